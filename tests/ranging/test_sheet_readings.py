"""Readings of a laser line on known planes: their points, weights and derivatives, and the first plane and its axes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.camera_fit import Pose
from gpuvision.camera.views.pose_response import PoseResponse, change_camera
from gpuvision.ranging.sheet_readings import (
    DEFAULT_LIMITS,
    LaserLine,
    SheetFrame,
    SheetReadings,
    robust_plane,
    sheet_axes,
    triangulate,
    turn_to_image,
)

CAMERA = Camera(
    matrix=((900.0, 0.0, 320.0), (0.0, 880.0, 240.0), (0.0, 0.0, 1.0)), distortion=(-0.1, 0.05, *(0.0,) * 12)
)


def target(turn: Any, translation: Any) -> PoseResponse:
    pose = Pose(Rotation.from_rotvec(turn).as_matrix(), np.array(translation, float))
    return PoseResponse(pose, 1e-10 * np.eye(6), np.zeros((6, 0)))


def test_a_moved_frame_has_the_plane_of_its_change(rng: np.random.Generator) -> None:
    frame = SheetFrame(np.array([0.1, -0.2, 0.4]), Rotation.from_rotvec([0.3, -0.4, 0.9]).as_matrix())
    change = np.array([0.02, 0.3, -0.2, 7.0, 8.0, 9.0])
    moved = frame.moved(change)
    g, h = rng.normal(size=(2, 30))
    heights = change[0] + change[1] * g + change[2] * h
    points = frame.origin + np.stack([g, h, heights], axis=1) @ frame.axes
    np.testing.assert_allclose((points - moved.origin) @ moved.axes[2], 0.0, atol=1e-14)
    np.testing.assert_allclose(moved.axes @ moved.axes.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(np.cross(moved.axes[0], moved.axes[1]), moved.axes[2], atol=1e-14)
    np.testing.assert_allclose(moved.origin, frame.origin + 0.02 * frame.axes[2], atol=1e-15)
    # g stays in its plane with the normal: only tilted, not turned.
    assert moved.axes[0] @ np.cross(frame.axes[0], moved.axes[2]) == pytest.approx(0.0, abs=1e-14)
    assert moved.axes[2] @ frame.axes[2] > 0.9


@pytest.mark.parametrize(("along", "sample"), [("columns", 0), ("rows", 1)])
def test_readings_meet_the_lit_surfaces(along: Any, sample: int, rng: np.random.Generator) -> None:
    """Each point is on its viewing ray, and at its height over the target, towards the camera on either side of it."""
    pixels = [rng.uniform([100.0, 80.0], [500.0, 400.0], (n, 2)) for n in (20, 15, 18, 16)]
    one, two = target((0.2, -0.3, 0.4), (0.02, -0.01, 0.5)), target((3.3, 0.1, 0.0), (0.01, 0.02, 0.4))
    heights = rng.uniform(0.0, 0.02, 20)
    lines = [
        LaserLine(pixels[0], one, heights),
        LaserLine(pixels[1], one),
        LaserLine(pixels[2], two, 0.01),
        LaserLine(pixels[3], two),
    ]
    found = triangulate(CAMERA, lines, along, (), DEFAULT_LIMITS)
    np.testing.assert_array_equal(found.view, np.repeat(np.arange(4), [20, 15, 18, 16]))
    assert found.pose == (0, 0, 1, 1)
    assert found.targets == (one, two)
    seen = np.concatenate(pixels)
    np.testing.assert_array_equal(found.along, seen[:, sample])
    # A line of 15 readings is too short.
    np.testing.assert_array_equal(found.weight, np.repeat([1.0, 0.0, 1.0, 1.0], [20, 15, 18, 16]))
    rays = CAMERA.rays(seen)
    np.testing.assert_allclose(found.ray, rays, rtol=1e-12)
    np.testing.assert_allclose(np.cross(found.point, rays), 0.0, atol=1e-14)
    assert np.all(np.sum(found.point * rays, axis=1) > 0.0)
    raised = np.concatenate([heights, np.zeros(15), np.full(18, 0.01), np.zeros(16)])
    for view, line in enumerate(lines):
        rotation, translation = line.target.pose
        mine = found.view == view
        over = (found.point[mine] - translation) @ rotation[:, 2]
        camera_side = np.sign(-translation @ rotation[:, 2])
        np.testing.assert_allclose(over * camera_side, raised[mine], atol=1e-14)
        np.testing.assert_array_equal(found.normal[mine], np.tile(rotation[:, 2], (mine.sum(), 1)))
    step = np.array([0.0, 0.5]) if along == "columns" else np.array([0.5, 0.0])
    np.testing.assert_allclose(found.slope, CAMERA.rays(seen + step) - CAMERA.rays(seen - step), rtol=1e-12)
    assert found.by_camera.shape == (69, 3, 0)
    named = triangulate(CAMERA, lines, along, ("k1", "k2"), DEFAULT_LIMITS)
    for number, name in enumerate(("k1", "k2")):
        ahead, behind = (change_camera(CAMERA, name, each).rays(seen) for each in (1e-5, -1e-5))
        np.testing.assert_allclose(named.by_camera[..., number], (ahead - behind) / 2e-5, rtol=1e-4, atol=1e-9)


def test_readings_behind_the_camera_have_no_weight(rng: np.random.Generator) -> None:
    pixels = rng.uniform([100.0, 80.0], [500.0, 400.0], (16, 2))
    front, back = target((0.2, 0.0, 0.0), (0.0, 0.0, 0.5)), target((0.2, 0.0, 0.0), (0.0, 0.0, -0.5))
    found = triangulate(CAMERA, [LaserLine(pixels, front), LaserLine(pixels, back)], "columns", (), DEFAULT_LIMITS)
    np.testing.assert_array_equal(found.weight, np.repeat([1.0, 0.0], 16))


def test_readings_next_to_the_fold_of_the_lens_have_no_weight(rng: np.random.Generator) -> None:
    """They have a ray, but half a pixel across the line on there is none: no derivative."""
    camera = replace(CAMERA, distortion=(-0.5, *(0.0,) * 13))
    rows = np.arange(240.0, 2000.0, 0.1)
    known = np.isfinite(camera.rays(np.stack([np.full_like(rows, 320.0), rows], axis=1))).all(axis=1)
    last = rows[known].max()
    assert not known.all()
    pixels = rng.uniform([100.0, 80.0], [500.0, 300.0], (18, 2))
    pixels[:3] = [[320.0, last - 0.3], [320.0, last - 0.7], [320.0, last + 1.0]]
    one, two = target((0.2, 0.0, 0.0), (0.0, 0.0, 0.5)), target((0.2, 0.1, 0.0), (0.0, 0.0, 0.4))
    found = triangulate(camera, [LaserLine(pixels, one), LaserLine(pixels, two)], "columns", (), DEFAULT_LIMITS)
    np.testing.assert_array_equal(found.weight[:18], [0.0, 1.0, 0.0, *[1.0] * 15])
    assert np.isfinite(found.ray[0]).all()


def test_one_target_needs_steps(rng: np.random.Generator) -> None:
    pixels = rng.uniform([100.0, 80.0], [500.0, 400.0], (16, 2))
    plane = target((0.2, 0.0, 0.0), (0.0, 0.0, 0.5))
    for height in (0.0, 0.01, np.full(16, 0.01)):
        with pytest.raises(ValueError, match="read on 1 targets, expected two at least"):
            triangulate(CAMERA, [LaserLine(pixels, plane, height)], "columns", (), DEFAULT_LIMITS)
    triangulate(CAMERA, [LaserLine(pixels, plane, np.r_[np.zeros(8), np.full(8, 1e-3)])], "columns", (), DEFAULT_LIMITS)
    with pytest.raises(ValueError, match="read on 0 targets"):
        triangulate(CAMERA, [LaserLine(pixels[:15], plane)] * 2, "columns", (), DEFAULT_LIMITS)


def readings_of(points: np.ndarray, along: np.ndarray | None = None) -> SheetReadings:
    """Return readings with given points."""
    count = len(points)
    nothing = np.zeros((count, 3))
    return SheetReadings(
        lines=(),
        view=np.zeros(count, np.intp),
        targets=(),
        pose=(),
        ray=nothing,
        slope=nothing,
        by_camera=np.zeros((count, 3, 0)),
        point=points,
        normal=nothing,
        along=np.zeros(count) if along is None else along,
        weight=np.ones(count),
    )


def test_the_first_plane_withstands_outliers(rng: np.random.Generator) -> None:
    """40 % of the points are 2 to 20 mm off; points without weight do not count."""
    axes = Rotation.from_rotvec([0.4, 0.2, -0.5]).as_matrix()
    flat = np.stack([rng.uniform(-0.05, 0.05, 300), rng.uniform(-0.02, 0.02, 300), rng.normal(0.0, 1e-5, 300)], axis=1)
    flat[:120, 2] += rng.uniform(2e-3, 2e-2, 120)
    points = np.array([0.01, 0.02, 0.4]) + flat @ axes
    points = np.concatenate([points, rng.uniform(-1.0, 1.0, (400, 3))])
    readings = replace(readings_of(points), weight=np.r_[np.ones(300), np.zeros(400)])
    frame = robust_plane(readings, DEFAULT_LIMITS)
    assert abs(frame.axes[2] @ axes[2]) > 1.0 - 1e-6
    assert abs((frame.origin - [0.01, 0.02, 0.4]) @ axes[2]) < 1e-4
    # The principal axes: the longer extent first.
    assert abs(frame.axes[0] @ axes[0]) > 0.95
    np.testing.assert_allclose(np.abs(np.linalg.det(frame.axes)), 1.0, atol=1e-12)


@pytest.mark.parametrize(("ratio", "is_refused"), [(0.019, True), (0.021, False)])
def test_points_on_one_line_are_no_plane(ratio: float, is_refused: bool) -> None:
    """A second extent of 2 % of the first one is the least."""
    along = np.linspace(-1.0, 1.0, 101)
    across = ratio * np.sqrt(along @ along / 101) * np.where(np.arange(101) % 2 == 0, 1.0, -1.0)
    across -= across.mean()
    points = np.stack([along, across, np.full(101, 3.0)], axis=1)
    if is_refused:
        with pytest.raises(ValueError, match="all laser lines lie on one line in space"):
            robust_plane(readings_of(points), DEFAULT_LIMITS)
    else:
        robust_plane(readings_of(points), DEFAULT_LIMITS)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_axes_follow_the_samples_and_the_camera(side: float, rng: np.random.Generator) -> None:
    """g is the direction in which the sample number grows fastest, h leads towards the camera, which is at 0."""
    origin = np.array([0.02, 0.1 * side, 0.5])
    turn = Rotation.from_rotvec([0.3, 0.1, 0.2]).as_matrix()
    flat = rng.uniform(-0.05, 0.05, (40, 2))
    points = origin + flat @ turn[:2]
    sample = 500.0 + 3000.0 * flat[:, 0] - 4000.0 * flat[:, 1]
    g, h, n = sheet_axes(origin, turn, points, sample)
    np.testing.assert_allclose(g, 0.6 * turn[0] - 0.8 * turn[1], atol=1e-12)
    assert h @ origin < 0.0
    assert abs(h @ g) < 1e-12
    np.testing.assert_allclose(n, np.cross(g, h), atol=1e-15)
    np.testing.assert_allclose(np.abs(n @ turn[2]), 1.0, atol=1e-12)
    off = np.concatenate([points, rng.uniform(-1.0, 1.0, (20, 3))])
    readings = replace(
        readings_of(off, np.r_[sample, rng.uniform(0, 900, 20)]), weight=np.r_[np.ones(40), np.zeros(20)]
    )
    turned = turn_to_image(SheetFrame(origin, turn), readings)
    np.testing.assert_array_equal(turned.origin, origin)
    np.testing.assert_allclose(turned.axes, [g, h, n], atol=1e-12)
