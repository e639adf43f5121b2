"""Accuracy of edge positions: ``python -m gpuvision.profiling.ruler_accuracy`` prints a table with the peers.

8-bit images of a straight edge of 100 grey levels, blurred by 1.2 px, with white noise, at twelve angles; rulers of 41
samples and 5 lines across it. The Cramer-Rao bound holds for five lines of independent samples at a distance of one
pixel. The peers also fit a parabola to the logarithms of the gradients: OpenCV with samples by ``remap`` (rounded to
grey levels), NumPy (and Numba, which does the same) with bilinear samples, and scikit-image, if it is installed, with
the samples and the step of ``profile_line``.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable, Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.special import ndtr

from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.ruler import RulerEdges, best_smoothing

SIDE, BLUR, LENGTH, WIDTH = 140, 1.2, 41, 5
NOISES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
ANGLES = np.radians([0.0, 2.0, 12.0, 26.565, 30.0, 40.0, 45.0, 73.0, 100.0, 160.0, 225.0, 301.0])
_RULERS = 9  # rulers per image
_SLOW = 1500  # rulers for peers that take half a millisecond per ruler

Float64 = NDArray[np.float64]
Scene = tuple[NDArray[np.uint8], Float64, Float64]


def bound(noise: float) -> float:
    """Return the Cramer-Rao bound of the position of an edge [px]; rounding of the image counts as noise."""
    return math.hypot(noise, math.sqrt(1.0 / 12.0)) / 100.0 * math.sqrt(2.0 * BLUR * math.sqrt(math.pi) / WIDTH)


def scenes(noise: float, images: int, seed: int = 1) -> Iterator[Scene]:
    """Yield images, rulers so far apart that their noise is independent, and the true edge positions [px]."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[:SIDE, :SIDE].astype(np.float64)
    for angle in ANGLES:
        direction = np.array([math.cos(angle), math.sin(angle)])
        along = np.array([-direction[1], direction[0]])
        for _ in range(images):
            distance = float(0.5 * SIDE * direction.sum() + rng.uniform(-0.5, 0.5))
            clean = 50.0 + 100.0 * ndtr((column * direction[0] + row * direction[1] - distance) / BLUR)
            foot = 0.5 * SIDE + (distance - 0.5 * SIDE * direction.sum()) * direction
            places = np.arange(-28.0, 29.0, 7.0)[:, None] + rng.uniform(-0.5, 0.5, (_RULERS, 1))
            centres = foot + places * along + rng.uniform(-3.0, 3.0, (_RULERS, 1)) * direction
            rulers = np.concatenate([centres, np.tile(direction, (_RULERS, 1))], axis=1).astype(np.float32)
            image = np.rint(clean + rng.normal(0.0, noise, clean.shape)).astype(np.uint8)
            exact = rulers.astype(np.float64)
            yield image, exact, distance - np.einsum("ij,ij->i", exact[:, :2], exact[:, 2:])


def _peak(profiles: Float64, smoothing: float, step: float = 1.0) -> Float64:
    """Return the positions of the largest gradients of profiles (n, samples), relative to their middle [px]."""
    reach = math.ceil(3.0 * smoothing / step)
    k = np.arange(-reach, reach + 1)
    taps = k * np.exp(-0.5 * (k * step / smoothing) ** 2)
    slopes = np.stack([np.correlate(each, taps, "valid") for each in profiles])
    at = np.argmax(slopes[:, 1:-1], axis=1) + 1
    before, centre, after = (np.log(np.maximum(slopes[np.arange(len(at)), at + j], 1e-6)) for j in (-1, 0, 1))
    shift = 0.5 * (before - after) / (before - 2.0 * centre + after)
    return np.asarray((at + shift + reach - 0.5 * (profiles.shape[1] - 1)) * step)


def _places(rulers: Float64) -> tuple[Float64, Float64]:
    along = np.arange(LENGTH) - 0.5 * (LENGTH - 1)
    across = np.arange(WIDTH)[:, None] - 0.5 * (WIDTH - 1)
    x, y, cosine, sine = (each[:, None, None] for each in rulers.T)
    return x + (along * cosine - across * sine), y + (along * sine + across * cosine)


