"""Derivatives of the distances of points from straight lines, and the normal equations of lens and vanishing points.

The lines are eliminated: the columns of the lines are projected out of the normal equations, which contain the lens and
the vanishing points only (variable projection, Kaufman's variant). `gpuvision.camera.lines.straightness` has the
distances.

References
----------
L. Kaufman, A variable projection method for solving separable nonlinear least squares problems, BIT 15 (1975) 49.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lines.line_families import Float64, PackedLines
from gpuvision.camera.lines.straightness import (
    Evaluation,
    LineSet,
    Parameters,
    constrained_lines,
    inner_products,
    pencil_basis,
)


class ResidualJacobian(NamedTuple):
    """Derivatives of the residuals.

    Attributes
    ----------
    lens
        (order + 3, n): derivatives by k1, k2, ... and both coordinates of the centre; the last row holds the residuals.
        For order 0: the residuals only.
    line
        (2, n): derivatives by the offset and the direction of the point's line.
    """

    lens: Float64
    line: Float64


def residual_jacobian(order: int, evaluation: Evaluation) -> ResidualJacobian:
    """Differentiate the residuals. The derivatives of the local scale are included, so the estimate is unbiased."""
    points, q, nx, ny, each = evaluation.points, evaluation.along, evaluation.nx, evaluation.ny, evaluation.inverse
    square, growth, slope = points.square, points.growth, points.slope
    line = np.empty((2, len(q)))
    line[0] = each
    np.multiply(each, nx * points.y - ny * points.x, out=line[1])
    if order == 0:
        return ResidualJacobian(evaluation.residual[None], line)
    # W is the squared scale, F = n.u + rho. dr = dF/sqrt(W) - (r / 2W) dW, split into the terms with dq and with ds.
    half = 0.5 * evaluation.residual / evaluation.squared_scale
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
    # d/dk_m = s^(m-1) (s (q / sqrt(W) - 2 h g - 4 (2 m + 1) h q^2 g') - 4 m h q^2 g), with h = r / 2W.
    power = square
    for higher in range(2, order + 1):
        plain -= by_slope
        column = plain * square
        column -= float(higher) * by_growth
        np.multiply(power, column, out=lens[higher - 1])
        power = power * square
    by_q += each * (1.0 - growth)
    for row, (normal, offset) in enumerate(((nx, points.dx), (ny, points.dy)), order):
        np.multiply(normal, by_q, out=lens[row])
        lens[row] += offset * outward
    lens[order + 2] = evaluation.residual
    return ResidualJacobian(lens, line)


class NormalEquations(NamedTuple):
    """Normal equations of lens and vanishing points, with the lines projected out.

    Attributes
    ----------
    matrix
        J'J of (k..., centre, two tangents per vanishing point).
    gradient
        J'r.
    line_coefficients
        (2, order + 3, lines): coefficients of the projection of each row of `ResidualJacobian.lens` onto the line's two
        columns.
    """

    matrix: Float64
    gradient: Float64
    line_coefficients: Float64


def normal_equations(
    packed: PackedLines, parameters: Parameters, evaluation: Evaluation, slopes: ResidualJacobian
) -> NormalEquations:
    """Return the normal equations of lens and vanishing points, with the lines' columns projected out."""
    cross, line_coefficients, sideways = _project_lines(packed, parameters, evaluation, slopes)
    product = inner_products(slopes.lens, slopes.lens) - sum(
        inner_products(a, b) for a, b in zip(line_coefficients, cross, strict=True)
    )
    if parameters.vanishing is None:
        return NormalEquations(product[:-1, :-1], product[:-1, -1], line_coefficients)
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
    return NormalEquations(matrix, gradient, line_coefficients)


def line_coefficients(
    packed: PackedLines, parameters: Parameters, evaluation: Evaluation, slopes: ResidualJacobian
) -> Float64:
    """Return the coefficients of the projection onto the lines' columns, as in `NormalEquations`."""
    return _project_lines(packed, parameters, evaluation, slopes)[1]


