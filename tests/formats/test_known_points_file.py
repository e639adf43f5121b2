"""CSV files of known points."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gpuvision.formats.known_points_file import read_known_points
from gpuvision.host.errors import ReadError

HEADER = "column, row, x, y, z\n"


def test_points_are_read(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(HEADER + "1.5,2,0.1,0.2,0.3\n\n3,4,-1e-3,0,5\n")
    pixels, places = read_known_points(path)
    np.testing.assert_array_equal(pixels, [[1.5, 2.0], [3.0, 4.0]])
    np.testing.assert_array_equal(places, [[0.1, 0.2, 0.3], [-1e-3, 0.0, 5.0]])


def test_ten_thousand_points_are_read(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(HEADER + "1,2,3,4,5\n" * 9_999 + "6,7,8,9,10\n")
    pixels, places = read_known_points(path)
    assert (len(pixels), pixels[-1].tolist(), places[-1].tolist()) == (10_000, [6.0, 7.0], [8.0, 9.0, 10.0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("u,v,x,y,z\n1,2,3,4,5\n", "the header is not column,row,x,y,z"),
        (HEADER, "0 points, expected 1 to"),
        (HEADER + "1,2,3,4,5\n" * 10_001, "10001 points, expected 1 to 10000"),
        (HEADER + "1,2,3,4,5\n1,2,3,4\n", "line 3 has not five finite numbers"),
        (HEADER + "1,2,3,4,5,6\n", "line 2 has not five finite numbers, expected column,row,x,y,z"),
        (HEADER + "\n\n1,2,3,4,inf\n", "line 4 has not five finite numbers"),
        (HEADER + "1,2,3,4,nan\n", "line 2 has not five finite numbers"),
        (HEADER + "1,2,x,4,5\n", "points.csv"),
    ],
)
def test_other_files_are_refused(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text(text)
    with pytest.raises(ReadError, match=said):
        read_known_points(path)
