"""Timelines: what is recorded, that the file is valid, and that nothing is left of a trace that has ended."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from collections import defaultdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

import gpuvision as gv
from gpuvision.host import Device, Pipeline, Trace
from gpuvision.host import trace as trace_module
from gpuvision.host.bound import Bound
from gpuvision.host.outputs import Outputs
from gpuvision.host.reading import reading
from gpuvision.host.stages import stage
from gpuvision.host.trace import active_trace
from gpuvision.host.traced import TracedBound

READOUT = gv.PsdReadout(strip_length=6e-3)
CURRENTS = np.full((8, 16, 2), 2.0, np.float32)


def spans_by_lane(path: Path) -> dict[str, list[dict[str, Any]]]:
    """Return the spans of a file by the name of the lane; check the form of each event."""
    tree = json.loads(path.read_text())
    names = {each["tid"]: each["args"]["name"] for each in tree["traceEvents"] if each["ph"] == "M"}
    assert len(set(names.values())) == len(names)
    lanes: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for each in tree["traceEvents"]:
        if each["ph"] != "M":
            assert each["ph"] == "X"
            assert each["pid"] == 1
            assert each["ts"] >= 0
            assert each["dur"] >= 0
            lanes[names[each["tid"]]].append(each)
    return lanes


def check_nested(spans: list[dict[str, Any]]) -> None:
    """Check that any two spans of a lane are apart or one contains the other (times have 1 ns)."""
    ends: list[float] = []
    for each in sorted(spans, key=lambda each: (each["ts"], -each["dur"])):
        while ends and ends[-1] <= each["ts"] + 1e-3:
            ends.pop()
        end = each["ts"] + each["dur"]
        assert not ends or end <= ends[-1] + 1e-3, each
        ends.append(end)


def test_stages_of_the_host_nest(tmp_path: Path, device: Device) -> None:
    with Trace(tmp_path / "t.json") as trace, trace.span("whole"):
        READOUT(CURRENTS, device=device)
        Outputs("test").write_text(tmp_path / "some.txt", "text")
        with reading("in.png", "image"):
            pass
    lanes = spans_by_lane(tmp_path / "t.json")
    for spans in lanes.values():
        check_nested(spans)
    host = {each["name"]: each for each in lanes["host"]}
    assert {"whole", "bind", "run", "write", "read"} <= set(host)
    assert host["run"]["args"] == host["bind"]["args"] == {"of": "PsdReadout"}
    assert host["read"]["args"] == {"of": "in.png"}
    assert host["write"]["args"] == {"of": str(tmp_path)}
    assert host["whole"]["ts"] == 0
    ends = [each["ts"] + each["dur"] for each in lanes["host"]]
    assert host["whole"]["dur"] == max(ends)
    assert host["bind"]["ts"] + host["bind"]["dur"] <= host["run"]["ts"]


def test_device_times_lie_in_the_calls_of_the_host(tmp_path: Path, device: Device) -> None:
    """A launch that is waited for runs between its start and the end of the wait, up to the offset of the clocks."""
    with Trace(tmp_path / "t.json"):
        bound = READOUT.bind(device, CURRENTS.shape, CURRENTS.dtype, queue=device.new_queue())
        for _ in range(5):
            bound.run()
    lanes = spans_by_lane(tmp_path / "t.json")
    waits = [each for each in lanes["host"] if each["name"] == "launch and wait"]
    assert len(waits) == 5
    computed = [each for name, spans in lanes.items() if name.startswith("device ") for each in spans]
    if device.kind == "rusticl" and not computed:
        return  # times that are no nanoseconds are left out: see the next test
    assert len(computed) >= 5
    for spans in lanes.values():
        check_nested(spans)
    slack = 2000.0  # [us] a runtime may round its times, and the process may lose the core between two clocks
    for wait in waits:
        begun, ended = wait["ts"] - slack, wait["ts"] + wait["dur"] + slack
        inside = [each for each in computed if begun <= each["ts"] and each["ts"] + each["dur"] <= ended]
        assert any(each["name"] == "compute" and each["args"] == {"of": "PsdReadout"} for each in inside)


class FakeEvent:
    """Completed event with given times of the device [ns]."""

    def __init__(self, queued: int, start: int, end: int) -> None:
        self.profile = SimpleNamespace(queued=queued, start=start, end=end)

    def wait(self) -> None:
        """Return at once."""


def fake_trace(path: Path, times: list[tuple[int, int, int, int]]) -> None:
    """Write a trace of commands: time before the enqueue, then the times of the device; a call lasts 1 us."""
    trace = Trace(path)
    queue = type("Queue", (), {"device": SimpleNamespace(name="fake")})()  # hashable, as a queue is
    for before, queued, start, end in times:
        trace.add_event(queue, "compute", "op", FakeEvent(queued, start, end), before, before + 1000)
    trace.write()


def test_the_offset_lies_between_the_bounds_of_all_commands(tmp_path: Path) -> None:
    """The clock of the device is 5 s ahead; both commands are queued 100 and 900 ns after their calls have begun."""
    ahead = 5_000_000_000
    times = [(10_000, ahead + 10_100, ahead + 20_000, ahead + 30_000)]
    times += [(50_000, ahead + 50_900, ahead + 60_000, ahead + 65_000)]
    fake_trace(tmp_path / "t.json", times)
    (spans,) = spans_by_lane(tmp_path / "t.json").values()
    # Bounds of the host's time minus the device's: from -100 and -900 to 900 and 100 [ns], the middle is 0.
    assert [each["dur"] for each in spans] == [10.0, 5.0]
    assert spans[1]["ts"] - spans[0]["ts"] == pytest.approx(40.0)


def test_times_that_are_of_no_clock_are_left_out(tmp_path: Path) -> None:
    fake_trace(tmp_path / "t.json", [(10_000_000 * number, 0, 2, 3) for number in range(3)])
    assert spans_by_lane(tmp_path / "t.json") == {}
    assert json.loads((tmp_path / "t.json").read_text())["otherData"]["commands without device times"] == 3


def test_writing_twice_counts_commands_once(tmp_path: Path) -> None:
    trace = Trace(tmp_path / "t.json")
    queue = type("Queue", (), {"device": SimpleNamespace(name="fake")})()
    for number in range(3):
        before = 10_000_000 * number
        trace.add_event(queue, "compute", "op", FakeEvent(0, 2, 3), before, before + 1000)
    trace.write()
    first = (tmp_path / "t.json").read_bytes()
    trace.write()
    assert (tmp_path / "t.json").read_bytes() == first


def test_polling_stops_at_the_first_incomplete_command_of_a_queue(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    class Running(FakeEvent):
        """Command that has not completed."""

        @property
        def command_execution_status(self) -> int:
            asked.append("running")
            return int(cl.command_execution_status.RUNNING)

    monkeypatch.setattr(trace_module, "_PENDING", 4)
    trace = Trace(tmp_path / "t.json")
    queues = [type("Queue", (), {"device": SimpleNamespace(name=name)})() for name in ("one", "other")]
    for number in range(4):
        trace.add_event(queues[number % 2], "compute", "op", Running(0, 2, 3), 0, 1000)
    assert asked == ["running"] * 2


def test_copies_are_recorded_where_memory_is_not_shared(
    tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "shares_memory", False)
    with Trace(tmp_path / "t.json"):
        bound = READOUT.bind(device, CURRENTS.shape, CURRENTS.dtype, queue=device.new_queue())
        first = bound.on_host([CURRENTS])
    monkeypatch.undo()
    np.testing.assert_array_equal(first.position, READOUT(CURRENTS, device=device).position)
    lanes = spans_by_lane(tmp_path / "t.json")
    order = [each["name"] for each in sorted(lanes["host"], key=lambda each: each["ts"])]
    assert order[order.index("run") :] == ["run", "upload", "launch", "download", "wait"]
    on_device = {each["name"] for name, spans in lanes.items() if name.startswith("device ") for each in spans}
    assert device.kind == "rusticl" or {"upload", "compute", "download"} <= on_device


def test_each_thread_has_a_lane(tmp_path: Path) -> None:
    def work() -> None:
        with stage("bind", "in a thread"):
            pass

    with Trace(tmp_path / "t.json"):
        thread = threading.Thread(target=work, name="worker")
        thread.start()
        thread.join()
    assert [each["args"]["of"] for each in spans_by_lane(tmp_path / "t.json")["thread worker"]] == ["in a thread"]


def test_a_stream_records_its_stages_and_no_launch_twice(tmp_path: Path, device: Device) -> None:
    with Trace(tmp_path / "t.json"):
        for _ in range(2):
            Pipeline(CURRENTS, READOUT, device=device, batch=2).run()
    lanes = spans_by_lane(tmp_path / "t.json")
    for spans in lanes.values():
        check_nested(spans)
    assert [each["args"]["frame"] for each in lanes["consumer"] if each["name"] == "sink"] == [0, 2, 4, 6] * 2
    assert "producer, stream 2" not in lanes  # the second stream began after the first one had ended
    assert not any(each["name"] == "launch" for each in lanes["host"])
    computed = [each for name, spans in lanes.items() if "compute" in name for each in spans]
    assert len(computed) == 8


def test_a_stream_that_outlives_the_block_does_not_write_the_file(tmp_path: Path, device: Device) -> None:
    with Trace(tmp_path / "t.json"):
        stream = Pipeline(CURRENTS, READOUT, device=device, batch=2)
        stream.__enter__()
        next(stream)
    written = (tmp_path / "t.json").read_bytes()
    list(stream)
    stream.close()
    assert (tmp_path / "t.json").read_bytes() == written


def test_a_stream_counts_all_stages_beyond_the_limit(tmp_path: Path, device: Device) -> None:
    def stages(limit: int) -> tuple[int, int]:
        file = tmp_path / f"{limit}.json"
        Pipeline(CURRENTS, READOUT, device=device, batch=2, trace=Trace(file, limit=limit)).run()
        left_out = json.loads(file.read_text())["otherData"]["spans beyond the limit"]
        return sum(map(len, spans_by_lane(file).values())), left_out

    total, none = stages(1000)
    assert none == 0
    assert stages(0) == (0, total)


def test_the_queues_of_a_stream_are_free_after_its_end(tmp_path: Path, device: Device) -> None:
    trace, queue = Trace(tmp_path / "t.json"), device.new_queue()
    number = trace.begin_stream(queue)
    assert trace.is_of_stream(queue)
    trace.end_stream(number)
    assert not trace.is_of_stream(queue)


def test_streams_at_the_same_time_have_lanes_of_their_own(tmp_path: Path, device: Device) -> None:
    with (
        Trace(tmp_path / "t.json"),
        Pipeline(CURRENTS, READOUT, device=device, batch=4) as first,
        Pipeline(CURRENTS, READOUT, device=device, batch=4) as second,
    ):
        assert sum(len(one) + len(other) for one, other in zip(first, second, strict=True)) == 16
    lanes = spans_by_lane(tmp_path / "t.json")
    assert [len(lanes[name]) for name in ("producer", "producer, stream 2")] == [6, 6]


def test_spans_that_overlap_go_to_further_lanes(tmp_path: Path) -> None:
    """A batch that the device computes during another one is no part of it, so that it is not drawn inside."""
    trace = Trace(tmp_path / "t.json")
    for number, (start, end) in enumerate(((0, 10), (5, 15), (10, 20), (12, 14), (16, 30), (20, 20))):
        trace.add({"compute": (start, end)}, number, 1)
    trace.write()
    lanes = spans_by_lane(tmp_path / "t.json")
    frames = {name: [each["args"]["frame"] for each in spans] for name, spans in lanes.items()}
    assert frames == {"device compute": [0, 2, 5], "device compute (2)": [1, 4], "device compute (3)": [3]}


def test_commands_of_a_queue_that_overlap_go_to_further_lanes(tmp_path: Path) -> None:
    fake_trace(tmp_path / "t.json", [(0, 100, 1000, 9000), (200, 300, 2000, 3000), (400, 500, 9000, 9500)])
    lanes = spans_by_lane(tmp_path / "t.json")
    assert {name: len(spans) for name, spans in lanes.items()} == {
        "device fake, queue 1": 2,
        "device fake, queue 1 (2)": 1,
    }


@pytest.mark.parametrize("ended", [False, True])
def test_the_batches_of_a_stream_have_one_offset_of_the_clocks(tmp_path: Path, ended: bool) -> None:
    """The first estimate is 10 us too late: with its own estimate, the first batch would end after the second one."""
    trace, queue = Trace(tmp_path / "t.json"), object()
    stream = trace.begin_stream(queue)
    trace.add({"compute": (20_000, 25_000), "wait": (1_000, 26_000)}, 0, 1, stream=stream, offset=15_000)
    trace.add({"compute": (17_000, 18_000), "wait": (27_000, 28_000)}, 1, 1, stream=stream, offset=5_000)
    if ended:
        trace.end_stream(stream)
        stream = trace.begin_stream(queue)
        trace.add({"compute": (40_000, 41_000)}, 0, 1, stream=stream, offset=-7_000)  # of another stream
    trace.write()
    lanes = spans_by_lane(tmp_path / "t.json")
    assert [(each["ts"], each["dur"]) for each in lanes["device compute"]][:2] == [(9.0, 5.0), (16.0, 1.0)]
    assert [each["ts"] for each in lanes["consumer"]] == [0.0, 26.0]  # the times of the host are as they were measured
    assert not ended or lanes["device compute"][2]["ts"] == 39.0


def test_the_limit_bounds_the_spans_and_the_rest_is_counted(tmp_path: Path, device: Device) -> None:
    with Trace(tmp_path / "t.json", limit=3) as trace:
        for _ in range(5):
            with stage("read"):
                pass
        assert trace.is_full
        READOUT(CURRENTS, device=device)
    assert sum(map(len, spans_by_lane(tmp_path / "t.json").values())) == 3
    assert json.loads((tmp_path / "t.json").read_text())["otherData"]["spans beyond the limit"] > 2


def test_nothing_is_left_after_the_trace(tmp_path: Path, device: Device) -> None:
    with Trace(tmp_path / "t.json"):
        inside = READOUT.bind(device, CURRENTS.shape, CURRENTS.dtype)
        assert type(inside) is TracedBound
        assert active_trace() is not None
    written = (tmp_path / "t.json").read_bytes()
    assert active_trace() is None
    inside.run()
    assert type(READOUT.bind(device, CURRENTS.shape, CURRENTS.dtype)) is Bound
    assert stage("read") is stage("write")  # one object for all: nothing is allocated
    assert (tmp_path / "t.json").read_bytes() == written


def test_a_block_that_fails_leaves_no_file(tmp_path: Path) -> None:
    with pytest.raises(KeyError), Trace(tmp_path / "t.json"):
        raise KeyError("a failure")
    assert active_trace() is None
    assert list(tmp_path.iterdir()) == []


def test_one_trace_at_a_time(tmp_path: Path) -> None:
    with (
        Trace(tmp_path / "t.json"),
        pytest.raises(ValueError, match=r"a trace is active already, which writes .*t\.json"),
    ):
        Trace(tmp_path / "u.json").__enter__()
    assert {each.name for each in tmp_path.iterdir()} >= {"t.json"}
    assert not (tmp_path / "u.json").exists()


def test_the_file_is_no_input_and_no_other_output(tmp_path: Path) -> None:
    file = tmp_path / "t.json"
    file.write_text("a user's")
    with pytest.raises(FileExistsError, match="not an unchanged output of an earlier trace"), Trace(file):
        pass
    with Trace(file, overwrite=True):
        with pytest.raises(FileExistsError, match="it is the input"):
            Outputs("scan", inputs=[file])
        with pytest.raises(ValueError, match="two outputs have the same name"):
            Outputs("scan", overwrite=True).claim(file)
    with (
        Trace(tmp_path / "out"),
        pytest.raises(ValueError, match=r"out is the folder .*out of the outputs or one above"),
    ):
        Outputs("scan").claim_folder(tmp_path / "out", ())
    Outputs("trace", inputs=[file])  # released


def test_the_default_queue_of_a_new_device_measures_times(tmp_path: Path, device: Device) -> None:
    """In a new process, as in a command: the device is opened inside the trace."""
    code = f"""
