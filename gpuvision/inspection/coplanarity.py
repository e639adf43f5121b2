"""Coplanarity of the leads or balls of a component in a height map.

A component rests on the three leads of its seating plane; the gap of every other lead must be closed by solder (F. de
Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 1.2.3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog

from gpuvision.inspection.aperture_cells import cells_of
from gpuvision.inspection.apertures import Aperture
from gpuvision.inspection.coverage import covered
from gpuvision.inspection.height_noise import complete_sigmas
from gpuvision.inspection.phase_sigmas import common_sigma, complete_phase
from gpuvision.inspection.top_height import top_height
from gpuvision.matching.artwork.shapes import Float64
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.ranging.height_map import Grid
from gpuvision.validation import finite

_TOP_PATCH = 0.15  # half width of the patch of a top, in square roots of the area of the region. Chosen
_TOUCHING = 1e-6  # distance from the seating plane, in ranges of the heights, of leads that touch it
_FLAT = 1e-9  # smallest share of the area of the leads that three seats span


class SeatingPlane(NamedTuple):
    """Plane on which a component rests, leads up.

    Attributes
    ----------
    coefficients : (3,)
        a, b, c of z = a + b x + c y [m].
    seats : (3,)
        Indices of the leads that the component rests on.
    """

    coefficients: Float64
    seats: npt.NDArray[np.int64]


class Coplanarity(NamedTuple):
    """Tops of leads and their distances from two planes: arrays (n,), NaN where a top is not measured.

    Attributes
    ----------
    names
        Names of the leads.
    place : (n, 2)
        Centroids of the regions in the height map [m].
    top, top_sigma
        Height of each top [m].
    gap, gap_sigma
        Distance of each top below the seating plane [m]: 0 for the three seats.
    deviation, deviation_sigma
        Height of each top above the least-squares plane [m].
    seats
        Names of the three leads of the seating plane.
    coplanarity, coplanarity_sigma
        Largest gap [m]: the coplanarity of JEDEC JESD22-B108.
    lowest
        Name of the lead with the largest gap.
    noise
        Standard deviation of the heights [m] that the sigmas use, with the phase; NaN if unknown.
    """

    names: tuple[str, ...]
    place: Float64
    top: Float64
    top_sigma: Float64
    gap: Float64
    gap_sigma: Float64
    deviation: Float64
    deviation_sigma: Float64
    seats: tuple[str, ...]
    coplanarity: float
    coplanarity_sigma: float
    lowest: str
    noise: float


def seating_plane(x: Float64, y: Float64, z: Float64, centre: tuple[float, float]) -> SeatingPlane:
    """Return the plane on which a component with upward leads rests when it is turned over.

    Parameters
    ----------
    x, y, z : numpy.ndarray
        Tops of the leads (n,) [m], three or more.
    centre : tuple of float
        Position of the centre of gravity [m].

    Returns
    -------
    SeatingPlane

    Raises
    ------
    ValueError
        The centre of gravity is not between the leads, or the leads are on one line.

    Notes
    -----
    The plane touches the convex hull of the tops from above, in the triangle that contains the centre of gravity. It is
    the plane above all tops that is lowest at the centre of gravity: a linear program with three unknowns.
    """
    origin = np.array([np.mean(x), np.mean(y)])
    length = float(np.max(np.hypot(x - origin[0], y - origin[1]))) or 1.0
    low, height = float(np.min(z)), float(np.ptp(z)) or 1.0
    u, v, w = (x - origin[0]) / length, (y - origin[1]) / length, (z - low) / height
    aim = np.array([1.0, (centre[0] - origin[0]) / length, (centre[1] - origin[1]) / length])
    design = np.stack([np.ones_like(u), u, v], axis=1)
    if len(x) < 3 or np.linalg.matrix_rank(design, tol=1e-6) < 3:
        raise ValueError("the leads are on one line; expected three or more around the centre of gravity")
    solved = linprog(aim, A_ub=-design, b_ub=-w, bounds=[(None, None)] * 3, method="highs")
    if solved.status != 0:
        raise ValueError(
            f"the centre of gravity ({centre[0]:g}, {centre[1]:g}) m is not between the leads; expected a place where "
            "the component rests stably"
        )
    plane = solved.x
    slack = design @ plane - w
    touching = np.flatnonzero(slack <= _TOUCHING + float(np.min(slack)))
    # Leads that carry weight come first (their multipliers are the shares of the weight).
    share = -np.asarray(solved.ineqlin.marginals)
    order = touching[np.argsort(-share[touching], kind="stable")]
    seats = _independent(design, order)
    coefficients = np.array([plane[0] * height + low, plane[1] * height / length, plane[2] * height / length])
    coefficients[0] -= coefficients[1:] @ origin
    return SeatingPlane(coefficients, seats)


def _independent(design: Float64, order: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Return the first three leads of an order that are not on one line."""
    chosen: list[int] = []
    for each in order:
        trial = design[[*chosen, int(each)]]
        if np.linalg.matrix_rank(trial, tol=math.sqrt(_FLAT)) == len(trial):
            chosen.append(int(each))
        if len(chosen) == 3:
            break
    return np.array(chosen, np.int64)


