"""Calibration of a sheet of light: plane, or low-order surface, from laser lines on known planes.

A laser line on a target of known pose gives points of the sheet in the camera's frame: the viewing ray of each reading
meets the target's plane. `fit_sheet` fits the plane of all points, with the quadratic surface

    d = offset + slope_g G + slope_h H + gg G^2 + gh G H + hh H^2            along g_axis x h_axis,

in the coordinates (G, H) of the sheet. The frame of the sheet is moved until offset and slopes vanish, so that the
sheet is the plane d = 0, or the surface of the last three terms (a bent sheet). The three terms are kept only if they
differ significantly from zero.

Three independent errors enter, and the fit weights and propagates each: the noise of the readings (independent), the
noise of the target's pose (common to all lines on this pose), and the error of the camera (common to all lines). The
observations of a pose have the covariance ``D + B O B'``, with the diagonal D of the readings, the covariance O of the
pose and the derivatives B of the distances by the pose. The result keeps the derivative by the camera's parameters.

References
----------
K. R. Koch, *Parameter Estimation and Hypothesis Testing in Linear Models*, Springer 1999, sections 3.2 (generalised
least squares) and 4.2 (test of a linear hypothesis).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag
from scipy.special import fdtrc

from gpuvision.camera.camera import Camera
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.ranging.sheet_readings import (
    DEFAULT_LIMITS,
    Along,
    LaserLine,
    SheetFrame,
    SheetLimits,
    SheetReadings,
    robust_plane,
    triangulate,
    turn_to_image,
)
from gpuvision.ranging.sheet_result import SHEET_PARAMETERS, BendTest, SheetFit

Float64 = npt.NDArray[np.float64]

# Tuning constant of Tukey's loss: 95 % efficiency for normal noise.
_TUKEY = 4.685
# Square of the last step [standard deviations] of a fit that has converged. Derived: a tenth of a standard deviation
# adds 0.5 % to the root-mean-square error.
_CONVERGED_SQUARE = 0.01
# Degrees of freedom that the line of a view contributes to the tests: offset, direction and curvature.
_NUMBERS_PER_VIEW = 3


def fit_sheet(
    camera: Camera,
    lines: Sequence[LaserLine],
    *,
    along: Along = "columns",
    names: Sequence[str] = (),
    camera_covariance: npt.ArrayLike | None = None,
    limits: SheetLimits = DEFAULT_LIMITS,
) -> SheetFit:
    """Fit a sheet of light to laser lines on targets of known pose.

    Parameters
    ----------
    camera : Camera
        Calibrated camera.
    lines : sequence of LaserLine
        Readings of the laser line, two targets at least.
    along : {"columns", "rows"}
        Image axis along which the line runs: its readings are rows ("columns") or columns ("rows").
    names : sequence of str
        Parameters of the camera with a covariance, as in `CameraFit.names`.
    camera_covariance : array_like, optional
        (m, m): covariance of these parameters. Default: the camera is known.
    limits : SheetLimits
        Thresholds.

    Returns
    -------
    SheetFit

    Raises
    ------
    ValueError
        The readings do not determine a plane; the message names the missing data.
    """
    covariance = np.zeros((len(names), len(names))) if camera_covariance is None else np.asarray(camera_covariance)
    readings = triangulate(camera, lines, along, tuple(names), limits)
    frame = turn_to_image(robust_plane(readings, limits), readings)
    frame, readings, sigma = _robust_fit(frame, readings, limits)
    plane = _Solution.of(frame, readings, sigma, 3, limits)
    bent = None
    if _freedom(readings) > 0:
        bent = _Solution.of(plane.frame, readings, sigma, len(SHEET_PARAMETERS), limits)
    test = None if bent is None else _test_bend(bent, covariance, limits)
    chosen = bent if bent is not None and test is not None and test.significant else plane
    return _result(chosen, test, sigma, [len(each.points) for each in lines])


class _System(NamedTuple):
    """Distances of the readings from a surface [m], and their derivatives.

    ``design`` (n, p): by the parameters of the surface, with the opposite sign. ``by_pixel`` (n,): by a pixel across
    the line. ``by_pose`` (n, 6): by the pose of the reading's target. ``by_camera`` (n, m): by the camera, at fixed
    poses.
    """

    distance: Float64
    flat: Float64
    design: Float64
    by_pixel: Float64
    by_pose: Float64
    by_camera: Float64


def _system(frame: SheetFrame, bend: Float64, readings: SheetReadings, count: int) -> _System:
    offset = readings.point - frame.origin
    g, h, d = (offset @ frame.axes.T).T
    gg, gh, hh = bend
    surface = gg * g * g + gh * g * h + hh * h * h
    normal = (
        frame.axes[2]
        - (2.0 * gg * g + gh * h)[:, None] * frame.axes[0]
        - (gh * g + 2.0 * hh * h)[:, None] * frame.axes[1]
    )
    # P = s ray on the plane N . P = N . T + constant: dP = s (dray - ray (N . dray) / (N . ray)), and for the plane
    # dP = ray (dN . (T - P) + N . dT) / (N . ray) with dN = w x N.
    steep = np.sum(readings.normal * readings.ray, axis=1)
    length = np.linalg.norm(readings.point, axis=1)
    along_ray = np.sum(normal * readings.ray, axis=1) / steep
    by_ray = length[:, None] * (normal - along_ray[:, None] * readings.normal)
    place = np.stack([each.target.pose.translation for each in readings.lines])[readings.view]
    by_turn = np.cross(readings.normal, place - readings.point)
    return _System(
        distance=d - surface,
        flat=np.stack([g, h], axis=1),
        design=np.stack([np.ones_like(g), g, h, g * g, g * h, h * h], axis=1)[:, :count],
        by_pixel=np.sum(by_ray * readings.slope, axis=1),
        by_pose=along_ray[:, None] * np.concatenate([by_turn, readings.normal], axis=1),
        by_camera=np.einsum("ni,nim->nm", by_ray, readings.by_camera),
    )


def _robust_fit(
    frame: SheetFrame, readings: SheetReadings, limits: SheetLimits
) -> tuple[SheetFrame, SheetReadings, float]:
    """Fit the bent sheet with Tukey's loss; return frame, readings with weights 0 or 1, and the noise [px]."""
    count = len(SHEET_PARAMETERS) if _freedom(readings) > 0 else 3
    bend, weight, sigma = np.zeros(3), readings.weight, math.inf
    known = readings.weight > 0.0
    for _ in range(limits.max_iterations):
        system = _system(frame, bend, readings, count)
        scale = np.abs(system.by_pixel)
        # A reading without a viewing ray has the distance NaN, which a weight of 0 does not remove from a product.
        root = np.sqrt(weight[known]) / scale[known]
        step = np.linalg.lstsq(system.design[known] * root[:, None], system.distance[known] * root, rcond=None)[0]
        change = step.astype(np.float64)
        frame = frame.moved(change)
        bend = bend + (change[3:] if count > 3 else 0.0)
        pixels = (system.distance - system.design @ change) / scale
        before, sigma = sigma, max(MAD_TO_SIGMA * float(np.median(np.abs(pixels[known]))), limits.noise_floor_px)
        weight = np.where(known, np.clip(1.0 - (pixels / (_TUKEY * sigma)) ** 2, 0.0, None) ** 2, 0.0)
        if abs(before - sigma) <= 1e-6 * sigma:
            break
    if sigma > limits.max_scatter_px:
        raise ValueError(
            f"the laser readings lie on no common sheet: they scatter by {sigma:.3g} px; check that each laser image "
            "shows the target in the pose of its target image"
        )
    kept = (weight > 0.0).astype(np.float64)
    readings = replace(readings, weight=kept)
    return frame, readings, _noise_within_views(pixels, readings, limits)


