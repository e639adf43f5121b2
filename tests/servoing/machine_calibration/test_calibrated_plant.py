"""Servo loop over a machine with scaled, skewed and turned axes and a camera off the head's axis."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains
from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import LoopRecord, Plant, PlantReading, ServoLoop, SimulatedClock
from gpuvision.servoing.machine_calibration.calibrated_plant import CalibratedPlant
from gpuvision.servoing.machine_calibration.motion_frame import MotionFrame, fit_motion_frame
from gpuvision.servoing.observer import MotionModel, PoseObserver
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PERIOD, GAIN = 1e-3, 0.4
X_SCALE, Y_SCALE, SKEW, BETA, CAMERA = 1.05, 0.9, 0.08, 0.4, -0.2
OFFSET = (31e-3, -4e-3)
AXIS_X, AXIS_Y = (X_SCALE, 0.0), (-Y_SCALE * math.sin(SKEW), Y_SCALE * math.cos(SKEW))
START = np.array([2e-3, -1e-3, 0.3])  # of the motion axes


def turned(x: np.ndarray, y: np.ndarray, angle: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
    return np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y


def seen(positions: np.ndarray) -> np.ndarray:
    """Return the poses (n, 3) of the camera on the board: the axes, the head on them, the camera on it."""
    x, y, alpha = np.moveaxis(np.asarray(positions, np.float64), -1, 0)
    arm_x, arm_y = turned(*np.broadcast_arrays(*OFFSET, alpha)[:2], alpha)
    camera_x = x * AXIS_X[0] + y * AXIS_Y[0] + arm_x
    camera_y = x * AXIS_X[1] + y * AXIS_Y[1] + arm_y
    return np.stack([*turned(camera_x - 7e-3, camera_y - 9e-3, BETA), CAMERA + alpha + BETA], axis=-1)


def calibration(turns: bool = True) -> MotionFrame:
    places = [(0, 0, 0), (40e-3, 0, 0.5), (40e-3, 30e-3, -0.5), (0, 30e-3, 0.2), (20e-3, 15e-3, 1.5)]
    commands = np.array(places) * (1.0, 1.0, float(turns))
    return fit_motion_frame(commands, seen(commands), np.diag([1e-12, 1e-12, 1e-9]))


def run(plant: Plant, machine: SimulatedPlant, target: np.ndarray, *, is_skewed: bool = True) -> LoopRecord:
    look = (lambda times: seen(machine.pose(times))) if is_skewed else machine.pose
    sensor = SimulatedPoseSensor(look, period=PERIOD, delay=2.5e-3, is_noisy=False)
    observer = PoseObserver(MotionModel(lag=(0.0,) * 3, position_noise=(1e-9,) * 3), gate=1e9)
    observer.reset(-0.01, look(np.zeros(1))[0], 1e-12 * np.eye(3))
    controller = PidController(PidGains(proportional=GAIN / PERIOD))
    limits = LoopLimits()
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=limits)
    return loop.run(target, 0.04)


def errors(is_skewed: bool, step: np.ndarray) -> tuple[LoopRecord, np.ndarray]:
    """Return the record, and the true errors (n, 3) of the camera's pose at the frames."""
    first = seen(START[None])[0]
    machine = SimulatedPlant(start=START if is_skewed else first)
    plant = CalibratedPlant(machine, calibration()) if is_skewed else machine
    record = run(plant, machine, first + step, is_skewed=is_skewed)
    poses = machine.pose(record.time)
    return record, first + step - (seen(poses) if is_skewed else poses)


def test_loop_converges_as_without_skew() -> None:
    step = np.array([0.4e-3, -0.3e-3, 0.0])
    (record, found), (_, expected) = (errors(is_skewed, step) for is_skewed in (True, False))
    np.testing.assert_allclose(found, expected, atol=1e-10)
    assert np.abs(found[-1]).max() < 1e-8
    assert record.glitches == 0
    np.testing.assert_allclose(record.encoder, record.target - found, atol=1e-12)


def test_turn_of_a_camera_off_the_axis_is_compensated() -> None:
    """A turn by 10 mrad around an axis at 31 mm would move the camera by 0.3 mm; at most 1.6 um remain for a frame."""
    step = np.array([0.4e-3, -0.3e-3, 10e-3])
    (record, found), (_, expected) = (errors(is_skewed, step) for is_skewed in (True, False))
    np.testing.assert_allclose(found[:, :2], expected[:, :2], atol=math.hypot(*OFFSET) * 10e-3**2 / 2)
    np.testing.assert_allclose(found[:, 2], expected[:, 2], atol=1e-9)
    assert np.abs(found[-1]).max() < 1e-7
    assert record.glitches == 0


def test_loop_without_the_adapter_goes_astray() -> None:
    """Axes turned by 0.4 rad: the first command leaves the direction to the target by that angle, and less than it."""
    machine = SimulatedPlant(start=START)
    first = seen(START[None])[0]
    record = run(machine, machine, first + np.array([0.4e-3, 0.0, 0.0]))
    moved = seen(machine.pose(record.time[4:5]))[0] - first
    assert abs(moved[1]) > 0.3 * abs(moved[0])


def test_limit_of_an_axis_ends_the_loop() -> None:
    stop = START[0] + 0.1e-3
    machine = SimulatedPlant((Axis(upper=stop), Axis(), Axis()), start=START)
    plant = CalibratedPlant(machine, calibration())
    record = run(plant, machine, seen(START[None])[0] + (0.6e-3, 0.2e-3, 0.0))
    assert record.outcome in {Outcome.AT_LIMIT, Outcome.ENCODER}
    assert plant.read(1.0).at_limit.tolist() == [1, 0, 0]


class Resting:
    """Machine with given readings that records its commands."""

    def __init__(self, position: tuple[float, float, float], at_limit: tuple[int, int, int] = (0, 0, 0)) -> None:
        self.reading = PlantReading(0.0, np.array(position), np.array(at_limit, np.int8))
        self.commands: list[np.ndarray] = []

    def command(self, time: float, velocity: np.ndarray) -> None:
        self.commands.append(velocity)

    def read(self, time: float) -> PlantReading:
        return self.reading


def test_calibration_without_turns_has_no_offset() -> None:
    machine = Resting((1e-3, 2e-3, 0.0))
    plant = CalibratedPlant(machine, calibration(turns=False))
    np.testing.assert_allclose(plant.read(0.0).position, seen(np.array([1e-3, 2e-3, 0.0])), atol=1e-12)
    plant.command(0.0, np.array([0.0, 0.0, 0.1]))
    np.testing.assert_allclose(machine.commands[0], (0.0, 0.0, 0.1), atol=1e-15)


def test_missing_encoder() -> None:
    plant = CalibratedPlant(Resting((1e-3, 2e-3, math.nan), (0, -1, 1)), calibration())
    assert np.isnan(plant.read(0.0).position).all()
    assert plant.read(0.0).at_limit.tolist() == [0, -1, 1]
    plant.command(0.0, np.array([1e-3, 0.0, 0.0]))
    with pytest.raises(ValueError, match="the angle of the head has no reading"):
        plant.command(0.0, np.array([0.0, 0.0, 0.1]))
