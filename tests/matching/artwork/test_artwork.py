"""Artwork: a small synthetic board with known numbers, and boards of three CAD tools."""

from __future__ import annotations

import functools
import math
import tracemalloc
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from gerbonara import LayerStack
from gerbonara.utils import MM
from matplotlib.path import Path as Outline

from gpuvision.matching.artwork.artwork import Artwork, Pad, read_artwork
from gpuvision.matching.artwork.edges import _joined
from gpuvision.matching.artwork.shapes import (
    SAGITTA,
    DrawnObject,
    Layer,
    Shape,
    _BoxIndex,
    area,
    capsule,
    disk,
    is_covered,
)

LAYERS = {
    r"copper\.gbr": "top copper",
    r"mask\.gbr": "top mask",
    r"silk\.gbr": "top silk",
    r"paste\.gbr": "top paste",
    r"outline\.gbr": "mechanical outline",
    r"plated\.drl": "drill plated",
    r"bare\.drl": "drill nonplated",
}
HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
BOARDS = ("fritzing", "upverter", *(f"kicad-x2-tests/{each}" for each in ("x2ap", "nox2ap", "x2noap", "nox2noap")))
# Gerbonara takes seconds for each board; the fast tier reads the smallest one.
ONE_BOARD_FAST = [pytest.param(each, marks=[] if each == "upverter" else pytest.mark.slow) for each in BOARDS]


def at(x: float, y: float, code: str) -> str:
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}{code}*\n"


def line(x: float, y: float, to_x: float, to_y: float) -> str:
    return at(x, y, "D02") + at(to_x, to_y, "D01")


# 20 x 10 mm. A trace 0.4 mm wide from a via at (2, 5) to (12, 5), crossed by silk 0.2 mm wide at x = 6, under an
# opening from x = 8 to 10; a trace at 45 degrees from (12, 5); a via, a through-hole pad, a pad of a part, a fiducial.
COPPER = (
    "%AMTURNED*21,1,$1,$2,0,0,$3*%\n%ADD10C,0.4*%\n%ADD11C,0.8*%\n%ADD12C,1.6*%\n%ADD13R,1.5X0.9*%\n"
    "%ADD14C,1.0*%\n%ADD15TURNED,2.0X1.0X30*%\n"
    "D10*\n"
    + line(2, 5, 7, 5)
    + line(7, 5, 12, 5)
    + line(12, 5, 10, 5)  # drawn twice, as tools do
    + line(12, 5, 15, 8)
    + "D11*\n"
    + at(2, 5, "D03")
    + "D12*\n"
    + at(17, 2, "D03")
    + "D13*\n"
    + at(5, 2, "D03")
    + "D14*\n"
    + at(2, 8, "D03")
    + "D15*\n"
    + at(10, 2, "D03")
)
MASK = (
    "%AMTURNED*21,1,$1,$2,0,0,$3*%\n%ADD10R,2.0X2.0*%\n%ADD12C,1.8*%\n%ADD13R,1.7X1.1*%\n%ADD14C,2.0*%\n"
    "%ADD15TURNED,2.2X1.2X30*%\n"
    "D10*\n"
    + at(9, 5, "D03")
    + "D12*\n"
    + at(17, 2, "D03")
    + "D13*\n"
    + at(5, 2, "D03")
    + "D14*\n"
    + at(2, 8, "D03")
    + "D15*\n"
    + at(10, 2, "D03")
)
SILK = "%ADD10C,0.2*%\nD10*\n" + line(6, 4, 6, 6)
PASTE = "%ADD13R,1.5X0.9*%\nD13*\n" + at(5, 2, "D03")
OUTLINE = "%ADD10C,0.1*%\nD10*\n" + line(0, 0, 20, 0) + at(20, 10, "D01") + at(0, 10, "D01") + at(0, 0, "D01")
PLATED = "M48\nMETRIC\nT1C0.300\nT2C0.900\n%\nG90\nG05\nT1\nX2.0Y5.0\nT2\nX17.0Y2.0\nT0\nM30\n"
BARE = "M48\nMETRIC\nT1C3.000\n%\nG90\nG05\nT1\nX18.0Y8.0\nT0\nM30\n"
BOARD = {
    "copper.gbr": COPPER,
    "mask.gbr": MASK,
    "silk.gbr": SILK,
    "paste.gbr": PASTE,
    "outline.gbr": OUTLINE,
    "plated.drl": PLATED,
    "bare.drl": BARE,
}


