"""The benchmark of the servo loop: the loop reaches its target, and the poses of all candidates are true."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.host import Device

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import feature_pose, servo


def test_summary_has_percentiles_and_counts() -> None:
    times = servo.LoopTimes(np.arange(101.0), 3, 2, np.zeros(3))
    assert times.summary == {"p50_us": 50.0, "p99_us": 99.0, "max_us": 100.0, "frames": 101, "missed": 3, "refused": 2}


def test_regions_have_enough_rulers() -> None:
    artwork = servo.board()
    for size in servo.SIZES:
        features = servo.features_of(artwork, size)
        assert len(features.length) == (48 if size == 128 else servo.RULERS)
        assert max(features.region_px) <= size


@pytest.mark.slow
def test_the_loop_reaches_its_target(device: Device) -> None:
    """A hundred frames with a gain of 0.2 leave 2e-10 of the first error: the noise of a pose remains."""
    times = servo.run_loop(device, 128, rate=100.0, seconds=1.0)
    assert len(times.latencies) == 100
    assert times.refused == 0
    assert (np.abs(times.error) < (5e-7, 5e-7, 1e-3)).all()
    assert (times.latencies > 0).all()


@pytest.mark.slow
def test_candidates_of_the_vision_give_the_true_pose(device: Device) -> None:
    """The cases themselves compare the poses of all candidates with the truth."""
    cases = list(feature_pose.cases(device))
    assert [case.name for case in cases] == [str(size) for size in feature_pose.SIZES]
    for case in cases:
        assert case.error < 5 * case.metadata["sigma_m"]
        assert 0 < case.metadata["p50_us"] <= case.metadata["p99_us"]
