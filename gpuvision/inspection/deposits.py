"""Deposits in a height map on the device: area, volume, mean height and offset of each aperture with sigmas.

`gpuvision.inspection.paste` prepares the inputs (cells, reference surfaces, noise) and adds the highest patches.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, FloatArray, Launch, LaunchBuilder, Precision, StatusArray, Variant, type_defines
from gpuvision.inspection.aperture_cells import Window
from gpuvision.inspection.reference_surface import ReferenceSurface
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.operation import VisionOperation
from gpuvision.ranging.height_map import Grid
from gpuvision.validation import finite, integer

TERMS = 6
SURFACE = TERMS + 7 + TERMS**2
"""Numbers of a surface: coefficients, u, u per column, v, v per row, centroid u, v, unit [m], covariance."""
_LANES, _GROUP = 16, 64
_MOST_CELLS = 2**31 - 1


class DepositSums(NamedTuple):
    """Measured deposits, arrays (n,) over the apertures; NaN where a deposit is not measured.

    Attributes
    ----------
    area, area_sigma
        Area of the cells above the threshold [m^2].
    volume, volume_sigma
        Volume above the reference surface [m^3].
    height_mean, height_mean_sigma
        Mean height of the cells above the threshold [m]; NaN without such a cell.
    offset, offset_sigma : (n, 2)
        Centroid of the volume minus centroid of the aperture [m], in the coordinates of the board.
    valid
        Fraction of the cells with a height; always known.
    status : uint8
        `Status` flags. NO_DATA: too few cells of the core or of the margin have a height. LOW_SIGNAL: the volume is not
        significant; the offset is NaN. An aperture without cells has the volume 0 and is LOW_SIGNAL; `owner_map`
        is given apertures with core cells only.
    """

    area: FloatArray
    area_sigma: FloatArray
    volume: FloatArray
    volume_sigma: FloatArray
    height_mean: FloatArray
    height_mean_sigma: FloatArray
    offset: FloatArray
    offset_sigma: FloatArray
    valid: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasureDeposits(VisionOperation[DepositSums]):
    """Area, volume, mean height and offset of deposits: ``op(z, sigma, owner, boxes, surfaces) -> DepositSums``.

    The heights z [m] (NaN in holes) and their standard deviations sigma [m] (above 0) are float32 or float64 of shape
    (rows, columns). ``owner`` is int32 (rows, columns), the result of `gpuvision.inspection.aperture_cells.owner_map`.
    ``boxes``, int32 (n, 4), and ``surfaces``, real (n, 49), are the results of
    `gpuvision.inspection.deposits.deposit_boxes` and `gpuvision.inspection.deposits.deposit_surfaces`.

    Parameters
    ----------
    apertures : int
        Number of apertures n, 1 or more.
    cell_area : float
        Area of a cell [m^2], above 0.
    threshold : float
        Height above the surface [m] from which on a cell counts to the area, above 0.
    correlation_area : float
        Number of cells whose noise is common, 1 or more, default 1: variances of sums are larger by this factor.
    least_valid : float
        Least fraction of the cells of the core, and of the margin, with a height, above 0 to 1, default 0.8.
    significance : float
        Volume from which on a deposit has an offset [standard deviations], 0 or more, default 3.
    to_board : array_like, (2, 2)
        Matrix that takes offsets in the height map to the coordinates of the board. Default: the same coordinates.
    precision : {"single", "double", None}
        Precision of the arithmetic and of the results; ``None`` follows the input.
    variant : {"auto", "vector", "work_item"}
        Kernel variant: "vector" computes 16 cells at once (CPU runtimes). Both use one work-item per aperture.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Formulas and error model: `gpuvision.inspection.paste.measure_deposits`. Single precision: heights are
    rounded to 6e-8 of their distance from 0 (0.1 nm at 2 mm), sums to about 1e-6. A cell whose height is within the
    rounding of the threshold may count or not.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 1.2.2.
    """

    Result: ClassVar[type[Any]] = DepositSums

    apertures: int
    cell_area: float
    threshold: float
    correlation_area: float = 1.0
    least_valid: float = 0.8
    significance: float = 3.0
    to_board: npt.ArrayLike = ((1.0, 0.0), (0.0, 1.0))
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        integer(self.apertures, "MeasureDeposits.apertures", minimum=1)
        for name in ("cell_area", "threshold"):
            finite(getattr(self, name), f"MeasureDeposits.{name}", above=0.0)
        finite(self.correlation_area, "MeasureDeposits.correlation_area", minimum=1.0)
        finite(self.least_valid, "MeasureDeposits.least_valid", above=0.0, maximum=1.0)
        finite(self.significance, "MeasureDeposits.significance", minimum=0.0)
        matrix = np.asarray(self.to_board, np.float64)
        if matrix.shape != (2, 2) or not np.all(np.isfinite(matrix)):
            raise ValueError("MeasureDeposits.to_board must be a finite matrix (2, 2)")
        object.__setattr__(self, "to_board", matrix)

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, variant=self.variant)
        build.check_dtype("float32", "float64", of="heights")
        is_valid = len(shape) == 2 and _LANES <= math.prod(shape) <= _MOST_CELLS
        build.check_shape(is_valid, f"heights (rows, columns) of {_LANES} cells or more")
        each, pair = (self.apertures,), (self.apertures, 2)
        shapes = dict.fromkeys(DepositSums._fields, each) | {"offset": pair, "offset_sigma": pair}
        integers = np.dtype(np.int32)
        scales = (self.cell_area, self.threshold, self.correlation_area, self.least_valid, self.significance)
        return build.launch(
            "deposits/deposits.cl",
            "deposits",
            work=build.work(self.apertures, each=1, group=_GROUP),
            more_inputs=[
                (shape, dtype),
                (shape, integers),
                ((self.apertures, 4), integers),
                ((self.apertures, SURFACE), build.real),
            ],
            outputs=build.outputs(shapes),
            defines=type_defines("INPUT", dtype, 16),
            arguments=[
                np.int32(self.apertures),
                np.int32(shape[1]),
                np.int64(math.prod(shape)),
                *map(build.real.type, (*scales, *np.ravel(self.to_board))),
            ],
        )


def deposit_boxes(windows: Sequence[Window]) -> npt.NDArray[np.int32]:
    """Return the bounding boxes of windows in cells, int32 (n, 4), as `gpuvision.MeasureDeposits` takes them.

    Columns: first row, row after the last, first column, column after the last.
    """
    boxes = [(each.rows.start, each.rows.stop, each.columns.start, each.columns.stop) for each in windows]
    return np.array(boxes, np.int32).reshape(-1, 4)


def deposit_surfaces(
    surfaces: Sequence[ReferenceSurface],
    windows: Sequence[Window],
    grid: Grid,
    centroids: Float64,
    pad_height: float = 0.0,
) -> Float64:
    """Return the reference surfaces as `gpuvision.MeasureDeposits` takes them.

    Parameters
    ----------
    surfaces : sequence of ReferenceSurface
        Surface of each aperture.
    windows : sequence of Window
        Cells of each aperture.
    grid : Grid
        Grid of the heights.
    centroids : numpy.ndarray
        Centroids of the apertures (n, 2) in the height map [m].
    pad_height : float
        Height [m] of the bare pad above the surfaces, default 0.

    Returns
    -------
    numpy.ndarray
        float64 (n, 49).
    """
    table = np.zeros((len(surfaces), SURFACE))
    for row, surface, window, centroid in zip(table, surfaces, windows, centroids, strict=True):
        terms = len(surface.coefficients)
        row[:terms] = surface.coefficients
        row[0] += pad_height
        first = np.array([grid.x[window.columns.start], grid.y[window.rows.start]])
        u, v = (first - surface.centre) / surface.length
        row[TERMS : TERMS + 4] = u, grid.cell_x / surface.length, v, -grid.cell_y / surface.length
        row[TERMS + 4 : TERMS + 6] = (centroid - surface.centre) / surface.length
        row[TERMS + 6] = surface.length
        row[TERMS + 7 :].reshape(TERMS, TERMS)[:terms, :terms] = surface.covariance
    return table
