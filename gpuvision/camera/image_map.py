"""Pixel maps between images, packed for ``kernels/undistort_image/undistort_image.cl``.

A lens bends a row of pixels gently, so a run of 16 of them is packed as two cubics, which single precision holds to a
millionth of a pixel where a float per coordinate does not, in a seventh of the memory. What cubics do not describe is
kept pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

# As in undistort_image_run.h and undistort_image_window.h.
RUN = 16
_POINTS, _BLANK, _WINDOW, _SCATTERED = 0, 1, 2, 6
_WIDE, _BANDED = 1, 2
_NARROW_SPAN, _LOADED = 16, 32
_SHIFTS = (8, 13, 19, 25)  # of the number of bands, and of the places where the windows of the thirds begin
_MOST_BANDS = 5
# How far a cubic may miss a place [px]: below what a float of a coordinate beyond 256 rounds away.
_CUBIC_TOLERANCE = 1e-5
# Places this near before a whole pixel count as on it [px]; interpolation is continuous there.
_ON_PIXEL = 1e-6
# Places are kept within so many pixels: a whole number that a float holds.
_FARTHEST = 2.0**24
_ROWS_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Where each pixel of an image lies in another one.

    Parameters
    ----------
    places
        (rows, columns, 2): column and row in the source image [px]; NaN where there is none. Kept as a read-only copy.

    Raises
    ------
    ValueError
        The shape is another one, or has no pixel.
    """

    places: Float64

    def __post_init__(self) -> None:
        places = np.array(self.places, dtype=np.float64)
        if places.ndim != 3 or places.shape[2] != 2 or 0 in places.shape:
            raise ValueError(f"a map of places has shape {places.shape}, expected (rows, columns, 2)")
        places.flags.writeable = False
        object.__setattr__(self, "places", places)


class Taps(NamedTuple):
    """What an interpolation reads around a place: so many pixels before and after its whole part."""

    before: int
    after: int


