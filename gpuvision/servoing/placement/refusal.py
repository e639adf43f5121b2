"""Reason why a target cannot be planned: where the camera looks, and the nearest target and window that work."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.placement.machine import Machine

Float64 = npt.NDArray[np.float64]

# Targets that are tried, and their least distance as a fraction of the window (cost: about 10 ms each).
_TRIED, _APART = 40, 0.25
_LANDED = 3  # targets and windows whose coarse registration is tried (cost: about 0.2 s each)
_LARGER = (1.5, 2.0, 3.0, 4.0)  # windows that are tried, relative to the given one


class Guidance(Protocol):
    """Selection of the features that guide a placement."""

    def works(self, camera_pose: Float64, machine: Machine) -> bool:
        """Return whether features guide a machine at a pose (3,) of its camera."""

    def lands(self, camera_pose: Float64, machine: Machine) -> bool:
        """Return whether the coarse registration finds all starts at a pose (3,) of the camera."""


def explain_refusal(
    reason: str, artwork: Artwork, target: Float64, camera_pose: Float64, machine: Machine, guidance: Guidance
) -> str:
    """Return why a target is refused, and how it can be mended.

    Parameters
    ----------
    reason : str
        Reason of the selection of the features; the part before the first semicolon is used.
    artwork : Artwork
        Side of the board that the camera sees.
    target, camera_pose : numpy.ndarray
        (3,): refused pose of the nozzle on the board, and pose of the camera, x, y [m], theta [rad].
    machine : Machine
        Machine.
    guidance : Guidance
        Selection of the features at another pose of the camera.
    """
    rows, columns = machine.camera.window
    height, width = (each * machine.camera.pixel for each in machine.camera.window)
    (left, bottom), (right, top) = 1e3 * artwork.bounds
    lines = [
        f"target ({_mm(target)}) mm: {reason.split(';')[0]}",
        f"the camera window of {1e3 * width:.2f} x {1e3 * height:.2f} mm is centred at ({_mm(camera_pose)}) mm; the "
        f"board spans x {left:.2f} to {right:.2f} mm and y {bottom:.2f} to {top:.2f} mm",
    ]
    near = _nearest_target(artwork, target, camera_pose, machine, guidance)
    if near is not None:
        lines.append(f"the nearest target found that has enough edges in view is ({_mm(near)}) mm")
    larger = _smallest_window(camera_pose, machine, guidance)
    if larger is not None:
        lines.append(f"a window of {larger[0]} x {larger[1]} px instead of {rows} x {columns} px has enough")
    return "; ".join(lines)


def _nearest_target(
    artwork: Artwork, target: Float64, camera_pose: Float64, machine: Machine, guidance: Guidance
) -> Float64 | None:
    """Return the nearest target at which the camera looks at a pad or at the end of an edge, and which works."""
    pads = np.array([pad.centre for pad in artwork.pads]).reshape(-1, 2)
    points = np.concatenate([pads, artwork.edges.start, artwork.edges.end])
    points = points[np.argsort(np.linalg.norm(points - camera_pose[:2], axis=1))]
    apart = _APART * min(machine.camera.window) * machine.camera.pixel
    landed = 0
    for _ in range(_TRIED):
        if not len(points) or landed == _LANDED:
            return None
        first = np.array([*points[0], camera_pose[2]])
        if guidance.works(first, machine):
            if guidance.lands(first, machine):
                return np.asarray(target + first - camera_pose)
            landed += 1
        points = points[np.linalg.norm(points - points[0], axis=1) > apart]
    return None


def _smallest_window(camera_pose: Float64, machine: Machine, guidance: Guidance) -> tuple[int, int] | None:
    """Return the rows and columns of the smallest larger window that works within the sensor and the frame time."""
    for factor in _LARGER:
        rows, columns = (round(factor * each) for each in machine.camera.window)
        try:
            larger = replace(machine, camera=replace(machine.camera, window=(rows, columns)))
        except ValueError:
            return None  # beyond the sensor, or the frame takes too long
        if guidance.works(camera_pose, larger) and guidance.lands(camera_pose, larger):
            return rows, columns
    return None


def _mm(pose: Float64) -> str:
    return f"{1e3 * pose[0]:.3f}, {1e3 * pose[1]:.3f}"
