"""Scan of a recording: frames to a range image and a height map.

The frames stream through the readout (`gpuvision.host.pipeline`). The profiles are then assembled to a range image and
resampled to a height map (`gpuvision.ranging`).
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Operation, Precision, to_numpy
from gpuvision.host.pipeline import Pipeline, Policy
from gpuvision.host.planning import Plan, plan_stream
from gpuvision.host.sources import PacedSource, Source
from gpuvision.ranging.background import FramesCopied
from gpuvision.ranging.focus_stack import FocusStack
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangeImage, RangePoints
from gpuvision.ranging.regrid import Direction, Regrid
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import SAMPLE_FLAGS, Status
from gpuvision.workflows.focus_frames import read_focus_peak
from gpuvision.workflows.opened_recording import ambient_level, open_for_scan
from gpuvision.workflows.scan_errors import ScanErrors, focus_errors, predict_errors, sigma_outputs
from gpuvision.workflows.scan_result import Scan, ScanLimits, scan_advice

Array = npt.NDArray[Any]
Progress = Callable[[int, int | None], object]


def scan(
    recording: str | Path | Source | Array,
    sensor: Sensor,
    *,
    device: Device | None = None,
    precision: Precision = None,
    rate: float | None = None,
    policy: Policy | None = None,
    stream_plan: Plan | None = None,
    progress: Progress = lambda done, of: None,
    limits: ScanLimits = ScanLimits(),
) -> Scan:
    """Compute the range image and the height map of a recording.

    Parameters
    ----------
    recording : str, Path, Source or numpy.ndarray
        A file or folder (`open_recording`), a source of frames, or an array: (frames, rows, columns) of a camera,
        (frames, strips, 2) of a PSD.
    sensor : Sensor
        Sensor of the recording.
    device : Device, optional
        Device of the computation; default `Device.best`.
    precision : {"single", "double"}, optional
        Precision of the arithmetic; default: that of the sensor's readout, and without one that of the recording.
    rate : float, optional
        Replay the recording at this rate [frames/s]; batch and ring size of the stream are planned for it. Default:
        read as fast as the device processes.
    policy : {"block", "drop_oldest", "raise"}, optional
        Handling of a frame when the queue is full; default "block" without a rate and "drop_oldest" with one.
    stream_plan : Plan, optional
        Plan of the stream at this rate, such as ``ScanPlan.stream``. Default: a plan by measurements on blank frames,
        on which ``"ml"`` is faster than on a line. A plan gives the device, too.
    progress : callable, optional
        Called with the number of processed frames and the number of all frames (None if unknown).
    limits : ScanLimits, optional
        Limits of the delay and of the size of the height map.

    Returns
    -------
    Scan

    Raises
    ------
    RecordingError
        The recording cannot be read.
    StreamError
        No plan keeps up with the rate.
    TypeError, ValueError
        The frames do not fit the sensor, or no sample is valid.
    """
    if isinstance(sensor.readout, FocusStack):
        if rate is not None or policy is not None or stream_plan is not None:
            raise ValueError("a focus stack is one measurement; rate, policy and stream_plan have no effect on it")
        return _scan_stack(recording, sensor, sensor.readout, device, precision, progress, limits)
    if stream_plan is not None:
        _check_plan(stream_plan, rate, device)
    opened = open_for_scan(recording, sensor)
    source, name, sensor = opened.source, opened.name, opened.sensor
    # A background that is subtracted, or a threshold that is estimated, takes the ambient light into account.
    is_checked = sensor.kind == "camera" and sensor.recording.background == "none" and not sensor.auto_threshold
    copied = FramesCopied(source) if is_checked else None
    source = source if copied is None else copied
    try:
        readout = range_readout(sensor, precision)
        device = Device.best() if device is None else device
        paced, stream = _pipeline(source, readout, device, rate, policy, stream_plan)
    except BaseException:
        source.close()
        raise
    fields, frame_numbers = _read_frames(stream, readout.outputs or (), source.length, progress)
    if sensor.recording.damaged == "drop":
        damaged = np.isin(frame_numbers, sorted(paced.damaged_frames()))
        fields["status"][damaged] |= np.uint8(Status.NO_DATA)
    start = time.perf_counter()
    points, errors = measure_points(sensor, fields, frame_numbers, stream.device)
    intensity = fields["peak" if sensor.kind == "camera" else "total"]
    middle = time.perf_counter()
    heights, grid, errors = _height_map(sensor, points, intensity, errors, stream.device, limits.max_cells)
    seconds = {"assemble": middle - start, "resample": time.perf_counter() - middle}
    return Scan(
        sensor=sensor,
        points=points,
        intensity=intensity,
        heights=heights,
        grid=grid,
        frame_numbers=frame_numbers,
        device=stream.device,
        stream=stream.report(),
        seconds=seconds,
        metadata=_metadata(name, sensor, rate, paced),
        limits=limits,
        errors=errors,
        ambient=None if copied is None else ambient_level(np.stack(copied.copies), sensor),
    )


def _check_plan(plan: Plan, rate: float | None, device: Device | None) -> None:
    """Check that the plan of a stream is for the rate and the device of a scan.

    Raises
    ------
    ValueError
        It is not.
    """
    if rate != plan.rate:
        asked = "no rate is asked for" if rate is None else f"{rate:g} frames/s are asked for"
        raise ValueError(f"stream_plan is for {plan.rate:g} frames/s, and {asked}; give both the same rate")
    if device is not None and device != plan.device:
        raise ValueError(f"stream_plan is for {plan.device.label}, and {device.label} is asked for; leave out device")


def _scan_stack(
    recording: str | Path | Source | Array,
    sensor: Sensor,
    stack: FocusStack,
    device: Device | None,
    precision: Precision,
    progress: Progress,
    limits: ScanLimits,
) -> Scan:
    """Compute the range image and the height map of a focus stack: one frame for each focus distance."""
    device = Device.best() if device is None else device  # before the stack is read
    opened = open_for_scan(recording, sensor)
    peak, stream = read_focus_peak(opened.source, stack, progress)
    assert isinstance(sensor.transport, StraightTransport)  # the reader of [focus] gives no other
    sharpest = np.where(np.isfinite(peak.frame), np.rint(peak.frame), -1.0).astype(np.int64)
    if sensor.recording.damaged == "drop":
        near = np.arange(-stack.neighbours, stack.neighbours + 1)
        damaged = np.isin(sharpest, np.add.outer(sorted(opened.source.damaged_frames()), near))
        damaged &= sharpest >= 0  # -1 is no frame number
        peak.status[damaged] |= np.uint8(Status.NO_DATA)
        peak.frame[damaged] = np.nan
    start = time.perf_counter()
    points = stack.points(
        peak, sensor.transport, sensor.output.limits, np.float64 if precision == "double" else np.float32
    )
    _drop_ambiguous(sensor, points)
    intensity = peak.strength.astype(points.z.dtype)
    errors = None if peak.sigma is None else focus_errors(sensor, stack, peak, points)
    middle = time.perf_counter()
    sigma = None if errors is None else errors.random.z
    heights, grid = resample_heights(sensor, points, intensity, device, max_cells=limits.max_cells, sigma=sigma)
    return Scan(
        sensor=sensor,
        points=points,
        intensity=intensity,
        heights=heights,
        grid=grid,
        frame_numbers=np.where(np.isfinite(peak.frame), sharpest, -1),
        device=device,
        stream=stream,
        seconds={"assemble": middle - start, "resample": time.perf_counter() - middle},
        metadata=_metadata(opened.name, sensor, None, opened.source),
        limits=limits,
        errors=errors,
    )


def _metadata(name: str, sensor: Sensor, rate: float | None, source: Source) -> dict[str, Any]:
    """Return the entries of the report about the recording and the replay: rates [frames/s], delay ``late`` [s]."""
    return {
        "recording": name,
        "sensor": sensor.name,
        "kind": sensor.kind,
        "background": str(sensor.recording.background),
        "threshold": None if isinstance(sensor.readout, PsdReadout) else sensor.readout.threshold,
        "readout": _line_settings(sensor.readout),
        "sensor_rate": sensor.recording.rate,
        "rate": rate,
        "encoder": _encoder(sensor),
        "damaged_frames": sorted(source.damaged_frames()),
        "late": source.late * 1e-9 if isinstance(source, PacedSource) else None,
    }


def _line_settings(readout: LineReadout | PsdReadout | FocusStack) -> dict[str, Any] | None:
    """Return method, window, filter length and precision of a line readout, which ``--tolerance`` chooses."""
    if not isinstance(readout, LineReadout):
        return None
    return {name: getattr(readout, name) for name in ("method", "window", "fir_length", "precision")}


def _encoder(sensor: Sensor) -> dict[str, Any] | None:
    """Return the file of the encoder and the regularity of its positions [m or rad]."""
    if sensor.encoder is None:
        return None
    statistics = dataclasses.asdict(sensor.encoder.statistics())
    known = {
        name: None if isinstance(value, float) and math.isnan(value) else value for name, value in statistics.items()
    }
    return {"file": str(sensor.encoder.file), "scale": sensor.encoder.scale, **known}


def range_readout(sensor: Sensor, precision: Precision = None) -> LineReadout | PsdReadout:
    """Return the sensor's readout with only the outputs that a range image and its errors need.

    Parameters
    ----------
    sensor : Sensor
        Camera or PSD.
    precision : {"single", "double", None}
        Precision of the readout; None: as the sensor's readout says.

    Returns
    -------
    LineReadout or PsdReadout
    """
    assert not isinstance(sensor.readout, FocusStack)  # it has no stream of profiles
    positions = ("position",) if isinstance(sensor.transport, RotatingSheet) else ("g", "h")
    light = "peak" if sensor.kind == "camera" else "total"
    errors = sigma_outputs(sensor)
    # Of the line, for the error of its phase.
    shape = ("position", "width", "total") if errors and sensor.kind == "camera" else ()
    outputs = tuple(dict.fromkeys((*positions, light, "status", *shape, *errors)))
    precision = sensor.readout.precision if precision is None else precision
    return dataclasses.replace(sensor.readout, outputs=outputs, precision=precision)


def _pipeline(
    source: Source,
    operation: Operation[Any],
    device: Device,
    rate: float | None,
    policy: Policy | None,
    planned: Plan | None,
) -> tuple[Source, Pipeline[Any]]:
    """Return the source, paced if a rate [frames/s] is given, and the pipeline over its frames."""
    if rate is None:
        stream = Pipeline(source, operation, device=device, profile=True, policy=policy or "block")
        return source, stream
    paced = PacedSource(source, rate)
    planned = plan_stream(paced, operation, device=device) if planned is None else planned
    setup: dict[str, Any] = {"profile": True, "policy": policy or "drop_oldest"}
    return paced, Pipeline(paced, operation, **setup, **planned.settings)


def _read_frames(
    stream: Pipeline[Any], names: Sequence[str], length: int | None, progress: Progress
) -> tuple[dict[str, Array], Array]:
    """Return the readout's outputs of all frames by name, (frames, ...), and the frame numbers (frames,)."""
    parts, frame_numbers = [], []
    with stream:
        for batch in stream:
            kept = batch.result
            parts.append(type(kept)(*(None if each is None else each.copy() for each in kept)))
            frame_numbers.append(np.arange(batch.number, batch.number + len(batch)))
            progress(batch.number + len(batch), length)
    if not parts:
        raise ValueError("the recording has no frame; expected at least one")
    return {name: np.concatenate([getattr(each, name) for each in parts]) for name in names}, np.concatenate(
        frame_numbers
    )


