"""The reference page of sensor files lists every key that the reader asks for."""

from __future__ import annotations

import copy
import re
import tomllib
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.schema import DescriptionError, Section
from gpuvision.sensor.sensor import Sensor

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "sensor_files.md"
PRESETS = {
    Path(each.name).stem: tomllib.loads(each.read_text(encoding="utf-8"))
    for each in resources.files("gpuvision").joinpath("presets", "sensors").iterdir()
}
POSE = {"sheet_origin": [0.0, 0.0, 0.2], "g_axis": [1.0, 0.0, 0.0], "h_axis": [0.0, -0.5, -0.8]}


# Defaults that stand in the text below the heading of their table.
IN_TEXT = {("axes", "position_pitch"): 1.0, ("axes", "sample_pitch"): 1.0, ("triangulation", "horizon"): 1e-3}


def described() -> Iterator[dict[str, Any]]:
    """Yield sensors that reach every reader; those with missing keys are read up to the missing key."""
    yield from PRESETS.values()
    camera = copy.deepcopy(PRESETS["camera_line"])
    for way in (
        {"homography": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]},
        {"constants": [1, 2, 3, 4]},
        {"points": [[0, 0, 0, 0]]},
        {"focal_length_px": 1000.0, "principal_point_px": [1.0, 1.0], **POSE},
        {"p": [0.0, *[1.0] * 7], "q": [1.0] * 8},
    ):
        yield camera | {"triangulation": way}
    matrix = [[1000.0, 0.0, 240.0], [0.0, 1000.0, 32.0], [0.0, 0.0, 1.0]]
    tilted = {key: value for key, value in camera.items() if key not in ("lens", "axes")}
    yield tilted | {"camera": {"matrix": matrix}, "triangulation": POSE}
    yield tilted | {"camera": {"file": "camera.toml"}, "triangulation": POSE}
    yield camera | {"lens": {"file": "lens.toml"}}
    for name in ("camera_line", "corner_scene"):
        moving = {key: value for key, value in PRESETS[name]["transport"].items() if "step" not in key}
        yield PRESETS[name] | {"transport": moving | {"encoder": "none.csv"}}
    corner = PRESETS["corner_scene"]
    yield corner | {"transport": corner["transport"] | {"sigma": {}}}
    mirror = {"apothem": 0.05, "facets": 8, "height": 0.3, "first_rotation": 0.0, "rotation_step": 1e-3}
    yield PRESETS["psd_line"] | {"polygon": mirror}
    output = {"output": {"cell": 1e-4}}
    lens = {"focal_length": 0.05, "first": 0.055, "spacing": 5e-4, "pixel_pitch": 5e-6, "stand_off": 0.5}
    for focus in (lens, {"stage_step": 1e-4, "pixel_size": 1e-5}):
        yield {"kind": "focus", "frame": {"columns": 2, "rows": 2}, "focus": focus, **output}


def asked(monkeypatch: pytest.MonkeyPatch) -> set[tuple[str, str]]:
    """Return table and key of everything that the readers of these sensors ask for."""
    found: set[tuple[str, str]] = set()

    class Recorded(list[str]):
        def __init__(self, name: str) -> None:
            self.name = name

        def append(self, key: str) -> None:
            found.add((self.name, key))
            super().append(key)

    create = Section.__init__

    def recorded(section: Section, table: Any, source: str, name: str = "", **more: Any) -> None:
        create(section, table, source, name, **more)
        section._queried = Recorded(name)

    monkeypatch.setattr(Section, "__init__", recorded)
    for each in described():
        try:
            Sensor.from_section(Section(each, "sensor.toml"))
        except (DescriptionError, FileNotFoundError):
            continue
    return found


def documented() -> dict[str, set[str]]:
    """Return the names in code type by the table of their heading; "" is the top level, with the tables' headings."""
    text = PAGE.read_text(encoding="utf-8").split("## Keys\n")[1].split("\n## ")[0]
    names: dict[str, set[str]] = {"": set()}
    table = ""
    for line in text.splitlines():
        if line.startswith("### "):
            heading = re.fullmatch(r"### `\[([a-z.]+)\]`", line)
            table = heading[1] if heading else ""
            names.setdefault(table, set())
            names[""].add(table)
        names[table] |= set(re.findall(r"`([a-zA-Z_0-9]+)`", line))
    return names


def test_every_key_of_the_reader_is_on_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    page = documented()
    keys = asked(monkeypatch)
    assert len(keys) > 130
    missing = {
        f"{table}.{key}"
        for table, key in keys
        if key not in page.get(table, set()) and f"{table}.{key}".removeprefix(".") not in page
    }
    assert missing == set()


def test_every_table_of_the_page_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    tables = {table for table, _ in asked(monkeypatch)}
    assert set(documented()) - {""} <= tables


def stated_defaults() -> dict[tuple[str, str], str]:
    """Return the texts of the column `default` by table and key."""
    found = {}
    table, has_defaults = "", False
    for line in PAGE.read_text(encoding="utf-8").split("## Keys\n")[1].split("\n## ")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("### "):
            heading = re.fullmatch(r"### `\[([a-z.]+)\]`", line)
            table = heading[1] if heading else ""
        elif line.startswith("| key"):
            has_defaults = cells[2] == "default"
        elif line.startswith("| `") and has_defaults:
            keys = re.findall(r"`(\w+)`", cells[0])
            texts = re.split(r", (?![^(]*\))", cells[2])
            for key, text in zip(keys, texts if len(texts) == len(keys) else [cells[2]] * len(keys), strict=True):
                found[table, key] = text
    return found


def test_numbers_that_the_page_states_are_the_defaults(monkeypatch: pytest.MonkeyPatch) -> None:
    read: dict[tuple[str, str], set[Any]] = {}
    value_of = Section._value

    def recorded(section: Section, key: str, expected: str, default: Any) -> Any:
        numbers = default if isinstance(default, tuple) else (default,)
        if all(isinstance(each, int | float) for each in numbers):
            read.setdefault((section.name, key), set()).add(default)
        return value_of(section, key, expected, default)

    monkeypatch.setattr(Section, "_value", recorded)
    asked(monkeypatch)
    stated = stated_defaults()
    compared = 0
    for place, defaults in read.items():
        if place not in stated:  # in the text of its table; what it does not name is 0
            assert {number for each in defaults for number in np.atleast_1d(each)} == {IN_TEXT.get(place, 0.0)}, place
            continue
        numbers = [float(each) for each in re.findall(r"-?\d[\d.]*", stated[place].replace(" ", ""))]
        if numbers and not re.search("[a-z]", stated[place]):
            for default in defaults:
                assert (list(default) if isinstance(default, tuple) else [default]) == numbers, place
                compared += 1
    assert compared > 30
