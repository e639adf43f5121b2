"""Sheet of light of a sensor file: the table ``[triangulation]``, from sensor coordinates to the sheet."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.ranging.sheet import BentSheet
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.ranging.triangulation_model import Along
from gpuvision.schema import Section
from gpuvision.sensor.optics import Optics

Region = tuple[tuple[float, float], tuple[float, float]]


def read_triangulation(
    table: Section, optics: Optics, region: Region, along: Along
) -> tuple[Triangulation, BentSheet | None]:
    """Read a triangulation: a homography, constants, calibration points, a setup in metres, or a camera's pose.

    Parameters
    ----------
    table : Section
        Table ``[triangulation]``.
    optics : Optics
        Distortion. With a camera, its matrix is the focal length and the principal point.
    region : ((u_min, u_max), (v_min, v_max))
        Region of the sensor [sensor unit].
    along : {"columns", "rows"}
        Image axis of the samples.

    Returns
    -------
    Triangulation
        To the mean plane of the sheet.
    BentSheet or None
        Deviation of the sheet from the plane, for a pose with the key ``bend``.

    Raises
    ------
    DescriptionError
        A key is missing, unknown or has a wrong value, or the table has no geometry or several.
    """
    ways = _WAYS if optics.camera is None else _WAYS_OF_CAMERA
    common: dict[str, Any] = {"region": region, "along": along, "lens": optics.lens, "camera": optics.camera}
    common |= {"horizon": table.number("horizon", "", 1e-3, above=0.0, below=1.0)}
    given = [method for method in ways if method in table]
    if len(given) != 1:
        problem = f"has {' and '.join(given)} at once" if given else "has no geometry"
        raise table.error(f"[{table.name}] {problem}, expected one of {', '.join(ways)}")
    made = ways[given[0]](table, common)
    bend = _bend(table) if given[0] in _POSES else None
    covariance = table.rows("covariance", "m^2, m and 1", 8, None)
    table.finish()
    with table.checking():
        return (made if covariance is None else replace(made, covariance=covariance)), bend


def _from_homography(table: Section, common: dict[str, Any]) -> Triangulation:
    return Triangulation(homography=table.rows("homography", "m per sensor unit", 3), **common)


def _from_constants(table: Section, common: dict[str, Any]) -> Triangulation:
    return Triangulation.from_constants(table.numbers("constants", "", (3, 4, 6, 8)), **common)


def _from_points(table: Section, common: dict[str, Any]) -> Triangulation:
    """Fit rows of (u, v, G, H)."""
    points = np.array(table.rows("points", "u, v in sensor units, G, H in m", 4))
    horizon = common.pop("horizon")
    fitted = Triangulation.fit(points[:, :2], points[:, 2:], **common)
    return replace(fitted, horizon=horizon)


def _from_polynomial(table: Section, common: dict[str, Any]) -> Triangulation:
    """Read the polynomials of a `PlanePolynomial`, with c = v and r = u."""
    p, q = table.numbers("p", "m", (8,)), table.numbers("q", "m", (8,))
    (v, u) = common["region"][::-1]
    region = table.rows("region", "sensor unit", 2, (v, u))
    with table.checking():
        return Triangulation.from_polynomial(PlanePolynomial(p=p, q=q, region=region), **common)


def _from_stand_off(table: Section, common: dict[str, Any]) -> Triangulation:
    return Triangulation.from_stand_off(
        baseline=table.number("baseline", "m", above=0.0),
        stand_off=table.number("stand_off", "m", above=0.0),
        focal_distance=table.number("focal_distance", "sensor unit", above=0.0),
        tilt=table.number("tilt", "rad", None, above=-math.pi / 2, below=math.pi / 2),
        **common,
    )


def _from_pinhole(table: Section, common: dict[str, Any]) -> Triangulation:
    focal = table.number("focal_length_px", "pixel", above=0.0)
    column, row = table.numbers("principal_point_px", "pixel", (2,))
    del common["camera"]
    return Triangulation.from_camera(
        [[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]], **_pose(table), **common
    )


def _from_camera(table: Section, common: dict[str, Any]) -> Triangulation:
    return Triangulation.from_camera(common.pop("camera"), **_pose(table), **common)


def _pose(table: Section) -> dict[str, Any]:
    """Read the pose of the sheet in the camera frame."""
    units = {"sheet_origin": "m", "g_axis": "", "h_axis": ""}
    origin, g_axis, h_axis = (table.numbers(key, unit, (3,)) for key, unit in units.items())
    return {"origin": origin, "g_axis": g_axis, "h_axis": h_axis}


def _bend(table: Section) -> BentSheet | None:
    """Read the bend of a sheet whose pose in the camera frame is given."""
    terms = table.numbers("bend", "1/m", (3,), None)
    if terms is None:
        return None
    with table.checking():
        return BentSheet.from_pose(terms, **_pose(table))


_Reader = Callable[[Section, dict[str, Any]], Triangulation]
_WAYS: dict[str, _Reader] = {
    "homography": _from_homography,
    "constants": _from_constants,
    "points": _from_points,
    "baseline": _from_stand_off,
    "focal_length_px": _from_pinhole,
    "p": _from_polynomial,
}
_WAYS_OF_CAMERA: dict[str, _Reader] = {
    "homography": _from_homography,
    "points": _from_points,
    "sheet_origin": _from_camera,
}
_POSES = ("focal_length_px", "sheet_origin")
