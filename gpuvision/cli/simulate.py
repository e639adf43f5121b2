"""``gpuvision simulate``: predict the range image of a part, its errors and their causes."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    Overwrite,
    ReportFile,
    claim_outputs,
    command_line,
    device_of,
    echo,
    named_path,
    prints_report,
    progress_bar,
    reject_unused,
    write_report,
)
from gpuvision.cli.plan_output import claim_plan, planned_tolerance
from gpuvision.cli.simulate_plan import WHICH, planned_tasks, write_simulation_plan

if TYPE_CHECKING:
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.simulation.scene.material import Material
    from gpuvision.simulation.scene.scene import Scene
    from gpuvision.simulation.sensors.masks import Mask
    from gpuvision.workflows.light_cache import SimulationTask
    from gpuvision.workflows.simulation_result import Simulation


class Unit(StrEnum):
    """Values of ``--unit``."""

    metre = "m"
    millimetre = "mm"
    micrometre = "um"
    inch = "inch"


class Rule(StrEnum):
    """Values of ``--rule``."""

    flag = "flag"
    mean = "mean"
    stronger = "stronger"
    narrower = "narrower"
    predicted = "predicted"


_METRES = {Unit.metre: 1.0, Unit.millimetre: 1e-3, Unit.micrometre: 1e-6, Unit.inch: 25.4e-3}


PartFile = Annotated[
    Path, typer.Argument(metavar="PART", parser=named_path, help="Mesh of the part: STL, PLY, OBJ or GLB.")
]
LitSensor = Annotated[
    str,
    typer.Option(
        metavar="SENSOR", help="Sensor file (TOML) that describes the light, or a preset: camera_line, psd_line."
    ),
]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for pictures, range image and report.json.")
]
MaterialsFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", parser=named_path, help="TOML file with a material for each mesh of the part."),
]
Albedo = Annotated[
    float | None, typer.Option(min=0.0, max=1.0, help="Albedo of all surfaces; not with --materials. Default: 0.5.")
]
Paths = Annotated[
    str | None,
    typer.Option(
        metavar="PATHS",
        help="Light paths: all, or a list of direct, specular, diffuse-specular, diffuse-diffuse, multi-bounce. "
        "Default: all but multi-bounce; with --tolerance all.",
    ),
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Largest error of the simulated range, such as 5um: choose the fastest light paths, slabs, rays per bin, "
        "patches and clusters of pairs that are predicted to meet it on some of the profiles.",
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(min=0.0, help="With --tolerance: profiles per second that the simulation must reach."),
]
OnlyPlan = Annotated[
    bool,
    typer.Option(
        "--plan",
        help="With --tolerance: only print the settings that were tried with their predicted errors and times, and "
        "write plan.png. No simulation.",
    ),
]
PatchSize = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        help="Largest edge of the patches for multi-bounce light [m]; half the size takes about 16 times as long. "
        "Default: patch_size of the sensor file, or a sixteenth of the part's diagonal.",
    ),
]
MaskChoice = Annotated[
    str,
    typer.Option(
        metavar="MASK",
        help="Mask before the sensor: none, best (a window per sample, computed for the part), or a mask file.",
    ),
]
SecondSensor = Annotated[
    str | None,
    typer.Option(metavar="SENSOR", help="Second sensor on the same sheet of light; the two range images are merged."),
]
Limit = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        help="Smallest error [m] that counts as wrong in the summary. Default: 5 standard deviations of the noise, "
        "or the tolerance of clustered pairs that a plan chose if that is larger.",
    ),
]
Profiles = Annotated[
    int | None, typer.Option(min=1, help="Number of profiles around the middle of the part. Default: the whole part.")
]
WithRecording = Annotated[
    bool,
    typer.Option(
        "--recording",
        help="Also write the simulated recording, recording.npy, and recording.toml, the sensor file with which "
        "gpuvision scan reads it.",
    ),
]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Address of a Dask scheduler whose workers compute the light, each on its best device. It needs Dask: "
        "pip install 'gpuvision[cluster]'.",
    ),
]


def simulate(
    part: PartFile,
    sensor: LitSensor,
    out: Results,
    unit: Annotated[Unit, typer.Option(help="Length unit of the mesh.")] = Unit.metre,
    materials: MaterialsFile = None,
    albedo: Albedo = None,
    paths: Paths = None,
    tolerance: Tolerance = None,
    rate: Rate = None,
    only_plan: OnlyPlan = False,
    patch_size: PatchSize = None,
    mask: MaskChoice = "none",
    second: SecondSensor = None,
    rule: Annotated[
        Rule | None, typer.Option(help="Rule for samples in which the two sensors disagree. Default: stronger.")
    ] = None,
    limit: Limit = None,
    profiles: Profiles = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed of the noise. Default: 1.")] = None,
    noise: Annotated[bool, typer.Option(help="Simulate the noise of the sensor.")] = True,
    recording: WithRecording = False,
    device: DeviceLabel = None,
    scheduler: Scheduler = None,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Predict the range image that a sensor makes of a PART, its errors, and their causes.

    The light of each profile is stored in DIR. A stopped run continues there; a run with another --mask, --seed or
    --noise reuses the stored light. With --recording, gpuvision scan can read the simulated frames. With --tolerance,
    light that the range does not need is left out.
    """
    from gpuvision.sensor.sensor import Sensor

    largest = planned_tolerance(tolerance, "the simulated range, such as 5um", only_plan=only_plan)
    names = _names(paths, is_planned=largest is not None)
    reject_unused("with --materials", albedo=None if materials is None else albedo)
    reject_unused("without --second", rule=rule if second is None else None)
    reject_unused("with --no-noise", seed=None if noise else seed)
    reject_unused("without --tolerance", rate=rate if largest is None else None)
    reject_unused("without multi-bounce in --paths", patch_size=None if "multi-bounce" in names else patch_size)
    if only_plan:
        more = {"limit": limit, "seed": seed, "no_noise": not noise, "recording": recording, "scheduler": scheduler}
        reject_unused("with --plan", mask=None if mask == "none" else mask, second=second, **more)
    described_by = [sensor] if second is None else [sensor, second]
    sensors = [Sensor.load(each) for each in described_by]
    read = [part, *described_by, *(each for each in (materials, mask) if each is not None)]
    read += [file for each in sensors for file in each.files]
    chosen = device_of(device)
    if only_plan:
        outputs = claim_plan(out, as_json, read, overwrite=overwrite)
    else:
        names_of_files = _files(len(sensors), has_mask=mask == "best", has_recording=recording)
        outputs = claim_outputs("simulate", read, (out, names_of_files), as_json, overwrite=overwrite)
    before = _mask(mask)
    loaded = _load_part(part, unit, materials, albedo, sensors[0])
    tasks = _prepare(*loaded, sensors, profiles, paths=names, patch_size=patch_size)
    if recording:
        _check_recordings(tasks, described_by)
    lines: list[str] = []
    if largest is not None:
        if only_plan:
            write_simulation_plan(tasks[0], part.name, largest, rate, chosen, out, as_json, outputs, overwrite)
            return
        tasks, lines = planned_tasks(tasks, part.name, largest, rate, chosen)
    made: dict[str, Any] = {
        "mask": before,
        "seed": (1 if seed is None else seed) if noise else None,
        "limit": limit,
        "device": chosen,
        "scheduler": scheduler,
    }
    found, summary = _run(tasks, rule or Rule.stronger, out, made, f"simulating {part.name}", read, overwrite)
    lines.append(summary)
    if recording:
        lines += _write_recordings(found, described_by, out, made, read, overwrite)
    write_report(as_json, found[0].report(), outputs)
    lines.append(f"look at {out / 'errors.png'}, {out / 'causes.png'} and {out / 'report.json'}")
    echo("\n".join(lines), err=prints_report(as_json))


