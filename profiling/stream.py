"""Line readout of camera frames at sensor rate, compared with a loop that copies, runs and copies back.

A thread delivers frames of 512 x 1024 pixels at a fixed rate. The stream holds a rate if no frame is dropped and no
frame waits longer for its slot than the buffers of a sensor last. Latency is the time from the arrival of a frame until
its positions are in host memory.

One case runs beside a second process that loads one core half of the time. The stream of this case has the settings
that `plan_stream` finds before the load begins. ``python -m gpuvision.profiling.stream`` repeats this case: five runs
of 60 s on each device, a table at the end, and exit code 1 if a run lost a frame or is void.
"""

from __future__ import annotations

import argparse
import contextlib
import copy
import math
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyopencl as cl
from numpy.typing import NDArray

from gpuvision.host import Device, DeviceArray, GpuVisionError, Stall, StreamError
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.planning import Plan, plan_stream
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
_LOADED_RATE = 4000  # [frames/s]
_LOAD_PERIOD = 0.1  # the second process computes for half of this time, then sleeps [s]
# Processor time counts, so that the process loads half a core even where it must share the core. It ends with the
# benchmark, whose end closes its input.
_LOAD_CODE = """
import select, sys, time
half = float(sys.argv[1]) / 2
print("ready", flush=True)
while not select.select([sys.stdin], [], [], half)[0]:
    end = time.process_time() + half
    while time.process_time() < end:
        pass
"""


@dataclass(frozen=True)
class Held:
    """Result of a stream at a rate [frames/s], with the plan of its settings where it has one."""

    rate: float
    report: StreamReport
    late: float
    plan: Plan | None = None

    @property
    def holds(self) -> bool:
        """Whether no frame was lost."""
        return not self.report.dropped and self.late < _STALL_S

    def metadata(self) -> dict[str, Any]:
        """Return the additional columns of a row."""
        latency, stall = self.report.latency, self.report.longest_stall
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
            "inline": self.report.inline,
            **{f"{name}_us": round(value * 1e6, 1) for name, value in micro.items()},
            "stall_ms": None if stall is None else round(stall.seconds * 1e3, 3),
            "stall_place": None if stall is None else stall.place,
            **({} if self.plan is None else {"ring_bytes": self.plan.ring_bytes}),
        }


def cases(device: Device, *, run_seconds: float = 60.0) -> Iterator[Case]:
    """Yield the cases of the stream.

    `1000` and `4000` [frames/s] and `4000_loaded` run for `run_seconds` each, the last one beside a process that loads
    one core half of the time. `highest` is the highest rate without loss.
    """
    frames = line_frames()
    error = _error(frames, device)
    rates = service_rates(frames, device)
    for rate in RATES:
        held = hold(frames, device, rate, run_seconds, _batch_for(rate, rates))
        yield from _case(str(rate), frames, device, held, error)
    loaded = hold_loaded(frames, device, _LOADED_RATE, run_seconds)
    yield from _case(f"{_LOADED_RATE}_loaded", frames, device, loaded, error)
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


def hold_loaded(frames: NDArray[np.uint8], device: Device, rate: float, seconds: float) -> Held:
    """Run the planned stream at a rate [frames/s] beside a second process that loads one core half of the time."""
    source = PacedSource(ArraySource(frames, max(int(rate * seconds), 1)), rate)
    plan = plan_stream(source, READOUT, device=device)
    stream = Pipeline(source, READOUT, policy="drop_oldest", **plan.settings)
    with _half_loaded_core():
        return Held(rate, stream.run(), source.late * 1e-9, plan)


