"""Calibrated laser sensors against known geometry: heights, distances, step, and their predicted uncertainty."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from gpuvision.ranging.sensor_geometry import SensorGeometry
from laser_sensor import PROFILES_BETWEEN, SIZE, STEP, LaserSensor, calibrated, sensor

Float64 = npt.NDArray[np.float64]
BENT = (0.06, -0.02, 0.03)
LINE_SIGMA = 0.1
# Points of the measuring range, (G, H) in the frame of the true sheet [m].
FLAT = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 7), np.linspace(-0.03, 0.03, 5)), axis=-1).reshape(-1, 2)


@pytest.fixture(scope="module")
def truth() -> LaserSensor:
    return sensor(25.0, BENT)


@pytest.fixture(scope="module")
def found(truth: LaserSensor) -> SensorGeometry:
    return calibrated(truth, np.random.default_rng(5))


def height_errors(truth: LaserSensor, found: SensorGeometry, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return errors and predicted sigmas: heights of points, then distances of points from the middle one [m]."""
    exact = truth.surface(FLAT)
    pixels = truth.project(exact)
    pixels[:, 1] += rng.normal(0.0, LINE_SIGMA, len(pixels))
    points, slopes = found.points(pixels), found.derivatives(pixels)
    half = np.array([0.0, 0.5])
    by_row = found.points(pixels + half) - found.points(pixels - half)
    covariance = found.covariance[: slopes.shape[2], : slopes.shape[2]]
    middle = len(FLAT) // 2
    others = np.arange(len(FLAT)) != middle
    apart, between = exact[others] - exact[middle], points[others] - points[middle]
    way = apart / np.linalg.norm(apart, axis=1)[:, None]
    errors, sigmas = [(points - exact) @ truth.h, np.linalg.norm(between, axis=1) - np.linalg.norm(apart, axis=1)], []
    for noise, slope in (
        ((by_row @ truth.h) ** 2, np.einsum("i,nip->np", truth.h, slopes)),
        (
            np.sum(by_row[others] * way, axis=1) ** 2 + (way @ by_row[middle]) ** 2,
            np.einsum("ni,nip->np", way, slopes[others] - slopes[middle]),
        ),
    ):
        sigmas.append(np.sqrt(LINE_SIGMA**2 * noise + np.einsum("np,pq,nq->n", slope, covariance, slope)))
    return np.concatenate(errors), np.concatenate(sigmas)


def check_statistics(runs: list[tuple[Float64, Float64]]) -> None:
    ratio = np.concatenate([errors / sigmas for errors, sigmas in runs])
    assert np.mean(np.abs(ratio) < 3.0) >= 0.95
    # The prediction is no upper bound: it has the size of the errors.
    assert 0.6 < np.sqrt(np.mean(ratio**2)) < 1.4


def test_points_and_distances_are_within_their_sigma(truth: LaserSensor, found: SensorGeometry) -> None:
    errors, sigmas = height_errors(truth, found, np.random.default_rng(7))
    # The errors of one calibration are one draw, common to all points; the full tier counts over seeds.
    assert np.abs(errors / sigmas).max() < 4.0
    # Reading noise of 0.1 px is 60 to 70 um of height; the calibration adds less to distances.
    distances = sigmas[len(FLAT) :]
    assert np.median(distances) < 120e-6


@pytest.mark.nightly
@pytest.mark.parametrize(("tilt_degrees", "bend"), [(10.0, (0.0, 0.0, 0.0)), (25.0, BENT), (40.0, BENT)])
def test_predicted_sigmas_hold_over_seeds(tilt_degrees: float, bend: tuple[float, float, float]) -> None:
    truth = sensor(tilt_degrees, bend)
    rngs = [np.random.default_rng((20, seed)) for seed in range(20)]
    check_statistics([height_errors(truth, calibrated(truth, rng), rng) for rng in rngs])


