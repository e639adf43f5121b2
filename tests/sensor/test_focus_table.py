"""Table ``[focus]`` of a sensor file: values and their fields, defaults, and the ends of their ranges."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import pytest

from gpuvision.ranging.focus_stack import FocusStack, LensFocus, StageFocus
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.schema import DescriptionError, Section
from gpuvision.sensor.focus import read_focus
from gpuvision.sensor.sensor import Sensor

STAGE = {"stage_start": 3e-3, "stage_step": -5e-5, "pixel_size": 1e-5}
LENS = {"focal_length": 0.05, "first": 0.055, "spacing": 5e-4, "pixel_pitch": 5e-6, "stand_off": 0.6}


def read(table: dict[str, Any]) -> FocusStack:
    return read_focus(Section(dict(table), "sensor.toml", "focus"))


def test_every_value_reaches_its_field() -> None:
    fields = {"measure": "intensity", "window": 3, "neighbours": 2, "threshold": 4.5, "ambiguity": 0.3}
    fields |= {"saturation": 250.0, "read_noise": 1.5, "gain": 0.05}
    found = read(STAGE | fields | {"principal_point_px": [320.5, 200.25]})
    assert found == FocusStack(
        geometry=StageFocus(start=3e-3, step=-5e-5, pixel_size=1e-5), principal_point_px=(320.5, 200.25), **fields
    )
    assert read(LENS) == FocusStack(geometry=LensFocus(**LENS))
    assert read(STAGE) == FocusStack(geometry=StageFocus(start=3e-3, step=-5e-5, pixel_size=1e-5))
    without_start = {key: value for key, value in STAGE.items() if key != "stage_start"}
    assert read(without_start) == replace(read(STAGE), geometry=StageFocus(start=0.0, step=-5e-5, pixel_size=1e-5))


@pytest.mark.parametrize(
    ("table", "key", "accepted", "refused"),
    [
        (STAGE, "window", [0, 100], [-1, 101]),
        (STAGE, "neighbours", [1, 20], [0, 21]),
        (STAGE, "threshold", [0.0], [-1e-12]),
        (STAGE, "ambiguity", [1e-12, 1.0], [0.0, math.nextafter(1.0, 2.0)]),
        (STAGE, "saturation", [1e-12], [0.0]),
        (STAGE, "read_noise", [1e-12], [0.0]),
        (STAGE | {"read_noise": 1.0}, "gain", [0.0], [-1e-12]),
        (STAGE, "pixel_size", [1e-12], [0.0]),
        (LENS | {"first": 2.0}, "focal_length", [1e-12], [0.0]),
        (LENS | {"focal_length": 1e-13}, "first", [1e-12], [0.0]),
        (LENS, "spacing", [1e-12], [0.0]),
        (LENS, "pixel_pitch", [1e-12], [0.0]),
        (LENS, "stand_off", [1e-12], [0.0]),
        (STAGE, "principal_point_px", [[0.0, -1.0]], [[1.0], [1.0, 2.0, 3.0]]),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_ends_of_the_ranges(table: dict[str, Any], key: str, accepted: list[Any], refused: list[Any]) -> None:
    for value in accepted:
        read(table | {key: value})
    for value in refused:
        with pytest.raises(DescriptionError, match=re.escape(f"sensor.toml: focus.{key} is {value}")):
            read(table | {key: value})


def test_a_focus_stack_is_a_sensor_without_transport() -> None:
    """x right, y up in the image, heights towards the camera; the noise is known if the file gives it."""
    described = {"kind": "focus", "focus": STAGE, "frame": {"columns": 40, "rows": 30}, "output": {"cell": 2e-5}}
    plain = Sensor.from_section(Section(described, "sensor.toml"))
    noisy = Sensor.from_section(Section(described | {"focus": STAGE | {"read_noise": 1.5}}, "sensor.toml"))
    assert (plain.kind, plain.readout, plain.frame) == ("focus", read(STAGE), (30, 40))
    assert plain.transport == StraightTransport(
        g_axis=(1.0, 0.0, 0.0), h_axis=(0.0, 0.0, 1.0), direction=(0.0, -1.0, 0.0)
    )
    assert (plain.noise_known, noisy.noise_known) == (False, True)
