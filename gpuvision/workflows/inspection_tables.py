"""Tables and reports of inspections."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gpuvision.formats.json import report_text
from gpuvision.host.files import write_text_atomic


def write_tables(folder: Path, name: str, rows: Sequence[Mapping[str, Any]], report: dict[str, Any]) -> None:
    """Write rows as CSV and a report as JSON; unknown numbers are empty cells."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        known = {
            key: "" if isinstance(value, float) and not math.isfinite(value) else value for key, value in row.items()
        }
        writer.writerow(known)
    write_text_atomic(folder / name, text.getvalue())
    write_text_atomic(folder / "report.json", report_text(report))
