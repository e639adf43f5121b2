"""Division of a scene into patches: large triangles are halved, many small ones are replaced by one octagon."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges
from gpuvision.simulation.transport.triangle_division import bisect_triangles, longest_edges, subdivide_to

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
# Corners of an outline.
_CORNERS = 8


@dataclass(frozen=True, kw_only=True)
class MeshingLimits:
    """Limits of the division of a scene into patches; all of them are chosen.

    The tests compare the light of scenes with and without outlines.

    Attributes
    ----------
    small
        Triangles whose longest edge is below this part of the patch size are joined. Default 0.5.
    max_triangles
        More joined triangles than this are replaced by an outline. Default 8.
    thickness
        Largest distance of the joined triangles from the outline's plane, as part of the patch size. Default 0.25.
    one_way
        Least length of the vector sum of the triangles' areas, as part of their area: they face roughly one way.
        Default 0.7.
    least_fill
        Least area of the outline before it is scaled, as part of the triangles' area. Default 0.2.
    slack
        Distance before an outline within which nothing occludes it, in units of the triangles' largest distance from
        its plane: a grazing ray meets the surface earlier. Default 4.0.
    grading
        Graded meshes: longest edge of a triangle, as part of its distance from the nearest surface that faces it.
        Default 1.0.
    least_size
        Graded meshes: least longest edge, as part of the patch size. Default 0.25.
    max_graded
        Graded meshes: largest number of large triangles, beyond which a mesh is not graded; bounds time and memory.
        Default 2000.
    """

    small: float = 0.5
    max_triangles: int = 8
    thickness: float = 0.25
    one_way: float = 0.7
    least_fill: float = 0.2
    slack: float = 4.0
    grading: float = 1.0
    least_size: float = 0.25
    max_graded: int = 2000


class PatchMesh(NamedTuple):
    """A scene in patches, in the order of the parameters of `gpuvision.simulation.transport.patches.Patches`."""

    corners: Reals
    patch: Integers
    origin: Integers
    slack: Reals
    nodes: tuple[Reals, Integers, Reals]


class _Outlines(NamedTuple):
    """Octagons (n, 8, 3) that replace groups of triangles, their slack, and four receivers per group (n, 4, 6)."""

    corners: Reals
    slack: Reals
    receivers: Reals


def mesh_scene(
    scene: Scene,
    size: float,
    both_sides: bool | None,
    limits: MeshingLimits = MeshingLimits(),
    *,
    graded: bool = False,
) -> PatchMesh:
    """Divide a scene into patches, as `gpuvision.simulation.transport.patches.Patches.from_scene` says."""
    numbers = scene.bvh.numbers
    corners = scene.corners[numbers]
    if both_sides is None or both_sides:
        back = ~_faces_outwards(corners) if both_sides is None else np.ones(len(corners), bool)
        corners = np.concatenate([corners, corners[back][:, ::-1]])
        numbers = np.concatenate([numbers, numbers[back]])
    small = longest_edges(corners)[0] < limits.small * size
    if graded and np.count_nonzero(~small) <= limits.max_graded:
        large, of_large = _subdivide_graded(corners[~small], numbers[~small], size, limits)
    else:
        large, of_large = subdivide_to(corners[~small], numbers[~small], size)
    corners, numbers = corners[small], numbers[small]
    group = _group_small(corners, np.asarray(scene.material)[numbers], size)
    order = np.argsort(group, kind="stable")
    corners, numbers, group = corners[order], numbers[order], group[order]
    outlined, outlines = _outline_groups(corners, group, size, limits)
    kept = ~outlined[group]
    first = len(outlined)
    fans, of_fan = _triangulate(outlines.corners)
    outlined_triangles = np.flatnonzero(outlined)
    parts = np.concatenate([corners[kept], fans, large])
    patch = np.concatenate([group[kept], outlined_triangles[of_fan], first + np.arange(len(large))])
    start = np.searchsorted(group, outlined_triangles)
    origin = np.concatenate([numbers[kept], numbers[start][of_fan], of_large])
    by_patch = np.argsort(patch, kind="stable")
    slack = np.zeros(first + len(large))
    slack[outlined_triangles] = outlines.slack
    nodes = (
        outlines.receivers.reshape(-1, 6),
        np.repeat(outlined_triangles, 4),
        np.full(4 * len(outlined_triangles), 0.25),
    )
    return PatchMesh(parts[by_patch], patch[by_patch], origin[by_patch], slack, nodes)


def _subdivide_graded(corners: Reals, numbers: Integers, size: float, limits: MeshingLimits) -> tuple[Reals, Integers]:
    """Halve triangles as `subdivide_to`, and further towards other triangles that face them."""
    facing = _facing_pairs(corners, size / limits.grading)
    begin, count = np.searchsorted(facing[0], np.arange(len(corners))), np.bincount(facing[0], minlength=len(corners))
    pieces, owner = corners, np.arange(len(corners))
    done, of = [corners[:0]], [owner[:0]]
    while len(pieces):
        longest = longest_edges(pieces)[0]
        allowed = np.full(len(pieces), size)
        number = np.where(longest <= size, count[owner], 0)
        piece = np.repeat(np.arange(len(pieces)), number)
        other = facing[1][concatenated_ranges(begin[owner], number)]
        away = limits.grading * _distance_to_triangles(pieces[piece].mean(axis=1), corners[other])
        np.minimum.at(allowed, piece, np.maximum(away, limits.least_size * size))
        fits = longest <= allowed
        done.append(pieces[fits])
        of.append(owner[fits])
        pieces, owner = bisect_triangles(pieces[~fits]), np.tile(owner[~fits], 2)
    return np.concatenate(done), numbers[np.concatenate(of)]


def _facing_pairs(corners: Reals, reach: float) -> tuple[Integers, Integers]:
    """Return pairs of triangles, each partly before the other, whose boxes are nearer than ``reach``; sorted."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    low, high = corners.min(axis=1), corners.max(axis=1)
    # A triangle in the plane of another one lies before it by rounding only.
    least = 1e-6 * reach
    one, two = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for k in range(len(corners)):
        near = np.flatnonzero(np.all((low <= high[k] + reach) & (high >= low[k] - reach), axis=1))
        before = ((corners[near] - corners[k, 0]) @ normals[k]).max(axis=1) > least
        back = np.einsum("nvd,nd->nv", corners[k] - corners[near][:, :1], normals[near]).max(axis=1) > least
        found = near[before & back]
        one.append(np.full(len(found), k))
        two.append(found)
    return np.concatenate(one), np.concatenate(two)


