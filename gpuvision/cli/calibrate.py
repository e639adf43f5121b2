"""``gpuvision calibrate``: images of a flat pattern become a lens file, a picture and a report."""

from __future__ import annotations

import math
import os
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from gpuvision.cli.arguments import named_path
from gpuvision.cli.scan import progress_bar

if TYPE_CHECKING:
    from gpuvision.camera.calibration import Calibration


class Seen(StrEnum):
    """What ``--pattern`` takes."""

    dots = "dots"
    chessboard = "chessboard"
    lines = "lines"


class Way(StrEnum):
    """What ``--method`` takes."""

    auto = "auto"
    lines = "lines"
    views = "views"


class Outliers(StrEnum):
    """What ``--loss`` takes."""

    squared = "squared"
    huber = "huber"
    tukey = "tukey"


Images = Annotated[
    list[Path], typer.Argument(metavar="IMAGES...", parser=named_path, help="From one camera, all of one size.")
]
LensFile = Annotated[
    Path,
    typer.Option(
        metavar="FILE.toml",
        parser=named_path,
        help="The lens file; its report (.json) and picture (.png) beside it.",
    ),
]
Pattern = Annotated[Seen, typer.Option(help="What the images show: a grid of dots, a chessboard, or crossing lines.")]
Method = Annotated[
    Way,
    typer.Option(
        help="lines: the lens alone, from what should be straight, from one image on. views: focal length, centre, "
        "lens and tilt of the sensor. auto: views where three images show a grid or --focal-length is given."
    ),
]
Model = Annotated[
    str,
    typer.Option(
        help="auto: the smallest model that the data do not refuse. lines: none, k1 or k1,k2. "
        "views: names out of k1,k2,p1,p2,k3,tilt."
    ),
]
Inner = Annotated[
    str | None, typer.Option(metavar="COLUMNSxROWS", help="Inner corners of the chessboard, such as 9x6.")
]
Pitch = Annotated[float, typer.Option(min=1e-9, help="Distance of neighbours on the pattern in metres, for the poses.")]
FocalLength = Annotated[
    float | None, typer.Option(help="Focal length in pixels, where it is known: one view then suffices.")
]
Loss = Annotated[Outliers, typer.Option(help="huber and tukey give points that lie far off less weight, or none.")]


def calibrate(
    images: Images,
    out: LensFile,
    pattern: Pattern = Seen.dots,
    method: Method = Way.auto,
    model: Model = "auto",
    inner: Inner = None,
    pitch: Pitch = 1.0,
    focal_length: FocalLength = None,
    loss: Loss = Outliers.squared,
) -> None:
    """Calibrate a lens, or a camera with a tilted sensor, from images of a flat pattern.

    Every parameter comes with its uncertainty; the report names other models that fit as well, and what the images
    cannot tell.
    """
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.host.files import check_file
    from gpuvision.workflows.calibrating import calibrate as run
    from gpuvision.workflows.calibrating import write_calibration

    corners = None if inner is None else _corners(inner)
    if out.suffix in (".json", ".png"):
        raise ValueError(
            f"--out is {out}, where the report and the picture go beside it; give a name such as lens.toml"
        )
    for place in (out, out.with_suffix(".json"), out.with_suffix(".png")):
        check_file(place)
    with progress_bar(f"finding {pattern.value}") as progress:
        done = run(
            images,
            pattern=pattern.value,
            method=method.value,
            model=model,
            inner=corners,
            pitch=pitch,
            focal_length=focal_length,
            loss=loss.value,
            progress=progress,
        )
    _show(done)
    write_calibration(done, out)
    typer.echo(
        f"look at {out.with_suffix('.png')}; correct images with: gpuvision undistort IMAGES --lens {out} --out DIR"
    )


def _corners(text: str) -> tuple[int, int]:
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        raise ValueError(f"--inner is {text!r}, expected the inner corners along both sides, such as 9x6")
    return int(parts[0]), int(parts[1])


def _show(done: Calibration) -> None:
    console = Console()
    typer.echo(done.summary())
    for path, why in done.passed_over:
        typer.echo(f"passed over {path}: {why}")
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("parameter")
    table.add_column("value", justify="right")
    table.add_column("uncertainty (1 sigma)", justify="right")
    for name, (value, error) in done.parameters.items():
        table.add_row(name, f"{value:.{_digits(value, error)}g}", f"{error:.2g}")
    console.print(table)
    if done.alternatives:
        console.print(_alternatives(done))
    for each in done.fit.warnings:
        typer.echo(f"warning: {each}")


def _digits(value: float, error: float) -> int:
    """Return how many digits of a value its uncertainty leaves, and one more."""
    if not 0.0 < error < math.inf or value == 0.0:
        return 6
    return min(max(math.ceil(math.log10(abs(value) / error)) + 2, 2), 10)


def _alternatives(done: Calibration) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("other models")
    for heading in ("residual, px", "p (F test)", "centre apart, px"):
        table.add_column(heading, justify="right")
    for each in done.alternatives:
        table.add_row(each.model, f"{each.rms_px:.4g}", f"{each.p_value:.2g}", f"{each.apart_px:.3g}")
    return table
