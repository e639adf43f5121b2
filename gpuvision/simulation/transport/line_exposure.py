"""The image of straight lines on a sensor: cut exactly where bins and samples end, integrated in between."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.transport.line_parts import Images, Parts

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Strength = Callable[[Integers, Float64], Float64]

# Gauss and Legendre's three nodes on [0, 1].
_NODES = 0.5 + 0.5 * np.array([-np.sqrt(0.6), 0.0, np.sqrt(0.6)])
_WEIGHTS = np.array([5.0, 8.0, 5.0]) / 18.0


def line_exposure(view: SensorView, L: float, ends: Float64, strength: Strength) -> Exposure:
    """Return the exposure by lines that are seen from end to end.

    Parameters
    ----------
    view
        The sensor, at transport ``L`` [m].
    ends
        (k, 2, 3), metres: the lines, or their images behind plane mirrors. What lies behind the lens or beyond the
        sheet's horizon is left out.
    strength
        Takes which line, (n,), and where on it, (n,) from 0 to 1, and returns the power on the sensor per share of the
        line [W].

    Notes
    -----
    A line is cut where its image crosses the edge of a bin or of a sample, to rounding; within a bin Gauss and
    Legendre's rule of 3 nodes integrates power and moment.
    """
    count = len(ends)
    images = Images(view).of(ends, L)
    parts = images.in_view(Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool)))
    parts = images.split(images.split(parts, view.v_edges, 1), view.u_edges, 0)
    width = parts.end - parts.start
    at = parts.start + _NODES[:, None] * width
    which = np.broadcast_to(parts.segment, at.shape)
    power = _WEIGHTS[:, None] * width * strength(which.ravel(), at.ravel()).reshape(at.shape)
    places = images.at(which, at)
    return view.deposit_spots(places[..., 0], places[..., 1], power)
