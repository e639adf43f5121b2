"""Files of a plan: its picture, and others of its job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from gpuvision.accuracy.plan import AccuracyPlan
from gpuvision.host.outputs import Outputs
from gpuvision.plots.plan import PlannedSetting, draw_plan

PLAN_FILE = "plan.png"
"""Name of the picture of a plan."""


def write_plan(
    plan: AccuracyPlan[Any],
    folder: str | Path,
    *,
    error_of: str,
    title: str,
    overwrite: bool,
    more: Mapping[str, Callable[[Path], object]] = MappingProxyType({}),
) -> None:
    """Write ``plan.png``, the predicted errors over the times, into a folder, which is created if it is missing.

    Parameters
    ----------
    plan : AccuracyPlan
        Plan to draw.
    folder : str or Path
        Output folder.
    error_of : str
        Result whose error is planned.
    title : str
        Title of the picture.
    overwrite : bool
        Whether a file may be replaced that no earlier plan wrote.
    more : mapping of str to callable
        Functions that write other files, by the name of the file. Default: none.

    Raises
    ------
    FileExistsError
        The file exists, and is not an unchanged output of an earlier plan.
    OSError
        The folder cannot be written.
    """
    settings = [PlannedSetting(each.name, each.seconds, each.error, plan.is_chosen(each)) for each in plan.usable]
    with Outputs("plan", overwrite=overwrite).folder(folder) as inside:
        draw_plan(inside / PLAN_FILE, settings, plan.tolerance, error_of=error_of, unit=plan.unit, title=title)
        for name, write in more.items():
            write(inside / name)
