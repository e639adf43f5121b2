"""Field files: TOML with the lines and arcs in metres relative to the field's centre.

The package contains the fields in `FIELDS`.
"""

from __future__ import annotations

import math
from pathlib import Path

from gpuvision.matching.field.distance_map import Arc, Field
from gpuvision.schema import Section, read_preset

FIELDS = ("robocup_msl", "robocup_junior")
"""Names of the fields in the package."""


def read_field(path: str | Path) -> Field:
    """Read a field.

    Parameters
    ----------
    path : str or Path
        Path of a file, or one of `FIELDS`.

    Returns
    -------
    Field

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is missing, unknown or has a wrong value; the message names the key.
    """
    return _field(read_preset(path, "fields", "field"))


def _field(top: Section) -> Field:
    name = top.text("name", "")
    length, width = (top.number(key, "m", above=0.0) for key in ("length", "width"))
    lines = tuple((*each[0], *each[1]) for each in (_ends(table) for table in top.sections("line")))
    arcs = tuple(_arc(table) for table in top.sections("arc"))
    top.finish()
    with top.checking():
        return Field(length=length, width=width, lines=lines, arcs=arcs, name=name)


def _ends(table: Section) -> tuple[tuple[float, float], tuple[float, float]]:
    (x0, y0), (x1, y1) = table.numbers("from", "m", (2,)), table.numbers("to", "m", (2,))
    table.finish()
    return (x0, y0), (x1, y1)


def _arc(table: Section) -> Arc:
    x, y = table.numbers("centre", "m", (2,))
    radius = table.number("radius", "m", above=0.0)
    start, end = table.number("start_degrees", "degree", 0.0), table.number("end_degrees", "degree", 360.0)
    table.finish()
    return Arc(x, y, radius, math.radians(start), math.radians(end))
