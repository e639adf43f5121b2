"""What commands take from the command line beyond typer's own types."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DeviceLabel = Annotated[str | None, typer.Option(help="Label of an OpenCL device, see `gpuvision devices`.")]


def named_path(text: str | Path) -> Path:
    """Return a path; an empty name, as a variable that is not set leaves it, would mean the current folder.

    Raises
    ------
    typer.BadParameter
        The name is empty.
    """
    if not str(text):
        raise typer.BadParameter("the name is empty; give one, or . for this folder")
    return Path(text)
