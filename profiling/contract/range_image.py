"""Contract of range images: a straight transport and a rotating sheet, holes, flags, and points beyond limits."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.profiling.range_image import ROTATING, STRAIGHT
from gpuvision.ranging.range_image import RangeImage
from gpuvision.reference import range_image as reference

_ROTATING = "RotatingSheet"
LIMITS = {
    "RangeImage": (
        equal("status", reason="comparisons only, except within rounding of a limit or of the horizon"),
        roundings(
            6, "x", "y", "z", of="largest term of the point [m]",
            reason="four terms, each with its constant, product and sum: twelve half epsilons",
        ),
        roundings(
            10, "x", "y", "z", of="distance (1 + 1 / (n . r)) + distance of the scene's origin [m]", when=_ROTATING,
            reason="n . r has about ten roundings, which its quotient magnifies; nine of the point",
        ),
    )
}  # fmt: skip
_SHAPE = (7, 143)


def cases() -> Iterator[Case]:
    """Yield both geometries, double precision, and limits in the middle of the points."""
    rng = np.random.default_rng(27)
    flags = rng.choice(np.array([0, 0, 0, 1, 2, 16, 32], np.uint8), _SHAPE)
    sheet = rng.uniform(-0.05, 0.05, (2, *_SHAPE))
    sheet[0, :, ::11], sheet[1, :, 5::13] = np.nan, np.inf
    everywhere = ((-np.inf, np.inf),) * 3
    for dtype in ("float32", "float64"):
        yield _straight(f"straight, {dtype}", sheet.astype(dtype), flags, everywhere)
    yield _straight("straight, limits", sheet.astype(np.float32), flags, ((-np.inf, np.inf), (-0.02, 0.03), (-0.01, 1)))
    direction = np.tan(ROTATING.transport(_SHAPE[0]))[:, None]
    position = 511.5 + 1700.0 * (direction + rng.uniform(0.02, 0.3, _SHAPE))
    position[:, ::9] -= 1000.0  # behind the horizon
    position[:, 4::17] = np.nan
    for dtype in ("float32", "float64"):
        yield _rotating(f"rotating, {dtype}", position.astype(dtype), flags)


def _straight(name: str, sheet: npt.NDArray[Any], flags: npt.NDArray[np.uint8], limits: Any) -> Case:
    operation = RangeImage(geometry=STRAIGHT, limits=limits)
    g, h = sheet
    transport = STRAIGHT.transport(_SHAPE[0]).astype(sheet.dtype)
    with np.errstate(invalid="ignore"):
        points = reference.points_of_straight_transport(STRAIGHT, g, h, transport)
    no = np.zeros(_SHAPE, bool)
    found, status = reference.apply_status(points, flags, ~np.isfinite(g) | ~np.isfinite(h), no, no, limits)
    axes = np.abs([STRAIGHT.g_axis, STRAIGHT.h_axis, STRAIGHT.direction])
    travelled = np.broadcast_to(np.abs(transport)[:, None], _SHAPE)
    with np.errstate(invalid="ignore"):
        size = np.stack([np.abs(g), np.abs(h), travelled], axis=-1)[..., None] * axes
        quantity = np.maximum(size.max(axis=-2), np.abs(STRAIGHT.origin))
    return _case(name, operation, (g, h, transport, flags), found, status, quantity, points)


def _rotating(name: str, position: npt.NDArray[Any], flags: npt.NDArray[np.uint8]) -> Case:
    operation = RangeImage(geometry=ROTATING)
    transport = ROTATING.transport(_SHAPE[0]).astype(position.dtype)
    points, facing, folded = reference.points_of_rotating_sheet(ROTATING, position, transport)
    missed = ~(facing > ROTATING.horizon)
    found, status = reference.apply_status(points, flags, ~np.isfinite(position), missed, folded, operation.limits)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.linalg.norm(points - ROTATING.packed()[:3], axis=-1)
        quantity = distance * (1.0 + 1.0 / np.abs(facing)) + np.linalg.norm(ROTATING.scene_origin)
        at_horizon = np.abs(facing - ROTATING.horizon) < 1e-5
    every = np.broadcast_to(quantity[..., None], points.shape)
    return _case(name, operation, (position, transport, flags), found, status, every, points, at_horizon, _ROTATING)


def _case(
    name: str,
    operation: RangeImage,
    inputs: tuple[npt.NDArray[Any], ...],
    found: npt.NDArray[Any],
    status: npt.NDArray[np.uint8],
    quantity: npt.NDArray[Any],
    points: npt.NDArray[Any],
    undecided: npt.NDArray[np.bool_] | None = None,
    when: str = "",
) -> Case:
    """Return a case; a point within rounding of a limit is undecided."""
    rounding = 12.0 * np.finfo(inputs[0].dtype).eps * quantity[..., None]
    with np.errstate(invalid="ignore"):
        at_limit = np.abs(points[..., None] - np.asarray(operation.limits)) <= rounding
        near = (at_limit & np.isfinite(rounding)).any(axis=(-1, -2))
    exact = {axis: found[..., k] for k, axis in enumerate("xyz")} | {"status": status}
    quantities = {axis: quantity[..., k] for k, axis in enumerate("xyz")}
    undecided = near if undecided is None else near | undecided
    return Case("RangeImage", name, operation, inputs, exact, quantities, undecided, when)
