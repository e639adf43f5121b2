"""Simulated placement machine over a rendered board, with the true image processing.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.7.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.trial import median_times
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.placing import Placement, count_commands, error_share, place_part
from gpuvision.servoing.placement.plan import PlacementPlan
from gpuvision.servoing.placement.rehearsal import IdentifyingMove
from gpuvision.servoing.placement.vision import BoardPoseSensor, SimulatedCamera
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.validation import integer

Float64 = npt.NDArray[np.float64]

# The board is rendered this far beyond the landing zone [px] (chosen).
_MARGIN_PX = 32
_TIMED = 15  # frames of the timing, of which the median counts (chosen)
# True poses in the time after the contact, in which a swing must stay within the tolerance.
_LATER = 33


class PlacementCell:
    """Simulated machine over a rendered board.

    Parameters
    ----------
    artwork : Artwork
        Side of the board in view.
    machine : Machine
        Machine over this side.
    plan : PlacementPlan
        Plan of the placement.
    device : Device
        Where to render and measure.
    seed : int
        Seed of the noise.

    Attributes
    ----------
    machine : Machine
        Machine; with the vibration that `identify` found.
    """

    def __init__(self, artwork: Artwork, machine: Machine, plan: PlacementPlan, device: Device, seed: int) -> None:
        camera, tolerance = machine.camera, machine.tolerance
        diagonal = camera.reach_px * (1.0 + tolerance.landing_angle) + _MARGIN_PX
        half = diagonal * camera.pixel + 2.0 * tolerance.landing_zone
        centre = plan.camera_pose[:2]
        board = ReflectanceMap.of(
            artwork, pixel=camera.pixel, region=(centre - half, centre + half), blur_px=camera.blur_px
        )
        self.machine, self._plan, self._device = machine, plan, device
        rest = np.zeros(3)
        self._camera = SimulatedCamera(board, machine, lambda _: rest, rest, device=device, seed=seed)
        self._sensor = BoardPoseSensor(self._camera, machine, plan, self._camera.dtype, device=device)

    def place(
        self, start: Float64, swing: Float64, true: Float64, offset: Float64, seed: int
    ) -> tuple[Placement, Float64, float]:
        """Place a part from a start error (3,) with a vibration (3,), and with another sensor by a seed.

        Returns
        -------
        tuple
            Run, motion, and largest true error less the offset (3,) of calibration and drift after the contact, as a
            fraction of the tolerance.
        """
        placement, plant = self._steer(self.machine, start, swing, true, seed)
        target, settling = self._plan.target, self.machine.settling
        motion = plant.pose(placement.record.time) - target
        if not placement.released:
            return placement, motion, math.nan
        periods = [2.0 * math.pi / axis.resonance for axis in self.machine.axes if axis.resonance]
        later = placement.record.time[-1] + settling.lead + np.linspace(0.0, max(periods, default=0.0), _LATER)
        reach = max(error_share(self.machine, each) for each in plant.pose(later) - target - offset)
        return placement, motion, reach

    def identify(self, start: Float64) -> None:
        """Find the vibration of the steered head in a move from a start error (3,), and take it for the rule."""
        machine = self.machine
        move = IdentifyingMove.of(machine, start)
        placement, _ = self._steer(move.machine, start, np.array(machine.swing), machine.pipette_in_camera.pose)
        self.machine = replace(machine, settling=move.settling(machine.settling, placement))

    def rest(self, count: int) -> Float64:
        """Return the errors (n, 3) of the measured poses of a head that rests at the target, in ``count`` frames."""
        target, machine = self._plan.target, self.machine
        self._camera.follow(lambda time: np.broadcast_to(target, (*np.shape(time), 3)), machine.pipette_in_camera.pose)
        self._sensor.reset()
        landing = 0 if self._plan.landing is None else math.ceil(machine.landing * machine.rate)
        frames = (self._sensor(frame * machine.period) for frame in range(landing + count))
        found = [each.pose - target for poses in frames for each in poses if each.status == 0]
        return np.array(found, np.float64).reshape(-1, 3)

    def vision_seconds(self) -> float:
        """Return the median time from a frame of a head that rests at the target to its pose [s]."""
        target, machine = self._plan.target, self.machine
        self._camera.follow(lambda time: np.broadcast_to(target, (*np.shape(time), 3)), machine.pipette_in_camera.pose)
        (frame,) = self._camera(0.0)
        sensor = BoardPoseSensor(
            lambda time: [frame._replace(arrived=time)], machine, self._plan, self._camera.dtype, device=self._device
        )
        sensor(0.0)  # the coarse registration, or a first pose
        return median_times([lambda: sensor(machine.landing)], _TIMED)[0]

    def _steer(
        self, machine: Machine, start: Float64, swing: Float64, true: Float64, seed: int | None = None
    ) -> tuple[Placement, SimulatedPlant]:
        """Run the loop for a part and return the run and the plant."""
        target = self._plan.target
        plant = SimulatedPlant(
            machine.axes,
            start=target + start,
            history=count_commands(machine),
            watchdog=machine.control.watchdog * machine.period,
            swing=swing,
        )
        self._camera.follow(plant.pose, true, seed=seed)
        self._sensor.reset()
        landing = 0.0 if self._plan.landing is None else machine.landing
        return place_part(machine, target, plant, self._sensor, SimulatedClock(), landing=landing), plant


class Repeatability(NamedTuple):
    """Scatter of the measured pose of a head at rest.

    Attributes
    ----------
    error : numpy.ndarray
        (n, 3): measured pose of the nozzle less the true one in each frame with a valid pose [m], [m], [rad].
    frame_sigma : numpy.ndarray
        (3,): predicted standard deviation from frame to frame.
    pixel_sigma : numpy.ndarray
        (3,): predicted standard deviation of the mean error, by the differences between the pixels (PRNU, DSNU).
    """

    error: Float64
    frame_sigma: Float64
    pixel_sigma: Float64

    def report(self) -> dict[str, Any]:
        """Return the measured and predicted standard deviations, and the mean error: the keys name their SI units."""
        measured = np.std(self.error, axis=0, ddof=1) if len(self.error) > 1 else np.full(3, np.nan)
        mean = np.mean(self.error, axis=0) if len(self.error) else np.full(3, np.nan)
        each = {
            "measured_sigma": measured,
            "predicted_sigma": self.frame_sigma,
            "mean": mean,
            "predicted_sigma_of_mean": self.pixel_sigma,
        }
        names = ("x_m", "y_m", "theta_rad")
        return {"frames": len(self.error)} | {
            key: dict(zip(names, values.tolist(), strict=True)) for key, values in each.items()
        }


def measure_repeatability(
    artwork: Artwork,
    machine: Machine,
    plan: PlacementPlan,
    *,
    frames: int = 100,
    seed: int = 0,
    device: Device | None = None,
) -> Repeatability:
    """Measure the pose of a head that rests at the target, in many rendered frames.

    Parameters
    ----------
    artwork : Artwork
        Side of the board in view.
    machine : Machine
        Machine over this side.
    plan : PlacementPlan
        Plan of a placement.
    frames : int
        Number of frames, 1 or more. Default 100.
    seed : int
        Seed of the noise of the sensor. Default 0.
    device : Device, optional
        Where to render and measure; None: `Device.best`.

    Notes
    -----
    The head is calibrated without an error. The noise of the pixels changes from frame to frame; their different
    sensitivities and offsets are the same in all frames and shift the mean.

    References
    ----------
    .. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 8.7.
    """
    cell = PlacementCell(artwork, machine, plan, Device.best() if device is None else device, seed)
    error = cell.rest(integer(frames, "frames", minimum=1))
    variance = np.diag(plan.vision)
    fixed = plan.fixed_pattern
    return Repeatability(error, np.sqrt((1.0 - fixed) * variance), np.sqrt(fixed * variance))
