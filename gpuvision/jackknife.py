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
    order = np.argsort(cluster, kind="stable")
    starts = np.flatnonzero(np.diff(cluster[order], prepend=-1))
    ordered = columns[:, order]
    scores = np.add.reduceat(ordered * residual[order], starts, axis=1)
    products = np.add.reduceat(ordered[:, None] * ordered, starts, axis=2)
    left = normal - products.transpose(2, 0, 1)
    # The pseudoinverse: a cluster may hold all points that determine a parameter.
    shifts = np.einsum("cij,jc->ci", np.linalg.pinv(left, hermitian=True), scores)
    return np.asarray(shifts.T @ shifts * ((len(shifts) - 1) / len(shifts)))
