"""Cuts of the light tree: which segments and clusters each block of receivers needs, and the bound of the error."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import capacity
from gpuvision.simulation.errors.range_error import StripErrorModel

Reals = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int32]

BLOCK = 16
"""Receivers of a strip that share a list of selected segments."""


@dataclass(frozen=True, eq=False)
class LightCut:
    """Cut of the light tree for each block of receivers: the segments and clusters to compute; compared by identity.

    Attributes
    ----------
    segments
        float64 (m + clusters, 10): the given segments, then the representative segment of each cluster in use.
    starts
        int32 (blocks + 1,): index into `selected` at which the list of each block of 16 receivers begins, block by
        block and strip by strip; the last entry is the end of the last list.
    selected
        int32: lists of segments as `gpuvision.simulation.transport.occluded_irradiance.OccludedIrradiance` takes them:
        an index into `segments`, or ~index of a segment that nothing can occlude.
    tolerance
        Range error that was allowed [m].
    bound
        float64 (strips,), metres: bound of the range error by all pairs that are left out or clustered; 0 where there
        are none. See the notes of `LightClustering` for the errors that it does not cover.
    bound_if_omitted
        float64 (strips,), metres: the same bound if the light of all segments were omitted.
    counts
        Number of "segments", of all "pairs" of a receiver and a segment, and of the pairs that are computed exactly
        ("exact"; of these "clear" cannot be occluded), represented by a cluster ("clustered"), or "left out". "work" is
        the number of pairs that remain to be computed.
    traversed
        Whether the tree was traversed. False: every pair is computed, because that is faster. Default True.
    """

    segments: Reals
    starts: Integers
    selected: Integers
    tolerance: float
    bound: Reals
    bound_if_omitted: Reals
    counts: Mapping[str, int]
    traversed: bool = True

    @classmethod
    def full(
        cls, segments: npt.NDArray[Any], shape: tuple[int, ...], reading: StripErrorModel, tolerance: float
    ) -> LightCut:
        """Return the cut that selects every segment for all receivers.

        Parameters
        ----------
        segments
            (m, 10), as of `LightClustering.__call__`.
        shape
            Shape of the receivers, (strips, n, 6).
        reading
            Gives `bound_if_omitted`.
        tolerance
            Recorded in the cut [m].
        """
        strips, count = shape[:2]
        blocks, pairs = strips * -(-count // BLOCK), strips * count * len(segments)
        return cls(
            np.asarray(segments, np.float64),
            *_full_lists(blocks, len(segments)),
            tolerance,
            np.zeros(strips),
            reading.max_error(),
            {
                "segments": len(segments),
                "pairs": pairs,
                "exact": pairs,
                "clear": 0,
                "clustered": 0,
                "left out": 0,
                "work": pairs,
            },
            traversed=False,
        )

    @property
    def has_pairs(self) -> bool:
        """Whether any pair is left to compute."""
        return bool(len(self.selected))

    def padded_tables(
        self, dtype: npt.DTypeLike, segments: int = 0, selected: int = 0
    ) -> tuple[Any, Integers, Integers]:
        """Return `segments`, `starts` and `selected`, padded to powers of two, so that few kernels are bound.

        The added segments have no exitance, and no list holds them.

        Parameters
        ----------
        dtype
            Of the segments.
        segments, selected
            Least numbers of rows. Defaults 0 and 0.
        """
        rows = np.zeros((capacity(max(segments, len(self.segments))), 10), dtype)
        rows[: len(self.segments)] = self.segments
        rows[len(self.segments) :, 8] = 1.0
        filled = np.zeros(capacity(max(selected, len(self.selected))), np.int32)
        filled[: len(self.selected)] = self.selected
        return rows, self.starts, filled

    def report(self) -> dict[str, Any]:
        """Return the counts and bounds as a dictionary for JSON; an infinite bound is None."""
        return {
            "has pairs": self.has_pairs,
            "traversed": self.traversed,
            "tolerance": self.tolerance,
            "bound": _finite_max(self.bound),
            "bound if all left out": _finite_max(self.bound_if_omitted),
            "clusters": len(self.segments) - self.counts["segments"],
            **self.counts,
        }


@functools.lru_cache(maxsize=16)
def _full_lists(blocks: int, segments: int) -> tuple[Integers, Integers]:
    """Return `starts` and `selected` of lists with all segments for each block: read-only, shared by cuts of a size."""
    starts = np.arange(blocks + 1, dtype=np.int32) * np.int32(segments)
    selected = np.tile(np.arange(segments, dtype=np.int32), blocks)
    for array in (starts, selected):
        array.flags.writeable = False
    return starts, selected


def _finite_max(values: Reals) -> float | None:
    largest = float(values.max(initial=0.0))
    return largest if math.isfinite(largest) else None
