"""Chains of a stream are checked before a frame is read; copies of a slot; times of its stages."""

from __future__ import annotations

import re
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pyopencl as cl
import pytest

from gpuvision.host import Device, ring
from gpuvision.host.launch import Specs, nbytes_of
from gpuvision.host.operation import Operation
from gpuvision.host.ring import SharedSlot, StagedSlot, Step, check_chain, queues_of, slot_bytes, steps_of
from streams import READOUT, currents_of

PAPER: Any = None  # the operations below ask no device
FLOAT, BYTE = np.dtype(np.float32), np.dtype(np.uint8)


class Pair(NamedTuple):
    first: Any
    second: Any


class Halves(Operation[Pair]):
    """Frames (n, 6) float32 to the columns of an index, or of a fixed length."""

    Result = Pair

    def __init__(self, lengths: Any = None, *, inputs: int = 1, single: bool = False) -> None:
        self._lengths, self._inputs = lengths, inputs
        self.takes_single_frames = single  # type: ignore[misc]

    def specs(self, device: Device, shape: tuple[int, ...], dtype: Any) -> Specs:
        first = self._lengths or (shape[0],)
        inputs = [(shape, np.dtype(dtype))] + [((5, 2), BYTE)] * (self._inputs - 1)
        outputs = {"first": None, "second": (tuple(first), FLOAT)}
        return Specs(inputs, outputs, nbytes_of((*inputs, *outputs.values())))


class Frames(Halves):
    """Another name in messages."""


def test_a_result_needs_the_batch_as_its_first_axis() -> None:
    """The message names the last operation and the field, with its shape for the batch at which it differs."""
    text = "Frames: second has shape {} for a batch of {} frames; a stream needs results with the batch as their first "
    for chain, shape, size in (
        ([Frames((4, 3))], (4, 3), 5),
        ([Halves(), Frames((4,))], (4,), 5),
        ([Halves(), Halves(), Frames((7, 1))], (7, 1), 4),
    ):
        with pytest.raises(ValueError, match=re.escape(f"{text}axis".format(shape, size)) + "$"):
            check_chain(steps_of(chain), PAPER, 4, (6,), FLOAT)
    check_chain(steps_of([Frames((4,)), Halves()])[1:], PAPER, 4, (6,), FLOAT)


def test_a_scalar_result_has_no_axis() -> None:
    class Sum(Halves):
        def specs(self, device: Device, shape: tuple[int, ...], dtype: Any) -> Specs:
            return Specs([(shape, np.dtype(dtype))], {"first": ((), FLOAT)}, 4)

    with pytest.raises(ValueError, match=r"Sum: first has shape \(\) for a batch of 1 frames"):
        check_chain([Step(Sum())], PAPER, 1, (6,), FLOAT)


def test_single_frames_need_batches_of_one() -> None:
    chain = steps_of([Halves(), Frames(single=True), Halves(single=True)])
    with pytest.raises(ValueError, match=r"^Frames, Halves takes one frame at a time; use batch=1, not 3$"):
        check_chain(chain, PAPER, 3, (6,), FLOAT)
    check_chain([Step(Frames(single=True))], PAPER, 1, (6, 2), FLOAT)
    # A result of one frame needs no axis for the batch.
    check_chain([Step(Frames((7, 2), single=True))], PAPER, 1, (6, 2), FLOAT)


def test_fixed_inputs_are_compared_with_the_inputs_of_the_operation() -> None:
    rulers = np.zeros((5, 2), np.uint8)
    check_chain([Step(Halves(inputs=2), fixed=(rulers,))], PAPER, 3, (6,), FLOAT)
    with pytest.raises(ValueError, match="Halves takes 3 arrays, a stream's source gives one; give the others"):
        check_chain([Step(Halves(inputs=3), fixed=(rulers,))], PAPER, 3, (6,), FLOAT)
    with pytest.raises(ValueError, match="Frames takes 1 arrays"):
        check_chain([Step(Frames(), fixed=(rulers,))], PAPER, 3, (6,), FLOAT)
    for wrong in (rulers[:4], rulers.astype(np.int8)):
        with pytest.raises(ValueError, match=r"Halves expects .* name what it takes: Step\(operation, takes="):
            check_chain([Step(Halves(inputs=2), fixed=(wrong,))], PAPER, 3, (6,), FLOAT)
    with pytest.raises(ValueError, match=r"Frames takes 'first', the operation before computes second$"):
        check_chain([Step(Halves()), Step(Frames(), takes=("first",))], PAPER, 3, (6,), FLOAT)


