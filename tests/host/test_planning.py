"""Batch sizes that the plan of a stream tries."""

from __future__ import annotations

import pytest

from gpuvision.host.planning import BATCHES, PlanLimits


def test_batch_sizes_double_from_one_frame() -> None:
    """The chosen batch is then at most twice the smallest that suffices."""
    assert [*BATCHES] == [1 << k for k in range(len(BATCHES))]
    assert BATCHES[-1] == 4096


def test_limits_are_given_by_name() -> None:
    assert PlanLimits(min_ring=8).min_ring == 8
    with pytest.raises(TypeError, match="positional argument"):
        PlanLimits(8)
