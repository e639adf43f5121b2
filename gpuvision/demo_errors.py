"""A scan of the demonstration's part against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh
from matplotlib.figure import Figure

from gpuvision.demo import PROFILES, cast_down
from gpuvision.scan import Scan

Array = npt.NDArray[Any]


class Errors(NamedTuple):
    """Measured heights against the truth [m].

    Attributes
    ----------
    map
        (profiles, samples); NaN where nothing was measured.
    rms, p95, maximum
        On smooth surfaces: away from edges, where the light of a sample falls on one surface.
    smooth
        Part of the measured samples that is.
    rms_all
        With the edges.
    """

    map: Array
    rms: float
    p95: float
    maximum: float
    smooth: float
    rms_all: float

    def to_dict(self) -> dict[str, float]:
        """Return the numbers."""
        return {name: value for name, value in self._asdict().items() if name != "map"}

    def summary(self) -> str:
        """Return the numbers in a line."""
        rms, p95, most, everywhere = (1e6 * each for each in (self.rms, self.p95, self.maximum, self.rms_all))
        return (
            f"heights off by {rms:.1f} µm rms, {p95:.1f} µm p95, {most:.0f} µm at most, away from edges "
            f"({100 * self.smooth:.0f} % of the valid samples); {everywhere:.0f} µm rms with the edges"
        )


def compare(scan: Scan, mesh: trimesh.Trimesh) -> Errors:
    """Compare a scan's points with the part: heights at their x and y."""
    middle = scan.sensor.transport.transport(PROFILES).mean()
    x, y, z = (np.asarray(each, np.float64) for each in scan.points[:3])
    good = np.isfinite(z)
    x, y = x[good], y[good] - middle
    truth, _ = cast_down(mesh, x, y)
    smooth = _away_from_edges(mesh, x, y, float(np.nanmedian(np.abs(np.diff(scan.points.x, axis=1)))))
    error = z[good] - truth
    errors = np.full(z.shape, np.nan)
    errors[good] = error
    size = np.abs(error[smooth])
    return Errors(
        map=errors,
        rms=float(np.sqrt(np.mean(size**2))),
        p95=float(np.percentile(size, 95)),
        maximum=float(size.max()),
        smooth=float(np.mean(smooth)),
        rms_all=float(np.sqrt(np.nanmean(error**2))),
    )


def _away_from_edges(mesh: trimesh.Trimesh, x: Array, y: Array, apart: float) -> Array:
    """Say where the part rises by less than 1.6 (58 degrees) for two samples to every side."""
    smooth = np.ones(x.shape, bool)
    middle, _ = cast_down(mesh, x, y)
    for dx, dy in ((apart, 0.0), (-apart, 0.0), (0.0, apart), (0.0, -apart)):
        before = middle
        for far in (1, 2):
            z, _ = cast_down(mesh, x + far * dx, y + far * dy)
            smooth &= np.abs(z - before) < 1.6 * apart  # False beside the part, where z is NaN
            before = z
    return smooth


def draw_errors(path: Path, errors: Errors, title: str) -> None:
    """Draw where a scan is how far off, as PNG; edges are shown with the rest."""
    figure = Figure(figsize=(8.0, 5.5), dpi=150, layout="constrained")
    axes = figure.add_subplot()
    reach = 4e6 * errors.rms
    shown = axes.imshow(
        1e6 * errors.map, cmap="RdBu_r", vmin=-reach, vmax=reach, aspect="auto", origin="lower", interpolation="nearest"
    )
    axes.set(xlabel="sample", ylabel="profile", facecolor="0.75")
    axes.set_title(f"{title}\n{errors.summary().replace('; ', chr(10))}", fontsize=8, loc="left")
    figure.colorbar(shown, label="measured height less the truth [µm]; grey: not measured", extend="both")
    figure.savefig(path)
