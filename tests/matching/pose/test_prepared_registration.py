"""Coarse registration of a board: its edge points, its rulers, and the grid of its search, against numbers by hand."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.matching.artwork.edges import BoardEdges
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.pose import coarse_registration, registration
from gpuvision.matching.pose.coarse_registration import CoarseRegistration
from gpuvision.matching.pose.motion import KnownEdges
from gpuvision.matching.pose.registration import (
    _board_in_view,
    _edge_points,
    _ruler_edges,
    _some,
    prepare_board_registration,
)
from gpuvision.matching.pose.registration_result import RegistrationLimits, ScoredMotion

# 40 px per unit, turned by 30 degrees, mirrored.
TURN = 40.0 * np.array([[math.cos(0.5), math.sin(0.5)], [math.sin(0.5), -math.cos(0.5)]])
MATRIX = np.vstack([np.column_stack([TURN, [70.0, 45.0]]), [0.0, 0.0, 1.0]])


def test_part_of_the_board_in_an_image() -> None:
    """Pixel centres from 0 to 120 and from 0 to 80; the size of a pixel is 1/40 unit."""
    found = _board_in_view(MATRIX, (81, 121))
    back = np.linalg.inv(TURN)
    corners = np.array([back @ (np.array(each) - [70.0, 45.0]) for each in ((0, 0), (120, 0), (0, 80), (120, 80))])
    np.testing.assert_allclose(found.low, corners.min(axis=0))
    np.testing.assert_allclose(found.high, corners.max(axis=0))
    np.testing.assert_allclose(found.centre, back @ [-10.0, -5.0])
    assert found.pixel == pytest.approx(1.0 / 40.0)
    stretched = MATRIX.copy()
    stretched[0] *= 4.0
    assert _board_in_view(stretched, (81, 121)).pixel == pytest.approx(1.0 / 80.0)


def artwork_of(pads: list[Any]) -> Any:
    nothing = np.zeros(2)
    edges = BoardEdges(
        start=np.array([[0.0, 0.0], [3.0, 4.0]]),
        end=np.array([[2.5, 0.0], [3.0, 3.0]]),
        normal=np.array([[0.0, 1.0], [-1.0, 0.0]]),
        width=nothing,
        bare=nothing > 1.0,
        trace=nothing.astype(int),
        pad=nothing.astype(int),
    )
    return SimpleNamespace(edges=edges, pads=pads)


def pad(x: float, y: float, across: float, opening: float, shape: str = "circle") -> Any:
    return SimpleNamespace(shape=shape, centre=np.array([x, y]), size=np.array([across, across]), opening=opening)


def test_points_of_edges_and_of_round_pads() -> None:
    """A point in the middle of each step or less of an edge; on contours that the mask does not cover."""
    pads = [
        pad(7.0, 5.0, 1.0, math.nan),
        pad(0.0, 9.0, 2.0, -0.1),
        pad(0.0, 9.0, 2.0, 0.0, "other"),
        pad(9.0, 9.0, 0.2, 0.0),
    ]
    found = _edge_points(artwork_of(pads), np.array([-50.0, -50.0]), np.array([50.0, 50.0]), 0.7)
    # 2.5 long: four parts of 0.625; 1 long: two parts of 0.5; contours of 3.14 and 0.63: five parts and one.
    expected = [(0.3125 + 0.625 * k, 0.0) for k in range(4)] + [(3.0, 3.75), (3.0, 3.25)]
    angles = [2.0 * math.pi * k / 5 for k in range(5)]
    expected += [(7.0 + 0.5 * math.cos(each), 5.0 + 0.5 * math.sin(each)) for each in angles]
    np.testing.assert_allclose(found.point, [*expected, (9.1, 9.0)], atol=1e-12)
    normals = [(0.0, 1.0)] * 4 + [(-1.0, 0.0)] * 2 + [(math.cos(each), math.sin(each)) for each in angles]
    np.testing.assert_allclose(found.normal, [*normals, (1.0, 0.0)], atol=1e-12)
    # Points on the bounds belong to them.
    some = _edge_points(artwork_of(pads), np.array([0.3125, -1.0]), np.array([3.0, 3.25]), 0.7)
    np.testing.assert_allclose(some.point, [*expected[:4], (3.0, 3.25)])


def test_some_of_many_numbers_are_spread_and_always_the_same() -> None:
    numbers = np.arange(100, 3000, 7)
    found = _some(numbers, 200)
    assert len(found) == len(set(found.tolist())) == 200
    assert set(found.tolist()) <= set(numbers.tolist())
    np.testing.assert_array_equal(found, np.sort(found))
    np.testing.assert_array_equal(found, _some(numbers, 200))
    assert abs(np.mean(found) - np.mean(numbers)) < 100
    for most in (len(numbers), len(numbers) + 1):
        assert _some(numbers, most) is numbers
    dense = _edge_points(artwork_of([]), np.zeros(2), np.full(2, 9.0), 1e-3)
    assert len(dense.point) == 512


@pytest.mark.parametrize(("count", "is_narrow"), [(128, False), (127, True)])
def test_rulers_smooth_less_where_few_have_room(monkeypatch: pytest.MonkeyPatch, count: int, is_narrow: bool) -> None:
    """The rulers need room on both sides and for a motion of two pixels, without a turn; pairs are left out."""
    asked: list[Any] = []

    def find(artwork: Any, region: Any, place: Any, imaging: Imaging) -> Any:
        asked.append((artwork, region, place, imaging))
        number = count if len(asked) == 1 else 700
        pair = np.arange(2 * number) % 2 == 1
        points = np.column_stack([np.arange(2.0 * number), np.full(2 * number, len(asked))])
        return SimpleNamespace(point=points, normal=points + 0.5, pair=pair)

    monkeypatch.setattr(registration, "find_ruler_candidates", find)
    board: Any = "board"
    region: Any = "region"
    found, smoothing = _ruler_edges(board, region, "place", 0.02, 1.5)
    assert [each[:3] for each in asked] == [("board", "region", "place")] * (1 + is_narrow)
    assert asked[0][3] == Imaging(pixel=0.02, blur_px=1.5, shift=0.04, angle=0.0)
    assert smoothing == pytest.approx(1.5 if is_narrow else 1.5 * math.sqrt(5.0))
    if is_narrow:
        assert asked[1][3] == Imaging(pixel=0.02, blur_px=1.5 / math.sqrt(3.0), shift=0.04, angle=0.0)
    assert len(found.point) == (512 if is_narrow else count)
    assert (found.point[:, 0] % 2 == 0).all()
    np.testing.assert_array_equal(found.normal, found.point + 0.5)


def test_registration_of_a_board(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rulers may leave the view by the shift, and by the turn of the half diagonal of the part in view."""
    asked: list[Any] = []
    edges = KnownEdges(np.zeros((3, 2)), np.tile([1.0, 0.0], (3, 1)))

    def rulers(artwork: Any, region: Any, place: Any, pixel: float, blur_px: float) -> Any:
        asked.append((region, place, pixel, blur_px))
        return edges, 3.25

    points: list[Any] = []
    monkeypatch.setattr(registration, "_ruler_edges", rulers)
    monkeypatch.setattr(registration, "_edge_points", lambda *of: (points.append(of), edges)[1])
    board: Any = "board"
    found = prepare_board_registration(board, MATRIX, (81, 121), shift=0.3, angle=0.2, blur_px=1.25, threshold=17.0)
    view = _board_in_view(MATRIX, (81, 121))
    (low, high), place, pixel, blur = asked[0]
    reach = 0.3 + 2.0 * math.sin(0.1) * float(np.hypot(*(view.high - view.low))) / 2.0
    np.testing.assert_allclose(low, view.low - reach)
    np.testing.assert_allclose(high, view.high + reach)
    assert (place, pixel, blur) == (view.centre, view.pixel, 1.25)
    assert points[0][0] == "board"
    np.testing.assert_array_equal(points[0][1:3], [view.low, view.high])
    assert points[0][3] == 2.0 * view.pixel
    assert (found.shift, found.angle, found.tolerance_px, found.cell_px) == (0.3, 0.2, 1.0, 2)
    assert found.placement == view.centre
    assert (found.ruler.threshold, found.ruler.width, found.ruler.smoothing_px) == (17.0, 5, 3.25)
    other = prepare_board_registration(
        board, MATRIX, (81, 121), placement=(1.0, 2.0), angle=4.0 * math.pi / 5.0, tolerance_px=2.0, cell_px=3
    )
    assert (other.placement, other.tolerance_px, other.cell_px, other.shift) == ((1.0, 2.0), 2.0, 3, 2e-3)
    assert asked[1][1] == (1.0, 2.0)
    assert points[1][3] == 3.0 * view.pixel
    for wrong in (np.eye(2), np.diag([1.0, 1.0, 0.0])):
        with pytest.raises(ValueError, match="board_to_image must be 3 x 3 and invertible"):
            prepare_board_registration(board, wrong, (81, 121))


