"""Delay of a servo loop, measured from commanded and measured positions of the loop's own data.

The measured position y at the time t follows the command c with a delay,

    y = scale c(t - delay - jitter) + offset + noise,

with a normal jitter that is independent from frame to frame. `measure_delay` starts from the correlation of the
velocities and maximises the likelihood of all samples. The speed separates jitter from noise: jitter shows in motion
only, noise shows at rest, too. `excitation` makes motions with both.

References
----------
.. [1] L. Ljung, *System Identification: Theory for the User*, 2nd edition, Prentice Hall 1999, chapters 7 (maximum
   likelihood) and 13 (pseudo-random excitation).
.. [2] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.3.6.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize

from gpuvision.validation import finite, integer

Float64 = npt.NDArray[np.float64]

_MAX_ITERATIONS = 1000  # of the simplex
# Nodes [sigma] and weights of the trapezoids over the jitter (chosen). The command has a corner at each frame: Gaussian
# quadrature with few nodes gives the likelihood a ripple as large as its curvature.
_NODES = np.linspace(-4.0, 4.0, 21)
_WEIGHTS = np.exp(-0.5 * _NODES**2)
_WEIGHTS = _WEIGHTS / _WEIGHTS.sum()
# Fewer samples than this do not fix five parameters (chosen).
_MIN_SAMPLES = 20
# A sample shows its own delay if the jitter moves it by more than this many standard deviations of the noise (chosen).
_CLEAR = 2.0
# Smallest correlation of commanded and measured motion at which a delay is reported (chosen).
_MIN_CORRELATION = 0.5


class MeasuredDelay(NamedTuple):
    """Delay between a commanded and a measured position.

    Attributes
    ----------
    mean : float
        Mean delay [s].
    mean_sigma : float
        Standard deviation of the estimate of the mean [s].
    jitter : float
        Standard deviation of the delay from frame to frame [s].
    jitter_sigma : float
        Standard deviation of the estimate of the jitter [s]; infinite if the data do not show a jitter.
    scale : float
        Measured motion over commanded motion.
    noise : float
        Standard deviation of the measured position [m].
    frames : float
        Mean delay in frames: in units of the median time between two samples.
    delays : numpy.ndarray
        (k,): delays [s] of the single samples that show it, in which jitter exceeds noise. They contain the noise.
    converged : bool
        Whether the search for the largest likelihood ended at its maximum, not at its largest number of iterations.
        Default True.
    """

    mean: float
    mean_sigma: float
    jitter: float
    jitter_sigma: float
    scale: float
    noise: float
    frames: float
    delays: Float64
    converged: bool = True


def excitation(count: int, speed: float, *, hold: int = 4, seed: int = 0) -> Float64:
    """Return velocities (count,) that excite an axis: a pseudo-random sequence of -speed, 0 and speed.

    Parameters
    ----------
    count : int
        Number of frames. Range: 1 or more.
    speed : float
        Velocity of the motions [m/s] or [rad/s]. Range: above 0.
    hold : int
        Number of frames for which each velocity lasts. Default 4. Range: 1 or more.
    seed : int
        Seed of the sequence. Default 0.

    Notes
    -----
    Each block of six velocities is a random order of two rests, two motions forth and two back: the axis returns after
    each block.
    """
    count, hold = integer(count, "count", minimum=1), integer(hold, "hold", minimum=1)
    rng = np.random.default_rng(seed)
    blocks = [rng.permutation([-1.0, -1.0, 0.0, 0.0, 1.0, 1.0]) for _ in range(-(-count // (6 * hold)))]
    return finite(speed, "speed", above=0.0) * np.repeat(np.concatenate(blocks), hold)[:count]


def chirp(count: int, period: float, amplitude: float, low: float, high: float) -> Float64:
    """Return positions (count,) of a sine whose frequency rises linearly from low to high [Hz].

    Parameters
    ----------
    count : int
        Number of frames. Range: 2 or more.
    period : float
        Frame time [s].
    amplitude : float
        Amplitude [m] or [rad].
    low, high : float
        First and last frequency [Hz], below half the frame rate.
    """
    time = period * np.arange(integer(count, "count", minimum=2))
    phase = 2.0 * math.pi * (low + 0.5 * (high - low) * time / time[-1]) * time
    return np.asarray(amplitude * np.sin(phase), np.float64)


def measure_delay(
    time: npt.ArrayLike, command: npt.ArrayLike, measured: npt.ArrayLike, *, longest: float | None = None
) -> MeasuredDelay:
    """Measure the delay between a commanded and a measured position.

    Parameters
    ----------
    time : array_like
        (n,) increasing times of the samples [s].
    command : array_like
        (n,) commanded position at these times [m] or [rad]; in between it is linear (a velocity that is held).
    measured : array_like
        (n,) newest measured position that was available at these times; NaN for a frame without one.
    longest : float, optional
        Longest delay [s]. Default: a quarter of the recording.

    Returns
    -------
    MeasuredDelay

    Raises
    ------
    ValueError
        The arrays do not fit, there are fewer than 20 samples, the command does not move, or the measured position does
        not follow it.

    Notes
    -----
    A lag of the plant counts to the delay. The likelihood of a sample is normal with the mean and variance of the
    jitter. The position is not normal where the command changes its velocity, so that the standard deviations are those
    of the sandwich estimator of [1]_, from differences of the likelihood.

    References
    ----------
    .. [1] H. White, *Maximum Likelihood Estimation of Misspecified Models*, Econometrica 50, 1982.
    """
    times, known, seen = _samples(time, command, measured)
    step = float(np.median(np.diff(times)))
    delays = _candidates(times, step, longest)
    start, correlation = _correlated_delay(times, known, seen, delays)
    if correlation < _MIN_CORRELATION:
        raise ValueError(
            f"the measured position does not follow the command (correlation {correlation:.2f}); excite the axis"
        )
    fit = _Likelihood(times, known, seen, float(delays[-1]), step)
    found = (fit.maximise(start, jitter * step) for jitter in (0.03, 0.3))
    best, is_largest = min(found, key=lambda each: fit.cost(each[0]))
    covariance = fit.covariance(best)
    scale, _, noise = fit.linear(best)
    mean, jitter = float(best[0]) * step, math.exp(best[1]) * step
    is_seen = fit.cost(np.array([best[0], -20.0, best[2]])) > fit.cost(best) + 2.0  # likelihood ratio of 2 sigma
    return MeasuredDelay(
        mean,
        math.sqrt(covariance[0, 0]) * step,
        jitter if is_seen else 0.0,
        math.sqrt(covariance[1, 1]) * jitter if is_seen else math.inf,
        scale,
        noise,
        mean / step,
        fit.single_delays(best) if is_seen else np.zeros(0),
        is_largest,
    )


def _samples(time: npt.ArrayLike, command: npt.ArrayLike, measured: npt.ArrayLike) -> tuple[Float64, Float64, Float64]:
    times, known, seen = (np.asarray(each, np.float64) for each in (time, command, measured))
    if times.ndim != 1 or known.shape != times.shape or seen.shape != times.shape:
        raise ValueError(f"time, command and measured have shapes {times.shape}, {known.shape}, {seen.shape}")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(known)) and np.all(np.diff(times) > 0.0)):
        raise ValueError("time must increase, and time and command must be finite")
    if np.count_nonzero(np.isfinite(seen)) < _MIN_SAMPLES:
        raise ValueError(f"{np.count_nonzero(np.isfinite(seen))} samples, expected {_MIN_SAMPLES} or more")
    if np.ptp(known) == 0.0:
        raise ValueError("the command does not move: no delay can be measured; excite the axis")
    return times, known, seen


def _candidates(times: Float64, step: float, longest: float | None) -> Float64:
    limit = 0.25 * float(times[-1] - times[0]) if longest is None else finite(longest, "longest", above=0.0)
    return np.arange(0.0, limit + step, 0.5 * step)


def _correlated_delay(times: Float64, known: Float64, seen: Float64, delays: Float64) -> tuple[float, float]:
    """Return the delay of the largest correlation of the steps of both positions, and this correlation."""
    valid = np.isfinite(seen)
    # Positions, not velocities, where noise exceeds the motion of a frame: remove the slow part by a difference of 3.
    apart = 3
    moved = seen[valid][apart:] - seen[valid][:-apart]
    ends, starts = times[valid][apart:], times[valid][:-apart]
    found = []
    for delay in delays:
        expected = np.interp(ends - delay, times, known) - np.interp(starts - delay, times, known)
        norm = math.sqrt(float(expected @ expected) * float(moved @ moved))
        found.append(float(expected @ moved) / norm if norm else 0.0)
    best = int(np.argmax(np.abs(found)))
    return float(delays[best]), abs(found[best])


class _Likelihood:
    """Negative log-likelihood of delay [frames], log jitter [log frames] and log noise [log motion of a frame].

    Scale and offset are eliminated: they are the weighted least-squares solution.
    """

    def __init__(self, times: Float64, known: Float64, seen: Float64, longest: float, step: float) -> None:
        inside = np.isfinite(seen) & (times >= times[0] + min(1.2 * longest, 0.3 * float(times[-1] - times[0])))
        self._times, self._known, self._step = times, known, step
        self._at, self._seen = times[inside], seen[inside]
        self._limit = longest / step + 2.0
        self._unit = float(np.std(np.diff(known))) or 1.0

    def _moments(self, parameters: Float64) -> tuple[Float64, Float64]:
        """Return mean and variance of the delayed command over the jitter."""
        late = (parameters[0] + math.exp(parameters[1]) * _NODES) * self._step
        values = np.interp(self._at[:, None] - late, self._times, self._known)
        mean = values @ _WEIGHTS
        return mean, ((values - mean[:, None]) ** 2) @ _WEIGHTS

    def _weighted(self, parameters: Float64, scale: float) -> tuple[float, float, Float64, Float64]:
        """Return scale, offset, residuals and variances, with the variance at an earlier scale."""
        mean, spread = self._moments(parameters)
        variance = (math.exp(parameters[2]) * self._unit) ** 2 + scale**2 * spread
        weight = 1.0 / variance
        middle, level = np.average(mean, weights=weight), np.average(self._seen, weights=weight)
        square = float(weight @ (mean - middle) ** 2)
        new = float(weight @ ((mean - middle) * (self._seen - level))) / square if square else 0.0
        return new, float(level - new * middle), self._seen - level - new * (mean - middle), variance

    def linear(self, parameters: Float64) -> tuple[float, float, float]:
        """Return scale, offset and noise."""
        scale = self._weighted(parameters, 1.0)[0]
        scale, offset, _, _ = self._weighted(parameters, scale)
        return scale, offset, math.exp(parameters[2]) * self._unit

    def cost(self, parameters: Float64) -> float:
        """Return the negative log-likelihood without its constant."""
        if not 0.0 <= parameters[0] <= self._limit or not np.all(np.abs(parameters[1:]) < 30.0):
            return math.inf
        return float(np.sum(self._costs(parameters)))

    def _costs(self, parameters: Float64) -> Float64:
        """Return the negative log-likelihoods (n,) of the samples."""
        scale = self._weighted(parameters, 1.0)[0]
        _, _, residual, variance = self._weighted(parameters, scale)
        return 0.5 * (residual**2 / variance + np.log(variance))

    def maximise(self, delay: float, jitter: float) -> tuple[Float64, bool]:
        """Return the parameters of largest likelihood, from a first delay and jitter [s], and whether it converged."""
        first = np.array([max(delay / self._step, 0.1), math.log(jitter / self._step), 0.0])
        _, _, residual, _ = self._weighted(first, 0.0)
        first[2] = math.log(max(float(np.std(residual)), 1e-9 * self._unit) / self._unit)
        options = {"xatol": 1e-5, "fatol": 1e-6, "maxiter": _MAX_ITERATIONS, "initial_simplex": _simplex(first)}
        found = minimize(self.cost, first, method="Nelder-Mead", options=options)
        return np.asarray(found.x, np.float64), bool(found.success)

    def covariance(self, best: Float64) -> Float64:
        """Return the covariance (3, 3): inverse Hessian, squared gradients of the samples, inverse Hessian."""
        # [frames], and factors of jitter and noise
        steps = np.diag([max(1e-3, 0.3 * math.exp(best[1])), 2e-2, 1e-2])
        middle = np.maximum(best, [2.0 * steps[0, 0], -25.0, -25.0])
        hessian = np.zeros((3, 3))
        for i in range(3):
            for j in range(3):
                corners = [a * b * self.cost(middle + a * steps[i] + b * steps[j]) for a in (-1, 1) for b in (-1, 1)]
                hessian[i, j] = sum(corners) / (4.0 * steps[i, i] * steps[j, j])
        changes = np.array([self._costs(middle + each) - self._costs(middle - each) for each in steps])
        gradients = changes / (2.0 * np.diag(steps)[:, None])
        inverse = np.linalg.pinv(hessian)
        return np.asarray(inverse @ (gradients @ gradients.T) @ inverse, np.float64)

    def single_delays(self, best: Float64) -> Float64:
        """Return the delays [s] of the samples in which the jitter exceeds the noise."""
        scale, offset, noise = self.linear(best)
        late, jitter = best[0] * self._step, math.exp(best[1]) * self._step
        ahead, behind = (np.interp(self._at - late + each, self._times, self._known) for each in (jitter, -jitter))
        slope = scale * (ahead - behind) / (2.0 * jitter)
        expected = scale * np.interp(self._at - late, self._times, self._known) + offset
        clear = np.abs(slope) * jitter > _CLEAR * noise
        return np.asarray(late - (self._seen - expected)[clear] / slope[clear], np.float64)


def _simplex(first: Float64) -> Float64:
    """Return the first simplex: half a frame of delay, and factors of about 2 and 3 of jitter and noise."""
    return np.asarray(first + np.vstack([np.zeros(3), np.diag([0.3, 0.7, -1.0])]), np.float64)
