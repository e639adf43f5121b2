"""Tilt and focal length of a Scheimpflug camera with a known lens.

The lens (distortion and centre) is known, for example from vanishing points. Undistorted points are image points of the
virtual pinhole camera (fig. 3.3), whose principal point lies at a distance f' sin(alpha) from the centre, in the
direction of the tilt. For a known direction one view of a flat target determines alpha and f' by linear equations in f'
sin(alpha) and f'^2. The pose is computed by the first stage of Tsai's method. Both are refined together.

Limits: The lens model is radial in the sensor plane. The distortion of a real lens is radial in the plane of the lens;
the difference increases with tilt and distortion. `fit_camera` with ``model="tilt"`` applies distortion and tilt in the
right order.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.7.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.camera.scheimpflug import TiltedSensor
from gpuvision.camera.tilted_projection import Floats
from gpuvision.camera.views.bundle_adjustment import FitState, PackedViews, RobustLoss, adjust
from gpuvision.camera.views.camera_fit import (
    Pose,
    alpha_standard_deviation,
    covariances,
    poses_in_lens_frame,
    residual_sigma,
)
from gpuvision.camera.views.initialization import fit_homographies, tilt_closed_form
from gpuvision.camera.views.parameters import FIT_PARAMETERS, FreeParameters
from gpuvision.camera.views.target_views import pack
from gpuvision.camera.views.tsai import fit_tsai

# Relative standard deviation of f above which the views do not determine it, and least noise [px] assumed for it.
_UNDETERMINED = 0.3
_MIN_NOISE_PX = 0.01


@dataclass(frozen=True, kw_only=True)
class TiltFit:
    """Tilt of a sensor behind a known lens.

    Attributes
    ----------
    sensor : TiltedSensor
        Sensor with alpha, direction, f' and the virtual camera.
    lens : Lens
        Known lens.
    poses : tuple of Pose
        Poses of the targets in the lens' frame.
    names : tuple of str
        Names of the estimated parameters: "f" (f'), "tauX", "tauY"; without "f" if f' was given.
    covariance : numpy.ndarray
        (m, m): covariance of these parameters [px], [rad].
    alpha_sigma : float
        Standard deviation of alpha [rad].
    rms_px : float
        Root mean square distance between undistorted and projected points [px].
    """

    sensor: TiltedSensor
    lens: Lens
    poses: tuple[Pose, ...]
    names: tuple[str, ...]
    covariance: Floats
    alpha_sigma: float
    rms_px: float


def fit_tilt(
    views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    lens: Lens,
    *,
    direction: float | None = None,
    focal_length: float | None = None,
) -> TiltFit:
    """Estimate alpha, f' and the poses of flat targets for a known lens.

    Parameters
    ----------
    views : sequence of View or pairs of array_like
        Per image: points on the target [m], and their image points [px].
    lens : Lens
        Lens from measured to undistorted pixels; its centre is the optical axis on the sensor.
    direction : float, optional
        Known direction of the tilt in the image, or its opposite [rad], from the columns' axis towards the rows'.
        Default: estimated.
    focal_length : float, optional
        Known f' [px]; one view then determines the direction as well. Default: estimated.

    Returns
    -------
    TiltFit

    Raises
    ------
    ValueError
        The views do not determine the parameters; the message names the missing data.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.7.
    """
    if len(views) == 1 and direction is None and focal_length is None:
        raise ValueError("one view fixes two numbers of alpha, its direction and f': give direction=, or focal_length=")
    undistorted = [(target, lens.undistort(np.asarray(image).reshape(-1, 2))) for target, image in views]
    packed, _ = pack(undistorted)
    centre = np.array(lens.centre)
    radius = float(np.sqrt(np.max(np.sum((packed.image - centre[:, None]) ** 2, axis=1))))
    homographies = fit_homographies(packed, centre, radius, undistorted=True).homographies
    closed = tilt_closed_form(homographies, direction, None if focal_length is None else focal_length / radius)
    if closed is None:
        raise ValueError(
            "no tilt and f' fit these views: check lens and direction; the target must be oblique to the sensor"
        )
    f = radius * closed[0]
    values = np.zeros(len(FIT_PARAMETERS))
    values[:6] = [f, 1.0, *(centre + radius * closed[1]), *centre]
    free_parameters = FreeParameters(
        coefficients=(), tilt=True, centre=False, direction=direction, focal_length=focal_length
    )
    poses = [
        fit_tsai(target, measured, (values[2], values[3]), focal_length=f, distorted=False).pose
        for target, measured in undistorted
    ]
    state = FitState(
        values, np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses])
    )
    state = adjust(packed, free_parameters, state, RobustLoss())
    return _result(packed, free_parameters, state, lens)


def _result(views: PackedViews, free_parameters: FreeParameters, state: FitState, lens: Lens) -> TiltFit:
    covariance, _, focus = covariances(views, free_parameters, state, RobustLoss(), None)
    noise = residual_sigma(views, free_parameters, state, RobustLoss())
    if not focus * max(1.0, _MIN_NOISE_PX / max(noise, np.finfo(float).tiny)) < _UNDETERMINED:
        raise ValueError("the views do not determine f': use a target oblique to the sensor, or give focal_length=")
    sensor = TiltedSensor.from_virtual(
        float(state.values[0]), (state.values[2], state.values[3]), (state.values[4], state.values[5])
    )
    return TiltFit(
        sensor=sensor,
        lens=lens,
        poses=poses_in_lens_frame(state),
        names=free_parameters.names,
        covariance=covariance,
        alpha_sigma=alpha_standard_deviation(sensor.tau, covariance[-2:, -2:]),
        rms_px=math.sqrt(2.0 * state.cost / views.coordinates),
    )
