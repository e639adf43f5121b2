from __future__ import annotations

import dataclasses
import math
from typing import Any, cast

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.delay import gain_limit
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.margins import observer_matrix
from gpuvision.servoing.placement.budget import model_tolerance, noise_covariance, noise_gain, predict_budget
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import ThermalDrift
from gpuvision.servoing.placement.placing import REMAINDER
from gpuvision.servoing.placement.plan import PlacementPlan

PRESET = read_machine("look_while_place")
# Measured poses scatter by the noise; the observer gets a covariance with the error of the sampling in addition.
NOISE, REPORTED, MOTION = (np.diag([each * 1e-6, each * 1e-6, each * 1e-3]) ** 2 for each in (0.1, 0.2, 0.05))
KALMAN = Control(observer="kalman", gain=1.0, motion_sigma=(0.05e-6, 0.05e-6, 0.05e-3))


def _plan() -> PlacementPlan:
    """Return a plan that has covariances only."""
    return PlacementPlan(
        target=np.zeros(3),
        camera_pose=np.zeros(3),
        features=cast(Any, None),
        landing=None,
        threshold=1.0,
        noise=1.0,
        vision=NOISE,
        fixed_pattern=0.0,
        sampling=np.zeros((3, 3)),
        reported=REPORTED,
        etch_bias=np.zeros((3, 3)),
    )


def test_noise_of_a_kalman_filter_follows_the_covariance_that_it_gets() -> None:
    machine = dataclasses.replace(PRESET, control=KALMAN)
    found = predict_budget(machine, _plan(), [300]).sources["vision"]
    # Random walk of variance q, measurements of variance r: the constant gain of the steady state, Riccati equation.
    q, r = np.diag(MOTION), np.diag(REPORTED)
    predicted = (q + np.sqrt(q**2 + 4.0 * q * r)) / 2.0
    gain = predicted / (predicted + r)
    np.testing.assert_allclose(np.diag(found), gain / (2.0 - gain) * np.diag(NOISE), rtol=1e-6)


def test_sources_of_the_error_add_up_on_a_turned_board() -> None:
    """Calibration and drift turn with the camera; the fixed pattern is not averaged over the frames."""
    rng = np.random.default_rng(2)
    vision, sampling, etch_bias, calibration = (
        scale * each @ each.T
        for scale, each in zip((1e-12, 3e-12, 5e-12, 7e-12), rng.normal(size=(4, 3, 3)), strict=True)
    )
    angle = 0.7
    plan = dataclasses.replace(
        _plan(),
        camera_pose=np.array([0.1, 0.2, angle]),
        vision=vision,
        fixed_pattern=0.3,
        sampling=sampling,
        etch_bias=etch_bias,
    )
    machine = dataclasses.replace(
        PRESET,
        pipette_in_camera=Transform.rigid("pipette", "camera", (1e-3, 2e-3, 0.1), calibration),
        drift=ThermalDrift(expansion=(1e-6, -2e-6), temperature_sigma=3.0),
        axes=(Axis(encoder=1e-7), Axis(encoder=2e-7), Axis(encoder=3e-5)),
        control=Control(gain=0.2),
    )
    budget = predict_budget(machine, plan)
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = turn @ (3.0 * np.array([1e-6, -2e-6, 0.0]))
    tolerance = machine.tolerance
    rest = 0.2 * np.array([tolerance.position, tolerance.position, tolerance.angle])
    steps = np.array([1e-7, 2e-7, 3e-5])
    # Evenly distributed errors: within plus and minus the rest, and within a step of the encoder.
    expected = {
        "calibration": turn @ calibration @ turn.T,
        "etch bias": etch_bias,
        "drift": np.outer(moved, moved),
        "vision": (0.7 * noise_gain(machine.delay.frames, 0.2) + 0.3) * vision,
        "sampling": sampling,
        "servo": np.diag(rest**2 / 3.0 + steps**2 / 12.0),
    }
    assert list(budget.sources) == list(expected)
    for name, covariance in expected.items():
        scale = np.abs(covariance).max()
        np.testing.assert_allclose(budget.sources[name], covariance, rtol=1e-9, atol=1e-9 * scale, err_msg=name)
    np.testing.assert_allclose(budget.total, sum(expected.values()), rtol=1e-9, atol=1e-20)
    np.testing.assert_allclose(budget.sigmas["total"] ** 2, np.diag(budget.total))


