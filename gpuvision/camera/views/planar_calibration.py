"""Calibration of a camera, its sensor tilted or not, from views of a flat target with known points."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gpuvision.camera.tilted_projection import Floats, tilt_matrix
from gpuvision.camera.views.bundle_adjustment import FitState, PackedViews, RobustLoss, adjust, residuals, robust_scale
from gpuvision.camera.views.calibration_candidates import (
    CalibrationTask,
    Candidate,
    alternative_of,
    calibration_result,
    p_value_against,
    parse_model,
)
from gpuvision.camera.views.camera_fit import (
    CameraFit,
    camera_from_parameters,
    residual_sigma,
)
from gpuvision.camera.views.diagnosis import DEFAULT_LIMITS, CalibrationLimits
from gpuvision.camera.views.initialization import (
    fit_homographies,
    poses_from_homographies,
    tilt_closed_form,
    zhang_closed_form,
)
from gpuvision.camera.views.parameters import COEFFICIENTS, FIT_PARAMETERS, FreeParameters, internal_parameters
from gpuvision.camera.views.target_views import pack
from gpuvision.validation import finite, numbers

LossName = Literal["squared", "huber", "tukey"]

AUTOMATIC_MODELS = ("none", "k1", "k1,k2", "tilt,k1", "tilt")
"""Candidates of ``model="auto"``, smallest first; "tilt" is "tilt,k1,k2"."""
FURTHER_MODELS = (("k1,k2,k3", "tilt,k1,k2,k3"), ("k1,k2,k3,k4,k5,k6", "tilt,k1,k2,k3,k4,k5,k6"))
"""Further candidates, without and with a tilt. Each pair is tried if the test rejects all models before it."""
# Robust scale: largest number of re-estimations, and the relative change that ends them.
_MAX_RESCALINGS = 10
_SAME_SCALE = 0.01
# Relative size below which a direction of the coordinates is rounding.
_SINGULAR = 1e-9
# Residuals [px] at rounding level, which cannot distinguish models.
_EXACT_PX = 1e-6


def fit_camera(
    views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    image_size: tuple[int, int],
    *,
    model: str = "auto",
    focal_length: float | None = None,
    centre: tuple[float, float] | None = None,
    free_aspect: bool = False,
    loss: LossName = "squared",
    sigma: float | None = None,
    limits: CalibrationLimits = DEFAULT_LIMITS,
) -> CameraFit:
    """Calibrate a camera, with or without sensor tilt, from views of a flat target. No starting values are needed.

    Parameters
    ----------
    views : sequence of View or pairs of array_like
        Per image: points on the target (n, 2) or (n, 3) [m], and their image points (n, 2) [px]; see `make_view`.
    image_size : (int, int)
        Columns and rows [px].
    model : str
        Free parameters besides focal length and centre: "none", or terms out of k1, k2, p1, p2, k3, k4, k5, k6 (the
        denominator of OpenCV's rational model) and tilt, joined by commas; "tilt" alone is "tilt,k1,k2". "auto"
        (default): the smallest of "none", "k1", "k1,k2", "tilt,k1" and "tilt" that a test at 0.1 % accepts; if it
        rejects "tilt", also k3, and then k4 to k6, without and with a tilt. The test is an F test, or Wald's test if
        the residuals are correlated. Tangential terms together with a tilt are refused: their effects cannot be
        separated.
    focal_length : float, optional
        Known f' (fx of a tilted camera) [px]; one view is then enough. Default: estimated.
    centre : (float, float), optional
        Known column and row of the optical axis [px]; the tilt is then determined without distortion. Default:
        estimated.
    free_aspect : bool
        Estimate fy independently of fx. Default False.
    loss : {"squared", "huber", "tukey"}
        RobustLoss of a residual. "huber" reduces the weight of outliers, "tukey" gives them no weight. Default
        "squared".
    sigma : float, optional
        Known standard deviation of one image coordinate [px]. Default: estimated from the residuals.
    limits : CalibrationLimits
        Thresholds of the model choice, the warnings and the acceptance.

    Returns
    -------
    CameraFit

    Raises
    ------
    ValueError
        The views do not determine the camera; the message names the missing data.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3. Z. Zhang, A
    flexible new technique for camera calibration, IEEE Trans. PAMI 22 (2000) 1330, for the starting values.
    """
    if loss not in get_args(LossName):
        raise ValueError(f"loss is {loss!r}, expected one of {', '.join(get_args(LossName))}")
    if sigma is not None and not sigma > 0.0:
        raise ValueError(f"sigma is {sigma}, expected a number of pixels above 0")
    models = list(AUTOMATIC_MODELS) if model == "auto" else [model]
    parse_model(model if model != "auto" else "none")
    task = _prepare(views, image_size, focal_length, centre, loss, sigma, free_aspect, limits)
    models = _check_enough(task, models)
    largest = _fit_from_starts(task, models[-1])
    if model == "auto":
        models, largest = _with_further_terms(task, models, largest)
    candidates = [_fit_smaller_model(task, each, largest) for each in models[:-1]] + [largest]
    return _smallest_accepted(task, candidates, loss)


def _with_further_terms(task: CalibrationTask, models: list[str], largest: Candidate) -> tuple[list[str], Candidate]:
    """Add models with further coefficients as long as the test rejects the largest one; return models and largest."""
    for further in FURTHER_MODELS:
        free_parameters = task.free_parameters(further[-1])
        if free_parameters.count + 6 * len(task.masks) > task.views.coordinates:
            break
        state = adjust(task.views, free_parameters, largest.state, largest.loss)
        larger = Candidate(
            views=task.views,
            model=further[-1],
            free_parameters=free_parameters,
            state=state,
            loss=largest.loss,
        )
        if not state.converged or not _is_invertible(task, state):
            break
        if p_value_against(task, largest, larger) >= task.limits.significance:
            break
        models, largest = [*models, *further], larger
    return models, largest


def _smallest_accepted(task: CalibrationTask, candidates: list[Candidate], loss: LossName) -> CameraFit:
    """Return the smallest model that the F test accepts against the last one, with the others as alternatives."""
    largest = candidates[-1]
    p_values = [p_value_against(task, each, largest) for each in candidates]
    compared = next(
        each
        for each, p in zip(candidates, p_values, strict=True)
        if each is largest or (p >= task.limits.significance and _is_invertible(task, each.state))
    )
    chosen = _fit_tukey(task, compared) if loss == "tukey" else compared
    alternatives = tuple(
        alternative_of(task, each, p, chosen.state)
        for each, p in zip(candidates, p_values, strict=True)
        if each is not compared
    )
    return calibration_result(task, chosen, alternatives)


def _prepare(
    views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    image_size: tuple[int, int],
    focal_length: float | None,
    centre: tuple[float, float] | None,
    loss: LossName,
    sigma: float | None,
    free_aspect: bool,
    limits: CalibrationLimits,
) -> CalibrationTask:
    """Check and pack the inputs, and fit the homographies."""
    packed, masks = pack(views)
    size = (int(image_size[0]), int(image_size[1]))
    _check_inside(packed, size, limits)
    known = None if centre is None else numbers(centre, (2,), "centre (column, row)")
    origin = 0.5 * (np.array(size) - 1.0) if known is None else np.array(known)
    radius = 0.5 * math.hypot(*size)
    homography_fit = fit_homographies(packed, origin, radius, robust=loss != "squared")
    return CalibrationTask(
        views=packed,
        masks=masks,
        size=size,
        homography_fit=homography_fit,
        origin=origin,
        radius=radius,
        # Huber's loss has one minimum near the start, Tukey's has many: fit and compare the models under Huber's.
        loss=RobustLoss("squared" if loss == "squared" else "huber", homography_fit.noise if sigma is None else sigma),
        sigma=sigma,
        aspect=free_aspect,
        focal_length=None if focal_length is None else _positive(focal_length, "focal_length"),
        centre_is_known=known is not None,
        limits=limits,
    )


def _check_inside(views: PackedViews, size: tuple[int, int], limits: CalibrationLimits) -> None:
    """Refuse views with many points outside the image; outliers may lie anywhere."""
    outside = ((views.image < -0.5) | (views.image > np.array(size)[:, None] - 0.5)).any(axis=1) & (views.weight > 0.0)
    count = np.count_nonzero(outside)
    if count > limits.max_outside_share * np.sum(views.weight):
        raise ValueError(
            f"{count} points lie outside an image of {size[0]} columns and {size[1]} rows: check image_size"
        )


def _positive(value: float, name: str) -> float:
    number = finite(value, name)
    if number <= 0.0:
        raise ValueError(f"{name} is {number:g}, expected a number above 0")
    return number


def _check_enough(task: CalibrationTask, models: Sequence[str]) -> list[str]:
    """Return the models for which the number of points suffices."""
    needed = {model: task.free_parameters(model).count + 6 * len(task.masks) for model in models}
    enough = [model for model in models if needed[model] <= task.views.coordinates]
    if not enough:
        raise ValueError(
            f"{task.views.coordinates // 2} points in {len(task.masks)} views are too few for the {needed[models[0]]} "
            f"unknowns of model {models[0]!r}"
        )
    if len(task.masks) == 1 and task.focal_length is None:
        raise ValueError("one view of a plane does not fix the focal length: give focal_length= or more views")
    sides = np.linalg.det(task.homography_fit.homographies) > 0.0
    if sides.any() and not sides.all():
        minority = np.flatnonzero(sides == (sides.sum() < sides.size / 2)).tolist()
        raise ValueError(
            f"views {minority} show the target from its other side: their point order or image is mirrored"
        )
    return enough


def _starting_states(task: CalibrationTask, free_parameters: FreeParameters) -> Iterator[FitState]:
    """Yield starting states, the most likely first."""
    homography_fit = task.homography_fit
    if free_parameters.tilt and task.focal_length is not None:
        oblique = tilt_closed_form(homography_fit.homographies, None, task.focal_length / task.radius)
        if oblique is not None:
            yield _starting_state(task, free_parameters, oblique[0], 1.0, oblique[1])
    closed = zhang_closed_form(homography_fit.homographies, task.aspect) if len(task.masks) > 1 else None
    if closed is not None:
        yield _starting_state(task, free_parameters, *closed)
    # Grid search: three tilts, v = f tan(alpha) from the centre in eight directions, f' as given or over the usual
    # range.
    scales = [0.6, 1.2, 2.5, 5.0, 10.0] if task.focal_length is None else [task.focal_length / task.radius]
    for alpha in (0.0, 0.35, 0.7) if free_parameters.tilt else (0.0,):
        for scale in scales:
            for direction in np.arange(8.0 if alpha else 1.0) * math.pi / 4.0:
                v = -scale * math.sin(alpha) * np.array([math.cos(direction), math.sin(direction)])
                yield _starting_state(task, free_parameters, scale * math.cos(alpha), 1.0, v)


def _starting_state(
    task: CalibrationTask, free_parameters: FreeParameters, f: float, aspect: float, v: Floats
) -> FitState:
    """Return the state of a virtual camera in units of the image's radius, about its middle or the known centre."""
    rotations, translations = poses_from_homographies(task.homography_fit.homographies, f, aspect, v)
    square = f * f + float(v @ v)
    values = np.zeros(len(FIT_PARAMETERS))
    values[:6] = [f * task.radius, aspect, *(v * task.radius + task.origin), *task.origin]
    if not free_parameters.tilt and free_parameters.centre:
        values[4:6] = values[2:4]
        square = f * f
    if "k1" in free_parameters.coefficients:
        values[6] = task.homography_fit.radial[0] * square
    if "k2" in free_parameters.coefficients:
        values[7] = task.homography_fit.radial[1] * square**2
    return FitState(values, rotations, translations)


def _fit_from_starts(task: CalibrationTask, model: str) -> Candidate:
    """Fit a model; try further starts until the residual is close to the residual of free homographies."""
    free_parameters = task.free_parameters(model)
    best: Candidate | None = None
    for start in _starting_states(task, free_parameters):
        candidate = Candidate(
            views=task.views, model=model, free_parameters=free_parameters, state=start, loss=task.loss
        )
        tried = _minimise_loss(task, candidate)
        if not np.isfinite(tried.state.cost) or not _is_invertible(task, tried.state):
            continue
        if best is None or tried.state.cost < best.state.cost:
            best = tried
        if (
            residual_sigma(task.views, free_parameters, best.state, best.loss)
            < task.limits.sufficient_noise_ratio * task.homography_fit.noise
        ):
            break
    if best is None:
        raise ValueError("no camera fits these views: check the pairing of target and image points, and image_size")
    return best


def _minimise_loss(task: CalibrationTask, candidate: Candidate) -> Candidate:
    """Minimise the loss; re-estimate the scale of a robust loss from its residuals."""
    state, loss = candidate.state, candidate.loss
    for _ in range(1 if loss.kind == "squared" or task.sigma is not None else _MAX_RESCALINGS):
        used = loss
        state = adjust(task.views, candidate.free_parameters, state, used)
        if not np.isfinite(state.cost) or loss.kind == "squared":
            break
        loss = loss._replace(scale=robust_scale(task.views, state))
        if abs(loss.scale - used.scale) <= _SAME_SCALE * used.scale:
            break
    # The cost belongs to the last scale that was used.
    return replace(candidate, state=state, loss=used)


def _fit_tukey(task: CalibrationTask, candidate: Candidate) -> Candidate:
    """Continue from Huber's minimum to the nearest minimum of Tukey's loss, which gives outliers no weight."""
    loss = candidate.loss._replace(kind="tukey")
    length = np.linalg.norm(residuals(task.views, candidate.state), axis=1)
    weight = task.views.weight
    least = task.limits.min_view_share * np.sum(weight, axis=1)
    lost = np.flatnonzero(np.sum(weight * (loss.weight(length) > 0.0), axis=1) < least)
    if len(lost):
        raise ValueError(f"views {lost.tolist()} do not fit the others: leave them out, or use loss='huber'")
    return _minimise_loss(task, replace(candidate, loss=loss))


def _is_invertible(task: CalibrationTask, state: FitState) -> bool:
    """Return whether every target point lies within the invertible region of the lens."""
    back = tilt_matrix(*internal_parameters(state.values)[0][4:6]).T
    before = back @ (state.rotations @ task.views.target + state.translations[..., None])
    return bool(np.isfinite(camera_from_parameters(state.values).project(np.swapaxes(before, 1, 2))).all())


def _fit_smaller_model(task: CalibrationTask, model: str, largest: Candidate) -> Candidate:
    """Fit a smaller model, starting from the largest one; if that does not converge, from the closed form."""
    free_parameters = task.free_parameters(model)
    reduced = largest.state.values.copy()
    for place, name in enumerate(COEFFICIENTS, 6):
        reduced[place] *= name in free_parameters.coefficients
    if not free_parameters.tilt and free_parameters.centre:
        reduced[4:6] = reduced[2:4]
    warm = replace(largest.state, values=reduced)
    # Keep the loss scale of the largest model: costs at different scales are not comparable.
    state = adjust(task.views, free_parameters, warm, largest.loss)
    if not state.converged:
        cold = adjust(task.views, free_parameters, next(_starting_states(task, free_parameters)), largest.loss)
        state = min(state, cold, key=lambda end: end.cost)
    return Candidate(views=task.views, model=model, free_parameters=free_parameters, state=state, loss=largest.loss)
