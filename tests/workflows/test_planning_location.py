"""Plan of a localization: the fastest features whose error of the pose is within the tolerance."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from board_images import BoardPicture, View
from boards import BOARD_MIDDLE, LAYERS, board_folder
from gpuvision.accuracy.plan import PlanError
from gpuvision.accuracy.trial import CallTime
from gpuvision.camera.image import PixelNoise
from gpuvision.camera.orthographic import BoardView
from gpuvision.formats.features_file import read_features
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.workflows import planning_location
from gpuvision.workflows.locating_board import locate_board
from gpuvision.workflows.location_plan import (
    FeaturesTrial,
    LocationPlan,
    LocationPlanLimits,
    usable_feature_sets,
)
from gpuvision.workflows.planning_location import choose_features, plan_location, pose_error

PIXEL, SHAPE, NOISE = 40e-6, (300, 400), 2.0
POSE = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, 2e-3)
EXPECTED = (*BOARD_MIDDLE, 0.0)
SHIFT, ANGLE = 4 * PIXEL, math.radians(0.3)  # search range of `locate_board` at a known pose


@pytest.fixture(scope="module")
def artwork(tmp_path_factory: pytest.TempPathFactory) -> Artwork:
    return read_artwork(board_folder(tmp_path_factory.mktemp("board")), layers=LAYERS)


@pytest.fixture(scope="module")
def picture(artwork: Artwork) -> BoardPicture:
    corner = np.array(BOARD_MIDDLE) + (np.array(SHAPE[::-1]) - 1) / 2 * PIXEL * (-1, 1)
    view = View(corner=tuple(corner), pixel=PIXEL, shape=SHAPE, noise=NOISE)
    return BoardPicture(artwork, view, margin=20)


def camera_image(picture: BoardPicture, pose: tuple[float, float, float], rng: np.random.Generator) -> Any:
    """Return the uint8 image of a camera at a pose: the board moves the other way."""
    x, y, theta = pose
    cos, sin = math.cos(theta), math.sin(theta)
    motion = np.array([[cos, sin], [-sin, cos]]) @ (np.array(BOARD_MIDDLE) - (x, y))
    # `seen` turns the board about the origin, the camera about its middle.
    middle = np.array(BOARD_MIDDLE)
    back = middle - np.array([[cos, sin], [-sin, cos]]) @ middle
    image = picture.seen((*(motion + back), -theta), rng)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


@pytest.fixture
def few_features(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try six feature sets: each width is a build of the kernel."""
    monkeypatch.setattr(planning_location, "_BUDGETS", (15, 40, 100))
    monkeypatch.setattr(planning_location, "_RULERS", ((3, math.sqrt(5.0)), (5, math.sqrt(5.0))))
    # A busy machine must not change their order.
    monkeypatch.setattr(
        planning_location,
        "loop_times",
        lambda calls, _: [CallTime(1e-4 * k, 1.1e-4 * k) for k in range(1, len(calls) + 1)],
    )


def plan_of(image: Any, artwork: Artwork, device: Device | None = None, **options: Any) -> LocationPlan:
    return plan_location(
        image, artwork, **({"scale": PIXEL, "initial_pose": EXPECTED, "device": device, "tolerance": 1.0} | options)
    )


def trial(error: float, leverage: float = 0.2, refused: float = 0.0) -> FeaturesTrial:
    features: Any = None
    return FeaturesTrial(features, 1e-4, 1.1e-4, error, error, 0.0, leverage, refused)


def test_the_error_of_a_pose_is_that_of_points_that_it_moves(rng: np.random.Generator) -> None:
    """Random poses of the covariance move the points by exactly these distances."""
    points = rng.uniform(-1.0, 1.0, (50, 2)) * (8e-3, 3e-3) + (2e-3, -1e-3)
    root = rng.normal(size=(3, 3)) * np.array([[2e-6], [1e-6], [4e-4]])
    poses = rng.normal(size=(20000, 3)) @ root.T
    covariance = poses.T @ poses / len(poses)
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x = cos[:, None] * points[:, 0] - sin[:, None] * points[:, 1] + poses[:, :1] - points[:, 0]
    y = sin[:, None] * points[:, 0] + cos[:, None] * points[:, 1] + poses[:, 1:2] - points[:, 1]
    assert pose_error(covariance, points) == pytest.approx(math.sqrt(np.mean(x**2 + y**2)), rel=1e-3)


