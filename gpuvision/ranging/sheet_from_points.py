"""Sheet of light from known points: the pose of a fixture whose lit points are known, in one or more laser images.

The points lie in the sheet of light and are known in the frame of the fixture. Their image points give the pose of this
frame (`gpuvision.camera.views.pose_response.fit_pose`), and the plane of the points is the sheet. The error of the
sheet follows from the error of the pose.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.pose_response import fit_pose
from gpuvision.ranging.sheet_readings import Along, sheet_axes
from gpuvision.ranging.sheet_result import SHEET_PARAMETERS, SheetFit

Float64 = npt.NDArray[np.float64]

# Distance of a known point from the plane of all of them, relative to their extent, above which they are no plane
# (chosen: a sheet bends less).
_MAX_OUT_OF_PLANE = 0.02


def sheet_from_points(
    camera: Camera,
    points: npt.ArrayLike,
    pixels: npt.ArrayLike,
    *,
    along: Along = "columns",
    names: Sequence[str] = (),
) -> SheetFit:
    """Fit the plane of a sheet of light to known points in it.

    Parameters
    ----------
    camera : Camera
        Calibrated camera.
    points : array_like
        (n, 3): points of the sheet in the frame of a fixture [m], four at least, in one plane and not on one line.
    pixels : array_like
        (n, 2): measured (column, row) of the points [px].
    along : {"columns", "rows"}
        Image axis along which the laser line runs.
    names : sequence of str
        Parameters of the camera with a covariance, as in `CameraFit.names`.

    Returns
    -------
    SheetFit
        A plane; without a test of a bend.

    Raises
    ------
    ValueError
        The points do not determine a pose, or lie in no plane.
    """
    known, measured = np.asarray(points, dtype=np.float64), np.asarray(pixels, dtype=np.float64)
    target, errors = fit_pose(camera, names, known, measured)
    rotation, translation = target.pose
    placed = known @ rotation.T + translation
    origin = placed.mean(axis=0)
    _, extents, axes = np.linalg.svd(placed - origin, full_matrices=False)
    if np.abs((placed - origin) @ axes[2]).max() > _MAX_OUT_OF_PLANE * extents[0] / math.sqrt(len(placed)):
        raise ValueError("the known points lie in no plane, but the sheet of light is one")
    g, h, n = sheet_axes(origin, axes, placed, measured[:, 0 if along == "columns" else 1])
    # A change (w, t) of the pose moves a point P by w x (P - T) + t.
    lever = origin - translation
    by_pose = np.stack(
        [
            np.concatenate([np.cross(lever, n), n]),
            np.concatenate([np.cross(g, n), np.zeros(3)]),
            np.concatenate([np.cross(h, n), np.zeros(3)]),
        ]
    )
    return SheetFit(
        origin=origin,
        g_axis=g,
        h_axis=h,
        bend=None,
        names=SHEET_PARAMETERS[:3],
        noise_covariance=by_pose @ target.covariance @ by_pose.T,
        by_camera=by_pose @ target.by_camera,
        sigma_px=math.sqrt(float(np.sum(errors**2)) / (errors.size - 6)),
        view_ratio=1.0,
        bend_test=None,
        residuals=(errors[:, 1 if along == "columns" else 0],),
        coordinates=((placed - origin) @ np.stack([g, h]).T,),
    )
