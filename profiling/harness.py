"""Benchmark harness: measure our operation and its peers interleaved.

Absolute times on a shared machine are unreliable: its speed changes by a factor of two within minutes. Therefore the
candidates of a case run in turn within each round, a ratio is the median over the rounds of the ratio within a round
with its confidence interval, and a section is measured again if the FLOP rate of the machine differs before and after
it.
"""

from __future__ import annotations

import importlib
import math
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Bound, Device, Operation
from gpuvision.profiling import ceiling, numba_cache
from gpuvision.profiling.device_times import DeviceTimes, Recorder
from gpuvision.profiling.machine import describe_machine
from gpuvision.profiling.rounds import median_interval, take_turns
from gpuvision.profiling.run import Failure, Probe, Row, Run
from gpuvision.profiling.time_plan import TimePlan

# Benchmarked operations: name in the rows, and module of this package that measures it. Some modules also yield cases
# of related operations. The names stay stable when modules are renamed, because results are compared over time.
# Servo first: PoCL 3 keeps 128 kernels. Where a process has used more, a launch of a feature pose takes 200 us longer.
OPERATIONS = {
    "servo": "servo",
    "psd": "psd",
    "line": "line",
    "triangulation": "triangulation",
    "range_image": "range_image",
    "merge_heights": "merge_heights",
    "deposits": "deposits",
    "undistort": "undistort_image",
    "points": "undistort_points",
    "calibration": "calibration",
    "reflections": "line_irradiance",
    "reflectance": "reflectance",
    "mirrors": "mirrors",
    "bvh": "rays",
    "visible_intervals": "visible_intervals",
    "simulate": "light_paths",
    "light_clustering": "light_clustering",
    "field": "field_pose",
    "board_image": "board_image",
    "ruler": "ruler",
    "blob": "blob",
    "line_fit": "line_fit",
    "pose": "board_pose",
    "registration": "registration",
    "mitsuba": "mitsuba",
    "launch": "launch",
    "stream": "stream",
}
# Public operations, and the benchmark that has rows of each one.
MEASURED = {
    "AnyHit": "bvh",
    "BoardPoseEstimator": "pose",
    "ClosestHit": "bvh",
    "EstimateFeaturePose": "servo",
    "FieldPoseRefinement": "field",
    "FieldPoseSearch": "field",
    "FindBlobs": "blob",
    "FitLines": "line_fit",
    "LineIrradiance": "reflections",
    "LineReadout": "line",
    "MeasureDeposits": "deposits",
    "MergeHeights": "merge_heights",
    "OccludedIrradiance": "reflections",
    "PsdReadout": "psd",
    "RangeImage": "range_image",
    "Reflectance": "reflectance",
    "RenderBoard": "board_image",
    "RulerEdges": "ruler",
    "SolvePose": "pose",
    "Triangulation": "triangulation",
    "UndistortImage": "undistort",
    "UndistortPoints": "points",
}
# Cases that a quick run measures, where these are not the first ones of their module.
QUICK_CASES = {"psd": "float32/1e6", "line": "whole/16", "triangulation": "float32/1e6", "ruler": "100", "blob": "100"}
# Settings of the cases of a quick run.
QUICK_SETTINGS: Mapping[str, Mapping[str, Any]] = {"stream": {"run_seconds": 10.0}}
# Preparation that no measuring time shortens [s]: the stream runs three times for 60 s, and searches its highest rate.
KNOWN_PREPARATION = {"stream": 200.0}
_STEADY = 0.2  # largest relative change of the FLOP rate during a valid section
_ATTEMPTS = 4  # measurements of a section before the run is marked invalid
R = TypeVar("R", bound=tuple[Any, ...])
_Call = tuple[str, str]  # names of a peer and of its form
_OURS: _Call = ("", "")
_CEILING: _Call = ("ceiling", "")
_EVENTS: _Call = ("events", "")

# Function of a peer, or functions by the name of the form.
Peer = Callable[[], object] | Mapping[str, Callable[[], object]]


