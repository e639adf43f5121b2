"""Artwork against the program gerbv, an independent reader of Gerber and Excellon files.

gerbv draws a file with antialiasing: a pixel is set where half of it is covered. `Layer` answers for the same pixels,
from the polygons of the artwork, whether the centre is covered. Only pixels beside an edge may differ.
"""

from __future__ import annotations

import math
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from gpuvision.matching.artwork.artwork import Artwork, Holes, read_artwork
from gpuvision.matching.artwork.board_files import open_board, parsed
from gpuvision.matching.artwork.drawn_objects import drawn_objects
from gpuvision.matching.artwork.shapes import Layer, Shape, capsule, is_covered

Picture = npt.NDArray[np.bool_]

needs_gerbv = pytest.mark.skipif(shutil.which("gerbv") is None, reason="the program gerbv is not installed")

INCH = 25.4e-3
LAYERS = {r"copper\.gbr": "top copper", r"holes\.drl": "drill plated"}
# gerbv draws with cairo, which replaces a curve by chords within 0.1 pixel and rounds corners to 1/256 pixel.
CHORD_ERROR = 0.1 + 1 / 256
# gerbv rounds widths of strokes to whole pixels, a quarter of a pixel on either side at most, and rounds their ends and
# the places of flashes by up to 1 pixel in x and y. The synthetic files lie on the grid of the pixels.
OFF_GRID_ERROR = CHORD_ERROR + 0.25


