"""Pictures of range images: heights in colours or as shaded relief, with scale bars and a legend of missing heights.

A cell without a height gets the colour of its status flag. The legend gives the meaning of each colour and the fraction
of the cells that have it.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import matplotlib.ticker
import numpy as np
import numpy.typing as npt
import scipy.ndimage
from matplotlib.axes import Axes
from matplotlib.colorbar import ColorbarBase
from matplotlib.colors import ListedColormap, Normalize, to_rgb
from matplotlib.patches import Rectangle

from gpuvision.host import to_numpy
from gpuvision.plots.figure import DPI, new_figure, write_png
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.status import Status

Style = Literal["colour", "shaded"]
Array = npt.NDArray[Any]

_STYLES = ("colour", "shaded")
# Viridis without its darkest 14 %, where the shading is not visible.
_COLOURS = ListedColormap(mpl.colormaps["viridis"](np.linspace(0.14, 1.0, 256)))
_PICTURE_PX = 1100  # longer side of the map
_INK, _PAPER, _FAINT = "#22262b", "#ffffff", "#6b7280"
# Unit vector (right, up, out of the picture) towards the lamp: from the upper left, 50 degrees above the plane.
_LIGHT = np.array([-0.455, 0.455, 0.766])
# Brightness, 0 to 1: ambient light alone, and a flat surface under all light.
_AMBIENT, _FLAT = 0.3, 0.95
_MAX_SLOPE = 4.0  # steeper slopes are clipped before smoothing, so that a cliff does not darken its surroundings
_SHOWN_SLOPE = 0.33  # slope after exaggeration, chosen by eye: 90 % of the slopes stay below it
_GREY = 0.78  # brightness of a flat surface in the grey relief
# Status flag, colour, text. A cell with several flags gets the first: rare and severe flags precede common flags.
_REASONS = (
    (Status.NO_DATA, "#cbd5e1", "hole: no measurement within the gap limit"),
    (Status.NOT_INVERTIBLE, "#e0218a", "folded: two surfaces share a cell"),
    (Status.OUT_OF_RANGE, "#f28c28", "out of range"),
    (Status.NOT_FINITE, "#d62728", "not finite"),
    (Status.HORIZON, "#17becf", "horizon: the ray misses the sheet of light"),
    (Status.AMBIGUOUS, "#b07aa1", "ambiguous: more than one peak"),
    (Status.SATURATED, "#bcbd22", "saturated"),
    (Status.LOW_SIGNAL, "#4b5563", "low signal: below the threshold"),
)
# Cells with these flags may have a height, which is shown with a tint. SATURATED has no tint: its heights are valid.
_TINTED = Status.NOT_INVERTIBLE | Status.AMBIGUOUS
_TINT = 0.45  # weight of the tint
_LENGTHS = ((1e-6, "µm"), (1e-3, "mm"), (1.0, "m"), (1e3, "km"))


class LegendEntry(NamedTuple):
    """Line of the legend.

    Attributes
    ----------
    colour : str
        Colour, ``#rrggbb``.
    meaning : str
        Reason why the height is missing or doubtful.
    part : float
        Fraction of the cells with this colour, 0 to 1.
    """

    colour: str
    meaning: str
    part: float


def length_unit(length: float) -> tuple[float, str]:
    """Return the unit (its length [m] and its name) in which a length [m] has one to three digits before the point."""
    # A length within half of the last of three digits below a unit is rounded up to the unit.
    fitting = [each for each in _LENGTHS if abs(length) >= 0.9995 * each[0]]
    return fitting[-1] if fitting else _LENGTHS[0]


def round_length(length: float) -> float:
    """Return the largest number of the form 1, 2 or 5 times a power of ten that does not exceed the length."""
    power = 10.0 ** math.floor(math.log10(length))
    return max(each * power for each in (1.0, 2.0, 5.0) if each * power <= length * (1 + 1e-9))


def choose_exaggeration(z: Array, cell_x: float, cell_y: float) -> float:
    """Return the exaggeration of the heights that makes slopes visible in a relief: 1, 2, 5, 10 or 20.

    90 % of the exaggerated slopes are below 0.33; the percentile ignores the steep edges.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns); NaN in holes.
    cell_x, cell_y : float
        Distance between cells [m].
    """
    slopes = np.hypot(_slope(z, 1) / cell_x, _slope(z, 0) / cell_y)[np.isfinite(z)]
    percentile = float(np.percentile(slopes, 90)) if slopes.size else 0.0
    # 1e-9 avoids a division by 0 on a plane; the result is clipped to 20 anyway.
    return round_length(min(max(_SHOWN_SLOPE / max(percentile, 1e-9), 1.0), 20.0))


def shade_relief(z: Array, cell_x: float, cell_y: float, *, exaggeration: float = 1.0, blur: float = 1.5) -> Array:
    """Compute the brightness of a matt (Lambertian) surface that is lit from the upper left.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns), rows downwards; NaN in holes.
    cell_x, cell_y : float
        Distance between cells [m].
    exaggeration : float
        Factor on the heights. Default 1.
    blur : float
        Standard deviation of the Gaussian smoothing of the slopes [cells], which suppresses noise. Default 1.5.

    Returns
    -------
    numpy.ndarray
        Brightness, (rows, columns): 0.95 where the surface is flat; NaN in holes.
    """
    known = np.isfinite(z)
    slope_x, slope_y = exaggeration * _slope(z, 1) / cell_x, exaggeration * _slope(z, 0) / cell_y
    slopes = [-_smooth_slopes(slope_x, known, blur), _smooth_slopes(slope_y, known, blur)]
    normal = np.stack([*slopes, np.ones(z.shape)])
    # Normalised to 1 on flat surfaces, so that the shading keeps the hue of the height colours.
    lit = np.tensordot(_LIGHT / _LIGHT[2], normal, 1) / np.linalg.norm(normal, axis=0)
    shade: Array = np.where(known, _AMBIENT + (_FLAT - _AMBIENT) * np.clip(lit, 0.0, None), np.nan)
    return shade


def _smooth_slopes(slope: Array, known: npt.NDArray[np.bool_], blur: float) -> Array:
    """Smooth slopes over the known heights (normalised convolution); clip them to `_MAX_SLOPE` first."""
    weight = scipy.ndimage.gaussian_filter(known.astype(np.float64), blur, mode="nearest")
    clipped = np.where(known, np.clip(slope, -_MAX_SLOPE, _MAX_SLOPE), 0.0)
    smooth: Array = scipy.ndimage.gaussian_filter(clipped, blur, mode="nearest") / np.where(known, weight, 1.0)
    return smooth


def _slope(z: Array, axis: int) -> Array:
    """Return the mean difference [m] to the known neighbours along an axis; 0 without a known neighbour."""
    ahead = np.diff(z, axis=axis, append=np.nan)
    backward = np.diff(z, axis=axis, prepend=np.nan)
    both = np.stack([ahead, backward])
    count = np.isfinite(both).sum(axis=0)
    slope: Array = np.where(np.isfinite(both), both, 0.0).sum(axis=0) / np.maximum(count, 1)
    return slope


def paint_heights(
    z: Array, status: Array, shade: Array, span: tuple[float, float], style: Style
) -> tuple[Array, list[LegendEntry]]:
    """Compute the colours of shaded heights, and the legend of missing and doubtful heights.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m], (rows, columns); NaN in holes.
    status : numpy.ndarray
        `Status` flags, (rows, columns), uint8.
    shade : numpy.ndarray
        Brightness, (rows, columns), see `shade_relief`; NaN counts as 1.
    span : (float, float)
        Heights of the ends of the colour scale [m].
    style : {"colour", "shaded"}
        Heights in colours, or a grey relief.

    Returns
    -------
    numpy.ndarray
        RGB colours 0 to 1, (rows, columns, 3).
    list of LegendEntry
        One entry for each colour of the picture that is not a height.
    """
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
            legend.append(LegendEntry(colour, meaning, float(np.mean(bare | tinted))))
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
    tints: Sequence[tuple[Array, str, str]] = (),
    overwrite: bool = False,
) -> None:
    """Draw a height map as PNG, with length bar, height bar and a legend of missing heights. Written atomically.

    Parameters
    ----------
    path : path-like
        Output file.
    heights : HeightMap
        Height map, arrays of the shape of the grid.
    grid : Grid
        Cells of the height map.
    style : {"colour", "shaded"}
        Shaded heights in colours, or a grey relief. Default "colour".
    title : str
        Title above the picture.
    span : (float, float), optional
        Heights of the ends of the colour scale [m]. Default: the 0.5 % and 99.5 % percentiles of the heights.
    tints : sequence of (mask, colour, meaning)
        Cells to tint (bool, shape of the grid), the colour ``#rrggbb`` and its text in the legend. Default: none.
    overwrite : bool
        Whether an existing file may be replaced. Default False.

    Raises
    ------
    ValueError
        The heights do not have the shape of the grid, or the style is unknown.
    """
    if style not in _STYLES:
        raise ValueError(f"style is {style!r}, expected one of {', '.join(_STYLES)}")
    z, status = to_numpy(heights.z).astype(np.float64), to_numpy(heights.status)
    if z.shape != grid.shape:
        raise ValueError(f"heights have shape {z.shape}, the grid has {grid.shape}; expected the same")
    span = height_span(z) if span is None else span
    exaggeration = choose_exaggeration(z, grid.cell_x, grid.cell_y)
    shade = shade_relief(z, grid.cell_x, grid.cell_y, exaggeration=exaggeration)
    picture, legend = paint_heights(z, status, shade, span, style)
    for mask, colour, meaning in tints:
        picture[mask] = (1 - _TINT) * picture[mask] + _TINT * np.array(to_rgb(colour))
        legend += [LegendEntry(colour, meaning, float(np.mean(mask)))] if mask.any() else []
    subtitle = _subtitle(z, _grid_size(grid)) + (f"  ·  relief {exaggeration:.0f} ×" if exaggeration > 1 else "")
    width, height = grid.columns * grid.cell_x, grid.rows * grid.cell_y
    page = _Page(picture, width / height, legend, title, subtitle, span if style == "colour" else None)
    page.length_bar(width)
    write_png(page.figure, path, overwrite=overwrite)


def draw_scan(
    path: str | os.PathLike[str],
    z: Any,
    status: Any,
    *,
    samples: Literal["down", "across"] = "across",
    aspect: float = 1.0,
    title: str = "Range image as scanned",
    span: tuple[float, float] | None = None,
    overwrite: bool = False,
) -> None:
    """Draw an organised range image as PNG, one row or column of the picture per profile. Written atomically.

    The samples are not resampled, so that the picture has a height bar but no length bar.

    Parameters
    ----------
    path : path-like
        Output file.
    z : array_like
        Heights [m], (profiles, samples), of `RangePoints`.
    status : array_like
        `Status` flags, (profiles, samples), uint8.
    samples : {"across", "down"}
        Direction of the samples of a profile in the picture. Default "across".
    aspect : float
        Width of the picture divided by its height. Default 1.
    title : str
        Title above the picture.
    span : (float, float), optional
        As for `draw_height_map`.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    z, status = np.asarray(z, np.float64), np.asarray(status)
    span = height_span(z) if span is None else span
    picture, legend = paint_heights(z, status, np.where(np.isfinite(z), 1.0, np.nan), span, "colour")
    subtitle = _subtitle(z, f"{z.shape[0]} profiles of {z.shape[1]} samples")
    labels = ("sample", "profile")
    if samples == "down":
        picture, labels = picture.transpose(1, 0, 2), ("profile", "sample")
    page = _Page(picture, aspect, legend, title, subtitle, span, labels=labels)
    write_png(page.figure, path, overwrite=overwrite)


