"""``gpuvision simulate``: what range image a sensor will make of a part, where it will be wrong, and why."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import DeviceLabel, named_path
from gpuvision.cli.scan import progress_bar

if TYPE_CHECKING:
    from gpuvision.simulation.sensors.masks import Mask
    from gpuvision.workflows.light_cache import Task


class Unit(StrEnum):
    """What ``--unit`` takes."""

    metre = "m"
    millimetre = "mm"
    micrometre = "um"
    inch = "inch"


class Rule(StrEnum):
    """What ``--rule`` takes."""

    flag = "flag"
    mean = "mean"
    stronger = "stronger"
    narrower = "narrower"
    predicted = "predicted"


_METRES = {Unit.metre: 1.0, Unit.millimetre: 1e-3, Unit.micrometre: 1e-6, Unit.inch: 25.4e-3}


PartFile = Annotated[
    Path, typer.Argument(metavar="PART", parser=named_path, help="Mesh of the part: STL, PLY, OBJ or GLB.")
]
LitSensor = Annotated[str, typer.Option(help="The sensor's TOML file, with its light; or camera_line, psd_line.")]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for pictures, range image and report.json.")
]
MaterialsFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", parser=named_path, help="TOML file with a material for each mesh of the part."),
]
Albedo = Annotated[float, typer.Option(min=0.0, max=1.0, help="Of all surfaces, without --materials.")]
Paths = Annotated[
    str,
    typer.Option(
        help="Ways of the light: all, or some of direct, specular, diffuse-specular, diffuse-diffuse, bounces."
    ),
]
Tolerance = Annotated[
    float, typer.Option(min=0.0, help="Range error that may come from what is left out, in metres; 0: nothing is.")
]
MaskChoice = Annotated[
    str, typer.Option(help="Before the sensor: none, best (a window per sample, made for the part), or a file.")
]
SecondSensor = Annotated[
    str | None, typer.Option(metavar="SENSOR", help="A second sensor over the same sheet; the two become one.")
]
Limit = Annotated[float | None, typer.Option(min=0.0, help="Error from which on a sample counts as wrong, in metres.")]
Profiles = Annotated[int | None, typer.Option(min=1, help="How many; otherwise as many as the part is long.")]
Scheduler = Annotated[
    str | None,
    typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers compute; needs the extra cluster."),
]


def simulate(
    part: PartFile,
    sensor: LitSensor,
    out: Results,
    unit: Annotated[Unit, typer.Option(help="Of the mesh.")] = Unit.metre,
    materials: MaterialsFile = None,
    albedo: Albedo = 0.5,
    paths: Paths = "direct,specular,diffuse-specular,diffuse-diffuse",
    tolerance: Tolerance = 0.0,
    mask: MaskChoice = "none",
    second: SecondSensor = None,
    rule: Annotated[Rule, typer.Option(help="Which of two sensors is right where they disagree.")] = Rule.stronger,
    limit: Limit = None,
    profiles: Profiles = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 1,
    noise: Annotated[bool, typer.Option(help="Whether there is any.")] = True,
    device: DeviceLabel = None,
    scheduler: Scheduler = None,
) -> None:
    """Predict the range image that a sensor makes of a PART, its errors, and their causes.

    The light of each profile is kept in DIR: what was stopped goes on where it was, and another --mask, --seed or
    --noise costs nothing anew.
    """
    from gpuvision.formats.materials_file import read_materials
    from gpuvision.host import Device
    from gpuvision.host.files import check_folder
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.workflows.simulating import part_of, prepare

    described = Sensor.load(sensor)
    beside = None if second is None else Sensor.load(second)
    check_folder(out)
    before = _mask(mask)
    given = None if materials is None else read_materials(materials)
    scene, made_of = part_of(part, _METRES[unit], given, albedo)
    if str(scene.defects) != "no defects":
        typer.echo(f"{part.name}: {'; '.join(str(scene.defects).splitlines())}", err=True)
    names = _names(paths)
    task = prepare(scene, made_of, described, paths=names, tolerance=tolerance, profiles=profiles)
    other = None
    if beside is not None:
        other = prepare(scene, made_of, beside, paths=names, tolerance=tolerance, transports=task.transports)
    made: dict[str, Any] = {
        "mask": before,
        "seed": seed if noise else None,
        "limit": limit,
        "device": None if device is None else Device.named(device),
        "scheduler": scheduler,
    }
    told = _run(task, other, rule, out, made, f"simulating {part.name}")
    typer.echo(f"{told}\nlook at {out / 'errors.png'}, {out / 'causes.png'} and {out / 'report.json'}")


def _names(paths: str) -> tuple[str, ...]:
    """Return the ways of the light that ``--paths`` names."""
    from gpuvision.simulation.sensors.readings import PATHS

    if paths.strip() == "all":
        return PATHS
    return tuple(each.strip() for each in paths.split(",") if each.strip())


def _mask(choice: str) -> Mask | str | None:
    """Return what ``--mask`` means: None, "best", or the mask in a file."""
    from gpuvision.simulation.sensors.masks import Mask

    if choice in ("none", "best"):
        return None if choice == "none" else choice
    return Mask.load(choice)


def _run(task: Task, other: Task | None, rule: Rule, out: Path, made: dict[str, Any], what: str) -> str:
    """Simulate one sensor or two, write the results, and return what came out."""
    from gpuvision.simulation.errors.recommendations import DualSensor
    from gpuvision.workflows.sensor_pair import SensorPair
    from gpuvision.workflows.simulating import simulate as run

    with progress_bar(what) as progress:
        done = run(task, out, progress=progress, **made)
    told = done.summary()
    if other is not None:
        with progress_bar(f"{what}, second sensor") as progress:
            pair = SensorPair.of(done, run(other, out, progress=progress, **made), DualSensor(rule=rule.value))
        pair.write(out)
        told += f"\n{pair.summary()}"
    done.write(out)
    return told