class PackedMap(NamedTuple):
    """Tables for the kernel.

    Attributes
    ----------
    heads
        (rows, runs, 4) int32: column and row that places count from, what to do, and a number.
    curves
        (rows, runs, 8) float32: coefficients of two cubics over the run.
    points
        (n, 16, 2) float32: places of the runs that cubics do not describe; at least one.
    """

    heads: npt.NDArray[np.int32]
    curves: npt.NDArray[np.float32]
    points: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Packer:
    """Packs maps for one source.

    Parameters
    ----------
    source
        (rows, columns) of the source image.
    taps
        Of the interpolation.
    channels
        1 or 3.
    missing
        Status of pixels whose place is NaN.
    outside
        Status of pixels whose place is outside, where these need not be looked up; None where they must be.
    margin
        How far outside the image's outermost pixels that is [px].
    """

    source: tuple[int, int]
    taps: Taps
    channels: int
    missing: int
    outside: int | None
    margin: tuple[float, float]

    def pack(self, places: Float64) -> PackedMap:
        """Pack a map (rows, columns, 2)."""
        parts: list[PackedMap] = []
        for first in range(0, len(places), _ROWS_AT_ONCE):
            packed = sum(len(each.points) for each in parts)
            parts.append(self._pack_rows(places[first : first + _ROWS_AT_ONCE], packed))
        heads, curves, points = map(np.concatenate, zip(*parts, strict=True))
        return PackedMap(heads, curves, points if len(points) else np.zeros((1, RUN, 2), np.float32))

    def _pack_rows(self, places: Float64, points_before: int) -> PackedMap:
        runs = places[:, run_columns(places.shape[1])]
        finite: Bools = np.asarray(np.isfinite(runs).all(-1))
        runs = np.where(finite[..., None], np.clip(runs, -_FARTHEST, _FARTHEST), 0.0)
        base = self._bases(runs, finite)
        offsets = runs - base[:, :, None]
        curves, fits = _cubics(offsets)
        what, bits = self._windows(base, offsets, fits)
        what = np.where(finite.all(-1) & (places.shape[1] >= RUN), what, _POINTS)
        what, number = self._blanks(runs, finite, what)
        heads = np.empty((*what.shape, 4), np.int32)
        heads[..., :2] = base
        heads[..., 2] = what | bits
        listed = (what == _POINTS) | (what == _SCATTERED)
        heads[..., 3] = np.where(listed, points_before + np.cumsum(listed).reshape(listed.shape) - 1, number)
        points = np.where(finite[..., None], offsets, np.nan)[listed]
        return PackedMap(heads, curves.astype(np.float32), points.astype(np.float32))

    def _bases(self, runs: Float64, finite: Bools) -> Float64:
        """Column and row, (rows, runs, 2), of a run's first left upper tap, moved into the image where it is near."""
        lowest = np.min(np.where(finite[..., None], runs, np.inf), axis=2)
        base = np.floor(np.where(np.isfinite(lowest), lowest, 0.0) + _ON_PIXEL)
        # A place on the last pixel is the end of the gap before it.
        last = np.array(self.source[::-1]) - 1
        return np.asarray(np.where((base == last) & (last > 0), base - 1, base))

    def _windows(self, base: Float64, offsets: Float64, fits: Bools) -> tuple[Ints, Ints]:
        """Which window serves each run, if any, and what the kernel has to know of it, as bits of the head."""
        before, after = self.taps
        rows, columns = self.source
        column, row = np.moveaxis(base.astype(np.intp), -1, 0)
        gaps_x, gaps_y = np.moveaxis(np.maximum(_ends(offsets, axis=2), 1), -1, 0)
        inside = (column >= before) & (row >= before)
        inside &= (column + gaps_x - 1 + after < columns) & (row + gaps_y - 1 + after < rows)
        starts, spans = self._parts(offsets[..., 0])
        wide = self.channels * spans > _NARROW_SPAN
        window = fits & inside & (self.channels * spans <= _LOADED - self.channels + 1) & (gaps_y <= _MOST_BANDS)
        last = (row + gaps_y - 1 + after) * columns + column + starts.max(axis=0) + after
        window &= self.channels * last + np.where(wide, _LOADED, _NARROW_SPAN) <= self.channels * rows * columns
        # Single precision may round an offset up to the next pixel; in a window that is held back.
        roomy = inside & (column + gaps_x + after < columns) & (row + gaps_y + after < rows)
        what = np.where(window, _WINDOW + _WIDE * wide + _BANDED * (gaps_y > 1), np.where(roomy, _SCATTERED, _POINTS))
        bits = np.zeros_like(what)
        for number, shift in zip((gaps_y, *starts), _SHIFTS, strict=False):
            bits |= np.where(window, number, 0) << shift
        return what, bits

    def _parts(self, x: Float64) -> tuple[Ints, Ints]:
        """Where the window of each vector of 16 samples begins, (1 or 3, rows, runs), and the widest one's gaps."""
        if self.channels == 1:
            return np.zeros((1, *x.shape[:2]), np.intp), np.maximum(_ends(x, axis=2), 1)
        parts = (x[..., :6], x[..., 5:11], x[..., 10:])
        starts = np.array([np.floor(part.min(axis=2) + _ON_PIXEL) for part in parts], np.intp)
        return starts, np.max([_ends(part, axis=2) for part in parts] - starts, axis=0)

    def _blanks(self, runs: Float64, finite: Bools, what: Ints) -> tuple[Ints, Ints]:
        """Mark runs without any source, and return their status."""
        number = np.zeros(what.shape, np.intp)
        missing = np.asarray(~finite.any(-1))
        what, number = np.where(missing, _BLANK, what), np.where(missing, self.missing, number)
        if self.outside is not None:
            low, high = -self.margin[0] - _ON_PIXEL, np.array(self.source[::-1]) - 1 + self.margin[1] + _ON_PIXEL
            outside = (((runs < low) | (runs > high)).any(-1) & finite).all(-1)
            what, number = np.where(outside, _BLANK, what), np.where(outside, self.outside, number)
        return what, number


def run_columns(columns: int) -> Ints:
    """Return the output columns of each run, (runs, 16): the last one moves back to end with the row."""
    starts = np.minimum(np.arange(0, columns, RUN), max(columns - RUN, 0))
    return np.minimum(starts[:, None] + np.arange(RUN), columns - 1)


def _ends(offsets: Float64, axis: int) -> Ints:
    """Return the end of the gap in which the largest offset lies."""
    ends: Ints = np.ceil(offsets.max(axis=axis) - _ON_PIXEL).astype(np.intp)
    return ends


def _cubics(offsets: Float64) -> tuple[Float64, Bools]:
    """Coefficients (..., 8) of cubics through offsets (..., 16, 2), and where they are good enough."""
    powers = np.vander(np.arange(RUN) - 0.5 * (RUN - 1), 4, increasing=True)
    x, y = np.moveaxis(offsets, -1, 0)
    inverse = np.linalg.pinv(powers).T
    curves = [(part @ inverse).astype(np.float32) for part in (x, y)]
    errors = [np.abs(curve @ powers.T - part).max(axis=-1) for curve, part in zip(curves, (x, y), strict=True)]
    return np.concatenate(curves, axis=-1), np.maximum(*errors) <= _CUBIC_TOLERANCE
