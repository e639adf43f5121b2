"""Plant in board axes: commands and readings of a machine whose calibrated axes are scaled, skewed or turned."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gpuvision.matching.pose.motion import rotation
from gpuvision.servoing.loop import Plant, PlantReading
from gpuvision.servoing.machine_calibration.motion_frame import MotionFrame

Float64 = npt.NDArray[np.float64]

_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])  # derivative of a rotation by its angle, times the inverse rotation


class CalibratedPlant:
    """Plant that takes velocities of the camera over the board and moves the axes of a machine accordingly.

    The poses that a camera measures, the observer, the controller and the guards then share the frame of the
    board; the axes behind it may have wrong scales, a skew, and another direction.

    Parameters
    ----------
    axes : Plant
        Machine that takes velocities in its motion axes: x, y [m/s] and the angle of the head [rad/s].
    frame : MotionFrame
        Calibration of these axes by `fit_motion_frame`.

    Notes
    -----
    It implements `gpuvision.servoing.loop.Plant`. The camera is at ``p = b + A q + R(alpha) u`` for the position q and
    the head angle alpha, so that the axes move with ``A^-1 (dp/dt - R'(alpha) u dalpha/dt)``. The compensation of a
    turn holds for the angle at the begin of a command: a turn by delta during one command leaves ``|u| delta^2 / 2``,
    which the loop corrects. Where the calibration had no turns u is taken as 0: the head must then keep its angle.
    """

    def __init__(self, axes: Plant, frame: MotionFrame) -> None:
        self.axes, self._to_board = axes, frame.transform
        self._to_motion = np.linalg.inv(frame.transform.linear)
        direction = float(frame.parameters[3])
        self._angle = direction + float(frame.parameters[4])  # of the camera on the board at the head angle 0
        offset = np.zeros(2) if frame.unobservable else frame.parameters[5:]
        self._offset: Float64 = rotation(direction) @ offset

    def command(self, time: float, velocity: Float64) -> None:
        """Move the camera over the board with a velocity (3,) [m/s], [m/s], [rad/s] from a time on.

        Raises
        ------
        ValueError
            The head turns, the camera is off its axis, and the reading of the angle is not finite.
        """
        moved = np.asarray(velocity[:2], np.float64)
        if velocity[2] != 0.0 and self._offset.any():
            angle = float(self.axes.read(time).position[2])
            if not np.isfinite(angle):
                raise ValueError("the angle of the head has no reading; the offset of the camera needs one")
            moved = moved - velocity[2] * (_TURN @ rotation(angle) @ self._offset)
        self.axes.command(time, np.array([*(self._to_motion @ moved), velocity[2]]))

    def read(self, time: float) -> PlantReading:
        """Return the pose (3,) of the camera on the board by the encoders, NaN where an axis that it needs has none.

        The limit of a motion axis is reported for the axis of the board that is nearest to its direction.
        """
        reading = self.axes.read(time)
        angle = float(reading.position[2])
        turn = (rotation(angle) - np.eye(2)) @ self._offset if self._offset.any() else np.zeros(2)
        place = self._to_board.apply(reading.position[:2]) + turn
        limits = np.array([0, 0, reading.at_limit[2]], np.int8)
        for axis in np.flatnonzero(reading.at_limit[:2]):
            direction = reading.at_limit[axis] * self._to_board.linear[:, axis]
            nearest = int(np.argmax(np.abs(direction)))
            limits[nearest] = np.sign(direction[nearest])
        return PlantReading(reading.time, np.array([*place, angle + self._angle]), limits)
