"""``gpuvision simulate --tolerance`` and ``--plan``: choose light paths and discretisations for a tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gpuvision.cli.plan_output import planning, report_plan

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.light_cache import SimulationTask
    from gpuvision.workflows.simulation_plan import SimulationPlan


WHICH = ("", ", second sensor")
"""Words for the first and the second sensor."""


def planned_tasks(
    tasks: Sequence[SimulationTask], description: str, tolerance: float, rate: float | None, device: Device | None
) -> tuple[list[SimulationTask], list[str]]:
    """Return the tasks of one sensor or two with the settings of plans, and a line about each.

    Without a rate a small task stays as it is.
    """
    from gpuvision.workflows.planning_simulation import is_worth_planning

    planned, lines = [], []
    for number, task in enumerate(tasks):
        if rate is None and not is_worth_planning(task):
            planned.append(task)
            lines.append(
                f"plan: {len(task.transports)} profiles are computed in full, because planning would take longer; "
                "their error is unknown: --plan predicts it"
            )
            continue
        plan = _plan(task, f"{description}{WHICH[number]}", tolerance, rate, device)
        planned.append(plan.task)
        lines.append(f"plan: {plan}")
    return planned, lines


def write_simulation_plan(
    task: SimulationTask,
    description: str,
    tolerance: float,
    rate: float | None,
    device: Device | None,
    out: Path,
    as_json: Path | None,
    outputs: Outputs,
    overwrite: bool,
) -> None:
    """Plan a task, print the plan, and write its picture and report."""
    plan = _plan(task, description, tolerance, rate, device)
    plan.write(out, title=task.sensor.name or "Plan", overwrite=overwrite)
    report_plan(plan, out, as_json, outputs)


def _plan(
    task: SimulationTask, description: str, tolerance: float, rate: float | None, device: Device | None
) -> SimulationPlan:
    """Plan a task, with a progress bar."""
    from gpuvision.workflows.planning_simulation import plan_task

    with planning(description) as progress:
        return plan_task(task, tolerance=tolerance, rate=rate, device=device, progress=progress)
