"""Pictures of boards: the artwork with the selected rulers and fiducials, and an image with its measurements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.collections import LineCollection, PathCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Polygon
from matplotlib.path import Path as Outline

from gpuvision.camera.image import finite_percentiles
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.artwork.shapes import Shape, area, capsule
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.plots.figure import new_figure, write_png

Float64 = npt.NDArray[np.float64]

_LAMINATE, _COPPER, _OPEN, _SILK, _HOLE = "#1f3d2b", "#4f8a5b", "#d9b75f", "#f4f4f0", "#111111"
# The colours also differ in lightness, for colour-blind readers.
_USED, _REJECTED, _MISSING, _ARTWORK = "#00e5ff", "#ff9f1c", "#ff3366", "#ffe14d"
_MM = 1e3


def draw_features(
    path: str | Path,
    artwork: Artwork,
    features: FeatureSet,
    region: npt.ArrayLike,
    *,
    view: BoardView | None = None,
    target: npt.ArrayLike | None = None,
    overwrite: bool = False,
) -> None:
    """Draw a region of the artwork with the selected features as PNG.

    Parameters
    ----------
    path
        File to write; it is replaced only once the picture is complete.
    artwork
        The side of the board.
    features
        Selected features.
    region
        (2, 2) least and greatest x, y [m].
    view : BoardView, optional
        Image on the board; its border is drawn, and the cross is named image centre. Default: the border of the region.
    target : array_like, optional
        (2,) point of the board that the nozzle shall reach [m], marked by a diagonal cross. Default: none.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    box = np.asarray(region, np.float64)
    corners = np.stack([box[[0, 1, 1, 0], 0], box[[0, 0, 1, 1], 1]], axis=1) if view is None else _image_corners(view)
    shown = corners if target is None else np.vstack([corners, np.asarray(target, np.float64)])
    box = np.stack([np.minimum(box[0], shown.min(axis=0)), np.maximum(box[1], shown.max(axis=0))])
    window = np.stack([np.minimum(box[0], features.region[0]), np.maximum(box[1], features.region[1])])
    border = 0.04 * (window[1] - window[0]).max()
    window = window + border * np.array([[-1.0], [1.0]])
    wide, high = window[1] - window[0]
    figure = new_figure(9.0, min(max(9.0 * high / wide, 3.0), 12.0) + 0.9)
    axes = figure.add_subplot()
    draw_artwork(axes, artwork, window)
    axes.add_patch(Polygon(_MM * corners, fill=False, edgecolor="white", linestyle="--"))
    ends = features.normal * features.length[:, None] / 2
    lines = _MM * np.stack([features.point - ends, features.point + ends], axis=1)
    pair = features.spacing > 0
    for which, colour in ((~pair, _USED), (pair, "#ff66ff")):
        axes.add_collection(LineCollection(list(lines[which]), colors=colour, linewidths=1.4))
    for middle, radius in zip(features.fiducials.point, features.fiducials.radius, strict=True):
        axes.add_patch(Circle(_MM * middle, _MM * radius, fill=False, edgecolor=_USED, linewidth=1.6))
    axes.plot(*(_MM * features.placement), marker="+", color="white", markersize=16, markeredgewidth=2)
    axes.set(xlim=_MM * window[:, 0], ylim=_MM * window[:, 1], aspect="equal", xlabel="x [mm]", ylabel="y [mm]")
    if artwork.side == "bottom":
        axes.invert_xaxis()
    axes.set_title(features.summary(), fontsize=8, loc="left")
    handles = [Line2D([], [], color=_USED, label="across an edge"), Line2D([], [], color="#ff66ff", label="a trace")]
    centre = "placement point" if view is None else "image centre"
    handles.append(Line2D([], [], color="grey", marker="+", linestyle="", label=centre))
    if target is not None:
        axes.plot(*(_MM * np.asarray(target, np.float64)), marker="x", color=_MISSING, markersize=12, markeredgewidth=2)
        handles.append(Line2D([], [], color=_MISSING, marker="x", linestyle="", label="target"))
    figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=8, frameon=False)
    write_png(figure, path, overwrite=overwrite)


def _image_corners(view: BoardView) -> Float64:
    """Return the corners (4, 2) of the undistorted image on the board [m], in order."""
    rows, columns = view.shape
    return view.to_plane([[0, 0], [columns - 1, 0], [columns - 1, rows - 1], [0, rows - 1]])


def draw_artwork(axes: Any, artwork: Artwork, window: Float64) -> None:
    """Draw copper, mask openings, silk and holes of a window (2, 2) [m], in millimetres."""
    axes.set_facecolor(_LAMINATE)
    _fill(axes, artwork.copper, window, _COPPER, _LAMINATE)
    _fill(axes, artwork.mask, window, _OPEN, _COPPER, alpha=0.55)
    _fill(axes, artwork.silk, window, _SILK, _LAMINATE)
    drilled = zip(artwork.holes.start, artwork.holes.end, artwork.holes.diameter, strict=True)
    _fill(axes, tuple(Shape(capsule(start, end, across / 2)) for start, end, across in drilled), window, _HOLE, _HOLE)


def _fill(
    axes: Any, shapes: tuple[Shape, ...], window: Float64, dark: str, clear: str, alpha: float | None = None
) -> None:
    visible = [
        each
        for each in shapes
        if np.all(each.outline.max(axis=0) >= window[0]) and np.all(each.outline.min(axis=0) <= window[1])
    ]
    colours = [dark if each.dark else clear for each in visible]
    axes.add_collection(
        PathCollection([_path(each) for each in visible], facecolors=colours, linewidths=0, alpha=alpha)
    )


