"""Exhaustive search of a grid of poses: known edges against the edges of an image, by position and direction.

`CellMeans` reduces the image to cells. `EdgeCostMap` computes the cost of an edge in each cell for eight directions of
its normal: low where the gradient is strong and parallel to the normal (either sign), independent of the contrast.
`EdgeSearch` sums these costs over the known edges for every shift and heading of the grid; `cell_offsets` gives the
cells on which the known edges lie. The cost is the cost of chamfer matching [1]_ with a truncated orientation-dependent
distance.

References
----------
.. [1] H. G. Barrow et al., "Parametric correspondence and chamfer matching: two new techniques for image matching",
   IJCAI 1977.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Array,
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Variant,
    flags,
    padded_rows,
    to_numpy,
    type_defines,
)
from gpuvision.matching.field.field_pose import (
    PoseCosts,
    is_short_search,
    pose_cost_outputs,
    pose_grid_defines,
    pose_grid_work,
)
from gpuvision.operation import VisionOperation
from gpuvision.validation import finite, integer

CHANNELS, COST_LEVELS = 8, 1023
"""Directions of normals, pi / 8 apart, and steps of a cost."""
_BLOCK, _MOST_POINTS, _MOST_CELLS = 64, 4096, 1 << 26


class Means(NamedTuple):
    """Means of square cells: ``means`` is float32 (rows, columns) of cells."""

    means: FloatArray


class EdgeCosts(NamedTuple):
    """Costs of edges: ``level`` is uint16 (8, rows, columns), by direction of the normal, in `COST_LEVELS` steps."""

    level: Array


@dataclass(frozen=True, kw_only=True)
class CellMeans(VisionOperation[Means]):
    """Means of square cells: ``op(image) -> Means``, image uint8, uint16 or float32 of shape (rows, columns).

    Parameters
    ----------
    cell_px : int
        Side of a cell [px], 1 to 64, default 2. Incomplete cells at the right and at the bottom are dropped.

    Raises
    ------
    ValueError
        The parameter is out of its range.

    Notes
    -----
    Error: single precision with at most cell_px^2 roundings of a sum: 2^-24 cell_px^2 of the greatest pixel.
    """

    Result: ClassVar[type[Any]] = Means

    cell_px: int = 2

    def __post_init__(self) -> None:
        integer(self.cell_px, "CellMeans.cell_px", minimum=1, maximum=64)

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
            work=padded_rows(*cells),
            outputs=build.outputs({"means": cells}),
            defines=type_defines("CODE", dtype),
            arguments=[np.int32(shape[1]), np.int32(self.cell_px)],
        )


@dataclass(frozen=True, kw_only=True)
class EdgeCostMap(VisionOperation[EdgeCosts]):
    """Cost of an edge in each cell: ``op(means) -> EdgeCosts``, means float32 of shape (rows, columns).

    The cost is 1 - (g_k^2 / (g^2 + t^2))^2, the least of the cell and its eight neighbours. g is the gradient over 3 x
    3 cells (Sobel), g_k its component along the normal of direction k, and t a quarter of the threshold (a sharp step
    of height h has g = h / 2). A cell without neighbours on all sides, or with one that is not finite, has no gradient
    and costs 1.

    Parameters
    ----------
    threshold : float
        Height of an edge that costs about a third [grey levels], above 0.
    border : int
        Width of a border of cells without edges around the image [cells], 0 or more. Default 0.

    Raises
    ------
    ValueError
        A parameter is out of its range.

    Notes
    -----
    Error: one of `COST_LEVELS` steps, and single precision's 1e-6 of the greatest mean in a gradient.
    """

    Result: ClassVar[type[Any]] = EdgeCosts

    threshold: float
    border: int = 0

    def __post_init__(self) -> None:
        if finite(self.threshold, "EdgeCostMap.threshold") <= 0.0:
            raise ValueError(f"EdgeCostMap.threshold is {self.threshold}, expected grey levels above 0")
        integer(self.border, "EdgeCostMap.border", minimum=0)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype)
        build.check_dtype("float32", of="means")
        build.check_shape(len(shape) == 2 and min(shape) >= 3, "means (rows, columns) of 3 cells or more each way")
        rows, columns = (each + 2 * self.border for each in shape)
        if CHANNELS * rows * columns > _MOST_CELLS:
            raise ValueError(f"EdgeCostMap: {rows} x {columns} cells with the border are too many; make cells larger")
        angles = np.arange(CHANNELS) * (math.pi / CHANNELS)
        return build.launch(
            "edge_search/edge_search.cl",
            "edge_levels",
            work=padded_rows(rows, columns),
            outputs=build.outputs({"level": (CHANNELS, rows, columns)}, level=np.uint16),
            defines={"COST_LEVELS": COST_LEVELS, **flags(FROM_MEANS=True)},
            arguments=[
                *map(np.int32, (*shape, self.border)),
                np.float32((0.25 * self.threshold) ** 2),
                np.stack([np.cos(angles), np.sin(angles)], axis=-1).astype(np.float32),
            ],
        )


@dataclass(frozen=True, kw_only=True)
class EdgeSearch(VisionOperation[PoseCosts]):
    """Score of every pose of a grid: ``op(level, offsets) -> PoseCosts``.

    ``level`` is uint16 (channels, rows, columns), the result of `EdgeCostMap`. ``offsets`` is int32 (headings, points),
    the result of `cell_offsets`: for every point the flat index into ``level`` of its cell at the first position (row
    0, column 0). A point with a negative index, or one that leaves ``level`` at some position, is not used.

    Parameters
    ----------
    rows, columns : int
        Number of positions: shifts by 0, 1, ... cells down and to the right, 1 to 4096 each.
    headings, points : int
        Number of headings, 1 to 4096, and of points, 1 to 4096.
    with_scores : bool
        Whether to return the score of every pose, besides the least of each block. Default False.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 64 positions at once (CPU runtimes), "work_item" one position per work-item
        (GPUs).

    Raises
    ------
    ValueError
        A parameter is out of its range.

    Notes
    -----
    The sums are exact; a score has the error of `EdgeCostMap`.
    """

    Result: ClassVar[type[Any]] = PoseCosts

    rows: int
    columns: int
    headings: int
    points: int
    with_scores: bool = False
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name, limit in (("rows", 4096), ("columns", 4096), ("headings", 4096), ("points", _MOST_POINTS)):
            integer(getattr(self, name), f"EdgeSearch.{name}", minimum=1, maximum=limit)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, variant=self.variant)
        build.check_dtype("uint16", of="levels")
        build.check_shape(len(shape) == 3, "levels (channels, rows, columns)")
        # The kernel reads complete blocks of positions.
        limit = math.prod(shape) - (self.rows - 1) * shape[2] - max(self.columns, _BLOCK) + 1
        if shape[1] < self.rows or shape[2] < self.columns or limit < 1:
            raise ValueError(
                f"EdgeSearch takes levels of {self.rows} x {self.columns} cells or more, got shape {shape}; give a "
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
            defines=pose_grid_defines(work, self.columns, self.points, with_scores=self.with_scores),
            arguments=[*map(np.int32, (self.points, self.rows, self.columns, shape[2], limit, work.each))],
            passes_once=is_short_search(work, math.prod(grid), self.points),
        )


def cell_offsets(
    points_px: npt.NDArray[np.float64],
    normals: npt.NDArray[np.float64],
    cell_px: int,
    border: int,
    shape: tuple[int, ...],
    positions: tuple[int, int],
) -> npt.NDArray[np.int32]:
    """Return the index of the cell of each point in ``level``, at the first position of a grid centred on the points.

    Parameters
    ----------
    points_px, normals
        (headings, points, 2) positions in the image [px] for the middle position, and unit normals.
    cell_px, border
        Parameters of `CellMeans` and `EdgeCostMap`.
    shape
        Shape of ``level``.
    positions
        Rows and columns of positions, odd; the middle one is no shift.

    Returns
    -------
    numpy.ndarray
        int32 (headings, points) as `EdgeSearch` takes them; -1 where not all positions lie in ``level``.
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


