"""Camera of the benchmark of the servo loop: a process that renders frames of a board and moves as commanded."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import tempfile
import time
from collections.abc import Iterator
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import Any

import numpy as np

from gpuvision.formats.cmos_sensor_file import read_cmos_sensor
from gpuvision.host import Device, host_view
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.servoing.low_latency import low_latency
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

TARGET = np.array([3e-3, 3e-3, 0.0])  # pose of the camera that the loop holds [m, m, rad]
START = np.array([15e-6, -12e-6, 1.5e-3])  # distance of the first pose from it
PIXEL = 10e-6  # m
_PAD, _PITCH = 0.3e-3, 0.45e-3  # m: 60 rulers have room in a frame of 128 x 128 px
_SLOTS = 4  # frames in shared memory
_TIMES = 4096  # times of the newest frames in shared memory
_READY_S = 120.0  # longest start of the other process: it compiles the renderer
_SILENT_S = 10.0  # longest time without a frame
# The camera sleeps until this time before a frame, and polls from then on: timers of ordinary threads end up to 50 us
# late.
_POLLING_NS = 60_000
_AWAKE_NS = 200_000  # time before and after the expected frame in which the loop polls: a sleeping core wakes up slowly


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


class Camera:
    """Memory and semaphore that the loop and the process of the camera share.

    Parameters
    ----------
    size : int
        Rows and columns of a frame [px].
    published : multiprocessing semaphore
        It counts the frames that were published and not waited for.
    name : str, optional
        Name of the memory of the other process. Default: new memory.
    """

    def __init__(self, size: int, published: Any, name: str | None = None) -> None:
        numbers = 8 * (4 + 3 + 3 + _TIMES + 1)
        self.memory = SharedMemory(name=name, create=name is None, size=numbers + _SLOTS * size * size)
        self.published, buffer = published, self.memory.buf
        self.header: Any = np.ndarray(4, np.int64, buffer)  # number of the newest frame, ready, run, stop
        self.velocity: Any = np.ndarray(3, np.float64, buffer, 32)
        self.pose: Any = np.ndarray(3, np.float64, buffer, 56)
        self.times: Any = np.ndarray(_TIMES, np.int64, buffer, 80)
        self.step: Any = np.ndarray(1, np.float64, buffer, numbers - 8)  # time between two frames [s]
        self.frames: Any = np.ndarray((_SLOTS, size, size), np.uint8, buffer, numbers)

    def start(self, rate: float) -> int:
        """Set the rate [1/s], forget all frames up to now, and return the number of the newest one."""
        self.step[0], self.header[2] = 1.0 / rate, 1
        while self.published.acquire(block=False):
            pass
        return int(self.header[0])

    def wait_after(self, taken: int) -> int:
        """Wait until a frame after a number is published, and return the number of the newest frame.

        The thread sleeps, and polls shortly before the frame is expected: its core is then awake.
        """
        due = int(self.times[taken % _TIMES]) + round(1e9 * float(self.step[0]))
        if _wait_until(due, _AWAKE_NS):
            end = due + _AWAKE_NS
            while int(self.header[0]) == taken and time.perf_counter_ns() < end:
                pass
        while (newest := int(self.header[0])) == taken:
            if not self.published.acquire(timeout=_SILENT_S):
                raise RuntimeError(f"the camera published no frame for {_SILENT_S:g} s")
        return newest

    def frame(self, number: int) -> Any:
        """Return the pixels of a frame; they stay valid until the camera has published a few more."""
        return self.frames[number % _SLOTS]

    def published_ns(self, first: int, last: int) -> list[int]:
        """Return the times at which frames were published, at most the newest 4096 of them."""
        return [int(self.times[number % _TIMES]) for number in range(max(first, last - _TIMES + 1), last + 1)]

    def close(self) -> None:
        """Release the memory; views of it must be gone."""
        self.header = self.velocity = self.pose = self.times = self.step = self.frames = None
        self.memory.close()


def _render(name: str, published: Any, size: int, label: str, core: int | None, priority: int) -> None:
    """Render frames at the wanted rate and move the camera as commanded, until the stop; runs in another process."""
    shared, device = Camera(size, published, name), Device.named(label)
    box = (tuple(TARGET[:2] - 2e-3), tuple(TARGET[:2] + 2e-3))
    values = ReflectanceMap.of(board(), pixel=PIXEL, region=box)
    operation = RenderBoard(board=values, shape=(size, size), sensor=read_cmos_sensor("pb1024"))
    queue = device.new_queue(inline=device.has_inline_queues)
    bound = operation.bind(device, (1, 1, 3), np.float64, queue=queue)
    pose = TARGET + START
    outputs: Any = bound.outputs
    poses, numbers, image = (host_view(each) for each in (*bound.inputs, outputs.image))
    with low_latency(core=core, priority=priority):
        shared.header[0], shared.header[1] = -1, 1
        while not shared.header[2]:
            time.sleep(1e-3)
        due, number = time.perf_counter_ns(), 0
        while not shared.header[3]:
            poses[0, 0], numbers[0], step = pose, number, float(shared.step[0])
            bound.run()
            shared.frames[number % _SLOTS] = image[0]
            _wait_until(due, _POLLING_NS)
            while time.perf_counter_ns() < due:
                os.sched_yield()
            shared.pose[:] = pose
            now = shared.times[number % _TIMES] = time.perf_counter_ns()
            shared.header[0] = number
            shared.published.release()
            pose = pose + step * shared.velocity
            shared.velocity[:] = 0.0  # a command holds for one frame: without a new one the camera stands still
            # A camera has a clock and is never late. After a late frame of this process the clock starts again, so
            # that frames never follow each other faster than a camera would take them.
            period = round(1e9 * step)
            number, due = number + 1, due + period if now - due < period // 4 else now + period
    shared.close()


def _wait_until(due: int, early: int) -> bool:
    """Sleep until some nanoseconds before a time, and return whether there was time to sleep."""
    left = due - early - time.perf_counter_ns()
    if left > 0:
        time.sleep(1e-9 * left)
    return left > 0


@contextlib.contextmanager
def camera_process(size: int, device: Device, *, core: int | None = None, priority: int = 0) -> Iterator[Camera]:
    """Start the process that renders, and end it.

    Parameters
    ----------
    size : int
        Rows and columns of a frame [px].
    device : Device
        Device that renders.
    core, priority : int
        Core and real-time priority of the process; see `low_latency`.
    """
    context = multiprocessing.get_context("spawn")
    shared = Camera(size, context.Semaphore(0))
    arguments = (shared.memory.name, shared.published, size, device.label, core, priority)
    process = context.Process(target=_render, args=arguments, daemon=True)
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
