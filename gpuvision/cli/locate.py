"""``gpuvision locate``: find the pose of a circuit board in a camera image."""

from __future__ import annotations

import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    LayerNames,
    Overwrite,
    ReportFile,
    check_exists,
    claim_outputs,
    command_line,
    device_of,
    echo,
    echo_warnings,
    layers_of,
    named_path,
    pose_of,
    prints_report,
    quantities,
    reject_unused,
)
from gpuvision.cli.plan_output import claim_plan, planned_tolerance, planning, report_plan
from gpuvision.cli.pose_output import POSE_FILES, PoseFolder, report_pose
from gpuvision.cli.select import Side

if TYPE_CHECKING:
    import numpy.typing as npt

    from gpuvision.host.outputs import Outputs
    from gpuvision.matching.artwork.artwork import Artwork
    from gpuvision.matching.board.located_board import LocatedBoard
    from gpuvision.matching.features.feature_set import FeatureSet
    from gpuvision.workflows.location_plan import LocationPlan

_BUDGET, _BLUR_PX, _ETCH_BIAS = 60, 1.0, "10um"
_IN_COMMENTS = str.maketrans("()\n\r", "[]  ")  # characters that would end a comment of G-code


class GcodeDialect(StrEnum):
    """Values of ``--gcode-dialect``."""

    linuxcnc = "linuxcnc"
    fanuc = "fanuc"


class Copper(StrEnum):
    """Values of ``--copper``."""

    auto = "auto"
    bright = "bright"
    dark = "dark"


Image = Annotated[
    Path,
    typer.Argument(
        metavar="IMAGE", parser=named_path, help="Image of a camera that looks at the board at right angles."
    ),
]
Board = Annotated[
    Path,
    typer.Option(metavar="GERBERS", parser=named_path, help="Folder or ZIP of the board's Gerber and Excellon files."),
]
Scale = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH", help="Size of a pixel on the board: 25e-6 (m) or 25um. Default: the value in --features."
    ),
]
InitialPose = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,THETA",
        help="Approximate pose: board point at the image centre and rotation, such as 12mm,8mm,90deg. "
        "Default: search around the middle of the board.",
    ),
]
SearchRange = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH,ANGLE",
        help="Largest distance and rotation from the expected pose. Default: 2mm,5deg; with "
        "--initial-pose the value in --features, or 100um,0.3deg.",
    ),
]
CameraFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml", parser=named_path, help="Camera file of `gpuvision calibrate`. Default: no distortion."
    ),
]
Features = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml", parser=named_path, help="Features file of `gpuvision select`. Default: select now."
    ),
]
Budget = Annotated[
    int | None,
    typer.Option(min=3, max=1000, help=f"Number of calipers (rulers); not with --features. Default: {_BUDGET}."),
]
Blur = Annotated[
    float | None,
    typer.Option(
        min=0.1, help=f"Edge blur, standard deviation [px]. Default: {_BLUR_PX:g}, or the value in --features."
    ),
]
EtchBias = Annotated[
    str, typer.Option(metavar="LENGTH", help="Over- or under-etch of copper edges, standard deviation.")
]
Threshold = Annotated[
    float | None,
    typer.Option(
        min=0.0, help="Smallest height of an edge [grey levels]. Default: from the noise and the range of the image."
    ),
]
GcodeFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        parser=named_path,
        help="G-code that sets the work offset G54 and the rotation of the board on the machine; with --camera-at.",
    ),
]
CameraAt = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,ANGLE",
        help="Machine coordinates of the point at the image centre (axes plus offset of the camera from the tool), and "
        "direction of the image columns, such as 120mm,80mm,0deg; with --gcode.",
    ),
]
GcodeDialectChoice = Annotated[
    GcodeDialect | None,
    typer.Option(help="linuxcnc: G10 L2 with R; fanuc: G10 L2, then G68 (Fanuc, Mach3, Mach4). Default: linuxcnc."),
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Largest error of the pose at the features of the board, such as 2um: choose number, width and smoothing "
        "of the calipers (rulers), the fastest that are predicted to meet it on this image.",
    ),
]
Rate = Annotated[
    float | None,
    typer.Option(help="With --tolerance: rate that measuring the chosen features must keep up with [frames/s]."),
]
OnlyPlan = Annotated[
    bool,
    typer.Option(
        "--plan",
        help="With --tolerance: only print the features that were tried with their predicted errors and times, and "
        "write plan.png and features.toml to --out. No pose.",
    ),
]
CopperChoice = Annotated[
    Copper, typer.Option(help="Copper is brighter or darker than its surroundings; auto: the better fit of both.")
]


