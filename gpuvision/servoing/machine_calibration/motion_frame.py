"""Motion frame of a head from commanded positions and seen poses: scales, non-orthogonality, camera angle and offset.

The camera of the head measures its pose on a fixed board: ``p = b + A q + R(alpha) u`` and ``psi = psi_0 + alpha`` at
the commanded position q and head angle alpha. A has the axes as columns, u is the camera's offset from the head's
rotation axis. It is the equation A X = X B of hand-eye calibration [1]_ in the plane, written for absolute poses: each
pose has its own noise, and the equations are linear in A, b, u and psi_0.

References
----------
.. [1] R. Y. Tsai and R. K. Lenz, "A new technique for fully autonomous and efficient 3D robotics hand/eye calibration",
   IEEE Transactions on Robotics and Automation 5, 1989 (A X = X B).
.. [2] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 8.3.3 and
   8.4.3 (motion coordinate system).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.matching.pose.motion import rotation
from gpuvision.ranging.homography_fit import DegenerateError
from gpuvision.servoing.frames import ARTWORK, CAMERA, MOTION, Transform
from gpuvision.servoing.machine_calibration.linear_fit import fit_linear, whiten
from gpuvision.servoing.machine_calibration.next_measurement import NextMeasurement, most_informative

Float64 = npt.NDArray[np.float64]

_AXES = ("x scale", "rotation", "skew", "y scale")
_NAMES = (*_AXES, "board x", "board y", "camera angle", "camera offset x", "camera offset y")
_OFFSET = slice(7, 9)
# Moves across their common direction below this fraction of their length count as 0: the same as in `linear_fit`.
_FLAT = 1e-9
# Significance of the determinant of the axes [standard deviations]: one false alarm in 30 000 for normal errors.
_AXES_SIGNIFICANCE = 4.0


@dataclass(frozen=True, kw_only=True)
class MotionPrior:
    """Standard deviations of the motion frame before the first move, for the choice of the next one.

    Attributes
    ----------
    axes : float
        Each element of the matrix of the axes, relative: scale, angle and skew; default 0.01 (chosen: a machine whose
        axes are right to a percent).
    position : float
        Place of the board and offset of the camera [m]; default 10 mm (chosen).
    """

    axes: float = 0.01
    position: float = 10e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionFrame:
    """Calibrated axes of a head.

    Attributes
    ----------
    parameters : numpy.ndarray
        (7,): scale of x and of y (seen over commanded length), skew (angle between the axes less a right angle) [rad],
        angle of the x axis on the board [rad], angle of the camera against the x axis [rad], and the offset of the
        camera from the head's rotation axis in motion axes, x and y [m]; NaN where it is not observable.
    covariance : numpy.ndarray
        (7, 7): covariance of ``parameters``; NaN where they are.
    unobservable : tuple of str
        Names of parameters that the moves do not determine.
    transform : Transform
        From "motion" (commands at the head angle ``head_angle``) to "artwork" (camera positions on the board).
    head_angle : float
        Angle of the head [rad] at which the translation of ``transform`` holds: 0, and the angle of all commands where
        the head did not turn, since the turned offset of the camera is then part of the place of the board.
    camera_to_motion : Transform
        From "camera" to "motion": command that moves the head by a vector seen in the camera frame. It has no
        translation.
    residual_scale : float
        Root of the reduced chi-square: above 1 the axes are less repeatable than the vision. NaN without
        degrees of freedom.
    """

    parameters: Float64
    covariance: Float64
    unobservable: tuple[str, ...]
    transform: Transform
    head_angle: float
    camera_to_motion: Transform
    residual_scale: float

    @property
    def sigmas(self) -> Float64:
        """(7,) standard deviations of ``parameters``."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


