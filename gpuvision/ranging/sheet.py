"""Laser triangulation: points in the sheet of light, shape of the sheet, sample axes of a sensor, kernel tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import FloatArray, StatusArray
from gpuvision.validation import check_keys, finite, numbers

# Largest difference of scalar products of given axes from 0 and 1. Chosen: axes written with 6 decimals pass.
_ORTHONORMAL = 1e-6


class SheetPoints(NamedTuple):
    """Points in the sheet of light, each array of the input's shape.

    Attributes
    ----------
    g, h
        Coordinates along the sheet and up in the sheet [m]; NaN where the status is not OK.
    status
        uint8 `Status` flags: NOT_FINITE (u or v is not finite, or lies more than 1e6 half extents of the region away),
        NOT_INVERTIBLE (beyond the fold of the lens, or behind the tilted sensor), OUT_OF_RANGE (outside of the
        region of plane polynomials), HORIZON (the ray does not meet the sheet in front of the sensor, or meets it too
        far away).
    sigma_g, sigma_h
        Standard deviations of g and h [m]; ``None`` unless the triangulation has the ``sigma`` of the sensor.
    """

    g: FloatArray
    h: FloatArray
    status: StatusArray
    sigma_g: FloatArray | None = None
    sigma_h: FloatArray | None = None


class SheetTable(NamedTuple):
    """Parameters of ``kernels/common/sheet.h``, in the order of its struct; unused distortions are empty."""

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
    plane_origin: npt.ArrayLike = ()
    plane_scale: npt.ArrayLike = ()
    plane_unit: npt.ArrayLike = ()
    plane_terms: npt.ArrayLike = ()


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


@dataclass(frozen=True, kw_only=True)
class BentSheet:
    """Deviation of the sheet of light from its mean plane, a quadratic surface: ``d = gg G^2 + gh G H + hh H^2``.

    d is the distance from the mean plane, along the normal ``g_axis x h_axis``. A triangulation gives the point Q at
    which the ray of the camera meets the mean plane; the light lies on the same ray, at ``P = Q + s (E - Q)`` with the
    pinhole E of the camera.

    Parameters
    ----------
    terms : (gg, gh, hh)
        Coefficients of the surface [1/m].
    pinhole : (G, H, D)
        Pinhole of the camera: its coordinates in the mean plane, and its distance from it along the normal [m], not 0.

    Raises
    ------
    ValueError
        A number is not finite, or the pinhole lies in the mean plane.
    """

    terms: tuple[float, float, float]
    pinhole: tuple[float, float, float]

    def __post_init__(self) -> None:
        object.__setattr__(self, "terms", numbers(self.terms, (3,), "BentSheet.terms (gg, gh, hh)"))
        object.__setattr__(self, "pinhole", numbers(self.pinhole, (3,), "BentSheet.pinhole"))
        if self.pinhole[2] == 0.0:
            raise ValueError("BentSheet.pinhole lies in the mean plane of the sheet: nothing can be triangulated")

    @classmethod
    def from_pose(
        cls, terms: npt.ArrayLike, *, origin: npt.ArrayLike, g_axis: npt.ArrayLike, h_axis: npt.ArrayLike
    ) -> BentSheet:
        """Build a bent sheet from the pose of its mean plane in the camera frame, where the pinhole is 0.

        Parameters
        ----------
        terms : (3,) array_like
            As in the class.
        origin, g_axis, h_axis : (3,) array_like
            Point G = H = 0 [m] and directions of G and H, orthonormal.

        Raises
        ------
        ValueError
            The axes are not orthonormal, or the class refuses the values.
        """
        g, h, start = (np.array(numbers(each, (3,), "BentSheet.from_pose")) for each in (g_axis, h_axis, origin))
        check_orthonormal((g, h), "BentSheet.from_pose: g_axis and h_axis")
        pinhole = numbers([-start @ g, -start @ h, -start @ np.cross(g, h)], (3,), "BentSheet.pinhole")
        return cls(terms=numbers(terms, (3,), "BentSheet.terms (gg, gh, hh)"), pinhole=pinhole)

    def to_dict(self) -> dict[str, Any]:
        """Return lists of numbers, as in a TOML file."""
        return {"terms": list(self.terms), "pinhole": list(self.pinhole)}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> BentSheet:
        """Build a bent sheet from the table of `to_dict`.

        Raises
        ------
        TypeError, ValueError
            A key is unknown or missing, or a value has the wrong type or range.
        """
        return cls(**check_keys(table, ("terms", "pinhole"), ("terms", "pinhole"), "bent sheet"))


def check_orthonormal(axes: Sequence[npt.ArrayLike], what: str) -> None:
    """Check that vectors have length 1 and are perpendicular to each other.

    Raises
    ------
    ValueError
        A scalar product differs from 0 or 1 by more than 1e-6, so that axes written with 6 decimals pass.
    """
    matrix = np.array(axes, dtype=np.float64)
    if np.max(np.abs(matrix @ matrix.T - np.eye(len(matrix)))) > _ORTHONORMAL:
        raise ValueError(f"{what} are not {'two' if len(matrix) == 2 else 'three'} orthonormal vectors")
