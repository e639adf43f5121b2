"""``gpuvision place --tolerance`` and ``--plan``: choose the settings of a machine for a tolerance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpuvision.cli.arguments import echo, prints_report, progress_bar, quantities
from gpuvision.cli.plan_output import claim_plan, report_plan, show_refused

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs
    from gpuvision.matching.artwork.artwork import Artwork
    from gpuvision.servoing.placement.machine import Machine
    from gpuvision.workflows.placement_plan import PlacementSettingsPlan

_MACHINE_FILE = "machine.toml"


def claim_placement_plan(
    tolerance: str | None, inputs: Sequence[str | Path], out: Path, as_json: Path | None, *, overwrite: bool
) -> Outputs:
    """Check ``--plan``: it needs a tolerance, and its files may be written.

    Raises
    ------
    ValueError
        There is no tolerance.
    OSError
        A file cannot be written, is an input, or exists and is no output of a plan.
    """
    if tolerance is None:
        raise ValueError("--plan needs --tolerance, the largest error of the placement, such as 5um")
    return claim_plan(out, as_json, inputs, overwrite=overwrite, more=(_MACHINE_FILE,))


def make_placement_plan(
    artwork: Artwork,
    target: tuple[float, ...],
    machine: Machine,
    tolerance: str,
    part_radius: str | None,
    options: Mapping[str, Any],
) -> PlacementSettingsPlan:
    """Plan placements for the texts of ``--tolerance`` and ``--part-radius``, with a progress bar."""
    from gpuvision.workflows.planning_placement import plan_placement_settings

    (largest,) = quantities(tolerance, "--tolerance", "m")
    radius = None if part_radius is None else quantities(part_radius, "--part-radius", "m")[0]
    with progress_bar("planning") as progress, show_refused():
        return plan_placement_settings(
            artwork, target, machine, tolerance=largest, part_radius=radius, progress=progress, **options
        )


def write_placement_plan(
    plan: PlacementSettingsPlan, machine: str, out: Path, as_json: Path | None, outputs: Outputs, *, overwrite: bool
) -> None:
    """Print a plan, and write its picture, the machine file with its settings, and its report."""
    from gpuvision.formats.machine_file import write_settings

    chosen = plan.chosen
    more = {_MACHINE_FILE: lambda path: write_settings(machine, chosen.machine, path)}
    plan.write(out, title=f"{Path(machine).stem}, {chosen.rulers} rulers", overwrite=overwrite, more=more)
    report_plan(plan, out, as_json, outputs)
    given = f"--machine {out / _MACHINE_FILE} --budget {chosen.budget}"
    echo(f"next: give {given} instead of --machine and --tolerance", err=prints_report(as_json))
