"""Comparison of remedies for range errors, such as the choice of the reflection that is read.

The other remedies: `gpuvision.simulation.errors.sensor_fusion` fuses two sensors, and
`gpuvision.simulation.sensors.masks` optimises masks.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 4.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line_parameters import PeakSelection
from gpuvision.simulation.errors.error_attribution import (
    ErrorAttribution,
    ReadingCategory,
    attribute_errors,
)
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.readings import GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure

Float64 = npt.NDArray[np.float64]


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
