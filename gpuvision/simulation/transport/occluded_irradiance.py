"""Light of lit segments on receivers, as far as they see each other."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Precision, Variant, real_defines, real_of, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.validation import integer

Spec = tuple[tuple[int, ...], np.dtype[Any]]
Visibility = Literal["intervals", "rays", "none"]

PICK_BLOCK = 16
"""Receivers of a strip that share a list of picked segments."""

_GROUP = 64
# Of work for a CPU: enough that none waits for another, few, as each looks for lines among the segments anew.
_SHARES_PER_CORE = 8
# Small scenes share a build.
_LEAST_DEPTH = 4
# Of the scene's size: within this of a surface rounding, the caller's too, decides what lies before it.
_CLEARANCE = {4: 4e-6, 8: 1e-12}


class ReceivedLight(NamedTuple):
    """Light that strips' receivers get.

    Attributes
    ----------
    irradiance
        (strips, n), W/m^2; NaN where the status says so.
    left, right
        (strips,): sums of irradiance times weight; NaN if one of the irradiances is that is to be added.
    status
        uint8 `Status` flags, (strips, n): NO_DATA (no receiver: its normal is zero; adds nothing), NOT_FINITE (a number
        of the receiver, or of any segment that it was to see, is not), OUT_OF_RANGE (a pick is no segment, or stands
        beyond the list's end), AMBIGUOUS (too many things hide parts of one segment: light is missing or too much by
        less than 1e-4 of that segment's; with a value).
    """

    irradiance: Any
    left: Any
    right: Any
    status: Any


@dataclass(frozen=True, kw_only=True)
class OccludedIrradiance(VisionOperation[ReceivedLight]):
    """Diffuse light of lit segments on strips of receivers: ``op(receivers, weights, segments) -> ReceivedLight``.

    All inputs are float32 or float64, alike, and change from call to call: one bound instance serves all profiles.

    receivers (strips, n, 6)
        Place in metres, normal of any length; a normal of zero: no receiver.
    weights (strips, n, 2)
        What a unit of irradiance adds to `left` and `right`.
    segments (segments, 10)
        Start, end, normal of the lit surface on the side that emits, exitance in W/m (`segment_rows`). An exitance of
        zero or less: no segment.
    starts (strips * ceil(n / 16) + 1,), picks (picks,), int32
        With ``picks`` only: `starts` says where in `picks` the segments of each block of 16 receivers begin, block by
        block and strip by strip, the end of the last one behind them; a pick is a segment's number, or ~number for one
        that is taken without looking whether anything is in the way.

    Parameters
    ----------
    scene
        What may lie between; both sides of a triangle hide. In the frame of receivers and segments.
    segments
        Rows of `segments`.
    picks
        Room in `picks`; None: every receiver gets light from all segments.
    visibility
        "intervals" (exact: what each triangle hides of a segment is projected on it from the receiver, in one walk
        through the tree), "rays" (shadow rays to the middles of ``samples`` parts of each segment: an independent,
        slower way, of first order in the length of a part), "none" (nothing hides).
    samples
        Parts of a segment for "rays".
    clearance
        Metres: what is less high above the lit surface, or above the receiver's own plane, hides nothing: the surfaces
        on which both lie, as far as they are flat. None: 4e-6 of the scene's reach from the origin where places are in
        single, 1e-12 in double; with less than that, surfaces may hide what lies on them. So a scene of metres with
        details of micrometres wants double.
    precision
        Of the arithmetic and the outputs; None follows the input. "single" takes float64 places, too: they are
        subtracted before they are rounded.
    variant
        "vector" (a work-item for some strips, 16 boxes at once, for CPU runtimes), "work_item" (a work-group per strip,
        an item per receiver, for GPUs), or "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here.

    Notes
    -----
    Light of the visible parts by the closed form, with the errors of `LineIrradiance`. An edge of a shadow is right to
    some roundings of places (relative to the scene's size, 1e-7 or 2e-16) seen from the receiver over the edge's
    distance from it: it moves along a segment by e D / d, if the place of an edge at distance d is off by e and the
    segment is D away.
    """

    Result: ClassVar[type[Any]] = ReceivedLight

    scene: Scene
    segments: int
    picks: int | None = None
    visibility: Visibility = "intervals"
    samples: int = 64
    clearance: float | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        _check_scene(self.scene, self.clearance)
        for name in ("segments", "samples", "picks"):
            if name != "picks" or self.picks is not None:
                integer(getattr(self, name), f"OccludedIrradiance.{name}", minimum=1, maximum=2**31 - 1)
        if self.visibility not in ("intervals", "rays", "none"):
            raise ValueError(
                f"OccludedIrradiance.visibility is {self.visibility!r}, expected 'intervals', 'rays' or 'none'"
            )

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if len(shape) != 3 or shape[-1] != 6 or not shape[1]:
            raise ValueError(f"OccludedIrradiance takes receivers (strips, n, 6), n at least 1, got shape {shape}")
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"OccludedIrradiance takes float32 or float64, got {dtype}")
        if dtype == np.float64 and not device.has_double:
            raise ValueError(f"device {device.label} has no double precision; give float32")
        real = real_of(self.precision, dtype, narrows=True)
        strips, each = shape[:2]
        strip, place, tree = uses_vectors(self.variant, device), _place(device), self.scene.bvh
        shares = min(strips, _SHARES_PER_CORE * device.handle.max_compute_units)
        present = {
            "VECTOR_VARIANT": strip,
            "WIDE_PLACES": device.has_double,
            "INTERVALS": self.visibility == "intervals",
            "RAYS": self.visibility == "rays",
            "PICKED": self.picks is not None,
        }
        inputs: list[Spec] = [(shape, dtype), ((strips, each, 2), dtype), ((self.segments, 10), dtype)]
        if self.picks is not None:
            integers = np.dtype(np.int32)
            inputs += [((strips * -(-each // PICK_BLOCK) + 1,), integers), ((self.picks,), integers)]
        return Launch(
            source="occluded_irradiance/occluded_irradiance.cl",
            kernel="occluded_irradiance",
            defines={
                **real_defines(device, real),
                **{name: None for name, is_present in present.items() if is_present},
                "INPUT": "float" if dtype == np.float32 else "double",
                "BVH_DEPTH": max(tree.depth, _LEAST_DEPTH),
                **({} if strip else {"GROUP": _GROUP}),
            },
            inputs=inputs,
            outputs={
                "irradiance": ((strips, each), real),
                "left": ((strips,), real),
                "right": ((strips,), real),
                "status": ((strips, each), np.dtype(np.uint8)),
            },
            arguments=[
                *tree.tables(real),
                tree.middle.astype(place),
                _clearance(self.clearance, self.scene, real, dtype),
                np.uint32(self.samples),
                np.uint32(each),
                np.uint32(self.segments),
                np.uint32(self.picks or 0),
                np.uint32(strips),
            ],
            global_size=(shares if strip else strips * _GROUP,),
            local_size=(1 if strip else _GROUP,),
        )


def segment_rows(segments: LitSegments, room: int | None = None) -> npt.NDArray[np.float64]:
    """Return segments as `OccludedIrradiance` takes them, (room, 10); rows of no exitance behind them.

    Parameters
    ----------
    segments
        What is lit.
    room
        How many rows; None: as many as there are segments.

    Raises
    ------
    ValueError
        There are more segments than that.
    """
    count = len(segments.exitance)
    rows = np.zeros((count if room is None else room, 10))
    if count > len(rows):
        raise ValueError(f"{count} segments do not fit into {len(rows)} rows")
    rows[:count] = np.column_stack([segments.ends.reshape(count, 6), segments.normals, segments.exitance])
    return rows


def _check_scene(scene: object, clearance: float | None) -> None:
    if not isinstance(scene, Scene):
        raise TypeError(f"OccludedIrradiance.scene is {scene!r}, expected a Scene")
    if clearance is not None and not (math.isfinite(clearance) and clearance >= 0.0):
        raise ValueError(f"OccludedIrradiance.clearance is {clearance!r}, expected metres, 0 or more, or None")


def _place(device: Device) -> np.dtype[Any]:
    return np.dtype(np.float64 if device.has_double else np.float32)


def _clearance(given: float | None, scene: Scene, real: np.dtype[Any], dtype: np.dtype[Any]) -> Any:
    if given is None:
        reach = float(np.abs(scene.bvh.corners).max(initial=0.0) + np.abs(scene.bvh.middle).max())
        given = _CLEARANCE[min(real.itemsize, dtype.itemsize)] * reach
    return real.type(given)
