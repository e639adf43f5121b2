"""Teams: the calling thread and waiting workers share a launch, and workers stop waiting when they should."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device, Launch, Operation, host_view
from gpuvision.host.bound import Bound
from gpuvision.host.team import _HEAD, _SHARE, Team, new_counters
from gpuvision.host.trace import Trace
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance

READOUT = PsdReadout(strip_length=2.0)
_TRIES = 2000  # pairs of launches, one after the other: another process may take the core between two of them
_CANARY = 0xA5
COMPLETE, COMMAND_QUEUE = cl.command_execution_status.COMPLETE, cl.event_info.COMMAND_QUEUE


@pytest.fixture
def cpu(device: Device) -> Device:
    """A device with teams, without workers that wait for a launch of another test."""
    if not device.has_inline_queues:
        pytest.skip(f"{device.label} has no inline queues")
    if not device.has_teams:
        pytest.skip(f"the process has too few cores for the workers of {device.label}")
    device.team_slot.clear()
    return device


def team_of(bound: Bound[Any]) -> Team:
    assert bound._team is not None
    return bound._team


def has_led(bound: Bound[Any]) -> bool:
    """Launch until a launch was shared with waiting workers; return whether one was."""
    team = team_of(bound)
    for _ in range(_TRIES):
        if team.waits:
            bound.run()
            return True
        bound.run()
    return False


def until(condition: Any, seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.001)
    return bool(condition())


class Counts(NamedTuple):
    count: Any
    column: Any
    row: Any


@dataclass(frozen=True)
class CountItems(Operation[Counts]):
    """Adds 1 to a cell of its input for each work-item, and notes the places of the items."""

    Result: ClassVar[type[Any]] = Counts
    kernel_folder: ClassVar[Path | None] = None
    include_folders: ClassVar[tuple[Path, ...]] = (KERNEL_FOLDER,)
    columns: int = 37
    turns: int = 0  # of a loop that does nothing, in each work-item

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        size = (self.columns, shape[0] // self.columns)
        word = (shape, np.dtype(np.int32))
        outputs = {"count": word, "column": word, "row": word}
        given, defines = [(shape, dtype)], {"TURNS": self.turns}
        return Launch("count.cl", "count_items", given, outputs, size, (1, 1), defines=defines, by_team=True)


SOURCE = """
#include "common/team.h"
kernel void count_items(global int *seen, global int *count, global int *column, global int *row TEAM_ARGUMENTS) {
    FOR_EACH_ITEM(item) {
        const uint at = item.y * ITEM_COLUMNS + item.x;
        for (volatile int turn = 0; turn < TURNS; turn++) {}
        count[at] = seen[at] += 1;
        column[at] = item.x;
        row[at] = item.y;
    }
}
"""


@pytest.fixture
def counting(tmp_path: Path) -> type[CountItems]:
    (tmp_path / "count.cl").write_text(SOURCE)
    return type("CountItemsHere", (CountItems,), {"kernel_folder": tmp_path})


@pytest.mark.parametrize(("columns", "rows"), [(37, 1), (2, 1), (37, 11), (1, 5), (300, 7)])
def test_each_item_runs_once_in_each_launch(cpu: Device, counting: type[CountItems], columns: int, rows: int) -> None:
    bound = counting(columns=columns).bind(cpu, (columns * rows,), np.int32)
    at_start = host_view(bound.outputs.count).copy()
    led = 0
    for launch in range(1, 2001):
        led += team_of(bound).waits
        bound.run()
        assert np.array_equal(host_view(bound.outputs.count), at_start + launch)
    assert led
    row, column = np.divmod(np.arange(columns * rows), columns)
    np.testing.assert_array_equal(host_view(bound.outputs.column), column)
    np.testing.assert_array_equal(host_view(bound.outputs.row), row)


def test_the_calling_thread_waits_for_a_work_item_of_a_member(cpu: Device, counting: type[CountItems]) -> None:
    """Here the share of the calling thread is empty: it computes nothing, and must still wait."""
    bound = counting(columns=1, turns=20_000).bind(cpu, (1,), np.int32)
    bound._team = bound._new_team()
    shares = bound._team._counters[_HEAD:].reshape(-1, _SHARE)
    shares[:-1, :3], shares[-1, :3] = 0, (1, 0, 1)
    at_start, led = int(host_view(bound.outputs.count)[0]), 0
    for launch in range(1, 2001):
        led += bound._team.waits
        bound.run()
        assert host_view(bound.outputs.count)[0] == at_start + launch
    assert led


@pytest.mark.parametrize(("items", "threads"), [(1, 2), (2, 4), (7, 3), (64, 64), (5, 64)])
def test_shares_hold_each_work_item_once(cpu: Device, items: int, threads: int) -> None:
    shares = host_view(new_counters(cpu, (items,), threads))[_HEAD:].reshape(threads, _SHARE)
    begun = [number for begin, end in shares[:, 1:3] for number in range(begin, end)]
    assert begun == list(range(items))
    assert shares[0, 1] < shares[0, 2]


def _psd(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    return READOUT, [rng.uniform(0.0, 1.0, (100_003, 2)).astype(np.float32)]


def _triangulation(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    matrix = ((1.0, 0.1, 0.2), (0.0, 1.2, 0.1), (0.0, 1e-3, 1.0))
    operation = Triangulation(homography=matrix, region=((-1.0, 1.0), (-1.0, 1.0)))
    return operation, [rng.uniform(-1.0, 1.0, 100_003).astype(np.float32) for _ in range(2)]


def _points(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    points = rng.uniform(0.0, 640.0, (20_011, 2)).astype(np.float32)
    return UndistortPoints(model=Lens(k1=-2e-7, centre=(320.0, 240.0))), [points]


def _line(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    return LineReadout(threshold=200), [rng.integers(0, 255, (5, 97, 641), np.uint8)]


def _rulers(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    image = rng.integers(0, 255, (203, 331), np.uint8)
    angle = rng.uniform(0.0, np.pi, 61)
    places = [rng.uniform(40.0, 160.0, 61), rng.uniform(40.0, 160.0, 61), np.cos(angle), np.sin(angle)]
    rulers = np.stack(places, -1).astype(np.float32)
    return RulerEdges(threshold=20.0, length=31, count=61), [image, rulers]


def _blobs(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    y, x = np.mgrid[:240, :320]
    places = np.array([(40.0 + 60.0 * k, 50.0 + 60.0 * j, 12.0) for k in range(4) for j in range(3)], np.float32)
    image = np.full(y.shape, 200.0)
    for at_x, at_y, size in places + rng.uniform(-1.0, 1.0, places.shape) * (1.0, 1.0, 0.0):
        image -= 150.0 / (1.0 + np.exp(2.0 * (np.hypot(x - at_x, y - at_y) - size)))
    return FindBlobs(threshold=20.0, polarity="dark", count=len(places)), [image.astype(np.uint8), places]


def _irradiance(rng: np.random.Generator) -> tuple[Any, list[Any]]:
    """Inputs of which the kernel reads the segments again for each work-item."""
    segments = np.zeros((7, 10), np.float32)
    segments[:, :6] = rng.uniform(-1.0, 1.0, (7, 6))
    segments[:, 6:9] = np.cross(segments[:, 3:6] - segments[:, :3], rng.normal(size=(7, 3)))
    segments[:, 6:9] /= np.linalg.norm(segments[:, 6:9], axis=1, keepdims=True)
    segments[:, 9] = rng.uniform(0.5, 2.0, 7)
    points = rng.uniform(-1.0, 1.0, (40, 21, 3))
    receivers = np.concatenate([points, rng.normal(size=points.shape)], axis=-1).astype(np.float32)
    scene = Scene(np.random.default_rng(3).uniform(-1.0, 1.0, (12, 3, 3)))
    return OccludedIrradiance(scene=scene, segments=7), [receivers, np.ones((40, 21, 2), np.float32), segments]


@pytest.mark.vectors
@pytest.mark.parametrize("make", [_psd, _triangulation, _points, _line, _rulers, _blobs, _irradiance])
def test_shared_launches_give_the_same_bits(cpu: Device, rng: np.random.Generator, make: Any) -> None:
    """Compared with launches in the queue, for two sets of inputs in turn; outputs hold canaries before each launch."""
    operation, inputs = make(rng)
    others = make(rng)[1]
    bound = operation.bind(cpu, inputs[0].shape, inputs[0].dtype)
    computed = {name: host_view(array) for name, array in bound.outputs._asdict().items() if array is not None}

    def launched(given: list[Any], launch: Any) -> dict[str, Any]:
        for array, values in zip(bound.inputs, given, strict=True):
            host_view(array)[...] = values
        for values in computed.values():
            values.view(np.uint8)[...] = _CANARY
        launch()
        return {name: values.tobytes() for name, values in computed.items()}

    expected = [launched(given, lambda: bound._enqueue(bound._own).wait()) for given in (inputs, others)]
    assert expected[0] != expected[1]
    led = [0, 0]
    for turn in range(_TRIES):
        which = turn % 2
        has_led(bound)
        led[which] += team_of(bound).waits
        assert launched((inputs, others)[which], bound.run) == expected[which]
        if min(led) >= 10:
            break
    assert min(led)


def test_workers_end_when_no_launch_comes(cpu: Device) -> None:
    bound = READOUT.bind(cpu, (100_000, 2), np.float32)
    assert has_led(bound)
    assert until(lambda: not team_of(bound)._has_members)
    before = np.array(host_view(bound.outputs.position))
    np.testing.assert_array_equal(host_view(bound.run().position), before)
    assert has_led(bound)  # they begin to wait again


def test_workers_do_not_wait_after_single_launches(cpu: Device) -> None:
    bound = READOUT.bind(cpu, (100_000, 2), np.float32)
    for _ in range(20):
        bound.run()
        time.sleep(0.002)
    assert not team_of(bound)._is_started


def test_another_launch_dismisses_the_workers(cpu: Device, rng: np.random.Generator) -> None:
    bound, other = (READOUT.bind(cpu, (100_000, 2), np.float32) for _ in range(2))
    frame = rng.uniform(0.1, 1.0, (100_000, 2)).astype(np.float32)
    other.inputs[0].set(frame)
    assert has_led(bound)
    other().wait()
    assert cpu.team_slot.team is None
    assert until(lambda: not team_of(bound)._has_members, seconds=1.0)
    left, right = frame.astype(np.float64).T
    np.testing.assert_allclose(host_view(other.outputs.position), (right - left) / (right + left), atol=5e-7)


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that wait for seconds, unless something dismisses them; on PoCL one is free."""
    monkeypatch.setattr(Team, "_polls", lambda *_: np.iinfo(np.uint32).max)


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize("how", ["after_event", "on_host"])
def test_launches_of_all_kinds_dismiss_the_workers(cpu: Device, how: str) -> None:
    bound, other = READOUT.bind(cpu, (100_000, 2), np.float32), READOUT.bind(cpu, (1_000_000, 2), np.float32)
    assert has_led(bound)
    start = time.monotonic()
    if how == "on_host":
        other.on_host([np.ones((1_000_000, 2), np.float32)])
    else:
        other(wait_for=[cl.enqueue_marker(cpu.queue)]).wait()
    assert time.monotonic() - start < 0.5


