"""Choice of the next measurement of a calibration: the candidate that shrinks the covariance most (D-optimal).

References
----------
.. [1] V. V. Fedorov, *Theory of Optimal Experiments*, 1972, chapter 2 (D-optimal designs).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.features.selection import two_row_update

Float64 = npt.NDArray[np.float64]


class NextMeasurement(NamedTuple):
    """Most informative candidate.

    Attributes
    ----------
    chosen : int
        Number of the candidate.
    volume_factor : numpy.ndarray
        (n,): volume of the confidence ellipsoid of all parameters before, over the volume after each candidate, at
        least 1. The factor of ``chosen`` is the largest.
    covariance : numpy.ndarray
        (p, p): predicted covariance of the parameters after the measurement of ``chosen``.
    """

    chosen: int
    volume_factor: Float64
    covariance: Float64


def most_informative(candidates: Float64, information: Float64) -> NextMeasurement:
    """Return the candidate whose measurement shrinks the volume of the confidence ellipsoid most.

    Parameters
    ----------
    candidates : numpy.ndarray
        (n, 2, p): derivatives of two measured coordinates by the parameters, divided by their standard deviations.
    information : numpy.ndarray
        (p, p): information (inverse covariance) of the parameters before, with the prior; positive definite.

    Raises
    ------
    ValueError
        There is no candidate, or one is not finite.
    """
    if not len(candidates):
        raise ValueError("there is no candidate for the next measurement, expected one at least")
    if not np.isfinite(candidates).all():
        raise ValueError("a candidate for the next measurement is not finite, expected finite numbers")
    # Unit diagonal before the inversion: parameters in metres and without unit have very different sizes.
    unit = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * unit * unit[:, None]) * unit * unit[:, None]
    weight = np.ones(len(candidates))
    update = two_row_update(candidates[:, 0], candidates[:, 1], weight, covariance)
    best = int(np.argmax(update.determinant))
    rows = candidates[best]
    gain = covariance @ rows.T @ np.linalg.inv(np.eye(2) + rows @ covariance @ rows.T)
    after = covariance - gain @ rows @ covariance
    return NextMeasurement(best, np.sqrt(update.determinant), np.asarray(0.5 * (after + after.T)))
