"""Plan of a scan: readouts that were tried, with predicted errors and times, and the chosen one with its stream."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from gpuvision.host import GpuVisionError, Plan
from gpuvision.host.outputs import Outputs
from gpuvision.plots.plan import PlannedSetting, draw_plan
from gpuvision.ranging.line import LineReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.validation import finite

_SMALL_GAIN = (
    0.95  # a smaller gain in time or error is no reason to change a setting. Chosen: the scatter of the timing
)
_LEGEND = """errors of the heights in um; other: scatter that the noise does not explain
- loses too many samples, or its window is narrower than the line"""
PLAN_FILE = "plan.png"
"""Name of the file that `ScanPlan.write` writes."""


@dataclass(frozen=True, kw_only=True)
class ScanPlanLimits:
    """Limits of `plan_scan`.

    Attributes
    ----------
    margin : float
        Least ratio of the tolerance to the predicted error, at least 1. Chosen: above the scatter of the error of a
        sample about its prediction. Default 1.1.
    max_lost : float
        Fraction of the samples that a readout may lose beyond the readout that loses fewest, 0 to 1. Default 0.01.
    rate_margin : float
        Least ratio of the measured service rate to the frame rate, at least 1. Default 1.25.
    """

    margin: float = 1.1
    max_lost: float = 0.01
    rate_margin: float = 1.25

    def __post_init__(self) -> None:
        finite(self.margin, "ScanPlanLimits.margin", minimum=1.0)
        finite(self.max_lost, "ScanPlanLimits.max_lost", minimum=0.0, maximum=1.0)
        finite(self.rate_margin, "ScanPlanLimits.rate_margin", minimum=1.0)


class ReadoutTrial(NamedTuple):
    """Line readout that was tried on the sample.

    Attributes
    ----------
    readout : LineReadout
        The readout.
    seconds : float
        Median time of the kernel for a frame [s].
    error : float
        Predicted error of the heights [m]: root mean square over the samples of ``random``, ``phase``, ``systematic``
        and ``unexplained`` together. NaN without a sample with a line, and for a window narrower than the line.
    random, phase, systematic : float
        Its parts [m], see `gpuvision.workflows.scan_errors.ScanErrors`; 0 where unknown.
    unexplained : float
        Scatter along the profiles that the noise does not explain, beyond that of the other readouts [m].
    lost : float
        Fraction of the samples without a point.
    """

    readout: LineReadout
    seconds: float
    error: float
    random: float
    phase: float
    systematic: float
    unexplained: float
    lost: float

    @property
    def name(self) -> str:
        """Method with its window or filter length, and the precision if it is double."""
        readout = self.readout
        size = {"fir": f" {readout.fir_length}", "windowed": f" {readout.window}", "ml": f" {readout.window}"}
        return f"{readout.method}{size.get(readout.method, '')}{' double' if readout.precision == 'double' else ''}"

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""
        numbers = {name: getattr(self, name) for name in self._fields if name != "readout"}
        return {"readout": self.name, **numbers}


class PlanError(GpuVisionError):
    """No readout meets tolerance and rate; the message gives the nearest feasible values.

    Attributes
    ----------
    trials : tuple of ReadoutTrial
        The readouts that were tried, fastest first.
    """

    def __init__(self, message: str, trials: Sequence[ReadoutTrial]) -> None:
        super().__init__(message)
        self.trials = tuple(trials)


@dataclass(frozen=True, kw_only=True)
class ScanPlan:
    """Plan of a scan. ``scan(recording, plan.sensor, ...)`` carries it out; ``str(plan)`` states it in one line.

    Attributes
    ----------
    sensor : Sensor
        The sensor with the chosen readout, and with the estimated threshold if its file asks for one.
    chosen : ReadoutTrial
        Fastest readout that meets the tolerance.
    trials : tuple of ReadoutTrial
        All readouts that were tried, fastest first.
    tolerance : float
        Asked error of the heights [m].
    rounding : float or None
        Root mean square difference between the heights of the chosen readout and of the same one in double precision,
        over the sample [m]; None on a device without doubles.
    stream : Plan or None
        Plan of the stream at the asked rate; None without a rate.
    limits : ScanPlanLimits
        Limits of the plan.
    """

    sensor: Sensor
    chosen: ReadoutTrial
    trials: tuple[ReadoutTrial, ...]
    tolerance: float
    rounding: float | None
    stream: Plan | None
    limits: ScanPlanLimits

    @property
    def faster(self) -> ReadoutTrial | None:
        """Most accurate readout that is faster by 5 % or more: what a larger tolerance allows. None if none is."""
        quicker = [each for each in self._usable() if each.seconds < _SMALL_GAIN * self.chosen.seconds]
        return min(quicker, key=lambda each: each.error, default=None)

    @property
    def finer(self) -> ReadoutTrial | None:
        """Fastest readout that is more accurate by 5 % or more: what a longer time allows. None if none is."""
        finer = [each for each in self._usable() if each.error < _SMALL_GAIN * self.chosen.error]
        return min(finer, key=lambda each: each.seconds, default=None)

    def table(self) -> str:
        """Return the tried readouts as a table, fastest first; a star marks the chosen one."""
        return readout_table(self.trials, self.limits, self.chosen)

    def write(self, folder: str | Path, *, overwrite: bool = False) -> None:
        """Write ``plan.png``, the predicted errors over the times, into a folder, which is created if it is missing.

        Parameters
        ----------
        folder : str or Path
            Output folder.
        overwrite : bool
            Whether a file may be replaced that no earlier plan wrote. Default False.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier plan.
        OSError
            The folder cannot be written.
        """
        settings = [
            PlannedSetting(each.name, each.seconds, each.error, _same(each, self.chosen)) for each in self._usable()
        ]
        with Outputs("plan", overwrite=overwrite).folder(folder) as inside:
            draw_plan(inside / PLAN_FILE, settings, self.tolerance, title=self.sensor.name or "Plan")

    def _usable(self) -> list[ReadoutTrial]:
        return usable_trials(self.trials, self.limits)

    def __str__(self) -> str:
        parts = [
            f"{self.chosen.name}: predicted error {micrometres(self.chosen.error)} of {micrometres(self.tolerance)}, "
            f"{_millionths(self.chosen.seconds)} us per frame"
        ]
        if self.faster is None:
            parts.append("no usable readout is faster")
        else:
            wanted = at_least(self.limits.margin * self.faster.error)
            parts.append(f"a tolerance of {wanted} would allow {self._relative('faster')}")
        if self.finer is not None:
            parts.append(f"{at_least(self.limits.margin * self.finer.error)} takes {self._relative('finer')}")
        if self.rounding is None:
            parts.append("rounding is not checked, because the device has no doubles")
        if self.stream is not None:
            parts.append(str(self.stream))
        return "; ".join(parts)

    def _relative(self, name: str) -> str:
        other: ReadoutTrial = getattr(self, name)
        return f"{other.name} at {other.seconds / self.chosen.seconds:.2g} times the time"

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return {
            "chosen": self.chosen.to_dict(),
            "tolerance": self.tolerance,
            "rounding": self.rounding,
            "faster": None if self.faster is None else self.faster.to_dict(),
            "finer": None if self.finer is None else self.finer.to_dict(),
            "stream": None if self.stream is None else self.stream.to_dict(),
            "trials": [each.to_dict() for each in self.trials],
            "limits": asdict(self.limits),
        }


def usable_trials(trials: Sequence[ReadoutTrial], limits: ScanPlanLimits) -> list[ReadoutTrial]:
    """Return the readouts with a predicted error that lose at most ``limits.max_lost`` more samples than the best."""
    known = [each for each in trials if each.error > 0.0]
    fewest = min((each.lost for each in known), default=0.0)
    return [each for each in known if each.lost <= fewest + limits.max_lost]


def readout_table(trials: Sequence[ReadoutTrial], limits: ScanPlanLimits, chosen: ReadoutTrial | None = None) -> str:
    """Return readouts with their times and errors as a table; a star marks the chosen one."""
    lines = [
        f"  {'readout':<16}{'us/frame':>9}{'error':>9}{'random':>9}{'phase':>9}{'calibr.':>9}{'other':>9}{'lost':>8}"
    ]
    usable = usable_trials(trials, limits)
    for each in trials:
        numbers = (each.seconds, each.error, each.random, each.phase, each.systematic, each.unexplained)
        mark = "*" if chosen is not None and _same(each, chosen) else " " if each in usable else "-"
        lines.append(f"{mark} {each.name:<16}{''.join(f'{_millionths(one):>9}' for one in numbers)}{each.lost:8.1%}")
    return "\n".join([*lines, _LEGEND])


def at_least(length: float) -> str:
    """Return a length [m] in micrometres, rounded up: a tolerance that the length meets."""
    step = 10.0 ** (math.floor(math.log10(1e6 * length)) - 2)
    return f"{math.ceil(1e6 * length / step * (1.0 - 1e-12)) * step:.6g} um"


def micrometres(length: float) -> str:
    """Return a length [m] in micrometres, with three digits or in full."""
    return f"{_millionths(length)} um"


def _millionths(value: float) -> str:
    scaled = 1e6 * value
    return f"{scaled:.0f}" if scaled >= 1000.0 else f"{scaled:.3g}"


def _same(trial: ReadoutTrial, chosen: ReadoutTrial) -> bool:
    """Return whether a readout is the chosen one, which may have another precision."""
    return trial.readout == replace(chosen.readout, precision=trial.readout.precision)
