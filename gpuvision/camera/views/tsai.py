"""Tsai's calibration from one view of a flat target: radial alignment for the pose, then focal length and k1.

Radial distortion moves points along the direction from the distortion centre. For a known centre this direction is
linear in the pose, independent of focal length and distortion.

Limits: The centre (and the aspect ratio) must be known. The sensor is not tilted, unless the points are undistorted and
the centre is the virtual camera's. The only distortion term is k1. The two stages minimise algebraic errors one after
the other, so the result is not the maximum likelihood estimate. A target nearly parallel to the sensor does not
separate focal length and distance. `fit_camera` has none of these limits; Tsai's method serves for comparison, and
`radial_alignment` as a starting value of other methods.

References
----------
R. Tsai, A versatile camera calibration technique for high-accuracy 3D machine vision metrology, IEEE J. Robotics and
Automation 3 (1987) 323. F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008,
section 3.3.4, eq. 3.8 and 3.9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.camera_fit import Pose
from gpuvision.validation import numbers

# Points that determine the five parameters of the alignment.
_MIN_POINTS = 5
# Ratio of the second smallest to the largest singular value of the alignment's equations, below which several poses
# fit. Derived: above double rounding.
_SINGULAR = 1e-9
# Second stage: largest number of Gauss-Newton steps, and relative step that ends them.
_MAX_ITERATIONS = 20
_CONVERGED = 1e-12
# Relative standard deviation of f above which the view does not determine it, and least residual_variance [px] assumed
# for it.
_UNDETERMINED = 0.3
_MIN_NOISE_PX = 0.01
_NO_FOCAL_LENGTH = (
    "the view does not determine the focal length: the target is too parallel to the sensor, or the centre is wrong; "
    "give f"
)


class Alignment(NamedTuple):
    """Pose up to the distance, from radial alignment.

    Attributes
    ----------
    rotations : numpy.ndarray
        (2, 3, 3): the two possible rotations. They differ in the side of the target that is nearer to the camera; only
        perspective decides between them.
    shift : numpy.ndarray
        (2,): (t_x, t_y) [m], the unit of the target points.
    """

    rotations: Floats
    shift: Floats


@dataclass(frozen=True, kw_only=True)
class TsaiFit:
    """Result of Tsai's calibration from one view.

    Attributes
    ----------
    focal_length : float
        f [px].
    lens : Lens or None
        kappa1 about the given centre, from measured to undistorted coordinates (eq. 3.9); None if not estimated.
    pose : Pose
        Pose of the target.
    rms_px : float
        Root mean square distance between undistorted and projected points [px].
    focal_length_sigma : float
        Standard deviation of f [px]; 0 if f was given.
    """

    focal_length: float
    lens: Lens | None
    pose: Pose
    rms_px: float
    focal_length_sigma: float


def radial_alignment(target: npt.ArrayLike, image: npt.ArrayLike, centre: tuple[float, float]) -> Alignment:
    """Estimate the pose of a flat target up to its distance: the first, linear stage of Tsai's method.

    Parameters
    ----------
    target : array_like
        (n, 2) or (n, 3): points on the target, Z = 0 [m].
    image : array_like
        (n, 2): measured (column, row) in square pixels; NaN where missing.
    centre : (float, float)
        Column and row of the distortion centre [px].

    Returns
    -------
    Alignment

    Raises
    ------
    ValueError
        The points are too few, or do not determine the pose (all on one line, or most on one through the centre).
    """
    plane, offset = _known_pairs(target, image, centre)
    size = math.sqrt(float(np.mean(plane**2))) or 1.0
    x, y = (plane / size).T
    column, row = (offset / math.sqrt(float(np.mean(offset**2)))).T
    # row * (r1 X + r2 Y + t_x) = column * (r4 X + r5 Y + t_y), solved as a homogeneous system since t_y may be 0.
    equations = np.stack([row * x, row * y, row, -column * x, -column * y, -column], axis=1)
    # Five points have five equations: a row of zeros keeps the sixth axis, which is then the solution.
    _, sizes, axes = np.linalg.svd(np.vstack([equations, np.zeros((1, 6))]), full_matrices=False)
    if sizes[-2] <= _SINGULAR * sizes[0]:
        raise ValueError("radial alignment leaves the pose open: its points lie on one line, or few through the centre")
    r1, r2, tx, r4, r5, ty = axes[-1]
    first, second = r1 * x + r2 * y + tx, r4 * x + r5 * y + ty
    sign = 1.0 if np.sum(first * column + second * row) > 0.0 else -1.0
    # The upper left 2 x 2 block of a rotation has the singular values 1 and cos(inclination).
    u, (large, small), vt = np.linalg.svd(sign * np.array([[r1, r2], [r4, r5]]))
    if large <= _SINGULAR:
        raise ValueError("radial alignment leaves the pose open: the target's points fall together in the image")
    cosine = min(small / large, 1.0)
    upper = u @ np.diag([1.0, cosine]) @ vt
    lower = math.sqrt(1.0 - cosine**2) * vt[1]
    rotations = [_complete_rotation(np.vstack([upper, side * lower])) for side in (1.0, -1.0)]
    return Alignment(np.array(rotations), sign * np.array([tx, ty]) * size / large)


def fit_tsai(
    target: npt.ArrayLike,
    image: npt.ArrayLike,
    centre: tuple[float, float],
    *,
    focal_length: float | None = None,
    distorted: bool = True,
) -> TsaiFit:
    """Calibrate an untilted camera of known centre from one view of a flat target by Tsai's method.

    Parameters
    ----------
    target, image, centre : array_like, pair of floats
        As in `radial_alignment`.
    focal_length : float, optional
        Known f [px]. Default: estimated.
    distorted : bool
        Estimate kappa1. Default True.

    Returns
    -------
    TsaiFit

    Raises
    ------
    ValueError
        The points do not determine the pose, or the target is too parallel to the sensor to determine f.

    References
    ----------
    R. Tsai, IEEE J. Robotics and Automation 3 (1987) 323.
    """
    plane, offset = _known_pairs(target, image, centre)
    alignment = radial_alignment(target, image, centre)
    shift = alignment.shift
    fits = [_second_stage(plane, offset, each, shift, focal_length, distorted) for each in alignment.rotations]
    possible = [fit for fit in fits if fit is not None]
    if not possible:
        raise ValueError(_NO_FOCAL_LENGTH)
    values, deviation, rms, rotation = min(possible, key=lambda fit: fit[2])
    f, distance, kappa = values.tolist()
    if deviation > _UNDETERMINED * f:
        raise ValueError(_NO_FOCAL_LENGTH)
    return TsaiFit(
        focal_length=f,
        lens=Lens(k1=kappa, centre=(float(centre[0]), float(centre[1]))) if distorted else None,
        pose=Pose(rotation, np.array([*shift, distance])),
        rms_px=rms,
        focal_length_sigma=deviation,
    )


def _known_pairs(target: npt.ArrayLike, image: npt.ArrayLike, centre: tuple[float, float]) -> tuple[Floats, Floats]:
    """Return the target points, and the image points relative to the centre, of the points that are not missing."""
    plane = np.asarray(target, dtype=np.float64)[..., :2].reshape(-1, 2)
    offset = np.asarray(image, dtype=np.float64).reshape(-1, 2) - numbers(centre, (2,), "centre (column, row)")
    if len(plane) != len(offset):
        raise ValueError(f"{len(plane)} target points for {len(offset)} image points, expected equal numbers")
    known = np.isfinite(np.concatenate([plane, offset], axis=1)).all(axis=1)
    if np.count_nonzero(known) < _MIN_POINTS:
        raise ValueError(f"{np.count_nonzero(known)} measured points, expected at least {_MIN_POINTS}")
    return plane[known], offset[known]


def _complete_rotation(columns: Floats) -> Floats:
    """Return the rotation (3, 3) of its first two columns (3, 2)."""
    return np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])


def _second_stage(
    plane: Floats, offset: Floats, rotation: Floats, shift: Floats, focal_length: float | None, distorted: bool
) -> tuple[Floats, float, float, Floats] | None:
    """Return (f, t_z, kappa1), deviation of f, rms and rotation; None if the target lies behind the camera."""
    rotated = plane @ rotation[:, :2].T
    across, depth = rotated[:, :2] + shift, rotated[:, 2]
    # Linear start without distortion: f * across = offset * (depth + t_z).
    system = np.stack([across.ravel(), -offset.ravel()], axis=1)
    side = (offset * depth[:, None]).ravel()
    if focal_length is None:
        f, distance = np.linalg.lstsq(system, side, rcond=None)[0].tolist()
    else:
        f = focal_length
        distance = float(np.linalg.lstsq(system[:, 1:], side - f * system[:, 0], rcond=None)[0][0])
    values = np.array([f, distance, 0.0])
    square = np.sum(offset**2, axis=1)
    free = [name for name, is_free in enumerate((focal_length is None, True, distorted)) if is_free]
    for _ in range(_MAX_ITERATIONS):
        point_depth = depth + values[1]
        if values[0] <= 0.0 or np.any(point_depth <= 0.0):
            return None
        ideal = across / point_depth[:, None]
        error = offset * (1.0 + values[2] * square)[:, None] - values[0] * ideal
        slopes = np.stack(
            [ideal, -values[0] * ideal / point_depth[:, None], -offset * square[:, None]], axis=-1
        ).reshape(-1, 3)
        unit = 1.0 / np.linalg.norm(slopes[:, free], axis=0)
        scaled = slopes[:, free] * unit
        step = unit * np.linalg.lstsq(scaled, error.ravel(), rcond=None)[0]
        values[free] += step
        if np.all(np.abs(step) <= _CONVERGED * np.abs(values[free])):
            break
    variance = unit**2 * np.diag(np.linalg.pinv(scaled.T @ scaled, rcond=1e-15))
    residual_variance = max(float(np.sum(error**2)) / max(error.size - len(free), 1), _MIN_NOISE_PX**2)
    deviation = math.sqrt(residual_variance * variance[0]) if focal_length is None else 0.0
    return values, deviation, math.sqrt(float(np.mean(np.sum(error**2, axis=1)))), rotation
