"""Simulated placements of parts on a board: the true image processing looks at a rendered board while the head moves.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.7.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.placement.budget import ErrorBudget, predict_budget
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import Placement, place_part
from gpuvision.servoing.placement.plan import PlacementPlan, plan_placement
from gpuvision.servoing.placement.vision import BoardPoseSensor, SimulatedCamera
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.validation import integer

Float64 = npt.NDArray[np.float64]

# Start errors fill this part of the landing zone: the first pose has an error, too (chosen).
_START = 0.9
# The board is rendered this far beyond the landing zone [px] (chosen).
_MARGIN_PX = 32


class PlacementResult(NamedTuple):
    """Simulated placements.

    Attributes
    ----------
    plan : PlacementPlan
        Features and camera pose.
    machine : Machine
        Machine over the side of the artwork.
    budget : ErrorBudget
        Predicted error by source.
    placements : tuple of Placement
        Runs of the loop.
    error : numpy.ndarray
        (n, 3): true pose of the nozzle at the release less the target [m], [m], [rad]; NaN where the part was not
        released.
    motion : tuple of numpy.ndarray
        True pose of the nozzle less the target in each frame [m], [m], [rad], (frames, 3) for each run; the last one is
        the error at the release.
    sources : mapping of str to numpy.ndarray
        Parts of the error (n, 3): "calibration", "drift", and "vision and servo", which is the rest.
    """

    plan: PlacementPlan
    machine: Machine
    budget: ErrorBudget
    placements: tuple[Placement, ...]
    error: Float64
    motion: tuple[Float64, ...]
    sources: dict[str, Float64]

    @property
    def simulated_sigmas(self) -> Float64:
        """Predicted standard deviations (3,) of the sources that the simulation has: all but the etch bias."""
        covariance = self.budget.total - self.budget.sources["etch bias"]
        return np.asarray(np.sqrt(np.diag(covariance)))

    def summary(self) -> str:
        """Return the result in a few lines."""
        released = np.isfinite(self.error[:, 0])
        frames = [each.frames for each in self.placements if each.released]
        least = [each.predicted_frames + 1 for each in self.placements if each.released]
        lines = [f"{np.sum(released)} of {len(released)} parts placed"]
        if self.plan.landing is not None:
            lines.append(f"coarse registration of the first frame: {1e3 * self.machine.landing:.1f} ms")
        if np.any(released):
            measured = np.sqrt(np.mean(self.error[released] ** 2, axis=0))
            lines[0] += f", in {np.mean(frames):.1f} frames (the release waits for {np.mean(least):.1f})"
            lines += [
                _triple("error, root mean square", measured),
                _triple("error, predicted", self.simulated_sigmas),
            ]
        lines += sorted({f"aborted: {each.reason}" for each in self.placements if not each.released})
        return "\n".join(lines)

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``: the keys name their SI units."""
        released = np.isfinite(self.error[:, 0])
        found = self.error[released]
        delay = self.machine.delay
        measured = {"total": found, **{name: each[released] for name, each in self.sources.items()}}
        return {
            "gpuvision": version("gpuvision"),
            "target": _pose(self.plan.target),
            "rate_Hz": self.machine.rate,
            "features": len(self.plan.features.length) + len(self.plan.features.fiducials.radius),
            "search_range_m": self.plan.features.imaging.shift,
            "landing_s": None if self.plan.landing is None else self.machine.landing,
            "period_s": self.machine.period,
            "parts_s": delay.parts,
            "total_delay_s": delay.total,
            "delay_frames": delay.frames,
            "gain_per_frame": self.machine.loop_gain,
            "predicted_sigma": {name: _pose(each) for name, each in self.budget.sigmas.items()},
            "predicted_sigma_simulated": _pose(self.simulated_sigmas),
            "measured_rms": {
                name: _pose(np.sqrt(np.mean(each**2, axis=0))) if len(each) else None for name, each in measured.items()
            },
            "placements": [
                {
                    "released": each.released,
                    "reason": each.reason,
                    "start_error": _pose(each.start_error),
                    "frames": each.frames,
                    "predicted_frames": each.predicted_frames + 1,
                    "error": _pose(error) if each.released else None,
                }
                for each, error in zip(self.placements, self.error, strict=True)
            ],
        }


