"""JSON reports: plain trees without infinities or NaN."""

from __future__ import annotations

import json
import math
from typing import Any


def json_tree(value: Any) -> Any:
    """Return a copy of a tree with None for infinities and NaN, which JSON cannot represent."""
    if isinstance(value, dict):
        return {key: json_tree(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [json_tree(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def report_text(report: Any) -> str:
    """Return the text of a report file: JSON with one space for each level of a tree, and a line feed at the end.

    Raises
    ------
    ValueError
        A number is infinite or NaN; see `json_tree`.
    """
    return json.dumps(report, indent=1, allow_nan=False) + "\n"
