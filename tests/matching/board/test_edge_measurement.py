"""View of a board whose artwork is moved, against complex numbers."""

from __future__ import annotations

import cmath
import math
import re
import types
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.board import edge_measurement
from gpuvision.matching.board.edge_measurement import (
    BoardMeasurer,
    _about_origin,
    _group_spacings,
    _reason_of,
    move_view,
)
from gpuvision.matching.board.fiducial_detection import FoundFiducials
from gpuvision.matching.board.measurement_result import Copper, MeasurementLimits, PoseSolution, RulerMeasurements
from gpuvision.status import Status

LENGTHS = st.floats(-0.2, 0.2)
ANGLES = st.floats(-math.pi, math.pi)
POSES = st.tuples(LENGTHS, LENGTHS, ANGLES)


@given(place=POSES, moved=POSES)
def test_a_moved_board_is_seen_by_the_moved_view(place, moved) -> None:
    """The camera at q = R p + t sees the artwork point p; its angle on the artwork is less by the rotation."""
    seen = move_view(BoardView(scale=20e-6, shape=(400, 600), pose=place), moved)
    point = complex(*seen.pose[:2]) * cmath.exp(1j * moved[2]) + complex(*moved[:2])
    assert point == pytest.approx(complex(*place[:2]), abs=1e-12)
    assert cmath.exp(1j * seen.pose[2]) == pytest.approx(cmath.exp(1j * (place[2] - moved[2])), abs=1e-12)
    assert abs(seen.pose[2]) <= math.pi


def test_pixels_of_a_moved_board_are_those_of_the_board() -> None:
    view = BoardView(scale=20e-6, shape=(400, 600), pose=(0.05, -0.02, 2.9), mirrored=True)
    x, y, theta = 0.01, 0.03, -1.7
    points = np.array([[0.04, 0.01], [-0.02, 0.03], [0.0, 0.0]])
    on_board = np.exp(1j * theta) * (points @ [1.0, 1j]) + complex(x, y)
    pixels = move_view(view, (x, y, theta)).to_pixels(points)
    np.testing.assert_allclose(pixels, view.to_pixels(np.stack([on_board.real, on_board.imag], -1)), atol=1e-6)


@pytest.mark.parametrize(
    ("status", "inlier_fraction", "leverage", "words"),
    [
        (Status.OUT_OF_RANGE | Status.AMBIGUOUS, 0.1, 0.9, "outside the search range"),
        (Status.NO_DATA, 1.0, 0.9, r"^12 edges .* were found, too few for a pose \(NO_DATA\)"),
        (Status.AMBIGUOUS, 0.29, 0.9, r"^5 of the 12 edges found .* 29% of their information, expected 30% or more"),
        (Status.AMBIGUOUS, 0.3, 0.9, "a single edge that no other edge checks"),
        (Status.AMBIGUOUS, np.nan, 0.01, "a single edge that no other edge checks"),
        (Status.AMBIGUOUS, 0.3, 0.0, "do not determine x, y and theta"),
        (Status.AMBIGUOUS, np.nan, np.nan, "do not determine x, y and theta"),
    ],
)
def test_reasons_of_a_refused_pose(status: Status, inlier_fraction: float, leverage: float, words: str) -> None:
    values = {"status": np.uint8(status), "inlier_fraction": inlier_fraction, "leverage": leverage, "inliers": 5}
    fit: Any = types.SimpleNamespace(**{name: np.array(value) for name, value in values.items()})
    assert re.search(words, _reason_of(fit, 12, MeasurementLimits()))


