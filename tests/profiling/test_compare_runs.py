"""Comparison of two benchmark runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gpuvision.profiling import compare_runs
from gpuvision.profiling.run import Row, Run


def run(*rows: Row, valid: bool = True) -> Run:
    return Run(rows=list(rows), valid=valid, machine={"cores": 2})


def row(case: str, ratio: float, **changes: Any) -> Row:
    columns = {"operation": "psd", "case": case, "device": "pocl", "seconds": 1e-3, "peer": "numba"}
    columns |= {"peer_version": "0", "peer_seconds": 1e-3 * ratio, "ratio": ratio, "error": 0.0, "fraction": None}
    columns |= {"confidence": 0.96, "ratio_low": 0.9 * ratio, "ratio_high": 1.1 * ratio}
    return Row(**columns | changes)


def stored(path: Path, run: Run) -> str:
    run.write(path)
    return str(path)


def test_rows_agree_when_their_intervals_explain_the_change() -> None:
    # Half-widths: the logarithm of about 1.1 within a run and 0.08 between runs, in both runs: a factor of 1.196.
    first = run(row("a", 1.0), row("b", 1.0), row("c", 1.0))
    second = run(row("c", 0.8), row("b", 1.19), row("a", 1.23))
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
    paths = [stored(tmp_path / f"{valid}.json", run(row("a", 1.0), valid=valid)) for valid in (True, False)]
    assert compare_runs.main(paths) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"{paths[1]} is not valid: the machine changed its speed during the measurement"
    assert lines[-1] == "1 of 1 rows agree within their intervals"


@pytest.mark.parametrize(("apart", "code"), [(0, 0), (1, 0), (2, 1), (10, 1)])
def test_the_exit_code_is_1_if_fewer_than_nine_of_ten_rows_agree(tmp_path: Path, apart: int, code: int) -> None:
    paths = []
    for number, ratio in enumerate((1.0, 2.0)):
        rows = [row(str(k), ratio if k < apart else 1.0) for k in range(10)]
        paths.append(stored(tmp_path / f"{number}.json", run(*rows)))
    assert compare_runs.main(paths) == code


@pytest.mark.parametrize(
    ("text", "reason"), [("{}", "not a run of gpuvision profile"), ("[", "not a readable JSON file")]
)
def test_a_file_that_is_no_run_is_named_in_one_line(
    text: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good, bad = stored(tmp_path / "good.json", run(row("a", 1.0))), tmp_path / "bad.json"
    bad.write_text(text)
    assert compare_runs.main([good, str(bad)]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.count("\n") == 1
    assert str(bad) in said.err
    assert reason in said.err


def test_a_missing_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare_runs.main([str(tmp_path / "none.json")] * 2) == 2
    assert str(tmp_path / "none.json") in capsys.readouterr().err