def test_feature_sets_without_a_pose_in_many_images_or_with_leverage_are_not_chosen() -> None:
    trials = [trial(1e-6, refused=3 / 128), trial(math.nan), trial(1e-6, leverage=0.701), trial(1e-6, 0.7, 2 / 128)]
    assert usable_feature_sets(trials, LocationPlanLimits()) == trials[3:]
    assert usable_feature_sets(trials, LocationPlanLimits(max_leverage=1.0)) == trials[2:]
    assert usable_feature_sets(trials, LocationPlanLimits(max_refused=0.0)) == []


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"margin": 0.99}, r"LocationPlanLimits\.margin is 0\.99, expected"),
        ({"rate_margin": 0.99}, r"LocationPlanLimits\.rate_margin is 0\.99, expected"),
        ({"max_leverage": 0.0}, r"LocationPlanLimits\.max_leverage is 0\.0, expected"),
        ({"max_leverage": 1.01}, r"LocationPlanLimits\.max_leverage is 1\.01, expected"),
        ({"max_refused": 1.01}, r"LocationPlanLimits\.max_refused is 1\.01, expected"),
        ({"draws": 7}, r"LocationPlanLimits\.draws is 7, expected"),
    ],
)
def test_limits_are_checked(limits: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LocationPlanLimits(**limits)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tolerance": 0.0}, "tolerance is 0.0, expected"),
        ({"rate": -1.0}, "rate is -1.0, expected"),
        ({"latency": 0.1}, "a latency needs a rate"),
    ],
)
def test_wrong_arguments_are_refused(artwork: Artwork, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan_of(np.zeros(SHAPE, np.uint8), artwork, **options)


def test_an_image_without_the_board_is_refused(artwork: Artwork, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="no pose to plan from: "):
        plan_of(np.rint(rng.normal(90.0, NOISE, SHAPE)).astype(np.uint8), artwork)


@pytest.mark.usefixtures("few_features")
def test_a_plan_chooses_the_fastest_features_and_writes_them(
    artwork: Artwork, picture: BoardPicture, device: Device, tmp_path: Path, rng: np.random.Generator
) -> None:
    image = camera_image(picture, POSE, rng)
    free = plan_of(image, artwork, device)
    assert free.chosen == min(free.usable, key=lambda each: each.seconds)
    assert {(len(each.features.length), each.features.imaging.width_px) for each in free.trials} >= {(15, 3), (40, 5)}
    best = min(free.usable, key=lambda each: each.error)
    plan = choose_features(free.located, free.trials, tolerance=1.1001 * best.error)
    assert plan.chosen == best
    with pytest.raises(PlanError, match=r"no feature set meets an error of .* \(scatter .* um, unexplained .* um\)"):
        plan_of(image, artwork, device, tolerance=1.09 * best.error)
    plan.write(tmp_path / "out")
    assert {each.suffix for each in (tmp_path / "out").iterdir()} == {".png", ".toml", ".json"}
    features = read_features(tmp_path / "out" / "features.toml")
    np.testing.assert_allclose(features.point, best.features.point)
    located = locate_board(image, artwork, scale=PIXEL, initial_pose=EXPECTED, features=features, device=device)
    assert located.reason == ""
    assert abs(np.array(located.pose) - POSE)[:2].max() < 4.5 * plan.chosen.error
    report = json.loads(json.dumps(plan.to_dict()))
    assert report["chosen"]["rulers"] == len(best.features.length)
    assert report["chosen"]["width_px"] == best.features.imaging.width_px
    assert report["limits"]["draws"] == 128


@pytest.mark.usefixtures("few_features")
def test_a_rate_that_no_accurate_features_keep_up_with_is_refused(
    artwork: Artwork, picture: BoardPicture, device: Device, rng: np.random.Generator
) -> None:
    """The times are 0.1, 0.2, ... ms in the order of the trials, so that the accurate ones are slow."""
    image = camera_image(picture, POSE, rng)
    free = plan_of(image, artwork, device)
    best = min(free.usable, key=lambda each: each.error)
    rate, found = 1.0 / best.slow_seconds, (free.located, free.trials)
    tolerance = 1.1001 * best.error
    with pytest.raises(PlanError, match=r"fastest feature set that meets the tolerance and is too slow: .* us, a rate"):
        choose_features(*found, tolerance=tolerance, rate=rate)
    assert choose_features(*found, tolerance=tolerance, rate=0.86 * rate, latency=1.0).chosen == best
    with pytest.raises(PlanError, match=r"a latency of \d+ us allows"):
        choose_features(*found, tolerance=tolerance, rate=0.1 * rate, latency=best.slow_seconds)


@pytest.mark.usefixtures("few_features")
def test_features_whose_usual_times_keep_a_rate_are_chosen_before_faster_ones(
    artwork: Artwork, picture: BoardPicture, device: Device, rng: np.random.Generator
) -> None:
    """The set with the smallest median time has an upper quartile beyond the limit."""
    free = plan_of(camera_image(picture, POSE, rng), artwork, device)
    first, second, *others = sorted(free.usable, key=lambda each: each.error)
    trials = [
        first._replace(seconds=20.0e-6, slow_seconds=30.0e-6),
        second._replace(seconds=20.6e-6, slow_seconds=21.0e-6),
        *(each._replace(seconds=1e-3, slow_seconds=1e-3) for each in others),
    ]
    tolerance = 1.2 * second.error
    assert choose_features(free.located, trials, tolerance=tolerance).chosen == trials[0]
    assert choose_features(free.located, trials, tolerance=tolerance, rate=1.0 / 25e-6).chosen == trials[1]


@pytest.mark.slow
@pytest.mark.usefixtures("few_features")
def test_predicted_errors_are_those_of_images_with_known_poses(
    artwork: Artwork, picture: BoardPicture, device: Device, rng: np.random.Generator
) -> None:
    """Images at poses anywhere in the search range; the reference maps the points by both poses."""
    plan = plan_of(camera_image(picture, POSE, rng), artwork, device)
    poses = EXPECTED + rng.uniform(-1.0, 1.0, (48, 3)) * (SHIFT, SHIFT, ANGLE)
    images = [camera_image(picture, tuple(each), rng) for each in poses]
    points = np.concatenate([each.features.point for each in plan.trials])
    for each in plan.usable:
        bound = each.features.bind(
            device, SHAPE, np.uint8, copper="bright", threshold=plan.located.threshold, noise=plan.located.noise
        )
        squares = []
        for image, pose in zip(images, poses, strict=True):
            found = bound(image, EXPECTED)
            assert int(found.status) == 0
            true, measured = (
                BoardView(scale=PIXEL, shape=SHAPE, pose=tuple(map(float, one)))  # type: ignore[arg-type]
                for one in (pose, found.pose)
            )
            away = measured.to_plane(true.to_pixels(points)) - points
            squares.append(np.mean(np.sum(away**2, axis=1)))
        # 48 poses determine the error to about 7 %, the 128 poses of the plan to 4 %.
        assert 0.75 * each.error < math.sqrt(np.mean(squares)) < 1.25 * each.error, each.name


@pytest.mark.usefixtures("few_features")
def test_the_error_is_the_scatter_by_noise_with_unexplained_residuals_and_the_common_error(
    artwork: Artwork, picture: BoardPicture, device: Device, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """The scatter is proportional to the additional noise, wherever the rulers are."""
    image = camera_image(picture, POSE, rng).astype(np.float32)
    full, half = (plan_of(image, artwork, device, noise=noise, threshold=20.0) for noise in (NOISE, 0.5 * NOISE))
    for each, other in zip(*(sorted(plan.trials, key=lambda one: one.name) for plan in (full, half)), strict=True):
        assert other.scatter == pytest.approx(0.5 * each.scatter, rel=0.1), each.name
        assert each.error == pytest.approx(math.hypot(each.scatter, each.unexplained, 0.002 * PIXEL, 0.002 * PIXEL))
    monkeypatch.setattr(planning_location, "unexplained_scale", lambda *_: 3.0)
    worse = plan_of(image, artwork, device, noise=NOISE, threshold=20.0)
    for each in worse.usable:
        # 3 sigma of each feature move the pose by about 3 times its scatter.
        assert each.unexplained == pytest.approx(3.0 * each.scatter, rel=0.5)
        assert each.error > each.unexplained


@pytest.mark.usefixtures("few_features")
def test_a_turn_by_half_a_revolution_has_the_same_scatter(
    artwork: Artwork, picture: BoardPicture, device: Device, rng: np.random.Generator
) -> None:
    """Poses about a turn of pi lie on both sides of the jump from pi to -pi."""
    x, y, _ = POSE
    image = camera_image(picture, (x, y, 0.0), rng)
    turned = np.ascontiguousarray(image[::-1, ::-1])
    upright, over = (
        plan_of(one, artwork, device, initial_pose=(*BOARD_MIDDLE, theta))
        for one, theta in ((image, 0.0), (turned, math.pi))
    )
    found = {each.name: each.scatter for each in over.trials}
    for each in upright.usable:
        assert found[each.name] == pytest.approx(each.scatter, rel=0.3), each.name


@pytest.mark.parametrize(
    ("scale", "noisy_scale", "degrees", "expected"),
    [
        (1.0, math.sqrt(2.0), 50, 0.0),  # noise explains all of it
        (1.0, 1.0, 50, 1.0),  # noise explains nothing
        (2.0, math.sqrt(5.0), 50, math.sqrt(3.0)),
        (1.0, math.sqrt(1.72), 50, 0.0),  # 0.28 beyond 0.72; 0.29 may be chance
        (1.0, math.sqrt(1.70), 50, math.sqrt(0.30)),  # 0.28 may be chance
        (1.0, math.sqrt(1.42), 4, 0.0),
        (1.0, 1.0, 0, 0.0),
    ],
)
def test_residuals_that_may_be_chance_do_not_raise_the_error(
    scale: float, noisy_scale: float, degrees: int, expected: float
) -> None:
    """The square of the scale of 50 degrees of freedom scatters by 0.2 of itself, of 4 by 0.71."""
    scales, noisy = np.full(9, scale), np.full(9, noisy_scale)
    scales[2] = noisy[5] = np.nan
    found = planning_location.unexplained_scale(scales, noisy, degrees)
    assert found == pytest.approx(expected)
    assert planning_location.unexplained_scale(np.full(9, np.nan), noisy, degrees) == 0.0


def test_the_covariance_is_that_of_a_residual_scale_of_one() -> None:
    base = np.diag([4.0, 9.0, 16.0])
    for scale, factor in ((0.5, 1.0), (2.0, 4.0), (math.nan, 1.0)):
        found: Any = SimpleNamespace(covariance=base * factor, residual_scale=np.array(scale, np.float32))
        np.testing.assert_allclose(planning_location._covariance(found), base)


@pytest.mark.usefixtures("few_features")
def test_a_pose_elsewhere_is_no_pose(
    artwork: Artwork, picture: BoardPicture, device: Device, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator
) -> None:
    """A feature set whose pose differs from the located one by half a pixel, many standard deviations, has no error."""
    image = camera_image(picture, POSE, rng)
    found = locate_board(image, artwork, scale=PIXEL, initial_pose=EXPECTED, device=device)
    view = dataclasses.replace(found.view, pose=(found.pose[0] + 0.5 * PIXEL, *found.pose[1:]))
    monkeypatch.setattr(planning_location, "locate_board", lambda *_, **__: dataclasses.replace(found, view=view))
    with pytest.raises(PlanError, match="each has no pose in too many images with additional noise") as refusal:
        plan_of(image, artwork, device)
    assert all(math.isnan(each.error) for each in refusal.value.trials)


def test_noise_is_added_in_the_dtype_of_the_image() -> None:
    for dtype, most in ((np.uint8, 255), (np.uint16, 65535), (np.float32, np.inf)):
        grey = np.full((60, 70), 250, dtype)
        images = planning_location._with_noise(grey, PixelNoise(2.0, 0.02), 9)
        assert images.dtype == dtype
        assert images.shape == (9, 60, 70)
        assert images.max() <= most
        if most > 255:
            # 37800 values determine the deviation to 0.4 %; the rounding adds 1/12.
            rounding = 1 / 12 if dtype is np.uint16 else 0.0
            assert np.std(images.astype(np.float64)) == pytest.approx(math.sqrt(9.0 + rounding), rel=0.02)
        assert not np.array_equal(images[0], images[1])
