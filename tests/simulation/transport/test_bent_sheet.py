"""Light of a bent sheet: against closed forms on planes and spheres, its stated bound, and conservation of power."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from gpuvision.host import Device
from gpuvision.ranging.sheet import BentSheet
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet
from gpuvision.simulation.transport.sheet_cut import BEND_ERROR, SheetIndex
from sensor_views import sensor_view

Float64 = npt.NDArray[np.float64]
TERMS = (0.4, -0.15, 0.2)
PINHOLE = (0.0, 0.15, 0.08)


def transport(turn: tuple[float, float, float] = (0.0, 0.0, 0.0), skew: tuple[float, float] = (0.0, 0.0)) -> Any:
    """Return a bent sheet, turned about x, y and z; the direction leaves its normal by the slopes ``skew``."""
    axes = Rotation.from_euler("xyz", turn).as_matrix()
    g, h = axes[:, 0], axes[:, 2]
    along = np.cross(g, h) + skew[0] * g + skew[1] * h
    bend = BentSheet(terms=TERMS, pinhole=PINHOLE)
    return StraightTransport(g_axis=g, h_axis=h, direction=along, origin=(1e-3, 2e-3, -1e-3), bend=bend)


def off_sheet(move: StraightTransport, points: Float64, L: float) -> Float64:
    """Return the distances of points (..., 3) from the sheet at a transport, along its normal."""
    from_origin = points - move.origin - L * np.array(move.direction)
    g, h, d = (from_origin @ each for each in (move.g_axis, move.h_axis, np.cross(move.g_axis, move.h_axis)))
    return np.asarray(d - TERMS[0] * g * g - TERMS[1] * g * h - TERMS[2] * h * h)


def along(ends: Float64) -> Float64:
    """Return 9 points on each segment, (n, 9, 3)."""
    share = np.linspace(0.0, 1.0, 9)[:, None]
    return np.asarray(ends[:, :1] + share * (ends[:, 1:] - ends[:, :1]))


def plane(z: float, slope: float = 0.0) -> npt.NDArray[np.float64]:
    """Return two triangles of 0.12 m by 0.02 m, rising along x."""
    x, y = 0.06, 0.01
    a, b, c, d = ([i, j, z + slope * i] for i, j in ((-x, -y), (x, -y), (x, y), (-x, y)))
    return np.array([[a, b, c], [a, c, d]])


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_the_line_on_a_plane_is_the_parabola(slope: float) -> None:
    move, L = transport(), 4e-3
    lit = LightSheet(transport=move, power=2.0).illuminate(Scene(plane(3e-3, slope)), L)
    points = along(lit.ends)
    x, y, z = np.moveaxis(points, -1, 0)
    np.testing.assert_allclose(z, 3e-3 + slope * x, atol=1e-15)
    # g x h is -y: the direction is -y, too.
    g, h = x - 1e-3, z + 1e-3
    bent = TERMS[0] * g * g + TERMS[1] * g * h + TERMS[2] * h * h
    error = np.abs(y - (2e-3 - L - bent))
    assert BEND_ERROR / 30.0 < error.max() < BEND_ERROR
    assert bent.max() > 1e-3
    # The segments follow each other over the whole plane, and take all the light.
    assert np.abs(lit.ends[1:, 0] - lit.ends[:-1, 1]).max() < 2.0 * BEND_ERROR
    assert lit.ends[0, 0, 0] == pytest.approx(-0.06, abs=1e-9)
    assert lit.ends[-1, 1, 0] == pytest.approx(0.06, abs=1e-9)
    assert lit.total() == pytest.approx(2.0 * 0.12, rel=1e-9)


@pytest.mark.parametrize("source", [None, (5e-3, 0.3)])
def test_the_line_on_a_sphere_is_on_both_surfaces(source: tuple[float, float] | None) -> None:
    move, L, radius = transport((0.1, -0.15, 0.2), (0.3, -0.2)), -2e-3, 20e-3
    ball = trimesh.creation.icosphere(5, radius)
    scene = Scene.of(ball)
    lit = LightSheet(transport=move, source=source).illuminate(scene, L)
    assert len(lit.power) > 50
    points = along(lit.ends)
    assert np.abs(off_sheet(move, points, L)).max() < BEND_ERROR
    # On their triangle, to rounding; so they are on the sphere up to the sag of its facets.
    beside = np.sum((points - scene.corners[lit.triangle][:, :1]) * lit.normals[:, None], axis=-1)
    assert np.abs(beside).max() < 1e-16
    sag = radius - np.linalg.norm(ball.triangles_center, axis=1).min()
    distance = np.linalg.norm(points, axis=-1)
    assert radius - 1.01 * sag < distance.min() <= distance.max() < radius * (1.0 + 1e-9)
    if source is None:
        # Parallel light: the ends of the lit line are the points of the sphere with extreme G, where its normal is g.
        reach = (points - move.origin - L * np.array(move.direction)) @ np.array(move.g_axis)
        assert lit.total() == pytest.approx(reach.max() - reach.min(), rel=1e-5)


def test_without_bend_terms_the_sheet_is_flat() -> None:
    flat = StraightTransport()
    bent = StraightTransport(bend=BentSheet(terms=(0.0, 0.0, 0.0), pinhole=PINHOLE))
    scene = Scene.of(trimesh.creation.icosphere(3, 0.02))
    one, two = (LightSheet(transport=move, source=(0.0, 0.1)).illuminate(scene, 1e-3) for move in (flat, bent))
    np.testing.assert_allclose(two.ends, one.ends, rtol=0, atol=1e-16)
    np.testing.assert_allclose(two.power, one.power, rtol=1e-12)


@pytest.mark.parametrize("doubles", [pytest.param(True, marks=pytest.mark.double), False])
def test_lit_points_are_not_hidden_by_their_own_triangle(device: Device, doubles: bool) -> None:
    """All light of a plane in view of the lens arrives: points beside their triangle would be occluded by it."""
    device = copy.copy(device)
    device.has_double = device.has_double and doubles
    # The plane rises along the normal of the sheet, so that the discretisation moves points off the plane.
    scene = Scene(plane(1e-3) @ Rotation.from_euler("x", 0.5).as_matrix().T)
    found = {}
    for terms in ((0.0, 0.0, 0.0), TERMS):
        move = StraightTransport(bend=BentSheet(terms=terms, pinhole=PINHOLE))
        direct = DirectLight(
            view=sensor_view(transport=move),
            scene=scene,
            materials=[Material(diffuse=Lambert(albedo=0.5))],
            sheet=LightSheet(transport=move, sigma=50e-6),
            device=device,
        )
        found[terms] = direct.exposures(0.0)["direct"].power.sum(axis=-1)
    # The distance to the lens changes by the bend, below 1 mm of 170 mm in view.
    np.testing.assert_allclose(found[TERMS], found[0.0, 0.0, 0.0], rtol=0.02)


def oblique(degrees: float) -> StraightTransport:
    """Return a strongly bent sheet at an angle to the transport."""
    angle = np.radians(degrees)
    bend = BentSheet(terms=(1.0, 0.0, 1.0), pinhole=PINHOLE)
    return StraightTransport(direction=(0.0, -np.sin(angle), np.cos(angle)), bend=bend)


def small_triangles(rng: np.random.Generator) -> Float64:
    """Return 50 triangles of 0.2 mm, up to 50 mm from the origin in each direction."""
    return np.asarray(rng.uniform(-0.05, 0.05, (50, 1, 3)) + rng.uniform(-1e-4, 1e-4, (50, 3, 3)))


@pytest.mark.parametrize("degrees", [90.0, 45.0, 30.0])
def test_coordinates_of_an_oblique_sheet_give_the_point(degrees: float, rng: np.random.Generator) -> None:
    move, corners = oblique(degrees), small_triangles(rng)
    index = SheetIndex.of(Scene(corners), move)
    g, h, L = np.moveaxis(index.corners, -1, 0)[..., None]
    normal = np.cross(move.g_axis, move.h_axis)
    found = g * move.g_axis + h * move.h_axis + (g * g + h * h) * normal + L * move.direction
    for points, triangle in zip(found, index.triangle, strict=True):
        # All pieces are in the plane of their triangle, and inside it: its corners are within 0.5 mm.
        a, b, c = corners[triangle]
        beside = (points - a) @ np.cross(b - a, c - a) / np.linalg.norm(np.cross(b - a, c - a))
        assert np.abs(beside).max() < 1e-14
        assert np.abs(points - a).max() < 5e-4
    assert set(index.triangle) == set(range(50))


def test_a_sheet_along_the_transport_is_refused(rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="nearly parallel to the transport"):
        SheetIndex.of(Scene(small_triangles(rng)), oblique(10.0))


def test_a_part_with_too_many_pieces_is_refused() -> None:
    # A plate of 0.4 m has about 1.3 million triangles at least; a strip of 300 m has few by its area.
    for size in ((0.5, 0.3, 0.0), (300.0, 1e-9, 0.0)):
        x, y, z = size
        plate = np.array([[[-x, -y, z], [x, -y, z], [x, y, z]], [[-x, -y, z], [x, y, z], [-x, y, z]]])
        with pytest.raises(ValueError, match=r"divides the part into at least .* triangles"):
            SheetIndex.of(Scene(plate), transport())


def test_mirrors_are_refused(device: Device) -> None:
    move = StraightTransport(bend=BentSheet(terms=TERMS, pinhole=PINHOLE))
    with pytest.raises(ValueError, match="a mirror in a bent sheet of light is not simulated"):
        DirectLight(
            view=sensor_view(transport=move),
            scene=Scene(plane(0.0)),
            materials=[Material(diffuse=Lambert(albedo=0.5), mirror=0.5)],
            sheet=LightSheet(transport=move),
            device=device,
        )
