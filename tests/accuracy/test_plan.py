"""Choice of settings by error and time: margins, refusals, time limits, tables."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import pytest

from gpuvision.accuracy.plan import AccuracyLimits, AccuracyPlan, PlanError, check_time, fastest_within, time_limit
from gpuvision.accuracy.trial import CallTime, at_least, loop_times, median_times, trial_table


class Setting(NamedTuple):
    name: str
    seconds: float
    error: float

    @property
    def error_parts(self) -> dict[str, float]:
        return {"noise": 0.5 * self.error, "bias": 0.25 * self.error}

    @property
    def legend(self) -> str:
        return "errors in um"

    def cells(self) -> dict[str, str]:
        return {"setting": self.name, "us": f"{1e6 * self.seconds:g}", "error": f"{1e6 * self.error:g}"}

    def to_dict(self) -> dict[str, Any]:
        return self._asdict()


@dataclass(frozen=True, kw_only=True)
class SettingPlan(AccuracyPlan[Setting]):
    kind: ClassVar[str] = "setting"
    unit: ClassVar[str] = "image"

    @property
    def usable(self) -> list[Setting]:
        return [each for each in self.trials if each.error > 0.0]


COARSE, MIDDLE, FINE = Setting("coarse", 1e-4, 8e-6), Setting("middle", 2e-4, 4e-6), Setting("fine", 8e-4, 2e-6)
TRIALS = (COARSE, MIDDLE, FINE)
LIMITS = AccuracyLimits(margin=1.25)


@pytest.mark.parametrize(
    ("tolerance", "expected"), [(1.1, COARSE), (10e-6, COARSE), (9.99e-6, MIDDLE), (5e-6, MIDDLE), (2.5e-6, FINE)]
)
def test_the_fastest_setting_within_the_margin_is_chosen(tolerance: float, expected: Setting) -> None:
    """The margin is 1.25: an error of 8 um needs a tolerance of 10 um."""
    assert fastest_within(TRIALS, TRIALS[::-1], tolerance * (1.0 + 1e-12), 1.25, "setting") == expected


def test_only_usable_settings_are_chosen() -> None:
    assert fastest_within(TRIALS, TRIALS[1:], 1.0, 1.25, "setting") == MIDDLE
    with pytest.raises(PlanError) as refusal:
        fastest_within(TRIALS, TRIALS[:2], 4.9e-6, 1.25, "setting")
    assert str(refusal.value) == (
        "no setting meets an error of 4.9 um; the most accurate, middle, is predicted 4 um (noise 2 um, bias 1 um): "
        "ask for 5 um or more"
    )
    assert (refusal.value.trials, refusal.value.usable) == (TRIALS, TRIALS[:2])
    # The tolerance that the refusal names is met.
    assert fastest_within(TRIALS, TRIALS[:2], 5e-6, 1.25, "setting") == MIDDLE


@pytest.mark.parametrize("error", [7.2218e-6, 3.3e-9, 1.0001e-3, 2e-6 / 3])
def test_a_named_tolerance_is_the_next_one_with_three_digits(error: float) -> None:
    named = 1e-6 * float(at_least(error).removesuffix(" um"))
    assert error * (1.0 - 1e-9) <= named <= 1.011 * error


def test_a_rate_and_a_latency_limit_the_time() -> None:
    assert time_limit(None, None, 1.25, "frame") is None
    by_rate = time_limit(100.0, None, 1.25, "frame")
    assert by_rate is not None
    assert by_rate.seconds == pytest.approx(8e-3)
    assert by_rate.reason == "a rate of 100 frames/s"
    by_latency = time_limit(100.0, 5e-3, 1.25, "frame")
    assert by_latency is not None
    assert by_latency.seconds == pytest.approx(4e-3)
    assert by_latency.reason == "a latency of 5000 us"
    assert time_limit(100.0, 11e-3, 1.25, "frame") == by_rate


@pytest.mark.parametrize(
    ("rate", "latency", "message"),
    [
        (None, 0.1, "a latency needs a rate; give the frames per second as well"),
        (0.0, None, "rate is 0.0, expected"),
        (math.inf, None, "rate must be finite"),
        (10.0, 0.0, "latency is 0.0, expected"),
    ],
)
def test_wrong_limits_are_refused(rate: float | None, latency: float | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        time_limit(rate, latency, 1.25, "frame")


@pytest.mark.parametrize("name", ["margin", "rate_margin"])
def test_margins_are_1_or_more(name: str) -> None:
    assert getattr(AccuracyLimits(**{name: 1.0}), name) == 1.0
    with pytest.raises(ValueError, match=rf"AccuracyLimits\.{name} is 0\.99, expected"):
        AccuracyLimits(**{name: 0.99})


def test_a_setting_that_is_too_slow_is_refused_with_the_nearest_ones() -> None:
    def check(chosen: Setting, rate: float, usable: tuple[Setting, ...] = TRIALS) -> None:
        check_time(chosen, TRIALS, usable, time_limit(rate, None, 1.25, "frame"), 1.25, "setting")

    check(FINE, 1000.0)  # 0.8 ms, as the limit
    limit = time_limit(1000.0, None, 1.25, "frame")
    with pytest.raises(PlanError, match=r"is too slow: 880 us, a rate of 1000 frames/s allows 800 us; middle keeps up"):
        check_time(FINE, TRIALS, TRIALS, limit, 1.25, "setting", lambda each: 1.1 * each.seconds)
    check_time(FINE, TRIALS, TRIALS, None, 1.25, "setting")
    with pytest.raises(PlanError) as refusal:
        check(FINE, 1001.0)
    assert str(refusal.value) == (
        "fine is the fastest setting that meets the tolerance and is too slow: 800 us, a rate of 1001 frames/s allows "
        "799 us; middle keeps up with a predicted error of 4 um: ask for 5 um or more"
    )
    with pytest.raises(PlanError, match=r"coarse keeps up with a predicted error of 8 um: ask for 10 um or more"):
        check(FINE, 1001.0, (COARSE, FINE))
    with pytest.raises(PlanError, match=r"allows 40 us; the fastest usable setting, coarse, takes 100 us$"):
        check(FINE, 20000.0)


def test_a_plan_says_what_a_little_more_buys() -> None:
    plan = SettingPlan(chosen=MIDDLE, trials=TRIALS, tolerance=6e-6, limits=LIMITS)
    assert (plan.faster, plan.finer) == (COARSE, FINE)
    assert str(plan) == (
        "middle: predicted error 4 um of 6 um, 200 us per image; a tolerance of 10 um would allow coarse at 0.5 times "
        "the time; 2.5 um takes fine at 4 times the time"
    )
    assert plan.to_dict() == {
        "chosen": MIDDLE._asdict(),
        "tolerance": 6e-6,
        "faster": COARSE._asdict(),
        "finer": FINE._asdict(),
        "trials": [each._asdict() for each in TRIALS],
        "limits": {"margin": 1.25, "rate_margin": 1.25},
    }
    near = (Setting("a", 1.92e-4, 4.1e-6), MIDDLE, Setting("b", 8e-4, 3.84e-6))
    plan = SettingPlan(chosen=MIDDLE, trials=near, tolerance=6e-6, limits=LIMITS)
    assert (plan.faster, plan.finer) == (None, None)  # less than 5 %
    assert str(plan).endswith("no usable setting is faster")


def test_a_table_marks_the_chosen_and_the_unusable_settings() -> None:
    lost = Setting("a setting with a long name", 5e-5, math.nan)
    plan = SettingPlan(chosen=MIDDLE, trials=(lost, *TRIALS), tolerance=6e-6, limits=LIMITS)
    lines = plan.table().splitlines()
    assert [re.split(r"  +", each) for each in lines[1:-1]] == [
        ["- a setting with a long name", "50", "nan"],
        ["", "coarse", "100", "8"],
        ["* middle", "200", "4"],
        ["", "fine", "800", "2"],
    ]
    assert lines[0].split() == ["setting", "us", "error"]
    assert lines[-1] == "errors in um"
    assert len({len(each) for each in lines[:-1]}) == 1  # the columns are aligned
    assert trial_table((lost,), ()).splitlines()[1].startswith("- a setting with a long name")


@pytest.mark.parametrize("repeats", [False, True])
def test_calls_take_turns(monkeypatch: pytest.MonkeyPatch, repeats: bool) -> None:
    """Of five timed calls the middle one is the median, the second largest the upper quartile."""
    clock, order = [0.0], []

    def call(name: str, durations: list[float]) -> Any:
        taken = iter([each for duration in durations for each in ((100.0, duration) if repeats else (duration,))])

        def run() -> None:
            order.append(name)
            clock[0] += next(taken)

        return run

    monkeypatch.setattr("gpuvision.accuracy.trial.time.perf_counter", lambda: clock[0])
    calls = [call("a", [9.0, 1.0, 2.0, 3.0, 4.0]), call("b", [3.0, 3.5, 50.0, 3.0, 3.0])]
    if repeats:
        assert loop_times(calls, 5) == [CallTime(3.0, 4.0), CallTime(3.0, 3.5)]
    else:
        assert median_times(calls, 5) == [3.0, 3.0]
    assert "".join(order) == ("aabb" if repeats else "ab") * 5
