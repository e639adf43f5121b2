"""Planning of a scan: try readouts on a sample of the recording, and choose the fastest that is accurate enough.

The error of the heights comes from the error model of `gpuvision.workflows.scan_errors`, the time from the device.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.accuracy.plan import PlanError, fastest_within
from gpuvision.accuracy.trial import at_least, median_times, micrometres
from gpuvision.host import ArraySource, Device, Plan, StreamError, plan_stream, to_numpy
from gpuvision.normal_distribution import MAD_TO_SIGMA
from gpuvision.ranging.background import sample_frames
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.validation import finite
from gpuvision.workflows.opened_recording import open_for_scan
from gpuvision.workflows.scan_plan import ReadoutTrial, ScanPlan, ScanPlanLimits, usable_trials
from gpuvision.workflows.scanning import measure_points, range_readout

Array = npt.NDArray[Any]
Progress = Callable[[int, int | None], object]

# Windows to try: few, because each is a build of the kernel; a factor of 1.5 or less apart.
_WINDOWS = (3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 180)
_HALF_WIDTHS = (1.2, 2.0)  # of the windows, over half the width of the line: noise moves the peak within the line
_UNKNOWN_LENGTH = 1 << 40  # frames of a recording that does not tell: its stream has no end
# Service rate over frame rate of a stream, where a larger batch gives it. Measured: of 17 streams of the smallest
# sufficient batch, 2 were late beside other work; a paced source takes time that the service rate does not contain.
_HEADROOM = 2.0
_ROUNDS = 15  # of the timing, of which the median counts
_QUIET = 1.5  # times the least noise of a readout, up to which its scatter shows the texture. Chosen
_EDGE = 8.0  # robust standard deviations of the second differences of heights. Chosen: noise stays below


class Sample(NamedTuple):
    """Frames of a recording less their background.

    Attributes
    ----------
    frames : numpy.ndarray
        (frames, rows, columns), or (frames, strips, 2) of a PSD.
    numbers : numpy.ndarray
        Their numbers in the recording, (frames,).
    length : int
        Number of frames of the recording.
    """

    frames: Array
    numbers: npt.NDArray[np.int64]
    length: int


class TriedReadouts(NamedTuple):
    """Readouts that were tried on a sample of a recording.

    Attributes
    ----------
    sensor : Sensor
        The sensor, with the estimated threshold if its file asks for one.
    sample : Sample
        Frames that the readouts read.
    trials : tuple of ReadoutTrial
        The readouts with errors and times, fastest first.
    device : Device
        Device of the times.
    """

    sensor: Sensor
    sample: Sample
    trials: tuple[ReadoutTrial, ...]
    device: Device


def plan_scan(
    recording: str | Path | Array,
    sensor: Sensor,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    device: Device | None = None,
    limits: ScanPlanLimits = ScanPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> ScanPlan:
    """Choose the fastest readout whose predicted error of the heights meets a tolerance.

    Of a camera the methods ``"windowed"``, ``"gauss3"``, ``"fir"`` and ``"ml"`` are tried with windows that suit the
    width of the line, and the readout of the sensor. All other settings are the sensor's. ``"centroid"`` is tried only
    if the sensor has it: no error model covers light beside the line. A PSD has one readout: only its precision and
    its stream are planned.

    Parameters
    ----------
    recording : str, Path or numpy.ndarray
        Recording (`open_recording`), or frames (frames, rows, columns) of a camera, (frames, strips, 2) of a PSD. It is
        read to its end for a sample.
    sensor : Sensor
        Sensor of the recording, with its noise.
    tolerance : float
        Largest error of the heights z [m], root mean square over the samples of the recording: random errors, the phase
        of the line in its pixel, and the calibration where its covariance is known.
    rate : float, optional
        Frame rate that the scan must keep up with [frames/s].
    latency : float, optional
        Longest acceptable time from the arrival of a frame to its result [s]; needs a rate.
    device : Device, optional
        Default `Device.best`.
    limits : ScanPlanLimits
        Margins of the choice.
    progress : callable, optional
        Called with the number of tried readouts and the number of all.

    Returns
    -------
    ScanPlan

    Raises
    ------
    PlanError
        No readout meets the tolerance, or none of them keeps up with the rate.
    RecordingError
        The recording cannot be read.
    ValueError
        The sensor is neither a camera nor a PSD, its file gives no noise, the tolerance is not above 0, a latency has
        no rate, or the recording has no line.

    Notes
    -----
    Errors are predicted to first order for Gaussian lines, see `LineReadout` and
    `gpuvision.ranging.line_phase.phase_error`. Where the heights of one readout scatter more along their profiles than
    its noise explains, and than those of the other readouts do, the difference is added. Windows narrower than the line
    are not chosen: noise moves them off the line, which the prediction does not cover. Not covered: errors of the
    threshold, light of reflections, the texture of the surface (unless ``[line] speckle`` is given), and interpolation
    to the height map. The precision is double where rounding would exceed the tolerance; a device without doubles
    cannot check that (``rounding`` is None).

    References
    ----------
    R. B. Fisher and D. K. Naidu, A comparison of algorithms for subpixel peak detection, in Image Technology, Springer
    1996.
    """
    _check_limits(tolerance, rate, latency)  # before the work
    tried = try_readouts(recording, sensor, device=device, limits=limits, progress=progress)
    return choose_readout(tried, tolerance=tolerance, rate=rate, latency=latency, limits=limits)


def try_readouts(
    recording: str | Path | Array,
    sensor: Sensor,
    *,
    device: Device | None = None,
    limits: ScanPlanLimits = ScanPlanLimits(),
    progress: Progress = lambda done, of: None,
) -> TriedReadouts:
    """Try readouts on a sample of a recording, for `choose_readout`.

    Parameters
    ----------
    recording, sensor, device, limits, progress
        As in `plan_scan`.

    Raises
    ------
    RecordingError, ValueError
        As `plan_scan`.
    """
    _check_sensor(sensor)
    device = Device.best() if device is None else device
    sensor, sample = _sampled(recording, sensor)
    return TriedReadouts(sensor, sample, _try_readouts(sensor, sample, device, limits, progress), device)


def choose_readout(
    tried: TriedReadouts,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    limits: ScanPlanLimits = ScanPlanLimits(),
) -> ScanPlan:
    """Choose the fastest of the readouts that were tried, for any tolerance, rate and latency.

    Parameters
    ----------
    tried : TriedReadouts
        Result of `try_readouts`.
    tolerance, rate, latency, limits
        As in `plan_scan`.

    Raises
    ------
    PlanError, ValueError
        As `plan_scan`.
    """
    _check_limits(tolerance, rate, latency)
    sensor, sample, trials, device = tried
    chosen = _chosen(trials, tolerance, limits)
    chosen, rounding = _with_precision(chosen, sensor, sample, device, tolerance / limits.margin)
    stream = None
    if rate is not None:
        stream = _plan_stream(chosen, trials, sensor, sample, device, rate, latency, limits)
    return ScanPlan(
        sensor=dataclasses.replace(sensor, readout=chosen.readout, auto_threshold=False),
        chosen=chosen,
        trials=trials,
        tolerance=tolerance,
        rounding=rounding,
        stream=stream,
        limits=limits,
    )


def _check_limits(tolerance: float, rate: float | None, latency: float | None) -> None:
    finite(tolerance, "tolerance", above=0.0)
    if rate is not None:
        finite(rate, "rate", above=0.0)
    elif latency is not None:
        raise ValueError("a latency needs a rate; give the frames per second as well")


def _check_sensor(sensor: Sensor) -> None:
    if not isinstance(sensor.readout, LineReadout | PsdReadout):
        raise ValueError(
            f"{sensor.name or 'the sensor'} is a {sensor.kind} sensor; only readouts of cameras and PSDs are planned"
        )
    if not sensor.noise_known:
        missing = "[line] read_noise and gain" if sensor.kind == "camera" else "[psd.noise]"
        raise ValueError(f"the sensor file gives no noise to predict errors from; give {missing}")


def _sampled(recording: str | Path | Array, sensor: Sensor) -> tuple[Sensor, Sample]:
    """Return the sensor with its threshold, and the sample."""
    opened = open_for_scan(recording, sensor)
    try:
        sample = sample_frames(opened.source)
        length = opened.source.length
    finally:
        opened.source.close()
    return opened.sensor, Sample(sample.frames[:, 0], sample.numbers, _UNKNOWN_LENGTH if length is None else length)


def _try_readouts(
    sensor: Sensor, sample: Sample, device: Device, limits: ScanPlanLimits, progress: Progress
) -> tuple[ReadoutTrial, ...]:
    """Return the readouts with their errors and times on the sample, fastest first."""
    readouts: list[LineReadout | PsdReadout]
    if isinstance(sensor.readout, PsdReadout):
        half, readouts = 0.0, [sensor.readout]
    else:
        half = _half_width(sensor, sample, device)
        readouts = [*_readouts(sensor, half)]
    trials = []
    for number, readout in enumerate(readouts):
        found = _errors(dataclasses.replace(sensor, readout=readout), sample, device)
        is_narrow = isinstance(readout, LineReadout) and _is_narrow(readout, half)
        trials.append(found._replace(error=math.nan) if is_narrow else found)
        progress(number + 1, len(readouts))
    seconds = _times(sensor, readouts, sample, device)
    timed = [each._replace(seconds=one) for each, one in zip(_with_unexplained(trials, limits), seconds, strict=True)]
    return tuple(sorted(timed, key=lambda each: each.seconds))


def _times(sensor: Sensor, readouts: Sequence[LineReadout | PsdReadout], sample: Sample, device: Device) -> list[float]:
    """Return the time of each readout for a frame of the sample [s]."""
    frames = device.empty(sample.frames.shape, sample.frames.dtype)
    frames.set(sample.frames)
    calls = []
    for readout in readouts:
        operation = range_readout(dataclasses.replace(sensor, readout=readout))
        calls.append(operation.bind(device, frames.shape, frames.dtype, inputs=(frames,)).run)
    return [each / len(sample.frames) for each in median_times(calls, _ROUNDS)]


def _half_width(sensor: Sensor, sample: Sample, device: Device) -> float:
    """Return half the median width of the line above the threshold [px].

    Raises
    ------
    ValueError
        The sample has no line.
    """
    reading: Any = range_readout(sensor)(sample.frames, device=device)
    good = to_numpy(reading.status) == Status.OK
    if not good.any():
        raise ValueError(f"no line in {len(sample.frames)} frames of the recording; look at `gpuvision scan --preview`")
    return 0.5 * float(np.median(to_numpy(reading.width)[good]))


def _is_narrow(readout: LineReadout, half: float) -> bool:
    """Return whether noise can move the window off the line: the predicted noise is then too small."""
    return readout.method in ("windowed", "ml") and readout.window < half + 1.0


def _readouts(sensor: Sensor, half: float) -> list[LineReadout]:
    """Return the readouts to try for a line of this half width [px]: the sensor's first."""
    given = sensor.readout
    assert isinstance(given, LineReadout)  # a PSD has no other readouts
    windows = _windows(half)
    changes: list[dict[str, Any]] = [
        {},
        *({"method": "windowed", "window": window} for window in windows),
        {"method": "gauss3"},
        *({"method": "fir", "fir_length": length} for length in (4, 8)),
        *({"method": "ml", "window": window} for window in windows),
    ]
    return list(dict.fromkeys(dataclasses.replace(given, **change) for change in changes))