def measure_points(
    sensor: Sensor, fields: dict[str, Array], frame_numbers: Array, device: Device
) -> tuple[RangePoints, ScanErrors | None]:
    """Assemble the points of a readout's outputs, and predict their errors.

    Parameters
    ----------
    sensor : Sensor
        Gives the transport of each frame.
    fields : dict of str to numpy.ndarray
        Outputs of `range_readout` by name, (frames, samples). Flags of the encoder are added to ``status``.
    frame_numbers : (frames,) int64
        Numbers of the frames in the recording, ascending.
    device : Device
        Device of the computation.

    Returns
    -------
    RangePoints
        Organised range image, (frames, samples).
    ScanErrors or None
        None without a noise model.
    """
    positions = [fields[name] for name in (("g", "h") if "g" in fields else ("position",))]
    transports, status = sensor.transports(int(frame_numbers[-1]) + 1), fields["status"]
    if sensor.encoder is not None:
        status[sensor.encoder.not_advancing()[frame_numbers]] |= np.uint8(Status.NOT_INVERTIBLE)
    if sensor.polygon is not None:
        transports = sensor.polygon.sample_transports(transports, status.shape[1])
    transports = transports[frame_numbers]
    points = assemble_points(sensor, positions, transports, status, device)
    errors = predict_errors(sensor, fields, points, transports, device) if "sigma" in fields else None
    return points, errors


