"""Opened recording: its frames without the background, and the sensor with the threshold that suits them."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host.errors import RecordingError
from gpuvision.host.image_files import read_frame
from gpuvision.host.recordings import open_recording
from gpuvision.host.sources import ArraySource, Source
from gpuvision.ranging.background import (
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
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.triangulation_model import Along
from gpuvision.sensor.sensor import Background, Sensor

Array = npt.NDArray[Any]

_NOISE_FRAMES = 8  # of the sampled frames; enough for a quantile over all their pixels


@dataclass(frozen=True, kw_only=True)
class OpenedRecording:
    """Recording that is ready for the readout.

    Attributes
    ----------
    source : Source
        Frames, less the background if the sensor asks for that.
    name : str
        Name of the recording for messages and the report.
    sensor : Sensor
        The sensor, with the estimated threshold if it asks for one.
    """

    source: Source
    name: str
    sensor: Sensor


def open_for_scan(recording: str | Path | Source | Array, sensor: Sensor) -> OpenedRecording:
    """Open a recording, subtract its background and estimate the threshold as the sensor file asks.

    Parameters
    ----------
    recording : str, Path, Source or numpy.ndarray
        As for `gpuvision.workflows.scanning.scan`.
    sensor : Sensor
        Gives ``recording.background``, ``recording.channel`` and ``auto_threshold``.

    Returns
    -------
    OpenedRecording

    Raises
    ------
    RecordingError
        The recording or the background image cannot be read, they differ in shape, or a background or threshold is to
        be estimated from a source that gives its frames only once.
    ValueError
        The frames do not fit the sensor, or the encoder has more or fewer positions than the recording has profiles.

    Notes
    -----
    A median background and an estimated threshold need the recording to be read twice.
    """
    source, name = _open(recording, sensor)
    try:
        sensor.check_frame(source.shape, name)
        background = sensor.recording.background
        image = read_frame(background, sensor.recording.channel) if isinstance(background, Path) else None
        if background == "median" or sensor.auto_threshold:
            frames = _sampled(recording, sensor)
            image = median_background(frames[:, 0]) if background == "median" else image
            sensor = sensor_with_threshold(sensor, frames, image) if sensor.auto_threshold else sensor
        subtracted = _subtracted(source, sensor, image)
        if sensor.encoder is not None and subtracted.length is not None:
            sensor.encoder.check_length(subtracted.length, name)
    except BaseException:
        source.close()
        raise
    return OpenedRecording(source=subtracted, name=name, sensor=sensor)


def _sampled(recording: str | Path | Source | Array, sensor: Sensor) -> Array:
    """Return frames that are spread over a recording, (groups, group, rows, columns): pairs where the light alternates.

    The recording is opened a second time for them.
    """
    if isinstance(recording, Source):
        raise RecordingError(
            f"{type(recording).__name__}: a median background and an automatic threshold need a recording that can be "
            "read twice; give [recording] background the file of an image, and [line] threshold a number"
        )
    source, _ = _open(recording, sensor)
    try:
        group = 2 if sensor.recording.background in ("dark_after", "dark_before") else 1
        return sample_frames(source, group=group).frames
    finally:
        source.close()


def _open(recording: str | Path | Source | Array, sensor: Sensor) -> tuple[Source, str]:
    if isinstance(recording, Source):
        return recording, type(recording).__name__
    if isinstance(recording, np.ndarray):
        return ArraySource(recording), "array"
    return open_recording(recording, channel=sensor.recording.channel, key=sensor.recording.key), str(recording)


def _subtracted(source: Source, sensor: Sensor, image: Array | None) -> Source:
    """Return the source less its background."""
    background = sensor.recording.background
    saturation = sensor.readout.saturation
    if image is not None:
        return ImageSubtracted(source, image, saturation=saturation)
    if background == "previous":
        return PreviousSubtracted(source, saturation=saturation)
    if background in ("dark_after", "dark_before"):
        return PairsSubtracted(source, light_first=background == "dark_after", saturation=saturation)
    return source


def sensor_with_threshold(sensor: Sensor, frames: Array, image: Array | None = None) -> Sensor:
    """Return a sensor with the threshold that is estimated from frames of its recording.

    Parameters
    ----------
    sensor : Sensor
        Camera; ``recording.background`` says how the readout subtracts the background.
    frames : numpy.ndarray
        Sampled frames, (groups, group, rows, columns), as `gpuvision.ranging.background.sample_frames` returns them.
    image : numpy.ndarray or None
        Background image, (rows, columns), if one is subtracted. Default: None.

    Returns
    -------
    Sensor
        ``readout.threshold`` is the estimate, and ``readout.minimum_peak`` at least that.
    """
    readout = sensor.readout
    assert isinstance(readout, LineReadout)  # only cameras have a threshold to estimate
    level = _threshold(frames, sensor.recording.background, image, readout.along)
    minimum_peak = None if readout.minimum_peak is None else max(readout.minimum_peak, level)
    return dataclasses.replace(sensor, readout=dataclasses.replace(readout, threshold=level, minimum_peak=minimum_peak))


def ambient_level(frames: Array, sensor: Sensor) -> float:
    """Return the level [grey levels] that at most 3 % of the pixels beside the line exceed without the laser's light.

    Parameters
    ----------
    frames : numpy.ndarray
        Frames that are spread over the recording, (frames, rows, columns).
    sensor : Sensor
        Camera; its readout gives the direction of the line.
    """
    assert isinstance(sensor.readout, LineReadout)  # a camera
    profiles = _profiles(median_background(frames), sensor.readout.along)
    return unlit_level(profiles[beside_line(profiles)])


def _threshold(frames: Array, background: Background | Path, image: Array | None, along: Along) -> float:
    """Return the threshold [grey levels] for frames after the subtraction of their background."""
    middle = median_background(frames[:, 0]) if image is None else image
    few = frames[:: math.ceil(len(frames) / _NOISE_FRAMES)]
    few = few.astype(np.float32 if few.dtype.itemsize < 4 else np.float64)
    noise_factor, level, integer = 1.0, 0.0, np.issubdtype(frames.dtype, np.integer)
    if background == "dark_after":
        differences = few[:, 0] - few[:, 1]
    elif background == "dark_before":
        differences = few[:, 1] - few[:, 0]
    else:
        differences = few[:, 0] - middle
    light = _profiles(differences, along)
    if background == "previous":
        noise_factor = math.sqrt(2.0)  # a difference of two frames has the noise of both
    elif background == "none":
        level = unlit_level(middle)
        lines, unlit = _profiles(few[:, 0], along), _profiles(middle, along)
        beside = beside_line(unlit)
        darker, noise = unlit_level(unlit[beside]), noise_threshold(light[:, beside], integer=integer)
        if level > darker + noise and line_stands_still(light, lines, darker):
            level, differences = darker, light[:, beside]  # the median contains the line, which is no background
    noise = noise_factor * noise_threshold(differences, integer=integer)
    threshold = level + line_threshold(light, noise)
    return math.ceil(threshold) if integer else threshold


def _profiles(images: Array, along: Along) -> Array:
    """Return images (..., rows, columns) as profiles across the line, (..., profiles, samples)."""
    return images.swapaxes(-1, -2) if along == "columns" else images