def written(folder: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (folder / name).write_text(text if name.endswith("drl") else HEAD + text + "M02*\n")
    return folder


def read(folder: Path, **changed: str) -> Artwork:
    files = {**BOARD, **{f"{name}.gbr": text for name, text in changed.items()}}
    return read_artwork(written(folder, files), layers=LAYERS)


@functools.cache
def real_board(path: Path) -> Artwork:
    return read_artwork(path)


def land_at(board: Artwork, x: float, y: float) -> Pad:
    (found,) = [each for each in board.pads if math.dist(each.centre, (x * 1e-3, y * 1e-3)) < 1e-6]
    return found


def test_a_filled_outline_is_cut_along_its_contour(tmp_path: Path) -> None:
    """A line of the outline has its width on both sides of the cut; the contour of a filled region is the cut."""
    corners = at(18, 0, "D01") + at(18, 9, "D01") + at(0, 9, "D01") + at(0, 0, "D01")
    board = read(tmp_path, outline="G36*\n" + at(0, 0, "D02") + corners + "G37*\n")
    assert board.bounds == pytest.approx(np.array([[0, 0], [18e-3, 9e-3]]), abs=1e-9)


def test_a_hole_that_is_repeated_in_place_is_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its 2e6 pairs would take 200 MB. A file may have 1e5 holes; their pairs would take all memory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    once = read(tmp_path).holes
    (tmp_path / "plated.drl").write_text(
        PLATED.replace("X2.0Y5.0\n", "X2.0Y5.0\nR2000X0.0\nX1.9951Y5.0\nX2.0051Y5.0\n")
    )
    tracemalloc.start()
    try:
        repeated = read_artwork(tmp_path, layers=LAYERS).holes
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()
    # A hole 4.9 um away is the same one, a hole 5.1 um away is another one.
    assert len(repeated.diameter) == len(once.diameter) + 1
    assert repeated.start[:, 0] == pytest.approx(np.insert(once.start[:, 0], 1, 2.0051e-3), abs=1e-12)


def test_says_what_each_spot_is_for(tmp_path: Path) -> None:
    board = read(tmp_path)
    assert len(board.pads) == 5
    via, hole, pad, fiducial, turned = (land_at(board, *each) for each in ((2, 5), (17, 2), (5, 2), (2, 8), (10, 2)))
    assert (via.role, via.shape, via.hole) == ("via", "circle", pytest.approx(0.3e-3))
    assert math.isnan(via.opening)
    assert (hole.role, hole.hole, hole.opening) == (
        "component",
        pytest.approx(0.9e-3),
        pytest.approx(0.1e-3, abs=SAGITTA),
    )
    assert (pad.role, pad.shape, pad.hole, pad.opening) == ("component", "rectangle", 0, pytest.approx(0.1e-3))
    assert sorted(pad.size) == pytest.approx([0.9e-3, 1.5e-3])
    assert (fiducial.role, fiducial.opening) == ("fiducial", pytest.approx(0.5e-3, abs=SAGITTA))
    assert fiducial.size == pytest.approx([1e-3, 1e-3], abs=SAGITTA)
    # A rectangle's longer side lies at 30 degrees: its axes are at 30 and 120, and the first axis is within a quarter
    # turn.
    assert (turned.shape, turned.angle, *turned.size) == ("rectangle", *map(pytest.approx, (math.pi / 6, 2e-3, 1e-3)))
    assert board.bounds == pytest.approx(np.array([[0, 0], [20e-3, 10e-3]]), abs=1e-9)
    assert (board.vias, board.fiducials) == ((via,), (fiducial,))
    assert len(board.component_pads) == 3


def test_cuts_the_edges_to_what_can_be_seen(tmp_path: Path) -> None:
    board = read(tmp_path)
    edges = board.edges
    upper = np.flatnonzero((edges.trace >= 0) & (edges.normal[:, 1] > 0.99))
    spans = sorted((*sorted((edges.start[i, 0], edges.end[i, 0])), edges.bare[i]) for i in upper)
    # From the via's circle, round the silk and the opening, to where the slanted trace begins; from each by the
    # clearance of 50 um. Other copper is met a micrometre outside of the edge. Pieces of one line are one trace.
    via = 2e-3 + math.sqrt(0.4**2 - 0.201**2) * 1e-3 + 50e-6
    # The slanted trace's edge is y = x - 7 + 0.2 sqrt(2).
    slant = (12 + 0.201 - 0.2 * math.sqrt(2)) * 1e-3 - 50e-6
    expected = [(via, 5.85e-3, 0), (6.15e-3, 7.95e-3, 0), (8.05e-3, 9.95e-3, 1), (10.05e-3, slant, 0)]
    assert np.array(spans) == pytest.approx(np.array(expected), abs=1e-6)
    assert edges.start[upper, 1] == pytest.approx(5.2e-3)
    assert len(set(edges.trace[upper])) == 1
    assert edges.width[edges.trace >= 0] == pytest.approx(0.4e-3)
    slanted = np.flatnonzero((edges.trace >= 0) & (np.abs(edges.normal[:, 0]) > 0.1))
    assert np.abs(edges.normal[slanted]) == pytest.approx(math.sqrt(0.5))
    assert len(slanted) == 2


def test_takes_the_sides_of_pads_in_the_open(tmp_path: Path) -> None:
    board = read(tmp_path)
    edges = board.edges
    of_pads = np.flatnonzero(edges.pad >= 0)
    counts = Counter(board.pads[i].shape for i in edges.pad[of_pads])
    assert counts == {"rectangle": 8}
    assert edges.bare[of_pads].all()
    for index in of_pads:
        pad = board.pads[edges.pad[index]]
        middle = (edges.start[index] + edges.end[index]) / 2
        assert (middle - pad.centre) @ edges.normal[index] == pytest.approx(edges.width[index] / 2)
        across = min(pad.size, key=lambda size: abs(size - edges.width[index]))
        along = pad.size.sum() - across
        assert edges.width[index] == pytest.approx(across)
        assert edges.length[index] == pytest.approx(along - 2 * 50e-6)


def test_a_side_of_a_pad_ends_where_the_pad_ends(tmp_path: Path) -> None:
    """Three pads side by side overlap: their copper and its upper contour go on beyond the ends of the middle pad."""
    row = "%ADD13R,1.5X0.9*%\nD13*\n" + "".join(at(x, 8, "D03") for x in (4.0, 5.2, 6.4))
    copper, wider = (COPPER + row.replace("1.5X0.9", size) for size in ("1.5X0.9", "1.7X1.1"))
    edges = read(tmp_path, copper=copper, mask=MASK + wider.removeprefix(COPPER)).edges
    upper = np.flatnonzero((edges.pad >= 0) & (edges.normal[:, 1] > 0.99) & (edges.start[:, 1] > 7e-3))
    spans = sorted(sorted((edges.start[i, 0], edges.end[i, 0])) for i in upper)
    expected = [(x - 0.7e-3, x + 0.7e-3) for x in (4e-3, 5.2e-3, 6.4e-3)]
    assert np.array(spans) == pytest.approx(np.array(expected), abs=1e-9)


def test_a_mask_just_as_large_as_its_pad_hides_the_sides(tmp_path: Path) -> None:
    same = MASK.replace("1.7X1.1", "1.5X0.9")
    board = read(tmp_path, mask=same)
    pad = board.pads.index(land_at(board, 5, 2))
    assert not np.any(board.edges.pad == pad)
    assert land_at(board, 5, 2).opening == pytest.approx(0, abs=1e-12)


def test_without_a_mask_everything_is_bare(tmp_path: Path) -> None:
    files = {name: text for name, text in BOARD.items() if name != "mask.gbr"}
    board = read_artwork(written(tmp_path, files), layers=LAYERS)
    assert board.edges.bare.all()
    assert not board.fiducials
    assert all(math.isnan(each.opening) for each in board.pads)


def test_the_file_s_word_counts_more_than_the_look(tmp_path: Path) -> None:
    with_function = COPPER.replace("%ADD14C,1.0*%", "%TA.AperFunction,SMDPad,CuDef*%\n%ADD14C,1.0*%\n%TD*%")
    with_function = with_function.replace(
        "%ADD13R,1.5X0.9*%", "%TA.AperFunction,FiducialPad,Local*%\n%ADD13R,1.5X0.9*%\n%TD*%"
    )
    with_function = with_function.replace("%ADD12C,1.6*%", "%TA.AperFunction,ViaPad*%\n%ADD12C,1.6*%\n%TD*%")
    with_function = with_function.replace("D11*\n", "%TO.N,GND*%\n%TO.P,R7,2*%\nD11*\n").replace(
        "D12*\n", "%TD*%\nD12*\n"
    )
    board = read(tmp_path, copper=with_function)
    roles = {where: land_at(board, *where).role for where in ((2, 8), (5, 2), (17, 2))}
    assert roles == {(2, 8): "component", (5, 2): "fiducial", (17, 2): "via"}
    assert land_at(board, 2, 8).function == "SMDPad"
    assert (land_at(board, 2, 5).net, land_at(board, 2, 5).part, land_at(board, 2, 5).pin) == ("GND", "R7", "2")


def test_areas_that_the_mask_opens_are_pads_and_pours_are_not(tmp_path: Path) -> None:
    square = "G36*\n" + line(12, 1, 13, 1) + at(13, 2, "D01") + at(12, 2, "D01") + at(12, 1, "D01") + "G37*\n"
    pour = "G36*\n" + line(0, 9, 20, 9) + at(20, 10, "D01") + at(0, 10, "D01") + at(0, 9, "D01") + "G37*\n"
    board = read(tmp_path, copper=COPPER + square + pour, mask=MASK + square)
    assert len(board.pads) == 6
    assert land_at(board, 12.5, 1.5).shape == "rectangle"


def test_what_is_cleared_hides_no_edge(tmp_path: Path) -> None:
    """A copper pour with a clearance around a trace: the trace is as visible as without the pour."""
    alone = "%ADD10C,0.4*%\n%ADD11C,1.2*%\nD10*\n" + line(4, 5, 12, 5)
    pour = "G36*\n" + line(0, 0, 20, 0) + at(20, 10, "D01") + at(0, 10, "D01") + at(0, 0, "D01") + "G37*\n"
    cleared = alone.replace("D10*\n", pour + "%LPC*%\nD11*\n" + line(4, 5, 12, 5) + "%LPD*%\nD10*\n")
    buried = alone.replace("D10*\n", pour + "D10*\n")
    first, second, third = (read(tmp_path, copper=each).edges for each in (alone, cleared, buried))
    assert first.length.sum() == pytest.approx(second.length.sum())
    assert len(first.trace) == len(second.trace) > 0
    assert len(third.trace) == 0


def test_inches_are_as_good_as_millimetres(tmp_path: Path) -> None:
    (tmp_path / "inch").mkdir()
    inch = tmp_path / "inch"
    board = read(tmp_path, copper="%ADD10C,0.508*%\nD10*\n" + line(2.54, 5.08, 12.7, 5.08))
    written(inch, BOARD)
    (inch / "copper.gbr").write_text(
        "%FSLAX24Y24*%\n%MOIN*%\n%LPD*%\nG01*\n%ADD10C,0.02*%\nD10*\nX1000Y2000D02*\nX5000Y2000D01*\nM02*\n"
    )
    other = read_artwork(inch, layers=LAYERS)
    assert other.edges.start == pytest.approx(board.edges.start, abs=1e-12)
    assert other.edges.width == pytest.approx(board.edges.width, abs=1e-12)


def test_holes_are_counted_once(tmp_path: Path) -> None:
    files = {**BOARD, "again.drl": PLATED}
    board = read_artwork(written(tmp_path, files), layers={**LAYERS, r"again\.drl": "drill unknown"})
    assert len(board.holes.start) == 3
    assert board.holes.plated.tolist() == [1, 1, 0]
    assert board.holes.diameter == pytest.approx([0.3e-3, 0.9e-3, 3e-3])


@pytest.mark.parametrize("polarity", ["D", "C"])
@pytest.mark.parametrize("ring", ["C,2.0X1.0", "RING"])
def test_hole_of_an_aperture_changes_nothing_below(tmp_path: Path, ring: str, polarity: str) -> None:
    """A ring over copper, and over laminate: inside its hole the copper stays as it was (sections 4.4.6, 4.5.1)."""
    drawn = f"%AMRING*1,1,2.0,0,0*1,0,1.0,0,0*%\n%ADD20R,3X3*%\n%ADD21{ring}*%\n"
    drawn += "D20*\n" + at(5, 5, "D03") + f"%LP{polarity}*%\nD21*\n" + at(5, 5, "D03") + at(15, 5, "D03")
    layer = Layer(read(tmp_path, copper=drawn).copper)
    places = np.array([5.0, 5.75, 6.25, 15.0, 15.75, 16.25]) * 1e-3
    found = is_covered(layer.crossings(np.array([0.0, 5e-3]), np.array([20e-3, 5e-3])), places / 20e-3)
    on_copper = [True, polarity == "D", True]
    on_laminate = [False, polarity == "D", False]
    assert found.tolist() == on_copper + on_laminate


def test_a_moire_is_refused(tmp_path: Path) -> None:
    moire = "%AMMARK*6,0,0,5,0.5,0.5,2,0.1,6,0*%\n%ADD20MARK*%\nD20*\n" + at(10, 8, "D03")
    with pytest.raises(ValueError, match="moiré is not supported"):
        read(tmp_path, copper=COPPER + moire)


def test_a_block_aperture_is_refused(tmp_path: Path) -> None:
    block = "%ABD20*%\nD10*\n" + at(0, 0, "D03") + "%AB*%\nD20*\n" + at(10, 8, "D03")
    with pytest.raises(ValueError, match=r"block aperture \(AB\) is not supported"):
        read(tmp_path, copper=COPPER + block)


@pytest.mark.parametrize("scale", ["0", "-1"])
def test_a_scale_of_an_aperture_must_be_positive(tmp_path: Path, scale: str) -> None:
    with pytest.raises(ValueError, match=f"a scale of {scale}, expected above 0"):
        read(tmp_path, copper=COPPER + f"%LS{scale}*%\n" + at(10, 8, "D03"))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"side": "left"}, "side must be"),
        ({"side": "bottom"}, "no copper on the bottom side"),
        ({"clearance": 0.0}, "clearance must be positive"),
        ({"clearance": math.nan}, "clearance must be positive"),
        ({"via_drill": -1.0}, "via_drill not negative"),
        ({"layers": None}, "not a readable board"),
    ],
)
def test_refuses_what_it_cannot_use(tmp_path: Path, arguments: dict[str, object], message: str) -> None:
    written(tmp_path, BOARD)
    for name in ("mask.gbr", "silk.gbr", "paste.gbr", "bare.drl"):
        (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=message):
        read_artwork(tmp_path, **{"layers": LAYERS, **arguments})


