"""Laser images of a sensor calibration: pairs of images of one target pose, and the laser line on the target."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from gpuvision.camera.calibration import DetectedTarget
from gpuvision.host import Device, to_numpy
from gpuvision.host.errors import RecordingError
from gpuvision.host.recordings import Channel, image_files, read_frame
from gpuvision.ranging.background import line_threshold, noise_threshold
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet_calibration import Along

SUFFIX = "_laser"
"""End of the name of a laser image: ``pose1_laser.png`` shows the target of ``pose1.png`` with the laser on."""

# Samples of the window of the readout on either side of the peak, and distance of a used reading from the hull of the
# target's points [px]: the border of the target must not cut the window.
_WINDOW = 8
_BORDER = _WINDOW


class _Difference(NamedTuple):
    """Laser image less the target image, the pixels within the target's points, and the saturated pixels."""

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


def pair_images(images: Sequence[Path], laser: Path | None) -> ImagePairs:
    """Pair each target image with the laser image of the same pose.

    Parameters
    ----------
    images : sequence of Path
        Target images; without a folder `laser` also the laser images, whose names end in ``_laser``.
    laser : Path, optional
        Folder of the laser images: with the names of the target images, with or without ``_laser``, or with the same
        last number.

    Returns
    -------
    ImagePairs

    Raises
    ------
    ValueError
        A laser image has no target image, or none of the target images has a laser image.
    RecordingError
        The folder has no images.
    """
    lasers = image_files(laser) if laser is not None else [each for each in images if each.stem.endswith(SUFFIX)]
    targets = [each for each in images if laser is not None or not each.stem.endswith(SUFFIX)]
    found: dict[Path, Path] = {}
    for each in lasers:
        fitting = [target for target in targets if _is_pair(target, each)]
        if len(fitting) != 1:
            raise ValueError(
                f"{each} is the laser image of {len(fitting)} target images, expected one; name it like its target "
                f"image with {SUFFIX} before the suffix"
            )
        if fitting[0] in found:
            raise ValueError(f"{fitting[0]} has two laser images, {found[fitting[0]]} and {each}; give one for a pose")
        found[fitting[0]] = each
    if not found:
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


def line_direction(targets: Sequence[tuple[DetectedTarget, Path]], channel: Channel) -> Along:
    """Return the image axis along which the laser line runs: the longer principal axis of its light."""
    total = np.zeros(2)
    for target, laser in targets:
        difference, inside, _ = _difference(target, laser, channel)
        threshold = noise_threshold(difference[inside], integer=False)
        rows, columns = np.nonzero(inside & (difference > max(threshold, 0.25 * float(difference[inside].max()))))
        if rows.size:
            total += np.array([np.var(columns), np.var(rows)])
    return "columns" if total[0] >= total[1] else "rows"


def read_line(
    target: DetectedTarget, laser: Path, *, along: Along, channel: Channel, device: Device | None
) -> LineImage:
    """Read the laser line on a target: the laser image less the target image, within the target's points.

    Parameters
    ----------
    target : DetectedTarget
        Target image with its points.
    laser : Path
        Image of the same pose with the laser on.
    along : {"columns", "rows"}
        Image axis along which the line runs.
    channel : str
        Channel of colour images that holds the laser.
    device : Device, optional
        Device of the readout. Default: the best.

    Returns
    -------
    LineImage

    Raises
    ------
    RecordingError
        An image cannot be read, or the two differ in size.
    """
    difference, inside, saturated = _difference(target, laser, channel)
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
    note = "" if within.any() else "no laser line was found on the target"
    if np.count_nonzero(within & clipped) > np.count_nonzero(within & ~clipped):
        note = f"{np.count_nonzero(within & clipped)} readings are saturated; take the laser images with less light"
    return LineImage(image=laser, points=points[within & ~clipped], threshold=threshold, note=note)


def _difference(target: DetectedTarget, laser: Path, channel: Channel) -> _Difference:
    dark, lit = read_frame(target.image, channel), read_frame(laser, channel)
    if dark.shape != lit.shape:
        raise RecordingError(
            f"{laser}: {lit.shape[1]} x {lit.shape[0]} pixels, its target image {target.image} has {dark.shape[1]} x "
            f"{dark.shape[0]}"
        )
    assert target.grid is not None, "only grids have poses"
    points = target.grid[np.isfinite(target.grid[..., 0])].astype(np.float32)
    inside = np.zeros(dark.shape, np.uint8)
    cv2.fillConvexPoly(inside, np.rint(cv2.convexHull(points)).astype(np.int32), 1)
    top = np.iinfo(lit.dtype).max if lit.dtype.kind == "u" else np.inf
    return _Difference(lit.astype(np.float32) - dark.astype(np.float32), inside > 0, lit >= top)
