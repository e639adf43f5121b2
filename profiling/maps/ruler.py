"""Caliper (ruler): background over the contrast of an edge, and blur of the edge."""

from __future__ import annotations

import math

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.ruler import find_edges, profile, step_image

_TILE, _LENGTH, _WIDTH, _SMOOTHING = 48, 31, 3, 1.5  # [px]
_TILES = 16  # in a row of the image
_CONTRAST, _THRESHOLD = 100.0, 2.0  # levels, and levels per pixel
_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the position over the background and the blur."""
    axes = Axis("background / contrast", 1e-2, 1e5), Axis("sigma of the edge's blur [px]", 0.5, 4.0)
    return Problem(axes, "half of the ruler", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    """Return the errors in an image of tiles, each with one edge and a ruler across it."""
    middle = 0.5 * (_TILE - 1)
    tiles, rulers = [], []
    for number, (ratio, blur) in enumerate(places):
        angle, away = rng.uniform(-math.pi, math.pi), rng.uniform(-3.0, 3.0)
        distance = middle * (math.cos(angle) + math.sin(angle)) + away
        low = _CONTRAST * ratio
        tiles.append(step_image((_TILE, _TILE), angle, distance, blur, low, low + _CONTRAST))
        row, column = divmod(number, _TILES)
        rulers.append((middle + _TILE * column, middle + _TILE * row, math.cos(angle), math.sin(angle)))
    tiles += [np.zeros((_TILE, _TILE))] * (-len(tiles) % _TILES)
    rows = [np.concatenate(tiles[first : first + _TILES], axis=1) for first in range(0, len(tiles), _TILES)]
    image, given = np.concatenate(rows).astype(np.float32), np.array(rulers, np.float32)
    operation = RulerEdges(
        threshold=_THRESHOLD, length=_LENGTH, width=_WIDTH, smoothing_px=_SMOOTHING, count=len(given)
    )
    found = operation(image, given, device=device).position
    exact = np.full(len(places), np.nan)
    for number, ruler in enumerate(given):
        grey, _ = profile(image.astype(np.float64), ruler, _LENGTH, _WIDTH)
        edges = find_edges(grey, _SMOOTHING, _THRESHOLD, 1.0, ruler, _WIDTH)
        if edges:
            exact[number] = max(edges, key=lambda edge: abs(edge["gradient"]))["position"]
    return np.asarray(np.abs(to_numpy(found) - exact) / (0.5 * _LENGTH), np.float64)


def _bound(places: Floats) -> Floats:
    ratio, blur = places.T
    # Error model of the ruler: 1e-4 px. Roundings of the grey levels disturb the gradients by some 4 epsilon of the
    # level. A parabola through the logarithms of three gradients turns a relative error of the gradient into
    # s^2 pixels; the gradient of the edge is the contrast over sqrt(2 pi) s, with the variance s^2 of blur and filter.
    spread = np.hypot(blur, _SMOOTHING)
    rounding = 4.0 * _EPS * (1.0 + ratio) * np.sqrt(2.0 * np.pi) * spread**3
    return np.asarray((1e-4 + rounding) / (0.5 * _LENGTH))
