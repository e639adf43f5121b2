"""Observer with delayed measurements, against a filter that gets the same measurements in order and without delay."""

from __future__ import annotations

import itertools
import math
import time as clock
from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.stats import chi2

from gpuvision.servoing.observer import LatestPose, MotionModel, Observer, PoseMeasurement, PoseObserver, Verdict

NOISE = np.array([[4.0, 1.0, 0.5], [1.0, 3.0, -0.2], [0.5, -0.2, 2.0]]) * 1e-12
MODEL = MotionModel(lag=(2e-3, 0.0, 5e-3), acceleration_noise=(1e-3, 0.0, 1e-2), position_noise=(0.0, 1e-9, 1e-12))
FREE = MotionModel(acceleration_noise=(1e-3, 1e-3, 1e-2))


def measured(exposed: float, pose: npt.ArrayLike, arrived: float | None = None, status: int = 0) -> PoseMeasurement:
    when = exposed if arrived is None else arrived
    return PoseMeasurement(exposed, when, np.array(pose, np.float64), NOISE, status)


def van_loan(lag: float | None, density: float, step: float) -> tuple[npt.NDArray[np.float64], ...]:
    """Return transition, command and noise of one axis by quadrature of the matrix exponential."""
    matrix = np.array([[0.0, 1.0], [0.0, 0.0 if lag is None else -1.0 / lag]])
    inputs = np.array([0.0, 0.0 if lag is None else 1.0 / lag])

    def integral(of: object) -> npt.NDArray[np.float64]:
        shape = np.shape(of(0.0))
        parts = [quad(lambda t, k=k: np.ravel(of(t))[k], 0.0, step, epsabs=0.0)[0] for k in range(np.prod(shape))]
        return np.array(parts).reshape(shape)

    impulse = np.array([0.0, 1.0])
    noise = integral(lambda t: density * np.outer(expm(matrix * t) @ impulse, expm(matrix * t) @ impulse))
    return expm(matrix * step), integral(lambda t: expm(matrix * t) @ inputs), noise


@pytest.mark.parametrize(("lag", "step"), [(None, 3e-3), (2e-3, 3e-3), (5e-2, 4e-4), (1.0, 1e-3)])
def test_transition_is_the_matrix_exponential(lag: float | None, step: float) -> None:
    model = MotionModel(lag=None if lag is None else (lag,) * 3, acceleration_noise=(2.0, 3.0, 5.0))
    state, command, noise = model.transition(step)
    for axis, density in enumerate((2.0, 3.0, 5.0)):
        pick = np.ix_([axis, axis + 3], [axis, axis + 3])
        expected = van_loan(lag, density, step)
        assert state[pick] == pytest.approx(expected[0], rel=1e-12, abs=1e-15)
        assert command[[axis, axis + 3], axis] == pytest.approx(expected[1], rel=1e-8, abs=1e-18)
        assert noise[pick] == pytest.approx(expected[2], rel=1e-7)


@pytest.mark.parametrize("ratio", [1e-4, 2e-3, 0.0099, 0.0101, 0.3])
def test_noise_of_a_short_step_keeps_its_digits(ratio: float) -> None:
    """In rational numbers: x - 2 (1 - exp(-x)) + (1 - exp(-2 x)) / 2 by the series of the exponential function."""
    x = Fraction(ratio)
    exact = sum((-1) ** (n + 1) * (2 ** (n - 1) - 2) * x**n / math.factorial(n) for n in range(3, 16))
    _, _, noise = MotionModel(lag=(0.02,) * 3, acceleration_noise=(2.0, 3.0, 5.0)).transition(0.02 * ratio)
    # The series of three terms lacks x^6 / 24, less than 1.3e-7 of x^3 / 3 below 0.01.
    assert noise[1, 1] == pytest.approx(3.0 * 0.02**3 * float(exact), rel=2e-7)


def test_transition_without_lag_follows_the_command() -> None:
    state, command, noise = MODEL.transition(2e-3)
    assert state[1].tolist() == [0, 1, 0, 0, 0, 0]
    assert command[[1, 4], 1].tolist() == [2e-3, 1.0]
    assert noise[1, 1] == pytest.approx(2e-12)
    assert noise[4, 4] == 0.0


def drive(observer: PoseObserver, events: list[tuple[float, object]]) -> None:
    for time, what in events:
        if isinstance(what, PoseMeasurement):
            observer.add(what)
        else:
            observer.command(time, np.array(what))


