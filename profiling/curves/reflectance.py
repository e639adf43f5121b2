"""Reflectance models: precision, for directions all over the hemisphere; relative errors."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.curves.curve import Errors, Setting
from gpuvision.profiling.harness import bind_with
from gpuvision.simulation.scene.reflectance import Ggx, OrenNayar, Phong, Reflectance, Ward

_COUNT = 100_000
_MODELS = {
    "matt (Oren-Nayar)": OrenNayar(albedo=0.9, roughness=0.6),
    "plastic (Phong)": Phong(albedo=0.7, exponent=30.0),
    "rough metal (GGX)": Ggx(alpha=0.3, f0=0.9),
    "polished metal (GGX)": Ggx(alpha=1e-2, f0=0.9),
    "brushed metal (Ward)": Ward(albedo=0.8, alpha_x=0.15, alpha_y=0.4),
}


def settings(device: Device) -> Iterator[Setting]:
    """Yield both precisions of each model; directions in which it reflects nothing are left out."""
    pairs = np.random.default_rng(10).normal(size=(_COUNT, 6))
    pairs[:, [2, 5]] = np.abs(pairs[:, [2, 5]])
    for data, model in _MODELS.items():
        truth = model.value(pairs)
        seen = truth > 1e-30  # the least value of single precision is 1e-38
        for dtype in ("float32", "float64") if device.has_double else ("float32",):
            bound = bind_with(Reflectance(model=model), device, pairs.astype(dtype))
            deviation = to_numpy(bound.outputs.value)[seen] / truth[seen] - 1.0
            parameters = {"precision": "single" if dtype == "float32" else "double"}
            yield Setting("reflectance", data, parameters, bound.run, Errors(deviation), "")
