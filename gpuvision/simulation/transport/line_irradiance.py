"""Irradiance of surfaces by lit lines on other surfaces: the closed form, for all pairs, without occlusion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    Launch,
    LaunchBuilder,
    Precision,
    StatusArray,
    Variant,
    ceil_div,
    type_defines,
)
from gpuvision.operation import VisionOperation

# Lanes of a vector and work-items of a work-group (speed only; the kernel's build options).
_LANES, _GROUP = 16, 64
# Strips of receivers: several per core balance the load, and each has enough pairs to outweigh its start.
_STRIPS_PER_CORE, _PAIRS_PER_STRIP = 8, 8192
# In single, frames whose components differ by less than this share one frame. Derived: the rounding of equal directions
# is some 1e-16.
_FRAME_ROUNDING = 1e-13


@dataclass(frozen=True, kw_only=True)
class SegmentLimits:
    """Limits of `LitSegments`.

    Attributes
    ----------
    max_normal_cosine : float
        Largest cosine of the angle between a segment and its normal; the segment must lie in its surface. Chosen: above
        the rounding of inputs in single. Default 1e-5.
    """

    max_normal_cosine: float = 1e-5


_SEGMENT_LIMITS = SegmentLimits()


@dataclass(frozen=True, eq=False)
class LitSegments:
    """Lit line segments on diffuse surfaces; compared by identity.

    Parameters
    ----------
    ends : numpy.ndarray
        (m, 2, 3): start and end [m]. A segment without length emits nothing.
    normals : numpy.ndarray
        (m, 3): normals of the lit surfaces on the side that emits, of any length, perpendicular to the segment.
    exitance : numpy.ndarray
        (m,): power that leaves a metre of the line [W/m], 0 or more: albedo times the power that arrives on it.
    limits : SegmentLimits
        Tolerance of the check of the normals.

    Raises
    ------
    TypeError
        The values are not numbers.
    ValueError
        A shape is wrong; a value is not finite; a normal is zero or leans along its segment; an exitance is negative.
    """

    ends: npt.NDArray[np.float64]
    normals: npt.NDArray[np.float64]
    exitance: npt.NDArray[np.float64]
    limits: SegmentLimits = _SEGMENT_LIMITS

    def __post_init__(self) -> None:
        exitance = _checked(self.exitance, (-1,), "exitance")
        ends = _checked(self.ends, (len(exitance), 2, 3), "ends")
        normals = _checked(self.normals, (len(exitance), 3), "normals")
        _refuse(exitance < 0.0, "has a negative exitance, expected power per length")
        _refuse(~normals.any(axis=1), "has no normal, expected the side on which it emits")
        normals = _unit(normals)
        along = _unit(ends[:, 1] - ends[:, 0])
        lean = np.sum(normals * along, axis=1, keepdims=True)
        _refuse(
            np.abs(lean[:, 0]) > self.limits.max_normal_cosine, "does not lie in its surface: its normal leans along it"
        )
        object.__setattr__(self, "exitance", exitance)
        object.__setattr__(self, "ends", ends)
        object.__setattr__(self, "normals", _unit(normals - lean * along))
        for array in (self.exitance, self.ends, self.normals):
            array.flags.writeable = False

    def tables(self, real: np.dtype[Any]) -> tuple[npt.NDArray[Any], ...]:
        """Return the tables of the emitters in the order of ``kernels/line_irradiance/line_irradiance.cl``.

        Tables of positions have float64.
        """
        across = self.ends[:, 1] - self.ends[:, 0]
        length = np.linalg.norm(across, axis=1)
        emits = np.flatnonzero((length > 0.0) & (self.exitance > 0.0))
        if not len(emits):
            # OpenCL has no buffers of size 0.
            shapes = (3,), (1, 12), (1, 9), (2,), (1, 4), (1, 3)
            types = np.float64, np.float64, real, np.uint32, np.float64, real
            return tuple(np.zeros(shape, dtype) for shape, dtype in zip(shapes, types, strict=True))
        along, normals = _unit(across[emits]), self.normals[emits]
        frames = np.stack([along, normals, np.cross(along, normals)], axis=1)
        # In single, frames that differ by rounding share one frame.
        key = frames.reshape(-1, 9) if real == np.float64 else np.rint(frames.reshape(-1, 9) / _FRAME_ROUNDING)
        _, group, members = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        # The kernel takes the segments that are alone in their frame first.
        order = np.lexsort((group, members[group] > 1))
        emits, frames, group = emits[order], frames[order], group[order]
        firsts = np.flatnonzero(np.diff(group, prepend=-1))
        segments = np.diff(firsts, append=len(emits))
        # The origin of a frame is the start of its first segment; the first axis is reversed, so that lengths along the
        # segment count from the receiver.
        frames = frames[firsts] * [[[-1.0], [1.0], [1.0]]]
        begin = self.ends[emits, 0]
        middle = begin.mean(axis=0)
        rows = np.dstack([frames, _inside(frames, middle - begin[firsts])])
        shifts = _inside(np.repeat(frames, segments, axis=0), np.repeat(begin[firsts], segments, axis=0) - begin)
        return (
            middle,
            rows.reshape(-1, 12),
            -frames.reshape(-1, 9).astype(real),
            np.append(firsts, len(emits)).astype(np.uint32),
            np.column_stack([shifts, length[emits]]),
            np.column_stack([length[emits], length[emits] ** 2, self.exitance[emits] / math.tau]).astype(real),
        )


class Irradiance(NamedTuple):
    """Irradiance of receivers.

    Attributes
    ----------
    irradiance
        float (...,): irradiance [W/m^2]; NaN where the status is not OK.
    status
        uint8 `Status` flags, (...,): NOT_FINITE (a component of the receiver is not finite, or its normal is zero).
    """

    irradiance: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class LineIrradiance(VisionOperation[Irradiance]):
    """Diffuse irradiance by lit segments: ``op(receivers) -> Irradiance``, receivers float32 or float64 (..., 6).

    A receiver is a position [m] and a normal of any length, in the frame of the segments. Parts of a segment behind the
    receiver's plane do not count, nor does a segment whose emitting side faces away. Occlusion is not computed.

    Parameters
    ----------
    segments : LitSegments
        The emitters.
    precision : {None, "single", "double"}
        Precision of arithmetic and outputs; None follows the input. "single" takes float64 receivers too: positions are
        subtracted in double before they are rounded, so they keep their digits near a line and far from the origin.
    variant : {"auto", "vector", "work_item"}
        "vector" (16-wide vectors, for CPU runtimes), "work_item" (a work-item per receiver, for GPUs), or "auto".

    Raises
    ------
    TypeError
        ``segments`` is not a `LitSegments`.

    Notes
    -----
    The closed form of a differential receiver and a line in a diffuse surface, in a form without cancellation
    (kernels/line_irradiance/line_irradiance.h): one form serves near, far and end-on receivers. Let E0 = M h / pi times
    the integral of dt / r^3, the irradiance if the whole segment were on the receiver's normal; E <= E0. The error per
    segment is below 2e-6 E0 in single and 1e-14 (1 + D / h) E0 in double, at any distance: h is the receiver's height
    above the lit surface, D the distance of the segment's far end or of the middle of all segments. So the error is
    relative except where the segment is at a grazing angle to the receiver. On a device without doubles, or with
    doubles at 1/32 of the float rate or less, positions are two floats (kernels/common/two_float.h), which adds
    2^-42 (1 + D / h) E0 to the error. The tests hold these limits at random and extreme configurations.

    Receivers are transformed once into a frame for all segments of one direction on surfaces of one normal, as on flat
    faces. In single, directions that differ by 1e-13 share a frame, which adds up to 1e-13 D / h.

    A receiver in the plane of a lit surface, or on the segment, gets no light from it.

    References
    ----------
    M. F. Cohen and J. R. Wallace, *Radiosity and Realistic Image Synthesis*, Academic Press 1993, chapter 4: form
    factors of differential receivers, here integrated over a line.
    """

    Result: ClassVar[type[Any]] = Irradiance

    segments: LitSegments
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        if not isinstance(self.segments, LitSegments):
            raise TypeError(f"LineIrradiance.segments is {type(self.segments).__name__}, expected LitSegments")

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, narrows=True, variant=self.variant)
        build.check_dtype("float32", "float64", of="receivers")
        build.check_shape(shape[-1:] == (6,), "receivers (..., 6), place and normal")
        middle, rows, axes, firsts, starts, lines = self.segments.tables(build.real)
        count = math.prod(shape[:-1])
        share = build.share(count, per_core=_STRIPS_PER_CORE, multiple=_LANES)
        # With fewer receivers the start of a work-item would cost more time than it saves.
        least = ceil_div(_PAIRS_PER_STRIP, max(int(firsts[-1]), 1) * _LANES) * _LANES
        work = build.work(count, each=max(share, least), group=_GROUP, least=_LANES, grouping="fitted")
        return build.launch(
            "line_irradiance/line_irradiance.cl",
            "line_irradiance",
            work=work,
            outputs=build.outputs({"irradiance": shape[:-1], "status": shape[:-1]}),
            defines={**type_defines("INPUT", dtype), **build.position_defines},
            arguments=[
                *map(build.positions, (middle, rows)),
                axes,
                firsts,
                build.positions(starts),
                lines,
                np.uint32(np.count_nonzero(np.diff(firsts) == 1)),
                np.uint32(len(firsts) - 1),
                np.uint64(count),
                np.uint64(work.each),
            ],
        )


def _checked(values: Any, shape: tuple[int, ...], what: str) -> npt.NDArray[np.float64]:
    """Return a copy of values as float64 of a shape, where -1 stands for any length."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"LitSegments.{what} must be numbers, got {values!r}") from None
    if array.ndim != len(shape) or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True)):
        expected = "(m,)" if shape == (-1,) else str(shape)
        raise ValueError(f"LitSegments.{what} has shape {array.shape}, expected {expected}")
    finite = np.isfinite(array.reshape(len(array), -1)).all(axis=1) if len(array) else np.ones(0, bool)
    _refuse(~finite, f"has {what} that are not finite")
    return array


def _refuse(wrong: Any, what: str) -> None:
    if wrong.any():
        raise ValueError(f"LitSegments: segment {int(np.argmax(wrong))} {what}")


def _inside(frames: npt.NDArray[np.float64], vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return vectors in the coordinates of frames, one frame per vector."""
    inside: npt.NDArray[np.float64] = np.einsum("nij,nj->ni", frames, vectors)
    return inside


def _unit(vectors: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return vectors scaled to length 1 without overflow or underflow; zero vectors stay zero."""
    largest = np.abs(vectors).max(axis=1, keepdims=True, initial=0.0)
    scaled = vectors / np.where(largest > 0.0, largest, 1.0)
    length = np.linalg.norm(scaled, axis=1, keepdims=True)
    unit: npt.NDArray[np.float64] = scaled / np.where(length > 0.0, length, 1.0)
    return unit