def locate(
    image: Image,
    board: Board,
    scale: Scale = None,
    initial_pose: InitialPose = None,
    search_range: SearchRange = None,
    camera: CameraFile = None,
    features: Features = None,
    side: Annotated[
        Side | None, typer.Option(help="Side of the board. Default: top, or the value in --features.")
    ] = None,
    layers: LayerNames = None,
    budget: Budget = None,
    blur: Blur = None,
    etch_bias: EtchBias = _ETCH_BIAS,
    copper: CopperChoice = Copper.auto,
    threshold: Threshold = None,
    gcode: GcodeFile = None,
    camera_at: CameraAt = None,
    gcode_dialect: GcodeDialectChoice = None,
    tolerance: Tolerance = None,
    rate: Rate = None,
    only_plan: OnlyPlan = False,
    out: PoseFolder = None,
    as_json: ReportFile = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Locate a circuit board in an IMAGE: pose with standard deviations, from edges and fiducials.

    The pose is the board point that the image centre shows, and the direction of the image columns on the board. A pose
    that the image does not support is refused with a reason. For robots on a field: gpuvision locate-robot.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.formats.camera_file import read_lens
    from gpuvision.plots.board import draw_located_board
    from gpuvision.workflows.locating_board import locate_board

    check_exists(image)
    largest = planned_tolerance(tolerance, "the pose, such as 2um", only_plan=only_plan)
    if largest is None:
        reject_unused("without --tolerance", rate=rate)
    else:
        reject_unused("with --tolerance, which chooses the features", features=features, budget=budget)
    outputs = _claim((image, board, camera, features), out, as_json, gcode, overwrite=overwrite, only_plan=only_plan)
    machine = _camera_at(camera_at, gcode, gcode_dialect)
    chosen = None if features is None else _features(features, budget, side)
    # Check the options before the files, which take longer to read.
    options: dict[str, Any] = {
        "scale": _pixel(scale, chosen),
        "blur_px": blur or (_BLUR_PX if chosen is None else chosen.imaging.blur_px),
        "initial_pose": pose_of(initial_pose, "--initial-pose"),
        "search_range": _search_range(search_range),
        "etch_bias_sigma": quantities(etch_bias, "--etch-bias", "m")[0],
        "threshold": threshold,
        "copper": copper.value,
    }
    picture = _picture(image, camera)
    artwork = _artwork(board, chosen, side, layers, options)
    options |= {"model": None if camera is None else read_lens(camera), "device": device_of(device)}
    if largest is not None:
        plan = _plan(picture, artwork, image.name, largest, rate, options)
        if only_plan:
            _write_plan(plan, image.name, out, as_json, outputs, overwrite=overwrite)
            return
        echo(f"plan: {plan}", err=prints_report(as_json))
        chosen = plan.chosen.features
        options |= {"initial_pose": plan.located.pose, "search_range": None, "copper": plan.located.copper}
    located = locate_board(picture, artwork, features=chosen, budget=budget or _BUDGET, **options)
    echo_warnings(located.warnings, err=True)
    report_pose(located, lambda path: draw_located_board(path, picture, artwork, located), out, as_json, outputs)
    if gcode is not None and machine is not None:
        comment = f"gpuvision locate {image.name}".translate(_IN_COMMENTS)
        outputs.write_text(gcode, _gcode(located, machine, gcode_dialect, comment))


def _claim(
    inputs: Sequence[Path | None],
    out: Path | None,
    as_json: Path | None,
    gcode: Path | None,
    *,
    overwrite: bool,
    only_plan: bool,
) -> Outputs:
    """Check that the files of a pose, or of a plan alone, may be written, before the work."""
    from gpuvision.workflows.location_plan import FEATURES_FILE

    if only_plan:
        reject_unused("with --plan", gcode=gcode)
        return claim_plan(out, as_json, inputs, overwrite=overwrite, more=(FEATURES_FILE,))
    return claim_outputs("locate", inputs, as_json, (out, POSE_FILES), gcode, overwrite=overwrite)


def _picture(image: Path, camera: Path | None) -> npt.NDArray[Any]:
    """Read the image, and check that it has the size for which the camera was calibrated."""
    from gpuvision.formats.camera_file import check_calibrated_size, read_calibrated_size
    from gpuvision.host.image_files import read_image

    picture = read_image(image)
    if camera is not None:
        check_calibrated_size(image, (picture.shape[1], picture.shape[0]), read_calibrated_size(camera))
    return picture


def _plan(
    picture: npt.NDArray[Any],
    artwork: Artwork,
    title: str,
    tolerance: float,
    rate: float | None,
    options: dict[str, Any],
) -> LocationPlan:
    """Choose the features that meet a tolerance [m], with a progress bar."""
    from gpuvision.workflows.planning_location import plan_location

    with planning(title) as progress:
        return plan_location(picture, artwork, tolerance=tolerance, rate=rate, progress=progress, **options)


def _write_plan(
    plan: LocationPlan, title: str, out: Path | None, as_json: Path | None, outputs: Outputs, *, overwrite: bool
) -> None:
    """Print a plan, and write its picture, its features and its report."""
    from gpuvision.workflows.location_plan import FEATURES_FILE

    if out is not None:
        plan.write(out, title=title, overwrite=overwrite)
    report_plan(plan, out, as_json, outputs)
    if out is not None:
        given = command_line("--features", out / FEATURES_FILE)
        echo(f"next: give {given} instead of --tolerance", err=prints_report(as_json))


def _features(file: Path, budget: int | None, side: Side | None) -> FeatureSet:
    """Read ``--features``, and refuse options that contradict the file."""
    from gpuvision.formats.features_file import read_features

    features = read_features(file)
    reject_unused("with --features, a file with a fixed selection of calipers", budget=budget)
    if side is not None and side.value != features.side:
        raise ValueError(f"--side is {side.value}, but the features in {file} are on the {features.side}; leave it out")
    return features


def _gcode(located: LocatedBoard, machine: tuple[float, ...], dialect: GcodeDialect | None, comment: str) -> str:
    """Return the G-code of a located board."""
    from gpuvision.formats.gcode_file import work_offset, work_offset_code

    offset = work_offset(located.pose, machine, mirrored=located.view.mirrored)
    return work_offset_code(offset, (dialect or GcodeDialect.linuxcnc).value, comment)


def _camera_at(text: str | None, gcode: Path | None, dialect: GcodeDialect | None) -> tuple[float, ...] | None:
    """Parse ``--camera-at``: x, y [m] and angle [rad]; None without the option."""
    if gcode is None:
        reject_unused("without --gcode", camera_at=text, gcode_dialect=dialect)
        return None
    if str(gcode) == "-":
        raise ValueError("--gcode is '-', expected the name of a file")
    if text is None:
        raise ValueError("--gcode needs --camera-at: where on the machine the image was taken, such as 120mm,80mm,0deg")
    return quantities(text, "--camera-at", "m,m,rad")


def _search_range(text: str | None) -> tuple[float, float] | None:
    """Parse ``--search-range``: distance [m] and angle [rad]; None without the option."""
    if text is None:
        return None
    distance, angle = quantities(text, "--search-range", "m,rad")
    return distance, angle


def _pixel(scale: str | None, features: FeatureSet | None) -> float:
    """Return the size of a pixel on the board [m]: from ``--scale``, else from the features."""
    if scale is not None:
        return quantities(scale, "--scale", "m")[0]
    if features is None:
        raise ValueError("--scale is missing: the size of a pixel on the board, such as 25um")
    return features.imaging.pixel


def _artwork(
    board: Path, features: FeatureSet | None, side: Side | None, layers: list[str] | None, options: dict[str, Any]
) -> Artwork:
    """Read the side of the board that the features are on, with the clearance that the imaging needs."""
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.features.feature_set import edge_clearance
    from gpuvision.matching.features.imaging import Imaging

    if features is not None:
        imaging, of_board = features.imaging, features.side
    else:
        imaging = Imaging(pixel=options["scale"], blur_px=options["blur_px"])
        of_board = "bottom" if side is Side.bottom else "top"
    return read_artwork(board, side=of_board, layers=layers_of(layers), clearance=edge_clearance(imaging))
