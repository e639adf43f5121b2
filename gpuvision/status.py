"""Status flags of samples: the reason why a value is NaN or doubtful."""

from __future__ import annotations

import enum


class Status(enum.IntFlag):
    """Bits of the ``status`` array that every operation returns with its values; 0 means a valid sample.

    A flagged value is NaN, with exceptions that the docstring of each result names: a sample with ``SATURATED`` or
    ``AMBIGUOUS`` may keep its value, a fit with ``NOT_CONVERGED`` keeps it. The array has the type uint8, and uint16 in
    the results of fits, which may have ``NOT_CONVERGED``.
    """

    OK = 0
    """The value is good."""
    LOW_SIGNAL = 1
    """The light is weaker than the threshold of the operation."""
    SATURATED = 2
    """A channel or pixel is at its upper limit."""
    OUT_OF_RANGE = 4
    """The position lies outside the measuring range, or the border of the sensor cuts its window or light spot."""
    NOT_FINITE = 8
    """An input of the sample is NaN or infinite, or the result is too large for the number type."""
    AMBIGUOUS = 16
    """More than one candidate is about equally strong."""
    HORIZON = 32
    """The ray of the sample does not meet the sheet of light in front of the sensor, or is nearly parallel to it."""
    NO_DATA = 64
    """No measurement lies near enough to this place, or the frame of the sample is damaged."""
    NOT_INVERTIBLE = 128
    """The mapping is not one-to-one here: the lens is beyond its fold, or the sampling runs backwards."""
    NOT_CONVERGED = 256
    """The iterations of a fit ended more than a tenth of a standard deviation from the solution."""


SAMPLE_FLAGS = tuple(flag for flag in Status if 0 < flag < 256)
"""Flags of the samples of a frame or image: all but NOT_CONVERGED, which fits no array of uint8."""
