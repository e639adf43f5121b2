"""The command ``gpuvision``.

Exit code 0: done; 1: it could not be done, with one line on stderr that says why; 2: the command line is wrong; 130 and
143: interrupted or terminated.

What takes time to import is imported within `main`: an interrupt is an exit code from the first moment.
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
    """Return the command line with its commands."""
    import typer

    from gpuvision.cli.calibrate import calibrate
    from gpuvision.cli.demo import demo
    from gpuvision.cli.devices import devices
    from gpuvision.cli.locate import locate
    from gpuvision.cli.profile import profile
    from gpuvision.cli.scan import scan
    from gpuvision.cli.select import select
    from gpuvision.cli.simulate import simulate
    from gpuvision.cli.undistort import undistort

    app = typer.Typer(
        help="Range imaging and visual servoing in OpenCL.",
        epilog=f"The variable {TRACEBACK}=1 shows where an error arose.",
        no_args_is_help=True,
        add_completion=False,
        pretty_exceptions_enable=False,
    )
    for command in (scan, simulate, calibrate, undistort, select, locate, demo, devices, profile):
        app.command()(command)
    return app


def one_line(error: Exception) -> str:
    """Return an error's message as a single line, with the file's name where the system gave one."""
    if isinstance(error, OSError) and error.strerror:
        # Of two files the second one is where the first, a temporary one, was to go.
        name = error.filename2 or error.filename
        message = f"{name}: {error.strerror}" if name else error.strerror
    else:
        message = str(error) or type(error).__name__
    return " ".join(message.split())


def main() -> None:
    """Run the command line; what goes wrong becomes a line on stderr and an exit code."""
    # Threads of NumPy's BLAS wait for more work in a loop, for some 20 ms, on cores that kernels then lack.
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
    before = signal.signal(signal.SIGTERM, _terminated)
    try:
        _run()
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    finally:
        signal.signal(signal.SIGTERM, before)


def _terminated(number: int, frame: object) -> NoReturn:
    """Leave by an exception, so that what is half-written goes; once, whatever comes while it does."""
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