def _noise_within_views(pixels: Float64, readings: SheetReadings, limits: SheetLimits) -> float:
    """Return the noise of a reading [px], from residuals about a parabola in each view."""
    total, freedom = 0.0, 0
    for number in range(len(readings.lines)):
        inside = (readings.view == number) & (readings.weight > 0.0)
        if np.count_nonzero(inside) <= _NUMBERS_PER_VIEW:
            continue
        basis = _parabola(readings.along[inside])
        rest = pixels[inside] - basis @ np.linalg.lstsq(basis, pixels[inside], rcond=None)[0]
        total, freedom = total + float(rest @ rest), freedom + len(rest) - _NUMBERS_PER_VIEW
    return max(math.sqrt(total / max(freedom, 1)), limits.noise_floor_px)


def _parabola(along: Float64) -> Float64:
    """Return the columns 1, t, t^2 of positions along the line, scaled to -1 to 1."""
    t = (along - along.mean()) / max(float(np.ptp(along)) / 2.0, 1.0)
    return np.stack([np.ones_like(t), t, t * t], axis=1)


@dataclass(frozen=True, kw_only=True)
class _Solution:
    """Generalised least squares fit of a plane (three parameters) or a bent sheet (six)."""

    frame: SheetFrame
    bend: Float64
    system: _System
    readings: SheetReadings
    noise_covariance: Float64
    by_camera: Float64
    view_ratio: float
    converged: bool

    @classmethod
    def of(cls, frame: SheetFrame, readings: SheetReadings, sigma: float, count: int, limits: SheetLimits) -> _Solution:
        """Iterate to the frame in which offset and slopes vanish."""
        bend = np.zeros(3)
        for _ in range(limits.max_iterations):
            system = _system(frame, bend, readings, count)
            normal, side, by_camera = _normal_equations(system, readings, sigma)
            inverse: Float64 = np.linalg.inv(normal).astype(np.float64)
            change = inverse @ side
            if float(change @ side) <= 1e-12:
                break
            frame = frame.moved(change)
            bend = bend + (change[3:] if count > 3 else 0.0)
        ratio = _view_ratio(system, readings, sigma, count)
        return cls(
            frame=frame,
            bend=bend,
            system=system,
            readings=readings,
            noise_covariance=max(ratio, 1.0) * inverse,
            by_camera=inverse @ by_camera,
            view_ratio=ratio,
            converged=float(change @ side) <= _CONVERGED_SQUARE,
        )


