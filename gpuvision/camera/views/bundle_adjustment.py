"""Least squares over one camera and the pose of every view: Levenberg-Marquardt, poses eliminated (Schur)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from gpuvision.camera.tilted_projection import COLUMNS, INTERNAL, Floats, project, rotation_matrix
from gpuvision.camera.views.parameters import Chart, internal_of

# The fewer views, the more bent is the valley that the target's pose and the camera share, and the cheaper a step.
_FEWEST_STEPS, _STEPS_OF_A_VIEW = 100, 1000
# A fit ends where a step moves the numbers by less than this many of their standard deviations ...
_SETTLED = 1e-4
# ... or the residual is down to the rounding of pixel coordinates.
_EXACT_PX = 1e-9
# Damping that holds back nothing, and damping at which no step leads down.
_UNDAMPED, _STUCK = 1e-11, 1e16
MEDIAN_OF_NORM = 1.1774  # of two normal deviates
# 95 % efficiency for normal noise on two coordinates.
_HUBER, _TUKEY = 1.5, 5.123


class Views(NamedTuple):
    """Points of all views, missing ones with weight 0.

    Attributes
    ----------
    target
        (views, 3, n), on Z = 0.
    seen
        (views, 2, n): columns and rows, pixels.
    weight
        (views, n): 1 or 0.
    """

    target: Floats
    seen: Floats
    weight: Floats

    @property
    def coordinates(self) -> int:
        """Measured coordinates: two a point."""
        return 2 * int(np.count_nonzero(self.weight))


class Loss(NamedTuple):
    """A robust loss on the length of a residual: 'squared', 'huber' or 'tukey', at a scale in pixels."""

    kind: str = "squared"
    scale: float = 1.0

    def cost(self, length: Floats) -> Floats:
        """Twice the loss: the square, for small residuals."""
        if self.kind == "squared":
            return length**2
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return np.where(length < edge, length**2, edge * (2.0 * length - edge))
        edge = _TUKEY * self.scale
        return edge**2 / 3.0 * (1.0 - np.clip(1.0 - (length / edge) ** 2, 0.0, None) ** 3)

    def weight(self, length: Floats) -> Floats:
        """Weight of a residual in the iterated least squares."""
        if self.kind == "squared":
            return np.ones_like(length)
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return edge / np.maximum(length, edge)
        return np.clip(1.0 - (length / (_TUKEY * self.scale)) ** 2, 0.0, None) ** 2

    def slope(self, length: Floats) -> Floats:
        """Mean over directions of the derivative of weight times residual: how stiffly the loss holds a point."""
        if self.kind == "squared":
            return np.ones_like(length)
        if self.kind == "huber":
            edge = _HUBER * self.scale
            return np.where(length < edge, 1.0, 0.5 * edge / np.maximum(length, edge))
        square = (length / (_TUKEY * self.scale)) ** 2
        return np.clip(1.0 - square, 0.0, None) * (1.0 - 3.0 * square) * (square < 1.0)


class System(NamedTuple):
    """Normal equations: cameras (m, m), (views, m, 6), poses (views, 6, 6), right-hand sides; the loss beside."""

    camera: Floats
    mixed: Floats
    pose: Floats
    camera_side: Floats
    pose_side: Floats
    cost: float


@dataclass(frozen=True)
class State:
    """A camera with poses, and how well it fits.

    Attributes
    ----------
    numbers
        `chart.NUMBERS`.
    rotations, translations
        From the target to the sensor's frame.
    cost
        Sum of the loss over all points.
    steps
        Steps tried.
    settled
        Whether the last step was below the noise.
    """

    numbers: Floats
    rotations: Floats
    translations: Floats
    cost: float = np.inf
    steps: int = 0
    settled: bool = False


def residuals(views: Views, state: State) -> Floats:
    """Seen minus projected, (views, 2, n); 0 where missing."""
    projected = project(internal_of(state.numbers)[0], state.rotations, state.translations, views.target)
    return np.where(views.weight[:, None] > 0.0, views.seen - projected.points, 0.0)


def robust_scale(views: Views, state: State) -> float:
    """Noise per coordinate from the median length of the residuals, pixels."""
    length = np.linalg.norm(residuals(views, state), axis=1)[views.weight > 0.0]
    return max(float(np.median(length)) / MEDIAN_OF_NORM, _EXACT_PX)


def solve(system: System, damping: float) -> tuple[Floats, Floats, Floats]:
    """Step of camera and poses at a relative damping of the diagonal, and the reduced camera matrix."""
    grow = 1.0 + damping
    six, m = np.arange(6), np.arange(len(system.camera))
    pose, camera = system.pose.copy(), system.camera.copy()
    pose[:, six, six] *= grow
    camera[m, m] *= grow
    right = np.concatenate([np.swapaxes(system.mixed, 1, 2), system.pose_side[..., None]], axis=2)
    eliminated = np.linalg.solve(pose, right)
    reduced = camera - np.sum(system.mixed @ eliminated[..., :-1], axis=0)
    side = system.camera_side - np.sum(system.mixed @ eliminated[..., -1:], axis=0)[:, 0]
    # Scaled to a unit diagonal: focal lengths and k3 are 1e8 apart.
    unit = 1.0 / np.sqrt(np.maximum(np.diag(camera), np.finfo(float).tiny))
    step = unit * np.linalg.lstsq(reduced * np.outer(unit, unit), unit * side, rcond=1e-15)[0]
    return step, eliminated[..., -1] - (eliminated[..., :-1] @ step), reduced


def linearise(views: Views, chart: Chart, state: State, loss: Loss, stiffness: bool = False) -> System | None:
    """Return the normal equations at a state, or None where a point lies behind the camera.

    With ``stiffness`` points weigh by the loss' second derivative (for covariances), else by its weight (for steps).
    """
    if not (np.isfinite(state.numbers).all() and min(state.numbers[:2]) > 0.0):
        return None
    internal, to_internal = internal_of(state.numbers)
    projected = project(internal, state.rotations, state.translations, views.target, derivatives=True)
    if projected.jacobian is None:
        return None
    residual = views.seen - projected.points
    length = np.sqrt(np.sum(residual**2, axis=1))
    weight = views.weight * (loss.slope(length) if stiffness else loss.weight(length))
    count = len(views.seen)
    jacobian = projected.jacobian.reshape(count, COLUMNS, -1)
    doubled = np.repeat(weight[:, None], 2, axis=1).reshape(count, 1, -1)
    weighted = jacobian * doubled
    hessian = weighted @ np.swapaxes(jacobian, 1, 2)
    side = (weighted @ residual.reshape(count, -1, 1))[..., 0]
    split = len(INTERNAL)
    free = to_internal @ chart.spread(state.numbers)
    return System(
        camera=free.T @ hessian[:, :split, :split].sum(axis=0) @ free,
        mixed=free.T @ hessian[:, :split, split:],
        pose=hessian[:, split:, split:],
        camera_side=free.T @ side[:, :split].sum(axis=0),
        pose_side=side[:, split:],
        cost=float(np.sum(views.weight * loss.cost(length))),
    )


def moved(chart: Chart, state: State, camera: Floats, poses: Floats) -> State:
    """Return the state after a step."""
    numbers = state.numbers + chart.basis @ camera
    return replace(
        state,
        numbers=chart.settled(numbers),
        rotations=rotation_matrix(poses[:, :3]) @ state.rotations,
        translations=state.translations + poses[:, 3:],
    )


def adjust(views: Views, chart: Chart, start: State, loss: Loss) -> State:
    """Move camera and poses to the nearest minimum of the loss.

    Levenberg-Marquardt with Nielsen's damping. It ends when a step would move nothing by more than 1e-4 of its
    standard deviation.
    """
    state = replace(start, numbers=chart.settled(start.numbers), cost=np.inf, steps=0, settled=False)
    system = linearise(views, chart, state, loss)
    if system is None:
        return state
    state = replace(state, cost=system.cost)
    damping, growth, polished = 1e-4, 2.0, False
    for count in range(1, max(_FEWEST_STEPS, _STEPS_OF_A_VIEW // len(views.seen)) + 1):
        camera, poses, _ = solve(system, damping)
        tried = moved(chart, state, camera, poses)
        next_system = linearise(views, chart, tried, loss)
        gain = float(camera @ system.camera_side + np.sum(poses * system.pose_side))
        small = gain < _SETTLED**2 * state.cost / views.coordinates
        if next_system is not None and next_system.cost < state.cost:
            # 1 where the linear prediction came true.
            truth = (state.cost - next_system.cost) / gain
            damping, growth = damping * max(0.1, 1.0 - (2.0 * truth - 1.0) ** 3), 2.0
            state, system = replace(tried, cost=next_system.cost, steps=count), next_system
        else:
            damping, growth = damping * growth, 2.0 * growth
        if (small and (polished or damping <= _UNDAMPED)) or state.cost < _EXACT_PX**2 * views.coordinates:
            return replace(state, settled=True, steps=count)
        if small:
            # Damping may hide what is left in a direction that the data hardly fix.
            damping, growth, polished = _UNDAMPED, 2.0, True
        if damping > _STUCK:
            break
    return replace(state, steps=count)