def scale_errors(truth: LaserSensor, found: SensorGeometry) -> Float64:
    """Return the errors of the scales of heights and of x and y, over their predicted sigmas."""
    exact = truth.surface(FLAT)
    pixels = truth.project(exact)
    # Along the true axes: those of the calibrated sheet are turned in the sheet.
    errors = (found.points(pixels) - exact) @ np.stack([truth.g, truth.h], axis=1)
    slopes = np.linalg.lstsq(np.column_stack([np.ones(len(FLAT)), FLAT]), errors, rcond=None)[0]
    assert found.transport is not None
    step = found.transport.step @ truth.step / STEP**2 - 1.0
    return np.asarray([slopes[2, 1], 0.5 * (slopes[1, 0] + step)]) / found.scale_sigma(pixels)


@pytest.mark.nightly
def test_scales_are_within_their_sigma_over_seeds(truth: LaserSensor) -> None:
    ratio = np.array([scale_errors(truth, calibrated(truth, np.random.default_rng((21, seed)))) for seed in range(30)])
    assert np.mean(np.abs(ratio) < 3.0) >= 0.95
    rms = np.sqrt(np.mean(ratio**2, axis=0))
    assert np.all((rms > 0.7) & (rms < 1.3))  # 30 draws: 13 %


def test_scales_are_within_their_sigma(truth: LaserSensor, found: SensorGeometry) -> None:
    assert np.abs(scale_errors(truth, found)).max() < 4.0
    height, lateral = found.scale_sigma(truth.project(truth.surface(FLAT)))
    # The longer the region, the better its scale; 0.1 px of 100 readings would give about 1e-4.
    assert 1e-5 < lateral < height < 5e-3


def test_exact_readings_give_the_exact_sensor(truth: LaserSensor) -> None:
    found = calibrated(truth, np.random.default_rng(2), sigma=1e-6, line_sigma=1e-6)
    points = found.points(truth.project(truth.surface(FLAT)))
    np.testing.assert_allclose(points, truth.surface(FLAT), rtol=0.0, atol=2e-8)
    np.testing.assert_allclose(found.direction * found.step, -truth.step, rtol=0.0, atol=1e-9)


def test_derivatives_are_those_of_the_points(truth: LaserSensor, found: SensorGeometry) -> None:
    """The derivative by the camera moves rays; the derivative by the sheet moves the surface along its normal."""
    pixels = truth.project(truth.surface(FLAT))
    slopes = found.derivatives(pixels)
    place = found.names.index("gh")
    gg, gh, hh = found.sheet.bend or (0.0, 0.0, 0.0)
    step = 1e-4
    ends = []
    for sign in (1.0, -1.0):
        changed = dict(vars(found.sheet), bend=(gg, gh + sign * step, hh))
        ends.append(SensorGeometry(**dict(_fields(found), sheet=type(found.sheet)(**changed))).points(pixels))
    np.testing.assert_allclose((ends[0] - ends[1]) / (2.0 * step), slopes[:, :, place], rtol=1e-4, atol=1e-9)


def test_pixels_without_a_ray_do_not_enter_the_covariance(truth: LaserSensor, found: SensorGeometry) -> None:
    """NaN stands for a pixel past the fold of the lens."""
    pixels = truth.project(truth.surface(FLAT))
    known = found.triangulation(SIZE, "columns", pixels)
    other = found.triangulation(SIZE, "columns", np.concatenate([pixels, [[np.nan, np.nan]]]))
    assert known.covariance is not None
    assert other.covariance == known.covariance


def _fields(found: SensorGeometry) -> dict[str, object]:
    return {name: getattr(found, name) for name in SensorGeometry.__dataclass_fields__}


def test_scene_has_y_along_the_transport_and_z_up(found: SensorGeometry) -> None:
    x, y, z = found.scene_axes
    np.testing.assert_allclose(found.scene_axes @ found.scene_axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.cross(x, y), z, atol=1e-12)
    np.testing.assert_allclose(y, found.direction, atol=1e-12)
    assert found.transport is not None
    assert y @ found.transport.step < 0.0  # the part moves against y
    assert z @ found.sheet.origin < 0.0  # towards the camera
    assert found.covariance.shape == (len(found.names),) * 2
    assert np.linalg.eigvalsh(found.covariance / np.sqrt(np.outer(*[np.diag(found.covariance)] * 2)))[0] > -1e-9


