"""Reference of mirror images: reflection in the unit sphere and in an ellipsoid about the origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

Float64 = NDArray[np.float64]


def reflect_in_sphere(point: Float64, lens: Float64) -> tuple[Float64, float]:
    """Return the reflection point of a point on the outside of the unit sphere (Alhazen's problem), and its density.

    The density is 1 / ((d + e + 2 d e / cos i) (d + e + 2 d e cos i)), with the distances d and e of the reflection
    point from lens and point, and the angle of incidence i: the product of the spreads of rays in and across the plane
    of incidence.
    """
    one = lens / np.linalg.norm(lens)
    two = point - (point @ one) * one
    two /= np.linalg.norm(two)

    def parts(angle: float) -> tuple[Float64, Float64, Float64]:
        normal = np.cos(angle) * one + np.sin(angle) * two
        return normal, lens - normal, point - normal

    def lean(angle: float) -> float:
        _, to_lens, to_point = parts(angle)
        across = np.cos(angle) * two - np.sin(angle) * one
        return float(across @ (to_lens / np.linalg.norm(to_lens) + to_point / np.linalg.norm(to_point)))

    angle = brentq(lean, 0.0, np.arctan2(point @ two, point @ one), xtol=1e-15)
    normal, to_lens, to_point = parts(angle)
    d, e = np.linalg.norm(to_lens), np.linalg.norm(to_point)
    cosine = to_lens @ normal / d
    return normal, float(1.0 / ((d + e + 2.0 * d * e / cosine) * (d + e + 2.0 * d * e * cosine)))


def reflect_past_ellipsoid(
    shape: tuple[float, ...], lens: Float64, place: Float64, point: Float64, apart: float = 1e-5
) -> tuple[float, float]:
    """Return the distance at which a ray off an ellipsoid passes a point, and its bundle's area per solid angle."""
    middle = place - lens
    middle /= np.linalg.norm(middle)
    one = np.cross(middle, [0.0, 0.0, 1.0])
    one /= np.linalg.norm(one)
    two = np.cross(middle, one)
    found = []
    for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
        towards = middle + apart * (a * one + b * two)
        start, direction = lens / shape, towards / shape
        half, square = start @ direction, direction @ direction
        t = (-half - np.sqrt(half**2 - square * (start @ start - 1.0))) / square
        spot = lens + t * towards
        normal = spot / np.square(shape)
        normal /= np.linalg.norm(normal)
        on = towards - 2.0 * (towards @ normal) * normal
        found.append((spot, on / np.linalg.norm(on)))
    spot, on = found[0]
    misses = [each + ((point - each) @ on) / (ray @ on) * ray - point for each, ray in found]
    across = np.cross(misses[1] - misses[2], misses[3] - misses[4]) / (2.0 * apart) ** 2
    return float(np.linalg.norm(misses[0])), float(np.linalg.norm(across))
