"""``gpuvision locate``: where a camera is over a board, or a robot on its field."""

from __future__ import annotations

import json
import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import DeviceLabel, LayerNames, layers_of, named_path, quantities
from gpuvision.cli.select import Side

if TYPE_CHECKING:
    from collections.abc import Callable

    from gpuvision.matching.board.located_board import LocatedBoard
    from gpuvision.matching.field.located_robot import LocatedRobot


class Copper(StrEnum):
    """What ``--copper`` takes."""

    auto = "auto"
    bright = "bright"
    dark = "dark"


Image = Annotated[
    Path,
    typer.Argument(
        metavar="IMAGE", parser=named_path, help="Image; for a field also points on lines: NPY or CSV, in metres."
    ),
]
Board = Annotated[
    Path | None,
    typer.Option(metavar="GERBERS", parser=named_path, help="The board: folder, or ZIP, of Gerber and Excellon files."),
]
FieldFile = Annotated[
    str | None, typer.Option(metavar="FIELD", help="The field: a TOML file; or robocup_msl, robocup_junior.")
]
Scale = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Of a pixel on the board or floor: 25e-6 (m), or 25um.")
]
Near = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,THETA",
        help="About where: what the image's middle sees, as 12mm,8mm,90deg. Otherwise a board is searched about its "
        "middle, a field everywhere.",
    ),
]
Within = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH,ANGLE",
        help="How far from there a board may be; otherwise 100um,0.3deg, and 2mm,5deg without --near.",
    ),
]
Lens = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.toml",
        parser=named_path,
        help="What `gpuvision calibrate` wrote. On a field it may hold a table `mount`, too (height, tilt_degrees): "
        "the image is then no top view but what a camera on the robot sees, and has no --scale.",
    ),
]
Features = Annotated[
    Path | None, typer.Option(metavar="FILE.toml", parser=named_path, help="What `gpuvision select` wrote.")
]
Results = Annotated[
    Path | None, typer.Option(metavar="DIR", parser=named_path, help="Folder for pose.json and located.png.")
]
JsonFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE", parser=named_path, help="Write the pose there, too.")
]
Budget = Annotated[int, typer.Option(min=3, max=1000, help="Rulers on a board, without --features.")]
Blur = Annotated[float | None, typer.Option(min=0.1, help="Of a board's edges, std in pixels; otherwise 1.")]
Etch = Annotated[str, typer.Option(metavar="LENGTH", help="How far copper is etched beside its edges, std.")]
Threshold = Annotated[
    float | None, typer.Option(min=0.0, help="Least edge, in grey levels; otherwise by the image's noise and range.")
]
LineWidth = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Of a field's lines; otherwise 125mm, on small fields 20mm.")
]
Blind = Annotated[
    str, typer.Option(metavar="LENGTH", help="So far from its middle a floor's image shows the robot itself.")
]
OfCopper = Annotated[Copper, typer.Option(help="Beside what surrounds it; auto: as more rulers agree.")]


