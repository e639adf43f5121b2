"""``gpuvision profile``: measure operations side by side with their peers on this machine."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import named_path
from gpuvision.host.errors import GpuVisionError

if TYPE_CHECKING:
    from gpuvision.profiling.harness import Row


def profile(
    operations: Annotated[
        list[str] | None, typer.Argument(metavar="[OPERATION]...", help="psd, line, ...; default: all.")
    ] = None,
    device: Annotated[
        list[str] | None, typer.Option(help="Label of a device, see `gpuvision devices`; may be repeated.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Time to measure each case [s].", min=0.01)] = 2.0,
    as_json: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", parser=named_path, help="Write the rows there.")
    ] = None,
    plots: Annotated[
        Path | None,
        typer.Option(metavar="DIR", parser=named_path, help="Folder for plots: time over size, and error over time."),
    ] = None,
) -> None:
    """Measure operations against their peers: NumPy, Numba, OpenCV.

    Candidates run interleaved. The ratio is the time of the peer over the time of gpuvision. A run during which the
    machine changed its speed is marked invalid.
    """
    if importlib.util.find_spec("numba") is None:
        raise GpuVisionError("the peer numba is missing; install it: pip install 'gpuvision[profile]'")
    from gpuvision.host import Device
    from gpuvision.host.files import check_file, check_folder
    from gpuvision.profiling import harness

    if as_json is not None:
        check_file(as_json)
    if plots is not None:
        check_folder(plots)
    for name in operations or ():
        if name not in harness.OPERATIONS:
            raise ValueError(f"no operation {name!r} to profile; expected some of {', '.join(harness.OPERATIONS)}")
    devices = [Device.named(each) for each in device] if device else list(Device.all() or [Device.best()])
    run = harness.profile(
        operations or harness.OPERATIONS,
        devices,
        seconds=seconds,
        progress=lambda line: typer.echo(line, err=True),
    )
    if as_json is not None:
        run.write(as_json)
    if plots is not None:
        from gpuvision.profiling.plots import draw_plots

        plots.mkdir(parents=True, exist_ok=True)
        draw_plots(plots, run.rows)
    _show(list(run.rows))
    if not run.valid:
        typer.echo("not valid: the machine changed its speed during the measurement; run it again", err=True)


def _show(rows: list[Row]) -> None:
    """Print a table for each operation, narrow enough for a terminal of 80 columns."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console()
    for operation in dict.fromkeys(each.operation for each in rows):
        table = Table(title=operation, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for heading in ("case", "device", "time", "peer", "its time", "ratio", "error", "ceiling"):
            words = heading in ("case", "device", "peer")
            table.add_column(heading, justify="left" if words else "right", no_wrap=heading != "case", overflow="fold")
        for each in rows:
            if each.operation == operation:
                table.add_row(*_cells(each))
        console.print(table)
        for line in dict.fromkeys(
            _metadata_line(each) for each in rows if each.operation == operation and each.metadata
        ):
            console.print(line, highlight=False, markup=False)


def _metadata_line(row: Row) -> str:
    return f" {row.case} on {row.device}: " + ", ".join(f"{name} {value}" for name, value in row.metadata.items())


def _cells(row: Row) -> tuple[str, ...]:
    fraction = "" if row.fraction is None else f"{100 * row.fraction:.0f} %"
    times = (_time(row.seconds), row.peer, _time(row.peer_seconds))
    return row.case, row.device, *times, f"{row.ratio:.2f}", f"{row.error:.1e}", fraction


def _time(seconds: float) -> str:
    unit, name = next(
        each for each in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")) if seconds >= each[0] or each[0] == 1e-6
    )
    return f"{seconds / unit:.3g} {name}"
