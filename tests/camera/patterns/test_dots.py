"""Dot grids: found completely, with correct indices and sub-pixel accuracy."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from gpuvision.camera.patterns.dots import find_dots
from target_images import dots, matched, photo, view

Float64 = np.ndarray
SIZE = (700, 600)


def _all(rows: int, columns: int) -> np.ndarray:
    return np.ones((rows, columns), dtype=bool)


def _errors(found: Float64, truth: Float64, start: tuple[int, int] | None = (0, 0)) -> Float64:
    """Return errors (n, 2) of the detected points; check that every point has the correct index."""
    where, errors = matched(found, truth)
    assert start is None or where == start
    errors = errors[~np.isnan(errors[..., 0])]
    assert np.isfinite(errors).all()
    return errors


def _rms(errors: Float64) -> float:
    return float(np.sqrt(np.mean(errors**2)))


# Noise in grey levels of a contrast of 180. The centre of gravity of a disc of radius r over a ground that its window
# holds too has about 0.5 sigma / contrast times (window / r)^2; a tenth more for sharp edges between pixels' centres
# (0.004 px, noise-free), and for the ground's slope.
@pytest.mark.parametrize(
    ("noise", "limit"),
    [
        (0.0, 0.004),
        (9.0, 0.03),
        *(pytest.param(*each, marks=pytest.mark.slow) for each in ((1.8, 0.007), (18.0, 0.06), (36.0, 0.15))),
    ],
)
@pytest.mark.parametrize("pitch", [14.0, 28.0])
def test_error_follows_the_noise(noise: float, limit: float, pitch: float, rng: np.random.Generator) -> None:
    rows, columns = int(500 / pitch), int(600 / pitch)
    camera = view(SIZE, rows, columns, pitch, turn=6.0)
    found = find_dots(photo(dots(camera, _all(rows, columns)), rng, noise=noise, dtype=np.float32))
    errors = _errors(found.points, camera.nodes(rows, columns))
    assert len(errors) > 0.99 * rows * columns
    assert _rms(errors) < limit * (1.0 if pitch > 20 else 1.5)
    assert np.abs(errors.mean(axis=0)).max() < 4.0 * limit / np.sqrt(len(errors)) + 3e-4
    if noise:
        # The estimate contains only noise that neighbours do not share; sampling errors of sharp edges are partly
        # shared.
        assert found.sigma == pytest.approx(_rms(errors), rel=0.25)


VIEWS = {
    "plain": view(SIZE, 18, 21, 28.0),
    "turned": view(SIZE, 16, 18, 25.0, turn=44.0),
    "tilted": view(SIZE, 18, 21, 28.0, turn=-12.0, tilt=40.0, focal=1.5),
    "barrel": view(SIZE, 18, 21, 30.0, barrel=20.0, tilt=15.0),
    "strong barrel": view(SIZE, 18, 21, 34.0, barrel=60.0, tilt=15.0),
    "pincushion": view(SIZE, 18, 21, 26.0, barrel=-20.0),
    "mirrored": view(SIZE, 18, 21, 28.0, turn=5.0, mirrored=True),
}


@pytest.mark.parametrize(
    ("name", "dark"),
    [
        *((name, True) for name in VIEWS),
        ("plain", False),
        *(pytest.param(name, False, marks=pytest.mark.slow) for name in VIEWS if name != "plain"),
    ],
)
def test_whatever_the_view(name: str, dark: bool, rng: np.random.Generator) -> None:
    camera = VIEWS[name]
    rows, columns = (16, 18) if camera is VIEWS["turned"] else (18, 21)
    found = find_dots(photo(dots(camera, _all(rows, columns)), rng, dark=dark, shade=0.5))
    truth = camera.nodes(rows, columns)
    errors = _errors(found.points, truth[:, ::-1] if camera is VIEWS["mirrored"] else truth)
    assert len(errors) > 0.98 * rows * columns
    assert _rms(errors) < 0.012
    assert np.abs(errors.mean(axis=0)).max() < 0.003


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_types_and_colours(dtype: type, rng: np.random.Generator) -> None:
    image = photo(dots(VIEWS["plain"], _all(18, 21)), rng, dtype=dtype)
    assert _rms(_errors(find_dots(image).points, VIEWS["plain"].nodes(18, 21))) < 0.01
    coloured = find_dots(np.repeat(image[..., None], 3, axis=2)).points
    assert _rms(_errors(coloured, VIEWS["plain"].nodes(18, 21))) < 0.01


def test_blur_of_half_a_dot(rng: np.random.Generator) -> None:
    image = photo(dots(VIEWS["plain"], _all(18, 21)), rng, blur=3.5)
    assert _rms(_errors(find_dots(image).points, VIEWS["plain"].nodes(18, 21))) < 0.02


def test_large_discs_seen_askew_have_no_bias(rng: np.random.Generator) -> None:
    """The centres of gravity have a bias of up to 0.2 px, which is corrected to second order."""
    camera = view((900, 800), 8, 8, 90.0, turn=10.0, tilt=40.0, focal=1.5)
    found = find_dots(photo(dots(camera, _all(8, 8), radius=0.35), rng, noise=0.0))
    assert _rms(_errors(found.points, camera.nodes(8, 8), None)) < 0.015


def test_missing_dots_are_nan_and_all_others_found(rng: np.random.Generator) -> None:
    present = rng.random((18, 21)) >= 0.2
    camera = VIEWS["barrel"]
    found = find_dots(photo(dots(camera, present), rng)).points
    start, _ = matched(found, camera.nodes(18, 21))
    shown = np.zeros_like(present)
    i, j = np.nonzero(np.isfinite(found[..., 0]))
    shown[i + start[0], j + start[1]] = True
    assert not (shown & ~present).any()
    assert np.count_nonzero(shown) > 0.97 * np.count_nonzero(present)


def test_half_of_the_grid_is_missing(rng: np.random.Generator) -> None:
    present = _all(18, 21)
    present[:, 11:] = False
    found = find_dots(photo(dots(VIEWS["barrel"], present), rng)).points
    assert found.shape == (18, 11, 2)
    _errors(found, VIEWS["barrel"].nodes(18, 21))


@pytest.mark.parametrize("level", [20, 128, 215])
def test_what_hides_dots_moves_none(level: int, rng: np.random.Generator) -> None:
    """A patch, a disc and a stroke of any grey level: dots that they cut or touch are rejected.

    An overlap of 6 % of a dot's area is below the detection limit, and moves the centre by 0.25 px at most.
    """
    image = photo(dots(VIEWS["barrel"], _all(18, 21)), rng)
    cv2.rectangle(image, (150, 150), (260, 230), level, -1)
    cv2.circle(image, (470, 350), 70, level, -1)
    cv2.line(image, (90, 480), (330, 300), level, 5)
    errors = _errors(find_dots(image).points, VIEWS["barrel"].nodes(18, 21))
    assert len(errors) > 270
    assert np.abs(errors).max() < 0.25


def test_a_covered_strip_is_bridged(rng: np.random.Generator) -> None:
    image = photo(dots(VIEWS["barrel"], _all(18, 21)), rng)
    image[:, 330:420] = 220
    found = find_dots(image).points
    _errors(found, VIEWS["barrel"].nodes(18, 21))
    assert found.shape == (18, 21, 2)


def test_dots_at_the_border_are_left_out(rng: np.random.Generator) -> None:
    camera = view(SIZE, 40, 40, 28.0, turn=10.0)
    errors = _errors(find_dots(photo(dots(camera, _all(40, 40)), rng)).points, camera.nodes(40, 40), None)
    assert len(errors) > 450
    assert np.abs(errors).max() < 0.06


def test_blobs_between_dots_are_left_out(rng: np.random.Generator) -> None:
    image = photo(dots(VIEWS["plain"], _all(18, 21)), rng)
    for x, y in rng.uniform(20, 580, (150, 2)):
        cv2.circle(image, (int(x), int(y)), int(rng.integers(1, 6)), 60, -1)
    errors = _errors(find_dots(image).points, VIEWS["plain"].nodes(18, 21), None)
    assert len(errors) > 250
    assert np.quantile(np.abs(errors), 0.95) < 0.1


@pytest.mark.slow
def test_twelve_thousand_dots(rng: np.random.Generator) -> None:
    """Tilted view through a lens that moves the corners by 10 % of the image; 5 % of the dots are missing."""
    camera = view((1400, 1400), 110, 110, 12.5, turn=5.0, tilt=15.0, barrel=140.0)
    present = rng.random((110, 110)) >= 0.05
    truth = camera.nodes(110, 110)
    errors = _errors(find_dots(photo(dots(camera, present), rng)).points, truth, None)
    assert len(errors) > 0.99 * np.count_nonzero(present & np.all((truth > 5) & (truth < 1394), axis=-1))
    assert _rms(errors) < 0.012
    assert np.abs(errors).max() < 0.15


@pytest.mark.slow
def test_eight_thousand_pixels(rng: np.random.Generator) -> None:
    """The same dots, enlarged: coordinates up to 8000 px keep an accuracy of 0.01 px in single-precision images."""
    camera = view((8000, 300), 4, 130, 60.0)
    errors = _errors(find_dots(photo(dots(camera, _all(4, 130)), rng)).points, camera.nodes(4, 130))
    assert len(errors) > 510
    assert _rms(errors) < 0.01


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((300, 400), np.uint8), "no dots found; expected at least 9"),
        (np.tile(np.arange(400, dtype=np.uint16), (300, 1)), "no dots found"),
        (np.zeros((1, 1), np.uint8), "no dots found"),
        (np.random.default_rng(1).integers(0, 255, (300, 400)).astype(np.uint8), "found"),
        (photo(dots(view(SIZE, 2, 4, 40.0), _all(2, 4)), np.random.default_rng(1)), "dots found"),
    ],
)
def test_what_is_no_grid_is_told(image: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        find_dots(image)
    assert "\n" not in str(caught.value)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "shape", "fewest", "sigma"),
    # discorpy 1.7.0 finds 6368 and 1305. The dots of the second target are not on a regular grid.
    [("dot_pattern_01", (68, 98), 6340, 0.01), ("dot_pattern_02", (35, 41), 1300, 0.15)],
)
def test_real_grids(data: Path, name: str, shape: tuple[int, int], fewest: int, sigma: float) -> None:
    image = cv2.imread(str(data / "calibration" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE)
    found = find_dots(image)
    assert found.points.shape[:2] == shape
    assert np.count_nonzero(np.isfinite(found.points[..., 0])) > fewest
    assert found.sigma < sigma
    turned = find_dots(np.ascontiguousarray(image[::-1, ::-1])).points[::-1, ::-1]
    back = np.array(image.shape[::-1]) - 1.0 - turned
    assert np.nanmax(np.abs(back - found.points)) < 0.02
    # A row and a column are smooth curves: no step is far from its neighbours.
    for axis in (0, 1):
        second_difference = np.diff(found.points, 2, axis)
        assert np.nanmax(np.abs(second_difference)) < 0.12 * np.nanmedian(
            np.linalg.norm(np.diff(found.points, 1, axis), axis=-1)
        )
