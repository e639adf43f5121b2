"""Construction of a triangulation from geometry, calibration points or tables; and its inverse."""

from __future__ import annotations

import contextlib
import math
import tomllib
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from gpuvision.camera.lens import Lens
from gpuvision.ranging import homography
from gpuvision.ranging.homography_fit import fit_models
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation

REGION = ((-3e-3, 3e-3), (-3e-3, 3e-3))
SIGMA = 2e-6
SHEET = np.stack(np.meshgrid(np.linspace(-0.02, 0.02, 9), np.linspace(-0.012, 0.01, 7)), -1).reshape(-1, 2)


def psd(**more: Any) -> Triangulation:
    return Triangulation.from_stand_off(
        **{"baseline": 0.1, "stand_off": 0.2, "focal_distance": 0.016, "region": REGION, **more}
    )


def rotated(points: np.ndarray, angle: float) -> np.ndarray:
    return points @ np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


# ---- geometry ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tilt", [None, 0.0, 0.3, -0.2])
def test_stand_off_against_rays_in_space(tilt: float | None) -> None:
    operation = psd(tilt=tilt)
    angle, distance = math.atan2(0.1, 0.2), math.hypot(0.1, 0.2)
    alpha = math.atan2(0.016, distance * math.tan(angle)) if tilt is None else tilt
    axis = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    up = np.array([math.cos(angle), 0.0, math.sin(angle)])
    u_axis = math.cos(alpha) * up + math.sin(alpha) * axis
    v_axis, middle = np.array([0.0, 1.0, 0.0]), 0.016 * axis
    for g, h in SHEET:
        ray = np.array([0.1, g, h - 0.2])
        # Where the ray from the lens meets the sensor plane, mirrored through the lens to its front.
        along, u, v = np.linalg.solve(np.stack([ray, -u_axis, -v_axis], axis=1), middle)
        assert along > 0.0
        np.testing.assert_allclose(operation.to_sensor((g, h)), (u, v), rtol=1e-11, atol=1e-16)


def test_scheimpflug_is_the_default() -> None:
    # tan(alpha) = m tan(omega), omega the tilt of the sheet against the plane perpendicular to the axis.
    omega, magnification = math.atan2(0.2, 0.1), 0.016 / math.hypot(0.1, 0.2)
    tilted = psd(tilt=math.atan(magnification * math.tan(omega)))
    np.testing.assert_allclose(psd().homography, tilted.homography, rtol=1e-12, atol=1e-15)


def test_sensitivity_is_the_textbook_one() -> None:
    # Untilted, dH/du = D^2 / (f' b) in the middle.
    _, _, _, _, slope, _, _, _ = psd(tilt=0.0).conditioned()
    assert slope / 3e-3 == pytest.approx((0.1**2 + 0.2**2) / (0.016 * 0.1), rel=1e-12)


def test_camera_against_projection() -> None:
    camera = np.array([[1700.0, 0.3, 640.0], [0.0, 1690.0, 512.0], [0.0, 0.0, 1.0]])
    rotation = np.linalg.qr(np.array([[1.0, 0.1, 0.2], [0.0, -0.5, -0.8], [0.1, 0.9, -0.4]]))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    translation = np.array([0.01, 0.02, 0.4])
    origin, g_axis, h_axis = np.array([0.0, 0.05, 0.01]), np.array([0.8, 0.6, 0.0]), np.array([0.0, 0.0, 1.0])
    world = origin + SHEET[:, :1] * g_axis + SHEET[:, 1:] * h_axis
    seen = (world @ rotation.T + translation) @ camera.T
    pixels = seen[:, :2] / seen[:, 2:]
    place = {"origin": origin, "g_axis": g_axis, "h_axis": h_axis}
    columns = Triangulation.from_camera(
        camera, rotation, translation, along="columns", region=homography.bounding_box(pixels[:, ::-1]), **place
    )
    rows = Triangulation.from_camera(
        camera, rotation, translation, along="rows", region=homography.bounding_box(pixels), **place
    )
    np.testing.assert_allclose(columns.to_sensor(SHEET), pixels[:, ::-1], rtol=1e-11)
    np.testing.assert_allclose(rows.to_sensor(SHEET), pixels, rtol=1e-11)


