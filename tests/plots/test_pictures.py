"""Pictures of calibrations, inspections, robots and frames: the drawn numbers, their units, axes and colour scales."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from matplotlib.quiver import Quiver

from gpuvision.matching.field.distance_map import Arc, Field
from gpuvision.plots import calibration as calibration_picture
from gpuvision.plots import field as field_picture
from gpuvision.plots.calibration import draw_calibration
from gpuvision.plots.field import draw_located_robot, draw_robot_track, field_lines
from gpuvision.plots.inspection import draw_regions
from gpuvision.plots.line_frames import LineFrame, draw_line_frames
from gpuvision.plots.plan import PlannedSetting, draw_plan
from gpuvision.plots.sensor_calibration import SensorPicture, draw_sensor_calibration
from gpuvision.ranging.height_map import Grid
from gpuvision.status import Status


def data(line: Any) -> np.ndarray:
    """Return the points of a drawn line (n, 2)."""
    return np.stack([np.asarray(line.get_xdata(), float), np.asarray(line.get_ydata(), float)], axis=-1)


def labels(axes: Any) -> tuple[str, str, str]:
    title = axes.get_title() or axes.get_title(loc="left")
    return axes.get_xlabel(), axes.get_ylabel(), title


def ranges(axes: Any) -> list[float]:
    return [*axes.get_xlim(), *axes.get_ylim()]


def page(figure: Figure) -> Any:
    """Return the size of the page [in] and its resolution [px/in]."""
    return pytest.approx((*figure.get_size_inches(), figure.dpi))


# ---- calibrations --------------------------------------------------------------------------------------------


def test_picture_of_a_sensor_calibration(drawn: list[Figure], tmp_path: Path) -> None:
    image = np.tile(np.arange(60, dtype=np.uint8), (40, 1))
    cv2.imwrite(str(tmp_path / "laser.png"), image)
    grid = np.stack(np.meshgrid([5.0, 15.0, 25.0], [7.0, 17.0]), axis=-1)
    lines = tuple(np.arange(20.0).reshape(10, 2) + k for k in range(2))
    flat = tuple(1e-3 * np.arange(8.0).reshape(4, 2) + 1e-3 * k for k in range(2))
    residuals = (np.array([0.1, -0.2, np.nan, 0.3]), np.array([0.5, 0.6, 0.7, 0.8]))
    picture = SensorPicture(
        title="sensor",
        image=tmp_path / "laser.png",
        grid=grid,
        line=lines[0],
        lines=lines,
        coordinates=flat,
        residuals=residuals,
        sigma_px=0.25,
    )
    draw_sensor_calibration(tmp_path / "picture.png", picture)
    left, right, below, beside = drawn[0].axes
    assert page(drawn[0]) == (13.0, 8.0, 150)
    # The panes of images are half as high again as those of the readings.
    grid_of_panes: Any = left.get_subplotspec().get_gridspec()
    assert np.divide(*grid_of_panes.get_height_ratios()) == pytest.approx(1.5)
    (shown,) = left.images
    np.testing.assert_array_equal(shown.get_array(), image)
    assert shown.get_clim() == (0.0, pytest.approx(np.percentile(image, 99.8)))
    assert [len(each.get_xdata()) for each in left.lines] == [2, 2, 2, 3, 3, 6, 10]
    np.testing.assert_array_equal(data(left.lines[0]), grid[:, 0])
    np.testing.assert_array_equal(data(left.lines[3]), grid[0])
    np.testing.assert_array_equal(data(left.lines[5]), grid.reshape(-1, 2))
    np.testing.assert_array_equal(data(left.lines[6]), lines[0])
    assert [each.get_text() for each in left.get_legend().get_texts()] == ["target points", "laser line"]
    assert labels(left) == ("column [px]", "row [px]", "laser.png: target and laser line found")
    for drawn_line, points in zip(right.lines, lines, strict=True):
        np.testing.assert_array_equal(data(drawn_line), points)
    assert ranges(right) == [-0.5, 59.5, 39.5, -0.5]
    assert labels(right) == ("column [px]", "row [px]", "laser lines of all images")
    for number, drawn_line in enumerate(below.lines):
        np.testing.assert_allclose(data(drawn_line), np.stack([1e3 * flat[number][:, 0], residuals[number]], axis=-1))
    assert ranges(below)[2:] == [-1.5, 1.5]
    assert labels(below) == ("G [mm]", "residual [px]", "residuals of the sheet; noise of a reading 0.25 px")
    for number, drawn_line in enumerate(beside.lines):
        np.testing.assert_allclose(data(drawn_line), 1e3 * flat[number])
    assert labels(beside)[:2] == ("G [mm]", "H [mm]")
    no_grid = SensorPicture(**{**vars(picture), "grid": np.zeros((0, 0, 2))})
    draw_sensor_calibration(tmp_path / "other.png", no_grid)
    assert len(drawn[1].axes[0].lines) == 1


def some_calibration(errors: np.ndarray, points: np.ndarray) -> Any:
    """Return a calibration of an image of 640 x 480; the correction shifts points to the right, more at the right."""
    grid = np.stack(np.meshgrid([0.0, 300.0, 639.0], [0.0, 479.0]), axis=-1)
    sigma = np.array([[0.01, 0.02, np.nan], [0.02, 0.04, 0.16]])
    return SimpleNamespace(
        image_size=(640, 480),
        residuals=((points[:2], errors[:2]), (points[2:], errors[2:])),
        model=SimpleNamespace(undistort=lambda pixels: pixels + 0.01 * pixels[..., :1] * [1.0, 0.0]),
        correction_map=SimpleNamespace(points=grid, sigma_px=sigma, extrapolated=sigma > 0.1),
        parameters={"C_c": (320.0, 2.0), "R_c": (240.0, 3.0)},
        summary=lambda: "calibrated",
    )


def test_picture_of_a_calibration_by_lines(drawn: list[Figure], tmp_path: Path) -> None:
    points = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    errors = np.array([0.4, -0.1, np.nan, 0.2])
    draw_calibration(tmp_path / "picture.png", some_calibration(errors, points))
    panels = drawn[0].axes
    assert page(drawn[0]) == (19.0, 5.6, 150)
    residuals, correction, uncertainty = panels[:3]
    (dots,) = residuals.collections
    np.testing.assert_array_equal(dots.get_offsets(), points[[1, 3, 0]])
    np.testing.assert_allclose(dots.get_array(), [0.1, 0.2, 0.4])
    assert dots.get_clim() == (0.0, pytest.approx(np.percentile([0.1, 0.2, 0.4], 98)))
    for axes in panels[:3]:
        assert ranges(axes) == [-0.5, 639.5, 479.5, -0.5]
        assert labels(axes)[:2] == ("column [px]", "row [px]")
    names = sorted(axes.get_ylabel() for axes in panels[3:])
    assert names == ["1 sigma of the correction [px]", "correction [px]", "residual [px]"]
    (arrows,) = (each for each in correction.collections if isinstance(each, Quiver))
    # At most 21 + 1 arrows along a side; each is as long as the correction, 1 % of the column.
    assert arrows.N == 21 * 21
    assert np.ptp(arrows.XY[:, 0]) > 600.0
    assert np.ptp(arrows.XY[:, 1]) > 460.0
    np.testing.assert_allclose(arrows.U, 0.01 * arrows.XY[:, 0], atol=1e-9)
    np.testing.assert_allclose(arrows.V, 0.0, atol=1e-9)
    shown = next(each for each in correction.collections if not isinstance(each, Quiver))
    assert shown.get_clim()[1] == pytest.approx(6.39, abs=0.7)
    (centre, *_) = (each for each in correction.lines if len(each.get_xdata()) == 1)
    np.testing.assert_array_equal(data(centre), [[320.0, 240.0]])
    bars = [each.get_segments()[0] for each in correction.collections if isinstance(each, LineCollection)]
    spans = sorted(tuple(np.ptp(each, axis=0)) for each in bars)
    assert spans == [(0.0, 6.0), (4.0, 0.0)]
    filled, hatched = uncertainty.collections
    assert filled.get_clim() == pytest.approx((0.01, 0.16))
    assert len(cast("Any", filled).levels) == 13
    assert len(cast("Any", hatched).levels) == 2
    assert drawn[0].get_suptitle() == "calibrated"


def test_picture_of_a_calibration_by_views(drawn: list[Figure], tmp_path: Path) -> None:
    points = np.array([[10.0, 20.0], [30.0, 40.0], [50.0, 60.0], [70.0, 80.0]])
    errors = np.array([[0.3, 0.4], [0.0, -0.1], [np.nan, np.nan], [0.12, 0.16]])
    calibration = some_calibration(errors, points)
    calibration.model, calibration.parameters = None, {"fx": (500.0, 1.0)}
    draw_calibration(tmp_path / "picture.png", calibration)
    residuals, correction = drawn[0].axes[:2]
    (arrows,) = residuals.collections
    assert isinstance(arrows, Quiver)
    # The 98th percentile of the residuals is drawn as 2 % of the image's width.
    largest = np.percentile([0.1, 0.2, 0.5], 98)
    np.testing.assert_array_equal(arrows.XY, points[[1, 3, 0]])
    np.testing.assert_allclose(np.stack([arrows.U, arrows.V], -1), errors[[1, 3, 0]] * 12.8 / largest)
    assert arrows.get_clim() == (0.0, pytest.approx(largest))
    assert residuals.get_title() == f"measured minus projected, magnified {12.8 / largest:.3g} times"
    assert not correction.collections
    assert not correction.lines


def test_of_many_residuals_every_nth_is_drawn(
    drawn: list[Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration_picture, "_MAX_POINTS", 3)
    for panel in ("_draw_distortion", "_draw_uncertainty"):
        monkeypatch.setattr(calibration_picture, panel, lambda *_: None)
    for count, step in ((5, 1), (6, 2), (8, 2), (9, 3)):
        errors = 0.1 * np.arange(1.0, count + 1)
        points = np.stack([np.arange(float(count)), np.arange(float(count))], axis=1)
        draw_calibration(tmp_path / f"{count}.png", some_calibration(errors, points))
        (dots,) = drawn[-1].axes[0].collections
        np.testing.assert_allclose(dots.get_array(), errors[::step])


@pytest.mark.parametrize(("least", "lowest"), [(0.01, 0.01), (2e-4, 2e-4), (1e-5, 1.6e-4), (0.16, 0.16)])
def test_scale_of_the_uncertainty(
    least: float, lowest: float, drawn: list[Figure], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Logarithmic, from the least one, or a thousandth of the largest one; what is not known is not filled."""
    monkeypatch.setattr(calibration_picture, "_draw_distortion", lambda *_: None)
    calibration = some_calibration(np.array([0.4, -0.1, 0.3, 0.2]), np.zeros((4, 2)))
    sigma = np.array([[least, 0.02 if least < 0.02 else 0.16, np.nan], [0.16, 0.16, 0.16]])
    calibration.correction_map.sigma_px = sigma
    draw_calibration(tmp_path / "picture.png", calibration)
    panels = drawn[0].axes
    filled, hatched = (cast("Any", each) for each in panels[2].collections)
    highest = max(0.16, 1.001 * lowest)  # also where all are equal
    np.testing.assert_allclose(filled.levels, np.geomspace(lowest, highest, 13))
    assert (filled.norm.vmin, filled.norm.vmax) == pytest.approx((lowest, highest))
    assert list(hatched.levels) == [0.5, 1.5]
    calibration.correction_map.sigma_px = np.full((2, 3), np.nan)
    draw_calibration(tmp_path / "unknown.png", calibration)
    assert len(drawn[1].axes[2].collections) == 1
    assert len(drawn[1].axes) == len(panels) - 1


