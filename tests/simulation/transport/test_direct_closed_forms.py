"""DirectLight against closed forms of steps, corners, occlusion and spots, in parallel projection."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import UNOCCLUDED
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.sheet_cut import SheetIndex
from gpuvision.simulation.transport.slabs import Slabs
from light_of_a_sheet import GREY, TRANSPORT, light_of, plate, quad, sensor_view, two_plates, u_of

# Edges of screens 0.1 mm wide, seen from FAR [m], need the digits of doubles.
FAR, SIGMA = 1e4, 1e-4


def far_view() -> SensorView:
    return sensor_view(scale=FAR, bins=3, samples=1)


def u_per_metre(seen_by: SensorView, towards: Any) -> float:
    """Return the motion of the image of a point along u per motion of the point."""
    ends = seen_by.project(0.5 * SIGMA * np.array([towards, towards]) * [[1.0], [-1.0]])
    return float(ends[0, 0] - ends[1, 0]) / SIGMA


def bell(x: float) -> float:
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


def step_shift(k: float, x: float) -> float:
    return (k - 1.0) * bell(x) / (float(ndtr(x)) + k * float(ndtr(-x)))


# The largest shift in sigmas of the beam, by the ratio of reflectances; it equals the offset of the step.
STEPS = [(1.5, 0.162), (2.0, 0.276), (5.0, 0.636), (10.0, 0.902), (50.0, 1.485), (100.0, 1.721), (1000.0, 2.436)]


@pytest.mark.parametrize(("k", "largest"), STEPS)
def test_step_of_reflectivity(k: float, largest: float) -> None:
    found = minimize_scalar(lambda x: -step_shift(k, x), bounds=(0.0, 4.0), method="bounded", options={"xatol": 1e-12})
    assert found.x == pytest.approx(largest, abs=6e-4)
    assert -found.fun == pytest.approx(found.x, abs=1e-7)
    seen_by = far_view()
    scene, materials = two_plates(1.0 / 1024.0, k / 1024.0)
    per_sigma = SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0))
    for x in (found.x, -0.7, 2.5):
        light = light_of(scene, materials, seen_by=seen_by, sigma=SIGMA, sub_sheets=1)
        direct = light.exposures(-x * SIGMA)["direct"]
        middle = seen_by.project([0.0, -x * SIGMA, 0.0], -x * SIGMA)[0]
        shift = (u_of(direct, seen_by)[0] - middle) / per_sigma
        assert shift == pytest.approx(step_shift(k, x), rel=1e-6)


@pytest.mark.parametrize("x", [-2.0, -1.0, 0.0, 0.5, 2.0])
@pytest.mark.double
def test_half_of_the_beam_hidden(device: Device, x: float) -> None:
    """A screen before the lens hides the beam beyond x sigmas: the shift equals the shift of a step to 0."""
    seen_by = far_view()
    lens, height = np.array(seen_by.lens), 0.01
    edge = x * SIGMA + (lens[1] - x * SIGMA) * height / lens[2]
    screen = quad((-1, edge, height), (1, edge, height), (1, 1, height), (-1, 1, height))
    scene = Scene(np.concatenate([plate(), screen]))
    light = light_of(scene, seen_by=seen_by, sigma=SIGMA, sub_sheets=[x], device=device)
    shown = light.exposures(0.0, causes=True)
    shift = u_of(shown["direct"], seen_by)[0] / (SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0)))
    assert shift == pytest.approx(-bell(x) / float(ndtr(x)), rel=1e-6)
    share = shown["direct"].total()[0] / shown[UNOCCLUDED].total()[0]
    assert share == pytest.approx(float(ndtr(x)), rel=1e-6)
    assert u_of(shown[UNOCCLUDED], seen_by)[0] == pytest.approx(0.0, abs=1e-11)


def screen_before_the_lens(seen_by: SensorView, sigma: float, x: float, slope: float) -> Scene:
    """Return a plate, and a screen whose shadow for the lens lies beyond y = x sigma + slope G."""
    lens, height = np.array(seen_by.lens), 0.2
    edge = [x * sigma + slope * G + (lens[1] - x * sigma) * height / lens[2] for G in (-1.0, 1.0)]
    return Scene(
        np.concatenate([plate(), quad((-1, edge[0], height), (1, edge[1], height), (1, 3, height), (-1, 3, height))])
    )


# Sigma of the shipped sensors [m], and what the issue allows [m of range].
SHIPPED_SIGMA, ALLOWED = 60e-6, 0.5e-6


@pytest.mark.parametrize("x", [-2.2, -1.03, -0.4, 0.11, 0.5, 1.37, 2.9, 3.3])
@pytest.mark.double
def test_shipped_slabs_at_an_edge_along_the_sheet(device: Device, x: float) -> None:
    """With nine slabs, a half plane that cuts the beam gives the mean of a truncated Gaussian."""
    seen_by = far_view()
    light = light_of(
        screen_before_the_lens(seen_by, SHIPPED_SIGMA, x, 0.0),
        seen_by=seen_by,
        sigma=SHIPPED_SIGMA,
        sub_sheets=9,
        device=device,
    )
    shown = light.exposures(0.0, causes=True)
    expected = -bell(x) / float(ndtr(x)) * SHIPPED_SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0))
    per_height = u_per_metre(seen_by, (0.0, 0.0, 1.0))
    assert abs(u_of(shown["direct"], seen_by)[0] - expected) / abs(per_height) < ALLOWED
    assert shown["direct"].total()[0] / shown[UNOCCLUDED].total()[0] == pytest.approx(float(ndtr(x)), abs=2e-3)
    assert u_of(shown[UNOCCLUDED], seen_by)[0] == pytest.approx(0.0, abs=1e-11)


@pytest.mark.parametrize("angle", [0.2, 1.0, 5.0, 20.0, 60.0])
@pytest.mark.double
def test_shipped_slabs_at_an_edge_across_the_sheet(device: Device, angle: float) -> None:
    """The edge leaves each sample another part of the beam: integrals of the Gaussian along the sample."""
    seen_by = sensor_view(scale=FAR, bins=3, samples=24)
    slope, x = math.tan(math.radians(angle)), 0.3
    light = light_of(
        screen_before_the_lens(seen_by, SHIPPED_SIGMA, x, slope),
        seen_by=seen_by,
        sigma=SHIPPED_SIGMA,
        sub_sheets=9,
        device=device,
    )
    shown = light.exposures(0.0)["direct"]
    G = np.linspace(-0.03, 0.03, 600_001)
    v = seen_by.project(np.stack([G, 0.0 * G, 0.0 * G], axis=-1))[:, 1]
    sample = seen_by.sample_of(v)
    limit = x + slope * G / SHIPPED_SIGMA
    visible, moment = ndtr(limit), -np.exp(-0.5 * limit**2) / math.sqrt(math.tau)
    sums = [np.bincount(sample[sample >= 0], each[sample >= 0], 24) for each in (np.ones(len(G)), visible, moment)]
    with np.errstate(invalid="ignore", divide="ignore"):
        expected = sums[2] / sums[1] * SHIPPED_SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0))
    bright = sums[1] > 0.02 * sums[0]
    error = (u_of(shown, seen_by) - expected)[bright] / abs(u_per_metre(seen_by, (0.0, 0.0, 1.0)))
    assert 6 < bright.sum() <= 24
    assert np.abs(error).max() < ALLOWED
    share = shown.total() / shown.total().max()
    np.testing.assert_allclose(share, sums[1] / sums[0] / np.max(sums[1] / sums[0]), atol=3e-3)


@pytest.mark.parametrize(("one", "two"), [(0.0, 0.6), (0.5, -0.5), (-0.3, 0.7), (-0.6, 0.2)])
@pytest.mark.parametrize("x", [-1.0, 0.0, 0.4])
def test_corner_between_slopes(one: float, two: float, x: float) -> None:
    """Each side of a ridge or valley contributes its part of the Gaussian, weighted by its orientation to the lens."""
    seen_by = far_view()
    before = quad((-1, -1, -one), (1, -1, -one), (1, 0, 0), (-1, 0, 0))
    behind = quad((-1, 0, 0), (1, 0, 0), (1, 1, two), (-1, 1, two))
    scene, at = Scene(np.concatenate([before, behind])), -x * SIGMA
    light = light_of(scene, seen_by=seen_by, sigma=SIGMA, sub_sheets=2)
    u = u_of(light.exposures(at)["direct"], seen_by)[0] - seen_by.project([0.0, 0.0, 0.0], at)[0]
    lens = np.array(seen_by.lens) / np.linalg.norm(seen_by.lens)
    weights = [(lens[2] - slope * lens[1]) / math.hypot(1.0, slope) for slope in (one, two)]
    moves = [SIGMA * u_per_metre(seen_by, (0.0, 1.0, slope)) for slope in (one, two)]
    parts = [float(ndtr(x)), float(ndtr(-x))]
    means = [-bell(x) - x * parts[0], bell(x) - x * parts[1]]
    expected = np.dot(np.multiply(weights, moves), means) / np.dot(weights, parts)
    assert u == pytest.approx(expected, rel=2e-6)


def test_order_of_convergence_in_slabs() -> None:
    """First order where a step lies within a slab; second order on a curved surface."""
    seen_by = far_view()
    scene, materials = two_plates(0.1, 0.5)
    counts = np.array([8, 16, 32, 64, 128])
    errors = []
    for count in counts:
        shifts = []
        for x in np.linspace(-0.61, 0.67, 7):
            cuts = Slabs.uniform(int(count)).low[1:]
            light = light_of(scene, materials, seen_by=seen_by, sigma=SIGMA, sub_sheets=cuts)
            direct = light.exposures(-x * SIGMA)["direct"]
            u = u_of(direct, seen_by)[0] - seen_by.project([0.0, -x * SIGMA, 0.0], -x * SIGMA)[0]
            shifts.append(u / (SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0))) - step_shift(5.0, float(x)))
        errors.append(np.sqrt(np.mean(np.square(shifts))))
    order = -np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert 0.7 < order < 1.6
    assert errors[0] < 0.2
    turn = np.linspace(-0.3, 0.3, 20001)
    y, z = 0.01 * np.sin(turn), 0.01 * np.cos(turn)
    rows = [quad((-1, a, c), (1, a, c), (1, b, d), (-1, b, d)) for a, b, c, d in zip(y, y[1:], z, z[1:], strict=False)]
    bent = Scene(np.concatenate(rows))
    values = [
        u_of(light_of(bent, seen_by=seen_by, sigma=5e-4, sub_sheets=n).exposures(0.0)["direct"], seen_by)[0]
        for n in (8, 16, 32, 1000)
    ]
    errors = np.abs(np.array(values[:-1]) - values[-1])
    assert np.all(errors[:-1] / errors[1:] > 2.2)


def test_slabs_end_where_edges_lie_in_the_sheet() -> None:
    """A fold and a change of material divide it; a diagonal, an edge within a plane, and a skew edge do not."""
    corners = np.concatenate(
        [
            plate(1.0, 0.5) + np.array([0.0, -0.5, 0.0]),
            plate(1.0, 0.5) + np.array([0.0, 0.5, 0.0]),
            quad((-1, 1, 0), (1, 1, 0), (1, 2, 1), (-1, 2, 1)),
            quad((-1, 2, 1), (1, 2, 1), (1, 3.0, 1.5), (-1, 3.1, 1.5)),
        ]
    )
    light = light_of(Scene(corners), sigma=0.05, sub_sheets=1)
    np.testing.assert_allclose(
        SheetIndex.of(light.scene, TRANSPORT).parallel_edges, [[-1.0, 1.0, 2.0], [2.0, 2.0, 2.0]]
    )
    assert len(light.slabs(0.0).share) == 1
    np.testing.assert_allclose(light.slabs(1.02).high, [-0.4, np.inf])
    painted = light_of(Scene(corners, np.repeat([0, 1, 1, 1], 2)), (GREY, GREY), sigma=0.05, sub_sheets=2)
    np.testing.assert_allclose(painted.slabs(-0.01).high, [0.0, 0.2, np.inf])
    np.testing.assert_allclose(painted.slabs(0.5).high, [0.0, np.inf])
    by_hand = light_of(Scene(corners), sigma=0.05, sub_sheets=[0.5])
    np.testing.assert_allclose(by_hand.slabs(1.02).high, [0.5, np.inf])
    nothing = light_of(np.zeros((0, 3, 3)), sigma=0.05)
    assert len(nothing.slabs(0.0).share) == 9


def test_slabs() -> None:
    for slabs in (Slabs.uniform(1), Slabs.uniform(2), Slabs.uniform(9), Slabs.from_cuts([-1.0, 3.0, 9.0])):
        assert slabs.share.sum() == pytest.approx(1.0, rel=1e-15)
        assert slabs.share @ slabs.middle == pytest.approx(0.0, abs=1e-15)
        assert np.all((slabs.low < slabs.middle) & (slabs.middle < slabs.high))
    assert len(Slabs.uniform(9).share) == 9


@pytest.mark.parametrize("count", [1, 2, 9])
def test_a_plate_gives_a_gaussian(count: int) -> None:
    """For any number of slabs, every bin has the light that falls into it. The rounding is relative to 1.7 km."""
    seen_by = sensor_view(scale=FAR, bins=400, samples=1)
    light = light_of(plate(z=1e-3), seen_by=seen_by, sigma=SIGMA, sub_sheets=count)
    direct = light.exposures(0.0)["direct"]
    middle = seen_by.project([0.0, 0.0, 1e-3])[0]
    width = SIGMA * u_per_metre(seen_by, (0.0, 1.0, 0.0))
    edges = (seen_by.u_edges - middle) / abs(width)
    np.testing.assert_allclose(direct.power[0] / direct.total()[0], np.diff(ndtr(edges)), atol=3e-7)
    spots = -np.diff(np.exp(-0.5 * edges**2)) / math.sqrt(2 * math.pi) * abs(width)
    beside = spots + (middle - seen_by.u_centres) * np.diff(ndtr(edges))
    np.testing.assert_allclose(direct.moment[0] / direct.total()[0], beside, atol=3e-7 * abs(width))


def test_light_that_falls_beside_the_sensor_is_lost() -> None:
    """Half of the spot is beyond the end of the strips: half of the power, shift of sqrt(2 / pi) widths."""
    whole = sensor_view(scale=FAR, bins=4, samples=1)
    middle = whole.project([0.0, 0.0, 1e-3])[0]
    cut = sensor_view(scale=FAR, samples=1, u_edges=np.array([-3e-3, 0.0, middle]))
    powers, places = [], []
    for seen_by in (whole, cut):
        direct = light_of(plate(z=1e-3), seen_by=seen_by, sigma=SIGMA).exposures(0.0)["direct"]
        powers.append(direct.total()[0])
        places.append(u_of(direct, seen_by)[0])
    width = abs(SIGMA * u_per_metre(whole, (0.0, 1.0, 0.0)))
    assert powers[1] / powers[0] == pytest.approx(0.5, rel=1e-6)
    assert (places[1] - places[0]) / width == pytest.approx(-0.7979, abs=1e-4)