def scene(seed: int = 3) -> tuple[list[tuple[float, object]], list[PoseMeasurement]]:
    """Return commands at each millisecond, and measurements of a random path between them."""
    rng = np.random.default_rng(seed)
    commands = [(1e-3 * k, rng.normal(0.0, 1e-3, 3)) for k in range(40)]
    times = 1e-3 * np.arange(39) + rng.uniform(1e-4, 9e-4, 39)
    return list(commands), [measured(float(t), rng.normal(0.0, 2e-6, 3)) for t in times]


def fresh(model: MotionModel = MODEL, **given: float) -> PoseObserver:
    observer = PoseObserver(model, **given)
    observer.reset(0.0, np.zeros(3), 1e-10 * np.eye(3))
    return observer


@pytest.mark.parametrize("model", [MODEL, FREE])
@pytest.mark.parametrize("shuffle", range(3))
def test_any_order_gives_the_state_of_the_right_order(model: MotionModel, shuffle: int) -> None:
    commands, measurements = scene()
    ordered = fresh(model, gate=1e9)
    drive(ordered, sorted([*commands, *((each.exposed, each) for each in measurements)], key=lambda each: each[0]))
    expected = ordered.estimate(0.05)

    late = fresh(model, gate=1e9)
    delays = np.random.default_rng(shuffle).integers(1, 9, len(measurements)) * 1e-3
    arriving = [(each.exposed + float(d), each) for each, d in zip(measurements, delays, strict=True)]
    # A measurement is added at the next command after its arrival.
    for time, velocity in [*commands, *((1e-3 * k, commands[-1][1]) for k in range(40, 50))]:
        for arrived, each in arriving:
            if time - 1e-3 < arrived <= time:
                assert late.add(each) is Verdict.ACCEPTED
        late.command(time, np.asarray(velocity))
    found = late.estimate(0.05)
    assert found.pose == pytest.approx(expected.pose, rel=1e-9, abs=1e-15)
    assert found.velocity == pytest.approx(expected.velocity, rel=1e-9, abs=1e-13)
    assert found.covariance == pytest.approx(expected.covariance, rel=1e-9, abs=1e-22)


def test_a_static_head_gives_the_weighted_mean() -> None:
    """Without process noise the filter is the least-squares mean of prior and measurements."""
    observer = fresh(MotionModel(lag=(0.0, 0.0, 0.0)), gate=1e9)
    poses = np.random.default_rng(1).normal(0.0, 3e-6, (6, 3))
    for k, pose in enumerate(poses):
        assert observer.add(measured(1e-3 * (k + 1), pose)) is Verdict.ACCEPTED
    information = 6 * np.linalg.inv(NOISE) + np.eye(3) / 1e-10
    found = observer.estimate(0.02)
    assert found.covariance == pytest.approx(np.linalg.inv(information), rel=1e-9)
    mean = np.linalg.solve(information, np.linalg.inv(NOISE) @ poses.sum(axis=0))
    assert found.pose == pytest.approx(mean, rel=1e-9)


def test_verdicts() -> None:
    observer = fresh(history=4)
    assert observer.add(measured(1e-3, np.zeros(3), status=8)) is Verdict.REFUSED
    assert observer.add(measured(1e-3, [np.nan, 0.0, 0.0])) is Verdict.REFUSED
    assert observer.add(measured(2e-3, np.zeros(3), arrived=1e-3)) is Verdict.REFUSED
    assert observer.add(measured(1e-3, np.zeros(3))._replace(covariance=np.zeros((3, 3)))) is Verdict.REFUSED
    assert observer.add(measured(1e-3, np.zeros(3))) is Verdict.ACCEPTED
    before = observer.estimate(2e-3)
    assert observer.add(measured(1e-3, np.zeros(3))) is Verdict.DUPLICATE
    assert observer.add(measured(2e-3, [1e-3, 0.0, 0.0])) is Verdict.GATED
    after = observer.estimate(2e-3)
    assert np.array_equal(before.pose, after.pose)
    assert np.array_equal(before.covariance, after.covariance)
    for k in range(3, 8):
        observer.command(1e-3 * k, np.zeros(3))
    assert observer.add(measured(1.5e-3, np.zeros(3))) is Verdict.TOO_OLD
    assert observer.add(measured(4.5e-3, np.zeros(3))) is Verdict.ACCEPTED


