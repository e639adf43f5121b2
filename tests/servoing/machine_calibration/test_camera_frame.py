from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision import Lens
from gpuvision.ranging.homography_fit import DegenerateError
from gpuvision.servoing.machine_calibration.camera_frame import CameraFrame, fit_camera_frame

SHAPE = (480, 640)
SIGMA = 0.05
# A camera of 10 um pixels, turned by 5 degrees and tilted by about 1 degree (perspective over the image: 1 %).
PLANTED = np.array([[9.96e-6, -0.87e-6, -2.9e-3], [0.88e-6, 9.97e-6, -2.6e-3], [2e-5, -1e-5, 1.0]])
LENS = Lens(k1=-8e-8, centre=(318.0, 243.0))
POINTS = np.stack(np.meshgrid(np.linspace(40, 600, 5), np.linspace(30, 450, 4)), axis=-1).reshape(-1, 2)


def _to_plane(pixels: np.ndarray) -> np.ndarray:
    lifted = np.column_stack([pixels, np.ones(len(pixels))]) @ PLANTED.T
    return lifted[:, :2] / lifted[:, 2:]


def _fit(pixels: np.ndarray, plane: np.ndarray, lens: Lens | None = None) -> CameraFrame:
    return fit_camera_frame(pixels, plane, SIGMA, SHAPE, distortion=lens)


@pytest.mark.parametrize("lens", [None, LENS])
def test_exact_points_give_back_the_planted_frame(lens: Lens | None) -> None:
    measured = POINTS if lens is None else lens.distort(POINTS)
    frame = _fit(measured, _to_plane(POINTS), lens)
    np.testing.assert_allclose(frame.to_plane(measured).points, _to_plane(POINTS), atol=1e-12)
    centre = np.array([[319.5, 239.5]])
    np.testing.assert_allclose(frame.transform.apply(centre), _to_plane(centre), atol=1e-12)
    step = _to_plane(np.array([[319.51, 239.5], [319.5, 239.51]])) - _to_plane(centre)
    np.testing.assert_allclose(frame.transform.linear, step.T / 0.01, rtol=1e-4)
    assert (frame.transform.source, frame.transform.target) == ("image", "camera")
    assert frame.pixel_size == pytest.approx(1e-5, rel=0.01)


def test_covariance_is_the_derivative_of_the_map_by_each_measured_value() -> None:
    measured, plane = LENS.distort(POINTS), _to_plane(POINTS)
    frame, probe, step = _fit(measured, plane, LENS), np.array([610.0, 30.0]), 1e-3
    spread = np.zeros((2, 2))
    for moved in np.eye(measured.size).reshape(-1, *measured.shape) * step:
        ends = [_fit(measured + sign * moved, plane, LENS).to_plane(probe).points for sign in (1, -1)]
        column = (ends[0] - ends[1]) / (2 * step)
        spread += SIGMA**2 * np.outer(column, column)
    calibration = frame.to_plane(probe).covariance
    np.testing.assert_allclose(calibration, spread, atol=1e-4 * np.trace(spread))
    ends = [[frame.to_plane(probe + sign * each).points for sign in (1, -1)] for each in np.eye(2) * step]
    by_pixel = np.array([(more - less) / (2 * step) for more, less in ends]).T
    noise = np.array([[0.04, 0.01], [0.01, 0.09]])
    added = frame.to_plane(probe, noise).covariance - calibration
    np.testing.assert_allclose(added, by_pixel @ noise @ by_pixel.T, atol=1e-6 * np.trace(added))


def _check_coverage(count: int) -> None:
    random = np.random.default_rng(2)
    probes = np.array([[319.5, 239.5], [20.0, 20.0], [620.0, 450.0]])
    exact, plane = _to_plane(probes), _to_plane(POINTS)
    inside, errors, corners = [], [], []
    for _ in range(count):
        frame = _fit(POINTS + random.normal(size=POINTS.shape) * SIGMA, plane)
        mapped = frame.to_plane(probes)
        sigma = np.sqrt(np.diagonal(mapped.covariance, axis1=1, axis2=2))
        inside.append(np.abs(mapped.points - exact) <= 3 * sigma)
        errors.append((mapped.points - exact) / sigma)
        corners.append(frame.transform.matrix.ravel())
    assert np.mean(np.all(inside, axis=(1, 2))) >= 0.95
    np.testing.assert_allclose(np.std(errors, axis=0), 1.0, atol=4 / math.sqrt(2 * count))
    predicted = frame.transform.covariance
    assert predicted is not None
    np.testing.assert_allclose(np.std(corners, axis=0) / np.sqrt(np.diag(predicted)), 1, atol=4 / math.sqrt(2 * count))


def test_planted_frame_is_within_three_sigma() -> None:
    _check_coverage(60)


@pytest.mark.slow
def test_planted_frame_is_within_three_sigma_in_95_percent_of_1000_draws() -> None:
    _check_coverage(1000)


def test_proposed_point_beats_a_random_one_by_the_predicted_factor() -> None:
    start = np.array([[300, 220], [340, 220], [340, 260], [300, 260], [320, 240]], np.float64)
    candidates = np.stack(np.meshgrid(np.linspace(20, 620, 7), np.linspace(20, 460, 5)), axis=-1).reshape(-1, 2)
    frame = _fit(start, _to_plane(start))
    best = frame.next_point(candidates)
    other = int(np.random.default_rng(4).integers(len(candidates)))

    def volume(index: int) -> float:
        points = np.vstack([start, candidates[index]])
        return math.sqrt(np.linalg.det(_fit(points, _to_plane(points)).covariance / np.outer(UNIT, UNIT)))

    predicted = best.volume_factor[best.chosen] / best.volume_factor[other]
    assert predicted > 2
    assert volume(other) / volume(best.chosen) == pytest.approx(predicted, rel=0.02)
    assert best.chosen in (0, 6, 28, 34)  # a corner of the image


UNIT = np.array([1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-6, 1e-3, 1e-3])


def test_points_that_do_not_determine_the_frame_are_refused() -> None:
    line = np.stack([np.linspace(0, 600, 6), np.linspace(0, 300, 6)], axis=1)
    with pytest.raises(DegenerateError, match="do not fix the model"):
        _fit(line, _to_plane(line))
    with pytest.raises(DegenerateError, match="too few"):
        _fit(POINTS[:3], _to_plane(POINTS[:3]))
