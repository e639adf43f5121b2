"""What a calibration's data cannot tell, in words: a small residual does not prove a camera."""

from __future__ import annotations

import math

import numpy as np

from gpuvision.camera.views.camera_fit import Alternative, CameraFit

# Points are seldom measured better, however well a simulation may fit: below, uncertainties are no diagnosis.
_BEST_NOISE_PX = 0.01
_LOOSE_FOCUS = 0.02
_LOOSE_CENTRE_PX = 3.0
_NO_FOCUS = 0.3
_FAR_CENTRE = 0.1
_LEVEL = 0.001
_TOO_NOISY = 1.2
_SIGNIFICANT = 3.0
_BORDER_POINTS = 17
# Lenses are assembled no better, and sensors not tilted by so little on purpose.
_ASSEMBLY_DEGREES = 1.0


def diagnose(
    fit: CameraFit, size: tuple[int, int], *, focus: float, settled: bool, noise: float, outliers: int, mirrored: bool
) -> tuple[str, ...]:
    """Return one sentence for each thing that the data leave open.

    Parameters
    ----------
    fit
        The calibration, its warnings yet empty.
    size
        (columns, rows) of the images.
    focus
        Relative deviation of the virtual camera's f.
    settled
        Whether the fit found its end.
    noise
        What the residual says of the noise of one coordinate, pixels.
    outliers
        Points farther from their place than noise leads, in a fit that trusts every point.
    mirrored
        Whether the target is seen from its other side in every view.
    """
    said = [
        _focus(focus * _floor(fit)),
        _centre(fit),
        _tilt_instead(fit, size),
        *(_as_good(fit, each) for each in fit.alternatives),
        _small_tilt(fit),
    ]
    if _folds(fit, size):
        said.append("the lens polynomial folds within the image: points beyond the fold cannot be undistorted")
    if not settled:
        said.append("the fit had not settled when it was stopped: the uncertainties are those of where it stood")
    if noise > _TOO_NOISY * fit.sigma:
        said.append(f"the residual is {noise / fit.sigma:.1f} times the noise given: the model does not suffice")
    if outliers:
        said.append(f"{outliers} points lie farther off than noise leads: look at the residuals, or take loss='tukey'")
    if mirrored:
        said.append(
            "the target is seen from behind (its Z axis points at the camera): y runs upwards on it, or the images are "
            "mirrored and the camera found is the mirrored one"
        )
    return tuple(each for each in said if each)


def fixes_focus(fit: CameraFit, focus: float, *, settled: bool) -> bool:
    """Whether the data fix the focal length at all. A fit that found no end had better know it well."""
    return focus * _floor(fit) < (_NO_FOCUS if settled else _LOOSE_FOCUS)


def _floor(fit: CameraFit) -> float:
    """Return by how much deviations grow at the noise that is to be expected at the best."""
    return max(1.0, _BEST_NOISE_PX / max(fit.sigma, np.finfo(float).tiny))


def _focus(loose: float) -> str:
    if loose < _LOOSE_FOCUS:
        return ""
    return f"the views fix the focal length to {100 * loose:.1f} % only: add views at other angles, or focal_length="


def _loose_centre(fit: CameraFit) -> float:
    """Return the standard deviation of the centre in the direction in which it is known least, pixels."""
    if "cx" not in fit.names:
        return 0.0
    first = fit.names.index("cx")
    largest = np.linalg.eigvalsh(fit.covariance[first : first + 2, first : first + 2])[-1]
    return float(math.sqrt(largest)) * _floor(fit)


def _centre(fit: CameraFit) -> str:
    loose = _loose_centre(fit)
    if loose < _LOOSE_CENTRE_PX:
        return ""
    if "tauX" not in fit.names:
        return f"the centre is known to {_pixels(loose, fit)} only: add views at other angles"
    tilt = math.degrees(fit.alpha_sigma)
    return (
        f"the lens bends too little to tell tilt from centre: the centre is known to {_pixels(loose, fit)}, "
        f"the tilt to {min(tilt, 90.0):.2g} degrees, one trading for the other: give centre= if it is known"
    )


def _pixels(loose: float, fit: CameraFit) -> str:
    return f"{loose:.2g} px" if loose < 2.0 * fit.camera.matrix[0][0] else "no pixel"


def _tilt_instead(fit: CameraFit, size: tuple[int, int]) -> str:
    """Say that a centre far from the image's middle is what a tilted sensor looks like."""
    if "tauX" in fit.names or "cx" not in fit.names:
        return ""
    f, (column, row) = fit.camera.matrix[0][0], (fit.camera.matrix[0][2], fit.camera.matrix[1][2])
    aside = math.hypot(column - 0.5 * (size[0] - 1), row - 0.5 * (size[1] - 1))
    if aside < _FAR_CENTRE * math.hypot(*size) + 3.0 * _loose_centre(fit):
        return ""
    tilt = math.degrees(math.atan2(aside, f))
    return (
        f"the centre lies {aside:.0f} px from the image's middle: a sensor tilted by {tilt:.1f} degrees looks the same "
        "where the lens bends too little; if it is tilted, give model='tilt' and centre="
    )


def _as_good(fit: CameraFit, other: Alternative) -> str:
    """Say which model fits as well, and lies elsewhere."""
    if other.p_value < _LEVEL or other.centre_distance_px < _LOOSE_CENTRE_PX:
        return ""
    return (
        f"model {other.model!r} fits as well (rms {other.rms_px:.4f} px, p = {other.p_value:.2g}) "
        f"with its centre {other.centre_distance_px:.1f} px away"
    )


def _folds(fit: CameraFit, size: tuple[int, int]) -> bool:
    """Whether the lens folds before the image's border: tried at the corners and some points between."""
    across, down = (np.linspace(0.0, last - 1.0, _BORDER_POINTS) for last in size)
    border = [(x, y) for x in across for y in down[[0, -1]]] + [(x, y) for x in across[[0, -1]] for y in down]
    return not np.isfinite(fit.camera.undistort(np.array(border))).all()


def _small_tilt(fit: CameraFit) -> str:
    if "tauX" not in fit.names:
        return ""
    block = fit.covariance[-2:, -2:]
    tau = np.array(fit.camera.distortion[12:])
    if tau @ np.linalg.solve(block, tau) > _SIGNIFICANT**2:
        alpha = math.degrees(math.hypot(*tau))
        if alpha > _ASSEMBLY_DEGREES:
            return ""
        return f"a tilt of {alpha:.2g} degrees is no proof of a tilted sensor: decentred lenses (p1, p2) look the same"
    return (
        f"the tilt found, {math.degrees(math.hypot(*tau)):.2g} degrees, is within its own uncertainty: "
        "an untilted sensor fits as well"
    )