def height_span(z: Array) -> tuple[float, float]:
    """Return the ends of the colour scale of heights [m]: their 0.5 % and 99.5 % percentiles.

    Equal percentiles are taken apart by 1 µm. Without a height the ends are 0 and 1 m.

    Parameters
    ----------
    z : numpy.ndarray
        Heights [m]; NaN in holes.
    """
    known = z[np.isfinite(z)]
    if not known.size:
        return 0.0, 1.0
    low, high = (float(each) for each in np.percentile(known, (0.5, 99.5)))
    return (low, high) if high > low else (low - 0.5e-6, high + 0.5e-6)


def _format_length(value: float, unit: float, step: float) -> str:
    """Return a length [m] as a number in a unit [m], with the decimals that resolve a step [m]."""
    digits = max(0, math.ceil(-math.log10(step / unit) - 1e-9))
    text = f"{value / unit:.{digits}f}"
    return text.replace("-", "\N{MINUS SIGN}") if float(text) != 0.0 else text.lstrip("-")


def _grid_size(grid: Grid) -> str:
    """Return the number of cells and the cell size as text."""
    sizes = []
    for cell in dict.fromkeys((grid.cell_x, grid.cell_y)):
        unit, name = length_unit(cell)
        sizes.append(f"{cell / unit:.3g} {name}")
    return f"{grid.columns} × {grid.rows} cells of {' × '.join(sizes)}"


