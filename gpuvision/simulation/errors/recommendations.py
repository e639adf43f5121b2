"""Remedies for range errors: choice of the reflection that is read, and fusion of two sensors.

Masks, the third remedy, are in `gpuvision.simulation.sensors.masks`.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line import PeakSelection
from gpuvision.simulation.errors.error_attribution import (
    ErrorAttribution,
    ReadingCategory,
    attribute_errors,
    classify_readings,
)
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.readings import GroundTruth, Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]
Rule = Literal["flag", "mean", "stronger", "narrower", "predicted"]

RULES = ("flag", "mean", "stronger", "narrower", "predicted")
"""Rules of `SensorFusion`."""
NONE, FIRST, SECOND, BOTH = range(4)
"""Values of `FusedReading.source`."""
# Status flags with which a sensor still reports a value, one of lower reliability.
_DOUBTFUL = int(Status.SATURATED | Status.AMBIGUOUS)


# ---- comparison of candidates --------------------------------------------------------------------------------


class RankedCandidate(NamedTuple):
    """Reading quality of a candidate.

    Attributes
    ----------
    name
        Name of the candidate.
    failed_fraction
        Fraction of the lit-surface samples that have no reading or an error larger than the limit.
    spurious_fraction
        Fraction of all samples with a reading where no lit surface is visible.
    rms
        RMS of the errors within the limit [m]; NaN if no error is.
    """

    name: str
    failed_fraction: float
    spurious_fraction: float
    rms: float


def rank_candidates(candidates: Mapping[str, ErrorAttribution], limit: float) -> list[RankedCandidate]:
    """Rank candidates by how well they read the same part, the best first.

    Candidates can be sensor positions (a position selects which reflections of a surface the sensor sees), readouts,
    masks, or coatings. The order is by the sum of failed and spurious fraction, then by the RMS error.

    Parameters
    ----------
    candidates
        Result of `attribute_errors` for each candidate, by name.
    limit
        Largest error of a good reading [m].

    Raises
    ------
    ValueError
        There is no candidate.
    """
    if not candidates:
        raise ValueError("expected one candidate or more")
    ranked = []
    for name, attribution in candidates.items():
        good = attribution.error[np.abs(attribution.error) <= limit]
        rms = float(np.sqrt(np.mean(good**2))) if good.size else float("nan")
        spurious = float(np.mean(attribution.is_category(ReadingCategory.SPURIOUS)))
        ranked.append(RankedCandidate(name, attribution.failed_fraction(limit), spurious, rms))
    return sorted(
        ranked, key=lambda each: (each.failed_fraction + each.spurious_fraction, np.nan_to_num(each.rms, nan=np.inf))
    )


def compare_peak_selections(
    simulator: CameraSimulator,
    exposures: Mapping[str, Exposure],
    truth: GroundTruth,
    *,
    peak_selections: Sequence[PeakSelection] = ("strongest", "first", "last"),
    seed: int | None = None,
    device: Device | None = None,
) -> dict[str, ErrorAttribution]:
    """Read the same light with each peak selection, for columns with several peaks.

    Parameters
    ----------
    simulator
        Camera with a readout that detects peaks.
    exposures, truth
        Light by path, (profiles, samples, bins), and the ground truth, (profiles, samples).
    peak_selections
        Values of `LineReadout.peak_selection`.
    seed, device
        As for `attribute_errors`.

    Returns
    -------
    dict
        Errors by peak selection; candidates for `rank_candidates`.

    Raises
    ------
    ValueError
        The method of the readout does not detect peaks.
    """
    return {
        selection: attribute_errors(
            replace(simulator, readout=replace(simulator.readout, peak_selection=selection)),
            exposures,
            truth,
            seed=seed,
            device=device,
        )
        for selection in peak_selections
    }


# ---- fusion of two sensors -----------------------------------------------------------------------------------


class FusedReading(NamedTuple):
    """Fused readings of two sensors, arrays (..., samples).

    Attributes
    ----------
    g, h
        Point in the sheet of light [m]; NaN where neither sensor is accepted.
    sigma
        Standard deviation of h from the noise of the sensors [m].
    first_weight
        Weight of the first sensor in g and h, 0 to 1; NaN where there is no value.
    source
        int8: `NONE` (0), `FIRST` (1), `SECOND` (2) or `BOTH` (3).
    status
        uint8 `Status` flags: AMBIGUOUS where the sensors disagree and the rule does not decide; the flags of both
        sensors where neither has a value.
    """

    g: Float64
    h: Float64
    sigma: Float64
    first_weight: Float64
    source: npt.NDArray[np.int8]
    status: npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class SensorFusion:
    """Fusion rule for two sensors over one sheet of light.

    Where one sensor has a value, that value is taken. Where both agree, the result is their mean, weighted by the
    inverse variances. Where they disagree and one of them is SATURATED or AMBIGUOUS, the other one is taken; otherwise
    the rule decides.

    Parameters
    ----------
    max_sigmas
        Two readings agree if they differ by at most this many standard deviations of their difference; 0 or more.
    tolerance
        Additional allowed difference of agreeing readings [m]; 0 or more.
    rule : {"flag", "mean", "stronger", "narrower", "predicted"}
        Decision where the sensors disagree. ``"flag"``: no value. ``"mean"``: the plain mean; at a step of
        reflectivity, two sensors that face each other have opposite errors of equal size. ``"stronger"``: the sensor
        that receives more light. ``"narrower"``: the camera that sees the narrower line. ``"predicted"``: the first,
        the second or the mean, whichever has the smallest error in a simulation of the part.
    min_ratio
        The chosen sensor must be better than the other by this factor, in the quantity of the rule; otherwise there
        is no value; 1 or more.
    accept_single
        True: a value that only one of the sensors has is accepted.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.2.
    """

    max_sigmas: float = 3.0
    tolerance: float = 0.0
    rule: Rule = "flag"
    min_ratio: float = 1.5
    accept_single: bool = True

    def __post_init__(self) -> None:
        for name, least in (("max_sigmas", 0.0), ("tolerance", 0.0), ("min_ratio", 1.0)):
            if finite(getattr(self, name), f"SensorFusion.{name}") < least:
                raise ValueError(f"SensorFusion.{name} is {getattr(self, name)}, expected {least:g} or more")
        if self.rule not in RULES:
            raise ValueError(f"SensorFusion.rule is {self.rule!r}, expected one of {', '.join(RULES)}")

    def fuse(
        self, first: Reading, second: Reading, predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None = None
    ) -> FusedReading:
        """Fuse readings at the same positions along the sheet (see `resample_reading`).

        Parameters
        ----------
        first, second
            Readings of the two sensors, (..., samples) each.
        predicted
            Errors of both sensors that a simulation predicts, (..., samples) each [m]; for the rule "predicted". NaN:
            the simulation predicts no reading.

        Raises
        ------
        ValueError
            Shapes differ, or an input that the rule needs is missing.
        """
        if first.h.shape != second.h.shape:
            raise ValueError(f"the readings have shapes {first.h.shape} and {second.h.shape}, expected the same")
        weights = _inverse_variance_weights(first.sigma, second.sigma)
        has = np.isfinite(first.h), np.isfinite(second.h)
        both = has[0] & has[1]
        threshold = self.max_sigmas * np.hypot(np.nan_to_num(first.sigma), np.nan_to_num(second.sigma))
        threshold = threshold + self.tolerance
        with np.errstate(invalid="ignore"):
            agreed = both & (np.abs(first.h - second.h) <= threshold)
        decided, weights = self._decide(first, second, both & ~agreed, weights, predicted)
        source = np.where(agreed, BOTH, decided)
        if self.accept_single:
            source = np.where(has[0] & ~has[1], FIRST, np.where(has[1] & ~has[0], SECOND, source))
        return _fused(first, second, source, weights, both)

    def _decide(
        self,
        first: Reading,
        second: Reading,
        disputed: npt.NDArray[np.bool_],
        weights: tuple[Float64, Float64],
        predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None,
    ) -> tuple[npt.NDArray[np.int64], tuple[Float64, Float64]]:
        """Return the source of disputed samples (NONE elsewhere), and the weights of the mean of all samples."""
        doubtful = [(each.status & _DOUBTFUL) != 0 for each in (first, second)]
        reliable = np.where(doubtful[1] & ~doubtful[0], FIRST, np.where(doubtful[0] & ~doubtful[1], SECOND, NONE))
        if self.rule == "flag":
            by_rule = np.zeros(disputed.shape, np.int64)
        elif self.rule == "mean":
            by_rule = np.full(disputed.shape, BOTH)
        elif self.rule == "stronger":
            # 1e-300 only avoids a division by zero: a sensor without light never wins.
            by_rule = self._smaller(1.0 / np.maximum(first.strength, 1e-300), 1.0 / np.maximum(second.strength, 1e-300))
        elif self.rule == "narrower":
            if np.isnan(first.width).all() or np.isnan(second.width).all():
                raise ValueError("SensorFusion.rule 'narrower' needs line widths, which only cameras measure")
            by_rule = self._smaller(first.width, second.width)
        else:
            by_rule = self._least_predicted_error(disputed, predicted)
        half = np.full(disputed.shape, 0.5)
        means = tuple(np.where(disputed, half, each) for each in weights)
        decided = np.where(disputed, np.where(reliable == NONE, by_rule, reliable), NONE)
        return decided, (means[0], means[1])

    def _smaller(self, first: Float64, second: Float64) -> npt.NDArray[np.int64]:
        """Return the sensor whose value is smaller by the factor `min_ratio`, or NONE."""
        with np.errstate(invalid="ignore"):
            return np.where(
                self.min_ratio * first <= second, FIRST, np.where(self.min_ratio * second <= first, SECOND, NONE)
            )

    def _least_predicted_error(
        self, disputed: npt.NDArray[np.bool_], predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None
    ) -> npt.NDArray[np.int64]:
        if predicted is None:
            raise ValueError("SensorFusion.rule 'predicted' needs the errors of a simulation, predicted=(a, b)")
        one, other = (np.broadcast_to(np.asarray(each, np.float64), disputed.shape) for each in predicted)
        errors = np.abs(np.stack([one, other, 0.5 * (one + other)]))
        errors = np.where(np.isnan(errors), np.inf, errors)
        best = errors.argmin(axis=0)
        runner_up = np.sort(errors, axis=0)[1]
        sure = np.isfinite(errors.min(axis=0)) & (self.min_ratio * errors.min(axis=0) <= runner_up)
        return np.where(sure, np.array([FIRST, SECOND, BOTH])[best], NONE)


def attribute_pair_errors(
    first: ErrorAttribution,
    second: ErrorAttribution,
    fusion: SensorFusion,
    *,
    max_gap: float,
    g: npt.ArrayLike | None = None,
) -> dict[str, ErrorAttribution]:
    """Attribute the errors of two sensors over one sheet and of their fusion, for `rank_candidates`.

    All three results have the same positions along the sheet and the same ground truth: every surface that either
    sensor sees. A surface that is occluded from one sensor counts as missing for that sensor.

    Parameters
    ----------
    first, second
        Results of `attribute_errors` for the two sensors, (profiles, samples), with the same profiles.
    fusion
        Fusion rule. The rule "predicted" uses the errors without noise of the two results as the prediction.
    max_gap
        As for `resample_reading` [m].
    g
        (k,), positions along the sheet [m]. None: the positions at which the samples of the first sensor see the part,
        as medians over the profiles.

    Returns
    -------
    dict
        "first", "second" and "both". The contributions of "both" are weighted like the readings; errors of the
        interpolation between samples belong to "shape". Positions along u are NaN in "both".

    Raises
    ------
    ValueError
        As `SensorFusion.fuse`; or the first sensor sees no surface and ``g`` is not given.
    """
    positions = _median_positions(first) if g is None else np.asarray(g, np.float64)
    at = np.broadcast_to(positions, (*first.error.shape[:-1], *positions.shape))
    truths = [
        _Interpolation.between(each.truth.g, np.isfinite(each.truth.h), at, max_gap).values(each.truth.h)
        for each in (first, second)
    ]
    h = np.where(np.isfinite(truths[0]), truths[0], truths[1])
    truth = GroundTruth(np.where(np.isfinite(h), at, np.nan), h, np.where(np.isfinite(h), 0, int(Status.LOW_SIGNAL)))
    alone = [_resample_attribution(each, truth, at, max_gap) for each in (first, second)]
    predicted = [each.error - each.causes["noise"] for each in alone]
    fused = fusion.fuse(alone[0].reading, alone[1].reading, (predicted[0], predicted[1]))
    error = fused.h - h
    causes = {}
    for name in (name for name in alone[0].causes if name in alone[1].causes):
        one, other = (each.causes[name] for each in alone)
        mean = fused.first_weight * one + (1.0 - fused.first_weight) * other
        part = np.where(fused.first_weight == 1.0, one, np.where(fused.first_weight == 0.0, other, mean))
        causes[name] = np.where(np.isfinite(error), part, np.nan)
    unknown = np.full(h.shape, np.nan)
    strength = np.where(fused.first_weight >= 0.5, alone[0].reading.strength, alone[1].reading.strength)
    both = ErrorAttribution(
        reading=Reading(unknown, fused.g, fused.h, fused.sigma, strength, unknown, fused.status),
        truth=truth,
        error=error,
        causes=causes,
        power={name: alone[0].power[name] + alone[1].power[name] for name in causes},
        category=classify_readings(fused.h, truth),
    )
    return {"first": alone[0], "second": alone[1], "both": both}


def _median_positions(attribution: ErrorAttribution) -> Float64:
    """Return the median position along the sheet of each sample, (samples,); interpolated for samples without truth."""
    g = np.asarray(attribution.truth.g, np.float64).reshape(-1, np.shape(attribution.truth.g)[-1])
    known = np.isfinite(g).any(axis=0)
    if not known.any():
        raise ValueError("the first sensor sees no surface; give the positions along the sheet, g=")
    at = np.flatnonzero(known)
    return np.interp(np.arange(g.shape[1]), at, np.nanmedian(g[:, at], axis=0))


def _resample_attribution(
    attribution: ErrorAttribution, truth: GroundTruth, positions: Float64, max_gap: float
) -> ErrorAttribution:
    """Return the readings at other positions, with their errors against the ground truth at these positions."""
    reading = resample_reading(attribution.reading, positions, max_gap=max_gap)
    error = reading.h - truth.h
    lines = _Interpolation.between(attribution.reading.g, np.isfinite(attribution.reading.h), positions, max_gap)
    # Where only the other sensor sees the surface, the causes of the error are unknown: "shape" takes all of it.
    causes = {name: lines.values(np.nan_to_num(part)) for name, part in attribution.causes.items()}
    causes["shape"] = causes["shape"] + (error - np.sum(list(causes.values()), axis=0))
    return ErrorAttribution(
        reading=reading,
        truth=truth,
        error=error,
        causes={name: np.where(np.isfinite(error), part, np.nan) for name, part in causes.items()},
        power={name: np.nan_to_num(lines.values(part)) for name, part in attribution.power.items()},
        category=classify_readings(reading.h, truth),
    )


def resample_reading(reading: Reading, g: npt.ArrayLike, *, max_gap: float) -> Reading:
    """Resample profiles at other positions along the sheet, by linear interpolation between neighbouring points.

    Next to a gap and at both ends of a profile, the nearest point is used up to half the median distance of points.

    Parameters
    ----------
    reading
        (samples,) or (profiles, samples).
    g
        Positions [m]: (k,) ascending, or (profiles, k), for example of the reading of another sensor. NaN gives NaN.
    max_gap
        No interpolation between points farther apart along the sheet [m]. Positions in such a gap have no value and
        the status NO_DATA.

    Returns
    -------
    Reading
        (..., k). Sigma, strength and width are also interpolated; the flags of both neighbours are combined.
    """
    at = np.broadcast_to(np.asarray(g, np.float64), (*reading.h.shape[:-1], np.shape(g)[-1]))
    lines = _Interpolation.between(reading.g, np.isfinite(reading.h), at, max_gap)
    position, h, sigma, strength, width = (
        lines.values(part) for part in (reading.position, reading.h, reading.sigma, reading.strength, reading.width)
    )
    return Reading(position, np.where(lines.inside, at, np.nan), h, sigma, strength, width, lines.flags(reading.status))


class _Interpolation(NamedTuple):
    """Linear interpolation at positions (..., k): both neighbours, fraction of the way, and whether it is valid."""

    left: npt.NDArray[np.intp]
    right: npt.NDArray[np.intp]
    t: Float64
    inside: npt.NDArray[np.bool_]

    @classmethod
    def between(cls, g: Float64, known: npt.NDArray[np.bool_], positions: Float64, max_gap: float) -> _Interpolation:
        lines = cls(
            np.zeros(positions.shape, np.intp),
            np.zeros(positions.shape, np.intp),
            np.zeros(positions.shape),
            np.zeros(positions.shape, bool),
        )
        known = known & np.isfinite(g)
        for row in np.ndindex(positions.shape[:-1]):
            samples = np.flatnonzero(known[row])
            if samples.size:
                samples = samples[np.argsort(g[row][samples], kind="stable")]
                left, right, t, inside = _neighbours(g[row][samples], positions[row], max_gap)
                lines.left[row], lines.right[row] = samples[left], samples[right]
                lines.t[row], lines.inside[row] = t, inside
        return lines

    def values(self, of: npt.NDArray[Any]) -> Float64:
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        # At t = 0 and t = 1 the value of the other neighbour is not used: it may be NaN.
        with np.errstate(invalid="ignore"):
            line = np.where(self.t == 0.0, left, np.where(self.t == 1.0, right, (1.0 - self.t) * left + self.t * right))
        return np.where(self.inside, line, np.nan)

    def flags(self, of: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        either = np.where(self.t < 1.0, left, 0) | np.where(self.t > 0.0, right, 0)
        return np.where(self.inside, either, int(Status.NO_DATA)).astype(np.uint8)


def _neighbours(x: Float64, at: Float64, max_gap: float) -> tuple[Any, ...]:
    """Return the left and right neighbour among ascending x, the fraction of the way, and whether it is valid."""
    right = np.clip(np.searchsorted(x, at, side="left"), min(1, len(x) - 1), len(x) - 1)
    left = np.maximum(right - 1, 0)
    width = x[right] - x[left]
    median_step = min(float(np.median(np.diff(x))), max_gap) if len(x) > 1 else max_gap
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.where(width > 0.0, (at - x[left]) / width, np.nan)
        between = (t >= 0.0) & (t <= 1.0) & (width <= max_gap)
        nearer = np.where(np.abs(at - x[left]) <= np.abs(at - x[right]), 0.0, 1.0)
        close = np.abs(at - np.where(nearer == 0.0, x[left], x[right])) <= 0.5 * median_step
    return left, right, np.where(between, t, nearer), between | close


def _inverse_variance_weights(first: Float64, second: Float64) -> tuple[Float64, Float64]:
    """Return weights of a mean, proportional to the inverse variances; 1/2 each where a sigma is unknown."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        weight = second**2 / (first**2 + second**2)
    weight = np.where(np.isfinite(weight), weight, 0.5)
    return weight, 1.0 - weight


def _fused(
    first: Reading,
    second: Reading,
    source: npt.NDArray[np.int64],
    weights: tuple[Float64, Float64],
    both: npt.NDArray[np.bool_],
) -> FusedReading:
    """Return the values of the chosen sources."""

    def select(one: Float64, other: Float64, mean: Float64) -> Float64:
        return np.choose(source, [np.full(source.shape, np.nan), one, other, mean])

    def weighted(one: Float64, other: Float64) -> Float64:
        return select(one, other, weights[0] * one + weights[1] * other)

    sigma_of_mean = np.hypot(weights[0] * first.sigma, weights[1] * second.sigma)
    either = first.status | second.status
    status = np.choose(source, [np.where(both, int(Status.AMBIGUOUS), either), first.status, second.status, either])
    # A single value that is not accepted can have no flag; without a value there must be one.
    status = np.where((source == NONE) & (status == 0), int(Status.AMBIGUOUS), status)
    return FusedReading(
        g=weighted(first.g, second.g),
        h=weighted(first.h, second.h),
        sigma=select(first.sigma, second.sigma, sigma_of_mean),
        first_weight=select(np.ones(source.shape), np.zeros(source.shape), weights[0]),
        source=source.astype(np.int8),
        status=status.astype(np.uint8),
    )
