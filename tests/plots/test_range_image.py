from __future__ import annotations

import math

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gpuvision import Status
from gpuvision.plots import range_image as picture
from gpuvision.ranging.height_map import Grid, HeightMap

GRID = Grid(left=0.0, top=0.4, cell_x=0.002, cell_y=0.002, columns=250, rows=200)


@pytest.fixture
def heights(rng):
    z = 0.05 * np.sin(GRID.x * 20) * np.cos(GRID.y[:, None] * 15)
    status = np.zeros(GRID.shape, np.uint8)
    z[50:80, 20:90], status[50:80, 20:90] = np.nan, Status.NO_DATA
    status[100:110] = Status.NOT_INVERTIBLE
    return HeightMap(z, np.ones(GRID.shape), status)


@pytest.mark.parametrize(
    ("length", "bar"), [(1.0, 1.0), (0.99, 0.5), (0.51, 0.5), (0.2, 0.2), (0.0199, 0.01), (3.7e-6, 2e-6), (42.0, 20.0)]
)
def test_a_bar_has_a_round_length(length, bar):
    assert picture.round_length(length) == pytest.approx(bar, rel=1e-12)


@pytest.mark.parametrize(
    ("length", "name"), [(2e-6, "µm"), (1e-3, "mm"), (0.5, "mm"), (1.0, "m"), (20.0, "m"), (-0.2, "mm"), (0.0, "µm")]
)
def test_lengths_have_units_of_few_digits(length, name):
    assert picture.length_unit(length)[1] == name


@pytest.mark.parametrize(
    ("span", "text"), [(9.95, "0.00 to 9.95"), (10.05, "0.0 to 10.1"), (0.0, "0.00000000 to 0.00000000")]
)
def test_heights_are_stated_to_a_hundredth_of_their_range(span, text):
    """And to 1e-8 of the unit where they are equal."""
    z = np.array([[0.0, 0.5001], [1.0, np.nan]]) * span * 1e-3
    unit = "mm" if span else "µm"
    assert picture._subtitle(z, "2 × 2") == f"2 × 2  ·  75.0 % measured  ·  heights {text} {unit}"


def test_light_falls_from_the_upper_left():
    x, y = np.meshgrid(np.arange(20.0), np.arange(15.0))
    shades = {
        name: float(picture.shade_relief(z, 1.0, 1.0)[7, 10])
        for name, z in {"flat": 0 * x, "faces left": x, "faces right": -x, "faces up": y, "faces down": -y}.items()
    }
    assert shades["flat"] == pytest.approx(0.95)
    assert shades["faces left"] > 0.95 > shades["faces right"]
    assert shades["faces up"] > 0.95 > shades["faces down"]


@pytest.mark.parametrize(("gx", "gy"), [(0.5, 0.0), (0.3, -0.4), (-0.2, 0.6)])
def test_brightness_of_a_plane_is_that_of_a_matt_surface(gx, gy):
    """Cosine of the angle between the light and the normal, 0.95 on a flat surface."""
    x, y = np.meshgrid(2.0 * np.arange(20.0), -3.0 * np.arange(15.0))
    light, normal = np.array(picture._LIGHT), np.array([-gx, -gy, 1.0])
    cosine = light @ normal / np.linalg.norm(light) / np.linalg.norm(normal)
    flat = light[2] / np.linalg.norm(light)
    expected = picture._AMBIENT + (0.95 - picture._AMBIENT) * cosine / flat
    shade = picture.shade_relief(gx * x + gy * y, 2.0, 3.0)
    np.testing.assert_allclose(shade, expected, rtol=1e-9)
    assert light[0] < 0.0 < light[1]


def test_the_colour_scale_leaves_out_half_a_percent_at_each_end():
    z = np.append(np.random.default_rng(1).permutation(np.arange(1001.0)), [np.nan, np.inf]) * 1e-3
    assert picture.height_span(z) == pytest.approx((5e-3, 995e-3))
    assert picture.height_span(np.full(4, 2e-3)) == pytest.approx((2e-3 - 0.5e-6, 2e-3 + 0.5e-6), rel=1e-12)
    assert picture.height_span(z[-2:]) == (0.0, 1.0)


def test_relief_is_a_slope_not_a_number_of_cells():
    x = np.tile(np.arange(20.0), (15, 1))
    np.testing.assert_allclose(
        picture.shade_relief(x, 1.0, 1.0), picture.shade_relief(0.01 * x, 0.01, 0.01), rtol=1e-12
    )


