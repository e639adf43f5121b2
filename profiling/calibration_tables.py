"""Comparison tables of docs/concepts/lens_calibration.md, printed by this module run with ``python -m``."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import get_args

import cv2
import numpy as np

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.alternating_minimisation import ALTERNATING_SOLVERS, minimise_alternating
from gpuvision.camera.lines.line_families import grid_lines, pack
from gpuvision.camera.lines.vanishing_points import Solver, fit_lens, straightness_px
from gpuvision.profiling.calibration import Families, Float64, Radial, discorpy_fit, tilted_grid

_SIZE = (1024, 1024)
_CORNER = 724.0
_CENTRE = (530.0, 500.0)
_DRAWS = 20


def radial_lens(border: float) -> Lens:
    """Return a lens that moves the image corner by ``border`` pixels: k1 by 115 %, k2 by -15 % of it."""
    return Lens(k1=1.15 * border / _CORNER**3, k2=-0.15 * border / _CORNER**5, centre=_CENTRE)


def solvers(noise: float = 0.05) -> Iterator[str]:
    """Compare the thesis' solvers with variable projection: 10 px at the border, tilt 20 degrees, k1 and k2."""
    lens = radial_lens(10.0)
    yield from _head("points", "solver", "rounds", "evaluations", "ms", "rms px", "centre off px", "correction off px")
    for shape in ((5, 9), (23, 31)):
        ideal = tilted_grid(shape, 20.0, _SIZE)
        points = lens.distort(ideal) + np.random.default_rng(1).normal(0.0, noise, ideal.shape)
        families = grid_lines(points)
        for solver in get_args(Solver):
            start = time.perf_counter()
            fit = fit_lens(families, model="k1,k2", lines="vanishing", solver=solver)
            line_coefficients = 1e3 * (time.perf_counter() - start)
            assert fit.lens is not None
            rounds = fit.iterations
            count = (
                minimise_alternating(pack(families), 2, solver).evaluations if solver in ALTERNATING_SOLVERS else rounds
            )
            away = float(np.hypot(*np.subtract(fit.lens.centre, _CENTRE)))
            error = correction_error(fit.lens, lens, points)
            words = (f"{shape[0]} x {shape[1]}", solver.replace("_", " "), f"{rounds}", f"{count}")
            yield _row(*words, f"{line_coefficients:.3g}", f"{fit.rms_px:.4f}", f"{away:.2g}", f"{error:.2g}")


def accuracy() -> Iterator[str]:
    """Compare with discorpy on synthetic grids of 23 x 31 points: medians over random draws."""
    names = ("straightness px", "centre off px", "correction off px")
    heads = [f"{name}, {whose}" for name in names for whose in ("ours", "discorpy")]
    yield from _head("tilt deg", "border px", "noise px", *heads, "discorpy fails")
    for tilt in (0.0, 20.0, 45.0):
        for border, noise in ((0.3, 0.02), (3.0, 0.05), (10.0, 0.05), (20.0, 0.05), (20.0, 0.2)):
            ours, theirs = zip(*(draw(seed, tilt, border, noise) for seed in range(_DRAWS)), strict=True)
            failed = sum(each is None for each in theirs)
            found = [each for each in theirs if each is not None] or [3 * (np.nan,)]
            columns = np.median(ours, axis=0), np.median(found, axis=0)
            numbers = [f"{side[row]:.3g}" for row in range(3) for side in columns]
            yield _row(f"{tilt:g}", f"{border:g}", f"{noise:g}", *numbers, f"{failed} of {_DRAWS}")


def tilted_sensor() -> Iterator[str]:
    """Show the model error with a tilted sensor, whose distortion precedes the tilt; no noise."""
    yield from _head("tilt of the sensor deg", "border px", "uncorrected px", "left px", "centre off px")
    for border in (3.0, 10.0, 20.0):
        for tilt in (0.0, 10.0, 20.0, 45.0):
            corner = _CORNER / 3000.0
            radial = (-0.85 * border / _CORNER / corner**2, -0.15 * border / _CORNER / corner**4)
            matrix = ((3000.0, 0.0, _CENTRE[0]), (0.0, 3000.0, _CENTRE[1]), (0.0, 0.0, 1.0))
            camera = Camera(matrix=matrix, distortion=(*radial, *10 * (0.0,), 0.0, float(np.radians(tilt))))
            families = grid_lines(camera.distort(tilted_grid((23, 31), 10.0, _SIZE)))
            fit = fit_lens(families, model="k1,k2", lines="free")
            assert fit.lens is not None
            away = float(np.hypot(*np.subtract(fit.lens.centre, _CENTRE)))
            left = straightness_px(families), straightness_px(families, fit.lens)
            yield _row(f"{tilt:g}", f"{border:g}", f"{left[0]:.3f}", f"{left[1]:.4f}", f"{away:.2g}")


def correction_error(found: Lens | Radial, true: Lens, points: Float64) -> float:
    """Return the largest distance between points corrected by two lenses, after the best homography between them."""
    ours, theirs = (each.undistort(points).reshape(-1, 2) for each in (found, true))
    matrix, _ = cv2.findHomography(ours, theirs)
    moved = cv2.perspectiveTransform(ours[None], matrix)[0]
    return float(np.max(np.hypot(*(moved - theirs).T)))


def draw(seed: int, tilt: float, border: float, noise: float) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
    """Return the errors of both libraries on one grid; None if discorpy fails or its polynomial folds."""
    rng, lens = np.random.default_rng(seed), radial_lens(border)
    ideal = tilted_grid((23, 31), tilt, _SIZE, direction=rng.uniform(0.0, 2.0 * np.pi))
    points = lens.distort(ideal) + rng.normal(0.0, noise, ideal.shape)
    families: Families = grid_lines(points)
    ours = fit_lens(families, model="k1,k2", lines="vanishing").lens
    assert ours is not None
    try:
        theirs = discorpy_fit(families)()
        errors = _errors(theirs, theirs.column, theirs.row, lens, families, points)
    except (ValueError, TypeError, np.linalg.LinAlgError, cv2.error):
        return _errors(ours, *ours.centre, lens, families, points), None
    failed = not np.all(np.isfinite(errors)) or errors[0] > 2.0 * straightness_px(families)
    return _errors(ours, *ours.centre, lens, families, points), None if failed else errors


def _errors(
    found: Lens | Radial, column: float, row: float, true: Lens, families: Families, points: Float64
) -> tuple[float, ...]:
    away = float(np.hypot(column - true.centre[0], row - true.centre[1]))
    return straightness_px(families, found), away, correction_error(found, true, points)


def _head(*names: str) -> Sequence[str]:
    return _row(*names), _row(*len(names) * ("---",))


def _row(*words: str) -> str:
    return f"| {' | '.join(words)} |"


if __name__ == "__main__":
    for table in (solvers, accuracy, tilted_sensor):
        print(f"\n{table.__doc__}\n")
        for line in table():
            print(line, flush=True)
