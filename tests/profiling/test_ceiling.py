"""Peak performance of a device."""

from __future__ import annotations

from gpuvision.profiling import ceiling


def test_the_flop_rate_is_that_of_multiply_adds(device):
    assert 1e8 < ceiling.flop_rate(device, seconds=0.01) < 1e15
