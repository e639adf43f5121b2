"""Reference of the caliper (ruler): edges along one ruler, sample by sample, as `gpuvision.RulerEdges` defines them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.special import ndtr

Float64 = NDArray[np.float64]


def straight(points: Float64) -> Float64:
    """Return the points themselves: no lens."""
    return points


def profile(
    image: NDArray[Any],
    ruler: NDArray[Any],
    length: int,
    width: int,
    step: float = 1.0,
    distort: Callable[[Float64], Float64] = straight,
) -> tuple[Float64, Float64]:
    """Sample an image along a ruler.

    Parameters
    ----------
    image : numpy.ndarray
        (rows, columns).
    ruler : numpy.ndarray
        x, y of the centre [px], cosine and sine of the direction.
    length, width : int
        Number of samples along the ruler, and of lines side by side.
    step : float
        Distance between samples [px].
    distort : callable
        Function from ideal to measured pixels (..., 2).

    Returns
    -------
    grey : numpy.ndarray
        Mean over the lines, (length,); NaN outside the image.
    samples : numpy.ndarray
        (width, length).
    """
    x, y, cosine, sine = np.asarray(ruler, np.float64)
    along = (np.arange(length) - 0.5 * (length - 1)) * step
    across = (np.arange(width) - 0.5 * (width - 1))[:, None]
    points = distort(np.stack([x + along * cosine - across * sine, y + along * sine + across * cosine], axis=-1))
    inside = np.all((points >= 0) & (points <= np.array(image.shape[::-1]) - 1), axis=-1)
    at = np.where(inside[..., None], points, 0.0)
    samples = map_coordinates(image.astype(np.float64), [at[..., 1], at[..., 0]], order=1)
    samples = np.where(inside, samples, np.nan)
    return samples.mean(axis=0), samples


def derivative_filter(smoothing: float, step: float = 1.0) -> Float64:
    """Return the taps of a derivative of a Gaussian to 3 sigma, for `numpy.correlate`; a ramp of slope 1 gives 1."""
    reach = math.ceil(3.0 * smoothing / step)
    k = np.arange(-reach, reach + 1)
    values = k * np.exp(-0.5 * (k * step / smoothing) ** 2)
    return np.asarray(values / np.sum(k * values))


def smoothing_variance(filter_: Float64) -> float:
    """Return the variance of the smoothing in a derivative filter [samples^2]: a third of its third moment."""
    k = np.arange(filter_.size) - filter_.size // 2
    return float(np.sum(filter_ * k**3)) / 3.0


def interpolation_shift(
    ruler: NDArray[Any], size: tuple[int, int], step: float, position: float, variance: float, smoothing: float
) -> float:
    """Return the displacement [px] of an edge by linear interpolation.

    Parameters
    ----------
    ruler : numpy.ndarray
        x, y of the centre [px], cosine and sine of the direction.
    size : tuple
        Number of lines and of samples.
    step, position : float
        Distance between samples, and position of the edge from the centre [px].
    variance, smoothing : float
        Variance of the edge's gradient and of the smoothing [px^2].

    Notes
    -----
    Along each axis a sample at a fraction f beyond a pixel sees the edge through a kernel with the variance
    f (1 - f) = 1/6 - sum cos(2 pi k f) / (pi k)^2 and the third moment
    f (1 - f) (1 - 2 f) = 3 sum sin(2 pi k f) / (pi k)^3. The zero of the smoothed curvature moves by the integrals of
    these over the smoothed edge. The terms k = 1 and 2 are summed.
    """
    x, y, cosine, sine = np.asarray(ruler, np.float64)
    samples = position / step + 0.5 * (size[1] - 1)
    blur = max(variance - smoothing, 0.05 * smoothing)
    variance, common = smoothing + blur, smoothing * blur / (smoothing + blur)
    lines = np.arange(size[0]) - 0.5 * (size[0] - 1)
    moved = 0.0
    for centre, along, across in ((x, cosine, -sine), (y, sine, cosine)):
        for k in (1, 2):
            nearest = np.round(k * along * step)
            omega = 2.0 * math.pi * (k * along * step - nearest) / step
            phase = k * (centre + along * position) - nearest * samples
            attenuation = np.mean(np.cos(2.0 * math.pi * k * across * lines)) * math.exp(-0.5 * omega**2 * common)
            even = omega * (1.0 + (omega**2 * common - 3.0) * common / smoothing)
            odd = 3.0 + omega**2 * (variance - 6.0 * common) + (omega**2 * common) ** 2
            odd *= along / (math.pi * k * variance)
            moved += (
                attenuation * math.sin(2.0 * math.pi * phase) * along**2 * (even + odd) / (2.0 * (math.pi * k) ** 2)
            )
    return moved


def find_edges(
    grey: Float64,
    smoothing: float,
    threshold: float,
    step: float = 1.0,
    ruler: NDArray[Any] | None = None,
    width: int = 1,
) -> list[dict[str, float]]:
    """Find the edges of a profile.

    Parameters
    ----------
    grey : numpy.ndarray
        Grey levels along the ruler.
    smoothing, threshold, step
        As for `gpuvision.RulerEdges` [px, grey levels, px].
    ruler, width
        Ruler and number of lines, to correct the positions for the interpolation; without them no correction.

    Returns
    -------
    list of dict
        Position from the centre [px], amplitude [grey levels], width [px], gradient and variance of each edge, in order
        of position.
    """
    filter_ = derivative_filter(smoothing, step)
    reach, variance = filter_.size // 2, smoothing_variance(filter_)
    slopes = np.correlate(grey, filter_, "valid")
    least = threshold / math.sqrt(2.0 * math.pi * variance)
    found = []
    for i in range(1, slopes.size - 1):
        before, here, after = np.abs(slopes[i - 1 : i + 2])
        if here < least or not (here > before and here >= after):
            continue
        sign = np.sign(slopes[i])
        found.append(_refined(slopes[i - 1 : i + 2] * sign, sign, variance, step))
        found[-1]["position"] += (i + reach - 0.5 * (grey.size - 1)) * step
        if ruler is not None:
            at, peak = found[-1]["position"], found[-1]["variance"] * step**2
            found[-1]["position"] -= interpolation_shift(ruler, (width, grey.size), step, at, peak, variance * step**2)
    return found


def _refined(three: Float64, sign: float, smoothing: float, step: float) -> dict[str, float]:
    left, middle, right = np.log(np.maximum(three, 1e-6 * three[1]))
    curvature = left - 2.0 * middle + right
    shift = 0.5 * (left - right) / curvature
    variance = -1.0 / curvature
    peak = math.exp(middle - 0.25 * (left - right) * shift)
    return {
        "position": shift * step,
        "amplitude": sign * peak * math.sqrt(2.0 * math.pi * variance),
        "width": math.sqrt(max(variance - smoothing, 0.0)) * step,
        "gradient": sign * three[1],
        "variance": variance,
    }


def step_image(
    shape: tuple[int, int], angle: float, distance: float, blur: float, low: float = 50.0, high: float = 150.0
) -> Float64:
    """Return grey levels of a blurred straight edge: ``high`` where x cos + y sin exceeds the distance."""
    row, column = np.mgrid[: shape[0], : shape[1]].astype(np.float64)
    return np.asarray(low + (high - low) * ndtr((column * math.cos(angle) + row * math.sin(angle) - distance) / blur))


def stripe_image(
    shape: tuple[int, int], angle: float, distance: float, spacing: float, blur: float, high: float = 150.0
) -> Float64:
    """Return grey levels of a bright stripe centred on the distance."""
    first = step_image(shape, angle, distance - 0.5 * spacing, blur, 50.0, high)
    return first - step_image(shape, angle, distance + 0.5 * spacing, blur, 0.0, high - 50.0)


def disc_image(shape: tuple[int, int], centre: tuple[float, float], radius: float, blur: float) -> Float64:
    """Return grey levels of a blurred dark disc, supersampled 15 x 15 in each pixel."""
    fine = 15
    row, column = ((np.arange(n * fine) + 0.5) / fine - 0.5 for n in shape)
    inside = np.hypot(row[:, None] - centre[1], column - centre[0]) < radius
    coarse = inside.reshape(shape[0], fine, shape[1], fine).mean(axis=(1, 3))
    return np.asarray(150.0 - 100.0 * gaussian_filter(coarse, math.sqrt(blur**2 - 1.0 / 12.0), truncate=6.0))


def random_rulers(
    angle: float, distance: float, count: int, rng: np.random.Generator, middle: tuple[float, float]
) -> Float64:
    """Draw rulers (count, 4) at right angles to an edge, near the middle of an image, up to 8 px off the edge."""
    direction, along = np.array([math.cos(angle), math.sin(angle)]), np.array([-math.sin(angle), math.cos(angle)])
    foot = np.array(middle) + (distance - np.array(middle) @ direction) * direction
    centres = foot + rng.uniform(-20, 20, (count, 1)) * along + rng.uniform(-8, 8, (count, 1)) * direction
    return np.concatenate([centres, np.tile(direction, (count, 1))], axis=1).astype(np.float32)
