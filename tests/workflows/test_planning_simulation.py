"""Plan of a simulation: the fastest light within a tolerance; refusals, bounds, errors against finer computations."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import Any, ClassVar

import numpy as np
import pytest

from gpuvision.accuracy.plan import PlanError
from gpuvision.host import Device
from gpuvision.simulation.scene.reflectance import Phong
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from gpuvision.workflows import planning_simulation
from gpuvision.workflows.planning_simulation import Combinations, is_worth_planning, plan_simulation, plan_task
from gpuvision.workflows.simulating import prepare_simulation, simulate
from gpuvision.workflows.simulation_errors import ErrorPart, SimulationErrors, estimate_errors, total_error
from gpuvision.workflows.simulation_options import LightOptions
from gpuvision.workflows.simulation_plan import SettingsTrial, SimulationPlan, SimulationPlanLimits, usable_settings
from gpuvision.workflows.simulation_reference import SimulationReference
from gpuvision.workflows.simulation_sample import ProfileSample, SampledLight, SampleReader, SimulationSettings
from groove_simulations import INDIRECT, MM, groove, heights_of, reading_at, sensor_of, task_of, white

FEW = SimulationPlanLimits(profiles=3, checked=6)


# ---- choice, against a finer computation -----------------------------------------------------------------------------


def set_times(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let light take 1 ms for a slab and 100 ms for a ray per bin, so that a busy machine does not change the order."""
    real = ProfileSample.light

    def light(self: ProfileSample, settings: SimulationSettings, *more: Any, **changes: Any) -> SampledLight:
        rays = math.prod(settings.nodes) if "diffuse-diffuse" in settings.paths else 0
        return real(self, settings, *more, **changes)._replace(seconds=1e-3 * settings.sub_sheets + 0.1 * rays)

    monkeypatch.setattr(ProfileSample, "light", light)


