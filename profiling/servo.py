"""Servo loop in wall-clock time: vision, observer and control of each frame, with the camera in another process.

A process renders frames of a board at a fixed rate, 128 x 128 to 256 x 256 pixels with the noise of a sensor, and moves
the camera as commanded (`gpuvision.profiling.servo_camera`). This process sleeps, polls shortly before the next frame,
measures 60 calipers (rulers) at the predicted pose (`FeatureSet.bind`), updates the observer, computes the command,
and writes it. The time of a frame runs from its publication until its command.

A frame is missed if a newer frame was published before it was taken. The frames of the camera are at least three
quarters of a period apart. A missed frame counts as interrupted if the frame before it needed less processor time than
the period: the loop was ready, but another program or the hypervisor had the core.

``python -m gpuvision.profiling.servo`` runs the loop alone: ``--seconds 60 --rate 1000 --device pocl``; with
``--empty`` without vision, observer and control, which shows the interruptions by the machine; with ``--highest`` it
searches the highest rate that the loop sustains, with ``--quick`` by runs of half a second. ``--priority`` sets the
real-time priority of both processes (`low_latency`), by default 10 where the user may; ``--cores`` their cores.
``gpuvision profile servo`` does both for a short time, and compares the vision with Numba and NumPy
(`gpuvision.profiling.feature_pose`).
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.feature_set import FeatureSet, choose_features
from gpuvision.matching.features.imaging import Imaging
from gpuvision.profiling import feature_pose
from gpuvision.profiling.harness import Case
from gpuvision.profiling.servo_camera import PIXEL, START, TARGET, Camera, board, camera_process
from gpuvision.servoing.low_latency import low_latency, real_time_is_allowed
from gpuvision.servoing.observer import MotionModel, PoseMeasurement, PoseObserver

SIZES = feature_pose.SIZES
RULERS = 60
_GAIN = 0.2  # of the proportional control, per frame
_STILL = np.zeros(3)
_BORDER = 14  # distance of the rulers' centres from the border of the frame [px]: half their length, and motion
_CASE_SECONDS, _CASE_RATE = 3.0, 1000.0
_TRIAL_SECONDS, _QUICK_SECONDS = 1.0, 0.5  # of a run in the search for the highest rate: in a case, and by --quick
_SETTLING_FRAMES = 20  # frames after a change of the rate that do not count
_LEAST_RATE, _MOST_RATE = 31.25, 32000.0  # limits of the search [1/s]
_BISECTIONS = 5  # the highest rate is found to a factor of 2^(1/32), 2 %
_ATTEMPTS = 2  # runs at a rate before it counts as not sustained: another process may have interrupted the first one
_DELIVERED = 0.98  # part of the wanted rate that the camera must publish
_PRIORITY = 10  # real-time priority of both processes where the user may set one


Limit = Literal["loop", "camera", "search"]
"""Reason why a rate is the highest one: the loop, the process that renders, or the range of the search."""


class HighestRate(NamedTuple):
    """Highest rate that a loop sustained.

    Attributes
    ----------
    rate : float
        Rate [1/s]; 0 if the least one was not sustained.
    limit : {"loop", "camera", "search"}
        Reason why a higher rate was not sustained. With "camera" the loop alone may sustain more.
    """

    rate: float
    limit: Limit


@dataclass(frozen=True)
class LoopTimes:
    """Times of a loop.

    Attributes
    ----------
    latencies : (frames,)
        Time from the publication of each frame until its command [us].
    computing : (frames,)
        Processor time of each frame [us].
    missed : int
        Frames that were replaced by newer ones before they were taken.
    interrupted : int
        Missed frames during which the loop was ready, but not on a core.
    camera_stalls : int
        Frames that the camera published a quarter of a period late or more. Not counted as missed.
    stolen_ms : float
        Time that the hypervisor took from all cores [ms], in steps of 10 ms; NaN if the system does not report it.
    refused : int
        Frames whose pose was refused.
    error : (3,)
        Distance of the last true pose from the target [m, m, rad].
    rate : float
        Rate at which the camera published the frames [1/s].
    """

    latencies: NDArray[np.float64]
    computing: NDArray[np.float64]
    missed: int
    interrupted: int
    camera_stalls: int
    stolen_ms: float
    refused: int
    error: NDArray[np.float64]
    rate: float

    def failure(self, rate: float) -> Limit | None:
        """Return the reason why the loop does not sustain a wanted rate [1/s], or None if it does.

        The loop sustains it if it missed no frame and its 99th percentile is at most the period. Otherwise "loop", or
        "camera" if the other process did not render as fast.
        """
        if self.rate < _DELIVERED * rate:
            return "camera"
        return "loop" if self.missed or self.summary["p99_us"] > 1e6 / rate else None

    @property
    def summary(self) -> dict[str, float]:
        """Percentiles [us] and counts."""
        p50, p99, most = np.percentile(self.latencies, (50, 99, 100)) if len(self.latencies) else (np.nan,) * 3
        busy = np.percentile(self.computing, (50, 99, 100)) if len(self.computing) else (np.nan,) * 3
        names = ("computing_p50_us", "computing_p99_us", "computing_max_us")
        return {
            "p50_us": float(p50),
            "p99_us": float(p99),
            "max_us": float(most),
            **{name: float(value) for name, value in zip(names, busy, strict=True)},
            "frames": len(self.latencies),
            "missed": self.missed,
            "interrupted": self.interrupted,
            "camera_stalls": self.camera_stalls,
            "stolen_ms": self.stolen_ms,
            "refused": self.refused,
        }


def features_of(artwork: Artwork, size: int) -> FeatureSet:
    """Return rulers that lie in a frame of size x size pixels."""
    half = (size / 2 - _BORDER) * PIXEL
    imaging = Imaging(pixel=PIXEL, blur_px=1.0, shift=20e-6, angle=3e-3)
    return choose_features(artwork, (TARGET[:2] - half, TARGET[:2] + half), imaging, budget=RULERS)


def _stolen_ms() -> float:
    """Return the time that the hypervisor has taken from all cores since the start of the system [ms], or NaN."""
    try:
        steal = int(Path("/proc/stat").read_text().split(maxsplit=9)[8])  # proc(5): the 8th number of the first line
    except (OSError, ValueError, IndexError):
        return math.nan
    return 1e3 * steal / os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class _Frames:
    """Times of the frames that a loop took [ns], in the order of the frames."""

    number: NDArray[np.int64]
    published: NDArray[np.int64]
    taken: NDArray[np.int64]
    commanded: NDArray[np.int64]
    computing: NDArray[np.int64]  # processor time from taken to commanded

    @staticmethod
    def empty(count: int) -> _Frames:
        # Ones: the first write to a page would cost a page fault inside the loop.
        return _Frames(*(np.ones(count, np.int64) for _ in range(5)))

    def times(self, rate: float, *, late: int, stolen_ms: float, refused: int, error: NDArray[np.float64]) -> LoopTimes:
        """Return the times of the loop at a wanted rate [1/s]."""
        skipped = np.diff(self.number) - 1
        was_interrupted = self.computing[:-1] < 1e9 / rate
        duration = max(1e-9 * float(self.published[-1] - self.published[0]), 1e-9)
        return LoopTimes(
            latencies=np.asarray(1e-3 * (self.commanded - self.published), np.float64),
            computing=np.asarray(1e-3 * self.computing, np.float64),
            missed=int(skipped.sum()),
            interrupted=int(skipped[was_interrupted].sum()),
            camera_stalls=late,
            stolen_ms=stolen_ms,
            refused=refused,
            error=error,
            rate=float(self.number[-1] - self.number[0]) / duration,
        )


class _Loop:
    """Loop over the frames of a camera, at one rate after another."""

    def __init__(self, device: Device, size: int, camera: Camera, *, is_empty: bool = False) -> None:
        self.camera, self.pose, self.is_empty = camera, TARGET + START, is_empty
        self.bound = features_of(board(), size).bind(
            device, (size, size), np.uint8, copper="bright", threshold=20.0, noise=2.0, etch_bias_sigma=0.0
        )

    def run(self, rate: float, seconds: float, *, settling: int = 0) -> LoopTimes:
        """Run at a rate [1/s] for some seconds and return the times, without the times of the first settling frames."""
        camera = self.camera
        # A random walk with the largest step of a frame, 3 um and 0.3 mrad: missed frames do not spoil the prediction.
        model = MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(9e-12 * rate, 9e-12 * rate, 9e-8 * rate))
        self.observer, self.now = PoseObserver(model), 1e-9 * time.perf_counter_ns()
        self.observer.reset(self.now, self.pose, np.diag((1e-10, 1e-10, 1e-6)))
        count = round(rate * seconds)
        frames, refused, late = _Frames.empty(count), 0, 0
        gain, late_after = _GAIN * rate, 1.25e9 / rate
        taken, stolen_before = camera.start(rate), _stolen_ms()
        for number in range(-settling, count):
            newest = camera.wait_after(taken)
            begun, busy = time.perf_counter_ns(), time.thread_time_ns()
            times = camera.published_ns(taken, newest)
            taken = newest
            is_refused = not self.is_empty and self._command(newest, times[-1], gain)
            if number < 0:
                continue
            frames.computing[number] = time.thread_time_ns() - busy
            frames.commanded[number] = time.perf_counter_ns()
            frames.number[number], frames.published[number], frames.taken[number] = newest, times[-1], begun
            refused += is_refused
            if number:
                late += sum(after - before > late_after for before, after in itertools.pairwise(times))
        stolen = _stolen_ms() - stolen_before
        return frames.times(rate, late=late, stolen_ms=stolen, refused=refused, error=camera.pose - TARGET)

    def _command(self, number: int, published: int, gain: float) -> bool:
        """Measure a frame and command the velocity; return whether the pose was refused."""
        exposed = 1e-9 * published
        found = self.bound(self.camera.frame(number), self.observer.estimate(max(exposed, self.now)).pose)
        self.now = 1e-9 * time.perf_counter_ns()
        status = int(to_numpy(found.status))
        measured = (np.array(found.pose, np.float64), np.array(found.covariance, np.float64))
        self.observer.add(PoseMeasurement(exposed, self.now, *measured, status))
        self.pose = self.observer.estimate(self.now).pose
        self.observer.command(self.now, _STILL)
        self.camera.velocity[:] = gain * (TARGET - self.pose) if status == 0 else _STILL
        return status != 0

    def highest_rate(self, start: float, seconds: float) -> HighestRate:
        """Search the highest sustained rate by runs of some seconds, from a rate on [1/s]."""

        def failure(rate: float) -> Limit | None:
            runs = (self.run(rate, seconds, settling=_SETTLING_FRAMES).failure(rate) for _ in range(_ATTEMPTS))
            reasons: list[Limit] = []
            for reason in runs:
                if reason is None:
                    return None
                reasons.append(reason)
            return reasons[-1]

        return search_highest(failure, start)


def search_highest(failure: Callable[[float], Limit | None], start: float) -> HighestRate:
    """Search the highest sustained rate by doubling or halving, then by bisection of the logarithm.

    Parameters
    ----------
    failure : function
        Returns the reason why a rate [1/s] is not sustained, or None.
    start : float
        First rate [1/s].
    """
    low, high, limit = 0.0, 0.0, failure(start)
    if limit is None:
        low, high, limit = start, 2.0 * start, "search"
        while high <= _MOST_RATE and (reason := failure(high)) is None:
            low, high = high, 2.0 * high
        if high > _MOST_RATE:
            return HighestRate(low, "search")
        limit = reason or limit
    else:
        low, high = 0.5 * start, start
        while low >= _LEAST_RATE and (reason := failure(low)) is not None:
            low, high, limit = 0.5 * low, low, reason
        if low < _LEAST_RATE:
            return HighestRate(0.0, limit)
    for _ in range(_BISECTIONS):
        middle = (low * high) ** 0.5
        reason = failure(middle)
        if reason is None:
            low = middle
        else:
            high, limit = middle, reason
    return HighestRate(low, limit)


class Placement(NamedTuple):
    """Cores and real-time priority of both processes.

    Attributes
    ----------
    loop, camera : int or None
        Core of the process; None: any.
    priority : int
        Real-time priority; 0: none.
    """

    loop: int | None = None
    camera: int | None = None
    priority: int = 0

    @staticmethod
    def default() -> Placement:
        """Return any core, with a real-time priority if the user may set one."""
        return Placement(priority=_PRIORITY if real_time_is_allowed() else 0)


@contextlib.contextmanager
def _loop(device: Device, size: int, placement: Placement | None = None, *, is_empty: bool = False) -> Iterator[_Loop]:
    """Start the camera and a loop; the body runs with low latency."""
    where = Placement.default() if placement is None else placement
    with camera_process(size, device, core=where.camera, priority=where.priority) as camera:
        loop = _Loop(device, size, camera, is_empty=is_empty)
        with low_latency(core=where.loop, priority=where.priority):
            yield loop


def run_loop(
    device: Device,
    size: int,
    *,
    rate: float,
    seconds: float,
    placement: Placement | None = None,
    is_empty: bool = False,
) -> LoopTimes:
    """Run the loop at a frame rate [1/s] for some seconds and return its times."""
    with _loop(device, size, placement, is_empty=is_empty) as loop:
        return loop.run(rate, seconds)


def highest_rate(
    device: Device, size: int, *, seconds: float, start: float = _CASE_RATE, placement: Placement | None = None
) -> HighestRate:
    """Search the highest rate at which the loop misses no frame and its 99th percentile is within the period.

    Parameters
    ----------
    device : Device
        Device of both processes.
    size : int
        Rows and columns of a frame [px].
    seconds : float
        Time of each of about 8 runs [s].
    start : float
        First rate [1/s].
    placement : Placement, optional
        Cores and priority. Default: `Placement.default`.
    """
    with _loop(device, size, placement) as loop:
        return loop.highest_rate(start, seconds)


def cases(device: Device) -> Iterator[Case]:
    """Yield the vision alone with its peers; the metadata is of a loop at 1 kHz, and of its highest rate."""
    for case in feature_pose.cases(device):
        with _loop(device, int(case.name)) as loop:
            times = {f"loop_{name}": value for name, value in loop.run(_CASE_RATE, _CASE_SECONDS).summary.items()}
            highest = loop.highest_rate(_CASE_RATE, _TRIAL_SECONDS)
        rates = {"loop_highest_hz": highest.rate, "loop_highest_limit": highest.limit}
        metadata = {**case.metadata, **times, **rates}
        yield replace(case, metadata=metadata)


def main() -> None:
    """Run the loop alone and print its times."""
    parser = argparse.ArgumentParser(description="Servo loop in wall-clock time, with the camera in another process")
    parser.add_argument("--device", default=None, help="label of the device; default: the best one")
    parser.add_argument("--seconds", type=float, default=None, help="time of a run; default: 60, with --highest 5")
    parser.add_argument("--rate", type=float, default=_CASE_RATE, help="frames per second; of --highest the first")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="rows and columns [px]")
    parser.add_argument("--highest", action="store_true", help="search the highest rate that the loop sustains")
    parser.add_argument("--quick", action="store_true", help="runs of half a second")
    parser.add_argument("--empty", action="store_true", help="take the frames and compute nothing")
    parser.add_argument(
        "--priority", type=int, default=None, help="real-time priority; 0: none; default: 10 if allowed"
    )
    parser.add_argument(
        "--cores", type=int, nargs=2, default=(None, None), help="cores of loop and camera; default: any"
    )
    options = parser.parse_args()
    device = Device.best() if options.device is None else Device.named(options.device)
    seconds = options.seconds or (_QUICK_SECONDS if options.quick else 5.0 if options.highest else 60.0)
    priority = Placement.default().priority if options.priority is None else options.priority
    loop_core, camera_core = options.cores
    placement = Placement(loop_core, camera_core, priority)
    for size in options.sizes:
        if options.highest:
            highest = highest_rate(device, size, seconds=seconds, start=options.rate, placement=placement)
            print(size, f"highest rate {highest.rate:.0f} Hz, limited by the {highest.limit}")
            continue
        times = run_loop(device, size, rate=options.rate, seconds=seconds, placement=placement, is_empty=options.empty)
        error = ", ".join(f"{each:+.2e}" for each in times.error)
        print(size, {name: round(value, 1) for name, value in times.summary.items()}, f"error {error}")


if __name__ == "__main__":
    main()
