"""Pictures of range images to look at: heights in colours or as a lit relief, with their scales and what is missing.

A cell without a height is never painted as if it had one: each reason has a colour of its own, and a legend says which
and how many.
"""

from __future__ import annotations

import math
import os
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import matplotlib.ticker
import numpy as np
import numpy.typing as npt
import scipy.ndimage
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import ColorbarBase
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from gpuvision.host.files import replacing
from gpuvision.ranging.regrid import Grid, HeightMap
from gpuvision.status import Status

Style = Literal["colour", "shaded"]
Array = npt.NDArray[Any]

_STYLES = ("colour", "shaded")
# Without its darkest end, on which no shade shows.
_COLOURS = ListedColormap(mpl.colormaps["viridis"](np.linspace(0.14, 1.0, 256)))
_DPI = 150
_PICTURE_PX = 1100  # the map's longer side
_INK, _PAPER, _FAINT = "#22262b", "#ffffff", "#6b7280"
# Light from the upper left, 50 degrees above the plane, and some from everywhere.
_LIGHT = np.array([-0.455, 0.455, 0.766])
_AMBIENT, _FLAT, _STEEPEST, _USUAL_SLOPE = 0.3, 0.95, 4.0, 0.33
_GREY = 0.78  # of a flat surface in the grey relief
# Of several reasons the first one is shown: the rarer and graver before the common.
_REASONS = (
    (Status.NO_DATA, "#cbd5e1", "hole: no measurement near enough"),
    (Status.NOT_INVERTIBLE, "#e0218a", "folded: two surfaces share the place"),
    (Status.OUT_OF_RANGE, "#f28c28", "out of range"),
    (Status.NOT_FINITE, "#d62728", "not finite"),
    (Status.HORIZON, "#17becf", "horizon: the ray misses the sheet"),
    (Status.AMBIGUOUS, "#b07aa1", "ambiguous: more than one peak"),
    (Status.SATURATED, "#bcbd22", "saturated"),
    (Status.LOW_SIGNAL, "#4b5563", "dark: no light that counts"),
)
# These come with a height, which is shown under a tint; a saturated line is as good as another one.
_TINTED = Status.NOT_INVERTIBLE | Status.AMBIGUOUS
_TINT = 0.45
_LENGTHS = ((1e-6, "µm"), (1e-3, "mm"), (1.0, "m"), (1e3, "km"))


class Entry(NamedTuple):
    """A line of the legend: what the colour means, and how much of the picture has it."""

    colour: str
    meaning: str
    part: float


def length_unit(length: float) -> tuple[float, str]:
    """Return the unit (in metres, and its name) in which a length is a number of one to three digits."""
    fitting = [each for each in _LENGTHS if abs(length) >= 0.9995 * each[0]]
    return fitting[-1] if fitting else _LENGTHS[0]


