"""Operations that `gpuvision tune` tunes, with inputs of any size: typical values, and values that get a flag."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.camera import Camera
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.host import Operation
from gpuvision.ranging.merge_heights import MergeHeights
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.triangulation import Triangulation

Case = tuple[Operation[Any], Callable[[int], Sequence[NDArray[Any]]]]

_CAMERA = Camera(
    matrix=((1400.0, 0.0, 960.0), (0.0, 1400.0, 600.0), (0.0, 0.0, 1.0)),
    distortion=(-0.2, 0.08, 4e-4, -3e-4, 0.01, *(0.0,) * 9),
)
# Camera with a focal length of 1700 px, 0.35 m from the sheet, at an angle of 35 degrees.
_HOMOGRAPHY = ((1.3e-6, 2.1e-4, -0.134), (2.5e-4, 2.0e-6, -0.131), (-4.2e-4, 8.0e-6, 1.21))
_ODD = 97  # every 97th value is special: not a divisor of a group or strip


def _psd(dtype: str) -> Case:
    def currents(elements: int) -> Sequence[NDArray[Any]]:
        values = np.random.default_rng(1).uniform(200.0, 40_000.0, (2, elements // 2)).astype(dtype)
        values[:, ::_ODD] = 0
        values[0, 5::_ODD] = 65_000
        if dtype == "float32":
            values[1, 9::_ODD] = np.nan
        return [values]

    return PsdReadout(strip_length=6e-3, minimum_total=100.0, saturation=60_000.0, layout="planar"), currents


def _triangulation(dtype: str) -> Case:
    def coordinates(elements: int) -> Sequence[NDArray[Any]]:
        rng = np.random.default_rng(2)
        u, v = rng.uniform(0.0, 1023.0, elements).astype(dtype), rng.uniform(0.0, 1279.0, elements).astype(dtype)
        u[::_ODD], v[3::_ODD], u[7::_ODD] = np.nan, np.inf, 2881.0
        return [u, v]

    region = ((0.0, 1023.0), (0.0, 1279.0))
    return Triangulation(homography=_HOMOGRAPHY, region=region), coordinates


def _points(dtype: str) -> Case:
    def points(elements: int) -> Sequence[NDArray[Any]]:
        rng = np.random.default_rng(3)
        values = rng.uniform((0.0, 0.0), (1920.0, 1200.0), (elements // 2, 2)).astype(dtype)
        values[::_ODD] = np.nan
        values[4::_ODD] = 1e6
        return [values]

    return UndistortPoints(model=_CAMERA), points


def _merge_heights(dtype: str) -> Case:
    def maps(elements: int) -> Sequence[NDArray[Any]]:
        rng = np.random.default_rng(4)
        arrays: list[NDArray[Any]] = []
        for _ in range(2):
            heights = rng.normal(0.01, 1e-5, elements).astype(dtype)
            heights[rng.integers(0, _ODD) :: _ODD] = np.nan
            status = np.where(rng.random(elements) < 0.05, 1, 0).astype(np.uint8)
            arrays += [heights, rng.uniform(0.0, 255.0, elements).astype(dtype), status]
        return arrays

    return MergeHeights(tolerance=2e-5), maps


# Makers of the operation with its inputs, and dtypes, by the name on the command line.
_MAKERS: dict[str, tuple[Callable[[str], Case], tuple[str, ...]]] = {
    "psd": (_psd, ("float32", "uint16")),
    "triangulation": (_triangulation, ("float32", "float64")),
    "points": (_points, ("float32", "float64")),
    "merge_heights": (_merge_heights, ("float32",)),
}
NAMES = tuple(_MAKERS)


def cases(name: str) -> Iterator[Case]:
    """Yield an operation for each dtype, with a function that makes its inputs."""
    make, dtypes = _MAKERS[name]
    for dtype in dtypes:
        yield make(dtype)
