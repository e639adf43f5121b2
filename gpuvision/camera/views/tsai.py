"""Tsai's calibration from one view of a flat target: radial alignment for the pose, then focal length and k1.

R. Tsai, IEEE J. Robotics and Automation 3 (1987) 323; F. de Jong, section 3.3.4, eq. 3.8 and 3.9. With the centre of
distortion known, radial distortion moves points towards it or away, never aside. So the direction from the centre to
each point is linear in the pose, whatever focal length and distortion are.

Limits. The centre (and the aspect) must be known; the sensor is not tilted, unless the lens has been undone before and
the centre is the virtual camera's; there is k1 alone; the stages minimise algebraic errors in turn, so that the result
is not the most likely one; a target nearly parallel to the sensor leaves focal length and distance to each other.
`fit_camera` has none of these limits; this is the method to compare it with, and `radial_alignment` a start for others.
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

_FEWEST_POINTS = 5
# Second smallest over largest singular value of the alignment's equations, at which more than one pose fits.
_SINGULAR = 1e-9
_ROUNDS = 20
_SETTLED = 1e-12
_NO_FOCUS = 0.3
_BEST_NOISE_PX = 0.01
_NO_FOCUS_SAID = "the view fixes no focal length: the target is too parallel to the sensor, or the centre wrong; give f"


class Alignment(NamedTuple):
    """What radial alignment tells of a pose.

    Attributes
    ----------
    rotations
        (2, 3, 3): the two rotations that agree with it. They differ in which side of the target is nearer, which
        only perspective tells.
    shift
        (t_x, t_y), in the target's unit.
    """

    rotations: Floats
    shift: Floats


@dataclass(frozen=True, kw_only=True)
class TsaiFit:
    """Tsai's calibration of one view.

    Attributes
    ----------
    focal_length
        f, pixels.
    lens
        kappa1 about the given centre, from measured to undistorted coordinates (eq. 3.9), or None where it was not
        sought.
    pose
        Of the target.
    rms_px
        Root mean square distance between undistorted and projected points.
    focal_length_sigma
        Standard deviation of f, pixels; 0 where f was given.
    """

    focal_length: float
    lens: Lens | None
    pose: Pose
    rms_px: float
    focal_length_sigma: float


def radial_alignment(target: npt.ArrayLike, image: npt.ArrayLike, centre: tuple[float, float]) -> Alignment:
    """Tsai's first stage: the pose of a flat target but for its distance, by linear equations.

    Parameters
    ----------
    target
        (n, 2) or (n, 3): points on the target, Z = 0.
    image
        (n, 2): where they were seen, pixels, square; NaN where missing.
    centre
        Of distortion, pixels.

    Raises
    ------
    ValueError
        Too few points, or points that leave the pose open (all on one line, or on one through the centre).
    """
    plane, offset = _paired(target, image, centre)
    size = math.sqrt(float(np.mean(plane**2))) or 1.0
    x, y = (plane / size).T
    column, row = (offset / math.sqrt(float(np.mean(offset**2)))).T
    # row * (r1 X + r2 Y + t_x) = column * (r4 X + r5 Y + t_y), homogeneous: t_y may be 0.
    equations = np.stack([row * x, row * y, row, -column * x, -column * y, -column], axis=1)
    _, sizes, axes = np.linalg.svd(equations, full_matrices=False)
    if sizes[-2] <= _SINGULAR * sizes[0]:
        raise ValueError("radial alignment leaves the pose open: its points lie on one line, or few through the centre")
    r1, r2, tx, r4, r5, ty = axes[-1]
    first, second = r1 * x + r2 * y + tx, r4 * x + r5 * y + ty
    sign = 1.0 if np.sum(first * column + second * row) > 0.0 else -1.0
    # Two columns of a rotation without their last row have the singular values 1 and cos(inclination).
    u, (large, small), vt = np.linalg.svd(sign * np.array([[r1, r2], [r4, r5]]))
    if large <= _SINGULAR:
        raise ValueError("radial alignment leaves the pose open: the target's points fall together in the image")
    cosine = min(small / large, 1.0)
    upper = u @ np.diag([1.0, cosine]) @ vt
    lower = math.sqrt(1.0 - cosine**2) * vt[1]
    rotations = [_completed(np.vstack([upper, side * lower])) for side in (1.0, -1.0)]
    return Alignment(np.array(rotations), sign * np.array([tx, ty]) * size / large)


def fit_tsai(
    target: npt.ArrayLike,
    image: npt.ArrayLike,
    centre: tuple[float, float],
    *,
    focal_length: float | None = None,
    distorted: bool = True,
) -> TsaiFit:
    """Calibrate an untilted camera of known centre from one view of a flat target, as Tsai does.

    Parameters
    ----------
    target, image, centre
        As `radial_alignment` takes them.
    focal_length
        f where it is known, pixels.
    distorted
        Whether to seek kappa1.

    Raises
    ------
    ValueError
        The points do not fix the pose, or the target is too parallel to the sensor to fix f.
    """
    plane, offset = _paired(target, image, centre)
    alignment = radial_alignment(target, image, centre)
    shift = alignment.shift
    fits = [_second_stage(plane, offset, each, shift, focal_length, distorted) for each in alignment.rotations]
    possible = [fit for fit in fits if fit is not None]
    if not possible:
        raise ValueError(_NO_FOCUS_SAID)
    values, deviation, rms, rotation = min(possible, key=lambda fit: fit[2])
    f, distance, kappa = values.tolist()
    if deviation > _NO_FOCUS * f:
        raise ValueError(_NO_FOCUS_SAID)
    return TsaiFit(
        focal_length=f,
        lens=Lens(k1=kappa, centre=(float(centre[0]), float(centre[1]))) if distorted else None,
        pose=Pose(rotation, np.array([*shift, distance])),
        rms_px=rms,
        focal_length_sigma=deviation,
    )


def _paired(target: npt.ArrayLike, image: npt.ArrayLike, centre: tuple[float, float]) -> tuple[Floats, Floats]:
    """Target points and image points relative to the centre, those that are there."""
    plane = np.asarray(target, dtype=np.float64)[..., :2].reshape(-1, 2)
    offset = np.asarray(image, dtype=np.float64).reshape(-1, 2) - numbers(centre, (2,), "centre (column, row)")
    if len(plane) != len(offset):
        raise ValueError(f"{len(plane)} target points for {len(offset)} image points, expected as many")
    there = np.isfinite(np.concatenate([plane, offset], axis=1)).all(axis=1)
    if np.count_nonzero(there) < _FEWEST_POINTS:
        raise ValueError(f"{np.count_nonzero(there)} measured points, expected at least {_FEWEST_POINTS}")
    return plane[there], offset[there]


def _completed(columns: Floats) -> Floats:
    return np.column_stack([columns, np.cross(columns[:, 0], columns[:, 1])])


def _second_stage(
    plane: Floats, offset: Floats, rotation: Floats, shift: Floats, focal_length: float | None, distorted: bool
) -> tuple[Floats, float, float, Floats] | None:
    """(f, t_z, kappa1), deviation of f, rms and the rotation; None where the target would lie behind the camera."""
    inward = plane @ rotation[:, :2].T
    across, depth = inward[:, :2] + shift, inward[:, 2]
    # Linear, without distortion: f across = offset (depth + t_z).
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
    for _ in range(_ROUNDS):
        near = depth + values[1]
        if values[0] <= 0.0 or np.any(near <= 0.0):
            return None
        seen = across / near[:, None]
        error = offset * (1.0 + values[2] * square)[:, None] - values[0] * seen
        slopes = np.stack([seen, -values[0] * seen / near[:, None], -offset * square[:, None]], axis=-1).reshape(-1, 3)
        unit = 1.0 / np.linalg.norm(slopes[:, free], axis=0)
        scaled = slopes[:, free] * unit
        step = unit * np.linalg.lstsq(scaled, error.ravel(), rcond=None)[0]
        values[free] += step
        if np.all(np.abs(step) <= _SETTLED * np.abs(values[free])):
            break
    spread = unit**2 * np.diag(np.linalg.pinv(scaled.T @ scaled, rcond=1e-15, hermitian=True))
    noise = max(float(np.sum(error**2)) / max(error.size - len(free), 1), _BEST_NOISE_PX**2)
    deviation = math.sqrt(noise * spread[0]) if focal_length is None else 0.0
    return values, deviation, math.sqrt(float(np.mean(np.sum(error**2, axis=1)))), rotation
