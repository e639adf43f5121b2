"""Simulated plant against scipy's integrator of the written-out equations, and against closed forms."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from gpuvision.servoing.axis import Axis, AxisStepper, FineStage
from gpuvision.servoing.plant import SimulatedPlant

COMMANDS = ((0.0, 0.05), (0.02, -0.03), (0.045, 0.0), (0.06, 0.2))
TIMES = np.linspace(0.0, 0.09, 37)


def moved(axis: Axis, times: np.ndarray = TIMES, commands: tuple[tuple[float, float], ...] = COMMANDS) -> np.ndarray:
    plant = SimulatedPlant((axis, Axis(), Axis()))
    for time, velocity in commands:
        plant.command(time, np.array([velocity, 0.0, 0.0]))
    return plant.pose(times)[:, 0]


def integrated(axis: Axis) -> np.ndarray:
    """Return the position by Runge-Kutta steps of 1 us at most, with a friction that changes its sign over 1e-7 m/s."""

    def rate(_: float, y: np.ndarray, u: float) -> list[float]:
        p, v, s, w, q, r = y
        fine = axis.fine
        demand = (u + (fine.recentring * s if fine else 0.0) - v) / axis.lag
        force = float(np.clip(demand, -axis.acceleration, axis.acceleration))
        dv = force - axis.viscous * v - axis.coulomb * float(np.clip(v / 1e-6, -1, 1))
        dw = (u - v - w) / fine.lag if fine else 0.0
        dr = axis.resonance**2 * (p + s - q) + 2 * axis.damping * axis.resonance * (v + w - r)
        return [v, dv, w, dw, r, dr]

    state, found = np.zeros(6), [0.0]
    ends = [*(time for time, _ in COMMANDS[1:]), TIMES[-1] + 1e-9]
    for (start, u), end in zip(COMMANDS, ends, strict=True):
        wanted = np.array([each for each in TIMES if start < each <= end])
        grid = np.append(wanted, end) if not wanted.size or wanted[-1] < end else wanted
        done = solve_ivp(rate, (start, end), state, "LSODA", grid, args=(u,), rtol=1e-8, atol=1e-12)
        found += list((done.y[4] if axis.resonance else done.y[0] + done.y[2])[: len(wanted)])
        state = done.y[:, -1]
    return np.array(found)


@pytest.mark.parametrize(
    "axis",
    [
        Axis(lag=3e-3),
        Axis(lag=3e-3, viscous=40.0),
        Axis(lag=3e-3, coulomb=4.0, viscous=10.0),
        Axis(lag=1e-3, acceleration=8.0),
        Axis(lag=2e-3, resonance=2 * math.pi * 60.0, damping=0.03),
        Axis(lag=5e-3, coulomb=2.0, fine=FineStage(lag=5e-4, stroke=1.0, recentring=30.0)),
        Axis(lag=4e-3, coulomb=3.0, acceleration=20.0, resonance=400.0, fine=FineStage(lag=1e-3, stroke=1.0)),
    ],
)
def test_motion_is_the_solution_of_the_equations(axis: Axis) -> None:
    # The smoothed friction of the integrator lets a resting axis creep by less than 1 um/s.
    assert moved(axis) == pytest.approx(integrated(axis), abs=2e-7 if axis.coulomb else 2e-8)


def test_ideal_axis_integrates_the_command() -> None:
    expected = np.interp(TIMES, [0.0, 0.02, 0.045, 0.06, 0.09], np.cumsum([0.0, 1e-3, -7.5e-4, 0.0, 6e-3]))
    assert moved(Axis()) == pytest.approx(expected, abs=1e-12)


def test_axis_sticks_below_the_friction_and_stops_in_closed_form() -> None:
    axis = Axis(lag=1e-2, coulomb=1.0)
    assert moved(axis, commands=((0.0, 0.0099),)) == pytest.approx(np.zeros(37), abs=0.0)  # 0.0099 / lag < coulomb
    # From v0 the velocity is (v0 + lag c) exp(-t / lag) - lag c; it stops at lag ln(1 + v0 / (lag c)).
    plant = SimulatedPlant((axis, Axis(), Axis()))
    plant.command(0.0, np.array([0.05, 0.0, 0.0]))
    plant.command(1.0, np.zeros(3))
    before, speed, limit = plant.pose(1.0)[0], 0.04, 0.01
    stop = 1e-2 * math.log1p(speed / limit)
    path = (speed + limit) * 1e-2 * -math.expm1(-stop / 1e-2) - limit * stop
    assert plant.pose(1.0 + 2 * stop)[0] - before == pytest.approx(path, rel=1e-9)
    assert plant.pose(2.0)[0] == plant.pose(1.0 + 1.001 * stop)[0]


def test_stops_hold_and_release() -> None:
    plant = SimulatedPlant((Axis(lag=1e-3, upper=1e-3), Axis(lower=-2e-3), Axis()))
    plant.command(0.0, np.array([0.1, -0.1, 0.0]))
    reading = plant.read(0.1)
    assert reading.position.tolist() == [1e-3, -2e-3, 0.0]
    assert reading.at_limit.tolist() == [1, -1, 0]
    plant.command(0.1, np.array([-0.1, 0.1, 0.0]))
    reading = plant.read(0.11)
    assert reading.position[0] == pytest.approx(1e-3 - 0.1 * (0.01 - 1e-3 * (1 - math.exp(-10))), rel=1e-9)
    assert reading.position[1] == pytest.approx(-1e-3)
    assert reading.at_limit.tolist() == [0, 0, 0]


def test_fine_stage_follows_until_its_stroke_ends() -> None:
    """The sum moves as fast as the fine stage; at the end of its stroke, as slow as the axis."""
    fine = FineStage(lag=1e-4, stroke=5e-5, recentring=50.0)
    short = moved(Axis(lag=2e-2, fine=fine), np.array([2e-3]), ((0.0, 0.01),))
    assert short == pytest.approx(0.01 * (2e-3 - 1e-4), rel=0.02)
    long = moved(Axis(lag=2e-2, fine=fine), np.array([2e-2]), ((0.0, 0.01),))[0]
    alone = moved(Axis(lag=2e-2), np.array([2e-2]), ((0.0, 0.01),))[0]
    assert alone < long < alone + 1.6 * 5e-5
    assert long < 0.01 * 2e-2 - 2e-5


def test_resonance_decays_with_its_frequency() -> None:
    frequency, damping = 80.0, 0.02
    plant = SimulatedPlant((Axis(resonance=2 * math.pi * frequency, damping=damping), Axis(), Axis()))
    plant.command(0.0, np.array([0.1, 0.0, 0.0]))
    plant.command(0.01, np.zeros(3))
    period = 1.0 / (frequency * math.sqrt(1 - damping**2))
    times = 0.02 + 0.1 * period + period * np.arange(6)
    swing = plant.pose(times)[:, 0] - 1e-3
    decay = math.exp(-damping * 2 * math.pi * frequency * period)
    assert swing[1:] / swing[:-1] == pytest.approx(decay, rel=1e-6)


def test_encoder_rounds_to_its_step() -> None:
    plant = SimulatedPlant((Axis(encoder=1e-6), Axis(), Axis()))
    plant.command(0.0, np.array([1e-3, 1e-3, 0.0]))
    assert plant.read(2.6e-3).position[:2] == pytest.approx([3e-6, 2.6e-6], abs=1e-15)


def test_history_is_bounded() -> None:
    plant = SimulatedPlant(history=4)
    for k in range(10):
        plant.command(1e-3 * k, np.zeros(3))
    with pytest.raises(ValueError, match="before the history"):
        plant.pose(2e-3)
    with pytest.raises(ValueError, match="before the last command"):
        plant.command(1e-3, np.zeros(3))


@pytest.mark.parametrize("given", [{"coulomb": 1.0}, {"lower": 1.0, "upper": 0.0}, {"speed": 0.0}, {"damping": 2.0}])
def test_axis_refuses(given: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"needs a lag|must be above 0|damping is"):
        Axis(**given)


@pytest.mark.parametrize("axis", [Axis(), Axis(upper=1.0, lag=1e-3)])
@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_velocity_must_be_finite(axis: Axis, wrong: float) -> None:
    plant = SimulatedPlant((axis,) * 3)
    with pytest.raises(ValueError, match="velocity"):
        plant.command(0.0, np.array([0.0, wrong, 0.0]))


@pytest.mark.parametrize(
    "axis",
    [
        Axis(lag=3e-3, coulomb=4.0, viscous=10.0, lower=-1e-4, upper=7e-4),
        Axis(lag=1e-3, acceleration=8.0, speed=0.04, resonance=300.0),
        Axis(lag=2e-2, fine=FineStage(lag=1e-3, stroke=2e-4, recentring=30.0)),
    ],
)
def test_mirrored_commands_move_a_mirrored_axis_by_the_mirrored_path(axis: Axis) -> None:
    mirrored = dataclasses.replace(axis, lower=-axis.upper, upper=-axis.lower)
    found = moved(axis)
    np.testing.assert_allclose(moved(mirrored, commands=tuple((time, -v) for time, v in COMMANDS)), -found, atol=1e-12)
    assert np.ptp(found) > 4e-4


def test_commands_are_cut_to_the_largest_speed() -> None:
    times = np.array([0.01, 0.02, 0.03, 0.05])
    found = moved(Axis(speed=0.04), times, ((0.0, 0.05), (0.02, -0.03), (0.03, -0.9)))
    assert found == pytest.approx([4e-4, 8e-4, 5e-4, -3e-4], abs=1e-15)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_limited_drive_reaches_its_speed_in_closed_form(sign: float) -> None:
    """The drive saturates until the command exceeds the velocity by acceleration times lag; then the lag decays."""
    plant = SimulatedPlant((Axis(lag=0.01, acceleration=2.0), Axis(), Axis()), start=(0.3, 0.0, 0.0))
    plant.command(0.0, np.array([0.1 * sign, 0.0, 0.0]))
    times = np.array([0.02, 0.04, 0.045, 0.07])
    since = np.maximum(times - 0.04, 0.0)
    ramp = 0.5 * 2.0 * np.minimum(times, 0.04) ** 2
    decayed = 0.1 * since - 0.02 * 0.01 * -np.expm1(-since / 0.01)
    assert plant.pose(times)[:, 0] - 0.3 == pytest.approx(sign * (ramp + decayed), rel=1e-8)


def test_the_watchdog_stops_the_axes_after_its_time() -> None:
    plant = SimulatedPlant((Axis(lag=0.2), Axis(), Axis()), watchdog=0.5)
    plant.command(0.0, np.array([1.0, -2.0, 0.0]))
    assert plant.pose([0.4, 0.5, 0.6, 9.0])[:, 1] == pytest.approx([-0.8, -1.0, -1.0, -1.0])
    velocity = -math.expm1(-2.5)
    stopped = 0.5 - 0.2 * velocity
    assert plant.pose([0.5, 0.7])[:, 0] == pytest.approx([stopped, stopped + 0.2 * velocity * -math.expm1(-1.0)])
    plant.command(0.7, np.array([0.0, 3.0, 0.0]))
    assert plant.pose([0.9, 1.2, 1.5])[:, 1] == pytest.approx([-0.4, 0.5, 0.5])


def test_start_and_swing_of_each_axis() -> None:
    axes = (Axis(), Axis(resonance=50.0, damping=0.0), Axis(resonance=20.0, damping=0.1))
    plant = SimulatedPlant(axes, start=(1.0, 2.0, 3.0), swing=(0.0, 0.5, -0.25))
    assert plant.read(0.0).position.tolist() == [1.0, 2.0, 3.0]
    times = np.array([[-1.0, 0.0], [0.03, 0.1]])
    since, rate = np.maximum(times, 0.0), 20.0 * math.sqrt(0.99)
    decay = np.exp(-2.0 * since) * (np.cos(rate * since) + 2.0 / rate * np.sin(rate * since))
    expected = np.stack([np.ones((2, 2)), 2.0 + 0.5 * np.cos(50.0 * since), 3.0 - 0.25 * decay], axis=-1)
    np.testing.assert_allclose(plant.pose(times), expected, atol=1e-12)
    with pytest.raises(ValueError, match=r"a plant has 3 axes \(x, y, theta\), got 2"):
        SimulatedPlant((Axis(), Axis()))


def test_equal_axes_share_their_matrices_and_no_motion() -> None:
    axis = Axis(lag=2e-3, resonance=2.0 * math.pi * 40.0)
    assert AxisStepper.of(axis) is AxisStepper.of(dataclasses.replace(axis))
    assert AxisStepper.of(axis) is not AxisStepper.of(dataclasses.replace(axis, lag=3e-3))
    poses = []
    for speed in (1.0, -2.0, 1.0):
        plant = SimulatedPlant((axis, axis, Axis()))
        for k in range(4):
            plant.command(1e-3 * k, np.array([speed, 0.5 * speed, 0.0]))
        poses.append(plant.pose(np.linspace(0.0, 4e-3, 9)))
    np.testing.assert_array_equal(poses[0], poses[2])
    np.testing.assert_allclose(poses[1], -2.0 * poses[0], atol=1e-15)


def test_history_keeps_its_number_of_commands() -> None:
    plant = SimulatedPlant(history=3)
    for k in range(1, 6):
        plant.command(0.1 * k, np.array([1.0, 0.0, 0.0]))
    assert plant.pose(0.3)[0] == pytest.approx(0.2)
    with pytest.raises(ValueError, match=r"0\.299000 s is before the history of the plant; enlarge history"):
        plant.pose(0.299)
    with pytest.raises(ValueError, match=r"0\.499000 s is before the last command at 0\.500000 s"):
        plant.read(0.499)
    assert plant.read(0.5).at_limit.tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"lower": 1.0, "upper": 1.0}, "acceleration and speed must be above 0, and lower below upper"),
        ({"acceleration": 0.0, "lag": 1.0}, "acceleration and speed must be above 0"),
        ({"viscous": 1.0}, "needs a lag above 0"),
        ({"acceleration": 1.0}, "needs a lag above 0"),
        ({"fine": FineStage(lag=1.0, stroke=1.0)}, "needs a lag above 0"),
    ],
)
def test_axes_that_cannot_work_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Axis(**given)
