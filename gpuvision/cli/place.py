"""``gpuvision place``: simulate placements of a part on a circuit board with the camera in the loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    LayerNames,
    Overwrite,
    ReportFile,
    claim_outputs,
    command_line,
    device_of,
    echo,
    echo_warnings,
    layers_of,
    length_of,
    named_path,
    prints_report,
    progress_bar,
    quantities,
    reject_unused,
    write_report,
)
from gpuvision.cli.plan_output import claim_plan, planned_tolerance, planning, report_plan
from gpuvision.cli.select import Side

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs
    from gpuvision.matching.artwork.artwork import Artwork
    from gpuvision.servoing.placement.machine import Machine
    from gpuvision.workflows.placement_cell import Repeatability
    from gpuvision.workflows.placement_plan import PlacementSettingsPlan
    from gpuvision.workflows.placing import PlacementResult

_BUDGET = 60  # number of rulers
_COUNT = 20  # number of placements
_LARGEST_BOARD = 1.0  # largest coordinate on a board [m] (chosen: panels are smaller)
_FILES = ("report.json", "placements.png", "features.png", "repeatability.png")
_MACHINE_FILE = "machine.toml"

Gerbers = Annotated[
    Path,
    typer.Argument(metavar="GERBERS", parser=named_path, help="Folder or ZIP of Gerber and Excellon files."),
]
MachineFile = Annotated[
    str,
    typer.Option(metavar="FILE.toml", help="Machine file, or the name of a machine in the package: look_while_place."),
]
Target = Annotated[
    str,
    typer.Option(metavar="X,Y,THETA", help="Place of the part on the board and its angle, such as 12mm,8mm,90deg."),
]
FrameRate = Annotated[
    float | None, typer.Option(min=1.0, max=1e7, help="Frames per second. Default: the value in the machine file.")
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Largest error of the placement, root mean square, such as 5um: choose camera window, observer, gain and "
        "tolerance of the release, the fastest that meet it.",
    ),
]
PlacementRate = Annotated[
    float | None, typer.Option(help="With --tolerance: placements per second that the plan must keep up with.")
]
PartRadius = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="With --tolerance: distance from the nozzle at which the error counts, such as 2mm. Default: the "
        "tolerances of the machine, position over angle.",
    ),
]
TimeVision = Annotated[
    bool,
    typer.Option(
        "--time-vision",
        help="With --tolerance: measure the time of the vision on the device, instead of the value in the machine "
        "file, for several numbers of calipers (rulers) up to --budget.",
    ),
]
OnlyPlan = Annotated[
    bool,
    typer.Option(
        "--plan",
        help="With --tolerance: only print the settings that were tried with their predicted errors and times, and "
        "write plan.png and machine.toml to --out. No other placements.",
    ),
]
Results = Annotated[
    Path,
    typer.Option(
        metavar="DIR",
        parser=named_path,
        help="Folder for report.json and the pictures placements.png, features.png, repeatability.png.",
    ),
]


def place(
    gerbers: Gerbers,
    machine: MachineFile,
    at: Target,
    out: Results,
    frame_rate: FrameRate = None,
    count: Annotated[
        int | None, typer.Option(min=1, max=10_000, help=f"Number of placements. Default: {_COUNT}.")
    ] = None,
    budget: Annotated[int, typer.Option(min=3, max=1000, help="Number of calipers (rulers).")] = _BUDGET,
    seed: Annotated[
        int | None, typer.Option(min=0, max=(1 << 32) - 1, help="Seed of all random numbers. Default: 0.")
    ] = None,
    side: Annotated[Side, typer.Option(help="Side of the board on which parts are placed.")] = Side.top,
    layers: LayerNames = None,
    tolerance: Tolerance = None,
    rate: PlacementRate = None,
    part_radius: PartRadius = None,
    time_vision: TimeVision = False,
    only_plan: OnlyPlan = False,
    as_json: ReportFile = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate placements of a part: the camera of the head steers the nozzle to its place on a rendered board.

    Every frame is rendered, measured by calipers (rulers), and answered by the controller after the delay of the
    machine. The report has the error at the release and its prediction, and the number of frames in which the true
    error settles, with its value by theory. The machine file chooses observer, controller and release rule.
    """
    from gpuvision.formats.machine_file import named_files, read_machine
    from gpuvision.workflows.placement_cell import measure_repeatability
    from gpuvision.workflows.placing import simulate_placements

    target = _target(at)
    largest = planned_tolerance(tolerance, "the placement, such as 5um", only_plan=only_plan)
    if largest is None:
        reject_unused("without --tolerance", rate=rate, part_radius=part_radius, time_vision=time_vision)
    inputs: list[str | Path] = [gerbers, machine, *named_files(machine)]
    if only_plan:
        reject_unused("with --plan", count=count, seed=seed)
        outputs = claim_plan(out, as_json, inputs, overwrite=overwrite, more=(_MACHINE_FILE,))
    else:
        outputs = claim_outputs("place", inputs, as_json, (out, _FILES), overwrite=overwrite)
    described = read_machine(machine, rate=frame_rate)
    artwork = _artwork(gerbers, side, layers, described)
    chosen = device_of(device)
    if largest is not None:
        radius = length_of(part_radius, "--part-radius")
        given = {"rate": rate, "part_radius": radius, "budget": budget, "times_vision": time_vision}
        plan = _plan(artwork, target, described, f"placements at {at}", tolerance=largest, device=chosen, **given)
        if only_plan:
            _write_plan(plan, machine, out, as_json, outputs, overwrite=overwrite)
            return
        echo(f"plan: {plan}", err=prints_report(as_json))
        described, budget = plan.chosen.machine, plan.chosen.budget
    count, seed = _COUNT if count is None else count, 0 if seed is None else seed
    how = {"count": count, "budget": budget, "seed": seed}
    with progress_bar("placing") as progress:
        result = simulate_placements(artwork, target, described, device=chosen, progress=progress, **how)
    resting = measure_repeatability(artwork, result.machine, result.plan, seed=seed, device=chosen)
    _write(artwork, result, resting, out, as_json, outputs)


