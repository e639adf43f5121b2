"""Plan of a scan: the fastest readout whose error is within the tolerance; refusals name the nearest feasible one."""

from __future__ import annotations

import dataclasses
import math
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.accuracy.plan import PlanError
from gpuvision.accuracy.trial import at_least
from gpuvision.host import Device, to_numpy
from gpuvision.host.planning import PlanLimits, plan_stream
from gpuvision.host.sources import ArraySource
from gpuvision.ranging.focus_stack import FocusStack, StageFocus
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdNoise
from gpuvision.reference.line import pixel_gaussian
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows import planning_scan, scanning
from gpuvision.workflows.planning_scan import plan_scan
from gpuvision.workflows.scan_plan import ReadoutTrial, ScanPlan, ScanPlanLimits, usable_trials
from gpuvision.workflows.scanning import scan

READ_NOISE, GAIN = 1.5, 0.1
# Each readout is a build of the kernel; the fast tier tries windows only.
FEW: tuple[dict[str, Any], ...] = (
    {"method": "windowed", "window": 6},
    {"method": "gauss3"},
    {"method": "ml", "window": 6},
)
ROWS = 30.2 + 0.01 * np.arange(480)


def try_readouts(monkeypatch: pytest.MonkeyPatch, *changes: dict[str, Any]) -> None:
    """Try the sensor's readout with these changes, as if each of them took longer than the one before."""
    monkeypatch.setattr(
        planning_scan,
        "_readouts",
        lambda sensor, *_: [dataclasses.replace(sensor.readout, **change) for change in changes],
    )
    # A busy machine must not change their order.
    monkeypatch.setattr(planning_scan, "median_times", lambda calls, _: [1e-4, 2e-4, 9e-4][: len(calls)])


@pytest.fixture
def few_readouts(monkeypatch: pytest.MonkeyPatch) -> None:
    try_readouts(monkeypatch, *FEW)


def noisy_camera(**changes: Any) -> Sensor:
    sensor = Sensor.load("camera_line")
    given: Any = sensor.readout
    readout = dataclasses.replace(
        given, threshold=20, minimum_peak=None, ambiguity=None, read_noise=READ_NOISE, gain=GAIN, **changes
    )
    return dataclasses.replace(sensor, readout=readout, noise_known=True)


