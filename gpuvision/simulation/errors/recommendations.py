"""What to do about artifacts (F. de Jong, 4.6): choose the reflection that is read, or join two sensors.

Masks, the third means, are in `gpuvision.simulation.sensors.masks`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line import PeakSelection
from gpuvision.simulation.errors.error_attribution import ErrorAttribution, Verdict, attribute_errors, verdict_of
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.readings import Reading, Truth
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]
Rule = Literal["flag", "mean", "stronger", "narrower", "predicted"]

RULES = ("flag", "mean", "stronger", "narrower", "predicted")
NONE, FIRST, SECOND, BOTH = range(4)
_WITH_VALUE = int(Status.SATURATED | Status.AMBIGUOUS)


# ---- which reflection is read --------------------------------------------------------------------------------


class Ranked(NamedTuple):
    """How well a candidate reads a part.

    Attributes
    ----------
    name
        The candidate's.
    unread
        Share of the surfaces' samples that it misses or that are off by more than the limit.
    false
        Share of all samples where it reads what is no surface.
    rms
        Of the errors within the limit [m]; NaN where there are none.
    """

    name: str
    unread: float
    false: float
    rms: float


def rank(candidates: Mapping[str, ErrorAttribution], limit: float) -> list[Ranked]:
    """Order candidates by how well they read the same part, the best first.

    Candidates may be places of the sensor (which of a surface's reflections it gets), readouts, masks, or materials'
    coatings. What counts is the share of samples that are unread or false; of equals, the smaller error.

    Parameters
    ----------
    candidates
        What `attribute_errors` found for each.
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
    for name, found in candidates.items():
        good = found.error[np.abs(found.error) <= limit]
        rms = float(np.sqrt(np.mean(good**2))) if good.size else float("nan")
        false = float(np.mean(found.is_(Verdict.FALSE)))
        ranked.append(Ranked(name, found.unread(limit), false, rms))
    return sorted(ranked, key=lambda each: (each.unread + each.false, np.nan_to_num(each.rms, nan=np.inf)))


def compare_peaks(
    simulator: CameraSimulator,
    exposures: Mapping[str, Exposure],
    truth: Truth,
    *,
    peak_selections: Sequence[PeakSelection] = ("strongest", "first", "last"),
    seed: int | None = None,
    device: Device | None = None,
) -> dict[str, ErrorAttribution]:
    """Read the same light by each choice of a peak, where there are several; for `rank`.

    Parameters
    ----------
    simulator
        Its readout looks for peaks.
    exposures, truth
        Light by path, (profiles, samples, bins), and where the surface is.
    peak_selections
        Of `LineReadout.peak_selection`; the names in what is returned.
    seed, device
        As of `attribute_errors`.

    Raises
    ------
    ValueError
        The readout knows no peaks.
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


# ---- two sensors ---------------------------------------------------------------------------------------------


class Joined(NamedTuple):
    """What two sensors say together, each array (..., samples).

    Attributes
    ----------
    g, h
        The point in the sheet of light [m]; NaN where neither can be trusted.
    sigma
        Standard deviation of h by the sensors' noise [m].
    share
        Of the first sensor in g and h, 0 to 1; NaN where there is no value.
    source
        int8: 0 none, 1 the first sensor, 2 the second, 3 both.
    status
        uint8 `Status` flags: AMBIGUOUS where they disagree and the rule does not decide; the two sensors' own where
        neither has a value.
    """

    g: Float64
    h: Float64
    sigma: Float64
    share: Float64
    source: npt.NDArray[np.int8]
    status: npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class DualSensor:
    """The rule by which two sensors over one sheet of light become one.

    One value is taken as it is; of two that agree the mean is taken, weighed by their noise. Where they disagree, the
    one that is neither SATURATED nor AMBIGUOUS has it, if the other is; else the rule decides.

    Parameters
    ----------
    agree
        Readings agree within so many standard deviations of their difference.
    tolerance
        Beside these, a difference that does not matter [m].
    rule : {"flag", "mean", "stronger", "narrower", "predicted"}
        Where they disagree. ``"flag"``: no value. ``"mean"``: their plain mean; sensors that face each other err by
        as much to either side where the light's centre is not in the sheet's middle, at a step of reflectivity.
        ``"stronger"``: the one with more light, that of a surface seen. ``"narrower"``: the one with the narrower
        line. ``"predicted"``: the one, or the mean, for which a simulation of the part predicts the smallest error.
    margin
        How many times better the one must be than the other, by the rule; else there is no value.
    lone
        Whether a value that only one of the sensors has is taken.

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.
    """

    agree: float = 3.0
    tolerance: float = 0.0
    rule: Rule = "flag"
    margin: float = 1.5
    lone: bool = True

    def __post_init__(self) -> None:
        for name, least in (("agree", 0.0), ("tolerance", 0.0), ("margin", 1.0)):
            if finite(getattr(self, name), f"DualSensor.{name}") < least:
                raise ValueError(f"DualSensor.{name} is {getattr(self, name)}, expected {least:g} or more")
        if self.rule not in RULES:
            raise ValueError(f"DualSensor.rule is {self.rule!r}, expected one of {', '.join(RULES)}")

    def join(
        self, first: Reading, second: Reading, predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None = None
    ) -> Joined:
        """Join readings of the same places along the sheet (see `resampled`).

        Parameters
        ----------
        first, second
            (..., samples) each.
        predicted
            Errors (..., samples) of both that a simulation predicts [m], for the rule "predicted"; NaN where it
            predicts no reading.

        Raises
        ------
        ValueError
            Shapes differ, or the rule needs what is not given.
        """
        if first.h.shape != second.h.shape:
            raise ValueError(f"the readings have shapes {first.h.shape} and {second.h.shape}, expected the same")
        weights = _weights(first.sigma, second.sigma)
        has = np.isfinite(first.h), np.isfinite(second.h)
        both = has[0] & has[1]
        spread = self.agree * np.hypot(np.nan_to_num(first.sigma), np.nan_to_num(second.sigma)) + self.tolerance
        with np.errstate(invalid="ignore"):
            agreed = both & (np.abs(first.h - second.h) <= spread)
        decided, weights = self._decide(first, second, both & ~agreed, weights, predicted)
        source = np.where(agreed, BOTH, decided)
        if self.lone:
            source = np.where(has[0] & ~has[1], FIRST, np.where(has[1] & ~has[0], SECOND, source))
        return _taken(first, second, source, weights, both)

    def _decide(
        self,
        first: Reading,
        second: Reading,
        disputed: npt.NDArray[np.bool_],
        weights: tuple[Float64, Float64],
        predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None,
    ) -> tuple[npt.NDArray[np.int64], tuple[Float64, Float64]]:
        """Return who has it where they disagree, and the weights of means."""
        doubtful = [(each.status & _WITH_VALUE) != 0 for each in (first, second)]
        clear = np.where(doubtful[1] & ~doubtful[0], FIRST, np.where(doubtful[0] & ~doubtful[1], SECOND, NONE))
        if self.rule == "flag":
            ruled = np.zeros(disputed.shape, np.int64)
        elif self.rule == "mean":
            ruled = np.full(disputed.shape, BOTH)
        elif self.rule == "stronger":
            ruled = self._better(1.0 / np.maximum(first.strength, 1e-300), 1.0 / np.maximum(second.strength, 1e-300))
        elif self.rule == "narrower":
            if np.isnan(first.width).all() or np.isnan(second.width).all():
                raise ValueError("DualSensor.rule 'narrower' needs the lines' widths, which only cameras know")
            ruled = self._better(first.width, second.width)
        else:
            ruled = self._least_error(disputed, predicted)
        half = np.full(disputed.shape, 0.5)
        means = tuple(np.where(disputed, half, each) for each in weights)
        decided = np.where(disputed, np.where(clear == NONE, ruled, clear), NONE)
        return decided, (means[0], means[1])

    def _better(self, first: Float64, second: Float64) -> npt.NDArray[np.int64]:
        """Return whose badness is smaller by the margin."""
        with np.errstate(invalid="ignore"):
            return np.where(self.margin * first <= second, FIRST, np.where(self.margin * second <= first, SECOND, NONE))

    def _least_error(
        self, disputed: npt.NDArray[np.bool_], predicted: tuple[npt.ArrayLike, npt.ArrayLike] | None
    ) -> npt.NDArray[np.int64]:
        if predicted is None:
            raise ValueError(
                "DualSensor.rule 'predicted' needs the errors that a simulation predicts, predicted=(a, b)"
            )
        one, other = (np.broadcast_to(np.asarray(each, np.float64), disputed.shape) for each in predicted)
        errors = np.abs(np.stack([one, other, 0.5 * (one + other)]))
        errors = np.where(np.isnan(errors), np.inf, errors)
        best = errors.argmin(axis=0)
        runner_up = np.sort(errors, axis=0)[1]
        sure = np.isfinite(errors.min(axis=0)) & (self.margin * errors.min(axis=0) <= runner_up)
        return np.where(sure, np.array([FIRST, SECOND, BOTH])[best], NONE)


def attribute_pair_errors(
    first: ErrorAttribution, second: ErrorAttribution, rule: DualSensor, *, gap: float, g: npt.ArrayLike | None = None
) -> dict[str, ErrorAttribution]:
    """Return what two sensors over one sheet make of a part: "first", "second" and "both", for `rank`.

    All three lie at the same places along the sheet and are judged by the surfaces that either sensor sees: what is
    hidden from one of them is missing there.

    Parameters
    ----------
    first, second
        What `attribute_errors` found for each, (profiles, samples) of the same profiles.
    rule
        "predicted" takes their errors without noise for what a simulation predicts.
    gap
        As for `resampled` [m].
    g
        (k,) the places [m]; None: where the first one's samples see the part, in the median over the profiles.

    Returns
    -------
    dict
        Causes of "both" have the sensors' shares of the reading; what lies between samples is added to "shape". Places
        along u are NaN.

    Raises
    ------
    ValueError
        As `DualSensor.join`; or the first sensor sees no surface and ``g`` is not given.
    """
    places = _usual_places(first) if g is None else np.asarray(g, np.float64)
    at = np.broadcast_to(places, (*first.error.shape[:-1], *places.shape))
    truths = [
        _Lines.through(each.truth.g, np.isfinite(each.truth.h), at, gap).values(each.truth.h)
        for each in (first, second)
    ]
    h = np.where(np.isfinite(truths[0]), truths[0], truths[1])
    truth = Truth(np.where(np.isfinite(h), at, np.nan), h, np.where(np.isfinite(h), 0, int(Status.LOW_SIGNAL)))
    alone = [_resampled_artifacts(each, truth, at, gap) for each in (first, second)]
    expected = [each.error - each.causes["noise"] for each in alone]
    joined = rule.join(alone[0].reading, alone[1].reading, (expected[0], expected[1]))
    error = joined.h - h
    causes = {}
    for name in (name for name in alone[0].causes if name in alone[1].causes):
        one, other = (each.causes[name] for each in alone)
        mean = joined.share * one + (1.0 - joined.share) * other
        part = np.where(joined.share == 1.0, one, np.where(joined.share == 0.0, other, mean))
        causes[name] = np.where(np.isfinite(error), part, np.nan)
    nothing = np.full(h.shape, np.nan)
    strength = np.where(joined.share >= 0.5, alone[0].reading.strength, alone[1].reading.strength)
    both = ErrorAttribution(
        reading=Reading(nothing, joined.g, joined.h, joined.sigma, strength, nothing, joined.status),
        truth=truth,
        error=error,
        causes=causes,
        light={name: alone[0].light[name] + alone[1].light[name] for name in causes},
        verdict=verdict_of(joined.h, truth),
    )
    return {"first": alone[0], "second": alone[1], "both": both}


def _usual_places(found: ErrorAttribution) -> Float64:
    g = np.asarray(found.truth.g, np.float64).reshape(-1, np.shape(found.truth.g)[-1])
    known = np.isfinite(g).any(axis=0)
    if not known.any():
        raise ValueError("the first sensor sees no surface; give the places along the sheet, g=")
    at = np.flatnonzero(known)
    return np.interp(np.arange(g.shape[1]), at, np.nanmedian(g[:, at], axis=0))


def _resampled_artifacts(found: ErrorAttribution, truth: Truth, places: Float64, gap: float) -> ErrorAttribution:
    """Return readings at other places beside a truth of those places."""
    reading = resampled(found.reading, places, gap=gap)
    error = reading.h - truth.h
    lines = _Lines.through(found.reading.g, np.isfinite(found.reading.h), places, gap)
    # Where the sample had no truth beside it, the other sensor's says how wrong it is, and "shape" has it all.
    causes = {name: lines.values(np.nan_to_num(part)) for name, part in found.causes.items()}
    causes["shape"] = causes["shape"] + (error - np.sum(list(causes.values()), axis=0))
    return ErrorAttribution(
        reading=reading,
        truth=truth,
        error=error,
        causes={name: np.where(np.isfinite(error), part, np.nan) for name, part in causes.items()},
        light={name: np.nan_to_num(lines.values(part)) for name, part in found.light.items()},
        verdict=verdict_of(reading.h, truth),
    )


def resampled(reading: Reading, g: npt.ArrayLike, *, gap: float) -> Reading:
    """Return a profile at other places along the sheet: straight lines between its points.

    Beside a hole and at either end a point stands for what is up to half a usual distance of points away.

    Parameters
    ----------
    reading
        (samples,) or (profiles, samples).
    g
        (k,) places, ascending, or (profiles, k) of another sensor's reading; NaN gives NaN [m].
    gap
        No line is drawn between points further apart than this along the sheet [m]. Where there is none there is no
        value, with the status NO_DATA.

    Returns
    -------
    Reading
        Of shape (..., k). Flags of either end go with the line; its sigma, strength and width are lines too.
    """
    at = np.broadcast_to(np.asarray(g, np.float64), (*reading.h.shape[:-1], np.shape(g)[-1]))
    lines = _Lines.through(reading.g, np.isfinite(reading.h), at, gap)
    position, h, sigma, strength, width = (
        lines.values(part) for part in (reading.position, reading.h, reading.sigma, reading.strength, reading.width)
    )
    return Reading(position, np.where(lines.inside, at, np.nan), h, sigma, strength, width, lines.flags(reading.status))


class _Lines(NamedTuple):
    """Which two samples each place lies between, how far from the one to the other, and whether it does; (..., k)."""

    left: npt.NDArray[np.intp]
    right: npt.NDArray[np.intp]
    t: Float64
    inside: npt.NDArray[np.bool_]

    @classmethod
    def through(cls, g: Float64, known: npt.NDArray[np.bool_], places: Float64, gap: float) -> _Lines:
        lines = cls(
            np.zeros(places.shape, np.intp),
            np.zeros(places.shape, np.intp),
            np.zeros(places.shape),
            np.zeros(places.shape, bool),
        )
        known = known & np.isfinite(g)
        for row in np.ndindex(places.shape[:-1]):
            samples = np.flatnonzero(known[row])
            if samples.size:
                samples = samples[np.argsort(g[row][samples], kind="stable")]
                left, right, t, inside = _spans(g[row][samples], places[row], gap)
                lines.left[row], lines.right[row] = samples[left], samples[right]
                lines.t[row], lines.inside[row] = t, inside
        return lines

    def values(self, of: npt.NDArray[Any]) -> Float64:
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        # On a point itself the other end does not matter.
        with np.errstate(invalid="ignore"):
            line = np.where(self.t == 0.0, left, np.where(self.t == 1.0, right, (1.0 - self.t) * left + self.t * right))
        return np.where(self.inside, line, np.nan)

    def flags(self, of: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        left, right = (np.take_along_axis(of, ends, axis=-1) for ends in (self.left, self.right))
        either = np.where(self.t < 1.0, left, 0) | np.where(self.t > 0.0, right, 0)
        return np.where(self.inside, either, int(Status.NO_DATA)).astype(np.uint8)


def _spans(x: Float64, at: Float64, gap: float) -> tuple[Any, ...]:
    """Return left and right neighbours among ascending x, the share of the way between them, and whether it counts."""
    right = np.clip(np.searchsorted(x, at, side="left"), min(1, len(x) - 1), len(x) - 1)
    left = np.maximum(right - 1, 0)
    width = x[right] - x[left]
    usual = min(float(np.median(np.diff(x))), gap) if len(x) > 1 else gap
    with np.errstate(invalid="ignore", divide="ignore"):
        t = np.where(width > 0.0, (at - x[left]) / width, np.nan)
        between = (t >= 0.0) & (t <= 1.0) & (width <= gap)
        nearer = np.where(np.abs(at - x[left]) <= np.abs(at - x[right]), 0.0, 1.0)
        beside = np.abs(at - np.where(nearer == 0.0, x[left], x[right])) <= 0.5 * usual
    return left, right, np.where(between, t, nearer), between | beside


def _weights(first: Float64, second: Float64) -> tuple[Float64, Float64]:
    """Return shares of a mean by the inverse of the variances; halves where either is not known."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        share = second**2 / (first**2 + second**2)
    share = np.where(np.isfinite(share), share, 0.5)
    return share, 1.0 - share


def _taken(
    first: Reading,
    second: Reading,
    source: npt.NDArray[np.int64],
    weights: tuple[Float64, Float64],
    both: npt.NDArray[np.bool_],
) -> Joined:
    def chosen(one: Float64, other: Float64, mean: Float64) -> Float64:
        return np.choose(source, [np.full(source.shape, np.nan), one, other, mean])

    def of(one: Float64, other: Float64) -> Float64:
        return chosen(one, other, weights[0] * one + weights[1] * other)

    spread = np.hypot(weights[0] * first.sigma, weights[1] * second.sigma)
    either = first.status | second.status
    own = np.choose(source, [np.where(both, int(Status.AMBIGUOUS), either), first.status, second.status, either])
    # A lone value that is not taken is no value: its flags do not say so.
    own = np.where((source == NONE) & (own == 0), int(Status.AMBIGUOUS), own)
    return Joined(
        g=of(first.g, second.g),
        h=of(first.h, second.h),
        sigma=chosen(first.sigma, second.sigma, spread),
        share=chosen(np.ones(source.shape), np.zeros(source.shape), weights[0]),
        source=source.astype(np.int8),
        status=own.astype(np.uint8),
    )
