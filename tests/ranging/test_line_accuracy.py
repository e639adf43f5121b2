"""Noise of the line methods: the Cramer-Rao bound for the likelihood fit, published figures for the others.

A column of 41 pixels with 20 electrons of background and 10 electrons of read noise, the line near its middle.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest

from gpuvision.host import Device
from gpuvision.host.program import build
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference.line import cramer_rao, pixel_gaussian, position_sigma, read_profile

TRIALS, LENGTH, BACKGROUND, READ_NOISE = 4000, 41, 20.0, 10.0

# sigma [px], peak [electrons]: deviation [px] of whole, windowed to 2.5 sigma, gauss3, Blais-Rioux of 4 and 8 taps.
FIGURES = {
    (0.5, 2000): (0.185, 0.0165, 0.0143, 0.0169, 0.0195),
    (1.0, 200): (0.730, 0.105, 0.119, 0.0841, 0.102),
    (1.0, 2000): (0.098, 0.0189, 0.0286, 0.0218, 0.0201),
    (1.0, 20_000): (0.0108, 0.0054, 0.0088, 0.0139, 0.0100),
    (2.5, 2000): (0.0471, 0.0286, 0.146, 0.0529, 0.0322),
    (4.0, 2000): (0.0404, 0.0492, 0.342, 0.122, 0.0616),
}


def trials(rng, sigma, peak):
    """Return the true positions and the frame of float32 electrons."""
    places = LENGTH // 2 + rng.uniform(-0.5, 0.5, TRIALS)
    light = pixel_gaussian(np.arange(LENGTH)[:, None], places, sigma, peak, BACKGROUND)
    return places, (rng.poisson(light) + rng.normal(0.0, READ_NOISE, light.shape)).astype(np.float32)


def deviation(readout, frame, places, device):
    reading = readout(frame, device=device)
    good = reading.status == 0
    assert good.mean() > 0.999
    return float(np.sqrt(np.mean((reading.position[good] - places[good]) ** 2)))


@pytest.mark.parametrize(("sigma", "peak"), [*FIGURES, (0.7, 5000), (3.0, 800)])
def test_likelihood_reaches_the_bound(device, rng, sigma, peak):
    places, frame = trials(rng, sigma, peak)
    readout = LineReadout(method="ml", threshold=BACKGROUND, window=16, read_noise=READ_NOISE, gain=1.0)
    bound = cramer_rao(sigma, peak, BACKGROUND, READ_NOISE, LENGTH, LENGTH // 2 + np.linspace(-0.5, 0.5, 41))
    # 4000 trials determine a standard deviation to 1.1 %.
    assert deviation(readout, frame, places, device) < 1.05 * bound


@pytest.mark.parametrize("method", ["centroid", "windowed", "ml"])
@pytest.mark.parametrize("share", [0.1, 0.25])
def test_ambient_light_on_one_side_of_a_line_shifts_it_by_its_share_of_the_sigma(device, method, share):
    """Light of 1 and 3 % of the peak shifts the mean over the phases by 0.9 to 1.24 times this share of sigma."""
    peak, sigma, row = 200.0, 1.4, np.arange(LENGTH)[:, None]
    places = LENGTH // 2 + np.linspace(0.0, 1.0, 64, endpoint=False)
    line = peak * np.exp(-0.5 * ((row - places) / sigma) ** 2)
    readout = LineReadout(method=method, threshold=share * peak)
    for part in (0.01, 0.03):
        ambient = part * peak * np.clip(row - places + 0.5, 0.0, 1.0)
        frames = np.stack([line + ambient, line]).astype(np.float32)
        lit, dark = readout(frames, device=device).position
        assert 0.9 * part < np.mean(lit - dark) / sigma < 1.24 * part


@pytest.mark.parametrize(
    # The window follows the sigma, and each window takes another kernel.
    ("sigma", "peak"),
    [pytest.param(*each, marks=pytest.mark.slow if each[0] != 1.0 else []) for each in FIGURES],
)
def test_classical_methods(device, rng, sigma, peak):
    places, frame = trials(rng, sigma, peak)
    methods = (
        {"method": "centroid"},
        {"method": "windowed", "window": int(np.ceil(2.5 * sigma))},
        {"method": "gauss3", "window": 4},
        {"method": "fir", "window": 6},
        {"method": "fir", "window": 8, "fir_length": 8},
    )
    for method, figure in zip(methods, FIGURES[sigma, peak], strict=True):
        measured = deviation(LineReadout(threshold=BACKGROUND, **method), frame, places, device)
        # Figure and measurement are based on 4000 trials each; outliers of three-point fits add uncertainty.
        assert measured == pytest.approx(figure, rel=0.08), method


@pytest.mark.parametrize(
    ("sigma", "windowed", "gauss3", "four_taps"),
    [pytest.param(0.5, 0.0023, 0.0053, 0.0117, marks=pytest.mark.slow), (1.0, 0.0046, 0.0001, 0.018)],
)
def test_bias_without_noise(device, sigma, windowed, gauss3, four_taps):
    places = LENGTH // 2 + np.linspace(-0.5, 0.5, 201)
    frame = pixel_gaussian(np.arange(LENGTH)[:, None], places, sigma, 2000.0, 0.0).astype(np.float32)
    window = int(np.ceil(2.5 * sigma))
    for method, bias in (
        ({"method": "windowed", "window": window}, windowed),
        ({"method": "gauss3", "window": 4}, gauss3),
        ({"method": "fir", "window": 6}, four_taps),
    ):
        reading = LineReadout(**method)(frame, device=device)
        assert np.max(np.abs(reading.position - places)) < 1.15 * bias + 1e-4
    fit = LineReadout(method="ml", window=16, read_noise=1.0)(frame, device=device)
    assert np.max(np.abs(fit.position - places)) < 1e-4


# ---- steps of the likelihood fit -------------------------------------------------------------------------------

# A wrong step costs the fit more steps, or the other fit repeats it: the positions stay.
STEPS = """
#include "common/real.h"
typedef struct {
    real read_variance, gain, noise_variance, lit_variance;
} LineTable;
#include "line/line_ml.h"