@pytest.fixture(scope="module")
def free_plan() -> SimulationPlan:
    """Return a plan that any setting meets."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        set_times(monkeypatch)
        return plan_task(task_of(), tolerance=1.0, limits=FEW)


def test_the_true_error_of_each_setting_is_at_most_the_predicted_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """On profiles between those of the sample, against 43 slabs and 8 x 16 rays in bins of the sensor file."""
    set_times(monkeypatch)
    device = Device.best()
    task = task_of()
    places = task.transports[1::9] + 0.1 * MM
    true = heights_of(task, device, places, sub_sheets=43, nodes=(8, 16))
    sample = ProfileSample.of(task, 3, device, others=(6,))
    tried = Combinations(LightOptions(sample, 1.0, lambda done, of: None), FEW.max_moved)
    trials = tried.trials()
    for each in usable_settings(trials, FEW):  # others read other lines
        tried.look_closer(each)
    usable = [each for each in tried.trials() if each.profiles == 9]
    assert len(usable) > 2
    for each in usable:
        found = heights_of(each.settings.applied(task), device, places)
        error = math.sqrt(float(np.nanmean((found - true) ** 2)))
        assert error <= each.error, each.name
    # Without diffuse light the change is above 5 um.
    without = [each for each in trials if "diffuse-diffuse" not in each.settings.paths]
    assert all(each.change > 5e-6 for each in without)
    assert without


def test_the_fastest_setting_within_the_tolerance_is_chosen(
    free_plan: SimulationPlan, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_times(monkeypatch)
    assert free_plan.chosen == free_plan.usable[0]
    assert [each.seconds for each in free_plan.trials] == sorted(each.seconds for each in free_plan.trials)
    tolerance = 1.15 * sorted(each.error for each in free_plan.usable)[1]
    plan = plan_task(task_of(), tolerance=tolerance, limits=FEW)
    assert plan.chosen.error * FEW.margin <= tolerance
    fits = [each for each in plan.usable if each.error * FEW.margin <= tolerance]
    assert plan.chosen.seconds == min(each.seconds for each in fits)
    assert plan.chosen.profiles == FEW.profiles + FEW.checked
    assert "tried on 9 profiles" in str(plan)
    assert SimulationSettings.of(plan.task) == plan.chosen.settings
    report = plan.to_dict()
    assert report["finest"]["nodes"]["is_bound"] is False
    assert report["chosen"] in report["trials"]


def test_a_refusal_names_the_nearest_tolerance_and_the_largest_part() -> None:
    with pytest.raises(
        PlanError, match=r"no setting meets an error of 0\.001 um; .*ask for .* um or more; the largest"
    ):
        plan_task(task_of(), tolerance=1e-9, limits=FEW)


def test_a_rate_that_no_setting_reaches_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(PlanError, match=r"is too slow: .* a rate of 1e\+06 profiles/s allows 0\.8 us"):
        plan_task(task_of(paths=("direct",)), tolerance=1e-3, rate=1e6, limits=FEW)
    with pytest.raises(ValueError, match="a latency needs a rate; give the profiles per second as well"):
        plan_task(task_of(), tolerance=1e-3, latency=1.0)
    for tolerance in (0.0, -1.0, math.inf):
        with pytest.raises(ValueError, match="tolerance"):
            plan_task(task_of(), tolerance=tolerance)


class Looks:
    """Settings "1" and "2", by their number of slabs, whose errors on more profiles are given."""

    finest: ClassVar[dict[str, ErrorPart]] = {"nodes": ErrorPart(1e-6, 0.0)}

    def __init__(self, seconds: float, errors: dict[int, list[tuple[float, float]]], moved: float = 0.0) -> None:
        self.seconds, self.errors, self.moved, self.looks = {1: 1.0, 2: seconds}, errors, moved, list[int]()
        self.profiles, self.most = {1: 1, 2: 1}, 3

    def _trial(self, number: int, profiles: int) -> SettingsTrial:
        error, least = self.errors[number][profiles - 1]
        settings = dataclasses.replace(SimulationSettings.of(task_of()), sub_sheets=number)
        moved = self.moved if profiles > 1 and number == 1 else 0.0
        return SettingsTrial(
            settings, self.seconds[number], error, least, 0.0, 0.0, 0.0, 0.0, 0.0, moved, moved, profiles
        )

    def trials(self) -> list[SettingsTrial]:
        return [self._trial(number, profiles) for number, profiles in self.profiles.items()]

    def has_more(self, trial: SettingsTrial) -> bool:
        return trial.profiles < self.most

    def look_closer(self, trial: SettingsTrial) -> None:
        self.looks.append(trial.settings.sub_sheets)
        self.profiles[trial.settings.sub_sheets] += 1


UNDECIDED, MET, MISSED = (
    (12.0, 8.0),
    (9.0, 8.5),
    (12.0, 9.5),
)  # limits of the error; the tolerance is 10, the margin 1.1


@pytest.mark.parametrize(
    ("seconds", "first", "second", "moved", "looks", "chosen"),
    [
        (4.0, [UNDECIDED, MET, MET], [MET], 0.0, [1, 1], 1),
        (4.0, [UNDECIDED, MISSED], [MET, MET, MET], 0.0, [1, 2, 2], 2),
        (4.0, [UNDECIDED, UNDECIDED, MET], [MET, MET], 0.0, [1, 2, 1], 1),
        (4.0, [UNDECIDED] * 3, [MET, MET, MET], 0.0, [1, 2, 1, 2], 2),
        (4.0, [MISSED], [MET, MET, MET], 0.0, [2, 2], 2),
        (1.2, [UNDECIDED], [MET, MET, MET], 0.0, [2, 2], 2),  # the next one takes little more time
        (1.2, [MET, UNDECIDED], [MET, MET, MET], 0.0, [1, 2, 2], 2),
        (4.0, [MET, MET, MISSED], [UNDECIDED, UNDECIDED, MET], 0.0, [1, 1, 2, 2], 2),
        (4.0, [MET, MET], [MET, MET, MET], 0.1, [1, 2, 2], 2),  # reads other lines on the other profiles
        (4.0, [MET, MISSED], [MISSED], 0.0, [1], None),
        (4.0, [MISSED], [UNDECIDED] * 3, 0.0, [2, 2], None),
    ],
)
def test_undecided_settings_are_tried_on_more_profiles(
    monkeypatch: pytest.MonkeyPatch,
    seconds: float,
    first: list[tuple[float, float]],
    second: list[tuple[float, float]],
    moved: float,
    looks: list[int],
    chosen: int | None,
) -> None:
    """As long as they would save time; the chosen one is tried on all of them."""
    tried = Looks(seconds, {1: first, 2: second}, moved)
    monkeypatch.setattr(planning_simulation, "LightOptions", lambda *_: None)
    monkeypatch.setattr(planning_simulation, "Combinations", lambda *_: tried)
    if chosen is None:
        with pytest.raises(PlanError, match="no setting meets an error of"):
            plan_task(task_of(), tolerance=10.0)
    else:
        assert plan_task(task_of(), tolerance=10.0).chosen.settings.sub_sheets == chosen
    assert tried.looks == looks


@pytest.mark.parametrize(
    ("one", "other", "looks"),
    [
        (MET, MISSED, [1]),
        (MISSED, MISSED, [1]),
        (UNDECIDED, MISSED, [1, 1]),
        (UNDECIDED, MET, [1, 2]),
        (UNDECIDED, UNDECIDED, [1, 2, 1]),
    ],
)
def test_added_profiles_are_for_undecided_settings_before_a_refusal(
    monkeypatch: pytest.MonkeyPatch, one: tuple[float, float], other: tuple[float, float], looks: list[int]
) -> None:
    """Of four profiles the last one is an added one, on which setting 1 meets the tolerance."""
    tried = Looks(4.0, {1: [UNDECIDED, UNDECIDED, one, MET], 2: [other] * 3})
    tried.profiles, tried.most = {1: 2, 2: 2}, 4
    monkeypatch.setattr(planning_simulation, "LightOptions", lambda *_: None)
    monkeypatch.setattr(planning_simulation, "Combinations", lambda *_: tried)
    limits = SimulationPlanLimits(profiles=2, checked=1)
    with contextlib.suppress(PlanError):
        plan_task(task_of(), tolerance=10.0, limits=limits)
    assert tried.looks == looks


def test_settings_that_are_too_slow_are_not_tried_on_more_profiles(monkeypatch: pytest.MonkeyPatch) -> None:
    """The slow one meets the tolerance; the fast one may, and keeps up with the rate."""
    tried = Looks(4.0, {1: [UNDECIDED, UNDECIDED, MET], 2: [MET]})
    monkeypatch.setattr(planning_simulation, "LightOptions", lambda *_: None)
    monkeypatch.setattr(planning_simulation, "Combinations", lambda *_: tried)
    assert plan_task(task_of(), tolerance=10.0, rate=0.5).chosen.settings.sub_sheets == 1
    assert tried.looks == [1, 1]


def test_more_profiles_are_compared_together_with_the_sample() -> None:
    """Against the reference there, with all light computed as the simulation does."""
    task = task_of(paths=("direct", *PATHS[3:]), patch_size=20 * MM)
    sample = ProfileSample.of(task, 2, Device.best(), others=(1, 2))
    options = LightOptions(sample, 1e-9, lambda done, of: None)
    combinations = Combinations(options, 1.0)
    # The only difference from the reference is that of the rays.
    found = combinations.keep([axis[-1] for axis in options.axes], math.inf)
    settings, places = found.settings, sample.places
    for group in sample.others:
        assert combinations.has_more(found)
        combinations.look_closer(found)
        found, places = combinations.judged(settings), np.append(places, group)
        one, finest = (
            sample.reader.read(light)
            for light in (sample.light(settings, places).exposures, options.reference_at(places))
        )
        expected = sample.reader.compare(one, finest)
        assert found.profiles == len(places)
        assert found.change == pytest.approx(expected.error, rel=1e-3)
        # The error of the reference is the same as if all these profiles were the sample.
        alone = LightOptions(dataclasses.replace(sample, places=places, others=()), 1e-9, lambda done, of: None)
        errors = SimulationReference(alone).errors()
        assert found.finest == pytest.approx(total_error(errors.most.values()), rel=1e-3)
        limits = (found.error, expected.error, errors.most), (found.least, expected.least, errors.least)
        for error, change, parts in limits:
            rays, finest = parts["nodes"].error, total_error(parts.values())
            assert error == pytest.approx(math.sqrt(finest**2 + change**2 + 2.0 * change * rays), rel=1e-3)
    assert not combinations.has_more(found)
    assert expected.least < expected.error
    assert 0.0 < errors.least["nodes"].error < errors.most["nodes"].error


def test_the_plan_of_a_job_simulates(tmp_path: Any) -> None:
    plan = plan_simulation(groove(), white(), sensor_of(), tolerance=1.0, paths=("direct",), profiles=6, limits=FEW)
    done = simulate(plan.task, tmp_path, seed=None)
    assert done.attribution.error.shape == (6, 16)


@pytest.mark.parametrize(("paths", "albedo", "most"), [(PATHS, 0.7, 120), (PATHS, 0.0, 4000), (INDIRECT, 0.7, 4000)])
def test_small_parts_are_not_worth_planning(paths: tuple[str, ...], albedo: float, most: int) -> None:
    """Black surfaces have no multi-bounce light."""
    task = dataclasses.replace(task_of(paths=paths), materials=white(albedo))
    for count, expected in ((most, False), (most + 1, True)):
        assert is_worth_planning(dataclasses.replace(task, transports=np.arange(float(count)))) == expected


# ---- bounds and options ----------------------------------------------------------------------------------------------


def sampled(seconds: float, setup: float = 0.0, **statistics: float) -> SampledLight:
    names = {"bounces": "bound of multi-bounce left out [m]", "pairs": "pairs", "cut": "bound of pairs left out [m]"}
    dark = {name: Exposure(np.zeros(1), np.zeros(1)) for name in PATHS}
    return SampledLight(dark, {names[name]: each for name, each in statistics.items()}, seconds, setup)


def options_of(monkeypatch: pytest.MonkeyPatch, tolerance: float, times: Any, **task: Any) -> LightOptions:
    """Return options whose light is that of `times(settings)`."""
    monkeypatch.setattr(ProfileSample, "light", lambda self, settings, places=None, **changes: times(settings))
    sample = ProfileSample.of(task_of(**task), 3, Device.best())
    return LightOptions(sample, tolerance, lambda done, of: None)


def test_a_proven_bound_replaces_multi_bounce_light(monkeypatch: pytest.MonkeyPatch) -> None:
    found = options_of(monkeypatch, 1e-4, lambda _: sampled(1.0, bounces=1e-5), paths=PATHS)
    assert found.proven == {
        "without multi-bounce": ErrorPart(1e-5, pytest.approx(math.nan, nan_ok=True), is_bound=True)
    }
    assert all("multi-bounce" not in found.settings_of(each).paths for each in found.combinations())
    more = options_of(monkeypatch, 0.99e-4, lambda _: sampled(1.0, 9.0, bounces=1e-5), paths=PATHS)
    assert more.proven == {}
    size = SimulationSettings.of(more.sample.task).patch_size
    assert more.setups == {4.0 * size: 9.0, 2.0 * size: 9.0, size: 9.0}


def test_clustered_pairs_count_with_their_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are an option where a profile has many pairs and clustering is faster."""

    def times(settings: SimulationSettings) -> SampledLight:
        if "diffuse-diffuse" not in settings.paths:
            return sampled(0.5)
        seconds = 2.0 if settings.tolerance else 3.0 if settings.nodes == (1, 1) else 1.5
        return sampled(seconds, pairs=1e5, cut=2e-6 * bool(settings.tolerance))

    found = options_of(monkeypatch, 40e-6, times)
    diffuse = found.axes[1]
    assert [(each.changes.get("nodes"), each.changes.get("tolerance"), each.pairs) for each in diffuse] == [
        (None, None, 0.0),
        ((1, 1), 10e-6, 10e-6),
        ((1, 1), None, 0.0),
        ((1, 2), None, 0.0),
        ((2, 2), None, 0.0),
        ((2, 4), None, 0.0),
    ]
    assert [each.seconds for each in diffuse] == [0.0, 1.5, 2.5, 1.0, 1.0, 1.0]


