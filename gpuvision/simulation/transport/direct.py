"""Direct light: from the sheet to a surface to the lens, and the true position of the lit line."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import (
    UNIFORM,
    UNIFORM_UNOCCLUDED,
    UNOCCLUDED,
    GroundTruth,
    strongest_points,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.sensors.view_rays import check_materials
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import (
    LensVisibility,
    LineProjector,
    Parts,
    ProjectedLines,
    concatenate_parts,
    points_on,
)
from gpuvision.simulation.transport.sheet_cut import SheetIndex, concatenated_ranges
from gpuvision.simulation.transport.slab_edges import (
    Levels,
    LineScale,
    Pieces,
    SlantedLimits,
    find_runs,
    intervals_to_divide,
    slanted_limits,
)
from gpuvision.simulation.transport.slabs import SlabImage, Slabs, concatenated_slabs, read_sub_sheets
from gpuvision.simulation.transport.specular_highlights import find_specular_highlights
from gpuvision.simulation.transport.surface_reflection import ReflectedPower, SurfaceReflection, mirrored_power

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

# Nodes of the two-point Gauss-Legendre rule on [0, 1].
_NODES = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
# Sheets that are computed together: bounds the memory.
_SHEETS = 36


@dataclass(frozen=True, kw_only=True)
class DirectLimits:
    """Numerical limits of `DirectLight`.

    Attributes
    ----------
    lobe_turn
        Turn of the half vector within a part of a line, in widths of the glossy lobe, beyond which the part is divided;
        chosen so that the two-point rule resolves the lobe.
    max_lobe_parts
        Largest number of these divisions of a part; bounds the work.
    tail_sigmas
        Range of the Gaussian that is deposited [sigmas]; derived: 3e-12 of the light lies beyond.
    edge_sigmas
        Range about the sheet's middle in which edges divide it [sigmas]; derived: 6e-5 of the light lies beyond.
    max_edges
        Largest number of edges that divide a sheet, the longest ones; bounds the work.
    edge_gap
        Least distance between two divisions [sigmas].
    max_divisions, max_levels
        Largest number of places per sheet at which it is divided where runs of the lit or visible line begin or end,
        and of levels that are computed to find them; they bound the work on rough surfaces, where errors of single
        edges average out. Chosen: an edge takes 8 levels.
    division_width
        Distance of two levels at which the search for such a place ends [sigmas]. Derived: half of it moves a reading
        of half a beam by 0.0016 sigma.
    outer_slab
        Place across the sheet beyond which the light is a separate slab, where an end of a run moves within the sheet
        [sigmas]; derived: 5e-4 of the light lies beyond.
    same_point
        Distance below which two lit points are one, as part of the largest coordinate; rounding with a wide margin.
    """

    lobe_turn: float = 0.5
    max_lobe_parts: int = 256
    tail_sigmas: float = 7.0
    edge_sigmas: float = 4.0
    max_edges: int = 16
    edge_gap: float = 1e-4
    max_divisions: int = 4
    max_levels: int = 32
    division_width: float = 0.005
    outer_slab: float = 3.5
    same_point: float = 1e-9


class _LitSheets(NamedTuple):
    """Lit segments of several sheets, moved to the sensor at transport 0; index of the sheet, and the motion [m]."""

    line: LitLine
    sheet: Integers
    moved: Float64

    def select(self, kept: npt.NDArray[np.bool_]) -> _LitSheets:
        """Return the segments of the sheets that ``kept`` (sheets,) marks, with new numbers of the sheets."""
        which = kept[self.sheet]
        return _LitSheets(self.line.select(which), (np.cumsum(kept) - 1)[self.sheet[which]], self.moved[which])


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectLight:
    """Light of a sheet that reaches a sensor by one reflection; compared by identity.

    Parameters
    ----------
    view
        The sensor.
    scene, materials
        Surfaces, and a material for every number in `Scene.material`.
    sheet
        Sheet of light, on the sensor's transport.
    sub_sheets
        Number of slabs that a thick sheet is divided into, 1 or more; a thick sheet is also divided at edges that lie
        in it, where the lit surface changes at once, and with 3 slabs or more where edges of shadows and surfaces cross
        it. Or the ascending positions, in sigmas, of all divisions: there are then no others. A thin sheet has one
        slab. Default 9.
    device
        Device on which visibility is computed; None: `Device.best`.
    ends
        (u_low, u_high), ends of the sensor in u where the view extends beyond them [sensor unit]; None: the view's.
    limits
        Numerical limits.

    Raises
    ------
    TypeError, ValueError
        A parameter has a wrong type or value; a triangle's material is missing.

    Notes
    -----
    The lit segments, their visible parts, and their division among samples and bins are exact to rounding. Within a
    part of a line that falls into one bin, the two-point Gauss-Legendre rule is used.

    The light of a slab is placed at the slab's mean and spread over the bins as a plane surface spreads it. So planes
    that end at edges along the sheet are exact for any number of slabs.

    Where a lit or visible stretch of the line ends within the sheet, light is cut off along the edge, with 3 slabs or
    more. The place of an edge nearly parallel to the sheet is found by bisection to 0.0025 sigma, and the sheet is
    divided there. An end that moves along the line by more than that is followed from level to level along straight
    lines, which is exact on planes. Measured for a sheet of 60 um sigma cut by a half plane: 0.2 um of range (12 um
    without the cuts). Not resolved: gaps narrower than the distance of the levels (half a sigma), edges that change
    their direction between two levels, and sheets cut by more than `DirectLimits.max_divisions` edges. There, and where
    the surface turns within a slab, the error is inversely proportional to the number of slabs. Explicit divisions, and
    1 or 2 slabs, have no cuts.

    Cost, as processor time of the direct light: 1.1 of that without cuts where no edge lies in the sheet, 1.6 for a box
    on a plate (1.0 and 1.13 of the time of all light; PoCL).

    Light from a mirror into the lens: the lens takes the rays that meet its aperture; a slab's light follows the ray of
    its mean. Triangles are plane mirrors.

    The x axis of an anisotropic lobe is the scene's x axis projected onto the surface (the y axis where the surface's
    normal is within 26 degrees of x).
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    sheet: LightSheet
    sub_sheets: int | Sequence[float] = 9
    device: Device | None = None
    ends: tuple[float, float] | None = None
    limits: DirectLimits = DirectLimits()
    _slabs: Slabs = field(init=False, repr=False)
    _visibility: LensVisibility = field(init=False, repr=False)
    _projector: LineProjector = field(init=False, repr=False)
    _reflection: SurfaceReflection = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_materials(self.scene, self.materials)
        if self.sheet.transport != self.view.transport:
            raise ValueError("DirectLight: sheet and view have different transports, expected the same one")
        if self.sheet.transport.bend is not None and any(each.mirror > 0.0 for each in self.materials):
            raise ValueError("a mirror in a bent sheet of light is not simulated: give a flat sheet, or no mirror")
        object.__setattr__(self, "_slabs", read_sub_sheets(self.sub_sheets if self.sheet.sigma > 0.0 else 1))
        object.__setattr__(self, "_projector", LineProjector(self.view))
        reflection = SurfaceReflection(view=self.view, scene=self.scene, materials=self.materials, sheet=self.sheet)
        object.__setattr__(self, "_reflection", reflection)
        device = Device.best() if self.device is None else self.device
        object.__setattr__(self, "_visibility", LensVisibility(scene=self.scene, device=device))

    def exposures(self, L: float, *, causes: bool = False) -> dict[str, Exposure]:
        """Return the light at a transport.

        Parameters
        ----------
        L
            Transport [m].
        causes
            Whether the light for the attribution of errors is returned as well.

        Returns
        -------
        dict of str to Exposure
            "direct": light off the diffuse parts of the surfaces. "specular": light off their glossy lobes, and from
            mirrors straight into the lens. With ``causes`` also the direct light if all surfaces were Lambertian of
            albedo 1 (`UNIFORM`), if nothing occluded the lens (`UNOCCLUDED`), and with both (`UNIFORM_UNOCCLUDED`).
        """
        found = self.exposures_of_profiles([L], causes=causes)
        return {name: Exposure(each.power[0], each.moment[0]) for name, each in found.items()}

    def exposures_of_profiles(self, transports: npt.ArrayLike, *, causes: bool = False) -> dict[str, Exposure]:
        """Return `exposures` at several transports [m], (profiles, samples, bins) each; faster than one by one."""
        places = np.atleast_1d(np.asarray(transports, np.float64))
        each = max(_SHEETS // len(self._slabs.share), 1)
        parts = [self._expose_profiles(places[k : k + each], causes) for k in range(0, max(len(places), 1), each)]
        return {
            name: Exposure(*(np.concatenate([part[name][n] for part in parts]) for n in (0, 1))) for name in parts[0]
        }

    def _expose_profiles(self, places: Float64, causes: bool) -> dict[str, Exposure]:
        slabs, profile, lit, parts, changes = self._divided_sheets(places, causes)
        lit = lit._replace(line=lit.line._replace(power=lit.line.power * slabs.share[lit.sheet]))
        image = SlabImage(self.view, slabs, profile, len(places), self.limits.tail_sigmas)
        found = self._expose(lit, image, parts, self._reflection.power, causes=causes)
        if changes:
            found |= self._expose_slanted(lit, image, parts, causes)
        if any(each.mirror > 0.0 for each in self.materials):
            found["specular"] += self._expose_highlights(lit, image)
        return found

    def _expose(
        self,
        lit: _LitSheets,
        image: SlabImage,
        parts: Parts,
        reflect: ReflectedPower,
        *,
        causes: bool = False,
        limits: tuple[Float64, Float64] | None = None,
    ) -> dict[str, Exposure]:
        """Return the exposures by parts of segments; limits across the sheet (m, 2) at the ends of each segment."""
        line, images = lit.line, self._projector.project(lit.line.ends, 0.0)
        parts = self._split(images.clip_to_view(parts), images, line)
        # Both nodes of all parts.
        arriving = (line.power * line.lengths)[parts.segment] * (parts.end - parts.start)
        share = (parts.start + _NODES[:, None] * (parts.end - parts.start)).ravel()
        segment, visible = np.tile(parts.segment, 2), np.tile(parts.visible, 2)
        points = points_on(line.ends[segment], share)
        sent = reflect(line, segment, points, np.tile(0.5 * arriving, 2))
        powers = {"direct": sent["diffuse"] * visible, "specular": sent["gloss"] * visible}
        if causes:
            powers |= {UNIFORM: sent["even"] * visible, UNOCCLUDED: sent["diffuse"], UNIFORM_UNOCCLUDED: sent["even"]}
        uv = images.image_points(segment, share)
        spread = np.zeros(len(share))
        if self.sheet.sigma > 0.0:
            spread = images.u_rates(segment, share, uv, self._shift_per_sigma(line.normals[segment], points))
        at_nodes = None
        if limits is not None:
            low, high = (_between(each[segment], share) for each in limits)
            at_nodes = (low, np.maximum(low, high))
        return image.deposit(uv, spread, lit.sheet[segment], powers, at_nodes)

    def _expose_highlights(self, lit: _LitSheets, image: SlabImage) -> Exposure:
        """Return the exposure by light that mirrors reflect straight into the lens."""
        line = lit.line
        shares = np.array([each.mirror for each in self.materials])[self._reflection.material_numbers(line)]
        parts = find_specular_highlights(line, self.sheet, self.view, 0.0)
        parts = parts.select(shares[parts.segment] > 0.0)
        of = parts.segment
        line = LitLine(parts.ends(line), line.normals[of], line.triangle[of], line.power[of] * shares[of])
        lit = _LitSheets(line, lit.sheet[of], lit.moved[of])
        return self._expose(lit, image, self._visible_parts(lit), mirrored_power)["specular"]

    def slabs(self, L: float) -> Slabs:
        """Return the slabs of the sheet at a transport L [m]."""
        sigma = self.sheet.sigma
        if sigma == 0.0 or not isinstance(self.sub_sheets, int):
            return self._slabs
        places, lengths = SheetIndex.of(self.scene, self.sheet.transport).parallel_edges
        limits = self.limits
        edge_range = slice(*np.searchsorted(places, [L - limits.edge_sigmas * sigma, L + limits.edge_sigmas * sigma]))
        longest = np.argsort(-lengths[edge_range], kind="stable")[: limits.max_edges]
        steps = np.sort((places[edge_range][longest] - L) / sigma)
        if not len(steps):
            return self._slabs
        cuts = self._slabs.high[:-1]
        far = np.abs(cuts[:, None] - steps).min(axis=1) > limits.edge_gap
        steps = steps[np.diff(steps, prepend=-np.inf) > limits.edge_gap]
        return Slabs.from_cuts(np.sort(np.append(cuts[far], steps)))

    # ---- edges within a thick sheet ----------------------------------------------------------------------------

    @property
    def _divides_at_edges(self) -> bool:
        return self.sheet.sigma > 0.0 and isinstance(self.sub_sheets, int) and self.sub_sheets > 2

    @functools.cached_property
    def _scale(self) -> LineScale:
        """Lengths on the line: the view's ends are infinite where a ray of it does not meet the sheet."""
        points = self.view.points_in_sheet(*np.meshgrid(self.view.u_edges, self.view.v_edges, indexing="ij"))
        x = self.sheet.ray_coordinates(self.view.sheet_coordinates(points))
        width = float(np.nanmedian(np.abs(np.diff(x, axis=1))))
        if not np.isfinite(x).all():
            return LineScale(self.sheet.sigma, width, -math.inf, math.inf)
        margin = self.limits.tail_sigmas * self.sheet.sigma
        return LineScale(self.sheet.sigma, width, float(x.min()) - margin, float(x.max()) + margin)

    def _across_transport(self, points: Float64) -> Float64:
        """Return the coordinates (G, H) (..., 2) [m] of points (..., 3) at any transport."""
        move = self.sheet.transport
        axes = np.linalg.inv(np.array([move.g_axis, move.h_axis, move.direction]))
        return np.asarray((points - np.array(move.origin)) @ axes[:, :2])

    def _light_sheets(self, places: Float64, profile: Integers, t: Float64, causes: bool) -> tuple[_LitSheets, Parts]:
        """Return the lit segments at places across the sheets of profiles [sigmas], and their parts in view."""
        lit = self._illuminate(places[profile] + self.sheet.sigma * t, places[profile])
        return lit, self._visible_parts(lit, with_hidden=causes)

    def _divided_sheets(self, places: Float64, causes: bool) -> tuple[Slabs, Integers, _LitSheets, Parts, bool]:
        """Return the slabs of all profiles, the profile of each, their lit segments, the segments' parts, and changes.

        The last value says whether a line changes from level to level. Sheets are divided where the lit or visible line
        changes at once. Two more levels at either side, beyond the outermost slabs, find edges there. Without such an
        edge the levels of the slabs are computed only once.
        """
        by_profile = [self.slabs(float(L)) for L in places]
        if not (self._divides_at_edges and by_profile):
            slabs, profile = concatenated_slabs(by_profile)
            return slabs, profile, *self._light_sheets(places, profile, slabs.middle, causes), False
        extended = [each.with_outer(self.limits.outer_slab) for each in by_profile]
        slabs, profile = concatenated_slabs(extended)
        lit, parts = self._light_sheets(places, profile, slabs.middle, causes)
        levels = Levels(slabs.middle, profile, self._lines(lit, parts, causes))
        moving, jumps = self._changes(places, levels, by_profile, causes)
        if not any(len(each) for each in jumps):
            # The levels of the slabs are known; where nothing moves, the outer slabs are not needed.
            outer = np.concatenate([np.arange(len(each.share)) % (len(each.share) - 1) == 0 for each in extended])
            kept = ~outer | moving[profile]
            used = [large if moves else own for large, own, moves in zip(extended, by_profile, moving, strict=True)]
            segment = np.cumsum(kept[lit.sheet]) - 1
            parts = parts.select(kept[lit.sheet[parts.segment]])
            parts = parts._replace(segment=segment[parts.segment])
            return *concatenated_slabs(used), lit.select(kept), parts, bool(moving.any())
        divided = []
        for slabs, found in zip(extended, jumps, strict=True):
            cuts = slabs.high[:-1]
            far = np.abs(cuts[:, None] - found).min(axis=1, initial=np.inf) > self.limits.edge_gap
            divided.append(Slabs.from_cuts(np.sort(np.append(cuts[far], found))))
        slabs, profile = concatenated_slabs(divided)
        return slabs, profile, *self._light_sheets(places, profile, slabs.middle, causes), True

    def _changes(
        self, places: Float64, levels: Levels, by_profile: list[Slabs], causes: bool
    ) -> tuple[npt.NDArray[np.bool_], list[Float64]]:
        """Return whether ends of runs move within each profile's sheet, and where runs begin or end at once [sigmas].

        The search halves the distance between two levels whose runs differ.
        """
        limits, width = self.limits, self._scale.width
        smallest = limits.division_width
        # Edges that lie in the sheet: the slabs end there already.
        known = [np.setdiff1d(each.high[:-1], self._slabs.high[:-1]) for each in by_profile]
        moving, added = np.zeros(len(places), bool), np.zeros(len(places), np.int64)
        while True:
            runs = levels.runs(self._scale)
            after = intervals_to_divide(runs, levels.place, levels.profile, smallest, limits.max_divisions, width)
            for each in runs:
                moving[levels.profile[each.moves]] = True
            after = after[added[levels.profile[after]] < limits.max_levels]
            if not len(after):
                break
            place, profile = [], []
            for k in after:
                low, high, of = levels.place[k], levels.place[k + 1], int(levels.profile[k])
                beside = known[of][:, None] + 0.25 * smallest * np.array([-1.0, 1.0])
                beside = beside[(beside > low) & (beside < high)]
                at = np.unique(beside) if len(beside) else np.array([0.5 * (low + high)])
                place.append(at)
                profile.append(np.full(len(at), of))
            new_place, new_profile = np.concatenate(place), np.concatenate(profile)
            added += np.bincount(new_profile, minlength=len(places))
            lines = self._lines(*self._light_sheets(places, new_profile, new_place, causes), causes)
            levels = levels.joined(Levels(new_place, new_profile, lines))
        step = np.append(np.diff(levels.place), np.inf)
        open_ = np.max([each.open_length for each in runs], axis=0) > 0.0
        found = np.flatnonzero(open_ & (step > 0.0) & (step <= smallest))
        at, in_profile = levels.place[found] + 0.5 * step[found], levels.profile[found]
        jumps = []
        for n, cuts in enumerate(known):
            mine = at[in_profile == n]
            jumps.append(mine[np.abs(mine[:, None] - cuts).min(axis=1, initial=np.inf) > smallest])
        return moving, jumps

    def _lines(self, lit: _LitSheets, parts: Parts, causes: bool) -> tuple[Pieces, ...]:
        """Return the visible line at each level, and with ``causes`` the lit line."""
        shown = self._pieces(lit, parts.select(parts.visible))
        return (shown, self._pieces(lit, _whole(lit.line))) if causes else (shown,)

    def _pieces(self, lit: _LitSheets, parts: Parts) -> Pieces:
        """Return parts of segments as pieces of lines, in their order."""
        ends = parts.ends(lit.line)
        place = self._across_transport(ends)
        x, height = self.sheet.ray_coordinates(place), place[..., 1]
        backward = (x[:, 1] < x[:, 0])[:, None]
        x, height = np.where(backward, x[:, ::-1], x), np.where(backward, height[:, ::-1], height)
        shift = self._shift_per_sigma(lit.line.normals[parts.segment], ends.mean(axis=1))
        rate = self._across_transport(ends[:, 0] + shift)[:, 1] - place[:, 0, 1]
        kind = self._reflection.material_numbers(lit.line)[parts.segment].astype(np.int64)
        return Pieces(lit.sheet[parts.segment], x, height, rate, kind)

    def _expose_slanted(self, lit: _LitSheets, image: SlabImage, parts: Parts, causes: bool) -> dict[str, Exposure]:
        """Return the exposures that change because ends of runs move from slab to slab; empty if there are none."""
        found: dict[str, Exposure] = {}
        slabs, scale = image.slabs, self._scale
        shown = parts.select(parts.visible)
        lines = [(shown, ["direct", "specular", UNIFORM] if causes else ["direct", "specular"])]
        if causes:
            lines.append((_whole(lit.line), [UNOCCLUDED, UNIFORM_UNOCCLUDED]))
        for mine, names in lines:
            pieces = self._pieces(lit, mine)
            runs = find_runs(pieces, slabs.middle, image.profile, scale)
            slanted = slanted_limits(pieces, runs, slabs.middle, slabs.low, slabs.high, scale.width)
            if not len(slanted.piece):
                continue
            lit_parts, limits, all_parts = self._with_limits(lit, mine, slanted, slabs)
            exposed = self._expose(lit_parts, image, all_parts, self._reflection.power, causes=causes, limits=limits)
            found |= {name: exposed[name] for name in names}
        return found

    def _with_limits(
        self, lit: _LitSheets, parts: Parts, slanted: SlantedLimits, slabs: Slabs
    ) -> tuple[_LitSheets, tuple[Float64, Float64], Parts]:
        """Return the segments with additional ones for slanted parts, limits of all segments (m, 2), and the parts."""
        line, of = lit.line, parts.segment[slanted.piece]
        ends = parts.ends(line)[slanted.piece]
        place = self._across_transport(ends)
        x = self.sheet.ray_coordinates(place)
        share = np.stack([slanted.start, slanted.end], axis=1)
        low, high = slanted.low, slanted.high
        backward = (x[:, 1] < x[:, 0])[:, None]
        share = np.where(backward, 1.0 - share[:, ::-1], share)
        low, high = (np.where(backward, each[:, ::-1], each) for each in (low, high))
        if self.sheet.source is not None:
            # From a fraction of x to a fraction of the segment, which are projectively related.
            near, far = (self.sheet.source[1] - place[:, n, 1] for n in (0, 1))
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
        added = _whole(more)
        added = added._replace(segment=added.segment + len(line.power))
        return (
            _LitSheets(joined, sheet, np.concatenate([lit.moved, lit.moved[of]])),
            (all_limits[0], all_limits[1]),
            concatenate_parts([parts.select(rest), added]),
        )

    def truth(self, L: float) -> GroundTruth:
        """Return the true position of the sheet's middle at a transport L [m], at the middle of each sample.

        The position belongs to a lit point that is visible from the lens and imaged on the sensor. Status: LOW_SIGNAL,
        there is no such point; OUT_OF_RANGE, the point is imaged beyond the sensor's ends in u, and is given only if
        it is in the view (see ``ends``); AMBIGUOUS, there are several, and the one with the most light is given.
        """
        found = self.truths_of_profiles([L])
        return GroundTruth(found.g[0], found.h[0], found.status[0])

    def truths_of_profiles(self, transports: npt.ArrayLike) -> GroundTruth:
        """Return `truth` at several transports [m], (profiles, samples); faster than one by one."""
        view, places = self.view, np.atleast_1d(np.asarray(transports, np.float64))
        lit = self._illuminate(places, places)
        line, images = lit.line, self._projector.project(lit.line.ends, 0.0)
        parts = images.clip_to_view(self._visible_parts(lit))
        v = images.image_points(parts.segment, np.stack([parts.start, parts.end]))[..., 1]
        low, high = v.min(axis=0), v.max(axis=0)
        # Half-open intervals: a sample whose middle lies on the border of two parts belongs to one of them.
        first = np.searchsorted(view.v_centres, low, side="left")
        count = np.maximum(np.searchsorted(view.v_centres, high, side="left") - first, 0)
        owner, sample = np.repeat(np.arange(len(count)), count), concatenated_ranges(first, count)
        mine = parts.select(owner)
        share = images.fractions_at(mine, view.v_centres[sample], 1)
        points = points_on(line.ends[mine.segment], share)
        u = images.image_points(mine.segment, share)[:, 0]
        low_u, high_u = (view.u_edges[0], view.u_edges[-1]) if self.ends is None else self.ends
        on = (u >= low_u) & (u <= high_u)
        in_view = on | ((u >= view.u_edges[0]) & (u <= view.u_edges[-1]))
        light = (line.power * line.lengths)[mine.segment] * (mine.end - mine.start) / (high - low)[owner]
        slot = lit.sheet[mine.segment] * view.samples + sample
        positions, same = view.sheet_coordinates(points), self.limits.same_point
        found = strongest_points(len(places) * view.samples, slot, positions, on, in_view, light, same)
        return GroundTruth(*(each.reshape(len(places), view.samples) for each in found))

    def _illuminate(self, sheets: Float64, transports: Float64) -> _LitSheets:
        """Return the segments that sheets light on the side that the lens can see, each in a profile at a transport."""
        line, first = self.sheet.illuminate_all(self.scene, sheets)
        sheet = np.repeat(np.arange(len(sheets)), np.diff(first))
        moved = transports[sheet, None] * np.array(self.sheet.transport.direction)
        ends = line.ends - moved[:, None]
        towards = np.array(self.view.lens) - ends[:, 0]
        which = np.flatnonzero(np.sum(line.normals * towards, axis=1) > 0.0)
        return _LitSheets(line._replace(ends=ends).select(which), sheet[which], moved[which])

    def _visible_parts(self, lit: _LitSheets, *, with_hidden: bool = False) -> Parts:
        line = lit.line._replace(ends=lit.line.ends + lit.moved[:, None])
        return self._visibility.visible_parts(line, np.array(self.view.lens) + lit.moved, with_hidden=with_hidden)

    def _split(self, parts: Parts, images: ProjectedLines, line: LitLine) -> Parts:
        """Split parts at the edges of samples and bins, and where a lobe changes much."""
        u_edges = self.view.u_edges
        if self.sheet.sigma > 0.0:
            # A thick sheet spreads light onto the sensor from points that are imaged beyond its ends.
            u_edges = np.concatenate([[-np.inf], u_edges, [np.inf]])
        parts = images.split_at_edges(images.split_at_edges(parts, self.view.v_edges, 1), u_edges, 0)
        return self._reflection.split_lobes(
            parts, line, lobe_turn=self.limits.lobe_turn, max_parts=self.limits.max_lobe_parts
        )

    def _shift_per_sigma(self, normal: Float64, points: Float64) -> Float64:
        """Return the motion of lit points over their planes (n, 3) [m] as the sheet moves by one sigma."""
        direction, light = np.array(self.sheet.transport.direction), self.sheet.direction_to_light(points)
        slope = (normal @ direction) / np.sum(normal * light, axis=1)
        return np.asarray(self.sheet.sigma * (direction - light * slope[:, None]))


def _whole(line: LitLine) -> Parts:
    """Return the whole segments of a line as parts."""
    count = len(line.power)
    return Parts(np.arange(count), np.zeros(count), np.ones(count), np.ones(count, bool))


def _between(ends: Float64, share: Float64) -> Float64:
    """Return values at fractions between both ends (n, 2); exact where the ends are equal, also if infinite."""
    start, end = ends.T
    same = start == end
    change = np.subtract(end, start, out=np.zeros_like(start), where=~same)
    return np.asarray(np.where(same, start, np.where(same, 0.0, start) + share * change))
