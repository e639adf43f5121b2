"""Range images: profiles over a moving sheet of light become x, y, z for every (profile, sample).

Two ways to move the sheet over a scene:

- `StraightTransport`: the scene moves past a sensor that stands still (a conveyor belt, a stage). Profiles come as
  points (G, H) in the sheet of light, the transport L from an encoder or at a uniform step.
- `RotatingSheet`: camera and scene stand still, the sheet turns about an axis (a rotating mirror, a motor). Profiles
  come as the line's position in the camera image, the transport is the sheet's angle.

The result is *organised*: neighbours in the arrays are neighbours on the sensor. `gpuvision.ranging.regrid` turns it
into a height map over regular cells.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.host import Device, Launch, LaunchBuilder, Precision, Variant, WorkSize, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.validation import check_keys, finite, numbers

_STRIP = 1024  # samples, as in range_image.cl
_LANES = 16
_PARALLEL = 1e-9
# A vector so near length 1 is one that was divided by its length: what was written reads back as it was.
_UNIT_ROUNDING = 4e-16

Vector = tuple[float, float, float]
Limits = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_EVERYWHERE: Limits = ((-math.inf, math.inf),) * 3


class RangePoints(NamedTuple):
    """An organised range image, each array (profiles, samples).

    Attributes
    ----------
    x, y, z
        The point in the scene [m]; NaN where a flag other than SATURATED and AMBIGUOUS is set.
    status
        uint8 `Status` flags: those that came in, and NOT_FINITE (a coordinate, the transport, or the result is not),
        NOT_INVERTIBLE (beyond the lens' fold), HORIZON (the ray does not meet the sheet in front of the camera),
        OUT_OF_RANGE (outside the limits).
    """

    x: Any
    y: Any
    z: Any
    status: Any


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


@dataclass(frozen=True, kw_only=True)
class StraightTransport:
    """A sheet of light over which the scene moves straight: ``point = origin + G g_axis + H h_axis + L direction``.

    The defaults put G on x, the transport on y, and H, the height, on z (F. de Jong, 2.3.5). A tilted sheet has tilted
    axes: with the light at an angle theta from the vertical, along the transport, ``h_axis = (0, tan(theta), 1)`` for
    heights H that were calibrated vertically (the sheared sampling of fig. 2.5).

    Parameters
    ----------
    step
        Transport per profile [m], for `transport`; None where an encoder measures every profile's.
    start
        Transport of profile 0 [m].
    g_axis, h_axis
        Where the sheet's coordinates point, in the scene; of length 1 where G and H are metres along them.
    direction
        Where the next profile lies; made a unit vector.
    origin
        The sheet's G = H = 0 at L = 0 [m].

    Raises
    ------
    ValueError
        A number is not finite, the step is 0, or the three directions lie in one plane.
    """

    step: float | None = None
    start: float = 0.0
    g_axis: Vector = (1.0, 0.0, 0.0)
    h_axis: Vector = (0.0, 0.0, 1.0)
    direction: Vector = (0.0, 1.0, 0.0)
    origin: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
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

    def transport(self, profiles: int, first: int = 0) -> npt.NDArray[np.float64]:
        """Transport of profiles `first`, `first` + 1, ... [m], where it is uniform.

        In single precision keep it within some metres of the origin: rounding is 6e-8 of it.

        Raises
        ------
        ValueError
            There is no uniform step; give the encoder's positions.
        """
        if self.step is None:
            raise ValueError("StraightTransport has no step; give the encoder's positions [m], one per profile")
        return self.start + self.step * np.arange(first, first + profiles, dtype=np.float64)

    @property
    def inputs(self) -> int:
        """Number of arrays per sample that `RangeImage` takes: g and h."""
        return 2

    @property
    def defines(self) -> dict[str, None]:
        """What ``kernels/range_image/range_image.cl`` has to compile."""
        return {}

    def packed(self) -> npt.NDArray[np.float64]:
        """Table of ``kernels/range_image/range_image.cl`` after its limits."""
        return np.concatenate([self.origin, self.g_axis, self.h_axis, self.direction])

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, as TOML holds them."""
        numbers = {name: list(getattr(self, name)) for name in ("g_axis", "h_axis", "direction", "origin")}
        return ({} if self.step is None else {"step": self.step}) | {"start": self.start} | numbers

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> StraightTransport:
        """Build one from a table with some of the parameters' names.

        Raises
        ------
        TypeError, ValueError
            A key is unknown, or a value is not what it should be.
        """
        return cls(**check_keys(table, cls.__dataclass_fields__, (), "straight transport"))


@dataclass(frozen=True, kw_only=True)
class RotatingSheet:
    """A sheet of light that turns about an axis, seen by a camera at rest.

    Camera frame: x right, y down, z forward, the pinhole at 0. At angle 0 the sheet is the plane
    ``sheet_normal . (X - axis_point) = sheet_offset``; it turns right-handed about the axis. A pixel's ray
    ``r = (a, b, 1)`` meets it at ``depth = (sheet_offset + n . axis_point) / (n . r)``.

    Parameters
    ----------
    focal_length_px
        Focal length [pixel].
    principal_point_px
        (column, row) of the optical axis; a region of interest shifts it.
    axis_point, axis_direction
        A point [m] and the direction of the axis of rotation, in the camera frame.
    sheet_normal
        Normal of the sheet at angle 0, in the camera frame; made a unit vector.
    sheet_offset
        Distance of the sheet from the axis point along its normal [m]; 0 for a sheet through the axis.
    first_angle, angle_step
        Angle of profile 0 and its change per profile [rad], for `transport`; None where an encoder measures it.
    along
        What the samples of a profile run along. ``"rows"``: one sample per row, the position is a column (a vertical
        line); ``"columns"``: one sample per column, the position is a row.
    lens
        Undone in the coordinates; None for a pinhole.
    scene_axes
        The scene's x, y and z axes in the camera frame, orthonormal: rows of the rotation camera -> scene.
    scene_origin
        The scene's origin in the camera frame [m].
    horizon
        Least ``n . r`` that counts: about the sine of the angle between ray and sheet.

    Raises
    ------
    ValueError
        A number is not finite or out of its range, the axes are not orthonormal, or the sheet does not move when
        turned (its normal lies along the axis).
    """

    focal_length_px: float
    principal_point_px: tuple[float, float]
    axis_point: Vector
    axis_direction: Vector
    sheet_normal: Vector
    sheet_offset: float = 0.0
    first_angle: float = 0.0
    angle_step: float | None = None
    along: Literal["rows", "columns"] = "rows"
    lens: Lens | None = None
    scene_axes: tuple[Vector, Vector, Vector] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    scene_origin: Vector = (0.0, 0.0, 0.0)
    horizon: float = 1e-4

    def __post_init__(self) -> None:
        for name in ("focal_length_px", "sheet_offset", "first_angle", "horizon"):
            object.__setattr__(self, name, finite(getattr(self, name), f"RotatingSheet.{name}"))
        for name in ("focal_length_px", "horizon"):
            if getattr(self, name) <= 0.0:
                raise ValueError(f"RotatingSheet.{name} is {getattr(self, name)}, expected a number above 0")
        if self.angle_step is not None:
            object.__setattr__(self, "angle_step", finite(self.angle_step, "RotatingSheet.angle_step"))
        if self.along not in ("rows", "columns"):
            raise ValueError(f"RotatingSheet.along is {self.along!r}, expected 'rows' or 'columns'")
        point = numbers(self.principal_point_px, (2,), "RotatingSheet.principal_point_px (column, row)")
        object.__setattr__(self, "principal_point_px", point)
        self._check_directions()

    def _check_directions(self) -> None:
        for name in ("axis_point", "scene_origin"):
            object.__setattr__(self, name, _vector(getattr(self, name), f"RotatingSheet.{name}"))
        for name in ("axis_direction", "sheet_normal"):
            object.__setattr__(self, name, _unit(getattr(self, name), f"RotatingSheet.{name}"))
        if np.linalg.norm(np.cross(self.axis_direction, self.sheet_normal)) <= _PARALLEL:
            raise ValueError("RotatingSheet: the sheet's normal lies along the axis, so that turning does not move it")
        axes = numbers(self.scene_axes, (3, 3), "RotatingSheet.scene_axes")
        if np.max(np.abs(np.array(axes) @ np.array(axes).T - np.eye(3))) > 1e-6:
            raise ValueError("RotatingSheet.scene_axes are not three orthonormal vectors")
        object.__setattr__(self, "scene_axes", axes)

    def transport(self, profiles: int, first: int = 0) -> npt.NDArray[np.float64]:
        """Angle of the sheet in profiles `first`, `first` + 1, ... [rad], where it turns uniformly.

        Raises
        ------
        ValueError
            There is no uniform step; give the encoder's angles.
        """
        if self.angle_step is None:
            raise ValueError("RotatingSheet has no angle_step; give the encoder's angles [rad], one per profile")
        return self.first_angle + self.angle_step * np.arange(first, first + profiles, dtype=np.float64)

    def normals(self) -> npt.NDArray[np.float64]:
        """Three vectors, ``normal = v[0] + v[1] cos(angle) + v[2] sin(angle)``, in the camera frame."""
        axis, normal = np.array(self.axis_direction), np.array(self.sheet_normal)
        fixed = axis * (axis @ normal)
        return np.stack([fixed, normal - fixed, np.cross(axis, normal)])

    @property
    def inputs(self) -> int:
        """Number of arrays per sample that `RangeImage` takes: the position."""
        return 1

    @property
    def defines(self) -> dict[str, None]:
        """What ``kernels/range_image/range_image.cl`` has to compile."""
        return {"GEOMETRY_ROTATING": None} | ({} if self.lens is None else self.lens.defines)

    def packed(self) -> npt.NDArray[np.float64]:
        """Table of ``kernels/range_image/range_image.cl`` after its limits."""
        # The kernel knows (position, sample), not (column, row).
        order = [0, 1, 2] if self.along == "rows" else [1, 0, 2]
        to_scene, normals = np.array(self.scene_axes), self.normals()
        reach = normals @ np.array(self.axis_point) + self.sheet_offset * np.array([1.0, 0.0, 0.0])
        middle = np.array(self.principal_point_px)[order[:2]]
        scale = 1.0 / self.focal_length_px
        lens = self.lens if self.lens is None or self.along == "rows" else self.lens.swapped()
        return np.concatenate(
            [
                -to_scene @ np.array(self.scene_origin),
                to_scene.T[order].ravel(),
                middle,
                [scale, self.horizon],
                normals[:, order].ravel(),
                reach,
                [] if lens is None else lens.packed(middle.tolist(), scale),
            ]
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, as TOML holds them."""
        table: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            value = getattr(self, name)
            if isinstance(value, Lens):
                table[name] = value.to_dict()
            elif value is not None:
                table[name] = np.array(value).tolist() if isinstance(value, tuple) else value
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> RotatingSheet:
        """Build one from a table with the parameters' names; the lens is a table in it.

        Raises
        ------
        TypeError, ValueError
            A key is unknown or missing, or a value is not what it should be.
        """
        required = ("focal_length_px", "principal_point_px", "axis_point", "axis_direction", "sheet_normal")
        values = dict(check_keys(table, cls.__dataclass_fields__, required, "rotating sheet"))
        if "lens" in values:
            values["lens"] = Lens.from_dict(values["lens"])
        return cls(**values)


@dataclass(frozen=True, kw_only=True)
class RangeImage(VisionOperation[RangePoints]):
    """Profiles and the transport of each -> an organised range image.

    Called as ``op(g, h, transport, status)`` with a `StraightTransport` and ``op(position, transport, status)`` with a
    `RotatingSheet`. Profile arrays are (profiles, samples), float32 or float64; ``transport`` is (profiles,) of the
    same dtype: metres or radians, measured by an encoder or from ``geometry.transport``; ``status`` is (profiles,
    samples), uint8, of the readout or the triangulation.

    Error: a few roundings of the largest term of the point. Single precision holds 6e-8 of the distance from the
    scene's origin, and for a `RotatingSheet` 6e-8 / (n . r) of the depth: lay origins near what is measured.

    Parameters
    ----------
    geometry
        How the sheet moves over the scene.
    limits
        Lowest and highest x, y and z that a point can have [m]; what lies outside is OUT_OF_RANGE.
    precision
        ``"single"``, ``"double"``, or None: follows the profiles.
    variant
        ``"vector"`` (CPU runtimes), ``"work_item"`` (GPUs), or ``"auto"``.

    Raises
    ------
    ValueError
        A lower limit is not below its upper one.
    """

    Result: ClassVar[type[Any]] = RangePoints

    geometry: StraightTransport | RotatingSheet
    limits: Limits = _EVERYWHERE
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        limits = tuple((float(low), float(high)) for low, high in self.limits)
        if len(limits) != 3 or not all(low < high for low, high in limits):
            raise ValueError(f"RangeImage.limits are {self.limits}, expected (lowest, highest) for x, y and z")
        object.__setattr__(self, "limits", limits)

    def packed(self, real: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
        """Table of ``kernels/range_image/range_image.cl`` in the device's real type."""
        # Finite limits keep infinite results out by the same comparisons.
        largest = np.finfo(np.dtype(real)).max
        limits = np.clip(np.array(self.limits).T.ravel(), -largest, largest)
        return np.concatenate([limits, self.geometry.packed()]).astype(real)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="profiles")
        build.check_shape(len(shape) == 2, "(profiles, samples)")
        profiles, samples = shape
        if build.uses_vectors and samples >= _LANES:
            work = WorkSize((max(samples // _STRIP, 1), profiles), None, vectors=True)
        else:
            work = WorkSize((samples, profiles), None)
        more_coordinates = [(shape, dtype)] * (self.geometry.inputs - 1)
        return build.launch(
            "range_image/range_image.cl",
            "assemble_profiles",
            work=work,
            more_inputs=[*more_coordinates, ((profiles,), dtype), (shape, np.dtype(np.uint8))],
            outputs=build.outputs({"x": shape, "y": shape, "z": shape, "status": shape}),
            defines={**self.geometry.defines, **type_defines("INPUT", dtype, 16)},
            arguments=[self.packed(build.real), np.uint32(samples)],
        )
