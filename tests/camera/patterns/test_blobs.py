"""Blobs beyond the local threshold: which regions are kept, exactly at the limits, and the search for the scale."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtri

from gpuvision.camera.patterns.blobs import (
    BlobLimits,
    _noise,
    estimate_scale,
    find_blobs,
    find_pattern_blobs,
    is_typical_area,
)

LIMITS = BlobLimits(min_contrast=0.0)
WINDOW = 12.0


def picture(shape: tuple[int, int], *parts: tuple[int, int, int, int]) -> np.ndarray:
    """Return grey levels with bright rectangles (left, top, width, height)."""
    grey = np.full(shape, 10.0, np.float32)
    for left, top, width, height in parts:
        grey[top : top + height, left : left + width] = 200.0
    return grey


@pytest.mark.parametrize("bright", [True, False])
def test_centre_area_and_size(bright: bool) -> None:
    grey = picture((40, 60), (10, 12, 4, 3), (30, 20, 5, 6))
    found = find_blobs(grey if bright else 210.0 - grey, WINDOW, bright, 1, LIMITS)
    np.testing.assert_allclose(found.points, [[11.5, 13.0], [32.0, 22.5]])
    np.testing.assert_array_equal(found.area, [12.0, 30.0])
    np.testing.assert_array_equal(found.size, [[4.0, 3.0], [5.0, 6.0]])
    assert not len(find_blobs(grey if bright else 210.0 - grey, WINDOW, not bright, 1, LIMITS).area)


def test_regions_at_the_border_are_ignored() -> None:
    """Of squares at the border and one pixel from it, on each side, those from one pixel on are kept."""
    for gap, kept in ((0, 0), (1, 4)):
        places = ((gap, 20), (60 - 4 - gap, 16), (20, gap), (30, 40 - 4 - gap))
        grey = picture((40, 60), *((left, top, 4, 4) for left, top in places))
        assert len(find_blobs(grey, WINDOW, True, 1, LIMITS).area) == kept


@pytest.mark.parametrize(
    ("parts", "kept"),
    [
        ([(20, 20, 3, 2)], True),  # area 6
        ([(20, 20, 3, 1), (20, 21, 2, 1)], False),  # area 5
        ([(20, 20, 7, 2)], False),  # 7 : 2 is the limit
        ([(20, 20, 2, 7)], False),
        ([(20, 20, 10, 3)], True),
        ([(20, 20, 3, 10)], True),
        ([(20, 20, 8, 1), (20, 20, 1, 8)], True),  # covers 0.23, but has an area of 15
        ([(20, 20, 12, 1), (20, 20, 1, 12)], True),  # area 23: the last one that needs no fill
        ([(20, 20, 13, 1), (20, 20, 1, 12)], False),  # area 24
        ([(20, 20, 10, 3), (20, 20, 3, 10)], True),  # covers 0.51
        ([(20, 20, 10, 2), (20, 20, 2, 10), (22, 22, 2, 2)], False),  # covers 0.4, the limit
        ([(20, 20, 10, 2), (20, 20, 2, 10), (22, 22, 5, 1)], True),  # covers 0.41
    ],
)
def test_limits_of_the_shape(parts: list[tuple[int, int, int, int]], kept: bool) -> None:
    assert len(find_blobs(picture((50, 60), *parts), 30.0, True, 1, LIMITS).area) == kept


def test_diagonal_neighbours_are_apart() -> None:
    grey = picture((40, 40), (10, 10, 4, 4), (14, 14, 4, 4))
    np.testing.assert_array_equal(find_blobs(grey, WINDOW, True, 1, LIMITS).area, [16.0, 16.0])


def test_typical_areas() -> None:
    """The limits 0.4 and 2.5 times the median area, 10, themselves are out of the range."""
    area = np.array([4.0, 4.001, 10.0, 10.0, 10.0, 24.999, 25.0])
    assert is_typical_area(area, BlobLimits()).tolist() == [False, True, True, True, True, True, False]
    assert is_typical_area(np.array([]), BlobLimits()).shape == (0,)


def test_noise_is_the_lower_quartile_of_second_differences(rng: np.random.Generator) -> None:
    """Of normal numbers it is 0.3186 sigma times the root of 6, of 1 - 2 + 1; along rows only."""
    image = rng.normal(0.0, 3.0, (7, 40)).astype(np.float32)
    steps = [abs(row[k - 1] - 2.0 * row[k] + row[k + 1]) for row in image.astype(float) for k in range(1, 39)]
    assert ndtri(0.625) == pytest.approx(0.3186, abs=1e-4)
    assert _noise(image) == pytest.approx(np.quantile(steps, 0.25) / ndtri(0.625) / np.sqrt(6.0), rel=1e-3)
    assert _noise(image[:, :2]) == 0.0


def test_contrast_needed() -> None:
    """The limit is 15 % of the contrast at the other spots, which the means over windows make somewhat smaller."""
    for level, kept in ((10.0 + 0.08 * 190.0, 16), (10.0 + 0.3 * 190.0, 17)):
        grey = picture((80, 120), *((10 + 15 * i, 10 + 15 * k, 5, 5) for i in range(4) for k in range(4)))
        grey[40:45, 100:105] = level
        assert len(find_blobs(grey, WINDOW, True, 1, BlobLimits()).area) == kept, level


def grid(pitch: int, side: int, count: int, bright: bool) -> np.ndarray:
    first = pitch // 2
    places = [(first + pitch * i, first + pitch * k, side, side) for i in range(count) for k in range(count)]
    grey = picture((pitch * (count + 1), pitch * (count + 1)), *places)
    return grey if bright else 210.0 - grey


@pytest.mark.parametrize("bright", [True, False])
def test_scale_of_a_grid(bright: bool) -> None:
    """Squares of 5 px at a pitch of 12 px: 9 x 9, of which the ones within have symmetric neighbours."""
    scale = estimate_scale(grid(12, 5, 9, bright), BlobLimits())
    assert (scale.bright, scale.pitch, scale.cell_area) == (bright, pytest.approx(12.0), pytest.approx(144.0))
    assert 49 <= scale.blob_count <= 81
    found = find_pattern_blobs(grid(12, 5, 9, bright), BlobLimits())
    assert (len(found.points), found.bright) == (81, bright)
    assert found.coverage == pytest.approx(25.0 / 144.0)
    first = 6 + 2
    expected = np.stack(np.meshgrid(first + 12.0 * np.arange(9), first + 12.0 * np.arange(9)), -1).reshape(-1, 2)
    order = np.lexsort(np.rint(found.points).T)
    np.testing.assert_allclose(found.points[order], expected, atol=1e-6)
    np.testing.assert_array_equal(found.size, 5.0)


@pytest.mark.parametrize(("pitch", "side"), [(60, 40), (58, 26), (30, 22)])
def test_scale_of_few_large_squares(pitch: int, side: int) -> None:
    """Of 3 x 3 squares the middle one has symmetric neighbours; a window of a sixth lies within a square of 40 px."""
    grey = grid(pitch, side, 3, True)
    scale = estimate_scale(grey, BlobLimits())
    assert (scale.bright, scale.pitch, scale.cell_area) == (True, pytest.approx(pitch), pytest.approx(pitch**2))
    found = find_pattern_blobs(grey, BlobLimits())
    assert len(found.points) == 9
    np.testing.assert_array_equal(found.size, side)
    assert found.coverage == pytest.approx(side**2 / pitch**2, rel=0.02)  # smoothing rounds the corners


def test_too_few_blobs_have_no_scale() -> None:
    """Five blobs are the least number of a trial."""
    cross = [(20, 8), (8, 20), (20, 20), (32, 20), (20, 32)]
    for count, expected in ((5, 1), (4, 0)):
        grey = picture((48, 48), *((left, top, 5, 5) for left, top in cross[-count:]))
        scale = estimate_scale(grey, BlobLimits())
        assert (scale.blob_count > 0) == bool(expected)
    empty = find_pattern_blobs(np.full((48, 48), 10.0, np.float32), BlobLimits())
    assert (empty.points.shape, empty.size.shape, empty.bright) == ((0, 2), (0, 2), False)
    assert np.isnan(empty.coverage)