def test_times_of_a_combination_add_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Direct light 1 s, diffuse light 2 s more, bounces 4 s more by ray and 80 s of preparation for 40 profiles.

    The preparation of patches of twice the size is included for the largest ones, and adds 80 s for others.
    """
    seconds = {("direct",): 1.0, ("direct", "diffuse-diffuse"): 3.0}

    def times(each: SimulationSettings) -> SampledLight:
        return sampled(seconds.get(each.paths, 1.0 + 4.0 * math.prod(each.nodes)), 80.0)

    found = options_of(monkeypatch, 1e-6, times, paths=("direct", *PATHS[3:]), profiles=40)
    by_settings = {found.settings_of(each): found.seconds_of(each) for each in found.combinations()}
    for settings, found_seconds in by_settings.items():
        expected = 1.0 + 2.0 * ("diffuse-diffuse" in settings.paths)
        if "multi-bounce" in settings.paths:
            assert settings.bounce_nodes is not None
            is_largest = settings.patch_size == max(found.setups)
            expected += 4.0 * math.prod(settings.bounce_nodes) + (2.0 if is_largest else 4.0)
        assert found_seconds == pytest.approx(expected)
    # Numbers of slabs, times four numbers of rays or no diffuse light, times three sizes of patches for each of two
    # numbers of rays or no bounces.
    assert len(by_settings) == 4 * 5 * (1 + 2 * 3)


def test_progress_counts_the_light_on_more_profiles() -> None:
    """The light of the setting; of the reference, direct and diffuse light; coarser slabs, and two numbers of rays."""
    done = list[tuple[int, int | None]]()
    sample = ProfileSample.of(task_of(), 1, Device.best(), others=(1,))
    options = LightOptions(sample, 1.0, lambda *each: done.append(each))
    tried = Combinations(options, FEW.max_moved)
    first = len(done)
    assert done == [(count, None) for count in range(1, first + 1)]
    trial = tried.keep([axis[-1] for axis in options.axes], 0.0)
    assert len(done) == first
    tried.look_closer(trial)
    assert done[first:] == [(first + count, None) for count in range(1, 7)]


def test_the_reference_has_the_finest_options_with_more_rays_of_diffuse_light() -> None:
    """On the sample and on other profiles; multi-bounce light has fewer rays than diffuse light."""
    task = task_of(paths=("direct", *PATHS[3:]), patch_size=20 * MM)
    sample = ProfileSample.of(task, 2, Device.best())
    options = LightOptions(sample, 1e-9, lambda done, of: None)
    with_bounces = [each for each in options.combinations() if len(options.settings_of(each).paths) == 3]
    settings = options.settings_of(with_bounces[-1])
    assert (settings.nodes, settings.bounce_nodes) == ((2, 4), (2, 2))
    others = task.transports[3:4]
    for places, light in ((sample.places, options.reference()), (others, options.reference_at(others))):
        expected = sample.light(settings, places).exposures
        assert set(light) == set(expected) == {"direct", *PATHS[3:]}
        finer = sample.light(dataclasses.replace(settings, nodes=(4, 8), paths=INDIRECT), places)
        expected["diffuse-diffuse"] = finer.exposures["diffuse-diffuse"]
        for name, each in expected.items():
            assert np.any(each.moment != 0.0)
            np.testing.assert_allclose(light[name].power, each.power, rtol=1e-5, atol=1e-6 * each.power.max())
            np.testing.assert_allclose(light[name].moment, each.moment, rtol=1e-4, atol=1e-5 * abs(each.moment).max())


def test_the_error_of_rays_is_half_of_the_mean_change_from_the_two_finest_options() -> None:
    """Root mean square of both changes, without the coarser options."""
    sample = ProfileSample.of(task_of(), 2, Device.best())
    options = LightOptions(sample, 1e-6, lambda done, of: None)
    reader, light, name = sample.reader, options.reference(), "diffuse-diffuse"
    few, many = options.axes[1][1], options.axes[1][-1]._replace(exposures={name: light[name]})
    change = reader.compare(reader.read(light), reader.read(light | few.exposures)).error
    assert change > 1e-6
    for rays, expected in (((few, few), 0.5 * change), ((few, many), math.sqrt(0.125) * change)):
        options.axes[1][1:] = [few, few, *rays]
        assert SimulationReference(options).errors().most["nodes"].error == pytest.approx(expected, rel=1e-3)


def test_rays_of_a_camera_are_doubled_along_v() -> None:
    """They are not spread; the reference has spread rays."""
    task = task_of(sensor_of("camera_line"))
    sample = ProfileSample.of(task, 1, Device.best())
    options = LightOptions(sample, 1e-6, lambda done, of: None)
    nodes = [each.changes["nodes"] for each in options.axes[1][1:]]
    assert nodes == [(1, 1), (1, 2), (1, 4), (1, 8)]
    settings = SimulationSettings.of(task)
    third, finest = (each["diffuse-diffuse"] for each in (options.axes[1][3].exposures, options.reference()))
    for rays, light, more in ((nodes[2], third, {}), ((4, 8), finest, {"spreads_rays": True})):
        expected = sample.light(dataclasses.replace(settings, nodes=rays), **more).exposures["diffuse-diffuse"]
        np.testing.assert_allclose(light.power, expected.power, rtol=1e-5, atol=1e-6 * expected.power.max())


def test_a_thin_sheet_has_no_slabs_to_try(monkeypatch: pytest.MonkeyPatch) -> None:
    thin = options_of(monkeypatch, 1e-6, lambda _: sampled(1.0), sensor=sensor_of(thickness=0.0), paths=("direct",))
    assert len(thin.axes[0]) == 1
    thick = options_of(monkeypatch, 1e-6, lambda _: sampled(1.0), paths=("direct",))
    assert [each.changes["sub_sheets"] for each in thick.axes[0]] == [1, 3, 9, 19]


def test_only_settings_that_read_the_same_lines_are_usable() -> None:
    settings = SimulationSettings.of(task_of())
    trials = [SettingsTrial(settings, 1.0, error, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, moved, 0.0, 6)
              for error, moved in ((1e-6, 0.005), (1e-6, 0.006), (math.nan, 0.0))]  # fmt: skip
    assert usable_settings(trials, SimulationPlanLimits()) == trials[:1]


# ---- errors of given settings ----------------------------------------------------------------------------------------


def test_errors_of_a_task_cover_what_it_leaves_out() -> None:
    """The estimates of the sensor file's settings are at least the changes by 16 x 16 rays and by the added path."""
    device, task = Device.best(), task_of(patch_size=10 * MM)
    found = estimate_errors(task, profiles=3, device=device)
    assert list(found.parts) == ["without multi-bounce", "slabs", "nodes", "bins and blur", "rounding"]
    assert found.total == pytest.approx(math.hypot(*(each.error for each in found.parts.values())))
    assert not found.is_bound
    places = task.transports[5::12]
    given, finer = (heights_of(task, device, places, **change) for change in ({}, {"nodes": (16, 16)}))
    assert np.sqrt(np.nanmean((given - finer) ** 2)) <= found.parts["nodes"].error
    assert "nodes: " in str(found)
    assert str(found).endswith("um (estimate)")
    tree = found.to_dict()
    assert (tree["total"], tree["parts"]["nodes"]["error"]) == (found.total, found.parts["nodes"].error)


