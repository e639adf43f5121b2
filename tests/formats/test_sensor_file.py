"""Sensor file of a calibrated sensor: what the scan reads is what was calibrated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.formats.sensor_file import sensor_text
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.range_image import StraightTransport
from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_calibration import SheetFit
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
        noise_covariance=np.zeros((3, 3)),
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
    path.write_text(sensor_text(geometry, name="test", size=SIZE, along="columns", channel="grey", cell=4e-4))
    read = Sensor.load(path)
    assert (read.name, read.frame, read.output.cell) == ("test", SIZE[::-1], 4e-4)
    assert isinstance(read.readout, LineReadout)
    assert isinstance(read.transport, StraightTransport)
    flat = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 5), np.linspace(-0.02, 0.02, 5)), axis=-1).reshape(-1, 2)
    pixels = truth.project(truth.surface(flat))
    assert read.readout.triangulation is not None
    np.testing.assert_allclose(read.readout.triangulation.to_sensor(flat), pixels[:, ::-1], atol=1e-6)
    axes = np.stack([read.transport.g_axis, read.transport.h_axis, read.transport.direction])
    # The next profile lies towards g x h: with y along it and z along h, x is opposite to g.
    np.testing.assert_allclose(axes, [[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], atol=1e-12)
    assert read.transport.step == 1e-3
