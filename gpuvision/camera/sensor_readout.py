"""Readout of an image sensor: taps, pixel clock, region of interest and shutter give row time, frame time and delay."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

from gpuvision.validation import finite, integer

Shutter = Literal["global", "rolling"]


class FrameTiming(NamedTuple):
    """Times of one frame of a region of interest [s].

    Attributes
    ----------
    exposure
        Time during which one row collects light: the exposure, or the flash.
    row_time
        Time to read one row.
    readout
        Time to read all rows.
    period
        Least time from frame to frame.
    skew
        Time from the exposure of the first row to the exposure of the last row; 0 with a global shutter or a flash.
    delay
        Time from the middle of the exposure, averaged over the rows, to the last pixel of the frame in the computer, at
        the highest frame rate. At a lower rate each frame buffer adds the period of that rate.
    """

    exposure: float
    row_time: float
    readout: float
    period: float
    skew: float
    delay: float

    @property
    def rate(self) -> float:
        """Highest frame rate [Hz]."""
        return 1.0 / self.period


@dataclass(frozen=True, kw_only=True)
class SensorReadout:
    """Readout of an image sensor.

    Parameters
    ----------
    pixel_clock : float
        Pixels per second of one tap [Hz], above 0.
    taps : int
        Number of pixels that leave the sensor at the same time, default 1. Range: 1 or more.
    shutter : {"global", "rolling"}
        "global": all rows collect light at the same time. "rolling": each row is read, and starts again, one row time
        after the row before. Default "global".
    row_overhead, frame_overhead : float
        Time for each row and for each frame without pixels [s], default 0. Range: 0 or more.
    overlaps : bool
        Whether a global shutter collects light for a frame while the frame before is read. A rolling shutter always
        does so. Default True.
    buffers : int
        Number of complete frames that are stored before the transfer; each one adds a period to the delay. Default 0.
        Range: 0 or more.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 7.5.
    """

    pixel_clock: float
    taps: int = 1
    shutter: Shutter = "global"
    row_overhead: float = 0.0
    frame_overhead: float = 0.0
    overlaps: bool = True
    buffers: int = 0

    def __post_init__(self) -> None:
        finite(self.pixel_clock, "SensorReadout.pixel_clock [Hz]", above=0.0)
        finite(self.row_overhead, "SensorReadout.row_overhead [s]", minimum=0.0)
        finite(self.frame_overhead, "SensorReadout.frame_overhead [s]", minimum=0.0)
        integer(self.taps, "SensorReadout.taps", minimum=1)
        integer(self.buffers, "SensorReadout.buffers", minimum=0)
        if self.shutter not in ("global", "rolling"):
            raise ValueError(f"SensorReadout.shutter is {self.shutter!r}, expected 'global' or 'rolling'")
        if not isinstance(self.overlaps, bool):
            raise TypeError(f"SensorReadout.overlaps must be True or False, got {self.overlaps!r}")

    @property
    def pixel_bandwidth(self) -> float:
        """Pixels per second of all taps, without overhead [Hz]."""
        return self.taps * self.pixel_clock

    def timing(self, shape: tuple[int, int], exposure: float, *, flash: bool = False) -> FrameTiming:
        """Return the times of a frame.

        Parameters
        ----------
        shape
            Rows and columns of the region of interest that are read.
        exposure
            Time during which a row collects light [s]; with ``flash`` the length of the flash. Range: above 0.
        flash
            Whether a flash is the only light. All rows then collect light at the same time; a rolling shutter has to
            open all rows before the flash and to read them after it. Default False.

        Notes
        -----
        Row time: ceil(columns / taps) / pixel_clock + row_overhead; readout: rows x row_time + frame_overhead.

        ======================= ============================ ========
        shutter                 period                       skew
        ======================= ============================ ========
        global, overlapping     max(exposure, readout)       0
        global, not overlapping exposure + readout           0
        rolling                 max(exposure, readout)       (rows - 1) row_time
        rolling with a flash    exposure + readout           0
        ======================= ============================ ========

        Delay: exposure / 2 + readout - skew / 2 + buffers x period.
        """
        rows, columns = (integer(each, "rows and columns of a region", minimum=1) for each in shape)
        lit = finite(exposure, "exposure [s]", above=0.0)
        row_time = math.ceil(columns / self.taps) / self.pixel_clock + self.row_overhead
        readout = rows * row_time + self.frame_overhead
        is_rolling = self.shutter == "rolling"
        overlaps = not flash if is_rolling else self.overlaps
        period = max(lit, readout) if overlaps else lit + readout
        skew = (rows - 1) * row_time if is_rolling and not flash else 0.0
        delay = lit / 2.0 + readout - skew / 2.0 + self.buffers * period
        return FrameTiming(lit, row_time, readout, period, skew, delay)
