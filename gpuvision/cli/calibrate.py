"""``gpuvision calibrate``: calibrate a lens or a camera from images of a flat target pattern."""

from __future__ import annotations

import math
import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gpuvision.cli.arguments import (
    Overwrite,
    ReportFile,
    command_line,
    echo,
    echo_warnings,
    named_path,
    prints_report,
    progress_bar,
    reject_unused,
    write_report,
)
from gpuvision.cli.calibrate_sensor import (
    BlockFolder,
    BlockHeights,
    CameraFile,
    Channel,
    KnownPoints,
    LaserFolder,
    LineAxis,
    OnStage,
    ProfilesBetween,
    SensorOption,
    SensorOptions,
    Step,
    TransportFolder,
    calibrate_sensor,
)

if TYPE_CHECKING:
    from gpuvision.camera.calibration import Calibration


class TargetPattern(StrEnum):
    """Values of ``--pattern``."""

    dots = "dots"
    chessboard = "chessboard"
    lines = "lines"


class CalibrationMethod(StrEnum):
    """Values of ``--method``."""

    auto = "auto"
    lines = "lines"
    views = "views"


class RobustLoss(StrEnum):
    """Values of ``--loss``."""

    squared = "squared"
    huber = "huber"
    tukey = "tukey"


Images = Annotated[
    list[Path], typer.Argument(metavar="IMAGES", parser=named_path, help="Images of one camera, all of one size.")
]
LensFile = Annotated[
    Path,
    typer.Option(
        metavar="FILE.toml",
        parser=named_path,
        help="Camera file to write, or with --sensor the sensor file. The report (.json) and a picture (.png) are "
        "written to the same folder.",
    ),
]
Pattern = Annotated[
    TargetPattern, typer.Option(help="Target pattern in the images: dot grid, chessboard, or grid of crossing lines.")
]
Method = Annotated[
    CalibrationMethod,
    typer.Option(
        help="lines: the lens distortion alone, from lines that must become straight; one image suffices. views: focal "
        "length, centre, lens and tilt of the sensor. auto: views with three images of a grid or with --focal-length."
    ),
]
Model = Annotated[
    str,
    typer.Option(
        metavar="MODEL",
        help="auto: the smallest model that the data do not reject (F test; Wald's test for correlated residuals). "
        "lines: none, or k1 up to k1,k2,k3,k4. views: none, or terms of k1,k2,p1,p2,k3,k4,k5,k6,tilt.",
    ),
]
InnerCorners = Annotated[
    str | None,
    typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the chessboard, such as 9x6. Default: any number."),
]
Pitch = Annotated[
    float | None,
    typer.Option(
        min=1e-9,
        help="Distance between neighbouring points on the target [m]. It scales the poses; with --sensor it is "
        "required and scales all heights. Default without --sensor: 1.",
    ),
]
FocalLength = Annotated[
    float | None, typer.Option(help="Known focal length [px]; with it one view suffices. Default: estimated.")
]
Loss = Annotated[RobustLoss, typer.Option(help="Robust loss: huber and tukey reduce the weight of outliers.")]