@pytest.mark.parametrize(
    ("distance", "is_first", "search_px"),
    [(3e-4, True, 17.5), (3e-3, True, 152.5), (4e-3, True, 190.0), (3e-4, False, 4)],
)
def test_range_in_which_fiducials_are_searched(
    monkeypatch: pytest.MonkeyPatch, distance: float, is_first: bool, search_px: float
) -> None:
    """Their distance, three sigmas of the etch bias and the slack; at most 190 px, in the second pass 4 px."""
    monkeypatch.setattr(edge_measurement, "search_distance", lambda *_: np.array([0.5, 1.0]) * distance)
    monkeypatch.setattr(edge_measurement, "find_fiducials", lambda *_, **how: how["search_px"])
    device: Any = None
    features: Any = types.SimpleNamespace(fiducials=types.SimpleNamespace(point=None), placement=None, imaging=None)
    measurer = BoardMeasurer(
        np.zeros((2, 2), np.float32),
        features,
        noise=1.0,
        threshold=10.0,
        blur_px=1.0,
        etch_bias_sigma=10e-6,
        device=device,
        limits=MeasurementLimits(),
    )
    view: Any = types.SimpleNamespace(scale=20e-6)
    assert measurer._find_fiducials(view, "bright", is_first=is_first) == pytest.approx(search_px)


@pytest.mark.parametrize(("copper", "polarities"), [("bright", ["falling", "rising"]), ("dark", ["rising", "falling"])])
def test_rulers_of_edges_and_of_traces(monkeypatch: pytest.MonkeyPatch, copper: Copper, polarities: list[str]) -> None:
    """Single edges, then traces of 4 px and of 10 to 11 px: widths are searched from 0.6 w - 2 to 1.4 w + 2 pixels.

    The least width is 1 px.
    """
    rulers: list[dict[str, Any]] = []

    def measure(**how: Any) -> Any:
        rulers.append(how)
        return lambda _, placed, **more: types.SimpleNamespace(
            position=placed[:, 0], sigma=np.full(len(placed), 0.3), status=np.full(len(placed), 2)
        )

    monkeypatch.setattr(edge_measurement, "RulerEdges", measure)
    view = BoardView(scale=1e-4, shape=(40, 60), pose=(0.0, 0.0, 0.0))
    features: Any = types.SimpleNamespace(
        point=np.array([[1e-3, 0.0], [2e-3, 0.0], [-1e-3, 0.0], [3e-4, 0.0]]),
        normal=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [-1.0, 0.0]]),
        spacing=np.array([1.1e-3, 0.0, 1e-3, 0.4e-3]),
        imaging=types.SimpleNamespace(width_px=5, smoothing_ratio=1.5),
    )
    device: Any = None
    limits = MeasurementLimits()
    measurer = BoardMeasurer(
        np.zeros((40, 60), np.float32),
        features,
        noise=1.0,
        threshold=10.0,
        blur_px=1.0,
        etch_bias_sigma=10e-6,
        device=device,
        limits=limits,
    )
    found = measurer._measure_rulers(view, copper, np.array([20.0, 33.0, 10.0, 15.0]))
    assert [each["pairs"] for each in rulers] == [False, True, True]
    assert [each["spacing_px"] for each in rulers] == [None, pytest.approx((1.0, 7.6)), pytest.approx((4.0, 17.4))]
    assert [each["polarity"] for each in rulers] == [*polarities, polarities[1]]
    assert [(each["length"], each["smoothing_px"], each["width"]) for each in rulers] == [(48, 1.5, 5)] * 3
    np.testing.assert_allclose(found.position_px, 29.5 + np.array([10.0, 20.0, -10.0, 3.0]))
    np.testing.assert_allclose(found.sigma, np.hypot(0.3, limits.sampling_sigma_px) * 1e-4)
    np.testing.assert_array_equal(found.status, 2)
    np.testing.assert_array_equal(found.weight, 0.0)
    assert np.isnan(found.residual).all()


def measurer_of(**features: Any) -> Any:
    """Return a measurer without image and device, over features with given fields."""
    found: Any = object.__new__(BoardMeasurer)
    found.limits, found.threshold = MeasurementLimits(), 12.5
    found.blur_px, found.etch_bias_sigma = 2.0, 10e-6
    found.features = types.SimpleNamespace(**features)
    return found