def measure_coplanarity(
    z: npt.NDArray[np.floating],
    grid: Grid,
    regions: Sequence[Aperture],
    *,
    sigma: float | npt.NDArray[np.floating] | None = None,
    phase: npt.NDArray[np.floating] | None = None,
    correlation_area: float = 1.0,
    centre: tuple[float, float] | None = None,
) -> Coplanarity:
    """Measure the tops of leads or balls, and their distances from the seating plane and the least-squares plane.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns), leads up; NaN in holes.
    grid : Grid
        Grid of the heights.
    regions : sequence of Aperture
        Region of each lead in the height map, three or more.
    sigma : float or numpy.ndarray, optional
        Random standard deviation of the heights [m]: one for all, or one per cell. Default: from the third differences
        of neighbours in the regions, which is too small if neighbours share noise. It is NaN (unknown) if no region
        has four neighbours in a row or column.
    phase : numpy.ndarray, optional
        Standard deviation of an error that neighbouring cells share [m], one per cell, NaN where it is unknown: of the
        phase of a laser line in its pixel. All cells of a lead share it, two leads do not. Default: none.
    correlation_area : float
        Number of cells whose noise is common, 1 or more. Default 1.
    centre : tuple of float, optional
        Centre of gravity in the height map [m]. Default: mean of the centroids of the regions.

    Returns
    -------
    Coplanarity

    Raises
    ------
    ValueError
        Fewer than three tops are measured, the centre of gravity is not between them, or a standard deviation is
        negative.

    Notes
    -----
    The sigma of a gap takes the three seats as given. Where other leads are within the noise of the seating plane, they
    compete for it: the gaps are then biased by up to about one sigma of a top.
    """
    heights = np.asarray(z, np.float64)
    if heights.shape != grid.shape:
        raise ValueError(f"heights have shape {heights.shape}, the grid has {grid.shape}; expected the same")
    correlated = finite(correlation_area, "correlation_area", minimum=1.0)
    parts = [_region(heights, grid, each) for each in regions]
    noise = _noise(parts) if sigma is None else sigma
    sigmas = complete_sigmas(np.asarray(noise, np.float64), grid.shape)
    tops = _tops(regions, parts, sigmas, grid, correlated)
    phases = complete_phase(None if phase is None else np.asarray(phase, np.float64), grid.shape)
    if phases is not None:
        common = [common_sigma(phases[rows, columns], inside) for _, inside, rows, columns in parts]
        tops[:, 1] = np.hypot(tops[:, 1], common)
        sigmas = np.hypot(sigmas, phases)
    return _compare_tops(regions, tops, centre, float(np.median(sigmas)))


