"""Ranges of numbers: for each parameter the last accepted and the first refused value of its documented range."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from gpuvision.camera.detection_stage import DetectionStage
from gpuvision.camera.photons import image_irradiance, irradiance_from_lux, photons_per_joule
from gpuvision.camera.sensor_readout import SensorReadout
from gpuvision.inspection.paste import PasteSettings
from gpuvision.matching.pose.edge_search import CellMeans
from gpuvision.servoing.axis import Axis, FineStage
from gpuvision.servoing.controllers import (
    PidController,
    PidGains,
    SmithPredictor,
    gains_without_oscillation,
    simc_gains,
)
from gpuvision.servoing.delay import DelayBudget, continuous_gains, delay_taps, phase_loss
from gpuvision.servoing.delay_measurement import excitation
from gpuvision.servoing.delay_response import jitter_moments, normal_delays, settling_frames, step_response
from gpuvision.servoing.guard import LoopLimits
from gpuvision.servoing.margins import margins, observer_tolerance, predictor_tolerance
from gpuvision.servoing.observer import MotionModel, PoseObserver
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.workflows.inspecting_paste import ScaleSigma, VolumeLimits

TINY = 5e-324
# Kinds of ranges: accepted and refused values.
POSITIVE: tuple[list[Any], list[Any]] = [0.125], [0.0, -TINY, math.nan, math.inf]
NOT_NEGATIVE: tuple[list[Any], list[Any]] = [0.0, 0.125], [-TINY, math.nan, math.inf]
SHARE: tuple[list[Any], list[Any]] = [0.125, 1.0], [0.0, -TINY, math.nextafter(1.0, 2.0)]
WATCHDOG: tuple[list[Any], list[Any]] = [0.125, math.inf], [0.0, math.nan]
GAINS = PidGains(proportional=1.0)
SWINGING = (Axis(resonance=10.0), Axis(resonance=10.0), Axis(resonance=10.0))


def count(least: int, most: int | None = None) -> tuple[list[Any], list[Any]]:
    """Return the values of a number of items."""
    return [least] if most is None else [least, most], [least - 1, *([] if most is None else [most + 1])]


def parts(kind: tuple[list[Any], list[Any]], base: float = 0.5) -> tuple[list[Any], list[Any]]:
    """Return triples, of which one number is at the end of the range, each number once."""
    accepted, refused = ([
        tuple(value if k == place else base for k in range(3)) for value in values for place in range(3)
    ] for values in kind)  # fmt: skip
    return accepted, [*refused, (base, base)]


def field(example: Any, name: str) -> Callable[[Any], Any]:
    return lambda value: replace(example, **{name: value})


READOUT, STAGE = SensorReadout(pixel_clock=40e6), DetectionStage(pixel=1e-5, extent=0.01, uncertainty=1e-3)
LIMITS, AXIS, FINE, BUDGET = LoopLimits(), Axis(), FineStage(lag=0.01, stroke=1e-3), DelayBudget(period=0.01)
PASTE, MODEL = PasteSettings(stencil=1e-4), MotionModel()
FIELDS: list[tuple[Any, str, tuple[list[Any], list[Any]]]] = [
    (READOUT, "pixel_clock", POSITIVE),
    (READOUT, "row_overhead", NOT_NEGATIVE),
    (READOUT, "frame_overhead", NOT_NEGATIVE),
    (READOUT, "taps", count(1)),
    (READOUT, "buffers", count(0)),
    (STAGE, "pixel", POSITIVE),
    (STAGE, "extent", POSITIVE),
    (STAGE, "uncertainty", NOT_NEGATIVE),
    (STAGE, "speed", NOT_NEGATIVE),
    (STAGE, "features", count(1)),
    (CellMeans(cell_px=4), "cell_px", count(1, 64)),
    (PASTE, "stencil", POSITIVE),
    (PASTE, "threshold", POSITIVE),
    (PASTE, "margin", NOT_NEGATIVE),
    (PASTE, "ring", POSITIVE),
    (PASTE, "least_reference", count(7)),
    (PASTE, "least_valid", SHARE),
    (ScaleSigma(height=0.0, lateral=0.0), "height", NOT_NEGATIVE),
    (ScaleSigma(height=0.0, lateral=0.0), "lateral", NOT_NEGATIVE),
    (VolumeLimits(), "minimum", ([0.0, 1.25], [-TINY])),
    (VolumeLimits(), "maximum", ([0.625], [0.5])),
    (BUDGET, "period", POSITIVE),
    (BUDGET, "exposure", NOT_NEGATIVE),
    (BUDGET, "readout", NOT_NEGATIVE),
    (BUDGET, "transfer", NOT_NEGATIVE),
    (GAINS, "proportional", POSITIVE),
    (GAINS, "derivative", NOT_NEGATIVE),
    (AXIS, "lag", NOT_NEGATIVE),
    (AXIS, "resonance", NOT_NEGATIVE),
    (AXIS, "encoder", NOT_NEGATIVE),
    (AXIS, "damping", ([0.0, 1.0], [-TINY, math.nextafter(1.0, 2.0)])),
    (AXIS, "speed", ([TINY, math.inf], [0.0])),
    (Axis(lag=0.1), "acceleration", ([TINY, math.inf], [0.0])),
    (Axis(lag=0.1), "viscous", NOT_NEGATIVE),
    (Axis(lag=0.1), "coulomb", NOT_NEGATIVE),
    (Axis(viscous=0.5, lag=0.1), "lag", ([0.125], [0.0])),
    (FINE, "lag", POSITIVE),
    (FINE, "stroke", POSITIVE),
    (FINE, "recentring", NOT_NEGATIVE),
    (LIMITS, "hold_after", ([TINY, 0.1], [0.0])),
    (LIMITS, "abort_after", ([0.01], [math.nextafter(0.01, 0.0)])),
    (LIMITS, "margin_sigmas", NOT_NEGATIVE),
    (LIMITS, "overshoot", parts(NOT_NEGATIVE)),
    (LIMITS, "lag", parts(NOT_NEGATIVE)),
    (LIMITS, "watchdog", WATCHDOG),
    (LIMITS, "encoder_error", parts(([TINY, math.inf], [0.0]))),
    (LIMITS, "gated", count(1)),
    (LIMITS, "readings", count(1)),
    (LIMITS, "missed", count(1)),
    (MODEL, "lag", parts(NOT_NEGATIVE)),
    (MODEL, "acceleration_noise", parts(NOT_NEGATIVE)),
    (MODEL, "position_noise", parts(NOT_NEGATIVE)),
]
CALLS: list[tuple[str, Callable[[Any], Any], tuple[list[Any], list[Any]]]] = [
    ("stage of a budget", lambda v: replace(BUDGET, stages={"pose": v}), NOT_NEGATIVE),
    ("f_number", lambda v: image_irradiance(1.0, v), POSITIVE),
    ("magnification", lambda v: image_irradiance(1.0, 4.0, magnification=v), NOT_NEGATIVE),
    ("transmission", lambda v: image_irradiance(1.0, 4.0, transmission=v), SHARE),
    ("irradiance", lambda v: image_irradiance(v, 4.0), NOT_NEGATIVE),
    ("illuminance", lambda v: irradiance_from_lux(v, 555e-9), NOT_NEGATIVE),
    ("wavelength of a lux", lambda v: irradiance_from_lux(1.0, v), ([555e-9], [0.0, -TINY])),
    ("wavelength of a photon", photons_per_joule, POSITIVE),
    ("feed_forward", lambda v: PidController(GAINS, feed_forward=v), ([0.0, 1.0], [-TINY, math.nextafter(1.0, 2.0)])),
    ("limit of velocities", lambda v: PidController(GAINS, limit=v), parts(([TINY, math.inf], [0.0]))),
    ("delay of the Smith predictor", SmithPredictor, NOT_NEGATIVE),
    ("plant_gain", lambda v: SmithPredictor(0.1, plant_gain=v), POSITIVE),
    ("period of a gain", lambda v: gains_without_oscillation(0.1, v), POSITIVE),
    ("delay of SIMC", simc_gains, POSITIVE),
    ("lag of SIMC", lambda v: simc_gains(0.1, lag=v), NOT_NEGATIVE),
    ("closed_loop", lambda v: simc_gains(0.1, closed_loop=v), POSITIVE),
    ("delay of taps", delay_taps, NOT_NEGATIVE),
    ("delay of continuous gains", continuous_gains, POSITIVE),
    ("delay of a phase", lambda v: phase_loss(1.0, v), NOT_NEGATIVE),
    ("speed of an excitation", lambda v: excitation(8, v), POSITIVE),
    ("count of an excitation", lambda v: excitation(v, 1.0), count(1)),
    ("hold of an excitation", lambda v: excitation(8, 1.0, hold=v), count(1)),
    ("frames of a response", lambda v: step_response(1.0, 0.2, v), count(1)),
    ("tolerance of settling", lambda v: settling_frames(1.0, 0.2, v), SHARE),
    ("probabilities", lambda v: jitter_moments([1.0, 2.0, 3.0], v),
     ([[0.0, 0.0, 1.0], [0.25, 0.25, 0.5]], [[-TINY, 0.0, 1.0], [0.25, 0.25, 0.25], [0.5, 0.5]])),
    ("mean of normal delays", lambda v: normal_delays(v, 0.1), NOT_NEGATIVE),
    ("sigma of normal delays", lambda v: normal_delays(1.0, v), NOT_NEGATIVE),
    ("period of margins", lambda v: margins(GAINS, 0.01, v), ([0.01], [0.0, -TINY])),
    ("lag of margins", lambda v: margins(GAINS, 0.01, 0.01, lag=v), NOT_NEGATIVE),
    ("gain of a predictor", lambda v: predictor_tolerance(v, 1.0), ([0.5], [0.0, math.nextafter(2.0, 3.0)])),
    ("gain of an observer", lambda v: observer_tolerance(v, 1.0), ([0.5], [0.0, math.nextafter(2.0, 3.0)])),
    ("gate", lambda v: PoseObserver(MODEL, gate=v), POSITIVE),
    ("history of an observer", lambda v: PoseObserver(MODEL, history=v), count(2)),
    ("history of a plant", lambda v: SimulatedPlant(history=v), count(2)),
    ("watchdog of a plant", lambda v: SimulatedPlant(watchdog=v), WATCHDOG),
    ("start of a plant", lambda v: SimulatedPlant(start=v), ([(0.0, 1.0, 2.0)], [(0.0, 1.0), (0.0, 1.0, math.nan)])),
    ("swing", lambda v: SimulatedPlant(swing=v), ([(0.0, 0.0, 0.0)], [(0.0, 0.0), (1e-3, 0.0, 0.0)])),
    ("swing of a resonance", lambda v: SimulatedPlant(SWINGING, swing=v),
     ([(1e-3, 0.0, -1e-3)], [(0.0, math.nan, 0.0)])),
]  # fmt: skip


@pytest.mark.parametrize(("example", "name", "values"), FIELDS, ids=[f"{type(e).__name__}.{n}" for e, n, _ in FIELDS])
def test_range_of_a_field(example: Any, name: str, values: tuple[list[Any], list[Any]]) -> None:
    check(field(example, name), values, name)


@pytest.mark.parametrize(("name", "make", "values"), CALLS, ids=[name for name, _, _ in CALLS])
def test_range_of_an_argument(name: str, make: Callable[[Any], Any], values: tuple[list[Any], list[Any]]) -> None:
    check(make, values, name)


def check(make: Callable[[Any], Any], values: tuple[list[Any], list[Any]], name: str) -> None:
    for value in values[0]:
        make(value)
    for value in values[1]:
        with pytest.raises((ValueError, TypeError)) as caught:
            make(value)
        message = str(caught.value)
        assert "\n" not in message
        assert any(word.split("_")[0] in message.lower() for word in name.split(" of ")), message


def test_swing_of_a_plant_is_its_start() -> None:
    """At time 0 the head is away from the axes by the swing."""
    plant = SimulatedPlant(SWINGING, start=(1.0, 2.0, 3.0), swing=(1e-3, 0.0, -2e-3))
    assert plant.pose(0.0) == pytest.approx([1.001, 2.0, 2.998])
