"""Plan of a scan: readouts that were tried, with predicted errors and times, and the chosen one with its stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from gpuvision.accuracy.plan import AccuracyLimits, AccuracyPlan
from gpuvision.accuracy.trial import millionths
from gpuvision.host import Plan
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.validation import finite
from gpuvision.workflows.plan_files import write_plan

_LEGEND = """errors of the heights in um; other: scatter that the noise does not explain
- loses too many samples, or its window is narrower than the line"""


@dataclass(frozen=True, kw_only=True)
class ScanPlanLimits(AccuracyLimits):
    """Limits of `plan_scan`; extends `gpuvision.accuracy.plan.AccuracyLimits`.

    Attributes
    ----------
    margin : float
        Least ratio of the tolerance to the predicted error, at least 1. Default 1.05: the error of 23 000 samples was
        up to 1.01 times the prediction (measured).
    max_lost : float
        Fraction of the samples that a readout may lose beyond the readout that loses fewest, 0 to 1. Default 0.01.
    """

    margin: float = 1.05
    max_lost: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        finite(self.max_lost, "ScanPlanLimits.max_lost", minimum=0.0, maximum=1.0)


class ReadoutTrial(NamedTuple):
    """Readout that was tried on the sample.

    Attributes
    ----------
    readout : LineReadout or PsdReadout
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

    readout: LineReadout | PsdReadout
    seconds: float
    error: float
    random: float
    phase: float
    systematic: float
    unexplained: float
    lost: float

    @property
    def name(self) -> str:
        """Method of a line readout with its window or filter length, and the precision if it is double."""
        precision = " double" if self.readout.precision == "double" else ""
        if isinstance(self.readout, PsdReadout):
            return f"psd{precision}"
        method, window = self.readout.method, self.readout.window
        size = {"fir": self.readout.fir_length, "windowed": window, "ml": window}.get(method)
        return f"{method}{'' if size is None else f' {size}'}{precision}"

    @property
    def error_parts(self) -> dict[str, float]:
        """Parts of the error by name [m]."""
        values = (self.random, self.phase, self.systematic, self.unexplained)
        return dict(zip(("random", "phase", "calibration", "unexplained"), values, strict=True))

    @property
    def legend(self) -> str:
        """Explanation of the columns."""
        return _LEGEND

    def cells(self) -> dict[str, str]:
        """Return the texts of a row of a table by the headings of their columns; the name is the first."""
        headings = ("us/frame", "error", "random", "phase", "calibr.", "other")
        numbers = map(millionths, (self.seconds, self.error, *self.error_parts.values()))
        return {"readout": self.name, **dict(zip(headings, numbers, strict=True)), "lost": f"{self.lost:.1%}"}

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""
        numbers = {name: getattr(self, name) for name in self._fields if name != "readout"}
        return {"readout": self.name, **numbers}


@dataclass(frozen=True, kw_only=True)
class ScanPlan(AccuracyPlan[ReadoutTrial]):
    """Plan of a scan. ``scan(recording, plan.sensor, ...)`` carries it out; ``str(plan)`` states it in one line.

    Attributes
    ----------
    chosen : ReadoutTrial
        Fastest readout that meets the tolerance.
    trials : tuple of ReadoutTrial
        All readouts that were tried, fastest first.
    tolerance : float
        Asked error of the heights [m].
    sensor : Sensor
        The sensor with the chosen readout, and with the estimated threshold if its file asks for one.
    rounding : float or None
        Root mean square difference between the heights of the chosen readout and of the same one in double precision,
        over the sample [m]; None on a device without doubles.
    stream : Plan or None
        Plan of the stream at the asked rate; None without a rate.
    limits : ScanPlanLimits
        Limits of the plan.
    """

    kind: ClassVar[str] = "readout"

    sensor: Sensor
    rounding: float | None
    stream: Plan | None
    limits: ScanPlanLimits

    @property
    def usable(self) -> list[ReadoutTrial]:
        """Readouts that may be chosen."""
        return usable_trials(self.trials, self.limits)

    def is_chosen(self, trial: ReadoutTrial) -> bool:
        """Return whether a readout is the chosen one, which may have another precision."""
        return trial.readout == replace(self.chosen.readout, precision=trial.readout.precision)

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
        write_plan(self, folder, error_of="the heights", title=self.sensor.name or "Plan", overwrite=overwrite)

    def sentences(self) -> list[str]:
        """Return error and time of the chosen readout, other tolerances, rounding, and the stream."""
        parts = super().sentences()
        if self.rounding is None:
            parts.append("rounding is not checked, because the device has no doubles")
        return parts if self.stream is None else [*parts, str(self.stream)]

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return super().to_dict() | {
            "rounding": self.rounding,
            "stream": None if self.stream is None else self.stream.to_dict(),
        }


def usable_trials(trials: Sequence[ReadoutTrial], limits: ScanPlanLimits) -> list[ReadoutTrial]:
    """Return the readouts with a predicted error that lose at most ``limits.max_lost`` more samples than the best."""
    known = [each for each in trials if each.error > 0.0]
    fewest = min((each.lost for each in known), default=0.0)
    return [each for each in known if each.lost <= fewest + limits.max_lost]
