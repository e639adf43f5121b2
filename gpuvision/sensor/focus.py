"""Reader of the table ``[focus]`` of a sensor file: depth from focus with a stack of images."""

from __future__ import annotations

from gpuvision.ranging.focus_stack import MEASURES, FocusStack, LensFocus, StageFocus
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.schema import Section

FOCUS_PLACE = StraightTransport(direction=(0.0, -1.0, 0.0))
"""Directions of the columns, the height and the rows of a focus stack: x right, y up in the image, z to the camera."""


def read_focus(table: Section) -> FocusStack:
    """Read the focus stack of a sensor.

    Raises
    ------
    DescriptionError
        A key is missing or unknown, or a value is out of range.
    """
    default = FocusStack(geometry=StageFocus(start=0.0, step=1.0, pixel_size=1.0))
    with table.checking():
        stack = FocusStack(
            geometry=_lens(table) if "focal_length" in table else _stage(table),
            measure=table.choice("measure", MEASURES, default.measure),
            window=table.integer("window", default.window, at_least=0, at_most=100),
            neighbours=table.integer("neighbours", default.neighbours, at_least=1, at_most=20),
            threshold=table.number("threshold", "grey levels", default.threshold, at_least=0.0),
            ambiguity=table.number("ambiguity", "share of the peak", None, above=0.0, at_most=1.0),
            saturation=table.number("saturation", "grey levels", None, above=0.0),
            read_noise=table.number("read_noise", "grey levels", None, above=0.0),
            gain=table.number("gain", "grey levels per electron", default.gain, at_least=0.0),
            principal_point_px=_pair(table.numbers("principal_point_px", "pixel", (2,), None)),
        )
        table.finish()
    return stack


def _pair(values: tuple[float, ...] | None) -> tuple[float, float] | None:
    return None if values is None else (values[0], values[1])


def _lens(table: Section) -> LensFocus:
    return LensFocus(
        focal_length=table.number("focal_length", "m", above=0.0),
        first=table.number("first", "m", above=0.0),
        spacing=table.number("spacing", "m per frame", above=0.0),
        pixel_pitch=table.number("pixel_pitch", "m", above=0.0),
        stand_off=table.number("stand_off", "m", above=0.0),
    )


def _stage(table: Section) -> StageFocus:
    return StageFocus(
        start=table.number("stage_start", "m", 0.0),
        step=table.number("stage_step", "m per frame"),
        pixel_size=table.number("pixel_size", "m", above=0.0),
    )
