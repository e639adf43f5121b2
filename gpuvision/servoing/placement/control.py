"""Controller, observer and release rule of a placement, as a machine file gives them.

References
----------
.. [1] S. Skogestad, *Simple analytic rules for model reduction and PID controller tuning*, Journal of Process
   Control 13, 2003, table 1 (integrating processes).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from gpuvision.validation import finite, integer, numbers

ObserverName = Literal["latest", "smith", "kalman"]
ControllerName = Literal["p", "pi", "pid"]
RuleName = Literal["response", "vibration", "fixed"]

OBSERVERS: tuple[ObserverName, ...] = ("latest", "smith", "kalman")
CONTROLLERS: tuple[ControllerName, ...] = ("p", "pi", "pid")
RULES: tuple[RuleName, ...] = ("response", "vibration", "fixed")


def _one_of(value: str, names: tuple[str, ...], what: str) -> None:
    if value not in names:
        raise ValueError(f"{what} is {value!r}, expected one of {', '.join(names)}")


@dataclass(frozen=True, kw_only=True)
class Control:
    """Observer and controller of a placement machine.

    Parameters
    ----------
    observer : {"latest", "smith", "kalman"}
        Estimate of the pose: the latest measured pose (`LatestPose`, default), this pose and the motion that was
        commanded during the known delay (`SmithPredictor`, with a model of the lag of the axes), or a Kalman filter
        (`PoseObserver`).
    controller : {"p", "pi", "pid"}
        Parts of the controller; default "p". The head integrates the commanded velocity, so "p" leaves no steady error.
    gain : float, optional
        Fraction of the error that one frame corrects. Default: for "p" the largest gain without oscillation, for "pi"
        and "pid" the rule of Skogestad (2003).
    integral : float, optional
        Time constant of the integral part of "pi" and "pid" [s], above 0. Default: by the rule of Skogestad.
    derivative : float, optional
        Time constant of the derivative part of "pid" [s], 0 or more. Default: the longest lag of the axes.
    motion_sigma : (float, float, float), optional
        Standard deviations of the random motion of the head during a frame in x, y [m] and theta [rad], above 0: error
        of the model of the Kalman filter, which needs them. Smaller values average over more frames.
    watchdog : float
        Time after a command at which the axes stop by themselves [frames], above 1; infinite (default) for none.

    Raises
    ------
    ValueError
        A number is out of its range, or does not belong to this observer or controller.
    """

    observer: ObserverName = "latest"
    controller: ControllerName = "p"
    gain: float | None = None
    integral: float | None = None
    derivative: float | None = None
    motion_sigma: tuple[float, float, float] | None = None
    watchdog: float = math.inf

    def __post_init__(self) -> None:
        _one_of(self.observer, OBSERVERS, "observer")
        _one_of(self.controller, CONTROLLERS, "controller")
        if self.integral is not None:
            finite(self.integral, "integral", above=0.0)
            if self.controller == "p":
                raise ValueError('integral needs the controller "pi" or "pid"')
        if self.derivative is not None:
            finite(self.derivative, "derivative", minimum=0.0)
            if self.controller != "pid":
                raise ValueError('derivative needs the controller "pid"')
        if self.controller == "pid" and self.observer == "latest":
            raise ValueError('the controller "pid" needs a velocity: the observer "smith" or "kalman"')
        if (self.motion_sigma is None) == (self.observer == "kalman"):
            raise ValueError('motion_sigma belongs to the observer "kalman", which needs it')
        if self.motion_sigma is not None:
            for each in numbers(self.motion_sigma, (3,), "motion_sigma"):
                finite(each, "motion_sigma", above=0.0)
        if not self.watchdog > 1.0:
            raise ValueError(f"watchdog is {self.watchdog} frames, expected above 1")


@dataclass(frozen=True, kw_only=True)
class Settling:
    """Rule that releases the part.

    Parameters
    ----------
    rule : {"response", "vibration", "fixed"}
        "response" (default) waits for the number of frames in which the step response of the loop falls to a fifth of
        the tolerance; "vibration" waits for these frames, and until the residual vibration leaves the tolerance with a
        small probability only (`VibrationSettling`); "fixed" waits for a fixed time.
    wait : float, optional
        Time from the first measured pose to the release by the rule "fixed" [s], above 0.
    frequency : (float, float, float), optional
        Frequencies [Hz], 0 or more, of the residual vibration of the steered head in x, y and theta, for the rule
        "vibration"; 0 for an axis that does not swing. Take frequencies and damping ratios from
        `gpuvision.servoing.settling.vibration_of_loop`. Default: a simulation makes an extra move to find them; a real
        machine needs them.
    damping : (float, float, float), optional
        Damping ratios of this vibration, 0 to 0.7. Default: as for the frequencies.
    miss_probability : float
        Largest probability that the head leaves the tolerance after the release, for the rule "vibration". Default
        0.0027 (3 sigma). Range: above 0 to 1.
    window : int
        Number of the last errors to which the rule "vibration" fits the vibration, 4 or more. Default 24.
    lead : float
        Time from the release to the contact of the part with the board [s], 0 or more. Default 0.

    Raises
    ------
    ValueError
        A number is out of its range, or does not belong to this rule.
    """

    rule: RuleName = "response"
    wait: float | None = None
    frequency: tuple[float, float, float] | None = None
    damping: tuple[float, float, float] | None = None
    miss_probability: float = 0.0027
    window: int = 24
    lead: float = 0.0

    def __post_init__(self) -> None:
        _one_of(self.rule, RULES, "rule")
        if (self.wait is None) == (self.rule == "fixed"):
            raise ValueError('wait belongs to the rule "fixed", which needs it')
        if self.wait is not None:
            finite(self.wait, "wait", above=0.0)
        if (self.frequency is None) != (self.damping is None):
            raise ValueError("frequency and damping belong together")
        if self.frequency is not None and self.rule != "vibration":
            raise ValueError('frequency and damping belong to the rule "vibration"')
        for each in self.frequency or ():
            finite(each, "frequency", minimum=0.0)
        for each in self.damping or ():
            finite(each, "damping", minimum=0.0, maximum=0.7)
        finite(self.miss_probability, "miss_probability", above=0.0, maximum=1.0)
        integer(self.window, "window", minimum=4)
        if self.rule != "vibration" and (self.miss_probability, self.window) != (
            Settling.miss_probability,
            Settling.window,
        ):
            raise ValueError('miss_probability and window belong to the rule "vibration"')
        finite(self.lead, "lead", minimum=0.0)
