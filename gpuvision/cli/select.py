"""``gpuvision select``: which edges and marks of a board to look at, chosen from its artwork before it is seen."""

from __future__ import annotations

import re
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gpuvision.cli.arguments import DeviceLabel, LayerNames, layers_of, named_path, quantities


class Side(StrEnum):
    """What ``--side`` takes."""

    top = "top"
    bottom = "bottom"


Gerbers = Annotated[
    Path, typer.Argument(metavar="GERBERS", parser=named_path, help="Folder, or ZIP, of Gerber and Excellon files.")
]
Region = Annotated[
    str, typer.Option(metavar="X0,Y0,X1,Y1", help="What the camera may read, in the files' frame: m, or 12mm.")
]
Budget = Annotated[
    str, typer.Option(help="What may be spent: 60 or 60rulers (a mark: 16), 20000px, or 150us on this device.")
]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for features.toml and features.png.")
]
Scale = Annotated[str, typer.Option(metavar="LENGTH", help="Of a pixel on the board: 25e-6 (m), or 25um.")]
Placement = Annotated[
    str | None, typer.Option(metavar="X,Y", help="Point whose pose counts; otherwise the region's middle.")
]
Within = Annotated[
    str,
    typer.Option(metavar="LENGTH,ANGLE", help="How far the board may be from where it is expected, and how turned."),
]
Blur = Annotated[float, typer.Option(min=0.1, help="Standard deviation of the edges' blur, in pixels.")]
Contrasts = Annotated[
    str, typer.Option(metavar="BARE,MASKED", help="Steps at edges of bare copper, and under the mask, over the noise.")
]
Etch = Annotated[str, typer.Option(metavar="LENGTH", help="How far copper is etched beside its edges, std.")]
Missing = Annotated[float, typer.Option(min=0.0, max=0.99, help="Share of the edges that will not be found.")]


def select(
    gerbers: Gerbers,
    roi: Region,
    scale: Scale,
    out: Results,
    budget: Budget = "60rulers",
    placement: Placement = None,
    side: Annotated[Side, typer.Option(help="Of the board, seen from above or from below.")] = Side.top,
    within: Within = "100um,0.3deg",
    blur: Blur = 1.0,
    contrast: Contrasts = "40,15",
    width: Annotated[int, typer.Option(min=1, max=255, help="Lines that a ruler averages.")] = 5,
    etch: Etch = "10um",
    missing: Missing = 0.0,
    layers: LayerNames = None,
    device: DeviceLabel = None,
) -> None:
    """Choose the edges and round marks of a board that fix its pose best, for `gpuvision locate --features`.

    DIR/features.toml says how long each ruler is so that its edge lies on it, which region they read, and what standard
    deviations the pose will have at the placement point.
    """
    from gpuvision.formats.features_file import write_features
    from gpuvision.host import Device
    from gpuvision.host.files import check_folder, whole_folder
    from gpuvision.matching.artwork.artwork import read_artwork
    from gpuvision.matching.features.feature_set import choose_features, clearance_of
    from gpuvision.matching.features.selection import Imaging
    from gpuvision.plots.board import draw_features

    region = quantities(roi, "--roi", "m,m,m,m")
    if not (region[0] < region[2] and region[1] < region[3]):
        raise ValueError(f"--roi is {roi!r}, expected the least x, y first and the greatest last")
    amount, unit = _budget(budget)
    shift, angle = quantities(within, "--within", "m,rad")
    bare, masked = _contrasts(contrast)
    imaging = Imaging(
        pixel=quantities(scale, "--scale", "m")[0],
        blur_px=blur,
        contrast_bare=bare,
        contrast_masked=masked,
        width_px=width,
        etch=quantities(etch, "--etch", "m")[0],
        shift=shift,
        angle=angle,
    )
    at = None if placement is None else quantities(placement, "--placement", "m,m")
    check_folder(out)
    artwork = read_artwork(gerbers, side=side.value, layers=layers_of(layers), clearance=clearance_of(imaging))
    box = (region[:2], region[2:])
    features = choose_features(
        artwork,
        box,
        imaging,
        placement=at,
        budget=amount,
        unit=unit,  # type: ignore[arg-type]
        missing=missing,
        device=None if device is None else Device.named(device),
    )
    with whole_folder(out) as inside:
        write_features(features, inside / "features.toml")
        draw_features(inside / "features.png", artwork, features, box)
    typer.echo(f"{features.summary()}\nlook at {out / 'features.png'}; use {out / 'features.toml'}")


def _budget(text: str) -> tuple[float, str]:
    found = re.fullmatch(r"\s*(\d+(?:\.\d*)?)\s*(rulers|px|us|µs)?\s*", text)
    if not found or not float(found[1]) > 0:
        raise ValueError(f"--budget is {text!r}, expected a number above 0 and what of: 60rulers, 20000px or 150us")
    return float(found[1]), (found[2] or "rulers").replace("µ", "u")


def _contrasts(text: str) -> tuple[float, float]:
    try:
        bare, masked = (float(each) for each in text.split(","))
    except ValueError:
        raise ValueError(f"--contrast is {text!r}, expected two numbers, as 40,15") from None
    return bare, masked