#define NUMBERS 45
#define WINDOW (2 * RADIUS + 1)
static inline int put(real *to, Gaussian from) {
    to[0] = from.position, to[1] = from.sigma, to[2] = from.amplitude, to[3] = from.background;
    return 4;
}

kernel void fit_steps(global const CODE *profiles, global const real *starts, global real *made,
                      constant LineTable *table, const CODE saturation) {
    const size_t n = get_global_id(0);
    CODE window[WINDOW], level = 0;
    real samples[WINDOW], out[NUMBERS];
    for (int k = 0; k < WINDOW; k++) {
        window[k] = profiles[n * WINDOW + k];
        samples[k] = window[k];
        level = max(level, window[k]);
    }
    const Gaussian start = {starts[4 * n], starts[4 * n + 1], starts[4 * n + 2], starts[4 * n + 3]};
    const SampleNoise noise = {table->read_variance, table->gain, saturation};
    int to = 0;
    for (int second = 0; second < 2; second++) {
        Gaussian next = start;
        const PointSums sums = point_sums(samples, &next, noise, second);
        const PointStep step = point_step(&next, &sums, second);
        to += put(out + to, next);
        out[to++] = step.move;
        out[to++] = step.change;
    }
    Normal normal = normal_equations(window, start, saturation, table->read_variance, table);
    for (int k = 0; k < 10; k++) out[to++] = normal.matrix[k];
    for (int k = 0; k < 4; k++) out[to++] = normal.right[k];
    Normal copy = normal;
    out[to++] = position_variance(&copy);
    Gaussian moved = start;
    out[to++] = take_step(&moved, &normal);
    to += put(out + to, moved);
    for (int by_variance = 0; by_variance < 2; by_variance++) {
        to += put(out + to, first_guess(samples, level, by_variance));
    }
    Gaussian fitted = start;
    out[to++] = fit_points(samples, &fitted, -1, noise);
    to += put(out + to, fitted);
    for (int k = 0; k < NUMBERS; k++) made[n * NUMBERS + k] = out[k];
}
"""
FIT_RADIUS, FIT_NOISE, FIT_GAIN = 12, 4.0, 0.3  # half window [px], variance of a dark sample, variance per grey level


def fitted_steps(
    device: Device, folder: Path, profiles: np.ndarray, starts: np.ndarray, saturation: int
) -> dict[str, np.ndarray]:
    """Return the numbers of the kernel `STEPS` by name, for profiles (n, 25) and starts (n, 4)."""
    (folder / "fit_steps.cl").write_text(STEPS)
    codes = {f"CODE{lanes}": f"uchar{lanes}" for lanes in (4, 8, 16)}
    sizes = {"CODE_BITS": 8, "RADIUS": FIT_RADIUS, "REACH": FIT_RADIUS}
    defines = {"CODE": "uchar", **codes, **sizes, "METHOD_ML": None, "NOISE": None, "REAL_IS_DOUBLE": None}
    program = build(device, folder, "fit_steps.cl", defines, include_folders=(KERNEL_FOLDER,))
    made = np.zeros((len(profiles), 45))
    table = np.array([FIT_NOISE, FIT_GAIN, FIT_NOISE + 1.0 / 12.0, 0.0])
    arrays = [cl.array.to_device(device.queue, each) for each in (profiles, starts, made, table)]
    data = (each.data for each in arrays)
    cl.Kernel(program, "fit_steps")(device.queue, (len(profiles),), None, *data, np.uint8(saturation))
    names = {
        "fisher": 6, "newton": 6, "matrix": 10, "right": 4, "variance": 1, "moved": 1, "step": 4, "peak": 4, "light": 4,
        "settled": 1, "fitted": 4,
    }  # fmt: skip
    ends = np.cumsum(list(names.values()))
    assert ends[-1] <= 47
    return dict(zip(names, np.split(arrays[2].get()[:, : ends[-1]], ends[:-1], axis=1), strict=True))


def sampled_gaussian(unknowns: np.ndarray) -> np.ndarray:
    """Return the light at the middles of the pixels of position, log(sigma), amplitude and background."""
    place, log_sigma, amplitude, background = unknowns
    z = (np.arange(-FIT_RADIUS, FIT_RADIUS + 1) - place) / np.exp(log_sigma)
    return np.asarray(background + amplitude * np.exp(-0.5 * z * z))


def integrated_gaussian(unknowns: np.ndarray) -> np.ndarray:
    """Return the light of the pixels of position, log(sigma), log(amplitude) and background."""
    place, log_sigma, log_amplitude, background = unknowns
    k = np.arange(-FIT_RADIUS, FIT_RADIUS + 1)
    return pixel_gaussian(k, place, np.exp(log_sigma), np.exp(log_amplitude), background)


def slopes_of(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: float) -> np.ndarray:
    """Return the derivatives of a function by each unknown, by central differences."""
    moves = step * np.eye(len(at))
    return np.stack([(function(at + move) - function(at - move)) / (2.0 * step) for move in moves], axis=-1)


def gradient_of(unknowns: np.ndarray, y: np.ndarray, saturation: int) -> np.ndarray:
    """Return the sum of the weighted residuals times the slopes of the model, which is 0 at the fit."""
    place, log_sigma, amplitude, background = unknowns
    z = (np.arange(-FIT_RADIUS, FIT_RADIUS + 1) - place) / np.exp(log_sigma)
    g = np.exp(-0.5 * z * z)
    slopes = [amplitude * g * z / np.exp(log_sigma), amplitude * g * z * z, g, np.ones_like(g)]
    model = background + amplitude * g
    weight = np.where(y >= saturation, 0.0, 1.0 / (FIT_NOISE + FIT_GAIN * np.maximum(model, 0.0)))
    return np.asarray(np.array(slopes) @ (weight * (y - model)))


@pytest.mark.double
def test_steps_of_the_likelihood_fit(device, rng, tmp_path):
    """Each step against numerical derivatives: by Fisher scoring, by Newton's method, and of the integrated model."""
    count, saturation = 40, 140
    truth = np.stack(
        [rng.uniform(low, high, count) for low, high in ((-0.9, 0.9), (1.75, 4.0), (60, 150), (8, 20))], -1
    )
    starts = truth * rng.uniform(0.93, 1.07, truth.shape) + [0.15, 0.0, 3.0, -1.0]
    k = np.arange(-FIT_RADIUS, FIT_RADIUS + 1)
    light = np.array([pixel_gaussian(k, *each) for each in truth])
    profiles = np.rint(light + rng.normal(0.0, 3.0, light.shape)).astype(np.uint8)
    assert np.any(profiles >= saturation)
    found = fitted_steps(device, tmp_path, profiles, starts, saturation)
    for number, (start, codes) in enumerate(zip(starts, profiles, strict=True)):
        y = codes.astype(np.float64)
        at = np.array([start[0], math.log(start[1]), *start[2:]])
        model, slopes = sampled_gaussian(at), slopes_of(sampled_gaussian, at, 1e-5)
        weight = np.where(y >= saturation, 0.0, 1.0 / (FIT_NOISE + FIT_GAIN * model))
        gradient = slopes.T @ (weight * (y - model))
        matrices = {
            "fisher": slopes.T @ (weight[:, None] * slopes),
            "newton": -slopes_of(lambda each, y=y: gradient_of(each, y, saturation), at, 1e-5),
        }
        for name, matrix in matrices.items():
            step = np.linalg.solve(matrix, gradient)
            factor = 1.0 + step[1] * (1.0 + 0.5 * step[1])
            change = abs(step[0] / start[1]) + abs(step[1]) + abs(step[2] / start[2])
            next_ = [
                start[0] + step[0],
                start[1] * factor,
                start[2] + step[2],
                start[3] + step[3],
                abs(step[0]),
                change,
            ]
            # Differences over 1e-5 have errors of about 1e-9; the series of the exponential of about 1e-10.
            np.testing.assert_allclose(found[name][number], next_, rtol=1e-6, atol=1e-6)
        at = np.array([start[0], math.log(start[1]), math.log(start[2]), start[3]])
        model = integrated_gaussian(at)
        # The unknown of the background is in units of the amplitude.
        slopes = slopes_of(integrated_gaussian, at, 1e-5) * [1.0, 1.0, 1.0, start[2]]
        weight = np.where(y >= saturation, 0.0, 1.0 / (FIT_NOISE + FIT_GAIN * model))
        matrix, right = slopes.T @ (weight[:, None] * slopes), slopes.T @ (weight * (y - model))
        # The error function of the kernel has errors of 1.5e-7.
        size = np.sqrt(np.diag(matrix))
        lower = np.tril_indices(4)
        np.testing.assert_allclose(
            found["matrix"][number] / np.outer(size, size)[lower],
            (matrix / np.outer(size, size))[lower],
            rtol=0,
            atol=1e-5,
        )
        np.testing.assert_allclose(
            found["right"][number] / size, right / size, rtol=0, atol=1e-5 * np.abs(y - model).max()
        )
        damped = matrix + 1e-4 * np.diag(np.diag(matrix))
        assert found["variance"][number, 0] == pytest.approx(np.linalg.inv(damped)[0, 0], rel=1e-4)
        step = np.linalg.solve(damped, right)
        assert np.all(np.abs(step[:3]) < 0.5)
        next_ = [
            start[0] + step[0],
            start[1] * np.exp(step[1]),
            start[2] * (1.0 + step[2]),
            start[3] + start[2] * step[3],
        ]
        np.testing.assert_allclose(found["step"][number], next_, rtol=1e-4, atol=1e-4)
        moved = max(abs(step[0]), abs(step[1]) * next_[1])
        assert found["moved"][number, 0] == pytest.approx(moved, rel=1e-3, abs=1e-5)
        # The fit is where the gradient is 0; in the end its sigma is that of the integrated model.
        position, sigma, amplitude, background = found["fitted"][number]
        sampled = math.hypot(sigma, math.sqrt(1.0 / 12.0))
        fit = np.array([position, math.log(sampled), amplitude * sigma / sampled, background])
        rest = np.linalg.solve(
            slopes_of(lambda each, y=y: gradient_of(each, y, saturation), fit, 1e-5), gradient_of(fit, y, saturation)
        )
        # The fit ends at an estimated error of 5e-5 px; with this noise the next step was up to 1.7e-4 px.
        assert abs(rest[0]) < 3e-4
    np.testing.assert_array_equal(found["settled"], -1.0)


