"""Division of a thick sheet of light into slabs, at edges of surfaces and shadows that lie in it.

`SheetDivision.divide` finds the slabs. `SheetDivision.slanted_parts` finds where light of a slab is cut off along an
edge that crosses the sheet.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.transport.illumination import LitLine
from gpuvision.simulation.transport.line_parts import Parts, concatenate_parts, points_on, whole_parts
from gpuvision.simulation.transport.line_runs import Levels, LineScale, Pieces, find_runs, intervals_to_divide
from gpuvision.simulation.transport.lit_sheets import LitSheets, SheetLighting
from gpuvision.simulation.transport.sheet_cut import SheetIndex
from gpuvision.simulation.transport.slab_edges import SlantedLimits, slanted_limits
from gpuvision.simulation.transport.slabs import Slabs, concatenated_slabs
from gpuvision.simulation.transport.surface_reflection import SurfaceReflection

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class DivisionLimits:
    """Numerical limits of `SheetDivision`.

    Attributes
    ----------
    edge_sigmas
        Range about the sheet's middle in which edges divide it [sigmas]; derived: 6e-5 of the light lies beyond.
        Default 4.0.
    max_edges
        Largest number of edges that divide a sheet, the longest ones; bounds the work. Default 16.
    edge_gap
        Least distance between two divisions [sigmas]. Default 1e-4.
    max_divisions, max_levels
        Largest number of places per sheet at which it is divided where runs of the lit or visible line begin or end,
        and of levels that are computed to find them; they bound the work on rough surfaces, where errors of single
        edges average out. Chosen: an edge takes 8 levels. Defaults 4 and 32.
    division_width
        Distance of two levels at which the search for such a place ends [sigmas]. Derived: half of it moves a reading
        of half a beam by 0.0016 sigma. Default 0.005.
    outer_slab
        Place across the sheet beyond which the light is a separate slab, where an end of a run moves within the sheet
        [sigmas]; derived: 5e-4 of the light lies beyond. Default 3.5.
    """

    edge_sigmas: float = 4.0
    max_edges: int = 16
    edge_gap: float = 1e-4
    max_divisions: int = 4
    max_levels: int = 32
    division_width: float = 0.005
    outer_slab: float = 3.5


class DividedSheets(NamedTuple):
    """Slabs of the sheets of several profiles, and their light.

    Attributes
    ----------
    slabs
        Slabs of all profiles.
    profile
        int64 (slabs,): index of the profile of each slab.
    lit
        Lit segments; `LitSheets.sheet` is the index of the slab.
    parts
        Parts of the segments in view.
    line_changes
        Whether an end of a run of the line moves from slab to slab.
    """

    slabs: Slabs
    profile: Integers
    lit: LitSheets
    parts: Parts
    line_changes: bool


class SlantedParts(NamedTuple):
    """Parts of lit segments with limits across the sheet.

    Attributes
    ----------
    line
        Line that the parts belong to: "visible", or "lit" (with the parts that are hidden from the lens).
    lit
        Lit segments, with additional ones for parts that have slanted limits.
    limits
        Lower and upper limit of the light at both ends of each segment, (m, 2) each [sigmas].
    parts
        Parts of the segments.
    """

    line: str
    lit: LitSheets
    limits: tuple[Float64, Float64]
    parts: Parts


@dataclass(frozen=True, kw_only=True, eq=False)
class SheetDivision:
    """Slabs of a thick sheet of light; compared by identity.

    Parameters
    ----------
    lighting
        Sheet, scene and sensor.
    reflection
        Reflection by the surfaces; gives the material of each segment.
    uniform
        Slabs where no edge divides the sheet.
    at_surface_edges, at_run_ends
        Whether edges of surfaces in the sheet, and ends of lit or visible runs of the line, divide it.
    tail_sigmas
        Range of the Gaussian that is deposited [sigmas].
    limits
        Numerical limits.
    """

    lighting: SheetLighting
    reflection: SurfaceReflection
    uniform: Slabs
    at_surface_edges: bool
    at_run_ends: bool
    tail_sigmas: float
    limits: DivisionLimits = DivisionLimits()

    def slabs(self, L: float) -> Slabs:
        """Return the slabs of the sheet at a transport L [m], divided at edges of surfaces that lie in it."""
        if not self.at_surface_edges:
            return self.uniform
        sigma, limits = self.lighting.sheet.sigma, self.limits
        places, lengths = SheetIndex.of(self.lighting.scene, self.lighting.sheet.transport).parallel_edges
        edge_range = slice(*np.searchsorted(places, [L - limits.edge_sigmas * sigma, L + limits.edge_sigmas * sigma]))
        longest = np.argsort(-lengths[edge_range], kind="stable")[: limits.max_edges]
        steps = np.sort((places[edge_range][longest] - L) / sigma)
        if not len(steps):
            return self.uniform
        return self._cut(self.uniform, steps, steps[np.diff(steps, prepend=-np.inf) > limits.edge_gap])

    def _cut(self, slabs: Slabs, steps: Float64, added: Float64) -> Slabs:
        """Return the slabs with the divisions ``added`` [sigmas], without their own divisions close to ``steps``."""
        cuts = slabs.high[:-1]
        far = np.abs(cuts[:, None] - steps).min(axis=1, initial=np.inf) > self.limits.edge_gap
        return Slabs.from_cuts(np.sort(np.append(cuts[far], added)))

    def divide(self, places: Float64, causes: bool) -> DividedSheets:
        """Return the slabs of profiles at transports (profiles,) [m], and their light.

        Sheets are divided where a run of the visible line (with ``causes`` also of the lit line) begins or ends at one
        place across the sheet. Two more levels at either side, beyond the outermost slabs, find edges there. Without
        such an edge the levels of the slabs are computed only once.
        """
        by_profile = [self.slabs(float(L)) for L in places]
        if not (self.at_run_ends and by_profile):
            return self._light(places, by_profile, causes, line_changes=False)
        extended = [each.with_outer(self.limits.outer_slab) for each in by_profile]
        first = self._light(places, extended, causes, line_changes=True)
        levels = Levels(first.slabs.middle, first.profile, self._lines(first.lit, first.parts, causes))
        moving, jumps = self._changes(places, levels, by_profile, causes)
        if not any(len(each) for each in jumps):
            return self._without_still_outer_slabs(first, extended, by_profile, moving)
        divided = [self._cut(slabs, found, found) for slabs, found in zip(extended, jumps, strict=True)]
        return self._light(places, divided, causes, line_changes=True)

    def _light(self, places: Float64, by_profile: list[Slabs], causes: bool, *, line_changes: bool) -> DividedSheets:
        """Return the slabs of all profiles with their lit segments and the segments' parts."""
        slabs, profile = concatenated_slabs(by_profile)
        lit, parts = self.lighting.light_levels(places, profile, slabs.middle, with_hidden=causes)
        return DividedSheets(slabs, profile, lit, parts, line_changes)

    @staticmethod
    def _without_still_outer_slabs(
        first: DividedSheets, extended: list[Slabs], by_profile: list[Slabs], moving: npt.NDArray[np.bool_]
    ) -> DividedSheets:
        """Return extended sheets without the outer slabs of the profiles in which no end of a run moves."""
        outer = np.concatenate([np.arange(len(each.share)) % (len(each.share) - 1) == 0 for each in extended])
        kept = ~outer | moving[first.profile]
        used = [large if moves else own for large, own, moves in zip(extended, by_profile, moving, strict=True)]
        kept_segments = kept[first.lit.sheet]
        parts = first.parts.select(kept_segments[first.parts.segment])
        parts = parts._replace(segment=(np.cumsum(kept_segments) - 1)[parts.segment])
        return DividedSheets(*concatenated_slabs(used), first.lit.select(kept), parts, bool(moving.any()))

    # ---- search for ends of runs -------------------------------------------------------------------------------

    def _changes(
        self, places: Float64, levels: Levels, by_profile: list[Slabs], causes: bool
    ) -> tuple[npt.NDArray[np.bool_], list[Float64]]:
        """Return whether ends of runs move within each profile's sheet, and where runs begin or end at once [sigmas].

        The search halves the distance between two levels whose runs differ.
        """
        limits, width = self.limits, self._scale.width
        smallest = limits.division_width
        # Edges that lie in the sheet: the slabs end there already.
        known = [np.setdiff1d(each.high[:-1], self.uniform.high[:-1]) for each in by_profile]
        moving, added = np.zeros(len(places), bool), np.zeros(len(places), np.int64)
        while True:
            runs = levels.runs(self._scale)
            after = intervals_to_divide(runs, levels.place, levels.profile, smallest, limits.max_divisions, width)
            for each in runs:
                moving[levels.profile[each.moves]] = True
            after = after[added[levels.profile[after]] < limits.max_levels]
            if not len(after):
                break
            place, profile = self._levels_between(levels, after, known)
            added += np.bincount(profile, minlength=len(places))
            lit, parts = self.lighting.light_levels(places, profile, place, with_hidden=causes)
            levels = levels.joined(Levels(place, profile, self._lines(lit, parts, causes)))
        step = np.append(np.diff(levels.place), np.inf)
        is_open = np.max([each.open_length for each in runs], axis=0) > 0.0
        found = np.flatnonzero(is_open & (step > 0.0) & (step <= smallest))
        at, in_profile = levels.place[found] + 0.5 * step[found], levels.profile[found]
        jumps = []
        for n, cuts in enumerate(known):
            mine = at[in_profile == n]
            jumps.append(mine[np.abs(mine[:, None] - cuts).min(axis=1, initial=np.inf) > smallest])
        return moving, jumps

    def _levels_between(self, levels: Levels, after: Integers, known: list[Float64]) -> tuple[Float64, Integers]:
        """Return place and profile of new levels between the levels ``after`` and their successors.

        A new level is the middle of the interval. Where known edges lie in the interval, the new levels are beside
        them: the levels then differ across these edges only, where the sheet is divided already.
        """
        place, profile = [], []
        for k in after:
            low, high, of = levels.place[k], levels.place[k + 1], int(levels.profile[k])
            beside = known[of][:, None] + 0.25 * self.limits.division_width * np.array([-1.0, 1.0])
            beside = beside[(beside > low) & (beside < high)]
            at = np.unique(beside) if len(beside) else np.array([0.5 * (low + high)])
            place.append(at)
            profile.append(np.full(len(at), of))
        return np.concatenate(place), np.concatenate(profile)

    def _lines(self, lit: LitSheets, parts: Parts, causes: bool) -> tuple[Pieces, ...]:
        """Return the visible line at each level, and with ``causes`` the lit line."""
        shown = self._pieces(lit, parts.select(parts.visible))
        return (shown, self._pieces(lit, whole_parts(lit.line))) if causes else (shown,)

    def _pieces(self, lit: LitSheets, parts: Parts) -> Pieces:
        """Return parts of segments as pieces of lines, in their order."""
        ends = parts.ends(lit.line)
        place = self._across_transport(ends)
        x, height = self.lighting.sheet.ray_coordinates(place), place[..., 1]
        backward = (x[:, 1] < x[:, 0])[:, None]
        x, height = np.where(backward, x[:, ::-1], x), np.where(backward, height[:, ::-1], height)
        shift = self.lighting.shift_per_sigma(lit.line.normals[parts.segment], ends.mean(axis=1))
        rate = self._across_transport(ends[:, 0] + shift)[:, 1] - place[:, 0, 1]
        kind = self.reflection.material_numbers(lit.line)[parts.segment].astype(np.int64)
        return Pieces(lit.sheet[parts.segment], x, height, rate, kind)

    # ---- limits across the sheet -------------------------------------------------------------------------------

    def slanted_parts(self, sheets: DividedSheets, causes: bool) -> Iterator[SlantedParts]:
        """Yield the parts of the visible line, and with ``causes`` of the lit line, whose ends move from slab to slab.

        A line that has no such end is not yielded.
        """
        slabs, lit = sheets.slabs, sheets.lit
        lines = {"visible": sheets.parts.select(sheets.parts.visible)}
        if causes:
            lines["lit"] = whole_parts(lit.line)
        for name, parts in lines.items():
            pieces = self._pieces(lit, parts)
            runs = find_runs(pieces, slabs.middle, sheets.profile, self._scale)
            slanted = slanted_limits(pieces, runs, slabs.middle, slabs.low, slabs.high, self._scale.width)
            if len(slanted.piece):
                yield SlantedParts(name, *self._with_limits(lit, parts, slanted, slabs))

    def _with_limits(
        self, lit: LitSheets, parts: Parts, slanted: SlantedLimits, slabs: Slabs
    ) -> tuple[LitSheets, tuple[Float64, Float64], Parts]:
        """Return the segments with additional ones for slanted parts, limits of all segments (m, 2), and the parts."""
        line, of = lit.line, parts.segment[slanted.piece]
        ends = parts.ends(line)[slanted.piece]
        place = self._across_transport(ends)
        x = self.lighting.sheet.ray_coordinates(place)
        share = np.stack([slanted.start, slanted.end], axis=1)
        low, high = slanted.low, slanted.high
        backward = (x[:, 1] < x[:, 0])[:, None]
        share = np.where(backward, 1.0 - share[:, ::-1], share)
        low, high = (np.where(backward, each[:, ::-1], each) for each in (low, high))
        if self.lighting.sheet.source is not None:
            # From a fraction of x to a fraction of the segment, which are projectively related.
            near, far = (self.lighting.sheet.source[1] - place[:, n, 1] for n in (0, 1))
            share = near[:, None] * share / (near[:, None] * share + far[:, None] * (1.0 - share))
        cut = np.stack([points_on(ends, share[:, n]) for n in (0, 1)], axis=1)
        more = LitLine(cut, line.normals[of], line.triangle[of], line.power[of])
        joined = LitLine(*(np.concatenate(each) for each in zip(line, more, strict=True)))
        sheet = np.concatenate([lit.sheet, lit.sheet[of]])
        all_limits = []
        for own, given in ((slabs.low, low), (slabs.high, high)):
            all_limits.append(np.concatenate([np.repeat(own[lit.sheet][:, None], 2, axis=1), given]))
        rest = np.ones(len(parts.segment), bool)
        rest[slanted.piece] = False
        added = whole_parts(more)
        added = added._replace(segment=added.segment + len(line.power))
        return (
            LitSheets(joined, sheet, np.concatenate([lit.moved, lit.moved[of]])),
            (all_limits[0], all_limits[1]),
            concatenate_parts([parts.select(rest), added]),
        )

    @functools.cached_property
    def _scale(self) -> LineScale:
        """Lengths on the line: the view's ends are infinite where a ray of it does not meet the sheet."""
        view, sheet = self.lighting.view, self.lighting.sheet
        points = view.points_in_sheet(*np.meshgrid(view.u_edges, view.v_edges, indexing="ij"))
        x = sheet.ray_coordinates(view.sheet_coordinates(points))
        width = float(np.nanmedian(np.abs(np.diff(x, axis=1))))
        if not np.isfinite(x).all():
            return LineScale(sheet.sigma, width, -math.inf, math.inf)
        margin = self.tail_sigmas * sheet.sigma
        return LineScale(sheet.sigma, width, float(x.min()) - margin, float(x.max()) + margin)

    def _across_transport(self, points: Float64) -> Float64:
        """Return the coordinates (G, H) (..., 2) [m] of points (..., 3) at any transport."""
        move = self.lighting.sheet.transport
        axes = np.linalg.inv(np.array([move.g_axis, move.h_axis, move.direction]))
        return np.asarray((points - np.array(move.origin)) @ axes[:, :2])
