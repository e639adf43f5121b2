"""Sphinx extension: one page for every command of ``gpuvision``, from the help texts of the command objects."""

from __future__ import annotations

import inspect
import re
from pathlib import Path
from typing import Any

import typer

from pages import table, title, toctree, write_pages

FOLDER = "reference/commands"


def _prose(text: str) -> str:
    """Return help text as reStructuredText: a single backtick there marks text to type."""
    parts = text.replace("\n", " ").split("`")
    return "``".join(part if odd % 2 else re.sub(r"([\\*|_])", r"\\\1", part) for odd, part in enumerate(parts))


def _table(heading: str, parameters: list[Any], context: Any) -> str:
    """Return a heading and the table of options or arguments; an empty text without options."""
    records = [each.get_help_record(context) for each in parameters]
    rows = [(f"``{record[0]}``", _prose(record[1])) for record in records if record]
    return f"{title(heading, '-')}\n{table(('name', 'meaning'), rows)}" if rows else ""


def _command_page(name: str, command: Any) -> str:
    context = command.make_context(f"gpuvision {name}", [], resilient_parsing=True)
    usage = " ".join(command.collect_usage_pieces(context)).translate(str.maketrans("", "", "{}"))
    kinds = {kind: [each for each in command.params if each.param_type_name == kind] for kind in ("argument", "option")}
    paragraphs = inspect.cleandoc(command.help or "").split("\n\n")
    return "\n".join(
        (
            title(f"gpuvision {name}"),
            "\n\n".join(_prose(each) for each in paragraphs),
            f"\n.. code-block:: text\n\n   gpuvision {name} {usage}\n",
            _table("Arguments", kinds["argument"], context),
            _table("Options", kinds["option"], context),
        )
    )


def cli_pages(application: typer.Typer) -> dict[str, str]:
    """Return all pages by file name."""
    group: Any = typer.main.get_command(application)
    context = group.make_context("gpuvision", [], resilient_parsing=True)
    rows = [
        (f":doc:`gpuvision {name} <{name}>`", _prose(inspect.cleandoc(command.help or "").partition("\n\n")[0]))
        for name, command in group.commands.items()
    ]
    codes = (
        "Exit codes: 0, done; 1, not possible, with one line on stderr that states the reason; 2, wrong command line;\n"
        "130 and 143, interrupted or terminated. ``python -m gpuvision`` is the same command.\n"
    )
    index = [title("Commands"), f"{_prose(group.help or '')}\n", codes, f"{_prose(group.epilog or '')}\n"]
    index += [table(("command", "summary"), rows), _table("Options before the command", group.params, context)]
    index.append(toctree(group.commands))
    pages = {f"{name}.rst": _command_page(name, command) for name, command in group.commands.items()}
    return pages | {"index.rst": "\n".join(index)}


def setup(app: Any) -> dict[str, Any]:
    """Write the pages before Sphinx looks for documents."""
    from gpuvision.cli.main import application

    app.connect("config-inited", lambda app, config: write_pages(Path(app.srcdir, FOLDER), cli_pages(application())))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
