"""Calibration of a camera, its sensor tilted or not, from views of a flat target with known points."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
from scipy.special import fdtrc

from gpuvision.camera.tilted_projection import Floats, tilt_matrix
from gpuvision.camera.views.bundle_adjustment import Loss, State, Views, adjust, residuals, robust_scale
from gpuvision.camera.views.camera_fit import (
    Alternative,
    CameraFit,
    camera_of,
    covariances,
    lens_poses,
    noise_of,
    variance_of,
)
from gpuvision.camera.views.diagnosis import diagnose, fixes_focus
from gpuvision.camera.views.initialization import Flat, closed_form, closed_form_of_tilt, flatten, poses
from gpuvision.camera.views.parameters import COEFFICIENTS, Chart, internal_of
from gpuvision.camera.views.target_views import Mask, pack
from gpuvision.validation import finite, numbers

LossName = Literal["squared", "huber", "tukey"]

AUTOMATIC = ("none", "k1", "k1,k2", "tilt,k1", "tilt")
"""What ``model="auto"`` chooses from, smallest first; "tilt" is "tilt,k1,k2"."""
_LEVEL = 0.001
# A start that ends this far above what free homographies leave is tried again from elsewhere.
_SUFFICIENT = 1.3
_RESCALINGS = 10
_SAME_SCALE = 0.01
# Share of a view's points that must fit before the others count as outliers.
_FEWEST_GOOD = 0.25
# Outliers may lie anywhere, but not so many of them.
_MOST_OUTSIDE = 0.05
# One of 1e5 points at normal noise.
_OUTLIER = 5.0
# Residuals below are rounding: of no use to tell models apart.
_EXACT_PX = 1e-6


@dataclass(frozen=True)
class _Task:
    """What one call of `fit_camera` works on."""

    views: Views
    masks: tuple[Mask, ...]
    size: tuple[int, int]
    flat: Flat
    origin: Floats
    radius: float
    loss: Loss
    sigma: float | None
    aspect: bool
    focal_length: float | None
    centre_is_known: bool

    def chart(self, model: str) -> Chart:
        tilt, coefficients = _parsed(model)
        return Chart(
            coefficients=coefficients,
            tilt=tilt,
            aspect=self.aspect,
            focal_length=self.focal_length,
            centre=not self.centre_is_known,
        )


@dataclass(frozen=True)
class _Candidate:
    model: str
    chart: Chart
    state: State
    loss: Loss


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
) -> CameraFit:
    """Calibrate a camera from views of a flat target. It needs no first guess.

    Parameters
    ----------
    views
        Per image (points on the target [m], points in the image [px]), see `View` and `make_view`.
    image_size
        (columns, rows), pixels.
    model
        What is free beside focal length and centre: "none", or names out of k1, k2, p1, p2, k3 and tilt, joined by
        commas; "tilt" alone is "tilt,k1,k2". "auto" takes the smallest of "none", "k1", "k1,k2", "tilt,k1" and
        "tilt" that an F test at 0.1 % does not refuse. Tangential terms beside a tilt are refused: they are
        confounded.
    focal_length
        f' (fx of a tilted camera) where it is known, pixels: one view then suffices.
    centre
        Where the optical axis meets the sensor, where that is known: the tilt then needs no distortion to be seen.
    free_aspect
        Whether fy is free beside fx.
    loss
        "squared" (least squares), "huber", or "tukey" (which gives outliers no weight).
    sigma
        Noise of one image coordinate, pixels, where it is known; else the residual tells.

    Returns
    -------
    CameraFit

    Raises
    ------
    ValueError
        The data lack something; the message names it.
    """
    if loss not in get_args(LossName):
        raise ValueError(f"loss is {loss!r}, expected one of {', '.join(get_args(LossName))}")
    if sigma is not None and not sigma > 0.0:
        raise ValueError(f"sigma is {sigma}, expected a number of pixels above 0")
    models = list(AUTOMATIC) if model == "auto" else [model]
    _parsed(model if model != "auto" else "none")
    task = _prepared(views, image_size, focal_length, centre, loss, sigma, free_aspect)
    models = _check_enough(task, models)
    largest = _searched(task, models[-1])
    candidates = [_refined(task, each, largest) for each in models[:-1]] + [largest]
    p_values = [_p_value(task, each, largest) for each in candidates]
    compared = next(
        each
        for each, p in zip(candidates, p_values, strict=True)
        if each is largest or (p >= _LEVEL and _is_physical(task, each.state))
    )
    chosen = _without_outliers(task, compared) if loss == "tukey" else compared
    alternatives = tuple(
        _alternative(task, each, p, chosen.state)
        for each, p in zip(candidates, p_values, strict=True)
        if each is not compared
    )
    return _result(task, chosen, alternatives)


def _prepared(
    views: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    image_size: tuple[int, int],
    focal_length: float | None,
    centre: tuple[float, float] | None,
    loss: LossName,
    sigma: float | None,
    free_aspect: bool,
) -> _Task:
    """Check and pack what was given, and fit the homographies."""
    packed, masks = pack(views)
    size = (int(image_size[0]), int(image_size[1]))
    _check_inside(packed, size)
    known = None if centre is None else numbers(centre, (2,), "centre (column, row)")
    origin = 0.5 * (np.array(size) - 1.0) if known is None else np.array(known)
    radius = 0.5 * math.hypot(*size)
    flat = flatten(packed, origin, radius, robust=loss != "squared")
    return _Task(
        views=packed,
        masks=masks,
        size=size,
        flat=flat,
        origin=origin,
        radius=radius,
        # Tukey's loss has many minima, Huber's one near the start: models are searched and compared under that.
        loss=Loss("squared" if loss == "squared" else "huber", flat.noise if sigma is None else sigma),
        sigma=sigma,
        aspect=free_aspect,
        focal_length=None if focal_length is None else _positive(focal_length, "focal_length"),
        centre_is_known=known is not None,
    )


def _check_inside(views: Views, size: tuple[int, int]) -> None:
    outside = ((views.seen < -0.5) | (views.seen > np.array(size)[:, None] - 0.5)).any(axis=1) & (views.weight > 0.0)
    count = np.count_nonzero(outside)
    if count > _MOST_OUTSIDE * np.sum(views.weight):
        raise ValueError(
            f"{count} points lie outside an image of {size[0]} columns and {size[1]} rows: is image_size right?"
        )


def _positive(value: float, what: str) -> float:
    number = finite(value, what)
    if number <= 0.0:
        raise ValueError(f"{what} is {number:g}, expected a number above 0")
    return number


def _parsed(model: str) -> tuple[bool, tuple[str, ...]]:
    """Tilt or not, and the free distortion coefficients."""
    if model == "tilt":
        return True, ("k1", "k2")
    names = [] if model == "none" else [name.strip() for name in model.split(",")]
    for name in names:
        if name not in ("tilt", *COEFFICIENTS):
            raise ValueError(
                f"model: unknown term {name!r}, expected some of tilt, {', '.join(COEFFICIENTS)}, or auto, or none"
            )
    if "tilt" in names and ("p1" in names or "p2" in names):
        raise ValueError("model: p1 and p2 beside a tilt are confounded with it; leave out them, or the tilt")
    return "tilt" in names, tuple(name for name in COEFFICIENTS if name in names)


def _check_enough(task: _Task, models: Sequence[str]) -> list[str]:
    """Return the models that have points enough."""
    needed = {model: task.chart(model).free + 6 * len(task.masks) for model in models}
    enough = [model for model in models if needed[model] <= task.views.coordinates]
    if not enough:
        raise ValueError(
            f"{task.views.coordinates // 2} points in {len(task.masks)} views are too few for the {needed[models[0]]} "
            f"unknowns of model {models[0]!r}"
        )
    if len(task.masks) == 1 and task.focal_length is None:
        raise ValueError("one view of a plane does not fix the focal length: give focal_length= or more views")
    sides = np.linalg.det(task.flat.homographies) > 0.0
    if sides.any() and not sides.all():
        few = np.flatnonzero(sides == (sides.sum() < sides.size / 2)).tolist()
        raise ValueError(f"views {few} show the target from its other side: their numbering or image is mirrored")
    return enough


def _starts(task: _Task, chart: Chart) -> Iterator[State]:
    """Cameras to start from, the most likely first."""
    flat = task.flat
    if chart.tilt and task.focal_length is not None:
        oblique = closed_form_of_tilt(flat.homographies, None, task.focal_length / task.radius)
        if oblique is not None:
            yield _start(task, chart, oblique[0], 1.0, oblique[1])
    closed = closed_form(flat.homographies, task.aspect) if len(task.masks) > 1 else None
    if closed is not None:
        yield _start(task, chart, *closed)
    # v = f tan(alpha) away from the centre, about it in eight directions; f' as given or over the usual range.
    scales = [0.6, 1.2, 2.5, 5.0, 10.0] if task.focal_length is None else [task.focal_length / task.radius]
    for alpha in (0.0, 0.35, 0.7) if chart.tilt else (0.0,):
        for scale in scales:
            for direction in np.arange(8.0 if alpha else 1.0) * math.pi / 4.0:
                v = -scale * math.sin(alpha) * np.array([math.cos(direction), math.sin(direction)])
                yield _start(task, chart, scale * math.cos(alpha), 1.0, v)


def _start(task: _Task, chart: Chart, f: float, aspect: float, v: Floats) -> State:
    """Return the state of a virtual camera, in units of the image's radius about its middle or the known centre."""
    rotations, translations = poses(task.flat.homographies, f, aspect, v)
    square = f * f + float(v @ v)
    values = np.zeros(11)
    values[:6] = [f * task.radius, aspect, *(v * task.radius + task.origin), *task.origin]
    if not chart.tilt and chart.centre:
        values[4:6] = values[2:4]
        square = f * f
    if "k1" in chart.coefficients:
        values[6] = task.flat.radial[0] * square
    if "k2" in chart.coefficients:
        values[7] = task.flat.radial[1] * square**2
    return State(values, rotations, translations)


