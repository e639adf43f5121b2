"""Settling: decide from the residual vibration and from the noise of the pose when the head may place its part.

After a move the head swings at its resonance. `VibrationSettling` fits offset and decaying sine to the last errors, and
allows the placement as soon as the probability of a misplacement beyond the tolerance of this part is small enough:
a part with a wide tolerance, or a move that excited little vibration, waits less.

References
----------
.. [1] G. H. Golub and V. Pereyra, *The differentiation of pseudo-inverses and nonlinear least squares problems whose
   variables separate*, SIAM Journal on Numerical Analysis 10, 1973 (variable projection).
.. [2] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.7.2.
"""

from __future__ import annotations

import math
from collections import deque
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.stats import f as f_distribution

from gpuvision.servoing.frames import pose_difference
from gpuvision.servoing.loop import LoopRecord
from gpuvision.servoing.observer import Verdict
from gpuvision.validation import finite, integer, numbers

Float64 = npt.NDArray[np.float64]

# Largest damping ratio of a vibration that a fit looks for (chosen): above, nothing swings.
_MAX_DAMPING = 0.7
# Damping ratio below which an error swings (chosen): at 0.34 the amplitude falls to a tenth within a period. Above, a
# fit follows the rest of the step response.
_SWINGING = 0.34
# Probability to find a vibration in the noise of a resting axis (chosen).
_FALSE_ALARM = 1e-3


class Vibration(NamedTuple):
    """Decaying sine ``offset + amplitude exp(-decay t) cos(angular frequency t + phase)``, t from the first sample.

    Attributes
    ----------
    offset : float
        Final value [m] or [rad].
    amplitude : float
        Amplitude at the first sample.
    phase : float
        Phase at the first sample [rad].
    frequency : float
        Frequency of the swing [Hz].
    damping : float
        Damping ratio.
    residual : float
        Root mean square of the residuals.
    """

    offset: float
    amplitude: float
    phase: float
    frequency: float
    damping: float
    residual: float


def _basis(time: Float64, frequency: float, damping: float) -> Float64:
    """Return the basis (n, 3): 1, decaying cosine and decaying sine; (n, 1) for the frequency 0."""
    one = np.ones((len(time), 1))
    if frequency == 0.0:
        return one
    swing = 2.0 * math.pi * frequency * time
    decay = np.exp(-damping / math.sqrt(1.0 - damping**2) * swing)
    return np.column_stack([one, decay * np.cos(swing), decay * np.sin(swing)])


def fit_vibration(time: npt.ArrayLike, error: npt.ArrayLike, *, damping: float = 0.02) -> Vibration:
    """Fit a decaying sine to errors after a move, to identify the resonance of an axis.

    Parameters
    ----------
    time : array_like
        (n,) increasing times [s], 8 or more, at least one period of the swing.
    error : array_like
        (n,) errors [m] or [rad].
    damping : float
        Damping ratio at which the search starts. Default 0.02.

    Raises
    ------
    ValueError
        There are fewer than 8 samples, or a number is not finite.

    Notes
    -----
    Frequency and damping are found by Gauss-Newton steps from the best frequency of a scan; the other parameters are
    linear (variable projection).
    """
    times, errors = np.asarray(time, np.float64), np.asarray(error, np.float64)
    if times.ndim != 1 or errors.shape != times.shape or len(times) < 8:
        raise ValueError(f"time and error have shapes {times.shape} and {errors.shape}, expected 8 samples or more")
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(errors)) and np.all(np.diff(times) > 0.0)):
        raise ValueError("time must increase, and time and error must be finite")
    since = times - times[0]
    step = since[-1] / (len(since) - 1)
    frequencies = np.linspace(0.5 / since[-1], 0.45 / step, 8 * len(since))
    costs = [float(np.sum(_residual(since, errors, each, damping) ** 2)) for each in frequencies]
    start = float(frequencies[int(np.argmin(costs))])
    unit = float(np.std(errors)) or 1.0
    found = least_squares(
        lambda each: _residual(since, errors, each[0] * start, each[1]) / unit,
        (1.0, damping),
        bounds=((0.5, 0.0), (2.0, _MAX_DAMPING)),
        x_scale=(0.01, 0.01),
    )
    frequency, ratio = float(found.x[0]) * start, float(found.x[1])
    offset, cosine, sine = np.linalg.lstsq(_basis(since, frequency, ratio), errors, rcond=None)[0]
    rms = float(np.sqrt(np.mean(_residual(since, errors, frequency, ratio) ** 2)))
    return Vibration(float(offset), math.hypot(cosine, sine), math.atan2(-sine, cosine), frequency, ratio, rms)


