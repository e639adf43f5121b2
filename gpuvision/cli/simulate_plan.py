"""``gpuvision simulate --tolerance`` and ``--plan``: choose light paths and discretisations for a tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gpuvision.cli.arguments import progress_bar, quantities, reject_unused
from gpuvision.cli.plan_output import claim_plan, report_plan, show_refused

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.workflows.light_cache import SimulationTask
    from gpuvision.workflows.simulation_plan import SimulationPlan


def check_plan_options(tolerance: str | None, rate: float | None, *, only_plan: bool, **unused: object) -> None:
    """Check the options of a plan; ``unused`` are options that have no effect with ``--plan``.

    Raises
    ------
    ValueError
        ``--plan`` has no tolerance, an option has no effect, or the tolerance is no length above 0.
    """
    if only_plan:
        if tolerance is None:
            raise ValueError("--plan needs --tolerance, the largest error of the simulated range, such as 5um")
        reject_unused("with --plan", **unused)
    if tolerance is None:
        reject_unused("without --tolerance", rate=rate)
    elif length(tolerance) <= 0.0:
        raise ValueError(f"--tolerance is {tolerance!r}, expected a length above 0")


def length(tolerance: str) -> float:
    """Return the length of ``--tolerance`` [m]."""
    (found,) = quantities(tolerance, "--tolerance", "m")
    return found


def make_simulation_plan(
    task: SimulationTask, description: str, tolerance: str, rate: float | None, device: Device | None
) -> SimulationPlan:
    """Plan a task, with a progress bar."""
    from gpuvision.workflows.planning_simulation import plan_task

    with progress_bar(f"planning {description}") as progress, show_refused():
        return plan_task(task, tolerance=length(tolerance), rate=rate, device=device, progress=progress)


def planned_task(
    task: SimulationTask, description: str, tolerance: str, rate: float | None, device: Device | None
) -> tuple[SimulationTask, str]:
    """Return a task with the settings of a plan, and a line about them; a small task itself if there is no rate."""
    from gpuvision.workflows.planning_simulation import is_worth_planning

    if rate is None and not is_worth_planning(task):
        count = len(task.transports)
        return task, (
            f"plan: {count} profiles are computed in full, because planning would take longer; their error is unknown: "
            "--plan predicts it"
        )
    plan = make_simulation_plan(task, description, tolerance, rate, device)
    return plan.task, f"plan: {plan}"


def write_simulation_plan(
    task: SimulationTask,
    description: str,
    tolerance: str,
    rate: float | None,
    device: Device | None,
    out: Path,
    as_json: Path | None,
    inputs: Sequence[str | Path],
    *,
    overwrite: bool,
) -> None:
    """Plan a task, print the plan, and write its picture and report."""
    outputs = claim_plan(out, as_json, inputs, overwrite=overwrite)
    plan = make_simulation_plan(task, description, tolerance, rate, device)
    plan.write(out, title=task.sensor.name or "Plan", overwrite=overwrite)
    report_plan(plan, out, as_json, outputs)
