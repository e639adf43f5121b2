"""Contract of reflectance models: pairs of directions above, at and below the horizon, in and off lobes, and holes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, OrenNayar, Phong, Reflectance, Ward
from gpuvision.status import Status

LIMITS = {
    "Reflectance": (
        equal("status", reason="comparisons only"),
        roundings(
            32, "value", of="value x condition of the lobe [1/sr], at least its factor x the smallest normal number",
            reason="about 8 epsilon of each direction; exp 3 ulp, pow 16 ulp (OpenCL), quotients and sums of the model",
        ),
    )
}  # fmt: skip
_COUNT = 1003
_MODELS = {
    "lambert": Lambert(albedo=0.8),
    "phong": Phong(albedo=0.7, exponent=30.0),
    "oren-nayar": OrenNayar(albedo=0.9, roughness=0.6),
    "ggx": Ggx(alpha=0.3, f0=0.5),
    "ggx, smooth": Ggx(alpha=1e-2, f0=0.9),
    "ward": Ward(albedo=0.6, alpha_x=0.1, alpha_y=0.4),
}


def cases() -> Iterator[Case]:
    """Yield all models in single precision, and one in double precision."""
    rng = np.random.default_rng(29)
    pairs = rng.normal(size=(_COUNT, 2, 3))
    pairs[::2, :, 2] = np.abs(pairs[::2, :, 2])
    pairs[1::6, 1] = pairs[1::6, 0] * (-1.0, -1.0, 1.0) + 1e-2 * rng.normal(size=pairs[1::6, 0].shape)  # in the lobe
    pairs[::9] *= 10.0 ** rng.uniform(-6.0, 6.0, pairs[::9, :, :1].shape)
    pairs[3::50, 0], pairs[4::50, 1, 1], pairs[5::50, 0, 2] = 0.0, np.nan, np.inf
    given = pairs.reshape(_COUNT, 6)
    for name, model in _MODELS.items():
        yield _case(f"{name}, float32", model, given.astype(np.float32))
    yield _case("ggx, float64", _MODELS["ggx"], given)


def _case(name: str, model: Brdf, given: npt.NDArray[Any]) -> Case:
    value = model.value(given)
    status = np.where(np.isnan(value), int(Status.NOT_FINITE), 0)
    real, limit = np.finfo(given.dtype), LIMITS["Reflectance"][1].factor(given.dtype)
    with np.errstate(invalid="ignore"):
        quantity = value * _condition(model, given.astype(np.float64).reshape(-1, 2, 3))
    # Devices may flush denormal numbers to 0, also before the lobe is multiplied by its factor.
    least = float(real.tiny) * _factor(model, given.astype(np.float64).reshape(-1, 2, 3)) / limit
    quantities = {"value": np.fmax(quantity, least)}
    exact = {"value": value, "status": status}
    return Case("Reflectance", name, Reflectance(model=model), (given,), exact, quantities)


def _factor(model: Brdf, pairs: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the number that multiplies the exponential or the power of the lobe, 1 or more."""
    factor = np.ones(len(pairs))
    if isinstance(model, Phong):
        factor *= model.exponent + 2.0
    if isinstance(model, Ward):
        with np.errstate(all="ignore"):
            half = (pairs / np.linalg.norm(pairs, axis=-1, keepdims=True)).sum(axis=1)
            factor = np.sum(half**2, axis=-1) / half[:, 2] ** 4 / (np.pi * model.alpha_x * model.alpha_y)
    return np.fmax(factor, 1.0)


def _condition(model: Brdf, pairs: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the relative change of the value over the change of a component of the directions."""
    with np.errstate(all="ignore"):
        light, eye = np.moveaxis(pairs / np.linalg.norm(pairs, axis=-1, keepdims=True), -2, 0)
        half = light + eye
        if isinstance(model, Phong):
            cosine = light[:, 2] * eye[:, 2] - light[:, 0] * eye[:, 0] - light[:, 1] * eye[:, 1]
            return np.asarray(1.0 + model.exponent / np.maximum(cosine, 0.0))
        if isinstance(model, OrenNayar):
            return np.asarray(1.0 + 1.0 / np.maximum(light[:, 2], eye[:, 2]))
        if isinstance(model, Ggx):
            return _condition_of_ggx(model, half)
        if isinstance(model, Ward):
            x, y = half[:, 0] / (model.alpha_x * half[:, 2]), half[:, 1] / (model.alpha_y * half[:, 2])
            away = np.hypot(x, y)
            return np.asarray(1.0 + away**2 + (away / min(model.alpha_x, model.alpha_y) + 1.0) / half[:, 2])
    return np.ones(len(pairs))


def _condition_of_ggx(model: Ggx, half: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the condition of the microfacet model from half vectors h, the sums of the two unit directions.

    The logarithm of the normals' distribution is 2 ln(z^2 + s^2) - 2 ln(s^2 + alpha^2 z^2), with the height z of h and
    its length s along the surface. Its derivatives are -g / s by s and g / z by z, with
    g = 4 (1 - alpha^2) s^2 z^2 / ((s^2 + alpha^2 z^2) (s^2 + z^2)). An error e of each direction changes s by 2 e; of
    grazing, mirrored directions s and z are both small, and the value changes by up to 4 e / (alpha z). Heights have a
    relative error e: z and both heights in the shadowing change the value by (g + 2) e. The Fresnel term
    f0 + (1 - f0) a^5, with a = 1 - |h| / 2, changes by 5 (1 - f0) a^4 e. With e = 8 epsilon the sum is 32 epsilon times
    a quarter of the derivatives; 32 epsilon more are the roundings of the model.
    """
    s, z = np.hypot(half[:, 0], half[:, 1]), half[:, 2]
    length = np.hypot(s, z)
    share = 4.0 * (1.0 - model.alpha**2) * z**2 / ((s**2 + (model.alpha * z) ** 2) * length**2)  # g / s^2
    away = np.maximum(1.0 - 0.5 * length, 0.0)
    fresnel = 5.0 * (1.0 - model.f0) * away**4 / (model.f0 + (1.0 - model.f0) * away**5)
    return np.asarray(1.0 + 0.25 * (2.0 * share * s + share * s**2 + 2.0 + fresnel))
