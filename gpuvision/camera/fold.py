"""How far OpenCV's lens terms stay one-to-one: where the determinant of their Jacobian first vanishes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

_DIRECTIONS = 64
# Between two of them the fold is hardly nearer than at either.
_MARGIN = 0.98
# Powers of the radius that k1 .. k6, p1, p2 and s1 .. s4 come with, and the radius at which nothing is looked for.
_ORDERS = np.array([2.0, 4.0, 6.0, 2.0, 4.0, 6.0, 1.0, 1.0, 1.0, 3.0, 1.0, 3.0])
_FARTHEST = 1e6

Float64 = npt.NDArray[np.float64]


class OneToOne(NamedTuple):
    """The part of the normalised ideal plane where a lens is one-to-one, as squared radii.

    It is where the determinant of the Jacobian is positive, within ``limit``: up to there every ray from the centre
    meets it vanish once at most. Within ``safe`` it is positive everywhere, so need not be looked at. ``edge`` are
    places (directions, 2) all around where it first vanishes, infinite where it never does.
    """

    safe: float
    limit: float
    edge: Float64


def one_to_one(radial: Sequence[float], tangential: Sequence[float], prism: Sequence[float]) -> OneToOne:
    """Find it for the radial coefficients k1 .. k6, the tangential p1, p2 and the thin prism's s1 .. s4."""
    terms = np.array([*radial, *tangential, *prism])
    with np.errstate(divide="ignore", over="ignore"):
        radii = np.abs(terms) ** (-1.0 / _ORDERS)
    # Terms too weak to matter anywhere would only spoil the numbers. The unit: where the first of the others reaches 1.
    terms = np.where(radii < _FARTHEST, terms, 0.0)
    unit = min(float(radii.min()), _FARTHEST)
    k, p, s = np.split(terms * unit**_ORDERS, [6, 8])
    over, under = np.r_[1.0, k[:3]], np.r_[1.0, k[3:]]
    pole = min(_sign_changes(under), default=math.inf)
    if not p.any() and not s.any():
        slope = polynomial.polyadd(polynomial.polymul(over, under), _twice_square_times(_wronskian(over, under)))
        square = min(*_sign_changes(slope), pole, math.inf) * unit**2
        return OneToOne(square, square, math.sqrt(square) * _directions())
    return _decentred(over, under, p, s, pole, unit)


def _decentred(over: Float64, under: Float64, p: Float64, s: Float64, pole: float, unit: float) -> OneToOne:
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
    return OneToOne(min((_MARGIN * min(first)) ** 2, limit) * unit**2, limit * unit**2, edge)


def _directions() -> Float64:
    angles = (np.arange(_DIRECTIONS) + 0.5) * (2.0 * math.pi / _DIRECTIONS)
    return np.stack([np.cos(angles), np.sin(angles)], -1)


def _wronskian(over: Float64, under: Float64) -> Any:
    first = polynomial.polymul(polynomial.polyder(over), under)
    return polynomial.polysub(first, polynomial.polymul(over, polynomial.polyder(under)))


def _twice_square_times(terms: Any) -> Any:
    return 2.0 * polynomial.polymulx(terms)


def _in_radius(terms: Any) -> Float64:
    """Rewrite a polynomial in the squared radius as one in the radius."""
    spread = np.zeros(2 * len(terms) - 1)
    spread[::2] = terms
    return spread


def _along_ray(over: Float64, under: Float64, p: Float64, s: Float64, c: float, d: float) -> Any:
    """Return the determinant along the ray (c, d), times the fourth power of the denominator; by powers of radius.

    Written as in kernels/common/camera.h, every term times the squared denominator.
    """
    add, mul = polynomial.polyadd, polynomial.polymul
    square = _in_radius(mul(under, under))
    turn = mul([0.0, 2.0], _in_radius(_wronskian(over, under)))
    growth = add(_in_radius(mul(over, under)), mul([0.0, 2.0 * (p[0] * d + p[1] * c)], square))
    e_x, e_y = add(c * turn, 2.0 * p[1] * square), add(d * turn, 2.0 * p[0] * square)
    a = mul([2.0 * (p[1] + s[0]), 0.0, 4.0 * s[1]], square)
    b = mul([2.0 * (p[0] + s[2]), 0.0, 4.0 * s[3]], square)
    xx, yy = add(growth, mul([0.0, c], add(e_x, a))), add(growth, mul([0.0, d], add(e_y, b)))
    xy, yx = mul([0.0, 1.0], add(c * e_y, d * a)), mul([0.0, 1.0], add(d * e_x, c * b))
    return polynomial.polysub(mul(xx, yy), mul(xy, yx))


def _sign_changes(terms: Iterable[float]) -> list[float]:
    """Return the positive places where a polynomial that is 1 at 0 changes its sign, ascending."""
    roots = polynomial.polyroots(np.trim_zeros(np.asarray(terms, dtype=np.float64), "b"))
    # Roots that rounding made complex, or that only touch 0, are told apart by the signs between them.
    near = roots[(roots.real > 0.0) & (np.abs(roots.imag) <= 1e-3 * roots.real) & (roots.real < _FARTHEST**2)]
    places = np.sort(near.real)
    if not len(places):
        return []
    between = np.r_[0.0, 0.5 * (places[1:] + places[:-1]), 2.0 * places[-1]]
    signs = np.sign(polynomial.polyval(between, np.asarray(terms)))
    return [float(place) for place, change in zip(places, np.diff(signs), strict=True) if change != 0.0]
