"""Direct light: from the sheet to a surface to the lens, and the true position of the lit line."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

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
from gpuvision.simulation.transport.line_parts import LineProjector, Parts, ProjectedLines, points_on
from gpuvision.simulation.transport.lit_sheets import LitSheets, SheetLighting
from gpuvision.simulation.transport.sheet_cut import concatenated_ranges
from gpuvision.simulation.transport.sheet_division import DividedSheets, DivisionLimits, SheetDivision
from gpuvision.simulation.transport.slabs import SlabImage, Slabs, read_sub_sheets
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
        chosen so that the two-point rule resolves the lobe. Default 0.5.
    max_lobe_parts
        Largest number of these divisions of a part; bounds the work. Default 256.
    tail_sigmas
        Range of the Gaussian that is deposited [sigmas]; derived: 3e-12 of the light lies beyond. Default 7.0.
    same_point
        Distance below which two lit points are one, as part of the largest coordinate; rounding with a wide margin.
        Default 1e-9.
    """

    lobe_turn: float = 0.5
    max_lobe_parts: int = 256
    tail_sigmas: float = 7.0
    same_point: float = 1e-9


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
    limits, division_limits
        Numerical limits of the light, and of the division of a thick sheet.

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
    their direction between two levels, and sheets cut by more than `DivisionLimits.max_divisions` edges. There, and
    where the surface turns within a slab, the error is inversely proportional to the number of slabs. Explicit
    divisions, and 1 or 2 slabs, have no cuts.

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
    division_limits: DivisionLimits = DivisionLimits()
    _lighting: SheetLighting = field(init=False, repr=False)
    _reflection: SurfaceReflection = field(init=False, repr=False)
    _division: SheetDivision = field(init=False, repr=False)
    _projector: LineProjector = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_materials(self.scene, self.materials)
        if self.sheet.transport != self.view.transport:
            raise ValueError("DirectLight: sheet and view have different transports, expected the same one")
        if self.sheet.transport.bend is not None and any(each.mirror > 0.0 for each in self.materials):
            raise ValueError("a mirror in a bent sheet of light is not simulated: give a flat sheet, or no mirror")
        is_thick = self.sheet.sigma > 0.0
        uniform = read_sub_sheets(self.sub_sheets if is_thick else 1)
        reflection = SurfaceReflection(view=self.view, scene=self.scene, materials=self.materials, sheet=self.sheet)
        device = Device.best() if self.device is None else self.device
        lighting = SheetLighting(view=self.view, scene=self.scene, sheet=self.sheet, device=device)
        division = SheetDivision(
            lighting=lighting,
            reflection=reflection,
            uniform=uniform,
            at_surface_edges=is_thick and isinstance(self.sub_sheets, int),
            at_run_ends=is_thick and isinstance(self.sub_sheets, int) and self.sub_sheets > 2,
            tail_sigmas=self.limits.tail_sigmas,
            limits=self.division_limits,
        )
        object.__setattr__(self, "_lighting", lighting)
        object.__setattr__(self, "_reflection", reflection)
        object.__setattr__(self, "_division", division)
        object.__setattr__(self, "_projector", LineProjector(self.view))

    def exposures(self, L: float, *, causes: bool = False) -> dict[str, Exposure]:
        """Return the light at a transport.

        Parameters
        ----------
        L
            Transport [m].
        causes
            Whether the light for the attribution of errors is returned as well. Default False.

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
        each = max(_SHEETS // len(self._division.uniform.share), 1)
        parts = [self._expose_profiles(places[k : k + each], causes) for k in range(0, max(len(places), 1), each)]
        return {
            name: Exposure(*(np.concatenate([part[name][n] for part in parts]) for n in (0, 1))) for name in parts[0]
        }

    def slabs(self, L: float) -> Slabs:
        """Return the slabs of the sheet at a transport L [m], divided at edges of surfaces that lie in it."""
        return self._division.slabs(L)

    def _expose_profiles(self, places: Float64, causes: bool) -> dict[str, Exposure]:
        """Return the exposures (profiles, samples, bins) at transports (profiles,) [m]."""
        sheets = self._division.divide(places, causes)
        lit, slabs = sheets.lit, sheets.slabs
        lit = lit._replace(line=lit.line._replace(power=lit.line.power * slabs.share[lit.sheet]))
        image = SlabImage(self.view, slabs, sheets.profile, len(places), self.limits.tail_sigmas)
        found = self._expose(lit, image, sheets.parts, self._reflection.power, causes=causes)
        if sheets.line_changes:
            found |= self._expose_slanted(sheets._replace(lit=lit), image, causes)
        if any(each.mirror > 0.0 for each in self.materials):
            found["specular"] += self._expose_highlights(lit, image)
        return found

    def _expose_slanted(self, sheets: DividedSheets, image: SlabImage, causes: bool) -> dict[str, Exposure]:
        """Return the exposures that change because ends of runs move from slab to slab; empty if no end moves."""
        found: dict[str, Exposure] = {}
        visible = ["direct", "specular", UNIFORM] if causes else ["direct", "specular"]
        names = {"visible": visible, "lit": [UNOCCLUDED, UNIFORM_UNOCCLUDED]}
        for each in self._division.slanted_parts(sheets, causes):
            exposed = self._expose(
                each.lit, image, each.parts, self._reflection.power, causes=causes, limits=each.limits
            )
            found |= {name: exposed[name] for name in names[each.line]}
        return found

    def _expose(
        self,
        lit: LitSheets,
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
            spread = images.u_rates(segment, share, uv, self._lighting.shift_per_sigma(line.normals[segment], points))
        at_nodes = None
        if limits is not None:
            low, high = (_between(each[segment], share) for each in limits)
            at_nodes = (low, np.maximum(low, high))
        return image.deposit(uv, spread, lit.sheet[segment], powers, at_nodes)

    def _expose_highlights(self, lit: LitSheets, image: SlabImage) -> Exposure:
        """Return the exposure by light that mirrors reflect straight into the lens."""
        line = lit.line
        shares = np.array([each.mirror for each in self.materials])[self._reflection.material_numbers(line)]
        parts = find_specular_highlights(line, self.sheet, self.view, 0.0)
        parts = parts.select(shares[parts.segment] > 0.0)
        of = parts.segment
        line = LitLine(parts.ends(line), line.normals[of], line.triangle[of], line.power[of] * shares[of])
        lit = LitSheets(line, lit.sheet[of], lit.moved[of])
        return self._expose(lit, image, self._lighting.visible_parts(lit), mirrored_power)["specular"]

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
        lit = self._lighting.illuminate(places, places)
        line, images = lit.line, self._projector.project(lit.line.ends, 0.0)
        parts = images.clip_to_view(self._lighting.visible_parts(lit))
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


def _between(ends: Float64, share: Float64) -> Float64:
    """Return values at fractions between both ends (n, 2); exact where the ends are equal, also if infinite."""
    start, end = ends.T
    same = start == end
    change = np.subtract(end, start, out=np.zeros_like(start), where=~same)
    return np.asarray(np.where(same, start, np.where(same, 0.0, start) + share * change))
