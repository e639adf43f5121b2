"""Pixel maps between images, packed for ``kernels/undistort_image/undistort_image.cl``.

A lens changes source positions smoothly along a row. A run of 16 output pixels is therefore packed as two cubic
polynomials (column and row) relative to an integer origin. In single precision these are exact to 1e-6 px and need a
seventh of the memory of a float pair per pixel. Runs that cubics do not fit are stored pixel by pixel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Bools = npt.NDArray[np.bool_]

# Output pixels of a run, and the codes of a run's kind: shared with undistort_image_run.h and _window.h.
RUN = 16
_POINTS, _BLANK, _WINDOW, _SCATTERED = 0, 1, 2, 6
_WIDE, _BANDED = 1, 2
_NARROW_SPAN, _LOADED = 16, 32
# Bit shifts, in the head, of the number of bands and of the starts of the windows of a run's three parts.
_SHIFTS = (8, 13, 19, 25)
_MAX_BANDS = 5
# Largest error of a cubic [px]. Derived: below the rounding of a float coordinate above 256 px (1.5e-5 px).
_CUBIC_TOLERANCE = 1e-5
# Positions up to this distance [px] below an integer count as on it; interpolation is continuous there.
_ON_PIXEL = 1e-6
# Positions are clamped to this magnitude [px]: the largest range of integers that a float holds exactly.
_FARTHEST = 2.0**24
# Rows packed in one pass, so that the intermediate arrays fit into the caches.
_ROWS_AT_ONCE = 32


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Source position of every pixel of an image (OpenCV: the maps of ``remap``).

    Parameters
    ----------
    positions : array_like
        (rows, columns, 2): column and row in the source image [px]; NaN where none exists. Stored as a read-only
        float64 copy.

    Raises
    ------
    ValueError
        The array has another shape, or no pixels.
    """

    positions: Float64

    def __post_init__(self) -> None:
        positions = np.array(self.positions, dtype=np.float64)
        if positions.ndim != 3 or positions.shape[2] != 2 or 0 in positions.shape:
            raise ValueError(f"a map of positions has shape {positions.shape}, expected (rows, columns, 2)")
        positions.flags.writeable = False
        object.__setattr__(self, "positions", positions)


class Taps(NamedTuple):
    """Numbers of source pixels that an interpolation reads before and after the integer part of a position."""

    before: int
    after: int


class PackedMap(NamedTuple):
    """Tables of a packed map for the kernel.

    Attributes
    ----------
    heads : numpy.ndarray
        (rows, runs, 4) int32: origin column and row of the run's positions, kind of the run with flag bits, and the
        status or the index into ``points``.
    curves : numpy.ndarray
        (rows, runs, 8) float32: coefficients of two cubics over the run.
    points : numpy.ndarray
        (n, 16, 2) float32: positions, relative to the origin, of the runs stored pixel by pixel; n is at least 1.
    """

    heads: npt.NDArray[np.int32]
    curves: npt.NDArray[np.float32]
    points: npt.NDArray[np.float32]


