"""Comparison of two benchmark runs: whether their ratios agree within their confidence intervals.

``python -m gpuvision.profiling.compare_runs FIRST.json SECOND.json`` lists the rows that do not agree, and the share of
the rows that do. The exit code is 1 if fewer than 90 % agree.

Two medians with 95 % confidence intervals of rounds within a run agree if the intervals overlap. The intervals hold the
spread within a run; the spread between runs (place of the arrays in memory, frequency) comes on top.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

_CONFIDENCE = 0.95
_AGREEING = 0.9  # smallest share of agreeing rows
_KEYS = ("operation", "case", "device", "peer")


class Change(NamedTuple):
    """Ratio of one row in two runs.

    Attributes
    ----------
    row
        Operation, case, device and peer.
    first, second
        Ratios in the two runs.
    agree
        Whether the confidence intervals overlap.
    """

    row: str
    first: float
    second: float
    agree: bool


def compare(first: Mapping[str, Any], second: Mapping[str, Any]) -> list[Change]:
    """Return the change of each row that both runs contain with 95 % confidence and with the same form of the peer."""
    others = {_key(row): row for row in second["rows"] if _stated(row)}
    return [
        Change(
            " ".join(_key(row)[:-1]),
            row["ratio"],
            other["ratio"],
            row["ratio_low"] <= other["ratio_high"] and other["ratio_low"] <= row["ratio_high"],
        )
        for row in first["rows"]
        if _stated(row) and (other := others.get(_key(row)))
    ]


def _key(row: Mapping[str, Any]) -> tuple[str, ...]:
    return (*(row[name] for name in _KEYS), row.get("form", ""))


def _stated(row: Mapping[str, Any]) -> bool:
    return (row.get("confidence") or 0.0) >= _CONFIDENCE


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
    changes = compare(*(json.loads(Path(path).read_text()) for path in paths))
    print("\n".join(report(changes)))
    return int(sum(each.agree for each in changes) < _AGREEING * len(changes) or not changes)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit("usage: python -m gpuvision.profiling.compare_runs FIRST.json SECOND.json")
    sys.exit(main(sys.argv[1:]))
