"""Oracle of the traversal of a light tree: one block of receivers, float64, every triangle tested (no hierarchy)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Reals = NDArray[np.float64]
# Occlusion is tested for clusters of at most 16 segments: of more than 8, or of fewer that one segment could represent.
_MAX_TESTED = 16
# Factor that covers the rounding of the bounds in single.
_UP = 1.0 + 256.0 * 2.0**-23
# A block gives up after 32 failed tests; each success allows 2 more.
_TESTS, _MORE_TESTS = 32, 2


class Traversal(NamedTuple):
    """Result for one block: entries and their bounds, bounds of lost and of all light, pair counts, tests left.

    An entry is ~node of a cluster, or the position of a segment, with bit 30 if nothing can occlude it.
    """

    entries: list[int]
    errors: list[float]
    sums: tuple[float, float]
    tallies: tuple[int, int]
    tests: int


@dataclass(frozen=True)
class Block:
    """Receivers with a cost and a normal: their box, mean normal, radius, deviation of the normals, and heights."""

    place: Reals
    normal: Reals
    cost: Reals
    low: Reals
    high: Reals
    centre: Reals
    mean: Reals
    radius: float
    spread: float
    slab: float
    most: float
    least: float

    @classmethod
    def of(cls, receivers: Reals, costs: Reals, middle: Reals) -> Block | None:
        """Return the block relative to the middle; None without a receiver that counts."""
        size = np.linalg.norm(receivers[:, 3:], axis=1)
        kept = (costs > 0.0) & (size > 0.0)
        if not kept.any():
            return None
        place, normal = receivers[kept, :3] - middle, receivers[kept, 3:] / size[kept, None]
        low, high = place.min(axis=0), place.max(axis=0)
        centre, mean = 0.5 * (low + high), normal.sum(axis=0)
        mean = mean / np.linalg.norm(mean)
        off = place - centre
        heights = -np.sum(normal * off, axis=1)
        radius = float(np.linalg.norm(off, axis=1).max())
        spread, slab = float(np.linalg.norm(normal - mean, axis=1).max()), float(np.abs(off @ mean).max())
        bounds = float(heights.max()), float(heights.min())
        return cls(place, normal, costs[kept], low, high, centre, mean, radius, spread, slab, *bounds)


def extent(direction: Reals, low: Reals, high: Reals) -> tuple[float, float]:
    """Return the range of a box, given from its centre, along a direction."""
    corners = np.array([[(low, high)[i][0], (low, high)[j][1], (low, high)[k][2]] for i, j, k in np.ndindex(2, 2, 2)])
    along = corners @ direction
    return float(along.min()), float(along.max())


def disc_extent(direction: Reals, normal: Reals, radius: float, slab: float) -> float:
    """Return the largest range of a disc of a thickness along a direction of length 1."""
    return float(abs(direction @ normal) * slab + np.linalg.norm(np.cross(direction, normal)) * radius)


def meeting(block: Block, node: dict[str, Any], single: bool, rounding: float) -> tuple[float, bool]:
    """Return the bound of cos cos / (pi r^2) of any two points, and whether all of both sides faces the other side."""
    to = block.centre - node["centre"]
    distance = float(np.linalg.norm(to))
    reach = min(
        extent(node["normal"], block.low - block.centre, block.high - block.centre)[1],
        disc_extent(node["normal"], block.mean, block.radius, block.slab),
    )
    behind, front = extent(block.mean, node["low"] - node["centre"], node["high"] - node["centre"])
    disc = disc_extent(block.mean, node["normal"], node["radius"], node["slab"])
    front, back = min(front, disc), min(-behind, disc)
    lit, lit_turn = node["normal"] @ to, node["spread"] * (distance + block.radius)
    got, got_turn = -block.mean @ to, block.spread * (distance + node["radius"])
    lit_most = lit + lit_turn + node["max_height"] + reach
    got_most = got + got_turn + block.most + front
    if lit_most <= 0.0 or got_most <= 0.0:
        return 0.0, False
    lit_least = lit - lit_turn + node["min_height"] - reach
    got_least = got - got_turn + block.least - back
    faces = bool(lit_least > rounding and got_least > rounding)
    gap = np.maximum(np.maximum(block.low - node["high"], node["low"] - block.high), 0.0)
    nearest = max(float(np.linalg.norm(gap)), distance - block.radius - node["radius"]) - rounding
    if nearest <= 0.0:
        return np.inf, faces
    nearest /= _UP
    cosines = min((lit_most + rounding) / nearest, 1.0) * min((got_most + rounding) / nearest, 1.0)
    along = np.pi / (nearest * node["length"]) if single else np.inf
    return _UP * cosines * min(nearest**-2, along) / np.pi, faces


def replacement_error(block: Block, node: dict[str, Any], rounding: float) -> float:
    """Return the bound of the error of the representative [W/m^2 per watt]."""
    gap = np.maximum(np.maximum(block.low - node["centre"], node["centre"] - block.high), 0.0)
    r = (float(np.linalg.norm(gap)) - rounding) / _UP
    q, arm = node["radius"] / r, node["arm"] / r
    if r <= 0.0 or q >= 1.0 or arm >= 1.0:
        return np.inf
    terms = (
        node["first_order"] / r**3,
        node["second_order"] / r**4,
        node["third_moment"] * (4.0 - 3.0 * q) / (1.0 - q) ** 2 / r**5,
        node["fourth_moment"] * (5.0 - 4.0 * arm) / (1.0 - arm) ** 2 / r**6,
    )
    return _UP * sum(terms) / np.pi


def segment_cost(block: Block, lit: dict[str, Any], length: float, rounding: float) -> float:
    """Return the bound of the cost of one watt of a segment, summed over the receivers."""
    total = 0.0
    way = lit["end"] - lit["start"]
    for place, normal, cost in zip(block.place, block.normal, block.cost, strict=True):
        from_start = place - lit["start"]
        up = from_start @ lit["normal"]
        ahead = max(-normal @ from_start, normal @ (lit["end"] - place))
        if up <= 0.0 or ahead <= 0.0:
            continue
        part = np.clip(from_start @ way / length**2, 0.0, 1.0)
        r = np.linalg.norm(from_start - part * way) - rounding
        if r <= 0.0:
            return np.inf
        r /= _UP
        cosines = min((up + rounding) / r, 1.0) * min((ahead + rounding) / r, 1.0)
        total += cost * cosines * min(r**-2, np.pi / (length * r)) / np.pi
    return float(_UP * total)


def meets_hull(corners: Reals, low: Reals, high: Reals, to_low: Reals, to_high: Reals) -> bool:
    """Return whether the box of a triangle meets the convex hull of two boxes."""
    first, last = 0.0, 1.0
    box = corners.min(axis=0), corners.max(axis=0)
    for axis in range(3):
        # low + t (to_low - low) <= the upper side of the triangle, and likewise for its lower side.
        for start, slope, limit in (
            (low[axis], to_low[axis] - low[axis], box[1][axis]),
            (-high[axis], high[axis] - to_high[axis], -box[0][axis]),
        ):
            if slope > 0.0:
                last = min(last, (limit - start) / slope)
            else:
                first = max(first, (limit - start) / slope)
    return first <= last


def rise(block: Block, corner: Reals) -> float:
    """Return the upper bound of the height of a point above the planes of the receivers."""
    way = corner - block.centre
    return float(way @ block.mean + block.spread * np.linalg.norm(way) + block.most)


def may_hide(block: Block, node: dict[str, Any], lits: list[dict[str, Any]], corners: Reals, margin: float) -> bool:
    """Return whether a triangle may occlude a part of the cluster from a receiver."""
    boxes = block.low - margin, block.high + margin, node["low"] - margin, node["high"] + margin
    if not meets_hull(corners, *boxes):
        return False
    if max(rise(block, corner) for corner in corners) <= margin:
        return False
    n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    unit = n / np.linalg.norm(n)
    heights = [
        [unit @ (end - corners[0]) for end in (lit["start"], lit["end"])]
        for lit in lits
        if max(corners @ lit["normal"]) > lit["height"] + margin
    ]
    above, below = any(max(each) > margin for each in heights), any(min(each) < -margin for each in heights)
    for place, normal in zip(block.place, block.normal, strict=True):
        side = unit @ (place - corners[0])
        if max((corners - place) @ normal) <= margin or not ((side > margin and below) or (side < -margin and above)):
            continue
        inside = True
        for one, two in ((0, 1), (1, 2), (2, 0)):
            plane = np.cross(corners[one] - place, corners[two] - place)
            plane /= np.linalg.norm(plane)
            middle = plane @ (node["centre"] - place)
            behind, front = extent(plane, node["low"] - node["centre"], node["high"] - node["centre"])
            disc = disc_extent(plane, node["normal"], node["radius"], node["slab"])
            low, high = middle + max(behind, -disc), middle + min(front, disc)
            inside &= bool(high > 0.0) if side < 0.0 else bool(low < 0.0)
        if inside:
            return True
    return False


def traverse(
    block: Block | None,
    nodes: list[dict[str, Any]],
    spans: NDArray[Any],
    lits: list[dict[str, Any]],
    share: float,
    rounding: float,
    triangles: Reals | None = None,
    margin: float = 0.0,
    *,
    clusters: bool = True,
) -> Traversal:
    """Descend the tree from node 1, children before the next sibling."""
    entries: list[int] = []
    errors: list[float] = []
    lost = whole = 0.0
    tests, tallies = _TESTS, [0, 0]
    if block is None:
        return Traversal([], [], (0.0, 0.0), (0, 0), _TESTS)
    total = float(block.cost.sum())

    def visit(number: int, is_open: bool) -> None:
        nonlocal lost, whole, tests
        node, (first, count) = nodes[number], spans[number]
        if node["power"] <= 0.0:
            return
        bound, faces = meeting(block, node, count == 1, rounding)
        scale = node["power"] * total
        most = bound * scale if bound > 0.0 else 0.0
        if count == 1 and bound > share:
            most = min(most, node["power"] * segment_cost(block, lits[first], node["length"], rounding))
        if most == 0.0 or bound <= share or most <= share * scale:
            tallies[0] += count
            lost, whole = lost + most, whole + most
            return
        wrong = 0.0 if count == 1 else replacement_error(block, node, rounding) if clusters and faces else np.inf
        is_close = wrong <= share
        if triangles is None:
            is_open = True
        elif not is_open and tests > 0 and 1 < count <= _MAX_TESTED and (2 * count > _MAX_TESTED or is_close):
            members = lits[first : first + count]
            is_open = not any(may_hide(block, node, members, each, margin) for each in triangles)
            tests += _MORE_TESTS if is_open else -1
        if count > 1 and not (is_open and is_close):
            visit(2 * number, is_open)
            visit(2 * number + 1, is_open)
            return
        if count > 1:
            tallies[1] += count
            lost += wrong * scale
        whole += most
        entries.append(~number if count > 1 else int(first) | (1 << 30 if is_open else 0))
        errors.append(most)

    visit(1, False)
    return Traversal(entries, errors, (_UP * lost, _UP * whole), (tallies[0], tallies[1]), tests)
