"""Contract of the measurement of deposits: paste of many heights, none at all, holes, sloping reference surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.inspection.deposits import MeasureDeposits
from gpuvision.profiling.contract.agreement import Case, Limit, equal, roundings
from gpuvision.reference.deposits import Plane, measure_deposit
from gpuvision.status import Status

_HEIGHT = "surface and difference: a height has four half epsilons of its distance from 0; sums are rounded"
LIMITS = {
    "MeasureDeposits": (
        equal("status", reason="comparisons only, except within rounding of the significance"),
        Limit(
            ("area",), 1e-6, 2e-15, "area [m^2]",
            "error model of the docstring: sums to about 1e-6; except for heights within rounding of the threshold",
        ),
        roundings(1, "valid", of="1", reason="quotient of two counts"),
        roundings(4, "volume", of="sum of the distances of the heights from 0 x cell area [m^3]", reason=_HEIGHT),
        roundings(4, "height_mean", of="largest distance of a height from 0 [m]", reason=_HEIGHT),
        roundings(16, "volume_sigma", of="sigma [m^3]", reason="sums of squares, and the form of the covariance"),
        roundings(
            8, "offset", of="size of the aperture x sum of the distances from 0 / sum of the heights [m]",
            reason="the volume's error in numerator and denominator",
        ),
    )
}  # fmt: skip
_CELL, _WINDOW, _ROWS, _COLUMNS = 10e-6, 24, 2, 5  # cell in metres, window in cells, and numbers of windows
_RADIUS, _THRESHOLD = 9.0, 60e-6  # radius of the paste in cells
_STATUS = {"measured": Status.OK, "missing": Status.LOW_SIGNAL, "holes": Status.NO_DATA}


def cases() -> Iterator[Case]:
    """Yield deposits 0 to 120 um high at 1 mm and at 0.1 m from the origin of the heights, also in double precision."""
    yield _case("1 mm from 0, float32", 1e-3, "float32")
    yield _case("0.1 m from 0, float32", 0.1, "float32")
    yield _case("1 mm from 0, float64", 1e-3, "float64")


def _case(name: str, base: float, dtype: str) -> Case:
    rng, count = np.random.default_rng(36), _ROWS * _COLUMNS
    z = rng.normal(0.0, 2e-6, (_ROWS * _WINDOW, _COLUMNS * _WINDOW))
    sigma, owner = rng.uniform(1e-6, 4e-6, z.shape).astype(dtype), np.zeros(z.shape, np.int32)
    away = np.hypot(*(np.indices((_WINDOW, _WINDOW)) - (_WINDOW - 1) / 2))
    x, y = np.arange(z.shape[1]) * _CELL, np.arange(z.shape[0])[:, None] * -_CELL
    covariance, length = np.diag([1e-14, 2e-14, 2e-14, 0.0, 0.0, 0.0]), _WINDOW * _CELL
    boxes, planes, table = np.empty((count, 4), np.int32), [], []
    for number in range(count):
        top, left = (_WINDOW * each for each in divmod(number, _COLUMNS))
        box = slice(top, top + _WINDOW), slice(left, left + _WINDOW)
        boxes[number] = top, top + _WINDOW, left, left + _WINDOW
        middle = np.array([x[box[1]].mean(), y[box[0]].mean()])
        terms = np.array([base, *rng.uniform(-8e-6, 8e-6, 5)]).astype(dtype).astype(np.float64)
        planes.append(Plane(terms, covariance, middle, length))
        u, v = (x[box[1]] - middle[0]) / length, (y[box[0]] - middle[1]) / length
        z[box] += np.tensordot(terms, np.stack(np.broadcast_arrays(u * 0 + 1.0, u, v, u * u, u * v, v * v)), 1)
        z[box] += np.clip(13e-6 * number * (1.3 - (away / _RADIUS) ** 2), 0.0, None)
        owner[box] = np.where(away < _RADIUS, number + 1, np.where(away < 11.0, -number - 1, 0))
        start, step = (_WINDOW - 1) / 2 / _WINDOW, 1.0 / _WINDOW
        table.append([*terms, -start, step, start, -step, 0.0, 0.0, length, *covariance.ravel()])
    z[rng.random(z.shape) < 0.05] = np.nan
    z[: _WINDOW // 2, _WINDOW : 2 * _WINDOW] = np.nan  # the second aperture has too many holes
    given = z.astype(dtype)
    operation = MeasureDeposits(apertures=count, cell_area=_CELL**2, threshold=_THRESHOLD)
    places = np.broadcast_arrays(x, y)
    found = [_reference(given, sigma, owner, places, number, planes[number]) for number in range(count)]
    results, sizes, undecided = zip(*found, strict=True)
    exact, quantities = ({key: np.array([each[key] for each in part]) for key in part[0]} for part in (results, sizes))
    inputs = (given, sigma, owner, boxes, np.array(table, dtype))
    return Case("MeasureDeposits", name, operation, inputs, exact, quantities, np.array(undecided))


def _reference(
    z: npt.NDArray[Any], sigma: npt.NDArray[Any], owner: npt.NDArray[Any], places: Any, number: int, plane: Plane
) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """Return the outputs and their quantities of a deposit, and whether a height is at the threshold."""
    own = np.abs(owner) == number + 1
    heights, x, y = z[own].astype(np.float64), places[0][own], places[1][own]
    core = owner[own] > 0
    deposit = measure_deposit(
        heights, sigma[own].astype(np.float64), x, y, core, ~core, plane, plane.centre,
        cell_area=_CELL**2, threshold=_THRESHOLD,
    )  # fmt: skip
    over = heights - plane.coefficients @ plane.basis(x, y)
    far, total = np.nansum(np.abs(heights)), abs(np.nansum(over))
    rounding = 2.0 * np.finfo(z.dtype).eps * np.nanmax(np.abs(heights))
    names = ("area", "volume", "volume_sigma", "height_mean", "offset", "valid")
    exact = {name: getattr(deposit, name) for name in names} | {"status": int(_STATUS[deposit.status])}
    arm = _WINDOW * _CELL * far / total
    quantities = {
        "area": deposit.area, "volume": far * _CELL**2, "volume_sigma": deposit.volume_sigma,
        "height_mean": np.nanmax(np.abs(heights)), "offset": np.array([arm, arm]), "valid": 1.0,
    }  # fmt: skip
    return exact, quantities, bool(np.nanmin(np.abs(over - _THRESHOLD)) <= rounding)
