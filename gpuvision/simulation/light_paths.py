"""All ways of the light from a sheet over a scene to a sensor, profile by profile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.clustering.clustered_irradiance import ClusteredIrradiance
from gpuvision.simulation.errors.range_error import StripErrorModel, interreflection_power_bound, select_paths
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS, GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.simulation.sensors.view_rays import ViewRays, VisibleSurface
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet, LitLine
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.mirrors import Mirrors
from gpuvision.simulation.transport.occluded_irradiance import segment_rows
from gpuvision.simulation.transport.radiosity import Radiosity

Float64 = npt.NDArray[np.float64]


class Profile(NamedTuple):
    """The light of one profile.

    Attributes
    ----------
    exposures
        By path, (samples, bins).
    truth
        (samples,).
    account
        Numbers by name: how much was modelled.
    """

    exposures: dict[str, Exposure]
    truth: GroundTruth
    account: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPaths:
    """What light comes to a sensor from a sheet on a scene; compared by identity.

    Parameters
    ----------
    view, sheet
        The sensor, and its sheet of light, over the same transport.
    scene, materials
        What is there; a material for every number in `Scene.material`.
    paths
        Which of `gpuvision.simulation.sensors.readings.PATHS` are modelled; without "direct" there is no reading.
    sub_sheets
        Thin sheets that stand for a thick one, on the direct path. Secondary light comes from the middle one: it sees
        the sheet from further away than the sheet is thick.
    blur
        Standard deviation of a point's image along u [sensor unit]; light by diffuse detours is even enough without.
    nodes
        Of `ViewRays`.
    patch
        Size of the patches between which light bounces on [m]; None: a sixteenth of the scene.
    tolerance
        Range error that may come from secondary light that is left out [m], as a centre of gravity reads it; 0:
        nothing is left out.
    floor
        Power of a sample below which it is not read [W].
    device
        None: `Device.best`.

    Raises
    ------
    ValueError
        A path is unknown, or a material missing.

    Attributes
    ----------
    lines
        What the sensor sees of the scene.
    """

    view: SensorView
    sheet: LightSheet
    scene: Scene
    materials: Sequence[Material]
    paths: Sequence[str] = PATHS
    sub_sheets: int = 1
    blur: float = 0.0
    nodes: tuple[int, int] = (1, 1)
    patch: float | None = None
    tolerance: float = 0.0
    floor: float = 0.0
    device: Device | None = None
    _direct: DirectLight = field(init=False, repr=False)
    _mirrors: Mirrors = field(init=False, repr=False)
    lines: ViewRays = field(init=False, repr=False)
    _bounces: Radiosity | None = field(init=False, repr=False)
    _planned: ClusteredIrradiance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for path in self.paths:
            if path not in PATHS:
                raise ValueError(f"unknown path {path!r}, expected some of {', '.join(PATHS)}")
        device = Device.best() if self.device is None else self.device
        object.__setattr__(self, "device", device)
        lines = ViewRays(view=self.view, scene=self.scene, materials=self.materials, nodes=self.nodes, device=device)
        direct = DirectLight(
            view=self.view,
            scene=self.scene,
            materials=self.materials,
            sheet=self.sheet,
            sub_sheets=self.sub_sheets,
            device=device,
        )
        mirrors = Mirrors(view=self.view, scene=self.scene, materials=self.materials, device=device)
        planned = ClusteredIrradiance(scene=self.scene, tolerance=self.tolerance, device=device)
        object.__setattr__(self, "_planned", planned)
        object.__setattr__(self, "_direct", direct)
        object.__setattr__(self, "_mirrors", mirrors)
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "_bounces", self._between_patches() if "bounces" in self.paths else None)

    def profile(self, L: float) -> Profile:
        """Return the light at a transport [m]."""
        return self.profiles([L])[0]

    def profiles(self, transports: npt.ArrayLike) -> list[Profile]:
        """Return the light at several transports [m]: faster than one by one."""
        places = np.atleast_1d(np.asarray(transports, np.float64))
        straight, truths = self._direct.exposures_along(places, causes=True), self._direct.truths_along(places)
        lit, first = self.sheet.lit_lines(self.scene, places)
        found = []
        for k, L in enumerate(places):
            exposures = {
                name: self.view.blur(Exposure(each.power[k], each.moment[k]), self.blur)
                for name, each in straight.items()
                if name in self.paths or name not in PATHS
            }
            truth = GroundTruth(truths.g[k], truths.h[k], truths.status[k])
            found.append(self._profile(float(L), lit.those(slice(first[k], first[k + 1])), exposures, truth))
        return found

    def _profile(self, L: float, lit: LitLine, exposures: dict[str, Exposure], truth: GroundTruth) -> Profile:
        """Return the direct light of a profile with the light by detours."""
        account = {"segments": float(len(lit.power)), "power": lit.total()}
        if "diffuse-specular" in self.paths and self._mirrors.there_are_any:
            mirrored = self._mirrors.exposure(lit, L, self.sheet)
            exposures["diffuse-specular"] = self.view.blur(mirrored, self.blur)
        if {"diffuse-diffuse", "bounces"} & set(self.paths):
            seen, segments = self.lines.visible_surface(L), self._diffuse(lit)
            reading = StripErrorModel.from_exposure(self.view, exposures["direct"], min_power=self.floor)
            remaining = self.tolerance
            if self._bounces is not None:
                choice = select_paths({"bounces": reading.error_bound(self._most_by_bounces(segments))}, self.tolerance)
                remaining = choice.remaining_tolerance
                if "bounces" in choice.modelled:
                    exposures["bounces"] = self._bounced(seen, segments)
                account |= {"bound of bounces left out [m]": sum(choice.omitted.values())}
            if "diffuse-diffuse" in self.paths:
                irradiance, told = self._secondary(seen, segments, reading, remaining)
                exposures["diffuse-diffuse"] = self.lines.exposure(seen, irradiance)
                account |= told
        return Profile(exposures, truth, account)

    # ---- light by detours ------------------------------------------------------------------------------------

    def _bounced(self, seen: VisibleSurface, segments: LitSegments) -> Exposure:
        assert self._bounces is not None  # asked for
        exitance = self._bounces.exitance(self._bounces.arrival(segments))
        return self.lines.exposure(seen, self._bounces.light(seen.receivers, exitance).irradiance)

    def _most_by_bounces(self, segments: LitSegments) -> float:
        """Return the most power that the sensor can get of light that went between surfaces more than once."""
        sent = float(segments.exitance @ np.linalg.norm(segments.ends[:, 1] - segments.ends[:, 0], axis=1))
        corners = self.scene.corners.reshape(-1, 3)
        lens = self.view.lens_at(0.0)
        # The nearest that the part can come to the lens, wherever the sheet stands on it.
        across = corners - lens
        across -= np.outer(across @ np.array(self.view.transport.direction), self.view.transport.direction)
        nearest = float(np.linalg.norm(across, axis=1).min(initial=np.inf))
        opening = 0.25 * np.pi * self.view.aperture**2
        solid_angle = min(opening / nearest**2, 2.0 * np.pi) if nearest > 0.0 else 2.0 * np.pi
        return interreflection_power_bound(
            sent, max((each.albedo for each in self.materials), default=0.0), solid_angle
        )

    def _secondary(
        self, seen: VisibleSurface, segments: LitSegments, reading: StripErrorModel, tolerance: float
    ) -> tuple[Float64, dict[str, float]]:
        """Return the irradiance by lit segments, and what of it was modelled."""
        if tolerance == 0.0:
            pairs = float(len(segments.exitance) * np.count_nonzero(seen.weights))
            return self.irradiance(seen, segments), {"pairs": pairs, "pairs exact": pairs}
        weights = reading.weights(seen.weights, self.lines.u)
        rows = segment_rows(segments)
        light, plan = self._planned(rows, seen.receivers, weights, reading, tolerance=tolerance)
        told = {f"pairs {name}": float(plan.counts[name]) for name in ("exact", "clustered", "left out")}
        told["profiles in full (cheaper than a plan)"] = float(not plan.planned)
        bound = {"bound of pairs left out [m]": float(plan.bound.max(initial=0.0))}
        return light, {"pairs": float(plan.counts["pairs"])} | told | bound

    def irradiance(self, seen: VisibleSurface, segments: LitSegments) -> Float64:
        """Return the irradiance [W/m^2] of what the sensor sees from lit segments, (samples, n)."""
        return self._planned.exactly(segment_rows(segments), seen.receivers)

    def _diffuse(self, lit: LitLine) -> LitSegments:
        assert self.scene.material is not None  # set by Scene itself
        lit = lit.joined(self.scene.material[lit.triangle])
        albedo = np.array([each.albedo for each in self.materials])[self.scene.material[lit.triangle]]
        return LitSegments(lit.ends, lit.normals, albedo * lit.power)

    def _between_patches(self) -> Radiosity:
        size = self.patch
        if size is None:
            corners = self.scene.corners.reshape(-1, 3)
            size = float(np.linalg.norm(np.ptp(corners, axis=0))) / 16.0
        albedo = [each.albedo for each in self.materials]
        return Radiosity.of(self.scene, albedo, size=size, device=self.device)
