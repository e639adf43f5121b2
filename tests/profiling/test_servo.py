"""The benchmark of the servo loop: the loop reaches its target, and the poses of all candidates are true."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.host import Device

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import feature_pose, servo


def loop_times(latencies: np.ndarray, missed: int, refused: int, rate: float) -> servo.LoopTimes:
    return servo.LoopTimes(latencies, 0.5 * latencies, missed, 1, 4, 20.0, refused, np.zeros(3), rate)


def test_summary_has_percentiles_and_counts() -> None:
    times = loop_times(np.arange(101.0), 3, 2, 1000.0)
    assert times.summary == {
        "p50_us": 50.0,
        "p99_us": 99.0,
        "max_us": 100.0,
        "computing_p50_us": 25.0,
        "computing_p99_us": 49.5,
        "computing_max_us": 50.0,
        "frames": 101,
        "missed": 3,
        "interrupted": 1,
        "camera_stalls": 4,
        "stolen_ms": 20.0,
        "refused": 2,
    }


def test_missed_frames_are_counted_and_attributed() -> None:
    """A period of 1 ms: 2 frames missed by an interruption, 3 while the loop computed for 4 ms."""
    frames = servo._Frames.empty(5)
    frames.number[:] = 10, 11, 14, 15, 19
    frames.published[:] = 1_000_000 * frames.number
    frames.commanded[:] = frames.published + 300_000
    frames.computing[:] = 200_000, 300_000, 200_000, 4_000_000, 200_000
    times = frames.times(1000.0, late=6, stolen_ms=30.0, refused=1, error=np.zeros(3))
    assert (times.missed, times.interrupted, times.camera_stalls, times.refused) == (5, 2, 6, 1)
    assert times.stolen_ms == 30.0
    assert times.rate == pytest.approx(1000.0)
    assert times.latencies == pytest.approx([300.0] * 5)
    assert times.computing == pytest.approx([200.0, 300.0, 200.0, 4000.0, 200.0])


def test_regions_have_enough_rulers() -> None:
    artwork = servo.board()
    for size in servo.SIZES:
        features = servo.features_of(artwork, size)
        assert len(features.length) == servo.RULERS == 60
        assert features.imaging.width_px == 5
        assert max(features.region_px) <= size


@pytest.mark.parametrize(
    ("slowest", "missed", "rate", "reason"),
    [
        (900.0, 0, 1000.0, None),
        (900.0, 0, 985.0, None),
        (900.0, 1, 1000.0, "loop"),
        (1100.0, 0, 1000.0, "loop"),
        (1100.0, 3, 900.0, "camera"),
    ],
)
def test_loop_sustains_a_rate(slowest: float, missed: int, rate: float, reason: str | None) -> None:
    times = loop_times(np.full(100, slowest), missed, 0, rate)
    assert times.failure(1000.0) == reason


@pytest.mark.parametrize("highest", [40.0, 333.0, 1000.0, 1011.0, 7777.0, 31000.0])
def test_search_finds_the_highest_rate(highest: float) -> None:
    tried: list[float] = []

    def failure(rate: float) -> servo.Limit | None:
        tried.append(rate)
        return None if rate <= highest else "loop"

    found = servo.search_highest(failure, 1000.0)
    assert found.limit == "loop"
    assert highest / 2 ** (1 / 32) - 1e-6 <= found.rate <= highest
    assert len(tried) <= 12


def test_search_ends_at_its_range() -> None:
    assert servo.search_highest(lambda rate: None, 1000.0) == (32000.0, "search")
    assert servo.search_highest(lambda rate: "loop", 1000.0) == (0.0, "loop")
    reason = servo.search_highest(lambda rate: None if rate < 1500.0 else "camera", 1000.0)
    assert reason.limit == "camera"


@pytest.mark.slow
def test_camera_goes_on_at_another_rate(device: Device) -> None:
    with servo._loop(device, 128) as loop:
        for rate in (100.0, 50.0):
            times = loop.run(rate, 0.5, settling=10)
            assert len(times.latencies) == round(0.5 * rate)
            assert times.rate == pytest.approx(rate, rel=0.02)
        assert (np.abs(times.error) < (5e-7, 5e-7, 1e-3)).all()
        assert loop.highest_rate(50.0, 0.1).rate > 0.0


@pytest.mark.slow
def test_the_loop_reaches_its_target(device: Device) -> None:
    """A hundred frames with a gain of 0.2 leave 2e-10 of the first error: the noise of a pose remains."""
    times = servo.run_loop(device, 128, rate=100.0, seconds=1.0)
    assert len(times.latencies) == 100
    assert times.refused == 0
    assert (np.abs(times.error) < (5e-7, 5e-7, 1e-3)).all()
    assert (times.latencies > 0).all()


@pytest.mark.slow
def test_an_empty_loop_takes_the_frames(device: Device) -> None:
    times = servo.run_loop(device, 128, rate=100.0, seconds=0.5, placement=servo.Placement(), is_empty=True)
    assert len(times.latencies) == 50
    assert np.median(times.computing) < 200.0


@pytest.mark.nightly
def test_candidates_of_the_vision_give_the_true_pose(device: Device) -> None:
    """The cases themselves compare the poses of all candidates with the truth."""
    cases = list(feature_pose.cases(device))
    assert [case.name for case in cases] == [str(size) for size in feature_pose.SIZES]
    for case in cases:
        assert case.error < 5 * case.metadata["sigma_m"]
        assert 0 < case.metadata["p50_us"] <= case.metadata["p99_us"]
