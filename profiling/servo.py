"""Servo loop in wall-clock time: vision, observer and control of each frame, with the camera in another process.

A process renders frames of a board at a fixed rate, 128 x 128 to 256 x 256 pixels with the noise of a sensor, and moves
the camera as commanded. This process waits for a frame, measures 60 calipers (rulers; 48 in the smallest frame) at the
predicted pose (`FeatureSet.bind`), updates the observer, computes the command, and writes it. The time of a frame runs
from its publication until its command. A frame is missed if a newer frame was published before it was taken.

``python -m gpuvision.profiling.servo`` runs the loop alone: ``--seconds 60 --rate 1000 --device pocl``; with
``--highest`` it searches the highest rate that the loop sustains, with ``--quick`` by runs of half a second.
``gpuvision profile servo`` does both for a short time, and compares the vision with Numba and NumPy
(`gpuvision.profiling.feature_pose`).
"""

from __future__ import annotations

import argparse
import contextlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.host import Device, host_view, to_numpy
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.features.feature_set import FeatureSet, choose_features
from gpuvision.matching.features.imaging import Imaging
from gpuvision.profiling import feature_pose
from gpuvision.profiling.harness import Case
from gpuvision.servoing.observer import MotionModel, PoseMeasurement, PoseObserver
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

SIZES = feature_pose.SIZES
PIXEL, RULERS = 10e-6, 60
TARGET = np.array([3e-3, 3e-3, 0.0])  # pose of the camera that the loop holds [m, m, rad]
_START = np.array([15e-6, -12e-6, 1.5e-3])  # distance of the first pose from it
_GAIN = 0.2  # of the proportional control, per frame
_PAD, _PITCH = 0.3e-3, 0.55e-3  # m
_BORDER = 14  # distance of the rulers' centres from the border of the frame [px]: half their length, and motion
_SLOTS = 4  # frames in shared memory
_CASE_SECONDS, _CASE_RATE = 3.0, 1000.0
_TRIAL_SECONDS, _QUICK_SECONDS = 1.0, 0.5  # of a run in the search for the highest rate: in a case, and by --quick
_SETTLING_FRAMES = 20  # frames after a change of the rate that do not count
_LEAST_RATE, _MOST_RATE = 31.25, 32000.0  # limits of the search [1/s]
_BISECTIONS = 5  # the highest rate is found to a factor of 2^(1/32), 2 %
_ATTEMPTS = 2  # runs at a rate before it counts as not sustained: another process may have interrupted the first one
_DELIVERED = 0.98  # part of the wanted rate that the camera must publish
_READY_S = 120.0  # longest start of the other process: it compiles the renderer


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
    missed : int
        Frames that were replaced by newer ones before they were taken.
    refused : int
        Frames whose pose was refused.
    error : (3,)
        Distance of the last true pose from the target [m, m, rad].
    rate : float
        Rate at which the camera published the frames [1/s].
    """

    latencies: NDArray[np.float64]
    missed: int
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
        counts = {"frames": len(self.latencies), "missed": self.missed, "refused": self.refused}
        return {"p50_us": float(p50), "p99_us": float(p99), "max_us": float(most), **counts}


def board() -> Artwork:
    """Return a board of 6 x 6 mm with square pads."""
    places = np.arange(0.5e-3, 5.6e-3, _PITCH)
    flashes = [f"X{round(1e9 * x)}Y{round(1e9 * y)}D03*" for x in places for y in places]
    head, end = ["%FSLAX46Y46*%", "%MOMM*%", "%LPD*%", "G01*"], ["M02*", ""]
    corners = [(0, 0), (6, 0), (6, 6), (0, 6), (0, 0)]
    border = [f"X{x * 10**6}Y{y * 10**6}D0{1 if number else 2}*" for number, (x, y) in enumerate(corners)]
    side = 1e3 * _PAD
    with tempfile.TemporaryDirectory() as folder:
        copper = [*head, f"%ADD10R,{side:g}X{side:g}*%", "D10*", *flashes, *end]
        Path(folder, "copper.gbr").write_text("\n".join(copper))
        Path(folder, "outline.gbr").write_text("\n".join([*head, "%ADD10C,0.1*%", "D10*", *border, *end]))
        return read_artwork(folder, layers={"copper.gbr": "top copper", "outline.gbr": "mechanical outline"})


def features_of(artwork: Artwork, size: int) -> FeatureSet:
    """Return rulers that lie in a frame of size x size pixels."""
    half = (size / 2 - _BORDER) * PIXEL
    imaging = Imaging(pixel=PIXEL, blur_px=1.0, shift=20e-6, angle=3e-3)
    return choose_features(artwork, (TARGET[:2] - half, TARGET[:2] + half), imaging, budget=RULERS)


class _Shared:
    """Memory of both processes: header, commanded velocity, true pose, times, and the ring of frames."""

    def __init__(self, size: int, name: str | None = None) -> None:
        numbers = 8 * (4 + 3 + 3 + _SLOTS + 1)
        self.memory = SharedMemory(name=name, create=name is None, size=numbers + _SLOTS * size * size)
        buffer = self.memory.buf
        self.header: Any = np.ndarray(4, np.int64, buffer)  # number of the newest frame, ready, run, stop
        self.velocity: Any = np.ndarray(3, np.float64, buffer, 32)
        self.pose: Any = np.ndarray(3, np.float64, buffer, 56)
        self.times: Any = np.ndarray(_SLOTS, np.int64, buffer, 80)
        self.step: Any = np.ndarray(1, np.float64, buffer, numbers - 8)  # time between two frames [s]
        self.frames: Any = np.ndarray((_SLOTS, size, size), np.uint8, buffer, numbers)

    def close(self) -> None:
        """Release the memory; views of it must be gone."""
        self.header = self.velocity = self.pose = self.times = self.step = self.frames = None
        self.memory.close()


def _render(name: str, size: int, label: str) -> None:
    """Render frames at the wanted rate and move the camera as commanded, until the stop; runs in another process."""
    shared, device = _Shared(size, name), Device.named(label)
    box = (tuple(TARGET[:2] - 2e-3), tuple(TARGET[:2] + 2e-3))
    values = ReflectanceMap.of(board(), pixel=PIXEL, region=box)
    operation = RenderBoard(board=values, shape=(size, size), sensor=read_cmos_sensor("pb1024"))
    queue = device.new_queue(inline=device.has_inline_queues)
    bound = operation.bind(device, (1, 1, 3), np.float64, queue=queue)
    pose = TARGET + _START
    outputs: Any = bound.outputs
    poses, numbers, image = (host_view(each) for each in (*bound.inputs, outputs.image))
    shared.header[0], shared.header[1] = -1, 1
    while not shared.header[2]:
        time.sleep(1e-3)
    due, number = time.perf_counter_ns(), 0
    while not shared.header[3]:
        poses[0, 0], numbers[0], step = pose, number, float(shared.step[0])
        bound.run()
        while time.perf_counter_ns() < due:
            os.sched_yield()
        slot = number % _SLOTS
        shared.frames[slot] = image[0]
        shared.pose[:] = pose
        shared.times[slot] = time.perf_counter_ns()
        shared.header[0] = number
        pose = pose + step * shared.velocity
        shared.velocity[:] = 0.0  # a command holds for one frame: without a new one the camera stands still
        number, due = number + 1, max(due + round(1e9 * step), time.perf_counter_ns() - round(1e9 * step))
    shared.close()


@contextlib.contextmanager
def _camera(size: int, device: Device) -> Iterator[_Shared]:
    """Start the process that renders, and end it."""
    shared = _Shared(size)
    arguments = (shared.memory.name, size, device.label)
    process = multiprocessing.get_context("spawn").Process(target=_render, args=arguments, daemon=True)
    process.start()
    try:
        end = time.monotonic() + _READY_S
        while not shared.header[1]:
            if not process.is_alive() or time.monotonic() > end:
                raise RuntimeError("the process of the camera did not start")
            time.sleep(0.01)
        yield shared
    finally:
        shared.header[3] = 1
        process.join(10.0)
        memory = shared.memory
        shared.close()
        memory.unlink()


class _Loop:
    """Loop over the frames of a camera, at one rate after another."""

    def __init__(self, device: Device, size: int, camera: _Shared) -> None:
        self.camera, self.taken, self.pose = camera, -1, TARGET + _START
        self.bound = features_of(board(), size).bind(
            device, (size, size), np.uint8, copper="bright", threshold=20.0, noise=2.0, etch_bias_sigma=0.0
        )

    def run(self, rate: float, seconds: float, *, settling: int = 0) -> LoopTimes:
        """Run at a rate [1/s] for some seconds and return the times, without those of the first settling frames."""
        camera, still = self.camera, np.zeros(3)
        # A random walk with the largest step of a frame, 3 um and 0.3 mrad: missed frames do not spoil the prediction.
        model = MotionModel(lag=(0.0, 0.0, 0.0), position_noise=(9e-12 * rate, 9e-12 * rate, 9e-8 * rate))
        observer = PoseObserver(model)
        now = 1e-9 * time.perf_counter_ns()  # time of the last command [s]
        observer.reset(now, self.pose, np.diag((1e-10, 1e-10, 1e-6)))
        camera.step[0], camera.header[2] = 1.0 / rate, 1
        latencies, published = np.empty(round(rate * seconds) + settling), np.empty(2, np.int64)
        refused = missed = begun = 0
        for number in range(len(latencies)):
            while camera.header[0] == self.taken:
                os.sched_yield()
            newest = int(camera.header[0])
            skipped, self.taken, slot = newest - self.taken - 1, newest, newest % _SLOTS
            if number == settling:
                published[0], begun = camera.times[slot], newest
            missed += skipped if number >= settling else 0
            published[1] = camera.times[slot]
            exposed = 1e-9 * int(published[1])
            found = self.bound(camera.frames[slot], observer.estimate(max(exposed, now)).pose)
            now = 1e-9 * time.perf_counter_ns()
            status = int(to_numpy(found.status))
            refused += status != 0
            measured = (np.array(found.pose, np.float64), np.array(found.covariance, np.float64))
            observer.add(PoseMeasurement(exposed, now, *measured, status))
            self.pose = observer.estimate(now).pose
            velocity = _GAIN * rate * (TARGET - self.pose)
            observer.command(now, still)
            camera.velocity[:] = velocity if status == 0 else still
            latencies[number] = 1e-3 * (time.perf_counter_ns() - int(published[1]))
        delivered = (newest - begun) / max(1e-9 * int(published[1] - published[0]), 1e-9)
        return LoopTimes(latencies[settling:], missed, refused, camera.pose - TARGET, delivered)

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


@contextlib.contextmanager
def _loop(device: Device, size: int) -> Iterator[_Loop]:
    with _camera(size, device) as camera:
        yield _Loop(device, size, camera)


def run_loop(device: Device, size: int, *, rate: float, seconds: float) -> LoopTimes:
    """Run the loop at a frame rate [1/s] for some seconds and return its times."""
    with _loop(device, size) as loop:
        return loop.run(rate, seconds)


def highest_rate(device: Device, size: int, *, seconds: float, start: float = _CASE_RATE) -> HighestRate:
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
    """
    with _loop(device, size) as loop:
        return loop.highest_rate(start, seconds)