def test_reset_forgets_the_measurements() -> None:
    """The history has been full and has moved to the front of its arrays."""
    observer, new = fresh(history=4), fresh(history=4)
    for k in range(1, 30):
        observer.add(measured(1e-3 * k, np.zeros(3)))
    for each in (observer, new):
        each.reset(0.5, [1e-3, 2e-3, 3e-3], 1e-10 * np.eye(3))
        assert math.isinf(each.exposed)
        assert each.predicted_pose(0.5) is None
        assert each.add(measured(0.5, [1.001e-3, 2.002e-3, 3e-3])) is Verdict.ACCEPTED
        assert each.exposed == 0.5
    one, other = observer.estimate(0.51), new.estimate(0.51)
    np.testing.assert_array_equal(one.pose, other.pose)
    np.testing.assert_array_equal(one.covariance, other.covariance)


def test_time_runs_forward() -> None:
    observer = fresh()
    observer.command(2e-3, np.ones(3))
    with pytest.raises(ValueError, match="before the last entry"):
        observer.command(1e-3, np.ones(3))
    with pytest.raises(ValueError, match="before the last entry"):
        observer.estimate(1e-3)


def test_angle_wraps() -> None:
    observer = fresh(MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(1e-9,) * 3))
    observer.reset(0.0, [0.0, 0.0, np.pi - 1e-6], 1e-10 * np.eye(3))
    assert observer.add(measured(1e-3, [0.0, 0.0, -np.pi + 1e-6])) is Verdict.ACCEPTED
    assert observer.estimate(1e-3).pose[2] == pytest.approx(np.pi + 1e-6, abs=1e-6)


def test_gate_passes_999_of_1000() -> None:
    rng = np.random.default_rng(2)
    observer = fresh(MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(1e-9,) * 3))
    truth = rng.multivariate_normal(np.zeros(3), 1e-10 * np.eye(3))
    verdicts = []
    for k in range(1, 1001):
        truth += rng.normal(0.0, 1e-6, 3)  # sqrt(1e-9 m^2/s * 1 ms)
        verdicts.append(observer.add(measured(1e-3 * k, rng.multivariate_normal(truth, NOISE))))
        observer.command(1e-3 * k, np.zeros(3))
    assert verdicts.count(Verdict.ACCEPTED) >= 993  # 1 expected beyond the gate; 8 have a probability of 1e-5


def test_memory_is_bounded_and_an_update_is_fast() -> None:
    """A measurement that is 5 frames old, 1000 times: the arrays do not grow."""
    observer = fresh(MODEL, history=64, gate=1e9)
    arrays = [id(each) for each in observer._arrays]
    durations = []
    for k, velocity in zip(range(1, 1001), itertools.cycle(np.eye(3) * 1e-4), strict=False):
        observer.command(1e-3 * k, velocity)
        start = clock.process_time()
        observer.add(measured(1e-3 * k - 4.5e-3, np.zeros(3)))
        observer.estimate(1e-3 * k)
        durations.append(clock.process_time() - start)
    assert [id(each) for each in observer._arrays] == arrays
    assert len(observer._times) == 128
    assert observer._end - observer._first == 64
    # About 0.1 ms on the loaded test machine; twenty times that fails only if the cost grows with the history.
    assert np.median(durations[500:]) < 2e-3


def test_latest_pose_keeps_the_newest_exposure() -> None:
    latest = LatestPose()
    assert latest.add(measured(2e-3, [1.0, 2.0, 3.0])) is Verdict.ACCEPTED
    assert latest.add(measured(1e-3, [0.0, 0.0, 0.0])) is Verdict.TOO_OLD
    assert latest.add(measured(2e-3, [0.0, 0.0, 0.0])) is Verdict.DUPLICATE
    assert latest.add(measured(3e-3, [np.nan, 0.0, 0.0])) is Verdict.REFUSED
    assert latest.estimate(9e-3).pose.tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("other", [1.0, -1.0, 2.0])
@pytest.mark.parametrize("observer", [PoseObserver(MotionModel()), LatestPose()])
def test_covariance_must_be_positive_definite(observer: Observer, other: float) -> None:
    """Correlations 1 of all axes are singular, -1 and 2 are indefinite."""
    observer.reset(-1.0, np.zeros(3), np.zeros((3, 3)))
    covariance = 1e-12 * (np.eye(3) + other * (np.ones((3, 3)) - np.eye(3)))
    assert observer.add(PoseMeasurement(0.0, 0.1, np.zeros(3), covariance, 0)) is Verdict.REFUSED
    units = np.diag([1e-7, 1.0, 1e-3]) * 1e-5
    valid = units @ (np.eye(3) + 0.9 * (np.ones((3, 3)) - np.eye(3))) @ units
    assert observer.add(PoseMeasurement(0.0, 0.1, np.zeros(3), valid, 0)) is Verdict.ACCEPTED


