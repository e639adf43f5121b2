"""Picture of a sensor calibration: the target and the laser line over an image, and the residuals of the sheet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from gpuvision.host.image_files import read_frame
from gpuvision.plots.figure import new_figure, write_png

Float64 = npt.NDArray[np.float64]

# Above this count, every n-th residual is drawn.
_MAX_POINTS = 20_000
# Range of the residuals' axis [standard deviations of a reading].
_RANGE = 6.0


@dataclass(frozen=True, kw_only=True)
class SensorPicture:
    """Data of the picture.

    Attributes
    ----------
    title : str
        Summary of the calibration.
    image : Path
        Laser image to draw.
    grid : numpy.ndarray
        (rows, columns, 2): points of the target in this image [px]; (0, 0, 2) without a target.
    line : numpy.ndarray
        (n, 2): readings of the laser line in this image [px].
    lines : tuple of numpy.ndarray
        (n, 2): readings of all laser images [px].
    coordinates : tuple of numpy.ndarray
        (n, 2): G and H of the readings of each laser image [m].
    residuals : tuple of numpy.ndarray
        (n,): residuals of the readings about the sheet [px]; NaN for rejected readings.
    sigma_px : float
        Noise of a reading [px].
    """

    title: str
    image: Path
    grid: Float64
    line: Float64
    lines: tuple[Float64, ...]
    coordinates: tuple[Float64, ...]
    residuals: tuple[Float64, ...]
    sigma_px: float


def draw_sensor_calibration(path: str | Path, picture: SensorPicture, *, overwrite: bool = False) -> None:
    """Draw the grid and the line over an image, the coverage of the sheet, and its residuals, as PNG.

    Parameters
    ----------
    path : str or Path
        File to write. On an error no file is left behind.
    picture : SensorPicture
        Data to draw.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    figure = new_figure(13.0, 8.0)
    (left, right), (below, beside) = figure.subplots(2, 2, height_ratios=(3, 2))
    _draw_image(left, picture)
    _draw_lines(right, picture)
    _draw_residuals(below, picture)
    _draw_sheet(beside, picture)
    figure.suptitle(picture.title, fontsize=9, x=0.01, ha="left")
    write_png(figure, path, overwrite=overwrite)


def _draw_image(axes: Axes, picture: SensorPicture) -> None:
    image = read_frame(picture.image)
    axes.imshow(image, cmap="gray", vmin=0, vmax=float(np.percentile(image, 99.8)))
    if picture.grid.size:
        columns, rows = picture.grid[..., 0], picture.grid[..., 1]
        axes.plot(columns, rows, color="tab:cyan", linewidth=0.6)
        axes.plot(columns.T, rows.T, color="tab:cyan", linewidth=0.6)
        axes.plot(columns.ravel(), rows.ravel(), "+", color="tab:cyan", markersize=4.0, label="target points")
    axes.plot(*picture.line.T, ".", color="tab:red", markersize=1.0, label="laser line")
    axes.legend(fontsize=7, markerscale=3.0)
    axes.set_title(f"{picture.image.name}: target and laser line found", fontsize=9)
    axes.set(xlabel="column [px]", ylabel="row [px]")


def _draw_lines(axes: Axes, picture: SensorPicture) -> None:
    rows, columns = read_frame(picture.image).shape
    for points in picture.lines:
        axes.plot(*points.T, ".", markersize=1.0)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), aspect="equal")
    axes.set_title("laser lines of all images", fontsize=9)
    axes.set(xlabel="column [px]", ylabel="row [px]")


def _draw_residuals(axes: Axes, picture: SensorPicture) -> None:
    step = max(sum(map(len, picture.residuals)) // _MAX_POINTS, 1)
    for flat, residuals in zip(picture.coordinates, picture.residuals, strict=True):
        axes.plot(1e3 * flat[::step, 0], residuals[::step], ".", markersize=1.5)
    limit = _RANGE * picture.sigma_px
    axes.set(xlabel="G [mm]", ylabel="residual [px]", ylim=(-limit, limit))
    axes.set_title(f"residuals of the sheet; noise of a reading {picture.sigma_px:.3g} px", fontsize=9)


def _draw_sheet(axes: Axes, picture: SensorPicture) -> None:
    for flat in picture.coordinates:
        axes.plot(*(1e3 * flat).T, ".", markersize=1.0)
    axes.set(xlabel="G [mm]", ylabel="H [mm]")
    axes.set_title("calibrated part of the sheet; outside it is extrapolated", fontsize=9)
