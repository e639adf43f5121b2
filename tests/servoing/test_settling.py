"""Settling rule against a fixed wait, on moves with random vibrations and parts with different tolerances."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.stats import norm

from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidController, PidGains
from gpuvision.servoing.guard import Outcome
from gpuvision.servoing.loop import LoopRecord, ServoLoop, SimulatedClock
from gpuvision.servoing.observer import MotionModel, PoseMeasurement, PoseObserver, Verdict
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.settling import VibrationSettling, fit_vibration, vibration_of_loop
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PERIOD, SIGMA = 1e-3, 1e-6
FREQUENCY, DAMPING = 60.0, 0.05
LONGEST = 400


def swings(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the true errors (count, LONGEST) of x after moves of different lengths [m]."""
    amplitude = rng.uniform(2e-6, 80e-6, count)
    angle = 2.0 * math.pi * FREQUENCY * PERIOD * np.arange(LONGEST)
    envelope = np.exp(-DAMPING / math.sqrt(1.0 - DAMPING**2) * angle)
    offset = rng.normal(0.0, 0.5e-6, count)
    return offset[:, None] + amplitude[:, None] * envelope * np.cos(angle + rng.uniform(0, 6.28, count)[:, None])


def wait_by_rule(errors: np.ndarray, tolerance: float, rng: np.random.Generator) -> int:
    rule = VibrationSettling(
        (tolerance, 1e-3, 1e-3),
        frequency=(FREQUENCY, 0.0, 0.0),
        damping=(DAMPING,) * 3,
        miss_probability=0.02,
        is_filtered=False,
    )
    covariance = SIGMA**2 * np.eye(3)
    for frame, error in enumerate(errors):
        seen = np.array([error + SIGMA * rng.standard_normal(), 0.0, 0.0])
        if rule(frame * PERIOD, seen, covariance):
            return frame
    return LONGEST - 1


def compare(count: int, seed: int) -> tuple[float, float, float]:
    """Return the mean wait of the rule, the fixed wait with as many misplacements [frames], and the misplaced fraction.

    A part is misplaced if it leaves its tolerance at any time in the period of the swing after the contact.
    """
    rng = np.random.default_rng(seed)
    errors = swings(count, rng)
    tolerances = rng.choice([4e-6, 10e-6, 25e-6, 50e-6], count)
    period = math.ceil(1.0 / FREQUENCY / PERIOD)
    reach = np.array([np.abs(errors[:, k : k + period]).max(axis=1) for k in range(LONGEST - period)]).T
    misses = reach > tolerances[:, None]
    waits = np.array([wait_by_rule(each, limit, rng) for each, limit in zip(errors, tolerances, strict=True)])
    missed = float(np.mean(misses[np.arange(count), np.minimum(waits, misses.shape[1] - 1)]))
    fixed = int(np.flatnonzero(misses.mean(axis=0) <= max(missed, 1.0 / count))[0])
    return float(np.mean(waits)), float(fixed), missed


def test_rule_waits_30_percent_less_than_a_fixed_wait_with_as_many_misplacements() -> None:
    wait, fixed, missed = compare(30, 1)
    assert missed <= 0.05
    assert wait <= 0.7 * fixed


@pytest.mark.slow
def test_misplacements_are_as_few_as_asked_for() -> None:
    wait, fixed, missed = compare(500, 2)
    assert missed <= 0.03
    assert wait <= 0.7 * fixed


def test_wide_tolerance_waits_less() -> None:
    rng = np.random.default_rng(0)
    errors = swings(1, rng)[0]
    waits = [wait_by_rule(errors, tolerance, np.random.default_rng(3)) for tolerance in (3e-6, 10e-6, 30e-6, 90e-6)]
    assert waits == sorted(waits, reverse=True)
    assert waits[0] > waits[-1] + 20


