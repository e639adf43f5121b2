"""What commands take from the command line beyond typer's own types."""

from __future__ import annotations

import fnmatch
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

DeviceLabel = Annotated[str | None, typer.Option(help="Label of an OpenCL device, see `gpuvision devices`.")]

LayerNames = Annotated[
    list[str] | None,
    typer.Option(
        "--layers",
        metavar="NAME=LAYER",
        help="What a file is, where names do not tell: '*.gtl=top copper', '*.gko=mechanical outline'; repeat it for "
        "all that are to be read.",
    ),
]


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


_UNITS = {
    "m": {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "rad": {"": 1.0, "rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zµ]*)\s*")


def quantities(text: str, option: str, units: str) -> tuple[float, ...]:
    """Return numbers, parted by commas, in metres and radians.

    Parameters
    ----------
    text
        As "1.5e-3,2mm,90deg": m, cm, mm, um and rad, mrad, deg may stand behind a number.
    option
        Its name, for the message.
    units
        What is expected, as "m,m,rad".

    Raises
    ------
    ValueError
        It is something else.
    """
    kinds, parts = units.split(","), text.split(",")
    found = [_NUMBER.fullmatch(part) for part in parts]
    if len(parts) == len(kinds):
        known = [each and each[2] in _UNITS[kind] for each, kind in zip(found, kinds, strict=True)]
        if all(known):
            return tuple(
                float(each[1]) * _UNITS[kind][each[2]] for each, kind in zip(found, kinds, strict=True) if each
            )
    ends = {"m": "m (or cm, mm, um)", "rad": "rad (or mrad, deg)"}
    wanted = ", ".join(ends[kind] for kind in kinds)
    raise ValueError(f"{option} is {text!r}, expected {len(kinds)} number{'s' * (len(kinds) > 1)}: {wanted}")


def layers_of(given: Sequence[str] | None) -> dict[str, str] | None:
    """Return what ``--layers`` say, as `read_artwork` takes it; None where there is none.

    Raises
    ------
    ValueError
        One is not of the form NAME=LAYER.
    """
    table = {}
    for each in given or ():
        name, equals, layer = each.partition("=")
        if not (name and equals and layer.strip()):
            raise ValueError(f"--layers is {each!r}, expected a name, or a pattern, and a layer: '*.gtl=top copper'")
        table[fnmatch.translate(name)] = layer.strip()
    return table or None
