"""Work-groups of the operations on a GPU are whole warps, and in either variant the work-items cover all elements."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from gpuvision.host import Device
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.simulation.scene.rays import AnyHit, ClosestHit
from gpuvision.simulation.scene.reflectance import Lambert, Reflectance
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.scene.visible_intervals import VisibleIntervals
from gpuvision.simulation.transport.line_irradiance import LineIrradiance, LitSegments
from gpuvision.simulation.transport.mirror_facets import MirrorFacets
from gpuvision.simulation.transport.mirror_points import MirrorPoints
from gpuvision.simulation.transport.patches import FormFactors, Patches

TRIANGLE = np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
NORMALS = np.broadcast_to([0.0, 0.0, 1.0], (1, 3, 3))
SCENE = Scene(TRIANGLE)
SEGMENTS = LitSegments(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]), np.array([[0.0, 0.0, 1.0]]), np.ones(1))
PLANE = gv.Triangulation.from_stand_off(
    baseline=0.1, stand_off=0.2, focal_distance=0.016, region=((-3e-3, 3e-3), (-3e-3, 3e-3))
)
# An operation, and the shape of its input for a number of elements.
OPERATIONS: dict[str, tuple[Any, Any]] = {
    "psd": (PsdReadout(strip_length=6e-3), lambda n: (n, 2)),
    "triangulation": (PLANE, lambda n: (n,)),
    "range image": (RangeImage(geometry=StraightTransport()), lambda n: (1, n)),
    "merge": (gv.MergeHeights(), lambda n: (n,)),
    "closest hit": (ClosestHit(scene=SCENE), lambda n: (n, 6)),
    "any hit": (AnyHit(scene=SCENE), lambda n: (n, 6)),
    "visible": (VisibleIntervals(scene=SCENE), lambda n: (n, 11)),
    "reflectance": (Reflectance(model=Lambert(albedo=0.5)), lambda n: (n, 6)),
    "facets": (MirrorFacets(corners=TRIANGLE), lambda n: (n, 6)),
    "points": (MirrorPoints(corners=TRIANGLE, normals=NORMALS, numbers=np.zeros(1, int)), lambda n: (n, 6)),
    "lines": (LineIrradiance(segments=SEGMENTS), lambda n: (n, 6)),
    "patches": (FormFactors(patches=Patches(corners=TRIANGLE)), lambda n: (n, 6)),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_groups_on_a_gpu_are_whole_warps(name: str, device: Device) -> None:
    operation, shape = OPERATIONS[name]
    gpu = device.without_vectors()
    for count in (4096, 100_003):
        launch = operation.launch(gpu, shape(count), np.dtype(np.float32))
        group = launch.local_size[0]
        assert math.prod(launch.local_size) == group
        assert group % 32 == 0
        assert group <= 256
        assert launch.global_size[0] % group == 0


@pytest.mark.vectors
@pytest.mark.parametrize("name", ["facets", "points"])
def test_vectors_of_a_cpu_hold_16_elements(name: str, device: Device) -> None:
    """One work-item for each 16 lines or points, and no idle ones."""
    operation, shape = OPERATIONS[name]
    for count in (1, 16, 17, 160, 161):
        launch = operation.launch(device, shape(count), np.dtype(np.float32))
        assert math.prod(launch.global_size) == -(-count // 16)
