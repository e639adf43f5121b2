"""Reference of the irradiance by lit segments: quadrature in NumPy, and the closed form in mpmath with 60 digits."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray

DIGITS = 60
_PANELS = 32


def irradiance(receivers: NDArray[Any], ends: Any, normals: Any, exitance: Any) -> tuple[Any, Any]:
    """Return the irradiance of receivers by segments without occlusion, by quadrature.

    Parameters
    ----------
    receivers : numpy.ndarray
        Position and normal, (n, 6).
    ends, normals, exitance : array
        Ends (m, 2, 3) [m], normals (m, 3) and radiant exitance (m,) [W/m] of the segments.

    Returns
    -------
    irradiance : numpy.ndarray
        (n,) [W/m^2].
    scale : numpy.ndarray
        (n,), the sum of E0 = M h / pi * integral of dt / r^3: the irradiance of a receiver that faces each element.
    """
    total, largest = np.zeros(len(receivers)), np.zeros(len(receivers))
    place, normal = receivers[:, :3].astype(float), receivers[:, 3:].astype(float)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    for (start, stop), lit, power in zip(np.asarray(ends, float), np.asarray(normals, float), exitance, strict=True):
        length = np.linalg.norm(stop - start)
        along = (stop - start) / length
        lit = lit - (lit @ along) * along
        d = place - start
        s, height, across = d @ along, d @ lit / np.linalg.norm(lit), d @ np.cross(along, lit) / np.linalg.norm(lit)
        foot = np.sum(normal * (start + s[:, None] * along - place), axis=1)
        rho = np.hypot(height, across)
        with np.errstate(all="ignore"):
            parts = _integrals(-s, np.full_like(s, length), rho, foot, normal @ along)
        factor = np.where(height > 0.0, power * height / np.pi, 0.0)
        total += np.where(factor > 0.0, factor * parts[0], 0.0)
        largest += np.where(factor > 0.0, factor * parts[1], 0.0)
    return total, largest


def _integrals(tau: Any, length: Any, rho: Any, foot: Any, slope: Any) -> tuple[Any, Any]:
    """Return the integrals of max(foot + slope tau, 0) / r^4, and of 1 / r^3 over the whole segment."""
    low, high = tau, tau + length
    cut = -foot / slope
    left = np.where((slope > 0) & (cut > low), cut, low)
    right = np.where((slope < 0) & (cut < high), cut, high)
    seen = np.maximum(right - left, 0.0)
    # The length of a short visible part is computed from its own end, without cancellation.
    seen = np.where((slope > 0) & (cut > low), np.clip((foot + slope * high) / slope, 0.0, length), seen)
    seen = np.where((slope < 0) & (cut < high), np.clip(-(foot + slope * low) / slope, 0.0, length), seen)
    cosine = _over(
        left, np.where(left == low, np.minimum(seen, length), seen), rho, lambda t: np.maximum(foot + slope * t, 0.0), 4
    )
    return cosine, _over(low, length, rho, lambda t: np.ones_like(t), 3)


def _over(start: Any, length: Any, rho: Any, of: Any, power: int) -> Any:
    """Integrate by Gauss-Legendre on panels of equal width in asinh(tau / rho); on one panel for a short piece."""
    nodes, weights = np.polynomial.legendre.leggauss(16)
    nearest = np.hypot(rho, np.maximum(np.maximum(start, -start - length), 0.0))
    first, last = np.arcsinh(start / rho), np.arcsinh((start + length) / rho)
    width = (last - first) / _PANELS
    sums = np.zeros_like(rho)
    for panel in range(_PANELS):
        x = first + width * (panel + 0.5 + 0.5 * nodes[:, None])
        sums += weights @ (of(rho * np.sinh(x)) / (rho * np.cosh(x)) ** (power - 1))
    t = start + length * (0.5 + 0.5 * nodes[:, None])
    short = weights @ (of(t) / np.hypot(rho, t) ** power)
    return np.where(nearest >= length, 0.5 * length * short, 0.5 * width * sums)


def exact(receiver: Any, ends: Any, normal: Any, exitance: float) -> tuple[float, float]:
    """Return irradiance and E0 of one receiver and one segment by the closed form with 60 digits."""
    with mpmath.workdps(DIGITS):
        place, start, stop, lit, facing = (
            mpmath.matrix([mpmath.mpf(float(v)) for v in each])
            for each in (receiver[:3], ends[0], ends[1], normal, receiver[3:])
        )
        length = mpmath.norm(stop - start)
        along = (stop - start) / length
        facing /= mpmath.norm(facing)
        lit -= _dot(lit, along) * along
        lit /= mpmath.norm(lit)
        s = _dot(place - start, along)
        foot = start + s * along
        height, rho = _dot(lit, place - foot), mpmath.norm(place - foot)
        a, b = _dot(facing, foot - place), _dot(facing, along)
        if height <= 0:
            return 0.0, 0.0
        t1, t2 = -s, length - s
        factor = exitance * height / mpmath.pi
        at_best = factor * (t2 / mpmath.sqrt(t2**2 + rho**2) - t1 / mpmath.sqrt(t1**2 + rho**2)) / rho**2
        if b > 0:
            t1 = max(t1, -a / b)
        elif b < 0:
            t2 = min(t2, -a / b)
        elif a <= 0:
            return 0.0, float(at_best)
        if t2 <= t1:
            return 0.0, float(at_best)
        value = factor * (_antiderivative(t2, rho, a, b) - _antiderivative(t1, rho, a, b))
        return float(value), float(at_best)


def _antiderivative(t: Any, rho: Any, a: Any, b: Any) -> Any:
    q = t**2 + rho**2
    return a * (t / (2 * rho**2 * q) + mpmath.atan(t / rho) / (2 * rho**3)) - b / (2 * q)


def _dot(a: Any, b: Any) -> Any:
    return mpmath.fdot(a, b)


def by_definition(receiver: Any, ends: Any, normal: Any, exitance: float) -> float:
    """Return M / pi * integral of cos cos / r^2 dt by mpmath's quadrature, straight from the definition."""
    with mpmath.workdps(25):
        place, start, stop, lit, facing = (
            mpmath.matrix([mpmath.mpf(float(v)) for v in each])
            for each in (receiver[:3], ends[0], ends[1], normal, receiver[3:])
        )
        length = mpmath.norm(stop - start)

        def element(t: Any) -> Any:
            ray = place - (start + (stop - start) * t / length)
            square = _dot(ray, ray)
            received = max(-_dot(facing, ray), mpmath.mpf(0))
            return max(_dot(lit, ray), mpmath.mpf(0)) * received / square**2

        low, high = -_dot(facing, place - start), -_dot(facing, place - stop)
        edges = [mpmath.mpf(0), length]
        if low * high < 0:
            edges.insert(1, length * low / (low - high))
        scale = mpmath.norm(lit) * mpmath.norm(facing)
        parts = [edge for pair in pairwise(edges) for edge in mpmath.linspace(*pair, 9)]
        total = sum(mpmath.quad(element, [p, q]) for p, q in pairwise(parts) if q > p)
        return float(exitance * total / mpmath.pi / scale)
