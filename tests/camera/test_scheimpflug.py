"""Geometry of a tilted sensor: eq. 3.1, fig. 3.3, the Scheimpflug condition."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.camera import Camera
from gpuvision.camera.scheimpflug import TiltedSensor, plane_of_focus, tilt_for_plane

ANGLES = {"alpha": st.floats(0.0, 1.3), "direction": st.floats(-math.pi, math.pi)}


@pytest.mark.parametrize(("degrees", "f", "row"), [(10.0, 1674.17, 216.80), (20.0, 1597.48, -69.43)])
def test_the_virtual_camera_of_two_known_tilts(degrees, f, row):
    """f' = 1700 px, centre in row 512: an untilted fit finds f' cos(alpha), and the centre shifted by f' sin(alpha)."""
    sensor = TiltedSensor(
        focal_length=1700.0, centre=(640.0, 512.0), alpha=math.radians(degrees), direction=0.5 * math.pi
    )
    assert sensor.virtual_focal_length == pytest.approx(f, abs=0.01)
    assert sensor.virtual_centre == pytest.approx((640.0, row), abs=0.01)


@given(**ANGLES)
def test_angles_round_trip(alpha, direction):
    sensor = TiltedSensor(focal_length=1700.0, centre=(640.0, 512.0), alpha=alpha, direction=direction)
    back = TiltedSensor.from_tau(1700.0, (640.0, 512.0), *sensor.tau)
    np.testing.assert_allclose(back.axis, sensor.axis, atol=1e-15)
    assert math.cos(back.alpha) == pytest.approx(math.cos(sensor.tau[0]) * math.cos(sensor.tau[1]), abs=1e-15)
    again = TiltedSensor.from_virtual(sensor.virtual_focal_length, sensor.virtual_centre, sensor.centre)
    assert again.focal_length == pytest.approx(1700.0, rel=1e-12)
    np.testing.assert_allclose(again.axis, sensor.axis, atol=1e-12)


@given(**ANGLES)
def test_without_distortion_the_virtual_camera_sees_the_same(alpha, direction):
    """Fig. 3.3: S' is S rotated by alpha about the pinhole."""
    sensor = TiltedSensor(focal_length=1700.0, centre=(640.0, 512.0), alpha=alpha, direction=direction)
    matrix = ((1700.0, 0.0, 640.0), (0.0, 1700.0, 512.0), (0.0, 0.0, 1.0))
    camera = Camera(matrix=matrix, distortion=(*(0.0,) * 12, *sensor.tau))
    assert TiltedSensor.from_camera(camera).alpha == pytest.approx(alpha, abs=1e-7)
    points = np.random.default_rng(1).uniform((-0.1, -0.1, 0.9), (0.1, 0.1, 1.1), (20, 3))
    seen, turned = camera.project(points), sensor.virtual_camera.project(points, sensor.rotation)
    is_visible = np.isfinite(seen[:, 0])
    np.testing.assert_allclose(seen[is_visible], turned[is_visible], rtol=1e-9, atol=1e-7)
    assert is_visible.any()
    # The rotation moves the optical axis by alpha from the normal.
    assert sensor.rotation[2, 2] == pytest.approx(math.cos(alpha), abs=1e-15)


@given(**ANGLES, pitch=st.floats(1e-6, 2e-5))
def test_object_lens_and_sensor_planes_meet_in_one_line(alpha, direction, pitch):
    """Fig. 3.1, and every point of the plane of focus obeys the thin-lens equation."""
    sensor = TiltedSensor(focal_length=5000.0, centre=(640.0, 512.0), alpha=alpha, direction=direction)
    image = 5000.0 * pitch
    lens = 0.8 * image
    normal, distance = plane_of_focus(sensor, lens, pitch)
    # The sensor behind the pinhole: its plane is m . q = -f.
    sensor_plane = np.array([*sensor.rotation[2], sensor.virtual_focal_length * pitch]) / image
    planes = np.array([[*normal, -distance], [0.0, 0.0, 1.0, 0.0], sensor_plane])
    planes[:, 3] /= image
    sizes = np.linalg.svd(planes, compute_uv=False)
    assert sizes[2] <= 1e-12 * sizes[0]
    checked = 0
    for place in ((0.0, 0.0), (1000.0, -400.0), (-500.0, 900.0)):
        # A sensor point, mirrored through the pinhole, in the lens' frame; the object point on its ray.
        on_sensor = np.array([*place, 0.0]) * pitch + sensor.focal_length * pitch * sensor.axis
        q = sensor.rotation.T @ on_sensor
        if q[2] <= lens:
            continue
        sharp = q * (distance / (normal @ q))
        assert 1.0 / sharp[2] + 1.0 / q[2] == pytest.approx(1.0 / lens, rel=1e-9)
        checked += 1
    assert checked


@given(**ANGLES)
def test_the_condition_solved_for_the_sensor(alpha, direction):
    sensor = TiltedSensor(focal_length=5000.0, centre=(0.0, 0.0), alpha=alpha, direction=direction)
    normal, distance = plane_of_focus(sensor, 0.02, 5e-6)
    image, tau_x, tau_y = tilt_for_plane(normal, distance, 0.02)
    assert image == pytest.approx(0.025, rel=1e-9)
    np.testing.assert_allclose(TiltedSensor.from_tau(5000.0, (0.0, 0.0), tau_x, tau_y).axis, sensor.axis, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_length": 0.0}, "above 0"),
        ({"alpha": -0.1}, "right angle"),
        ({"alpha": 1.6}, "right angle"),
        ({"alpha": math.nan}, "finite"),
        ({"centre": (1.0,)}, "shape"),
    ],
)
def test_numbers_out_of_bounds(change, message):
    with pytest.raises(ValueError, match=message):
        TiltedSensor(**({"focal_length": 1700.0, "centre": (640.0, 512.0), "alpha": 0.1} | change))


def test_pixels_that_are_not_square_are_refused():
    camera = Camera(matrix=((900.0, 0.0, 640.0), (0.0, 950.0, 480.0), (0.0, 0.0, 1.0)))
    with pytest.raises(ValueError, match=r"^the camera has fx = 900, fy = 950, expected square pixels$"):
        TiltedSensor.from_camera(camera)


def test_what_cannot_be_sharp_and_what_is_not_square():
    sensor = TiltedSensor(focal_length=5000.0, centre=(0.0, 0.0), alpha=0.1)
    with pytest.raises(ValueError, match="below f'"):
        plane_of_focus(sensor, 0.03, 5e-6)
    with pytest.raises(ValueError, match="nearer than the focal length"):
        tilt_for_plane((0.0, 0.0, 1.0), 0.01, 0.02)
    with pytest.raises(ValueError, match="nearer than the focal length"):
        tilt_for_plane((0.0, 1.0, 0.0), 0.01, 0.02)
    with pytest.raises(ValueError, match="normal"):
        tilt_for_plane((0.0, 0.0, 0.0), 0.1, 0.02)
    with pytest.raises(ValueError, match="above 0"):
        tilt_for_plane((0.0, 0.0, 1.0), 0.1, -0.02)
    with pytest.raises(ValueError, match="square"):
        TiltedSensor.from_camera(Camera(matrix=((1700.0, 0.0, 0.0), (0.0, 1600.0, 0.0), (0.0, 0.0, 1.0))))