@pytest.mark.parametrize("observer", [PoseObserver(MotionModel()), LatestPose()])
def test_each_correlation_of_a_covariance_counts(observer: Observer) -> None:
    """The third coordinate is a sum of the other two, or of one of them: the matrix is singular to rounding."""
    for third in ((1.0, 0.0), (0.0, 1.0), (0.6, 0.8), (0.6, -0.8)):
        for share, verdict in ((1.0, Verdict.REFUSED), (0.999, Verdict.ACCEPTED)):
            factor = np.eye(3)
            factor[2] = [share * third[0], share * third[1], math.sqrt(1.0 - share**2)]
            for units in (np.eye(3), np.diag([2.0, 1.0, 5.0])):
                observer.reset(-1.0, np.zeros(3), np.zeros((3, 3)))
                covariance = 1e-12 * units @ factor @ factor.T @ units
                assert observer.add(PoseMeasurement(0.0, 0.1, np.zeros(3), covariance, 0)) is verdict


def test_transitions_of_jittering_times_are_dropped_one_by_one() -> None:
    """A loop with jitter never frees many of them in one frame: that took 3 to 6 ms every 2200 frames."""
    observer, kept = PoseObserver(MODEL), [0]
    observer.reset(0.0, np.zeros(3), 1e-12 * np.eye(3))
    for frame in range(5000):
        observer.estimate(1e-3 + 1e-9 * frame)
        kept.append(len(observer._transitions))
    assert min(np.diff(kept)) >= 0
    assert kept[-1] < 1000


def test_default_gate_is_exceeded_with_a_probability_of_one_in_a_thousand() -> None:
    """The pose is at rest, with the covariance of the start: a residual along an eigenvector of the sum of both."""
    values, vectors = np.linalg.eigh(1e-10 * np.eye(3) + NOISE)
    for axis in range(3):
        for factor, verdict in ((0.9995, Verdict.ACCEPTED), (1.0005, Verdict.GATED)):
            observer = fresh(MotionModel(lag=(0.0, 0.0, 0.0)))
            pose = vectors[:, axis] * math.sqrt(factor * chi2.isf(1e-3, 3) * values[axis])
            assert observer.add(measured(1e-3, pose)) is verdict


@pytest.mark.parametrize("away", [-0.5e-9, 0.5e-9])
def test_times_within_a_nanosecond_are_the_same(away: float) -> None:
    observer, same = fresh(), 5e-3 + away
    observer.command(5e-3, np.array([1.0, 2.0, 3.0]))
    observer.command(same, np.array([-1.0, 0.5, 2.0]))  # replaces the command
    assert observer.estimate(6e-3).pose[1] == pytest.approx(0.5e-3)
    assert observer.add(measured(2e-3, np.zeros(3))) is Verdict.ACCEPTED
    assert observer.add(measured(2e-3 + away, np.zeros(3))) is Verdict.DUPLICATE
    assert observer.add(measured(2e-3 + 4.0 * away, np.zeros(3))) is Verdict.ACCEPTED
    assert observer.estimate(5e-3 - 0.5e-9).pose[1] == pytest.approx(observer.estimate(5e-3).pose[1], abs=1e-8)
    fresh_one = fresh()
    assert fresh_one.add(measured(-0.5e-9, np.zeros(3))) is Verdict.ACCEPTED
    assert fresh_one.add(measured(-2e-9, np.zeros(3))) is Verdict.TOO_OLD
    assert fresh_one.predicted_pose(-0.5e-9) is not None
    assert fresh_one.predicted_pose(-2e-9) is None


@pytest.mark.parametrize("count", [2, 3, 5])
def test_history_keeps_the_newest_entries(count: int) -> None:
    """After many commands a measurement is taken from the oldest kept one on, wherever the arrays have moved."""
    for last in range(count, 4 * count):
        observer = fresh(history=count)
        for k in range(1, last + 1):
            observer.command(1e-3 * k, np.zeros(3))
        oldest = 1e-3 * (last - count + 1)
        assert observer.predicted_pose(oldest) is None  # no measurement yet
        assert observer.add(measured(oldest - 1e-6, np.zeros(3))) is Verdict.TOO_OLD
        assert observer.add(measured(oldest + 1e-6, np.zeros(3))) is Verdict.ACCEPTED


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_leaves_the_observer_as_it_was(wrong: float) -> None:
    observer, other = PoseObserver(MODEL), PoseObserver(MODEL)
    for each in (observer, other):
        each.reset(0.0, np.zeros(3), NOISE)
        each.command(1e-3, np.array([1e-2, 2e-2, -1e-2]))
    for axis in range(3):
        velocity = np.zeros(3)
        velocity[axis] = wrong
        with pytest.raises(ValueError, match="expected finite numbers"):
            observer.command(2e-3, velocity)
    with pytest.raises(ValueError, match="expected finite numbers"):
        observer.command(wrong, np.zeros(3))
    for given, expected in zip(observer.estimate(3e-3), other.estimate(3e-3), strict=True):
        np.testing.assert_array_equal(given, expected)


