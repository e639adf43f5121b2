"""Observer, controller and release rule of a placement: the theory against the running loop."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, cast

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController
from gpuvision.servoing.guard import Outcome
from gpuvision.servoing.loop import ServoLoop, SimulatedClock
from gpuvision.servoing.observer import PoseMeasurement, PosePrediction
from gpuvision.servoing.placement import rehearsal
from gpuvision.servoing.placement.budget import model_tolerance, noise_covariance
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import (
    Placement,
    ReleaseRule,
    count_commands,
    make_observer,
    place_part,
    predicted_settling,
    settled_frames,
)
from gpuvision.servoing.placement.rehearsal import check_resonances
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.settling import vibration_of_loop
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor
from gpuvision.status import Status

PRESET = read_machine("look_while_place")
COVARIANCE = np.diag([0.2e-6, 0.2e-6, 1e-4]) ** 2
MOTION = (60e-9, 60e-9, 3e-5)
BAND = np.array([0.9e-6, 0.9e-6, 0.4e-3])
CONTROLS = [
    Control(),
    Control(controller="pi"),
    Control(observer="smith"),
    Control(observer="smith", controller="pi", gain=0.4, integral=10e-3),
    Control(observer="smith", controller="pid", gain=0.4, integral=10e-3, derivative=0.5e-3),
    Control(observer="kalman", motion_sigma=MOTION, gain=0.5),
    Control(observer="kalman", motion_sigma=MOTION, controller="pid", gain=0.4, integral=12e-3, derivative=0.3e-3),
]


def _sensor(plant: SimulatedPlant, machine: Machine, *, is_noisy: bool, seed: int = 0) -> SimulatedPoseSensor:
    return SimulatedPoseSensor(
        plant.pose,
        period=machine.period,
        delay=machine.delay.latency,
        covariance=COVARIANCE,
        is_noisy=is_noisy,
        seed=seed,
    )


def _free_run(
    machine: Machine,
    start: np.ndarray,
    frames: int,
    *,
    is_noisy: bool = False,
    seed: int = 0,
    axes: tuple[Axis, Axis, Axis] = (Axis(), Axis(), Axis()),
) -> np.ndarray:
    """Return the true errors (frames, 3) of a loop without guards."""
    plant = SimulatedPlant(axes, start=start)
    loop = ServoLoop(
        plant,
        _sensor(plant, machine, is_noisy=is_noisy, seed=seed),
        make_observer(machine, np.zeros(3), 0.0),
        PidController(machine.gains),
        SimulatedClock(),
        period=machine.period,
        limits=None,
    )
    return plant.pose(loop.run(np.zeros(3), frames * machine.period).time)


@pytest.mark.parametrize("control", CONTROLS, ids=lambda each: f"{each.observer}-{each.controller}")
def test_error_of_each_frame_is_that_of_theory(control: Control) -> None:
    machine = dataclasses.replace(PRESET, control=control)
    error = _free_run(machine, np.array([50e-6, 0.0, 0.0]), 30)[:, 0]
    # The prior of the Kalman filter, ten landing zones, shares the first pose by 4e-8.
    np.testing.assert_allclose(error / 50e-6, machine.error_after(30)[:, 0], atol=1e-6)
    within = np.flatnonzero(np.abs(machine.error_after(400)[:, 0]) > 0.02)[-1] + 1
    assert machine.frames_to(0.02) == within


@pytest.mark.slow
@pytest.mark.parametrize("control", [CONTROLS[3], CONTROLS[5]], ids=["smith-pi", "kalman-p"])
def test_noise_at_the_release_is_that_of_theory(control: Control) -> None:
    machine = dataclasses.replace(PRESET, control=control)
    frames, runs = (9, 80) if control.observer == "kalman" else (25, 50)
    errors = np.array(
        [_free_run(machine, np.zeros(3), frames + 1, is_noisy=True, seed=seed)[-1] for seed in range(runs)]
    )
    expected = np.sqrt(np.diag(noise_covariance(machine, COVARIANCE, COVARIANCE, frames)))
    # Three axes of 50 runs or more: standard error of the mean of the standard deviations 6 %.
    assert np.mean(np.std(errors, axis=0) / expected) == pytest.approx(1.0, abs=0.12)


def test_a_kalman_filter_averages_over_the_frames() -> None:
    machine = dataclasses.replace(PRESET, control=Control(observer="kalman", motion_sigma=(1e-12, 1e-12, 1e-9)))
    # The gain 1 moves the head to the estimate: the mean of n poses has 1/n of the variance.
    for frames in (1, 4, 20):
        found = noise_covariance(machine, COVARIANCE, COVARIANCE, frames)
        np.testing.assert_allclose(np.diag(found) / np.diag(COVARIANCE), 1.0 / frames, rtol=1e-6)
    assert not np.any(noise_covariance(machine, COVARIANCE, COVARIANCE, 0))


def _place(machine: Machine, start: np.ndarray, axes: tuple[Axis, Axis, Axis], **more: Any) -> tuple[Placement, Any]:
    plant = SimulatedPlant(axes, start=start, watchdog=machine.control.watchdog * machine.period, **more)
    sensor = _sensor(plant, machine, is_noisy=True)
    return place_part(machine, np.zeros(3), plant, sensor, SimulatedClock()), plant


@pytest.mark.parametrize("control", CONTROLS, ids=lambda each: f"{each.observer}-{each.controller}")
def test_true_error_settles_in_the_frames_of_theory(control: Control) -> None:
    """The count of the true error is apart from the release rule: a machine that is slower shows it."""
    machine, start = dataclasses.replace(PRESET, control=control), np.array([70e-6, -40e-6, 3e-3])
    expected = predicted_settling(machine, start, BAND)
    counted = {}
    for lag in (0.0, 2e-3):
        placement, plant = _place(machine, start, (Axis(lag=lag),) * 3)
        motion = plant.pose(placement.record.time)
        counted[lag] = settled_frames(motion, BAND, released=placement.released)
        if placement.record.outcome is not Outcome.ARRIVED:
            assert not placement.released
            assert counted[lag] is None
    assert counted[0.0] is not None
    assert abs(counted[0.0] - expected) <= 1
    assert counted[2e-3] is None or counted[2e-3] >= expected + 3


@pytest.mark.parametrize(
    "control", [*CONTROLS[1:5:2], CONTROLS[6], Control(gain=0.4)], ids=lambda each: f"{each.observer}-{each.controller}"
)
@pytest.mark.parametrize("start", [40e-6, -90e-6])
def test_guards_do_not_cut_the_overshoot_of_theory(control: Control, start: float) -> None:
    machine = dataclasses.replace(PRESET, control=control, settling=Settling(rule="fixed", wait=0.06))
    plant = SimulatedPlant(start=(start, 0.0, 0.0))
    sensor = _sensor(plant, machine, is_noisy=False)
    placement = place_part(machine, np.zeros(3), plant, sensor, SimulatedClock())
    error = plant.pose(placement.record.time)[:, 0] / start
    np.testing.assert_allclose(error, machine.error_after(len(error))[:, 0], atol=1e-6)
    np.testing.assert_allclose(machine.overshoot, -error.min(), atol=1e-6)
    assert np.all(machine.overshoot > 0.05)


def test_settled_frames_count_from_the_last_error_outside_the_band() -> None:
    motion = np.zeros((6, 3))
    assert settled_frames(motion, BAND, released=True) == 0
    assert settled_frames(motion, BAND, released=False) is None
    motion[0, 0], motion[2, 2] = 5e-6, -0.5e-3
    assert settled_frames(motion, BAND, released=True) == 3
    motion[5, 1] = 1e-6
    assert settled_frames(motion, BAND, released=True) is None


def test_predictors_regain_the_frames_of_the_delay() -> None:
    """A Kalman filter of gain 1 has the noise of the loop on the latest pose after half of its frames."""
    start = np.array([80e-6, 0.0, 0.0])
    plain = dataclasses.replace(PRESET, tolerance=dataclasses.replace(PRESET.tolerance, position=3e-6))
    frames = {}
    for control in (Control(), Control(observer="smith", gain=0.5), Control(observer="smith")):
        placement, _ = _place(dataclasses.replace(plain, control=control), start, (Axis(),) * 3)
        assert placement.released
        frames[control.observer, control.gain] = placement.frames
    assert frames["smith", None] == 2 < frames["smith", 0.5] < frames["latest", None]
    kalman = dataclasses.replace(PRESET, control=Control(observer="kalman", motion_sigma=(1e-9, 1e-9, 1e-6)))
    latest = noise_covariance(plain, COVARIANCE, COVARIANCE, frames["latest", None])[0, 0]
    half = frames["latest", None] // 2
    assert noise_covariance(kalman, COVARIANCE, COVARIANCE, half + 1)[0, 0] < 1.2 * latest


def _swinging(settling: Settling, tolerance: float) -> tuple[Machine, tuple[Axis, Axis, Axis]]:
    x = Axis(resonance=2.0 * math.pi * 150.0, damping=0.02)
    limits = dataclasses.replace(PRESET.tolerance, position=tolerance)
    machine = dataclasses.replace(
        PRESET, control=Control(gain=0.1), settling=settling, tolerance=limits, axes=(x, Axis(), Axis())
    )
    return machine, machine.axes


def _largest_later(plant: SimulatedPlant, time: float) -> float:
    """Return the largest error of x in a period of the swing after a time [m]."""
    return float(np.abs(plant.pose(time + np.linspace(0.0, 0.007, 15))[:, 0]).max())


@pytest.mark.slow
def test_waiting_by_vibration_saves_30_percent_of_a_fixed_wait_with_as_many_misplacements() -> None:
    """Ten parts with tolerances of 5 and 15 um; the head comes out of the long move with a swing of up to 40 um."""
    rng, count = np.random.default_rng(4), 10
    swings, starts = rng.uniform(-40e-6, 40e-6, (2, count))
    tolerances = np.where(np.arange(count) % 2, 15e-6, 5e-6)
    runs = list(zip(starts, swings, tolerances, strict=True))
    resting = []
    for start, swing, tolerance in runs:
        machine, axes = _swinging(Settling(rule="fixed", wait=0.16), tolerance)
        resting.append(_place(machine, np.array([start, 0.0, 0.0]), axes, swing=(swing, 0.0, 0.0)))
    found = vibration_of_loop(resting[0][0].record, 0.03)
    assert (found.frequency > 0.0).tolist() == [True, False, False]
    frequency, damping = (tuple(map(float, each)) for each in found)
    rule = Settling(rule="vibration", frequency=frequency, damping=damping)
    waits, misplaced = [], 0
    for start, swing, tolerance in runs:
        machine, axes = _swinging(rule, tolerance)
        placement, plant = _place(machine, np.array([start, 0.0, 0.0]), axes, swing=(swing, 0.0, 0.0))
        assert placement.released
        waits.append(float(placement.record.time[-1]))
        misplaced += _largest_later(plant, waits[-1]) > tolerance
    assert misplaced == 0
    # The shortest fixed wait after which no part is misplaced, either.
    times = np.arange(0.02, 0.15, 2e-3)
    missed = [
        any(_largest_later(plant, time) > limit for (_, plant), limit in zip(resting, tolerances, strict=True))
        for time in times
    ]
    assert not missed[-1]
    assert np.mean(waits) <= 0.7 * times[np.flatnonzero(missed)[-1] + 1]


@pytest.mark.parametrize(
    ("frequency", "control"), [pytest.param(80.0, Control(gain=0.1), marks=pytest.mark.slow), (120.0, CONTROLS[2])]
)
def test_a_loop_that_makes_a_resonance_swing_up_is_refused_with_a_gain_that_settles(
    frequency: float, control: Control
) -> None:
    x = Axis(resonance=2.0 * math.pi * frequency, damping=0.04)
    machine = dataclasses.replace(PRESET, control=control, axes=(x, Axis(), Axis()), swing=(5e-6, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"does not settle .* swings up; it settles with the gain") as refused:
        check_resonances(machine)
    settles = dataclasses.replace(control, gain=float(str(refused.value).split("the gain ")[1]))
    # The amplitude after half a second, without the guards that bound the motion.
    for each, is_stable in ((control, False), (settles, True)):
        moved = dataclasses.replace(machine, control=each)
        error = _free_run(moved, np.array([5e-6, 0.0, 0.0]), 500, axes=machine.axes)[:, 0]
        assert (np.abs(error[-50:]).max() < 1e-6) == is_stable
    check_resonances(PRESET)


def test_a_slow_resonance_is_checked_for_all_of_its_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant keeps every command of the run, which is longer than a short default history."""
    monkeypatch.setattr(
        rehearsal, "SimulatedPlant", lambda *given, **more: SimulatedPlant(*given, **{"history": 16} | more)
    )
    x = Axis(resonance=2.0 * math.pi * 120.0, damping=0.3)
    check_resonances(dataclasses.replace(PRESET, control=Control(gain=0.1), axes=(x, Axis(), Axis())))
    slow = dataclasses.replace(PRESET, axes=(Axis(resonance=2.0 * math.pi * 0.4, damping=0.05), Axis(), Axis()))
    with pytest.raises(ValueError, match=r"slowest resonance, 0\.4 Hz, takes 250\d\d frames, more than 20000"):
        check_resonances(slow)


