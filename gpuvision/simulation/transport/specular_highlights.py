"""Glints: where a sheet of light falls on plane mirrors so that they throw it right into a lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import Parts, within_reach

Float64 = npt.NDArray[np.float64]


def specular_highlights(line: LitLine, sheet: LightSheet, view: SensorView, L: float) -> Parts:
    """Return the parts of lit segments whose light, mirrored by the triangles, goes through the lens' opening.

    The opening is a disc about the lens, square to its axis. Where mirrored rays meet its plane is a ratio of straight
    functions along a segment, so that the ends of the parts are known: exact for a thin sheet. What is in the way is
    not asked.
    """
    plane, weight = _crossings(line, sheet, view, L)
    return within_reach(plane[:, 0], plane[:, 1], *(0.5 * view.aperture * weight.T))


def _crossings(line: LitLine, sheet: LightSheet, view: SensorView, L: float) -> tuple[Float64, Float64]:
    """Return where mirrored rays from both ends meet the lens' plane, from the lens, times a weight, and the weights.

    (m, 2, 3) and (m, 2); the weight is positive where the light goes forward to the plane.
    """
    axis, normal = np.array(view.axis), line.normals[:, None]
    ends = line.ends - view.lens_at(L)
    if sheet.source is None:
        light = -sheet.towards(line.ends)
        mirrored = light - 2.0 * np.sum(light * normal, axis=-1, keepdims=True) * normal
        weight = -(mirrored @ axis)
        return weight[..., None] * ends + (ends @ axis)[..., None] * mirrored, weight
    # As if from the source's image behind the mirror.
    source = sheet.source_of(line.ends) - view.lens_at(L)
    source = source + 2.0 * np.sum((ends - source) * normal, axis=-1, keepdims=True) * normal
    mirrored = ends - source
    weight = -(mirrored @ axis)
    return weight[..., None] * source + (source @ axis)[..., None] * mirrored, weight
