"""Option ``--trace``, which every command has."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from gpuvision.cli.arguments import Overwrite, named_path

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
    """Return a command with the option ``--trace`` before ``--overwrite``; a command without ``--overwrite`` gets both.

    The timeline is written when the command has succeeded, or ends with an exit code after its work.
    """
    signature = inspect.signature(command, eval_str=True)
    parameters = dict(signature.parameters)
    overwrite_option = parameters.pop("overwrite", None)

    @functools.wraps(command)
    def traced(*, trace: Path | None = None, overwrite: bool = False, **arguments: Any) -> None:
        if overwrite_option is not None:
            arguments["overwrite"] = overwrite
        if trace is None:
            command(**arguments)
        else:
            _run_traced(command, trace, overwrite, arguments)

    options = [
        *parameters.values(),
        _option("trace", None, TraceFile),
        overwrite_option or _option("overwrite", False, Overwrite),
    ]
    traced.__signature__ = signature.replace(parameters=options)  # type: ignore[attr-defined]
    traced.__annotations__ = {each.name: each.annotation for each in options} | {"return": None}
    return traced


def _option(name: str, default: object, annotation: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, default=default, annotation=annotation)


def _run_traced(command: Callable[..., None], path: Path, overwrite: bool, arguments: dict[str, Any]) -> None:
    from gpuvision.host.trace import Trace

    ended: typer.Exit | None = None
    with Trace(path, overwrite=overwrite) as trace, trace.span(f"gpuvision {_command_name(command)}"):
        try:
            command(**arguments)
        except typer.Exit as code:
            ended = code
    if ended is not None:
        raise ended


def _command_name(command: Callable[..., None]) -> str:
    return command.__name__.replace("_", "-")
