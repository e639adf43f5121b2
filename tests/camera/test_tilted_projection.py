"""Projection through a tilted camera and its derivatives, against OpenCV and complex steps."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gpuvision.camera.tilted_projection import COLUMNS, INTERNAL, project, rotation_matrix, tilt_matrix
from gpuvision.camera.views.parameters import (
    FIT_PARAMETERS,
    OPENCV,
    FreeParameters,
    internal_parameters,
    opencv_parameters,
)
from tilted_camera import project_virtual, tilt

VIEWS, POINTS = 3, 7
CAMERAS = {
    "plain": [1500.0, 1.0, 630.0, 500.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "lens": [1500.0, 1.0, 630.0, 500.0, 0.0, 0.0, -0.2, 0.1, 0.01, -0.02, 0.05, 0.0, 0.0, 0.0],
    "tilt": [1500.0, 1.1, 630.0, 700.0, 0.3, -0.5, -0.12, 0.08, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0],
    "all": [800.0, 0.9, 100.0, 1700.0, -0.7, 0.4, -0.12, 0.08, 0.01, -0.02, 0.03, 0.2, -0.1, 0.05],
    "rational": [1500.0, 1.0, 630.0, 500.0, 0.0, 0.0, 0.3, 0.2, 0.01, -0.02, 0.05, 0.4, 0.1, -0.2],
}


@pytest.fixture
def scene(rng):
    target = np.zeros((VIEWS, 3, POINTS))
    target[:, :2] = rng.uniform(-0.2, 0.2, (VIEWS, 2, POINTS))
    return rotation_matrix(rng.normal(0.0, 0.3, (VIEWS, 3))), rng.normal((0.0, 0.0, 1.0), 0.05, (VIEWS, 3)), target


@pytest.mark.parametrize("name", CAMERAS)
def test_it_is_opencvs_camera(name, scene):
    """In the lens' frame: poses rotated by the tilt, f' = f / cos(alpha), centre where the axis meets the sensor."""
    internal = np.array(CAMERAS[name])
    rotations, translations, target = scene
    projected = project(internal, rotations, translations, target)
    m = tilt_matrix(*internal[4:6])
    np.testing.assert_allclose(m, tilt(*internal[4:6]), atol=1e-15)
    fx = internal[0] / m[2, 2]
    centre = internal[2:4] + fx * m[:2, 2] * [1.0, internal[1]]
    matrix = np.array([[fx, 0.0, centre[0]], [0.0, internal[1] * fx, centre[1]], [0.0, 0.0, 1.0]])
    distortion = np.array([*internal[6:], *np.zeros(4), *internal[4:6]])
    for view in range(VIEWS):
        vector = cv2.Rodrigues(m.T @ rotations[view])[0]
        seen = cv2.projectPoints(target[view].T, vector, m.T @ translations[view], matrix, distortion)[0]
        np.testing.assert_allclose(projected.points[view].T, seen.reshape(-1, 2), atol=1e-9)


@pytest.mark.parametrize("name", CAMERAS)
def test_every_derivative_is_that_of_a_complex_step(name, scene):
    internal = np.array(CAMERAS[name])
    rotations, translations, target = scene
    jacobian = project(internal, rotations, translations, target, derivatives=True).jacobian
    step = 1e-30
    for view in range(VIEWS):
        for column in range(COLUMNS):
            numbers = np.array([*internal, *np.zeros(6)], dtype=complex)
            numbers[column] += 1j * step
            moved, turn, shift = np.split(numbers, [len(INTERNAL), len(INTERNAL) + 3])
            small = np.array([[1, -turn[2], turn[1]], [turn[2], 1, -turn[0]], [-turn[1], turn[0], 1]])
            seen = project_virtual(moved, small @ rotations[view], translations[view] + shift, target[view].T)
            expected = seen.imag.T / step
            # Without distortion the two effects of a tilt cancel, each some thousand pixels.
            np.testing.assert_allclose(
                jacobian[view, column], expected, rtol=1e-11, atol=1e-11 * max(np.abs(expected).max(), 1.0)
            )


def test_points_behind_lens_or_sensor_are_said_to_be(scene):
    rotations, translations, target = scene
    internal = np.array(CAMERAS["tilt"])
    assert project(internal, rotations, translations, target).in_front
    mirrored = project(internal, rotations, -translations, target, derivatives=True)
    assert not mirrored.in_front
    assert mirrored.jacobian is None


def _numbers(rng):
    return np.array([1500.0, 1.1, 700.0, -300.0, 650.0, 480.0, *rng.normal(0.0, 0.1, 8)])


@pytest.mark.parametrize(("function", "names"), [(internal_parameters, INTERNAL), (opencv_parameters, OPENCV)])
def test_derivatives_of_the_coordinates(function, names, rng):
    numbers = _numbers(rng)
    values, derivative = function(numbers)
    assert derivative.shape == (len(names), len(FIT_PARAMETERS))
    for column in range(len(FIT_PARAMETERS)):
        step = 1e-6 * max(abs(numbers[column]), 1.0)
        ends = [function(numbers + sign * step * np.eye(len(FIT_PARAMETERS))[column])[0] for sign in (1.0, -1.0)]
        # Central differences: step^2, and rounding of 1e3 pixels over the step.
        np.testing.assert_allclose(derivative[:, column], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-6, atol=1e-6)
    np.testing.assert_array_equal(values, function(numbers)[0])


@pytest.mark.parametrize(
    "free_parameters",
    [
        FreeParameters(coefficients=("k1", "k2"), tilt=True),
        FreeParameters(coefficients=("k1", "p1", "p2", "k3"), tilt=False, aspect=True),
        FreeParameters(coefficients=("k1",), tilt=True, focal_length=1800.0),
        FreeParameters(coefficients=(), tilt=True, centre=False, direction=0.7),
        FreeParameters(coefficients=(), tilt=True, aspect=True, focal_length=1800.0, direction=0.7),
    ],
    ids=["tilt", "brown", "f known", "along", "along, f known"],
)
def test_spread_is_what_a_step_does(free_parameters, rng):
    numbers = free_parameters.with_dependent(_numbers(rng))
    if free_parameters.focal_length is not None:
        assert opencv_parameters(numbers)[0][0] == pytest.approx(free_parameters.focal_length, rel=1e-14)
    spread = free_parameters.derivative(numbers)
    for column in range(free_parameters.count):
        step = 1e-5
        ends = [
            free_parameters.with_dependent(numbers + sign * step * free_parameters.basis[:, column])
            for sign in (1.0, -1.0)
        ]
        np.testing.assert_allclose(spread[:, column], (ends[0] - ends[1]) / (2.0 * step), rtol=1e-6, atol=1e-6)


def test_a_known_focal_length_is_the_longest_way_from_centre_to_v(rng):
    free_parameters = FreeParameters(coefficients=(), tilt=True, focal_length=500.0)
    assert np.isnan(free_parameters.with_dependent(_numbers(rng))[0])
