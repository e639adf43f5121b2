"""How far lines are from straight once a lens is undone, and how that changes with the lens.

The lens takes a measured point p to ``u = c + d g(s)``, ``d = p - c``, ``s = |d|^2``, ``g = 1 + k1 s + k2 s^2 + ...``
(F. de Jong, eq. 3.11-3.13). A line ``n.u + rho = 0``, |n| = 1, is in the measured image a curve, and a point's distance
from that curve is to first order ``r = (n.u + rho)/|J'n|`` with ``J = du/dp = g I + 2 g' d d'``. Distances in the
undistorted image (eq. 3.10) would shrink to 0 with g; those in the measured image cannot.

Lines are eliminated: for a given lens each follows in closed form, and the normal equations are those of the lens (and
of the vanishing points) alone, the lines' own columns projected out (variable projection, Kaufman's variant).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lines.line_families import Float64, PackedLines


class Parameters(NamedTuple):
    """What is sought, in packed coordinates.

    Attributes
    ----------
    k
        Coefficients (order,) of s, s^2, ...; none for order 0.
    centre
        (2,).
    vanishing
        Unit homogeneous vanishing points (families, 3), or None where lines need not meet.
    """

    k: Float64
    centre: Float64
    vanishing: Float64 | None


class Undistorted(NamedTuple):
    """Points with the lens undone, and what its slopes need.

    Attributes
    ----------
    dx, dy, square
        From the centre, and their squared distance (n,).
    growth, slope, bend
        g(s) (n,), its derivative, and its second derivative.
    x, y
        Undistorted (n,).
    """

    dx: Float64
    dy: Float64
    square: Float64
    growth: Float64
    slope: Float64 | float
    bend: float
    x: Float64
    y: Float64


class LineSet(NamedTuple):
    """Lines ``nx x + ny y + offset = 0`` (lines,), |n| = 1."""

    nx: Float64
    ny: Float64
    offset: Float64


@dataclass(frozen=True)
class Evaluation:
    """Distances from straight lines at some parameters.

    Attributes
    ----------
    points, lines
        Undistorted points, and the lines through them in closed form.
    nx, ny, along
        Each point's line's normal, and its distance from the centre along it (n,).
    spread
        Squared local scale |J'n|^2 (n,).
    inverse
        Root of the weight over the local scale (n,).
    distance
        Signed distances (n,) in the measured image.
    residual
        Distances times the root of the weights.
    cost
        Sum of the residuals' squares.
    """

    points: Undistorted
    lines: LineSet
    nx: Float64
    ny: Float64
    along: Float64
    spread: Float64
    inverse: Float64
    distance: Float64
    residual: Float64
    cost: float


def inner(first: Float64, second: Float64) -> Float64:
    """Sum products over the last axis, of each with each: ``first @ second.T``.

    Not by BLAS, whose threads wait for each other longer than the sums take, above all beside an OpenCL runtime's.
    """
    if first.ndim == 1:
        return np.asarray(np.einsum("n,n->", first, second))
    return np.asarray(np.einsum("in,jn->ij", first, second))


def undistort(packed: PackedLines, k: Float64, centre: Float64) -> Undistorted:
    """Undo a lens of at most k1 and k2."""
    k1, k2 = (*k.tolist(), 0.0, 0.0)[:2]
    dx, dy = packed.x - centre[0], packed.y - centre[1]
    square = dx * dx + dy * dy
    stretch = k1 * square
    slope: Float64 | float = k1
    if len(k) > 1:
        tail = k2 * square
        slope = k1 + 2.0 * tail
        tail *= square
        stretch += tail
    x, y = dx * stretch, dy * stretch
    x += packed.x
    y += packed.y
    stretch += 1.0
    return Undistorted(dx, dy, square, stretch, slope, 2.0 * k2, x, y)


def monotone(k: Float64, square: float, *, least: float = 0.0) -> bool:
    """Whether the slope of ``r (1 + k1 r^2 + k2 r^4)`` exceeds ``least`` for all r^2 up to ``square``."""
    k1, k2 = (*k.tolist(), 0.0, 0.0)[:2]
    places = [square]
    if k2 != 0.0 and 0.0 < -0.3 * k1 / k2 < square:
        places.append(-0.3 * k1 / k2)
    return all(1.0 + s * (3.0 * k1 + 5.0 * k2 * s) > least for s in places)


def moments(packed: PackedLines, x: Float64, y: Float64, weight: Float64 | None) -> Float64:
    """Weighted sums (6, lines) of 1, x, y, xx, xy, yy over each line."""
    terms = np.empty((6, len(x)))
    terms[0] = 1.0 if weight is None else weight
    np.multiply(x, terms[0], out=terms[1])
    np.multiply(y, terms[0], out=terms[2])
    np.multiply(terms[1], x, out=terms[3])
    np.multiply(terms[1], y, out=terms[4])
    np.multiply(terms[2], y, out=terms[5])
    return packed.sums(terms)


def free_lines(moments: Float64) -> LineSet:
    """Lines of least squared distance: through the centre of gravity, along the scatter's longer axis."""
    total, x, y, xx, xy, yy = moments
    x, y = x / total, y / total
    turn = 0.5 * np.arctan2(2.0 * (xy - total * x * y), (xx - total * x * x) - (yy - total * y * y))
    nx, ny = -np.sin(turn), np.cos(turn)
    return LineSet(nx, ny, -(nx * x + ny * y))


