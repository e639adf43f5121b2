"""Arrays, channels and processes that the host refuses, and the limits on both sides."""

from __future__ import annotations

import os
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.host import process, tuning
from gpuvision.host.arrays import check_host
from gpuvision.host.channels import CHANNELS, channel_copier
from gpuvision.host.errors import DeviceUnusableError, RecordingError
from gpuvision.host.launch_builder import LaunchBuilder
from gpuvision.host.tuned_settings import TunedSettings


def test_an_array_of_the_host_is_plain_whole_and_aligned() -> None:
    dtype = np.dtype(np.float32)
    good = np.zeros((3, 4), dtype)
    check_host(good, (3, 4), dtype, "a")
    unaligned = np.zeros(49, np.uint8)[1:].view(np.float32).reshape(3, 4)
    assert not unaligned.flags.aligned
    for array, error, message in (
        (np.ma.masked_array(good), TypeError, "a: expected a plain array, got a masked array"),
        (good.astype(np.float64), TypeError, "a: expected dtype float32, got float64; convert it with .astype"),
        (good[:2], ValueError, r"a: expected shape \(3, 4\), got \(2, 4\)"),
        (np.zeros((4, 3), dtype).T, ValueError, "a: expected a C-contiguous array; use np.ascontiguousarray"),
        (unaligned, ValueError, "a: expected an array aligned to float32; use np.require"),
    ):
        with pytest.raises(error, match=message):
            check_host(array, (3, 4), dtype, "a")


@pytest.mark.parametrize("depth", [3, 4])
@pytest.mark.parametrize("channel", CHANNELS)
def test_channels_of_colour_frames(channel: Any, depth: int, rng: np.random.Generator) -> None:
    """Blue, green and red; a difference is a channel less the luma, 0 where it is negative."""
    frame = rng.integers(0, 256, (5, 7, depth), dtype=np.uint8)
    blue, green, red = (frame[..., k].astype(int) for k in range(3))
    luma = cv2.cvtColor(np.ascontiguousarray(frame[..., :3]), cv2.COLOR_BGR2GRAY).astype(int)
    assert np.abs(luma - (0.114 * blue + 0.587 * green + 0.299 * red)).max() <= 1.0
    expected = {
        "grey": luma,
        "blue": blue,
        "green": green,
        "red": red,
        "max": np.maximum(np.maximum(blue, green), red),
        "blue_difference": np.maximum(blue - luma, 0),
        "green_difference": np.maximum(green - luma, 0),
        "red_difference": np.maximum(red - luma, 0),
    }[channel]
    out = np.zeros((5, 7), np.uint8)
    channel_copier(channel, frame.shape, "frame 3")(frame, out)
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("channel", CHANNELS)
def test_grey_frames_have_no_colours(channel: Any) -> None:
    if channel in ("grey", "max"):
        out = np.zeros((2, 3), np.uint8)
        channel_copier(channel, (2, 3), "frame 3")(np.full((2, 3), 9, np.uint8), out)
        assert (out == 9).all()
        return
    with pytest.raises(RecordingError, match=f"frame 3: has no {channel} channel, the frames are grey"):
        channel_copier(channel, (2, 3), "frame 3")


@pytest.mark.parametrize("shape", [(4,), (4, 5, 2), (4, 5, 5), (2, 4, 5, 3)])
def test_what_is_no_frame_has_no_channels(shape: tuple[int, ...]) -> None:
    with pytest.raises(RecordingError, match="frame 3: expected grey or colour frames, got shape"):
        channel_copier("red", shape, "frame 3")


def test_only_the_process_that_loaded_the_runtimes_uses_them(monkeypatch: pytest.MonkeyPatch) -> None:
    for user in (None, os.getpid()):
        monkeypatch.setattr(process, "_user", user)
        process.check_process()
    monkeypatch.setattr(process, "_user", os.getpid() + 1)
    with pytest.raises(DeviceUnusableError, match="this process was forked after OpenCL was used"):
        process.check_process()
    process.begin_use()
    process.check_process()


def test_time_of_a_short_call_is_the_mean_over_half_a_millisecond(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls of 0.2 ms: three of them reach 0.5 ms; of 0.26 ms two do; a long call is made once."""
    for duration, made in ((0.2, 3), (0.26, 2), (0.51, 1), (7.0, 1)):
        now, calls = [10.0], []

        def call(now: list[float] = now, calls: list[int] = calls, duration: float = duration) -> None:
            now[0] += 1e-3 * duration
            calls.append(1)

        monkeypatch.setattr(tuning, "time", SimpleNamespace(perf_counter=lambda now=now: now[0]))
        assert tuning.seconds_of_a_call(TunedSettings(), call) == pytest.approx(1e-3 * duration)
        assert len(calls) == made


@pytest.mark.parametrize(
    ("shape", "is_colour"),
    [
        ((16, 16, 3), True),
        ((16, 16, 4), True),
        ((5, 16, 17, 3), True),
        ((15, 16, 3), False),
        ((16, 15, 3), False),
        ((16, 16, 2), False),
        ((16, 16, 5), False),
        ((16, 3), False),
    ],
)
def test_what_looks_like_colours(shape: tuple[int, ...], is_colour: bool) -> None:
    builder: Any = object.__new__(LaunchBuilder)
    builder.name, builder.shape = "Readout", shape
    if not is_colour:
        builder.check_no_colour("frames")
        return
    with pytest.raises(ValueError, match=r"Readout takes frames of one channel, got shape .*: its last axis looks"):
        builder.check_no_colour("frames")
