"""Survey of the profiles of a simulation: profiles with large errors are tried, and the mean over the part is right."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.sensor.simulated import require_light
from gpuvision.workflows import planning_simulation
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.planning_simulation import plan_task
from gpuvision.workflows.simulation_plan import SimulationPlanLimits
from gpuvision.workflows.simulation_sample import ProfileSample, SampleReader
from gpuvision.workflows.simulation_survey import profile_shares
from groove_simulations import MM, heights_of, reading_at, task_of

COUNT = 100


def long_task(**more: Any) -> SimulationTask:
    """Return profiles from -9 to 9 mm: the sheet passes walls of the block at -5 and 5 mm."""
    return dataclasses.replace(task_of(**more), transports=np.linspace(-9 * MM, 9 * MM, COUNT))


def test_profiles_whose_light_changes_have_large_shares() -> None:
    """Against heights without diffuse light, with one slab, and with twice the rays, each from one run of all light."""
    task, device = long_task(), Device.best()
    (u, v), places = require_light(task.sensor).nodes, task.transports
    whole = heights_of(task, device, places)
    direct = heights_of(dataclasses.replace(task, paths=("direct",)), device, places)
    others = (
        direct,
        heights_of(task, device, places, sub_sheets=1),
        heights_of(task, device, places, nodes=(u, 2 * v)),
    )
    changes = [np.nanmean((each - whole) ** 2, axis=-1) for each in others]
    shares = profile_shares(task, COUNT, device)
    assert shares.sum() == pytest.approx(1.0)
    expected = np.mean([np.full(COUNT, 1.0 / COUNT), *(each / each.sum() for each in changes if each.any())], axis=0)
    np.testing.assert_allclose(shares, expected, rtol=0.3)
    most = np.argmax(expected)
    assert np.argmax(shares) == most
    assert shares[most] > 10.0 / COUNT
    few = profile_shares(task, COUNT // 3, device)  # the block ends at profiles 22 and 77
    assert few.sum() == pytest.approx(1.0)
    assert few[:22].mean() > 2.0 * few[30:70].mean()
    assert most in ProfileSample.of(task, 6, device, others=(12,), shares=shares).numbers[1]


def test_direct_light_alone_has_the_shares_of_its_slabs() -> None:
    """Against heights with one slab; without indirect light nothing else changes."""
    task, device = long_task(paths=("direct",)), Device.best()
    whole, one = (heights_of(task, device, task.transports, **slabs) for slabs in ({}, {"sub_sheets": 1}))
    change = np.nanmean((one - whole) ** 2, axis=-1)
    expected = 0.5 / COUNT + 0.5 * change / change.sum()
    np.testing.assert_allclose(profile_shares(task, COUNT, device), expected, rtol=0.3)


def test_parts_with_few_profiles_are_not_surveyed(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []

    def shares(task: SimulationTask, count: int, device: Device) -> np.ndarray:
        asked.append(count)
        return np.full(COUNT, 1.0 / COUNT)

    monkeypatch.setattr(planning_simulation, "profile_shares", shares)
    for checked, surveyed, expected in ((COUNT - 3, 7, []), (COUNT - 4, 0, []), (COUNT - 4, 7, [7])):
        limits = SimulationPlanLimits(profiles=3, checked=checked, added=0, surveyed=surveyed)
        plan_task(long_task(paths=("direct",)), tolerance=1.0, limits=limits)
        assert asked == expected


def sample_of(shares: np.ndarray | None, *others: int) -> ProfileSample:
    task = task_of(paths=("direct",))
    task = dataclasses.replace(task, transports=np.arange(float(len(shares) if shares is not None else COUNT)))
    return ProfileSample.of(task, 6, Device.best(), others=others, shares=shares)


def test_a_profile_without_an_equal_is_certain_to_be_drawn() -> None:
    """One profile has half of the shares of 60: of 10 drawn ones it would be 5; 9 are left for 53 of the others."""
    shares = np.full(60, 0.5 / 59)
    shares[31] = 0.5
    sample = sample_of(shares, 10)
    assert 31 in sample.numbers[1]
    chances = dict(zip(np.concatenate(sample.numbers), sample.chances(1), strict=True))
    assert chances.pop(31) == pytest.approx(1.0)
    # 6 of 60 are in the sample; of the rest 10 are drawn, as 100 / 9 of 60.
    np.testing.assert_allclose(list(chances.values()), 0.1 + 0.9 * (100 / 9 - 1) / 59)


def test_equal_shares_are_equal_chances() -> None:
    sample = sample_of(None, 10, 20)
    for groups, count in ((0, 6), (1, 16), (2, 36)):
        np.testing.assert_allclose(sample.chances(groups), count / COUNT)


def test_profiles_count_by_their_chances_in_the_error_and_the_signal() -> None:
    """One certain profile, and one that stands for four: means over five profiles."""
    reader = SampleReader.of(task_of(), Device.best())
    u = np.zeros((2, 16))
    moved = u + np.array([[0.0], [1e-6]])
    found, reference = reading_at(reader, moved, np.array([[1.0], [1.1]])), reading_at(reader, u)
    chances = np.array([1.0, 0.25])
    difference = reader.compare(found, reference, chances)
    assert difference.signal == pytest.approx(0.1 * np.sqrt(4.0 / 5.0))
    # The standard error is that of one profile with the chance 1/4: its residual is 4 times 1/5 of the square.
    single = reader.mean_squares(found, reference)[1]
    deviation = 2.0 * np.sqrt(0.75 * 2.0) * 4.0 / 5.0 / 5.0 * single
    assert difference.error == pytest.approx(np.sqrt(0.8 * single + deviation))


def test_the_mean_over_the_part_is_estimated_without_bias() -> None:
    """Of 300 profiles in random order 12 have large values, which the shares show but for a factor of up to 3."""
    rng, count, runs = np.random.default_rng(3), 300, 400
    reader = dataclasses.replace(SampleReader.of(task_of(), Device.best()), profiles=count)
    errors: dict[str, list[float]] = {"even": [], "surveyed": []}
    covered = 0
    for _ in range(runs):
        values = rng.exponential(1.0, count)
        values[rng.choice(count, 12, replace=False)] *= 100.0
        guess = values * np.exp(rng.uniform(-np.log(3.0), np.log(3.0), count))
        shares = np.mean([np.full(count, 1.0 / count), guess / guess.sum()], axis=0)
        for name, given in (("even", None), ("surveyed", shares)):
            sample = sample_of(np.full(count, 1.0 / count) if given is None else given, 12, 36)
            drawn = np.concatenate(sample.numbers)
            found = values[drawn, None]
            mean, deviation = reader._mean(found, np.ones_like(found, bool), sample.chances(2))
            errors[name].append(mean / values.mean() - 1.0)
            covered += name == "surveyed" and values.mean() <= mean + deviation
    assert abs(np.mean(errors["surveyed"])) < 0.03
    assert np.std(errors["surveyed"]) < 0.4 * np.std(errors["even"])
    assert covered > 0.95 * runs