def _project_lines(
    packed: PackedLines, parameters: Parameters, evaluation: Evaluation, slopes: ResidualJacobian
) -> tuple[Float64, Float64, _Pencils | None]:
    """Return products with the lines' columns (2, order + 3, lines), coefficients of the projection, and pencils."""
    cross = np.array([packed.sums(line * slopes.lens) for line in slopes.line])
    line_blocks = packed.sums(np.array([slopes.line[i] * slopes.line[j] for i, j in ((0, 0), (0, 1), (1, 1))]))
    coefficients = np.empty_like(cross)
    np.subtract(line_blocks[2] * cross[0], line_blocks[1] * cross[1], out=coefficients[0])
    np.subtract(line_blocks[0] * cross[1], line_blocks[1] * cross[0], out=coefficients[1])
    coefficients /= line_blocks[0] * line_blocks[2] - line_blocks[1] ** 2
    bound = constrained_lines(packed, parameters)
    if parameters.vanishing is None or not bound.any():
        return cross, coefficients, None
    sideways = _pencils(packed, parameters.vanishing, evaluation.lines, line_blocks, cross, bound)
    coefficients[..., bound] = sideways.line_coefficients
    return cross, coefficients, sideways


class _Pencils(NamedTuple):
    """Blocks of the normal equations for the families (found,) that have a vanishing point.

    Attributes
    ----------
    family
        Indices of the families.
    line_coefficients
        As in `NormalEquations`, for lines of a pencil, which have one free parameter.
    with_lens, square
        Products of the point's tangents with `ResidualJacobian.lens` (found, 2, order + 3), and with each other (found,
        2, 2).
    """

    family: npt.NDArray[np.intp]
    line_coefficients: Float64
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
    # The lines of a family are contiguous.
    starts = np.flatnonzero(np.diff(family, prepend=-1))
    with_lens = np.add.reduceat(crossed[1:] - moved[0, 1:, None] * turned, starts, axis=-1)
    square = np.add.reduceat(moved[1:, 1:] - moved[0, 1:, None] * (moved[0, 1:] / moved[0, 0]), starts, axis=-1)
    return _Pencils(family[starts], change[:, :1] * turned, with_lens.transpose(2, 0, 1), square.transpose(2, 0, 1))


def projected_columns(
    packed: PackedLines,
    parameters: Parameters,
    evaluation: Evaluation,
    slopes: ResidualJacobian,
    line_coefficients: Float64,
) -> Float64:
    """Return the Jacobian (parameters, n), with the lines' columns projected out."""
    found = slopes.lens[:-1] - sum(
        line * part[:-1, packed.line] for line, part in zip(slopes.line, line_coefficients, strict=True)
    )
    if parameters.vanishing is None:
        return np.asarray(found)
    bound = constrained_lines(packed, parameters)
    change = np.zeros((2, 3, len(bound)))
    change[..., bound] = pencil_changes(
        parameters.vanishing, packed.family[bound], LineSet(*(n[bound] for n in evaluation.lines))
    )
    rotation, *moves = (np.sum(slopes.line * change[:, part, packed.line], axis=0) for part in range(3))
    length = np.where(bound, packed.sums(rotation * rotation), 1.0)
    tangents = np.zeros((packed.families, 2, len(packed.x)))
    points = np.arange(len(packed.x))
    for axis, move in enumerate(moves):
        tangents[packed.family[packed.line], axis, points] = (
            move - rotation * (packed.sums(rotation * move) / length)[packed.line]
        )
    return np.concatenate([found, tangents.reshape(-1, len(packed.x))])


def pencil_changes(vanishing: Float64, family: npt.NDArray[np.intp], lines: LineSet) -> Float64:
    """Return derivatives (2, 3, lines) of lines' (offset, direction) by a rotation in their pencil and by two tangents.

    The tangents of the vanishing point are computed by `pencil_basis`; a line follows its point with the least
    rotation.
    """
    nx, ny, offset = lines
    x, y, w = vanishing[family].T
    along = np.einsum("lia,al->il", pencil_basis(vanishing)[family], np.stack(lines))
    # A rotation changes a line l by v x l, a tangent b of the point by -(l.b) v; then l is normalised again.
    moves = [(y * offset - w * ny, w * nx - x * offset, x * ny - y * nx), *((-q * x, -q * y, -q * w) for q in along)]
    return np.array(
        [
            [dw - offset * (nx * dx + ny * dy) for dx, dy, dw in moves],
            [nx * dy - ny * dx for dx, dy, _ in moves],
        ]
    )
