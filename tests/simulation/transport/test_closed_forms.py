"""Closed forms of secondary light: wedges, corners, plates, rectangles, spheres; convergence of sampled quantities."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import trimesh

from gpuvision.host import Device
from gpuvision.reference import radiosity as reference
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.patches import FormFactors, Patches
from gpuvision.simulation.transport.radiosity import Radiosity

PRECISIONS = pytest.mark.parametrize("precision", ["single", "double"])
TO = {"single": 1e-6, "double": 1e-11}
WEDGES = pytest.mark.parametrize("degrees", [30.0, 60.0, 90.0, 120.0, 150.0])
LONG = 1e7
# E_B a / M on the second wall of a corner, E_B h / M on the second of two plates; per albedo.
AT_CORNER, CORNER = (
    np.array([0.1, 0.5, 1.0, 2.0, 10.0]),
    {0.5: (0.055251, 0.184470, 0.181049, 0.092235, 0.005525), 0.8: (0.065894, 0.194054, 0.188357, 0.097027, 0.006589)},
)
AT_PLATES, PLATES = (
    np.array([0.0, 0.5, 1.0, 2.0, 5.0]),
    {
        0.5: (0.566719, 0.420983, 0.231055, 0.077624, 0.009566),
        0.8: (0.774983, 0.621929, 0.412841, 0.209082, 0.050599),
        0.95: (1.327908, 1.166791, 0.935742, 0.666250, 0.320370),
    },
)


def line(place: Any, front: Any) -> LitSegments:
    """Return a practically infinite line along y of 1 W/m."""
    ends = np.array([[place, place]], float)
    ends[0, :, 1] = -LONG, LONG
    return LitSegments(ends, [front], [1.0])


def on_wall(b: Any, omega: float) -> np.ndarray:
    """Return receivers at distances b from the edge, on the wall at an angle to the plane z = 0."""
    b = np.atleast_1d(np.asarray(b, float))
    c, s = math.cos(omega), math.sin(omega)
    return np.column_stack([b * c, 0.0 * b, b * s, *(np.full_like(b, v) for v in (s, 0.0, -c))])


@pytest.mark.double
@WEDGES
@PRECISIONS
def test_wedge_by_lines(device: Device, degrees: float, precision: Any) -> None:
    omega, b = math.radians(degrees), np.geomspace(1e-2, 1e1, 64)
    light = LineIrradiance(segments=line((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), precision=precision)
    exact = b * math.sin(omega) ** 2 / (2.0 * (1.0 + b**2 - 2.0 * b * math.cos(omega)) ** 1.5)
    np.testing.assert_allclose(light(on_wall(b, omega), device=device).irradiance, exact, rtol=TO[precision])


@pytest.mark.double
@WEDGES
@PRECISIONS
def test_wedge_by_patches(device: Device, degrees: float, precision: Any) -> None:
    """The same light, integrated over strips of the lit plane, each of which is one patch."""
    omega, b, edges = math.radians(degrees), np.geomspace(1e-1, 1e1, 64), np.array([0.0, 0.2, 1.0, 3.0, 20.0])
    # Edges with 1e4 times the length of their distance lose digits in single precision; longer edges lose more.
    length, close = (1e4, 4e-6) if precision == "single" else (1e8, 1e-11)
    floor = Patches(reference.strips(edges, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), length), np.repeat(np.arange(4), 2))
    factors = FormFactors(patches=floor, precision=precision)(on_wall(b, omega), device=device).factors
    to_edge = (b[:, None] - edges * math.cos(omega)) / np.sqrt(
        edges**2 + b[:, None] ** 2 - 2.0 * edges * b[:, None] * math.cos(omega)
    )
    exact = -0.5 * np.diff(to_edge, axis=1)
    np.testing.assert_allclose(factors, exact, atol=close, rtol=0)


@pytest.mark.double
@WEDGES
def test_power_on_the_other_wall(device: Device, degrees: float) -> None:
    """M (1 + cos(omega)) / 2 of a line reaches an infinite wall: the form factor from its points to the wall."""
    omega, width = math.radians(degrees), 1e4
    away = np.array([math.cos(omega), 0.0, math.sin(omega)])
    wall = reference.strips(np.array([0.0, width]), away, (math.sin(omega), 0.0, -math.cos(omega)), 1e8)
    factors = FormFactors(patches=Patches(wall, np.zeros(2, int)))
    a = np.geomspace(1e-3, 1.0, 16)
    points = np.column_stack([a, 0 * a, 0 * a, 0 * a, 0 * a, 1 + 0 * a])
    got = factors(points, device=device).factors[:, 0]
    c = math.cos(omega)
    exact = 0.5 * (1.0 - (a - width * c) / np.sqrt(a**2 + width**2 - 2.0 * a * width * c))
    np.testing.assert_allclose(got, exact, rtol=1e-7)
    np.testing.assert_allclose(got, {30: 0.93301, 60: 0.75, 90: 0.5, 120: 0.25, 150: 0.06699}[int(degrees)], atol=1e-4)


def gauss_in_log(beta: float, nodes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights of integrals over (0, beta]: Gauss-Legendre in ln(b) on panels of width 2."""
    low, high = math.log(1e-9), math.log(beta)
    panels = np.linspace(low, high, math.ceil((high - low) / 2.0) + 1)
    x, w = np.polynomial.legendre.leggauss(nodes)
    t = np.concatenate([p + (q - p) * (0.5 + 0.5 * x) for p, q in pairwise(panels)])
    weights = np.concatenate([0.5 * (q - p) * w for p, q in pairwise(panels)])
    return np.exp(t), weights * np.exp(t)


