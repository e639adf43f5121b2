"""Lens fits to straight lines against discorpy's best functions, on discorpy's real target images if available.

discorpy's functions are ``find_cod_bailey``, ``correct_perspective_effect`` and ``calc_coef_backward`` with five
coefficients, on float64 points (single precision has no effect under NumPy 2). Both libraries get the same points. The
error is the straightness: root mean square distance of the corrected points from straight lines, independent of scale.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.line_families import grid_lines
from gpuvision.camera.lines.vanishing_points import fit_lens, straightness_px
from gpuvision.camera.patterns.dots import find_dots
from gpuvision.camera.patterns.line_pattern import find_lines
from gpuvision.host import Device
from gpuvision.profiling.harness import Case

Float64 = NDArray[np.float64]
Families = tuple[tuple[Float64, ...], ...]

_DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "calibration"
_COEFFICIENTS = 5
_IMAGE = (2560, 2160)
# Case name, image file, and rows and columns of the synthetic grid that replaces a missing image.
_TARGETS = (
    ("fit/66x96", "dot_pattern_01.jpg", (66, 96)),
    ("fit/33x39", "dot_pattern_02.jpg", (33, 39)),
    ("fit/lines", "line_pattern_01.jpg", (34, 140)),
)


class Radial(NamedTuple):
    """discorpy's radial model, as a model with ``undistort``."""

    column: float
    row: float
    coefficients: Float64

    def undistort(self, points: Float64) -> Float64:
        """Return undistorted (column, row) by inverting the backward polynomial with Newton steps."""
        offset = np.asarray(points, dtype=np.float64) - (self.column, self.row)
        radius = np.hypot(offset[..., 0], offset[..., 1])
        backward = np.polynomial.Polynomial([0.0, *self.coefficients])
        found = radius.copy()
        for _ in range(30):
            found -= (backward(found) - radius) / backward.deriv()(found)
        return np.asarray((self.column, self.row) + offset * (found / np.maximum(radius, 1e-12))[..., None])


def cases(device: Device) -> Iterator[Case]:
    """Yield fits of k1 and k2 to the lines of each target: two dot grids and one line grid.

    The cases ``fit/`` have the covariance for independent errors, the cases ``tested/`` test the residuals for lack
    of fit and include a smooth field of them in the covariance. discorpy estimates no errors in either case.
    """
    for name, file, shape in _TARGETS:
        yield case_of(name, file, shape, "independent")
        yield case_of(name.replace("fit/", "tested/"), file, shape, "auto")


@functools.lru_cache(maxsize=2 * len(_TARGETS))
def case_of(name: str, file: str, shape: tuple[int, int], error_model: Literal["auto", "independent"]) -> Case:
    """Return the case of a target, or of a synthetic grid if the image is missing."""
    families, measured = _measured(file) if (_DATA / file).is_file() else _synthetic(shape)

    def ours() -> Lens | None:
        return fit_lens(families, model="k1,k2", lines="free", error_model=error_model).lens

    theirs = discorpy_fit(families)
    start = time.perf_counter()
    chosen = fit_lens(families)
    seconds = time.perf_counter() - start
    metadata = measured | {
        "points": sum(len(line) for family in families for line in family),
        "error_raw": straightness_px(families),
        "error_discorpy": straightness_px(families, theirs()),
        "model": f"{chosen.model}, {chosen.lines}",
        "seconds_with_choice": seconds,
    }
    return Case("calibration", name, ours, {"discorpy": theirs}, straightness_px(families, ours()), metadata=metadata)


def discorpy_fit(families: Families) -> Callable[[], Radial]:
    """Return a function that runs discorpy's fit to rows and columns; discorpy takes points as (row, column)."""
    from discorpy.proc import processing

    horizontal, vertical = ([np.ascontiguousarray(line[:, ::-1]) for line in family] for family in families)

    def fit() -> Radial:
        column, row = processing.find_cod_bailey(horizontal, vertical)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            flat = processing.correct_perspective_effect(horizontal, vertical, column, row)
            coefficients = processing.calc_coef_backward(*flat, column, row, _COEFFICIENTS)
        return Radial(float(column), float(row), np.asarray(coefficients))

    return fit


