"""``gpuvision undistort``: correct images and points for lens distortion."""

from __future__ import annotations

import os
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gpuvision.cli.arguments import DeviceLabel, Overwrite, echo, named_path, progress_bar, reject_unused


class Interpolation(StrEnum):
    """Values of ``--interpolation``."""

    bilinear = "bilinear"
    bicubic = "bicubic"


class Border(StrEnum):
    """Values of ``--border``."""

    mask = "mask"
    constant = "constant"
    replicate = "replicate"
    reflect = "reflect"


class Frame(StrEnum):
    """Values of ``--frame``."""

    same = "same"
    all = "all"
    valid = "valid"


Inputs = Annotated[
    list[Path],
    typer.Argument(
        metavar="INPUTS", parser=named_path, help="Images, and NPY arrays (..., 2) of points (column, row) [px]."
    ),
]
CameraFile = Annotated[
    Path, typer.Option(metavar="FILE.toml", parser=named_path, help="Camera file of `gpuvision calibrate`.")
]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Output folder; files keep the names of the inputs.")
]
InterpolationChoice = Annotated[
    Interpolation | None, typer.Option(help="Interpolation between pixels. Default: bilinear.")
]
BorderChoice = Annotated[
    Border | None,
    typer.Option(
        help="Values outside the image: mask (default; 0 or NaN), constant (--border-value), or replicate or reflect "
        "the border pixels."
    ),
]
BorderValue = Annotated[
    float | None, typer.Option(help="Grey level outside the image with --border constant. Default: 0.")
]
Region = Annotated[
    str | None,
    typer.Option(metavar="COLUMN,ROW,COLUMNS,ROWS", help="Part of the corrected images to compute. Default: all."),
]

FrameChoice = Annotated[
    Frame | None,
    typer.Option(
        help="Part that the corrected images show: same (default; the rectangle of the image), all (every pixel; "
        "OpenCV: alpha 1) or valid (no missing pixels; OpenCV: alpha 0)."
    ),
]
Window = Annotated[
    str | None,
    typer.Option(metavar="COLUMN,ROW", help="First pixel of cropped images in the calibrated image. Default: 0,0."),
]
Binning = Annotated[
    int | None, typer.Option(min=1, help="Calibrated pixels per pixel of binned or scaled images. Default: 1.")
]


def undistort(
    inputs: Inputs,
    lens: CameraFile,
    out: Results,
    interpolation: InterpolationChoice = None,
    border: BorderChoice = None,
    border_value: BorderValue = None,
    region: Region = None,
    frame: FrameChoice = None,
    window: Window = None,
    binning: Binning = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Correct images and points for the distortion of a calibrated lens.

    Integer images become PNG, float32 images TIFF; points stay NPY, NaN where the lens model is not invertible. Files
    are written only after all inputs succeeded.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.formats.camera_file import read_calibrated_size, read_lens
    from gpuvision.host import Device
    from gpuvision.host.files import check_writable_folder
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.undistorting import undistort_files

    if border is not Border.constant:
        reject_unused("without --border constant", border_value=border_value)
    if all(each.suffix.lower() == ".npy" for each in inputs):
        reason = "for points, only for images"
        reject_unused(reason, interpolation=interpolation, border=border, region=region, frame=frame)
    model = read_lens(lens)
    check_writable_folder(out)
    suffixes = (".png", ".tif", ".npy")
    Outputs("undistort", inputs=[lens]).protect(*(out / f"{each.stem}{end}" for each in inputs for end in suffixes))
    chosen = Device.best() if device is None else Device.named(device)
    part = None if region is None else _region(region)
    with progress_bar("undistorting") as progress:
        done = undistort_files(
            inputs,
            model,
            out,
            device=chosen,
            interpolation=(interpolation or Interpolation.bilinear).value,
            border=(border or Border.mask).value,
            border_value=border_value or 0.0,
            region=part,
            frame=(frame or Frame.same).value,
            calibrated_size=read_calibrated_size(lens),
            window=None if window is None else _window(window),
            binning=binning or 1,
            overwrite=overwrite,
            progress=progress,
        )
    echo(f"{len(done)} files written to {out}; the first: {done[0]}")


def _region(text: str) -> tuple[int, int, int, int]:
    try:
        column, row, columns, rows = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--region is {text!r}, expected column,row,columns,rows in whole pixels") from None
    return column, row, columns, rows


def _window(text: str) -> tuple[int, int]:
    try:
        column, row = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"--window is {text!r}, expected column,row in whole pixels") from None
    return column, row