def pencil_basis(vanishing: Float64) -> Float64:
    """Orthonormal pairs (points, 2, 3) that span all lines through points (points, 3)."""
    least = np.eye(3)[np.argmin(np.abs(vanishing), axis=-1)]
    first = np.cross(vanishing, least)
    first /= np.linalg.norm(first, axis=-1, keepdims=True)
    return np.stack([first, np.cross(vanishing, first)], axis=1)


def pencil_lines(moments: Float64, basis: Float64) -> LineSet:
    """Lines of least squared distance in each line's pencil (lines, 2, 3): the smaller of two eigenvectors.

    Among ``l = cos(phi) b1 + sin(phi) b2`` that of least ``l'S l / (l1^2 + l2^2)``, S the 3 x 3 scatter: regular for
    pencils of parallel lines as well.
    """
    total, x, y, xx, xy, yy = moments
    scatter = np.array([[xx, xy, x], [xy, yy, y], [x, y, total]])
    m = np.einsum("lia,abl,ljb->ijl", basis, scatter, basis)
    n = np.einsum("lia,lja->ijl", basis[..., :2], basis[..., :2])
    a = n[0, 0] * n[1, 1] - n[0, 1] ** 2
    b = m[0, 0] * n[1, 1] + m[1, 1] * n[0, 0] - 2.0 * m[0, 1] * n[0, 1]
    c = m[0, 0] * m[1, 1] - m[0, 1] ** 2
    # The smaller root in the form that holds for a = 0.
    m = m - 2.0 * c / (b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) * n
    # Of the two rows, which ought to be parallel, the longer one is the better conditioned.
    top = m[0, 0] ** 2 >= m[1, 1] ** 2
    mix = np.where(top, np.stack([-m[0, 1], m[0, 0]]), np.stack([-m[1, 1], m[0, 1]]))
    line = mix[0, :, None] * basis[:, 0] + mix[1, :, None] * basis[:, 1]
    line /= np.hypot(line[:, 0], line[:, 1])[:, None]
    return LineSet(*line.T)


def evaluate(
    packed: PackedLines, at: Parameters, before: Evaluation | None = None, weight: Float64 | None = None
) -> Evaluation:
    """Return distances from the best lines.

    Parameters
    ----------
    packed
        The measured points.
    at
        Lens and vanishing points.
    before
        An evaluation nearby, whose lines' directions give the local scale; none: two passes.
    weight
        Weights (n,) of the squares.
    """
    points = undistort(packed, at.k, at.centre)
    inverse = weight
    if len(at.k):
        if before is None:
            lines = best_lines(packed, at, moments(packed, points.x, points.y, weight))
            nx, ny = lines.nx[packed.line], lines.ny[packed.line]
        else:
            nx, ny = before.nx, before.ny
        inverse = (1.0 if weight is None else weight) / _spread(points, nx, ny)[1]
    lines = best_lines(packed, at, moments(packed, points.x, points.y, inverse))
    nx, ny, distance = lines.nx[packed.line], lines.ny[packed.line], lines.offset[packed.line]
    along, spread = _spread(points, nx, ny)
    inverse = 1.0 / np.sqrt(spread)
    distance += nx * points.x
    distance += ny * points.y
    distance *= inverse
    residual = distance
    if weight is not None:
        root = np.sqrt(weight)
        inverse *= root
        residual = distance * root
    return Evaluation(
        points, lines, nx, ny, along, spread, inverse, distance, residual, float(inner(residual, residual))
    )


def best_lines(packed: PackedLines, at: Parameters, moments: Float64) -> LineSet:
    """Return lines of least squared distance, through their vanishing points if there are any."""
    lines = free_lines(moments)
    bound = bound_lines(packed, at)
    if at.vanishing is None or not bound.any():
        return lines
    basis = pencil_basis(at.vanishing)[packed.family[bound]]
    inside = pencil_lines(moments[:, bound], basis)
    for all_lines, some in zip(lines, inside, strict=True):
        all_lines[bound] = some
    return lines