def assemble_points(
    sensor: Sensor, positions: Sequence[Array], transports: Array, status: Array, device: Device
) -> RangePoints:
    """Compute the organised range image of the profiles of a sensor.

    Parameters
    ----------
    sensor : Sensor
        Gives the transport, the limits of the scene and the handling of ambiguous samples (``[output]``).
    positions : sequence of numpy.ndarray
        g and h [m] for a straight transport; the position [px] alone for a rotating sheet. Each (profiles, samples).
    transports : numpy.ndarray
        Transport of each profile, (profiles,): [m], or the rotation [rad] of a rotating sheet. Behind a polygon mirror:
        of each sample, (profiles, samples).
    status : numpy.ndarray
        `Status` flags of the samples, (profiles, samples), uint8.
    device : Device
        Device of the computation.

    Returns
    -------
    RangePoints
        NumPy arrays (profiles, samples). Ambiguous points are NaN where the sensor drops them.
    """
    limits = sensor.output.limits
    if sensor.polygon is not None:
        assert isinstance(sensor.transport, StraightTransport)  # a PSD has no other transport
        points = sensor.polygon.assemble(
            positions[1], transports, status, transport=sensor.transport, limits=limits, device=device
        )
    else:
        assemble = RangeImage(geometry=sensor.transport, limits=limits)
        points = assemble(*positions, transports.astype(positions[0].dtype), status, device=device)
    _drop_ambiguous(sensor, points)
    return points


