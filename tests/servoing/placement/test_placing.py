from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.delay_response import settling_frames
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.observer import PoseMeasurement
from gpuvision.servoing.placement.budget import noise_gain
from gpuvision.servoing.placement.machine import Machine, PlacementCamera, ThermalDrift, Tolerance
from gpuvision.servoing.placement.placing import REMAINDER, Placement, place_part, predicted_frames
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import Fault, SimulatedPoseSensor

MACHINE = dataclasses.replace(read_machine("look_while_place"), gain=0.2)
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
        dataclasses.replace(MACHINE, gain=1.5)
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
