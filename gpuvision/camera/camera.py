"""OpenCV's camera: a pinhole, a lens with radial, tangential and thin-prism terms, a tilted sensor.

An ideal point is where the pinhole alone would show a scene point, a measured one is where the sensor shows it. With
normalised ideal coordinates x, y (the scene point's X/Z and Y/Z) and q = x^2 + y^2::

    x' = x (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3) + 2 p1 x y + p2 (q + 2 x^2) + s1 q + s2 q^2
    y' = y (...) / (...) + p1 (q + 2 y^2) + 2 p2 x y + s3 q + s4 q^2
    w (x'', y'', 1) = T (x', y', 1)             the sensor turned by tauX about x, then by tauY about y
    column = fx x'' + cx,  row = fy y'' + cy

as in OpenCV's ``projectPoints`` and ``CALIB_TILTED_MODEL``. Going back, the tilt is undone by its inverse and the lens
by Newton's method for the displacement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.fold import OneToOne, one_to_one
from gpuvision.camera.inverse_start import Guess
from gpuvision.camera.newton import determinant, undo
from gpuvision.validation import check_keys, numbers

Matrix = tuple[tuple[float, float, float], ...]
Float64 = npt.NDArray[np.float64]
Direction = Literal["undistort", "distort"]

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
_LENGTHS = (4, 5, 8, 12, 14)


# Squared, in focal lengths: what lies beyond is not looked for.
_REACH = 1e12


@dataclass(frozen=True, kw_only=True)
class Camera:
    """A camera of OpenCV's model with 14 coefficients, both ways.

    Parameters
    ----------
    matrix
        ``((fx, 0, cx), (0, fy, cy), (0, 0, 1))`` [px]; no skew.
    distortion
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tauX, tauY, as OpenCV orders them; angles in radians.

    Raises
    ------
    ValueError
        A number is not finite, a focal length is not above 0, the matrix has another shape, or a tilt is not
        within a right angle.
    TypeError
        Something is no number.

    Notes
    -----
    The lens terms fold the plane where the determinant of their Jacobian vanishes. What lies past that on the way
    from the centre has no measured point, and measured points outside the picture of what lies before have no ideal
    one: both directions answer NaN there. Within, ``distort(undistort(p))`` is p to rounding, of the larger of the two,
    which the inverse magnifies by 1/det.
    """

    matrix: Matrix
    distortion: tuple[float, ...] = (0.0,) * 14

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _checked_matrix(self.matrix, "Camera.matrix"))
        object.__setattr__(self, "distortion", numbers(self.distortion, (14,), "Camera.distortion"))
        if max(map(abs, self.distortion[12:])) >= 0.5 * math.pi:
            raise ValueError(f"Camera.distortion tilts by {self.distortion[12:]} rad, expected less than a right angle")

    # ---- what the kernels take -----------------------------------------------------------------------------

    def defines(self, matrix: npt.ArrayLike | None = None) -> dict[str, int | None]:
        """Return the defines of ``kernels/common/camera.h`` for this camera and ideal pixels under ``matrix``."""
        k = self._radial
        defines = {"CAMERA": None, "CAMERA_RADIAL": _terms(k[:3]), "CAMERA_RATIONAL": _terms(k[3:])}
        present = {
            "CAMERA_DECENTRED": self._is_decentred,
            "CAMERA_PRISM": any(self._prism[1::2]),
            "CAMERA_TILTED": any(self.distortion[12:]),
            "CAMERA_MATRICES": self._ideal_matrix(matrix) != self.matrix,
        }
        return defines | {name: None for name, is_present in present.items() if is_present}

    def packed(
        self, real: npt.DTypeLike, direction: Direction, matrix: npt.ArrayLike | None = None
    ) -> npt.NDArray[Any]:
        """Return the table of ``kernels/common/camera.h``.

        Parameters
        ----------
        real
            float32 or float64, the kernel's real type.
        direction
            ``"distort"`` for ``camera_distort``, ``"undistort"`` for ``camera_undistort``.
        matrix
            3 x 3, of the ideal pixels; None: the camera's own.
        """
        own, ideal = np.array(self.matrix), np.array(self._ideal_matrix(matrix))
        given, made = (own, ideal) if direction == "undistort" else (ideal, own)
        focal, focal_made = np.diag(given)[:2], np.diag(made)[:2]
        # The centre is rounded before the rest is computed from it.
        centre = given[:2, 2].astype(real).astype(np.float64)
        growth = focal_made / focal - 1.0
        shift = made[:2, 2] - given[:2, 2] + growth * (centre - given[:2, 2])
        back = direction == "undistort"
        tilt = self._untilt if back else self._tilt
        (p1, p2), (s1, s2, s3, s4) = self._tangential, self._prism
        parts = [
            *(centre, 1.0 / focal, focal_made, shift, growth),
            *((tilt - np.eye(3))[:2, :2].ravel(), tilt[2, :2]),
            *(self._radial, (p1, p2, p2 + s1, s2, p1 + s3, s4)),
            (self._one_to_one.safe, self._one_to_one.limit),
        ]
        if back:
            parts += [(min(self._farthest_bent, _REACH),), self._guess.packed(real)]
        with np.errstate(over="ignore"):
            return np.concatenate(parts).astype(real)

    def steps(self, real: npt.DTypeLike) -> int:
        """Return CAMERA_STEPS for ``camera_undistort``: how many steps settle most of the sensor."""
        return self._guess.steps(real)

    # ---- both ways on the host -----------------------------------------------------------------------------

    def distort(self, points: npt.ArrayLike, *, matrix: npt.ArrayLike | None = None) -> Float64:
        """Measured (column, row) of ideal ones, shape (..., 2); NaN past the fold.

        Parameters
        ----------
        points
            Ideal pixels.
        matrix
            3 x 3, under which they are; None: the camera's own.
        """
        ideal = np.array(self._ideal_matrix(matrix))
        return self._to_pixels(self._shown((np.asarray(points, np.float64) - ideal[:2, 2]) / np.diag(ideal)[:2]))

    def undistort(self, points: npt.ArrayLike, *, matrix: npt.ArrayLike | None = None) -> Float64:
        """Ideal (column, row) of measured ones, shape (..., 2): the inverse; NaN past the fold.

        Parameters
        ----------
        points
            Measured pixels.
        matrix
            3 x 3, under which the ideal ones shall be; None: the camera's own.
        """
        ideal = np.array(self._ideal_matrix(matrix))
        return np.asarray(ideal[:2, 2] + np.diag(ideal)[:2] * self._seen(points))

    def rays(self, points: npt.ArrayLike) -> Float64:
        """Return unit vectors (..., 3) towards what measured points (..., 2) show; NaN past the fold."""
        flat = self._seen(points)
        ray = np.concatenate([flat, np.ones((*flat.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def project(
        self, points: npt.ArrayLike, rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike | None = None
    ) -> Float64:
        """Measured (column, row) of scene points, shape (..., 3); NaN behind the camera and past the fold.

        Parameters
        ----------
        points
            In the scene [m].
        rotation, translation
            Scene to camera, (3, 3) and (3,) [m]; None: the scene's coordinates are the camera's.
        """
        scene = np.asarray(points, dtype=np.float64)
        if rotation is not None:
            scene = scene @ np.asarray(rotation, dtype=np.float64).T
        if translation is not None:
            scene = scene + np.asarray(translation, dtype=np.float64)
        depth = np.where(scene[..., 2:] > 0.0, scene[..., 2:], np.nan)
        return self._to_pixels(self._shown(scene[..., :2] / depth))

    def jacobian(self, points: npt.ArrayLike) -> Float64:
        """d(ideal column, row) / d(measured column, row) at measured points, shape (..., 2, 2); NaN past the fold."""
        ideal = self._seen(points)
        _, bend, _ = self._bend(ideal)
        far = 1.0 + self._bent(ideal) @ self._tilt[2, :2]
        shown = self._shown(ideal)
        tilt = (self._tilt[:2, :2] - shown[..., :, None] * self._tilt[2, :2]) / far[..., None, None]
        focal = np.diag(self.matrix)[:2]
        slopes: Float64 = focal[:, None] * np.linalg.inv(tilt @ bend) / focal
        return slopes

    @property
    def one_to_one_radius(self) -> float:
        """Tangent of the angle to the optical axis up to which nothing folds (inf: never)."""
        return math.sqrt(self._one_to_one.safe)

    def covers(self, size: tuple[int, int]) -> bool:
        """Whether every pixel of an image of (columns, rows) has an ideal place: tried along its border."""
        columns, rows = np.arange(size[0]), np.arange(size[1])
        across = [np.stack([columns, np.full(size[0], row)], -1) for row in (0, size[1] - 1)]
        down = [np.stack([np.full(size[1], column), rows], -1) for column in (0, size[0] - 1)]
        return bool(np.isfinite(self.undistort(np.concatenate([*across, *down]))).all())

    # ---- parts ---------------------------------------------------------------------------------------------

    @property
    def _radial(self) -> tuple[float, ...]:
        return (*self.distortion[:2], *self.distortion[4:8])

    @property
    def _tangential(self) -> tuple[float, ...]:
        return self.distortion[2:4]

    @property
    def _prism(self) -> tuple[float, ...]:
        return self.distortion[8:12]

    @property
    def _is_decentred(self) -> bool:
        return any(self._tangential) or any(self._prism)

    @cached_property
    def _one_to_one(self) -> OneToOne:
        return one_to_one(self._radial, self._tangential, self._prism)

    @cached_property
    def _farthest_bent(self) -> float:
        """Squared radius outside which the lens bends no place to."""
        with np.errstate(all="ignore"):
            bent = np.sum((self._one_to_one.edge + self._bend(self._one_to_one.edge)[0]) ** 2, axis=-1)
        # Between the directions it may be a little more, unless the lens is round.
        return float(np.max(bent)) * (1.05 if self._is_decentred else 1.0) if np.isfinite(bent).all() else math.inf

    @cached_property
    def _guess(self) -> Guess:
        """Made for a sensor about twice as large as its principal point is far in; others take longer, no more."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        corners = np.array([[a, b] for a in (-cx / fx, cx / fx) for b in (-cy / fy, cy / fy)])
        bent = _tilted(self._untilt, corners)
        farthest = float(np.nanmax(np.sum(bent**2, axis=-1), initial=0.0))
        k1, k2, k3, k4, k5, k6 = self._radial
        radial = replace(self, distortion=(k1, k2, 0.0, 0.0, k3, k4, k5, k6, *(0.0,) * 6))
        return Guess(self._bend, radial._bend if self._is_decentred else None, radial._one_to_one.limit, farthest)

    @cached_property
    def _tilt(self) -> Float64:
        """The tilt's homography, its last element 1: it keeps the centre."""
        (cos_x, cos_y), (sin_x, sin_y) = np.cos(self.distortion[12:]), np.sin(self.distortion[12:])
        about_x = np.array([[1.0, 0.0, 0.0], [0.0, cos_x, sin_x], [0.0, -sin_x, cos_x]])
        about_y = np.array([[cos_y, 0.0, -sin_y], [0.0, 1.0, 0.0], [sin_y, 0.0, cos_y]])
        turn = about_y @ about_x
        onto = np.array([[turn[2, 2], 0.0, -turn[0, 2]], [0.0, turn[2, 2], -turn[1, 2]], [0.0, 0.0, 1.0]])
        tilt: Float64 = onto @ turn / turn[2, 2]
        # What is 0 but for rounding.
        tilt[:2, 2] = 0.0
        return tilt

    @cached_property
    def _untilt(self) -> Float64:
        return np.asarray(np.linalg.inv(self._tilt), dtype=np.float64)

    def _ideal_matrix(self, matrix: npt.ArrayLike | None) -> Matrix:
        return self.matrix if matrix is None else _checked_matrix(matrix, "matrix")

    def _to_pixels(self, places: Float64) -> Float64:
        matrix = np.array(self.matrix)
        return np.asarray(matrix[:2, 2] + np.diag(matrix)[:2] * places)

    def _bend(self, places: Float64) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
        """Return how far the lens moves normalised ideal places (..., 2), as `newton.undo` asks for it."""
        q = np.sum(places**2, axis=-1, keepdims=True)
        k1, k2, k3, k4, k5, k6 = self._radial
        (p1, p2), (s1, s2, s3, s4) = self._tangential, self._prism
        under = q * (k4 + q * (k5 + q * k6))
        stretch = (q * (k1 + q * (k2 + q * k3)) - under) / (1.0 + under)
        slope = k1 + q * (2.0 * k2 + 3.0 * q * k3) - (1.0 + stretch) * (k4 + q * (2.0 * k5 + 3.0 * q * k6))
        slope = slope / (1.0 + under)
        e = stretch + 2.0 * places @ np.array([[p2], [p1]])
        e_slope = 2.0 * (slope * places + np.array([p2, p1]))
        second = np.array([s2, s4])
        aside = np.array([p2 + s1, p1 + s3]) + second * q
        jacobian = (1.0 + e)[..., None] * np.eye(2) + places[..., :, None] * e_slope[..., None, :]
        jacobian += 2.0 * (aside + second * q)[..., :, None] * places[..., None, :]
        inside = (q[..., 0] < self._one_to_one.limit) & (determinant(jacobian) > 0.0)
        return places * e + q * aside, jacobian, inside

    def _bent(self, places: Float64) -> Float64:
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            move, _, inside = self._bend(places)
            return np.where(inside[..., None], places + move, np.nan)

    def _shown(self, places: Float64) -> Float64:
        """Normalised measured places of normalised ideal ones; NaN past the fold, and behind the tilted sensor."""
        return _tilted(self._tilt, self._bent(places))

    def _seen(self, points: npt.ArrayLike) -> Float64:
        """Normalised ideal places of measured points; NaN past the fold."""
        matrix = np.array(self.matrix)
        shown = (np.asarray(points, dtype=np.float64) - matrix[:2, 2]) / np.diag(matrix)[:2]
        return undo(self._bend, _tilted(self._untilt, shown))

    # ---- tables --------------------------------------------------------------------------------------------

    @classmethod
    def from_opencv(cls, matrix: npt.ArrayLike, coefficients: npt.ArrayLike = ()) -> Camera:
        """Build a camera from OpenCV's ``cameraMatrix`` and ``distCoeffs``: 4, 5, 8, 12 or 14 numbers, or none.

        Raises
        ------
        ValueError
            Another number of coefficients, a skewed matrix, or what the class refuses.
        """
        given = np.ravel(np.asarray(coefficients, dtype=np.float64))
        if given.size and given.size not in _LENGTHS:
            raise ValueError(
                f"coefficients: got {given.size} numbers, expected 4, 5, 8, 12 or 14 as OpenCV orders them"
            )
        return cls(matrix=_checked_matrix(matrix, "matrix"), distortion=(*given.tolist(), *(0.0,) * (14 - given.size)))

    def to_opencv(self) -> tuple[Float64, Float64]:
        """Return OpenCV's ``cameraMatrix`` (3, 3) and ``distCoeffs`` (14,)."""
        return np.array(self.matrix), np.array(self.distortion)

    def to_dict(self) -> dict[str, Any]:
        """Plain numbers and lists, as TOML holds them; coefficients by name, those that are 0 left out."""
        named = {name: value for name, value in zip(COEFFICIENT_NAMES, self.distortion, strict=True) if value != 0.0}
        return {"matrix": [list(row) for row in self.matrix], **named}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Camera:
        """Build a camera from such a table; ``matrix`` is needed.

        Raises
        ------
        ValueError, TypeError
            A key is unknown or missing, or a value is not what it must be.
        """
        values = check_keys(table, ("matrix", *COEFFICIENT_NAMES), ("matrix",), "camera")
        return cls(matrix=values["matrix"], distortion=tuple(values.get(name, 0.0) for name in COEFFICIENT_NAMES))


def _checked_matrix(matrix: Any, what: str) -> Matrix:
    rows: Matrix = numbers(matrix, (3, 3), what)
    (fx, skew, _), (below, fy, _), last = rows
    if not (fx > 0.0 and fy > 0.0):
        raise ValueError(f"{what} has focal lengths {fx:g} and {fy:g}, expected numbers above 0")
    if skew != 0.0 or below != 0.0 or last != (0.0, 0.0, 1.0):
        raise ValueError(f"{what} is {rows}, expected ((fx, 0, cx), (0, fy, cy), (0, 0, 1))")
    return rows


def _terms(coefficients: Sequence[float]) -> int:
    """Return how many of them there are up to the last that is not 0."""
    return max((place for place, value in enumerate(coefficients, 1) if value != 0.0), default=0)


def _tilted(tilt: Float64, places: Float64) -> Float64:
    with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
        w = 1.0 + places @ tilt[2, :2]
        return np.asarray(places @ tilt[:2, :2].T / np.where(w > 0.0, w, np.nan)[..., None])
