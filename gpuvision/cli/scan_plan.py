"""``gpuvision scan --tolerance`` and ``--plan``: choose the line readout for a tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gpuvision.cli.arguments import progress_bar, quantities
from gpuvision.cli.plan_output import claim_plan, report_plan, show_refused

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

    if tolerance is None:
        raise ValueError("--plan needs --tolerance, the largest error of the heights, such as 20um")
    outputs = claim_plan(out, as_json, inputs, overwrite=overwrite)
    with show_refused():
        plan = make_plan(recording, sensor, tolerance, rate, None if device is None else Device.named(device))
    plan.write(out, overwrite=overwrite)
    report_plan(plan, out, as_json, outputs)