def rulers_of(sigma: list[float], used: list[int], in_image: int | None = None) -> RulerMeasurements:
    count = len(sigma)
    zeros, nothing = np.zeros(count), np.full((count, 2), np.nan)
    inside = np.arange(count) < (count if in_image is None else in_image)
    return RulerMeasurements(
        point=nothing,
        normal=nothing,
        length_px=zeros,
        position_px=np.where(np.arange(count) < 2, 0.0, np.nan),
        sigma=np.array(sigma),
        weight=np.array(used, np.float64),
        residual=zeros,
        status=np.where(inside, 0, Status.OUT_OF_RANGE).astype(np.uint8),
    )


def fiducials_of(sigma: list[float], used: list[int]) -> FoundFiducials:
    count = len(sigma)
    zeros, points = np.zeros(count), np.zeros((count, 2))
    return FoundFiducials(
        point=points,
        radius=zeros,
        seen=points,
        image_px=points,
        size=zeros,
        covariance=np.array(sigma).reshape(-1, 1, 1) ** 2 * np.eye(2),
        weight=np.array(used, np.float64),
        residual=points,
        status=np.zeros(count, np.uint8),
        in_image=np.ones(count, np.bool_),
    )


def solved(rulers: RulerMeasurements, fiducials: FoundFiducials, **changes: Any) -> PoseSolution:
    pose, covariance = np.array([1e-4, -2e-4, 3e-3]), np.diag([1e-6, 2e-6, 1e-4]) ** 2
    found = PoseSolution(pose, covariance, math.nan, 1.0, 2.0, rulers, fiducials, "")
    return found._replace(**changes)


@pytest.mark.parametrize(
    ("rulers", "in_image", "fiducials", "reason"),
    [
        ([1, 1, 1, 0, 0, 0, 0, 0, 0, 0], 10, [], ""),
        ([1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0], 11, [], "3 of 11 rulers agree, expected 30% or more"),
        ([1, 1, 1, 0, 0, 0, 0, 0, 0, 0, 0], 10, [], ""),
        ([1, 1, 0, 0], 4, [], "2 of 4 rulers agree, expected 30% or more"),
        ([1, 1, 0, 0], 4, [1], ""),
        ([1, 1, 0, 0, 0, 0, 0, 0, 0, 0], 10, [0], "2 of 11 rulers and fiducials agree, expected 30% or more"),
    ],
)
def test_a_pose_needs_three_features_and_a_share_that_agree(
    rulers: list[int], in_image: int, fiducials: list[int], reason: str
) -> None:
    found = solved(rulers_of([1e-6] * len(rulers), rulers, in_image), fiducials_of([1e-6] * len(fiducials), fiducials))
    assert measurer_of()._check(found, 20e-6).reason == reason


def test_residuals_above_half_a_pixel_are_refused() -> None:
    """The median sigma is 4 um, 0.2 px; of 2 degrees of freedom, errors explain a chi-square of 4: 0.49 and 0.51 px."""
    found = solved(rulers_of([1e-6, 2e-6, 4e-6], [1, 1, 1]), fiducials_of([9e-6], [1]))
    measurer = measurer_of()
    assert measurer._check(found._replace(residual_scale=math.sqrt(4.0 + 2.45**2)), 20e-6).reason == ""
    reason = measurer._check(found._replace(residual_scale=math.sqrt(4.0 + 2.55**2)), 20e-6).reason
    assert reason == (
        "the edges differ from the best pose by 0.5 px more than their errors explain; expected 0.5 px or less"
    )
    # One more unknown: 1 degree of freedom.
    with_etch_bias = found._replace(etch_bias=0.0, residual_scale=math.sqrt(1.0 + 3.0 * math.sqrt(2.0) + 2.45**2))
    assert measurer._check(with_etch_bias, 20e-6).reason == ""


@pytest.mark.parametrize("residual_scale", [0.2, 1.0, 1.9])
def test_residuals_as_large_as_the_errors_are_accepted(residual_scale: float) -> None:
    """Errors of 1 px explain residuals of 1.9 px with 3 degrees of freedom, a chi-square of 3.6, up to 0.4 px."""
    found = solved(rulers_of([20e-6] * 4, [1] * 4), fiducials_of([20e-6], [1]), residual_scale=residual_scale)
    assert measurer_of()._check(found, 20e-6).reason == ""


