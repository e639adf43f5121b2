"""Examples of the kernels of `gpuvision.camera`, `gpuvision.ranging` and `gpuvision.inspection`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.camera.undistort_points import UndistortPoints
from gpuvision.inspection.deposits import MeasureDeposits
from gpuvision.profiling.offline.builds import Example
from gpuvision.ranging.height_map import Grid
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import LineReading
from gpuvision.ranging.merge_heights import MergeHeights
from gpuvision.ranging.psd import PsdNoise, PsdReading, PsdReadout
from gpuvision.ranging.range_image import RangeImage
from gpuvision.ranging.regrid import Regrid
from gpuvision.ranging.sheet import BentSheet
from gpuvision.ranging.sheet_motion import RotatingSheet, StraightTransport
from gpuvision.ranging.triangulation import Triangulation

_FRAMES = (4, 512, 1024)
_MATRIX = ((900.0, 0.0, 511.5), (0.0, 910.0, 255.5), (0.0, 0.0, 1.0))
_OTHER = ((800.0, 0.0, 320.0), (0.0, 800.0, 240.0), (0.0, 0.0, 1.0))  # matrix of ideal pixels
_HOMOGRAPHY = ((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (0.0, 1e-5, 1.0))
_REGION = ((0.0, 511.0), (0.0, 1023.0))
# Coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tau_x, tau_y.
_FOLDING = (-0.3, 0.05)
_OPENCV = (-0.1, 0.02, 1e-4, -2e-4, -1e-3)
_ALL_TERMS = (-0.1, 0.02, 1e-4, -2e-4, -1e-3, 1e-2, 1e-3, 1e-4, 1e-4, -1e-4, 1e-4, 1e-5, 0.01, -0.02)


def camera(*distortion: float) -> Camera:
    """Return a camera with the first of OpenCV's distortion coefficients."""
    return Camera(matrix=_MATRIX, distortion=(*distortion, *(0.0,) * (14 - len(distortion))))


CAMERAS = {
    "k1": camera(-0.1),
    "k1 k2": camera(*_FOLDING),
    "k1 k2 p k3": camera(*_OPENCV),
    "rational 1": camera(-0.1, 0.0, 0.0, 0.0, 0.0, 0.01),
    "rational 2": camera(-0.1, 0.02, 0.0, 0.0, 0.0, 0.01, 0.001),
    "14 terms": camera(*_ALL_TERMS),
}
LENSES = {
    "lens k1": Lens(k1=-1e-9),
    "lens k2": Lens(k1=-1e-9, k2=-1e-16),
    "lens k3": Lens(k1=-1e-9, k2=-1e-16, k3=-1e-23),
    "lens k4": Lens(k1=-1e-9, k2=-1e-16, k3=-1e-23, k4=-1e-30),
}


def polynomial() -> PlanePolynomial:
    """Return a polynomial from the sensor to the plane of the sheet."""
    terms = (0.0, 1e-4, 0.0, 1e-9, 0.0, 0.0, 0.0, 0.0)
    return PlanePolynomial(p=terms, q=terms, region=_REGION)


def triangulation(**more: Any) -> Triangulation:
    """Return the triangulation of a sensor of 512 x 1024 pixels."""
    return Triangulation(**{"homography": _HOMOGRAPHY, "region": _REGION} | more)


def examples() -> Iterator[Example]:
    """Yield examples of every build option of these kernels."""
    yield from _psd()
    yield from _line()
    yield from _triangulation()
    yield from _undistort_image()
    yield from _undistort_points()
    yield from _range_image()
    yield from _heights()


