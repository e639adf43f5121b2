"""Camera preset files: TOML with the EMVA 1288 parameters and the readout of a CMOS sensor, in SI units and electrons.

The package contains the sensors in `CMOS_SENSORS`; ``docs/reference/camera_presets.md`` lists the keys.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.sensor_readout import SensorReadout
from gpuvision.schema import Section, read_preset

CMOS_SENSORS = ("lupa300", "pb1024")
"""Names of the sensors in the package."""


def read_cmos_sensor(path: str | Path) -> CmosSensor:
    """Read a CMOS sensor.

    Parameters
    ----------
    path : str or Path
        Path of a file, or one of `CMOS_SENSORS`.

    Returns
    -------
    CmosSensor

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is missing, unknown or has a wrong value; the message names the key.
    """
    return _sensor(read_preset(path, "cameras", "image sensor"))


def _sensor(top: Section) -> CmosSensor:
    name, estimated = top.text("name", ""), top.text("estimated", "")
    array, response, noise = (top.section(key) for key in ("array", "response", "noise"))
    readout = _readout(top.section("readout"))
    top.finish()
    # Unknown keys are refused before `CmosSensor` compares the values: a misspelt key has a default here.
    make = partial(
        CmosSensor,
        rows=array.integer("rows", at_least=1),
        columns=array.integer("columns", at_least=1),
        pitch=array.number("pitch", "m", above=0.0),
        pixel=array.choice("pixel", ("integrating", "direct_read"), "integrating"),
        response_time=array.number("response_time", "s", 0.0, at_least=0.0),
        quantum_efficiency=response.number("quantum_efficiency", "electrons per photon", above=0.0, at_most=1.0),
        wavelength=response.number("wavelength", "m", 550e-9, above=0.0),
        gain=response.number("gain", "grey levels per electron", above=0.0),
        full_well=response.number("full_well", "electrons", above=0.0),
        bits=response.integer("bits", at_least=1, at_most=16),
        dark_level=response.number("dark_level", "grey levels", 0.0, at_least=0.0),
        nonlinearity=response.number("nonlinearity", "", 0.0, at_least=0.0, below=0.5),
        dark_noise=noise.number("dark_noise", "electrons", at_least=0.0),
        dsnu=noise.number("dsnu", "electrons", 0.0, at_least=0.0),
        prnu=noise.number("prnu", "", 0.0, at_least=0.0),
        dark_current=noise.number("dark_current", "electrons/s", 0.0, at_least=0.0),
        readout=readout,
        name=name,
        estimated=tuple(estimated.split()),
    )
    for each in (array, response, noise):
        each.finish()
    with top.checking():
        return make()


def _readout(table: Section) -> SensorReadout:
    readout = SensorReadout(
        pixel_clock=table.number("pixel_clock", "Hz", above=0.0),
        taps=table.integer("taps", 1, at_least=1),
        shutter=table.choice("shutter", ("global", "rolling"), "global"),
        row_overhead=table.number("row_overhead", "s", 0.0, at_least=0.0),
        frame_overhead=table.number("frame_overhead", "s", 0.0, at_least=0.0),
        overlaps=table.choice("exposure", ("overlapping", "alternating"), "overlapping") == "overlapping",
        buffers=table.integer("buffers", 0, at_least=0),
    )
    table.finish()
    return readout