@dataclass(frozen=True)
class Case:
    """Benchmark case: our call, and peers that do the same work on the same input. It gives one row for each peer.

    Attributes
    ----------
    operation, name
        Columns ``operation`` and ``case`` of the rows. Names stay stable, because results are compared over time.
    ours
        Function that does the work and waits until it is finished.
    peers
        Functions by the name of the peer (``numba``, ``numpy``, ``opencv``, ``pyopencl``). ``numba`` is the form of an
        expert, ``numba-plain`` the loop that a user writes first. Several forms of a peer are functions by the name
        of the form: the row shows the fastest one.
    error
        Our largest error compared with float64 on the input of the case, in the unit of the output.
    traffic
        Least number of bytes (read, written) of the work, for its place in the roofline; None: it has none.
    repeats
        Number of times that each function does the work back to back; the times in a row are for one.
    metadata
        Additional columns of the row (latencies, rates).
    factors
        Factors, by the name of the peer, that multiply the measured time of a peer which does only a part of the work,
        because all of it would take too long. The module of the case documents the origin of a factor.
    flops
        Number of additions, subtractions, multiplications and divisions of the work, counted in its formulas; None: no
        fraction of the device's FLOP rate. They are floating-point operations, or operations on pixels and levels where
        the formulas compute in integers. A root, an exponential and the like count 1. The module of the case documents
        the count.
    bound
        Bound operation that `ours` launches, for the times on the device. It is found without being given if `ours` is
        a method of it; None: no times on the device.
    copied
        Whether a copy with the traffic is timed in turn with the functions, for the fraction of the device's limit. It
        evicts the caches for the function that is timed next, and not for the others.
    """

    operation: str
    name: str
    ours: Callable[[], object]
    peers: Mapping[str, Peer]
    error: float
    traffic: tuple[int, int] | None = None
    repeats: int = 1
    metadata: Mapping[str, Any] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)
    flops: float | None = None
    bound: Bound[Any] | None = None
    copied: bool = True

    @property
    def launched(self) -> Bound[Any] | None:
        """Bound operation whose times on the device are measured."""
        owner = getattr(self.ours, "__self__", None)
        return owner if self.bound is None and isinstance(owner, Bound) else self.bound


def bind_with(operation: Operation[R], device: Device, *inputs: NDArray[Any]) -> Bound[R]:
    """Return a bound instance with these inputs, after one run."""
    bound = operation.bind(device, inputs[0].shape, inputs[0].dtype)
    for target, source in zip(bound.inputs, inputs, strict=True):
        target.set(source)
    bound.run()
    return bound


def traffic_of(bound: Bound[Any]) -> tuple[int, int]:
    """Return the bytes of the inputs and of the outputs of a bound operation: the least traffic of a call."""
    written = (each.nbytes for each in bound.outputs if each is not None)
    return sum(each.nbytes for each in bound.inputs), sum(written)


def measure(case: Case, device: Device, *, seconds: float = 2.0) -> list[Row]:
    """Measure our function, the peers and the limit of the device interleaved, for about ``seconds`` [s]."""
    calls = {(name, form): call for name, peer in case.peers.items() for form, call in _forms(peer).items()}
    calls[_OURS] = case.ours
    if case.traffic is not None and case.copied:
        calls[_CEILING] = ceiling.move(device, *case.traffic, case.repeats)
    recorder = None if case.launched is None else Recorder(case.launched, device)
    if recorder is not None:
        calls[_EVENTS] = recorder
    durations = take_turns(calls, seconds, always=_OURS)
    durations.pop(_EVENTS, None)
    times = {call: each * (case.factors.get(call[0], 1.0) / case.repeats) for call, each in durations.items()}
    ours = times.pop(_OURS)
    limit = times.pop(_CEILING, None)
    fraction = None if limit is None else float(np.nanmedian(limit / ours))
    common = _common_columns(case, device, ours, fraction, None if recorder is None else recorder.medians())
    return [
        replace(common, **_peer_columns(ours, peer, form, theirs))
        for (peer, form), theirs in _fastest_forms(times).items()
    ]


def _common_columns(
    case: Case, device: Device, ours: NDArray[Any], fraction: float | None, events: DeviceTimes | None
) -> Row:
    """Return a row without a peer."""
    return Row(
        operation=case.operation,
        case=case.name,
        device=device.label,
        seconds=float(np.median(ours)),
        peer="",
        peer_version="",
        peer_seconds=math.nan,
        ratio=math.nan,
        error=case.error,
        fraction=fraction,
        device_seconds=None if events is None else events.running,
        queued_seconds=None if events is None else events.queued,
        submitted_seconds=None if events is None else events.submitted,
        launched="" if case.launched is None else type(case.launched.operation).__name__,
        flops=case.flops,
        bytes=None if case.traffic is None else sum(case.traffic),
        metadata=case.metadata,
    )


def _peer_columns(ours: NDArray[Any], peer: str, form: str, theirs: NDArray[Any]) -> dict[str, Any]:
    ratios = (theirs / ours)[np.isfinite(theirs)]
    interval = median_interval(ratios)
    return {
        "peer": peer,
        "peer_version": peer_version(peer),
        "peer_seconds": float(np.nanmedian(theirs)),
        "ratio": float(np.median(ratios)),
        "form": form,
        "ratio_low": interval.low,
        "ratio_high": interval.high,
        "confidence": interval.confidence,
        "rounds": len(ratios),
    }


def _forms(peer: Peer) -> Mapping[str, Callable[[], object]]:
    return peer if isinstance(peer, Mapping) else {"": peer}