def _windows(half: float) -> list[int]:
    """Return windows that hold a line of this half width [px], ascending."""
    wanted = (factor * half + 1.0 for factor in _HALF_WIDTHS)
    return sorted({next((window for window in _WINDOWS if window >= each), _WINDOWS[-1]) for each in wanted})


def _errors(sensor: Sensor, sample: Sample, device: Device) -> ReadoutTrial:
    """Return the predicted errors of a readout on the sample, without its time."""
    points, errors = _points(sensor, sample, device)
    assert errors is not None  # `_check_sensor` asks for the noise
    z = to_numpy(points.z)
    random, phase, systematic = (
        _rms(None if each is None else each.z) for each in (errors.random, errors.phase, errors.systematic)
    )
    readout: Any = sensor.readout
    lost = float(np.mean(~np.isfinite(z)))
    error = math.hypot(random, phase, systematic) if lost < 1.0 else math.nan
    unexplained = math.sqrt(max(_scatter(z) ** 2 - _rms(errors.readout.z) ** 2, 0.0))
    return ReadoutTrial(readout, math.nan, error, random, phase, systematic, unexplained, lost)


def _scatter(z: Array) -> float:
    """Return the scatter of heights along their profiles [m], about the line through the neighbours; 0 if unknown.

    The second difference of three independent values has 6 times the variance of one of them. Differences beyond 8
    standard deviations are edges of the part.
    """
    second = np.diff(z.astype(np.float64), 2, axis=1)
    known = np.abs(second[np.isfinite(second)])
    if not known.size:
        return 0.0
    return _rms(known[known <= _EDGE * MAD_TO_SIGMA * np.median(known)]) / math.sqrt(6.0)


