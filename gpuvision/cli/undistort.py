"""``gpuvision undistort``: images and points as an ideal camera would have seen them."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gpuvision.cli.arguments import DeviceLabel, named_path
from gpuvision.cli.scan import progress_bar


class Between(StrEnum):
    """What ``--interpolation`` takes."""

    bilinear = "bilinear"
    bicubic = "bicubic"


class Outside(StrEnum):
    """What ``--border`` takes."""

    mask = "mask"
    constant = "constant"
    replicate = "replicate"
    reflect = "reflect"


def undistort(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUTS...", parser=named_path, help="Images; and points: NPY arrays (..., 2) of (column, row)."
        ),
    ],
    lens: Annotated[
        Path, typer.Option(metavar="FILE.toml", parser=named_path, help="What `gpuvision calibrate` wrote.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for the results, under the inputs' names.")
    ],
    interpolation: Annotated[Between, typer.Option(help="Between pixels.")] = Between.bilinear,
    border: Annotated[
        Outside, typer.Option(help="What lies outside the image: nothing (0, NaN), a value, or its border's pixels.")
    ] = Outside.mask,
    value: Annotated[float, typer.Option(help="Of --border constant.")] = 0.0,
    region: Annotated[
        str | None,
        typer.Option(metavar="COLUMN,ROW,COLUMNS,ROWS", help="The part of the ideal images to make; else all."),
    ] = None,
    device: DeviceLabel = None,
) -> None:
    """Undo a lens in images and in points.

    Whole-number images become PNG, float32 ones TIFF; points stay NPY, NaN where the lens has no ideal place. Nothing
    is written before all is done.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.formats.camera_file import read_lens
    from gpuvision.host import Device
    from gpuvision.host.files import check_folder
    from gpuvision.workflows.undistorting import undistort_files

    model = read_lens(lens)
    check_folder(out)
    chosen = Device.best() if device is None else Device.named(device)
    part = None if region is None else _region(region)
    with progress_bar("undistorting") as progress:
        done = undistort_files(
            inputs,
            model,
            out,
            device=chosen,
            interpolation=interpolation.value,
            border=border.value,
            value=value,
            region=part,
            progress=progress,
        )
    typer.echo(f"{len(done)} files in {out}; the first: {done[0]}")


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        column, row, columns, rows = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--region is {text!r}, expected column,row,columns,rows in whole pixels") from None
    return column, row, columns, rows