def test_the_plant_keeps_all_commands_of_the_longest_run() -> None:
    limits = dataclasses.replace(PRESET.tolerance, max_time=0.0205, max_refused=100)
    machine = dataclasses.replace(PRESET, tolerance=limits)
    for missing, is_kept in ((0, True), (1, False)):
        clock = SimulatedClock()
        clock.wait_until(0.005)
        plant = SimulatedPlant(start=(1.0, 0.0, 0.0), history=count_commands(machine) - missing)
        assert place_part(machine, np.zeros(3), plant, lambda *_: [], clock).frames == 21
        if is_kept:
            assert plant.pose(0.0)[0] == 1.0
        else:
            with pytest.raises(ValueError, match="before the history"):
                plant.pose(0.0)


def test_a_fixed_wait_releases_after_its_time() -> None:
    machine = dataclasses.replace(PRESET, settling=Settling(rule="fixed", wait=5e-3))
    placement, _ = _place(machine, np.array([90e-6, 0.0, 0.0]), (Axis(),) * 3)
    assert (placement.released, placement.frames, placement.predicted_frames) == (True, 6, 5)


def test_vibration_of_a_real_machine_must_be_known() -> None:
    machine, _ = _swinging(Settling(rule="vibration"), 5e-6)
    with pytest.raises(ValueError, match="find them by vibration_of_loop"):
        ReleaseRule(machine, make_observer(machine, np.zeros(3), 0.0))


