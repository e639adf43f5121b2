"""Smith predictor with axes of different lags: each axis has its limit, response, noise and tolerance."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains
from gpuvision.servoing.loop import ServoLoop, SimulatedClock
from gpuvision.servoing.placement.budget import model_tolerance, noise_covariance
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import make_observer, place_part, predicted_frames, predicted_settling
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PRESET = read_machine("look_while_place")
COVARIANCE = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.7], [0.5, -0.7, 2.0]]) * 1e-14
SMITH = Control(observer="smith")


def _axes(*lags: float) -> Any:
    return tuple(Axis(lag=1e-3 * lag) for lag in lags)


def _machine(control: Control, *lags: float) -> Machine:
    return dataclasses.replace(PRESET, control=control, axes=_axes(*lags))


def _sensor(machine: Machine, plant: SimulatedPlant) -> SimulatedPoseSensor:
    return SimulatedPoseSensor(
        plant.pose, period=machine.period, delay=machine.delay.latency, covariance=COVARIANCE, is_noisy=False
    )


def _errors(machine: Machine, frames: int, gain: float | None = None) -> np.ndarray:
    """Return the true errors (frames, 3) of a loop without guards from errors of 1; the gain replaces the machine's."""
    start = np.full(3, 50e-6)
    gains = machine.gains if gain is None else PidGains(proportional=gain * machine.rate)
    plant = SimulatedPlant(machine.axes, start=start)
    loop = ServoLoop(
        plant,
        _sensor(machine, plant),
        make_observer(machine, np.zeros(3), 0.0),
        PidController(gains),
        SimulatedClock(),
        period=machine.period,
        limits=None,
    )
    return plant.pose(loop.run(np.zeros(3), frames * machine.period).time) / start


@pytest.mark.parametrize(("lags", "gain"), [((0.3, 0.0, 0.0), 3.0), ((1.0, 0.0, 0.0), 2.3), ((0.3, 1.0, 0.3), 3.0)])
def test_the_axis_with_the_least_limit_limits_the_gain(lags: tuple[float, float, float], gain: float) -> None:
    """The limit is 2 without a lag, 3.80 at 0.3 frames and 2.39 at 1 frame."""
    least = 0.0 if 0.0 in lags else 1.0
    # The gain suits one of the lags.
    _machine(dataclasses.replace(SMITH, gain=gain), *[lags[0]] * 3)
    with pytest.raises(ValueError, match=rf"gain is {gain}, .* the limit of stability for a lag of {least:.2f} frames"):
        _machine(dataclasses.replace(SMITH, gain=gain), *lags)
    limit = 2.0 if least == 0.0 else 2.3922
    machine = _machine(dataclasses.replace(SMITH, gain=0.97 * limit), *lags)
    swings = {factor: np.abs(_errors(machine, 120, factor * limit)) for factor in (0.97, 1.03)}
    assert swings[0.97][-20:].max() < 0.5
    assert swings[1.03][-20:].max() > 2.0


def test_an_integral_part_is_checked_for_each_axis() -> None:
    control = Control(observer="smith", controller="pi", gain=2.4, integral=4e-3)
    _machine(control, 0.3, 0.3, 0.3)
    with pytest.raises(ValueError, match=r"is not stable with a lag of 0.00 frames"):
        _machine(control, 0.3, 0.3, 0.0)


@pytest.mark.parametrize(
    "control",
    [
        SMITH,
        dataclasses.replace(SMITH, gain=1.6),
        Control(observer="smith", controller="pi", gain=0.4, integral=10e-3),
        Control(observer="smith", controller="pid", gain=0.4, integral=10e-3, derivative=0.5e-3),
    ],
    ids=["p", "p-1.6", "pi", "pid"],
)
def test_each_axis_responds_as_by_theory(control: Control) -> None:
    machine = _machine(control, 0.3, 1.0, 0.0)
    found = _errors(machine, 200)
    np.testing.assert_allclose(found, machine.error_after(200), atol=1e-9)
    settled = np.array([np.flatnonzero(np.abs(each) > 0.02)[-1] + 1 for each in found.T])
    assert machine.frames_to(0.02) == settled.max()
    for axis in range(3):
        fractions = np.ones(3)
        fractions[axis] = 0.02
        assert machine.frames_to(fractions) == settled[axis]
        assert predicted_settling(machine, np.eye(3)[axis], np.full(3, 0.02)) == settled[axis]
    np.testing.assert_allclose(machine.overshoot, np.maximum(-found.min(axis=0), 0.0), atol=1e-9)
    angle = machine.tolerance.angle
    assert predicted_frames(machine, [0.0, 0.0, 10.0 * angle]) == np.flatnonzero(np.abs(found[:, 2]) > 0.02)[-1] + 1


def test_the_default_gain_oscillates_on_no_axis() -> None:
    for lags in ((0.3, 0.0, 0.0), (0.0, 1.0, 0.3)):
        machine = _machine(SMITH, *lags)
        assert machine.loop_gain == min(_machine(SMITH, each, each, each).loop_gain for each in lags)
        assert _errors(machine, 60).min() > -1e-12


@pytest.mark.parametrize("gain", [0.15, 1.7])
def test_noise_of_each_axis_and_between_axes_is_the_sum_over_the_impulse_responses(gain: float) -> None:
    machine = _machine(dataclasses.replace(SMITH, gain=gain), 0.3, 1.0, 0.0)
    impulse = -np.diff(_errors(machine, 300), axis=0)
    expected = np.einsum("ki,kj,ij->ij", impulse, impulse, COVARIANCE)
    found = noise_covariance(machine, COVARIANCE, COVARIANCE, 20)
    np.testing.assert_allclose(
        found / np.sqrt(np.outer(*[np.diag(expected)] * 2)),
        expected / np.sqrt(np.outer(*[np.diag(expected)] * 2)),
        atol=1e-8,
    )
    assert np.linalg.eigvalsh(found).min() > 0.0


@pytest.mark.parametrize(
    "control", [SMITH, Control(observer="kalman", motion_sigma=(60e-9,) * 3)], ids=["smith", "kalman"]
)
def test_the_least_tolerance_of_the_axes_counts(control: Control) -> None:
    plan: Any = SimpleNamespace(reported=np.eye(3) * (60e-9) ** 2)
    control = dataclasses.replace(control, gain=1.5)
    each = [model_tolerance(_machine(control, lag, lag, lag), plan) for lag in (0.3, 0.0)]
    found = model_tolerance(_machine(control, 0.3, 0.0, 0.0), plan)
    assert found is not None
    gains, delays = zip(*[one for one in each if one is not None], strict=True)
    assert found == (min(gains), min(delays))
    # The axis with a lag tolerates less gain, the axes without a lag tolerate less delay.
    assert gains[0] < 0.9 * gains[1]
    assert delays[1] < 0.9 * delays[0]


def test_a_part_is_placed_with_a_gain_near_the_least_limit() -> None:
    machine = _machine(dataclasses.replace(SMITH, gain=1.5), 0.3, 0.0, 0.0)
    plant = SimulatedPlant(machine.axes, start=(80e-6, -60e-6, 3e-3))
    placement = place_part(machine, np.zeros(3), plant, _sensor(machine, plant), SimulatedClock())
    assert placement.released
    rest = np.abs(plant.pose(placement.record.time[-1] + 20e-3))
    assert np.hypot(*rest[:2]) < machine.tolerance.position
    assert rest[2] < machine.tolerance.angle
