"""Detectors on arbitrary images: a grid, or an error message of one line."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gpuvision.camera.patterns.chessboard import find_chessboard
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from target_images import chessboard, dots, line_grid, photo, view


def _noise(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return rng.integers(0, 256, shape).astype(np.uint8)


def _clouds(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    return cv2.GaussianBlur(rng.normal(0.0, 1.0, shape).astype(np.float32), (0, 0), rng.uniform(0.5, 8.0))


def _blobs(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    image = np.full(shape, 200, np.uint8)
    for _ in range(rng.integers(0, 40)):
        centre = int(rng.integers(0, shape[1])), int(rng.integers(0, shape[0]))
        cv2.circle(image, centre, int(rng.integers(1, 12)), int(rng.integers(0, 255)), -1)
    return image


def _pattern(rng: np.random.Generator, shape: tuple[int, int]) -> np.ndarray:
    """Draw a pattern of a few points; half of it may be covered."""
    rows, columns = (int(each) for each in rng.integers(1, 6, 2))
    camera = view((shape[1] + 40, shape[0] + 40), rows, columns, rng.uniform(12, 50), turn=rng.uniform(0, 45))
    covers = [
        lambda: dots(camera, np.ones((rows, columns), dtype=bool)),
        lambda: chessboard(camera, (columns, rows)),
        lambda: line_grid(camera, rows, columns),
    ]
    image = photo(covers[rng.integers(0, 3)](), rng)
    image[: rng.integers(-shape[0], shape[0])] = 0
    return image


@pytest.mark.parametrize("find", [find_dots, find_chessboard, find_lines])
@settings(deadline=None, max_examples=80)
@example(picture=_clouds, seed=1968334978, height=237, width=97)  # dots in a single row
@given(
    picture=st.sampled_from([_noise, _clouds, _blobs, _pattern]),
    seed=st.integers(0, 2**32 - 1),
    height=st.integers(1, 250),
    width=st.integers(1, 250),
)
def test_ends_in_a_grid_or_a_line(
    find: Callable[[np.ndarray], object],
    picture: Callable[[np.random.Generator, tuple[int, int]], np.ndarray],
    seed: int,
    height: int,
    width: int,
) -> None:
    image = picture(np.random.default_rng(seed), (height, width))
    message = None
    try:
        find(image)
    except ValueError as error:
        message = error
    assert message is None or type(message) is ValueError  # no LinAlgError
    line = "found" if message is None else str(message)
    assert "\n" not in line
    assert any(word in line for word in ("found", "broke into", "are whole"))
