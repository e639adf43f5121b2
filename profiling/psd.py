"""PSD readout, compared with Numba loops and NumPy: position and status.

The peer ``numba`` reads a pair as one complex number or one 32-bit word, and runs chunks on all cores or the whole loop
on one; ``numba-plain`` indexes the arrays in a parallel loop.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.profiling.harness import Case, Peer
from gpuvision.ranging.psd import PsdReadout

LENGTH, MINIMUM, SATURATION = 6e-3, 100.0, 60_000.0
_IN_A_ROW = 8
_FLOPS = 4  # of a sample: sum, difference, product with half of the length, quotient; without the comparisons
_CHUNK = 8192  # samples of a chunk of the peer
# Largest difference of two readouts that keep the stated error bound of 4 epsilon of L/2 each [m].
_AGREEMENT = 8.0 * float(np.finfo(np.float32).eps) * LENGTH / 2


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
    """Read out one sample of codes, which are finite and not negative.

    The numbers are float32 and the flags int32, so that one vector width suits all of them until the flags are stored.
    """
    total = a + b
    dark, high = total <= minimum, max(a, b) >= saturation
    flags = (np.int32(1) if dark else np.int32(0)) | (np.int32(2) if high else np.int32(0))
    return np.float32(np.nan) if dark | high else half * (b - a) / total, np.uint8(flags)


@numba.njit(error_model="numpy")
def _read_out_codes_plain(a, b, half, minimum, saturation):
    """Read out one sample of codes, with flags as they are stored."""
    total = a + b
    dark = total <= minimum
    high = (a >= saturation) | (b >= saturation)
    flags = np.uint8(dark) | (np.uint8(high) << np.uint8(1))
    return np.float32(np.nan) if dark | high else half * (b - a) / total, flags


# The loops take the arrays of both channels. A loop over pairs takes one array twice.
@numba.njit(error_model="numpy")
def _planar(left, right, position, status, half, minimum, saturation):
    for i in range(position.shape[0]):
        position[i], status[i] = _read_out(left[i], right[i], half, minimum, saturation)


@numba.njit(error_model="numpy")
def _planar_codes(left, right, position, status, half, minimum, saturation):
    for i in range(position.shape[0]):
        a, b = np.float32(left[i]), np.float32(right[i])
        position[i], status[i] = _read_out_codes(a, b, half, minimum, saturation)


@numba.njit(error_model="numpy")
def _complex_pairs(pairs, _, position, status, half, minimum, saturation):
    for i in range(position.shape[0]):
        position[i], status[i] = _read_out(pairs[i].real, pairs[i].imag, half, minimum, saturation)


@numba.njit(error_model="numpy")
def _word_pairs(pairs, _, position, status, half, minimum, saturation):
    for i in range(position.shape[0]):
        a, b = np.int32(pairs[i] & np.uint32(0xFFFF)), np.int32(pairs[i] >> np.uint32(16))
        position[i], status[i] = _read_out_codes(np.float32(a), np.float32(b), half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _planar_plain(left, right, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        position[i], status[i] = _read_out(left[i], right[i], half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _planar_codes_plain(left, right, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(left[i]), np.float32(right[i])
        position[i], status[i] = _read_out_codes_plain(a, b, half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _pairs_plain(currents, _, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        position[i], status[i] = _read_out(currents[2 * i], currents[2 * i + 1], half, minimum, saturation)


@numba.njit(parallel=True, error_model="numpy")
def _code_pairs_plain(currents, _, position, status, half, minimum, saturation):
    for i in numba.prange(position.shape[0]):
        a, b = np.float32(currents[2 * i]), np.float32(currents[2 * i + 1])
        position[i], status[i] = _read_out_codes_plain(a, b, half, minimum, saturation)


# Loop of an expert, on one core, and of a user, by layout and dtype of the currents.
_LOOPS: dict[tuple[str, str], tuple[Any, Any]] = {
    ("planar", "float32"): (_planar, _planar_plain),
    ("planar", "uint16"): (_planar_codes, _planar_codes_plain),
    ("pairs", "float32"): (_complex_pairs, _pairs_plain),
    ("pairs", "uint16"): (_word_pairs, _code_pairs_plain),
}


@functools.cache
def _in_chunks(one_thread: Any) -> Any:
    """Return a loop over chunks on all cores: LLVM vectorises more of `one_thread` than of a parallel loop."""

    @numba.njit(parallel=True, error_model="numpy")
    def chunks(left, right, position, status, half, minimum, saturation):
        count = position.shape[0]
        for chunk in numba.prange((count + _CHUNK - 1) // _CHUNK):
            first, end = chunk * _CHUNK, min((chunk + 1) * _CHUNK, count)
            currents = left[first:end], right[first:end]
            one_thread(*currents, position[first:end], status[first:end], half, minimum, saturation)

    return chunks


def _peers(
    currents: NDArray[Any], layout: str, repeats: int, expected: tuple[NDArray[Any], NDArray[Any]]
) -> dict[str, Peer]:
    """Return the peers ``numba`` and ``numba-plain``, after a comparison of their results with the expected ones."""
    dtype = currents.dtype.name
    flat = currents.reshape(-1)
    pairs = flat.view(np.complex64 if dtype == "float32" else np.uint32)
    expert = tuple(currents) if layout == "planar" else (pairs, pairs)
    plain = tuple(currents) if layout == "planar" else (flat, flat)
    count = len(expected[0])
    position, status = np.empty(count, np.float32), np.empty(count, np.uint8)

    constants = np.float32(LENGTH / 2), np.float32(MINIMUM), np.float32(SATURATION)

    def call(loop: Any, channels: tuple[NDArray[Any], ...]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(repeats):
                loop(*channels, position, status, *constants)

        position[:], status[:] = 0.0, 255
        run()
        np.testing.assert_array_equal(status, expected[1])
        np.testing.assert_allclose(position, expected[0], rtol=0.0, atol=_AGREEMENT)
        return run

    one_thread, by_user = _LOOPS[layout, dtype]
    forms = {"one-thread": call(one_thread, expert), "chunks": call(_in_chunks(one_thread), expert)}
    return {"numba": forms, "numba-plain": call(by_user, plain)}


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

    def ours() -> None:
        for _ in range(repeats - 1):
            bound()
        bound.run()

    def with_numpy() -> None:
        for _ in range(repeats):
            _numpy(left, right)

    bound().wait()
    outputs: Any = bound.outputs
    position, status = outputs.position.get(), outputs.status.get()
    peers = _peers(currents, layout, repeats, (position, status)) | {"numpy": with_numpy}
    traffic = (currents.nbytes, 5 * count)
    error, flops = _error(position, status, left, right), _FLOPS * count
    return Case("psd", name, ours, peers, error, traffic, repeats, flops=flops, bound=bound)


def _error(position: NDArray[Any], status: NDArray[Any], left: NDArray[Any], right: NDArray[Any]) -> float:
    a, b = left.astype(np.float64), right.astype(np.float64)
    good = (a + b > MINIMUM) & (a < SATURATION) & (b < SATURATION)
    if not np.array_equal(status == 0, good):
        raise AssertionError("the readout and float64 differ in the valid samples")
    return float(np.max(np.abs(position[good] - LENGTH / 2 * (b - a)[good] / (a + b)[good])))