def recording(rng: np.random.Generator, frames: int = 24) -> Any:
    """Return frames of one tilted line, sigma 2 px, with shot noise and read noise."""
    light = pixel_gaussian(np.arange(64)[:, None], ROWS[None], 2.0, 150.0, 4.0)  # type: ignore[arg-type]
    light = np.broadcast_to(light, (frames, 64, 480))
    noisy = rng.poisson(light / GAIN) * GAIN + rng.normal(0.0, READ_NOISE, light.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def scatter(frames: Any, plan: ScanPlan, device: Device) -> float:
    """Return the scatter of the heights: each column sees the same place in all frames."""
    z = to_numpy(scan(frames, plan.sensor, device=device).points.z).astype(np.float64)
    return math.sqrt(float(np.mean(np.var(z, axis=0, ddof=1))))


def trial(name: str, seconds: float, error: float, lost: float = 0.0) -> ReadoutTrial:
    method: Any = name
    return ReadoutTrial(LineReadout(method=method), seconds, error, error, 0.0, 0.0, 0.0, lost)


TRIALS = (trial("fir", 1.0, 9.0), trial("windowed", 2.0, 5.0), trial("gauss3", 3.0, 7.0), trial("ml", 8.0, 4.0))


def plan_of(chosen: ReadoutTrial, trials: tuple[ReadoutTrial, ...] = TRIALS) -> ScanPlan:
    return ScanPlan(
        sensor=Sensor.load("camera_line"),
        chosen=chosen,
        trials=trials,
        tolerance=6.0,
        rounding=None,
        stream=None,
        limits=ScanPlanLimits(),
    )


@pytest.mark.parametrize(("tolerance", "name"), [(10.0, "fir"), (9.44, "windowed"), (5.25, "windowed"), (5.24, "ml")])
def test_the_fastest_readout_within_the_margin_is_chosen(tolerance: float, name: str) -> None:
    """The margin is 1.05: an error of 5 needs a tolerance of 5.25."""
    shuffled = TRIALS[::-1]
    assert planning_scan._chosen(shuffled, tolerance * (1 + 1e-12), ScanPlanLimits()).readout.method == name


def test_a_refusal_names_a_tolerance_that_is_met() -> None:
    trials = [trial("ml", 8.0, error) for error in (7.2218e-6, 8e-6)]
    with pytest.raises(PlanError, match=r"the most accurate, ml 8, is predicted 7\.22 um") as refusal:
        planning_scan._chosen(trials, 7.58e-6, ScanPlanLimits())
    wanted = re.search(r"ask for ([\d.]+) um or more", str(refusal.value))
    assert wanted is not None
    assert wanted[1] == "7.59"  # 7.5829 rounded up
    assert planning_scan._chosen(trials, 1e-6 * float(wanted[1]), ScanPlanLimits()) == trials[0]


@pytest.mark.parametrize(
    ("length", "text"), [(7.944e-6, "7.95 um"), (4.4e-6, "4.4 um"), (1.2341e-3, "1240 um"), (9.999e-9, "0.01 um")]
)
def test_lengths_are_rounded_up(length: float, text: str) -> None:
    assert at_least(length) == text


def test_readouts_that_lose_samples_or_have_no_error_are_not_chosen() -> None:
    lossy, blind = trial("gauss3", 0.5, 1.0, lost=0.111), trial("fir", 0.1, math.nan, lost=1.0)
    kept, edge = trial("windowed", 2.0, 5.0, lost=0.1), trial("ml", 1.5, 5.0, lost=0.1099)
    assert usable_trials([lossy, blind, kept, edge], ScanPlanLimits()) == [kept, edge]
    assert usable_trials([lossy, kept], ScanPlanLimits(max_lost=0.02)) == [lossy, kept]
    with pytest.raises(PlanError, match="no readout gives a point"):
        planning_scan._chosen([blind], 1.0, ScanPlanLimits())


def test_the_plan_says_what_a_little_more_buys() -> None:
    plan = plan_of(TRIALS[1])
    assert plan.faster == TRIALS[0]
    assert plan.finer == TRIALS[3]
    assert str(plan) == (
        "windowed 8: predicted error 5000000 um of 6000000 um, 2000000 us per frame; a tolerance of 9.45e+06 um "
        "would allow fir 4 at 0.5 times the time; 4.2e+06 um takes ml 8 at 4 times the time; rounding is not checked, "
        "because the device has no doubles"
    )
    near = (trial("fir", 1.92, 5.1), trial("windowed", 2.0, 5.0), trial("ml", 8.0, 4.8))
    plan = plan_of(near[1], near)
    assert plan.faster is None  # less than 5 % faster, less than 5 % more accurate
    assert plan.finer is None
    assert "no usable readout is faster" in str(plan)
    report = plan_of(TRIALS[1]).to_dict()
    assert report["chosen"]["readout"] == "windowed 8"
    assert [each["error"] for each in report["trials"]] == [9.0, 5.0, 7.0, 4.0]
    assert (report["faster"]["readout"], report["finer"]["readout"]) == ("fir 4", "ml 8")


@pytest.mark.parametrize(
    ("limits", "message"),
    [
        ({"margin": 0.99}, r"ScanPlanLimits\.margin is 0\.99, expected"),
        ({"max_lost": 1.01}, r"ScanPlanLimits\.max_lost is 1\.01, expected"),
        ({"rate_margin": 0.0}, r"ScanPlanLimits\.rate_margin is 0\.0, expected"),
    ],
)
def test_limits_are_checked(limits: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ScanPlanLimits(**limits)


@pytest.mark.parametrize(("half", "windows"), [(0.8, [3]), (4.2, [8, 12]), (8.0, [12, 24]), (300.0, [180])])
def test_windows_hold_the_line(half: float, windows: list[int]) -> None:
    assert planning_scan._windows(half) == windows


def test_readouts_that_are_tried() -> None:
    """The sensor's readout first; each other one once, with the settings of the sensor."""
    sensor = noisy_camera(window=8)
    found = planning_scan._readouts(sensor, 4.2)
    given: Any = sensor.readout
    settings = [(each.method, each.window, each.fir_length) for each in found]
    window, length = given.window, given.fir_length
    assert settings == [
        ("windowed", 8, length),
        ("windowed", 12, length),
        ("gauss3", window, length),
        ("fir", window, 4),
        ("fir", window, 8),
        ("ml", 8, length),
        ("ml", 12, length),
    ]
    assert all((each.threshold, each.read_noise, each.gain) == (20, READ_NOISE, GAIN) for each in found)
    assert found[0] == given


@pytest.mark.parametrize(("largest", "takes_double"), [(5.0 * (1 + 1e-6), False), (5.0 * (1 - 1e-6), True)])
def test_precision_is_double_where_rounding_would_exceed_the_error(
    largest: float, takes_double: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Heights of 1 m and of 5 m in double precision differ by 4 m; with the error of 3 m that is 5 m."""

    def points(sensor: Sensor, sample: Any, device: Any) -> Any:
        readout: Any = sensor.readout
        z = 5.0 if readout.precision == "double" else 1.0
        return SimpleNamespace(z=np.array([z, z, np.nan])), None

    monkeypatch.setattr(planning_scan, "_points", points)
    monkeypatch.setattr(planning_scan, "_times", lambda sensor, readouts, *_: [0.25 * len(readouts)])
    chosen = trial("ml", 1.0, 3.0)
    device: Any = SimpleNamespace(has_double=True)
    sample: Any = None
    found, rounding = planning_scan._with_precision(chosen, noisy_camera(), sample, device, largest)
    assert rounding == pytest.approx(4.0)
    readout = dataclasses.replace(chosen.readout, precision="double")
    assert found == (chosen._replace(readout=readout, seconds=0.25) if takes_double else chosen)
    device.has_double = False
    assert planning_scan._with_precision(chosen, noisy_camera(), sample, device, 0.0) == (chosen, None)


def test_a_plan_with_a_stream_states_it() -> None:
    class Stream:
        def __str__(self) -> str:
            return "in batches of 4"

        def to_dict(self) -> dict[str, int]:
            return {"batch": 4}

    stream: Any = Stream()
    plan = dataclasses.replace(plan_of(TRIALS[1]), stream=stream, rounding=0.5)
    assert str(plan).endswith("4.2e+06 um takes ml 8 at 4 times the time; in batches of 4")
    report = plan.to_dict()
    assert (report["stream"], report["rounding"], report["tolerance"]) == ({"batch": 4}, 0.5, 6.0)
    assert report["limits"] == {"margin": 1.05, "max_lost": 0.01, "rate_margin": 1.25}


def test_a_plan_is_for_one_device() -> None:
    device: Any
    plan: Any
    device, plan = SimpleNamespace(label="b"), SimpleNamespace(rate=10.0, device=SimpleNamespace(label="a"))
    with pytest.raises(ValueError, match="stream_plan is for a, and b is asked for; leave out device"):
        scanning._check_plan(plan, 10.0, device)
    scanning._check_plan(plan, 10.0, plan.device)
    scanning._check_plan(plan, 10.0, None)


def test_scatter_beyond_the_texture_of_the_surface_is_an_error() -> None:
    """The readouts with little noise scatter by 3 more than it explains, one by 5; others do not tell the texture."""
    trials = [trial("fir", 1.0, 4.5), trial("windowed", 2.0, 4.0), trial("ml", 3.0, 4.0)]
    trials += [trial("gauss3", 1.0, 30.0), trial("centroid", 1.0, 4.0, lost=0.9)]
    unexplained = (3.0, 5.0, 3.0, 0.0, 0.0)
    seen = [each._replace(unexplained=one) for each, one in zip(trials, unexplained, strict=True)]
    found = planning_scan._with_unexplained(seen, ScanPlanLimits())
    assert [each.error for each in found] == [4.5, math.hypot(4.0, 4.0), 4.0, 30.0, 4.0]


def test_the_scatter_is_the_noise_of_a_curved_surface(rng: np.random.Generator) -> None:
    z = 1e-3 * np.sin(np.arange(500) / 80.0) + rng.normal(0.0, 5e-6, (40, 500))
    z[3, 100:200], z[5] = np.nan, 1.0
    z[7, ::50] += 1.0
    assert planning_scan._scatter(z) == pytest.approx(5e-6, rel=0.04)
    assert planning_scan._scatter(np.full((3, 2), np.nan)) == 0.0


@pytest.mark.slow
def test_predicted_errors_of_all_readouts_are_the_scatter(device: Device, rng: np.random.Generator) -> None:
    frames, sensor = recording(rng), noisy_camera(window=8)
    plan = plan_scan(frames, sensor, tolerance=1.0, device=device)
    assert plan.chosen == min(usable_trials(plan.trials, plan.limits), key=lambda each: each.seconds)
    assert {each.readout.method for each in plan.trials} == {"windowed", "gauss3", "fir", "ml"}
    assert [each.seconds for each in plan.trials] == sorted(each.seconds for each in plan.trials)
    for each in plan.trials:
        tried = dataclasses.replace(plan, sensor=dataclasses.replace(sensor, readout=each.readout))
        # 24 frames x 480 columns determine the scatter to 0.7 %, the unexplained part to 15 % of the noise.
        assert scatter(frames, tried, device) == pytest.approx(each.random, rel=0.06), each.name
        assert each.unexplained < 0.25 * each.random
        assert each.error == pytest.approx(math.hypot(each.random, each.phase, each.unexplained))
        assert each.lost == 0.0


def test_a_psd_has_one_readout_whose_error_is_the_scatter(device: Device, rng: np.random.Generator) -> None:
    """Spots at one place, with the noise of the amplifiers alone; the sensor file also counts its electrons."""
    sensor = Sensor.load("psd_line")
    given: Any = sensor.readout
    silent = PsdNoise(independent=1e-9, spot=given.noise.spot)
    sensor = dataclasses.replace(sensor, readout=dataclasses.replace(given, noise=silent))
    shares = np.linspace(0.3, 0.7, 96)
    currents = 1e-6 * np.stack([1.0 - shares, shares], axis=-1) + 1e-9 * rng.standard_normal((48, 96, 2))
    frames = np.rint((currents + np.array(given.dark)) / given.ampere).astype(np.uint16)
    plan = plan_scan(frames, sensor, tolerance=1.0, rate=10.0, device=device)
    (found,) = plan.trials
    assert (plan.chosen, found.name, found.phase, found.lost) == (found, "psd", 0.0, 0.0)
    # 48 x 96 values determine the scatter to 1 %.
    assert found.error == pytest.approx(scatter(frames, plan, device), rel=0.04)
    assert plan.stream is not None
    assert plan.stream.ring == 7
    assert plan.rounding is None or plan.rounding < 0.01 * found.error
    double = found._replace(readout=dataclasses.replace(found.readout, precision="double"))
    assert double.name == "psd double"
    with pytest.raises(PlanError, match="the most accurate, psd, is predicted"):
        plan_scan(frames, sensor, tolerance=found.error, device=device)


def test_readouts_that_were_tried_give_plans_for_several_tolerances() -> None:
    device: Any = SimpleNamespace(has_double=False)  # nothing is read for the rounding
    nothing: Any = None
    tried = planning_scan.TriedReadouts(noisy_camera(), nothing, TRIALS, device)
    chosen = [planning_scan.choose_readout(tried, tolerance=each).chosen for each in (6.0, 10.0)]
    assert chosen == [TRIALS[1], TRIALS[0]]
    with pytest.raises(ValueError, match=r"tolerance is 0\.0, expected"):
        planning_scan.choose_readout(tried, tolerance=0.0)


@pytest.mark.slow
def test_a_window_that_noise_moves_off_the_line_is_seen(device: Device, rng: np.random.Generator) -> None:
    """Its predicted noise is far below its scatter: a plan by the noise alone would choose it."""
    frames = recording(rng)
    sensor = noisy_camera(window=3)
    sample = planning_scan.Sample(frames, np.arange(len(frames)), len(frames))
    narrow = planning_scan._errors(sensor, sample, device)
    found = scatter(frames, dataclasses.replace(plan_of(TRIALS[0]), sensor=sensor), device)
    assert found > 2.0 * narrow.random
    assert math.hypot(narrow.random, narrow.unexplained) == pytest.approx(found, rel=0.15)


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"window": 5}, True),
        ({"window": 6}, False),
        ({"method": "ml", "window": 5}, True),
        ({"method": "gauss3", "window": 1}, False),
        ({"method": "fir", "window": 1}, False),
        ({"method": "centroid", "window": 1}, False),
    ],
)
def test_which_windows_are_narrower_than_the_line(change: dict[str, Any], expected: bool) -> None:
    assert planning_scan._is_narrow(LineReadout(**change), 5.0) == expected


def test_a_window_narrower_than_the_line_is_not_chosen(
    device: Device, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is tried, and it would be the fastest."""
    try_readouts(monkeypatch, {"window": 4}, {"window": 6})
    plan = plan_scan(recording(rng, 3), noisy_camera(), tolerance=1.0, device=device)
    assert plan.chosen.readout.window == 6
    assert [each.readout.window for each in plan.trials] == [4, 6]
    assert math.isnan(plan.trials[0].error)
    assert plan.table().splitlines()[1].startswith("- windowed 4")


@pytest.mark.slow
@pytest.mark.usefixtures("few_readouts")
def test_a_tight_tolerance_takes_the_likelihood_fit_and_a_tighter_one_is_refused(
    device: Device, rng: np.random.Generator
) -> None:
    frames, sensor = recording(rng), noisy_camera()
    free = plan_scan(frames, sensor, tolerance=1.0, device=device)
    errors = {each.name: each.error for each in free.trials}
    best = min(errors, key=lambda name: errors[name])
    assert best.startswith("ml")
    # Every other method has at least 1.05 times the error.
    assert min(error for name, error in errors.items() if not name.startswith("ml")) > 1.05 * errors[best]
    plan = plan_scan(frames, sensor, tolerance=1.09 * errors[best], device=device)
    assert plan.chosen.readout.method == "ml"
    assert plan.sensor.readout == plan.chosen.readout
    assert plan.rounding is None or plan.rounding < 0.01 * plan.chosen.error
    with pytest.raises(PlanError, match="no readout meets an error of"):
        plan_scan(frames, sensor, tolerance=1.04 * errors[best], device=device)


@pytest.mark.slow
@pytest.mark.usefixtures("few_readouts")
def test_rounding_beyond_the_tolerance_takes_double_precision(device: Device, rng: np.random.Generator) -> None:
    if not device.has_double:
        pytest.skip("the device has no double precision")
    frames, sensor = recording(rng, 3), noisy_camera()
    plan = plan_scan(frames, sensor, tolerance=1.0, device=device)
    sample = planning_scan.Sample(frames, np.arange(3), 3)
    assert plan.rounding is not None
    assert plan.rounding > 0.0
    tight = math.hypot(plan.chosen.error, 0.5 * plan.rounding)
    chosen, rounding = planning_scan._with_precision(plan.chosen, sensor, sample, device, tight)
    assert rounding == plan.rounding
    assert chosen.readout.precision == "double"
    assert chosen.name.endswith(" double")
    assert chosen.seconds > 0.0
    double = dataclasses.replace(sensor, readout=chosen.readout)
    assert to_numpy(scan(frames, double, device=device).points.z).dtype == np.float64
    chosen, _ = planning_scan._with_precision(plan.chosen, sensor, sample, device, plan.chosen.error + rounding)
    assert chosen.readout.precision is None


def test_a_rate_gives_the_plan_of_its_stream(
    device: Device, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    try_readouts(monkeypatch, {"window": 6})
    frames, sensor = recording(rng), noisy_camera()
    plan = plan_scan(frames, sensor, tolerance=1.0, rate=10.0, device=device)
    assert plan.stream is not None
    assert plan.stream.rate == 10.0
    assert plan.stream.batch == 1
    assert plan.stream.ring == 7  # for 5 frames of a stall of 0.5 s, the source and the consumer
    done = scan(frames[:3], plan.sensor, device=device, rate=10.0, stream_plan=plan.stream, policy="block")
    assert len(done.frame_numbers) == 3
    with pytest.raises(ValueError, match="stream_plan is for 10 frames/s, and no rate is asked for"):
        scan(frames, plan.sensor, stream_plan=plan.stream)
    with pytest.raises(ValueError, match="stream_plan is for 10 frames/s, and 20 frames/s are asked for"):
        scan(frames, plan.sensor, rate=20.0, stream_plan=plan.stream)


@pytest.mark.slow
@pytest.mark.usefixtures("few_readouts")
def test_a_rate_that_only_a_coarser_readout_keeps_up_with(
    device: Device, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The refusal names the most accurate readout that keeps up."""
    frames, sensor = recording(rng), noisy_camera()
    free = plan_scan(frames, sensor, tolerance=1.0, device=device)
    ml = min((each for each in free.trials if each.readout.method == "ml"), key=lambda each: each.error)

    def only_windowed(source: Any, operation: LineReadout, **options: Any) -> Any:
        assert options["sample"].shape == (24, 64, 480)
        if operation.method != "windowed":
            raise planning_scan.StreamError("too slow")
        return plan_stream(source, operation, **options)

    monkeypatch.setattr(planning_scan, "plan_stream", only_windowed)
    with pytest.raises(PlanError, match=r"^ml \d+ meets the tolerance and .* too slow; at this rate windowed"):
        plan_scan(frames, sensor, tolerance=1.12 * ml.error, rate=10.0, device=device)

    def none(source: Any, operation: LineReadout, **options: Any) -> Any:
        raise planning_scan.StreamError("too slow")

    monkeypatch.setattr(planning_scan, "plan_stream", none)
    with pytest.raises(PlanError, match=r"^ml \d+ meets the tolerance and is too slow, as all 2 faster ones: too slow"):
        plan_scan(frames, sensor, tolerance=1.12 * ml.error, rate=10.0, device=device)


@pytest.mark.parametrize("limits", [ScanPlanLimits(), ScanPlanLimits(rate_margin=2.5)])
@pytest.mark.parametrize(
    ("fits", "message"),
    [
        (("windowed",), "at this rate windowed 8 keeps up with a predicted error of 5000000 um: ask for 5.25e+06 um"),
        (("fir",), "at this rate fir 4 keeps up with a predicted error of 9000000 um: ask for 9.45e+06 um or more"),
        (("ml",), "is too slow, as all 2 faster ones: the queue is full"),
    ],
)
def test_a_plan_that_is_too_slow_names_the_most_accurate_faster_readout(
    fits: tuple[str, ...], message: str, limits: ScanPlanLimits, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Readouts that are slower or as slow are not tried: fir of 1 s and windowed of 2 s are faster than 3 s."""
    tried: list[str] = []
    frames = np.zeros((3, 64, 480), np.uint8)
    device: Any = object()

    def planned(source: Any, operation: LineReadout, **options: Any) -> str:
        assert (source.length, options.pop("sample") is frames) == (7, True)
        margins = {"margin": limits.rate_margin, "headroom": max(2.0, limits.rate_margin)}
        assert options == {"rate": 20.0, "latency": 0.1, "device": device, **margins}
        tried.append(operation.method)
        if operation.method in fits:
            return "a plan"
        raise planning_scan.StreamError("the queue is full")

    monkeypatch.setattr(planning_scan, "plan_stream", planned)
    monkeypatch.setattr(planning_scan, "range_readout", lambda sensor: sensor.readout)
    sample = planning_scan.Sample(frames, np.arange(3), 7)
    trials = (*TRIALS, trial("centroid", 3.0, 1.0), trial("centroid", 0.5, 2.0, lost=0.5))
    request: Any = (trials, Sensor.load("camera_line"), sample, device, 20.0, 0.1, limits)
    with pytest.raises(PlanError, match=re.escape(message)) as refused:
        planning_scan._plan_stream(TRIALS[2], *request)
    assert str(refused.value).startswith("gauss3 ")
    assert tried == ["gauss3", "windowed", "fir"][: 2 if "windowed" in fits else 3]
    if "fir" in fits:
        assert planning_scan._plan_stream(TRIALS[0], *request) == "a plan"
        return
    with pytest.raises(
        PlanError, match=r"fir 4 meets the tolerance and is too slow, and no usable readout is faster: "
    ):
        planning_scan._plan_stream(TRIALS[0], *request)


def test_a_dark_recording_is_refused(device: Device) -> None:
    with pytest.raises(ValueError, match="no line in 5 frames"):
        plan_scan(np.zeros((5, 64, 480), np.uint8), noisy_camera(), tolerance=1.0, device=device)


@pytest.mark.parametrize(
    ("sensor", "options", "message"),
    [
        (noisy_camera(), {"tolerance": 0.0}, "tolerance is 0.0, expected"),
        (noisy_camera(), {"tolerance": math.nan}, "tolerance must be finite, got nan"),
        (noisy_camera(), {"tolerance": 1.0, "rate": 0.0}, "rate is 0.0, expected"),
        (noisy_camera(), {"tolerance": 1.0, "latency": 0.1}, "a latency needs a rate"),
        (Sensor.load("camera_line"), {"tolerance": 1.0}, r"gives no noise .* give \[line\] read_noise and gain"),
        (
            dataclasses.replace(Sensor.load("psd_line"), noise_known=False),
            {"tolerance": 1.0},
            r"gives no noise .* give \[psd\.noise\]",
        ),
        (
            dataclasses.replace(
                noisy_camera(), readout=FocusStack(geometry=StageFocus(start=0.0, step=1e-5, pixel_size=1e-6))
            ),
            {"tolerance": 1.0},
            "is a focus sensor; only readouts of cameras and PSDs are planned",
        ),
    ],
)
def test_wrong_arguments_are_refused(sensor: Sensor, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        plan_scan(np.zeros((5, 64, 480), np.uint8), sensor, **options)  # type: ignore[arg-type]


def test_a_sample_must_be_frames_of_the_source() -> None:
    frames = np.zeros((4, 8, 64), np.uint8)
    for sample in (frames.astype(np.uint16), frames[:, :7], frames[0], np.uint8(3)):
        message = (
            f"sample has shape {sample.shape} and dtype {sample.dtype}, expected shape (frames, 8, 64) and dtype uint8"
        )
        with pytest.raises(ValueError, match=re.escape(message)):
            plan_stream(ArraySource(frames), LineReadout(), rate=10.0, sample=np.asarray(sample))
    with pytest.raises(ValueError, match=r"sample has shape \(0, 8, 64\), expected one frame or more"):
        plan_stream(ArraySource(frames), LineReadout(), rate=10.0, sample=frames[:0])


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_sample_may_have_any_byte_order(order: str, device: Device) -> None:
    """A recording in the byte order of another machine: its source converts the frames, for the measurement, too."""
    frames = np.arange(4 * 8 * 64, dtype=np.uint16).reshape(4, 8, 64).astype(f"{order}u2")
    limits = PlanLimits(rounds=1, trial_seconds=1e-3, latency_batches=3)
    plan = plan_stream(ArraySource(frames), LineReadout(), rate=1.0, sample=frames, device=device, limits=limits)
    assert plan.batch == 1
