"""Selection of calipers (rulers) on a board from its artwork: the few that determine the pose best.

An edge with the unit normal n through p, measured with the standard deviation sigma along n, is one equation for the
board's shift t and turn theta about the placement point: n . t + n . J p theta + e, with p relative to that point and J
the rotation by 90 degrees. e is the etch bias, one unknown for the whole board. A single edge measures it together with
the pose; a ruler across both edges of a trace does not depend on it.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.3 and
   6.3.7.
.. [2] G. L. Nemhauser, L. A. Wolsey and M. L. Fisher, "An analysis of approximations for maximizing submodular set
   functions I", Mathematical Programming 14, 1978 (bound of the greedy choice).
"""

from __future__ import annotations

import math
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.shapes import Float64
from gpuvision.matching.features.candidates import FeatureCandidates, lever_arm
from gpuvision.matching.features.imaging import Imaging

# Largest over smallest standard deviation beyond which a selection is refused: the pose is not determined (chosen).
_MAX_CONDITION = 1e4


class Selection(NamedTuple):
    """Selected features, and the covariance that they predict.

    Attributes
    ----------
    chosen : (k,)
        Indices of the candidates, in the order of selection.
    covariance : (3, 3)
        Covariance of the placement point's x, y [m] and of theta [rad].
    cost : float
        Sum of the costs.
    condition : float
        Largest over smallest standard deviation; the angle's is taken at the mean distance of the selected points.
    region : (2, 2)
        Least and greatest x, y [m] that the rulers sample: the region that the camera must read.
    """

    chosen: npt.NDArray[np.int64]
    covariance: Float64
    cost: float
    condition: float
    region: Float64

    @property
    def sigmas(self) -> Float64:
        """(3,) standard deviations of x, y [m] and theta [rad] at the placement point."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def select_rulers(
    rulers: FeatureCandidates,
    imaging: Imaging,
    budget: float,
    *,
    costs: Any = None,
    criterion: Literal["determinant", "placement"] = "determinant",
    per_source: int = 4,
    missing: float = 0.0,
) -> Selection:
    """Select rulers greedily: each time the one with the largest gain for its cost.

    With the determinant, equal costs, no limit per source and ``imaging.etch_bias_sigma`` 0, the gain in its logarithm
    is at least 1 - 1/e of the largest possible gain [2]_ (the function is submodular). Otherwise no such bound is
    known.

    Parameters
    ----------
    rulers
        Result of `find_ruler_candidates`.
    imaging
        Image quality; the search range ``shift`` and ``angle`` is the prior of the first choices (equally distributed).
        It does not count in the predicted covariance.
    budget
        Limit of the sum of costs.
    costs
        (n,) positive cost of each candidate: by default 1 (the budget is a number of rulers),
        ``rulers.pixels(imaging)``, or measured microseconds.
    criterion
        ``"determinant"`` of the pose's information (D-optimal), or ``"placement"``: variance of the placement point's x
        and y.
    per_source
        Largest number of rulers on one trace or side of a pad, default 4: a defect there does not affect the others.
    missing
        Expected share of rulers without an edge, 0 to below 1; it counts in the predicted covariance. Default 0.0.

    Raises
    ------
    ValueError
        The selection does not determine x, y and theta: all traces parallel, too small a budget, too few edges.
    """
    price = _price(rulers, costs)
    if per_source < 1:
        raise ValueError(f"per_source must be 1 or more, not {per_source}")
    if criterion not in ("determinant", "placement"):
        raise ValueError(f"criterion must be 'determinant' or 'placement', not {criterion!r}")
    weight = _weight(rulers, missing)
    chosen = _greedy(weight, price, rulers, imaging, (budget, criterion, per_source))
    return predict_selection(rulers, imaging, chosen, costs=costs, missing=missing)


def predict_selection(
    rulers: FeatureCandidates, imaging: Imaging, chosen: npt.ArrayLike, *, costs: Any = None, missing: float = 0.0
) -> Selection:
    """Predict the covariance of features selected otherwise: by hand, or at random.

    Parameters
    ----------
    rulers, imaging, costs, missing
        As in `select_rulers`.
    chosen
        (k,) indices of the candidates.

    Raises
    ------
    ValueError
        The features do not determine x, y and theta.
    """
    price, weight = _price(rulers, costs), _weight(rulers, missing)
    which = np.asarray(chosen, dtype=np.int64)
    covariance, condition = _predict(weight[which], rulers, which, imaging)
    return Selection(which, covariance, float(price[which].sum()), condition, _region(rulers, which, imaging))


class TwoRowUpdate(NamedTuple):
    """Effect of candidates with two measured coordinates each on the covariance of some parameters.

    Attributes
    ----------
    first, second : (n, p)
        Rows of each candidate times the covariance.
    one, two, mixed : (n,)
        Diagonal and off-diagonal element of ``I + w R C R'``, with R the two rows.
    determinant : (n,)
        Determinant of ``I + w R C R'``: determinant of the covariance before, over the one after the feature is added.
    """

    first: Float64
    second: Float64
    one: Float64
    two: Float64
    mixed: Float64
    determinant: Float64


def two_row_update(rows: Float64, second_rows: Float64, weight: Float64, covariance: Float64) -> TwoRowUpdate:
    """Predict how much each candidate shrinks a covariance.

    Parameters
    ----------
    rows, second_rows
        (n, p) derivatives of the two measured coordinates; zeros where a candidate has one coordinate.
    weight
        (n,) one over the variance of a coordinate.
    covariance
        (p, p) covariance of the parameters before the measurement.
    """
    first, second = rows @ covariance, second_rows @ covariance
    one, two = (1 + weight * np.einsum("ij,ij->i", *each) for each in ((first, rows), (second, second_rows)))
    mixed = weight * np.einsum("ij,ij->i", first, second_rows)
    return TwoRowUpdate(first, second, one, two, mixed, one * two - mixed**2)


def _price(rulers: FeatureCandidates, costs: Any) -> Float64:
    price = np.ones(len(rulers.sigma)) if costs is None else np.asarray(costs, dtype=np.float64)
    if price.shape != rulers.sigma.shape or not np.all(price > 0):
        raise ValueError(f"costs must be {len(rulers.sigma)} positive numbers, one for each candidate")
    return price


def _weight(rulers: FeatureCandidates, missing: float) -> Float64:
    if not 0 <= missing < 1:
        raise ValueError(f"missing must be in [0, 1), not {missing}")
    return np.asarray((1 - missing) * (1 - rulers.ambiguity) / rulers.sigma**2)


def _rows(rulers: FeatureCandidates) -> Float64:
    """Return the Jacobian (n, 4) of the measurements in x, y, theta and the etch bias."""
    lever = lever_arm(rulers.point - rulers.placement, rulers.normal)
    return np.concatenate([rulers.normal, lever[:, None], np.where(rulers.pair, 0.0, 1.0)[:, None]], axis=1)


def _second_rows(rulers: FeatureCandidates) -> Float64:
    """Return the Jacobian (n, 4) of the second coordinate of fiducials; zeros for rulers."""
    across = np.where(rulers.radius[:, None] > 0, np.stack([-rulers.normal[:, 1], rulers.normal[:, 0]], axis=1), 0.0)
    lever = lever_arm(rulers.point - rulers.placement, across)
    return np.concatenate([across, lever[:, None], np.zeros((len(lever), 1))], axis=1)


def _greedy(
    weight: Float64,
    price: Float64,
    rulers: FeatureCandidates,
    imaging: Imaging,
    limits: tuple[float, str, int],
) -> npt.NDArray[np.int64]:
    budget, criterion, per_source = limits
    rows, second = _rows(rulers), _second_rows(rulers)
    # Prior variances: uniform distributions over the search range. The least one keeps the matrix invertible.
    prior = np.array([imaging.shift**2 / 3, imaging.shift**2 / 3, imaging.angle**2 / 3, imaging.etch_bias_sigma**2])
    covariance, etch_information = np.diag(np.maximum(prior, 1e-18)), 1 / max(prior[3], 1e-18)
    used: dict[int, int] = {}
    free = weight > 0
    chosen: list[int] = []
    while True:
        free &= price <= budget
        if not free.any():
            return np.array(chosen, dtype=np.int64)
        update = two_row_update(rows, second, weight, covariance)
        if criterion == "determinant":
            # Information of the pose alone: without the information of the etch bias.
            gain = np.log(update.determinant) - np.log1p(weight * rows[:, 3] ** 2 / etch_information)
        else:
            pairs = ((update.first, update.first), (update.first, update.second), (update.second, update.second))
            products = [np.sum(a[:, :2] * b[:, :2], axis=1) for a, b in pairs]
            one, two, mixed = update.one, update.two, update.mixed
            gain = weight * (two * products[0] - 2 * mixed * products[1] + one * products[2]) / update.determinant
        best = int(np.argmax(np.where(free, gain / price, -np.inf)))
        chosen.append(best)
        for row in (rows[best], second[best]):
            pulled = covariance @ row
            covariance -= weight[best] / (1 + weight[best] * (row @ pulled)) * np.outer(pulled, pulled)
        etch_information += weight[best] * rows[best, 3] ** 2
        budget -= price[best]
        free[best] = False
        source = int(rulers.source[best])
        used[source] = used.get(source, 0) + 1
        if used[source] >= per_source:
            free &= rulers.source != source


def _predict(
    weight: Float64, rulers: FeatureCandidates, chosen: npt.NDArray[np.int64], imaging: Imaging
) -> tuple[Float64, float]:
    """Return the covariance of the pose without the prior, the etch bias eliminated, and its condition."""
    if len(chosen) + int(np.sum(rulers.radius[chosen] > 0)) < 3:
        raise ValueError(f"{len(chosen)} rulers do not determine x, y and theta: give a larger budget or region")
    both = (_rows(rulers)[chosen], _second_rows(rulers)[chosen])
    information = np.asarray(sum((rows * weight[:, None]).T @ rows for rows in both))
    information[3, 3] += 1 / max(imaging.etch_bias_sigma, 1e-9) ** 2
    pose = information[:3, :3] - np.outer(information[:3, 3], information[3, :3]) / information[3, 3]
    distance = max(float(np.hypot(*(rulers.point[chosen] - rulers.placement).T).mean()), imaging.pixel)
    metres = np.array([1.0, 1.0, 1 / distance])
    values = np.linalg.eigvalsh(pose * metres * metres[:, None])
    if not values[0] * _MAX_CONDITION**2 > values[2]:
        raise ValueError("these edges do not determine x, y and theta (all parallel, or all through one point)")
    return np.linalg.inv(pose), math.sqrt(values[2] / values[0])


def _region(rulers: FeatureCandidates, chosen: npt.NDArray[np.int64], imaging: Imaging) -> Float64:
    normal = np.abs(rulers.normal[chosen])
    wide = np.where(rulers.radius[chosen] > 0, rulers.length[chosen], imaging.width_px * imaging.pixel)
    half = normal * rulers.length[chosen, None] / 2 + normal[:, ::-1] * wide[:, None] / 2
    return np.stack([(rulers.point[chosen] - half).min(axis=0), (rulers.point[chosen] + half).max(axis=0)])
