"""Irradiance of a segment behind the edge of an occluder: gap below the receiver, and place of the shadow's end."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.line_irradiance import irradiance
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows

_HEIGHT, _HALF = 0.25, 0.5  # height of the occluder above the segment, half of the segment's length [m]
# The occluder covers x < 0.
_CORNERS = np.array([[[0.0, -2.0, _HEIGHT], [0.0, 2.0, _HEIGHT], [-4.0, 0.0, _HEIGHT]]])
_ENDS = np.array([[[-_HALF, 0.0, 0.0], [_HALF, 0.0, 0.0]]])
_NORMAL = np.array([[0.0, 0.0, 1.0]])
_ROWS = segment_rows(LitSegments(_ENDS, _NORMAL, np.ones(1))).astype(np.float32)
_LIGHT = OccludedIrradiance(scene=Scene(_CORNERS), segments=1, clearance=1e-9)
_SIZE, _EPS = 4.0, float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the irradiance over the gap and the place on the segment where the shadow ends."""
    axes = (
        Axis("gap / height of the occluder", 1e-3, 3.0),
        Axis("end of the shadow / half of the segment", -0.9, 0.9, False),
    )
    return Problem(axes, "irradiance without occlusion of a receiver that faces each element", _errors, _bound)


def _receivers(places: Floats) -> tuple[Floats, Floats]:
    """Return x and z of the receivers: the ray to the end of the shadow passes the edge of the occluder."""
    return -_HALF * places[:, 1] * places[:, 0], _HEIGHT * (1.0 + places[:, 0])


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    count = len(places)
    x, z = _receivers(places)
    normal = rng.normal(0.0, 0.3, (count, 3)) - [0.0, 0.0, 1.0]
    normal[:, 2] = -np.abs(normal[:, 2])
    receivers = np.column_stack([x, 0.0 * x, z, normal]).astype(np.float32)
    strips, weights = receivers[:, None], np.ones((count, 1, 2), np.float32)
    found = np.asarray(_LIGHT(strips, weights, _ROWS, device=device).irradiance, np.float64)[:, 0]
    errors = np.empty(count)
    for number, (own, light) in enumerate(zip(receivers.astype(np.float64), found, strict=True)):
        begin = -own[0] * _HEIGHT / (own[2] - _HEIGHT)
        seen, _ = irradiance(own[None], np.array([[[begin, 0.0, 0.0], [_HALF, 0.0, 0.0]]]), _NORMAL, np.ones(1))
        errors[number] = abs(light - seen[0])
    return errors / (_integral(x, z) * z / np.pi)


def _integral(x: Floats, z: Floats) -> Floats:
    """Return the integral of 1 / r^3 over the segment."""
    ends = ((_HALF - x) / np.hypot(_HALF - x, z), (_HALF + x) / np.hypot(_HALF + x, z))
    return np.asarray((ends[0] + ends[1]) / z**2)


def _bound(places: Floats) -> Floats:
    # Contract of the irradiance: 2e-6, and the light that a receiver gains or loses when it moves by 8 epsilon of the
    # scene's size. A sideways move of the receiver moves the end of the shadow 1 / gap times as far, an
    # upward move place / gap times as far.
    (gap, place), (x, z) = places.T, _receivers(places)
    end = _HALF * place
    moved = 8.0 * _EPS * _SIZE * (1.0 + np.abs(end) / _HEIGHT) / gap
    return np.asarray(2e-6 + moved / np.hypot(end - x, z) ** 3 / _integral(x, z))
