"""Images of a flat pattern become a camera model, with uncertainties, alternatives and warnings.

From straight lines (`fit_lens`) the lens alone follows, from one image on; from three views of a grid, or one and the
focal length, the whole camera with a tilted sensor (`fit_camera`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt

from gpuvision.camera.calibration import Calibration, Pattern, Seen
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.line_statistics import Loss
from gpuvision.camera.lines.vanishing_points import fit_lens, straightness_px
from gpuvision.camera.patterns.chessboard import find_chessboard
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from gpuvision.camera.views.camera_fit import CameraFit
from gpuvision.camera.views.planar_calibration import LossName, fit_camera
from gpuvision.camera.views.target_views import make_view
from gpuvision.formats.camera_file import write_lens
from gpuvision.formats.json import json_tree
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import write_whole
from gpuvision.host.recordings import read_image
from gpuvision.plots.calibration import draw_calibration

Method = Literal["auto", "lines", "views"]
Progress = Callable[[int, int | None], object]

_FEWEST_VIEWS = 3


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
        views = [make_view(grid, pitch) for grid in grids]
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


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write the model (TOML) to `path`, and beside it the report (JSON) and the picture (PNG).

    Raises
    ------
    ValueError
        There is no model to write: the lines are straight without one.
    """
    if calibration.model is None:
        raise ValueError("the lines are straight without a lens: there is nothing to correct, nothing was written")
    # Numbers that nothing fixes are infinite in the covariance; JSON and its readers know no such word.
    write_whole(path.with_suffix(".json"), json.dumps(json_tree(calibration.report()), indent=1) + "\n")
    draw_calibration(path.with_suffix(".png"), calibration)
    write_lens(
        path,
        calibration.model,
        {
            "image": {"size": list(calibration.image_size)},
            "uncertainty": {name: error for name, (_, error) in calibration.parameters.items()},
            "fit": {
                "model": calibration.fit.model,
                "pattern": calibration.pattern,
                "rms_px": calibration.fit.rms_px,
                "images": [each.image.name for each in calibration.seen],
                "warnings": list(calibration.fit.warnings),
            },
        },
    )
