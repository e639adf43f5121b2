"""Benchmark harness: measure our operation and its peers interleaved.

Absolute times on a shared machine are unreliable: its speed changes by a factor of two within minutes. Therefore the
candidates of a case run in turn within each round, a ratio is the median over the rounds of the ratio within a round,
and a section is measured again if the FLOP rate of the machine differs before and after it.
"""

from __future__ import annotations

import datetime
import importlib
import json
import platform
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.host.outputs import Outputs
from gpuvision.profiling import ceiling

# Benchmarked operations: name in the rows, and module of this package that measures it. Some modules also yield cases
# of related operations. The names stay stable when modules are renamed, because results are compared over time.
OPERATIONS = {
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
    "servo": "servo",
    "registration": "registration",
    "mitsuba": "mitsuba",
    "launch": "launch",
    "stream": "stream",
}
_ROUND_LIMITS = (7, 101)  # smallest and largest number of rounds
_WARM_UP = 1e-3  # duration of untimed calls before a timed one [s]
_CALLS_PER_TURN = 3
_STEADY = 0.2  # largest relative change of the FLOP rate during a valid section
_ATTEMPTS = 4  # measurements of a section before the run is marked invalid
_Call = tuple[str, str]  # names of a peer and of its form
_OURS: _Call = ("", "")
_CEILING: _Call = ("ceiling", "")

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
        Least number of bytes (read, written) of the work, for the fraction of the device's limit; None: no fraction.
    repeats
        Number of times that each function does the work back to back; the times in a row are for one.
    metadata
        Additional columns of the row (latencies, rates).
    factors
        Factors, by the name of the peer, that multiply the measured time of a peer which does only a part of the work,
        because all of it would take too long. The module of the case documents the origin of a factor.
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


