"""Examples of the kernels of `gpuvision.simulation`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.profiling.offline.builds import Example
from gpuvision.profiling.offline.ranging_builds import CAMERAS
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.simulation.clustering.light_clustering import LightClustering
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.reflectance import Ggx, Lambert, OrenNayar, Phong, Reflectance, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.mirror_facets import MirrorFacets
from gpuvision.simulation.transport.mirror_points import MirrorPoints
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance
from gpuvision.simulation.transport.patches import FormFactors, Patches, PatchLight

_TYPES = (np.float32, np.float64)


def examples() -> Iterator[Example]:
    """Yield examples of every build option of these kernels."""
    scene = Scene(_corners())
    yield from _rays(scene)
    yield from _reflectance()
    yield from _light(scene)
    yield from _mirrors()
    yield from _board_images()


def _corners() -> NDArray[np.float64]:
    """Return triangles that stand side by side."""
    one = np.array([[0.0, 0.0, 0.0], [1e-2, 0.0, 0.0], [0.0, 0.0, 1e-2]])
    return one + np.arange(64.0)[:, None, None] * [0.0, 1e-3, 0.0]


def _rays(scene: Scene) -> Iterator[Example]:
    for dtype in _TYPES:
        yield Example(f"closest hit {np.dtype(dtype)}", ClosestHit(scene=scene), (10_000, 6), dtype)
        yield Example(f"any hit {np.dtype(dtype)}", AnyHit(scene=scene), (10_000, 6), dtype)
        fans = VisibleIntervals(scene=scene)
        yield Example(f"fans {np.dtype(dtype)}", fans, (1000, 11), dtype)
    yield Example("closest hit, no double", ClosestHit(scene=scene), (10_000, 6), has_double=False)


def _reflectance() -> Iterator[Example]:
    models = {
        "Lambert": Lambert(albedo=0.5),
        "Phong": Phong(albedo=0.5, exponent=20.0),
        "Oren-Nayar": OrenNayar(albedo=0.5, roughness=0.3),
        "GGX": Ggx(alpha=0.2),
        "Ward": Ward(albedo=0.5, alpha_x=0.2, alpha_y=0.1),
    }
    for name, model in models.items():
        for dtype in _TYPES:
            yield Example(f"{name} {np.dtype(dtype)}", Reflectance(model=model), (10_000, 6), dtype)


def _light(scene: Scene) -> Iterator[Example]:
    ends = np.array([[[0.0, 0.0, 0.0], [1e-2, 0.0, 0.0]]])
    segments = LitSegments(ends=ends, normals=np.array([[0.0, 0.0, 1.0]]), exitance=np.array([1.0]))
    patches = Patches(_corners())
    for dtype in _TYPES:
        kind = np.dtype(dtype)
        yield Example(f"irradiance {kind}", LineIrradiance(segments=segments), (10_000, 6), dtype)
        strips = OccludedIrradiance(scene=scene, segments=6)
        yield Example(f"intervals {kind}", strips, (2, 17, 6), dtype)
        yield Example(f"rays {kind}", replace(strips, visibility="rays"), (2, 17, 6), dtype)
        for name, occluders in (("", None), (", occluders", scene)):
            factors = FormFactors(patches=patches, scene=occluders)
            yield Example(f"factors {kind}{name}", factors, (1000, 6), dtype)
            light = PatchLight(patches=patches, scene=occluders)
            yield Example(f"light {kind}{name}", light, (1000, 6), dtype)
    yield Example("single from double", LineIrradiance(segments=segments, precision="single"), (10_000, 6), np.float64)
    chosen = OccludedIrradiance(scene=scene, segments=6, selected=40)
    yield Example("selected", chosen, (2, 17, 6))
    yield Example("selected, rays", replace(chosen, visibility="rays"), (2, 17, 6))
    yield Example("selected, no double", chosen, (2, 17, 6), has_double=False)
    yield Example("irradiance, no double", LineIrradiance(segments=segments), (10_000, 6), has_double=False)
    open_light = OccludedIrradiance(scene=scene, segments=6, visibility="none")
    yield Example("no occlusion", open_light, (2, 17, 6))
    for occluders in (None, scene):
        for clusters in (False, True):
            selection = LightClustering(tolerance=1e-6, scene=occluders, clusters=clusters).selection(127, 64)
            words = f"clusters {clusters}, occluders {occluders is not None}"
            yield Example(words, selection, (100, 64, 6), np.float32)


def _mirrors() -> Iterator[Example]:
    corners = _corners()
    normals = np.broadcast_to([0.0, -1.0, 0.0], corners.shape)
    points = MirrorPoints(corners=corners, normals=normals, numbers=np.arange(len(corners), dtype=np.int32))
    for dtype in _TYPES:
        yield Example(f"points {np.dtype(dtype)}", points, (1000, 6), dtype)
        yield Example(f"facets {np.dtype(dtype)}", MirrorFacets(corners=corners), (1000, 6), dtype)


def _board_images() -> Iterator[Example]:
    values = np.full((100, 100), 30_000, np.uint16)
    board = ReflectanceMap(values=values, origin=(0.0, 0.0), cell=2.5e-6, pixel=1e-5, blur_px=0.5)
    sensor = CmosSensor(
        rows=1024, columns=1024, pitch=1e-5, quantum_efficiency=0.5, gain=0.025, dark_noise=20.0, full_well=2e4, bits=8
    )
    clean = RenderBoard(board=board, shape=(5, 19))
    noisy = replace(clean, sensor=sensor, electrons=8000.0)
    worn = replace(sensor, prnu=0.01, dsnu=2.0, nonlinearity=0.01)
    glare = np.zeros((5, 19), np.float32)
    more: dict[str, Any] = {"glare": glare, "mirrored": True, "model": CAMERAS["k1 k2 p k3"], "exposure": 1e-3}
    poses = (2, 8, 3)
    yield Example("reflectance", clean, poses, np.float64)
    yield Example("noise", noisy, poses, np.float64)
    yield Example("no noise", replace(noisy, noise=False), (2, 1, 3), np.float32)
    yield Example("pixel differences, glare, lens", replace(noisy, sensor=worn, **more), poses, np.float64)
    twelve = replace(noisy, sensor=replace(sensor, bits=12, gain=0.2))
    yield Example("12 bits", twelve, poses, np.float64)