def _subtitle(z: Array, size: str) -> str:
    """Return the line below the title: size, fraction of cells with a height, range of the heights."""
    known = z[np.isfinite(z)]
    subtitle = f"{size}  ·  {100 * known.size / z.size:.1f} % measured"
    if known.size:
        low, high = float(known.min()), float(known.max())
        unit, name = length_unit(max(abs(low), abs(high), 1e-6))
        step = max(high - low, 1e-6 * unit) / 100
        subtitle += f"  ·  heights {_format_length(low, unit, step)} to {_format_length(high, unit, step)} {name}"
    return subtitle


class _Page:
    """Page with picture, title, legend and scale bars; lengths on the page are in inches."""

    _LEFT, _RIGHT, _TOP, _BOTTOM, _LINE, _MIN_WIDTH = 0.3, 0.3, 0.72, 0.12, 0.21, 5.6
    _HEIGHT_BAR, _LENGTH_BAR, _AXES, _LABELS = 0.9, 0.45, 0.5, 0.5

    def __init__(
        self,
        picture: Array,
        aspect: float,
        legend: list[LegendEntry],
        title: str,
        subtitle: str,
        span: tuple[float, float] | None,
        *,
        labels: tuple[str, str] | None = None,
    ) -> None:
        longer = _PICTURE_PX / DPI
        self.width, self.height = (longer, longer / aspect) if aspect >= 1 else (longer * aspect, longer)
        self.left = self._LEFT + (self._AXES if labels else 0.0)
        right = self._RIGHT + (self._HEIGHT_BAR if span else 0.0)
        # The title needs this width even above a narrow picture.
        page_width = max(self.left + self.width + right, self._MIN_WIDTH)
        self.below = self._BOTTOM + self._LINE * len(legend)
        self.bottom = self.below + (self._LABELS if labels else self._LENGTH_BAR)
        self.page = (page_width, self.bottom + self.height + self._TOP)
        self.figure = new_figure(*self.page, layout=None)
        self.figure.set_facecolor(_PAPER)
        axes = self.axes(self.left, self.bottom, self.width, self.height)
        # Enlarged cells keep sharp edges: interpolated colours would show heights that were not measured.
        enlarged = picture.shape[0] < self.height * DPI or picture.shape[1] < self.width * DPI
        axes.imshow(picture, aspect="auto", interpolation="nearest" if enlarged else "antialiased")
        self._frame(axes, labels)
        self._write_titles(title, subtitle)
        self._legend(legend)
        if span:
            self._height_bar(span)

    def axes(self, left: float, bottom: float, width: float, height: float) -> Axes:
        """Add axes at a position on the page [in]."""
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

    def _write_titles(self, title: str, subtitle: str) -> None:
        across, up = self.page
        x = self.left / across
        self.figure.text(x, 1 - 0.33 / up, title, fontsize=12, fontweight="bold", color=_INK)
        self.figure.text(x, 1 - 0.57 / up, subtitle, fontsize=7.5, color=_FAINT)

    def _legend(self, legend: list[LegendEntry]) -> None:
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
        """Draw a bar of a round length below the picture, which is `width` metres wide."""
        length = round_length(width / 4)
        unit, name = length_unit(length)
        inches = self.width * length / width
        axes = self.axes(self.left, self.below + 0.08, inches, 0.09)
        axes.set_axis_off()
        axes.set(xlim=(0, 4), ylim=(0, 1))
        # Four fields of alternating colour, as on a map, show the quarters of the length.
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
