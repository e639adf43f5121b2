"""Irradiance of a lit line on a curved surface, without occlusion: number of straight segments, and precision.

The line is an arc on a cylinder. The truth are 128 segments by quadrature in NumPy.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.host.launch import Precision
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.reference.line_irradiance import irradiance
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments

_RADIUS, _MANY, _RECEIVERS = 0.02, 128, 50  # [m]
_COUNTS = (2, 4, 8, 16, 32)
_DISTANCES = {"receivers 1 to 3 radii away": (1.0, 3.0), "receivers 0.1 to 0.5 radii away": (0.1, 0.5)}


def settings(device: Device) -> Iterator[Setting]:
    """Yield numbers of segments; the error is relative to the largest irradiance."""
    rng = np.random.default_rng(14)
    truth = _arc(_MANY)
    for data, (near, far) in _DISTANCES.items():
        angle, away = rng.uniform(-1.0, 1.0, _RECEIVERS), _RADIUS * (1.0 + rng.uniform(near, far, _RECEIVERS))
        way = np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=-1)
        aside = rng.normal(0.0, 0.2 * _RADIUS, _RECEIVERS)[:, None] * [0.0, 1.0, 0.0]
        receivers = np.concatenate([away[:, None] * way + aside, -way], axis=1)
        exact, _ = irradiance(receivers, truth.ends, truth.normals, truth.exitance)
        for count in _COUNTS:
            precisions: list[Precision] = [None, "double"] if device.has_double else [None]
            for precision in precisions:
                dtype = np.float64 if precision else np.float32
                operation = LineIrradiance(segments=_arc(count), precision=precision)
                bound = bind_with(operation, device, receivers.astype(dtype))
                errors = Errors((to_numpy(bound.outputs.irradiance) - exact) / exact.max())
                parameters = {"segments": count, "precision": precision or "single"}
                yield Setting("line_irradiance", data, parameters, bound.run, errors, "")


def _arc(count: int) -> LitSegments:
    """Return an arc of 120 degrees of a lit line on a cylinder along y as straight segments."""
    angle = np.linspace(-np.pi / 3.0, np.pi / 3.0, count + 1)
    points = _RADIUS * np.stack([np.sin(angle), 0.0 * angle, np.cos(angle)], axis=-1)
    middle = 0.5 * (angle[1:] + angle[:-1])
    normals = np.stack([np.sin(middle), 0.0 * middle, np.cos(middle)], axis=-1)
    return LitSegments(np.stack([points[:-1], points[1:]], axis=1), normals, np.ones(count))
