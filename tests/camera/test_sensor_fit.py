"""Fit of a sensor to flat and dark frames: planted parameters, coverage of the sigmas, a real camera, refused input."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.camera.photon_transfer import FrameStatistics, frame_statistics
from gpuvision.camera.sensor_fit import Estimate, SensorFit, _Fit, _reduced_chi_square, fit_sensor

PLANTED = {"gain": 0.25, "quantum_efficiency": 0.6, "dark_noise": 12.0, "prnu": 0.02, "dsnu": 15.0, "dark_current": 4e4}
LEVEL, FULL_WELL = 30.0, 14e3


def frames(
    rng: np.random.Generator,
    photons: np.ndarray,
    exposures: np.ndarray,
    count: int,
    shape: tuple[int, int],
    *,
    exact_patterns: bool = False,
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return flat and dark stacks of pixels that count Poisson electrons, in whole grey levels.

    With exact patterns the differences between the pixels have the planted standard deviations in this sensor, instead
    of in the population from which it is drawn.
    """
    patterns = rng.standard_normal((2, *shape))
    if exact_patterns:
        patterns -= patterns.mean(axis=(1, 2), keepdims=True)
        patterns[1] -= patterns[0] * np.sum(patterns[0] * patterns[1]) / np.sum(patterns[0] ** 2)
        patterns /= patterns.std(axis=(1, 2), keepdims=True)
    gains, offsets = 1.0 + PLANTED["prnu"] * patterns[0], PLANTED["dsnu"] * patterns[1]

    def stack(light: float, exposure: float) -> np.ndarray:
        mean = PLANTED["quantum_efficiency"] * light * gains + PLANTED["dark_current"] * exposure
        electrons = np.minimum(rng.poisson(mean, (count, *shape)), FULL_WELL)
        noise = PLANTED["dark_noise"] * rng.standard_normal(electrons.shape)
        return np.rint(LEVEL + PLANTED["gain"] * (electrons + offsets + noise)).astype(np.uint16)

    flat = [stack(*each) for each in zip(photons, exposures, strict=True)]
    return flat, [stack(0.0, each) for each in exposures]


def pulls(fit: SensorFit) -> list[float]:
    """Return the errors of all estimates over their sigmas."""
    found: dict[str, Estimate] = {name: getattr(fit, name) for name in PLANTED}
    return [(found[name].value - truth) / found[name].sigma for name, truth in PLANTED.items()]


def test_planted_parameters_are_recovered_from_a_thousand_frames(rng: np.random.Generator) -> None:
    photons, exposures = np.linspace(400.0, 28e3, 20), np.linspace(1e-3, 40e-3, 20)
    flat, dark = frames(rng, photons, exposures, 25, (48, 48), exact_patterns=True)
    fit = fit_sensor(flat, dark, photons=photons, exposures=exposures)
    for name in ("gain", "quantum_efficiency", "dark_noise", "prnu"):
        estimate = getattr(fit, name)
        assert estimate.value == pytest.approx(PLANTED[name], rel=0.01), name
    assert np.abs(pulls(fit)).max() < 3.5
    assert fit.dark_level == pytest.approx(LEVEL, abs=0.1)
    # The temporal variance falls when the first pixels are full: 2.5 standard deviations of the pixels before the mean,
    # and up to one step of 840 electrons; dark current fills up to 1600 electrons.
    assert FULL_WELL - 1600.0 - 2.5 * math.hypot(280.0, 120.0) - 840.0 < fit.saturation < FULL_WELL
    assert fit.used.sum() == pytest.approx(0.7 * FULL_WELL / 0.6 / 28e3 * 20, abs=2)
    np.testing.assert_allclose(fit.predicted_variance[fit.used], fit.variance[fit.used], rtol=0.1)
    sensor = fit.sensor(rows=48, columns=48, pitch=5e-6, bits=12)
    assert float(sensor.level(1000.0)) == pytest.approx(LEVEL + 250.0, rel=0.01)
    assert float(sensor.noise(1000.0, spatial=False)) == pytest.approx(math.sqrt(1000 + 144 + 16 / 12), rel=0.01)


