"""Measured speed-accuracy curves: settings of an operation, errors against truth, times, and the Pareto front."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.profiling.rounds import median_interval, take_turns

OPERATIONS = (
    "psd",
    "line",
    "triangulation",
    "undistort_image",
    "undistort_points",
    "ruler",
    "blob",
    "line_fit",
    "pose",
    "occluded_irradiance",
    "line_irradiance",
    "reflectance",
    "rays",
    "range_image",
    "merge_heights",
    "deposits",
    "board_image",
    "board_pose",
    "feature_pose",
    "field_pose",
)
"""Operations with curves: names of the modules of this package."""


class Errors:
    """Deviations from truth, summarised.

    Parameters
    ----------
    deviation : (n,) float64
        Result minus truth; of points and poses the distance, see `distance`. NaN where the operation gave no value
        (flagged).

    Attributes
    ----------
    rms, p95, largest : float
        Root mean square, 95th percentile and largest absolute deviation of the samples with a value.
    lost : float
        Fraction of the samples without a value.
    """

    def __init__(self, deviation: npt.ArrayLike) -> None:
        every = np.asarray(deviation, np.float64).ravel()
        size = np.abs(every[np.isfinite(every)])
        self.lost = 1.0 - size.size / every.size
        found = size.size > 0
        self.rms = math.sqrt(float(np.mean(size**2))) if found else math.nan
        self.p95 = float(np.quantile(size, 0.95)) if found else math.nan
        self.largest = float(size.max()) if found else math.nan


def distance(found: npt.ArrayLike, true: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the Euclidean distances (n,) of points (n, d)."""
    return np.asarray(np.linalg.norm(np.subtract(found, true, dtype=np.float64), axis=-1))


@dataclass(frozen=True)
class Setting:
    """Setting of an operation on data with known truth.

    Attributes
    ----------
    operation : str
        Name of the operation, as in `OPERATIONS`.
    data : str
        Description of the data: settings are compared on equal data only.
    parameters : mapping
        Values that a user chooses, by their names in the operation.
    run : callable
        Function that does the work and waits until it is finished.
    errors : Errors
        Deviations of the result from truth.
    unit : str
        Unit of the deviations; empty for relative ones.
    """

    operation: str
    data: str
    parameters: Mapping[str, Any]
    run: Callable[[], object]
    errors: Errors
    unit: str


@dataclass(frozen=True)
class Point:
    """Point of a measured curve.

    Attributes
    ----------
    operation, data, parameters, unit
        See `Setting`.
    device : str
        Label of the device.
    seconds : float
        Median time [s].
    seconds_low, seconds_high : float
        Confidence interval of the median, see `median_interval`.
    rms, p95, largest, lost : float
        See `Errors`.
    best : bool
        Whether no other setting on the same data and device is better in time, rms or lost and as good in the others.
    """

    operation: str
    data: str
    parameters: Mapping[str, Any]
    device: str
    seconds: float
    seconds_low: float
    seconds_high: float
    unit: str
    rms: float
    p95: float
    largest: float
    lost: float
    best: bool

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name."""
        return asdict(self) | {"parameters": dict(self.parameters)}


def measure_curves(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    seconds: float = 0.3,
    progress: Callable[[str], None] = lambda line: None,
) -> list[Point]:
    """Measure the settings of the given operations on the given devices.

    Parameters
    ----------
    operations : sequence of str
        Names in `OPERATIONS`.
    devices : sequence of Device
        Devices to measure on.
    seconds : float
        Approximate time to measure a setting [s].
    progress : callable
        Function that is called with lines of text about the progress.

    Raises
    ------
    ValueError
        An operation has no curves.
    """
    unknown = next((each for each in operations if each not in OPERATIONS), None)
    if unknown is not None:
        raise ValueError(f"no curves of {unknown!r}; expected some of {', '.join(OPERATIONS)}")
    points: list[Point] = []
    for operation in operations:
        for device in devices:
            progress(f"curves of {operation} on {device.label}")
            points += _measure(operation, device, seconds)
    return points


def _measure(operation: str, device: Device, seconds: float) -> list[Point]:
    """Measure the settings on the same data interleaved."""
    module = importlib.import_module(f"gpuvision.profiling.curves.{operation}")
    made: Iterator[Setting] = module.settings(device)
    by_data: dict[str, list[Setting]] = {}
    for setting in made:
        by_data.setdefault(setting.data, []).append(setting)
    points: list[Point] = []
    for settings in by_data.values():
        calls = {number: each.run for number, each in enumerate(settings)}
        times = take_turns(calls, seconds * len(settings), always=0)
        durations = [times[number][np.isfinite(times[number])] for number in calls]
        medians = [float(np.median(each)) for each in durations]
        best = pareto_front([(t, s.errors.rms, s.errors.lost) for t, s in zip(medians, settings, strict=True)])
        points += map(_point, settings, durations, best, [device.label] * len(settings))
    return points


def _point(setting: Setting, durations: npt.NDArray[np.float64], best: bool, device: str) -> Point:
    interval = median_interval(durations)
    return Point(
        operation=setting.operation,
        data=setting.data,
        parameters=setting.parameters,
        device=device,
        seconds=float(np.median(durations)),
        seconds_low=interval.low,
        seconds_high=interval.high,
        unit=setting.unit,
        rms=setting.errors.rms,
        p95=setting.errors.p95,
        largest=setting.errors.largest,
        lost=setting.errors.lost,
        best=best,
    )


def pareto_front(settings: Sequence[tuple[float, ...]]) -> list[bool]:
    """Return for each setting whether no other one is better in one of its numbers and as good in the others.

    Smaller numbers are better. A setting with a NaN is never on the front: it gave no value.
    """
    return [
        not any(map(math.isnan, each))
        and not any(other != each and all(a <= b for a, b in zip(other, each, strict=True)) for other in settings)
        for each in settings
    ]
