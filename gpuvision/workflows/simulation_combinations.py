"""Combinations of options of a simulation's light paths: their errors on a sample of profiles, and on more profiles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from gpuvision.simulation.sensors.readings import Reading
from gpuvision.workflows.simulation_errors import ErrorPart, total_error
from gpuvision.workflows.simulation_options import LightOptions, Option, light_of_options
from gpuvision.workflows.simulation_plan import SettingsTrial
from gpuvision.workflows.simulation_reference import SimulationReference
from gpuvision.workflows.simulation_sample import Difference, SimulationSettings, join_readings


class _Kept(NamedTuple):
    """Selected combination: time [s], bound of its pairs [m], and change of the readings by its rays [m]."""

    seconds: float
    pairs: float
    by_rays: float


class Combinations:
    """Combinations of options of the light paths, with their errors and times.

    Parameters
    ----------
    options : LightOptions
        Light of the options.
    max_moved : float
        Largest fraction of the samples that a usable combination may read on another line.
    """

    def __init__(self, options: LightOptions, max_moved: float) -> None:
        self._max_moved = max_moved
        self._options, self._axes, self._sample = options, options.axes, options.sample
        self._reference = SimulationReference(options)
        self._errors = self._reference.errors()
        # Readings of the sample, and of each group of other profiles that was needed.
        self._readings: dict[SimulationSettings, list[Reading]] = {}
        self._kept: dict[SimulationSettings, _Kept] = {}
        self._select()

    @property
    def finest(self) -> dict[str, ErrorPart]:
        """Errors of the reference by parts; upper limits."""
        return self._errors.most

    def trials(self) -> list[SettingsTrial]:
        """Return the selected combinations, fastest first, by their readings up to now."""
        return [self.judged(settings) for settings in self._kept]

    def _select(self) -> None:
        """Keep the combinations that no usable one beats in time and error, by the errors of their options."""
        errors = {id(each): found for axis in self._axes for each, found in self._errors_of(axis)}
        rated = []
        for options in self._options.combinations():
            found = [errors[id(each)] for each in options]
            error = math.hypot(*(each.error for each in found)) + sum(each.pairs for each in options)
            moved = sum(each.changed for each in found)
            rated.append((self._options.seconds_of(options), error, moved, options))
        least = math.inf
        for _, error, moved, options in sorted(rated, key=lambda each: each[:2]):
            if error < least:
                by_rays = (errors[id(each)].error for each in options if "nodes" in each.changes)
                self.keep(options, next(by_rays, 0.0))
                least = error if moved <= self._max_moved else least

    def keep(self, options: Sequence[Option], by_rays: float) -> SettingsTrial:
        """Read a combination of options on the sample; the rays of its diffuse light change readings by `by_rays`."""
        settings = self._options.settings_of(options)
        pairs = sum(each.pairs for each in options)
        self._kept[settings] = _Kept(self._options.seconds_of(options), pairs, by_rays)
        self._readings[settings] = [self._sample.reader.read(light_of_options(options))]
        return self.judged(settings)

    def has_more(self, trial: SettingsTrial) -> bool:
        """Return whether there are profiles on which settings were not read."""
        return len(self._readings[trial.settings]) <= len(self._sample.others)

    def look_closer(self, trial: SettingsTrial) -> None:
        """Read settings on one more group of profiles, with all light computed as the simulation does.

        They are also read on the groups on which other settings were read: the light of the reference is known there.
        The errors of the reference are estimated on its groups too.
        """
        readings, read = self._readings[trial.settings], self._sample.reader.read
        groups, reference = self._sample.others, self._reference
        if len(reference.readings) == len(readings):
            reference.read_at(groups[len(readings) - 1])
            self._errors = reference.errors()
        for places in groups[len(readings) - 1 : len(reference.readings) - 1]:
            readings.append(read(self._options.compute(trial.settings, places, runs=1).exposures))

    def judged(self, settings: SimulationSettings) -> SettingsTrial:
        """Return the trial of settings: the reference gives the readings to compare with, on the same profiles."""
        readings, (seconds, pairs, by_rays) = self._readings[settings], self._kept[settings]
        found, reference = join_readings(readings), join_readings(self._reference.readings[: len(readings)])
        chances = self._sample.chances(len(readings) - 1)
        difference = self._sample.reader.compare(found, reference, chances)
        bound = ErrorPart(pairs, math.nan, is_bound=True)
        error, least = (
            total_error([*parts.values(), ErrorPart(_added(change, by_rays, parts), difference.signal), bound])
            for change, parts in ((difference.error, self._errors.most), (difference.least, self._errors.least))
        )
        return SettingsTrial(
            settings=settings,
            seconds=seconds,
            error=error,
            least=least,
            change=difference.error,
            pairs=pairs,
            finest=total_error(self.finest.values()),
            worst=difference.worst,
            signal=difference.signal,
            moved=difference.changed,
            least_moved=difference.least_changed,
            profiles=len(found.position),
        )

    def _errors_of(self, axis: Sequence[Option]) -> Iterator[tuple[Option, Difference]]:
        """Yield the change of the reading by each option of an axis, with the reference's light of the others."""
        paths, reader = axis[-1].exposures, self._sample.reader
        others = {name: each for name, each in self._options.reference().items() if name not in paths}
        for each in axis:
            reading = reader.read(others | each.exposures)
            yield each, reader.compare(reading, self._reference.readings[0])


def _added(change: float, by_rays: float, parts: Mapping[str, ErrorPart]) -> float:
    """Return a change such that its square and that of the error of the reference's rays add up to the total.

    The error of the reference's rays may have the sign of the change by rays: these two add up linearly, which happens
    in parts whose profiles are alike.
    """
    rays = parts["nodes"].error if "nodes" in parts else 0.0
    return math.sqrt(change**2 + 2.0 * min(change, by_rays) * rays)
