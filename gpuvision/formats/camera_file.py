"""Camera files (TOML): ``gpuvision calibrate`` writes them, ``gpuvision undistort`` and sensor files read them.

A file holds one of two tables: ``[lens]``, the radial distortion of measured pixels (`Lens`), as in a sensor file; or
``[camera]``, a camera matrix and OpenCV's coefficients (`Camera`). The table ``[image]`` holds the size of the
calibrated images (`read_calibrated_size`). The table ``[covariance]`` of a ``[camera]`` holds the covariance of its
fitted parameters (`read_calibrated_camera`). The tables ``[uncertainty]`` and ``[fit]`` document the calibration; no
reader uses them. A table ``[mount]`` describes a `gpuvision.camera.ground_plane.MountedCamera`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import tomli_w

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.lens import Lens
from gpuvision.host.files import atomic_write
from gpuvision.schema import Section, read_toml

_OTHER_TABLES = ("image", "covariance", "uncertainty", "fit", "mount")
_PARAMETERS = ("f", "fx", "fy", "cx", "cy", *COEFFICIENT_NAMES)
# Asymmetry and negative eigenvalue of a correlation matrix that count as rounding. Chosen: far above double rounding,
# far below a correlation that matters.
_ROUNDING = 1e-9


class CalibratedCamera(NamedTuple):
    """Camera of a camera file with the covariance of its parameters.

    Attributes
    ----------
    camera : Camera
        Camera.
    size : (int, int) or None
        Columns and rows of the calibrated images; None if the file does not say.
    names : tuple of str
        Fitted parameters, as in `gpuvision.camera.views.camera_fit.CameraFit`; empty without ``[covariance]``.
    covariance : numpy.ndarray
        (m, m): covariance of these parameters [px], [rad].
    """

    camera: Camera
    size: tuple[int, int] | None
    names: tuple[str, ...]
    covariance: npt.NDArray[np.float64]


def read_lens(path: str | Path) -> Lens | Camera:
    """Read the camera model of a camera file.

    Parameters
    ----------
    path : str or Path
        File that ``gpuvision calibrate`` wrote.

    Returns
    -------
    Lens or Camera

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key or table is missing, unknown or has a wrong value; the message names the key.
    """
    top = read_toml(Path(path))
    lens, camera = top.optional_section("lens"), top.optional_section("camera")
    for name in _OTHER_TABLES:
        top.optional_section(name)
    top.finish()
    if lens is not None and camera is None:
        return radial_lens(lens)
    if camera is not None and lens is None:
        return camera_of(camera)
    raise top.error("expected one table, [lens] or [camera]")


def read_calibrated_camera(path: str | Path) -> CalibratedCamera:
    """Read camera, size of the images and covariance of a camera file with a table ``[camera]``.

    Parameters
    ----------
    path : str or Path
        File that ``gpuvision calibrate`` wrote from views of a grid.

    Returns
    -------
    CalibratedCamera

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key or table is missing, unknown or has a wrong value, or the file has a ``[lens]`` instead of a ``[camera]``.
    """
    model, top = read_lens(path), read_toml(Path(path))
    if not isinstance(model, Camera):
        raise top.error("[lens] is the distortion alone, expected a [camera]; calibrate with --method views")
    table = top.optional_section("covariance")
    names, covariance = ((), np.zeros((0, 0))) if table is None else _covariance(table)
    return CalibratedCamera(model, read_calibrated_size(path), names, covariance)


def covariance_table(names: Sequence[str], covariance: npt.ArrayLike) -> dict[str, Any]:
    """Return the table ``[covariance]`` of a camera file, which `read_calibrated_camera` reads."""
    return {"names": ",".join(names), "matrix": np.asarray(covariance).tolist()}


def _covariance(table: Section) -> tuple[tuple[str, ...], npt.NDArray[np.float64]]:
    """Return names and matrix of a table ``[covariance]``; refuse a matrix that is no covariance."""
    names = tuple(table.text("names").split(","))
    if len(set(names)) < len(names) or not set(names) <= set(_PARAMETERS):
        raise table.error(f"names is {','.join(names)!r}, expected different ones of {', '.join(_PARAMETERS)}")
    matrix = np.array(table.rows("matrix", "", len(names)))
    table.finish()
    if len(matrix) != len(names):
        raise table.error(f"matrix has {len(matrix)} rows for {len(names)} names")
    if not _is_covariance(matrix):
        raise table.error(
            "matrix is no covariance, expected a symmetric matrix with variances above 0 and no negative eigenvalue"
        )
    return names, matrix


def _is_covariance(matrix: npt.NDArray[np.float64]) -> bool:
    """Return whether a square matrix is symmetric, with variances above 0 and no negative eigenvalue."""
    variances = np.diag(matrix)
    if not (variances > 0.0).all():
        return False
    sigmas = np.sqrt(variances)
    with np.errstate(over="ignore"):
        correlation = matrix / sigmas / sigmas[:, None]
    if not (np.abs(correlation) <= 1.0 + _ROUNDING).all():
        return False
    values = np.linalg.eigvalsh(correlation)
    return bool(
        np.allclose(correlation, correlation.T, rtol=0.0, atol=_ROUNDING) and values[0] >= -_ROUNDING * values[-1]
    )


def read_calibrated_size(path: str | Path) -> tuple[int, int] | None:
    """Return columns and rows of the images that a camera file was calibrated from; None if the file does not say.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        The size is no pair of whole numbers above 0.
    """
    table = read_toml(Path(path)).optional_section("image")
    if table is None or "size" not in table:
        return None
    columns, rows = table.numbers("size", "pixel", (2,))
    if min(columns, rows) < 1.0 or columns != int(columns) or rows != int(rows):
        raise table.error(f"size is ({columns:g}, {rows:g}), expected two whole numbers of pixels above 0")
    return int(columns), int(rows)


def check_calibrated_size(
    file: str | Path,
    size: tuple[int, int],
    calibrated_size: tuple[int, int] | None,
    part: tuple[tuple[float, float], int] | None = None,
    *,
    hint: str = "give the window and the binning of these images to gpuvision undistort, or calibrate at this size",
) -> None:
    """Check that an image shows the sensor pixels for which a camera model was calibrated.

    Parameters
    ----------
    file : str or Path
        File of the image, for the message.
    size : (int, int)
        Columns and rows of the image.
    calibrated_size : (int, int) or None
        Columns and rows of the calibrated images, see `read_calibrated_size`; None: no check.
    part : ((float, float), int), optional
        Part of the sensor that the image shows: column and row of its first pixel in the calibrated image, and
        calibrated pixels per pixel along each axis. Default: the whole sensor.
    hint : str
        Last part of the message for an image of another size without a `part`.

    Raises
    ------
    ValueError
        The image has another size, or the part does not lie within the calibrated image.
    """
    if calibrated_size is None or (part is None and size == calibrated_size):
        return
    columns, rows = size
    said = f"{file}: {columns} x {rows} pixels, the model was calibrated at {calibrated_size[0]} x {calibrated_size[1]}"
    if part is None:
        raise ValueError(f"{said}; {hint}")
    window, binning = part
    ends = (window[0] + columns * binning, window[1] + rows * binning)
    if min(window) < 0 or ends[0] > calibrated_size[0] or ends[1] > calibrated_size[1]:
        raise ValueError(f"{said}; the window from {window} with binning {binning} ends at {ends}, outside")


def radial_lens(table: Section) -> Lens:
    """Return the lens of a table ``[lens]``; refuse unknown keys."""
    k1 = table.number("k1", "sensor unit^-2")
    k2 = table.number("k2", "sensor unit^-4", 0.0)
    k3, k4 = table.number("k3", "sensor unit^-6", 0.0), table.number("k4", "sensor unit^-8", 0.0)
    column, row = table.numbers("centre", "sensor unit", (2,), (0.0, 0.0))
    table.finish()
    with table.checking():
        return Lens(k1=k1, k2=k2, k3=k3, k4=k4, centre=(column, row))


def camera_of(table: Section) -> Camera:
    """Return the camera of a table ``[camera]``; refuse unknown keys."""
    matrix = table.rows("matrix", "pixel", 3)
    distortion = tuple(table.number(name, "", 0.0) for name in COEFFICIENT_NAMES)
    table.finish()
    with table.checking():
        return Camera(matrix=matrix, distortion=distortion)


def write_lens(
    path: str | Path, model: Lens | Camera, documentation: Mapping[str, Mapping[str, Any]], *, overwrite: bool = False
) -> None:
    """Write a camera model as TOML. On an error no file is left behind.

    Parameters
    ----------
    path : str or Path
        Output file; its folder must exist.
    model : Lens or Camera
        Model that `read_lens` reads back.
    documentation : mapping
        Further tables: ``image``, ``covariance``, ``uncertainty`` and ``fit``.
    overwrite : bool
        Whether an existing file may be replaced. Default False.
    """
    table = {"lens" if isinstance(model, Lens) else "camera": model.to_dict(), **documentation}
    with atomic_write(path, overwrite=overwrite) as file:
        tomli_w.dump(table, file)


def read_mounted(path: str | Path, shape: tuple[int, int]) -> MountedCamera | None:
    """Read the table ``[mount]`` of a camera file, together with the file's lens or camera.

    Parameters
    ----------
    path : str or Path
        File that ``gpuvision calibrate`` wrote, with a table ``[mount]`` added; or a file with that table alone.
    shape : (int, int)
        Rows and columns of the image. The image's centre is the principal point where the file gives none.

    Returns
    -------
    MountedCamera or None
        None if the file has no table ``[mount]``.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        A key is missing, unknown or has a wrong value; the message names the key.
    """
    top = read_toml(Path(path))
    table = top.optional_section("mount")
    if table is None:
        return None
    model = read_lens(path) if "lens" in top or "camera" in top else None
    if model is None:
        top.finish()
    middle = ((shape[1] - 1) / 2, (shape[0] - 1) / 2)
    return _mounted(table, model, middle)


def _mounted(table: Section, model: Lens | Camera | None, middle: tuple[float, float]) -> MountedCamera:
    height = table.number("height", "m", above=0.0)
    tilt = table.number("tilt_degrees", "degree", at_least=-90.0, at_most=90.0)
    roll, heading = (table.number(f"{name}_degrees", "degree", 0.0) for name in ("roll", "heading"))
    forward, left = table.numbers("position", "m", (2,), (0.0, 0.0))
    focal = centre = None
    if not isinstance(model, Camera):
        focal = table.number("focal_px", "pixel", above=0.0)
        column, row = table.numbers("centre_px", "pixel", (2,), middle if model is None else model.centre)
        centre = (column, row)
    table.finish()
    with table.checking():
        return MountedCamera(
            height=height,
            tilt=math.radians(tilt),
            roll=math.radians(roll),
            heading=math.radians(heading),
            position=(forward, left),
            focal_px=focal,
            centre_px=centre,
            model=model,
        )