@functools.cache
def _measured(file: str) -> tuple[Families, dict[str, Any]]:
    """Return the lines of a real target found by our finders, and the times of both libraries (discorpy: one run)."""
    image = cv2.imread(str(_DATA / file), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    finds = _discorpy_lines if file.startswith("line") else _discorpy_dots
    times = []
    for find in (lambda: finds(image.astype(np.float64)), *3 * (lambda: _found(image, file),)):
        start = time.perf_counter()
        found = find()
        times.append(time.perf_counter() - start)
    metadata = {"data": file, "seconds_to_find": float(np.median(times[1:])), "seconds_to_find_discorpy": times[0]}
    return found, metadata


def _found(image: NDArray[Any], file: str) -> Families:
    return find_lines(image) if file.startswith("line") else grid_lines(find_dots(image).points)


def _discorpy_dots(image: Float64) -> Any:
    """Find dots as in discorpy's demonstrations."""
    from discorpy.prep import preprocessing

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mask = preprocessing.binarization(image)
        size, distance = preprocessing.calc_size_distance(mask)
        mask = preprocessing.select_dots_based_ratio(preprocessing.select_dots_based_size(mask, size))
        slopes = preprocessing.calc_hor_slope(mask), preprocessing.calc_ver_slope(mask)
        horizontal = preprocessing.group_dots_hor_lines(mask, slopes[0], distance)
        vertical = preprocessing.group_dots_ver_lines(mask, slopes[1], distance)
    return horizontal, vertical


def _discorpy_lines(image: Float64) -> Any:
    """Find points on lines as in discorpy's demonstration."""
    from discorpy.prep import linepattern, preprocessing

    found = {"radius": 15, "sensitive": 0.5}
    grouped = {"ratio": 0.1, "num_dot_miss": 2, "accepted_ratio": 0.8}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        across = linepattern.calc_slope_distance_hor_lines(image, **found)
        down = linepattern.calc_slope_distance_ver_lines(image, **found)
        points = linepattern.get_cross_points_hor_lines(image, *down, bgr="bright", **found)
        horizontal = preprocessing.group_dots_hor_lines(points, *across, **grouped)
        points = linepattern.get_cross_points_ver_lines(image, *across, bgr="bright", **found)
        vertical = preprocessing.group_dots_ver_lines(points, *down, **grouped)
    return horizontal, vertical


def _synthetic(shape: tuple[int, int]) -> tuple[Families, dict[str, Any]]:
    """Return the lines of a tilted grid of points with noise of 0.05 px."""
    rng = np.random.default_rng(1)
    points = tilted_grid(shape, 5.0, _IMAGE)
    lens = Lens(k1=1.6e-8, k2=6e-16, centre=(1257.0, 1020.0))
    return grid_lines(lens.distort(points) + rng.normal(0.0, 0.05, points.shape)), {"data": "synthetic"}


def tilted_grid(
    shape: tuple[int, int], degrees: float, size: tuple[int, int], *, direction: float = 0.8, focal: float = 3000.0
) -> Float64:
    """Return ideal image points (rows, columns, 2) of a tilted plane grid that fills 0.85 of an image."""
    v, u = np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in shape), indexing="ij")
    flat = (size[0] * u + 1j * size[1] * v) * np.exp(-1j * direction)
    depth = 1.0 + np.sin(np.radians(degrees)) * flat.imag / focal
    seen = (flat.real + 1j * np.cos(np.radians(degrees)) * flat.imag) / depth * np.exp(1j * direction)
    seen -= 0.5 * (seen.real.max() + seen.real.min() + 1j * (seen.imag.max() + seen.imag.min()))
    seen *= 0.425 / max(seen.real.max() / size[0], seen.imag.max() / size[1])
    return np.stack([seen.real + 0.5 * size[0], seen.imag + 0.5 * size[1]], axis=-1)