def cases(device: Device) -> Iterator[Case]:
    """Yield the vision alone with its peers; the metadata is of a loop at 1 kHz, and of its highest rate."""
    for case in feature_pose.cases(device):
        with _loop(device, int(case.name)) as loop:
            times = {f"loop_{name}": value for name, value in loop.run(_CASE_RATE, _CASE_SECONDS).summary.items()}
            highest = loop.highest_rate(_CASE_RATE, _TRIAL_SECONDS)
        rates = {"loop_highest_hz": highest.rate, "loop_highest_limit": highest.limit}
        metadata = {**case.metadata, **times, **rates}
        yield Case(case.operation, case.name, case.ours, case.peers, case.error, metadata=metadata)


def main() -> None:
    """Run the loop alone and print its times."""
    parser = argparse.ArgumentParser(description="Servo loop in wall-clock time, with the camera in another process")
    parser.add_argument("--device", default=None, help="label of the device; default: the best one")
    parser.add_argument("--seconds", type=float, default=None, help="time of a run; default: 60, with --highest 5")
    parser.add_argument("--rate", type=float, default=_CASE_RATE, help="frames per second; of --highest the first")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), help="rows and columns [px]")
    parser.add_argument("--highest", action="store_true", help="search the highest rate that the loop sustains")
    parser.add_argument("--quick", action="store_true", help="runs of half a second")
    options = parser.parse_args()
    device = Device.best() if options.device is None else Device.named(options.device)
    seconds = options.seconds or (_QUICK_SECONDS if options.quick else 5.0 if options.highest else 60.0)
    for size in options.sizes:
        if options.highest:
            highest = highest_rate(device, size, seconds=seconds, start=options.rate)
            print(size, f"highest rate {highest.rate:.0f} Hz, limited by the {highest.limit}")
            continue
        loop = run_loop(device, size, rate=options.rate, seconds=seconds)
        error = ", ".join(f"{each:+.2e}" for each in loop.error)
        print(size, {name: round(value, 1) for name, value in loop.summary.items()}, f"error {error}")


if __name__ == "__main__":
    main()
