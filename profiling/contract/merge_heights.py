"""Contract of the merge of height maps: agreeing and disagreeing maps, holes, flags of every kind, wrong sigmas."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.ranging.merge_heights import DISAGREEMENTS, MergeHeights
from gpuvision.reference.merge_heights import merge_heights

LIMITS = {
    "MergeHeights": (
        equal("status", "source", reason="comparisons only, except within rounding of the limit of agreement"),
        roundings(4, "z", of="larger height + difference of the heights [m]", reason="weight, product and sum"),
        roundings(4, "intensity", of="larger intensity + difference", reason="as the height"),
        roundings(4, "sigma", of="sigma [m]", reason="two squares, their sum, root, product and quotient"),
    )
}
_SHAPE = (23, 37)
_Map = tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[np.uint8], npt.NDArray[Any]]


def cases() -> Iterator[Case]:
    """Yield every strategy for disagreeing heights, with and without sigmas, and double precision."""
    rng = np.random.default_rng(23)
    one, two = _map(rng), _map(rng)
    for disagreement in DISAGREEMENTS:
        yield _case(f"disagreement {disagreement}", one, two, "float32", disagreement=disagreement, sigma=True)
    yield _case("without sigmas", one, two, "float32", tolerance=2e-5)
    yield _case("both required", one, two, "float32", sigma=True, require_both=True)
    yield _case("float64", one, two, "float64", sigma=True)


def _map(rng: np.random.Generator) -> _Map:
    """Return a map of one surface with noise, holes, flags, outliers, and sigmas of 0.1 to 100 um or wrong ones."""
    surface = np.random.default_rng(24).uniform(-0.01, 0.01, _SHAPE)
    sigma = 10.0 ** rng.uniform(-7.0, -4.0, _SHAPE)
    z = surface + sigma * rng.normal(size=_SHAPE)
    z = np.where(rng.random(_SHAPE) < 0.2, z + rng.choice([-1.0, 1.0], _SHAPE) * 1e-3, z)
    status = np.where(rng.random(_SHAPE) < 0.3, 1 << rng.integers(0, 8, _SHAPE), 0).astype(np.uint8)
    z = np.where(rng.random(_SHAPE) < 0.1, rng.choice([np.nan, np.inf], _SHAPE), z)
    sigma = np.where(rng.random(_SHAPE) < 0.1, rng.choice([np.nan, np.inf, 0.0, -1.0], _SHAPE), sigma)
    return z, rng.uniform(0.0, 255.0, _SHAPE), status, sigma


def _case(name: str, one: Any, two: Any, dtype: str, *, sigma: bool = False, **settings: Any) -> Case:
    operation = MergeHeights(sigma=sigma, **settings)
    given = [tuple(each.astype(each.dtype if each.dtype == np.uint8 else dtype) for each in m) for m in (one, two)]
    parameters = {key: getattr(operation, key) for key in ("max_sigmas", "tolerance", "disagreement", "require_both")}
    first, second = (each if sigma else (*each[:3], None) for each in given)
    expected = merge_heights(first, second, **parameters)
    exact = {key: value for key, value in expected._asdict().items() if sigma or key != "sigma"}
    (z1, light1, _, sigma1), (z2, light2, _, sigma2) = ([each.astype(np.float64) for each in m] for m in given)
    with np.errstate(invalid="ignore"):
        limit = operation.tolerance + (operation.max_sigmas * np.hypot(sigma1, sigma2) if sigma else 0.0)
        rounding = 4.0 * np.finfo(dtype).eps * (np.abs(z1) + np.abs(z2) + limit)
        undecided = (np.abs(np.abs(z1 - z2) - limit) <= rounding) & np.isfinite(rounding)
        quantities = {
            "z": np.fmax(np.abs(z1), np.abs(z2)) + np.nan_to_num(np.abs(z1 - z2), posinf=0.0),
            "intensity": np.fmax(light1, light2) + np.abs(light1 - light2),
            "sigma": exact.get("sigma", 0.0),
        }
    inputs = (*given[0][:3], *given[1][:3], *((given[0][3], given[1][3]) if sigma else ()))
    return Case("MergeHeights", name, operation, inputs, exact, quantities, undecided)