@dataclass(frozen=True)
class Packer:
    """Packer of maps into one source image.

    Parameters
    ----------
    source : (int, int)
        Rows and columns of the source image.
    taps : Taps
        Taps of the interpolation.
    channels : int
        1 or 3.
    missing : int
        Status of pixels whose position is NaN.
    outside : int or None
        Status of pixels whose position is outside the source, if their value is constant. None if their value is read
        from the border pixels.
    margin : (float, float)
        Distance beyond the outermost pixel centres, before and after, at which a position counts as outside [px].
    """

    source: tuple[int, int]
    taps: Taps
    channels: int
    missing: int
    outside: int | None
    margin: tuple[float, float]

    def pack(self, positions: Float64) -> PackedMap:
        """Pack a map of positions (rows, columns, 2) [px]."""
        parts: list[PackedMap] = []
        for first in range(0, len(positions), _ROWS_AT_ONCE):
            packed = sum(len(each.points) for each in parts)
            parts.append(self._pack_rows(positions[first : first + _ROWS_AT_ONCE], packed))
        heads, curves, points = map(np.concatenate, zip(*parts, strict=True))
        return PackedMap(heads, curves, points if len(points) else np.zeros((1, RUN, 2), np.float32))

    def _pack_rows(self, positions: Float64, points_before: int) -> PackedMap:
        runs = positions[:, run_columns(positions.shape[1])]
        finite: Bools = np.asarray(np.isfinite(runs).all(-1))
        runs = np.where(finite[..., None], np.clip(runs, -_FARTHEST, _FARTHEST), 0.0)
        base = self._bases(runs, finite)
        offsets = runs - base[:, :, None]
        curves, fits = _cubics(offsets)
        kind, bits = self._windows(base, offsets, fits)
        kind = np.where(finite.all(-1) & (positions.shape[1] >= RUN), kind, _POINTS)
        kind, number = self._blanks(runs, finite, kind)
        heads = np.empty((*kind.shape, 4), np.int32)
        heads[..., :2] = base
        heads[..., 2] = kind | bits
        listed = (kind == _POINTS) | (kind == _SCATTERED)
        heads[..., 3] = np.where(listed, points_before + np.cumsum(listed).reshape(listed.shape) - 1, number)
        points = np.where(finite[..., None], offsets, np.nan)[listed]
        return PackedMap(heads, curves.astype(np.float32), points.astype(np.float32))

    def _bases(self, runs: Float64, finite: Bools) -> Float64:
        """Return the integer origin (column, row) of each run, (rows, runs, 2), moved into the image if next to it."""
        lowest = np.min(np.where(finite[..., None], runs, np.inf), axis=2)
        base = np.floor(np.where(np.isfinite(lowest), lowest, 0.0) + _ON_PIXEL)
        # A position on the last pixel is the upper end of the interval before it.
        last = np.array(self.source[::-1]) - 1
        return np.asarray(np.where((base == last) & (last > 0), base - 1, base))

    def _windows(self, base: Float64, offsets: Float64, fits: Bools) -> tuple[Ints, Ints]:
        """Return the kind of window that covers each run's taps, and its bands and starts as bits of the head."""
        before, after = self.taps
        rows, columns = self.source
        column, row = np.moveaxis(base.astype(np.intp), -1, 0)
        intervals_x, intervals_y = np.moveaxis(np.maximum(_ends(offsets, axis=2), 1), -1, 0)
        inside = (column >= before) & (row >= before)
        inside &= (column + intervals_x - 1 + after < columns) & (row + intervals_y - 1 + after < rows)
        starts, spans = self._parts(offsets[..., 0])
        wide = self.channels * spans > _NARROW_SPAN
        window = fits & inside & (self.channels * spans <= _LOADED - self.channels + 1) & (intervals_y <= _MAX_BANDS)
        last = (row + intervals_y - 1 + after) * columns + column + starts.max(axis=0) + after
        window &= self.channels * last + np.where(wide, _LOADED, _NARROW_SPAN) <= self.channels * rows * columns
        # Single precision may round an offset up to the next pixel; inside a window the offset is clamped.
        roomy = inside & (column + intervals_x + after < columns) & (row + intervals_y + after < rows)
        kind = np.where(
            window, _WINDOW + _WIDE * wide + _BANDED * (intervals_y > 1), np.where(roomy, _SCATTERED, _POINTS)
        )
        bits = np.zeros_like(kind)
        for number, shift in zip((intervals_y, *starts), _SHIFTS, strict=False):
            bits |= np.where(window, number, 0) << shift
        return kind, bits

    def _parts(self, x: Float64) -> tuple[Ints, Ints]:
        """Return the window start of each vector of 16 samples, (1 or 3, rows, runs), and the widest span."""
        if self.channels == 1:
            return np.zeros((1, *x.shape[:2]), np.intp), np.maximum(_ends(x, axis=2), 1)
        parts = (x[..., :6], x[..., 5:11], x[..., 10:])
        starts = np.array([np.floor(part.min(axis=2) + _ON_PIXEL) for part in parts], np.intp)
        return starts, np.max([_ends(part, axis=2) for part in parts] - starts, axis=0)

    def _blanks(self, runs: Float64, finite: Bools, what: Ints) -> tuple[Ints, Ints]:
        """Mark runs without any source pixel, and return their status."""
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
    """Return the upper end of the unit interval that contains the largest offset."""
    ends: Ints = np.ceil(offsets.max(axis=axis) - _ON_PIXEL).astype(np.intp)
    return ends


def _cubics(offsets: Float64) -> tuple[Float64, Bools]:
    """Fit cubics to offsets (..., 16, 2); return coefficients (..., 8) and whether the error is within tolerance."""
    powers = np.vander(np.arange(RUN) - 0.5 * (RUN - 1), 4, increasing=True)
    x, y = np.moveaxis(offsets, -1, 0)
    inverse = np.linalg.pinv(powers).T
    curves = [(part @ inverse).astype(np.float32) for part in (x, y)]
    errors = [np.abs(curve @ powers.T - part).max(axis=-1) for curve, part in zip(curves, (x, y), strict=True)]
    return np.concatenate(curves, axis=-1), np.maximum(*errors) <= _CUBIC_TOLERANCE
