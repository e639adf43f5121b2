"""Robust lines on devices: minimum of the loss, robustness against outliers, validity of the covariance."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from canary import Guarded
from gpuvision.host import Device
from gpuvision.matching.features.line_fit import FitLines, LineFits
from gpuvision.matching.robust import efficiency
from gpuvision.reference import robust
from gpuvision.status import Status

VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
NOISE = 0.05


def scene(
    rng: np.random.Generator, lines: int, count: int, bad: float = 0.0, size: float = 1000.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals, points of the lines, and noisy points along them; the first points are gross errors."""
    angle, middle = rng.uniform(-np.pi / 2, np.pi / 2, lines), rng.uniform(0.0, size, (lines, 2))
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=-1)
    u, v = rng.uniform(-30.0, 30.0, (lines, count)), rng.normal(0.0, NOISE, (lines, count))
    far = int(bad * count)
    v[:, :far] += rng.uniform(1.0, 20.0, (lines, far)) * rng.choice([-1.0, 1.0], (lines, far))
    points = middle[:, None] + u[..., None] * along[:, None] + v[..., None] * normal[:, None]
    return normal, middle, points


def errors(fits: LineFits, normal: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Return angle errors and offsets at the centres, (lines, 2)."""
    sine = normal[:, 0] * fits.normal[:, 1] - normal[:, 1] * fits.normal[:, 0]
    cosine = np.sum(normal * fits.normal, axis=-1)
    offset = np.sum(normal * (fits.centre - middle), axis=-1)
    return np.stack([np.arctan(sine / cosine), offset], axis=-1)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize("loss", ["tukey", "huber", "ransac", "least_squares"])
def test_lies_at_the_minimum_of_its_loss(device: Device, loss: Any, variant: Any, rng: np.random.Generator) -> None:
    _, _, points = scene(rng, 5, 20, 0.3 if loss != "least_squares" else 0.0, size=100.0)
    points = np.rint(1024.0 * points) / 1024.0
    points[1, 0], points[2, :3] = np.nan, np.inf
    operation = FitLines(loss=loss, scale=NOISE, variant=variant, max_iterations=60)
    fits = operation(points, device=device)
    for number, each in enumerate(points):
        known = each[np.isfinite(each).all(axis=-1)]
        angle = np.arctan2(-fits.normal[number, 0], fits.normal[number, 1])
        start = (angle + 1e-6, float(fits.distance[number]) + 1e-5)
        found = robust.fit_line(known, np.ones(len(known)), NOISE, loss, operation.tuning_constant, start)
        assert angle == pytest.approx(found[0], abs=1e-7)
        assert fits.distance[number] == pytest.approx(found[1], abs=1e-5)
    # The fit is relative to the first valid point, so that a shift, exact in these digits, changes no rounding of it.
    shift = np.array([2.0**40, -(2.0**39)])
    far = operation(points + shift, device=device)
    np.testing.assert_array_equal(far.normal, fits.normal)
    np.testing.assert_array_equal(far.covariance, fits.covariance)
    np.testing.assert_array_equal(far.inliers, fits.inliers)
    # Doubles near 2^40 have a spacing of 2^-12.
    np.testing.assert_allclose(far.centre - shift, fits.centre, rtol=0, atol=2.0**-12)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize(
    ("loss", "scale", "bad"),
    [("tukey", None, 0.4), ("tukey", NOISE, 0.4), ("ransac", NOISE, 0.4), ("huber", None, 0.0)],
)
def test_covariance_is_what_is_measured(
    device: Device, variant: Any, loss: Any, scale: Any, bad: float, rng: np.random.Generator
) -> None:
    normal, middle, points = scene(rng, 1000, 20, bad)
    fits = FitLines(loss=loss, scale=scale, variant=variant)(points, device=device)
    # If twelve good points have a small scale by chance, some of them get weight 0.
    assert np.mean(fits.status != 0) < 0.01
    sigma = np.sqrt(fits.covariance[:, [0, 1], [0, 1]])
    found = errors(fits, normal, middle)
    # A thousand draws determine a standard deviation to 2 %; the asymptotic formula is good to 15 % at twelve good
    # points.
    np.testing.assert_allclose(np.std(found, axis=0) / np.sqrt(np.mean(sigma**2, axis=0)), 1.0, atol=0.15)
    # No line follows its outliers: they are at least 20 sigma away.
    assert np.abs(found[:, 1]).max() < 8.0 * sigma[:, 1].mean()
    if scale is None:
        assert np.median(fits.scale) == pytest.approx(NOISE, rel=0.2)


@pytest.mark.double
def test_single_follows_double(device: Device, rng: np.random.Generator) -> None:
    _, _, points = scene(rng, 37, 20, 0.3)
    points = points.astype(np.float32)
    single = FitLines()(points, device=device)
    double = FitLines()(points.astype(np.float64), device=device)
    np.testing.assert_allclose(single.normal, double.normal, atol=2e-6)
    # Floats near 1000 px have a spacing of 6e-5 px; distances from the origin also contain the rounding of the angle.
    np.testing.assert_allclose(single.centre, double.centre, atol=1e-4)
    np.testing.assert_allclose(single.distance, double.distance, atol=2e-3)
    np.testing.assert_allclose(single.covariance, double.covariance, rtol=1e-2, atol=1e-12)


@pytest.mark.double
@VARIANTS
def test_sigmas_weigh(device: Device, variant: Any, rng: np.random.Generator) -> None:
    _, _, points = scene(rng, 3, 20, size=50.0)
    sigma = rng.uniform(0.5, 3.0, (3, 20))
    fits = FitLines(loss="least_squares", scale=1.0, weighted=True, variant=variant, with_weights=True)(
        points, sigma, device=device
    )
    for number, each in enumerate(points):
        angle = np.arctan2(-fits.normal[number, 0], fits.normal[number, 1])
        start = (angle + 1e-6, float(fits.distance[number]) + 1e-5)
        found = robust.fit_line(each, sigma[number], 1.0, "least_squares", 1.0, start)
        assert angle == pytest.approx(found[0], abs=1e-7)
        assert fits.covariance[number, 1, 1] == pytest.approx(1.0 / np.sum(sigma[number] ** -2.0), rel=1e-6)
    np.testing.assert_array_equal(fits.weights, 1.0)


@pytest.mark.double
@VARIANTS
def test_what_is_missing(device: Device, variant: Any, rng: np.random.Generator) -> None:
    _, _, points = scene(rng, 6, 20)
    points[0, 5:9, 0] = np.nan
    points[1, 2:] = np.inf
    points[2, 1:] = np.nan
    points[3] = points[3, 0]
    points[4] = np.nan
    fits = FitLines(variant=variant, with_weights=True)(points, device=device)
    expected = [Status.OK, Status.OK, Status.NO_DATA, Status.AMBIGUOUS, Status.NO_DATA, Status.OK]
    np.testing.assert_array_equal(fits.status, expected)
    np.testing.assert_array_equal(fits.weights[0, 5:9], 0.0)
    without = FitLines(variant=variant)(np.delete(points[:1], slice(5, 9), axis=1), device=device)
    # Other start pairs change the scale slightly.
    np.testing.assert_allclose(fits.centre[0], without.centre[0], atol=0.1 * NOISE)
    # Two points determine a line, but no covariance.
    assert np.isfinite(fits.normal[1]).all()
    assert np.isnan(fits.covariance[1, 0, 0])
    for bad in (2, 3, 4):
        assert all(np.isnan(getattr(fits, name)[bad]).all() for name in ("normal", "distance", "centre", "scale"))
        assert fits.inliers[bad] == 0
        assert not fits.weights[bad].any()


@VARIANTS
def test_exact_points_upright_and_level(device: Device, variant: Any) -> None:
    along = np.linspace(0.0, 10.0, 8)
    points = np.stack(
        [np.stack([along, 0 * along + 3], -1), np.stack([0 * along + 5, along], -1), np.stack([along, -along], -1)]
    )
    fits = FitLines(variant=variant)(points.astype(np.float32), device=device)
    assert not fits.status.any()
    half = np.sqrt(0.5)
    np.testing.assert_allclose(fits.normal, [[0, 1], [-1, 0], [half, half]], atol=1e-6)
    np.testing.assert_allclose(fits.distance, [3, -5, 0], atol=1e-5)
    np.testing.assert_array_equal(fits.inliers, 8)


@pytest.mark.double
def test_too_few_agree(device: Device, rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 100.0, (20, 20, 2))
    fits = FitLines(scale=NOISE)(points, device=device)
    assert ((fits.status & Status.AMBIGUOUS) != 0).all()


@pytest.mark.double
@pytest.mark.parametrize(("variant", "lines"), [("vector", 1), ("vector", 17), ("work_item", 3), ("vector", 0)])
def test_writes_within_its_outputs(device: Device, variant: Any, lines: int, rng: np.random.Generator) -> None:
    _, _, points = scene(rng, lines, 20)
    operation = FitLines(variant=variant, with_weights=True)
    fits = operation(points, device=device)
    guarded = Guarded(fits)
    operation(points, device=device, out=guarded.out)
    guarded.assert_intact()
    for ours, again in zip(fits, guarded.out, strict=True):
        np.testing.assert_array_equal(ours, again)


def test_efficiencies() -> None:
    assert efficiency("huber", 1.345) == pytest.approx(0.95, abs=1e-3)
    assert efficiency("tukey", 4.685) == pytest.approx(0.95, abs=1e-3)
    assert efficiency("huber", 8.0) == pytest.approx(1.0, abs=1e-6)
    assert efficiency("ransac", 8.0) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"loss": "l1"}, "loss is 'l1'"),
        ({"loss": "ransac"}, "give the scale"),
        ({"scale": 0.0}, "scale is 0.0"),
        ({"tuning_constant": -1.0}, "tuning_constant is -1.0"),
        ({"max_trials": 0}, "max_trials is 0"),
        ({"min_scale": -1.0}, "min_scale"),
    ],
)
def test_refuses_parameters(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        FitLines(**parameters)


def test_refuses_inputs(device: Device) -> None:
    with pytest.raises(TypeError, match="float32 or float64"):
        FitLines()(np.zeros((4, 8, 2), np.int32), device=device)
    with pytest.raises(ValueError, match="points"):
        FitLines()(np.zeros((4, 8, 3), np.float32), device=device)
