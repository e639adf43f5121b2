"""Blobs: blur of a disc, and light of the background that its contrast is over."""

from __future__ import annotations

import functools

import numpy as np

from gpuvision.host import Device
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.blob import disc_profile

_RADIUS, _CELL, _ACROSS = 10.0, 64, 32  # [px], [px], and blobs in a row of the image
_EPS = float(np.finfo(np.float32).eps)
_FIND = FindBlobs(threshold=0.2, noise=0.01, smoothing_px=2.0)  # of a contrast of 1


def problem() -> Problem:
    """Return the error of the centre over the blur and the background."""
    return Problem((Axis("blur [px]", 0.6, 3.0), Axis("background / contrast", 1e-2, 1e4)), "radius", _errors, _bound)


@functools.lru_cache(maxsize=64)
def _profile(blur: float) -> tuple[Floats, Floats]:
    """Return distances from the centre, and the levels of a disc."""
    return disc_profile(_RADIUS, blur)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    count = len(places)
    true = 0.5 * (_CELL - 1) + rng.uniform(-0.5, 0.5, (count, 2))
    row, column = np.mgrid[:_CELL, :_CELL]
    image = np.zeros((_CELL * -(-count // _ACROSS), _CELL * min(count, _ACROSS)), np.float32)
    for number, ((blur, light), (x, y)) in enumerate(zip(places, true.copy(), strict=True)):
        top, left = (_CELL * each for each in divmod(number, _ACROSS))
        level = np.interp(np.hypot(column - x, row - y), *_profile(float(blur)), right=0.0)
        image[top : top + _CELL, left : left + _CELL] = light + level
        true[number] += left, top
    near = true + rng.uniform(-1.0, 1.0, true.shape)
    nominal = np.column_stack([near, np.full(count, _RADIUS)]).astype(np.float32)
    shift = np.asarray(_FIND(image, nominal, device=device).shift, np.float64)
    return np.asarray(np.linalg.norm(nominal[:, :2] + shift - true, axis=1) / _RADIUS)


def _bound(places: Floats) -> Floats:
    blur, light = places.T
    # Contract of the blobs: the polynomial of a blurred step errs by 2.4e-4 of the contrast, at a slope of the contrast
    # over 2.5 blurs; a pixel is rounded to half an epsilon of its light.
    return np.asarray(np.sqrt(2.0) * 2.5 * blur * (2.4e-4 + 0.5 * _EPS * (light + 1.0)) / _RADIUS)
