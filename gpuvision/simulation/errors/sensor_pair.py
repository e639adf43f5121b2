"""Attribution of the errors of two sensors over one sheet of light, and of their fusion."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.errors.error_attribution import ErrorAttribution, classify_readings
from gpuvision.simulation.errors.resampling import Interpolation, resample_reading
from gpuvision.simulation.errors.sensor_fusion import FusedReading, SensorFusion
from gpuvision.simulation.sensors.readings import GroundTruth, Reading
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]


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
        Interpolation.between(each.truth.g, np.isfinite(each.truth.h), at, max_gap).values(each.truth.h)
        for each in (first, second)
    ]
    h = np.where(np.isfinite(truths[0]), truths[0], truths[1])
    truth = GroundTruth(np.where(np.isfinite(h), at, np.nan), h, np.where(np.isfinite(h), 0, int(Status.LOW_SIGNAL)))
    alone = [_resample_attribution(each, truth, at, max_gap) for each in (first, second)]
    predicted = [each.error - each.causes["noise"] for each in alone]
    fused = fusion.fuse(alone[0].reading, alone[1].reading, (predicted[0], predicted[1]))
    return {"first": alone[0], "second": alone[1], "both": _fused_attribution(fused, alone[0], alone[1], truth)}


def _fused_attribution(
    fused: FusedReading, first: ErrorAttribution, second: ErrorAttribution, truth: GroundTruth
) -> ErrorAttribution:
    """Return the errors of fused readings; each cause is weighted like the readings."""
    error = fused.h - truth.h
    causes = {}
    none = np.zeros(error.shape)
    # A cause that only one of the sensors has contributes nothing to the other.
    for name in dict.fromkeys([*first.causes, *second.causes]):
        one, other = first.causes.get(name, none), second.causes.get(name, none)
        mean = fused.first_weight * one + (1.0 - fused.first_weight) * other
        part = np.where(fused.first_weight == 1.0, one, np.where(fused.first_weight == 0.0, other, mean))
        causes[name] = np.where(np.isfinite(error), part, np.nan)
    unknown = np.full(error.shape, np.nan)
    strength = np.where(fused.first_weight >= 0.5, first.reading.strength, second.reading.strength)
    return ErrorAttribution(
        reading=Reading(unknown, fused.g, fused.h, fused.sigma, strength, unknown, fused.status),
        truth=truth,
        error=error,
        causes=causes,
        power={name: first.power.get(name, none) + second.power.get(name, none) for name in causes},
        category=classify_readings(fused.h, truth),
    )


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
    lines = Interpolation.between(attribution.reading.g, np.isfinite(attribution.reading.h), positions, max_gap)
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
