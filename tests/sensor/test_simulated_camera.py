"""Simulation of a sensor with a calibrated, tilted camera: its view is OpenCV's, and a scan of it finds the part."""

from __future__ import annotations

import math
import tomllib
from importlib import resources
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh

from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.host import Device
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.schema import Section
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import make_sensor_view
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.workflows.simulating import load_part, prepare_simulation, simulate

MATRIX = ((1600.0, 0.0, 239.5), (0.0, 1600.0, 44.0), (0.0, 0.0, 1.0))
TILT = math.radians(10.0)
COEFFICIENTS = {"k1": -0.3, "k2": 0.4, "p1": 2e-3, "p2": -1e-3, "k3": 0.1, "s1": 1e-3, "tauX": TILT, "tauY": -0.03}
DISTANCE = math.hypot(0.08, 0.15)  # m: the camera looks at the origin of the sheet from 80 mm beside and 150 mm above
H_AXIS = [0.0, -0.08 / DISTANCE, -0.15 / DISTANCE]


def sensor(**sheet: Any) -> Sensor:
    preset = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml")
    table = tomllib.loads(preset.read_text(encoding="utf-8"))
    del table["axes"], table["lens"]
    table["camera"] = {"matrix": [list(row) for row in MATRIX], **COEFFICIENTS}
    table["triangulation"] = {
        "sheet_origin": [0.0, 0.0, DISTANCE],
        "g_axis": [1.0, 0.0, 0.0],
        "h_axis": H_AXIS,
        **sheet,
    }
    return Sensor.from_section(Section(table, "sensor.toml"))


def test_the_view_is_that_of_opencv(rng: np.random.Generator) -> None:
    view = make_sensor_view(sensor())
    np.testing.assert_allclose(view.lens, (0.0, -0.08, 0.15), atol=1e-12)
    scene = rng.uniform((-0.02, -0.003, -0.003), (0.02, 0.003, 0.006), (200, 3))
    # From scene to camera: x is g, the heights are along H_AXIS, and y is against g x h.
    g, h = np.array([1.0, 0.0, 0.0]), np.array(H_AXIS)
    turn = np.stack([g, -np.cross(g, h), h], axis=1)
    in_camera = scene @ turn.T + [0.0, 0.0, DISTANCE]
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
    coefficients = np.array([COEFFICIENTS.get(name, 0.0) for name in names])
    pixels = cv2.projectPoints(in_camera[:, None], np.zeros(3), np.zeros(3), np.array(MATRIX), coefficients)[0][:, 0]
    found = view.project(scene)
    np.testing.assert_allclose(found, pixels[:, ::-1], rtol=0, atol=1e-6)  # (u, v) are (row, column)
    # The rays through the pixels meet the points.
    rays = view.rays(found[:, 0], found[:, 1])
    beside = np.cross(scene - rays[:, :3], rays[:, 3:])
    assert np.abs(beside).max() < 1e-9


def polynomial_view() -> SensorView:
    """Return a view by polynomials with distortion of some percent, about 0.1 m by 0.08 m of the sheet."""
    polynomial = PlanePolynomial(
        p=(-0.05, 8e-5, 2e-6, 3e-10, 5e-9, -1e-10, 2e-13, 4e-13),
        q=(-0.04, -7.5e-5, 1e-6, 4e-9, 2e-10, 3e-10, -3e-13, 2e-13),
        region=((0.0, 1279.0), (0.0, 1023.0)),
    )
    return SensorView(
        triangulation=Triangulation.from_polynomial(polynomial),
        transport=StraightTransport(step=1e-3),
        lens=(0.0, -0.2, 0.3),
        u_edges=np.arange(100.0, 900.0),
        v_edges=np.arange(100.0, 1100.0),
    )


@pytest.mark.parametrize("which", ["camera", "polynomial"])
def test_etendue_is_the_solid_angle_of_a_pixel(which: str, rng: np.random.Generator) -> None:
    """Numerically: the area of the sheet that a pixel sees, over the squared distance, times the aperture."""
    view = make_sensor_view(sensor()) if which == "camera" else polynomial_view()
    u, v = (rng.uniform(edges[0] + 5, edges[-1] - 5, 50) for edges in (view.u_edges, view.v_edges))
    step = 0.05
    point = view.points_in_sheet(u, v)
    along = view.points_in_sheet(u + step, v) - view.points_in_sheet(u - step, v)
    across = view.points_in_sheet(u, v + step) - view.points_in_sheet(u, v - step)
    area = np.cross(along, across) / (2.0 * step) ** 2
    rays = point - np.array(view.lens)
    distance = np.linalg.norm(rays, axis=-1)
    solid = np.abs(np.sum(area * rays, axis=-1)) / distance**3
    expected = 0.25 * math.pi * view.aperture**2 * (rays @ np.array(view.axis)) / distance * solid
    np.testing.assert_allclose(view.etendue(u, v), expected, rtol=1e-6)
    np.testing.assert_allclose(view.project(point), np.stack([u, v], axis=-1), rtol=0, atol=1e-7)


@pytest.mark.slow
def test_a_scan_of_the_simulation_finds_the_part(device: Device, tmp_path: Any) -> None:
    """The readings of the simulated frames, triangulated with the camera, are the surface within the noise."""
    path = tmp_path / "part.stl"
    plate, block = trimesh.creation.box((0.04, 0.02, 0.002)), trimesh.creation.box((0.01, 0.008, 0.004))
    plate.apply_translation((0.0, 0.0, -0.001))
    block.apply_translation((0.004, 0.0, 0.002))
    trimesh.util.concatenate([plate, block]).export(path)
    scene, materials = load_part(path, 1.0, None, 0.5)
    assert isinstance(scene, Scene)
    task = prepare_simulation(scene, materials, sensor(), paths=("direct",), profiles=16)
    done = simulate(task, tmp_path / "out", seed=None, device=device)
    error = done.attribution.error[np.isfinite(done.attribution.error)]
    assert error.size > 2000
    # Without noise: quantisation and the width of the line leave about 1/50 px; a pixel is 0.2 mm of height.
    assert np.median(np.abs(error)) < 5e-6
    noisy = simulate(task, tmp_path / "out", seed=1, device=device)
    ratio = (noisy.attribution.error - done.attribution.error) / noisy.attribution.reading.sigma
    known = ratio[np.isfinite(ratio)]
    assert known.size > 2000
    assert np.mean(np.abs(known) < 3.0) > 0.95
    assert 0.6 < 1.4826 * np.median(np.abs(known)) < 1.4


def test_the_view_of_a_bent_sheet_is_that_of_its_mean_plane(rng: np.random.Generator) -> None:
    flat, bent = (make_sensor_view(each) for each in (sensor(), sensor(bend=[0.1, 0.0, 0.0])))
    assert bent.transport.bend is not None
    scene = rng.uniform((-0.02, -0.003, -0.003), (0.02, 0.003, 0.006), (50, 3))
    np.testing.assert_array_equal(bent.project(scene), flat.project(scene))
