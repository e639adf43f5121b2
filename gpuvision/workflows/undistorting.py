"""Undistortion of image files and files of points."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_image import Border, Interpolation, UndistortImage
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.formats.camera_file import check_calibrated_size
from gpuvision.host import Device, to_numpy
from gpuvision.host.array_files import read_array
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import atomic_write
from gpuvision.host.image_files import read_image
from gpuvision.host.outputs import Outputs

# Largest number of pixels of the frame "all" per pixel of the image: near the fold of a lens the frame is unlimited.
_LARGEST_FRAME = 16
Frame = Literal["same", "all", "valid"]
Progress = Callable[[int, int | None], object]


def undistort_files(
    inputs: Sequence[Path],
    model: Lens | Camera,
    out: Path,
    *,
    device: Device,
    interpolation: Interpolation = "bilinear",
    border: Border = "mask",
    border_value: float = 0.0,
    region: tuple[int, int, int, int] | None = None,
    frame: Frame = "same",
    calibrated_size: tuple[int, int] | None = None,
    window: tuple[int, int] | None = None,
    binning: int = 1,
    overwrite: bool = False,
    progress: Progress = lambda done, of: None,
) -> tuple[Path, ...]:
    """Undistort images and NPY arrays of points into a folder. On an error no file is left behind.

    Parameters
    ----------
    inputs : sequence of Path
        Images (uint8, uint16 or float32; grey or colour) and NPY arrays (..., 2) of measured (column, row) [px].
    model : Lens or Camera
        Camera model.
    out : Path
        Output folder. Files keep their names; images get the suffix of the format written (.png or .tif).
    device : Device
        Device to run on.
    interpolation, border, border_value, region
        See `UndistortImage`; they apply to images.
    frame : {"same", "all", "valid"}
        Part of the ideal plane that an image shows. "same" (default): the rectangle of the measured image; content that
        the correction moves outside is cut off. "all": the smallest rectangle with every measured pixel (OpenCV: alpha
        = 1). "valid": the largest rectangle between the corrected borders, without missing pixels (OpenCV: alpha = 0).
    calibrated_size : (int, int), optional
        Columns and rows of the images that the model was calibrated from. Images of another size are refused unless
        ``window`` or ``binning`` says which part of the sensor they show. Default: not checked.
    window : (int, int), optional
        Column and row, in the calibrated image, of the first pixel of the images. Default: (0, 0).
    binning : int
        Pixels of the calibrated image per pixel of the images, along each axis. Default 1. ``window`` and ``binning``
        apply to points as well.
    overwrite : bool
        Whether files may be replaced that no earlier undistortion wrote. Default False. The inputs are never replaced.
    progress : callable
        Called with the number of processed files and the number of files.

    Returns
    -------
    tuple of Path
        Files written, in the order of the inputs.

    Raises
    ------
    FileNotFoundError
        An input does not exist.
    FileExistsError
        An output is an input; or it exists, and is not an unchanged output of an earlier undistortion; see
        `gpuvision.host.outputs`.
    RecordingError
        An input is neither an image nor an array of points, or two inputs have the same name.
    ValueError, TypeError
        The shape or the pixel type of an image is not supported.
    """
    stems = [each.stem for each in inputs]
    duplicates = {name for name in stems if stems.count(name) > 1}
    if duplicates:
        raise RecordingError(f"several inputs have the name {min(duplicates)}; undistort them into separate folders")
    written = []
    if binning < 1:
        raise ValueError(f"binning is {binning}, expected a whole number of 1 or more")
    if frame != "same" and region is not None:
        raise ValueError(f"frame {frame!r} and region both choose the part of the image; leave one out")
    outputs = Outputs("undistort", inputs=inputs, overwrite=overwrite)
    is_part = window is not None or binning > 1
    if is_part:
        model = model.in_window(window or (0, 0), binning)
    image_options: dict[str, Any] = {
        "interpolation": interpolation,
        "border": border,
        "border_value": border_value,
        "region": region,
    }
    with outputs.folder(out) as folder:
        for number, file in enumerate(inputs):
            progress(number, len(inputs))
            if not file.exists():
                raise FileNotFoundError(f"{file}: no such file")
            if file.suffix.lower() == ".npy":
                name = file.name
                outputs.claim(out / name)
                points = _undistorted_points(file, model, device)
                with atomic_write(folder / name) as npy:
                    np.save(npy, points)
            else:
                image = _image_without_alpha(file)
                size = (image.shape[1], image.shape[0])
                check_calibrated_size(file, size, calibrated_size, (window or (0, 0), binning) if is_part else None)
                if frame != "same":
                    image_options["region"] = frame_region(model, size, frame)
                name = f"{file.stem}.tif" if image.dtype == np.float32 else f"{file.stem}.png"
                outputs.claim(out / name)
                _write(folder / name, _undistorted_image(image, model, device, image_options))
            written.append(out / name)
        progress(len(inputs), len(inputs))
    return tuple(written)


def frame_region(model: Lens | Camera, size: tuple[int, int], frame: Frame) -> tuple[int, int, int, int]:
    """Return the region (column, row, columns, rows) of the ideal plane that shows all, or only valid, pixels.

    Parameters
    ----------
    model : Lens or Camera
        Camera model.
    size : (int, int)
        Columns and rows of the measured image.
    frame : {"same", "all", "valid"}
        See `undistort_files`.

    Raises
    ------
    ValueError
        The border has no corrected position (it lies past the fold of the model), or the region is empty or has more
        than 16 times the pixels of the image.
    """
    columns, rows = size
    if frame == "same":
        return 0, 0, columns, rows
    across, down = np.arange(columns, dtype=np.float64), np.arange(rows, dtype=np.float64)
    top, bottom = (np.stack([across, np.full(columns, row)], -1) for row in (0.0, rows - 1.0))
    left, right = (np.stack([np.full(rows, column), down], -1) for column in (0.0, columns - 1.0))
    top, bottom, left, right = (model.undistort(each) for each in (top, bottom, left, right))
    border = np.concatenate([top, bottom, left, right])
    if not np.all(np.isfinite(border)):
        raise ValueError(f"frame {frame!r}: the image's border lies past the fold of the model; use --region")
    if frame == "all":
        first, last = np.floor(border.min(axis=0)), np.ceil(border.max(axis=0))
    else:
        first = np.ceil([left[:, 0].max(), top[:, 1].max()])
        last = np.floor([right[:, 0].min(), bottom[:, 1].min()])
    made = last - first + 1.0
    if np.any(made < 1.0) or made[0] * made[1] > _LARGEST_FRAME * columns * rows:
        raise ValueError(f"frame {frame!r}: it would have {made[0]:.0f} x {made[1]:.0f} pixels; use --region")
    return int(first[0]), int(first[1]), int(made[0]), int(made[1])


def _image_without_alpha(file: Path) -> npt.NDArray[Any]:
    """Read a grey image, or a colour image without its alpha channel."""
    image = read_image(file)
    return image[..., :3] if image.ndim == 3 else image


def _undistorted_image(
    image: npt.NDArray[Any], model: Lens | Camera, device: Device, options: Mapping[str, Any]
) -> npt.NDArray[Any]:
    """Undistort an image with options of `UndistortImage`."""
    operation = UndistortImage(model=model, channels=3 if image.ndim == 3 else 1, **options)
    return to_numpy(operation(np.ascontiguousarray(image), device=device).image)


def _undistorted_points(file: Path, model: Lens | Camera, device: Device) -> npt.NDArray[Any]:
    """Read points of an NPY file and undistort them, in single precision on a device without doubles."""
    points = read_array(file)
    if points.ndim < 1 or points.shape[-1] != 2 or points.dtype not in (np.float32, np.float64):
        raise RecordingError(
            f"{file}: {points.dtype} of shape {points.shape}, expected float32 or float64 points of shape (..., 2)"
        )
    flat = np.ascontiguousarray(points.reshape(-1, 2))
    real = flat.dtype if device.has_double else np.dtype(np.float32)
    undistorted = UndistortPoints(model=model)(flat.astype(real, copy=False), device=device).points
    return to_numpy(undistorted).reshape(points.shape)


def _write(path: Path, image: npt.NDArray[Any]) -> None:
    """Write an image in a lossless format: TIFF or PNG, as the suffix of the path says."""
    if path.suffix == ".tif":
        is_colour = image.ndim == 3
        with atomic_write(path) as file:
            tifffile.imwrite(
                file, image[..., ::-1] if is_colour else image, photometric="rgb" if is_colour else "minisblack"
            )
        return
    done, encoded = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"cannot encode an image of shape {image.shape} as PNG, the format of {path.name}")
    with atomic_write(path) as file:
        file.write(encoded.tobytes())
