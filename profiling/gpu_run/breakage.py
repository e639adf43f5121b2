"""Step 2: input and states that break kernels, launches and memory management on GPUs, each in another process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host import Device, DeviceLostError, DeviceMemoryError, GpuVisionError, Pipeline, clear_cache
from gpuvision.profiling.gpu_run.worker import Worker
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout

_SECONDS = 60.0  # time limit of one case
_READOUT = PsdReadout(strip_length=2.0)
_GIB = 1 << 30


def run(device: Device, seconds: float) -> dict[str, Any]:
    """Run all cases and return their results by name: "ok", a remark, or the failure; stop after `seconds`."""
    end = time.monotonic() + seconds
    results: dict[str, str] = {}
    with Worker() as worker:
        for case in CASES:
            if time.monotonic() > end:
                results[case.__name__] = "not reached"
                continue
            answer = worker.call(case, device.label, seconds=min(_SECONDS, max(end - time.monotonic(), 1.0)))
            results[case.__name__] = f"FAILED: {answer.failure}" if answer.failure else answer.value
    failed = [name for name, result in results.items() if result.startswith("FAILED")]
    return {"failed": failed, "results": results}


def _check(condition: object, what: str) -> None:
    if not condition:
        raise AssertionError(what)


def _pairs(count: int) -> Any:
    return np.random.default_rng(count).uniform(0.1, 1.0, (count, 2)).astype(np.float32)


def _expected(pairs: Any) -> Any:
    left, right = pairs.astype(np.float64).T
    return (right - left) / (right + left)


def sizes(label: str) -> str:
    """Check that batches of no, few and a prime number of samples give NumPy's positions."""
    device = Device.named(label)
    for count in (0, 1, 15, 17, 63, 65, 1_000_003):
        pairs = _pairs(count)
        found = np.asarray(_READOUT(pairs, device=device).position)
        _check(np.allclose(found, _expected(pairs), atol=1e-6), f"{count} samples give wrong positions")
    return "ok"


def many_rows(label: str) -> str:
    """Check more than 65 535 groups along the second axis of a launch, the limit of NVIDIA's grids."""
    device = Device.named(label)
    frames = np.zeros((70_000, 32, 5), np.uint8)
    rows = 5 + np.arange(len(frames)) % 20
    frames[np.arange(len(frames)), rows] = 200
    found = np.asarray(LineReadout(method="centroid", threshold=20)(frames, device=device).position)
    _check(np.allclose(found, rows[:, None], atol=1e-3), "wrong positions of lines")
    return "ok"


def special_values(label: str) -> str:
    """Check that zero, tiny, denormal and infinite currents and NaN are flagged or right."""
    device = Device.named(label)
    values = np.array([0.0, 1e-45, 1e-38, 1e-30, 1.0, 3e38, np.inf, np.nan], np.float32)
    pairs = np.array([(a, b) for a in values for b in values], np.float32)
    reading = _READOUT(pairs, device=device)
    position, status = np.asarray(reading.position), np.asarray(reading.status)
    _check(not np.any(np.isnan(position) & (status == 0)), "NaN without a flag")
    with np.errstate(all="ignore"):
        error = np.abs(position - _expected(pairs))
        total = pairs.astype(np.float64).sum(1)
    good = (status == 0) & (total > 1e-37)
    _check(np.all(error[good] < 1e-5), "a wrong position without a flag")
    denormal = int(np.sum((status == 0) & (total > 0) & (total < 1e-37)))
    return f"ok; {denormal} pairs of denormal sums are read"


def doubles(label: str) -> str:
    """Check that double precision is right, or refused in one line."""
    device, pairs = Device.named(label), _pairs(1000).astype(np.float64)
    try:
        found = np.asarray(_READOUT(pairs, device=device).position)
    except ValueError as error:
        _check(not device.has_double and "float32" in str(error), f"unclear message: {error}")
        return "ok; refused: no double precision"
    _check(np.allclose(found, _expected(pairs), atol=1e-14), "wrong positions in double precision")
    return "ok"


