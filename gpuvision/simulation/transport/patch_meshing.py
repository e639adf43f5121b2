"""How a scene is cut into patches: large triangles are halved, many small ones become one outline."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.scene.scene import Scene

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
# More small triangles than that are replaced by what they look like from afar: eight corners, in so many directions.
_FEW, _CORNERS = 8, 8
# What an outline may stand off its triangles, in sizes, and which part of their area must face one way.
_THICK, _ONE_WAY = 0.25, 0.7
# A ray to an outline meets the surface that it stands for so much before it, in units of how far they are apart.
_BEFORE = 4.0


class Cut(NamedTuple):
    """A scene in patches, as `gpuvision.simulation.transport.patches.Patches` takes them."""

    corners: Reals
    patch: Integers
    origin: Integers
    slack: Reals
    looked_at: tuple[Reals, Integers, Reals]


class _Outlines(NamedTuple):
    """Polygons (n, 8, 3) in place of groups of triangles, their slack, and four receivers on each group (n, 4, 6)."""

    corners: Reals
    slack: Reals
    receivers: Reals


def cut(scene: Scene, size: float, both_sides: bool | None) -> Cut:
    """Cut a scene; see `gpuvision.simulation.transport.patches.Patches.of`."""
    numbers = scene.bvh.numbers
    corners = scene.corners[numbers]
    if both_sides is None or both_sides:
        back = ~_is_outside(corners) if both_sides is None else np.ones(len(corners), bool)
        corners = np.concatenate([corners, corners[back][:, ::-1]])
        numbers = np.concatenate([numbers, numbers[back]])
    small = longest(corners)[0] < 0.5 * size
    large, of_large = halved_to(corners[~small], numbers[~small], size)
    corners, numbers = corners[small], numbers[small]
    group = _pieces(corners, np.asarray(scene.material)[numbers], size)
    order = np.argsort(group, kind="stable")
    corners, numbers, group = corners[order], numbers[order], group[order]
    outlined, outlines = _outlined(corners, group, size)
    kept = ~outlined[group]
    first = len(outlined)
    fans, of_fan = _fans(outlines.corners)
    whole = np.flatnonzero(outlined)
    parts = np.concatenate([corners[kept], fans, large])
    patch = np.concatenate([group[kept], whole[of_fan], first + np.arange(len(large))])
    start = np.searchsorted(group, whole)
    origin = np.concatenate([numbers[kept], numbers[start][of_fan], of_large])
    by_patch = np.argsort(patch, kind="stable")
    slack = np.zeros(first + len(large))
    slack[whole] = outlines.slack
    looked_at = outlines.receivers.reshape(-1, 6), np.repeat(whole, 4), np.full(4 * len(whole), 0.25)
    return Cut(parts[by_patch], patch[by_patch], origin[by_patch], slack, looked_at)


def longest(corners: Reals) -> tuple[Reals, Integers]:
    """Return the longest edge's length of triangles (n, 3, 3), and at which corner it starts."""
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    return lengths.max(axis=1, initial=0.0), lengths.argmax(axis=1)


def in_two(corners: Reals) -> Reals:
    """Return the first halves of triangles (n, 3, 3), cut at their longest edge, then the second ones."""
    turn = (longest(corners)[1][:, None] + np.arange(3)) % 3
    a, b, c = np.moveaxis(np.take_along_axis(corners, turn[:, :, None], axis=1), 1, 0)
    between = 0.5 * (a + b)
    return np.concatenate([np.stack([a, between, c], axis=1), np.stack([between, b, c], axis=1)])


def halved_to(corners: Reals, numbers: Integers, size: float) -> tuple[Reals, Integers]:
    """Halve triangles until no edge is longer; return the pieces and the numbers of what they are of."""
    done, of = [corners[:0]], [numbers[:0]]
    while len(corners):
        fits = longest(corners)[0] <= size
        done.append(corners[fits])
        of.append(numbers[fits])
        corners, numbers = in_two(corners[~fits]), np.tile(numbers[~fits], 2)
    return np.concatenate(done), np.concatenate(of)


