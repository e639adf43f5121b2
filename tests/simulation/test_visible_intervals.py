"""VisibleIntervals on devices: as a ray into every part says, in float64; extremes; what comes in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device
from gpuvision.simulation.scene import Scene
from gpuvision.simulation.visible_light import VisibleIntervals, Visibles
from gpuvision.status import Status
from reference import visible as reference
from reference.visible import comb, single, soup

ON_DEVICES = settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
# Builds are what takes time: each walk in one of the two types here.
WAYS = pytest.mark.parametrize(("walk", "dtype"), [("strip", np.float32), ("strip", np.float64), ("item", np.float32)])
NO_TRIANGLES = np.zeros((0, 3, 3))


def assert_intervals(corners: np.ndarray, rows: np.ndarray, result: Any, tolerance: float, rare: float) -> None:
    """A share of ``rare`` rows may have an edge that is so near the point that rounding moves it by more."""
    assert not result.status.any()
    far = 0
    for row, found, count in zip(rows, result.intervals, result.count, strict=True):
        assert np.isnan(found[count:]).all()
        flat = found[:count].ravel()
        assert (np.diff(flat) > 0.0).all()
        assert ((flat >= 0.0) & (flat <= 1.0)).all()
        far += reference.difference(found[:count], reference.from_point(corners, row)) > tolerance
    assert far <= rare * len(rows)


@WAYS
@pytest.mark.parametrize("count", [1, 17, 400])
def test_intervals_as_rays_say(device: Device, walk: Any, dtype: Any, count: int, rng: np.random.Generator) -> None:
    corners = soup(rng, count, 0.6 if count < 20 else 0.08)
    rows = single(rng.uniform(-1.0, 1.0, (100 if count < 20 else 30, 9))).astype(dtype)
    result = VisibleIntervals(scene=Scene(corners), walk=walk, most=16, clearance=0.0)(rows, device=device)
    assert result.intervals.dtype == dtype
    assert_intervals(corners, rows, result, *((2e-5, 0.05) if dtype == np.float32 else (1e-9, 0.0)))
    if count == 400:
        assert result.count.max() > 3
        assert (result.count == 0).any()


@ON_DEVICES
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 40), size=st.sampled_from([1e-2, 0.3, 3.0]))
def test_intervals_of_any_soup(device: Device, seed: int, count: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    corners, rows = soup(rng, count, size), rng.uniform(-1.0, 1.0, (7, 9))
    result = VisibleIntervals(scene=Scene(corners), most=16, clearance=0.0)(rows, device=device)
    assert_intervals(corners, rows, result, 1e-8, 0.0)


@WAYS
def test_shadow_of_a_box(device: Device, walk: Any, dtype: Any) -> None:
    scene = Scene.of(trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation((0.0, 0.0, 0.03)))
    rows = np.array([[0.0, 0.0, 0.1, -0.05, 0.0, 0.0, 0.05, 0.0, 0.0], [0.1, 0, 0, -0.05, 0.1, 0, 0.05, 0.1, 0]], dtype)
    result = VisibleIntervals(scene=scene, walk=walk)(rows, device=device)
    edge = 0.005 / 0.065  # the top's edge
    tolerance = 16 * float(np.finfo(dtype).eps)
    np.testing.assert_allclose(result.intervals[0, :2], [[0.0, 0.5 - edge], [0.5 + edge, 1.0]], atol=tolerance, rtol=0)
    np.testing.assert_array_equal(result.intervals[1, :1], [[0.0, 1.0]])
    np.testing.assert_array_equal(result.count, [2, 1])


@WAYS
def test_nothing_is_seen_through_an_edge(device: Device, walk: Any, dtype: Any, rng: np.random.Generator) -> None:
    """From within a closed surface: planes through its corners, along its edges."""
    mesh = trimesh.creation.icosphere(2)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [0.1, 0.7, 0.3]))
    corners = single(mesh.vertices)[mesh.faces]
    points = single(rng.uniform(-0.3, 0.3, (len(corners), 3)))
    points[::2] = 0.0
    rows = np.hstack([points, 2.0 * corners[:, 0], 2.0 * corners[:, 1]]).astype(dtype)
    result = VisibleIntervals(scene=Scene(corners), walk=walk)(rows, device=device)
    np.testing.assert_array_equal(result.count, 0)
    np.testing.assert_array_equal(result.status, 0)


@WAYS
def test_more_than_fits(device: Device, walk: Any, dtype: Any) -> None:
    teeth = 100
    row = np.array([[0.0, 0.0, 1.0, -0.5, 0.0, 0.0, 0.5, 0.0, 0.0]], dtype)
    scene = Scene(comb(teeth))
    many = VisibleIntervals(scene=scene, walk=walk, most=120)(row, device=device)
    assert (many.count[0], many.status[0]) == (teeth + 1, Status.OK)
    assert np.nansum(many.intervals[0, :, 1] - many.intervals[0, :, 0]) == pytest.approx(0.5, abs=1e-3)
    few = VisibleIntervals(scene=scene, walk=walk)(row, device=device)
    assert (few.count[0], few.status[0]) == (teeth + 1, Status.AMBIGUOUS)
    np.testing.assert_array_equal(few.intervals[0], many.intervals[0, :8])


@WAYS
def test_clearance(device: Device, walk: Any, dtype: Any) -> None:
    """A wall 1 mm before the segment hides it, unless that is within the clearance; so does one before the point."""
    wall = np.array([[[-1.0, -1.0, 1e-3], [1.0, -1.0, 1e-3], [0.0, 3.0, 1e-3]]])
    up, down = [0.1, 0.0, 1.0, -0.5, 0.0, 0.0, 0.5, 0.0, 0.0], [0.1, 0.0, 0.0, -0.5, 0.0, 1.0, 0.5, 0.0, 1.0]
    rows = np.array([up, down], dtype)
    for clearance, count in ((None, 0), (0.9e-3, 0), (1.2e-3, 1)):
        result = VisibleIntervals(scene=Scene(wall), walk=walk, clearance=clearance)(rows, device=device)
        np.testing.assert_array_equal(result.count, count)


@WAYS
def test_rows_that_have_no_plane(device: Device, walk: Any, dtype: Any) -> None:
    rows = np.array([np.arange(9.0)] * 4 + [[0, 0, 0, 1, 0, 0, 2, 0, 0], [0, 0, 1, 1, 0, 0, 1, 0, 0]], dtype)
    rows[:, 3] += 0.5
    rows[1, 2], rows[2, 4], rows[3, 8] = np.nan, np.inf, -np.inf
    rows[4:, 3] -= 0.5
    result = VisibleIntervals(scene=Scene(NO_TRIANGLES), walk=walk)(rows, device=device)
    np.testing.assert_array_equal(result.status, [0, 8, 8, 8, Status.HORIZON, Status.HORIZON])
    np.testing.assert_array_equal(result.count, [1, 0, 0, 0, 0, 0])
    np.testing.assert_array_equal(np.isnan(result.intervals[1:]), True)


@pytest.mark.parametrize("count", [0, 1, 15, 16, 65, 200])
@pytest.mark.parametrize("walk", ["strip", "item"])
def test_intervals_sizes_and_canaries(device: Device, walk: Any, count: int, rng: np.random.Generator) -> None:
    corners, rows = soup(rng, 300), single(rng.uniform(-1.0, 1.0, (count, 9))).astype(np.float32)
    operation = VisibleIntervals(scene=Scene(corners), walk=walk, most=2)
    like = Visibles(np.empty((count, 2, 2), np.float32), np.empty(count, np.int32), np.empty(count, np.uint8))
    guarded = Guarded(like)
    operation(rows, device=device, out=guarded.out)
    guarded.assert_intact()
    alone = VisibleIntervals(scene=Scene(corners), walk=walk, most=2)(np.repeat(rows, 2, axis=0), device=device)
    for name in Visibles._fields:
        np.testing.assert_array_equal(getattr(guarded.out, name), getattr(alone, name)[::2])


def test_wrong_parameters(device: Device) -> None:
    scene = Scene(NO_TRIANGLES)
    with pytest.raises(ValueError, match=r"clearance is -1\.0"):
        VisibleIntervals(scene=scene, clearance=-1.0)
    with pytest.raises(ValueError, match="most is 0, expected 1 or more"):
        VisibleIntervals(scene=scene, most=0)
    with pytest.raises(ValueError, match=r"rows \(\.\.\., 9\), a point and two ends, got shape \(3, 6\)"):
        VisibleIntervals(scene=scene)(np.zeros((3, 6)), device=device)
