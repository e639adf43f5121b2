"""Regular resampling in float64, cell by cell: which pairs of neighbours lie over it, and which folds."""

from __future__ import annotations

import itertools

import numpy as np

from gpuvision import Status
from gpuvision.ranging.regrid import HeightMap, Regrid

_INFORMS = Status.SATURATED | Status.AMBIGUOUS | Status.NOT_INVERTIBLE


def resample_line(
    at: np.ndarray, values: np.ndarray, given: np.ndarray, centres: np.ndarray, sense: float, regrid: Regrid
) -> tuple[np.ndarray, np.ndarray]:
    """One line of points at `at` with `values` (k, n), height first, at the centres: values (k, cells) and status."""
    made = np.full((len(values), len(centres)), np.nan)
    status = np.full(len(centres), Status.NO_DATA, np.uint8)
    good = np.isfinite(at) & np.isfinite(values[0]) & ((given & ~np.uint8(_INFORMS)) == 0)
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
        # On the very place of a sample two pairs lie over a cell: what either knows of a fold is kept.
        status[over] = ((given[first] | given[second]) & np.uint8(_INFORMS)) | (
            status[over] & np.uint8(Status.NOT_INVERTIBLE)
        )
    for n in range(1, len(kept)):
        behind = furthest[n] - reached[n]
        if behind >= regrid.fold_tolerance and reached[n] <= furthest[n - 1]:
            status[(sense * centres >= reached[n]) & (sense * centres <= furthest[n])] |= np.uint8(
                Status.NOT_INVERTIBLE
            )
    return made, status


def regrid(
    op: Regrid, x: np.ndarray, y: np.ndarray, z: np.ndarray, intensity: np.ndarray, given: np.ndarray
) -> HeightMap:
    """The height map of an organised range image."""
    x, y, z, intensity = (each.astype(np.float64) for each in (x, y, z, intensity))
    places, centres = {"x": x, "y": y}, {"x": op.grid.x, "y": op.grid.y}
    (along, to), (across, over) = ((each[-1], -1.0 if each[0] == "-" else 1.0) for each in op.directions)
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
        folds = (status & np.uint8(Status.NOT_INVERTIBLE)) != 0
        made[:, folds], status[folds] = np.nan, Status.NOT_INVERTIBLE
    return HeightMap(made[0], made[1], status)
