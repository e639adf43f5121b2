"""Plots of a benchmark run: roofline, time over the amount of work, and time and error over the tolerance."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from gpuvision.host.outputs import Outputs
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.profiling.roofline import draw_roofline
from gpuvision.profiling.run import Row

_SIZE = (8.0, 3.6)  # [in]
_ROOFLINE_SIZE = (8.0, 6.4)  # its legends have a line for each operation
_COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
_GROWTH = re.compile(r"^growth/(?:(\w+)-)?x(\d+)$")


PLOTS = ("growth.png", "tolerance.png", "roofline.png")
"""Names of the files that `draw_plots` writes."""


def draw_plots(
    folder: str | Path, rows: Sequence[Row], machine: Mapping[str, Any] | None = None, *, overwrite: bool = False
) -> list[str]:
    """Draw the plots of the rows into a folder, as PNG; return the names of the files.

    ``growth.png``: times of the cases ``growth/...`` over the amount of work, relative to the case ``base`` of their
    metadata. ``tolerance.png``: times and errors over the tolerance, of the cases that have one in their metadata.
    ``roofline.png``: rates of the cases that declare operations and traffic, below the limits of the devices in the
    description of the machine (`machine.describe_machine`).
    With `overwrite` they may replace files that no earlier profile wrote.
    """
    figures = figures_of(rows, machine)
    if figures:
        with Outputs("profile", overwrite=overwrite).folder(folder) as inside:
            for name, figure in figures.items():
                write_png(figure, inside / f"{name}.png")
    return [f"{name}.png" for name in figures]


def figures_of(rows: Sequence[Row], machine: Mapping[str, Any] | None = None) -> dict[str, Figure]:
    """Return the figures that the rows have data for, by the names of the files of `draw_plots` without suffix."""
    figures: dict[str, Figure] = {}
    grown = [row for row in rows if _GROWTH.match(row.case)]
    bases = {row.metadata.get("base") for row in grown}
    for name, draw, chosen in (
        ("growth", _growth, grown and [row for row in rows if row in grown or row.case in bases]),
        ("tolerance", _tolerance, [row for row in rows if "tolerance" in row.metadata and "/" in row.case]),
    ):
        some = [row for row in chosen if name == "growth" or not row.case.startswith("growth/")]
        if some:
            figures[name] = _figure(draw, some)
    placed = [row for row in rows if row.flops and row.bytes and _roofs(machine, row.device)]
    if placed:
        devices = {row.device: _roofs(machine, row.device) for row in placed}
        figures["roofline"] = _figure(lambda axes, some: draw_roofline(axes, some, devices), placed, _ROOFLINE_SIZE)
    return figures


def _roofs(machine: Mapping[str, Any] | None, device: str) -> Mapping[str, Any]:
    """Return the limits of a device in the description of the machine; empty in runs of earlier versions."""
    devices = (machine or {}).get("devices")
    found = devices.get(device) if isinstance(devices, Mapping) else None
    return found if isinstance(found, Mapping) and {"gflops", "bandwidths"} <= set(found) else {}


def _figure(
    draw: Callable[[Any, Sequence[Row]], None], rows: Sequence[Row], size: tuple[float, float] = _SIZE
) -> Figure:
    devices = list(dict.fromkeys(row.device for row in rows))
    figure = new_figure(*size)
    for axes, device in zip(figure.subplots(1, len(devices), squeeze=False, sharey=True)[0], devices, strict=True):
        axes.set_title(device, fontsize=9, loc="left")
        draw(axes, [row for row in rows if row.device == device])
        axes.grid(which="both", alpha=0.2)
        if size == _SIZE:
            axes.legend(fontsize=6.5, frameon=False)
        else:
            axes.legend(fontsize=6.5, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    return figure


def _growth(axes: Any, rows: Sequence[Row]) -> None:
    lines: dict[str, dict[int, float]] = {}
    bases = {row.case: row.seconds for row in rows}
    for row in rows:
        grown = _GROWTH.match(row.case)
        if grown is None:
            continue
        quantity, times = grown.groups()
        line = lines.setdefault(quantity or "all, within a tolerance", {})
        line[int(times)] = row.seconds
        if "base" in row.metadata:
            line[1] = bases[row.metadata["base"]]
        if row.peer == "gpuvision":
            lines.setdefault("all, all pairs", {})[int(times)] = row.peer_seconds
    for colour, (name, line) in zip(itertools.cycle(_COLOURS), lines.items(), strict=False):
        times = sorted(line)
        axes.loglog(times, [1e3 * line[each] for each in times], "o-", color=colour, label=name, markersize=3)
    axes.set(xlabel="times as many", ylabel="ms")


def _tolerance(axes: Any, rows: Sequence[Row]) -> None:
    lines: dict[str, list[Row]] = {}
    for row in rows:
        lines.setdefault(row.case.split("/")[0], []).append(row)
    for colour, (name, line) in zip(itertools.cycle(_COLOURS), lines.items(), strict=False):
        tolerances = sorted(
            (row for row in line if row.metadata["tolerance"] > 0.0), key=lambda row: row.metadata["tolerance"]
        )
        x = [1e6 * row.metadata["tolerance"] for row in tolerances]
        axes.loglog(
            x, [1e3 * row.seconds for row in tolerances], "o-", color=colour, label=f"{name}: time", markersize=3
        )
        off = [1e6 * max(row.error, 1e-12) for row in tolerances]
        axes.loglog(x, off, "s--", color=colour, label=f"{name}: largest error", markersize=3)
    if lines:
        axes.loglog(x, x, ":", color="0.4", label="as asked")
    axes.set(xlabel="tolerance [µm]", ylabel="ms, µm")