def search_of(**given: Any) -> CoarseRegistration:
    rng = np.random.default_rng(2)
    angle = rng.uniform(-math.pi, math.pi, 30)
    edges = KnownEdges(rng.uniform(-1.0, 1.0, (30, 2)), np.stack([np.cos(angle), np.sin(angle)], axis=-1))
    values: dict[str, Any] = {
        "search": edges,
        "rulers": edges,
        "to_image": MATRIX,
        "placement": (0.1, -0.2),
        "shift": 0.33,
        "angle": 0.25,
        "ruler": registration.RulerEdges(threshold=10.0, smoothing_px=2.0),
    }
    return CoarseRegistration(**values | given)


def test_grid_of_a_search() -> None:
    """Shifts of 0.33 units along both axes turn to 40 (0.33 cos + 0.33 sin) px at most; cells of 2 and of 3 px."""
    reach = 40.0 * 0.33 * (math.cos(0.5) + math.sin(0.5))
    for cell in (2, 3):
        search = search_of(cell_px=cell)
        assert search.positions() == (2 * math.ceil(reach / cell) + 1,) * 2
        away = 40.0 * np.linalg.norm(search.search.point - np.array([0.1, -0.2]), axis=1)
        half = math.ceil(0.25 * max(float(np.median(away)), 4.0 * cell) / cell)
        np.testing.assert_allclose(search.headings(), np.linspace(-0.25, 0.25, 2 * half + 1), atol=1e-12)
    wide = np.vstack([np.column_stack([np.diag([80.0, 20.0]), [0.0, 0.0]]), [0.0, 0.0, 1.0]])
    assert search_of(to_image=wide).positions() == (2 * math.ceil(20 * 0.33 / 2) + 1, 2 * math.ceil(80 * 0.33 / 2) + 1)
    assert search_of(angle=0.0).headings().tolist() == [0.0]
    # Points near the placement point count as four cells away.
    near = KnownEdges(np.tile([0.1, -0.2], (4, 1)), np.tile([1.0, 0.0], (4, 1)))
    assert len(search_of(search=near, angle=1.0).headings()) == 9


