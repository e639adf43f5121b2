"""Fusion of the readings of two sensors over one sheet of light.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.readings import Reading
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
    max_sigmas : float
        Two readings agree if they differ by at most this many standard deviations of their difference; 0 or more.
        Default 3.0.
    tolerance : float
        Additional allowed difference of agreeing readings [m]; 0 or more. Default 0.0.
    rule : {"flag", "mean", "stronger", "narrower", "predicted"}
        Decision where the sensors disagree. ``"flag"``: no value. ``"mean"``: the plain mean; at a step of
        reflectivity, two sensors that face each other have opposite errors of equal size. ``"stronger"``: the sensor
        that receives more light. ``"narrower"``: the camera that sees the narrower line. ``"predicted"``: the first,
        the second or the mean, whichever has the smallest error in a simulation of the part.
    min_ratio : float
        The chosen sensor must be better than the other by this factor, in the quantity of the rule; otherwise there
        is no value; 1 or more. Default 1.5.
    accept_single : bool
        True: a value that only one of the sensors has is accepted. Default True.

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
        first, second : Reading
            Readings of the two sensors, (..., samples) each.
        predicted : pair of array_like, optional
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