def test_vibration_of_a_simulated_axis_is_identified() -> None:
    plant = SimulatedPlant((Axis(resonance=2 * math.pi * 75.0, damping=0.04), Axis(), Axis()))
    plant.command(0.0, np.array([0.1, 0.0, 0.0]))
    plant.command(0.02, np.zeros(3))
    times = 0.02 + PERIOD * np.arange(80)
    errors = plant.pose(times)[:, 0] - 2e-3
    found = fit_vibration(times, errors + 1e-7 * np.random.default_rng(0).standard_normal(80))
    assert found.frequency == pytest.approx(75.0 * math.sqrt(1 - 0.04**2), rel=1e-3)
    assert found.damping == pytest.approx(0.04, rel=0.02)
    assert found.offset == pytest.approx(0.0, abs=1e-7)
    assert found.residual == pytest.approx(1e-7, rel=0.3)
    angle = 2 * math.pi * found.frequency * (times - times[0])
    decay = np.exp(-found.damping / math.sqrt(1 - found.damping**2) * angle)
    assert found.offset + found.amplitude * decay * np.cos(angle + found.phase) == pytest.approx(errors, abs=3e-7)


def test_vibration_is_found_from_half_a_period_of_the_record_on() -> None:
    """A record of 0.9 periods whose last sample comes late: the scan starts at half a period per record."""
    times = np.r_[np.linspace(0.0, 0.1, 12), 0.9]
    found = fit_vibration(times, 3e-6 + 1e-5 * np.cos(2.0 * math.pi * times))
    assert found.frequency == pytest.approx(1.0, rel=1e-3)
    assert found.amplitude == pytest.approx(1e-5, rel=1e-2)
    assert found.residual < 1e-10


def test_rule_without_vibration_is_the_normal_distribution() -> None:
    """Four errors of 1 um, mean 2 um: a tolerance of 3 um is two standard deviations of the mean away."""
    rule = VibrationSettling((3e-6, 1.0, 1.0), is_filtered=False)
    for k in range(4):
        assert rule.miss_probability() == 1.0
        rule(k * PERIOD, np.array([2e-6, 0.0, 0.0]), SIGMA**2 * np.eye(3))
    assert rule.miss_probability() == pytest.approx(0.02275, rel=1e-3)


def test_short_window_does_not_settle() -> None:
    rule = VibrationSettling((1e-3,) * 3, frequency=(0.01, 0.0, 0.0))
    assert not any(rule(k * PERIOD, np.zeros(3), SIGMA**2 * np.eye(3)) for k in range(6))


def test_lead_lets_the_vibration_decay() -> None:
    errors = swings(1, np.random.default_rng(5))[0][:24]
    found = []
    for lead in (0.0, 0.2):
        rule = VibrationSettling((8e-6, 1.0, 1.0), frequency=(FREQUENCY,) * 3, damping=(DAMPING,) * 3, lead=lead)
        for k, error in enumerate(errors):
            rule(k * PERIOD, np.array([error, 0.0, 0.0]), SIGMA**2 * np.eye(3))
        found.append(rule.miss_probability())
    assert found[1] < found[0]


