"""Readout of a sensor file: the tables ``[line]``, ``[psd]``, ``[psd.noise]`` and ``[axes]``."""

from __future__ import annotations

from typing import Literal, cast

from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import METHODS, WIDEST_WINDOW, Method
from gpuvision.ranging.psd import PsdNoise, PsdReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.ranging.triangulation_model import Along
from gpuvision.schema import Section
from gpuvision.sensor.light_source import Light


def read_axes(table: Section | None) -> SampleAxes:
    """Read the table ``[axes]``; without one, positions and samples are the coordinates of the triangulation."""
    if table is None:
        return SampleAxes()
    names = ("position_origin", "position_pitch", "sample_origin", "sample_pitch")
    values = {name: table.number(name, "sensor unit", getattr(SampleAxes(), name)) for name in names}
    table.finish()
    return SampleAxes(**values)


def read_line_readout(table: Section, along: Along, sheet: Triangulation | None, axes: SampleAxes) -> LineReadout:
    """Read the table ``[line]``.

    Parameters
    ----------
    table : Section
        Table; its key ``along`` is read before.
    along : {"columns", "rows"}
        Image axis along which the line runs.
    sheet : Triangulation, optional
        Triangulation; None for a rotating sheet.
    axes : SampleAxes
        Map from positions and samples to the coordinates of the triangulation.

    Returns
    -------
    LineReadout

    Raises
    ------
    DescriptionError
        A key is missing, unknown or has a wrong value.
    """
    default = LineReadout()
    threshold = default.threshold
    if table.word("threshold", ("auto",)) is None:
        threshold = table.number("threshold", "grey levels", default.threshold, at_least=0.0)
    readout = LineReadout(
        along=along,
        method=table.choice("method", cast(tuple[Method, ...], METHODS), default.method),
        threshold=threshold,
        window=table.integer("window", default.window, at_least=1, at_most=WIDEST_WINDOW),
        # "nearest" needs the reading before: a recording is read in batches, of which all frames run at once.
        peak_selection=table.choice("peak_selection", ("strongest", "first", "last"), default.peak_selection),
        minimum_peak=table.number("minimum_peak", "grey levels", None, at_least=0.0),
        minimum_width=table.integer("minimum_width", default.minimum_width, at_least=1),
        maximum_width=table.integer("maximum_width", None, at_least=1),
        saturation=table.number("saturation", "grey levels", None, above=0.0),
        ambiguity=table.number("ambiguity", "share of the peak", None, above=0.0, at_most=1.0),
        fir_length=cast(Literal[4, 8], table.integer("fir_length", default.fir_length, at_least=4, at_most=8)),
        read_noise=table.number("read_noise", "grey levels", default.read_noise, at_least=0.0),
        gain=table.number("gain", "grey levels per electron", default.gain, at_least=0.0),
        speckle=table.number("speckle", "pixel", default.speckle, at_least=0.0),
        triangulation=sheet,
        axes=axes,
    )
    table.finish()
    return readout


def read_psd_readout(table: Section, sheet: Triangulation | None, axes: SampleAxes, light: Light | None) -> PsdReadout:
    """Read the tables ``[psd]`` and ``[psd.noise]``.

    Parameters
    ----------
    table : Section
        Table; its key ``strips`` is read before.
    sheet, axes
        As for `read_line_readout`.
    light : Light, optional
        Light source; its ambient light is the default of the background.

    Returns
    -------
    PsdReadout

    Raises
    ------
    DescriptionError
        A key is missing, unknown or has a wrong value.
    """
    left, right = table.numbers("dark", "A", (2,), (0.0, 0.0))
    readout = PsdReadout(
        strip_length=table.number("strip_length", "m", above=0.0),
        ampere=table.number("ampere", "A per unit of the recording", 1.0, above=0.0),
        dark=(left, right),
        right_gain=table.number("right_gain", "", 1.0, above=0.0),
        interelectrode_resistance=table.number("interelectrode_resistance", "Ohm", None, above=0.0),
        load_resistance=table.number("load_resistance", "Ohm", 0.0, at_least=0.0),
        minimum_total=table.number("minimum_total", "A", 0.0, at_least=0.0),
        saturation=table.number("saturation", "A", None, above=0.0),
        linearity=table.rows("linearity", "m", default=None),
        margin=table.number("margin", "m", None, at_least=0.0),
        noise=_noise(table.optional_section("noise"), 0.0 if light is None else light.responsivity * light.ambient),
        triangulation=sheet,
        axes=axes,
    )
    table.finish()
    return readout


def _noise(table: Section | None, ambient: float) -> PsdNoise | None:
    """Read the noise of a PSD; without a background it is the photocurrent of the light's ambient light [A]."""
    if table is None:
        return None
    units = {"independent": "A", "opposed": "A", "spot": "m", "bandwidth": "Hz", "dark_current": "A"}
    values = {name: table.number(name, unit, 0.0, at_least=0.0) for name, unit in units.items()}
    background = table.number("background", "A", ambient if values["bandwidth"] > 0.0 else 0.0, at_least=0.0)
    noise = PsdNoise(**values, background=background)
    table.finish()
    return noise
