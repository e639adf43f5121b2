"""Camera preset files (TOML): the sensors of the package, messages that name the key, and the reference page."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.sensor_readout import SensorReadout
from gpuvision.formats.cmos_sensor_file import CMOS_SENSORS, read_cmos_sensor
from gpuvision.schema import DescriptionError, Section

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "camera_presets.md"
TEXT = """
name = "mine"
estimated = "gain dark_noise"
[array]
rows = 10
columns = 20
pitch = 5e-6
pixel = "direct_read"
response_time = 2e-6
[response]
quantum_efficiency = 0.5
wavelength = 630e-9
gain = 0.1
full_well = 1e4
bits = 10
dark_level = 3.0
nonlinearity = 0.02
[noise]
dark_noise = 7.0
dsnu = 1.0
prnu = 0.01
dark_current = 5.0
[readout]
pixel_clock = 1e7
taps = 2
shutter = "rolling"
row_overhead = 1e-6
frame_overhead = 2e-6
exposure = "alternating"
buffers = 3
"""


def write(folder: Path, text: str) -> Path:
    path = folder / "camera.toml"
    path.write_text(text)
    return path


def test_a_file_is_read(tmp_path: Path) -> None:
    assert read_cmos_sensor(write(tmp_path, TEXT)) == CmosSensor(
        name="mine",
        estimated=("gain", "dark_noise"),
        rows=10,
        columns=20,
        pitch=5e-6,
        pixel="direct_read",
        response_time=2e-6,
        quantum_efficiency=0.5,
        wavelength=630e-9,
        gain=0.1,
        full_well=1e4,
        bits=10,
        dark_level=3.0,
        nonlinearity=0.02,
        dark_noise=7.0,
        dsnu=1.0,
        prnu=0.01,
        dark_current=5.0,
        readout=SensorReadout(
            pixel_clock=1e7,
            taps=2,
            shutter="rolling",
            row_overhead=1e-6,
            frame_overhead=2e-6,
            overlaps=False,
            buffers=3,
        ),
    )


def test_presets_state_their_frame_rates_and_their_estimates() -> None:
    rates = {name: read_cmos_sensor(name).timing(exposure=1e-4).rate for name in CMOS_SENSORS}
    assert rates == pytest.approx({"lupa300": 250.0, "pb1024": 503.5}, rel=0.001)
    for name in CMOS_SENSORS:
        assert {"quantum_efficiency", "gain", "dark_noise"} <= set(read_cmos_sensor(name).estimated)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("rows = 10", "", "'array.rows' is missing"),
        ("pitch = 5e-6", "pitch = -5e-6", r"array.pitch is -5e-06 m, expected a number \[m\] above 0"),
        ("bits = 10", "bits = 17", "response.bits is 17, expected a whole number"),
        ("taps = 2", "tabs = 2", "unknown key 'readout.tabs'; did you mean 'readout.taps'"),
        ('estimated = "gain dark_noise"', 'estimated = "gains"', "'gains'"),
        ("response_time = 2e-6", "", "response_time"),
        ('"alternating"', '"sometimes"', "readout.exposure"),
    ],
)
def test_messages_name_the_key(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert TEXT.count(old) == 1
    with pytest.raises(DescriptionError, match=message):
        read_cmos_sensor(write(tmp_path, TEXT.replace(old, new)))


def test_the_reference_page_lists_every_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The text above gives every key: without one of them reading falls back to the default, or fails."""
    given = tomllib.loads(TEXT)
    tables = {name for name, value in given.items() if isinstance(value, dict)}
    read = {("", key) for key in given.keys() - tables} | {(name, key) for name in tables for key in given[name]}
    asked = set()
    queried = Section._value

    def note(self: Section, key: str, *arguments: Any) -> Any:
        asked.add((self.name if self.name in tables else "", key))
        return queried(self, key, *arguments)

    monkeypatch.setattr(Section, "_value", note)
    read_cmos_sensor(write(tmp_path, TEXT))
    assert asked - {("", name) for name in tables} == read
    listed, table = set(), ""
    for line in PAGE.read_text().partition("## Keys")[2].splitlines():
        if heading := re.match(r"### `\[(\w+)\]`", line):
            table = heading[1]
        if key := re.match(r"\| `(\w+)` \|", line):
            listed.add((table, key[1]))
    assert listed == read