def _searched(task: _Task, model: str) -> _Candidate:
    """Fit a model from several starts, if the first does not do as well as free homographies."""
    chart = task.chart(model)
    best: _Candidate | None = None
    for start in _starts(task, chart):
        tried = _fitted(task, _Candidate(model, chart, start, task.loss))
        if not np.isfinite(tried.state.cost) or not _is_physical(task, tried.state):
            continue
        if best is None or tried.state.cost < best.state.cost:
            best = tried
        if noise_of(task.views, chart, best.state, best.loss) < _SUFFICIENT * task.flat.noise:
            break
    if best is None:
        raise ValueError("no camera explains these views: are target and image points paired, and image_size right?")
    return best


def _fitted(task: _Task, candidate: _Candidate) -> _Candidate:
    """Minimise the loss; a robust one at the scale that its own residuals have."""
    state, loss = candidate.state, candidate.loss
    for _ in range(1 if loss.kind == "squared" or task.sigma is not None else _RESCALINGS):
        used = loss
        state = adjust(task.views, candidate.chart, state, used)
        if not np.isfinite(state.cost) or loss.kind == "squared":
            break
        loss = loss._replace(scale=robust_scale(task.views, state))
        if abs(loss.scale - used.scale) <= _SAME_SCALE * used.scale:
            break
    # The cost belongs to the scale it was reached at.
    return replace(candidate, state=state, loss=used)


