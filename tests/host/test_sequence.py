"""Sequences called on NumPy arrays and device arrays, with and without shared memory, against NumPy."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import Device, Launch, LaunchBuilder, Layout, Operation, OperationSequence, Stage, Trace

# Integers, whose results do not depend on rounding.
SOURCE = """
kernel void scale(global const int *in, global int *scaled, global int *parity, const int factor, const int count) {
    const int i = get_global_id(0);
    if (i >= count) return;
    scaled[i] = factor * in[i];
    if (parity) parity[i] = in[i] & 1;
}
"""
FRAME = np.arange(-5, 95, dtype=np.int32)


class Scaled(NamedTuple):
    """Result of `Scale`."""

    scaled: Any
    parity: Any


@dataclass(frozen=True)
class Scale(Operation[Scaled]):
    """Integers times a factor, and their parities."""

    Result = Scaled
    factor: int = 2
    with_parity: bool = True

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        build = LaunchBuilder(self, device, shape, dtype, variant="work_item")
        shapes = {"scaled": shape, "parity": shape if self.with_parity else None}
        return build.launch(
            "scale.cl",
            "scale",
            work=build.work(shape[0], each=1, group=8),
            outputs=build.outputs(shapes, scaled=np.int32, parity=np.int32),
            arguments=[np.int32(self.factor), np.int32(shape[0])],
        )


class Chained(NamedTuple):
    """Result of `Chain`, whose fields are not in the order of its stages."""

    last: Any
    nothing: Any
    parity: Any
    first: Any


@dataclass(frozen=True)
class Chain(OperationSequence[Chained]):
    """Twice the input, its parity, and six times the input."""

    Result = Chained

    def layout(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Layout:
        stages = [
            Stage("double", Scale(), ("frame",)),
            Stage("triple", Scale(3, with_parity=False), ("double.scaled",)),
        ]
        outputs = {"last": "triple.scaled", "nothing": None, "parity": "double.parity", "first": "double.scaled"}
        return Layout({"frame": (shape, dtype)}, stages, outputs)


@pytest.fixture(autouse=True)
def _kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "scale.cl").write_text(SOURCE)
    monkeypatch.setattr(Scale, "kernel_folder", tmp_path)


def check(result: Chained, frame: Any) -> None:
    np.testing.assert_array_equal(result.first, 2 * frame)
    np.testing.assert_array_equal(result.last, 6 * frame)
    np.testing.assert_array_equal(result.parity, frame % 2)
    assert result.nothing is None


def test_numpy_arrays(memory: dict[str, Any]) -> None:
    device = memory["device"]
    check(Chain()(FRAME, device=device), FRAME)
    bound = Chain().bind(device, FRAME.shape, FRAME.dtype)
    for frame in (FRAME, FRAME[::-1].copy()):
        check(bound.on_host([frame]), frame)


def test_numpy_arrays_wait_for_an_earlier_call(device: Device) -> None:
    """The earlier call reads the inputs of the instance, which NumPy arrays overwrite."""
    ones = np.ones(4_000_000, np.int32)
    bound = Chain().bind(device, ones.shape, ones.dtype)
    out = bound.allocate()
    bound.inputs[0].set(ones)
    for _ in range(4):
        bound()
    event = bound(out=out)
    bound.on_host([2 * ones])
    event.wait()
    np.testing.assert_array_equal(out.first.get(), 2 * ones)


def test_given_outputs_are_written(memory: dict[str, Any]) -> None:
    last, parity, first = (np.full_like(FRAME, -99) for _ in range(3))
    out = Chained(last, None, parity, first)
    assert Chain()(FRAME, device=memory["device"], out=out) is out
    check(out, FRAME)


def test_outputs_that_are_missing_or_not_computed_are_refused(device: Device) -> None:
    bound = Chain().bind(device, FRAME.shape, FRAME.dtype)
    last, nothing, parity, first = (np.empty_like(FRAME) for _ in range(4))
    with pytest.raises(ValueError, match=r"out.nothing is not computed; expected None"):
        bound.on_host([FRAME], Chained(last, nothing, parity, first))
    with pytest.raises(ValueError, match=r"out.first is missing"):
        bound.on_host([FRAME], Chained(last, None, parity, None))


def test_each_stage_is_launched_once(device: Device) -> None:
    """The first one waits for the given events; `begun` is its event, the last event is returned."""
    bound: Any = Chain().bind(device, FRAME.shape, FRAME.dtype)
    calls: list[Any] = []
    own = bound._bounds

    def counted(number: int) -> Any:
        return lambda *given, **how: calls.append((number, given, how)) or f"event {number}"

    bound._bounds = tuple(counted(number) for number in range(3))
    gate: Any = ["gate"]
    assert bound(wait_for=gate) == "event 2"
    assert bound.begun == "event 0"
    assert calls == [(0, (), {"wait_for": gate}), (1, (), {}), (2, (), {})]
    bound._bounds = own
    bound.inputs[0].set(FRAME)
    gate = cl.UserEvent(device.context)
    event = bound(wait_for=[gate])
    gate.set_status(cl.command_execution_status.COMPLETE)
    event.wait()
    check(Chained(*(None if each is None else each.get() for each in bound.outputs)), FRAME)


def test_device_arrays(device: Device) -> None:
    bound = Chain().bind(device, FRAME.shape, FRAME.dtype)
    bound.inputs[0].set(FRAME)
    check(Chained(*(None if each is None else each.get() for each in bound.run())), FRAME)


def test_a_traced_sequence_gives_the_same_result(memory: dict[str, Any], tmp_path: Path) -> None:
    with Trace(tmp_path / "trace.json"):
        result = Chain()(FRAME, device=memory["device"])
    check(result, FRAME)


OTHER = np.arange(300, 400, dtype=np.int32)[::-1].copy()


class Noted:
    """Bound stage that notes how it is called."""

    def __init__(self, bound: Any, notes: list[Any]) -> None:
        self.bound, self.outputs, self.notes = bound, bound.outputs, notes

    def __call__(self, *frames: Any, out: Any, wait_for: Any = None) -> Any:
        self.notes.append((frames, out, wait_for, self.bound(*frames, out=out, wait_for=wait_for)))
        return self.notes[-1][-1]


@pytest.mark.parametrize("with_out", [False, True])
@pytest.mark.parametrize("with_frame", [False, True])
def test_arrays_of_the_caller(device: Device, with_frame: bool, with_out: bool) -> None:
    """They take the place of the arrays of the sequence, which stay as they are."""
    bound: Any = Chain().bind(device, FRAME.shape, FRAME.dtype)
    bound.inputs[0].set(FRAME)
    own = [each for each in bound.outputs if each is not None]
    for each in own:
        each.set(np.full_like(FRAME, -7))
    given = device.empty(FRAME.shape, FRAME.dtype)
    given.set(OTHER)
    last, parity, first = (device.empty(FRAME.shape, FRAME.dtype) for _ in range(3))
    out = Chained(last, None, parity, first) if with_out else None
    notes: list[Any] = []
    bound._bounds = tuple(Noted(each, notes) for each in bound._bounds)
    if with_frame or with_out:
        event = bound(*[given] * with_frame, out=out, wait_for=["gate"][:0])
        event.wait()
        (frames, results, gate, begun), (_, _, later, ended) = notes
        assert (frames[0] is given, later, event is ended, bound.begun is begun) == (with_frame, None, True, True)
        assert gate == []
        assert (results.scaled is first, results.parity is parity) == (with_out, with_out)
        written = Chained(*(None if each is None else each.get() for each in (out or bound.outputs)))
        check(written, OTHER if with_frame else FRAME)
        if with_out:
            assert all(np.all(each.get() == -7) for each in own)
    else:
        bound._bounds = tuple(each.bound for each in bound._bounds)
        check(Chained(*(None if each is None else each.get() for each in bound.run())), FRAME)


def test_wrong_arrays_of_the_caller_are_refused(device: Device) -> None:
    bound = Chain().bind(device, FRAME.shape, FRAME.dtype)
    with pytest.raises(TypeError, match="Chain: expected 1 input arrays, got 2"):
        bound(*bound.inputs, *bound.inputs)
    last, _, parity, _ = bound.outputs
    with pytest.raises(ValueError, match=r"out\.first is missing"):
        bound(out=Chained(last, None, parity, None))
    with pytest.raises(TypeError, match="a sequence has several launches; use enqueue_arguments of each of its stages"):
        _ = bound.enqueue_arguments


@dataclass(frozen=True)
class Wrong(Chain):
    """Sequence whose second stage takes arrays that do not fit or are not computed."""

    takes: tuple[str, ...] = ()

    def layout(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Layout:
        found = super().layout(device, shape, dtype)
        stages = [found.stages[0], found.stages[1], Stage("again", Scale(), self.takes)]
        return Layout(found.inputs, stages, found.outputs)


@pytest.mark.parametrize(
    ("takes", "message"),
    [
        (("triple.parity",), "stage 'again' takes 'triple.parity', which no earlier stage computes"),
        (("frame", "frame"), r"stage 'again' expects .*int32.*, is given .*int32.*int32"),
    ],
)
def test_a_stage_that_takes_what_does_not_fit_is_refused(device: Device, takes: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Wrong(takes).specs(device, FRAME.shape, FRAME.dtype)


def test_memory_of_all_stages_is_counted(device: Device) -> None:
    """Four arrays of 100 integers: frame, two of the first stage, one of the second one."""
    assert Chain().specs(device, FRAME.shape, FRAME.dtype).nbytes == 4 * 400


def test_calls_of_a_traced_sequence_are_recorded(device: Device, tmp_path: Path) -> None:
    with Trace(tmp_path / "trace.json"):
        bound = Chain().bind(device, FRAME.shape, FRAME.dtype, queue=device.new_queue(profiling=True))
        bound.run()
        bound().wait()
        bound.on_host([FRAME])
    events = json.loads((tmp_path / "trace.json").read_text())["traceEvents"]
    names = [each["name"] for each in events if each["ph"] == "X" and "Chain" in json.dumps(each)]
    assert {name: names.count(name) for name in names} == {
        "bind": 1,
        "launch sequence": 3,
        "launch and wait": 1,
        "run": 1,
    }