@pytest.mark.usefixtures("patient")
def test_kernels_of_other_threads_get_their_turn(cpu: Device) -> None:
    """A kernel that gpuvision does not know of, in another queue, while a loop launches without a pause."""
    bound, other = READOUT.bind(cpu, (100_000, 2), np.float32), READOUT.bind(cpu, (1_000_000, 2), np.float32)
    queue = cpu.new_queue()
    arguments = other._queue_site.arguments[1:]
    assert has_led(bound)
    event = cl.enqueue_nd_range_kernel(queue, *arguments)
    queue.flush()
    end = time.monotonic() + 0.5
    while event.command_execution_status > COMPLETE and time.monotonic() < end:
        bound.run()
    assert event.command_execution_status == COMPLETE


def test_a_short_launch_in_the_calling_thread_dismisses_the_workers(cpu: Device) -> None:
    """With Intel's runtime it takes three times as long while a worker waits."""
    bound, short = READOUT.bind(cpu, (100_000, 2), np.float32), READOUT.bind(cpu, (1000, 2), np.float32)
    assert has_led(bound)
    short.run()
    assert cpu.team_slot.team is None
    assert until(lambda: not team_of(bound)._has_members, seconds=1.0)


@pytest.mark.parametrize("pairs", [20_000, 50_000])
def test_alternating_arrays_do_not_meet(cpu: Device, pairs: int) -> None:
    """Workers may still wait for the arrays of the instance after a launch with arrays of the caller."""
    bound = READOUT.bind(cpu, (pairs, 2), np.float32)
    out, frame = bound.allocate(), cpu.empty((pairs, 2), np.float32)
    host_view(bound.inputs[0])[...] = 1.0, 3.0
    host_view(frame)[...] = 3.0, 1.0
    own, of_caller = host_view(bound.outputs.position), host_view(out.position)
    for repetition in range(_TRIES):
        for _ in range(1 + repetition % 5):
            own.fill(np.nan)
            bound.run()
            assert np.all(own == 0.5)
        of_caller.fill(np.nan)
        bound.run(frame, out=out)
        assert np.all(of_caller == -0.5)


