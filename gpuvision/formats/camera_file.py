"""Calibrated lenses as files: ``gpuvision calibrate`` writes them, ``gpuvision undistort`` and sensor files read them.

A file holds one of two tables: ``[lens]``, radial distortion of measured pixels (`Lens`), as a sensor file has it; or
``[camera]``, a camera matrix and OpenCV's coefficients (`Camera`). The others, ``[image]``, ``[uncertainty]`` and
``[fit]``, say how it came about; nothing depends on them. A table ``[mount]`` is `gpuvision.camera.ground_plane`'s.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w

from gpuvision.camera.camera import NAMES, Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.lens import Lens
from gpuvision.host.files import replacing
from gpuvision.schema import Section, read

_ABOUT = ("image", "uncertainty", "fit", "mount")


def read_lens(path: str | Path) -> Lens | Camera:
    """Read the camera model from a file that ``gpuvision calibrate`` wrote.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        It is no such file; the message names the key.
    """
    top = read(Path(path))
    lens, camera = top.optional_section("lens"), top.optional_section("camera")
    for name in _ABOUT:
        top.optional_section(name)
    top.finish()
    if lens is not None and camera is None:
        return radial_lens(lens)
    if camera is not None and lens is None:
        return _camera(camera)
    raise top.error("expected one table, [lens] or [camera]")


def radial_lens(table: Section) -> Lens:
    """Return the lens of a table ``[lens]``, and finish that."""
    k1 = table.number("k1", "sensor unit^-2")
    k2 = table.number("k2", "sensor unit^-4", 0.0)
    column, row = table.numbers("centre", "sensor unit", (2,), (0.0, 0.0))
    table.finish()
    return Lens(k1=k1, k2=k2, centre=(column, row))


def write_lens(path: str | Path, model: Lens | Camera, about: Mapping[str, Mapping[str, Any]]) -> None:
    """Write a camera model as TOML, whole or not at all.

    Parameters
    ----------
    path
        Its folder must exist.
    model
        What `read_lens` will return.
    about
        The tables ``image``, ``uncertainty`` and ``fit``.
    """
    table = {"lens" if isinstance(model, Lens) else "camera": model.to_dict(), **about}
    with replacing(path) as file:
        tomli_w.dump(table, file)


def _camera(table: Section) -> Camera:
    matrix = table.rows("matrix", "pixel", 3)
    distortion = tuple(table.number(name, "", 0.0) for name in NAMES)
    table.finish()
    return Camera(matrix=matrix, distortion=distortion)


def read_mounted(path: str | Path, shape: tuple[int, int]) -> MountedCamera | None:
    """Read a camera file's table ``[mount]``: how it is mounted, and what its other table says of the lens.

    Parameters
    ----------
    path
        What ``gpuvision calibrate`` wrote, with a table ``[mount]`` added; or such a table alone.
    shape
        Rows and columns of the image: its middle is the centre where the file has none.

    Returns
    -------
    MountedCamera or None
        None where there is no such table.

    Raises
    ------
    OSError
        The file cannot be read.
    DescriptionError
        It says something else; the message names the key.
    """
    top = read(Path(path))
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
    ahead, left = table.numbers("place", "m", (2,), (0.0, 0.0))
    focal = centre = None
    if not isinstance(model, Camera):
        focal = table.number("focal_px", "pixel", above=0.0)
        column, row = table.numbers("centre_px", "pixel", (2,), middle if model is None else model.centre)
        centre = (column, row)
    table.finish()
    return MountedCamera(
        height=height,
        tilt=math.radians(tilt),
        roll=math.radians(roll),
        heading=math.radians(heading),
        place=(ahead, left),
        focal_px=focal,
        centre_px=centre,
        model=model,
    )