class _HangingClock(SimulatedClock):
    """Clock of a computer that hangs for 8 ms at the third frame."""

    def __init__(self) -> None:
        super().__init__()
        self._calls = 0

    def wait_until(self, time: float) -> float:
        self._calls += 1
        return super().wait_until(time + (8e-3 if self._calls == 3 else 0.0))


@pytest.mark.parametrize("watchdog", [1.5, math.inf])
def test_the_watchdog_stops_the_head_while_the_computer_hangs(watchdog: float) -> None:
    # A gain without oscillation: the step response itself does not go beyond the target.
    machine = dataclasses.replace(PRESET, control=Control(gain=0.2, watchdog=watchdog))
    assert not machine.overshoot.any()
    plant = SimulatedPlant(start=(80e-6, 0.0, 0.0), watchdog=watchdog * machine.period)
    place_part(machine, np.zeros(3), plant, _sensor(plant, machine, is_noisy=False), _HangingClock())
    lowest = plant.pose(np.linspace(0.0, 0.02, 200))[:, 0].min()
    assert (lowest > -1e-6) == (watchdog == 1.5)


def test_the_predictor_knows_that_the_watchdog_stopped_the_head() -> None:
    """The command before the hang of 8 ms lasted for 1.5 ms: at the late frame the predicted motion is 0."""
    machine = dataclasses.replace(PRESET, control=Control(observer="smith", gain=0.3, watchdog=1.5))
    plant = SimulatedPlant(start=(80e-6, 0.0, 0.0), watchdog=1.5 * machine.period)
    sensor = _sensor(plant, machine, is_noisy=False)
    record = place_part(machine, np.zeros(3), plant, sensor, _HangingClock()).record
    assert record.time[2] == pytest.approx(10e-3)
    np.testing.assert_allclose(record.pose[2:], plant.pose(record.time[2:]), atol=1e-12)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observer": "luenberger"}, "observer is 'luenberger', expected one of latest, smith, kalman"),
        ({"controller": "lqr"}, "controller is 'lqr', expected one of p, pi, pid"),
        ({"integral": 1e-2}, 'integral needs the controller "pi" or "pid"'),
        ({"controller": "pi", "derivative": 1e-3}, 'derivative needs the controller "pid"'),
        ({"controller": "pid"}, "needs a velocity"),
        ({"observer": "kalman"}, "motion_sigma belongs to the observer"),
        ({"motion_sigma": MOTION}, "motion_sigma belongs to the observer"),
        ({"observer": "kalman", "motion_sigma": (0.0, 1.0, 1.0)}, "motion_sigma is 0"),
        ({"watchdog": 1.0}, "watchdog is 1.0 frames, expected above 1"),
    ],
)
def test_controls_that_cannot_work_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Control(**given)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rule": "wait"}, "rule is 'wait', expected one of response, vibration, fixed"),
        ({"rule": "fixed"}, "wait belongs to the rule"),
        ({"wait": 0.1}, "wait belongs to the rule"),
        ({"rule": "vibration", "frequency": (90.0, 0.0, 0.0)}, "belong together"),
        ({"rule": "vibration", "damping": (0.02,) * 3}, "belong together"),
        ({"frequency": (90.0, 0.0, 0.0), "damping": (0.02,) * 3}, 'belong to the rule "vibration"'),
        ({"miss_probability": 1e-6}, 'miss_probability and window belong to the rule "vibration"'),
        ({"rule": "fixed", "wait": 0.1, "window": 50}, 'miss_probability and window belong to the rule "vibration"'),
        ({"rule": "vibration", "frequency": (90.0, 0.0, 0.0), "damping": (0.8,) * 3}, "damping is 0.8"),
    ],
)
def test_release_rules_that_cannot_work_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Settling(**given)


