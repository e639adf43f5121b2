"""Uncertainty of the calibration of a rotating sheet of light."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from gpuvision.ranging.sheet_motion import RotatingSheet, Vector
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class RotatingSheetSigma:
    """Standard deviations of the calibration of a `RotatingSheet`; the errors are independent.

    Parameters
    ----------
    focal_length_px : float
        Of the focal length [px]; with a camera, of both focal lengths together. Default 0, as for all parameters.
    principal_point_px : float
        Of each coordinate of the principal point [px]. Default 0.0.
    axis_point : float
        Of each coordinate of the point on the axis [m]. Default 0.0.
    axis_direction, sheet_normal : float
        Of each of the two rotations of the direction about perpendicular directions [rad]. Defaults 0.0 and 0.0.
    sheet_offset : float
        Of the distance of the sheet from the axis point [m]. Default 0.0.
    first_angle : float
        Of the angle of profile 0 [rad]. Default 0.0.
    angle_scale : float
        Of the angle step or of the size of a count of the encoder, relative to it. Default 0.0.

    Raises
    ------
    ValueError
        A standard deviation is negative or not finite.
    """

    focal_length_px: float = 0.0
    principal_point_px: float = 0.0
    axis_point: float = 0.0
    axis_direction: float = 0.0
    sheet_normal: float = 0.0
    sheet_offset: float = 0.0
    first_angle: float = 0.0
    angle_scale: float = 0.0

    def __post_init__(self) -> None:
        for each in fields(self):
            if finite(getattr(self, each.name), f"RotatingSheetSigma.{each.name}") < 0.0:
                raise ValueError(f"RotatingSheetSigma.{each.name} is {getattr(self, each.name)}, expected 0 or more")

    def sheets(self, sheet: RotatingSheet) -> Iterator[RotatingSheet]:
        """Yield the sheet with each of its parameters changed by its standard deviation."""
        if self.focal_length_px:
            yield _with_intrinsics(sheet, self.focal_length_px, (0.0, 0.0))
        if self.principal_point_px:
            yield _with_intrinsics(sheet, 0.0, (self.principal_point_px, 0.0))
            yield _with_intrinsics(sheet, 0.0, (0.0, self.principal_point_px))
        if self.axis_point:
            for step in self.axis_point * np.eye(3):
                yield replace(sheet, axis_point=_vector(np.array(sheet.axis_point) + step))
        for each in _turned(sheet.axis_direction, self.axis_direction):
            yield replace(sheet, axis_direction=each)
        for each in _turned(sheet.sheet_normal, self.sheet_normal):
            yield replace(sheet, sheet_normal=each)
        if self.sheet_offset:
            yield replace(sheet, sheet_offset=sheet.sheet_offset + self.sheet_offset)

    def angles(self, sheet: RotatingSheet, angles: Float64) -> Iterator[Float64]:
        """Yield the angles of the profiles, (profiles,) [rad], with each of the errors of the angle."""
        if self.first_angle:
            yield angles + self.first_angle
        if self.angle_scale:
            yield angles + self.angle_scale * (angles - sheet.first_angle)


def _with_intrinsics(sheet: RotatingSheet, longer: float, moved: tuple[float, float]) -> RotatingSheet:
    """Return the sheet with another focal length and principal point [px]."""
    if sheet.camera is None:
        assert sheet.focal_length_px is not None  # RotatingSheet checks that
        assert sheet.principal_point_px is not None
        column, row = (at + by for at, by in zip(sheet.principal_point_px, moved, strict=True))
        return replace(sheet, focal_length_px=sheet.focal_length_px + longer, principal_point_px=(column, row))
    matrix = np.array(sheet.camera.matrix)
    matrix[[0, 1], [0, 1]] += longer
    matrix[:2, 2] += moved
    a, b, c = matrix.tolist()
    return replace(sheet, camera=replace(sheet.camera, matrix=(tuple(a), tuple(b), tuple(c))))


def _turned(direction: Vector, angle: float) -> Iterator[Vector]:
    """Yield a unit vector turned by an angle about the two directions perpendicular to it."""
    if angle:
        across = np.linalg.svd(np.array([direction]))[2][1:]
        for axis in across:
            yield _vector(Rotation.from_rotvec(angle * axis).apply(np.array(direction)))


def _vector(values: Float64) -> Vector:
    x, y, z = values.tolist()
    return x, y, z
