"""Images of a flat pattern become a camera model, with uncertainties, alternatives and warnings.

From straight lines (`fit_lens`) the lens alone follows, from one image on; from three views of a grid, or one and the
focal length, the whole camera with a tilted sensor (`fit_camera`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import NAMES, Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.line_statistics import Loss
from gpuvision.camera.patterns.chessboard import find_chessboard
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from gpuvision.camera.patterns.pattern import LineFamilies
from gpuvision.camera.planar_views import LossName, fit_camera
from gpuvision.camera.vanishing_points import fit_lens, straightness_px
from gpuvision.camera.views.camera_fit import CameraFit
from gpuvision.camera.views.target_views import view_of
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import write_whole
from gpuvision.host.recordings import read_image
from gpuvision.lens_file import write_lens
from gpuvision.tables import json_tree

Pattern = Literal["dots", "chessboard", "lines"]
Method = Literal["auto", "lines", "views"]
Float64: TypeAlias = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]

_FEWEST_VIEWS = 3


class Other(NamedTuple):
    """A model that was fitted too.

    Attributes
    ----------
    model
        Its name.
    rms_px
        Root mean square residual.
    p_value
        Probability of so much a worse fit than the largest model's, were this one true (F test).
    aic
        Akaike's criterion; only differences tell.
    centre
        (column, row) of its centre; None without a lens.
    apart_px
        How far that lies from the chosen model's; NaN without a lens.
    """

    model: str
    rms_px: float
    p_value: float
    aic: float
    centre: tuple[float, float] | None
    apart_px: float


class Seen(NamedTuple):
    """The pattern in one image.

    Attributes
    ----------
    image
        Its file.
    grid
        (rows, columns, 2) [px], NaN where missing; None for a pattern of lines.
    families
        Its straight lines.
    """

    image: Path
    grid: Float64 | None
    families: LineFamilies

    @property
    def points(self) -> int:
        """Number of points."""
        if self.grid is None:
            return sum(len(line) for family in self.families for line in family)
        return int(np.count_nonzero(np.isfinite(self.grid[..., 0])))


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera model and what it was found from.

    Attributes
    ----------
    fit
        The fit, with parameters, covariance, alternatives and warnings.
    pattern
        What was looked for.
    image_size
        (columns, rows) of the images.
    seen
        The pattern in each image where it was found.
    passed_over
        Images without it, and why.
    straightness_px
        Root mean square distance of the points from straight lines: as measured, and corrected by the model.
    """

    fit: LensFit | CameraFit
    pattern: Pattern
    image_size: tuple[int, int]
    seen: tuple[Seen, ...]
    passed_over: tuple[tuple[Path, str], ...]
    straightness_px: tuple[float, float]

    @property
    def model(self) -> Lens | Camera | None:
        """What corrects images and points; None where lines are straight without."""
        return self.fit.lens if isinstance(self.fit, LensFit) else self.fit.camera

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of every parameter of the camera, by its name."""
        if isinstance(self.fit, LensFit):
            errors, values = self.fit.uncertainties, dict(zip(self.fit.names, self.fit.values, strict=True))
            return {name: (float(values[name]), error) for name, error in errors.items() if not name.startswith("v")}
        camera = self.fit.camera
        (fx, _, cx), (_, fy, cy), _ = camera.matrix
        known = {"f": fx, "fx": fx, "fy": fy, "cx": cx, "cy": cy, **dict(zip(NAMES, camera.distortion, strict=True))}
        return {name: (known[name], error) for name, error in self.fit.uncertainties.items()}

    @property
    def alternatives(self) -> tuple[Other, ...]:
        """Other models, fitted to the same points."""
        if isinstance(self.fit, CameraFit):
            return tuple(
                Other(each.model, each.rms_px, each.p_value, each.aic, each.centre, each.apart_px)
                for each in self.fit.alternatives
            )
        return tuple(
            Other(
                f"{each.model} (lines {each.lines})",
                each.rms_px,
                each.p_value,
                each.aic,
                each.centre,
                each.centre_distance_px,
            )
            for each in self.fit.alternatives
        )

    @property
    def residuals(self) -> tuple[tuple[Float64, Float64], ...]:
        """Per image the measured points (n, 2), and how far each lies off: (n, 2), or (n,) from its line [px]."""
        if isinstance(self.fit, CameraFit):
            grids = [each.grid for each in self.seen if each.grid is not None]
            return tuple((grid.reshape(-1, 2), off) for grid, off in zip(grids, self.fit.residuals, strict=True))
        left, parts = list(self.fit.residuals_px), []
        for each in self.seen:
            mine = [left.pop(0) for _ in each.families]
            points = [line for family in each.families for line in family]
            parts.append((np.concatenate(points), np.concatenate([off for family in mine for off in family])))
        return tuple(parts)

    def summary(self) -> str:
        """Return a line: what was found, how well."""
        points = sum(each.points for each in self.seen)
        before, after = self.straightness_px
        return (
            f"{self.pattern} in {len(self.seen)} of {len(self.seen) + len(self.passed_over)} images, {points} points; "
            f"model {self.fit.model}: residual {self.fit.rms_px:.3g} px rms; lines bent by {before:.3g} px, "
            f"corrected {after:.3g} px"
        )

    def report(self) -> dict[str, Any]:
        """Everything in plain numbers and strings, as JSON holds them."""
        fit = self.fit
        table: dict[str, Any] = {
            "pattern": self.pattern,
            "image_size": list(self.image_size),
            "model": fit.model,
            "rms_px": fit.rms_px,
            "straightness_px": dict(zip(("measured", "corrected"), self.straightness_px, strict=True)),
            "parameters": {k: {"value": v, "sigma": s} for k, (v, s) in self.parameters.items()},
            "covariance": {"names": list(fit.names), "matrix": fit.covariance.tolist()},
            "alternatives": [each._asdict() for each in self.alternatives],
            "warnings": list(fit.warnings),
            "images": [
                {"name": each.image.name, "rms_px": _rms(off)}
                for each, (_, off) in zip(self.seen, self.residuals, strict=True)
            ],
            "passed_over": {path.name: why for path, why in self.passed_over},
        }
        if isinstance(fit, LensFit):
            return table | {"sigma_px": fit.sigma_px, "lines": fit.lines}
        tilt = {"alpha_rad": fit.sensor.alpha, "alpha_sigma_rad": fit.alpha_sigma}
        poses = [{"rotation": p.rotation.tolist(), "translation": p.translation.tolist()} for p in fit.poses]
        return table | {"sigma_px": fit.sigma, "tilt": tilt, "poses": poses}

    def write(self, path: Path) -> None:
        """Write the model (TOML) to `path`, and beside it the report (JSON) and the picture (PNG).

        Raises
        ------
        ValueError
            There is no model to write: the lines are straight without one.
        """
        from gpuvision.calibration_picture import draw_calibration

        if self.model is None:
            raise ValueError("the lines are straight without a lens: there is nothing to correct, nothing was written")
        # Numbers that nothing fixes are infinite in the covariance; JSON and its readers know no such word.
        write_whole(path.with_suffix(".json"), json.dumps(json_tree(self.report()), indent=1) + "\n")
        draw_calibration(path.with_suffix(".png"), self)
        write_lens(
            path,
            self.model,
            {
                "image": {"size": list(self.image_size)},
                "uncertainty": {name: error for name, (_, error) in self.parameters.items()},
                "fit": {
                    "model": self.fit.model,
                    "pattern": self.pattern,
                    "rms_px": self.fit.rms_px,
                    "images": [each.image.name for each in self.seen],
                    "warnings": list(self.fit.warnings),
                },
            },
        )


def calibrate(
    images: Sequence[str | Path],
    *,
    pattern: Pattern = "dots",
    method: Method = "auto",
    model: str = "auto",
    inner: tuple[int, int] | None = None,
    pitch: float = 1.0,
    focal_length: float | None = None,
    loss: Loss = "squared",
    progress: Progress = lambda done, of: None,
) -> Calibration:
    """Calibrate a camera from images of a flat pattern.

    Parameters
    ----------
    images
        Files, all of one size and from one camera.
    pattern
        "dots", "chessboard" (its inner corners) or "lines" (a grid of crossing ones).
    method
        "lines": the lens alone, from what should be straight; "views": focal length, centre, lens and tilt of the
        sensor; "auto": views where a grid is seen in three images or the focal length is known, else lines.
    model
        "auto", or what `fit_lens` ("k1", "k1,k2") or `fit_camera` ("k1,k2", "tilt", ...) takes.
    inner
        Inner corners of the chessboard, along both sides; None: what is found.
    pitch
        Distance of neighbours on the pattern, metres; it scales nothing but the poses.
    focal_length
        f' in pixels where it is known.
    loss
        "squared"; or "huber" or "tukey", which give outliers less weight, or none.
    progress
        Told how many images are done, of how many.

    Raises
    ------
    ValueError
        Nothing was found, sizes differ, or the data lack something; the message names it.
    RecordingError
        A file is no image.
    """
    seen, passed_over, size = _look([Path(each) for each in images], pattern, inner, progress)
    grids = [each.grid for each in seen if each.grid is not None]
    if method == "auto":
        method = "views" if len(grids) >= _FEWEST_VIEWS or (grids and focal_length is not None) else "lines"
    families = tuple(family for each in seen for family in each.families)
    fit: LensFit | CameraFit
    if method == "views":
        if not grids:
            raise ValueError("lines have no points to tell views by; use --pattern dots or chessboard, or method lines")
        views = [view_of(grid, pitch) for grid in grids]
        for_views: LossName = "linear" if loss == "squared" else loss
        fit = fit_camera(views, size, model=model, focal_length=focal_length, loss=for_views)
        corrects: Any = fit.camera
    else:
        chosen: Any = model
        fit = fit_lens(families, model=chosen, loss=loss)
        corrects = fit.lens
    return Calibration(
        fit=fit,
        pattern=pattern,
        image_size=size,
        seen=tuple(seen),
        passed_over=tuple(passed_over),
        straightness_px=(straightness_px(families), straightness_px(families, corrects)),
    )


def _look(
    files: Sequence[Path], pattern: Pattern, inner: tuple[int, int] | None, progress: Progress
) -> tuple[list[Seen], list[tuple[Path, str]], tuple[int, int]]:
    """Find the pattern in every image; return where it was found, where not and why, and the images' size."""
    seen: list[Seen] = []
    passed_over: list[tuple[Path, str]] = []
    size: tuple[int, int] | None = None
    for number, file in enumerate(files):
        progress(number, len(files))
        if not file.exists():
            raise FileNotFoundError(f"{file}: there is no such file")
        image = read_image(file)
        mine = (image.shape[1], image.shape[0])
        if size is not None and mine != size:
            raise RecordingError(
                f"{file}: {mine[0]} x {mine[1]} pixels, {files[0]} has {size[0]} x {size[1]}; one camera, one size"
            )
        size = mine
        try:
            seen.append(_seen(file, image[..., :3] if image.ndim == 3 else image, pattern, inner))
        except ValueError as error:
            passed_over.append((file, str(error)))
    progress(len(files), len(files))
    if size is None:
        raise ValueError("no images given, expected at least one")
    if not seen:
        file, why = passed_over[0]
        more = f" (and {len(passed_over) - 1} more images)" if len(passed_over) > 1 else ""
        raise ValueError(f"{file}{more}: {why}")
    return seen, passed_over, size


def _seen(file: Path, image: npt.NDArray[Any], pattern: Pattern, inner: tuple[int, int] | None) -> Seen:
    if pattern == "lines":
        return Seen(file, None, find_lines(image))
    found = find_dots(image) if pattern == "dots" else find_chessboard(image, inner)
    return Seen(file, found.points, grid_lines(found.points))


def _rms(off: Float64) -> float:
    """Root mean square size of residuals (n, 2) or (n,)."""
    return float(np.sqrt(np.nanmean(np.sum(off.reshape(len(off), -1) ** 2, axis=1))))