@dataclass(frozen=True)
class Row:
    """Result of one comparison.

    Attributes
    ----------
    operation, case, device, peer, peer_version
        Names of the operation, the case, the device and the peer, and the version of the peer.
    seconds, peer_seconds
        Median times of our function and of the peer [s].
    ratio
        Time of the peer over our time, median over the rounds; above 1 if we are faster.
    error
        Our largest error, see `Case`.
    fraction
        Time of a copy with the same traffic over our time; None if the case gives no traffic.
    form
        Fastest form of the peer; empty if the peer has one form.
    metadata
        Additional columns.
    """

    operation: str
    case: str
    device: str
    seconds: float
    peer: str
    peer_version: str
    peer_seconds: float
    ratio: float
    error: float
    fraction: float | None
    form: str = ""
    metadata: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name; the columns of the metadata are the last ones."""
        table = asdict(self)
        return {key: value for key, value in table.items() if key != "metadata"} | dict(self.metadata)


@dataclass(frozen=True)
class Failure:
    """Operation whose benchmark raised an exception. Its rows on the device are missing.

    Attributes
    ----------
    operation, device
        Name of the operation, and label of the device.
    reason
        Type and message of the exception.
    traceback
        Traceback of the exception.
    """

    operation: str
    device: str
    reason: str
    traceback: str


@dataclass(frozen=True)
class Run:
    """Rows of a benchmark run.

    Attributes
    ----------
    rows
        Measured comparisons.
    valid
        Whether the machine held its speed during the measurement.
    machine
        Description of the machine, see `describe_machine`.
    failures
        Operations without rows, because their benchmark raised an exception.
    """

    rows: Sequence[Row]
    valid: bool
    machine: Mapping[str, Any]
    failures: Sequence[Failure] = ()

    def to_json(self) -> str:
        """Return the run as JSON."""
        table = {
            "machine": self.machine,
            "valid": self.valid,
            "failures": [asdict(failure) for failure in self.failures],
            "rows": [row.to_dict() for row in self.rows],
        }
        return json.dumps(table, indent=1) + "\n"

    def write(self, path: Path, *, overwrite: bool = False) -> None:
        """Write the run as JSON; on an error no file is written.

        With `overwrite` it may replace a file that no earlier profile wrote.
        """
        Outputs("profile", overwrite=overwrite).write_text(path, self.to_json())


def measure(case: Case, device: Device, *, seconds: float = 2.0) -> list[Row]:
    """Measure our function, the peers and the limit of the device interleaved, for about ``seconds`` [s]."""
    calls = {(name, form): call for name, peer in case.peers.items() for form, call in _forms(peer).items()}
    calls[_OURS] = case.ours
    if case.traffic is not None:
        calls[_CEILING] = ceiling.move(device, *case.traffic, case.repeats)
    durations = _take_turns(calls, seconds)
    times = {call: np.array(each) * (case.factors.get(call[0], 1.0) / case.repeats) for call, each in durations.items()}
    ours = times.pop(_OURS)
    limit = times.pop(_CEILING, None)
    fraction = None if limit is None else float(np.median(limit / ours))
    return [
        Row(
            operation=case.operation,
            case=case.name,
            device=device.label,
            seconds=float(np.median(ours)),
            peer=peer,
            peer_version=peer_version(peer),
            peer_seconds=float(np.median(theirs)),
            ratio=float(np.median(theirs / ours)),
            error=case.error,
            fraction=fraction,
            form=form,
            metadata=case.metadata,
        )
        for (peer, form), theirs in _fastest_forms(times).items()
    ]


def _forms(peer: Peer) -> Mapping[str, Callable[[], object]]:
    return peer if isinstance(peer, Mapping) else {"": peer}


def _fastest_forms(times: Mapping[_Call, NDArray[Any]]) -> dict[_Call, NDArray[Any]]:
    """Return the times of the form of each peer that has the smallest median."""
    best: dict[str, _Call] = {}
    for call, durations in times.items():
        rival = best.setdefault(call[0], call)
        if np.median(durations) < np.median(times[rival]):
            best[call[0]] = call
    return {call: times[call] for call in best.values()}


def _take_turns(calls: Mapping[_Call, Callable[[], object]], seconds: float) -> dict[_Call, list[float]]:
    for call in calls.values():  # compiles, allocates, warms the caches
        call()
    start = time.perf_counter()
    _round(calls, 0)
    rounds = int(seconds / max(time.perf_counter() - start, 1e-6))
    low, high = _ROUND_LIMITS
    times: dict[_Call, list[float]] = {name: [] for name in calls}
    for number in range(min(max(rounds, low), high)):
        for name, duration in _round(calls, number).items():
            times[name].append(duration)
    return times


def _round(calls: Mapping[_Call, Callable[[], object]], number: int) -> dict[_Call, float]:
    """Time each function once, in a different order each round: a predecessor that fills the caches costs time."""
    names = list(calls)
    order = np.random.default_rng(number).permutation(len(names))
    return {names[place]: _turn(calls[names[place]]) for place in order}


def _turn(call: Callable[[], object]) -> float:
    """Return the median time of a few calls [s], after untimed calls that fill the caches with the data of `call`."""
    begun = time.perf_counter()
    call()
    while time.perf_counter() - begun < _WARM_UP:
        call()
    times = []
    for _ in range(_CALLS_PER_TURN):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return float(np.median(times))


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
        Approximate time to measure each case [s].
    progress
        Function that is called with lines of text about the progress.
    """
    rows: list[Row] = []
    failures: list[Failure] = []
    valid = True
    for operation in operations:
        for device in devices:
            progress(f"{operation} on {device.label}")
            try:
                section, steady = _steady_section(operation, device, seconds, progress)
            except Exception as error:
                failures.append(_failure(operation, device, error))
                progress(f"  failed: {failures[-1].reason}")
                continue
            rows += section
            valid &= steady
    return Run(rows, valid, describe_machine(devices), failures)


def _failure(operation: str, device: Device, error: Exception) -> Failure:
    reason = "".join(traceback.format_exception_only(error)).strip()
    return Failure(operation, device.label, reason, "".join(traceback.format_exception(error)))


def _steady_section(
    operation: str, device: Device, seconds: float, progress: Callable[[str], None]
) -> tuple[list[Row], bool]:
    """Measure an operation on a device; again if the machine changed its speed meanwhile. Return rows and validity."""
    module = importlib.import_module(f"gpuvision.profiling.{OPERATIONS[operation]}")
    rows: list[Row] = []
    for attempt in range(_ATTEMPTS):
        before = ceiling.flop_rate(device)
        cases: Iterator[Case] = module.cases(device)
        rows = [row for case in cases for row in measure(case, device, seconds=seconds)]
        after = ceiling.flop_rate(device)
        if abs(after / before - 1.0) <= _STEADY:
            return rows, True
        progress(f"  {before / 1e9:.0f} -> {after / 1e9:.0f} GFLOP/s: the machine changed its speed ({attempt + 1})")
    return rows, False


def describe_machine(devices: Sequence[Device]) -> dict[str, Any]:
    """Return date, processor, system, versions and devices, which the times depend on."""
    return {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "processor": _processor(),
        "system": platform.platform(terse=True),
        "python": platform.python_version(),
        "packages": {name: version(name) for name in ("gpuvision", "numpy", "pyopencl", "numba")},
        "devices": {
            each.label: {
                "name": each.name,
                "driver": each.driver,
                "units": each.compute_units,
                "gflops": round(ceiling.flop_rate(each) / 1e9),
            }
            for each in devices
        },
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
