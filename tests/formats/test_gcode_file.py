"""Work offsets in G-code: an interpreter of the controllers' documented words takes artwork points to the machine."""

from __future__ import annotations

import cmath
import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gpuvision.camera.orthographic import BoardView
from gpuvision.formats.gcode_file import DIALECTS, Dialect, WorkOffset, work_offset, work_offset_code

LENGTHS, ANGLES = st.floats(-0.3, 0.3), st.floats(-7.0, 7.0)
POSES = st.tuples(LENGTHS, LENGTHS, ANGLES)


def machine_point(code: str, x: float, y: float) -> complex:
    """Return the machine coordinates [mm] of a programmed point [mm]: LinuxCNC's G10 L2 R, or the G68 of Fanuc."""
    offset, of_system, about, turn, unit = 0j, 0.0, 0j, 0.0, None
    for line in code.splitlines():
        words = re.sub(r"\([^)]*\)", "", line).split()
        values = {word[0]: float(word[1:]) for word in words if word[0] != "G"}
        codes = [word for word in words if word[0] == "G"]
        if "G21" in codes:
            unit = "mm"
        elif "G10" in codes:
            assert (values["L"], values["P"], unit) == (2, 1, "mm")  # P1 is G54
            offset, of_system = complex(values["X"], values["Y"]), values.get("R", 0.0)
        elif "G68" in codes:
            about, turn = complex(values["X"], values["Y"]), values["R"]
        else:
            assert codes in (["G90"], ["G54"], ["G69"]) or not codes
    programmed = about + (complex(x, y) - about) * cmath.exp(1j * math.radians(turn))
    return offset + programmed * cmath.exp(1j * math.radians(of_system))


@given(
    pose=POSES,
    camera=POSES,
    point=st.tuples(LENGTHS, LENGTHS),
    mirrored=st.booleans(),
    dialect=st.sampled_from(DIALECTS),
)
def test_a_program_reaches_the_point_that_the_camera_shows(
    pose: tuple[float, float, float],
    camera: tuple[float, float, float],
    point: tuple[float, float],
    mirrored: bool,
    dialect: Dialect,
) -> None:
    """The camera of the machine shows an artwork point at a pixel, whose machine coordinates are those of the G-code.

    Pixels: columns increase along the camera's direction, rows a quarter turn clockwise from it.
    """
    view = BoardView(scale=20e-6, shape=(480, 640), pose=pose, mirrored=mirrored)
    column, row = view.to_pixels(point) - view.centre_px
    seen = complex(*camera[:2]) + 20e-6 * complex(column, -row) * cmath.exp(1j * camera[2])
    code = work_offset_code(work_offset(pose, camera, mirrored=mirrored), dialect, "test board")
    x = -point[0] if mirrored else point[0]
    reached = machine_point(code, 1e3 * x, 1e3 * point[1])
    # Millimetres have five decimals, degrees six: at 0.6 m 1e-5 mm each.
    assert reached == pytest.approx(1e3 * seen, abs=5e-5)
    assert ("mirrored" in code) == mirrored
    assert code.startswith("(test board)\n")


def test_offset_maps_points_like_its_code() -> None:
    offset = WorkOffset(0.1, -0.02, 0.3, True)
    reached = machine_point(work_offset_code(offset, "fanuc"), -7.0, 5.0)
    np.testing.assert_allclose([reached.real, reached.imag], 1e3 * offset.to_machine((7e-3, 5e-3)), atol=5e-5)


@pytest.mark.parametrize(("turn", "theta", "mirrored", "rotation"), [
    (0.5, 0.75, False, -0.25),
    (0.5, 0.75, True, 1.25),
    (3.0, -1.0, False, 4.0 - 2.0 * math.pi),
    (-3.0, 1.0, False, 2.0 * math.pi - 4.0),
    (3.0, 1.0, True, 4.0 - 2.0 * math.pi),
])  # fmt: skip
def test_rotation_is_at_most_a_half_turn(turn: float, theta: float, mirrored: bool, rotation: float) -> None:
    found = work_offset((0.02, 0.03, theta), (0.1, -0.2, turn), mirrored=mirrored)
    assert found.rotation == pytest.approx(rotation, abs=1e-12)
    assert found.is_mirrored == mirrored
    np.testing.assert_allclose(found.to_machine((0.02, 0.03)), (0.1, -0.2), atol=1e-12)


@pytest.mark.parametrize(("dialect", "lines"), [
    ("linuxcnc", ["G21 (mm)", "G90", "G10 L2 P1 X12.50000 Y-3.25000 R28.647890", "G54"]),
    ("fanuc", ["G21 (mm)", "G90", "G69", "G10 L2 P1 X12.50000 Y-3.25000", "G54", "G68 X0 Y0 R28.647890"]),
])  # fmt: skip
def test_words_of_the_code(dialect: Dialect, lines: list[str]) -> None:
    plain, mirrored = (WorkOffset(0.0125, -0.00325, 0.5, each) for each in (False, True))
    assert work_offset_code(plain, dialect) == "\n".join(lines) + "\n"
    note = "(bottom side: the program must be mirrored, x to -x)"
    assert work_offset_code(mirrored, dialect, "board 7") == "\n".join(["(board 7)", note, *lines]) + "\n"
    for comment in ("a\nM3", "a(b", "a\rM3"):
        with pytest.raises(ValueError, match="has a parenthesis or a line break"):
            work_offset_code(plain, dialect, comment)


def test_wrong_dialects_numbers_and_comments_are_refused() -> None:
    dialect: Any = "grbl"
    with pytest.raises(ValueError, match="expected one of linuxcnc, fanuc"):
        work_offset_code(WorkOffset(0, 0, 0), dialect)
    with pytest.raises(ValueError, match="parenthesis"):
        work_offset_code(WorkOffset(0, 0, 0), comment="a) M3 S9000")
    with pytest.raises(ValueError, match="pose"):
        work_offset((math.nan, 0, 0), (0, 0, 0))
