"""Report of the scatter of a head at rest, and the move that identifies its vibration."""

from __future__ import annotations

import math
import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.placement import rehearsal
from gpuvision.workflows import placement_cell
from gpuvision.workflows.placement_cell import PlacementCell, Repeatability

NAMES = ("x_m", "y_m", "theta_rad")


def test_report_of_the_repeatability() -> None:
    error = np.array([[1e-6, 2e-6, 1e-4], [3e-6, 2e-6, 5e-4], [5e-6, 8e-6, 3e-4]])
    frame, pixel = np.array([1e-6, 2e-6, 3e-4]), np.array([4e-6, 5e-6, 6e-4])
    report = Repeatability(error, frame, pixel).report()
    assert report.pop("frames") == 3
    expected = {
        "measured_sigma": (2e-6, np.sqrt(12.0) * 1e-6, 2e-4),
        "predicted_sigma": frame,
        "mean": (3e-6, 4e-6, 3e-4),
        "predicted_sigma_of_mean": pixel,
    }
    assert set(report) == set(expected)
    for key, values in expected.items():
        assert report[key] == pytest.approx(dict(zip(NAMES, values, strict=True)))


def test_one_frame_has_no_scatter_and_no_frame_no_mean() -> None:
    zero = np.zeros(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # of NumPy, for a mean of nothing
        one, none = (Repeatability(np.ones((count, 3)), zero, zero).report() for count in (1, 0))
    assert one["mean"] == dict.fromkeys(NAMES, 1.0)
    for values in (one["measured_sigma"], none["measured_sigma"], none["mean"]):
        assert np.isnan(list(values.values())).all()


def test_vibration_is_identified_in_twelve_periods_of_the_slowest_resonance(monkeypatch: pytest.MonkeyPatch) -> None:
    """The head waits after its response; a placement may take that much longer. A rigid axis does not count."""

    def changed(old: Any, **changes: Any) -> Any:
        return SimpleNamespace(**{**vars(old), **changes})

    for module in (rehearsal, placement_cell):
        monkeypatch.setattr(module, "replace", changed)
    monkeypatch.setattr(rehearsal, "Settling", SimpleNamespace)
    monkeypatch.setattr(rehearsal, "predicted_frames", lambda machine, start: 20)
    started: list[float] = []

    def vibration(record: Any, start: float) -> Any:
        started.append(start)
        return np.array([[30.0, 20.0, 0.0], [0.02, 0.03, 0.0]])

    monkeypatch.setattr(rehearsal, "vibration_of_loop", vibration)
    machine: Any = SimpleNamespace(
        axes=[SimpleNamespace(resonance=2.0 * math.pi * frequency) for frequency in (30.0, 20.0, 0.0)],
        period=1e-3,
        landing=0.25,
        swing=(0.0, 0.0, 0.0),
        tolerance=SimpleNamespace(max_time=1.0),
        settling=SimpleNamespace(rule="vibration", frequency=None, damping=None),
        pipette_in_camera=SimpleNamespace(pose=None),
    )
    cell = object.__new__(PlacementCell)
    cell.machine = machine
    steered: list[Any] = []

    def steer(moved: Any, *_: Any) -> Any:
        steered.append(moved)
        return SimpleNamespace(released=True, record=None, first_pose=0.5), None

    monkeypatch.setattr(cell, "_steer", steer)
    cell.identify(np.zeros(3))
    (moved,) = steered
    wait = 20e-3 + 12 / 20.0
    assert (moved.settling.rule, moved.settling.wait) == ("fixed", pytest.approx(wait))
    assert moved.tolerance.max_time == pytest.approx(1.0 + wait + 0.25)
    assert started == [pytest.approx(0.52)]
    assert cell.machine.settling.rule == "vibration"
    assert cell.machine.settling.frequency == (30.0, 20.0, 0.0)
    assert cell.machine.settling.damping == (0.02, 0.03, 0.0)
    monkeypatch.setattr(cell, "_steer", lambda *_: (SimpleNamespace(released=False, reason="no pose"), None))
    with pytest.raises(ValueError, match="the vibration of the head cannot be identified: no pose"):
        cell.identify(np.zeros(3))


@pytest.mark.parametrize(("landing", "first"), [(None, 0), (object(), 3)])
def test_a_head_at_rest_is_measured_at_the_target(landing: object, first: int) -> None:
    """The coarse registration of 2.5 frames comes first; poses with a flag do not count."""
    target, true = np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0])
    machine: Any = SimpleNamespace(
        landing=2.5e-3, rate=1000.0, period=1e-3, pipette_in_camera=SimpleNamespace(pose=true)
    )
    followed: list[Any] = []
    times: list[float] = []

    class Sensor:
        def reset(self) -> None:
            times.append(-1.0)

        def __call__(self, time: float) -> list[Any]:
            times.append(time)
            good = SimpleNamespace(pose=target + len(times), status=0)
            return [good, SimpleNamespace(pose=target, status=1)]

    cell: Any = object.__new__(PlacementCell)
    cell.machine, cell._plan, cell._sensor = machine, SimpleNamespace(target=target, landing=landing), Sensor()
    cell._camera = SimpleNamespace(follow=lambda *given: followed.append(given))
    error = cell.rest(4)
    ((pose, camera),) = followed
    np.testing.assert_array_equal(pose(np.zeros(2)), [target, target])
    assert camera is true
    assert times == pytest.approx([-1.0, *(1e-3 * frame for frame in range(first + 4))])
    np.testing.assert_allclose(error, np.repeat(np.arange(2.0, first + 6)[:, None], 3, axis=1))


