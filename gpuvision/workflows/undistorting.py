"""Files of images and points, undistorted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_image import Border, Interpolation, UndistortImage
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import whole_folder
from gpuvision.host.recordings import read_image

Progress = Callable[[int, int | None], object]


def undistort_files(
    inputs: Sequence[Path],
    model: Lens | Camera,
    out: Path,
    *,
    device: Device,
    interpolation: Interpolation = "bilinear",
    border: Border = "mask",
    value: float = 0.0,
    region: tuple[int, int, int, int] | None = None,
    progress: Progress = lambda done, of: None,
) -> tuple[Path, ...]:
    """Undistort images and NPY arrays of points into a folder, all or none of them.

    Parameters
    ----------
    inputs
        Images (uint8, uint16, float32; grey or colour), and NPY arrays (..., 2) of (column, row) [px].
    model, device
        The camera model; where to run.
    out
        The folder; files keep their names, images with the ending of what they are written as.
    interpolation, border, value, region
        Of images, as `UndistortImage` has them.
    progress
        Told how many files are done, of how many.

    Returns
    -------
    tuple of Path
        What was written.

    Raises
    ------
    RecordingError
        A file is neither an image nor points, or two inputs have one name.
    ValueError, TypeError
        An image or array is of a kind that cannot be undistorted.
    """
    twins = {name for name in (each.stem for each in inputs) if [each.stem for each in inputs].count(name) > 1}
    if twins:
        raise RecordingError(f"several inputs are called {min(twins)}; undistort them into folders of their own")
    written = []
    with whole_folder(out) as inside:
        for number, file in enumerate(inputs):
            progress(number, len(inputs))
            if not file.exists():
                raise FileNotFoundError(f"{file}: there is no such file")
            if file.suffix.lower() == ".npy":
                name = file.name
                np.save(inside / name, _points(file, model, device))
            else:
                image = read_image(file)
                image = image[..., :3] if image.ndim == 3 else image
                operation = UndistortImage(
                    model=model,
                    interpolation=interpolation,
                    channels=3 if image.ndim == 3 else 1,
                    border=border,
                    value=value,
                    region=region,
                )
                name = _write(inside, file, operation(np.ascontiguousarray(image), device=device).image)
            written.append(out / name)
        progress(len(inputs), len(inputs))
    return tuple(written)


def _points(file: Path, model: Lens | Camera, device: Device) -> npt.NDArray[Any]:
    try:
        points = np.load(file, allow_pickle=False)
    except (EOFError, ValueError) as error:
        raise RecordingError(f"{file}: not a readable NPY array: {error}") from error
    if points.ndim < 1 or points.shape[-1] != 2 or points.dtype not in (np.float32, np.float64):
        raise RecordingError(
            f"{file}: {points.dtype} of shape {points.shape}, expected float32 or float64 points of shape (..., 2)"
        )
    flat = np.ascontiguousarray(points.reshape(-1, 2))
    straight: npt.NDArray[Any] = UndistortPoints(model=model)(flat, device=device).points
    return straight.reshape(points.shape)


def _write(folder: Path, source: Path, image: npt.NDArray[Any]) -> str:
    """Write an image without loss, and return its name."""
    if image.dtype == np.float32:
        name = f"{source.stem}.tif"
        coloured = image.ndim == 3
        tifffile.imwrite(
            folder / name, image[..., ::-1] if coloured else image, photometric="rgb" if coloured else "minisblack"
        )
        return name
    name = f"{source.stem}.png"
    if not cv2.imwrite(str(folder / name), image):
        raise OSError(f"cannot write {folder / name}")
    return name
