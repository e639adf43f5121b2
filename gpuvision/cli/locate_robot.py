"""``gpuvision locate-robot``: find the pose of a robot on a field with marked lines."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    Overwrite,
    ReportFile,
    check_exists,
    claim_outputs,
    device_of,
    echo,
    echo_warnings,
    length_of,
    named_path,
    pose_of,
    prints_report,
    quantities,
    reject_unused,
    write_report,
)
from gpuvision.cli.pose_output import POSE_FILES, PoseFolder, report_pose

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from gpuvision.matching.field.distance_map import Field
    from gpuvision.matching.field.line_detection import FloorScan

_WITH_POINTS = "with a file of points, only with an image"

Input = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        parser=named_path,
        help="Image of the floor: a top view with the robot in the middle, or the view of a camera on the robot; "
        "points on lines (NPY or CSV, metres, x ahead, y to the left); or, with --rate, a recording of such images.",
    ),
]
FieldFile = Annotated[
    str,
    typer.Option(metavar="FIELD", help="Field file (TOML) with the lines, or a preset: robocup_msl, robocup_junior."),
]
Scale = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Size of a pixel on the floor in a top view, such as 1cm.")
]
InitialPose = Annotated[
    str | None,
    typer.Option(metavar="X,Y,THETA", help="Approximate pose, such as 1m,2m,90deg. Default: search the whole field."),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml",
        parser=named_path,
        help="Camera file of `gpuvision calibrate`. With a table [mount] (height, tilt_degrees) the image is the view "
        "of that camera on the robot; leave out --scale.",
    ),
]
Threshold = Annotated[
    float | None,
    typer.Option(
        min=0.0, help="Smallest height of an edge [grey levels]. Default: from the noise and the range of the image."
    ),
]
LineWidth = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Width of the lines. Default: 125mm; 20mm on fields under 5 m.")
]
BlindRadius = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH", help="Radius of the area in the middle of a top view that shows the robot itself. Default: 0."
    ),
]


FrameRate = Annotated[
    float | None,
    typer.Option(
        metavar="FPS",
        min=1e-3,
        max=1e7,
        help="INPUT is a recording with this number of frames per second: follow the robot through it. DIR gets "
        "track.csv, track.json and track.png.",
    ),
]
OdometryFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        parser=named_path,
        help="Motions between the frames: header forward,left,turn [m, m, rad], one line for each frame after the "
        "first; with --rate. Default: unknown motion.",
    ),
]


def locate_robot(
    source: Input,
    field: FieldFile,
    scale: Scale = None,
    initial_pose: InitialPose = None,
    camera: CameraFile = None,
    line_width: LineWidth = None,
    blind_radius: BlindRadius = None,
    threshold: Threshold = None,
    rate: FrameRate = None,
    odometry: OdometryFile = None,
    out: PoseFolder = None,
    as_json: ReportFile = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Locate a robot on a field from the white lines around it: candidate poses with standard deviations.

    The pose is the position of the robot on the field [m] and its heading [rad]. A symmetric field has two poses that
    look alike; both are listed. INPUT that does not fit the field is refused with a reason. Over a recording, odometry
    and views are filtered: symmetric poses, views that are wrong, and a robot that is carried elsewhere.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.formats.camera_file import check_calibrated_size, read_calibrated_size
    from gpuvision.formats.field_file import read_field
    from gpuvision.host import StepDevices
    from gpuvision.operation import KERNEL_FOLDER
    from gpuvision.plots.field import draw_located_robot
    from gpuvision.workflows.locating_robot import POINT_FILES, read_floor, read_points
    from gpuvision.workflows.locating_robot import locate_robot as locate

    check_exists(source)
    pose = pose_of(initial_pose, "--initial-pose")
    pixel = length_of(scale, "--scale")
    described = read_field(field)
    chosen = device_of(device)
    if rate is not None:
        files = _TrackFiles((source, field, camera, odometry), out, as_json, overwrite)
        sizes = (camera, pixel, line_width, blind_radius)
        _track(source, described, rate, odometry, sizes, files, initial_pose=pose, threshold=threshold, device=chosen)
        return
    reject_unused("without --rate", odometry=odometry)
    outputs = claim_outputs("locate-robot", (source, field, camera), as_json, (out, POSE_FILES), overwrite=overwrite)
    devices = StepDevices(chosen, kernel_folders=(KERNEL_FOLDER,))
    picture = None
    measured: npt.NDArray[np.float32] | FloorScan
    if source.suffix.lower() in POINT_FILES:
        reject_unused(
            _WITH_POINTS,
            scale=scale,
            camera=camera,
            line_width=line_width,
            blind_radius=blind_radius,
            threshold=threshold,
        )
        measured = read_points(source)
    else:
        picture = read_floor(source)
        if camera is not None:
            check_calibrated_size(source, (picture.shape[1], picture.shape[0]), read_calibrated_size(camera))
        measured = _scan(
            picture, described, camera, pixel, line_width, blind_radius, threshold=threshold, device=devices
        )
    located = locate(measured, described, initial_pose=pose, scale=pixel, device=devices)
    echo_warnings(located.warnings, err=True)
    report_pose(located, lambda path: draw_located_robot(path, located, picture), out, as_json, outputs)


class _TrackFiles(NamedTuple):
    """Inputs of a track, and where its results go."""

    inputs: tuple[str | Path | None, ...]
    out: Path | None
    as_json: Path | None
    overwrite: bool


def _track(
    source: Path,
    field: Field,
    rate: float,
    odometry: Path | None,
    sizes: tuple[Path | None, float | None, str | None, str | None],
    files: _TrackFiles,
    **settings: Any,
) -> None:
    """Follow a robot through a recording and write its track."""
    from gpuvision.host import open_recording
    from gpuvision.host.errors import RecordingError
    from gpuvision.workflows.tracking_robot import TRACK_FILES, read_odometry, track_robot

    targets = (files.as_json, (files.out, TRACK_FILES))
    outputs = claim_outputs("locate-robot", files.inputs, *targets, overwrite=files.overwrite)
    motions = None if odometry is None else read_odometry(odometry)
    views = open_recording(source)
    how = _scan_settings((int(views.shape[0]), int(views.shape[1])), field, *sizes)
    track = track_robot(views, field, rate=rate, odometry=motions, **how, **settings)
    write_report(files.as_json, track.report(), outputs)
    shown = ""
    if files.out is not None:
        with outputs.folder(files.out) as inside:
            track.write(inside)
        shown = f"look at {files.out / 'track.png'} and {files.out / 'track.csv'}"
    echo_warnings(track.warnings(), err=True)
    problem = track.problem()
    if problem is not None:
        raise RecordingError("; ".join(each for each in (problem, shown) if each))
    echo("\n".join(each for each in (track.summary(), shown) if each), err=prints_report(files.as_json))


def _scan(
    picture: npt.NDArray[np.generic],
    field: Field,
    camera: Path | None,
    scale: float | None,
    line_width: str | None,
    blind_radius: str | None,
    **settings: Any,
) -> FloorScan:
    """Find points on the lines of the floor in a top view, or in the view of a camera on the robot."""
    from gpuvision.workflows.locating_robot import scan_floor

    shape = (int(picture.shape[0]), int(picture.shape[1]))
    return scan_floor(picture, **_scan_settings(shape, field, camera, scale, line_width, blind_radius), **settings)


def _scan_settings(
    shape: tuple[int, int],
    field: Field,
    camera: Path | None,
    scale: float | None,
    line_width: str | None,
    blind_radius: str | None,
) -> dict[str, Any]:
    """Return the parameters of `scan_floor` for images of one shape."""
    from gpuvision.formats.camera_file import read_lens, read_mounted
    from gpuvision.workflows.locating_robot import default_line_width

    mounted = None if camera is None else read_mounted(camera, shape)
    if mounted is not None:
        reason = f"with {camera}, whose table [mount] gives height and tilt"
        reject_unused(reason, scale=scale, blind_radius=blind_radius)
    elif scale is None:
        raise ValueError("--scale is missing: the size of a pixel on the floor, such as 1cm")
    width = default_line_width(field) if line_width is None else quantities(line_width, "--line-width", "m")[0]
    return {
        "scale": scale,
        "line_width": width,
        "blind": 0.0 if blind_radius is None else quantities(blind_radius, "--blind-radius", "m")[0],
        "model": mounted or (None if camera is None else read_lens(camera)),
    }
