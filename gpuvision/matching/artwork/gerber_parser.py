"""Parser of Gerber files: gerbonara's parser, with the commands that gerbonara 1.5 draws wrongly or ignores.

Section numbers refer to the Gerber Layer Format Specification, revision 2024.05 (Ucamco).
"""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from gerbonara.apertures import CircleAperture, PolygonAperture
from gerbonara.graphic_objects import Region
from gerbonara.rs274x import GerberFile, GerberParser

from gpuvision.host.reading import FileLimit

MAX_BOARD_OBJECTS = FileLimit("GPUVISION_MAX_BOARD_OBJECTS", 100_000)
"""Objects of a layer, repeated ones included. Chosen: 100 000, which take 110 MiB and 7 s to build. The largest layer
of the boards in the tests has 23 000 objects; a panel of 100 boards with 1000 objects each is accepted."""
_SHORT_CODE = re.compile(r"\AG(?=[1-3](?!\d))")  # G1, G2 and G3; gerbonara reads G01, G02 and G03
# Name of a macro (section 3.4.5), and the statements with one; gerbonara expects two characters or more.
_NAME = r"[a-zA-Z_$.][a-zA-Z_$.0-9+\-]*"
_NAMED = ("aperture_definition", "aperture_macro")
_DECIMAL = r"[+-]?\d*\.?\d+"


def parse_gerber(text: str, path: Path) -> GerberFile:
    """Return the objects of a Gerber file.

    Parameters
    ----------
    text : str
        Content of the file.
    path : pathlib.Path
        Name of the file, for messages.

    Raises
    ------
    SyntaxError
        The text is not a Gerber file.
    """
    file = GerberFile()
    _Parser(file).parse(text, filename=path)
    return file


@dataclass(frozen=True)
class TransformedAperture:
    """Aperture that is mirrored, rotated and scaled when it is flashed (section 4.9).

    Attributes
    ----------
    aperture
        Aperture of gerbonara, not transformed.
    matrix
        (2, 2) matrix of the transform.
    """

    aperture: Any
    matrix: npt.NDArray[np.float64]

    @property
    def attrs(self) -> Any:
        """Attributes of Gerber X2."""
        return self.aperture.attrs

    def equivalent_width(self, unit: Any = None) -> float:
        """Return the width of a stroke, which gerbonara asks for; only circles and rectangles have one."""
        return float(self.aperture.equivalent_width(unit)) * math.sqrt(abs(np.linalg.det(self.matrix)))


