"""Axis of a rotating nozzle from the positions of a marker on it: centre, radius and run-out, with covariance.

The marker is seen at known angles phi of the nozzle. As complex numbers its positions are
``c + m exp(i phi) + b exp(-i phi) + f exp(2 i phi)``: the axis c, the marker m relative to the axis, and the error
motion of the axis (run-out) in the harmonics -1 and 2. The harmonics 0 and 1 of the error motion cannot be separated
from the axis and from the marker. The model is linear in its parameters.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 8.3.2 and
   8.4.2 (nozzle marker).
.. [2] ISO 230-7:2015, *Geometric accuracy of axes of rotation* (error motion, fundamental error).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.homography_fit import DegenerateError
from gpuvision.servoing.frames import CAMERA, PIPETTE, Transform
from gpuvision.servoing.machine_calibration.linear_fit import fit_linear, whiten
from gpuvision.servoing.machine_calibration.next_measurement import NextMeasurement, most_informative

Float64 = npt.NDArray[np.float64]

RUN_OUT_HARMONICS = (-1, 2)
"""Harmonics of the error motion that are fitted by default: the lowest that one marker can show."""


@dataclass(frozen=True, kw_only=True)
class NozzlePrior:
    """Standard deviations of the nozzle's parameters before the first measurement, for the choice of the next angle.

    Attributes
    ----------
    position : float
        Axis and marker [m]; default 1 mm (chosen: the field of view of a placement camera).
    run_out : float
        Each component of the error motion [m]; default 20 um (chosen: a worn nozzle).
    """

    position: float = 1e-3
    run_out: float = 20e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class NozzleAxis:
    """Calibrated rotation axis of a nozzle in the camera frame.

    Attributes
    ----------
    centre : numpy.ndarray
        (2,): axis [m].
    marker : numpy.ndarray
        (2,): position of the marker relative to the axis at the angle 0 [m].
    harmonics : tuple of int
        Fitted harmonics of the error motion.
    error_motion : numpy.ndarray
        (len(harmonics), 2): amplitude of each harmonic at the angle 0 [m].
    covariance : numpy.ndarray
        Covariance of centre, marker and error motion, (4 + 2 len(harmonics),) squared.
    residual_scale : float
        Root of the reduced chi-square: above 1 the marker moves more than its noise (asynchronous error motion); NaN
        without degrees of freedom.
    """

    centre: Float64
    marker: Float64
    harmonics: tuple[int, ...]
    error_motion: Float64
    covariance: Float64
    residual_scale: float

    @property
    def radius(self) -> float:
        """Distance of the marker from the axis [m]."""
        return float(np.hypot(*self.marker))

    @property
    def radius_sigma(self) -> float:
        """Standard deviation of the radius [m]."""
        direction = self.marker / self.radius
        return math.sqrt(float(direction @ self.covariance[2:4, 2:4] @ direction))

    @property
    def run_out(self) -> float:
        """Bound of the distance of the axis from its mean position over a turn [m]; reached for two harmonics."""
        return float(np.sum(np.hypot(*self.error_motion.T)))

    def position(self, angle: float) -> Float64:
        """Return the position (2,) of the axis at an angle [rad], with its error motion [m]."""
        return np.asarray(self._rows(angle) @ np.concatenate([self.centre, self.error_motion.ravel()]))

    def transform(self, angle: float = 0.0) -> Transform:
        """Return the pose of the nozzle ("pipette") in the camera frame at an angle [rad], with its covariance."""
        rows = self._rows(angle)
        of_axis = np.r_[0, 1, 4 : len(self.covariance)]
        covariance = np.zeros((3, 3))
        covariance[:2, :2] = rows @ self.covariance[np.ix_(of_axis, of_axis)] @ rows.T
        return Transform.rigid(PIPETTE, CAMERA, (*self.position(angle), angle), covariance)

    def _rows(self, angle: float) -> Float64:
        """Return the derivatives (2, 2 + 2 len(harmonics)) of the axis position by the centre and the error motion."""
        return np.delete(_design(np.array([angle]), self.harmonics)[0], (2, 3), axis=1)


def fit_nozzle_axis(
    angles: npt.ArrayLike,
    seen: npt.ArrayLike,
    covariance: npt.ArrayLike,
    *,
    harmonics: Sequence[int] = RUN_OUT_HARMONICS,
) -> NozzleAxis:
    """Fit the rotation axis of a nozzle to the positions of a marker.

    Parameters
    ----------
    angles : array_like
        (n,): commanded angles of the nozzle [rad], counter-clockwise in the camera frame.
    seen : array_like
        (n, 2): positions of the marker in the camera frame [m].
    covariance : array_like
        Covariance of a position, (2, 2) or (n, 2, 2) [m^2].
    harmonics : sequence of int
        Harmonics of the error motion, without 0 and 1. Default: -1 and 2; empty for an exact axis.

    Returns
    -------
    NozzleAxis

    Raises
    ------
    DegenerateError
        The angles do not determine all parameters.
    ValueError
        A shape or a harmonic is wrong, or the marker turns against the sense of the angles.

    Notes
    -----
    Without the harmonic -1 the sense is found from the residuals: at two angles, or at angles half a turn apart, both
    senses fit, and a wrong sense is not seen.
    """
    phi, points = np.asarray(angles, np.float64), np.asarray(seen, np.float64)
    if phi.ndim != 1 or points.shape != (len(phi), 2):
        raise ValueError(f"angles have shape {phi.shape} and positions {points.shape}, expected (n,) and (n, 2)")
    if not (np.all(np.isfinite(phi)) and np.all(np.isfinite(points))):
        raise ValueError("an angle or a position is not finite; drop refused measurements first")
    orders = tuple(harmonics)
    if {0, 1} & set(orders) or len(set(orders)) < len(orders):
        raise ValueError(f"harmonics are {orders}, expected different ones without 0 (the axis) and 1 (the marker)")
    distinct = len(np.unique(np.round(np.exp(1j * phi), 9)))
    if distinct < 2 + len(orders):
        raise DegenerateError(
            f"the nozzle was seen at {distinct} different angles, expected {2 + len(orders)} at least for the axis, "
            f"the marker and {len(orders)} harmonics of the run-out"
        )
    names = ["axis x", "axis y", "marker x", "marker y"]
    names += [f"run-out {axis} of harmonic {order}" for order in orders for axis in "xy"]
    fit = fit_linear(_design(phi, orders), points, covariance, names, "turn the nozzle to other angles")
    motion = fit.values[4:].reshape(-1, 2)
    marker = fit.values[2:4]
    if -1 in orders:
        is_reversed = np.hypot(*motion[orders.index(-1)]) > np.hypot(*marker)
    else:
        mirrored = fit_linear(_design(-phi, orders), points, covariance, names, "turn the nozzle to other angles")
        gain = fit.residual_scale**2 - mirrored.residual_scale**2
        is_reversed = fit.degrees_of_freedom * gain > 9.0  # 3 standard deviations; not with angles that fit both senses
    if is_reversed:
        raise ValueError("the marker turns against the sense of the angles: give them counter-clockwise as seen")
    return NozzleAxis(
        centre=fit.values[:2],
        marker=marker,
        harmonics=orders,
        error_motion=motion,
        covariance=fit.covariance,
        residual_scale=fit.residual_scale,
    )


def next_nozzle_angle(
    angles: npt.ArrayLike,
    candidates: npt.ArrayLike,
    covariance: npt.ArrayLike,
    *,
    harmonics: Sequence[int] = RUN_OUT_HARMONICS,
    prior: NozzlePrior = NozzlePrior(),
) -> NextMeasurement:
    """Propose the angle of the nozzle that tells most about its axis.

    Parameters
    ----------
    angles : array_like
        (n,): angles already measured [rad]; may be empty.
    candidates : array_like
        (m,): angles to choose from [rad].
    covariance : array_like
        (2, 2): covariance of a position [m^2].
    harmonics : sequence of int
        As in `fit_nozzle_axis`.
    prior : NozzlePrior
        What is known before the first measurement.
    """
    orders = tuple(harmonics)
    tried = whiten(_design(np.asarray(angles, np.float64), orders), covariance).reshape(-1, 4 + 2 * len(orders))
    known = np.array([prior.position] * 4 + [prior.run_out] * 2 * len(orders))
    return most_informative(
        whiten(_design(np.asarray(candidates, np.float64), orders), covariance), tried.T @ tried + np.diag(known**-2.0)
    )


def _design(angles: Float64, harmonics: tuple[int, ...]) -> Float64:
    """Return the derivatives (n, 2, 4 + 2 k) of the marker's position by axis, marker and error motion."""
    blocks = []
    for order in (0, 1, *harmonics):
        c, s = np.cos(order * angles), np.sin(order * angles)
        blocks.append(np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2))
    return np.concatenate(blocks, axis=-1)