def test_parts_follow_the_scene() -> None:
    """Gloss has lobes, mirrors have steps, a thin sheet has no slabs, black surfaces have no indirect light."""
    glossy = prepare_simulation(
        groove(),
        white(0.0, gloss=Phong(albedo=0.2, exponent=20.0)),
        sensor_of(thickness=0.0),
        paths=("direct", "specular"),
        profiles=4,
    )
    assert set(estimate_errors(glossy, profiles=2).parts) == {"bins and blur", "lobes", "rounding"}
    mirror = dataclasses.replace(
        task_of(paths=("direct", "diffuse-specular"), profiles=4), materials=white(0.3, mirror=0.2)
    )
    parts = estimate_errors(dataclasses.replace(mirror, patch_size=20 * MM), profiles=2).parts
    assert {"mirrors", "slabs", "without specular", "without diffuse-diffuse"} <= set(parts)


def test_a_total_is_a_bound_only_if_all_its_parts_are() -> None:
    proven, guess = ErrorPart(2e-6, math.nan, is_bound=True), ErrorPart(1e-6, 0.1)
    assert SimulationErrors(parts={"pairs": proven, "slabs": ErrorPart(0.0, 0.0)}, changed=0.0).is_bound
    assert total_error([proven, proven, ErrorPart(3e-6, 0.0), ErrorPart(4e-6, 0.0)]) == pytest.approx(9e-6)
    both = SimulationErrors(parts={"pairs": proven, "slabs": guess}, changed=0.0)
    assert not both.is_bound
    assert str(both) == "pairs: 2 um (bound)\nslabs: 1 um (estimate)\ntotal: 3 um (estimate)"


