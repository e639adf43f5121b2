"""Lenses from straight lines against discorpy's best functions, on its own real targets where they are at hand.

discorpy's chain is ``find_cod_bailey``, ``correct_perspective_effect`` and ``calc_coef_backward`` with five
coefficients, on float64 points (in single precision it does nothing under NumPy 2). Both sides get the same points;
errors are straightness: root mean square distance of the corrected points from straight lines, free of scale.

``python -m gpuvision.profiling.calibration`` prints the comparison of the thesis' strategies that stands in
docs/calibration.md.
"""

from __future__ import annotations

import functools
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.camera.dots import find_dots
from gpuvision.camera.lens import Lens
from gpuvision.camera.line_families import grid_lines, pack
from gpuvision.camera.line_pattern import find_lines
from gpuvision.camera.strategies import STRATEGIES, alternate
from gpuvision.camera.vanishing_points import fit_lens, straightness_px
from gpuvision.host import Device
from gpuvision.profiling.harness import Case

Float64 = NDArray[np.float64]
Families = tuple[tuple[Float64, ...], ...]

_DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "calibration"
_COEFFICIENTS = 5
_IMAGE = (2560, 2160)
# Name of the case, its file, and rows and columns of the synthetic grid that stands in for it.
_TARGETS = (
    ("fit/66x96", "dot_pattern_01.jpg", (66, 96)),
    ("fit/33x39", "dot_pattern_02.jpg", (33, 39)),
    ("fit/lines", "line_pattern_01.jpg", (34, 140)),
)


class _Radial(NamedTuple):
    """discorpy's result, as a model that undoes a lens."""

    column: float
    row: float
    coefficients: Float64

    def undistort(self, points: Float64) -> Float64:
        """Undistorted (column, row): a backward polynomial, solved by discorpy."""
        from discorpy.post.postprocessing import unwarp_line_backward

        turned = [np.asarray(points, dtype=np.float64)[:, ::-1]]
        return np.asarray(unwarp_line_backward(turned, self.column, self.row, self.coefficients)[0])[:, ::-1]


def cases(device: Device) -> Iterator[Case]:
    """Yield a fit of k1 and k2 to the lines of each target: two of dots, one of lines."""
    for name, file, shape in _TARGETS:
        yield _case(name, file, shape)


@functools.lru_cache(maxsize=len(_TARGETS))
def _case(name: str, file: str, shape: tuple[int, int]) -> Case:
    families, facts = _measured(file) if (_DATA / file).is_file() else _synthetic(shape)

    def ours() -> Lens | None:
        return fit_lens(families, model="k1,k2", lines="free").lens

    horizontal, vertical = ([np.ascontiguousarray(line[:, ::-1]) for line in family] for family in families)
    theirs = _discorpy(horizontal, vertical)
    start = time.perf_counter()
    chosen = fit_lens(families)
    taken = time.perf_counter() - start
    facts |= {
        "points": sum(len(line) for family in families for line in family),
        "error_raw": straightness_px(families),
        "error_discorpy": straightness_px(families, theirs()),
        "model": f"{chosen.model}, {chosen.lines}",
        "seconds_with_choice": taken,
    }
    return Case("calibration", name, ours, {"discorpy": theirs}, straightness_px(families, ours()), facts=facts)


def _discorpy(horizontal: Sequence[Float64], vertical: Sequence[Float64]) -> Callable[[], _Radial]:
    """Return discorpy's fit to lines of (row, column)."""
    from discorpy.proc import processing

    def fit() -> _Radial:
        column, row = processing.find_cod_bailey(horizontal, vertical)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            flat = processing.correct_perspective_effect(horizontal, vertical, column, row)
            coefficients = processing.calc_coef_backward(*flat, column, row, _COEFFICIENTS)
        return _Radial(float(column), float(row), np.asarray(coefficients))

    return fit


def _measured(file: str) -> tuple[Families, dict[str, Any]]:
    """Lines of a real target, by our own finders."""
    image = cv2.imread(str(_DATA / file), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return (find_lines(image) if file.startswith("line") else grid_lines(find_dots(image).points)), {"data": file}


def _synthetic(shape: tuple[int, int]) -> tuple[Families, dict[str, Any]]:
    """Lines of a tilted grid of points, with the noise of a good finder."""
    rng = np.random.default_rng(1)
    points = _tilted_grid(shape, 15.0)
    lens = Lens(k1=1.6e-8, k2=6e-16, centre=(1257.0, 1020.0))
    return grid_lines(lens.distort(points) + rng.normal(0.0, 0.05, points.shape)), {"data": "synthetic"}


def _tilted_grid(shape: tuple[int, int], degrees: float, size: tuple[int, int] = _IMAGE) -> Float64:
    """Image (rows, columns, 2) of a plane grid, tilted about the diagonal, that fills most of an image."""
    v, u = np.meshgrid(*(np.linspace(-0.5, 0.5, count) for count in shape), indexing="ij")
    x, y = 0.75 * size[0] * u, 0.75 * size[1] * v
    depth = 1.0 + np.tan(np.radians(degrees)) * (x + y) / (4.0 * max(size))
    return np.stack([x / depth + 0.5 * size[0], y / depth + 0.5 * size[1]], axis=-1)


def strategies_table(*, noise: float = 0.05, seed: int = 1) -> str:
    """Compare the thesis' strategies with variable projection; a table in Markdown.

    The thesis' grid of 5 x 9 points and one of 23 x 31, of a 1024 x 1024 image with 10 pixels of distortion at the
    border, tilted by 20 degrees; both families, k1 and k2 about an unknown centre.
    """
    lens = Lens(k1=3e-8, k2=-7.5e-15, centre=(530.0, 500.0))
    lines = [
        "| points | strategy | rounds | evaluations | ms | rms px | centre off by px | correction off by px |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for shape in ((5, 9), (23, 31)):
        ideal = _tilted_grid(shape, 20.0, (1024, 1024))
        rng = np.random.default_rng(seed)
        points = lens.distort(ideal) + rng.normal(0.0, noise, ideal.shape)
        families = grid_lines(points)
        for strategy in ("variable_projection", *STRATEGIES):
            start = time.perf_counter()
            fit = fit_lens(families, model="k1,k2", lines="vanishing", strategy=strategy)  # type: ignore[arg-type]
            taken = 1e3 * (time.perf_counter() - start)
            count = fit.iterations
            if strategy in STRATEGIES:
                count = alternate(pack(families), 2, strategy).evaluations
            assert fit.lens is not None
            away = np.hypot(*np.subtract(fit.lens.centre, lens.centre))
            name = f"{shape[0]} x {shape[1]} | {strategy.replace('_', ' ')}"
            error = _correction_error(fit.lens, lens, points)
            lines.append(
                f"| {name} | {fit.iterations} | {count} | {taken:.3g} | {fit.rms_px:.4f} | {away:.3g} | {error:.3g} |"
            )
    return "\n".join(lines)


def _correction_error(found: Lens, true: Lens, points: Float64) -> float:
    """Largest distance between points corrected by two lenses, after the best homography between them."""
    ours, theirs = (each.undistort(points).reshape(-1, 2) for each in (found, true))
    matrix, _ = cv2.findHomography(ours, theirs)
    moved = cv2.perspectiveTransform(ours[None], matrix)[0]
    return float(np.max(np.hypot(*(moved - theirs).T)))


if __name__ == "__main__":
    print(strategies_table())
