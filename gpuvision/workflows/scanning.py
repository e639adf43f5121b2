"""A recording and the description of its sensor become a range image, files and a report.

Frames stream through the readout (`gpuvision.host.pipeline`), the profiles are assembled and resampled
(`gpuvision.ranging`), and everything is written at the end, whole or not at all.
"""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.range_image import write_npz, write_ply, write_png16, write_tiff
from gpuvision.host import Device, Operation, Precision
from gpuvision.host.files import check_file, whole_folder
from gpuvision.host.pipeline import Pipeline, Policy
from gpuvision.host.plan import plan
from gpuvision.host.recordings import open_recording
from gpuvision.host.report import StreamReport
from gpuvision.host.sources import ArraySource, PacedSource, Source
from gpuvision.host.trace import Trace
from gpuvision.plots.range_image import draw_height_map, draw_scan
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangeImage, RangePoints, RotatingSheet
from gpuvision.ranging.regrid import Direction, Grid, HeightMap, Regrid
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status

LATE = 0.01  # s: a recording read later than this did not hold the rate that was asked for
_MOST_CELLS = 1 << 26

Array = npt.NDArray[Any]
Progress = Callable[[int, int | None], object]


@dataclass(frozen=True, kw_only=True)
class Scan:
    """A range image and how it came about.

    Attributes
    ----------
    sensor
        What was scanned with.
    points
        The organised range image, (profiles, samples); status flags say why a point is missing.
    intensity
        Of the light, (profiles, samples): grey levels of a camera, amperes of a PSD.
    heights, grid
        The height map over regular cells, and where they lie.
    numbers
        The recording's frame behind each profile: with drops they are not consecutive.
    device
        Where it was computed.
    stream
        The account of the frames' way.
    seconds
        Time of the steps after it, by name.
    metadata
        Entries of the report about the recording and the requested rate.
    """

    sensor: Sensor
    points: RangePoints
    intensity: Array
    heights: HeightMap
    grid: Grid
    numbers: Array
    device: Device
    stream: StreamReport
    seconds: dict[str, float]
    metadata: dict[str, Any]

    @property
    def valid_fraction(self) -> float:
        """Part of the samples that have a point."""
        return float(np.mean(np.isfinite(self.points.z)))

    def counts(self) -> dict[str, int]:
        """Return how many samples are good (``OK``), and how many have each flag; a sample may have several."""
        status = self.points.status
        flags = {str(flag.name): int(np.count_nonzero(status & flag)) for flag in Status if flag}
        return {"OK": int(np.count_nonzero(status == 0))} | flags

    def summary(self) -> str:
        """Return what came out, in a line."""
        stream, usual, late = self.stream, self.sensor.recording.rate, self.metadata["late"]
        dropped = f" ({stream.dropped} dropped)" if stream.dropped else ""
        speed = f"{self.throughput:,.0f} frames/s on {self.device.label}"
        if usual is not None and self.metadata["rate"] is None:
            speed += f" ({self.throughput / usual:.1f} times the sensor's rate)"
        good = f"{100 * self.valid_fraction:.1f} % of the samples valid"
        overdue = f"; frames were read up to {1e3 * late:.0f} ms late" if late and late > LATE else ""
        return (
            f"{stream.frames} frames{dropped} at {speed}, {good}, {self.grid.columns} x {self.grid.rows} cells{overdue}"
        )

    @property
    def throughput(self) -> float:
        """Frames per second."""
        # A short recording is over before the stream is warm: its own span is all there is.
        measured = self.stream.throughput
        return measured if measured > 0 else self.stream.frames / max(self.stream.seconds, 1e-9)

    def report(self) -> dict[str, Any]:
        """Return what `write` puts into ``report.json``; times in seconds, rates in frames per second."""
        stream = self.stream.to_dict()
        stream.pop("throughput")
        return {
            "gpuvision": version("gpuvision"),
            **self.metadata,
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "precision": "double" if self.points.z.dtype == np.float64 else "single",
            "frames": self.stream.frames,
            "dropped": stream.pop("dropped"),
            "samples_per_frame": self.points.z.shape[1],
            "valid_fraction": self.valid_fraction,
            "status": self.counts(),
            "throughput": self.throughput,
            "latency": stream.pop("latency"),
            "stages": stream.pop("stages"),
            "seconds": {"stream": stream.pop("seconds")} | self.seconds,
            "stream": stream,
            "map": dataclasses.asdict(self.grid) | {"valid_fraction": float(np.mean(np.isfinite(self.heights.z)))},
        }

    def write(self, folder: str | Path) -> None:
        """Write the range image, pictures and the report into a folder, all or nothing.

        ``range_image.tiff``, ``.png`` (16 bit) and ``picture.png`` show the height map, ``range_image.ply`` and
        ``scan.png`` the organised points, ``range_image.npz`` holds both.

        Raises
        ------
        OSError
            The folder cannot be written.
        """
        with whole_folder(folder) as inside:
            start = time.perf_counter()
            z, points = self.heights.z, self.points
            write_tiff(inside / "range_image.tiff", z, self.grid)
            write_png16(inside / "range_image.png", z, self.grid)
            write_ply(inside / "range_image.ply", *points[:3], self.intensity, points.status)
            write_npz(inside / "range_image.npz", *self._arrays())
            draw_height_map(inside / "picture.png", self.heights, self.grid, title=self._title())
            upright = isinstance(self.sensor.readout, LineReadout) and self.sensor.readout.along == "rows"
            draw_scan(inside / "scan.png", points.z, points.status, samples="down" if upright else "across")
            report = self.report()
            report["seconds"]["write"] = time.perf_counter() - start
            (inside / "report.json").write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")

    def _title(self) -> str:
        return self.sensor.name or "Height map"

    def _arrays(self) -> tuple[dict[str, Array], dict[str, str]]:
        light = "grey level" if self.sensor.kind == "camera" else "A"
        held: dict[str, tuple[Any, str]] = {
            **{name: (getattr(self.points, name), "m") for name in ("x", "y", "z")},
            "status": (self.points.status, "flags"),
            "intensity": (self.intensity, light),
            "frame": (self.numbers, ""),
            "map_x": (self.grid.x, "m"),
            "map_y": (self.grid.y, "m"),
            "map_z": (self.heights.z, "m"),
            "map_status": (self.heights.status, "flags"),
            "map_intensity": (self.heights.intensity, light),
        }
        return {name: array for name, (array, _) in held.items()}, {name: unit for name, (_, unit) in held.items()}