class ResidualVibration(NamedTuple):
    """Residual vibration of the axes of a loop: keyword arguments of `VibrationSettling`.

    Attributes
    ----------
    frequency : numpy.ndarray
        (3,) frequencies [Hz]; 0 for an axis that does not swing.
    damping : numpy.ndarray
        (3,) damping ratios; 0.02 for an axis that does not swing.
    """

    frequency: Float64
    damping: Float64


def vibration_of_loop(record: LoopRecord, since: float) -> ResidualVibration:
    """Find the residual vibration of each axis in the measured poses of a loop.

    A closed loop swings at another frequency and with another damping than the free axis. Take them from a run of the
    same loop: ``VibrationSettling(tolerance, **vibration_of_loop(record, since)._asdict())``.

    Parameters
    ----------
    record : LoopRecord
        Run to a resting target, long enough to see some periods of the swing: run it without a settling rule.
    since : float
        Time [s] from which the move is over and the head only swings.

    Returns
    -------
    ResidualVibration

    Raises
    ------
    ValueError
        Fewer than 8 poses were exposed and accepted since this time.

    Notes
    -----
    `fit_vibration` fits each axis. An axis swings if an F test of the fit against a constant is significant at 0.001,
    divided by the number of independent frequencies (Bonferroni), and if its damping is below 0.34: above, the
    amplitude falls to less than a tenth within a period. The fit sees the vibration of the steered head: a stop of the
    loop ends the last command, which excites the free axis again. The rule sees the swing in the estimate of the
    observer. A model without the resonance makes it smaller there, by 10 to 15 % at 83 Hz and 1 kHz in
    ``tests/servoing/test_settling.py``: give the rule a smaller tolerance by this part.
    """
    taken = [each for each, verdict in record.measurements if verdict is Verdict.ACCEPTED and each.exposed >= since]
    taken.sort(key=lambda each: each.exposed)
    if len(taken) < 8:
        raise ValueError(f"{len(taken)} accepted poses since {since:g} s, expected 8 or more; run the loop for longer")
    times = np.array([each.exposed for each in taken])
    errors = np.array([pose_difference(record.target[-1], each.pose) for each in taken])
    frequency, damping = np.zeros(3), np.full(3, 0.02)
    for axis in range(3):
        found = fit_vibration(times, errors[:, axis])
        left, rest = found.residual**2, float(np.var(errors[:, axis]))
        degrees = len(times) - 5
        ratio = (rest - left) / 4.0 / (left / degrees) if left > 0.0 else math.inf if rest > 0.0 else 0.0
        is_significant = f_distribution.sf(ratio, 4, degrees) * len(times) / 2.0 < _FALSE_ALARM
        if is_significant and found.damping < _SWINGING:
            frequency[axis], damping[axis] = found.frequency, found.damping
    return ResidualVibration(frequency, damping)


def _residual(time: Float64, error: Float64, frequency: float, damping: float) -> Float64:
    basis = _basis(time, frequency, damping)
    return np.asarray(error - basis @ np.linalg.lstsq(basis, error, rcond=None)[0], np.float64)


