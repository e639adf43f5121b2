"""Error of a simulation by its discretisations and by the light that it leaves out, estimated on a few profiles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, NamedTuple

from gpuvision.accuracy.trial import micrometres
from gpuvision.host import Device
from gpuvision.sensor.simulated import require_light
from gpuvision.simulation.sensors.readings import PATHS, Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.direct import DirectLimits
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.simulation_sample import ProfileSample, SimulationSettings, divided_light

PAIRS_BOUND = "bound of pairs left out [m]"
BOUNCES_BOUND = "bound of multi-bounce left out [m]"
DIRECT = ("direct", "specular")
"""Light paths that are computed together."""
BLURRED = (*DIRECT, "diffuse-specular")
"""Light paths that the lens blurs; diffuse indirect light varies slowly."""
# An error of first order halves when its step is halved: it is twice the change. Errors of higher order are less. The
# blur takes the light of a bin as a spot at its centroid: the missing variance is of second order in the bin.
_FIRST_ORDER, _SECOND_ORDER = 2.0, 4.0 / 3.0
# Error by the rays per bin over its change by twice the rays along both axes, which are spread: at other places their
# error is independent. Measured on nine random parts with 1 x 1 and 2 x 2 rays: 0.3 to 1.3 (without spread rays: 3.3).
_ERROR_PER_FINER_CHANGE = 4.0 / 3.0


class ErrorPart(NamedTuple):
    """Part of the error of a simulation.

    Attributes
    ----------
    error : float
        Error of the range [m].
    signal : float
        Error of the signal, as a fraction of the root mean square signal; NaN if it is not known.
    is_bound : bool
        Whether the error of the range is proven for each sample. Otherwise it is an estimate of the root mean square.
        Default False.
    """

    error: float
    signal: float
    is_bound: bool = False


def total_error(parts: Iterable[ErrorPart]) -> float:
    """Return the error by several parts [m]: the sum of the bounds, and the root of the sum of squares of estimates."""
    parts = list(parts)
    bounds = sum(each.error for each in parts if each.is_bound)
    return bounds + math.hypot(*(each.error for each in parts if not each.is_bound))


@dataclass(frozen=True, kw_only=True)
class SimulationErrors:
    """Error of a simulation by parts. ``str(errors)`` states it in lines.

    Attributes
    ----------
    parts : dict of str to ErrorPart
        Parts by name: "without PATH" for light that is left out, "slabs", "nodes", "patches", "pairs", "bins and blur",
        "lobes", "mirrors", "rounding". A part that the scene cannot have is missing.
    changed : float
        Largest fraction of the samples that a refinement reads on another line, or not at all. They are not in the
        errors.
    """

    parts: dict[str, ErrorPart]
    changed: float

    @property
    def total(self) -> float:
        """Error by all parts [m], see `total_error`."""
        return total_error(self.parts.values())

    @property
    def is_bound(self) -> bool:
        """Whether all parts are proven bounds."""
        return all(each.is_bound for each in self.parts.values() if each.error > 0.0)

    def __str__(self) -> str:
        lines = [f"{name}: {_words(each.error, is_bound=each.is_bound)}" for name, each in self.parts.items()]
        return "\n".join([*lines, f"total: {_words(self.total, is_bound=self.is_bound)}"])

    def to_dict(self) -> dict[str, Any]:
        """Return parts and total as dictionaries and numbers for JSON."""
        parts = {name: each._asdict() for name, each in self.parts.items()}
        return asdict(self) | {"parts": parts, "total": self.total, "is_bound": self.is_bound}


def estimate_errors(task: SimulationTask, *, profiles: int = 6, device: Device | None = None) -> SimulationErrors:
    """Estimate the error of a simulation for each discretisation and each light path that it leaves out.

    Parameters
    ----------
    task : SimulationTask
        Task from `gpuvision.workflows.simulating.prepare_simulation`, with the settings to judge.
    profiles : int
        Number of profiles to compute, evenly spaced over the part, 1 or more. Default 6.
    device : Device, optional
        Default `Device.best`.

    Returns
    -------
    SimulationErrors

    Raises
    ------
    ValueError
        Nothing is read in these profiles.

    Notes
    -----
    A discretisation is refined by a factor of 2, everything else kept, and the noiseless readings are compared: the
    range error is the distance of the readings on the sensor times the derivative dH/du of the height. The error is
    taken as twice the root mean square change, which holds for errors of first order and is too large for those of
    higher order; for bins and blur, of second order, as 4/3 of the change; for rays per bin, from rays that are spread
    (see `ViewRays`), as 4/3 of the change as well. Patches are compared with patches of twice the size, whose error
    is assumed to be twice as large. These are estimates. Proven bounds are those of clustered and omitted
    pairs, and that of omitted multi-bounce light where it is smaller than the estimate; both for PSDs only. Rounding is
    that of the readout; the light is computed in single precision.
    """
    device = Device.best() if device is None else device
    sample = ProfileSample.of(task, profiles, device)
    settings = SimulationSettings.of(task)
    exposures, statistics = light_by_path(sample, settings)
    kept = {name: each for name, each in exposures.items() if name in task.paths}
    estimate = PartEstimate(sample, settings, kept)
    found = {f"without {name}": estimate.change({name: exposures[name]}, 1.0) for name in exposures if name not in kept}
    has_bounds = task.sensor.kind == "psd"
    if has_bounds and "without multi-bounce" in found and 0.0 < statistics.get(BOUNCES_BOUND, math.inf) < math.inf:
        estimated = found["without multi-bounce"]
        if statistics[BOUNCES_BOUND] <= estimated.error:
            found["without multi-bounce"] = estimated._replace(error=statistics[BOUNCES_BOUND], is_bound=True)
    if require_light(task.sensor).thickness > 0.0:
        found["slabs"] = estimate.refined(DIRECT, sub_sheets=2 * settings.sub_sheets + 1)
    indirect = tuple(each for each in ("diffuse-diffuse", "multi-bounce") if each in kept)
    if indirect:
        (u, v), bounces = settings.nodes, settings.bounce_nodes
        finer = None if bounces is None else (2 * bounces[0], 2 * bounces[1])
        found["nodes"] = estimate.refined(
            indirect,
            factor=_ERROR_PER_FINER_CHANGE,
            limits={"spreads_rays": True},
            nodes=(2 * u, 2 * v),
            bounce_nodes=finer,
        )
    if "multi-bounce" in kept:
        found["patches"] = estimate.refined(("multi-bounce",), patch_size=2.0 * settings.patch_size, factor=1.0)
    if task.tolerance > 0.0 and "diffuse-diffuse" in kept:
        found["pairs"] = ErrorPart(statistics.get(PAIRS_BOUND, 0.0), math.nan, is_bound=has_bounds)
    found |= estimate.others()
    return SimulationErrors(parts=found, changed=estimate.changed)


def light_by_path(sample: ProfileSample, settings: SimulationSettings) -> tuple[dict[str, Exposure], dict[str, float]]:
    """Return the exposures of all light paths of a scene at some settings, and their statistics."""
    light = sample.light(replace(settings, paths=scene_paths(sample.task)), runs=1)
    return light.exposures, light.statistics


def scene_paths(task: SimulationTask) -> tuple[str, ...]:
    """Return the light paths that the materials of a scene can have."""
    missing = {
        "specular": not any(each.gloss is not None or each.mirror for each in task.materials),
        "diffuse-specular": not any(each.mirror for each in task.materials),
        "diffuse-diffuse": not any(each.albedo for each in task.materials),
        "multi-bounce": not any(each.albedo for each in task.materials),
    }
    return tuple(name for name in PATHS if not missing.get(name, False))


class Refined(NamedTuple):
    """Reading of light with a refined discretisation.

    Attributes
    ----------
    reading : Reading
        The reading.
    factor : float
        Error of the discretisation over the change of the reading.
    """

    reading: Reading
    factor: float


class PartEstimate:
    """Errors of the discretisations of sampled light, by the readings with one of them refined.

    Parameters
    ----------
    sample : ProfileSample
        The profiles.
    settings : SimulationSettings
        Settings of the light.
    exposures : mapping of str to Exposure
        The light by path.
    """

    def __init__(self, sample: ProfileSample, settings: SimulationSettings, exposures: Mapping[str, Exposure]) -> None:
        self.sample, self.settings, self.exposures = sample, settings, dict(exposures)
        self.reading = sample.reader.read(exposures)
        self.changed = 0.0

    def read(self, exposures: Mapping[str, Exposure]) -> Reading:
        """Read light that replaces or adds paths."""
        return self.sample.reader.read(self.exposures | dict(exposures))

    def change(self, exposures: Mapping[str, Exposure], factor: float = _FIRST_ORDER) -> ErrorPart:
        """Return the change of the reading by light that replaces or adds paths, times a factor.

        Raises
        ------
        ValueError
            Nothing is read.
        """
        return self._part(Refined(self.read(exposures), factor))

    def refined(
        self,
        paths: tuple[str, ...],
        *,
        factor: float = _FIRST_ORDER,
        limits: Mapping[str, Any] | None = None,
        **changes: Any,
    ) -> ErrorPart:
        """Return the error of a discretisation, from the light of some paths with a finer one."""
        return self._part(self._refine(paths, factor, limits or {}, **changes))

    def others(self) -> dict[str, ErrorPart]:
        """Return the errors of bins and blur, lobes, mirrors and rounding."""
        return {name: self._part(each) for name, each in self.refine_others().items()}

    def refine_others(self) -> dict[str, Refined]:
        """Return readings with refined bins and blur, lobes, mirrors and precision of the readout."""
        sample = self.sample
        blurred = replace(self.settings, paths=tuple(each for each in BLURRED if each in self.exposures))
        light = divided_light(blurred.applied(sample.task), sample.places, sample.device, 2)
        found = {"bins and blur": Refined(self.read(light), _SECOND_ORDER)}
        if any(each.gloss is not None for each in sample.task.materials):
            finer = {"direct_limits": DirectLimits(lobe_turn=0.5 * DirectLimits.lobe_turn)}
            found["lobes"] = self._refine(DIRECT, _FIRST_ORDER, finer)
        if "diffuse-specular" in self.exposures:
            found["mirrors"] = self._refine(("diffuse-specular",), _FIRST_ORDER, {"mirror_steps": 4.0})
        if sample.device.has_double:
            found["rounding"] = Refined(sample.reader.read_in_double(self.exposures), 1.0)
        return found

    def _refine(self, paths: tuple[str, ...], factor: float, limits: Mapping[str, Any], **changes: Any) -> Refined:
        """Return the reading with a finer discretisation of some paths."""
        settings = replace(self.settings, paths=tuple(dict.fromkeys(("direct", *paths))), **changes)
        light = self.sample.light(settings, runs=1, **limits).exposures
        kept = {name: light[name] for name in paths if name in light and name in self.exposures}
        return Refined(self.read(kept), factor)

    def _part(self, refined: Refined) -> ErrorPart:
        difference = self.sample.reader.compare(self.reading, refined.reading)
        if not math.isfinite(difference.error):
            raise ValueError(f"nothing is read in {len(self.sample.places)} profiles of the part")
        self.changed = max(self.changed, difference.changed)
        return ErrorPart(refined.factor * difference.error, refined.factor * difference.signal)


def _words(error: float, *, is_bound: bool) -> str:
    return f"{micrometres(error)} ({'bound' if is_bound else 'estimate'})"
