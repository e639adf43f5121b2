"""Noise of the line methods: the Cramer-Rao bound for the likelihood fit, published figures for the others.

A column of 41 pixels with 20 electrons of background and 10 electrons of read noise, the line near its middle.
"""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.ranging.line import LineReadout
from gpuvision.reference.line import cramer_rao, pixel_gaussian

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


@pytest.mark.parametrize(("sigma", "peak"), FIGURES)
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
    ("sigma", "windowed", "gauss3", "four_taps"), [(0.5, 0.0023, 0.0053, 0.0117), (1.0, 0.0046, 0.0001, 0.018)]
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
