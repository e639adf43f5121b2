"""Step 4: streams with copies: overlap of upload, compute and download, and throughput at three batch sizes."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl

from gpuvision.host import ArraySource, Device, Pipeline, Trace
from gpuvision.ranging.line import LineReadout

_SHAPE = (512, 1024)
_MEGABYTES = (4, 16, 64)
_ENDLESS = 1 << 40  # frames
_LEAST_US = 0.1  # shortest credible stage [us]
_STAGES = ("upload", "compute", "download")
_READOUT = LineReadout(method="centroid", threshold=20)


def run(device: Device, seconds: float) -> dict[str, Any]:
    """Return the throughput and the overlap for batches of 4, 16 and 64 MB, in at most about `seconds`."""
    each = min(seconds / (2 * len(_MEGABYTES)), 10.0)
    return {"rows": [measure(device, megabytes, each) for megabytes in _MEGABYTES]}


def measure(device: Device, megabytes: int, seconds: float) -> dict[str, Any]:
    """Return the row of one batch size; the stream runs for about `seconds`."""
    batch = max((megabytes << 20) // (_SHAPE[0] * _SHAPE[1]), 1)
    frames = np.random.default_rng(1).integers(0, 255, (min(batch, 8), *_SHAPE), np.uint8)
    copy_rate = upload_rate(device, megabytes << 20)
    row = _stream(device, frames, batch, seconds)
    return {
        "batch_mb": megabytes,
        "batch": batch,
        "frames_per_second": round(row["throughput"], 1),
        "gb_per_second": round(1e-9 * row["throughput"] * _SHAPE[0] * _SHAPE[1], 3),
        "upload_gb_per_second": round(1e-9 * copy_rate, 3),
        **row["overlap"],
    }


def _stream(device: Device, frames: Any, batch: int, seconds: float) -> dict[str, Any]:
    """Run a stream with copies for some seconds and return its throughput and overlap."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "trace.json"
        source = ArraySource(frames, _ENDLESS)
        stream: Pipeline[Any] = Pipeline(
            source, _READOUT, device=device, batch=batch, ring=4, zero_copy=False, trace=Trace(path)
        )
        end = time.monotonic() + seconds
        with stream:
            for _ in stream:
                if time.monotonic() > end:
                    break
        report = stream.report()
        events = json.loads(path.read_text())["traceEvents"]
    return {"throughput": report.throughput, "overlap": overlap(events)}


def overlap(events: Iterable[dict[str, Any]]) -> dict[str, float]:
    """Return how the stages of a stream overlap, from the events of its trace.

    Parameters
    ----------
    events : iterable of dict
        Events of Chrome's trace format with ``name``, ``ts`` and ``dur``.

    Returns
    -------
    dict
        Empty where the runtime gives no device times (events of rusticl on llvmpipe last 1 ns).
        ``upload_share``, ``compute_share``, ``download_share``: time of the stage over the time from the first start to
        the last end. ``busy_share``: share of the time in which at least one stage runs. ``overlap``: 1 - busy time /
        sum of the stages' times: 0 where no two stages run at the same time, 2/3 where all three always do.
    """
    spans = {
        stage: [(each["ts"], each["ts"] + each["dur"]) for each in events if each.get("name") == stage]
        for stage in _STAGES
    }
    everything = sorted(span for each in spans.values() for span in each)
    if not any(end - start > _LEAST_US for start, end in everything):
        return {}
    whole = max(max(end for _, end in everything) - everything[0][0], 1e-9)
    sums = {stage: sum(end - start for start, end in each) for stage, each in spans.items()}
    busy = _union(everything)
    shares = {f"{stage}_share": round(each / whole, 4) for stage, each in sums.items()}
    together = round(1.0 - busy / sum(sums.values()), 4)
    return {**shares, "busy_share": round(busy / whole, 4), "overlap": together}


def _union(spans: Sequence[tuple[float, float]]) -> float:
    """Return the length of the union of intervals that are sorted by their starts."""
    total, reached = 0.0, -float("inf")
    for start, end in spans:
        total += max(end - max(start, reached), 0.0)
        reached = max(reached, end)
    return total


def upload_rate(device: Device, size: int, repeats: int = 10) -> float:
    """Return the rate of uploads from page-locked memory alone [bytes/s]: the best of some copies."""
    queue, flags = device.new_queue(), cl.mem_flags
    pinned = cl.Buffer(device.context, flags.READ_WRITE | flags.ALLOC_HOST_PTR, size)
    access: Any = cl.map_flags.READ | cl.map_flags.WRITE
    host = cl.enqueue_map_buffer(queue, pinned, access, 0, (size,), np.dtype(np.uint8))[0]
    host.fill(1)
    target = cl.Buffer(device.context, flags.READ_WRITE, size)
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        cl.enqueue_copy(queue, target, host, is_blocking=False).wait()
        times.append(time.perf_counter() - start)
    return size / min(times)