def _files(sensors: int, *, has_mask: bool, has_recording: bool) -> tuple[str, ...]:
    """Return the names of the files that a simulation of one sensor or of two writes."""
    from gpuvision.workflows.sensor_pair import pair_files
    from gpuvision.workflows.simulated_recording import RECORDING_FILES
    from gpuvision.workflows.simulation_result import simulation_files

    names = simulation_files(has_mask=has_mask) + (pair_files(has_mask=has_mask) if sensors > 1 else ())
    places = ("", "second/")[:sensors] if has_recording else ()
    return names + tuple(f"{place}{name}" for place in places for name in RECORDING_FILES)


def _prepare(
    scene: Scene,
    materials: tuple[Material, ...],
    sensors: Sequence[Sensor],
    profiles: int | None,
    **light: Any,
) -> list[SimulationTask]:
    """Prepare the simulation of a sensor, and of a second one with the same transports."""
    from gpuvision.workflows.simulating import prepare_simulation

    first = prepare_simulation(scene, materials, sensors[0], profiles=profiles, **light)
    others = [prepare_simulation(scene, materials, each, transports=first.transports, **light) for each in sensors[1:]]
    return [first, *others]


def _check_recordings(tasks: Sequence[SimulationTask], sensor_files: Sequence[str]) -> None:
    """Refuse sensors whose recordings no sensor file describes, before any light is computed."""
    from gpuvision.workflows.simulated_recording import recording_sensor

    for task, file in zip(tasks, sensor_files, strict=True):
        recording_sensor(task, file)


