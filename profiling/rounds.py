"""Interleaved timing of several functions within a given time, and the spread of a median."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Hashable, Mapping
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

_MOST_ROUNDS = 101
_FEWEST_ROUNDS = 2  # of a call that is slower than its share of the time; one round if a turn takes all of the time
_WARM_UP = 1e-3  # duration of untimed calls before a timed one [s]
_CALLS_PER_TURN = 3
# A call of 10 ms is timed once in a turn: its time hardly depends on a single interrupt. A call of 100 ms has no
# untimed call before it: loading caches of some 10 MB takes about 1 % of its time.
_LONG_CALL, _LONGEST_WARMED_CALL = 0.01, 0.1  # [s]
CONFIDENCE = 0.95  # least confidence of an interval that is shown
# Half of the 95 % interval of a ratio between runs of the same code, relative: arrays at other places in memory, other
# frequency, other work of the machine. Fitted to 262 ratios of two runs of 19 minutes on an idle machine: 96 % of them
# differ by less than this and the rounds within the runs explain; half of them by less than 2 %.
BETWEEN_RUNS = 0.08

K = TypeVar("K", bound=Hashable)


class MedianInterval(NamedTuple):
    """Confidence interval of a median, from order statistics.

    Attributes
    ----------
    low, high
        Limits of the interval.
    confidence
        Probability that the interval contains the median of the distribution: at least 0.95 for 6 values and more. For
        fewer values the interval is their range, and its confidence is smaller.
    """

    low: float
    high: float
    confidence: float


def median_interval(values: NDArray[Any]) -> MedianInterval:
    """Return the shortest central interval of order statistics that contains the median with 95 % confidence.

    Each of n independent values is below the median with probability 1/2. The k-th smallest and the k-th largest value
    enclose the median unless fewer than k values are on one of its sides: confidence 1 - 2 P(B < k) with B binomial
    (n, 1/2). No distribution of the values is assumed.

    References
    ----------
    H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed., section 7.1, Wiley, 2003.
    """
    ordered = np.sort(values)
    count = len(ordered)
    outside, rank, confidence = 0.0, 1, 1.0 - 2.0 ** (1 - count)
    for k in range(1, count // 2 + 1):
        outside += math.comb(count, k - 1) * 2.0 ** (1 - count)
        if 1.0 - outside < CONFIDENCE:
            break
        rank, confidence = k, 1.0 - outside
    return MedianInterval(float(ordered[rank - 1]), float(ordered[-rank]), confidence)


def stated_interval(row: Mapping[str, Any]) -> tuple[float, float] | None:
    """Return the confidence interval of the ratio of a row by columns, for a run at another time.

    The interval of the rounds within the run is widened by `BETWEEN_RUNS`; as logarithms, the half-widths add up as
    squares. It is None if the rounds give less than 95 % confidence.
    """
    low, high = row.get("ratio_low"), row.get("ratio_high")
    sure = (row.get("confidence") or 0.0) >= CONFIDENCE
    if not sure or low is None or high is None:
        return None
    ratio = float(row["ratio"])
    below, above = (math.hypot(math.log(each / ratio), BETWEEN_RUNS) for each in (low, high))
    return ratio * math.exp(-below), ratio * math.exp(above)


def take_turns(calls: Mapping[K, Callable[[], object]], seconds: float, always: K) -> dict[K, NDArray[Any]]:
    """Time the calls interleaved for about ``seconds`` [s]; return the durations [s] by round, NaN without a turn.

    The call ``always`` takes part in every round. Calls slower than it take part in fewer rounds, spread over the
    measurement: in two at least, or in one if a turn takes all of the time.
    """
    turns = {name: _prepare(call) for name, call in calls.items()}
    counts = _rounds({name: turn.seconds for name, turn in turns.items()}, seconds)
    rounds = counts[always]
    durations = {name: np.full(rounds, np.nan) for name in calls}
    for number in range(rounds):
        # A predecessor that fills the caches costs time: each round has a different order.
        for place in np.random.default_rng(number).permutation(len(turns)):
            name = list(turns)[place]
            share = min(counts[name], rounds)
            if (number + 1) * share // rounds > number * share // rounds:
                durations[name][number] = turns[name].run()
    return durations


class _Turn(NamedTuple):
    """Turn of a call in a round.

    Attributes
    ----------
    run
        Function that takes the turn and returns the duration of the call [s].
    seconds
        Expected duration of the turn [s].
    """

    run: Callable[[], float]
    seconds: float


def _prepare(call: Callable[[], object]) -> _Turn:
    """Call a function twice: the first call compiles, allocates and fills caches, the second one is timed."""
    call()
    once = _duration(call)
    warm_up = 0.0 if once >= _LONGEST_WARMED_CALL else _WARM_UP
    timed = 1 if once >= _LONG_CALL else _CALLS_PER_TURN
    return _Turn(lambda: _take_turn(call, warm_up, timed), (max(once, warm_up) if warm_up else 0.0) + timed * once)


def _take_turn(call: Callable[[], object], warm_up: float, timed: int) -> float:
    """Return the median time of a few calls [s], after untimed calls that fill the caches with the data of `call`."""
    begun = time.perf_counter()
    while time.perf_counter() - begun < warm_up:
        call()
    return float(np.median([_duration(call) for _ in range(timed)]))


def _duration(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def _rounds(costs: Mapping[K, float], seconds: float) -> dict[K, int]:
    """Return the number of rounds of each call: equal shares of the time; cheap calls leave a part of it to others."""
    counts: dict[K, int] = {}
    left = seconds
    for place, name in enumerate(sorted(costs, key=lambda name: costs[name])):
        cost = max(costs[name], 1e-9)
        fewest = _FEWEST_ROUNDS if cost < seconds else 1
        counts[name] = min(max(int(left / (len(costs) - place) / cost), fewest), _MOST_ROUNDS)
        left -= counts[name] * cost
    return counts
