"""Simulated placements of parts on a board: the true image processing looks at a rendered board while the head moves.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.7.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.placement.budget import ErrorBudget, model_tolerance, predict_budget
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import (
    REMAINDER,
    Placement,
    predicted_settling,
    settled_frames,
)
from gpuvision.servoing.placement.plan import PlacementPlan, plan_placement
from gpuvision.servoing.placement.rehearsal import check_resonances, start_zone
from gpuvision.validation import integer
from gpuvision.workflows.placement_cell import PlacementCell

Float64 = npt.NDArray[np.float64]


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
    reach : numpy.ndarray
        (n,): largest true error, less calibration and drift, in a period of the resonance after the contact, as a
        fraction of the tolerance; NaN where the part was not released.
    """

    plan: PlacementPlan
    machine: Machine
    budget: ErrorBudget
    placements: tuple[Placement, ...]
    error: Float64
    motion: tuple[Float64, ...]
    sources: dict[str, Float64]
    reach: Float64

    @property
    def _servo_motion(self) -> list[Float64]:
        """True errors (frames, 3) of each run, less calibration and drift: the motion to the point of the camera."""
        offset = self.sources["calibration"] + self.sources["drift"]
        return [motion - away for motion, away in zip(self.motion, offset, strict=True)]

    @property
    def settling_band(self) -> Float64:
        """Band (3,) of the settled error: the remainder of `ReleaseRule`, three sigmas of vision and sampling."""
        tolerance = self.machine.tolerance
        limit = np.array([tolerance.position] * 2 + [tolerance.angle])
        sigmas = self.budget.sigmas
        return np.asarray(REMAINDER * limit + 3.0 * np.hypot(sigmas["vision"], sigmas["sampling"]))

    @property
    def settled(self) -> list[int | None]:
        """Frame from which on the true error, less calibration and drift, stays within `settling_band`.

        Measured apart from the release rule; None for an error that is larger at the end, and for a part that was not
        released.
        """
        pairs = zip(self.placements, self._servo_motion, strict=True)
        return [settled_frames(motion, self.settling_band, released=each.released) for each, motion in pairs]

    @property
    def _landing_frames(self) -> int:
        """Frames of the coarse registration, during which the head rests."""
        return 0 if self.plan.landing is None else math.ceil(self.machine.landing * self.machine.rate - 1e-9)

    @property
    def response(self) -> Float64:
        """Errors (frames, 3) in each frame of the longest run by theory, as fractions of the start errors."""
        landing = self._landing_frames
        frames = max(len(each) for each in self.motion) - landing
        return np.concatenate([np.ones((landing, 3)), self.machine.error_after(max(frames, 1))])

    @property
    def predicted_settling(self) -> list[int]:
        """Frames to `settling_band` by theory from the true start errors; the coarse registration included."""
        counts = [predicted_settling(self.machine, each[0], self.settling_band) for each in self._servo_motion]
        return [self._landing_frames + each if each else 0 for each in counts]

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
                f"observer {self.machine.control.observer}, controller {self.machine.control.controller}, "
                f"release by {self.machine.settling.rule}",
                self._settling(),
                _triple("error, root mean square", measured),
                _triple("error, predicted", self.simulated_sigmas),
            ]
        lines += sorted({f"aborted: {each.reason}" for each in self.placements if not each.released})
        return "\n".join(lines)

    def _settling(self) -> str:
        """Return the frames to the settling band, measured from the true error and by theory."""
        pairs = zip(self.settled, self.predicted_settling, strict=True)
        counted = np.array([each for each in pairs if each[0] is not None], np.float64).reshape(-1, 2)
        if not len(counted):
            return "the true error did not settle before the release"
        measured, predicted = counted.mean(axis=0)
        text = f"true error settled in {measured:.1f} frames, predicted {predicted:.1f}"
        missing = len(self.settled) - len(counted)
        return text + (f"; not settled before the release: {missing}" if missing else "")

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``: the keys name their SI units."""
        released = np.isfinite(self.error[:, 0])
        found = self.error[released]
        delay = self.machine.delay
        measured = {"total": found, **{name: each[released] for name, each in self.sources.items()}}
        control, gains, settling = self.machine.control, self.machine.gains, self.machine.settling
        noise = np.diag(self.budget.sources["vision"]) / np.diag(self.plan.vision)
        tolerated = model_tolerance(self.machine, self.plan)
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
            "settling_band": _pose(self.settling_band),
            "observer": control.observer,
            "controller": control.controller,
            "gain_per_frame": self.machine.loop_gain,
            "integral_s": gains.integral if math.isfinite(gains.integral) else None,
            "derivative_s": gains.derivative,
            "vision_gain": _pose(noise),
            "tolerated_plant_gain": None if tolerated is None else tolerated.plant_gain,
            "tolerated_delay_s": None if tolerated is None else tolerated.longer_delay,
            "settling": settling.rule,
            "vibration_Hz": settling.frequency,
            "vibration_damping": settling.damping,
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
                    "settled_frames": settled,
                    "predicted_settled_frames": predicted,
                    "error": _pose(error) if each.released else None,
                    "reach_of_tolerance": float(reach) if each.released else None,
                }
                for each, error, settled, predicted, reach in zip(
                    self.placements, self.error, self.settled, self.predicted_settling, self.reach, strict=True
                )
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
        `plan_placement` refuses the target, the loop does not settle with the resonances of the axes, or ``count`` is
        below 1.

    Notes
    -----
    Every placement draws a new error of the calibration and a new drift from their covariances, the noise of another
    sensor with other differences between its pixels, and a start error that is evenly distributed in the landing zone.
    The board is rendered as it is drawn, without etch bias. An axis with a ``swing`` starts with a vibration, whose
    amplitude is evenly distributed. If the rule "vibration" has no frequencies, a move without a release finds them
    first. `ReleaseRule` waits for the predicted number of frames;
    ``settled`` counts the frames of the true error, apart from this rule.
    """
    integer(count, "count", minimum=1)
    device = Device.best() if device is None else device
    machine = machine.for_side(artwork.side)
    check_resonances(machine)
    plan = plan_placement(artwork, target, machine, budget=budget, device=device)
    rng = np.random.default_rng(seed)
    calibrated, zone = machine.pipette_in_camera.pose, start_zone(machine)
    draws = {
        "calibration": _normal(rng, machine.pipette_in_camera.pose_covariance, count),
        "drift": _normal(rng, machine.drift.covariance, count),
    }
    cell = PlacementCell(artwork, machine, plan, device, seed)
    starts, swings = rng.uniform(-zone, zone, (count, 3)), rng.uniform(-1.0, 1.0, (count, 3)) * np.array(machine.swing)
    seeds = rng.integers(1 << 32, size=count).tolist()
    if machine.settling.rule == "vibration" and machine.settling.frequency is None:
        cell.identify(zone)
    sources = {name: each @ plan.camera_to_board.T for name, each in draws.items()}
    runs = []
    for number, (start, swing) in enumerate(zip(starts, swings, strict=True)):
        true = calibrated + draws["calibration"][number] + draws["drift"][number]
        offset = sources["calibration"][number] + sources["drift"][number]
        runs.append(cell.place(start, swing, true, offset, seeds[number]))
        if progress is not None:
            progress(number + 1, count)
    placements, motions, reach = zip(*runs, strict=True)
    released = [each.released for each in placements]
    error = np.where(np.array(released)[:, None], np.array([each[-1] for each in motions]), np.nan)
    sources["vision and servo"] = error - sources["calibration"] - sources["drift"]
    frames = [each.steered_frames for each in placements if each.released] or None
    predicted = predict_budget(cell.machine, plan, frames)
    return PlacementResult(plan, cell.machine, predicted, placements, error, motions, sources, np.array(reach))


def _normal(rng: np.random.Generator, covariance: Float64, count: int) -> Float64:
    """Return normal draws (count, 3); the covariance may be singular."""
    return rng.multivariate_normal(np.zeros(3), covariance, count, method="eigh")


def _pose(values: Float64) -> dict[str, float]:
    """Return a pose or an error (3,) with a key for each coordinate."""
    return dict(zip(("x_m", "y_m", "theta_rad"), values.tolist(), strict=True))


def _triple(name: str, values: Float64) -> str:
    x, y, theta = values
    return f"{name}: x {1e6 * x:.2f} µm, y {1e6 * y:.2f} µm, theta {1e3 * theta:.3f} mrad"
