"""Uncertainty of the correction of a calibrated lens or camera, over the image.

The correction moves a measured point to its ideal position (`Lens.undistort`, `Camera.undistort`). Its covariance is
J C J^T to first order: C is the covariance of the parameters, J the derivative of the corrected position, by central
differences. A homography of the corrected plane (a shift, a scale, a tilt of all points together) changes neither
straight lines nor a pose that is estimated afterwards; the part of J that is a homography over the measured points is
removed. Where no point was measured the model is extrapolated, and an error of the model is not part of C.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, Delaunay, QhullError

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.views.camera_fit import CameraFit

Float64 = npt.NDArray[np.float64]

# Step of the central differences, as part of the size of a parameter at which the point moves by about the distance
# from the centre. Derived: rounding 1e-16 / 1e-5 and truncation 1e-10 are both below 1e-9 of the derivative.
_STEP = 1e-5
# Measured points from which the homography is fitted, at most. Chosen: bounds the time.
_MAX_POINTS = 4000


class CorrectionMap(NamedTuple):
    """Uncertainty of the correction on a grid of points of the image.

    Attributes
    ----------
    points : numpy.ndarray
        (rows, columns, 2) float64: column and row of each grid point in the measured image [px].
    sigma_px : numpy.ndarray
        (rows, columns) float64: standard deviation of the corrected position in its least certain direction [px]; NaN
        where the model cannot be inverted, infinite where the data do not determine it.
    inside : numpy.ndarray
        (rows, columns) bool: inside the convex hull of the measured points.
    extrapolated : numpy.ndarray
        (rows, columns) bool: not inside, or sigma above the limit, or NaN.
    """

    points: Float64
    sigma_px: Float64
    inside: npt.NDArray[np.bool_]
    extrapolated: npt.NDArray[np.bool_]


def correction_covariance(fit: LensFit | CameraFit, points: npt.ArrayLike, measured: npt.ArrayLike) -> Float64:
    """Return the covariance of the corrected positions of points, up to a homography of the corrected plane.

    Parameters
    ----------
    fit : LensFit or CameraFit
        Result of `fit_lens` or `fit_camera`.
    points : array_like
        (..., 2): column and row in the measured image [px].
    measured : array_like
        (n, 2): points over which the best homography is removed, such as the points of the fit; NaN is ignored.

    Returns
    -------
    numpy.ndarray
        (..., 2, 2) float64 [px^2]; zero for a fit without a lens, NaN where the model cannot be inverted, infinite
        where the data do not determine a parameter.

    Notes
    -----
    The covariance of the parameters is the result of the fit, with its error model. It does not contain an error of the
    model where no point was measured.
    """
    places = np.asarray(points, dtype=np.float64)
    model = fit.lens if isinstance(fit, LensFit) else fit.camera
    if model is None:
        return np.zeros((*places.shape, 2))
    names = [name for name in fit.names if not name.startswith("v")]
    covariance = fit.covariance[: len(names), : len(names)]
    variance = covariance.diagonal()
    known = np.flatnonzero((variance > 0.0) & np.isfinite(variance))
    fitted = _some_finite(np.asarray(measured, dtype=np.float64), model)
    together = np.concatenate([places.reshape(-1, 2), fitted])
    columns = np.zeros((*together.shape, len(known)))
    for column, each in enumerate(known):
        columns[..., column] = _derivative(model, names[each], together)
    derivative = _without_homography(columns, model.undistort(together), len(fitted)).reshape(*places.shape, -1)
    found = derivative @ covariance[np.ix_(known, known)] @ np.swapaxes(derivative, -1, -2)
    for each in np.flatnonzero(np.isinf(variance)):
        found[np.any(_derivative(model, names[each], places) != 0.0, axis=-1)] = np.inf
    return np.asarray(found)


def correction_sigma(fit: LensFit | CameraFit, points: npt.ArrayLike, measured: npt.ArrayLike) -> Float64:
    """Return the standard deviation of corrected positions in their least certain direction [px], shape (...).

    Parameters
    ----------
    fit, points, measured : LensFit or CameraFit, array_like
        As for `correction_covariance`.
    """
    found = correction_covariance(fit, points, measured)
    known = np.isfinite(found).all(axis=(-1, -2))
    sigma = np.where(np.isnan(found).any(axis=(-1, -2)), np.nan, np.inf)
    sigma[known] = np.sqrt(np.maximum(np.linalg.eigvalsh(found[known])[..., -1], 0.0))
    return np.asarray(sigma)


def correction_map(
    fit: LensFit | CameraFit,
    image_size: tuple[int, int],
    measured: Sequence[npt.ArrayLike],
    *,
    max_sigma_px: float,
    grid: tuple[int, int] = (41, 31),
) -> CorrectionMap:
    """Return the uncertainty of the correction over the image, and where it is extrapolated.

    Parameters
    ----------
    fit : LensFit or CameraFit
        Result of `fit_lens` or `fit_camera`.
    image_size : (int, int)
        Columns and rows [px].
    measured : sequence of array_like
        Measured points (n, 2) [px], which may contain NaN.
    max_sigma_px : float
        Sigma above which the correction counts as extrapolated [px].
    grid : (int, int)
        Number of grid points along the columns' and the rows' axis. Default (41, 31).
    """
    across, down = (np.linspace(0.0, size - 1.0, count) for size, count in zip(image_size, grid, strict=True))
    points = np.stack(np.meshgrid(across, down), axis=-1)
    known = np.concatenate([np.asarray(each, dtype=np.float64).reshape(-1, 2) for each in measured])
    sigma, inside = correction_sigma(fit, points, known), _inside_hull(points, known)
    return CorrectionMap(points, sigma, inside, ~(sigma <= max_sigma_px) | ~inside)


def _inside_hull(points: Float64, measured: Float64) -> npt.NDArray[np.bool_]:
    """Return whether points (..., 2) lie inside the convex hull of the measured points."""
    known = measured[np.isfinite(measured).all(axis=1)]
    try:
        return np.asarray(Delaunay(known[ConvexHull(known).vertices]).find_simplex(points) >= 0)
    except (QhullError, ValueError):
        return np.zeros(points.shape[:-1], dtype=np.bool_)


def _some_finite(measured: Float64, model: Lens | Camera) -> Float64:
    """Return at most `_MAX_POINTS` measured points that the model can correct."""
    points = measured.reshape(-1, 2)[np.isfinite(measured.reshape(-1, 2)).all(axis=1)]
    points = points[:: -(-max(len(points), 1) // _MAX_POINTS)]
    return np.asarray(points[np.isfinite(model.undistort(points)).all(axis=1)])


def _without_homography(columns: Float64, corrected: Float64, count: int) -> Float64:
    """Remove from displacement fields (n, 2, m) the homography that fits the last ``count`` points best."""
    if not count:
        return columns
    middle = corrected[-count:].mean(axis=0)
    x, y = ((corrected - middle) / max(float(np.ptp(corrected[-count:])), 1.0)).T
    one, nothing = np.ones_like(x), np.zeros_like(x)
    # Displacement fields of the eight generators of a homography.
    along = np.stack([one, x, y, nothing, nothing, nothing, x * x, x * y], axis=-1)
    down = np.stack([nothing, nothing, nothing, one, x, y, x * y, y * y], axis=-1)
    generators = np.stack([along, down], axis=1)
    part = np.linalg.lstsq(
        generators[-count:].reshape(2 * count, 8), columns[-count:].reshape(2 * count, -1), rcond=None
    )[0]
    return np.asarray((columns - generators @ part)[:-count])


def _derivative(model: Lens | Camera, name: str, points: Float64) -> Float64:
    """Return the derivative (..., 2) of corrected points by a parameter, by central differences."""
    radius = float(np.max(np.linalg.norm(points - _centre(model), axis=-1), initial=1.0))
    step = _STEP * _size(model, name, radius)
    ends = [_moved(model, name, sign * step).undistort(points) for sign in (1.0, -1.0)]
    return np.asarray((ends[0] - ends[1]) / (2.0 * step))


def _centre(model: Lens | Camera) -> tuple[float, float]:
    if isinstance(model, Lens):
        return model.centre
    return model.matrix[0][2], model.matrix[1][2]


def _size(model: Lens | Camera, name: str, radius: float) -> float:
    """Return the size of a parameter at which a point at ``radius`` [px] moves by about ``radius``."""
    if name in ("C_c", "R_c", "cx", "cy"):
        return radius
    if name.startswith("tau"):
        return 1.0
    if isinstance(model, Lens):
        return float(radius ** (-2.0 * int(name[1:])))
    if name in ("f", "fx", "fy"):
        return model.matrix[0][0]
    # The distortion has the term: coefficient times normalised radius to the power of twice this order.
    order = {"k1": 1.0, "k2": 2.0, "k3": 3.0, "p1": 0.5, "p2": 0.5, "k4": 1.0, "k5": 2.0, "k6": 3.0}[name]
    return float((radius / model.matrix[0][0]) ** (-2.0 * order))


def _moved(model: Lens | Camera, name: str, step: float) -> Lens | Camera:
    """Return the model with one parameter changed."""
    if isinstance(model, Lens):
        values = {"k1": model.k1, "k2": model.k2, "k3": model.k3, "k4": model.k4}
        column, row = model.centre
        if name in values:
            values[name] += step
        else:
            column, row = (column + step, row) if name == "C_c" else (column, row + step)
        return Lens(**values, centre=(column, row))
    (fx, skew, cx), (_, fy, cy), last = model.matrix
    distortion = list(model.distortion)
    if name in COEFFICIENT_NAMES:
        distortion[COEFFICIENT_NAMES.index(name)] += step
    aspect = fy / fx
    fx, fy = (
        (fx + step, fy + aspect * step) if name == "f" else (fx + step * (name == "fx"), fy + step * (name == "fy"))
    )
    cx, cy = cx + step * (name == "cx"), cy + step * (name == "cy")
    return Camera(matrix=((fx, skew, cx), (0.0, fy, cy), last), distortion=tuple(distortion))


def largest_sigma(found: CorrectionMap, *, inside: bool) -> float:
    """Return the largest sigma of a map [px], in the image or only inside the hull of the points; NaN without one."""
    sigma = found.sigma_px[found.inside] if inside else found.sigma_px
    sigma = sigma[~np.isnan(sigma)]
    return float(sigma.max()) if len(sigma) else math.nan
