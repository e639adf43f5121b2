"""Readers of the table ``[transport]`` of a sensor file: straight and rotating sheets, steps and encoders."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.encoder_file import read_encoder
from gpuvision.ranging.encoder import EncoderStatistics, not_advancing, unwrapped_counts
from gpuvision.ranging.rotating_sigma import RotatingSheetSigma
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport, Vector
from gpuvision.ranging.triangulation_model import Along
from gpuvision.schema import Section
from gpuvision.sensor.optics import Optics

Transport = StraightTransport | RotatingSheet
_LONGEST_COUNTER = 52  # bits of a count that is exact in a double


@dataclass(frozen=True, kw_only=True)
class Encoder:
    """Transport of each profile as an encoder measured it.

    Attributes
    ----------
    file : Path
        File of the counts.
    scale : float
        Size of a count [m] (straight transport) or [rad] (rotating sheet).
    positions : numpy.ndarray
        Transport of each profile, (profiles,) float64: [m], or the angle [rad] of a rotating sheet.
    """

    file: Path
    scale: float
    positions: npt.NDArray[np.float64] = field(compare=False, repr=False)

    def check_length(self, profiles: int, what: str) -> None:
        """Check that there is one position for each profile of a recording.

        Raises
        ------
        ValueError
            The numbers differ.
        """
        if len(self.positions) != profiles:
            raise ValueError(f"{self.file}: holds {len(self.positions)} positions, {what} has {profiles} profiles")

    def not_advancing(self) -> npt.NDArray[np.bool_]:
        """Return the profiles that do not advance, (profiles,); see `gpuvision.ranging.encoder.not_advancing`."""
        return not_advancing(self.positions)

    def statistics(self) -> EncoderStatistics:
        """Return the regularity of the positions."""
        return EncoderStatistics.from_positions(self.positions)


def read_transport(
    table: Section, optics: Optics, along: Along, *, is_rotating: bool, encoder_file: Path | None = None
) -> tuple[Transport, Encoder | None, RotatingSheetSigma | None]:
    """Read the table ``[transport]``.

    Parameters
    ----------
    table : Section
        The table; its key ``kind`` was read.
    optics : Optics
        Camera, or lens in pixels, for a rotating sheet.
    along : {"columns", "rows"}
        Image axis along which the samples of a profile run.
    is_rotating : bool
        Whether the sheet of light turns.
    encoder_file : Path, optional
        Encoder file of this recording; replaces the file that the table may name.

    Returns
    -------
    StraightTransport or RotatingSheet
        Without a step if an encoder measures the transport.
    Encoder or None
    RotatingSheetSigma or None
        Standard deviations of a rotating sheet, if the file gives them.

    Raises
    ------
    DescriptionError
        A key is missing or unknown, or a value is out of range.
    RecordingError
        The encoder file cannot be read.
    """
    transport: Transport
    sigma = None
    if is_rotating:
        transport, encoder = _rotating(table, optics, along, encoder_file)
        sigma = _rotating_sigma(table.optional_section("sigma"))
    else:
        transport, encoder = _straight(table, encoder_file)
    table.finish()
    return transport, encoder, sigma


def read_vector(table: Section, key: str, unit: str, default: tuple[float, ...] | None = None) -> Vector:
    """Read three numbers; errors as for `Section.number`."""
    x, y, z = table.numbers(key, unit, (3,)) if default is None else table.numbers(key, unit, (3,), default)
    return x, y, z


def _straight(table: Section, encoder_file: Path | None) -> tuple[StraightTransport, Encoder | None]:
    default = StraightTransport()
    start = table.number("start", "m", 0.0)
    encoder = _encoder(table, encoder_file, start, "metres_per_count", "m per count", "step")
    transport = StraightTransport(
        step=None if encoder is not None else table.number("step", "m per profile"),
        start=start,
        jitter=table.number("jitter", "m", 0.0, at_least=0.0),
        g_axis=read_vector(table, "g_axis", "", default.g_axis),
        h_axis=read_vector(table, "h_axis", "", default.h_axis),
        direction=read_vector(table, "direction", "", default.direction),
        origin=read_vector(table, "origin", "m", default.origin),
        covariance=table.rows("covariance", "", 3, None),
    )
    return transport, encoder


def _rotating(
    table: Section, optics: Optics, along: Along, encoder_file: Path | None
) -> tuple[RotatingSheet, Encoder | None]:
    pinhole: dict[str, Any] = {}
    if optics.camera is None:
        pinhole["focal_length_px"] = table.number("focal_length_px", "pixel", above=0.0)
        pinhole["principal_point_px"] = table.numbers("principal_point_px", "pixel", (2,))
    identity = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    first_angle = table.number("first_angle", "rad", at_least=-2 * math.pi, at_most=2 * math.pi)
    encoder = _encoder(table, encoder_file, first_angle, "radians_per_count", "rad per count", "angle_step")
    limits: dict[str, Any] = {"above": -math.pi, "below": math.pi}
    sheet = RotatingSheet(
        along=along,
        lens=optics.lens,
        camera=optics.camera,
        **pinhole,
        axis_point=read_vector(table, "axis_point", "m"),
        axis_direction=read_vector(table, "axis_direction", ""),
        sheet_normal=read_vector(table, "sheet_normal", ""),
        sheet_offset=table.number("sheet_offset", "m", 0.0),
        first_angle=first_angle,
        jitter=table.number("jitter", "rad", 0.0, at_least=0.0),
        angle_step=None if encoder is not None else table.number("angle_step", "rad per profile", **limits),
        scene_axes=table.rows("scene_axes", "", 3, identity),
        scene_origin=read_vector(table, "scene_origin", "m", (0.0, 0.0, 0.0)),
        horizon=table.number("horizon", "", 1e-4, above=0.0, below=1.0),
    )
    return sheet, encoder


def _rotating_sigma(table: Section | None) -> RotatingSheetSigma | None:
    """Read the standard deviations of a rotating sheet, ``[transport.sigma]``; errors as for `Section.number`."""
    if table is None:
        return None
    units = {"focal_length_px": "pixel", "principal_point_px": "pixel", "axis_point": "m", "sheet_offset": "m"}
    units |= {"axis_direction": "rad", "sheet_normal": "rad", "first_angle": "rad", "angle_scale": ""}
    sigma = RotatingSheetSigma(**{name: table.number(name, unit, 0.0, at_least=0.0) for name, unit in units.items()})
    table.finish()
    return sigma


def _encoder(
    table: Section, given: Path | None, start: float, scale_key: str, unit: str, step_key: str
) -> Encoder | None:
    """Read an encoder: its positions are ``start + scale counts``. A given file replaces the table's file or step."""
    key = table.text("encoder_key", None)
    bits = table.integer("encoder_bits", None, at_least=2, at_most=_LONGEST_COUNTER)
    if "encoder" in table and step_key in table:
        raise table.error(f"[{table.name}] has encoder and {step_key} at once, expected one of them")
    file = table.file("encoder") if "encoder" in table else None
    if file is None and given is None:
        table.number(scale_key, unit, None)  # for the recordings that have an encoder file
        return None
    if given is not None:
        table.number(step_key, unit, None)
        file = given
    assert file is not None  # one of them is given
    scale = table.number(scale_key, unit)
    if scale == 0.0:
        raise table.error(f"{table.dotted(scale_key)} is 0, expected the size of a count [{unit}]")
    counts = read_encoder(file, key)
    if bits is not None:
        counts = unwrapped_counts(counts, bits, str(file))
    return Encoder(file=file, scale=scale, positions=start + scale * counts)