@pytest.mark.parametrize(
    ("given", "message"), [({"tolerance": (0.0, 1.0, 1.0)}, "tolerance is"), ({"damping": (1.0,) * 3}, "damping is")]
)
def test_rule_is_checked(given: dict[str, tuple[float, float, float]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        VibrationSettling(**({"tolerance": (1.0, 1.0, 1.0)} | given))


def test_fit_needs_samples() -> None:
    with pytest.raises(ValueError, match="8 samples"):
        fit_vibration([0.0, 1.0], [0.0, 1.0])


def swinging_loop(settling: VibrationSettling | None = None) -> tuple[LoopRecord, SimulatedPlant]:
    """Return a run of 0.3 mm in x whose payload swings at 90 Hz, and its plant."""
    plant = SimulatedPlant((Axis(resonance=2 * math.pi * 90.0, damping=0.05), Axis(), Axis()))
    noise = np.diag([1e-14, 1e-14, 1e-10])
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=2e-3, covariance=noise, seed=3)
    observer = PoseObserver(MotionModel(lag=(0.0,) * 3, position_noise=(1e-11,) * 3), gate=1e9)
    observer.reset(-0.01, np.zeros(3), 1e-12 * np.eye(3))
    controller = PidController(PidGains(proportional=100.0))
    loop = ServoLoop(plant, sensor, observer, controller, SimulatedClock(), period=PERIOD, limits=None)
    return loop.run((3e-4, 0.0, 0.0), 0.25, settling=settling), plant


def test_vibration_of_a_loop_is_that_of_its_payload() -> None:
    """The zero crossings of the true error give the frequency, the peaks the damping; the loop changes both."""
    record, plant = swinging_loop()
    found = vibration_of_loop(record, 0.08)
    times = np.arange(0.08, 0.2, 1e-4)
    error = plant.pose(times)[:, 0] - 3e-4
    up = np.flatnonzero((error[:-1] < 0.0) & (error[1:] >= 0.0))
    crossings = times[up] - error[up] * 1e-4 / (error[up + 1] - error[up])
    frequency = (len(up) - 1) / (crossings[-1] - crossings[0])
    peaks = [error[a:b].max() for a, b in itertools.pairwise(up)]
    decrement = math.log(peaks[0] / peaks[-1]) / (len(peaks) - 1)
    assert found.frequency[0] == pytest.approx(frequency, rel=2e-3)
    assert found.damping[0] == pytest.approx(decrement / math.hypot(decrement, 2 * math.pi), rel=0.03)
    assert abs(found.frequency[0] / 90.0 - 1.0) > 0.05
    assert found.frequency[1:].tolist() == [0.0, 0.0]
    assert found.damping[1:].tolist() == [0.02, 0.02]


@pytest.mark.parametrize("frequency", [0.0, 4.3])
def test_the_rest_of_the_step_response_is_no_vibration(frequency: float) -> None:
    """An error that decays, with or without one overshoot as that of a PI loop: a damped swing fits it."""
    times, rng = PERIOD * np.arange(100), np.random.default_rng(2)
    decay = np.exp(-times / 0.05) * np.cos(2.0 * math.pi * frequency * times)  # damping ratio 0.6 at 4.3 Hz
    errors = 5e-6 * decay[:, None] * [1.0, 0.0, 0.0] + 5e-8 * rng.standard_normal((100, 3))
    covariance = 1e-14 * np.eye(3)
    seen = tuple(
        (PoseMeasurement(time, time, -error, covariance, 0), Verdict.ACCEPTED)
        for time, error in zip(times.tolist(), errors, strict=True)
    )
    record = swinging_loop()[0]._replace(target=np.zeros((1, 3)), measurements=seen)
    assert vibration_of_loop(record, 0.0).frequency.tolist() == [0.0, 0.0, 0.0]


def test_rule_from_a_loop_settles_as_soon_as_the_swing_allows() -> None:
    """The steered head stays near the tolerance from then on; without the vibration it leaves it by a factor above 3.

    The model of the observer has no resonance: its estimate shows the swing 10 to 15 % smaller than it is.
    """
    tolerance = (6e-6, 1e-3, 1e-3)
    record, plant = swinging_loop()
    found = vibration_of_loop(record, 0.08)
    reach = []
    for rule in (VibrationSettling(tolerance, **found._asdict()), VibrationSettling(tolerance)):
        settled, _ = swinging_loop(rule)
        assert settled.outcome is Outcome.ARRIVED
        later = plant.pose(np.arange(settled.time[-1], 0.25, 5e-4))[:, 0] - 3e-4
        reach.append(np.abs(later).max() / tolerance[0])
    assert 0.6 < reach[0] < 1.2
    assert reach[1] > 3.0


def test_vibration_of_a_loop_needs_poses() -> None:
    with pytest.raises(ValueError, match="expected 8 or more; run the loop for longer"):
        vibration_of_loop(swinging_loop()[0], 0.244)


def test_rule_on_the_estimates_of_an_observer_keeps_its_probability() -> None:
    """A resting head just beyond the tolerance, and one at the target: the estimates share most of their noise."""
    rng, sigma, tolerance = np.random.default_rng(8), 10e-6, 12e-6

    def allows(true: float) -> bool:
        observer = PoseObserver(MotionModel(lag=(0.0,) * 3), gate=1e9)
        observer.reset(0.0, np.zeros(3), 1e-8 * np.eye(3))
        rule = VibrationSettling((tolerance, 1.0, 1.0), window=20)
        for k in range(1, 29):
            pose = np.array([true + sigma * rng.standard_normal(), 0.0, 0.0])
            observer.add(PoseMeasurement(k * PERIOD, k * PERIOD, pose, sigma**2 * np.eye(3), 0))
            state = observer.estimate(k * PERIOD)
            is_allowed = k > 8 and rule(k * PERIOD, -state.pose, state.covariance)
        return is_allowed

    assert sum(allows(1.05 * tolerance) for _ in range(40)) == 0
    assert sum(allows(0.0) for _ in range(8)) >= 6


def miss(
    samples: list[tuple[float, np.ndarray, np.ndarray]],
    tolerance: tuple[float, ...],
    *,
    frequency: tuple[float, ...],
    damping: tuple[float, ...],
    lead: float,
    is_filtered: bool,
) -> float:
    """Return the probability of a miss by a weighted pseudo-inverse and the normal distribution."""
    total = 0.0
    for axis in range(3):
        sigmas = np.array([math.sqrt(covariance[axis, axis]) for _, _, covariance in samples])
        rate = damping[axis] / math.sqrt(1.0 - damping[axis] ** 2)  # decay per radian of the swing
        rows = []
        for time, _, _ in samples:
            angle = 2.0 * math.pi * frequency[axis] * (time - samples[-1][0])
            swing = [math.exp(-rate * angle) * part for part in (math.cos(angle), math.sin(angle))]
            rows.append([1.0, *swing] if frequency[axis] else [1.0])
        weights = np.linalg.pinv(np.array(rows) / sigmas[:, None], rcond=1e-12) / sigmas
        fit = weights @ np.array([error[axis] for _, error, _ in samples])
        fading = math.exp(-rate * 2.0 * math.pi * frequency[axis] * lead)
        worst = abs(fit[0]) + (fading * math.hypot(*fit[1:]) if len(fit) > 1 else 0.0)
        spread = np.abs(weights) @ sigmas if is_filtered else np.sqrt(np.square(weights) @ np.square(sigmas))
        swing_spread = fading * math.hypot(*spread[1:]) / math.sqrt(2.0) if len(fit) > 1 else 0.0
        sigma = spread[0] + swing_spread if is_filtered else math.hypot(spread[0], swing_spread)
        total += norm.sf((tolerance[axis] - worst) / sigma) + norm.cdf((-tolerance[axis] - worst) / sigma)
    return total


@pytest.mark.parametrize("is_filtered", [True, False])
@pytest.mark.parametrize("lead", [0.0, 3e-3])
def test_miss_probability_is_that_of_offset_and_envelope(is_filtered: bool, lead: float) -> None:
    """Errors with a noise that grows, on three axes of which two swing; the window keeps the last six errors."""
    frequency, damping, tolerance = (70.0, 0.0, 40.0), (0.03, 0.02, 0.2), (2.5e-5, 6e-6, 7e-5)
    rule = VibrationSettling(
        tolerance, frequency=frequency, damping=damping, window=6, lead=lead, is_filtered=is_filtered
    )
    rng, samples, probabilities = np.random.default_rng(6), [], []
    for k in range(11):
        time = 0.7 + PERIOD * (k + 0.3 * math.sin(k))
        mean = np.array([3e-6 * math.cos(0.4 * k), -2e-6, 2e-5 * math.sin(0.25 * k)])
        covariance = np.diag([1e-12, 3e-12, 2e-11]) * (1.0 + 0.2 * k) + 1e-13
        samples.append((time, mean + np.sqrt(np.diag(covariance)) * rng.standard_normal(3), covariance))
        rule(*samples[-1])
        if k >= 3:
            known = miss(
                samples[-6:], tolerance, frequency=frequency, damping=damping, lead=lead, is_filtered=is_filtered
            )
            assert rule.miss_probability() == pytest.approx(known, rel=1e-6)
            probabilities.append(known)
    assert probabilities[-1] < 0.9


def test_placement_is_allowed_at_the_probability_itself() -> None:
    rules = [VibrationSettling((3e-6, 1.0, 1.0), is_filtered=False) for _ in range(3)]
    for k in range(4):
        rules[0](k * PERIOD, np.array([2e-6, 0.0, 0.0]), SIGMA**2 * np.eye(3))
    found = rules[0].miss_probability()
    for factor, is_allowed in ((1.0, True), (1.0 - 1e-9, False)):
        rule = VibrationSettling((3e-6, 1.0, 1.0), is_filtered=False, miss_probability=factor * found)
        allowed = [rule(k * PERIOD, np.array([2e-6, 0.0, 0.0]), SIGMA**2 * np.eye(3)) for k in range(4)]
        assert allowed == [False, False, False, is_allowed]


def test_default_window_has_24_errors() -> None:
    """An error of 1 mm counts until 24 others came."""
    rule = VibrationSettling((1e-4, 1.0, 1.0), is_filtered=False)
    allowed = [rule(k * PERIOD, np.array([1e-3 * (k == 0), 0.0, 0.0]), SIGMA**2 * np.eye(3)) for k in range(26)]
    found = rule.miss_probability()
    assert allowed[24:] == [True, True]
    assert found < 1e-9
    short = VibrationSettling((3.8e-5, 1.0, 1.0), is_filtered=False)
    allowed = [short(k * PERIOD, np.array([1e-3 * (k == 0), 0.0, 0.0]), SIGMA**2 * np.eye(3)) for k in range(25)]
    assert allowed == [False] * 24 + [True]  # a mean of 1 mm / 24, 41.7 um, is beyond the tolerance


@pytest.mark.parametrize(
    ("time", "error", "message"),
    [
        (np.arange(7.0), np.arange(7.0), r"shapes \(7,\) and \(7,\), expected 8 samples"),
        (np.arange(8.0), np.arange(9.0), r"shapes \(8,\) and \(9,\)"),
        (np.zeros((8, 1)), np.zeros((8, 1)), r"shapes \(8, 1\)"),
        (np.arange(8.0) % 7.0, np.arange(8.0), "time must increase"),
        (np.r_[0.0, np.arange(7.0)], np.arange(8.0), "time must increase"),
        (np.r_[np.arange(7.0), np.inf], np.arange(8.0), "must be finite"),
        (np.arange(8.0), np.r_[np.arange(7.0), np.nan], "must be finite"),
    ],
)
def test_samples_of_a_fit_are_checked(time: np.ndarray, error: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_vibration(time, error)


@pytest.mark.parametrize(("damping", "phase"), [(0.3, 2.0), (0.6, -1.0), (0.01, 3.0)])
def test_fit_of_eight_exact_samples_gives_back_the_swing(damping: float, phase: float) -> None:
    times = 2.0 + np.linspace(0.0, 1.1, 8)
    angle = 2.0 * math.pi * (times - 2.0)
    swing = np.exp(-damping / math.sqrt(1.0 - damping**2) * angle) * np.cos(angle + phase)
    found = fit_vibration(times, -4.0 + 3.0 * swing, damping=0.8 * damping)
    assert found[:5] == pytest.approx((-4.0, 3.0, phase, 1.0, damping), rel=1e-3)
    assert found.residual < 1e-5
