"""``gpuvision devices``: which OpenCL devices are there, which work, and what to do about the others."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from gpuvision.host.discovery import Candidate


def devices(
    as_json: Annotated[bool, typer.Option("--json", help="Print a list of objects instead of the table.")] = False,
    probe: Annotated[bool, typer.Option("--probe", help="Ask the devices again that failed before.")] = False,
) -> None:
    """Show every OpenCL device: whether it works, why not, and what to install.

    A device works when a kernel was built, launched and checked on it. Exit code 1 if none does.
    """
    from gpuvision.host import discovery

    listed = sorted(discovery.candidates(probe_again=probe), key=lambda each: each.rank)
    if as_json:
        typer.echo(json.dumps([_described(each) for each in listed], indent=2))
    elif listed:
        _show(listed)
    else:
        typer.echo(f"no OpenCL device; {discovery.INSTALL_HINT}")
    if not any(each.healthy for each in listed):
        raise typer.Exit(1)


def _described(device: Candidate) -> dict[str, str | bool]:
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


def _show(listed: list[Candidate]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table()
    for heading in ("label", "name", "platform", "driver", "works"):
        # Whole words on a wide terminal; on a narrow one a cell breaks rather than ends in dots.
        table.add_column(heading, overflow="fold", no_wrap=heading in ("label", "works"))
    for each in listed:
        works = "[green]yes[/]" if each.healthy else "[red]no[/]"
        table.add_row(each.label, each.name, each.platform, each.driver, works)
    Console().print(table)
    for each in listed:
        if not each.healthy:
            typer.echo(f"{each.label} does not work: {each.reason}\n    {each.advice}")