# ---- differences of readings -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["psd_line", "camera_line"])
def test_the_range_error_is_the_derivative_times_the_move(name: str) -> None:
    task = task_of(sensor_of(name))
    reader = SampleReader.of(task, Device.best())
    view = reader.simulator.view
    u = np.broadcast_to(0.3 * view.u_edges[0] + 0.7 * view.u_edges[-1], (2, view.samples))
    step = 1e-7 * (view.u_edges[-1] - view.u_edges[0])
    ends = [view.sheet_coordinates(view.points_in_sheet(u[0] + each, view.v_centres))[..., 1] for each in (step, -step)]
    slope = np.abs(ends[0] - ends[1]) / (2.0 * step)
    move = 1e-3 * (view.u_edges[1] - view.u_edges[0])
    found = reader.compare(reading_at(reader, u + move, 1.1), reading_at(reader, u))
    assert found.error == pytest.approx(move * math.sqrt(float(np.mean(slope**2))), rel=1e-6)
    assert found.worst == pytest.approx(move * slope.max(), rel=1e-6)
    assert found.signal == pytest.approx(0.1)
    assert found.changed == 0.0


def test_readings_of_other_lines_are_counted_apart() -> None:
    """The window of the camera's readout is 4 px: a move by more is another line; a PSD reads all light."""
    for name, changed in (("camera_line", 0.25), ("psd_line", 0.0)):
        reader = SampleReader.of(task_of(sensor_of(name)), Device.best())
        window: Any = getattr(reader.simulator, "readout", None)
        pitch = abs(window.axes.position_pitch)
        u = np.zeros((1, 80 if name == "camera_line" else 16))
        moved = u + np.where(np.arange(u.shape[1]) % 4, 0.0, pitch * (getattr(window, "window", 1e-4) + 0.1))
        assert reader.compare(reading_at(reader, moved), reading_at(reader, u)).changed == changed
    # Ambiguous samples of the reference are not compared.
    reader, u = SampleReader.of(task_of(), Device.best()), np.zeros((1, 16))
    flagged = reading_at(reader, u)._replace(status=np.where(np.arange(16) % 4, 0, Status.AMBIGUOUS)[None])
    moved = u + np.where(np.arange(16) % 4, 0.0, 1e-3)
    assert reader.compare(reading_at(reader, moved), flagged).worst == 0.0
    assert reader.compare(flagged._replace(position=moved), reading_at(reader, u)).worst > 0.0
    lost = np.where(np.arange(16) % 2, np.nan, 0.0)[None]
    found = reader.compare(reading_at(reader, lost), reading_at(reader, np.zeros((1, 16))))
    assert (found.changed, found.least_changed, found.error) == (0.5, 0.5, 0.0)
    # Moved shares 0 and 0.5 of 2 profiles out of 40: mean 0.25, standard error 0.25 times the root of 38 / 40.
    one, other = (reading_at(reader, np.stack([each, np.zeros(16)])) for each in (lost[0], np.zeros(16)))
    found = reader.compare(one, other)
    assert (found.changed, found.least_changed) == (0.25, 0.0)
    whole = dataclasses.replace(reader, profiles=2).compare(one, other)
    assert (whole.changed, whole.least_changed) == (0.25, 0.25)


