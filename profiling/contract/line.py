"""Contract of the line readout: both axes, all sample types and methods, dark profiles, holes and odd shapes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference.line import read_lines
from gpuvision.reference.triangulation import triangulate

_GAUSS3, _FIR = 'method="gauss3"', 'method="fir"'
_LEVER = "lever: half of the window, or the profile for the centroid [px]"
LIMITS = {
    "LineReadout": (
        equal("status", "peak", "width", reason="comparisons of samples, which are read exactly"),
        roundings(
            3, "position", of=f"position + {_LEVER}",
            reason="quotient, product and sum at the peak; compensated sums of light times distance",
        ),
        roundings(
            3, "position", of="position + (1 + largest logarithm) / curvature of the logarithms [px]", when=_GAUSS3,
            reason="three logarithms of 3 ulp (OpenCL), differences, quotient and sum",
        ),
        roundings(3, "position", of="position + 2 px", when=_FIR, reason="sums of integers are exact; quotients, sums"),
        roundings(2, "total", of="sum of the light [levels]", reason="compensated sum, and its end"),
    )
}  # fmt: skip
_TOP = {"uint8": 180.0, "uint16": 40_000.0, "float32": 128.0}
_LEVEL = {"uint8": 20.0, "uint16": 4000.0, "float32": 8.5}
_WINDOW = 6
# Sensor of 137 rows and 201 columns. The denominator of the homography is 1 in row 68 and 0.3 in row 118: there is the
# horizon. The lens folds at 90 px from the middle, within the corners of the image.
_HOMOGRAPHY = ((1e-5, 2e-4, -0.01), (-2e-4, 1e-6, 0.012), (-0.014, 0.0, 1.952))
_REGION = ((36.0, 100.0), (50.0, 150.0))
_HORIZON = 0.3
_LENS = Lens(k1=-1.0 / (3.0 * 90.0**2), centre=(100.0, 68.0))


def cases() -> Iterator[Case]:
    """Yield centroids of each sample type along both axes, the other methods, and profiles without a line."""
    rng = np.random.default_rng(25)
    for dtype in ("uint8", "uint16", "float32"):
        for along, shape in (("columns", (2, 137, 201)), ("rows", (1, 50, 1025))):
            frames = _frames(rng, dtype, shape, along)
            yield _case(f"windowed, {dtype}, {along}", frames, method="windowed", along=along)
        yield _case(f"centroid, {dtype}", _frames(rng, dtype, (1, 64, 65), "columns"), method="centroid")
    for method in ("gauss3", "fir"):
        yield _case(f"{method}, uint16", _frames(rng, "uint16", (1, 60, 83), "columns", swing=0.35), method=method)
    for dtype in ("uint8", "float32"):
        yield _case(f"extremes, {dtype}", _extremes(dtype), ambiguity=0.5)
    holes = _frames(rng, "float32", (2, 137, 201), "columns", swing=0.45)
    holes[0, 5:9, ::7] = np.nan
    holes[1, 30, 3::7] = np.inf
    yield _case("holes, float32", holes)
    yield from _triangulated(_frames(rng, "uint8", (2, 137, 201), "columns"))


def _frames(
    rng: np.random.Generator, dtype: str, shape: tuple[int, ...], along: str, *, swing: float = 0.5
) -> npt.NDArray[Any]:
    """Return frames of a line that leaves the image at a swing of 0.5, over noise; some profiles are dark."""
    *batch, rows, columns = shape
    length, samples = (rows, columns) if along == "columns" else (columns, rows)
    place = length * (0.5 + swing * np.sin(0.05 * np.arange(samples))) + rng.uniform(-0.5, 0.5, (*batch, samples))
    light = np.where(rng.random((*batch, samples)) < 0.06, 0.0, rng.uniform(0.3, 1.0, (*batch, samples)))
    profiles = light[..., None, :] * np.exp(-((np.arange(length)[:, None] - place[..., None, :]) ** 2) / (2 * 1.7**2))
    profiles = _TOP[dtype] * (profiles + rng.uniform(0.0, 0.07, profiles.shape))
    frames = profiles if along == "columns" else np.swapaxes(profiles, -1, -2)
    return np.ascontiguousarray(frames.astype(dtype))


def _extremes(dtype: str) -> npt.NDArray[Any]:
    """Return a frame of dark, saturated, wide, cut and doubled lines, and of levels at the threshold."""
    frame = np.zeros((1, 61, 97), dtype)
    top = 255 if dtype == "uint8" else 1e6
    frame[0, 20:23, :20] = _TOP[dtype]
    frame[0, 20:40, 20:30] = top
    frame[0, :4, 30:40] = frame[0, -4:, 40:50] = _TOP[dtype]
    frame[0, 15, 50:60] = frame[0, 45, 55:65] = _TOP[dtype]
    frame[0, 30, 65:75] = np.asarray(_LEVEL[dtype], dtype) + np.arange(-5, 5).astype(dtype)
    frame[0, :, 75:80] = _TOP[dtype]
    return frame


def _case(name: str, frames: npt.NDArray[Any], *, triangulation: Triangulation | None = None, **settings: Any) -> Case:
    parameters = {"method": "windowed", "threshold": _LEVEL[frames.dtype.name], "window": _WINDOW, **settings}
    expected = read_lines(frames, **parameters)
    exact = {key: expected[key] for key in ("position", "peak", "width", "total", "status")}
    method, along = parameters["method"], parameters.get("along", "columns")
    when = {"gauss3": _GAUSS3, "fir": _FIR}.get(method, "")
    lever: Any = frames.shape[-2 if along == "columns" else -1] if method == "centroid" else _WINDOW
    if method == "gauss3":
        lever = _spread_of_logarithms(frames, expected["position"], parameters["threshold"])
    elif method == "fir":
        lever = 2.0
    quantities = {"position": np.abs(expected["position"]) + lever, "total": np.abs(expected["total"])}
    template = LineReadout(triangulation=triangulation, **parameters)
    return Case("LineReadout", name, template, (frames,), exact, quantities, when=when)


def _triangulated(frames: npt.NDArray[Any]) -> Iterator[Case]:
    """Yield readouts with the flags of the triangulation: beyond the horizon, and beyond the fold of a lens."""
    column = np.broadcast_to(np.arange(frames.shape[2]), (len(frames), frames.shape[2]))
    for name, lens in (("horizon", None), ("fold of the lens", _LENS)):
        sheet = Triangulation(homography=_HOMOGRAPHY, region=_REGION, horizon=_HORIZON, lens=lens)
        terms = None if lens is None else (lens.k1, lens.k2, lens.centre)
        case = _case(f"{name}, uint8", frames, triangulation=sheet)
        position, status = case.exact["position"], case.exact["status"]
        _, _, flags = triangulate(position, column, _HOMOGRAPHY, _REGION, horizon=_HORIZON, lens=terms)
        status = np.where(np.isfinite(position), status | flags, status)
        yield replace(case, exact={**case.exact, "status": status})


def _spread_of_logarithms(frames: npt.NDArray[Any], position: npt.NDArray[Any], threshold: float) -> npt.NDArray[Any]:
    """Return (1 + largest logarithm) / curvature of the three samples at each peak (frames, columns)."""
    light = np.log(np.maximum(frames.astype(np.float64) - threshold, 1e-300))
    at = np.clip(np.nan_to_num(np.rint(position)), 1, frames.shape[1] - 2).astype(int)[:, None]
    # The peak is the sample nearest to the position, or its neighbour at half a pixel.
    rows = np.concatenate([np.take_along_axis(light, at + k, axis=1) for k in (-1, 0, 1)], axis=1)
    curvature = np.abs(rows[:, 0] - 2.0 * rows[:, 1] + rows[:, 2])
    return np.asarray((1.0 + np.abs(rows).max(axis=1)) / np.maximum(curvature, 1e-300))
