from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.sensor_readout import SensorReadout
from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.delay_response import settling_frames
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.observer import LatestPose, PoseMeasurement
from gpuvision.servoing.placement.budget import noise_gain
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine, PlacementCamera, ThermalDrift, Tolerance
from gpuvision.servoing.placement.placing import REMAINDER, Placement, ReleaseRule, place_part, predicted_frames
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import Fault, SimulatedPoseSensor

MACHINE = dataclasses.replace(read_machine("look_while_place"), control=Control(gain=0.2))
TARGET = np.array([12e-3, 5e-3, 0.3])
COVARIANCE = np.diag([0.2e-6, 0.2e-6, 1e-4]) ** 2


def _place(
    start: tuple[float, float, float],
    *,
    machine: Machine = MACHINE,
    seed: int = 0,
    is_noisy: bool = False,
    fault: Fault | None = None,
) -> tuple[Placement, np.ndarray]:
    plant = SimulatedPlant(machine.axes, start=TARGET + start)
    sensor = SimulatedPoseSensor(
        plant.pose,
        period=machine.period,
        delay=machine.delay.latency,
        covariance=COVARIANCE,
        is_noisy=is_noisy,
        fault=fault,
        seed=seed,
    )
    placement = place_part(machine, TARGET, plant, sensor, SimulatedClock())
    return placement, plant.pose(placement.record.time[-1]) - TARGET


@pytest.mark.parametrize("offset", [80e-6, 20e-6, 5e-6])
def test_the_head_settles_in_the_number_of_frames_of_theory(offset: float) -> None:
    placement, error = _place((offset, 0.0, 0.0))
    assert placement.released
    rest = REMAINDER * MACHINE.tolerance.position
    expected = settling_frames(MACHINE.delay.frames, MACHINE.loop_gain, rest / offset)
    assert placement.predicted_frames == expected
    assert placement.frames == expected + 1  # the first frame measures the start
    assert abs(error[0]) <= rest * (1 + 1e-9)
    # One frame earlier the rest was larger: the loop waits no longer than it must.
    motion = placement.record.pose[:, 0] - TARGET[0]
    assert abs(motion[0]) == pytest.approx(offset)


def test_a_start_within_the_rest_is_released_at_once() -> None:
    placement, _ = _place((0.3e-6, 0.0, 0.0))
    assert (placement.released, placement.frames, placement.predicted_frames) == (True, 1, 0)


def test_error_at_the_release_has_the_predicted_variance() -> None:
    variance = noise_gain(MACHINE.delay.frames, MACHINE.loop_gain) * np.diag(COVARIANCE)
    errors = []
    for seed in range(100):
        placement, error = _place((60e-6, -40e-6, 2e-3), seed=seed, is_noisy=True)
        assert placement.released
        errors.append(error)
    spread = np.std(errors, axis=0)
    # Standard error of a standard deviation of 100 runs: 7 %. The noise is not yet stationary: a few percent less.
    np.testing.assert_allclose(spread / np.sqrt(variance), 1.0, atol=0.25)


def test_a_camera_without_a_pose_aborts_the_placement() -> None:
    def refused(_: int, measurement: PoseMeasurement) -> list[PoseMeasurement]:
        return [measurement._replace(pose=np.full(3, math.nan), covariance=np.full((3, 3), math.nan), status=1)]

    placement, error = _place((50e-6, 0.0, 0.0), fault=refused)
    assert not placement.released
    assert placement.reason == "no trusted pose for too long"
    assert np.all(np.isnan(placement.start_error))
    assert abs(error[0] - 50e-6) < 1e-12  # the head did not move
    assert 20 <= placement.frames <= 24


def test_a_target_that_is_not_reached_is_aborted_after_the_longest_time() -> None:
    # The measured pose stays where it was: a camera that shows the same frame with new time stamps.
    def frozen(_: int, measurement: PoseMeasurement) -> list[PoseMeasurement]:
        return [measurement._replace(pose=TARGET + np.array([50e-6, 0.0, 0.0]))]

    machine = dataclasses.replace(MACHINE, tolerance=dataclasses.replace(MACHINE.tolerance, max_time=0.05))
    placement, _ = _place((50e-6, 0.0, 0.0), machine=machine, fault=frozen)
    assert (placement.released, placement.reason, placement.frames) == (False, "time over", 50)