def _fastest_forms(times: Mapping[_Call, NDArray[Any]]) -> dict[_Call, NDArray[Any]]:
    """Return the times of the form of each peer that has the smallest median."""
    best: dict[str, _Call] = {}
    for call, durations in times.items():
        rival = best.setdefault(call[0], call)
        if np.nanmedian(durations) < np.nanmedian(times[rival]):
            best[call[0]] = call
    return {call: times[call] for call in best.values()}


def peer_version(peer: str) -> str:
    """Return the version of the package of a peer; "a+b" stands for two packages, and "a-plain" for a form of "a"."""
    packages = {"opencv": "opencv-contrib-python-headless"}
    names = [each.removesuffix("-plain") for each in peer.split("+") if each]
    return " + ".join(version(packages.get(name, name)) for name in names)


def profile(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    seconds: float = 2.0,
    total: float = math.inf,
    quick: bool = False,
    progress: Callable[[str], None] = lambda line: None,
) -> Run:
    """Measure the cases of the given operations on the given devices.

    An operation that raises an exception is added to the failures of the run; the other operations are still measured.

    Parameters
    ----------
    operations
        Names of modules in ``profiling``, each with a function ``cases(device)``.
    devices
        Devices to measure on.
    seconds
        Longest time to measure each case [s].
    total
        Approximate time of the whole run [s]. Cases are measured for a shorter time if the run would take longer. The
        preparation of the cases may alone take longer.
    quick
        Whether only one case of each operation is measured: see `QUICK_CASES`.
    progress
        Function that is called with lines of text about the progress.
    """
    rows: list[Row] = []
    failures: list[Failure] = []
    probes: list[Probe] = []
    machine = describe_machine(devices)
    known = [0.0 if quick else KNOWN_PREPARATION.get(operation, 0.0) for operation in operations for _ in devices]
    plan = TimePlan(total, seconds, known)
    for operation in operations:
        for device in devices:
            progress(f"{operation} on {device.label}")
            kept: list[Row] = []
            try:
                with plan.section():
                    for measured, probe in _attempts(operation, device, plan, quick, progress):
                        kept = measured
                        probes.append(probe)
            except Exception as error:
                failures.append(failure_of(operation, device, error))
                progress(f"  failed: {failures[-1].reason}")
            rows += kept  # of the last attempt that ended
    last = {(probe.operation, probe.device): probe.steady for probe in probes}
    return Run(rows, all(last.values()), machine, failures, probes, plan.elapsed)


def failure_of(operation: str, device: Device, error: Exception) -> Failure:
    """Return the description of an exception that the measurement of an operation raised."""
    reason = "".join(traceback.format_exception_only(error)).strip()
    return Failure(operation, device.label, reason, "".join(traceback.format_exception(error)))


def _attempts(
    operation: str, device: Device, plan: TimePlan, quick: bool, progress: Callable[[str], None]
) -> Iterator[tuple[list[Row], Probe]]:
    """Measure an operation on a device; again if the machine changed its speed meanwhile and the time suffices.

    Yields
    ------
    tuple of list of Row, and Probe
        Rows of each measurement, and speed of the machine before and after it.
    """
    for attempt in range(_ATTEMPTS):
        if attempt:
            if not plan.allows_repetition():
                break
            plan.repeat()
        before = ceiling.flop_rate(device)
        rows = []
        for case in _cases(operation, device, quick):
            rows += measure(case, device, seconds=plan.grant())
        probe = probe_of(operation, device, before)
        yield [_with_flop_fraction(row, 0.5 * (before + probe.after)) for row in rows], probe
        if probe.steady:
            break
        change = f"{before / 1e9:.0f} -> {probe.after / 1e9:.0f} GFLOP/s"
        progress(f"  {change}: the machine changed its speed ({attempt + 1})")


def probe_of(operation: str, device: Device, before: float) -> Probe:
    """Measure the FLOP rate of a device after a measurement; `before` is the rate before it [FLOP/s]."""
    after = ceiling.flop_rate(device)
    return Probe(operation, device.label, before, after, abs(after / before - 1.0) <= _STEADY)


def _with_flop_fraction(row: Row, rate: float) -> Row:
    return row if row.flops is None else replace(row, flop_fraction=row.flops / row.seconds / rate)


def _cases(operation: str, device: Device, quick: bool) -> Iterator[Case]:
    """Yield the cases of an operation, one at a time: their arrays may fill the memory."""
    module = importlib.import_module(f"gpuvision.profiling.{OPERATIONS[operation]}")
    numba_cache.keep_compiled(module)
    if not quick:
        yield from module.cases(device)
        return
    chosen = QUICK_CASES.get(operation)
    found = module.cases(device, **QUICK_SETTINGS.get(operation, {}))
    case = next((each for each in found if chosen in (None, each.name)), None)
    if case is not None:
        yield case  # `found` is still referenced: the case may use what its generator holds open
    elif chosen is not None:
        raise LookupError(f"{operation} has no case {chosen!r} on {device.label}, see QUICK_CASES")
