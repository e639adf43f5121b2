from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.placement.budget import noise_gain


@pytest.mark.parametrize("gain", [0.1, 0.5, 1.0])
def test_noise_of_a_loop_without_delay_has_a_closed_form(gain: float) -> None:
    # x[k+1] = (1 - gain) x[k] - gain noise: an autoregression of the first order.
    assert noise_gain(0.0, gain) == pytest.approx(gain / (2.0 - gain), rel=1e-12)


def test_noise_of_a_delayed_loop_agrees_with_its_simulation() -> None:
    delay, gain, runs = 1.4, 0.15, 4000
    noise = np.random.default_rng(1).standard_normal((200, runs))
    x = np.zeros((204, runs))
    for k in range(3, 203):
        seen = 0.6 * x[k - 1] + 0.4 * x[k - 2] + noise[k - 3]
        x[k + 1] = x[k] - gain * seen
    # Standard error of a variance of 4000 runs: 2.2 %; 40 frames that are far apart are averaged.
    measured = np.mean(x[100::3] ** 2)
    assert measured == pytest.approx(noise_gain(delay, gain), rel=0.03)


def test_more_delay_and_more_gain_give_more_noise() -> None:
    values = [noise_gain(delay, gain) for delay, gain in ((0.0, 0.1), (2.0, 0.1), (2.0, 0.3))]
    assert values == sorted(values)
    assert math.isfinite(values[-1])


@pytest.mark.parametrize("gain", [1e-8, 1e-4])
@pytest.mark.parametrize("delay", [0.0, 1.4, 6.0])
def test_noise_of_a_slow_loop_is_not_cut_off(delay: float, gain: float) -> None:
    # A slow loop is a first-order low-pass filter: half its gain, with corrections of the relative size gain * delay.
    assert noise_gain(delay, gain) == pytest.approx(gain / 2.0, rel=3.0 * gain * (1.0 + delay))


def test_noise_of_an_unstable_loop_is_refused() -> None:
    for gain in (0.62, 0.0):
        with pytest.raises(ValueError, match="not stable"):
            noise_gain(2.0, gain)