def bound_lines(packed: PackedLines, at: Parameters) -> npt.NDArray[np.bool_]:
    """Which lines (lines,) go through a vanishing point: one without any other in its family need not."""
    if at.vanishing is None:
        return np.zeros(len(packed.counts), dtype=bool)
    return np.bincount(packed.family, minlength=packed.families)[packed.family] > 1


def _spread(points: Undistorted, nx: Float64, ny: Float64) -> tuple[Float64, Float64]:
    """Return n.d, and the squared local scale along the normal."""
    along = nx * points.dx
    along += ny * points.dy
    spread = points.slope * points.square
    spread += points.growth
    spread *= along
    spread *= along
    spread *= 4.0 * points.slope
    spread += points.growth * points.growth
    return along, spread


class Columns(NamedTuple):
    """Derivatives of the residuals.

    Attributes
    ----------
    lens
        By k1, k2, ..., both coordinates of the centre; below them the residuals (order + 3, n). Order 0: residuals.
    line
        By the line's offset and direction (2, n).
    """

    lens: Float64
    line: Float64


def columns(order: int, here: Evaluation) -> Columns:
    """Differentiate the residuals; the local scale's own slopes are in it, so that the estimate has no bias."""
    points, q, nx, ny, each = here.points, here.along, here.nx, here.ny, here.inverse
    square, growth, slope = points.square, points.growth, points.slope
    line = np.empty((2, len(q)))
    line[0] = each
    np.multiply(each, nx * points.y - ny * points.x, out=line[1])
    if order == 0:
        return Columns(here.residual[None], line)
    # With W the squared scale: dr = dF/sqrt(W) - half dW, and what of half dW goes with dq and ds.
    half = 0.5 * here.residual / here.spread
    outward, four = half * q, 4.0 * q
    by_q = 8.0 * slope * (growth + slope * square) * outward
    line[1] -= by_q * (nx * points.dy - ny * points.dx)
    four *= outward
    by_growth, by_slope = four * growth, four * slope
    half *= growth
    half *= 2.0
    by_square = half * slope + by_slope * (2.0 * slope)
    by_square += points.bend * (by_growth + 2.0 * by_slope * square)
    lens = np.empty((order + 3, len(q)))
    plain = q * each
    outward = 2.0 * (by_square - plain * slope)
    plain -= half
    by_slope *= 2.0
    plain -= 1.5 * by_slope
    np.multiply(square, plain, out=lens[0])
    lens[0] -= by_growth
    if order > 1:
        plain -= by_slope
        plain *= square
        plain -= 2.0 * by_growth
        np.multiply(square, plain, out=lens[1])
    by_q += each * (1.0 - growth)
    for row, (normal, offset) in enumerate(((nx, points.dx), (ny, points.dy)), order):
        np.multiply(normal, by_q, out=lens[row])
        lens[row] += offset * outward
    lens[order + 2] = here.residual
    return Columns(lens, line)


class NormalEquations(NamedTuple):
    """Lines projected out.

    Attributes
    ----------
    matrix
        J'J of (k..., centre, two tangents per vanishing point).
    gradient
        J'r.
    taken
        (2, order + 3, lines): how much of a line's own two columns each column of `Columns.lens` holds.
    """

    matrix: Float64
    gradient: Float64
    taken: Float64


def normal_equations(packed: PackedLines, at: Parameters, here: Evaluation, slopes: Columns) -> NormalEquations:
    """Return the normal equations of what is sought, the lines' columns projected out."""
    cross = np.array([packed.sums(line * slopes.lens) for line in slopes.line])
    own = packed.sums(np.array([slopes.line[i] * slopes.line[j] for i, j in ((0, 0), (0, 1), (1, 1))]))
    taken = np.empty_like(cross)
    np.subtract(own[2] * cross[0], own[1] * cross[1], out=taken[0])
    np.subtract(own[0] * cross[1], own[1] * cross[0], out=taken[1])
    taken /= own[0] * own[2] - own[1] ** 2
    bound = bound_lines(packed, at)
    sideways = None
    if at.vanishing is not None and bound.any():
        sideways = _pencils(packed, at.vanishing, here.lines, own, cross, bound)
        taken[..., bound] = sideways.taken
    product = inner(slopes.lens, slopes.lens) - sum(inner(a, b) for a, b in zip(taken, cross, strict=True))
    if at.vanishing is None:
        return NormalEquations(product[:-1, :-1], product[:-1, -1], taken)
    lens, tangents = len(product) - 1, 2 * packed.families
    matrix, gradient = np.zeros((lens + tangents,) * 2), np.zeros(lens + tangents)
    matrix[:lens, :lens], gradient[:lens] = product[:-1, :-1], product[:-1, -1]
    if sideways is not None:
        for slot, with_lens, square in zip(
            lens + 2 * sideways.family, sideways.with_lens, sideways.square, strict=True
        ):
            inside = slice(slot, slot + 2)
            matrix[inside, :lens] = with_lens[:, :-1]
            matrix[:lens, inside] = with_lens[:, :-1].T
            matrix[inside, inside], gradient[inside] = square, with_lens[:, -1]
    return NormalEquations(matrix, gradient, taken)


