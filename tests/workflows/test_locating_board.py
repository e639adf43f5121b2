"""Locating a camera over boards as a library; boards and robots by the commands."""

from __future__ import annotations

import functools
import json
import math
import re
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from board_images import BoardPicture, View
from boards import BOARD_MIDDLE, LAYERS, board_folder
from fakes import list_gpu
from floors import floor_image
from gpuvision.camera.image import estimate_pixel_noise, grey_image
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.cli import main as cli
from gpuvision.cli.arguments import quantities
from gpuvision.formats.camera_file import write_lens
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device, StepDevices
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.board.edge_measurement import BoardMeasurer
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.measurement_result import MeasurementLimits
from gpuvision.matching.features.ruler import best_smoothing
from gpuvision.matching.pose.pose import BoardPose
from gpuvision.status import Status
from gpuvision.workflows import locating_board
from gpuvision.workflows.locating_board import (
    LocalizationLimits,
    _Clock,
    _ExpectedPose,
    _initial_view,
    _Job,
    _reason_of_ambiguity,
    _search_range,
    locate_board,
)
from gpuvision.workflows.locating_robot import scan_floor

PIXEL, SHAPE, NOISE = 40e-6, (300, 400), 2.0
FINE, FINE_SHAPE = 25e-6, (480, 640)  # for boards of narrow traces, and few of them
TOLD = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]
# For three Gaussian numbers, one in 1e5 boards exceeds 4.5 sigmas.
SIGMAS = 4.5


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return board_folder(tmp_path_factory.mktemp("board"))


@pytest.fixture(scope="module")
def artwork(folder: Path) -> Artwork:
    return read_artwork(folder, layers=LAYERS)


@functools.cache
def rendered_board(
    artwork: Artwork, place: tuple[float, float], turn: float, pixel: float, shape: tuple[int, int], **more: Any
) -> BoardPicture:
    """Render a board around the field of view of a camera, once for all tests with that view."""
    corner = np.array(place) + (np.array(shape[::-1]) - 1) / 2 * pixel * (-1, 1)
    view = View(corner=tuple(corner), pixel=pixel, shape=shape, noise=NOISE, **more)
    return BoardPicture(artwork, view, (0.0, 0.0, -turn), place, margin=16)


def camera_image(
    artwork: Artwork,
    pose: tuple[float, float, float],
    pixel: float = PIXEL,
    shape: tuple[int, int] = SHAPE,
    **more: Any,
) -> np.ndarray:
    """Return the uint8 image of a camera at a pose: board point at the image centre, and direction of the columns."""
    place, turn = np.round(np.array(pose[:2]) / 0.5e-3) * 0.5e-3, round(20 * pose[2]) / 20
    picture = rendered_board(artwork, tuple(place.tolist()), turn, pixel, shape, **more)
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    shift = np.array([[cos, sin], [-sin, cos]]) @ (place - pose[:2])
    image = picture.seen((*shift, turn - pose[2]), np.random.default_rng(1))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def errors_in_sigmas(located: LocatedBoard, pose: tuple[float, float, float]) -> np.ndarray:
    """Return the error of a pose in units of its sigmas."""
    return (np.array(located.pose) - pose) / located.sigmas


LIMITS = LocalizationLimits()


@pytest.mark.parametrize(
    ("given", "known", "scale", "has_features", "expected"),
    [
        ((1e-3, 0.2), True, 1e-5, True, (1e-3, 0.2)),
        ((1e-3, math.pi), False, 1e-5, False, (1e-3, math.pi)),
        (None, False, 1e-5, True, (2e-3, math.radians(5.0))),
        (None, True, 1e-5, True, (7e-5, 0.01)),
        (None, True, 2.5e-5, False, (1e-4, math.radians(0.3))),
        (None, True, 3e-5, False, (1.2e-4, math.radians(0.3))),  # 4 pixels
    ],
)
def test_search_range_of_a_board(
    given: Any, known: bool, scale: float, has_features: bool, expected: tuple[float, float]
) -> None:
    features: Any = SimpleNamespace(imaging=SimpleNamespace(shift=7e-5, angle=0.01)) if has_features else None
    assert _search_range(given, known, scale, features, LIMITS) == pytest.approx(expected)


@pytest.mark.parametrize("given", [(0.0, 0.1), (math.inf, 0.1), (1e-3, -1e-9), (1e-3, 3.15)])
def test_search_ranges_out_of_bounds(given: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"search_range is .*, expected metres above 0, and an angle of 0 to pi"):
        _search_range(given, True, 1e-5, None, LIMITS)


def test_initial_view_of_a_board() -> None:
    board: Any = SimpleNamespace(bounds=np.array([[0.0, 0.01], [0.02, 0.05]]), side="bottom")
    view = _initial_view(None, board, 3e-5, (5, 7), None)
    assert (view.pose, view.mirrored, view.scale, view.shape) == (
        pytest.approx((0.01, 0.03, 0.0)),
        True,
        3e-5,
        (5, 7),
    )
    board.side = "top"
    view = _initial_view((0.5, 0.25, 0.125), board, 3e-5, (5, 7), None)
    assert (view.pose, view.mirrored) == ((0.5, 0.25, 0.125), False)


def test_time_of_a_step_that_is_kept_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter([10.0, 11.5, 14.0, 20.0])
    monkeypatch.setattr(locating_board.time, "perf_counter", lambda: next(now))
    clock = _Clock()
    clock.record("features")
    clock.record_apart("choose device", 0.5)
    clock.record_apart("choose device", 0.25)
    clock.record("rulers")
    clock.record("support")
    assert clock.seconds == {"features": 1.5, "choose device": 0.75, "rulers": 1.75, "support": 6.0}


def job(**changes: Any) -> _Job:
    """Return a job that runs each step on the device "cpu"."""
    devices: Any = SimpleNamespace(
        choose=lambda step, run, *size: run("cpu") and "cpu",
        choices={"rulers": SimpleNamespace(device="cpu")},
        report=lambda: {"rulers": "cpu"},
    )
    artwork: Any = SimpleNamespace(side="top", warnings=("a warning",))
    values: dict[str, Any] = {
        "grey": np.zeros((5, 7), np.uint8),
        "artwork": artwork,
        "noise": 2.0,
        "threshold": 9.0,
        "blur_px": 1.25,
        "etch_bias_sigma": 8e-6,
        "devices": devices,
        "limits": LIMITS,
    }
    return _Job(**(values | changes))


def board_view(x: float, y: float, theta: float = 0.0, scale: float = 2e-5) -> BoardView:
    return BoardView(scale=scale, shape=(5, 7), pose=(x, y, theta))


