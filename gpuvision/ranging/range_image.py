"""Range images: profiles over a moving sheet of light become x, y, z for every (profile, sample).

The sheet moves over the scene in one of the two ways of `gpuvision.ranging.sheet_motion`: a straight transport, or a
rotation of the sheet.

The result is an *organised point cloud*: neighbours in the arrays are neighbours on the sensor.
`gpuvision.ranging.regrid` resamples it to a height map over regular cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    WorkSize,
    round_up,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport

_STRIP = 1024  # samples of a work-item of the vector variant: SAMPLES_PER_STRIP in range_image.cl
_LANES = 16  # of a vector of the vector variant: its kernel's vectors have 16 elements
_GROUP = 64  # work-items of a group of the other variant

Limits = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_EVERYWHERE: Limits = ((-math.inf, math.inf),) * 3


class RangePoints(NamedTuple):
    """Organised range image (point cloud): arrays of shape (profiles, samples).

    Attributes
    ----------
    x, y, z
        Point in the scene [m]; NaN where a flag other than SATURATED and AMBIGUOUS is set.
    status
        uint8 `Status` flags: the flags of the input, and NOT_FINITE (a coordinate, the transport or the result is not
        finite), NOT_INVERTIBLE (beyond the fold of the lens), HORIZON (the ray does not meet the sheet in front of the
        camera), OUT_OF_RANGE (outside the limits).
    """

    x: FloatArray
    y: FloatArray
    z: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class RangeImage(VisionOperation[RangePoints]):
    """Assembly of profiles to an organised range image (point cloud).

    Called as ``op(g, h, transport, status)`` with a `StraightTransport` and as ``op(position, transport, status)`` with
    a `RotatingSheet`; returns `RangePoints`. The profile arrays g and h [m], or position [px], have the shape
    (profiles, samples) and are float32 or float64. ``transport`` has the shape (profiles,) and the same dtype: metres
    or radians, from an encoder or from ``geometry.transport``. ``status`` (profiles, samples) uint8 holds the flags of
    the readout or of the triangulation.

    Parameters
    ----------
    geometry : StraightTransport or RotatingSheet
        Motion of the sheet over the scene.
    limits : ((low, high), (low, high), (low, high))
        Limits of x, y and z [m]; points outside are OUT_OF_RANGE. Default: no limits.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` follows the profiles.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: vectors of 16 (CPU runtimes) or one work-item per sample (GPUs); ``"auto"`` follows the device.

    Raises
    ------
    ValueError
        A lower limit is not below its upper limit.

    Notes
    -----
    Error: a few roundings of the largest term of the point. Single precision resolves 6e-8 of the distance from the
    origin of the scene, and for a `RotatingSheet` 6e-8 / (n . r) of the depth: choose origins near the measured
    surface.
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
        """Return the parameter table of the kernel in its real type: limits (low, high), then `geometry`'s part."""
        # Finite limits exclude infinite results by the same comparisons.
        largest = np.finfo(np.dtype(real)).max
        limits = np.clip(np.array(self.limits).T.ravel(), -largest, largest)
        return np.concatenate([limits.astype(real), self.geometry.packed(real)])

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="profiles")
        build.check_shape(len(shape) == 2, "(profiles, samples)")
        profiles, samples = shape
        if build.uses_vectors and samples >= _LANES:
            work = WorkSize((max(samples // _STRIP, 1), profiles), (1, 1), vectors=True)
        else:
            work = WorkSize((round_up(samples, _GROUP), profiles), (_GROUP, 1))
        more_coordinates = [(shape, dtype)] * (self.geometry.inputs - 1)
        return build.launch(
            "range_image/range_image.cl",
            "assemble_profiles",
            work=work,
            more_inputs=[*more_coordinates, ((profiles,), dtype), (shape, np.dtype(np.uint8))],
            outputs=build.outputs({"x": shape, "y": shape, "z": shape, "status": shape}),
            defines={**self.geometry.defines(build.real), **type_defines("INPUT", dtype, 16)},
            arguments=[self.packed(build.real), np.uint32(samples)],
            # Only rows that are aligned to a vector bypass the caches. Where half of the rows do, a launch takes 1.4
            # times as long as where none does (measured: 4000 x 1000 samples).
            streams=samples % _LANES == 0,
        )