def _distance_to_triangles(points: Reals, corners: Reals) -> Reals:
    """Return the distance of each point (n, 3) from its triangle (n, 3, 3)."""
    ends = np.roll(corners, -1, axis=1)
    way, to_point = ends - corners, points[:, None] - corners
    share = np.clip(np.sum(to_point * way, axis=2) / np.sum(way * way, axis=2), 0.0, 1.0)
    from_edges = np.linalg.norm(to_point - share[..., None] * way, axis=2).min(axis=1)
    normal = np.cross(way[:, 0], way[:, 1])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    over = np.all(np.einsum("nvd,nvd->nv", np.cross(normal[:, None], way), to_point) >= 0.0, axis=1)
    return np.asarray(np.where(over, np.abs(np.sum(to_point[:, 0] * normal, axis=1)), from_edges))


def _hash64(values: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return 64-bit hashes (splitmix64)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _edge_keys(corners: Reals) -> tuple[npt.NDArray[np.uint64], Integers]:
    """Return a key for each edge (3 n,), equal for two triangles that share it, and the index of its triangle.

    Different edges have the same key with a probability of 1e-19 (hash of 64 bits).
    """
    bits = (corners + 0.0).view(np.uint64)
    named = _hash64(bits[:, :, 0] + _hash64(bits[:, :, 1] + _hash64(bits[:, :, 2] + np.uint64(1))))
    return (named + np.roll(named, -1, axis=1)).ravel(), np.repeat(np.arange(len(corners)), 3)


def _connected_components(count: int, one: Integers, other: Integers) -> Integers:
    """Return the number of the connected component of each triangle, (count,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _faces_outwards(corners: Reals) -> Flags:
    """Return whether triangles belong to closed surfaces with their front outside: their backs are never visible."""
    edge, face = _edge_keys(corners)
    order = np.argsort(edge, kind="stable")
    edge, face = edge[order], face[order]
    first = np.append(True, edge[1:] != edge[:-1])
    uses = np.bincount(np.cumsum(first) - 1)[np.cumsum(first) - 1]
    again = np.flatnonzero(~first)
    label = _connected_components(len(corners), face[again - 1], face[again])
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    outside = np.bincount(label, np.sum(a * np.cross(b, c), axis=1)) > 0.0
    outside[label[face[uses != 2]]] = False
    return np.asarray(outside[label])


def _group_small(corners: Reals, material: npt.NDArray[np.int32], size: float) -> Integers:
    """Return group numbers: connected triangles of one material, one cell of the size and roughly one direction."""
    if not len(corners):
        return np.zeros(0, np.int64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = np.rint(1.5 * normals / np.linalg.norm(normals, axis=1, keepdims=True))
    cells = np.floor(corners.mean(axis=1) / size)
    key = _hash64(material.astype(np.uint64) + np.uint64(1))
    for column in (*cells.T, *directions.T):
        key = _hash64(key + column.astype(np.int64).view(np.uint64))
    edge, face = _edge_keys(corners)
    edge = edge + key[face]
    order = np.argsort(edge, kind="stable")
    edge, face = edge[order], face[order]
    same = np.flatnonzero(edge[1:] == edge[:-1])
    return _connected_components(len(corners), face[same], face[same + 1])


def _outline_groups(corners: Reals, group: Integers, size: float, limits: MeshingLimits) -> tuple[Flags, _Outlines]:
    """Return the groups (ascending numbers) that an outline replaces, as a mask, and the outlines."""
    count = int(group.max(initial=-1)) + 1
    is_large = np.bincount(group, minlength=count) > limits.max_triangles
    if not is_large.any():
        return is_large, _Outlines(np.zeros((0, _CORNERS, 3)), np.zeros(0), np.zeros((0, 4, 6)))
    mine = is_large[group]
    corners = corners[mine]
    starts = np.flatnonzero(np.diff(group[mine], prepend=-1))
    owner = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(corners)))
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(vectors, axis=1)
    area, vector = np.add.reduceat(areas, starts), np.add.reduceat(vectors, starts)
    one_way = np.linalg.norm(vector, axis=1)
    n = vector / np.maximum(one_way, 1e-300)[:, None]
    middle = np.add.reduceat(areas[:, None] * corners.mean(axis=1), starts) / area[:, None]
    x = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    frame = np.stack([x, np.cross(n, x), n], axis=1)
    local = np.einsum("tkd,tcd->tkc", corners - middle[owner, None], frame[owner])
    thick = np.maximum.reduceat(np.abs(local[:, :, 2]).max(axis=1), starts)
    flat = _octagons(local[:, :, :2], owner, starts)
    ring = np.roll(flat, -1, axis=1)
    inside = 0.5 * np.sum(flat[:, :, 0] * ring[:, :, 1] - flat[:, :, 1] * ring[:, :, 0], axis=1)
    good = (thick <= limits.thickness * size) & (one_way >= limits.one_way * area)
    good &= inside >= limits.least_fill * area
    # Scaled to the area of the triangles that it replaces.
    flat *= np.sqrt(area / np.where(good, inside, area))[:, None, None]
    outline = middle[:, None] + np.einsum("gkc,gcd->gkd", flat, frame[:, :2])
    picked = _nearest_to_quarters(local.mean(axis=1)[:, :2], flat, owner, starts)
    places = np.concatenate([corners[picked].mean(axis=2), (vectors / areas[:, None])[picked]], axis=2)
    is_large[is_large] = good
    return is_large, _Outlines(outline[good], limits.slack * thick[good], places[good])


def _octagons(places: Reals, own: Integers, starts: Integers) -> Reals:
    """Return each group's extreme corners in eight directions, (g, 8, 2), counter-clockwise; places (t, 3, 2)."""
    corners = np.empty((len(starts), _CORNERS, 2))
    every = np.arange(len(places))
    for k, angle in enumerate(2.0 * np.pi * np.arange(_CORNERS) / _CORNERS):
        reach = places @ [np.cos(angle), np.sin(angle)]
        which = np.argmax(reach, axis=1)
        furthest = reach[every, which]
        chosen = _first_of_each(furthest == np.maximum.reduceat(furthest, starts)[own], own)
        corners[:, k] = places[chosen, which[chosen]]
    return corners


def _nearest_to_quarters(places: Reals, flat: Reals, own: Integers, starts: Integers) -> Integers:
    """Return the triangles (g, 4) nearest to the middles of an outline's four quarters."""
    chosen = np.empty((len(starts), 4), np.int64)
    for k in range(4):
        target = 0.5 * flat[:, 2 * k]
        away = np.sum((places - target[own]) ** 2, axis=1)
        chosen[:, k] = _first_of_each(away == np.minimum.reduceat(away, starts)[own], own)
    return chosen


def _first_of_each(flags: Flags, own: Integers) -> Integers:
    """Return the index of the first flagged element of each group; every group has one."""
    found = np.flatnonzero(flags)
    return found[np.diff(own[found], prepend=-1) > 0]


def _triangulate(outlines: Reals) -> tuple[Reals, Integers]:
    """Return the triangles of convex polygons (n, 8, 3), and the polygon of each; corners may coincide."""
    a, b, c = outlines[:, :1], outlines[:, 1:-1], outlines[:, 2:]
    triangles = np.stack([np.broadcast_to(a, b.shape), b, c], axis=2)
    double = np.linalg.norm(np.cross(b - a, c - a), axis=2)
    keep = double > 1e-9 * double.sum(axis=1, keepdims=True)
    return triangles[keep], np.nonzero(keep)[0]
