"""Corners of a chessboard step by step: saddle points, squares about corners, Foerstner's points, the white level."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.patterns.chessboard import (
    ChessboardLimits,
    _find_saddles,
    _foerstner_points,
    _has_chequered_squares,
    _white_level,
)

LIMITS = ChessboardLimits()


def saddles(shape: tuple[int, int], *parts: tuple[float, float, float, float]) -> np.ndarray:
    """Return grey levels 100 + sum of a saddle s (x' y') within 9 px, turned by an angle; parts are x, y, s, angle."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    grey = np.full(shape, 100.0)
    for column, row, size, angle in parts:
        u = (x - column) * np.cos(angle) + (y - row) * np.sin(angle)
        v = (y - row) * np.cos(angle) - (x - column) * np.sin(angle)
        grey += size * u * v * np.exp(-0.5 * (u**2 + v**2) / 9.0)
    return grey.astype(np.float32)


def test_saddles_and_twice_their_angle() -> None:
    """A saddle u v has its principal curvatures at 45 degrees from u: their double angle is 90 degrees further."""
    parts = [(30, 40, 4.0, 0.0), (80, 35, -3.0, 0.3), (55, 75, 2.0, -0.5)]
    places, orientation = _find_saddles(saddles((110, 120), *parts), LIMITS)
    strong = [int(np.argmin(np.hypot(*(places - part[:2]).T))) for part in parts]
    np.testing.assert_array_equal(places[strong], [part[:2] for part in parts])
    assert strong == [0, 1, 2]  # the strongest first
    angles = [2.0 * part[3] + np.pi / 2 * np.sign(part[2]) for part in parts]
    np.testing.assert_allclose(orientation[strong], np.stack([np.cos(angles), np.sin(angles)], axis=1), atol=0.02)
    np.testing.assert_allclose(np.hypot(*orientation.T), 1.0)


@pytest.mark.parametrize(("distance", "is_found"), [(5, True), (4, False)])
def test_saddles_near_the_border_are_left_out(distance: int, is_found: bool) -> None:
    """The blur of 1.5 px reaches 5 px: twice the next whole number of pixels, and the centre."""
    for column, row in ((distance, 30), (79 - distance, 30), (40, distance), (40, 59 - distance)):
        places, _ = _find_saddles(saddles((60, 80), (column, row, 4.0, 0.1)), LIMITS)
        assert ([column, row] in places.tolist()) == is_found


def test_weak_and_uneven_saddles_are_left_out() -> None:
    """The curvature is compared with that of the saddle of a rank; valleys have one curvature only."""
    places = [(30 + 25 * i, 30 + 25 * j) for j in range(3) for i in range(3)]
    sizes = [8.0, 8.0, 8.0, 8.0, 8.0, 4.0, 4.0, 4.0, 0.9]
    grey = saddles((110, 120), *((*place, size, 0.2) for place, size in zip(places, sizes, strict=True)))
    for limits, count in (
        (ChessboardLimits(min_saddle=0.2, strongest=5), 8),  # a quarter of the curvature of the strongest
        (ChessboardLimits(min_saddle=0.3, strongest=5), 5),
        (ChessboardLimits(min_saddle=0.3, strongest=6), 8),
        (ChessboardLimits(min_saddle=0.3, strongest=99), 9),
        (ChessboardLimits(min_saddle=0.3, strongest=99, max_candidates=7), 7),
    ):
        found = _find_saddles(grey, limits)[0].tolist()
        assert sum(list(place) in found for place in places) == count, limits
    y, x = np.mgrid[:60, :80].astype(float)
    for ratio, is_found in ((0.18, True), (0.10, False)):  # (1 - ratio) / (1 + ratio) is 0.69 and 0.82
        bump = np.exp(-0.5 * ((x - 40) ** 2 + (y - 30) ** 2) / 36.0)
        grey = (100.0 + bump * ((x - 40) ** 2 - ratio * (y - 30) ** 2)).astype(np.float32)
        assert ([40.0, 30.0] in _find_saddles(grey, LIMITS)[0].tolist()) == is_found
    assert [each.shape for each in _find_saddles(np.full((60, 80), 5.0, np.float32), LIMITS)] == [(0, 2), (0, 2)]