def test_sigmas_cover_the_errors(rng: np.random.Generator, draws: Callable[[int, int], int]) -> None:
    count = draws(40, 400)
    photons, exposures = np.linspace(500.0, 16e3, 8), np.linspace(1e-3, 30e-3, 8)
    found = []
    for _ in range(count):
        flat, dark = frames(rng, photons, exposures, 3, (20, 20))
        found.append(pulls(fit_sensor(flat, dark, photons=photons, exposures=exposures)))
    # Standard deviations of a mean and of a standard deviation of pulls; sigmas are estimates of a few residuals, too.
    spread = np.sqrt(np.mean(np.square(found), axis=0))
    margin = 4.0 / math.sqrt(2.0 * count)
    assert (spread > 0.75 - margin / 2).all(), spread
    assert (spread < 1.2 + margin).all(), spread
    assert (np.abs(np.mean(found, axis=0)) < 4.5 / math.sqrt(count) + 0.15).all()


def test_without_photons_and_exposures_gain_and_noise_are_left(rng: np.random.Generator) -> None:
    photons, exposures = np.linspace(500.0, 16e3, 8), np.full(8, 1e-3)
    flat, dark = frames(rng, photons, exposures, 8, (40, 40))
    fit = fit_sensor(flat, np.concatenate(dark))
    assert fit.gain.value == pytest.approx(0.25, rel=0.02)
    assert fit.dark_noise.value == pytest.approx(math.sqrt(144 + 40), rel=0.02)  # with the dark current
    assert math.isnan(fit.quantum_efficiency.value)
    assert math.isnan(fit.dark_current.sigma)
    assert fit.saturation == math.inf
    assert fit.used.all()
    with_rounding = fit_sensor(flat, np.concatenate(dark), quantised=False)
    assert with_rounding.dark_noise.value**2 - fit.dark_noise.value**2 == pytest.approx(1 / 12 / 0.25**2, rel=0.05)
    assert str(Estimate(0.25, 0.001)) == "0.25 +- 0.001"


def test_light_that_changes_from_frame_to_frame_is_no_noise(rng: np.random.Generator) -> None:
    photons, exposures = np.linspace(500.0, 16e3, 8), np.full(8, 1e-3)
    flat, dark = frames(rng, photons, exposures, 8, (40, 40))
    shaken = [each + rng.uniform(-20.0, 20.0, (8, 1, 1)) for each in flat]
    assert fit_sensor(shaken, dark).gain.value == pytest.approx(fit_sensor(flat, dark).gain.value, rel=1e-3)


def test_uneven_steps_enlarge_the_sigma(rng: np.random.Generator) -> None:
    """A gain that falls with the signal: the residuals exceed the noise, and the sigma grows with them."""
    photons, exposures = np.linspace(500.0, 16e3, 8), np.full(8, 1e-3)
    flat, dark = frames(rng, photons, exposures, 20, (40, 40))
    bent = [each * (1.0 - 5e-5 * each) for each in flat]
    straight, curved = fit_sensor(flat, dark, photons=photons), fit_sensor(bent, dark, photons=photons)
    assert straight.reduced_chi_square < 4.0
    assert curved.reduced_chi_square > 30.0
    assert curved.gain.sigma > 3.0 * straight.gain.sigma
    assert curved.quantum_efficiency.sigma > 3.0 * straight.quantum_efficiency.sigma


def test_reduced_chi_square_is_the_mean_over_the_freedoms() -> None:
    """Squares 1, 4 and 9 with weights 1, 1/2 and 1/3 are 6 in all; as many parameters as residuals leave no test."""
    left, weights = np.array([1.0, 2.0, 3.0]), np.diag([1.0, 1.0 / 2.0, 1.0 / 3.0])
    assert _reduced_chi_square(left, weights, 1) == pytest.approx(3.0)
    assert _reduced_chi_square(left, weights, 3) == 1.0


