"""``gpuvision devices``: list the OpenCL devices, whether they work, and remedies."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import Overwrite, ReportFile, claim_outputs, echo, prints_report, write_report

if TYPE_CHECKING:
    from gpuvision.host.discovery import ProbedDevice


def devices(
    as_json: ReportFile = None,
    probe: Annotated[bool, typer.Option("--probe", help="Repeat the probe of devices that failed before.")] = False,
    overwrite: Overwrite = False,
) -> None:
    """List every OpenCL device: whether it works, why not, and what to install.

    A device works if a probe kernel was built, launched and checked on it. Exit code 1 if no device works.
    """
    from gpuvision.host import discovery

    outputs = claim_outputs("devices", (), as_json, overwrite=overwrite)
    listed = sorted(discovery.probed_devices(probe_again=probe), key=lambda each: each.rank)
    write_report(as_json, [_described(each) for each in listed], outputs)
    if not prints_report(as_json):
        _show(listed)
    if not any(each.healthy for each in listed):
        raise typer.Exit(1)


def _described(device: ProbedDevice) -> dict[str, str | bool]:
    return {
        "label": device.label,
        "kind": device.kind,
        "name": device.name,
        "platform": device.platform,
        "driver": device.driver,
        "gpu": device.is_gpu,
        "healthy": device.healthy,
        "reason": device.reason,
        "advice": device.advice,
    }


def _show(listed: list[ProbedDevice]) -> None:
    """Print a table of the devices; below it the reason and the advice for each broken one."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    from gpuvision.host.discovery import INSTALL_HINT

    if not listed:
        echo(f"no OpenCL device; {INSTALL_HINT}")
        return
    table = Table()
    for heading in ("label", "name", "platform", "driver", "works"):
        # Whole words on a wide terminal; on a narrow one a cell wraps instead of being cut.
        table.add_column(heading, overflow="fold", no_wrap=heading in ("label", "works"))
    for each in listed:
        works = "[green]yes[/]" if each.healthy else "[red]no[/]"
        table.add_row(*map(escape, (each.label, each.name, each.platform, each.driver)), works)
    Console().print(table)
    for each in listed:
        if not each.healthy:
            echo(f"{each.label} does not work: {each.reason}\n    {each.advice}")
    healthy = [each.label for each in listed if each.healthy]
    if len(healthy) > 1:
        echo(f"choose a device with --device {healthy[0]} or with the variable GPUVISION_DEVICE={healthy[0]}")
