"""Status flags: why a sample is not to be trusted."""

from __future__ import annotations

import enum


class Status(enum.IntFlag):
    """Bits of the ``status`` array that every operation returns beside its values (uint8; 0 is good).

    A value that cannot be trusted is flagged *and* NaN. ``SATURATED`` and ``AMBIGUOUS`` may come with a
    value, where the operation says so: the reader decides.
    """

    OK = 0
    LOW_SIGNAL = 1
    """Less light than the threshold asks for."""
    SATURATED = 2
    """A channel or pixel at its upper limit."""
    OUT_OF_RANGE = 4
    """The light lies outside, or its window is cut by the border."""
    NOT_FINITE = 8
    """NaN or infinity came in."""
    AMBIGUOUS = 16
    """More than one candidate of comparable strength."""
    HORIZON = 32
    """The point's ray runs (nearly) parallel to the sheet of light."""
    NO_DATA = 64
    """No measurement near enough."""
    NOT_INVERTIBLE = 128
    """The sampling runs backwards here: two surfaces share one place."""