@pytest.mark.parametrize(
    ("reach", "scale", "is_registered"),
    [
        ((2.5e-4, math.radians(1.0)), 2e-5, False),
        ((2.51e-4, 0.0), 2e-5, True),
        ((1e-4, math.radians(1.01)), 2e-5, True),
        ((3e-4, 0.0), 3e-5, False),  # 10 pixels
    ],
)
def test_a_large_search_range_is_registered_first(
    monkeypatch: pytest.MonkeyPatch, reach: tuple[float, float], scale: float, is_registered: bool
) -> None:
    prepared: list[Any] = []

    class Search:
        search = SimpleNamespace(point=np.zeros((4, 2)))
        rulers = SimpleNamespace(point=np.zeros((6, 2)))

        def __call__(self, image: Any, device: Any) -> Any:
            return SimpleNamespace(pose=np.ones(3), status=Status.OK, runner_up_pose=None)

    monkeypatch.setattr(
        locating_board, "prepare_board_registration", lambda *given, **how: prepared.append((given, how)) or Search()
    )
    monkeypatch.setattr(locating_board, "move_view", lambda view, pose: (view, pose))
    done, view = job(), board_view(0.1, 0.2, scale=scale)
    expected: Any = done.register(view, reach)
    if not is_registered:
        assert (expected, prepared) == (_ExpectedPose(view, reach), [])
        return
    ((given, how),) = prepared
    assert given[0] is done.artwork
    assert (how["shift"], how["angle"]) == reach
    assert (how["blur_px"], how["threshold"]) == (1.25, 9.0)
    assert expected.reach == pytest.approx((max(6e-5, 3.0 * scale), 2e-3))
    assert (expected.other, expected.reason) == (None, "")
    kept, moved = tuple(expected.view)
    assert kept is view
    np.testing.assert_array_equal(moved, np.ones(3))


@pytest.mark.parametrize("rulers", [0, 3])
@pytest.mark.parametrize("status", [Status.OK, Status.AMBIGUOUS, Status.NO_DATA])
def test_results_of_a_registration(monkeypatch: pytest.MonkeyPatch, status: Status, rulers: int) -> None:
    found = SimpleNamespace(
        pose=np.full(3, np.nan) if status == Status.NO_DATA else np.ones(3),
        status=status,
        runner_up_pose=np.zeros(3),
        score=0.375,
        rulers=rulers,
    )

    class Search:
        search = rulers = SimpleNamespace(point=np.zeros((4, 2)))

        def __call__(self, image: Any, device: Any) -> Any:
            assert device == "cpu"
            return found

    monkeypatch.setattr(locating_board, "prepare_board_registration", lambda *_, **__: Search())
    monkeypatch.setattr(locating_board, "move_view", lambda view, pose: (view, tuple(pose)))
    done, view = job(), board_view(0.1, 0.2, scale=3e-5)
    expected: Any = done.register(view, (2e-3, 0.1))
    assert expected.found is found
    assert expected.reach == pytest.approx((9e-5, 2e-3))
    if status == Status.NO_DATA:
        few = "too few straight edges are in view; give an initial pose (fiducials are enough then), or another scale"
        many = "the best candidate has 38% of its edges; is the board in view, is the scale right?"
        assert expected.reason == f"the coarse registration found no pose of the board: {many if rulers else few}"
        assert (expected.view, expected.other) == (view, None)
    else:
        assert (expected.view, expected.reason) == ((view, (1.0, 1.0, 1.0)), "")
        assert expected.other == ((view, (0.0, 0.0, 0.0)) if status == Status.AMBIGUOUS else None)
    assert {"prepare registration", "registration", "choose device"} <= set(done.clock.seconds)


@pytest.mark.parametrize(
    ("preference", "distance", "bright", "found_at", "words"),
    [
        (3.1, 1e-3, True, 0.0, ""),
        (3.0, 1e-3, True, 0.0, ""),  # undecided; only the found pose lies in the range
        (
            -3.1,
            1e-3,
            True,
            0.0,
            "fits better 1.00 mm away (x 1.00 mm, y 0.00 mm), with bright copper; check the initial",
        ),
        (-3.0, 1e-3, True, 0.0, ""),
        (0.0, 1e-4, True, 0.0, "fits as well 0.10 mm away (x 0.10 mm, y 0.00 mm), with bright copper; show the end"),
        (0.0, 1e-4, False, 0.0, ""),  # the given polarity decides
        (3.0, 1e-4, True, 0.0, "fits as well 0.10 mm away"),  # 3 standard deviations do not decide
        (-3.0, 1e-4, True, 0.0, "fits as well 0.10 mm away"),
        (0.0, 2e-4, True, 0.0, "fits as well 0.20 mm away"),  # both poses at the end of the range
        (0.0, 1e-3, True, 2e-4, ""),
        (0.0, 1e-3, True, 2.01e-4, "fits as well 1.00 mm away"),
        (0.0, 1e-3, False, 3e-4, "fits as well 1.00 mm away (x 1.00 mm, y 0.00 mm), with dark copper; show the end"),
    ],
)
def test_support_of_a_pose_by_the_image(
    monkeypatch: pytest.MonkeyPatch, preference: float, distance: float, bright: bool, found_at: float, words: str
) -> None:
    """The search range is 0.2 mm; the second pose lies at x = distance, y = 0, the expected one at 0."""
    asked: list[Any] = []
    other = SimpleNamespace(preference=preference, view=board_view(distance, 0.0), distance=distance, is_bright=bright)
    monkeypatch.setattr(
        locating_board, "find_other_pose", lambda *given, **how: asked.append((given[1:], how)) or other
    )
    done, found = job(), board_view(0.0, found_at)
    text = done._test_support(board_view(0.0, 0.0), found, "bright", 2e-4)
    assert words in text
    assert bool(words) == bool(text)
    assert asked == [((done.artwork, found, 4.0 * 2e-4, 1.25), {"is_bright": True})]
    monkeypatch.setattr(locating_board, "find_other_pose", lambda *_, **__: None)
    assert done._test_support(board_view(0.0, 0.0), found, "dark", 2e-4) == ""


class Measured(NamedTuple):
    """Result of the measurement of one polarity of copper."""

    reason: str
    agreeing: int
    view: str