@pytest.mark.double
def test_starts_of_the_likelihood_fit(device, rng, tmp_path):
    """Start values by the constants of a Gaussian above a quarter of its peak, derived here; limits of the fast fit."""
    truth = np.array([(0.3, 2.0, 150.0, 20.0), (-0.6, 3.0, 120.0, 10.0), (0.1, 0.5, 200.0, 30.0)])
    k = np.arange(-FIT_RADIUS, FIT_RADIUS + 1)
    profiles = np.rint([pixel_gaussian(k, *each) for each in truth]).astype(np.uint8)
    found = fitted_steps(device, tmp_path, profiles, truth, 255)
    c = math.sqrt(2.0 * math.log(4.0))
    light = math.sqrt(2.0 * math.pi) * math.erf(c / math.sqrt(2.0)) - c / 2.0
    share = 1.0 - c**3 / (6.0 * light)
    for number, codes in enumerate(profiles):
        y = codes.astype(np.float64)
        background = (y[0] + y[-1]) / 2.0
        height = y.max() - background
        v = np.maximum(y - background - height / 4.0, 0.0)
        place = v @ k / v.sum()
        by_variance = max(math.sqrt((v @ (k * k) / v.sum() - place**2) / share), 0.3)
        by_peak = max(v.sum() / (height * light), 0.3)
        of_light = v.sum() / (by_variance * light)
        np.testing.assert_allclose(found["peak"][number], [place, by_peak, height, background], rtol=1e-4, atol=1e-12)
        np.testing.assert_allclose(
            found["light"][number], [place, by_variance, of_light, background], rtol=1e-4, atol=1e-12
        )
    # The fast fit takes sigmas from 1.626 to 12 px, and positions up to 1.5 px from the peak, of lines that are bright.
    line = np.array((1.4, 1.8, 100.0, 10.0))
    profile = np.rint(pixel_gaussian(k, *line)).astype(np.uint8)
    starts = {
        (1.4, 1.8, 100.0, 10.0): -1, (1.4, 1.63, 100.0, 10.0): -1, (1.4, 1.62, 100.0, 10.0): 0,
        (1.49, 1.8, 100.0, 10.0): -1, (1.51, 1.8, 100.0, 10.0): 0, (-1.51, 1.8, 100.0, 10.0): 0,
        (1.4, 12.1, 100.0, 10.0): 0, (1.4, 1.8, -1.0, 10.0): 0,
    }  # fmt: skip
    found = fitted_steps(device, tmp_path, np.tile(profile, (len(starts), 1)), np.array(list(starts)), 255)
    np.testing.assert_array_equal(found["settled"][:, 0], list(starts.values()))


