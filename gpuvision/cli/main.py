"""The command ``gpuvision``.

Exit codes: 0 success; 1 failure, with one line on stderr that gives the reason; 2 wrong command line; 130 interrupted;
143 terminated.

Slow imports happen inside `main`, so that an interrupt is turned into an exit code from the first moment.
"""

from __future__ import annotations

import os
import signal
import sys
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    import typer

TRACEBACK = "GPUVISION_TRACEBACK"


def application() -> typer.Typer:
    """Return the typer application with all commands."""
    import typer

    from gpuvision.cli.calibrate import calibrate
    from gpuvision.cli.demo import demo
    from gpuvision.cli.devices import devices
    from gpuvision.cli.locate import locate
    from gpuvision.cli.locate_robot import locate_robot
    from gpuvision.cli.profile import profile
    from gpuvision.cli.scan import scan
    from gpuvision.cli.select import select
    from gpuvision.cli.simulate import simulate
    from gpuvision.cli.undistort import undistort
    from gpuvision.cli.version import root

    app = typer.Typer(
        epilog=f"Set {TRACEBACK}=1 to see the traceback of an error.",
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode="markdown",  # the default, "rich", takes units such as [m] for its markup
        pretty_exceptions_enable=False,
    )
    app.callback()(root)
    for command in (scan, simulate, calibrate, undistort, select, locate, locate_robot, demo, devices, profile):
        app.command()(command)
    return app


def one_line(error: Exception) -> str:
    """Return an error's message as a single line, with the file's name where the system gave one."""
    if isinstance(error, OSError) and error.strerror:
        # os.replace reports two file names; the second is the destination.
        name = error.filename2 or error.filename
        message = f"{name}: {error.strerror}" if name else error.strerror
    else:
        message = str(error) or type(error).__name__
    return " ".join(message.split())


def main() -> None:
    """Run the command line. Errors become one line on stderr and an exit code."""
    # Idle BLAS threads of NumPy spin for about 20 ms and take cores from the kernels; shorten that (2**4 cycles).
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        _run()
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminated(number: int, frame: object) -> NoReturn:
    """Exit by an exception, so that half-written files are removed. Ignore further signals meanwhile."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.exit(128 + number)


def _run() -> None:
    from gpuvision.host.errors import GpuVisionError

    try:
        application()()
    except (GpuVisionError, ValueError, TypeError, OverflowError, OSError) as error:
        if os.environ.get(TRACEBACK):
            raise
        print(f"gpuvision: {one_line(error)}", file=sys.stderr)
        sys.exit(1)
