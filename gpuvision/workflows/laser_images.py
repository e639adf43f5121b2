"""Laser images of a sensor calibration: pairs of images of one target pose, and the laser line on the target."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import DetectedTarget
from gpuvision.host import Device, to_numpy
from gpuvision.host.channels import Channel
from gpuvision.host.errors import RecordingError
from gpuvision.host.image_files import image_files, read_frame
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.ranging.background import line_threshold, noise_threshold
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet_readings import Along

SUFFIX = "_laser"
"""End of the name of a laser image: ``pose1_laser.png`` shows the target of ``pose1.png`` with the laser on."""

# Samples of the window of the readout on either side of the peak, and distance of a used reading from the hull of the
# target's points [px]: the border of the target must not cut the window.
_WINDOW = 8
_BORDER = _WINDOW

# Readings on either side of an edge of a block that decide on a step (chosen: the median ignores four wrong ones).
_STEP_WINDOW = 9
# Least jump at an edge [standard deviations of the difference of two readings]. Derived: 1e-6 by chance.
_LEAST_JUMP = 5.0
# Readings left out on either side of an edge: both levels lie in the window of the readout, or the edge is round.
_EDGE = 6
# Standard deviation of a normal distribution over its median absolute deviation.


class LightImage(NamedTuple):
    """Light of the laser in a pair of images.

    Attributes
    ----------
    light : numpy.ndarray
        (rows, columns) float32: laser image less the image without laser [grey levels].
    inside : numpy.ndarray
        (rows, columns) bool: pixels in which the line is read.
    saturated : numpy.ndarray
        (rows, columns) bool: saturated pixels of the laser image.
    """

    light: npt.NDArray[np.float32]
    inside: npt.NDArray[np.bool_]
    saturated: npt.NDArray[np.bool_]


class ImagePairs(NamedTuple):
    """Target images, and the laser image of the pose of each of them (None without one)."""

    targets: tuple[Path, ...]
    lasers: tuple[Path | None, ...]


@dataclass(frozen=True, kw_only=True)
class LineImage:
    """Laser line on a target.

    Attributes
    ----------
    image : Path
        Laser image.
    points : numpy.ndarray
        (n, 2): measured (column, row) [px] within the target.
    threshold : float
        Threshold of the readout [grey levels], above the target image.
    note : str
        Empty, or the reason why there are few readings.
    """

    image: Path
    points: npt.NDArray[np.float64]
    threshold: float
    note: str


def pair_images(images: Sequence[Path], laser: Path | None, *, required: bool = True) -> ImagePairs:
    """Pair each target image with the laser image of the same pose.

    Parameters
    ----------
    images : sequence of Path
        Target images; without a folder `laser` also the laser images, whose names end in ``_laser``.
    laser : Path, optional
        Folder of the laser images: with the names of the target images, with or without ``_laser``, or with the same
        last number.
    required : bool
        Whether one target image at least needs a laser image. Default True.

    Returns
    -------
    ImagePairs

    Raises
    ------
    ValueError
        A laser image has no target image or is a target image, or none of the target images has a laser image.
    RecordingError
        The folder has no images.
    """
    lasers = image_files(laser) if laser is not None else [each for each in images if each.stem.endswith(SUFFIX)]
    targets = [each for each in images if laser is not None or not each.stem.endswith(SUFFIX)]
    found: dict[Path, Path] = {}
    known = {each.resolve() for each in targets}
    for each in lasers:
        if each.resolve() in known:
            raise ValueError(
                f"{each} is a target image and a laser image; give the laser images a folder for them alone"
            )
        fitting = [target for target in targets if _is_pair(target, each)]
        if len(fitting) != 1:
            raise ValueError(
                f"{each} is the laser image of {len(fitting)} target images, expected one; name it like its target "
                f"image with {SUFFIX} before the suffix"
            )
        if fitting[0] in found:
            raise ValueError(f"{fitting[0]} has two laser images, {found[fitting[0]]} and {each}; give one for a pose")
        found[fitting[0]] = each
    if not found and required:
        raise ValueError(
            f"no laser images; give pairs such as pose1.png and pose1{SUFFIX}.png, or the folder of the laser images "
            "with --laser"
        )
    return ImagePairs(tuple(targets), tuple(found.get(each) for each in targets))


def _is_pair(target: Path, laser: Path) -> bool:
    stem = laser.stem.removesuffix(SUFFIX)
    if stem == target.stem:
        return True
    if laser.parent == target.parent:
        return False
    numbers = [re.findall(r"\d+", each) for each in (target.stem, stem)]
    return bool(numbers[0] and numbers[1]) and int(numbers[0][-1]) == int(numbers[1][-1])


def line_direction(images: Iterable[LightImage]) -> Along:
    """Return the image axis along which the laser line runs: the longer principal axis of its light."""
    total = np.zeros(2)
    for light, inside, _ in images:
        threshold = noise_threshold(light[inside], integer=False)
        rows, columns = np.nonzero(inside & (light > max(threshold, 0.25 * float(light[inside].max()))))
        if rows.size:
            total += np.array([np.var(columns), np.var(rows)])
    return "columns" if total[0] >= total[1] else "rows"


def read_line(images: LightImage, laser: Path, *, along: Along, device: Device | None) -> LineImage:
    """Read the laser line in the difference of two images.

    Parameters
    ----------
    images : LightImage
        Light of the laser, see `target_light` and `image_light`.
    laser : Path
        Laser image, for the report.
    along : {"columns", "rows"}
        Image axis along which the line runs.
    device : Device, optional
        Device of the readout. Default: the best.

    Returns
    -------
    LineImage
    """
    difference, inside, saturated = images
    threshold = noise_threshold(difference[inside], integer=False)
    near = cv2.dilate(inside.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8)) > 0
    light = np.where(near, np.clip(difference, 0.0, None), np.float32(0.0))
    profiles = light.T if along == "columns" else light
    threshold = line_threshold(profiles[None], threshold)
    readout = LineReadout(along=along, window=_WINDOW, threshold=threshold, outputs=("position", "status"))
    reading = readout(light, device=device)
    position, status = to_numpy(reading.position).astype(np.float64), to_numpy(reading.status)
    samples = np.arange(len(position), dtype=np.float64)
    points = np.stack([samples, position] if along == "columns" else [position, samples], axis=1)
    points = points[status == 0]
    core = cv2.erode(inside.astype(np.uint8), np.ones((2 * _BORDER + 1,) * 2, np.uint8)) > 0
    column, row = np.rint(points).astype(int).T
    within, clipped = core[row, column], saturated[row, column]
    note = "" if within.any() else "no laser line was found"
    if np.count_nonzero(within & clipped) > np.count_nonzero(within & ~clipped):
        note = f"{np.count_nonzero(within & clipped)} readings are saturated; take the laser images with less light"
    return LineImage(image=laser, points=points[within & ~clipped], threshold=threshold, note=note)


def read_block(
    images: LightImage, laser: Path, steps: int, *, along: Along, device: Device | None
) -> tuple[LineImage, npt.NDArray[np.intp]]:
    """Read the laser line on a stepped block.

    Parameters
    ----------
    images, laser, along, device
        As for `read_line`.
    steps : int
        Number of steps of the block along the line, two at least.

    Returns
    -------
    LineImage
        Readings on the steps; readings near the edges are left out.
    numpy.ndarray
        (n,): number of the step of each reading, from 0 along the image axis of the line.

    Raises
    ------
    ValueError
        The line does not show this number of steps.
    """
    found = read_line(images, laser, along=along, device=device)
    try:
        inside, step = split_steps(found.points if along == "columns" else found.points[:, ::-1], steps)
    except ValueError as error:
        raise ValueError(f"{laser}: {error}") from error
    return replace(found, points=found.points[inside]), step


def split_steps(points: npt.ArrayLike, steps: int) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.intp]]:
    """Split the readings of a line at the largest jumps of their position.

    Parameters
    ----------
    points : array_like
        (n, 2): sample and position of the readings, in the order of the samples.
    steps : int
        Number of steps, two at least.

    Returns
    -------
    numpy.ndarray
        (n,) bool: readings on a step, not near an edge.
    numpy.ndarray
        Number of the step of each of these readings.

    Raises
    ------
    ValueError
        There are fewer jumps above the noise.
    """
    sample, position = np.asarray(points, dtype=np.float64).T
    if len(sample) <= 2 * _STEP_WINDOW * steps:
        raise ValueError(f"{len(sample)} readings of the laser line, too few for {steps} steps")
    slopes = np.diff(position) / np.diff(sample)
    level = position - np.median(slopes) * sample
    windows = np.median(np.lib.stride_tricks.sliding_window_view(level, _STEP_WINDOW), axis=1)
    # Jump between the readings i - 1 and i, from the medians of a window before and a window after it.
    jump = np.abs(windows[_STEP_WINDOW:] - windows[:-_STEP_WINDOW])
    noise = MAD_TO_SIGMA * float(np.median(np.abs(slopes - np.median(slopes))))
    edges: list[int] = []
    for _ in range(steps - 1):
        place = int(np.argmax(jump))
        if jump[place] <= _LEAST_JUMP * noise:
            raise ValueError(f"the laser line has {len(edges)} steps up or down, expected {steps - 1}")
        edges.append(place + _STEP_WINDOW)
        jump[max(place - _STEP_WINDOW, 0) : place + _STEP_WINDOW + 1] = 0.0
    numbers = np.arange(len(sample))
    step = np.searchsorted(np.sort(edges), numbers, side="right")
    inside = np.min(np.abs(numbers[:, None] + 0.5 - np.array(edges)), axis=1) > _EDGE
    return inside, step[inside]


def target_light(target: DetectedTarget, laser: Path, channel: Channel) -> LightImage:
    """Return the light of the laser on a target, to be read within the target's points.

    Parameters
    ----------
    target : DetectedTarget
        Target image with its points.
    laser : Path
        Image of the same pose with the laser on.
    channel : str
        Channel of colour images that holds the laser.

    Returns
    -------
    LightImage

    Raises
    ------
    RecordingError
        An image cannot be read, or the two differ in size.
    """
    images = image_light(target.image, laser, channel)
    assert target.grid is not None, "only grids have poses"
    points = target.grid[np.isfinite(target.grid[..., 0])].astype(np.float32)
    inside = np.zeros(images.light.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(cv2.convexHull(points)).astype(np.int32), 1)
    return images._replace(inside=inside > 0)


def image_light(dark_image: Path, laser: Path, channel: Channel) -> LightImage:
    """Return the light of the laser in a pair of images, to be read in the whole image; as `target_light`."""
    dark, lit = read_frame(dark_image, channel), read_frame(laser, channel)
    if dark.shape != lit.shape:
        raise RecordingError(
            f"{laser}: {lit.shape[1]} x {lit.shape[0]} pixels, the image without laser {dark_image} has "
            f"{dark.shape[1]} x {dark.shape[0]}"
        )
    top = np.iinfo(lit.dtype).max if lit.dtype.kind == "u" else np.inf
    return LightImage(lit.astype(np.float32) - dark.astype(np.float32), np.ones(dark.shape, np.bool_), lit >= top)
