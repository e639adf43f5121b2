"""Reflectance models: laws, limits, and agreement of devices and host."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

from canary import Guarded
from gpuvision.host import Device
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, OrenNayar, Phong, Reflectance, Reflected, Ward
from gpuvision.status import Status

MODELS = {
    "lambert": Lambert(albedo=0.8),
    "phong": Phong(albedo=0.7, exponent=30.0),
    "oren-nayar": OrenNayar(albedo=0.9, roughness=0.6),
    "ggx": Ggx(alpha=0.3, f0=0.5),
    "ward": Ward(albedo=0.6, alpha_x=0.1, alpha_y=0.4),
}
FULL = {
    "lambert": Lambert(albedo=1.0),
    "phong diffuse": Phong(albedo=1.0, exponent=0.0),
    "phong": Phong(albedo=1.0, exponent=50.0),
    **{f"oren-nayar {sigma}": OrenNayar(albedo=1.0, roughness=sigma) for sigma in (0.1, 0.3, 1.0)},
    **{f"ggx {alpha}": Ggx(alpha=alpha) for alpha in (0.1, 0.5, 1.0)},
    "ward": Ward(albedo=1.0, alpha_x=0.15, alpha_y=0.5),
    "ward rough": Ward(albedo=1.0, alpha_x=1.0, alpha_y=1.0),
}
ANGLES = (0.0, 0.5, 1.0, 1.4, 1.55, math.radians(89.9))


def above(rng: np.random.Generator, count: int) -> np.ndarray:
    pairs = rng.normal(size=(count, 2, 3))
    pairs[..., 2] = np.abs(pairs[..., 2])
    return (pairs / np.linalg.norm(pairs, axis=-1, keepdims=True)).reshape(count, 6)


gauss_legendre = functools.cache(np.polynomial.legendre.leggauss)


def directions(theta: np.ndarray, turn: np.ndarray) -> np.ndarray:
    sine = np.sin(theta)[:, None]
    parts = np.broadcast_arrays(sine * np.cos(turn), sine * np.sin(turn), np.cos(theta)[:, None])
    return np.stack(parts, axis=-1)


def albedo(model: Brdf, angle: float) -> float:
    """Return the albedo for light at an angle, by Gauss-Legendre quadrature over half of the hemisphere.

    Nodes are dense where a lobe is narrow at grazing angles: at the horizon, and in the plane of the light.
    """
    nodes, weights = gauss_legendre(250)
    theta, turn = (nodes + 1.0) * math.pi / 4.0, (nodes + 1.0) * math.pi / 2.0
    out = directions(theta, turn)
    light = np.broadcast_to([math.sin(angle), 0.0, math.cos(angle)], out.shape)
    value = model.value(np.concatenate([light, out], axis=-1)) @ weights * math.pi
    return float(np.sum(weights * math.pi / 4.0 * value * np.cos(theta) * np.sin(theta)))


def lobe(model: Brdf, angle: float, alpha: float) -> float:
    """The same for a narrow lobe of facets: over half-way directions, as GGX's own distribution has them."""
    nodes, weights = gauss_legendre(300)
    u, turn = (nodes + 1.0) / 2.0, np.arange(128) * math.tau / 128
    tilt = np.arctan(alpha * np.sqrt(u / (1.0 - u)))
    halves = directions(tilt, turn)
    light = np.broadcast_to([math.sin(angle), 0.0, math.cos(angle)], halves.shape)
    along = np.sum(light * halves, axis=-1, keepdims=True)
    out = 2.0 * along * halves - light
    value = model.value(np.concatenate([light, out], axis=-1)) * np.maximum(out[..., 2], 0.0) * 4.0 * along[..., 0]
    square = alpha**2
    density = square * np.cos(tilt) / (math.pi * (np.sin(tilt) ** 2 + square * np.cos(tilt) ** 2) ** 2)
    return float(np.sum(weights / 2.0 * (value / density[:, None]).mean(axis=1)))


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_reciprocal(model: Brdf, rng: np.random.Generator) -> None:
    pairs = above(rng, 5000)
    swapped = np.roll(pairs, 3, axis=1)
    np.testing.assert_allclose(model.value(pairs), model.value(swapped), rtol=1e-12)
    assert np.all(model.value(pairs) >= 0.0)


@pytest.mark.parametrize("model", FULL.values(), ids=FULL)
def test_no_more_than_arrives(model: Brdf) -> None:
    reflected = [albedo(model, angle) for angle in ANGLES]
    assert max(reflected) <= 1.0 + 1e-4
    assert min(reflected) > 0.0


def test_known_albedos() -> None:
    assert all(abs(albedo(Lambert(albedo=0.8), angle) - 0.8) < 1e-9 for angle in ANGLES)
    assert abs(albedo(Phong(albedo=0.7, exponent=30.0), 0.0) - 0.7) < 1e-6
    assert abs(albedo(OrenNayar(albedo=0.9, roughness=1.0), 1.0) / 0.9 - 1.0) < 0.2


def test_limits_to_lambert(rng: np.random.Generator) -> None:
    pairs, diffuse = above(rng, 1000), Lambert(albedo=0.8)
    np.testing.assert_allclose(Phong(albedo=0.8, exponent=0.0).value(pairs), diffuse.value(pairs), rtol=1e-15)
    np.testing.assert_allclose(OrenNayar(albedo=0.8, roughness=0.0).value(pairs), diffuse.value(pairs), rtol=1e-15)