def _drop_ambiguous(sensor: Sensor, points: RangePoints) -> None:
    """Make ambiguous points NaN where the sensor file asks for that."""
    if sensor.output.ambiguous == "drop":
        ambiguous = (to_numpy(points.status) & Status.AMBIGUOUS) != 0
        for coordinate in (points.x, points.y, points.z):
            to_numpy(coordinate)[ambiguous] = np.nan


def _height_map(
    sensor: Sensor,
    points: RangePoints,
    intensity: Array,
    errors: ScanErrors | None,
    device: Device,
    max_cells: int,
) -> tuple[HeightMap, Grid, ScanErrors | None]:
    """Return the height map with its grid, and the errors with the systematic errors of the map."""
    sigma = None if errors is None else errors.random.z
    heights, grid = resample_heights(sensor, points, intensity, device, max_cells=max_cells, sigma=sigma)
    if errors is not None:
        # Linear interpolation of systematic errors, as of the intensity: the errors of neighbours are the same.
        maps: dict[str, Any] = {
            f"map_{name}": to_numpy(resample_heights(sensor, points, each.z, device, max_cells=max_cells)[0].intensity)
            for name, each in (("systematic", errors.systematic), ("phase", errors.phase))
            if each is not None
        }
        errors = dataclasses.replace(errors, **maps)
    return heights, grid, errors


def resample_heights(
    sensor: Sensor,
    points: RangePoints,
    light: Array,
    device: Device,
    *,
    max_cells: int = ScanLimits.max_cells,
    sigma: Array | None = None,
) -> tuple[HeightMap, Grid]:
    """Resample an organised range image to a height map over the grid of the sensor file (``[output]``).

    Parameters
    ----------
    sensor : Sensor
        Gives the cell size and the limits of interpolation.
    points : RangePoints
        Organised range image, NumPy arrays (profiles, samples).
    light : numpy.ndarray
        Intensity of the samples, (profiles, samples).
    device : Device
        Device of the computation.
    max_cells : int
        Largest number of cells of the grid, default 2^26.
    sigma : numpy.ndarray, optional
        Random standard deviation of z [m], (profiles, samples); requests the standard deviation of the heights.

    Returns
    -------
    HeightMap
        NumPy arrays (rows, columns).
    Grid
        Cells of the height map; they cover all points.

    Raises
    ------
    ValueError
        No point is valid, or the points span more than ``max_cells`` cells.
    """
    x, y, z, status = to_numpy(points.x), to_numpy(points.y), to_numpy(points.z), to_numpy(points.status)
    if not np.any(np.isfinite(z)):
        flags = ", ".join(flag.name or "" for flag in SAMPLE_FLAGS if np.any(status & flag))
        advice = "; ".join(scan_advice(status, sensor)) or "check thresholds and [output] limits"
        raise ValueError(f"no valid sample in {len(z)} frames ({flags}); {advice}")
    output = sensor.output
    grid = Grid.covering(x, y, output.cell)
    if grid.rows * grid.columns > max_cells:
        raise ValueError(
            f"the points span {grid.columns} x {grid.rows} cells of {output.cell} m; "
            "give [output] a larger cell, or limits x and y [m]"
        )
    along, across = _directions(x, y)
    regrid = Regrid(
        grid=grid,
        max_gap=output.max_gap,
        max_step=min(output.max_step, float(np.finfo(np.float32).max)),
        fold_tolerance=output.fold_tolerance,
        folded=output.folded,
        along=along,
        across=across,
        sigma=sigma is not None,
    )
    return regrid(x, y, z, light, status, sigma, device=device), grid


def _directions(x: Array, y: Array) -> tuple[Direction, Direction]:
    """Return the scene directions of increasing sample and profile number, by the median steps in x and y."""
    steps = np.empty((2, 2))
    for coordinate, values in enumerate((x, y)):
        for axis in (0, 1):
            known = np.diff(values, axis=axis)
            known = known[np.isfinite(known)]
            steps[coordinate, axis] = np.median(known) if known.size else 0.0
    samples_on_x = abs(steps[0, 1]) >= abs(steps[1, 1])
    on_samples, on_profiles = (0, 1) if samples_on_x else (1, 0)
    names: tuple[tuple[Direction, Direction], tuple[Direction, Direction]] = (("x", "-x"), ("y", "-y"))
    return names[on_samples][int(steps[on_samples, 1] < 0)], names[on_profiles][int(steps[on_profiles, 0] < 0)]
