"""``gpuvision calibrate --sensor``: calibrate camera, sheet of light and transport of a laser sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from gpuvision.cli.arguments import (
    command_line,
    echo,
    echo_warnings,
    named_path,
    prints_report,
    progress_bar,
    quantities,
    reject_unused,
    write_report,
)

if TYPE_CHECKING:
    from gpuvision.camera.calibration import Calibration
    from gpuvision.host.channels import Channel as RecordingChannel
    from gpuvision.workflows.calibrating_sensor import BlockViews, TransportViews
    from gpuvision.workflows.sensor_calibration_result import SensorCalibration


class Axis(StrEnum):
    """Values of ``--along``."""

    columns = "columns"
    rows = "rows"


SensorOption = Annotated[
    bool,
    typer.Option(
        "--sensor",
        help="Calibrate a laser sensor: camera, sheet of light and transport. --out is then the sensor file for scan.",
    ),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml",
        parser=named_path,
        help="With --sensor: camera file that gpuvision calibrate wrote for this camera. The images then give only the "
        "poses of the target. Default: the images calibrate the camera.",
    ),
]
LaserFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        parser=named_path,
        help="With --sensor: folder of the laser images, each in the pose of the target image with the same name or "
        "number. Default: pose_laser.png among the IMAGES belongs to pose.png.",
    ),
]
TransportFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        parser=named_path,
        help="With --sensor: folder of images of the whole target on the moving stage, in the order of their names.",
    ),
]
ProfilesBetween = Annotated[
    float | None,
    typer.Option(help="Profiles that the stage moves from one transport view to the next one; negative if backward."),
]
OnStage = Annotated[
    bool,
    typer.Option("--on-stage", help="The target of the transport views lies on the stage: its plane is z = 0."),
]
BlockFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="FOLDER",
        parser=named_path,
        help="With --sensor and transport views: folder with pairs of images (block1.png, block1_laser.png) of a "
        "stepped block on the stage, instead of laser images of the target or beside them.",
    ),
]
BlockHeights = Annotated[
    str | None,
    typer.Option(
        metavar="H,H,...",
        help="Heights of the block's steps over the plane of the target on the stage, along the laser line in the "
        "direction of increasing columns (or rows), such as 0,5mm,10mm.",
    ),
]
KnownPoints = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        parser=named_path,
        help="With --sensor: known points of the sheet of light instead of laser images, with the header "
        "column,row,x,y,z [px, m].",
    ),
]
Step = Annotated[
    float | None,
    typer.Option(
        help="With --sensor, without transport views: movement of the part per profile [m], perpendicular to the sheet "
        "of light, along -(g x h); a negative value means along g x h.",
    ),
]
LineAxis = Annotated[
    Axis | None,
    typer.Option(help="With --sensor: image axis along which the laser line runs. Default: found in the images."),
]
Channel = Annotated[
    str | None,
    typer.Option(
        metavar="CHANNEL",
        help="With --sensor: channel of colour images that holds the laser, such as red or red_difference. Default: "
        "grey.",
    ),
]


class SensorOptions(NamedTuple):
    """Options of the command that only ``--sensor`` uses."""

    camera: Path | None
    laser: Path | None
    transport_views: Path | None
    profiles_between: float | None
    on_stage: bool
    block: Path | None
    block_heights: str | None
    points: Path | None
    step: float | None
    along: Axis | None
    channel: str | None


def calibrate_sensor(
    images: Sequence[Path],
    out: Path,
    options: SensorOptions,
    settings: dict[str, Any],
    *,
    as_json: Path | None,
    overwrite: bool,
    show: Callable[[Calibration, bool], None],
) -> None:
    """Run the calibration of a laser sensor, print and write its results.

    Parameters
    ----------
    images : sequence of Path
        Target images, and laser images without ``--laser``.
    out : Path
        Sensor file.
    options : SensorOptions
        Options of ``--sensor``.
    settings : dict
        Options of the target and of the camera's calibration, as parameters of
        `gpuvision.workflows.calibrating_sensor`.
    as_json, overwrite
        Common options.
    show : callable
        Prints the calibration of the camera; the second argument says whether to standard error.
    """
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.calibrating_sensor import calibrate_sensor as run
    from gpuvision.workflows.sensor_calibration_result import sensor_calibration_files, write_sensor_calibration

    channel = _checked_channel(options.channel)
    _check(options, settings)
    inputs = [*images, *(each for each in options if isinstance(each, Path))]
    outputs = Outputs("calibrate", inputs=inputs, overwrite=overwrite)
    outputs.claim(*sensor_calibration_files(out), as_json)
    _check_place(out, options)
    with progress_bar(f"detecting {settings['pattern']}") as progress:
        done = run(
            images,
            camera=options.camera,
            laser=options.laser,
            transport=_transport_views(options),
            block=_block_views(options),
            points=options.points,
            step=options.step,
            along=None if options.along is None else options.along.value,
            channel=channel,
            name=out.stem,
            progress=progress,
            **settings,
        )
    _show(done, show, to_stderr=prints_report(as_json))
    write_sensor_calibration(done, out, inputs=inputs, overwrite=overwrite)
    write_report(as_json, done.report(), outputs)
    scan = command_line("gpuvision", "scan", "RECORDING", "--sensor", out, "--out", "DIR")
    echo(f"next: check {out.with_suffix('.png')}; scan with {scan}", err=prints_report(as_json))


def _check(options: SensorOptions, settings: dict[str, Any]) -> None:
    """Check the options of ``--sensor`` that depend on each other."""
    if options.camera is not None:
        reject_unused(
            "with --camera, which gives the camera",
            model=None if settings["model"] == "auto" else settings["model"],
            focal_length=settings["focal_length"],
            loss=None if settings["loss"] == "squared" else settings["loss"],
        )
    if settings["pitch"] is None:
        raise ValueError("--sensor needs --pitch, the distance of the target's points [m]: it scales all heights")
    if (options.transport_views is None) == (options.step is None):
        raise ValueError(
            "--sensor needs either --transport-views, images of the target on the moving stage, or --step, the "
            "transport per profile [m]"
        )
    if (options.transport_views is None) != (options.profiles_between is None):
        raise ValueError("--transport-views and --profiles-between need each other; give both")
    if (options.block is None) != (options.block_heights is None):
        raise ValueError("--block and --block-heights need each other; give both")
    if options.block is not None and options.transport_views is None:
        raise ValueError("--block needs --transport-views, which show the plane of the stage")
    if options.on_stage and options.transport_views is None:
        raise ValueError("--on-stage has no effect without --transport-views; leave it out")


def _check_place(out: Path, options: SensorOptions) -> None:
    """Refuse an output in a folder of images: the next run would take the picture for one of them."""
    for name in ("laser", "transport_views", "block"):
        folder = getattr(options, name)
        if folder is not None and out.resolve().parent == folder.resolve():
            raise ValueError(
                f"--out is {out}, in the folder of --{name.replace('_', '-')}: its picture would be one of the images; "
                "give another folder"
            )


def _checked_channel(name: str | None) -> RecordingChannel:
    from gpuvision.host.channels import CHANNELS

    for each in CHANNELS:
        if each == (name or "grey"):
            return each
    raise ValueError(f"--channel is {name!r}, expected one of {', '.join(CHANNELS)}")


def _transport_views(options: SensorOptions) -> TransportViews | None:
    from gpuvision.workflows.calibrating_sensor import TransportViews

    if options.transport_views is None or options.profiles_between is None:
        return None
    return TransportViews(
        folder=options.transport_views, profiles_between=options.profiles_between, on_stage=options.on_stage
    )


def _block_views(options: SensorOptions) -> BlockViews | None:
    from gpuvision.workflows.calibrating_sensor import BlockViews

    if options.block is None or options.block_heights is None:
        return None
    count = options.block_heights.count(",") + 1
    heights = quantities(options.block_heights, "--block-heights", ",".join(["m"] * count))
    return BlockViews(folder=options.block, heights=heights)


def _show(done: SensorCalibration, show: Callable[[Calibration, bool], None], *, to_stderr: bool) -> None:
    """Print the camera, then the sheet, the transport and their warnings."""
    from gpuvision.camera.calibration import Calibration

    camera = done.calibration
    if isinstance(camera, Calibration):
        show(camera, to_stderr)
    else:
        for line in (camera.summary(), *(f"skipped {path}: {reason}" for path, reason in camera.skipped_images)):
            echo(line, err=to_stderr)
        echo_warnings(camera.warnings, err=to_stderr)
    echo(done.summary(), err=to_stderr)
    test = done.geometry.sheet.bend_test
    if test is not None:
        verdict = "kept" if test.significant else "not significant, left out"
        bends = ", ".join(
            f"{name} {value:.3g} +- {sigma:.2g}"
            for name, value, sigma in zip(("gg", "gh", "hh"), test.bend, test.sigma, strict=True)
        )
        echo(f"bend of the sheet [1/m]: {bends}; p = {test.p_value:.2g} (F test): {verdict}", err=to_stderr)
    echo_warnings(done.warnings[len(camera.warnings) :], err=to_stderr)