def _psd() -> Iterator[Example]:
    noise = PsdNoise(independent=1e-9, background=1e-6, bandwidth=1e5)
    with_all: dict[str, Any] = {"triangulation": triangulation(sigma=(1e-6, 1e-6), covariance=_covariance())}
    cases: dict[str, tuple[dict[str, Any], Any]] = {
        "pairs": ({}, np.float32),
        "codes, total": ({"outputs": ("total", "status")}, np.uint16),
        "planar codes, position": ({"layout": "planar", "outputs": ("position",)}, np.uint16),
        "dark, gain": ({"dark": (1.0, 2.0), "right_gain": 1.1}, np.uint16),
        "linearity": ({"linearity": ((0.0, 1e-5, 0.0),) * 16}, np.float32),
        "sigma, background": ({"noise": noise, "outputs": ("position", "total", "status", "sigma")}, np.float32),
        "sheet": ({"triangulation": triangulation()}, np.float32),
        "sheet with sigmas": (
            with_all | {"noise": noise, "outputs": tuple(PsdReading._fields)},
            np.float32,
        ),
        "double": ({}, np.float64),
    }
    for name, (more, dtype) in cases.items():
        shape = (2, 1000, 16) if more.get("layout") == "planar" else (1000, 16, 2)
        yield Example(name, PsdReadout(**{"strip_length": 6e-3} | more), shape, dtype)


def _covariance() -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in (1e-12 * np.eye(8)).tolist())


def _line() -> Iterator[Example]:
    for method in ("windowed", "centroid", "gauss3", "fir", "ml"):
        for dtype in (np.uint8, np.float32):
            yield Example(f"{method} {np.dtype(dtype)}", LineReadout(method=method, gain=0.1), _FRAMES, dtype)
        with_sigma = LineReadout(method=method, gain=0.1, outputs=("position", "status", "sigma"))
        yield Example(f"{method} uint16 sigma", with_sigma, _FRAMES, np.uint16)
    for selection in ("first", "last", "nearest"):
        yield Example(f"windowed {selection}", LineReadout(peak_selection=selection), _FRAMES, np.uint8)
    yield Example("fir 8 taps", LineReadout(method="fir", fir_length=8), _FRAMES, np.uint8)
    yield Example("windowed 100", LineReadout(window=100), _FRAMES, np.uint8)
    yield Example("ambiguity", LineReadout(ambiguity=0.5, outputs=("peak", "status")), _FRAMES, np.uint8)
    yield Example("width limits", LineReadout(minimum_width=2, maximum_width=9), _FRAMES, np.uint8)
    yield Example("position along rows", LineReadout(along="rows", outputs=("position",)), _FRAMES, np.uint8)
    yield Example("centroid along rows, long", LineReadout(method="centroid", along="rows"), (4, 8, 9000), np.uint16)
    in_double = LineReadout(method="centroid", along="rows", precision="double")
    yield Example("centroid along rows, double", in_double, _FRAMES, np.float32)
    yield Example("double", LineReadout(method="ml", gain=0.1, precision="double"), _FRAMES, np.uint16)
    names = tuple(name for name in LineReading._fields if not name.startswith("systematic"))
    fused: dict[str, Triangulation] = {
        "sheet": triangulation(),
        "sheet behind a lens": triangulation(lens=LENSES["lens k2"]),
        "sheet behind a camera": triangulation(camera=CAMERAS["k1 k2 p k3"]),
        "sheet by polynomial": Triangulation.from_polynomial(polynomial()),
    }
    for name, sheet in fused.items():
        yield Example(name, LineReadout(triangulation=sheet, outputs=names), _FRAMES, np.uint8)
    everything = LineReadout(triangulation=triangulation(covariance=_covariance()), outputs=LineReading._fields)
    yield Example("sheet, systematic errors", everything, _FRAMES, np.uint8)
    rows = LineReadout(along="rows", triangulation=triangulation(camera=CAMERAS["14 terms"], along="rows"))
    yield Example("sheet behind a camera, rows", rows, _FRAMES, np.uint8)
    in_double = LineReadout(triangulation=triangulation(camera=CAMERAS["k1"]), precision="double")
    yield Example("sheet behind a camera, double", in_double, _FRAMES, np.uint8)


def _triangulation() -> Iterator[Example]:
    cases: dict[str, Triangulation] = {
        "homography": triangulation(),
        "sigmas": triangulation(sigma=(0.1, 0.1)),
        "covariance": triangulation(sigma=(0.1, 0.1), covariance=_covariance()),
        **{name: triangulation(lens=lens) for name, lens in LENSES.items()},
        **{f"camera {name}": triangulation(camera=each) for name, each in CAMERAS.items()},
        "camera, rows": triangulation(camera=CAMERAS["k1 k2 p k3"], along="rows", sigma=(0.1, 0.1)),
        "polynomial": Triangulation.from_polynomial(polynomial(), sigma=(0.1, 0.1)),
    }
    for name, operation in cases.items():
        yield Example(name, operation, (100_000,))
    yield Example("double", triangulation(sigma=(0.1, 0.1)), (100_000,), np.float64)


