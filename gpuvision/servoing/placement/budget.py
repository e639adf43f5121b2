"""Error budget of a placement: calibration, vision, etch bias, servo and thermal drift.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 5.4.4 and
   8.7.
.. [2] K. J. Astrom, *Introduction to Stochastic Control Theory*, Academic Press 1970, chapter 5, section 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.delay import characteristic_polynomial
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import REMAINDER
from gpuvision.servoing.placement.plan import PlacementPlan

Float64 = npt.NDArray[np.float64]


class ErrorBudget(NamedTuple):
    """Covariances of the sources of the placement error.

    Attributes
    ----------
    sources : mapping of str to numpy.ndarray
        Covariance (3, 3) of the pose of the nozzle on the board by source: "calibration", "vision", "etch bias",
        "servo", "drift".
    total : numpy.ndarray
        (3, 3): sum of all sources.
    """

    sources: Mapping[str, Float64]
    total: Float64

    @property
    def sigmas(self) -> dict[str, Float64]:
        """Standard deviations (3,) of x, y [m] and theta [rad] by source, and of the "total"."""
        each = {**self.sources, "total": self.total}
        return {name: np.sqrt(np.diag(covariance)) for name, covariance in each.items()}


def noise_gain(delay: float, gain: float) -> float:
    """Return the variance of the position of a servo loop at rest over the variance of a measured position.

    Parameters
    ----------
    delay : float
        Delay [frames], 0 or more.
    gain : float
        Fraction of the error that one frame corrects; the loop must be stable.

    Notes
    -----
    Independent errors of the frames add: the sum of the squared steps of the step response, in closed form by the
    recursion of Astrom (1970). Without delay it is ``gain / (2 - gain)``.

    Raises
    ------
    ValueError
        The loop is not stable, or the gain is 0.
    """
    poles = characteristic_polynomial(delay, gain)
    zeros = np.zeros(len(poles))
    zeros[1] = gain
    total = 0.0
    while len(poles) > 1:
        if abs(poles[-1]) >= poles[0]:
            raise ValueError(f"the loop with delay {delay:g} frames and gain {gain:g} is not stable: no variance")
        total += zeros[-1] ** 2 / poles[0]
        mirrored = poles[::-1] / poles[0]
        poles, zeros = (poles - poles[-1] * mirrored)[:-1], (zeros - zeros[-1] * mirrored)[:-1]
    return float(total + zeros[0] ** 2 / poles[0])


def predict_budget(machine: Machine, plan: PlacementPlan) -> ErrorBudget:
    """Predict the error of a placement at the release.

    Parameters
    ----------
    machine : Machine
        Machine; its calibration has a covariance.
    plan : PlacementPlan
        Plan of the placement.

    Notes
    -----
    Calibration, etch bias and drift are common to all frames of a placement. "vision" is the motion by the errors of
    the measured poses, which the loop follows: it averages the noise from frame to frame (`noise_gain`), but not the
    differences between the pixels, which are the same in all frames of a head at rest. "servo" is the rest of the step
    response that `ReleaseRule` allows, evenly distributed, and the step of the encoder.
    """
    averaged, turn = noise_gain(machine.response_frames, machine.loop_gain), plan.camera_to_board
    steps = np.array([axis.encoder for axis in machine.axes])
    rest = REMAINDER * np.array([machine.tolerance.position] * 2 + [machine.tolerance.angle])
    sources = {
        "calibration": turn @ machine.pipette_in_camera.pose_covariance @ turn.T,
        "etch bias": plan.etch_bias,
        "drift": turn @ machine.drift.covariance @ turn.T,
        "vision": (averaged * (1.0 - plan.fixed_pattern) + plan.fixed_pattern) * plan.vision,
        "servo": np.diag(rest**2 / 3.0 + steps**2 / 12.0),
    }
    return ErrorBudget(sources, np.sum(list(sources.values()), axis=0))
