"""Rehearsal of a placement loop: its start, its length, what the loop is told, and the gains that the message tries."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.placement import rehearsal
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import count_commands, predicted_frames

PRESET = read_machine("look_while_place")
AXES = (Axis(resonance=2.0 * math.pi * 90.0), Axis(), Axis(resonance=2.0 * math.pi * 60.0))
MACHINE: Machine = dataclasses.replace(
    PRESET, axes=AXES, swing=(1e-6, 0.0, 2e-3), control=Control(gain=0.1, watchdog=2.0), rate=1000.0
)
START = np.array([50e-6, 50e-6, 2.5e-3])  # half of the landing zone
RESPONSE = predicted_frames(MACHINE, START)
FRAMES = RESPONSE + 167  # ten periods at 60 Hz: 166.7 ms


@pytest.mark.parametrize(
    ("first", "last", "reason"),
    [
        (0.5, 0.49, ""),
        (0.5, 0.51, "a resonance swings up"),
        (1e-3, 0.0099, ""),  # below a hundredth of the tolerance any error is settled
        (1e-3, 0.0101, "a resonance swings up"),
    ],
)
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_errors_of_the_second_half_are_the_smaller_ones(
    monkeypatch: pytest.MonkeyPatch, axis: int, first: float, last: float, reason: str
) -> None:
    """Errors in parts of the tolerance; those of the step response do not count."""
    made: dict[str, Any] = {}
    limits = np.array([3e-6, 3e-6, 1e-3])
    error = np.zeros((FRAMES + 1, 3))
    error[:RESPONSE] = -99.0 * limits
    middle = RESPONSE + math.ceil((FRAMES + 1 - RESPONSE) / 2)
    error[RESPONSE, axis] = error[middle - 1, axis] = -first * limits[axis]
    error[middle, axis] = last * limits[axis]

    def plant(axes: Any, **more: Any) -> Any:
        made.update(axes=axes, **more)
        return SimpleNamespace(pose=lambda time: error[np.asarray(time)])

    def sensor(pose: Any, **more: Any) -> Any:
        made["sensor"] = more
        return "sensor"

    def place(machine: Any, target: Any, *parts: Any) -> Any:
        made.update(machine=machine, target=target)
        assert parts[1] == "sensor"
        return SimpleNamespace(released=True, reason="", record=SimpleNamespace(time=np.arange(FRAMES + 1)))

    monkeypatch.setattr(rehearsal, "SimulatedPlant", plant)
    monkeypatch.setattr(rehearsal, "SimulatedPoseSensor", sensor)
    monkeypatch.setattr(rehearsal, "place_part", place)
    assert rehearsal._failure(MACHINE) == reason
    moved: Machine = made["machine"]
    assert moved.settling == Settling(rule="fixed", wait=moved.settling.wait)
    assert moved.settling.wait == pytest.approx(FRAMES * 1e-3)
    assert moved.tolerance == dataclasses.replace(MACHINE.tolerance, max_time=moved.tolerance.max_time)
    assert moved.tolerance.max_time == pytest.approx(2.0 * FRAMES * 1e-3 + 1.0)
    np.testing.assert_array_equal(made["target"], np.zeros(3))
    np.testing.assert_allclose(made["start"], START)
    assert (made["axes"], made["swing"], made["history"]) == (AXES, MACHINE.swing, count_commands(moved))
    seen = made["sensor"]
    assert (seen["period"], seen["delay"], seen["is_noisy"]) == (1e-3, MACHINE.delay.latency, False)
    np.testing.assert_allclose(seen["covariance"], np.diag((0.1 * limits) ** 2))


def test_the_run_is_long_enough_and_not_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    assert rehearsal._run_frames(MACHINE) == FRAMES
    asked: list[Machine] = []
    monkeypatch.setattr(rehearsal, "_failure", lambda machine: (asked.append(machine), "")[1])
    for frames in (20_000, 20_001):
        monkeypatch.setattr(rehearsal, "_run_frames", lambda _, frames=frames: frames)
        if frames == 20_000:
            rehearsal.check_resonances(MACHINE)
            assert asked == [MACHINE]
            rehearsal.check_resonances(PRESET)
            assert asked == [MACHINE]
            continue
        with pytest.raises(ValueError, match=r"slowest resonance, 60 Hz, takes 20001 frames, more than 20000"):
            rehearsal.check_resonances(MACHINE)
        rehearsal.check_resonances(PRESET)


@pytest.mark.parametrize(
    ("settles", "too_long", "tried", "advice"),
    [
        (0.05, 0.0, 1, "; it settles with the gain 0.05"),
        (0.0126, 0.0, 3, "; it settles with the gain 0.013"),
        (0.0126, 0.024, 3, ""),  # the slow ones take too many frames
        (0.0, 0.0, 6, ""),  # halves down to 1e-3: 0.05 to 0.0016
    ],
)
def test_gains_are_halved_for_the_message(
    monkeypatch: pytest.MonkeyPatch, settles: float, too_long: float, tried: int, advice: str
) -> None:
    asked: list[float] = []

    def failure(machine: Machine) -> str:
        asked.append(machine.loop_gain)
        return "" if machine.loop_gain <= settles else "it swings"

    monkeypatch.setattr(rehearsal, "_failure", failure)
    monkeypatch.setattr(rehearsal, "_run_frames", lambda machine: 20_001 if machine.loop_gain < too_long else 20_000)
    expected = f"the loop of gain 0.1 does not settle with these axes: it swings{advice}"
    with pytest.raises(ValueError, match=f"^{expected}$"):
        rehearsal.check_resonances(MACHINE)
    if not too_long:
        assert asked == pytest.approx([0.1 / 2**power for power in range(tried + 1)])


def test_eight_gains_are_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(rehearsal, "_failure", lambda machine: (asked.append(machine.loop_gain), "it swings")[1])
    with pytest.raises(ValueError, match=r"it swings$"):
        rehearsal.check_resonances(dataclasses.replace(MACHINE, control=Control(gain=0.35)))
    assert asked == pytest.approx([0.35 / 2**power for power in range(9)])