import numpy, gpuvision as gv
from gpuvision.host import Device, Trace
with Trace({str(tmp_path / "t.json")!r}):
    gv.PsdReadout(strip_length=6e-3)(numpy.ones((8, 16, 2), numpy.float32), device=Device.named({device.label!r}))
"""
    subprocess.run([sys.executable, "-c", code], check=True)
    lanes = spans_by_lane(tmp_path / "t.json")
    computed = [each["name"] for name, spans in lanes.items() if name.startswith("device ") for each in spans]
    without_times = json.loads((tmp_path / "t.json").read_text())["otherData"]["commands without device times"]
    assert computed.count("compute") + without_times >= 2  # of the bind and of the call
    assert without_times == 0 or device.kind == "rusticl"


def test_spans_of_a_thread_that_cross_go_to_further_parts() -> None:
    """A span that begins where another one ends follows it; of two that begin together the longer one contains."""
    times = {"a": (0, 10), "b": (5, 15), "c": (6, 9), "d": (10, 12), "e": (11, 20), "f": (30, 40), "g": (30, 50)}
    times["h"] = (7, 10)  # within "a", but it crosses "c"
    spans = [trace_module._Span("lane", name, *each, {}) for name, each in times.items()]
    parts = [[each.name for each in part] for part in trace_module._nested_parts(spans[::-1])]
    assert parts == [["a", "c", "d", "g", "f"], ["b", "h"], ["e"]]
    assert trace_module._nested_parts([]) == [[]]


@pytest.mark.parametrize(("late", "is_kept"), [(1_011_000, True), (1_011_001, False), (0, True), (-3_000, True)])
def test_bounds_of_the_offset_may_differ_by_a_millisecond_and_the_drift(
    tmp_path: Path, late: int, is_kept: bool
) -> None:
    """Two calls of 1 us, 10 ms apart: the drift is a thousandth of that. The offset is the middle of the bounds."""
    trace = Trace(tmp_path / "t.json")
    trace.add_span("host", "", 0, 10)
    queue = type("Queue", (), {"device": SimpleNamespace(name=" fake ")})()
    apart = 10_000_000
    for before, queued in ((0, 0), (apart, apart - late)):
        event = FakeEvent(queued, apart + before, apart + before + 7_000)
        trace.add_event(queue, "compute", "op", event, before, before + 1_000)
    trace.write()
    lanes = spans_by_lane(tmp_path / "t.json")
    left_out = json.loads((tmp_path / "t.json").read_text())["otherData"]["commands without device times"]
    if not is_kept:
        assert (set(lanes), left_out) == ({"host"}, 2)
        return
    offset = (max(0, late) + min(1_000, late + 1_000)) // 2
    assert left_out == 0
    assert [(each["ts"], each["dur"]) for each in lanes["device fake, queue 1"]] == [
        ((apart + offset) / 1e3, 7.0),
        ((2 * apart + offset) / 1e3, 7.0),
    ]


def test_stages_of_a_batch_are_kept_together(tmp_path: Path) -> None:
    """Of four spans three are of the first batch; the next batch does not fit, a single span does."""
    trace = Trace(tmp_path / "t.json", limit=4)
    stages = {"source": (10, 20), "compute": (20, 30), "wait": (30, 40)}
    trace.add(stages, 0, 2)
    assert not trace.is_full
    trace.add(stages, 2, 2)
    trace.add_span("read", "file", 5, 6)
    assert trace.is_full
    trace.add_span("read", "file", 7, 8)
    trace.write()
    lanes = spans_by_lane(tmp_path / "t.json")
    assert {name: [each["args"] for each in spans] for name, spans in lanes.items()} == {
        "producer": [{"frame": 0, "frames": 2}],
        "device compute": [{"frame": 0, "frames": 2}],
        "consumer": [{"frame": 0, "frames": 2}],
        "host": [{"of": "file"}],
    }
    assert json.loads((tmp_path / "t.json").read_text())["otherData"]["spans beyond the limit"] == 4


def test_streams_take_the_least_free_number(tmp_path: Path) -> None:
    trace = Trace(tmp_path / "t.json")
    queues = [object() for _ in range(4)]
    assert [trace.begin_stream(queue) for queue in queues[:3]] == [1, 2, 3]
    trace.end_stream(2)
    assert [trace.is_of_stream(queue) for queue in queues] == [True, False, True, False]
    assert trace.begin_stream(queues[3]) == 2
    trace.end_stream(1)
    assert [trace.is_of_stream(queue) for queue in queues] == [False, False, True, True]
    trace.add({"sink": (1, 2)}, 0, 1, stream=3)
    trace.write()
    assert set(spans_by_lane(tmp_path / "t.json")) == {"consumer, stream 3"}


def test_completed_commands_are_read_while_others_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each event is kept until its times are read; a command without times is counted."""
    status = {"done": int(cl.command_execution_status.COMPLETE), "runs": int(cl.command_execution_status.RUNNING)}

    class Event(FakeEvent):
        def __init__(self, state: str) -> None:
            super().__init__(0, 2, 3)
            self.command_execution_status = status[state]

    class Untimed(Event):
        @property
        def profile(self) -> Any:
            raise cl.RuntimeError("clGetEventProfilingInfo failed: PROFILING_INFO_NOT_AVAILABLE")

        @profile.setter
        def profile(self, value: object) -> None:
            pass

    monkeypatch.setattr(trace_module, "_PENDING", 3)
    trace = Trace(tmp_path / "t.json")
    queues = [type("Queue", (), {"device": SimpleNamespace(name=name)})() for name in ("one", "other")]
    for number, event in enumerate((Event("done"), Untimed("done"))):
        trace.add_event(queues[number], "compute", "op", event, 0, 1000)
    assert (len(trace._pending), len(trace._executed)) == (2, 0)
    trace.add_event(queues[0], "compute", "op", Event("runs"), 0, 1000)
    assert (len(trace._pending), len(trace._executed)) == (1, 1)
    trace.write()
    assert (len(trace._pending), len(trace._executed)) == (0, 2)
    assert json.loads((tmp_path / "t.json").read_text())["otherData"]["commands without device times"] == 1


