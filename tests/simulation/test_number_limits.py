"""Numbers at both sides of each limit: the last one that is taken, and the first one that is refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.errors.sensor_fusion import SensorFusion
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.reflectance import Ggx, Lambert, OrenNayar, Phong, Ward
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.sensors.masks import Mask, optimise_mask
from gpuvision.simulation.sensors.readings import GroundTruth
from gpuvision.simulation.transport.illumination import LightSheet
from gpuvision.simulation.transport.mirror_points import MirrorPoints
from gpuvision.simulation.transport.mirrors import Mirrors
from gpuvision.simulation.transport.patches import Patches
from lights import camera, camera_view, gaussian, pixel_axes, psd, psd_view
from mirror_scenes import sensor_view

TRIANGLE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
SCENE = Scene(TRIANGLE)
TWO = Scene(np.concatenate([TRIANGLE, TRIANGLE + 2.0]))
MOVE = StraightTransport()
GREY = Material(diffuse=Lambert(albedo=0.5))


def sheet(**more: Any) -> LightSheet:
    return LightSheet(transport=MOVE, **more)


def mirrors(**more: Any) -> Mirrors:
    return Mirrors(view=sensor_view(4, 4), scene=SCENE, materials=[GREY], **more)


def optimised(**more: Any) -> Any:
    view = psd_view(8)
    light = {"direct": gaussian(view, np.zeros((1, view.samples)), 1.0, 1e-3)}
    nothing = np.zeros((1, view.samples))
    return optimise_mask(view, light, GroundTruth(nothing, nothing, nothing.astype(np.uint8)), **more)


# What is made of a number; numbers that are taken; numbers that are refused, each with a part of its message.
CASES: dict[str, tuple[Callable[[Any], Any], tuple[Any, ...], dict[Any, str]]] = {
    "leak": (lambda x: Mask(leak=x), (0.0, 1.0), {-1e-9: "leak is -1e-09, expected a share", 1.0 + 1e-6: "leak is 1"}),
    "windows": (
        lambda x: Mask(windows=x),
        (((0.0, 0.0), (0.0, 1.0)),),
        {((0.0, -1e-9),): "lower end first", ((0.0, 1.0, 2.0),): "expected", (0.0, 1.0): "expected"},
    ),
    "transmission": (
        lambda x: Mask(transmission=x),
        (((0.0, 1.0),),),
        {((-1e-9, 1.0),): "shares from 0 to 1", ((0.0, 1.0 + 1e-9),): "shares from 0 to 1", (0.0, 1.0): "shares from"},
    ),
    "passed fraction": (
        lambda x: optimised(min_passed_fraction=x),
        (1e-9, 1.0),
        {0.0: "got 0 and 0", 1.0 + 1e-6: "0 < min_passed_fraction <= 1"},
    ),
    "margin": (lambda x: optimised(margin=x), (0.0,), {-1e-9: "margin >= 0, got 0.999 and -1e-09"}),
    "power": (lambda x: sheet(power=x), (0.0,), {-1e-9: r"power is -1e-09, expected 0 or more"}),
    "sigma": (lambda x: sheet(sigma=x), (0.0,), {-1e-9: r"sigma is -1e-09, expected 0 or more"}),
    "uniformity": (
        lambda x: sheet(uniformity=x),
        (1e-4,),
        {0.99e-4: r"uniformity is 9.9e-05, expected 0.0001 or more"},
    ),
    "source": (lambda x: sheet(source=(1.0, x)), (1e-300,), {0.0: "source has H = 0 m", -1.0: "source has H = -1 m"}),
    "range of G": (
        lambda x: sheet(g_limits=x),
        ((0.0, 1e-9), (-1.0, -0.5)),
        {(0.0, 0.0): "expected the lower one first", (0.0, -1e-9): r"g_limits are \(0.0, -1e-09\)"},
    ),
    "profile": (
        lambda x: sheet(profile=x),
        (((0.0, 0.0), (1e-9, 0.0)),),
        {
            ((0.0, 1.0),): "two rows or more",
            ((0.0, 1.0), (0.0, 1.0)): "G ascending",
            ((0.0, 1.0), (1.0, -1e-9)): "no factor below 0",
        },
    ),
    "steps": (
        lambda x: mirrors(steps_per_sample=x),
        (1e-300,),
        {0.0: r"steps_per_sample is 0\.0", math.inf: "steps_per_sample is inf"},
    ),
    "reflections": (lambda x: mirrors(max_reflections=x), (0,), {-1: "max_reflections is -1, expected 0 or more"}),
    "shown intervals": (
        lambda x: VisibleIntervals(scene=SCENE, max_intervals=x),
        (1, 49),
        {0: "max_intervals is 0, expected 1 to 49", 50: "max_intervals is 50"},
    ),
    "images": (
        lambda x: MirrorPoints(corners=TRIANGLE, normals=TRIANGLE, numbers=[0], kept=x),
        (1, 255),
        {0: "kept", 256: "kept"},
    ),
    "mirror": (
        lambda x: Material(diffuse=Lambert(albedo=0.0), mirror=x),
        (0.0, 1.0),
        {-1e-9: "mirror is -1e-09, expected 0 to 1", 1.0 + 1e-6: "mirror is 1, expected 0 to 1"},
    ),
    "reflected light": (
        lambda x: Material(diffuse=Lambert(albedo=x), mirror=0.25),
        (0.75, 0.7599),
        {0.7601: "Material reflects 1.01 of the incident light, expected 1 at most"},
    ),
    "albedo": (
        lambda x: Lambert(albedo=x),
        (0.0, 1.0),
        {-1e-9: r"Lambert.albedo is -1e-09, expected 0 to 1", 1.0 + 1e-6: r"Lambert.albedo is 1"},
    ),
    "roughness": (
        lambda x: OrenNayar(albedo=0.5, roughness=x),
        (0.0,),
        {-1e-9: r"OrenNayar.roughness is -1e-09"},
    ),
    "exponent": (lambda x: Phong(albedo=0.5, exponent=x), (0.0,), {-1e-9: r"Phong.exponent is -1e-09"}),
    "lobe": (
        lambda x: Ward(albedo=0.5, alpha_x=x[0], alpha_y=x[1]),
        ((1e-4, 1e-4), (1.0, 1.0)),
        {
            (0.99e-4, 0.5): r"Ward.alpha_x is 9.9e-05",
            (0.5, 0.99e-4): r"Ward.alpha_y",
            (0.5, 1.01): r"Ward.alpha_y is 1.01",
        },
    ),
    "facets": (
        lambda x: Ggx(alpha=x, f0=0.5),
        (1e-4, 1.0),
        {0.99e-4: r"Ggx.alpha is 9.9e-05, expected 0.0001 to 1", 1.01: r"Ggx.alpha is 1.01"},
    ),
    "reflection of facets": (lambda x: Ggx(alpha=0.3, f0=x), (0.0, 1.0), {-1e-9: r"Ggx.f0 is", 1.0 + 1e-6: r"Ggx.f0"}),
    "sigmas": (lambda x: SensorFusion(max_sigmas=x), (0.0,), {-1e-9: "max_sigmas is -1e-09, expected 0 or more"}),
    "tolerance": (lambda x: SensorFusion(tolerance=x), (0.0,), {-1e-9: "tolerance is -1e-09, expected 0 or more"}),
    "ratio": (
        lambda x: SensorFusion(min_ratio=x),
        (1.0,),
        {1.0 - 1e-9: r"min_ratio is 0.999999999, expected 1 or more"},
    ),
    "bits": (lambda x: camera(bits=x), (8, 10, 12, 14, 16), dict.fromkeys((7, 9, 11, 13, 15, 17), "bits is")),
    "well": (lambda x: camera(full_well=x), (1e-300, math.inf), {0.0: "full_well and gain: expected numbers > 0"}),
    "gain": (lambda x: camera(gain=x), (1e-300,), {0.0: "full_well and gain: expected", -1e-9: "gain is -1e-09"}),
    "camera's ambient": (lambda x: camera(ambient=x), (0.0,), {-1e-18: "CameraSimulator.ambient is -1e-18"}),
    "camera's offset": (lambda x: camera(offset=x), (0.0,), {-1e-9: "CameraSimulator.offset is -1e-09, expected 0 or"}),
    "time": (lambda x: camera(exposure_time=x), (0.0,), {-1e-9: "CameraSimulator.exposure_time is -1e-09"}),
    "ambient": (lambda x: psd(ambient=x), (0.0,), {-1e-18: "PsdSimulator.ambient is -1e-18, expected 0 or more"}),
    "pixels": (
        lambda x: camera(
            replace(camera_view(), u_edges=camera_view().u_edges + 1e-5 * x),
            readout={"axes": pixel_axes(camera_view())},
        ),
        (0.9e-6, -0.9e-6),
        {1.1e-6: "a bin for every pixel", -1.1e-6: "a bin for every pixel"},
    ),
    "ends of strips": (
        lambda x: psd(replace(psd_view(), u_edges=psd_view().u_edges + 3e-3 * x)),
        (0.9e-6, -0.9e-6),
        {1.1e-6: "readout's strips at", -1.1e-6: "the view ends at u = "},
    ),
    "aperture": (
        lambda x: replace(psd_view(), aperture=x),
        (1e-300,),
        {0.0: "aperture is 0 m, expected a diameter > 0", -1e-9: "aperture is -1e-09 m"},
    ),
    "lens in the sheet": (
        lambda x: replace(psd_view(), lens=(0.0, 0.17 * x, 0.17)),
        (1.1e-9, -1.1e-9),
        {
            0.9e-9: "lies in the sheet of light",
            -0.9e-9: "lies in the sheet of light",
            0.0: "nothing can be triangulated",
        },
    ),
    "axis": (
        lambda x: replace(psd_view(), axis=(0.0, x, 0.0)),
        (1e-150, -2.0),
        {0.0: "SensorView.axis has no direction"},
    ),
    "edges": (
        lambda x: replace(psd_view(), u_edges=np.array(x)),
        ((0.0, 1e-9),),
        {
            (0.0,): "u_edges: expected two or more numbers in ascending order",
            (0.0, 0.0): "ascending order",
            (0.0, 1.0, 0.5): "ascending order",
            (0.0, math.inf): "u_edges",
            ((0.0, 1.0),): "u_edges",
        },
    ),
    "patches": (
        lambda x: Patches(corners=TWO.corners, patch=np.array(x)),
        ((0, 1), (0, 0)),
        {
            (1, 2): "ascend from 0",
            (0, 2): "without a gap",
            (1, 0): "ascend from 0",
            (0, 1, 2): r"expected integers \(2,\)",
        },
    ),
    "slack": (
        lambda x: Patches(corners=TRIANGLE, slack=np.array(x)),
        ((0.0,),),
        {(-1e-12,): r"slack has shape \(1,\), expected \(1,\): metres, 0 or more", (0.0, 0.0): "slack has shape"},
    ),
    "size": (
        lambda x: Patches.from_scene(SCENE, size=x),
        (2.0,),
        {0.0: "size is 0.0, expected metres, more than 0", -1.0: "size is -1.0", math.inf: "size is inf"},
    ),
    "clearance": (
        lambda x: (ClosestHit(scene=SCENE, clearance=x), AnyHit(scene=SCENE, clearance=x)),
        (0.0,),
        {-1e-12: r"clearance is -1e-12, expected metres, 0 or more", math.inf: "clearance is inf"},
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_numbers_at_their_limits(case: str) -> None:
    make, taken, refused = CASES[case]
    for value in taken:
        make(value)
    for value, message in refused.items():
        with pytest.raises((TypeError, ValueError), match=message):
            make(value)