def test_calls_that_follow_at_once_are_shared_on_pocl(cpu: Device) -> None:
    """A call that does not wait runs in the queue after a pause, in which the caller does other work."""
    if cpu.inline_device is None:
        pytest.skip("only workers of PoCL wake slowly")
    bound = READOUT.bind(cpu, (400_000, 2), np.float32)
    shared = []
    for _ in range(_TRIES):
        for _ in range(4):
            event = bound()
            shared.append(event.get_info(COMMAND_QUEUE) != cpu.queue)
            assert not shared[-1] or event.command_execution_status == COMPLETE
        bound.run()
    assert any(shared)
    time.sleep(0.001)
    assert bound().get_info(COMMAND_QUEUE) == cpu.queue


def test_shared_launches_come_after_earlier_work_of_the_queue(cpu: Device) -> None:
    """Work that gpuvision does not know of dismisses no workers: the launch that they share must wait for it."""
    first = READOUT.bind(cpu, (1_000_000, 2), np.float32)
    host_view(first.inputs[0])[...] = 1.0, 3.0
    position = first.outputs.position[: 2 * 100_000].reshape(100_000, 2)
    bound = READOUT.bind(cpu, position.shape, np.float32, inputs=[position])
    led = 0
    for _ in range(_TRIES):
        has_led(bound)
        host_view(first.outputs.position).fill(np.nan)
        led += team_of(bound).waits
        cl.enqueue_nd_range_kernel(*first._queue_site.arguments)
        assert np.all(host_view(bound.run().position) == 0.0)
        if led == 20:
            break
    assert led


