"""Plain model of a camera with a tilted sensor, scenes of flat targets, and the Cramer-Rao bound of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np


def tilt(tau_x, tau_y):
    """Return R of OpenCV's documentation, term by term; also for complex arguments."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    about_y = np.array([[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cx, sx], [0, -sx, cx]])
    return about_y @ about_x


def project_virtual(internal, rotation, translation, points):
    """Project points (n, 3) with a pose in the *sensor's* frame; also for complex arguments.

    ``internal``: f and aspect of the virtual camera, v, tauX, tauY, k1, k2, p1, p2, k3, k4, k5, k6.
    """
    f, aspect, v_column, v_row, tau_x, tau_y, k1, k2, p1, p2, k3, k4, k5, k6 = internal
    r = tilt(tau_x, tau_y)
    ray = (points @ rotation.T + translation) @ r
    x, y = ray[:, 0] / ray[:, 2], ray[:, 1] / ray[:, 2]
    q = x * x + y * y
    stretch = (1 + k1 * q + k2 * q**2 + k3 * q**3) / (1 + k4 * q + k5 * q**2 + k6 * q**3)
    xd = x * stretch + 2 * p1 * x * y + p2 * (q + 2 * x * x)
    yd = y * stretch + p1 * (q + 2 * y * y) + 2 * p2 * x * y
    out = np.stack([xd, yd, np.ones_like(xd)], axis=1) @ r.T
    return np.stack([f * out[:, 0] / out[:, 2] + v_column, aspect * f * out[:, 1] / out[:, 2] + v_row], axis=1)


@dataclass
class Scene:
    """Views of a flat target by a known camera."""

    size: tuple[int, int]
    matrix: np.ndarray
    distortion: np.ndarray
    targets: list[np.ndarray]
    exact: list[np.ndarray]
    rotations: list[np.ndarray]
    translations: list[np.ndarray]

    def views(self, rng, sigma):
        """Return the views with normal noise."""
        return [(t, e + rng.normal(0.0, sigma, e.shape)) for t, e in zip(self.targets, self.exact, strict=True)]

    @property
    def truth(self):
        """True parameters f, cx, cy, k1, k2, tauX, tauY."""
        d = self.distortion
        return np.array([self.matrix[0, 0], self.matrix[0, 2], self.matrix[1, 2], d[0], d[1], d[12], d[13]])

    def bound(self, sigma):
        """Return the Cramer-Rao bound of the covariance of f, cx, cy, k1, k2, tauX, tauY, with OpenCV's derivatives."""
        blocks, rest = [], []
        for target, rotation, translation in zip(self.targets, self.rotations, self.translations, strict=True):
            vector = cv2.Rodrigues(rotation)[0]
            jacobian = cv2.projectPoints(target, vector, translation, self.matrix, self.distortion)[1]
            # rotation 3, translation 3, fx fy, cx cy, 14 coefficients
            camera = np.column_stack([jacobian[:, 6] + jacobian[:, 7], jacobian[:, [8, 9, 10, 11, 22, 23]]])
            pose = np.linalg.qr(jacobian[:, :6])[0]
            rest.append(camera - pose @ (pose.T @ camera))
            blocks.append(camera)
        free = np.concatenate(rest)
        unit = np.linalg.norm(free, axis=0)
        return sigma**2 * np.linalg.inv((free / unit).T @ (free / unit)) / np.outer(unit, unit)


KINDS = {
    "grid": {"size": (1280, 1024), "f": 1700.0, "shape": (19, 15), "centre": (650.0, 500.0)},
    "dots": {"size": (1024, 1024), "f": 3000.0, "shape": (31, 23), "centre": (530.0, 500.0)},
}
PITCH = 0.01


def scene(rng, kind, tilt_degrees, corner_px=None, views=10, weakest=0.0, steepest=30.0, direction=None):
    """Return random views; k1 = -.12, k2 = .08, or a lens that moves the corner of an untilted sensor by corner_px."""
    given = KINDS[kind]
    size, f = given["size"], given["f"]
    centre = np.array(given["centre"]) + rng.uniform(-15.0, 15.0, 2)
    direction = rng.uniform(0.0, 2.0 * math.pi) if direction is None else direction
    alpha = math.radians(tilt_degrees)
    axis = np.array([math.sin(alpha) * math.cos(direction), math.sin(alpha) * math.sin(direction), math.cos(alpha)])
    k1, k2 = -0.12, 0.08
    if corner_px is not None:
        radius = 0.5 * math.hypot(*size)
        k1 = rng.choice([-1.0, 1.0]) * corner_px / radius / (radius / f) ** 2 / 0.85
        k2 = -0.15 * k1 / (radius / f) ** 2
    distortion = np.zeros(14)
    distortion[[0, 1, 12, 13]] = k1, k2, math.asin(axis[1]), math.atan2(-axis[0], axis[2])
    matrix = np.array([[f, 0.0, centre[0]], [0.0, f, centre[1]], [0.0, 0.0, 1.0]])
    made = Scene(size, matrix, distortion, [], [], [], [])
    while len(made.targets) < views:
        _add_view(rng, made, given["shape"], axis, (weakest, steepest))
    return made


def _add_view(rng, made, shape, axis, angles):
    """Add a random view if the image shows at least 60 % of the target."""
    f, centre = made.matrix[0, 0], made.matrix[:2, 2]
    row, column = np.indices(shape[::-1]).reshape(2, -1) * PITCH
    target = np.stack([column, row, np.zeros_like(row)], axis=1)
    lean = np.radians(rng.uniform(*angles, 2)) * rng.choice([-1.0, 1.0], 2)
    turns = np.diag([*lean, rng.uniform(-0.3, 0.3)])
    rotation = np.linalg.multi_dot([cv2.Rodrigues(turn)[0] for turn in turns])
    # Ray through a random point of the image, without distortion.
    place = np.array(made.size) * rng.uniform(0.3, 0.7, 2)
    ray = tilt(*made.distortion[12:]).T @ np.array([*(place - centre + f * axis[:2]) / (f * axis[2]), 1.0])
    distance = f * shape[0] * PITCH / (rng.uniform(0.5, 0.95) * made.size[0])
    translation = ray / ray[2] * distance - rotation @ target.mean(axis=0)
    image = cv2.projectPoints(target, cv2.Rodrigues(rotation)[0], translation, made.matrix, made.distortion)[0]
    image = image.reshape(-1, 2)
    inside = ((image >= 0.0) & (image <= np.array(made.size) - 1.0)).all(axis=1)
    if inside.mean() >= 0.6:
        made.targets.append(target[inside])
        made.exact.append(image[inside])
        made.rotations.append(rotation)
        made.translations.append(translation)


TILTED = cv2.CALIB_TILTED_MODEL | cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_ASPECT_RATIO


def calibrate_with_opencv(views, size, flags=TILTED):
    """Return rms, matrix and coefficients of OpenCV's calibration, which takes points in single precision."""
    targets = [np.ascontiguousarray(target, dtype=np.float32) for target, _ in views]
    images = [np.ascontiguousarray(image, dtype=np.float32) for _, image in views]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    found = cv2.calibrateCamera(targets, images, size, np.eye(3), None, flags=flags, criteria=criteria)
    return found[0], found[1], found[2].ravel()


def through_float32(views):
    """Return the views in single precision, as OpenCV takes them."""
    return [(target.astype(np.float32), image.astype(np.float32)) for target, image in views]
