"""Channels of colour frames."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import cv2
import numpy as np

from gpuvision.host.arrays import HostArray
from gpuvision.host.errors import RecordingError

Channel = Literal["grey", "red", "green", "blue", "max", "red_difference", "green_difference", "blue_difference"]

CHANNELS: tuple[Channel, ...] = get_args(Channel)
_DIFFERENCE = "_difference"
_PLACES = {"blue": 0, "green": 1, "red": 2}


def channel_copier(channel: Channel, shape: tuple[int, ...], what: str) -> Callable[[HostArray, HostArray], object]:
    """Return the function that copies one channel of a frame (blue, green, red, ...) to an array.

    Parameters
    ----------
    channel : {"grey", "red", "green", "blue", "max", "red_difference", "green_difference", "blue_difference"}
        Channel as in `gpuvision.host.open_recording`.
    shape : tuple of int
        (rows, columns), or (rows, columns, 3 or 4).
    what : str
        Name of the frame for messages.

    Raises
    ------
    RecordingError
        The frames are grey and the channel is a colour, or the shape is not one of a frame.
    """
    if len(shape) == 2:
        if channel not in ("grey", "max"):
            raise RecordingError(f"{what}: has no {channel} channel, the frames are grey; use channel 'grey'")
        return lambda frame, out: np.copyto(out, frame)
    if len(shape) != 3 or shape[2] not in (3, 4):
        raise RecordingError(f"{what}: expected grey or colour frames, got shape {shape}")
    if channel == "grey":
        code = cv2.COLOR_BGR2GRAY if shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return lambda frame, out: cv2.cvtColor(frame, code, out)
    if channel == "max":
        return lambda frame, out: np.max(frame[:, :, :3], axis=2, out=out)
    if channel.endswith(_DIFFERENCE):
        return lambda frame, out: _colour_difference(frame, _PLACES[channel.removesuffix(_DIFFERENCE)], out)
    return lambda frame, out: cv2.extractChannel(frame, _PLACES[channel], out)


def _colour_difference(frame: HostArray, place: int, out: HostArray) -> None:
    """Write one of blue, green, red minus the luma, 0 where it is negative."""
    luma = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY if frame.shape[2] == 3 else cv2.COLOR_BGRA2GRAY)
    cv2.extractChannel(frame, place, out)
    np.maximum(out, luma, out=out)
    np.subtract(out, luma, out=out)
