"""Covariance of a registration whose edges err together, and the test for a transform with too few parameters.

Defects of a board, and a deformation that the transform does not have, move neighbouring edges alike. The covariance is
therefore the delete-one-block jackknife over blocks of the image, the mean over overlapping grids of blocks. It is not
below the covariance for independent edges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from gpuvision.camera.smooth_field import not_below
from gpuvision.jackknife import overlapping_jackknife
from gpuvision.matching.pose.pose import TRANSFORM_PARAMETERS, Transform

Float64 = npt.NDArray[np.float64]

# Blocks along each side of the edges' bounding box, for the test of the transform. Chosen: 36 blocks give variances of
# 35 degrees of freedom, and blocks of 100 px in an image of 640 px, wider than the defects of a board.
_BLOCKS = 6
# Blocks along each side for the covariance, and number of shifts of their grid. Edges along one trace err together over
# more than 100 px in binary images, which draw a nearly vertical edge in steps of whole pixels: 4 blocks are wider. The
# mean over shifted grids makes up for the smaller number of blocks: its variance is 0.70 along each side of that of
# one grid (derived). Measured with 2505 pairs: 12 are off by more than 3 standard deviations; with 6 x 6 separate
# blocks 19 are.
_WIDE_BLOCKS, _SHIFTS = 4, 3
# Probability of a misfit of a transform that is right (chosen).
_SIGNIFICANCE = 1e-3


class FittedEdges(NamedTuple):
    """Edges of a registration's last fit, (n, ...); lengths in the unit of the known edges.

    Attributes
    ----------
    known : (n, 2)
        Points relative to the placement point, where they are known.
    place, normal : (n, 2)
        The same points and their unit normals under the motion.
    residual : (n,)
        Measured less fitted position along the normal; NaN for missing edges.
    weight : (n,)
        Weight in the fit, 0 to 1.
    rotation : (2, 2)
        Rotation of the motion.
    etch_bias_sigma : float
        Standard deviation of the etch bias; 0 where it is not solved for.
    sigma : float
        Standard deviation of an edge that the fit assumed: it weighs the etch bias against the edges.
    """

    known: Float64
    place: Float64
    normal: Float64
    residual: Float64
    weight: Float64
    rotation: Float64
    etch_bias_sigma: float
    sigma: float


class RegistrationErrors(NamedTuple):
    """Errors of a registration.

    Attributes
    ----------
    covariance : (f, f)
        Covariance of the placement point's x, y, of theta, and of the free deformation parameters.
    misfit : float
        Largest displacement of an edge by the next larger transform, where the edges fit it significantly better;
        else 0.
    """

    covariance: Float64
    misfit: float


def registration_errors(edges: FittedEdges, transform: Transform) -> RegistrationErrors:
    """Compute the covariance of a registration, and compare its transform with the next larger one.

    The next larger transform of "rigid" and of "similarity" is "affine"; of "affine" it is the polynomial of second
    order.

    Parameters
    ----------
    edges
        Edges of the last fit.
    transform
        Transform of the fit.

    References
    ----------
    .. [1] A. C. Cameron and D. L. Miller, "A practitioner's guide to cluster-robust inference", J. Human Resources 50
       (2015) 317.
    """
    good = np.isfinite(edges.residual) & (edges.weight > 0.0)
    edges = edges._replace(
        **{name: getattr(edges, name)[good] for name in ("known", "place", "normal", "residual", "weight")}
    )
    count = TRANSFORM_PARAMETERS[transform]
    columns, larger = _columns(edges, transform), _columns(edges, transform, with_next=True)
    fit = _fit(edges, columns, _WIDE_BLOCKS, _SHIFTS)
    covariance = fit.covariance[:count, :count]
    if len(edges.residual) <= 2 * len(larger):
        return RegistrationErrors(covariance, 0.0)
    next_fit = _fit(edges, larger, _BLOCKS)
    further = slice(count, count + len(larger) - len(columns))
    if not _is_significant(next_fit, further):
        return RegistrationErrors(covariance, 0.0)
    change = next_fit.parameters - np.insert(fit.parameters, count, np.zeros(len(larger) - len(columns)))
    # The error of the smaller transform is not known better than by this change.
    return RegistrationErrors(
        covariance + np.outer(change[:count], change[:count]), float(np.max(np.abs(change @ larger)))
    )


class _Fit(NamedTuple):
    """Parameters of a linear fit of the residuals, their covariance, and the number of cells with edges."""

    parameters: Float64
    covariance: Float64
    cells: int


def _columns(edges: FittedEdges, transform: Transform, *, with_next: bool = False) -> Float64:
    """Return derivatives (parameters, n): x, y, theta, deformation, parameters of the next transform, etch bias."""
    (x, y), (u, v) = edges.place.T, edges.known.T
    nx, ny = edges.normal.T
    along_u, along_v = (edges.normal @ edges.rotation).T
    rigid = [nx, ny, ny * x - nx * y]
    affine = [along_u * u, along_v * v, along_u * v]
    deformation = {"rigid": [], "similarity": [along_u * u + along_v * v], "affine": affine}
    columns = rigid + deformation[transform]
    if with_next:
        more = {"rigid": affine, "similarity": [along_u * u - along_v * v, along_u * v]}
        second = [n * each for n in (nx, ny) for each in (u * u, u * v, v * v)]
        columns = columns + more.get(transform, second)
    return np.array([*columns, *([np.ones_like(nx)] if edges.etch_bias_sigma else [])])


def _fit(edges: FittedEdges, columns: Float64, blocks: int, overlap: int = 1) -> _Fit:
    """Fit the residuals by columns; the covariance is clustered by blocks of the image, of ``overlap`` cells."""
    scale = np.sqrt(np.mean(columns**2, axis=1)) + np.finfo(float).tiny
    root = np.sqrt(edges.weight)
    weighted, residual = columns / scale[:, None] * root, edges.residual * root
    normal = weighted @ weighted.T
    shrinkage = np.zeros(len(columns))
    if edges.etch_bias_sigma:
        # The fit knows the etch bias to its standard deviation, and each edge to `sigma`.
        normal[-1, -1] += (edges.sigma / edges.etch_bias_sigma / scale[-1]) ** 2
        shrinkage[-1] = edges.sigma**2 / edges.etch_bias_sigma / scale[-1]
    inverse = np.linalg.pinv(normal, hermitian=True)
    parameters = inverse @ (weighted @ residual)
    left = residual - weighted.T @ parameters
    independent = inverse * (left @ left / max(len(left) - len(columns), 1))
    shrunk = inverse @ shrinkage

    cell = _cells(edges.place, blocks * overlap)
    clustered = overlapping_jackknife(weighted, normal, left, cell, cells=blocks * overlap, overlap=overlap)
    covariance = not_below(clustered, independent) + np.outer(shrunk, shrunk)
    return _Fit(parameters / scale, covariance / np.outer(scale, scale), len(np.unique(cell @ (1, blocks * overlap))))


def _cells(place: Float64, count: int) -> npt.NDArray[np.intp]:
    """Return column and row (n, 2) of the cell of each place: equal parts of the bounding box."""
    low = place.min(axis=0)
    extent = np.maximum(place.max(axis=0) - low, np.finfo(float).tiny)
    return np.asarray(np.minimum((place - low) / extent * count, count - 1).astype(np.intp))


def _is_significant(fit: _Fit, further: slice) -> bool:
    """Return whether further parameters differ from 0: Wald test against the F distribution for the blocks."""
    values = fit.parameters[further]
    freedom = fit.cells - len(values)
    if freedom < 1:
        return False
    wald = float(values @ np.linalg.pinv(fit.covariance[further, further], hermitian=True) @ values)
    ratio = wald * freedom / (len(values) * (fit.cells - 1))
    return bool(stats.f.sf(ratio, len(values), freedom) < _SIGNIFICANCE)