@pytest.mark.parametrize(("slope", "times"), [(1.0, 1), (0.1, 2), (0.03, 10), (1e-3, 20), (0.0, 20)])
def test_gentle_slopes_are_exaggerated(slope, times):
    z = slope * 0.01 * np.tile(np.arange(20.0), (15, 1))
    z[3, 4:9] = np.nan
    z[10, 10] += 5.0  # an edge does not count as a slope
    assert picture.choose_exaggeration(z, 0.01, 0.01) == times


def test_exaggeration_is_of_the_heights():
    z = np.cos(np.arange(20.0) / 3) * np.ones((15, 1))
    np.testing.assert_allclose(
        picture.shade_relief(z, 1.0, 1.0, exaggeration=5.0), picture.shade_relief(5 * z, 1.0, 1.0), rtol=1e-12
    )


def test_relief_stops_at_holes():
    z = np.zeros((20, 20))
    z[5:9, 5:9] = np.nan
    shade = picture.shade_relief(z, 1.0, 1.0)
    np.testing.assert_array_equal(np.isnan(shade), np.isnan(z))
    np.testing.assert_allclose(shade[np.isfinite(z)], 0.95, rtol=1e-12)


def test_what_is_missing_has_a_colour_of_its_own():
    flags = [
        Status.NO_DATA,
        Status.NOT_INVERTIBLE,
        Status.OUT_OF_RANGE,
        Status.NOT_FINITE,
        Status.HORIZON,
        Status.LOW_SIGNAL,
    ]
    z = np.full((1, 7), np.nan)
    z[0, 6] = 0.5
    status = np.array([[*flags, 0]], np.uint8)
    for style in ("colour", "shaded"):
        made, legend = picture.paint_heights(z, status, np.where(np.isfinite(z), 0.95, np.nan), (0.0, 1.0), style)
        colours = {tuple(each) for each in made[0]}
        assert len(colours) == 7
        assert {to_rgb(each.colour) for each in legend} == {tuple(each) for each in made[0, :6]}
        assert all(each.part == pytest.approx(1 / 7) for each in legend)


def test_a_doubtful_height_is_tinted_and_a_saturated_one_is_not():
    z = np.full((1, 3), 0.5)
    status = np.array([[0, Status.NOT_INVERTIBLE, Status.SATURATED]], np.uint8)
    made, legend = picture.paint_heights(z, status, np.full_like(z, 0.95), (0.0, 1.0), "colour")
    assert [each.meaning[:6] for each in legend] == ["folded"]
    assert np.array_equal(made[0, 0], made[0, 2])
    assert np.linalg.norm(made[0, 1] - to_rgb(legend[0].colour)) < np.linalg.norm(made[0, 0] - to_rgb(legend[0].colour))
    assert not np.array_equal(made[0, 1], to_rgb(legend[0].colour))


def test_tinted_cells_are_in_the_legend(tmp_path, heights, monkeypatch):
    legends = []
    page = picture._Page
    monkeypatch.setattr(
        picture,
        "_Page",
        lambda shown, ratio, legend, *more: legends.append((shown, legend)) or page(shown, ratio, legend, *more),
    )
    for tints in (
        (),
        [(np.isfinite(heights.z), "#1f77b4", "one scan alone"), (np.zeros(GRID.shape, bool), "#d62728", "-")],
    ):
        picture.draw_height_map(tmp_path / "map.png", heights, GRID, style="shaded", tints=tints, overwrite=True)
    (plain, before), (tinted, after) = legends
    assert after == [*before, picture.LegendEntry("#1f77b4", "one scan alone", float(np.mean(np.isfinite(heights.z))))]
    known = np.isfinite(heights.z)
    assert np.array_equal(plain[~known], tinted[~known])
    assert np.all(
        np.linalg.norm(tinted[known] - to_rgb("#1f77b4"), axis=-1)
        < np.linalg.norm(plain[known] - to_rgb("#1f77b4"), axis=-1)
    )