def queues(label: str) -> str:
    """Check that queues of another context and without order are refused, and that a queue of the caller works."""
    device, shape = Device.named(label), (100, 2)
    context = cl.Context([device.handle])
    disorder = cl.command_queue_properties.OUT_OF_ORDER_EXEC_MODE_ENABLE
    for queue in (cl.CommandQueue(context), cl.CommandQueue(device.context, device.handle, properties=disorder)):
        try:
            _READOUT.bind(device, shape, np.float32, queue=queue)
        except ValueError:
            continue
        raise AssertionError("a queue of another context or without order is not refused")
    mine = Device.of(cl.CommandQueue(context))
    _READOUT.bind(mine, shape, np.float32).run()
    return "ok"


def threads(label: str) -> str:
    """Check an operation that four threads use at the same time."""
    device, wrong = Device.named(label), []

    def work(count: int) -> None:
        pairs = _pairs(count)
        for _ in range(100):
            found = np.asarray(_READOUT(pairs, device=device).position)
            if not np.allclose(found, _expected(pairs), atol=1e-6):
                wrong.append(count)

    workers = [threading.Thread(target=work, args=(1000 + number,)) for number in range(4)]
    for each in workers:
        each.start()
    for each in workers:
        each.join()
    _check(not wrong, f"wrong results in threads: {wrong[:4]}")
    return "ok"


def too_large(label: str) -> str:
    """Check that an array beyond the largest allocation is refused in one line."""
    device = Device.named(label)
    try:
        device.empty((device.max_allocation + 1,), np.uint8)
    except DeviceMemoryError as error:
        _check("\n" not in str(error), "more than one line")
        return f"ok; {error}"
    raise AssertionError("not refused")


def memory_full(label: str) -> str:
    """Fill the memory of a GPU: an error comes, and the device works after the arrays are freed."""
    device = Device.named(label)
    if device.is_cpu:
        return "ok; not run: the memory of a CPU device is the memory of the machine"
    kept: list[Any] = []
    try:
        while len(kept) * _GIB < 2 * device.handle.global_mem_size:
            array = device.empty((min(_GIB, device.max_allocation),), np.uint8)
            array.fill(1)  # some drivers allocate at the first use
            array.finish()
            kept.append(array)
    except (DeviceMemoryError, cl.Error) as error:
        remark = f"{type(error).__name__} after {len(kept)} arrays of 1 GiB"
    else:
        remark = f"no error after {len(kept)} arrays of 1 GiB: the driver moves them to the host"
    del kept
    clear_cache()
    _check(np.asarray(_READOUT(_pairs(100), device=device).position).shape == (100,), "the device does not work again")
    return f"ok; {remark}"


def illegal_access(label: str) -> str:
    """Write far outside a buffer on a GPU, which loses the context: the device is opened again."""
    device = Device.named(label)
    if device.is_cpu:
        return "ok; not run: an illegal access on a CPU ends the process"
    _READOUT(_pairs(100), device=device)
    source = "kernel void far(global int *to) { to[((size_t)1 << 44) + get_global_id(0)] = 1; }"
    kernel = cl.Kernel(cl.Program(device.context, source).build(), "far")
    kernel.set_args(cl.Buffer(device.context, cl.mem_flags.READ_WRITE, 64))
    try:
        cl.enqueue_nd_range_kernel(device.queue, kernel, (64,), (64,)).wait()
        device.queue.finish()
    except cl.Error as error:
        first = str(error)
    else:
        return "ok; the driver ignores the access"
    remark = "the next call works"
    try:
        _READOUT(_pairs(100), device=device)
    except (DeviceLostError, DeviceMemoryError) as error:
        remark = str(error)
    found = np.asarray(_READOUT(_pairs(100), device=device).position)
    _check(np.allclose(found, _expected(_pairs(100)), atol=1e-6), "wrong positions after the loss")
    return f"ok; {first}; {remark}"


def stream_that_fails(label: str) -> str:
    """Check that a stream whose consumer fails names the frame, and that the device works afterwards."""
    device = Device.named(label)

    def sink(batch: Any) -> None:
        if batch.number >= 4:
            raise OSError("disk full")

    try:
        Pipeline(_pairs(2000).reshape(20, 100, 2), _READOUT, device=device, batch=2).run(sink)
    except GpuVisionError as error:
        _check("frame 4" in str(error) and "disk full" in str(error), str(error))
    else:
        raise AssertionError("no error")
    _READOUT(_pairs(100), device=device)
    return "ok"


CASES: tuple[Callable[[str], str], ...] = (
    sizes,
    many_rows,
    special_values,
    doubles,
    queues,
    threads,
    too_large,
    stream_that_fails,
    memory_full,
    illegal_access,
)