def test_a_dropped_instance_leaves_no_waiting_worker(cpu: Device) -> None:
    for _ in range(20):
        bound = READOUT.bind(cpu, (100_000, 2), np.float32)
        has_led(bound)
        events = team_of(bound)._events
        del bound
        gc.collect()
        assert all(event.command_execution_status == COMPLETE for event in events)


def test_no_team_for_traces_streams_of_a_few_bytes_and_queues_of_the_caller(cpu: Device, tmp_path: Path) -> None:
    with Trace(tmp_path / "trace.json"):
        assert READOUT.bind(cpu, (100_000, 2), np.float32)._team is None
    assert READOUT.bind(cpu, (1000, 2), np.float32)._team is None
    assert READOUT.bind(cpu, (100_000, 2), np.float32, queue=cpu.new_queue())._team is None
    assert READOUT._bind(cpu, (100_000, 2), np.float32, None)._team is None  # of a single call


def test_the_environment_prevents_teams(cpu: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_TEAMS", "off")
    bound = READOUT.bind(cpu, (100_000, 2), np.float32)
    assert bound._team is None
    for _ in range(5):
        bound.run()


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="the system has no such policies")
@pytest.mark.parametrize("policy", ["SCHED_FIFO", "SCHED_RR"])
def test_workers_do_not_wait_for_a_real_time_thread(cpu: Device, monkeypatch: pytest.MonkeyPatch, policy: str) -> None:
    bound = READOUT.bind(cpu, (100_000, 2), np.float32)
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: getattr(os, policy))
    for _ in range(50):
        bound.run()
    assert not team_of(bound)._is_started
    monkeypatch.undo()
    assert has_led(bound)


def test_no_team_where_a_worker_has_no_core(cpu: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """With more workers than cores, waiting workers would take the cores of the others."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert READOUT.bind(cpu, (100_000, 2), np.float32)._team is None


_AT_EXIT = """
import os, sys
import numpy as np
from gpuvision.host import Device
from gpuvision.ranging.psd import PsdReadout
bound = PsdReadout(strip_length=2.0).bind(Device.named(sys.argv[1]), (100_000, 2), np.float32)
waits = 0
while not waits:
    bound.run()
    waits = bound._team.waits
if sys.argv[2] == "fork":
    child = os.fork()
    if child:
        sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@pytest.mark.parametrize("how", ["exit", "fork"])
def test_a_process_ends_while_workers_wait(cpu: Device, how: str) -> None:
    ran = subprocess.run(
        [sys.executable, "-c", _AT_EXIT, cpu.label, how], capture_output=True, text=True, timeout=120, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")


_IN_CHILD = """
import os, sys
import numpy as np
from gpuvision.host import Device, DeviceUnusableError
from gpuvision.host.team import _ENDED
from gpuvision.ranging.psd import PsdReadout
bound = PsdReadout(strip_length=2.0).bind(Device.named(sys.argv[1]), (100_000, 2), np.float32)
while not bound._team.waits:
    bound.run()
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
bound._team._counters[_ENDED] = 0
for launch in bound.run, bound:
    try:
        launch()
    except DeviceUnusableError:
        continue
    os._exit(1)
os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no fork")
def test_a_forked_process_raises_where_its_parent_has_waiting_workers(cpu: Device) -> None:
    """Without workers a launch would hang. The child has a copy of the counters, as of the moment of the fork."""
    ran = subprocess.run(
        [sys.executable, "-c", _IN_CHILD, cpu.label], capture_output=True, text=True, timeout=30, check=False
    )
    assert (ran.returncode, ran.stderr) == (0, "")