@pytest.mark.parametrize("lag", [0.3e-3, 3e-3])
@pytest.mark.parametrize("control", [CONTROLS[0], CONTROLS[5]], ids=lambda each: each.observer)
def test_frames_of_axes_with_a_lag_are_those_of_theory(control: Control, lag: float) -> None:
    axes = (Axis(lag=lag),) * 3
    machine = dataclasses.replace(PRESET, control=dataclasses.replace(control, gain=None), axes=axes)
    error = _free_run(machine, np.array([50e-6, 0.0, 0.0]), 200, axes=axes)[:, 0] / 50e-6
    settled = int(np.flatnonzero(np.abs(error) > 0.02)[-1]) + 1
    # The theory takes the lag as a delay: 22 frames of the Kalman filter at 3 ms are 20 by theory.
    assert settled == pytest.approx(machine.frames_to(0.02), rel=0.15)


OVERSHOOTING = [
    Control(controller="pi"),
    Control(gain=0.5),
    Control(observer="smith", controller="pi", gain=0.4, integral=4e-3),
    Control(observer="smith", gain=1.6),
]


@pytest.mark.parametrize(
    "control",
    [
        pytest.param(each, id=name, marks=() if name.endswith("pi") else pytest.mark.slow)
        for each, name in zip(OVERSHOOTING, ("pi", "p", "smith-pi", "smith-p"), strict=True)
    ],
)
def test_missing_poses_stop_a_head_at_the_error_of_the_last_pose(control: Control) -> None:
    """The camera is blind from each of the frames of the step response on.

    The overshoot is allowed in frames with a new pose only: later the head moves on at most to the error of the last
    pose plus three standard deviations, or stands still where it is.
    """
    machine = dataclasses.replace(PRESET, control=control)
    start = np.array([80e-6, -60e-6, 4e-3])
    margin, period = 3.0 * np.sqrt(np.diag(COVARIANCE)), machine.period
    zone = np.array([machine.tolerance.landing_zone] * 2 + [machine.tolerance.landing_angle])
    passed = np.zeros(3)
    for last in range(14):
        plant = SimulatedPlant(start=start)
        sensor = SimulatedPoseSensor(
            plant.pose,
            period=period,
            delay=machine.delay.latency,
            covariance=COVARIANCE,
            is_noisy=False,
            fault=lambda frame, seen, last=last: [seen] if frame <= last else [],
        )
        placement = place_part(machine, np.zeros(3), plant, sensor, SimulatedClock())
        if placement.released:
            break
        seen = plant.pose(last * period - machine.delay.latency)
        answered = np.abs(plant.pose((last + 1) * period) - seen)  # by the command that answers the last pose
        times = np.linspace((last + 1) * period, placement.record.time[-1] + 10.0 * period, 300)
        moved = np.abs(plant.pose(times) - seen)
        # The plant counts time in ns: 0.1 nm at 0.1 m/s.
        assert np.all(moved <= np.maximum(answered, np.abs(seen) + margin) + 1e-3 * margin)
        passed = np.maximum(passed, (-plant.pose(times) * np.sign(start)).max(axis=0))
    assert last > 4
    assert np.all(passed <= machine.overshoot * zone + margin)
    assert np.any(passed > 2.0 * margin)  # an overshoot that trusted poses asked for