def simulate_placements(
    artwork: Artwork,
    target: npt.ArrayLike,
    machine: Machine,
    *,
    count: int = 20,
    budget: float = 60,
    seed: int = 0,
    device: Device | None = None,
    progress: Callable[[int, int | None], object] | None = None,
) -> PlacementResult:
    """Simulate placements from random start errors, with rendered frames and the true image processing.

    Parameters
    ----------
    artwork : Artwork
        Side of the board on which parts are placed, read with the clearance of `placement_imaging`.
    target : array_like
        (3,): pose of the part in the frame of the board's files, x, y [m], theta [rad], as in `plan_placement`.
    machine : Machine
        Machine. `Machine.for_side` turns it to the side of the artwork.
    count : int
        Number of placements, 1 or more. Default 20.
    budget : float
        Number of rulers, default 60.
    seed : int
        Seed of start errors, errors of the calibration, drift, and noise. Default 0.
    device : Device, optional
        Where to render and measure; None: `Device.best`.
    progress : function, optional
        Called with the number of finished placements and ``count``.

    Returns
    -------
    PlacementResult

    Raises
    ------
    ValueError
        The camera sees too few edges at the target, or ``count`` is below 1.

    Notes
    -----
    Every placement draws its own error of the calibration and its own drift from their covariances, and a start error
    that is evenly distributed in the landing zone. The board is rendered as it is drawn, without etch bias. The number
    of frames checks the theory in one direction only: `ReleaseRule` waits for the predicted number of frames.
    """
    integer(count, "count", minimum=1)
    device = Device.best() if device is None else device
    machine = machine.for_side(artwork.side)
    plan = plan_placement(artwork, target, machine, budget=budget)
    rng = np.random.default_rng(seed)
    tolerance, calibrated = machine.tolerance, machine.pipette_in_camera.pose
    zone = _START * np.array([tolerance.landing_zone] * 2 + [tolerance.landing_angle])
    draws = {
        "calibration": _normal(rng, machine.pipette_in_camera.pose_covariance, count),
        "drift": _normal(rng, machine.drift.covariance, count),
    }
    cell = _Cell(artwork, machine, plan, device, seed)
    runs = []
    for number, start in enumerate(rng.uniform(-zone, zone, (count, 3))):
        true = calibrated + draws["calibration"][number] + draws["drift"][number]
        runs.append(cell.place(start, true))
        if progress is not None:
            progress(number + 1, count)
    placements, motions, errors = zip(*runs, strict=True)
    error = np.array(errors)
    sources = {name: each @ plan.camera_to_board.T for name, each in draws.items()}
    sources["vision and servo"] = error - sources["calibration"] - sources["drift"]
    return PlacementResult(plan, machine, predict_budget(machine, plan), placements, error, motions, sources)


class _Cell:
    """Simulated machine over a rendered board."""

    def __init__(self, artwork: Artwork, machine: Machine, plan: PlacementPlan, device: Device, seed: int) -> None:
        camera, tolerance = machine.camera, machine.tolerance
        diagonal = float(np.hypot(*camera.window)) / 2.0 * (1.0 + tolerance.landing_angle) + _MARGIN_PX
        half = diagonal * camera.pixel + 2.0 * tolerance.landing_zone
        centre = plan.camera_pose[:2]
        board = ReflectanceMap.of(
            artwork, pixel=camera.pixel, region=(centre - half, centre + half), blur_px=camera.blur_px
        )
        self._machine, self._plan = machine, plan
        rest = np.zeros(3)
        self._camera = SimulatedCamera(board, machine, lambda _: rest, rest, device=device, seed=seed)
        self._sensor = BoardPoseSensor(self._camera, machine, plan, self._camera.dtype, device=device)

    def place(self, start: Float64, true: Float64) -> tuple[Placement, Float64, Float64]:
        """Place a part from a start error (3,); return the run, the motion, and the error at the release."""
        machine, target = self._machine, self._plan.target
        plant = SimulatedPlant(machine.axes, start=target + start)
        self._camera.follow(plant.pose, true)
        self._sensor.reset()
        landing = 0.0 if self._plan.landing is None else machine.landing
        placement = place_part(machine, target, plant, self._sensor, SimulatedClock(), landing=landing)
        motion = plant.pose(placement.record.time) - target
        error = motion[-1].copy() if placement.released else np.full(3, np.nan)
        return placement, motion, error


def _normal(rng: np.random.Generator, covariance: Float64, count: int) -> Float64:
    """Return normal draws (count, 3); the covariance may be singular."""
    return rng.multivariate_normal(np.zeros(3), covariance, count, method="eigh")


def _pose(values: Float64) -> dict[str, float]:
    """Return a pose or an error (3,) with a key for each coordinate."""
    return dict(zip(("x_m", "y_m", "theta_rad"), values.tolist(), strict=True))


def _triple(name: str, values: Float64) -> str:
    x, y, theta = values
    return f"{name}: x {1e6 * x:.2f} µm, y {1e6 * y:.2f} µm, theta {1e3 * theta:.3f} mrad"