# ---- predicted standard deviations -----------------------------------------------------------------------------

PHASES = (-0.4, -0.2, 0.05, 0.3)  # of the line in its pixel: noise without the bias that depends on the phase
METHODS = (
    {"method": "centroid"},
    {"method": "windowed", "window": 8},
    {"method": "gauss3", "window": 4},
    {"method": "fir", "window": 8},
    {"method": "fir", "window": 8, "fir_length": 8},
    {"method": "ml", "window": 8},
)


def digitised(rng, trials, *, sigma, peak, background, read_noise, gain):
    """Return uint8 frames of lines at each phase, `trials` columns of each: shot noise, read noise, quantisation."""
    places = LENGTH // 2 + np.repeat(PHASES, trials)
    light = pixel_gaussian(np.arange(LENGTH)[:, None], places, sigma, peak, background)
    shot = rng.poisson(light / gain) * gain if gain else light
    return np.clip(np.rint(shot + rng.normal(0.0, read_noise, light.shape)), 0, 255).astype(np.uint8)


def scatter_ratio(reading):
    """Return the standard deviation of the positions within a phase, over the predicted one."""
    assert np.mean(reading.status == 0) > 0.999
    position, sigma = (each.reshape(len(PHASES), -1).astype(np.float64) for each in (reading.position, reading.sigma))
    return float(np.sqrt(np.mean(np.var(position, axis=1)) / np.mean(sigma**2)))