def _with_unexplained(trials: Sequence[ReadoutTrial], limits: ScanPlanLimits) -> list[ReadoutTrial]:
    """Add the scatter that the noise model of a readout does not explain to its error.

    The least unexplained scatter of the readouts with little noise is taken as the texture of the surface, which is no
    error: a readout with much noise would not show it, nor one that loses samples.
    """
    usable = usable_trials(trials, limits)
    quiet = min((each.random for each in usable), default=0.0)
    shown = [each.unexplained for each in usable if each.random <= _QUIET * quiet]
    texture = min(shown, default=0.0)
    own = [math.sqrt(max(each.unexplained**2 - texture**2, 0.0)) for each in trials]
    return [
        each._replace(unexplained=one, error=math.hypot(each.error, one)) for each, one in zip(trials, own, strict=True)
    ]


def _points(sensor: Sensor, sample: Sample, device: Device) -> Any:
    """Return the points of the sample, and their errors."""
    operation = range_readout(sensor)
    reading = operation(sample.frames, device=device)
    fields = {name: to_numpy(getattr(reading, name)) for name in operation.outputs or ()}
    return measure_points(sensor, fields, sample.numbers, device)


def _rms(sigma: Array | None) -> float:
    """Return the root mean square of the known values; 0 without one."""
    known = np.empty(0) if sigma is None else sigma[np.isfinite(sigma)].astype(np.float64)
    return math.sqrt(float(np.mean(known**2))) if known.size else 0.0