@pytest.mark.parametrize(
    ("copper", "measured", "kind", "reason"),
    [
        ("auto", {"bright": ("", 9), "dark": ("", 8)}, "bright", "supported"),
        ("auto", {"bright": ("", 8), "dark": ("", 9)}, "dark", "supported"),
        ("auto", {"bright": ("", 8), "dark": ("", 8)}, "bright", "supported"),
        ("auto", {"bright": ("few", 9), "dark": ("", 2)}, "dark", "supported"),  # a refused pose does not count
        ("auto", {"bright": ("few", 2), "dark": ("none", 3)}, "dark", "none"),
        ("dark", {"bright": ("", 9), "dark": ("", 2)}, "dark", "supported"),
        ("dark", {"bright": ("", 9), "dark": ("few", 2)}, "dark", "few"),
    ],
)
def test_the_polarity_with_more_agreeing_rulers(
    copper: Any, measured: Any, kind: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    locate_with(monkeypatch, measured, copper, kind=kind, why=reason)


@pytest.mark.parametrize(
    ("changes", "copper", "reason"),
    [
        ({"reason": "not registered"}, "auto", "not registered"),
        ({"smoothing": 0.0}, "auto", "the edges are too dense to tell whether copper is bright or dark"),
        ({"smoothing": 0.0}, "bright", "supported"),
        ({"other": "other view"}, "auto", "ambiguous: first view 9, other view 4, 0.6"),
        ({"other": "other view", "reason": "not registered"}, "auto", "not registered"),
    ],
)
def test_reasons_against_a_pose_in_their_order(
    changes: Any, copper: Any, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The support by the image is asked last, and only where nothing else is against the pose."""
    locate_with(monkeypatch, {"bright": ("", 9), "dark": ("", 1)}, copper, kind="bright", why=reason, **changes)


def locate_with(
    monkeypatch: pytest.MonkeyPatch,
    measured: dict[str, tuple[str, int]],
    copper: Any,
    *,
    kind: str,
    why: str,
    smoothing: float | None = None,
    **changes: Any,
) -> None:
    """Locate a board with these measurements, and compare the polarity and the reason."""
    calls: list[Any] = []

    class Measurer:
        def __init__(self, *given: Any) -> None:
            assert given[1:] == (features, 2.0, 9.0, 1.25, 8e-6, "cpu")

        def measure(self, view: str, each: str) -> Measured:
            if view == "other view":
                assert each == kind
                return Measured("", 4, view)
            return Measured(*measured[each], f"{each} {view}")

    best = best_smoothing(1.25)
    imaging = SimpleNamespace(width_px=5.0, blur_px=1.25, shift=3e-4, smoothing_px=best if smoothing is None else 0.0)
    features: Any = SimpleNamespace(
        length=np.array([1e-4, 3e-4]),
        spacing=np.array([0.0, 2e-5]),
        fiducials=SimpleNamespace(radius=np.zeros(3)),
        imaging=imaging,
    )
    monkeypatch.setattr(locating_board, "BoardMeasurer", Measurer)
    monkeypatch.setattr(
        locating_board,
        "_reason_of_ambiguity",
        lambda expected, found, other, share: f"ambiguous: first view {found.agreeing}, {other.view} 4, {share}",
    )
    monkeypatch.setattr(_Job, "_test_support", lambda self, *given: calls.append(given) or "supported")
    monkeypatch.setattr(_Job, "_result", lambda self, *given: given)
    sizes: list[Any] = []
    devices: Any = SimpleNamespace(choose=lambda step, run, *size: sizes.append((step, size[2:])) or "cpu")
    done: Any = job(devices=devices)
    view: Any = FirstView("first view")
    at: Any = _ExpectedPose(view, (1e-3, 0.1), found="registration", **changes)  # type: ignore[arg-type]
    found: Any = done.locate(at, features, copper)
    measurement, chosen, given, registration, reason = found
    assert (chosen, given, registration) == (kind, features, "registration")
    assert measurement.view == f"{kind} first view"
    assert reason.startswith(why)
    expected = [(view, f"{kind} first view", kind, 3e-4)]
    assert calls == (expected if why == "supported" else [])
    # Two rulers of 20 px together, pairs 1 px apart, three fiducials.
    ((step, size),) = sizes
    assert (step, size) == ("rulers", pytest.approx((2.0, 3.0, 20.0, 1.0, 5.0)))
    assert {"rulers", "support"} & set(done.clock.seconds) == ({"rulers", "support"} if calls else {"rulers"})


class FirstView(str):
    """Name of the expected view, which has the size of a pixel."""

    scale = 2e-5


def test_covariance_at_the_image_centre(monkeypatch: pytest.MonkeyPatch) -> None:
    """The camera moves against the board; a turn about the placement point moves the centre, 3 and -2 mm away."""
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, -0.25], [0.5, -0.25, 16.0]]) * 1e-12
    solution = SimpleNamespace(
        covariance=covariance,
        warnings=("another",),
        **dict.fromkeys(("rulers", "fiducials", "etch_bias", "residual_scale", "condition", "scale_error")),
    )
    view = board_view(0.013, 0.018)
    measurement: Any = SimpleNamespace(view=view, solution=solution)
    features: Any = SimpleNamespace(placement=np.array([0.010, 0.020]))
    done = job()
    located = done._result(measurement, "bright", features, None, "")
    # A turn t about the placement point moves a point at (3, -2) mm from it by t (2, 3) mm.
    motion = np.array([[-1.0, 0.0, -2e-3], [0.0, -1.0, -3e-3], [0.0, 0.0, -1.0]])
    np.testing.assert_allclose(located.covariance, motion @ covariance @ motion.T, rtol=1e-12)
    np.testing.assert_array_equal(located.placement_covariance, covariance)
    np.testing.assert_allclose(located.placement_px, view.to_measured_pixels(features.placement))
    assert (located.noise, located.threshold, located.copper) == (2.0, 9.0, "bright")
    assert located.warnings == ("a warning", "another")
    assert (located.device, located.steps) == ("cpu", {"rulers": "cpu"})
    refused = done._result(measurement, "dark", features, None, "too few")
    assert np.isnan(refused.covariance).all()
    assert np.isnan(refused.placement_covariance).all()
    assert (refused.reason, refused.copper) == ("too few", "dark")


def test_a_view_s_places_and_pixels_are_each_other_s() -> None:
    lens = Lens(k1=1e-8, centre=(300.0, 200.0))
    for mirrored in (False, True):
        view = BoardView(scale=PIXEL, shape=SHAPE, pose=(3e-3, -2e-3, 2.5), mirrored=mirrored, model=lens)
        pixels = np.array([[0.0, 0.0], [399.0, 299.0], [100.5, 7.25]])
        np.testing.assert_allclose(view.to_pixels(view.to_plane(pixels)), pixels, atol=1e-9)
        np.testing.assert_allclose(view.to_plane(view.centre_px), (3e-3, -2e-3), atol=1e-12)
        ahead = view.to_plane(view.centre_px + np.array([-1.0 if mirrored else 1.0, 0.0])) - view.pose[:2]
        assert math.atan2(ahead[1], ahead[0]) == pytest.approx(2.5)
        up = view.to_plane(view.centre_px - (0.0, 1.0)) - view.pose[:2]
        assert math.atan2(up[1], up[0]) == pytest.approx(2.5 + math.pi / 2 - 2 * math.pi)
        np.testing.assert_allclose(lens.undistort(view.to_measured_pixels(view.to_plane(pixels))), pixels, atol=1e-6)


def test_noise_is_that_of_the_image(rng: np.random.Generator) -> None:
    steps = np.repeat(np.repeat(rng.uniform(0, 200, (12, 16)), 40, axis=0), 40, axis=1)
    # The median of 3e5 values is accurate to 0.2 %; they are correlated, and a tenth of them lie on a step.
    assert estimate_pixel_noise(steps + rng.normal(0, 3.0, steps.shape)) == pytest.approx(3.0, rel=0.15)
    assert estimate_pixel_noise(np.zeros((40, 40), np.uint8)) == 0.0


@pytest.mark.parametrize("turned", [0.0, pytest.param(math.pi / 2, marks=pytest.mark.slow), -2.2])
def test_a_camera_is_located_where_it_is(artwork: Artwork, turned: float, device: Device) -> None:
    pose = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, turned + 2e-3)
    located = locate_board(
        camera_image(artwork, pose), artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, turned), device=device
    )
    assert located.reason == ""
    assert located.copper == "bright"
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS
    assert np.all(located.sigmas[:2] < 0.05 * PIXEL)
    assert located.rulers.used.sum() >= 0.9 * located.rulers.in_image.sum()
    assert located.noise == pytest.approx(NOISE, rel=0.1)


def test_edges_that_agree_exactly_are_refused(artwork: Artwork, monkeypatch: pytest.MonkeyPatch) -> None:
    """A covariance of 0 from residuals of 0 is no covariance."""
    fit = BoardMeasurer._fit

    def exact(*of: Any) -> BoardPose:
        found = fit(*of)
        return found._replace(residual_scale=np.zeros(()), covariance=np.zeros_like(found.covariance))

    monkeypatch.setattr(BoardMeasurer, "_fit", exact)
    pose = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, 2e-3)
    located = locate_board(camera_image(artwork, pose), artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0))
    assert "all edges agree exactly" in located.reason


@pytest.mark.parametrize(
    ("wrong", "is_refused"),
    [(1.005, True), (0.999, False), *(pytest.param(each, False, marks=pytest.mark.slow) for each in (0.9978, 1.001))],
)
def test_a_wrong_scale_is_said(artwork: Artwork, wrong: float, is_refused: bool) -> None:
    """More edges lie on one side of the placement point: without the test 0.1 % moves the pose by 5 sigmas."""
    pose = (BOARD_MIDDLE[0] - 1.5e-3, BOARD_MIDDLE[1] + 1e-3, 1e-3)
    located = locate_board(camera_image(artwork, pose), artwork, scale=wrong * PIXEL, initial_pose=(*pose[:2], 0.0))
    assert abs(located.scale_error.value - (wrong - 1)) < SIGMAS * located.scale_error.sigma < 0.0003
    assert bool(located.reason) == is_refused
    message = located.reason if is_refused else located.warnings[0]
    proposed = float(re.findall(r"is the scale ([0-9.]+) um, not", message)[0])
    assert proposed == pytest.approx(1e6 * PIXEL, rel=SIGMAS * located.scale_error.sigma)
    if not is_refused:
        assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS


def test_a_wrong_scale_beyond_the_tolerance_of_boards_is_refused(artwork: Artwork, device: Device) -> None:
    pose, wrong = (BOARD_MIDDLE[0] - 1.5e-3, BOARD_MIDDLE[1] + 1e-3, 1e-3), 0.999 * PIXEL
    image = camera_image(artwork, pose)
    located = locate_board(image, artwork, scale=wrong, initial_pose=(*pose[:2], 0.0), device=device)
    view = BoardView(scale=wrong, shape=SHAPE, pose=(*pose[:2], 0.0))
    how: tuple[Any, ...] = (image, located.features, located.noise, located.threshold, 1.0, 10e-6, device)
    accepted, refused = (
        BoardMeasurer(*how, MeasurementLimits(max_board_scale=each)).measure(view, "bright") for each in (2e-3, 5e-4)
    )
    assert accepted.reason == ""
    assert re.match(
        r"a wrong scale moves the pose by [4-7]\.\d standard deviations: the board is -0\.1", refused.reason
    )


def dense_board(folder: Path, count: int = 20) -> Artwork:
    """Return a board of traces 0.2 mm wide and apart, ``count`` level ones left, as many upright right."""
    head = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n%ADD10C,0.2*%\nD10*\n"
    level = [f"X0Y{400000 * k}D02*\nX9000000Y{400000 * k}D01*\n" for k in range(count)]
    end = 400000 * count
    upright = [f"X{10000000 + 400000 * k}Y0D02*\nX{10000000 + 400000 * k}Y{end}D01*\n" for k in range(count)]
    (folder / "copper.gbr").write_text(head + "".join(level + upright) + "M02*\n")
    return read_artwork(folder, layers={r"copper\.gbr": "top copper"})


def test_a_dense_board_is_located_with_less_smoothing(tmp_path: Path) -> None:
    """At 35 um per pixel the neighbours are 5.7 px away: too near for the best smoothing, which needs 6.7 px."""
    dense, pose = dense_board(tmp_path), (9.53e-3, 3.97e-3, 1e-3)
    image = camera_image(dense, pose, 35e-6)
    located = locate_board(image, dense, scale=35e-6, initial_pose=(9.5e-3, 4e-3, 0.0), copper="bright")
    assert located.reason == ""
    assert located.features.imaging.smoothing_ratio == 1.0
    error = np.array(located.view.pose) - pose
    assert np.all(np.abs(error) < SIGMAS * np.sqrt(np.diag(located.covariance)))
    assert np.hypot(*error[:2]) < 0.02 * 35e-6


def test_dense_copper_may_be_bright_or_dark(tmp_path: Path) -> None:
    """Half a pitch away (0.2 mm along x and y) the other polarity fits as well: no pose, instead of the wrong one."""
    dense = dense_board(tmp_path)
    image = camera_image(dense, (9.53e-3, 3.97e-3, 1e-3), 45e-6)
    located = locate_board(image, dense, scale=45e-6, initial_pose=(9.5e-3, 4e-3, 0.0))
    assert located.reason.startswith("the edges are too dense to tell whether copper is bright or dark")
    assert np.all(np.isnan(located.covariance))


@pytest.mark.slow
def test_copper_that_repeats_is_not_mistaken_by_half_a_pitch(tmp_path: Path) -> None:
    """56 of 60 rulers find edges 0.2 mm off with the wrong polarity of copper, and 0.4 mm off with the right one."""
    dense = dense_board(tmp_path)
    image = camera_image(dense, (9.53e-3, 3.97e-3, 1e-3), 35e-6)
    half = locate_board(image, dense, scale=35e-6, initial_pose=(9.4e-3, 4.1e-3, 0.0), copper="dark")
    assert half.rulers.used.mean() > 0.9
    better = "the copper in the image fits better "
    assert half.reason.startswith(better + "0.30 mm away (x 9.54 mm, y 3.96 mm), with bright copper")
    assert np.all(np.isnan(half.covariance))
    pitch = locate_board(image, dense, scale=35e-6, initial_pose=(9.13e-3, 4.37e-3, 0.0), copper="bright")
    assert pitch.rulers.used.mean() > 0.9
    assert re.match(better + r"0.5\d mm away \(x 9.5\d mm, y 3.9\d mm\)", pitch.reason)


def test_the_search_range_decides_where_no_end_of_the_copper_is_in_view(tmp_path: Path) -> None:
    """Inside a repetition poses a pitch apart look the same: one is accepted within the search range, none beyond."""
    dense, pose = dense_board(tmp_path, 60), (9.53e-3, 11.97e-3, 1e-3)
    image = camera_image(dense, pose, 35e-6, (128, 160))
    near = locate_board(image, dense, scale=35e-6, initial_pose=(9.5e-3, 12e-3, 0.0), copper="bright")
    assert near.reason == ""
    between, reach = (9.5e-3, 12.17e-3, 0.0), (0.13e-3, 5e-3)  # 0.2 mm from two poses
    far = locate_board(image, dense, scale=35e-6, initial_pose=between, search_range=reach, copper="bright")
    assert "the copper in the image fits as well 0.38 mm away" in far.reason


@pytest.mark.slow
def test_a_dense_board_names_a_pixel_that_would_do(tmp_path: Path) -> None:
    """Traces 0.2 mm wide and apart: at 60 um per pixel no edge has room, at the proposed pixel rulers have."""
    dense = dense_board(tmp_path, 10)
    image = np.zeros(SHAPE, np.uint8)
    with pytest.raises(
        ValueError, match=r"without another edge on both sides at 60 um per pixel; at [0-9.]+ um"
    ) as error:
        locate_board(image, dense, scale=60e-6, initial_pose=(9e-3, 2e-3, 0.0))
    pixel = 1e-6 * float(re.findall(r"per pixel; at ([0-9.]+) um", str(error.value))[0])
    assert pixel < 60e-6
    located = locate_board(image, dense, scale=pixel, initial_pose=(9.5e-3, 2e-3, 0.0), search_range=(120e-6, 5e-3))
    assert len(located.features.length) >= 3


def test_the_right_scale_has_no_warning(artwork: Artwork) -> None:
    pose = (BOARD_MIDDLE[0] - 1.5e-3, BOARD_MIDDLE[1] + 1e-3, 1e-3)
    right = locate_board(camera_image(artwork, pose), artwork, scale=PIXEL, initial_pose=(*pose[:2], 0.0))
    assert right.reason == ""
    assert right.warnings == ()
    assert abs(right.scale_error.value) < SIGMAS * right.scale_error.sigma
    assert right.report()["scale_error"] == right.scale_error._asdict()


def test_the_placement_point_is_where_it_is_seen(artwork: Artwork) -> None:
    pose = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, 3e-3)
    located = locate_board(camera_image(artwork, pose), artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0))
    true = BoardView(scale=PIXEL, shape=SHAPE, pose=pose).to_pixels(located.placement)
    sigmas = np.sqrt(np.diag(located.placement_covariance))[:2] / PIXEL
    assert np.abs((located.placement_px - true) / sigmas).max() < SIGMAS


@pytest.mark.parametrize("etch_bias", [-12e-6, 9e-6])
def test_etching_is_solved_for(artwork: Artwork, etch_bias: float) -> None:
    pose = (BOARD_MIDDLE[0] - 30e-6, BOARD_MIDDLE[1], -2e-3)
    located = locate_board(
        camera_image(artwork, pose, etch_bias=etch_bias),
        artwork,
        scale=PIXEL,
        initial_pose=(*BOARD_MIDDLE, 0.0),
        budget=120,
    )
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS
    # Edges are rendered to 0.01 px with a common error, and 40 edges are measured to 0.03 px.
    assert np.sum(located.features.spacing == 0) > 20
    assert located.etch_bias == pytest.approx(etch_bias, abs=0.04 * PIXEL)


def test_dark_copper_is_told_from_bright(artwork: Artwork) -> None:
    pose = (BOARD_MIDDLE[0] + 20e-6, BOARD_MIDDLE[1] + 35e-6, 1e-3)
    inverted = (110.0, 60.0, 200.0, 90.0, 240.0, 15.0)
    located = locate_board(
        camera_image(artwork, pose, levels=inverted), artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0)
    )
    assert located.copper == "dark"
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS


@pytest.mark.slow
def test_a_lens_is_undone(artwork: Artwork) -> None:
    pose = (BOARD_MIDDLE[0] + 30e-6, BOARD_MIDDLE[1] - 25e-6, -1e-3)
    lens = Lens(k1=2e-7, centre=(200.0, 147.0))
    straight = camera_image(artwork, pose).astype(np.float32)
    columns, rows = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    at = lens.undistort(np.stack([columns, rows], axis=-1)).astype(np.float32)
    bent = cv2.remap(straight, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    initial_pose = (*BOARD_MIDDLE, 0.0)
    # The image is resampled from noisy pixels; cubic interpolation preserves the noise to some percent.
    located = locate_board(bent, artwork, scale=PIXEL, initial_pose=initial_pose, model=lens)
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS + 1.0
    bare = locate_board(bent, artwork, scale=PIXEL, initial_pose=initial_pose)
    # 2e-7 px^-2 moves the corners by 5 px.
    assert bare.reason or np.abs(np.array(bare.pose) - pose).max() > 10 * np.abs(np.array(located.pose) - pose).max()


def test_a_board_is_searched_where_it_is_not_known(artwork: Artwork, device: Device) -> None:
    pose = (BOARD_MIDDLE[0] + 1.3e-3, BOARD_MIDDLE[1] - 0.9e-3, 0.05)
    located = locate_board(
        camera_image(artwork, pose), artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0), search_range=(2e-3, 0.09)
    )
    assert located.coarse_registration is not None
    assert located.reason == ""
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS


def test_each_step_runs_on_its_fastest_device(
    artwork: Artwork, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report names device and costs of each step; the result does not depend on the choice."""
    costs = {("registration", "gpu"): 1e-3, ("registration", device.label): 2e-3}
    costs |= {("rulers", "gpu"): 3e-3, ("rulers", device.label): 1e-4}
    image = camera_image(artwork, (BOARD_MIDDLE[0] + 1.3e-3, BOARD_MIDDLE[1] - 0.9e-3, 0.05))
    how: dict[str, Any] = {"scale": PIXEL, "initial_pose": (*BOARD_MIDDLE, 0.0), "search_range": (2e-3, 0.09)}
    alone = locate_board(image, artwork, **how, device=device)
    assert alone.report()["steps"]["rulers"] == {"device": device.label, "seconds": {}, "unusable": {}}
    list_gpu(device, costs, monkeypatch)
    choose = StepDevices.choose

    sizes: dict[str, Any] = {}

    def slow_choice(self: StepDevices, step: str, run: Any, *size: Any) -> Device:
        time.sleep(0.1)
        sizes[step] = size
        return choose(self, step, run, *size)

    monkeypatch.setattr(StepDevices, "choose", slow_choice)
    begun = time.perf_counter()
    located = locate_board(image, artwork, **how)
    spent = time.perf_counter() - begun
    apart = located.seconds["choose device"]
    assert apart > 0.2  # two steps
    assert sizes["registration"][2:4] == (2e-3 / PIXEL, 0.09)  # the same range takes more time on small pixels
    assert sizes["rulers"][2] == len(located.features.length)
    assert sizes["rulers"][4] == np.sum(located.features.length) / PIXEL
    assert sum(located.seconds.values()) <= spent
    assert located.device is device
    assert (located.reason, located.pose) == ("", alone.pose)
    chosen = {"registration": "gpu", "rulers": device.label}
    assert located.report()["steps"] == {
        step: {
            "device": label,
            "seconds": {"gpu": costs[step, "gpu"], device.label: costs[step, device.label]},
            "unusable": {},
        }
        for step, label in chosen.items()
    }


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.full(SHAPE, 90, np.uint8), "0 of .* rulers found an edge"),
        (np.random.default_rng(3).integers(0, 255, SHAPE).astype(np.uint8), "rulers"),
    ],
)
def test_what_shows_no_board_is_refused(artwork: Artwork, image: np.ndarray, words: str) -> None:
    located = locate_board(image, artwork, scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0))
    assert re.search(words, located.reason)
    assert np.isnan(located.pose).all()
    json.dumps(located.report(), allow_nan=False)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"initial_pose": (0.5, 0.5, 0.0)}, "0 edges of the top artwork in view"),
        ({"scale": 0.0}, r"BoardView.scale \[m/px\] is 0.0, expected a number > 0"),
        ({"copper": "green"}, "expected one of auto, bright, dark"),
        ({"search_range": (-1e-3, 0.0)}, "expected metres above 0"),
        ({"initial_pose": (math.nan, 0.0, 0.0)}, r"x \[m\], y \[m\], theta \[rad\]\) has a number that is not finite"),
    ],
)
def test_a_wrong_parameter_is_told(artwork: Artwork, change: dict[str, Any], words: str) -> None:
    usual: dict[str, Any] = {"scale": PIXEL, "initial_pose": (*BOARD_MIDDLE, 0.0)}
    with pytest.raises(ValueError, match=words):
        locate_board(np.zeros(SHAPE, np.uint8), artwork, **{**usual, **change})


