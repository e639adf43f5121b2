"""FeatureSet.bind: rulers, pairs and fiducials in one enqueued sequence give the pose of the operations one by one."""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from boards import BOARD_MIDDLE
from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.edge_measurement import move_view
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.feature_set import FeatureSet, choose_features
from gpuvision.matching.features.fiducials import SPOKES, Fiducials, fiducial_smoothing
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.bound_features import BoundFeatures
from gpuvision.matching.pose.feature_pose import CameraFeatures, EstimateFeaturePose, SolveFeatures
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.reference import robust
from gpuvision.status import Status
from round_boards import (
    FIDUCIALS,
    LANDS,
    NOISE,
    PIXEL,
    SHAPE,
    TRACES,
    moved_picture,
    round_artwork,
    round_board,
    round_picture,
)

NEAR = np.array([*BOARD_MIDDLE, 0.0])
BLUR, THRESHOLD = 1.04, 12.0
IMAGING = Imaging(pixel=PIXEL, blur_px=BLUR, contrast_bare=110 / NOISE, contrast_masked=50 / NOISE, angle=5.3e-3)


@pytest.fixture(scope="module")
def artwork(tmp_path_factory: pytest.TempPathFactory) -> Artwork:
    """Return a board with traces, fiducials and pads."""
    return round_artwork(round_board(tmp_path_factory.mktemp("board"), traces=TRACES))


@pytest.fixture(scope="module")
def features(artwork: Artwork) -> FeatureSet:
    """Return pairs, single edges (one side of every third trace), and fiducials, two of them for the contour only."""
    chosen = choose_features(artwork, ((2e-3, 2e-3), (18e-3, 14e-3)), IMAGING, budget=200)
    is_single = np.arange(len(chosen.spacing)) % 3 == 0
    edge = chosen.point + chosen.normal * chosen.spacing[:, None] / 2
    found = replace(
        chosen,
        point=np.where(is_single[:, None], edge, chosen.point),
        spacing=np.where(is_single, 0.0, chosen.spacing),
        fiducials=chosen.fiducials._replace(hole=np.where(np.arange(len(chosen.fiducials.hole)) < 2, 1e-4, 0.0)),
    )
    assert is_single.sum() >= 5
    return found


@pytest.fixture(scope="module")
def seen(artwork: Artwork) -> tuple[np.ndarray, np.ndarray]:
    """Return an image and the true pose of the camera."""
    return moved_picture(round_picture(artwork), np.random.default_rng(5))


def bind(features: FeatureSet, device: Device, shape: tuple[int, int] = SHAPE, **more: Any) -> BoundFeatures:
    return features.bind(device, shape, np.uint8, **{"copper": "bright", "threshold": THRESHOLD, "noise": NOISE} | more)


def one_by_one(features: FeatureSet, image: np.ndarray, view: BoardView, device: Device, length: int) -> np.ndarray:
    """Return the feature rows (n, 8) about the placement point from the existing operations, and float64 geometry."""
    matrix, smoothing = view.matrix, IMAGING.smoothing_ratio * BLUR
    direction = features.normal @ matrix[:2, :2].T * PIXEL
    placed = np.concatenate([view.to_pixels(features.point), direction], axis=1).astype(np.float32)
    position, sigma = np.empty((2, len(placed)))
    for number, spacing in enumerate(features.spacing / PIXEL):
        kind: dict[str, Any] = {"polarity": "falling"}
        if spacing > 0:
            limits = (max(0.6 * spacing - 2, 1.0), 1.4 * spacing + 2)
            kind = {"polarity": "rising", "pairs": True, "spacing_px": limits}
        edges = RulerEdges(threshold=THRESHOLD, length=length, smoothing_px=smoothing, noise=NOISE, **kind)
        found = edges(image, placed[number : number + 1], device=device)
        position[number], sigma[number] = found.position[0], found.sigma[0]
    measured = features.point + features.normal * (position * PIXEL)[:, None] - features.placement
    factor = np.where(features.spacing == 0, 1.0, 0.0)
    all_sigma = np.hypot(sigma, 0.02) * PIXEL
    rows = [line_rows(features.normal, features.point - features.placement, measured, all_sigma, factor)]
    of = features.fiducials
    for is_drilled in (False, True):
        which = np.flatnonzero((of.hole > 0) == is_drilled)
        reach = math.sqrt(2) * IMAGING.shift + IMAGING.angle * np.hypot(*(of.point - features.placement).T).max()
        blobs = FindBlobs(
            threshold=THRESHOLD,
            polarity="bright",
            search_px=(reach + 3 * IMAGING.etch_bias_sigma) / PIXEL + 1,
            spokes=SPOKES,
            smoothing_px=min(fiducial_smoothing(BLUR), of.radius[which].min() / PIXEL / 2.5),
            match=not is_drilled,
            noise=NOISE,
        )
        places = np.concatenate([view.to_pixels(of.point[which]), of.radius[which, None] / PIXEL], axis=1)
        found = blobs(image, places.astype(np.float32), device=device)
        back = np.linalg.inv(matrix[:2, :2])
        covariance = found.covariance[:, :2, :2] + (0.02 if is_drilled else 0.003) ** 2 * np.eye(2)
        variance, columns = np.linalg.eigh(back @ covariance.astype(np.float64) @ back.T)
        axes = np.swapaxes(columns, 1, 2)
        point = (of.point[which] - features.placement)[:, None]
        shifted = point + (found.shift.astype(np.float64) @ back.T)[:, None]
        rows.append(line_rows(axes, point, shifted, np.sqrt(variance), 0.0))
    return np.concatenate(rows)


