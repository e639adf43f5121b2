"""Report and summary of a simulation: every entry."""

from __future__ import annotations

import math
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.simulation.light_paths import PATHS
from gpuvision.workflows import simulation_result
from gpuvision.workflows.simulation_result import Simulation, light_strength, simulation_files

ERRORS: dict[str, Any] = {
    "valid": 90,
    "surface": 100,
    "median": 1.25e-6,
    "p95": 2e-5,
    "beyond_limit": 7,
    "spurious": 3,
    "causes": {"occlusion": {"dominant": 2}, "glow": {"dominant": 5}},
}


def simulation(device: Device, errors: dict[str, Any] = ERRORS, light: Any = None, **changes: Any) -> Simulation:
    """Return a simulation of 3 profiles without arrays."""
    defects = PartDefects(holes=np.zeros(4), degenerate=np.zeros(2))
    values = {
        "task": SimpleNamespace(
            sensor=SimpleNamespace(name="corner", kind="psd", light=light),
            part=SimpleNamespace(corners=np.zeros((12, 3, 3)), defects=defects),
            transports=np.array([0.1, 0.2, 0.3]),
            paths=("direct", "diffuse-diffuse"),
            tolerance=1e-6,
            fingerprint="abc",
        ),
        "attribution": SimpleNamespace(summary=lambda limit: {**errors, "limit": limit}),
        "points": None,
        "heights": None,
        "grid": None,
        "limit": 5e-6,
        "threshold": 17.5,
        "mask": None,
        "statistics": {"pairs": 8.0},
        "device": device,
        "seconds": {"light": 0.5},
        "computed_blocks": 6,
    }
    return Simulation(**{**values, **changes})


class PartDefects(SimpleNamespace):
    """Defects of a part, with the fields that the report counts."""


MASK: Any = SimpleNamespace(
    error_before=np.array([np.nan, -40e-6, 10e-6]),
    error_after=np.array([5e-6, np.nan, -8e-6]),
    passed_fraction=np.array([0.75, np.nan, 0.5]),
)
SUMMARY = (
    "3 profiles, 90 of 100 samples read, errors 1.2 µm median, 20 µm p95, 7 beyond 5.0 µm (mostly glow), 3 spurious "
    "(a reading, but no lit surface in view)"
)


def test_summary(device: Device) -> None:
    assert simulation(device).summary() == SUMMARY
    none = {**ERRORS, "median": None, "p95": None}
    assert "errors 0.0 µm median, 0 µm p95" in simulation(device, none).summary()
    expected = f"{SUMMARY}\nlargest error of the centroid: 40 µm without, 8 µm with the mask"
    assert simulation(device, mask=MASK).summary() == expected


