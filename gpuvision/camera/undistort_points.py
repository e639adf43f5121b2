"""Undistortion and distortion of points with a calibrated camera or lens (OpenCV: ``undistortPoints``)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.host import (
    Define,
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Tunable,
    Variant,
    flags,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.validation import numbers

_LANES, _GROUP = 16, 64
# Points of a strip (a work-item's share, vector variant); several strips per core balance the load.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 16384, 8


class UndistortedPoints(NamedTuple):
    """Undistorted (or distorted) points.

    Attributes
    ----------
    points : array
        (..., 2): column, row [px]; [m] for a `PlanePolynomial`. NaN where the status is not OK.
    status : array of uint8
        (...) `Status` flags. NOT_FINITE: an input coordinate is not finite, or the result overflows. NOT_INVERTIBLE:
        the point lies past the fold of the lens or behind the tilted sensor. OUT_OF_RANGE: the point lies outside the
        region of a `PlanePolynomial`.
    """

    points: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class UndistortPoints(VisionOperation[UndistortedPoints]):
    """Undistortion of points: ``op(points) -> UndistortedPoints`` with float32 or float64 points (..., 2).

    Parameters
    ----------
    model : Camera, Lens or PlanePolynomial
        Camera model. A `PlanePolynomial` maps sensor coordinates to metres in the measurement plane.
    inverse : bool
        Compute measured points from ideal ones. Default False.
    matrix : 3 x 3, optional
        Camera matrix of the ideal pixels, for a `Camera`. Default: the matrix of ``model``.
    precision : {"single", "double"}, optional
        Precision of the arithmetic and the outputs. Default: the precision of the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: 16-wide vectors for CPU runtimes, a work-item per 4 points for GPUs, or by the device (default).

    Raises
    ------
    TypeError
        The model has another type.
    ValueError
        ``matrix`` is given for a model other than a `Camera`.

    Notes
    -----
    Error: the kernel computes the correction and adds it to the point. The relative error of the correction is 1e-6
    (4e-15 in double), below 1e-4 px for corrections up to 100 px. The rounding of the result adds half a float spacing:
    1.2e-4 px above 2048 px, 2.4e-4 px above 4096 px. Near the fold the inverse magnifies both by 1 / det of the model's
    Jacobian.
    """

    Result: ClassVar[type[Any]] = UndistortedPoints
    # Not the variant: where the steps are tested, the lanes of a vector take as many as the slowest one.
    tunable: ClassVar[Tunable | None] = Tunable(strips=(512, 1024, 2048, 4096, 8192, 16384), groups=(32, 64, 128, 256))

    model: Camera | Lens | PlanePolynomial
    inverse: bool = False
    matrix: tuple[tuple[float, ...], ...] | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.model, Camera | Lens | PlanePolynomial):
            raise TypeError(f"UndistortPoints.model is {self.model!r}, expected a Camera, a Lens or a PlanePolynomial")
        if self.matrix is not None:
            if not isinstance(self.model, Camera):
                raise ValueError("UndistortPoints.matrix goes with a Camera only; leave it out")
            object.__setattr__(self, "matrix", numbers(self.matrix, (3, 3), "UndistortPoints.matrix"))
            self.model.defines(self.matrix)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="points")
        build.check_shape(shape[-1:] == (2,), "points (..., 2)")
        count = math.prod(shape[:-1])
        share = build.share(count, per_core=_STRIPS_PER_CORE, multiple=_LANES)
        each = min(max(share, _SHORTEST_STRIP), _LONGEST_STRIP)
        work = build.work(count, each=each, group=_GROUP, least=_LANES, grouping="strided")
        return build.launch(
            "undistort_points/undistort_points.cl",
            "undistort_points",
            work=work,
            outputs=build.outputs({"points": shape, "status": shape[:-1]}),
            defines={
                **self._model_defines(build.real),
                **type_defines("INPUT", dtype, 2, 4, 16),
                **flags(INVERSE=self.inverse),
            },
            arguments=[self._packed(build.real), np.uint64(count), np.uint64(work.each)],
            by_team=True,
        )

    def _model_defines(self, real: np.dtype[Any]) -> dict[str, Define]:
        if isinstance(self.model, Camera):
            steps = {} if self.inverse else self.model.undistort_defines(real, self.matrix)
            return {**self.model.defines(self.matrix), **steps}
        return dict(self.model.defines)

    def _packed(self, real: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return the parameter table of the model's header, of type ``real``."""
        if isinstance(self.model, Camera):
            return self.model.packed(real, "distort" if self.inverse else "undistort", self.matrix)
        if isinstance(self.model, PlanePolynomial):
            return self.model.packed(real)
        with np.errstate(over="ignore"):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(real)
