"""Time of a benchmark run: it ends in time, and no case is measured longer than asked for."""

from __future__ import annotations

import math

import pytest

from gpuvision.profiling import time_plan


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def perf_counter(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(time_plan, "time", clock)
    return clock


def run(clock: Clock, plan: time_plan.TimePlan, sections: int, cases: int, preparation: float) -> list[float]:
    granted = []
    for _ in range(sections):
        with plan.section():
            for _ in range(cases):
                clock.now += preparation / cases
                granted.append(plan.grant())
                clock.now += granted[-1]
    return granted


@pytest.mark.parametrize(("cases", "preparation"), [(1, 1.0), (6, 0.5), (20, 12.0)])
def test_a_run_ends_in_its_time(clock: Clock, cases: int, preparation: float) -> None:
    """Whatever the sections take for preparation, and however many cases they have."""
    plan = time_plan.TimePlan(600.0, 50.0, [0.0] * 40)
    granted = run(clock, plan, 40, cases, preparation)
    assert plan.elapsed == pytest.approx(600.0, rel=1e-6)
    # All cases have the same time, except in the first section, whose number of cases is not known before.
    assert granted[cases:] == pytest.approx([granted[-1]] * (39 * cases), rel=1e-6)


def test_a_run_with_a_long_last_section_ends_in_its_time(clock: Clock) -> None:
    """The cases before a section of known length leave the time for it, wherever it stands."""
    for known in ([0.0] * 9 + [200.0], [200.0] + [0.0] * 9):
        plan = time_plan.TimePlan(600.0, 50.0, known)
        granted = [each for more in known for each in run(clock, plan, 1, 4, 2.0 + more)]
        assert plan.elapsed == pytest.approx(600.0, rel=1e-6)
        assert granted[4:] == pytest.approx([granted[-1]] * 36, rel=1e-6)


def test_a_repeated_attempt_does_not_count_as_more_cases(clock: Clock) -> None:
    plan = time_plan.TimePlan(100.0, 50.0, [0.0] * 2)
    with plan.section():
        for _ in range(2):
            plan.grant()
        clock.now += 10.0
        plan.repeat()
        for _ in range(2):
            plan.grant()
    with plan.section():
        assert plan.grant() == pytest.approx(45.0)


def test_no_case_is_measured_longer_than_asked_for(clock: Clock) -> None:
    assert set(run(clock, time_plan.TimePlan(math.inf, 2.0, [0.0] * 3), 3, 4, 1.0)) == {2.0}
    assert set(run(clock, time_plan.TimePlan(1e4, 2.0, [0.0] * 3), 3, 4, 1.0)) == {2.0}


def test_without_time_each_case_gets_the_shortest_measurement(clock: Clock) -> None:
    plan = time_plan.TimePlan(1.0, 2.0, [0.0] * 10)
    assert set(run(clock, plan, 10, 2, 30.0)) == {0.05}


def test_a_section_is_repeated_only_if_the_others_still_have_time(clock: Clock) -> None:
    plan = time_plan.TimePlan(100.0, 2.0, [0.0] * 2)
    with plan.section():
        clock.now += 40.0
        assert plan.allows_repetition()  # 60 s are left: 40 for the repetition, and 5 to prepare the other section
        clock.now += 15.0
        assert not plan.allows_repetition()


def test_the_time_of_a_repetition_is_that_of_the_last_attempt(clock: Clock) -> None:
    plan = time_plan.TimePlan(100.0, 2.0, [0.0] * 1)
    with plan.section():
        clock.now += 40.0
        plan.repeat()
        clock.now += 25.0
        assert plan.allows_repetition()  # 35 s are left for an attempt of 25 s; the section has taken 65 s
        plan.repeat()
        clock.now += 20.0
        assert not plan.allows_repetition()
