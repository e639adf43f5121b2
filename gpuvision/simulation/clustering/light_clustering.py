"""Model only what the scene requires: what may be left out of secondary light, to a proven error of the range."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, Launch, Variant, uses_vectors
from gpuvision.operation import VisionOperation
from gpuvision.simulation.clustering.light_tree import COLUMNS, LightTree
from gpuvision.simulation.errors.range_error import StripErrorModel
from gpuvision.simulation.scene.scene import Scene

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int32]

BLOCK = 16
# The kernel's reals, and of the scene's reach: what a place may be off by in them, and what rises less than it hides
# nothing.
_REAL = np.dtype(np.float32)
_ROUNDING, _MARGIN = 4.0 * 2.0**-23, 32.0 * 2.0**-23
# Of a row of placed segments in kernels/light_clustering/light_clustering.cl.
_PLACED = 10
_GROUP, _STRIPS_PER_CORE = 64, 8
_CLEAR = 1 << 30
# Picks of a block for which there is room at first; what needs more is planned again.
_ROOM = 64
# Bounds of zero leave most shares unspent: the others get so many times theirs, as long as the sum allows it.
_GENEROSITY = 2.0
# Twos by which the errors of picks are told apart when some of them are left out.
_STEPS = 64


@dataclass(frozen=True, eq=False)
class LightCut:
    """What of the light from lit segments is to be modelled; compared by identity.

    Attributes
    ----------
    segments
        float64 (m + clusters, 10): those given, and one for each cluster that stands for its parts somewhere.
    starts
        int32 (blocks + 1,): where the picks of each block of 16 receivers begin, block by block and strip by strip.
    picks
        int32: the segments that each needs, as `gpuvision.simulation.transport.occluded_irradiance.OccludedIrradiance`
        takes them: a number, or ~number of one that nothing can hide.
    tolerance
        Metres, as asked for.
    bound
        (strips,), metres: what the plan may be off by in range, proven; 0 where nothing is left out.
    worst
        (strips,), metres: what leaving out all of it may be off by.
    counts
        "segments", as given; "pairs" of receiver and segment, all, and by what becomes of them: "exact", "clear" (those
        of them that nothing can hide), "clustered", "left out"; "work": pairs that are left to compute.
    planned
        False: all is to be computed, because that takes less time than to find out what need not be.
    """

    segments: Reals
    starts: Integers
    picks: Integers
    tolerance: float
    bound: Reals
    worst: Reals
    counts: Mapping[str, int]
    planned: bool = True

    @classmethod
    def of_all(
        cls, segments: npt.NDArray[Any], shape: tuple[int, ...], direct: StripErrorModel, tolerance: float
    ) -> LightCut:
        """Return the plan that leaves out nothing for receivers of a shape (strips, n, 6): every segment for all."""
        strips, count = shape[:2]
        blocks, pairs = strips * -(-count // BLOCK), strips * count * len(segments)
        return cls(
            np.asarray(segments, np.float64),
            np.arange(blocks + 1, dtype=np.int32) * np.int32(len(segments)),
            np.tile(np.arange(len(segments), dtype=np.int32), blocks),
            tolerance,
            np.zeros(strips),
            direct.max_error(),
            {
                "segments": len(segments),
                "pairs": pairs,
                "exact": pairs,
                "clear": 0,
                "clustered": 0,
                "left out": 0,
                "work": pairs,
            },
            planned=False,
        )

    @property
    def modelled(self) -> bool:
        """Whether anything is left to compute."""
        return bool(len(self.picks))

    def tables(self, dtype: npt.DTypeLike, segments: int = 0, picks: int = 0) -> tuple[Any, Integers, Integers]:
        """Return segments, starts and picks with room for so many, and up to a power of two, at least.

        What is added has no exitance, and is picked by none: instances bound to few shapes serve many plans.
        """
        rows = np.zeros((_room(max(segments, len(self.segments))), 10), dtype)
        rows[: len(self.segments)] = self.segments
        rows[len(self.segments) :, 8] = 1.0
        filled = np.zeros(_room(max(picks, len(self.picks))), np.int32)
        filled[: len(self.picks)] = self.picks
        return rows, self.starts, filled

    def report(self) -> dict[str, Any]:
        """Return what was modelled and what was left out, with which bound, as JSON takes it; no bound is None."""
        return {
            "modelled": self.modelled,
            "planned": self.planned,
            "tolerance": self.tolerance,
            "bound": _largest(self.bound),
            "bound if left out": _largest(self.worst),
            "clusters": len(self.segments) - self.counts["segments"],
            **self.counts,
        }


def _room(count: int) -> int:
    return 1 << max(count - 1, 0).bit_length()


def _largest(values: Reals) -> float | None:
    largest = float(values.max(initial=0.0))
    return largest if math.isfinite(largest) else None


@dataclass(frozen=True, kw_only=True)
class LightClustering:
    """Leaves out of the light between surfaces what stays under a tolerance: ``planner(segments, ...) -> LightCut``.

    Parameters
    ----------
    tolerance
        Metres of range; 0 leaves out only what is zero.
    scene
        What may stand between; None: nothing does.
    clearance
        Metres: what rises less above a receiver's or a lit surface does not hide anything; at least 4e-6 of the
        scene's reach from its middle.
    clusters
        Whether one segment may stand for several.
    variant
        "vector" (16 boxes at a time, for CPU runtimes), "work_item" (a work-item per block, for GPUs), or "auto".

    Raises
    ------
    ValueError
        The tolerance or the clearance is negative or no number.

    Notes
    -----
    A receiver's irradiance from a segment is at most W cos cos / (pi r^2), W its power, with the largest cosines and
    the least distance of any two points, and never more than W / (L r) of length L. The error of a segment that stands
    for a cluster is in `gpuvision.simulation.clustering.light_tree`. Visibility is between 0 and 1, and a cluster
    stands only where nothing can hide any of it, so all this holds with occlusion. The tolerance is shared among
    pairs by power times
    cost; what the shares leave over is then spent on the pairs with the least bounds.

    Places are rounded to single about the scene's middle, and the bounds take that into account, by 5e-7 of its reach;
    only what lies in, or under, a surface's own plane to that is taken to get nothing from it. The rounding of the
    kernel that computes the rest comes on top.
    """

    tolerance: float
    scene: Scene | None = None
    clearance: float = 0.0
    clusters: bool = True
    variant: Variant = "auto"
    # The room that the last profiles needed.
    _room: list[int] = field(init=False, repr=False, compare=False, default_factory=lambda: [_ROOM])

    def __post_init__(self) -> None:
        for name in ("tolerance", "clearance"):
            _check_metres(getattr(self, name), f"LightClustering.{name}")

    def __call__(
        self,
        segments: npt.NDArray[Any],
        receivers: npt.NDArray[Any],
        weights: npt.NDArray[Any],
        direct: StripErrorModel,
        *,
        tolerance: float | None = None,
        device: Device | None = None,
    ) -> LightCut:
        """Plan a profile.

        Parameters
        ----------
        segments
            (m, 10): start, end [m], normal, exitance [W/m]; without exitance: none.
        receivers
            (strips, n, 6), float32 or float64: place and normal. Those without weight have no part in it.
        weights
            (strips, n, 2): W, and W times sensor unit about u = 0, by 1 W/m^2.
        direct
            What else falls on the strips.
        tolerance
            Of this profile, if another one.
        device
            Where to plan; `Device.best` if left out.
        """
        asked = self.asked(tolerance)
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
        costs = direct.error_per_irradiance(weights)
        places = np.ascontiguousarray(receivers)
        return _planned(self, asked, tree, segments, places, costs, direct, device or Device.best())

    def asked(self, tolerance: float | None) -> float:
        """Return the tolerance of a profile, metres: the one given, or else the planner's."""
        asked = self.tolerance if tolerance is None else tolerance
        _check_metres(asked, "LightClustering.tolerance")
        return asked