def test_a_kalman_filter_is_stable_up_to_the_tolerated_errors_of_its_model() -> None:
    machine = dataclasses.replace(PRESET, control=KALMAN)
    tolerated = model_tolerance(machine, _plan())
    assert tolerated is not None
    delay, ratio = machine.delay.frames, math.sqrt(MOTION[0, 0] / REPORTED[0, 0])
    longer = tolerated.longer_delay / machine.period
    for factor, is_stable in ((0.99, True), (1.01, False)):
        slow = observer_matrix(1.0, delay, noise_ratio=ratio, plant_delay=delay + factor * longer)
        fast = observer_matrix(1.0, delay, noise_ratio=ratio, plant_gain=1.0 + factor * (tolerated.plant_gain - 1.0))
        for matrix in (slow, fast):
            assert (np.abs(np.linalg.eigvals(matrix)).max() < 1.0) == is_stable


@pytest.mark.parametrize("frequency", [(150.0, 0.0, 0.0), (150.0, 120.0, 80.0)])
def test_servo_variance_is_that_of_swings_at_the_limit(frequency: tuple[float, float, float]) -> None:
    rule = Settling(rule="vibration", frequency=frequency, damping=(0.02,) * 3)
    tolerance = PRESET.tolerance
    found = predict_budget(dataclasses.replace(PRESET, settling=rule, axes=(Axis(),) * 3), _plan()).sources["servo"]
    rest = (REMAINDER * np.array([tolerance.position, tolerance.position, tolerance.angle])) ** 2 / 3.0
    # The largest amplitude leaves the distance, x and y together, and the angle at their limits.
    amplitude = np.sqrt(2.0 * (np.diag(found) - rest))
    assert np.hypot(*amplitude[:2]) == pytest.approx(tolerance.position)
    np.testing.assert_allclose(amplitude > 1e-12, np.array(frequency) > 0.0)
    if frequency[2]:
        assert amplitude[2] == pytest.approx(tolerance.angle)


@pytest.mark.parametrize("gain", [0.1, 0.5, 1.0])
def test_noise_of_a_loop_without_delay_has_a_closed_form(gain: float) -> None:
    # x[k+1] = (1 - gain) x[k] - gain noise: an autoregression of the first order.
    assert noise_gain(0.0, gain) == pytest.approx(gain / (2.0 - gain), rel=1e-12)


def test_noise_of_a_delayed_loop_agrees_with_its_simulation() -> None:
    delay, gain, runs = 1.4, 0.15, 4000
    noise = np.random.default_rng(1).standard_normal((200, runs))
    x = np.zeros((204, runs))
    for k in range(3, 203):
        seen = 0.6 * x[k - 1] + 0.4 * x[k - 2] + noise[k - 3]
        x[k + 1] = x[k] - gain * seen
    # Standard error of a variance of 4000 runs: 2.2 %; 40 frames that are far apart are averaged.
    measured = np.mean(x[100::3] ** 2)
    assert measured == pytest.approx(noise_gain(delay, gain), rel=0.03)


def test_more_delay_and_more_gain_give_more_noise() -> None:
    values = [noise_gain(delay, gain) for delay, gain in ((0.0, 0.1), (2.0, 0.1), (2.0, 0.3))]
    assert values == sorted(values)
    assert math.isfinite(values[-1])


