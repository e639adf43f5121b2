"""Combinations of options of a simulation's light paths: their errors on a sample of profiles, and on more profiles."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from gpuvision.simulation.sensors.readings import Reading
from gpuvision.workflows.simulation_errors import ErrorPart, PartEstimate, total_error
from gpuvision.workflows.simulation_options import LightOptions, Option, light_of_options
from gpuvision.workflows.simulation_plan import SettingsTrial
from gpuvision.workflows.simulation_sample import Difference, SimulationSettings, join_readings


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
        finest = [axis[-1] for axis in self._axes]
        self._estimate = PartEstimate(self._sample, options.settings_of(finest), options.reference())
        # Readings of the sample, and of each group of other profiles that was needed.
        self._references = [self._estimate.reading]
        self._readings: dict[SimulationSettings, list[Reading]] = {}
        self._by_rays: dict[SimulationSettings, float] = {}  # part of the change that rays of diffuse light cause
        self.finest = self._finest_errors()

    def trials(self) -> list[SettingsTrial]:
        """Return the combinations that no usable one beats in time and error, fastest first.

        They are selected by the errors of their options, and then read.
        """
        errors = {id(each): found for axis in self._axes for each, found in self._errors_of(axis)}
        rated = []
        for options in self._options.combinations():
            found = [errors[id(each)] for each in options]
            error = math.hypot(*(each.error for each in found)) + sum(each.pairs for each in options)
            moved = sum(each.changed for each in found)
            rated.append((self._options.seconds_of(options), error, moved, options))
        kept, least = [], math.inf
        for _, error, moved, options in sorted(rated, key=lambda each: each[:2]):
            if error < least:
                by_rays = (errors[id(each)].error for each in options if "nodes" in each.changes)
                kept.append(self.trial(options, next(by_rays, 0.0)))
                least = error if moved <= self._max_moved else least
        return kept

    def trial(self, options: Sequence[Option], by_rays: float) -> SettingsTrial:
        """Read a combination of options on the sample; the rays of its diffuse light change readings by `by_rays`."""
        settings = self._options.settings_of(options)
        self._by_rays[settings] = by_rays
        self._readings[settings] = [self._sample.reader.read(light_of_options(options))]
        return self._judged(settings, self._options.seconds_of(options), sum(each.pairs for each in options))

    def has_more(self, trial: SettingsTrial) -> bool:
        """Return whether there are profiles on which settings were not read."""
        return len(self._readings[trial.settings]) <= len(self._sample.others)

    def look_closer(self, trial: SettingsTrial) -> SettingsTrial:
        """Read settings on one more group of profiles, with all light computed as the simulation does.

        They are also read on the groups on which other settings were read: the light of the reference is known there.
        """
        readings, read = self._readings[trial.settings], self._sample.reader.read
        groups = self._sample.others
        if len(self._references) == len(readings):
            self._references.append(read(self._options.reference_at(groups[len(readings) - 1])))
        for places in groups[len(readings) - 1 : len(self._references) - 1]:
            readings.append(read(self._options.compute(trial.settings, places, runs=1).exposures))
        return self._judged(trial.settings, trial.seconds, trial.pairs)

    def _judged(self, settings: SimulationSettings, seconds: float, pairs: float) -> SettingsTrial:
        """Return the trial of settings: the reference gives the readings to compare with, on the same profiles."""
        readings = self._readings[settings]
        found, reference = join_readings(readings), join_readings(self._references[: len(readings)])
        difference = self._sample.reader.compare(found, reference)
        bound = ErrorPart(pairs, math.nan, is_bound=True)
        error, least = (
            total_error([*self.finest.values(), ErrorPart(self._added(change, settings), difference.signal), bound])
            for change in (difference.error, difference.least)
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

    def _added(self, change: float, settings: SimulationSettings) -> float:
        """Return a change such that its square and that of the error of the reference's rays add up to the total.

        The error of the reference's rays may have the sign of the change by rays: these two add up linearly, which
        happens in parts whose profiles are alike.
        """
        rays = self.finest["nodes"].error if "nodes" in self.finest else 0.0
        return math.sqrt(change**2 + 2.0 * min(change, self._by_rays[settings]) * rays)

    def _errors_of(self, axis: Sequence[Option]) -> Iterator[tuple[Option, Difference]]:
        """Yield the change of the reading by each option of an axis, with the reference's light of the others."""
        paths, reader = axis[-1].exposures, self._sample.reader
        others = {name: each for name, each in self._options.reference().items() if name not in paths}
        for each in axis:
            reading = reader.read(others | each.exposures)
            yield each, reader.compare(reading, self._estimate.reading)

    def _finest_errors(self) -> dict[str, ErrorPart]:
        """Return the errors of the reference: of first order, the change by the last refinement at most."""
        found = dict(self._options.proven)
        for name, part, factor in (
            ("sub_sheets", "slabs", 1.0),
            # From a quarter of the rays. Measured on four parts: 0.19 to 0.30 of the change.
            ("bounce_nodes", "nodes of multi-bounce light", 0.5),
            ("patch_size", "patches", 1.0),
        ):
            light = light_of_options([each for axis in self._axes for each in _last_coarser(axis, name)])
            if light:
                found[part] = self._estimate.change(light, factor)
        if self._options.rays:
            found["nodes"] = self.ray_error()
        return found | self._estimate.others()

    def ray_error(self) -> ErrorPart:
        """Return the error by the reference's rays per bin.

        It is half of the smaller change from the two finest options. Errors of spread rays are independent: then the
        reference, with four times the rays of the finest option and half of its error (measured: a half to a quarter),
        has 0.45 of that change. A change from an option is large also if one of its rays lies beside a lit line; so the
        smaller change counts.
        """
        changes = [self._estimate.change({"diffuse-diffuse": each}, 0.5) for each in self._options.rays[-3:-1]]
        return min(changes)


def _last_coarser(axis: Sequence[Option], name: str) -> list[Option]:
    """Return the last option of an axis that differs from the finest one only in the field `name`, if there is any."""
    finest = axis[-1].changes
    options = [each for each in axis if not each.pairs and each.changes.keys() == finest.keys()]
    return [each for each in options if {key for key in finest if each.changes[key] != finest[key]} == {name}][-1:]
