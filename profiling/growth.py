"""Time against size: an operation from one item to a limit of memory, and the knees of the curve.

A curve has up to three parts. Up to the launch knee the time is that of a launch. Then it grows with the number of
items, at the rate of the arithmetic or of the caches. Beyond the cache knee, the size at which inputs and outputs
exceed the largest cache, operations with little arithmetic run at the rate of the memory.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, Operation
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.profiling import (
    ceiling,
    line,
    line_fit,
    line_irradiance,
    psd,
    rays,
    ruler,
    ruler_peers,
    triangulation,
    undistort_points,
)
from gpuvision.profiling.harness import bind_with, failure_of, probe_of
from gpuvision.profiling.machine import describe_machine
from gpuvision.profiling.rounds import median_interval, take_turns
from gpuvision.profiling.run import Failure, Probe
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.merge_heights import MergeHeights
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.reflectance import Ggx, Reflectance
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LineIrradiance

Inputs = Sequence[NDArray[Any]]
_DISTINCT = 1 << 16  # items that differ; larger inputs repeat them
_GROWTH = 4  # factor from one size to the next
_LONGEST = 1.0  # duration of a call after which an operation is not measured with more items [s]


@dataclass(frozen=True)
class Workload:
    """Operation on a number of items.

    Attributes
    ----------
    item
        Name of an item.
    operation
        Function that returns the operation for a number of items.
    samples
        Inputs with items that differ. Larger inputs repeat them.
    axes
        Axis of the items in each input; None: the input is the same for each number of items.
    """

    item: str
    operation: Callable[[int], Operation[Any]]
    samples: Inputs
    axes: Sequence[int | None]

    def first_shape(self, items: int) -> tuple[int, ...]:
        """Return the shape of the first input for a number of items."""
        shape, axis = self.samples[0].shape, self.axes[0]
        return shape if axis is None else (*shape[:axis], items, *shape[axis + 1 :])

    def inputs(self, items: int) -> Inputs:
        """Return the inputs for a number of items."""
        return [
            each if axis is None else np.ascontiguousarray(np.take(each, np.arange(items), axis=axis, mode="wrap"))
            for each, axis in zip(self.samples, self.axes, strict=True)
        ]


@dataclass(frozen=True)
class Point:
    """Time for one size.

    Attributes
    ----------
    operation, device, item
        Names of the operation, of the device and of an item.
    items
        Number of items.
    bytes
        Memory of inputs and outputs [bytes].
    seconds, low, high
        Median time of a call, and its 95 % confidence interval [s].
    """

    operation: str
    device: str
    item: str
    items: int
    bytes: int
    seconds: float
    low: float
    high: float


def _repeated(item: str, operation: Operation[Any], samples: Inputs, axis: int = 0) -> Workload:
    """Return the workload of an operation that is the same for each number of items."""
    return Workload(item, lambda _: operation, samples, [axis] * len(samples))


def _rulers(items: int) -> Operation[Any]:
    return RulerEdges(
        threshold=ruler.THRESHOLD,
        length=ruler_peers.LENGTH,
        width=ruler_peers.WIDTH,
        smoothing_px=ruler.SMOOTHING,
        count=items,
    )


def _heights() -> Inputs:
    rng = np.random.default_rng(1)
    z = rng.uniform(-5e-3, 5e-3, (2, _DISTINCT)).astype(np.float32)
    ones, ok = np.ones(_DISTINCT, np.float32), np.zeros(_DISTINCT, np.uint8)
    return [z[0], ones, ok, z[1], ones, ok]


def workloads() -> dict[str, Workload]:
    """Return the workloads by the name of the operation; inputs as in the benchmarks."""
    rng = np.random.default_rng(2)
    readout = PsdReadout(
        strip_length=psd.LENGTH,
        minimum_total=psd.MINIMUM,
        saturation=psd.SATURATION,
        layout="planar",
        outputs=("position", "status"),
    )
    places = [rng.uniform(*bounds, _DISTINCT).astype(np.float32) for bounds in triangulation.REGION]
    sheet = Triangulation(homography=triangulation.HOMOGRAPHY, region=triangulation.REGION)
    pixels = rng.uniform(0.0, 1000.0, (_DISTINCT, 2)).astype(np.float32)
    directions = rng.normal(size=(_DISTINCT, 6)).astype(np.float32)
    directions[:, [2, 5]] = np.abs(directions[:, [2, 5]])
    mesh = rays.board(0)
    scene, shadow, view = Scene.of(mesh), rays.shadow_segments(mesh, False), rays.view_rays(mesh)
    segments, receivers = line_irradiance.wall(64, _DISTINCT)
    lines = FitLines(scale=1.0, weighted=True, max_trials=line_fit.TRIALS, max_iterations=line_fit.STEPS)
    return {
        "psd": _repeated("sample", readout, [psd.scan_currents("float32", _DISTINCT)], axis=1),
        "line": _repeated("frame", LineReadout(method="centroid"), [line.line_frames(4)]),
        "triangulation": _repeated("point", sheet, places),
        "merge_heights": _repeated("cell", MergeHeights(sigma=False, tolerance=1e-4), _heights()),
        "points": _repeated("point", UndistortPoints(model=undistort_points.STANDARD), [pixels]),
        "line_fit": _repeated("line", lines, line_fit.scene(20)),
        "ruler": Workload("ruler", _rulers, ruler.scene(_DISTINCT), (None, 0)),
        "reflectance": _repeated("direction", Reflectance(model=Ggx(alpha=0.2, f0=0.9)), [directions]),
        "reflections": _repeated("receiver", LineIrradiance(segments=segments), [receivers]),
        "any_hit": _repeated("ray", AnyHit(scene=scene), [shadow]),
        "closest_hit": _repeated("ray", ClosestHit(scene=scene), [view]),
    }


def measure_growth(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    memory: int,
    seconds: float = 0.1,
    progress: Callable[[str], None] = lambda line: None,
) -> Growth:
    """Measure operations from one item to a limit of memory.

    An operation that raises an exception is added to the failures; the other operations are still measured.

    Parameters
    ----------
    operations
        Names of `workloads`; none: all.
    devices
        Devices to measure on.
    memory
        Largest memory of the inputs and outputs of an operation [bytes].
    seconds
        Approximate time for each size [s].
    progress
        Function that is called with lines of text about the progress.
    """
    points: list[Point] = []
    probes: list[Probe] = []
    failures: list[Failure] = []
    known = workloads()
    machine = describe_machine(devices)  # before the measurement: a device without times fails at once
    for name in operations or known:
        for device in devices:
            progress(f"{name} on {device.label}")
            try:
                before = ceiling.flop_rate(device)
                curve = list(_curve(name, known[name], device, memory, seconds))
                probes.append(probe_of(name, device, before))
            except Exception as error:
                failures.append(failure_of(name, device, error))
                progress(f"  failed: {failures[-1].reason}")
                continue
            points += curve
            if not curve:
                progress(f"  not measured: inputs and outputs of one {known[name].item} exceed {memory} bytes")
    return Growth(points, probes, {each.label: each.cache_bytes for each in devices}, machine, failures)


def _curve(name: str, workload: Workload, device: Device, memory: int, seconds: float) -> Iterator[Point]:
    items = 1
    while True:
        operation = workload.operation(items)
        size = operation.specs(device, workload.first_shape(items), workload.samples[0].dtype).nbytes
        if size > memory:
            return
        bound = bind_with(operation, device, *workload.inputs(items))
        times = take_turns({"": bound.run}, seconds, always="")[""]
        interval = median_interval(times)
        median = float(np.median(times))
        yield Point(name, device.label, workload.item, items, size, median, interval.low, interval.high)
        if median > _LONGEST:
            return
        items *= _GROWTH


def launch_knee(points: Sequence[Point]) -> float | None:
    """Return the number of items from which a call takes twice the shortest time; None if no size takes as long.

    A few items may take longer than more of them: fewer than a vector run as single work-items.
    """
    shortest = min(range(len(points)), key=lambda place: points[place].seconds)
    limit = 2.0 * points[shortest].seconds
    for before, after in itertools.pairwise(points[shortest:]):
        if after.seconds >= limit:
            logs = np.log([before.seconds, after.seconds])
            return float(np.exp(np.interp(np.log(limit), logs, np.log([before.items, after.items]))))
    return None


def cache_knee(points: Sequence[Point], cache: int) -> float | None:
    """Return the number of items whose inputs and outputs fill a cache [bytes]; None if all of them fit.

    If already the first point exceeds the cache, its number of items is returned.
    """
    if points[0].bytes >= cache:
        return float(points[0].items)
    for before, after in itertools.pairwise(points):
        if after.bytes >= cache > before.bytes:
            return float(np.interp(cache, [before.bytes, after.bytes], [before.items, after.items]))
    return None


@dataclass(frozen=True)
class Growth:
    """Curves of time against size.

    Attributes
    ----------
    points
        Measured points, in ascending order of the items of each operation and device.
    probes
        Speed of the machine before and after each curve.
    caches
        Last-level cache by the label of the device, at least 32 MiB: see `Device.cache_bytes` [bytes].
    machine
        Description of the machine, see `machine.describe_machine`.
    failures
        Operations without points, because their measurement raised an exception.
    """

    points: Sequence[Point]
    probes: Sequence[Probe]
    caches: Mapping[str, int]
    machine: Mapping[str, Any]
    failures: Sequence[Failure] = ()

    @property
    def curves(self) -> dict[tuple[str, str], list[Point]]:
        """Points by operation and device."""
        found: dict[tuple[str, str], list[Point]] = {}
        for point in self.points:
            found.setdefault((point.operation, point.device), []).append(point)
        return found

    def lines(self) -> list[str]:
        """Return a line of text for each curve: first time, knees, and rate at the end."""
        return [self._line(curve) for curve in self.curves.values()]

    def _line(self, curve: Sequence[Point]) -> str:
        first, last = curve[0], curve[-1]
        launch, cache = launch_knee(curve), cache_knee(curve, self.caches[first.device])
        rate = last.items / last.seconds
        shortest = min(point.seconds for point in curve)
        return (
            f"{first.operation} on {first.device}: {first.seconds * 1e6:.1f} µs for one {first.item}, "
            f"{shortest * 1e6:.1f} µs at least, twice as long from {_count(launch)}, "
            f"beyond the cache from {_count(cache)}; {rate:.3g} {first.item}s/s and "
            f"{last.bytes / last.seconds / 1e9:.2g} GB/s for {last.items}"
        )

    def to_json(self) -> str:
        """Return the curves as JSON."""
        table = {
            "machine": self.machine,
            "caches": self.caches,
            "probes": [asdict(probe) for probe in self.probes],
            "failures": [asdict(failure) for failure in self.failures],
            "growth": [asdict(point) for point in self.points],
        }
        return json.dumps(table, indent=1) + "\n"


def _count(items: float | None) -> str:
    return "no measured size" if items is None else f"{items:.3g}"
