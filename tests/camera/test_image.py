"""Grey images and their noise: accepted types and shapes at their limits, and the noise by loops."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from scipy.special import ndtri

from gpuvision.camera.image import PixelNoise, estimate_noise_model, estimate_pixel_noise, grey_image


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32, np.float64])
@pytest.mark.parametrize("channels", [None, 1, 3, 4])
def test_grey_of_an_image(dtype: type, channels: int | None, rng: np.random.Generator) -> None:
    """A fourth channel is ignored; float64 becomes float32, the other types stay."""
    shape = (16, 17) if channels is None else (16, 17, channels)
    image = rng.integers(0, 200, shape).astype(dtype)
    kept = np.float32 if dtype is np.float64 else dtype
    found = grey_image(image)
    assert (found.shape, found.dtype) == ((16, 17), kept)
    assert found.flags.c_contiguous
    plain = image.reshape(16, 17, -1).astype(kept)
    expected = plain[..., 0] if channels in (None, 1) else cv2.cvtColor(plain[..., :3].copy(), cv2.COLOR_BGR2GRAY)
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(grey_image(image[:, ::-1]), expected[:, ::-1])


def test_what_is_no_image() -> None:
    for shape in ((15, 16), (16, 15), (15, 16, 3)):
        with pytest.raises(ValueError, match=f"image has {shape[1]} x {shape[0]} px, expected at least 16 x 16"):
            grey_image(np.zeros(shape, np.uint8))
    assert grey_image(np.zeros((2, 3), np.uint8), min_size=2).shape == (2, 3)
    with pytest.raises(ValueError, match="expected at least 3 x 3"):
        grey_image(np.zeros((2, 3), np.uint8), min_size=3)
    for shape in ((16,), (16, 16, 2), (16, 16, 5), (0, 16), (16, 16, 3, 1)):
        with pytest.raises(ValueError, match=r"expected \(height, width\) or .* with 1 or 3 or 4 channels"):
            grey_image(np.zeros(shape, np.uint8))
    with pytest.raises(ValueError, match="with 3 channels"):
        grey_image(np.zeros((16, 16, 1), np.uint8), channels=(3,))
    for image in (np.zeros((16, 16), np.int32), np.zeros((16, 16), bool), np.zeros((16, 16)).tolist()):
        with pytest.raises(TypeError, match="expected an array of uint8, uint16 or float32"):
            grey_image(image)
    with pytest.raises(TypeError, match="image is float64, expected"):
        grey_image(np.zeros((16, 16)), convert_float64=False)


def test_noise_of_pixels(rng: np.random.Generator) -> None:
    """The median of the magnitudes of second differences along rows and columns, whose kernel's norm is 6."""
    image = 100.0 + 5.0 * np.arange(30.0) + rng.normal(0.0, 4.0, (25, 30))
    weights = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0])
    every = [
        abs(np.sum(weights * image[row : row + 3, column : column + 3].astype(float)))
        for row in range(23)
        for column in range(28)
    ]
    assert np.linalg.norm(weights) == pytest.approx(6.0)
    assert estimate_pixel_noise(image) == pytest.approx(np.median(every) / ndtri(0.75) / 6.0, rel=1e-4)
    holes = image.copy()
    holes[5, 6] = np.nan
    inside = [each for number, each in enumerate(every) if not (3 <= number // 28 <= 5 and 4 <= number % 28 <= 6)]
    assert estimate_pixel_noise(holes) == pytest.approx(np.median(inside) / ndtri(0.75) / 6.0, rel=1e-4)
    assert estimate_pixel_noise(np.full((5, 5), np.nan)) == 0.0


@pytest.mark.parametrize("noise", [0.3, 0.4, 0.5, 0.7, 0.8, 1.0, 1.2, 1.5, 1.6, 1.8, 2.0, 2.5, 3.0])
def test_noise_of_rounded_pixels(noise: float, rng: np.random.Generator) -> None:
    """Known noise and the variance 1/12 of the rounding. The median alone is wrong by up to 19 %."""
    rows, columns = np.mgrid[:300, :400]
    exact = 100.0 + 0.02 * columns + 0.013 * rows
    image = np.rint(exact + rng.normal(0.0, noise, exact.shape)).astype(np.uint8)
    found = estimate_pixel_noise(image)
    # The median of 118000 values determines the deviation to 0.5 %. Sums of few steps of 1 are not normal below 0.5.
    assert found == pytest.approx(math.sqrt(noise**2 + 1 / 12), rel=0.02 if noise >= 0.5 else 0.12)
    assert estimate_pixel_noise(image.astype(np.float32)) == found


def test_noise_of_rounded_pixels_without_noise() -> None:
    assert estimate_pixel_noise(np.full((20, 20), 7, np.uint8)) == 0.0
    single = np.full((40, 40), 7, np.uint8)
    single[20, 20] = 8  # 9 of 1444 differences are not 0
    assert 0.0 < estimate_pixel_noise(single) < 0.05


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize(("read_noise", "gain"), [(1.5, 0.0), (0.8, 0.04), (0.0, 0.05), (2.0, 0.02)])
def test_noise_that_depends_on_the_level(dtype: type, read_noise: float, gain: float, rng: np.random.Generator) -> None:
    """Surfaces of three levels with slanted edges between them."""
    rows, columns = np.mgrid[:300, :400]
    surface = (rows + columns // 3) % 90 // 30
    exact = np.array([30.3, 90.6, 200.2])[surface]
    noisy = exact + rng.normal(size=exact.shape) * np.sqrt(read_noise**2 + gain * exact)
    found = estimate_noise_model((noisy if dtype is np.float32 else np.rint(noisy)).astype(dtype))
    for level in (60.0, 120.0, 200.0):
        expected = math.sqrt(read_noise**2 + gain * level)
        assert found.sigma(np.full((1, 1), level)) == pytest.approx(expected, rel=0.05)


def test_noise_model_at_its_limits(rng: np.random.Generator) -> None:
    assert estimate_noise_model(np.full((40, 40), 7, np.uint8)) == PixelNoise(0.0, 0.0)
    # One level, and a variance that falls with the level: no shot noise.
    flat = estimate_noise_model(rng.normal(50.0, 2.0, (300, 300)).astype(np.float32))
    assert flat.sigma(np.full((1, 1), 50.0)) == pytest.approx(2.0, rel=0.05)
    sides = np.where(np.arange(400) < 200, 40.0, 160.0)
    falling = estimate_noise_model(sides + rng.normal(size=(300, 400)) * np.where(sides < 50, 3.0, 1.0))
    assert falling.gain == 0.0
    assert 1.0 < falling.read_noise < 3.0
    # A variance that would be negative at level 0: no read noise.
    steep = estimate_noise_model(sides + rng.normal(size=(300, 400)) * np.where(sides < 50, 0.5, 4.0))
    assert steep.read_noise == 0.0
    assert steep.gain > 0.0
    assert np.all(PixelNoise(2.0, 0.5).sigma(np.array([[-3.0, 10.0]])) == np.float32([2.0, 3.0]))
