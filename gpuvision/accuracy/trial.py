"""Settings that a plan tries: their interface, their times, and their table."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

_NAME_WIDTH, _NUMBER_WIDTH = 16, 9  # characters of a column


class Trial(Protocol):
    """Setting that a plan tried, with its predicted error and its measured time."""

    @property
    def name(self) -> str:
        """Name of the setting in tables and messages."""

    @property
    def seconds(self) -> float:
        """Median time of a unit of work, such as a frame [s]."""

    @property
    def error(self) -> float:
        """Predicted error [m]; NaN where it is not known."""

    @property
    def error_parts(self) -> dict[str, float]:
        """Parts of the error by name [m]."""

    @property
    def legend(self) -> str:
        """Explanation of the columns."""

    def cells(self) -> dict[str, str]:
        """Return the texts of a row of a table by the headings of their columns; the name is the first."""

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""


AnyTrial = TypeVar("AnyTrial", bound=Trial)


class CallTime(NamedTuple):
    """Time of a call.

    Attributes
    ----------
    median, upper : float
        Median and upper quartile [s].
    """

    median: float
    upper: float


def median_times(calls: Sequence[Callable[[], object]], rounds: int = 7) -> list[float]:
    """Return the median time of each call [s]; the calls take turns.

    Parameters
    ----------
    calls : sequence of callable
        Calls to measure.
    rounds : int
        Number of turns. Default 7: a pause of a shared machine hits one call or a few.
    """
    return [statistics.median(each) for each in _turns(calls, rounds, repeats=False)]


def loop_times(calls: Sequence[Callable[[], object]], rounds: int) -> list[CallTime]:
    """Return the time of each call in a loop; the calls take turns.

    An untimed call comes before each timed one: in a loop the caches hold the program.

    Parameters
    ----------
    calls : sequence of callable
        Calls to measure.
    rounds : int
        Number of turns, 2 or more.
    """
    quartiles = [statistics.quantiles(each, method="inclusive") for each in _turns(calls, rounds, repeats=True)]
    return [CallTime(middle, upper) for _, middle, upper in quartiles]


def _turns(calls: Sequence[Callable[[], object]], rounds: int, *, repeats: bool) -> list[list[float]]:
    """Return the times of each call [s]: in each turn once, or after an untimed one."""
    times: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds):
        for taken, call in zip(times, calls, strict=True):
            if repeats:
                call()
            start = time.perf_counter()
            call()
            taken.append(time.perf_counter() - start)
    return times


def trial_table(
    trials: Sequence[AnyTrial],
    usable: Sequence[AnyTrial],
    is_chosen: Callable[[AnyTrial], bool] = lambda each: False,
) -> str:
    """Return trials as a table with its legend.

    Parameters
    ----------
    trials : sequence of Trial
        Rows of the table, one or more.
    usable : sequence of Trial
        Trials that may be chosen; a minus sign marks all others.
    is_chosen : callable
        Whether a trial is the chosen one, which a star marks.
    """
    first, *others = trials[0].cells()
    width = max(_NAME_WIDTH, *(len(each.name) + 1 for each in trials))
    lines = [f"  {first:<{width}}{''.join(f'{each:>{_NUMBER_WIDTH}}' for each in others)}"]
    for each in trials:
        mark = "*" if is_chosen(each) else " " if each in usable else "-"
        name, *numbers = each.cells().values()
        lines.append(f"{mark} {name:<{width}}{''.join(f'{one:>{_NUMBER_WIDTH}}' for one in numbers)}")
    return "\n".join([*lines, trials[0].legend])


def millionths(value: float) -> str:
    """Return a length or a time in micrometres or microseconds, with three digits or in full."""
    scaled = 1e6 * value
    return f"{scaled:.0f}" if scaled >= 1000.0 else f"{scaled:.3g}"


def micrometres(length: float) -> str:
    """Return a length [m] in micrometres, with three digits or in full."""
    return f"{millionths(length)} um"


def at_least(length: float) -> str:
    """Return a length [m] in micrometres, rounded up: a tolerance that the length meets."""
    step = 10.0 ** (math.floor(math.log10(1e6 * length)) - 2)
    return f"{math.ceil(1e6 * length / step * (1.0 - 1e-12)) * step:.6g} um"


def parts_text(trial: Trial) -> str:
    """Return the parts of the error of a trial in words."""
    return ", ".join(f"{name} {micrometres(each)}" for name, each in trial.error_parts.items())