def test_a_queue_of_no_clock_hides_no_other(tmp_path: Path) -> None:
    """The first queue counts 0, 1, 2 instead of nanoseconds, and is left out."""
    trace = Trace(tmp_path / "t.json")
    queues = [type("Queue", (), {"device": SimpleNamespace(name=name)})() for name in ("one", "other")]
    for queue, times in ((queues[0], (0, 1)), (queues[1], (0, 10_000_000))):
        for number, queued in enumerate(times):
            before = 10_000_000 * number
            event = FakeEvent(queued, queued + 1_000, queued + 3_000)
            trace.add_event(queue, "compute", "op", event, before, before + 1_000)
    trace.write()
    lanes = spans_by_lane(tmp_path / "t.json")
    assert {name: [each["dur"] for each in spans] for name, spans in lanes.items()} == {
        "device other, queue 2": [2.0, 2.0]
    }
    assert json.loads((tmp_path / "t.json").read_text())["otherData"]["commands without device times"] == 2


def test_a_command_that_runs_or_fails_hides_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commands that wait behind a running one stay; those of other queues, and after a failed one, are read."""

    class Event(FakeEvent):
        def __init__(self, state: int) -> None:
            super().__init__(0, 2, 3)
            self.command_execution_status = state

        def wait(self) -> None:
            if self.command_execution_status < 0:
                raise cl.RuntimeError("clWaitForEvents failed: OUT_OF_RESOURCES")

    class Failed(Event):
        profile = property(lambda self: self.wait(), lambda self, value: None)  # type: ignore[assignment]

    complete, running = int(cl.command_execution_status.COMPLETE), int(cl.command_execution_status.RUNNING)
    monkeypatch.setattr(trace_module, "_PENDING", 6)
    trace = Trace(tmp_path / "t.json")
    queues = [type("Queue", (), {"device": SimpleNamespace(name=name)})() for name in ("one", "other")]
    events = [Event(running), Failed(-5), Event(complete), Event(complete), Event(complete), Event(complete)]
    for number, event in enumerate(events):
        trace.add_event(queues[number % 2], "compute", "op", event, 0, 1_000)
    assert [each.event for each in trace._pending] == events[::2]
    assert [each.command.event for each in trace._executed] == [events[3], events[5]]
    assert trace._without_times == 1
    trace.write()
    assert len(trace._executed) == 5