@pytest.mark.parametrize("lag", [0.3e-3, 2e-3])
@pytest.mark.parametrize("controller", ["p", "pi", "pid"])
def test_a_smith_predictor_with_axes_that_lag_follows_the_theory(controller: Any, lag: float) -> None:
    axes = (Axis(lag=lag),) * 3
    machine = dataclasses.replace(PRESET, control=Control(observer="smith", controller=controller), axes=axes)
    error = _free_run(machine, np.array([50e-6, 0.0, 0.0]), 60, axes=axes)[:, 0]
    np.testing.assert_allclose(error / 50e-6, machine.error_after(60)[:, 0], atol=1e-9)
    if controller == "p":
        assert not machine.overshoot.any()
        assert error.min() > -1e-12
        with pytest.raises(ValueError, match=rf"limit of stability for a lag of {1e3 * lag:.2f} frames"):
            dataclasses.replace(machine, control=Control(observer="smith", gain=5.0))


def test_a_smith_predictor_with_axes_that_lag_places_a_part() -> None:
    axes = (Axis(lag=0.5e-3), Axis(lag=1e-3), Axis())
    machine = dataclasses.replace(PRESET, control=Control(observer="smith"), axes=axes)
    start = np.array([80e-6, -60e-6, 3e-3])
    plant = SimulatedPlant(axes, start=start)
    placement = place_part(machine, np.zeros(3), plant, _sensor(plant, machine, is_noisy=True), SimulatedClock())
    assert placement.released
    rest = plant.pose(placement.record.time[-1] + 20e-3)
    assert np.hypot(*rest[:2]) < machine.tolerance.position
    assert abs(rest[2]) < machine.tolerance.angle
    slower = dataclasses.replace(machine, control=Control())
    # The true errors: the theory of the slower loop takes the longest lag as a delay of all axes.
    settled, later = (
        settled_frames(_free_run(each, start, 60, axes=axes), BAND, released=True) for each in (machine, slower)
    )
    assert settled == predicted_settling(machine, start, BAND)
    assert later is not None
    assert settled < later
    tolerated = model_tolerance(machine, cast(Any, None))
    assert tolerated is not None
    assert tolerated.plant_gain > 2.0