class _Parser(GerberParser):  # type: ignore[misc]  # gerbonara has no type annotations: its classes are Any
    """Parser that also draws step-and-repeat, transformed apertures and rotated polygons, and reads G1, G2 and G3."""

    STATEMENT_REGEXES: ClassVar[dict[str, str]] = {
        "load_mirroring": r"LM(?P<axes>N|XY|X|Y)$",
        "load_rotation": rf"LR(?P<degrees>{_DECIMAL})$",
        "load_scaling": rf"LS(?P<factor>{_DECIMAL})$",
        "block_aperture": r"AB",
        **GerberParser.STATEMENT_REGEXES,
        **{name: GerberParser.STATEMENT_REGEXES[name].replace(GerberParser.NAME, _NAME) for name in _NAMED},
    }

    def __init__(self, target: GerberFile) -> None:
        super().__init__(target)
        self._selected: Any = None  # aperture before its transform
        self._mirrored, self._rotation, self._scale = "N", 0.0, 1.0
        # Objects from this index are in an open block; the moves of its copies, in units of the file.
        self._block_start = 0
        self._moves: list[tuple[float, float]] = []

    def _split_commands(self, data: str) -> Iterator[str]:
        for command in super()._split_commands(data):
            yield _SHORT_CODE.sub("G0", command)

    def _parse_aperture_definition(self, match: re.Match[str]) -> None:
        """Define an aperture; the rotation of a polygon is in degrees (section 4.4.5), gerbonara's in radians."""
        super()._parse_aperture_definition(match)
        number = int(match["number"])
        aperture = self.aperture_map[number]
        if isinstance(aperture, PolygonAperture):
            self.aperture_map[number] = replace(aperture, rotation=math.radians(aperture.rotation or 0.0))

    def _parse_aperture(self, match: re.Match[str]) -> None:
        super()._parse_aperture(match)
        self._selected = self.graphics_state.aperture
        self._transform()

    def _parse_load_mirroring(self, match: re.Match[str]) -> None:
        self._mirrored = match["axes"]
        self._transform()

    def _parse_load_rotation(self, match: re.Match[str]) -> None:
        self._rotation = math.radians(float(match["degrees"]))
        self._transform()

    def _parse_load_scaling(self, match: re.Match[str]) -> None:
        self._scale = float(match["factor"])
        if not self._scale > 0:
            raise ValueError(f"a scale of {match['factor']}, expected above 0")
        self._transform()

    def _parse_block_aperture(self, match: re.Match[str]) -> None:
        """Refuse block apertures (section 4.11); gerbonara ignores the command, and draws the block at once."""
        raise ValueError("a block aperture (AB) is not supported")

    def _transform(self) -> None:
        """Apply mirroring, then rotation, then scaling to the selected aperture (section 4.9.1)."""
        aperture = self._selected
        if aperture is not None and (self._mirrored, self._rotation, self._scale) != ("N", 0.0, 1.0):
            cos, sin = math.cos(self._rotation), math.sin(self._rotation)
            mirror = [-1.0 if "X" in self._mirrored else 1.0, -1.0 if "Y" in self._mirrored else 1.0]
            if isinstance(aperture, CircleAperture):
                aperture = aperture.scaled(self._scale)
            else:
                matrix = self._scale * np.array([[cos, -sin], [sin, cos]]) @ np.diag(mirror)
                aperture = TransformedAperture(aperture, matrix)
        self.graphics_state.aperture = aperture

    def _parse_step_repeat(self, match: re.Match[str]) -> None:
        """Close the open block, and open the next one (section 4.12).

        gerbonara draws the block only once: it tests a list of objects, empty at first, for its truth.
        """
        self._close_block()
        if match["coords"]:
            columns, rows = int(match["X"]), int(match["Y"])
            if columns < 1 or rows < 1:
                raise ValueError(f"a step-and-repeat of {columns} x {rows}, expected 1 x 1 or more")
            # A % in other text hides the command from `check_gerber`, which splits the text otherwise.
            copies = columns * rows
            MAX_BOARD_OBJECTS.check(copies, f"a step-and-repeat of {copies} copies", ValueError)
            step = float(match["I"]), float(match["J"])
            self._block_start = len(self.target.objects)
            self._moves = [(step[0] * column, step[1] * row) for column in range(columns) for row in range(rows)]

    def _parse_eof(self, match: re.Match[str]) -> None:
        self._close_block()
        super()._parse_eof(match)

    def _close_block(self) -> None:
        """Append the copies of the block, each as a whole: a later copy covers an earlier one."""
        block = self.target.objects[self._block_start :]
        objects = len(self.target.objects) + len(block) * max(len(self._moves) - 1, 0)
        MAX_BOARD_OBJECTS.check(objects, f"{objects} objects", ValueError)
        for move in self._moves[1:]:
            self.target.objects += [_moved(item, *move) for item in block]
        self._moves = []


def _moved(item: Any, x: float, y: float) -> Any:
    """Return a copy of an object, moved in its units; gerbonara leaves the centres of a region's arcs in place."""
    moved = copy.copy(item)
    moved.offset(x, y, moved.unit)
    if isinstance(moved, Region):
        moved.arc_centers = [arc and (arc[0], (arc[1][0] + x, arc[1][1] + y)) for arc in moved.arc_centers]
    return moved