def _compare_tops(
    regions: Sequence[Aperture], tops: Float64, centre: tuple[float, float] | None, noise: float
) -> Coplanarity:
    """Compare tops and their sigmas (n, 2) with the seating plane and with the least-squares plane."""
    place = np.array([each.centroid for each in regions])
    known = np.flatnonzero(np.isfinite(tops[:, 0]))
    if len(known) < 3:
        raise ValueError(f"{len(known)} of {len(regions)} leads have a measured top; expected three or more")
    x, y = place[known].T
    top, top_sigma = tops[known].T
    gravity = (float(place[:, 0].mean()), float(place[:, 1].mean())) if centre is None else centre
    plane = seating_plane(x, y, top, gravity)
    design = np.stack([np.ones_like(x), x - place[:, 0].mean(), y - place[:, 1].mean()], axis=1)
    result = np.full((4, len(regions)), math.nan)
    result[:, known] = _gaps_and_deviations(design, plane.seats, top, top_sigma)
    worst = int(np.nanargmax(result[0]))
    return Coplanarity(
        names=tuple(each.name for each in regions),
        place=place,
        top=tops[:, 0],
        top_sigma=tops[:, 1],
        gap=result[0],
        gap_sigma=result[1],
        deviation=result[2],
        deviation_sigma=result[3],
        seats=tuple(regions[known[each]].name for each in plane.seats),
        coplanarity=float(result[0, worst]),
        coplanarity_sigma=float(result[1, worst]),
        lowest=regions[worst].name,
        noise=noise,
    )


def _tops(
    regions: Sequence[Aperture],
    parts: Sequence[tuple[Float64, npt.NDArray[np.bool_], slice, slice]],
    sigmas: Float64,
    grid: Grid,
    correlated: float,
) -> Float64:
    """Return the height of the top of each lead and its standard deviation, (n, 2); NaN where it is not measured."""
    tops = np.full((len(regions), 2), math.nan)
    for index, (each, (part, inside, rows, columns)) in enumerate(zip(regions, parts, strict=True)):
        if inside.any():
            half = max(round(_TOP_PATCH * math.sqrt(each.area / (grid.cell_x * grid.cell_y))), 1)
            found = top_height(part, inside, sigmas[rows, columns], half)
            tops[index] = found.height, found.sigma * math.sqrt(correlated)
    return tops


def _gaps_and_deviations(design: Float64, seats: npt.NDArray[np.int64], top: Float64, top_sigma: Float64) -> Float64:
    """Return the gaps to the seating plane, their sigmas, the deviations from the least-squares plane, their sigmas."""
    # Each row holds the weights of the tops in one gap: the height of the plane at the lead, less the lead's top.
    through_seats = np.zeros((len(top), len(top)))
    through_seats[:, seats] = design @ np.linalg.inv(design[seats])
    rows: list[Float64] = []
    for weights in (through_seats - np.eye(len(top)), np.eye(len(top)) - design @ np.linalg.pinv(design)):
        rows += [weights @ (top - top.mean()), np.sqrt((weights**2) @ top_sigma**2)]
    return np.stack(rows)


def _region(z: Float64, grid: Grid, region: Aperture) -> tuple[Float64, npt.NDArray[np.bool_], slice, slice]:
    """Return the heights around a region, its cells, and the rows and columns of the part."""
    rows, columns = cells_of(region.bounds, grid, 2 * max(grid.cell_x, grid.cell_y))
    part = z[rows, columns]
    inside = covered(region.shapes, grid.x[columns], grid.y[rows]) if part.size else np.zeros(part.shape, np.bool_)
    return part, inside, rows, columns


def _noise(parts: Sequence[tuple[Float64, npt.NDArray[np.bool_], slice, slice]]) -> float:
    """Return the standard deviation of independent noise, from third differences in the regions; NaN without any."""
    found = []
    for part, inside, _, _ in parts:
        # Along rows and along columns: narrow leads have four neighbours in one direction only.
        for height, allowed in ((part, inside), (part.T, inside.T)):
            if height.shape[1] >= 4:
                third = height[:, 3:] - height[:, :-3] - 3 * (height[:, 2:-1] - height[:, 1:-2])
                found.append(third[allowed[:, 3:] & allowed[:, :-3] & np.isfinite(third)])
    values = np.concatenate(found) if found else np.empty(0)
    if not values.size:
        return math.nan
    # The variance of a third difference is (1 + 9 + 9 + 1) times the variance of a height; the median ignores edges.
    return MAD_TO_SIGMA * float(np.median(np.abs(values - np.median(values)))) / math.sqrt(20)
