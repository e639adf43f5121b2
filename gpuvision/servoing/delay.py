"""Delay of a servo loop: its budget, and the gain that a loop with this delay allows.

The loop integrates: a head moves with the commanded velocity, the controller commands ``gain`` times the error in each
frame, and the error is seen ``delay`` frames late,

    x[k+1] = x[k] - gain * x(k - delay).

The position is linear between two commands. Therefore a delay of n + f frames, 0 <= f < 1, sees exactly
(1 - f) x[k-n] + f x[k-n-1], and the characteristic polynomial of the loop is

    z^(n+2) - z^(n+1) + gain ((1 - f) z + f).

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.4 and
   6.3.6, appendix A.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]

# Points of the search for crossings of the unit circle, per root of the polynomial: the phase of the loop changes by
# less than a tenth of a turn between two points.
_POINTS_PER_ROOT = 64
# Longest delay and lag [frames] (chosen: a second at 1 kHz); memory and time of the analyses grow with it.
_MAX_DELAY = 1000.0


def delay_taps(delay: float) -> tuple[int, float]:
    """Split a delay in frames into whole frames n and a fraction f, 0 <= f < 1.

    Raises
    ------
    ValueError
        The delay is negative, not finite, or longer than 1000 frames.
    """
    delay = finite(delay, "delay", minimum=0.0, maximum=_MAX_DELAY)
    whole = math.floor(delay)
    return whole, delay - whole


class LoopPolynomials(NamedTuple):
    """Transfer function of a closed loop from the target to the position, and from an error of the pose, negated.

    Attributes
    ----------
    numerator, denominator : numpy.ndarray
        (n,) coefficients of the powers of 1/z, lowest power first.
    """

    numerator: Float64
    denominator: Float64


class HeldAxis(NamedTuple):
    """Sampled axis whose velocity follows the command with a lag; q = 1/z is the delay of a frame.

    Attributes
    ----------
    decay : float
        Part of a velocity that remains after a frame: the poles are 1 and ``decay``.
    now, seen : numpy.ndarray
        Coefficients of the powers of q, lowest power first, of the position at the frame and at the exposure, over
        ``(1 - q)(1 - decay q)``, for a command of 1 [frames].
    """

    decay: float
    now: Float64
    seen: Float64


def held_axis(delay: float, lag: float = 0.0) -> HeldAxis:
    """Return the axis ``lag v' = u - v, x' = v`` with commands that are held for a frame, sampled exactly.

    Parameters
    ----------
    delay : float
        Time from the exposure to the frame [frames], 0 or more; fractions are exact.
    lag : float
        Time constant of the velocity [frames], 0 to 1000; 0 (default) follows at once.

    Notes
    -----
    In a time s the position moves by ``g v + (s - g) u`` with ``g = lag (1 - exp(-s / lag))``. Without a lag the
    position is linear between two commands.
    """
    whole, part = delay_taps(delay)
    if finite(lag, "lag", minimum=0.0, maximum=_MAX_DELAY) == 0.0:
        now, seen, decay = np.array([0.0, 1.0]), np.array([0.0, 1.0 - part, part]), 0.0
    else:
        decay, moved, time = math.exp(-1.0 / lag), -lag * math.expm1(-1.0 / lag), 1.0 - part
        faded = -lag * math.expm1(-time / lag)
        driven, follows = time - faded, faded * (1.0 - decay)
        now = np.array([0.0, 1.0 - moved, moved - decay])
        last = moved - decay - follows + driven * decay
        seen = np.array([0.0, driven, 1.0 - moved + follows - driven * (1.0 + decay), last])
    if not part:
        seen = now
    return HeldAxis(decay, now, np.concatenate([np.zeros(whole), seen]))


def closed_loop(
    delay: float, gain: float, *, integral: float = math.inf, derivative: float = 0.0, lag: float = 0.0
) -> LoopPolynomials:
    """Return the closed loop of controller, integrating plant with hold and lag, and delay.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.
    gain : float
        Fraction of the error that one frame corrects.
    integral : float
        Time constant of the integral part [frames]; infinite (default) for none.
    derivative : float
        Time constant of the derivative part [frames], default 0. It acts on the commanded velocity of the last frame:
        the velocity that `SmithPredictor` and `PoseObserver` estimate.
    lag : float
        Time constant with which the velocity of the plant follows the command [frames], default 0.

    Notes
    -----
    With q = 1/z, the numerators N now and S at the exposure of `held_axis`, its decay e, and the controller B / A, the
    position is ``gain N B / ((1 - q) A + gain S B)`` times the target. ``A = (1 - e q) + gain derivative (1 - e) q B``
    and ``B = 1`` without integral part. With it, ``B = 1 + 1 / integral - q`` and the first term of A has the factor
    ``1 - q``. Without lag, N = q and e = 0.
    """
    axis = held_axis(delay, lag)
    has_integral = math.isfinite(integral)
    front = np.array([1.0 + 1.0 / integral, -1.0] if has_integral else [1.0])
    back = np.array([1.0, -1.0] if has_integral else [1.0])
    if lag:
        back = np.convolve(back, [1.0, -axis.decay])
    if derivative:
        back = np.pad(back, (0, max(len(front) + 1 - len(back), 0)))
        back[1 : len(front) + 1] += gain * derivative * (1.0 - axis.decay) * front
    loop, own = np.convolve(gain * axis.seen, front), np.convolve([1.0, -1.0], back)
    forward = np.convolve(axis.now, gain * front)
    numerator, denominator = np.zeros((2, max(len(loop), len(own), len(forward))))
    denominator[: len(own)] += own
    denominator[: len(loop)] += loop
    numerator[: len(forward)] = forward
    return LoopPolynomials(numerator, denominator)


def characteristic_polynomial(delay: float, gain: float) -> Float64:
    """Return the characteristic polynomial of the loop with a proportional controller, highest power first.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.
    gain : float
        Fraction of the error that one frame corrects.

    Returns
    -------
    numpy.ndarray
        (n + 3,) coefficients for a delay of n + f frames, or (n + 2,) for f = 0.
    """
    return closed_loop(delay, gain).denominator


def gain_limit(delay: float) -> float:
    """Return the gain from which on the loop is unstable.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.

    Returns
    -------
    float
        Smallest gain (fraction of the error that a frame corrects) at which the loop is unstable.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    For a whole number d of frames the limit is 2 sin(pi / (2 (2 d + 1))). For a fraction the limit is the smallest
    positive gain with a root on the unit circle. The limit is not monotone below half a frame: the mean of two
    positions damps. It is 2 at d = 0, 4 at d = 1/4 and 2 at d = 1/2.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, appendix A.1.

    Examples
    --------
    >>> round(gain_limit(2), 5)
    0.61803
    """
    whole, part = delay_taps(delay)
    if part == 0.0:
        return 2.0 * math.sin(math.pi / (2.0 * (2.0 * whole + 1.0)))

    def gain_at(angle: Float64) -> npt.NDArray[np.complex128]:
        z = np.exp(1j * angle)
        return np.asarray((1.0 - z) * z ** (whole + 1) / ((1.0 - part) * z + part))

    def imaginary(angle: float) -> float:
        return float(gain_at(np.array([angle]))[0].imag)

    angles = np.linspace(0.0, math.pi, _POINTS_PER_ROOT * (whole + 2))[1:-1]
    signs = np.sign(gain_at(angles).imag)
    crossings = [brentq(imaginary, angles[k], angles[k + 1]) for k in np.flatnonzero(signs[:-1] != signs[1:])]
    gains = [float(gain_at(np.array([each]))[0].real) for each in crossings]
    if part != 0.5:
        gains.append(2.0 * (-1) ** whole / (1.0 - 2.0 * part))  # a root at z = -1
    return min(each for each in gains if each > 0.0)


def non_oscillating_gain(delay: float) -> float:
    """Return the largest gain for which the error decays without oscillation.

    At this gain the two slowest roots meet on the positive real axis.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more; fractions are exact.

    Returns
    -------
    float
        Gain: fraction of the error that a frame corrects.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.

    Notes
    -----
    For a whole number d of frames the gain is d^d / (d + 1)^(d + 1).

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, appendix A.1.

    Examples
    --------
    >>> round(non_oscillating_gain(2), 4)
    0.1481
    """
    whole, part = delay_taps(delay)
    if part == 0.0:
        return (whole / (whole + 1.0)) ** whole / (whole + 1.0)
    # The gain z^(n+1) (1 - z) / ((1 - f) z + f) is largest where its derivative, a quadratic in z, is 0.
    roots = np.roots([-(whole + 1) * (1.0 - part), (whole + 1) * (1.0 - 2.0 * part) - 1.0, (whole + 1) * part])
    z = max(float(each.real) for each in roots if 0.0 < each.real < 1.0)
    return z ** (whole + 1) * (1.0 - z) / ((1.0 - part) * z + part)


class LagGains(NamedTuple):
    """Gains of the sampled loop of an axis with a lag, without a delay: the loop of a Smith predictor.

    Attributes
    ----------
    limit : float
        Gain from which on the loop is unstable: fraction of the error that one frame corrects.
    critical : float
        Largest gain without oscillation.
    """

    limit: float
    critical: float


def lag_gains(lag: float) -> LagGains:
    """Return the gains that a lag of the axis allows, without a delay.

    Parameters
    ----------
    lag : float
        Time constant with which the velocity follows the command [frames], 0 to 1000.

    Notes
    -----
    With ``e = exp(-1 / lag)``, ``a = 1 - lag (1 - e)`` and ``b = lag (1 - e) - e`` the characteristic polynomial is
    ``z^2 - (1 + e - K a) z + e + K b``. It is stable below ``(1 - e) / b`` (a pair of complex roots) and below
    ``2 (1 + e) / (a - b)`` (a root at -1), by Jury's criterion. The roots are real up to the smaller root of
    ``a^2 K^2 - 2 (a (1 + e) + 2 b) K + (1 - e)^2 = 0``. For a long lag the limits are 2 and 1 / (4 lag).

    Examples
    --------
    >>> lag_gains(0.0)
    LagGains(limit=2.0, critical=1.0)
    >>> round(lag_gains(1.0).critical, 3)
    0.196
    """
    if finite(lag, "lag", minimum=0.0, maximum=_MAX_DELAY) == 0.0:
        return LagGains(2.0, 1.0)
    decay, lost = math.exp(-1.0 / lag), -math.expm1(-1.0 / lag)
    a, b = 1.0 - lag * lost, lag * lost - decay
    half = a * (1.0 + decay) + 2.0 * b
    critical = lost**2 / (half + math.sqrt(max(half**2 - (a * lost) ** 2, 0.0)))
    return LagGains(min(lost / b, 2.0 * (1.0 + decay) / (a - b)), critical)


class ContinuousGains(NamedTuple):
    """Gains of the continuous integrator with a delay.

    Attributes
    ----------
    limit : float
        Gain from which on the loop is unstable [1/s]: pi / 2 over the delay.
    critical : float
        Largest gain without oscillation [1/s]: 1 / e over the delay.
    """

    limit: float
    critical: float


def continuous_gains(delay: float) -> ContinuousGains:
    """Return the gains that the continuous integrator allows with a delay [s].

    The delay of a sampled loop includes half a frame for the hold.

    Examples
    --------
    >>> round(continuous_gains(1e-3).limit / (2 * 3.141592653589793), 1)  # [Hz]
    250.0
    """
    delay = finite(delay, "delay", above=0.0)
    return ContinuousGains(math.pi / (2.0 * delay), 1.0 / (math.e * delay))


def phase_loss(frequency: npt.ArrayLike, delay: float) -> Float64:
    """Return the phase [rad] that a delay [s] takes from a loop at frequencies [Hz]."""
    return 2.0 * math.pi * np.asarray(frequency, np.float64) * finite(delay, "delay", minimum=0.0)


@dataclass(frozen=True, kw_only=True)
class DelayBudget:
    """Parts of the delay between the middle of the exposure and the motion that answers it.

    Parameters
    ----------
    period : float
        Time between two frames [s]. Range: above 0.
    exposure : float
        Time of exposure [s], 0 or more. Half of it counts. Default 0.
    readout : float
        Time from the end of the exposure to the last needed pixel [s], 0 or more. Default 0.
    transfer : float
        Time of the transfer to the memory of the computer [s], 0 or more. Default 0.
    stages : mapping of str to float
        Time of each stage of processing by name [s]: edges, pose, control, drive. Default: none.

    Raises
    ------
    ValueError
        A time is negative, or the period is 0.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 6.3.6.
    """

    period: float
    exposure: float = 0.0
    readout: float = 0.0
    transfer: float = 0.0
    stages: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        finite(self.period, "period", above=0.0)
        for name in ("exposure", "readout", "transfer"):
            finite(getattr(self, name), name, minimum=0.0)
        for name, time in self.stages.items():
            finite(time, f"stage {name}", minimum=0.0)

    @property
    def parts(self) -> dict[str, float]:
        """Parts of the total delay by name [s]."""
        stages = {f"stage {name}": time for name, time in self.stages.items()}
        sensor = {"half exposure": self.exposure / 2.0, "readout": self.readout, "transfer": self.transfer}
        return sensor | stages | {"half hold": self.period / 2.0}

    @property
    def latency(self) -> float:
        """Time from the middle of the exposure to the command [s]: the total delay without the hold."""
        return self.exposure / 2.0 + self.readout + self.transfer + sum(self.stages.values())

    @property
    def total(self) -> float:
        """Total delay [s]: the latency, and half a frame, because each command is held for one frame."""
        return self.latency + self.period / 2.0

    @property
    def frames(self) -> float:
        """Latency in frames: the delay of the discrete loop, which contains the hold."""
        return self.latency / self.period

    @property
    def gain(self) -> float:
        """Largest gain of the discrete loop without oscillation."""
        return non_oscillating_gain(self.frames)

    @property
    def bandwidth(self) -> float:
        """Bandwidth gain / (2 pi period) at the largest gain without oscillation [Hz]."""
        return self.gain / (2.0 * math.pi * self.period)
