"""Placements by the error model without images: noise, errors that frames have in common, landing, and aborts."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.rehearsal import rehearse_placements, start_zone

PRESET = dataclasses.replace(read_machine("look_while_place"), axes=(Axis(), Axis(), Axis()))
TARGET = np.array([10e-3, 8e-3, 0.3])
VISION = np.diag([0.3e-6, 0.2e-6, 0.1e-3]) ** 2


def machine(control: Control, **tolerance: float) -> Machine:
    limits = dataclasses.replace(PRESET.tolerance, **({"position": 3e-6, "angle": 1e-3} | tolerance))
    return dataclasses.replace(PRESET, control=control, tolerance=limits)


def plan(*, fixed_pattern: float = 0.0, sampling: float = 0.0, landing: Any = None) -> Any:
    return SimpleNamespace(
        target=TARGET,
        landing=landing,
        vision=VISION,
        fixed_pattern=fixed_pattern,
        sampling=sampling * VISION,
        reported=VISION,
    )


@pytest.mark.parametrize(("fixed_pattern", "sampling"), [(0.0, 0.0), (0.0, 3.0), (0.75, 0.0)])
def test_one_step_has_the_error_of_one_pose(fixed_pattern: float, sampling: float) -> None:
    """The Smith predictor of gain 1 steers by the first pose, and the second frame releases."""
    steered = machine(Control(observer="smith", gain=1.0))
    found = rehearse_placements(steered, plan(fixed_pattern=fixed_pattern, sampling=sampling), count=300)
    np.testing.assert_allclose(found.seconds, steered.delay.latency + steered.period)
    # 300 draws determine a standard deviation to 4 %.
    np.testing.assert_allclose(np.std(found.error, axis=0), np.sqrt((1.0 + sampling) * np.diag(VISION)), rtol=0.16)
    np.testing.assert_allclose(np.mean(found.error, axis=0) / np.sqrt(np.diag(VISION)), 0.0, atol=0.25 * (1 + sampling))


def test_a_slow_loop_averages_noise_but_no_common_error() -> None:
    """A gain of 0.1 without delay leaves 0.1 / 1.9 of the variance of the noise (`noise_gain`)."""
    steered = machine(Control(observer="smith", gain=0.1), position=1e-6, angle=0.3e-3, landing_zone=20e-6)
    noise = rehearse_placements(steered, plan(), count=150).error
    common = rehearse_placements(steered, plan(fixed_pattern=0.75), count=150).error
    rest = np.array([0.2e-6, 0.2e-6, 0.06e-3])  # of the step response, at most
    for found, part in ((noise, 0.1 / 1.9), (common, 0.75 + 0.25 * 0.1 / 1.9)):
        sigmas = np.sqrt(part * np.diag(VISION))
        assert np.all(np.std(found, axis=0) > 0.8 * sigmas)
        assert np.all(np.std(found, axis=0) < 1.25 * np.hypot(sigmas, rest))


def test_the_head_rests_during_the_coarse_registration() -> None:
    steered = machine(Control(observer="smith", gain=1.0))
    with_landing = rehearse_placements(steered, plan(landing="registration"), count=5)
    np.testing.assert_allclose(with_landing.seconds, steered.delay.latency + steered.landing + steered.period)
    assert steered.landing == 20e-3


def test_the_lead_belongs_to_the_time() -> None:
    steered = machine(Control(observer="smith", gain=1.0))
    settling = dataclasses.replace(steered.settling, lead=7e-3)
    found = rehearse_placements(dataclasses.replace(steered, settling=settling), plan(), count=2)
    np.testing.assert_allclose(found.seconds, steered.delay.latency + steered.period + 7e-3)


def test_a_part_that_is_not_released_has_no_error_and_no_time() -> None:
    found = rehearse_placements(machine(Control(gain=0.01), max_time=10e-3), plan(), count=3)
    assert np.all(np.isnan(found.error))
    assert np.all(np.isnan(found.seconds))


def test_seeds_differ() -> None:
    steered = machine(Control(gain=0.2))
    first, same, other = (rehearse_placements(steered, plan(), count=3, seed=seed) for seed in (4, 4, 5))
    np.testing.assert_array_equal(first.error, same.error)
    assert np.all(first.error != other.error)


def test_start_errors_and_vibration_fill_the_landing_zone() -> None:
    np.testing.assert_allclose(start_zone(PRESET), [90e-6, 90e-6, 4.5e-3])
    axis = Axis(resonance=600.0)
    swinging = dataclasses.replace(PRESET, axes=(axis, Axis(), Axis()), swing=(40e-6, 0.0, 0.0))
    np.testing.assert_allclose(start_zone(swinging), [50e-6, 90e-6, 4.5e-3])
    with pytest.raises(ValueError, match=r"swing is \(9e-05, 0\.0, 0\.0\), expected less than 0\.9 of the landing"):
        start_zone(dataclasses.replace(swinging, swing=(90e-6, 0.0, 0.0)))
