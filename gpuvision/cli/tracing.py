"""Option ``--trace``, which every command has."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from gpuvision.cli.arguments import named_path

TraceFile = Annotated[
    Path | None,
    typer.Option(
        "--trace",
        metavar="FILE",
        parser=named_path,
        help="Write a timeline of the stages on host and device for chrome://tracing or ui.perfetto.dev.",
    ),
]


def with_trace(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command with the option ``--trace`` before its last option, ``--overwrite``.

    The timeline is written when the command has succeeded, or ends with an exit code after its work.
    """
    signature = inspect.signature(command, eval_str=True)
    *others, overwrite = signature.parameters.values()
    if overwrite.name != "overwrite":
        raise ValueError(f"the last option of {command.__name__} is {overwrite.name}, expected overwrite")

    @functools.wraps(command)
    def traced(*, trace: Path | None = None, **arguments: Any) -> None:
        if trace is None:
            command(**arguments)
        else:
            _run_traced(command, trace, arguments)

    option = inspect.Parameter("trace", inspect.Parameter.POSITIONAL_OR_KEYWORD, default=None, annotation=TraceFile)
    parameters = [*others, option, overwrite]
    traced.__signature__ = signature.replace(parameters=parameters)  # type: ignore[attr-defined]
    traced.__annotations__ = {each.name: each.annotation for each in parameters} | {"return": None}
    return traced


def _run_traced(command: Callable[..., None], path: Path, arguments: dict[str, Any]) -> None:
    from gpuvision.host.trace import Trace

    ended: typer.Exit | None = None
    with Trace(path, overwrite=arguments["overwrite"]) as trace, trace.span(f"gpuvision {_command_name(command)}"):
        try:
            command(**arguments)
        except typer.Exit as code:
            ended = code
    if ended is not None:
        raise ended


def _command_name(command: Callable[..., None]) -> str:
    return command.__name__.replace("_", "-")