def test_an_ambiguous_place_names_both_places_in_millimetres() -> None:
    first, second = (BoardView(scale=PIXEL, shape=SHAPE, pose=pose) for pose in ((0.0123, 0.0345, 0), (-0.002, 1.5, 0)))
    expected = SimpleNamespace(view=first)
    best, other = SimpleNamespace(agreeing=20), SimpleNamespace(agreeing=15, reason="", view=second)
    words = _reason_of_ambiguity(expected, best, other, 0.7)
    assert words.startswith("the board may be at x 12.30 mm, y 34.50 mm or x -2.00 mm, y 1500.00 mm: 20 and 15 rulers")
    assert _reason_of_ambiguity(expected, best, other, 0.75) == ""
    assert _reason_of_ambiguity(expected, best, SimpleNamespace(agreeing=15, reason="few"), 0.7) == ""


def test_images_are_made_grey_or_refused() -> None:
    colour = np.zeros((20, 30, 3), np.uint8)
    colour[..., 1] = 100
    assert grey_image(colour).shape == (20, 30)
    assert grey_image(np.dstack([colour, colour[..., :1]])).dtype == np.uint8
    for wrong in (np.zeros((20, 30), np.int32), np.zeros((4, 30), np.uint8), np.zeros((20, 30, 2), np.uint8)):
        with pytest.raises((TypeError, ValueError), match="expected"):
            grey_image(wrong)


