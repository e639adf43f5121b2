"""CMOS sensor: photon budget, noise against random draws, coarse pixels, frame times of simulated shutters."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.detection_stage import DetectionStage
from gpuvision.camera.photons import image_irradiance, irradiance_from_lux, luminous_efficiency
from gpuvision.camera.sensor_readout import SensorReadout

READOUT = SensorReadout(pixel_clock=10e6, taps=4, row_overhead=2e-6, frame_overhead=50e-6)
SENSOR = CmosSensor(
    rows=100,
    columns=130,
    pitch=5e-6,
    quantum_efficiency=0.5,
    gain=0.2,
    dark_noise=9.0,
    full_well=12e3,
    bits=12,
    dark_level=64.0,
    dsnu=4.0,
    prnu=0.01,
    dark_current=2000.0,
    readout=READOUT,
)


def test_efficiency_is_that_of_the_cie_table() -> None:
    table = {
        405: 0.0006,
        450: 0.038,
        500: 0.323,
        510: 0.503,
        555: 1.0,
        589: 0.7690,
        610: 0.503,
        650: 0.107,
        700: 0.0041,
    }
    for nm, efficiency in table.items():
        assert luminous_efficiency(nm * 1e-9) == pytest.approx(efficiency, abs=0.01)
    assert irradiance_from_lux(683.0, 555e-9) == pytest.approx(1.0, rel=0.005)
    with pytest.raises(ValueError, match="850 nm is not visible"):
        irradiance_from_lux(1.0, 850e-9)


@pytest.mark.parametrize(("nanometres", "efficiency"), [(450.0, 0.038), (507.0, 0.444), (555.0, 1.0), (620.0, 0.381)])
def test_irradiance_of_light_that_the_eye_sees(nanometres: float, efficiency: float) -> None:
    """1000 lx of one wavelength; the efficiencies are the CIE's, which the two Gaussians meet to 0.01."""
    irradiance = irradiance_from_lux(1000.0, nanometres * 1e-9)
    assert 1000.0 / 683.0 / irradiance == pytest.approx(efficiency, abs=0.01)
    assert irradiance_from_lux(250.0, nanometres * 1e-9) == pytest.approx(irradiance / 4.0)


def test_electrons_are_those_of_the_energy_of_photons() -> None:
    """A photon of 500 nm has 2.4797 eV; 1 eV is 1.602177e-19 J."""
    sensor = replace(SENSOR, wavelength=500e-9)
    energy = 3.0 * 25e-12 * 2e-3
    assert sensor.photons(3.0, 2e-3) == pytest.approx(energy / (2.479684 * 1.602177e-19), rel=1e-6)
    assert sensor.electrons([3.0, 6.0], 2e-3) == pytest.approx(sensor.photons(3.0, 2e-3) * np.array([0.5, 1.0]))


def test_light_of_a_lens_is_that_of_the_cone() -> None:
    """Far object: radiance E / pi over the solid angle of the aperture, small for a large f-number."""
    assert image_irradiance(100.0, 20.0) == pytest.approx(100.0 / math.pi * math.pi / 4 / 20.0**2)
    assert image_irradiance(100.0, 4.0, magnification=1.0, transmission=0.9) == pytest.approx(100.0 * 0.9 / 256.0)


@pytest.mark.parametrize("electrons", [0.0, 50.0, 6000.0])
def test_noise_and_level_are_those_of_random_pixels(rng: np.random.Generator, electrons: float) -> None:
    """Poisson electrons of pixels with own gains and offsets, in whole grey levels."""
    exposure, count = 0.05, 100_000
    gains, offsets = 1.0 + SENSOR.prnu * rng.standard_normal(count), SENSOR.dsnu * rng.standard_normal(count)

    def frame() -> np.ndarray:
        collected = rng.poisson(electrons * gains + 2000.0 * exposure)
        return np.rint(64.0 + 0.2 * (collected + offsets + 9.0 * rng.standard_normal(count)))

    first, second = frame(), frame()
    assert first.mean() == pytest.approx(float(SENSOR.level(electrons, exposure)), abs=0.15)
    assert first.std() / 0.2 == pytest.approx(float(SENSOR.noise(electrons, exposure)), rel=0.01)
    temporal = (first - second).std() / math.sqrt(2.0) / 0.2
    assert temporal == pytest.approx(float(SENSOR.noise(electrons, exposure, spatial=False)), rel=0.01)
    assert float(SENSOR.snr(electrons, exposure)) == pytest.approx(electrons / float(SENSOR.noise(electrons, exposure)))


