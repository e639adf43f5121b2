"""Contract of the irradiance of lit lines: random and extreme places of receivers, behind surfaces and holes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, Limit, equal
from gpuvision.reference import line_irradiance as reference
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments

LIMITS = {
    "LineIrradiance": (
        equal("status", reason="comparisons only"),
        Limit(
            ("irradiance",), 2e-6, 1e-14, "sum of E0 of the segments; in double precision times 1 + D / h [W/m^2]",
            "error model of the docstring",
        ),
    )
}  # fmt: skip
_RECEIVERS, _SEGMENTS = 203, 17


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
