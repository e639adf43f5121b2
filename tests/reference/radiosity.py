"""Reference of radiosity between the walls of a long corner: a convolution, solved by Fourier transform."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def corner_irradiance(albedo: float, where: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return E a / M at b / a on the other wall of a right-angled corner with a line of diffuse power M.

    The line lies at the distance a from the corner. In t = ln b each bounce convolves the light times b with
    exp(2 t) / (2 (1 + exp(2 t))^1.5).
    """
    count, half = 1 << 17, 80.0
    step = 2.0 * half / count
    t = step * (np.arange(count) - count // 2)
    kernel = 0.5 * np.exp(2.0 * t - 1.5 * np.logaddexp(0.0, 2.0 * t))
    one = np.fft.fft(np.fft.ifftshift(kernel)) * step
    # Two more bounces lead back to the other wall.
    more = np.real(np.fft.fftshift(np.fft.ifft(one * (albedo * one) ** 2 / (1.0 - (albedo * one) ** 2)))) / step
    first = where / (2.0 * (1.0 + where**2) ** 1.5)
    return np.asarray(first + np.interp(np.log(where), t, more) / where)


def strips(edges: NDArray[np.float64], across: Any, front: Any, length: float) -> NDArray[np.float64]:
    """Return the triangles (2 n, 3, 3) of n strips along y, between ``edges`` along the direction ``across``."""
    across, along = np.asarray(across, float), np.array([0.0, length, 0.0])
    low, high = edges[:-1, None] * across, edges[1:, None] * across
    quads = np.stack([low - along, high - along, high + along, low + along], axis=1)
    if np.cross(across, along) @ np.asarray(front, float) < 0.0:
        quads = quads[:, ::-1]
    return np.stack([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3, 3)
