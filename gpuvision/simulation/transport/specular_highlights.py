"""Specular highlights: parts of the lit line whose light plane mirrors reflect straight into the lens."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import Parts, parts_within_radius

Float64 = npt.NDArray[np.float64]


def find_specular_highlights(line: LitLine, sheet: LightSheet, view: SensorView, L: float) -> Parts:
    """Return the parts of lit segments whose light, mirrored by their triangles, passes through the lens' aperture.

    The aperture is a disc about the lens, perpendicular to its axis. The points in which mirrored rays meet its plane
    are ratios of linear functions along a segment, so the ends of the parts have a closed form: exact for a thin sheet.
    Occlusion is not considered.

    Parameters
    ----------
    line
        Lit segments.
    sheet
        Sheet of light.
    view
        The sensor.
    L
        Transport [m].
    """
    plane, weight = _crossings(line, sheet, view, L)
    return parts_within_radius(plane[:, 0], plane[:, 1], *(0.5 * view.aperture * weight.T))


def _crossings(line: LitLine, sheet: LightSheet, view: SensorView, L: float) -> tuple[Float64, Float64]:
    """Return homogeneous points in which mirrored rays from both ends meet the lens' plane, and their weights.

    Points (m, 2, 3) from the lens times the weights (m, 2); a weight is positive where the light travels towards the
    plane.
    """
    axis, normal = np.array(view.axis), line.normals[:, None]
    ends = line.ends - view.lens_at(L)
    if sheet.source is None:
        light = -sheet.direction_to_light(line.ends)
        mirrored = light - 2.0 * np.sum(light * normal, axis=-1, keepdims=True) * normal
        weight = -(mirrored @ axis)
        return weight[..., None] * ends + (ends @ axis)[..., None] * mirrored, weight
    # The mirrored light is emitted by the mirror image of the source.
    source = sheet.source_positions(line.ends) - view.lens_at(L)
    source = source + 2.0 * np.sum((ends - source) * normal, axis=-1, keepdims=True) * normal
    mirrored = ends - source
    weight = -(mirrored @ axis)
    return weight[..., None] * source + (source @ axis)[..., None] * mirrored, weight
