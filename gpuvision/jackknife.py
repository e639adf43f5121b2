"""Covariance of least-squares parameters whose residuals correlate within clusters."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]


def cluster_jackknife(columns: Float64, normal: Float64, residual: Float64, cluster: npt.NDArray[np.intp]) -> Float64:
    """Return the delete-one-cluster jackknife covariance of least-squares parameters, to first order.

    Parameters
    ----------
    columns
        Derivatives of the residuals with respect to the parameters, (parameters, n), each times the root of the weight.
    normal
        Normal matrix (parameters, parameters): columns @ columns.T, and the information of priors if there are any.
    residual
        Residuals (n,), each times the root of the weight.
    cluster
        Cluster of each residual, (n,).

    Returns
    -------
    numpy.ndarray
        Covariance (parameters, parameters). Residuals of different clusters are taken for independent.

    References
    ----------
    .. [1] B. Efron, *The Jackknife, the Bootstrap and Other Resampling Plans*, SIAM 1982.
    """
    scores, products, _ = _cluster_sums(columns, residual, cluster)
    shifts = _shifts(normal, scores, products)
    return np.asarray(shifts.T @ shifts * ((len(shifts) - 1) / len(shifts)))


def overlapping_jackknife(
    columns: Float64, normal: Float64, residual: Float64, cell: npt.NDArray[np.intp], *, cells: int, overlap: int
) -> Float64:
    """Return the mean of the delete-one-block jackknife covariances of shifted grids of blocks, to first order.

    Parameters
    ----------
    columns, normal, residual
        As in `cluster_jackknife`.
    cell
        Column and row (n, 2) of the cell of each residual, 0 to ``cells`` less 1.
    cells : int
        Number of cells along each side.
    overlap : int
        Cells along each side of a block. The grid of blocks is shifted by each number of cells below it along each
        side; 1: separate blocks of one cell.

    Returns
    -------
    numpy.ndarray
        Covariance (parameters, parameters).

    Notes
    -----
    The mean over shifted grids has a smaller variance than the covariance of one grid: 2/3 of it along each side, for
    many shifts and residuals that correlate over less than a block.

    References
    ----------
    .. [1] M. S. Meketon and B. Schmeiser, "Overlapping batch means: something for nothing?", Winter Simulation
       Conference (1984) 227.
    """
    scores, products, number = _cluster_sums(columns, residual, cell @ (1, cells))
    terms = np.concatenate([scores, products.reshape(-1, len(number)), np.ones((1, len(number)))])
    sums = np.zeros((len(terms), cells * cells))
    sums[:, number] = terms
    border = (overlap - 1, overlap - 1)
    padded = np.pad(sums.reshape(-1, cells, cells), ((0, 0), border, border))
    places = cells + overlap - 1
    corners = np.ndindex(overlap, overlap)
    blocks = np.asarray(sum(padded[:, row : row + places, column : column + places] for row, column in corners))
    # Blocks whose places differ by whole blocks form one grid.
    has_edges = blocks[-1] > 0.0
    weight = np.zeros(has_edges.shape)
    for row, column in np.ndindex(overlap, overlap):
        grid = np.s_[row::overlap, column::overlap]
        number_of_blocks = max(int(np.count_nonzero(has_edges[grid])), 1)
        weight[grid] = 1.0 - 1.0 / number_of_blocks
    filled, count = blocks[:, has_edges], len(columns)
    shifts = _shifts(normal, filled[:count], filled[count:-1].reshape(count, count, -1))
    return np.asarray(shifts.T @ (shifts * weight[has_edges][:, None]) / overlap**2)


def _cluster_sums(
    columns: Float64, residual: Float64, cluster: npt.NDArray[np.intp]
) -> tuple[Float64, Float64, npt.NDArray[np.intp]]:
    """Return the gradients (p, c) and the normal matrices (p, p, c) of the clusters, and the clusters' numbers (c,)."""
    order = np.argsort(cluster, kind="stable")
    starts = np.flatnonzero(np.diff(cluster[order], prepend=-1))
    ordered = columns[:, order]
    scores = np.add.reduceat(ordered * residual[order], starts, axis=1)
    products = np.add.reduceat(ordered[:, None] * ordered, starts, axis=2)
    return scores, products, cluster[order][starts]


def _shifts(normal: Float64, scores: Float64, products: Float64) -> Float64:
    """Return the changes (c, p) of the parameters without each cluster."""
    left = normal - products.transpose(2, 0, 1)
    # The pseudoinverse: a cluster may hold all points that determine a parameter.
    return np.asarray(np.einsum("cij,jc->ci", np.linalg.pinv(left, hermitian=True), scores))
