"""Merge of two height maps, compared with a Numba loop, NumPy and OpenCV: four million cells, with and without sigma.

Numba does the same as `MergeHeights` in one pass. NumPy does it with whole arrays. OpenCV does only a part of the work:
the mean of both maps where they differ by less than the tolerance, without flags, weights and single heights.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.profiling.harness import Case
from gpuvision.ranging.merge_heights import MergeHeights

Array = NDArray[Any]

_CELLS = 2000 * 2000
_TOLERANCE = 2e-5


@numba.njit(parallel=True, error_model="numpy")
def _numba(one, two, sigmas, limits, z, light, status, sigma, source):
    """Merge cell by cell; ``sigmas`` of length 0: equal weights. Heights that disagree are dropped."""
    weighted = sigmas.shape[0] > 0
    (z1, light1, status1), (z2, light2, status2) = one, two
    for i in numba.prange(z1.shape[0]):
        s1, s2 = (sigmas[0, i], sigmas[1, i]) if weighted else (np.float32(1), np.float32(1))
        flag1, flag2 = status1[i], status2[i]
        lost1, lost2 = not np.isfinite(z1[i] + s1) or s1 <= 0, not np.isfinite(z2[i] + s2) or s2 <= 0
        flag1 = np.uint8(8) if lost1 and flag1 == 0 else flag1
        flag2 = np.uint8(8) if lost2 and flag2 == 0 else flag2
        has1, has2 = not lost1 and not flag1 & 0x6D, not lost2 and not flag2 & 0x6D
        total = s1 * s1 + s2 * s2
        limit = (limits[0] * np.sqrt(total) if weighted else np.float32(0)) + limits[1]
        apart = has1 and has2 and abs(z1[i] - z2[i]) > limit
        take1 = has1 and (not has2 or (apart and flag2 != 0 and flag1 == 0))
        take2 = has2 and (not has1 or (apart and flag1 != 0 and flag2 == 0))
        mean = has1 and has2 and not apart
        weight = s1 * s1 / total
        z[i] = z1[i] if take1 else z2[i] if take2 else z1[i] - weight * (z1[i] - z2[i]) if mean else np.float32(np.nan)
        light[i] = (
            light1[i]
            if take1
            else light2[i]
            if take2
            else light1[i] + weight * (light2[i] - light1[i])
            if mean
            else np.float32(np.nan)
        )
        if weighted:
            sigma[i] = s1 if take1 else s2 if take2 else s1 * s2 / np.sqrt(total) if mean else np.float32(np.nan)
        flag = flag1 if take1 else flag2 if take2 else flag1 | flag2
        status[i] = flag | np.uint8(16) if apart and not (take1 or take2) else flag
        source[i] = (1 if take1 else 2 if take2 else 3 if mean else 0) + (4 if apart else 0)


def _numpy(one: list[Array], two: list[Array], sigmas: list[Array], limits: Array) -> tuple[Any, ...]:
    """Merge whole arrays; heights that disagree are dropped."""
    (z1, light1, flag1), (z2, light2, flag2) = one, two
    s1, s2 = sigmas or [np.ones_like(z1)] * 2
    lost = [~np.isfinite(z + s) | ~(s > 0) for z, s in ((z1, s1), (z2, s2))]
    flag1, flag2 = (
        np.where(gone & (flag == 0), np.uint8(8), flag) for gone, flag in zip(lost, (flag1, flag2), strict=True)
    )
    has1, has2 = (~gone & ((flag & 0x6D) == 0) for gone, flag in zip(lost, (flag1, flag2), strict=True))
    with np.errstate(all="ignore"):
        total = s1 * s1 + s2 * s2
        limit = (limits[0] * np.sqrt(total) if sigmas else 0) + limits[1]
        apart = has1 & has2 & (np.abs(z1 - z2) > limit)
        weight = s1 * s1 / total
        take1 = has1 & (~has2 | (apart & (flag2 != 0) & (flag1 == 0)))
        take2 = has2 & (~has1 | (apart & (flag1 != 0) & (flag2 == 0)))
        mean = has1 & has2 & ~apart
        cases = [take1, take2, mean]
        z = np.select(cases, [z1, z2, z1 - weight * (z1 - z2)], np.nan)
        light = np.select(cases, [light1, light2, light1 + weight * (light2 - light1)], np.nan)
        sigma = np.select(cases, [s1, s2, s1 * s2 / np.sqrt(total)], np.nan) if sigmas else None
    status = np.select([take1, take2], [flag1, flag2], flag1 | flag2)
    status = np.where(apart & ~take1 & ~take2, status | 16, status).astype(np.uint8)
    source = np.select(cases, [1, 2, 3], 0) + 4 * apart
    return z, light, status, sigma, source.astype(np.uint8)


def _opencv(z1: Array, z2: Array) -> Array:
    """Return the mean where the maps are closer than the tolerance, NaN elsewhere."""
    mean = cv2.addWeighted(z1, 0.5, z2, 0.5, 0.0)
    mean[cv2.threshold(cv2.absdiff(z1, z2), _TOLERANCE, 1.0, cv2.THRESH_BINARY)[1] != 0] = np.nan
    return mean


# Operations of a cell with heights in both maps, in merge_at of kernels/merge_heights/merge_heights.cl: difference 1,
# height 2, intensity 3; with sigmas also the parts 2, their sum of squares 3, the weight 2, the limit 3 and a root, and
# the merged sigma 2.
_FLOPS, _SIGMA_FLOPS = 6, 19


def cases(device: Device) -> Iterator[Case]:
    """Yield the merge of four million cells in single precision, with and without standard deviations."""
    yield _case(device, sigma=True)
    yield _case(device, sigma=False)


def _case(device: Device, *, sigma: bool) -> Case:
    rng = np.random.default_rng(1)
    surface = rng.uniform(-5e-3, 5e-3, _CELLS)
    maps: list[list[Array]] = []
    sigmas: list[Array] = []
    for _ in range(2):
        spread = rng.uniform(2e-6, 1e-5, _CELLS)
        z = surface + spread * rng.normal(size=_CELLS)
        hidden = rng.random(_CELLS) < 0.1
        z[rng.random(_CELLS) < 0.02] += 1e-3
        z[hidden] = np.nan
        maps.append([z.astype(np.float32), np.ones(_CELLS, np.float32), np.where(hidden, 64, 0).astype(np.uint8)])
        sigmas.append(spread.astype(np.float32))
    sigmas = sigmas if sigma else []
    operation = MergeHeights(sigma=sigma, tolerance=0.0 if sigma else _TOLERANCE)
    bound = operation.bind(device, (_CELLS,), np.float32)
    for array, values in zip(bound.inputs, [*maps[0], *maps[1], *sigmas], strict=True):
        array.set(values)
    limits = np.array([operation.max_sigmas, operation.tolerance], np.float32)
    made = [np.empty(_CELLS, kind) for kind in (np.float32, np.float32, np.uint8, np.float32, np.uint8)]
    stacked = np.array(sigmas, np.float32).reshape(-1, _CELLS)
    first, second = tuple(maps[0]), tuple(maps[1])
    peers: dict[str, Callable[[], object]] = {
        "numba": lambda: _numba(first, second, stacked, limits, *made),
        "numpy": lambda: _numpy(maps[0], maps[1], sigmas, limits),
    }
    if not sigma:
        peers["opencv"] = lambda: _opencv(maps[0][0].reshape(-1, 2000), maps[1][0].reshape(-1, 2000))
    bound().wait()
    wide = [[z.astype(np.float64), light.astype(np.float64), flags] for z, light, flags in maps]
    exact = _numpy(wide[0], wide[1], [each.astype(np.float64) for each in sigmas], limits.astype(np.float64))
    outputs: Any = bound.outputs
    same = outputs.source.get() == exact[4]
    # Rounding decides the few cells whose difference is at the limit.
    if np.mean(~same) > 1e-5:
        raise AssertionError("the merge and float64 differ in the sources of the heights")
    error = float(np.nanmax(np.abs(outputs.z.get()[same] - exact[0][same])))
    moved = (2 * (9 + 4 * sigma) * _CELLS, (10 + 4 * sigma) * _CELLS)
    name, flops = ("float32-sigma/4e6", _SIGMA_FLOPS) if sigma else ("float32/4e6", _FLOPS)
    return Case("merge heights", name, bound.run, peers, error, moved, flops=flops * _CELLS)
