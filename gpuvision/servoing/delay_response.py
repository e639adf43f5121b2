"""Response of a servo loop with a delay: root locus, step response, jitter of the delay, delay against frame time.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.3.6 and
   appendix A.
.. [2] O. L. V. Costa, M. D. Fragoso and R. P. Marques, *Discrete-Time Markov Jump Linear Systems*, Springer 2005,
   chapter 3 (mean-square stability).
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import toeplitz
from scipy.signal import lfilter

from gpuvision.servoing.delay import DelayBudget, characteristic_polynomial, closed_loop, delay_taps, gain_limit
from gpuvision.validation import finite, integer

Float64 = npt.NDArray[np.float64]

# Steps of the scan and of the bisection for the gain: the last interval is 1e-8 of the scanned range.
_SCANS, _BISECTIONS = 24, 22
# Trapezoids over a normal distribution of the delay, and their range [sigma] (chosen): the limits of 81 and of 401
# differ by less than 0.2 %, and the tail beyond 4 sigma has a probability of 6e-5.
_NODES, _RANGE = 81, 4.0
# Longest step response that is searched for the settling [frames] (chosen): an hour at 1 kHz, 30 MB an array.
_MAX_FRAMES = 3_600_000


def root_locus(delay: float, gains: npt.ArrayLike) -> npt.NDArray[np.complex128]:
    """Return the roots of the loop for each gain.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.
    gains : array_like
        (m,) gains: fraction of the error that one frame corrects.

    Returns
    -------
    numpy.ndarray
        (m, order) complex roots, the slowest root (largest magnitude) first. The loop is stable if all are inside the
        unit circle.
    """
    found = [np.roots(characteristic_polynomial(delay, gain)) for gain in np.atleast_1d(np.asarray(gains, np.float64))]
    return np.array([each[np.argsort(-np.abs(each))] for each in found])


def step_response(
    delay: float, gain: float, frames: int, *, integral: float = math.inf, derivative: float = 0.0, lag: float = 0.0
) -> Float64:
    """Return the error in each frame after a step of the target by 1.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.
    gain : float
        Fraction of the error that one frame corrects.
    frames : int
        Number of frames, 1 or more.
    integral, derivative : float
        Time constants of a PI or PID controller [frames], as for `closed_loop`. Default: a proportional controller.
    lag : float
        Time constant with which the velocity of the plant follows the command [frames], default 0.

    Returns
    -------
    numpy.ndarray
        (frames,): error at the frame; the first one is 1. The head rested before the step: frames that were exposed
        before it show an error of 1, too.
    """
    count = integer(frames, "frames", minimum=1)
    # The position x follows x[k+1] = x[k] + gain (1 - delayed x[k]) from x = 0.
    numerator, denominator = closed_loop(delay, gain, integral=integral, derivative=derivative, lag=lag)
    return 1.0 - np.asarray(lfilter(numerator, denominator, np.ones(count)), np.float64)


def settling_frames(
    delay: float,
    gain: float,
    tolerance: float,
    *,
    integral: float = math.inf,
    derivative: float = 0.0,
    lag: float = 0.0,
) -> int:
    """Return the number of frames after which the error of a step of 1 stays within a tolerance.

    Parameters
    ----------
    delay, gain : float
        As for `step_response`; the loop must be stable.
    tolerance : float
        Largest error as a fraction of the step, above 0 and below 1.
    integral, derivative, lag : float
        As for `step_response`.

    Raises
    ------
    ValueError
        The loop is not stable, the tolerance is out of range, or the search takes more than 3.6 million frames.
    """
    tolerance = finite(tolerance, "tolerance", above=0.0, maximum=1.0)
    poles = np.roots(closed_loop(delay, gain, integral=integral, derivative=derivative, lag=lag).denominator)
    slowest = float(np.abs(poles).max(initial=0.0)) if gain > 0.0 else 1.0
    if slowest >= 1.0 - 1e-12:  # rounding of np.roots at double roots is below 1e-7 of the root's distance
        raise ValueError(f"the loop with delay {delay:g} frames and gain {gain:g} is not stable: no settling time")
    # A double root decays as k r^k: twice the frames of r^k and some for the delay cover it; then double until it fits.
    count = math.ceil(2.0 * math.log(tolerance) / math.log(slowest)) if slowest > 0.0 else 0
    count += 4 * (math.ceil(delay) + 2)
    while count <= _MAX_FRAMES:
        error = step_response(delay, gain, count, integral=integral, derivative=derivative, lag=lag)
        outside = np.flatnonzero(np.abs(error) > tolerance)
        if outside.size == 0 or outside[-1] < count // 2:
            return int(outside[-1]) + 1 if outside.size else 0
        count *= 2
    raise ValueError(
        f"the loop with delay {delay:g} frames and gain {gain:g} does not settle within {_MAX_FRAMES // 2} frames; "
        "raise the gain"
    )


class JitterMoments(NamedTuple):
    """First two moments of the taps of a random delay: position k frames ago has the weight tap[k].

    Attributes
    ----------
    mean : numpy.ndarray
        (n,): mean of the taps.
    square : numpy.ndarray
        (n, n): mean of the products of two taps.
    """

    mean: Float64
    square: Float64


def jitter_moments(delays: npt.ArrayLike, probabilities: npt.ArrayLike | None = None) -> JitterMoments:
    """Return the moments of the taps of a random delay that is independent from frame to frame.

    Parameters
    ----------
    delays : array_like
        (m,) delays [frames], 0 or more.
    probabilities : array_like, optional
        (m,) probability of each delay; their sum is 1. Default: equal.
    """
    values = np.atleast_1d(np.asarray(delays, np.float64))
    weights = np.full(len(values), 1.0 / len(values)) if probabilities is None else np.asarray(probabilities, float)
    if weights.shape != values.shape or np.any(weights < 0.0) or not math.isclose(weights.sum(), 1.0, rel_tol=1e-9):
        raise ValueError("probabilities must be one number of 0 or more for each delay, with the sum 1")
    taps = np.zeros((len(values), math.floor(values.max()) + 2))
    for row, delay in zip(taps, values, strict=True):
        whole, part = delay_taps(float(delay))
        row[whole], row[whole + 1] = 1.0 - part, part
    return JitterMoments(weights @ taps, taps.T @ (weights[:, None] * taps))


def normal_delays(mean: float, sigma: float) -> tuple[Float64, Float64]:
    """Return delays (n,) and probabilities (n,) that stand for a normal distribution; delays below 0 become 0.

    Parameters
    ----------
    mean, sigma : float
        Mean and standard deviation of the delay [frames]. Range: 0 or more.
    """
    nodes = np.linspace(-_RANGE, _RANGE, _NODES)
    weights = np.exp(-0.5 * nodes**2)
    delays = finite(mean, "mean", minimum=0.0) + finite(sigma, "sigma", minimum=0.0) * nodes
    return np.maximum(delays, 0.0), weights / weights.sum()


def _is_mean_square_stable(moments: JitterMoments, gain: float) -> bool:
    """Return whether the mean square of the error decays.

    The new position is ``x[t + 1] = x[t] - gain sum(tap[k] x[t - k])`` with random taps. Their mean gives a filter, and
    their scatter adds noise to the new position, with the variance ``gain^2 sum(C[i, j] x[t - i] x[t - j])`` and the
    covariance C of the taps. The mean square decays if the filter is stable and turns noise of variance 1 into
    positions that cause noise of a variance below 1 [2]_: ``gain^2 sum(C[i, j] r[|i - j|]) < 1``. The autocovariances r
    of the positions follow from the Yule-Walker equations.
    """
    size = len(moments.mean)
    filter_taps = -gain * moments.mean
    filter_taps[0] += 1.0
    if np.abs(np.roots(np.append(1.0, -filter_taps))).max(initial=0.0) >= 1.0:
        return False
    row, tap = np.indices((size + 1, size))
    equations = np.eye(size + 1)
    np.subtract.at(equations, (row, np.abs(row - 1 - tap)), filter_taps[tap])
    r = np.linalg.solve(equations, np.eye(size + 1)[0])
    covariance = moments.square - np.outer(moments.mean, moments.mean)
    return bool(gain**2 * np.sum(covariance * toeplitz(r[:size])) < 1.0)


def jitter_gain_limit(delays: npt.ArrayLike, probabilities: npt.ArrayLike | None = None) -> float:
    """Return the gain from which on a loop with a random delay is not mean-square stable.

    Parameters
    ----------
    delays, probabilities : array_like
        Distribution of the delay [frames], independent from frame to frame; see `jitter_moments`, `normal_delays`.

    Notes
    -----
    The loop is mean-square stable at small gains; the first gain at which it is not is found by scanning up to the
    largest limit of any of the delays, then by bisection. Jitter of about a frame can raise the limit: the mean over
    several positions damps. It does not lower the noise of the error. Time: 0.1 s at 20 frames, 2 s at 200.
    """
    moments = jitter_moments(delays, probabilities)
    largest = 1.01 * max(gain_limit(float(each)) for each in np.atleast_1d(np.asarray(delays, np.float64)))
    steps = np.linspace(0.0, largest, _SCANS + 1)[1:]
    high = next((float(each) for each in steps if not _is_mean_square_stable(moments, float(each))), largest)
    low = max(high - float(steps[0]), 1e-9)
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _is_mean_square_stable(moments, middle) else (low, middle)
    return 0.5 * (low + high)


class FrameTimeCurve(NamedTuple):
    """Delay and bandwidth against the time between two frames.

    Attributes
    ----------
    period : numpy.ndarray
        (n,): time between two frames [s].
    total : numpy.ndarray
        (n,): total delay with half a frame for the hold [s].
    frames : numpy.ndarray
        (n,): latency in frames.
    gain : numpy.ndarray
        (n,): largest gain of one frame without oscillation.
    bandwidth : numpy.ndarray
        (n,): bandwidth at this gain [Hz].
    """

    period: Float64
    total: Float64
    frames: Float64
    gain: Float64
    bandwidth: Float64


def delay_against_frame_time(budget: DelayBudget, periods: npt.ArrayLike) -> FrameTimeCurve:
    """Compute delay and bandwidth of a loop at other frame rates.

    A pipeline raises the frame rate while the latency stays: more frames only shorten the hold.

    Parameters
    ----------
    budget : DelayBudget
        Parts of the delay; the period of the budget is not used.
    periods : array_like
        (n,) times between two frames [s].

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.3.6.
    """
    given = np.atleast_1d(np.asarray(periods, np.float64))
    budgets = [dataclasses.replace(budget, period=float(each)) for each in given]
    columns = [(each.total, each.frames, each.gain, each.bandwidth) for each in budgets]
    total, frames, gain, bandwidth = np.array(columns).T
    return FrameTimeCurve(given, total, frames, gain, bandwidth)