# ---- inspection ----------------------------------------------------------------------------------------------


def region(name: str, x: float, y: float) -> Any:
    """Return a square of 1 mm with a hole, which is not drawn."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * 1e-3 + np.array([x, y])
    shapes = (SimpleNamespace(outline=corners, dark=True), SimpleNamespace(outline=corners, dark=False))
    return SimpleNamespace(name=name, centroid=corners.mean(axis=0), shapes=shapes)


def test_picture_of_an_inspection(drawn: list[Figure], tmp_path: Path) -> None:
    grid = Grid(left=1e-3, top=9e-3, cell_x=1e-4, cell_y=2e-4, columns=60, rows=40)
    z = np.linspace(-1e-4, 2e-4, 2400).reshape(40, 60)
    regions = [region("A", 2e-3, 3e-3), region("B", 4e-3, 3e-3), region("C", 2e-3, 5e-3)]
    draw_regions(
        tmp_path / "picture.png",
        z,
        grid,
        regions,
        np.array([50.0, np.nan, 150.0]),
        (0.0, 200.0),
        [True, False, False],
        title="paste",
        label="volume [%]",
        colours="RdYlBu",
    )
    axes, bar = drawn[0].axes
    (shown,) = axes.images
    assert page(drawn[0]) == (10.0, 8.5 * 8.0 / 6.0 + 0.8, 150)
    np.testing.assert_array_equal(shown.get_array(), z)
    edges = [0.95, 6.95, 1.1, 9.1]
    assert shown.get_extent() == pytest.approx(edges)
    assert ranges(axes) == pytest.approx(edges)
    known, unknown = (each for each in axes.collections if isinstance(each, PolyCollection))
    np.testing.assert_array_equal(known.get_array(), [50.0, 150.0])
    assert known.get_clim() == (0.0, 200.0)
    assert [to_hex(each) for each in known.get_edgecolor()] == ["#1a1a1a", "#d62728"]
    np.testing.assert_allclose(known.get_paths()[1].vertices[:4], 1e3 * regions[2].shapes[0].outline)
    np.testing.assert_allclose(unknown.get_paths()[0].vertices[:4], 1e3 * regions[1].shapes[0].outline)
    assert (len(known.get_paths()), len(unknown.get_paths()), unknown.get_hatch()) == (2, 1, "///")
    assert [(each.get_text(), each.xy) for each in axes.texts] == [
        ("A", pytest.approx((2.5, 3.5))),
        ("B", pytest.approx((4.5, 3.5))),
        ("C", pytest.approx((2.5, 5.5))),
    ]
    assert bar.get_ylabel() == "volume [%]"
    assert labels(axes)[:2] == ("x [mm]", "y [mm]")
    low, top = np.percentile(z, [0.5, 99.5])
    assert labels(axes)[2] == f"paste\ngrey: heights {1e6 * low:.3g} to {1e6 * top:.3g} µm"


def test_many_regions_have_no_names_and_large_maps_are_thinned_out(drawn: list[Figure], tmp_path: Path) -> None:
    grid = Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=1e-5, columns=2001, rows=3)
    z = np.arange(6003.0).reshape(3, 2001)
    regions = [region(str(k), 1e-3 * k, 0.0) for k in range(61)]
    for count in (60, 61):
        values = np.ones(count)
        draw_regions(
            tmp_path / f"{count}.png", z, grid, regions[:count], values, (0.0, 1.0), [True] * count,
            title="", label="", colours="viridis",
        )  # fmt: skip
    assert [len(each.axes[0].texts) for each in drawn] == [60, 0]
    assert page(drawn[0]) == (10.0, 3.0 + 0.8, 150)  # 3 in high at least
    np.testing.assert_array_equal(drawn[0].axes[0].images[0].get_array(), z[::2, ::2])


# ---- frames --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_picture_of_frames(along: Any, drawn: list[Figure], tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    samples, places = 6, 30
    shape = (places, samples) if along == "columns" else (samples, places)
    status = np.array([0, Status.SATURATED, Status.AMBIGUOUS | Status.SATURATED, Status.LOW_SIGNAL, 0, 0], np.uint8)
    position = np.array([3.0, 4.0, 5.0, np.nan, 7.0, np.nan])
    frames = [
        LineFrame(number=k, image=rng.uniform(0.0, 100.0, shape), position=position, status=status) for k in (4, 9)
    ]
    assert frames[0].found_fraction == pytest.approx(4 / 6)
    draw_line_frames(tmp_path / "frames.png", frames, along=along, title="frames")
    assert (12.0, 5.0 * 6.0 + 1.25 if along == "columns" else 2.0 * (0.2 * 12.0 + 0.25) + 1.0, 110) == page(drawn[0])
    first, second = drawn[0].axes
    high = np.percentile(np.concatenate([each.image.ravel() for each in frames]), 99.9)
    for axes, frame in ((first, frames[0]), (second, frames[1])):
        (shown,) = axes.images
        np.testing.assert_array_equal(shown.get_array(), frame.image)
        assert shown.get_clim() == (0.0, pytest.approx(high))
        assert ranges(axes) == [-0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5]
        *dots, lost = axes.collections
        expected = {"#c77dff": [[2, 5]], "#ffd60a": [[1, 4]], "#39ff14": [[0, 3], [4, 7]]}
        for marks in dots:
            offsets = np.asarray(marks.get_offsets())
            offsets = offsets if along == "columns" else offsets[:, ::-1]
            np.testing.assert_array_equal(offsets, expected.pop(to_hex(marks.get_facecolor()[0])))
        assert not expected
        assert isinstance(lost, LineCollection)
        segments = np.array(lost.get_segments())
        segments = segments if along == "columns" else segments[..., ::-1]
        np.testing.assert_allclose(segments[:, :, 0], [[3, 3], [5, 5]])
        np.testing.assert_allclose(segments[:, :, 1], [[-0.5, 0.06 * places]] * 2)
    assert [each.get_title() for each in (first, second)] == [
        f"frame {number}: line in 67 %, SATURATED 33 %" for number in (4, 9)
    ]
    texts = [each.get_text() for each in drawn[0].legends[0].get_texts()]
    assert texts == ["line found", "saturated", "ambiguous: several candidates", "no line: mark at the border"]
    # Two tall frames lie side by side, two wide frames below each other.
    boxes = [each.get_subplotspec().get_geometry()[:2] for each in (first, second)]
    assert boxes == [(1, 2) if along == "columns" else (2, 1)] * 2


@pytest.mark.parametrize(
    ("count", "shape", "grid"),
    [
        (6, (10, 10), (2, 3)),
        (5, (10, 10), (2, 3)),
        (3, (10, 10), (2, 2)),
        (2, (10, 10), (1, 2)),
        (4, (10, 40), (4, 1)),
        (4, (40, 10), (1, 4)),
        (9, (10, 30), (5, 2)),
    ],
)
def test_frames_fill_a_page(
    count: int, shape: tuple[int, int], grid: tuple[int, int], drawn: list[Figure], tmp_path: Path
) -> None:
    """Wide frames lie below each other, tall frames side by side: the page is about 1.4 times as wide as high."""
    frames = [
        LineFrame(number=k, image=np.ones(shape), position=np.ones(shape[1]), status=np.zeros(shape[1], np.uint8))
        for k in range(count)
    ]
    draw_line_frames(tmp_path / "frames.png", frames, along="columns", title="frames")
    assert len(drawn[0].axes) == count
    for number, axes in enumerate(drawn[0].axes):
        place: Any = axes.get_subplotspec()
        assert place.get_geometry() == (*grid, number, number)
    high = max(12.0 / grid[1] * shape[0] / shape[1], 0.3) + 0.25
    assert tuple(drawn[0].get_size_inches()) == pytest.approx((12.0, grid[0] * high + 1.0))


def test_dark_frames_have_a_scale(drawn: list[Figure], tmp_path: Path) -> None:
    frame = LineFrame(
        number=0, image=np.full((5, 5), np.nan), position=np.full(5, np.nan), status=np.zeros(5, np.uint8)
    )
    draw_line_frames(tmp_path / "frames.png", [frame], along="columns", title="frames")
    (axes,) = drawn[0].axes
    assert axes.images[0].get_clim() == (0.0, 1.0)
    assert axes.get_title() == "frame 0: line in 0 %"


# ---- robots --------------------------------------------------------------------------------------------------

FIELD = Field(
    length=10.0, width=6.0, lines=((-4.0, -2.0, 4.0, -2.0), (1.0, -2.0, 1.0, 2.0)), arcs=(Arc(0.5, 1.0, 2.0),)
)
POSE = np.array([1.0, 2.0, 0.5])
COVARIANCE = np.array([[0.04, 0.02, 0.0], [0.02, 0.07, 0.0], [0.0, 0.0, 0.01]])


def test_lines_of_a_field() -> None:
    lines = field_lines(FIELD)
    np.testing.assert_array_equal(lines[1], [[1.0, -2.0], [1.0, 2.0]])
    arc = lines[2]
    np.testing.assert_allclose(np.hypot(*(arc - [0.5, 1.0]).T), 2.0)
    assert len(arc) == math.ceil(2.0 * math.pi / 0.08)
    np.testing.assert_allclose([arc[0], arc[-1]], [[2.5, 1.0]] * 2)


def test_short_arcs_have_eight_points() -> None:
    """Others have a point for each 0.08 radians."""
    for turn, count in ((0.1, 8), (0.56, 8), (0.64, 8), (0.641, 9), (1.0, 13)):
        field = Field(length=1.0, width=1.0, lines=(), arcs=(Arc(0.5, -1.0, 2.0, 0.3, 0.3 + turn),))
        (arc,) = field_lines(field)
        assert len(arc) == count
        ends = [[0.5 + 2.0 * math.cos(each), -1.0 + 2.0 * math.sin(each)] for each in (0.3, 0.3 + turn)]
        np.testing.assert_allclose(arc[[0, -1]], ends)


def test_distance_from_a_line_is_that_from_its_nearest_point() -> None:
    lines = [np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]]), np.array([[-5.0, 5.0], [-5.0, 9.0]])]
    points = np.array([[2.0, 1.5], [-3.0, -4.0], [5.0, 2.0], [4.0, 5.0], [-7.0, 6.0], [2.5, 0.0]])
    np.testing.assert_allclose(field_picture._distances(points, lines), [1.5, 5.0, 1.0, 2.0, 2.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(("std", "limit"), [(0.02, 0.06), (0.0, 3e-3), (1e-4, 3e-3)])
def test_points_within_three_sigmas_are_on_lines(std: float, limit: float, drawn: list[Figure], tmp_path: Path) -> None:
    """A sigma of 1 mm at least."""
    field = Field(length=10.0, width=6.0, lines=((-4.0, 0.0, 4.0, 0.0),), arcs=())
    best = SimpleNamespace(pose=np.zeros(3), covariance=COVARIANCE, score=0.1, residual_std=std)
    points = np.array([[1.0, 0.99 * limit], [2.0, -0.99 * limit], [3.0, 1.01 * limit]])
    located: Any = SimpleNamespace(
        points=points, candidates=(best,), doubtful=(), field=field, scale=None, summary=lambda: "located"
    )
    draw_located_robot(tmp_path / "located.png", located)
    on, beside, _ = drawn[0].axes[0].lines
    np.testing.assert_allclose(data(on), points[:2])
    np.testing.assert_allclose(data(beside), points[2:])


def check_ellipse(ellipse: Ellipse, centre: np.ndarray, colour: str) -> None:
    """Check that an ellipse is that of three sigmas."""
    assert ellipse.center == pytest.approx(tuple(centre[:2]))
    assert to_hex(ellipse.get_edgecolor()) == colour
    turn = math.radians(ellipse.angle)
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    half = np.diag([0.5 * ellipse.width, 0.5 * ellipse.height]) / 3.0
    np.testing.assert_allclose(axes @ half**2 @ axes.T, COVARIANCE[:2, :2], atol=1e-12)


def test_picture_of_a_track(drawn: list[Figure], tmp_path: Path) -> None:
    lost = SimpleNamespace(pose=np.full(3, np.nan), covariance=np.full((3, 3), np.nan), status=Status.NO_DATA)
    states: list[Any] = [lost] + [
        SimpleNamespace(pose=POSE + 0.1 * k, covariance=COVARIANCE, status=Status.AMBIGUOUS if k < 5 else Status.OK)
        for k in range(1, 13)
    ]
    draw_robot_track(tmp_path / "track.png", FIELD, states)
    assert page(drawn[0]) == (9.0, 6.5, 130)
    (axes,) = drawn[0].axes
    certain, ambiguous = axes.lines
    np.testing.assert_allclose(data(certain), [each.pose[:2] for each in states[5:]])
    np.testing.assert_allclose(data(ambiguous), [each.pose[:2] for each in states[1:5]])
    texts = [each.get_text() for each in axes.get_legend().get_texts()]
    assert texts == ["8 frames certain", "4 frames ambiguous"]
    colours = [to_hex(each) for each in (axes.get_facecolor(), certain.get_color(), ambiguous.get_color())]
    assert colours == ["#2e7d4f", "#00e5ff", "#ff9f1c"]
    assert axes.get_aspect() == 1.0
    tenth, last = axes.patches
    check_ellipse(cast("Ellipse", tenth), states[10].pose, "#5d4037")
    check_ellipse(cast("Ellipse", last), states[12].pose, "#d50000")
    assert ranges(axes) == pytest.approx([-5.6, 5.6, -3.6, 3.6])
    assert labels(axes)[:2] == ("x [m]", "y [m]")
    (lines,) = axes.collections
    assert len(cast("Any", lines).get_segments()) == 3


def test_picture_of_a_located_robot(drawn: list[Figure], tmp_path: Path) -> None:
    to_robot = np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    # Two points on lines, one 1 m beside them.
    on_field = np.array([[1.0, 0.5], [-3.0, -2.0], [3.0, -1.0]])
    best = SimpleNamespace(pose=POSE, covariance=COVARIANCE, score=0.125, residual_std=0.01)
    other = SimpleNamespace(pose=-POSE, covariance=np.full((3, 3), np.nan), score=0.25, residual_std=0.01)
    located: Any = SimpleNamespace(
        points=(on_field - POSE[:2]) @ to_robot,
        candidates=(best, other),
        doubtful=(),
        field=FIELD,
        scale=0.05,
        summary=lambda: "located",
    )
    image = np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3)
    draw_located_robot(tmp_path / "located.png", located, image)
    draw_located_robot(tmp_path / "points.png", located)
    assert page(drawn[0]) == (13.0, 5.8, 130)
    view, field = drawn[0].axes
    (shown,) = view.images
    np.testing.assert_array_equal(shown.get_array(), image[..., ::-1])
    assert shown.get_extent() == pytest.approx([-2.0, 2.0, -1.5, 1.5])
    assert ranges(view) == pytest.approx([-2.0, 2.0, -1.5, 1.5])
    reach = 1.05 * np.abs(located.points).max()
    assert ranges(drawn[1].axes[0]) == pytest.approx([-reach, reach, -reach, reach])
    # The image lies on black, points alone lie on the carpet, as the field does.
    grounds = [to_hex(axes.get_facecolor()) for figure in drawn for axes in figure.axes]
    assert grounds == ["#000000", "#2e7d4f", "#2e7d4f", "#2e7d4f"]
    assert {axes.get_aspect() for figure in drawn for axes in figure.axes} == {1.0}
    on, beside, robot = view.lines
    np.testing.assert_allclose(data(on), located.points[:2])
    np.testing.assert_allclose(data(beside), located.points[2:])
    np.testing.assert_array_equal(data(robot), [[0.0, 0.0]])
    texts = [each.get_text() for each in view.get_legend().get_texts()]
    assert texts == ["2 points on lines", "1 points beside them"]
    assert [to_hex(each.get_color()) for each in (on, beside, robot)] == ["#00e5ff", "#ff9f1c", "#ffffff"]
    (lines,) = view.collections
    segments = cast("Any", lines).get_segments()
    np.testing.assert_allclose(segments[0] @ to_robot.T + POSE[:2], [[-4.0, -2.0], [4.0, -2.0]], atol=1e-12)
    assert labels(view)[:2] == ("ahead [m]", "to the left [m]")
    # The field: candidates in reversed order, then the points at the best one.
    second, first, points = field.lines
    np.testing.assert_allclose(data(first), [POSE[:2]])
    np.testing.assert_allclose(data(second), [-POSE[:2]])
    np.testing.assert_allclose(data(points), on_field, atol=1e-12)
    assert [to_hex(each.get_color()) for each in (first, second, points)] == ["#d50000", "#5d4037", "#00e5ff"]
    (ellipse,) = field.patches
    check_ellipse(cast("Ellipse", ellipse), POSE, "#d50000")
    arrows = [cast("Any", each) for each in field.texts if not each.get_text()]
    scores = [each.get_text() for each in field.texts if each.get_text()]
    assert scores == [" 2: 0.250", " 1: 0.125"]
    assert [to_hex(each.arrow_patch.get_edgecolor()) for each in arrows] == ["#5d4037", "#d50000"]
    for arrow, pose in zip(arrows, (-POSE, POSE), strict=True):
        tip = pose[:2] + 0.6 * np.array([math.cos(pose[2]), math.sin(pose[2])])
        assert (*arrow.xy, *arrow.xyann) == pytest.approx((*tip, *pose[:2]))
    assert ranges(field) == pytest.approx([-5.6, 5.6, -3.6, 3.6])


def test_a_refused_pose_is_drawn_in_the_view_only(drawn: list[Figure], tmp_path: Path) -> None:
    doubtful = SimpleNamespace(pose=POSE, covariance=COVARIANCE, score=0.125, residual_std=0.01)
    none = np.zeros((0, 2), np.float32)
    for poses in ((doubtful,), ()):
        located: Any = SimpleNamespace(
            points=none, candidates=(), doubtful=poses, field=FIELD, scale=None, summary=lambda: "refused"
        )
        draw_located_robot(tmp_path / f"{len(poses)}.png", located)
    (view, field), (empty, _) = (each.axes for each in drawn)
    assert (len(view.collections), len(empty.collections), len(field.patches), len(field.lines)) == (1, 0, 0, 0)
    assert ranges(empty) == [-1.0, 1.0, -1.0, 1.0]


# ---- plans ---------------------------------------------------------------------------------------------------


def test_picture_of_a_plan(drawn: list[Figure], tmp_path: Path) -> None:
    settings = (
        PlannedSetting("windowed 6", 9e-6, 7e-6, chosen=True),
        PlannedSetting("ml 6", 40e-6, 6e-6, chosen=False),
    )
    draw_plan(tmp_path / "plan.png", settings, 8e-6, title="camera")
    assert page(drawn[0]) == (6.5, 4.5, 150)
    (axes,) = drawn[0].axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert labels(axes) == ("time per frame [us]", "predicted error of the heights [um]", "camera")
    limit, chosen, other = axes.lines
    np.testing.assert_allclose(limit.get_ydata(), 8.0)
    np.testing.assert_allclose(data(chosen), [[9.0, 7.0]])
    np.testing.assert_allclose(data(other), [[40.0, 6.0]])
    assert chosen.get_color() != other.get_color()
    assert [each.get_text() for each in axes.texts] == ["windowed 6", "ml 6"]
    assert [each.get_text() for each in axes.get_legend().get_texts()] == ["tolerance", "chosen"]


def test_a_picture_of_many_settings_names_those_that_no_other_one_beats(drawn: list[Figure], tmp_path: Path) -> None:
    """Times 1, 2, ... and errors 20, 19, ..., of which every third one is 30 instead."""
    settings = [
        PlannedSetting(f"s{k}", 1e-6 * (k + 1), 1e-6 * (30 if k % 3 == 2 else 20 - k), chosen=k == 5) for k in range(13)
    ]
    draw_plan(tmp_path / "a.png", settings, 8e-6, error_of="the pose", unit="image")
    (axes,) = drawn[0].axes
    assert labels(axes)[:2] == ("time per image [us]", "predicted error of the pose [um]")
    assert len(axes.lines) == 14
    assert [each.get_text() for each in axes.texts] == [f"s{k}" for k in range(13) if k % 3 != 2 or k == 5]
    draw_plan(tmp_path / "b.png", settings[1:], 8e-6)
    assert len(drawn[1].axes[0].texts) == 12
    # Of settings at one place the chosen one has the name and is on top, otherwise the first one.
    apart = [each for each in settings if each.error < 29e-6 or each.chosen]
    same = [each._replace(name=f"{each.name} again", seconds=1.009 * each.seconds, chosen=False) for each in apart]
    draw_plan(tmp_path / "c.png", [*same, *settings], 8e-6)
    axes = drawn[2].axes[0]
    assert [each.get_text() for each in axes.texts] == [*(each.name for each in same if each.name[:2] != "s5"), "s5"]
    chosen = next(each for each in axes.lines if each.get_label() == "chosen")
    assert all(chosen.get_zorder() > each.get_zorder() for each in axes.lines if each is not chosen)