def _chosen(trials: Sequence[ReadoutTrial], tolerance: float, limits: ScanPlanLimits) -> ReadoutTrial:
    """Return the fastest usable readout that meets the tolerance.

    Raises
    ------
    PlanError
        None does.
    """
    usable = usable_trials(trials, limits)
    if not usable:
        message = "no readout gives a point with a predicted error; look at `gpuvision scan --preview`"
        raise PlanError(message, trials, usable)
    return fastest_within(trials, usable, tolerance, limits.margin, "readout")


def _with_precision(
    chosen: ReadoutTrial, sensor: Sensor, sample: Sample, device: Device, largest: float
) -> tuple[ReadoutTrial, float | None]:
    """Return the readout, in double precision if rounding would exceed the largest error [m], and its rounding [m]."""
    if not device.has_double:
        return chosen, None
    double = chosen._replace(readout=dataclasses.replace(chosen.readout, precision="double"))
    heights = [
        to_numpy(_points(dataclasses.replace(sensor, readout=each.readout), sample, device)[0].z).astype(np.float64)
        for each in (chosen, double)
    ]
    rounding = _rms(heights[0] - heights[1])
    if math.hypot(chosen.error, rounding) <= largest:
        return chosen, rounding
    (seconds,) = _times(sensor, [double.readout], sample, device)
    return double._replace(seconds=seconds), rounding


def _plan_stream(
    chosen: ReadoutTrial,
    trials: Sequence[ReadoutTrial],
    sensor: Sensor,
    sample: Sample,
    device: Device,
    rate: float,
    latency: float | None,
    limits: ScanPlanLimits,
) -> Plan:
    """Return the plan of the stream of the chosen readout.

    Raises
    ------
    PlanError
        It does not keep up with the rate.
    """

    def planned(trial: ReadoutTrial) -> Plan:
        operation = range_readout(dataclasses.replace(sensor, readout=trial.readout))
        source = ArraySource(sample.frames, sample.length)
        return plan_stream(
            source,
            operation,
            rate=rate,
            latency=latency,
            margin=limits.rate_margin,
            headroom=max(_HEADROOM, limits.rate_margin),
            device=device,
            sample=sample.frames,
        )

    try:
        return planned(chosen)
    except StreamError as error:
        slow = error
    usable = usable_trials(trials, limits)
    quicker = [each for each in usable if each.seconds < chosen.seconds]
    for each in sorted(quicker, key=lambda each: each.error):
        try:
            planned(each)
        except StreamError:
            continue
        raise PlanError(
            f"{chosen.name} meets the tolerance and is too slow: {slow}; at this rate {each.name} keeps up with a "
            f"predicted error of {micrometres(each.error)}: ask for {at_least(limits.margin * each.error)} or more",
            trials,
            usable,
        ) from slow
    others = f", as all {len(quicker)} faster ones" if quicker else ", and no usable readout is faster"
    raise PlanError(f"{chosen.name} meets the tolerance and is too slow{others}: {slow}", trials, usable) from slow
