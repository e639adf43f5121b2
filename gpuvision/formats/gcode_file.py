"""G-code of a located board: work offset and rotation, so that a program in the frame of the artwork runs on the board.

Words are in millimetres (G21) and degrees, counter-clockwise seen from above. Two dialects differ in the rotation:
LinuxCNC keeps it in the work coordinate system (``G10 L2 P1 X Y R``), Fanuc and similar controllers (Mach3, Mach4)
rotate the program (``G10 L2 P1 X Y``, then ``G68 X0 Y0 R``). Both set the coordinate system G54. GRBL cannot rotate and
is no dialect.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.validation import numbers

Dialect = Literal["linuxcnc", "fanuc"]
DIALECTS = ("linuxcnc", "fanuc")


class WorkOffset(NamedTuple):
    """Frame of a program on a machine: machine = (x, y) + R(rotation) program.

    Attributes
    ----------
    x, y : float
        Machine coordinates of the program's origin [m].
    rotation : float
        Angle of the program's x axis, counter-clockwise from the x axis of the machine [rad], -pi to pi.
    is_mirrored : bool
        Whether the program must be mirrored, x to -x, as for the bottom side of a board. Default False.
    """

    x: float
    y: float
    rotation: float
    is_mirrored: bool = False

    def to_machine(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return machine coordinates (..., 2) [m] of points (..., 2) of the artwork [m]."""
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        program = np.asarray(points, np.float64) * (-1.0 if self.is_mirrored else 1.0, 1.0)
        return np.asarray(program @ np.array([[c, s], [-s, c]]) + (self.x, self.y))


def work_offset(pose: npt.ArrayLike, camera_at: npt.ArrayLike, *, mirrored: bool = False) -> WorkOffset:
    """Return the work offset of a board from the pose of a camera that the machine carries.

    Parameters
    ----------
    pose : array_like, (3,)
        Point of the artwork at the image centre x, y [m], and direction of increasing columns on the artwork [rad], as
        `LocatedBoard.pose`.
    camera_at : array_like, (3,)
        Machine coordinates of the point at the image centre x, y [m]: position of the axes plus offset of the camera
        from the tool; direction of increasing columns, counter-clockwise from the x axis of the machine [rad].
    mirrored : bool
        The image shows the bottom side of the board: the program must be mirrored, x to -x. Default False.

    Raises
    ------
    TypeError, ValueError
        A number is not finite.
    """
    x, y, theta = numbers(pose, (3,), "pose")
    at_x, at_y, angle = numbers(camera_at, (3,), "camera_at")
    # A mirrored artwork has the mirrored x, and its angles have the other sign.
    rotation = angle + theta if mirrored else angle - theta
    offset = WorkOffset(0.0, 0.0, math.remainder(rotation, 2 * math.pi), mirrored)
    back = offset.to_machine((x, y))
    return offset._replace(x=at_x - float(back[0]), y=at_y - float(back[1]))


def work_offset_code(offset: WorkOffset, dialect: Dialect = "linuxcnc", comment: str = "") -> str:
    """Return the G-code that sets the work offset and the rotation; the program of the board follows it.

    Parameters
    ----------
    offset : WorkOffset
    dialect : {"linuxcnc", "fanuc"}
    comment : str
        First line of the code, without parentheses.

    Raises
    ------
    ValueError
        The dialect is unknown, or the comment has a parenthesis or a line break, which would end it.
    """
    if dialect not in DIALECTS:
        raise ValueError(f"the dialect is {dialect!r}, expected one of {', '.join(DIALECTS)}")
    if not comment.isprintable() or any(each in comment for each in "()"):
        raise ValueError(f"the comment {comment!r} has a parenthesis or a line break")
    turn = f"R{math.degrees(offset.rotation):.6f}"
    place = f"G10 L2 P1 X{1e3 * offset.x:.5f} Y{1e3 * offset.y:.5f}"
    lines = [f"({comment})"] if comment else []
    if offset.is_mirrored:
        lines.append("(bottom side: the program must be mirrored, x to -x)")
    lines += ["G21 (mm)", "G90"]
    # A rotation of an earlier program would turn the new one further: G69 ends it.
    lines += [f"{place} {turn}", "G54"] if dialect == "linuxcnc" else ["G69", place, "G54", f"G68 X0 Y0 {turn}"]
    return "\n".join(lines) + "\n"
