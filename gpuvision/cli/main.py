"""The command ``gpuvision``.

Exit codes: 0 success; 1 failure, with one line on stderr that gives the reason; 2 wrong command line; 130 interrupted;
143 terminated.

Slow imports happen inside `main`, so that an interrupt is turned into an exit code from the first moment.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    import typer

TRACEBACK = "GPUVISION_TRACEBACK"

# Time to unwind after a signal [s] (chosen): then the process ends at once. Service managers wait 10 s and more.
_GRACE = 5.0
# Signals received by this process, the first one first.
_received: list[int] = []


def application() -> typer.Typer:
    """Return the typer application with all commands."""
    import typer

    from gpuvision.cli.calibrate import calibrate
    from gpuvision.cli.curves import curves
    from gpuvision.cli.delay import delay
    from gpuvision.cli.demo import demo
    from gpuvision.cli.devices import devices
    from gpuvision.cli.inspect import inspect
    from gpuvision.cli.locate import locate
    from gpuvision.cli.locate_robot import locate_robot
    from gpuvision.cli.merge import merge
    from gpuvision.cli.place import place
    from gpuvision.cli.profile import profile
    from gpuvision.cli.scan import scan
    from gpuvision.cli.select import select
    from gpuvision.cli.simulate import simulate
    from gpuvision.cli.tracing import with_trace
    from gpuvision.cli.tune import tune
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
    for command in (
        scan,
        merge,
        simulate,
        calibrate,
        undistort,
        select,
        locate,
        locate_robot,
        place,
        inspect,
        delay,
        demo,
        devices,
        profile,
        tune,
        curves,
    ):
        app.command()(with_trace(command))
    return app


def one_line(error: Exception) -> str:
    """Return an error's message as a single line without control characters, with the file's name if there is one."""
    if isinstance(error, OSError) and error.strerror:
        # os.replace reports two file names; the second is the destination.
        name = error.filename2 or error.filename
        message = f"{name}: {error.strerror}" if name else error.strerror
    else:
        message = str(error) or type(error).__name__
    from gpuvision.host.text import printable

    return " ".join(printable(message).split())


def main() -> None:
    """Run the command line. Errors become one line on stderr and an exit code."""
    # Idle BLAS threads of NumPy spin for about 20 ms and take cores from the kernels; shorten that (2**4 cycles).
    os.environ.setdefault("OPENBLAS_THREAD_TIMEOUT", "4")
    with _ending_by_signals():
        try:
            _run()
        except KeyboardInterrupt:
            sys.exit(128 + signal.SIGINT)


@contextlib.contextmanager
def _ending_by_signals() -> Iterator[None]:
    """End the process with exit code 128 + number on SIGINT and SIGTERM, even if the block catches the exception.

    The signal raises SystemExit in the main thread, so that half-written files are removed. Code that swallows the
    exception (an extension module that is being imported, a destructor) or that stays in a library call is cut off by
    a second thread, which the signal wakes without the help of the main thread.
    """
    numbers = [signal.SIGTERM]
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:  # a shell's background job ignores SIGINT
        numbers.append(signal.SIGINT)
    _received.clear()
    ear, mouth = os.pipe()
    os.set_blocking(mouth, False)
    waker = signal.set_wakeup_fd(mouth, warn_on_full_buffer=False)
    _thread.start_new_thread(_end_after_grace, (ear, frozenset(numbers)))
    before = {number: signal.signal(number, _raise_exit) for number in numbers}
    try:
        yield
    except BaseException:
        if _received:
            raise SystemExit(128 + _received[0]) from None
        raise
    else:
        if _received:
            sys.exit(128 + _received[0])
    finally:
        if not _received:
            for number, handler in before.items():
                signal.signal(number, handler)
            signal.set_wakeup_fd(waker)
            os.close(mouth)


def _raise_exit(number: int, frame: object) -> NoReturn:
    """Raise SystemExit in the main thread; ignore further signals."""
    for each in (signal.SIGINT, signal.SIGTERM):
        signal.signal(each, signal.SIG_IGN)
    _received.append(number)
    sys.unraisablehook = lambda _: None  # no traceback where a destructor swallows the exception
    sys.exit(128 + number)


def _end_after_grace(ear: int, numbers: frozenset[int]) -> None:
    """Wait for a signal; if the process still lives after the grace, remove its temporary files and end it."""
    while received := os.read(ear, 1):
        if received[0] in numbers:
            time.sleep(_GRACE)
            files = sys.modules.get("gpuvision.host.files")
            with contextlib.suppress(Exception):  # the module may be half imported, or a file gone meanwhile
                if files is not None:
                    files.remove_temporaries()
            os._exit(128 + received[0])
    os.close(ear)


def _run() -> None:
    from gpuvision.host.build_notice import BuildNotice, show_builds
    from gpuvision.host.errors import GpuVisionError

    if sys.stderr.isatty() and os.environ.get("TERM") != "dumb":
        show_builds(BuildNotice(sys.stderr))
    try:
        application()()
    except (GpuVisionError, ValueError, TypeError, ArithmeticError, MemoryError, OSError) as error:
        if os.environ.get(TRACEBACK):
            raise
        print(f"gpuvision: {one_line(error)}", file=sys.stderr)
        sys.exit(1)
