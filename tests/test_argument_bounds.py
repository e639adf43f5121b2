"""Arguments at the ends of their ranges: the last accepted value, and the first refused one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import gpuvision as gv
from gpuvision.matching.features.imaging import Imaging
from gpuvision.ranging.focus import DepthFromFocus
from gpuvision.ranging.homography import triangulation_homography
from gpuvision.simulation.errors.range_error import StripErrorModel, interreflection_power_bound
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.transport.patches import Patches

TINY = 5e-324
AFTER_1 = math.nextafter(1.0, 2.0)
LINE = (0.0, 0.0, 1.0, 1.0)
IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
PLANE = gv.Triangulation(homography=IDENTITY, region=((0.0, 1.0), (0.0, 1.0)))
RULER = gv.RulerEdges(threshold=20.0)
READOUT = gv.LineReadout(threshold=5.0)
PSD = gv.PsdReadout(strip_length=6e-3)
FOCUS = DepthFromFocus(first=0.1, spacing=1e-3, focal_length=0.01)
BLUR = Imaging(pixel=25e-6)
MAP = gv.UndistortImage(model=gv.Lens(k1=1e-7))
TRIANGLE = np.eye(3)[None]
ONE = {"power": [1.0], "moment": [0.0], "slope": [1.0], "limits": (-1.0, 1.0)}


def replaced(example: Any, name: str) -> Callable[[Any], Any]:
    return lambda value: dataclasses.replace(example, **{name: value})


# Name of the case, what makes the object of a value, accepted values, refused values.
CASES: list[tuple[str, Callable[[Any], Any], list[Any], list[Any]]] = [
    ("SolvePose.search_range", replaced(gv.SolvePose(), "search_range"), [(0.0, 0.0)], [(-TINY, 1.0), (1.0, -TINY)]),
    ("SolvePose.max_leverage", replaced(gv.SolvePose(), "max_leverage"), [TINY, 1.0], [0.0, AFTER_1]),
    ("SolvePose.max_trials", replaced(gv.SolvePose(), "max_trials"), [16, 32], [0, 8, 17]),
    ("SolvePose.min_scale", replaced(gv.SolvePose(), "min_scale"), [TINY], [0.0]),
    ("RulerEdges.ambiguity", replaced(RULER, "ambiguity"), [TINY, 1.0], [0.0, AFTER_1]),
    ("RulerEdges.radius_px", replaced(RULER, "radius_px"), [-50.0, 50.0], [0.0]),
    ("RulerEdges.saturation", replaced(RULER, "saturation"), [1.0], [-1.0]),
    ("LineReadout widths", lambda v: dataclasses.replace(READOUT, minimum_width=v[0], maximum_width=v[1]),
     [(1, None), (3, 3)], [(0, None), (4, 3)]),
    ("LineReadout noise of ml", lambda v: dataclasses.replace(READOUT, method="ml", read_noise=v[0], gain=v[1]),
     [(1.0, 0.0), (0.0, 1.0)], [(0.0, 0.0)]),
    ("LineReadout window of ml", lambda v: dataclasses.replace(READOUT, method="ml", window=v), [3, 180], [2, 181]),
    ("LineReadout of centroid", lambda v: dataclasses.replace(READOUT, method="centroid", **v),
     [{}], [{"peak_selection": "first"}, {"ambiguity": 0.5}]),
    ("LineReadout.saturation", replaced(READOUT, "saturation"), [TINY], [0.0]),
    ("LineReadout.triangulation", replaced(READOUT, "triangulation"),
     [PLANE], [dataclasses.replace(PLANE, along="rows")]),
    ("PsdReadout.layout", replaced(PSD, "layout"), ["pairs", "planar"], ["rows"]),
    ("Triangulation.region", replaced(PLANE, "region"),
     [((0.0, 1.0), (0.5, 0.5))], [((0.5, 0.5), (0.0, 1.0)), ((0.0, 1.0), (0.6, 0.5))]),
    ("Triangulation.sigma", replaced(PLANE, "sigma"), [(0.0, 0.0)], [(-TINY, 1.0), (1.0, -TINY)]),
    ("Triangulation.horizon", replaced(PLANE, "horizon"), [TINY, 0.5], [0.0, 1.0]),
    ("Triangulation.along", replaced(PLANE, "along"), ["columns", "rows"], ["across"]),
    ("DepthFromFocus.spacing", replaced(FOCUS, "spacing"), [TINY], [0.0]),
    ("DepthFromFocus.first", replaced(FOCUS, "first"), [math.nextafter(0.01, 1.0)], [0.01]),
    ("DepthFromFocus.minimum", replaced(FOCUS, "minimum"), [0.0], [-TINY]),
    ("DepthFromFocus.sigma_intensity", replaced(FOCUS, "sigma_intensity"), [TINY], [0.0]),
    ("Imaging.etch_bias_sigma", replaced(BLUR, "etch_bias_sigma"), [0.0], [-TINY]),
    ("Imaging.registration", replaced(BLUR, "registration"), [0.0], [-TINY]),
    ("Imaging.width_px", replaced(BLUR, "width_px"), [1], [0]),
    ("UndistortImage.size", replaced(MAP, "size"), [(1, 1)], [(0, 1), (1, 0), (1, 1, 1)]),
    ("UndistortImage.region", replaced(MAP, "region"), [(-1, -1, 1, 1)], [(0, 0, 0, 1), (0, 0, 1, 0), (1, 1)]),
    ("UndistortImage.matrix", replaced(MAP, "matrix"), [None], [IDENTITY]),
    ("Field without lines", lambda v: gv.Field(length=1.0, width=1.0, lines=v), [(LINE,)], [()]),
    ("Field.lines", lambda v: gv.Field(length=1.0, width=1.0, lines=(v,)), [LINE], [(0.5, 0.5, 0.5, 0.5)]),
    ("Field.arcs", lambda v: gv.Field(length=1.0, width=1.0, arcs=((0.0, 0.0, *v),)),
     [(TINY, 0.0, 1.0), (1.0, 1.0, 1.0 + 2.0 * math.pi)], [(0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (1.0, 0.0, 6.3)]),
    ("baseline stand_off focal_distance", lambda v: triangulation_homography(*v, 0.1),
     [(0.1, 0.2, 0.01)], [(0.0, 0.2, 0.01), (0.1, 0.0, 0.01), (0.1, 0.2, 0.0)]),
    ("albedo of a bound", lambda v: interreflection_power_bound(1.0, v, 1.0), [0.0, 1.0], [-TINY, AFTER_1]),
    ("power of a bound", lambda v: interreflection_power_bound(v, 0.5, 1.0), [0.0], [-TINY]),
    ("solid angle of a bound", lambda v: interreflection_power_bound(1.0, 0.5, v), [0.0], [-TINY]),
    ("power of a strip", lambda v: StripErrorModel(**{**ONE, "power": [v]}), [0.0], [-TINY]),
    ("limits of a strip", lambda v: StripErrorModel(**{**ONE, "limits": v}), [(0.0, TINY)], [(0.0, 0.0), (1.0, 0.0)]),
    ("Mask.leak", lambda v: Mask(leak=v), [0.0, 1.0], [-TINY, AFTER_1]),
    ("Mask.windows", lambda v: Mask(windows=v), [[[0.5, 0.5]]], [[[0.6, 0.5]], [0.0, 1.0]]),
    ("Mask.transmission", lambda v: Mask(transmission=v), [[[0.0, 1.0]]], [[[-TINY]], [[AFTER_1]], [0.5]]),
    ("Patches.patch", lambda v: Patches(np.repeat(TRIANGLE, len(v), axis=0), patch=v),
     [[0], [0, 0, 1]], [[1], [0, 2], [0, 1, 0]]),
    ("Patches.slack", lambda v: Patches(TRIANGLE, slack=v), [[0.0]], [[-TINY], [0.0, 0.0]]),
    ("area of Patches", lambda v: Patches(np.array([[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, v, 0.0]]])), [1.0], [0.0]),
    ("Scene.corners", gv.Scene, [TRIANGLE], [TRIANGLE[0], np.zeros((1, 3, 2))]),
    ("Material.mirror", lambda v: gv.Material(diffuse=gv.Lambert(albedo=0.25), mirror=v), [0.0, 0.75], [-TINY, 0.8]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "make", "accepted", "refused"), CASES, ids=[case[0] for case in CASES])
def test_ends_of_an_argument(name: str, make: Callable[[Any], Any], accepted: list[Any], refused: list[Any]) -> None:
    for value in accepted:
        make(value)
    for value in refused:
        with pytest.raises((ValueError, TypeError)) as caught:
            make(value)
        message = str(caught.value)
        assert "\n" not in message
        assert any(word in message for word in name.replace(".", " ").split()), message
