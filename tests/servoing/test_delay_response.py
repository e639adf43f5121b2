"""Root locus, step response and jitter, against recursions that are written out here."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest

from gpuvision.servoing.delay import DelayBudget, gain_limit, non_oscillating_gain
from gpuvision.servoing.delay_response import (
    JitterMoments,
    delay_against_frame_time,
    jitter_gain_limit,
    jitter_moments,
    normal_delays,
    root_locus,
    settling_frames,
    step_response,
)


def recursion(delay: float, gain: float, frames: int) -> list[float]:
    """Return the errors of the loop, with the position interpolated between frames."""
    errors = [1.0]
    times = np.arange(-20.0, frames + 1.0)
    positions = np.zeros(len(times))
    for k in range(frames - 1):
        seen = float(np.interp(k - delay, times, positions))
        positions[21 + k] = positions[20 + k] + gain * (1.0 - seen)
        errors.append(1.0 - float(positions[21 + k]))
    return errors


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.5, 6.0])
def test_step_response_is_the_recursion(delay: float) -> None:
    gain = 0.8 * gain_limit(delay)
    assert step_response(delay, gain, 40) == pytest.approx(recursion(delay, gain, 40), abs=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.5, 6.0])
@pytest.mark.parametrize("fraction", [0.2, 1.0, 2.0])
def test_settling_frames(delay: float, fraction: float) -> None:
    gain = min(fraction * non_oscillating_gain(delay), 0.9 * gain_limit(delay))
    count = settling_frames(delay, gain, 0.01)
    errors = np.abs(recursion(delay, gain, 1000))
    assert np.all(errors[count:] <= 0.01)
    assert errors[count - 1] > 0.01


def test_settling_of_an_unstable_loop_is_an_error() -> None:
    with pytest.raises(ValueError, match="not stable"):
        settling_frames(2, 0.62, 0.01)
    with pytest.raises(ValueError, match="not stable"):
        settling_frames(2, 0.0, 0.01)


def test_settling_of_a_slow_loop_is_an_error_without_much_memory() -> None:
    tracemalloc.start()
    with pytest.raises(ValueError, match="gain 1e-08 does not settle within 1800000 frames; raise the gain"):
        settling_frames(2.0, 1e-8, 0.01)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e6
    # A first-order loop: (1 - gain)^n = 0.01.
    assert settling_frames(0.0, 1e-4, 0.01) == math.ceil(math.log(0.01) / math.log1p(-1e-4))


def test_root_locus_is_sorted_and_leaves_the_circle_at_the_limit() -> None:
    gains = np.linspace(0.1, 1.2, 12) * gain_limit(3)
    roots = root_locus(3, gains)
    assert roots.shape == (12, 4)
    assert np.all(np.diff(np.abs(roots), axis=1) <= 1e-12)
    assert np.array_equal(np.abs(roots[:, 0]) > 1.0, gains > gain_limit(3))


def test_constant_delay_has_the_limit_without_jitter() -> None:
    for delay in (0.0, 0.7, 2.0, 3.4):
        assert jitter_gain_limit([delay]) == pytest.approx(gain_limit(delay), rel=1e-6)


def mean_squares(moments: JitterMoments, gain: float, count: int) -> list[float]:
    """Return the mean square of the error in each frame, by the exact recursion of the second moments."""
    size = len(moments.mean)
    known = np.ones((size, size))
    found = []
    for _ in range(count):
        row = known[0] - gain * moments.mean @ known
        first = known[0, 0] - 2 * gain * moments.mean @ known[:, 0] + gain**2 * np.sum(moments.square * known)
        known = np.block([[np.array([[first]]), row[None, :-1]], [row[:-1, None], known[:-1, :-1]]])
        found.append(float(first))
    return found


def test_mean_squares_are_those_of_many_loops() -> None:
    """The recursion of this file against 20 000 loops in their first frames."""
    delays, weights, gain = np.array([0.5, 1.0, 2.25]), np.array([0.3, 0.5, 0.2]), 0.9
    rng = np.random.default_rng(5)
    taps = np.array([[0.5, 0.5, 0, 0], [0, 1.0, 0, 0], [0, 0, 0.75, 0.25]])
    past = np.ones((20_000, 4))
    squares = []
    for _ in range(10):
        drawn = taps[rng.choice(3, len(past), p=weights)]
        new = past[:, 0] - gain * np.sum(drawn * past, axis=1)
        past = np.column_stack([new, past[:, :3]])
        squares.append(np.mean(new**2))
    assert squares == pytest.approx(mean_squares(jitter_moments(delays, weights), gain, 10), rel=0.06)


@pytest.mark.parametrize(("mean", "sigma"), [(0.1, 1.0), (2.0, 0.5), (1.0, 3.0), (12.0, 2.0)])
def test_mean_square_grows_above_the_limit_only(mean: float, sigma: float) -> None:
    moments, limit = jitter_moments(*normal_delays(mean, sigma)), jitter_gain_limit(*normal_delays(mean, sigma))
    for factor in (0.995, 1.005):
        found = mean_squares(moments, factor * limit, 3000)
        assert (max(found[-100:]) > max(found[-1100:-1000])) == (factor > 1.0)


def test_limit_with_normal_jitter_has_converged() -> None:
    nodes = np.linspace(-4.0, 4.0, 401)
    weights = np.exp(-0.5 * nodes**2)
    fine = jitter_gain_limit(np.maximum(2.0 + 0.5 * nodes, 0.0), weights / weights.sum())
    assert jitter_gain_limit(*normal_delays(2.0, 0.5)) == pytest.approx(fine, rel=1e-3)


def test_limit_of_long_delays_takes_seconds() -> None:
    """104 frames of delay: a matrix of all pairs of positions would have 30 million elements."""
    limit = jitter_gain_limit(*normal_delays(100.0, 1.0))
    assert limit == pytest.approx(gain_limit(100.0), rel=0.02)


def test_probabilities_are_checked() -> None:
    with pytest.raises(ValueError, match="probabilities must be"):
        jitter_moments([1.0, 2.0], [0.5, 0.6])


def test_frame_time_only_changes_the_hold() -> None:
    """Section 6.3.6: a faster pipeline with the same latency approaches the continuous loop."""
    budget = DelayBudget(period=1.0, exposure=2e-4, readout=9e-4, stages={"all": 1e-3})
    curve = delay_against_frame_time(budget, [2e-3, 1e-3, 1e-4, 1e-5])
    assert curve.total == pytest.approx([3e-3, 2.5e-3, 2.05e-3, 2.005e-3])
    assert curve.frames == pytest.approx([1.0, 2.0, 20.0, 200.0])
    assert np.all(np.diff(curve.bandwidth) > 0.0)
    assert curve.bandwidth[-1] == pytest.approx(1.0 / (np.e * 2.0 * np.pi * 2.005e-3), rel=1e-3)
