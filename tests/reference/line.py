"""Reference of the line readout: one profile at a time, written from the definitions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import optimize, special

LOW_SIGNAL, SATURATED, OUT_OF_RANGE, NOT_FINITE, AMBIGUOUS = 1, 2, 4, 8, 16

Float64 = NDArray[np.float64]
Reading = tuple[float, float, float, float, int]  # position, peak, width, total, status


def read_lines(
    frames: NDArray[Any], *, along: str = "columns", previous: ArrayLike | None = None, **settings: Any
) -> dict[str, NDArray[Any]]:
    """Read the position of the laser line in each profile.

    Parameters
    ----------
    frames : numpy.ndarray
        Images (..., rows, columns).
    along : str
        "columns" or "rows": direction of a profile.
    previous : array, optional
        Position of the last frame's line in each profile [px], for ``peak_selection="nearest"``.
    **settings
        Parameters of `gpuvision.LineReadout`.

    Returns
    -------
    dict
        position, peak, width and total (float64) and status (uint8), each of shape (..., samples).
    """
    profiles = np.asarray(frames)
    if along == "columns":
        profiles = np.swapaxes(profiles, -1, -2)
    saturation = settings.pop("saturation", None)
    if saturation is None:
        saturation = np.iinfo(profiles.dtype).max if profiles.dtype.kind == "u" else np.inf
    flat = profiles.reshape(-1, profiles.shape[-1]).astype(np.float64)
    before = np.full(len(flat), np.nan) if previous is None else np.asarray(previous, np.float64).reshape(-1)
    rows = [read_profile(x, saturation=saturation, previous=b, **settings) for x, b in zip(flat, before, strict=True)]
    names = ("position", "peak", "width", "total", "status")
    out = {k: np.array([row[i] for row in rows]).reshape(profiles.shape[:-1]) for i, k in enumerate(names)}
    out["status"] = out["status"].astype(np.uint8)
    return out


def read_profile(
    x: Float64,
    *,
    saturation: float,
    previous: float,
    method: str = "windowed",
    threshold: float = 0.0,
    window: int = 8,
    **settings: Any,
) -> Reading:
    """Return position, peak, width, total and status of one profile."""
    if not np.all(np.isfinite(x)):
        return np.nan, np.nan, np.nan, np.nan, NOT_FINITE
    if method == "centroid":
        return read_centroid(x, threshold, saturation, **settings)
    return read_peak(x, method, threshold, window, saturation, previous, **settings)


def read_centroid(
    x: Float64,
    threshold: float,
    saturation: float,
    *,
    minimum_peak: float = -np.inf,
    minimum_width: int = 1,
    maximum_width: int | None = None,
    **_: Any,
) -> Reading:
    """Return the reading by the centroid of all light above the threshold."""
    v = np.maximum(x - threshold, 0.0)
    lit = int(np.sum(v > 0.0))
    status = SATURATED if x.max() >= saturation else 0
    widest = len(x) if maximum_width is None else maximum_width
    if lit == 0 or x.max() < minimum_peak or not minimum_width <= lit <= widest:
        return np.nan, x.max(), lit, v.sum(), status | LOW_SIGNAL
    if max(v[0], v[-1]) >= v.max() / 2.0:
        return np.nan, x.max(), lit, v.sum(), status | OUT_OF_RANGE
    return np.sum(v * np.arange(len(x))) / v.sum(), x.max(), lit, v.sum(), status


def position_sigma(x: Float64, *, quantised: bool, read_noise: float, gain: float, **settings: Any) -> float:
    """Return the standard deviation of the position of one profile, by numerical derivatives of `read_profile`."""
    settings = {"previous": np.nan, "read_noise": read_noise, "gain": gain, **settings}
    position, step, variance = read_profile(x, **settings)[0], 1e-5 * float(x.max()), 0.0
    for k in range(len(x)):
        # Towards lower values: a sample at the threshold has no light.
        moved = x.copy()
        moved[k] -= step
        slope = (position - read_profile(moved, **settings)[0]) / step
        variance += slope**2 * (read_noise**2 + gain * max(x[k], 0.0) + (1.0 / 12.0 if quantised else 0.0))
    return float(np.sqrt(variance))


def runs_of(x: Float64, threshold: float) -> list[tuple[int, int]]:
    """Return (begin, end) of each run of samples above the threshold."""
    lit = np.concatenate([[False], x > threshold, [False]])
    steps = np.flatnonzero(lit[1:] != lit[:-1])
    return [(int(begin), int(end)) for begin, end in zip(steps[::2], steps[1::2], strict=True)]


def select_peak(
    x: Float64,
    threshold: float,
    previous: float,
    peak_selection: str,
    minimum_peak: float,
    minimum_width: int,
    maximum_width: int | None,
) -> tuple[int, int] | None:
    """Return the index of the selected peak and the width of its run, or None."""
    widest = len(x) if maximum_width is None else maximum_width
    peaks = [(b + int(np.argmax(x[b:e])), e - b) for b, e in runs_of(x, threshold) if minimum_width <= e - b <= widest]
    peaks = [(at, width) for at, width in peaks if x[at] >= minimum_peak]
    if not peaks:
        return None
    if peak_selection == "first":
        return peaks[0]
    if peak_selection == "last":
        return peaks[-1]
    if peak_selection == "nearest" and 0.0 <= previous < len(x):
        return min(peaks, key=lambda peak: abs(peak[0] - int(np.rint(previous))))
    return max(peaks, key=lambda peak: x[peak[0]])


def read_peak(
    x: Float64,
    method: str,
    threshold: float,
    window: int,
    saturation: float,
    previous: float,
    *,
    peak_selection: str = "strongest",
    minimum_peak: float = -np.inf,
    minimum_width: int = 1,
    maximum_width: int | None = None,
    ambiguity: float | None = None,
    fir_length: int = 4,
    read_noise: float = 1.0,
    gain: float = 0.0,
) -> Reading:
    """Return the reading by a window around the selected peak."""
    found = select_peak(x, threshold, previous, peak_selection, minimum_peak, minimum_width, maximum_width)
    if found is None:
        return np.nan, x.max(), 0, 0.0, LOW_SIGNAL | (SATURATED if x.max() >= saturation else 0)
    at, width = found
    top = x[at]
    others = np.flatnonzero(x[at:] != top)
    equals = int(others[0]) if len(others) else len(x) - at
    begin, end = at, at + equals
    at += (equals - 1) // 2
    status = SATURATED if top >= saturation else 0
    v = np.maximum(x - threshold, 0.0)
    inside = np.abs(np.arange(len(x)) - at) <= window
    if ambiguity is not None and np.any(~inside):
        second = v[~inside].max()
        status |= AMBIGUOUS if second > 0.0 and second >= ambiguity * (top - threshold) else 0
    is_wide = equals > 2 * window + 1
    status |= AMBIGUOUS if is_wide else 0
    if at < window or at + window >= len(x) or (is_wide and (begin == 0 or end == len(x))):
        return np.nan, top, width, v[inside].sum(), status | OUT_OF_RANGE
    in_window = x[at - window : at + window + 1]
    total = v[inside].sum()
    if is_wide:
        offset, flag = ((equals - 1) % 2) / 2.0, 0
    elif method == "windowed":
        offset, flag = np.sum(v[inside] * np.arange(-window, window + 1)) / total, 0
    elif method == "gauss3":
        offset, flag = gauss3(v, at, equals)
    elif method == "fir":
        offset, flag = fir(x, at, window, fir_length // 2)
    else:
        offset, flag = fit_gaussian(in_window, window, saturation, read_noise, gain), 0
    return (np.nan if flag & LOW_SIGNAL else at + offset), top, width, total, status | flag


def gauss3(v: Float64, at: int, equals: int) -> tuple[float, int]:
    """Return the offset and a flag by a parabola through the logarithms of three samples."""
    if v[at - 1] <= 0.0 or v[at + 1] <= 0.0:
        return np.nan, LOW_SIGNAL
    a, b, c = np.log(v[at - 1 : at + 2])
    curvature = a - 2.0 * b + c
    if curvature >= 0.0 or abs(0.5 * (a - c) / curvature) > 1.0:
        return ((equals - 1) % 2) / 2.0, AMBIGUOUS
    return 0.5 * (a - c) / curvature, 0


def fir(x: Float64, at: int, window: int, half: int) -> tuple[float, int]:
    """Return the offset and a flag by the zero crossing of a derivative filter."""
    padded = np.pad(x, half + window, mode="edge")
    index = np.arange(at - window, at + window + 1) + half + window
    g = np.array([padded[i - half : i].sum() - padded[i + 1 : i + half + 1].sum() for i in index])
    k = np.arange(-window, window)
    nearest = []
    for crosses in ((g[:-1] < 0.0) & (g[1:] >= 0.0), (g[:-1] <= 0.0) & (g[1:] > 0.0)):
        if not crosses.any():
            return np.nan, LOW_SIGNAL
        places = k[crosses] + g[:-1][crosses] / (g[:-1] - g[1:])[crosses]
        nearest.append(places[np.argmin(np.abs(places))])
    return float(np.mean(nearest)), 0


def pixel_gaussian(k: ArrayLike, place: ArrayLike, sigma: float, amplitude: float, background: float) -> Float64:
    """Return the light of a Gaussian line in each pixel ``k``, integrated over the pixel."""
    k, place = np.asarray(k), np.asarray(place)
    low, high = ((k + half - place) / (sigma * np.sqrt(2.0)) for half in (-0.5, 0.5))
    return np.asarray(background + amplitude * sigma * np.sqrt(np.pi / 2.0) * (special.erf(high) - special.erf(low)))


def fit_gaussian(y: Float64, window: int, saturation: float, read_noise: float, gain: float) -> float:
    """Return the offset of a Gaussian by maximum likelihood: least squares, weighted anew by the fit until it stays."""
    k = np.arange(-window, window + 1)
    good = y < saturation
    background = (y[0] + y[-1]) / 2.0
    over = np.maximum(y - background, 0.0)
    over[over < over.max() / 4.0] = 0.0
    guess = np.array([np.sum(over * k) / over.sum(), over.sum() / (2.266 * over.max()), over.max(), background])
    for _ in range(40):
        deviation = np.sqrt(read_noise**2 + gain * np.maximum(pixel_gaussian(k, *guess), 0.0))
        fit = optimize.least_squares(
            lambda p, d: ((pixel_gaussian(k, *p) - y) / d)[good], guess, x_scale=np.abs(guess) + 0.1,
            args=(deviation,), xtol=1e-12, ftol=1e-12, gtol=1e-12,
        )  # fmt: skip
        if np.max(np.abs(fit.x - guess)) < 1e-9:
            break
        guess = fit.x
    return float(guess[0])


def cramer_rao(
    sigma: float, amplitude: float, background: float, read_noise: float, length: int, places: ArrayLike
) -> float:
    """Return the Cramer-Rao bound of a line's position [px], root mean square over places; all parameters unknown."""
    k = np.arange(length)
    variances = []
    for place in np.asarray(places):
        truth = np.array([place, sigma, amplitude, background])
        slopes = []
        for i, size in enumerate((1e-5, 1e-5 * sigma, 1e-5 * amplitude, 1e-3)):
            shift = np.zeros(4)
            shift[i] = size
            slopes.append((pixel_gaussian(k, *(truth + shift)) - pixel_gaussian(k, *(truth - shift))) / (2.0 * size))
        design = np.array(slopes)
        variance = read_noise**2 + pixel_gaussian(k, *truth)
        variances.append(np.linalg.inv((design / variance) @ design.T)[0, 0])
    return float(np.sqrt(np.mean(variances)))
