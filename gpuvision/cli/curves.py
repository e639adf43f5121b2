"""``gpuvision curves``: measure speed against accuracy of the settings of operations."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import (
    DeviceLabels,
    Overwrite,
    ReportFile,
    claim_outputs,
    devices_of,
    echo,
    named_path,
    prints_report,
    reject_unused,
    write_report,
)
from gpuvision.host.errors import GpuVisionError

if TYPE_CHECKING:
    from gpuvision.profiling.curves.curve import Point

_SECONDS = 0.3  # time to measure a setting [s]


def curves(
    operations: Annotated[
        list[str] | None,
        typer.Argument(metavar="OPERATION", help="Operations to measure, such as line or ruler. Default: all."),
    ] = None,
    device: DeviceLabels = None,
    seconds: Annotated[
        float | None, typer.Option(help="Approximate time to measure each setting [s]. Default: 0.3.", min=0.01)
    ] = None,
    as_json: ReportFile = None,
    plots: Annotated[
        Path | None, typer.Option(metavar="DIR", parser=named_path, help="Folder for a picture of each operation.")
    ] = None,
    maps: Annotated[
        bool,
        typer.Option(
            "--maps",
            help="Measure the region of inputs in which single precision stays close to float64, instead of settings.",
        ),
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure speed against accuracy: time and error of the settings that a user chooses.

    The truth of the data is known. Data of triangulation, undistort_points, range_image and the simulation of light
    have no noise; the others have. Errors of points are Euclidean distances. The table shows for each setting the
    median time, the root mean square error, the 95th percentile, and the fraction of samples without a value. A star
    marks the best settings: no other one on the same data is better in time, error or lost samples and as good in the
    others.

    With --maps nothing is timed. The table shows for each operation two axes of its inputs (light level, distance,
    distortion, size, condition), and the fraction of the places in their plane where the relative error against float64
    is below 1e-6 and 1e-3, as measured and as the error model predicts.
    """
    if importlib.util.find_spec("numba") is None:
        raise GpuVisionError("the package numba is missing; install it: pip install 'gpuvision[profile]'")
    if maps:
        from gpuvision.cli.curves_maps import measure_stability

        reject_unused("with --maps", seconds=seconds)
        measure_stability(operations or (), device or (), as_json, plots, overwrite=overwrite)
        return
    from gpuvision.profiling.curves import curve, plot
    from gpuvision.profiling.machine import describe_machine

    outputs = claim_outputs("curves", (), as_json, (plots, plot.FILES), overwrite=overwrite)
    devices = devices_of(device)
    machine = describe_machine(devices)
    points = curve.measure_curves(
        operations or curve.OPERATIONS,
        devices,
        seconds=seconds or _SECONDS,
        progress=lambda line: echo(line, err=True),
    )
    report = {"machine": machine, "points": [point.to_dict() for point in points]}
    write_report(as_json, report, outputs)
    if not prints_report(as_json):
        _show(points)
    if plots is not None:
        drawn = plot.draw_curves(plots, points, overwrite=overwrite)
        echo(f"look at {', '.join(str(plots / name) for name in drawn)}", err=True)


def _show(points: list[Point]) -> None:
    """Print a table for each operation, data and device."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from gpuvision.profiling.curves.plot import describe

    console = Console()
    for key in dict.fromkeys((each.operation, each.data, each.device) for each in points):
        chosen = [each for each in points if (each.operation, each.data, each.device) == key]
        table = Table(title=", ".join(key), title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for heading in ("setting", "time [µs]", "rms", "p95", "lost", "best"):
            table.add_column(heading, justify="left" if heading == "setting" else "right", overflow="fold")
        for each in chosen:
            numbers = (f"{1e6 * each.seconds:.3g}", f"{each.rms:.2e} {each.unit}", f"{each.p95:.1e}")
            table.add_row(describe(each, chosen), *numbers, f"{each.lost:.1%}", "*" if each.best else "")
        console.print(table)
