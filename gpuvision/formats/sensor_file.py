"""Sensor files (TOML) that ``gpuvision calibrate --sensor`` writes and ``gpuvision scan`` reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from gpuvision.ranging.sensor_geometry import SensorGeometry
from gpuvision.ranging.sheet_readings import Along

# Components of unit vectors and of distances [m] below this size are rounding errors.
_ROUNDING = 1e-15

_HEADER = (
    "# Written by gpuvision calibrate --sensor. Lengths in metres; pixel (0, 0) is the centre of the first pixel.\n"
    "# The report beside this file has residuals and uncertainties.\n\n"
)


def sensor_text(
    geometry: SensorGeometry,
    *,
    name: str,
    size: tuple[int, int],
    along: Along,
    channel: str,
    cell: float,
    pixels: npt.ArrayLike,
) -> str:
    """Return the sensor file of a calibrated laser sensor.

    Parameters
    ----------
    geometry : SensorGeometry
        Camera, sheet of light and transport.
    name : str
        Name of the sensor.
    size : (int, int)
        Columns and rows of a frame.
    along : {"columns", "rows"}
        Image axis along which the laser line runs.
    channel : str
        Channel of colour frames that holds the laser.
    cell : float
        Cell of the height map [m].
    pixels : array_like
        (n, 2): measured (column, row) over the calibrated part of the image, for the covariance of the triangulation.

    Returns
    -------
    str
        TOML, read by `gpuvision.sensor.sensor.Sensor`.
    """
    sheet = geometry.sheet
    triangulation: dict[str, Any] = {
        "sheet_origin": sheet.origin.tolist(),
        "g_axis": sheet.g_axis.tolist(),
        "h_axis": sheet.h_axis.tolist(),
    }
    if sheet.bend is not None:
        triangulation["bend"] = list(sheet.bend)
    covariance = geometry.triangulation(size, along, pixels).covariance
    if covariance is not None:
        triangulation["covariance"] = [list(row) for row in covariance]
    table: dict[str, Any] = {
        "kind": "camera",
        "name": name or "calibrated laser sensor",
        "recording": {"channel": channel},
        "frame": {"columns": size[0], "rows": size[1]},
        "line": {"along": along, "method": "windowed", "threshold": "auto"},
        "camera": geometry.camera.to_dict(),
        "triangulation": triangulation,
        "transport": _transport(geometry),
        "output": {"cell": cell},
    }
    return _HEADER + tomli_w.dumps(table)


def _transport(geometry: SensorGeometry) -> dict[str, Any]:
    """Return the table of a straight transport: the axes of the sheet and the direction in the scene."""
    to_scene, sheet = geometry.scene_axes, geometry.sheet
    vectors = {
        "g_axis": to_scene @ sheet.g_axis,
        "h_axis": to_scene @ sheet.h_axis,
        "direction": to_scene @ geometry.direction,
        "origin": to_scene @ (sheet.origin - geometry.scene_origin),
    }
    # Adding 0.0 turns -0.0 into 0.0.
    table = {"kind": "straight", "step": geometry.step} | {
        key: (np.where(np.abs(value) < _ROUNDING, 0.0, value) + 0.0).tolist() for key, value in vectors.items()
    }
    if geometry.transport is not None:
        step = geometry.transport.covariance(geometry.camera_covariance)
        per_metre = to_scene @ step @ to_scene.T / geometry.step**2
        table["covariance"] = (0.5 * (per_metre + per_metre.T)).tolist()
    return table