@pytest.mark.parametrize(("correlation", "factor"), [(0.0, 1.0), (0.5, 1.4), (0.9, 1.8)])
def test_errors_that_are_correlated_from_frame_to_frame(correlation: float, factor: float) -> None:
    """The factors of the docstring: root of the mean squared error over the predicted variance, to 10 %."""
    rng, step, noise, density = np.random.default_rng(7), 2e-3, 1e-6, 1e-6
    transition, _, motion = MotionModel(lag=(0.02,) * 3, acceleration_noise=(density,) * 3).transition(step)
    root = np.linalg.cholesky(motion)
    squares = []
    for _ in range(10):
        observer = PoseObserver(MotionModel(lag=(0.02,) * 3, acceleration_noise=(density,) * 3))
        observer.reset(0.0, np.zeros(3), noise**2 * np.eye(3))
        state, error = np.zeros(6), rng.normal(0.0, noise, 3)
        for k in range(1, 300):
            state = transition @ state + root @ rng.normal(size=6)
            error = correlation * error + math.sqrt(1.0 - correlation**2) * rng.normal(0.0, noise, 3)
            observer.add(PoseMeasurement(k * step, k * step, state[:3] + error, noise**2 * np.eye(3), 0))
            found = observer.estimate(k * step)
            if k > 50:
                away = found.pose - state[:3]
                squares.append(away @ np.linalg.solve(found.covariance, away) / 3.0)
    assert math.sqrt(np.mean(squares)) == pytest.approx(factor, rel=0.1)


def test_a_measurement_takes_the_command_before_it() -> None:
    """Two measurements in a frame: the motion after them is that of the command, up to the next one."""
    model = MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(1e9,) * 3)  # each measurement counts alone
    observer = fresh(model, gate=1e99)
    for time, velocity in ((1.0, (1.0, -2.0, 0.25)), (2.0, (3.0, 5.0, -0.5))):
        observer.command(time, np.array(velocity))
    for time, pose in ((1.6, [9.0, 8.0, 0.5]), (1.2, [4.0, 3.0, 1.0])):
        assert observer.add(measured(time, pose, arrived=3.0)) is Verdict.ACCEPTED
    np.testing.assert_allclose(observer.predicted_pose(1.4), [4.2, 2.6, 1.05], atol=1e-12)
    np.testing.assert_allclose(observer.predicted_pose(1.8), [9.2, 7.6, 0.55], atol=1e-12)
    found = observer.estimate(2.5)
    np.testing.assert_allclose(found.pose, [9.0 + 0.4 + 1.5, 8.0 - 0.8 + 2.5, 0.5 + 0.1 - 0.25], atol=1e-12)
    np.testing.assert_allclose(found.velocity, [3.0, 5.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(found.covariance, NOISE + 0.9e9 * np.eye(3), rtol=1e-12)
    assert (found.time, observer.exposed) == (2.5, 1.6)


def test_latest_pose_has_no_motion() -> None:
    latest = LatestPose()
    latest.reset(1.0, [1.0, 2.0, 3.0], 2.0 * NOISE)
    assert latest.add(measured(1.0, np.zeros(3))) is Verdict.DUPLICATE
    assert latest.add(measured(0.5, np.zeros(3))) is Verdict.TOO_OLD
    latest.command(2.0, np.ones(3))
    found = latest.estimate(7.0)
    assert (found.time, latest.exposed) == (7.0, 1.0)
    assert (found.pose.tolist(), found.velocity.tolist()) == ([1.0, 2.0, 3.0], [0.0, 0.0, 0.0])
    np.testing.assert_array_equal(found.covariance, 2.0 * NOISE)
    assert latest.predicted_pose(9.0).tolist() == [1.0, 2.0, 3.0]


@pytest.mark.parametrize("name", ["lag", "acceleration_noise", "position_noise"])
@pytest.mark.parametrize("wrong", [(0.0, -1.0, 0.0), (0.0, 0.0, math.inf), (0.0, 0.0)])
def test_models_of_motion_are_checked(name: str, wrong: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match=name):
        MotionModel(**{name: wrong})
