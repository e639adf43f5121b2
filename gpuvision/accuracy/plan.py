"""Plan of a job: the tried settings, the fastest that meets the tolerance, and faster and more accurate ones."""

from __future__ import annotations

import abc
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, Generic, NamedTuple

from gpuvision.accuracy.trial import (
    AnyTrial,
    Trial,
    at_least,
    micrometres,
    millionths,
    parts_text,
    trial_table,
)
from gpuvision.host import GpuVisionError
from gpuvision.validation import finite

_SMALL_GAIN = (
    0.95  # a smaller gain in time or error is no reason to change a setting. Chosen: the scatter of the timing
)


class PlanError(GpuVisionError):
    """No setting meets tolerance and rate; the message gives the nearest feasible values.

    Attributes
    ----------
    trials : tuple of Trial
        The settings that were tried, fastest first.
    usable : tuple of Trial
        The settings that may be chosen.
    """

    def __init__(self, message: str, trials: Sequence[Trial], usable: Sequence[Trial]) -> None:
        super().__init__(message)
        self.trials, self.usable = tuple(trials), tuple(usable)

    def table(self) -> str:
        """Return the settings as a table."""
        return trial_table(self.trials, self.usable)


@dataclass(frozen=True, kw_only=True)
class AccuracyLimits:
    """Limits of a plan of a job by speed and accuracy.

    Attributes
    ----------
    margin : float
        Least ratio of the tolerance to the predicted error, at least 1. Default 1.1.
    rate_margin : float
        Least ratio of the time that rate and latency allow to the time of a unit of work, at least 1. Default 1.25.
    """

    margin: float = 1.1
    rate_margin: float = 1.25

    def __post_init__(self) -> None:
        for name in ("margin", "rate_margin"):
            finite(getattr(self, name), f"{type(self).__name__}.{name}", minimum=1.0)


@dataclass(frozen=True, kw_only=True)
class AccuracyPlan(abc.ABC, Generic[AnyTrial]):
    """Plan of a job by speed and accuracy. ``str(plan)`` states it in one line.

    Attributes
    ----------
    chosen : Trial
        Fastest setting that meets the tolerance.
    trials : tuple of Trial
        All settings that were tried, fastest first.
    tolerance : float
        Asked error [m].
    limits : AccuracyLimits
        Limits of the plan.
    """

    kind: ClassVar[str]
    unit: ClassVar[str] = "frame"

    chosen: AnyTrial
    trials: tuple[AnyTrial, ...]
    tolerance: float
    limits: AccuracyLimits

    @property
    @abc.abstractmethod
    def usable(self) -> list[AnyTrial]:
        """Settings that may be chosen."""

    @property
    def faster(self) -> AnyTrial | None:
        """Most accurate setting that is faster by 5 % or more, for a larger tolerance; None if no setting is faster."""
        quicker = [each for each in self.usable if each.seconds < _SMALL_GAIN * self.chosen.seconds]
        return min(quicker, key=lambda each: each.error, default=None)

    @property
    def finer(self) -> AnyTrial | None:
        """Fastest setting that is more accurate by 5 % or more, for a longer time; None if there is no such setting."""
        finer = [each for each in self.usable if each.error < _SMALL_GAIN * self.chosen.error]
        return min(finer, key=lambda each: each.seconds, default=None)

    def is_chosen(self, trial: AnyTrial) -> bool:
        """Return whether a setting is the chosen one."""
        return trial == self.chosen

    def table(self) -> str:
        """Return the tried settings as a table, fastest first; a star marks the chosen one."""
        return trial_table(self.trials, self.usable, self.is_chosen)

    def sentences(self) -> list[str]:
        """Return error and time of the chosen setting, and what other tolerances give, in parts of a sentence."""
        chosen = self.chosen
        parts = [
            f"{chosen.name}: predicted error {micrometres(chosen.error)} of {micrometres(self.tolerance)}, "
            f"{millionths(chosen.seconds)} us per {self.unit}"
        ]
        if self.faster is None:
            parts.append(f"no usable {self.kind} is faster")
        else:
            wanted = at_least(self.limits.margin * self.faster.error)
            parts.append(f"a tolerance of {wanted} would allow {self._relative(self.faster)}")
        if self.finer is not None:
            parts.append(f"{at_least(self.limits.margin * self.finer.error)} takes {self._relative(self.finer)}")
        return parts

    def _relative(self, other: AnyTrial) -> str:
        return f"{other.name} at {other.seconds / self.chosen.seconds:.2g} times the time"

    def __str__(self) -> str:
        return "; ".join(self.sentences())

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return {
            "chosen": self.chosen.to_dict(),
            "tolerance": self.tolerance,
            "faster": None if self.faster is None else self.faster.to_dict(),
            "finer": None if self.finer is None else self.finer.to_dict(),
            "trials": [each.to_dict() for each in self.trials],
            "limits": asdict(self.limits),
        }


