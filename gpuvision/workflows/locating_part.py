"""Rotation and offset of a part on the nozzle, from the image of a camera that looks up at it.

The leads, pads or the outline of the package's own drawing take the place of the artwork of a board.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.5.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, Holes
from gpuvision.matching.artwork.edges import board_edges
from gpuvision.matching.artwork.shapes import Layer, Shape, area
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.board.measurement_result import Copper
from gpuvision.servoing.frames import CAMERA, PIPETTE, Transform, compose_poses, invert_pose
from gpuvision.validation import numbers
from gpuvision.workflows.locating_board import locate_board

Float64 = npt.NDArray[np.float64]

PART = "part"
"""Frame of a part: origin and axes of the package's drawing [m]."""


class LocatedPart(NamedTuple):
    """Pose of a part on the nozzle.

    Attributes
    ----------
    transform : Transform or None
        From "part" to "pipette": its pose is offset and rotation of the part, with covariance. None if refused.
    reason : str
        Reason of a refusal; empty for a pose.
    located : LocatedBoard
        Measurement, with the drawing as artwork.
    """

    transform: Transform | None
    reason: str
    located: LocatedBoard


def part_artwork(outlines: Sequence[npt.ArrayLike], *, mirrored: bool = False, clearance: float = 50e-6) -> Artwork:
    """Return the drawing of a package as an artwork whose copper are its leads, pads or body.

    Parameters
    ----------
    outlines : sequence of array_like
        Corners (n, 2) of each lead, pad or body [m], in any sense.
    mirrored : bool
        The drawing is a view from above: x changes its sign, because the camera looks up. Default False.
    clearance : float
        Distance that an edge keeps from other outlines [m], default 50 um.

    Raises
    ------
    ValueError
        There is no outline, or an outline has fewer than three corners, a wrong shape or no area.
    """
    shapes = []
    for each in outlines:
        corners = np.array(each, np.float64)
        if corners.ndim != 2 or corners.shape[1:] != (2,) or len(corners) < 3 or not np.all(np.isfinite(corners)):
            raise ValueError(f"an outline has shape {corners.shape}, expected three or more finite corners (n, 2)")
        corners[:, 0] *= -1.0 if mirrored else 1.0
        if area(corners) == 0.0:
            raise ValueError("an outline has no area")
        shapes.append(Shape(corners if area(corners) > 0.0 else corners[::-1].copy()))
    if not shapes:
        raise ValueError("there is no outline, expected a lead, pad or body at least")
    copper, every = tuple(shapes), np.concatenate([each.outline for each in shapes])
    none = np.zeros((0, 2))
    edges = board_edges((), [each.outline for each in copper], Layer(copper), None, Layer(()), clearance)
    return Artwork(
        side="top",
        copper=copper,
        mask=(),
        silk=(),
        holes=Holes(none, none, np.zeros(0), np.zeros(0, np.int8)),
        pads=(),
        edges=edges,
        bounds=np.stack([every.min(axis=0), every.max(axis=0)]),
    )


def locate_part(
    image: npt.NDArray[Any],
    drawing: Artwork,
    *,
    pixel: float,
    pipette_in_camera: Transform,
    expected: npt.ArrayLike = (0.0, 0.0, 0.0),
    search_range: tuple[float, float] = (2e-4, 0.02),
    blur_px: float = 1.0,
    size_sigma: float = 10e-6,
    leads: Copper = "bright",
    device: Device | None = None,
) -> LocatedPart:
    """Measure offset and rotation of a part on the nozzle.

    Parameters
    ----------
    image : numpy.ndarray
        Image of the camera that looks up, as `locate_board` takes it.
    drawing : Artwork
        Result of `part_artwork`.
    pixel : float
        Size of a pixel in the plane of the leads [m].
    pipette_in_camera : Transform
        From "pipette" to "camera": the nozzle in the frame of this camera (origin at the image centre, x along
        increasing columns, y along decreasing rows).
    expected : array_like
        (3,): expected pose of the part in the frame of the nozzle. Default: centred.
    search_range : (float, float)
        Largest offset [m] and rotation [rad] from the expected pose. Default 0.2 mm and 0.02 rad.
        Beyond 0.25 mm or 1 degree a coarse registration comes first; within them small leads may have no room for
        rulers.
    blur_px : float
        Standard deviation of the blur of edges [px], default 1.
    size_sigma : float
        Standard deviation of the distance of the real edges from the drawn ones [m], common to all edges;
        default 10 um.
    leads : {"bright", "dark", "auto"}
        Grey level of the leads relative to their surroundings. Default "bright".
    device : Device, optional
        Where to run; None: `Device.best`.

    Returns
    -------
    LocatedPart

    Raises
    ------
    ValueError
        A frame or a parameter is wrong, or too few edges are in view.
    TypeError
        ``expected`` is not a list of three numbers.
    """
    if (pipette_in_camera.source, pipette_in_camera.target) != (PIPETTE, CAMERA):
        raise ValueError(
            f"pipette_in_camera leads from {pipette_in_camera.source!r} to {pipette_in_camera.target!r}, expected from "
            "pipette to camera"
        )
    part_in_camera = compose_poses(pipette_in_camera.pose, np.array(numbers(expected, (3,), "expected")))
    x, y, theta = invert_pose(part_in_camera).tolist()
    located = locate_board(
        image,
        drawing,
        scale=pixel,
        initial_pose=(x, y, theta),
        search_range=search_range,
        blur_px=blur_px,
        etch_bias_sigma=size_sigma,
        copper=leads,
        device=device,
    )
    if located.reason:
        return LocatedPart(None, located.reason, located)
    camera_in_part = Transform.rigid(CAMERA, PART, located.view.pose, located.covariance)
    return LocatedPart(pipette_in_camera.inverse() @ camera_in_part.inverse(), "", located)
