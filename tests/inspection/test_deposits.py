"""Sums of deposits on the device against the float64 reference, at the edges of the map, and their messages."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest

from gpuvision.host import Device, to_numpy
from gpuvision.inspection.deposits import SURFACE, TERMS, DepositSums, MeasureDeposits
from gpuvision.reference.deposits import Plane, ReferenceDeposit, measure_deposit
from gpuvision.status import Status

CELL = 10e-6
STATUS = {"measured": Status.OK, "missing": Status.LOW_SIGNAL, "holes": Status.NO_DATA}
TURN = np.array([[math.cos(0.3), math.sin(0.3)], [-math.sin(0.3), math.cos(0.3)]])


class Scene(NamedTuple):
    """Inputs of the operation, and the surfaces and centroids of the apertures."""

    z: np.ndarray
    sigma: np.ndarray
    owner: np.ndarray
    boxes: np.ndarray
    table: np.ndarray
    surfaces: list[Plane]
    centroids: np.ndarray


def places(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    rows, columns = np.indices(shape)
    return columns * CELL, (shape[0] - 1 - rows) * CELL


def scene(
    rng: np.random.Generator, shape: tuple[int, int], dtype: Any, *, pitch: int = 24, holes: float = 0.05
) -> Scene:
    """Round deposits on curved surfaces, one per square of ``pitch`` cells, up to the border of the map.

    The first deposit is missing, the second has too many holes.
    """
    x, y = places(shape)
    z, sigma, owner = rng.normal(0.0, 2e-6, shape), rng.uniform(1e-6, 4e-6, shape), np.zeros(shape, np.int32)
    boxes, table, surfaces, centroids = [], [], [], []
    for top in range(0, shape[0] - pitch + 1, pitch):
        for left in range(0, shape[1] - pitch + 1, pitch):
            number = len(boxes)
            box = (slice(top, top + pitch), slice(left, left + pitch))
            centroid = np.array([x[box].mean(), y[box].mean()]) + rng.uniform(-CELL, CELL, 2)
            away = np.hypot(x[box] - centroid[0], y[box] - centroid[1])
            radius = 0.36 * pitch * CELL
            owner[box] = np.where(away < radius, number + 1, np.where(away < 0.48 * pitch * CELL, -number - 1, 0))
            covariance = np.diag(rng.uniform(0.5, 2.0, TERMS) * 1e-14)
            covariance[0, 1] = covariance[1, 0] = 2e-15
            terms = np.array([1e-3, 5e-6, -8e-6, 3e-6, 2e-6, -1e-6]) * rng.uniform(0.5, 1.0, TERMS)
            surface = Plane(terms, covariance, centroid + 3 * CELL, 0.6 * pitch * CELL)
            z[box] += (terms @ surface.basis(x[box].ravel(), y[box].ravel())).reshape(pitch, pitch)
            z[box] += 0.0 if number == 0 else np.clip(120e-6 * (1.3 - (away / radius) ** 2), 0.0, 120e-6)
            z[box] = np.where(rng.random((pitch, pitch)) < (0.5 if number == 1 else 0.05), math.nan, z[box])
            first = (np.array([left * CELL, (shape[0] - 1 - top) * CELL]) - surface.centre) / surface.length
            middle, step = (centroid - surface.centre) / surface.length, CELL / surface.length
            row = [*terms, first[0], step, first[1], -step, *middle, surface.length, *covariance.ravel()]
            boxes.append((top, top + pitch, left, left + pitch))
            table.append(row)
            surfaces.append(surface)
            centroids.append(centroid)
    numbers = np.array(boxes, np.int32), np.array(table, dtype)
    return Scene(z.astype(dtype), sigma.astype(dtype), owner, *numbers, surfaces, np.array(centroids))


def operation(of: Scene, **more: Any) -> MeasureDeposits:
    settings = {"cell_area": CELL**2, "threshold": 60e-6, "correlation_area": 1.7, "to_board": TURN} | more
    return MeasureDeposits(apertures=len(of.boxes), **settings)


def run(measured: MeasureDeposits, of: Scene, device: Device) -> DepositSums:
    sums = measured(of.z, of.sigma, of.owner, of.boxes, of.table, device=device)
    return DepositSums(*map(to_numpy, sums))


def expected(of: Scene, **settings: Any) -> list[ReferenceDeposit]:
    x, y = (each.ravel() for each in places(of.z.shape))
    z, sigma, owner = of.z.ravel().astype(np.float64), of.sigma.ravel().astype(np.float64), of.owner.ravel()
    given = {"cell_area": CELL**2, "threshold": 60e-6, "correlation_area": 1.7, "to_board": TURN} | settings
    return [
        measure_deposit(z, sigma, x, y, owner == number, owner == -number, surface, centroid, **given)
        for number, (surface, centroid) in enumerate(zip(of.surfaces, of.centroids, strict=True), 1)
    ]


def check(found: DepositSums, wanted: list[ReferenceDeposit], rtol: float) -> None:
    assert [Status(int(each)) for each in found.status] == [STATUS[each.status] for each in wanted]
    for name in DepositSums._fields[:-1]:
        values = np.array([getattr(each, name) for each in wanted], np.float64)
        # An offset is small against the deposit: its rounding is that of a length of some cells. The kernel neglects
        # noise of more than 12 sigmas.
        atol = {"offset": rtol * 5 * CELL, "area_sigma": 1e-12 * CELL**2}.get(name, 0.0)
        np.testing.assert_allclose(getattr(found, name), values, rtol=rtol, atol=atol, err_msg=name)


@pytest.mark.parametrize("variant", ["vector", "work_item"])
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 2e-4), (np.float64, 1e-9)])
def test_sums_equal_the_reference(
    rng: np.random.Generator, device: Device, variant: Any, dtype: Any, rtol: float
) -> None:
    """Boxes of 24 columns end inside a vector; the last one ends with the map."""
    of = scene(rng, (48, 96), dtype)
    wanted = expected(of)
    assert [each.status for each in wanted[:3]] == ["missing", "holes", "measured"]
    check(run(operation(of, variant=variant), of, device), wanted, rtol)


def test_a_map_narrower_than_a_vector(rng: np.random.Generator, device: Device) -> None:
    of = scene(rng, (33, 11), np.float32, pitch=11)
    check(run(operation(of), of, device), expected(of), 2e-4)


def test_an_aperture_without_cells_and_cells_without_noise(rng: np.random.Generator, device: Device) -> None:
    """No cell: no deposit. Noise of almost 0: a cell is above the threshold or below it, and nothing overflows."""
    of = scene(rng, (48, 96), np.float32)
    of = of._replace(sigma=np.full_like(of.sigma, np.finfo(np.float32).tiny))
    of.owner[np.abs(of.owner) == 8] = 0
    found = run(operation(of), of, device)
    assert found.valid[7] == found.volume[7] == 0.0
    assert Status(int(found.status[7])) == Status.LOW_SIGNAL
    wanted = expected(of._replace(surfaces=of.surfaces[:7], centroids=of.centroids[:7]))
    check(DepositSums(*(each[:7] for each in found)), wanted, 2e-4)


def test_one_valid_cell_has_the_offset_of_its_place(device: Device) -> None:
    """Its place has no error but that of the surface, here 0; a difference of squares may round below 0."""
    of = scene(np.random.default_rng(3), (24, 72), np.float32)
    core, sigmas = of.owner == 1, []
    for row, column in np.argwhere(core):
        z = np.full_like(of.z, math.nan)
        z[row, column] = of.z[12, 12] + 300e-6 if math.isfinite(of.z[12, 12]) else 1.3e-3
        table = of.table.copy()
        table[:, -(TERMS**2) :] = 0.0
        single = of._replace(z=z, owner=np.where(core, 1, 0).astype(np.int32), table=table)
        found = run(operation(single, least_valid=1e-3), single, device)
        assert Status(int(found.status[0])) == Status.OK
        sigmas.append(found.offset_sigma[0])
    assert np.isfinite(sigmas).all()
    np.testing.assert_allclose(sigmas, 0.0, atol=0.01 * CELL)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("apertures", 0, r"MeasureDeposits\.apertures is 0"),
        ("threshold", 0.0, r"MeasureDeposits\.threshold is 0"),
        ("correlation_area", 0.5, r"MeasureDeposits\.correlation_area is 0\.5"),
        ("to_board", np.eye(3), r"MeasureDeposits\.to_board must be a finite matrix \(2, 2\)"),
    ],
)
def test_wrong_parameters_are_refused(name: str, value: Any, message: str) -> None:
    settings: dict[str, Any] = {"apertures": 1, "cell_area": 1e-10, "threshold": 1e-5} | {name: value}
    with pytest.raises(ValueError, match=message):
        MeasureDeposits(**settings)


def test_wrong_inputs_are_refused(device: Device) -> None:
    op = MeasureDeposits(apertures=1, cell_area=1e-10, threshold=1e-5)
    with pytest.raises(ValueError, match="heights \\(rows, columns\\) of 16 cells or more"):
        op.launch(device, (3, 3), np.dtype(np.float32))
    with pytest.raises(TypeError, match="float32"):
        op.launch(device, (8, 8), np.dtype(np.uint8))
    assert SURFACE == 49


def test_the_axes_of_the_map_are_those_of_the_board_by_default() -> None:
    np.testing.assert_array_equal(MeasureDeposits.to_board, np.eye(2))
