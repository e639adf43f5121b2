"""Invertible region of OpenCV's lens model: up to where the determinant of its Jacobian first vanishes (the fold)."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

# Directions in which the fold is searched, and the factor on the nearest fold found that covers the directions between.
_DIRECTIONS = 64
_MARGIN = 0.98
# Powers of the radius of the terms k1 .. k6, p1, p2 and s1 .. s4; largest normalised radius of the search.
_ORDERS = np.array([2.0, 4.0, 6.0, 2.0, 4.0, 6.0, 1.0, 1.0, 1.0, 3.0, 1.0, 3.0])
_FARTHEST = 1e6
# Largest imaginary part of a root that counts as real, as a fraction of its real part. Derived: rounding splits a
# double root by the square root of float64's rounding, 1.5e-8, times its condition. A candidate too many does no harm,
# because signs are compared.
_MAX_IMAGINARY = 1e-3

Float64 = npt.NDArray[np.float64]


class InvertibleRegion(NamedTuple):
    """Region of the normalised ideal plane where a lens model is invertible.

    Attributes
    ----------
    safe : float
        Squared radius within which the determinant of the Jacobian is positive everywhere.
    limit : float
        Squared radius within which the determinant changes its sign at most once along every ray from the centre. The
        region is the set of points within it with a positive determinant.
    edge : numpy.ndarray
        (directions, 2): points around the centre where the determinant first vanishes; infinite where it never does.
    """

    safe: float
    limit: float
    edge: Float64


def invertible_region(radial: Sequence[float], tangential: Sequence[float], prism: Sequence[float]) -> InvertibleRegion:
    """Find the invertible region for radial terms k1 .. k6, tangential terms p1, p2 and prism terms s1 .. s4."""
    terms = np.array([*radial, *tangential, *prism])
    with np.errstate(divide="ignore", over="ignore"):
        radii = np.abs(terms) ** (-1.0 / _ORDERS)
    # Drop terms that reach 1 only beyond the search radius: they would degrade the conditioning of the polynomials. The
    # unit of length is the smallest radius at which one of the other terms reaches 1.
    terms = np.where(radii < _FARTHEST, terms, 0.0)
    unit = min(float(radii.min()), _FARTHEST)
    k, p, s = np.split(terms * unit**_ORDERS, [6, 8])
    over, under = np.r_[1.0, k[:3]], np.r_[1.0, k[3:]]
    pole = min(_sign_changes(under), default=math.inf)
    if not p.any() and not s.any():
        slope = polynomial.polyadd(polynomial.polymul(over, under), _twice_square_times(_wronskian(over, under)))
        square = min(*_sign_changes(slope), pole, math.inf) * unit**2
        return InvertibleRegion(square, square, math.sqrt(square) * _directions())
    return _decentred(over, under, p, s, pole, unit)


def _decentred(over: Float64, under: Float64, p: Float64, s: Float64, pole: float, unit: float) -> InvertibleRegion:
    directions = _directions()
    rays = [_sign_changes(_along_ray(over, under, p, s, c, d)) for c, d in directions]
    first = [ray[0] if ray else math.inf for ray in rays]
    again = min(ray[1] if len(ray) > 1 else math.inf for ray in rays)
    last = max((each for each in first if math.isfinite(each)), default=0.0)
    if not last:
        limit = pole
    elif last < again:
        limit = min(last * again, pole)
    else:
        limit = min((_MARGIN * again) ** 2, pole)
    edge = np.minimum(first, math.sqrt(pole))[:, None] * unit * directions
    return InvertibleRegion(min((_MARGIN * min(first)) ** 2, limit) * unit**2, limit * unit**2, edge)


def _directions() -> Float64:
    angles = (np.arange(_DIRECTIONS) + 0.5) * (2.0 * math.pi / _DIRECTIONS)
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def _wronskian(over: Float64, under: Float64) -> Any:
    first = polynomial.polymul(polynomial.polyder(over), under)
    return polynomial.polysub(first, polynomial.polymul(over, polynomial.polyder(under)))


def _twice_square_times(terms: Any) -> Any:
    return 2.0 * polynomial.polymulx(terms)


def _in_radius(terms: Any) -> Float64:
    """Convert a polynomial in the squared radius to one in the radius."""
    spread = np.zeros(2 * len(terms) - 1)
    spread[::2] = terms
    return spread


def _along_ray(over: Float64, under: Float64, p: Float64, s: Float64, c: float, d: float) -> Any:
    """Return the determinant along the ray (c, d), times the denominator to the power 4, as a polynomial in the radius.

    The terms match kernels/common/camera.h, each multiplied by the squared denominator.
    """
    add, mul = polynomial.polyadd, polynomial.polymul
    square = _in_radius(mul(under, under))
    tangential = mul([0.0, 2.0], _in_radius(_wronskian(over, under)))
    radial = add(_in_radius(mul(over, under)), mul([0.0, 2.0 * (p[0] * d + p[1] * c)], square))
    e_x, e_y = add(c * tangential, 2.0 * p[1] * square), add(d * tangential, 2.0 * p[0] * square)
    a = mul([2.0 * (p[1] + s[0]), 0.0, 4.0 * s[1]], square)
    b = mul([2.0 * (p[0] + s[2]), 0.0, 4.0 * s[3]], square)
    xx, yy = add(radial, mul([0.0, c], add(e_x, a))), add(radial, mul([0.0, d], add(e_y, b)))
    xy, yx = mul([0.0, 1.0], add(c * e_y, d * a)), mul([0.0, 1.0], add(d * e_x, c * b))
    return polynomial.polysub(mul(xx, yy), mul(xy, yx))


def _sign_changes(terms: Iterable[float]) -> list[float]:
    """Return the positive arguments, ascending, where a polynomial that is 1 at 0 changes its sign."""
    known = np.asarray(terms, dtype=np.float64)
    roots = polynomial.polyroots(np.trim_zeros(known, "b"))
    # Rounding can make a real root complex, and a double root does not change the sign: compare signs between the
    # roots.
    candidates = roots[
        (roots.real > 0.0) & (np.abs(roots.imag) <= _MAX_IMAGINARY * roots.real) & (roots.real < _FARTHEST**2)
    ]
    places = np.sort(candidates.real)
    # Between the parts of a multiple root the value is 0 or rounding, at most 2 n eps sum |a_k| x^k for n terms
    # (Horner's method): its sign means nothing.
    after = np.r_[0.5 * (places[1:] + places[:-1]), 2.0 * places[-1:]]
    values = np.asarray(polynomial.polyval(after, known))
    rounding = 2.0 * len(known) * np.finfo(float).eps * polynomial.polyval(after, np.abs(known))
    found, sign, first = [], 1.0, 0
    for k in np.flatnonzero(np.abs(values) > rounding).tolist():
        if np.sign(values[k]) != sign:
            found.append(float(places[first]))
            sign = -sign
        first = k + 1
    return found
