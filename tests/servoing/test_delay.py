"""Delay budget and gains: closed forms of appendix A, against roots of the polynomial and a table of known values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.delay import (
    DelayBudget,
    characteristic_polynomial,
    continuous_gains,
    gain_limit,
    non_oscillating_gain,
    phase_loss,
)

LIMITS = (2.0, 1.0, 0.61803, 0.44504, 0.34730, 0.28463, 0.24107)
NON_OSCILLATING = (1.0, 0.25, 0.1481, 0.1055, 0.0819, 0.0670, 0.0567)
DELAYS = (*range(7), 0.1, 0.25, 0.4, 0.5, 0.6, 0.9, 1.3, 1.5, 2.5, 3.75, 6.01)


def largest_root(delay: float, gain: float) -> float:
    """Return the spectral radius by the companion matrix of the recursion, built from scratch."""
    whole, part = int(delay), delay - int(delay)
    step = np.eye(whole + 2, k=-1)
    step[0, 0] = 1.0
    step[0, whole] -= gain * (1.0 - part)
    step[0, whole + 1] -= gain * part
    return float(np.abs(np.linalg.eigvals(step)).max())


def test_table_of_whole_delays() -> None:
    assert [gain_limit(d) for d in range(7)] == pytest.approx(LIMITS, abs=5e-6)
    assert [non_oscillating_gain(d) for d in range(7)] == pytest.approx(NON_OSCILLATING, abs=5e-5)


@pytest.mark.parametrize("delay", DELAYS)
def test_limit_is_where_the_first_root_leaves_the_unit_circle(delay: float) -> None:
    limit = gain_limit(delay)
    assert all(largest_root(delay, gain) < 1.0 for gain in np.linspace(1e-3, 0.9999, 60) * limit)
    assert largest_root(delay, 1.0001 * limit) > 1.0


def test_limit_is_continuous_in_the_delay() -> None:
    for delay in (1, 2, 5, 0.5, 1.5):
        near = [gain_limit(delay - 1e-7), gain_limit(delay + 1e-7)]
        assert near == pytest.approx([gain_limit(delay)] * 2, rel=1e-5)


@pytest.mark.parametrize("delay", DELAYS)
def test_slowest_root_turns_complex_above_the_non_oscillating_gain(delay: float) -> None:
    gain = non_oscillating_gain(delay)
    below, above = (np.roots(characteristic_polynomial(delay, factor * gain)) for factor in (0.999, 1.001))
    slowest = below[np.abs(below).argmax()]
    assert slowest.real > 0.0
    assert abs(slowest.imag) < 1e-9
    if delay:
        assert abs(above[np.abs(above).argmax()].imag) > 1e-3


def test_characteristic_polynomial_has_the_roots_of_the_recursion() -> None:
    for delay, gain in ((0, 0.3), (2, 0.2), (2.25, 0.2), (0.75, 0.9)):
        assert np.abs(np.roots(characteristic_polynomial(delay, gain))).max() == pytest.approx(
            largest_root(delay, gain)
        )


def test_continuous_gains_are_those_of_fine_sampling() -> None:
    """A delay of many frames with the hold of half a frame is nearly continuous."""
    period, delay = 1e-5, 1e-3
    known = continuous_gains(delay + period / 2.0)
    assert gain_limit(delay / period) / period == pytest.approx(known.limit, rel=1e-4)
    assert non_oscillating_gain(delay / period) / period == pytest.approx(known.critical, rel=1e-4)


def test_bandwidths_of_the_literature() -> None:
    table = {1e-3: (250.0, 58.5), 2e-3: (125.0, 29.3), 4e-3: (62.5, 14.6), 10e-3: (25.0, 5.9)}
    for delay, expected in table.items():
        gains = continuous_gains(delay)
        assert [each / (2.0 * math.pi) for each in gains] == pytest.approx(expected, abs=0.06)
    assert np.degrees(phase_loss([50.0, 125.0], 2e-3)) == pytest.approx([36.0, 90.0])


def test_budget() -> None:
    budget = DelayBudget(period=1e-3, exposure=2e-4, readout=3e-4, transfer=1e-4, stages={"edges": 4e-4, "pose": 1e-4})
    assert budget.latency == pytest.approx(1e-3)
    assert budget.total == pytest.approx(1.5e-3)
    assert sum(budget.parts.values()) == pytest.approx(budget.total)
    assert list(budget.parts) == ["half exposure", "readout", "transfer", "stage edges", "stage pose", "half hold"]
    assert budget.frames == pytest.approx(1.0)
    assert budget.gain == pytest.approx(0.25, rel=1e-6)
    assert budget.bandwidth == pytest.approx(0.25 / (2.0 * math.pi * 1e-3), rel=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"period": 0.0}, "period is 0.0, expected a number > 0"),
        ({"period": 1e-3, "exposure": -1.0}, "exposure is -1.0"),
        ({"period": 1e-3, "stages": {"edges": float("nan")}}, "stage edges must be finite"),
    ],
)
def test_budget_refuses(given: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DelayBudget(**given)


def test_negative_delay_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"delay is -0\.5"):
        gain_limit(-0.5)


def test_longest_delay() -> None:
    assert gain_limit(999.5) == pytest.approx(math.pi / 2.0 / 1000.0, rel=1e-3)
    with pytest.raises(ValueError, match=r"delay is 1000\.5"):
        gain_limit(1000.5)