def test_to_sensor_flags_what_is_behind_and_what_the_lens_cannot_show() -> None:
    operation = psd(tilt=0.0)
    distance = math.hypot(0.1, 0.2)
    horizon = distance / math.cos(math.atan2(0.1, 0.2))
    seen = operation.to_sensor([[0.0, 0.9 * horizon], [0.0, 1.1 * horizon]])
    assert np.all(np.isfinite(seen[0]))
    assert np.all(np.isnan(seen[1]))
    folding = psd(lens=Lens(k1=-1e5))
    assert np.any(np.isnan(folding.to_sensor([[0.0, 0.05]])))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"baseline": 0.0}, "baseline"),
        ({"baseline": -0.1}, "baseline"),
        ({"tilt": 0.5 * math.pi}, "right angle"),
        ({"focal_distance": math.nan}, "finite"),
        ({"baseline": 1e-13, "tilt": 0.0}, "horizon"),
        ({"tilt": 0.5 * math.pi - 1e-13}, "edge-on"),
    ],
)
def test_geometry_at_its_ends(change: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        psd(**change)


@pytest.mark.parametrize("change", [{"baseline": 1e-5, "tilt": 0.0}, {"tilt": math.radians(89.9)}])
def test_geometry_near_its_ends_still_inverts(change: dict[str, float]) -> None:
    operation = psd(**change)
    g0, gx, gy, h0, hx, hy, dx, dy = operation.conditioned()
    seen = operation.to_sensor([[1e-4, 1e-6]])[0] / 3e-3
    w = 1.0 + dx * seen[0] + dy * seen[1]
    assert g0 + (gx * seen[0] + gy * seen[1]) / w == pytest.approx(1e-4, rel=1e-9)
    assert h0 + (hx * seen[0] + hy * seen[1]) / w == pytest.approx(1e-6, rel=1e-9)


# ---- fitting -----------------------------------------------------------------------------------------------


def offset(points: np.ndarray) -> np.ndarray:
    return points + np.array([1e-4, 2e-4])


def rolled(points: np.ndarray) -> np.ndarray:
    return rotated(points, 0.03)


CASES = {"C4": lambda points: points, "D6": offset, "H8": rolled}


@pytest.mark.parametrize("model", CASES)
def test_smallest_sufficient_model_is_chosen(model: str, rng: np.random.Generator) -> None:
    seen = CASES[model](psd().to_sensor(SHEET))
    chosen = [Triangulation.fit(seen + rng.normal(0.0, SIGMA, seen.shape), SHEET).model for _ in range(60)]
    # A test at 1 % rejects a true small model in 1 % of the trials: six of sixty would be a 1e-5 accident.
    assert chosen.count(model) > 54
    smaller = {"C4": (), "D6": ("C4",), "H8": ("C4", "D6")}[model]
    assert not any(chosen.count(each) for each in smaller)


@pytest.mark.parametrize("model", CASES)
def test_exact_points_are_met_and_need_no_larger_model(model: str) -> None:
    seen = CASES[model](psd().to_sensor(SHEET))
    fitted = Triangulation.fit(seen, SHEET)
    assert fitted.model == model
    np.testing.assert_allclose(fitted.to_sensor(SHEET), seen, rtol=0, atol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("model", CASES)
def test_parameter_covariance_is_the_spread_of_fits(model: Any, rng: np.random.Generator) -> None:
    seen = CASES[model](psd().to_sensor(SHEET))
    options = {"model": model, "region": REGION}
    fits = [
        Triangulation.fit(seen + rng.normal(0.0, SIGMA, seen.shape), SHEET, **options).conditioned() for _ in range(300)
    ]
    spread = np.std(fits, axis=0)
    known = Triangulation.fit(seen, SHEET, sigma=SIGMA, **options)
    guessed = Triangulation.fit(seen + rng.normal(0.0, SIGMA, seen.shape), SHEET, **options)
    predicted = np.sqrt(np.diag(known.covariance))
    free = predicted > 1e-12 * np.max(predicted)
    # A deviation from 300 trials is known to 4 %, from the residuals of a single fit to 7 %: four sigmas each.
    np.testing.assert_allclose(spread[free], predicted[free], rtol=0.16)
    np.testing.assert_allclose(np.sqrt(np.diag(guessed.covariance))[free], predicted[free], rtol=0.28)
    assert np.all(spread[~free] <= 1e-9 * np.max(spread))


@pytest.mark.slow
def test_covariance_of_a_point_is_the_spread_of_measurements(rng: np.random.Generator) -> None:
    lens = Lens(k1=2e3, centre=(1e-3, -5e-4))
    truth = psd(lens=lens)
    seen = truth.to_sensor(SHEET)
    point, sigma = np.array([0.8e-3, -1.1e-3]), (3e-6, 5e-6)
    found = []
    for _ in range(400):
        fitted = Triangulation.fit(
            seen + rng.normal(0.0, sigma, seen.shape), SHEET, sigma=sigma, model="H8", region=REGION, lens=lens
        )
        found.append(np.linalg.solve(jacobian(fitted, point), on_sheet(fitted, point + rng.normal(0.0, sigma))))
    predicted = fitted.covariance_at(point)
    derivative = jacobian(fitted, point)
    spread = np.cov((np.array(found) @ derivative.T).T)
    # Variances from 400 trials are known to 7 %: four sigmas.
    np.testing.assert_allclose(np.diag(spread), np.diag(predicted), rtol=0.28)
    correlation = predicted[0, 1] / math.sqrt(predicted[0, 0] * predicted[1, 1])
    assert np.corrcoef((np.array(found) @ derivative.T).T)[0, 1] == pytest.approx(correlation, abs=0.2)


def on_sheet(operation: Triangulation, point: np.ndarray) -> np.ndarray:
    """Return (G, H) of a measured point, on the host."""
    lens = operation.lens.swapped()
    return homography.project(np.array(operation.homography), lens.undistort(point))


def jacobian(operation: Triangulation, point: np.ndarray) -> np.ndarray:
    steps = 1e-7 * np.eye(2)
    return np.stack([(on_sheet(operation, point + s) - on_sheet(operation, point - s)) / 2e-7 for s in steps], axis=1)


def test_lens_is_undone_in_the_fit(rng: np.random.Generator) -> None:
    lens = Lens(k1=5e3, k2=-1e8, centre=(2e-4, -1e-4))
    seen = psd(lens=lens).to_sensor(SHEET)
    fitted = Triangulation.fit(seen, SHEET, lens=lens)
    assert fitted.model == "C4"
    np.testing.assert_allclose(fitted.to_sensor(SHEET), seen, rtol=0, atol=1e-14)
    noisy = seen + rng.normal(0.0, 0.01 * SIGMA, seen.shape)
    without, with_lens = fit_models(noisy, SHEET), fit_models(noisy, SHEET, distortion=lens.swapped())
    assert without[-1].rms > 10.0 * with_lens[-1].rms


def test_sigma_weighs_the_points(rng: np.random.Generator) -> None:
    seen = psd().to_sensor(SHEET)
    sigma = np.where(np.arange(len(SHEET))[:, None] % 2 == 0, SIGMA, 100.0 * SIGMA) * np.ones(2)
    truth = psd().conditioned()
    errors: dict[bool, list[float]] = {True: [], False: []}
    for _ in range(40):
        noisy = seen + sigma * rng.normal(size=seen.shape)
        for weighted in errors:
            fitted = Triangulation.fit(noisy, SHEET, sigma=sigma if weighted else None, model="H8", region=REGION)
            errors[weighted].append(float(np.max(np.abs(fitted.conditioned() - truth))))
    assert np.mean(errors[True]) < 0.1 * np.mean(errors[False])


def test_p_value_is_that_of_the_textbook(rng: np.random.Generator) -> None:
    """F = (S1 - S2) / (d1 - d2) / (S2 / d2) for sums of squares S and degrees of freedom d of two nested models."""
    seen = psd().to_sensor(SHEET)
    fits = fit_models(seen + rng.normal(0.0, SIGMA, seen.shape), SHEET, sigma=SIGMA)
    full = fits[-1]
    assert [each.model for each in fits] == ["C4", "D6", "H8"]
    for each in fits[:-1]:
        more = each.degrees_of_freedom - full.degrees_of_freedom
        ratio = (each.rms**2 / full.rms**2 - 1.0) * full.degrees_of_freedom / more
        assert each.p_value == pytest.approx(scipy.stats.f.sf(ratio, more, full.degrees_of_freedom), rel=1e-6)
        assert 0.01 < each.p_value < 0.99


def test_residuals_are_told_in_sigmas(rng: np.random.Generator) -> None:
    seen = psd().to_sensor(SHEET)
    noisy = seen + rng.normal(0.0, (SIGMA, 3.0 * SIGMA), seen.shape)
    full = fit_models(noisy, SHEET, sigma=(SIGMA, 3.0 * SIGMA))[-1]
    # 126 residuals have 118 degrees of freedom; their root mean square is known to 6.5 %.
    assert full.degrees_of_freedom == 126 - 8
    assert full.rms == pytest.approx(math.sqrt(118 / 126), rel=0.26)


def test_a_wrong_pair_is_refused_where_sigma_is_known(rng: np.random.Generator) -> None:
    """One pair with G and H exchanged is hundreds of sigmas off; all pairs with mirrored axes fit."""
    seen = psd().to_sensor(SHEET) + rng.normal(0.0, SIGMA, SHEET.shape)
    wrong = SHEET.copy()
    wrong[5] = wrong[5, ::-1]
    with pytest.raises(ValueError, match=r"residual is \d\S+ times sigma, expected at most 10; check the order"):
        Triangulation.fit(seen, wrong, sigma=SIGMA)
    assert Triangulation.fit(seen, wrong).model  # without sigma there is nothing to compare with
    limits = homography.HomographyLimits(max_rms=math.inf)
    assert Triangulation.fit(seen, wrong, sigma=SIGMA, limits=limits).model
    for mirror in (np.array([-1.0, 1.0]), np.array([1.0, -1.0])):
        fitted = Triangulation.fit(seen, SHEET * mirror, sigma=SIGMA)
        np.testing.assert_allclose(fitted.to_sensor(SHEET * mirror), seen, rtol=0, atol=6.0 * SIGMA)
    Triangulation.fit(seen, SHEET, sigma=SIGMA / 8.0)
    with pytest.raises(ValueError, match="times sigma, expected at most 10"):
        Triangulation.fit(seen, SHEET, sigma=SIGMA / 12.0)


def test_single_beam_is_a_moebius_map(rng: np.random.Generator) -> None:
    heights = np.linspace(-0.01, 0.01, 21)
    sheet = np.stack([np.full(21, 0.003), heights], -1)
    seen = psd().to_sensor(sheet) + rng.normal(0.0, SIGMA, (21, 1)) * (1.0, 0.0)
    seen[:, 1] = 4e-4
    fits = fit_models(seen, sheet)
    assert [each.model for each in fits] == ["C3"]
    # Readings of one beam scatter across it; several beams at one height are no single beam.
    scattered = seen + rng.normal(0.0, SIGMA, (21, 1)) * (0.0, 1.0)
    assert [each.model for each in fit_models(scattered, sheet)] == ["C3"]
    fitted = Triangulation.fit(seen, sheet, sigma=SIGMA)
    assert fitted.model == "C3"
    np.testing.assert_allclose(fitted.to_sensor(sheet)[:, 0], seen[:, 0], rtol=0, atol=5.0 * SIGMA)
    # It has no v: points are imaged in the middle of the region, whatever their G is.
    off = Triangulation.fit(seen, sheet, sigma=SIGMA, region=((-3e-3, 3e-3), (-2e-4, 7e-4)))
    np.testing.assert_allclose(off.to_sensor(sheet + np.array([0.01, 0.0]))[:, 1], 2.5e-4, rtol=0, atol=1e-15)
    np.testing.assert_allclose(off.to_sensor(sheet)[:, 0], fitted.to_sensor(sheet)[:, 0], rtol=1e-9)
    np.testing.assert_allclose(fitted.to_sensor(sheet)[:, 1], 4e-4, rtol=0, atol=1e-15)
    g0, gx, gy, *_ = fitted.conditioned()
    np.testing.assert_allclose((g0, gx, gy), (0.003, 0.0, 0.0), rtol=0, atol=1e-15)
    assert np.sqrt(fitted.covariance_at([0.0, 4e-4])[1, 1]) > 0.0
    assert fitted.covariance_at([0.0, 4e-4])[0, 0] < 1e-30


@settings(max_examples=50, deadline=None)
@given(
    roll=st.floats(-0.2, 0.2),
    tilt=st.floats(-0.6, 0.9),
    baseline=st.floats(0.02, 0.4),
    scale=st.sampled_from([1.0, 1e5, 1e-3]),
)
def test_any_geometry_is_recovered(roll: float, tilt: float, baseline: float, scale: float) -> None:
    truth = psd(tilt=tilt, baseline=baseline)
    seen = rotated(truth.to_sensor(SHEET), roll) * scale
    fitted = Triangulation.fit(seen, SHEET, model="H8")
    np.testing.assert_allclose(fitted.to_sensor(SHEET), seen, rtol=0, atol=1e-11 * np.max(np.abs(seen)))


def test_four_points_fix_eight_parameters_without_a_covariance() -> None:
    corners = SHEET[[0, 8, -9, -1]]
    seen = rolled(psd().to_sensor(corners))
    fitted = Triangulation.fit(seen, corners, model="H8")
    np.testing.assert_allclose(fitted.to_sensor(corners), seen, rtol=0, atol=1e-15)
    assert fitted.covariance is None
    assert Triangulation.fit(seen, corners, model="H8", sigma=SIGMA).covariance is not None


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        (SHEET[:3], {"model": "H8"}, "too few"),
        (SHEET[::9], {"model": "H8"}, "do not fix"),
        (np.repeat(SHEET[:1], 9, axis=0), {"model": "C4"}, "do not fix"),
        (SHEET, {"model": "C8"}, "the model is 'C8', expected one of C3, C4, D6, H8"),
        (SHEET, {"sigma": 0.0}, "sigma must be positive"),
        (SHEET, {"lens": Lens(k1=-1e6)}, "beyond the fold"),
    ],
)
def test_points_that_do_not_fix_a_model(points: np.ndarray, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Triangulation.fit(psd().to_sensor(points), points, **options)


@pytest.mark.parametrize(
    ("places", "model", "message"),
    [
        ([0, 8, -9], "H8", "3 places on the sheet do not fix the model H8, which needs 4 or more"),
        ([0, 1, 2, -9], "H8", "4 places on the sheet do not fix the model H8, as too many of them lie on one line"),
        ([0, 8], "D6", "2 places on the sheet do not fix the model D6, which needs 3 or more"),
        ([0, 8], "C3", r"[12] heights H do not fix the model C3, which needs 3 or more"),
    ],
)
def test_repeated_readings_do_not_replace_places(
    places: list[int], model: Any, message: str, rng: np.random.Generator
) -> None:
    """Noise gives the equations of repeated readings full rank; their solution has no meaning."""
    points = np.repeat(SHEET[places], 5, axis=0)
    for _ in range(20):
        seen = rolled(psd().to_sensor(points)) + rng.normal(0.0, SIGMA, points.shape)
        with pytest.raises(ValueError, match=f"^{message}$"):
            Triangulation.fit(seen, points, model=model)
        assert model != "H8" or Triangulation.fit(seen, points).model != "H8"


@pytest.mark.parametrize(
    ("places", "is_fixed"),
    [
        ([(0, 0), (0, 1), (0, 2), (0, 3)], False),
        ([(1, 0), (2, 0), (-1, 0)], False),
        ([(0, 0), (1, 1), (-1, 1), (2, 1)], False),
        ([(1, 0), (2, 1)], True),
        ([(1, 0), (0, 1), (0, 2)], True),
        ([(1, 0), (1, 1), (1, 2)], True),
    ],
)
def test_places_that_fix_the_symmetric_model(places: list[tuple[int, int]], is_fixed: bool) -> None:
    """u fixes a, b and c from three heights, or c comes from v = d G / (c H + 1) at two; G = 0 tells nothing of d."""
    points = np.repeat(np.array(places) * [2e-3, 1e-3] + [0.0, 1e-3], 3, axis=0)
    missing = "which needs places off the line G = 0 at two heights H, or three heights and one such place"
    message = rf"^{len(places)} places on the sheet do not fix the model C4, {missing}$"
    with contextlib.nullcontext() if is_fixed else pytest.raises(ValueError, match=message):
        fitted = Triangulation.fit(psd().to_sensor(points), points, model="C4")
        np.testing.assert_allclose(fitted.to_sensor(points), psd().to_sensor(points), rtol=1e-6, atol=1e-15)


def test_heights_that_are_almost_equal_do_not_fix_a_beam() -> None:
    points = np.array([[0.0, 1e-3], [0.0, 1e-3 + 1e-18], [0.0, 1e-3 + 2e-18], [0.0, 3e-3]])
    message = "^4 heights H do not fix the model C3, as they are too close to each other$"
    with pytest.raises(ValueError, match=message):
        Triangulation.fit(psd().to_sensor(points), points, model="C3")


@pytest.mark.parametrize(("count", "model"), [(2, "C4"), (3, "D6"), (4, "H8")])
def test_least_number_of_places(count: int, model: Any, rng: np.random.Generator) -> None:
    """Oracle: with as many equations as parameters the fit meets the mean readings at the places."""
    corners = SHEET[{2: [0, -1], 3: [0, 31, -9], 4: [0, 8, -9, -1]}[count]]
    points = np.repeat(corners, 5, axis=0)
    seen = CASES[model](psd().to_sensor(points)) + rng.normal(0.0, SIGMA, points.shape)
    fitted = Triangulation.fit(seen, points, model=model)
    means = seen.reshape(count, 5, 2).mean(axis=1)
    np.testing.assert_allclose(fitted.to_sensor(corners), means, rtol=0, atol=1e-3 * SIGMA)


def test_points_behind_the_horizon_are_refused() -> None:
    matrix = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 1.0]])
    seen = np.stack(np.meshgrid([-1.0, 0.0, 0.5, 2.0, 3.0], [-1.0, 0.0, 1.0]), -1).reshape(-1, 2)
    with pytest.raises(ValueError, match="both sides of the horizon"):
        Triangulation.fit(seen, homography.project(matrix, seen), model="H8")