@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.5, math.pi / 2.0])
def test_slopes_as_oren_and_nayar_say(sigma: float, rng: np.random.Generator) -> None:
    """The formula A + B cos(phi) sin(alpha) tan(beta), divided by A, with light and viewer on one side."""
    polar, azimuth = rng.uniform(0.0, 1.5, (2, 500)), rng.uniform(-1.5, 1.5, 500)
    light = np.stack([np.sin(polar[0]), 0.0 * azimuth, np.cos(polar[0])], axis=1)
    eye = np.stack([np.sin(polar[1]) * np.cos(azimuth), np.sin(polar[1]) * np.sin(azimuth), np.cos(polar[1])], axis=1)
    level = 1.0 - 0.5 * sigma**2 / (sigma**2 + 0.33)
    slope = 0.45 * sigma**2 / (sigma**2 + 0.09)
    expected = 1.0 + slope / level * np.cos(azimuth) * np.sin(polar.max(axis=0)) * np.tan(polar.min(axis=0))
    model = OrenNayar.from_slope_sigma(albedo=0.7, sigma=sigma)
    normal = model.value([0.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(model.value(np.hstack([light, eye])) / normal, expected, rtol=1e-12)
    assert albedo(model, 0.5) <= 0.7 * (1.0 + 1e-9)


def test_slopes_out_of_range() -> None:
    for sigma in (-0.1, 2.0):
        with pytest.raises(ValueError, match="expected radians"):
            OrenNayar.from_slope_sigma(albedo=0.5, sigma=sigma)


@pytest.mark.parametrize("angle", [0.0, 0.5, 1.0, 1.3])
def test_limits_to_the_mirror(angle: float) -> None:
    """In the limit all light is reflected in the mirror direction, and no light at a small angle from it."""
    for model in (Ggx(alpha=1e-3), Ward(albedo=1.0, alpha_x=1e-3, alpha_y=1e-3)):
        assert abs(lobe(model, angle, 1e-3) - 1.0) < 2e-3
        light = [math.sin(angle), 0.0, math.cos(angle)]
        mirror, oblique = ([-math.sin(angle + tilt), 0.0, math.cos(angle + tilt)] for tilt in (0.0, 0.05))
        assert model.value([*light, *oblique]) < 1e-4 * model.value([*light, *mirror])
    half = Ggx(alpha=1e-3, f0=0.04)
    schlick = 0.04 + 0.96 * (1.0 - math.cos(angle)) ** 5
    assert abs(lobe(half, angle, 1e-3) / schlick - 1.0) < 1e-2


TWO_WAYS = pytest.mark.parametrize("variant", ["vector", "work_item"])


@TWO_WAYS
@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_devices_as_the_host(device: Device, name: str, dtype: Any, variant: Any, rng: np.random.Generator) -> None:
    pairs = above(rng, 5003).astype(dtype)
    pairs[:100, 2] *= -1.0
    pairs[100:200, 2] *= 1e-6
    model = MODELS[name]
    guarded = Guarded(Reflected(np.empty(5003, dtype), np.empty(5003, np.uint8)))
    result = Reflectance(model=model, variant=variant)(pairs, device=device, out=guarded.out)
    guarded.assert_intact()
    expected = model.value(pairs)
    # In the tail of a lobe the large exponent of a power or exponential magnifies roundings: relative accuracy of 1e-6.
    assert np.all(np.abs(result.value - expected) <= 200 * np.finfo(dtype).eps * (expected + 1e-6))
    assert np.all(result.status == 0)
    assert np.all(result.value[:100] == 0.0)


@pytest.mark.double
@TWO_WAYS
@pytest.mark.parametrize("name", MODELS)
def test_not_finite(device: Device, name: str, variant: Any) -> None:
    good = [0.1, 0.2, 0.9, -0.1, 0.3, 0.8]
    pairs = np.array(5 * [good, [0.0, 0.0, 0.0, *good[3:]], [math.nan, *good[1:]], [*good[:5], math.inf]])
    result = Reflectance(model=MODELS[name], variant=variant)(pairs, device=device)
    np.testing.assert_array_equal(result.status, 5 * ([0] + 3 * [Status.NOT_FINITE]))
    np.testing.assert_array_equal(np.isnan(result.value), np.isnan(MODELS[name].value(pairs)))


@pytest.mark.double
@TWO_WAYS
@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 31, 63, 64, 65, 4097])
def test_sizes_and_canaries(device: Device, count: int, variant: Any, rng: np.random.Generator) -> None:
    pairs = above(rng, count)
    guarded = Guarded(Reflected(np.empty(count), np.empty(count, np.uint8)))
    Reflectance(model=MODELS["ggx"], variant=variant)(pairs, device=device, out=guarded.out)
    guarded.assert_intact()
    np.testing.assert_allclose(guarded.out.value, MODELS["ggx"].value(pairs), rtol=1e-12)


def test_wrong_inputs(device: Device) -> None:
    with pytest.raises(TypeError, match="expected a Brdf"):
        Reflectance(model=0.5)
    with pytest.raises(TypeError, match="float32 or float64 directions, got int64"):
        Reflectance(model=MODELS["ggx"])(np.zeros((3, 6), np.int64), device=device)
    with pytest.raises(ValueError, match=r"directions \(\.\.\., 6\), got shape \(3, 5\)"):
        Reflectance(model=MODELS["ggx"])(np.zeros((3, 5)), device=device)
    with pytest.raises(ValueError, match=r"Lambert.albedo is 1.5, expected 0 to 1"):
        Lambert(albedo=1.5)
    with pytest.raises(ValueError, match=r"Ggx.alpha is 0, expected 0.0001 to 1"):
        Ggx(alpha=0.0)
