"""Benchmark of `Reflectance`, compared with Numba: all cores, single precision, blocks by columns, without branches.

The models are a smooth metal (GGX) and a brushed metal (Ward, with its exponential). Errors are relative to the largest
reflectance, compared with `Brdf.value` in double precision. The error of the Numba code is in ``peer_error``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Reflectance, Ward

_BLOCK = 1024
F = np.float32
ZERO, HALF, ONE, TINY, PI = F(0.0), F(0.5), F(1.0), F(1e-30), F(math.pi)


@numba.njit(inline="always")
def _ggx(ix, iy, iz, ox, oy, oz, a):
    square, rest = a[0] * a[0], ONE - a[0] * a[0]
    x, y, z = ix + ox, iy + oy, iz + oz
    length = x * x + y * y + z * z
    spread = (x * x + y * y + square * z * z) / length
    masked = oz * np.sqrt(square + rest * iz * iz) + iz * np.sqrt(square + rest * oz * oz)
    away = max(ONE - HALF * np.sqrt(length), ZERO)
    away2 = away * away
    fresnel = a[1] + (ONE - a[1]) * away2 * away2 * away
    return fresnel * square * HALF / (PI * spread * spread * masked)


@numba.njit(inline="always")
def _ward(ix, iy, iz, ox, oy, oz, a):
    x, y, z = ix + ox, iy + oy, iz + oz
    upright = z * z
    lobe = np.exp(-(x * x / (a[1] * a[1]) + y * y / (a[2] * a[2])) / upright)
    return a[0] / (PI * a[1] * a[2]) * lobe * (x * x + y * y + upright) / (upright * upright)


def _numba(model: Any) -> Callable[..., None]:
    @numba.njit(parallel=True, error_model="numpy")
    def run(directions, a, value, status):
        count = directions.shape[0]
        for block in numba.prange((count + _BLOCK - 1) // _BLOCK):
            begin = block * _BLOCK
            n = min(_BLOCK, count - begin)
            local = np.empty((6, _BLOCK), np.float32)
            for i in range(n):
                for k in range(6):
                    local[k, i] = directions[begin + i, k]
            ix, iy, iz, ox, oy, oz = local[0], local[1], local[2], local[3], local[4], local[5]
            for i in range(n):
                one = ONE / np.sqrt(ix[i] * ix[i] + iy[i] * iy[i] + iz[i] * iz[i])
                two = ONE / np.sqrt(ox[i] * ox[i] + oy[i] * oy[i] + oz[i] * oz[i])
                up, out = iz[i] * one, oz[i] * two
                f = model(ix[i] * one, iy[i] * one, max(up, TINY), ox[i] * two, oy[i] * two, max(out, TINY), a)
                f = f if (up > ZERO) & (out > ZERO) else ZERO
                lost = not np.isfinite(one + two + up + out)
                value[begin + i] = F(np.nan) if lost else f
                status[begin + i] = np.uint8(8) if lost else np.uint8(0)

    compiled: Callable[..., None] = run
    return compiled


# Operations of a pair in kernels/reflectance: both directions to unit length 26. Ggx: half vector 3, its squares 8,
# spread 4, masking 11, Fresnel's factor 8, product 6. Ward: half vector 3, its squares 6, slopes 4, exponential 4,
# product 4; the factor of the parameters is one for all pairs.
_UNIT, _GGX, _WARD = 26, 40, 21


def cases(device: Device) -> Iterator[Case]:
    """Yield a smooth and a brushed metal, with a million pairs of directions each."""
    yield _case(device, "ggx/1e6", Ggx(alpha=0.2, f0=0.9), _numba(_ggx), _UNIT + _GGX)
    yield _case(device, "ward/1e6", Ward(albedo=0.8, alpha_x=0.15, alpha_y=0.4), _numba(_ward), _UNIT + _WARD)


def _case(device: Device, name: str, model: Brdf, peer: Callable[..., None], flops: int) -> Case:
    rng = np.random.default_rng(6)
    directions = rng.normal(size=(1_000_000, 6)).astype(np.float32)
    directions[:, [2, 5]] = np.abs(directions[:, [2, 5]])
    bound = Reflectance(model=model).bind(device, directions.shape, directions.dtype)
    bound.inputs[0].set(directions)
    ours = to_numpy(bound.run().value)
    parameters = np.array(model.parameters, np.float32)
    value, status = np.empty(len(directions), np.float32), np.empty(len(directions), np.uint8)
    peer(directions, parameters, value, status)
    truth = model.value(directions)
    metadata = {"peer_error": _error(value, truth)}
    peers = {"numba": lambda: peer(directions, parameters, value, status)}
    traffic = (directions.nbytes, value.nbytes + status.nbytes)
    error, total = _error(ours, truth), flops * len(directions)
    return Case("reflectance", name, bound.run, peers, error, traffic, metadata=metadata, flops=total)


def _error(values: NDArray[Any], truth: NDArray[np.float64]) -> float:
    return float(np.max(np.abs(values - truth)) / np.max(truth))
