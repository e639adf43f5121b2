"""Report, tables and complete cut of `LightCut`."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gpuvision.simulation.clustering.light_cut import LightCut
from gpuvision.simulation.errors.range_error import StripErrorModel


def complete_cut() -> LightCut:
    """Return the cut of 3 segments for 2 strips of 17 receivers: 2 blocks a strip."""
    reading = StripErrorModel(power=[1.0, 2.0], moment=[0.25, 0.0], slope=[1e-3, 2e-3], limits=(-1.0, 0.5))
    segments = np.arange(30.0).reshape(3, 10)
    return LightCut.full(segments, (2, 17, 6), reading, 1e-6)


def test_complete_cut() -> None:
    cut = complete_cut()
    np.testing.assert_array_equal(cut.starts, [0, 3, 6, 9, 12])
    np.testing.assert_array_equal(cut.selected, [0, 1, 2] * 4)
    np.testing.assert_array_equal(cut.bound, [0.0, 0.0])
    # A mean of u cannot be off by more than the limits are apart.
    np.testing.assert_allclose(cut.bound_if_omitted, [1.5e-3, 3e-3])
    pairs = 2 * 17 * 3
    counts = {"segments": 3, "pairs": pairs, "exact": pairs, "clear": 0, "clustered": 0, "left out": 0, "work": pairs}
    assert cut.counts == counts
    assert cut.report() == {
        "has pairs": True,
        "traversed": False,
        "tolerance": 1e-6,
        "bound": 0.0,
        "bound if all left out": pytest.approx(3e-3),
        "clusters": 0,
        **counts,
    }


def test_report_of_clusters_and_infinite_bounds() -> None:
    cut = complete_cut()
    segments = np.concatenate([cut.segments, cut.segments[:2]])
    changed = dataclasses.replace(
        cut,
        segments=segments,
        selected=cut.selected[:0],
        traversed=True,
        bound=np.array([2e-7, 5e-7]),
        bound_if_omitted=np.array([np.inf, 1.0]),
    )
    report = changed.report()
    assert (report["has pairs"], report["traversed"], report["clusters"]) == (False, True, 2)
    assert (report["bound"], report["bound if all left out"]) == (5e-7, None)


def test_padded_tables() -> None:
    cut = complete_cut()
    rows, starts, selected = cut.padded_tables(np.float32, 5, 20)
    assert rows.shape == (8, 10)
    assert rows.dtype == np.float32
    np.testing.assert_array_equal(rows[:3], cut.segments)
    padding = np.zeros((5, 10))
    padding[:, 8] = 1.0
    np.testing.assert_array_equal(rows[3:], padding)
    assert starts is cut.starts
    np.testing.assert_array_equal(selected, np.append(cut.selected, np.zeros(32 - 12)))
    rows, _, selected = cut.padded_tables(np.float64)
    assert (rows.shape, selected.shape) == ((4, 10), (16,))