def _names(paths: str | None, *, is_planned: bool = False) -> tuple[str, ...]:
    """Return the light paths of ``--paths``; without it the default ones, or for a plan all."""
    from gpuvision.simulation.sensors.readings import PATHS
    from gpuvision.workflows.simulating import DEFAULT_PATHS

    if paths is None:
        return PATHS if is_planned else DEFAULT_PATHS
    if paths.strip() == "all":
        return PATHS
    return tuple(each.strip() for each in paths.split(",") if each.strip())


def _load_part(
    part: Path, unit: Unit, materials: Path | None, albedo: float | None, sensor: Sensor
) -> tuple[Scene, tuple[Material, ...]]:
    """Read the part with its materials; warn of defects of the mesh and of a doubtful unit."""
    from gpuvision.formats.materials_file import read_materials
    from gpuvision.workflows.part_unit import doubt_unit
    from gpuvision.workflows.simulating import load_part

    given = None if materials is None else read_materials(materials)
    scene, made_of = load_part(part, _METRES[unit], given, 0.5 if albedo is None else albedo)
    if str(scene.defects) != "no defects":
        echo(f"{part.name}: {'; '.join(str(scene.defects).splitlines())}", err=True)
    if doubt := doubt_unit(scene, sensor, unit.value, {each.value: metres for each, metres in _METRES.items()}):
        echo(f"{part.name}: {doubt}", err=True)
    return scene, made_of


def _mask(choice: str) -> Mask | str | None:
    """Return the mask of ``--mask``: None, "best", or the mask in a file."""
    from gpuvision.simulation.sensors.masks import Mask

    if choice in ("none", "best"):
        return None if choice == "none" else choice
    return Mask.load(choice)


def _run(
    tasks: Sequence[SimulationTask],
    rule: Rule,
    out: Path,
    made: dict[str, Any],
    description: str,
    inputs: Sequence[str | Path],
    overwrite: bool,
) -> tuple[list[Simulation], str]:
    """Simulate one sensor or two, write the results, and return the simulations and the summary."""
    from gpuvision.simulation.errors.sensor_fusion import SensorFusion
    from gpuvision.workflows.sensor_pair import SensorPair
    from gpuvision.workflows.simulating import simulate as run

    done = []
    for number, task in enumerate(tasks):
        with progress_bar(f"{description}{WHICH[number]}") as progress:
            done.append(run(task, out, progress=progress, **made))
    summary, scale = done[0].summary(), None
    if len(done) > 1:
        pair = SensorPair.fuse(done[0], done[1], SensorFusion(rule=rule.value))
        pair.write(out, inputs=inputs, overwrite=overwrite)
        summary += f"\n{pair.summary()}"
        scale = pair.picture_scale
    done[0].write(out, inputs=inputs, overwrite=overwrite, scale=scale)
    return done, summary


def _write_recordings(
    found: Sequence[Simulation],
    sensor_files: Sequence[str],
    out: Path,
    made: dict[str, Any],
    inputs: Sequence[str | Path],
    overwrite: bool,
) -> list[str]:
    """Write the recording of each sensor, and return the commands that scan them."""
    from gpuvision.workflows.simulated_recording import RECORDING_FILES, write_recording

    lines = []
    folders = (out, out / "second")[: len(found)]
    for each, file, folder in zip(found, sensor_files, folders, strict=True):
        mask = made["mask"] if each.mask is None else each.mask.mask
        given = {"seed": made["seed"], "device": made["device"], "mask": mask}
        write_recording(each.task, folder, file, light=out, inputs=inputs, overwrite=overwrite, **given)
        recording, sensor = (folder / name for name in RECORDING_FILES)
        words = ("scan", recording, "--sensor", sensor, "--out", folder / "scan")
        lines.append(f"next: {command_line('gpuvision', *words)}")
    return lines