def board(contrast: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey levels of squares of 20 px, each with its contrast, and the inner corners."""
    rows, columns = contrast.shape
    sign = np.where(np.indices(contrast.shape).sum(axis=0) % 2, 1.0, -1.0)
    grey = 100.0 + np.kron(sign * contrast, np.ones((20, 20)))
    corners = np.stack(np.meshgrid(np.arange(1, columns), np.arange(1, rows)), axis=-1) * 20.0 - 0.5
    return grey.astype(np.float32), corners


def test_squares_about_corners_alternate() -> None:
    """A corner counts if its contrast is more than half of the median, and dark squares lie where the others have."""
    contrast = np.full((5, 6), 40.0)
    grey, corners = board(contrast)
    assert _has_chequered_squares(grey, corners, LIMITS).all()
    assert _has_chequered_squares(200.0 - grey, corners, LIMITS).all()
    for level, is_good in ((1.1, True), (0.9, False)):
        # The contrast of a corner is the least step between its squares: here of 40 + 40 (level - 1).
        weak = contrast.copy()
        weak[2, 3] = 40.0 * (level - 1.0)
        good = _has_chequered_squares(board(weak)[0], corners, LIMITS)
        expected = np.ones((4, 5), bool)
        expected[1:3, 2:4] = is_good
        np.testing.assert_array_equal(good, expected)
    turned = grey.copy()
    turned[20:60, 20:60] = 200.0 - turned[20:60, 20:60]
    assert not _has_chequered_squares(turned, corners, LIMITS)[1, 1]
    assert not _has_chequered_squares(np.full_like(grey, 9.0), corners, LIMITS).any()


def test_the_point_nearest_to_the_edges() -> None:
    """Two straight edges cross at a point between pixels; its mean square distance from the edges is that of blur."""
    y, x = np.mgrid[:50, :60].astype(float)
    centre, angles = np.array([30.37, 22.81]), (0.2, 1.9)
    normals = [np.array([np.cos(each), np.sin(each)]) for each in angles]
    away = [(x - centre[0]) * n[0] + (y - centre[1]) * n[1] for n in normals]
    soft = [np.exp(-0.5 * (each / 1.2) ** 2) for each in away]
    slope = [(soft[0] * normals[0][axis] + soft[1] * normals[1][axis]).astype(np.float32) for axis in (0, 1)]
    to_steps = np.linalg.inv(np.array([[20.0, 3.0], [-2.0, 16.0]]).T)[None]
    found, rest = _foerstner_points(slope, np.array([[32.0, 21.5]]), to_steps, 12)
    np.testing.assert_allclose(found[0], centre, atol=0.01)
    s, t = to_steps[0] @ np.stack([(x - found[0, 0]).ravel(), (y - found[0, 1]).ravel()])
    window = (np.maximum(1.0 - (s / 0.4) ** 2, 0.0) * np.maximum(1.0 - (t / 0.4) ** 2, 0.0)).reshape(x.shape)
    gx, gy = slope
    square = window * (gx**2 + gy**2)
    distance = gx * (x - found[0, 0]) + gy * (y - found[0, 1])
    expected = np.sum(square * distance**2) / np.sum(square * (gx**2 + gy**2))
    assert rest[0] == pytest.approx(expected, rel=1e-3)
    # Without edges the point stays, with parallel edges it moves across them only.
    start = np.array([[32.0, 21.5]])
    nothing = np.zeros((50, 60), np.float32)
    np.testing.assert_array_equal(_foerstner_points([nothing, nothing], start, to_steps, 12)[0], start)
    upright = np.exp(-0.5 * ((x - centre[0]) / 1.2) ** 2).astype(np.float32)
    moved, _ = _foerstner_points([upright, nothing], start, to_steps, 12)
    np.testing.assert_allclose(moved, [[centre[0], 21.5]], atol=0.01)


def test_white_level_is_that_of_the_light_squares() -> None:
    """Light that falls along x; squares of 20 px. Dark parts of the image have a thousandth of the lightest level."""
    y, x = np.mgrid[:100, :160]
    light = 200.0 - 0.5 * x
    grey = np.where((x // 20 + y // 20) % 2, light, 0.1 * light).astype(np.float32)
    inside = np.s_[30:70, 40:120]
    np.testing.assert_allclose(_white_level(grey, 20.0)[inside], light[inside], rtol=0.08)
    dark = np.zeros((100, 160), np.float32)
    dark[:20, :20] = 80.0
    level = _white_level(dark, 10.0)
    assert level.min() == pytest.approx(1e-3 * level.max(), rel=1e-5)
