"""Pictures of boards and of delays: outlines, rulers, fiducials and curves, with their units and colours."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from matplotlib.collections import LineCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.plots.board import draw_artwork, draw_features, draw_located_board
from gpuvision.plots.figure import new_figure
from gpuvision.plots.placement import draw_placements
from gpuvision.plots.servoing import DelayPicture, draw_delay, draw_measured_delay
from gpuvision.servoing.delay_measurement import MeasuredDelay
from gpuvision.servoing.delay_response import FrameTimeCurve

SQUARE = np.array([[0.0, 0.0], [1e-3, 0.0], [1e-3, 1e-3], [0.0, 1e-3]])


def data(line: Any) -> np.ndarray:
    """Return the points of a drawn line (n, 2)."""
    return np.stack([np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)], axis=-1)


def texts(legend: Any) -> list[str]:
    return [each.get_text() for each in legend.get_texts()]


def segments(collection: Any) -> np.ndarray:
    return np.array(collection.get_segments())


def some_artwork(**changes: Any) -> Any:
    """Return a pad with a hole and a clear shape, far and near silk, and a drilled hole."""
    inner = 0.25 * SQUARE + 3e-4
    holes = {"start": np.array([[2e-3, 2e-3]]), "end": np.array([[2e-3, 3e-3]]), "diameter": np.array([4e-4])}
    edges = SimpleNamespace(start=np.array([[0.0, 0.0], [9.0, 9.0]]), end=np.array([[1e-3, 0.0], [9.0, 9.1]]))
    parts = {
        "copper": (Shape(SQUARE[::-1], holes=(inner,)), Shape(SQUARE, dark=False)),
        "mask": (),
        "silk": (Shape(SQUARE + 9.0), Shape(SQUARE + 4e-3)),
        "holes": SimpleNamespace(**holes),
        "edges": edges,
        "side": "top",
    }
    return SimpleNamespace(**{**parts, **changes})


def test_layers_of_the_artwork() -> None:
    axes = new_figure(4.0, 4.0).add_subplot()
    draw_artwork(axes, some_artwork(), np.array([[0.0, 0.0], [4e-3, 4e-3]]))
    assert to_hex(axes.get_facecolor()) == "#1f3d2b"
    copper, mask, silk, holes = (cast("Any", each) for each in axes.collections)
    assert [to_hex(each) for each in copper.get_facecolor()] == ["#4f8a5b", "#1f3d2b"]
    pad = copper.get_paths()[0]
    # The outline runs counter-clockwise, the hole clockwise: the hole is free.
    outline, hole = pad.vertices[:4], pad.vertices[4:8]
    np.testing.assert_allclose(outline[::-1], 1e3 * SQUARE[::-1])
    np.testing.assert_allclose(hole[::-1], 1e3 * (0.25 * SQUARE + 3e-4))
    assert mask.get_alpha() == 0.55
    assert len(silk.get_paths()) == 1
    drill = holes.get_paths()[0].vertices
    np.testing.assert_allclose([drill.min(axis=0), drill.max(axis=0)], [[1.8, 1.8], [2.2, 3.2]], atol=0.01)


@pytest.mark.parametrize(
    ("shift", "is_shown"),
    [
        ((0.0, 0.0), True),
        ((4e-3, 0.0), True),  # it touches the window of 4 mm
        ((0.0, 4e-3), True),
        ((-1e-3, 0.0), True),
        ((0.0, -1e-3), True),
        ((4.1e-3, 0.0), False),
        ((0.0, 4.1e-3), False),
        ((-1.1e-3, 0.0), False),
        ((0.0, -1.1e-3), False),
    ],
)
def test_only_shapes_in_the_window_are_drawn(shift: tuple[float, float], is_shown: bool) -> None:
    axes = new_figure(4.0, 4.0).add_subplot()
    artwork = some_artwork(silk=(Shape(SQUARE + shift),))
    draw_artwork(axes, artwork, np.array([[0.0, 0.0], [4e-3, 4e-3]]))
    silk: Any = axes.collections[2]
    assert len(silk.get_paths()) == is_shown


@pytest.mark.parametrize(("height", "inches"), [(0.3e-3, 3.0), (2e-3, 4.5), (9e-3, 12.0)])
def test_size_of_the_page_of_features(height: float, inches: float, drawn: list[Figure], tmp_path: Path) -> None:
    """9 in wide, 3 to 12 in high, and a line of text; a border of 4 % of the longer side around 4 mm."""
    region = np.array([[0.0, 0.0], [4e-3, height]])
    draw_features(tmp_path / "features.png", some_artwork(), features(region=region), region)
    border = 0.04 * max(4e-3, height)
    high = 9.0 * (height + 2 * border) / (4e-3 + 2 * border)
    expected = high if inches == 4.5 else inches
    assert tuple(drawn[0].get_size_inches()) == pytest.approx((9.0, expected + 0.9))


@pytest.mark.parametrize(("rows", "inches"), [(10, 3.0), (90, 14.0)])
def test_size_of_the_page_of_a_located_board(rows: int, inches: float, drawn: list[Figure], tmp_path: Path) -> None:
    view = BoardView(scale=1e-4, shape=(rows, 61), pose=(0.0, 0.0, 0.0))
    draw_located_board(tmp_path / "a.png", np.zeros((rows, 61)), some_artwork(), located_board(view))
    assert tuple(drawn[0].get_size_inches()) == pytest.approx((10.0, inches + 0.8))
    # A flat image has a grey scale, too.
    low, high = drawn[0].axes[0].images[0].get_clim()
    assert low == 0.0 < high < 1e-6


def features(**changes: Any) -> Any:
    values = {
        "region": np.array([[0.0, 0.0], [4e-3, 3e-3]]),
        "normal": np.array([[1.0, 0.0], [0.0, 1.0]]),
        "length": np.array([2e-4, 4e-4]),
        "point": np.array([[1e-3, 2e-3], [2e-3, 1e-3]]),
        "spacing": np.array([0.0, 1e-4]),
        "fiducials": SimpleNamespace(point=np.array([[3e-3, 1e-3]]), radius=np.array([5e-4])),
        "placement": np.array([2e-3, 1.5e-3]),
        "summary": lambda: "features",
    }
    return SimpleNamespace(**{**values, **changes})


@pytest.mark.parametrize("side", ["top", "bottom"])
def test_selected_features(side: str, drawn: list[Figure], tmp_path: Path) -> None:
    chosen = features()
    region = [[0.0, 0.0], [4e-3, 3e-3]]
    draw_features(tmp_path / "features.png", some_artwork(side=side), chosen, region)
    # As wide as high as the window of 4.32 x 3.32 mm.
    assert [*drawn[0].get_size_inches(), drawn[0].dpi] == pytest.approx([9.0, 9.0 * 3.32 / 4.32 + 0.9, 150])
    (axes,) = drawn[0].axes
    rulers = [each for each in axes.collections if isinstance(each, LineCollection)]
    np.testing.assert_allclose(segments(rulers[0]), [[[0.9, 2.0], [1.1, 2.0]]])
    np.testing.assert_allclose(segments(rulers[1]), [[[2.0, 0.8], [2.0, 1.2]]])
    assert [to_hex(each.get_colors()[0]) for each in map(cast, ["Any"] * 2, rulers)] == ["#00e5ff", "#ff66ff"]
    (circle,) = (each for each in axes.patches if isinstance(each, Circle))
    assert (circle.center, circle.radius) == (pytest.approx((3.0, 1.0)), pytest.approx(0.5))
    (cross,) = axes.lines
    np.testing.assert_allclose(data(cross), [[2.0, 1.5]])
    border = next(each for each in axes.patches if each is not circle)
    np.testing.assert_allclose(cast("Any", border).get_xy()[:4], [[0, 0], [4, 0], [4, 3], [0, 3]], atol=1e-12)
    # A twenty-fifth of the longer side around the region.
    x = [-0.16, 4.16]
    assert axes.get_xlim() == pytest.approx(x if side == "top" else x[::-1])
    assert axes.get_ylim() == pytest.approx((-0.16, 3.16))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("x [mm]", "y [mm]")
    assert texts(drawn[0].legends[0]) == ["across an edge", "a trace", "placement point"]


def located_board(view: BoardView, reason: str = "") -> Any:
    """Return a located board with rulers and fiducials of each kind, in a view of 0.1 mm per pixel."""
    rulers = SimpleNamespace(
        point=np.array([[0.0, 0.0], [1e-3, 0.0], [0.0, 1e-3], [9.0, 9.0]]),
        normal=np.tile([[1.0, 0.0]], (4, 1)),
        length_px=np.full(4, 4.0),
        position_px=np.array([1.0, -1.0, 0.0, 0.0]),
        used=np.array([True, False, False, False]),
        found=np.array([True, True, False, False]),
        in_image=np.array([True, True, True, False]),
    )
    fiducials = SimpleNamespace(
        point=np.array([[-1e-3, 0.0], [-1e-3, 1e-3], [-1e-3, -1e-3]]),
        image_px=np.array([[10.0, 20.0], [11.0, 31.0], [np.nan, np.nan]]),
        radius=np.array([3e-4, 3e-4, 3e-4]),
        size=np.array([2e-4, 4e-4, np.nan]),
        used=np.array([True, False, False]),
        found=np.array([True, True, False]),
        in_image=np.ones(3, bool),
    )
    return SimpleNamespace(
        rulers=rulers,
        fiducials=fiducials,
        view=view,
        placement_px=np.array([42.0, 17.0]),
        reason=reason,
        summary=lambda: "located",
    )


def test_located_board(drawn: list[Figure], tmp_path: Path) -> None:
    view = BoardView(scale=1e-4, shape=(41, 61), pose=(0.0, 0.0, 0.0))
    image = np.linspace(0.0, 1.0, 41 * 61).reshape(41, 61)
    located = located_board(view)
    draw_located_board(tmp_path / "located.png", image, some_artwork(), located)
    assert [*drawn[0].get_size_inches(), drawn[0].dpi] == pytest.approx([10.0, 10.0 * 41 / 61 + 0.8, 150])
    (axes,) = drawn[0].axes
    (shown,) = axes.images
    np.testing.assert_array_equal(shown.get_array(), image)
    assert shown.get_clim() == pytest.approx(tuple(np.percentile(image, [0.5, 99.5])))
    outlines, *rulers = [each for each in axes.collections if isinstance(each, LineCollection)]
    np.testing.assert_allclose(segments(outlines), [view.to_measured_pixels([[0.0, 0.0], [1e-3, 0.0]])])
    colours = ["#00e5ff", "#ff9f1c", "#ff3366"]
    assert [to_hex(cast("Any", each).get_colors()[0]) for each in rulers] == colours
    for number, each in enumerate(rulers):
        middle = view.to_measured_pixels(located.rulers.point[number])
        ends = np.array([[-2.0, 0.0], [2.0, 0.0]]) + middle
        np.testing.assert_allclose(segments(each), [ends])
    dots = [each for each in axes.lines if each.get_marker() == "."]
    for number, shift in enumerate((1.0, -1.0, 0.0)):
        column, row = view.to_measured_pixels(located.rulers.point[number])
        np.testing.assert_allclose(data(dots[number]), [[column + shift, row]])
    (cross,) = (each for each in axes.lines if each.get_marker() == "+")
    np.testing.assert_array_equal(data(cross), [[42.0, 17.0]])
    circles = [each for each in axes.patches if isinstance(each, Circle)]
    expected = [(10.0, 20.0), (11.0, 31.0), tuple(view.to_measured_pixels([-1e-3, -1e-3]))]
    assert [each.center for each in circles] == [pytest.approx(each) for each in expected]
    assert [each.radius for each in circles] == pytest.approx([2.0, 4.0, 3.0])
    assert [to_hex(each.get_edgecolor()) for each in circles] == colours
    marks = [tuple(data(each)[0]) for each in axes.lines if each.get_marker() == "x"]
    assert marks == [pytest.approx(each) for each in expected]
    assert texts(drawn[0].legends[0]) == [
        "artwork's edges",
        *(f"1 rulers: {name}" for name in ("agree", "rejected", "no edge found")),
        *(f"1 fiducials: {name}" for name in ("agree", "rejected", "not found")),
    ]
    names = {each.get_text(): cast("Any", each) for each in axes.texts if each.get_text()}
    # The arms are 8 % of the shorter side, that of x 1.6 times as long.
    arm = 0.08 * 41 * 1e-4
    assert names["x"].xy == pytest.approx(tuple(view.to_measured_pixels([1.6 * arm, 0.0])))
    assert names["y"].xy == pytest.approx(tuple(view.to_measured_pixels([0.0, arm])))
    assert [*axes.get_xlim(), *axes.get_ylim()] == [-0.5, 60.5, 40.5, -0.5]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("column [px]", "row [px]")


def test_refused_board_in_colour(drawn: list[Figure], tmp_path: Path) -> None:
    view = BoardView(scale=1e-4, shape=(41, 61), pose=(0.0, 0.0, 0.0))
    image = np.arange(41 * 61 * 3, dtype=np.uint8).reshape(41, 61, 3)
    for number, each in enumerate((image, image.astype(np.float32))):
        draw_located_board(tmp_path / f"{number}.png", each, some_artwork(), located_board(view, "too dark"))
    colour, grey = (each.axes[0].images[0].get_array() for each in drawn)
    np.testing.assert_array_equal(colour, image[..., ::-1])
    np.testing.assert_allclose(grey, image.mean(axis=2), rtol=1e-6)
    assert texts(drawn[0].legends[0])[0] == "artwork's edges where last looked for"


def test_delay_of_a_loop(drawn: list[Figure], tmp_path: Path) -> None:
    roots = np.array([[0.5 + 0.25j, 0.5 - 0.25j], [0.25 + 0.0j, 0.75 + 0.0j]])
    values = {name: np.array([1.0, 2.0, 4.0]) * (number + 1) for number, name in enumerate(FrameTimeCurve._fields)}
    curve = FrameTimeCurve(**values)
    picture = DelayPicture(
        title="delay",
        parts={"exposure": 2e-3, "transfer": 3e-3},
        steps=[("one", np.array([1.0, 0.5])), ("two", np.array([1.0, 0.25]))],
        locus=roots,
        marked=[("critical", roots[1])],
        curve=curve,
        period=2e-3,
    )
    draw_delay(tmp_path / "delay.png", picture)
    assert tuple(drawn[0].get_size_inches()) == (12.0, 8.5)
    budget, step, locus, against, beside = drawn[0].axes
    bars = [(each.get_x(), each.get_width()) for each in map(cast, ["Any"] * 2, budget.patches)]
    assert bars == [pytest.approx((0.0, 2.0)), pytest.approx((2.0, 3.0))]
    assert budget.get_title() == "total delay 5 ms"
    assert budget.yaxis_inverted()
    one, two, zero = step.lines
    np.testing.assert_array_equal(data(one), [[0.0, 1.0], [1.0, 0.5]])
    np.testing.assert_array_equal(data(two), [[0.0, 1.0], [1.0, 0.25]])
    np.testing.assert_array_equal(zero.get_ydata(), [0.0, 0.0])
    circle, points, marked = locus.lines
    np.testing.assert_allclose(np.hypot(*data(circle).T), 1.0)
    assert np.ptp(data(circle), axis=0) == pytest.approx([2.0, 2.0], abs=1e-3)
    np.testing.assert_array_equal(data(points), np.stack([roots.ravel().real, roots.ravel().imag], axis=-1))
    np.testing.assert_array_equal(data(marked), [[0.25, 0.0], [0.75, 0.0]])
    assert [*locus.get_xlim(), *locus.get_ylim()] == [-1.6, 1.6, -1.3, 1.3]
    total, now = against.lines
    np.testing.assert_allclose(data(total), np.stack([1e3 * curve.period, 1e3 * curve.total], axis=-1))
    assert now.get_xdata()[0] == pytest.approx(2.0)
    (band,) = beside.lines
    np.testing.assert_allclose(data(band), np.stack([1e3 * curve.period, curve.bandwidth], axis=-1))
    assert (against.get_xscale(), against.get_xlabel()) == ("log", "frame time [ms]")


def test_measured_delay(drawn: list[Figure], tmp_path: Path) -> None:
    time = 1e-3 * np.arange(5)
    command, seen = 1e-6 * np.arange(5.0), 2e-6 * np.arange(5.0)
    delay = MeasuredDelay(2e-3, 1e-5, 3e-4, 1e-5, 1.0, 1e-9, 2.5, np.array([2e-3, 2.1e-3, 2.1e-3]))
    draw_measured_delay(tmp_path / "measured.png", time, command, seen, delay)
    assert tuple(drawn[0].get_size_inches()) == (12.0, 4.5)
    left, right = drawn[0].axes
    assert left.get_position().width / right.get_position().width == pytest.approx(2.0)
    commanded, delayed, measured = left.lines
    np.testing.assert_allclose(data(commanded), np.stack([np.arange(5.0)] * 2, axis=-1))
    np.testing.assert_allclose(data(delayed), np.stack([np.arange(5.0) + 2.0, np.arange(5.0)], axis=-1))
    np.testing.assert_allclose(data(measured), np.stack([np.arange(5.0), 2.0 * np.arange(5.0)], axis=-1))
    heights = [cast("Any", each).get_height() for each in right.patches]
    assert (len(heights), sum(heights), max(heights)) == (40, 3.0, 2.0)
    assert right.lines[0].get_xdata()[0] == pytest.approx(2.0)
    assert right.get_xlabel() == "delay of single samples [ms]"
    assert drawn[0].get_suptitle() == "delay 2 ms (2.5 frames), sigma 0.01 ms; jitter 0.3 ms"


def test_delay_and_errors_of_placements(drawn: list[Figure], tmp_path: Path) -> None:
    error = np.array([[1e-6, 0.0, 0.2e-3], [3e-6, 0.1e-6, -0.1e-3], [np.nan] * 3])
    draw_placements(
        tmp_path / "placements.png",
        period=2e-3,
        motion=[np.full((3, 3), 1e-5)],
        response=np.outer([1.0, 0.2, 0.04], np.ones(3)),
        error=error,
        sigmas=np.array([1e-6, 2e-6, 1e-4]),
        delay={"exposure": 1e-3, "pose": 3e-3},
        tolerance=(5e-6, 2e-3),
    )
    assert [*drawn[0].get_size_inches(), drawn[0].dpi] == [15.0, 9.2, 120]
    panels: dict[str, Any] = {each.get_xlabel() + each.get_title(): each for each in drawn[0].axes}
    bars = [(each.get_x(), each.get_width()) for each in panels["time [ms]delay budget: 4.00 ms"].patches]
    assert bars == [pytest.approx((0.0, 1.0)), pytest.approx((1.0, 3.0))]
    panel = panels["error at the release [µm]2 placements"]
    assert texts(panel.get_legend()) == ["x measured", "x predicted", "y measured", "y predicted"]
    for curve, sigma in zip(panel.lines, (1.0, 2.0), strict=True):
        places, expected = data(curve).T
        # 21 edges from -8 to 8: bins of 0.8 um, and 2 placements.
        normal = np.exp(-0.5 * (places / sigma) ** 2) / (sigma * np.sqrt(2.0 * np.pi))
        np.testing.assert_allclose(expected, 2.0 * 0.8 * normal)
        assert (places[0], places[-1], len(places)) == (pytest.approx(-8.0), pytest.approx(8.0), 401)
