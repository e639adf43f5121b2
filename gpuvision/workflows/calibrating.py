"""Camera calibration from image files of a flat target pattern, with uncertainties, alternatives and warnings.

`fit_lens` finds the lens distortion from straight lines; one image is enough. `fit_camera` finds focal length, centre,
distortion and sensor tilt from three views of a grid, or from one view and a known focal length.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import Calibration, DetectedTarget, TargetPattern, image_coverage
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.line_statistics import Loss
from gpuvision.camera.lines.vanishing_points import fit_lens, straightness_px
from gpuvision.camera.patterns.chessboard import find_chessboard
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from gpuvision.camera.views.camera_fit import CameraFit
from gpuvision.camera.views.planar_calibration import fit_camera
from gpuvision.camera.views.target_views import make_view
from gpuvision.formats.camera_file import covariance_table, write_lens
from gpuvision.formats.json import json_tree, report_text
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import write_text_atomic
from gpuvision.host.image_files import read_image
from gpuvision.host.outputs import Outputs
from gpuvision.plots.calibration import draw_calibration

# Points, and part of the image that they cover, from which "no lens distortion" may be concluded. Derived: a grid of
# 5 x 5 points leaves 10 numbers after its lines; distortion grows with the third power of the radius, so a target over
# less than a quarter of the image (half its radius) sees less than an eighth of the displacement.
_MIN_POINTS = 25
_MIN_COVERAGE = 0.25

Method = Literal["auto", "lines", "views"]
Progress = Callable[[int, int | None], object]

# Views of a plane that fix focal length and centre without a starting value (Zhang's closed form).
_MIN_VIEWS = 3


def calibrate(
    images: Sequence[str | Path],
    *,
    pattern: TargetPattern = "dots",
    method: Method = "auto",
    model: str = "auto",
    inner_corners: tuple[int, int] | None = None,
    pitch: float | None = None,
    focal_length: float | None = None,
    loss: Loss = "squared",
    progress: Progress = lambda done, of: None,
) -> Calibration:
    """Calibrate a camera from images of a flat target pattern.

    Parameters
    ----------
    images : sequence of path
        Image files of one camera, all of one size.
    pattern : {"dots", "chessboard", "lines"}
        Target pattern: a grid of dots (default), a chessboard, or a grid of crossing lines.
    method : {"auto", "lines", "views"}
        "lines": lens distortion only, from straight lines. "views": focal length, centre, lens and sensor tilt from
        views of a grid. "auto" (default): views if a grid is detected in three images or more, or in one image and
        ``focal_length`` is given; otherwise lines.
    model : str
        "auto" (default): the smallest model that an F test accepts. Otherwise a model of `fit_lens` ("none", "k1",
        "k1,k2", "k1,k2,k3", "k1,k2,k3,k4") or of `fit_camera` ("k1,k2", "tilt", ...).
    inner_corners : (int, int), optional
        Inner corners of the chessboard along its two sides, in any order. Default: accept any number.
    pitch : float, optional
        Distance between neighbouring points on the target [m]. It scales the poses only. Default 1. Method "lines" has
        no poses.
    focal_length : float, optional
        Known focal length f' [px]. Default: estimated.
    loss : {"squared", "huber", "tukey"}
        Loss of a residual. "huber" and "tukey" reduce the weight of outliers. Default "squared".
    progress : callable
        Called with the number of processed images and the number of images.

    Returns
    -------
    Calibration

    Raises
    ------
    FileNotFoundError
        A file does not exist.
    ValueError
        No target pattern was detected, or the points do not fix the model; the message names the missing data. Or
        `pitch` or `focal_length` is given, and the method is "lines" or ends in it.
    RecordingError
        A file is no image, or the images differ in size.
    """
    detected, skipped_images, size = detect_targets([Path(each) for each in images], pattern, inner_corners, progress)
    grids = [each.grid for each in detected if each.grid is not None]
    if method == "auto":
        method = "views" if len(grids) >= _MIN_VIEWS or (grids and focal_length is not None) else "lines"
    if method == "lines":
        for name, given in (("pitch", pitch), ("focal_length", focal_length)):
            if given is not None:
                raise ValueError(
                    f"{name} has no effect with method 'lines', which finds no poses ('auto' takes it with fewer than "
                    f"{_MIN_VIEWS} images of a grid); leave it out, give more images, or take method 'views'"
                )
    families = tuple(family for each in detected for family in each.families)
    fit: LensFit | CameraFit
    if method == "views":
        if not grids:
            raise ValueError(
                "method 'views' needs a grid of points, a line pattern has none; use pattern 'dots' or 'chessboard', "
                "or method 'lines'"
            )
        views = [make_view(grid, 1.0 if pitch is None else pitch) for grid in grids]
        fit = fit_camera(views, size, model=model, focal_length=focal_length, loss=loss)
        correction: Lens | Camera | None = fit.camera
    else:
        lens_model: Any = model
        fit = fit_lens(families, model=lens_model, loss=loss)
        correction = fit.lens
        if correction is None and model == "auto":
            _check_enough_to_judge(detected, size, pattern)
    return Calibration(
        fit=fit,
        pattern=pattern,
        image_size=size,
        detected_targets=tuple(detected),
        skipped_images=tuple(skipped_images),
        straightness_px=(straightness_px(families), straightness_px(families, correction)),
    )


def _check_enough_to_judge(detected: Sequence[DetectedTarget], size: tuple[int, int], pattern: TargetPattern) -> None:
    """Refuse to say that no correction is needed if few points, or a small part of the image, were seen.

    Raises
    ------
    ValueError
        Fewer than `_MIN_POINTS` points, or a coverage below `_MIN_COVERAGE`.
    """
    points, coverage = sum(each.points for each in detected), image_coverage(detected, size)
    if points < _MIN_POINTS or coverage < _MIN_COVERAGE:
        raise ValueError(
            f"{pattern} found in {len(detected)} images: {points} points over {100.0 * coverage:.0f} % of the image, "
            f"too few to tell whether the lens distorts; expected {_MIN_POINTS} points over "
            f"{100.0 * _MIN_COVERAGE:.0f} %. Is this the pattern of the target?"
        )


def detect_targets(
    files: Sequence[Path], pattern: TargetPattern, inner_corners: tuple[int, int] | None, progress: Progress
) -> tuple[list[DetectedTarget], list[tuple[Path, str]], tuple[int, int]]:
    """Detect the target pattern in every image.

    Parameters
    ----------
    files : sequence of Path
        Image files of one camera, all of one size. An image with the same pixels as an earlier one is skipped.
    pattern, inner_corners, progress
        As in `calibrate`.

    Returns
    -------
    list of DetectedTarget
        Detected patterns, in the order of the files.
    list of (Path, str)
        Skipped images, each with the reason.
    (int, int)
        Columns and rows of the images.

    Raises
    ------
    FileNotFoundError, ValueError, RecordingError
        As `calibrate`.
    """
    detected: list[DetectedTarget] = []
    skipped_images: list[tuple[Path, str]] = []
    size: tuple[int, int] | None = None
    seen: dict[bytes, Path] = {}
    for number, file in enumerate(files):
        progress(number, len(files))
        if not file.exists():
            raise FileNotFoundError(f"{file}: no such file")
        image = read_image(file)
        image_size = (image.shape[1], image.shape[0])
        if size is not None and image_size != size:
            raise RecordingError(
                f"{file}: {image_size[0]} x {image_size[1]} pixels, {files[0]} has {size[0]} x {size[1]}; give images "
                "of one camera, all of one size"
            )
        size = image_size
        # An image given twice adds no information, but counts twice and makes the uncertainties too small.
        first = seen.setdefault(hashlib.sha256(np.ascontiguousarray(image).data).digest(), file)
        if first is not file:
            skipped_images.append((file, f"it has the same pixels as {first}"))
            continue
        try:
            detected.append(_detect(file, image[..., :3] if image.ndim == 3 else image, pattern, inner_corners))
        except ValueError as error:
            skipped_images.append((file, str(error)))
    progress(len(files), len(files))
    if size is None:
        raise ValueError("no images given, expected at least one")
    if not detected:
        file, reason = skipped_images[0]
        more = f" (and {len(skipped_images) - 1} more images)" if len(skipped_images) > 1 else ""
        raise ValueError(f"{file}{more}: {reason}")
    return detected, skipped_images, size


def _detect(
    file: Path, image: npt.NDArray[Any], pattern: TargetPattern, inner_corners: tuple[int, int] | None
) -> DetectedTarget:
    """Detect the target pattern in one image."""
    if pattern == "lines":
        return DetectedTarget(file, None, find_lines(image))
    found = find_dots(image) if pattern == "dots" else find_chessboard(image, inner_corners)
    return DetectedTarget(file, found.points, grid_lines(found.points))


def calibration_files(path: Path) -> tuple[Path, Path, Path]:
    """Return the files that `write_calibration` writes: camera file, report and plot."""
    return path, path.with_suffix(".json"), path.with_suffix(".png")


def write_calibration(calibration: Calibration, path: Path, *, overwrite: bool = False) -> None:
    """Write the camera file (TOML), report (.json) and plot (.png) into one folder; after an error no file is written.

    Parameters
    ----------
    calibration : Calibration
        Result of `calibrate`.
    path : Path
        Camera file to write.
    overwrite : bool
        Whether files may be replaced that no earlier calibration wrote. Default False. The calibrated images are never
        replaced.

    Raises
    ------
    ValueError
        The calibration has no model: the lines are straight without a lens.
    FileExistsError
        A file is an image of the calibration; or it exists, and is not an unchanged output of an earlier calibration;
        see `gpuvision.host.outputs`.
    """
    if calibration.model is None:
        raise ValueError("the lines are straight without a lens; no correction is needed, nothing was written")
    # The covariance of parameters that the data do not fix is infinite; json_tree replaces it, since JSON has no
    # infinity.
    report = report_text(json_tree(calibration.report()))
    documentation: dict[str, dict[str, Any]] = {
        "image": {"size": list(calibration.image_size)},
        "uncertainty": {name: error for name, (_, error) in calibration.parameters.items()},
        "fit": {
            "model": calibration.fit.model,
            "pattern": calibration.pattern,
            "rms_px": calibration.fit.rms_px,
            "images": [each.image.name for each in calibration.detected_targets],
            "warnings": list(calibration.fit.warnings),
        },
    }
    if isinstance(calibration.fit, CameraFit):
        documentation["covariance"] = covariance_table(calibration.fit.names, calibration.fit.covariance)
    images = [each.image for each in calibration.detected_targets] + [each for each, _ in calibration.skipped_images]
    outputs = Outputs("calibrate", inputs=images, overwrite=overwrite)
    with outputs.folder(path.parent) as inside:
        camera_file, report_file, plot = calibration_files(inside / path.name)
        write_text_atomic(report_file, report)
        draw_calibration(plot, calibration)
        write_lens(camera_file, calibration.model, documentation)
