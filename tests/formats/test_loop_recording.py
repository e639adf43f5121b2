"""CSV files of a servo loop: the values, the empty cell, and the faults that are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gpuvision.formats.loop_recording import read_loop_recording
from gpuvision.host.errors import ReadError

HEADER = "time,command,measured\n"


def test_rows_are_read(tmp_path: Path) -> None:
    path = tmp_path / "loop.csv"
    path.write_text(HEADER + "0,1e-3,\n0.001,2e-3,1.5e-3\n\n0.002,2e-3,nan\n")
    found = read_loop_recording(path)
    assert found.time.tolist() == [0.0, 0.001, 0.002]
    assert found.command.tolist() == [1e-3, 2e-3, 2e-3]
    assert np.isnan(found.measured[[0, 2]]).all()
    assert found.measured[1] == 1.5e-3


def test_numbers_up_to_a_million_are_read(tmp_path: Path) -> None:
    path = tmp_path / "loop.csv"
    path.write_text(HEADER + "-1e6,1e6,-1e6\n1e6,-1e6,1e6\n")
    found = read_loop_recording(path)
    np.testing.assert_array_equal(found, [[-1e6, 1e6], [1e6, -1e6], [-1e6, 1e6]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,c,m\n0,0,0\n", "the header is not time,command,measured"),
        (HEADER, "no sample"),
        (HEADER + "0,0\n", "line 2 has 2 cells"),
        (HEADER + "0,nan,0\n", "line 2: expected finite numbers"),
        (HEADER + "0,0,0\n1,0,inf\n", "line 3: expected finite numbers"),
        (HEADER + "0,x,0\n", "loop.csv"),
        (HEADER + "0,0,0\n1,x,0\n", r"line 3: '1,x,0', expected numbers"),
        (HEADER + "0,0,0\n1,1e308,0\n", r"line 3: command is 1e\+308, expected a magnitude of at most 1e\+06 m or rad"),
        (HEADER + "0,0,0\n1,0,-1e7\n", r"line 3: measured is -1e\+07"),
        (HEADER + "0,0,0\n0.5,0,0\n0.5,0,0\n", r"line 4: time is 0\.5 after 0\.5, expected a later one"),
        (HEADER + "0,0,0\n1,0,0\n2,0,0\n3,0,0\n2.5,0,0\n", r"line 6: time is 2\.5 after 3, expected a later one"),
        (HEADER + "0," + 100 * "x" + ",0\n", f"line 2: '0,{58 * 'x'}', expected numbers"),
        ("", "the file is empty; expected the header time,command,measured"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "loop.csv"
    path.write_text(text)
    with pytest.raises(ReadError, match=message):
        read_loop_recording(path)


def test_number_of_samples_is_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_LOOP_SAMPLES", "2")
    path = tmp_path / "loop.csv"
    path.write_text(HEADER + "0,0,0\n1,1,1\n2,2,2\n")
    with pytest.raises(ReadError, match="GPUVISION_MAX_LOOP_SAMPLES"):
        read_loop_recording(path)
