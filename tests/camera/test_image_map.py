"""Packed maps of source positions: kind, window and positions of each run of 16 pixels, by loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import pytest

from gpuvision.camera.image_map import Packer, PixelMap, Taps, run_columns
from gpuvision.camera.undistort_image import UndistortImage

POINTS, BLANK, WINDOW, SCATTERED = 0, 1, 2, 6
MISSING, OUTSIDE = 64, 4
SOURCE = (60, 90)


class Run(NamedTuple):
    """Expected head of a run, without the index of its points."""

    origin: tuple[int, int]
    kind: int
    bits: int
    number: int | None


def ends(low: float, high: float) -> tuple[int, int]:
    """Return the first pixel of positions, and the last one that interpolation reads without taps beside it."""
    return math.floor(low + 1e-6), math.ceil(high - 1e-6)


def run_of(places: np.ndarray, packer: Packer, is_smooth: bool, columns_of_map: int) -> Run:
    """Return the head of a run of positions (16, 2) that cubics fit, or do not."""
    rows, columns = packer.source
    finite = np.isfinite(places).all(axis=1)
    known = places[finite]
    if not finite.any():
        return Run((0, 0), BLANK, 0, packer.missing)
    origin = []
    for axis, size in ((0, columns), (1, rows)):
        first, _ = ends(known[:, axis].min(), 0.0)
        origin.append(first - 1 if first == size - 1 else first)  # the last pixel ends the interval before it
    offset = known - origin
    across, down = (max(ends(0.0, each)[1], 1) for each in offset.max(axis=0))
    before, after = packer.taps
    inside = min(origin) >= before
    inside &= origin[0] + across - 1 + after < columns and origin[1] + down - 1 + after < rows
    roomy = inside and origin[0] + across + after < columns and origin[1] + down + after < rows
    starts, span = [0], across
    if packer.channels > 1 and finite.all():
        parts = [offset[first : last + 1, 0] for first, last in ((0, 5), (5, 10), (10, 15))]
        starts = [ends(part.min(), 0.0)[0] for part in parts]
        span = max(ends(0.0, part.max())[1] - start for part, start in zip(parts, starts, strict=True))
    loaded = 16 if packer.channels * span <= 16 else 32
    last = (origin[1] + down - 1 + after) * columns + origin[0] + max(starts) + after
    fits = is_smooth and inside and packer.channels * span <= 33 - packer.channels and down <= 5
    fits &= packer.channels * last + loaded <= packer.channels * rows * columns
    kind, bits = POINTS, 0
    if finite.all() and columns_of_map >= 16:
        kind = WINDOW + (loaded == 32) + 2 * (down > 1) if fits else SCATTERED if roomy else POINTS
    if fits and finite.all():  # the kernel reads the bits of windows only
        for value, shift in zip((down, *starts), (8, 13, 19, 25), strict=False):
            bits |= value << shift
    if packer.outside is not None and finite.all():
        low, high = -packer.margin[0] - 1e-6, np.array([columns - 1, rows - 1]) + packer.margin[1] + 1e-6
        if ((places < low) | (places > high)).any(axis=1).all():
            return Run((origin[0], origin[1]), BLANK, bits, packer.outside)
    return Run((origin[0], origin[1]), kind, bits, None)


def checked(positions: np.ndarray, packer: Packer, *, is_smooth: bool = True) -> set[int]:
    """Compare a packed map with the loops; return the kinds of its runs."""
    packed = packer.pack(positions)
    rows, columns = positions.shape[:2]
    first = sorted({min(16 * k, max(columns - 16, 0)) for k in range(-(-columns // 16))})
    lanes = [np.minimum(start + np.arange(16), columns - 1) for start in first]
    np.testing.assert_array_equal(run_columns(columns), lanes)
    assert packed.heads.shape == (rows, len(first), 4)
    kinds, count = set(), 0
    for row in range(rows):
        for number, lane in enumerate(lanes):
            places = positions[row, lane]
            expected = run_of(places, packer, is_smooth, columns)
            head, where = packed.heads[row, number], (row, number, expected)
            kind = int(head[2]) & 0xFF
            kinds.add(kind)
            assert kind == expected.kind, where
            if kind == BLANK:
                assert head[3] == expected.number, where
                continue
            assert tuple(head[:2]) == expected.origin, where
            if kind in (POINTS, SCATTERED):
                assert head[3] == count, where
                np.testing.assert_allclose(packed.points[count] + expected.origin, places, rtol=0, atol=1e-4)
                count += 1
                continue
            assert int(head[2]) & ~0xFF == expected.bits, where
            # Cubics about the middle of the run, for the column and for the row.
            powers = np.vander(np.arange(16) - 7.5, 4, increasing=True)
            moved = powers @ packed.curves[row, number].reshape(2, 4).T.astype(float)
            np.testing.assert_allclose(moved + expected.origin, places, rtol=0, atol=2e-5)
    assert len(packed.points) == max(count, 1)
    return kinds


def turned(shape: tuple[int, int], zoom: float, angle: float, shift: tuple[float, float]) -> np.ndarray:
    """Return positions of a scaled and rotated image, with a slight curvature."""
    row, column = np.indices(shape).astype(float)
    cos, sin = zoom * math.cos(angle), zoom * math.sin(angle)
    x, y = cos * column - sin * row + shift[0], sin * column + cos * row + shift[1]
    return np.stack([x + 1e-4 * column * row, y - 1e-4 * row**2], axis=-1)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("taps", [Taps(0, 1), Taps(1, 2)])
@pytest.mark.parametrize("outside", [None, OUTSIDE])
def test_runs_of_scaled_and_rotated_maps(channels: int, taps: Taps, outside: int | None) -> None:
    """Narrow, wide and banded windows, scattered runs, points at the border, and runs beyond it."""
    packer = Packer(SOURCE, taps, channels, MISSING, outside, (0.5, 0.25))
    kinds = set()
    for zoom, angle, shift in (
        (1.0, 0.0, (3.25, 4.5)),
        (0.6, 0.1, (20.0, 3.0)),
        (0.9, 0.3, (12.0, 2.3)),
        (2.03, -0.2, (-20.3, 40.7)),
        (1.9, 0.02, (1.0, 1.0)),
        (4.0, 0.5, (-60.0, -30.0)),
        (0.3, -0.9, (70.0, 55.0)),
    ):
        kinds |= checked(turned((35, 50), zoom, angle, shift), packer)
    assert kinds == {POINTS, *range(WINDOW, SCATTERED + 1), *([] if outside is None else [BLANK])}


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("columns", [1, 9, 16, 17, 40])
def test_runs_with_missing_positions(channels: int, columns: int, rng: np.random.Generator) -> None:
    """A run with a missing position, or of a narrow map, is stored by pixel; a run of missing positions is blank."""
    packer = Packer(SOURCE, Taps(0, 1), channels, MISSING, OUTSIDE, (0.0, 0.0))
    positions = turned((40, columns), 1.2, 0.2, (5.0, 4.0))
    positions[rng.random((40, columns)) < 0.02] = np.nan
    positions[7:9], positions[12, :, 1] = np.nan, np.inf
    checked(positions, packer)


def test_positions_that_no_cubic_fits(rng: np.random.Generator) -> None:
    """Stored by pixel; the index of the points goes on over blocks of 32 rows."""
    packer = Packer(SOURCE, Taps(1, 2), 1, MISSING, None, (0.0, 0.0))
    positions = turned((70, 33), 0.9, 0.1, (20.0, 2.0)) + rng.uniform(-0.2, 0.2, (70, 33, 2))
    assert checked(positions, packer, is_smooth=False) == {POINTS, SCATTERED}


@pytest.mark.parametrize("place", [0.0, 2.0, 3.5, 58.0, 59.0])
def test_positions_on_pixels(place: float) -> None:
    """A position on a pixel needs the one interval beside it; the last pixel ends the interval before it."""
    packer = Packer(SOURCE, Taps(0, 1), 1, MISSING, None, (0.0, 0.0))
    columns, rows = np.meshgrid(np.arange(74.0), np.full(3, place))
    for shift in (0.0, 5e-7, -5e-7, 16.0):
        checked(np.stack([columns + shift, rows + np.array([0.0, 5e-7, -5e-7])[:, None]], axis=-1), packer)


def test_far_positions_are_limited() -> None:
    packer = Packer(SOURCE, Taps(0, 1), 1, MISSING, OUTSIDE, (0.0, 0.0))
    packed = packer.pack(np.full((1, 16, 2), [3e9, -3e9]))
    assert packed.heads[0, 0].tolist() == [1 << 24, -(1 << 24), BLANK | packed.heads[0, 0, 2] & ~0xFF, OUTSIDE]


@pytest.mark.parametrize("shape", [(3, 4), (3, 4, 3), (0, 4, 2), (3, 0, 2), (3, 4, 2, 1)])
def test_other_shapes_are_no_map(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="expected \\(rows, columns, 2\\)"):
        PixelMap(np.zeros(shape))


def test_a_map_keeps_its_positions() -> None:
    given = np.zeros((3, 4, 2), np.float32)
    kept = PixelMap(given)
    given[:] = 1.0
    assert (kept.positions.dtype, kept.positions.any()) == (np.float64, False)
    with pytest.raises(ValueError, match="read-only"):
        kept.positions[0, 0, 0] = 1.0


@pytest.mark.parametrize("region", [(0, 0, 5, 4), (0, 0, 1, 1), (4, 3, 1, 1), (2, 1, 3, 3)])
def test_a_region_lies_within_the_map(region: tuple[int, int, int, int]) -> None:
    """Column, row, columns, rows of a map of 5 x 4 pixels; a step over each of its borders is refused."""
    positions = np.stack(np.meshgrid(np.arange(5.0), 10.0 * np.arange(4.0)), axis=-1)
    left, top, width, height = region
    cut = UndistortImage(model=positions, region=region).source_positions((60, 90))
    np.testing.assert_array_equal(cut, positions[top : top + height, left : left + width])
    beyond = [(-1, top, width, height), (left, -1, width, height)]
    beyond += [(6 - width, top, width, height), (left, 5 - height, width, height)]
    for outside in beyond:
        with pytest.raises(ValueError, match=r"UndistortImage\.region \(.*\) leaves the map of 5 x 4 pixels"):
            UndistortImage(model=positions, region=outside).source_positions((60, 90))