def recording(folder: Path) -> tuple[dict[str, list[Any]], dict[str, list[Any]]]:
    """Return exposures [s], photons and stacks of the bright (b) and dark (d) frames of the reference data set."""
    series: dict[str, dict[str, list[Any]]] = {
        kind: {"exposures": [], "photons": [], "stacks": []} for kind in ("b", "d")
    }
    for line in (folder / "EMVA1288_Data.txt").read_text().splitlines():
        words = line.split()
        if words and words[0] in series:
            current = series[words[0]]
            current["exposures"].append(float(words[1]) * 1e-9)
            current["photons"].append(float(words[2]) if len(words) > 2 else 0.0)
            current["stacks"].append([])
        elif words and words[0] == "i":
            image = cv2.imread(str(folder / words[1].replace("\\", "/")), cv2.IMREAD_UNCHANGED)
            current["stacks"][-1].append(image)
    for each in series.values():
        each["stacks"] = [np.stack(stack) for stack in each["stacks"]]
    return series["b"], series["d"]


@pytest.mark.realdata
@pytest.mark.slow
def test_a_real_camera_agrees_with_the_reference_implementation(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The program of the EMVA working group fits without weights: within two standard deviations of ours."""
    emva = pytest.importorskip("emva1288.process")
    folder = data / "emva1288"
    bright, dark = recording(folder)
    fit = fit_sensor(bright["stacks"], dark["stacks"], photons=bright["photons"], exposures=bright["exposures"])
    monkeypatch.setattr(np, "asfarray", lambda values: np.asarray(values, np.float64), raising=False)
    images = emva.ParseEmvaDescriptorFile(str(folder / "EMVA1288_Data.txt"), loglevel=logging.ERROR).images
    # The spatial part of the data set is not here; the program needs one exposure of it.
    images["spatial"] = {exposure: value for exposure, value in images["temporal"].items() if exposure == 5180000.0}
    loaded = emva.LoadImageData(images, loglevel=logging.ERROR)
    theirs = emva.Results1288(emva.Data1288(loaded.data, loglevel=logging.ERROR).data, loglevel=logging.ERROR)
    assert fit.gain.value == pytest.approx(theirs.K, abs=2 * fit.gain.sigma)
    assert fit.quantum_efficiency.value == pytest.approx(theirs.QE / 100, abs=2 * fit.quantum_efficiency.sigma)
    assert fit.dark_noise.value == pytest.approx(theirs.sigma_d, abs=2 * fit.dark_noise.sigma)
    assert fit.dark_current.value == pytest.approx(theirs.u_I_mean, abs=fit.dark_current.sigma)
    assert fit.prnu.value == pytest.approx(theirs.PRNU1288 / 100, rel=0.02)
    assert fit.gain.sigma / fit.gain.value < 0.01
    # Variance against mean: within 3 % of the line at every step of the fit, as far as this camera is linear.
    np.testing.assert_allclose(fit.variance[fit.used], fit.predicted_variance[fit.used], rtol=0.03)


def test_statistics_of_two_frames_are_those_of_the_standard(rng: np.random.Generator) -> None:
    """EMVA 1288: half the mean squared difference, less half the squared difference of the means."""
    a, b = rng.normal(100.0, 5.0, (2, 30, 40))
    b += 3.0
    found = frame_statistics([np.stack([a, b])], "flat")
    expected = np.mean((a - b) ** 2) / 2 - (a.mean() - b.mean()) ** 2 / 2
    assert found.temporal[0] == pytest.approx(expected * 1200 / 1199)
    assert found.mean[0] == pytest.approx((a.mean() + b.mean()) / 2)


def test_wrong_frames_are_refused() -> None:
    flat = [np.full((2, 4, 4), level, np.uint16) + np.eye(4, dtype=np.uint16) for level in (10, 20, 30)]
    dark = np.stack([np.zeros((4, 4)), np.ones((4, 4))])
    with pytest.raises(ValueError, match=r"flat\[0\] has the shape \(1, 4, 4\)"):
        fit_sensor([flat[0][:1]], dark)
    with pytest.raises(TypeError, match=r"flat\[1\] must be an array"):
        fit_sensor([flat[0], [[1]]], dark)
    with pytest.raises(ValueError, match="no frames"):
        fit_sensor([], dark)
    with pytest.raises(ValueError, match="not finite"):
        fit_sensor([flat[0] * np.nan], dark)
    with pytest.raises(ValueError, match="3 stacks of flat frames and 2 of dark ones"):
        fit_sensor(flat, [dark, dark])
    with pytest.raises(ValueError, match="photons: 2 numbers, expected 3"):
        fit_sensor(flat, dark, photons=[1.0, 2.0])
    with pytest.raises(ValueError, match="exposures need"):
        fit_sensor(flat, dark, exposures=[1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="fewer than two steps"):
        fit_sensor(flat[:1], dark)


def test_variances_of_the_statistics(rng: np.random.Generator) -> None:
    """Scatter of mean and variances over 20000 draws of 50 pixels in 4 frames: 1 % of a variance, one sigma."""
    pixels, count, temporal, spatial = 50, 4, 2.0, 1.5
    pattern = rng.normal(size=pixels)
    pattern = (pattern - pattern.mean()) * math.sqrt(spatial / pattern.var(ddof=1))
    rest = rng.normal(0.0, math.sqrt(temporal / count), (20_000, pixels))
    predicted = FrameStatistics(
        *(np.array([each]) for each in (0.0, temporal, spatial, 99.0, float(count), float(pixels)))
    )
    means = pattern + rest
    assert predicted.mean_variance[0] == pytest.approx(means.mean(axis=1).var(), rel=0.05)
    assert predicted.spatial_variance[0] == pytest.approx(means.var(axis=1, ddof=1).var(), rel=0.05)
    chi_square = temporal * rng.chisquare(99.0, 20_000) / 99.0
    assert predicted.temporal_variance[0] == pytest.approx(chi_square.var(), rel=0.05)


def test_differences_between_pixels_are_weighted_means() -> None:
    """Spatial variances of all dark stacks by their variances; of the flat stacks relative to the squared mean."""
    pixels = 400.0

    def statistics(mean: list[float], temporal: list[float], spatial: list[float], frames: list[float]) -> Any:
        count = np.array(frames)
        arrays = (mean, temporal, spatial, (count - 1.0) * (pixels - 1.0), count, np.full(3, pixels))
        return FrameStatistics(*map(np.array, arrays))

    lit = statistics([230.0, 430.0, 630.0], [54.0, 104.0, 154.0], [30.0, 95.0, 190.0], [5.0, 9.0, 4.0])
    unlit = statistics([30.0, 30.5, 31.0], [4.0, 4.5, 5.0], [14.0, 13.0, 15.0], [8.0, 3.0, 6.0])
    gain = 0.25
    dsnu, prnu = _Fit(lit, unlit, None, None, 0.0)._differences(gain)

    def variances(given: FrameStatistics) -> np.ndarray:
        rest = given.temporal / given.frames
        return np.asarray((4.0 * given.spatial * rest + 2.0 * rest**2) / (pixels - 1.0))

    dark, dark_total = np.average(unlit.spatial, weights=1.0 / variances(unlit), returned=True)
    mean = lit.mean - unlit.mean
    relative = (lit.spatial - dark) / mean**2
    weights = mean**4 / variances(lit)
    ratio, total = np.average(relative, weights=weights, returned=True)
    both = 4.0 * dark * ratio / pixels * np.average(1.0 / mean, weights=weights) ** 2
    for found, squared, variance, unit in (
        (dsnu, dark, 1.0 / dark_total, gain),
        (prnu, ratio, 1.0 / total + both, 1.0),
    ):
        value = math.sqrt(squared)
        assert found.value == pytest.approx(value / unit, rel=1e-12)
        # The error of the root, and the chance of 400 pixels of one sensor.
        expected = math.hypot(math.sqrt(variance) / (2.0 * value), value / math.sqrt(2.0 * 399.0)) / unit
        assert found.sigma == pytest.approx(expected, rel=1e-12)
