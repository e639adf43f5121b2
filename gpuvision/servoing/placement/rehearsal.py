"""Run of a placement loop without a camera: whether the axes of a machine, with their resonances, settle."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.placement.control import Settling
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import count_commands, place_part, predicted_frames
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.simulated_sensor import SimulatedPoseSensor

Float64 = npt.NDArray[np.float64]

_PERIODS = 10.0  # length of the run beyond the step response [periods of the slowest resonance] (chosen)
_START = 0.5  # start error as a part of the landing zone (chosen)
# Standard deviations of the poses that the observer gets, as a part of the tolerance (chosen): the poses have no error.
_SIGMA = 0.1
_SETTLED = 0.01  # largest error that counts as settled, as a part of the tolerance (chosen)
_HALVINGS = 8  # gains that are tried for the message
_MAX_FRAMES = 20_000  # longest run (chosen: about 6 s of computing)


def check_resonances(machine: Machine) -> None:
    """Check that the loop settles with the axes of a machine.

    Parameters
    ----------
    machine : Machine
        Machine. Its limit of the gain does not include the resonances of the axes.

    Raises
    ------
    ValueError
        The loop swings up, or it gives up: the message names a gain that settles, where one is found. Or the run would
        take more than 20 000 frames.

    Notes
    -----
    Without a resonance there is nothing to check. With one, the loop runs from a start error on the simulated axes with
    exact poses. After the step response it goes on for ten periods of the slowest resonance: the largest error in the
    second half of this time must be below the one in the first half. Cost: about 0.3 ms a frame.
    """
    if not any(axis.resonance for axis in machine.axes):
        return
    if (frames := _run_frames(machine)) > _MAX_FRAMES:
        slowest = min(axis.resonance for axis in machine.axes if axis.resonance) / (2.0 * math.pi)
        raise ValueError(
            f"the check of the slowest resonance, {slowest:.3g} Hz, takes {frames} frames, more than {_MAX_FRAMES}; "
            "raise the resonance, or leave it out"
        )
    reason = _failure(machine)
    if not reason:
        return
    control = machine.control
    gains = (machine.loop_gain / 2.0**power for power in range(1, _HALVINGS + 1))
    lower = (replace(machine, control=replace(control, gain=gain)) for gain in gains if gain > 1e-3)
    found = next((each.loop_gain for each in lower if _run_frames(each) <= _MAX_FRAMES and not _failure(each)), None)
    advice = "" if found is None else f"; it settles with the gain {found:.2g}"
    raise ValueError(f"the loop of gain {machine.loop_gain:.3g} does not settle with these axes: {reason}{advice}")


def _start(machine: Machine) -> Float64:
    """Return the start error (3,) of the run."""
    zone = machine.tolerance
    return _START * np.array([zone.landing_zone, zone.landing_zone, zone.landing_angle])


def _run_frames(machine: Machine) -> int:
    """Return the number of frames of the run: the step response, and periods of the slowest resonance."""
    slowest = min(axis.resonance for axis in machine.axes if axis.resonance)
    periods = _PERIODS * 2.0 * math.pi / slowest
    return predicted_frames(machine, _start(machine)) + math.ceil(periods * machine.rate)


def _failure(machine: Machine) -> str:
    """Return why the loop does not settle; empty if it does."""
    zone, start = machine.tolerance, _start(machine)
    response, wait = predicted_frames(machine, start), _run_frames(machine) * machine.period
    moved = replace(
        machine, settling=Settling(rule="fixed", wait=wait), tolerance=replace(zone, max_time=2.0 * wait + 1.0)
    )
    plant = SimulatedPlant(machine.axes, start=start, swing=machine.swing, history=count_commands(moved))
    limits = np.array([zone.position, zone.position, zone.angle])
    sensor = SimulatedPoseSensor(
        plant.pose,
        period=machine.period,
        delay=machine.delay.latency,
        covariance=np.diag((_SIGMA * limits) ** 2),
        is_noisy=False,
    )
    placement = place_part(moved, np.zeros(3), plant, sensor, SimulatedClock())
    if not placement.released:
        return placement.reason
    swing = np.abs(plant.pose(placement.record.time[response:])) / limits
    first, last = (float(each.max()) for each in np.array_split(swing, 2))
    return "a resonance swings up" if last > max(first, _SETTLED) else ""
