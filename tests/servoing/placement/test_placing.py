from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.sensor_readout import SensorReadout
from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.delay_response import settling_frames
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.guard import LoopLimits, Outcome
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.observer import LatestPose, PoseMeasurement
from gpuvision.servoing.placement import placing
from gpuvision.servoing.placement.budget import noise_gain
from gpuvision.servoing.placement.control import Control, Settling
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


@pytest.mark.parametrize(("lag", "needed"), [(0.0, 1), (1.5e-3, math.ceil(MACHINE.delay.frames + 1.5) + 1)])
def test_errors_in_a_row_release_where_axes_have_a_lag(lag: float, needed: int) -> None:
    """After the wait by theory: new errors within the tolerance for a latency and a lag; a larger one starts again."""
    machine = dataclasses.replace(MACHINE, axes=(Axis(), Axis(lag=lag), Axis()), control=Control(gain=0.1))
    observer: Any = SimpleNamespace(exposed=-math.inf)
    rule = ReleaseRule(machine, observer)
    near, far = np.array([0.0, 0.0, 0.99e-3]), np.array([0.0, 0.0, 1.01e-3])
    assert rule.start is None
    assert not rule(0.5, near, COVARIANCE)  # no pose yet
    observer.exposed = 0.0
    start = np.array([3e-6, -4e-6, 2e-3])
    assert not rule(1.0, start, COVARIANCE)
    np.testing.assert_array_equal(rule.start, start)
    assert rule.frames == predicted_frames(machine, start) > 9
    end, row = 1.0 + rule.frames * 1e-3, 0
    for number in range(1, 20 + needed):
        observer.exposed = float(number)
        error = far if number <= 10 or number == 12 else near
        row = row + 1 if error is near else 0
        released = rule(end + 1e-4 * number, error, COVARIANCE)
        assert released == (row >= needed)
    assert row >= needed


@pytest.mark.parametrize(("share", "expected"), [(0.51, False), (0.49, True)])
def test_the_wait_ends_at_the_nearest_frame(share: float, expected: bool) -> None:
    settling = Settling(rule="fixed", wait=20.2e-3)
    observer: Any = SimpleNamespace(exposed=0.0)
    rule = ReleaseRule(dataclasses.replace(MACHINE, settling=settling), observer)
    assert not rule(3.0, TARGET, COVARIANCE)
    assert rule.frames == 21
    observer.exposed = 1.0
    assert rule(3.0 + (21 - share) * 1e-3, TARGET, COVARIANCE) is expected


def test_limits_of_the_loop_of_a_placement(monkeypatch: pytest.MonkeyPatch) -> None:
    """Head without poses: latency, coarse registration and refused frames; overshoot from the edge of the zone."""
    axes = (Axis(lag=0.5e-3), Axis(lag=2e-3), Axis(lag=1e-3))
    machine = dataclasses.replace(MACHINE, axes=axes, control=Control(gain=0.3, watchdog=1.5))
    made: dict[str, Any] = {}

    class Loop:
        def __init__(self, *parts: Any, **more: Any) -> None:
            made.update(more, parts=parts)

        def run(self, goal: Any, duration: float, *, settling: Any) -> Any:
            made.update(goal=goal, duration=duration, rule=settling)
            return SimpleNamespace(outcome=made["outcome"])

    monkeypatch.setattr(placing, "ServoLoop", Loop)
    nothing: Any = None
    for landing, waited in ((0.0, 0), (7.2e-3, 8), (7e-3, 7)):
        for outcome, reason in ((Outcome.ARRIVED, ""), (Outcome.LOST, "no trusted pose for too long")):
            made["outcome"] = outcome
            found = place_part(machine, TARGET, nothing, nothing, SimulatedClock(), landing=landing)
            assert (found.released, found.reason, found.predicted_frames) == (not reason, reason, waited)
            assert np.isnan(found.start_error).all()
        blind = landing + machine.delay.latency + 20 * 1e-3
        zone = machine.overshoot * (100e-6, 100e-6, 5e-3)
        assert zone.min() > 1e-6
        limits: LoopLimits = made["limits"]
        assert (limits.hold_after, limits.abort_after) == pytest.approx((blind, blind))
        assert limits.watchdog == pytest.approx(1.5e-3)
        assert limits.overshoot == pytest.approx(zone)
        assert limits.lag == (0.5e-3, 2e-3, 1e-3)
        assert (made["period"], made["duration"]) == (1e-3, 1.0)
        np.testing.assert_array_equal(made["goal"], TARGET)


@pytest.mark.parametrize(("x", "y", "share"), [(90.0, 0.0, 1.0), (0.0, 90.0, 1.0), (90.0, 50.0, math.sqrt(0.5))])
def test_swings_of_both_axes_share_the_tolerance(x: float, y: float, share: float) -> None:
    settling = Settling(rule="vibration", frequency=(x, y, 20.0), damping=(0.1, 0.1, 0.1))
    limits = placing.swing_limit(dataclasses.replace(MACHINE, settling=settling))
    np.testing.assert_allclose(limits, (3e-6 * share, 3e-6 * share, 1e-3))


def _pose(exposed: float) -> PoseMeasurement:
    return PoseMeasurement(exposed, exposed, TARGET, COVARIANCE, 0)


def _at(exposed: float) -> LatestPose:
    observer = LatestPose()
    observer.add(_pose(exposed))
    return observer