def test_a_fixed_wait_beyond_the_longest_time_is_refused() -> None:
    for wait in (1.0, 2.0):
        with pytest.raises(
            ValueError, match=rf"settling.wait is {wait} s, expected less than tolerance.max_time, 1.0 s"
        ):
            dataclasses.replace(PRESET, settling=Settling(rule="fixed", wait=wait))
    dataclasses.replace(PRESET, settling=Settling(rule="fixed", wait=0.999))


def test_refused_poses_are_not_counted_as_the_first_pose() -> None:
    """Three frames are refused, as by the coarse registration; the other frames are steered as without refusals."""
    plant = SimulatedPlant(start=(80e-6, 0.0, 0.0))
    sensor = _sensor(plant, PRESET, is_noisy=False)
    nothing = np.full((3, 3), np.nan)

    def late(time: float, _predicted: PosePrediction) -> list[PoseMeasurement]:
        found = sensor(time)
        return found if time > 2.5e-3 else [PoseMeasurement(time, time, nothing[0], nothing, int(Status.AMBIGUOUS))]

    placement = place_part(PRESET, np.zeros(3), plant, late, SimulatedClock())
    assert placement.released
    assert [each.status == 0 for each in placement.measurements[:4]] == [False, False, False, True]
    assert placement.first_pose == pytest.approx(3e-3, abs=1e-9)
    assert placement.steered_frames == placement.frames - 4 == placement.predicted_frames
    blind = place_part(PRESET, np.zeros(3), SimulatedPlant(), lambda *_: [], SimulatedClock())
    assert (blind.first_pose, blind.steered_frames) == (math.inf, 0)


def test_an_unstable_controller_and_a_swing_without_a_resonance_are_refused() -> None:
    with pytest.raises(ValueError, match=r"controller pi with gain 0.7, integral .* is not stable"):
        dataclasses.replace(PRESET, control=Control(controller="pi", gain=0.7, integral=3e-3))
    with pytest.raises(ValueError, match="swing needs an axis with a resonance"):
        dataclasses.replace(PRESET, swing=(1e-6, 0.0, 0.0))
    with pytest.raises(ValueError, match="swing needs an axis with a resonance"):
        SimulatedPlant(swing=(1e-6, 0.0, 0.0))
    # Skogestad's rule for a delay of 1.3 frames and half a frame for the hold.
    gains = dataclasses.replace(PRESET, control=Control(controller="pi")).gains
    delay = PRESET.delay.latency + 0.5e-3
    assert (gains.proportional, gains.integral) == pytest.approx((0.5 / delay, 8.0 * delay))
