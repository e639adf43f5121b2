"""Table of the README: the committed results, and what happens when a row is missing."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gpuvision.profiling import tables

ROOT = Path(__file__).resolve().parents[2]


def _results(folder: Path, **changes: Any) -> Path:
    row = {"seconds": 1.36e-4, "ratio": 6.04, "error": 1.53e-5, **changes}
    rows = [
        {"operation": each.operation, "case": each.case, "peer": each.peer, "device": device, **row}
        for each in tables.COMPARISONS
        for device in tables.DEVICES
    ]
    (folder / "run.json").write_text(json.dumps({"rows": rows}))
    return folder


def test_readme_has_the_table_of_the_committed_results() -> None:
    """`python -m gpuvision.profiling.tables README.md` writes the table again."""
    text = (ROOT / "README.md").read_text()
    assert tables.with_table(text, tables.comparison_table(ROOT / "profiling" / "results")) == text


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (2.5, "2.5 s"),
        (0.0282, "28 ms"),
        (1.36e-4, "136 µs"),
        (9.97e-5, "100 µs"),
        (9.94e-5, "99 µs"),
        (3.75e-6, "3.8 µs"),
        (5e-7, "0.50 µs"),
    ],
)
def test_times_have_a_unit_and_two_digits(seconds: float, text: str, tmp_path: Path) -> None:
    line = tables.comparison_table(_results(tmp_path, seconds=seconds)).splitlines()[2]
    assert line == f"| PSD, 1e6 samples of float32 | Numba | {text} | 6.0 | {text} | 6.0 | 1.5e-5 m |"


def test_error_is_the_largest_of_the_devices(tmp_path: Path) -> None:
    folder = _results(tmp_path)
    run = json.loads((folder / "run.json").read_text())
    run["rows"][1]["error"] = 0.25  # Intel's
    (folder / "run.json").write_text(json.dumps(run))
    assert tables.comparison_table(folder).splitlines()[2].endswith("| 0.25 m |")


def test_an_error_of_zero_is_named_where_it_can_be_zero(tmp_path: Path) -> None:
    lines = tables.comparison_table(_results(tmp_path, error=0.0)).splitlines()
    assert sum("no ray differs" in line for line in lines) == 1


def test_a_missing_row_is_an_error(tmp_path: Path) -> None:
    folder = _results(tmp_path)
    run = json.loads((folder / "run.json").read_text())
    (folder / "run.json").write_text(json.dumps({"rows": run["rows"][1:]}))
    with pytest.raises(KeyError, match="psd"):
        tables.comparison_table(folder)


def test_a_text_without_marks_is_refused() -> None:
    with pytest.raises(ValueError, match="expected one table between"):
        tables.with_table("no table", "| a |\n")
