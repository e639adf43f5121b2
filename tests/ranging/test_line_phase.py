"""Error of the line position by its phase in the pixel: against readings of lines without noise, and of noisy ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import METHODS
from gpuvision.ranging.line_phase import LineShape, estimate_line_shape, phase_error
from gpuvision.reference.line import read_lines


def line(rows: Any, sigma: float, amplitude: Any, background: float) -> np.ndarray:
    """Return a frame (64, profiles) of Gaussian lines without noise."""
    return background + amplitude * np.exp(-0.5 * ((np.arange(64.0)[:, None] - rows) / sigma) ** 2)


@pytest.mark.parametrize(
    ("sigma", "amplitude", "background", "threshold"),
    [(1.4, 150.0, 8.0, 46.0), (2.5, 60.0, 100.0, 130.0), (0.9, 200.0, 0.0, 5.0), (1.4, 150.0, 0.0, 0.01)],
)
def test_the_shape_of_the_line_is_found(
    sigma: float, amplitude: float, background: float, threshold: float, rng: np.random.Generator
) -> None:
    rows = rng.uniform(25.0, 38.0, 300)
    reading = read_lines(line(rows, sigma, amplitude, background), threshold=threshold, window=20)
    shape = estimate_line_shape(reading["peak"], reading["width"], reading["total"], threshold)
    assert shape is not None
    assert shape.sigma == pytest.approx(sigma, rel=0.05)
    assert shape.background == pytest.approx(background, abs=0.06 * amplitude)


def test_two_surfaces_and_no_line(rng: np.random.Generator) -> None:
    """A quarter of the profiles is dark paste: the shape is that of the brighter surface's line."""
    amplitude = np.where(np.arange(400) % 4 == 0, 60.0, 180.0)
    reading = read_lines(line(rng.uniform(25.0, 38.0, 400), 1.6, amplitude, 10.0), threshold=40.0)
    shape = estimate_line_shape(reading["peak"], reading["width"], reading["total"], 40.0)
    assert shape == pytest.approx((1.6, 10.0), rel=0.1, abs=5.0)
    assert estimate_line_shape([10.0, np.nan], [0, 0], [0.0, 0.0], 40.0) is None
    assert phase_error(LineReadout(), LineShape(1.4, 0.0), [np.nan]) is None


@pytest.mark.parametrize(
    "method", [pytest.param(name, marks=[] if name == "windowed" else pytest.mark.slow) for name in METHODS]
)
@pytest.mark.parametrize("along", ["columns", "rows"])
def test_the_error_is_that_of_readings_without_noise(device: Device, method: Any, along: Any) -> None:
    """Root mean square over the phases, of the float64 reference of the readout."""
    settings: dict[str, Any] = {"method": method, "threshold": 46.0, "window": 8}
    readout = LineReadout(along=along, **settings)
    peaks = np.linspace(80.0, 200.0, 25).reshape(5, 5)
    shape = LineShape(1.4, 8.0)
    error = phase_error(readout, shape, peaks, device)
    assert error is not None
    assert error.shape == peaks.shape
    rows = 30.0 + np.arange(97) / 97.0
    for row, column in ((0, 1), (2, 2), (4, 3)):
        bright = line(rows, 1.4, 1.0, 0.0).max(axis=0).mean()
        read = read_lines(line(rows, 1.4, (peaks[row, column] - 8.0) / bright, 8.0), **settings)["position"]
        expected = np.sqrt(np.mean((read - rows) ** 2))
        assert error[row, column] == pytest.approx(expected, rel=0.1, abs=1e-3)


@pytest.mark.parametrize(("sigma", "amplitude", "threshold"), [(1.4, 150.0, 46.0), (1.0, 200.0, 60.0)])
def test_noise_and_phase_scatter_the_positions(
    device: Device, sigma: float, amplitude: float, threshold: float, rng: np.random.Generator
) -> None:
    """Lines at all phases: the error is noise and phase together, and far more than the noise alone."""
    rows = rng.uniform(28.0, 35.0, 4000)
    noisy = line(rows, sigma, amplitude, 8.0) + rng.normal(0.0, 1.5, (64, rows.size))
    readout = LineReadout(
        threshold=threshold, read_noise=1.5, outputs=("position", "sigma", "peak", "width", "total", "status")
    )
    reading = readout(np.rint(noisy).astype(np.uint8), device=device)
    shape = estimate_line_shape(reading.peak, reading.width, reading.total, threshold)
    assert shape is not None
    phase = phase_error(readout, shape, reading.peak, device)
    assert phase is not None
    error = reading.position - rows
    assert np.sqrt(np.mean((error / reading.sigma) ** 2)) > 1.25
    assert np.sqrt(np.mean(error**2 / (reading.sigma**2 + phase**2))) == pytest.approx(1.0, abs=0.1)