def test_report(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    names = [SimpleNamespace(name=name) for name in ("holes", "degenerate")]
    monkeypatch.setattr("gpuvision.workflows.simulation_result.fields", lambda _: names)
    omitted = [path for path in PATHS if path not in ("direct", "diffuse-diffuse")]
    expected = {
        "gpuvision": version("gpuvision"),
        "sensor": "corner",
        "kind": "psd",
        "profiles": 3,
        "triangles": 12,
        "defects": {"holes": 4, "degenerate": 2},
        "paths": ["direct", "diffuse-diffuse"],
        "tolerance": 1e-6,
        "threshold": 17.5,
        "errors": {**ERRORS, "limit": 5e-6},
        "mask": None,
        "light_statistics": {"pairs": 8.0},
        "not_in_bounds": [
            *(f"light path {path} (not simulated)" for path in omitted),
            "quadrature of indirect light (nodes per bin)",
            "rounding",
        ],
        "device": {"label": device.label, "name": device.name, "driver": device.driver},
        "light_fingerprint": "abc",
        "computed_blocks": 6,
        "seconds": {"light": 0.5},
    }
    assert simulation(device).report() == expected
    mask = simulation(device, mask=MASK).report()["mask"]
    assert mask == pytest.approx({"worst_without": 40e-6, "worst_with": 8e-6, "light_kept": 0.5})
    dark = SimpleNamespace(
        **{name: np.full(2, math.nan) for name in ("error_before", "error_after", "passed_fraction")}
    )
    assert set(simulation(device, mask=dark).report()["mask"].values()) == {None}


def test_what_no_bound_covers(device: Device) -> None:
    sheet = SimpleNamespace(thickness=1e-4)
    task = simulation(device, light=sheet).task
    task.paths = PATHS
    quadrature, slabs = "quadrature of indirect light (nodes per bin)", "slabs of the sheet of light (sub_sheets)"
    estimated = "patches of multi-bounce light (estimated error: see light_statistics)"
    without = [quadrature, slabs, "patches of multi-bounce light", "rounding"]
    assert simulation(device, task=task).not_in_bounds() == without
    statistics = {"estimated error of patches [m]": 1e-6}
    found = simulation(device, task=task, statistics=statistics).not_in_bounds()
    assert found == [quadrature, slabs, estimated, "rounding"]
    task.paths, sheet.thickness = ("direct",), 0.0
    left = [f"light path {path} (not simulated)" for path in PATHS if path != "direct"]
    assert simulation(device, task=task).not_in_bounds() == [*left, "rounding"]
    bounded = simulation(device, task=task, statistics={"bound of multi-bounce left out [m]": 1e-6}).not_in_bounds()
    assert bounded == [*(each for each in left if "multi-bounce" not in each), "rounding"]


def test_direction_of_the_transport(device: Device) -> None:
    task = simulation(device).task
    assert not simulation(device, task=task).moves_backward
    task.transports = task.transports[::-1]
    assert simulation(device, task=task).moves_backward


def test_light_strength_and_files() -> None:
    strength = light_strength(SimpleNamespace(strength=np.array([1.5, np.nan])))
    np.testing.assert_array_equal(strength, np.array([1.5, 0.0], np.float32))
    assert strength.dtype == np.float32
    assert set(simulation_files(has_mask=True)) - set(simulation_files(has_mask=False)) == {"mask.txt"}
    assert len(simulation_files(has_mask=False)) == 8


class Points(NamedTuple):
    """Points with their status."""

    x: str
    y: str
    z: str
    status: str


@pytest.mark.parametrize(("name", "title"), [("corner", "corner"), ("", "Simulation")])
def test_pictures_have_the_name_of_the_sensor(
    name: str, title: str, device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The transport of this task increases; the pictures of errors get the scale of both."""
    drawn: list[Any] = []
    written: dict[str, Any] = {}
    for writer in ("write_tiff", "write_png16", "write_ply", "write_npz"):
        monkeypatch.setattr(
            simulation_result, writer, lambda path, *given: written.update({path.name: given}) or path.touch()
        )
    for draw in ("draw_height_map", "draw_errors", "draw_causes"):
        monkeypatch.setattr(
            simulation_result, draw, lambda path, *given, **how: drawn.append((path.name, given, how)) or path.touch()
        )
    points = Points("x", "y", "z", "status")
    made = simulation(device, heights=SimpleNamespace(z="heights"), grid="grid", points=points)
    task, attribution = made.task, made.attribution
    task.sensor = SimpleNamespace(name=name, kind="psd", light=None, files=())
    attribution.reading = SimpleNamespace(strength=np.array([2.0, np.nan]))
    monkeypatch.setattr(simulation_result.Simulation, "_arrays", lambda _: ({}, {}))
    monkeypatch.setattr(simulation_result.Simulation, "report", lambda _: {"a": 1})
    scale: Any = "scale"
    made.write(tmp_path / "out", scale=scale)
    assert drawn == [
        ("picture.png", (made.heights, "grid"), {"title": f"{title}: as measured"}),
        ("errors.png", (attribution, title, "scale"), {"backward": False}),
        ("causes.png", (attribution, title, "scale"), {"backward": False}),
    ]
    assert written["range_image.tiff"] == written["range_image.png"] == ("heights", "grid")
    *places, strength, status = written["range_image.ply"]
    assert (places, strength.tolist(), status) == (["x", "y", "z"], [2.0, 0.0], "status")
    assert written["simulation.npz"] == ({}, {})
    assert (tmp_path / "out" / "report.json").read_text() == '{\n "a": 1\n}\n'
    drawn.clear()
    monkeypatch.setattr(simulation_result.PictureScale, "of", lambda parts, limit: (parts, limit))
    made.write(tmp_path / "out")
    assert [given[-1] for _, given, _ in drawn[1:]] == [([attribution], 5e-6)] * 2
