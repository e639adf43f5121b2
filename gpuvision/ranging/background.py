"""Background subtraction: sources that subtract ambient light from the frames of a laser line, and a threshold.

Each source wraps another one and subtracts in the memory of the stream, before the readout.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host.arrays import HostArray
from gpuvision.host.errors import RecordingError
from gpuvision.host.sources import Arrivals, Source, check_frame

# The threshold lies at this multiple of the distance between the median of the noise and its 0.1 % quantile: 6.2
# standard deviations of Gaussian noise. Chosen: one false sample in 1e9.
_NOISE_QUANTILE, _NOISE_FACTOR = 1e-3, 2.0
# Differences that are clipped at zero have no dark side: multiple of the distance to their 90 % quantile, also 6.2
# standard deviations.
_BRIGHT_QUANTILE, _BRIGHT_FACTOR = 0.9, 4.8
LEAST_INTEGER_THRESHOLD = 4
"""Smallest estimated threshold of integer frames [grey levels]. Chosen: above rounding and ripple of video codecs."""
# Threshold as a part of the typical peak of the line. Chosen: secondary light is usually weaker; surfaces that reflect
# less than a quarter of the typical light are lost.
_PEAK_FRACTION = 0.25
# Part of the image that a line covers at most: above this quantile a background without a subtraction is not counted.
_UNLIT_QUANTILE = 0.97
# A line that stands still lights samples up to this part of the profile from its brightest one. Chosen: eight samples
# in a window of 64, where 3 % of the profile are less than the width of a thin line.
_STILL_LINE_REACH = 1 / 8
# A line stands still if frames less their median have less than this part of its light. Chosen: a line that moves by
# more than its width keeps all of it.
_STILL_SHARE = 0.5
_LARGEST_SAMPLE_BYTES = 1 << 28
# Frames of which `FramesCopied` keeps copies, at most. Chosen: enough for the median of each pixel.
_COPIED_FRAMES = 16
_LARGEST_SAMPLE_VALUES = 1 << 22


class _Subtracted(Source):
    """Base class: a source that changes the frames of another one."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.shape, self.dtype, self.length, self.rate = source.shape, source.dtype, source.length, source.rate

    def wait(self) -> bool:
        """Wait for the next frame; return False at the end."""
        return self._source.wait()

    def damaged_frames(self) -> frozenset[int]:
        """Return the damaged frames of the wrapped source."""
        return self._source.damaged_frames()

    def stop(self) -> None:
        """Stop the wrapped source."""
        self._source.stop()

    def close(self) -> None:
        """Close the wrapped source."""
        self._source.close()


class ImageSubtracted(_Subtracted):
    """Frames of a source less one background image.

    Parameters
    ----------
    source : Source
        Frames (rows, columns).
    background : numpy.ndarray
        Background, (rows, columns), of the dtype of the frames.
    saturation : float, optional
        Level at which a pixel is saturated [grey levels]; default: the largest code of integer frames, none for floats.

    Raises
    ------
    RecordingError
        The background has another shape or dtype than the frames.

    Notes
    -----
    A pixel darker than the background becomes 0. A saturated pixel keeps its value, so that the readout flags it; where
    the background is saturated too, the pixel becomes 0. The noise of the background adds to the noise of the frame:
    the standard deviation of a pixel is ``sqrt(frame variance + background variance)``.
    """

    def __init__(self, source: Source, background: HostArray, *, saturation: float | None = None) -> None:
        super().__init__(source)
        check_frame(background, source.shape, source.dtype, "the background")
        self._background = background.copy()
        self._limit = _saturation(source.dtype, saturation)

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Read frames and subtract the background in place."""
        count = self._source.read_into(out, arrived)
        for frame in out[:count]:
            _subtract(frame, self._background, frame, self._limit)
        return count


class PreviousSubtracted(_Subtracted):
    """Frames of a source less the previous frame: for a line that moves by more than its width between frames.

    Parameters
    ----------
    source : Source
        Frames (rows, columns).
    saturation : float, optional
        As for `ImageSubtracted`.

    Notes
    -----
    The first frame has no previous frame: it becomes 0. Where the line overlaps its previous place the position is
    biased. The standard deviation of a pixel is ``sqrt(2)`` times its standard deviation in a frame.
    """

    def __init__(self, source: Source, *, saturation: float | None = None) -> None:
        super().__init__(source)
        self._limit = _saturation(source.dtype, saturation)
        self._previous: HostArray | None = None

    def damaged_frames(self) -> frozenset[int]:
        """Return the damaged frames, and the frames after them, which are less a damaged one."""
        damaged = self._source.damaged_frames()
        return damaged | {number + 1 for number in damaged}

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Read frames and subtract each one's previous frame in place."""
        count = self._source.read_into(out, arrived)
        if not count:
            return 0
        last = out[count - 1].copy()
        for k in range(count - 1, 0, -1):
            _subtract(out[k], out[k - 1], out[k], self._limit)
        if self._previous is None:
            out[0] = 0
        else:
            _subtract(out[0], self._previous, out[0], self._limit)
        self._previous = last
        return count


