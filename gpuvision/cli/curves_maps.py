"""``gpuvision curves --maps``: regions of the inputs in which single precision stays close to float64."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from gpuvision.cli.arguments import claim_outputs, devices_of, echo, prints_report, write_report

if TYPE_CHECKING:
    from gpuvision.profiling.maps.stability import StabilityMap


def measure_stability(
    operations: Sequence[str], labels: Sequence[str], as_json: Path | None, plots: Path | None, *, overwrite: bool
) -> None:
    """Measure the maps, print a line for each one, and draw them."""
    from gpuvision.profiling.machine import describe_machine
    from gpuvision.profiling.maps import picture, stability

    outputs = claim_outputs("curves", (), as_json, (plots, picture.FILES), overwrite=overwrite)
    devices = devices_of(labels)
    maps = stability.measure_maps(
        operations or stability.OPERATIONS, devices, progress=lambda line: echo(line, err=True)
    )
    report = {"machine": describe_machine(devices), "maps": [each.to_dict() for each in maps]}
    write_report(as_json, report, outputs)
    if not prints_report(as_json):
        _show(maps, stability.LIMITS)
    if plots is not None:
        drawn = picture.draw_maps(plots, maps, overwrite=overwrite)
        echo(f"look at {', '.join(str(plots / name) for name in drawn)}", err=True)


def _show(maps: Sequence[StabilityMap], limits: Sequence[float]) -> None:
    """Print the fraction of the places of each map within each limit, and then the inputs of each operation."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title="places within a relative error", title_justify="left")
    for heading in ("operation", "device"):
        table.add_column(heading, overflow="fold")
    for limit in limits:
        table.add_column(f"{limit:.0e}", justify="right")
        table.add_column("by model", justify="right")
    for each in maps:
        shares = (f"{share(limit):.0%}" for limit in limits for share in (each.share, each.allowed))
        table.add_row(each.operation, each.device, *shares)
    Console().print(table)
    for line in dict.fromkeys(_inputs(each) for each in maps):
        echo(line)


def _inputs(each: StabilityMap) -> str:
    """Return a line with the unit of the error and the ranges of the inputs of a map."""
    ranges = ", ".join(f"{axis.name} {axis.low:g} to {axis.high:g}" for axis in each.axes)
    return f"{each.operation}: error relative to {each.relative_to}; {ranges}"
