"""Plan of a simulation: light paths and discretisations that were tried, with errors and times, and the chosen ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from gpuvision.accuracy.plan import AccuracyLimits, AccuracyPlan
from gpuvision.accuracy.trial import millionths
from gpuvision.validation import finite, integer
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.plan_files import write_plan
from gpuvision.workflows.simulation_errors import ErrorPart
from gpuvision.workflows.simulation_sample import SimulationSettings

_LEGEND = """errors of the range in um; change: from the reference, estimate; pairs: bound of clustered pairs;
finest: error of the reference, estimate; signal: change of the signal; moved: samples that read another line;
profiles: on which the light was tried
- is not chosen: it reads other lines than the reference"""


@dataclass(frozen=True, kw_only=True)
class SimulationPlanLimits(AccuracyLimits):
    """Limits of `gpuvision.workflows.planning_simulation.plan_simulation`; extends `AccuracyLimits`.

    Attributes
    ----------
    max_moved : float
        Largest fraction of the samples that may read another line than with the reference, 0 to 1. Chosen. Default
        0.005.
    profiles : int
        Number of profiles on which settings are tried, 2 or more. Default 6.
    checked : int
        Number of other profiles on which the chosen setting is tried, and faster settings that may meet the tolerance,
        1 or more. Default 48: a ray beside a lit line, or a sheet that grazes an edge, makes a large error in few
        profiles. With 4 and with 12 such profiles were missed (true errors of 3.3 and 1.7 tolerances).
    added : int
        Number of further profiles on which settings are tried before the plan refuses, if their error is undecided, 0
        or more. Default 96: twice as many again. Chosen: if few profiles of a large part have a large error, its limits
        are far apart.
    surveyed : int
        Number of profiles of a part with more than ``profiles`` and ``checked`` profiles whose coarsest light shows
        where errors are large, so that more of these profiles are tried, 0 or more; 0: evenly spaced ones are tried.
        Default 200 (chosen): places of 1/200 of the part or more are met.
    """

    max_moved: float = 0.005
    profiles: int = 6
    checked: int = 48
    added: int = 96
    surveyed: int = 200

    def __post_init__(self) -> None:
        super().__post_init__()
        finite(self.max_moved, "SimulationPlanLimits.max_moved", minimum=0.0, maximum=1.0)
        integer(self.profiles, "SimulationPlanLimits.profiles", minimum=2)
        integer(self.checked, "SimulationPlanLimits.checked", minimum=1)
        integer(self.added, "SimulationPlanLimits.added", minimum=0)
        integer(self.surveyed, "SimulationPlanLimits.surveyed", minimum=0)


class SettingsTrial(NamedTuple):
    """Settings that were tried on a sample of the profiles.

    Attributes
    ----------
    settings : SimulationSettings
        Light paths and discretisations.
    seconds : float
        Time of a profile, with its share of the preparation [s].
    error : float
        Error of the range [m] by ``change``, ``pairs`` and ``finest``: the sum of bounds, and the root of the sum of
        squares of estimates. The part of the rays in ``change`` and in ``finest`` adds up before it is squared.
    least : float
        The same with the lower limits of ``change`` and ``finest`` [m]: more profiles may show that the error is as
        small as this.
    change : float
        Root mean square difference between the readings and those of the reference, with all pairs [m]. It is an upper
        limit: the mean square is raised by two standard errors. The reference has the finest options, with more rays
        per bin of diffuse light.
    pairs : float
        Proven bound of the error by clustered and omitted pairs [m]; only PSDs have such pairs.
    finest : float
        Estimated error of the reference [m].
    worst : float
        Largest difference from the reference [m].
    signal : float
        Root mean square difference of the signal, as a fraction of the signal.
    moved : float
        Fraction of the samples that read another line than with the reference, or none.
    least_moved : float
        Lower limit of that fraction, twice its standard error below it.
    profiles : int
        Number of profiles on which the settings were tried.
    """

    settings: SimulationSettings
    seconds: float
    error: float
    least: float
    change: float
    pairs: float
    finest: float
    worst: float
    signal: float
    moved: float
    least_moved: float
    profiles: int

    @property
    def name(self) -> str:
        """Light paths, with the settings that matter to them."""
        return self.settings.name

    @property
    def error_parts(self) -> dict[str, float]:
        """Parts of the error by name [m]."""
        return {"change": self.change, "pairs": self.pairs, "finest": self.finest}

    @property
    def legend(self) -> str:
        """Explanation of the columns."""
        return _LEGEND

    def cells(self) -> dict[str, str]:
        """Return the texts of a row of a table by the headings of their columns; the name is the first."""
        numbers = {"us/prof.": self.seconds, "error": self.error, **self.error_parts, "worst": self.worst}
        texts = {name: millionths(each) for name, each in numbers.items()}
        shares = {"signal": f"{self.signal:.2%}", "moved": f"{self.moved:.1%}"}
        return {"light": self.name, **texts, **shares, "profiles": f"{self.profiles}"}

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""
        numbers = {name: getattr(self, name) for name in self._fields if name != "settings"}
        return {"light": self.name, **asdict(self.settings), **numbers}


@dataclass(frozen=True, kw_only=True)
class SimulationPlan(AccuracyPlan[SettingsTrial]):
    """Plan of a simulation. ``simulate(plan.task, folder)`` carries it out; ``str(plan)`` states it in one line.

    Attributes
    ----------
    chosen : SettingsTrial
        Fastest settings that meet the tolerance.
    trials : tuple of SettingsTrial
        The settings that were tried and that no other one beats in time and error, fastest first.
    tolerance : float
        Asked error of the range [m].
    task : SimulationTask
        The task with the chosen settings.
    finest : dict of str to ErrorPart
        Parts of the error of the reference.
    seconds : float
        Time that the planning took [s].
    limits : SimulationPlanLimits
        Limits of the plan.
    """

    kind: ClassVar[str] = "setting"
    unit: ClassVar[str] = "profile"

    task: SimulationTask
    finest: dict[str, ErrorPart]
    seconds: float
    limits: SimulationPlanLimits

    @property
    def usable(self) -> list[SettingsTrial]:
        """Settings that may be chosen."""
        return usable_settings(self.trials, self.limits)

    def write(self, folder: str | Path, *, title: str = "Plan", overwrite: bool = False) -> None:
        """Write ``plan.png``, the predicted errors over the times, into a folder, which is created if it is missing.

        Parameters
        ----------
        folder : str or Path
            Output folder.
        title : str
            Title of the picture. Default ``"Plan"``.
        overwrite : bool
            Whether a file may be replaced that no earlier plan wrote. Default False.

        Raises
        ------
        FileExistsError
            The file exists, and is not an unchanged output of an earlier plan.
        OSError
            The folder cannot be written.
        """
        write_plan(self, folder, error_of="the range", title=title, overwrite=overwrite)

    def sentences(self) -> list[str]:
        """Return error and time of the chosen settings, other tolerances, the profiles, and the largest part."""
        parts = super().sentences()
        parts.append(f"tried on {self.chosen.profiles} profiles")
        name = largest_part(self.chosen, self.finest)
        return [*parts, f"the largest part of the error is {name}"]

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        return super().to_dict() | {
            "finest": {name: each._asdict() for name, each in self.finest.items()},
            "planning_seconds": self.seconds,
        }


def largest_part(trial: SettingsTrial, finest: dict[str, ErrorPart]) -> str:
    """Return the largest part of the error of a trial in words, such as "nodes of the reference"."""
    parts = {"the difference from the reference": trial.change, "the bound of clustered pairs": trial.pairs}
    parts |= {f"{name} of the reference": each.error for name, each in finest.items()}
    return max(parts, key=lambda name: parts[name])


def usable_settings(trials: Sequence[SettingsTrial], limits: SimulationPlanLimits) -> list[SettingsTrial]:
    """Return the settings that read the lines of the reference."""
    return [each for each in trials if each.error > 0.0 and each.moved <= limits.max_moved]
