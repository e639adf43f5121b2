"""Tilt and focal length of a Scheimpflug camera whose lens is known (F. de Jong, section 3.3.7).

Vanishing points gave the lens: its distortion and the centre, where the optical axis meets the sensor. Points that it
has straightened come from the virtual pinhole camera of fig. 3.3, whose principal point lies f' sin(alpha) from the
centre in the direction of the tilt. A view of a flat target then fixes alpha and f' where that direction is known, by
linear equations in f' sin(alpha) and f'^2; the pose is Tsai's first stage; both are refined together.

Limits. The lens model is radial in the sensor; behind a real lens distortion is radial in the plane of the lens, which
differs the more, the larger tilt and distortion are. `fit_camera` with ``model="tilt"`` has the true order.
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
from gpuvision.camera.views.bundle_adjustment import Loss, State, Views, adjust
from gpuvision.camera.views.camera_fit import Pose, covariances, deviation_of_alpha, lens_poses, noise_of
from gpuvision.camera.views.initialization import closed_form_of_tilt, flatten
from gpuvision.camera.views.parameters import Chart
from gpuvision.camera.views.target_views import pack
from gpuvision.camera.views.tsai import fit_tsai

_NO_FOCUS = 0.3
_BEST_NOISE_PX = 0.01


@dataclass(frozen=True, kw_only=True)
class TiltFit:
    """The tilt of a sensor behind a known lens.

    Attributes
    ----------
    sensor
        alpha, its direction, f' and the virtual camera.
    lens
        The lens that was given.
    poses
        Of the targets, in the frame of the lens.
    names
        "f" (that is f'), "tauX", "tauY": what the covariance is of; without "f" where f' was given.
    covariance
        Pixels and radians.
    alpha_sigma
        Standard deviation of alpha, radians.
    rms_px
        Root mean square distance between straightened and projected points.
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
    """Find alpha, f' and the poses of flat targets once the lens is known.

    Parameters
    ----------
    views
        Per image (points on the target [m], points in the image [px]).
    lens
        From measured to undistorted pixels, its centre where the optical axis meets the sensor.
    direction
        Direction of the tilt in the image, radians from the columns' axis towards the rows' (or its opposite: alpha
        comes with the sign that the data have); None: to be found.
    focal_length
        f' where it is known, pixels. One view then suffices for the direction too.

    Raises
    ------
    ValueError
        The views do not fix what is sought.
    """
    if len(views) == 1 and direction is None and focal_length is None:
        raise ValueError("one view fixes two numbers of alpha, its direction and f': give direction=, or focal_length=")
    straight = [(target, lens.undistort(np.asarray(image).reshape(-1, 2))) for target, image in views]
    packed, _ = pack(straight)
    centre = np.array(lens.centre)
    radius = float(np.sqrt(np.max(np.sum((packed.seen - centre[:, None]) ** 2, axis=1))))
    homographies = flatten(packed, centre, radius, straight=True).homographies
    closed = closed_form_of_tilt(homographies, direction, None if focal_length is None else focal_length / radius)
    if closed is None:
        raise ValueError("no tilt and f' explain these views: are lens and direction right, and the target oblique?")
    f = radius * closed[0]
    values = np.zeros(11)
    values[:6] = [f, 1.0, *(centre + radius * closed[1]), *centre]
    chart = Chart(coefficients=(), tilt=True, centre=False, direction=direction, focal_length=focal_length)
    poses = [
        fit_tsai(target, seen, (values[2], values[3]), focal_length=f, distorted=False).pose
        for target, seen in straight
    ]
    state = State(values, np.array([pose.rotation for pose in poses]), np.array([pose.translation for pose in poses]))
    state = adjust(packed, chart, state, Loss())
    return _described(packed, chart, state, lens)


def _described(views: Views, chart: Chart, state: State, lens: Lens) -> TiltFit:
    covariance, _, focus = covariances(views, chart, state, Loss(), None)
    noise = noise_of(views, chart, state, Loss())
    if not focus * max(1.0, _BEST_NOISE_PX / max(noise, np.finfo(float).tiny)) < _NO_FOCUS:
        raise ValueError("the views do not fix f': a target oblique to the sensor, or focal_length=, is needed")
    sensor = TiltedSensor.from_virtual(
        float(state.numbers[0]), (state.numbers[2], state.numbers[3]), (state.numbers[4], state.numbers[5])
    )
    return TiltFit(
        sensor=sensor,
        lens=lens,
        poses=lens_poses(state),
        names=chart.names,
        covariance=covariance,
        alpha_sigma=deviation_of_alpha(sensor.tau, covariance[-2:, -2:]),
        rms_px=math.sqrt(2.0 * state.cost / views.coordinates),
    )
