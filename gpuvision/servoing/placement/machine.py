"""Description of a placement machine: camera, calibration, axes, controller, delay and tolerances."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.matching.artwork.board_artwork import Side
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.controllers import PidGains, simc_gains
from gpuvision.servoing.delay import DelayBudget, closed_loop, gain_limit, lag_gains, non_oscillating_gain
from gpuvision.servoing.delay_response import settling_frames, step_response
from gpuvision.servoing.frames import CAMERA, PIPETTE, Transform
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.validation import finite, integer

Float64 = npt.NDArray[np.float64]

# Smallest gain (chosen): the error then falls by a factor of e in 10 000 frames.
_MIN_GAIN = 1e-4
# Error after which no larger overshoot follows, as a fraction of the start error (chosen).
_SETTLED = 0.01


@dataclass(frozen=True, kw_only=True)
class PlacementCamera:
    """Camera of the head, which looks at the board at right angles.

    Parameters
    ----------
    sensor : CmosSensor
        Image sensor.
    pixel : float
        Size of a pixel on the board [m], above 0; with a ``lens`` of the undistorted image.
    window : (int, int)
        Rows and columns that are read, in the middle of the sensor.
    exposure : float
        Exposure time [s], above 0.
    electrons : float, optional
        Photoelectrons of a white board during the exposure. Default: 0.8 of the saturation of the sensor. Range: above
        0.
    blur_px : float
        Standard deviation of the blur of the lens [px], without the extent of a pixel; default 0.5. Range: 0 or more.
    mirrored : bool
        The camera sees the bottom side of the board, as `BoardView.mirrored`; see `Machine.for_side`. Default False.
    lens : Lens or Camera, optional
        Distortion of the lens, in pixels of an image of the whole sensor. Default: none. The camera frame is the one
        of the undistorted image.

    Raises
    ------
    ValueError
        A number is out of its range, the window is larger than the sensor, or the lens model folds in the window.
    """

    sensor: CmosSensor
    pixel: float
    window: tuple[int, int]
    exposure: float
    electrons: float | None = None
    blur_px: float = 0.5
    mirrored: bool = False
    lens: Lens | Camera | None = None

    def __post_init__(self) -> None:
        finite(self.pixel, "pixel", above=0.0)
        finite(self.exposure, "exposure", above=0.0)
        finite(self.blur_px, "blur_px", minimum=0.0)
        if self.electrons is not None:
            finite(self.electrons, "electrons", above=0.0)
        for size, most, name in zip(self.window, self.sensor.shape, ("rows", "columns"), strict=True):
            integer(size, f"window {name}", minimum=16, maximum=most)
        if not math.isfinite(self.reach_px):
            raise ValueError("lens: the model folds within the window")

    @property
    def window_lens(self) -> Lens | Camera | None:
        """Lens in the pixels of the window; None without a lens."""
        if self.lens is None:
            return None
        (rows, columns), (all_rows, all_columns) = self.window, self.sensor.shape
        return self.lens.in_window(((all_columns - columns) // 2, (all_rows - rows) // 2))

    @property
    def reach_px(self) -> float:
        """Distance of the farthest corner from the centre of the window, undistorted [px]; NaN beyond a fold."""
        diagonal = float(np.hypot(*self.window)) / 2.0
        if (lens := self.window_lens) is None:
            return diagonal
        rows, columns = self.window
        border = [(x, y) for x in (-0.5, columns - 0.5) for y in (-0.5, rows - 0.5)]
        away = lens.undistort(np.array(border)) - ((columns - 1) / 2.0, (rows - 1) / 2.0)
        return float(np.maximum(diagonal, np.max(np.hypot(away[:, 0], away[:, 1]))))

    @property
    def white_electrons(self) -> float:
        """Photoelectrons of a white board during the exposure."""
        return 0.8 * self.sensor.saturation if self.electrons is None else self.electrons

    @property
    def edge_blur_px(self) -> float:
        """Standard deviation of the blur of edges [px]: lens and extent of a pixel."""
        return math.hypot(self.blur_px, 1.0 / math.sqrt(12.0))

    def view(self, pose: Float64) -> BoardView:
        """Return the view of the board from a pose (3,) of the camera, x, y [m], theta [rad]."""
        x, y, theta = pose.tolist()
        return BoardView(
            scale=self.pixel, shape=self.window, pose=(x, y, theta), mirrored=self.mirrored, model=self.window_lens
        )


@dataclass(frozen=True, kw_only=True)
class Tolerance:
    """Limits of a placement.

    Parameters
    ----------
    position : float
        Largest distance from the target at the release [m], above 0. The settling rule waits for it.
    angle : float
        Largest angle from the target at the release [rad], above 0. The settling rule waits for it.
    landing_zone : float
        Largest offset, along x and along y, at which the camera takes over from the long move [m], above 0.
    landing_angle : float
        Largest angle at which the camera takes over [rad], above 0.
    max_time : float
        Time after which a placement is aborted [s], above 0; default 1 s.
    max_refused : int
        Number of frames in a row without a valid pose after which a placement is aborted; default 20. Range: 1 or more.

    Raises
    ------
    ValueError
        A number is out of its range.
    """

    position: float
    angle: float
    landing_zone: float
    landing_angle: float
    max_time: float = 1.0
    max_refused: int = 20

    def __post_init__(self) -> None:
        for name in ("position", "angle", "landing_zone", "landing_angle", "max_time"):
            finite(getattr(self, name), name, above=0.0)
        integer(self.max_refused, "max_refused", minimum=1)


@dataclass(frozen=True, kw_only=True)
class ThermalDrift:
    """Drift of the nozzle against the camera by temperature since the calibration.

    Parameters
    ----------
    expansion : (float, float)
        Change of the nozzle's position in the camera frame along x and y per kelvin [m/K]. Default ``(0.0, 0.0)``.
    temperature_sigma : float
        Standard deviation of the temperature since the calibration [K], 0 or more. Default 0.0.
    """

    expansion: tuple[float, float] = (0.0, 0.0)
    temperature_sigma: float = 0.0

    def __post_init__(self) -> None:
        for each in self.expansion:
            finite(each, "expansion")
        finite(self.temperature_sigma, "temperature_sigma", minimum=0.0)

    @property
    def covariance(self) -> Float64:
        """Covariance (3, 3) of the nozzle's pose in the camera frame."""
        moved = np.array([*self.expansion, 0.0]) * self.temperature_sigma
        return np.outer(moved, moved)