class VibrationSettling:
    """Rule that allows a placement when vibration and noise leave its tolerance with a small probability only.

    Parameters
    ----------
    tolerance : array_like
        (3,) largest errors of this part [m], [m], [rad], above 0.
    frequency : array_like
        (3,) frequencies of the residual vibration of the axes [Hz], 0 or more; 0 for an axis that does not swing.
        Default 0.
    damping : array_like
        (3,) damping ratios. Default 0.02.
    miss_probability : float
        Largest probability of an error beyond the tolerance. Default 0.0027 (3 sigma). Range: above 0 to 1.
    window : int
        Number of the last errors to which the vibration is fitted, 4 or more. Default 24.
    lead : float
        Time from the decision to the contact of the part with the board [s]. Default 0. Range: 0 or more.
    is_filtered : bool
        Whether the errors are estimates of a filter, such as `PoseObserver`, whose noise is correlated from one frame
        to the next. False for independent measurements, such as from `LatestPose` with a new pose in each frame.
        Default True.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    Offset and amplitude are a linear least-squares fit. The error at the contact is taken as offset plus envelope,
    whatever the phase, with the standard deviation of the fit: the head stays within the tolerance from then on. Call
    it once for each frame; it implements `gpuvision.servoing.loop.SettlingRule`.

    The correlation of filtered errors is not known to the rule. It then takes the largest standard deviation that any
    correlation gives: the sum of the standard deviations of the errors, each times the absolute value of its weight in
    the fit.
    """

    def __init__(
        self,
        tolerance: npt.ArrayLike,
        *,
        frequency: npt.ArrayLike = (0.0, 0.0, 0.0),
        damping: npt.ArrayLike = (0.02, 0.02, 0.02),
        miss_probability: float = 0.0027,
        window: int = 24,
        lead: float = 0.0,
        is_filtered: bool = True,
    ) -> None:
        self._tolerance = [finite(each, "tolerance", above=0.0) for each in numbers(tolerance, (3,), "tolerance")]
        self._frequency = [finite(each, "frequency", minimum=0.0) for each in numbers(frequency, (3,), "frequency")]
        self._damping = [
            finite(each, "damping", minimum=0.0, maximum=_MAX_DAMPING) for each in numbers(damping, (3,), "damping")
        ]
        self._miss = finite(miss_probability, "miss_probability", above=0.0, maximum=1.0)
        self._lead, self._is_filtered = finite(lead, "lead", minimum=0.0), is_filtered
        self._samples: deque[tuple[float, Float64, Float64]] = deque(maxlen=integer(window, "window", minimum=4))

    def __call__(self, time: float, error: Float64, covariance: Float64) -> bool:
        """Take an error (3,) with its covariance (3, 3) at a time [s]; return whether the part may be placed."""
        self._samples.append((time, np.array(error), np.diagonal(covariance).copy()))
        return self.miss_probability() <= self._miss

    def miss_probability(self) -> float:
        """Return the probability that an axis leaves the tolerance after the contact, by the errors so far."""
        if len(self._samples) < 4:
            return 1.0
        times = np.array([each[0] for each in self._samples])
        errors = np.array([each[1] for each in self._samples])
        variances = np.array([each[2] for each in self._samples])
        return float(sum(self._axis(k, times, errors[:, k], variances[:, k]) for k in range(3)))

    def _axis(self, axis: int, times: Float64, errors: Float64, variances: Float64) -> float:
        """Return the probability that one axis leaves its tolerance, at most 1."""
        basis = _basis(times - times[-1], self._frequency[axis], self._damping[axis])
        weighted = basis / np.maximum(variances, 1e-300)[:, None]
        information = weighted.T @ basis
        if np.linalg.cond(information) > 1e12:  # the window is a small part of a period
            return 1.0
        covariance = np.linalg.inv(information)
        weights = covariance @ weighted.T
        fit = covariance @ (weighted.T @ errors)
        sigmas = np.abs(weights) @ np.sqrt(variances) if self._is_filtered else np.sqrt(np.diagonal(covariance))
        worst, spread = abs(float(fit[0])), [float(sigmas[0])]
        if len(fit) == 3:
            ratio = self._damping[axis] / math.sqrt(1.0 - self._damping[axis] ** 2)
            decay = math.exp(-ratio * 2.0 * math.pi * self._frequency[axis] * self._lead)
            worst += decay * math.hypot(fit[1], fit[2])
            spread.append(decay * math.hypot(sigmas[1], sigmas[2]) / math.sqrt(2.0))
        sigma = math.sqrt(2.0) * (sum(spread) if self._is_filtered else math.hypot(*spread))
        tolerance = self._tolerance[axis]
        return 0.5 * (math.erfc((tolerance - worst) / sigma) + math.erfc((tolerance + worst) / sigma))
