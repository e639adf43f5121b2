"""``gpuvision simulate``: what range image a sensor will make of a part, where it will be wrong, and why."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from gpuvision.commands.arguments import named_path
from gpuvision.commands.scan import progress_bar


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


def simulate(
    part: Annotated[
        Path, typer.Argument(metavar="PART", parser=named_path, help="Mesh of the part: STL, PLY, OBJ or GLB.")
    ],
    sensor: Annotated[str, typer.Option(help="The sensor's TOML file, with its light; or camera_line, psd_line.")],
    out: Annotated[
        Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for pictures, range image and report.json.")
    ],
    unit: Annotated[Unit, typer.Option(help="Of the mesh.")] = Unit.metre,
    materials: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            parser=named_path,
            help="TOML file with a material for each mesh of the part.",
        ),
    ] = None,
    albedo: Annotated[float, typer.Option(min=0.0, max=1.0, help="Of all surfaces, without --materials.")] = 0.5,
    paths: Annotated[
        str,
        typer.Option(
            help="Ways of the light: all, or some of direct, specular, diffuse-specular, diffuse-diffuse, bounces."
        ),
    ] = "direct,specular,diffuse-specular,diffuse-diffuse",
    tolerance: Annotated[
        float, typer.Option(min=0.0, help="Range error that may come from what is left out, in metres; 0: nothing is.")
    ] = 0.0,
    mask: Annotated[
        str, typer.Option(help="Before the sensor: none, best (a window per sample, made for the part), or a file.")
    ] = "none",
    second: Annotated[
        str | None, typer.Option(metavar="SENSOR", help="A second sensor over the same sheet; the two become one.")
    ] = None,
    rule: Annotated[Rule, typer.Option(help="Which of two sensors is right where they disagree.")] = Rule.stronger,
    limit: Annotated[
        float | None, typer.Option(min=0.0, help="Error from which on a sample counts as wrong, in metres.")
    ] = None,
    profiles: Annotated[
        int | None, typer.Option(min=1, help="How many; otherwise as many as the part is long.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 1,
    noise: Annotated[bool, typer.Option(help="Whether there is any.")] = True,
    device: Annotated[str | None, typer.Option(help="Label of an OpenCL device, see `gpuvision devices`.")] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers compute; needs the extra cluster."),
    ] = None,
) -> None:
    """Predict the range image that a sensor makes of a PART, its errors, and their causes.

    The light of each profile is kept in DIR: what was stopped goes on where it was, and another --mask, --seed or
    --noise costs nothing anew.
    """
    from gpuvision.host import Device
    from gpuvision.materials_file import read_materials
    from gpuvision.scan import check_folder
    from gpuvision.sensor import Sensor
    from gpuvision.sensor_pair import SensorPair
    from gpuvision.simulate import part_of, prepare
    from gpuvision.simulate import simulate as run
    from gpuvision.simulation.masks import Mask
    from gpuvision.simulation.recommendations import DualSensor

    described = Sensor.load(sensor)
    check_folder(out)
    given = None if materials is None else read_materials(materials)
    before = {"none": None, "best": "best"}[mask] if mask in ("none", "best") else Mask.load(mask)
    scene, made_of = part_of(part, _METRES[unit], given, albedo)
    if str(scene.defects) != "no defects":
        typer.echo(f"{part.name}: {'; '.join(str(scene.defects).splitlines())}", err=True)
    names = tuple(each.strip() for each in paths.split(",") if each.strip())
    task = prepare(scene, made_of, described, paths=names, tolerance=tolerance, profiles=profiles)
    chosen = None if device is None else Device.named(device)
    made: dict[str, Any] = {
        "mask": before,
        "seed": seed if noise else None,
        "limit": limit,
        "device": chosen,
        "scheduler": scheduler,
    }
    with progress_bar(f"simulating {part.name}") as progress:
        done = run(task, out, progress=progress, **made)
    told = done.summary()
    if second is not None:
        beside = Sensor.load(second)
        other = prepare(scene, made_of, beside, paths=names, tolerance=tolerance, transports=task.transports)
        with progress_bar(f"simulating {part.name}, second sensor") as progress:
            pair = SensorPair.of(done, run(other, out, progress=progress, **made), DualSensor(rule=rule.value))
        pair.write(out)
        told += f"\n{pair.summary()}"
    done.write(out)
    typer.echo(f"{told}\nlook at {out / 'errors.png'}, {out / 'causes.png'} and {out / 'report.json'}")
