"""Pose of the nozzle from the frames of a camera: rulers at the predicted pose, camera pose, nozzle pose."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device, to_numpy
from gpuvision.matching.board.edge_measurement import move_view
from gpuvision.servoing.frames import compose_poses, invert_pose, move_covariance
from gpuvision.servoing.observer import SAME_TIME, PoseMeasurement, PosePrediction
from gpuvision.servoing.placement.board_renderer import board_renderer
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.plan import PlacementPlan
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

# Poses during an exposure that are averaged: motion of up to 1.5 px in an exposure is smooth (`RenderBoard`).
_SUBPOSES = 3


class Frame(NamedTuple):
    """Frame of a camera.

    Attributes
    ----------
    image : numpy.ndarray
        (rows, columns) uint8 or uint16.
    exposed : float
        Middle of the exposure [s].
    arrived : float
        Time at which the pose of the frame is available [s], with the time of all stages of processing.
    """

    image: npt.NDArray[Any]
    exposed: float
    arrived: float


class FrameSource(Protocol):
    """Source of frames: a camera or its simulation."""

    def __call__(self, time: float) -> Sequence[Frame]:
        """Return the frames that arrived since the last call, up to a time [s]."""


class SimulatedCamera:
    """Camera over a rendered board that moves with a head.

    Parameters
    ----------
    board : ReflectanceMap
        Board in view.
    machine : Machine
        Camera, rate and delay.
    nozzle : function
        True poses (n, 3) of the nozzle on the board at times (n,) [s], such as `SimulatedPlant.pose`.
    pipette_in_camera : numpy.ndarray
        (3,): true pose of the nozzle in the camera frame; it differs from the calibrated one.
    device : Device, optional
        Where to render; None: `Device.best`.
    seed : int
        Seed of the noise of the sensor. Default 0.

    Notes
    -----
    A frame arrives at each multiple of the frame time: the phase of a loop with the same rate.
    """

    def __init__(
        self,
        board: ReflectanceMap,
        machine: Machine,
        nozzle: Callable[[Float64], Float64],
        pipette_in_camera: Float64,
        *,
        device: Device | None = None,
        seed: int = 0,
    ) -> None:
        self._render_board = board_renderer(board, machine.camera, seed=seed)
        self._device = Device.best() if device is None else device
        self._real = np.dtype(np.float64 if self._device.has_double else np.float32)
        self._bound = self._render_board.bind(self._device, (1, _SUBPOSES, 3), self._real)
        delay = machine.delay
        self._period, self._latency, self._exposure = machine.period, delay.latency, delay.exposure
        self._nozzle, self._camera_in_pipette = nozzle, invert_pose(pipette_in_camera)
        self.dtype = self._render_board.dtype
        """Dtype of the frames."""
        self._frame = self._first = 0

    def follow(
        self, nozzle: Callable[[Float64], Float64], pipette_in_camera: Float64, *, seed: int | None = None
    ) -> None:
        """Start again at time 0 with another motion and another true pose of the nozzle in the camera frame.

        With a seed also with another sensor of the same kind: other noise, and other differences between the pixels.
        Without one the numbers of the frames, and so their noise, go on.
        """
        if seed is not None:
            self._render_board = replace(self._render_board, seed=seed)
            self._bound = self._render_board.bind(self._device, (1, _SUBPOSES, 3), self._real)
        self._nozzle, self._camera_in_pipette = nozzle, invert_pose(pipette_in_camera)
        self._first = self._frame

    def __call__(self, time: float) -> list[Frame]:
        """Return the frames that arrived since the last call, up to a time [s]."""
        frames = []
        while (arrived := (self._frame - self._first) * self._period) <= time + SAME_TIME:
            frames.append(self._render(arrived))
            self._frame += 1
        return frames

    def _render(self, arrived: float) -> Frame:
        exposed = arrived - self._latency
        parts = (np.arange(_SUBPOSES) + 0.5) / _SUBPOSES - 0.5
        poses = compose_poses(self._nozzle(exposed + parts * self._exposure), self._camera_in_pipette)
        self._bound.inputs[0].set(np.ascontiguousarray(poses[None], self._real))
        self._bound.inputs[1].set(np.array([self._frame], np.uint32))
        result = self._bound.run()
        return Frame(to_numpy(result.image)[0], exposed, arrived)


class BoardPoseSensor:
    """Sensor of the pose of the nozzle on the board: implements `gpuvision.servoing.loop.PoseSensor`.

    Parameters
    ----------
    camera : FrameSource
        Source of frames.
    machine : Machine
        Machine, with the calibrated pose of the nozzle in the camera frame.
    plan : PlacementPlan
        Features to measure.
    dtype : dtype
        Dtype of the frames.
    device : Device, optional
        Where to measure; None: `Device.best`.

    Notes
    -----
    The rulers of a frame are placed at the pose that the observer of the loop predicts for the exposure. Before its
    first accepted measurement, and without an observer, they are placed at the last measured pose, at first at the
    target. A plan with a ``landing`` registers the first frame instead: frames that arrive within `Machine.landing`
    after it are not measured, and a refused registration is repeated. The covariance of a measurement contains the
    error of the vision alone; the error of the calibration is common to all frames.
    """

    def __init__(
        self,
        camera: FrameSource,
        machine: Machine,
        plan: PlacementPlan,
        dtype: npt.DTypeLike,
        *,
        device: Device | None = None,
    ) -> None:
        self.camera, self._plan, self._device = camera, plan, device
        self._view, self._landing_time = machine.camera.view(plan.camera_pose), machine.landing
        self._calibrated = machine.pipette_in_camera.pose
        self._bound = plan.features.bind(
            device,
            machine.camera.window,
            dtype,
            copper="bright",
            threshold=plan.threshold,
            noise=plan.noise,
            model=machine.camera.window_lens,
        )
        # The coarse registration knows no lens. Beyond the frame the outermost pixels go on: a mask would be an edge.
        lens = machine.camera.window_lens
        self._undistort = None if lens is None else UndistortImage(model=lens, border="replicate")
        self.reset()

    def reset(self) -> None:
        """Place the rulers at the target again."""
        self._last = self._plan.camera_pose.copy()  # last measured pose of the camera
        self._has_landed, self._ready = self._plan.landing is None, -math.inf

    def __call__(self, time: float, predicted: PosePrediction | None = None) -> list[PoseMeasurement]:
        """Return the measurements that arrived since the last call, up to a time [s].

        Parameters
        ----------
        time : float
            Time of the call [s].
        predicted : function, optional
            Prediction of the pose of the nozzle at an exposure. Default: the pose of the last measured frame.
        """
        frames = (frame for frame in self.camera(time) if frame.arrived >= self._ready - SAME_TIME)
        found = [self._measure(frame, predicted) if self._has_landed else self._land(frame) for frame in frames]
        return [each for each in found if each is not None]

    def _land(self, frame: Frame) -> PoseMeasurement | None:
        """Register a frame coarsely; return a measurement only where the pose is refused."""
        assert self._plan.landing is not None
        image = frame.image
        if self._undistort is not None:
            image = to_numpy(self._undistort(image, device=self._device).image)
        found = self._plan.landing(image, device=self._device)
        self._ready = frame.arrived + self._landing_time
        self._has_landed = not found.status & ~Status.NOT_CONVERGED  # the pose only has to be near
        if self._has_landed:
            self._last = np.array(move_view(self._view, found.pose).pose)
            return None
        nothing = np.full((3, 3), np.nan)
        return PoseMeasurement(frame.exposed, frame.arrived, nothing[0], nothing, int(found.status))

    def _measure(self, frame: Frame, predicted: PosePrediction | None) -> PoseMeasurement:
        nozzle = None if predicted is None else predicted(frame.exposed)
        place = self._last if nozzle is None else compose_poses(nozzle, invert_pose(self._calibrated))
        found = self._bound(frame.image, place)
        status = int(np.asarray(found.status))
        pose, covariance = np.asarray(found.pose, np.float64), np.asarray(found.covariance, np.float64)
        if status == 0:
            self._last = pose.copy()
        moved = move_covariance(covariance, pose, self._calibrated)
        return PoseMeasurement(frame.exposed, frame.arrived, compose_poses(pose, self._calibrated), moved, status)
