"""The direct light: from the sheet to a surface to the lens. What a sensor is meant to see, and the truth about it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Brdf, Ggx, Lambert, Phong, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import UNIFORM, UNIFORM_UNOCCLUDED, UNOCCLUDED, GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.sensors.view_rays import check_materials
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_parts import Images, LineImages, LineOfSight, Parts, along
from gpuvision.simulation.transport.sheet_cut import SheetIndex, ranges
from gpuvision.simulation.transport.specular_highlights import specular_highlights
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
# Power on the sensor [W] by kind of reflection, of light that arrives at points of segments [W].
Sender = Callable[[LitLine, Integers, Float64, Float64], dict[str, Float64]]

# Gauss and Legendre's two nodes on [0, 1].
_NODES = 0.5 + np.array([-0.5, 0.5]) / math.sqrt(3.0)
# How far a lobe's half way vector may turn within a part, in widths of the lobe, and into how many parts at most.
_TURN, _TURNS = 0.5, 256
# A Gaussian's light beyond so many sigmas, 1e-12, is not sought.
_BEYOND = 7.0
# Edges in the sheet, within so many sigmas, cut it; the longest so many; those so many sigmas apart.
_REACH, _STEPS, _APART = 4.0, 16, 1e-4
# Sheets that are looked at in one go.
_SHEETS = 36
# Of the largest coordinate: nearer than that, two lit places are one.
_SAME = 1e-9


class Slabs(NamedTuple):
    """Slabs of a sheet with a Gaussian across, in its sigmas.

    Attributes
    ----------
    low, high
        (n,): where each begins and ends; the first and the last have no end.
    share
        (n,): of the light.
    middle
        (n,): where the light of a slab lies in the mean.
    """

    low: Float64
    high: Float64
    share: Float64
    middle: Float64

    @classmethod
    def between(cls, cuts: npt.ArrayLike) -> Slabs:
        """Return the slabs that ascending cuts make, one more than there are cuts."""
        cuts = np.asarray(cuts, np.float64)
        low, high = np.append(-np.inf, cuts), np.append(cuts, np.inf)
        share = _between(low, high)
        return cls(low, high, share, np.clip((_bell(low) - _bell(high)) / share, low, high))

    @classmethod
    def of(cls, count: int) -> Slabs:
        """Return so many slabs, all but the outer ones of one width."""
        # What the outer ones hold falls with their number as an inner one's width does.
        reach = math.sqrt(2.0 * math.log(count)) if count > 2 else 0.0
        return cls.between(np.linspace(-reach, reach, count - 1))


class _Lit(NamedTuple):
    """Lit segments moved to before the sensor at transport 0, the sheets they are in, and how far they lie."""

    line: LitLine
    sheet: Integers
    moved: Float64


class _Image(NamedTuple):
    """Where light is deposited: slabs, each of one of so many profiles."""

    view: SensorView
    slabs: Slabs
    profile: Integers
    profiles: int

    def of(self, uv: Float64, spread: Float64, slab: Integers, lights: Mapping[str, Float64]) -> dict[str, Exposure]:
        """Return exposures by spots of slabs' light: their means at (u, v), spread by so much along u a sigma."""
        view, slabs = self.view, self.slabs
        sample = view.sample_of(uv[:, 1])
        on = np.flatnonzero(sample >= 0)
        sample, u, slab = sample[on], uv[on, 0], slab[on]
        least = 1e-9 * float(np.diff(view.u_edges).min())
        spread = np.where(np.abs(spread[on]) < least, least, spread[on])
        low, high, middle = slabs.low[slab], slabs.high[slab], slabs.middle[slab]
        reach = u + spread * (np.clip([low, high], -_BEYOND, _BEYOND) - middle)
        first = np.maximum(np.searchsorted(view.u_edges, reach.min(axis=0), side="right") - 1, 0)
        last = np.minimum(np.searchsorted(view.u_edges, reach.max(axis=0), side="left"), view.bins)
        count = np.maximum(last - first, 0)
        of, place = np.repeat(np.arange(len(u)), count), ranges(first, count)
        # The edges of the bins in sigmas of the sheet.
        ends = middle[of] + (np.stack([view.u_edges[place], view.u_edges[place + 1]]) - u[of]) / spread[of]
        ends = np.clip(np.sort(ends, axis=0), low[of], high[of])
        share = _between(*ends)
        moment = (u - spread * middle)[of] - view.u_centres[place]
        moment = moment * share + spread[of] * (_bell(ends[0]) - _bell(ends[1]))
        row = self.profile[slab] * view.samples + sample
        at, per = row[of] * view.bins + place, 1.0 / slabs.share[slab[of]]
        shape = (self.profiles, view.samples, view.bins)
        made = {}
        for name, power in lights.items():
            here = power[on][of] * per
            sums = [np.bincount(at, here * each, minlength=math.prod(shape)) for each in (share, moment)]
            made[name] = Exposure(*(np.asarray(each, np.float64).reshape(shape) for each in sums))
        return made


