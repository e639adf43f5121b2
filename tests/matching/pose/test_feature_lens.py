"""FeatureSet.bind with a lens: frames are rendered through OpenCV's camera model or the polynomial of the thesis."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.special
import scipy.stats

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.pose.bound_features import BoundFeatures
from gpuvision.status import Status

PIXEL, SHAPE, NOISE, BLUR = 20e-6, (200, 240), 2.0, 1.0
PLACEMENT = np.array([10e-3, 20e-3])
NEAR = np.array([*PLACEMENT, 0.0])
FOCAL, K1, CENTRE = 220.0, -0.2, (123.5, 96.0)  # 14 px of distortion in the corners
CAMERA = Camera(matrix=((FOCAL, 0, CENTRE[0]), (0, FOCAL, CENTRE[1]), (0, 0, 1)), distortion=(K1, *13 * (0.0,)))
LENS = Lens(k1=-K1 / FOCAL**2, k2=0.1 / FOCAL**4, centre=CENTRE)
# On the board, relative to the placement point [mm]: middle and half sides of pads; the last two are traces. Most lie
# on one side, so that an uncorrected distortion does not cancel.
PADS = np.array([(1.3, 0.9, 0.3, 0.25), (1.5, -0.9, 0.25, 0.3), (0.2, 1.3, 0.3, 0.25), (1.8, 0.1, 0.1, 0.5)])
PADS = np.vstack([PADS, (0.7, -1.3, 0.5, 0.08)]) * 1e-3
DISCS = np.array([(0.6, 0.6, 0.16), (0.5, -0.6, 0.18), (1.0, 0.1, 0.16)]) * 1e-3  # x, y, radius


def undistorted(model: Camera | Lens, pixels: np.ndarray) -> np.ndarray:
    """Return the undistorted pixels (..., 2) of measured ones."""
    if isinstance(model, Camera):
        stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        matrix = np.array(model.matrix)
        flat = cv2.undistortPoints(pixels.reshape(-1, 1, 2), matrix, np.array([K1, 0, 0, 0]), P=matrix, criteria=stop)
        return flat.reshape(pixels.shape)
    offset = pixels - CENTRE
    square = (offset**2).sum(axis=-1, keepdims=True)
    return pixels + offset * (model.k1 * square + model.k2 * square**2)


def picture(model: Camera | Lens | None, pose: np.ndarray) -> np.ndarray:
    """Return the grey levels that a camera at a pose sees, without noise."""
    pixels = np.stack(np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0])), axis=-1).astype(np.float64)
    ideal = pixels if model is None else undistorted(model, pixels)
    across, up = (ideal - (np.array(SHAPE[::-1]) - 1) / 2).transpose(2, 0, 1) * PIXEL * np.array([1, -1])[:, None, None]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    point = np.stack([c * across - s * up, s * across + c * up], axis=-1) + pose[:2] - PLACEMENT
    inside = [
        (half - np.abs(point - middle)).min(axis=-1) for middle, half in zip(PADS[:, :2], PADS[:, 2:], strict=True)
    ]
    inside += [each[2] - np.hypot(*(point - each[:2]).transpose(2, 0, 1)) for each in DISCS]
    return 60 + 110 * scipy.special.ndtr(np.max(inside, axis=0) / PIXEL / BLUR)


def image(levels: np.ndarray, rng: np.random.Generator, noise: float = NOISE) -> np.ndarray:
    return np.rint(levels + rng.normal(0.0, noise, SHAPE)).clip(0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def features() -> FeatureSet:
    """Return rulers across the sides of the pads, across the traces, and the discs as fiducials."""
    rulers = []
    for x, y, wide, high in PADS[:3]:
        for along in (-0.4, 0.4):
            rulers += [(x + sign * wide, y + along * high, sign, 0, 0) for sign in (-1, 1)]
            rulers += [(x + along * wide, y + sign * high, 0, sign, 0) for sign in (-1, 1)]
    (x, y, wide, high), (far, low, long, thin) = PADS[3:]
    rulers += [(x, y + along * high, 1, 0, 2 * wide) for along in (-0.6, 0.0, 0.6)]
    rulers += [(far + along * long, low, 0, 1, 2 * thin) for along in (-0.6, 0.0, 0.6)]
    rows = np.array(rulers, np.float64)
    return FeatureSet(
        side="top",
        placement=PLACEMENT,
        point=rows[:, :2] + PLACEMENT,
        normal=rows[:, 2:4],
        spacing=rows[:, 4],
        length=np.full(len(rows), 28 * PIXEL),
        sigma=np.full(len(rows), 0.1 * PIXEL),
        fiducials=Fiducials(DISCS[:, :2] + PLACEMENT, DISCS[:, 2], np.array([0.0, 0.0, 1e-5]), np.full(3, 1e-6)),
        imaging=Imaging(pixel=PIXEL, blur_px=BLUR, shift=5 * PIXEL, angle=5e-3, etch_bias_sigma=0.0),
        covariance=np.eye(3),
        condition=1.0,
        region=np.stack([PLACEMENT - 2e-3, PLACEMENT + 2e-3]),
    )


def bind(features: FeatureSet, device: Device, **more: Any) -> BoundFeatures:
    shape = more.pop("shape", SHAPE)
    return features.bind(device, shape, np.uint8, **{"copper": "bright", "threshold": 20.0, "noise": NOISE} | more)


@pytest.mark.parametrize(
    "model", [pytest.param(CAMERA, id="camera"), pytest.param(LENS, id="lens", marks=pytest.mark.slow)]
)
def test_errors_are_as_predicted_behind_a_strong_lens(
    model: Camera | Lens, features: FeatureSet, device: Device, rng: np.random.Generator, draws: Callable[..., int]
) -> None:
    """Squared Mahalanobis distances are below 99.99 % of chi square, and above a third of it.

    The covariance contains a sampling error of 0.02 px of each edge: without a lens the mean distance is 0.64 per
    degree of freedom, too.
    """
    bound, count, total = bind(features, device, model=model), draws(4, 40), 0.0
    for _ in range(count):
        true = NEAR + rng.uniform(-1, 1, 3) * (3 * PIXEL, 3 * PIXEL, 4e-3)
        seen = image(picture(model, true), rng)
        found = bound(seen, NEAR)
        assert found.status == 0
        assert not found.feature_status.any()
        error = found.pose - true
        assert (np.abs(error) < 3.9 * np.sqrt(np.diag(found.covariance))).all()  # once in 10 000 errors
        total += error @ np.linalg.solve(found.covariance, error)
    low, high = scipy.stats.chi2.ppf([1e-4, 1 - 1e-4], 3 * count)
    assert low / 3 < total < high
    plain = bind(features, device)(seen, NEAR)
    assert plain.status != 0 or np.abs(plain.pose - true)[:2].max() > 40 * np.sqrt(found.covariance[0, 0])


@pytest.mark.parametrize("model", [CAMERA, LENS], ids=["camera", "lens"])
def test_every_feature_is_measured_without_bias(
    model: Camera | Lens, features: FeatureSet, device: Device, rng: np.random.Generator
) -> None:
    """In an image without noise all residuals are below 0.015 px, 3 px beside the predicted pose."""
    true = NEAR + np.array([-2.5 * PIXEL, 3 * PIXEL, 4e-3])
    found = bind(features, device, model=model)(image(picture(model, true), rng, 0.0), NEAR)
    assert found.status == 0
    assert np.abs(found.residuals).max() < 0.015 * PIXEL
    assert np.abs(found.pose - true)[:2].max() < 0.01 * PIXEL


@pytest.mark.parametrize("has_fiducials", [True, False])
@pytest.mark.parametrize("model", [CAMERA, LENS], ids=["camera", "lens"])
def test_covariance_refers_to_the_undistorted_image(
    model: Camera | Lens, has_fiducials: bool, features: FeatureSet, device: Device, rng: np.random.Generator
) -> None:
    """Sigmas and covariances in the distorted image, taken to the board by differences of the lens model."""
    if not has_fiducials:  # discs of another size are not the fiducials
        wrong = features.fiducials._replace(radius=features.fiducials.radius + 3 * PIXEL)
        features = replace(features, fiducials=wrong)
    bound = bind(features, device, model=model, noise=10 * NOISE)
    found = bound(image(picture(model, NEAR), rng, 0.0), NEAR)

    def jacobian(places: np.ndarray) -> np.ndarray:
        steps = [undistorted(model, places + e) - undistorted(model, places - e) for e in 0.5 * np.eye(2)]
        return np.stack(steps, axis=-1)

    outputs = {name: bound.stages[name].outputs for name in ("place", "edges", "matched", "drilled")}
    rulers = to_numpy(outputs["place"].rulers).astype(np.float64)
    seen = features.normal * (1, -1)  # the normals in the undistorted image: rows point down
    slope = np.einsum("ni,nij,nj->n", seen, jacobian(rulers[:, :2]), rulers[:, 2:4])
    assert slope.max() > 1.1
    sigma = np.hypot(to_numpy(outputs["edges"].sigma) * slope, 0.02) * PIXEL
    (x, y), (nx, ny) = (features.point - PLACEMENT).T, features.normal.T
    rows = np.stack([nx, ny, ny * x - nx * y], axis=1) / sigma[:, None]
    information = rows.T @ rows
    for name, which, systematic in (("matched", [0, 1], 0.003), ("drilled", [2], 0.02))[: 2 * has_fiducials]:
        places = to_numpy(getattr(outputs["place"], name))[:, :2] + to_numpy(outputs[name].shift)
        bend, found_covariance = jacobian(places.astype(np.float64)), to_numpy(outputs[name].covariance)[:, :2, :2]
        for each, (px, py) in enumerate(features.fiducials.point[which] - PLACEMENT):
            covariance = bend[each] @ found_covariance[each] @ bend[each].T + systematic**2 * np.eye(2)
            axes = np.array([[1, 0, -py], [0, 1, px]]) / PIXEL * np.array([[1], [-1]])
            information += axes.T @ np.linalg.solve(covariance, axes)
    expected = np.linalg.inv(information)
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / unit, expected / unit, atol=5e-3)


def test_a_region_of_the_image_gives_the_pose_of_the_image(
    features: FeatureSet, device: Device, rng: np.random.Generator
) -> None:
    """The features lie 3 px from their expected places, and the region begins far from the corner of the image."""
    whole = image(picture(CAMERA, NEAR + np.array([-2.5 * PIXEL, 3 * PIXEL, 4e-3])), rng)
    of_whole = bind(features, device, model=CAMERA)
    expected = of_whole(whole, NEAR)
    top, left = 4, 80
    cut = np.ascontiguousarray(whole[top:-2, left:-2])
    found = bind(features, device, shape=cut.shape, frame_shape=SHAPE, model=CAMERA)(cut, NEAR, corner=(left, top))
    assert not found.feature_status.any()
    assert (np.abs(found.pose - expected.pose) <= (1e-3 * PIXEL, 1e-3 * PIXEL, 3e-6)).all()
    np.testing.assert_allclose(found.residuals, expected.residuals, rtol=0, atol=2e-3 * PIXEL)
    unit = np.sqrt(np.outer(np.diag(expected.covariance), np.diag(expected.covariance)))
    np.testing.assert_allclose(found.covariance / unit, expected.covariance / unit, rtol=0, atol=2e-3)


@pytest.mark.slow  # two more builds
@pytest.mark.parametrize("model", [CAMERA, LENS], ids=["camera", "lens"])
def test_both_kernel_variants_give_the_same_pose(
    model: Camera | Lens, features: FeatureSet, device: Device, rng: np.random.Generator
) -> None:
    seen = image(picture(model, NEAR), rng)
    bound = bind(features, device, model=model)
    pose, residuals = bound(seen, NEAR).pose.copy(), bound(seen, NEAR).residuals.copy()
    for variant in ("vector", "work_item"):
        solver = replace(bound.operation.solver, variant=variant)
        found = bind(features, device, model=model, solver=solver)(seen, NEAR)
        np.testing.assert_allclose(found.residuals, residuals, atol=1e-4 * PIXEL)
        assert (np.abs(found.pose - pose) <= (1e-4 * PIXEL, 1e-4 * PIXEL, 1e-6)).all()


def test_features_past_the_fold_are_not_invertible(
    features: FeatureSet, device: Device, rng: np.random.Generator
) -> None:
    """The fold of r (1 - 0.2 r^2) lies at r = sqrt(5/3): 284 px in the undistorted image. The camera is 225 px off."""
    bound = bind(features, device, model=CAMERA)
    found = bound(image(picture(CAMERA, NEAR), rng), NEAR - np.array([225 * PIXEL, 0.0, 0.0]))
    middle = (np.array(SHAPE[::-1]) - 1) / 2
    places = np.concatenate([features.point, features.fiducials.point]) - PLACEMENT
    pixels = middle + (places + np.array([225 * PIXEL, 0.0])) / PIXEL * (1, -1)
    distance, fold = np.hypot(*(pixels - CENTRE).T), FOCAL * np.sqrt(5 / 3)
    is_past = distance > fold + 3
    is_within = distance < fold - 3
    is_within[len(features.point) :] = False  # the contour of a fiducial reaches farther
    assert is_past.sum() > 10
    assert is_within.sum() > 10
    assert (found.feature_status[is_past] == Status.NOT_INVERTIBLE).all()
    assert (found.feature_status[is_within] == Status.OUT_OF_RANGE).all()
    assert np.isnan(found.pose).all()
    lost = bound(image(picture(CAMERA, NEAR), rng), (np.nan, 0.0, 0.0))
    assert (lost.feature_status & Status.NOT_FINITE).all()


def test_other_models_are_refused(features: FeatureSet, device: Device) -> None:
    with pytest.raises(TypeError, match=r"CameraFeatures\.model is 0\.2, expected a Lens or a Camera"):
        bind(features, device, model=0.2)
