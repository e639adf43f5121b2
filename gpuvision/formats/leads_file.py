"""CSV files of the regions of leads or balls: name, centre, sides and angle of rectangles, in metres and radians."""

from __future__ import annotations

import csv
import math
import os
from pathlib import Path

import numpy as np

from gpuvision.host.errors import ReadError
from gpuvision.host.reading import FileLimit, reading
from gpuvision.inspection.apertures import Aperture, make_aperture
from gpuvision.matching.artwork.shapes import Shape

MAX_LEADS = FileLimit("GPUVISION_MAX_LEADS", 10_000)
"""Leads of a component. Chosen: 10 000; the largest ball grid arrays have 5000."""
_COLUMNS = ("name", "x", "y", "width", "height")
_LONGEST_LINE = 1000


def read_leads(path: str | os.PathLike[str]) -> tuple[Aperture, ...]:
    """Read the regions of leads: rectangles with a name, a centre, two sides and an angle (default 0).

    Parameters
    ----------
    path : path-like
        CSV file with the header ``name,x,y,width,height`` or ``name,x,y,width,height,angle``; lengths [m], angle [rad].

    Returns
    -------
    tuple of Aperture

    Raises
    ------
    ReadError
        The file has another header, a row has no finite numbers or sides above 0, two rows have one name, or there are
        more than `MAX_LEADS`.
    """
    path = Path(path)
    regions: list[Aperture] = []
    lines: dict[str, int] = {}  # line number of each name
    with reading(path, "CSV file of leads"), path.open(newline="", encoding="utf-8-sig") as file:
        header = [each.strip() for each in file.readline(_LONGEST_LINE).split(",")]
        if tuple(header[:5]) != _COLUMNS or header[5:] not in ([], ["angle"]):
            raise ReadError(f"{path}: the header is not {','.join(_COLUMNS)}[,angle]; lengths are metres")
        for number, row in enumerate(csv.reader(iter(lambda: file.readline(_LONGEST_LINE), "")), 2):
            if not any(each.strip() for each in row):
                continue
            MAX_LEADS.check(len(regions) + 1, f"{path}: {len(regions) + 1} leads or more")
            if len(row) != len(header):
                raise ReadError(f"{path}: line {number} has {len(row)} cells, expected {len(header)}")
            x, y, width, height, *angle = (float(each) for each in row[1:])
            turn = angle[0] if angle else 0.0
            if not all(map(math.isfinite, (x, y, turn, width, height))) or not (width > 0 and height > 0):
                raise ReadError(f"{path}: line {number}: expected finite numbers and sides above 0 [m]")
            name = row[0].strip() or str(number - 1)
            if lines.setdefault(name, number) != number:
                raise ReadError(
                    f"{path}: line {number}: the name {name!r} already stands in line {lines[name]}; give another one"
                )
            cos, sin = math.cos(turn), math.sin(turn)
            corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * np.array([width, height]) / 2
            outline = corners @ np.array([[cos, sin], [-sin, cos]]) + np.array([x, y])
            regions.append(make_aperture(name, [Shape(outline)]))
    if not regions:
        raise ReadError(f"{path}: no lead; expected one line for each lead")
    return tuple(regions)
