"""LightSheet: illumination against rays and all triangles; conservation of power, exact shadows."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.reference.sheet import first_hits
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.envelope import upper_envelope
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.lit_sheets import SheetLighting
from gpuvision.simulation.transport.sheet_cut import SheetIndex

UPRIGHT = StraightTransport()
TILTED = StraightTransport(
    g_axis=(0.8, 0.6, 0.0), h_axis=(0.0, math.tan(0.3), 1.0), direction=(-0.5, 0.8, 0.1), origin=(0.01, -0.02, 0.03)
)
SHEETS = {
    "parallel": LightSheet(transport=UPRIGHT),
    "tilted": LightSheet(transport=TILTED),
    "fan": LightSheet(transport=UPRIGHT, source=(0.1, 3.0)),
    "tilted fan": LightSheet(transport=TILTED, source=(-0.2, 2.5)),
}
BOTH = pytest.mark.parametrize("sheet", [pytest.param(sheet, id=name) for name, sheet in SHEETS.items()])


def soup(rng: np.random.Generator, count: int, size: float = 0.4) -> np.ndarray:
    return rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.normal(0.0, size, (count, 3, 3))


def quad(a: Any, b: Any, c: Any, d: Any) -> np.ndarray:
    return np.array([[a, b, c], [a, c, d]], float)


def plate(x: float, y: float, z: float = 0.0) -> np.ndarray:
    """Return a rectangle about the z axis that faces up."""
    return quad((-x, -y, z), (x, -y, z), (x, y, z), (-x, y, z))


def step(height: float, at: float = 0.0) -> np.ndarray:
    """Return two plates, the left one higher, with a wall between them."""
    left = quad((-1, -1, height), (at, -1, height), (at, 1, height), (-1, 1, height))
    right = quad((at, -1, 0), (1, -1, 0), (1, 1, 0), (at, 1, 0))
    wall = quad((at, -1, height), (at, -1, 0), (at, 1, 0), (at, 1, height))
    return np.concatenate([left, wall, right])


def rays_of(sheet: LightSheet, points: np.ndarray, L: float) -> np.ndarray:
    """Return the ray of the sheet through points, by their coordinates."""
    move = sheet.transport
    axes = np.array([move.g_axis, move.h_axis, move.direction])
    G, H, along = np.moveaxis((points - move.origin) @ np.linalg.inv(axes), -1, 0)
    np.testing.assert_allclose(along, L, atol=1e-12)
    if sheet.source is None:
        return G
    return sheet.source[0] + sheet.source[1] * (G - sheet.source[0]) / (sheet.source[1] - H)


def assert_as_rays(sheet: LightSheet, scene: Scene, L: float, lit: LitLine, rng: np.random.Generator) -> None:
    x = rays_of(sheet, lit.ends, L)
    assert np.all(x[:, 0] < x[:, 1])
    gap = x[1:, 0] - x[:-1, 1]
    # A nearly horizontal ray ends far away.
    assert np.all(gap > -1e-12 * (1.0 + x[1:, 0] ** 2))
    rays = rng.uniform(-2.0, 2.0, 300)
    rays = rays[np.abs(rays[:, None] - x.ravel()).min(axis=1, initial=np.inf) > 1e-9]
    triangle, point = first_hits(sheet, scene.corners, L, rays)
    of = np.searchsorted(x[:, 0], rays, side="right") - 1
    found = np.where((of >= 0) & (rays < x[np.maximum(of, 0), 1]), of, -1) if len(x) else np.full(len(rays), -1)
    np.testing.assert_array_equal(np.where(found >= 0, np.append(lit.triangle, -1)[found], -1), triangle)
    met = found >= 0
    start, end = lit.ends[found[met], 0], lit.ends[found[met], 1]
    along = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    beside = np.linalg.norm(np.cross(point[met] - start, along), axis=1)
    np.testing.assert_allclose(beside, 0.0, atol=1e-11)


@BOTH
@pytest.mark.parametrize("count", [1, 3, 40, 400])
def test_as_rays_of_light_say(sheet: LightSheet, count: int, rng: np.random.Generator) -> None:
    scene = Scene(soup(rng, count))
    places = rng.uniform(-1.0, 1.0, 4)
    lit, first = sheet.illuminate_all(scene, places)
    for n, L in enumerate(places):
        mine = LitLine(*(each[first[n] : first[n + 1]] for each in lit))
        assert_as_rays(sheet, scene, L, mine, rng)
        for both, alone in zip(mine, sheet.illuminate(scene, L - 0.25, 0.25), strict=True):
            np.testing.assert_array_equal(both, alone)


@settings(max_examples=60, deadline=None)
@example(seed=82, count=24, size=3.0, name="tilted fan")  # across the fan, nearer to its source than its start
@example(seed=95, count=50, size=3.0, name="fan")
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 60),
    size=st.sampled_from([1e-4, 0.1, 3.0]),
    name=st.sampled_from(sorted(SHEETS)),
)
def test_soup(seed: int, count: int, size: float, name: str) -> None:
    rng = np.random.default_rng(seed)
    scene, sheet = Scene(soup(rng, count, size)), SHEETS[name]
    L = float(rng.uniform(-0.5, 0.5))
    assert_as_rays(sheet, scene, L, sheet.illuminate(scene, L), rng)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), groups=st.integers(1, 3), count=st.integers(1, 30))
def test_envelope_on_a_lattice(seed: int, groups: int, count: int) -> None:
    """Coincident ends, coincident segments, and crossings: the envelope has the largest height everywhere."""
    rng = np.random.default_rng(seed)
    group = rng.integers(0, groups, count)
    x, height = rng.integers(0, 6, (count, 2)).astype(float), rng.integers(0, 4, (count, 2)).astype(float)
    pieces = upper_envelope(group, x, height)
    assert np.all(pieces.left < pieces.right)
    for n in range(groups):
        mine = np.flatnonzero(group[pieces.segment] == n)
        assert np.all(pieces.right[mine[:-1]] <= pieces.left[mine[1:]])
        at = rng.uniform(-0.5, 6.5, 50)
        of = (group == n)[:, None] & (x[:, :1] < at) & (at < x[:, 1:])
        with np.errstate(divide="ignore", invalid="ignore"):
            level = height[:, :1] + (at - x[:, :1]) / (x[:, 1:] - x[:, :1]) * (height[:, 1:] - height[:, :1])
        best = np.where(of, level, -np.inf).max(axis=0)
        inside = (pieces.left[mine, None] < at) & (at < pieces.right[mine, None])
        assert np.all(inside.sum(axis=0) == np.isfinite(best))
        piece, k = np.nonzero(inside)
        np.testing.assert_allclose(level[pieces.segment[mine][piece], k], best[k], atol=1e-12)


def test_envelope_of_many_long_segments(rng: np.random.Generator) -> None:
    """Each segment spans the ends of all others: computed in halves, with the same result as at once."""
    count = 1500
    x = np.stack([rng.uniform(-1.0, -0.9, count), rng.uniform(0.9, 1.0, count)], axis=1)
    height = rng.normal(size=(count, 2))
    pieces = upper_envelope(np.zeros(count, int), x, height)
    at = np.linspace(-0.95, 0.95, 777)
    level = np.stack([np.interp(at, *pair, left=-9.0, right=-9.0) for pair in zip(x, height, strict=True)])
    of = np.searchsorted(pieces.left, at, side="right") - 1
    np.testing.assert_array_equal(pieces.segment[of], np.argmax(level, axis=0))
    assert len(pieces.segment) < 60


@BOTH
def test_no_power_is_lost(sheet: LightSheet, rng: np.random.Generator) -> None:
    """Light that passes the upper parts arrives on the plate below, to rounding."""
    create = trimesh.creation
    solids = [create.box((3.0, 3.0, 0.1)), create.icosphere(3, 0.3), create.annulus(0.1, 0.4, 0.3)]
    solids[0].apply_translation((0.0, 0.0, -0.5))
    solids[2].apply_translation((0.35, 0.1, 0.1))
    scene = Scene.of(solids)
    limited = LightSheet(transport=sheet.transport, power=7.0, source=sheet.source, g_limits=(-0.7, 0.6))
    lit = limited.illuminate(scene, 0.05)
    assert len(lit.power) > 30
    np.testing.assert_allclose(lit.total(), 7.0 * 1.3, rtol=1e-13)
    assert len(np.unique(scene.material[lit.triangle])) == 3


def test_shadow_of_a_step() -> None:
    """A fan from the left over a step of 10 mm: the shadow ends where the ray over the edge meets the ground."""
    sheet = LightSheet(transport=UPRIGHT, source=(-0.5, 0.2))
    lit = sheet.illuminate(Scene(step(0.01)), 0.1)
    right = lit.ends[lit.ends[:, :, 0].min(axis=1) > 1e-6]
    assert right[:, :, 0].min() == pytest.approx(0.5 * 0.01 / 0.19, rel=1e-13)
    upright = LightSheet(transport=UPRIGHT).illuminate(Scene(step(0.01)), 0.1)
    assert not np.isin(upright.triangle, (2, 3)).any()
    assert upright.total() == pytest.approx(2.0, rel=1e-14)


def test_power_falls_with_the_cosine() -> None:
    tilt = math.radians(60.0)
    slope = quad(
        (0.0, -1.0, 0.0), (math.cos(tilt), -1.0, math.sin(tilt)), (math.cos(tilt), 1.0, math.sin(tilt)), (0.0, 1.0, 0.0)
    )
    lit = LightSheet(transport=UPRIGHT, power=3.0).illuminate(Scene(slope), 0.3)
    np.testing.assert_allclose(lit.power, 3.0 * math.cos(tilt), rtol=1e-14)
    normals = np.tile([-math.sin(tilt), 0.0, math.cos(tilt)], (len(lit.power), 1))
    np.testing.assert_allclose(lit.normals, normals, atol=1e-15)


def test_open_meshes_are_lit_on_the_side_of_the_light() -> None:
    for corners in (plate(1.0, 1.0), plate(1.0, 1.0)[:, ::-1]):
        lit = LightSheet(transport=UPRIGHT).illuminate(Scene(corners), 0.2)
        np.testing.assert_array_equal(lit.normals, np.tile([0.0, 0.0, 1.0], (len(lit.power), 1)))
        assert lit.total() == pytest.approx(2.0, rel=1e-15)


def test_normals_of_a_fan_face_the_source(rng: np.random.Generator) -> None:
    for name in ("fan", "tilted fan"):
        sheet, scene = SHEETS[name], Scene(soup(rng, 300))
        move, L = sheet.transport, 0.2
        lit = sheet.illuminate(scene, L)
        source = np.array(move.origin) + L * np.array(move.direction)
        source = source + np.array(sheet.source) @ np.array([move.g_axis, move.h_axis])
        assert np.all(np.sum(lit.normals * (source - lit.ends.mean(axis=1)), axis=1) > 0.0)
        along = lit.ends[:, 1] - lit.ends[:, 0]
        lean = np.sum(lit.normals * along, axis=1) / lit.lengths
        assert np.all(np.abs(lean) * lit.lengths < 1e-13)


def test_profile_along_the_sheet() -> None:
    """Segments end where the power has changed by 5 %; each has the integral of the profile over it."""
    bell = np.linspace(-0.8, 0.8, 41)
    table = np.stack([bell, np.exp(-0.5 * (bell / 0.25) ** 2)], axis=1)
    sheet = LightSheet(transport=UPRIGHT, power=2.0, profile=tuple(map(tuple, table)), g_limits=(-0.5, 0.9))
    lit = sheet.illuminate(Scene(plate(1.0, 1.0)), 0.1)
    G = lit.ends[:, :, 0]
    assert G.min() == -0.5
    assert G.max() == 0.8
    dense = np.linspace(0.0, 1.0, 2001)
    for (a, b), power in zip(G, lit.power, strict=True):
        exact = 2.0 * np.interp(a + (b - a) * dense, *table.T)
        assert np.trapezoid(exact, dense) == pytest.approx(power, rel=1e-6)
        # Apart from most ends within its triangle, segments are cut at the knots of the table.
        assert np.ptp(exact) <= 0.0501 * exact.max() or np.ptp(exact) <= 0.0501 * 2.0 * table[:, 1].max()


@BOTH
def test_lit_points_move_in_their_planes_along_the_light(sheet: LightSheet, rng: np.random.Generator) -> None:
    """A step of the sheet moves a lit point by the step and along the ray, and leaves it in its plane."""
    sheet = replace(sheet, sigma=1e-4)
    lighting = SimpleNamespace(sheet=sheet)
    points, normals = rng.uniform(-0.1, 0.1, (2, 20, 3))
    found = SheetLighting.shift_per_sigma(cast(SheetLighting, lighting), normals, points)
    light, step = sheet.direction_to_light(points), sheet.sigma * np.array(sheet.transport.direction)
    np.testing.assert_allclose(np.sum(found * normals, axis=1) / sheet.sigma, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cross(found - step, light) / sheet.sigma, 0.0, atol=1e-12)


def test_uniformity_of_a_fan() -> None:
    """A steep slope below a fan: power per metre is proportional to the inverse square of the depth, within 2 %."""
    slope = quad((0.0, -1.0, 0.0), (0.1, -1.0, 0.6), (0.1, 1.0, 0.6), (0.0, 1.0, 0.0))
    sheet = LightSheet(transport=UPRIGHT, source=(-1.0, 1.0), uniformity=0.02)
    lit = sheet.illuminate(Scene(slope), 0.0)
    s = lit.ends.mean(axis=1) @ np.array([0.1, 0.0, 0.6]) / 0.37
    # x = -1 + (1 + 0.1 s) / (1 - 0.6 s): its slope over the length of the slope.
    exact = (0.1 + 0.6) / (1.0 - 0.6 * s) ** 2 / math.sqrt(0.37)
    np.testing.assert_allclose(lit.power, exact, rtol=0.02)
    assert lit.total() == pytest.approx(1.1 / 0.4 - 1.0, rel=1e-13)
    assert 40 < len(lit.power) < 90


def test_joined(rng: np.random.Generator) -> None:
    """A finely divided box on a plate in a fine mesh: after joining there is one segment per face and material."""
    ground, box = trimesh.creation.box((2.0, 2.0, 0.2)), trimesh.creation.box((0.5, 0.5, 0.5))
    for _ in range(4):
        ground, box = ground.subdivide(), box.subdivide()
    scene = Scene.of([ground, box])
    lit = LightSheet(transport=TILTED).illuminate(scene, 0.013)
    joined = lit.merged(scene.material[lit.triangle])
    assert len(lit.power) > 40
    assert 3 <= len(joined.power) <= 6
    assert joined.total() == pytest.approx(lit.total(), rel=1e-13)
    lengths, at = np.cumsum(lit.lengths), np.cumsum(joined.lengths)
    np.testing.assert_allclose(np.abs(lengths[:, None] - at).min(axis=0), 0.0, atol=1e-12)
    apart = lit.merged(np.arange(len(lit.power)))
    for both, alone in zip(apart, lit, strict=True):
        np.testing.assert_array_equal(both, alone)
    nothing = LightSheet(transport=UPRIGHT).illuminate(scene, 9.0).merged(np.zeros(0, int))
    assert nothing.ends.shape == (0, 2, 3)
    bent = Scene.of(trimesh.creation.icosphere(3, 0.5))
    curve = LightSheet(transport=UPRIGHT).illuminate(bent, 0.1)
    assert len(curve.merged(np.zeros(len(curve.power), int)).power) == len(curve.power)


def test_coincident_faces_share_nothing() -> None:
    """If two faces coincide, the first one gets all the light."""
    lit = LightSheet(transport=UPRIGHT).illuminate(Scene(np.concatenate([plate(1.0, 1.0), plate(1.0, 1.0)])), 0.3)
    np.testing.assert_array_equal(np.sort(lit.triangle), [0, 1])
    assert lit.total() == 2.0


def test_solids_that_stand_in_each_other() -> None:
    """A ball that intersects a plate: its segments end on the circle of intersection."""
    ball, ground = trimesh.creation.icosphere(5, 0.3), trimesh.creation.box((2.0, 2.0, 0.2))
    scene = Scene.of([ball, ground])
    lit = LightSheet(transport=UPRIGHT).illuminate(scene, 0.05)
    on_ball = scene.material[lit.triangle] == 0
    edge = np.abs(lit.ends[on_ball][:, :, 0]).max()
    height = lit.ends[on_ball][:, :, 2].min()
    assert height == pytest.approx(0.1, abs=1e-12)
    assert edge == pytest.approx(math.sqrt(0.09 - 0.0025 - 0.01), rel=2e-3)
    assert lit.total() == pytest.approx(2.0, rel=1e-13)


def test_edge_in_the_sheet_and_face_in_the_sheet() -> None:
    """In the plane of a wall, the sheet lights the surfaces before the wall, but not the wall."""
    scene = Scene(_step_across(0.01))
    sheet = LightSheet(transport=UPRIGHT)
    before, at, behind = (sheet.illuminate(scene, L) for L in (-1e-9, 0.0, 1e-9))
    assert np.isin(at.triangle, before.triangle).all()
    for lit, height in ((before, 0.01), (at, 0.01), (behind, 0.0)):
        np.testing.assert_allclose(lit.ends[:, :, 2], height, atol=1e-17)
        assert lit.total() == pytest.approx(2.0, rel=1e-15)


def _step_across(height: float) -> np.ndarray:
    """Return two plates; the plate at y < 0 is higher."""
    return np.stack([step(height)[..., 1], step(height)[..., 0], step(height)[..., 2]], axis=-1)[:, ::-1]


def test_long_thin_triangles(rng: np.random.Generator) -> None:
    """Needle triangles along the transport, micrometres wide and metres long."""
    start = rng.uniform(-1.0, 1.0, (200, 3)) * (1.0, 0.1, 0.1)
    needles = start[:, None] + np.array([[0.0, -5.0, 0.0], [1e-6, 5.0, 0.0], [-1e-6, 5.0, 1e-6]])
    scene = Scene(np.concatenate([needles, plate(2.0, 2.0, -1.0)]))
    lit = LightSheet(transport=UPRIGHT).illuminate(scene, 0.5)
    assert lit.total() == pytest.approx(4.0, rel=1e-12)
    assert (lit.triangle < 200).sum() > 150


def test_index_finds_all_that_is_cut(rng: np.random.Generator) -> None:
    """Triangles of micrometres to metres: the index agrees with a test of all triangles."""
    size = 10.0 ** rng.uniform(-7.0, 0.5, 5000)
    corners = rng.uniform(-1.0, 1.0, (5000, 1, 3)) + rng.normal(size=(5000, 3, 3)) * size[:, None, None]
    scene = Scene(corners)
    for L in (*rng.uniform(-1.0, 1.0, 10), float(corners[17, 1, 1])):
        y = scene.corners[..., 1]
        expected = np.flatnonzero((y.min(axis=1) < L) & (y.max(axis=1) >= L))
        np.testing.assert_array_equal(np.sort(SheetIndex.of(scene, UPRIGHT).cuts([L]).triangle), expected)


def test_nothing_there() -> None:
    for scene in (Scene(np.zeros((0, 3, 3))), Scene(plate(1.0, 1.0)), Scene(np.full((2, 3, 3), np.nan))):
        lit, first = LightSheet(transport=UPRIGHT).illuminate_all(scene, [5.0, 6.0])
        assert lit.ends.shape == (0, 2, 3)
        assert lit.normals.shape == (0, 3)
        assert lit.total() == 0.0
        np.testing.assert_array_equal(first, [0, 0, 0])


def test_where_a_fan_comes_from() -> None:
    sheet = SHEETS["tilted fan"]
    move = sheet.transport
    place = np.array(move.origin) + 0.3 * np.array(move.direction)
    axes = np.array([move.g_axis, move.h_axis])
    source = place + np.array(sheet.source) @ axes
    point = place + np.array([0.2, -0.1]) @ axes
    np.testing.assert_allclose(sheet.source_positions(point), source, atol=1e-14)
    np.testing.assert_allclose(
        sheet.direction_to_light(point), (source - point) / np.linalg.norm(source - point), atol=1e-14
    )
    upright = SHEETS["tilted"]
    np.testing.assert_allclose(np.cross(upright.direction_to_light(np.zeros((4, 3))), move.h_axis), 0.0, atol=1e-15)
    with pytest.raises(ValueError, match=r"parallel light has no source"):
        upright.source_positions(point)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"power": -1.0}, "LightSheet.power is -1, expected 0 or more"),
        ({"sigma": math.nan}, "LightSheet.sigma must be finite"),
        ({"uniformity": 0.0}, "LightSheet.uniformity is 0"),
        ({"source": (0.0, -1.0)}, "LightSheet.source has H = -1 m, expected it above H = 0"),
        ({"g_limits": (1.0, 1.0)}, "LightSheet.g_limits are"),
        ({"profile": ((0.0, 1.0),)}, "LightSheet.profile: expected two rows"),
        ({"profile": ((0.0, 1.0), (1.0, -1.0))}, "LightSheet.profile: expected two rows"),
    ],
)
def test_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LightSheet(transport=UPRIGHT, **wrong)
    with pytest.raises(TypeError, match="expected a StraightTransport"):
        LightSheet(transport="upright")


@pytest.mark.slow
def test_a_million_triangles() -> None:
    """A rough height field without gaps: every profile gets all the light over its width."""
    x = np.linspace(-0.05, 0.05, 708)
    X, Y = np.meshgrid(x, x)
    Z = 2e-3 * np.sin(200.0 * X) * np.cos(170.0 * Y) + 2e-5 * np.random.default_rng(1).normal(size=X.shape)
    field = np.stack([X, Y, Z], axis=-1)
    a, b, c, d = field[:-1, :-1], field[:-1, 1:], field[1:, 1:], field[1:, :-1]
    halves = [np.stack(each, axis=-2).reshape(-1, 3, 3) for each in ((a, b, c), (a, c, d))]
    scene, sheet = Scene(np.concatenate(halves)), LightSheet(transport=UPRIGHT)
    places = np.linspace(-0.0499, 0.0499, 1000)
    for L in places:
        lit = sheet.illuminate(scene, float(L))
        assert lit.total() == pytest.approx(0.1, rel=1e-12)
        assert len(lit.power) >= 1414
    assert len(scene.corners) > 999_000


@pytest.mark.parametrize("turns", [(1, 1, 0), (1, 2, 2), (2, 1, 0), (2, 2, 1)])
@pytest.mark.parametrize("name", ["parallel", "fan"])
def test_rounding_lights_no_line_on_corners_and_walls(turns: tuple[int, int, int], name: str) -> None:
    """Cubes turned by multiples of 45 degrees: by rounding, corners reach through a sheet, and walls into its light.

    Such a line has no direction, or lies along the light. The light on the cube stays that of its width.
    """
    cube = trimesh.creation.box(extents=(2.0, 2.0, 2.0))
    for count, axis in zip(turns, np.eye(3), strict=True):
        cube.apply_transform(trimesh.transformations.rotation_matrix(count * math.pi / 4.0, axis))
    sheet, scene = SHEETS[name], Scene.of(cube)
    for L in np.unique(np.round(cube.vertices[:, 1], 9)):
        lit = sheet.illuminate(scene, float(L))
        LitSegments(lit.ends, lit.normals, lit.power)  # refuses lines outside of their surfaces
        middle = lit.ends.mean(axis=1)
        assert np.all(np.sum(lit.normals * sheet.direction_to_light(middle), axis=1) > 1e-9)
    width = np.ptp(rays_of(sheet, plane_cut(cube, 0.3), 0.3))
    lit = sheet.illuminate(scene, 0.3)
    assert float(lit.power @ lit.lengths) == pytest.approx(sheet.power * width, rel=1e-9)


def plane_cut(mesh: Any, y: float) -> np.ndarray:
    """Return the points in which the plane at y cuts the edges of a mesh."""
    a, b = np.moveaxis(mesh.vertices[mesh.edges_unique], 1, 0)
    a, b = a[crossing := (a[:, 1] < y) != (b[:, 1] < y)], b[crossing]
    points: np.ndarray = a + ((y - a[:, 1]) / (b[:, 1] - a[:, 1]))[:, None] * (b - a)
    points[:, 1] = y
    return points
