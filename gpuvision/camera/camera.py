"""OpenCV's camera: a pinhole, a lens with radial, tangential and thin-prism terms, a tilted sensor.

An ideal point is the image of a scene point through the pinhole alone; a measured point is its image on the real
sensor. With normalised ideal coordinates x, y (the scene point's X/Z and Y/Z) and q = x^2 + y^2::

    x' = x (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3) + 2 p1 x y + p2 (q + 2 x^2) + s1 q + s2 q^2
    y' = y (...) / (...) + p1 (q + 2 y^2) + 2 p2 x y + s3 q + s4 q^2
    w (x'', y'', 1) = T (x', y', 1)             sensor rotated by tauX about x, then by tauY about y
    column = fx x'' + cx,  row = fy y'' + cy

as in OpenCV's ``projectPoints`` and ``CALIB_TILTED_MODEL``. Undistortion inverts T in closed form and the lens terms by
Newton's method.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.inverse_start import InverseStart
from gpuvision.camera.lens_terms import LensTerms, apply_tilt
from gpuvision.host import Define, flags
from gpuvision.validation import check_keys, numbers

Matrix = tuple[tuple[float, float, float], ...]
Float64 = npt.NDArray[np.float64]
Direction = Literal["undistort", "distort"]
Region = tuple[tuple[float, float], tuple[float, float]]

COEFFICIENT_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
_COEFFICIENT_COUNTS = (4, 5, 8, 12, 14)
# Squared normalised distorted radius beyond which no ideal point is searched.
_MAX_SQUARE = 1e12
# Largest error, relative to a rounding of the corrected coordinate, at which the kernel omits its convergence test.
# Chosen.
_SHARE_OF_ROUNDING = 0.25
# Smallest focal length and largest number of camera matrices with which no result of the kernel can overflow where the
# start polynomials hold [px]. Chosen: far from all cameras, and from the largest float.
_SMALLEST_FOCAL, _LARGEST_ENTRY = 1e-9, 1e9
# Fitted starting polynomials that are kept, each some kilobytes.
_KEPT_STARTS = 64


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Camera of OpenCV's model with 14 distortion coefficients.

    Parameters
    ----------
    matrix : 3 x 3
        ``((fx, 0, cx), (0, fy, cy), (0, 0, 1))`` [px]; no skew.
    distortion : sequence of 14 floats
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tauX, tauY in OpenCV's order; angles in radians. Default: zeros.

    Raises
    ------
    ValueError
        A number is not finite, a focal length is not above 0, the matrix has another form, or a tilt angle is not
        below a right angle.
    TypeError
        An entry is no number.

    Notes
    -----
    The lens terms fold the plane where the determinant of their Jacobian vanishes. Ideal points beyond the fold
    (counted from the centre) have no measured point. Measured points outside the image of the region before the fold
    have no ideal point. Both directions return NaN there. Elsewhere ``distort(undistort(p))`` equals p up to rounding;
    the inverse magnifies rounding errors by 1 / det.

    References
    ----------
    OpenCV documentation, module calib3d. F. de Jong, *Range Imaging and Visual Servoing for industrial applications*,
    TU Delft 2008, chapter 3, for the tilted sensor.
    """

    matrix: Matrix
    distortion: tuple[float, ...] = (0.0,) * 14

    def __post_init__(self) -> None:
        object.__setattr__(self, "matrix", _checked_matrix(self.matrix, "Camera.matrix"))
        object.__setattr__(self, "distortion", numbers(self.distortion, (14,), "Camera.distortion"))
        if max(map(abs, self.distortion[12:])) >= 0.5 * math.pi:
            raise ValueError(f"Camera.distortion tilts by {self.distortion[12:]} rad, expected less than a right angle")

    @cached_property
    def terms(self) -> LensTerms:
        """Distortion in normalised coordinates."""
        return LensTerms(coefficients=self.distortion)

    def in_window(self, first: Sequence[float], binning: int = 1) -> Camera:
        """Return the camera in the pixels of a window of the image, as `Lens.in_window`."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        cx, cy = ((c - f - 0.5 * (binning - 1)) / binning for c, f in zip((cx, cy), first, strict=True))
        return replace(self, matrix=((fx / binning, 0.0, cx), (0.0, fy / binning, cy), (0.0, 0.0, 1.0)))

    # ---- kernel tables and defines -------------------------------------------------------------------------

    def defines(self, matrix: npt.ArrayLike | None = None) -> dict[str, Define]:
        """Return the defines of ``kernels/common/camera.h``; ``matrix`` is the camera matrix of the ideal pixels."""
        k = self.terms.radial
        return {
            "CAMERA": None,
            "CAMERA_RADIAL": _polynomial_order(k[:3]),
            "CAMERA_RATIONAL": _polynomial_order(k[3:]),
            **flags(
                CAMERA_DECENTRED=self.terms.is_decentred,
                CAMERA_PRISM=any(self.terms.prism[1::2]),
                CAMERA_TILTED=any(self.distortion[12:]),
                CAMERA_MATRICES=self._ideal_matrix(matrix) != self.matrix,
            ),
        }

    def packed(
        self, real: npt.DTypeLike, direction: Direction, matrix: npt.ArrayLike | None = None
    ) -> npt.NDArray[Any]:
        """Return the parameter table of ``kernels/common/camera.h``.

        Parameters
        ----------
        real : dtype
            float32 or float64, the kernel's real type.
        direction : {"distort", "undistort"}
            Direction of the kernel: ``camera_distort`` or ``camera_undistort``.
        matrix : 3 x 3, optional
            Camera matrix of the ideal pixels. Default: the camera's matrix.

        Returns
        -------
        numpy.ndarray
            One-dimensional, of type ``real``.
        """
        measured, ideal = np.array(self.matrix), np.array(self._ideal_matrix(matrix))
        source, target = (measured, ideal) if direction == "undistort" else (ideal, measured)
        return self._table(real, direction, source, target, self._principal_region)

    def packed_correction(
        self,
        real: npt.DTypeLike,
        first: npt.ArrayLike,
        pitch: npt.ArrayLike,
        unit: npt.ArrayLike,
        region: Region | None = None,
        profiles: tuple[float, float] | None = None,
    ) -> npt.NDArray[Any]:
        """Return the table of ``camera_correction`` in ``kernels/common/camera.h`` for other coordinates than pixels.

        Parameters
        ----------
        real : dtype
            float32 or float64, the kernel's real type.
        first, pitch : (2,) array_like
            Measured coordinates of the kernel: ``(column, row) = first + pitch * coordinate``.
        unit : (2,) array_like
            Units of the corrections that the focal lengths of the table give, columns and rows [px].
        region : ((column, column), (row, row)), optional
            Region of the sensor that is measured [px]; positions outside of it take more time. Default: a sensor that
            the principal point halves.
        profiles : (middle, scale), optional
            `ProfileCorrection.middle` and ``scale`` instead of the start polynomials, for a kernel with the option
            CAMERA_PROFILES.

        Returns
        -------
        numpy.ndarray
            One-dimensional, of type ``real``.
        """
        matrix = np.array(self.matrix)
        source, target = matrix.copy(), matrix.copy()
        first, pitch, unit = (np.asarray(each, dtype=np.float64) for each in (first, pitch, unit))
        source[:2] /= pitch[:, None]
        source[:2, 2] -= first / pitch
        target[:2] /= unit[:, None]
        if profiles is not None:
            return np.append(self._table(real, "undistort", source, target, None), np.array(profiles, real))
        return self._table(real, "undistort", source, target, region or self._principal_region)

    def _table(
        self, real: npt.DTypeLike, direction: Direction, source: Float64, target: Float64, region: Region | None
    ) -> npt.NDArray[Any]:
        """Return the kernels' table from input pixels with the matrix `source` to output pixels with `target`.

        Without a region it ends before the start polynomials.
        """
        inverse = direction == "undistort"
        focal, target_focal = np.diag(source)[:2], np.diag(target)[:2]
        # Round the centre first and compute the other entries from the rounded value, so that they compensate.
        centre = source[:2, 2].astype(real).astype(np.float64)
        relative_focal_change = target_focal / focal - 1.0
        shift = target[:2, 2] - source[:2, 2] + relative_focal_change * (centre - source[:2, 2])
        tilt = self.terms.untilt if inverse else self.terms.tilt
        (p1, p2), (s1, s2, s3, s4) = self.terms.tangential, self.terms.prism
        parts: list[Any] = [
            *(centre, 1.0 / focal, target_focal, shift, relative_focal_change),
            *((tilt - np.eye(3))[:2, :2].ravel(), tilt[2, :2]),
            *(self.terms.radial, (2.0 * p1, 2.0 * p2, p2 + s1, s2, p1 + s3, s4)),
            (self.terms.invertible_region.safe, self.terms.invertible_region.limit),
        ]
        if inverse:
            parts += [(min(self.terms.max_distorted_square, _MAX_SQUARE),)]
        if inverse and region is not None:
            parts += [_inverse_start(self, region).packed(real)]
        with np.errstate(over="ignore"):
            return np.concatenate(parts).astype(real)

    def undistort_defines(self, real: npt.DTypeLike, matrix: npt.ArrayLike | None = None) -> dict[str, Define]:
        """Return the defines of ``kernels/common/camera.h`` for ``camera_undistort``, in addition to `defines`.

        If the number of Newton steps after which most points have converged is enough for every point in the image,
        and no result can overflow there, the kernel takes these steps without a test. ``matrix`` is the camera matrix
        of the ideal pixels.
        """
        start = _inverse_start(self, self._principal_region)
        steps, settled = start.newton_steps(real), start.settled_steps(real)
        if settled is None or settled > steps or not self._is_moderate(matrix):
            return {"CAMERA_STEPS": steps}
        return {"CAMERA_STEPS": settled, **flags(CAMERA_SURE=True)}

    def correction_defines(self, real: npt.DTypeLike, unit: float, region: Region | None = None) -> dict[str, Define]:
        """Return the defines of ``kernels/common/camera.h`` for ``camera_correction``.

        Parameters
        ----------
        real : dtype
            float32 or float64, the kernel's real type.
        unit : float
            Unit of the corrections [px]. If a number of steps is known to leave errors below a quarter of the unit's
            rounding in the whole region, the kernel takes these steps, often none, without a test.
        region : ((column, column), (row, row)), optional
            As for `packed_correction`.
        """
        start = _inverse_start(self, region or self._principal_region)
        largest_focal = max(self.matrix[0][0], self.matrix[1][1])
        sure = start.sure_steps(_SHARE_OF_ROUNDING * float(np.finfo(np.dtype(real)).eps) * unit / largest_focal)
        steps = start.newton_steps(real) if sure is None else sure
        return {**self.defines(), "CAMERA_STEPS": steps, **flags(CAMERA_SURE=sure is not None)}

    # ---- host computation in float64 -----------------------------------------------------------------------

    def distort(self, points: npt.ArrayLike, *, matrix: npt.ArrayLike | None = None) -> Float64:
        """Return the measured (column, row) of ideal points.

        Parameters
        ----------
        points : array_like
            (..., 2): ideal (column, row) [px].
        matrix : 3 x 3, optional
            Camera matrix of the ideal pixels. Default: the camera's matrix.

        Returns
        -------
        numpy.ndarray
            (..., 2) float64 [px]; NaN past the fold.
        """
        ideal = np.array(self._ideal_matrix(matrix))
        return self._to_pixels(self.terms.measure((np.asarray(points, np.float64) - ideal[:2, 2]) / np.diag(ideal)[:2]))

    def undistort(self, points: npt.ArrayLike, *, matrix: npt.ArrayLike | None = None) -> Float64:
        """Return the ideal (column, row) of measured points: the inverse of `distort`.

        Parameters
        ----------
        points : array_like
            (..., 2): measured (column, row) [px].
        matrix : 3 x 3, optional
            Camera matrix of the ideal pixels. Default: the camera's matrix.

        Returns
        -------
        numpy.ndarray
            (..., 2) float64 [px]; NaN past the fold.
        """
        ideal = np.array(self._ideal_matrix(matrix))
        return np.asarray(ideal[:2, 2] + np.diag(ideal)[:2] * self._ideal(points))

    def rays(self, points: npt.ArrayLike) -> Float64:
        """Return the unit viewing directions (..., 3) of measured points (..., 2) [px]; NaN past the fold."""
        ideal = self._ideal(points)
        ray = np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def project(
        self, points: npt.ArrayLike, rotation: npt.ArrayLike | None = None, translation: npt.ArrayLike | None = None
    ) -> Float64:
        """Project scene points onto the sensor.

        Parameters
        ----------
        points : array_like
            (..., 3): scene points [m].
        rotation, translation : array_like, optional
            Scene to camera, (3, 3) and (3,) [m]. Default: identity and zero.

        Returns
        -------
        numpy.ndarray
            (..., 2) float64: measured (column, row) [px]; NaN behind the camera and past the fold.
        """
        scene = np.asarray(points, dtype=np.float64)
        if rotation is not None:
            scene = scene @ np.asarray(rotation, dtype=np.float64).T
        if translation is not None:
            scene = scene + np.asarray(translation, dtype=np.float64)
        depth = np.where(scene[..., 2:] > 0.0, scene[..., 2:], np.nan)
        return self._to_pixels(self.terms.measure(scene[..., :2] / depth))

    def jacobian(self, points: npt.ArrayLike) -> Float64:
        """Return d(ideal) / d(measured), (..., 2, 2), at measured points (..., 2) [px]; NaN past the fold."""
        ideal = self._ideal(points)
        focal = np.diag(self.matrix)[:2]
        slopes: Float64 = focal[:, None] * np.linalg.inv(self.terms.jacobian(ideal)) / focal
        return slopes

    @property
    def distorts(self) -> bool:
        """Whether any coefficient differs from 0."""
        return any(self.distortion)

    @property
    def invertible_radius(self) -> float:
        """Tangent of the angle to the optical axis up to which the lens model is invertible (inf: everywhere)."""
        return math.sqrt(self.terms.invertible_region.safe)

    def covers(self, size: tuple[int, int]) -> bool:
        """Return whether every pixel of an image of (columns, rows) has an ideal point; tested along its border."""
        columns, rows = np.arange(size[0]), np.arange(size[1])
        across = [np.stack([columns, np.full(size[0], row)], -1) for row in (0, size[1] - 1)]
        down = [np.stack([np.full(size[1], column), rows], -1) for column in (0, size[0] - 1)]
        return bool(np.isfinite(self.undistort(np.concatenate([*across, *down]))).all())

    # ---- parts ---------------------------------------------------------------------------------------------

    @property
    def _principal_region(self) -> Region:
        """Region of a sensor that the principal point halves [px]."""
        (_, _, cx), (_, _, cy), _ = self.matrix
        return (0.0, 2.0 * cx), (0.0, 2.0 * cy)

    def inverse_start(self, region: Region) -> InverseStart:
        """Fit the starting polynomials of the kernels' inversion to a region ((column, column), (row, row)) [px]."""
        (fx, _, cx), (_, fy, cy), _ = self.matrix
        corners = np.array([[(a - cx) / fx, (b - cy) / fy] for a in region[0] for b in region[1]])
        distorted = apply_tilt(self.terms.untilt, corners)
        farthest = float(np.nanmax(np.sum(distorted**2, axis=-1), initial=0.0))
        k1, k2, k3, k4, k5, k6 = self.terms.radial
        radial = LensTerms(coefficients=(k1, k2, 0.0, 0.0, k3, k4, k5, k6, *(0.0,) * 6))
        return InverseStart(
            self.terms.displacement,
            radial.displacement if self.terms.is_decentred else None,
            radial.invertible_region.limit,
            farthest,
        )

    def _is_moderate(self, matrix: npt.ArrayLike | None) -> bool:
        """Return whether the numbers of both camera matrices are far from the limits of floats."""
        matrices = np.abs([self.matrix, self._ideal_matrix(matrix)])
        smallest = float(np.min(np.diagonal(matrices, axis1=1, axis2=2)[:, :2]))
        return smallest > _SMALLEST_FOCAL and float(np.max(matrices)) < _LARGEST_ENTRY

    def _ideal_matrix(self, matrix: npt.ArrayLike | None) -> Matrix:
        return self.matrix if matrix is None else _checked_matrix(matrix, "matrix")

    def _to_pixels(self, points: Float64) -> Float64:
        matrix = np.array(self.matrix)
        return np.asarray(matrix[:2, 2] + np.diag(matrix)[:2] * points)

    def _ideal(self, points: npt.ArrayLike) -> Float64:
        """Return normalised ideal points of measured pixels; NaN past the fold."""
        matrix = np.array(self.matrix)
        measured = (np.asarray(points, dtype=np.float64) - matrix[:2, 2]) / np.diag(matrix)[:2]
        return self.terms.undistort(measured)

    # ---- tables --------------------------------------------------------------------------------------------

    @classmethod
    def from_opencv(cls, matrix: npt.ArrayLike, coefficients: npt.ArrayLike = ()) -> Camera:
        """Build a camera from OpenCV's ``cameraMatrix`` and ``distCoeffs``.

        Parameters
        ----------
        matrix : array_like
            (3, 3) camera matrix [px].
        coefficients : array_like
            0, 4, 5, 8, 12 or 14 distortion coefficients in OpenCV's order. Default: none.

        Raises
        ------
        ValueError
            Another number of coefficients, a skewed matrix, or a value that `Camera` refuses.
        """
        given = np.ravel(np.asarray(coefficients, dtype=np.float64))
        if given.size and given.size not in _COEFFICIENT_COUNTS:
            raise ValueError(
                f"coefficients: got {given.size} numbers, expected 4, 5, 8, 12 or 14 as OpenCV orders them"
            )
        return cls(matrix=_checked_matrix(matrix, "matrix"), distortion=(*given.tolist(), *(0.0,) * (14 - given.size)))

    def to_opencv(self) -> tuple[Float64, Float64]:
        """Return OpenCV's ``cameraMatrix`` (3, 3) and ``distCoeffs`` (14,)."""
        return np.array(self.matrix), np.array(self.distortion)

    def to_dict(self) -> dict[str, Any]:
        """Return the camera as a table of numbers and lists for TOML; coefficients by name, without zeros."""
        named = {name: value for name, value in zip(COEFFICIENT_NAMES, self.distortion, strict=True) if value != 0.0}
        return {"matrix": [list(row) for row in self.matrix], **named}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Camera:
        """Build a camera from the table of `to_dict`; ``matrix`` is required.

        Raises
        ------
        ValueError, TypeError
            A key is unknown or missing, or a value has a wrong type or range.
        """
        values = check_keys(table, ("matrix", *COEFFICIENT_NAMES), ("matrix",), "camera")
        return cls(matrix=values["matrix"], distortion=tuple(values.get(name, 0.0) for name in COEFFICIENT_NAMES))


@lru_cache(maxsize=_KEPT_STARTS)
def _inverse_start(camera: Camera, region: Region) -> InverseStart:
    """Return `Camera.inverse_start`; a bound operation needs it twice."""
    return camera.inverse_start(region)


def _checked_matrix(matrix: Any, what: str) -> Matrix:
    rows: Matrix = numbers(matrix, (3, 3), what)
    (fx, skew, _), (below, fy, _), last = rows
    if not (fx > 0.0 and fy > 0.0):
        raise ValueError(f"{what} has focal lengths {fx:g} and {fy:g}, expected numbers above 0")
    if skew != 0.0 or below != 0.0 or last != (0.0, 0.0, 1.0):
        raise ValueError(f"{what} is {rows}, expected ((fx, 0, cx), (0, fy, cy), (0, 0, 1))")
    return rows


def _polynomial_order(coefficients: Sequence[float]) -> int:
    """Return the number of coefficients up to the last one that is not 0."""
    return max((place for place, value in enumerate(coefficients, 1) if value != 0.0), default=0)
