"""Warnings of a calibration about undetermined parameters; a small residual alone does not prove a model."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from gpuvision.camera.views.camera_fit import CameraAlternative, CameraFit
from gpuvision.camera.views.correlated_errors import MIN_VIEWS

# Points tested along each side of the image's border.
_BORDER_POINTS = 17


@dataclass(frozen=True, kw_only=True)
class CalibrationLimits:
    """Thresholds of the model choice, of the warnings and of the acceptance of `fit_camera`.

    Attributes
    ----------
    significance : float
        p-value below which an F test rejects the smaller model. Default 0.001.
    min_noise_px : float
        Least noise of a coordinate [px] assumed for the warnings: real points are seldom measured better. Default 0.01.
    max_focal_sigma : float
        Relative standard deviation of f above which a warning says that the views do not determine it. Default 0.02.
    undetermined_focal_sigma : float
        Relative standard deviation of f above which the calibration is refused. Default 0.3.
    max_centre_sigma_px : float
        Standard deviation of the centre [px] above which a warning says that the views do not determine it; also the
        distance of an alternative's centre that is reported. Default 3.0.
    max_centre_offset : float
        Distance of the centre from the image's middle [image diagonals] above which a tilted sensor is suspected.
        Default 0.1.
    max_noise_ratio : float
        Ratio of the estimated to the given noise above which the model is reported as insufficient. Default 1.2.
    significant_sigmas : float
        Standard deviations from which a tilt is significant. Default 3.0.
    min_tilt_degrees : float
        Tilt [degree] below which decentred lenses look the same. Typical assembly tolerance of lenses. Default 1.0.
    outlier_sigmas : float
        Length of a residual [standard deviations] of an outlier. Derived: one of 1e5 points at normal noise. Default
        5.0.
    min_view_share : float
        Least share of a view's points that must have a weight above 0 under Tukey's loss. Default 0.25.
    max_outside_share : float
        Largest share of points outside the image; a larger one indicates a wrong ``image_size``. Default 0.05.
    sufficient_noise_ratio : float
        Ratio of the residual to the residual of free homographies, up to which no other start is tried. Default 1.3.
    lack_of_fit_significance : float
        p-value of the smooth field, or of the test between views, below which the residuals count as correlated.
        Chosen: with two tests, one of 500 calibrations with independent errors. Default 0.001.
    max_lack_of_fit : float
        Ratio of the smooth residuals to the noise above which a warning names the lack of fit. Chosen: below 0.5 they
        add less than 12 % to the residual. Default 0.5.
    """

    significance: float = 0.001
    min_noise_px: float = 0.01
    max_focal_sigma: float = 0.02
    undetermined_focal_sigma: float = 0.3
    max_centre_sigma_px: float = 3.0
    max_centre_offset: float = 0.1
    max_noise_ratio: float = 1.2
    significant_sigmas: float = 3.0
    min_tilt_degrees: float = 1.0
    outlier_sigmas: float = 5.0
    min_view_share: float = 0.25
    max_outside_share: float = 0.05
    sufficient_noise_ratio: float = 1.3
    lack_of_fit_significance: float = 0.001
    max_lack_of_fit: float = 0.5


DEFAULT_LIMITS = CalibrationLimits()


def diagnose(
    fit: CameraFit,
    size: tuple[int, int],
    *,
    focus: float,
    converged: bool,
    noise: float,
    outliers: int,
    mirrored: bool,
    limits: CalibrationLimits = DEFAULT_LIMITS,
) -> tuple[str, ...]:
    """Return a warning for every parameter that the data do not determine.

    Parameters
    ----------
    fit : CameraFit
        Calibration without warnings.
    size : (int, int)
        Columns and rows of the images.
    focus : float
        Relative standard deviation of the virtual camera's f.
    converged : bool
        Whether the fit has converged.
    noise : float
        Standard deviation of one coordinate estimated from the residuals [px].
    outliers : int
        Number of outliers in a fit with the squared loss.
    mirrored : bool
        Whether every view shows the target from behind.
    limits : CalibrationLimits
        Thresholds.
    """
    warnings = [
        _focus(focus * _noise_factor(fit, limits), limits),
        _centre(fit, limits),
        _possible_tilt(fit, size, limits),
        *(_equal_alternative(each, limits) for each in fit.alternatives),
        _small_tilt(fit, limits),
        _lack_of_fit(fit, limits),
        _differing_views(fit, limits),
    ]
    if _folds(fit, size):
        warnings.append("the lens polynomial folds within the image: points beyond the fold cannot be undistorted")
    if not converged:
        warnings.append("the fit stopped before it converged; the uncertainties were computed at its last step")
    if noise > limits.max_noise_ratio * fit.sigma_px:
        warnings.append(f"the residual is {noise / fit.sigma_px:.1f} times the given noise: the model does not suffice")
    if outliers:
        warnings.append(f"{outliers} points are outliers: check the residuals, or use loss='tukey'")
    if mirrored:
        warnings.append(
            "the views show the target from behind (its Z axis points at the camera): its y axis points upwards, or "
            "the images are mirrored, and so is the calibrated camera"
        )
    return tuple(each for each in warnings if each)


def determines_focal_length(
    fit: CameraFit, focus: float, *, converged: bool, limits: CalibrationLimits = DEFAULT_LIMITS
) -> bool:
    """Return whether the data determine the focal length; a fit that has not converged must determine it well."""
    limit = limits.undetermined_focal_sigma if converged else limits.max_focal_sigma
    return focus * _noise_factor(fit, limits) < limit


def _noise_factor(fit: CameraFit, limits: CalibrationLimits) -> float:
    """Return the factor on standard deviations if the noise is below the least noise assumed."""
    return max(1.0, limits.min_noise_px / max(fit.sigma_px, np.finfo(float).tiny))


def _focus(deviation: float, limits: CalibrationLimits) -> str:
    """Warn of a weakly determined focal length."""
    if deviation < limits.max_focal_sigma:
        return ""
    return (
        f"the views determine the focal length to {100 * deviation:.1f} % only: add views at other angles, or give "
        "focal_length="
    )


def _centre_deviation(fit: CameraFit, limits: CalibrationLimits) -> float:
    """Return the standard deviation of the centre in its least determined direction [px]."""
    if "cx" not in fit.names:
        return 0.0
    first = fit.names.index("cx")
    largest = np.linalg.eigvalsh(fit.covariance[first : first + 2, first : first + 2])[-1]
    return float(math.sqrt(largest)) * _noise_factor(fit, limits)


def _centre(fit: CameraFit, limits: CalibrationLimits) -> str:
    """Warn of a weakly determined centre."""
    deviation = _centre_deviation(fit, limits)
    if deviation < limits.max_centre_sigma_px:
        return ""
    if "tauX" not in fit.names:
        return f"the centre is known to {_pixels(deviation, fit)} only: add views at other angles"
    tilt = math.degrees(fit.alpha_sigma)
    return (
        f"the distortion is too small to tell tilt from centre: the centre is known to {_pixels(deviation, fit)}, "
        f"the tilt to {min(tilt, 90.0):.2g} degrees, and their errors are correlated: give centre= if it is known"
    )


def _pixels(deviation: float, fit: CameraFit) -> str:
    return f"{deviation:.2g} px" if deviation < 2.0 * fit.camera.matrix[0][0] else "no pixel"


def _possible_tilt(fit: CameraFit, size: tuple[int, int], limits: CalibrationLimits) -> str:
    """Warn that a centre far from the image's middle can be the effect of a tilted sensor."""
    if "tauX" in fit.names or "cx" not in fit.names:
        return ""
    f, (column, row) = fit.camera.matrix[0][0], (fit.camera.matrix[0][2], fit.camera.matrix[1][2])
    shift = math.hypot(column - 0.5 * (size[0] - 1), row - 0.5 * (size[1] - 1))
    if shift < limits.max_centre_offset * math.hypot(*size) + 3.0 * _centre_deviation(fit, limits):
        return ""
    tilt = math.degrees(math.atan2(shift, f))
    return (
        f"the centre lies {shift:.0f} px from the image's middle: a sensor tilted by {tilt:.1f} degrees looks the same "
        "if the distortion is small; for a tilted sensor give model='tilt' and centre="
    )


