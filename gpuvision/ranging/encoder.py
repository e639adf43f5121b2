"""Positions that an encoder measured, one for each profile: their order and their regularity."""

from __future__ import annotations

import bisect
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

# Variance of a second difference of positions with independent errors, relative to the variance of an error: 1 + 4 + 1.
_SECOND_DIFFERENCE_VARIANCE = 6.0


@dataclass(frozen=True, kw_only=True)
class EncoderStatistics:
    """Regularity of the positions of an encoder, in the unit of the positions [m or rad].

    Attributes
    ----------
    profiles : int
        Number of positions.
    not_advancing : int
        Number of profiles that `not_advancing` marks.
    step_mean, step_std, step_smallest, step_largest : float
        Mean, standard deviation and extremes of the distance from a profile to the next one, with the sign of the
        motion; NaN for one profile.
    jitter : float
        Standard deviation of the error of a position, if the motion is smooth, from the second differences:
        ``sqrt(mean((p[k-1] - 2 p[k] + p[k+1])^2) / 6)``. A changing speed adds nothing in first order; the rounding to
        counts does. NaN for fewer than three profiles.
    """

    profiles: int
    not_advancing: int
    step_mean: float
    step_std: float
    step_smallest: float
    step_largest: float
    jitter: float

    @classmethod
    def from_positions(cls, positions: Float64) -> EncoderStatistics:
        """Compute the statistics of positions, (profiles,)."""
        steps = np.diff(positions)
        bends = np.diff(steps)
        return cls(
            profiles=len(positions),
            not_advancing=int(np.count_nonzero(not_advancing(positions))),
            step_mean=float(np.mean(steps)) if steps.size else math.nan,
            step_std=float(np.std(steps)) if steps.size else math.nan,
            step_smallest=float(np.min(steps)) if steps.size else math.nan,
            step_largest=float(np.max(steps)) if steps.size else math.nan,
            jitter=math.sqrt(float(np.mean(bends**2)) / _SECOND_DIFFERENCE_VARIANCE) if bends.size else math.nan,
        )


def unwrapped_counts(counts: npt.ArrayLike, bits: int, what: str = "the encoder") -> Float64:
    """Return the counts of a counter that wraps around, without the jumps.

    Parameters
    ----------
    counts : array_like
        (profiles,): counts of a counter of some bits, unsigned or signed (two's complement).
    bits : int
        Bits of the counter: after ``2**bits`` counts it starts again.
    what : str
        Name of the counter for messages.

    Returns
    -------
    numpy.ndarray
        (profiles,) float64: the first count, and from there the sums of the steps. A step is taken as the shorter way,
        less than ``2**(bits - 1)`` counts.

    Raises
    ------
    ValueError
        A count does not fit the bits.
    """
    read = np.asarray(counts, dtype=np.float64)
    lowest, highest = -(2.0 ** (bits - 1)), 2.0**bits
    wrong = (read < lowest) | (read >= highest)
    if np.any(wrong):
        place = int(np.argmax(wrong))
        raise ValueError(f"{what}: count {read[place]:.0f} of profile {place} does not fit {bits} bits")
    return np.asarray(np.unwrap(read, period=2.0**bits))


def not_advancing(positions: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Find the profiles that do not advance: the smallest set without which the positions are strictly monotone.

    The direction is chosen so that the set is smallest; of two equally small sets, ascending.

    Parameters
    ----------
    positions : array_like
        Positions, (profiles,), finite.

    Returns
    -------
    numpy.ndarray
        (profiles,) bool: True where a profile repeats a position, or the motion runs backwards. A single wrong position
        marks one profile only, not the profiles after it.

    Notes
    -----
    The other profiles are a longest strictly increasing subsequence, found in ``O(n log n)``.

    References
    ----------
    M. L. Fredman, *On computing the length of longest increasing subsequences*, Discrete Mathematics 11 (1975) 29-35.

    Examples
    --------
    >>> not_advancing([0.0, 1.0, 9.0, 2.0, 2.0, 3.0]).tolist()
    [False, False, True, False, True, False]
    """
    values = np.asarray(positions, dtype=np.float64)
    ascending, descending = _longest_increasing(values), _longest_increasing(-values)
    kept = ascending if len(ascending) >= len(descending) else descending
    mask = np.ones(len(values), dtype=np.bool_)
    mask[kept] = False
    return mask


def _longest_increasing(values: Float64) -> list[int]:
    """Return the numbers of a longest strictly increasing subsequence, in descending order."""
    last_values: list[float] = []  # smallest last value of a subsequence of each length
    last_numbers: list[int] = []
    before = [-1] * len(values)
    for number, value in enumerate(values.tolist()):
        length = bisect.bisect_left(last_values, value)
        before[number] = last_numbers[length - 1] if length else -1
        if length == len(last_values):
            last_values.append(value)
            last_numbers.append(number)
        elif value < last_values[length]:  # of equal values the first one stays
            last_values[length], last_numbers[length] = value, number
    kept = []
    number = last_numbers[-1] if last_numbers else -1
    while number >= 0:
        kept.append(number)
        number = before[number]
    return kept
