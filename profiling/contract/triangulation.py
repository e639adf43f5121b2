"""Contract of the triangulation: points in the region, at the horizon, beyond the fold of a lens, and holes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.profiling.triangulation import HOMOGRAPHY, LENS, REGION
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference.triangulation import triangulate

LIMITS = {
    "Triangulation": (
        equal("status", reason="comparisons only, except within rounding of the horizon or the fold"),
        roundings(
            4, "g", "h", of="largest coordinate of point and region [m], divided by the denominator if it is below 1",
            reason="x, w, quotient, two products, their sum and the offset: eight half epsilons",
        ),
    )
}  # fmt: skip
_SHAPE = (7, 143)
_CORNERS = np.array([(u, v) for u in REGION[0] for v in REGION[1]]).T
_EXTENT = float(
    np.max(np.abs(triangulate(_CORNERS[0], _CORNERS[1], HOMOGRAPHY, REGION)[:2]))
)  # largest coordinate of the region [m]
_FOLDING = Lens(k1=-8e-7, centre=(650.0, 500.0))  # folds at 645 px, within the image


def cases() -> Iterator[Case]:
    """Yield points of the benchmark's sensor, with and without a lens, and points that have no place in the sheet."""
    rng = np.random.default_rng(22)
    inside = [rng.uniform(*bounds, _SHAPE) for bounds in REGION]
    for dtype in ("float32", "float64"):
        yield _case(f"region, {dtype}", inside, dtype)
        yield _case(f"lens, {dtype}", inside, dtype, lens=LENS)
    holes = [np.where(rng.random(_SHAPE) < 0.2, rng.choice([np.nan, np.inf, -np.inf], _SHAPE), each) for each in inside]
    yield _case("holes", holes, "float32")
    yield _case("fold of the lens", inside, "float32", lens=_FOLDING)
    # The denominator is -4.2e-4 u + 8e-6 v + 1.21: 0 at u = 2880 px and v = 0.
    beyond = [rng.uniform(1000.0, 4000.0, _SHAPE), inside[1]]
    yield _case("horizon", beyond, "float32", horizon=0.05)


def _case(name: str, points: list[npt.NDArray[Any]], dtype: str, **settings: Any) -> Case:
    operation = Triangulation(homography=HOMOGRAPHY, region=REGION, **settings)
    u, v = (each.astype(dtype) for each in points)
    lens = None if operation.lens is None else (operation.lens.k1, operation.lens.k2, operation.lens.centre)
    g, h, status = triangulate(u, v, HOMOGRAPHY, REGION, horizon=operation.horizon, lens=lens)
    wide_u, wide_v = u.astype(np.float64), v.astype(np.float64)
    denominator = _denominator(wide_u, wide_v)
    radius = np.hypot(wide_v - LENS.centre[0], wide_u - LENS.centre[1])
    undecided = np.abs(denominator - operation.horizon) < 1e-5
    if operation.lens is not None:
        undecided |= np.abs(radius / operation.lens.fold_radius - 1.0) < 1e-5
    # The rounding of a denominator below 1 is relative to 1: it moves a point that is far away more.
    near = np.minimum(np.abs(denominator), 1.0)
    quantity = np.maximum(np.maximum(np.abs(g), np.abs(h)), _EXTENT) / near
    exact: dict[str, npt.NDArray[Any]] = {"g": g, "h": h, "status": status}
    return Case("Triangulation", name, operation, (u, v), exact, {"g": quantity, "h": quantity}, undecided)


def _denominator(u: npt.NDArray[np.float64], v: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the homography's denominator, as a fraction of that in the middle of the region."""
    line = np.array(HOMOGRAPHY[2])
    middle = line @ [np.mean(REGION[0]), np.mean(REGION[1]), 1.0]
    with np.errstate(invalid="ignore"):
        return np.asarray((line[0] * u + line[1] * v + line[2]) / middle)
