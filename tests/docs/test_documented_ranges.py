"""Ranges that docstrings state for numbers are the ranges that the operations accept, exactly at their ends."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from gpuvision.formats.height_files import ImageScale
from gpuvision.inspection.paste import PasteSettings
from gpuvision.ranging.focus_stack import FocusStack, StageFocus
from gpuvision.simulation.clustering.light_clustering import LightClustering
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from test_arguments import EXAMPLES

ROTATING = gv.RotatingSheet(
    focal_length_px=1000.0,
    principal_point_px=(1.0, 1.0),
    axis_point=(1.0, 0.0, 0.0),
    axis_direction=(0.0, 1.0, 0.0),
    sheet_normal=(1.0, 0.0, 0.0),
    first_angle=0.1,
    angle_step=1e-3,
)
SCENE = gv.Scene(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]))
CHECKED = [
    *EXAMPLES,
    FocusStack(geometry=StageFocus(start=0.0, step=1e-4, pixel_size=1e-5), threshold=1.0, ambiguity=0.5),
    gv.MergeHeights(max_sigmas=3.0),
    ROTATING,
    PasteSettings(stencil=1e-4),
    ImageScale(cell_x=1e-5, cell_y=1e-5, step=1e-6),
    VisibleIntervals(scene=SCENE),
    ClosestHit(scene=SCENE),
    AnyHit(scene=SCENE),
    LightClustering(scene=SCENE, tolerance=0.1, clearance=1e-5),
]
_ENTRY = re.compile(r"^(?P<names>\w+(?:, \w+)*)(?: :[^\n]*)?\n(?P<text>(?:(?:[ ]{4}[^\n]*)?\n)+)", re.MULTILINE)
_NUMBER = r"(-?\d+(?:\.\d+)?(?:e-?\d+)?)"
# Phrases of the docstrings; `positive` is "above 0".
_RANGE = re.compile(
    rf"\b(?:above {_NUMBER}(?:, at most {_NUMBER})?|{_NUMBER} or more|{_NUMBER} to {_NUMBER}(, exclusive)?"
    rf"|at least {_NUMBER}|(positive)\b)|(>= 0)"
)
# Ranges of another number than the parameter, and ranges that another parameter narrows.
OTHERS = {
    ("Material", "mirror"),  # at most 1 together with the diffuse part
    ("LightClustering", "clearance"),  # 0 or at least 4e-6 of the scene's size
    ("RulerEdges", "length"),  # long enough for the smoothing
}


def _texts(kind: type) -> dict[str, str]:
    """Return the text of each parameter of a class."""
    found = {}
    for entry in _ENTRY.finditer(inspect.cleandoc(kind.__doc__ or "") + "\n"):
        found |= dict.fromkeys(entry["names"].split(", "), " ".join(entry["text"].split()))
    return found


def _ranges(example: Any) -> Iterator[tuple[str, list[float], list[float]]]:
    """Yield a field, accepted values and refused values at the ends of its range."""
    texts = _texts(type(example))
    for field in dataclasses.fields(example):
        number = str(field.type).removesuffix(" | None")
        stated = _RANGE.search(texts.get(field.name, ""))
        if number not in ("int", "float") or stated is None or (type(example).__name__, field.name) in OTHERS:
            continue
        above, most, least, low, high, exclusive, at_least, positive, not_negative = stated.groups()
        first = next(each for each in (above, least, low, at_least, "0") if each is not None)
        last = most or high
        open_below, open_above = above is not None or bool(positive or exclusive), bool(exclusive)
        assert not_negative or positive or first in stated[0]
        accepted, refused = [], []
        for end, is_open, outwards in ((first, open_below, -1.0), (last, open_above, 1.0)):
            if end is not None:
                beyond = float(end) + outwards if number == "int" else math.nextafter(float(end), outwards * math.inf)
                (refused if is_open else accepted).append(float(end))
                refused += [] if is_open else [beyond]
        yield field.name, accepted, refused


@pytest.mark.parametrize("example", CHECKED, ids=lambda each: type(each).__name__)
def test_ends_of_a_range(example: Any) -> None:
    kinds = {field.name: str(field.type) for field in dataclasses.fields(example)}
    for name, accepted, refused in _ranges(example):
        number = int if kinds[name].startswith("int") else float
        for value in accepted:
            dataclasses.replace(example, **{name: number(value)})
        for value in refused:
            with pytest.raises(ValueError, match=rf"{name}\b"):  # the shown arguments name the value
                dataclasses.replace(example, **{name: number(value)})


def test_most_numbers_have_a_range() -> None:
    assert sum(len(list(_ranges(example))) for example in CHECKED) > 60
    assert [each for each in _ranges(gv.FitLines()) if each[0] == "min_scale"] == [("min_scale", [0.0], [-5e-324])]
