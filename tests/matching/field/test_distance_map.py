"""Distance map of a field: distances, nearest lines and costs by definition; refused fields."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from field_maps import large, small
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.distance_map import Arc, DistanceMap, DistanceMapBuilder, Field
from gpuvision.reference import field as reference


def test_distances_are_those_to_the_nearest_line(device: Device) -> None:
    for field_map in (large(device), small(device)):
        rows, columns = field_map.cells.distance.shape
        x0, y0 = field_map.first
        x, y = np.meshgrid(x0 + field_map.cell * np.arange(columns), y0 + field_map.cell * np.arange(rows))
        exact = reference.distance(field_map.field, np.stack([x, y], axis=-1))
        # A few roundings of coordinates up to 20 m.
        np.testing.assert_allclose(field_map.cells.distance, exact, atol=8e-6)
        every = [reference.distance_to_line(line, np.stack([x, y], axis=-1)) for line in field_map.field.lines]
        every += [reference.distance_to_arc(arc, np.stack([x, y], axis=-1)) for arc in field_map.field.arcs]
        of_nearest = np.take_along_axis(np.array(every), field_map.cells.nearest[None, ..., 0].astype(int), axis=0)[0]
        np.testing.assert_allclose(of_nearest, exact, atol=8e-6)
        assert_candidates(field_map.cells.nearest, np.array(every), field_map.cell, least=0.3)
        level = 1023.0 * exact**2 / (field_map.scale**2 + exact**2)
        np.testing.assert_allclose(field_map.cells.level, level, atol=0.51)


def assert_candidates(nearest: np.ndarray, every: np.ndarray, cell: float, *, least: float) -> None:
    """Assert that a cell holds the up to four lines that can be nearest to one of its points, the nearest one first.

    `every`: distances (lines, rows, columns); `least`: least part of the cells in which rounding cannot decide.
    """
    order = np.argsort(every, axis=0, kind="stable")[:5]
    far = np.take_along_axis(every, order, axis=0)
    # Of a point of the cell a distance differs by half the diagonal at most.
    limit = far[0] + 1.42 * cell
    within = np.where(far[:4] <= limit, order[:4], order[0])
    expected = np.concatenate([within, np.repeat(order[:1], 4 - len(within), axis=0)])
    # Rounding decides between lines that are equally far, and at the limit.
    clear = (np.diff(far, axis=0) > 1e-4).all(axis=0) & (np.abs(far - limit) > 1e-4).all(axis=0)
    assert clear.mean() > least
    found = np.moveaxis(nearest, -1, 0)
    np.testing.assert_array_equal(found[:, clear], expected[:, clear])


@pytest.mark.parametrize("vectors", [pytest.param(True, marks=pytest.mark.vectors), False])
@pytest.mark.parametrize(
    ("columns", "rows", "cell", "away"), [(16, 1, 0.5, 0.0), (49, 37, 0.2, 0.0), (33, 19, 0.05, 500.0)]
)
def test_lines_left_out_of_a_tile_are_no_candidates(
    device: Device, rng: np.random.Generator, vectors: bool, columns: int, rows: int, cell: float, away: float
) -> None:
    """A field of 256 lines and arcs at any place; columns at unequal distances, in any order."""
    single = device if vectors else device.without_vectors()
    lines, places = rng.uniform(-9.0, 9.0, (200, 4)) + away, rng.uniform(-9.0, 9.0, (56, 2)) + away
    arcs = [
        Arc(*place, radius, 0.3 * n, 0.3 * n + 0.1 * n)
        for n, (place, radius) in enumerate(zip(places, rng.uniform(0.1, 9.0, 56), strict=True), 1)
    ]
    field = Field(length=20.0, width=20.0, lines=tuple(map(tuple, lines)), arcs=tuple(arcs))
    x, first = (rng.uniform(-5.0, 5.0, columns) + away).astype(np.float32), away - 0.5 * cell * (rows - 1)
    made = DistanceMapBuilder(field=field, first_y=first, cell=cell, rows=rows, scale=0.25)(x, device=single)
    at = np.stack(np.meshgrid(x.astype(np.float64), first + cell * np.arange(rows)), axis=-1)
    every = [reference.distance_to_line(line, at) for line in field.lines]
    every += [reference.distance_to_arc(arc, at) for arc in field.arcs]
    # Roundings of coordinates up to 9 m, or of 500 m.
    np.testing.assert_allclose(made.distance, np.min(every, axis=0), atol=1e-7 * (20.0 + away))
    assert_candidates(made.nearest, np.array(every), cell, least=0.3)


@pytest.mark.parametrize("vectors", [pytest.param(True, marks=pytest.mark.vectors), False])
def test_a_line_far_from_the_middle_of_a_tile_is_nearest_at_its_end(device: Device, vectors: bool) -> None:
    """Columns from -5 to 5 m: at 0 the second line is 9.5 m farther away than the first one, at 5 m it is nearer."""
    field = Field(length=40.0, width=4.0, lines=((-5.5, -1.0, -5.5, 1.0), (15.0, -1.0, 15.0, 1.0)))
    build = DistanceMapBuilder(field=field, first_y=0.0, cell=0.01, rows=1, scale=0.25)
    x = np.linspace(-5.0, 5.0, 16, dtype=np.float32)
    for at_x in (x, x[::-1].copy()):
        made = build(at_x, device=device if vectors else device.without_vectors())
        np.testing.assert_array_equal(made.nearest[0], np.where(at_x > 4.75, 1, 0)[:, None].repeat(4, axis=1))
        np.testing.assert_allclose(made.distance[0], np.minimum(at_x + 5.5, 15.0 - at_x), atol=1e-6)


def test_searched_positions_are_centred_on_the_field(device: Device) -> None:
    """Of a field of 2 m by 1 m with a margin of 0.5 m: 3 m by 2 m in cells of 0.5 m, and 1.2 m around them."""
    field = Field(length=2.0, width=1.0, lines=((0.0, 0.0, 1.0, 0.0),))
    field_map = DistanceMap(field=field, cell=0.5, margin=0.5, max_range=1.2, device=device)
    assert field_map.positions == (4, 6)
    assert field_map.border == 4
    assert field_map.first_position == pytest.approx((-1.25, -0.75))
    assert field_map.first == pytest.approx((-1.25 - 2.0, -0.75 - 2.0))
    assert DistanceMap(field=field, cell=3.0, max_range=3.0, device=device).positions == (1, 1)


def test_a_field_may_be_symmetric() -> None:
    msl = read_field("robocup_msl")
    assert msl.is_symmetric
    assert read_field("robocup_junior").is_symmetric
    one_more = Field(length=22.0, width=14.0, lines=(*msl.lines, (1.0, 1.0, 2.0, 1.0)), arcs=msl.arcs)
    assert not one_more.is_symmetric
    without_an_arc = Field(length=22.0, width=14.0, lines=msl.lines, arcs=msl.arcs[:-1])
    assert not without_an_arc.is_symmetric


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"lines": ((0.0, 0.0, 1.0, 0.0),) * 257}, "256 at most"),
        ({"length": 0.0}, "length"),
        ({"lines": ()}, "neither"),
        ({"lines": ((1.0, 1.0, 1.0, 1.0),)}, "begins where it ends"),
        ({"arcs": (Arc(0.0, 0.0, -1.0),)}, "radius"),
        ({"arcs": (Arc(0.0, 0.0, 1.0, 2.0, 1.0),)}, "start < end"),
    ],
)
def test_wrong_fields_are_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        Field(**{"length": 2.0, "width": 1.0, "lines": ((0.0, 0.0, 1.0, 0.0),), **change})


def test_wrong_maps_are_refused() -> None:
    field = read_field("robocup_msl")
    for change, match in (
        ({"cell": 0.0}, "cell"),
        ({"margin": -1.0}, "margin"),
        ({"max_range": math.inf}, "max_range"),
        ({"cell": 1e-3}, "or more for this field"),
    ):
        with pytest.raises(ValueError, match=match):
            DistanceMap(field=field, **change)


def test_fields_at_their_limits_are_taken() -> None:
    line = (0.0, 0.0, 1.0, 0.0)
    Field(length=1e-3, width=1e-3, lines=(line,) * 255, arcs=(Arc(0.0, 0.0, 1.0),))
    Field(length=1.0, width=1.0, arcs=(Arc(0.0, 0.0, 1e-3, 0.5, 0.5 + 2.0 * math.pi),))
    with pytest.raises(ValueError, match="Field has 257 lines and arcs, expected 256 at most"):
        Field(length=1.0, width=1.0, lines=(line,) * 256, arcs=(Arc(0.0, 0.0, 1.0),))
    for wrong in (Arc(0.0, 0.0, 1.0, 0.5, 0.5), Arc(0.0, 0.0, 1.0, 0.0, 6.2832), Arc(0.0, 0.0, 0.0)):
        with pytest.raises(ValueError, match="expected a radius above 0 and start < end <= start"):
            Field(length=1.0, width=1.0, arcs=(wrong,))
    with pytest.raises(ValueError, match=r"Field\.width is 0\.0, expected metres above 0"):
        Field(length=1.0, width=0.0, lines=(line,))


@pytest.mark.parametrize(
    ("lines", "arcs", "is_symmetric"),
    [
        (((-1.0, 2.0, 3.0, 2.0), (1.0, -2.0, -3.0, -2.0)), (), True),
        (((-1.0, 2.0, 3.0, 2.0), (-3.0, -2.0, 1.0, -2.0)), (), True),
        (((-1.0, 2.0, 3.0, 2.0), (-3.0, -2.0, 1.0, -2.1)), (), False),
        (((-1.0, 2.0, 3.0, 2.0), (-1.0, -2.0, 3.0, -2.0)), (), False),
        (((-2.0, 0.0, 2.0, 0.0),), (), True),
        (((2.0, 3.0, 2.0, -1.0), (-2.0, 1.0, -2.0, -3.0)), (), True),
        ((), (Arc(0.0, 0.0, 1.0, 0.4, 0.4 + 2.0 * math.pi),), True),
        ((), (Arc(0.1, 0.0, 1.0),), False),
        ((), (Arc(0.0, 0.1, 1.0),), False),
        ((), (Arc(1.0, 2.0, 1.0), Arc(-1.0, -2.0, 1.0)), True),
        ((), (Arc(1.0, 2.0, 1.0), Arc(-1.0, -2.0, 1.1)), False),
        ((), (Arc(1.0, 2.0, 1.0, 0.5, 1.5), Arc(-1.0, -2.0, 1.0, 0.5 + math.pi, 1.5 + math.pi)), True),
        ((), (Arc(1.0, 2.0, 1.0, 0.5, 1.5), Arc(-1.0, -2.0, 1.0, 0.5 - math.pi, 1.5 - math.pi)), True),
        ((), (Arc(1.0, 2.0, 1.0, 0.5, 1.5), Arc(-1.0, -2.0, 1.0, 0.5, 1.5)), False),
        ((), (Arc(1.0, 2.0, 1.0, 0.5, 1.5), Arc(-1.0, -2.0, 1.0, 0.4 + math.pi, 1.6 + math.pi)), False),
        ((), (Arc(0.0, 0.0, 1.0, 0.5, 1.5),), False),
    ],
)
def test_half_a_turn_maps_a_symmetric_field_to_itself(lines: Any, arcs: Any, is_symmetric: bool) -> None:
    assert Field(length=8.0, width=6.0, lines=lines, arcs=arcs).is_symmetric == is_symmetric


def test_the_largest_map_has_2_to_the_26_cells() -> None:
    """The larger one of length and width, the margin and the range on both sides, over the cells of a side, 8192."""
    field = Field(length=2.0, width=7.0, lines=((0.0, 0.0, 1.0, 0.0),))
    least = (7.0 + 2.0 * (0.5 + 3.0)) / 8192.0
    with pytest.raises(ValueError, match=rf"DistanceMap\.cell is {0.999 * least} m, expected 0\.0017 m or more"):
        DistanceMap(field=field, cell=0.999 * least, margin=0.5, max_range=3.0)