def _equal_alternative(other: CameraAlternative, limits: CalibrationLimits) -> str:
    """Warn of an alternative model that fits equally well with another centre."""
    if other.p_value < limits.significance or other.centre_distance_px < limits.max_centre_sigma_px:
        return ""
    return (
        f"model {other.model!r} fits as well (rms {other.rms_px:.4f} px, p = {other.p_value:.2g}) "
        f"with its centre {other.centre_distance_px:.1f} px away"
    )


def _lack_of_fit(fit: CameraFit, limits: CalibrationLimits) -> str:
    """Warn of a smooth pattern in the residuals, which the model does not describe."""
    lack = fit.lack_of_fit
    if lack.p_value >= limits.lack_of_fit_significance or lack.rms_px <= limits.max_lack_of_fit * lack.noise_px:
        return ""
    return (
        f"the residuals form a smooth pattern of {lack.rms_px:.3g} pixels rms over the image, beside "
        f"{lack.noise_px:.3g} pixels of noise: the lens is not of model {fit.model}, or the target is not flat; the "
        "uncertainties include the pattern"
    )


def _differing_views(fit: CameraFit, limits: CalibrationLimits) -> str:
    """Warn of views that differ, where they are too few for a covariance by view."""
    if fit.view_p_value >= limits.lack_of_fit_significance or len(fit.poses) >= MIN_VIEWS:
        return ""
    return (
        f"the views differ by more than independent errors explain (p = {fit.view_p_value:.2g}), and {len(fit.poses)} "
        f"views are too few to include it in the uncertainties: give {MIN_VIEWS} or more, and check that the target is "
        "flat and still"
    )


def _folds(fit: CameraFit, size: tuple[int, int]) -> bool:
    """Return whether the lens folds within the image; tested at points along the border."""
    across, down = (np.linspace(0.0, last - 1.0, _BORDER_POINTS) for last in size)
    border = [(x, y) for x in across for y in down[[0, -1]]] + [(x, y) for x in across[[0, -1]] for y in down]
    return not np.isfinite(fit.camera.undistort(np.array(border))).all()


def _small_tilt(fit: CameraFit, limits: CalibrationLimits) -> str:
    """Warn of a tilt that is not significant, or too small to prove a tilted sensor."""
    if "tauX" not in fit.names:
        return ""
    block = fit.covariance[-2:, -2:]
    tau = np.array(fit.camera.distortion[12:])
    if tau @ np.linalg.solve(block, tau) > limits.significant_sigmas**2:
        alpha = math.degrees(math.hypot(*tau))
        if alpha > limits.min_tilt_degrees:
            return ""
        return f"a tilt of {alpha:.2g} degrees is no proof of a tilted sensor: decentred lenses (p1, p2) look the same"
    return (
        f"the tilt found, {math.degrees(math.hypot(*tau)):.2g} degrees, is within its own uncertainty: "
        "an untilted sensor fits as well"
    )