def _path(shape: Shape) -> Outline:
    """Return the contours of a shape [mm]; a hole runs clockwise, an outline counter-clockwise, so that it is free."""
    outlines = (shape.outline if area(shape.outline) >= 0 else shape.outline[::-1],)
    holes = (each if area(each) <= 0 else each[::-1] for each in shape.holes)
    return Outline.make_compound_path(*(Outline(_MM * each, closed=False) for each in (*outlines, *holes)))


def draw_located_board(
    path: str | Path, image: npt.NDArray[Any], artwork: Artwork, located: LocatedBoard, *, overwrite: bool = False
) -> None:
    """Draw an image with the artwork at the located pose, the rulers with their edges, and the fiducials, as PNG.

    Rulers are drawn as straight lines between their ends; the distortion of a lens over a ruler is not visible.

    Parameters
    ----------
    path
        File to write; it is replaced only once the picture is complete.
    image
        The image that was measured.
    artwork, located
        Artwork, and result of `locate_board`.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    rows, columns = located.view.shape
    figure = new_figure(10.0, min(max(10.0 * rows / columns, 3.0), 14.0) + 0.8)
    axes = figure.add_subplot()
    _show(axes, image)
    _draw_outlines(axes, artwork, located.view)
    rulers, view = located.rulers, located.view
    classes = (
        ("agree", rulers.used, _USED),
        ("rejected", rulers.found & ~rulers.used, _REJECTED),
        ("no edge found", rulers.in_image & ~rulers.found, _MISSING),
    )
    ends = rulers.normal * (rulers.length_px * view.scale / 2)[:, None]
    lines = np.stack(
        [view.to_measured_pixels(rulers.point - ends), view.to_measured_pixels(rulers.point + ends)], axis=1
    )
    places = view.to_measured_pixels(rulers.point + rulers.normal * (rulers.position_px * view.scale)[:, None])
    handles = [Line2D([], [], color=_ARTWORK, label="artwork's edges" + _as_expected(located))]
    for name, which, colour in classes:
        axes.add_collection(LineCollection(list(lines[which]), colors=colour, linewidths=1.1))
        axes.plot(*places[which].T, ".", color=colour, markersize=4.0)
        handles.append(Line2D([], [], color=colour, label=f"{int(which.sum())} rulers: {name}"))
    axes.plot(*located.placement_px, marker="+", color="white", markersize=18, markeredgewidth=1.6)
    handles += _draw_fiducials(axes, located)
    _draw_axes(axes, view)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xlabel="column [px]", ylabel="row [px]")
    axes.set_title(located.summary(), fontsize=8, loc="left")
    figure.legend(handles=handles, loc="outside lower left", ncols=4, fontsize=8, frameon=False)
    write_png(figure, path, overwrite=overwrite)


def _draw_fiducials(axes: Any, located: LocatedBoard) -> list[Line2D]:
    """Draw fiducials as circles where they were found or expected, and return the handles of the legend."""
    fiducials, view = located.fiducials, located.view
    middles = np.where(fiducials.found[:, None], fiducials.image_px, view.to_measured_pixels(fiducials.point))
    size = np.where(fiducials.found, np.nan_to_num(fiducials.size), fiducials.radius) / view.scale
    handles = []
    for name, which, colour in (
        ("agree", fiducials.used, _USED),
        ("rejected", fiducials.found & ~fiducials.used, _REJECTED),
        ("not found", fiducials.in_image & ~fiducials.found, _MISSING),
    ):
        for middle, radius in zip(middles[which], size[which], strict=True):
            axes.add_patch(Circle(middle, radius, fill=False, edgecolor=colour, linewidth=1.4))
            axes.plot(*middle, "x", color=colour, markersize=4.0)
        if fiducials.in_image.any():
            label = f"{int(which.sum())} fiducials: {name}"
            handles.append(Line2D([], [], color=colour, marker="o", fillstyle="none", linestyle="", label=label))
    return handles


def _as_expected(located: LocatedBoard) -> str:
    return " where last looked for" if located.reason else ""


def _draw_outlines(axes: Any, artwork: Artwork, view: BoardView) -> None:
    """Draw the visible straight edges of the artwork."""
    edges = artwork.edges
    ends = np.stack([edges.start, edges.end], axis=1)
    low, high = view.bounds
    visible = np.all((ends.max(axis=1) >= low) & (ends.min(axis=1) <= high), axis=1)
    axes.add_collection(
        LineCollection(list(view.to_measured_pixels(ends[visible])), colors=_ARTWORK, linewidths=0.5, alpha=0.8)
    )


def _draw_axes(axes: Any, view: BoardView) -> None:
    """Draw the board's axes at the image centre: x with a long arrow, y with a short one."""
    x, y, _ = view.pose
    arm = 0.08 * min(view.shape) * view.scale
    centre = view.to_measured_pixels(np.array([x, y]))
    for name, tip in (("x", (1.6 * arm, 0.0)), ("y", (0.0, arm))):
        end = view.to_measured_pixels(np.array([x, y]) + tip)
        axes.annotate("", end, centre, arrowprops={"arrowstyle": "->", "color": "white", "lw": 1.3})
        axes.annotate(name, end, color="white", fontsize=8, fontweight="bold")


def _show(axes: Any, image: npt.NDArray[Any]) -> None:
    grey = image if image.ndim == 2 else image[..., 2::-1]
    if grey.ndim == 3 and grey.dtype == np.uint8:
        axes.imshow(grey, interpolation="nearest")
        return
    grey = grey if grey.ndim == 2 else grey.mean(axis=2)
    low, high = finite_percentiles(grey, (0.5, 99.5))
    axes.imshow(grey, cmap="gray", vmin=low, vmax=max(high, low + 1e-9), interpolation="nearest")