def test_predicted_frames_follow_the_worst_axis() -> None:
    angle_alone = predicted_frames(MACHINE, (0.0, 0.0, 5e-3))
    assert predicted_frames(MACHINE, (1e-6, 0.0, 5e-3)) == angle_alone
    assert predicted_frames(MACHINE, (90e-6, 0.0, 5e-3)) > angle_alone


def test_machines_that_cannot_work_are_refused() -> None:
    camera = MACHINE.camera
    with pytest.raises(ValueError, match=r"gain is 1.5, expected above 0 and below .* limit of stability"):
        dataclasses.replace(MACHINE, control=Control(gain=1.5))
    with pytest.raises(ValueError, match=r"gain is 1e-09, expected 0\.0001 or more"):
        dataclasses.replace(MACHINE, control=Control(gain=1e-9))
    with pytest.raises(ValueError, match="more than 1/rate"):
        dataclasses.replace(MACHINE, rate=20_000.0)
    with pytest.raises(ValueError, match="expected a rigid transform from pipette to camera"):
        dataclasses.replace(MACHINE, pipette_in_camera=Transform.rigid("camera", "pipette", (0, 0, 0)))
    with pytest.raises(ValueError, match="window rows"):
        dataclasses.replace(camera, window=(2000, 100))
    with pytest.raises(ValueError, match="exposure"):
        PlacementCamera(sensor=camera.sensor, pixel=1e-5, window=(64, 64), exposure=0.0)
    with pytest.raises(ValueError, match="landing_zone"):
        Tolerance(position=1e-6, angle=1e-3, landing_zone=0.0, landing_angle=1e-3)
    np.testing.assert_allclose(
        ThermalDrift(expansion=(1e-6, -2e-6), temperature_sigma=3.0).covariance[:2, :2] * 1e12, [[9, -18], [-18, 36]]
    )


@pytest.mark.parametrize("lag", [0.3e-3, 1e-3, 3e-3, 10e-3])
def test_an_axis_with_a_lag_rests_within_the_tolerance_after_the_release(lag: float) -> None:
    machine = dataclasses.replace(MACHINE, axes=(Axis(lag=lag),) * 3, control=Control())
    plant = SimulatedPlant(machine.axes, start=TARGET + np.array([80e-6, 0.0, 0.0]))
    sensor = SimulatedPoseSensor(
        plant.pose, period=machine.period, delay=machine.delay.latency, covariance=COVARIANCE, is_noisy=False
    )
    placement = place_part(machine, TARGET, plant, sensor, SimulatedClock())
    assert placement.released
    end = placement.record.time[-1]
    after = plant.pose(np.linspace(end, end + 10.0 * lag, 50))[:, 0] - TARGET[0]
    assert np.all(np.abs(after) < machine.tolerance.position)
    before = plant.pose(np.linspace(0.0, end, 500))[:, 0] - TARGET[0]
    assert before.min() > -0.03 * 80e-6  # hardly an overshoot
    assert placement.predicted_frames <= placement.frames <= 1.5 * placement.predicted_frames + 10


@pytest.mark.parametrize("lag", [0.2e-3, 1e-3, 5e-3])
@pytest.mark.parametrize("transfer", [0.0, 1.7e-3])
def test_the_largest_gain_is_stable_with_a_lag(lag: float, transfer: float) -> None:
    slow = dataclasses.replace(MACHINE, axes=(Axis(lag=lag),) * 3, transfer=transfer, control=Control())
    with pytest.raises(ValueError, match="limit of stability") as refused:
        dataclasses.replace(slow, control=Control(gain=10.0))
    limit = float(str(refused.value).split("below ")[1].split(",")[0])
    machine = dataclasses.replace(slow, control=Control(gain=0.98 * limit))
    error = velocity = 0.0
    # Recursion of the axis in fine steps of the frame, apart from the code of the plant.
    steps, errors = 200, []
    seen, error = round(machine.delay.frames * steps), 1.0
    history = [error] * (seen + 1)
    for _ in range(400):
        command = -machine.loop_gain * history[-1 - seen] * machine.rate
        for _ in range(steps):
            velocity += (command - velocity) * (1.0 - math.exp(-machine.period / steps / lag))
            error += velocity * machine.period / steps
            history.append(error)
        errors.append(abs(error))
    assert max(errors[300:]) < 0.5


