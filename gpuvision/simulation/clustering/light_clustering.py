"""Error-bounded clustering of lit segments: which pairs of segments and receivers a reading needs (lightcuts)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import (
    Device,
    FloatArray,
    IntArray,
    Launch,
    LaunchBuilder,
    Variant,
    capacity,
    ceil_div,
    flags,
    group_per_element,
    table_offsets,
    to_numpy,
    type_defines,
)
from gpuvision.operation import VisionOperation
from gpuvision.simulation.clustering.light_cut import BLOCK, LightCut
from gpuvision.simulation.clustering.light_tree import COLUMNS, NODE_SIZES, LightTree
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.bvh import MIN_STACK_SIZE
from gpuvision.simulation.scene.scene import Scene

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int32]

# The kernel computes in single. In parts of the scene's reach: how far a position may be rounded (derived: a few
# roundings of single), and how high a surface must rise above the planes of receiver and segment to occlude (chosen:
# well above the rounding).
_REAL = np.dtype(np.float32)
_POSITION_ROUNDING, _OCCLUDER_MARGIN = 4.0 * 2.0**-23, 32.0 * 2.0**-23
# Columns of a segment in kernels/light_clustering/light_clustering.cl: normal, height of its plane, start, end.
_SEGMENT_SIZES = {"normal": 3, "height": 1, "start": 3, "end": 3}
_SEGMENT_COLUMNS = sum(_SEGMENT_SIZES.values())
# Work-items of a work-group, which processes a block; strips of receivers per core, several to balance the load (speed
# only).
_GROUP, _STRIPS_PER_CORE = 64, 8
# Bit of a selected segment that no surface can occlude, as the kernel sets it.
_UNOCCLUDED_BIT = 1 << 30
# Entries of a block that fit at first. If a block needs more, the capacity grows to the next power of two and the
# kernel runs again.
_FIRST_CAPACITY = 64
# Many pairs have a bound of 0 and leave their share of the tolerance unused. All shares are multiplied by this factor;
# a strip whose error sum then exceeds the tolerance is traversed again with the factor 1. Speed only (chosen).
_SHARE_FACTOR = 2.0
# Error classes, in powers of two below the tolerance: a histogram over them finds the smallest errors without a sort.
_ERROR_CLASSES = 64


@dataclass(frozen=True, kw_only=True)
class LightClustering:
    """Error-bounded clustering of lights in the manner of lightcuts: ``clustering(segments, ...) -> LightCut``.

    Each block of 16 receivers descends the tree of lit segments (`LightTree`) from its root. A node is omitted if the
    bound of its light is below its share of the tolerance. It is replaced by its representative segment if the bound of
    the error of this replacement is below that share and no surface can occlude the node. Otherwise its children are
    visited.

    Parameters
    ----------
    tolerance
        Range error that omitted and clustered pairs may make together in a strip [m], 0 or more; 0 omits only pairs
        without light.
    scene
        Triangles that may occlude; None: nothing occludes.
    clearance
        Surfaces that rise less than this above a receiver's or a lit surface's plane do not occlude [m]; at least 4e-6
        of the scene's reach from its middle. Default 0.0.
    clusters
        Whether one segment may represent several. Default True.
    variant
        "vector" (16 boxes at a time, for CPU runtimes), "work_item" (a work-group per block, whose items compute bounds
        of clusters and test triangles side by side, for GPUs), or "auto".

    Raises
    ------
    ValueError
        The tolerance or the clearance is negative or not finite.

    Notes
    -----
    Bound of one pair: the irradiance of a receiver from a segment of power W and length L is at most W cos_r cos_e /
    (pi r^2), with the largest cosines and the least distance r of any two points, and at most W / (L r). Bound of a
    cluster: see `gpuvision.simulation.clustering.light_tree`. Both hold with occlusion, because visibility lies between
    0 and 1 and a cluster is used only where no triangle can occlude any part of it.
    `StripErrorModel.error_per_irradiance` turns irradiance into metres of range; errors of pairs are added without
    cancellation.

    The tolerance is shared among pairs by power times cost. The unused part of the tolerance is then spent on the pairs
    with the least bounds.

    Covered by the bound: omission, clustering, and the rounding of positions to single about the scene's middle (5e-7
    of the reach). Not covered: the rounding of `OccludedIrradiance`, which computes the pairs that are kept; light that
    arrives within that rounding of the plane of the receiving surface, which counts as 0; the discretisation of the
    surface by receivers; readings other than the mean of u in a fixed window (`StripErrorModel`).

    References
    ----------
    B. Walter et al., *Lightcuts: a scalable approach to illumination*, ACM Transactions on Graphics 24(3), 2005. Their
    cuts bound the error of each pixel by material, geometric and visibility terms; these bound the range of a strip.
    """

    tolerance: float
    scene: Scene | None = None
    clearance: float = 0.0
    clusters: bool = True
    variant: Variant = "auto"
    # Capacity of the lists of blocks that the last profiles needed.
    _capacity_used: list[int] = field(init=False, repr=False, compare=False, default_factory=lambda: [_FIRST_CAPACITY])

    def __post_init__(self) -> None:
        for name in ("tolerance", "clearance"):
            _check_metres(getattr(self, name), f"LightClustering.{name}")

    def __call__(
        self,
        segments: npt.NDArray[Any],
        receivers: npt.NDArray[Any],
        weights: npt.NDArray[Any],
        reading: StripErrorModel,
        *,
        tolerance: float | None = None,
        device: Device | None = None,
    ) -> LightCut:
        """Return the cut of a profile.

        Parameters
        ----------
        segments
            (m, 10): start, end [m], normal, exitance [W/m]; a row without exitance is no segment.
        receivers
            (strips, n, 6), float32 or float64: position [m] and normal. Receivers without weight are not considered.
        weights
            (strips, n, 2): power on the sensor [W], and power times u about u = 0 [W sensor unit], that 1 W/m^2 on a
            receiver adds to its strip.
        reading
            Direct light on the strips, and how the range follows the reading.
        tolerance
            Tolerance of this profile [m]; None: `LightClustering.tolerance`.
        device
            Device of the kernel; None: `Device.best`.

        Raises
        ------
        ValueError
            Shapes do not agree, or the tolerance is negative or not finite.
        """
        tolerance = self.tolerance_of(tolerance)
        segments = np.asarray(segments, np.float64)
        if (
            receivers.ndim != 3
            or receivers.shape[2] != 6
            or not receivers.size
            or weights.shape != (*receivers.shape[:2], 2)
        ):
            raise ValueError(
                f"expected receivers (strips, n, 6) and weights (strips, n, 2), got {receivers.shape}, {weights.shape}"
            )
        tree = LightTree.build(segments)
        costs = reading.error_per_irradiance(weights)
        positions = np.ascontiguousarray(receivers)
        return _cut_tree(self, tolerance, tree, segments, positions, costs, reading, device or Device.best())

    def tolerance_of(self, tolerance: float | None) -> float:
        """Return the tolerance of a profile [m]: the given one, or `LightClustering.tolerance` for None.

        Raises
        ------
        ValueError
            The tolerance is negative or not finite.
        """
        chosen = self.tolerance if tolerance is None else tolerance
        _check_metres(chosen, "LightClustering.tolerance")
        return chosen

    def selection(self, nodes: int, segments: int) -> _SelectLights:
        """Return the operation that selects the lights of each block of receivers.

        Parameters
        ----------
        nodes, segments : int
            Nodes of the light tree, and segments in it.
        """
        return _SelectLights(
            nodes=nodes,
            segments=segments,
            capacity=self._capacity_used[0],
            scene=self.scene,
            clearance=self.clearance,
            clusters=self.clusters,
            variant=self.variant,
        )


def _check_metres(value: float, what: str) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"{what} is {value!r}, expected metres, 0 or more")


class _Selection(NamedTuple):
    """Outputs of kernels/light_clustering/light_clustering.cl.

    Attributes
    ----------
    selected
        int32 (blocks, capacity): position of a segment in the tree, with the bit `_UNOCCLUDED_BIT` if nothing can
        occlude it, or ~node of a cluster.
    errors
        float32 (blocks, capacity): bound of the range error if that entry were omitted [m].
    counts
        int32 (blocks,): entries that the block needs; more than the capacity are not written.
    error_sums
        float32 (blocks, 2): bound of the error by omitted and clustered nodes, and by omitting all segments [m].
    pair_counts
        int32 (blocks, 2): segments left out, and segments in clusters.
    """

    selected: IntArray
    errors: FloatArray
    counts: IntArray
    error_sums: FloatArray
    pair_counts: IntArray


@dataclass(frozen=True, kw_only=True)
class _SelectLights(VisionOperation[_Selection]):
    """Traversal of the light tree for every block of receivers (strips, n, 6)."""

    Result: ClassVar[type[Any]] = _Selection

    nodes: int
    segments: int
    capacity: int
    scene: Scene | None
    clearance: float
    clusters: bool
    variant: Variant

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        build = LaunchBuilder(
            self, device, shape, dtype, precision="single", narrows=True, variant=self.variant, name="LightClustering"
        )
        build.check_dtype("float32", "float64", of="receivers")
        strips, count, _ = shape
        of_strip = ceil_div(count, BLOCK)
        blocks = strips * of_strip
        each = max(build.share(blocks, per_core=_STRIPS_PER_CORE), 1)
        work = build.work(blocks, each=each, group=_GROUP) if build.uses_vectors else group_per_element(blocks, _GROUP)
        tree = None if self.scene is None else self.scene.bvh
        reach = 0.0 if self.scene is None else _scene_reach(self.scene, dtype)
        margin = max(self.clearance, _OCCLUDER_MARGIN * reach)
        selected = (blocks, self.capacity)
        shapes = {"selected": selected, "errors": selected, "counts": (blocks,)}
        shapes |= {"error_sums": (blocks, 2), "pair_counts": (blocks, 2)}
        return build.launch(
            "light_clustering/light_clustering.cl",
            "select_lights",
            work=work,
            more_inputs=[
                ((strips, count), _REAL),
                ((strips,), _REAL),
                ((self.nodes, COLUMNS), _REAL),
                ((self.nodes, 2), np.dtype(np.int32)),
                ((self.segments, _SEGMENT_COLUMNS), _REAL),
                ((4,), dtype),
            ],
            outputs=build.outputs(shapes, selected=np.int32, counts=np.int32, pair_counts=np.int32),
            defines={
                **type_defines("INPUT", dtype),
                **table_offsets("NODE", NODE_SIZES),
                **table_offsets("SEGMENT", _SEGMENT_SIZES),
                "BVH_DEPTH": MIN_STACK_SIZE if tree is None else tree.stack_size,
                "BLOCK": BLOCK,
                **({} if work.vectors else {"GROUP": _GROUP}),
                **flags(OCCLUDERS=tree is not None, CLUSTERS=self.clusters),
            },
            arguments=[
                *([None] * 5 if tree is None else tree.tables(_REAL)),
                _REAL.type(margin),
                *map(np.uint32, (self.capacity, blocks, of_strip, count, work.each, self.nodes)),
            ],
        )


def _frame(scene: Scene | None, segments: Reals, receivers: npt.NDArray[Any]) -> Reals:
    """Return (4,): the middle of all positions, and the bound of their rounding to single about it [m]."""
    if scene is not None:
        middle, reach = scene.bvh.middle, _scene_reach(scene, receivers.dtype)
    else:
        places = np.concatenate([segments[:, :6].reshape(-1, 3), receivers[..., :3].reshape(-1, 3)])
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            return np.zeros(4)
        low, high = places.min(axis=0), places.max(axis=0)
        middle = (0.5 * (low + high)).astype(receivers.dtype)
        reach = float(np.abs(places).max()) if receivers.dtype == np.float32 else 0.5 * float((high - low).max())
    return np.append(middle, _POSITION_ROUNDING * reach)


def _scene_reach(scene: Scene, dtype: np.dtype[Any]) -> float:
    """Return the scene's reach from its middle [m]; plus the middle's from the origin for positions in single."""
    reach = float(np.abs(scene.bvh.corners).max(initial=0.0))
    return reach + (float(np.abs(scene.bvh.middle).max()) if dtype == np.float32 else 0.0)


def _cut_tree(
    clustering: LightClustering,
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    receivers: npt.NDArray[Any],
    costs: Reals,
    reading: StripErrorModel,
    device: Device,
) -> LightCut:
    strips = len(costs)
    of_strip = -(-receivers.shape[1] // BLOCK)
    found, error_sums = _traverse(clustering, tolerance, tree, segments, receivers, costs, device)
    owner = np.repeat(np.arange(strips), of_strip)
    in_block = to_numpy(found.counts)
    held = np.arange(found.selected.shape[1]) < in_block[:, None]
    selected, errors = to_numpy(found.selected)[held], to_numpy(found.errors)[held].astype(np.float64)
    block = np.repeat(np.arange(len(in_block)), in_block)
    receivers_of = np.minimum(BLOCK, receivers.shape[1] - BLOCK * (np.arange(len(in_block)) % of_strip))
    worst = np.minimum(error_sums[:, 1], reading.max_error())
    kept, lost = _drop_smallest(selected, errors, owner[block], error_sums, worst, tolerance)
    bound = np.minimum(np.where(lost > 0.0, lost, 0.0), worst)
    return _assemble(tolerance, tree, segments, selected[kept], block[kept], bound, worst, receivers_of)


def _drop_smallest(
    selected: Integers, errors: Reals, strip: npt.NDArray[np.int64], error_sums: Reals, worst: Reals, tolerance: float
) -> tuple[npt.NDArray[np.bool_], Reals]:
    """Return which entries are kept after the rest of the tolerance is spent on the smallest, and the error sums.

    Single segments are dropped from the smallest error on, as long as the error sum of their strip stays within the
    tolerance. A strip whose light can be omitted completely has no entry.
    """
    strips = len(error_sums)
    out = worst <= tolerance
    single = selected >= 0
    # Classes of errors in powers of two below the tolerance; the entries of a class are dropped together.
    with np.errstate(divide="ignore"):
        below = np.floor(np.log2(tolerance) - np.log2(errors)) if tolerance > 0.0 else np.full(len(errors), -1.0)
    step = np.clip(below, -1.0, _ERROR_CLASSES - 1.0).astype(np.int64)
    able = single & (step >= 0)
    sums = np.bincount(strip[able] * _ERROR_CLASSES + step[able], errors[able], strips * _ERROR_CLASSES).reshape(
        strips, _ERROR_CLASSES
    )
    # The last class holds the smallest errors.
    running = np.cumsum(sums[:, ::-1], axis=1)[:, ::-1]
    fits = running <= (tolerance - error_sums[:, 0])[:, None]
    cut = np.where(fits.any(axis=1), np.argmax(fits, axis=1), _ERROR_CLASSES)
    dropped = np.where(cut < _ERROR_CLASSES, running[np.arange(strips), np.minimum(cut, _ERROR_CLASSES - 1)], 0.0)
    kept = ~out[strip] & ~(able & (step >= cut[strip]))
    return kept, np.where(out, worst, error_sums[:, 0] + dropped)


def _assemble(
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    selected: Integers,
    block: npt.NDArray[np.int64],
    bound: Reals,
    worst: Reals,
    receivers_of: npt.NDArray[np.int64],
) -> LightCut:
    """Make the cut from the kernel's entries: turn positions in the tree and nodes into indices of segments."""
    cluster = selected < 0
    clear = cluster | (selected >= _UNOCCLUDED_BIT)
    numbers = np.zeros(len(selected), np.int64)
    numbers[~cluster] = tree.order[selected[~cluster] & (_UNOCCLUDED_BIT - 1)] if len(segments) else 0
    nodes, place = np.unique(~selected[cluster], return_inverse=True)
    numbers[cluster] = len(segments) + place
    starts = np.zeros(len(receivers_of) + 1, np.int32)
    np.cumsum(np.bincount(block, minlength=len(receivers_of)), out=starts[1:])
    each = receivers_of[block]
    pairs = int(receivers_of.sum()) * len(segments)
    exact = int(each[~cluster].sum())
    clustered = int((each[cluster] * tree.spans[~selected[cluster], 1]).sum())
    counts = {
        "segments": len(segments),
        "pairs": pairs,
        "exact": exact,
        "clear": int(each[~cluster & clear].sum()),
        "clustered": clustered,
        "left out": pairs - exact - clustered,
        "work": int(each.sum()),
    }
    return LightCut(
        np.concatenate([segments, tree.representatives[nodes]]),
        starts,
        np.where(clear, ~numbers, numbers).astype(np.int32),
        tolerance,
        bound,
        worst,
        counts,
    )


