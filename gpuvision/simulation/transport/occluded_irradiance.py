"""Diffuse irradiance of receivers by lit segments with occlusion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, NamedTuple

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
    WorkSize,
    ceil_div,
    flags,
    group_per_element,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.simulation.scene.bvh import Bvh
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.validation import integer

Spec = tuple[tuple[int, ...], np.dtype[Any]]
Visibility = Literal["intervals", "rays", "none"]

SELECTION_BLOCK = 16
"""Receivers of a strip that share a list of selected segments."""

_GROUP = 64  # work-items of a work-group (speed only)
# Parts of the work per CPU core: enough to balance the load, but few, because each part groups the segments into lines
# again.
_SHARES_PER_CORE = 8
# Default clearance in parts of the scene's reach, by bytes of the type: below it, the rounding of positions (including
# the caller's) decides on which side of a surface a point lies.
_CLEARANCE = {4: 4e-6, 8: 1e-12}


class StripIrradiance(NamedTuple):
    """Irradiance of the receivers of strips.

    Attributes
    ----------
    irradiance
        float (strips, n): irradiance [W/m^2]; NaN where the status says so.
    left, right
        float (strips,): sums of irradiance times the first and the second weight (currents of a PSD's two electrodes,
        for example); NaN where an irradiance that is to be added is NaN.
    status
        uint8 `Status` flags, (strips, n): NO_DATA (no receiver: its normal is zero; adds nothing), NOT_FINITE (a
        component of the receiver, or of a segment that is not left out for it, is not finite), OUT_OF_RANGE (a selected
        index is no segment, or a list reaches beyond the input's end), AMBIGUOUS (too many triangles occlude parts of
        one segment: the light is wrong by less than 1e-4 of that segment's; the value is given).
    """

    irradiance: FloatArray
    left: FloatArray
    right: FloatArray
    status: StatusArray


@dataclass(frozen=True, kw_only=True)
class OccludedIrradiance(VisionOperation[StripIrradiance]):
    """Diffuse irradiance by lit segments with occlusion: ``op(receivers, weights, segments) -> StripIrradiance``.

    All real inputs are float32 or float64, of one type. They change from call to call: one bound instance serves all
    profiles.

    receivers (strips, n, 6)
        Position [m] and normal of any length; a normal of zero marks an entry without receiver.
    weights (strips, n, 2)
        Contributions of 1 W/m^2 to `left` and `right`.
    segments (segments, 10)
        Start, end [m], normal of the lit surface on the side that emits, exitance [W/m] (`segment_rows`). A row with an
        exitance of 0 or less is no segment.
    starts (strips * ceil(n / 16) + 1,), selected (selected,), int32
        Only with ``selected``: lists of segments for each block of 16 receivers, block by block and strip by strip.
        `starts` holds the index into `selected` at which each list begins, and the end of the last. An entry is a
        segment's index, or ~index of a segment whose visibility is not tested.

    Parameters
    ----------
    scene : Scene
        Triangles that may occlude, on both sides, in the frame of receivers and segments.
    segments : int
        Number of rows of `segments`, 1 or more.
    selected : int, optional
        Length of the input `selected`; None: every receiver gets light from all segments.
    visibility : {"intervals", "rays", "none"}
        "intervals" (exact: the triangles' shadows on each segment, projected from the receiver in one traversal of the
        tree), "rays" (shadow rays to the middles of ``samples`` parts of each segment: an independent, slower method,
        of first order in the length of a part), "none" (nothing occludes).
    samples : int
        Parts of a segment for "rays", 1 or more. Default 64.
    clearance : float, optional
        Height above the lit surface, or above the receiver's plane, below which nothing occludes [m]: this excludes the
        surfaces on which both lie, as far as they are flat. None: 4e-6 of the scene's reach from the origin with
        positions in single, 1e-12 in double. A smaller clearance lets surfaces occlude points on themselves; so a scene
        of metres with details of micrometres needs double.
    precision : {None, "single", "double"}
        Precision of arithmetic and outputs; None follows the input. "single" takes float64 positions, too: they are
        subtracted before they are rounded.
    variant : {"auto", "vector", "work_item"}
        "vector" (a work-item for several strips, 16 boxes at once, for CPU runtimes), "work_item" (a work-group per
        strip, which lists the pairs of receivers and segments that face each other; a work-item per pair, for GPUs), or
        "auto".

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or lies outside its range.

    Notes
    -----
    The visible parts are summed by the closed form, with the errors of `LineIrradiance`. The edge of a shadow moves
    along a segment by e D / d, if the occluding edge at distance d from the receiver is off by e and the segment is D
    away; e is a few roundings of positions, 1e-7 or 2e-16 of the scene's size.

    The work-item variant takes two floats (kernels/common/two_float.h) for positions and sums in single precision on a
    device without doubles, or with doubles at 1/32 of the float rate or less. This adds 2^-41 (1 + D / h) of E0 to the
    error, with D and h as in `LineIrradiance`. On Mesa's rusticl without doubles, positions are floats. Sums have a
    fixed order: results are bit-equal from run to run.
    """

    Result: ClassVar[type[Any]] = StripIrradiance

    scene: Scene
    segments: int
    selected: int | None = None
    visibility: Visibility = "intervals"
    samples: int = 64
    clearance: float | None = None
    precision: Precision = None
    variant: Variant = "auto"

    def __post_init__(self) -> None:
        _check_scene(self.scene, self.clearance)
        for name in ("segments", "samples", "selected"):
            if name != "selected" or self.selected is not None:
                integer(getattr(self, name), f"OccludedIrradiance.{name}", minimum=1, maximum=2**31 - 1)
        if self.visibility not in ("intervals", "rays", "none"):
            raise ValueError(
                f"OccludedIrradiance.visibility is {self.visibility!r}, expected 'intervals', 'rays' or 'none'"
            )

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(self, device, shape, dtype, precision=self.precision, narrows=True, variant=self.variant)
        build.check_dtype("float32", "float64", of="receivers")
        is_valid = len(shape) == 3 and shape[-1] == 6 and shape[1] > 0
        build.check_shape(is_valid, "receivers (strips, n, 6), n at least 1")
        strips, each = shape[:2]
        # Convex parts are used by the vector variant only, and compiled only for a scene that has some.
        parts = self.scene.convex_parts if build.uses_vectors and self.visibility == "intervals" else None
        tree = self.scene.bvh if parts is None else parts.tree
        of_parts = [] if parts is None or not len(parts.leaves) else [parts.table(build.real)]
        if build.uses_vectors:
            work = WorkSize((min(strips, _SHARES_PER_CORE * device.compute_units),), (1,), vectors=True)
        else:
            work = group_per_element(strips, _GROUP)
        # The vector variant computes in vectors of doubles or floats. Mesa's compiler takes minutes or more for frames
        # in two floats (rusticl on llvmpipe, 2026-11).
        two_floats = not (build.doubles_positions or work.vectors or device.kind == "rusticl")
        inputs: list[Spec] = [((strips, each, 2), dtype), ((self.segments, 10), dtype)]
        if self.selected is not None:
            integers = np.dtype(np.int32)
            inputs += [((strips * ceil_div(each, SELECTION_BLOCK) + 1,), integers), ((self.selected,), integers)]
        of_receivers, of_strips = (strips, each), (strips,)
        return build.launch(
            "occluded_irradiance/occluded_irradiance.cl",
            "occluded_irradiance",
            work=work,
            more_inputs=inputs,
            outputs=build.outputs(
                {"irradiance": of_receivers, "left": of_strips, "right": of_strips, "status": of_receivers}
            ),
            defines={
                **type_defines("INPUT", dtype),
                "BVH_DEPTH": tree.stack_size,
                **({} if work.vectors else {"GROUP": _GROUP}),
                **flags(
                    DOUBLE_POSITIONS=not two_floats and device.has_double,
                    TWO_FLOAT_POSITIONS=two_floats,
                    INTERVALS=self.visibility == "intervals",
                    CONVEX_PARTS=bool(of_parts),
                    RAYS=self.visibility == "rays",
                    SELECTED=self.selected is not None,
                ),
            },
            arguments=[
                *tree.tables(build.real),
                *of_parts,
                build.positions(tree.middle) if two_floats else tree.middle.astype(build.widest),
                _clearance(self.clearance, tree, build.real, dtype),
                np.uint32(self.samples),
                np.uint32(each),
                np.uint32(self.segments),
                np.uint32(self.selected or 0),
                np.uint32(strips),
            ],
            by_team=True,
        )


def segment_rows(segments: LitSegments, room: int | None = None) -> npt.NDArray[np.float64]:
    """Return segments as rows for `OccludedIrradiance`, (room, 10): start, end, normal, exitance.

    Parameters
    ----------
    segments
        The emitters.
    room
        Number of rows; rows behind the segments have no exitance. None: the number of segments.

    Raises
    ------
    ValueError
        There are more segments than rows.
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


def _clearance(given: float | None, tree: Bvh, real: np.dtype[Any], dtype: np.dtype[Any]) -> Any:
    if given is None:
        reach = float(np.abs(tree.corners).max(initial=0.0) + np.abs(tree.middle).max())
        given = _CLEARANCE[min(real.itemsize, dtype.itemsize)] * reach
    return real.type(given)
