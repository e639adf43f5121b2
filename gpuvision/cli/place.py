"""``gpuvision place``: simulate placements of a part on a circuit board with the camera in the loop."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    LayerNames,
    Overwrite,
    ReportFile,
    echo,
    layers_of,
    named_path,
    prints_report,
    progress_bar,
    quantities,
    write_report,
)
from gpuvision.cli.select import Side

_LARGEST_BOARD = 1.0  # largest coordinate on a board [m] (chosen: panels are smaller)
_FILES = ("report.json", "placements.png", "features.png", "repeatability.png")

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
Rate = Annotated[
    float | None, typer.Option(min=1.0, max=1e7, help="Frames per second. Default: the value in the machine file.")
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
    rate: Rate = None,
    count: Annotated[int, typer.Option(min=1, max=10_000, help="Number of placements.")] = 20,
    budget: Annotated[int, typer.Option(min=3, max=1000, help="Number of calipers (rulers).")] = 60,
    seed: Annotated[int, typer.Option(min=0, max=(1 << 32) - 1, help="Seed of all random numbers.")] = 0,
    side: Annotated[Side, typer.Option(help="Side of the board on which parts are placed.")] = Side.top,
    layers: LayerNames = None,
    as_json: ReportFile = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate placements of a part: the camera of the head steers the nozzle to its place on a rendered board.

    Every frame is rendered, measured by calipers (rulers), and answered by the controller after the delay of the
    machine. The report has the error at the release and its prediction, and the number of frames in which the true
    error settles, with its value by theory. The machine file chooses observer, controller and release rule.
    """
    from gpuvision.formats.json import json_tree, report_text
    from gpuvision.formats.machine_file import named_files, read_machine
    from gpuvision.host import Device
    from gpuvision.host.files import write_text_atomic
    from gpuvision.host.outputs import Outputs
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.features.feature_set import edge_clearance
    from gpuvision.plots.board import draw_features
    from gpuvision.plots.placement import draw_placements, draw_repeatability
    from gpuvision.servoing.placement.plan import placement_imaging
    from gpuvision.workflows.placement_cell import measure_repeatability
    from gpuvision.workflows.placing import simulate_placements

    target = quantities(at, "--at", "m,m,rad")
    if max(abs(target[0]), abs(target[1])) > _LARGEST_BOARD:
        raise ValueError(f"--at is {at!r}, expected at most {_LARGEST_BOARD:g} m; numbers need units: 9mm,9mm,90deg")
    outputs = Outputs("place", inputs=[gerbers, machine, *named_files(machine)], overwrite=overwrite)
    outputs.claim(as_json)
    outputs.claim_folder(out, _FILES)
    described = read_machine(machine, rate=rate)
    clearance = edge_clearance(placement_imaging(described))
    artwork = read_artwork(gerbers, side=side.value, layers=layers_of(layers), clearance=clearance)
    for each in artwork.warnings:
        echo(f"warning: {each}", err=True)
    chosen = None if device is None else Device.named(device)
    with progress_bar("placing") as progress:
        result = simulate_placements(
            artwork,
            target,
            described,
            count=count,
            budget=budget,
            seed=seed,
            device=chosen,
            progress=progress,
        )
    resting = measure_repeatability(artwork, result.machine, result.plan, seed=seed, device=chosen)
    report = result.report() | {"repeatability": resting.report()}
    write_report(as_json, report, outputs)
    with outputs.folder(out) as inside:
        write_text_atomic(inside / "report.json", report_text(json_tree(report)))
        view, region = result.machine.camera.view(result.plan.camera_pose), result.plan.features.region
        draw_features(
            inside / "features.png", artwork, result.plan.features, region, view=view, target=result.plan.target[:2]
        )
        draw_placements(
            inside / "placements.png",
            period=described.period,
            motion=result.motion,
            response=result.response,
            error=result.error,
            sigmas=result.simulated_sigmas,
            delay=described.delay.parts,
            tolerance=(described.tolerance.position, described.tolerance.angle),
        )
        if len(resting.error):
            draw_repeatability(inside / "repeatability.png", **resting._asdict(), period=described.period)
    echo(f"{result.summary()}\nlook at {out / 'placements.png'} and {out / 'report.json'}", err=prints_report(as_json))
