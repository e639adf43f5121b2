"""Texts of reports."""

from __future__ import annotations

import math

import pytest

from gpuvision.formats.json import json_tree, report_text


def test_infinities_and_nan_become_null() -> None:
    tree = {"a": [1.5, math.inf, (2, math.nan)], "b": {"c": -math.inf, "d": "text", "e": None, "f": True}}
    assert json_tree(tree) == {"a": [1.5, None, [2, None]], "b": {"c": None, "d": "text", "e": None, "f": True}}


def test_a_report_has_one_space_for_each_level() -> None:
    assert report_text({"a": [1, 0.5], "b": {}}) == '{\n "a": [\n  1,\n  0.5\n ],\n "b": {}\n}\n'
    for value in (math.inf, math.nan):
        with pytest.raises(ValueError, match="not JSON compliant"):
            report_text({"a": value})
