"""Sensor description files: a TOML file describes the readout, the triangulation and the transport of a sensor.

Tables of the file (the files in ``gpuvision/presets/sensors`` are commented examples):

====================  ==================================================================================================
``kind``, ``name``    ``"camera"``, ``"psd"`` or ``"focus"``; a name for the report
``[recording]``       see `Recording`
``[line]``            camera: fields of `LineReadout`
``[psd]``             PSD: number of strips, fields of `PsdReadout`; ``[psd.noise]``: fields of `PsdNoise`, where the
                      default of ``background`` is the photocurrent of the ambient light in ``[light]``
``[frame]``           camera: columns and rows of a frame; needed for a triangulation
``[axes]``            map from positions and samples to the coordinates of the triangulation, see `SampleAxes`
``[lens]``            radial distortion in sensor coordinates, see `Lens`; or ``file``, a lens that ``gpuvision
                      calibrate`` wrote, with ``window``, the column and row of a frame's first pixel in the
                      calibrated images
``[camera]``          calibrated camera: ``matrix`` and OpenCV's coefficients ``k1`` ... ``tauY`` as in the file of
                      ``gpuvision calibrate``, or ``file``, such a file; ``window`` as for a lens. Excludes ``[lens]``
                      and ``[axes]``
``[triangulation]``   sensor to sheet, for a straight transport: ``baseline``, ``stand_off`` and so on (see
                      `Triangulation.from_stand_off`); or the sheet in the frame of a camera, ``sheet_origin``,
                      ``g_axis``, ``h_axis`` and, if it is bent, ``bend`` (see `BentSheet`), with a table ``[camera]``,
                      or without it with ``focal_length_px`` and ``principal_point_px``; or ``homography``; or
                      ``constants`` (`Triangulation.from_constants`); or ``points``: calibration points (u, v, G, H) to
                      fit; or ``p`` and ``q`` of a `PlanePolynomial` from (v, u). ``covariance``: see `Triangulation`
``[transport]``       ``kind = "straight"``, fields of `StraightTransport`; or ``"rotating"``, of `RotatingSheet`, and
                      ``[transport.sigma]``, fields of `RotatingSheetSigma`;
                      with an encoder ``encoder``, a file with a count for each profile, and ``metres_per_count`` or
                      ``radians_per_count`` instead of a step
``[polygon]``         a point sensor behind a polygon mirror: fields of `PolygonMirror`, ``first_rotation``,
                      ``rotation_step``, ``moving``; the strips of a PSD are then the samples of a sweep
``[focus]``           depth from focus: fields of `FocusStack` and `LensFocus`, or ``stage_start``, ``stage_step`` and
                      ``pixel_size``; the file then has no readout and no transport
``[output]``          see `Output`
``[light]``           light source and electronics, for a simulation: see `gpuvision.sensor.light_source`
====================  ==================================================================================================
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from gpuvision.host.channels import CHANNELS, Channel
from gpuvision.ranging.focus_stack import FocusStack
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.polygon_scan import PolygonScan
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import Limits
from gpuvision.ranging.rotating_sigma import RotatingSheetSigma
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation_model import Along
from gpuvision.schema import DescriptionError, Section, preset_names, read_preset
from gpuvision.sensor.focus import FOCUS_PLACE, read_focus
from gpuvision.sensor.light_source import Light, read_light
from gpuvision.sensor.optics import read_optics
from gpuvision.sensor.polygon import read_polygon
from gpuvision.sensor.readouts import read_axes, read_line_readout, read_psd_readout
from gpuvision.sensor.sheet import read_triangulation
from gpuvision.sensor.transports import Encoder, Transport, read_transport

Background = Literal["none", "median", "previous", "dark_after", "dark_before"]
BACKGROUNDS: tuple[Background, ...] = get_args(Background)
Damaged = Literal["drop", "keep"]
_NOISE_KEYS = ("read_noise", "gain", "speckle")
Folded = Literal["drop", "top"]
Ambiguous = Literal["drop", "keep"]


@dataclass(frozen=True, kw_only=True)
class Recording:
    """Properties of the recordings of a sensor.

    Attributes
    ----------
    channel
        Channel of colour frames that holds the laser line, default ``"grey"``.
    key
        Name of the array in an NPZ file, if the file holds more than one.
    rate
        Frame rate of the sensor [frames/s]; a scan reports its measured rate relative to it.
    background
        Ambient light to subtract from the frames of a camera, default ``"none"``:

        - ``"median"``: the median of each pixel over the recording; for a line that moves through the image.
        - ``"previous"``: the previous frame; for a line that moves by more than its width from frame to frame.
        - ``"dark_after"``, ``"dark_before"``: after, or before, each frame with light comes a frame without light. A
          pair of frames gives one profile.
        - a path: an image without the light.
    damaged
        Whether the samples of a damaged frame of a video keep their points (``"keep"``) or are NO_DATA (``"drop"``, the
        default).
    """

    channel: Channel = "grey"
    key: str | None = None
    rate: float | None = None
    background: Background | Path = "none"
    damaged: Damaged = "drop"


@dataclass(frozen=True, kw_only=True)
class Output:
    """Height map of a scan: cell size, limits between neighbours, limits of the scene; all in metres.

    Attributes
    ----------
    cell
        Distance between cells [m].
    max_gap, max_step, fold_tolerance, folded
        As for `gpuvision.ranging.regrid.Regrid`.
    ambiguous
        Whether a sample with the flag AMBIGUOUS (several candidates for the light) keeps its point.
    limits
        Lowest and highest x, y and z of the scene [m]; points outside are OUT_OF_RANGE.
    """

    cell: float
    max_gap: float
    max_step: float
    fold_tolerance: float = 0.0
    folded: Folded = "drop"
    ambiguous: Ambiguous = "drop"
    limits: Limits = ((-math.inf, math.inf),) * 3


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """Sensor: its readout (with the triangulation in the same pass), its transport, and the output of a scan.

    Attributes
    ----------
    name
        Name for reports.
    readout
        `LineReadout` for a camera, `PsdReadout` for a PSD, `FocusStack` for depth from focus.
    transport
        `StraightTransport` for a readout with a triangulation, or a `RotatingSheet`, which includes the triangulation.
        For depth from focus: the directions of columns, height and rows.
    frame
        Shape of a frame if the file gives it: (rows, columns), or (strips, 2).
    recording, output
        See `Recording` and `Output`.
    auto_threshold
        Whether a scan estimates the threshold of the readout from the recording (``threshold = "auto"``). Default
        False.
    light
        Light source and electronics for a simulation, if the file has them.
    encoder
        Transport of each profile, if an encoder measured it.
    polygon
        Polygon mirror through which a point sensor looks. A frame is then a sweep of one facet, and its strips are
        the samples of the sweep.
    noise_known
        Whether the file gives the noise of the readout, so that a scan predicts its errors: ``read_noise``, ``gain`` or
        ``speckle`` of a camera, ``[psd.noise]`` of a PSD, ``read_noise`` of a focus stack. Default False.
    rotating_sigma
        Standard deviations of the calibration of a rotating sheet, if the file has them (``[transport.sigma]``).
    files
        The sensor file, and the files that it names: background image, camera or lens, encoder. No command replaces one
        of them.
    """

    name: str
    readout: LineReadout | PsdReadout | FocusStack
    transport: Transport
    output: Output
    recording: Recording = Recording()
    frame: tuple[int, int] | None = None
    auto_threshold: bool = False
    light: Light | None = None
    encoder: Encoder | None = None
    polygon: PolygonScan | None = None
    noise_known: bool = False
    rotating_sigma: RotatingSheetSigma | None = None
    files: tuple[Path, ...] = field(default=(), compare=False)

    @classmethod
    def load(cls, path: str | Path, *, encoder: str | Path | None = None) -> Sensor:
        """Read a sensor from a TOML file, or a sensor of the package by its name (``"corner_scene"``).

        Parameters
        ----------
        path : str or Path
            File, or name of a sensor of the package.
        encoder : str or Path, optional
            Encoder file of one recording. It replaces ``[transport] encoder`` or the step; the file gives the size of a
            count. A relative name refers to the current folder.

        Raises
        ------
        FileNotFoundError
            There is no file and no sensor of the package with this name.
        DescriptionError
            A key is missing or unknown, or a value is out of range; the message has key, value, unit and range.
        """
        read = cls.from_section(read_preset(path, "sensors", "sensor"), encoder=encoder)
        return read if str(path) in preset_names("sensors") else replace(read, files=(Path(path), *read.files))

    @classmethod
    def from_section(cls, top: Section, *, encoder: str | Path | None = None) -> Sensor:
        """Read a sensor from an opened description; `encoder` as for `load`.

        Raises
        ------
        DescriptionError
            See `load`.
        """
        try:
            sensor = cls._read(top, None if encoder is None else Path(encoder))
        except DescriptionError:
            raise
        except (TypeError, ValueError, OverflowError) as error:
            raise top.error(str(error)) from error
        return sensor

    @classmethod
    def _read(cls, top: Section, encoder_file: Path | None) -> Sensor:
        kind = top.choice("kind", ("camera", "psd", "focus"))
        name = top.text("name", "")
        recording = _recording(kind, top.optional_section("recording"))
        if kind == "focus":
            if encoder_file is not None:
                raise top.error("a focus stack has no transport; an encoder file has no effect on it")
            return cls._read_focus(top, name, recording)
        return cls._read_sheet_of_light(top, kind, name, recording, encoder_file)

    @classmethod
    def _read_sheet_of_light(
        cls, top: Section, kind: str, name: str, recording: Recording, encoder_file: Path | None
    ) -> Sensor:
        """Read a camera or PSD strips that view a sheet of light."""
        readout = top.section("line" if kind == "camera" else "psd")
        along: Along = readout.choice("along", ("columns", "rows"), "columns") if kind == "camera" else "columns"
        frame = _frame(top) if kind == "camera" else (readout.integer("strips", 1, at_least=1), 2)
        moving = top.section("transport")
        sheet = None
        # A PSD does not measure the place of the light in the plane of the beam: it cannot see a rotating sheet.
        is_rotating = (
            moving.choice("kind", ("straight", "rotating") if kind == "camera" else ("straight",)) == "rotating"
        )
        axes = SampleAxes() if is_rotating else read_axes(top.optional_section("axes"))
        optics = read_optics(top, kind, frame, along, axes)
        transport, encoder, rotating_sigma = read_transport(
            moving, optics, along, is_rotating=is_rotating, encoder_file=encoder_file
        )
        if not is_rotating:
            region = _region(kind, top, frame, along, axes, readout)
            sheet, bend = read_triangulation(top.section("triangulation"), optics, region, along)
            assert isinstance(transport, StraightTransport)  # it is not rotating
            transport = replace(transport, bend=bend)
        polygon = None
        if kind == "psd":
            assert frame is not None  # a PSD has strips
            polygon = read_polygon(top.optional_section("polygon"), frame[0], sheet)
        output = _output(top.section("output"))
        light = _light(top, transport)
        noise_known = "noise" in readout if kind == "psd" else any(key in readout for key in _NOISE_KEYS)
        top.finish()
        return cls(
            name=name,
            readout=read_line_readout(readout, along, sheet, axes)
            if kind == "camera"
            else read_psd_readout(readout, sheet, axes, light),
            transport=transport,
            output=output,
            recording=recording,
            frame=frame,
            auto_threshold=kind == "camera" and readout.word("threshold", ("auto",)) is not None,
            light=light,
            encoder=encoder,
            polygon=polygon,
            noise_known=noise_known,
            rotating_sigma=rotating_sigma,
            files=top.files if encoder_file is None else (*top.files, encoder_file),
        )

    @classmethod
    def _read_focus(cls, top: Section, name: str, recording: Recording) -> Sensor:
        stack = read_focus(top.section("focus"))
        frame = _frame(top)
        output = _output(top.section("output"))
        top.finish()
        return cls(
            name=name,
            readout=stack,
            transport=FOCUS_PLACE,
            output=output,
            recording=recording,
            frame=frame,
            noise_known=stack.read_noise is not None,
            files=top.files,
        )

    @property
    def kind(self) -> Literal["camera", "psd", "focus"]:
        """Kind of the sensor: ``"camera"``, ``"psd"`` or ``"focus"``."""
        if isinstance(self.readout, FocusStack):
            return "focus"
        return "camera" if isinstance(self.readout, LineReadout) else "psd"

    def transports(self, profiles: int) -> npt.NDArray[np.float64]:
        """Return the transport of the first profiles of a recording, (profiles,): [m], or the angle [rad] of the sheet.

        Raises
        ------
        ValueError
            The encoder has fewer positions.
        """
        if self.encoder is None:
            return self.transport.transport(profiles)
        if profiles > len(self.encoder.positions):
            self.encoder.check_length(profiles, "the recording")
        return self.encoder.positions[:profiles]

    def check_frame(self, shape: tuple[int, ...], what: str) -> None:
        """Check that the frames of a recording have the shape of this sensor's frames.

        Raises
        ------
        ValueError
            The shape differs.
        """
        words = "(strips, 2)" if self.kind == "psd" else "(rows, columns)"
        if len(shape) != 2 or shape != (self.frame or shape):
            expected = words if self.frame is None else f"{words} = {self.frame}"
            raise ValueError(f"{what}: frames have shape {shape}, the sensor file expects {expected}")


def _recording(kind: str, table: Section | None) -> Recording:
    if table is None:
        return Recording()
    channel = table.choice("channel", CHANNELS, "grey")
    rate = table.number("rate", "frames/s", None, above=0.0)
    key = table.text("key", None)
    background: Background | Path = "none"
    if kind == "camera" and "background" in table:
        background = table.word("background", BACKGROUNDS) or table.file("background")
    damaged = table.choice("damaged", get_args(Damaged), "drop")
    table.finish()
    return Recording(channel=channel, key=key, rate=rate, background=background, damaged=damaged)


def _frame(top: Section) -> tuple[int, int] | None:
    table = top.optional_section("frame")
    if table is None:
        return None
    columns, rows = table.integer("columns", at_least=1), table.integer("rows", at_least=1)
    table.finish()
    return rows, columns


def _region(
    kind: str, top: Section, frame: tuple[int, int] | None, along: Along, axes: SampleAxes, readout: Section
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the region of the sensor in u and v: the positions on a strip or the pixels of a frame."""
    if frame is None:
        raise top.error("the table [frame] with columns and rows [pixel] is missing; a triangulation needs it")
    if kind == "psd":
        half = 0.5 * readout.number("strip_length", "m", above=0.0)
        positions, samples = (-half, half), frame[0]
    else:
        length, samples = frame if along == "columns" else frame[::-1]
        positions = (0.0, length - 1.0)
    u = sorted(axes.position_origin + axes.position_pitch * each for each in positions)
    v = sorted(axes.sample_origin + axes.sample_pitch * each for each in (0.0, samples - 1.0))
    return (u[0], u[1]), (v[0], v[1])


