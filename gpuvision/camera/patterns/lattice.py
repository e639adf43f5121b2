"""Which point of a distorted lattice is which: rows and columns by walking from neighbour to neighbour."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from gpuvision.camera.patterns.pattern import Float64, nan_median

Int64 = npt.NDArray[np.int64]

# A point's eight lattice neighbours, and some more where spurious points lie between them.
_NEIGHBOURS = 10
# A neighbour has a mirror image about its point when their sum is at most this part of its distance.
_MIRRORED = 0.25
# Two steps span a lattice when the sine of their angle is at least this.
_SPANNING = 0.4
# A prediction is met when the point lies within this part of a step; surely, within that.
_MET, _SURELY = 0.3, 0.15
# A step differs from its neighbour's by less than this part of it.
_ALIKE = 0.2
# Vectors that turn round from neighbour to neighbour have at most this scalar product.
_TURNED = -0.5
_SIDE = 1024
_TRIES = 12
# So many points of the whole, and a quarter of the piece, say how a piece continues it; to this part of a step.
_JOINT = 160
_FITS = 0.2
# A part that holds less of the largest part's points and cannot be joined to it is left out.
_WORTH_JOINING = 0.1
_STEPS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])


class Chart(NamedTuple):
    """Points of one lattice: their numbers and their (column, row), any origin."""

    members: Int64
    nodes: Int64


def local_bases(points: Float64, tree: cKDTree, turning: Float64 | None = None) -> Float64:
    """Two steps (n, 2, 2) of the lattice about every point; NaN where its neighbours do not lie symmetrically.

    The first step leads to the nearest neighbour that has a mirror image about the point, the second to the nearest
    such neighbour in another direction. For ``turning`` see `charts`.
    """
    count = min(_NEIGHBOURS + 1, len(points))
    _, near = tree.query(points, count)
    steps = points[near[:, 1:]] - points[:, None]
    square = np.sum(steps**2, axis=-1)
    length = np.sqrt(square)
    # |s + t|^2 of all pairs of steps
    sums = square[:, :, None] + square[:, None] + 2.0 * steps @ steps.transpose(0, 2, 1)
    partner = np.argmin(sums, axis=2)
    mirrored = np.take_along_axis(sums, partner[..., None], 2)[..., 0] < _MIRRORED**2 * square
    if turning is not None:
        mirrored &= np.einsum("ij,ikj->ik", turning, turning[near[:, 1:]]) < _TURNED
    across = np.take_along_axis(steps, partner[..., None], 1)
    straight = 0.5 * (steps - across)
    rows = np.arange(len(points))
    first = np.argmax(mirrored, axis=1)
    a = straight[rows, first]
    cross = a[:, None, 0] * steps[..., 1] - a[:, None, 1] * steps[..., 0]
    spanning = mirrored & (np.abs(cross) > _SPANNING * length * length[rows, first, None])
    second = np.argmax(spanning, axis=1)
    bases = np.stack([a, straight[rows, second]], axis=1)
    bases[~(mirrored[rows, first] & spanning[rows, second])] = np.nan
    return bases


class _Walk:
    """A lattice that grows from a seed: every wave predicts the neighbours of the last one's points."""

    def __init__(self, points: Float64, tree: cKDTree, seed: int, basis: Float64, turning: Float64 | None) -> None:
        self.points = points
        self.tree = tree
        self.turning = turning
        self.at = np.full((_SIDE, _SIDE), -1)
        self.index = np.full((len(points), 2), -1)
        self.bases = np.full((len(points), 2, 2), np.nan)
        self.bases[seed] = basis
        self._place(np.array([seed]), np.array([[_SIDE // 2, _SIDE // 2]]))

    def _place(self, members: Int64, index: Int64) -> None:
        self.index[members] = index
        self.at[index[:, 0], index[:, 1]] = members

    def grow(self, wave: Int64, met: float) -> Int64:
        """Find the neighbours of a wave's points, within a part of a step; return the new ones."""
        target = (self.index[wave, None] + _STEPS).reshape(-1, 2)
        parent = np.repeat(wave, len(_STEPS))
        steps = np.stack([self.bases[wave], -self.bases[wave]], axis=2).reshape(-1, 2)
        free = (self.at[target[:, 0], target[:, 1]] < 0) & np.all((target > 0) & (target < _SIDE - 1), axis=1)
        target, parent, steps = target[free], parent[free], steps[free]
        distance, found = self.tree.query(self.points[parent] + steps)
        error = distance / np.hypot(steps[:, 0], steps[:, 1])
        is_met = (error < met) & (self.index[found, 0] < 0)
        if self.turning is not None:
            is_met &= np.sum(self.turning[parent] * self.turning[found], axis=1) < _TURNED
        order = np.flatnonzero(is_met)[np.argsort(error[is_met], kind="stable")]
        # The best prediction of a place, then the best place of a point.
        key = target[:, 0] * _SIDE + target[:, 1]
        for names in (key, found):
            order = order[np.sort(np.unique(names[order], return_index=True)[1])]
        new: Int64 = found[order]
        self.bases[new] = self.bases[parent[order]]
        self._place(new, target[order])
        self._measure(new)
        return new

    def _measure(self, new: Int64) -> None:
        """Take steps from the neighbours that are known; a parent's step serves where there are none."""
        here = self.index[new]
        for axis in (0, 1):
            ahead, behind = (self.at[tuple((here + side * _STEPS[2 * axis]).T)] for side in (1, -1))
            forward = np.where((ahead >= 0)[:, None], self.points[ahead] - self.points[new], np.nan)
            backward = np.where((behind >= 0)[:, None], self.points[new] - self.points[behind], np.nan)
            count = (ahead >= 0).astype(int) + (behind >= 0)
            total = np.nan_to_num(forward) + np.nan_to_num(backward)
            known = np.flatnonzero(count)
            step, parents = total[known] / count[known, None], self.bases[new[known], axis]
            # A spurious point's steps are no steps of the lattice.
            like = np.linalg.norm(step - parents, axis=1) < _ALIKE * np.linalg.norm(parents, axis=1)
            self.bases[new[known[like]], axis] = step[like]


def _walked(points: Float64, tree: cKDTree, seed: int, basis: Float64, turning: Float64 | None) -> Chart:
    """Index the points that can be reached from a seed, neighbour by neighbour.

    First those that surely are neighbours: a spurious point beside a missing one leads astray, but nowhere once the
    places beyond it are taken.
    """
    lattice = _Walk(points, tree, seed, basis, turning)
    members = wave = np.array([seed])
    while wave.size:
        while wave.size:
            wave = lattice.grow(wave, _SURELY)
        members = np.flatnonzero(lattice.index[:, 0] >= 0)
        wave = lattice.grow(members, _MET)
    return Chart(members, lattice.index[members])


def charts(points: Float64, fewest: int, turning: Float64 | None = None) -> list[Chart]:
    """Index points that lie on a distorted lattice, in as many pieces as it falls into, the largest first.

    Parameters
    ----------
    points
        (n, 2), with spurious ones among them.
    fewest
        A piece of fewer points is none.
    turning
        Unit vectors (n, 2) that point the other way round from neighbour to neighbour, where the pattern has such.
    """
    if len(points) < max(fewest, 5):
        return []
    tree = cKDTree(points)
    bases = local_bases(points, tree, turning)
    pieces: list[Chart] = []
    left = np.isfinite(bases[:, 0, 0])
    for _ in range(_TRIES):
        seed = _seed(points, bases, left)
        if seed is None:
            break
        chart = _walked(points, tree, seed, bases[seed], turning)
        left[chart.members] = False
        left[seed] = False
        if len(chart.members) >= fewest and np.ptp(chart.nodes, axis=0).all():
            pieces.append(chart)
    return _without_overlap(pieces, fewest)


def _seed(points: Float64, bases: Float64, left: npt.NDArray[np.bool_]) -> int | None:
    """Of the points that are left, the one whose steps are the most usual."""
    candidates = np.flatnonzero(left)
    if candidates.size == 0:
        return None
    # Steps may be swapped and turned from point to point: their lengths and the angle between them are not.
    a, b = bases[candidates, 0], bases[candidates, 1]
    cross = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    kind = np.log(np.stack([np.sum(a**2, 1), np.sum(b**2, 1), cross]))
    return int(candidates[np.argmin(np.sum(np.abs(kind - np.median(kind, axis=1, keepdims=True)), axis=0))])


def _without_overlap(pieces: list[Chart], fewest: int) -> list[Chart]:
    """Drop from smaller pieces what larger ones hold too."""
    kept: list[Chart] = []
    taken = np.empty(0, dtype=np.int64)
    for piece in sorted(pieces, key=lambda each: len(each.members), reverse=True):
        own = ~np.isin(piece.members, taken)
        if np.count_nonzero(own) >= fewest:
            kept.append(Chart(piece.members[own], piece.nodes[own]))
            taken = np.concatenate([taken, piece.members[own]])
    return kept


def as_grid(chart: Chart, points: Float64) -> Int64:
    """Lay a chart out as rows and columns.

    The shortest steps span the lattice, columns grow with x and rows with y; empty borders are cut.

    Returns
    -------
    numpy.ndarray
        (rows, columns): numbers of points, -1 where there is none.
    """
    index = chart.nodes
    place = points[chart.members]
    for _ in range(2):  # the first turn is found on oblique axes where the shortest steps are others
        steps = _mean_steps(index, place)
        if np.isfinite(steps).all():  # they are not in a row of points along a diagonal
            index = index @ _turn(steps).T
    index = index - index.min(axis=0)
    grid = np.full(index.max(axis=0)[::-1] + 1, -1)
    grid[index[:, 1], index[:, 0]] = chart.members
    return grid


def _mean_steps(index: Int64, place: Float64) -> Float64:
    """Median step (2, 2) along the columns' and the rows' index."""
    low = index.min(axis=0)
    at = np.full((*(index.max(axis=0) - low + 1), 2), np.nan)
    at[tuple((index - low).T)] = place
    return np.stack([nan_median(np.diff(at, axis=axis).reshape(-1, 2)) for axis in (0, 1)])


def _turn(steps: Float64) -> Int64:
    """Whole-numbered matrix to the index whose steps are the shortest, right-handed, and along x and y."""
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


def joined(pieces: list[Chart], points: Float64) -> tuple[Chart, list[Chart]]:
    """Join to the largest piece those that lie where its lattice goes on; return the whole, and what stays apart."""
    whole, apart = pieces[0], pieces[1:]
    while True:
        for piece in apart:
            index = _continued(whole, piece, points)
            if index is not None:
                whole = Chart(np.concatenate([whole.members, piece.members]), np.concatenate([whole.nodes, index]))
                apart = [each for each in apart if each is not piece]
                break
        else:
            return whole, apart


def _continued(whole: Chart, piece: Chart, points: Float64) -> Int64 | None:
    """Index of a piece in the lattice of another one, or None where they do not fit together.

    The index of the whole near the piece is a smooth function of the place. Extrapolated to the piece, it must be
    the piece's own index but for a turn and a shift.
    """
    place, other = points[whole.members], points[piece.members]
    distance, _ = cKDTree(place).query(other)
    anchor = other[np.argmin(distance)]
    near = np.argsort(np.linalg.norm(place - anchor, axis=1))[:_JOINT]
    ends = np.argsort(np.linalg.norm(other - anchor, axis=1))[: _JOINT // 4]
    scale = np.ptp(place[near])
    design, there = (_quadratic((each - anchor) / scale) for each in (place[near], other[ends]))
    guess = there @ np.linalg.lstsq(design, whole.nodes[near].astype(np.float64), rcond=None)[0]
    own = piece.nodes[ends].astype(np.float64)
    turn = np.rint(np.linalg.lstsq(own - own.mean(axis=0), guess - guess.mean(axis=0), rcond=None)[0]).astype(np.int64)
    if abs(round(float(np.linalg.det(turn)))) != 1:
        return None
    offset = guess - own @ turn
    shift = np.rint(np.median(offset, axis=0)).astype(np.int64)
    if np.median(np.abs(offset - shift)) > _FITS or np.max(np.abs(np.median(offset, axis=0) - shift)) > 2.0 * _FITS:
        return None
    index = piece.nodes @ turn + shift
    taken = {tuple(each) for each in whole.nodes.tolist()}
    return None if any(tuple(each) in taken for each in index.tolist()) else index


def _quadratic(at: Float64) -> Float64:
    x, y = at.T
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1)


def whole_grid(points: Float64, fewest: int, what: str) -> Int64:
    """Lay points out in rows and columns, with a way over gaps where the grid goes on behind them.

    Returns
    -------
    numpy.ndarray
        (rows, columns): numbers of points, -1 where there is none.

    Raises
    ------
    ValueError
        If there are too few, if they lie on no grid, or if it falls into parts.
    """
    advice = f"expected at least {fewest} {what} on an even ground: check focus, exposure and what is in the picture"
    if len(points) < fewest:
        raise ValueError(f"{len(points) or 'no'} {what} found; {advice}")
    no_grid = f"{len(points)} {what} found, but they lie on no grid; {advice}"
    pieces = charts(points, fewest)
    if not pieces:
        raise ValueError(no_grid)
    whole, apart = joined(pieces, points)
    large = [each for each in apart if len(each.members) > _WORTH_JOINING * len(whole.members)]
    if large:
        counts = " and ".join(str(len(each.members)) for each in (whole, *large))
        raise ValueError(
            f"the grid broke into {len(large) + 1} parts of {counts} {what} with too wide a gap between them; "
            "uncover what lies between them, or crop the image to one part"
        )
    grid = as_grid(whole, points)
    known = grid >= 0
    # A row of points is no grid: a step of each direction must have been seen somewhere.
    if not ((known[1:] & known[:-1]).any() and (known[:, 1:] & known[:, :-1]).any()):
        raise ValueError(no_grid)
    return grid