def test_says_that_a_folder_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such folder"):
        read_artwork(tmp_path / "nothing")


@pytest.mark.parametrize("radius", [20e-6, 0.3e-3, 0.5e-3, 5e-3])
def test_disks_have_the_circle_s_area(radius: float) -> None:
    corners = disk(np.array([0.1, -0.2]), radius)
    assert area(corners) == pytest.approx(math.pi * radius**2, rel=1e-9)
    distance = np.hypot(*(corners - (0.1, -0.2)).T)
    assert distance.max() - radius < 0.68 * SAGITTA
    middles = np.hypot(*((corners + np.roll(corners, 1, axis=0)) / 2 - (0.1, -0.2)).T)
    assert radius - middles.min() < 0.34 * SAGITTA


def test_capsules_have_straight_sides() -> None:
    corners = capsule(np.array([1e-3, 2e-3]), np.array([4e-3, 6e-3]), 0.25e-3)
    normal = np.array([-0.8, 0.6])
    across = (corners - (1e-3, 2e-3)) @ normal
    assert np.sort(across)[[0, 1, -2, -1]] == pytest.approx([-0.25e-3, -0.25e-3, 0.25e-3, 0.25e-3], rel=1e-9)
    assert area(corners) == pytest.approx(5e-3 * 0.5e-3 + math.pi * 0.25e-3**2, rel=1e-3)
    # As few corners as keep the sagitta of the chords.
    chords = math.ceil(math.pi / (2.0 * math.acos(1.0 - SAGITTA / 0.25e-3)))
    assert len(corners) == 2 * (chords + 1)


