"""All poses of a grid on the device: known edges against a picture's edges, by place and direction.

A picture becomes cells (`CellMeans`), and those what an edge costs in each of them, for eight directions of its normal
(`EdgeLevels`): little where the gradient is strong and points that way or the other, whatever the contrast.
`SearchEdges` adds that up over the known edges, for every shift and heading; `shifts_of` says where they lie.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, LaunchBuilder, Variant, WorkSize, capacity, flags, type_defines
from gpuvision.matching.field.field_pose import PoseCosts, pose_cost_outputs, pose_grid_work
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite

CHANNELS, LEVELS = 8, 1023
"""Directions of normals, pi / 8 apart, and steps of a cost."""
_BLOCK, _MOST_POINTS, _MOST_CELLS = 64, 4096, 1 << 26


class Means(NamedTuple):
    """float32 (rows, columns) of cells, the means of their pixels."""

    means: Any


class Levels(NamedTuple):
    """uint16 (8, rows, columns), an edge's cost in `LEVELS` steps, by the direction of its normal and its cell."""

    level: Any


@dataclass(frozen=True, kw_only=True)
class CellMeans(VisionOperation[Means]):
    """Means of square cells: ``op(image) -> Means``, of uint8, uint16 or float32 (rows, columns).

    Parameters
    ----------
    cell_px
        A cell's side; what is left over at the right and below is not used.

    Notes
    -----
    Error: single precision, at most cell_px^2 roundings of a sum: 2^-24 cell_px^2 of the greatest pixel.
    """

    Result: ClassVar[type[Any]] = Means

    cell_px: int = 2

    def __post_init__(self) -> None:
        if not isinstance(self.cell_px, int) or not 1 <= self.cell_px <= 64:
            raise ValueError(f"CellMeans.cell_px is {self.cell_px!r}, expected a whole number, 1 to 64")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        build.check_dtype("uint8", "uint16", "float32", of="images")
        is_valid = len(shape) == 2 and min(shape) >= 3 * self.cell_px
        build.check_shape(is_valid, "images (rows, columns) of 3 cells or more each way")
        cells = (shape[0] // self.cell_px, shape[1] // self.cell_px)
        return build.launch(
            "edge_search/edge_search.cl",
            "cell_means",
            work=WorkSize(cells[::-1], None),
            outputs=build.outputs({"means": cells}),
            defines=type_defines("CODE", dtype),
            arguments=[np.int32(shape[1]), np.int32(self.cell_px)],
        )


@dataclass(frozen=True, kw_only=True)
class EdgeLevels(VisionOperation[Levels]):
    """What an edge costs in each cell: ``op(means) -> Levels``, of float32 (rows, columns).

    1 - (g_k^2 / (g^2 + t^2))^2, the least of the cell and its eight neighbours: g is the gradient by 3 x 3 cells
    (Sobel), g_k its part along the normal of direction k, t a quarter of the threshold (a sharp step has half its
    height for g). Without neighbours all round, or where one is not finite, there is no gradient; that costs 1.

    Parameters
    ----------
    threshold
        Height of an edge that costs a third [grey levels].
    border
        Cells without edges that are laid round.

    Notes
    -----
    Error: a step of `LEVELS`, and single precision's 1e-6 of the greatest mean in a gradient.
    """

    Result: ClassVar[type[Any]] = Levels

    threshold: float
    border: int = 0

    def __post_init__(self) -> None:
        if finite(self.threshold, "EdgeLevels.threshold") <= 0.0:
            raise ValueError(f"EdgeLevels.threshold is {self.threshold}, expected grey levels above 0")
        if not isinstance(self.border, int) or self.border < 0:
            raise ValueError(f"EdgeLevels.border is {self.border!r}, expected a whole number, 0 or more")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        build.check_dtype("float32", of="means")
        build.check_shape(len(shape) == 2 and min(shape) >= 3, "means (rows, columns) of 3 cells or more each way")
        rows, columns = (each + 2 * self.border for each in shape)
        if CHANNELS * rows * columns > _MOST_CELLS:
            raise ValueError(f"EdgeLevels: {rows} x {columns} cells with the border are too many; make cells larger")
        angles = np.arange(CHANNELS) * (math.pi / CHANNELS)
        return build.launch(
            "edge_search/edge_search.cl",
            "edge_levels",
            work=WorkSize((columns, rows), None),
            outputs=build.outputs({"level": (CHANNELS, rows, columns)}, level=np.uint16),
            defines=flags(FROM_MEANS=True),
            arguments=[
                *map(np.int32, (*shape, self.border)),
                np.float32((0.25 * self.threshold) ** 2),
                np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
            ],
        )


@dataclass(frozen=True, kw_only=True)
class SearchEdges(VisionOperation[PoseCosts]):
    """Score all shifts for all headings: ``op(level, shifts) -> PoseCosts``.

    ``level`` is uint16 (channels, rows, columns) as `EdgeLevels` gives it; ``shifts`` int32 (headings, points), for
    every point the cell, counted through all of ``level``, that it lies on at the first position (row 0, column 0).
    One that is negative, or from which a position leaves ``level``, is not used.

    Parameters
    ----------
    rows, columns
        Positions: shifts by 0, 1, ... cells down and to the right.
    headings, points
        How many.
    with_scores
        Also give every pose's score, not only the least of each block.
    variant
        "vector" (64 positions at once, for CPU runtimes), "work_item" (a work-item per position, for GPUs), or "auto".

    Notes
    -----
    Sums are exact; what a score says is `EdgeLevels`' error.
    """

    Result: ClassVar[type[Any]] = PoseCosts

    rows: int
    columns: int
    headings: int
    points: int
    with_scores: bool = False
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, most in (("rows", 4096), ("columns", 4096), ("headings", 4096), ("points", _MOST_POINTS)):
            if not isinstance(getattr(self, name), int) or not 1 <= getattr(self, name) <= most:
                raise ValueError(f"SearchEdges.{name} is {getattr(self, name)!r}, expected 1 to {most}")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, variant=self.variant)
        build.check_dtype("uint16", of="levels")
        build.check_shape(len(shape) == 3, "levels (channels, rows, columns)")
        # A whole block of positions is read.
        limit = math.prod(shape) - (self.rows - 1) * shape[2] - max(self.columns, _BLOCK) + 1
        if shape[1] < self.rows or shape[2] < self.columns or limit < 1:
            raise ValueError(
                f"SearchEdges takes levels of {self.rows} x {self.columns} cells or more, got shape {shape}; lay a "
                f"wider border"
            )
        grid = (self.headings, self.rows, self.columns)
        work = pose_grid_work(build, *grid)
        return build.launch(
            "edge_search/edge_search.cl",
            "edge_search",
            work=work,
            more_inputs=[((self.headings, self.points), np.dtype(np.int32))],
            outputs=pose_cost_outputs(build, *grid, with_scores=self.with_scores),
            defines={"CAPACITY": capacity(self.points, least=64), **flags(WITH_SCORES=self.with_scores)},
            arguments=[*map(np.int32, (self.points, self.rows, self.columns, shape[2], limit, work.each))],
        )