@pytest.mark.double
@PRECISIONS
@pytest.mark.parametrize(
    ("beta", "known"), [(1, 0.594984), (2, 0.993527), (5, 1.656779), (10, 2.224535), (100, 4.341808)]
)
def test_centroid_of_a_window_in_a_corner(device: Device, beta: float, known: float, precision: Any) -> None:
    b, weights = gauss_in_log(beta, 16)
    light = LineIrradiance(segments=line((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), precision=precision)
    got = light(on_wall(b, math.pi / 2.0), device=device).irradiance.astype(float)
    power, moment = weights @ got, (weights * b) @ got
    root = math.sqrt(1.0 + beta**2)
    assert power == pytest.approx(0.5 * (1.0 - 1.0 / root), rel=TO[precision])
    assert moment == pytest.approx(0.5 * (math.asinh(beta) - beta / root), rel=TO[precision])
    assert moment / power == pytest.approx(known, abs=5.01e-7 if precision == "double" else 5e-6)


@pytest.mark.double
def test_brightest_place_in_a_corner(device: Device) -> None:
    light = LineIrradiance(segments=line((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    b = math.sqrt(0.5) + np.linspace(-1e-3, 1e-3, 33)
    got = light(on_wall(b, math.pi / 2.0), device=device).irradiance
    assert np.argmax(got) == 16
    assert got[16] == pytest.approx(1.0 / (3.0 * math.sqrt(3.0)), rel=1e-12)


@pytest.mark.double
def test_how_the_power_in_a_window_converges(device: Device) -> None:
    """Midpoint errors are 1 / n^2; Gauss-Legendre in ln(b) gains digits with every node."""
    light = LineIrradiance(segments=line((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    exact = 0.5 * (1.0 - 1.0 / math.sqrt(1.0 + 5.0**2))

    def error(b: np.ndarray, weights: np.ndarray) -> float:
        return abs(float(weights @ light(on_wall(b, math.pi / 2.0), device=device).irradiance) / exact - 1.0)

    middles = [error(5.0 * (np.arange(n) + 0.5) / n, np.full(n, 5.0 / n)) for n in (64, 128, 256)]
    assert all(3.9 < coarse / fine < 4.1 for coarse, fine in pairwise(middles))
    gauss = [error(*gauss_in_log(5.0, n)) for n in (2, 4, 6, 8)]
    assert all(coarse > 10.0 * fine for coarse, fine in pairwise(gauss))
    assert gauss[-1] < 3e-9


@pytest.mark.double
@PRECISIONS
def test_perpendicular_rectangle(device: Device, precision: Any) -> None:
    """Rectangle of width a and height b, at distance c from an element at the foot of the corner."""
    cases = ((1.0, 1.0, 1.0), (0.1, 3.0, 2.0), (5.0, 0.2, 0.3), (40.0, 40.0, 0.1))
    # Near very long edges, single precision is less accurate.
    for a, b, c in cases[:2] if precision == "single" else cases:
        quad = np.array([[c, 0.0, 0.0], [c, 0.0, b], [c, a, b], [c, a, 0.0]])
        wall = Patches(quad[[[0, 1, 2], [0, 2, 3]]], np.zeros(2, int))
        got = FormFactors(patches=wall, precision=precision)(np.array([[0.0, 0, 0, 0, 0, 1]]), device=device).factors
        far = math.hypot(b, c)
        exact = (math.atan(a / c) - c / far * math.atan(a / far)) / math.tau
        assert got[0, 0] == pytest.approx(exact, rel=TO[precision])
        if a == b == c:
            assert got[0, 0] == pytest.approx(0.05573420, abs=5e-9 if precision == "double" else 5e-8)


@pytest.mark.double
def test_squares_that_face_each_other_and_that_meet(device: Device) -> None:
    """Form factors between squares by Gauss-Legendre over one of them; adjacent squares have an edge singularity."""
    square = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0], [1.0, 0.0, 1.0]])
    wall = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])
    both = FormFactors(patches=Patches(np.concatenate([square, wall])[[[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]]))
    root, angle = math.sqrt(2.0), math.atan(1.0 / math.sqrt(2.0))
    facing = 2.0 / math.pi * (0.5 * math.log(4.0 / 3.0) + 2.0 * root * angle - 2.0 * math.atan(1.0))
    meeting = (2.0 * math.atan(1.0) - root * angle + 0.25 * math.log(3.0 / 4.0)) / math.pi
    assert facing == pytest.approx(0.199825, abs=5e-7)
    assert meeting == pytest.approx(0.200044, abs=5e-7)
    errors = []
    for nodes in (4, 8, 16):
        x, w = np.polynomial.legendre.leggauss(nodes)
        u, v = (each.ravel() for each in np.meshgrid(0.5 + 0.5 * x, 0.5 + 0.5 * x))
        floor = np.column_stack([u, v, 0.0 * u, 0.0 * u, 0.0 * u, 1.0 + 0.0 * u])
        means = (0.25 * np.outer(w, w).ravel()) @ both(floor, device=device).factors
        errors.append((abs(means[:2].sum() / facing - 1.0), abs(means[2:].sum() / meeting - 1.0)))
    assert errors[2][0] < 1e-11
    assert errors[2][1] < 1e-4
    assert errors[1][1] < 0.3 * errors[0][1]


def between_walls(edges: np.ndarray, walls: Any, first: np.ndarray, albedo: float, length: float, device: Any) -> Any:
    """Solve two walls (across, front, from) in strips; the first light arrives on the second wall."""
    triangles = [reference.strips(edges, across, front, length) + np.asarray(start) for across, front, start in walls]
    count = len(edges) - 1
    patches = Patches(np.concatenate(triangles), np.repeat(np.arange(2 * count), 2))
    solved = Radiosity(patches=patches, albedo=np.full(2 * count, albedo), device=device)
    return solved, solved.solve(np.concatenate([np.zeros(count), np.diff(first) / np.diff(edges)]))


def plates(count: int, albedo: float, device: Device) -> tuple[np.ndarray, float]:
    """Return E_B h / M at AT_PLATES, and the power on the opposite plate over M."""
    edges = np.sinh(np.linspace(-1.0, 1.0, count + 1) * np.arcsinh(300.0))
    walls = [((1, 0, 0), (0, 0, 1), (0, 0, 0)), ((1, 0, 0), (0, 0, -1), (0, 0, 1))]
    solved, exitance = between_walls(edges, walls, edges / (2 * np.sqrt(1 + edges**2)), albedo, 1e5, device)
    receivers = np.zeros((5, 6))
    receivers[:, 0], receivers[:, 2], receivers[:, 5] = AT_PLATES, 1.0, -1.0
    light = 0.5 / (1.0 + AT_PLATES**2) ** 1.5 + solved.irradiance(receivers, exitance).irradiance
    return light, float(exitance[count:] @ np.diff(edges)) / albedo


def corner(count: int, albedo: float, device: Device) -> np.ndarray:
    """Return E_B a / M at AT_CORNER."""
    edges = np.concatenate([[0.0], np.geomspace(1e-4, 1e5, count)])
    walls = [((1, 0, 0), (0, 0, 1), (0, 0, 0)), ((0, 0, 1), (1, 0, 0), (0, 0, 0))]
    solved, exitance = between_walls(edges, walls, -0.5 / np.sqrt(1 + edges**2), albedo, 1e7, device)
    first = AT_CORNER / (2.0 * (1.0 + AT_CORNER**2) ** 1.5)
    return np.asarray(first + solved.irradiance(on_wall(AT_CORNER, math.pi / 2.0), exitance).irradiance)


def extrapolated(values: list[np.ndarray]) -> np.ndarray:
    """Return the Richardson limit of values at 1, 2, 4 times the number of patches; check second order."""
    steps = [np.abs(fine - coarse).max() for coarse, fine in pairwise(values)]
    assert all(3.5 < coarse / fine < 4.5 for coarse, fine in pairwise(steps))
    once = [(4.0 * fine - coarse) / 3.0 for coarse, fine in pairwise(values)]
    return (16.0 * once[1] - once[0]) / 15.0


@pytest.mark.double
@pytest.mark.parametrize("albedo", list(PLATES))
def test_parallel_plates_with_all_bounces(device: Device, albedo: float) -> None:
    """Equal to the table to its last digit; plates 600 gaps wide leave an error of 1e-7 for albedos up to 0.95."""
    solutions = [plates(count, albedo, device) for count in (100, 200, 400)]
    light = extrapolated([each for each, _ in solutions])
    np.testing.assert_allclose(light, PLATES[albedo], atol=1.5e-6 if albedo > 0.9 else 6e-7, rtol=0)
    if albedo < 0.9:
        assert solutions[-1][1] == pytest.approx(1.0 / (1.0 - albedo**2), rel=1e-3)


@pytest.mark.double
@pytest.mark.parametrize("albedo", [*CORNER, 1.0])
def test_corner_with_all_bounces(device: Device, albedo: float) -> None:
    """Equal to the table to its last digit, and to the solved convolution, also for white walls."""
    light = extrapolated([corner(count, albedo, device) for count in (100, 200, 400)])
    np.testing.assert_allclose(light, reference.corner_irradiance(albedo, AT_CORNER), rtol=2e-6)
    if albedo in CORNER:
        np.testing.assert_allclose(light, CORNER[albedo], atol=6e-7, rtol=0)


def sphere(finer: int, height: float = 1.0) -> tuple[Patches, Scene]:
    """Return the inside of a sphere of radius 1 up to a height."""
    triangles = np.asarray(trimesh.creation.icosphere(finer).triangles)[:, ::-1]
    triangles = triangles[triangles.mean(axis=1)[:, 2] < height]
    return Patches(triangles), Scene(triangles)


@pytest.mark.double
def test_any_two_places_in_a_sphere(device: Device) -> None:
    """The form factor is dA / (4 pi R^2) for any two places; flat facets agree to first order, the total exactly."""
    errors = []
    for finer in (2, 3):
        patches, scene = sphere(finer)
        turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 3.0))[:3, :3]
        places = np.asarray(trimesh.creation.icosphere(1).vertices) @ turn
        plain = FormFactors(patches=patches)(np.column_stack([places, -places]), device=device).factors
        # No occlusion inside a sphere.
        inside = np.column_stack([0.9 * places, -places])
        seen = FormFactors(patches=patches, scene=scene)(inside, device=device).factors
        free = FormFactors(patches=patches)(inside, device=device).factors
        np.testing.assert_allclose(seen, free, rtol=1e-14)
        np.testing.assert_allclose(free.sum(axis=1), 1.0, rtol=1e-12)
        far = np.linalg.norm(places[:, None] - patches.corners.mean(axis=1), axis=2) > 0.7
        exact = np.broadcast_to(patches.area / (4.0 * math.pi), far.shape)
        errors.append(np.abs(plain / exact - 1.0)[far].mean())
    assert errors[1] < 0.01
    assert errors[0] > 2.0 * errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("height", [1.0, 0.6])
def test_integrating_sphere(device: Device, height: float) -> None:
    """One bounce: albedo * power / (4 pi R^2) everywhere; all bounces: divided by 1 - albedo (1 - open part)."""
    albedo, errors = 0.9, []
    for finer in (2, 3):
        patches, scene = sphere(finer, height)
        solved = Radiosity(patches=patches, albedo=np.full(patches.count, albedo), scene=scene, device=device)
        start = int(np.argmin(patches.corners.mean(axis=1)[:, 2]))
        middle, normal = patches.corners[start].mean(axis=0), patches.normals[start]
        along = 1e-3 * np.cross(normal, [0.0, 1.0, 0.0])
        lit = LitSegments([[middle - along, middle + along]], [normal], [albedo / (2.0 * np.linalg.norm(along))])
        one = solved.direct_irradiance(lit)
        area = 4.0 * math.pi
        away = np.linalg.norm(patches.corners.mean(axis=1) - middle, axis=1) > 1.0
        exitance = solved.solve(one)
        closed = patches.area.sum() / trimesh.creation.icosphere(finer).area
        every = albedo / (area * (1.0 - albedo * closed))
        errors.append(
            (np.abs(one[away] / (albedo / area) - 1.0).max(), np.abs(exitance[away] / (albedo * every) - 1.0).max())
        )
    assert np.all(np.array(errors[1]) < 0.03)
    assert np.all(np.array(errors[0]) > 2.0 * np.array(errors[1]))