def test_what_lies_along_a_line_is_what_lies_at_its_points(rng: np.random.Generator) -> None:
    """Random polygons with holes, dark and clear over each other, against an independent point-in-polygon test."""
    for _ in range(40):
        shapes = tuple(
            Shape(star(rng), bool(rng.random() < 0.7), tuple(star(rng) for _ in range(rng.integers(0, 3))))
            for _ in range(6)
        )
        start, end = rng.uniform(-2, 2, (2, 2))
        places = rng.uniform(0, 1, 200)
        points = start + places[:, None] * (end - start)
        covered = np.zeros(len(points), dtype=bool)
        for each in shapes:
            in_holes = [Outline(hole).contains_points(points) for hole in each.holes]
            inside = Outline(each.outline).contains_points(points) & ~np.any(
                [np.zeros_like(covered), *in_holes], axis=0
            )
            covered[inside] = each.dark
        np.testing.assert_array_equal(is_covered(Layer(shapes).crossings(start, end), places), covered)


def test_boxes_are_found_where_they_overlap(rng: np.random.Generator) -> None:
    """Small boxes, narrow ones and one across all, against a comparison of all pairs; few others are found."""
    low = rng.uniform((-3e-3, 20e-3), (50e-3, 40e-3), (900, 2))
    high = low + rng.uniform(0.0, 1.0, (900, 2)) * rng.choice([0.2e-3, 4e-3], (900, 2))
    low[5], high[5] = (-3e-3, 20e-3), (54e-3, 44e-3)
    index = _BoxIndex(low, high)
    found = 0
    for start in rng.uniform((-5e-3, 18e-3), (52e-3, 42e-3), (60, 2)):
        end = start + rng.uniform(0.0, 3e-3, 2)
        near = index.near(start, end)
        overlaps = np.flatnonzero(np.all((low <= end) & (high >= start), axis=1))
        assert set(overlaps) <= set(near)
        np.testing.assert_array_equal(near, np.unique(near))
        found += len(near)
    assert found < 0.2 * 60 * 900


