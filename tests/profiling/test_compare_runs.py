"""Comparison of two benchmark runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gpuvision.profiling import compare_runs


def run(*rows: dict[str, Any]) -> dict[str, Any]:
    common = {"operation": "psd", "device": "pocl", "peer": "numba", "form": "", "confidence": 0.96}
    return {"valid": True, "rows": [common | row for row in rows]}


def row(case: str, ratio: float, **changes: Any) -> dict[str, Any]:
    return {"case": case, "ratio": ratio, "ratio_low": 0.9 * ratio, "ratio_high": 1.1 * ratio} | changes


def test_rows_agree_when_their_intervals_overlap() -> None:
    first = run(row("a", 1.0), row("b", 1.0), row("c", 1.0))
    second = run(row("c", 0.8), row("b", 1.21), row("a", 1.23))
    changes = compare_runs.compare(first, second)
    assert [(each.row, each.agree) for each in changes] == [
        ("psd a pocl numba", False),
        ("psd b pocl numba", True),
        ("psd c pocl numba", False),
    ]
    assert compare_runs.report(changes) == [
        "psd a pocl numba: 1.00 -> 1.23 (+23 %)",
        "psd c pocl numba: 1.00 -> 0.80 (-20 %)",
        "1 of 3 rows agree within their intervals",
    ]


@pytest.mark.parametrize("changes", [{"confidence": 0.5}, {"confidence": None}, {"form": "words"}, {"device": "intel"}])
def test_only_rows_with_the_same_names_and_enough_rounds_are_compared(changes: dict[str, Any]) -> None:
    assert compare_runs.compare(run(row("a", 1.0)), run(row("a", 1.0, **changes))) == []
    assert compare_runs.compare(run(row("a", 1.0, **changes)), run(row("a", 1.0))) == []


def test_rows_that_are_not_compared_are_listed_with_the_reason() -> None:
    first = run(row("a", 1.0), row("b", 1.0), row("c", 1.0), row("d", 1.0))
    second = run(row("a", 1.0), row("b", 1.0, confidence=0.5), row("c", 1.0, form="words"), row("e", 1.0))
    assert compare_runs.left_out(first, second) == [
        "psd d pocl numba: only in the first run",
        "psd e pocl numba: only in the second run",
        "psd b pocl numba: no interval with 95 % confidence",
        "psd c pocl numba: the fastest form is '' in the first run, 'words' in the second one",
    ]


def test_an_invalid_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = [str(tmp_path / f"{number}.json") for number in range(2)]
    for path, valid in zip(paths, (True, False), strict=True):
        Path(path).write_text(json.dumps(run(row("a", 1.0)) | {"valid": valid}))
    assert compare_runs.main(paths) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{paths[1]} is not valid: the machine changed its speed during the measurement"
    assert lines[-1] == "1 of 1 rows agree within their intervals"


@pytest.mark.parametrize(("apart", "code"), [(0, 0), (1, 0), (2, 1), (10, 1)])
def test_the_exit_code_is_1_if_fewer_than_nine_of_ten_rows_agree(tmp_path: Path, apart: int, code: int) -> None:
    paths = []
    for number, ratio in enumerate((1.0, 2.0)):
        rows = [row(str(k), ratio if k < apart else 1.0) for k in range(10)]
        paths.append(str(tmp_path / f"{number}.json"))
        Path(paths[-1]).write_text(json.dumps(run(*rows)))
    assert compare_runs.main(paths) == code