def _traverse(
    clustering: LightClustering,
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    receivers: npt.NDArray[Any],
    costs: Reals,
    device: Device,
) -> tuple[_Selection, Reals]:
    """Return the kernel's outputs, and per strip (strips, 2) the error sums of the cut and of omitting all [m]."""
    frame = _frame(clustering.scene, segments, receivers)
    middle = frame[:3]
    rows = tree.rows.copy()
    rows[:, :9] -= np.tile(middle, 3)
    placed = np.zeros((len(tree.spans) // 2, _SEGMENT_COLUMNS))
    placed[: len(segments)] = _segment_rows(segments[tree.order], middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = tolerance / (costs.sum(axis=1) * tree.power)
    shares = np.where(np.isnan(shares), 0.0, np.minimum(shares, float(np.finfo(np.float32).max)))
    given = costs.astype(_REAL), rows.astype(_REAL), placed.astype(_REAL), frame.astype(receivers.dtype)
    of_strip = -(-receivers.shape[1] // BLOCK)
    factor = np.full(len(costs), _SHARE_FACTOR)
    while True:
        found = _select_lights(
            clustering,
            receivers,
            np.minimum(shares * factor, np.finfo(np.float32).max).astype(_REAL),
            tree.spans,
            *given,
            device=device,
        )
        error_sums = np.add.reduceat(
            to_numpy(found.error_sums).astype(np.float64), np.arange(len(costs)) * of_strip, axis=0
        )
        over = (error_sums[:, 0] > tolerance) & (factor > 1.0)
        if not over.any():
            return found, error_sums
        factor[over] = 1.0


def _select_lights(
    clustering: LightClustering,
    receivers: npt.NDArray[Any],
    shares: npt.NDArray[Any],
    spans: Integers,
    costs: npt.NDArray[Any],
    rows: npt.NDArray[Any],
    placed: npt.NDArray[Any],
    frame: npt.NDArray[Any],
    device: Device,
) -> _Selection:
    while True:
        operation = clustering.selection(len(spans), len(placed))
        found = operation(receivers, costs, shares, rows, spans, placed, frame, device=device)
        max_count = int(to_numpy(found.counts).max(initial=0))
        if max_count <= clustering._capacity_used[0]:
            return found
        clustering._capacity_used[0] = capacity(max_count)


def _segment_rows(segments: Reals, middle: Reals) -> Reals:
    """Return (m, 10): normal, the height of its plane, start and end, from the middle."""
    size = np.linalg.norm(segments[:, 6:9], axis=1, keepdims=True)
    normal = segments[:, 6:9] / np.where(size > 0.0, size, 1.0)
    start, end = segments[:, :3] - middle, segments[:, 3:6] - middle
    return np.column_stack([normal, np.sum(normal * start, axis=1), start, end])