def fit_of(*, status: int = 0, residual_scale: float = 2.0, sigma: float = 1e-4, error: float = 0.0) -> Any:
    """Return a similarity whose placement point moves by 3 um along x, relative to the pose of `solved`."""
    factor = 2.0 if residual_scale > 1.0 else 1.0
    return types.SimpleNamespace(
        status=np.array(status, np.uint16),
        residual_scale=np.array(residual_scale),
        covariance=np.diag([1e-6, 1e-6, 1e-4, factor * sigma]) ** 2,
        deformation=np.array([error, error, 0.0]),
        pose=np.array([3e-6, 0.0, 0.0]),
    )


def scale_test(monkeypatch: pytest.MonkeyPatch, fit: Any, **changes: Any) -> PoseSolution:
    """Test the scale of a pose of no motion, with standard deviations of 1 um, about a placement point."""
    measurer = measurer_of(placement=np.array([0.02, -0.01]))
    asked: list[Any] = []
    monkeypatch.setattr(measurer, "_fit", lambda *of: (asked.append(of), fit)[1])
    found = solved(rulers_of([1e-6] * 3, [1] * 3), fiducials_of([], []))
    found = found._replace(**{"pose": np.zeros(3), "covariance": 1e-12 * np.eye(3)} | changes)
    tested = measurer._test_scale(found, 20e-6)
    assert all(each[2:] == (20e-6, None, "similarity") for each in asked)
    return tested


def test_a_pose_that_has_not_converged_is_kept_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    rulers, marks = rulers_of([1e-6] * 3, [1] * 3), fiducials_of([], [])
    measurer = measurer_of(placement=np.zeros(2), spacing=np.ones(3))
    for status, count in ((0, 0), (256, 1)):
        fit = types.SimpleNamespace(
            **vars(fit_of(status=status, residual_scale=1.0)),
            weights=np.ones(3),
            residuals=np.zeros(3),
            scale=np.array(1.0),
            condition=np.array(2.0),
        )
        monkeypatch.setattr(measurer, "_fit", lambda *_, fit=fit: fit)
        found = measurer._solve(rulers, marks, 20e-6, None)
        assert (found.reason, len(found.warnings)) == ("", count)
        np.testing.assert_allclose(found.pose, [3e-6, 0.0, 0.0])
        tested = scale_test(monkeypatch, fit_of(error=1e-3), warnings=found.warnings)
        assert tested.warnings[:count] == found.warnings
        assert len(tested.warnings) == count + 1


def test_a_scale_that_is_not_known_or_not_significant_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    for fit in (fit_of(status=1, error=0.1), fit_of(residual_scale=0.0, error=0.1)):
        found = scale_test(monkeypatch, fit)
        assert np.isnan(found.scale_error).all()
        assert (found.reason, found.warnings) == ("", ())
    unknown = scale_test(monkeypatch, fit_of(error=0.1), covariance=np.full((3, 3), np.nan))
    assert np.isnan(unknown.scale_error).all()
    # Four standard deviations; the covariance is that of the residuals, which are twice as large as the sigmas say.
    for error in (8e-4, -8e-4):
        found = scale_test(monkeypatch, fit_of(error=error))
        assert found.scale_error == pytest.approx((error, 2e-4))
        assert (found.reason, found.warnings) == ("", ())
    # Residuals that are small by chance do not reduce it.
    assert scale_test(monkeypatch, fit_of(residual_scale=0.5, sigma=1e-4)).scale_error[1] == pytest.approx(2e-4)
    assert scale_test(monkeypatch, fit_of(residual_scale=math.nan, sigma=1e-4)).scale_error[1] == pytest.approx(1e-4)


