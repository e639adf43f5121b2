"""Starting polynomials of the kernels' lens inversion, and its Newton steps: each step's error against exact points."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.host import Device
from gpuvision.host.program import options
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import camera as reference

MATRIX = ((1700.0, 0.0, 640.0), (0.0, 1700.0, 512.0), (0.0, 0.0, 1.0))
IDEAL = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
REGION = ((0.0, 1280.0), (0.0, 1024.0))
RADIAL = (-0.28, 0.11, 0.0, 0.0, -0.02)
# Decentring and prism terms of 5 times a good lens: each of their polynomials moves points by more than the errors.
DECENTRED = (-0.12, 0.08, 5e-3, -8e-3, 0.01, 0.02, 0.03, 0.001, 5e-3, 1e-2, -5e-3, 1.5e-2)

# The number of steps is an entry behind the camera's table.
APPROACH = """
#include "common/camera.h"
kernel void approach(global const double *m, global double *back, constant double *camera) {
    const size_t i = get_global_id(0);
    double x, y;
    camera_approach(m[2 * i], m[2 * i + 1], camera, &x, &y);
    back[2 * i] = x;
    back[2 * i + 1] = y;
}
"""


def _camera(coefficients: tuple[float, ...], matrix: object = MATRIX) -> Camera:
    return Camera(matrix=matrix, distortion=(*coefficients, *(0.0,) * (14 - len(coefficients))))


def _points(rng: np.random.Generator, camera: Camera, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Return distorted points within a radius, and their displacement back to the ideal points, both normalised."""
    ideal = rng.uniform(-1.0, 1.0, (40_000, 2)) * math.sqrt(2.0 * reach)
    distorted = np.asarray(reference.distort_pixels(ideal, IDEAL, camera.distortion), np.float64)
    within = np.sum(distorted**2, axis=-1) < reach
    return distorted[within], (ideal - distorted)[within]


def _largest_errors(
    device: Device,
    camera: Camera,
    points: np.ndarray,
    back: np.ndarray,
    steps: int,
    *,
    unit: object = 1.0,
) -> list[float]:
    """Return the largest error of the kernel after 0, 1, ... steps, in a unit, which may differ between the points."""
    table = camera.packed(np.float64, "undistort")
    defines = {**camera.defines(), "CAMERA_SURE": None, "REAL_IS_DOUBLE": None}
    defines["CAMERA_STEPS"] = f"(int)camera[{len(table)}]"
    program = cl.Program(device.context, APPROACH).build([*options(defines), "-I", str(KERNEL_FOLDER)])
    approach, queue, found = program.approach, device.queue, []
    m, moved = cl.array.to_device(queue, points), cl.array.zeros(device.queue, points.shape, np.float64)
    for count in range(steps):
        entries = cl.array.to_device(queue, np.append(table, float(count)))
        approach(queue, (len(points),), None, m.data, moved.data, entries.data)
        found.append(float(np.max(np.abs(moved.get() - back) / unit)))
    return found


@pytest.mark.double
@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")
@pytest.mark.parametrize(("coefficients", "first"), [(RADIAL, 1e-10), (DECENTRED, 1e-3)], ids=["radial", "decentred"])
def test_each_step_is_as_exact_as_the_host_says(
    device: Device, coefficients: tuple[float, ...], first: float, rng: np.random.Generator
) -> None:
    """`sure_steps` returns a number of steps for tolerances from the largest error after these steps on."""
    camera = _camera(coefficients)
    start = camera.inverse_start(REGION)
    reach = 1.0 / camera.packed(np.float64, "undistort")[31]
    # Undistorted corners of the region, 1.1 times as far.
    far = np.hypot(640.0, 512.0) / 1700.0
    assert reach == pytest.approx((1.1 * far) ** 2, rel=1e-6)
    errors = _largest_errors(device, camera, *_points(rng, camera, reach), steps=4)
    assert errors[0] < first
    for before, after in itertools.pairwise(errors):
        assert after < max(1e-2 * before, 1e-15)
    for count, error in enumerate(errors):
        if error > 1e-14:
            assert start.sure_steps(1.1 * error) <= count
            assert start.sure_steps(0.9 * error) == count + 1
    assert start.sure_steps(1e-18) is None


