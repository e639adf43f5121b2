"""Reflectance of a metal (GGX): width of its lobe, and elevation of the directions above the surface."""

from __future__ import annotations

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.maps.stability import Axis, Floats, Problem
from gpuvision.simulation.scene.reflectance import Ggx, Reflectance

_EPS = float(np.finfo(np.float32).eps)


def problem() -> Problem:
    """Return the error of the reflectance over the roughness and the elevation of both directions."""
    return Problem(
        (Axis("roughness alpha", 1e-3, 1.0), Axis("cosine of incidence", 1e-3, 0.999)), "value", _errors, _bound
    )


def _errors(device: Device, places: Floats, rng: np.random.Generator) -> Floats:
    upright = places[:, 1:]
    along = np.sqrt(1.0 - upright**2)
    turn = rng.uniform(-np.pi, np.pi, (len(places), 1))
    # The eye near the mirrored light, as far away as the lobe is wide.
    other = turn + np.pi + places[:, :1] * rng.normal(size=turn.shape)
    pairs = np.concatenate(
        [along * np.cos(turn), along * np.sin(turn), upright, along * np.cos(other), along * np.sin(other), upright],
        axis=1,
    ).astype(np.float32)
    errors = np.empty(len(places))
    for alpha in np.unique(places[:, 0]):
        chosen = places[:, 0] == alpha
        model = Ggx(alpha=float(alpha), f0=0.5)
        value = to_numpy(Reflectance(model=model)(pairs[chosen], device=device).value)
        exact = model.value(pairs[chosen].astype(np.float64))
        errors[chosen] = np.abs(value / exact - 1.0)
    return errors


def _bound(places: Floats) -> Floats:
    # Each component of a direction is divided, and multiplied by one over the length, which has up to 3.5 roundings:
    # 5.5 roundings, 2.75 epsilon. Where two grazing directions nearly cancel, the half vector, twice the cosine long,
    # turns by 2 x 2.75 epsilon over twice the cosine. The value changes by up to two over alpha of this turn. Heights
    # and the Fresnel term have a relative error of 2.75 epsilon, to the powers 4 + 2 and up to 5 (1 - f0) / f0 times
    # the fifth power of 1 - cosine of the half angle: 11 in all. The model has 32 roundings.
    return np.asarray((16.0 + 11.0 * 2.75 + 5.5 / (places[:, 0] * places[:, 1])) * _EPS)
