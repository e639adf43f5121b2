"""Calibration of a laser sensor from image files: camera, sheet of light and transport in one sensor file.

Images of a target in several poses calibrate the camera (`gpuvision.workflows.calibrating`), or a camera file gives the
camera, and the images only the poses. A second image of each pose with the laser on gives points of the sheet of light.
Images of the target on the moving stage give the direction
and the step of the transport.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import DetectedTarget, TargetPattern
from gpuvision.camera.lines.line_statistics import Loss
from gpuvision.camera.views.target_views import make_view
from gpuvision.formats.known_points_file import read_known_points
from gpuvision.host import Device
from gpuvision.host.channels import Channel
from gpuvision.host.image_files import image_files
from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_calibration import fit_sheet
from gpuvision.ranging.sheet_from_points import sheet_from_points
from gpuvision.ranging.sheet_readings import DEFAULT_LIMITS, Along, LaserLine
from gpuvision.ranging.sheet_result import SheetFit
from gpuvision.ranging.transport_calibration import TransportFit, fit_transport
from gpuvision.validation import finite
from gpuvision.workflows.calibrating import detect_targets
from gpuvision.workflows.laser_images import (
    ImagePairs,
    LightImage,
    LineImage,
    image_light,
    line_direction,
    pair_images,
    read_block,
    read_line,
    target_light,
)
from gpuvision.workflows.sensor_calibration_result import SensorCalibration
from gpuvision.workflows.sensor_camera import DetectedViews, SensorCamera, fitted_camera, known_camera, known_grid

Float64 = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]

# Share of the readings of a view that the sheet rejects, above which a warning names the view (chosen).
_MANY_OUTLIERS = 0.5
# Number of laser images from which the direction of the line is estimated. Chosen.
_FIRST = 3
# Reduced chi-square of views above which a warning says that they disagree (chosen: three times the predicted scatter).
_DISAGREEMENT = 9.0


@dataclass(frozen=True, kw_only=True)
class TransportViews:
    """Images of the target on the moving stage.

    Attributes
    ----------
    folder : Path
        Folder of the images, in natural order of their names. The whole target is in view, and the stage moves by the
        same number of profiles from each image to the next one.
    profiles_between : float
        Number of profiles between two images; with an encoder, the movement divided by the movement per profile.
    on_stage : bool
        Whether the target lies on the surface of the stage: this surface is then z = 0. Default False.
    """

    folder: Path
    profiles_between: float
    on_stage: bool = False


@dataclass(frozen=True, kw_only=True)
class BlockViews:
    """Images of a stepped block on the stage, which give the sheet of light without laser images of the target.

    Attributes
    ----------
    folder : Path
        Folder with a pair of images for each place of the block: ``block1.png`` and ``block1_laser.png``.
    heights : tuple of float
        Heights of the lit steps over the plane of the target in the transport views [m], in the order of the samples of
        the line. The steps are parallel to the stage.
    """

    folder: Path
    heights: tuple[float, ...]


def calibrate_sensor(
    images: Sequence[str | Path],
    *,
    pitch: float,
    camera: str | Path | None = None,
    laser: str | Path | None = None,
    transport: TransportViews | None = None,
    block: BlockViews | None = None,
    points: str | Path | None = None,
    step: float | None = None,
    pattern: TargetPattern = "dots",
    model: str = "auto",
    inner_corners: tuple[int, int] | None = None,
    focal_length: float | None = None,
    loss: Loss = "squared",
    along: Along | None = None,
    channel: Channel = "grey",
    name: str = "",
    device: Device | None = None,
    progress: Progress = lambda done, of: None,
) -> SensorCalibration:
    """Calibrate camera, sheet of light and transport of a laser sensor from images of a flat target.

    Parameters
    ----------
    images : sequence of path
        Images of the target in different poses, and without a folder `laser` the laser images of the same poses
        (``pose1.png``, ``pose1_laser.png``).
    pitch : float
        Distance between neighbouring points on the target [m].
    camera : path, optional
        Camera file with a table ``[camera]`` of this camera, as ``gpuvision calibrate`` writes it. The images then give
        the poses of the target alone; the covariance of the file enters the joint covariance. Default: the images
        calibrate the camera.
    laser : path, optional
        Folder of the laser images, matched by name or by the last number in the name.
    transport : TransportViews, optional
        Images of the target on the moving stage. Default: the transport is perpendicular to the sheet.
    block : BlockViews, optional
        Images of a stepped block on the stage; they need `transport`, which gives the plane of the stage. Laser images
        of the target may be given as well, and need not.
    points : path, optional
        CSV file ``column,row,x,y,z`` of points of the sheet: pixels, and places in the frame of a fixture [m]. They
        give a flat sheet, instead of laser images.
    step : float, optional
        Transport per profile [m]; required without `transport`, which measures it. The part moves along -(g x h) of the
        sheet, or along g x h if the step is negative.
    pattern, model, inner_corners, focal_length, loss
        As in `gpuvision.workflows.calibrating.calibrate`; the pattern is a grid ("dots" or "chessboard"). A camera
        file replaces `model`, `focal_length` and `loss`.
    along : {"columns", "rows"}, optional
        Image axis along which the laser line runs. Default: found in the images.
    channel : str
        Channel of colour images that holds the laser. Default "grey".
    name : str
        Name of the sensor.
    device : Device, optional
        Device of the line readout. Default: the best.
    progress : callable
        Called with the number of processed images and the number of images.

    Returns
    -------
    SensorCalibration

    Raises
    ------
    FileNotFoundError
        A file does not exist.
    ValueError
        The images do not determine the sensor; the message names the missing data.
    RecordingError
        A file is no image, or the images differ in size.
    """
    _check_settings(pattern, transport, block, step)
    if camera is not None and (model != "auto" or focal_length is not None or loss != "squared"):
        raise ValueError("a camera file replaces the calibration of the camera: leave out model, focal_length and loss")
    folder = None if laser is None else Path(laser)
    pairs = pair_images([Path(each) for each in images], folder, required=block is None and points is None)
    if points is not None and (block is not None or any(pairs.lasers)):
        raise ValueError("known points replace laser images and the block; give one of them")
    moved = [] if transport is None else image_files(transport.folder)
    detected, skipped, size = detect_targets([*pairs.targets, *moved], pattern, inner_corners, progress)
    _check_transport_targets(detected, skipped, moved)
    views = DetectedViews(pattern, pitch, tuple(detected), tuple(skipped), size)
    if camera is None:
        found = fitted_camera(views, model=model, focal_length=focal_length, loss=loss)
    else:
        found = known_camera(views, Path(camera))
    if points is None:
        lit = _lit_targets(detected, dict(zip(pairs.targets, pairs.lasers, strict=True)), at_least=0 if block else 2)
        light = _read_light(lit, block, along, channel, device)
        sheet = _fit_light(light, found, moved)
    else:
        light, sheet = _sheet_of_points(Path(points), found, along)
    motion = None if transport is None else _motion(transport, views, found, moved)
    geometry = SensorGeometry(
        camera=found.camera,
        camera_names=found.names,
        camera_covariance=found.covariance,
        sheet=sheet,
        transport=motion,
        step=motion.length if motion is not None else float(step or 0.0),
        zero_at_stage=transport is not None and transport.on_stage,
    )
    return SensorCalibration(
        name=name,
        calibration=found.calibration,
        geometry=geometry,
        along=light.along,
        channel=channel,
        lines=tuple(light.lines.get(each.image) for each in detected),
        other_lines=light.others,
        cell=_cell(geometry, light.readings, light.along),
        warnings=(*found.calibration.warnings, *_warnings(geometry, light.readings)),
    )


def _check_settings(
    pattern: TargetPattern, transport: TransportViews | None, block: BlockViews | None, step: float | None
) -> None:
    """Refuse settings that miss each other or determine no sensor."""
    if pattern == "lines":
        raise ValueError("pattern 'lines' gives no poses of the target; use 'dots' or 'chessboard'")
    if (transport is None) == (step is None):
        raise ValueError("give either transport views, which measure the step, or the step [m per profile]")
    if step is not None and (step == 0.0 or not math.isfinite(step)):
        raise ValueError(f"step is {step}, expected metres per profile, not 0")
    if block is not None and transport is None:
        raise ValueError("a block needs transport views: they show the plane of the stage that carries it")
    if block is not None and len(block.heights) < 2:
        raise ValueError(f"the block has {len(block.heights)} height, expected the heights of at least two steps")
    if transport is not None and finite(transport.profiles_between, "profiles_between") == 0.0:
        raise ValueError("profiles_between is 0, expected the number of profiles from one transport view to the next")


class _Light(NamedTuple):
    """Laser lines of all images: on targets by target image, and on a block with the heights of the readings."""

    along: Along
    lines: dict[Path, LineImage]
    blocks: tuple[tuple[LineImage, Float64], ...]
    points: LineImage | None = None

    @property
    def others(self) -> tuple[LineImage, ...]:
        """Readings that are not on a target."""
        return (*(line for line, _ in self.blocks), *(() if self.points is None else (self.points,)))

    @property
    def readings(self) -> tuple[LineImage, ...]:
        """All readings, in the order of the residuals of the sheet."""
        return (*self.lines.values(), *self.others)


def _read_light(
    lit: Sequence[tuple[DetectedTarget, Path]],
    block: BlockViews | None,
    along: Along | None,
    channel: Channel,
    device: Device | None,
) -> _Light:
    """Read the laser lines on targets and block."""
    steps = None if block is None else pair_images(image_files(block.folder), None)
    if along is None:
        along = line_direction(_first_lights(lit, steps, channel))
    lines = {
        each.image: read_line(target_light(each, file, channel), file, along=along, device=device) for each, file in lit
    }
    blocks = () if block is None or steps is None else _other_lines(steps, block, along, channel, device)
    return _Light(along, lines, blocks)


def _fit_light(light: _Light, found: SensorCamera, moved: Sequence[Path]) -> SheetFit:
    """Fit the sheet to the laser lines; the first transport view has the plane of the block."""
    lines = [
        *(LaserLine(line.points, found.targets[image]) for image, line in light.lines.items()),
        *(LaserLine(line.points, found.targets[moved[0]], heights) for line, heights in light.blocks),
    ]
    return fit_sheet(found.camera, lines, along=light.along, names=found.names, camera_covariance=found.covariance)


def _sheet_of_points(file: Path, found: SensorCamera, along: Along | None) -> tuple[_Light, SheetFit]:
    """Fit the sheet to the known points of a file."""
    pixels, places = read_known_points(file)
    if along is None:
        along = "columns" if np.var(pixels[:, 0]) >= np.var(pixels[:, 1]) else "rows"
    sheet = sheet_from_points(found.camera, places, pixels, along=along, names=found.names)
    return _Light(along, {}, (), LineImage(image=file, points=pixels, threshold=math.nan, note="")), sheet


def _first_lights(
    lit: Sequence[tuple[DetectedTarget, Path]], block: ImagePairs | None, channel: Channel
) -> Iterator[LightImage]:
    """Yield the light of some laser images, for the direction of the line."""
    for target, file in lit[:_FIRST]:
        yield target_light(target, file, channel)
    if block is not None:
        for dark, laser in _pairs(block)[:_FIRST]:
            yield image_light(dark, laser, channel)


def _pairs(images: ImagePairs) -> list[tuple[Path, Path]]:
    return [(dark, laser) for dark, laser in zip(images.targets, images.lasers, strict=True) if laser is not None]


def _other_lines(
    images: ImagePairs, block: BlockViews, along: Along, channel: Channel, device: Device | None
) -> tuple[tuple[LineImage, Float64], ...]:
    """Read the laser lines on the block; return each with the heights of its readings."""
    found = []
    for dark, laser in _pairs(images):
        light = image_light(dark, laser, channel)
        line, step = read_block(light, laser, len(block.heights), along=along, device=device)
        found.append((line, np.array(block.heights)[step]))
    return tuple(found)


def _motion(
    transport: TransportViews, views: DetectedViews, found: SensorCamera, moved: Sequence[Path]
) -> TransportFit:
    """Fit the transport to the poses of the transport views."""
    first = next(each for each in views.detected if each.image == moved[0])
    middle = make_view(known_grid(first), views.pitch).target.mean(axis=0)
    targets = [found.targets[each] for each in moved]
    return fit_transport(targets, np.arange(len(targets)) * transport.profiles_between, middle)


def _check_transport_targets(
    detected: Sequence[DetectedTarget], skipped: Sequence[tuple[Path, str]], moved: Sequence[Path]
) -> None:
    """Refuse transport views without the whole target: its points would get other numbers, and the target a shift."""
    reasons = dict(skipped)
    shapes = {}
    for file in moved:
        if file in reasons:
            raise ValueError(f"{file}: the transport needs the target in every view of its folder; {reasons[file]}")
        grid = next(known_grid(each) for each in detected if each.image == file)
        shapes[file] = grid.shape[:2]
        if shapes[file] != shapes[moved[0]] or not np.isfinite(grid).all():
            raise ValueError(
                f"{file}: {np.count_nonzero(np.isfinite(grid[..., 0]))} points in a grid of {grid.shape[1]} x "
                f"{grid.shape[0]}, {moved[0].name} shows {shapes[moved[0]][1]} x {shapes[moved[0]][0]}; the transport "
                "needs the whole target in every view"
            )


def _lit_targets(
    detected: Sequence[DetectedTarget], lasers: dict[Path, Path | None], *, at_least: int
) -> list[tuple[DetectedTarget, Path]]:
    """Return the detected targets that have a laser image."""
    found = []
    for each in detected:
        laser = lasers.get(each.image)
        if laser is not None:
            found.append((each, laser))
    if len(found) < at_least:
        raise ValueError(
            f"{len(found)} target images with a laser image show the target, expected two at least, at different "
            "distances"
        )
    return found


def _cell(geometry: SensorGeometry, lines: Sequence[LineImage], along: Along) -> float:
    """Return a cell size: the larger one of the step and the distance of samples, rounded up to two digits [m]."""
    middle = np.median(np.concatenate([each.points for each in lines]), axis=0)
    ahead = np.array([1.0, 0.0] if along == "columns" else [0.0, 1.0])
    sample = float(np.linalg.norm(geometry.points(middle + ahead) - geometry.points(middle)))
    largest = max(sample, abs(geometry.step))
    digit = 10.0 ** (math.floor(math.log10(largest)) - 1)
    return float(f"{math.ceil(largest / digit) * digit:.2g}")


def _warnings(geometry: SensorGeometry, lines: Sequence[LineImage]) -> list[str]:
    """Return doubts about sheet and transport."""
    warnings = [f"{each.image.name}: {each.note}" for each in lines if each.note]
    sheet, transport = geometry.sheet, geometry.transport
    for each, residual in zip(lines, sheet.residuals, strict=True):
        if 0 < len(residual) < DEFAULT_LIMITS.min_readings and np.isnan(residual).all():
            warnings.append(
                f"{each.image.name}: the line has {len(residual)} readings, the sheet uses lines of "
                f"{DEFAULT_LIMITS.min_readings} or more"
            )
        elif len(residual) and np.mean(np.isnan(residual)) > _MANY_OUTLIERS:
            warnings.append(
                f"{each.image.name}: the sheet rejects {np.count_nonzero(np.isnan(residual))} of {len(residual)} "
                "readings; check that the target did not move between its two images"
            )
    if sheet.view_ratio > _DISAGREEMENT:
        warnings.append(
            f"the laser lines scatter {math.sqrt(sheet.view_ratio):.1f} times as much from view to view as readings "
            "and poses predict; the uncertainties include it"
        )
    if not sheet.converged:
        warnings.append(
            "the fit of the sheet stopped before it converged; its uncertainties are computed at the last iteration"
        )
    if transport is None:
        warnings.append(
            "no transport views: the part is assumed to move along -(g x h), perpendicular to the sheet; a negative "
            "step reverses it"
        )
    elif transport.view_ratio > _DISAGREEMENT:
        warnings.append(
            f"the transport views scatter {math.sqrt(transport.view_ratio):.1f} times as much about a straight uniform "
            "motion as their poses predict; the uncertainties include it"
        )
    return warnings