Locate = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Locate:
    def call(*arguments: object, command: str = "locate") -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["gpuvision", command, *map(str, arguments)])
        code = 0
        try:
            cli.main()
        except SystemExit as end:
            code = int(end.code or 0)
        output = capfd.readouterr()
        return code, output.out, output.err

    return call


POSE_KEYS = {
    "gpuvision", "status", "reason", "warnings", "side", "pose", "sigmas", "covariance", "placement",
    "predicted_covariance", "etch_bias", "residual_scale", "condition", "scale", "scale_error", "copper", "noise",
    "threshold", "coarse_registration", "counts", "rulers", "fiducials", "device", "steps", "seconds",
}  # fmt: skip
COUNT_KEYS = {"in_image", "found", "used", "fiducials_in_image", "fiducials_found", "fiducials_used"}
RULER_KEYS = {"point", "image_px", "found", "weight", "residual", "sigma", "status"}
FIDUCIAL_KEYS = {"point", "image_px", "found", "weight", "residual", "sigmas", "radius", "status"}


def test_the_threshold_is_given_or_from_noise_and_range(artwork: Artwork) -> None:
    """Four times the noise, a twentieth of the range between the percentiles 1 and 99; not below a millionth."""
    image = np.full(SHAPE, 40, np.uint8)
    image[:, 200:] = 200
    image[0, :9] = (0, 0, 0, 0, 255, 255, 255, 255, 255)  # fewer than one in a hundred
    how: dict[str, Any] = {"scale": PIXEL, "initial_pose": (*BOARD_MIDDLE, 0.0), "budget": 10}
    for given, expected in (
        ({"noise": 1.0}, 8.0),
        ({"noise": 3.0}, 12.0),
        ({"noise": 3.0, "threshold": 5.5}, 5.5),
    ):
        located = locate_board(image, artwork, **how, **given)
        assert (located.threshold, located.noise) == (pytest.approx(expected), given["noise"])
        assert located.report()["threshold"] == pytest.approx(expected)
    flat = locate_board(np.full(SHAPE, 90, np.uint8), artwork, **how)
    assert (flat.threshold, flat.noise) == (1e-6, 0.0)


