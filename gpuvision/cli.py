"""The command ``gpuvision``.

Exit code 0: done; 1: it could not be done, with one line on stderr that says why; 2: the command line is wrong.
"""

from __future__ import annotations

import os
import sys

import typer

from gpuvision.commands.demo import demo
from gpuvision.commands.devices import devices
from gpuvision.commands.profile import profile
from gpuvision.commands.scan import scan
from gpuvision.host.errors import GpuVisionError

TRACEBACK = "GPUVISION_TRACEBACK"

app = typer.Typer(
    help="Range imaging and visual servoing in OpenCL.",
    epilog=f"The variable {TRACEBACK}=1 shows where an error arose.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


for command in (scan, demo, devices, profile):
    app.command()(command)


def one_line(error: Exception) -> str:
    """Return an error's message as a single line, with the file's name where the system gave one."""
    if isinstance(error, OSError) and error.strerror:
        message = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    else:
        message = str(error) or type(error).__name__
    return " ".join(message.split())


def main() -> None:
    """Run the command line; what goes wrong becomes a line on stderr and an exit code."""
    try:
        app()
    except (GpuVisionError, ValueError, TypeError, OSError) as error:
        if os.environ.get(TRACEBACK):
            raise
        print(f"gpuvision: {one_line(error)}", file=sys.stderr)
        sys.exit(1)