@pytest.mark.parametrize("style", ["colour", "shaded"])
def test_the_length_bar_is_as_long_as_it_says(tmp_path, heights, style):
    path = tmp_path / "map.png"
    pages = []
    save = Figure.savefig
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            Figure, "savefig", lambda figure, *args, **how: pages.append(figure) or save(figure, *args, **how)
        )
        picture.draw_height_map(path, heights, GRID, style=style)
    assert len(pages[0].texts) == 5
    assert all(0.0 < each < 1.0 for text in pages[0].texts for each in text.get_position())
    image = cv2.imread(str(path))
    # The map, 0.5 m wide, is the longer side: 1100 pixels. A quarter of it is 0.125 m: the bar is 100 mm, 220 pixels.
    legend = 2
    middle = (0.12 + 0.21 * legend + 0.08 + 0.045) * 150
    strip = image[image.shape[0] - round(middle) - 5 : image.shape[0] - round(middle) + 5]
    inked = np.flatnonzero((strip < 128).all(axis=2).any(axis=0))
    bar = inked[: np.flatnonzero(np.diff(inked) > 60)[0] + 1] if np.any(np.diff(inked) > 60) else inked
    runs = np.split(bar, np.flatnonzero(np.diff(bar) > 1) + 1)
    # Quarters 1 and 3 are filled: 55 pixels each, and a line's width.
    filled = [len(run) for run in runs if len(run) > 20]
    assert len(filled) == 2
    assert all(abs(length - 55) <= 3 for length in filled)


def test_the_height_bar_stands_beside_the_map(tmp_path, heights):
    path = tmp_path / "map.png"
    picture.draw_height_map(path, heights, GRID)
    image = cv2.imread(str(path)).astype(int)
    # The map is 1100 pixels wide and begins 0.3 in from the left and 0.72 in from the top, at 150 pixels/in. The bar is
    # 0.16 in to its right, 0.16 in wide and 4.5 in high.
    bar = image[:, round((0.3 + 0.16 + 0.08) * 150) + 1100]
    coloured = np.flatnonzero(np.ptp(bar, axis=1) > 20)
    assert abs(coloured[0] - 0.72 * 150) <= 2
    assert abs(np.ptp(coloured) - 4.5 * 150) <= 4
    # It has the colours of the highest and the lowest cell.
    row, column = np.divmod([np.nanargmax(heights.z), np.nanargmin(heights.z)], GRID.columns)
    cells = image[(108 + (row + 0.5) * 4.4).astype(int), (45 + (column + 0.5) * 4.4).astype(int)]
    ends = bar[[coloured[0] + 4, coloured[-1] - 4]]
    assert np.abs(cells - ends).max() < np.abs(cells - ends[::-1]).max()


def test_a_picture_shows_the_cells(tmp_path, heights):
    path = tmp_path / "map.png"
    picture.draw_height_map(path, heights, GRID)
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    hole = np.round(255 * np.array(to_rgb("#cbd5e1"))).astype(np.uint8)
    part = np.all(image == hole, axis=2)
    # 30 x 70 cells of 4.4 x 4.4 pixels, and a swatch of the legend.
    assert part.sum() == pytest.approx(30 * 70 * 4.4**2, rel=0.03)


def test_a_scan_is_drawn_as_it_came(tmp_path):
    z = np.linspace(0, 1, 30)[:, None] * np.ones(80)
    status = np.zeros(z.shape, np.uint8)
    for samples in ("down", "across"):
        picture.draw_scan(tmp_path / f"{samples}.png", z, status, samples=samples, aspect=0.5)
    down, across = (cv2.imread(str(tmp_path / f"{each}.png")).astype(float) for each in ("down", "across"))
    rows, columns = (slice(200, 1000), slice(250, 600))
    # Heights increase with the profile number: across the picture if samples run down, down if samples run across.
    assert np.ptp(down[rows, columns], axis=0).max() == 0
    assert np.ptp(down[rows, columns], axis=1).max() > 50
    assert np.ptp(across[rows, columns], axis=1).max() == 0


@pytest.mark.parametrize("fill", [0.0, np.nan, 1e-9, -3.0])
@pytest.mark.parametrize("style", ["colour", "shaded"])
def test_flat_and_empty_maps_are_drawn(tmp_path, fill, style):
    z = np.full(GRID.shape, fill)
    status = np.where(np.isnan(z), Status.NO_DATA, 0).astype(np.uint8)
    picture.draw_height_map(tmp_path / "map.png", HeightMap(z, z, status), GRID, style=style)
    assert cv2.imread(str(tmp_path / "map.png")) is not None


