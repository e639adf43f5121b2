"""Dot grids: thousands of dots, found sub-pixel and told apart, whatever the lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.camera.blobs import alike, find_blobs, find_scale
from gpuvision.camera.centroids import Centroids, cross, disc_shift, measure_dots
from gpuvision.camera.grid_polynomial import GridPolynomial
from gpuvision.camera.lattice import as_grid, charts, joined
from gpuvision.camera.pattern import Float64, PatternGrid, grey_image, localisation_noise, nan_median, off_neighbours

Bool = npt.NDArray[np.bool_]

_FEWEST = 9
# A part that holds less of the largest part's dots and cannot be joined to it is left out.
_WORTH_JOINING = 0.1
# Windows hold two steps each way of a regular grid: dots and ground are in all of them.
_WINDOW_PITCHES = 2.0
# Half the side of the smoothing before dots are told from the ground.
_SMOOTHED = 0.04
# Limits of what a dot may differ from its neighbours. In place and shape: as many times what is usual in this image,
# but a small part of the pitch (of the size) always; in contrast; and its ground from a plane, in units of contrast.
_OFF_USUAL = 7.0
_OFF_PITCH = 0.003
_OFF_SHAPE = 0.06
_LEAST_CONTRAST = 0.25
_UNEVEN = 0.5


def find_dots(image: npt.NDArray[np.generic]) -> PatternGrid:
    """Find the dots of a regular grid, dark on light or light on dark.

    Dots are told from the ground by a threshold that follows the illumination, indexed by walking from neighbour to
    neighbour, and measured by the centre of gravity of their grey levels; a step of the grid may vary as lenses and
    perspective make it. Missing and hidden dots are NaN, as are those that lie off their neighbours' grid, are cut
    by something, or touch the border. The centre of gravity of a disc that is seen askew is not its centre: the
    difference follows from the grid's own curvature, and is taken off.

    Parameters
    ----------
    image
        (height, width) or (height, width, 3; blue, green, red) of uint8, uint16 or float32, 9 dots or more, of at
        least 4 pixels across and 2 pixels apart, the grid turned by at most 45 degrees.

    Returns
    -------
    PatternGrid
        Noise and bias are about 0.01 px where dots are 10 px across and the noise is 1 % of their contrast.

    Raises
    ------
    ValueError
        If there is no grid, or it falls into parts; says how many dots were found.
    TypeError
        If the image is of another type.
    """
    grey = grey_image(image)
    scale = find_scale(grey)
    if scale.count == 0:
        raise ValueError(f"no grid of dots found; {_ADVICE}")
    smoothing = 2 * round(_SMOOTHED * scale.pitch) + 1
    blobs = find_blobs(grey, _WINDOW_PITCHES * scale.pitch, scale.bright, smoothing)
    kept = alike(blobs.area)
    grid = _indexed(blobs.points[kept])
    place, size = (np.where(grid[..., None] < 0, np.nan, each[kept][grid]) for each in (blobs.points, blobs.size))
    found = measure_dots(grey, place, size)
    bent = GridPolynomial(found.points)
    points = found.points - disc_shift(bent, found.mass)
    points[~_sound(found, bent)] = np.nan
    points = _trimmed(points)
    if np.count_nonzero(np.isfinite(points[..., 0])) < _FEWEST:
        raise ValueError(
            f"only {np.count_nonzero(np.isfinite(points[..., 0]))} of {grid.size} dots are sound; {_ADVICE}"
        )
    return PatternGrid(points, localisation_noise(points))


_ADVICE = "expected at least 9 dots of one size on an even ground: check focus, exposure and what is in the picture"


def _indexed(points: Float64) -> npt.NDArray[np.int64]:
    """Lay dots out in rows and columns: numbers of points, -1 where there is none."""
    if len(points) < _FEWEST:
        raise ValueError(f"only {len(points)} dots found; {_ADVICE}")
    pieces = charts(points, _FEWEST)
    if not pieces:
        raise ValueError(f"{len(points)} blobs found, but they lie on no grid; {_ADVICE}")
    whole, apart = joined(pieces, points)
    large = [each for each in apart if len(each.members) > _WORTH_JOINING * len(whole.members)]
    if large:
        counts = " and ".join(str(len(each.members)) for each in (whole, *large))
        raise ValueError(
            f"the grid broke into {len(large) + 1} parts of {counts} dots with too wide a gap between them; "
            "uncover what lies between them, or crop the image to one part"
        )
    return as_grid(whole, points)


def _sound(found: Centroids, bent: GridPolynomial) -> Bool:
    """Which dots lie, look and stand out as their neighbours do."""
    u, v = bent.derivative(1, 0), bent.derivative(0, 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.linalg.norm(off_neighbours(found.points - bent.derivative(0, 0)), axis=-1)
        least = _OFF_PITCH * float(np.sqrt(np.median(np.abs(cross(u, v)))))
        sound = ~(off > max(least, _OFF_USUAL * float(np.nanmedian(off))))
        # A disc's area, width and height, but for how the grid is bent: about the same everywhere.
        disc = np.stack([found.mass / np.abs(cross(u, v)), *np.moveaxis(found.spread / (u**2 + v**2), -1, 0)])
        for each in disc:
            change = np.abs(np.log(each / _around(each)))
            sound &= change < max(_OFF_SHAPE, _OFF_USUAL * float(np.nanmedian(change)))
        return sound & (found.contrast / _around(found.contrast) > _LEAST_CONTRAST) & (found.unevenness < _UNEVEN)


def _around(values: Float64) -> Float64:
    """Median of a node and of the 24 around it."""
    padded = np.pad(values, 2, constant_values=np.nan)
    rows, columns = values.shape
    return nan_median(np.stack([padded[i : i + rows, j : j + columns] for i in range(5) for j in range(5)]))


def _trimmed(points: Float64) -> Float64:
    """Cut rows and columns at the border that hold nothing."""
    known = np.isfinite(points[..., 0])
    rows, columns = (np.flatnonzero(known.any(axis=axis)) for axis in (1, 0))
    if rows.size == 0:
        return points[:0, :0]
    return points[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
