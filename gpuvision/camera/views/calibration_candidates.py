"""Candidates of a camera calibration: fits of models, their comparison, and the result of the chosen one."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import FitState, PackedViews, RobustLoss, residuals, robust_scale
from gpuvision.camera.views.camera_fit import (
    CameraAlternative,
    CameraFit,
    camera_from_parameters,
    covariances,
    free_covariance,
    poses_in_lens_frame,
    residual_sigma,
    residual_variance_factor,
)
from gpuvision.camera.views.correlated_errors import MIN_VIEWS, CorrelatedErrors, correlated_errors
from gpuvision.camera.views.diagnosis import CalibrationLimits, determines_focal_length, diagnose
from gpuvision.camera.views.initialization import UndistortedHomographies
from gpuvision.camera.views.parameters import COEFFICIENTS, FreeParameters
from gpuvision.camera.views.target_views import Mask

# Relative size below which a direction of the coordinates is rounding.
_SINGULAR = 1e-9
# Residuals [px] at rounding level, which cannot distinguish models.
_EXACT_PX = 1e-6


@dataclass(frozen=True, kw_only=True)
class CalibrationTask:
    """Inputs of one call of `fit_camera`, checked and packed."""

    views: PackedViews
    masks: tuple[Mask, ...]
    size: tuple[int, int]
    homography_fit: UndistortedHomographies
    origin: Floats
    radius: float
    loss: RobustLoss
    sigma: float | None
    aspect: bool
    focal_length: float | None
    centre_is_known: bool
    limits: CalibrationLimits

    def free_parameters(self, model: str) -> FreeParameters:
        """Return the free parameters of a model."""
        tilt, coefficients = parse_model(model)
        return FreeParameters(
            coefficients=coefficients,
            tilt=tilt,
            aspect=self.aspect,
            focal_length=self.focal_length,
            centre=not self.centre_is_known,
        )


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """Fit of one model."""

    views: PackedViews
    model: str
    free_parameters: FreeParameters
    state: FitState
    loss: RobustLoss

    @functools.cached_property
    def correlated(self) -> CorrelatedErrors:
        """Tests of the residuals for correlation."""
        return correlated_errors(self.views, self.free_parameters, self.state, self.loss)


def parse_model(model: str) -> tuple[bool, tuple[str, ...]]:
    """Return whether a model has a tilt, and its free distortion coefficients."""
    if model == "tilt":
        return True, ("k1", "k2")
    names = [] if model == "none" else [name.strip() for name in model.split(",")]
    for name in names:
        if name not in ("tilt", *COEFFICIENTS):
            raise ValueError(
                f"model: unknown term {name!r}, expected some of tilt, {', '.join(COEFFICIENTS)}, or auto, or none"
            )
    if "tilt" in names and ("p1" in names or "p2" in names):
        raise ValueError(
            "model: the effects of p1 and p2 and of a tilt cannot be separated; leave out p1 and p2, or the tilt"
        )
    return "tilt" in names, tuple(name for name in COEFFICIENTS if name in names)


def calibration_result(
    task: CalibrationTask, chosen: Candidate, alternatives: tuple[CameraAlternative, ...]
) -> CameraFit:
    """Return the result of the chosen fit, with covariances and warnings."""
    state, free_parameters = chosen.state, chosen.free_parameters
    noise = residual_sigma(task.views, free_parameters, state, chosen.loss)
    correlated = chosen.correlated
    is_correlated = correlated.is_correlated(task.limits.lack_of_fit_significance)
    covariance, pose_covariance, focus = covariances(
        task.views, free_parameters, state, chosen.loss, task.sigma, correlated if is_correlated else None
    )
    if task.focal_length is not None:
        focus = 0.0
    errors = residuals(task.views, state)
    fit = CameraFit(
        camera=camera_from_parameters(state.values),
        model=chosen.model,
        poses=poses_in_lens_frame(state),
        names=free_parameters.names,
        covariance=covariance,
        pose_covariance=pose_covariance,
        rms_px=_rms(task, state),
        sigma_px=noise if task.sigma is None else task.sigma,
        residuals=_unpacked(task, errors),
        iterations=state.iterations,
        lack_of_fit=correlated.lack_of_fit,
        view_p_value=correlated.view_p_value,
        error_model="correlated" if is_correlated else "independent",
        alternatives=alternatives,
    )
    if not determines_focal_length(fit, focus, converged=state.converged, limits=task.limits):
        raise ValueError(
            "the views do not determine the focal length: add views at other angles to the camera, or give "
            "focal_length="
        )
    doubtful = np.linalg.norm(errors, axis=1) > task.limits.outlier_sigmas * robust_scale(task.views, state)
    warnings = diagnose(
        fit,
        task.size,
        focus=focus,
        converged=state.converged,
        noise=noise,
        outliers=int(doubtful.sum()) if chosen.loss.kind == "squared" else 0,
        mirrored=bool((np.linalg.det(task.homography_fit.homographies) < 0.0).all()),
        limits=task.limits,
    )
    return replace(fit, warnings=warnings)


def _rms(task: CalibrationTask, state: FitState) -> float:
    """Return the root mean square distance between measured and projected points [px]."""
    return math.sqrt(2.0 * float(np.sum(residuals(task.views, state) ** 2)) / task.views.coordinates)


def _unpacked(task: CalibrationTask, errors: Floats) -> tuple[Floats, ...]:
    """Return the residuals of each view in the order of its points, NaN for missing points."""
    result = []
    for mask, error in zip(task.masks, errors, strict=True):
        unpacked = np.full((len(mask), 2), np.nan)
        unpacked[mask] = error.T[: np.count_nonzero(mask)]
        result.append(unpacked)
    return tuple(result)


def p_value_against(task: CalibrationTask, small: Candidate, large: Candidate) -> float:
    """Return the p-value of a model against a larger one.

    The F test assumes independent errors. If the residuals of the larger model are correlated, Wald's test compares
    its further parameters with their covariance for correlated errors. The F test is also used for the comparison with
    the model "none", and if there are too few views for a covariance by view.
    """
    additional = large.free_parameters.count - small.free_parameters.count
    if additional == 0:
        return 1.0
    by_view = len(task.masks) >= MIN_VIEWS and bool(small.free_parameters.coefficients)
    if by_view and large.correlated.is_correlated(task.limits.lack_of_fit_significance):
        return _wald_p_value(task, small, large)
    free = task.views.coordinates - large.free_parameters.count - 6 * len(task.masks)
    if free <= 0:
        return 1.0
    rise = max(small.state.cost - large.state.cost, 0.0) / additional
    noise = residual_variance_factor(task.views, large.free_parameters, large.state, large.loss)
    return float(fdtrc(additional, free, rise / max(noise, _EXACT_PX**2)))


def _wald_p_value(task: CalibrationTask, small: Candidate, large: Candidate) -> float:
    """Return the p-value of Wald's test of the further parameters of the larger model, with errors by view.

    The smooth field in the image is not part of these errors: further terms of the lens may describe it.
    """
    free_parameters = large.free_parameters
    covariance = free_covariance(task.views, free_parameters, large.state, large.loss, task.sigma, large.correlated)
    values = large.state.values.copy()
    derivative, of_small = free_parameters.derivative(values), small.free_parameters.derivative(values)
    # A tilt moves v away from the centre; a known f' makes f follow from both.
    values[2:4] -= values[4:6]
    values[4:6] = 0.0
    if task.focal_length is not None:
        derivative[0] = of_small[0] = 0.0
    # Directions of the coordinates that the larger model can move and the smaller one cannot.
    basis = np.linalg.qr(of_small)[0]
    vectors, sizes, _ = np.linalg.svd(derivative - basis @ (basis.T @ derivative))
    further = vectors[:, : np.count_nonzero(sizes > _SINGULAR * sizes[0])].T
    effect = further @ derivative
    shift = further @ values
    statistic = float(shift @ np.linalg.solve(effect @ covariance @ effect.T, shift)) / len(further)
    return float(fdtrc(len(further), len(task.masks) - 1, statistic))


def alternative_of(task: CalibrationTask, other: Candidate, p_value: float, chosen: FitState) -> CameraAlternative:
    """Return the summary of a fit beside the chosen one."""
    parameters = other.free_parameters.count + 6 * len(task.masks)
    cost = max(other.state.cost / task.views.coordinates, _EXACT_PX**2)
    centre = other.state.values[4:6]
    return CameraAlternative(
        model=other.model,
        rms_px=_rms(task, other.state),
        parameters=other.free_parameters.count,
        p_value=p_value,
        aic=task.views.coordinates * math.log(cost) + 2.0 * parameters,
        centre=(float(centre[0]), float(centre[1])),
        centre_distance_px=float(np.linalg.norm(centre - chosen.values[4:6])),
    )