@dataclass(frozen=True, kw_only=True, eq=False)
class Machine:
    """Placement machine: camera, calibration, delay, control and tolerances.

    Parameters
    ----------
    camera : PlacementCamera
        Camera of the head.
    pipette_in_camera : Transform
        Calibrated pose of the nozzle ("pipette") in the camera frame ("camera"): origin at the image centre, x along
        increasing columns, y along decreasing rows; see `gpuvision.servoing.machine_calibration`. Over the bottom side
        see `for_side`.
    tolerance : Tolerance
        Limits of a placement.
    axes : tuple of Axis
        Axes x, y and theta of the head. With the observers "latest" and "kalman", gain and predicted frames count the
        longest lag as a delay of all axes; with "smith" the theory of each axis has its lag, and the least limit of the
        gain counts. The rest is for the simulated machine. Default: axes that follow at once.
    rate : float
        Frames per second, above 0; default 1000.
    transfer : float
        Time of the transfer of a frame [s], default 0.
    stages : mapping of str to float
        Time of each stage of processing [s].
    landing : float
        Time of a coarse registration [s], 0 or more, default 0. It finds the pose of the first frame where rulers that
        cover the landing zone have no room; the head rests during this time.
    control : Control
        Observer, controller, gains and watchdog. Default: a proportional controller on the latest pose, with the
        largest gain without oscillation.
    settling : Settling
        Rule that releases the part. Default: the number of frames of the step response.
    drift : ThermalDrift
        Default: none.
    swing : (float, float, float)
        Largest amplitudes of the vibration with which the head comes out of the long move [m], [m], [rad], 0 or more,
        for the simulated machine; an axis with a resonance only. Default 0.

    Raises
    ------
    ValueError
        A frame or a number is wrong, the frame does not fit into its period, or the gain makes the loop unstable.
    """

    camera: PlacementCamera
    pipette_in_camera: Transform
    tolerance: Tolerance
    axes: tuple[Axis, Axis, Axis] = (Axis(), Axis(), Axis())
    rate: float = 1000.0
    transfer: float = 0.0
    stages: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    landing: float = 0.0
    control: Control = field(default_factory=Control)
    settling: Settling = field(default_factory=Settling)
    drift: ThermalDrift = field(default_factory=ThermalDrift)
    swing: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        frames = (self.pipette_in_camera.source, self.pipette_in_camera.target, self.pipette_in_camera.kind)
        if frames != (PIPETTE, CAMERA, "rigid"):
            raise ValueError(f"pipette_in_camera is {frames}, expected a rigid transform from pipette to camera")
        finite(self.rate, "rate", above=0.0)
        finite(self.landing, "landing", minimum=0.0)
        timing = self.camera.sensor.timing(self.camera.window, exposure=self.camera.exposure)
        if timing.period > 1.0 / self.rate * (1.0 + 1e-9):
            rows, columns = self.camera.window
            raise ValueError(
                f"a frame of {rows} x {columns} px takes {1e3 * timing.period:.3f} ms, more than 1/rate = "
                f"{1e3 * self.period:.3f} ms; read a smaller window, expose shorter, or lower the rate"
            )
        for axis, swing in zip(self.axes, self.swing, strict=True):
            if finite(swing, "swing", minimum=0.0) and not axis.resonance:
                raise ValueError("swing needs an axis with a resonance")
        wait, most = self.settling.wait, self.tolerance.max_time
        if wait is not None and wait >= most:
            raise ValueError(f"settling.wait is {wait} s, expected less than tolerance.max_time, {most} s")
        self._check_stability()

    def _check_stability(self) -> None:
        """Raise a `ValueError` for a gain that is unstable or too small."""
        gain, delay = self.control.gain, self.control_delay
        if any(self.control_lags):
            # The limit is not monotonic in the lag: 2 without a lag, 3.8 at 0.3 frames, 2.39 at 1 frame.
            most, lag = min((lag_gains(each).limit, each) for each in self.control_lags)
            cause = f"a lag of {lag:.2f} frames"
        else:
            # Below half a frame a delay raises the limit, a lag does not.
            most, cause = gain_limit(max(delay, 0.5) if self.lag else delay), f"a delay of {delay:.2f} frames"
        if gain is not None and not (gain > 0.0 and (gain < most or self.control.controller != "p")):
            raise ValueError(
                f"gain is {gain}, expected above 0 and below {most:.4g}, the limit of stability for {cause}"
            )
        if gain is not None and gain < _MIN_GAIN:
            raise ValueError(f"gain is {gain}, expected {_MIN_GAIN} or more: the loop would hardly move")
        if self.control.controller == "p":
            return
        gains = self.gains
        for lag in dict.fromkeys(self.control_lags):
            loop = closed_loop(delay, self.loop_gain, **self.time_constants(lag))
            if not np.all(np.abs(np.roots(loop.denominator)) < 1.0):
                raise ValueError(
                    f"the controller {self.control.controller} with gain {self.loop_gain:.4g}, integral "
                    f"{gains.integral:.4g} s and derivative {gains.derivative:.4g} s is not stable with "
                    + (f"a lag of {lag:.2f} frames" if any(self.control_lags) else cause)
                )

    @property
    def period(self) -> float:
        """Time between two frames [s]."""
        return 1.0 / self.rate

    @property
    def delay(self) -> DelayBudget:
        """Delay from the middle of the exposure to the command that answers it.

        The readout counts from the end of the exposure of the middle row, and includes the frame buffers of the sensor.
        """
        camera = self.camera
        timing = camera.sensor.timing(camera.window, exposure=camera.exposure)
        # The buffers delay by frame times: the sensor counts its shortest frame time, the machine runs at `period`.
        buffers = camera.sensor.readout.buffers * (self.period - timing.period)
        return DelayBudget(
            period=self.period,
            exposure=timing.exposure,
            readout=timing.delay - timing.exposure / 2.0 + buffers,
            transfer=self.transfer,
            stages=dict(self.stages),
        )

    @property
    def lag(self) -> float:
        """Longest lag of an axis [s]."""
        return max(axis.lag for axis in self.axes)

    @property
    def response_frames(self) -> float:
        """Delay of the loop in frames: the latency of the camera, and the longest lag of an axis as a delay."""
        return self.delay.frames + self.lag / self.period

    @property
    def control_delay(self) -> float:
        """Delay in frames that the controller sees: the part of `response_frames` that the observer does not predict.

        The Smith predictor predicts the delay, and `control_lags` remain. The Kalman filter predicts the delay by the
        time stamps, and the longest lag remains as a delay.
        """
        if self.control.observer == "latest":
            return self.response_frames
        return self.lag / self.period if self.control.observer == "kalman" else 0.0

    @property
    def control_lags(self) -> tuple[float, float, float]:
        """Lags of x, y and theta in frames, where the theory has them as lags: with the Smith predictor; else 0."""
        if self.control.observer != "smith":
            return (0.0, 0.0, 0.0)
        x, y, theta = (axis.lag / self.period for axis in self.axes)
        return (x, y, theta)

    @property
    def _smooth_gains(self) -> tuple[float, ...]:
        """Largest proportional gain without oscillation of each axis."""
        free = non_oscillating_gain(self.control_delay)
        return tuple(lag_gains(each).critical if each else free for each in self.control_lags)

    @property
    def loop_gain(self) -> float:
        """Fraction of the error that one frame corrects."""
        if self.control.gain is not None:
            return self.control.gain
        if self.control.controller == "p":
            return min(self._smooth_gains)
        return self._rule.proportional * self.period

    @property
    def gains(self) -> PidGains:
        """Gains of the controller."""
        control, proportional = self.control, self.loop_gain * self.rate
        if control.controller == "p":
            return PidGains(proportional=proportional)
        derivative = self.lag if control.derivative is None else control.derivative
        return PidGains(
            proportional=proportional,
            integral=self._rule.integral if control.integral is None else control.integral,
            derivative=derivative if control.controller == "pid" else 0.0,
        )

    @property
    def _rule(self) -> PidGains:
        """Gains by the rule of Skogestad for the delay that the controller sees, with half a frame for the hold.

        The longest lag counts as a delay.
        """
        return simc_gains((self.control_delay + max(self.control_lags) + 0.5) * self.period)

    def error_after(self, frames: int) -> Float64:
        """Return the errors (frames, 3) of x, y and theta in each frame after start errors of 1, by theory."""
        error = {
            lag: step_response(self.control_delay, self.loop_gain, frames, **self.time_constants(lag))
            for lag in dict.fromkeys(self.control_lags)
        }
        return np.stack([error[lag] for lag in self.control_lags], axis=1)

    def frames_to(self, fraction: npt.ArrayLike) -> int:
        """Return the number of frames after which start errors of 1 of all axes stay within a fraction, by theory.

        The fraction is a number above 0, or three for x, y and theta. A fraction of 1 or more takes no frame.
        """
        least: dict[float, float] = {}
        for lag, each in zip(self.control_lags, np.broadcast_to(fraction, 3).tolist(), strict=True):
            least[lag] = min(each, least.get(lag, 1.0))
        counts = (
            settling_frames(self.control_delay, self.loop_gain, each, **self.time_constants(lag))
            for lag, each in least.items()
            if each < 1.0
        )
        return max(counts, default=0)

    @property
    def overshoot(self) -> Float64:
        """Overshoot (3,) of the step response as a fraction of the start error, by theory; 0 without oscillation."""
        is_smooth = np.array(self._smooth_gains) >= self.loop_gain
        if self.control.controller == "p" and np.all(is_smooth):
            return np.zeros(3)
        found = np.maximum(-self.error_after(self.frames_to(_SETTLED) + 1).min(axis=0), 0.0)
        return np.where(is_smooth & (self.control.controller == "p"), 0.0, found)

    def time_constants(self, lag: float) -> dict[str, float]:
        """Return the arguments ``integral``, ``derivative`` and ``lag`` [frames] of `closed_loop` for a lag."""
        integral, derivative = self.gains.integral / self.period, self.gains.derivative / self.period
        return {"integral": integral, "derivative": derivative, "lag": lag}

    def for_side(self, side: Side) -> Machine:
        """Return the machine over a side of the board.

        Parameters
        ----------
        side : {"top", "bottom"}
            Side that the camera sees.

        Returns
        -------
        Machine
            Over the bottom side, x of the camera frame is reversed: x along decreasing columns, y along decreasing
            rows. The calibration and the drift are converted to this frame.

        Notes
        -----
        All poses stay in the frame of the board's files, the view of the top side. The camera sees it mirrored. With
        M = diag(-1, 1), a point p of the camera frame F_c lies at ``t + R(theta) M p`` on the board, and a rotation by
        an angle appears as a rotation by its negative. In the frame M F_c this is again a rigid transform, in which the
        nozzle has the pose (-x, y, -theta).
        """
        if self.camera.mirrored == (side == "bottom"):
            return self
        x, y, theta = self.pipette_in_camera.pose
        mirror = np.diag([-1.0, 1.0, -1.0])
        covariance = mirror @ self.pipette_in_camera.pose_covariance @ mirror
        expansion_x, expansion_y = self.drift.expansion
        return replace(
            self,
            camera=replace(self.camera, mirrored=not self.camera.mirrored),
            pipette_in_camera=Transform.rigid(PIPETTE, CAMERA, (-x, y, -theta), covariance),
            drift=replace(self.drift, expansion=(-expansion_x, expansion_y)),
        )
