"""Line readout of camera frames at sensor rate, compared with a loop that copies, runs and copies back.

A thread delivers frames of 512 x 1024 pixels at a fixed rate. The stream holds a rate if no frame is dropped and no
frame waits longer for its slot than the buffers of a sensor last. Latency is the time from the arrival of a frame until
its positions are in host memory.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from gpuvision.host import Device, DeviceArray
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.report import StreamReport
from gpuvision.host.sources import ArraySource, PacedSource
from gpuvision.profiling.harness import Case
from gpuvision.ranging.line import LineReadout

SHAPE = (512, 1024)
RATES = (1000, 4000)
READOUT = LineReadout(method="centroid", threshold=20)

_FRAMES = 16
_ENDLESS = 1 << 40  # frames
_BURST = 1024  # frames
_STALL_S = 0.1  # time that the buffers of a sensor bridge [s]
_TRIAL_S = 1.0  # duration of a trial of the search [s]
_BATCHES = (1, 2, 4, 8, 16)
_RESOLUTION = 0.03  # relative width of the interval at which the search stops
_MARGIN = 1.25  # throughput of the chosen batch size over the rate
_RING_FRAMES = 512  # 256 MB


@dataclass(frozen=True)
class Held:
    """Result of a stream at a rate [frames/s]."""

    rate: float
    report: StreamReport
    late: float

    @property
    def holds(self) -> bool:
        """Whether no frame was lost."""
        return not self.report.dropped and self.late < _STALL_S

    def metadata(self) -> dict[str, Any]:
        """Return the additional columns of a row."""
        latency = self.report.latency
        micro = {"p50": latency.p50, "p99": latency.p99, "p999": latency.p999, "max": latency.maximum}
        return {
            "rate": round(self.rate),
            "holds": self.holds,
            "run_seconds": round(self.report.seconds, 3),
            "frames": self.report.frames,
            "dropped": self.report.dropped,
            "late_ms": round(self.late * 1e3, 3),
            "batch": self.report.batch,
            "ring": self.report.ring,
            **{f"{name}_us": round(value * 1e6, 1) for name, value in micro.items()},
        }


def cases(device: Device, *, run_seconds: float = 60.0) -> Iterator[Case]:
    """Yield `1000` and `4000` [frames/s], each for `run_seconds`, and `highest`: the highest rate without loss."""
    frames = line_frames()
    error = _error(frames, device)
    rates = service_rates(frames, device)
    for rate in RATES:
        held = hold(frames, device, rate, run_seconds, _batch_for(rate, rates))
        yield from _case(str(rate), frames, device, held, error)
    yield from _case("highest", frames, device, highest(frames, device, rates, min(run_seconds, _TRIAL_S)), error)


def line_frames() -> NDArray[np.uint8]:
    """Return noisy frames with a moving line (sigma 2 px)."""
    rng = np.random.default_rng(4)
    rows = np.arange(SHAPE[0])[:, None]
    frames = rng.integers(0, 20, (_FRAMES, *SHAPE), dtype=np.uint8)
    for number, frame in enumerate(frames):
        line = 250.0 + number + 60.0 * np.sin(np.arange(SHAPE[1]) / 90.0)
        frame += np.round(200.0 * np.exp(-0.5 * ((rows - line) / 2.0) ** 2)).astype(np.uint8)
    return frames


def service_rates(frames: NDArray[np.uint8], device: Device) -> dict[int, float]:
    """Return the throughput by batch size [frames/s], with frames that are always available."""
    rates = {}
    for batch in _BATCHES:
        source = ArraySource(frames, 2 * _BURST)
        rates[batch] = Pipeline(source, READOUT, device=device, batch=batch).run().throughput
    return rates


def _batch_for(rate: float, rates: Mapping[int, float]) -> int:
    """Return the smallest batch that keeps up with a margin, or the fastest one."""
    return next((batch for batch in rates if rates[batch] > _MARGIN * rate), max(rates, key=rates.__getitem__))


def hold(frames: NDArray[np.uint8], device: Device, rate: float, seconds: float, batch: int) -> Held:
    """Run the stream at a rate [frames/s] for some seconds."""
    source = PacedSource(ArraySource(frames, max(int(rate * seconds), 1)), rate)
    ring = max(min(int(_STALL_S * rate), _RING_FRAMES) // batch, 4)
    stream = Pipeline(source, READOUT, device=device, batch=batch, ring=ring, policy="drop_oldest")
    return Held(rate, stream.run(), source.late * 1e-9)


def highest(
    frames: NDArray[np.uint8], device: Device, rates: Mapping[int, float], trial_seconds: float = _TRIAL_S
) -> Held:
    """Search the highest rate that holds by bisection; each rate has two trials, since machines stall at times."""
    batch = max(rates, key=rates.__getitem__)
    low, high = 0.0, 1.4 * rates[batch]
    best: Held | None = None
    while best is None or high - low > _RESOLUTION * high:
        rate = 0.5 * (low + high)
        trials = (hold(frames, device, rate, trial_seconds, batch) for _ in range(2))
        held = next((trial for trial in trials if trial.holds), None)
        if held is None:
            high = rate
        else:
            low, best = rate, held
    return best


def _case(name: str, frames: NDArray[np.uint8], device: Device, held: Held, error: float) -> Iterator[Case]:
    """Yield the case of a burst of frames through an open stream; the peer is the loop."""
    batch = held.report.batch
    with Pipeline(ArraySource(frames, _ENDLESS), READOUT, device=device, batch=batch) as stream:

        def burst() -> None:
            for _ in range(_BURST // batch):
                next(stream)

        loop = _blocking_loop(frames, device)
        yield Case("stream", name, burst, {"pyopencl": loop}, error=error, metadata=held.metadata())


def _blocking_loop(frames: NDArray[np.uint8], device: Device) -> Callable[[], None]:
    """Return a loop without a stream: copy a frame in, run, copy the results out, and wait after each step."""
    apart = copy.copy(device)
    apart.shares_memory = False
    bound = READOUT.bind(apart, SHAPE, np.uint8)
    target: Any = bound.inputs[0].base_data
    outputs = [each for each in bound.outputs if isinstance(each, DeviceArray)]
    results: list[tuple[Any, Any]] = [(np.empty(each.shape, each.dtype), each.base_data) for each in outputs]

    def loop() -> None:
        for number in range(_BURST):
            cl.enqueue_copy(device.queue, target, frames[number % len(frames)])
            bound()
            for host, memory in results:
                cl.enqueue_copy(device.queue, host, memory)

    return loop


def _error(frames: NDArray[np.uint8], device: Device) -> float:
    """Return the largest error of a streamed position against float64 [pixel]."""
    light = np.maximum(frames.astype(np.float64) - READOUT.threshold, 0.0)
    exact = (light * np.arange(SHAPE[0])[:, None]).sum(axis=1) / light.sum(axis=1)
    error = 0.0
    with Pipeline(frames, READOUT, device=device, batch=3) as stream:
        for batch in stream:
            part = exact[batch.number : batch.number + len(batch)]
            error = max(error, float(np.abs(batch.result.position - part).max()))
    return error
