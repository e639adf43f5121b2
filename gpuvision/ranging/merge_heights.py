"""Merge of two height maps over one part, by two sensors or two recordings.

One sensor does not see behind an edge, the other one does (occlusion). Where both see the surface, the mean has less
noise; where they disagree, one of them reads a reflection (F. de Jong, *Range Imaging and Visual Servoing for
industrial applications*, TU Delft 2008, section 4.6.2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Tunable,
    Variant,
    flags,
    to_numpy,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.ranging.height_map import MAX_MAP_CELLS, Grid, HeightMap
from gpuvision.status import Status
from gpuvision.validation import finite

Disagreement = Literal["drop", "first", "second", "lower", "higher", "mean"]
DISAGREEMENTS = get_args(Disagreement)
"""Strategies of `MergeHeights` where the maps disagree."""
FIRST, SECOND, DISAGREES, UNCONFIRMED = 1, 2, 4, 8
"""Bits of `MergedHeights.source`."""

# Cells of a strip in the vector variant, and work-items of a work-group (speed only).
_LANES, _GROUP = 16, 256
_SHORTEST_STRIP, _LONGEST_STRIP, _STRIPS_PER_CORE = 1024, 16384, 8
# Distance of two grids from a common lattice [cells]. Derived: cells of 1e-4 m at 1 m, in double precision, are 1e-12.
_SAME_LATTICE = 1e-6


class MergedHeights(NamedTuple):
    """Merged height map, arrays of one shape.

    Attributes
    ----------
    z
        Height [m]; NaN where no height is taken.
    intensity
        Intensity of the light, weighted as the height; NaN where no height is taken.
    status
        uint8 `Status` flags. AMBIGUOUS: the maps disagree, and not just one of them is doubtful; or a map has that
        flag. A cell that neither map has carries the flags of both.
    sigma
        Standard deviation of the height [m]; None without `MergeHeights.sigma`.
    source
        uint8, a sum of `FIRST` (1) and `SECOND` (2), the maps that the height is from, and of `DISAGREES` (4): both
        maps have a height, and they disagree. Exactly `FIRST` or `SECOND`: no other map confirms the height, which may
        be that of a reflection; `UNCONFIRMED` (8): ``require_both`` dropped such a height.
    """

    z: FloatArray
    intensity: FloatArray
    status: StatusArray
    sigma: FloatArray | None
    source: StatusArray


@dataclass(frozen=True, kw_only=True)
class MergeHeights(VisionOperation[MergedHeights]):
    """Merge of two height maps over the same cells.

    Called as ``op(z1, intensity1, status1, z2, intensity2, status2)`` with float32 or float64 arrays of one shape
    (uint8 status), NumPy or device arrays; with ``sigma=True`` the standard deviations of both maps are the last
    arguments.
    `merge_height_maps` merges maps over different grids.

    A map has a height where it is finite and its status has no flag, or only SATURATED, AMBIGUOUS or NOT_INVERTIBLE
    (doubtful). Where one map has a height, it is taken, unless ``require_both`` drops it: nothing confirms it, and a
    reflection that one sensor alone sees keeps its wrong height. Where both have one and agree, the result is their
    mean. Where they disagree and one of them is doubtful, the other one is taken; otherwise the cell is AMBIGUOUS, and
    ``disagreement`` decides.

    Parameters
    ----------
    max_sigmas : float
        With ``sigma``: the maps agree if they differ by at most this many standard deviations of the difference, plus
        the tolerance; 0 or more, default 3.
    tolerance : float
        Allowed difference of agreeing heights [m], 0 or more, default 0. Without ``sigma`` it is the only limit.
    disagreement : {"drop", "first", "second", "lower", "higher", "mean"}
        Height where the maps disagree: none (default), that of one map, the lower or the higher one, or the mean.
    require_both : bool
        Whether a height that one map alone has is dropped, default False. Its status is then the flags of both maps.
    sigma : bool
        Whether standard deviations are given and computed, default False. The mean is then weighted by the inverse
        variances, otherwise both maps have the weight 1/2. A height without a finite standard deviation above 0 is
        missing.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the outputs; ``None`` follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    The errors of the two maps count as independent. A common error (of the frame in which both sensors are calibrated)
    is neither averaged out nor part of ``sigma``. Four roundings of the height.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.2.
    """

    Result: ClassVar[type[Any]] = MergedHeights
    tunable: ClassVar[Tunable | None] = Tunable(
        strips=(512, 1024, 2048, 4096, 8192, 16384), groups=(64, 128, 256), variants=True
    )

    max_sigmas: float = 3.0
    tolerance: float = 0.0
    disagreement: Disagreement = "drop"
    require_both: bool = False
    sigma: bool = False
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        for name in ("max_sigmas", "tolerance"):
            object.__setattr__(self, name, finite(getattr(self, name), f"MergeHeights.{name}"))
            if getattr(self, name) < 0.0:
                raise ValueError(f"MergeHeights.{name} is {getattr(self, name)}, expected 0 or more")
        if self.disagreement not in DISAGREEMENTS:
            raise ValueError(
                f"MergeHeights.disagreement is {self.disagreement!r}, expected one of {', '.join(DISAGREEMENTS)}"
            )

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="heights")
        cells = math.prod(shape)
        share = build.share(cells, per_core=_STRIPS_PER_CORE, multiple=_LANES)
        each = min(max(share, _SHORTEST_STRIP), _LONGEST_STRIP)
        work = build.work(cells, each=each, group=_GROUP, least=_LANES, grouping="fitted")
        heights, status = (shape, dtype), (shape, np.dtype(np.uint8))
        made = {
            "z": shape,
            "intensity": shape,
            "status": shape,
            "sigma": shape if self.sigma else None,
            "source": shape,
        }
        return build.launch(
            "merge_heights/merge_heights.cl",
            "merge_heights",
            work=work,
            more_inputs=[heights, status, heights, heights, status, *([heights] * (2 * self.sigma))],
            outputs=build.outputs(made, source=np.uint8),
            defines=type_defines("INPUT", dtype, 16) | flags(WITH_SIGMA=self.sigma),
            arguments=[
                np.uint64(cells),
                np.uint64(work.each),
                build.real.type(self.max_sigmas),
                build.real.type(self.tolerance),
                np.int32(DISAGREEMENTS.index(self.disagreement)),
                np.int32(self.require_both),
            ],
            passes_once=work.vectors,
            streams=True,
        )


def merge_height_maps(
    first: tuple[HeightMap, Grid],
    second: tuple[HeightMap, Grid],
    *,
    max_sigmas: float = 3.0,
    tolerance: float = 0.0,
    disagreement: Disagreement = "drop",
    require_both: bool = False,
    device: Device | None = None,
    max_cells: int = MAX_MAP_CELLS,
) -> tuple[MergedHeights, Grid]:
    """Merge two height maps whose cells lie on one lattice.

    Parameters
    ----------
    first, second : (HeightMap, Grid)
        Maps with their grids, in one frame; the cells have one size, and the grids differ by whole cells. If both maps
        have standard deviations, they are used.
    max_sigmas, tolerance : float
        As for `MergeHeights`. Defaults 3.0 and 0.0.
    disagreement : {"drop", "first", "second", "lower", "higher", "mean"}
        As for `MergeHeights`.
    require_both : bool
        As for `MergeHeights`. Default False.
    device : Device, optional
        Default `Device.best`.
    max_cells : int
        Largest number of cells of the merged map, default 2^26.

    Returns
    -------
    MergedHeights, Grid
        NumPy arrays over the smallest grid that covers both maps.

    Raises
    ------
    ValueError
        The cells have different sizes, the grids do not lie on one lattice, or both maps together span more than
        ``max_cells`` cells.
    """
    grid = _common_grid(first[1], second[1], max_cells)
    with_sigma = first[0].sigma is not None and second[0].sigma is not None
    operation = MergeHeights(
        max_sigmas=max_sigmas,
        tolerance=tolerance,
        disagreement=disagreement,
        require_both=require_both,
        sigma=with_sigma,
    )
    dtype = np.result_type(*(to_numpy(each.z).dtype for each, _ in (first, second)))
    frames, sigmas = [], []
    for heights, own in (first, second):
        for values, empty in ((heights.z, math.nan), (heights.intensity, math.nan), (heights.status, Status.NO_DATA)):
            kind = np.dtype(np.uint8) if values is heights.status else dtype
            frames.append(pad_to_grid(to_numpy(values), own, grid, empty, kind))
        if with_sigma and heights.sigma is not None:
            sigmas.append(pad_to_grid(to_numpy(heights.sigma), own, grid, math.nan, dtype))
    return operation(*frames, *sigmas, device=device), grid


def common_differences(
    first: tuple[HeightMap, Grid], second: tuple[HeightMap, Grid], merged: MergedHeights, grid: Grid
) -> npt.NDArray[np.float64]:
    """Return the differences of two merged height maps in the cells in which both have a height.

    Parameters
    ----------
    first, second : (HeightMap, Grid)
        Maps with their grids.
    merged, grid
        Result of `merge_height_maps` for them.

    Returns
    -------
    numpy.ndarray
        Second minus first height [m], (cells,).
    """
    source = to_numpy(merged.source)
    common = (source & (FIRST | SECOND) == FIRST | SECOND) | (source & DISAGREES != 0)
    one, two = (
        pad_to_grid(to_numpy(heights.z), own, grid, math.nan, np.dtype(np.float64))[common]
        for heights, own in (first, second)
    )
    return np.asarray(two - one)


def _common_grid(first: Grid, second: Grid, max_cells: int) -> Grid:
    """Return the grid that covers two grids."""
    for name in ("cell_x", "cell_y"):
        sizes = getattr(first, name), getattr(second, name)
        if not math.isclose(*sizes, rel_tol=_SAME_LATTICE / max(first.columns, first.rows)):
            raise ValueError(
                f"the cells of the height maps are {sizes[0]:g} and {sizes[1]:g} m wide; scan both with one cell size"
            )
    steps = np.array([(second.left - first.left) / first.cell_x, (first.top - second.top) / first.cell_y])
    whole = np.rint(steps)
    if np.max(np.abs(steps - whole)) > _SAME_LATTICE * max(1.0, np.max(np.abs(steps))):
        raise ValueError(
            f"the height maps are shifted by {steps[0]:g} and {steps[1]:g} cells, expected whole cells; resample both "
            "over one grid"
        )
    column, row = int(whole[0]), int(whole[1])
    left, top = min(column, 0), min(row, 0)
    columns = max(first.columns, column + second.columns) - left
    rows = max(first.rows, row + second.rows) - top
    if rows * columns > max_cells:
        raise ValueError(
            f"the two height maps together span {columns} x {rows} cells of {first.cell_x:g} m, expected at most "
            f"{max_cells} cells; are both scans in one frame?"
        )
    return Grid(
        left=first.left + left * first.cell_x,
        top=first.top - top * first.cell_y,
        cell_x=first.cell_x,
        cell_y=first.cell_y,
        columns=columns,
        rows=rows,
    )


def pad_to_grid(values: Any, own: Grid, grid: Grid, empty: float, dtype: np.dtype[Any]) -> Any:
    """Return an array over a larger grid on the same lattice, with ``empty`` in the other cells.

    Parameters
    ----------
    values : array_like
        (own.rows, own.columns).
    own, grid : Grid
        Grid of the values, and the larger one.
    empty : float
        Value of the other cells.
    dtype : numpy.dtype
        Type of the result, (grid.rows, grid.columns).
    """
    made = np.full(grid.shape, empty, dtype)
    row, column = round((grid.top - own.top) / grid.cell_y), round((own.left - grid.left) / grid.cell_x)
    made[row : row + own.rows, column : column + own.columns] = values
    return made
