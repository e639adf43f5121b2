"""Polygons of drawn objects, visible edges and shapes of pads, against closed forms and SciPy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from bare_boards import board_of
from gpuvision.matching.artwork.artwork import _described, _first_of_equals, read_artwork
from gpuvision.matching.artwork.drawn_objects import drawn_objects
from gpuvision.matching.artwork.edges import BoardEdges, board_edges
from gpuvision.matching.artwork.gerber_parser import parse_gerber
from gpuvision.matching.artwork.shapes import (
    SAGITTA,
    DrawnObject,
    Layer,
    Shape,
    arc,
    area,
    capsule,
    count_chords,
    disk,
    hull,
    radius_and_sweep,
    sorted_unique,
)
from gpuvision.matching.artwork.visible_layers import layer_edges_along, visible_layers

HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"


def square(x: float, y: float, side: float) -> np.ndarray:
    """Return the corners of a square with its lower left corner at (x, y), counter-clockwise."""
    return np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]])


@pytest.mark.parametrize("radius", [11e-6, 0.3e-3, 5e-3, 1.0])
@pytest.mark.parametrize("angle", [0.3, math.pi, 2.0 * math.pi])
def test_chords_are_as_few_as_keep_the_sagitta(radius: float, angle: float) -> None:
    count = count_chords(radius, angle)
    sagitta = [radius * (1.0 - math.cos(angle / 2.0 / n)) for n in (count, max(count - 1, 1))]
    assert sagitta[0] <= SAGITTA * (1.0 + 1e-6)
    assert sagitta[1] > SAGITTA * (1.0 - 1e-6) or count == 1


def test_chords_of_tiny_and_of_huge_arcs() -> None:
    """Below 10 um the sagitta is a twentieth of the radius; an arc has 100 000 chords at most."""
    for radius in (1e-9, 0.4e-6, 9e-6):
        assert count_chords(radius, 2.0 * math.pi) == math.ceil(math.pi / math.acos(0.95))
    half = math.acos(1.0 - SAGITTA / 2e3)
    most = 2.0 * half * 100_000
    assert count_chords(2e3, most * (1.0 - 1e-9)) == 100_000
    with pytest.raises(ValueError, match=r"an arc or aperture with a radius of 2000 m, which is too large for a board"):
        count_chords(2e3, most * (1.0 + 1e-9))
    with pytest.raises(ValueError, match="radius of nan m"):
        count_chords(math.nan, math.nan)


@pytest.mark.parametrize(
    ("start", "end", "clockwise", "sweep"),
    [
        (0.5, 1.5, False, 1.0),
        (0.5, 1.5, True, 1.0 - 2.0 * math.pi),
        (1.5, 0.5, True, -1.0),
        (1.5, 0.5, False, 2.0 * math.pi - 1.0),
        (3.0, -3.0, False, 2.0 * math.pi - 6.0),
        (0.7, 0.7, False, 2.0 * math.pi),
        (0.7, 0.7, True, -2.0 * math.pi),
    ],
)
def test_arcs_run_from_their_start_to_before_their_end(start: float, end: float, clockwise: bool, sweep: float) -> None:
    centre, radius = np.array([1e-3, -2e-3]), 0.5e-3
    first, last = (centre + radius * np.array([math.cos(each), math.sin(each)]) for each in (start, end))
    assert radius_and_sweep(first, last, centre, clockwise) == pytest.approx((radius, sweep))
    corners = arc(first, last, centre, clockwise)
    count = len(corners)
    assert count == count_chords(radius, abs(sweep))
    angles = start + np.arange(count) * sweep / count
    np.testing.assert_allclose(corners, centre + radius * np.column_stack([np.cos(angles), np.sin(angles)]), atol=1e-12)


def test_ends_of_an_arc_within_a_nanometre_are_one_point() -> None:
    centre = np.zeros(2)
    for away, is_circle in ((0.9e-9, True), (1.1e-9, False)):
        _, sweep = radius_and_sweep(np.array([1e-3, 0.0]), np.array([1e-3, away]), centre, False)
        assert (sweep == 2.0 * math.pi) == is_circle


def test_hulls_and_areas(rng: np.random.Generator) -> None:
    points = rng.normal(size=(60, 2)) * [1.0, 3.0] + [5.0, -2.0]
    points = np.concatenate([points, points[:5], square(-1.0, -1.0, 8.0), [[3.0, -1.0], [7.0, 2.0]]])
    found = hull(points)
    known = ConvexHull(points)
    assert area(found) == pytest.approx(known.volume)
    corners = {tuple(each) for each in points[known.vertices].tolist()}
    assert {tuple(each) for each in found.tolist()} == corners
    assert area(found[::-1]) == pytest.approx(-known.volume)
    # Corners on a side do not belong to the hull.
    assert len(hull(np.concatenate([square(0.0, 0.0, 2.0), [[1.0, 0.0], [2.0, 1.0]]]))) == 4
    assert area(np.array([[2.0, 1.0], [5.0, 1.0], [5.0, 3.0]])) == pytest.approx(3.0)


def test_disks_and_capsules() -> None:
    corners = disk(np.array([1e-3, 2e-3]), 0.25e-3)
    assert len(corners) % 4 == 0
    assert len(corners) - 4 < count_chords(0.25e-3, 2.0 * math.pi) <= len(corners)
    around = corners - [1e-3, 2e-3]
    for mirrored in (around * [-1.0, 1.0], around * [1.0, -1.0], around[:, ::-1]):
        np.testing.assert_allclose(
            sorted(map(tuple, np.round(mirrored, 12))), sorted(map(tuple, np.round(around, 12))), atol=1e-12
        )
    place = np.array([3e-3, 4e-3])
    np.testing.assert_array_equal(capsule(place, place, 1e-4), disk(place, 1e-4))
    values = np.array([3.0, 1.0, 1.0, 2.0, 3.0, -4.0])
    np.testing.assert_array_equal(sorted_unique(values), np.unique(values))
    assert len(sorted_unique(values[:0])) == 0


def test_comparisons_measure_the_time_of_queries() -> None:
    """800 for a query, a side and 200 for each shape near the line, and 800 for one that it crosses."""
    layer = Layer((Shape(square(0.0, 0.0, 1.0)), Shape(square(3.0, 0.0, 1.0))))
    layer.crossings(np.array([-1.0, 0.5]), np.array([2.0, 0.5]))
    assert layer.comparisons == 800 + 200 + 4 + 800
    layer.crossings(np.array([-1.0, 5.0]), np.array([2.0, 5.0]))
    assert layer.comparisons == 1804 + 800
    # The boxes overlap, but the line passes by.
    layer.crossings(np.array([0.9, 1.5]), np.array([1.6, 0.9]))
    assert layer.comparisons == 2604 + 800 + 200 + 4
    empty = Layer(())
    assert empty.crossings(np.zeros(2), np.ones(2)) == []
    assert empty.comparisons == 800


def test_edges_of_a_layer_along_a_normal() -> None:
    """Squares from 0 to 2 and from 1.5 to 3, which overlap; one from 5 to 6; the direction is along (0.6, 0.8)."""
    normal = np.array([0.6, 0.8])
    turn = np.array([[0.6, 0.8], [-0.8, 0.6]])
    shapes = tuple(Shape(square(x, -1.0, side) @ turn) for x, side in ((0.0, 2.0), (1.5, 1.5), (5.0, 1.0)))
    point = 1.5 * normal - 0.5 * np.array([-0.8, 0.6])
    place, ends = layer_edges_along(Layer(shapes), point, normal, 4.0)
    np.testing.assert_allclose(place, [-1.5, 1.5, 3.5], atol=1e-12)
    assert ends.tolist() == [False, True, False]
    near, _ = layer_edges_along(Layer(shapes), point, normal, 1.4)
    assert len(near) == 0
    assert len(layer_edges_along(Layer(()), point, normal, 4.0)[0]) == 0


def test_layers_over_the_copper_may_lie_off() -> None:
    holes = [(0.5e-3, 0.5e-3, 0.4e-3)]
    artwork = board_of(square(0.0, 0.0, 1e-3), holes=holes, silk=(Shape(square(2e-3, 0.0, 1e-3)),))
    copper, mask, silk, drilled = visible_layers(artwork, 30e-6)
    assert [each.max_offset for each in (copper, mask, silk, drilled)] == [0.0, 30e-6, 30e-6, 30e-6]
    assert [each.dark for each in (copper, mask, silk, drilled)] == [False, False, False, True]
    assert [len(each.layer.shapes) for each in (copper, mask, silk, drilled)] == [1, 0, 1, 1]
    assert area(drilled.layer.shapes[0].outline) == pytest.approx(math.pi * 0.04e-6, rel=1e-6)


def stroke(x0: float, y0: float, x1: float, y1: float, width: float) -> DrawnObject:
    ends = 1e-3 * np.array([[x0, y0], [x1, y1]])
    return DrawnObject("stroke", (Shape(capsule(*ends, 0.5e-3 * width)),), ends, 1e-3 * width)


def edges_of(strokes: list[DrawnObject], pads: list[np.ndarray], clearance: float, mask: Any = None) -> BoardEdges:
    shapes = tuple(shape for each in strokes for shape in each.shapes) + tuple(Shape(each) for each in pads)
    openings = None if mask is None else Layer(tuple(Shape(each) for each in mask))
    return board_edges(strokes, pads, Layer(shapes), openings, Layer(()), clearance)


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.0])
@pytest.mark.parametrize(("length", "count"), [(0.1999, 0), (0.2001, 2)])
def test_edges_shorter_than_100_micrometres_are_left_out(angle: float, length: float, count: int) -> None:
    """A clearance of 50 um at both ends of the two edges of a trace."""
    c, s = length * math.cos(angle), length * math.sin(angle)
    found = edges_of([stroke(1.0, 2.0, 1.0 + c, 2.0 + s, 0.3)], [], 50e-6)
    assert len(found.width) == count
    if count:
        np.testing.assert_allclose(found.length, 0.1001e-3, rtol=1e-6)
        np.testing.assert_allclose(found.width, 0.3e-3)
        np.testing.assert_allclose(found.normal @ [math.cos(angle), math.sin(angle)], 0.0, atol=1e-12)
        np.testing.assert_allclose(np.abs(found.normal @ [-math.sin(angle), math.cos(angle)]), 1.0)
        middle = np.array([1.0, 2.0]) + 0.5 * np.array([c, s])
        np.testing.assert_allclose((found.start + found.end) / 2.0 - 1e-3 * middle, 0.15e-3 * found.normal, atol=1e-12)
    assert (found.pad == -1).all()


def test_sides_of_pads_shorter_than_100_micrometres_are_left_out() -> None:
    """Sides of 99 um and of 101 um, of which 0.5 um are kept free at each end; the width is that across the pad."""
    for side, count in ((99e-6, 2), (101e-6, 4)):
        pad = np.array([[0.0, 0.0], [0.4e-3, 0.0], [0.4e-3, side], [0.0, side]])
        found = edges_of([], [pad], 0.5e-6)
        assert len(found.width) == count
        assert (found.trace == -1).all()
        assert (found.pad == 0).all()
        np.testing.assert_allclose(found.width[np.abs(found.normal[:, 1]) > 0.5], side)
        np.testing.assert_allclose(found.width[np.abs(found.normal[:, 0]) > 0.5], 0.4e-3)
        outwards = np.sum(((found.start + found.end) / 2.0 - pad.mean(axis=0)) * found.normal, axis=1)
        np.testing.assert_allclose(outwards, found.width / 2.0)


def test_a_mask_cuts_edges_into_bare_and_masked_parts() -> None:
    """An opening from x = 1 to 2 mm over a trace from 0 to 3 mm; parts keep the clearance of 50 um."""
    opening = np.array([[1e-3, -1e-3], [2e-3, -1e-3], [2e-3, 1e-3], [1e-3, 1e-3]])
    found = edges_of([stroke(0.0, 0.0, 3.0, 0.0, 0.4)], [], 50e-6, [opening])
    spans = sorted(
        (*sorted((a, b)), bool(bare))
        for a, b, bare in zip(1e3 * found.start[:, 0], 1e3 * found.end[:, 0], found.bare, strict=True)
    )
    expected = [(0.05, 0.95, False)] * 2 + [(1.05, 1.95, True)] * 2 + [(2.05, 2.95, False)] * 2
    np.testing.assert_allclose(spans, expected, atol=1e-9)
    # An opening whose border runs within the clearance of an edge hides it; a border beyond it does not.
    for top, count in ((0.23e-3, 1), (0.26e-3, 2)):
        opening = np.array([[-1e-3, -1e-3], [4e-3, -1e-3], [4e-3, top], [-1e-3, top]])
        assert len(edges_of([stroke(0.0, 0.0, 3.0, 0.0, 0.4)], [], 50e-6, [opening]).width) == count


def regular(count: int, radius: float, turn: float = 0.0) -> np.ndarray:
    angle = turn + 2.0 * math.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angle), np.sin(angle)]) + [7.0, -3.0]


@pytest.mark.parametrize(
    ("outline", "shape", "size", "angle"),
    [
        (regular(24, 1.0), "circle", [2.0 * math.sqrt(12.0 * math.sin(math.pi / 12.0) / math.pi)] * 2, 0.0),
        (regular(16, 1.0), "other", None, None),
        (regular(4, 1.0, 0.3), "rectangle", [math.sqrt(2.0)] * 2, 0.3 + math.pi / 4.0),
        (regular(3, 1.0), "other", None, None),
    ],
)
def test_shape_size_and_angle_of_a_pad(outline: np.ndarray, shape: str, size: Any, angle: Any) -> None:
    found = _described(outline)
    assert found[0] == shape
    if size is not None:
        np.testing.assert_allclose(found[1], size)
        assert found[2] == pytest.approx(angle)


@pytest.mark.parametrize("angle", [0.0, 0.2, 1.5])
def test_a_rectangle_without_corners_is_a_rectangle_up_to_half_a_percent(angle: float) -> None:
    """3 x 2 with chamfers c at the four corners: the area lacks 2 c^2 of 6."""
    turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    for share, shape in ((0.0049, "rectangle"), (0.0051, "other")):
        c = math.sqrt(share * 6.0 / 2.0)
        corners = [(c, 0), (3 - c, 0), (3, c), (3, 2 - c), (3 - c, 2), (c, 2), (0, 2 - c), (0, c)]
        found = _described(np.array(corners) @ turn + [1.0, 5.0])
        assert found[0] == shape
        np.testing.assert_allclose(found[1], [3.0, 2.0])
        assert found[2] == pytest.approx(angle, abs=1e-9)


def test_places_within_5_micrometres_are_one(rng: np.random.Generator) -> None:
    """The first one of each group counts, whatever its coordinates; a third coordinate separates."""
    base = rng.uniform(-0.2, 0.2, (50, 2))
    near = base + 4.9e-6 * np.column_stack([np.cos(np.arange(50)), np.sin(np.arange(50))])
    far = base + 5.1e-6 * np.column_stack([np.cos(np.arange(50)), np.sin(np.arange(50))])
    assert _first_of_equals(np.concatenate([base, near])).tolist() == list(range(50))
    assert _first_of_equals(np.concatenate([base, far])).tolist() == list(range(100))
    assert _first_of_equals(np.array([[0.0, 0.0, 1e-3], [0.0, 0.0, 2e-3]])).tolist() == [0, 1]
    assert len(_first_of_equals(np.empty((0, 2)))) == 0


def objects(*commands: str) -> tuple[DrawnObject, ...]:
    return drawn_objects(parse_gerber(HEAD + "\n".join(commands) + "\nM02*\n", Path("board.gbr")))


@pytest.mark.filterwarnings("ignore::SyntaxWarning")
def test_strokes_without_area_are_left_out_and_the_others_kept() -> None:
    """A stroke with a width of 0, then a flash and a stroke."""
    found = objects(
        "%ADD10C,0*%", "%ADD11C,0.4*%", "D10*", "X0Y0D02*", "X1000000Y0D01*", "D11*", "X3000000Y0D03*",
        "X4000000Y0D02*", "X5000000Y0D01*",
    )  # fmt: skip
    assert [each.kind for each in found] == ["flash", "stroke"]
    np.testing.assert_allclose(found[0].centre, [3e-3, 0.0], atol=1e-12)
    assert found[1].width == pytest.approx(0.4e-3)
    np.testing.assert_allclose(found[1].ends, [[4e-3, 0.0], [5e-3, 0.0]], atol=1e-12)
    assert math.isnan(found[0].width)
    assert found[0].ends is None


def test_holes_of_an_area_are_the_later_erased_ones_that_overlap_it() -> None:
    """Two boxes side by side, and disks that are erased from the first, from both, and beside them."""
    found = objects(
        "%AMTWO*21,1,2,2,-2,0,0*21,1,2,2,2,0,0*1,0,0.5,-2,0,0*1,0,4,0,0,0*1,0,0.5,9,9,0*%", "%ADD10TWO*%", "D10*",
        "X0Y0D03*",
    )  # fmt: skip
    (flash,) = found
    assert [len(each.holes) for each in flash.shapes] == [2, 1]
    assert [each.dark for each in flash.shapes] == [True, True]
    np.testing.assert_allclose([area(each.outline) for each in flash.shapes], 4e-6)
    alone = objects("%AMONE*21,1,2,2,0,0,0*21,1,1,1,0.5,0,0*1,0,0.5,0,0,0*%", "%ADD10ONE*%", "D10*", "X0Y0D03*")
    # A later exposed area is no hole of the earlier one.
    assert [len(each.holes) for each in alone[0].shapes] == [1, 1]


def beyond(radius: float, half: float) -> float:
    """Return the area of a disk where x and y exceed half a gap."""
    rest = math.sqrt(radius**2 - half**2)
    return 0.5 * radius**2 * (0.5 * math.pi - 2.0 * math.asin(half / radius)) - half * rest + half**2


@pytest.mark.parametrize(("inner", "hole"), [(1.4, True), (0.5, False)])
@pytest.mark.parametrize("degrees", [0.0, 30.0])
def test_a_thermal_has_the_area_of_a_ring_without_a_cross(inner: float, hole: bool, degrees: float) -> None:
    """2.4 mm across with gaps of 0.4 mm; the hole may lie within the cross of the gaps, 0.283 mm from the middle."""
    found = objects(f"%AMTHERMAL*7,0.5,0.3,2.4,{inner},0.4,{degrees}*%", "%ADD10THERMAL*%", "D10*", "X0Y0D03*")
    outlines = [each.outline for each in found[0].shapes]
    assert len(outlines) == 4
    each = beyond(1.2, 0.2) - (beyond(0.5 * inner, 0.2) if hole else 0.0)
    np.testing.assert_allclose([1e6 * abs(area(one)) for one in outlines], each, rtol=2e-3)
    angle = math.radians(degrees)
    centre = [0.5 * math.cos(angle) - 0.3 * math.sin(angle), 0.5 * math.sin(angle) + 0.3 * math.cos(angle)]
    every = np.concatenate(outlines)
    np.testing.assert_allclose(1e3 * every.mean(axis=0), centre, atol=1e-9)
    away = np.linalg.norm(1e3 * every - centre, axis=1)
    assert away.max() == pytest.approx(1.2, rel=1e-6)
    # Wide gaps leave nothing.
    assert objects("%AMNONE*7,0,0,1,0.5,0.71,0*%", "%ADD10NONE*%", "D10*", "X0Y0D03*") == ()
    assert len(objects("%AMSOME*7,0,0,1,0.5,0.7,0*%", "%ADD10SOME*%", "D10*", "X0Y0D03*")[0].shapes) == 4


@pytest.mark.parametrize(
    ("commands", "message"),
    [
        (
            ("%AMMANY*5,1,1001,0,0,1,0*%", "%ADD10MANY*%", "D10*", "X0Y0D03*"),
            "MANY: a polygon of more than 1000 corners",
        ),
        (("%ADD10C,1*%", "D10*", "X1999600000Y0D03*"), "an object that extends to 2 m"),
        (("%ADD10C,1*%", "D10*", "X0Y-1999600000D03*"), "an object that extends to 2 m"),
        (
            ("%ADD10C,1*%", "G75*", "D10*", "X0Y0D02*", "G03*", "X0Y0I-11000000000J0D01*"),
            r"an arc with a radius of 11 m takes 104\d\d lines, which is too large for a board",
        ),
    ],
)
def test_objects_that_are_too_large_are_refused(commands: tuple[str, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        objects(*commands)


def test_objects_at_their_limits_are_taken() -> None:
    (polygon,) = objects("%AMMANY*5,1,1000,0,0,1,0*%", "%ADD10MANY*%", "D10*", "X0Y0D03*")
    assert len(polygon.shapes[0].outline) == 1000
    (far,) = objects("%ADD10C,1*%", "D10*", "X1999400000Y0D03*")
    assert far.bounds.max() == pytest.approx(1.9999, abs=1e-6)


def test_bounds_of_a_board_without_an_outline_are_those_of_its_copper(tmp_path: Path) -> None:
    text = (
        "%ADD10C,0.4*%\n%ADD11R,2X1*%\nD10*\nX1000000Y2000000D02*\nX5000000Y2000000D01*\nD11*\nX3000000Y7000000D03*\n"
    )
    (tmp_path / "copper.gbr").write_text(HEAD + text + "M02*\n")
    board = read_artwork(tmp_path, layers={r"copper\.gbr": "top copper"})
    np.testing.assert_allclose(board.bounds, [[0.8e-3, 1.8e-3], [5.2e-3, 7.5e-3]], atol=SAGITTA)
    # A flash in the outline does not count.
    outline = "%ADD10C,0.1*%\nD10*\nX0Y0D02*\nX20000000Y10000000D01*\nX90000000Y0D03*\n"
    (tmp_path / "outline.gbr").write_text(HEAD + outline + "M02*\n")
    layers = {r"copper\.gbr": "top copper", r"outline\.gbr": "mechanical outline"}
    board = read_artwork(tmp_path, layers=layers)
    np.testing.assert_allclose(board.bounds, [[0.0, 0.0], [20e-3, 10e-3]], atol=1e-9)
