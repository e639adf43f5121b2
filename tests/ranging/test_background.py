"""Background subtraction against integer arithmetic in int64 and closed forms of Gaussian noise."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri

from gpuvision.host.errors import RecordingError
from gpuvision.host.sources import ArraySource, Source
from gpuvision.ranging.background import (
    FramesCopied,
    ImageSubtracted,
    PairsSubtracted,
    PreviousSubtracted,
    beside_line,
    line_stands_still,
    line_threshold,
    median_background,
    noise_threshold,
    sample_frames,
    unlit_level,
)

CANARY = 77


def read(source: Source, batch: int = 3) -> Any:
    """Return all frames of a source, read in batches; check that nothing is written beyond the filled frames."""
    frames = []
    while source.wait():
        out = np.full((batch, *source.shape), CANARY, source.dtype)
        count = source.read_into(out, np.zeros(batch, np.int64))
        assert np.all(out[count:] == CANARY)
        if not count:
            break
        frames.append(out[:count])
    return np.concatenate(frames) if frames else np.empty((0, *source.shape), source.dtype)


def frames_of(count: int, dtype: Any, seed: int = 3) -> Any:
    rng = np.random.default_rng(seed)
    top = np.iinfo(dtype).max if np.issubdtype(dtype, np.integer) else 1000
    return rng.integers(0, top, (count, 7, 11), endpoint=True).astype(dtype)


def expected(frame: Any, background: Any) -> Any:
    """Return the difference in int64 or float64: at least 0; where only the frame is saturated, the frame."""
    exact = np.maximum(frame.astype(np.float64) - background.astype(np.float64), 0.0)
    if np.issubdtype(frame.dtype, np.integer):
        top = np.iinfo(frame.dtype).max
        exact[(frame == top) & (background < top)] = top
    return exact


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("batch", [1, 3, 20])
def test_an_image_is_subtracted_from_each_frame(dtype: Any, batch: int) -> None:
    frames, (background,) = frames_of(10, dtype), frames_of(1, dtype, seed=4)
    frames[4, 2, 3] = frames[5, 2, 4] = background[2, 4] = np.max(frames)
    found = read(ImageSubtracted(ArraySource(frames), background), batch)
    np.testing.assert_array_equal(found, [expected(each, background) for each in frames])


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("batch", [1, 3, 20])
def test_the_previous_frame_is_subtracted_across_batches(dtype: Any, batch: int) -> None:
    frames = frames_of(10, dtype)
    found = read(PreviousSubtracted(ArraySource(frames)), batch)
    np.testing.assert_array_equal(found[0], 0)
    np.testing.assert_array_equal(found[1:], [expected(frames[k], frames[k - 1]) for k in range(1, 10)])


@pytest.mark.parametrize("light_first", [True, False])
@pytest.mark.parametrize("count", [1, 10, 11])
def test_pairs_become_one_frame_each(light_first: bool, count: int) -> None:
    frames = frames_of(count, np.uint8)
    source = ArraySource(frames)
    source.rate = 100.0
    pairs = PairsSubtracted(source, light_first=light_first)
    assert (pairs.length, pairs.rate) == (count // 2, 50.0)
    found = read(pairs)
    light, dark = (0, 1) if light_first else (1, 0)
    wanted = [expected(frames[2 * k + light], frames[2 * k + dark]) for k in range(count // 2)]
    np.testing.assert_array_equal(found, np.reshape(wanted, (-1, 7, 11)))


class Unknowing(ArraySource):
    """Source that does not know its end, and gives one frame in each read."""

    stopped = closed = False

    def wait(self) -> bool:
        return True

    def read_into(self, out: Any, arrived: Any) -> int:
        return super().read_into(out[:1], arrived[:1]) if self._next < self.length else 0

    def stop(self) -> None:
        self.stopped = True

    def close(self) -> None:
        self.closed = True


def test_sources_end_where_a_read_gives_no_frame() -> None:
    """Frames come one by one, also the two of a pair and those of a group; the wrapped source is stopped and closed."""
    frames = frames_of(5, np.uint8)
    previous, pairs = PreviousSubtracted(Unknowing(frames)), PairsSubtracted(Unknowing(frames))
    subtracted = ImageSubtracted(Unknowing(frames), np.zeros_like(frames[0]))
    np.testing.assert_array_equal(read(subtracted), frames)
    found = read(previous)
    np.testing.assert_array_equal(found[1:], [expected(frames[k], frames[k - 1]) for k in range(1, 5)])
    assert len(found) == 5
    out, arrived = np.full((2, 7, 11), CANARY, np.uint8), np.zeros(2, np.int64)
    assert previous.read_into(out, arrived) == subtracted.read_into(out, arrived) == 0
    assert np.all(out == CANARY)
    assert pairs.wait()
    assert len(read(pairs)) == 2
    assert not pairs.wait()
    sample = sample_frames(Unknowing(frames), group=2)
    np.testing.assert_array_equal(sample.frames.reshape(4, 7, 11), frames[:4])
    np.testing.assert_array_equal(sample.numbers, [0, 2])
    for source in (previous, pairs, subtracted):
        source.stop()
        source.close()
        assert source._source.stopped
        assert source._source.closed


def test_lengths_and_rates_of_unknown_sources_are_unknown() -> None:
    source = ArraySource(frames_of(5, np.uint8))
    source.length, source.rate = None, None
    pairs = PairsSubtracted(source)
    assert (pairs.length, pairs.rate) == (None, None)
    source.length, source.rate = 5, 30.0
    previous = PreviousSubtracted(source)
    assert (previous.length, previous.rate, previous.shape, previous.dtype) == (5, 30.0, (7, 11), np.uint8)


def test_a_pair_arrives_with_its_second_frame() -> None:
    times = iter(range(100, 200))
    source = PairsSubtracted(ArraySource(frames_of(6, np.uint8), clock=lambda: next(times)))
    arrived = np.zeros(3, np.int64)
    # The array gives both frames of a pair in one read, at one time.
    assert source.read_into(np.empty((3, 7, 11), np.uint8), arrived) == 3
    np.testing.assert_array_equal(arrived, [100, 101, 102])


def test_a_stated_saturation_replaces_the_largest_code() -> None:
    frames = np.full((1, 2, 3), 200, np.uint8)
    background = np.full((2, 3), 50, np.uint8)
    assert np.all(read(ImageSubtracted(ArraySource(frames), background, saturation=200.0)) == 200)
    assert np.all(read(ImageSubtracted(ArraySource(frames), background)) == 150)


@pytest.mark.parametrize("background", [np.zeros((7, 10), np.uint8), np.zeros((7, 11), np.uint16)])
def test_another_background_is_refused(background: Any) -> None:
    with pytest.raises(
        RecordingError, match=r"the background: 7x1[01] uint(8|16) where the first frame was 7x11 uint8"
    ):
        ImageSubtracted(ArraySource(frames_of(2, np.uint8)), background)


@given(st.integers(1, 200), st.integers(5, 20), st.integers(1, 3))
def test_samples_are_spread_evenly(length: int, count: int, group: int) -> None:
    frames = np.broadcast_to(np.arange(length, dtype=np.uint16)[:, None, None], (length, 2, 3))
    groups = length // group
    if not groups:
        with pytest.raises(RecordingError, match="too few frames"):
            sample_frames(ArraySource(frames), count, group=group)
        return
    sample = sample_frames(ArraySource(frames), count, group=group)
    found = sample.frames[:, :, 0, 0]
    np.testing.assert_array_equal(sample.numbers, found[:, 0])
    assert min(count, groups) <= len(found) < 2 * count
    assert np.all(np.diff(found, axis=1) == 1)
    firsts = found[:, 0] // group
    assert np.unique(np.diff(firsts)).size <= 1
    assert firsts[0] == 0
    assert firsts[-1] + max(np.diff(firsts), default=1) >= groups


@given(st.integers(1, 12), st.integers(0, 1000))
def test_the_median_of_each_pixel(count: int, seed: int) -> None:
    frames = frames_of(count, np.uint16, seed)
    wanted = np.sort(frames, axis=0)[(count - 1) // 2]
    np.testing.assert_array_equal(median_background(frames), wanted)


@pytest.mark.parametrize("sigma", [3.0, 20.0])
@pytest.mark.parametrize("clipped", [False, True])
def test_the_threshold_of_gaussian_noise(sigma: float, clipped: bool) -> None:
    """Closed form: twice the 0.1 % quantile; for clipped noise 4.8 times the 90 % quantile."""
    noise = np.random.default_rng(5).normal(0.0, sigma, (4, 500, 501))
    noise[:, 100:102] += 40 * sigma  # a line, on less than 1 % of the pixels
    found = noise_threshold(noise.clip(0) if clipped else noise, integer=False)
    wanted = 4.8 * ndtri(0.9) * sigma if clipped else -2.0 * ndtri(1e-3) * sigma
    assert found == pytest.approx(wanted, rel=0.03)
    unlit = np.delete(noise, [100, 101], axis=1)
    assert np.count_nonzero(unlit > found) == 0


def test_thresholds_of_frames_without_noise() -> None:
    assert noise_threshold(np.zeros((2, 5, 5)), integer=True) == 4.0
    assert noise_threshold(np.zeros((2, 5, 5)), integer=False) == 0.0
    assert noise_threshold(np.full((2, 5, 5), np.nan), integer=True) == 4.0


def test_the_threshold_of_a_line_is_a_quarter_of_its_typical_peak() -> None:
    light = np.zeros((1, 10, 50))
    light[0, :7, 20] = [100, 120, 80, 100, 100, 60, 140]
    light[0, 7:, 3] = 9.0  # unlit profiles
    assert line_threshold(light, 10.0) == 25.0
    assert line_threshold(light, 30.0) == 30.0
    assert line_threshold(light, 200.0) == 200.0


def test_the_unlit_level_leaves_out_a_line() -> None:
    background = np.zeros((101, 99))
    background[50:52] = 255.0
    background[:40] = 30.0
    assert unlit_level(background) == 30.0


def test_samples_beside_the_line_are_an_eighth_of_the_profile_away() -> None:
    """Profiles of 16 samples: the brightest one and two on each side are the line, up to the ends of the profile."""
    profiles = np.ones((3, 16))
    profiles[[0, 1, 2], [5, 0, 14]] = 9.0
    expected = np.ones((3, 16), bool)
    expected[0, 3:8] = expected[1, :3] = expected[2, 12:] = False
    np.testing.assert_array_equal(beside_line(profiles), expected)
    # A profile of one sample has nothing beside the line: all of it counts.
    np.testing.assert_array_equal(beside_line([[3.0], [4.0]]), np.ones((2, 1), bool))


def test_a_line_stands_still_if_the_median_takes_half_of_its_light() -> None:
    """The peaks of a profile are 110 with the background 10: less than 50 without the median is a line in it."""
    frames = np.full((4, 6, 9), 10.0)
    frames[:, :, 4] = 110.0
    light = np.zeros_like(frames)
    for left, still in ((0.0, True), (49.5, True), (50.0, False), (100.0, False)):
        light[:, :, 4] = left
        assert line_stands_still(light, frames, 10.0) is still
    # The median profile decides: some profiles without light change nothing.
    light[:, :2] = 0.0
    assert not line_stands_still(light, frames, 10.0)
    light[:, :4] = 0.0
    assert line_stands_still(light, frames, 10.0)


def test_a_threshold_of_integers_is_the_next_whole_number() -> None:
    """Values -2, 0 and 6 in equal shares: centre 0, and 2 x 2 by the dark side."""
    values = np.repeat([-2.0, 0.0, 6.0], 100)
    assert noise_threshold(values, integer=False) == 4.0
    assert noise_threshold(values + 0.25, integer=True) == 5.0
    assert noise_threshold(values - 9.0, integer=True) == 4.0
    assert noise_threshold(values - 9.0, integer=False) == 0.0
    # Without a dark side the bright side counts, too: 4.8 times the distance from the median to the 90 % quantile.
    assert noise_threshold(np.repeat([0.0, 1.0, 3.0], 100), integer=False) == pytest.approx(1.0 + 4.8 * 2.0)
    values[::7] = np.nan
    assert noise_threshold(values, integer=False) == 4.0


def test_a_large_background_is_thinned_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    """An even step would see only every second column; with an odd one both kinds of columns count."""
    monkeypatch.setattr("gpuvision.ranging.background._LARGEST_SAMPLE_VALUES", 500)
    for size, step in ((500, 1), (501, 3), (1000, 3), (1500, 3), (1501, 5)):
        # Every step-th value is 7, the others are out of the sample.
        values = np.full(size, 99.0)
        values[::step] = 7.0
        assert unlit_level(values.reshape(-1, 1)) == 7.0
        values[(size - 1) // step * step] = 99.0
        assert noise_threshold(values.reshape(1, -1), integer=False) == 7.0
        values[::step] = 200.0
        assert unlit_level(values) == 200.0


def test_a_sample_of_a_large_recording_keeps_at_least_five_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """At most the groups that the memory holds, with 6 bytes for each frame; but five where it holds fewer."""
    frames = np.broadcast_to(np.arange(64, dtype=np.uint16)[:, None, None], (64, 1, 3))
    # While the recording is read up to twice as many groups are kept.
    for limit, group, least in ((6 * 2 * 8, 1, 8), (6 * 2 * 7, 1, 7), (6 * 2 * 6, 2, 5), (0, 1, 5), (10_000, 1, 16)):
        monkeypatch.setattr("gpuvision.ranging.background._LARGEST_SAMPLE_BYTES", limit)
        assert least <= len(sample_frames(ArraySource(frames), group=group).frames) < 2 * least


@pytest.mark.parametrize("batch", [1, 3, 20, 200])
@pytest.mark.parametrize("count", [1, 5, 16, 17, 33, 150])
def test_copies_are_spread_over_all_frames(count: int, batch: int) -> None:
    """Every n-th frame from the first one on, with the least power of two that gives at most 16."""
    frames = frames_of(count, np.uint8)
    source = FramesCopied(ArraySource(frames))
    np.testing.assert_array_equal(read(source, batch), frames)
    step = next(2**k for k in range(10) if -(-count // 2**k) <= 16)
    np.testing.assert_array_equal(np.stack(source.copies), frames[::step])