@pytest.mark.parametrize(
    ("sensor", "sheet", "message"),
    [
        (np.zeros((5, 2)), np.zeros((4, 2)), "pairs"),
        (np.zeros((5, 3)), np.zeros((5, 2)), "expected \\(n, 2\\)"),
        (np.zeros((0, 2)), np.zeros((0, 2)), "expected \\(n, 2\\)"),
        (np.full((5, 2), np.nan), np.zeros((5, 2)), "not finite"),
    ],
)
def test_malformed_points(sensor: np.ndarray, sheet: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Triangulation.fit(sensor, sheet)


# ---- constants, tables, checks -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("constants", "model"),
    [((0.3, 1e-3, 0.02), "C4"), ((0.3, 1e-3, 0.02, 0.1), "C4"), ((0.3, 1e-3, 0.02, 0.1, 0.01, -2e-4), "D6")],
)
def test_constants(constants: tuple[float, ...], model: str) -> None:
    if len(constants) == 3:
        constants, model = (2.0, 1e-3, 40.0), "C3"
    operation = Triangulation.from_constants(constants, region=REGION)
    assert operation.model == model
    u, v = 1e-3, 2e-3
    found = homography.project(np.array(operation.homography), np.array([u, v]))
    match constants:
        case (a, b, c):
            expected = (0.0, (a * u + b) / (c * u + 1.0))
        case (a, b, c, d):
            expected = (d * v / (u + c), (a * u + b) / (u + c))
        case (a, b, c, d, e, f):
            expected = ((d * v + e * u + f) / (u + c), (a * u + b) / (u + c))
    np.testing.assert_allclose(found, expected, rtol=1e-13)


