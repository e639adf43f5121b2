"""Range errors of simulated readings, attributed to causes: occlusion, reflectivity, secondary light, noise, ...

Two methods split the range error of a sample into contributions of causes. With both methods the contributions add up
to the error exactly, and the contributions do not depend on an order of the causes.

- ``"moments"``, for PSDs. A PSD reads the centroid of all light. Light of power P at position u moves the centroid by
  P (u - u_true) / P_total. The contribution of a cause is the sum of these shifts over its light, times the slope of
  the height between the true position and the reading.
- ``"shapley"``, for any readout. The contribution of a cause is its Shapley value: the change of the error when the
  cause is added to unoccluded direct light of uniform reflectivity, averaged over all orders in which the causes can be
  added. Cost: the light is read 2^n times for n causes that have light.

Where several causes act on one sample, the two methods differ by a term of second order in the share of the light.

A surface of uniform reflectivity sends the same power to a sample as the real surface, from other positions. On a dark
surface, secondary light therefore has a larger share, and the contribution of secondary light is larger.

References
----------
L. S. Shapley, "A value for n-person games", Contributions to the Theory of Games II, Princeton 1953, pp. 307-317.
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.3.
"""

from __future__ import annotations

import enum
import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.readings import (
    AMBIENT,
    BEYOND_ENDS,
    PATHS,
    UNIFORM,
    UNIFORM_UNOCCLUDED,
    UNOCCLUDED,
    GroundTruth,
    Reading,
    Simulator,
    dark_exposure,
    height_secant,
    height_slope,
    total_exposure,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Method = Literal["moments", "shapley"]

CAUSES = ("shape", "occlusion", "reflectivity", "specular", "secondary", "ambient", "noise", "clipped")
"""Names of the causes. "shape" is the contribution of unoccluded direct light with uniform reflectivity: the width of a
strip or of a light spot on a part that is not flat. Without the variants of the direct light, "shape" also holds the
contributions of occlusion and reflectivity. "clipped" is the contribution of the direct light that the ends of a PSD
strip cut off; without `BEYOND_ENDS`, "shape" holds it too."""
_VARIANTS = (UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED)
_SECONDARY = ("diffuse-specular", "diffuse-diffuse", "multi-bounce")


class ReadingCategory(enum.IntFlag):
    """Category of a reading compared with the ground truth (uint8 flags; 0 is a valid reading)."""

    VALID = 0
    """A reading of a lit surface."""
    MISSING = 1
    """Dropout: a lit surface is visible, but there is no reading."""
    SPURIOUS = 2
    """False reading: a reading where no lit surface is visible."""
    NO_SURFACE = 4
    """No lit surface is visible within the ends of the sensor, and there is no reading."""
    AMBIGUOUS = 8
    """Several lit surfaces are visible in one sample."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ErrorAttribution:
    """Readings, ground truth, range errors and their causes, arrays (..., samples).

    Attributes
    ----------
    reading
        Readings of the sensor.
    truth
        Ground truth of the same samples.
    error
        float64, height read minus true height [m]; NaN where the reading or the truth is missing.
    causes
        Contribution to the error by cause, float64 [m]; NaN where `error` is NaN. The contributions add up to `error`.
    power
        Power of the light that belongs to each cause, float64 [W]. "shape" holds all direct light, "noise" no light.
    category
        uint8 `ReadingCategory` flags.
    """

    reading: Reading
    truth: GroundTruth
    error: Float64
    causes: dict[str, Float64]
    power: dict[str, Float64] = field(repr=False)
    category: npt.NDArray[np.uint8]

    def dominant_cause(self, min_error: float = 0.0) -> npt.NDArray[np.int8]:
        """Return the cause with the largest contribution in each sample.

        Parameters
        ----------
        min_error : float
            Samples whose error is not larger than this have no dominant cause [m], 0 or more. Default 0.0.

        Returns
        -------
        numpy.ndarray
            int8 (..., samples), index of the cause in `causes`. For a spurious reading: the cause with the most light.
            -1: no dominant cause.
        """
        parts = np.nan_to_num(np.abs(np.stack(list(self.causes.values()))), nan=-1.0)
        largest = np.where(np.abs(self.error) > min_error, parts.argmax(axis=0), -1)
        brightest = np.stack([self.power[name] for name in self.causes]).argmax(axis=0)
        return np.where(self.is_category(ReadingCategory.SPURIOUS), brightest, largest).astype(np.int8)

    @property
    def has_surface(self) -> npt.NDArray[np.bool_]:
        """Samples that see a lit surface within the ends of the sensor, or beyond the ends with a reading."""
        return np.asarray(np.isfinite(self.truth.h) & ~_is_unread_beyond_ends(self.reading.h, self.truth))

    def is_category(self, category: ReadingCategory) -> npt.NDArray[np.bool_]:
        """Return a mask of the samples with a category flag; for VALID, of the samples without any flag."""
        return np.asarray(self.category == 0 if category == ReadingCategory.VALID else (self.category & category) != 0)

    def failed_fraction(self, limit: float) -> float:
        """Return the fraction of lit-surface samples without a reading within the limit [m]: dropouts and outliers."""
        true = self.has_surface
        failed = true & ~(np.abs(self.error) <= limit)
        return int(failed.sum()) / max(int(true.sum()), 1)

    def without_flagged(self, flags: Status) -> ErrorAttribution:
        """Return a copy in which samples with any of the status flags have no reading."""
        dropped = (self.reading.status & flags) != 0
        values = {name: np.where(dropped, np.nan, getattr(self.reading, name)) for name in ("position", "g", "h")}
        reading = self.reading._replace(**values)
        return replace(
            self,
            reading=reading,
            error=np.where(dropped, np.nan, self.error),
            causes={name: np.where(dropped, np.nan, part) for name, part in self.causes.items()},
            category=classify_readings(reading.h, self.truth),
        )

    def summary(self, limit: float) -> dict[str, Any]:
        """Return counts and error statistics for a report; lengths in metres, None where no sample has an error.

        Parameters
        ----------
        limit : float
            Samples with a larger error are outliers: they are counted, each for its dominant cause [m].

        Returns
        -------
        dict
            ``samples``: number of all samples; ``surface``: samples that see a lit surface; ``valid``: readings of a
            surface; ``missing``, ``spurious``, ``ambiguous``: counts by `ReadingCategory`; ``beyond_limit``: number of
            outliers; ``failed_fraction``; ``rms``, ``median``, ``p95``, ``max`` of the absolute error [m]; ``causes``:
            for each cause the ``rms`` and ``max`` of its contribution [m], and in how many outliers (``dominant``) and
            spurious readings (``spurious``) it is the dominant cause.
        """
        true, error = self.has_surface, np.abs(self.error[np.isfinite(self.error)])
        dominant = self.dominant_cause(limit)
        outlier = np.abs(self.error) > limit
        spurious = self.is_category(ReadingCategory.SPURIOUS)
        causes = {
            name: {
                "rms": _rms(part[np.isfinite(part)]),
                "max": _max_abs(part),
                "dominant": int(np.sum(outlier & (dominant == number))),
                "spurious": int(np.sum(spurious & (dominant == number))),
            }
            for number, (name, part) in enumerate(self.causes.items())
        }
        levels = np.quantile(error, [0.5, 0.95]).tolist() if error.size else [None, None]
        return {
            "samples": int(true.size),
            "surface": int(true.sum()),
            "valid": int(error.size),
            "missing": int(self.is_category(ReadingCategory.MISSING).sum()),
            "spurious": int(spurious.sum()),
            "ambiguous": int(self.is_category(ReadingCategory.AMBIGUOUS).sum()),
            "limit": limit,
            "beyond_limit": int(outlier.sum()),
            "failed_fraction": self.failed_fraction(limit),
            "rms": _rms(error),
            "median": levels[0],
            "p95": levels[1],
            "max": _max_abs(error),
            "causes": causes,
        }


def _rms(values: Float64) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def _max_abs(values: Float64) -> float | None:
    known = np.abs(values[np.isfinite(values)])
    return float(known.max()) if known.size else None


def attribute_errors(
    simulator: PsdSimulator | CameraSimulator,
    exposures: Mapping[str, Exposure],
    truth: GroundTruth,
    *,
    seed: int | None = None,
    first_profile: int = 0,
    method: Method | None = None,
    secondary_by_path: bool = False,
    device: Device | None = None,
) -> ErrorAttribution:
    """Simulate readings, compare them with the ground truth, and attribute the errors to causes.

    Parameters
    ----------
    simulator : PsdSimulator or CameraSimulator
        The sensor, with its mask and its ambient light.
    exposures : mapping of str to Exposure
        Light by path, (..., samples, bins). With all three variants of the direct light (`UNIFORM`, `UNOCCLUDED`,
        `UNIFORM_UNOCCLUDED`), occlusion and reflectivity are causes in addition to shape; with `BEYOND_ENDS` and a PSD,
        clipped is one too.
    truth : GroundTruth
        Ground truth of the same samples.
    seed, first_profile : int or None, int
        Seed of the noise and number of the first profile, as for `PsdSimulator.read`; ``seed=None``: no noise.
    method : {"moments", "shapley"}, optional
        ``"moments"`` or ``"shapley"``, see the module's description. None: "moments" for PSDs, "shapley" for cameras.
        "shapley" counts a height that cannot be read as no error.
    secondary_by_path : bool
        True: each path of secondary light is a cause. False: one cause "secondary". Default False.
    device : Device, optional
        Device of the readouts; None: `Device.best`.

    Returns
    -------
    ErrorAttribution
        Errors of the readings [m], and the part of each cause.

    Raises
    ------
    ValueError
        Shapes differ, a path is unknown, only some of the variants are given, or ``method="moments"`` with a camera.
    """
    chosen = method or ("moments" if isinstance(simulator, PsdSimulator) else "shapley")
    if chosen == "moments" and not isinstance(simulator, PsdSimulator):
        raise ValueError("method 'moments' is for PSDs, which read the centroid of all light; cameras take 'shapley'")
    reading = simulator.read(exposures, seed=seed, first_profile=first_profile, device=device)
    if np.shape(truth.h) != reading.h.shape:
        raise ValueError(f"the truth has shape {np.shape(truth.h)}, the reading {reading.h.shape}; expected the same")
    light = simulator.detected_light(exposures)
    if chosen == "moments":
        noiseless = reading if seed is None else simulator.read(exposures, device=device)
        causes = _attribute_by_moments(simulator.view, light, truth, noiseless, secondary_by_path)
    else:
        causes = _attribute_by_shapley_values(simulator, light, truth, secondary_by_path, device)
    error = reading.h - truth.h
    # "noise" takes the rest of the error: also rounding, and samples that are read only because of their noise.
    causes["noise"] = error - np.nan_to_num(np.sum(list(causes.values()), axis=0))
    known = np.isfinite(error)
    causes = {name: np.where(known, np.nan_to_num(part), np.nan) for name, part in causes.items()}
    return ErrorAttribution(
        reading=reading,
        truth=truth,
        error=error,
        causes=causes,
        power={name: _power_of(name, light, secondary_by_path) for name in causes},
        category=classify_readings(reading.h, truth),
    )


def classify_readings(h: Float64, truth: GroundTruth) -> npt.NDArray[np.uint8]:
    """Return the categories of readings.

    Parameters
    ----------
    h
        Heights read [m], (..., samples); NaN: no reading.
    truth
        Ground truth of the same samples.

    Returns
    -------
    numpy.ndarray
        uint8 `ReadingCategory` flags, (..., samples).
    """
    true, read = np.isfinite(truth.h) & ~_is_unread_beyond_ends(h, truth), np.isfinite(h)
    several = (np.asarray(truth.status) & Status.AMBIGUOUS) != 0
    category = np.select(
        [true & ~read, read & ~true, ~read & ~true],
        [ReadingCategory.MISSING, ReadingCategory.SPURIOUS, ReadingCategory.NO_SURFACE],
    )
    category = np.where(several & ~true, 0, category)
    return (category | np.where(several, ReadingCategory.AMBIGUOUS, 0)).astype(np.uint8)


def _is_unread_beyond_ends(h: Float64, truth: GroundTruth) -> npt.NDArray[np.bool_]:
    """Return a mask of the samples without a reading whose lit surface is imaged beyond the ends of the sensor."""
    return np.asarray(((np.asarray(truth.status) & Status.OUT_OF_RANGE) != 0) & ~np.isfinite(h))


def _paths_of(cause: str, secondary_by_path: bool) -> tuple[str, ...]:
    """Return the light paths that belong to a cause."""
    if cause == "shape":
        return ("direct",)
    if cause == "secondary" and not secondary_by_path:
        return _SECONDARY
    return (cause,) if cause in (*PATHS, AMBIENT) else ()


def _additional_causes(light: Mapping[str, Exposure], secondary_by_path: bool) -> list[str]:
    """Return the causes that add light to the direct light, including causes without light."""
    ambient = [AMBIENT] if AMBIENT in light else []
    return ["specular", *(_SECONDARY if secondary_by_path else ["secondary"]), *ambient]


def _power_of(cause: str, light: Mapping[str, Exposure], secondary_by_path: bool) -> Float64:
    """Return the power of the light that belongs to a cause, (..., samples) [W]."""
    parts = [light[path].total() for path in _paths_of(cause, secondary_by_path) if path in light]
    zero = np.zeros(next(iter(light.values())).power.shape[:-1])
    return np.asarray(sum(parts, start=zero))


def _has_variants(light: Mapping[str, Exposure]) -> bool:
    given = [name in light for name in _VARIANTS]
    if any(given) and not all(given):
        raise ValueError(f"expected all of {'; '.join(_VARIANTS)} beside the direct light, or none of them")
    return all(given)


# ---- PSDs: contributions from moments of the light -----------------------------------------------------------


def _attribute_by_moments(
    view: SensorView,
    light: Mapping[str, Exposure],
    truth: GroundTruth,
    noiseless: Reading,
    secondary_by_path: bool,
) -> dict[str, Float64]:
    true_u, _ = height_slope(view, truth)
    edges = view.u_edges
    total = total_exposure(light).total()
    slope = height_secant(view.triangulation, true_u, noiseless.position, view.v_centres)
    with np.errstate(invalid="ignore", divide="ignore"):
        per_power = slope / total

        def contribution(path: str) -> Float64:
            exposure = light[path]
            return np.asarray((exposure.first_moment(edges) - true_u * exposure.total()) * per_power)

        causes: dict[str, Float64] = {}
        direct = contribution("direct") if "direct" in light else np.zeros(total.shape)
        if _has_variants(light):
            causes |= _direct_contributions(view, light, light["direct"].total() * per_power)
            causes["shape"] = direct - causes["occlusion"] - causes["reflectivity"]
        else:
            causes["shape"] = direct
        if BEYOND_ENDS in light and "direct" in light:
            causes["clipped"] = _clipping_contribution(view, light, light["direct"].total() * per_power)
            causes["shape"] = causes["shape"] - causes["clipped"]
        for cause in _additional_causes(light, secondary_by_path):
            parts = [contribution(path) for path in _paths_of(cause, secondary_by_path) if path in light]
            causes[cause] = np.asarray(sum(parts, start=np.zeros(total.shape)))
    return {name: causes[name] for name in (*CAUSES, *_SECONDARY) if name in causes}


def _direct_contributions(view: SensorView, light: Mapping[str, Exposure], weight: Float64) -> dict[str, Float64]:
    """Return the contributions of occlusion and reflectivity to the centroid of the direct light.

    These are Shapley values of two causes: the mean of the shifts with one cause added before and after the other.
    """
    centroid = {}
    for name in ("direct", *_VARIANTS):
        total = light[name].total()
        centroid[name] = np.where(total > 0.0, light[name].first_moment(view.u_edges) / total, np.nan)
    occlusion = (centroid["direct"] - centroid[UNOCCLUDED]) + (centroid[UNIFORM] - centroid[UNIFORM_UNOCCLUDED])
    reflectivity = (centroid["direct"] - centroid[UNIFORM]) + (centroid[UNOCCLUDED] - centroid[UNIFORM_UNOCCLUDED])
    return {
        "occlusion": np.nan_to_num(0.5 * weight * occlusion),
        "reflectivity": np.nan_to_num(0.5 * weight * reflectivity),
    }


def _clipping_contribution(view: SensorView, light: Mapping[str, Exposure], weight: Float64) -> Float64:
    """Return the contribution of the light beyond the ends: the shift of the direct light's centroid without it."""
    received, complete = light["direct"], light["direct"] + light[BEYOND_ENDS]
    clipped, unclipped = (each.first_moment(view.u_edges) / each.total() for each in (received, complete))
    return np.nan_to_num(weight * (clipped - unclipped))


# ---- any readout: contributions as Shapley values ------------------------------------------------------------


def _attribute_by_shapley_values(
    simulator: Simulator,
    light: Mapping[str, Exposure],
    truth: GroundTruth,
    secondary_by_path: bool,
    device: Device | None,
) -> dict[str, Float64]:
    additional = _additional_causes(light, secondary_by_path)
    direct = _direct_signals(simulator, light)
    signals = {}
    for name in additional:
        if np.any(_power_of(name, light, secondary_by_path) > 0.0):
            paths = _paths_of(name, secondary_by_path)
            signals[name] = simulator.signal(total_exposure({path: light[path] for path in paths if path in light}))
    # Occlusion and reflectivity change the direct light, and clipping takes light from it; the other causes add their
    # signals to it.
    changes = ["occlusion", "reflectivity"] if _has_variants(light) else []
    if isinstance(simulator, PsdSimulator) and BEYOND_ENDS in light:
        changes.append("clipped")
        lost = simulator.signal(light[BEYOND_ENDS])
        direct = {group | {"clipped"}: signal for group, signal in direct.items()} | {
            group: signal + lost for group, signal in direct.items()
        }
    present = changes + list(signals)
    errors: dict[frozenset[str], Float64] = {}
    for count in range(len(present) + 1):
        for group in itertools.combinations(present, count):
            total = sum(
                (signals[name] for name in group if name in signals), start=direct[frozenset(group) & {*changes}]
            )
            errors[frozenset(group)] = np.nan_to_num(simulator.heights(total, device) - truth.h)
    causes = {"shape": errors[frozenset()]}
    for name in changes + additional:
        causes[name] = _shapley_value(name, present, errors) if name in present else np.zeros(np.shape(truth.h))
    return causes


def _direct_signals(simulator: Simulator, light: Mapping[str, Exposure]) -> dict[frozenset[str], npt.NDArray[Any]]:
    """Return the signal of the direct light for each subset of its causes, occlusion and reflectivity.

    Without the variants of the direct light: the real direct light for the empty set.
    """
    real = light["direct"] if "direct" in light else dark_exposure(light)
    if not _has_variants(light):
        return {frozenset(): simulator.signal(real)}
    variants = {
        frozenset({"occlusion", "reflectivity"}): real,
        frozenset({"reflectivity"}): light[UNOCCLUDED],
        frozenset({"occlusion"}): _scaled_to_power(light[UNIFORM], real),
        frozenset(): _scaled_to_power(light[UNIFORM_UNOCCLUDED], light[UNOCCLUDED]),
    }
    return {causes: simulator.signal(exposure) for causes, exposure in variants.items()}


def _scaled_to_power(light: Exposure, reference: Exposure) -> Exposure:
    """Return light scaled, sample by sample, to the power of a reference."""
    total = light.total()
    factor = np.divide(reference.total(), total, out=np.zeros_like(total), where=total > 0.0)[..., None]
    return Exposure(factor * light.power, factor * light.moment)


def _shapley_value(name: str, causes: Sequence[str], errors: Mapping[frozenset[str], Float64]) -> Float64:
    """Return the Shapley value of one cause: the weighted mean of its marginal errors over all sets of other causes.

    A set S of the other n - 1 causes has the weight |S|! (n - 1 - |S|)! / n!.
    """
    others = [each for each in causes if each != name]
    total = np.zeros_like(errors[frozenset()])
    for count in range(len(others) + 1):
        weight = math.factorial(count) * math.factorial(len(others) - count) / math.factorial(len(causes))
        for group in itertools.combinations(others, count):
            before = frozenset(group)
            total += weight * (errors[before | {name}] - errors[before])
    return total
