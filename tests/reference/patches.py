"""Reference of the form factors of receivers and triangles: Lambert's sum over edges in mpmath with 60 digits."""

from __future__ import annotations

from typing import Any

import mpmath

DIGITS = 60


def form_factor(receiver: Any, corners: Any) -> tuple[float, float]:
    """Return the form factor of a receiver (position, normal) to a triangle, and the largest over all normals."""
    with mpmath.workdps(DIGITS):
        place, normal = _vector(receiver[:3]), _vector(receiver[3:])
        normal /= mpmath.norm(normal)
        shape = [_vector(corner) - place for corner in corners]
        front = _cross(shape[1] - shape[0], shape[2] - shape[0])
        if _dot(front, shape[0]) >= 0:
            return 0.0, 0.0
        largest = mpmath.norm(_light(shape))
        above = _cut(shape, normal)
        value = -_dot(_light(above), normal) if len(above) > 2 else mpmath.mpf(0)
        return float(value), float(largest)


def _light(shape: list[Any]) -> Any:
    """Return the sum over edges of the edge's angle times the normal of its plane, over 2 pi."""
    total = mpmath.matrix(3, 1)
    for a, b in zip(shape, [*shape[1:], shape[0]], strict=True):
        turn = _cross(a, b)
        sine = mpmath.norm(turn)
        if sine > 0:
            total += turn * (mpmath.atan2(sine, _dot(a, b)) / sine)
    return total / (2 * mpmath.pi)


def _cut(shape: list[Any], normal: Any) -> list[Any]:
    """Clip a polygon at the plane through the origin (Sutherland and Hodgman)."""
    kept = []
    for a, b in zip(shape, [*shape[1:], shape[0]], strict=True):
        one, two = _dot(a, normal), _dot(b, normal)
        if one > 0:
            kept.append(a)
        if one * two < 0:
            kept.append(a + (b - a) * (one / (one - two)))
    return kept


def _vector(values: Any) -> Any:
    return mpmath.matrix([mpmath.mpf(float(v)) for v in values])


def _dot(a: Any, b: Any) -> Any:
    return mpmath.fdot(a, b)


def _cross(a: Any, b: Any) -> Any:
    return mpmath.matrix([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])
