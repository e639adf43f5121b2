"""Motion of a sheet of light over the scene: a straight transport, or a sheet that rotates in view of a camera.

- `StraightTransport`: the scene moves past a fixed sensor (conveyor belt, linear stage). A profile is a row of points
  (G, H) in the sheet of light; the transport L is read from an encoder or has a uniform step.
- `RotatingSheet`: camera and scene are fixed, the sheet turns about an axis (rotating mirror, motor). A profile is a
  row of line positions in the camera image; the transport is the angle of the sheet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Define, flags
from gpuvision.ranging.sheet import BentSheet, check_orthonormal
from gpuvision.validation import check_keys, finite, numbers

_PARALLEL = 1e-9  # volume of three unit vectors, or sine between two, below which they count as coplanar or parallel
# A vector whose length is 1 within this rounding (two epsilon) is not normalised again, so that a written vector reads
# back unchanged.
_UNIT_ROUNDING = 4e-16

Vector = tuple[float, float, float]


def _vector(value: Any, what: str) -> Vector:
    x, y, z = numbers(value, (3,), what)
    return x, y, z


def _unit(value: Any, what: str) -> Vector:
    given = _vector(value, what)
    length = math.hypot(*given)
    if not 0.0 < length < math.inf:
        raise ValueError(f"{what} has length {length:g}, expected a direction")
    if abs(length - 1.0) <= _UNIT_ROUNDING:
        return given
    x, y, z = (each / length for each in given)
    return x, y, z


def _covariance(value: Any, what: str) -> tuple[Vector, Vector, Vector]:
    rows = numbers(value, (3, 3), what)
    matrix = np.array(rows)
    if not np.allclose(matrix, matrix.T, rtol=1e-6, atol=0.0) or np.any(np.diag(matrix) < 0.0):
        raise ValueError(f"{what} is {matrix.tolist()}, expected a symmetric matrix with variances of 0 or more")
    a, b, c = rows
    return a, b, c


def _check_jitter(transport: StraightTransport | RotatingSheet) -> None:
    what = f"{type(transport).__name__}.jitter"
    object.__setattr__(transport, "jitter", finite(transport.jitter, what))
    if transport.jitter < 0.0:
        raise ValueError(f"{what} is {transport.jitter}, expected 0 or more")


class StraightTable(NamedTuple):
    """Parameters of ``kernels/range_image/range_image.cl`` after the limits, for a straight transport."""

    origin: npt.ArrayLike
    e1: npt.ArrayLike
    e2: npt.ArrayLike
    e3: npt.ArrayLike


class BentTable(NamedTuple):
    """Parameters of a bent sheet in ``kernels/range_image/range_image.cl``, at the end of `StraightTable`."""

    bend: npt.ArrayLike
    pinhole: npt.ArrayLike
    across: npt.ArrayLike


class RotatingTable(NamedTuple):
    """Parameters of ``kernels/range_image/range_image.cl`` after the limits, under ``GEOMETRY_ROTATING``."""

    origin: npt.ArrayLike
    e1: npt.ArrayLike
    e2: npt.ArrayLike
    e3: npt.ArrayLike
    position_origin: float
    sample_origin: float
    position_scale: float
    sample_scale: float
    horizon: float
    normal: npt.ArrayLike
    reach: npt.ArrayLike
    lens: npt.ArrayLike
    camera: npt.ArrayLike


@dataclass(frozen=True, kw_only=True)
class StraightTransport:
    """Straight transport under a sheet of light: ``point = origin + G g_axis + H h_axis + L direction``.

    By default G is along x, the transport along y, and the height H along z. A tilted sheet has tilted axes: for light
    at an angle theta from the vertical, along the transport, and heights H that were calibrated vertically, ``h_axis =
    (0, tan(theta), 1)`` (the sheared sampling of Figure 2.5).

    Parameters
    ----------
    step : float, optional
        Transport per profile [m], not 0, used by `transport`; ``None`` if an encoder measures the transport.
    start : float
        Transport of profile 0 [m], default 0.
    g_axis, h_axis : (3,) array_like
        Directions of G and H in the scene; of length 1 if G and H are metres along them. Defaults ``(1.0, 0.0, 0.0)``
        and ``(0.0, 0.0, 1.0)``.
    direction : (3,) array_like
        Direction of the transport, from a profile to the next one; it is normalised. Default ``(0.0, 1.0, 0.0)``.
    origin : (3,) array_like
        Point G = H = 0 of the sheet at L = 0 [m]. Default ``(0.0, 0.0, 0.0)``.
    jitter : float
        Standard deviation of the transport of a profile [m], >= 0, default 0; part of the predicted random errors.
    bend : BentSheet, optional
        Deviation of the light from the mean plane of the sheet, to which G and H refer; ``g_axis`` and ``h_axis`` must
        then be orthonormal. Default: a flat sheet.
    covariance : (3, 3) array_like, optional
        Covariance of the displacement in the scene per metre of transport, symmetric: along ``direction`` the squared
        relative error of the step, across it the variance of the direction [rad^2]. Part of the predicted systematic
        errors, which are 0 at L = 0. Default: not known.

    Raises
    ------
    ValueError
        A number is not finite, the step is 0, the three directions lie in one plane, the axes of a bent sheet are not
        orthonormal, or a covariance is not symmetric with variances >= 0.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3.5.
    """

    step: float | None = None
    start: float = 0.0
    g_axis: Vector = (1.0, 0.0, 0.0)
    h_axis: Vector = (0.0, 0.0, 1.0)
    direction: Vector = (0.0, 1.0, 0.0)
    origin: Vector = (0.0, 0.0, 0.0)
    jitter: float = 0.0
    bend: BentSheet | None = None
    covariance: tuple[Vector, Vector, Vector] | None = None

    def __post_init__(self) -> None:
        _check_jitter(self)
        if self.step is not None:
            object.__setattr__(self, "step", finite(self.step, "StraightTransport.step"))
        if self.step == 0.0:
            raise ValueError("StraightTransport.step is 0, expected metres per profile, or None with an encoder")
        object.__setattr__(self, "start", finite(self.start, "StraightTransport.start"))
        for name in ("g_axis", "h_axis", "origin"):
            object.__setattr__(self, name, _vector(getattr(self, name), f"StraightTransport.{name}"))
        object.__setattr__(self, "direction", _unit(self.direction, "StraightTransport.direction"))
        axes = np.array([self.g_axis, self.h_axis, self.direction])
        if abs(np.linalg.det(axes)) <= _PARALLEL * np.prod(np.linalg.norm(axes, axis=1)):
            raise ValueError("StraightTransport: g_axis, h_axis and direction lie in one plane; expected a volume")
        if self.bend is not None:
            check_orthonormal((self.g_axis, self.h_axis), "StraightTransport: g_axis and h_axis of a bent sheet")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", _covariance(self.covariance, "StraightTransport.covariance"))

    def transport(self, profiles: int, first: int = 0) -> npt.NDArray[np.float64]:
        """Return the transport of the profiles ``first``, ``first + 1``, ... for a uniform step [m], shape (profiles,).

        In single precision keep it within some metres of the origin: the rounding error is 6e-8 of it.

        Raises
        ------
        ValueError
            The step is None: use the positions of an encoder.
        """
        if self.step is None:
            raise ValueError("StraightTransport has no step; give the encoder's positions [m], one per profile")
        return self.start + self.step * np.arange(first, first + profiles, dtype=np.float64)

    @property
    def inputs(self) -> int:
        """Number of profile arrays that `RangeImage` takes: 2 (g and h)."""
        return 2

    def defines(self, real: npt.DTypeLike) -> dict[str, Define]:
        """Return the options of ``kernels/range_image/range_image.cl`` for a kernel with the real type ``real``."""
        return {} if self.bend is None else {"SHEET_BENT": None}

    def packed(self, real: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Return the part of the kernel's parameter table after the limits, of type ``real``."""
        straight = StraightTable(origin=self.origin, e1=self.g_axis, e2=self.h_axis, e3=self.direction)
        if self.bend is None:
            return np.hstack(straight).astype(real)
        # The kernel's terms and normal are in units of the distance of the pinhole.
        distance = self.bend.pinhole[2]
        bent = BentTable(
            bend=np.array(self.bend.terms) / distance,
            pinhole=self.bend.pinhole[:2],
            across=distance * np.cross(self.g_axis, self.h_axis),
        )
        return np.hstack([*straight, *bent]).astype(real)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, lists and tables, as in a TOML file."""
        table: dict[str, Any] = {} if self.step is None else {"step": self.step}
        table |= {"start": self.start} | ({"jitter": self.jitter} if self.jitter else {})
        table |= {name: list(getattr(self, name)) for name in ("g_axis", "h_axis", "direction", "origin")}
        if self.covariance is not None:
            table["covariance"] = [list(row) for row in self.covariance]
        return table if self.bend is None else {**table, "bend": self.bend.to_dict()}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> StraightTransport:
        """Build a transport from a table; its keys are names of parameters.

        Raises
        ------
        TypeError, ValueError
            A key is unknown, or a value has the wrong type or range.
        """
        values = dict(check_keys(table, cls.__dataclass_fields__, (), "straight transport"))
        if "bend" in values:
            values["bend"] = BentSheet.from_dict(values["bend"])
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class RotatingSheet:
    """Sheet of light that rotates about an axis, in view of a fixed camera.

    Camera frame: x right, y down, z forward, pinhole at 0. At angle 0 the sheet is the plane
    ``sheet_normal . (X - axis_point) = sheet_offset``; it turns right-handed about the axis. With n the turned normal,
    the ray ``r = (a, b, 1)`` of a pixel meets the sheet at ``depth = (sheet_offset + n . axis_point) / (n . r)``.

    Parameters
    ----------
    camera : Camera, optional
        Calibrated camera, with its distortion and the tilt of its sensor; `Camera.in_window` gives the camera of a
        region of interest. Without it ``focal_length_px`` and ``principal_point_px`` are required.
    focal_length_px : float, optional
        Focal length of a camera that is not calibrated [px], positive.
    principal_point_px : (column, row), optional
        Image of its optical axis [px]; a region of interest shifts it.
    axis_point, axis_direction : (3,) array_like
        A point [m] on the axis of rotation and the direction of the axis, in the camera frame.
    sheet_normal : (3,) array_like
        Normal of the sheet at angle 0, in the camera frame; it is normalised.
    sheet_offset : float
        Distance of the sheet from the axis point along its normal [m], default 0: a sheet through the axis.
    first_angle, angle_step : float
        Angle of profile 0 and its change per profile [rad], used by `transport`. ``angle_step`` is ``None`` if an
        encoder measures the angle.
    jitter : float
        Standard deviation of the angle of a profile [rad], >= 0, default 0; part of the predicted random errors.
    along : {"rows", "columns"}
        Image axis along which the samples of a profile run, default ``"rows"``: one sample per row, the position is a
        column (a vertical line). ``"columns"``: one sample per column, the position is a row.
    lens : Lens, optional
        Radial lens distortion of a camera that is not calibrated, corrected in the positions.
    scene_axes : (3, 3) array_like
        Axes x, y and z of the scene in the camera frame, orthonormal: the rows of the rotation camera -> scene. Default
        ``((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))``.
    scene_origin : (3,) array_like
        Origin of the scene in the camera frame [m]. Default ``(0.0, 0.0, 0.0)``.
    horizon : float
        Smallest ``n . r`` of a valid point, default 1e-4: about the sine of the angle between ray and sheet.

    Raises
    ------
    ValueError
        A number is not finite or out of its range, the axes are not orthonormal, the normal of the sheet lies along the
        axis, so that turning does not move the sheet, or a camera is given together with a focal length, a principal
        point or a lens.
    """

    axis_point: Vector
    axis_direction: Vector
    sheet_normal: Vector
    camera: Camera | None = None
    focal_length_px: float | None = None
    principal_point_px: tuple[float, float] | None = None
    sheet_offset: float = 0.0
    first_angle: float = 0.0
    angle_step: float | None = None
    jitter: float = 0.0
    along: Literal["rows", "columns"] = "rows"
    lens: Lens | None = None
    scene_axes: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scene_origin: Vector = (0.0, 0.0, 0.0)
    horizon: float = 1e-4

    def __post_init__(self) -> None:
        _check_jitter(self)
        self._check_camera()
        for name in ("sheet_offset", "first_angle", "horizon"):
            object.__setattr__(self, name, finite(getattr(self, name), f"RotatingSheet.{name}"))
        if self.horizon <= 0.0:
            raise ValueError(f"RotatingSheet.horizon is {self.horizon}, expected a number above 0")
        if self.angle_step is not None:
            object.__setattr__(self, "angle_step", finite(self.angle_step, "RotatingSheet.angle_step"))
        if self.along not in ("rows", "columns"):
            raise ValueError(f"RotatingSheet.along is {self.along!r}, expected 'rows' or 'columns'")
        self._check_directions()

    def _check_camera(self) -> None:
        pinhole = (self.focal_length_px, self.principal_point_px)
        if self.camera is not None:
            if (*pinhole, self.lens) != (None, None, None):
                raise ValueError(
                    "RotatingSheet has a camera and focal_length_px, principal_point_px or lens; the camera has them"
                )
            return
        if None in pinhole:
            raise ValueError("RotatingSheet needs a camera, or focal_length_px and principal_point_px")
        focal = finite(self.focal_length_px, "RotatingSheet.focal_length_px")
        if focal <= 0.0:
            raise ValueError(f"RotatingSheet.focal_length_px is {focal}, expected a number above 0")
        point = numbers(self.principal_point_px, (2,), "RotatingSheet.principal_point_px (column, row)")
        object.__setattr__(self, "focal_length_px", focal)
        object.__setattr__(self, "principal_point_px", point)

    def _intrinsics(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the focal lengths and the principal point of columns and rows [px]."""
        if self.camera is not None:
            matrix = np.array(self.camera.matrix)
            return np.diag(matrix)[:2], matrix[:2, 2]
        return np.full(2, self.focal_length_px, dtype=np.float64), np.array(self.principal_point_px)

    def _check_directions(self) -> None:
        for name in ("axis_point", "scene_origin"):
            object.__setattr__(self, name, _vector(getattr(self, name), f"RotatingSheet.{name}"))
        for name in ("axis_direction", "sheet_normal"):
            object.__setattr__(self, name, _unit(getattr(self, name), f"RotatingSheet.{name}"))
        if np.linalg.norm(np.cross(self.axis_direction, self.sheet_normal)) <= _PARALLEL:
            raise ValueError("RotatingSheet: the sheet's normal lies along the axis, so that turning does not move it")
        axes = numbers(self.scene_axes, (3, 3), "RotatingSheet.scene_axes")
        check_orthonormal(axes, "RotatingSheet.scene_axes")
        object.__setattr__(self, "scene_axes", axes)

    def transport(self, profiles: int, first: int = 0) -> npt.NDArray[np.float64]:
        """Return the angle of the sheet in the profiles ``first``, ``first + 1``, ... for a uniform step [rad].

        Raises
        ------
        ValueError
            The step is None: use the angles of an encoder.
        """
        if self.angle_step is None:
            raise ValueError("RotatingSheet has no angle_step; give the encoder's angles [rad], one per profile")
        return self.first_angle + self.angle_step * np.arange(first, first + profiles, dtype=np.float64)

    def normals(self) -> npt.NDArray[np.float64]:
        """Return three vectors v in the camera frame: ``normal = v[0] + v[1] cos(angle) + v[2] sin(angle)``."""
        axis, normal = np.array(self.axis_direction), np.array(self.sheet_normal)
        fixed = axis * (axis @ normal)
        return np.stack([fixed, normal - fixed, np.cross(axis, normal)])

    @property
    def inputs(self) -> int:
        """Number of profile arrays that `RangeImage` takes: 1 (the position)."""
        return 1

    def defines(self, real: npt.DTypeLike) -> dict[str, Define]:
        """Return the options of ``kernels/range_image/range_image.cl`` for a kernel with the real type ``real``."""
        options: dict[str, Define] = {"GEOMETRY_ROTATING": None}
        if self.lens is not None:
            options |= self.lens.defines
        if self.camera is not None and self.camera.distorts:
            # Normalised coordinates are corrected: their unit is the focal length.
            options |= self.camera.correction_defines(real, min(self._intrinsics()[0]))
            options |= flags(SAMPLES_ARE_COLUMNS=self.along == "columns")
        return options

    def packed(self, real: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Return the part of the kernel's parameter table after the limits, of type ``real``."""
        # The kernel's coordinates are (position, sample) instead of (column, row).
        order = [0, 1, 2] if self.along == "rows" else [1, 0, 2]
        to_scene, normals = np.array(self.scene_axes), self.normals()
        reach = normals @ np.array(self.axis_point) + self.sheet_offset * np.array([1.0, 0.0, 0.0])
        focal, centre = (each[order[:2]] for each in self._intrinsics())
        scale = 1.0 / focal
        lens = self.lens if self.lens is None or self.along == "rows" else self.lens.swapped()
        e1, e2, e3 = to_scene.T[order]
        table = RotatingTable(
            origin=-to_scene @ np.array(self.scene_origin),
            e1=e1,
            e2=e2,
            e3=e3,
            position_origin=centre[0],
            sample_origin=centre[1],
            position_scale=scale[0],
            sample_scale=scale[1],
            horizon=self.horizon,
            normal=normals[:, order].ravel(),
            reach=reach,
            lens=np.empty(0) if lens is None else lens.packed(centre.tolist(), scale[0]),
            camera=np.empty(0) if self.camera is None else self._correction(real, self.camera),
        )
        return np.hstack(table).astype(real)

    def _correction(self, real: npt.DTypeLike, camera: Camera) -> npt.NDArray[Any]:
        """Return the table of ``camera_correction`` for normalised coordinates; empty without distortion."""
        if not camera.distorts:
            return np.empty(0)
        return camera.packed_correction(real, first=(0.0, 0.0), pitch=(1.0, 1.0), unit=self._intrinsics()[0])

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and lists, as in a TOML file."""
        table: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, Lens | Camera):
                table[name] = value.to_dict()
            elif value is not None and (name != "jitter" or value):
                table[name] = np.array(value).tolist() if isinstance(value, tuple) else value
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> RotatingSheet:
        """Build a rotating sheet from a table; its keys are names of parameters; lens and camera are tables.

        Raises
        ------
        TypeError, ValueError
            A key is unknown or missing, or a value has the wrong type or range.
        """
        required = ("axis_point", "axis_direction", "sheet_normal")
        values = dict(check_keys(table, cls.__dataclass_fields__, required, "rotating sheet"))
        if "lens" in values:
            values["lens"] = Lens.from_dict(values["lens"])
        if "camera" in values:
            values["camera"] = Camera.from_dict(values["camera"])
        return cls(**values)
