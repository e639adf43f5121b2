"""Sensor file of a calibrated sensor: what the scan reads is what was calibrated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.formats.sensor_file import sensor_text
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.sheet_result import SheetFit
from gpuvision.ranging.transport_calibration import TransportFit
from gpuvision.sensor.sensor import Sensor
from laser_sensor import SIZE, LaserSensor, sensor


def geometry_of(truth: LaserSensor) -> SensorGeometry:
    rows = tuple(tuple(row) for row in truth.matrix.tolist())
    sheet = SheetFit(
        origin=truth.origin,
        g_axis=truth.g,
        h_axis=truth.h,
        bend=None,
        names=("offset", "slope_g", "slope_h"),
        noise_covariance=np.diag([4e-10, 1e-8, 1e-6]),
        by_camera=np.zeros((3, 0)),
        sigma_px=0.1,
        view_ratio=1.0,
        bend_test=None,
        residuals=(),
        coordinates=(),
    )
    return SensorGeometry(
        camera=Camera(matrix=rows, distortion=tuple(truth.distortion.tolist())),
        camera_names=(),
        camera_covariance=np.zeros((0, 0)),
        sheet=sheet,
        transport=None,
        step=1e-3,
    )


def test_scan_reads_the_calibrated_sensor(tmp_path: Path) -> None:
    truth = sensor(20.0)
    geometry = geometry_of(truth)
    path = tmp_path / "sensor.toml"
    flat = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 5), np.linspace(-0.02, 0.02, 5)), axis=-1).reshape(-1, 2)
    pixels = truth.project(truth.surface(flat))
    path.write_text(
        sensor_text(geometry, name="test", size=SIZE, along="columns", channel="grey", cell=4e-4, pixels=pixels)
    )
    read = Sensor.load(path)
    assert (read.name, read.frame, read.output.cell) == ("test", SIZE[::-1], 4e-4)
    assert isinstance(read.readout, LineReadout)
    assert isinstance(read.transport, StraightTransport)
    sheet = read.readout.triangulation
    assert sheet is not None
    np.testing.assert_allclose(sheet.to_sensor(flat), pixels[:, ::-1], atol=1e-6)
    assert sheet.covariance is not None
    assert sheet.covariance == geometry.triangulation(SIZE, "columns", pixels).covariance
    # The sheet is known to 20 um and 1 mrad about g: G and H are uncertain by a few um at a few cm.
    sigmas = np.sqrt(np.diagonal(sheet.covariance_at(pixels[:, ::-1]), axis1=-2, axis2=-1))
    assert 1e-6 < sigmas.max() < 200e-6
    axes = np.stack([read.transport.g_axis, read.transport.h_axis, read.transport.direction])
    # The next profile lies towards g x h: with y along it and z along h, x is opposite to g.
    np.testing.assert_allclose(axes, [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], atol=1e-12)
    assert read.transport.step == 1e-3


def test_covariance_of_the_transport(tmp_path: Path) -> None:
    """Per metre of transport, in the scene: y is along the transport, z along the heights."""
    truth = sensor(20.0)
    geometry = geometry_of(truth)
    sheet = geometry.sheet
    axes = np.stack([-sheet.g_axis, sheet.normal, sheet.h_axis])  # x, y and z in the camera's frame
    in_scene = np.diag([4e-12, 1e-12, 9e-12])
    motion = TransportFit(
        step=-1e-3 * sheet.normal,
        normal=sheet.h_axis,
        middle=sheet.origin,
        noise_covariance=axes.T @ in_scene @ axes,
        by_camera=np.zeros((3, 0)),
        residuals=np.zeros((0, 3)),
        rotations=np.zeros((0, 3)),
        view_ratio=1.0,
    )
    path = tmp_path / "sensor.toml"
    pixels = truth.project(truth.surface(0.01 * np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0], [2.0, 1.0]])))
    measured = replace(geometry, transport=motion)
    path.write_text(
        sensor_text(measured, name="", size=SIZE, along="columns", channel="grey", cell=4e-4, pixels=pixels)
    )
    transport = Sensor.load(path).transport
    assert isinstance(transport, StraightTransport)
    np.testing.assert_allclose(transport.covariance, in_scene / 1e-3**2, rtol=1e-9, atol=1e-15)
