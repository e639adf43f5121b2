"""Simulated source of measured poses: a frame rate, a delay with jitter, noise, and faults."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from gpuvision.servoing.observer import SAME_TIME, PoseMeasurement, PosePrediction
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]

Fault = Callable[[int, PoseMeasurement], Sequence[PoseMeasurement]]
"""Function of frame number and measurement that returns the measurements that arrive: 0, 1 or more."""


class SimulatedPoseSensor:
    """Camera that measures a known motion.

    Parameters
    ----------
    pose : function
        True pose (n, 3) at times (n,) [s], such as `SimulatedPlant.pose`.
    period : float
        Time between two frames [s]. Range: above 0.
    delay : float
        Time from the middle of the exposure to the arrival of the pose [s]. Without jitter frame k arrives at
        ``k * period``, for every delay: in time for frame k of a loop that starts at 0. Range: 0 or more.
    exposure : float
        Time of exposure [s]: the pose is the mean over it. Default 0. Range: 0 or more.
    covariance : array_like
        (3, 3): covariance of the noise. Default 1e-12 for each axis (1 um, 1 urad).
    is_noisy : bool
        Whether the noise is added to the poses. Default True.
    jitter : float
        Standard deviation of the delay, normally distributed and not below 0 [s]. Default 0. Range: 0 or more.
    fault : function, optional
        Fault of each frame; see `Fault`.
    seed : int
        Seed of noise and jitter. Default 0.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or is out of its range.
    """

    def __init__(
        self,
        pose: Callable[[Float64], Float64],
        *,
        period: float,
        delay: float,
        exposure: float = 0.0,
        covariance: npt.ArrayLike = ((1e-12, 0.0, 0.0), (0.0, 1e-12, 0.0), (0.0, 0.0, 1e-12)),
        is_noisy: bool = True,
        jitter: float = 0.0,
        fault: Fault | None = None,
        seed: int = 0,
    ) -> None:
        self._pose, self.period = pose, finite(period, "period", above=0.0)
        self.delay, self.exposure = finite(delay, "delay", minimum=0.0), finite(exposure, "exposure", minimum=0.0)
        self.jitter = finite(jitter, "jitter", minimum=0.0)
        self._covariance = np.array(numbers(covariance, (3, 3), "covariance"))
        self._root = np.linalg.cholesky(self._covariance) if is_noisy else np.zeros((3, 3))
        self._fault, self._rng = fault, np.random.default_rng(seed)
        self._frame = 0
        self._waiting: list[PoseMeasurement] = []

    def __call__(self, time: float, predicted: PosePrediction | None = None) -> list[PoseMeasurement]:
        """Return the measurements that arrived since the last call, up to a time [s]; a prediction has no effect."""
        while self._exposed(self._frame) + 0.5 * self.exposure <= time + SAME_TIME:
            measurement = self._measure(self._frame)
            self._waiting += [measurement] if self._fault is None else self._fault(self._frame, measurement)
            self._frame += 1
        arrived = [each for each in self._waiting if each.arrived <= time + SAME_TIME]
        self._waiting = [each for each in self._waiting if each.arrived > time + SAME_TIME]
        return sorted(arrived, key=lambda each: each.arrived)

    def _exposed(self, frame: int) -> float:
        return frame * self.period - self.delay

    def _measure(self, frame: int) -> PoseMeasurement:
        exposed = self._exposed(frame)
        points = np.linspace(-0.5, 0.5, 5) if self.exposure else np.zeros(1)
        pose = self._pose(exposed + self.exposure * points).mean(axis=0)
        noise = self._root @ self._rng.standard_normal(3)
        late = max(self.delay + self.jitter * float(self._rng.standard_normal()), 0.0)
        return PoseMeasurement(exposed, exposed + late, pose + noise, self._covariance, 0)