@dataclass(frozen=True, kw_only=True, eq=False)
class DirectLight:
    """Light of a sheet that comes to a sensor straight from what it lights; compared by identity.

    Parameters
    ----------
    view
        The sensor.
    scene, materials
        What is lit; a material for every number in `Scene.material`.
    sheet
        The light.
    sub_sheets
        A thick sheet is taken as so many slabs, and is cut also where an edge of the surface lies in it from end to
        end: there what it lights changes at once. Or the places in sigmas at which it is cut, and no others. A thin
        sheet has one.
    device
        Where visibility is found; None: `Device.best`.

    Raises
    ------
    TypeError, ValueError
        A parameter is not what is said here; a triangle's material is missing.

    Notes
    -----
    What is lit, and what of it the lens sees, is exact but for rounding; so is the division of light among samples and
    bins. Within a part of a line that falls into one bin, two Gauss nodes are taken.

    A slab's light is where the slab's mean is, and is spread over the bins as the surface there, thought plane, spreads
    it. So planes that end at edges along the sheet are exact whatever the number of slabs; where the surface, its
    material or its shadow change within a slab, across it or hidden from the lens, the error falls as one over the
    number of slabs.

    Of a mirror, the lens takes the rays that meet its opening; a slab's light goes where its middle goes. Triangles are
    plane mirrors.

    The x axis of an anisotropic lobe is the scene's x axis laid onto the surface (y, on one that x stands on).
    """

    view: SensorView
    scene: Scene
    materials: Sequence[Material]
    sheet: LightSheet
    sub_sheets: int | Sequence[float] = 9
    device: Device | None = None
    _slabs: Slabs = field(init=False, repr=False)
    _line_of_sight: LineOfSight = field(init=False, repr=False)
    _images: Images = field(init=False, repr=False)

    def __post_init__(self) -> None:
        check_materials(self.scene, self.materials)
        if self.sheet.transport != self.view.transport:
            raise ValueError("DirectLight: sheet and view have different transports, expected the same one")
        object.__setattr__(self, "_slabs", _slabs(self.sub_sheets if self.sheet.sigma > 0.0 else 1))
        object.__setattr__(self, "_images", Images(self.view))
        device = Device.best() if self.device is None else self.device
        object.__setattr__(self, "_line_of_sight", LineOfSight(scene=self.scene, device=device))

    def exposures(self, L: float, *, causes: bool = False) -> dict[str, Exposure]:
        """Return the light at a transport L [m]: "direct" and "specular".

        Direct light comes off the surfaces' diffuse parts, specular light off their lobes, and off mirrors right into
        the lens. With ``causes``, also what the direct light would be if all surfaces were white ones of Lambert
        (`UNIFORM`), if nothing were in the way to the lens (`UNOCCLUDED`), and both (`UNIFORM_UNOCCLUDED`).
        """
        found = self.exposures_along([L], causes=causes)
        return {name: Exposure(each.power[0], each.moment[0]) for name, each in found.items()}

    def exposures_along(self, transports: npt.ArrayLike, *, causes: bool = False) -> dict[str, Exposure]:
        """Return `exposures` of several profiles, (profiles, samples, bins) each: faster than one by one."""
        places = np.atleast_1d(np.asarray(transports, np.float64))
        each = max(_SHEETS // len(self._slabs.share), 1)
        parts = [self._some_exposures(places[k : k + each], causes) for k in range(0, max(len(places), 1), each)]
        return {
            name: Exposure(*(np.concatenate([part[name][n] for part in parts]) for n in (0, 1))) for name in parts[0]
        }

    def _some_exposures(self, places: Float64, causes: bool) -> dict[str, Exposure]:
        by_profile = [self.slabs(float(L)) for L in places]
        profile = np.repeat(np.arange(len(places)), [len(each.share) for each in by_profile])
        columns = zip(*by_profile, strict=True) if by_profile else ([], [], [], [])
        slabs = Slabs(*(np.concatenate([*each, np.zeros(0)]) for each in columns))
        lit = self._lit(places[profile] + self.sheet.sigma * slabs.middle, places[profile])
        lit = lit._replace(line=lit.line._replace(power=lit.line.power * slabs.share[lit.sheet]))
        image = _Image(self.view, slabs, profile, len(places))
        found = self._exposed(lit, image, self._visible(lit, hidden=causes), self._sent, causes=causes)
        if any(each.mirror > 0.0 for each in self.materials):
            found["specular"] += self._mirrored(lit, image)
        return found

    def _exposed(
        self, lit: _Lit, image: _Image, parts: Parts, sent_by: Sender, *, causes: bool = False
    ) -> dict[str, Exposure]:
        """Return the exposures by parts of segments."""
        line, images = lit.line, self._images.of(lit.line.ends, 0.0)
        parts = self._split(images.in_view(parts), images, line)
        # Both nodes of all parts.
        arriving = (line.power * line.lengths)[parts.segment] * (parts.end - parts.start)
        share = (parts.start + _NODES[:, None] * (parts.end - parts.start)).ravel()
        segment, seen = np.tile(parts.segment, 2), np.tile(parts.seen, 2)
        points = along(line.ends[segment], share)
        sent = sent_by(line, segment, points, np.tile(0.5 * arriving, 2))
        wanted = {"direct": sent["diffuse"] * seen, "specular": sent["gloss"] * seen}
        if causes:
            wanted |= {UNIFORM: sent["even"] * seen, UNOCCLUDED: sent["diffuse"], UNIFORM_UNOCCLUDED: sent["even"]}
        uv = images.at(segment, share)
        spread = np.zeros(len(share))
        if self.sheet.sigma > 0.0:
            spread = images.speed(segment, share, uv, self._moved(line.normals[segment], points))
        return image.of(uv, spread, lit.sheet[segment], wanted)

    def _mirrored(self, lit: _Lit, image: _Image) -> Exposure:
        """Return what mirrors throw right into the lens."""
        line = lit.line
        shares = np.array([each.mirror for each in self.materials])[self._material(line)]
        parts = specular_highlights(line, self.sheet, self.view, 0.0)
        parts = parts.those(shares[parts.segment] > 0.0)
        of = parts.segment
        line = LitLine(parts.ends(line), line.normals[of], line.triangle[of], line.power[of] * shares[of])
        lit = _Lit(line, lit.sheet[of], lit.moved[of])
        return self._exposed(lit, image, self._visible(lit), _all_of_it)["specular"]

    def slabs(self, L: float) -> Slabs:
        """Return the slabs of the sheet at a transport L [m]."""
        sigma = self.sheet.sigma
        if sigma == 0.0 or not isinstance(self.sub_sheets, int):
            return self._slabs
        places, lengths = SheetIndex.of(self.scene, self.sheet.transport).steps
        near = slice(*np.searchsorted(places, [L - _REACH * sigma, L + _REACH * sigma]))
        longest = np.argsort(-lengths[near], kind="stable")[:_STEPS]
        steps = np.sort((places[near][longest] - L) / sigma)
        if not len(steps):
            return self._slabs
        cuts = self._slabs.high[:-1]
        far = np.abs(cuts[:, None] - steps).min(axis=1) > _APART
        steps = steps[np.diff(steps, prepend=-np.inf) > _APART]
        return Slabs.between(np.sort(np.append(cuts[far], steps)))

    def truth(self, L: float) -> GroundTruth:
        """Return where the middle of the sheet truly is at a transport L [m], at the middle of each sample.

        What is lit and visible there and imaged on the sensor. Status: LOW_SIGNAL, there is none; OUT_OF_RANGE, it is
        imaged beyond the sensor's ends in u, and not given; AMBIGUOUS, there are several: the one with the most light
        is given.
        """
        found = self.truths_along([L])
        return GroundTruth(found.g[0], found.h[0], found.status[0])

    def truths_along(self, transports: npt.ArrayLike) -> GroundTruth:
        """Return `truth` of several profiles, (profiles, samples): faster than one by one."""
        view, places = self.view, np.atleast_1d(np.asarray(transports, np.float64))
        lit = self._lit(places, places)
        line, images = lit.line, self._images.of(lit.line.ends, 0.0)
        parts = images.in_view(self._visible(lit))
        v = images.at(parts.segment, np.stack([parts.start, parts.end]))[..., 1]
        low, high = v.min(axis=0), v.max(axis=0)
        # Half open, so that of two parts that touch one has the sample.
        first = np.searchsorted(view.v_centres, low, side="left")
        count = np.maximum(np.searchsorted(view.v_centres, high, side="left") - first, 0)
        owner, sample = np.repeat(np.arange(len(count)), count), ranges(first, count)
        mine = parts.those(owner)
        share = images.where(mine, view.v_centres[sample], 1)
        points = along(line.ends[mine.segment], share)
        u = images.at(mine.segment, share)[:, 0]
        on = (u >= view.u_edges[0]) & (u <= view.u_edges[-1])
        light = (line.power * line.lengths)[mine.segment] * (mine.end - mine.start) / (high - low)[owner]
        slot = lit.sheet[mine.segment] * view.samples + sample
        found = _chosen(len(places) * view.samples, slot, view.sheet_coordinates(points), on, light)
        return GroundTruth(*(each.reshape(len(places), view.samples) for each in found))

    def _lit(self, sheets: Float64, transports: Float64) -> _Lit:
        """Return what sheets light on the side that the lens can see, each in a profile at a transport."""
        line, first = self.sheet.lit_lines(self.scene, sheets)
        sheet = np.repeat(np.arange(len(sheets)), np.diff(first))
        moved = transports[sheet, None] * np.array(self.sheet.transport.direction)
        ends = line.ends - moved[:, None]
        towards = np.array(self.view.lens) - ends[:, 0]
        which = np.flatnonzero(np.sum(line.normals * towards, axis=1) > 0.0)
        return _Lit(line._replace(ends=ends).those(which), sheet[which], moved[which])

    def _visible(self, lit: _Lit, *, hidden: bool = False) -> Parts:
        line = lit.line._replace(ends=lit.line.ends + lit.moved[:, None])
        return self._line_of_sight.parts(line, np.array(self.view.lens) + lit.moved, hidden=hidden)

    def _split(self, parts: Parts, images: LineImages, line: LitLine) -> Parts:
        """Split parts at the edges of samples and bins, and where a lobe changes much."""
        u_edges = self.view.u_edges
        if self.sheet.sigma > 0.0:
            # Light is spread onto the sensor from beyond its ends.
            u_edges = np.concatenate([[-np.inf], u_edges, [np.inf]])
        parts = images.split(images.split(parts, self.view.v_edges, 1), u_edges, 0)
        return self._split_lobes(parts, line)

    def _split_lobes(self, parts: Parts, line: LitLine) -> Parts:
        """Split parts on glossy surfaces until the half way vector turns little within each."""
        widths = np.array([math.inf if each.gloss is None else _width(each.gloss) for each in self.materials])
        if np.isinf(widths).all():
            return parts
        width = widths[self._material(line)][parts.segment]
        ends = parts.ends(line)
        half_way = _unit(self.sheet.towards(ends) + _unit(np.array(self.view.lens) - ends))
        turn = np.linalg.norm(half_way[:, 1] - half_way[:, 0], axis=1) / width
        count = np.clip(np.ceil(turn / _TURN), 1, _TURNS).astype(np.int64)
        owner, number = np.repeat(np.arange(len(count)), count), ranges(np.zeros_like(count), count)
        size = ((parts.end - parts.start) / count)[owner]
        start = parts.start[owner] + number * size
        return parts.those(owner)._replace(start=start, end=start + size)

    def _material(self, line: LitLine) -> npt.NDArray[np.int32]:
        assert self.scene.material is not None  # set by Scene itself
        return self.scene.material[line.triangle]

    def _sent(self, line: LitLine, segment: Integers, points: Float64, arriving: Float64) -> dict[str, Float64]:
        """Return power on the sensor [W] of light that arrives at points [W], by kind of reflection."""
        normal = line.normals[segment]
        eye = _unit(np.array(self.view.lens) - points)
        arriving = arriving * np.maximum(np.sum(normal * eye, axis=1), 0.0) * self.view.aperture_solid_angle(points)
        sent = {"even": arriving / math.pi, "diffuse": np.zeros(len(points)), "gloss": np.zeros(len(points))}
        material = self._material(line)[segment]
        for number in np.unique(material):
            mine, made_of = np.flatnonzero(material == number), self.materials[number]
            if isinstance(made_of.diffuse, Lambert):
                sent["diffuse"][mine] = made_of.albedo * sent["even"][mine]
                if made_of.gloss is None:
                    continue
            directions = _in_frames(normal[mine], self.sheet.towards(points[mine]), eye[mine])
            if not isinstance(made_of.diffuse, Lambert):
                sent["diffuse"][mine] = arriving[mine] * made_of.diffuse.value(directions)
            if made_of.gloss is not None:
                sent["gloss"][mine] = arriving[mine] * made_of.gloss.value(directions)
        return sent

    def _moved(self, normal: Float64, points: Float64) -> Float64:
        """Return how lit points move over their planes as the sheet moves by one sigma."""
        direction, light = np.array(self.sheet.transport.direction), self.sheet.towards(points)
        slope = (normal @ direction) / np.sum(normal * light, axis=1)
        return np.asarray(self.sheet.sigma * (direction - light * slope[:, None]))


def _all_of_it(line: LitLine, segment: Integers, points: Float64, arriving: Float64) -> dict[str, Float64]:
    return {"diffuse": np.zeros(len(arriving)), "gloss": arriving}


def _slabs(given: int | Sequence[float]) -> Slabs:
    if isinstance(given, int):
        if given < 1:
            raise ValueError(f"DirectLight.sub_sheets is {given}, expected 1 or more")
        return Slabs.of(given)
    cuts = np.asarray(given, np.float64)
    if cuts.ndim != 1 or not np.isfinite(cuts).all() or np.any(np.diff(cuts) <= 0.0):
        raise ValueError("DirectLight.sub_sheets: expected a number of slabs, or ascending places in sigmas")
    return Slabs.between(cuts)


def _chosen(samples: int, sample: Integers, places: Float64, on: npt.NDArray[np.bool_], light: Float64) -> GroundTruth:
    """Return of the places (G, H) of each sample the one on the sensor with the most light."""
    order = np.lexsort((-light, ~on, sample))
    sample, places, on = sample[order], places[order], on[order]
    best = np.flatnonzero(np.diff(sample, prepend=-1))
    own = np.repeat(best, np.diff(best, append=len(sample)))
    other = on & (np.abs(places - places[own]).max(axis=1, initial=0.0) > _SAME * np.abs(places).max(initial=0.0))
    g, h = np.full(samples, np.nan), np.full(samples, np.nan)
    status = np.full(samples, Status.LOW_SIGNAL, np.uint8)
    status[sample[best]] = np.where(on[best], Status.OK, Status.OUT_OF_RANGE)
    status[sample[other]] |= np.uint8(Status.AMBIGUOUS)
    given = best[on[best]]
    g[sample[given]], h[sample[given]] = places[given].T
    return GroundTruth(g, h, status)


def _width(lobe: Brdf) -> float:
    """Return about how wide a lobe is, as an angle of the half way vector [rad]."""
    if isinstance(lobe, Ggx):
        return lobe.alpha
    if isinstance(lobe, Ward):
        return min(lobe.alpha_x, lobe.alpha_y)
    return 0.5 / math.sqrt(lobe.exponent + 1.0) if isinstance(lobe, Phong) else math.inf


def _in_frames(normal: Float64, light: Float64, eye: Float64) -> Float64:
    """Return directions (n, 6) to the light and to the eye in frames whose z is the normal."""
    axis = np.where((np.abs(normal[:, 0]) < 0.9)[:, None], (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    x = _unit(axis - np.sum(axis * normal, axis=1, keepdims=True) * normal)
    frame = np.stack([x, np.cross(normal, x), normal], axis=1)
    return np.concatenate([np.einsum("nij,nj->ni", frame, each) for each in (light, eye)], axis=1)


def _unit(vectors: Float64) -> Float64:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=-1, keepdims=True))


def _bell(x: Float64) -> Float64:
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(math.tau))


def _between(low: Float64, high: Float64) -> Float64:
    """Return a Gaussian's share between two places, to its own digits in either tail."""
    return np.asarray(np.where(low > 0.0, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low)))
