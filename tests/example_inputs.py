"""Inputs for the examples of all operations, for tests that compare two runs of an operation bit by bit."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.matching.pose.feature_pose import PlaceFeatures

Array = NDArray[Any]


def random_values(shape: tuple[int, ...], dtype: np.dtype[Any], rng: np.random.Generator) -> Array:
    """Return positive numbers or grey levels; zeros for integers of 4 bytes and more, which are indices."""
    if dtype.kind == "f":
        return rng.uniform(0.1, 1.0, shape).astype(dtype)
    if dtype.itemsize < 4:
        return rng.integers(0, 200, shape).astype(dtype)
    return np.zeros(shape, dtype)


def inputs_with_numbers(operation: Any, arrays: list[Any], device: Device, rng: np.random.Generator) -> list[Array]:
    """Return inputs of the shapes and types of ``arrays`` for which an example has finite results.

    They are random, except for operations that find nothing in random images, rays and rows.
    """
    values = [random_values(each.shape, each.dtype, rng) for each in arrays]
    scene = _SCENES.get(type(operation).__name__)
    if scene is not None:
        scene(operation, values, device, rng)
    return values


def assert_has_numbers(operation: Any, results: Any) -> None:
    """Assert that each result in floating point has a finite number: equal NaN would prove nothing."""
    for name, values in zip(results._fields, results, strict=True):
        assert values is None or np.isfinite(values).any(), f"{type(operation).__name__}.{name} is nowhere finite"


def _edge(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Rulers across a blurred vertical edge with noise."""
    image, rulers = values
    rows, columns = image.shape
    step = 1.0 / (1.0 + np.exp(columns / 2.0 - np.arange(columns)))
    image[...] = 40.0 + 100.0 * step + rng.uniform(0.0, 10.0, image.shape)
    rulers[..., 0] = columns / 2.0 + rng.uniform(-3.0, 3.0, rulers.shape[:-1])
    rulers[..., 1] = rows / 2.0 + rng.uniform(-3.0, 3.0, rulers.shape[:-1])
    rulers[..., 2], rulers[..., 3] = 1.0, 0.0


def _discs(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Blurred discs with noise, and places 1 px beside them."""
    image, places = values
    row, column = np.indices(image.shape)
    image[...] = rng.uniform(20.0, 25.0, image.shape)
    for number, place in enumerate(places):
        x, y, radius = 30.0 + 40.0 * number, 50.0, 8.0
        image += (100.0 / (1.0 + np.exp(np.hypot(column - x, row - y) - radius))).astype(image.dtype)
        place[:] = x + rng.uniform(-1.0, 1.0), y + rng.uniform(-1.0, 1.0), radius


def _features(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Features measured within a twentieth of a pixel of where the expected pose places them."""
    values[0][...], values[1][...] = 0.0, 0.0
    placed = PlaceFeatures(features=operation.features)(values[0], values[1], device=device)
    rest = iter(values[2:])
    for kind in placed:
        if kind is None:
            continue
        if kind.shape[1] == 7:
            position, sigma, status, place = (next(rest) for _ in range(4))
            position[:], sigma[:] = rng.uniform(-0.05, 0.05, len(kind)), 0.02
        else:
            shift, size, covariance, status, place = (next(rest) for _ in range(5))
            shift[:], size[:] = rng.uniform(-0.05, 0.05, shift.shape), kind[:, 2]
            covariance[:] = 1e-4 * np.eye(3)
        status[:], place[:] = 0, kind


def _field(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Points on the two lines at a corner of the field, seen from within the range of the map."""
    points, starts = values
    pose, corner = np.array([-1.0, 0.7, 0.0]), np.array([-1.085, 0.78])
    points[:] = corner - pose[:2]
    points[0::2, 0] += rng.uniform(0.0, 0.4, len(points[0::2]))
    points[1::2, 1] -= rng.uniform(0.0, 0.4, len(points[1::2]))
    starts[:] = pose + rng.uniform(-0.02, 0.02, starts.shape)


def _deposits(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Deposits of 6 x 6 cells with a margin of one cell, as many as fit, on a plane; the other boxes are empty."""
    z, sigma, owner, boxes, surfaces = values
    z[:], sigma[:], boxes[:], surfaces[:] = rng.uniform(0.0, 1e-6, z.shape), 1e-6, 0, 0.0
    surfaces[:, 6:13] = 0.0, 0.1, 0.0, 0.1, 0.4, 0.4, 1e-4
    across = z.shape[1] // 8
    for number in range(min(len(boxes), z.shape[0] // 8 * across)):
        row, column = 8 * (number // across), 8 * (number % across)
        boxes[number] = row, row + 8, column, column + 8
        owner[row : row + 8, column : column + 8] = -number - 1
        owner[row + 1 : row + 7, column + 1 : column + 7] = number + 1
        z[row + 1 : row + 7, column + 1 : column + 7] += rng.uniform(5e-5, 1e-4, (6, 6))


def _heights(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Heights without steps, whose places cover the grid along the direction of the pass."""
    place, z, _, status, *_ = values
    grid, (lines, samples) = operation.regrid.grid, z.shape
    if operation.direction == "x":
        place[:] = grid.left + np.linspace(0.0, grid.columns * grid.cell_x, samples)
    else:
        place[:] = (grid.top - np.linspace(0.0, grid.rows * grid.cell_y, lines))[:, None]
    place += rng.uniform(0.0, 1e-5, place.shape).astype(place.dtype)
    z *= 1e-4
    status[:] = 0


def _rays(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Rays from in front of the triangles, which stand side by side along y, through their corner at the origin."""
    rays = values[0]
    rays[:, :3] = rng.uniform(1e-3, 4e-3, (len(rays), 3))
    rays[:, 1] = -0.01
    rays[:, 3:] = rng.uniform(-0.05, 0.05, (len(rays), 3))
    rays[:, 4] = 1.0


def _mirrors(operation: Any, values: list[Array], device: Device, rng: np.random.Generator) -> None:
    """Points and a lens in front of the mirrors, which stand side by side along y."""
    points, lens = values
    points[:, :3] = rng.uniform(1e-3, 4e-3, (len(points), 3))
    points[:, 1] = -0.01
    lens[:] = 4e-3, -0.02, 4e-3


_SCENES: dict[str, Callable[[Any, list[Array], Device, np.random.Generator], None]] = {
    "ClosestHit": _rays,
    "FieldPoseRefinement": _field,
    "FindBlobs": _discs,
    "MeasureBoardEdges": _edge,
    "MeasureDeposits": _deposits,
    "MirrorPoints": _mirrors,
    "RulerEdges": _edge,
    "SolveFeatures": _features,
    "_AlongProfiles": _heights,
    "_AlongSamples": _heights,
}