def scan(
    recording: str | Path | Source | Array,
    sensor: Sensor,
    *,
    device: Device | None = None,
    precision: Precision = None,
    rate: float | None = None,
    policy: Policy | None = None,
    trace: str | Path | None = None,
    progress: Progress = lambda done, of: None,
) -> Scan:
    """Scan a recording.

    Parameters
    ----------
    recording
        A file or folder (`open_recording`), a source, or an array: (frames, rows, columns) of a camera, (frames,
        strips, 2) of a PSD.
    sensor
        Its description.
    device
        `Device.best` otherwise.
    precision
        Of the arithmetic; None follows the recording.
    rate
        Replay at so many frames per second, as a sensor would send them; the stream is planned for it.
    policy
        What happens to a frame for which there is no room; None: the recording waits, a replay drops the oldest.
    trace
        File for the timeline; tried before the scan.
    progress
        Called with the frames done, and of how many (None: unknown).

    Raises
    ------
    RecordingError, StreamError
        The recording cannot be read, or no plan keeps up with the rate.
    TypeError, ValueError
        The frames are not the sensor's, or no sample is valid.
    OSError
        The timeline cannot be written there.
    """
    timeline = None if trace is None else _Timeline(trace)
    source, name = _opened(recording, sensor)
    sensor.check_frame(source.shape, name)
    readout = _asking_for(sensor, precision)
    device = Device.best() if device is None else device
    paced, stream = _pipeline(source, readout, device, rate, policy, timeline)
    fields, numbers = _streamed(stream, readout.outputs or (), source.length, progress)
    start = time.perf_counter()
    points = _points(sensor, fields, numbers, stream.device)
    intensity = fields["peak" if sensor.kind == "camera" else "total"]
    middle = time.perf_counter()
    heights, grid = resampled(sensor, points, intensity, stream.device)
    if timeline is not None:
        timeline.write_now()
    seconds = {"assemble": middle - start, "resample": time.perf_counter() - middle}
    return Scan(
        sensor=sensor,
        points=points,
        intensity=intensity,
        heights=heights,
        grid=grid,
        numbers=numbers,
        device=stream.device,
        stream=stream.report(),
        seconds=seconds,
        metadata=_metadata(name, sensor, rate, paced),
    )


class _Timeline(Trace):
    """A trace that waits for the end of the scan: bad input leaves no file, and one that cannot be is told first."""

    def __init__(self, path: str | Path) -> None:
        check_file(path)
        super().__init__(path)

    def write(self) -> None:
        """Do nothing at the end of the stream."""

    def write_now(self) -> None:
        """Write the file."""
        super().write()


def _opened(recording: str | Path | Source | Array, sensor: Sensor) -> tuple[Source, str]:
    if isinstance(recording, Source):
        return recording, type(recording).__name__
    if isinstance(recording, np.ndarray):
        return ArraySource(recording), "array"
    return open_recording(recording, channel=sensor.recording.channel, key=sensor.recording.key), str(recording)


def _metadata(name: str, sensor: Sensor, rate: float | None, source: Source) -> dict[str, Any]:
    """Return the entries of the report about the recording and the requested rate: seconds, frames per second."""
    return {
        "recording": name,
        "sensor": sensor.name,
        "kind": sensor.kind,
        "sensor_rate": sensor.recording.rate,
        "rate": rate,
        "late": source.late * 1e-9 if isinstance(source, PacedSource) else None,
    }