def _target(text: str) -> tuple[float, ...]:
    """Parse ``--at``: x, y [m] and angle [rad]."""
    target = quantities(text, "--at", "m,m,rad")
    if max(abs(target[0]), abs(target[1])) > _LARGEST_BOARD:
        raise ValueError(f"--at is {text!r}, expected at most {_LARGEST_BOARD:g} m; numbers need units: 9mm,9mm,90deg")
    return target


def _artwork(gerbers: Path, side: Side, layers: list[str] | None, machine: Machine) -> Artwork:
    """Read the side of the board, with the clearance that the camera of the machine needs; print the warnings."""
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.features.feature_set import edge_clearance
    from gpuvision.servoing.placement.plan import placement_imaging

    clearance = edge_clearance(placement_imaging(machine))
    artwork = read_artwork(gerbers, side=side.value, layers=layers_of(layers), clearance=clearance)
    echo_warnings(artwork.warnings, err=True)
    return artwork


def _plan(
    artwork: Artwork, target: tuple[float, ...], machine: Machine, description: str, **given: Any
) -> PlacementSettingsPlan:
    """Choose the settings that meet a tolerance, with a progress bar."""
    from gpuvision.workflows.planning_placement import plan_placement_settings

    with planning(description) as progress:
        return plan_placement_settings(artwork, target, machine, progress=progress, **given)


def _write(
    artwork: Artwork,
    result: PlacementResult,
    resting: Repeatability,
    out: Path,
    as_json: Path | None,
    outputs: Outputs,
) -> None:
    """Write report and pictures of placements, and print the summary."""
    from gpuvision.formats.json import json_tree, report_text
    from gpuvision.host.files import write_text_atomic

    report = result.report() | {"repeatability": resting.report()}
    write_report(as_json, report, outputs)
    with outputs.folder(out) as inside:
        write_text_atomic(inside / "report.json", report_text(json_tree(report)))
        _draw(inside, artwork, result, resting)
    echo(f"{result.summary()}\nlook at {out / 'placements.png'} and {out / 'report.json'}", err=prints_report(as_json))


def _write_plan(
    plan: PlacementSettingsPlan, machine: str, out: Path, as_json: Path | None, outputs: Outputs, *, overwrite: bool
) -> None:
    """Print a plan, and write its picture, the machine file with its settings, and its report."""
    from gpuvision.formats.machine_file import write_settings

    chosen = plan.chosen
    more = {_MACHINE_FILE: lambda path: write_settings(machine, chosen.machine, path)}
    plan.write(out, title=f"{Path(machine).stem}, {chosen.rulers} rulers", overwrite=overwrite, more=more)
    report_plan(plan, out, as_json, outputs)
    given = command_line("--machine", out / _MACHINE_FILE, "--budget", chosen.budget)
    echo(f"next: give {given} instead of --machine and --tolerance", err=prints_report(as_json))


def _draw(folder: Path, artwork: Artwork, result: PlacementResult, resting: Repeatability) -> None:
    """Write the pictures of placements."""
    from gpuvision.plots.board import draw_features
    from gpuvision.plots.placement import draw_placements, draw_repeatability

    machine, features = result.machine, result.plan.features
    view = machine.camera.view(result.plan.camera_pose)
    draw_features(folder / "features.png", artwork, features, features.region, view=view, target=result.plan.target[:2])
    draw_placements(
        folder / "placements.png",
        period=machine.period,
        motion=result.motion,
        response=result.response,
        error=result.error,
        sigmas=result.simulated_sigmas,
        delay=machine.delay.parts,
        tolerance=(machine.tolerance.position, machine.tolerance.angle),
    )
    if len(resting.error):
        draw_repeatability(folder / "repeatability.png", **resting._asdict(), period=machine.period)