def _mixed(values: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return numbers that look random, the same for the same input (splitmix64)."""
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def _edges(corners: Reals) -> tuple[npt.NDArray[np.uint64], Integers]:
    """Return a number for each edge (3 n,), the same where two triangles share it, and whose it is.

    Two that are not the same have the same number with a chance of 1e-19.
    """
    bits = (corners + 0.0).view(np.uint64)
    named = _mixed(bits[:, :, 0] + _mixed(bits[:, :, 1] + _mixed(bits[:, :, 2] + np.uint64(1))))
    return (named + np.roll(named, -1, axis=1)).ravel(), np.repeat(np.arange(len(corners)), 3)


def _linked(count: int, one: Integers, other: Integers) -> Integers:
    """Give triangles that hang together the same number."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(one), np.int8), (one, other)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


def _is_outside(corners: Reals) -> Flags:
    """Whether triangles are of closed surfaces with their front outside: nobody outside sees their backs."""
    edge, face = _edges(corners)
    order = np.argsort(edge, kind="stable")
    edge, face = edge[order], face[order]
    first = np.append(True, edge[1:] != edge[:-1])
    uses = np.bincount(np.cumsum(first) - 1)[np.cumsum(first) - 1]
    again = np.flatnonzero(~first)
    label = _linked(len(corners), face[again - 1], face[again])
    a, b, c = np.moveaxis(corners - corners.mean(axis=(0, 1)), 1, 0)
    outside = np.bincount(label, np.sum(a * np.cross(b, c), axis=1)) > 0.0
    outside[label[face[uses != 2]]] = False
    return np.asarray(outside[label])


def _pieces(corners: Reals, material: npt.NDArray[np.int32], size: float) -> Integers:
    """Give what hangs together, of one material, one cell of the size and roughly one direction, the same number."""
    if not len(corners):
        return np.zeros(0, np.int64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    directions = np.rint(1.5 * normals / np.linalg.norm(normals, axis=1, keepdims=True))
    cells = np.floor(corners.mean(axis=1) / size)
    key = _mixed(material.astype(np.uint64) + np.uint64(1))
    for column in (*cells.T, *directions.T):
        key = _mixed(key + column.astype(np.int64).view(np.uint64))
    edge, face = _edges(corners)
    edge = edge + key[face]
    order = np.argsort(edge, kind="stable")
    edge, face = edge[order], face[order]
    same = np.flatnonzero(edge[1:] == edge[:-1])
    return _linked(len(corners), face[same], face[same + 1])


def _outlined(corners: Reals, group: Integers, size: float) -> tuple[Flags, _Outlines]:
    """Return which groups (ascending numbers) have an outline instead of their triangles, and those."""
    count = int(group.max(initial=-1)) + 1
    many = np.bincount(group, minlength=count) > _FEW
    if not many.any():
        return many, _Outlines(np.zeros((0, _CORNERS, 3)), np.zeros(0), np.zeros((0, 4, 6)))
    mine = many[group]
    corners = corners[mine]
    starts = np.flatnonzero(np.diff(group[mine], prepend=-1))
    own = np.repeat(np.arange(len(starts)), np.diff(starts, append=len(corners)))
    vectors = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(vectors, axis=1)
    area, vector = np.add.reduceat(areas, starts), np.add.reduceat(vectors, starts)
    one_way = np.linalg.norm(vector, axis=1)
    n = vector / np.maximum(one_way, 1e-300)[:, None]
    middle = np.add.reduceat(areas[:, None] * corners.mean(axis=1), starts) / area[:, None]
    x = np.cross(n, np.eye(3)[np.argmin(np.abs(n), axis=1)])
    x /= np.maximum(np.linalg.norm(x, axis=1, keepdims=True), 1e-300)
    frame = np.stack([x, np.cross(n, x), n], axis=1)
    local = np.einsum("tkd,tcd->tkc", corners - middle[own, None], frame[own])
    thick = np.maximum.reduceat(np.abs(local[:, :, 2]).max(axis=1), starts)
    flat = _octagons(local[:, :, :2], own, starts)
    ring = np.roll(flat, -1, axis=1)
    inside = 0.5 * np.sum(flat[:, :, 0] * ring[:, :, 1] - flat[:, :, 1] * ring[:, :, 0], axis=1)
    good = (thick <= _THICK * size) & (one_way >= _ONE_WAY * area) & (inside >= 0.2 * area)
    # As large as what it stands for.
    flat *= np.sqrt(area / np.where(good, inside, area))[:, None, None]
    outline = middle[:, None] + np.einsum("gkc,gcd->gkd", flat, frame[:, :2])
    picked = _quarters(local.mean(axis=1)[:, :2], flat, own, starts)
    places = np.concatenate([corners[picked].mean(axis=2), (vectors / areas[:, None])[picked]], axis=2)
    many[many] = good
    return many, _Outlines(outline[good], _BEFORE * thick[good], places[good])


def _octagons(places: Reals, own: Integers, starts: Integers) -> Reals:
    """Return each group's outermost corners (g, 8, 2) in eight directions, turning left; places (t, 3, 2)."""
    corners = np.empty((len(starts), _CORNERS, 2))
    every = np.arange(len(places))
    for k, angle in enumerate(2.0 * np.pi * np.arange(_CORNERS) / _CORNERS):
        reach = places @ [np.cos(angle), np.sin(angle)]
        which = np.argmax(reach, axis=1)
        furthest = reach[every, which]
        chosen = _first(furthest == np.maximum.reduceat(furthest, starts)[own], own)
        corners[:, k] = places[chosen, which[chosen]]
    return corners


def _quarters(places: Reals, flat: Reals, own: Integers, starts: Integers) -> Integers:
    """Return the triangles (g, 4) that lie next to the middles of an outline's four quarters."""
    chosen = np.empty((len(starts), 4), np.int64)
    for k in range(4):
        target = 0.5 * flat[:, 2 * k]
        away = np.sum((places - target[own]) ** 2, axis=1)
        chosen[:, k] = _first(away == np.minimum.reduceat(away, starts)[own], own)
    return chosen


def _first(flags: Flags, own: Integers) -> Integers:
    """Return the first flagged element of each group; there is one."""
    found = np.flatnonzero(flags)
    return found[np.diff(own[found], prepend=-1) > 0]


def _fans(outlines: Reals) -> tuple[Reals, Integers]:
    """Return the triangles of convex polygons (n, 8, 3), and whose they are; corners may coincide."""
    a, b, c = outlines[:, :1], outlines[:, 1:-1], outlines[:, 2:]
    triangles = np.stack([np.broadcast_to(a, b.shape), b, c], axis=2)
    double = np.linalg.norm(np.cross(b - a, c - a), axis=2)
    keep = double > 1e-9 * double.sum(axis=1, keepdims=True)
    return triangles[keep], np.nonzero(keep)[0]