@dataclass(frozen=True)
class Window:
    """Part of a board in pixels: lower left corner [inch], pixels per inch, and size [px]."""

    x: float
    y: float
    dpi: int
    columns: int
    rows: int

    @property
    def centres(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Centres of columns and rows [m], rows upwards."""
        return (
            (self.x + (np.arange(self.columns) + 0.5) / self.dpi) * INCH,
            (self.y + (np.arange(self.rows) + 0.5) / self.dpi) * INCH,
        )


# 6 x 4 mm, in pixels of 10 micrometres.
SMALL = Window(0.0, 0.0, 2540, 600, 400)


def drawn_by_gerbv(path: Path, window: Window) -> Picture:
    picture = path.with_suffix(".png")
    # gerbv takes a window in pixels up to 2000 pixels only, and truncates one in inches to whole pixels.
    width, height = (window.columns + 0.25) / window.dpi, (window.rows + 0.25) / window.dpi
    place = [f"--origin={window.x:.6f};{window.y:.6f}", f"--window_inch={width:.6f}x{height:.6f}", "--border=0"]
    colours = ["--background=#000000", "--foreground=#ffffffff", "--antialias"]
    command = ["gerbv", "--export=png", f"--output={picture}", f"--dpi={window.dpi}", *place, *colours, path]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    values = cv2.imread(str(picture), cv2.IMREAD_GRAYSCALE)
    assert values.shape == (window.rows, window.columns)
    return values[::-1] > 127


def rasterised(shapes: tuple[Shape, ...], window: Window) -> Picture:
    layer = Layer(shapes)
    x, y = window.centres
    share = np.linspace(0, 1, len(x))
    rows = [is_covered(layer.crossings(np.array([x[0], each]), np.array([x[-1], each])), share) for each in y]
    return np.stack(rows)


def check_equal(ours: Picture, theirs: Picture, *, error: float = CHORD_ERROR) -> None:
    """Compare pixels outside one-pixel bands along the edges of both pictures, and areas.

    The bands hide an edge that is displaced by two pixels at most. The area differs by at most the error [px] times the
    length of the edges. An edge has a pixel on either side for each pixel of its length, or more where it is slanted.
    """
    at_edges = edges(ours) | edges(theirs)
    assert ours.any()
    assert not ours.all()
    assert not np.any((ours != theirs) & ~at_edges)
    length = np.count_nonzero(edges(ours)) / 2
    assert abs(np.count_nonzero(ours) - np.count_nonzero(theirs)) <= error * length


def edges(picture: Picture) -> Picture:
    """Return the pixels with a neighbour of the other value."""
    values, kernel = picture.astype(np.uint8), np.ones((3, 3), np.uint8)
    return np.asarray(cv2.dilate(values, kernel) != cv2.erode(values, kernel))


def read(folder: Path, **files: str) -> Artwork:
    for name, text in files.items():
        (folder / {"copper": "copper.gbr", "holes": "holes.drl"}[name]).write_text(text)
    return read_artwork(folder, layers=LAYERS)


def gerber(*commands: str, head: str = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n") -> str:
    return head + "\n".join(commands) + "\nM02*\n"


def at(x: float, y: float, code: str) -> str:
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*"


def arc(x: float, y: float, i: float, j: float) -> str:
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}I{round(i * 1e6)}J{round(j * 1e6)}D01*"


def flashes(*apertures: str) -> str:
    """Return a file that flashes apertures side by side, from (1, 1.5) mm in steps of 2 mm."""
    defined = [f"%ADD{10 + k}{each}*%" for k, each in enumerate(apertures)]
    flashed = [f"D{10 + k}*\n{at(1 + 2 * k, 1.5, 'D03')}" for k in range(len(apertures))]
    return gerber(*defined, *flashed)


def macro(*primitives: str, values: str = "") -> str:
    return gerber("%AMSHAPE*", "*\n".join(primitives) + "*%", f"%ADD10SHAPE{values}*%", "D10*", at(3, 2, "D03"))


def stroke(*points: tuple[float, float]) -> str:
    return "\n".join(at(*each, "D02" if k == 0 else "D01") for k, each in enumerate(points))


SQUARE = stroke((0.4, 0.4), (2.4, 0.4), (2.4, 2.4), (0.4, 2.4), (0.4, 0.4))
L_SHAPE = "4,1,6,0,0,1.4,0,1.4,0.5,0.5,0.5,0.5,1.0,0,1.0,0,0"
APERTURES = {
    "circle": flashes("C,1.2", "C,1.2X0.5"),
    "rectangle": flashes("R,1.6X0.9", "R,0.9X1.6X0.4"),
    "obround": flashes("O,1.6X0.9", "O,0.9X1.6X0.4", "O,1.2X1.2"),
    "triangle": flashes("P,1.6X3", "P,1.6X3X20", "P,1.6X3X-50X0.4"),
    "pentagon": flashes("P,1.6X5", "P,1.6X5X20", "P,1.6X5X0X0.4"),
    "octagon": flashes("P,1.6X8", "P,1.6X8X22.5", "P,1.6X8X22.5X0.4"),
    "macro circle": macro("1,1,1.5,0.2,-0.3"),
    "macro vector line": macro("20,1,0.4,-0.9,-0.3,0.8,0.7"),
    "macro vector line turned": macro("20,1,0.4,0.2,0.1,1.3,0.6,70"),
    "macro centre line": macro("21,1,1.8,0.6,0.3,0.2"),
    "macro centre line turned": macro("21,1,1.8,0.6,0.4,0.2,-35"),
    "macro outline": macro(f"{L_SHAPE},0"),
    "macro outline turned": macro(f"{L_SHAPE},130"),
    "macro polygon": macro("5,1,6,0,0,1.8,0"),
    "macro polygon turned": macro("5,1,5,0,0,1.8,25"),
    "macro polygon beside": macro("5,1,5,0.8,0.3,1.4,0"),
    "macro thermal": macro("7,0,0,2.4,1.4,0.4,0"),
    "macro thermal turned": macro("7,0,0,2.4,1.4,0.4,25"),
    "macro exposure off": macro("1,1,2.4,0,0", "21,0,1.8,0.5,0,0,30", "1,1,0.9,0,0"),
    "macro expressions": macro(
        "0 a rectangle and a disk", "$3=$1x0.5", "21,1,$1,$2,0,0,0", "1,1,$3+0.2,$1/2-0.1,-$2/2", values=",1.6X0.9"
    ),
}
DRAWN = {
    "strokes": gerber("%ADD10C,0.4*%", "D10*", stroke((0.5, 0.5), (3, 0.7), (5, 3), (1, 3.3))),
    "strokes of a rectangle": gerber("%ADD10R,0.4X0.6*%", "D10*", stroke((1, 1), (4, 1), (5, 3))),
    "arcs G75": gerber(
        "%ADD10C,0.3*%", "G75*", "D10*", at(1, 1, "D02"), "G02*", arc(3, 1, 1, 0), "G03*", arc(5, 1, 1, 0), "G01*"
    ),
    "large arcs G75": gerber("%ADD10C,0.3*%", "G75*", "D10*", at(2, 2, "D02"), "G03*", arc(3, 3, 1, 0)),
    "circle G75": gerber("%ADD10C,0.3*%", "G75*", "D10*", at(2, 2, "D02"), "G02*", arc(2, 2, 1, 0)),
    "circle G75 counter-clockwise": gerber("%ADD10C,0.3*%", "G75*", "D10*", at(2, 2, "D02"), "G03*", arc(2, 2, 1, 0)),
    "arcs G74": gerber(
        "%ADD10C,0.3*%", "G74*", "D10*", at(1, 1, "D02"), "G02*", arc(2, 2, 1, 0), "G03*", arc(3, 3, 0, 1), "G01*"
    ),
    "modal codes without zeros": gerber(
        "%ADD10C,0.3*%", "G75*", "D10*", at(1, 1, "D02"), "G2*", arc(3, 1, 1, 0), "G1*", at(5, 2, "D01"),
        "G3" + arc(3, 3, -1, 0),
    ),
    "region": gerber("G36*", SQUARE, "G37*"),
    "region of two contours": gerber("G36*", SQUARE, stroke((3, 1), (5, 1), (4, 3), (3, 1)), "G37*"),
    "region with arcs": gerber(
        "G75*", "G36*", at(1, 1, "D02"), at(4, 1, "D01"), "G03*", arc(4, 3, 0, 1), "G01*", at(1, 3, "D01"),
        "G02*", arc(1, 1, -1, -1), "G01*", "G37*",
    ),
    "region of a circle": gerber("G75*", "G36*", at(1, 2, "D02"), "G03*", arc(1, 2, 1.5, 0), "G01*", "G37*"),
    "region with arcs G74": gerber(
        "G74*", "G36*", at(1, 1, "D02"), at(4, 1, "D01"), "G03*", arc(5, 2, 0, 1), "G01*", at(1, 2, "D01"),
        at(1, 1, "D01"), "G37*",
    ),
    "region with a cut-in": gerber(
        "G36*", stroke((0.5, 0.5), (5, 0.5), (5, 3.5), (0.5, 3.5), (0.5, 2), (1.5, 2), (1.5, 3), (4, 3), (4, 1),
                       (1.5, 1), (1.5, 2), (0.5, 2), (0.5, 0.5)), "G37*",
    ),
}  # fmt: skip
SR = "%ADD10C,0.5*%", "%ADD11R,0.6X0.3*%"
REPEATED = {
    "flashes": gerber(*SR, "%SRX3Y2I1.5J1.2*%", "D10*", at(1, 1, "D03"), "D11*", at(1.5, 1.4, "D03"), "%SR*%"),
    "strokes and arcs": gerber(
        *SR, "G75*", "%SRX2Y2I2.5J1.7*%", "D10*", at(1, 1, "D02"), "G02*", arc(2, 1, 0.5, 0), "G01*", "%SR*%"
    ),
    "regions": gerber(
        "G75*", "%SRX2Y1I2.5J0*%", "G36*", at(1, 1, "D02"), at(2, 1, "D01"), "G03*", arc(2, 3, 0, 1), "G01*",
        at(1, 3, "D01"), at(1, 1, "D01"), "G37*", "%SR*%",
    ),
    "then more": gerber(*SR, "%SRX3Y1I1.5J0*%", "D10*", at(1, 1, "D03"), "%SR*%", "D11*", at(3, 3, "D03")),
    "one after the other": gerber(
        *SR, "%SRX3Y1I1.5J0*%", "D10*", at(1, 1, "D03"), "%SR*%", "%SRX1Y2I0J1*%", "D11*", at(3, 2, "D03"), "%SR*%"
    ),
    "closed by the next": gerber(
        *SR, "%SRX3Y1I1.5J0*%", "D10*", at(1, 1, "D03"), "%SRX1Y1I0J0*%", "D11*", at(3, 3, "D03")
    ),
    "closed by the end": gerber(*SR, "%SRX3Y1I1.5J0*%", "D10*", at(1, 1, "D03")),
    "inches": gerber(
        "%ADD10C,0.02*%", "%SRX3Y2I0.06J0.05*%", "D10*", "X400Y400D03*", "%SR*%",
        head="%FSLAX24Y24*%\n%MOIN*%\n%LPD*%\nG01*\n",
    ),
}  # fmt: skip
POLARITY = {
    "nested": gerber(
        "%ADD10C,3.6*%", "%ADD11C,2.6*%", "%ADD12C,1.6*%", "%ADD13C,0.8*%", "D10*", at(3, 2, "D03"), "%LPC*%", "D11*",
        at(3, 2, "D03"), "%LPD*%", "D12*", at(3, 2, "D03"), "%LPC*%", "D13*", at(3, 2, "D03"),
    ),
    "cleared stroke and region": gerber(
        "%ADD10R,5X3*%", "%ADD11C,0.4*%", "D10*", at(3, 2, "D03"), "%LPC*%", "D11*", stroke((1, 1), (5, 3)), "G36*",
        stroke((1, 2), (2, 2), (2, 3), (1, 2)), "G37*", "%LPD*%", "D11*", stroke((1, 3), (5, 1)),
    ),
    "cleared aperture with a hole": gerber(
        "%ADD10R,5X3*%", "%ADD11C,1.5X0.6*%", "D10*", at(3, 2, "D03"), "%LPC*%", "D11*", at(3, 2, "D03")
    ),
}  # fmt: skip
FORMATS = {
    "inches": gerber("%ADD10C,0.04*%", "D10*", "X500Y500D03*", head="%FSLAX24Y24*%\n%MOIN*%\n%LPD*%\nG01*\n"),
    "trailing zeros omitted": gerber("%ADD10C,1*%", "D10*", "X002Y0015D03*", head="%FSTAX33Y33*%\n%MOMM*%\n%LPD*%\n"),
    "negative": gerber("%ADD10C,8*%", "D10*", "X-1000Y-2000D03*", head="%FSLAX33Y33*%\n%MOMM*%\n%LPD*%\n"),
    "modal coordinates": gerber("%ADD10C,0.4*%", "D10*", "X1000000Y1000000D02*", "X3000000D01*", "Y3000000D01*"),
    "macro in inches": gerber(
        "%AMBOX*", "21,1,$1,$2,0.02,0,30*", "5,1,5,-0.03,0,0.04,0*%", "%ADD10BOX,0.05X0.03*%", "D10*", "X1000Y800D03*",
        head="%FSLAX24Y24*%\n%MOIN*%\n%LPD*%\n",
    ),
    "thermal in inches": gerber(
        "%AMTHERMAL*", "7,0.01,0,$1,0.05,0.015,0*%", "%ADD10THERMAL,0.09*%", "D10*", "X1000Y800D03*",
        head="%FSLAX24Y24*%\n%MOIN*%\n%LPD*%\n",
    ),
}  # fmt: skip
CASES = {
    f"{group}: {name}": text
    for group, texts in {
        "aperture": APERTURES,
        "drawn": DRAWN,
        "repeated": REPEATED,
        "polarity": POLARITY,
        "format": FORMATS,
    }.items()
    for name, text in texts.items()
}


def turned(x: float, y: float, degrees: float) -> str:
    cos, sin = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    return f"{x * cos - y * sin:.6f},{x * sin + y * cos:.6f}"


def l_shape(mirror: tuple[int, int] = (1, 1), degrees: float = 0, scale: float = 1) -> str:
    """Return the outline of the L after mirroring, rotation and scaling, in this order."""
    corners = [
        turned(scale * mirror[0] * x, scale * mirror[1] * y, degrees)
        for x, y in ((0, 0), (1.4, 0), (1.4, 0.5), (0.5, 0.5), (0.5, 1), (0, 1), (0, 0))
    ]
    return ",".join(["4,1,6", *corners, "0"])


PADS = ("%AMELL*", f"{L_SHAPE},0*%", "%ADD10ELL*%", "%ADD11C,0.4*%", "%ADD12R,1.4X0.6*%", "%ADD13O,1.4X0.6X0.3*%",
        "D10*")  # fmt: skip


def alone(outline: str, *commands: str) -> str:
    """Return a file whose aperture 10 is an outline."""
    return gerber("%AMELL*", f"{outline}*%", "%ADD10ELL*%", "D10*", *commands)


CENTRE = at(3, 2, "D03")
DIAGONAL = math.dist((1, 1), (3, 3))
# Pairs of files for commands that gerbv 2.9.6 ignores or draws wrongly: the first file has the command; the second, for
# gerbv, draws the same without it. Section numbers refer to the Gerber Layer Format Specification, revision 2024.05
# (Ucamco).
TWINS = {
    # Section 4.5.3: primitives turn about the origin of the macro. gerbv does not turn the centre of a circle, and
    # turns polygons and thermals about their own centres.
    "macro circle turned": (macro("1,1,1.0,1.2,0.3,40"), macro(f"1,1,1.0,{turned(1.2, 0.3, 40)}")),
    "macro polygon turned": (macro("5,1,5,0.8,0.3,1.4,50"), macro(f"5,1,5,{turned(0.8, 0.3, 50)},1.4,50")),
    "macro thermal turned": (macro("7,0.5,0.3,2.4,1.4,0.4,30"), macro(f"7,{turned(0.5, 0.3, 30)},2.4,1.4,0.4,30")),
    # Section 4.5.1.8: the hole lies within the cross of gaps. gerbv draws more than the four parts.
    "macro thermal without a ring": (
        macro("7,0,0,2.4,0.5,0.4,0"),
        macro("1,1,2.4,0,0", "21,0,3,0.4,0,0,0", "21,0,0.4,3,0,0,0"),
    ),
    # Section 3.4.5: a name has one character or more. gerbv takes a single letter for a type of aperture.
    "macro of one letter": (macro("21,1,1.8,0.6,0,0,10").replace("SHAPE", "M"), macro("21,1,1.8,0.6,0,0,10")),
    # Section 4.12: each copy is dark and clear as a whole. gerbv draws the dark parts of all copies first.
    "repeated polarity": (
        gerber("%ADD10C,0.5*%", "%ADD12C,1.6*%", "%SRX3Y1I0.9J0*%", "D12*", at(1.2, 2, "D03"), "%LPC*%", "D10*",
               at(1.2, 2, "D03"), "%LPD*%", "%SR*%"),
        gerber("%ADD10C,0.5*%", "%ADD12C,1.6*%", *(
            f"%LPD*%\nD12*\n{at(x, 2, 'D03')}\n%LPC*%\nD10*\n{at(x, 2, 'D03')}" for x in (1.2, 2.1, 3.0)
        )),
    ),
    # Section 4.9: gerbv ignores LM, LR and LS.
    "mirrored in x": (gerber(*PADS, "%LMX*%", CENTRE), alone(l_shape((-1, 1)), CENTRE)),
    "mirrored in y": (gerber(*PADS, "%LMY*%", CENTRE), alone(l_shape((1, -1)), CENTRE)),
    "mirrored in both": (gerber(*PADS, "%LMXY*%", CENTRE), alone(l_shape((-1, -1)), CENTRE)),
    "rotated": (gerber(*PADS, "%LR30*%", CENTRE), alone(l_shape(degrees=30), CENTRE)),
    "rotated rectangle": (gerber(*PADS, "D12*", "%LR30*%", CENTRE), macro("21,1,1.4,0.6,0,0,30")),
    "rotated obround with a hole": (
        gerber(*PADS, "D13*", "%LR30*%", CENTRE),
        macro("21,1,0.8,0.6,0,0,30", f"1,1,0.6,{turned(0.4, 0, 30)}", f"1,1,0.6,{turned(-0.4, 0, 30)}", "1,0,0.3,0,0"),
    ),
    "scaled": (gerber(*PADS, "%LS1.3*%", CENTRE), alone(l_shape(scale=1.3), CENTRE)),
    "scaled disk with a hole": (flashes("C,1.2X0.5").replace("D10*", "%LS1.4*%\nD10*"), flashes("C,1.68X0.7")),
    "scaled strokes": (
        gerber(*PADS, "D11*", "%LS1.5*%", stroke((1, 1), (4, 3)), "%LS1*%", stroke((1, 3), (2, 3))),
        gerber("%ADD10C,0.6*%", "%ADD11C,0.4*%", "D10*", stroke((1, 1), (4, 3)), "D11*", stroke((1, 3), (2, 3))),
    ),
    "rotated strokes of a square": (
        gerber("%ADD10R,0.4X0.4*%", "D10*", "%LR45*%", stroke((1, 1), (3, 3))),
        alone("4,1,4," + ",".join(turned(x, y, 45) for x, y in (
            (-0.2, -0.2), (DIAGONAL + 0.2, -0.2), (DIAGONAL + 0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2)
        )) + ",0", at(1, 1, "D03")),
    ),
    "mirrored, rotated and scaled": (
        gerber(*PADS, "%LS1.2*%", "%LR70*%", "%LMX*%", CENTRE), alone(l_shape((-1, 1), 70, 1.2), CENTRE)
    ),
    "transformed and set back": (
        gerber(*PADS, "%LMX*%", "%LR70*%", "%LMN*%", "%LR0*%", CENTRE), alone(f"{L_SHAPE},0", CENTRE)
    ),
}  # fmt: skip


@needs_gerbv
@pytest.mark.parametrize("text", CASES.values(), ids=CASES.keys())
def test_gerber_is_drawn_as_gerbv_draws_it(tmp_path: Path, text: str) -> None:
    board = read(tmp_path, copper=text)
    check_equal(rasterised(board.copper, SMALL), drawn_by_gerbv(tmp_path / "copper.gbr", SMALL))


@needs_gerbv
@pytest.mark.parametrize(("text", "twin"), TWINS.values(), ids=TWINS.keys())
def test_gerber_is_drawn_as_gerbv_draws_its_twin(tmp_path: Path, text: str, twin: str) -> None:
    board = read(tmp_path, copper=text)
    path = tmp_path / "twin.gbr"
    path.write_text(twin)
    check_equal(rasterised(board.copper, SMALL), drawn_by_gerbv(path, SMALL))


@needs_gerbv
@pytest.mark.parametrize("ring", ["C,1.5X0.9", "RING"])
def test_hole_shows_the_copper_below(tmp_path: Path, ring: str) -> None:
    """A hole of an aperture, and an area that a macro erases, do not affect earlier objects (sections 4.4.6, 4.5.1)."""
    text = gerber("%AMRING*", "1,1,1.5,0,0*", "1,0,0.9,0,0*%", "%ADD10R,5X0.4*%", f"%ADD11{ring}*%", "D10*", CENTRE,
                  "D11*", CENTRE)  # fmt: skip
    board = read(tmp_path, copper=text)
    check_equal(rasterised(board.copper, SMALL), drawn_by_gerbv(tmp_path / "copper.gbr", SMALL))


ROUND_AND_SLOT = "T1\nX1.0Y1.0\n{slot}\nT2\nX1.0Y3.0\n"
G85_SLOT = "X3.0Y1.0G85X4.5Y2.0"
ROUTED_SLOT = "G00X3.0Y1.0\nM15\nG01X4.5Y2.0\nM16\nG05"


def drills(body: str, units: str = "METRIC", tools: tuple[float, float] = (0.6, 0.4)) -> str:
    return f"M48\n{units}\nT1C{tools[0]:.4f}\nT2C{tools[1]:.4f}\n%\nG90\nG05\n{body}T0\nM30\n"


MILLIMETRES = drills(ROUND_AND_SLOT.format(slot=G85_SLOT))
# The file, and one for gerbv, which ignores routes.
DRILLS = {
    "slot by G85": (MILLIMETRES, MILLIMETRES),
    "routed slot": (drills(ROUND_AND_SLOT.format(slot=ROUTED_SLOT)), MILLIMETRES),
    "inches": (drills("T1\nX0.05Y0.05\nX0.15Y0.05G85X0.2Y0.1\nT2\nX0.1Y0.12\n", "INCH", (0.03, 0.02)),) * 2,
    "trailing zeros kept": (drills("T1\nX1000Y1000\nX3000Y1500\n", "METRIC,TZ,000.000"),) * 2,
    "leading zeros kept": (drills("T1\nX001Y001\nX003Y0015\n", "METRIC,LZ,000.000"),) * 2,
    "modal coordinates": (drills("T1\nX1.0Y1.0\nX3.0\nY3.0\n"),) * 2,
}


@needs_gerbv
@pytest.mark.parametrize(("text", "twin"), DRILLS.values(), ids=DRILLS.keys())
def test_holes_are_where_gerbv_draws_them(tmp_path: Path, text: str, twin: str) -> None:
    board = read(tmp_path, copper=flashes("C,1"), holes=text)
    path = tmp_path / "twin.drl"
    path.write_text(twin)
    check_equal(rasterised(drilled(board.holes), SMALL), drawn_by_gerbv(path, SMALL))


def drilled(holes: Holes) -> tuple[Shape, ...]:
    ends = zip(holes.start, holes.end, holes.diameter, strict=True)
    return tuple(Shape(capsule(start, end, across / 2)) for start, end, across in ends)


BOARDS = (
    "upverter",
    "eagle",
    pytest.param("fritzing", marks=pytest.mark.nightly),
    *(f"kicad-x2-tests/{each}" for each in ("x2ap", "nox2noap")),
    # The same board with one of two features of the format, of which the two above have both or none.
    *(pytest.param(f"kicad-x2-tests/{each}", marks=pytest.mark.nightly) for each in ("nox2ap", "x2noap")),
)


@needs_gerbv
@pytest.mark.realdata
@pytest.mark.slow
@pytest.mark.parametrize("name", BOARDS)
def test_boards_are_drawn_as_gerbv_draws_them(data: Path, tmp_path: Path, name: str) -> None:
    with open_board(data / "gerber" / name, None) as stack:
        for file in stack.graphic_layers.values():
            shapes = tuple(shape for each in drawn_objects(parsed(file)) for shape in each.shapes)
            if shapes:
                window = around(shapes)
                path = Path(shutil.copy(file.original_path, tmp_path))
                drawn = rasterised(shapes, window), drawn_by_gerbv(path, window)
                check_equal(*drawn, error=OFF_GRID_ERROR)


def around(shapes: tuple[Shape, ...]) -> Window:
    """Return a window around shapes, with pixels of 20 micrometres.

    The window is offset by a fraction of a pixel, so that edges on a CAD grid never pass through pixel centres.
    """
    dpi = 1270
    low, high = (np.array([each(shape.outline, axis=0) for shape in shapes]) for each in (np.min, np.max))
    corner = np.round(np.min(low, axis=0) / INCH - np.array([10.382, 10.236]) / dpi, 6)
    columns, rows = np.ceil((np.max(high, axis=0) / INCH - corner) * dpi).astype(int) + 10
    return Window(float(corner[0]), float(corner[1]), dpi, int(columns), int(rows))
