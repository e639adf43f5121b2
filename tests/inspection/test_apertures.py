"""Apertures of a paste layer: areas and centroids against closed forms, names, and what touches."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.host import GpuVisionError
from gpuvision.inspection.apertures import BoardPlacement, read_apertures
from gpuvision.inspection.coverage import area_and_centroid, covered
from gpuvision.matching.artwork.board_artwork import Pad
from gpuvision.matching.artwork.shapes import Shape, disk

HEAD = "%FSLAX46Y46*%\n%MOMM*%\n%LPD*%\nG01*\n"
LAYERS = {"paste.gbr": "top paste", "copper.gbr": "top copper"}
SQUARE = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]])


def flash(x, y):
    return f"X{round(x * 1e6)}Y{round(y * 1e6)}D03*\n"


@pytest.fixture
def board(tmp_path):
    """Paste: a square with a circle that touches it, a separate rectangle, a square of four strokes."""
    paste = "%ADD10R,1X1*%\n%ADD11C,0.8*%\n%ADD12R,0.5X0.3*%\n%ADD13C,0.2*%\n"
    paste += "D10*\n" + flash(2, 2) + "D12*\n" + flash(5, 2) + "D11*\n" + flash(2.6, 2)
    paste += "D13*\nX8000000Y2000000D02*\nX9000000Y2000000D01*\nX9000000Y2100000D01*\n"
    copper = "%ADD10R,1.2X1.2*%\nD10*\n" + flash(2, 2) + flash(5, 2)
    for name, text in (("paste.gbr", paste), ("copper.gbr", copper)):
        (tmp_path / name).write_text(HEAD + text + "M02*\n")
    return tmp_path


def test_objects_that_touch_are_one_aperture(board):
    apertures = read_apertures(board, layers=LAYERS)
    assert [each.name for each in apertures] == ["1", "2", "3"]
    first, second, third = apertures
    # Square of 1 mm, and circle of 0.8 mm whose centre lies 0.1 mm outside its right side.
    inside = math.acos(0.1 / 0.4)
    segment = 0.4**2 * (inside - math.sin(inside) * math.cos(inside))  # left of the chord at 0.1 mm
    np.testing.assert_allclose(first.area, 1e-6 * (1.0 + math.pi * 0.4**2 - segment), rtol=3e-3)
    np.testing.assert_allclose(second.area, 0.15e-6, rtol=1e-9)
    np.testing.assert_allclose(second.centroid, [5e-3, 2e-3], rtol=1e-9)
    # Two strokes 0.2 mm wide: the second, 0.1 mm long, adds a half disk above the end of the first, and the corner
    # between this and the first one's round end.
    np.testing.assert_allclose(third.area, 1e-6 * (0.2 + 0.01 * math.pi * 1.25 + 0.01), rtol=3e-3)


def test_apertures_over_the_pads_of_a_part_have_its_name(board):
    pads = [
        Pad(
            role="component",
            shape="rectangle",
            centre=np.array([x, 2e-3]),
            size=np.array([1.2e-3, 1.2e-3]),
            angle=0.0,
            outline=np.array([x, 2e-3]) + 1.2e-3 * (SQUARE / 2 - 0.5),
            part="U3",
            pin=pin,
        )
        for x, pin in ((2e-3, "1"), (5e-3, "2"))
    ]
    assert [each.name for each in read_apertures(board, layers=LAYERS, pads=pads)] == ["U3.1", "U3.2", "3"]
    wide = [pads[0].__class__(**{**pads[0].__dict__, "outline": 1e-2 * SQUARE - 5e-3, "size": np.array([2e-2, 2e-2])})]
    assert [each.name for each in read_apertures(board, layers=LAYERS, pads=wide)] == ["U3.1/1", "U3.1/2", "U3.1/3"]


def test_a_board_without_paste_is_refused(board):
    with pytest.raises(
        GpuVisionError, match="no paste layer on the bottom side; name its file with layers 'FILE=bottom"
    ):
        read_apertures(board, side="bottom", layers=LAYERS)
    (board / "paste.gbr").write_text(HEAD + "M02*\n")
    with pytest.raises(GpuVisionError, match=r"the paste layer paste\.gbr has no aperture"):
        read_apertures(board, layers=LAYERS)


def test_cleared_shapes_and_holes_are_not_covered():
    shapes = [
        Shape(SQUARE),
        Shape(SQUARE / 2, dark=False),
        Shape(SQUARE / 4),
        Shape(SQUARE + 3, holes=(SQUARE / 2 + 3,)),
    ]
    x = y = np.array([0.25, 0.75, 1.5, 3.5, 4.5])
    expected = np.zeros((5, 5), bool)
    expected[0, 0] = expected[2, :3] = expected[:3, 2] = expected[4, 3:] = expected[3, 4] = True
    np.testing.assert_array_equal(covered(shapes, x, y), expected)
    area, centroid = area_and_centroid(shapes[:2])
    np.testing.assert_allclose(area, 3.0, rtol=5e-3)
    np.testing.assert_allclose(centroid, [3.5 / 3, 3.5 / 3], rtol=5e-3)


def test_area_and_centroid_of_a_polygon():
    triangle = np.array([[1.0, 1.0], [4.0, 1.0], [1.0, 3.0]])
    for outline in (triangle, triangle[::-1]):
        area, centroid = area_and_centroid([Shape(outline)])
        np.testing.assert_allclose([area, *centroid], [3.0, 2.0, 5 / 3])
    area, centroid = area_and_centroid([Shape(disk(np.array([1.0, 2.0]), 0.5))])
    np.testing.assert_allclose([area, *centroid], [math.pi / 4, 1.0, 2.0], rtol=1e-9)


def test_the_bottom_of_a_board_is_mirrored():
    place = BoardPlacement(x=1.0, y=2.0, theta=math.pi / 2, side="bottom")
    np.testing.assert_allclose(place.to_map(np.array([[1.0, 0.0], [0.0, 1.0]])), [[1.0, 1.0], [0.0, 2.0]], atol=1e-12)