@pytest.mark.parametrize("angle", [0.0, 90.0, 30.0, -60.0, 180.0])
def test_strokes_of_one_line_are_one_trace_in_either_direction(angle: float) -> None:
    """Pieces from 0 to 2, 3 to 2 and 3 to 4 mm join; a gap, another width and another line do not."""
    c, s = math.cos(math.radians(angle)), math.sin(math.radians(angle))

    def stroke(start: float, end: float, width: float = 0.2, beside: float = 0.0) -> DrawnObject:
        ends = 1e-3 * np.array([[start, beside], [end, beside]]) @ np.array([[c, s], [-s, c]]) + 7e-3
        return DrawnObject("line", (Shape(capsule(*ends, 5e-4 * width)),), ends, 1e-3 * width)

    strokes = [
        stroke(3, 2),
        stroke(0, 2),
        stroke(3, 4),
        stroke(5, 6),
        stroke(8, 5.5),
        stroke(1, 2, 0.3),
        stroke(1, 2, beside=1),
    ]
    back = np.array([[c, -s], [s, c]])
    found = []
    for start, end, width in _joined(strokes):
        ends = 1e3 * (np.stack([start, end]) - 7e-3) @ back
        found.append((*np.sort(ends[:, 0]), ends[0, 1], ends[1, 1], 1e3 * width))
    expected = [(0, 4, 0, 0, 0.2), (5, 8, 0, 0, 0.2), (1, 2, 0, 0, 0.3), (1, 2, 1, 1, 0.2)]
    np.testing.assert_allclose(sorted(np.round(found, 6).tolist()), sorted(expected), atol=1e-6)


