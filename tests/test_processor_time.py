"""The run ends with the test files that take the most processor time."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from processor_time import record_test, table_of_files


def report_of(nodeid: str, *seconds: float) -> pytest.TestReport:
    properties = [("device", "pocl"), *(("processor_time", value) for value in seconds)]
    return pytest.TestReport(nodeid, (nodeid, 1, ""), {}, "passed", None, "teardown", user_properties=properties)


def test_the_table_sums_the_tests_of_a_file() -> None:
    reports = [report_of("a.py::test_x[1]", 40.0), report_of("b.py::test_y", 70.0), report_of("a.py::test_x[2]", 45.5)]
    assert list(table_of_files(reports)) == [
        "processor time of 3 tests: 156 s; most of it in",
        "    85.5 s     2 tests  a.py",
        "    70.0 s     1 tests  b.py",
    ]
    assert len(list(table_of_files(report_of(f"{k}.py::test", 10.0) for k in range(30)))) == 11


def test_a_short_run_has_no_table() -> None:
    assert list(table_of_files([report_of("a.py::test_x", 59.0), report_of("a.py::test_y")])) == []


def test_a_test_has_the_time_between_its_records(monkeypatch: pytest.MonkeyPatch) -> None:
    item: Any = SimpleNamespace(stash=pytest.Stash(), user_properties=[])
    for seconds in (2.0, 7.5):
        # User and system time of this process and of its subprocesses, then the time of the clock.
        monkeypatch.setattr("processor_time.os.times", lambda each=seconds: (each, 1.0, 0.25 * each, 0.0, 99.0 * each))
        record_test(item)
    assert item.user_properties == [("processor_time", 5.5 * 1.25)]
