"""``gpuvision --version``."""

from __future__ import annotations

from importlib.metadata import version as installed_version
from typing import Annotated

import typer


def _print_version(is_asked: bool) -> None:
    if is_asked:
        typer.echo(f"gpuvision {installed_version('gpuvision')}")
        raise typer.Exit


def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Range imaging and visual servoing in OpenCL."""