def _light(top: Section, transport: Transport) -> Light | None:
    table = top.optional_section("light")
    if table is None:
        return None
    light = read_light(table)
    if light.lens is not None or not isinstance(transport, StraightTransport):
        return light
    setup = top.section("triangulation")
    if "sheet_origin" in setup:
        place = _pinhole(setup, transport)
    elif "baseline" in setup:
        up = np.array(transport.h_axis) / np.linalg.norm(transport.h_axis)
        sheet_normal = np.cross(transport.g_axis, transport.h_axis)
        sheet_normal *= np.sign(sheet_normal @ np.array(transport.direction)) / np.linalg.norm(sheet_normal)
        beside = np.array(transport.origin) + setup.number("baseline", "m") * sheet_normal
        place = beside + setup.number("stand_off", "m") * up
    else:
        return light
    return replace(light, lens=(float(place[0]), float(place[1]), float(place[2])))


def _pinhole(setup: Section, transport: StraightTransport) -> npt.NDArray[np.float64]:
    """Return the pinhole of a camera in the scene at transport 0 [m], from the sheet in the camera's frame."""
    origin, g_axis, h_axis = (np.array(setup.numbers(key, "", (3,))) for key in ("sheet_origin", "g_axis", "h_axis"))
    of_camera = np.stack([g_axis, h_axis, np.cross(g_axis, h_axis)])
    of_scene = np.array([transport.g_axis, transport.h_axis, np.cross(transport.g_axis, transport.h_axis)])
    return np.asarray(np.array(transport.origin) - (of_camera @ origin) @ of_scene)


def _output(table: Section) -> Output:
    cell = table.number("cell", "m", above=0.0)
    x, y, z = (_limits(table, name) for name in "xyz")
    output = Output(
        cell=cell,
        max_gap=table.number("max_gap", "m", 3.0 * cell, at_least=cell),
        max_step=table.number("max_step", "m", math.inf, above=0.0),
        fold_tolerance=table.number("fold_tolerance", "m", 0.0, at_least=0.0),
        folded=table.choice("folded", ("drop", "top"), "drop"),
        ambiguous=table.choice("ambiguous", ("drop", "keep"), "drop"),
        limits=(x, y, z),
    )
    table.finish()
    return output


def _limits(table: Section, key: str) -> tuple[float, float]:
    low, high = table.numbers(key, "m", (2,), (-math.inf, math.inf))
    if not low < high:
        raise table.error(f"{table.dotted(key)} is [{low}, {high}], expected the lowest below the highest [m]")
    return low, high