def test_a_failure_leaves_nothing(tmp_path, heights, monkeypatch):
    def stuck(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", stuck)
    with pytest.raises(OSError, match="No space left"):
        picture.draw_height_map(tmp_path / "map.png", heights, GRID)
    assert list(tmp_path.iterdir()) == []


def test_wrong_maps_are_refused(tmp_path, heights):
    with pytest.raises(ValueError, match="style is 'grey', expected one of colour, shaded"):
        picture.draw_height_map(tmp_path / "a.png", heights, GRID, style="grey")
    with pytest.raises(ValueError, match=r"the grid has \(200, 250\)"):
        picture.draw_height_map(tmp_path / "a.png", HeightMap(*(each.T for each in heights[:3])), GRID)


def test_numbers_have_the_digits_of_their_step():
    assert picture._format_length(0.12345, 1e-3, 1e-4) == "123.5"
    assert picture._format_length(-0.5, 1.0, 0.01) == "\N{MINUS SIGN}0.50"
    assert picture._format_length(-1e-9, 1.0, 0.01) == "0.00"
    assert math.isclose(picture.round_length(1e-3), 1e-3)


# ---- brightness and colours by their formulas ------------------------------------------------------------------------


@pytest.mark.parametrize(("slope", "shown"), [(9.0, 4.0), (-9.0, -4.0), (3.9, 3.9)])
def test_slopes_beyond_four_are_as_bright_as_four(slope, shown):
    """Before the smoothing; what the lamp does not reach has the ambient light alone."""
    x = np.tile(np.arange(20.0), (15, 1))
    light, normal = np.array(picture._LIGHT), np.array([-shown, 0.0, 1.0])
    lit = max(float(light @ normal / light[2] / np.linalg.norm(normal)), 0.0)
    assert (lit == 0.0) == (slope < 0.0)
    np.testing.assert_allclose(picture.shade_relief(slope * x, 1.0, 1.0), 0.3 + 0.65 * lit, rtol=1e-12)


def test_a_hole_does_not_change_the_brightness_of_its_surroundings():
    x, y = np.meshgrid(np.arange(24.0), np.arange(17.0))
    z = 0.3 * x - 0.2 * y
    whole = picture.shade_relief(z, 1.0, 1.0)
    z[5:9, 7:12] = np.nan
    shade = picture.shade_relief(z, 1.0, 1.0)
    known = np.isfinite(z)
    np.testing.assert_allclose(shade[known], whole[known], rtol=1e-12)
    assert np.isnan(shade[~known]).all()


def test_slopes_are_means_over_the_known_neighbours():
    z = np.array([[0.0, 1.0, 4.0, np.nan, 7.0, 9.0, np.nan], [5.0, 5.0, 5.0, np.nan, np.nan, np.nan, 1.0]])
    across = [[1.0, 2.0, 3.0, 0.0, 2.0, 2.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]]
    down = [[5.0, 4.0, 1.0, 0.0, 0.0, 0.0, 0.0]] * 2
    np.testing.assert_array_equal(picture._slope(z, 1), across)
    np.testing.assert_array_equal(picture._slope(z, 0), down)


def test_colours_of_doubtful_and_unexplained_cells():
    """A cell with several flags has the colour of the rarer one; a tint weighs 0.45; shade multiplies the colour."""
    hole, folded = (np.array(to_rgb(each)) for each in ("#cbd5e1", "#e0218a"))
    dark, ambiguous = (np.array(to_rgb(each)) for each in ("#4b5563", "#b07aa1"))
    missing, both = Status.NO_DATA | Status.LOW_SIGNAL, Status.NOT_INVERTIBLE | Status.AMBIGUOUS
    status = np.array([[missing, 0, both, both, Status.LOW_SIGNAL, Status.AMBIGUOUS, Status.LOW_SIGNAL, 0]], np.uint8)
    z = np.array([[np.nan, np.nan, np.nan, 0.5, np.nan, 0.5, 0.5, 0.5]])
    shade = np.array([[np.nan] * 3 + [0.8, np.nan, 0.4, 0.6, np.nan]])
    made, legend = picture.paint_heights(z, status, shade, (0.0, 1.0), "shaded")
    grey = 0.78 / 0.95
    expected = [hole, hole, folded, 0.55 * 0.8 * grey + 0.45 * folded, dark, 0.55 * 0.4 * grey + 0.45 * ambiguous]
    np.testing.assert_allclose(made[0], [*expected, np.full(3, 0.6 * grey), np.full(3, grey)], rtol=1e-12)
    assert [(each.colour, each.part) for each in legend] == [
        ("#cbd5e1", 1 / 8),  # the cell without a flag is not counted
        ("#e0218a", 2 / 8),
        ("#b07aa1", 1 / 8),
        ("#4b5563", 1 / 8),
    ]


def test_heights_have_the_colours_of_the_scale():
    z = np.array([[-1.0, 2.0, 3.0, 4.0, 9.0]])
    made, _ = picture.paint_heights(z, np.zeros(z.shape, np.uint8), np.full(z.shape, 0.9), (2.0, 4.0), "colour")
    viridis = mpl.colormaps["viridis"]
    ends = [np.array(viridis(each)[:3]) for each in (0.14, 1.0)]
    np.testing.assert_allclose(made[0, [0, 1]], [0.9 * ends[0]] * 2, rtol=1e-12)
    np.testing.assert_allclose(made[0, [3, 4]], [0.9 * ends[1]] * 2, rtol=1e-12)
    np.testing.assert_allclose(made[0, 2], 0.9 * np.array(viridis(0.57)[:3]), atol=0.01)


# ---- layout of the page ----------------------------------------------------------------------------------------------

ENTRIES = [picture.LegendEntry("#cbd5e1", "hole", 0.25), picture.LegendEntry("#e0218a", "folded", 0.0004)]


def inches(axes, page):
    """Return left, bottom, width and height of axes [in]."""
    return [value * size for value, size in zip(axes.get_position().bounds, (*page.page, *page.page), strict=True)]


@pytest.mark.parametrize("aspect", [2.0, 0.5])
@pytest.mark.parametrize("labels", [None, ("sample", "profile")])
@pytest.mark.parametrize("span", [None, (-2e-3, 5e-4)])
def test_places_on_the_page(aspect, labels, span):
    """The longer side has 1100 pixels at 150 per inch; below lie the legend and the length bar, or the labels."""
    page = picture._Page(np.zeros((10, 20, 3)), aspect, ENTRIES, "title", "subtitle", span, labels=labels)
    longer = 1100 / 150
    width, height = (longer, longer / 2) if aspect == 2.0 else (longer / 2, longer)
    left, below = (0.8 if labels else 0.3), 0.12 + 2 * 0.21
    bottom = below + (0.5 if labels else 0.45)
    across = max(left + width + (1.2 if span else 0.3), 5.6)
    assert page.page == pytest.approx((across, bottom + height + 0.72))
    assert tuple(page.figure.get_size_inches()) == pytest.approx(page.page)
    shown, *bars = page.figure.axes
    assert inches(shown, page) == pytest.approx([left, bottom, width, height])
    assert (shown.get_xlabel(), shown.get_ylabel()) == (labels or ("", ""))
    assert (len(shown.get_xticks()) > 0, len(shown.get_yticks()) > 0) == (bool(labels),) * 2
    assert shown.images[0].get_interpolation() == "nearest"
    title, subtitle, *legend = page.figure.texts
    places = [(left, page.page[1] - 0.33), (left, page.page[1] - 0.57)]
    places += [(left + 0.28, below - 0.21 * line + 0.015) for line in (1, 2)]
    found = [np.multiply(text.get_position(), page.page) for text in page.figure.texts]
    np.testing.assert_allclose(found, places)
    assert [text.get_text() for text in (title, subtitle)] == ["title", "subtitle"]
    assert [text.get_text() for text in legend] == ["hole  (25.0 %)", "folded  (< 0.1 %)"]
    swatches = [each for each in page.figure.artists if isinstance(each, Rectangle)]
    for line, (swatch, entry) in enumerate(zip(swatches, ENTRIES, strict=True), 1):
        place = np.multiply((*swatch.get_xy(), swatch.get_width(), swatch.get_height()), (*page.page, *page.page))
        assert place == pytest.approx([left, below - 0.21 * line, 0.2, 0.12])
        assert swatch.get_facecolor()[:3] == to_rgb(entry.colour)
    assert len(bars) == (span is not None)
    if span:
        room = min(height, 4.5)
        assert inches(bars[0], page) == pytest.approx([left + width + 0.16, bottom + height - room, 0.16, room])
        assert bars[0].get_ylabel() == "height z  [mm]"
        assert bars[0].get_ylim() == pytest.approx((-2.0, 0.5))
        ticks = bars[0].get_yticks()
        assert 4 <= len(ticks) <= 9
        np.testing.assert_allclose(np.diff(ticks), 0.5)


def test_only_maps_beyond_the_pixels_of_the_page_are_smoothed():
    """1100 x 550 pixels: where cells are enlarged along one side, they keep sharp edges."""
    for shape, expected in (
        ((550, 1100), "antialiased"),
        ((549, 1100), "nearest"),
        ((550, 1099), "nearest"),
        ((600, 1200), "antialiased"),
    ):
        page = picture._Page(np.zeros((*shape, 3)), 2.0, [], "", "", None)
        assert page.figure.axes[0].images[0].get_interpolation() == expected


@pytest.mark.parametrize(
    ("width", "length", "text"), [(0.5, 0.1, "100 mm"), (41e-6, 10e-6, "10 µm"), (9.0, 2.0, "2 m")]
)
def test_the_length_bar_is_a_round_part_of_the_width(width, length, text):
    """Four fields of alternating colours, as long together as the text says, beside it."""
    page = picture._Page(np.zeros((10, 20, 3)), 2.0, ENTRIES, "", "", None)
    page.length_bar(width)
    bar = page.figure.axes[-1]
    drawn_length = 1100 / 150 * length / width
    assert inches(bar, page) == pytest.approx([0.3, 0.54 + 0.08, drawn_length, 0.09])
    assert [*bar.get_xlim(), *bar.get_ylim()] == [0.0, 4.0, 0.0, 1.0]
    fields = [(each.get_x(), each.get_y(), each.get_width(), each.get_height()) for each in bar.patches]
    assert fields == [(k, 0, 1, 1) for k in range(4)]
    colours = [each.get_facecolor()[:3] for each in bar.patches]
    assert colours == [to_rgb("#22262b"), to_rgb("#ffffff")] * 2
    label = page.figure.texts[-1]
    assert label.get_text() == text
    place = np.multiply(label.get_position(), page.page)
    np.testing.assert_allclose(place, [0.3 + drawn_length + 0.1, 0.54 + 0.085])


def test_texts_of_a_map_and_a_scan(tmp_path, monkeypatch):
    """Size, part with a height, range of the heights, and the exaggeration of the relief where it is above 1."""
    pages = []
    page = picture._Page
    monkeypatch.setattr(picture, "_Page", lambda *given, **how: pages.append((given, how)) or page(*given, **how))
    monkeypatch.setattr(Figure, "savefig", lambda *_, **__: None)
    grid = Grid(left=0.0, top=0.0, cell_x=2e-3, cell_y=5e-4, columns=6, rows=4)
    steep = np.tile(2e-3 * np.arange(6.0), (4, 1))
    steep[0, 0] = np.nan
    for number, z in enumerate((steep, 0.1 * steep)):
        for style in ("colour", "shaded"):
            heights = HeightMap(z, np.ones(z.shape), np.zeros(z.shape, np.uint8))
            picture.draw_height_map(tmp_path / f"{number}{style}.png", heights, grid, style=style, title="a map")
    size = "6 × 4 cells of 2 mm × 500 µm  ·  95.8 % measured  ·  heights "
    subtitles = [f"{size}0.0 to 10.0 mm"] * 2 + [f"{size}0.00 to 1.00 mm  ·  relief 2 ×"] * 2
    assert [given[4] for given, _ in pages] == subtitles
    assert [given[3] for given, _ in pages] == ["a map"] * 4
    assert [given[1] for given, _ in pages] == [pytest.approx(6.0)] * 4  # 12 mm by 2 mm
    spans = [given[5] for given, _ in pages]
    assert spans[1] is spans[3] is None
    assert spans[0] == pytest.approx(picture.height_span(steep))
    pages.clear()
    for samples in ("across", "down"):
        picture.draw_scan(
            tmp_path / f"{samples}.png", steep, np.zeros(steep.shape, np.uint8), samples=samples, aspect=3.0,
            title="a scan", span=(0.0, 1.0),
        )  # fmt: skip
    for (given, how), shape, labels in zip(
        pages, ((4, 6, 3), (6, 4, 3)), (("sample", "profile"), ("profile", "sample")), strict=True
    ):
        assert given[0].shape == shape
        text = "4 profiles of 6 samples  ·  " + subtitles[0].partition("  ·  ")[2]
        assert given[1:] == (3.0, [], "a scan", text, (0.0, 1.0))
        assert how == {"labels": labels}
