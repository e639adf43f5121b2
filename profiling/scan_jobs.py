"""Random recordings with known truth for `gpuvision.profiling.scan_plans`: a laser line on a camera, spots on PSDs."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.psd import ELECTRON, PsdNoise
from gpuvision.reference.line import pixel_gaussian
from gpuvision.sensor.sensor import Sensor

Float64 = npt.NDArray[np.float64]

_FRAMES, _ROWS = 48, 64
_BACKGROUND = 5.0  # grey levels of 8 bits
_PSD_SHARE = 0.25  # of the jobs


class Job(NamedTuple):
    """Recording with known truth, and what is asked of its scan.

    Attributes
    ----------
    sensor : Sensor
        Sensor with the noise of the recording.
    frames : (frames, rows, columns) uint8 or uint16, or (frames, strips, 2) uint16
        Recording of a camera or a PSD.
    true : (frames, samples) float64
        True positions of the line [px] or the spots [m].
    tolerance : float
        Largest error of the heights, as a multiple of the smallest true one.
    rate : float
        Frame rate, as a fraction of the rate of the fastest stream.
    """

    sensor: Sensor
    frames: npt.NDArray[Any]
    true: Float64
    tolerance: float
    rate: float


def random_job(rng: np.random.Generator) -> Job:
    """Draw a sensor, a surface, light and noise, a tolerance and a rate."""
    sensor, frames, true = _psd(rng) if rng.random() < _PSD_SHARE else _camera(rng)
    return Job(sensor, frames, true, _spread(rng, 0.7, 6.0), _spread(rng, 0.03, 0.95))


def _spread(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number with an even logarithm."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _surface(rng: np.random.Generator, samples: int, reach: float) -> Float64:
    """Draw positions (frames, samples) up to a distance from the middle: flat or wavy, tilted or not.

    The profiles of half of the surfaces are equal, as those of a part that is straight along the transport.
    """
    along = np.linspace(-1.0, 1.0, samples)
    phase = rng.uniform(0.0, 6.0, (_FRAMES, 1) if rng.random() < 0.5 else (1, 1))
    wave = _spread(rng, 0.004, 0.7) * np.sin(rng.uniform(2.0, 12.0) * along + phase)
    tilt = rng.uniform(-0.3, 0.3) * along if rng.random() < 0.5 else 0.0
    return np.broadcast_to(reach * (wave + tilt), (_FRAMES, samples)).copy()


def _camera(rng: np.random.Generator) -> tuple[Sensor, npt.NDArray[Any], Float64]:
    """Draw a Gaussian line of sigma 1 to 4 px on a camera with 8 or 12 bits, with or without speckle."""
    sensor, columns = Sensor.load("camera_line"), int(rng.choice([160, 240, 480]))
    scale, dtype = (16.0, np.uint16) if rng.random() < 0.25 else (1.0, np.uint8)
    sigma, peak = rng.uniform(1.0, 4.0), _spread(rng, 40.0, 220.0)
    read_noise, gain = rng.uniform(0.5, 2.5), _spread(rng, 0.01, 0.2)
    speckle = rng.uniform(0.02, 0.2) if rng.random() < 0.25 else 0.0
    true = rng.uniform(29.0, 33.0) + _surface(rng, columns, 13.0)
    dim = 1.0 - rng.uniform(0.0, 0.5) * np.sin(np.arange(columns) / rng.uniform(10.0, 100.0)) ** 2  # of the reflectance
    place = true + speckle * rng.standard_normal(true.shape)
    line = pixel_gaussian(np.arange(_ROWS)[:, None], place[:, None, :], sigma, 1.0, 0.0)
    light = _BACKGROUND + peak * dim * line
    noisy = rng.poisson(light / gain) * gain + read_noise * rng.standard_normal(light.shape)
    given: Any = sensor.readout
    readout = dataclasses.replace(
        given,
        window=int(rng.choice([4, 8, 12])),
        threshold=math.ceil(scale * (_BACKGROUND + 4.0 * math.hypot(read_noise, math.sqrt(gain * _BACKGROUND)))),
        minimum_peak=None,
        ambiguity=None,
        saturation=255.0 * scale,
        read_noise=scale * read_noise,
        gain=scale * gain,
        speckle=speckle,
    )
    sensor = dataclasses.replace(sensor, readout=readout, frame=(_ROWS, columns), noise_known=True)
    return sensor, np.clip(np.rint(scale * noisy), 0.0, 255.0 * scale).astype(dtype), true


def _psd(rng: np.random.Generator) -> tuple[Sensor, npt.NDArray[Any], Float64]:
    """Draw spots on PSDs with the noise of amplifiers, of the strip resistance, and of the electrons."""
    sensor = Sensor.load("psd_line")
    given: Any = sensor.readout
    noise = dataclasses.replace(
        given.noise, independent=_spread(rng, 0.03e-9, 1e-9), opposed=_spread(rng, 0.01e-9, 1e-9)
    )
    readout = dataclasses.replace(given, noise=noise)
    true = rng.uniform(-0.4e-3, 0.4e-3) + _surface(rng, sensor.frame[0] if sensor.frame else 0, 2.2e-3)
    dim = 1.0 - rng.uniform(0.0, 0.5) * np.asarray(rng.random(true.shape[1]))
    currents = _currents(rng, true, _spread(rng, 150e-9, 3e-6) * dim, readout.strip_length, noise)
    codes = (currents + np.array(readout.dark)) / readout.ampere
    return dataclasses.replace(sensor, readout=readout), np.clip(np.rint(codes), 0, 65535).astype(np.uint16), true


def _currents(rng: np.random.Generator, true: Float64, total: Float64, length: float, noise: PsdNoise) -> Float64:
    """Return the currents of both electrodes (frames, strips, 2) [A], without the mean dark current.

    An electron at x leaves at the right electrode with the charge share ``1/2 + x / length``. Electrons of the spot lie
    about its centre, those of the dark current anywhere on the strip: of N electrons the right share has the variance
    ``N (1/4 + 1/12)``, the covariance with the left one is ``N (1/4 - 1/12)``.
    """
    electrons = 2.0 * ELECTRON * noise.bandwidth  # variance of a current over the current [A]
    light = total + np.sqrt(electrons * total) * rng.standard_normal(true.shape)
    centre = true + noise.spot * np.sqrt(electrons / total) * rng.standard_normal(true.shape)
    both = np.stack([light * (0.5 - centre / length), light * (0.5 + centre / length)], axis=-1)
    variance = electrons * noise.dark_current * np.array([[1.0 / 3.0, 1.0 / 6.0], [1.0 / 6.0, 1.0 / 3.0]])
    both += rng.standard_normal(both.shape) @ np.linalg.cholesky(variance + 1e-40 * np.eye(2)).T
    both += noise.independent * rng.standard_normal(both.shape)
    opposed = noise.opposed * rng.standard_normal(true.shape)
    return np.asarray(both + np.stack([-opposed, opposed], axis=-1), np.float64)
