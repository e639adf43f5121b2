"""``gpuvision scan --tolerance`` and ``--plan``: choose the line readout for a tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gpuvision.cli.arguments import echo, prints_report, progress_bar, quantities, write_report

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.workflows.scan_plan import ScanPlan


def make_plan(recording: Path, sensor: Sensor, tolerance: str, rate: float | None, device: Device | None) -> ScanPlan:
    """Plan a scan for the text of ``--tolerance``, with a progress bar."""
    from gpuvision.workflows.planning_scan import plan_scan

    (largest,) = quantities(tolerance, "--tolerance", "m")
    with progress_bar(f"planning {recording.name}") as progress:
        return plan_scan(recording, sensor, tolerance=largest, rate=rate, device=device, progress=progress)


def write_plan(
    recording: Path,
    sensor: Sensor,
    tolerance: str | None,
    rate: float | None,
    device: str | None,
    out: Path,
    as_json: Path | None,
    inputs: Sequence[str | Path],
    *,
    overwrite: bool,
) -> None:
    """Plan a scan, print the plan, and write its picture and report."""
    from gpuvision.host import Device
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.scan_plan import PLAN_FILE, PlanError, ScanPlanLimits, readout_table

    if tolerance is None:
        raise ValueError("--plan needs --tolerance, the largest error of the heights, such as 20um")
    outputs = Outputs("plan", inputs=inputs, overwrite=overwrite)
    outputs.claim_folder(out, (PLAN_FILE,))
    outputs.claim(as_json)
    try:
        plan = make_plan(recording, sensor, tolerance, rate, None if device is None else Device.named(device))
    except PlanError as refusal:
        echo(readout_table(refusal.trials, ScanPlanLimits()), err=True)
        raise
    plan.write(out, overwrite=overwrite)
    write_report(as_json, plan.to_dict(), outputs)
    echo(f"{plan.table()}\n{plan}\nlook at {out / PLAN_FILE}", err=prints_report(as_json))
