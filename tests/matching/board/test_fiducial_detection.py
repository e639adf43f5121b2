"""Found fiducials: principal axes, rows of the pose, sizes and places, against numbers by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board import fiducial_detection
from gpuvision.matching.board.fiducial_detection import FoundFiducials, find_fiducials
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.status import Status

COVARIANCE = np.array([[[4.0, 1.0], [1.0, 2.0]], [[1.0, 0.0], [0.0, 9.0]], [[np.nan] * 2] * 2]) * 1e-12
SEEN = np.array([[1.1e-3, 2.2e-3], [-3.1e-3, 0.4e-3], [np.nan, np.nan]])
FOUND = FoundFiducials(
    point=np.array([[1e-3, 2e-3], [-3e-3, 0.5e-3], [0.0, 0.0]]),
    radius=np.array([1e-4, 2e-4, 3e-4]),
    seen=SEEN,
    image_px=SEEN,
    size=np.array([1e-4, 2e-4, np.nan]),
    covariance=COVARIANCE,
    weight=np.zeros(3),
    residual=np.full((3, 2), np.nan),
    status=np.zeros(3, np.uint8),
    in_image=np.ones(3, np.bool_),
)


def test_axes_are_those_of_the_covariance() -> None:
    sigma, axes = FOUND.axes
    assert FOUND.found.tolist() == [True, True, False]
    assert np.isnan(sigma[2]).all()
    assert (sigma[:2, 0] <= sigma[:2, 1]).all()
    for number in range(2):
        back = axes[number].T @ np.diag(sigma[number] ** 2) @ axes[number]
        np.testing.assert_allclose(back, COVARIANCE[number], rtol=1e-12, atol=1e-26)
    # Each row of the pose is the displacement along an axis, relative to the placement point.
    place = np.array([5e-4, -2e-4])
    rows = FOUND.rows(place)
    assert rows.shape == (6, 8)
    np.testing.assert_allclose(rows[:, :2], axes.reshape(-1, 2))
    np.testing.assert_allclose(rows[:, 2:4], np.repeat(FOUND.point - place, 2, axis=0))
    np.testing.assert_allclose(rows[:, 4:6], np.repeat(SEEN - FOUND.point, 2, axis=0), atol=1e-18)
    np.testing.assert_allclose(rows[:, 6], sigma.ravel())
    np.testing.assert_array_equal(rows[:, 7], 0.0)


def test_least_sigma_applies_along_each_axis() -> None:
    limited = FOUND.with_min_sigma(2e-6)
    sigma, axes = FOUND.axes
    expected = np.maximum(sigma, 2e-6)
    assert (expected > sigma)[:2].any()
    for number in range(2):
        turned = axes[number] @ limited.covariance[number] @ axes[number].T
        np.testing.assert_allclose(turned, np.diag(expected[number] ** 2), rtol=1e-12, atol=1e-26)


def test_weights_and_residuals_of_the_two_rows() -> None:
    """The smaller weight counts; residuals along the axes become residuals in x and y."""
    _, axes = FOUND.axes
    residuals = np.array([1e-6, -2e-6, 3e-6, 0.5e-6, np.nan, np.inf])
    with_pose = FOUND.with_pose(np.array([0.9, 0.4, 0.051, 0.8, np.nan, 1.0]), residuals)
    np.testing.assert_allclose(with_pose.weight, [0.4, 0.051, 0.0])
    assert with_pose.used.tolist() == [True, True, False]
    for number in range(2):
        along = residuals[2 * number] * axes[number, 0] + residuals[2 * number + 1] * axes[number, 1]
        np.testing.assert_allclose(with_pose.residual[number], along)
    assert np.isnan(with_pose.residual[2]).all()
    assert FOUND.with_pose(np.array([0.05] * 6), residuals).used.tolist() == [False] * 3


@pytest.mark.parametrize("lens", [None, Lens(k1=1e-7, centre=(60.0, 30.0))])
def test_fiducials_are_searched_with_their_polarity_and_size(
    monkeypatch: pytest.MonkeyPatch, lens: Lens | None
) -> None:
    """Two kinds in one image: with a hole only the contour is measured; a blob of another size is no fiducial."""
    view = BoardView(scale=1e-4, shape=(80, 120), pose=(2e-3, 1e-3, 0.4), model=lens)
    fiducials = Fiducials(
        point=np.array([[2e-3, 1e-3], [3e-3, 2e-3], [1e-3, 0.5e-3], [2.5e-3, 0.0], [9e-3, 1e-3]]),
        radius=np.array([6e-4, 5e-4, 8e-4, 7e-4, 5e-4]),
        hole=np.array([0.0, 2e-4, 0.0, 3e-4, 0.0]),
        sigma=np.zeros(5),
    )
    shift = np.array([[0.5, -0.25], [-1.0, 0.75], [0.125, 0.25], [0.0, 1.0]])
    # Radii [px] as drawn 6, 5, 8, 7: errors of 2.2 px and 2.4 px, of which 1 px and 4 x 0.325 px are etching.
    size = np.array([6.0, 5.0 - 2.2, 8.0 + 2.4, 7.0 + 2.2])
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 9.0, 0.0], [0.0, 0.0, 1.0]]) * 1e-4
    asked: list[Any] = []
    order = {False: [0, 2], True: [1, 3]}

    def find(**how: Any) -> Any:
        def measure(grey: Any, places: np.ndarray, device: Any) -> Any:
            which = order[not how["match"]]
            asked.append((how, places, device))
            return SimpleNamespace(
                shift=shift[which].astype(np.float32),
                size=size[which].astype(np.float32),
                status=np.array([0, 0], np.uint8),
                covariance=np.tile(covariance, (2, 1, 1)).astype(np.float32),
            )

        return measure

    monkeypatch.setattr(fiducial_detection, "FindBlobs", find)
    device: Any = "device"
    found = find_fiducials(
        np.zeros((80, 120)),
        fiducials,
        view,
        is_bright=False,
        search_px=7.0,
        threshold=9.0,
        noise=2.0,
        blur_px=1.5,
        etch_bias_sigma=0.325e-4,
        device=device,
    )
    assert found.in_image.tolist() == [True, True, True, True, False]
    assert [how["match"] for how, _, _ in asked] == [True, False]
    for (how, places, on), which in zip(asked, ([0, 2], [1, 3]), strict=True):
        assert on == "device"
        assert (how["threshold"], how["polarity"], how["search_px"], how["noise"]) == (9.0, "dark", 7.0, 2.0)
        assert how["spokes"] == 16
        # 1.5 blurs, or the smallest radius over 2.5.
        assert how["smoothing_px"] == pytest.approx(min(2.25, fiducials.radius[which].min() / 1e-4 / 2.5))
        np.testing.assert_allclose(places[:, :2], view.to_measured_pixels(fiducials.point[which]), rtol=1e-5)
        np.testing.assert_allclose(places[:, 2], fiducials.radius[which] / 1e-4, rtol=1e-6)
    assert found.status.tolist() == [0, 0, Status.AMBIGUOUS, 0, Status.OUT_OF_RANGE]
    good = [0, 1, 3]
    pixels = view.to_measured_pixels(fiducials.point[good]) + shift[good]
    np.testing.assert_allclose(found.image_px[good], pixels, atol=1e-4)
    ideal = pixels if lens is None else lens.undistort(pixels)
    np.testing.assert_allclose(found.seen[good], view.to_plane(ideal), atol=1e-8)
    np.testing.assert_allclose(found.size[:4], size * 1e-4, rtol=1e-6)
    assert np.isnan(found.seen[[2, 4]]).all()
    assert np.isnan(found.image_px[[2, 4]]).all()
    # The errors without noise: 0.003 px of matched ones, 0.02 px of drilled ones.
    back = np.linalg.inv(view.matrix[:2, :2])
    for number, rest in ((0, 0.003), (1, 0.02), (3, 0.02)):
        expected = back @ (covariance[:2, :2] + rest**2 * np.eye(2)) @ back.T
        np.testing.assert_allclose(found.covariance[number], expected, rtol=1e-5)
    assert not found.weight.any()