class GridShifts(NamedTuple):
    """Poses of a grid: index of the heading, (poses, 2) cells right and down, and score, 0 to 1."""

    heading: npt.NDArray[np.int64]
    cells: npt.NDArray[np.int64]
    scores: npt.NDArray[np.float64]


def find_best_shifts(
    costs: PoseCosts, positions: tuple[int, int], max_candidates: int, separation: tuple[int, int]
) -> GridShifts:
    """Return the best poses of a grid, best first, with non-maximum suppression.

    Parameters
    ----------
    costs
        Result of `EdgeSearch`, NumPy arrays.
    positions
        As in `cell_offsets`: cells are counted from the middle position.
    max_candidates
        Largest number of poses.
    separation
        (cells, headings): poses within this distance of a better one are suppressed.
    """
    least = to_numpy(costs.least).astype(np.float64).ravel()
    least[~np.isfinite(least)] = np.inf
    heading, row, _ = np.unravel_index(np.arange(least.size), np.shape(costs.least))
    down = row - positions[0] // 2
    right = to_numpy(costs.column).ravel() - positions[1] // 2
    chosen: list[int] = []
    scores: list[float] = []
    while len(chosen) < max_candidates:
        number = int(np.argmin(least))
        if not np.isfinite(least[number]):
            break
        chosen.append(number)
        scores.append(float(least[number]))
        neighbours = (np.abs(down - down[number]) <= separation[0]) & (np.abs(right - right[number]) <= separation[0])
        least[neighbours & (np.abs(heading - heading[number]) <= separation[1])] = np.inf
    return GridShifts(heading[chosen], np.stack([right[chosen], down[chosen]], axis=-1), np.array(scores))
