"""Coordinates of laser triangulation: points in the sheet of light, sample axes of a sensor, and the kernels' table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy.typing as npt

from gpuvision.host import FloatArray, StatusArray
from gpuvision.validation import finite


class SheetPoints(NamedTuple):
    """Points in the sheet of light, each array of the input's shape.

    Attributes
    ----------
    g, h
        Coordinates along the sheet and up in the sheet [m]; NaN where the status is not OK.
    status
        uint8 `Status` flags: NOT_FINITE (u or v is not finite, or lies more than 1e6 half extents of the region away),
        NOT_INVERTIBLE (beyond the fold of the lens, or behind the tilted sensor), HORIZON (the ray does not meet the
        sheet in front of the sensor, or meets it too far away).
    sigma_g, sigma_h
        Standard deviations of g and h [m]; ``None`` unless the triangulation has the ``sigma`` of the sensor.
    """

    g: FloatArray
    h: FloatArray
    status: StatusArray
    sigma_g: FloatArray | None = None
    sigma_h: FloatArray | None = None


class SheetTable(NamedTuple):
    """Parameters of ``kernels/common/sheet.h``, in the order of its struct ``SheetTable``; ``camera`` only with one."""

    position_origin: float
    position_scale: float
    sample_origin: float
    sample_scale: float
    horizon: float
    w_terms: npt.ArrayLike
    g_terms: npt.ArrayLike
    h_terms: npt.ArrayLike
    lens: npt.ArrayLike
    factor_g: npt.ArrayLike
    factor_h: npt.ArrayLike
    camera: npt.ArrayLike = ()


@dataclass(frozen=True, kw_only=True)
class SampleAxes:
    """Affine map from the output of a readout to sensor coordinates.

    ``u = position_origin + position_pitch * position`` and ``v = sample_origin + sample_pitch * sample``, with the
    sample index counted from 0. By default position and sample index are the sensor coordinates.

    Parameters
    ----------
    sample_origin, sample_pitch : float
        v of sample 0 and distance between samples [sensor unit], default 0 and 1. The pitch is not 0.
    position_origin, position_pitch : float
        u of position 0 and size of a position unit [sensor unit], default 0 and 1. The pitch is not 0.

    Raises
    ------
    ValueError
        A pitch is 0, or a number is not finite.

    Examples
    --------
    A region of interest that begins at column 100, and a PSD of 64 strips 0.1 mm apart, in metres from the middle:

    >>> roi = SampleAxes(sample_origin=100.0)
    >>> psd = SampleAxes(sample_pitch=1e-4, sample_origin=-31.5e-4)
    """

    sample_origin: float = 0.0
    sample_pitch: float = 1.0
    position_origin: float = 0.0
    position_pitch: float = 1.0

    def __post_init__(self) -> None:
        for name in ("sample_origin", "sample_pitch", "position_origin", "position_pitch"):
            finite(getattr(self, name), f"SampleAxes.{name}")
        if self.sample_pitch == 0.0 or self.position_pitch == 0.0:
            raise ValueError("SampleAxes: a pitch is 0, expected the distance between samples in sensor units")