def locate(
    image: Image,
    board: Board = None,
    field: FieldFile = None,
    scale: Scale = None,
    near: Near = None,
    within: Within = None,
    camera: Lens = None,
    features: Features = None,
    side: Annotated[Side | None, typer.Option(help="Of the board; otherwise top.")] = None,
    layers: LayerNames = None,
    budget: Budget = 60,
    blur: Blur = None,
    etch: Etch = "10um",
    copper: OfCopper = Copper.auto,
    threshold: Threshold = None,
    line_width: LineWidth = None,
    blind: Blind = "0",
    out: Results = None,
    as_json: JsonFile = None,
    device: DeviceLabel = None,
) -> None:
    """Locate a camera over a board, or a robot on its field, by an IMAGE: a pose with its standard deviations.

    The camera looks straight at it. The pose is the place that the image's middle sees, and the direction of its
    columns from left to right; for a field, where the robot in the middle of a top view is, and where it heads: to the
    right. All candidates are told: a symmetric field has two that look alike.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.host.files import check_file, check_folder

    if (board is None) == (field is None):
        raise ValueError("expected --board GERBERS or --field FIELD, one of the two")
    if out is not None:
        check_folder(out)
    if as_json is not None:
        check_file(as_json)
    if not image.exists():
        raise FileNotFoundError(f"{image}: there is no such file")
    about = None if near is None else quantities(near, "--near", "m,m,rad")
    given: dict[str, Any] = {
        "about": about,
        "scale": None if scale is None else quantities(scale, "--scale", "m")[0],
        "threshold": threshold,
        "camera": camera,
        "device": device,
    }
    located: LocatedBoard | LocatedRobot
    if field is not None:
        _reject_for_field({"within": within, "features": features, "side": side, "blur": blur, "layers": layers})
        located, draw = _robot(image, field, line_width, quantities(blind, "--blind", "m")[0], **given)
    else:
        assert board is not None  # one of the two
        more: dict[str, Any] = {"within": within, "features": features, "side": side, "budget": budget, "blur": blur}
        more["layers"] = layers
        located, draw = _board(image, board, etch=etch, copper=copper, **more, **given)
    _tell(located, draw, out, as_json)


def _reject_for_field(given: dict[str, Any]) -> None:
    for name, value in given.items():
        if value:
            raise ValueError(f"--{name} is of --board, not of --field; leave it out")


def _robot(
    image: Path,
    field: str,
    line_width: str | None,
    blind: float,
    *,
    about: Any,
    scale: float | None,
    threshold: float | None,
    camera: Path | None,
    device: str | None,
) -> tuple[LocatedRobot, Callable[[Path], None]]:
    from gpuvision.formats.camera_file import read_lens, read_mounted
    from gpuvision.formats.field_file import read_field
    from gpuvision.host import Device
    from gpuvision.plots.field import draw_located_robot
    from gpuvision.workflows.locating_robot import (
        POINT_FILES,
        line_width_of,
        locate_robot,
        read_floor,
        read_points,
        scan_floor,
    )

    described = read_field(field)
    chosen = None if device is None else Device.named(device)
    picture = None
    if image.suffix.lower() in POINT_FILES:
        located = locate_robot(read_points(image), described, near=about, scale=scale, device=chosen)
    else:
        picture = read_floor(image)
        mounted = None if camera is None else read_mounted(camera, picture.shape[:2])
        if scale is None and mounted is None:
            raise ValueError("--scale is missing: how wide a pixel is on the floor, as 1cm")
        if scale is not None and mounted is not None:
            raise ValueError(f"--scale is of top views, but {camera} says how it is mounted; leave one out")
        wide = line_width_of(described) if line_width is None else quantities(line_width, "--line-width", "m")[0]
        scan = scan_floor(
            picture,
            scale=scale,
            line_width=wide,
            blind=blind,
            threshold=threshold,
            model=mounted or (None if camera is None else read_lens(camera)),
            device=chosen,
        )
        located = locate_robot(scan, described, near=about, scale=scale, device=chosen)
    return located, lambda path: draw_located_robot(path, located, picture)


def _board(
    image: Path,
    board: Path,
    *,
    within: str | None,
    features: Path | None,
    side: Side | None,
    layers: list[str] | None,
    budget: int,
    blur: float | None,
    etch: str,
    copper: Copper,
    about: Any,
    scale: float | None,
    threshold: float | None,
    camera: Path | None,
    device: str | None,
) -> tuple[LocatedBoard, Callable[[Path], None]]:
    from gpuvision.formats.camera_file import read_lens
    from gpuvision.formats.features_file import read_features
    from gpuvision.host import Device
    from gpuvision.host.recordings import read_image
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.features.feature_set import clearance_of
    from gpuvision.matching.features.selection import Imaging
    from gpuvision.plots.board import draw_located_board
    from gpuvision.workflows.locating_board import locate_board

    chosen = None if features is None else read_features(features)
    if scale is None and chosen is None:
        raise ValueError("--scale is missing: how wide a pixel is on the board, as 25um")
    if chosen is not None and side is not None and side.value != chosen.side:
        raise ValueError(f"--side is {side.value}, but {features} is of the {chosen.side}; leave it out")
    picture = read_image(image)
    of = chosen.side if chosen is not None else "top" if side is None else side.value
    pixel = chosen.imaging.pixel if scale is None and chosen is not None else float(scale or 0.0)
    blur_px = blur or (1.0 if chosen is None else chosen.imaging.blur_px)
    clearance = clearance_of(Imaging(pixel=pixel, blur_px=blur_px) if chosen is None else chosen.imaging)
    artwork = read_artwork(board, side=of, layers=layers_of(layers), clearance=clearance)
    located = locate_board(
        picture,
        artwork,
        scale=pixel,
        near=about,
        within=None if within is None else quantities(within, "--within", "m,rad"),  # type: ignore[arg-type]
        features=chosen,
        model=None if camera is None else read_lens(camera),
        budget=budget,
        blur_px=blur_px,
        etch=quantities(etch, "--etch", "m")[0],
        threshold=threshold,
        copper=copper.value,
        device=None if device is None else Device.named(device),
    )
    return located, lambda path: draw_located_board(path, picture, artwork, located)


def _tell(
    located: LocatedBoard | LocatedRobot, draw: Callable[[Path], None], out: Path | None, as_json: Path | None
) -> None:
    """Write what was found, or not; a pose that is refused is an error, with a picture that shows why."""
    from gpuvision.host.files import replacing, whole_folder

    text = json.dumps(located.report(), indent=1, allow_nan=False) + "\n"
    if as_json is not None:
        with replacing(as_json) as file:
            file.write(text.encode())
    shown = ""
    if out is not None:
        with whole_folder(out) as inside:
            (inside / "pose.json").write_text(text)
            draw(inside / "located.png")
        shown = f"look at {out / 'located.png'} and {out / 'pose.json'}"
    if located.reason:
        raise ValueError(f"no pose: {located.reason}{'; ' + shown if shown else ''}")
    typer.echo("\n".join(filter(None, (located.summary(), shown))))