def test_eight_constants_are_the_homography() -> None:
    rows = (1.0, 0.1, 0.0, 0.2, 1.0, 0.0, 0.01, 0.02)
    operation = Triangulation.from_constants(rows, region=REGION)
    np.testing.assert_array_equal(np.ravel(operation.homography), (*rows, 1.0))
    with pytest.raises(ValueError, match="3, 4, 6 or 8"):
        Triangulation.from_constants(rows[:5], region=REGION)


def test_table_round_trip_through_toml(rng: np.random.Generator) -> None:
    seen = psd().to_sensor(SHEET) + rng.normal(0.0, SIGMA, SHEET.shape)
    fitted = Triangulation.fit(seen, SHEET, sigma=(SIGMA, SIGMA), lens=Lens(k1=10.0, centre=(1e-3, 2e-3)))
    table = fitted.to_dict()
    lens = table.pop("lens")
    lines = [f"{key} = {value!r}" for key, value in table.items()]
    lines += ["[lens]", *(f"{key} = {value}" for key, value in lens.items())]
    assert Triangulation.from_dict(tomllib.loads("\n".join(lines))) == fitted
    assert Triangulation.from_dict(psd().to_dict()) == psd()


IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"homography": ((1.0, 0.0), (0.0, 1.0))}, "expected \\(3, 3\\)"),
        ({"homography": ((1.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 1.0))}, "edge-on"),
        ({"homography": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 0.0))}, "horizon"),
        ({"homography": ((1.0, 0.0, 0.0), (0.0, math.nan, 0.0), (0.0, 0.0, 1.0))}, "finite"),
        ({"homography": "identity"}, "must be numbers"),
        ({"region": ((1.0, 1.0), (0.0, 1.0))}, "region"),
        ({"model": "H9"}, "one of C3, C4, D6, H8"),
        ({"along": "diagonal"}, "'columns' or 'rows'"),
        ({"horizon": 0.0}, "between 0 and 1"),
        ({"sigma": (-1.0, 1.0)}, "negative"),
        ({"covariance": ((1.0,),)}, "expected \\(8, 8\\)"),
        ({"depth": 1.0}, "unknown key 'depth'"),
    ],
)
def test_bad_tables(change: dict[str, Any], message: str) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        Triangulation.from_dict({"homography": IDENTITY, "region": ((0.0, 1.0), (0.0, 1.0)), **change})


def test_missing_key() -> None:
    with pytest.raises(ValueError, match="'region' is missing"):
        Triangulation.from_dict({"homography": IDENTITY})


def test_covariance_needs_something_known() -> None:
    with pytest.raises(ValueError, match="neither sigma nor covariance"):
        psd().covariance_at([0.0, 0.0])


def test_axes_are_checked() -> None:
    with pytest.raises(ValueError, match="pitch is 0"):
        SampleAxes(sample_pitch=0.0)
    with pytest.raises(ValueError, match="finite"):
        SampleAxes(position_origin=math.inf)
