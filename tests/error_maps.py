"""Errors of simulated sensors for the tests of pictures and pairs."""

from __future__ import annotations

from typing import Any

import numpy as np

from gpuvision.simulation.errors.error_attribution import ErrorAttribution
from gpuvision.simulation.sensors.readings import GroundTruth, Reading


def errors_of(error: Any, *, mirrored: bool = False, causes: tuple[str, ...] = ("shape", "noise")) -> ErrorAttribution:
    """Return errors, (profiles, samples), of which the last cause has all; g rises or falls with the sample."""
    error = np.asarray(error, float)
    g = np.broadcast_to(np.linspace(-1e-3, 1e-3, error.shape[1])[:: -1 if mirrored else 1], error.shape)
    zero, flags = np.zeros(error.shape), np.zeros(error.shape, np.uint8)
    return ErrorAttribution(
        reading=Reading(zero, g, error, zero, zero, zero, flags),
        truth=GroundTruth(g, zero, flags),
        error=error,
        causes={name: error if name == causes[-1] else zero for name in causes},
        power=dict.fromkeys(causes, zero),
        category=flags,
    )