@pytest.mark.parametrize("mean", [0.0, 600.0])
def test_coarse_pixels_add_signal_or_leave_it_out(rng: np.random.Generator, mean: float) -> None:
    coarse, exposure = SENSOR.binned(3), 0.05
    assert (coarse.rows, coarse.columns, coarse.pitch) == (33, 43, pytest.approx(15e-6))
    assert coarse.electrons(2.0, exposure) == pytest.approx(9 * SENSOR.electrons(2.0, exposure))
    count = 50_000
    gains, offsets = 1.0 + 0.01 * rng.standard_normal((count, 9)), 4.0 * rng.standard_normal((count, 9))
    charge = (rng.poisson(mean * gains + 2000.0 * exposure) + offsets).sum(axis=1) + 9.0 * rng.standard_normal(count)
    quantised = np.rint(0.2 * charge) / 0.2
    assert quantised.std() == pytest.approx(float(coarse.noise(9 * mean, exposure)), rel=0.015)
    skipped = SENSOR.skipping(3)
    assert skipped.electrons(2.0, exposure) == pytest.approx(SENSOR.electrons(2.0, exposure))
    assert skipped.shape == coarse.shape


@pytest.mark.parametrize(("factor", "rows", "columns"), [(1, 100, 130), (3, 33, 43), (130, 1, 1)])
def test_parameters_of_coarse_pixels(factor: int, rows: int, columns: int) -> None:
    """Charge adds up; independent offsets and gains average out; a pixel that is skipped collects no light."""
    size = {"rows": rows, "columns": columns, "pitch": pytest.approx(factor * 5e-6)}
    binned = {
        "full_well": factor**2 * 12e3,
        "dark_current": factor**2 * 2e3,
        "dsnu": factor * 4.0,
        "prnu": 0.01 / factor,
    }
    for found, changed in (
        (SENSOR.binned(factor), {name: pytest.approx(value) for name, value in binned.items()}),
        (SENSOR.skipping(factor), {"collecting": pytest.approx(1.0 / factor**2)}),
    ):
        assert asdict(found) == asdict(SENSOR) | size | changed
    for made in (SENSOR.binned, SENSOR.skipping):
        with pytest.raises(ValueError, match="factor is 0, expected at least 1"):
            made(0)


def test_saturation_is_the_full_well_or_the_largest_level() -> None:
    assert SENSOR.saturation == 12e3
    assert replace(SENSOR, bits=11).saturation == pytest.approx((2047 - 64) / 0.2)
    bent = replace(SENSOR, bits=11, nonlinearity=0.1)
    assert float(bent.level(bent.saturation)) == pytest.approx(2047.0)
    # n (1 - 0.1 n / 12 000) = 9915
    assert bent.saturation == pytest.approx((1.0 - math.sqrt(1.0 - 0.4 * 9915.0 / 12e3)) * 12e3 / 0.2, rel=1e-12)
    assert replace(SENSOR, nonlinearity=0.1).saturation == 12e3
    # At the full well the response is 12 000 (1 - 0.1) = 10 800 electrons: 2160 levels above the dark level.
    for level, expected in ((4095.0 - 2161.0, 12e3), (4095.0 - 2160.0, 12e3), (4095.0 - 2159.0, 11_993.76)):
        found = replace(SENSOR, nonlinearity=0.1, dark_level=level)
        assert found.saturation == pytest.approx(expected, rel=1e-6)
    assert float(bent.level(1e9)) == 2047.0
    # The slope of a bent response magnifies the noise behind it.
    assert float(bent.noise(8000.0) ** 2 - 8000.0 - 80.0**2) == pytest.approx(
        (SENSOR.read_noise**2 + 16.0) / (1 - 0.2 * 8000.0 / 12e3) ** 2
    )


def simulated(
    readout: SensorReadout, shape: tuple[int, int], exposure: float, flash: bool
) -> tuple[float, float, float]:
    """Return period, skew and delay by the times at which rows open, close and are read, for the second of two frames.

    Rows are read one after the other; a row that is read opens again at once, if the shutter allows it.
    """
    row_time = math.ceil(shape[1] / readout.taps) / readout.pixel_clock + readout.row_overhead
    index = np.arange(shape[0])
    if readout.shutter == "rolling" and not flash:
        frame = max(exposure, shape[0] * row_time + readout.frame_overhead)
        close = frame + index * row_time
        middle = (close - exposure / 2).mean()
        return frame, float(np.ptp(close)), float(close[-1] + row_time + readout.frame_overhead - middle)
    # All rows see the light from `lit` to `dark`; then they are read.
    dark = exposure
    end_of_reading = dark + shape[0] * row_time + readout.frame_overhead
    if readout.shutter == "rolling" or not readout.overlaps:
        next_lit = end_of_reading
    else:
        next_lit = max(end_of_reading - exposure, exposure)
    return next_lit, 0.0, end_of_reading - exposure / 2


