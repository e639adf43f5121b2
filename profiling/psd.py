"""PSD readout against a Numba loop and against NumPy, position and status."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, host_view
from gpuvision.profiling.harness import Case
from gpuvision.ranging.psd import PsdReadout

LENGTH, MINIMUM, SATURATION = 6e-3, 100.0, 60_000.0


@numba.njit(parallel=True, error_model="numpy")
def _numba_planar(left, right, position, status, half, minimum, saturation):  # type: ignore[no-untyped-def]
    """Read out on all cores; branch-free, so that LLVM vectorises it."""
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(left[i]), np.float32(right[i])
        total = a + b
        dark = total <= minimum
        high = (a >= saturation) | (b >= saturation)
        position[i] = np.float32(np.nan) if dark | high else half * (b - a) / total
        status[i] = np.uint8(dark) | (np.uint8(high) << np.uint8(1))


@numba.njit(parallel=True, error_model="numpy")
def _numba_pairs(currents, position, status, half, minimum, saturation):  # type: ignore[no-untyped-def]
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(currents[2 * i]), np.float32(currents[2 * i + 1])
        total = a + b
        dark = total <= minimum
        high = (a >= saturation) | (b >= saturation)
        position[i] = np.float32(np.nan) if dark | high else half * (b - a) / total
        status[i] = np.uint8(dark) | (np.uint8(high) << np.uint8(1))


def _numpy(left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    a, b = left.astype(np.float32), right.astype(np.float32)
    total = a + b
    dark = total <= np.float32(MINIMUM)
    high = (a >= np.float32(SATURATION)) | (b >= np.float32(SATURATION))
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.float32(LENGTH / 2) * (b - a) / total
    position[dark | high] = np.nan
    return position, dark.astype(np.uint8) | (high.astype(np.uint8) << np.uint8(1))


def cases(device: Device) -> Iterator[Case]:
    """Yield float32 and uint16 batches of 1e4, 1e6 and 16e6 samples, planar; and 1e6 as pairs."""
    for count, name in ((10_000, "1e4"), (1_000_000, "1e6"), (16_000_000, "16e6")):
        for dtype in ("float32", "uint16"):
            yield _case(device, dtype, count, f"{dtype}/{name}", "planar")
    for dtype in ("float32", "uint16"):
        yield _case(device, dtype, 1_000_000, f"{dtype}-pairs/1e6", "pairs")


def _case(device: Device, dtype: str, count: int, name: str, layout: Any) -> Case:
    readout = PsdReadout(
        strip_length=LENGTH,
        minimum_total=MINIMUM,
        saturation=SATURATION,
        layout=layout,
        outputs=("position", "status"),
    )
    shape = (2, count) if layout == "planar" else (count, 2)
    bound = readout.bind(device, shape, dtype)
    currents = np.random.default_rng(1).integers(0, 65_000, shape).astype(dtype)
    _fill(bound.inputs[0], currents)
    left, right = (currents[0], currents[1]) if layout == "planar" else (currents[:, 0], currents[:, 1])
    position, status = np.empty(count, np.float32), np.empty(count, np.uint8)
    constants = (np.float32(LENGTH / 2), np.float32(MINIMUM), np.float32(SATURATION))
    if layout == "planar":
        peers = {
            "numba": lambda: _numba_planar(left, right, position, status, *constants),
            "numpy": lambda: _numpy(left, right),
        }
    else:
        flat = currents.reshape(-1)
        peers = {
            "numba": lambda: _numba_pairs(flat, position, status, *constants),
            "numpy": lambda: _numpy(left, right),
        }
    bound().wait()
    error = _error(bound.outputs.position.get(), bound.outputs.status.get(), left, right)
    traffic = (currents.nbytes, 5 * count)
    return Case("psd", name, lambda: bound().wait(), peers, error, traffic)


def _fill(array: Any, values: NDArray[Any]) -> None:
    if isinstance(array.base_data, type(None)) or not hasattr(array.base_data, "svm_ptr"):
        array.set(values)
    else:
        host_view(array)[...] = values


def _error(position: NDArray[Any], status: NDArray[Any], left: NDArray[Any], right: NDArray[Any]) -> float:
    a, b = left.astype(np.float64), right.astype(np.float64)
    good = (a + b > MINIMUM) & (a < SATURATION) & (b < SATURATION)
    if not np.array_equal(status == 0, good):
        raise AssertionError("the readout and float64 disagree on which samples are good")
    return float(np.max(np.abs(position[good] - LENGTH / 2 * (b - a)[good] / (a + b)[good])))