def test_a_wrong_scale_is_a_warning_or_a_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    """0.1 %, as boards shrink, is a warning; 0.3 % that moves the pose by more than 3 sigmas is a refusal."""
    text = "the board is +0.100 % (standard deviation 0.020 %) larger in the image than in the artwork; is the scale "
    found = scale_test(monkeypatch, fit_of(error=1e-3))
    assert found.warnings == (text + "19.98 um, not 20 um?",)
    assert found.reason == ""
    # The motion of the placement point adds to the covariance.
    np.testing.assert_allclose(found.covariance, 1e-12 * np.eye(3) + np.outer([3e-6, 0, 0], [3e-6, 0, 0]), atol=1e-16)
    for share, is_refused in ((0.99, False), (1.01, True)):
        fit = fit_of(error=-3e-3)
        fit.pose = np.array([share * 3e-6, 0.0, 0.0])
        found = scale_test(monkeypatch, fit)
        assert bool(found.reason) == is_refused
        assert len(found.warnings) == (not is_refused)
    assert found.reason.startswith("a wrong scale moves the pose by 3.0 standard deviations: the board is -0.300 %")
    # Within the tolerance of boards it is no refusal, whatever it moves.
    fit = fit_of(error=2e-3)
    fit.pose = np.array([1e-3, 0.0, 0.0])
    assert scale_test(monkeypatch, fit).reason == ""
    fit.deformation = np.array([2.01e-3] * 3)
    assert scale_test(monkeypatch, fit).reason
    refused = scale_test(monkeypatch, fit_of(error=1e-3), reason="few agree")
    assert refused.reason == f"few agree: {text}19.98 um, not 20 um?"
    assert refused.warnings == ()


@given(place=POSES, moved=POSES)
def test_poses_about_a_point_and_about_the_origin(place: Any, moved: Any) -> None:
    """A pose given for places relative to a point, and the motion of this point, by complex numbers."""
    point, shift, turn = complex(*place[:2]), complex(*moved[:2]), cmath.exp(1j * moved[2])
    pose = _about_origin(np.array(moved), np.array(place[:2]))
    for each in (0.3 + 0.1j, -0.2j):
        assert complex(*pose[:2]) + turn * each == pytest.approx(point + shift + turn * (each - point), abs=1e-12)
    assert pose[2] == moved[2]
    motion = measurer_of(placement=np.array(place[:2]))._placement_motion(np.array(moved))
    assert complex(*motion[:2]) == pytest.approx(turn * point + shift - point, abs=1e-12)
    assert motion[2] == moved[2]


def test_spacings_within_20_percent_are_one_group() -> None:
    spacings = np.array([12.1, 0.0, 10.0, 5.0, 12.0, 0.0, 6.0, 14.5])
    assert _group_spacings(spacings) == [(0.0, 0.0), (5.0, 6.0), (10.0, 12.0), (12.1, 14.5)]
    assert _group_spacings(np.array([])) == []
    assert _group_spacings(np.array([0.5, 0.61])) == [(0.5, 0.5), (0.61, 0.61)]


def test_rulers_of_the_second_pass() -> None:
    """4 px on both sides and the filter, 3 px times 3; the spacing of a pair in addition."""
    measurer = measurer_of(spacing=np.array([0.0, 3e-4]), imaging=types.SimpleNamespace(smoothing_ratio=1.5))
    np.testing.assert_allclose(measurer._second_length_px(20e-6), [2 * (4 + 9) + 3, 29 + 15])


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [("", "", "second"), ("first", "", "expected"), ("", "second", "found once")],
)
def test_the_second_pass_looks_where_the_first_one_found_the_board(
    monkeypatch: pytest.MonkeyPatch, first: str, second: str, expected: str
) -> None:
    """Search range: twice the expected one, at least 5 mrad; rulers of at most 512 px, then of the second pass."""
    poses: Any = {"expected": 0, "found once": 1, "second": 2}
    view: Any = types.SimpleNamespace(scale=20e-6, step=0)
    monkeypatch.setattr(
        edge_measurement, "move_view", lambda view, pose: types.SimpleNamespace(scale=20e-6, step=view.step + 1)
    )
    imaging = types.SimpleNamespace(shift=1e-4, angle=1e-3, smoothing_ratio=1.5)
    measurer = measurer_of(length=np.array([1e-3, 0.02]), spacing=np.array([0.0, 3e-4]), imaging=imaging)
    asked: list[Any] = []

    def once(at: Any, copper: str, length: Any, search_range: Any = None) -> Any:
        asked.append((at.step, copper, length.tolist(), search_range))
        return types.SimpleNamespace(reason=first if len(asked) == 1 else second, pose=np.zeros(3))

    monkeypatch.setattr(measurer, "_measure_once", once)
    monkeypatch.setattr(measurer, "_test_scale", lambda solution, scale: solution)
    found = measurer.measure(view, "dark")
    assert asked[0] == (0, "dark", [50.0, 512.0], (pytest.approx(2e-4), pytest.approx(1e-2)))
    assert asked[1:] == ([] if first else [(1, "dark", [29.0, 44.0], None)])
    assert found.view.step == poses[expected]
    assert found.before.step == (0 if first else 1)
    assert found.solution.reason == first + second
    imaging.angle = 7e-3
    asked.clear()
    measurer.measure(view, "dark")
    assert asked[0][3] == (pytest.approx(2e-4), pytest.approx(14e-3))