@pytest.mark.rendered
def test_the_command_writes_pose_and_picture(folder: Path, artwork: Artwork, tmp_path: Path, run: Locate) -> None:
    pose = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, 2e-3)
    cv2.imwrite(str(tmp_path / "board.png"), camera_image(artwork, pose))
    initial_pose = ",".join(f"{1e3 * each}mm" for each in BOARD_MIDDLE) + ",0deg"
    files = ("--out", tmp_path / "out", "--json", tmp_path / "pose.json")
    code, out, _ = run(
        tmp_path / "board.png", "--board", folder, *TOLD, "--scale", "40um", f"--initial-pose={initial_pose}", *files
    )
    assert code == 0
    assert "rulers agree" in out
    report = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert report == json.loads((tmp_path / "pose.json").read_text())
    assert report["status"] == "located"
    for name, true in zip(("x", "y", "theta"), pose, strict=True):
        assert abs(report["pose"][name] - true) < SIGMAS * report["sigmas"][name]
    assert len(report["rulers"]) >= report["counts"]["used"]
    assert (set(report), set(report["counts"])) == (POSE_KEYS, COUNT_KEYS)
    assert set(report["placement"]) == {"board", "image_px", "covariance"}
    assert set(report["device"]) == {"label", "name", "driver"}
    assert report["rulers"]
    for ruler in report["rulers"]:
        assert set(ruler) == RULER_KEYS
    for fiducial in report["fiducials"]:
        assert set(fiducial) == FIDUCIAL_KEYS
    assert (report["side"], report["reason"], report["copper"]) == ("top", None, "bright")
    assert report["scale"] == pytest.approx(PIXEL)
    assert report["noise"] == pytest.approx(NOISE, rel=0.1)
    assert report["threshold"] >= 4.0 * report["noise"]
    np.testing.assert_allclose(list(report["sigmas"].values()), np.sqrt(np.diag(report["covariance"])), rtol=1e-12)
    for found, name in (("found", "found"), ("weight", "used")):
        assert sum(bool(ruler[found]) for ruler in report["rulers"]) == report["counts"][name]
    picture = cv2.imread(str(tmp_path / "out" / "located.png"))
    assert picture.shape[0] > SHAPE[0]


