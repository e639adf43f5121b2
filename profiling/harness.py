"""Measure candidates side by side.

Absolute times lie on a shared machine: it changes its speed by a factor of two within minutes. So the candidates of a
case take turns within each round, a ratio is the median over rounds of the ratio within a round, and a section whose
FLOP rate differs before and after is measured again.
"""

from __future__ import annotations

import datetime
import importlib
import json
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.host import Device
from gpuvision.host.files import write_whole
from gpuvision.profiling import ceiling

OPERATIONS = (
    "psd",
    "line",
    "triangulation",
    "range_image",
    "undistort",
    "points",
    "calibration",
    "reflections",
    "reflectance",
    "mirrors",
    "bvh",
    "visible_intervals",
    "simulate",
    "light_clustering",
    "field",
    "ruler",
    "blob",
    "line_fit",
    "pose",
    "registration",
    "mitsuba",
    "launch",
    "stream",
)
_ROUND_LIMITS = (7, 101)
_WARM_UP = 1e-3  # s
_CALLS_PER_TURN = 3
_STEADY = 0.2
_ATTEMPTS = 4


@dataclass(frozen=True)
class Case:
    """One row or more to measure: our call, and peers that do the same work on the same input.

    Attributes
    ----------
    operation, name
        As in the rows; names stay stable, they are tracked over time.
    ours
        A call that does the work and waits for it.
    peers
        Calls by the peer's name (``numba``, ``numpy``, ``opencv``, ``pyopencl``).
    error
        Our largest error against float64, in the output's unit, measured on the case's own input.
    traffic
        Bytes (read, written) that the work needs at least, for the fraction of the device's limit.
    repeats
        How often every call does the work back to back; a row's times are for one.
    facts
        More columns for the row (latencies, rates).
    factors
        What the measured time of a peer, by name, is multiplied with, where all of its work would take too long; the
        facts say how the factor was found.
    """

    operation: str
    name: str
    ours: Callable[[], object]
    peers: Mapping[str, Callable[[], object]]
    error: float
    traffic: tuple[int, int] | None = None
    repeats: int = 1
    facts: Mapping[str, Any] = field(default_factory=dict)
    factors: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Row:
    """One measured comparison; ``ratio`` is the peer's time over ours, more than 1 where we are faster."""

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
    facts: Mapping[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the row as JSON takes it, the facts beside the other columns."""
        table = asdict(self)
        return {key: value for key, value in table.items() if key != "facts"} | dict(self.facts)


@dataclass(frozen=True)
class Run:
    """Rows, and whether the machine held its speed while they were measured."""

    rows: Sequence[Row]
    valid: bool
    machine: Mapping[str, Any]

    def write(self, path: Path) -> None:
        """Write the run as JSON, whole or not at all."""
        rows = [row.to_dict() for row in self.rows]
        write_whole(path, json.dumps({"machine": self.machine, "valid": self.valid, "rows": rows}, indent=1) + "\n")


def measure(case: Case, device: Device, *, seconds: float = 2.0) -> list[Row]:
    """Let our call, the peers and the device's ceiling take turns for about so many seconds."""
    calls: dict[str, Callable[[], object]] = {"": case.ours, **case.peers}
    if case.traffic is not None:
        calls["ceiling"] = ceiling.move(device, *case.traffic, case.repeats)
    taken = _take_turns(calls, seconds)
    times = {name: np.array(each) * (case.factors.get(name, 1.0) / case.repeats) for name, each in taken.items()}
    ours = times.pop("")
    limit = times.pop("ceiling", None)
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
            facts=case.facts,
        )
        for peer, theirs in times.items()
    ]


def _take_turns(calls: Mapping[str, Callable[[], object]], seconds: float) -> dict[str, list[float]]:
    for call in calls.values():  # compiles, allocates, warms the caches
        call()
    start = time.perf_counter()
    _round(calls, 0)
    rounds = int(seconds / max(time.perf_counter() - start, 1e-6))
    low, high = _ROUND_LIMITS
    times: dict[str, list[float]] = {name: [] for name in calls}
    for number in range(min(max(rounds, low), high)):
        for name, taken in _round(calls, number).items():
            times[name].append(taken)
    return times


def _round(calls: Mapping[str, Callable[[], object]], number: int) -> dict[str, float]:
    """Give each call a turn, in another order each round: whoever follows a neighbour that fills the caches pays."""
    order = np.random.default_rng(number).permutation(list(calls))
    return {name: _turn(calls[name]) for name in order}


def _turn(call: Callable[[], object]) -> float:
    """Return the median of a few calls, after it had the machine for a moment and left the caches its own way."""
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
    """Return the version of the package a peer's name stands for."""
    packages = {"opencv": "opencv-contrib-python-headless"}
    return " + ".join(version(packages.get(each, each)) for each in peer.split("+") if each)


def profile(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    seconds: float = 2.0,
    told: Callable[[str], None] = lambda line: None,
    row_ready: Callable[[Row], None] = lambda row: None,
) -> Run:
    """Measure the cases of some operations on some devices.

    Parameters
    ----------
    operations
        Names of modules in ``profiling``, each with ``cases(device)``.
    devices
        Where to measure.
    seconds
        About how long to measure each case.
    told, row_ready
        Called with a line of progress, and with each row of a section that stands.
    """
    rows: list[Row] = []
    valid = True
    for operation in operations:
        for device in devices:
            told(f"{operation} on {device.label}")
            section, steady = _steady_section(operation, device, seconds, told)
            for row in section:
                row_ready(row)
            rows += section
            valid &= steady
    return Run(rows, valid, describe_machine(devices))


def _steady_section(
    operation: str, device: Device, seconds: float, told: Callable[[str], None]
) -> tuple[list[Row], bool]:
    """Measure a section; again when the machine changed its speed meanwhile."""
    module = importlib.import_module(f"gpuvision.profiling.{operation}")
    rows: list[Row] = []
    for attempt in range(_ATTEMPTS):
        before = ceiling.flop_rate(device)
        cases: Iterator[Case] = module.cases(device)
        rows = [row for case in cases for row in measure(case, device, seconds=seconds)]
        after = ceiling.flop_rate(device)
        if abs(after / before - 1.0) <= _STEADY:
            return rows, True
        told(f"  {before / 1e9:.0f} -> {after / 1e9:.0f} GFLOP/s: the machine changed its speed ({attempt + 1})")
    return rows, False


def describe_machine(devices: Sequence[Device]) -> dict[str, Any]:
    """Return what a reader needs to place the numbers."""
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
