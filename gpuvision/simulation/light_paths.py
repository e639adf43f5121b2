"""All ways of the light from a sheet over a scene to a sensor, profile by profile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Bound, Device
from gpuvision.simulation.bounces import Bounces
from gpuvision.simulation.direct import DirectLight
from gpuvision.simulation.illumination import LightSheet, LitLine
from gpuvision.simulation.line_irradiance import LitSegments
from gpuvision.simulation.material import Material
from gpuvision.simulation.mirrors import Mirrors
from gpuvision.simulation.readings import PATHS, Truth
from gpuvision.simulation.scene import Scene
from gpuvision.simulation.sight import Exposure, Sight
from gpuvision.simulation.sight_lines import SeenSurface, SightLines
from gpuvision.simulation.visible_light import VisibleLight, segment_rows

Float64 = npt.NDArray[np.float64]
# Segments are bound by the hundred and more, so that few profiles ask for another kernel.
_LEAST_ROOM = 64


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
    truth: Truth
    account: dict[str, float]


@dataclass(frozen=True, kw_only=True, eq=False)
class LightPaths:
    """What light comes to a sensor from a sheet on a scene; compared by identity.

    Parameters
    ----------
    sight, sheet
        The sensor, and its sheet of light, over the same transport.
    scene, materials
        What is there; a material for every number in `Scene.material`.
    paths
        Which of `gpuvision.simulation.readings.PATHS` are modelled; without "direct" there is no reading.
    sub_sheets
        Thin sheets that stand for a thick one, on the direct path. Secondary light comes from the middle one: it sees
        the sheet from further away than the sheet is thick.
    blur
        Standard deviation of a point's image along u [sensor unit].
    nodes
        Of `SightLines`.
    patch
        Size of the patches between which light bounces on [m]; None: a sixteenth of the scene.
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

    sight: Sight
    sheet: LightSheet
    scene: Scene
    materials: Sequence[Material]
    paths: Sequence[str] = PATHS
    sub_sheets: int = 1
    blur: float = 0.0
    nodes: tuple[int, int] = (1, 1)
    patch: float | None = None
    tolerance: float = 0.0
    device: Device | None = None
    _direct: DirectLight = field(init=False, repr=False)
    _mirrors: Mirrors = field(init=False, repr=False)
    lines: SightLines = field(init=False, repr=False)
    _bounces: Bounces | None = field(init=False, repr=False)
    _bound: dict[int, Bound[Any]] = field(init=False, repr=False, default_factory=dict)

    def __post_init__(self) -> None:
        for path in self.paths:
            if path not in PATHS:
                raise ValueError(f"unknown path {path!r}, expected some of {', '.join(PATHS)}")
        device = Device.best() if self.device is None else self.device
        object.__setattr__(self, "device", device)
        lines = SightLines(
            sight=self.sight, scene=self.scene, materials=self.materials, nodes=self.nodes, device=device
        )
        direct = DirectLight(
            sight=self.sight,
            scene=self.scene,
            materials=self.materials,
            sheet=self.sheet,
            sub_sheets=self.sub_sheets,
            device=device,
        )
        mirrors = Mirrors(sight=self.sight, scene=self.scene, materials=self.materials, device=device)
        object.__setattr__(self, "_direct", direct)
        object.__setattr__(self, "_mirrors", mirrors)
        object.__setattr__(self, "lines", lines)
        object.__setattr__(self, "_bounces", self._between_patches() if "bounces" in self.paths else None)

    def profile(self, L: float) -> Profile:
        """Return the light at a transport [m]."""
        lit = self.sheet.lit(self.scene, L)
        exposures = self._straight(L)
        account = {"segments": float(len(lit.power)), "power": lit.total()}
        if "diffuse-specular" in self.paths and self._mirrors.there_are_any:
            exposures["diffuse-specular"] = self._mirrors.exposure(lit, L, self.sheet)
        if {"diffuse-diffuse", "bounces"} & set(self.paths):
            exposures |= self._by_detours(lit, L)
        return Profile(exposures, self._direct.truth(L), account)

    def _straight(self, L: float) -> dict[str, Exposure]:
        light = self._direct.exposures(L, causes=True)
        return {
            name: self.sight.blurred(each, self.blur)
            for name, each in light.items()
            if name in self.paths or name not in PATHS
        }

    def _by_detours(self, lit: LitLine, L: float) -> dict[str, Exposure]:
        exposures: dict[str, Exposure] = {}
        seen = self.lines.surface(L)
        segments = self._diffuse(lit)
        if "diffuse-diffuse" in self.paths:
            exposures["diffuse-diffuse"] = self.lines.exposure(seen, self.irradiance(seen, segments))
        if self._bounces is not None:
            exitance = self._bounces.exitance(self._bounces.arrival(segments))
            light = self._bounces.light(seen.receivers, exitance)
            exposures["bounces"] = self.lines.exposure(seen, light.irradiance)
        return exposures

    def irradiance(self, seen: SeenSurface, segments: LitSegments) -> Float64:
        """Return the irradiance [W/m^2] of what the sensor sees from lit segments, (samples, n)."""
        room = max(_LEAST_ROOM, 1 << max(len(segments.exitance) - 1, 0).bit_length())
        if room not in self._bound:
            shape = seen.receivers.shape
            operation = VisibleLight(scene=self.scene, segments=room, precision="single")
            self._bound[room] = operation.bind(self.device, shape, self._real)
        bound = self._bound[room]
        # What it would sum up behind the bins is not needed: the weights stay zero.
        receivers, _, rows = bound.inputs
        receivers.set(seen.receivers.astype(self._real))
        rows.set(segment_rows(segments, room).astype(self._real))
        return np.asarray(bound.run().irradiance.get(), np.float64)

    def _diffuse(self, lit: LitLine) -> LitSegments:
        assert self.scene.material is not None  # set by Scene itself
        albedo = np.array([each.albedo for each in self.materials])[self.scene.material[lit.triangle]]
        return LitSegments(lit.ends, lit.normals, albedo * lit.power)

    def _between_patches(self) -> Bounces:
        size = self.patch
        if size is None:
            corners = self.scene.corners.reshape(-1, 3)
            size = float(np.linalg.norm(np.ptp(corners, axis=0))) / 16.0
        albedo = [each.albedo for each in self.materials]
        return Bounces.of(self.scene, albedo, size=size, both_sides=True, device=self.device)

    @property
    def _real(self) -> np.dtype[Any]:
        assert self.device is not None
        return np.dtype(np.float64 if self.device.has_double else np.float32)
