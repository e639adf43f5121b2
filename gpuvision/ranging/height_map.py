"""Height map over regular cells in x and y: its grid and its arrays.

`gpuvision.ranging.regrid` makes height maps, `gpuvision.ranging.merge_heights` merges them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import FloatArray, StatusArray
from gpuvision.validation import finite, integer

MAX_MAP_CELLS = 1 << 26
"""Largest number of cells of a height map. Chosen: bounds the memory, 256 MiB of float32 heights."""


class HeightMap(NamedTuple):
    """Height map over the cells of a grid: arrays of shape (rows, columns).

    Attributes
    ----------
    z
        Height [m]; NaN in holes.
    intensity
        Intensity of the light, in the unit of the input; NaN in holes.
    status
        uint8 `Status` flags. NO_DATA: no measurement near enough. NOT_INVERTIBLE: the sampling runs backwards here, two
        surfaces share the cell. A cell with SATURATED or AMBIGUOUS keeps its value.
    sigma
        Random standard deviation of the height [m] (`Regrid.sigma`), NaN in holes; None if it was not requested.
    """

    z: FloatArray
    intensity: FloatArray
    status: StatusArray
    sigma: FloatArray | None = None


@dataclass(frozen=True, kw_only=True)
class Grid:
    """Regular cells of a height map, as in an image: x grows with the column, y falls with the row.

    Parameters
    ----------
    left, top : float
        Centre of the cell [0, 0] [m]: smallest x, largest y.
    cell_x, cell_y : float
        Distance between cells in x and in y [m], positive.
    columns, rows : int
        Number of columns and rows, positive.

    Raises
    ------
    ValueError
        A number is not finite or not positive.
    """

    left: float
    top: float
    cell_x: float
    cell_y: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        for name in ("left", "top", "cell_x", "cell_y"):
            object.__setattr__(self, name, finite(getattr(self, name), f"Grid.{name}"))
        for name in ("columns", "rows"):
            object.__setattr__(self, name, integer(getattr(self, name), f"Grid.{name}"))
        for name in ("cell_x", "cell_y", "columns", "rows"):
            if getattr(self, name) <= 0:
                raise ValueError(f"Grid.{name} is {getattr(self, name)}, expected a number above 0")

    @classmethod
    def covering(cls, x: npt.ArrayLike, y: npt.ArrayLike, cell: float) -> Grid:
        """Return the grid of square cells of size `cell` [m] that covers all finite points (x, y) [m].

        Raises
        ------
        ValueError
            No point is finite, or the cell size is not positive.
        """
        if finite(cell, "the cell of a grid") <= 0.0:
            raise ValueError(f"the cell of a grid is {cell}, expected metres above 0")
        x, y = np.asarray(x), np.asarray(y)
        good = np.isfinite(x) & np.isfinite(y)
        if not good.any():
            raise ValueError("no finite point to lay a grid over; expected at least one valid sample")
        low, high = [np.array([f(x[good]), f(y[good])], dtype=np.float64) for f in (np.min, np.max)]
        first, last = np.floor(low / cell), np.ceil(high / cell)
        columns, rows = (last - first).astype(int) + 1
        return cls(
            left=float(first[0]) * cell,
            top=float(last[1]) * cell,
            cell_x=cell,
            cell_y=cell,
            columns=int(columns),
            rows=int(rows),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (rows, columns) of a height map over this grid."""
        return self.rows, self.columns

    @property
    def x(self) -> npt.NDArray[np.float64]:
        """Centres of the columns, ascending [m]."""
        return self.left + self.cell_x * np.arange(self.columns, dtype=np.float64)

    @property
    def y(self) -> npt.NDArray[np.float64]:
        """Centres of the rows, descending [m]."""
        return self.top - self.cell_y * np.arange(self.rows, dtype=np.float64)
