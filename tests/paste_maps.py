"""Height maps of solder paste with closed-form volumes: boxes, spherical caps and frusta on a tilted board."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.inspection.apertures import Aperture, BoardPlacement, make_aperture
from gpuvision.matching.artwork.shapes import Shape, disk
from gpuvision.ranging.height_map import Grid

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Box:
    """Box with sides along x and y of the map."""

    size: tuple[float, float]
    height: float

    @property
    def volume(self) -> float:
        return self.size[0] * self.size[1] * self.height

    def heights(self, x: Array, y: Array) -> Array:
        inside = (np.abs(x) < self.size[0] / 2) & (np.abs(y) < self.size[1] / 2)
        return np.where(inside, self.height, 0.0)


@dataclass(frozen=True)
class Cap:
    """Spherical cap of a base radius and a height."""

    radius: float
    height: float

    @property
    def volume(self) -> float:
        return math.pi * self.height * (3 * self.radius**2 + self.height**2) / 6

    def heights(self, x: Array, y: Array) -> Array:
        sphere = (self.radius**2 + self.height**2) / (2 * self.height)
        away = np.hypot(x, y)
        dome = np.sqrt(np.maximum(sphere**2 - away**2, 0.0)) - (sphere - self.height)
        return np.where(away < self.radius, dome, 0.0)

    def area_above(self, level: float) -> float:
        sphere = (self.radius**2 + self.height**2) / (2 * self.height)
        return math.pi * (sphere**2 - (level + sphere - self.height) ** 2)


@dataclass(frozen=True)
class Frustum:
    """Truncated cone with a base radius, a top radius and a height."""

    radius: float
    top: float
    height: float

    @property
    def volume(self) -> float:
        return math.pi * self.height * (self.radius**2 + self.radius * self.top + self.top**2) / 3

    def heights(self, x: Array, y: Array) -> Array:
        rise = (self.radius - np.hypot(x, y)) / (self.radius - self.top)
        return self.height * np.clip(rise, 0.0, 1.0)

    def area_above(self, level: float) -> float:
        return math.pi * (self.radius - (self.radius - self.top) * level / self.height) ** 2


def board_grid(columns: int, rows: int, cell: float = 10e-6) -> Grid:
    """Return a grid whose lower left corner (not centre) is (0, 0)."""
    return Grid(left=cell / 2, top=(rows - 0.5) * cell, cell_x=cell, cell_y=cell, columns=columns, rows=rows)


def rectangle(name: str, centre: tuple[float, float], size: tuple[float, float]) -> Aperture:
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array(size) / 2 + np.array(centre)
    return make_aperture(name, [Shape(corners)])


def circle(name: str, centre: tuple[float, float], radius: float) -> Aperture:
    return make_aperture(name, [Shape(disk(np.array(centre), radius))])


def paste_map(
    grid: Grid,
    placement: BoardPlacement,
    deposits: list[tuple[Box | Cap | Frustum, tuple[float, float]]],
    plane: tuple[float, float, float] = (1e-3, 0.01, -0.02),
) -> Array:
    """Return heights of deposits at places of the board, on a plane z = a + b x + c y of the map."""
    x, y = np.meshgrid(grid.x, grid.y)
    z = plane[0] + plane[1] * x + plane[2] * y
    for deposit, place in deposits:
        at = placement.to_map(np.array(place))
        z = z + deposit.heights(x - at[0], y - at[1])
    return np.asarray(z)