def _check_metres(value: float, what: str) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"{what} is {value!r}, expected metres, 0 or more")


class _Found(NamedTuple):
    """As kernels/light_clustering/light_clustering.cl writes it."""

    picks: Any
    errors: Any
    counts: Any
    spent: Any
    tallies: Any


@dataclass(frozen=True, kw_only=True)
class _PlanLight(VisionOperation[_Found]):
    """Traverses the clusters for every block of receivers (strips, n, 6)."""

    Result: ClassVar[type[Any]] = _Found

    nodes: int
    segments: int
    room: int
    scene: Scene | None
    clearance: float
    clusters: bool
    variant: Variant

    def launch(self, device: Device, shape: tuple[int, ...], dtype: np.dtype[Any]) -> Launch:
        """Describe the launch for inputs of one shape, as `Operation.launch` says."""
        if dtype not in (np.float32, np.float64):
            raise TypeError(f"LightClustering takes float32 or float64 receivers, got {dtype}")
        if dtype == np.float64 and not device.has_double:
            raise ValueError(f"device {device.label} has no double precision; give receivers as float32")
        strips, count, _ = shape
        of_strip = -(-count // BLOCK)
        blocks = strips * of_strip
        strip = uses_vectors(self.variant, device)
        each = -(-blocks // (_STRIPS_PER_CORE * device.handle.max_compute_units)) if strip else 1
        items = -(-blocks // max(each, 1))
        whole = np.dtype(np.int32)
        tables: list[Any] = [None] * 5
        depth = 1
        if self.scene is not None:
            tables, depth = list(self.scene.bvh.tables(_REAL)), self.scene.bvh.depth
        present = {"VECTOR_VARIANT": strip, "OCCLUDERS": self.scene is not None, "CLUSTERS": self.clusters}
        reach = 0.0 if self.scene is None else _reach(self.scene, dtype)
        margin = max(self.clearance, _MARGIN * reach)
        return Launch(
            source="light_clustering/light_clustering.cl",
            kernel="plan_light",
            defines={
                **{name: None for name, is_present in present.items() if is_present},
                "INPUT": "float" if dtype == np.float32 else "double",
                "BVH_DEPTH": depth,
                "BLOCK": BLOCK,
            },
            inputs=[
                (shape, dtype),
                ((strips, count), _REAL),
                ((strips,), _REAL),
                ((self.nodes, COLUMNS), _REAL),
                ((self.nodes, 2), whole),
                ((self.segments, _PLACED), _REAL),
                ((4,), dtype),
            ],
            outputs={
                "picks": ((blocks, self.room), whole),
                "errors": ((blocks, self.room), np.dtype(np.float32)),
                "counts": ((blocks,), whole),
                "spent": ((blocks, 2), _REAL),
                "tallies": ((blocks, 2), whole),
            },
            arguments=[
                *tables,
                _REAL.type(margin),
                *(np.uint32(value) for value in (self.room, blocks, of_strip, count, each)),
            ],
            global_size=(items,) if strip else (-(-items // _GROUP) * _GROUP,),
            local_size=(1,) if strip else (_GROUP,),
        )


def _frame(scene: Scene | None, segments: Reals, receivers: npt.NDArray[Any]) -> Reals:
    """Return the middle of all places, and by how much they may be rounded in single, metres."""
    if scene is not None:
        middle, reach = scene.bvh.middle, _reach(scene, receivers.dtype)
    else:
        places = np.concatenate([segments[:, :6].reshape(-1, 3), receivers[..., :3].reshape(-1, 3)])
        places = places[np.isfinite(places).all(axis=1)]
        if not len(places):
            return np.zeros(4)
        low, high = places.min(axis=0), places.max(axis=0)
        middle = (0.5 * (low + high)).astype(receivers.dtype)
        reach = float(np.abs(places).max()) if receivers.dtype == np.float32 else 0.5 * float((high - low).max())
    return np.append(middle, _ROUNDING * reach)


def _reach(scene: Scene, dtype: np.dtype[Any]) -> float:
    """Return how far from its middle a scene goes; from the origin, where places come in single."""
    reach = float(np.abs(scene.bvh.corners).max(initial=0.0))
    return reach + (float(np.abs(scene.bvh.middle).max()) if dtype == np.float32 else 0.0)


def _planned(
    planner: LightClustering,
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    receivers: npt.NDArray[Any],
    costs: Reals,
    direct: StripErrorModel,
    device: Device,
) -> LightCut:
    strips = len(costs)
    of_strip = -(-receivers.shape[1] // BLOCK)
    found, spent = _traversed(planner, tolerance, tree, segments, receivers, costs, device)
    owner = np.repeat(np.arange(strips), of_strip)
    held = np.arange(found.picks.shape[1]) < found.counts[:, None]
    picks, errors = found.picks[held], found.errors[held].astype(np.float64)
    block = np.repeat(np.arange(len(found.counts)), found.counts)
    receivers_of = np.minimum(BLOCK, receivers.shape[1] - BLOCK * (np.arange(len(found.counts)) % of_strip))
    worst = np.minimum(spent[:, 1], direct.max_error())
    kept, lost = _kept(picks, errors, owner[block], spent, worst, tolerance)
    bound = np.minimum(np.where(lost > 0.0, lost, 0.0), worst)
    return _assembled(tolerance, tree, segments, picks[kept], block[kept], bound, worst, receivers_of)


def _kept(
    picks: Integers, errors: Reals, strip: npt.NDArray[np.int64], spent: Reals, worst: Reals, tolerance: float
) -> tuple[npt.NDArray[np.bool_], Reals]:
    """Return which picks stay when what is left of the tolerance is spent on the least, and all that is lost."""
    strips = len(spent)
    out = worst <= tolerance
    single = picks >= 0
    # Errors in steps of two below the tolerance; a step is left out whole.
    with np.errstate(divide="ignore"):
        below = np.floor(np.log2(tolerance) - np.log2(errors)) if tolerance > 0.0 else np.full(len(errors), -1.0)
    step = np.clip(below, -1.0, _STEPS - 1.0).astype(np.int64)
    able = single & (step >= 0)
    sums = np.bincount(strip[able] * _STEPS + step[able], errors[able], strips * _STEPS).reshape(strips, _STEPS)
    # The smallest are in the last step.
    running = np.cumsum(sums[:, ::-1], axis=1)[:, ::-1]
    fits = running <= (tolerance - spent[:, 0])[:, None]
    cut = np.where(fits.any(axis=1), np.argmax(fits, axis=1), _STEPS)
    dropped = np.where(cut < _STEPS, running[np.arange(strips), np.minimum(cut, _STEPS - 1)], 0.0)
    kept = ~out[strip] & ~(able & (step >= cut[strip]))
    return kept, np.where(out, worst, spent[:, 0] + dropped)


def _assembled(
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    picks: Integers,
    block: npt.NDArray[np.int64],
    bound: Reals,
    worst: Reals,
    receivers_of: npt.NDArray[np.int64],
) -> LightCut:
    """Turn picks of the kernel, by places in the tree and by nodes, into numbers of segments."""
    cluster = picks < 0
    clear = cluster | (picks >= _CLEAR)
    numbers = np.zeros(len(picks), np.int64)
    numbers[~cluster] = tree.order[picks[~cluster] & (_CLEAR - 1)] if len(segments) else 0
    nodes, place = np.unique(~picks[cluster], return_inverse=True)
    numbers[cluster] = len(segments) + place
    starts = np.zeros(len(receivers_of) + 1, np.int32)
    np.cumsum(np.bincount(block, minlength=len(receivers_of)), out=starts[1:])
    each = receivers_of[block]
    pairs = int(receivers_of.sum()) * len(segments)
    exact = int(each[~cluster].sum())
    clustered = int((each[cluster] * tree.spans[~picks[cluster], 1]).sum())
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
        np.concatenate([segments, tree.aggregates[nodes]]),
        starts,
        np.where(clear, ~numbers, numbers).astype(np.int32),
        tolerance,
        bound,
        worst,
        counts,
    )


def _traversed(
    planner: LightClustering,
    tolerance: float,
    tree: LightTree,
    segments: Reals,
    receivers: npt.NDArray[Any],
    costs: Reals,
    device: Device,
) -> tuple[_Found, Reals]:
    """Return what the kernel found, and what each strip has lost by it, and would lose by all of it, metres."""
    frame = _frame(planner.scene, segments, receivers)
    middle = frame[:3]
    rows = tree.rows.copy()
    rows[:, :9] -= np.tile(middle, 3)
    placed = np.zeros((len(tree.spans) // 2, _PLACED))
    placed[: len(segments)] = _placed(segments[tree.order], middle)
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = tolerance / (costs.sum(axis=1) * tree.power)
    shares = np.where(np.isnan(shares), 0.0, np.minimum(shares, float(np.finfo(np.float32).max)))
    given = costs.astype(_REAL), rows.astype(_REAL), placed.astype(_REAL), frame.astype(receivers.dtype)
    of_strip = -(-receivers.shape[1] // BLOCK)
    generosity = np.full(len(costs), _GENEROSITY)
    while True:
        found = _run(
            planner,
            receivers,
            np.minimum(shares * generosity, np.finfo(np.float32).max).astype(_REAL),
            tree.spans,
            *given,
            device=device,
        )
        spent = np.add.reduceat(found.spent.astype(np.float64), np.arange(len(costs)) * of_strip, axis=0)
        over = (spent[:, 0] > tolerance) & (generosity > 1.0)
        if not over.any():
            return found, spent
        generosity[over] = 1.0


def _run(
    planner: LightClustering,
    receivers: npt.NDArray[Any],
    shares: npt.NDArray[Any],
    spans: Integers,
    costs: npt.NDArray[Any],
    rows: npt.NDArray[Any],
    placed: npt.NDArray[Any],
    frame: npt.NDArray[Any],
    device: Device,
) -> _Found:
    while True:
        operation = _PlanLight(
            nodes=len(spans),
            segments=len(placed),
            room=planner._room[0],
            scene=planner.scene,
            clearance=planner.clearance,
            clusters=planner.clusters,
            variant=planner.variant,
        )
        found = operation(receivers, costs, shares, rows, spans, placed, frame, device=device)
        most = int(found.counts.max(initial=0))
        if most <= planner._room[0]:
            return found
        planner._room[0] = _room(most)


def _placed(segments: Reals, middle: Reals) -> Reals:
    """Return (m, 10): normal, the height of its plane, start and end, from the middle."""
    size = np.linalg.norm(segments[:, 6:9], axis=1, keepdims=True)
    normal = segments[:, 6:9] / np.where(size > 0.0, size, 1.0)
    start, end = segments[:, :3] - middle, segments[:, 3:6] - middle
    return np.column_stack([normal, np.sum(normal * start, axis=1), start, end])