@pytest.mark.parametrize("flash", [False, True])
@pytest.mark.parametrize("exposure", [0.1e-3, 20e-3])
@pytest.mark.parametrize(
    "readout",
    [READOUT, replace(READOUT, overlaps=False), replace(READOUT, shutter="rolling")],
    ids=["overlapping", "alternating", "rolling"],
)
def test_frame_times_are_those_of_the_shutter(readout: SensorReadout, exposure: float, flash: bool) -> None:
    shape = (40, 66)
    found = replace(SENSOR, readout=readout).timing(shape, exposure, flash=flash)
    assert found.row_time == pytest.approx(17 / 10e6 + 2e-6)
    assert found.readout == pytest.approx(40 * found.row_time + 50e-6)
    assert (found.period, found.skew, found.delay) == pytest.approx(simulated(readout, shape, exposure, flash))
    assert found.rate == pytest.approx(1.0 / found.period)
    buffered = replace(SENSOR, readout=replace(readout, buffers=2)).timing(shape, exposure, flash=flash)
    assert buffered.delay == pytest.approx(found.delay + 2 * found.period)


def test_direct_read_pixels_have_their_response_for_an_exposure() -> None:
    sensor = replace(SENSOR, pixel="direct_read", response_time=30e-6)
    assert sensor.electrons(1.0, 0.0) == pytest.approx(SENSOR.electrons(1.0, 30e-6))
    timing = sensor.timing((40, 66))
    assert timing == SensorReadout.timing(replace(READOUT, shutter="rolling"), (40, 66), 30e-6)
    assert sensor.frame_time() == pytest.approx(100 * (33 / 10e6 + 2e-6) + 50e-6)
    assert sensor.motion_blur(0.5, 1.0, 10e-6) == pytest.approx(1.5)
    assert SENSOR.motion_blur(0.5, 100e-6, 10e-6) == pytest.approx(5.0)


def test_a_stage_needs_least_bandwidth_at_its_best_rate() -> None:
    stage = DetectionStage(pixel=10e-6, extent=0.4e-3, uncertainty=50e-6, speed=0.2, features=3)
    rates = np.linspace(0.2, 5.0, 400) * stage.best_rate
    bandwidths = [stage.pixel_bandwidth(rate) for rate in rates]
    assert min(bandwidths) == pytest.approx(stage.minimum_pixel_bandwidth, rel=1e-3)
    assert rates[int(np.argmin(bandwidths))] == pytest.approx(stage.best_rate, rel=0.02)
    # Side at 1 kHz: 0.4 mm, 2 x 50 um, and 0.2 mm each way.
    assert stage.side_px(1000.0) == pytest.approx(90.0)
    assert stage.pixel_bandwidth(1000.0) == pytest.approx(3 * 8100 * 1000.0)
    assert replace(stage, speed=0.0).minimum_pixel_bandwidth == 0.0


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"rows": 0}, ValueError, "rows"),
        ({"bits": 17}, ValueError, "bits"),
        ({"pitch": 0.0}, ValueError, "pitch"),
        ({"dark_noise": -1.0}, ValueError, "dark_noise"),
        ({"quantum_efficiency": 1.1}, ValueError, "quantum_efficiency"),
        ({"nonlinearity": 0.5}, ValueError, "nonlinearity"),
        ({"dark_level": 4095.0}, ValueError, "dark_level"),
        ({"pixel": "active"}, ValueError, "pixel"),
        ({"pixel": "direct_read"}, ValueError, "response_time"),
        ({"response_time": 1e-6}, ValueError, "response_time"),
        ({"estimated": ("gains",)}, ValueError, "'gains'"),
        ({"gain": "1"}, TypeError, "gain"),
    ],
)
def test_wrong_sensors_are_refused(change: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        replace(SENSOR, **change)


def test_wrong_readouts_regions_and_stages_are_refused() -> None:
    for change in ({"pixel_clock": 0.0}, {"taps": 0}, {"row_overhead": -1.0}, {"buffers": -1}, {"shutter": "iris"}):
        with pytest.raises(ValueError, match=next(iter(change))):
            replace(READOUT, **change)
    with pytest.raises(TypeError, match="overlaps"):
        replace(READOUT, overlaps=1)
    with pytest.raises(ValueError, match="the sensor has 100 x 130"):
        SENSOR.timing((101, 5), 1e-3)
    with pytest.raises(ValueError, match="give the exposure"):
        SENSOR.timing()
    stage = DetectionStage(pixel=10e-6, extent=0.4e-3, uncertainty=50e-6)
    for name, value in (("pixel", 0.0), ("extent", 0.0), ("uncertainty", -1.0), ("speed", -1.0), ("features", 0)):
        with pytest.raises(ValueError, match=name):
            replace(stage, **{name: value})
