"""Chessboards: all inner corners, with correct indices and sub-pixel accuracy."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest

from gpuvision.camera.patterns.chessboard import find_chessboard
from target_images import View, chessboard, matched, photo, view

Float64 = np.ndarray
SIZE = (640, 480)
INNER = (9, 6)


def _errors(found: Float64, truth: Float64, start: tuple[int, int] | None = (0, 0)) -> Float64:
    """Return errors (n, 2) of the detected corners; check that every corner has the correct index."""
    where, errors = matched(found, truth)
    assert start is None or where == start
    errors = errors[~np.isnan(errors[..., 0])]
    assert np.isfinite(errors).all()
    return errors


def _rms(errors: Float64) -> float:
    return float(np.sqrt(np.mean(errors**2)))


VIEWS = {
    "plain": view(SIZE, 6, 9, 40.0),
    "turned": view(SIZE, 6, 9, 40.0, turn=40.0),
    "tilted": view(SIZE, 6, 9, 40.0, turn=20.0, tilt=40.0, focal=1.5),
    "far tilted": view(SIZE, 6, 9, 40.0, turn=20.0, tilt=60.0, focal=1.5),
    "barrel": view(SIZE, 6, 9, 46.0, barrel=40.0, tilt=15.0),
    "mirrored": view(SIZE, 6, 9, 40.0, turn=5.0, mirrored=True),
}


@pytest.mark.parametrize("camera", VIEWS.values(), ids=VIEWS.keys())
def test_whatever_the_view(camera: View, rng: np.random.Generator) -> None:
    """Two crossing edges of about 20 px in the window, with 1 % noise: 0.01 px."""
    found = find_chessboard(photo(chessboard(camera, INNER), rng))
    truth = camera.nodes(6, 9)
    errors = _errors(found.points, truth[:, ::-1] if camera is VIEWS["mirrored"] else truth)
    assert found.points.shape == (6, 9, 2)
    assert len(errors) == 54
    assert _rms(errors) < 0.015
    assert found.sigma < 0.02


@pytest.mark.parametrize(("noise", "limit"), [(0.0, 0.01), (9.0, 0.05), (18.0, 0.12), (36.0, 0.3)])
def test_error_follows_the_noise(noise: float, limit: float, rng: np.random.Generator) -> None:
    camera = view(SIZE, 6, 9, 40.0, turn=7.0)
    found = find_chessboard(photo(chessboard(camera, INNER), rng, noise=noise, dtype=np.float32))
    assert _rms(_errors(found.points, camera.nodes(6, 9))) < limit


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_types_and_colours(dtype: type, rng: np.random.Generator) -> None:
    image = photo(chessboard(VIEWS["plain"], INNER), rng, dtype=dtype)
    for each in (image, np.repeat(image[..., None], 3, axis=2)):
        assert _rms(_errors(find_chessboard(each).points, VIEWS["plain"].nodes(6, 9))) < 0.015


@pytest.mark.slow
def test_not_worse_than_opencv(rng: np.random.Generator) -> None:
    """On the same images as OpenCV, with cornerSubPix in windows of 11 pixels and with the sector-based detector."""
    ours, theirs = [], {"classic": [], "sector": []}
    for name in ("tilted", "barrel", "far tilted"):
        camera = VIEWS[name]
        image = photo(chessboard(camera, INNER), rng)
        truth = camera.nodes(6, 9)
        ours.append(_errors(find_chessboard(image).points, truth))
        found, corners = cv2.findChessboardCorners(image, INNER)
        assert found
        corners = cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 100, 1e-4))
        sector = cv2.findChessboardCornersSB(image, INNER, flags=cv2.CALIB_CB_ACCURACY)[1]
        for kind, each in (("classic", corners), ("sector", sector)):
            grid = each.reshape(6, 9, 2).astype(float)
            best = min((grid, grid[::-1, ::-1]), key=lambda turned: np.abs(turned - truth).max())
            theirs[kind].append(best - truth)
    for kind in theirs.values():
        assert _rms(np.stack(ours)) < _rms(np.stack(kind))


def test_a_slope_of_the_light_moves_no_corner(rng: np.random.Generator) -> None:
    """Large windows and light that falls to a fifth: without the correction the error would be up to 0.2 px."""
    camera = view((1280, 1024), 6, 9, 120.0, turn=7.0)
    found = find_chessboard(photo(chessboard(camera, INNER), rng, shade=0.8))
    assert _rms(_errors(found.points, camera.nodes(6, 9))) < 0.03


def test_blurred(rng: np.random.Generator) -> None:
    camera = view(SIZE, 6, 9, 40.0, turn=7.0)
    assert (
        _rms(_errors(find_chessboard(photo(chessboard(camera, INNER), rng, blur=4.0)).points, camera.nodes(6, 9)))
        < 0.06
    )


def test_hidden_corners_are_nan(rng: np.random.Generator) -> None:
    camera = view((1000, 800), 12, 15, 50.0, turn=7.0)
    image = photo(chessboard(camera, (15, 12)), rng)
    cv2.rectangle(image, (400, 300), (560, 430), 120, -1)
    image[:, 700:730] = 60
    found = find_chessboard(image, (15, 12)).points
    errors = _errors(found, camera.nodes(12, 15))
    assert 140 < len(errors) < 165
    assert np.abs(errors).max() < 0.15


def test_a_board_larger_than_the_image(rng: np.random.Generator) -> None:
    camera = view(SIZE, 12, 15, 50.0, turn=7.0)
    errors = _errors(find_chessboard(photo(chessboard(camera, (15, 12)), rng)).points, camera.nodes(12, 15), None)
    assert len(errors) > 95
    assert np.abs(errors).max() < 0.1


@pytest.mark.slow
def test_many_small_squares(rng: np.random.Generator) -> None:
    camera = view((1000, 900), 60, 70, 12.0, turn=3.0, tilt=10.0)
    errors = _errors(find_chessboard(photo(chessboard(camera, (70, 60)), rng)).points, camera.nodes(60, 70))
    assert len(errors) > 0.995 * 60 * 70
    assert _rms(errors) < 0.04


def test_memory_of_the_refinement_is_limited(rng: np.random.Generator) -> None:
    """Windows of about 2^17 pixels in all, 1 MB for each of their 16 arrays, are refined at the same time."""
    image = photo(chessboard(view((420, 400), 30, 30, 12.0, turn=3.0, tilt=10.0), (30, 30)), rng)
    tracemalloc.start()
    try:
        assert np.isfinite(find_chessboard(image).points).all()
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("inner", [(9, 6), (6, 9), [6, 9]])
def test_the_number_of_corners_in_any_order(inner: tuple[int, int], rng: np.random.Generator) -> None:
    assert find_chessboard(photo(chessboard(VIEWS["plain"], INNER), rng), inner).points.shape == (6, 9, 2)


def test_a_single_row_of_corners_is_none(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="corners of a chessboard found, expected at least 6"):
        find_chessboard(photo(chessboard(view(SIZE, 1, 10, 40.0), (10, 1)), rng))


def test_another_number_of_corners_is_told(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="chessboard of 9 x 6 inner corners found, expected 8 x 6"):
        find_chessboard(photo(chessboard(VIEWS["plain"], INNER), rng), (8, 6))


@pytest.mark.parametrize(
    "image",
    [
        np.zeros((300, 400), np.uint8),
        np.zeros((1, 1), np.uint8),
        np.zeros((3, 700), np.uint8),
        np.random.default_rng(1).integers(0, 255, (300, 400)).astype(np.uint8),
    ],
)
def test_what_is_no_chessboard_is_told(image: np.ndarray) -> None:
    with pytest.raises(ValueError, match="corners of a chessboard found, expected at least 6") as caught:
        find_chessboard(image)
    assert "\n" not in str(caught.value)


@pytest.mark.realdata
def test_real_boards(data: Path) -> None:
    """All 54 corners of 13 views, amid clutter, and a reprojection rms below the rms of OpenCV's corners (0.18 px)."""
    names = sorted((data / "calibration" / "chessboard").glob("*.jpg"))
    grids = [find_chessboard(cv2.imread(str(name), cv2.IMREAD_GRAYSCALE)).points for name in names]
    assert len(grids) == 13
    assert {tuple(sorted(grid.shape[:2])) for grid in grids} == {(6, 9)}
    assert all(np.isfinite(grid).all() for grid in grids)
    objects = [np.insert(np.argwhere(grid[..., 0])[:, ::-1], 2, 0, axis=1).astype(np.float32) for grid in grids]
    pixels = [grid.reshape(-1, 1, 2).astype(np.float32) for grid in grids]
    assert cv2.calibrateCamera(objects, pixels, SIZE, None, None)[0] < 0.18