def _asking_for(sensor: Sensor, precision: Precision) -> LineReadout | PsdReadout:
    """Return the readout with just the outputs that a range image needs."""
    place = ("position",) if isinstance(sensor.transport, RotatingSheet) else ("g", "h")
    light = "peak" if sensor.kind == "camera" else "total"
    return dataclasses.replace(sensor.readout, outputs=(*place, light, "status"), precision=precision)


def _pipeline(
    source: Source,
    operation: Operation[Any],
    device: Device,
    rate: float | None,
    policy: Policy | None,
    timeline: Trace | None,
) -> tuple[Source, Pipeline[Any]]:
    """Return the source, held back to a rate if one is given, and the stream of its frames."""
    if rate is None:
        stream = Pipeline(source, operation, device=device, profile=True, trace=timeline, policy=policy or "block")
        return source, stream
    paced = PacedSource(source, rate)
    fitting = plan(paced, operation, device=device)
    setup: dict[str, Any] = {"policy": policy or "drop_oldest", "batch": fitting.batch, "ring": fitting.ring}
    return paced, Pipeline(paced, operation, device=device, profile=True, trace=timeline, **setup)


def _streamed(
    stream: Pipeline[Any], names: Sequence[str], length: int | None, progress: Progress
) -> tuple[dict[str, Array], Array]:
    """Return the fields of all frames by name, and the frames' numbers."""
    parts, numbers = [], []
    with stream:
        for batch in stream:
            kept = batch.result
            parts.append(type(kept)(*(None if each is None else each.copy() for each in kept)))
            numbers.append(np.arange(batch.number, batch.number + len(batch)))
            progress(batch.number + len(batch), length)
    if not parts:
        raise ValueError("the recording has no frame; expected at least one")
    return {name: np.concatenate([getattr(each, name) for each in parts]) for name in names}, np.concatenate(numbers)


def _points(sensor: Sensor, fields: dict[str, Array], numbers: Array, device: Device) -> RangePoints:
    """Return the organised range image of the fields that a readout gave for the frames of these numbers."""
    place = [fields[name] for name in ("position", "g", "h") if name in fields]
    transports = sensor.transport.transport(int(numbers[-1]) + 1)[numbers]
    return assembled(sensor, place, transports, fields["status"], device)


def assembled(sensor: Sensor, place: Sequence[Array], transports: Array, status: Array, device: Device) -> RangePoints:
    """Return the organised range image of what a sensor reads.

    Parameters
    ----------
    sensor
        Says how the sheet moves, what lies in the scene, and whether doubtful points stay.
    place
        g and h, (profiles, samples) each, or the position for a sheet that turns.
    transports
        (profiles,).
    status
        (profiles, samples) flags.
    device
        Where it is done.
    """
    moved = transports.astype(place[0].dtype)
    assemble = RangeImage(geometry=sensor.transport, limits=sensor.output.limits)
    points: RangePoints = assemble(*place, moved, status, device=device)
    if sensor.output.ambiguous == "drop":
        doubtful = (points.status & Status.AMBIGUOUS) != 0
        for array in points[:3]:
            array[doubtful] = np.nan
    return points


def resampled(sensor: Sensor, points: RangePoints, light: Array, device: Device) -> tuple[HeightMap, Grid]:
    """Return the height map of organised points, over the cells that the sensor's file asks for.

    Raises
    ------
    ValueError
        No point is valid, or they span too many cells.
    """
    if not np.any(np.isfinite(points.z)):
        flags = ", ".join(flag.name or "" for flag in Status if flag and np.any(points.status & flag))
        raise ValueError(
            f"not one valid sample in {len(points.z)} frames ({flags}); check thresholds and [output] limits"
        )
    output = sensor.output
    grid = Grid.covering(points.x, points.y, output.cell)
    if grid.rows * grid.columns > _MOST_CELLS:
        raise ValueError(
            f"the points span {grid.columns} x {grid.rows} cells of {output.cell} m; "
            "give [output] a larger cell, or limits x and y [m]"
        )
    along, across = _directions(points)
    regrid = Regrid(
        grid=grid,
        max_gap=output.max_gap,
        max_step=min(output.max_step, float(np.finfo(np.float32).max)),
        fold_tolerance=output.fold_tolerance,
        folded=output.folded,
        along=along,
        across=across,
    )
    return regrid(*points[:3], light, points.status, device=device), grid


def _directions(points: RangePoints) -> tuple[Direction, Direction]:
    """Find in which scene directions samples and profiles advance: what most neighbours say."""
    steps = np.empty((2, 2))
    for place, name in enumerate("xy"):
        values = getattr(points, name)
        for axis in (0, 1):
            known = np.diff(values, axis=axis)
            known = known[np.isfinite(known)]
            steps[place, axis] = np.median(known) if known.size else 0.0
    samples_on_x = abs(steps[0, 1]) >= abs(steps[1, 1])
    on_samples, on_profiles = (0, 1) if samples_on_x else (1, 0)
    names: tuple[tuple[Direction, Direction], tuple[Direction, Direction]] = (("x", "-x"), ("y", "-y"))
    return names[on_samples][int(steps[on_samples, 1] < 0)], names[on_profiles][int(steps[on_profiles, 0] < 0)]
