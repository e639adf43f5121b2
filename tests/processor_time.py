"""Processor time of each test, and the table of the files that take most of it."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator

import pytest

# Files of the table; and the least total that is printed [s]: a run of few tests needs no table.
_ROWS, _LEAST_TOTAL = 10, 60.0
_PROPERTY = "processor_time"
_START = pytest.StashKey[float]()


def record_test(item: pytest.Item) -> None:
    """Start the processor time of a test; on the second call add it to the properties of the test's last report."""
    now = sum(os.times()[:4])  # all threads of this process and its ended subprocesses, user and system
    if _START in item.stash:
        item.user_properties.append((_PROPERTY, now - item.stash[_START]))
        del item.stash[_START]
    else:
        item.stash[_START] = now


def table_of_files(reports: Iterable[pytest.TestReport]) -> Iterator[str]:
    """Yield lines: the total processor time of the reported tests, and the files with the most."""
    seconds: Counter[str] = Counter()
    tests: Counter[str] = Counter()
    for each in reports:
        path = each.nodeid.partition("::")[0]
        tests[path] += 1
        seconds[path] += sum(value for name, value in each.user_properties if name == _PROPERTY)
    total = sum(seconds.values())
    if total < _LEAST_TOTAL:
        return
    yield f"processor time of {sum(tests.values())} tests: {total:.0f} s; most of it in"
    for path, value in seconds.most_common(_ROWS):
        yield f"{value:8.1f} s {tests[path]:5d} tests  {path}"
