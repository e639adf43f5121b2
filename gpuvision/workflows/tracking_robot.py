"""Follow a robot through a recording of views: pose, covariance and probability at every frame.

References
----------
.. [1] S. Thrun, W. Burgard and D. Fox, *Probabilistic Robotics*, MIT Press 2005, chapter 7.
"""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.json import report_text
from gpuvision.host import Device, Source
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import write_text_atomic
from gpuvision.host.reading import FileLimit, reading
from gpuvision.matching.field.distance_map import Field
from gpuvision.matching.field.odometry import PoseEstimate
from gpuvision.matching.field.robot_filter import RobotFilter, RobotFilterLimits, RobotState
from gpuvision.plots.field import draw_robot_track
from gpuvision.validation import finite
from gpuvision.workflows.locating_robot import locate_robot, scan_floor

Float64 = npt.NDArray[np.float64]

TRACK_FILES = ("track.csv", "track.json", "track.png")
_COLUMNS = ("frame", "time", "x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta", "probability", "status")
_ODOMETRY = "forward,left,turn"
_LONGEST_LINE, _LONGEST_SHOWN = 1000, 60  # characters of a line that is read, and of a header in a message
# Largest motion between two frames [m] or [rad] (chosen): the size of a large field.
_LARGEST_MOTION = 1e3

MAX_MOTIONS = FileLimit("GPUVISION_MAX_MOTIONS", 1_000_000)
"""Motions of a CSV file of odometry. Chosen: 1 000 000, 9 hours at 30 frames per second."""