def star(rng: np.random.Generator) -> np.ndarray:
    """Corners in the order of their angles: the sides do not cross, so that all fill rules agree."""
    count = rng.integers(3, 9)
    angle = np.sort(rng.uniform(0, 2 * math.pi, count))
    return rng.uniform(-1, 1, 2) + rng.uniform(0.1, 1, (count, 1)) * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.realdata
@pytest.mark.parametrize("name", ONE_BOARD_FAST)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::SyntaxWarning", "ignore::UserWarning")
def test_layers_are_where_gerbonara_says(data: Path, name: str) -> None:
    board = real_board(data / "gerber" / name)
    stack = LayerStack.open(data / "gerber" / name)
    for use, shapes in (("copper", board.copper), ("mask", board.mask)):
        points = np.concatenate([each.outline for each in shapes])
        bounds = np.array(stack.graphic_layers["top", use].bounding_box(MM)) * 1e-3
        assert np.stack([points.min(axis=0), points.max(axis=0)]) == pytest.approx(bounds, abs=2 * SAGITTA)


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "pads", "holes", "bounds"),
    [
        pytest.param("fritzing", 364, 482, (96.96, 97.94), marks=pytest.mark.slow),
        ("upverter", 63, 63, (39.5, 60.025)),  # its holes are in two files
        pytest.param("kicad-x2-tests/x2ap", 236, 80, (80, 50), marks=pytest.mark.slow),
    ],
)
def test_reads_the_boards_of_three_tools(
    data: Path, name: str, pads: int, holes: int, bounds: tuple[float, float]
) -> None:
    board = real_board(data / "gerber" / name)
    assert len(board.pads) == pads
    assert len(board.holes.start) == holes
    assert np.ptp(board.bounds, axis=0) * 1e3 == pytest.approx(bounds, abs=0.01)
    assert np.sum(board.edges.trace >= 0) > 100