class _Pencils(NamedTuple):
    """What vanishing points add to the normal equations, for the families (found,) that have one.

    Attributes
    ----------
    family
        Their numbers.
    taken
        As in `NormalEquations`, of their lines: a line has one direction of its own in a pencil.
    with_lens, square
        Products of the point's tangents with `Columns.lens` (found, 2, order + 3), and with each other (found, 2, 2).
    """

    family: npt.NDArray[np.intp]
    taken: Float64
    with_lens: Float64
    square: Float64


def _pencils(
    packed: PackedLines, vanishing: Float64, lines: LineSet, own: Float64, cross: Float64, bound: npt.NDArray[np.bool_]
) -> _Pencils:
    family = packed.family[bound]
    own, cross = own[:, bound], cross[:, :, bound]
    change = pencil_changes(vanishing, family, LineSet(*(each[bound] for each in lines)))
    gram = np.array([[own[0], own[1]], [own[1], own[2]]])
    moved = np.einsum("ial,ijl,jbl->abl", change, gram, change)
    crossed = np.einsum("ial,ikl->akl", change, cross)
    turned = crossed[0] / moved[0, 0]
    # Lines of a family lie side by side.
    starts = np.flatnonzero(np.diff(family, prepend=-1))
    with_lens = np.add.reduceat(crossed[1:] - moved[0, 1:, None] * turned, starts, axis=-1)
    square = np.add.reduceat(moved[1:, 1:] - moved[0, 1:, None] * (moved[0, 1:] / moved[0, 0]), starts, axis=-1)
    return _Pencils(family[starts], change[:, :1] * turned, with_lens.transpose(2, 0, 1), square.transpose(2, 0, 1))


def projected_columns(
    packed: PackedLines, at: Parameters, here: Evaluation, slopes: Columns, taken: Float64
) -> Float64:
    """Return the columns (parameters, n) themselves, the lines' columns projected out."""
    found = slopes.lens[:-1] - sum(line * part[:-1, packed.line] for line, part in zip(slopes.line, taken, strict=True))
    if at.vanishing is None:
        return np.asarray(found)
    bound = bound_lines(packed, at)
    change = np.zeros((2, 3, len(bound)))
    change[..., bound] = pencil_changes(at.vanishing, packed.family[bound], LineSet(*(n[bound] for n in here.lines)))
    turn, *moves = (np.sum(slopes.line * change[:, part, packed.line], axis=0) for part in range(3))
    length = np.where(bound, packed.sums(turn * turn), 1.0)
    tangents = np.zeros((packed.families, 2, len(packed.x)))
    points = np.arange(len(packed.x))
    for axis, move in enumerate(moves):
        tangents[packed.family[packed.line], axis, points] = (
            move - turn * (packed.sums(turn * move) / length)[packed.line]
        )
    return np.concatenate([found, tangents.reshape(-1, len(packed.x))])


def pencil_changes(vanishing: Float64, family: npt.NDArray[np.intp], lines: LineSet) -> Float64:
    """Change (2, 3, lines) of lines' (offset, direction) by a turn in their pencil and by the point's two tangents.

    The tangents are those of `pencil_basis`; a line moves with its point so that it turns least.
    """
    nx, ny, offset = lines
    x, y, w = vanishing[family].T
    along = np.einsum("lia,al->il", pencil_basis(vanishing)[family], np.stack(lines))
    # A turn moves a line by v x l, a tangent by -(l.b) v; then it is normalised again.
    moves = [(y * offset - w * ny, w * nx - x * offset, x * ny - y * nx), *((-q * x, -q * y, -q * w) for q in along)]
    return np.array(
        [
            [dw - offset * (nx * dx + ny * dy) for dx, dy, dw in moves],
            [nx * dy - ny * dx for dx, dy, _ in moves],
        ]
    )