def test_the_memory_of_a_slot_counts_fixed_inputs() -> None:
    """3 frames of 6 floats, 10 bytes of fixed input, 3 floats of a result; those 3 in, and out again; times."""
    chain = [Step(Halves(inputs=2), fixed=(np.zeros((5, 2), np.uint8),)), Step(Halves())]
    arrays = 3 * 24 + 10 + 12 + 12 + 12
    assert slot_bytes(chain, PAPER, 3, (6,), FLOAT, zero_copy=True) == arrays + 3 * 8
    # Copies: of the first step's inputs, and of the last result.
    assert slot_bytes(chain, PAPER, 3, (6,), FLOAT, zero_copy=False) == arrays + 3 * 8 + 82 + 12


def test_copies_have_queues_of_their_own(device: Device) -> None:
    shared = queues_of(device, 1, zero_copy=True, profiling=True, inline=False)[0]
    assert shared.upload is shared.compute is shared.download
    apart = queues_of(device, 1, zero_copy=False, profiling=True, inline=False)[0]
    assert apart.all == (apart.upload, apart.compute, apart.download)
    assert len(set(apart.all)) == 3
    profiling = cl.command_queue_properties.PROFILING_ENABLE
    assert all(queue.properties & profiling for queue in (*shared.all, *apart.all))


def test_the_download_lasts_from_its_first_copy_to_its_last(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """A reading has three computed fields, each of which is copied."""
    copied: list[tuple[Any, Any]] = []
    copy = cl.enqueue_copy

    def recorded(queue: Any, *args: Any, **options: Any) -> Any:
        copied.append((queue, copy(queue, *args, **options)))
        return copied[-1][1]

    queues = queues_of(device, 1, zero_copy=False, profiling=True, inline=False)[0]
    currents = currents_of(3, strips=40_000)
    slot: StagedSlot[Any] = StagedSlot([Step(READOUT)], device, queues, 3, currents.shape[1:], currents.dtype)
    slot.frames[...] = currents
    expected = READOUT(currents, device=device)
    monkeypatch.setattr(cl, "enqueue_copy", recorded)
    slot.launch()
    slot.wait()
    np.testing.assert_array_equal(slot.result.position, expected.position)
    np.testing.assert_array_equal(slot.result.status, expected.status)
    assert [queue for queue, _ in copied] == [queues.upload] + 3 * [queues.download]
    times = [(event.profile.start, event.profile.end) for _, event in copied]
    spans = slot.spans()
    assert list(spans) == ["upload", "compute", "download"]
    assert spans["upload"] == times[0]
    assert spans["download"] == (min(start for start, _ in times[1:]), max(end for _, end in times[1:]))


def test_steps_of_a_slot_follow_one_another(device: Device) -> None:
    queues = queues_of(device, 1, zero_copy=False, profiling=True, inline=False)[0]
    currents = currents_of(3, strips=40_000)
    slot: StagedSlot[Any] = StagedSlot([Step(READOUT)], device, queues, 3, currents.shape[1:], currents.dtype)
    slot.frames[...] = currents
    slot.launch()
    slot.wait()
    spans = slot.spans()
    assert spans["upload"][1] <= spans["compute"][0] < spans["compute"][1] <= spans["download"][0]
    assert slot.queued <= spans["compute"][0]


@pytest.mark.parametrize("kind", [StagedSlot, SharedSlot])
def test_the_source_writes_the_first_input(kind: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The other inputs are the fixed arrays of a step."""
    slot = object.__new__(kind)
    slot._first, slot._outputs = SimpleNamespace(inputs=("frames", "rulers", "poses")), Pair(None, "second")
    monkeypatch.setattr(StagedSlot, "_pinned", lambda _, array: f"host {array}")
    monkeypatch.setattr(ring, "host_view", lambda array: f"host {array}")
    assert slot._host_side() == ("host frames", Pair(None, "host second"))


def test_a_short_batch_trims_all_computed_fields(device: Device) -> None:
    queues = queues_of(device, 1, zero_copy=False, profiling=False, inline=False)[0]
    slot: StagedSlot[Any] = StagedSlot([Step(READOUT)], device, queues, 4, (5, 2), np.dtype(np.float32))
    slot.count = 4
    assert slot.trimmed_result() is slot.result
    slot.count = 3
    trimmed = slot.trimmed_result()
    assert type(trimmed) is type(slot.result)
    shapes = {name: each.shape for name, each in trimmed._asdict().items() if each is not None}
    assert shapes == {"position": (3, 5), "total": (3, 5), "status": (3, 5)}
    assert np.shares_memory(trimmed.total, slot.result.total)
    assert not slot.arrived.any()
    assert slot.arrived.shape == (4,)