def _undistort_image() -> Iterator[Example]:
    shape, model = (480, 640), CAMERAS["k1 k2 p k3"]
    for dtype in (np.uint8, np.uint16, np.float32):
        for interpolation in ("bilinear", "bicubic"):
            operation = UndistortImage(model=model, interpolation=interpolation)
            yield Example(f"{interpolation} {np.dtype(dtype)}", operation, shape, dtype)
    for border in ("constant", "reflect", "replicate"):
        yield Example(f"border {border}", UndistortImage(model=model, border=border), shape, np.uint8)
    yield Example("colour", UndistortImage(model=model, channels=3), (*shape, 3), np.uint8)
    yield Example("colour bicubic", UndistortImage(model=model, channels=3, interpolation="bicubic"), (*shape, 3), "u1")
    for name, each in (CAMERAS | LENSES).items():
        more: dict[str, Any] = {"matrix": _OTHER} if name == "14 terms" else {}
        yield Example(f"computed {name}", UndistortImage(model=each, coordinates="computed", **more), shape, np.uint8)


def _undistort_points() -> Iterator[Example]:
    models: dict[str, Any] = CAMERAS | LENSES | {"polynomial": polynomial()}
    for name, model in models.items():
        for inverse in (False, True):
            operation = UndistortPoints(model=model, inverse=inverse)
            yield Example(f"{name}{', inverse' if inverse else ''}", operation, (100_000, 2))
    for inverse in (False, True):
        operation = UndistortPoints(model=CAMERAS["14 terms"], inverse=inverse, matrix=_OTHER)
        yield Example(f"14 terms double{', inverse' if inverse else ''}", operation, (100_000, 2), np.float64)


def _range_image() -> Iterator[Example]:
    bend = BentSheet(terms=(1e-3, 0.0, 0.0), pinhole=(0.0, 0.0, 0.2))
    rotating: dict[str, Any] = {
        "axis_point": (0.12, 0.01, -0.02),
        "axis_direction": (0.0, 1.0, 0.0),
        "sheet_normal": (1.0, 0.1, -0.05),
        "angle_step": 0.01,
    }
    pinhole: dict[str, Any] = {"focal_length_px": 900.0, "principal_point_px": (511.5, 255.5)}
    geometries: dict[str, Any] = {
        "straight": StraightTransport(step=1e-4),
        "bent": StraightTransport(step=1e-4, bend=bend),
        "rotating": RotatingSheet(**rotating, **pinhole),
        "rotating, lens": RotatingSheet(**rotating, **pinhole, lens=Lens(k1=-0.1, k2=0.01)),
        "rotating, camera": RotatingSheet(**rotating, camera=CAMERAS["k1 k2 p k3"]),
        "rotating, camera, columns": RotatingSheet(**rotating, camera=CAMERAS["14 terms"], along="columns"),
    }
    for name, geometry in geometries.items():
        yield Example(name, RangeImage(geometry=geometry), (512, 1024))
    yield Example("straight, double", RangeImage(geometry=geometries["straight"]), (512, 1024), np.float64)


def _heights() -> Iterator[Example]:
    grid = Grid(left=0.0, top=0.1, cell_x=1e-4, cell_y=1e-4, columns=500, rows=500)
    for sigma in (False, True):
        words = " with sigma" if sigma else ""
        yield Example(f"merge{words}", MergeHeights(sigma=sigma), (500, 500))
        along_samples, along_profiles = Regrid(grid=grid, max_gap=1e-3, max_step=1e-3, sigma=sigma).passes
        yield Example(f"along samples{words}", along_samples, (512, 1024))
        yield Example(f"along profiles{words}", along_profiles, (512, 1024))
    yield Example("merge, double", MergeHeights(sigma=True), (500, 500), np.float64)
    deposits = MeasureDeposits(apertures=1000, cell_area=1e-10, threshold=2e-5)
    yield Example("deposits", deposits, (2000, 2000))
    yield Example("deposits, double", deposits, (2000, 2000), np.float64)
