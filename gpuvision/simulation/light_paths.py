"""Light paths of a simulation: all light that reaches a sensor from a sheet over a scene, profile by profile."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.simulation.clustering.clustered_irradiance import ClusteredIrradiance
from gpuvision.simulation.errors.range_error import StripErrorModel, interreflection_power_bound, select_paths
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import BEYOND_ENDS, PATHS, GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.sensors.view_rays import ViewRays, VisibleSurface
from gpuvision.simulation.transport.direct import DirectLight, DirectLimits
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.mirrors import Mirrors
from gpuvision.simulation.transport.occluded_irradiance import segment_rows
from gpuvision.simulation.transport.radiosity import Radiosity

Float64 = npt.NDArray[np.float64]
# Scene, size of the patches [m], albedos of the materials, and device of a radiosity solution.
SolverKey = tuple[Scene, float, tuple[float, ...], Device | None]


class ProfileLight(NamedTuple):
    """Light of one profile.

    Attributes
    ----------
    exposures
        `Exposure` (samples, bins) by name of the light path.
    truth
        True position of the lit line, (samples,).
    statistics
        Numbers by name: segments, power [W], and the pairs and paths that were modelled or omitted, with their bounds.
    """

    exposures: dict[str, Exposure]
    truth: GroundTruth
    statistics: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPaths:
    """Light that reaches a sensor from a sheet over a scene; compared by identity.

    Parameters
    ----------
    view, sheet : SensorView, LightSheet
        Sensor and sheet of light, on the same transport.
    scene, materials : Scene, sequence of Material
        Surfaces, and a material for every number in `Scene.material`.
    paths : sequence of str
        Light paths to model, out of `gpuvision.simulation.sensors.readings.PATHS`: "direct" (one diffuse reflection),
        "specular" (one glossy reflection, or a mirror straight into the lens), "diffuse-specular" (a mirror before or
        after a diffuse surface), "diffuse-diffuse" (two diffuse reflections), "multi-bounce" (three or more, by
        radiosity). Without "direct" there is no reading.
    sub_sheets : int
        Number of thin sheets that represent a thick one on the direct path, 1 or more. Secondary light is emitted from
        the middle of the sheet: for other surfaces the sheet is thin. Default 1.
    blur : float
        Standard deviation of the image of a point along u [sensor unit]. It is not applied to diffuse secondary light,
        which varies slowly. Default 0.0.
    nodes : pair of ints
        Of `ViewRays`. Default ``(1, 1)``.
    bounce_nodes : pair of ints, optional
        Nodes for "multi-bounce" light, which is smooth: it needs fewer. Default: ``nodes``.
    spreads_rays : bool
        Of `ViewRays`: for readings that add up all bins. Default False.
    end_bins : int
        Number of bins beyond either end of the samples in which direct light is imaged and blurred too, 0 or more: the
        light that the ends cut off is then known (`BEYOND_ENDS`), and the true points beyond the ends. Default 0.
    patch_size : float, optional
        Largest edge of the patches of the radiosity solution [m]; None: a sixteenth of the scene's diagonal. Towards
        concave edges the patches become smaller (`Patches.from_scene`).
    solvers : dict
        Radiosity solutions by scene, size of the patches, albedos and device; they are used, and added if they are
        missing. Give the same dictionary to several instances so that form factors are computed once. Default: empty.
    tolerance : float
        Range error that omitted secondary light may cause [m], 0 or more; 0: all light is computed. See the notes.
        Default 0.0.
    min_power : float
        Power of a sample below which it is not read [W]. Default 0.0.
    device : Device, optional
        Device of the kernels; None: `Device.best`.
    direct_limits : DirectLimits
        Numerical limits of the direct light, such as the division of glossy lobes.
    mirror_steps : float
        Number of steps per sample in which a line in a curved mirror is imaged, above 0. Default 2.0.

    Raises
    ------
    ValueError
        A path is unknown, or a material is missing.

    Attributes
    ----------
    view_rays
        Surface elements that the sensor sees.

    Notes
    -----
    The tolerance holds for a reading that is the mean of u over the light of a sample (a PSD, or a centroid in a fixed
    window), and covers pairs of a segment and a receiver that are omitted or clustered (`LightClustering`), and omitted
    "multi-bounce" light. At most half of the tolerance is spent on "multi-bounce" light. It does not cover the
    discretisation of the surface, of the sheet and of the patches, nor rounding, nor light paths that are not modelled.

    The statistics "bound of ... left out" hold the bounds of omitted pairs and of omitted multi-bounce light, also of a
    path "multi-bounce" that is not requested. The bound of multi-bounce light assumes diffuse reflection with the
    largest albedo of the scene, and the largest solid angle of the lens from any point of the scene. Light that also
    meets mirrors is not covered.

    "multi-bounce" light is computed with two sizes of patches, ``patch_size`` and its double. The difference of the
    two readings is the statistic "estimated error of patches": an estimate and not a bound. The error is of first
    order in the size at concave edges, so that the error of the smaller patches is about the difference.
    """

    view: SensorView
    sheet: LightSheet
    scene: Scene
    materials: Sequence[Material]
    paths: Sequence[str] = PATHS
    sub_sheets: int = 1
    blur: float = 0.0
    nodes: tuple[int, int] = (1, 1)
    bounce_nodes: tuple[int, int] | None = None
    spreads_rays: bool = False
    end_bins: int = 0
    patch_size: float | None = None
    solvers: dict[SolverKey, Radiosity] = field(default_factory=dict, repr=False)
    tolerance: float = 0.0
    min_power: float = 0.0
    device: Device | None = None
    direct_limits: DirectLimits = DirectLimits()
    mirror_steps: float = 2.0
    _direct: DirectLight = field(init=False, repr=False)
    _mirrors: Mirrors = field(init=False, repr=False)
    view_rays: ViewRays = field(init=False, repr=False)
    _bounce_rays: ViewRays = field(init=False, repr=False)
    _radiosity: Radiosity | None = field(init=False, repr=False)
    _coarse_radiosity: Radiosity | None = field(init=False, repr=False)
    _clustered: ClusteredIrradiance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for path in self.paths:
            if path not in PATHS:
                raise ValueError(f"unknown path {path!r}, expected some of {', '.join(PATHS)}")
        device = Device.best() if self.device is None else self.device
        object.__setattr__(self, "device", device)
        view_rays = ViewRays(
            view=self.view,
            scene=self.scene,
            materials=self.materials,
            nodes=self.nodes,
            spreads_rays=self.spreads_rays,
            device=device,
        )
        bounce_nodes = self.nodes if self.bounce_nodes is None else self.bounce_nodes
        bounce_rays = view_rays if bounce_nodes == self.nodes else replace(view_rays, nodes=bounce_nodes)
        if self.end_bins < 0:
            raise ValueError(f"LightPaths.end_bins is {self.end_bins}, expected 0 or more")
        direct = DirectLight(
            view=_widened(self.view, self.end_bins),
            scene=self.scene,
            materials=self.materials,
            sheet=self.sheet,
            sub_sheets=self.sub_sheets,
            device=device,
            ends=(float(self.view.u_edges[0]), float(self.view.u_edges[-1])),
            limits=self.direct_limits,
        )
        mirrors = Mirrors(
            view=self.view,
            scene=self.scene,
            materials=self.materials,
            steps_per_sample=self.mirror_steps,
            device=device,
        )
        clustered = ClusteredIrradiance(scene=self.scene, tolerance=self.tolerance, device=device)
        object.__setattr__(self, "_clustered", clustered)
        object.__setattr__(self, "_direct", direct)
        object.__setattr__(self, "_mirrors", mirrors)
        object.__setattr__(self, "view_rays", view_rays)
        object.__setattr__(self, "_bounce_rays", bounce_rays)
        for name, factor in (("_radiosity", 1.0), ("_coarse_radiosity", 2.0)):
            made = self._make_radiosity(factor) if "multi-bounce" in self.paths else None
            object.__setattr__(self, name, made)

    def profile(self, L: float) -> ProfileLight:
        """Return the light at a transport L [m]."""
        return self.profiles([L])[0]

    def profiles(self, transports: npt.ArrayLike) -> list[ProfileLight]:
        """Return the light at several transports [m]; faster than one by one."""
        places = np.atleast_1d(np.asarray(transports, np.float64))
        straight, truths = (
            self._direct.exposures_of_profiles(places, causes=True),
            self._direct.truths_of_profiles(places),
        )
        lit, first = self.sheet.illuminate_all(self.scene, places)
        found = []
        for k, L in enumerate(places):
            wide = {
                name: self._direct.view.blur(Exposure(each.power[k], each.moment[k]), self.blur)
                for name, each in straight.items()
                if name in self.paths or name not in PATHS
            }
            exposures = {name: self._within_ends(each) for name, each in wide.items()}
            if self.end_bins and "direct" in wide:
                exposures[BEYOND_ENDS] = self._beyond_ends(wide["direct"])
            truth = GroundTruth(truths.g[k], truths.h[k], truths.status[k])
            found.append(self._profile(float(L), lit.select(slice(first[k], first[k + 1])), exposures, truth))
        return found

    def _within_ends(self, wide: Exposure) -> Exposure:
        """Return the light within the ends of the samples, of light in the widened view."""
        inner = slice(self.end_bins, self.end_bins + self.view.bins)
        return Exposure(wide.power[:, inner], wide.moment[:, inner])

    def _beyond_ends(self, wide: Exposure) -> Exposure:
        """Return the light beyond the ends of the samples: power and first moment in the first and the last bin."""
        beyond, centres = self.view.dark(), self._direct.view.u_centres
        for place, outer in ((0, slice(0, self.end_bins)), (-1, slice(self.end_bins + self.view.bins, None))):
            power = wide.power[:, outer]
            beyond.power[:, place] = power.sum(axis=-1)
            from_bin = centres[outer] - self.view.u_centres[place]
            beyond.moment[:, place] = wide.moment[:, outer].sum(axis=-1) + power @ from_bin
        return beyond

    def _profile(self, L: float, lit: LitLine, exposures: dict[str, Exposure], truth: GroundTruth) -> ProfileLight:
        """Return the light of a profile: the direct light and all secondary light."""
        statistics = {"segments": float(len(lit.power)), "power": lit.total()}
        if "diffuse-specular" in self.paths and self._mirrors.has_mirrors:
            mirrored = self._mirrors.exposure(lit, L, self.sheet)
            exposures["diffuse-specular"] = self.view.blur(mirrored, self.blur)
        if {"diffuse-diffuse", "multi-bounce"} & set(self.paths):
            seen, segments = self.view_rays.visible_surface(L), self._diffuse_segments(lit)
            reading = StripErrorModel.from_exposure(self.view, exposures["direct"], min_power=self.min_power)
            remaining = self.tolerance
            bound = reading.error_bound(self._max_multi_bounce_power(segments))
            omitted = float(np.max(bound, initial=0.0))
            if self._radiosity is not None:
                choice = select_paths({"multi-bounce": bound}, self.tolerance)
                remaining, omitted = choice.remaining_tolerance, sum(choice.omitted.values())
                if "multi-bounce" in choice.modelled:
                    rays = self._bounce_rays
                    by_bounces = seen if rays is self.view_rays else rays.visible_surface(L)
                    light, error = self._multi_bounce_exposure(by_bounces, segments, exposures["direct"])
                    exposures["multi-bounce"] = light
                    statistics |= {"estimated error of patches [m]": error}
            statistics |= {"bound of multi-bounce left out [m]": omitted}
            if "diffuse-diffuse" in self.paths:
                irradiance, counts = self._diffuse_irradiance(seen, segments, reading, remaining)
                exposures["diffuse-diffuse"] = self.view_rays.exposure(seen, irradiance)
                statistics |= counts
        return ProfileLight(exposures, truth, statistics)

    # ---- secondary light -------------------------------------------------------------------------------------

    def _multi_bounce_exposure(
        self, seen: VisibleSurface, segments: LitSegments, direct: Exposure
    ) -> tuple[Exposure, float]:
        """Return the exposure by multi-bounce light, and an estimate of the range error by the patches' size [m]."""
        assert self._radiosity is not None  # the path is requested
        assert self._coarse_radiosity is not None
        found = []
        for solver in (self._radiosity, self._coarse_radiosity):
            light = solver.irradiance(seen.receivers, solver.solve(solver.direct_irradiance(segments)))
            found.append(self._bounce_rays.exposure(seen, np.asarray(to_numpy(light.irradiance), np.float64)))
        readings = [StripErrorModel.from_exposure(self.view, direct + each, min_power=self.min_power) for each in found]
        read = direct.total() > self.min_power
        difference = readings[0].slope * np.abs(readings[0].position - readings[1].position)
        return found[0], float(np.max(difference[read], initial=0.0))

    def _max_multi_bounce_power(self, segments: LitSegments) -> float:
        """Return a bound of the power on the sensor by light with three or more diffuse reflections [W]."""
        sent = float(segments.exitance @ np.linalg.norm(segments.ends[:, 1] - segments.ends[:, 0], axis=1))
        return interreflection_power_bound(
            sent, max((each.albedo for each in self.materials), default=0.0), self._largest_solid_angle
        )

    @functools.cached_property
    def _largest_solid_angle(self) -> float:
        """Largest solid angle of the lens from a point of the scene [sr], for any transport."""
        nearest = distance_from_path(self.scene.corners, self.view.lens_at(0.0), self.view.transport.direction)
        # A point of the aperture is nearer than its middle by at most the radius.
        nearest -= 0.5 * self.view.aperture
        opening = 0.25 * math.pi * self.view.aperture**2
        return min(opening / nearest**2, 2.0 * math.pi) if nearest > 0.0 else 2.0 * math.pi

    def _diffuse_irradiance(
        self, seen: VisibleSurface, segments: LitSegments, reading: StripErrorModel, tolerance: float
    ) -> tuple[Float64, dict[str, float]]:
        """Return the irradiance of the visible surface by lit segments, and the counts of the modelled pairs."""
        if tolerance == 0.0:
            pairs = float(len(segments.exitance) * np.count_nonzero(seen.weights))
            return self.irradiance(seen, segments), {"pairs": pairs, "pairs exact": pairs}
        weights = reading.weights(seen.weights, self.view_rays.u)
        rows = segment_rows(segments)
        light, cut = self._clustered(rows, seen.receivers, weights, reading, tolerance=tolerance)
        counts = {f"pairs {name}": float(cut.counts[name]) for name in ("exact", "clustered", "left out")}
        counts["profiles without clustering (cheaper)"] = float(not cut.traversed)
        bound = {"bound of pairs left out [m]": float(cut.bound.max(initial=0.0))}
        return light, {"pairs": float(cut.counts["pairs"])} | counts | bound

    def irradiance(self, seen: VisibleSurface, segments: LitSegments) -> Float64:
        """Return the irradiance of the visible surface by all pairs with lit segments, (samples, n) [W/m^2].

        Parameters
        ----------
        seen : VisibleSurface
            Surface elements that the sensor sees, from `view_rays`.
        segments : LitSegments
            Lit segments.
        """
        return self._clustered.compute_all(segment_rows(segments), seen.receivers)

    def _diffuse_segments(self, lit: LitLine) -> LitSegments:
        assert self.scene.material is not None  # set by Scene itself
        lit = lit.merged(self.scene.material[lit.triangle])
        albedo = np.array([each.albedo for each in self.materials])[self.scene.material[lit.triangle]]
        return LitSegments(lit.ends, lit.normals, albedo * lit.power)

    def _make_radiosity(self, factor: float) -> Radiosity:
        """Return the radiosity solver with patches of ``factor`` times the size."""
        size = self.patch_size
        if size is None:
            corners = self.scene.corners.reshape(-1, 3)
            size = float(np.linalg.norm(np.ptp(corners, axis=0))) / 16.0
        size *= factor
        albedo = tuple(each.albedo for each in self.materials)
        key = (self.scene, size, albedo, self.device)
        if key not in self.solvers:
            self.solvers[key] = Radiosity.from_scene(self.scene, albedo, size=size, graded=True, device=self.device)
        return self.solvers[key]