def round_length(length: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above the length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(each * power for each in (1.0, 2.0, 5.0) if each * power <= length * (1 + 1e-9))


def steepness(z: Array, cell_x: float, cell_y: float) -> float:
    """Return by how much slopes have to be exaggerated for a relief to show them: 1, 2, 5, 10 or 20.

    Nine tenths of the slopes then stay below a third, whatever the edges do.
    """
    slopes = np.hypot(_slope(z, 1) / cell_x, _slope(z, 0) / cell_y)[np.isfinite(z)]
    usual = float(np.percentile(slopes, 90)) if slopes.size else 0.0
    return round_length(min(max(_USUAL_SLOPE / max(usual, 1e-9), 1.0), 20.0))


def relief(z: Array, cell_x: float, cell_y: float, *, exaggeration: float = 1.0, blur: float = 1.5) -> Array:
    """Light that a matt surface throws back, lit from the upper left; 0.95 where it is flat.

    Parameters
    ----------
    z
        Heights [m], rows downwards; NaN in holes.
    cell_x, cell_y
        Distance between cells [m].
    exaggeration
        Of the heights.
    blur
        Standard deviation of the smoothing of slopes, in cells: a relief shows noise first.

    Returns
    -------
    numpy.ndarray
        As `z`; NaN in holes.
    """
    known = np.isfinite(z)
    steep = exaggeration * _slope(z, 1) / cell_x, exaggeration * _slope(z, 0) / cell_y
    slopes = [-_blurred(steep[0], known, blur), _blurred(steep[1], known, blur)]
    normal = np.stack([*slopes, np.ones(z.shape)])
    # What lies flat is nearly white, so that slopes darken and lighten the heights' colours but keep them.
    lit = np.tensordot(_LIGHT / _LIGHT[2], normal, 1) / np.linalg.norm(normal, axis=0)
    shade: Array = np.where(known, _AMBIENT + (_FLAT - _AMBIENT) * np.clip(lit, 0.0, None), np.nan)
    return shade


def _blurred(slope: Array, known: npt.NDArray[np.bool_], blur: float) -> Array:
    """Smooth slopes where heights are known; a cliff weighs no more than the steepest slope that light can tell."""
    weight = scipy.ndimage.gaussian_filter(known.astype(np.float64), blur, mode="nearest")
    cliffs = np.where(known, np.clip(slope, -_STEEPEST, _STEEPEST), 0.0)
    smooth: Array = scipy.ndimage.gaussian_filter(cliffs, blur, mode="nearest") / np.where(known, weight, 1.0)
    return smooth


def _slope(z: Array, axis: int) -> Array:
    """Mean of the differences to the neighbours that are there; 0 where none is."""
    ahead = np.diff(z, axis=axis, append=np.nan)
    behind = np.diff(z, axis=axis, prepend=np.nan)
    both = np.stack([ahead, behind])
    count = np.isfinite(both).sum(axis=0)
    slope: Array = np.where(np.isfinite(both), both, 0.0).sum(axis=0) / np.maximum(count, 1)
    return slope


def paint(z: Array, status: Array, shade: Array, span: tuple[float, float], style: Style) -> tuple[Array, list[Entry]]:
    """Colours (rows, columns, 3) of heights under light, and the legend of what is missing or doubtful."""
    light = np.where(np.isfinite(shade), shade, 1.0)[..., None]
    grey = np.full((*z.shape, 3), _GREY / _FLAT)
    heights = _COLOURS(Normalize(*span, clip=True)(np.nan_to_num(z)))[..., :3] if style == "colour" else grey
    picture = light * heights
    legend = []
    missing, left = ~np.isfinite(z), np.ones(z.shape, bool)
    for flag, colour, meaning in _REASONS:
        flagged = left & ((status & flag) != 0)
        bare, tinted = flagged & missing, flagged & ~missing & bool(flag & _TINTED)
        picture[bare] = to_rgb(colour)
        picture[tinted] = (1 - _TINT) * picture[tinted] + _TINT * np.array(to_rgb(colour))
        left &= ~(bare | tinted)
        if np.any(bare | tinted):
            legend.append(Entry(colour, meaning, float(np.mean(bare | tinted))))
    unexplained = left & missing
    picture[unexplained] = to_rgb(_REASONS[0][1])
    return np.clip(picture, 0.0, 1.0), legend


def draw_height_map(
    path: str | os.PathLike[str],
    heights: HeightMap,
    grid: Grid,
    *,
    style: Style = "colour",
    title: str = "Height map",
    span: tuple[float, float] | None = None,
) -> None:
    """Draw a height map as PNG: with a length bar, a height bar, and a legend of what is missing. Written atomically.

    Parameters
    ----------
    path
        Where to.
    heights, grid
        What `Regrid` gives, as NumPy arrays, and where its cells lie.
    style
        ``"colour"``: heights in colours under light. ``"shaded"``: a grey relief under light.
    title
        Over the picture.
    span
        Heights of the ends of the colour scale [m]; None leaves half a percent of the heights outside on either side.

    Raises
    ------
    ValueError
        The heights are not of the grid's shape, or the style is another one.
    """
    if style not in _STYLES:
        raise ValueError(f"style is {style!r}, expected one of {', '.join(_STYLES)}")
    z, status = np.asarray(heights.z, np.float64), np.asarray(heights.status)
    if z.shape != grid.shape:
        raise ValueError(f"heights have shape {z.shape}, the grid has {grid.shape}; expected the same")
    span = _span_of(z) if span is None else span
    steeper = steepness(z, grid.cell_x, grid.cell_y)
    shade = relief(z, grid.cell_x, grid.cell_y, exaggeration=steeper)
    picture, legend = paint(z, status, shade, span, style)
    told = _told(z, _cells(grid)) + (f"  ·  relief {steeper:.0f} ×" if steeper > 1 else "")
    width, height = grid.columns * grid.cell_x, grid.rows * grid.cell_y
    sheet = _Sheet(picture, width / height, legend, title, told, span if style == "colour" else None)
    sheet.length_bar(width)
    sheet.write(path)


def draw_scan(
    path: str | os.PathLike[str],
    z: Any,
    status: Any,
    *,
    samples: Literal["down", "across"] = "across",
    aspect: float = 1.0,
    title: str = "Range image as scanned",
    span: tuple[float, float] | None = None,
) -> None:
    """Draw an organised range image as the sensor saw it, profile beside profile, as PNG. Written atomically.

    Nothing is resampled, so that there are no lengths to show but the height.

    Parameters
    ----------
    path
        Where to.
    z, status
        (profiles, samples), of `RangePoints`, as NumPy arrays.
    samples
        Whether the samples of a profile run down the picture or across it.
    aspect
        Width of the picture over its height.
    title, span
        As for `draw_height_map`.
    """
    z, status = np.asarray(z, np.float64), np.asarray(status)
    span = _span_of(z) if span is None else span
    picture, legend = paint(z, status, np.where(np.isfinite(z), 1.0, np.nan), span, "colour")
    told = _told(z, f"{z.shape[0]} profiles of {z.shape[1]} samples")
    labels = ("sample", "profile")
    if samples == "down":
        picture, labels = picture.transpose(1, 0, 2), ("profile", "sample")
    _Sheet(picture, aspect, legend, title, told, span, labels=labels).write(path)


def _span_of(z: Array) -> tuple[float, float]:
    known = z[np.isfinite(z)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(each) for each in np.percentile(known, (0.5, 99.5)))
    return (low, high) if high > low else (low - 0.5e-6, high + 0.5e-6)


def _number(value: float, unit: float, step: float) -> str:
    """Write a length in a unit, to the digits that a step needs."""
    digits = max(0, math.ceil(-math.log10(step / unit) - 1e-9))
    text = f"{value / unit:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) != 0.0 else text.lstrip("-")


def _cells(grid: Grid) -> str:
    sizes = []
    for cell in dict.fromkeys((grid.cell_x, grid.cell_y)):
        unit, name = length_unit(cell)
        sizes.append(f"{cell / unit:.3g} {name}")
    return f"{grid.columns} × {grid.rows} cells of {' × '.join(sizes)}"


def _told(z: Array, what: str) -> str:
    known = z[np.isfinite(z)]
    told = f"{what}  ·  {100 * known.size / z.size:.1f} % measured"
    if known.size:
        low, high = float(known.min()), float(known.max())
        unit, name = length_unit(max(abs(low), abs(high), 1e-6))
        step = max(high - low, 1e-6 * unit) / 100
        told += f"  ·  heights {_number(low, unit, step)} to {_number(high, unit, step)} {name}"
    return told


class _Sheet:
    """A page with the picture, its title and legend, and room for bars; lengths on it are in inches."""

    _LEFT, _RIGHT, _TOP, _BOTTOM, _LINE, _LEAST_WIDTH = 0.3, 0.3, 0.72, 0.12, 0.21, 5.6
    _HEIGHT_BAR, _LENGTH_BAR, _AXES, _LABELS = 0.9, 0.45, 0.5, 0.5

    def __init__(
        self,
        picture: Array,
        aspect: float,
        legend: list[Entry],
        title: str,
        told: str,
        span: tuple[float, float] | None,
        *,
        labels: tuple[str, str] | None = None,
    ) -> None:
        longer = _PICTURE_PX / _DPI
        self.width, self.height = (longer, longer / aspect) if aspect >= 1 else (longer * aspect, longer)
        self.left = self._LEFT + (self._AXES if labels else 0.0)
        right = self._RIGHT + (self._HEIGHT_BAR if span else 0.0)
        # A title needs its room, however narrow the picture.
        page_width = max(self.left + self.width + right, self._LEAST_WIDTH)
        self.below = self._BOTTOM + self._LINE * len(legend)
        self.bottom = self.below + (self._LABELS if labels else self._LENGTH_BAR)
        self.page = (page_width, self.bottom + self.height + self._TOP)
        self.figure = Figure(figsize=self.page, dpi=_DPI, facecolor=_PAPER)
        FigureCanvasAgg(self.figure)
        axes = self.axes(self.left, self.bottom, self.width, self.height)
        # Where cells are larger than pixels they stay cells: between a colour and its neighbour nothing was measured.
        enlarged = picture.shape[0] < self.height * _DPI or picture.shape[1] < self.width * _DPI
        axes.imshow(picture, aspect="auto", interpolation="nearest" if enlarged else "antialiased")
        self._frame(axes, labels)
        self._say(title, told)
        self._legend(legend)
        if span:
            self._height_bar(span)

    def axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        """Axes at a place on the page."""
        across, up = self.page
        return self.figure.add_axes((left / across, bottom / up, width / across, height / up))

    def _frame(self, axes: Axes, labels: tuple[str, str] | None) -> None:
        for spine in axes.spines.values():
            spine.set(color=_FAINT, linewidth=0.6)
        if labels is None:
            axes.set(xticks=[], yticks=[])
            return
        axes.tick_params(colors=_FAINT, labelsize=7, width=0.6, length=2.5)
        axes.set_xlabel(labels[0], fontsize=8, color=_INK)
        axes.set_ylabel(labels[1], fontsize=8, color=_INK)

    def _say(self, title: str, told: str) -> None:
        across, up = self.page
        x = self.left / across
        self.figure.text(x, 1 - 0.33 / up, title, fontsize=12, fontweight="bold", color=_INK)
        self.figure.text(x, 1 - 0.57 / up, told, fontsize=7.5, color=_FAINT)

    def _legend(self, legend: list[Entry]) -> None:
        across, up = self.page
        for line, entry in enumerate(legend):
            y = self.below - self._LINE * (line + 1)
            swatch = (self.left / across, y / up)
            self.figure.add_artist(
                Rectangle(swatch, 0.2 / across, 0.12 / up, facecolor=entry.colour, edgecolor=_FAINT, linewidth=0.4)
            )
            part = f"{100 * entry.part:.1f}" if entry.part >= 0.0005 else "< 0.1"
            text = f"{entry.meaning}  ({part} %)"
            self.figure.text((self.left + 0.28) / across, (y + 0.015) / up, text, fontsize=7.5, color=_INK)

    def length_bar(self, width: float) -> None:
        """Draw a bar of a round length under the picture, which is `width` metres wide."""
        length = round_length(width / 4)
        unit, name = length_unit(length)
        inches = self.width * length / width
        axes = self.axes(self.left, self.below + 0.08, inches, 0.09)
        axes.set_axis_off()
        axes.set(xlim=(0, 4), ylim=(0, 1))
        # Four fields, as on a map: quarters can be read off.
        for field in range(4):
            colour = _INK if field % 2 == 0 else _PAPER
            axes.add_patch(Rectangle((field, 0), 1, 1, facecolor=colour, edgecolor=_INK, linewidth=0.7, clip_on=False))
        across, up = self.page
        place = ((self.left + inches + 0.1) / across, (self.below + 0.085) / up)
        self.figure.text(*place, f"{length / unit:.0f} {name}", fontsize=9, fontweight="bold", color=_INK)

    def _height_bar(self, span: tuple[float, float]) -> None:
        unit, name = length_unit(max(abs(span[0]), abs(span[1])))
        room = min(self.height, 4.5)
        axes = self.axes(self.left + self.width + 0.16, self.bottom + self.height - room, 0.16, room)
        bar = ColorbarBase(axes, cmap=_COLOURS, norm=Normalize(span[0] / unit, span[1] / unit))
        bar.locator = matplotlib.ticker.MaxNLocator(nbins=8, steps=[1, 2, 5, 10])
        bar.update_ticks()
        bar.outline.set(linewidth=0.6, edgecolor=_FAINT)
        axes.tick_params(labelsize=8, colors=_INK, width=0.6, length=2.5)
        axes.set_ylabel(f"height z  [{name}]", fontsize=9, color=_INK, labelpad=6)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the page as PNG."""
        with replacing(path) as file:
            self.figure.savefig(file, format="png", dpi=_DPI, facecolor=_PAPER)
