"""Cuts of sheets of light through triangles, edges that lie in a sheet, and the size of the pieces of a bent sheet."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest

from gpuvision.ranging.sheet import BentSheet
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.sheet_cut import SheetIndex, bend_of, concatenated_ranges

OBLIQUE = StraightTransport(
    g_axis=(1.0, 0.2, -0.1), h_axis=(0.1, -0.3, 1.0), direction=(0.2, 1.0, 0.3), origin=(0.5, -0.25, 0.125)
)


def in_scene(points: np.ndarray) -> np.ndarray:
    """Return points of the scene for coordinates (G, H, L) in which `OBLIQUE` is defined."""
    axes = np.array([OBLIQUE.g_axis, OBLIQUE.h_axis, OBLIQUE.direction])
    return np.asarray(points @ axes + OBLIQUE.origin)


def brute_force(corners: np.ndarray, at: float) -> dict[int, np.ndarray]:
    """Return the two points (G, H) of each triangle (G, H, L) on the sheet at a transport, by interpolation."""
    found = {}
    for number, triangle in enumerate(corners):
        points = []
        for a, b in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            if (a[2] < at) != (b[2] < at):
                t = (at - a[2]) / (b[2] - a[2])
                points.append((a + t * (b - a))[:2])
        if points:
            found[number] = np.array(sorted(map(tuple, points)))
    return found


def test_cuts_are_those_of_each_triangle_alone(rng: np.random.Generator) -> None:
    """Triangles from a thousandth to one in length, sheets in any order; the sheet before a corner counts."""
    size = 10.0 ** rng.uniform(-3.0, 0.0, (60, 1, 1))
    corners = rng.uniform(-1.0, 1.0, (60, 1, 3)) + size * rng.uniform(-1.0, 1.0, (60, 3, 3))
    at = np.array([0.3, -0.7, 0.05, 5.0, 0.31])
    cuts = SheetIndex.of(Scene(in_scene(corners)), OBLIQUE).cuts(at)
    np.testing.assert_array_equal(np.sort(cuts.sheet), cuts.sheet)
    for sheet, place in enumerate(at.tolist()):
        expected = brute_force(corners, place)
        mine = cuts.sheet == sheet
        assert sorted(cuts.triangle[mine].tolist()) == sorted(expected)
        for number, ends in zip(cuts.triangle[mine].tolist(), cuts.ends[mine], strict=True):
            np.testing.assert_allclose(sorted(map(tuple, ends)), expected[number], rtol=0, atol=1e-12)


def test_a_corner_in_a_sheet_is_behind_it() -> None:
    """At a corner the cut is that just before it; triangles in the sheet and beyond it are not cut."""
    corners = np.array(
        [
            [[0.0, 0.0, 0.0], [4.0, 0.0, 1.0], [0.0, 2.0, 1.0]],
            [[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
            [[0.0, 0.0, 1.0], [1.0, 0.0, 2.0], [0.0, 1.0, 3.0]],
        ]
    )
    upright = StraightTransport(g_axis=(1.0, 0.0, 0.0), h_axis=(0.0, 1.0, 0.0), direction=(0.0, 0.0, 1.0))
    index = SheetIndex.of(Scene(corners), upright)
    at_end = index.cuts(1.0)
    assert at_end.triangle.tolist() == [0]
    np.testing.assert_array_equal(at_end.ends[0], [[4.0, 0.0], [0.0, 2.0]])
    assert len(index.cuts(0.0).triangle) == 0
    assert index.cuts([3.0, 0.25, 1.5]).sheet.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(index.cuts(0.25).ends[0], [[1.0, 0.0], [0.0, 0.5]])


@pytest.mark.parametrize("bend", [None, BentSheet(terms=(0.5, 0.0, 0.25), pinhole=(0.0, 0.1, 0.3))])
def test_triangles_without_area_or_with_nan_are_not_cut(bend: BentSheet | None) -> None:
    good = np.array([[0.0, 0.0, 0.0], [1e-3, 0.0, 0.0], [0.0, 1e-3, 1e-4]])
    line = np.array([[0.0, 0.0, 0.0], [1e-3, 1e-3, 0.0], [3e-3, 3e-3, 0.0]])
    unknown = np.array([[0.0, 0.0, 0.0], [1e-3, 1e-3, 0.0], [3e-3, np.nan, 0.0]])
    index = SheetIndex.of(Scene(np.stack([line, good, unknown])), StraightTransport(bend=bend))
    assert set(index.triangle) == {1}
    assert set(index.cuts([0.25e-3, 0.5e-3]).triangle) == {1}
    assert set(index.material) == {0}


FLAT = StraightTransport(g_axis=(1.0, 0.0, 0.0), h_axis=(0.0, 0.0, 1.0), direction=(0.0, 1.0, 0.0))


def ridge(turn: float, at: float = 0.4, width: float = 2.0, shift: float = 0.0) -> np.ndarray:
    """Return four triangles of two rectangles that meet at y = ``at``; the second one turns down by an angle."""
    x = np.array([-0.5 * width, 0.5 * width]) + shift
    y, z = at + np.array([-1.0, 0.0, math.cos(turn)]), np.array([0.0, 0.0, -math.sin(turn)])
    quads = [
        [[x[0], y[k], z[k]], [x[1], y[k], z[k]], [x[1], y[k + 1], z[k + 1]], [x[0], y[k + 1], z[k + 1]]] for k in (0, 1)
    ]
    return np.array([[q[i] for i in some] for q in quads for some in ((0, 1, 2), (0, 2, 3))])


@pytest.mark.parametrize(("turn", "is_sharp"), [(0.199, False), (0.201, True), (-0.199, False), (-0.201, True)])
def test_a_sharp_edge_turns_by_more_than_a_fifth_of_a_radian(turn: float, is_sharp: bool) -> None:
    """The outer edges end the surface; the edge between the rectangles counts if it is sharp."""
    places, lengths = SheetIndex.of(Scene(ridge(turn)), FLAT).parallel_edges
    expected = [-0.6, 0.4, 0.4 + math.cos(turn)] if is_sharp else [-0.6, 0.4 + math.cos(turn)]
    np.testing.assert_allclose(places, expected, rtol=1e-12)
    np.testing.assert_allclose(lengths, 2.0, rtol=1e-12)


def test_edges_at_one_transport_add_up_and_materials_end_surfaces() -> None:
    """Two ridges side by side, 2 and 3 wide, one of them of two materials and without a turn."""
    corners = np.concatenate([ridge(0.5), ridge(0.0, width=3.0, shift=5.0)])
    material = np.array([0, 0, 0, 0, 0, 0, 1, 1])
    index = SheetIndex.of(Scene(corners, material), FLAT)
    places, lengths = index.parallel_edges
    np.testing.assert_allclose(places, [-0.6, 0.4, 0.4 + math.cos(0.5), 1.4], rtol=1e-12)
    np.testing.assert_allclose(lengths, [5.0, 5.0, 2.0, 3.0], rtol=1e-12)
    one_material = SheetIndex.of(Scene(corners), FLAT).parallel_edges
    np.testing.assert_allclose(one_material[1], [5.0, 2.0, 2.0, 3.0], rtol=1e-12)


def test_three_triangles_at_an_edge_are_no_smooth_surface() -> None:
    flat = ridge(0.0)
    upright = np.array([[[-1.0, 0.4, 0.0], [1.0, 0.4, 0.0], [0.3, 0.4, 1.0]]])
    upright[0, 2, 1] += 0.5
    lengths = SheetIndex.of(Scene(np.concatenate([flat, upright])), FLAT).parallel_edges[1]
    np.testing.assert_allclose(lengths, [2.0, 2.0, 2.0], rtol=1e-12)


@pytest.mark.parametrize(
    ("along", "slope", "counts"), [("x", 0.9e-9, True), ("x", 1.1e-9, False), ("z", 0.9e-9, True), ("z", 1.1e-9, False)]
)
def test_an_edge_in_a_sheet_has_a_slope_of_at_most_1e_9(along: str, slope: float, counts: bool) -> None:
    end = [3.0, slope * 3.0, 0.0] if along == "x" else [0.0, slope * 3.0, 3.0]
    corners = np.array([[[0.0, 0.0, 0.0], end, [1.0, 2.0, 1.5]]])
    places, lengths = SheetIndex.of(Scene(corners), FLAT).parallel_edges
    assert len(places) == counts
    np.testing.assert_allclose(lengths, [3.0] * counts, rtol=1e-12)


def test_the_distance_of_a_bent_sheet_is_its_quadratic_surface() -> None:
    sheet = BentSheet(terms=(0.5, -3.0, 0.25), pinhole=(0.0, 0.1, 0.3))
    G, H = np.array([2.0, -1.0, 0.5]), np.array([1.0, 4.0, -2.0])
    np.testing.assert_array_equal(bend_of(sheet, G, H), [2.0 - 6.0 + 0.25, 0.5 + 12.0 + 4.0, 0.125 + 3.0 + 1.0])


@pytest.mark.parametrize("terms", [(40.0, -15.0, 20.0), (-40.0, 25.0, 10.0), (0.0, 30.0, 0.0), (5.0, 0.0, -60.0)])
@pytest.mark.parametrize("size", [(3.0, 2.0), (1e5, 1e-7)])
def test_a_refused_part_states_the_pieces_that_it_needs(terms: tuple[float, ...], size: tuple[float, float]) -> None:
    """Pieces whose quadratic surface is within 50 nm of a triangle and its chords; at least their area, or one row."""
    gg, gh, hh = terms
    curvature = np.abs(np.linalg.eigvalsh([[2.0 * gg, gh], [gh, 2.0 * hh]])).max()
    edge = math.sqrt(5e-8 / (curvature * (1.0 / 6.0 + 1.0 / 8.0)))
    x, y = size
    longest = math.hypot(x, y)
    least = 2.0 * max(0.5 * x * y / (math.sqrt(3.0) / 4.0 * edge**2), longest / edge)
    plate = np.array([[[0.0, 0.0, 0.0], [x, 0.0, 0.0], [x, y, 0.0]], [[0.0, 0.0, 0.0], [x, y, 0.0], [0.0, y, 0.0]]])
    move = StraightTransport(bend=BentSheet(terms=(gg, gh, hh), pinhole=(0.0, 0.15, 0.08)))
    message = (
        f"divides the part into at least {least:.3g} triangles, expected at most 1048576; their edges are at most "
        f"{1e3 * edge:.3g} mm."
    )
    with pytest.raises(ValueError, match=re.escape(message)):
        SheetIndex.of(Scene(plate), move)


def test_ranges_follow_each_other() -> None:
    begin, count = np.array([5, 0, -2, 7]), np.array([2, 3, 0, 1])
    np.testing.assert_array_equal(concatenated_ranges(begin, count), [5, 6, 0, 1, 2, 7])