@pytest.mark.parametrize("gain", [1e-8, 1e-4])
@pytest.mark.parametrize("delay", [0.0, 1.4, 6.0])
def test_noise_of_a_slow_loop_is_not_cut_off(delay: float, gain: float) -> None:
    # A slow loop is a first-order low-pass filter: half its gain, with corrections of the relative size gain * delay.
    assert noise_gain(delay, gain) == pytest.approx(gain / 2.0, rel=3.0 * gain * (1.0 + delay))


def test_noise_of_an_unstable_loop_is_refused() -> None:
    for gain in (0.62, 0.0):
        with pytest.raises(ValueError, match="not stable"):
            noise_gain(2.0, gain)


@pytest.mark.parametrize(("wait", "frames"), [(4e-3, 4), (4.2e-3, 5)])
def test_servo_variance_of_a_fixed_wait_is_the_rest_of_the_response(wait: float, frames: int) -> None:
    """A predictor leaves the loop without delay: the error of a frame is 0.6 of the one before."""
    control = Control(observer="smith", gain=0.4)
    machine = dataclasses.replace(
        PRESET, control=control, settling=Settling(rule="fixed", wait=wait), axes=(Axis(),) * 3
    )
    zone = np.array([machine.tolerance.landing_zone] * 2 + [machine.tolerance.landing_angle])
    found = predict_budget(machine, _plan()).sources["servo"]
    np.testing.assert_allclose(found, np.diag((0.6**frames * zone) ** 2 / 3.0), rtol=1e-9, atol=1e-30)


def test_tolerated_errors_of_a_loop_on_the_latest_pose_are_its_margins() -> None:
    machine = dataclasses.replace(PRESET, control=Control(gain=0.2), axes=(Axis(lag=0.4e-3), Axis(lag=0.9e-3), Axis()))
    delay = machine.delay.frames + 0.9  # the longest lag counts as a delay
    tolerated = model_tolerance(machine, _plan())
    assert tolerated is not None
    assert tolerated.plant_gain == pytest.approx(gain_limit(delay) / 0.2, rel=1e-6)
    # The phase at the crossover is -90 degrees less half a frame and the delay.
    angle = 2.0 * math.asin(0.1)
    assert tolerated.longer_delay == pytest.approx(1e-3 * ((math.pi / 2.0) / angle - 0.5 - delay), rel=0.02)


def test_a_predictor_with_an_integral_part_has_no_tolerated_errors() -> None:
    for control in (Control(observer="smith", controller="pi"), dataclasses.replace(KALMAN, controller="pi", gain=0.3)):
        assert model_tolerance(dataclasses.replace(PRESET, control=control), _plan()) is None


def test_corrections_of_a_kalman_filter_follow_its_recursion() -> None:
    """Matrices that do not commute, three frames: the error of the last estimate, written out."""
    rng = np.random.default_rng(7)
    reported, noise = (each @ each.T for each in rng.normal(size=(2, 3, 3)))
    sigma = (0.3, 0.5, 0.2)
    machine = dataclasses.replace(
        PRESET, control=Control(observer="kalman", gain=0.7, motion_sigma=sigma), axes=(Axis(),) * 3
    )
    covariance = reported
    # Derivatives of the estimates and of the position by the noise of each frame.
    by_noise = [np.eye(3) if each == 0 else np.zeros((3, 3)) for each in range(3)]
    at = [np.zeros((3, 3)) for _ in range(3)]
    for frame in range(3):
        if frame:
            prior = covariance + np.diag(sigma) ** 2
            gain = prior @ np.linalg.inv(prior + reported)
            covariance = prior - gain @ prior
            by_noise = [(np.eye(3) - gain) @ each for each in by_noise]
            by_noise[frame] = gain
        # The head moves by 0.7 of the estimated error; the estimate contains the motion.
        at = [here - 0.7 * (here + error) for here, error in zip(at, by_noise, strict=True)]
    expected = sum(each @ noise @ each.T for each in at)
    np.testing.assert_allclose(noise_covariance(machine, reported, noise, 3), expected, rtol=1e-9)
