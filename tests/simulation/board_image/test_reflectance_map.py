"""Reflectance map of a board: materials, order of the layers, etch bias, filter and refused parameters."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bare_boards import board_of
from board_images import View, board_image
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.reference import board_image as reference
from gpuvision.simulation.board_image.reflectance_map import WHITE, ReflectanceMap

PIXEL = 20e-6
MATERIALS = BoardReflectance(laminate_masked=0.1, copper_masked=0.3, laminate=0.2, copper=0.8, silk=0.9, hole=0.05)


def box(x0: float, y0: float, x1: float, y1: float, dark: bool = True) -> Shape:
    """Return a rectangle from millimetres."""
    return Shape(1e-3 * np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), dark)


def value_at(board_map: ReflectanceMap, x: float, y: float) -> float:
    """Return the reflectance at a place [mm], to the nearest node."""
    column, row = np.rint((1e-3 * np.array([x, y]) - board_map.origin) / board_map.cell).astype(int)
    return float(board_map.values[row, column]) / WHITE


def test_each_material_lies_where_the_layers_put_it() -> None:
    artwork = board_of(
        copper=(box(0.2, 0.2, 1.2, 1.2), box(0.8, 0.8, 1.0, 1.0, dark=False)),
        mask=(box(0.3, 0.3, 1.8, 0.7),),
        silk=(box(0.2, 0.6, 0.6, 1.8),),
        holes=((0.5e-3, 0.5e-3, 0.2e-3),),
    )
    found = ReflectanceMap.of(artwork, pixel=PIXEL, reflectance=MATERIALS)
    expected = {
        (1.5, 1.5): 0.1,  # laminate under the mask
        (1.1, 1.1): 0.3,  # copper under the mask
        (0.9, 0.9): 0.1,  # cleared copper
        (1.5, 0.5): 0.2,  # laminate in the opening
        (0.8, 0.5): 0.8,  # copper in the opening
        (0.4, 1.5): 0.9,  # silk over laminate
        (0.4, 0.65): 0.9,  # silk over bare copper
        (0.5, 0.5): 0.05,  # hole through everything
    }
    for (x, y), reflectance in expected.items():
        assert value_at(found, x, y) == pytest.approx(reflectance, abs=2e-3), (x, y)
    assert found.values.shape == (401, 401)
    moved = ReflectanceMap.of(
        artwork, pixel=PIXEL, reflectance=MATERIALS, mask_shift=(0.0, 0.9e-3), silk_shift=(1e-3, 0.0)
    )
    assert [value_at(moved, *place) for place in ((0.8, 0.3), (1.5, 1.4), (1.4, 1.0), (0.4, 1.7))] == pytest.approx(
        [0.3, 0.9, 0.9, 0.1], abs=2e-3
    )


def test_the_map_covers_its_region() -> None:
    """Node (0, 0) is at the least x and y of a region that is not square; columns run along x."""
    artwork = board_of(copper=(box(0.5, 0.5, 1.5, 1.5),))
    found = ReflectanceMap.of(artwork, pixel=PIXEL, region=((0.31e-3, -0.2e-3), (0.91e-3, 0.7e-3)))
    assert found.origin == (0.31e-3, -0.2e-3)
    assert (found.pixel, found.blur_px) == (PIXEL, 0.5)
    assert found.cell == pytest.approx(PIXEL / 4)
    np.testing.assert_allclose(found.values.shape, (1 + 0.9e-3 / found.cell, 1 + 0.6e-3 / found.cell), atol=1.1)
    dark, light = found.values[0, 0], found.values[-1, -1]
    rows, columns = np.nonzero(found.values > 0.5 * (int(dark) + int(light)))
    assert rows.min() == pytest.approx(0.7e-3 / found.cell, abs=1.0)
    assert columns.min() == pytest.approx(0.19e-3 / found.cell, abs=1.0)


def test_without_a_mask_all_copper_is_bare() -> None:
    found = ReflectanceMap.of(board_of(copper=(box(0.5, 0.5, 1.5, 1.5),)), pixel=PIXEL, reflectance=MATERIALS)
    assert (value_at(found, 1.0, 1.0), value_at(found, 0.2, 0.2)) == pytest.approx((0.8, 0.2), abs=1e-4)


def test_shapes_that_touch_and_overlap_have_no_seam() -> None:
    """Coverages of overlapping shapes that were added or multiplied would leave a seam along common borders."""
    parts = (box(0.2, 0.2, 1.003, 1.8), box(1.003, 0.2, 1.8, 1.8), box(0.7, 0.2, 1.4, 1.8))
    whole = ReflectanceMap.of(board_of(copper=(box(0.2, 0.2, 1.8, 1.8),)), pixel=PIXEL)
    pieces = ReflectanceMap.of(board_of(copper=parts), pixel=PIXEL)
    assert np.abs(whole.values.astype(int) - pieces.values).max() <= 1
    crossed = Shape(1e-3 * np.array([[0.2, 0.2], [1.8, 1.8], [1.8, 0.2], [0.2, 1.8]]))  # even-odd: a bow tie
    tie = ReflectanceMap.of(board_of(copper=(crossed,)), pixel=PIXEL, reflectance=MATERIALS)
    found = [value_at(tie, *place) for place in ((0.4, 1.0), (1.6, 1.0), (1.0, 0.4))]
    assert found == pytest.approx([0.8, 0.8, 0.2], abs=1e-4)


@pytest.mark.parametrize(("blur_px", "fine"), [(0.5, 4), (1.0, 3), (0.25, 8)])
def test_an_edge_has_the_blur_of_lens_and_pixel(blur_px: float, fine: int) -> None:
    artwork = board_of(copper=(box(-5.0, -5.0, 1.0, 5.0),))
    found = ReflectanceMap.of(
        artwork,
        pixel=PIXEL,
        region=((0.9e-3, 0.9e-3), (1.1e-3, 1.1e-3)),
        blur_px=blur_px,
        nodes_per_pixel=fine,
        reflectance=MATERIALS,
    )
    x = found.origin[0] + found.cell * np.arange(found.values.shape[1])
    exact = 0.2 + 0.6 * reference.edge_response((1e-3 - x) / PIXEL, 0.0, blur_px)
    # The filter is a sum over the cells: trapezoidal rule at the kinks of an edge's mean over a pixel, and cut tails.
    error = 0.6 / (30.0 * fine**2 * blur_px) + 1e-4
    np.testing.assert_allclose(found.values[found.values.shape[0] // 2] / WHITE, exact, atol=error)


def test_the_etch_bias_moves_the_edges_of_the_copper() -> None:
    artwork = board_of(copper=(box(0.5, 0.5, 1.5, 1.5), box(0.9, 0.9, 1.1, 1.1, dark=False)))
    for bias in (-17e-6, 0.0, 23e-6):
        found = ReflectanceMap.of(artwork, pixel=PIXEL, reflectance=MATERIALS, etch_bias=bias)
        light = (found.values[1:-1, 1:-1] / WHITE - 0.2).sum() * found.cell**2 / 0.6
        assert light == pytest.approx((1e-3 + 2 * bias) ** 2 - (0.2e-3 - 2 * bias) ** 2, rel=1e-4)


def test_copper_beyond_the_region_grows_into_it() -> None:
    found = ReflectanceMap.of(
        board_of([[1.2e-3, 0.0], [1.5e-3, 0.0], [1.5e-3, 1e-3], [1.2e-3, 1e-3]]),
        pixel=PIXEL,
        region=((0.0, 0.0), (1e-3, 1e-3)),
        reflectance=MATERIALS,
        etch_bias=0.3e-3,
    )
    assert (value_at(found, 0.95, 0.5), value_at(found, 0.85, 0.5)) == pytest.approx((0.8, 0.2), abs=1e-3)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"pixel": 0.0}, "pixel"),
        ({"blur_px": -1.0}, "blur_px"),
        ({"nodes_per_pixel": 0}, "nodes_per_pixel"),
        ({"region": ((0.0, 0.0), (0.0, 1.0))}, "least and then the greatest"),
        ({"region": ((0.0, 0.0), (1.0, 1.0))}, "expected 2\\^28 at most"),
    ],
)
def test_wrong_parameters_are_refused(change: dict[str, Any], match: str) -> None:
    with pytest.raises(ValueError, match=match):
        ReflectanceMap.of(board_of(), **{"pixel": PIXEL, **change})
    with pytest.raises(ValueError, match="silk"):
        replace(MATERIALS, silk=1.1)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "middle"),
    [
        ("upverter", (-50e-3, 10e-3)),
        pytest.param("fritzing", (20e-3, 25e-3), marks=pytest.mark.slow),
        pytest.param("kicad-x2-tests/x2ap", (60e-3, -45e-3), marks=pytest.mark.slow),
    ],
)
def test_real_boards_look_as_another_program_draws_them(data: Path, name: str, middle: tuple[float, float]) -> None:
    """The images of other tests: 64 samples per pixel, filtered, and resampled; shifted mask and silk."""
    artwork = read_artwork(data / "gerber" / name, clearance=100e-6)
    shape, pixel = (160, 200), 25e-6
    corner = (middle[0] - (shape[1] - 1) / 2 * pixel, middle[1] + (shape[0] - 1) / 2 * pixel)
    shifts: dict[str, Any] = {"mask_shift": (30e-6, -20e-6), "silk_shift": (-40e-6, 10e-6)}
    levels = (0.1, 0.3, 0.2, 0.8, 0.9, 0.05)
    view = View(corner=corner, pixel=pixel, shape=shape, blur_px=0.8, levels=levels, **shifts)
    drawn = board_image(artwork, view)
    half = np.array(shape[::-1]) / 2 * pixel
    found = ReflectanceMap.of(
        artwork,
        pixel=pixel,
        region=(middle - half, middle + half),
        blur_px=0.8,
        reflectance=MATERIALS,
        **shifts,
    )
    seen = reference.reflectance(
        found.values, found.origin, found.cell, pixel, reference.centred_pixels(shape), np.array([[*middle, 0.0]])
    )
    assert np.ptp(drawn) > 0.19
    # The samples of the other image leave 1/64 of the area of a pixel open along an edge.
    assert np.abs(seen - drawn).max() < 0.03
    assert np.sqrt(np.mean((seen - drawn) ** 2)) < 0.004
