"""Noise of the modified Laplacian, and of the focus that it finds: against derivatives and Monte Carlo."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import scipy.ndimage

from gpuvision.ranging.focus_noise import laplacian_variance
from gpuvision.ranging.focus_stack import FocusSearch, FocusStack, StageFocus

STAGE = StageFocus(start=0.0, step=1.0, pixel_size=1.0)
SIZE = 48


def mean_of_bends(image: np.ndarray, row: int, column: int, window: int) -> float:
    """Return the measure of a pixel by its definition."""
    total = 0.0
    for r in range(row - window, row + window + 1):
        for c in range(column - window, column + window + 1):
            total += abs(2 * image[r, c] - image[r, c - 1] - image[r, c + 1])
            total += abs(2 * image[r, c] - image[r - 1, c] - image[r + 1, c])
    return total / (2 * window + 1) ** 2


@pytest.mark.parametrize("window", [0, 1, 2])
def test_strong_texture_propagates_to_first_order(window: int, rng: np.random.Generator) -> None:
    """The derivative by every pixel, taken by differences, gives the variance of independent noise."""
    image, noise = rng.uniform(0.0, 200.0, (11, 12)), 1e-6
    variance = laplacian_variance(image, noise, window)
    for row, column in ((5, 6), (window + 1, 4), (6, 10 - window)):
        square = 0.0
        for place in np.ndindex(image.shape):
            above, below = image.copy(), image.copy()
            above[place] += 1e-3
            below[place] -= 1e-3
            ahead, behind = (mean_of_bends(each, row, column, window) for each in (above, below))
            square += ((ahead - behind) / 2e-3) ** 2
        assert variance[row, column] == pytest.approx(noise**2 * square, rel=1e-6)


@pytest.mark.parametrize("window", [0, 1, 2])
def test_the_noise_of_each_pixel_is_propagated(window: int, rng: np.random.Generator) -> None:
    """Shot noise: the variance is the sum over the pixels of derivative and standard deviation, squared."""
    image = rng.uniform(0.0, 200.0, (11, 12))
    noise = 1e-6 * np.sqrt(1.0 + image)
    variance = laplacian_variance(image, noise, window)
    for row, column in ((5, 6), (window + 1, 4), (6, 10 - window)):
        square = 0.0
        for place in np.ndindex(image.shape):
            above, below = image.copy(), image.copy()
            above[place] += 1e-3
            below[place] -= 1e-3
            ahead, behind = (mean_of_bends(each, row, column, window) for each in (above, below))
            square += ((ahead - behind) / 2e-3 * noise[place]) ** 2
        assert variance[row, column] == pytest.approx(square, rel=1e-6)
    equal = laplacian_variance(image, np.full_like(image, 3.0), window)
    np.testing.assert_allclose(equal, laplacian_variance(image, 3.0, window), rtol=1e-12)


def test_the_border_has_no_variance(rng: np.random.Generator) -> None:
    variance = laplacian_variance(rng.uniform(0.0, 200.0, (9, 12)), 1.0, 1)
    expected = np.zeros((9, 12), bool)
    expected[2:-2, 2:-2] = True
    np.testing.assert_array_equal(np.isfinite(variance), expected)
    assert np.isnan(laplacian_variance(np.zeros((6, 20)), 1.0, 2)).all()


def test_without_texture_the_variance_is_that_of_noise(rng: np.random.Generator) -> None:
    """The estimate from noisy differences is 1.07 of the variance of one of them, and nearly the same of a window."""
    noise = rng.normal(0.0, 3.0, (400, 400))
    measure = FocusStack(geometry=STAGE, window=2).sharpness(noise)[3:-3, 3:-3]
    predicted = laplacian_variance(noise, 3.0, 2)[3:-3, 3:-3]
    assert np.mean(predicted) / np.var(measure) == pytest.approx(1.05, abs=0.1)


def textures() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(8)
    white = rng.normal(size=(SIZE, SIZE))
    return {
        "white": white,
        "smooth": scipy.ndimage.gaussian_filter(white, 1.2),
        "dots": (rng.random((SIZE, SIZE)) < 0.1).astype(float),
        "stripes": np.broadcast_to(np.sin(0.9 * np.arange(SIZE)), (SIZE, SIZE)).copy(),
    }


def scatter_over_sigma(texture: str, noise: float, window: int, draws: int, gain: float = 0.0) -> tuple[float, float]:
    """Return the median over the pixels of scatter over sigma of the sharpest frame, and the share with a sigma."""
    image = textures()[texture]
    image = 120.0 + 40.0 * (image - image.mean()) / image.std()
    clean = [scipy.ndimage.gaussian_filter(image, math.hypot(0.6, 0.5 * abs(k - 2.3))) for k in range(5)]
    rng, stack = np.random.default_rng(5), FocusStack(geometry=STAGE, window=window, read_noise=noise, gain=gain)
    places, sigmas = [], []
    for _ in range(draws):
        search = FocusSearch(stack, np.dtype(np.float64))
        for frame in clean:
            lit = frame if gain == 0.0 else gain * rng.poisson(frame / gain)
            search.add(lit + rng.normal(0.0, noise, frame.shape))
        peak = search.peak()
        places.append(peak.frame)
        sigmas.append(peak.sigma)
    known = np.isfinite(sigmas).mean(axis=0) > 0.8
    if not known.any():
        return math.nan, 0.0
    with np.errstate(invalid="ignore"):
        ratio = np.nanstd(np.array(places)[:, known], axis=0, ddof=1) / np.sqrt(
            np.nanmean(np.array(sigmas)[:, known] ** 2, axis=0)
        )
    return float(np.sqrt(np.mean(ratio**2))), float(known[window + 1 : -window - 1, window + 1 : -window - 1].mean())


@pytest.mark.parametrize(
    ("texture", "noise", "window", "least"),
    [
        ("white", 1.0, 2, 0.95),
        ("white", 4.0, 4, 0.95),
        ("smooth", 0.5, 2, 0.9),
        ("dots", 1.0, 2, 0.6),
        ("stripes", 0.3, 4, 0.9),
    ],
)
def test_the_sharpest_frame_scatters_by_its_sigma(
    texture: str, noise: float, window: int, least: float, draws: Callable[[int, int], int]
) -> None:
    ratio, known = scatter_over_sigma(texture, noise, window, draws(16, 100))
    assert known > least
    assert 0.9 < ratio < 1.1


@pytest.mark.parametrize(("texture", "gain", "window", "least"), [("white", 0.1, 2, 0.95), ("dots", 0.02, 2, 0.6)])
def test_shot_noise_is_part_of_the_sigma(
    texture: str, gain: float, window: int, least: float, draws: Callable[[int, int], int]
) -> None:
    """At a level of 120 the shot noise is 3.5 and 1.5 grey levels, and the read noise only 0.3."""
    ratio, known = scatter_over_sigma(texture, 0.3, window, draws(16, 100), gain)
    assert known > least
    assert 0.9 < ratio < 1.1


def test_a_pixel_has_read_and_shot_noise() -> None:
    stack = FocusStack(geometry=STAGE, measure="intensity", read_noise=3.0, gain=0.16)
    levels = np.array([[0, 100]], np.uint8)
    np.testing.assert_allclose(stack.noise(levels), np.sqrt([[9 + 1 / 12, 25 + 1 / 12]]), rtol=1e-6)
    with pytest.raises(ValueError, match="gain is given without read_noise"):
        FocusStack(geometry=STAGE, gain=0.1)


def test_noise_that_hides_the_texture_leaves_no_sigma() -> None:
    _, known = scatter_over_sigma("smooth", 8.0, 2, 6)
    assert known < 0.02
