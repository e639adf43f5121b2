"""Changes of a rotating sheet: each parameter once, by its standard deviation."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.ranging.rotating_sigma import RotatingSheetSigma
from gpuvision.ranging.sheet_motion import RotatingSheet

PINHOLE: dict[str, Any] = {"focal_length_px": 800.0, "principal_point_px": (320.0, 240.0)}
SHEET = RotatingSheet(
    axis_point=(0.1, 0.2, 0.5),
    axis_direction=(0.0, 0.6, 0.8),
    sheet_normal=(0.8, 0.0, -0.6),
    sheet_offset=0.01,
    first_angle=0.25,
    angle_step=1e-3,
    **PINHOLE,
)
MATRIX = ((800.0, 0.0, 320.0), (0.0, 810.0, 240.0), (0.0, 0.0, 1.0))


def changed(name: str, amount: float, sheet: RotatingSheet = SHEET) -> list[RotatingSheet]:
    return list(RotatingSheetSigma(**{name: amount}).sheets(sheet))


def differing(one: RotatingSheet, other: RotatingSheet) -> list[str]:
    return [each.name for each in fields(one) if getattr(one, each.name) != getattr(other, each.name)]


def test_no_sigma_changes_nothing() -> None:
    angles = np.arange(3.0)
    assert list(RotatingSheetSigma().sheets(SHEET)) == []
    assert list(RotatingSheetSigma().angles(SHEET, angles)) == []


def test_pinhole() -> None:
    (longer,) = changed("focal_length_px", 2.0)
    assert longer == replace(SHEET, focal_length_px=802.0)
    right, down = changed("principal_point_px", 2.0)
    assert right == replace(SHEET, principal_point_px=(322.0, 240.0))
    assert down == replace(SHEET, principal_point_px=(320.0, 242.0))


def test_camera() -> None:
    camera = Camera(matrix=MATRIX, distortion=(0.1, *(0.0,) * 13))
    sheet = replace(SHEET, camera=camera, focal_length_px=None, principal_point_px=None)
    (longer,) = changed("focal_length_px", 2.0, sheet)
    right, down = changed("principal_point_px", 2.0, sheet)
    for found, (fx, fy, cx, cy) in (
        (longer, (802.0, 812.0, 320.0, 240.0)),
        (right, (800.0, 810.0, 322.0, 240.0)),
        (down, (800.0, 810.0, 320.0, 242.0)),
    ):
        assert differing(found, sheet) == ["camera"]
        assert found.camera is not None
        np.testing.assert_array_equal(found.camera.matrix, [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        assert found.camera.distortion == camera.distortion


def test_point_and_offset() -> None:
    moved = changed("axis_point", 0.01)
    assert all(differing(each, SHEET) == ["axis_point"] for each in moved)
    np.testing.assert_allclose(np.array([each.axis_point for each in moved]) - SHEET.axis_point, 0.01 * np.eye(3))
    (further,) = changed("sheet_offset", 0.02)
    assert differing(further, SHEET) == ["sheet_offset"]
    assert further.sheet_offset == pytest.approx(0.03)


@pytest.mark.parametrize("name", ["axis_direction", "sheet_normal"])
def test_directions_turn_about_two_perpendicular_axes(name: str) -> None:
    turned = changed(name, 0.01)
    before = np.array(getattr(SHEET, name))
    vectors = np.array([getattr(each, name) for each in turned])
    assert [differing(each, SHEET) for each in turned] == [[name]] * 2
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0)
    np.testing.assert_allclose(vectors @ before, np.cos(0.01))
    one, other = vectors - np.cos(0.01) * before
    assert one @ other == pytest.approx(0.0, abs=1e-15)


def test_angles_of_the_profiles() -> None:
    angles = np.array([0.25, 0.5, 1.25])
    first, scaled = RotatingSheetSigma(first_angle=0.125, angle_scale=0.5).angles(SHEET, angles)
    np.testing.assert_array_equal(first, [0.375, 0.625, 1.375])
    np.testing.assert_array_equal(scaled, [0.25, 0.625, 1.75])


@pytest.mark.parametrize("name", [each.name for each in fields(RotatingSheetSigma)])
def test_negative_sigmas_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"RotatingSheetSigma.{name}"):
        RotatingSheetSigma(**{name: -5e-324})