@pytest.mark.parametrize("method", METHODS, ids=lambda each: "-".join(map(str, each.values())))
def test_sigma_is_the_scatter(device, rng, method, draws):
    # Four phases of 1000 trials determine a standard deviation to 1.1 %, of 2000 trials to 0.8 %.
    count = draws(1000, 2000)
    for line in (
        {"sigma": 1.0, "peak": 150.0, "background": 10.0, "read_noise": 1.5, "gain": 0.1},
        {"sigma": 2.0, "peak": 150.0, "background": 10.0, "read_noise": 1.5, "gain": 0.1},
        {"sigma": 2.0, "peak": 150.0, "background": 10.0, "read_noise": 1.5, "gain": 0.0},
        {"sigma": 2.0, "peak": 60.0, "background": 10.0, "read_noise": 3.0, "gain": 0.1},
    ):
        if method["method"] == "gauss3" and line["sigma"] > 1.0:
            continue  # a parabola through the three samples of a flat peak is not linear in their noise
        noise = {name: line[name] for name in ("read_noise", "gain")}
        readout = LineReadout(threshold=24, outputs=("position", "sigma", "status"), **noise, **method)
        frame = digitised(rng, count, **line)
        reading = readout(frame, device=device)
        assert scatter_ratio(reading) == pytest.approx(1.0, abs=0.05)
        if method["method"] == "ml":
            continue  # compared with the Cramer-Rao bound below
        settings = {"saturation": 255.0, "threshold": 24.0, "quantised": True, **noise, **method}
        # At a whole position the slope of the zero crossing of a filter is not the same on both sides.
        between = np.flatnonzero(np.abs(reading.position - np.rint(reading.position)) > 1e-3)
        columns = between[:: len(between) // 8]
        expected = [position_sigma(frame[:, column].astype(np.float64), **settings) for column in columns]
        # The derivatives of the reference are differences over 1e-5 of the peak.
        np.testing.assert_allclose(reading.sigma[columns], expected, rtol=1e-3)


@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_sigma_of_the_fit_is_continuous_in_the_width(device, variant):
    """Lines below and above 1.6 px are fitted by different models; both have the Cramer-Rao bound of the window."""
    places = np.linspace(-0.45, 0.45, 32)
    noise = {"read_noise": READ_NOISE, "gain": 1.0}
    readout = LineReadout(method="ml", window=8, variant=variant, outputs=("position", "sigma"), **noise)
    for sigma in (1.59, 1.61, 2.5):
        light = pixel_gaussian(np.arange(LENGTH)[:, None], LENGTH // 2 + places, sigma, 2000.0, BACKGROUND)
        reading = readout(light.astype(np.float32), device=device)
        bounds = [cramer_rao(sigma, 2000.0, BACKGROUND, READ_NOISE, 17, [8 + place]) for place in places]
        np.testing.assert_allclose(reading.sigma, bounds, rtol=1.5e-3)


@pytest.mark.parametrize(
    ("method", "dtype", "along", "variant"),
    [
        ("centroid", "uint8", "columns", "vector"),
        ("centroid", "float32", "rows", "vector"),
        ("windowed", "uint16", "columns", "vector"),
        ("centroid", "float32", "columns", "work_item"),
        ("fir", "float32", "rows", "work_item"),
        pytest.param("centroid", "uint16", "columns", "vector", marks=pytest.mark.slow),
        pytest.param("centroid", "uint8", "rows", "vector", marks=pytest.mark.slow),
        pytest.param("centroid", "uint8", "columns", "work_item", marks=pytest.mark.slow),
        pytest.param("windowed", "float32", "columns", "vector", marks=pytest.mark.slow),
        pytest.param("windowed", "uint8", "rows", "work_item", marks=pytest.mark.slow),
        pytest.param("gauss3", "uint16", "columns", "vector", marks=pytest.mark.slow),
        pytest.param("gauss3", "float32", "rows", "work_item", marks=pytest.mark.slow),
    ],
)
def test_sigma_is_the_effect_of_every_sample(device, rng, method, dtype, along, variant):
    top = {"uint8": 200.0, "uint16": 50_000.0, "float32": 3.0}[dtype]
    length, samples = 83, 80
    places = length / 2 + 0.4 * length * np.sin(0.1 * np.arange(samples)) + rng.uniform(-0.5, 0.5, samples)
    profiles = pixel_gaussian(np.arange(length)[:, None], places, 1.7, top * rng.uniform(0.3, 1.0, samples), 0.05 * top)
    profiles += rng.normal(0.0, 0.003 * top, profiles.shape)
    profiles[60, 20] += 0.15 * top  # a hot pixel far from the line counts for the centroid
    profiles = np.clip(np.rint(profiles) if dtype != "float32" else profiles, 0, None).astype(dtype)
    frame = np.ascontiguousarray(profiles if along == "columns" else profiles.T)
    settings = {"method": method, "read_noise": 0.01 * top, "gain": 0.002 * top, "threshold": round(0.1 * top, 1)}
    readout = LineReadout(
        along=along, variant=variant, window=7, speckle=0.002, outputs=("sigma", "position", "status"), **settings
    )
    reading = readout(frame, device=device)
    np.testing.assert_array_equal(np.isnan(reading.sigma), np.isnan(reading.position))
    good = np.flatnonzero(reading.status == 0)
    assert good.size > 0.6 * samples
    quantised = dtype != "float32"
    settings |= {"saturation": np.inf, "window": 7}
    chosen = [profiles[:, i].astype(np.float64) for i in good[::4]]
    expected = [np.hypot(position_sigma(each, quantised=quantised, **settings), 0.002) for each in chosen]
    np.testing.assert_allclose(reading.sigma[good[::4]], expected, rtol=2e-3)
    positions = [read_profile(each, previous=np.nan, **settings)[0] for each in chosen]
    # Roundings of the position, and of the logarithms and quotients of a flat peak.
    np.testing.assert_allclose(reading.position[good[::4]], positions, rtol=4e-7, atol=1e-4)


def test_sigma_travels_to_the_sheet(device, rng):
    line = {"sigma": 2.0, "peak": 150.0, "background": 10.0, "read_noise": 1.5, "gain": 0.1}
    frame = digitised(rng, 50, **line)
    covariance = np.diag([1e-12, 2e-12, 3e-12, 4e-12, 5e-12, 6e-12, 1e-8, 2e-8])
    sheet = Triangulation(
        homography=((1.1e-5, 2.0e-4, -0.1), (-2.2e-4, 1.0e-6, 0.06), (2.0e-4, 1.0e-5, 1.0)),
        region=((0.0, LENGTH - 1.0), (0.0, frame.shape[1] - 1.0)),
        covariance=covariance,
    )
    axes = SampleAxes(position_origin=0.0, position_pitch=1.0, sample_origin=0.0, sample_pitch=1.0)
    wanted = ("position", "status", "g", "h", "sigma", "sigma_g", "sigma_h", "systematic_g", "systematic_h")
    readout = LineReadout(threshold=24, read_noise=1.5, gain=0.1, triangulation=sheet, axes=axes, outputs=wanted)
    reading = readout(frame, device=device)
    assert np.all(reading.status == 0)
    # Oracle: numerical derivatives of the homography in float64, and the sheet's covariance by NumPy.
    matrix = np.array(sheet.homography)
    v = np.arange(frame.shape[1], dtype=np.float64)

    def points(u):
        lifted = matrix @ np.stack([u, v, np.ones_like(u)])
        return lifted[:2] / lifted[2]

    u = reading.position.astype(np.float64)
    slopes = np.abs(points(u + 1e-4) - points(u - 1e-4)) / 2e-4
    np.testing.assert_allclose([reading.sigma_g, reading.sigma_h], slopes * reading.sigma, rtol=1e-4)
    of_parameters = sheet.covariance_at(np.stack([u, v], axis=-1))
    expected = np.sqrt([of_parameters[:, 0, 0], of_parameters[:, 1, 1]])
    np.testing.assert_allclose([reading.systematic_g, reading.systematic_h], expected, rtol=1e-4)


def test_sigma_is_unknown_without_an_estimate(device):
    profile = np.zeros((24, 16), np.uint8)
    profile[11:14] = 100
    profile[:, 8:] = 0  # dark
    frame = profile.copy()
    frame[2:22, :4] = 100  # flat top wider than the window
    reading = LineReadout(window=6, threshold=20, outputs=("position", "sigma", "status"))(frame, device=device)
    assert np.all(np.isfinite(reading.position[:8]))
    assert np.all(np.isnan(reading.sigma[:4]))
    assert np.all(np.isfinite(reading.sigma[4:8]))
    assert np.all(np.isnan(reading.sigma[8:]))