def _numpy(image: NDArray[np.uint8], rulers: Float64, smoothing: float) -> Float64:
    x, y = _places(rulers)
    return _peak(map_coordinates(image.astype(np.float64), [y, x], order=1).mean(axis=1), smoothing)


def _opencv(image: NDArray[np.uint8], rulers: Float64, smoothing: float) -> Float64:
    x, y = (each.reshape(-1, LENGTH).astype(np.float32) for each in _places(rulers))
    samples = cv2.remap(image, x, y, cv2.INTER_LINEAR).reshape(-1, WIDTH, LENGTH)
    return _peak(samples.mean(axis=1, dtype=np.float64), smoothing)


def _skimage(image: NDArray[np.uint8], rulers: Float64, smoothing: float) -> Float64:
    profile_line: Any = importlib.import_module("skimage.measure").profile_line
    reach = 0.5 * (LENGTH - 1)
    found = []
    for x, y, cosine, sine in rulers:
        first, last = ((y + side * reach * sine, x + side * reach * cosine) for side in (-1.0, 1.0))
        profile = profile_line(image, first, last, linewidth=WIDTH, order=1, mode="nearest").astype(np.float64)
        found.append(_peak(profile[None], smoothing, 2.0 * reach / (len(profile) - 1))[0])
    return np.array(found)


def columns(device: Device) -> dict[str, Callable[[float], Callable[[Scene], tuple[Float64, Float64 | None]]]]:
    """Return for each column a function of the noise that returns a function (scene) -> (positions, deviations)."""

    def ours(smoothing: float) -> Any:
        def prepared(noise: float) -> Any:
            operation = RulerEdges(threshold=30.0, length=LENGTH, width=WIDTH, smoothing_px=smoothing, noise=noise)

            def located(scene: Scene) -> Any:
                edges = operation(scene[0], scene[1].astype(np.float32), device=device)
                return to_numpy(edges.position), to_numpy(edges.sigma)

            return located

        return prepared

    def theirs(locate: Callable[[NDArray[np.uint8], Float64, float], Float64], smoothing: float) -> Any:
        return lambda noise: lambda scene: (locate(scene[0], scene[1], smoothing), None)

    best = best_smoothing(BLUR)
    methods = {
        "ours, best": ours(best),
        "NumPy, Numba, best": theirs(_numpy, best),
        "OpenCV, best": theirs(_opencv, best),
        "scikit-image, best": theirs(_skimage, best),
        "ours, 1 px": ours(1.0),
        "NumPy, Numba, 1 px": theirs(_numpy, 1.0),
        "OpenCV, 1 px": theirs(_opencv, 1.0),
    }
    if importlib.util.find_spec("skimage") is None:
        del methods["scikit-image, best"]
    return methods


def table(device: Device, images: int = 40) -> list[str]:
    """Return lines of Markdown: deviation [px], over the bound, bias; of ours also the predicted over the measured."""
    methods = columns(device)
    lines = ["| noise (SNR) | bound | " + " | ".join(methods) + " |", "|---" * (len(methods) + 2) + "|"]
    for noise in NOISES:
        cells = [f"{noise:g} ({100.0 / noise:.0f})" if noise else "0", f"{bound(noise):.4f}"]
        for name, method in methods.items():
            located = method(noise)
            image_count = min(images, _SLOW // (_RULERS * len(ANGLES))) if name.startswith("scikit") else images
            found = [(located(scene), scene[2]) for scene in scenes(noise, image_count)]
            error = np.concatenate([position - true for (position, _), true in found])
            cell = f"{error.std():.4f} ({error.std() / bound(noise):.2f}), {error.mean():+.4f}"
            if found[0][0][1] is not None:
                predicted = np.concatenate([np.asarray(sigma) for (_, sigma), _ in found])
                cell += f"; {math.sqrt(float(np.mean(predicted**2))) / error.std():.2f}"
            cells.append(cell)
        lines.append("| " + " | ".join(cells) + " |")
    return lines


if __name__ == "__main__":
    print("\n".join(table(Device.best())))
