"""``gpuvision inspect``: measure solder paste, or the coplanarity of leads, in a height map."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

import typer

from gpuvision.cli.arguments import (
    LayerNames,
    Overwrite,
    ReportFile,
    check_exists,
    claim_outputs,
    echo,
    echo_warnings,
    layers_of,
    length_of,
    named_path,
    pose_of,
    prints_report,
    quantities,
    reject_unused,
    write_report,
)
from gpuvision.cli.select import Side

if TYPE_CHECKING:
    from gpuvision.formats.height_files import ImageScale
    from gpuvision.inspection.apertures import Aperture
    from gpuvision.inspection.paste import PasteSettings
    from gpuvision.workflows.inspecting_leads import LeadInspection
    from gpuvision.workflows.inspecting_paste import PasteInspection, VolumeLimits

Heights = Annotated[
    Path,
    typer.Argument(
        metavar="HEIGHTS",
        parser=named_path,
        help="Height map: TIFF, PNG or NPZ file of `gpuvision scan`, CSV file of a Gocator, or an image with --cell "
        "and --height-step.",
    ),
]
Results = Annotated[
    Path,
    typer.Option(
        metavar="DIR",
        parser=named_path,
        help="Folder for paste.csv, report.json and the picture volume.png; with --leads for leads.csv, report.json "
        "and coplanarity.png.",
    ),
]
Board = Annotated[
    Path | None,
    typer.Option(metavar="GERBERS", parser=named_path, help="Folder or ZIP of the board's Gerber files."),
]
Stencil = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Thickness of the stencil, such as 120um: the expected height.")
]
Pose = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,THETA",
        help="Known place of the board: position of the origin of its files in the height map and direction of its x "
        "axis, such as 1mm,2mm,90deg. Default: found by the paste.",
    ),
]
InitialPose = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,THETA", help="Place where the search begins. Default: the paste layer centred in the height map."
    ),
]
SearchRange = Annotated[
    str | None,
    typer.Option(metavar="LENGTH,ANGLE", help="Largest shift and rotation of the search. Default: 2mm,3deg."),
]
Threshold = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH", help="Height from which on a cell counts to the area. Default: half of the stencil."
    ),
]
Margin = Annotated[
    str | None,
    typer.Option(metavar="LENGTH", help="Distance from an aperture up to which paste belongs to it. Default: 50um."),
]
Ring = Annotated[
    str | None,
    typer.Option(metavar="LENGTH", help="Width of the ring in which the board is the reference. Default: 0.2mm."),
]
Order = Annotated[
    int | None, typer.Option(min=0, max=2, help="Order of the reference surface: 1 (default) is a plane.")
]
PadHeight = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Height of the bare pad above the reference surface. Default: 0.")
]
MinimumVolume = Annotated[
    float | None,
    typer.Option(min=0.0, help="Least volume that passes, as a fraction of the expected one. Default: 0.5."),
]
MaximumVolume = Annotated[
    float | None,
    typer.Option(min=0.0, help="Largest volume that passes, as a fraction of the expected one. Default: 1.5."),
]
PinNames = Annotated[
    bool,
    typer.Option(
        "--pin-names",
        help="Name apertures by part and pin of the pads below them, such as U3.5 (Gerber X2). Default: numbers.",
    ),
]
Leads = Annotated[
    str | None,
    typer.Option(
        metavar="FILE.csv|PART",
        help="Measure the coplanarity of leads or balls instead of paste: a CSV file "
        "(name,x,y,width,height[,angle] in m and rad), or a part of --board at --pose, such as U3. The height map "
        "shows the leads from their tips.",
    ),
]
Centre = Annotated[
    str | None,
    typer.Option(metavar="X,Y", help="Centre of gravity in the coordinates of the leads. Default: mean of the leads."),
]
MaximumGap = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Largest distance from the seating plane that passes.")
]
Sigma = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Random standard deviation of the heights. Default: from the height map, or else estimated.",
    ),
]
CorrelationArea = Annotated[
    float | None,
    typer.Option(min=1.0, help="Number of cells whose noise is common. Default: estimated; with --leads 1."),
]
ScaleSigmas = Annotated[
    str | None,
    typer.Option(
        metavar="HEIGHT,LATERAL",
        help="Relative standard deviations of the scales of heights and of x and y, such as 0.002,0.001: systematic "
        "errors, stated apart.",
    ),
]
Cell = Annotated[
    str | None, typer.Option(metavar="LENGTH[,LENGTH]", help="Size of a pixel of an image of heights, in x and y.")
]
HeightStep = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Height of one grey level of an image of heights.")
]
HeightOffset = Annotated[
    str | None, typer.Option(metavar="LENGTH", help="Height of the grey level 0 of an image of heights. Default: 0.")
]
Hole = Annotated[
    float | None, typer.Option(help="Grey level of pixels without a height, of an image of heights. Default: 0.")
]


def inspect(
    heights: Heights,
    out: Results,
    board: Board = None,
    stencil: Stencil = None,
    side: Annotated[Side | None, typer.Option(help="Side of the board that carries the paste. Default: top.")] = None,
    layers: LayerNames = None,
    pose: Pose = None,
    initial_pose: InitialPose = None,
    search_range: SearchRange = None,
    threshold: Threshold = None,
    margin: Margin = None,
    ring: Ring = None,
    reference_order: Order = None,
    pad_height: PadHeight = None,
    minimum_volume: MinimumVolume = None,
    maximum_volume: MaximumVolume = None,
    pin_names: PinNames = False,
    leads: Leads = None,
    centre: Centre = None,
    maximum_gap: MaximumGap = None,
    sigma: Sigma = None,
    correlation_area: CorrelationArea = None,
    scale_sigma: ScaleSigmas = None,
    cell: Cell = None,
    height_step: HeightStep = None,
    height_offset: HeightOffset = None,
    hole: Hole = None,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure solder paste on a board, or the coplanarity of leads, in a height map.

    Each measured quantity has a standard deviation. Of each aperture of the board's paste layer: volume, area, mean and
    largest height, offset. Of each lead or ball: distance from the seating plane and from the least-squares plane.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.workflows.inspecting_leads import LEAD_FILES
    from gpuvision.workflows.inspecting_paste import PASTE_FILES

    check_exists(heights)
    lead_file = Path(leads) if leads is not None and leads.lower().endswith(".csv") else None
    names = PASTE_FILES if leads is None else LEAD_FILES
    outputs = claim_outputs("inspect", (heights, board, lead_file), (out, names), as_json, overwrite=overwrite)
    common = _Common(
        heights=heights,
        scale=_image_scale(cell, height_step, height_offset, hole),
        board=board,
        side="bottom" if side is Side.bottom else "top",
        layers=layers,
        pose=pose_of(pose, "--pose"),
        sigma=_sigma(sigma),
        correlation_area=_correlation_area(correlation_area),
    )
    paste = _PasteOptions(
        stencil=stencil,
        initial_pose=initial_pose,
        search_range=search_range,
        threshold=threshold,
        margin=margin,
        ring=ring,
        reference_order=reference_order,
        pad_height=pad_height,
        minimum_volume=minimum_volume,
        maximum_volume=maximum_volume,
        scale_sigma=scale_sigma,
        pin_names=pin_names,
    )
    found: PasteInspection | LeadInspection
    if leads is not None:
        reject_unused("with --leads", **paste._asdict())
        found = _inspect_leads(
            common, leads, lead_file, side_given=side is not None, centre=centre, maximum_gap=maximum_gap
        )
    else:
        reject_unused("without --leads", centre=centre, maximum_gap=maximum_gap)
        found = _inspect_paste(common, paste)
    echo_warnings(found.warnings(), err=True)
    found.write(out, overwrite=overwrite)
    write_report(as_json, found.report(), outputs)
    picture = out / ("volume.png" if leads is None else "coplanarity.png")
    echo(f"{found.summary()}\nlook at {picture} and {out / 'report.json'}", err=prints_report(as_json))


class _Common(NamedTuple):
    """Parsed options that the inspections of paste and of leads share."""

    heights: Path
    scale: ImageScale | None
    board: Path | None
    side: Literal["top", "bottom"]
    layers: list[str] | None
    pose: tuple[float, float, float] | None
    sigma: float | None
    correlation_area: float | None


class _PasteOptions(NamedTuple):
    """Options of the inspection of paste alone, as they were given."""

    stencil: str | None
    initial_pose: str | None
    search_range: str | None
    threshold: str | None
    margin: str | None
    ring: str | None
    reference_order: int | None
    pad_height: str | None
    minimum_volume: float | None
    maximum_volume: float | None
    scale_sigma: str | None
    pin_names: bool

    def settings(self, stencil: str) -> PasteSettings:
        """Parse the settings of the measurement of paste."""
        from gpuvision.inspection.paste import PasteSettings

        return PasteSettings(
            stencil=quantities(stencil, "--stencil", "m")[0],
            threshold=length_of(self.threshold, "--threshold"),
            margin=quantities(self.margin or "50um", "--margin", "m")[0],
            ring=quantities(self.ring or "0.2mm", "--ring", "m")[0],
            reference_order=1 if self.reference_order is None else self.reference_order,
            pad_height=quantities(self.pad_height or "0", "--pad-height", "m")[0],
        )

    @property
    def limits(self) -> VolumeLimits:
        """Limits of the verdicts, 50 % and 150 % by default."""
        from gpuvision.workflows.inspecting_paste import VolumeLimits

        least, most = self.minimum_volume, self.maximum_volume
        return VolumeLimits(minimum=0.5 if least is None else least, maximum=1.5 if most is None else most)

    @property
    def reach(self) -> tuple[float, float]:
        """Search range: shift [m] and rotation [rad]."""
        from gpuvision.validation import finite

        shift, turn = quantities(self.search_range or "2mm,3deg", "--search-range", "m,rad")
        return (
            finite(shift, "the shift of --search-range", minimum=0.0),
            finite(turn, "the rotation of --search-range", minimum=0.0),
        )


def _inspect_leads(
    common: _Common,
    leads: str,
    lead_file: Path | None,
    *,
    side_given: bool,
    centre: str | None,
    maximum_gap: str | None,
) -> LeadInspection:
    """Measure the leads of a CSV file or of a part of the board."""
    from gpuvision.formats.height_files import read_heights
    from gpuvision.inspection.apertures import BoardPlacement
    from gpuvision.workflows.inspecting_leads import inspect_leads

    pose = common.pose
    regions = _regions(leads, lead_file, common.board, common.layers, common.side)
    if lead_file is None and pose is None:
        raise ValueError(f"--leads is {leads!r}, a part: give --pose too, or a CSV file of leads")
    if pose is None:
        reject_unused("without --pose", side=side_given)
    # A part with its leads up is the mirror image of its pads.
    mirrored = (common.side == "top") == (lead_file is None)
    placement = None
    if pose is not None:
        placement = BoardPlacement(x=pose[0], y=pose[1], theta=pose[2], side="bottom" if mirrored else "top")
    gravity = None if centre is None else quantities(centre, "--centre", "m,m")
    return inspect_leads(
        read_heights(common.heights, common.scale),
        regions,
        placement=placement,
        sigma=common.sigma,
        correlation_area=common.correlation_area or 1.0,
        centre=None if gravity is None else (gravity[0], gravity[1]),
        maximum=length_of(maximum_gap, "--maximum-gap"),
        files={
            "height_map": str(common.heights),
            **({} if common.board is None else {"board": str(common.board)}),
            "leads": leads,
        },
    )


def _inspect_paste(common: _Common, options: _PasteOptions) -> PasteInspection:
    """Measure the solder paste of a board."""
    from gpuvision.formats.height_files import read_heights
    from gpuvision.inspection.apertures import read_apertures
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.workflows.inspecting_paste import ScaleSigma, inspect_paste

    board = common.board
    if board is None or options.stencil is None:
        missing = "--board" if board is None else "--stencil"
        raise ValueError(f"{missing} is missing; expected a board with its stencil, or --leads")
    if common.pose is not None:
        given = {"initial_pose": options.initial_pose, "search_range": options.search_range}
        reject_unused("with --pose, a known place", **given)
    settings, limits = options.settings(options.stencil), options.limits
    scales = None if options.scale_sigma is None else ScaleSigma(**_scale_sigmas(options.scale_sigma))
    reach, layers = options.reach, layers_of(common.layers)
    pads = read_artwork(board, side=common.side, layers=layers).pads if options.pin_names else ()
    return inspect_paste(
        read_heights(common.heights, common.scale),
        read_apertures(board, side=common.side, layers=layers, pads=pads),
        settings,
        side=common.side,
        pose=common.pose,
        initial_pose=pose_of(options.initial_pose, "--initial-pose"),
        search_range=reach,
        sigma=common.sigma,
        correlation_area=common.correlation_area,
        limits=limits,
        scale_sigma=scales,
        files={"height_map": str(common.heights), "board": str(board)},
    )


def _regions(
    leads: str, lead_file: Path | None, board: Path | None, layers: list[str] | None, side: Literal["top", "bottom"]
) -> tuple[Aperture, ...]:
    """Return the regions of leads: of a CSV file, or the pads of a part of the board."""
    from gpuvision.formats.leads_file import read_leads
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.workflows.inspecting_leads import pads_of_part

    if lead_file is not None:
        reject_unused("with a CSV file of leads", board=board, layers=layers)
        return read_leads(lead_file)
    if board is None:
        raise ValueError(f"--leads is {leads!r}, a part: give --board too, or a CSV file of leads")
    return pads_of_part(read_artwork(board, side=side, layers=layers_of(layers)).pads, leads)


def _sigma(text: str | None) -> float | None:
    """Parse ``--sigma``: a length above 0; None without the option."""
    from gpuvision.validation import finite

    return None if text is None else finite(length_of(text, "--sigma"), "--sigma", above=0.0)


def _correlation_area(number: float | None) -> float | None:
    """Check ``--correlation-area``: 1 or more; None without the option."""
    from gpuvision.validation import finite

    return None if number is None else finite(number, "--correlation-area", minimum=1.0)


def _scale_sigmas(text: str) -> dict[str, float]:
    try:
        height, lateral = (float(each) for each in text.split(","))
    except ValueError:
        raise ValueError(f"--scale-sigma is {text!r}, expected two numbers, such as 0.002,0.001") from None
    return {"height": height, "lateral": lateral}


def _image_scale(cell: str | None, step: str | None, offset: str | None, hole: float | None) -> ImageScale | None:
    """Return the scale of an image of heights; None without --cell and --height-step."""
    from gpuvision.formats.height_files import ImageScale

    if cell is None and step is None:
        reject_unused("without --cell and --height-step", height_offset=offset, hole=hole)
        return None
    if cell is None or step is None:
        raise ValueError(f"{'--cell' if cell is None else '--height-step'} is missing; an image of heights needs both")
    cells = quantities(cell, "--cell", "m,m" if "," in cell else "m")
    return ImageScale(
        cell_x=cells[0],
        cell_y=cells[-1],
        step=quantities(step, "--height-step", "m")[0],
        offset=length_of(offset, "--height-offset") or 0.0,
        hole=0.0 if hole is None else hole,
    )
