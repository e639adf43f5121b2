"""Result of a scan: range image, height map, report, and the files that hold them."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.formats.json import report_text
from gpuvision.formats.range_image import write_npz, write_ply, write_png16, write_tiff
from gpuvision.formats.surface_files import SURFACE_WRITERS, SurfaceFormat, surface_problem
from gpuvision.host import Device, to_numpy
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.host.report import StreamReport
from gpuvision.plots.range_image import draw_height_map, draw_scan, height_span
from gpuvision.ranging.height_map import MAX_MAP_CELLS, Grid, HeightMap
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.range_image import RangePoints
from gpuvision.ranging.sheet_motion import RotatingSheet
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import SAMPLE_FLAGS, Status
from gpuvision.workflows.scan_errors import ScanErrors, error_budget

Array = npt.NDArray[Any]
PlyPoints = Literal["organised", "valid"]

SCAN_FILES = (
    "range_image.tiff",
    "range_image.png",
    "range_image.ply",
    "range_image.npz",
    "picture.png",
    "scan.png",
    "report.json",
)
"""Names of the files that `Scan.write` writes."""

SIGMA_FILES = ("range_image_sigma.tiff", "range_image_systematic.tiff")
"""Names of the files that `Scan.write` also writes if the random and the systematic errors are known."""


def surface_files(formats: Iterable[str]) -> dict[SurfaceFormat, str]:
    """Return the name of the file of each surface format that `Scan.write` writes.

    Parameters
    ----------
    formats : iterable of str
        Names of formats: "x3p", "sur", "sdf" or "sdf-ascii".

    Raises
    ------
    ValueError
        A format is unknown, or two formats have the same file.
    """
    names: dict[SurfaceFormat, str] = {}
    for given in dict.fromkeys(formats):
        each = next((known for known in SURFACE_WRITERS if known == given), None)
        if each is None:
            raise ValueError(f"the format is {given!r}, expected one of {', '.join(SURFACE_WRITERS)}")
        name = f"range_image.{SURFACE_WRITERS[each][0]}"
        if name in names.values():
            raise ValueError(f"two formats write {name}; give one of them")
        names[each] = name
    return names


_OPTIONAL_FILES = (*SIGMA_FILES, *(f"range_image.{extension}" for extension, _ in SURFACE_WRITERS.values()))


@dataclass(frozen=True, kw_only=True)
class ScanLimits:
    """Limits of a scan.

    Attributes
    ----------
    max_delay : float
        Delay of a frame [s] from which on the summary says that the replay did not hold the requested rate. Chosen.
        Default 0.01.
    max_cells : int
        Largest number of cells of a height map, default `gpuvision.ranging.height_map.MAX_MAP_CELLS`, 2^26.
    """

    max_delay: float = 0.01
    max_cells: int = MAX_MAP_CELLS


@dataclass(frozen=True, kw_only=True)
class Scan:
    """Range image of a recording, with its height map and the report of the stream.

    Attributes
    ----------
    sensor : Sensor
        Sensor of the recording.
    points : RangePoints
        Organised range image, NumPy arrays (profiles, samples); the status flags say why a point is missing.
    intensity : numpy.ndarray
        Intensity of the light, (profiles, samples): grey levels of a camera, amperes of a PSD.
    heights : HeightMap
        Height map, NumPy arrays of the shape of the grid.
    grid : Grid
        Cells of the height map.
    frame_numbers : numpy.ndarray
        Number of each profile's frame in the recording, (profiles,); not consecutive where frames were dropped. Of a
        focus stack: number of the sharpest frame of each pixel, (rows, columns); -1 without a sharpest frame.
    device : Device
        Device of the computation.
    stream : StreamReport
        Frame counts, times and latencies of the stream.
    seconds : dict of str to float
        Duration [s] of the steps after the stream, by name.
    metadata : dict
        Further entries of the report: recording, sensor, rates [frames/s], delay of the replay [s].
    limits : ScanLimits
        Limits of the scan.
    errors : ScanErrors, optional
        Predicted errors of the points; None if the sensor file gives no noise. The random error of the height map is
        ``heights.sigma``.
    ambient : float, optional
        Level of the frames beside the line [grey levels], see `gpuvision.workflows.opened_recording.ambient_level`;
        None where a background is subtracted or the threshold is estimated, and for other sensors than cameras.
    """

    sensor: Sensor
    points: RangePoints
    intensity: Array
    heights: HeightMap
    grid: Grid
    frame_numbers: Array
    device: Device
    stream: StreamReport
    seconds: dict[str, float]
    metadata: dict[str, Any]
    limits: ScanLimits = ScanLimits()
    errors: ScanErrors | None = None
    ambient: float | None = None

    @property
    def valid_fraction(self) -> float:
        """Fraction of the samples that have a point, 0 to 1."""
        return float(np.mean(np.isfinite(to_numpy(self.points.z))))

    def counts(self) -> dict[str, int]:
        """Return the number of samples without a flag (``OK``) and with each flag; a sample may have several flags."""
        status = to_numpy(self.points.status)
        flags = {str(flag.name): int(np.count_nonzero(status & flag)) for flag in SAMPLE_FLAGS}
        return {"OK": int(np.count_nonzero(status == 0))} | flags

    def advice(self) -> tuple[str, ...]:
        """Return what to try; empty for a good scan.

        Where most samples have no point, see `scan_advice`. Ambient light that reaches the threshold shifts the line.
        """
        sentences = scan_advice(to_numpy(self.points.status), self.sensor) if self.valid_fraction < 0.5 else ()
        if self.ambient is None:
            return sentences
        readout = self.sensor.readout
        assert isinstance(readout, LineReadout)  # no other one has a level
        if self.ambient < readout.threshold:
            return sentences
        return (
            *sentences,
            f"the frames have {self.ambient:g} grey levels beside the line, expected less than the threshold of "
            f'{readout.threshold:g}; ambient light shifts the line: try [line] threshold = "auto", or subtract it with '
            "[recording] background",
        )

    def summary(self) -> str:
        """Return one line: frames, throughput, fraction of valid samples, size of the height map.

        A replay at a rate also names its longest stall and the part of the stream that spent it. With an encoder the
        line gives the number of profiles that do not advance, and of a damaged recording the number of damaged frames.
        """
        stream, sensor_rate, delay = self.stream, self.sensor.recording.rate, self.metadata["late"]
        dropped = f" ({stream.dropped} dropped)" if stream.dropped else ""
        speed = f"{self.throughput:,.0f} frames/s on {self.device.label}"
        if sensor_rate is not None and self.metadata["rate"] is None:
            speed += f" ({self.throughput / sensor_rate:.1f} times the sensor's rate)"
        valid = f"{100 * self.valid_fraction:.1f} % of the samples valid"
        overdue = (
            f"; frames were read up to {1e3 * delay:.0f} ms late" if delay and delay > self.limits.max_delay else ""
        )
        stall = stream.longest_stall if self.metadata["rate"] is not None else None
        stalled = "" if stall is None else f"; longest stall {stall}"
        backward = (self.metadata["encoder"] or {}).get("not_advancing", 0)
        unordered = f"; {backward} profiles do not advance" if backward else ""
        count = len(self.metadata["damaged_frames"])
        damaged = f"; {count} damaged frame{'s' * (count > 1)}" if count else ""
        size = f"{self.grid.columns} x {self.grid.rows} cells"
        return f"{stream.frames} frames{dropped} at {speed}, {valid}, {size}{overdue}{stalled}{unordered}{damaged}"

    def error_budget(self) -> dict[str, Any]:
        """Return the predicted and measured errors of the points and heights: see `scan_errors.error_budget`."""
        sigma = self.heights.sigma
        map_sigma = None if sigma is None else to_numpy(sigma)
        return error_budget(self.errors, to_numpy(self.points.z), map_sigma, camera=self.sensor.kind == "camera")

    @property
    def throughput(self) -> float:
        """Frames per second."""
        # A short recording ends within the warm-up of the stream, which then has no throughput: use the whole time.
        measured = self.stream.throughput
        return measured if measured > 0 else self.stream.frames / max(self.stream.seconds, 1e-9)

    def report(self) -> dict[str, Any]:
        """Return the content of ``report.json``; times in seconds, rates in frames per second."""
        stream = self.stream.to_dict()
        valid_cells = float(np.mean(np.isfinite(to_numpy(self.heights.z))))
        stream.pop("throughput")
        return {
            "gpuvision": version("gpuvision"),
            **self.metadata,
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "precision": "double" if self.points.z.dtype == np.float64 else "single",
            "frames": self.stream.frames,
            "dropped": stream.pop("dropped"),
            "samples_per_frame": self.points.z.size if self.sensor.kind == "focus" else self.points.z.shape[1],
            "valid_fraction": self.valid_fraction,
            "ambient_level": self.ambient,
            "status": self.counts(),
            "throughput": self.throughput,
            "latency": stream.pop("latency"),
            "stages": stream.pop("stages"),
            "seconds": {"stream": stream.pop("seconds")} | self.seconds,
            "stream": stream,
            "map": dataclasses.asdict(self.grid) | {"valid_fraction": valid_cells},
            "error_budget": self.error_budget(),
        }

    def surface_problems(self, folder: str | Path, formats: Iterable[str]) -> dict[SurfaceFormat, str]:
        """Return a message for each format that cannot hold the height map; parameters as for `write`."""
        problems = {each: (name, surface_problem(each, self.grid)) for each, name in surface_files(formats).items()}
        return {
            each: f"cannot write {Path(folder) / name}: {problem}; leave out --format {each} (Python: formats)"
            for each, (name, problem) in problems.items()
            if problem is not None
        }

    def write(
        self,
        folder: str | Path,
        *,
        formats: Iterable[str] = (),
        ply_points: PlyPoints = "organised",
        overwrite: bool = False,
    ) -> None:
        """Write the range image, pictures and the report into a folder; after an error no file remains.

        ``range_image.tiff``, ``range_image.png`` (16 bit) and ``picture.png`` show the height map. ``range_image.ply``
        and ``scan.png`` show the organised points. ``range_image.npz`` holds both. ``report.json`` holds the report.
        With a noise model ``range_image_sigma.tiff`` holds the random standard deviation of the height map; with the
        covariance of a calibration ``range_image_systematic.tiff`` holds the systematic one. The PLY and NPZ files have
        the standard deviations of the points, ``sigma_x``, ``systematic_x`` and ``phase_x`` and so on.

        Files of an earlier scan for a standard deviation or a format that this scan does not have are removed, if they
        were not changed since.

        Parameters
        ----------
        folder : str or Path
            Output folder; created if it is missing.
        formats : iterable of {"x3p", "sur", "sdf", "sdf-ascii"}, optional
            Further files of the height map, ``range_image.x3p`` and so on; see `gpuvision.formats.surface_files`.
        ply_points : {"organised", "valid"}
            Points in the PLY file: all samples in scan order with NaN in holes (default), or only the valid points.
        overwrite : bool
            Whether files may be replaced that no earlier scan wrote. Default False.

        Raises
        ------
        FileExistsError
            A file exists, and is not an unchanged output of an earlier scan, or is a file that the sensor file names;
            see `gpuvision.host.outputs`.
        OSError
            The folder cannot be written.
        ValueError
            A format cannot hold the height map, see `surface_problems`; no file is written.
        """
        names = surface_files(formats)
        if problems := self.surface_problems(folder, names):
            raise ValueError("; ".join(problems.values()))
        outputs = Outputs("scan", inputs=self.sensor.files, overwrite=overwrite)
        with outputs.folder(folder, optional=_OPTIONAL_FILES) as inside:
            start = time.perf_counter()
            z, points = self.heights.z, self.points
            write_tiff(inside / "range_image.tiff", z, self.grid)
            write_png16(inside / "range_image.png", z, self.grid)
            organised = ply_points == "organised"
            write_ply(
                inside / "range_image.ply",
                *points[:3],
                self.intensity,
                points.status,
                scalars=self._point_sigmas(),
                organised=organised,
            )
            if self.heights.sigma is not None:
                write_tiff(inside / SIGMA_FILES[0], self.heights.sigma, self.grid, quantity="random sigma of height")
            if self.errors is not None and self.errors.map_systematic is not None:
                write_tiff(
                    inside / SIGMA_FILES[1],
                    self.errors.map_systematic,
                    self.grid,
                    quantity="systematic sigma of height",
                )
            for each, name in names.items():
                SURFACE_WRITERS[each][1](inside / name, z, self.grid)
            write_npz(inside / "range_image.npz", *self._arrays())
            # One colour scale: the two pictures show the same heights.
            span = height_span(to_numpy(points.z).astype(np.float64))
            draw_height_map(inside / "picture.png", self.heights, self.grid, title=self._title(), span=span)
            upright = isinstance(self.sensor.readout, LineReadout) and self.sensor.readout.along == "rows"
            samples: Literal["down", "across"] = "down" if upright else "across"
            draw_scan(inside / "scan.png", points.z, points.status, samples=samples, span=span)
            report = self.report()
            report["seconds"]["write"] = time.perf_counter() - start
            write_text_atomic(inside / "report.json", report_text(report))

    def _title(self) -> str:
        return self.sensor.name or "Height map"

    def _point_sigmas(self) -> dict[str, Array]:
        """Return the standard deviations of points [m] by name: random ``sigma_x``, ``systematic_x``, ``phase_x``."""
        if self.errors is None:
            return {}
        errors = self.errors
        groups = {"sigma": errors.random, "systematic": errors.systematic, "phase": errors.phase}
        known = {name: each for name, each in groups.items() if each is not None}
        return {f"{name}_{axis}": getattr(each, axis) for name, each in known.items() for axis in "xyz"}

    def _arrays(self) -> tuple[dict[str, Array], dict[str, str]]:
        """Return the arrays of ``range_image.npz`` and their units, by name."""
        light = "A" if self.sensor.kind == "psd" else "grey level"
        held: dict[str, tuple[Any, str]] = {
            **{name: (getattr(self.points, name), "m") for name in ("x", "y", "z")},
            "status": (self.points.status, "flags"),
            "intensity": (self.intensity, light),
            "frame": (self.frame_numbers, ""),
            "map_x": (self.grid.x, "m"),
            "map_y": (self.grid.y, "m"),
            "map_z": (self.heights.z, "m"),
            "map_status": (self.heights.status, "flags"),
            "map_intensity": (self.heights.intensity, light),
            **{name: (array, "m") for name, array in self._point_sigmas().items()},
        }
        maps = {
            "map_sigma": self.heights.sigma,
            "map_systematic": None if self.errors is None else self.errors.map_systematic,
            "map_phase": None if self.errors is None else self.errors.map_phase,
        }
        held |= {name: (array, "m") for name, array in maps.items() if array is not None}
        return {name: array for name, (array, _) in held.items()}, {name: unit for name, (_, unit) in held.items()}


def scan_advice(status: npt.NDArray[np.uint8], sensor: Sensor) -> tuple[str, ...]:
    """Return what to try in the sensor file, one sentence for each flag that at least a third of the samples have.

    Parameters
    ----------
    status : numpy.ndarray
        `Status` flags of the samples, (profiles, samples), uint8.
    sensor : Sensor
        Sensor of the scan.
    """
    camera = isinstance(sensor.readout, LineReadout)
    turning = isinstance(sensor.transport, RotatingSheet)
    frequent = {flag for flag in SAMPLE_FLAGS if np.mean((status & flag) != 0) >= 1 / 3}
    sentences = []
    if Status.NO_DATA in frequent:
        sentences.append(
            'many frames are damaged: copy it again, or keep their samples with [recording] damaged = "keep"'
        )
    if Status.NOT_FINITE in frequent:
        sentences.append(
            "many samples have light that is not finite (infinity or NaN): check the program that wrote the recording"
        )
    if Status.LOW_SIGNAL in frequent and isinstance(sensor.readout, LineReadout):
        threshold = "a lower [line] threshold" if sensor.auto_threshold else '[line] threshold = "auto"'
        sentences.append(
            f"many samples are dark at a threshold of {sensor.readout.threshold:g} grey levels: try {threshold}, "
            "[recording] background in ambient light, another [recording] channel, or a longer exposure"
        )
    elif Status.LOW_SIGNAL in frequent and sensor.kind == "focus":
        sentences.append("many pixels have no texture: try a lower [focus] threshold, or project a pattern")
    elif Status.LOW_SIGNAL in frequent:
        sentences.append("many samples are dark: try a lower [psd] minimum_total, or more light")
    if Status.AMBIGUOUS in frequent and camera:
        sentences.append(
            "many samples have several candidates for the line: try [recording] background, which removes ambient "
            "light, or a higher [line] threshold"
        )
    if frequent & {Status.HORIZON, Status.OUT_OF_RANGE}:
        if sensor.kind == "focus":
            return (
                *sentences,
                "many pixels are sharpest outside the stack: check its range, and the limits of [output]",
            )
        step = "the sign of [transport] angle_step and axis_direction" if turning else "the sign of [axes] and baseline"
        sentences.append(f"many samples miss the scene: check {step}, and the limits x, y, z of [output]")
    return tuple(sentences)
