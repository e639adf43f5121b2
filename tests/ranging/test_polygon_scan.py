"""Point sensor behind a polygon mirror, against a ray tracer of the turning polygon."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device, to_numpy
from gpuvision.ranging.polygon import PolygonMirror
from gpuvision.ranging.polygon_scan import PolygonScan
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.status import Status

ANYWHERE = ((-math.inf, math.inf),) * 3
MIRROR = PolygonMirror(apothem=0.05, facets=8, height=0.3)
SCAN = PolygonScan(mirror=MIRROR, first_rotation=-0.2, rotation_step=0.01)


def traced(mirror: PolygonMirror, phi: float, slope: float, level: float) -> tuple[float, float, float] | None:
    """Trace the beam over the mirror to the line z = level + slope x; return x, z, length of the path from x = 1.

    The polygon's axis is at (0, height), z is up. The beam travels along -x at the height of the middle of the facet at
    rotation 0. The corners of the polygon turn by phi; the beam meets the nearest of its sides.
    """
    reach = mirror.apothem / math.cos(math.pi / mirror.facets)
    angles = -math.pi / 4 + phi + math.pi / mirror.facets * (2 * np.arange(mirror.facets + 1) - 1)
    corners = np.column_stack([reach * np.cos(angles), mirror.height + reach * np.sin(angles)])
    start = np.array([1.0, mirror.height - mirror.apothem * math.sin(math.pi / 4)])
    best = None
    for one, two in pairwise(corners):
        if (one[1] - start[1]) * (two[1] - start[1]) > 0:
            continue
        share = (start[1] - one[1]) / (two[1] - one[1])
        hit = one + share * (two - one)
        if best is None or hit[0] > best[0][0]:
            best = hit, two - one
    if best is None:
        return None
    hit, side = best
    normal = np.array([side[1], -side[0]]) / np.linalg.norm(side)
    before = np.array([-1.0, 0.0])
    after = before - 2 * (before @ normal) * normal
    falling = after[1] - slope * after[0]
    if falling >= 0:
        return None
    length = (level + slope * hit[0] - hit[1]) / falling
    place = hit + length * after
    return place[0], place[1], float(start[0] - hit[0] + length)


def readings(scan: PolygonScan, samples: int, slope: float, level: float) -> tuple[Any, Any]:
    """Return traced readings (samples,), and traced places (samples, 2) with x from the foot of the beam at rest."""
    foot = traced(scan.mirror, 0.0, 0.0, 0.0)
    assert foot is not None
    found, places = [], []
    for phi in scan.first_rotation + scan.rotation_step * np.arange(samples):
        x, z, path = traced(scan.mirror, phi, slope, level) or (math.nan,) * 3
        found.append(foot[2] - path)  # the height that the sensor shows at rest for this length of the path
        places.append((x - foot[0], z))
    return np.array(found), np.array(places)


@pytest.mark.parametrize("height_from", ["centre", "hit"])
@pytest.mark.parametrize(("slope", "level"), [(0.0, 0.0), (0.0, 0.04), (0.3, 0.02), (-0.5, 0.0)])
def test_spots_lie_where_the_beam_meets_the_object(height_from: Any, slope: float, level: float) -> None:
    height = 0.3 if height_from == "centre" else 0.3 - 0.05 * math.sqrt(0.5)
    scan = PolygonScan(
        mirror=PolygonMirror(apothem=0.05, facets=8, height=height, height_from=height_from),
        first_rotation=-0.2,
        rotation_step=0.01,
    )
    reading, place = readings(SCAN, 41, slope, level)  # SCAN measures the height from the centre
    found = scan.locate(reading[None], np.zeros((1, 41), np.uint8))
    assert np.all(to_numpy(found.status) == 0)
    np.testing.assert_allclose(to_numpy(found.g)[0], place[:, 0], rtol=0, atol=1e-13)
    np.testing.assert_allclose(to_numpy(found.h)[0], place[:, 1], rtol=0, atol=1e-13)


def test_the_height_moves_the_spot_sideways() -> None:
    phi, h = np.array([-0.2, 0.0, 0.15]), 0.06
    expected = [(traced(MIRROR, each, 0.0, h) or (0.0,))[0] for each in phi]
    foot = traced(MIRROR, 0.0, 0.0, 0.0)
    assert foot is not None
    np.testing.assert_allclose(MIRROR.position(phi, h), np.array(expected) - foot[0], rtol=0, atol=1e-14)
    # Without the height the spot would be taken 18 mm aside.
    assert abs(MIRROR.position(0.15, h) - MIRROR.position(0.15)) == pytest.approx(h * math.tan(0.3))


def test_samples_beyond_the_facet_are_flagged() -> None:
    scan = PolygonScan(mirror=MIRROR, first_rotation=-0.6, rotation_step=0.02)
    reading, _ = readings(scan, 61, 0.0, 0.0)
    found = scan.locate(np.where(np.isfinite(reading), reading, 0.0)[None], np.zeros((1, 61), np.uint8))
    status = to_numpy(found.status)[0]
    low, high = MIRROR.limits
    phi = -0.6 + 0.02 * np.arange(61)
    np.testing.assert_array_equal(status == Status.OUT_OF_RANGE, (phi < low) | (phi > high))
    np.testing.assert_array_equal(status != 0, np.isnan(to_numpy(found.h)[0]))


def test_readings_behind_the_mirror_are_flagged() -> None:
    reading = np.array([[0.0, MIRROR.drop + 1e-2, math.nan]])
    scan = PolygonScan(mirror=MIRROR, first_rotation=-0.01, rotation_step=0.01)
    found = scan.locate(reading, np.array([[0, 0, Status.LOW_SIGNAL]], np.uint8))
    np.testing.assert_array_equal(found.status, [[0, Status.OUT_OF_RANGE, Status.LOW_SIGNAL]])
    np.testing.assert_array_equal(np.isnan(found.h), [[False, True, True]])


@pytest.mark.double
@pytest.mark.parametrize("step", [0.01, -0.01])
def test_the_object_moves_during_a_sweep(device: Device, step: float) -> None:
    """A roof that moves along y: every sample is traced at the place of the object at its time."""
    scan = PolygonScan(mirror=MIRROR, first_rotation=-20 * step, rotation_step=step)
    speed, ridge = 4e-3, 0.01  # per profile [m]
    reading, expected = np.empty((6, 41)), np.empty((6, 41, 3))
    foot = traced(MIRROR, 0.0, 0.0, 0.0)
    assert foot is not None
    for profile in range(6):
        for sample in range(41):
            phi = step * (sample - 20)
            time = profile + (sample - 20) * abs(step) / (2 * math.pi / 8)
            y = speed * time  # on the object; the sheet of the beam is at rest
            x, z, path = traced(MIRROR, phi, 0.0, 0.05 - abs(y - ridge)) or (math.nan,) * 3
            reading[profile, sample], expected[profile, sample] = foot[2] - path, (x - foot[0], y, z)
    moved = scan.sample_transports(speed * np.arange(6.0), 41)
    points = scan.assemble(
        reading, moved, np.zeros((6, 41), np.uint8),
        transport=StraightTransport(), limits=ANYWHERE, device=device,
    )  # fmt: skip
    for number, coordinate in enumerate(points[:3]):
        np.testing.assert_allclose(to_numpy(coordinate), expected[:, :, number], rtol=0, atol=1e-12)
    # A stage that stops for each sweep.
    at_rest = PolygonScan(mirror=MIRROR, first_rotation=-0.2, rotation_step=0.01, is_moving=False)
    np.testing.assert_array_equal(at_rest.sample_transports(np.arange(3.0), 2), np.arange(3.0)[:, None].repeat(2, 1))


def test_an_encoder_is_interpolated_within_a_sweep() -> None:
    scan = PolygonScan(mirror=MIRROR, first_rotation=-math.pi / 16, rotation_step=math.pi / 16)  # -1/4, 0, 1/4 profile
    found = scan.sample_transports(np.array([0.0, 1.0, 5.0]), 3)
    np.testing.assert_allclose(found, [[-0.25, 0.0, 0.25], [0.75, 1.0, 2.0], [4.0, 5.0, 6.0]], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(scan.sample_transports(np.array([3.0]), 2), [[3.0, 3.0]])


def test_limits_hold_after_the_motion(device: Device) -> None:
    reading, place = readings(SCAN, 41, 0.0, 0.03)
    reading = reading.astype(np.float64 if device.has_double else np.float32)
    limits = ((-0.05, math.inf), (0.004, 0.0105), (-math.inf, math.inf))
    moved = SCAN.sample_transports(5e-3 * np.arange(4.0), 41)
    flags = np.zeros((4, 41), np.uint8)
    flags[1, 7] = Status.LOW_SIGNAL
    points = SCAN.assemble(
        np.repeat(reading[None], 4, axis=0), moved, flags, transport=StraightTransport(), limits=limits, device=device
    )
    outside = (place[None, :, 0] < -0.05) | (moved < 0.004) | (moved > 0.0105)
    outside[1, 7] = False
    np.testing.assert_array_equal((to_numpy(points.status) & Status.OUT_OF_RANGE) != 0, outside)
    assert np.isnan(to_numpy(points.x)[1, 7])
    for coordinate in points[:3]:
        np.testing.assert_array_equal(np.isnan(to_numpy(coordinate)), to_numpy(points.status) != 0)


@pytest.mark.parametrize("value", [0.0, math.nan, math.inf])
def test_a_mirror_that_stands_is_refused(value: float) -> None:
    with pytest.raises(ValueError, match=r"PolygonScan\.rotation_step (is 0|must be finite)"):
        PolygonScan(mirror=MIRROR, first_rotation=0.0, rotation_step=value)