def calibrate(
    images: Images,
    out: LensFile,
    pattern: Pattern = TargetPattern.dots,
    method: Method = CalibrationMethod.auto,
    model: Model = "auto",
    inner_corners: InnerCorners = None,
    pitch: Pitch = None,
    focal_length: FocalLength = None,
    loss: Loss = RobustLoss.squared,
    sensor: SensorOption = False,
    camera: CameraFile = None,
    laser: LaserFolder = None,
    transport_views: TransportFolder = None,
    profiles_between: ProfilesBetween = None,
    on_stage: OnStage = False,
    block: BlockFolder = None,
    block_heights: BlockHeights = None,
    points: KnownPoints = None,
    step: Step = None,
    along: LineAxis = None,
    channel: Channel = None,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Calibrate a lens, a camera with a tilted (Scheimpflug) sensor, or a laser sensor, from images of a flat target.

    Every parameter comes with its standard deviation. The report lists other models that fit equally well and warns of
    parameters that the images do not determine.
    """
    options = SensorOptions(
        camera, laser, transport_views, profiles_between, on_stage, block, block_heights, points, step, along, channel
    )
    if not sensor:
        reject_unused("without --sensor", **options._asdict())
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    _check_unused(pattern, method, inner_corners, pitch, focal_length)
    settings: dict[str, Any] = {
        "pattern": pattern.value,
        "model": model,
        "inner_corners": None if inner_corners is None else _corners(inner_corners),
        "pitch": pitch,
        "focal_length": focal_length,
        "loss": loss.value,
    }
    if out.suffix in (".json", ".png"):
        raise ValueError(
            f"--out is {out}, but the report and the plot get the suffixes .json and .png; give a name such as "
            "lens.toml"
        )
    if not sensor:
        _calibrate_camera(images, out, settings | {"method": method.value}, as_json, overwrite)
        return
    if method is CalibrationMethod.lines or pattern is TargetPattern.lines:
        raise ValueError("--sensor needs poses of the target; leave out --method lines and --pattern lines")
    calibrate_sensor(images, out, options, settings, as_json=as_json, overwrite=overwrite, show=_show)


def _check_unused(
    pattern: TargetPattern,
    method: CalibrationMethod,
    inner_corners: str | None,
    pitch: float | None,
    focal_length: float | None,
) -> None:
    """Refuse options that the pattern or the method does not use."""
    if pattern is not TargetPattern.chessboard:
        reject_unused(f"with --pattern {pattern.value}, only with chessboard", inner_corners=inner_corners)
    if method is CalibrationMethod.lines:
        reject_unused("with --method lines, which finds no poses", pitch=pitch, focal_length=focal_length)
    elif method is CalibrationMethod.auto and pattern is TargetPattern.lines:
        reject_unused("with --pattern lines, which gives no poses", pitch=pitch, focal_length=focal_length)


def _calibrate_camera(
    images: list[Path], out: Path, settings: dict[str, Any], as_json: Path | None, overwrite: bool
) -> None:
    """Calibrate a lens or a camera, print and write its results."""
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.calibrating import calibrate as run
    from gpuvision.workflows.calibrating import calibration_files, write_calibration

    outputs = Outputs("calibrate", inputs=images, overwrite=overwrite)
    outputs.claim(*calibration_files(out), as_json)
    with progress_bar(f"detecting {settings['pattern']}") as progress:
        done = run(images, progress=progress, **settings)
    _show(done, to_stderr=prints_report(as_json))
    write_calibration(done, out, overwrite=overwrite)
    write_report(as_json, done.report(), outputs)
    correct = command_line("gpuvision", "undistort", "IMAGES", "--lens", out, "--out", "DIR")
    echo(f"next: check {out.with_suffix('.png')}; correct images with {correct}", err=prints_report(as_json))


def _corners(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(
            f"--inner-corners is {text!r}, expected the numbers of inner corners along both sides, such as 9x6"
        )
    return int(parts[0]), int(parts[1])


def _show(done: Calibration, to_stderr: bool) -> None:
    """Print the summary, the parameters with uncertainties, the alternative models and the warnings."""
    console = Console(stderr=to_stderr)
    echo(done.summary(), err=to_stderr)
    for path, reason in done.skipped_images:
        echo(f"skipped {path}: {reason}", err=to_stderr)
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("uncertainty (1 sigma)", justify="right")
    for name, (value, error) in done.parameters.items():
        table.add_row(name, f"{value:.{_digits(value, error)}g}", f"{error:.2g}")
    console.print(table)
    if done.alternatives:
        console.print(_alternatives(done))
    echo_warnings(done.fit.warnings, err=to_stderr)


def _digits(value: float, error: float) -> int:
    """Return the number of significant digits to print: one more than the digits above the uncertainty."""
    if not 0.0 < error < math.inf or value == 0.0:
        return 6
    return min(max(math.ceil(math.log10(abs(value) / error)) + 2, 2), 10)


def _alternatives(done: Calibration) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("alternative models")
    for heading in ("residual [px]", "p (F test)", "centre distance [px]"):
        table.add_column(heading, justify="right")
    for each in done.alternatives:
        table.add_row(each.model, f"{each.rms_px:.4g}", f"{each.p_value:.2g}", f"{each.centre_distance_px:.3g}")
    return table
