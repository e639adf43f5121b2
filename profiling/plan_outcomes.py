"""Plans of random jobs against truth: the outcome of a job, and the shares of plans that hold."""

from __future__ import annotations

import argparse
import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from gpuvision.accuracy.plan import AccuracyPlan
from gpuvision.host import Device

_AMPLE = 1.25  # factor by which a setting is clearly accurate and fast enough. Chosen


class Outcome(NamedTuple):
    """Plan of a job, measured against truth.

    Attributes
    ----------
    plan : AccuracyPlan or None
        None where the planner refused.
    tolerance, error : float
        Asked and true root mean square error [m]; the latter NaN without a plan.
    possible : bool
        Whether a setting that truly meets the tolerance is fast enough for the rate.
    cost : float
        Time of the chosen setting over the time of the fastest one that truly meets the tolerance; NaN if none does.
    keeps_up : bool or None
        Whether the chosen setting kept up with the asked rate; None without a plan or a rate.
    room : float
        Largest factor by which a setting is truly more accurate than the tolerance and faster than the rate; NaN if
        unknown.
    note : str
        Measured numbers, or the reason of a refusal, for the line of the job. Default: none.
    is_known : bool
        Whether the search for the best setting was complete. Default True. Otherwise a cost of NaN is unknown, and so
        is whether a refused job was possible.
    """

    plan: AccuracyPlan[Any] | None
    tolerance: float
    error: float = math.nan
    possible: bool = False
    cost: float = math.nan
    keeps_up: bool | None = None
    room: float = math.nan
    note: str = ""
    is_known: bool = True


def room_of(errors: Sequence[float], times: Sequence[float], tolerance: float, rate: float) -> float:
    """Return the largest factor by which a setting is more accurate than a tolerance and faster than a rate.

    Parameters
    ----------
    errors, times : sequence of float
        True error [m] and time [s] of each setting.
    tolerance : float
        Largest error [m].
    rate : float
        Units of work per second [1/s].
    """
    factors = (min(tolerance / error, 1.0 / (time * rate)) for error, time in zip(errors, times, strict=True))
    return max(factors, default=0.0)


def cost_of(plan: AccuracyPlan[Any], meeting: Sequence[Any]) -> float:
    """Return the time of the chosen setting over the fastest one's of some trials of the plan; NaN without one."""
    return float(plan.chosen.seconds / min((each.seconds for each in meeting), default=math.nan))


def summary(outcomes: Sequence[Outcome]) -> str:
    """Return the shares of plans that hold, in lines of text."""
    made = [each for each in outcomes if each.plan is not None]
    refused = [each for each in outcomes if each.plan is None]
    costs = np.array([each.cost for each in made if math.isfinite(each.cost)])
    cheap, largest = int(np.sum(costs <= 1.5)), costs.max(initial=0.0)
    ratios = np.array([each.error / each.tolerance for each in made])
    kept_up = [each.keeps_up for each in made if each.keeps_up is not None]
    lines = [
        f"{len(outcomes)} jobs: {len(made)} plans, {len(refused)} refused",
        f"error within the tolerance: {int(np.sum(ratios <= 1.0))} of {len(made)}, largest "
        f"{ratios.max(initial=0.0):.2f} tolerances",
        f"kept up with the rate: {sum(kept_up)} of {len(kept_up)}",
        f"cost at most 1.5 times the best: {cheap} of {len(costs)}, largest {largest:.2f}",
        f"refused although a setting is truly accurate and fast enough: {_possible(refused)}",
    ]
    if unknown := [each for each in outcomes if not each.is_known]:
        count = sum(each.plan is not None for each in unknown)
        lines.append(
            f"unknown, because the search was not complete: the cost of {count} plans, and whether a setting is "
            f"possible for {len(unknown) - count} refused jobs"
        )
    return "\n".join(lines)


def _possible(refused: Sequence[Outcome]) -> str:
    """Return how many refused jobs were possible, and how many of them clearly, where that is known."""
    count = f"{sum(each.possible for each in refused)}"
    if all(math.isnan(each.room) for each in refused):
        return count
    return f"{count}, by a factor of {_AMPLE:g} or more: {sum(each.room >= _AMPLE for each in refused)}"


def run_jobs(judge: Callable[[np.random.Generator, Device], Outcome], description: str) -> int:
    """Run the command of a script: plan random jobs, print each and the summary.

    Parameters
    ----------
    judge : callable
        Draws a job and measures its plan against truth.
    description : str
        Help text of the command.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--jobs", type=int, default=200, help="number of random jobs")
    parser.add_argument("--first", type=int, default=0, help="number of the first job")
    parser.add_argument("--seed", type=int, default=1, help="of the jobs")
    parser.add_argument("--device", help="label of a device; default: the best one")
    given = parser.parse_args()
    device = Device.best() if given.device is None else Device.named(given.device)
    outcomes: list[Outcome] = []
    with contextlib.suppress(KeyboardInterrupt):  # the summary holds the jobs up to then
        for number in range(given.first, given.first + given.jobs):
            outcomes.append(judge(np.random.default_rng((given.seed, number)), device))
            print(f"{number}: {_line(outcomes[-1])}", flush=True)
    print(summary(outcomes))
    return 0


def _line(outcome: Outcome) -> str:
    """Return the outcome of a job in one line."""
    asked = f"{1e6 * outcome.tolerance:.3g} um"
    if outcome.plan is None:
        return _refused_line(outcome, asked)
    cost = f"{outcome.cost:.2f}" if outcome.is_known else "unknown"
    speed = {None: "no rate", True: "kept up", False: "too slow"}[outcome.keeps_up]
    times = f"cost {cost}, {speed}"
    if outcome.note:
        times += f", {outcome.note}"
    return f"{outcome.plan.chosen.name}, {1e6 * outcome.error:.3g} of {asked}, {times}"


def _refused_line(outcome: Outcome, asked: str) -> str:
    """Return the line of a refused job."""
    line = "refused" if math.isnan(outcome.tolerance) else f"refused {asked}"
    if outcome.possible:
        line += ", which is possible" + ("" if math.isnan(outcome.room) else f" by a factor of {outcome.room:.2f}")
    elif not outcome.is_known:
        line += ", unknown whether it is possible"
    return f"{line}: {outcome.note}" if outcome.note else line
