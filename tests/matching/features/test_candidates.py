"""Candidates of rulers on a board of given edges: places, lengths, sigmas and ambiguities by loops."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bare_boards import board_of
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.edges import BoardEdges
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.features import candidates
from gpuvision.matching.features.candidates import find_ruler_candidates, lever_arm, pixel_hint
from gpuvision.matching.features.imaging import Imaging

IMAGING = Imaging(
    pixel=10e-6,
    blur_px=1.2,
    width_px=4,
    motion_px=(1.5, 0.0),
    contrast_bare=50.0,
    contrast_masked=20.0,
    registration=20e-6,
    shift=50e-6,
    angle=2e-3,
)
EVERYWHERE = ((-1.0, -1.0), (1.0, 1.0))
MIDDLE = np.array([1e-3, 0.5e-3])


def bar(x: float, y: float, length: float, width: float, angle: float) -> np.ndarray:
    """Return the corners of a bar whose middle line begins at (x, y) [mm]."""
    c, s = math.cos(angle), math.sin(angle)
    corners = np.array([[0.0, -width / 2], [length, -width / 2], [length, width / 2], [0.0, width / 2]])
    return 1e-3 * (corners @ np.array([[c, s], [-s, c]]) + [x, y])


def board(*bars: tuple[float, float, float, float, float], is_bare: bool = True, **layers: Any) -> Artwork:
    """Return a board of traces: their two long sides are edges, cut by 0.05 mm at their ends."""
    rows: list[Any] = []
    for number, each in enumerate(bars):
        corners = bar(*each)
        along = (corners[1] - corners[0]) / np.linalg.norm(corners[1] - corners[0])
        out = np.array([along[1], -along[0]])
        for start, end, normal in ((corners[0], corners[1], out), (corners[3], corners[2], -out)):
            rows.append((start + 5e-5 * along, end - 5e-5 * along, normal, 1e-3 * each[3], is_bare, number, -1))
    columns = [np.array(each) for each in zip(*rows, strict=True)]
    return replace(board_of(*(bar(*each) for each in bars), **layers), edges=BoardEdges(*columns))


@pytest.mark.parametrize("is_bare", [True, False])
@pytest.mark.parametrize("angle", [0.0, 0.5, math.pi / 2, 2.5])
def test_rulers_lie_side_by_side_on_edges_and_on_traces(angle: float, is_bare: bool) -> None:
    """A trace 1.21 mm long and 0.3 mm wide: of the 1.11 mm of an edge 0.97 mm are free of a width and two shifts."""
    artwork = board((0.3, -0.2, 1.21, 0.3, angle), is_bare=is_bare)
    found = find_ruler_candidates(artwork, EVERYWHERE, MIDDLE, IMAGING)
    count = math.floor(0.97 / 0.04) + 1
    axis = np.array([math.cos(angle), math.sin(angle)])
    across = np.array([-axis[1], axis[0]])
    offsets = 0.605 + 0.04 * (np.arange(count) - 0.5 * (count - 1))
    line = np.array([0.3e-3, -0.2e-3]) + 1e-3 * offsets[:, None] * axis
    for which, shift, spacing in ((found.spacing == 0.0, 0.15e-3, 0.0), (found.spacing > 0.0, 0.0, 0.3e-3)):
        normals, points = found.normal[which], found.point[which]
        for sign in (1.0, -1.0):
            some = normals @ across * sign > 0.0
            if spacing and not some.any():
                continue  # a pair is a candidate with one of the two normals
            np.testing.assert_allclose(np.sort(points[some] @ axis), np.sort((line + sign * shift * across) @ axis))
            np.testing.assert_allclose(points[some] @ across, line[0] @ across + sign * shift, atol=1e-12)
            np.testing.assert_allclose(normals[some], np.tile(sign * across, (count, 1)), atol=1e-12)
        assert len(points) == (1 if spacing else 2) * count
        np.testing.assert_array_equal(found.spacing[which] > 0.0, found.pair[which])
    pairs = found.normal[found.pair]
    assert ((pairs[:, 0] > 0.0) | ((np.abs(pairs[:, 0]) < 1e-12) & (pairs[:, 1] > 0.0))).all()
    # Rulers of one trace have the same source.
    assert set(found.source.tolist()) == {0}
    # Motion blurs edges across it; a pair is the mean of two edges.
    for normal, pair, sigma in zip(found.normal, found.pair, found.sigma, strict=True):
        blur = math.hypot(1.2, 1.5 * normal[0] / math.sqrt(12.0))
        smoothing, contrast = 1.2 * math.sqrt(5.0), 50.0 if is_bare else 20.0
        bound = math.sqrt(2.0 * math.sqrt(math.pi) * blur / 4) / contrast
        worse = math.sqrt(3.0 / 8.0 * (smoothing**2 + blur**2) ** 3 / (smoothing**5 * blur))
        assert sigma == pytest.approx(10e-6 * bound * worse / (math.sqrt(2.0) if pair else 1.0), rel=1e-9)


def test_lengths_cover_the_motion_of_an_edge_and_its_blur() -> None:
    """Shift along both axes, turn about the placement point, and four sigmas of blur and smoothing on both sides."""
    found = find_ruler_candidates(board((0.3, -0.2, 1.2, 0.3, 0.5)), EVERYWHERE, MIDDLE, IMAGING)
    most = math.hypot(1.2, 1.5 / math.sqrt(12.0))
    tails = 4.0 * math.hypot(most, 1.2 * math.sqrt(5.0)) * 10e-6
    for point, normal, length, spacing in zip(found.point, found.normal, found.length, found.spacing, strict=True):
        x, y = point - MIDDLE
        reach = 50e-6 * (abs(normal[0]) + abs(normal[1])) + 2e-3 * abs(x * normal[1] - y * normal[0])
        assert length == pytest.approx(2.0 * (reach + tails) + spacing, rel=1e-9)
    np.testing.assert_allclose(
        lever_arm(np.array([[2.0, 3.0]]), np.array([[0.6, 0.8]])), [2.0 * 0.8 - 3.0 * 0.6], rtol=1e-12
    )
    pixels = np.ceil(found.length / 10e-6) * 4
    np.testing.assert_array_equal(found.pixels(IMAGING), pixels)
    marks = found._replace(radius=np.full(len(pixels), 1e-4))
    np.testing.assert_array_equal(marks.pixels(IMAGING), (pixels / 4) ** 2)


def test_centres_of_rulers_lie_in_the_region() -> None:
    artwork = board((0.3, -0.2, 1.2, 0.3, 0.0))
    every = find_ruler_candidates(artwork, EVERYWHERE, MIDDLE, IMAGING)
    for region in (((0.5e-3, -1.0), (0.9e-3, 1.0)), ((-1.0, -0.2e-3), (1.0, 1.0)), ((-1.0, -0.34e-3), (1.0, -0.21e-3))):
        low, high = np.array(region)
        inside = np.all((every.point >= low) & (every.point <= high), axis=1)
        found = find_ruler_candidates(artwork, region, MIDDLE, IMAGING)
        assert len(found.point) == inside.sum()
        for row in found.point:
            assert np.abs(every.point[inside] - row).sum(axis=1).min() < 1e-15


@pytest.mark.parametrize("gap", [0.0, 0.011])
def test_edges_need_room_on_both_sides(gap: float) -> None:
    """Room for the filter: 3 sqrt(5 / 6) sqrt(6) blurs, 80.5 um; 60 um of it are the clearance of the two traces."""
    room = 3.0 * math.sqrt(5.0) * 1.2 * 10e-3  # [mm]
    away = room + (-0.001 if gap == 0.0 else 0.001)
    artwork = board((0.0, 0.0, 1.2, 0.3, 0.0), (0.0, 0.3 + away, 1.2, 0.3, 0.0))
    found = find_ruler_candidates(artwork, EVERYWHERE, MIDDLE, IMAGING)
    single = found.point[~found.pair]
    inner = (single[:, 1] > 0.0) & (single[:, 1] < (0.3 + away) * 1e-3)
    assert inner.any() == (gap > 0.0)
    assert (~inner).any()
    # A trace is not measured as a pair, nor its edges, if it is narrower than the room.
    for width, has_any in ((room - 0.001, False), (room + 0.001, True)):
        narrow = find_ruler_candidates(board((0.0, 0.0, 1.2, width, 0.0)), EVERYWHERE, MIDDLE, IMAGING)
        assert (len(narrow.point) > 0) == has_any


@pytest.mark.parametrize("layer", ["mask", "silk", "holes"])
def test_other_layers_may_lie_off_by_the_registration(layer: str) -> None:
    """An ink, an opening or a hole whose border is as far as the room and 20 um along the normal."""
    room = 3.0 * math.sqrt(5.0) * 1.2 * 10e-3 + 0.02
    for more, has_room in ((-0.001, False), (0.002, True)):
        low = 1e-3 * (0.15 + room + more)
        square = Shape(np.array([[-1e-3, low], [3e-3, low], [3e-3, low + 2e-3], [-1e-3, low + 2e-3]]))
        given: dict[str, Any] = {layer: (square,)}
        if layer == "holes":
            # A large hole: its border is within 1 um of a line over the trace.
            given = {"holes": [(0.6e-3, low + 0.2, 0.4)]}
        artwork = board((0.0, 0.0, 1.2, 0.3, 0.0), **given)
        found = find_ruler_candidates(artwork, EVERYWHERE, MIDDLE, IMAGING)
        upper = ~found.pair & (found.normal[:, 1] > 0.0)
        assert upper.any() == has_room
        assert (~found.pair & (found.normal[:, 1] < 0.0)).any()


def test_ambiguity_is_the_share_of_shifts_that_show_another_edge() -> None:
    """Copper that ends 0.35 mm farther is taken for the edge where the shift brings it onto the ruler."""
    artwork = board((0.0, 0.0, 1.2, 0.3, 0.0), (0.0, 0.4, 1.2, 0.3, 0.0), (0.0, 1.5, 1.2, 0.3, 0.0))
    imaging = replace(IMAGING, shift=200e-6, angle=0.0)
    found = find_ruler_candidates(artwork, EVERYWHERE, MIDDLE, imaging)
    most = math.hypot(1.2, 1.5 / math.sqrt(12.0))
    tails = 4.0 * math.hypot(most, 1.2 * math.sqrt(5.0)) * 10e-6
    seen = 200e-6 + tails - 3.0 * math.sqrt(5.0) * 1.2 * 10e-6  # where the whole filter lies on a ruler
    shifts = np.linspace(-200e-6, 200e-6, 40001)
    upper = ~found.pair & (found.normal[:, 1] > 0.0)
    for y, others in ((0.15e-3, (0.4e-3,)), (0.55e-3, (-0.4e-3,)), (1.65e-3, ())):
        here = upper & np.isclose(found.point[:, 1], y)
        assert here.any()
        expected = sum(np.mean(np.abs(shifts + other) < seen) for other in others)
        np.testing.assert_allclose(found.ambiguity[here], expected, atol=1e-3)
    assert (found.ambiguity > 0.0).any()


def test_a_hint_names_the_room_and_a_pixel_with_room(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = {0.8: 0, 0.65: 2, 0.5: 3, 0.35: 9}
    asked: list[float] = []

    class Found:
        def __init__(self, imaging: Imaging) -> None:
            asked.append(round(imaging.pixel / 10e-6, 3))
            self.sigma = np.zeros(counts.get(asked[-1], 0))

    monkeypatch.setattr(candidates, "find_ruler_candidates", lambda a, b, c, imaging: Found(imaging))
    artwork = board((0.0, 0.0, 1.2, 0.3, 0.0))
    room = 1e6 * (3.0 * math.sqrt(5.0) * 1.2 * 10e-6 + 20e-6)
    text = f"an edge needs {room:.0f} um without another edge on both sides at 10 um per pixel"
    assert pixel_hint(artwork, EVERYWHERE, MIDDLE, IMAGING) == f"{text}; at 5 um, 3 rulers have room"
    assert asked == [0.8, 0.65, 0.5]
    counts.clear()
    asked.clear()
    assert pixel_hint(artwork, EVERYWHERE, MIDDLE, IMAGING) == text
    assert asked == [0.8, 0.65, 0.5, 0.35, 0.25]


@pytest.mark.parametrize(
    ("region", "placement", "message"),
    [
        (((0.0, 0.0), (1.0, 0.0)), (0.0, 0.0), "region must be finite"),
        (((1.0, 0.0), (0.0, 1.0)), (0.0, 0.0), "region must be finite"),
        (((0.0, 0.0), (1.0, math.inf)), (0.0, 0.0), "region must be finite"),
        ((0.0, 0.0, 1.0, 1.0), (0.0, 0.0), "region must be finite"),
        (EVERYWHERE, (0.0, math.inf), "placement must be a finite x, y"),
        (EVERYWHERE, (0.0, 0.0, 0.0), "placement must be a finite x, y"),
    ],
)
def test_wrong_regions_are_refused(region: Any, placement: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_ruler_candidates(board((0.0, 0.0, 1.2, 0.3, 0.0)), region, placement, IMAGING)
