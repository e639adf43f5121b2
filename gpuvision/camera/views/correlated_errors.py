"""Correlated residuals of a camera calibration: tests, and the covariance that includes them.

Two errors are common to many points and do not average out. A lens model that is too small leaves a smooth field that
is fixed in the image; `CorrelatedErrors.lack_of_fit` compares the residuals with a free field, as for straight lines
(`gpuvision.camera.lines.lack_of_fit`). A bent target, a moving target or a biased point detector causes errors that
differ from view to view; `view_p_value` tests one camera for all views against one camera for each view. If one of the
tests finds correlation, the covariance is the sum of the field's part and of the delete-one-view jackknife (clusters by
view, which is the sandwich estimator with the small-sample correction CR3).

All sums are inner products of the columns of one view, with the pose of the view projected out, so the memory does not
grow with the number of views times the number of modes.

References
----------
R. Bell and D. McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples, Survey
Methodology 28 (2002) 169. G. Chow, Tests of equality between sets of coefficients in two linear regressions,
Econometrica 28 (1960) 591, for the test between views.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.special import fdtrc

from gpuvision.camera.smooth_field import LackOfFit, mode_variances, not_below
from gpuvision.camera.tilted_projection import INTERNAL, Floats, project
from gpuvision.camera.views.bundle_adjustment import FitState, PackedViews, RobustLoss
from gpuvision.camera.views.parameters import FreeParameters, internal_parameters

# Degrees of the smooth field. The poses absorb most of the linear part. Degree 7 resolves a third of the image.
_DEGREES = (2, 7)
# Degrees of freedom per mode of the field, at least: with fewer, the noise is not known.
_FREEDOM_PER_MODE = 4
# Mean square of a mode that camera and poses leave over, relative to the mode, below which the data do not show it.
_SEEN_MODE = 1e-3
# Views of a jackknife, at least. Chosen: with fewer, its variances have less than four degrees of freedom.
MIN_VIEWS = 5
# Relative eigenvalue below which a view does not determine a combination of the camera parameters.
_SINGULAR = 1e-9
# Residuals [px] at rounding level, which no test may compare.
_EXACT_PX = 1e-6


class _Products(NamedTuple):
    """Inner products of the columns of each view, with its pose projected out: (views, m + modes + 1, ...).

    Columns: the free camera parameters, each scaled by ``scale``; the modes of the field; the residual.
    """

    by_view: Floats
    scale: Floats
    degree: npt.NDArray[np.intp]


@dataclass(frozen=True)
class CorrelatedErrors:
    """Tests for correlated residuals of a camera fit, and their part of the covariance.

    Attributes
    ----------
    lack_of_fit
        Smooth field in the residuals that is fixed in the image.
    view_p_value
        p-value of the test that one camera explains all views; 1 with too few views or points.
    field, by_view
        (m, m): parts of the covariance of the free parameters; ``by_view`` is None with fewer than five views.
    """

    lack_of_fit: LackOfFit
    view_p_value: float
    field: Floats
    by_view: Floats | None

    def is_correlated(self, significance: float) -> bool:
        """Return whether one of the two tests rejects independent errors."""
        return min(self.lack_of_fit.p_value, self.view_p_value) < significance

    def covariance_by_view(self, white: Floats) -> Floats:
        """Return the covariance for errors by view; in no direction is it below ``white`` of independent errors."""
        if self.by_view is None:
            return white
        scale = np.sqrt(white.diagonal())
        outer = np.outer(scale, scale)
        return np.asarray(not_below(self.by_view / outer, white / outer) * outer)

    def covariance(self, white: Floats) -> Floats:
        """Return the covariance for errors by view, and for a smooth field in the image."""
        return np.asarray(self.covariance_by_view(white) + self.field)


def correlated_errors(
    views: PackedViews, free_parameters: FreeParameters, state: FitState, loss: RobustLoss
) -> CorrelatedErrors:
    """Test the residuals of a fit for correlation."""
    count, m = views.coordinates, free_parameters.count
    free = count - m - 6 * len(views.image)
    products = _inner_products(views, free_parameters, state, loss, free // _FREEDOM_PER_MODE)
    total = products.by_view.sum(axis=0)
    camera, modes, residual = slice(0, m), slice(m, -1), -1
    shifts = np.linalg.lstsq(total[camera, camera], total[camera, modes], rcond=None)[0]
    seen = total[modes, modes] - total[camera, modes].T @ shifts
    # At the minimum the residual is orthogonal to the camera's columns.
    product = total[modes, residual]
    cost = float(total[residual, residual])
    lack, variance = _lack_of_fit(seen, product, cost, count, free)
    by_degree = mode_variances(products.degree, seen, product, variance, count)
    outer = np.outer(products.scale, products.scale)
    field = (shifts * by_degree[products.degree]) @ shifts.T * outer
    return CorrelatedErrors(
        lack_of_fit=lack,
        view_p_value=_view_p_value(
            products.by_view[:, camera, camera], products.by_view[:, camera, residual], cost, free
        ),
        field=field,
        by_view=None if len(views.image) < MIN_VIEWS else outer * _jackknife(products.by_view, m),
    )


def _inner_products(
    views: PackedViews, free_parameters: FreeParameters, state: FitState, loss: RobustLoss, most_modes: int
) -> _Products:
    """Return the inner products of each view; points are weighted by a robust loss."""
    internal, to_internal = internal_parameters(state.values)
    free = to_internal @ free_parameters.derivative(state.values)
    low, high = _bounding_box(views)
    degree = _degrees(most_modes)
    products = []
    for view in range(len(views.image)):
        known = views.weight[view] > 0.0
        target, image = views.target[view][None, :, known], views.image[view][:, known]
        projected = project(
            internal, state.rotations[view][None], state.translations[view][None], target, derivatives=True
        )
        assert projected.jacobian is not None, "the fit ended with every point in front of the camera"
        residual = image - projected.points[0]
        root = np.sqrt(loss.weight(np.linalg.norm(residual, axis=0)))
        jacobian = projected.jacobian[0] * root
        split = len(INTERNAL)
        rows = np.concatenate(
            [
                (free.T @ jacobian[:split].reshape(split, -1)),
                _field(image, low, high, degree, root),
                (residual * root).reshape(1, -1),
            ]
        )
        pose = jacobian[split:].reshape(6, -1)
        # An orthonormal basis of the pose's columns; QR is more accurate than the normal equations.
        basis = np.linalg.qr(pose.T)[0]
        along = rows @ basis
        products.append(rows @ rows.T - along @ along.T)
    by_view = np.array(products)
    m = free_parameters.count
    scale = 1.0 / np.sqrt(np.maximum(by_view.sum(axis=0).diagonal()[:m], np.finfo(np.float64).tiny))
    by_view[:, :m] *= scale[:, None]
    by_view[:, :, :m] *= scale
    return _Products(by_view, scale, np.repeat(degree, 2 * (degree + 1)))


def _bounding_box(views: PackedViews) -> tuple[Floats, Floats]:
    """Return the lowest and the highest column and row of the measured points, (2, 1) each."""
    known = np.swapaxes(views.image, 0, 1)[:, views.weight > 0.0]
    low, high = known.min(axis=1, keepdims=True), known.max(axis=1, keepdims=True)
    return low, np.asarray(np.maximum(high, low + 1.0))


def _degrees(most_modes: int) -> npt.NDArray[np.intp]:
    """Return the degrees of the field with at most ``most_modes`` modes in total."""
    first, last = _DEGREES
    while last >= first and sum(2 * (n + 1) for n in range(first, last + 1)) > most_modes:
        last -= 1
    return np.arange(first, last + 1)


def _field(image: Floats, low: Floats, high: Floats, degree: npt.NDArray[np.intp], root: Floats) -> Floats:
    """Return the modes (modes, 2 n) at points (2, n): Legendre polynomials with a mean square of 1 over the box."""
    last = int(degree.max(initial=0))
    norm = np.sqrt(2.0 * np.arange(last + 1) + 1.0)
    across, down = (
        legendre.legvander(each, last).T * norm[:, None] for each in 2.0 * (image - low) / (high - low) - 1.0
    )
    nothing = np.zeros_like(root)
    rows = []
    for n in degree:
        for power in range(n + 1):
            shape = across[power] * down[n - power] * root
            rows += [np.concatenate([shape, nothing]), np.concatenate([nothing, shape])]
    return np.array(rows).reshape(len(rows), 2 * len(root))


def _lack_of_fit(seen: Floats, product: Floats, cost: float, count: int, free: int) -> tuple[LackOfFit, float]:
    """Return the test of the smooth field and the variance of the remaining residuals."""
    values, vectors = np.linalg.eigh(seen) if len(seen) else (np.empty(0), np.empty((0, 0)))
    kept = values > _SEEN_MODE * count
    modes = int(np.count_nonzero(kept))
    gain = float(np.sum((vectors[:, kept].T @ product) ** 2 / values[kept]))
    left = free - modes
    noise = max(cost - gain, 0.0) / max(left, 1)
    p_value = 1.0 if not modes or left <= 0 else float(fdtrc(modes, left, gain / modes / max(noise, _EXACT_PX**2)))
    surplus = max(gain - modes * noise, 0.0) / count
    return LackOfFit(p_value=p_value, rms_px=math.sqrt(surplus), noise_px=math.sqrt(noise), modes=modes), noise


def _view_p_value(normal: Floats, side: Floats, cost: float, free: int) -> float:
    """Return the p-value of one camera for all views against one camera for each view, to first order."""
    if len(normal) < 2:
        return 1.0
    values, vectors = np.linalg.eigh(normal)
    turned = np.einsum("vij,vi->vj", vectors, side)
    kept = values > _SINGULAR * values[:, -1:]
    gain = float(np.sum(turned[kept] ** 2 / values[kept]))
    more = int(np.count_nonzero(kept)) - normal.shape[1]
    left = free - more
    if more <= 0 or left <= 0:
        return 1.0
    return float(fdtrc(more, left, gain / more / max(max(cost - gain, 0.0) / left, _EXACT_PX**2)))


def _jackknife(products: Floats, m: int) -> Floats:
    """Return the delete-one-view jackknife covariance of the scaled camera parameters, to first order."""
    normal, side = products[:, :m, :m], products[:, :m, -1]
    left = normal.sum(axis=0) - normal
    # The pseudoinverse: one view may hold all points that determine a parameter.
    shifts = np.einsum("vij,vj->vi", np.linalg.pinv(left, hermitian=True), side)
    return np.asarray(shifts.T @ shifts * ((len(shifts) - 1) / len(shifts)))
