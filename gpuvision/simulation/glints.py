"""Glints: where a sheet of light falls on plane mirrors so that they throw it right into a lens."""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.illumination import LightSheet, LitLine
from gpuvision.simulation.line_parts import Parts, together
from gpuvision.simulation.sight import Sight

Float64 = npt.NDArray[np.float64]


def glints(line: LitLine, sheet: LightSheet, sight: Sight, L: float) -> Parts:
    """Return the parts of lit segments whose light, mirrored by the triangles, goes through the lens' opening.

    The opening is a disc about the lens, square to its axis. Where mirrored rays meet its plane is a ratio of straight
    functions along a segment, so that the ends of the parts are known: exact for a thin sheet. What is in the way is
    not asked.
    """
    plane, weight = _crossings(line, sheet, sight, L)
    radius = 0.5 * sight.aperture
    start, end = plane[:, 0], plane[:, 1]
    low, high = radius * weight[:, 0], radius * weight[:, 1]
    # Inside: |start + t (end - start)| < low + t (high - low), a quadratic in t.
    way, growth = end - start, high - low
    square = np.sum(way * way, axis=1) - growth**2
    half = np.sum(start * way, axis=1) - low * growth
    rest = np.sum(start * start, axis=1) - low**2
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(half * half - square * rest)
        # Without cancellation.
        sum_ = -(half + np.copysign(root, half))
        places = np.sort(np.clip(np.nan_to_num(np.stack([sum_ / square, rest / sum_]), nan=0.0), 0.0, 1.0), axis=0)
    knots = np.concatenate([np.zeros((1, len(low))), places, np.ones((1, len(low)))])
    each, found = np.arange(len(low)), []
    for first, last in itertools.pairwise(knots):
        middle = 0.5 * (first + last)
        reach = low + middle * growth
        inside = (np.linalg.norm(start + middle[:, None] * way, axis=1) < reach) & (first < last)
        found.append(Parts(each, first, last, np.ones(len(each), bool)).those(inside))
    return together(found)


def _crossings(line: LitLine, sheet: LightSheet, sight: Sight, L: float) -> tuple[Float64, Float64]:
    """Return where mirrored rays from both ends meet the lens' plane, from the lens, times a weight, and the weights.

    (m, 2, 3) and (m, 2); the weight is positive where the light goes forward to the plane.
    """
    axis, normal = np.array(sight.axis), line.normals[:, None]
    ends = line.ends - sight.lens_at(L)
    if sheet.source is None:
        light = -sheet.towards(line.ends)
        mirrored = light - 2.0 * np.sum(light * normal, axis=-1, keepdims=True) * normal
        weight = -(mirrored @ axis)
        return weight[..., None] * ends + (ends @ axis)[..., None] * mirrored, weight
    # As if from the source's image behind the mirror.
    source = sheet.source_of(line.ends) - sight.lens_at(L)
    source = source + 2.0 * np.sum((ends - source) * normal, axis=-1, keepdims=True) * normal
    mirrored = ends - source
    weight = -(mirrored @ axis)
    return weight[..., None] * source + (source @ axis)[..., None] * mirrored, weight