def _normal_equations(system: _System, readings: SheetReadings, sigma: float) -> tuple[Float64, Float64, Float64]:
    """Return the normal matrix (p, p), the right-hand side (p,), and the right-hand sides (p, m) by the camera."""
    count, others = system.design.shape[1], system.by_camera.shape[1]
    total = np.zeros((count, count + 1 + others))
    pose_of_reading = np.array(readings.pose)[readings.view]
    for number, target in enumerate(readings.targets):
        inside = (pose_of_reading == number) & (readings.weight > 0.0)
        if not inside.any():
            continue
        root = 1.0 / (sigma * np.abs(system.by_pixel[inside]))[:, None]
        design, pose = system.design[inside] * root, system.by_pose[inside] * root
        by_camera = (system.by_camera[inside] + system.by_pose[inside] @ target.by_camera) * root
        right = np.concatenate([design, system.distance[inside, None] * root, by_camera], axis=1)
        # Inverse of I + B O B' by the identity of Woodbury; O stays positive definite when it is scaled by its factor.
        reach = pose @ np.linalg.cholesky(target.covariance)
        inner = np.eye(6) + reach.T @ reach
        total += design.T @ right - (design.T @ reach) @ np.linalg.solve(inner, reach.T @ right)
    return total[:, :count], total[:, count], total[:, count + 1 :]


def _view_ratio(system: _System, readings: SheetReadings, sigma: float, count: int) -> float:
    """Return the reduced chi-square of offset, direction and curvature of every view's line about the sheet."""
    # Numbers, their covariance by the readings, and their derivatives by the pose, of all lines on each pose.
    measured: list[list[Float64]] = [[] for _ in readings.targets]
    noises: list[list[Float64]] = [[] for _ in readings.targets]
    by_poses: list[list[Float64]] = [[] for _ in readings.targets]
    for number, pose in enumerate(readings.pose):
        inside = (readings.view == number) & (readings.weight > 0.0)
        if np.count_nonzero(inside) <= _NUMBERS_PER_VIEW:
            continue
        root = 1.0 / (sigma * np.abs(system.by_pixel[inside]))[:, None]
        basis = _parabola(readings.along[inside]) * root * np.median(1.0 / root)
        inverse = np.linalg.inv(basis.T @ basis)
        measured[pose].append(inverse @ basis.T @ (system.distance[inside] * root[:, 0]))
        noises[pose].append(inverse)
        by_poses[pose].append(inverse @ basis.T @ (system.by_pose[inside] * root))
    chi_square, freedom = 0.0, -count
    for target, numbers, noise, by_pose in zip(readings.targets, measured, noises, by_poses, strict=True):
        if not numbers:
            continue
        values, response = np.concatenate(numbers), np.concatenate(by_pose)
        covariance = block_diag(*noise) + response @ target.covariance @ response.T
        chi_square += float(values @ np.linalg.solve(covariance, values))
        freedom += len(values)
    return chi_square / freedom if freedom > 0 else 1.0


def _test_bend(bent: _Solution, camera: Float64, limits: SheetLimits) -> BendTest:
    """Test whether the bend differs from zero, with the errors of readings, poses and camera."""
    covariance = (bent.noise_covariance + bent.by_camera @ camera @ bent.by_camera.T)[3:, 3:]
    f_value = float(bent.bend @ np.linalg.solve(covariance, bent.bend)) / 3.0
    p_value = float(fdtrc(3, _freedom(bent.readings), f_value))
    sigmas = np.sqrt(np.diag(covariance))
    return BendTest(_triple(bent.bend), _triple(sigmas), f_value, p_value, p_value < limits.significance)


def _freedom(readings: SheetReadings) -> int:
    """Return the degrees of freedom of a bent sheet: numbers that the lines of all views give, less its parameters."""
    counts = np.bincount(readings.view[readings.weight > 0.0], minlength=len(readings.lines))
    return int(_NUMBERS_PER_VIEW * np.count_nonzero(counts > _NUMBERS_PER_VIEW)) - len(SHEET_PARAMETERS)


def _triple(values: Float64) -> tuple[float, float, float]:
    first, second, third = values.tolist()
    return first, second, third


def _result(solution: _Solution, test: BendTest | None, sigma: float, lengths: Sequence[int]) -> SheetFit:
    system, count = solution.system, solution.system.design.shape[1]
    pixels = np.where(solution.readings.weight > 0.0, system.distance / np.abs(system.by_pixel), np.nan)
    ends = np.cumsum(lengths)[:-1]
    return SheetFit(
        origin=solution.frame.origin,
        g_axis=solution.frame.axes[0],
        h_axis=solution.frame.axes[1],
        bend=_triple(solution.bend) if count > 3 else None,
        names=SHEET_PARAMETERS[:count],
        noise_covariance=solution.noise_covariance,
        by_camera=solution.by_camera,
        sigma_px=sigma,
        view_ratio=solution.view_ratio,
        bend_test=test,
        residuals=tuple(np.split(pixels, ends)),
        coordinates=tuple(np.split(system.flat, ends)),
        converged=solution.converged,
    )