def test_a_refused_pose_is_an_error_with_a_picture(folder: Path, tmp_path: Path, run: Locate) -> None:
    cv2.imwrite(str(tmp_path / "board.png"), np.full(SHAPE, 77, np.uint8))
    initial_pose = ",".join(str(each) for each in BOARD_MIDDLE) + ",0"
    arguments = ("--scale", "40um", f"--initial-pose={initial_pose}", "--out", tmp_path / "out")
    code, out, err = run(tmp_path / "board.png", "--board", folder, *TOLD, *arguments)
    assert (code, out) == (1, "")
    assert err.count("\n") == 1
    assert "no pose: 0 of" in err
    assert (tmp_path / "out" / "located.png").exists()
    report = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert (report["status"], report["pose"]["x"]) == ("refused", None)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--board", "{board}"), "--scale is missing"),
        (("--board", "{board}", "--scale", "25furlongs"), "--scale is '25furlongs'"),
        (("--board", "{board}", "--scale", "25um", "--initial-pose", "1,2"), "expected 3 numbers"),
        (("--board", "nowhere", "--scale", "25um"), "nowhere"),
        (("--board", "{board}", "--scale", "25um"), "name its files with layers"),
        (
            ("--board", "{board}", "--scale", "25um", "--layers", "copper"),
            "expected a file name or pattern and a layer",
        ),
        (("--board", "{board}", "--scale", "25um", "--features", "nowhere.toml"), "nowhere.toml"),
    ],
)
def test_the_command_says_what_is_wrong(
    folder: Path, tmp_path: Path, run: Locate, arguments: tuple[str, ...], words: str
) -> None:
    cv2.imwrite(str(tmp_path / "board.png"), np.full(SHAPE, 77, np.uint8))
    code, out, err = run(tmp_path / "board.png", *(each.format(board=folder) for each in arguments))
    assert (code, out) == (1, "")
    assert err.startswith("gpuvision: ")
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--field", "robocup_msl"), "--scale is missing"),
        (("--field", "robocup_msl", "--scale", "1m"), "is the scale right"),
        (("--field", "nowhere"), "nowhere"),
    ],
)
def test_the_robot_command_says_what_is_wrong(
    tmp_path: Path, run: Locate, arguments: tuple[str, ...], words: str
) -> None:
    cv2.imwrite(str(tmp_path / "floor.png"), np.full(SHAPE, 77, np.uint8))
    code, out, err = run(tmp_path / "floor.png", *arguments, command="locate-robot")
    assert (code, out) == (1, "")
    assert err.startswith("gpuvision: ")
    assert err.count("\n") == 1
    assert words in err


@pytest.mark.parametrize(
    ("command", "option", "value"),
    [("locate", "--field", "robocup_msl"), ("locate-robot", "--board", "gerbers"), ("locate-robot", "--budget", "60")],
)
def test_options_of_the_other_command_are_unknown(
    tmp_path: Path, run: Locate, command: str, option: str, value: str
) -> None:
    code, out, err = run(tmp_path / "image.png", option, value, command=command)
    assert (code, out) == (2, "")
    assert f"No such option: {option}" in err


def test_board_and_field_are_required(tmp_path: Path, run: Locate) -> None:
    for command, option in (("locate", "--board"), ("locate-robot", "--field")):
        code, _, err = run(tmp_path / "image.png", command=command)
        assert code == 2
        assert option in err


