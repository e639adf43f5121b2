"""PSD readout, compared with a Numba loop and NumPy: position and status."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.profiling.harness import Case
from gpuvision.ranging.psd import PsdReadout

LENGTH, MINIMUM, SATURATION = 6e-3, 100.0, 60_000.0
_IN_A_ROW = 8
_FLOPS = 4  # of a sample: sum, difference, product with half of the length, quotient; without the comparisons


@numba.njit(error_model="numpy")
def _read_out(a, b, half, minimum, saturation):
    """Read out one sample; without a branch, so that LLVM vectorises the loops below."""
    total = a + b
    difference = b - a
    dark = total <= minimum
    high = (a >= saturation) | (b >= saturation)
    lost = ~((np.abs(a) < np.inf) & (np.abs(b) < np.inf))
    outside = (np.abs(difference) > total) & ~dark
    good = ~(dark | high | lost | outside)
    flags = np.uint8(dark) | (np.uint8(high) << np.uint8(1)) | (np.uint8(outside) << np.uint8(2))
    return half * difference / total if good else np.float32(np.nan), np.uint8(8) if lost else flags


@numba.njit(error_model="numpy")
def _read_out_codes(a, b, half, minimum, saturation):
    """Read out one sample of codes, which are finite and not negative."""
    total = a + b
    dark = total <= minimum
    high = (a >= saturation) | (b >= saturation)
    flags = np.uint8(dark) | (np.uint8(high) << np.uint8(1))
    return np.float32(np.nan) if dark | high else half * (b - a) / total, flags


@numba.njit(parallel=True, error_model="numpy")
def _numba_planar(left, right, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        position[i], status[i] = _read_out(left[i], right[i], half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _numba_planar_codes(left, right, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(left[i]), np.float32(right[i])
        position[i], status[i] = _read_out_codes(a, b, half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _numba_pairs(currents, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        position[i], status[i] = _read_out(currents[2 * i], currents[2 * i + 1], half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _numba_pairs_codes(currents, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(currents[2 * i]), np.float32(currents[2 * i + 1])
        position[i], status[i] = _read_out_codes(a, b, half, minimum, saturation)


def _numpy(left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    a, b = left.astype(np.float32, copy=False), right.astype(np.float32, copy=False)
    total, difference = a + b, b - a
    dark = total <= np.float32(MINIMUM)
    high = (a >= np.float32(SATURATION)) | (b >= np.float32(SATURATION))
    bad = dark | high
    status = dark.astype(np.uint8) | (high.astype(np.uint8) << np.uint8(1))
    if left.dtype.kind == "f":
        outside = (np.abs(difference) > total) & ~dark
        lost = ~np.isfinite(total)
        status |= outside.astype(np.uint8) << np.uint8(2)
        status[lost] = 8
        bad |= outside | lost
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.float32(LENGTH / 2) * difference / total
    position[bad] = np.nan
    return position, status


def scan_currents(dtype: str, count: int) -> NDArray[Any]:
    """Return currents (2, count) of a scan: 5 % of the samples dark and 1 % saturated, in runs as in real scenes."""
    rng = np.random.default_rng(1)
    place = rng.uniform(0.1, 0.9, count)
    level = rng.uniform(1_000.0, 50_000.0, count)
    for share, run, value in ((0.05, 1000, 50.0), (0.01, 200, 130_000.0)):
        for start in rng.integers(0, count, round(share * count / run)):
            level[start : start + run] = value
    return np.minimum([level * (1.0 - place), level * place], 65_535.0).astype(dtype)


def cases(device: Device) -> Iterator[Case]:
    """Yield float32 and uint16 batches of 1e4, 1e6 and 16e6 samples, planar, and 1e6 as pairs.

    Smaller batches run eight in sequence, as a stream enqueues them; ``...-alone`` waits for each batch.
    """
    for dtype in ("float32", "uint16"):
        yield _case(device, dtype, 10_000, f"{dtype}/1e4", repeats=_IN_A_ROW)
        yield _case(device, dtype, 10_000, f"{dtype}/1e4-alone")
        yield _case(device, dtype, 1_000_000, f"{dtype}/1e6", repeats=_IN_A_ROW)
        yield _case(device, dtype, 1_000_000, f"{dtype}/1e6-alone")
        yield _case(device, dtype, 16_000_000, f"{dtype}/16e6")
        yield _case(device, dtype, 1_000_000, f"{dtype}-pairs/1e6", "pairs", repeats=_IN_A_ROW)


def _case(device: Device, dtype: str, count: int, name: str, layout: Any = "planar", repeats: int = 1) -> Case:
    readout = PsdReadout(
        strip_length=LENGTH,
        minimum_total=MINIMUM,
        saturation=SATURATION,
        layout=layout,
        outputs=("position", "status"),
    )
    shape = (2, count) if layout == "planar" else (count, 2)
    bound = readout.bind(device, shape, dtype)
    planar = scan_currents(dtype, count)
    currents = planar if layout == "planar" else np.ascontiguousarray(planar.T)
    bound.inputs[0].set(currents)
    left, right = (currents[0], currents[1]) if layout == "planar" else (currents[:, 0], currents[:, 1])
    position, status = np.empty(count, np.float32), np.empty(count, np.uint8)
    constants = (np.float32(LENGTH / 2), np.float32(MINIMUM), np.float32(SATURATION))
    loop: Any = {
        ("planar", False): _numba_planar,
        ("planar", True): _numba_planar_codes,
        ("pairs", False): _numba_pairs,
        ("pairs", True): _numba_pairs_codes,
    }[layout, dtype == "uint16"]
    arrays = (left, right) if layout == "planar" else (currents.reshape(-1),)

    def ours() -> None:
        for _ in range(repeats - 1):
            bound()
        bound.run()

    def with_numba() -> None:
        for _ in range(repeats):
            loop(*arrays, position, status, *constants)

    def with_numpy() -> None:
        for _ in range(repeats):
            _numpy(left, right)

    bound().wait()
    outputs: Any = bound.outputs
    error = _error(outputs.position.get(), outputs.status.get(), left, right)
    traffic = (currents.nbytes, 5 * count)
    peers = {"numba": with_numba, "numpy": with_numpy}
    flops = _FLOPS * count
    return Case("psd", name, ours, peers, error, traffic, repeats, flops=flops, bound=bound)


def _error(position: NDArray[Any], status: NDArray[Any], left: NDArray[Any], right: NDArray[Any]) -> float:
    a, b = left.astype(np.float64), right.astype(np.float64)
    good = (a + b > MINIMUM) & (a < SATURATION) & (b < SATURATION)
    if not np.array_equal(status == 0, good):
        raise AssertionError("the readout and float64 differ in the valid samples")
    return float(np.max(np.abs(position[good] - LENGTH / 2 * (b - a)[good] / (a + b)[good])))
