"""``gpuvision select``: choose from the artwork the edges and fiducials that determine the pose of a board best."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import (
    LayerNames,
    Overwrite,
    claim_outputs,
    command_line,
    device_of,
    echo,
    echo_warnings,
    layers_of,
    named_path,
    quantities,
    reject_unused,
)

if TYPE_CHECKING:
    from gpuvision.matching.features.feature_set import BudgetUnit
    from gpuvision.matching.features.imaging import Imaging


class Side(StrEnum):
    """Values of ``--side``."""

    top = "top"
    bottom = "bottom"


Gerbers = Annotated[
    Path, typer.Argument(metavar="GERBERS", parser=named_path, help="Folder or ZIP of Gerber and Excellon files.")
]
Region = Annotated[
    str,
    typer.Option(
        metavar="X0,Y0,X1,Y1",
        help="Region of the board in view, in the coordinates of the files, such as 0,0,12mm,8mm; without a unit: m.",
    ),
]
Budget = Annotated[
    str,
    typer.Option(
        metavar="NUMBER[UNIT]",
        help="Budget of the measurement: number of calipers (60 or 60rulers; a fiducial counts as 16), pixels that "
        "they read (20000px), or time on the device (150us).",
    ),
]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for features.toml and features.png.")
]
Scale = Annotated[str, typer.Option(metavar="LENGTH", help="Size of a pixel on the board: 25e-6 (m) or 25um.")]
Placement = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y", help="Board point whose standard deviations are predicted. Default: middle of the region."
    ),
]
SearchRange = Annotated[
    str,
    typer.Option(metavar="LENGTH,ANGLE", help="Largest displacement and rotation of the board from its expected pose."),
]
Blur = Annotated[float, typer.Option(min=0.1, help="Edge blur, standard deviation [px].")]
Contrasts = Annotated[
    str,
    typer.Option(
        metavar="BARE,MASKED", help="Contrast of bare and of solder-masked copper edges, in units of the noise."
    ),
]
EtchBias = Annotated[
    str, typer.Option(metavar="LENGTH", help="Over- or under-etch of copper edges, standard deviation.")
]
Missing = Annotated[float, typer.Option(min=0.0, max=0.99, help="Expected fraction of edges that are not found.")]


def select(
    gerbers: Gerbers,
    region: Region,
    scale: Scale,
    out: Results,
    budget: Budget = "60rulers",
    placement: Placement = None,
    side: Annotated[Side, typer.Option(help="Side of the board.")] = Side.top,
    search_range: SearchRange = "100um,0.3deg",
    blur: Blur = 1.0,
    contrast: Contrasts = "40,15",
    width: Annotated[
        int, typer.Option(min=1, max=255, help="Width of a caliper (ruler): number of averaged lines.")
    ] = 5,
    etch_bias: EtchBias = "10um",
    missing: Missing = 0.0,
    layers: LayerNames = None,
    device: Annotated[
        str | None,
        typer.Option(
            metavar="LABEL",
            help="Label of the OpenCL device of a --budget in us, see `gpuvision devices`. Default: the best device.",
        ),
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Choose the edges and fiducials of a board that determine its pose best, for `gpuvision locate --features`.

    DIR/features.toml lists the calipers (rulers) with their lengths, the image region that they read, and the predicted
    standard deviations of the pose at the placement point.
    """
    from gpuvision.formats.features_file import write_features
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.board.measurement_result import MeasurementLimits
    from gpuvision.matching.features.feature_set import choose_features, edge_clearance
    from gpuvision.plots.board import draw_features

    box = _box(region)
    amount, unit = _budget(budget)
    if unit != "us":
        reject_unused("without a --budget in us, the only one that is measured on a device", device=device)
    imaging = _imaging(scale, search_range, contrast, etch_bias, blur_px=blur, width_px=width)
    at = None if placement is None else quantities(placement, "--placement", "m,m")
    outputs = claim_outputs("select", [gerbers], (out, ("features.toml", "features.png")), overwrite=overwrite)
    artwork = read_artwork(gerbers, side=side.value, layers=layers_of(layers), clearance=edge_clearance(imaging))
    echo_warnings(artwork.warnings, err=True)
    features = choose_features(
        artwork,
        box,
        imaging,
        placement=at,
        budget=amount,
        unit=unit,
        missing=missing,
        device=device_of(device),
    )
    count, least = len(features.length) + len(features.fiducials.radius), MeasurementLimits().min_count
    if count < least:
        raise ValueError(
            f"the region and the budget give {count} rulers and fiducials, gpuvision locate needs {least} or more; "
            "give a larger --region or --budget"
        )
    with outputs.folder(out) as inside:
        write_features(features, inside / "features.toml")
        draw_features(inside / "features.png", artwork, features, box)
    same_layers = [word for each in layers or () for word in ("--layers", each)]
    words = ("locate", "IMAGE", "--board", gerbers, "--features", out / "features.toml", *same_layers)
    echo(f"{features.summary()}\nlook at {out / 'features.png'}; next: {command_line('gpuvision', *words)}")


def _box(region: str) -> tuple[tuple[float, float], tuple[float, float]]:
    left, bottom, right, top = quantities(region, "--region", "m,m,m,m")
    if not (left < right and bottom < top):
        raise ValueError(f"--region is {region!r}, expected X0 < X1 and Y0 < Y1")
    return (left, bottom), (right, top)


def _imaging(scale: str, search_range: str, contrast: str, etch_bias: str, **settings: Any) -> Imaging:
    """Return the imaging model of the options."""
    from gpuvision.matching.features.imaging import Imaging

    shift, angle = quantities(search_range, "--search-range", "m,rad")
    bare, masked = _contrasts(contrast)
    return Imaging(
        pixel=quantities(scale, "--scale", "m")[0],
        contrast_bare=bare,
        contrast_masked=masked,
        etch_bias_sigma=quantities(etch_bias, "--etch-bias", "m")[0],
        shift=shift,
        angle=angle,
        **settings,
    )


def _budget(text: str) -> tuple[float, BudgetUnit]:
    units: dict[str, BudgetUnit] = {"rulers": "rulers", "px": "px", "us": "us", "µs": "us"}
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(rulers|px|us|µs)?\s*", text)
    if not found or not float(found[1]) > 0:
        raise ValueError(f"--budget is {text!r}, expected a number above 0 with a unit: 60rulers, 20000px or 150us")
    return float(found[1]), units[found[2] or "rulers"]


def _contrasts(text: str) -> tuple[float, float]:
    try:
        bare, masked = (float(each) for each in text.split(","))
    except ValueError:
        raise ValueError(f"--contrast is {text!r}, expected two numbers, such as 40,15") from None
    return bare, masked
