"""Contract of the undistortion of points: cameras of the benchmark, both directions, points past the fold, holes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.profiling.undistort_points import FULL, SIZE, STANDARD, TILTED
from gpuvision.reference.camera import distort_pixels, undistort_pixels

LIMITS = {
    "UndistortPoints": (
        equal("status", reason="comparisons only, except within rounding of the fold"),
        Limit(
            ("points",), 1e-6, 4e-15, "(correction of lens and of tilt) / Jacobian + 0.06 of the coordinate [px]",
            "error model of the docstring: relative error of the correction; half a spacing of the result",
        ),
    )
}  # fmt: skip
_COUNT = 1003
_BARREL = Camera(matrix=STANDARD.matrix, distortion=(-0.9, *(0.0,) * 13))  # folds within the image


def cases() -> Iterator[Case]:
    """Yield three cameras in both directions, double precision, a fold within the image, and holes."""
    points = np.random.default_rng(26).uniform(0.0, 1.0, (_COUNT, 2)) * SIZE
    for name, camera in (("5 coefficients", STANDARD), ("tilted sensor", TILTED), ("14 coefficients", FULL)):
        yield _case(name, camera, points, "float32")
        yield _case(f"{name}, inverse", camera, points, "float32", inverse=True)
    yield _case("14 coefficients, float64", FULL, points, "float64")
    yield _case("fold within the image", _BARREL, points, "float32")
    holes = points.copy()
    holes[::5, 0], holes[3::7, 1] = np.nan, np.inf
    yield _case("holes", STANDARD, holes, "float32")


def _case(name: str, camera: Camera, points: npt.NDArray[Any], dtype: str, *, inverse: bool = False) -> Case:
    given = points.astype(dtype)
    function = distort_pixels if inverse else undistort_pixels
    known = np.isfinite(given).all(axis=1)
    found = np.full(given.shape, np.nan)
    found[known] = function(given[known].astype(np.float64), camera.matrix, camera.distortion)
    ideal = given.astype(np.float64) if inverse else found
    area = _jacobian(camera, ideal)
    found = np.where((area > 0.0)[:, None], found, np.nan)
    status = np.where(known, np.where(np.isfinite(found).all(axis=1), 0, 128), 8)
    with np.errstate(invalid="ignore"):
        untilted = distort_pixels(ideal, camera.matrix, (*camera.distortion[:12], 0.0, 0.0))
        measured = found if inverse else given
        moved = np.abs(measured - untilted).max(axis=1) + np.abs(untilted - ideal).max(axis=1)
        quantity = (moved / np.minimum(area, 1.0))[:, None] + 0.06 * np.abs(found)
    return Case(
        "UndistortPoints", name, UndistortPoints(model=camera, inverse=inverse), (given,),
        {"points": found, "status": status}, {"points": quantity.astype(np.float64)}, np.abs(area) < 0.02,
    )  # fmt: skip


def _jacobian(camera: Camera, ideal: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return the determinant of the model's derivatives, by central differences; NaN where there is no ideal pixel."""
    step = 1e-3  # [px]; extended precision has 1e-19 of 1e3 px
    ends = [[distort_pixels(ideal + sign * away, camera.matrix, camera.distortion) for sign in (1.0, -1.0)]
            for away in np.array([(step, 0.0), (0.0, step)])]  # fmt: skip
    (xx, xy), (yx, yy) = (((one - other) / (2.0 * step)).T for one, other in ends)
    return np.asarray(xx * yy - xy * yx, np.float64)