def test_too_few_features_in_the_image_or_with_an_edge(monkeypatch: pytest.MonkeyPatch) -> None:
    measurer = measurer_of()
    for rulers, marks, reason in (
        (rulers_of([1.0] * 4, [0] * 4, 2), [], "2 of 4 rulers lie in the image, expected 3 or more"),
        (rulers_of([1.0] * 4, [0] * 4, 1), [1.0], "2 of 5 rulers and fiducials lie in the image, expected 3 or more"),
        (
            rulers_of([1.0] * 4, [0] * 4, 3),
            [],
            "2 of 3 rulers found an edge of 12.5 grey levels or more, expected 3; is this the right side of the right "
            "board, near the initial pose, at this scale?",
        ),
        (rulers_of([1.0] * 4, [0] * 4, 3), [1.0], ""),
    ):
        solution = solved(rulers, fiducials_of(marks, [1] * len(marks)))
        monkeypatch.setattr(measurer, "_measure_rulers", lambda *_, rulers=rulers: rulers)
        monkeypatch.setattr(measurer, "_find_fiducials", lambda *_, is_first, solution=solution: solution.fiducials)
        monkeypatch.setattr(measurer, "_solve", lambda *_, solution=solution: solution)
        view: Any = types.SimpleNamespace(scale=20e-6)
        found = measurer._measure_once(view, "bright", np.zeros(4))
        assert found.reason == reason
        assert np.isnan(found.pose).all() == bool(reason)
        assert found.rulers is rulers


@pytest.mark.parametrize("again", ["", "refused"])
def test_a_refused_pose_is_solved_again_with_less_weight_of_the_fiducials(
    monkeypatch: pytest.MonkeyPatch, again: str
) -> None:
    """The sigmas of the fiducials are raised to the median of all, 4 um."""
    rulers, marks = rulers_of([3e-6, 4e-6, 5e-6], [1, 1, 1]), fiducials_of([1e-6, 6e-6], [1, 1])
    measurer = measurer_of()
    monkeypatch.setattr(measurer, "_measure_rulers", lambda *_: rulers)
    monkeypatch.setattr(measurer, "_find_fiducials", lambda *_, is_first: marks)
    asked: list[Any] = []

    def solve(given: Any, fiducials: FoundFiducials, scale: float, search_range: Any) -> PoseSolution:
        asked.append((fiducials, scale, search_range))
        return solved(given, fiducials, reason="first" if len(asked) == 1 else again)

    monkeypatch.setattr(measurer, "_solve", solve)
    view: Any = types.SimpleNamespace(scale=20e-6)
    found = measurer._measure_once(view, "bright", np.zeros(3), (1e-3, 0.1))
    assert found.reason == ("first" if again else "")
    assert [each[1:] for each in asked] == [(20e-6, (1e-3, 0.1))] * 2
    np.testing.assert_allclose(asked[1][0].axes[0], [[4e-6] * 2, [6e-6] * 2], rtol=1e-9)
