"""Coarse registration, compared with NumPy, Numba and OpenCV.

``search`` is the grid search (`gpuvision.profiling.edge_search`).

``pair`` is a complete registration of two binary images of 640 x 640 with realistic noise and defects, without an
initial pose. OpenCV's findTransformECC starts within 2 px and 0.2 degrees of the true pose, because it does not
converge without an initial pose. ``error`` is the largest error of the four corners [px], ``opencv_error_px`` the error
of OpenCV.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from gpuvision.host import Device
from gpuvision.matching.pose.registration import register_images
from gpuvision.profiling import edge_search
from gpuvision.profiling.harness import Case

_SIDE = 640


def cases(device: Device) -> Iterator[Case]:
    """Yield the grid search, and the registration of a pair of images."""
    yield from edge_search.cases(device)
    yield _pair(device)


def pictures() -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float64]]:
    """Return a template, a picture of it with defects, and the motion (2, 3) between them."""
    rng = np.random.default_rng(12)
    fine = np.full((4 * _SIDE, 4 * _SIDE), 255, np.uint8)
    for _ in range(45):
        x, y = rng.integers(0, 4 * _SIDE, 2)
        direction = [(1, 0), (0, 1), (1, 1), (1, -1)][rng.integers(4)]
        length = int(rng.integers(200, 900))
        end = (int(x + length * direction[0]), int(y + length * direction[1]))
        cv2.line(fine, (int(x), int(y)), end, 0, int(rng.integers(40, 110)))
        cv2.circle(fine, (int(x), int(y)), int(rng.integers(50, 110)), 0, -1)
    angle, shift = math.radians(3.7), np.array([21.3, -16.8])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    middle = np.full(2, (_SIDE - 1) / 2.0)
    motion = np.column_stack([turn, middle + shift - turn @ middle])
    # Motion of the fine pictures: pixel centres lie at (x + 0.5) * 4 - 0.5.
    start = 4.0 * motion[:, 2] + (turn @ np.ones(2) - 1.0) * -1.5
    seen = cv2.warpAffine(fine, np.column_stack([turn, start]), fine.shape, borderValue=255)
    for _ in range(8):
        cv2.circle(seen, tuple(int(each) for each in rng.integers(0, 4 * _SIDE, 2)), 25, int(rng.choice([0, 255])), -1)
    both = [cv2.resize(each, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA) for each in (fine, seen)]
    noisy = [np.asarray(each, np.float64) + rng.normal(0.0, 40.0, each.shape) for each in both]
    template, image = (np.where(each > 127.5, 255, 0).astype(np.uint8) for each in noisy)
    return template, image, motion


def _off(found: NDArray[Any], true: NDArray[np.float64]) -> float:
    """Return the largest error of the four corners [px]."""
    corners = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * (_SIDE - 1.0)
    return float(np.max(np.linalg.norm(corners @ (found - true)[:, :2].T + (found - true)[:, 2], axis=-1)))


def _pair(device: Device) -> Case:
    template, image, motion = pictures()
    turned = np.array([[math.cos(0.0035), -math.sin(0.0035)], [math.sin(0.0035), math.cos(0.0035)]])
    start = np.column_stack([turned @ motion[:, :2], motion[:, 2] + (1.4, -1.4)]).astype(np.float32)
    white = np.full(template.shape, 255, np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 100, 1e-6)

    def by_opencv() -> NDArray[Any]:
        warp = start.copy()
        cv2.findTransformECC(template, image, warp, cv2.MOTION_EUCLIDEAN, criteria, white, 5)
        return warp

    def ours() -> NDArray[np.float64]:
        found = register_images(image, template, transform="rigid", device=device)
        c, s = math.cos(found.pose[2]), math.sin(found.pose[2])
        return np.array([[c, -s, found.pose[0]], [s, c, found.pose[1]]])

    metadata = {"opencv_error_px": _off(by_opencv().astype(np.float64), motion)}
    return Case("registration", "pair", ours, {"opencv": by_opencv}, _off(ours(), motion), metadata=metadata)