def test_rulers_of_a_search_reach_its_candidates() -> None:
    """Three smoothings, a sample, and the range on both sides; a candidate is off by 2.5 cells and the tolerance."""
    search = search_of(cell_px=3, tolerance_px=1.5)
    assert search._candidate_error_px == pytest.approx(2.5 * 3 + 1.5)
    assert search._ruler(9.0).length == 2 * (6 + 1 + 9) + 1
    assert search._ruler(9.2).length == 2 * (6 + 1 + 10) + 1
    fine = search_of(ruler=registration.RulerEdges(threshold=10.0, smoothing_px=1.2, step_px=0.5))
    assert fine._ruler(3.0).length == 2 * (8 + 1 + 6) + 1
    assert search._ruler(9.0).threshold == 10.0


@pytest.mark.parametrize(("count", "step"), [(512, 1), (513, 2), (1024, 2)])
def test_candidates_are_verified_by_at_most_512_rulers(count: int, step: int) -> None:
    points = np.column_stack([np.arange(float(count)), np.zeros(count)])
    many = KnownEdges(points, np.tile([0.0, 1.0], (count, 1)))
    np.testing.assert_array_equal(search_of(rulers=many)._verification_edges.point, points[::step])
    assert [search_of(transform=each)._trials for each in ("rigid", "similarity", "affine")] == [128, 256, 512]
    with_etch = [search_of(transform=each, etch_bias_sigma=1.0)._trials for each in ("rigid", "similarity", "affine")]
    assert with_etch == [128, 256, 1024]


