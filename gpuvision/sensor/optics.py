"""Distortion of a sensor file: the tables ``[lens]`` and ``[camera]``, with their parameters or with a file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.formats.camera_file import camera_of, check_calibrated_size, radial_lens, read_calibrated_size, read_lens
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation_model import Along
from gpuvision.schema import Section

Frame = tuple[int, int]


class Optics(NamedTuple):
    """Distortion of a sensor: a lens in sensor coordinates, or a camera in the pixels of its frames, or neither."""

    lens: Lens | None = None
    camera: Camera | None = None


def read_optics(top: Section, kind: str, frame: Frame | None, along: Along, axes: SampleAxes) -> Optics:
    """Read the tables ``[lens]`` and ``[camera]``; at most one of them.

    Parameters
    ----------
    top : Section
        Sensor file.
    kind : {"camera", "psd"}
        Kind of the sensor. A PSD has no ``[camera]``.
    frame : (int, int) or None
        Rows and columns of a frame.
    along : {"columns", "rows"}
        Image axis of the samples.
    axes : SampleAxes
        Map from pixels to sensor coordinates.

    Raises
    ------
    DescriptionError
        A key is missing, unknown or has a wrong value, or the tables exclude each other.
    """
    lens = top.optional_section("lens")
    camera = top.optional_section("camera") if kind == "camera" else None
    if camera is None:
        return Optics(lens=None if lens is None else _lens(lens, frame, along, axes))
    if lens is not None:
        raise top.error("[lens] and [camera] exclude each other; a camera includes a lens")
    if axes != SampleAxes():
        raise top.error("[axes] and [camera] exclude each other; a camera's sensor coordinates are pixels")
    return Optics(camera=_camera(camera, frame))


def _lens(table: Section, frame: Frame | None, along: Along, axes: SampleAxes) -> Lens:
    """Read a lens in sensor coordinates, or a file with a lens in pixels."""
    if "file" not in table:
        return radial_lens(table)
    path = table.file("file")
    window = _window(table)
    table.finish()
    lens = read_lens(path)
    if not isinstance(lens, Lens):
        raise table.error(
            f"{path} has a table [camera], expected [lens]: name it in [camera], or calibrate with --method lines"
        )
    _check_size(table, path, frame, window)
    with table.checking():
        return _in_sensor_coordinates(lens.in_window(window), along, axes)


def _camera(table: Section, frame: Frame | None) -> Camera:
    """Read a camera, or a file with a camera, as the camera of the window that the frames show."""
    window = _window(table)
    if "file" not in table:
        return camera_of(table).in_window(window)
    path = table.file("file")
    table.finish()
    camera = read_lens(path)
    if not isinstance(camera, Camera):
        raise table.error(f"{path} has a table [lens], expected [camera]: name it in [lens], or calibrate with views")
    _check_size(table, path, frame, window)
    return camera.in_window(window)


def _window(table: Section) -> tuple[float, float]:
    column, row = table.numbers("window", "pixel", (2,), (0.0, 0.0))
    return column, row


def _check_size(table: Section, path: Path, frame: Frame | None, window: tuple[float, float]) -> None:
    """Check that the frames have the size of the calibrated images, or that their window lies within these images."""
    if frame is None:
        return
    part = (window, 1) if "window" in table else None
    hint = f"give {table.dotted('window')}, the column and row of a frame's first pixel in the calibrated images"
    with table.checking():
        check_calibrated_size(f"frames of {path}", frame[::-1], read_calibrated_size(path), part, hint=hint)


def _in_sensor_coordinates(lens: Lens, along: Along, axes: SampleAxes) -> Lens:
    """Return a lens in pixels (column, row) as a lens in the sensor coordinates of these axes."""
    position, sample = (axes.position_origin, axes.position_pitch), (axes.sample_origin, axes.sample_pitch)
    column, row = (sample, position) if along == "columns" else (position, sample)
    scale = abs(column[1])
    if scale != abs(row[1]):
        raise ValueError("a lens of a file needs pitches of equal size in [axes]: its pixels are square")
    centre = tuple(origin + pitch * each for (origin, pitch), each in zip((column, row), lens.centre, strict=True))
    terms = {f"k{order}": value / scale ** (2 * order) for order, value in enumerate(lens.coefficients, 1)}
    return Lens(**terms, centre=(centre[0], centre[1]))