def assert_near(pose: np.ndarray, expected: Any, tolerance: Any) -> None:
    assert (np.abs(pose - expected) <= tolerance).all(), (pose - expected, tolerance)


def length_of(bound: BoundFeatures) -> int:
    return bound.operation.ruler.length


@pytest.mark.parametrize("kind", ["rulers", "fiducials"])
def test_one_kind_of_features_is_enough(
    kind: str, features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, true = seen
    found = bind(only(features, kind), device)(image, NEAR)
    assert found.status == 0
    assert_near(found.pose, true, 5 * np.sqrt(np.diag(found.covariance)))


@pytest.mark.double
def test_pose_is_that_of_the_operations_one_by_one(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, _ = seen
    bound = bind(features, device)
    expected = NEAR + np.array([20e-6, -30e-6, 1e-3])
    found = bound(image, expected)
    view = BoardView(scale=PIXEL, shape=SHAPE, pose=tuple(expected))
    rows = one_by_one(features, image, view, device, length_of(bound))
    assert np.isfinite(rows).all()
    offset = tuple(expected[:2] - features.placement)
    solver = replace(bound.operation.solver, precision="double", placement=offset)
    parts = solver(np.ascontiguousarray(rows), device=device)
    cosine, sine = math.cos(parts.pose[2]), math.sin(parts.pose[2])
    turned = np.array([[cosine, -sine], [sine, cosine]])
    shift = parts.pose[:2] + features.placement - turned @ features.placement
    camera = np.array(move_view(view, (*shift, parts.pose[2])).pose)
    assert_near(found.pose, camera, (1e-9, 1e-9, 2e-7))
    rulers = len(features.spacing)
    np.testing.assert_allclose(found.residuals[:rulers], parts.residuals[:rulers], atol=2e-9)
    assert found.status == 0
    assert int(found.inliers) == int(parts.inliers)
    np.testing.assert_allclose(found.etch_bias, parts.etch_bias, atol=2e-9)
    # Covariance of the camera from the covariance of the board's motion at the image centre, by differences.
    scale = min(float(parts.residual_scale), 1.0) ** 2

    def camera_of(state: np.ndarray) -> np.ndarray:
        """Camera for a measured place of the expected image centre and a turn of the board."""
        c, s = math.cos(state[2]), math.sin(state[2])
        turn = np.array([[c, -s], [s, c]])
        return np.array(move_view(view, (*(state[:2] - turn @ expected[:2]), state[2])).pose)

    place = parts.placement + features.placement
    state, steps = np.array([*place, parts.pose[2]]), np.array([1e-6, 1e-6, 1e-5])
    jacobian = np.stack(
        [
            (camera_of(state + e * h) - camera_of(state - e * h)) / (2 * h)
            for e, h in zip(np.eye(3), steps, strict=True)
        ],
        1,
    )
    np.testing.assert_allclose(
        found.covariance, jacobian @ parts.covariance @ jacobian.T / scale, rtol=2e-3, atol=1e-18
    )


def test_pose_is_the_least_squares_minimum(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    """SciPy minimises the same loss in float64, without an etch bias and with trusted sigmas."""
    image, _ = seen
    bound = bind(features, device, etch_bias_sigma=0.0, solver=SolvePose(scale=1.0, max_iterations=30))
    found = bound(image, NEAR)
    view = BoardView(scale=PIXEL, shape=SHAPE, pose=tuple(NEAR))
    rows = one_by_one(features, image, view, device, length_of(bound))
    pose = robust.solve_pose(rows[:, :7], 3, 1.0, "tukey", 4.685, found.motion.astype(np.float64))
    assert_near(found.motion, pose, (3e-9, 3e-9, 1e-6))  # a fiftieth of the standard deviations
    assert found.status == Status.OK
    once = bind(features, device, etch_bias_sigma=0.0, solver=SolvePose(loss="huber", scale=1.0, max_iterations=1))
    first = once(image, NEAR)
    assert first.status == Status.NOT_CONVERGED
    assert np.isfinite(first.pose).all()


def test_errors_are_as_predicted(artwork: Artwork, features: FeatureSet, device: Device) -> None:
    """Squared Mahalanobis distances of 12 random motions: chi square of 36 degrees of freedom, between 15 and 70."""
    rng, picture, bound = np.random.default_rng(8), round_picture(artwork), bind(features, device)
    total, pose = 0.0, NEAR
    for _ in range(12):
        image, true = moved_picture(picture, rng)
        found = bound(image, pose)
        error = found.pose - true
        total += error @ np.linalg.solve(found.covariance, error)
        pose = found.pose.copy()  # the rulers follow the board
    assert 15 < total < 70


def test_a_region_of_the_image_gives_the_pose_of_the_image(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, _ = seen
    whole = bind(features, device)(image, NEAR).pose.copy()
    top, left = 3, 4
    cut = np.ascontiguousarray(image[top:-2, left:-2])
    bound = bind(features, device, cut.shape, frame_shape=SHAPE)
    found = bound(cut, NEAR, corner=(left, top))
    assert_near(found.pose, whole, (3e-8, 3e-8, 3e-6))
    # Another corner is an argument, not a new build: the same pixels, stated to lie elsewhere, are another pose.
    moved = bound(cut, NEAR + np.array([PIXEL, -2 * PIXEL, 0.0]), corner=(left - 1, top - 2))
    assert_near(moved.pose - whole, (PIXEL, -2 * PIXEL, 0.0), (3e-8, 3e-8, 3e-6))


def test_a_mirrored_side_is_seen_from_behind(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    """The mirrored image shows the same board at the same pose to a camera below it, whose columns run backwards."""
    image, _ = seen
    front = bind(features, device)(image, NEAR).pose.copy()
    mirrored = np.ascontiguousarray(image[:, ::-1])
    found = bind(replace(features, side="bottom"), device)(mirrored, NEAR)
    assert_near(found.pose, front, (3e-8, 3e-8, 3e-6))


def test_search_distance_shortens_the_rulers(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, true = seen
    long, short = bind(features, device), bind(features, device, search_px=1.0)
    assert length_of(short) < length_of(long)
    found = short(image, true)
    assert found.status == 0
    assert_near(found.pose, true, 5 * np.sqrt(np.diag(found.covariance)))


def test_frames_of_a_camera_need_no_copy(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, _ = seen
    bound = bind(features, device)
    result = bound(image, NEAR)
    pose = result.pose.copy()
    bound.frame[...] = 0
    assert bound(None, NEAR).status == Status.NO_DATA
    bound.frame[...] = image
    again = bound(None, NEAR)
    np.testing.assert_array_equal(again.pose, pose)
    # The same arrays in every call: nothing is allocated.
    assert all(a is b for a, b in zip(again, result, strict=True))


def test_a_device_with_separate_memory_gives_the_same_pose(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    separate = copy.copy(device)
    separate.shares_memory = False
    expected, found = (bind(features, each)(seen[0], NEAR) for each in (device, separate))
    np.testing.assert_array_equal(found.pose, expected.pose)
    np.testing.assert_array_equal(found.covariance, expected.covariance)


def test_results_must_lie_apart(features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device) -> None:
    operation = bind(features, device).operation
    frames = seen[0], NEAR.astype(np.float64 if device.has_double else np.float32), np.zeros(2, np.float32)
    result = operation(*frames, device=device)
    with pytest.raises(ValueError, match="arrays apart"):
        operation(*frames, device=device, out=result._replace(scale=result.residual_scale))


def test_a_board_that_is_not_there_is_refused(features: FeatureSet, device: Device) -> None:
    bound = bind(features, device)
    found = bound(np.full(SHAPE, 80, np.uint8), NEAR)
    assert found.status == Status.NO_DATA
    assert np.isnan(found.pose).all()
    assert np.isnan(found.covariance).all()
    assert (found.feature_status & Status.LOW_SIGNAL).all()
    lost = bound(np.full(SHAPE, 80, np.uint8), (np.nan, 0.0, 0.0))
    assert lost.status & Status.NOT_FINITE
    assert np.isnan(lost.pose).all()


def test_a_blob_of_another_size_is_not_the_fiducial(
    features: FeatureSet, seen: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    image, _ = seen
    of = features.fiducials
    matched = np.flatnonzero(of.hole == 0)
    radius = of.radius.copy()
    radius[matched[0]] += 3 * PIXEL
    found = bind(replace(features, fiducials=of._replace(radius=radius)), device)(image, NEAR)
    count = len(features.spacing)
    assert found.feature_status[count] == Status.AMBIGUOUS
    assert not found.feature_status[count + 1 : count + 3].any()
    assert (found.weights[count : count + 2] == 0).all()
    assert np.isnan(found.residuals[count : count + 2]).all()
    assert found.status == 0


def only(features: FeatureSet, kind: str) -> FeatureSet:
    """Return the rulers of a feature set, or its fiducials without holes."""
    if kind == "rulers":
        return replace(features, fiducials=Fiducials.empty())
    fiducials = features.fiducials.subset(features.fiducials.hole == 0)
    empty = {name: getattr(features, name)[:0] for name in ("point", "normal", "spacing", "length", "sigma")}
    return replace(features, fiducials=fiducials, **empty)


def test_a_radius_at_the_tolerance_is_the_fiducials(features: FeatureSet, device: Device) -> None:
    """Powers of two: 8 px drawn, 1 px of tolerance, and measured radii at the ends of the range and just beyond."""
    pixel = 2.0**-16
    sizes = np.array([7.0, 9.0, 8.0, np.nextafter(np.float32(7.0), 0), np.nextafter(np.float32(9.0), 10)], np.float32)
    count = len(sizes)
    places = tuple((x * 1e-3, y * 1e-3, 8.0 * pixel) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1), (0, 0)))
    operation = SolveFeatures(
        features=CameraFeatures(
            rulers=(), matched=places, drilled=(), placement=(0.0, 0.0), pixel_size=pixel, frame_shape=SHAPE
        ),
        solver=bind(only(features, "fiducials"), device).operation.solver,
        size_tolerance=pixel,
        ruler_sigma_px=0.0,
        matched_sigma_px=0.0,
        drilled_sigma_px=0.0,
        min_share=0.0,
        max_residual_px=1.0,
    )
    pose = np.zeros(3, np.float64 if device.has_double else np.float32)
    covariance = np.broadcast_to(np.float32(1e-4) * np.eye(3, dtype=np.float32), (count, 3, 3)).copy()
    measured = (np.zeros((count, 2), np.float32), sizes, covariance, np.zeros(count, np.uint8))
    found = operation(pose, np.zeros(2, np.float32), *measured, np.zeros((count, 3), np.float32), device=device)
    np.testing.assert_array_equal(found.feature_status, [0, 0, 0, Status.AMBIGUOUS, Status.AMBIGUOUS])


def test_nothing_is_added_to_the_predicted_sigmas_by_default() -> None:
    """Any radius of a fiducial is taken, and the solver and its limits are the default ones."""
    features = CameraFeatures(
        rulers=((0.0, 0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0),) * 3,
        matched=(),
        drilled=(),
        placement=(0.0, 0.0),
        pixel_size=1e-5,
        frame_shape=SHAPE,
    )
    blobs = FindBlobs(threshold=THRESHOLD)
    ruler = RulerEdges(threshold=THRESHOLD, length=41, per_ruler=True)
    made = EstimateFeaturePose(features=features, ruler=ruler, matched=blobs, drilled=blobs)
    assert made.layout(Device.best(), SHAPE, np.dtype(np.uint8)).stages[-1].operation == SolveFeatures(
        features=features,
        solver=SolvePose(),
        ruler_sigma_px=0.0,
        matched_sigma_px=0.0,
        drilled_sigma_px=0.0,
        size_tolerance=math.inf,
        min_share=0.5,
        max_residual_px=0.5,
    )


def solved(position: np.ndarray, sigma: np.ndarray, status: np.ndarray, device: Device, **limits: float) -> Any:
    """Return the pose from positions and sigmas [px] of rulers on a circle of 1 mm, and two fiducials that agree."""
    count, pixel = len(position), 1e-5
    angle = 2 * np.pi * np.arange(count) / count
    c, s = np.cos(angle), np.sin(angle)
    none, one = np.zeros(count), np.ones(count)
    rulers = np.column_stack([1e-3 * (c - s), 1e-3 * (s + c), c, s, one, none, none, none])
    operation = SolveFeatures(
        features=CameraFeatures(
            rulers=tuple(map(tuple, rulers)),
            matched=((1e-3, 0.0, 1e-4), (-1e-3, 0.0, 1e-4)),
            drilled=(),
            placement=(0.0, 0.0),
            pixel_size=pixel,
            frame_shape=SHAPE,
        ),
        solver=SolvePose(scale=None, min_scale=1.0),
        size_tolerance=pixel,
        ruler_sigma_px=0.0,
        matched_sigma_px=0.0,
        drilled_sigma_px=0.0,
        **{"min_share": 0.0, "max_residual_px": 100.0} | limits,
    )
    covariance = np.broadcast_to(np.float32(1e-2) * np.eye(3, dtype=np.float32), (2, 3, 3)).copy()
    blobs = (np.zeros((2, 2), np.float32), np.full(2, 10.0, np.float32), covariance, np.zeros(2, np.uint8))
    edges = (position.astype(np.float32), sigma.astype(np.float32), status, np.zeros((count, 7), np.float32))
    pose = np.zeros(3, np.float64 if device.has_double else np.float32)
    places = np.zeros((2, 3), np.float32)
    return operation(pose, np.zeros(2, np.float32), *edges, *blobs, places, device=device)


def test_a_share_of_the_features_in_the_image_must_agree(device: Device) -> None:
    """12 rulers, 3 outside the image, 4 without an edge: 5 of 9 agree, with the fiducials 9 of 13 rows."""
    position, status = np.zeros(12), np.zeros(12, np.uint8)
    status[[0, 4, 8]], status[[1, 2, 5, 6]] = Status.OUT_OF_RANGE, Status.LOW_SIGNAL
    position[status > 0] = np.nan
    sigma = np.where(status > 0, np.nan, 0.1)
    found = solved(position, sigma, status, device, min_share=9 / 13 - 1e-6)
    assert found.status == Status.OK
    assert found.inliers == 9
    refused = solved(position, sigma, status, device, min_share=9 / 13 + 1e-6)
    assert refused.status == Status.AMBIGUOUS
    assert np.isnan(refused.pose).all()
    assert np.isnan(refused.covariance).all()
    assert np.isnan(refused.residuals).all()


def test_residuals_beyond_their_sigmas_must_be_below_a_limit(device: Device) -> None:
    """The limit is compared with the residuals that the median sigma of the rows, found to 1 %, does not explain."""
    rng = np.random.default_rng(4)
    sigma = rng.uniform(0.05, 0.3, 61)
    position, status = rng.normal(0.0, 3 * sigma), np.zeros(61, np.uint8)
    found = solved(position, sigma, status, device)
    assert found.residual_scale > 2.0
    explained = 1.0 + 3.0 * math.sqrt(2.0 / (found.inliers - 3))
    residual_px = math.sqrt(found.residual_scale**2 - explained) * np.median(np.concatenate([sigma, np.full(4, 0.1)]))
    assert solved(position, sigma, status, device, max_residual_px=1.02 * residual_px).status == Status.OK
    refused = solved(position, sigma, status, device, max_residual_px=0.98 * residual_px)
    assert refused.status == Status.AMBIGUOUS
    assert np.isnan(refused.pose).all()


@pytest.mark.parametrize(("noise", "offset", "is_accepted"), [(0.1, 0.0, True), (1.0, 0.0, True), (1.0, 4.0, False)])
def test_large_predicted_sigmas_are_no_other_board(
    noise: float, offset: float, is_accepted: bool, device: Device
) -> None:
    """Errors of 1 px are predicted: residuals of 0.1 and 1 px are no larger; offsets by 4 px inward and outward are."""
    rng, accepted = np.random.default_rng(8), np.zeros(2, int)
    for _ in range(20):
        position = rng.normal(0.0, noise, 61) + offset * rng.choice([-1.0, 1.0], 61)
        for number, limit_px in enumerate((0.5, 1e6)):
            found = solved(position, np.ones(61), np.zeros(61, np.uint8), device, max_residual_px=limit_px)
            accepted[number] += int(found.status) == Status.OK
    # Other limits refuse frames in which a fiducial is an outlier.
    assert accepted[1] >= 5
    assert accepted[0] == (accepted[1] if is_accepted else 0)


def test_other_boards_are_refused(features: FeatureSet, tmp_path: Path, device: Device) -> None:
    """Boards whose features lie up to 0.15 mm from their places; with fiducials half of them pass the other checks."""
    rng, accepted = np.random.default_rng(11), {"limits": 0, "no limits": 0}
    bound = {"limits": bind(features, device), "no limits": bind(features, device, min_share=0.0, max_residual_px=1e6)}
    for number in range(8):
        folder = tmp_path / str(number)
        folder.mkdir()
        pads, fiducials, ends = (
            np.array(each) + rng.uniform(-0.15, 0.15, np.shape(each)) for each in (LANDS, FIDUCIALS, TRACES)
        )
        picture = round_picture(round_artwork(round_board(folder, pads=pads, fiducials=fiducials, traces=ends)))
        for _ in range(3):
            image = moved_picture(picture, rng)[0]
            for name, of in bound.items():
                accepted[name] += int(of(image, NEAR).status) == Status.OK
    assert accepted["no limits"] >= 8
    assert accepted["limits"] == 0


@pytest.mark.parametrize("count", [3, 8])
def test_exact_edges_have_the_covariance_of_their_sigmas(count: int, device: Device) -> None:
    """A square without noise: the rulers at its sides agree exactly, and three rulers have no residuals."""
    image, half, pixel = np.full((128, 128), 50, np.uint8), 32, 1e-5
    image[32:96, 32:96] = 200
    rulers = []
    for number in range(count):
        angle, along = 0.5 * math.pi * (number % 4), -15.0 + 10.0 * (number // 4)
        c, s = round(math.cos(angle)), round(math.sin(angle))
        along -= 3.0 * (number % 4 == 2)
        rulers.append((pixel * (half * c - along * s), pixel * (half * s + along * c), c, s, -1.0, 0.0, 0.0, 0.0))
    features = CameraFeatures(
        rulers=tuple(rulers), matched=(), drilled=(), placement=(0, 0), pixel_size=pixel, frame_shape=image.shape
    )
    operation = EstimateFeaturePose(
        features=features,
        ruler=RulerEdges(threshold=20, length=32, per_ruler=True, smoothing_px=1.0, noise=1.0),
        matched=FindBlobs(threshold=20),
        drilled=FindBlobs(threshold=20),
        solver=SolvePose(scale=None, min_scale=1.0, max_leverage=1.0),
    )
    bound = BoundFeatures(operation, device, image.shape, np.uint8)
    found = bound(image, np.zeros(3))
    assert found.status == 0
    np.testing.assert_allclose(found.pose, 0.0, atol=1e-9)
    x, y, nx, ny = np.transpose(rulers)[:4]
    sigma = to_numpy(bound.stages["edges"].outputs.sigma).astype(np.float64) * pixel
    rows = np.stack([nx, ny, ny * x - nx * y], axis=1) / sigma[:, None]
    expected = np.linalg.inv(rows.T @ rows)
    unit = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / unit, expected / unit, atol=1e-4)
    if count == 3:
        assert np.isnan(found.residual_scale)
    else:
        assert found.residual_scale == 0.0
        np.testing.assert_array_equal(found.motion_covariance, 0.0)


def test_wrong_frames_and_options_are_refused(features: FeatureSet, device: Device) -> None:
    bound = bind(features, device)
    with pytest.raises(TypeError, match="frame: expected dtype uint8, got uint16"):
        bound(np.zeros(SHAPE, np.uint16), NEAR)
    with pytest.raises(ValueError, match="frame: expected shape"):
        bound(np.zeros((10, 10), np.uint8), NEAR)
    with pytest.raises(ValueError, match="rigid transform"):
        bind(features, device, solver=SolvePose(transform="similarity"))
    with pytest.raises(ValueError, match="threshold"):
        bind(features, device, threshold=0.0)
    with pytest.raises(ValueError, match="pixel_size"):
        bind(features, device, pixel_size=-1.0)
    two = {name: getattr(features, name)[:2] for name in ("point", "normal", "spacing", "length", "sigma")}
    few = replace(features, fiducials=Fiducials.empty(), **two)
    with pytest.raises(ValueError, match="2 rows"):
        bind(few, device)