def _without_outliers(task: _Task, candidate: _Candidate) -> _Candidate:
    """Go on from Huber's minimum to the nearest of Tukey's, in which outliers have no weight."""
    loss = candidate.loss._replace(kind="tukey")
    length = np.linalg.norm(residuals(task.views, candidate.state), axis=1)
    weight = task.views.weight
    lost = np.flatnonzero(np.sum(weight * (loss.weight(length) > 0.0), axis=1) < _FEWEST_GOOD * np.sum(weight, axis=1))
    if len(lost):
        raise ValueError(f"views {lost.tolist()} do not fit the others: leave them out, or take loss='huber'")
    return _fitted(task, replace(candidate, loss=loss))


def _is_physical(task: _Task, state: State) -> bool:
    """Whether every point of the target lies before the fold of the lens."""
    back = tilt_matrix(*internal_of(state.numbers)[0][4:6]).T
    before = back @ (state.rotations @ task.views.target + state.translations[..., None])
    return bool(np.isfinite(camera_of(state.numbers).project(np.swapaxes(before, 1, 2))).all())


def _refined(task: _Task, model: str, largest: _Candidate) -> _Candidate:
    """Fit a smaller model from what the largest found, and where that leads nowhere from the closed form."""
    chart = task.chart(model)
    reduced = largest.state.numbers.copy()
    for place, name in enumerate(COEFFICIENTS, 6):
        reduced[place] *= name in chart.coefficients
    if not chart.tilt and chart.centre:
        reduced[4:6] = reduced[2:4]
    warm = replace(largest.state, numbers=reduced)
    # At the scale of the largest: costs at other scales could not be compared.
    state = adjust(task.views, chart, warm, largest.loss)
    if not state.settled:
        cold = adjust(task.views, chart, next(_starts(task, chart)), largest.loss)
        state = min(state, cold, key=lambda end: end.cost)
    return _Candidate(model, chart, state, largest.loss)


