"""Examples of the kernels of `gpuvision.matching`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gpuvision.formats.field_file import read_field
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.field.distance_map import DistanceMap, DistanceMapBuilder
from gpuvision.matching.field.field_pose import FieldPoseRefinement, FieldPoseSearch
from gpuvision.matching.pose.board_pose import FitBoardLines, MeasureBoardEdges, SolveBoardLines
from gpuvision.matching.pose.edge_search import CellMeans, EdgeCostMap, EdgeSearch
from gpuvision.matching.pose.feature_pose import CameraFeatures, PlaceFeatures, SolveFeatures
from gpuvision.matching.pose.pose import SolvePose
from gpuvision.profiling.offline.builds import Example
from gpuvision.profiling.offline.ranging_builds import CAMERAS, LENSES

_IMAGE = (480, 640)
_TYPES = (np.uint8, np.uint16, np.float32)


def examples() -> Iterator[Example]:
    """Yield examples of every build option of these kernels."""
    yield from _rulers()
    yield from _blobs()
    yield from _lines()
    yield from _poses()
    yield from _board_poses()
    yield from _feature_poses()
    yield from _fields()
    yield from _edge_search()


def _rulers() -> Iterator[Example]:
    ruler = RulerEdges(threshold=12.0, count=100)
    for dtype in _TYPES:
        yield Example(f"strongest {np.dtype(dtype)}", ruler, _IMAGE, dtype)
    more: dict[str, dict[str, Any]] = {
        "first rising": {"edge_selection": "first", "polarity": "rising"},
        "last falling": {"edge_selection": "last", "polarity": "falling"},
        "all": {"edge_selection": "all"},
        "ambiguity": {"ambiguity": 0.5},
        "saturation": {"saturation": 250.0},
        "arc": {"radius_px": 100.0},
        "pairs": {"pairs": True, "polarity": "rising", "spacing_px": (4.0, 12.0)},
        "pairs falling": {"pairs": True, "polarity": "falling"},
        "per ruler": {"per_ruler": True},
        "lens": {"model": LENSES["lens k2"]},
        "camera": {"model": CAMERAS["k1 k2 p k3"]},
        "long": {"length": 256, "width": 15, "smoothing_px": 6.0},
    }
    for name, options in more.items():
        yield Example(name, replace(ruler, **options), _IMAGE, np.uint8)


def _blobs() -> Iterator[Example]:
    blobs = FindBlobs(threshold=12.0, count=2)
    for dtype in (np.uint8, np.float32):
        yield Example(f"circle {np.dtype(dtype)}", blobs, _IMAGE, dtype)
    for shape in ("ring", "cross"):
        yield Example(shape, replace(blobs, shape=shape), _IMAGE, np.uint8)
    yield Example("contour only", replace(blobs, match=False, polarity="either"), _IMAGE, np.uint8)
    yield Example("64 spokes", replace(blobs, spokes=64, saturation=250.0), _IMAGE, np.uint8)


def _lines() -> Iterator[Example]:
    for loss in ("least_squares", "huber", "tukey"):
        yield Example(loss, FitLines(loss=loss), (1000, 16, 2))
    more: dict[str, dict[str, Any]] = {
        "given scale, sigma": {"scale": 1.0, "weighted": True},
        "ransac": {"loss": "ransac", "scale": 1.0},
        "weights": {"with_weights": True},
        "least squares, given scale": {"loss": "least_squares", "scale": 1.0},
    }
    for name, options in more.items():
        yield Example(name, FitLines(**options), (1000, 16, 2))
    yield Example("1024 points", FitLines(), (1000, 1024, 2))
    yield Example("double", FitLines(), (1000, 16, 2), np.float64)


def _poses() -> Iterator[Example]:
    for transform in ("rigid", "similarity", "affine"):
        yield Example(f"{transform}", SolvePose(transform=transform), (16, 40, 7))
        biased = SolvePose(transform=transform, etch_bias_sigma=1e-5)
        yield Example(f"{transform}, etch bias", biased, (16, 40, 8))
    for loss in ("least_squares", "huber"):
        yield Example(f"{loss}, free scale", SolvePose(loss=loss, scale=None), (16, 40, 7))
    yield Example("ransac", SolvePose(loss="ransac"), (16, 40, 7))
    yield Example("initial pose", SolvePose(with_initial_pose=True), (16, 40, 7))
    yield Example("1024 rows", SolvePose(), (16, 1024, 7))
    yield Example("double", SolvePose(etch_bias_sigma=1e-5), (16, 40, 8), np.float64)


def _board_poses() -> Iterator[Example]:
    ruler = RulerEdges(threshold=20.0)
    edges = MeasureBoardEdges(ruler=ruler, lines=12, rulers_per_line=6)
    yield Example("edges, 12 lines x 6", edges, _IMAGE, np.uint8)
    yield Example("edges, lens", replace(edges, ruler=replace(ruler, model=LENSES["lens k1"])), _IMAGE, np.uint8)
    yield Example("fits", FitBoardLines(solver=SolvePose()), (12, 6, 2))
    biased = FitBoardLines(solver=SolvePose(loss="huber", etch_bias_sigma=1e-5, scale=None))
    yield Example("fits, etch bias, free scale", biased, (12, 6, 2))
    yield Example("pose, two rows of a line", SolveBoardLines(solver=SolvePose(), lines=12), (24, 7))


def _feature_poses() -> Iterator[Example]:
    ruler = (1e-3, 2e-3, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0)
    numbers: dict[str, Any] = {"placement": (0.01, 0.01), "pixel_size": 1e-5, "frame_shape": _IMAGE}
    every = CameraFeatures(rulers=(ruler,) * 40, matched=((0.0, 0.0, 1e-3),), drilled=((0.0, 1e-3, 1e-3),), **numbers)
    sets = {
        "all features": every,
        "lens": replace(every, model=LENSES["lens k2"]),
        "camera": replace(every, model=CAMERAS["k1 k2 p k3"]),
        "rulers": replace(every, matched=(), drilled=()),
        "fiducials": replace(every, rulers=(), matched=((0.0, 0.0, 1e-3),) * 3),
    }
    sigmas: dict[str, Any] = {
        "ruler_sigma_px": 0.02,
        "matched_sigma_px": 0.003,
        "drilled_sigma_px": 0.02,
        "size_tolerance": 0.2,
        "min_share": 0.5,
        "max_residual_px": 0.5,
    }
    for name, features in sets.items():
        yield Example(f"place, {name}", PlaceFeatures(features=features), (3,), np.float64)
        solve = SolveFeatures(features=features, solver=SolvePose(), **sigmas)
        yield Example(f"solve, {name}", solve, (3,), np.float64)
    solver = SolvePose(loss="huber", etch_bias_sigma=1e-5, scale=None)
    biased = SolveFeatures(features=every, solver=solver, **sigmas)
    yield Example("solve, etch bias, free scale", biased, (3,), np.float64)
    yield Example("place, no double", PlaceFeatures(features=every), (3,), has_double=False)
    solve = SolveFeatures(features=every, solver=SolvePose(), **sigmas)
    yield Example("solve, no double", solve, (3,), has_double=False)


def _fields() -> Iterator[Example]:
    field = read_field("robocup_junior")
    builder = DistanceMapBuilder(field=field, first_y=0.0, cell=0.01, rows=100, scale=0.05)
    yield Example("map", builder, (100,))
    found = DistanceMap(field=field, cell=0.05, scale=0.05, max_range=0.5)
    for scores in (False, True):
        search = FieldPoseSearch(map=found, with_scores=scores)
        yield Example(f"search{', scores' if scores else ''}", search, (64, 2))
    yield Example("refinement", FieldPoseRefinement(map=found, count=16), (64, 2))


def _edge_search() -> Iterator[Example]:
    for dtype in _TYPES:
        yield Example(f"means {np.dtype(dtype)}", CellMeans(), _IMAGE, dtype)
    yield Example("levels", EdgeCostMap(threshold=10.0, border=8), _IMAGE)
    for scores in (False, True):
        search = EdgeSearch(rows=16, columns=24, headings=3, points=512, with_scores=scores)
        yield Example(f"search{', scores' if scores else ''}", search, (8, 480, 640), np.uint16)