def _widened(view: SensorView, bins: int) -> SensorView:
    """Return a view with more bins of the same width beyond either end in u."""
    if not bins:
        return view
    edges, count = view.u_edges, np.arange(1, bins + 1)
    low, high = edges[0] - count[::-1] * (edges[1] - edges[0]), edges[-1] + count * (edges[-1] - edges[-2])
    return replace(view, u_edges=np.concatenate([low, edges, high]), axis=view.axis)


def distance_from_path(corners: npt.NDArray[np.float64], start: npt.ArrayLike, direction: npt.ArrayLike) -> float:
    """Return the least distance between triangles and a straight line [m]; infinite without triangles.

    Along the line the triangles are projected to a plane, in which the line is a point.

    Parameters
    ----------
    corners
        (n, 3, 3): corners [m].
    start, direction
        (3,): a point of the line [m], and its direction of any length.
    """
    corners = corners[np.isfinite(corners).all(axis=(1, 2))]
    if not len(corners):
        return math.inf
    axis = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    across = np.linalg.svd(axis[None])[2][1:]
    flat = (corners - np.asarray(start, np.float64)) @ across.T
    ends = np.roll(flat, -1, axis=1)
    way = ends - flat
    square = np.sum(way * way, axis=2)
    share = np.divide(-np.sum(flat * way, axis=2), square, out=np.zeros_like(square), where=square > 0.0)
    points = flat + np.clip(share, 0.0, 1.0)[..., None] * way
    side = flat[..., 0] * ends[..., 1] - flat[..., 1] * ends[..., 0]
    inside = (side > 0.0).all(axis=1) | (side < 0.0).all(axis=1)
    return 0.0 if inside.any() else float(np.linalg.norm(points, axis=2).min())
