"""Reference of the resampling to a height map: linear interpolation between neighbours, cell by cell; and folds."""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SATURATED, AMBIGUOUS, NO_DATA, NOT_INVERTIBLE = 2, 16, 64, 128
_VALUE_KEPT = SATURATED | AMBIGUOUS | NOT_INVERTIBLE  # flags under which a sample keeps its value

Float64 = NDArray[np.float64]
UInt8 = NDArray[np.uint8]


class ReferenceHeightMap(NamedTuple):
    """Height map: arrays of shape (rows, columns).

    Attributes
    ----------
    z
        Height [m], NaN in holes.
    intensity
        Intensity of the light in the unit of the input, NaN in holes.
    status
        Flags of `gpuvision.Status`.
    """

    z: Float64
    intensity: Float64
    status: UInt8


def resample_line(
    at: Float64, values: Float64, given: UInt8, centres: Float64, sense: float, regrid: Any
) -> tuple[Float64, UInt8]:
    """Resample one line of points.

    Parameters
    ----------
    at, values, given
        Place [m], values (k, n) with the height first, and status of n points.
    centres
        Places of the cells [m].
    sense
        1 if places ascend along the line, -1 if they descend.
    regrid : gpuvision.Regrid
        Parameters of the resampling.

    Returns
    -------
    values : numpy.ndarray
        (k, cells), NaN in holes.
    status : numpy.ndarray
        (cells,).
    """
    made = np.full((len(values), len(centres)), np.nan)
    status = np.full(len(centres), NO_DATA, np.uint8)
    good = np.isfinite(at) & np.isfinite(values[0]) & ((given & ~np.uint8(_VALUE_KEPT)) == 0)
    kept = np.flatnonzero(good)
    reached = sense * at[kept]
    furthest = np.maximum.accumulate(reached)
    for first, second in itertools.pairwise(kept):
        low, high = min(at[first], at[second]), max(at[first], at[second])
        over = (centres >= low) & (centres <= high)
        length, rise = at[second] - at[first], values[0, second] - values[0, first]
        if abs(length) > regrid.max_gap or abs(rise) > regrid.max_step:
            continue
        part = (centres - at[first]) / length if length else np.zeros(len(centres))
        new = values[:, [first]] + part * (values[:, [second]] - values[:, [first]])
        over &= ~(made[0] > new[0] + regrid.max_step)
        made[:, over] = new[:, over]
        # Two pairs of neighbours cover a cell at the place of a sample: the fold flag of either pair is kept.
        status[over] = ((given[first] | given[second]) & np.uint8(_VALUE_KEPT)) | (
            status[over] & np.uint8(NOT_INVERTIBLE)
        )
    for n in range(1, len(kept)):
        setback = furthest[n] - reached[n]
        if setback >= regrid.fold_tolerance and reached[n] <= furthest[n - 1]:
            status[(sense * centres >= reached[n]) & (sense * centres <= furthest[n])] |= np.uint8(NOT_INVERTIBLE)
    return made, status


def regrid(
    op: Any, x: NDArray[Any], y: NDArray[Any], z: NDArray[Any], intensity: NDArray[Any], given: UInt8
) -> ReferenceHeightMap:
    """Resample an organised range image to a height map.

    Parameters
    ----------
    op : gpuvision.Regrid
        Grid and parameters.
    x, y, z
        Coordinates [m], (profiles, samples).
    intensity, given
        Intensity and status of each sample, (profiles, samples).
    """
    x, y, z, intensity = (each.astype(np.float64) for each in (x, y, z, intensity))
    grid = op.grid
    places = {"x": x, "y": y}
    centres = {
        "x": grid.left + grid.cell_x * np.arange(grid.columns),
        "y": grid.top - grid.cell_y * np.arange(grid.rows),
    }
    (along, to), (across, over) = ((each[-1], -1.0 if each[0] == "-" else 1.0) for each in _directions(op))
    lines = [
        resample_line(places[along][n], np.stack(values), given[n], centres[along], to, op)
        for n, values in enumerate(zip(z, intensity, places[across], strict=True))
    ]
    values, flags = np.array([each[0] for each in lines]), np.array([each[1] for each in lines])
    made = np.empty((2, len(centres[along]), len(centres[across])))
    status = np.empty(made.shape[1:], np.uint8)
    for cell in range(len(centres[along])):
        made[:, cell], status[cell] = resample_line(
            values[:, 2, cell], values[:, :2, cell].T, flags[:, cell], centres[across], over, op
        )
    if along == "x":
        made, status = made.transpose(0, 2, 1), status.T
    if op.folded == "drop":
        folds = (status & np.uint8(NOT_INVERTIBLE)) != 0
        made[:, folds], status[folds] = np.nan, NOT_INVERTIBLE
    return ReferenceHeightMap(made[0], made[1], status)


def _directions(op: Any) -> tuple[str, str]:
    """Return the scene directions of the samples and of the profiles: the profiles advance along the other axis."""
    return op.along, op.across or ("y" if op.along[-1] == "x" else "x")
