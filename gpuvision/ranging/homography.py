"""Plane-to-plane homographies between sensor and sheet of light: a nested family of models.

`gpuvision.ranging.homography_fit` fits them to calibration points. The models map the sheet to the sensor,
``(u, v, 1) ~ N (G, H, 1)``, because the noise of a calibration is on the sensor
coordinates. Each model fixes some elements of N at 0; the inverse of N has the same number of zeros, see
`homography_from_constants`.

- C3: ``u = (a H + b)/(c H + 1)``. A single beam: only u and H.
- C4: also ``v = d G/(c H + 1)``. Symmetric about G = 0 and v = ``symmetry``: De Bakker's four constants,
  ``H = (C1 u + C2)/(u + C3)``, ``G = C4 v/(u + C3)``.
- D6: also ``v = (d G + e H + f)/(c H + 1)``. Sensor and sheet are offset along the profile, and the profile axis is not
  perpendicular to the measuring axis; H still depends on u alone.
- H8: all elements. Any pinhole sensor and any sheet; if the sensor is rolled about its axis, H also depends on v.

The thesis lists C1-C4 and D1-D6 among its symbols without their equations. The equations are derived here: C4 is the
only model with four constants for a symmetric setup. D6 is its smallest extension by offsets that keeps H independent
of v.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3.3 and the
list of symbols.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from gpuvision.validation import finite

Model = Literal["C3", "C4", "D6", "H8"]
Float64 = npt.NDArray[np.float64]
Region = tuple[tuple[float, float], tuple[float, float]]

MODELS: dict[str, npt.NDArray[np.bool_]] = {
    name: np.array(rows, dtype=bool)
    for name, rows in {
        "C3": ((0, 1, 1), (0, 0, 0), (0, 1, 1)),
        "C4": ((0, 1, 1), (1, 0, 0), (0, 1, 1)),
        "D6": ((0, 1, 1), (1, 1, 1), (0, 1, 1)),
        "H8": ((1, 1, 1), (1, 1, 1), (1, 1, 1)),
    }.items()
}
"""Free elements of N (sheet to sensor) by model name; one of them is the scale."""


@dataclass(frozen=True, kw_only=True)
class HomographyLimits:
    """Limits of the fit of homographies.

    Attributes
    ----------
    rank_tolerance : float
        Singular values and denominators below this fraction of the largest one count as 0. Chosen: well above the
        rounding of float64 (2e-16), well below the values of a setup that can be built. Default 1e-10.
    residual_rounding : float
        Residuals below this fraction of the largest coordinate are rounding errors, which an F test must not compare.
        Chosen: 64 roundings of float64.
    max_rms : float
        Largest root mean square residual in given standard deviations that `Triangulation.fit` accepts. Chosen: a wrong
        pair gives a hundred and more, a standard deviation that is stated too small seldom ten. Default 10.
    """

    rank_tolerance: float = 1e-10
    residual_rounding: float = 64.0 * float(np.finfo(np.float64).eps)
    max_rms: float = 10.0


DEFAULT_LIMITS = HomographyLimits()


def shift_and_scale(origin: npt.ArrayLike, unit: npt.ArrayLike) -> Float64:
    """Return the (3, 3) matrix that maps (x, y, 1) to (origin + unit (x, y), 1)."""
    matrix = np.diag([*np.broadcast_to(np.asarray(unit, dtype=np.float64), 2), 1.0])
    matrix[:2, 2] = origin
    return matrix


def project(matrix: Float64, points: Float64) -> Float64:
    """Map points (..., 2) by a homography (3, 3); the result is infinite or NaN on the horizon."""
    lifted = points @ matrix[:, :2].T + matrix[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        mapped: Float64 = lifted[..., :2] / lifted[..., 2:]
    return mapped


def inverse(matrix: Float64) -> Float64:
    """Return the inverse (3, 3) of a homography.

    Raises
    ------
    ValueError
        The homography is singular: the sensor sees the sheet of light edge-on.
    """
    try:
        inverted = np.linalg.inv(matrix)
    except np.linalg.LinAlgError:
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on") from None
    return np.asarray(inverted, dtype=np.float64)


def to_displacement(
    matrix: Float64, *, rank: int = 3, rank_tolerance: float = HomographyLimits.rank_tolerance
) -> Float64:
    """Return the displacement parameters of a homography: value at the centre, gradients, and denominator.

    They are (g0, gx, gy, h0, hx, hy, dx, dy) of ``G = g0 + (gx x + gy y)/(1 + dx x + dy y)``, and the same form for H.

    Parameters
    ----------
    matrix : numpy.ndarray
        Homography (3, 3) from (x, y, 1) to (G, H, 1), with x and y in -1 to 1.
    rank : {3, 2}
        Rank that the homography must have: 3, or 2 for a single beam, where only H depends on x. Default 3.
    rank_tolerance : float
        As `HomographyLimits.rank_tolerance`.

    Returns
    -------
    numpy.ndarray
        Eight parameters; g and h in metres, d without unit.

    Raises
    ------
    ValueError
        x = y = 0 lies on the horizon, or the rank is lower.
    """
    if abs(matrix[2, 2]) <= rank_tolerance * np.max(np.abs(matrix[2])):
        raise ValueError("the middle of the region lies on the horizon; expected a region that sees the sheet")
    scaled = matrix / matrix[2, 2]
    gradients = scaled[:2, :2] - np.outer(scaled[:2, 2], scaled[2, :2])
    singular = np.linalg.svd(gradients, compute_uv=False)
    if singular[rank - 2] <= rank_tolerance * singular[0] or not np.all(np.isfinite(scaled)):
        raise ValueError("the homography is singular: the sensor sees the sheet of light edge-on")
    return np.array([scaled[0, 2], *gradients[0], scaled[1, 2], *gradients[1], *scaled[2, :2]])


def displacement_jacobian(matrix: Float64, changes: Float64) -> Float64:
    """Return the changes (..., 8) of `to_displacement` for small changes (..., 3, 3) of the matrix (product rule)."""
    scaled = matrix / matrix[2, 2]
    moved = changes / matrix[2, 2]
    moved = moved - scaled * moved[..., 2:, 2:]
    gradients = moved[..., :2, :2] - moved[..., :2, 2:] * scaled[2, :2] - scaled[:2, 2:] * moved[..., 2:, :2]
    blocks = [
        moved[..., :1, 2],
        gradients[..., 0, :],
        moved[..., 1:2, 2],
        gradients[..., 1, :],
        moved[..., 2, :2],
    ]
    return np.concatenate(blocks, axis=-1)


def displacement_design(x: Float64, displacement: Float64) -> Float64:
    """Return the derivatives (..., 2, 8) of (G, H) by the displacement parameters.

    Parameters
    ----------
    x : numpy.ndarray
        Coordinates (x, y) / (1 + dx x + dy y), (..., 2).
    displacement : numpy.ndarray
        (G - g0, H - h0), (..., 2).
    """
    design = np.zeros((*x.shape[:-1], 2, 8))
    for row in (0, 1):
        design[..., row, 3 * row] = 1.0
        design[..., row, 3 * row + 1 : 3 * row + 3] = x
    design[..., 6:] = -displacement[..., None] * x[..., None, :]
    return design


def packed_covariance_factor(covariance: npt.ArrayLike, which: Sequence[int]) -> Float64:
    """Return the lower triangular factor of a block of a covariance, packed by columns; the block may be singular.

    Parameters
    ----------
    covariance : array_like
        Covariance (n, n).
    which : sequence of int
        Indices of the m rows and columns of the block.

    Returns
    -------
    numpy.ndarray
        The m (m + 1) / 2 elements of L, with ``L L^T`` the block.
    """
    block = np.asarray(covariance, dtype=np.float64)[np.ix_(which, which)]
    values, vectors = np.linalg.eigh(block)
    triangle = np.asarray(np.linalg.qr((vectors * np.sqrt(np.maximum(values, 0.0))).T, mode="r")).T
    return np.concatenate([triangle[column:, column] for column in range(len(which))])


def camera_homography(
    camera_matrix: npt.ArrayLike,
    rotation: npt.ArrayLike,
    translation: npt.ArrayLike,
    plane: Sequence[npt.ArrayLike],
) -> Float64:
    """Return the homography (3, 3) from the sheet to the pixels (column, row) of a pinhole camera.

    Parameters
    ----------
    camera_matrix : array_like
        Camera matrix (3, 3) [px].
    rotation, translation : array_like
        Pose of the camera, world to camera: (3, 3), and (3,) [m].
    plane : sequence of array_like
        G axis, H axis (unit vectors) and origin [m] of the sheet in the world, (3,) each.
    """
    axes = np.asarray(rotation, dtype=np.float64) @ np.column_stack([np.asarray(each, np.float64) for each in plane])
    axes[:, 2] += np.asarray(translation, dtype=np.float64)
    return np.asarray(camera_matrix, dtype=np.float64) @ axes


def triangulation_homography(baseline: float, stand_off: float, focal_distance: float, tilt: float | None) -> Float64:
    """Return the homography (3, 3) from the sheet to the sensor (u, v) of a laser triangulation setup.

    The lens lies beside the sheet. Its axis meets the sheet at the origin.

    Parameters
    ----------
    baseline : float
        Distance of the lens from the sheet [m], positive.
    stand_off : float
        Distance of the lens from the origin along the sheet [m], positive.
    focal_distance : float
        Distance of the sensor from the lens along the axis [m], positive.
    tilt : float or None
        Tilt of the sensor [rad], -pi/2 to pi/2 (exclusive). None: the Scheimpflug condition.

    Raises
    ------
    ValueError
        A length is not positive, or the tilt is out of its range.
    """
    for name, value in (("baseline", baseline), ("stand_off", stand_off), ("focal_distance", focal_distance)):
        if not finite(value, name) > 0.0:
            raise ValueError(f"{name} is {value}, expected a positive length")
    angle, distance = math.atan2(baseline, stand_off), math.hypot(baseline, stand_off)
    if tilt is None:
        tilt = math.atan2(focal_distance, distance * math.tan(angle))
    if not abs(tilt) < 0.5 * math.pi:
        raise ValueError(f"tilt is {tilt} rad, expected less than a right angle")
    return np.array(
        [
            [0.0, focal_distance * math.sin(angle), 0.0],
            [focal_distance * math.cos(tilt), 0.0, 0.0],
            [0.0, -math.cos(angle - tilt), distance * math.cos(tilt)],
        ]
    )


def homography_from_constants(constants: tuple[float, ...]) -> tuple[tuple[tuple[float, float, float], ...], Model]:
    """Return the homography from sensor to sheet, and the model, for given constants.

    Parameters
    ----------
    constants : tuple of float
        3, 4, 6 or 8 constants, see `Triangulation.from_constants`.

    Returns
    -------
    tuple of tuple of float
        Rows of the homography.
    Model
        "C3", "C4", "D6" or "H8".

    Raises
    ------
    ValueError
        Another number of constants.
    """
    match constants:
        case (c1, c2, c3):
            return ((0.0, 0.0, 0.0), (c1, 0.0, c2), (c3, 0.0, 1.0)), "C3"
        case (c1, c2, c3, c4):
            return ((0.0, c4, 0.0), (c1, 0.0, c2), (1.0, 0.0, c3)), "C4"
        case (d1, d2, d3, d4, d5, d6):
            return ((d5, d4, d6), (d1, 0.0, d2), (1.0, 0.0, d3)), "D6"
        case (a, b, c, d, e, f, g, h):
            return ((a, b, c), (d, e, f), (g, h, 1.0)), "H8"
    raise ValueError(f"got {len(constants)} constants, expected 3, 4, 6 or 8")


def centre_and_half_extent(region: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return the centre (2,) of a region and half its larger extent, twice: equal scales keep circles circles."""
    bounds = np.asarray(region, dtype=np.float64)
    return bounds.mean(axis=1), np.full(2, 0.5 * np.max(bounds[:, 1] - bounds[:, 0]))


def bounding_box(points: Float64) -> Region:
    """Return the smallest region that contains points (n, 2)."""
    (u_min, v_min), (u_max, v_max) = points.min(axis=0).tolist(), points.max(axis=0).tolist()
    return (u_min, u_max), (v_min, v_max)
