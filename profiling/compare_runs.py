"""Comparison of two benchmark runs: whether their ratios agree within their confidence intervals.

``python -m gpuvision.profiling.compare_runs FIRST.json SECOND.json`` lists the rows that are not compared, with the
reason, the rows that do not agree, and the share of the rows that do. The exit code is 1 if fewer than 90 % agree, or
if a run is invalid because the machine changed its speed, and 2 if a file is not a run.

Two ratios agree if their logarithms differ by at most the half-widths of their 95 % confidence intervals, added as
squares. The intervals hold the spread within a run and the spread between runs, `rounds.BETWEEN_RUNS`. About 95 % of
the rows of two runs of the same code should agree.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import NamedTuple

from gpuvision.host.errors import ReadError
from gpuvision.profiling.run import Row, Run
from gpuvision.profiling.stored_run import read_run

_AGREEING = 0.9  # smallest share of agreeing rows


class Change(NamedTuple):
    """Ratio of one row in two runs.

    Attributes
    ----------
    row
        Operation, case, device and peer.
    first, second
        Ratios in the two runs.
    agree
        Whether the ratios differ by no more than their intervals explain.
    """

    row: str
    first: float
    second: float
    agree: bool


def compare(first: Run, second: Run) -> list[Change]:
    """Return the change of each row that both runs contain with 95 % confidence and with the same form of the peer."""
    one, other = _by_name(first), _by_name(second)
    changes = []
    for name in one.keys() & other.keys():
        mine, theirs = one[name].interval, other[name].interval
        if mine is not None and theirs is not None and one[name].form == other[name].form:
            before, after = one[name].ratio, other[name].ratio
            limit = 0.5 * math.hypot(*(math.log(high / low) for low, high in (mine, theirs)))
            changes.append(Change(name, before, after, abs(math.log(after / before)) <= limit))
    return sorted(changes)


def left_out(first: Run, second: Run) -> list[str]:
    """Return a line with the reason for each row that `compare` leaves out."""
    one, other = _by_name(first), _by_name(second)
    lines = [f"{name}: only in the first run" for name in sorted(one.keys() - other.keys())]
    lines += [f"{name}: only in the second run" for name in sorted(other.keys() - one.keys())]
    for name in sorted(one.keys() & other.keys()):
        forms = one[name].form, other[name].form
        if forms[0] != forms[1]:
            lines.append(f"{name}: the fastest form is {forms[0]!r} in the first run, {forms[1]!r} in the second one")
        elif any(each[name].interval is None for each in (one, other)):
            lines.append(f"{name}: no interval with 95 % confidence")
    return lines


def _by_name(run: Run) -> dict[str, Row]:
    return {f"{row.operation} {row.case} {row.device} {row.peer}": row for row in run.rows}


def report(changes: Sequence[Change]) -> list[str]:
    """Return lines about the rows that do not agree, and about the share of rows that agree."""
    apart = [each for each in changes if not each.agree]
    lines = [
        f"{each.row}: {each.first:.2f} -> {each.second:.2f} ({100 * (each.second / each.first - 1):+.0f} %)"
        for each in apart
    ]
    return [*lines, f"{len(changes) - len(apart)} of {len(changes)} rows agree within their intervals"]


def main(paths: Sequence[str]) -> int:
    """Print the report of two files; return the exit code."""
    try:
        first, second = map(read_run, paths)
    except (ReadError, OSError) as error:
        print(error, file=sys.stderr)
        return 2
    changes = compare(first, second)
    invalid = [path for path, run in zip(paths, (first, second), strict=True) if not run.valid]
    lines = [f"{path} is not valid: the machine changed its speed during the measurement" for path in invalid]
    lines += [f"not compared: {line}" for line in left_out(first, second)]
    print("\n".join([*lines, *report(changes)]))
    agreeing = sum(each.agree for each in changes) >= _AGREEING * len(changes)
    return int(bool(invalid) or not changes or not agreeing)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m gpuvision.profiling.compare_runs FIRST.json SECOND.json")
    sys.exit(main(sys.argv[1:]))