@pytest.mark.double
@pytest.mark.filterwarnings("ignore::pyopencl.CompilerWarning")
@pytest.mark.parametrize("coefficients", [RADIAL, DECENTRED], ids=["radial", "decentred"])
def test_steps_without_a_test_leave_errors_that_the_test_accepts(
    device: Device, coefficients: tuple[float, ...], rng: np.random.Generator
) -> None:
    """The test in single precision accepts squared errors of CAMERA_LEFT, 1e-15 of the squared radius."""
    camera = _camera(coefficients)
    steps = camera.inverse_start(REGION).settled_steps(np.float32)
    reach = 1.0 / camera.packed(np.float64, "undistort")[31]
    points, back = _points(rng, camera, reach)
    radius = np.hypot(*points.T)[:, None]
    errors = _largest_errors(device, camera, points, back, steps + 1, unit=radius)
    assert errors[steps] < math.sqrt(1e-15)
    fewer = errors[steps - 1] if steps else math.inf
    assert fewer > 0.5 * math.sqrt(1e-15)


@pytest.mark.parametrize(
    ("coefficients", "errors"),
    [(RADIAL, (1e-11, 1e-15)), (DECENTRED, (1.5e-4, 1.3e-7, 9e-11, 6e-14))],
    ids=["radial", "decentred"],
)
def test_accuracy_of_the_start_and_of_its_steps(coefficients: tuple[float, ...], errors: tuple[float, ...]) -> None:
    """Largest errors of displacements, normalised, within 1.3 of those measured: a worse fit has larger ones."""
    start = _camera(coefficients).inverse_start(REGION)
    for count, error in enumerate(errors):
        assert start.sure_steps(error) == count


def test_reach_ends_before_the_fold() -> None:
    """r (1 - 0.4 r^2) folds at 1 / sqrt(1.2), where it is 2/3 of it; without a region the reach is 1."""
    for region, reach in (
        (((-2.0, 2.0), (-2.0, 2.0)), 0.95**2 * (2.0 / 3.0) ** 2 / 1.2),
        (((-0.2, 0.3), (-0.1, 0.2)), 1.1**2 * (0.3**2 + 0.2**2)),
        (((0.0, 0.0), (0.0, 0.0)), 0.95**2 * (2.0 / 3.0) ** 2 / 1.2),
    ):
        start = _camera((-0.4,), IDEAL).inverse_start(region)
        assert 1.0 / start.packed(np.float64)[0] == pytest.approx(reach, rel=1e-12)
    free = _camera((0.1,), IDEAL).inverse_start(((0.0, 0.0), (0.0, 0.0)))
    assert 1.0 / free.packed(np.float64)[0] == pytest.approx(1.0, rel=1e-12)


def test_a_lens_without_distortion_needs_no_step() -> None:
    assert _camera((1e-12,)).inverse_start(REGION).settled_steps(np.float32) == 0


@pytest.mark.parametrize("coefficients", [RADIAL, DECENTRED], ids=["radial", "decentred"])
def test_a_usual_lens_is_not_tested(coefficients: tuple[float, ...]) -> None:
    assert "CAMERA_SURE" in _camera(coefficients).undistort_defines(np.float32)


def test_a_strong_lens_is_tested() -> None:
    """Near the fold, the steps after which most points have converged are not enough for all."""
    camera = _camera((-0.9, 0.0, 0.02, -0.03))
    assert "CAMERA_SURE" not in camera.undistort_defines(np.float32)
    assert camera.undistort_defines(np.float32)["CAMERA_STEPS"] > 1
