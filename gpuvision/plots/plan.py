"""Picture of a plan: predicted errors over measured times of the settings that were tried, and the tolerance."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import NamedTuple

from gpuvision.plots.figure import new_figure, write_png

_WIDTH, _HEIGHT = 6.5, 4.5  # of the page [in]
_MAX_NAMES = 12  # with more settings only those get a name that no other one beats
_NEAR = 0.01  # relative difference of times and errors of two points that have one name (chosen: a marker's size)
_CHOSEN, _OTHER, _TOLERANCE = "#009e73", "#0072b2", "#d55e00"


class PlannedSetting(NamedTuple):
    """Setting that a plan tried.

    Attributes
    ----------
    name : str
        Text beside the point.
    seconds : float
        Time for a unit of work, such as a frame [s].
    error : float
        Predicted error [m].
    chosen : bool
        Whether the plan chose it.
    """

    name: str
    seconds: float
    error: float
    chosen: bool


def draw_plan(
    path: str | os.PathLike[str],
    settings: Sequence[PlannedSetting],
    tolerance: float,
    *,
    error_of: str = "the heights",
    unit: str = "frame",
    title: str = "",
) -> None:
    """Draw the error of each setting over its time, with the tolerance as a line, as PNG.

    Of more than 12 settings only the chosen one and those have a name that no other one beats in time and error, and
    of these one at each place.

    Parameters
    ----------
    path : path-like
        File to write; it must not exist.
    settings : sequence of PlannedSetting
        Settings with an error.
    tolerance : float
        Largest error [m].
    error_of : str
        Result whose error is drawn, for the label of the axis. Default ``"the heights"``.
    unit : str
        Unit of work whose time is drawn, for the label of the axis. Default ``"frame"``.
    title : str
        Title of the picture.
    """
    figure = new_figure(_WIDTH, _HEIGHT)
    axes = figure.subplots()
    axes.axhline(1e6 * tolerance, color=_TOLERANCE, linewidth=1.0, label="tolerance")
    named = _named(settings)
    for each in settings:
        colour = _CHOSEN if each.chosen else _OTHER
        place = (1e6 * each.seconds, 1e6 * each.error)
        axes.plot(
            *place,
            "o",
            color=colour,
            markersize=8 if each.chosen else 5,
            label="chosen" if each.chosen else None,
            zorder=3 if each.chosen else 2,
        )
        if each in named:
            axes.annotate(each.name, place, xytext=(6, 4), textcoords="offset points", fontsize=8, color=colour)
    axes.set(xlabel=f"time per {unit} [us]", ylabel=f"predicted error of {error_of} [um]", xscale="log", yscale="log")
    axes.set_title(title, fontsize=10, loc="left")
    axes.grid(which="both", alpha=0.2)
    axes.legend(fontsize=8, frameon=False)
    write_png(figure, path)


def _named(settings: Sequence[PlannedSetting]) -> Sequence[PlannedSetting]:
    """Return the settings that get a name."""
    if len(settings) <= _MAX_NAMES:
        return settings
    named: list[PlannedSetting] = []
    for each in sorted(settings, key=lambda one: not one.chosen):
        is_beaten = any(one.seconds < each.seconds and one.error < each.error for one in settings)
        if each.chosen or not (is_beaten or any(_is_near(each, one) for one in named)):
            named.append(each)
    return named


def _is_near(one: PlannedSetting, other: PlannedSetting) -> bool:
    """Return whether the names of two settings would cover each other."""
    pairs = ((one.seconds, other.seconds), (one.error, other.error))
    return all(math.isclose(*each, rel_tol=_NEAR) for each in pairs)
