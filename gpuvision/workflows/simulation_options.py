"""Light of a sample of profiles for each path and each of its discretisations: the settings that a plan combines."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.sensor.simulated import require_light
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows.simulation_errors import BOUNCES_BOUND, DIRECT, PAIRS_BOUND, ErrorPart, scene_paths
from gpuvision.workflows.simulation_sample import ProfileSample, SampledLight, SimulationSettings

Progress = Callable[[int, int | None], object]

_PROVEN = 0.1  # share of the tolerance up to which a proven bound replaces multi-bounce light. Chosen
_PAIRS = 0.25  # share of the tolerance that clustered and omitted pairs may take. Chosen
_MIN_PAIRS = 65536  # pairs of a profile below which `ClusteredIrradiance` computes all of them


class Option(NamedTuple):
    """Discretisation of a light path, or the path left out.

    Attributes
    ----------
    changes : dict
        Fields of `SimulationSettings`; the paths add to those of other options.
    exposures : dict of str to Exposure
        The light.
    seconds : float
        Time of a profile beyond that of the direct light, or of the direct light [s].
    pairs : float
        Bound of the error by clustered pairs [m]. Default 0.0.
    """

    changes: dict[str, Any]
    exposures: dict[str, Exposure]
    seconds: float
    pairs: float = 0.0


class LightOptions:
    """Options of all light paths of a task.

    Parameters
    ----------
    sample : ProfileSample
        The profiles.
    tolerance : float
        Asked error of the range [m].
    progress : callable
        Called with the number of computed lights and None; see `compute`.

    Attributes
    ----------
    axes : list of list of Option
        Options of the direct light, of mirrors, and of diffuse and multi-bounce light; the last of each is the finest.
    setups : dict of float
        Time of the preparation of multi-bounce light by size of the patches, largest first [s]. Patches of twice the
        size, which a simulation prepares as well, count only with the largest ones; see `preparation_of`.
    proven : dict of str to ErrorPart
        Errors of paths that are left out by a proven bound.
    """

    def __init__(self, sample: ProfileSample, tolerance: float, progress: Progress) -> None:
        self.sample, self.settings = sample, SimulationSettings.of(sample.task)
        self.setups: dict[float, float] = {}
        self.proven: dict[str, ErrorPart] = {}
        # Light of two diffuse reflections of the reference: four times the rays of the finest option, spread
        # (`ViewRays`). Empty without such light.
        self._reference_rays: dict[str, Exposure] = {}
        self._finest: list[tuple[SimulationSettings, dict[str, Any]]] = []
        self._paths = [each for each in scene_paths(sample.task) if each in sample.task.paths]
        self._tolerance, self._progress, self._done = tolerance, progress, 0
        self._bound_of_bounces = math.inf
        self._has_bounds = sample.task.sensor.kind == "psd"
        u, v = self.settings.nodes
        # Rays that are not spread converge along v only (measured: more rays along u changed the error by less than a
        # tenth).
        finer = ((2 * u, 2 * v), (2 * u, 4 * v)) if self._has_bounds else ((u, 4 * v), (u, 8 * v))
        self._nodes = ((u, v), (u, 2 * v), *finer)
        self._reference_nodes = (4 * u, 8 * v)
        direct = self._direct()
        self._least = min(each.seconds for each in direct)
        axes = [direct, self._mirrors(), self._diffuse(), self._bounces()]
        self.axes = [each for each in axes if each]

    def combinations(self) -> Iterator[list[Option]]:
        """Yield the combinations of an option of each axis."""
        for options in itertools.product(*self.axes):
            yield list(options)

    def reference(self) -> dict[str, Exposure]:
        """Return the light with which all options are compared: of the finest ones, with more rays of diffuse light."""
        light = light_of_options([axis[-1] for axis in self.axes])
        return light | self._reference_rays

    def reference_at(self, places: npt.NDArray[np.float64]) -> dict[str, Exposure]:
        """Compute the light of the reference on profiles that are not in the sample.

        Parameters
        ----------
        places : numpy.ndarray
            (profiles,): transports [m].
        """
        light: dict[str, Exposure] = {}
        for settings, more in self._finest:  # the direct light of the first one is the finest
            light = self.compute(settings, places, **{"runs": 1, **more}).exposures | light
        return light

    def light_at(self, option: Option, places: npt.NDArray[np.float64]) -> dict[str, Exposure]:
        """Compute the light of an option, with all pairs, on profiles that are not in the sample.

        Parameters
        ----------
        option : Option
            Option of an axis.
        places : numpy.ndarray
            (profiles,): transports [m].
        """
        paths = tuple(dict.fromkeys(("direct", *option.changes["paths"])))
        settings = replace(self.settings, **{"sub_sheets": 1, "tolerance": 0.0, **option.changes, "paths": paths})
        light = self.compute(settings, places, runs=1).exposures
        return {name: light[name] for name in option.exposures}

    def compute(
        self, settings: SimulationSettings, places: npt.NDArray[np.float64] | None = None, **more: Any
    ) -> SampledLight:
        """Compute light as `ProfileSample.light`, and report that one more light is done."""
        light = self.sample.light(settings, places, **more)
        self._done += 1
        self._progress(self._done, None)
        return light

    def settings_of(self, options: Sequence[Option]) -> SimulationSettings:
        """Return the settings of a combination of options."""
        changes: dict[str, Any] = {}
        for each in options:
            changes |= each.changes
        named = {name for each in options for name in each.changes.get("paths", ())}
        return replace(self.settings, **changes | {"paths": tuple(each for each in PATHS if each in named)})

    def seconds_of(self, options: Sequence[Option]) -> float:
        """Return the time of a profile, with its share of the preparation of multi-bounce light [s]."""
        return sum(each.seconds for each in options) + self.preparation_of(self.settings_of(options))

    def preparation_of(self, settings: SimulationSettings) -> float:
        """Return the share of a profile in the time of the preparation of multi-bounce light [s].

        A simulation also prepares patches of twice the size, to estimate the error by patches. Patches that no option
        has count as 0.
        """
        if "multi-bounce" not in settings.paths:
            return 0.0
        prepared = sum(self.setups.get(factor * settings.patch_size, 0.0) for factor in (1.0, 2.0))
        return prepared / len(self.sample.task.transports)

    def _direct(self) -> list[Option]:
        """Return the direct light for numbers of slabs, ascending; specular highlights cost no time of their own."""
        paths, given = tuple(each for each in DIRECT if each in self._paths), self.settings.sub_sheets
        is_thick = require_light(self.sample.task.sensor).thickness > 0.0
        options = []
        counts = sorted({1, 3, given, 2 * given + 1}) if is_thick else [given]
        for slabs in counts:
            light = self._light(is_finest=slabs == counts[-1], paths=paths, sub_sheets=slabs)
            options.append(Option({"paths": paths, "sub_sheets": slabs}, light.exposures, light.seconds))
        return options

    def _mirrors(self) -> list[Option]:
        """Return no mirrored light, and mirrored light."""
        name = "diffuse-specular"
        if name not in self._paths:
            return []
        return [Option({}, {}, 0.0), self._option(name, self._light(is_finest=True, paths=("direct", name)))]

    def _diffuse(self) -> list[Option]:
        """Return no light of two diffuse reflections, and such light for rays per bin, also with clustered pairs."""
        name = "diffuse-diffuse"
        if name not in self._paths:
            return []
        options = [Option({}, {}, 0.0)]
        for nodes in self._nodes:
            given: dict[str, Any] = {"paths": ("direct", name), "nodes": nodes}
            light = self._light(is_finest=False, **given)
            exact = self._option(name, light, nodes=nodes)
            self._bound_of_bounces = light.statistics.get(BOUNCES_BOUND, math.inf)
            options += [*self._clustered(light, exact, given), exact]
        paths = ("direct", name)
        reference = self._light(is_finest=True, is_reference=True, paths=paths, nodes=self._reference_nodes)
        self._reference_rays = {name: reference.exposures[name]}
        return options

    def _clustered(self, light: SampledLight, exact: Option, given: dict[str, Any]) -> list[Option]:
        """Return the option with clustered pairs if that is faster. It has the light of all pairs, and a bound."""
        if not self._has_bounds or light.statistics.get("pairs", 0.0) <= _MIN_PAIRS:
            return []
        share = _PAIRS * self._tolerance
        found = self._light(is_finest=False, tolerance=share, **given)
        if not found.statistics.get(PAIRS_BOUND, 0.0) or found.seconds >= light.seconds:
            return []
        seconds = max(found.seconds - self._least, 0.0)
        # Profiles beside the sample may use the whole share.
        return [Option(exact.changes | {"tolerance": share}, exact.exposures, seconds, share)]

    def _bounces(self) -> list[Option]:
        """Return no multi-bounce light, and such light for rays per bin and sizes of patches.

        It is smooth, and takes most of the time: every other number of rays is tried, and larger patches too. There are
        no options if a bound of such light is negligible.
        """
        name = "multi-bounce"
        if name not in self._paths:
            return []
        if self._has_bounds and self._bound_of_bounces <= _PROVEN * self._tolerance:
            self.proven["without multi-bounce"] = ErrorPart(self._bound_of_bounces, math.nan, is_bound=True)
            return []
        options = [Option({}, {}, 0.0)]
        sizes = tuple(factor * self.settings.patch_size for factor in (4.0, 2.0, 1.0))
        counts = self._nodes[::2]
        finest = (counts[-1], sizes[-1])
        for nodes, size in itertools.product(counts, sizes):
            given: dict[str, Any] = {"bounce_nodes": nodes, "patch_size": size}
            light = self._light(is_finest=(nodes, size) == finest, paths=("direct", name), nodes=nodes, **given)
            options.append(self._option(name, light, **given))
            self.setups.setdefault(size, light.setup)  # further light with these patches finds them prepared
        return options

    def _option(self, name: str, light: SampledLight, **changes: Any) -> Option:
        exposures = {name: light.exposures[name]} if name in light.exposures else {}
        return Option({"paths": (name,), **changes}, exposures, max(light.seconds - self._least, 0.0))

    def _light(self, *, is_finest: bool, is_reference: bool = False, **changes: Any) -> SampledLight:
        """Return the light of the sample; keep the settings of the reference."""
        # The direct light that comes with other paths is only their reference: one slab suffices.
        settings = replace(self.settings, **{"sub_sheets": 1, "tolerance": 0.0, **changes})
        more: dict[str, Any] = {"runs": 1, "spreads_rays": True} if is_reference else {}
        if is_finest:
            self._finest.append((settings, more))
        return self.compute(settings, **more)


def light_of_options(options: Sequence[Option]) -> dict[str, Exposure]:
    """Return the light of options of different paths."""
    return {name: each for option in options for name, each in option.exposures.items()}
