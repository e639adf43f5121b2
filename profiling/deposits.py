"""Deposits of solder paste, compared with a Numba loop and NumPy: 1000 apertures on 4 Mpx, 10 000 on 25 Mpx.

Each aperture has 40 x 40 cells, of which about 1250 belong to it; float32 heights with 2 % holes and a standard
deviation of each cell. Numba does the same as `MeasureDeposits`, aperture by aperture on all cores. NumPy takes the
window of one aperture after the other; it is measured on the small map only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.inspection.deposits import MeasureDeposits
from gpuvision.profiling.harness import Case
from gpuvision.reference.deposits import Plane, measure_deposit

Array = NDArray[Any]

_CELL, _THRESHOLD, _CORRELATED, _LEAST_VALID, _SIGNIFICANT = 10e-6, 60e-6, 1.5, 0.8, 3.0
_WINDOW = 40  # cells along each side of a window


@numba.njit(inline="always")
def _variance(gradient, covariance):
    total = np.float32(0)
    for i in range(6):
        for j in range(6):
            total += gradient[i] * covariance[6 * i + j] * gradient[j]
    return total


@numba.njit(inline="always")
def _crossing(height, noise, threshold):
    """Return the ratio, the chance that a cell counts, and the density at the threshold."""
    ratio = min(max((threshold - height) / noise, np.float32(-12)), np.float32(12))
    if abs(ratio) >= np.float32(12):
        return ratio, np.float32(ratio < 0), np.float32(0)
    chance = np.float32(0.5) * np.float32(math.erfc(ratio * np.float32(0.70710678)))
    return ratio, chance, np.exp(np.float32(-0.5) * ratio * ratio) * np.float32(0.39894228)


@numba.njit(parallel=True, error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})
def _numba(z, sigma, owner, boxes, surfaces, settings, made):
    """Measure aperture by aperture: counts of cells, sums, moments about the mean height."""
    cell_area, threshold, correlated, least_valid, significant = settings
    for item in numba.prange(boxes.shape[0]):
        first, last, left, right = boxes[item]
        k, covariance = surfaces[item, :13], surfaces[item, 13:]
        number = item + 1
        in_core, in_margin, core_valid, margin_valid = 0, 0, 0, 0
        for row in range(first, last):
            for column in range(left, right):
                own, good = owner[row, column], np.isfinite(z[row, column])
                in_core += own == number
                in_margin += own == -number
                core_valid += good and own == number
                margin_valid += good and own == -number
        made[item, :] = np.nan
        made[item, 10] = (core_valid + margin_valid) / max(in_core + in_margin, 1)
        if core_valid < least_valid * in_core or margin_valid < least_valid * in_margin:
            continue
        core_weight = np.float32(in_core / max(core_valid, 1))
        margin_weight = np.float32(in_margin / max(margin_valid, 1))
        s, t = np.zeros(12, np.float32), np.zeros((5, 6), np.float32)
        b = np.empty(6, np.float32)
        for row in range(first, last):
            v = k[8] + k[9] * np.float32(row - first)
            for column in range(left, right):
                own = owner[row, column]
                if abs(own) != number or not np.isfinite(z[row, column]):
                    continue
                u = k[6] + k[7] * np.float32(column - left)
                b[0], b[1], b[2], b[3], b[4], b[5] = np.float32(1), u, v, u * u, u * v, v * v
                level = k[0] + k[1] * u + k[2] * v + k[3] * b[3] + k[4] * b[4] + k[5] * b[5]
                h, noise = z[row, column] - level, sigma[row, column]
                w = core_weight if own > 0 else margin_weight
                x, y, ws = u - k[10], v - k[11], w * noise
                q = ws * ws
                s[0] += w * h
                s[1] += w * h * x
                s[2] += w * h * y
                s[3] += q
                s[4] += q * x
                s[5] += q * y
                s[6] += q * x * x
                s[7] += q * x * y
                s[8] += q * y * y
                _, chance, density = _crossing(h, noise, threshold)
                counted = w if h > threshold else np.float32(0)
                s[9] += counted
                s[10] += counted * h
                s[11] += w * w * chance * (np.float32(1) - chance)
                for i in range(6):
                    t[0, i] += w * b[i]
                    t[1, i] += w * x * b[i]
                    t[2, i] += w * y * b[i]
                    t[3, i] += counted * b[i]
                    t[4, i] += w * density / noise * b[i]
        total, count, mean = s[0], s[9], s[10] / s[9]
        moments = np.float32(0)
        for row in range(first, last):
            v = k[8] + k[9] * np.float32(row - first)
            for column in range(left, right):
                own = owner[row, column]
                if abs(own) != number or not np.isfinite(z[row, column]) or count == 0:
                    continue
                u = k[6] + k[7] * np.float32(column - left)
                level = k[0] + k[1] * u + k[2] * v + k[3] * u * u + k[4] * u * v + k[5] * v * v
                h, noise = z[row, column] - level, sigma[row, column]
                w = core_weight if own > 0 else margin_weight
                ratio, chance, density = _crossing(h, noise, threshold)
                centred, missing = h - mean, np.float32(1) - chance
                narrowed = chance + ratio * density - density * density
                spread = centred * missing * (centred * chance + np.float32(2) * noise * density)
                moments += w * w * max(spread + noise * noise * narrowed, np.float32(0))
        volume_variance = correlated * (s[3] + _variance(t[0], covariance))
        made[item, 0] = cell_area * count
        made[item, 1] = cell_area * np.sqrt(correlated * (s[11] + _variance(t[4], covariance)))
        made[item, 2] = cell_area * total
        made[item, 3] = cell_area * np.sqrt(volume_variance)
        if count > 0:
            gradient = -t[3] - (threshold - mean) * t[4]
            made[item, 4] = mean
            made[item, 5] = np.sqrt(correlated * (moments + _variance(gradient, covariance))) / count
        if total > significant * np.sqrt(volume_variance):
            cx, cy, unit = s[1] / total, s[2] / total, k[12] / total
            xx = s[6] - cx * (np.float32(2) * s[4] - cx * s[3])
            yy = s[8] - cy * (np.float32(2) * s[5] - cy * s[3])
            along, across = (t[1] - cx * t[0]) * unit, (t[2] - cy * t[0]) * unit
            made[item, 6], made[item, 7] = cx * k[12], cy * k[12]
            made[item, 8] = np.sqrt(correlated * (xx * unit * unit + _variance(along, covariance)))
            made[item, 9] = np.sqrt(correlated * (yy * unit * unit + _variance(across, covariance)))


def _numpy(z: Array, sigma: Array, owner: Array, boxes: Array, planes: list[Plane], centroids: Array) -> Array:
    """Measure the window of one aperture after the other, in the precision of the heights."""
    found = np.empty((len(boxes), 11))
    for number, (box, plane, centroid) in enumerate(zip(boxes, planes, centroids, strict=True), 1):
        part = slice(box[0], box[1]), slice(box[2], box[3])
        x = np.broadcast_to(np.arange(box[2], box[3]) * _CELL, z[part].shape).ravel()
        y = np.broadcast_to(np.arange(box[0], box[1])[:, None] * -_CELL, z[part].shape).ravel()
        own = owner[part].ravel()
        each = measure_deposit(
            z[part].ravel(),
            sigma[part].ravel(),
            x,
            y,
            own == number,
            own == -number,
            plane,
            centroid,
            cell_area=_CELL**2,
            threshold=_THRESHOLD,
            correlation_area=_CORRELATED,
            least_valid=_LEAST_VALID,
            significance=_SIGNIFICANT,
        )
        found[number - 1] = [*each[:6], *each.offset, *each.offset_sigma, each.valid]
    return found


# Operations in kernels/deposits. Of a cell: height above the surface 13, in two passes; sums 5 and 12 of the noise,
# terms of the surface 44, parts and weights 16; moments 20. Of a cell within 12 sigmas of the threshold: probability
# and density 7, in two passes, terms 13. Of an aperture: products of five gradients with the covariance 540, and 60.
_CELL_FLOPS, _NEAR_FLOPS, _APERTURE_FLOPS = 123, 27, 600


def measure_flops(z: Array, sigma: Array, owner: Array, surface: float, apertures: int) -> int:
    """Return the operations of a measurement over a level reference surface [m]."""
    valid = (owner != 0) & np.isfinite(z)
    near = np.abs((_THRESHOLD - (z[valid] - surface)) / sigma[valid]) < 12.0
    return int(_CELL_FLOPS * valid.sum() + _NEAR_FLOPS * near.sum()) + _APERTURE_FLOPS * apertures


def cases(device: Device) -> Iterator[Case]:
    """Yield 1000 apertures on 4 Mpx, and 10 000 on 25 Mpx."""
    yield _case(device, 2000, 1000, with_numpy=True)
    yield _case(device, 5000, 10_000, with_numpy=False)


def _case(device: Device, side: int, count: int, *, with_numpy: bool) -> Case:
    rng = np.random.default_rng(1)
    z = rng.normal(1e-3, 3e-6, (side, side)).astype(np.float32)
    sigma = rng.uniform(2e-6, 4e-6, z.shape).astype(np.float32)
    owner = np.zeros(z.shape, np.int32)
    places = rng.permutation((side // _WINDOW) ** 2)[:count]
    tops, lefts = (each * _WINDOW for each in divmod(places, side // _WINDOW))
    boxes = np.stack([tops, tops + _WINDOW, lefts, lefts + _WINDOW], axis=1).astype(np.int32)
    away = np.hypot(*(np.indices((_WINDOW, _WINDOW)) - (_WINDOW - 1) / 2))
    paste = np.clip(130e-6 * (1.2 - (away / 16) ** 2), 0.0, 130e-6).astype(np.float32)
    for number, (top, bottom, left, right) in enumerate(boxes, 1):
        z[top:bottom, left:right] += paste
        owner[top:bottom, left:right] = np.where(away < 16, number, np.where(away < 20, -number, 0))
    z[rng.random(z.shape) < 0.02] = np.nan
    covariance = np.diag([1e-14, 2e-14, 2e-14, 0.0, 0.0, 0.0])
    length = _WINDOW * _CELL
    centroids = np.stack([lefts, -tops], axis=1) * _CELL + (_WINDOW - 1) / 2 * _CELL * np.array([1.0, -1.0])
    terms = np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
    planes = [Plane(terms, covariance, each, length) for each in centroids]
    start, step = (_WINDOW - 1) / 2 / _WINDOW, 1.0 / _WINDOW
    row = [*terms, -start, step, start, -step, 0.0, 0.0, length, *covariance.ravel()]
    surfaces = np.tile(np.array(row, np.float32), (count, 1))
    operation = MeasureDeposits(
        apertures=count,
        cell_area=_CELL**2,
        threshold=_THRESHOLD,
        correlation_area=_CORRELATED,
        least_valid=_LEAST_VALID,
        significance=_SIGNIFICANT,
    )
    bound = operation.bind(device, z.shape, np.float32)
    for array, values in zip(bound.inputs, (z, sigma, owner, boxes, surfaces), strict=True):
        array.set(values)
    settings = tuple(map(np.float32, (_CELL**2, _THRESHOLD, _CORRELATED, _LEAST_VALID, _SIGNIFICANT)))
    made = np.empty((count, 11), np.float32)
    peers: dict[str, Callable[[], object]] = {"numba": lambda: _numba(z, sigma, owner, boxes, surfaces, settings, made)}
    if with_numpy:
        peers["numpy"] = lambda: _numpy(z, sigma, owner, boxes, planes, centroids)
    bound().wait()
    checked = slice(0, 100)
    wide = [each.astype(np.float64) for each in (z, sigma)]
    exact = _numpy(wide[0], wide[1], owner, boxes[checked], planes[checked], centroids[checked])
    peers["numba"]()
    sums: Any = bound.outputs
    own = np.column_stack([getattr(sums, name).get() for name in sums._fields[:-1]])
    error = float(np.max(np.abs(own[checked, 2] / exact[:, 2] - 1.0)))
    for other in (own[checked], made[checked]):
        if not np.allclose(other, exact, rtol=1e-3, atol=1e-9, equal_nan=True):
            raise AssertionError("deposits and float64 differ")
    moved = (12 * _WINDOW**2 * count, 45 * count)
    name, flops = f"float32/{side**2 / 1e6:.0f}e6-{count}", measure_flops(z, sigma, owner, float(terms[0]), count)
    return Case("deposits", name, bound.run, peers, error, moved, flops=flops)
