"""Specular highlights of lit segments, and the light on their surfaces, against single rays."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.specular_highlights import find_specular_highlights
from sensor_views import sensor_view

TRANSPORT = 3e-3
VIEW = replace(sensor_view(), aperture=0.02, axis=(0.1, -0.5, -0.8))


def to_light(points: np.ndarray, source: tuple[float, float] | None) -> np.ndarray:
    """Return unit vectors from points to the light: up, or to a source in the sheet through the point."""
    if source is None:
        return np.broadcast_to([0.0, 0.0, 1.0], points.shape)
    places = np.stack(np.broadcast_arrays(source[0], points[..., 1], source[1]), axis=-1)
    return np.asarray((places - points) / np.linalg.norm(places - points, axis=-1, keepdims=True))


def lines(rng: np.random.Generator, source: tuple[float, float] | None, count: int = 60) -> LitLine:
    """Return segments whose normals mirror the light from a point on them to a place near the lens, or beside it."""
    middle = rng.uniform(-0.01, 0.01, (count, 3))
    lens = VIEW.lens_at(TRANSPORT) + rng.normal(0.0, 0.012, (count, 3))
    towards = lens - middle
    normals = to_light(middle, source) + towards / np.linalg.norm(towards, axis=1, keepdims=True)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::10] = -normals[::10] + 0.1  # mirrored to somewhere else
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    # A segment lies in its surface and in the sheet.
    half = np.cross(normals, [0.0, 1.0, 0.0]) * rng.normal(0.0, 8e-3, (count, 1))
    return LitLine(np.stack([middle - half, middle + half], axis=1), normals, np.arange(count), np.ones(count))


@pytest.mark.parametrize("source", [None, (0.02, 0.25)])
def test_highlights_are_where_mirrored_rays_pass_the_aperture(
    source: tuple[float, float] | None, rng: np.random.Generator
) -> None:
    line = lines(rng, source)
    parts = find_specular_highlights(line, LightSheet(transport=StraightTransport(), source=source), VIEW, TRANSPORT)
    share = (np.arange(400) + 0.5) / 400
    points = line.ends[:, :1] + share[:, None] * (line.ends[:, 1:] - line.ends[:, :1])
    arriving, normal = -to_light(points, source), line.normals[:, None]
    mirrored = arriving - 2.0 * np.sum(arriving * normal, axis=-1, keepdims=True) * normal
    axis = np.array([0.1, -0.5, -0.8]) / math.sqrt(0.01 + 0.25 + 0.64)
    lens = VIEW.lens_at(TRANSPORT)
    # A ray meets the plane of the lens after a way that is positive where it travels against the axis.
    way = ((lens - points) @ axis) / (mirrored @ axis)
    crossing = points + way[..., None] * mirrored
    distance = np.linalg.norm(crossing - lens, axis=-1)
    expected = (distance < 0.01) & (mirrored @ axis < 0.0)
    inside = np.zeros(expected.shape, int)
    for segment, first, last, visible in zip(*parts, strict=True):
        assert visible
        inside[segment] += (share > first) & (share < last)
    near = np.abs(distance - 0.01) < 1e-9
    np.testing.assert_array_equal(inside[~near], expected[~near])
    assert 0.05 < expected.mean() < 0.95
    assert np.count_nonzero(expected.any(axis=1) & ~expected.all(axis=1)) > 10


def test_a_smaller_aperture_has_shorter_highlights(rng: np.random.Generator) -> None:
    """For one segment the length is in proportion to the diameter, where the rays are parallel."""
    sheet = LightSheet(transport=StraightTransport())
    towards = np.array(VIEW.lens) / np.linalg.norm(VIEW.lens)
    normal = towards + np.array([0.0, 0.0, 1.0])
    normal /= np.linalg.norm(normal)
    ends = np.array([[[-0.05, 0.0, 0.0], [0.05, 0.0, 0.0]]])
    line = LitLine(ends, normal[None], np.zeros(1, int), np.ones(1))
    view = replace(VIEW, axis=-towards)
    lengths = []
    for aperture in (1e-3, 3e-3):
        parts = find_specular_highlights(line, sheet, replace(view, aperture=aperture), 0.0)
        lengths.append(0.1 * (parts.end - parts.start)[0])
        np.testing.assert_allclose(parts.start + parts.end, 1.0, rtol=1e-9)
    np.testing.assert_allclose(lengths, [1e-3, 3e-3], rtol=1e-9)