@dataclass(frozen=True, kw_only=True)
class MotionUncertainty:
    """Standard deviations of a robot's motion.

    Parameters
    ----------
    speed, turn_rate : float
        Speed and turn rate of a robot without odometry [m/s], [rad/s] (chosen: a walking pace and a quarter turn a
        second). Defaults 1.0 and 1.5.
    share : float
        Error of odometry, relative to the distance and to the turn (chosen: wheels on a carpet). Default 0.1.
    least, least_turn : float
        Smallest error of odometry in a frame [m], [rad] (chosen). Defaults 2e-3 and 2e-3.
    initial, initial_turn : float
        Error of a given first pose [m], [rad] (chosen: placed by hand). Defaults 0.5 and 0.35.
    """

    speed: float = 1.0
    turn_rate: float = 1.5
    share: float = 0.1
    least: float = 2e-3
    least_turn: float = 2e-3
    initial: float = 0.5
    initial_turn: float = 0.35


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotTrack:
    """Track of a robot.

    Attributes
    ----------
    states
        State after each frame.
    refused
        Reason of each frame whose view was refused, by its number.
    warned
        Warnings of each frame that has some, by its number, such as an error of the scale.
    field
        The field.
    device
        Where it ran.
    """

    states: tuple[RobotState, ...]
    refused: dict[int, str]
    warned: dict[int, tuple[str, ...]]
    field: Field
    device: Device

    def summary(self) -> str:
        """Return the number of frames and the last pose in two lines."""
        last = self.states[-1]
        found = f"{len(self.states)} frames, {len(self.refused)} of them refused; last state {last.status.name or 'OK'}"
        x, y, theta = last.pose
        if not math.isfinite(x):
            return f"{found}\nno pose at the last frame"
        sigmas = np.sqrt(np.diag(last.covariance))
        return (
            f"{found}, probability {last.probability:.3f}\nx {x:.3f} m, y {y:.3f} m, heading {math.degrees(theta):.2f} "
            f"degrees; sigmas {1e3 * sigmas[0]:.2g} mm, {1e3 * sigmas[1]:.2g} mm, {math.degrees(sigmas[2]):.2g} degrees"
        )

    def problem(self) -> str | None:
        """Return the most frequent reason for which no frame has a pose; None if a frame has one."""
        if any(math.isfinite(state.pose[0]) for state in self.states):
            return None
        reasons = Counter(self.refused.values()).most_common(1)
        return f"no pose in {len(self.states)} frames" + (f": {reasons[0][0]}" if reasons else "")

    def warnings(self) -> tuple[str, ...]:
        """Return the first warning, and in how many frames there are warnings; nothing without warnings."""
        if not self.warned:
            return ()
        first = min(self.warned)
        count = f"{len(self.warned)} of {len(self.states)} frames have warnings"
        return (f"{count}; frame {first}: {self.warned[first][0]}",)

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each frame: metres, radians, seconds; None where a value is not known."""
        rows = []
        for number, state in enumerate(self.states):
            values = (*state.pose, *np.sqrt(np.diag(state.covariance)))
            numbers = [float(each) if math.isfinite(each) else None for each in values]
            row = (number, state.time, *numbers, state.probability, state.status.name or "OK")
            rows.append(dict(zip(_COLUMNS, row, strict=True)))
        return rows

    def report(self) -> dict[str, Any]:
        """Return the content of ``track.json``."""
        states = [
            row
            | {
                "covariance": None if row["x"] is None else state.covariance.tolist(),
                "hypotheses": [
                    {"pose": each.estimate.pose.tolist(), "probability": each.probability} for each in state.hypotheses
                ],
                "refused": self.refused.get(number),
                "warnings": list(self.warned.get(number, ())),
            }
            for number, (row, state) in enumerate(zip(self.rows(), self.states, strict=True))
        ]
        return {
            "gpuvision": version("gpuvision"),
            "field": self.field.name,
            "symmetric": self.field.is_symmetric,
            "frames": states,
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
        }

    def write(self, folder: Path) -> None:
        """Write ``track.csv``, ``track.json`` and the picture ``track.png`` into a folder."""
        text = io.StringIO()
        writer = csv.DictWriter(text, _COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(self.rows())
        write_text_atomic(folder / "track.csv", text.getvalue())
        write_text_atomic(folder / "track.json", report_text(self.report()))
        draw_robot_track(folder / "track.png", self.field, self.states)


def track_robot(
    source: Source,
    field: Field,
    *,
    rate: float,
    odometry: npt.ArrayLike | None = None,
    initial_pose: tuple[float, float, float] | None = None,
    uncertainty: MotionUncertainty = MotionUncertainty(),
    limits: RobotFilterLimits = RobotFilterLimits(),
    device: Device | None = None,
    **scan: Any,
) -> RobotTrack:
    """Follow a robot through a recording.

    Parameters
    ----------
    source
        Views; the source is closed at the end.
    field
        The field.
    rate
        Frames per second, 0.001 to 1e7.
    odometry
        (frames - 1, 3) motions (forward, left, turn) from each frame to the next [m], [m], [rad]. None: unknown.
    initial_pose
        Pose at the first frame, x, y [m], heading [rad]; needed to tell the two poses on a symmetric field apart. None:
        unknown.
    uncertainty, limits
        Standard deviations of the motion, and thresholds of the filter.
    device
        Where to run; None: `Device.best`.
    **scan
        Parameters of `scan_floor`: ``line_width``, and ``scale`` or ``model``, ...

    Raises
    ------
    ValueError
        The rate is out of range, or the odometry has another number of rows than there are motions.
    RecordingError
        A frame cannot be read, or the recording is empty.
    """
    finite(rate, "rate", minimum=1e-3, maximum=1e7)
    device = Device.best() if device is None else device
    motions = None if odometry is None else np.asarray(odometry, np.float64).reshape(-1, 3)
    initial = None
    if initial_pose is not None:
        sigmas = np.array([uncertainty.initial, uncertainty.initial, uncertainty.initial_turn])
        initial = PoseEstimate(np.array(initial_pose, np.float64), np.diag(sigmas**2))
    robot, states = RobotFilter(field, initial, limits=limits), list[RobotState]()
    refused, warned = dict[int, str](), dict[int, tuple[str, ...]]()
    if motions is not None and source.length is not None and len(motions) != source.length - 1:
        source.close()
        raise _wrong_number(len(motions), source.length)
    frame, arrived = np.empty((1, *source.shape), source.dtype), np.zeros(1, np.int64)
    try:
        while source.wait() and source.read_into(frame, arrived):
            number = len(states)
            if number:
                if motions is not None and number > len(motions):
                    raise ValueError(f"the odometry has {len(motions)} motions, fewer than between the frames")
                robot.move(number / rate, *_motion(motions, number - 1, rate, uncertainty))
            located = locate_robot(scan_floor(frame[0], device=device, **scan), field, device=device)
            if located.reason:
                refused[number] = located.reason
            if located.warnings:
                warned[number] = located.warnings
            robot.see(number / rate, located.candidates)
            states.append(robot.state())
    finally:
        source.close()
    if not states:
        raise RecordingError("the recording has no frame")
    if motions is not None and len(motions) != len(states) - 1:
        raise _wrong_number(len(motions), len(states))
    return RobotTrack(states=tuple(states), refused=refused, warned=warned, field=field, device=device)


def _wrong_number(motions: int, frames: int) -> ValueError:
    return ValueError(f"the odometry has {motions} motions, expected {frames - 1} between {frames} frames")


def _motion(
    motions: Float64 | None, number: int, rate: float, uncertainty: MotionUncertainty
) -> tuple[Float64, Float64]:
    """Return the motion between two frames with its covariance."""
    if motions is None:
        sigmas = np.array([uncertainty.speed, uncertainty.speed, uncertainty.turn_rate]) / rate
        return np.zeros(3), np.diag(sigmas**2)
    forward, left, turn = motions[number]
    moved = uncertainty.least + uncertainty.share * math.hypot(forward, left)
    sigmas = np.array([moved, moved, uncertainty.least_turn + uncertainty.share * abs(turn)])
    return motions[number], np.diag(sigmas**2)


def _motion_of(line: str, place: str) -> list[float]:
    """Return the three numbers of a line of odometry."""
    try:
        motion = [float(each) for each in line.split(",")]
    except ValueError as error:
        shown = repr(line.strip()[:_LONGEST_SHOWN])
        raise RecordingError(f"{place}: not a readable list of motions: {shown}, expected {_ODOMETRY}") from error
    if len(motion) != 3 or not np.isfinite(motion).all():
        raise RecordingError(f"{place}: expected three finite numbers, {_ODOMETRY}")
    for value in motion:
        if abs(value) > _LARGEST_MOTION:
            raise RecordingError(f"{place}: {value:g}, expected a motion of at most {_LARGEST_MOTION:g} m or rad")
    return motion


def read_odometry(path: Path) -> Float64:
    """Read the motions between frames: CSV with the header ``forward,left,turn`` [m], [m], [rad].

    Raises
    ------
    OSError
        The file cannot be read.
    RecordingError
        The file has another header or content, a motion above 1000 m or rad, or more than `MAX_MOTIONS` motions.
    """
    motions: list[list[float]] = []
    with reading(path, "list of motions", RecordingError), path.open(encoding="utf-8-sig") as file:
        head = file.readline(_LONGEST_LINE).strip()
        if head.replace(" ", "") != _ODOMETRY:
            raise RecordingError(f"{path}: the header is {head[:_LONGEST_SHOWN]!r}, expected {_ODOMETRY}")
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), ""), 2):
            if not line.strip():
                continue
            MAX_MOTIONS.check(len(motions) + 1, f"{path}: {len(motions) + 1} motions or more", RecordingError)
            motions.append(_motion_of(line, f"{path}: line {number}"))
    return np.array(motions, np.float64).reshape(-1, 3)
