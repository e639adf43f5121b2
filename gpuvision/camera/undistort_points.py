"""Points through a calibrated camera or lens: measured to ideal, and back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.host import Device, Launch, LaunchBuilder, Precision, Variant, flags, type_defines
from gpuvision.operation import VisionOperation
from gpuvision.validation import numbers

_LANES, _GROUP = 16, 256
# Points of a strip: several strips per core keep the cores even.
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 16384, 8


class UndistortedPoints(NamedTuple):
    """Points and whether they are to be trusted.

    Attributes
    ----------
    points
        (..., 2), as the input; NaN where the status is not OK.
    status
        uint8 `Status` flags, (...): NOT_FINITE (a coordinate is not, or lies so far away that its place is not),
        NOT_INVERTIBLE (past the fold of the lens, or behind the tilted sensor: no such point), OUT_OF_RANGE (outside
        the region of a `PlanePolynomial`).
    """

    points: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class UndistortPoints(VisionOperation[UndistortedPoints]):
    """Measured pixels to ideal ones: ``op(points) -> UndistortedPoints``, points float32 or float64 (..., 2).

    Parameters
    ----------
    model
        `Camera`, `Lens`, or `PlanePolynomial` (sensor coordinates to metres in the plane).
    inverse
        From ideal points to measured ones.
    matrix
        3 x 3, of the ideal pixels of a `Camera`; None: its own.
    precision
        Of the arithmetic and the outputs; None follows the input.
    variant
        "vector" (16-wide vectors, for CPU runtimes), "work_item" (a work-item per point, for GPUs), or "auto".

    Raises
    ------
    TypeError
        The model is none of these.
    ValueError
        There is a matrix, but no `Camera`.

    Notes
    -----
    Error: the correction is computed, not the point, so the result is the exact one to 1e-6 of the correction (4e-15
    in double) plus its own rounding: half a float's spacing is 1.2e-4 px beyond 2048 px and 2.4e-4 px beyond 4096 px.
    The correction's part is below 1e-4 px for corrections up to 100 px. Near the fold the inverse magnifies both by
    1/det of the model's Jacobian.
    """

    Result: ClassVar[type[Any]] = UndistortedPoints

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
        work = build.work(count, each=each, group=_GROUP, least=_LANES, grouping="fitted")
        return build.launch(
            "undistort_points/undistort_points.cl",
            "undistort_points",
            work=work,
            outputs=build.outputs({"points": shape, "status": shape[:-1]}),
            defines={
                **self._model_defines(build.real),
                **type_defines("INPUT", dtype, 16),
                **flags(INVERSE=self.inverse),
            },
            arguments=[self._packed(build.real), np.uint64(count), np.uint64(work.each)],
        )

    def _model_defines(self, real: np.dtype[Any]) -> dict[str, int | None]:
        if isinstance(self.model, Camera):
            steps = {} if self.inverse else {"CAMERA_STEPS": self.model.steps(real)}
            return {**self.model.defines(self.matrix), **steps}
        return dict(self.model.defines)

    def _packed(self, real: np.dtype[Any]) -> npt.NDArray[Any]:
        """Return the table of the model's header, of ``real``."""
        if isinstance(self.model, Camera):
            return self.model.packed(real, "distort" if self.inverse else "undistort", self.matrix)
        if isinstance(self.model, PlanePolynomial):
            return self.model.packed(real)
        with np.errstate(over="ignore"):
            return self.model.packed((0.0, 0.0), 1.0, inverse=True).astype(real)
