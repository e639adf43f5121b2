"""Irradiance of a lit segment: height of the receiver above its surface, and distance along its line."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.reference.line_irradiance import irradiance
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments

_ENDS, _NORMAL = np.array([[[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]]), np.array([[0.0, 0.0, 1.0]])  # [m]
_LIGHT = LineIrradiance(segments=LitSegments(_ENDS, _NORMAL, np.ones(1)))


def problem() -> Problem:
    """Return the error of the irradiance over height and distance from the middle, in lengths of the segment."""
    axes = Axis("height / length of the segment", 1e-4, 1e2), Axis("distance along the line / length", 1e-2, 1e2)
    return Problem(axes, "irradiance of a receiver that faces each element", _errors, _bound)


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    height, along = places.T
    aside = height * rng.uniform(-1.0, 1.0, len(places))
    receivers = np.column_stack([along, aside, height, rng.normal(size=(len(places), 3))])
    receivers[:, 5] = -np.abs(receivers[:, 5])  # towards the surface of the segment
    given = receivers.astype(np.float32)
    found = np.asarray(_LIGHT(given, device=device).irradiance, np.float64)
    exact, largest = irradiance(given, _ENDS, _NORMAL, np.ones(1))
    return np.asarray(np.abs(found - exact) / largest)


def _bound(places: Floats) -> Floats:
    # Error model of the irradiance: 2e-6 of that of a receiver that faces each element.
    return np.full(len(places), 2e-6)
