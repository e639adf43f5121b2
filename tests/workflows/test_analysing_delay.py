"""Report of the command `delay`: each number against the function or formula that it stands for."""

from __future__ import annotations

import math
from importlib.metadata import version
from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.controllers import PidGains, gains_without_oscillation, simc_gains
from gpuvision.servoing.delay import DelayBudget, gain_limit
from gpuvision.servoing.delay_measurement import MeasuredDelay
from gpuvision.servoing.delay_response import jitter_gain_limit, normal_delays, settling_frames
from gpuvision.servoing.margins import margins, observer_tolerance, predictor_tolerance
from gpuvision.workflows.analysing_delay import DelayAnalysis

PERIOD, JITTER = 0.01, 0.002
# Half an exposure, readout, transfer and a stage: 28 ms.
BUDGET = DelayBudget(period=PERIOD, exposure=0.006, readout=0.01, transfer=0.008, stages={"pose": 0.007})


def measured(**changes: Any) -> MeasuredDelay:
    values = {"mean": 0.03, "mean_sigma": 1e-4, "jitter": 3e-3, "jitter_sigma": 2e-4, "scale": 1.02, "noise": 4e-6}
    return MeasuredDelay(**{**values, "frames": 3.0, "delays": np.zeros(0), **changes})


def analysis(**changes: Any) -> DelayAnalysis:
    return DelayAnalysis(**{"budget": BUDGET, "measured": None, "recording": None, "jitter": JITTER, **changes})


def rule(gains: PidGains, delay: float) -> dict[str, Any]:
    """Return the entry of a rule."""
    found = margins(gains, delay, PERIOD)
    return {
        "proportional_per_s": gains.proportional,
        "integral_s": gains.integral if math.isfinite(gains.integral) else None,
        "gain_margin": found.gain,
        "phase_margin_rad": found.phase,
        "delay_margin_s": found.delay,
        "modulus_margin": found.modulus,
        "crossover_Hz": found.crossover,
    }


def tolerances(found: Any, frames: float) -> dict[str, Any]:
    """Return the numbers that Smith predictor and observer have in common."""
    return {
        "unstable_from_shorter_by_s": found.shorter * PERIOD if found.shorter < frames else None,
        "unstable_from_longer_by_s": found.longer * PERIOD,
        "unstable_from_plant_gain": found.plant_gain,
    }


@pytest.mark.parametrize("delay", [0.028, 0.03])
def test_report(delay: float) -> None:
    found = measured() if delay == 0.03 else None
    report = analysis(measured=found).report()
    frames, total = delay / PERIOD, delay + PERIOD / 2.0
    best = gains_without_oscillation(delay, PERIOD)
    expected = {
        "gpuvision": version("gpuvision"),
        "period_s": PERIOD,
        "parts_s": {"half exposure": 0.003, "readout": 0.01, "transfer": 0.008, "stage pose": 0.007, "half hold": 5e-3},
        "delay_s": delay,
        "delay_frames": frames,
        "total_delay_s": total,
        "jitter_s": JITTER,
        "limit_per_frame": gain_limit(frames),
        "limit_with_jitter_per_frame": jitter_gain_limit(*normal_delays(frames, JITTER / PERIOD)),
        "non_oscillating_per_frame": best.proportional * PERIOD,
        "settling_frames_to_1_percent": settling_frames(frames, best.proportional * PERIOD, 0.01),
        # Franklin, Powell and Emami-Naeini: the limits of an integrator with a delay are pi / 2 and 1 / e over it.
        "continuous_limit_per_s": 0.5 * math.pi / total,
        "continuous_critical_per_s": math.exp(-1.0) / total,
        "rules": {
            "non_oscillating": rule(best, delay),
            "simc_p": rule(simc_gains(total, integral=False), delay),
            "simc_pi": rule(simc_gains(total), delay),
        },
        "predictor": [
            {"gain_per_frame": gain, **tolerances(predictor_tolerance(gain, frames), frames)}
            for gain in (0.2, 0.5, 0.8)
        ],
        "observer": [
            {
                "gain_per_frame": gain,
                "noise_ratio": 1.0,
                "unstable_from_lag_s": observer_tolerance(gain, frames, noise_ratio=1.0).lag * PERIOD,
                **tolerances(observer_tolerance(gain, frames, noise_ratio=1.0), frames),
            }
            for gain in (0.2, 0.5, 0.8)
        ],
    }
    if found is not None:
        expected["measured"] = {
            "mean_s": 0.03,
            "mean_sigma_s": 1e-4,
            "jitter_s": 3e-3,
            "jitter_sigma_s": 2e-4,
            "scale": 1.02,
            "noise": 4e-6,
            "beyond_the_budget_s": pytest.approx(0.002),
        }
    assert set(report) == set(expected)
    for key, value in expected.items():
        compare(report[key], value)


def compare(found: Any, expected: Any) -> None:
    """Compare trees; numbers to rounding, infinity as None."""
    if isinstance(expected, dict):
        assert set(found) == set(expected)
        for key, value in expected.items():
            compare(found[key], value)
    elif isinstance(expected, list):
        for one, other in zip(found, expected, strict=True):
            compare(one, other)
    elif isinstance(expected, float) and not math.isfinite(expected):
        assert found is None
    else:
        assert found == (pytest.approx(expected, rel=1e-9) if isinstance(expected, float) else expected)


def test_without_jitter_the_limit_is_the_same() -> None:
    report = analysis(jitter=0.0).report()
    assert report["limit_with_jitter_per_frame"] == report["limit_per_frame"]
    assert "measured" not in report


def test_summary() -> None:
    best = gains_without_oscillation(0.028, PERIOD).proportional
    assert analysis().summary() == (
        f"delay 28 ms = 2.8 frames of 10 ms: unstable from {gain_limit(2.8) / PERIOD:.4g} /s on, no oscillation up to "
        f"{best:.4g} /s ({best / (2.0 * math.pi):.3g} Hz)"
    )


def test_warnings() -> None:
    assert analysis().warnings == analysis(measured=measured()).warnings == ()
    assert analysis(measured=measured(scale=1.19)).warnings == ()
    assert len(analysis(measured=measured(scale=0.79)).warnings) == 1
    (text,) = analysis(measured=measured(scale=1.21)).warnings
    assert text.startswith("the measured motion is 1.21 times the commanded motion")
    # 0.03 s are 2.6 samples of 11.54 ms, but frames of 10 ms.
    (text,) = analysis(measured=measured(frames=2.6)).warnings
    assert text.startswith("the samples of the recording are 11.54 ms apart, the frames 10 ms")
    assert analysis(measured=measured(frames=2.8)).warnings == analysis(measured=measured(frames=0.0)).warnings == ()
    (text,) = analysis(measured=measured(converged=False)).warnings
    assert text.startswith("the fit of the delay stopped before it converged")
    (text,) = analysis(budget=DelayBudget(period=PERIOD)).warnings
    assert text.startswith("the delay is 0")
    assert analysis(budget=DelayBudget(period=PERIOD, exposure=PERIOD)).warnings == ()
    (text,) = analysis(budget=DelayBudget(period=PERIOD, exposure=0.02)).warnings
    assert text == "the exposure of 20 ms is longer than a frame of 10 ms; check exposure and frame rate"
