"""Pictures of a located robot: its view with the field's lines, the field with the pose candidates, and its track."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patches import Ellipse

from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.located_robot import LocatedRobot
from gpuvision.matching.field.robot_filter import RobotState
from gpuvision.plots.figure import new_figure, write_png
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

_DPI = 130
_CARPET, _LINE, _ON, _OFF, _BEST, _OTHER = "#2e7d4f", "#ffffff", "#00e5ff", "#ff9f1c", "#d50000", "#5d4037"
_ELLIPSE = 3.0  # sigmas
_ELLIPSE_EVERY = 10  # frames of a track


def draw_located_robot(
    path: str | Path, located: LocatedRobot, image: npt.NDArray[Any] | None = None, *, overwrite: bool = False
) -> None:
    """Draw the robot's view and the field with the candidates side by side, as PNG.

    Parameters
    ----------
    path
        File to write; it is replaced only once the picture is complete.
    located
        Result of `locate_robot`.
    image
        Top view of the floor; None: draw the points alone.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(13.0, 5.8, dpi=_DPI)
    left, right = figure.subplots(1, 2)
    _draw_view(left, located, image)
    _draw_field(right, located)
    figure.suptitle(located.summary(), fontsize=8, x=0.01, ha="left")
    write_png(figure, path, overwrite=overwrite)


def draw_robot_track(path: str | Path, field: Field, states: Sequence[RobotState], *, overwrite: bool = False) -> None:
    """Draw the poses of a robot over time on its field, as PNG.

    Parameters
    ----------
    path
        File to write; it is replaced only once the picture is complete.
    field
        The field.
    states
        State at each frame: ambiguous ones are drawn in another colour, 3 sigma ellipses at every tenth frame.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(9.0, 6.5, dpi=_DPI)
    axes = figure.subplots()
    axes.set_facecolor(_CARPET)
    axes.add_collection(LineCollection(field_lines(field), colors=_LINE, linewidths=1.5))
    for name, colour, which in (
        ("certain", _ON, [not each.status for each in states]),
        ("ambiguous", _OFF, [each.status == Status.AMBIGUOUS for each in states]),
    ):
        poses = np.array([each.pose for each, there in zip(states, which, strict=True) if there]).reshape(-1, 3)
        axes.plot(poses[:, 0], poses[:, 1], ".", color=colour, markersize=4.0, label=f"{len(poses)} frames {name}")
    for each in [*states[::_ELLIPSE_EVERY], states[-1]]:
        if np.all(np.isfinite(each.covariance)):
            axes.add_patch(_ellipse(each.pose, each.covariance, _BEST if each is states[-1] else _OTHER))
    axes.set(
        aspect="equal",
        xlabel="x [m]",
        ylabel="y [m]",
        xlim=(-0.56 * field.length, 0.56 * field.length),
        ylim=(-0.6 * field.width, 0.6 * field.width),
    )
    axes.set_title("track of the robot, 3 sigma ellipses at every tenth frame and at the last", fontsize=9, loc="left")
    axes.legend(loc="lower left", fontsize=7)
    write_png(figure, path, overwrite=overwrite)


def _draw_view(axes: Axes, located: LocatedRobot, image: npt.NDArray[Any] | None) -> None:
    """Draw the robot's frame: the image, its points, and the field lines transformed by the best candidate."""
    reach = float(np.abs(located.points).max()) * 1.05 if len(located.points) else 1.0
    axes.set_facecolor(_CARPET if image is None else "black")
    if image is not None and located.scale is not None:
        rows, columns = image.shape[:2]
        wide, high = 0.5 * columns * located.scale, 0.5 * rows * located.scale
        shown = image if image.ndim == 2 else image[..., 2::-1]
        axes.imshow(shown, extent=(-wide, wide, -high, high), cmap="gray", interpolation="nearest")
        axes.set(xlim=(-wide, wide), ylim=(-high, high))
    else:
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    on = np.zeros(len(located.points), np.bool_)
    shown_poses = located.candidates or located.doubtful
    if shown_poses:
        pose = shown_poses[0].pose
        lines = [_into(line, pose) for line in field_lines(located.field)]
        axes.add_collection(LineCollection(lines, colors="#ffe14d", linewidths=0.8))
        on = _distances(located.points, lines) < 3.0 * max(shown_poses[0].residual_std, 1e-3)
    for name, which, colour in (("on lines", on, _ON), ("beside them", ~on, _OFF)):
        axes.plot(
            *located.points[which].T, ".", color=colour, markersize=4.0, label=f"{int(which.sum())} points {name}"
        )
    axes.plot(0.0, 0.0, marker="+", color="white", markersize=14)
    axes.set(aspect="equal", xlabel="ahead [m]", ylabel="to the left [m]")
    axes.set_title("view of the robot; yellow: the field's lines for the best candidate", fontsize=9, loc="left")
    axes.legend(loc="lower left", fontsize=7)


