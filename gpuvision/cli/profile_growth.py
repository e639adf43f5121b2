"""``gpuvision profile --growth``: time against size, from one item to a limit of memory."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import typer

from gpuvision.cli.arguments import claim_outputs, devices_of, echo, prints_report


def profile_growth(
    operations: Sequence[str],
    labels: Sequence[str],
    memory_mib: float,
    as_json: Path | None,
    plots: Path | None,
    *,
    overwrite: bool,
) -> None:
    """Measure the curves and print a line for each one.

    The exit code is 1 if the machine changed its speed, an operation failed, or no size was measured.
    """
    from gpuvision.profiling.growth import measure_growth, workloads

    outputs = claim_outputs("profile", (), as_json, overwrite=overwrite)
    if plots is not None:
        from gpuvision.profiling.growth_plot import NAME, draw_growth

        outputs.claim_folder(plots, (NAME,))
    known = workloads()
    for name in operations:
        if name not in known:
            raise ValueError(f"no operation {name!r} to profile over its size; expected some of {', '.join(known)}")
    devices = devices_of(labels)
    growth = measure_growth(
        operations, devices, memory=round(memory_mib * 2**20), progress=lambda line: echo(line, err=True)
    )
    if prints_report(as_json):
        typer.echo(growth.to_json(), nl=False)
    elif as_json is not None:
        outputs.write_text(as_json, growth.to_json())
    for line in growth.lines():
        echo(line, err=prints_report(as_json))
    if not growth.points:
        echo(f"nothing measured: no operation has a size within {memory_mib:g} MiB, or all failed", err=True)
    elif plots is not None:
        echo(f"look at {plots / draw_growth(plots, growth, overwrite=overwrite)}", err=True)
    unsteady = [probe for probe in growth.probes if not probe.steady]
    for probe in unsteady:
        echo(f"not valid: the machine changed its speed during {probe.operation} on {probe.device}", err=True)
    for failure in growth.failures:
        echo(f"not measured: {failure.operation} on {failure.device}: {failure.reason}", err=True)
    if unsteady or growth.failures or not growth.points:
        raise typer.Exit(1)
