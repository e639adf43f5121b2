"""Offset and rotation of a part on the nozzle, from rendered images of its leads."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision import RenderBoard
from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.shapes import area
from gpuvision.servoing.frames import Transform, compose_poses, invert_pose
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.workflows.locating_part import locate_part, part_artwork

PIXEL, SHAPE = 20e-6, (256, 320)
NOZZLE = Transform.rigid("pipette", "camera", (0.3e-3, -0.2e-3, 0.1), np.diag([1e-6, 1e-6, 1e-4]) ** 2)


def _rectangle(x: float, y: float, width: float, height: float) -> np.ndarray:
    return np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])


# A small outline package: four leads of 0.4 x 0.7 mm on each of two sides, one of them wider to break the symmetry.
LEADS = [_rectangle(-1.9e-3 + 1.1e-3 * k, side, 0.4e-3 + 0.15e-3 * (k == 0), 0.7e-3) for k in range(4) for side in
         (-2.0e-3, 1.3e-3)]  # fmt: skip


def _image(part_in_pipette: np.ndarray, device: Device, noise_number: int = 0) -> np.ndarray:
    drawing = part_artwork(LEADS)
    board = ReflectanceMap.of(drawing, pixel=PIXEL, region=((-5e-3, -5e-3), (5e-3, 5e-3)), blur_px=0.5)
    part_in_camera = compose_poses(NOZZLE.pose, part_in_pipette)
    render = RenderBoard(board=board, shape=SHAPE, sensor=read_cmos_sensor("pb1024"))
    camera = invert_pose(part_in_camera)[None, None].astype(np.float64 if device.has_double else np.float32)
    result = render(camera, np.array([noise_number], np.uint32), device=device)
    return to_numpy(result.image)[0]


def test_offset_and_rotation_of_a_picked_part(device: Device) -> None:
    planted = np.array([0.05e-3, -0.04e-3, 0.006])
    found = locate_part(
        _image(planted, device),
        part_artwork(LEADS),
        pixel=PIXEL,
        pipette_in_camera=NOZZLE,
        search_range=(0.07e-3, 0.01),
        blur_px=0.6,
        device=device,
    )
    assert found.reason == ""
    assert found.transform is not None
    assert (found.transform.source, found.transform.target) == ("part", "pipette")
    error = np.abs(found.transform.pose - planted)
    # The nozzle is exact here: its covariance is the larger part of the stated one.
    assert np.all(error <= 3.0 * np.sqrt(np.diag(found.transform.pose_covariance)))
    assert np.all(error[:2] < 1e-6)
    assert error[2] < 3e-4
    assert np.all(np.diag(found.transform.pose_covariance)[:2] >= 0.99e-12)


def test_drawing_from_above_is_mirrored() -> None:
    seen, above = part_artwork(LEADS), part_artwork([each * (-1, 1) for each in LEADS], mirrored=True)
    assert len(seen.edges.start) == len(above.edges.start) > 20
    for one, other in zip(seen.copper, above.copper, strict=True):
        assert {tuple(each) for each in one.outline} == {tuple(each) for each in other.outline}
    # All outlines are counter-clockwise, also the mirrored ones and those that are drawn clockwise.
    for artwork in (seen, above, part_artwork([each[::-1] for each in LEADS])):
        assert all(area(each.outline) > 0.0 for each in artwork.copper)
    # Edges of the two point out of the leads.
    centres = np.array([each.outline.mean(axis=0) for each in above.copper])[above.edges.pad]
    middle = (above.edges.start + above.edges.end) / 2
    assert np.all(np.sum((middle - centres) * above.edges.normal, axis=1) > 0)


def test_wrong_drawings_and_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="there is no outline"):
        part_artwork([])
    with pytest.raises(ValueError, match="three or more finite corners"):
        part_artwork([[[0, 0], [1, 1]]])
    with pytest.raises(ValueError, match="no area"):
        part_artwork([[[0, 0], [1, 1], [2, 2]]])
    with pytest.raises(ValueError, match="expected from pipette to camera"):
        locate_part(np.zeros((9, 9), np.uint8), part_artwork(LEADS), pixel=PIXEL, pipette_in_camera=NOZZLE.inverse())