def test_few_profiles_widen_the_limits_of_the_error() -> None:
    """Mean squares 1 and 3 of 2 profiles out of 8: mean 2, standard error 1 times the root of 6 / 8, counted twice."""
    reader = SampleReader.of(task_of(), Device.best())
    error, same = np.sqrt(np.array([[1.0, 1.0], [3.0, 3.0]])), np.ones((2, 2), bool)
    move = 2.0 * math.sqrt(0.75)
    for profiles, least, most in ((8, 2.0 - move, 2.0 + move), (2, 2.0, 2.0)):
        limits = reader._root_mean_square(error, same, np.full(2, 2.0 / profiles))
        assert limits == pytest.approx((math.sqrt(least), math.sqrt(most)))
    error[0] = 0.0  # mean 1.5, standard error 1.5: the lower limit is not below 0
    assert reader._root_mean_square(error, same, np.full(2, 1e-3))[0] == 0.0


def test_a_sample_is_spread_over_the_part() -> None:
    task = dataclasses.replace(task_of(profiles=20), transports=np.arange(20.0))
    sample = ProfileSample.of(task, 5, Device.best(), others=(3, 20))
    np.testing.assert_array_equal(sample.places, [2.0, 6.0, 10.0, 14.0, 18.0])
    np.testing.assert_array_equal(sample.others[0], [3.0, 9.0, 16.0])
    np.testing.assert_array_equal(np.sort(np.concatenate([sample.places, *sample.others])), task.transports)
    few = ProfileSample.of(dataclasses.replace(task, transports=np.arange(3.0)), 5, Device.best(), others=(3,))
    assert (len(few.places), len(few.others)) == (3, 0)