class PairsSubtracted(_Subtracted):
    """Frames with light less frames without light: the light source is switched on and off from frame to frame.

    Parameters
    ----------
    source : Source
        Frames (rows, columns), alternately with and without the light. A single frame at the end is left out.
    light_first : bool
        Whether the first frame of each pair has the light, default True.
    saturation : float, optional
        As for `ImageSubtracted`.

    Notes
    -----
    Two frames become one, so that ``length`` and ``rate`` are halved. The standard deviation of a pixel is ``sqrt(2)``
    times its standard deviation in a frame. A part that moves between the two frames of a pair leaves edges of its
    texture.
    """

    def __init__(self, source: Source, *, light_first: bool = True, saturation: float | None = None) -> None:
        super().__init__(source)
        self.length = None if source.length is None else source.length // 2
        self.rate = None if source.rate is None else 0.5 * source.rate
        self._light_first = light_first
        self._limit = _saturation(source.dtype, saturation)
        self._pair = np.empty((2, *source.shape), source.dtype)
        self._times: Arrivals = np.zeros(2, np.int64)
        self._held = 0

    def damaged_frames(self) -> frozenset[int]:
        """Return the pairs with a damaged frame."""
        return frozenset(number // 2 for number in self._source.damaged_frames())

    def wait(self) -> bool:
        """Wait for the next pair; return False at the end."""
        while self._held < 2:
            if not self._source.wait():
                return False
            read = self._source.read_into(self._pair[self._held :], self._times[self._held :])
            if not read:
                return False
            self._held += read
        return True

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Read pairs of frames and write their differences; a pair arrives with its second frame."""
        for filled in range(len(out)):
            if not self.wait():
                return filled
            light, dark = self._pair if self._light_first else self._pair[::-1]
            _subtract(light, dark, out[filled], self._limit)
            arrived[filled] = self._times[1]
            self._held = 0
        return len(out)


class FrameSample(NamedTuple):
    """Frames that are spread evenly over a recording.

    Attributes
    ----------
    frames : numpy.ndarray
        (groups, group, ...).
    numbers : numpy.ndarray
        Number of the first frame of each group in the recording, (groups,) int64.
    """

    frames: HostArray
    numbers: npt.NDArray[np.int64]


def sample_frames(source: Source, count: int = 16, *, group: int = 1) -> FrameSample:
    """Return frames that are spread evenly over a recording; reads it to its end.

    Parameters
    ----------
    source : Source
    count : int
        Smallest number of groups to return from a recording that has as many, default 16. Fewer, but at least 5, where
        the groups would exceed 256 MiB.
    group : int
        Number of consecutive frames in a group, default 1.

    Returns
    -------
    FrameSample
        Fewer than ``2 * count`` groups.

    Raises
    ------
    RecordingError
        The recording has no frame, or it cannot be read.
    """
    size = group * math.prod(source.shape) * source.dtype.itemsize
    count = max(5, min(count, _LARGEST_SAMPLE_BYTES // (2 * max(size, 1))))
    kept: list[HostArray] = []
    stride = 1
    for number, frames in enumerate(_groups(source, group)):
        if number % stride:
            continue
        kept.append(frames.copy())
        if len(kept) == 2 * count:
            del kept[1::2]
            stride *= 2
    if not kept:
        raise RecordingError("the recording has too few frames to sample it")
    return FrameSample(np.stack(kept), group * stride * np.arange(len(kept), dtype=np.int64))


def _groups(source: Source, group: int) -> Iterator[HostArray]:
    """Yield consecutive groups of frames in one buffer."""
    frames = np.empty((group, *source.shape), source.dtype)
    arrived = np.zeros(group, np.int64)
    held = 0
    while source.wait():
        read = source.read_into(frames[held:], arrived[held:])
        if not read:
            return
        held += read
        if held == group:
            yield frames
            held = 0


class FramesCopied(_Subtracted):
    """Frames of a source, unchanged; copies of 8 to 16 of them, spread over all frames read so far, are kept.

    Attributes
    ----------
    copies : list of numpy.ndarray
        The copies: fewer than 8 only of a shorter source.
    """

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self.copies: list[HostArray] = []
        self._step = 1
        self._read = 0

    def read_into(self, out: HostArray, arrived: Arrivals) -> int:
        """Read frames, and copy every n-th one; n doubles whenever there are more than 16 copies."""
        count = self._source.read_into(out, arrived)
        for k in range(-self._read % self._step, count, self._step):
            # The step may have doubled within the batch.
            if (self._read + k) % self._step == 0:
                self.copies.append(out[k].copy())
            if len(self.copies) > _COPIED_FRAMES:
                self.copies, self._step = self.copies[::2], 2 * self._step
        self._read += count
        return count


def median_background(frames: HostArray) -> HostArray:
    """Return the median of each pixel over frames: the background where a line lights the pixel in less than half.

    Parameters
    ----------
    frames : numpy.ndarray
        (frames, ...).

    Returns
    -------
    numpy.ndarray
        (...), of the dtype of the frames; the lower median of an even number of frames.
    """
    middle = (len(frames) - 1) // 2
    flat = np.ascontiguousarray(frames.reshape(len(frames), -1).T)
    flat.partition(middle, axis=1)
    background: HostArray = flat[:, middle].reshape(frames.shape[1:])
    return background


def noise_threshold(differences: npt.ArrayLike, *, integer: bool) -> float:
    """Estimate a threshold for the light of a line from the noise of frames less their background.

    Light only adds. The dark side of the differences is noise and flicker alone, and the threshold is twice the
    distance from their median to their 0.1 % quantile: 6.2 standard deviations of Gaussian noise.

    Parameters
    ----------
    differences : array_like
        Frames less their background, with sign, [grey levels].
    integer : bool
        Whether the frames are integers: the threshold is then a whole number of at least 4 grey levels.

    Returns
    -------
    float
        Threshold above the background [grey levels].

    Notes
    -----
    Differences that were clipped at zero have no dark side. For them, 4.8 times the distance to the 90 % quantile is
    the larger value: also 6.2 standard deviations of Gaussian noise, if the light covers less than 10 % of the image.
    """
    values = _thinned(np.asarray(differences))
    values = values[np.isfinite(values)]
    if not values.size:
        return float(LEAST_INTEGER_THRESHOLD if integer else 0)
    low, centre, high = np.quantile(values, (_NOISE_QUANTILE, 0.5, _BRIGHT_QUANTILE))
    distance = max(_NOISE_FACTOR * (centre - low), _BRIGHT_FACTOR * (high - centre) if low >= 0 else 0.0)
    threshold = float(centre + distance)
    return float(max(math.ceil(threshold), LEAST_INTEGER_THRESHOLD)) if integer else max(threshold, 0.0)


def line_threshold(light: npt.ArrayLike, noise: float) -> float:
    """Estimate a threshold from the line: a quarter of the median peak of the profiles that exceed the noise.

    Parameters
    ----------
    light : array_like
        Frames less their background, (frames, profiles, samples): each profile crosses the line [grey levels].
    noise : float
        Threshold of the noise, see `noise_threshold` [grey levels].

    Returns
    -------
    float
        Threshold above the background [grey levels], at least ``noise``.
    """
    peaks = np.asarray(light).max(axis=-1)
    lit = peaks[peaks > noise]
    return max(noise, _PEAK_FRACTION * float(np.median(lit))) if lit.size else noise


def unlit_level(background: npt.ArrayLike) -> float:
    """Return the level [grey levels] that at most 3 % of the pixels of a background exceed.

    A threshold for frames without a subtraction is this level plus `noise_threshold`.
    """
    return float(np.quantile(_thinned(np.asarray(background)), _UNLIT_QUANTILE))


def beside_line(profiles: npt.ArrayLike) -> npt.NDArray[np.bool_]:
    """Return which samples of a background are beside the line, (profiles, samples).

    For a background that contains the line, because the line stands still: samples up to an eighth of the profile from
    its brightest sample are taken for the line.

    Parameters
    ----------
    profiles : array_like
        Background, (profiles, samples): each profile crosses the line.
    """
    levels = np.asarray(profiles)
    samples = levels.shape[-1]
    beside: npt.NDArray[np.bool_] = (
        np.abs(np.arange(samples) - levels.argmax(axis=-1)[..., None]) > _STILL_LINE_REACH * samples
    )
    return beside if beside.any() else ~beside


def line_stands_still(light: npt.ArrayLike, frames: npt.ArrayLike, unlit: float) -> bool:
    """Return whether the median of the frames contains the line, because it stands still.

    Parameters
    ----------
    light : array_like
        Frames less their median, (frames, profiles, samples) [grey levels].
    frames : array_like
        The frames, of the same shape.
    unlit : float
        Level of the background `beside_line` [grey levels], see `unlit_level`.
    """
    left, whole = (float(np.median(np.asarray(each).max(axis=-1))) for each in (light, frames))
    return left < _STILL_SHARE * (whole - unlit)


def _thinned(values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return about every n-th value, at most 4e6 of them; n is odd, so that no column is preferred."""
    step = math.ceil(values.size / _LARGEST_SAMPLE_VALUES) | 1
    return values.reshape(-1)[::step].astype(np.float64)


def _saturation(dtype: np.dtype[Any], saturation: float | None) -> float:
    if saturation is not None:
        return saturation
    return float(np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else math.inf


def _subtract(frame: HostArray, background: HostArray, out: HostArray, limit: float) -> None:
    """Write ``max(frame - background, 0)``; a pixel that only the frame saturates keeps its value."""
    saturated = (frame >= limit) & (background < limit) if frame.max(initial=0) >= limit else None
    kept = frame[saturated] if saturated is not None else None
    np.maximum(frame, background, out=out)
    np.subtract(out, background, out=out)
    if saturated is not None:
        out[saturated] = kept