def fastest_within(
    trials: Sequence[AnyTrial], usable: Sequence[AnyTrial], tolerance: float, margin: float, kind: str
) -> AnyTrial:
    """Return the fastest usable setting that meets a tolerance.

    Parameters
    ----------
    trials, usable : sequence of Trial
        All settings, and the settings that may be chosen (at least one).
    tolerance : float
        Largest error [m].
    margin : float
        Least ratio of the tolerance to the predicted error.
    kind : str
        Word for a setting in messages, such as "readout".

    Raises
    ------
    PlanError
        No setting meets it; the message names the tolerance that the most accurate setting meets.
    """
    met = [each for each in usable if margin * each.error <= tolerance]
    if met:
        return min(met, key=lambda each: each.seconds)
    best = min(usable, key=lambda each: each.error)
    raise PlanError(
        f"no {kind} meets an error of {micrometres(tolerance)}; the most accurate, {best.name}, is predicted "
        f"{micrometres(best.error)} ({parts_text(best)}): ask for {at_least(margin * best.error)} or more",
        trials,
        usable,
    )


class TimeLimit(NamedTuple):
    """Longest time of a unit of work, by a rate or a latency.

    Attributes
    ----------
    seconds : float
        Longest time [s].
    reason : str
        Constraint in words.
    """

    seconds: float
    reason: str


def time_limit(rate: float | None, latency: float | None, rate_margin: float, unit: str) -> TimeLimit | None:
    """Return the longest time of a unit of work that keeps up with a rate and a latency; None without a rate.

    Parameters
    ----------
    rate : float or None
        Units of work per second [1/s], above 0.
    latency : float or None
        Longest time from a unit's arrival to its result [s], above 0; needs a rate.
    rate_margin : float
        Least ratio of the longest time to the measured one.
    unit : str
        Name of a unit of work.

    Raises
    ------
    ValueError
        A number is not above 0, or a latency has no rate.
    """
    if rate is None:
        if latency is not None:
            raise ValueError(f"a latency needs a rate; give the {unit}s per second as well")
        return None
    limits = [TimeLimit(1.0 / finite(rate, "rate", above=0.0) / rate_margin, f"a rate of {rate:g} {unit}s/s")]
    if latency is not None:
        longest = finite(latency, "latency", above=0.0) / rate_margin
        limits.append(TimeLimit(longest, f"a latency of {millionths(latency)} us"))
    return min(limits)


def check_time(
    chosen: AnyTrial,
    trials: Sequence[AnyTrial],
    usable: Sequence[AnyTrial],
    limit: TimeLimit | None,
    margin: float,
    kind: str,
    time_of: Callable[[AnyTrial], float] = lambda each: each.seconds,
) -> None:
    """Check that the fastest setting that meets a tolerance keeps a time limit.

    Parameters
    ----------
    chosen : Trial
        Result of `fastest_within`.
    trials, usable, margin, kind
        As in `fastest_within`.
    limit : TimeLimit or None
        Longest time; None: any time.
    time_of : callable
        Time of a setting that must keep the limit [s]. Default: its median time.

    Raises
    ------
    PlanError
        It is too slow; the message names the most accurate setting that does.
    """
    if limit is None or time_of(chosen) <= limit.seconds:
        return
    times = f"{millionths(time_of(chosen))} us, {limit.reason} allows {millionths(limit.seconds)} us"
    refusal = f"{chosen.name} is the fastest {kind} that meets the tolerance and is too slow: {times}"
    quick = [each for each in usable if time_of(each) <= limit.seconds]
    if not quick:
        fastest = min(usable, key=time_of)
        raise PlanError(
            f"{refusal}; the fastest usable {kind}, {fastest.name}, takes {millionths(time_of(fastest))} us",
            trials,
            usable,
        )
    best = min(quick, key=lambda each: each.error)
    raise PlanError(
        f"{refusal}; {best.name} keeps up with a predicted error of {micrometres(best.error)}: ask for "
        f"{at_least(margin * best.error)} or more",
        trials,
        usable,
    )