def shifts_of(
    points_px: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    cell_px: int,
    border: int,
    shape: tuple[int, ...],
    positions: tuple[int, int],
) -> npt.NDArray[np.int32]:
    """Say where points lie in ``level``, for positions about where they are.

    Parameters
    ----------
    points_px, normals
        (headings, points, 2) in the image, for the middle position.
    cell_px, border
        Of `CellMeans` and `EdgeLevels`.
    shape
        Of ``level``.
    positions
        Rows and columns; odd, the middle one is no shift.

    Returns
    -------
    numpy.ndarray
        int32 (headings, points) as `SearchEdges` takes them, -1 where not all positions lie in ``level``.
    """
    cell = (points_px + 0.5) / cell_px - 0.5
    rows, columns = positions
    _, height, stride = shape
    with np.errstate(invalid="ignore"):
        column = np.rint(cell[..., 0]) + border - columns // 2
        row = np.rint(cell[..., 1]) + border - rows // 2
        channel = np.rint(np.arctan2(normals[..., 1], normals[..., 0]) * (CHANNELS / math.pi)) % CHANNELS
        inside = (row >= 0) & (row <= height - rows) & (column >= 0) & (column <= stride - columns)
        shift = (channel * height + row) * stride + column
    return np.where(inside, shift, -1).astype(np.int32)


class RoughShifts(NamedTuple):
    """Poses of a grid: which heading, how many cells right and down (poses, 2), and what each costs, 0 to 1."""

    heading: npt.NDArray[np.int64]
    cells: npt.NDArray[np.int64]
    scores: npt.NDArray[np.float64]


def best_shifts(costs: PoseCosts, positions: tuple[int, int], most: int, apart: tuple[int, int]) -> RoughShifts:
    """Return the best poses, best first, none within ``apart`` (cells, headings) of a better one.

    Parameters
    ----------
    costs
        What `SearchEdges` gave, NumPy arrays.
    positions
        As in `shifts_of`: cells are counted from the middle position.
    most
        How many at most.
    apart
        Cells each way, and headings, within which poses are the same.
    """
    least = np.array(costs.least, np.float64).ravel()
    least[~np.isfinite(least)] = np.inf
    heading, row, _ = np.unravel_index(np.arange(least.size), np.shape(costs.least))
    down = row - positions[0] // 2
    right = np.ravel(costs.column) - positions[1] // 2
    chosen: list[int] = []
    scores: list[float] = []
    while len(chosen) < most:
        number = int(np.argmin(least))
        if not np.isfinite(least[number]):
            break
        chosen.append(number)
        scores.append(float(least[number]))
        near = (np.abs(down - down[number]) <= apart[0]) & (np.abs(right - right[number]) <= apart[0])
        least[near & (np.abs(heading - heading[number]) <= apart[1])] = np.inf
    return RoughShifts(heading[chosen], np.stack([right[chosen], down[chosen]], axis=-1), np.array(scores))
