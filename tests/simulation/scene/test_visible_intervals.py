"""VisibleIntervals on devices: against the ends of all hidden intervals, against shadow rays, and watertight."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from canary import Guarded
from gpuvision.host import Device
from gpuvision.reference import visible_intervals as reference
from gpuvision.simulation.scene.rays import AnyHit
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.status import Status

WAYS = pytest.mark.parametrize(
    ("variant", "dtype"),
    [("vector", np.float64), ("work_item", np.float64), ("vector", np.float32), ("work_item", np.float32)],
)
NO_MIRROR = (0.0, 0.0)


def soup(rng: np.random.Generator, count: int, size: float = 0.15) -> np.ndarray:
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, size, (count, 3, 3))
    return corners.astype(np.float32).astype(np.float64)


def some_fans(rng: np.random.Generator, count: int, mirrors: bool) -> np.ndarray:
    nears = rng.uniform(0.1, 0.9, (count, 2)) if mirrors else np.zeros((count, 2))
    return np.hstack([rng.uniform(-1.5, 1.5, (count, 9)), nears])


def parts(result: Any, n: int) -> np.ndarray:
    return result.intervals[n, : result.interval_count[n]]


@WAYS
@pytest.mark.parametrize("mirrors", [False, True])
def test_parts_as_the_reference_says(
    device: Device, variant: Any, dtype: Any, mirrors: bool, rng: np.random.Generator
) -> None:
    corners = soup(rng, 60)
    fans = some_fans(rng, 150, mirrors).astype(dtype)
    result = VisibleIntervals(scene=Scene(corners), variant=variant)(fans, device=device)
    assert not result.status.any()
    # The error of a cut is the rounding of the corners divided by the distance of a corner from the plane.
    least, tolerance = (1e-9, 1e-8) if dtype == np.float64 else (1e-5, 2e-3)
    same, several = 0, 0
    for n, fan in enumerate(fans.astype(np.float64)):
        expected = reference.visible_parts(corners, fan, least)
        if len(expected) != result.interval_count[n]:
            continue
        same += bool(np.all(np.abs(parts(result, n) - expected) < tolerance))
        several += len(expected) > 1
    assert same >= len(fans) * (0.95 if dtype == np.float32 else 1.0)
    assert several > 30


@pytest.mark.double
def test_parts_as_shadow_rays_say(device: Device, rng: np.random.Generator) -> None:
    scene = Scene.of(trimesh.creation.torus(1.0, 0.3, major_sections=40, minor_sections=20))
    fans = some_fans(rng, 200, True)
    result = VisibleIntervals(scene=scene)(fans, device=device)
    t = rng.uniform(0.0, 1.0, (200, 50))
    apex, one, two = (fans[:, None, 3 * n : 3 * n + 3] for n in range(3))
    ends = one + t[..., None] * (two - one)
    near = 1.0 / ((1.0 - t) / fans[:, 9:10] + t / fans[:, 10:])
    starts = apex + near[..., None] * (ends - apex)
    free = AnyHit(scene=scene)(np.concatenate([starts, ends], axis=-1), device=device).occluded == 0
    low, high = result.intervals[..., 0][:, None], result.intervals[..., 1][:, None]
    inside = ((t[..., None] > low) & (t[..., None] < high)).any(axis=-1)
    # The mirror of a fan cuts the torus; rays that start or end within rounding of it do not occur.
    np.testing.assert_array_equal(inside, free)
    assert 0.2 < free.mean() < 0.8


@WAYS
def test_nothing_shows_between_neighbours(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    """From inside a closed surface no outside point is visible, although hidden intervals meet at hundreds of edges."""
    scene = Scene.of(trimesh.creation.icosphere(3))
    fans = np.zeros((100, 11), dtype)
    fans[:, :3] = rng.uniform(-0.3, 0.3, (100, 3))
    ends = rng.normal(0.0, 1.0, (100, 3))
    fans[:, 3:6] = 4.0 * ends / np.linalg.norm(ends, axis=1, keepdims=True)
    fans[:, 6:9] = fans[:, 3:6] + rng.normal(0.0, 0.5, (100, 3))
    result = VisibleIntervals(scene=scene, variant=variant)(fans, device=device)
    assert not result.interval_count.any()
    assert not result.status.any()


@WAYS
def test_a_square_before_a_line(device: Device, variant: Any, dtype: Any) -> None:
    """A square at half the distance hides twice its width, from both sides; not with a mirror beyond it."""
    square = np.array([[[-1, -1, 1], [1, -1, 1], [1, 1, 1]], [[-1, -1, 1], [1, 1, 1], [-1, 1, 1]]]) * [0.1, 0.1, 1.0]
    fan = [0.02, 0.01, 0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 2.0]
    op = VisibleIntervals(scene=Scene(square), variant=variant)
    fans = np.array([[*fan, 0, 0], [*fan, 0.6, 0.6], [*fan, 0.4, 0.3]], dtype)
    result = op(fans, device=device)
    np.testing.assert_array_equal(result.interval_count, [2, 1, 2])
    expected = [[0.0, 0.5 * (1.0 - 0.22)], [0.5 * (1.0 + 0.18), 1.0]]
    for n in (0, 2):
        np.testing.assert_allclose(parts(result, n), expected, atol=1e-6 if dtype == np.float32 else 1e-12)
    np.testing.assert_array_equal(parts(result, 1), [[0.0, 1.0]])


@WAYS
def test_short_segments_are_not_hidden_by_their_own_triangle(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    """Segments of a thousandth of their triangle: its corners are up to 1000 segments away, and their fans narrow."""
    corners = 0.1 * np.array([[[-1.0, -1.0, 0.3], [1.0, -1.0, -0.2], [0.0, 1.0, 0.1]]])
    a, b, c = corners[0]
    middles = a + rng.uniform(0.05, 0.45, (500, 1)) * (b - a) + rng.uniform(0.05, 0.45, (500, 1)) * (c - a)
    angle = rng.uniform(0.0, 2.0 * np.pi, (500, 1))
    half = 5e-4 * (np.cos(angle) * (b - a) + np.sin(angle) * (c - a))
    apex = rng.uniform([-0.1, -0.1, 0.15], [0.1, 0.1, 0.35], (500, 3))
    fans = np.hstack([apex, middles - half, middles + half, np.zeros((500, 2))]).astype(dtype)
    result = VisibleIntervals(scene=Scene(corners), variant=variant)(fans, device=device)
    assert not result.status.any()
    np.testing.assert_array_equal(result.interval_count, 1)
    np.testing.assert_array_equal(result.intervals[:, 0], np.broadcast_to([0.0, 1.0], (500, 2)))


@WAYS
@pytest.mark.parametrize("corner", [0, 1, 2])
def test_a_corner_that_touches_the_plane_from_above_hides_nothing(
    device: Device, variant: Any, dtype: Any, corner: int
) -> None:
    """The corner lies in the fan, before the segment; the rest of the triangle lies on the side of the normal."""
    triangle = np.roll([[0.0, 1.0, 0.0], [-0.25, 1.0, -0.5], [0.25, 1.0, -0.5]], corner, axis=0)
    fan = np.array([[0.0, 0.0, 0.0, -1.0, 2.0, 0.0, 1.0, 2.0, 0.0, *NO_MIRROR]], dtype)
    result = VisibleIntervals(scene=Scene(triangle[None]), variant=variant)(fan, device=device)
    np.testing.assert_array_equal(parts(result, 0), [[0.0, 1.0]])


@WAYS
def test_surfaces_that_the_ends_lie_on_do_not_hide(device: Device, variant: Any, dtype: Any) -> None:
    corners = np.array([[[-1.0, -1, 0], [2, -1, 0], [-1, 2, 0]], [[-1.0, 0.5, 0], [2, 0.5, 0], [0, 0.5, 2]]])
    fans = np.array([[0.1, -1.0, 2.0, 0.0, -0.5, 0.0, 0.3, 0.5, 0.0, 0, 0]], dtype)
    np.testing.assert_array_equal(
        parts(VisibleIntervals(scene=Scene(corners), variant=variant)(fans, device=device), 0), [[0, 1]]
    )


@WAYS
def test_more_parts_than_are_kept_and_numbers_that_are_none(device: Device, variant: Any, dtype: Any) -> None:
    at = np.arange(-20, 20) / 20.0
    bars = np.array([[[x, -1, 1], [x + 0.02, -1, 1], [x + 0.01, 2, 1]] for x in at])
    fans = np.tile(np.array([[0.0, 0.0, 0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 2.0, *NO_MIRROR]], dtype), (4, 1))
    fans[1, 4], fans[2, 10] = np.nan, np.inf
    fans[3, 6:9] = -fans[3, :3] + 2 * fans[3, 3:6]  # segment on a line through the apex
    for kept, expected in ((4, Status.AMBIGUOUS), (40, 0)):
        result = VisibleIntervals(scene=Scene(bars), max_intervals=kept, variant=variant)(fans, device=device)
        np.testing.assert_array_equal(result.status, [expected, Status.NOT_FINITE, Status.NOT_FINITE, 0])
        np.testing.assert_array_equal(result.interval_count, [0 if expected else 21, 0, 0, 0])
        assert np.isnan(result.intervals[result.interval_count == 0]).all()


@WAYS
def test_more_hidden_intervals_than_there_is_room_for(device: Device, variant: Any, dtype: Any) -> None:
    """48 bars apart fit, and leave 49 parts; with one more bar nothing is claimed."""
    fan = np.array([[0.0, 0.0, 0.0, -1.0, 0.0, 2.0, 1.0, 0.0, 2.0, *NO_MIRROR]], dtype)
    for count in (47, 48, 49, 61):
        at = np.linspace(-0.48, 0.47, count)
        bars = np.array([[[x, -1, 1], [x + 0.009, -1, 1], [x + 0.0045, 2, 1]] for x in at])
        result = VisibleIntervals(scene=Scene(bars), max_intervals=49, variant=variant)(fan, device=device)
        assert result.status[0] == (0 if count <= 48 else Status.AMBIGUOUS), count
        assert result.interval_count[0] == (count + 1 if count <= 48 else 0)
        # A third of the way up the triangle it is two thirds as wide; from the apex on the line it is twice that.
        hidden = 0.5 + np.stack([at + 0.0015, at + 0.0075], axis=-1)
        expected = np.concatenate([[0.0], hidden.ravel(), [1.0]]).reshape(-1, 2)
        if count <= 48:
            np.testing.assert_allclose(parts(result, 0), expected, atol=1e-5 if dtype == np.float32 else 1e-12)
        else:
            assert np.isnan(result.intervals).all()


@pytest.mark.double
def test_writes_only_its_outputs(device: Device, rng: np.random.Generator) -> None:
    op = VisibleIntervals(scene=Scene(soup(rng, 50)))
    for shape in ((0,), (1,), (3, 7), (65,)):
        fans = some_fans(rng, int(np.prod(shape)), True).reshape(*shape, 11)
        plain = op(fans, device=device)
        guarded = Guarded(plain)
        op(fans, device=device, out=guarded.out)
        guarded.assert_intact()
        for one, two in zip(plain, guarded.out, strict=True):
            np.testing.assert_array_equal(one, two)


def test_what_it_does_not_take(device: Device, rng: np.random.Generator) -> None:
    with pytest.raises(TypeError, match="Scene"):
        VisibleIntervals(scene=soup(rng, 1))
    with pytest.raises(ValueError, match="max_intervals"):
        VisibleIntervals(scene=Scene(soup(rng, 1)), max_intervals=0)
    with pytest.raises(ValueError, match=r"\(\.\.\., 11\)"):
        VisibleIntervals(scene=Scene(soup(rng, 1)))(np.zeros((4, 9)), device=device)
    with pytest.raises(TypeError, match="float32"):
        VisibleIntervals(scene=Scene(soup(rng, 1)))(np.zeros((4, 11), np.int32), device=device)
