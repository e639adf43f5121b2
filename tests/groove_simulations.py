"""Simulations of a groove on which tests of plans try settings."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import trimesh

from gpuvision.host import Device
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import require_light
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import Reading
from gpuvision.workflows.light_cache import SimulationTask, make_light_paths
from gpuvision.workflows.simulating import prepare_simulation
from gpuvision.workflows.simulation_sample import SampleReader

MM = 1e-3
INDIRECT = ("direct", "diffuse-diffuse")


def sensor_of(name: str = "psd_line", **light: Any) -> Sensor:
    """Return a sensor of the package with a sixth of its samples, and a PSD with half of its bins."""
    sensor = Sensor.load(name)
    readout: Any = sensor.readout
    axes = readout.axes
    wide = dataclasses.replace(
        axes, sample_origin=axes.sample_origin + 2.5 * axes.sample_pitch, sample_pitch=6.0 * axes.sample_pitch
    )
    frame = (16, 2) if name == "psd_line" else (64, 80)
    return dataclasses.replace(
        sensor,
        frame=frame,
        readout=dataclasses.replace(readout, axes=wide),
        light=dataclasses.replace(require_light(sensor), **({"bins": 48} | light)),
    )


def groove() -> Scene:
    """Return a V-groove of 90 degrees, whose walls light each other, cut off where a block ends."""
    outline = np.array([(-24, 0), (-14, 0), (-4, -10), (6, 0), (24, 0)]) * MM
    edge = np.repeat(outline, 2, axis=0)
    corners = np.stack([edge[:, 0], np.tile([-20 * MM, 20 * MM], len(outline)), edge[:, 1]], axis=-1)
    triangles = [each for n in range(0, len(edge) - 2, 2) for each in ((n, n + 2, n + 1), (n + 1, n + 2, n + 3))]
    block = trimesh.creation.box((8 * MM, 10 * MM, 4 * MM))
    block.apply_translation((14 * MM, 0.0, 1.9 * MM))
    joined: Any = trimesh.util.concatenate([trimesh.Trimesh(corners, triangles), block])
    return Scene.of(joined)


def white(albedo: float = 0.7, **more: Any) -> tuple[Material, ...]:
    return (Material(diffuse=Lambert(albedo=albedo), **more),)


def task_of(sensor: Sensor | None = None, **more: Any) -> SimulationTask:
    given: dict[str, Any] = {"paths": INDIRECT, "profiles": 40} | more
    return prepare_simulation(groove(), white(), sensor_of() if sensor is None else sensor, **given)


def heights_of(task: SimulationTask, device: Device, places: Any, **finer: Any) -> Any:
    """Return the heights that a sensor reads at some transports, by one run of all light of a task."""
    light = dataclasses.replace(require_light(task.sensor), **finer)
    paths = make_light_paths(dataclasses.replace(task, sensor=dataclasses.replace(task.sensor, light=light)), device)
    reader = SampleReader.of(task, device)
    return np.array([reader.read(each.exposures).h for each in paths.profiles(places)])


def reading_at(reader: SampleReader, u: Any, strength: Any = 1.0) -> Reading:
    """Return readings at some positions on the sensor, with a signal."""
    nothing = np.full(np.shape(u), np.nan)
    return Reading(u, nothing, nothing, nothing, np.broadcast_to(strength, np.shape(u)), nothing, np.zeros(1, np.uint8))
