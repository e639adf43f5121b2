"""Resampling of readings at other positions along the sheet, by linear interpolation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.readings import Reading
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]


def resample_reading(reading: Reading, g: npt.ArrayLike, *, max_gap: float) -> Reading:
    """Resample profiles at other positions along the sheet, by linear interpolation between neighbouring points.

    Next to a gap and at both ends of a profile, the nearest point is used up to half the median distance of points.

    Parameters
    ----------
    reading
        (samples,) or (profiles, samples).
    g
        Positions [m]: (k,) ascending, or (profiles, k), for example of the reading of another sensor. NaN gives NaN.
    max_gap
        No interpolation between points farther apart along the sheet [m]. Positions in such a gap have no value and
        the status NO_DATA.

    Returns
    -------
    Reading
        (..., k). Sigma, strength and width are also interpolated; the flags of both neighbours are combined.
    """
    at = np.broadcast_to(np.asarray(g, np.float64), (*reading.h.shape[:-1], np.shape(g)[-1]))
    lines = Interpolation.between(reading.g, np.isfinite(reading.h), at, max_gap)
    position, h, sigma, strength, width = (
        lines.values(part) for part in (reading.position, reading.h, reading.sigma, reading.strength, reading.width)
    )
    return Reading(position, np.where(lines.inside, at, np.nan), h, sigma, strength, width, lines.flags(reading.status))


class Interpolation(NamedTuple):
    """Linear interpolation at positions (..., k): both neighbours, fraction of the way, and whether it is valid."""

    left: npt.NDArray[np.intp]
    right: npt.NDArray[np.intp]
    t: Float64
    inside: npt.NDArray[np.bool_]

    @classmethod
    def between(cls, g: Float64, known: npt.NDArray[np.bool_], positions: Float64, max_gap: float) -> Interpolation:
        """Return the interpolation between known points at ``g`` (..., samples), in ascending order, at positions."""
        lines = cls(
            np.zeros(positions.shape, np.intp),
            np.zeros(positions.shape, np.intp),
            np.zeros(positions.shape),
            np.zeros(positions.shape, bool),
        )
        known = known & np.isfinite(g)
        for row in np.ndindex(positions.shape[:-1]):
            samples = np.flatnonzero(known[row])
            if samples.size:
                samples = samples[np.argsort(g[row][samples], kind="stable")]
                left, right, t, inside = _neighbours(g[row][samples], positions[row], max_gap)
                lines.left[row], lines.right[row] = samples[left], samples[right]
                lines.t[row], lines.inside[row] = t, inside
        return lines

    def values(self, of: npt.NDArray[Any]) -> Float64:
        """Return interpolated values (..., k), NaN where the interpolation is not valid."""
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        # At t = 0 and t = 1 the value of the other neighbour is not used: it may be NaN.
        with np.errstate(invalid="ignore"):
            line = np.where(self.t == 0.0, left, np.where(self.t == 1.0, right, (1.0 - self.t) * left + self.t * right))
        return np.where(self.inside, line, np.nan)

    def flags(self, of: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the combined flags of the neighbours that are used, NO_DATA where the interpolation is not valid."""
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        either = np.where(self.t < 1.0, left, 0) | np.where(self.t > 0.0, right, 0)
        return np.where(self.inside, either, int(Status.NO_DATA)).astype(np.uint8)


def _neighbours(x: Float64, at: Float64, max_gap: float) -> tuple[Any, ...]:
    """Return the left and right neighbour among ascending x, the fraction of the way, and whether it is valid."""
    right = np.clip(np.searchsorted(x, at, side="left"), min(1, len(x) - 1), len(x) - 1)
    left = np.maximum(right - 1, 0)
    width = x[right] - x[left]
    median_step = min(float(np.median(np.diff(x))), max_gap) if len(x) > 1 else max_gap
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.where(width > 0.0, (at - x[left]) / width, np.nan)
        between = (t >= 0.0) & (t <= 1.0) & (width <= max_gap)
        nearer = np.where(np.abs(at - x[left]) <= np.abs(at - x[right]), 0.0, 1.0)
        close = np.abs(at - np.where(nearer == 0.0, x[left], x[right])) <= 0.5 * median_step
    return left, right, np.where(between, t, nearer), between | close