@pytest.mark.realdata
@pytest.mark.parametrize("name", ["upverter", pytest.param("kicad-x2-tests/x2ap", marks=pytest.mark.slow)])
def test_edges_lie_between_copper_and_laminate_in_a_picture(data: Path, name: str) -> None:
    board = real_board(data / "gerber" / name)
    pixel, low = 10e-6, board.bounds[0] - 1e-3
    columns, rows = np.ceil((np.ptp(board.bounds, axis=0) + 2e-3) / pixel).astype(int)
    copper, silk = np.zeros((rows, columns), np.uint8), np.zeros((rows, columns), np.uint8)
    for picture, shapes in ((copper, board.copper), (silk, board.silk)):
        for each in shapes:
            corners = [
                np.round((contour - low) / pixel * 16).astype(np.int32) for contour in (each.outline, *each.holes)
            ]
            cv2.fillPoly(picture, corners, int(each.dark), shift=4)
    edges = board.edges
    share = np.linspace(0, 1, 20)[:, None, None]
    along = edges.start + share * (edges.end - edges.start)

    def at_side(picture: np.ndarray, offset: float) -> np.ndarray:
        places = np.round((along + offset * edges.normal - low) / pixel).astype(int)
        return picture[places[..., 1], places[..., 0]]

    assert at_side(copper, -30e-6).all()
    assert not at_side(copper, 30e-6).any()
    assert not at_side(silk, 0.0).any()


@pytest.mark.slow
@pytest.mark.realdata
def test_one_board_written_four_ways_is_one_board(data: Path) -> None:
    """KiCad files with and without X2 attributes, with and without aperture macros."""
    first, *others = (real_board(data / "gerber" / name) for name in BOARDS[2:])
    order = np.lexsort(np.round(np.array([each.centre for each in first.pads]).T, 5))
    for other in others:
        also = np.lexsort(np.round(np.array([each.centre for each in other.pads]).T, 5))
        pairs = [(first.pads[i], other.pads[j]) for i, j in zip(order, also, strict=True)]
        for one, two in pairs:
            assert (one.role, one.shape) == (two.role, two.shape)
            assert one.centre == pytest.approx(two.centre, abs=1e-6)
            assert np.sort(one.size) == pytest.approx(np.sort(two.size), abs=2e-6)
        assert other.edges.start == pytest.approx(first.edges.start, abs=2e-6)
        assert other.edges.end == pytest.approx(first.edges.end, abs=2e-6)