def test_reach_is_the_largest_error_in_a_period_after_the_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """The head touches 0.1 s after the last frame, at 1.5 s; the slowest resonance has 10 Hz. Poses are t, 2 t, 3 t."""
    asked: list[np.ndarray] = []

    def pose(time: Any) -> np.ndarray:
        asked.append(np.asarray(time))
        return np.multiply.outer(time, [1.0, 2.0, 3.0])

    plant = SimpleNamespace(pose=pose)
    times = np.array([0.0, 0.5, 1.0, 1.4])
    run: Any = SimpleNamespace(released=True, record=SimpleNamespace(time=times))
    cell = object.__new__(PlacementCell)
    cell.machine = machine = SimpleNamespace(  # type: ignore[assignment]
        axes=[SimpleNamespace(resonance=2.0 * math.pi * frequency) for frequency in (10.0, 40.0, 0.0)],
        settling=SimpleNamespace(lead=0.1),
    )
    target, offset = np.array([0.25, 0.5, 1.0]), np.array([0.05, 0.25, 0.5])
    cell._plan = SimpleNamespace(target=target)  # type: ignore[assignment]
    given: list[Any] = []
    monkeypatch.setattr(cell, "_steer", lambda *args: given.append(args) or (run, plant))
    monkeypatch.setattr(placement_cell, "error_share", lambda _, error: float(np.abs(error).max()))
    start, swing, true = (np.full(3, value) for value in (1.0, 2.0, 3.0))
    placement, motion, reach = cell.place(start, swing, true, offset, 7)
    assert given == [(machine, start, swing, true, 7)]
    assert placement is run
    np.testing.assert_allclose(motion, np.outer(times, [1.0, 2.0, 3.0]) - target)
    np.testing.assert_allclose(asked[1], np.linspace(1.5, 1.6, 33))
    assert reach == pytest.approx(3.0 * 1.6 - 1.5)
    for axis in machine.axes:
        axis.resonance = 0.0
    assert cell.place(start, swing, true, offset, 7)[2] == pytest.approx(3.0 * 1.5 - 1.5)  # rigid axes: at the contact
    run.released = False
    assert math.isnan(cell.place(start, swing, true, offset, 7)[2])
