"""``gpuvision profile``: our operations and their peers, side by side on this machine."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.host.errors import GpuVisionError

if TYPE_CHECKING:
    from gpuvision.profiling.harness import Row


def profile(
    operations: Annotated[
        list[str] | None, typer.Argument(metavar="[OPERATION]...", help="psd, line, ...; all where none is named.")
    ] = None,
    device: Annotated[
        list[str] | None, typer.Option(help="Label of a device, see `gpuvision devices`; may be repeated.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="About how long to measure each case.", min=0.01)] = 2.0,
    as_json: Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the rows there.")] = None,
) -> None:
    """Measure operations against their peers: NumPy, Numba, OpenCV.

    Candidates take turns; a ratio is the peer's time over ours: above 1 we are faster. A run in which the machine
    changed its speed is marked invalid.
    """
    if importlib.util.find_spec("numba") is None:
        raise GpuVisionError("numba is missing, the strongest peer; install it: pip install 'gpuvision[profile]'")
    from gpuvision.host import Device
    from gpuvision.profiling import harness

    for name in operations or ():
        if name not in harness.OPERATIONS:
            raise ValueError(f"no operation {name!r} to profile; expected some of {', '.join(harness.OPERATIONS)}")
    devices = [Device.named(each) for each in device] if device else list(Device.all() or [Device.best()])
    run = harness.profile(
        operations or harness.OPERATIONS,
        devices,
        seconds=seconds,
        told=lambda line: typer.echo(line, err=True),
    )
    if as_json is not None:
        run.write(as_json)
    _show(list(run.rows))
    if not run.valid:
        typer.echo("not valid: the machine changed its speed while it was measured; run it again", err=True)


def _show(rows: list[Row]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for heading in ("operation", "case", "device", "time", "peer", "its time", "ratio", "error", "of ceiling"):
        table.add_column(heading, justify="left" if heading in ("operation", "case", "device", "peer") else "right")
    for each in rows:
        table.add_row(
            each.operation,
            each.case,
            each.device,
            _time(each.seconds),
            f"{each.peer} {each.peer_version}",
            _time(each.peer_seconds),
            f"{each.ratio:.2f}",
            f"{each.error:.1e}",
            "" if each.fraction is None else f"{100 * each.fraction:.0f} %",
        )
    Console().print(table)


def _time(seconds: float) -> str:
    unit, name = next(
        each for each in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")) if seconds >= each[0] or each[0] == 1e-6
    )
    return f"{seconds / unit:.3g} {name}"
