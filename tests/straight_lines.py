"""Grids behind a lens, straightness of lines, and the Cramer-Rao bound of the lens, in plain float64."""

from __future__ import annotations

import numpy as np

from gpuvision.camera.lens import Lens

SIZE = 1024
HALF = 512.0 * np.sqrt(2.0)


def radial_lens(border: float, *, k2_part: float = -0.15, centre: tuple[float, float] = (530.0, 500.0)) -> Lens:
    """Return a lens that moves the corner of a 1024 x 1024 image by ``border`` pixels, a part of it by k2."""
    return Lens(k1=(1.0 - k2_part) * border / HALF**3, k2=k2_part * border / HALF**5, centre=centre)


def plane_grid(
    rng: np.random.Generator, tilt: float, *, rows: int = 23, columns: int = 31, focal: float = 3000.0
) -> np.ndarray:
    """Return ideal image points (rows, columns, 2) of a plane grid tilted by ``tilt`` degrees in a random direction."""
    direction, twist = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-0.1, 0.1)
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    flat = (x + 1j * y) * np.exp(1j * (twist - direction))
    depth = flat.imag * np.sin(np.radians(tilt))
    turned = (flat.real + 1j * flat.imag * np.cos(np.radians(tilt))) * np.exp(1j * direction)
    near, far = 40.0, 3e4
    while far > 1.0001 * near:
        distance = np.sqrt(near * far)
        seen = focal * turned / (depth + distance)
        spread = max(np.ptp(seen.real), np.ptp(seen.imag))
        near, far = (near, distance) if spread < 900.0 else (distance, far)
    seen = focal * turned / (depth + far)
    middle = 0.5 * (seen.real.max() + seen.real.min() + 1j * (seen.imag.max() + seen.imag.min()))
    seen = seen - middle + 512.0 * (1.0 + 1.0j)
    return np.stack([seen.real, seen.imag], axis=-1)


def straightness(lines: list[np.ndarray]) -> float:
    """Return the root mean square distance of points from the best straight line through each line."""
    squares = [np.linalg.svd(line - line.mean(axis=0), compute_uv=False)[1] ** 2 for line in lines]
    return float(np.sqrt(np.sum(squares) / sum(map(len, lines))))


def bound(ideal: np.ndarray, lens: Lens, sigma: float, *, meet: bool) -> np.ndarray:
    """Return the Cramer-Rao bound (4,) of the standard deviations of k1, k2, C_c, R_c from a grid of straight lines.

    Each point is the intersection of its row and its column, distorted by the lens. With ``meet`` all rows pass through
    one vanishing point, all columns through another.
    """
    rows, columns = ideal.shape[:2]
    lines = np.array([_line(each) for each in [*ideal, *ideal.swapaxes(0, 1)]])
    bases = [np.linalg.svd(family)[2] for family in (lines[:rows], lines[rows:])]
    scale = np.array([1e-9, 1e-15, 1e-2, 1e-2])

    def points(change: np.ndarray) -> np.ndarray:
        moved = lines.copy()
        rest = change[4:]
        for start, count, basis in ((0, rows, bases[0]), (rows, columns, bases[1])):
            family = slice(start, start + count)
            if meet:
                point = basis[2] + 1e-4 * rest[:2] @ basis[:2]
                moved[family] -= np.outer(lines[family] @ point, point) / (point @ point)
                moved[family] += 1e-6 * rest[2 : 2 + count, None] * np.cross(point, moved[family])
                rest = rest[2 + count :]
            else:
                along = np.cross(basis[2], lines[family])
                moved[family] += 1e-6 * rest[:count, None] * along + 1e-6 * rest[count : 2 * count, None] * basis[2]
                rest = rest[2 * count :]
        crossed = np.cross(moved[:rows, None], moved[None, rows:])
        values = np.array([lens.k1, lens.k2, *lens.centre]) + scale * change[:4]
        changed = Lens(k1=values[0], k2=values[1], centre=(values[2], values[3]))
        return (changed.distort(1000.0 * crossed[..., :2] / crossed[..., 2:])).ravel()

    size = 4 + (rows + columns + 4 if meet else 2 * (rows + columns))
    step = 0.5
    slopes = np.stack([points(step * unit) - points(-step * unit) for unit in np.eye(size)], axis=1) / (2.0 * step)
    # Normalise the columns; the bound of the first four parameters does not depend on the scale of the others.
    length = np.linalg.norm(slopes, axis=0)
    information = (slopes / length).T @ (slopes / length)
    return np.asarray(sigma * scale * np.sqrt(np.diag(np.linalg.inv(information)))[:4] / length[:4])


def _line(points: np.ndarray) -> np.ndarray:
    """Return the line through points, in units of 1000 pixels."""
    places = points / 1000.0
    middle = places.mean(axis=0)
    normal = np.linalg.svd(places - middle)[2][1]
    return np.array([*normal, -normal @ middle])