def fit_motion_frame(commands: npt.ArrayLike, seen: npt.ArrayLike, covariance: npt.ArrayLike) -> MotionFrame:
    """Fit the motion frame to poses of the camera on a fixed board.

    Parameters
    ----------
    commands : array_like
        (n, 3): commanded positions x, y [m] and angle of the head [rad].
    seen : array_like
        (n, 3): poses of the camera on the board, x, y [m] and theta [rad].
    covariance : array_like
        Covariance of a pose, (3, 3) or (n, 3, 3).

    Returns
    -------
    MotionFrame

    Raises
    ------
    DegenerateError
        The moves do not determine scales, skew and angles; the message names the missing parameters. Or the seen
        positions do not follow the commands in two directions.
    ValueError
        A shape is wrong, a number is not finite, or the seen axes are mirrored.

    Notes
    -----
    Without turns of the head the data do not separate the offset of the camera from the place of the board: it is NaN
    and named in ``unobservable``. The translation of ``transform`` then holds at ``head_angle`` alone; everything else
    does not depend on the offset.
    """
    given, poses = np.asarray(commands, np.float64), np.asarray(seen, np.float64)
    for name, values in (("commands", given), ("seen", poses)):
        if values.shape != (*given.shape[:1], 3) or not np.all(np.isfinite(values)):
            raise ValueError(f"{name} have shape {values.shape}, expected finite numbers (n, 3), as many of both")
    _check_moves(given)
    design = _design(given)
    turned = np.ptp(np.unwrap(np.sort(given[:, 2] % (2 * math.pi)))) > _FLAT
    names = _NAMES if turned else _NAMES[: _OFFSET.start]
    observed = poses.copy()
    observed[:, 2] = _wrap(poses[:, 2] - given[:, 2], poses[0, 2] - given[0, 2])
    advice = "move the head in x and y, and turn it at different places"
    fit = fit_linear(design[:, :, : len(names)], observed, covariance, names, advice)
    _check_axes(fit.values[:4], fit.covariance[:4, :4])
    rows = _parameter_rows(fit.values)
    parameters = _parameters(fit.values)
    spread = rows @ fit.covariance @ rows.T
    if not turned:
        parameters[5:] = spread[5:] = spread[:, 5:] = math.nan
    return MotionFrame(
        parameters=parameters,
        covariance=spread,
        unobservable=() if turned else _NAMES[7:9],
        transform=_to_board(fit.values, fit.covariance),
        head_angle=0.0 if turned else float(given[0, 2]),
        camera_to_motion=_camera_to_motion(fit.values, fit.covariance),
        residual_scale=fit.residual_scale,
    )


def next_move(
    commands: npt.ArrayLike,
    candidates: npt.ArrayLike,
    covariance: npt.ArrayLike,
    *,
    prior: MotionPrior = MotionPrior(),
) -> NextMeasurement:
    """Propose the move that tells most about the motion frame.

    Parameters
    ----------
    commands : array_like
        (n, 3): commands already measured [m, m, rad]; may be empty, (0, 3).
    candidates : array_like
        (m, 3): commands to choose from.
    covariance : array_like
        (3, 3): covariance of a seen pose.
    prior : MotionPrior
        What is known before the first move.

    Notes
    -----
    The angle of the camera is not counted: every move tells the same about it.
    """
    position = np.asarray(covariance, np.float64)[:2, :2]
    kept = [number for number, name in enumerate(_NAMES) if name != "camera angle"]

    def rows(values: npt.ArrayLike) -> Float64:
        return whiten(_design(np.asarray(values, np.float64).reshape(-1, 3))[:, :2, kept], position)

    tried = rows(commands).reshape(-1, len(kept))
    known = np.array([prior.axes] * 4 + [prior.position] * 4)
    return most_informative(rows(candidates), tried.T @ tried + np.diag(known**-2.0))


def _check_moves(commands: Float64) -> None:
    """Refuse commands along one line, with the names of the parameters that stay unknown."""
    if not len(commands):
        raise DegenerateError("there is no command; move the head in x and y, and turn it at different places")
    moves = commands[:, :2] - commands[:, :2].mean(axis=0)
    _, lengths, directions = np.linalg.svd(np.vstack([moves, np.zeros((2, 2))]), full_matrices=False)
    if lengths[0] == 0.0:
        raise DegenerateError("all commands are at one place: x scale, rotation, skew and y scale cannot be found")
    if lengths[1] > _FLAT * lengths[0]:
        return
    x, y = np.abs(directions[0])
    along, missing = "on one slanted line", "skew and the ratio of the scales"
    if y <= _FLAT:
        along, missing = "along x", "skew and y scale"
    elif x <= _FLAT:
        along, missing = "along y", "skew and x scale"
    raise DegenerateError(f"all moves are {along}: {missing} cannot be found; move across that line, too")


def _check_axes(axes: Float64, covariance: Float64) -> None:
    """Refuse axes (ax, ay, bx, by) that are mirrored, or whose determinant does not differ from 0."""
    ax, ay, bx, by = axes
    slope = np.array([by, -bx, -ay, ax])
    area, sigma = ax * by - ay * bx, math.sqrt(max(float(slope @ covariance @ slope), 0.0))
    if area < -_AXES_SIGNIFICANCE * sigma:
        raise ValueError(
            "the seen axes are mirrored: y is clockwise from x; check the signs of the commands and of the seen poses"
        )
    if area <= _AXES_SIGNIFICANCE * sigma:
        raise DegenerateError(
            "the seen positions do not follow the commands in two directions; check that the head moves and that both "
            "are in metres"
        )


