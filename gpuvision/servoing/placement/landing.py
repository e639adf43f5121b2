"""Check of the coarse registration of a placement on ideal images, before the head moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.pose.coarse_registration import CoarseRegistration
from gpuvision.servoing.frames import compose_poses, invert_pose
from gpuvision.servoing.placement.board_renderer import board_renderer
from gpuvision.servoing.placement.machine import Machine
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

# Start poses that are tried, as fractions of the landing zone in x, y and theta (chosen): the target and four corners,
# each angle with each side. At a corner a repeated pattern has most of the search range on one side.
_STARTS = np.array([(0, 0, 0), (1, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)], np.float64)
# Part of the landing zone at which the corners lie (chosen): the image of the corner itself may leave the search range.
_CORNER = 0.9
# Nodes of the rendered board per pixel: edges then lie within a few hundredths of a pixel, far below the tolerance.
_NODES = 2


def refused_starts(
    artwork: Artwork,
    camera_pose: Float64,
    machine: Machine,
    landing: CoarseRegistration,
    *,
    reflectance: BoardReflectance | None = None,
    device: Device | None = None,
) -> list[Status]:
    """Return the flags of the start poses in the landing zone that a coarse registration refuses.

    Parameters
    ----------
    artwork : Artwork
        Side of the board in view.
    camera_pose : numpy.ndarray
        (3,): pose of the camera over the board at the release.
    machine : Machine
        Machine over this side.
    landing : CoarseRegistration
        Search for the pose of the first frame.
    reflectance : BoardReflectance, optional
        Reflectances of the board. Default: `BoardReflectance`.
    device : Device, optional
        Where to render and search; None: `Device.best`.

    Returns
    -------
    list of Status
        Flags of the refused ones of five starts: the target, and four corners of the landing zone. AMBIGUOUS: another
        pose in the search range fits as well, such as a repeated pattern.

    Notes
    -----
    The images have no noise and no distortion, and show the board as drawn. Cost: about 0.2 s for 512 x 512 pixels.
    """
    camera, tolerance = replace(machine.camera, lens=None), machine.tolerance
    zone = _CORNER * np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
    calibrated = machine.pipette_in_camera.pose
    nozzle = compose_poses(camera_pose, calibrated) + zone * _STARTS
    poses = compose_poses(nozzle, invert_pose(calibrated))
    half = float(np.hypot(*camera.window)) / 2.0 * camera.pixel
    seen = (poses[:, :2].min(axis=0) - half, poses[:, :2].max(axis=0) + half)
    board = ReflectanceMap.of(
        artwork,
        pixel=camera.pixel,
        region=seen,
        blur_px=camera.blur_px,
        nodes_per_pixel=_NODES,
        reflectance=reflectance,
    )
    render = board_renderer(board, camera, noise=False)
    images = to_numpy(render(poses[:, None], np.zeros(len(poses), np.uint32), device=device).image)
    found = [landing(image, device=device).status & ~Status.NOT_CONVERGED for image in images]
    return [Status(each) for each in found if each]