def test_refused_poses_keep_their_scores() -> None:
    def scored(agreeing: int, x: float) -> ScoredMotion:
        motion = np.column_stack([np.eye(2), [0.1 + x, -0.2]])
        return ScoredMotion(motion, 0.0, np.arange(10) < 8, np.arange(10) < agreeing)

    search = search_of()
    alone = search._refuse(registration.Status.LOW_SIGNAL, scored(6, 0.0), [])
    assert (alone.score, alone.rulers, alone.status, alone.runner_up) == (0.75, 8, registration.Status.LOW_SIGNAL, 0.0)
    assert np.isnan(alone.pose).all()
    assert np.isnan(alone.runner_up_pose).all()
    found = search._refuse(registration.Status.AMBIGUOUS, scored(6, 0.0), [scored(4, 0.5), scored(2, 0.7)])
    assert (found.score, found.runner_up) == (0.75, 0.5)
    np.testing.assert_allclose(found.runner_up_pose, [0.5, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"to_image": np.diag([1.0, 1.0, 0.0])}, "to_image must be 3 x 3, finite and invertible"),
        ({"to_image": np.eye(3) * np.nan}, "to_image must be 3 x 3, finite and invertible"),
        ({"shift": 0.0}, "shift is 0.0, expected above 0"),
        ({"tolerance_px": 64.1}, "tolerance_px is 64.1, expected above 0 and up to 64"),
        ({"min_score": 1.01}, "min_score is 1.01, expected above 0 and up to 1"),
        ({"shift": -1e-6}, "shift is -1e-06, expected above 0"),
        ({"tolerance_px": -0.5}, "tolerance_px is -0.5, expected above 0"),
        ({"min_score": -0.1}, "min_score is -0.1, expected above 0"),
        ({"angle": -0.01}, "angle is -0.01, expected 0 to pi"),
        ({"angle": 3.15}, "angle is 3.15, expected 0 to pi"),
        ({"max_candidates": 0}, "max_candidates is 0, expected 1 or more"),
        ({"etch_bias_sigma": 0.0}, "etch_bias_sigma is 0.0"),
        ({"rulers": KnownEdges(np.zeros((1025, 2)), np.tile([1.0, 0.0], (1025, 1)))}, "rulers must have up to 1024"),
        ({"search": KnownEdges(np.zeros((2, 2)), np.tile([1.0, 0.1], (2, 1)))}, "search must have finite points and"),
        ({"search": KnownEdges(np.zeros((2, 3)), np.zeros((2, 3)))}, "search must have up to 4096 points"),
        ({"search": KnownEdges(np.zeros((2, 2)), np.zeros((3, 2)))}, "search must have up to 4096 points"),
    ],
)
def test_searches_out_of_their_range_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        search_of(**changes)


def test_searches_at_their_limits_are_taken() -> None:
    edges = KnownEdges(np.zeros((1024, 2)), np.tile([1.0, 0.0], (1024, 1)))
    search_of(tolerance_px=64.0, min_score=1.0, angle=math.pi, max_candidates=1, rulers=edges)
    limits = RegistrationLimits()
    for ruler in ({"edge_selection": "all", "max_edges": 3}, {"pairs": True, "spacing_px": (3.0, 9.0)}):
        wrong: Any = registration.RulerEdges(threshold=10.0, **ruler)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="must be a RulerEdges that returns one single edge"):
            search_of(ruler=wrong, limits=limits)


def test_border_of_the_cost_map_holds_all_edges_at_all_shifts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of the shifts, two cells, and the turn of the farthest edge; at most the larger side of the image."""

    class StoppedError(Exception):
        pass

    borders: list[int] = []

    def costs(*, threshold: float, border: int) -> Any:
        assert threshold == 10.0
        borders.append(border)
        raise StoppedError

    monkeypatch.setattr(coarse_registration, "CellMeans", lambda **_: lambda *_, **__: SimpleNamespace(means=None))
    monkeypatch.setattr(coarse_registration, "EdgeCostMap", costs)
    for angle, side in ((0.25, 81), (3.0, 81), (0.25, 12)):
        search = search_of(angle=angle, cell_px=3)
        with pytest.raises(StoppedError):
            search._search_grid(np.zeros((side, side // 2)), None)
        away = 40.0 * np.linalg.norm(search.search.point - np.array([0.1, -0.2]), axis=1).max()
        turned = min(2.0 * math.sin(angle / 2.0) * away, side)
        assert borders[-1] == max(search.positions()) // 2 + 2 + math.ceil(turned / 3)