def _draw_field(axes: Axes, located: LocatedRobot) -> None:
    field = located.field
    axes.set_facecolor(_CARPET)
    axes.add_collection(LineCollection(field_lines(field), colors=_LINE, linewidths=1.5))
    size = max(field.length, field.width)
    for number, each in reversed(list(enumerate(located.candidates))):
        x, y, heading = each.pose
        colour = _BEST if number == 0 else _OTHER
        axes.annotate(
            "",
            (x + 0.06 * size * math.cos(heading), y + 0.06 * size * math.sin(heading)),
            (x, y),
            arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.8},
        )
        axes.plot(x, y, "o", color=colour, markersize=5)
        axes.annotate(f" {number + 1}: {each.score:.3f}", (x, y), color="white", fontsize=8, va="bottom")
        if np.all(np.isfinite(each.covariance)):
            axes.add_patch(_ellipse(each.pose, each.covariance, colour))
    if located.candidates:
        x, y, heading = located.candidates[0].pose
        rotation = np.array([[math.cos(heading), -math.sin(heading)], [math.sin(heading), math.cos(heading)]])
        axes.plot(*(located.points @ rotation.T + (x, y)).T, ".", color=_ON, markersize=3.0)
    axes.set(
        aspect="equal",
        xlabel="x [m]",
        ylabel="y [m]",
        xlim=(-0.56 * field.length, 0.56 * field.length),
        ylim=(-0.6 * field.width, 0.6 * field.width),
    )
    axes.set_title("candidates with their scores (the least is the best), 3 sigma ellipses", fontsize=9, loc="left")


def field_lines(field: Field) -> list[Float64]:
    """Return a field's lines and arcs as polylines, (n, 2) [m] each."""
    lines = [np.array(each).reshape(2, 2) for each in field.lines]
    for arc in field.arcs:
        angle = np.linspace(arc.start, arc.end, max(8, math.ceil((arc.end - arc.start) / 0.08)))
        lines.append(np.stack([arc.x + arc.radius * np.cos(angle), arc.y + arc.radius * np.sin(angle)], axis=-1))
    return lines


def _into(line: Float64, pose: Float64) -> Float64:
    """Return places on the field in the frame of a robot."""
    rotation = np.array([[math.cos(pose[2]), -math.sin(pose[2])], [math.sin(pose[2]), math.cos(pose[2])]])
    return np.asarray((line - pose[:2]) @ rotation)


def _distances(points: npt.NDArray[Any], lines: list[Float64]) -> Float64:
    """Return the distance of each point from the nearest line [m]."""
    start = np.concatenate([each[:-1] for each in lines])
    along = np.concatenate([each[1:] - each[:-1] for each in lines])
    offset = points[:, None] - start
    share = np.clip(np.sum(offset * along, axis=-1) / np.sum(along**2, axis=-1), 0.0, 1.0)
    return np.asarray(np.linalg.norm(offset - share[..., None] * along, axis=-1).min(axis=1))


def _ellipse(pose: Float64, covariance: Float64, colour: str) -> Ellipse:
    values, vectors = np.linalg.eigh(covariance[:2, :2])
    wide, high = 2.0 * _ELLIPSE * np.sqrt(np.maximum(values, 0.0))
    angle = math.degrees(math.atan2(vectors[1, 0], vectors[0, 0]))
    return Ellipse((pose[0], pose[1]), wide, high, angle=angle, fill=False, edgecolor=colour, linewidth=1.2)