def test_step_is_within_its_sigma(truth: LaserSensor, found: SensorGeometry) -> None:
    assert found.transport is not None
    first = len(found.names) - 3
    axes = np.stack([found.sheet.g_axis, found.sheet.h_axis, found.sheet.normal])
    error = axes @ (found.transport.step - truth.step)
    chi_square = error @ np.linalg.solve(found.covariance[first:, first:], error)
    assert chi_square < 16.3  # 0.1 % of three normal numbers
    sigma = np.sqrt(found.direction @ found.transport.covariance(found.camera_covariance) @ found.direction)
    assert sigma * PROFILES_BETWEEN * 4 < 20e-6
    assert abs(found.step - STEP) < 4.0 * sigma


def aligned(found: Float64, exact: Float64) -> Float64:
    """Return the errors (n, 2) of points (G, H) after the best rotation and shift."""
    middle, centre = found.mean(axis=0), exact.mean(axis=0)
    u, _, vt = np.linalg.svd((found - middle).T @ (exact - centre))
    return (found - middle) @ (u @ vt) - (exact - centre)


def errors_in_sheet(truth: LaserSensor, found: SensorGeometry) -> tuple[Float64, Float64]:
    """Return errors (n, 2) of (G, H) for exact readings up to a rigid motion, and the predicted sigmas (n, 2)."""
    pixels = truth.project(truth.surface(FLAT))
    sheet = found.triangulation(SIZE, "columns", pixels)
    sigmas = np.sqrt(np.diagonal(sheet.covariance_at(pixels[:, ::-1]), axis1=-2, axis2=-1))
    return aligned(found.in_sheet(found.points(pixels)), FLAT), sigmas


def test_triangulation_predicts_errors_up_to_a_rigid_motion(truth: LaserSensor, found: SensorGeometry) -> None:
    """The covariance leaves out where the camera's frame lies, and no error that changes the shape of a part."""
    errors, sigmas = errors_in_sheet(truth, found)
    assert 0.1 < np.sqrt(np.mean((errors / sigmas) ** 2)) < 3.0
    # In the frame of the camera the points are several times as uncertain.
    slopes = found.derivatives(truth.project(truth.surface(FLAT)))
    inside = found.covariance[: slopes.shape[2], : slopes.shape[2]]
    absolute = np.sqrt(np.einsum("i,nip,pq,njq,j->n", truth.h, slopes, inside, slopes, truth.h))
    assert np.median(absolute) > 1.5 * np.median(sigmas[:, 1])


def test_triangulation_keeps_the_size_of_the_errors(truth: LaserSensor, found: SensorGeometry) -> None:
    """The mean variance over the pixels is that of the points without the best rigid motion of each error pattern."""
    pixels = truth.project(truth.surface(FLAT))
    predicted = found.triangulation(SIZE, "columns", pixels).covariance_at(pixels[:, ::-1])
    patterns = np.stack([found.sheet.g_axis, found.sheet.h_axis]) @ found.derivatives(pixels)
    g, h = found.in_sheet(found.points(pixels)).T
    turn = np.stack([h.mean() - h, g - g.mean()], axis=1)
    patterns = patterns - patterns.mean(axis=0)
    patterns = patterns - turn[:, :, None] * np.einsum("ni,nip->p", turn, patterns) / np.sum(turn**2)
    covariance = found.covariance[: patterns.shape[2], : patterns.shape[2]]
    expected = np.einsum("nip,pq,niq->", patterns, covariance, patterns) / len(pixels)
    assert np.trace(predicted, axis1=-2, axis2=-1).mean() == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_systematic_sigmas_hold_over_seeds(truth: LaserSensor) -> None:
    ratios = []
    for seed in range(20):
        errors, sigmas = errors_in_sheet(truth, calibrated(truth, np.random.default_rng((30, seed))))
        ratios.append(errors / sigmas)
    assert np.mean(np.abs(ratios) < 3.0) >= 0.95
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.4
