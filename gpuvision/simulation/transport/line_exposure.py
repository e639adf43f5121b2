"""Exposure of a sensor by straight lines: cut exactly at the edges of bins and samples, integrated between them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.line_parts import LineProjector, Parts

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
PowerOnLine = Callable[[Integers, Float64], Float64]

# Nodes and weights of the three-point Gauss-Legendre rule on [0, 1].
_NODES = 0.5 + 0.5 * np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


def expose_lines(view: SensorView, L: float, ends: Float64, power_on_line: PowerOnLine) -> Exposure:
    """Return the exposure of a sensor by completely visible lines.

    Parameters
    ----------
    view
        The sensor.
    L
        Transport [m].
    ends
        (k, 2, 3): ends of the lines, or of their images behind plane mirrors [m]. Parts behind the lens or beyond the
        sheet's horizon are omitted.
    power_on_line
        Function of the index of a line (n,) and the fraction of its length (n,), 0 to 1, that returns the power on the
        sensor per unit of the fraction [W].

    Notes
    -----
    A line is divided, to rounding, where its image crosses the edge of a bin or a sample. Within a bin the three-point
    Gauss-Legendre rule integrates power and moment.
    """
    count = len(ends)
    images = LineProjector(view).project(ends, L)
    parts = images.clip_to_view(Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool)))
    parts = images.split_at_edges(images.split_at_edges(parts, view.v_edges, 1), view.u_edges, 0)
    width = parts.end - parts.start
    at = parts.start + _NODES[:, None] * width
    which = np.broadcast_to(parts.segment, at.shape)
    power = _WEIGHTS[:, None] * width * power_on_line(which.ravel(), at.ravel()).reshape(at.shape)
    places = images.image_points(which, at)
    return view.deposit_spots(places[..., 0], places[..., 1], power)
