"""Table of the README, computed from the committed results in ``profiling/results``.

``python -m gpuvision.profiling.tables README.md`` writes the table between its two marks again; a test fails when the
table and the results differ.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

BEGIN, END = "<!-- begin: comparison with peers -->\n", "<!-- end: comparison with peers -->\n"
DEVICES = {"pocl": "PoCL", "intel": "Intel"}
_UNITS = ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs"))


class Comparison(NamedTuple):
    """Line of the table.

    Attributes
    ----------
    work
        Description of the work.
    operation, case, peer
        Columns of the row in the results.
    peer_name
        Name of the peer in the table.
    unit
        Unit of the error; empty for relative errors.
    exact
        Text for an error of 0; None where the error is never 0.
    """

    work: str
    operation: str
    case: str
    peer: str
    peer_name: str
    unit: str
    exact: str | None = None


COMPARISONS = (
    Comparison("PSD, 1e6 samples of float32", "psd", "float32/1e6", "numba", "Numba", "m"),
    Comparison("PSD, 1e6 samples of 16-bit codes", "psd", "uint16/1e6", "numba", "Numba", "m"),
    Comparison(
        "PSD, 1e4 samples of 16-bit codes, one batch at a time", "psd", "uint16/1e4-alone", "numba", "Numba", "m"
    ),
    Comparison("laser line, 16 frames of 512 x 1024", "line", "whole/16", "numba", "Numba", "px"),
    Comparison(
        "undistortion, 1024² pixels of 8 bits", "undistort", "uint8/bilinear/1024", "opencv", "OpenCV", "levels"
    ),
    Comparison("undistortion, 1e6 points", "points", "opencv/1e6", "numba", "Numba", "px"),
    Comparison("lens from 12 752 points", "calibration", "fit/66x96", "discorpy", "discorpy", "px"),
    Comparison("100 calipers (rulers) of 64 x 5 pixels", "ruler", "100", "numba", "Numba", "px"),
    Comparison("pose from 100 rulers, lines and covariance included", "pose", "local-fix", "numba", "Numba", "m"),
    Comparison(
        "interreflection with occluders, a board",
        "reflections",
        "board/1024",
        "numpy+embreex",
        "NumPy, Embree",
        "",
    ),
    Comparison(
        "any hit of 256 000 rays, 1752 triangles",
        "bvh",
        "any-hit/board",
        "embreex",
        "Embree",
        "",
        "no ray differs",
    ),
    Comparison("registration of two images", "registration", "pair", "opencv", "OpenCV", "px"),
)


def comparison_table(folder: Path) -> str:
    """Return the table for the results in a folder, as Markdown.

    Raises
    ------
    KeyError
        A row of the table is not in the results of a device.
    """
    rows = _rows(folder)
    header = [
        "work",
        "peer",
        *(column for name in DEVICES.values() for column in (name, "ratio")),
        "error of gpuvision",
    ]
    lines = [_line(header), _line(["---"] * len(header))]
    for each in COMPARISONS:
        found = [rows[each.operation, each.case, each.peer, device] for device in DEVICES]
        times = [cell for row in found for cell in (_time(row["seconds"]), _digits(row["ratio"]))]
        lines.append(_line([each.work, each.peer_name, *times, _error(each, found)]))
    return "".join(lines)


def _rows(folder: Path) -> dict[tuple[str, ...], Mapping[str, Any]]:
    """Return the rows of all runs against peers by operation, case, peer and device."""
    runs = [json.loads(path.read_text()) for path in sorted(folder.glob("[!.]*.json"))]
    rows = [row for run in runs for row in run["rows"] if "peer" in row]
    return {(row["operation"], row["case"], row["peer"], row["device"]): row for row in rows}


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cells) + " |\n"


def _time(seconds: float) -> str:
    """Return a time with two digits, from 100 on without a fraction."""
    unit, name = next(((unit, name) for unit, name in _UNITS if seconds >= unit), _UNITS[-1])
    return f"{_digits(seconds / unit)} {name}"


def _digits(value: float) -> str:
    """Return a number with two significant digits, or rounded to a whole number where this has more."""
    return f"{value:.0f}" if value >= 99.5 else f"{value:#.2g}".removesuffix(".")


def _error(comparison: Comparison, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the largest error over the devices."""
    error = max(row["error"] for row in rows)
    if error == 0.0 and comparison.exact is not None:
        return comparison.exact
    text = _digits(error) if error >= 1e-3 else re.sub("e-0*", "e-", f"{error:.1e}")
    return f"{text} {comparison.unit}".strip()


def with_table(text: str, table: str) -> str:
    """Return a text with the table between its two marks replaced.

    Raises
    ------
    ValueError
        The text does not have the two marks once.
    """
    pattern = re.escape(BEGIN) + ".*?" + re.escape(END)
    if len(re.findall(pattern, text, re.DOTALL)) != 1:
        raise ValueError(f"expected one table between {BEGIN.strip()!r} and {END.strip()!r}")
    return re.sub(pattern, lambda _: f"{BEGIN}{table}{END}", text, flags=re.DOTALL)


if __name__ == "__main__":
    results = Path(__file__).resolve().parent / "results"
    for name in sys.argv[1:]:
        path = Path(name)
        path.write_text(with_table(path.read_text(), comparison_table(results)))
