"""Key of stored light: it changes with the sources and with every field of the description that is not excluded."""

from __future__ import annotations

import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import gpuvision
from gpuvision.sensor.light_source import Light
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.workflows import light_cache, light_key
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.light_key import NOT_OPTICAL, key_of, source_files

MATERIAL = Material(diffuse=Lambert(albedo=0.5))


def task_of(sensor: Sensor, tolerance: float = 0.0) -> SimulationTask:
    scene = Scene(np.array([[(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)]]))
    return SimulationTask(
        part=scene, materials=(MATERIAL,), sensor=sensor, transports=np.zeros(3), paths=("direct",), tolerance=tolerance
    )


@pytest.fixture
def copied_sources(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Path]:
    """Return copies of the sources, which the key is computed from."""
    copies = {}
    for name, path in source_files().items():
        copies[name] = tmp_path / name
        copies[name].parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(path, copies[name])
    monkeypatch.setattr(light_key, "source_files", lambda: copies)
    return copies


@pytest.mark.parametrize(
    "name", ["simulation/transport/direct.py", "kernels/common/bvh.h", "host/launch.py", "workflows/light_cache.py"]
)
def test_a_changed_source_changes_the_key(name: str, copied_sources: dict[str, Path]) -> None:
    sensor = Sensor.load("psd_line")

    def key() -> str:
        light_key.source_digest.cache_clear()
        return task_of(sensor).fingerprint

    try:
        before, content = key(), copied_sources[name].read_bytes()
        copied_sources[name].write_bytes(content + b"\n")
        assert key() != before
        copied_sources[name].write_bytes(content)
        assert key() == before
    finally:
        light_key.source_digest.cache_clear()


def test_all_sources_of_light_are_in_the_key(tmp_path: Path) -> None:
    """Every module that a computation of light imports, and every kernel."""
    code = """
import os, sys
import numpy as np
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows.light_cache import SimulationTask, compute_block
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS
scene = Scene(np.array([[(-.1, -.1, 0), (.1, -.1, 0), (.1, .1, .0)], [(-.1, -.1, 0), (.1, .1, 0), (-.1, .1, .0)]]))
made = (Material(diffuse=Lambert(albedo=0.5), mirror=0.1),)
task = SimulationTask(part=scene, materials=made, sensor=Sensor.load("psd_line"), transports=np.zeros(1), paths=PATHS,
                      tolerance=1e-6)
compute_block(task, 0)
print("\\n".join(os.path.realpath(m.__file__) for n, m in sys.modules.items() if n.startswith("gpuvision")
                and getattr(m, "__file__", None)))
"""
    ran = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True)
    imported = {Path(line) for line in ran.stdout.split()}
    assert len(imported) > 60
    known = {path.resolve() for path in source_files().values()}
    kernels = Path(os.fspath(next(iter(gpuvision.__path__)))).resolve().parent / "kernels"
    if kernels.is_dir():  # a checkout
        imported |= {path for path in kernels.rglob("*") if path.suffix in (".cl", ".h")}
    assert imported - known == set()


def test_new_fields_are_in_the_key() -> None:
    """A field that nobody has listed changes the key; fields of the electronics do not."""

    @dataclasses.dataclass(frozen=True, kw_only=True)
    class SpreadLight(Light):
        divergence: float = 0.0

    sensor = Sensor.load("psd_line")
    assert sensor.light is not None
    values = {each.name: getattr(sensor.light, each.name) for each in dataclasses.fields(Light)}

    def key(tolerance: float = 0.0, **change: Any) -> str:
        light = SpreadLight(**(values | change))
        return task_of(dataclasses.replace(sensor, light=light), tolerance).fingerprint

    assert key(divergence=1.0) != key()
    assert key(ambient=1.0, responsivity=0.1) == key()
    # The least readable power, and with it the light that may be omitted, depends on the electronics.
    assert key(tolerance=1e-6, responsivity=0.1) != key(tolerance=1e-6)
    for name in ("output", "recording", "name"):
        other = dataclasses.replace(sensor, **{name: getattr(Sensor.load("camera_line"), name)})
        assert task_of(other).fingerprint == task_of(sensor).fingerprint


def test_fields_that_are_not_optical_exist() -> None:
    for kind, names in NOT_OPTICAL.items():
        assert names <= {each.name for each in dataclasses.fields(kind)}


def test_every_number_counts() -> None:
    """Long arrays differ in one element; the key distinguishes NumPy and Python numbers, shapes and types."""
    long = np.zeros(100_000)
    changed = long.copy()
    changed[50_000] = 1e-300
    values = [long, changed, long.astype(np.float32), long.reshape(2, -1), (1, 2), ((1, 2),), ("1", 2), (1, 2.0), 1e-9]
    assert len({key_of(each) for each in values}) == len(values)
    assert key_of(long) == key_of(long.copy())
    with pytest.raises(TypeError, match="depends on a function"):
        key_of(test_every_number_counts)


def test_a_worker_with_other_sources_is_refused() -> None:
    with pytest.raises(ValueError, match="other sources of gpuvision"):
        light_cache._compute_on_worker(task_of(Sensor.load("psd_line")), 0, "other")
