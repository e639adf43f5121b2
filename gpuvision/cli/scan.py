"""``gpuvision scan``: a recording becomes a range image, pictures and a report."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from gpuvision.cli.arguments import DeviceLabel, named_path


class Arithmetic(StrEnum):
    """What ``--precision`` takes."""

    single = "single"
    double = "double"


class NoRoom(StrEnum):
    """What ``--policy`` takes."""

    block = "block"
    drop_oldest = "drop_oldest"
    stop = "raise"


Recording = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        parser=named_path,
        help="Of a camera: a video, a TIFF stack, a folder of images, an NPY array (frames, rows, columns). "
        "Of a PSD: an NPY array (frames, strips, 2).",
    ),
]
SensorFile = Annotated[
    str, typer.Option(help="The sensor's TOML file, or one that comes along: camera_line, corner_scene, psd_line.")
]
Results = Annotated[
    Path,
    typer.Option(metavar="DIR", parser=named_path, help="Folder for the range image, the pictures and report.json."),
]
Rate = Annotated[float | None, typer.Option(help="Replay at so many frames per second, as a sensor would send them.")]
RoomPolicy = Annotated[
    NoRoom | None,
    typer.Option(help="Where no room is left for a frame: it waits; the oldest is given up (so with --rate); stop."),
]
TraceFile = Annotated[
    Path | None,
    typer.Option(metavar="FILE", parser=named_path, help="Timeline for chrome://tracing or ui.perfetto.dev."),
]


def scan(
    recording: Recording,
    sensor: SensorFile,
    out: Results,
    device: DeviceLabel = None,
    precision: Annotated[
        Arithmetic | None, typer.Option(help="Of the arithmetic; otherwise as the recording has it.")
    ] = None,
    rate: Rate = None,
    policy: RoomPolicy = None,
    trace: TraceFile = None,
) -> None:
    """Scan a recording: range image, pictures and a report in DIR.

    Nothing is written before all of the recording was understood.
    """
    # The decoder would speak for itself on stderr; what is wrong with a video is in our own line.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.host import Device
    from gpuvision.host.files import check_file, check_folder
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.workflows.scanning import scan as run

    described = Sensor.load(sensor)
    check_folder(out)
    if trace is not None:
        check_file(trace)
        if trace.absolute() in (out.absolute(), *out.absolute().parents):
            raise ValueError(f"--trace is {trace}, the folder of --out or one above it; give a file")
    chosen = None if device is None else Device.named(device)
    with progress_bar(f"scanning {recording.name}") as progress:
        done = run(
            recording,
            described,
            device=chosen,
            precision=None if precision is None else precision.value,
            rate=rate,
            policy=None if policy is None else policy.value,
            trace=trace,
            progress=progress,
        )
    done.write(out)
    typer.echo(f"{done.summary()}\nlook at {out / 'picture.png'} and {out / 'report.json'}")


@contextlib.contextmanager
def progress_bar(what: str) -> Iterator[Callable[[int, int | None], object]]:
    """Show progress on stderr where that is a terminal; give what takes (frames done, of how many)."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(what, total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)
