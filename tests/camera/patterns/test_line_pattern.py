"""Line grids: both families, complete, with sub-pixel accuracy."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gpuvision.camera.patterns.line_pattern import find_lines
from gpuvision.camera.patterns.pattern import LineFamilies
from target_images import View, dots, line_grid, photo, view

Float64 = np.ndarray
SIZE = (640, 480)
ROWS, COLUMNS = 10, 14


def _checked(families: LineFamilies, camera: View) -> tuple[list[int], list[int], Float64]:
    """Check that rows and columns are unique and in order along the line; return rows, columns and all errors."""
    numbers: list[list[int]] = []
    errors = []
    assert len(families) == 2
    for axis, family in zip((1, 0), families, strict=True):
        found = []
        for line in family:
            at = camera.pattern(line)
            number = int(np.rint(np.median(at[:, axis])))
            found.append(number)
            assert (np.diff(line[:, 1 - axis]) > 0).all()
            # Distance perpendicular to the true line.
            nearest = at.copy()
            nearest[:, axis] = number
            ahead = nearest.copy()
            ahead[:, 1 - axis] += 0.01
            along = camera.pixels(ahead) - camera.pixels(nearest)
            along /= np.linalg.norm(along, axis=1, keepdims=True)
            off = line - camera.pixels(nearest)
            errors.append(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])
        numbers.append(found)
    return numbers[0], numbers[1], np.concatenate(errors)


def _rms(errors: Float64) -> float:
    return float(np.sqrt(np.mean(errors**2)))


VIEWS = {
    "plain": view(SIZE, ROWS, COLUMNS, 40.0),
    "turned": view(SIZE, ROWS, COLUMNS, 30.0, turn=40.0),
    "tilted": view(SIZE, ROWS, COLUMNS, 38.0, turn=10.0, tilt=40.0, focal=1.5),
    "barrel": view(SIZE, ROWS, COLUMNS, 40.0, barrel=40.0, tilt=15.0),
}


@pytest.mark.parametrize("camera", VIEWS.values(), ids=VIEWS.keys())
@pytest.mark.parametrize("dark", [True, False])
def test_whatever_the_view(camera: View, dark: bool, rng: np.random.Generator) -> None:
    """A point is the mean of about twenty profiles; noise of 1 % of the contrast gives 0.01 px."""
    rows, columns, errors = _checked(
        find_lines(photo(line_grid(camera, ROWS, COLUMNS), rng, dark=dark, shade=0.5)), camera
    )
    assert rows == list(range(ROWS))
    assert columns == list(range(COLUMNS))
    assert len(errors) > 0.95 * (ROWS * (COLUMNS - 1) + COLUMNS * (ROWS - 1))
    assert _rms(errors) < 0.012
    assert np.abs(errors).max() < 0.05


@pytest.mark.parametrize("width", [0.06, 0.15, 0.25])
@pytest.mark.parametrize(("noise", "limit"), [(0.0, 0.008), (9.0, 0.03), (18.0, 0.06)])
def test_error_follows_the_noise(noise: float, limit: float, width: float, rng: np.random.Generator) -> None:
    camera = view(SIZE, ROWS, COLUMNS, 40.0, turn=6.0)
    image = photo(line_grid(camera, ROWS, COLUMNS, width), rng, noise=noise, dtype=np.float32)
    *_, errors = _checked(find_lines(image), camera)
    assert _rms(errors) < limit
    assert abs(errors.mean()) < 4.0 * limit / np.sqrt(len(errors)) + 5e-4


def test_wide_lines_seen_askew(rng: np.random.Generator) -> None:
    camera = view(SIZE, ROWS, COLUMNS, 40.0, turn=10.0, tilt=50.0, focal=2.0)
    rows, columns, errors = _checked(find_lines(photo(line_grid(camera, ROWS, COLUMNS, 0.25), rng)), camera)
    assert (rows, columns) == (list(range(ROWS)), list(range(COLUMNS)))
    assert _rms(errors) < 0.02


def test_mirrored(rng: np.random.Generator) -> None:
    camera = view(SIZE, ROWS, COLUMNS, 40.0, turn=4.0, mirrored=True)
    rows, columns, errors = _checked(find_lines(photo(line_grid(camera, ROWS, COLUMNS), rng)), camera)
    assert rows == list(range(ROWS))
    assert columns == list(range(COLUMNS))[::-1]
    assert _rms(errors) < 0.012


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_types_and_colours(dtype: type, rng: np.random.Generator) -> None:
    image = photo(line_grid(VIEWS["plain"], ROWS, COLUMNS), rng, dtype=dtype)
    for each in (image, np.repeat(image[..., None], 3, axis=2)):
        *_, errors = _checked(find_lines(each), VIEWS["plain"])
        assert _rms(errors) < 0.012


def test_what_hides_lines_moves_none(rng: np.random.Generator) -> None:
    camera = view((1000, 800), 18, 22, 44.0, turn=6.0)
    image = photo(line_grid(camera, 18, 22), rng)
    cv2.rectangle(image, (400, 300), (560, 430), 120, -1)
    cv2.line(image, (100, 700), (420, 520), 60, 9)
    rows, columns, errors = _checked(find_lines(image), camera)
    assert (rows, columns) == (list(range(18)), list(range(22)))
    assert len(errors) > 600
    assert np.quantile(np.abs(errors), 0.98) < 0.05
    assert np.abs(errors).max() < 0.3


def test_a_grid_larger_than_the_image(rng: np.random.Generator) -> None:
    camera = view(SIZE, 30, 30, 44.0, turn=6.0)
    rows, columns, errors = _checked(find_lines(photo(line_grid(camera, 30, 30), rng)), camera)
    assert np.diff(rows).tolist() == [1] * (len(rows) - 1)
    assert np.diff(columns).tolist() == [1] * (len(columns) - 1)
    assert np.abs(errors).max() < 0.05


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((300, 400), np.uint8), "no cells between lines found; expected at least 9"),
        (np.zeros((1, 1), np.uint8), "no cells between lines found"),
        (photo(dots(view(SIZE, 10, 14, 40.0), np.ones((10, 14), bool)), np.random.default_rng(1)), "a pattern of dots"),
    ],
)
def test_what_is_no_grid_is_told(image: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        find_lines(image)
    assert "\n" not in str(caught.value)


@pytest.mark.realdata
def test_real_grid(data: Path) -> None:
    image = cv2.imread(str(data / "calibration" / "line_pattern_01.jpg"), cv2.IMREAD_GRAYSCALE)
    rows, columns = find_lines(image)
    assert (len(rows), len(columns)) == (34, 40)
    assert sum(map(len, rows)) > 1320
    assert sum(map(len, columns)) > 1320
    for axis, family in ((0, rows), (1, columns)):
        for line in family:
            # A lens bends these lines by a pixel; a cubic removes this curvature.
            curve = np.polynomial.Polynomial.fit(line[:, axis], line[:, 1 - axis], 3)
            assert np.std(line[:, 1 - axis] - curve(line[:, axis])) < 0.08
