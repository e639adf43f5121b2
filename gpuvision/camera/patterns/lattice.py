"""Grid index of the points of a distorted lattice, by growth from neighbour to neighbour."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from gpuvision.camera.patterns.pattern import Float64, nan_median

Int64 = npt.NDArray[np.int64]

# Largest index of a lattice, twice: side of the array of occupied nodes.
_SIDE = 1024
_STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])


@dataclass(frozen=True, kw_only=True)
class LatticeLimits:
    """Thresholds of the lattice index. Lengths are fractions of a lattice step.

    Attributes
    ----------
    neighbours : int
        Nearest points examined per point. Derived: eight lattice neighbours, and two spurious points between them.
        Default 10.
    max_asymmetry : float
        Largest length of the sum of two opposite steps. Default 0.25.
    min_sine : float
        Least sine of the angle between two steps that span a lattice. Default 0.4.
    tolerance, safe_tolerance : float
        Largest distance of a point from its predicted position: in general, and in the first pass, which accepts
        unambiguous neighbours only. Defaults 0.3 and 0.15.
    max_step_change : float
        Largest change of a step from one point to the next. Default 0.2.
    max_product : float
        Largest scalar product of the orientation vectors of two neighbours, where a pattern alternates (-1: opposite).
        Default -0.5.
    max_seeds : int
        Seeds from which patches are grown. Default 12.
    joint_points : int
        Points of the main patch nearest to another patch that predict its index; a quarter as many of the other patch.
        Default 160.
    joint_tolerance : float
        Largest deviation of the predicted index from a whole number. Default 0.2.
    min_patch_share : float
        Size, relative to the main patch, from which a patch that cannot be joined is an error; smaller ones are
        dropped. Default 0.1.
    """

    neighbours: int = 10
    max_asymmetry: float = 0.25
    min_sine: float = 0.4
    tolerance: float = 0.3
    safe_tolerance: float = 0.15
    max_step_change: float = 0.2
    max_product: float = -0.5
    max_seeds: int = 12
    joint_points: int = 160
    joint_tolerance: float = 0.2
    min_patch_share: float = 0.1


class LatticePatch(NamedTuple):
    """Indexed points of one connected patch of a lattice."""

    members: Int64
    """(n,) indices of the points."""
    nodes: Int64
    """(n, 2) column and row in the lattice, from any origin."""


def estimate_local_steps(
    points: Float64, tree: cKDTree, orientation: Float64 | None = None, limits: LatticeLimits = LatticeLimits()
) -> Float64:
    """Estimate the two lattice steps at every point from symmetric neighbours.

    The first step leads to the nearest neighbour that has a mirror image about the point, the second to the nearest
    such neighbour in another direction.

    Parameters
    ----------
    points : numpy.ndarray
        (n, 2).
    tree : scipy.spatial.cKDTree
        Search tree of the points.
    orientation : numpy.ndarray, optional
        See `index_patches`.
    limits : LatticeLimits
        Thresholds.

    Returns
    -------
    numpy.ndarray
        (n, 2, 2); NaN where the neighbours are not symmetric.
    """
    count = min(limits.neighbours + 1, len(points))
    _, neighbours = tree.query(points, count)
    steps = points[neighbours[:, 1:]] - points[:, None]
    square = np.sum(steps**2, axis=-1)
    length = np.sqrt(square)
    # |s + t|^2 of all pairs of steps s, t: 0 for opposite steps.
    sums = square[:, :, None] + square[:, None] + 2.0 * steps @ steps.transpose(0, 2, 1)
    partner = np.argmin(sums, axis=2)
    mirrored = np.take_along_axis(sums, partner[..., None], 2)[..., 0] < limits.max_asymmetry**2 * square
    if orientation is not None:
        mirrored &= np.einsum("ij,ikj->ik", orientation, orientation[neighbours[:, 1:]]) < limits.max_product
    across = np.take_along_axis(steps, partner[..., None], 1)
    straight = 0.5 * (steps - across)
    rows = np.arange(len(points))
    first = np.argmax(mirrored, axis=1)
    a = straight[rows, first]
    cross = a[:, None, 0] * steps[..., 1] - a[:, None, 1] * steps[..., 0]
    spanning = mirrored & (np.abs(cross) > limits.min_sine * length * length[rows, first, None])
    second = np.argmax(spanning, axis=1)
    bases = np.stack([a, straight[rows, second]], axis=1)
    bases[~(mirrored[rows, first] & spanning[rows, second])] = np.nan
    return bases


class _LatticeGrowth:
    """Growth of a lattice from a seed: every front predicts the neighbours of the previous front's points."""

    def __init__(
        self,
        points: Float64,
        tree: cKDTree,
        seed: int,
        basis: Float64,
        orientation: Float64 | None,
        limits: LatticeLimits,
    ) -> None:
        self.limits = limits
        self.points = points
        self.tree = tree
        self.orientation = orientation
        self.at = np.full((_SIDE, _SIDE), -1)
        self.index = np.full((len(points), 2), -1)
        self.bases = np.full((len(points), 2, 2), np.nan)
        self.bases[seed] = basis
        self._place(np.array([seed]), np.array([[_SIDE // 2, _SIDE // 2]]))

    def _place(self, members: Int64, index: Int64) -> None:
        self.index[members] = index
        self.at[index[:, 0], index[:, 1]] = members

    def grow(self, front: Int64, tolerance: float) -> Int64:
        """Find the neighbours of a front's points within a tolerance [steps]; return the new ones."""
        target = (self.index[front, None] + _STEPS).reshape(-1, 2)
        parent = np.repeat(front, len(_STEPS))
        steps = np.stack([self.bases[front], -self.bases[front]], axis=2).reshape(-1, 2)
        free = (self.at[target[:, 0], target[:, 1]] < 0) & np.all((target > 0) & (target < _SIDE - 1), axis=1)
        target, parent, steps = target[free], parent[free], steps[free]
        distance, found = self.tree.query(self.points[parent] + steps)
        error = distance / np.hypot(steps[:, 0], steps[:, 1])
        is_met = (error < tolerance) & (self.index[found, 0] < 0)
        if self.orientation is not None:
            is_met &= np.sum(self.orientation[parent] * self.orientation[found], axis=1) < self.limits.max_product
        order = np.flatnonzero(is_met)[np.argsort(error[is_met], kind="stable")]
        # Keep the best prediction of every node, then the best node of every point.
        key = target[:, 0] * _SIDE + target[:, 1]
        for names in (key, found):
            order = order[np.sort(np.unique(names[order], return_index=True)[1])]
        new: Int64 = found[order]
        self.bases[new] = self.bases[parent[order]]
        self._place(new, target[order])
        self._measure(new)
        return new

    def _measure(self, new: Int64) -> None:
        """Estimate the steps of new points from known neighbours; without neighbours the parent's step remains."""
        index = self.index[new]
        for axis in (0, 1):
            ahead, previous = (self.at[tuple((index + side * _STEPS[2 * axis]).T)] for side in (1, -1))
            forward = np.where((ahead >= 0)[:, None], self.points[ahead] - self.points[new], 0.0)
            backward = np.where((previous >= 0)[:, None], self.points[new] - self.points[previous], 0.0)
            count = (ahead >= 0).astype(int) + (previous >= 0)
            total = forward + backward
            known = np.flatnonzero(count)
            step, parents = total[known] / count[known, None], self.bases[new[known], axis]
            # Reject the steps of a spurious point.
            change = np.linalg.norm(step - parents, axis=1)
            like = change < self.limits.max_step_change * np.linalg.norm(parents, axis=1)
            self.bases[new[known[like]], axis] = step[like]


def _grow_patch(
    points: Float64, tree: cKDTree, seed: int, basis: Float64, orientation: Float64 | None, limits: LatticeLimits
) -> LatticePatch:
    """Index the points that can be reached from a seed, neighbour by neighbour.

    The first pass accepts unambiguous neighbours only. A spurious point next to a missing one can mislead the growth;
    once the nodes beyond it are occupied it has no effect.
    """
    lattice = _LatticeGrowth(points, tree, seed, basis, orientation, limits)
    members = front = np.array([seed])
    while front.size:
        while front.size:
            front = lattice.grow(front, limits.safe_tolerance)
        members = np.flatnonzero(lattice.index[:, 0] >= 0)
        front = lattice.grow(members, limits.tolerance)
    return LatticePatch(members, lattice.index[members])


def index_patches(
    points: Float64, min_points: int, orientation: Float64 | None = None, limits: LatticeLimits = LatticeLimits()
) -> list[LatticePatch]:
    """Index points on a distorted lattice; return its connected patches, the largest first.

    Parameters
    ----------
    points : numpy.ndarray
        (n, 2), spurious points among them.
    min_points : int
        Least number of points of a patch.
    orientation : numpy.ndarray, optional
        (n, 2) unit vectors that are opposite for neighbouring points, for patterns with an alternating orientation.
    limits : LatticeLimits
        Thresholds.
    """
    if len(points) < max(min_points, 5):
        return []
    tree = cKDTree(points)
    bases = estimate_local_steps(points, tree, orientation, limits)
    patches: list[LatticePatch] = []
    left = np.isfinite(bases[:, 0, 0])
    for _ in range(limits.max_seeds):
        seed = _seed(bases, left)
        if seed is None:
            break
        patch = _grow_patch(points, tree, seed, bases[seed], orientation, limits)
        left[patch.members] = False
        left[seed] = False
        if len(patch.members) >= min_points and np.ptp(patch.nodes, axis=0).all():
            patches.append(patch)
    return _without_overlap(patches, min_points)


def _seed(bases: Float64, left: npt.NDArray[np.bool_]) -> int | None:
    """Return the remaining point whose steps are nearest to the median; None if no point remains."""
    candidates = np.flatnonzero(left)
    if candidates.size == 0:
        return None
    # Steps may be swapped or rotated from point to point; their lengths and the area they span are invariant.
    a, b = bases[candidates, 0], bases[candidates, 1]
    cross = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    kind = np.log(np.stack([np.sum(a**2, 1), np.sum(b**2, 1), cross]))
    return int(candidates[np.argmin(np.sum(np.abs(kind - np.median(kind, axis=1, keepdims=True)), axis=0))])


def _without_overlap(patches: list[LatticePatch], min_points: int) -> list[LatticePatch]:
    """Remove from smaller patches the points that larger ones contain."""
    kept: list[LatticePatch] = []
    taken = np.empty(0, dtype=np.int64)
    for patch in sorted(patches, key=lambda each: len(each.members), reverse=True):
        is_new = ~np.isin(patch.members, taken)
        if np.count_nonzero(is_new) >= min_points:
            kept.append(LatticePatch(patch.members[is_new], patch.nodes[is_new]))
            taken = np.concatenate([taken, patch.members[is_new]])
    return kept


def patch_grid(patch: LatticePatch, points: Float64) -> Int64:
    """Arrange a patch as a grid of rows and columns.

    The shortest steps span the lattice; columns increase with x, rows with y.

    Returns
    -------
    numpy.ndarray
        (rows, columns) indices of points, -1 at empty nodes.
    """
    index = patch.nodes
    place = points[patch.members]
    for _ in range(2):  # on oblique axes the first reduction may not find the shortest steps yet
        steps = _mean_steps(index, place)
        if np.isfinite(steps).all():  # NaN for a single row of points along a diagonal
            index = index @ _reduction(steps).T
    index = index - index.min(axis=0)
    grid = np.full(index.max(axis=0)[::-1] + 1, -1)
    grid[index[:, 1], index[:, 0]] = patch.members
    return grid


def _mean_steps(index: Int64, place: Float64) -> Float64:
    """Return the median steps (2, 2) along the column index and the row index."""
    low = index.min(axis=0)
    at = np.full((*(index.max(axis=0) - low + 1), 2), np.nan)
    at[tuple((index - low).T)] = place
    return np.stack([nan_median(np.diff(at, axis=axis).reshape(-1, 2)) for axis in (0, 1)])


def _reduction(steps: Float64) -> Int64:
    """Return the integer matrix to the index whose steps are the shortest, right-handed, and along x and y."""
    a, b = steps
    new = np.eye(2, dtype=np.int64)  # rows: new steps in the old ones
    while True:  # Gauss' reduction
        if a @ a > b @ b:
            a, b, new = b, a, new[::-1]
        shift = round(float(a @ b / (a @ a)))
        if shift == 0:
            break
        b, new = b - shift * a, np.stack([new[0], new[1] - shift * new[0]])
    options = []
    for first, second in ((0, 1), (1, 0)):
        for i in (1, -1):
            for j in (1, -1):
                rows = np.stack([i * new[first], j * new[second]])
                u, v = rows @ steps
                if u[0] * v[1] - u[1] * v[0] > 0.0:
                    unit = u[0] / np.hypot(*u) + v[1] / np.hypot(*v)
                    options.append((float(unit), rows))
    best = max(options, key=lambda option: option[0])[1]
    # A point is index @ steps = new_index @ (best @ steps).
    return np.rint(np.linalg.inv(best.T)).astype(np.int64)


def join_patches(
    patches: list[LatticePatch], points: Float64, limits: LatticeLimits = LatticeLimits()
) -> tuple[LatticePatch, list[LatticePatch]]:
    """Join patches that continue the lattice of the largest one; return the result and the remaining patches."""
    joined, separate = patches[0], patches[1:]
    while True:
        for patch in separate:
            index = _index_in(joined, patch, points, limits)
            if index is not None:
                members, nodes = np.concatenate([joined.members, patch.members]), np.concatenate([joined.nodes, index])
                joined = LatticePatch(members, nodes)
                separate = [each for each in separate if each is not patch]
                break
        else:
            return joined, separate


def _index_in(whole: LatticePatch, patch: LatticePatch, points: Float64, limits: LatticeLimits) -> Int64 | None:
    """Return the index of a patch in the lattice of the main patch, or None if they do not fit together.

    Near the patch, the index of the main patch is a smooth (quadratic) function of the position. Extrapolated to the
    patch it must equal the patch's index up to an integer rotation and shift.
    """
    place, other = points[whole.members], points[patch.members]
    distance, _ = cKDTree(place).query(other)
    anchor = other[np.argmin(distance)]
    nearest = np.argsort(np.linalg.norm(place - anchor, axis=1))[: limits.joint_points]
    ends = np.argsort(np.linalg.norm(other - anchor, axis=1))[: limits.joint_points // 4]
    scale = np.ptp(place[nearest])
    design, design_at_ends = (_quadratic((each - anchor) / scale) for each in (place[nearest], other[ends]))
    guess = design_at_ends @ np.linalg.lstsq(design, whole.nodes[nearest].astype(np.float64), rcond=None)[0]
    nodes = patch.nodes[ends].astype(np.float64)
    rotation = np.rint(np.linalg.lstsq(nodes - nodes.mean(axis=0), guess - guess.mean(axis=0), rcond=None)[0]).astype(
        np.int64
    )
    if abs(round(float(np.linalg.det(rotation)))) != 1:
        return None
    offset = guess - nodes @ rotation
    shift = np.rint(np.median(offset, axis=0)).astype(np.int64)
    deviation, bias = np.median(np.abs(offset - shift)), np.max(np.abs(np.median(offset, axis=0) - shift))
    if deviation > limits.joint_tolerance or bias > 2.0 * limits.joint_tolerance:
        return None
    index = patch.nodes @ rotation + shift
    taken = {tuple(each) for each in whole.nodes.tolist()}
    return None if any(tuple(each) in taken for each in index.tolist()) else index


def _quadratic(at: Float64) -> Float64:
    """Return the design matrix (n, 6) of a quadratic polynomial at points (n, 2)."""
    x, y = at.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def index_grid(points: Float64, min_points: int, name: str, limits: LatticeLimits = LatticeLimits()) -> Int64:
    """Arrange points in rows and columns; bridge gaps behind which the grid continues.

    Parameters
    ----------
    points : numpy.ndarray
        (n, 2), spurious points among them.
    min_points : int
        Least number of points.
    name : str
        Name of the points in error messages, plural.
    limits : LatticeLimits
        Thresholds.

    Returns
    -------
    numpy.ndarray
        (rows, columns) indices of points, -1 at empty nodes.

    Raises
    ------
    ValueError
        The points are too few, lie on no grid, or form separate grids.
    """
    advice = f"expected at least {min_points} {name} on an even background: check focus, exposure and the image content"
    if len(points) < min_points:
        raise ValueError(f"{len(points) or 'no'} {name} found; {advice}")
    no_grid = f"{len(points)} {name} found, but they lie on no grid; {advice}"
    patches = index_patches(points, min_points, limits=limits)
    if not patches:
        raise ValueError(no_grid)
    joined, separate = join_patches(patches, points, limits)
    large = [each for each in separate if len(each.members) > limits.min_patch_share * len(joined.members)]
    if large:
        counts = " and ".join(str(len(each.members)) for each in (joined, *large))
        raise ValueError(
            f"the grid broke into {len(large) + 1} parts of {counts} {name} with too wide a gap between them; "
            "uncover what lies between them, or crop the image to one part"
        )
    grid = patch_grid(joined, points)
    known = grid >= 0
    # A single row is no grid: both directions must have at least one pair of neighbours.
    if not ((known[1:] & known[:-1]).any() and (known[:, 1:] & known[:, :-1]).any()):
        raise ValueError(no_grid)
    return grid
