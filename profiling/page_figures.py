"""Figures of the page of a benchmark run, as SVG elements for HTML.

Text and axes have the colour of the page's text, so that a figure is readable on a light and on a dark page.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl

from gpuvision.plots.figure import new_figure
from gpuvision.profiling.plots import figures_of
from gpuvision.profiling.run import Probe, Row, Run

_WIDTH = 8.0  # [in]
_ROW_HEIGHT = 0.21  # of a line of a strip chart [in]
_COLOURS = ("#2a85c7", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_MARKS = "osD^v*Pph"
_LONGEST = 32  # characters of a name in a figure, so that the axes have room
_DARK_GREY = "#333333"  # of the roofline, not readable on a dark page
_INK = "#010203"  # replaced by the colour of the page's text
# Title and caption of each figure of `plots.figures_of`.
_TITLES = {
    "growth": ("Time over the amount of work", ""),
    "tolerance": ("Time and error over the tolerance", ""),
    "roofline": (
        "Roofline",
        "Rate of operations over their number for each byte of the least traffic. Roofs: copies of different sizes, "
        "and multiply-adds in registers.",
    ),
}
_STYLE: dict[Any, Any] = {
    "svg.fonttype": "none",
    "svg.hashsalt": "gpuvision",  # the same file for the same numbers
    "font.family": "sans-serif",
    "font.size": 9,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), _INK),
    "axes.facecolor": "none",
    "figure.facecolor": "none",
    "legend.facecolor": "none",
}


class PageFigure(NamedTuple):
    """Figure of the page.

    Attributes
    ----------
    title, caption
        Text above and below the figure.
    svg
        SVG element.
    """

    title: str
    caption: str
    svg: str


def page_figures(run: Run) -> list[PageFigure]:
    """Return the figures that a run has data for."""
    with mpl.rc_context(_STYLE):
        return [PageFigure(title, caption, _svg(figure, name)) for name, title, caption, figure in _drawn(run)]


def _drawn(run: Run) -> Iterator[tuple[str, str, str, Any]]:
    """Yield name, title, caption and figure of matplotlib."""
    rows = run.rows
    if rows:
        caption = (
            "A point for each case; the bar is the 95 % interval of the ratio. Right of the line gpuvision is faster."
        )
        yield "ratios", "Time of the peer over our time", caption, _ratios(rows)
    if any(_positive(row.fraction) for row in rows):
        caption = "Time of a copy with the same traffic over our time. Above 1 the data come from the caches."
        yield "fractions", "Fraction of the ceiling", caption, _fractions(rows)
    if any(_positive(row.error) for row in rows):
        caption = "Largest error of gpuvision, in the unit of the operation (m, px or relative), over its time."
        yield "errors", "Error over time", caption, _errors(rows)
    for name, figure in figures_of(rows, run.machine).items():
        yield name, *_TITLES[name], figure
    if run.probes:
        caption = "FLOP rate of the device before and after each measurement; a cross: the device was not steady."
        yield "probes", "Trace of the speed probe", caption, _probe_trace(run.probes)


def _positive(value: float | None) -> bool:
    return value is not None and math.isfinite(value) and value > 0.0


def _plain(text: str) -> str:
    """Return the start of a text, in which matplotlib sees no formula. The tables show the whole text."""
    return (text if len(text) <= _LONGEST else f"{text[: _LONGEST - 1]}…").replace("$", r"\$")


def _strip(
    rows: Sequence[Row], line_of: Callable[[Row], str], value_of: Callable[[Row], float | None], label: str
) -> tuple[Any, Any, dict[str, int]]:
    """Return a figure, its axes and the line numbers of a chart with a line of points for each name."""
    names = list(dict.fromkeys(line_of(row) for row in rows if _positive(value_of(row))))
    figure = new_figure(_WIDTH, 1.0 + _ROW_HEIGHT * len(names))
    axes = figure.subplots()
    axes.set_xscale("log")
    axes.axvline(1.0, color=_INK, linewidth=0.8)
    axes.set_yticks(range(len(names)), [_plain(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.set_xlabel(label)
    axes.grid(axis="both", alpha=0.2, color=_INK)
    return figure, axes, {name: number for number, name in enumerate(names)}


def _ratios(rows: Sequence[Row]) -> Any:
    def line(row: Row) -> str:
        return f"{row.operation}: {row.peer}"

    figure, axes, places = _strip(rows, line, lambda row: row.ratio, "ratio")
    _points_of_devices(axes, rows, places, line, lambda row: row.ratio, lambda row: row.interval)
    return figure


def _fractions(rows: Sequence[Row]) -> Any:
    figure, axes, places = _strip(rows, lambda row: row.operation, lambda row: row.fraction, "fraction")
    _points_of_devices(axes, rows, places, lambda row: row.operation, lambda row: row.fraction)
    return figure


def _points_of_devices(
    axes: Any,
    rows: Sequence[Row],
    places: Mapping[str, int],
    line_of: Callable[[Row], str],
    value_of: Callable[[Row], float | None],
    interval_of: Callable[[Row], tuple[float, float] | None] = lambda row: None,
) -> None:
    """Draw a point for each row, and a bar for its interval; the devices have colours and offsets."""
    devices = list(dict.fromkeys(row.device for row in rows))
    for number, device in enumerate(devices):
        chosen = [row for row in rows if row.device == device and _positive(value_of(row))]
        offset = 0.3 * ((number + 0.5) / len(devices) - 0.5)
        heights = [places[line_of(row)] + offset for row in chosen]
        colour = _COLOURS[number % len(_COLOURS)]
        values = [value_of(row) for row in chosen]
        axes.plot(values, heights, "o", color=colour, markersize=3.5, alpha=0.8, label=_plain(device))
        for row, height in zip(chosen, heights, strict=True):
            interval = interval_of(row)
            if interval is not None and _positive(interval[0]):
                axes.plot(interval, [height] * 2, color=colour, linewidth=0.9, alpha=0.6)
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _errors(rows: Sequence[Row]) -> Any:
    figure = new_figure(_WIDTH, 4.2)
    axes = figure.subplots()
    operations = list(dict.fromkeys(row.operation for row in rows))
    for number, operation in enumerate(operations):
        chosen = [row for row in rows if row.operation == operation and _positive(row.error) and _positive(row.seconds)]
        if chosen:
            mark = _MARKS[number // len(_COLOURS) % len(_MARKS)]
            colour = _COLOURS[number % len(_COLOURS)]
            times, errors = [1e3 * row.seconds for row in chosen], [row.error for row in chosen]
            axes.plot(times, errors, mark, color=colour, markersize=4, alpha=0.8, label=_plain(operation))
    axes.set(xscale="log", yscale="log", xlabel="time [ms]", ylabel="largest error")
    axes.grid(alpha=0.2, color=_INK)
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
    return figure


def _probe_trace(probes: Sequence[Probe]) -> Any:
    figure = new_figure(_WIDTH, 2.6)
    axes = figure.subplots()
    for number, device in enumerate(dict.fromkeys(probe.device for probe in probes)):
        colour = _COLOURS[number % len(_COLOURS)]
        for place, probe in enumerate(probes):
            if probe.device == device:
                rates = [probe.before / 1e9, probe.after / 1e9]
                axes.plot([place, place + 0.8], rates, ".-" if probe.steady else "x--", color=colour)
        axes.plot([], [], ".-", color=colour, label=_plain(device))
    names = [_plain(probe.operation) for probe in probes]
    axes.set_xticks([place + 0.4 for place in range(len(probes))], names, rotation=90, fontsize=7)
    axes.set_ylim(0.0, 1.15e-9 * max(max(probe.before, probe.after) for probe in probes))
    axes.set_ylabel("GFLOP/s")
    axes.grid(axis="y", alpha=0.2, color=_INK)
    axes.legend(frameon=False, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _svg(figure: Any, name: str) -> str:
    """Return the SVG element of a figure, without references out of it and with identifiers of its own."""
    file = io.StringIO()
    figure.savefig(file, format="svg", metadata={"Date": None})
    text = file.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    for ink in (_INK, _DARK_GREY):
        text = text.replace(ink, "currentColor")
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    # Without a size the page scales the figure to its width.
    return re.sub(r"^<svg[^>]*>", lambda tag: re.sub(r' (?:width|height)="[^"]*"', "", tag.group()), text)