def _design(commands: Float64) -> Float64:
    """Return the derivatives (n, 3, 9) of x, y and the angle less the commanded one by the linear parameters."""
    x, y, alpha = commands.T
    c, s = np.cos(alpha), np.sin(alpha)
    rows = np.zeros((len(commands), 3, len(_NAMES)))
    rows[:, 0, 0] = rows[:, 1, 1] = x
    rows[:, 0, 2] = rows[:, 1, 3] = y
    rows[:, 0, 4] = rows[:, 1, 5] = rows[:, 2, 6] = 1.0
    rows[:, 0, 7], rows[:, 0, 8] = c, -s
    rows[:, 1, 7], rows[:, 1, 8] = s, c
    return rows


def _parameters(values: Float64) -> Float64:
    """Return scales, skew, angle of x, angle of the camera and its offset (7,) of the linear parameters."""
    axis_x, axis_y, psi = values[:2], values[2:4], values[6]
    beta = math.atan2(axis_x[1], axis_x[0])
    skew = float(_wrap(np.array(math.atan2(axis_y[1], axis_y[0]) - beta - 0.5 * math.pi), 0.0))
    camera = float(_wrap(np.array(psi - beta), 0.0))
    offset = rotation(-beta) @ values[_OFFSET] if len(values) == len(_NAMES) else np.zeros(2)
    return np.array([math.hypot(*axis_x), math.hypot(*axis_y), skew, beta, camera, *offset])


def _parameter_rows(values: Float64) -> Float64:
    """Return the derivatives (7, p) of `_parameters`."""
    rows = np.zeros((7, len(values)))
    (ax, ay), (bx, by) = values[:2], values[2:4]
    first, second = math.hypot(ax, ay), math.hypot(bx, by)
    turn_x, turn_y = np.array([-ay, ax]) / first**2, np.array([-by, bx]) / second**2
    rows[0, :2], rows[1, 2:4] = (ax / first, ay / first), (bx / second, by / second)
    rows[2, :2], rows[2, 2:4] = -turn_x, turn_y
    rows[3, :2] = turn_x
    rows[4, :2], rows[4, 6] = -turn_x, 1.0
    if len(values) == len(_NAMES):
        beta = math.atan2(ay, ax)
        x, y = rotation(-beta) @ values[_OFFSET]
        rows[5:, _OFFSET] = rotation(-beta)
        rows[5:, :2] = np.outer((y, -x), turn_x)  # d(R(-beta) u) / d(beta)
    return rows


def _to_board(values: Float64, covariance: Float64) -> Transform:
    """Return the transform from commands to camera positions on the board, at the head angle 0 or the only one."""
    rows = np.zeros((6, len(values)))
    for element, parameter in ((0, 0), (1, 2), (2, 4), (3, 1), (4, 3), (5, 5)):
        rows[element, parameter] = 1.0
    if len(values) == len(_NAMES):  # R(0) u = u
        rows[2, 7] = rows[5, 8] = 1.0
    return Transform.affine(MOTION, ARTWORK, (rows @ values).reshape(2, 3), rows @ covariance @ rows.T)


def _camera_to_motion(values: Float64, covariance: Float64) -> Transform:
    """Return the linear transform ``A^-1 R(psi_0)`` from vectors in the camera frame to commands."""
    matrix = np.array([[values[0], values[2]], [values[1], values[3]]])
    inverse, turned = np.linalg.inv(matrix), rotation(float(values[6]))
    linear = inverse @ turned
    rows = np.zeros((2, 3, len(values)))
    for parameter, (row, column) in enumerate(((0, 0), (1, 0), (0, 1), (1, 1))):
        unit = np.zeros((2, 2))
        unit[row, column] = 1.0
        rows[:, :2, parameter] = -inverse @ unit @ linear  # d(A^-1) = -A^-1 dA A^-1
    rows[:, :2, 6] = linear @ np.array([[0.0, -1.0], [1.0, 0.0]])
    by_value = rows.reshape(6, -1)
    matrix = np.column_stack([linear, np.zeros(2)])
    return Transform.affine(CAMERA, MOTION, matrix, by_value @ covariance @ by_value.T)


def _wrap(angles: Float64, centre: float) -> Float64:
    """Return angles in the half-open turn about a centre [rad]."""
    return np.asarray((angles - centre + math.pi) % (2 * math.pi) - math.pi + centre)
