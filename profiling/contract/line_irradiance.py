"""Contract of the irradiance of lit lines, without and with occluders: random and extreme places, and holes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference import line_irradiance as reference
from gpuvision.reference import occluded_irradiance as occluded
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows

LIMITS = {
    "LineIrradiance": (
        equal("status", reason="comparisons only"),
        Limit(
            ("irradiance",), 2e-6, 1e-14, "sum of E0 of the segments; in double precision times 1 + D / h [W/m^2]",
            "error model of the docstring",
        ),
    ),
    "OccludedIrradiance": (
        equal("status", reason="comparisons only"),
        Limit(
            ("irradiance",), 1.0, 1.0, "error of LineIrradiance + change by 8 epsilon of the scene's size [W/m^2]",
            "error model of the docstring: the edge of a shadow is off by a few roundings of positions; the change of "
            "the irradiance when the receiver moves so far",
        ),
    ),
}  # fmt: skip
_RECEIVERS, _SEGMENTS = 203, 17
# Segments, clearance and size of the scene with occluders [m].
_LIT, _CLEARANCE, _SIZE = 5, 1e-5, 2.0


def cases() -> Iterator[Case]:
    """Yield receivers among segments, near and far ones, and receivers without a place."""
    rng = np.random.default_rng(30)
    receivers, lit = _scene(rng)
    yield _case("random, float32", receivers.astype(np.float32), lit)
    yield _case("random, float64", receivers[:53], lit)
    far = receivers.copy()
    far[:, :3] *= 10.0 ** rng.uniform(-3.0, 3.0, (_RECEIVERS, 1))
    yield _case("distances 1:1e6, float32", far.astype(np.float32), lit)
    holes = receivers.astype(np.float32)
    holes[::7, 1], holes[3::11, 4] = np.nan, np.inf
    yield _case("holes, float32", holes, lit)
    for count in (3, 60):
        yield _occluded(f"{count} triangles, float32", count)


def _scene(rng: np.random.Generator) -> tuple[npt.NDArray[np.float64], LitSegments]:
    ends = rng.uniform(-1.0, 1.0, (_SEGMENTS, 2, 3))
    normals = np.cross(ends[:, 1] - ends[:, 0], rng.normal(size=(_SEGMENTS, 3)))
    receivers = np.concatenate([rng.uniform(-1.0, 1.0, (_RECEIVERS, 3)), rng.normal(size=(_RECEIVERS, 3))], axis=1)
    return receivers, LitSegments(ends, normals, rng.uniform(0.1, 2.0, _SEGMENTS))


def _case(name: str, receivers: npt.NDArray[Any], lit: LitSegments) -> Case:
    known = np.isfinite(receivers).all(axis=1)
    parts = _in_digits if receivers.dtype == np.float64 else _by_quadrature
    value, quantity = (np.zeros(len(receivers)) for _ in range(2))
    value[known], quantity[known] = parts(receivers[known].astype(np.float64), lit)
    exact = {"irradiance": np.where(known, value, np.nan), "status": np.where(known, 0, 8)}
    return Case("LineIrradiance", name, LineIrradiance(segments=lit), (receivers,), exact, {"irradiance": quantity})


def _by_quadrature(receivers: npt.NDArray[np.float64], lit: LitSegments) -> tuple[Any, Any]:
    return reference.irradiance(receivers, lit.ends, lit.normals, lit.exitance)


def _in_digits(receivers: npt.NDArray[np.float64], lit: LitSegments) -> tuple[Any, Any]:
    """Return the irradiance of receivers, and the sum of E0 (1 + D / h), with 60 digits."""
    value, quantity = (np.zeros(len(receivers)) for _ in range(2))
    for ends, normal, exitance in zip(lit.ends, lit.normals, lit.exitance, strict=True):
        height = np.abs((receivers[:, :3] - ends[0]) @ normal) / np.linalg.norm(normal)
        reach = 1.0 + np.linalg.norm(receivers[:, None, :3] - ends, axis=-1).max(axis=1) / height
        pairs = np.array([reference.exact(each, ends, normal, float(exitance)) for each in receivers])
        value += pairs[:, 0]
        quantity += pairs[:, 1] * reach
    return value, quantity


def _occluded(name: str, count: int) -> Case:
    """Return strips of receivers among triangles."""
    rng = np.random.default_rng(31)
    corners = occluded.soup(rng, count, 0.6 if count < 20 else 0.3)
    scene, strips = Scene(corners), (3, 23)
    receivers, lit = _scene(rng)
    places = occluded.single(receivers[: strips[0] * strips[1]])
    rows = occluded.single(segment_rows(lit)[:_LIT])

    def exact_at(at: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        return np.asarray(occluded.irradiance(corners, at, rows, _CLEARANCE))

    value, largest = exact_at(places)
    step = 8.0 * float(np.finfo(np.float32).eps) * _SIZE
    moves = step * np.eye(3, 6)
    change = np.max(
        [np.abs(exact_at(places + sign * each)[0] - value) for each in moves for sign in (1.0, -1.0)], axis=0
    )
    quantity = LIMITS["LineIrradiance"][1].single * largest + change
    exact = {"irradiance": value.reshape(strips), "status": np.zeros(strips, np.uint8)}
    operation = OccludedIrradiance(scene=scene, segments=_LIT, clearance=_CLEARANCE)
    single = (places.reshape(*strips, 6), np.ones((*strips, 2)), rows)
    inputs = tuple(np.ascontiguousarray(each, np.float32) for each in single)
    return Case("OccludedIrradiance", name, operation, inputs, exact, {"irradiance": quantity.reshape(strips)})