def test_quantities_have_units() -> None:
    assert quantities("25um", "--scale", "m") == pytest.approx((25e-6,))
    assert quantities("1e-3, -2mm,90deg", "--initial-pose", "m,m,rad") == pytest.approx((1e-3, -2e-3, math.pi / 2))
    for wrong in ("", "1", "1,2,3,4", "1,2,3mm", "nan,1,2", "1,2,inf"):
        with pytest.raises(ValueError, match="expected 3 numbers"):
            quantities(wrong, "--initial-pose", "m,m,rad")


def test_a_camera_file_of_another_image_size_is_refused(tmp_path: Path, run: Locate) -> None:
    """The model of 4000 x 3000 pixels would move points of a smaller image by the wrong amount."""
    camera = tmp_path / "camera.toml"
    write_lens(camera, Lens(k1=1e-9, centre=(2000.0, 1500.0)), {"image": {"size": [4000, 3000]}})
    cv2.imwrite(str(tmp_path / "image.png"), np.zeros((80, 128), np.uint8))
    for command, described in (("locate", ("--board", tmp_path)), ("locate-robot", ("--field", "robocup_msl"))):
        options = (*described, "--scale", "1cm", "--camera", camera)
        code, out, err = run(tmp_path / "image.png", *options, command=command)
        assert (code, out) == (1, "")
        assert "image.png: 128 x 80 pixels, the model was calibrated at 4000 x 3000" in err.replace("\n", "")


@pytest.mark.parametrize("name", ["points.csv", "points.npy"])
def test_a_file_without_a_finite_point_is_named(tmp_path: Path, run: Locate, name: str) -> None:
    points = np.full((9, 2), np.nan)
    np.savetxt(tmp_path / name, points, delimiter=",") if name.endswith("csv") else np.save(tmp_path / name, points)
    code, out, err = run(tmp_path / name, "--field", "robocup_msl", command="locate-robot")
    assert (code, out) == (1, "")
    assert f"{name}: none of the 9 points is finite" in err.replace("\n", "")


def test_points_of_any_camera_will_do(tmp_path: Path, run: Locate, rng: np.random.Generator) -> None:
    field = read_field("robocup_msl")
    image = floor_image(field, (-6.0, 2.0, 0.7), scale=0.03, shape=(400, 440), line_width=0.125, rng=rng)
    points = scan_floor(image, scale=0.03, line_width=0.125).points
    np.save(tmp_path / "points.npy", points)
    np.savetxt(tmp_path / "points.csv", points, delimiter=",")
    np.save(tmp_path / "wrong.npy", np.zeros((3, 3)))
    np.save(tmp_path / "few.npy", points[:2])
    for name in ("points.npy", "points.csv"):
        code, out, _ = run(
            tmp_path / name,
            "--field",
            "robocup_msl",
            "--out",
            tmp_path / name.replace(".", "_"),
            command="locate-robot",
        )
        assert code == 0
        assert "twin of 2" in out
        report = json.loads((tmp_path / name.replace(".", "_") / "pose.json").read_text())
        assert abs(abs(report["candidates"][0]["pose"]["x"]) - 6.0) < 0.01
        assert (tmp_path / name.replace(".", "_") / "located.png").exists()
    assert "expected points (n, 2)" in run(tmp_path / "wrong.npy", "--field", "robocup_msl", command="locate-robot")[2]
    assert (
        "2 points on lines, expected 4"
        in run(tmp_path / "few.npy", "--field", "robocup_msl", command="locate-robot")[2]
    )


@functools.cache
def board_of(folder: Path) -> Artwork:
    return read_artwork(folder)


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "middle"),
    [("upverter", (-50e-3, 10e-3)), ("fritzing", (20e-3, 25e-3)), ("kicad-x2-tests/x2ap", (60e-3, -45e-3))],
)
def test_boards_of_three_tools_are_located(data: Path, name: str, middle: tuple[float, float], device: Device) -> None:
    board = board_of(data / "gerber" / name)
    pose = (middle[0] + 45e-6, middle[1] - 60e-6, 3e-3)
    image = camera_image(board, pose, FINE, FINE_SHAPE, etch_bias=-8e-6)
    located = locate_board(image, board, scale=FINE, initial_pose=(*middle, 0.0), device=device)
    assert located.reason == ""
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS
    assert np.all(located.sigmas[:2] < 0.05 * FINE)


def test_a_lens_file_goes_with_the_command(folder: Path, artwork: Artwork, tmp_path: Path, run: Locate) -> None:
    pose = (BOARD_MIDDLE[0] + 40e-6, BOARD_MIDDLE[1] - 55e-6, 2e-3)
    cv2.imwrite(str(tmp_path / "board.png"), camera_image(artwork, pose))
    write_lens(tmp_path / "lens.toml", Lens(k1=0.0), {})
    initial_pose = ",".join(str(each) for each in BOARD_MIDDLE) + ",0"
    arguments = ("--scale", "40um", f"--initial-pose={initial_pose}", "--camera", tmp_path / "lens.toml")
    code, out, _ = run(tmp_path / "board.png", "--board", folder, *TOLD, *arguments)
    assert (code, "rulers agree" in out) == (0, True)
    (tmp_path / "lens.toml").write_text("[lens]\nk1 = 'wide'\n")
    code, _, err = run(tmp_path / "board.png", "--board", folder, *TOLD, *arguments)
    assert code == 1
    assert "lens.k1" in err


def test_a_mirrored_side_is_seen_from_below(artwork: Artwork) -> None:
    """The bottom side in view of a camera below: a mirror image of the top view."""
    pose = (BOARD_MIDDLE[0] + 20e-6, BOARD_MIDDLE[1] + 10e-6, 2e-3)
    below = np.ascontiguousarray(camera_image(artwork, pose)[:, ::-1])
    located = locate_board(below, replace(artwork, side="bottom"), scale=PIXEL, initial_pose=(*BOARD_MIDDLE, 0.0))
    assert located.reason == ""
    assert np.abs(errors_in_sigmas(located, pose)).max() < SIGMAS


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan])
def test_levels_of_an_image_with_pixels_that_are_not_finite(value: float) -> None:
    """Two percentiles of the finite pixels, which are half dark and half bright: a twentieth of their difference."""
    grey = np.full((40, 40), 100.0, np.float32)
    grey[:, 20:] = 300.0
    expected = locating_board._levels(grey, None, None)
    assert expected == (0.0, 10.0)
    grey[5:12, 8:30] = value
    assert locating_board._levels(grey, None, None) == expected
    assert locating_board._levels(np.full_like(grey, value), None, None) == (0.0, 1e-6)
