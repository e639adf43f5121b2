"""Division of a thick sheet of light where its line ends at once: at steps and behind occluding edges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.illumination import LightSheet
from gpuvision.simulation.transport.lit_sheets import SheetLighting
from gpuvision.simulation.transport.sheet_division import DividedSheets, DivisionLimits, SheetDivision
from gpuvision.simulation.transport.slabs import Slabs
from gpuvision.simulation.transport.surface_reflection import SurfaceReflection
from sensor_views import sensor_view

SIGMA = 1e-3
VIEW = sensor_view()
GREY = Material(diffuse=Lambert(albedo=0.5))


def plates(edges: list[float], heights: list[float]) -> np.ndarray:
    """Return rectangles along x between edges in y [sigmas], each at a height [m]; the outer ones reach far."""
    y = SIGMA * np.array([-40.0, *edges, 40.0])
    made = []
    for low, high, z in zip(y[:-1], y[1:], heights, strict=True):
        a, b, c, d = ([x, v, z] for x, v in ((-0.1, low), (0.1, low), (0.1, high), (-0.1, high)))
        made += [[a, b, c], [a, c, d]]
    return np.array(made)


def division(corners: np.ndarray, device: Device, **more: Any) -> SheetDivision:
    scene, sheet = Scene(corners), LightSheet(transport=VIEW.transport, sigma=SIGMA)
    values: dict[str, Any] = {"at_surface_edges": False, "at_run_ends": True, "tail_sigmas": 7.0}
    return SheetDivision(
        lighting=SheetLighting(view=VIEW, scene=scene, sheet=sheet, device=device),
        reflection=SurfaceReflection(view=VIEW, scene=scene, materials=[GREY], sheet=sheet),
        uniform=Slabs.from_cuts([-0.75, 0.6]),
        **(values | more),
    )


def cuts(found: DividedSheets, profile: int) -> np.ndarray:
    return np.asarray(found.slabs.high[found.profile == profile][:-1])


@pytest.mark.double
def test_steps_of_the_surface_divide_the_sheet(device: Device) -> None:
    """Steps down towards the lens hide nothing: a division at each edge, to half of 0.005 sigma, in each profile."""
    edges = [-1.3, 0.4]
    found = division(plates(edges, [6e-3, 3e-3, 0.0]), device).divide(np.array([0.0, 0.5 * SIGMA]), causes=False)
    assert found.line_changes
    for profile, shift in enumerate((0.0, 0.5)):
        at = np.array(edges) - shift
        mine = cuts(found, profile)
        divisions = mine[np.abs(mine[:, None] - at).min(axis=1) < 0.01]
        np.testing.assert_allclose(divisions, at, rtol=0, atol=0.0026)
        # The other divisions are those of the uniform slabs, and the outer ones.
        np.testing.assert_allclose(np.setdiff1d(mine, divisions), [-3.5, -0.75, 0.6, 3.5])
    np.testing.assert_allclose(found.slabs.share[found.profile == 1].sum(), 1.0)


@pytest.mark.double
@pytest.mark.parametrize("causes", [False, True])
def test_an_edge_that_hides_the_surface_behind_it(causes: bool, device: Device) -> None:
    """A step up towards the lens: the line is hidden from the ray over the edge to the edge, but lit all over."""
    edge, step = 0.9, 2e-3
    found = division(plates([edge], [0.0, step]), device).divide(np.array([0.25 * SIGMA]), causes=causes)
    lens = VIEW.lens_at(0.25 * SIGMA)
    ray = edge - step * (lens[1] / SIGMA - edge) / (lens[2] - step)
    at = np.array([ray, edge]) - 0.25
    assert at[0] > -1.0
    mine = cuts(found, 0)
    divisions = mine[np.abs(mine[:, None] - at).min(axis=1) < 0.01]
    np.testing.assert_allclose(divisions, at, rtol=0, atol=0.0026)
    lit = (found.lit.line.ends[..., 1] + found.lit.moved[:, None, 1]) / SIGMA
    for end in lit.T:
        np.testing.assert_allclose(end, 0.25 + found.slabs.middle[found.lit.sheet], rtol=0, atol=1e-9)
    hidden = (found.slabs.middle > at[0]) & (found.slabs.middle < at[1])
    shown = found.parts.segment[found.parts.visible]
    assert set(found.lit.sheet[shown]) == set(np.flatnonzero(~hidden))
    assert np.any(~found.parts.visible) == causes


@pytest.mark.double
def test_edges_of_the_surface_are_known_before_the_search(device: Device) -> None:
    """With edges of the surface, only the ray over the edge is searched; the edge itself is exact."""
    edge, step = 0.9, 2e-3
    both = division(plates([edge], [0.0, step]), device, at_surface_edges=True)
    np.testing.assert_allclose(both.slabs(0.0).high, [-0.75, 0.6, edge, np.inf], rtol=0, atol=1e-12)
    found = cuts(both.divide(np.array([0.0]), causes=False), 0)
    lens = VIEW.lens_at(0.0)
    ray = edge - step * (lens[1] / SIGMA - edge) / (lens[2] - step)
    assert np.abs(found - edge).min() < 1e-12
    assert np.abs(found - ray).min() < 0.0026
    np.testing.assert_allclose(np.sort(np.append([-3.5, -0.75, 0.6, edge, 3.5], ray)), found, rtol=0, atol=0.0026)


@pytest.mark.double
def test_an_even_surface_keeps_the_slabs(device: Device) -> None:
    """No outer slabs either, where no end of the line moves; with an edge across the sheet they are kept."""
    even = division(plates([], [1e-3]), device)
    found = even.divide(np.array([0.0, 1e-3]), causes=True)
    assert not found.line_changes
    for profile in (0, 1):
        np.testing.assert_array_equal(cuts(found, profile), [-0.75, 0.6])
    np.testing.assert_array_equal(found.profile, [0, 0, 0, 1, 1, 1])
    np.testing.assert_array_equal(np.unique(found.lit.sheet), np.arange(6))
    places = np.repeat([0.0, 1e-3], 3) + SIGMA * found.slabs.middle
    for end in (found.lit.line.ends[..., 1] + found.lit.moved[:, None, 1]).T:
        np.testing.assert_allclose(end, places[found.lit.sheet], rtol=0, atol=1e-12)
    skew = plates([], [1e-3])
    skew[:, :, 0] += np.where(skew[:, :, 0] > 0.0, -0.095 + 0.5 * skew[:, :, 1], 0.0)
    moving = division(skew, device).divide(np.array([0.0]), causes=False)
    assert moving.line_changes
    np.testing.assert_array_equal(cuts(moving, 0), [-3.5, -0.75, 0.6, 3.5])
    assert not list(even.slanted_parts(found, causes=True))
    (slanted,) = division(skew, device).slanted_parts(moving, causes=False)
    assert slanted.line == "visible"


@pytest.mark.double
def test_without_a_search_the_slabs_are_as_given(device: Device) -> None:
    step = plates([0.3], [1e-3, 0.0])
    plain = division(step, device, at_run_ends=False).divide(np.array([0.0]), causes=False)
    np.testing.assert_array_equal(cuts(plain, 0), [-0.75, 0.6])
    assert not plain.line_changes
    assert len(division(step, device).divide(np.zeros(0), causes=False).profile) == 0


def test_edges_close_to_each_other_divide_once(device: Device) -> None:
    """Within 1e-4 sigma the first one counts, and a uniform division gives way; beyond 4 sigma none counts."""
    edges = [-4.1, -3.9, -0.75 + 0.9e-4, 0.0, 0.9e-4, 0.6 - 1.1e-4, 3.9, 4.1]
    heights = [1e-3 * k for k in range(9)]
    found = division(plates(edges, heights), device, at_surface_edges=True).slabs(0.0)
    np.testing.assert_allclose(found.high[:-1], [-3.9, -0.75 + 0.9e-4, 0.0, 0.6 - 1.1e-4, 0.6, 3.9], rtol=0, atol=1e-10)
    longest = division(plates(edges, heights), device, at_surface_edges=True, limits=DivisionLimits(max_edges=2))
    assert len(longest.slabs(0.0).high) <= 5


def test_the_shift_of_a_lit_point_is_in_its_plane(rng: np.random.Generator, device: Device) -> None:
    """It is the motion of the sheet, plus a way along the light."""
    for source in (None, (0.01, 0.2)):
        sheet = LightSheet(transport=VIEW.transport, sigma=SIGMA, source=source)
        lighting = SheetLighting(view=VIEW, scene=Scene(plates([], [0.0])), sheet=sheet, device=device)
        points, normal = rng.uniform(-0.01, 0.01, (20, 3)), rng.normal([0.0, 0.0, 3.0], 1.0, (20, 3))
        shift = lighting.shift_per_sigma(normal, points)
        np.testing.assert_allclose(np.sum(shift * normal, axis=1), 0.0, atol=1e-15)
        along = shift - SIGMA * np.array(VIEW.transport.direction)
        light = np.array([0.0, 0.0, 1.0]) if source is None else np.array([0.01, 0.0, 0.2]) - points * [1.0, 0.0, 1.0]
        np.testing.assert_allclose(np.cross(along, light), 0.0, atol=1e-15)