def test_the_delay_is_that_of_the_sensor() -> None:
    """Readout of a window of 128 x 128: 0.41 ms at 40 MHz; 1 kHz; an exposure of 0.2 ms."""

    def latency(readout: SensorReadout, **pixel: object) -> float:
        described = {"rows": 256, "columns": 256, "pitch": 1e-5, "quantum_efficiency": 0.5, "gain": 0.1}
        sensor = CmosSensor(**described, dark_noise=10.0, full_well=2e4, bits=10, readout=readout, **pixel)
        camera = dataclasses.replace(MACHINE.camera, sensor=sensor, window=(128, 128), exposure=0.2e-3)
        machine = dataclasses.replace(MACHINE, camera=camera, rate=1000.0, transfer=0.0, stages={}, control=Control())
        if not readout.buffers:
            assert machine.delay.latency == pytest.approx(sensor.timing((128, 128), 0.2e-3).delay, rel=1e-12)
        return machine.delay.latency

    row = 128 / 40e6
    assert latency(SensorReadout(pixel_clock=40e6)) == pytest.approx(0.1e-3 + 128 * row, rel=1e-12)
    # The buffers are read at the rate of the machine, not at the highest one of the sensor.
    assert latency(SensorReadout(pixel_clock=40e6, buffers=2)) == pytest.approx(2.1e-3 + 128 * row, rel=1e-12)
    rolling = SensorReadout(pixel_clock=40e6, shutter="rolling")
    assert latency(rolling) == pytest.approx(0.1e-3 + 64.5 * row, rel=1e-12)
    direct = latency(SensorReadout(pixel_clock=40e6), pixel="direct_read", response_time=20e-6)
    assert direct == pytest.approx(10e-6 + 64.5 * row, rel=1e-12)


def test_the_position_tolerance_is_a_distance() -> None:
    side = 0.9 * MACHINE.tolerance.position
    assert ReleaseRule(MACHINE, _at(0.0))(0.0, np.zeros(3), COVARIANCE)
    late = 1.0
    for error, expected in (((side, 0.0, 0.0), True), ((side, side, 0.0), False)):
        observer = _at(0.0)
        rule = ReleaseRule(MACHINE, observer)
        assert not rule(0.0, np.array([90e-6, 0.0, 0.0]), COVARIANCE)
        observer.add(_pose(late))
        assert rule(late, np.array(error), COVARIANCE) is expected
    assert predicted_frames(MACHINE, (40e-6, 40e-6, 0.0)) == predicted_frames(MACHINE, (40e-6 * math.sqrt(2), 0.0, 0.0))


def test_an_error_of_an_old_pose_does_not_release() -> None:
    observer = _at(0.0)
    rule = ReleaseRule(MACHINE, observer)
    small = np.array([0.5 * MACHINE.tolerance.position, 0.0, 0.0])
    assert not rule(0.0, small, COVARIANCE)  # the rest of the step response is still too large
    assert not any(rule(time, small, COVARIANCE) for time in (0.5, 0.6))
    observer.add(_pose(0.6))
    assert rule(0.61, small, COVARIANCE)


def _pose(exposed: float) -> PoseMeasurement:
    return PoseMeasurement(exposed, exposed, TARGET, COVARIANCE, 0)


def _at(exposed: float) -> LatestPose:
    observer = LatestPose()
    observer.add(_pose(exposed))
    return observer
