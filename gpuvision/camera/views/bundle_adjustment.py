"""Bundle adjustment of one camera and the pose of every view: Levenberg-Marquardt with a Schur complement."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpuvision.camera.tilted_projection import COLUMNS, INTERNAL, Floats, project, rotation_matrix
from gpuvision.camera.views.parameters import FreeParameters, internal_parameters

# Largest number of steps: max(first, second / views). With few views pose and camera are strongly coupled, so more
# steps are needed, and a step is cheaper.
_MIN_STEPS, _STEPS_TIMES_VIEWS = 100, 1000
# The fit has converged if a step changes the parameters by less than this many standard deviations, or if the residual
# is at the rounding level of pixel coordinates [px].
_CONVERGED, _EXACT_PX = 1e-4, 1e-9
# Damping without effect, and damping above which no step decreases the cost.
_UNDAMPED, _MAX_DAMPING = 1e-11, 1e16
# Median length of a vector of two standard normal deviates: sqrt(2 ln 2).
MEDIAN_OF_NORM = 1.1774
# Tuning constants of Huber's and Tukey's loss [standard deviations of a coordinate]: 95 % efficiency for normal noise
# on two coordinates.
_HUBER, _TUKEY = 1.5, 5.123


class PackedViews(NamedTuple):
    """Points of all views, padded to one length.

    Attributes
    ----------
    target
        (views, 3, n): points on the target, Z = 0 [m].
    image
        (views, 2, n): measured columns and rows [px].
    weight
        (views, n): 1, or 0 for padding.
    """

    target: Floats
    image: Floats
    weight: Floats

    @property
    def coordinates(self) -> int:
        """Number of measured coordinates: two per point."""
        return 2 * int(np.count_nonzero(self.weight))


class RobustLoss(NamedTuple):
    """RobustLoss of the length of a residual vector: 'squared', 'huber' or 'tukey', with the noise scale [px]."""

    kind: str = "squared"
    scale: float = 1.0

    def cost(self, length: Floats) -> Floats:
        """Return twice the loss; for small residuals the squared length."""
        if self.kind == "squared":
            return length**2
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return np.where(length < edge, length**2, edge * (2.0 * length - edge))
        edge = _TUKEY * self.scale
        return edge**2 / 3.0 * (1.0 - np.clip(1.0 - (length / edge) ** 2, 0.0, None) ** 3)

    def weight(self, length: Floats) -> Floats:
        """Return the weight of a residual in iteratively reweighted least squares."""
        if self.kind == "squared":
            return np.ones_like(length)
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return edge / np.maximum(length, edge)
        return np.clip(1.0 - (length / (_TUKEY * self.scale)) ** 2, 0.0, None) ** 2

    def slope(self, length: Floats) -> Floats:
        """Return the derivative of weight times residual, averaged over directions: the curvature of the loss."""
        if self.kind == "squared":
            return np.ones_like(length)
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return np.where(length < edge, 1.0, 0.5 * edge / np.maximum(length, edge))
        square = (length / (_TUKEY * self.scale)) ** 2
        return np.clip(1.0 - square, 0.0, None) * (1.0 - 3.0 * square) * (square < 1.0)


class NormalEquations(NamedTuple):
    """Normal equations: blocks (m, m), (views, m, 6) and (views, 6, 6), right-hand sides, and the cost."""

    camera: Floats
    mixed: Floats
    pose: Floats
    camera_side: Floats
    pose_side: Floats
    cost: float


@dataclass(frozen=True)
class FitState:
    """Camera parameters and poses during a fit.

    Attributes
    ----------
    values
        (14,): the parameters named in `parameters.FIT_PARAMETERS`.
    rotations, translations
        (views, 3, 3) and (views, 3): from the target to the sensor's frame.
    cost
        Sum of the loss over all points [px^2].
    iterations
        Number of steps tried. Default 0.
    converged
        Whether the fit has converged. Default False.
    """

    values: Floats
    rotations: Floats
    translations: Floats
    cost: float = np.inf
    iterations: int = 0
    converged: bool = False


def residuals(views: PackedViews, state: FitState) -> Floats:
    """Return measured minus projected points, (views, 2, n) [px]; 0 for padding."""
    projected = project(internal_parameters(state.values)[0], state.rotations, state.translations, views.target)
    return np.where(views.weight[:, None] > 0.0, views.image - projected.points, 0.0)


def robust_scale(views: PackedViews, state: FitState) -> float:
    """Estimate the noise of a coordinate [px] from the median length of the residuals."""
    length = np.linalg.norm(residuals(views, state), axis=1)[views.weight > 0.0]
    return max(float(np.median(length)) / MEDIAN_OF_NORM, _EXACT_PX)


def solve_step(system: NormalEquations, damping: float) -> tuple[Floats, Floats, Floats]:
    """Return the steps of camera and poses for a relative damping of the diagonal, and the reduced camera matrix."""
    damped = 1.0 + damping
    six, m = np.arange(6), np.arange(len(system.camera))
    pose, camera = system.pose.copy(), system.camera.copy()
    pose[:, six, six] *= damped
    camera[m, m] *= damped
    right = np.concatenate([np.swapaxes(system.mixed, 1, 2), system.pose_side[..., None]], axis=2)
    eliminated = np.linalg.solve(pose, right)
    reduced = camera - np.sum(system.mixed @ eliminated[..., :-1], axis=0)
    side = system.camera_side - np.sum(system.mixed @ eliminated[..., -1:], axis=0)[:, 0]
    # Scale to a unit diagonal: the magnitudes of focal length and k3 differ by 1e8.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(camera), np.finfo(float).tiny))
    step = unit * np.linalg.lstsq(reduced * np.outer(unit, unit), unit * side, rcond=1e-15)[0]
    return step, eliminated[..., -1] - (eliminated[..., :-1] @ step), reduced


def linearise(
    views: PackedViews, free_parameters: FreeParameters, state: FitState, loss: RobustLoss, stiffness: bool = False
) -> NormalEquations | None:
    """Return the normal equations at a state; None if a point lies behind the camera.

    With ``stiffness`` the points are weighted by the second derivative of the loss (for covariances), otherwise by its
    weight (for steps).
    """
    if not (np.isfinite(state.values).all() and min(state.values[:2]) > 0.0):
        return None
    internal, to_internal = internal_parameters(state.values)
    projected = project(internal, state.rotations, state.translations, views.target, derivatives=True)
    if projected.jacobian is None:
        return None
    residual = views.image - projected.points
    length = np.sqrt(np.sum(residual**2, axis=1))
    weight = views.weight * (loss.slope(length) if stiffness else loss.weight(length))
    count = len(views.image)
    jacobian = projected.jacobian.reshape(count, COLUMNS, -1)
    doubled = np.repeat(weight[:, None], 2, axis=1).reshape(count, 1, -1)
    weighted = jacobian * doubled
    hessian = weighted @ np.swapaxes(jacobian, 1, 2)
    side = (weighted @ residual.reshape(count, -1, 1))[..., 0]
    split = len(INTERNAL)
    free = to_internal @ free_parameters.derivative(state.values)
    return NormalEquations(
        camera=free.T @ hessian[:, :split, :split].sum(axis=0) @ free,
        mixed=free.T @ hessian[:, :split, split:],
        pose=hessian[:, split:, split:],
        camera_side=free.T @ side[:, :split].sum(axis=0),
        pose_side=side[:, split:],
        cost=float(np.sum(views.weight * loss.cost(length))),
    )


def apply_step(free_parameters: FreeParameters, state: FitState, camera: Floats, poses: Floats) -> FitState:
    """Return the state after a step of camera and poses."""
    values = state.values + free_parameters.basis @ camera
    return replace(
        state,
        values=free_parameters.with_dependent(values),
        rotations=rotation_matrix(poses[:, :3]) @ state.rotations,
        translations=state.translations + poses[:, 3:],
    )


def adjust(views: PackedViews, free_parameters: FreeParameters, start: FitState, loss: RobustLoss) -> FitState:
    """Minimise the loss over camera and poses from a starting state.

    Levenberg-Marquardt with Nielsen's damping. The iteration ends when a step changes no parameter by more than 1e-4 of
    its standard deviation.

    References
    ----------
    K. Madsen, H. B. Nielsen and O. Tingleff, Methods for non-linear least squares problems, TU Denmark 2004.
    """
    state = replace(
        start, values=free_parameters.with_dependent(start.values), cost=np.inf, iterations=0, converged=False
    )
    system = linearise(views, free_parameters, state, loss)
    if system is None:
        return state
    state = replace(state, cost=system.cost)
    damping, damping_factor, polished = 1e-4, 2.0, False
    for count in range(1, max(_MIN_STEPS, _STEPS_TIMES_VIEWS // len(views.image)) + 1):
        camera, poses, _ = solve_step(system, damping)
        tried = apply_step(free_parameters, state, camera, poses)
        next_system = linearise(views, free_parameters, tried, loss)
        gain = float(camera @ system.camera_side + np.sum(poses * system.pose_side))
        small = gain < _CONVERGED**2 * state.cost / views.coordinates
        if next_system is not None and next_system.cost < state.cost:
            # Ratio of actual to predicted decrease; 1 for an exactly quadratic cost.
            ratio = (state.cost - next_system.cost) / gain
            damping, damping_factor = damping * max(0.1, 1.0 - (2.0 * ratio - 1.0) ** 3), 2.0
            state, system = replace(tried, cost=next_system.cost, iterations=count), next_system
        else:
            damping, damping_factor = damping * damping_factor, 2.0 * damping_factor
        if (small and (polished or damping <= _UNDAMPED)) or state.cost < _EXACT_PX**2 * views.coordinates:
            return replace(state, converged=True, iterations=count)
        if small:
            # Damping can hide a remaining step along a weakly determined direction: repeat the step without damping.
            damping, damping_factor, polished = _UNDAMPED, 2.0, True
        if damping > _MAX_DAMPING:
            break
    return replace(state, iterations=count)