def _result(task: _Task, chosen: _Candidate, alternatives: tuple[Alternative, ...]) -> CameraFit:
    """Describe a fit, with what its data leave open."""
    state, chart = chosen.state, chosen.chart
    noise = noise_of(task.views, chart, state, chosen.loss)
    covariance, pose_covariance, focus = covariances(task.views, chart, state, chosen.loss, task.sigma)
    if task.focal_length is not None:
        focus = 0.0
    errors = residuals(task.views, state)
    fit = CameraFit(
        camera=camera_of(state.numbers),
        model=chosen.model,
        poses=lens_poses(state),
        names=chart.names,
        covariance=covariance,
        pose_covariance=pose_covariance,
        rms_px=_rms(task, state),
        sigma=noise if task.sigma is None else task.sigma,
        residuals=_unpacked(task, errors),
        iterations=state.steps,
        alternatives=alternatives,
    )
    if not fixes_focus(fit, focus, settled=state.settled):
        raise ValueError(
            "the views do not fix the focal length: views at other angles to the camera, or focal_length=, are needed"
        )
    doubtful = np.linalg.norm(errors, axis=1) > _OUTLIER * robust_scale(task.views, state)
    warnings = diagnose(
        fit,
        task.size,
        focus=focus,
        settled=state.settled,
        noise=noise,
        outliers=int(doubtful.sum()) if chosen.loss.kind == "squared" else 0,
        mirrored=bool((np.linalg.det(task.flat.homographies) < 0.0).all()),
    )
    return replace(fit, warnings=warnings)


def _rms(task: _Task, state: State) -> float:
    return math.sqrt(2.0 * float(np.sum(residuals(task.views, state) ** 2)) / task.views.coordinates)


def _unpacked(task: _Task, errors: Floats) -> tuple[Floats, ...]:
    """Residuals per view, in the order of its points."""
    result = []
    for mask, error in zip(task.masks, errors, strict=True):
        whole = np.full((len(mask), 2), np.nan)
        whole[mask] = error.T[: np.count_nonzero(mask)]
        result.append(whole)
    return tuple(result)


def _p_value(task: _Task, small: _Candidate, large: _Candidate) -> float:
    """F test of a model within a larger one."""
    more = large.chart.free - small.chart.free
    if more == 0:
        return 1.0
    free = task.views.coordinates - large.chart.free - 6 * len(task.masks)
    if free <= 0:
        return 1.0
    rise = max(small.state.cost - large.state.cost, 0.0) / more
    noise = variance_of(task.views, large.chart, large.state, large.loss)
    return float(fdtrc(more, free, rise / max(noise, _EXACT_PX**2)))


def _alternative(task: _Task, other: _Candidate, p_value: float, chosen: State) -> Alternative:
    parameters = other.chart.free + 6 * len(task.masks)
    cost = max(other.state.cost / task.views.coordinates, _EXACT_PX**2)
    centre = other.state.numbers[4:6]
    return Alternative(
        model=other.model,
        rms_px=_rms(task, other.state),
        parameters=other.chart.free,
        p_value=p_value,
        aic=task.views.coordinates * math.log(cost) + 2.0 * parameters,
        centre=(float(centre[0]), float(centre[1])),
        centre_distance_px=float(np.linalg.norm(centre - chosen.numbers[4:6])),
    )
