"""Ranges, units and defaults of the keys of every TOML file: they are what `keys_of_files.txt` states.

A range or a default is a decision, which no other test of a reader repeats: the list is its second statement. Whoever
changes one changes the list, the page of the keys and CHANGELOG.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from fuzz.readers import READERS, SEEDS
from gpuvision.schema import Section
from gpuvision.sensor.sensor import Sensor

LIST = Path(__file__).with_name("keys_of_files.txt")
FILES = ("camera", "cmos_sensor", "features", "field", "machine", "materials", "sensor")
OUTPUT = {"output": {"cell": 1e-4}}
POLYGON = {
    "kind": "psd",
    "psd": {"strips": 61, "strip_length": 6e-3},
    "triangulation": {"constants": [12.0, 0.05, -20.0]},
    "polygon": {"apothem": 0.05, "facets": 8, "height": 0.4, "first_rotation": -0.15, "rotation_step": 0.005},
    "transport": {"kind": "straight", "step": 4e-3},
}
FOCUS = {"kind": "focus", "frame": {"columns": 4, "rows": 3}}
STAGE = {"stage_start": 0.0, "stage_step": 1e-4, "pixel_size": 2e-6}
LENS = {"focal_length": 0.05, "first": 0.055, "spacing": 5e-4, "pixel_pitch": 5e-6, "stand_off": 0.5}


def _asked(monkeypatch: pytest.MonkeyPatch) -> set[str]:
    """Read a file of each kind; return the lines of the list."""
    asked: set[str] = set()
    value_of = Section._value

    def recorded(section: Section, key: str, expected: str, default: Any) -> Any:
        name = re.sub(r"\[\d+\]", "", section.dotted(key))
        # The limit and the default of this key are 1 and 3 times the cell.
        expected = "a number [m]" if name == "output.max_gap" else expected
        otherwise = "3 cells" if name == "output.max_gap" else repr(default)
        asked.add(f"{file}: {name}: {expected}; {'required' if type(default) is object else otherwise}")
        return value_of(section, key, expected, default)

    monkeypatch.setattr(Section, "_value", recorded)
    for file in FILES:
        READERS[f"{file}.toml"].read(SEEDS / f"{file}.toml")
    for name in ("camera_line", "corner_scene", "psd_line"):
        Sensor.load(name)
    for table in (POLYGON, FOCUS | {"focus": STAGE}, FOCUS | {"focus": LENS}):
        Sensor.from_section(Section(table | OUTPUT, "sensor.toml"))
    return asked


def test_ranges_and_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    stated = {line for line in LIST.read_text(encoding="utf-8").splitlines() if not line.startswith("#")}
    assert _asked(monkeypatch) == stated
