"""Batch sizes that the plan of a stream tries."""

from __future__ import annotations

from gpuvision.host.planning import BATCHES


def test_batch_sizes_double_from_one_frame() -> None:
    """The chosen batch is then at most twice the smallest that suffices."""
    assert [*BATCHES] == [1 << k for k in range(len(BATCHES))]
    assert BATCHES[-1] == 4096
