"""Measured delay on synthetic recordings with a planted delay, and on the data of a running loop."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.servoing import delay_measurement
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.delay_measurement import MeasuredDelay, chirp, excitation, measure_delay
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

PERIOD = 1e-3
SPEED = 0.02  # 20 um a frame


def recording(
    delay: float, jitter: float, noise: float, *, count: int = 400, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    time = PERIOD * np.arange(count)
    command = np.concatenate([[0.0], np.cumsum(excitation(count - 1, SPEED, seed=seed)) * PERIOD])
    late = delay + jitter * rng.standard_normal(count)
    measured = 0.97 * np.interp(time - late, time, command) + 3e-3 + noise * rng.standard_normal(count)
    return time, command, measured


@pytest.mark.parametrize(
    ("delay", "jitter"), [(0.4e-3, 0.0), (3.37e-3, 0.0), (0.9e-3, 0.2e-3), (8.9e-3, 0.2e-3), (2e-3, 0.6e-3)]
)
def test_delay_is_found_to_a_tenth_of_a_frame(delay: float, jitter: float) -> None:
    found = measure_delay(*recording(delay, jitter, 1e-6))
    assert abs(found.mean - delay) < 0.1 * PERIOD
    assert abs(found.mean - delay) < 4.0 * found.mean_sigma
    assert found.frames == pytest.approx(found.mean / PERIOD)
    assert found.scale == pytest.approx(0.97, abs=0.01)
    assert found.noise == pytest.approx(1e-6, rel=0.35)
    if jitter:
        assert abs(found.jitter - jitter) < 4.0 * found.jitter_sigma
        assert found.jitter == pytest.approx(jitter, rel=0.25)
        assert np.std(found.delays) == pytest.approx(jitter, rel=0.3)
        assert np.mean(found.delays) == pytest.approx(delay, abs=4.0 * jitter / np.sqrt(len(found.delays)))
        assert len(found.delays) > 100
    else:
        assert found.jitter < 0.05 * PERIOD
        assert (found.jitter_sigma == np.inf) == (found.jitter == 0.0) == (len(found.delays) == 0)


@pytest.mark.slow
def test_uncertainty_covers_the_error() -> None:
    """Errors of 24 recordings in units of their predicted sigma: the mean square is 1."""
    runs: list[MeasuredDelay] = [measure_delay(*recording(2.6e-3, 3e-4, 3e-6, count=250, seed=k)) for k in range(24)]
    mean = np.array([(each.mean - 2.6e-3) / each.mean_sigma for each in runs])
    jitter = np.array([(each.jitter - 3e-4) / each.jitter_sigma for each in runs])
    # 24 squares of a unit normal: mean 1, standard deviation 0.29.
    assert 0.4 < np.mean(mean**2) < 2.0
    assert 0.3 < np.mean(jitter**2) < 2.2


def _check_sigma_of_a_whole_delay(runs: int) -> None:
    """Errors at a delay of whole frames, at which each corner of the command meets a sample."""
    errors = []
    for seed in range(runs):
        rng = np.random.default_rng(5100 + seed)  # the jitter is independent of the command
        time = PERIOD * np.arange(600)
        command = np.concatenate([[0.0], np.cumsum(excitation(599, SPEED / 2.0, seed=100 + seed)) * PERIOD])
        late = 2e-3 + 0.15e-3 * rng.standard_normal(600)
        measured = np.interp(time - late, time, command) + 1e-7 * rng.standard_normal(600)
        found = measure_delay(time, command, measured, longest=0.02)
        errors.append((found.mean - 2e-3) / found.mean_sigma)
    # The mean of squares of a unit normal has a standard deviation of the root of 2 / runs.
    assert np.mean(np.square(errors)) == pytest.approx(1.0, abs=2.5 * np.sqrt(2.0 / runs))


def test_uncertainty_covers_the_error_of_a_whole_delay() -> None:
    _check_sigma_of_a_whole_delay(10)


@pytest.mark.nightly
def test_uncertainty_covers_the_error_of_a_whole_delay_in_100_recordings() -> None:
    _check_sigma_of_a_whole_delay(100)


def test_missing_frames_and_a_chirp(monkeypatch: pytest.MonkeyPatch) -> None:
    time = PERIOD * np.arange(500)
    command = chirp(500, PERIOD, 1e-3, 2.0, 60.0)
    rng = np.random.default_rng(1)
    measured = np.interp(time - 4.2e-3, time, command) + 1e-6 * rng.standard_normal(500)
    measured[rng.random(500) < 0.3] = np.nan
    found = measure_delay(time, command, measured)
    assert abs(found.mean - 4.2e-3) < 1e-5
    assert found.converged
    monkeypatch.setattr(delay_measurement, "_MAX_ITERATIONS", 3)
    assert not measure_delay(time, command, measured).converged


def test_delay_of_a_running_loop() -> None:
    """Commands and poses of a simulated machine whose axis follows at once, with a camera of 1 kHz and 2.6 ms."""
    plant = SimulatedPlant((Axis(), Axis(), Axis()))
    sensor = SimulatedPoseSensor(plant.pose, period=PERIOD, delay=2.6e-3, covariance=1e-13 * np.eye(3))
    rows = []
    position = 0.0
    for k, velocity in enumerate(excitation(400, SPEED)):
        seen = sensor(k * PERIOD)
        rows.append((k * PERIOD, position, seen[-1].pose[0] if seen else np.nan))
        plant.command(k * PERIOD, np.array([velocity, 0.0, 0.0]))
        position += velocity * PERIOD
    found = measure_delay(*np.array(rows).T)
    assert abs(found.mean - 2.6e-3) < 0.02 * PERIOD


def test_excitation_rests_moves_and_returns() -> None:
    velocities = excitation(240, 2.0, hold=4, seed=3)
    assert set(velocities) == {-2.0, 0.0, 2.0}
    assert np.cumsum(velocities)[23::24] == pytest.approx(np.zeros(10))
    assert np.all(velocities.reshape(-1, 4) == velocities[::4, None])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, c, m: (t, np.zeros_like(c), m), "does not move"),
        (lambda t, c, m: (t, c, np.random.default_rng(0).normal(size=len(t))), "does not follow"),
        (lambda t, c, m: (t[::-1], c, m), "must increase"),
        (lambda t, c, m: (t, c[:-1], m), "shapes"),
        (lambda t, c, m: (t, c, np.where(np.arange(len(t)) < 15, m, np.nan)), "15 samples"),
    ],
)
def test_useless_recordings_are_refused(change: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure_delay(*change(*recording(2e-3, 0.0, 1e-6)))


def test_a_mirrored_axis_with_uneven_frames_has_a_negative_scale() -> None:
    """Times that scatter by a tenth of a frame; the noise is that of the positions, in metres."""
    rng = np.random.default_rng(4)
    time = PERIOD * (np.arange(300) + rng.uniform(-0.1, 0.1, 300)) + 5.0
    command = np.concatenate([[0.0], np.cumsum(excitation(299, SPEED, hold=3, seed=2) * np.diff(time))])
    measured = -2.5 * np.interp(time - 1.3e-3, time, command) - 0.2 + 4e-6 * rng.standard_normal(300)
    found = measure_delay(time, command, measured)
    assert found.scale == pytest.approx(-2.5, rel=0.01)
    assert found.mean == pytest.approx(1.3e-3, abs=4.0 * found.mean_sigma)
    assert found.mean_sigma < 0.03 * PERIOD
    assert found.noise == pytest.approx(4e-6, rel=0.3)
    assert found.frames == pytest.approx(found.mean / np.median(np.diff(time)), rel=1e-12)


def test_twenty_samples_with_a_command_that_moves_are_enough() -> None:
    time, command, measured = recording(1.2e-3, 0.0, 1e-7, count=40)
    seen = np.where(np.arange(40) < 20, measured, np.nan)
    assert measure_delay(time, command, seen, longest=3e-3).mean == pytest.approx(1.2e-3, abs=0.05 * PERIOD)
    with pytest.raises(ValueError, match="19 samples, expected 20 or more"):
        measure_delay(time, command, np.where(np.arange(40) < 19, measured, np.nan), longest=3e-3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, c, m: (t[:, None], c, m), r"shapes \(400, 1\), \(400,\), \(400,\)"),
        (lambda t, c, m: (t, c, m[1:]), r"shapes \(400,\), \(400,\), \(399,\)"),
        (lambda t, c, m: (np.r_[t[0], t[:-1]], c, m), "must increase"),
        (lambda t, c, m: (t, np.r_[np.nan, c[1:]], m), "must be finite"),
        (lambda t, c, m: (np.r_[t[:-1], np.inf], c, m), "must be finite"),
    ],
)
def test_wrong_arrays_are_refused(change: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        measure_delay(*change(*recording(2e-3, 0.0, 1e-6)))


def test_excitation_has_two_of_each_velocity_in_a_block() -> None:
    velocities = excitation(50, 0.5, hold=3, seed=8)
    assert velocities.shape == (50,)
    for block in velocities[:36].reshape(2, 6, 3):
        assert np.all(block == block[:, :1])
        assert sorted(block[:, 0]) == [-0.5, -0.5, 0.0, 0.0, 0.5, 0.5]
    assert len(excitation(36, 0.5, hold=3)) == 36
    np.testing.assert_array_equal(excitation(7, 1.0), excitation(24, 1.0, hold=4, seed=0)[:7])


def test_frequency_of_a_chirp_rises_linearly() -> None:
    """The phase is the integral of the frequency, by trapezoids, which are exact for a linear one."""
    time = 0.05 * np.arange(11)
    frequency = 1.5 + (4.0 - 1.5) * time / 0.5
    phase = np.r_[0.0, np.cumsum(0.05 * 0.5 * (frequency[1:] + frequency[:-1]))]
    np.testing.assert_allclose(chirp(11, 0.05, 3.0, 1.5, 4.0), 3.0 * np.sin(2.0 * np.pi * phase), atol=1e-12)
    assert chirp(2, 0.25, 3.0, 0.5, 0.5) == pytest.approx([0.0, 3.0 * np.sin(0.25 * np.pi)])