@contextlib.contextmanager
def _half_loaded_core() -> Iterator[None]:
    """Run a second process that loads one core half of the time."""
    command = [sys.executable, "-c", _LOAD_CODE, str(_LOAD_PERIOD)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as load:
        assert load.stdin is not None
        assert load.stdout is not None
        load.stdout.readline()
        try:
            yield
            if load.poll() is not None:
                raise StreamError(f"the second process ended with exit code {load.returncode} during the run")
        finally:
            load.stdin.close()


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
    own_device = copy.copy(device)
    own_device.shares_memory = False
    bound = READOUT.bind(own_device, SHAPE, np.uint8)
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


@dataclass(frozen=True)
class LoadedRun:
    """Run beside a half-loaded core: number, label of the device, and the result or the reason why there is none."""

    number: int
    device: str
    held: Held | None
    failure: str = ""

    @property
    def problem(self) -> str:
        """Reason why the run does not count; empty for a run that counts."""
        if self.held is None:
            return f"void: {self.failure}"
        if self.held.report.dropped:
            return "frames lost"
        if not self.held.holds:
            return f"void: frames were read up to {1e3 * self.held.late:.3g} ms late"
        return ""


def loaded_run(number: int, frames: NDArray[np.uint8], device: Device, seconds: float) -> LoadedRun:
    """Return a run beside a half-loaded core; a run that fails is void, and the other runs go on."""
    try:
        return LoadedRun(number, device.label, hold_loaded(frames, device, _LOADED_RATE, seconds))
    except GpuVisionError as error:
        return LoadedRun(number, device.label, None, str(error).splitlines()[0])


def table(runs: Sequence[LoadedRun]) -> list[str]:
    """Return the lines of the table of runs."""
    head = ("run", "device", "lost", "p50 [us]", "p99 [us]", "stall [ms]", "spent in", "result")
    cells = [head, *(_cells(each) for each in runs)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, row, widths)).rstrip() for row in cells]


def _cells(run: LoadedRun) -> tuple[str, ...]:
    """Return the row of a run; a run without a result has no numbers."""
    numbers: tuple[str, ...] = ("-",) * 5
    if run.held is not None:
        report = run.held.report
        stall = ("-", "-") if report.longest_stall is None else _stall_cells(report.longest_stall)
        quantiles = [f"{1e6 * each:.0f}" for each in (report.latency.p50, report.latency.p99)]
        numbers = (str(report.dropped), *quantiles, *stall)
    return (str(run.number), run.device, *numbers, run.problem or "held")


def _stall_cells(stall: Stall) -> tuple[str, str]:
    return f"{1e3 * stall.seconds:.2f}", stall.place


def main(arguments: Sequence[str] | None = None) -> int:
    """Repeat the case beside a half-loaded core and print a table; return 1 if a run lost frames or is void.

    A run is void if the frames came late by more than the buffers of a sensor bridge, if the second process ended
    early, or if the stream failed.
    """
    parser = argparse.ArgumentParser(prog="python -m gpuvision.profiling.stream", description=main.__doc__)
    parser.add_argument("--device", action="append", help="label of a device; repeat for several; default: all")
    parser.add_argument("--runs", type=_positive(int), default=5, help="number of runs on each device; default: 5")
    parser.add_argument("--seconds", type=_positive(float), default=60.0, help="duration of a run [s]; default: 60")
    options = parser.parse_args(arguments)
    frames = line_frames()
    runs: list[LoadedRun] = []
    for device in [Device.named(each) for each in options.device] if options.device else Device.all():
        for _ in range(options.runs):
            runs.append(loaded_run(len(runs) + 1, frames, device, options.seconds))
            _print_run(runs[-1])
    print("\n".join(["", *table(runs)]))
    return int(not runs or any(each.problem for each in runs))


def _print_run(run: LoadedRun) -> None:
    """Print the plan and the report of a run when it has ended: all runs take ten minutes."""
    name = f"{run.device} run {run.number}"
    if run.held is None:
        print(f"{name}: {run.problem}", flush=True)
    else:
        print(f"{name}: {run.held.plan}", flush=True)
        print(f"{name}: {run.held.report}, frames read up to {1e3 * run.held.late:.3g} ms late", flush=True)


def _positive(kind: Callable[[str], float]) -> Callable[[str], float]:
    """Return a converter of a positive finite number for the command line."""

    def convert(text: str) -> float:
        number = kind(text)
        if not 0 < number < math.inf:
            raise argparse.ArgumentTypeError(f"{text} is not a positive number")
        return number

    return convert


if __name__ == "__main__":
    sys.exit(main())
