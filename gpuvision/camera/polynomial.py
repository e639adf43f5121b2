"""Measurement-plane polynomial: direct map from sensor coordinates to metres in one plane, without a camera model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import comb
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.newton import determinant, invert_displacement
from gpuvision.validation import check_keys, numbers

Float64 = npt.NDArray[np.float64]
Region = tuple[tuple[float, float], tuple[float, float]]

# Powers (of c, of r) of the terms, in the order of eq. 3.6; eq. 3.7 is the same with c and r exchanged.
_TERMS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (1, 2), (3, 0))
# Powers (of c, of r) of the terms beyond the linear ones, in the order of plane.h.
_DISPLACEMENT_TERMS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
# Border of the region in conditioned coordinates, for given points and for points found by inversion; as in plane.h.
_BORDER, _INVERSE_BORDER = (1.0 + ulps * float(np.finfo(np.float64).eps) for ulps in (4.0, 64.0))
# Border, in conditioned coordinates, that the iteration of the inverse may not leave.
_ITERATION_BORDER = 1.25
# Points along each side of the grid on which the sign of the Jacobian's determinant is tested.
_TEST_POINTS = 33
# Largest accepted condition number of the linear terms, and of the least-squares design.
_MAX_CONDITION = 1e6


@dataclass(frozen=True, kw_only=True)
class PlanePolynomial:
    """Cubic polynomials from sensor coordinates to a measurement plane.

    ::

        G = p0 + p1 c + p2 r + p3 c^2 + p4 r c + p5 r^2 + p6 r^2 c + p7 c^3
        H = q0 + q1 r + q2 c + q3 r^2 + q4 c r + q5 c^2 + q6 c^2 r + q7 r^3

    where c and r are sensor coordinates (any unit), and G and H are metres in the plane. The polynomials model
    magnification, rotation, weak perspective and radial distortion together, for a sensor about perpendicular to the
    plane.

    Parameters
    ----------
    p, q : sequence of 8 floats
        Coefficients of G and of H.
    region : ((float, float), (float, float))
        ((c_min, c_max), (r_min, r_max)): region of the sensor in which the polynomials are valid.
    covariance : (2, 8, 8), optional
        Covariances of the coefficients of G and of H [m^2], over sensor coordinates shifted and scaled to -1 .. 1
        within the region.

    Raises
    ------
    ValueError
        The polynomials are not invertible within the region, or a number or shape is wrong.
    TypeError
        An entry is no number.

    Notes
    -----
    The coefficients have no physical meaning: they give no lens, tilt or pose, and are valid for one plane only. The
    terms are not complete: G has to run approximately along c, and H along r; omitted terms remain as a model error. On
    1280 x 1024 pixels at a focal length of 1700 px this error is 0.04 px for a lens with k1 = -0.05 and 0.6 px for
    -0.2; 0.05 px for a sensor rotated by 10 degrees about one axis, 0.4 px for 20, and 3 px for 10 about both. Outside
    the fitted points the cubic terms diverge, so results outside ``region`` are NaN. For triangulation
    prefer a calibrated camera, or a `Lens`; `Triangulation.from_polynomial` takes polynomials.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, eq. 3.6 and 3.7.
    """

    p: tuple[float, ...]
    q: tuple[float, ...]
    region: Region
    covariance: tuple[tuple[tuple[float, ...], ...], ...] | None = None

    def __post_init__(self) -> None:
        for name in ("p", "q"):
            object.__setattr__(self, name, numbers(getattr(self, name), (8,), f"PlanePolynomial.{name}"))
        object.__setattr__(self, "region", numbers(self.region, (2, 2), "PlanePolynomial.region"))
        if any(low >= high for low, high in self.region):
            raise ValueError(f"PlanePolynomial.region is {self.region}, expected ((c_min, c_max), (r_min, r_max))")
        if self.covariance is not None:
            parts = tuple(numbers(part, (8, 8), "PlanePolynomial.covariance[i]") for part in self.covariance)
            if len(parts) != 2:
                raise ValueError(f"PlanePolynomial.covariance has {len(parts)} parts, expected one of p and one of q")
            object.__setattr__(self, "covariance", parts)
        self._check_invertible()

    def _check_invertible(self) -> None:
        _, matrix, _ = self._parts
        if not np.linalg.cond(matrix) < _MAX_CONDITION:
            raise ValueError(
                "PlanePolynomial: its linear terms are not one-to-one, expected a plane seen from its front"
            )
        line = np.linspace(-1.0, 1.0, _TEST_POINTS)
        _, jacobian, _ = self._displacement(np.stack(np.meshgrid(line, line), -1).reshape(-1, 2))
        if not np.all(determinant(jacobian) > 0.0):
            raise ValueError("PlanePolynomial folds within its region; fit it to more points, or to a smaller region")

    # ---- host computation in float64 -----------------------------------------------------------------------

    def to_plane(self, points: npt.ArrayLike) -> Float64:
        """Return (G, H) [m] of sensor points (..., 2); NaN outside the region."""
        points = self._to_conditioned(points)
        offset, matrix, _ = self._parts
        with np.errstate(all="ignore"):
            move, _, _ = self._displacement(points)
        return np.asarray(offset + np.where(_is_within(points, _BORDER)[..., None], points + move, np.nan) @ matrix.T)

    def to_sensor(self, points: npt.ArrayLike) -> Float64:
        """Return the sensor coordinates of plane points (G, H) [m] (..., 2), the inverse; NaN outside the region."""
        offset, matrix, _ = self._parts
        moved = (np.asarray(points, dtype=np.float64) - offset) @ np.linalg.inv(matrix).T
        points = invert_displacement(self._displacement, moved)
        return self._to_sensor_units(np.where(_is_within(points, _INVERSE_BORDER)[..., None], points, np.nan))

    def covariance_at(self, points: npt.ArrayLike) -> Float64:
        """Propagate the covariance of the coefficients to (G, H) at sensor points.

        Parameters
        ----------
        points : array_like
            (..., 2): sensor coordinates.

        Returns
        -------
        numpy.ndarray
            (..., 2, 2) float64: covariance of (G, H) [m^2]; NaN outside the region.

        Raises
        ------
        ValueError
            The polynomial has no covariance.
        """
        if self.covariance is None:
            raise ValueError("PlanePolynomial.covariance is not known; fit the polynomial to more than eight points")
        points = self._to_conditioned(points)
        designs = _designs(np.where(_is_within(points, _BORDER)[..., None], points, np.nan))
        variances = [
            np.einsum("...i,ij,...j->...", design, np.array(part), design)
            for design, part in zip(designs, self.covariance, strict=True)
        ]
        return np.asarray(np.stack(variances, -1)[..., None] * np.eye(2))

    # ---- affine part and displacement ----------------------------------------------------------------------

    @property
    def affine(self) -> Float64:
        """Linear part (2, 3): ``(G, H) = affine (c, r, 1)`` of sensor points that `undistort` has displaced [m]."""
        middle, half = self._middle_and_half
        offset, matrix, _ = self._parts
        return np.column_stack([matrix / half, offset - matrix @ (middle / half)])

    def undistort(self, points: npt.ArrayLike, /) -> Float64:
        """Return sensor points (..., 2) displaced by the higher terms; `affine` maps them to the plane.

        NaN outside the region.
        """
        points = self._to_conditioned(points)
        move, _, _ = self._displacement(points)
        return self._to_sensor_units(np.where(_is_within(points, _BORDER)[..., None], points + move, np.nan))

    def distort(self, points: npt.ArrayLike, /) -> Float64:
        """Return the sensor points (..., 2) of displaced ones: the inverse of `undistort`; NaN outside the region."""
        found = invert_displacement(self._displacement, self._to_conditioned(points))
        return self._to_sensor_units(np.where(_is_within(found, _INVERSE_BORDER)[..., None], found, np.nan))

    def jacobian(self, points: npt.ArrayLike, /) -> Float64:
        """Return d(displaced) / d(measured), (..., 2, 2), at sensor points (..., 2)."""
        _, half = self._middle_and_half
        _, jacobian, _ = self._displacement(self._to_conditioned(points))
        return np.asarray(half[:, None] * jacobian / half)

    @property
    def displacement(self) -> tuple[Float64, Float64, Float64]:
        """Middle (2,) and half extents (2,) of the region, and the terms (2, 7) of ``plane.h`` for these units."""
        return *self._middle_and_half, self._parts[2]

    # ---- kernel tables and defines -------------------------------------------------------------------------

    @property
    def defines(self) -> dict[str, None]:
        """Defines of ``kernels/common/plane.h``."""
        return {"PLANE": None}

    def packed(self, real: npt.DTypeLike) -> npt.NDArray[Any]:
        """Return the parameter table of ``kernels/common/plane.h`` for float32 or float64."""
        middle, half = self._middle_and_half
        # Round origin and scale first and compute the other entries from the rounded values, so that they compensate.
        origin = middle.astype(real).astype(np.float64)
        scale = (1.0 / half).astype(real).astype(np.float64)
        offset, matrix, displacement = _decompose(self._powers, origin, 1.0 / scale)
        inverse = np.linalg.inv(matrix)
        table = [origin, scale, 1.0 / scale, offset, matrix.ravel(), inverse.ravel(), displacement.ravel()]
        return np.concatenate(table).astype(real)

    # ---- parts ---------------------------------------------------------------------------------------------

    @cached_property
    def _middle_and_half(self) -> tuple[Float64, Float64]:
        low, high = np.array(self.region).T
        return 0.5 * (low + high), 0.5 * (high - low)

    def _to_conditioned(self, points: npt.ArrayLike) -> Float64:
        middle, half = self._middle_and_half
        return np.asarray((np.asarray(points, dtype=np.float64) - middle) / half)

    def _to_sensor_units(self, points: Float64) -> Float64:
        middle, half = self._middle_and_half
        return np.asarray(middle + half * points)

    @cached_property
    def _powers(self) -> Float64:
        """Coefficients of c^i r^j, of G and of H: (2, 4, 4)."""
        powers = np.zeros((2, 4, 4))
        for (i, j), p, q in zip(_TERMS, self.p, self.q, strict=True):
            powers[0, i, j], powers[1, j, i] = p, q
        return powers

    @cached_property
    def _parts(self) -> tuple[Float64, Float64, Float64]:
        return _decompose(self._powers, *self._middle_and_half)

    def _displacement(self, points: Float64) -> tuple[Float64, Float64, npt.NDArray[np.bool_]]:
        """Return displacement by the higher terms, Jacobian and invertibility, as `newton.Displacement`."""
        _, _, displacement = self._parts
        x, y = points[..., 0], points[..., 1]
        ones = np.ones_like(x)
        terms = np.stack([x**i * y**j for i, j in _DISPLACEMENT_TERMS], -1)
        by_x = np.stack([i * x ** max(i - 1, 0) * y**j * ones for i, j in _DISPLACEMENT_TERMS], -1)
        by_y = np.stack([j * x**i * y ** max(j - 1, 0) * ones for i, j in _DISPLACEMENT_TERMS], -1)
        jacobian = np.eye(2) + np.stack([by_x @ displacement.T, by_y @ displacement.T], -1)
        return terms @ displacement.T, jacobian, _is_within(points, _ITERATION_BORDER) & (determinant(jacobian) > 0.0)

    # ---- construction --------------------------------------------------------------------------------------

    @classmethod
    def fit(
        cls,
        sensor_points: npt.ArrayLike,
        plane_points: npt.ArrayLike,
        *,
        region: Region | None = None,
        sigma: float | None = None,
    ) -> PlanePolynomial:
        """Fit the polynomials to known points of the plane by linear least squares.

        Parameters
        ----------
        sensor_points, plane_points : array_like
            (..., 2): measured (c, r) and known (G, H) [m]. Pairs with NaN are ignored.
        region : optional
            Region of validity. Default: the bounding box of the sensor points.
        sigma : float, optional
            Standard deviation of one plane coordinate [m], for the covariance. Default: estimated from the residuals.

        Returns
        -------
        PlanePolynomial

        Raises
        ------
        ValueError
            The shapes differ, the points do not determine the terms, or G does not run along c.
        """
        sensor, plane = (np.asarray(each, dtype=np.float64) for each in (sensor_points, plane_points))
        if sensor.shape != plane.shape or sensor.shape[-1:] != (2,):
            raise ValueError(f"sensor points {sensor.shape} and plane points {plane.shape}: expected (..., 2), alike")
        pairs = np.concatenate([sensor, plane], -1).reshape(-1, 4)
        pairs = pairs[np.isfinite(pairs).all(axis=1)]
        if len(pairs) < len(_TERMS):
            raise ValueError(f"{len(pairs)} pairs of points are known, expected eight at least")
        low, high = pairs[:, :2].min(axis=0), pairs[:, :2].max(axis=0)
        if not np.all(high > low):
            raise ValueError("the sensor points lie on one line, expected points all over the measurement plane")
        box = numbers(np.stack([low, high], -1) if region is None else region, (2, 2), "region")
        middle, half = 0.5 * np.sum(box, axis=1), 0.5 * np.ptp(box, axis=1)
        designs = _designs((pairs[:, :2] - middle) / half)
        fits = [_least_squares(design, pairs[:, 2 + axis], sigma) for axis, design in enumerate(designs)]
        if not all(abs(value[1]) > abs(value[2]) for value, _ in fits):
            raise ValueError(
                "the plane's G does not run along the sensor's c; exchange the plane's axes, or the sensor's"
            )
        values = [_in_sensor_units(fits[axis][0], middle, half, axis) for axis in (0, 1)]
        parts = tuple(numbers(part, (8, 8), "covariance") for _, part in fits if part is not None)
        return cls(p=values[0], q=values[1], region=box, covariance=parts if len(parts) == 2 else None)

    def to_dict(self) -> dict[str, Any]:
        """Return the polynomial as a table of numbers and lists for TOML, without entries that are None."""
        table: dict[str, Any] = {"p": list(self.p), "q": list(self.q), "region": [list(each) for each in self.region]}
        if self.covariance is not None:
            table["covariance"] = [[list(row) for row in part] for part in self.covariance]
        return table

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> PlanePolynomial:
        """Build a polynomial from the table of `to_dict`; all keys but ``covariance`` are required.

        Raises
        ------
        ValueError, TypeError
            A key is unknown or missing, or a value has a wrong type or range.
        """
        required = ("p", "q", "region")
        return cls(**check_keys(table, (*required, "covariance"), required, "plane polynomial"))


def _is_within(points: Float64, edge: float) -> npt.NDArray[np.bool_]:
    return np.asarray(np.all(np.abs(points) <= edge, axis=-1))


def _designs(points: Float64) -> tuple[Float64, Float64]:
    """Return the terms of eq. 3.6 and of eq. 3.7 at points (..., 2): each (..., 8)."""
    x, y = points[..., 0], points[..., 1]
    return np.stack([x**i * y**j for i, j in _TERMS], -1), np.stack([x**j * y**i for i, j in _TERMS], -1)


def _least_squares(design: Float64, values: Float64, sigma: float | None) -> tuple[Float64, Float64 | None]:
    """Return coefficients and covariance; no covariance if no residual is left to estimate it from."""
    orthogonal, triangle = np.linalg.qr(design)
    if not np.linalg.cond(triangle) < _MAX_CONDITION:
        raise ValueError("the points do not fix eight terms, expected four columns and four rows of points at least")
    found = np.linalg.solve(triangle, orthogonal.T @ values)
    spare = len(values) - len(_TERMS)
    if sigma is None and not spare:
        return found, None
    variance = sigma**2 if sigma is not None else float(np.sum((values - design @ found) ** 2)) / spare
    inverse = np.linalg.inv(triangle)
    return found, variance * inverse @ inverse.T


def _substitute(powers: Float64, origin: Float64, unit: Float64) -> Float64:
    """Rewrite coefficients (..., 4, 4) of c^i r^j for c = origin + unit x and r = origin + unit y."""
    along, across = (
        np.array([[comb(i, k) * o ** (i - k) * u**k if k <= i else 0.0 for k in range(4)] for i in range(4)])
        for o, u in zip(origin, unit, strict=True)
    )
    return np.asarray(along.T @ powers @ across)


def _in_sensor_units(values: Float64, middle: Float64, half: Float64, axis: int) -> tuple[float, ...]:
    """Convert coefficients over conditioned coordinates to the coefficients of eq. 3.6 (axis 0) or 3.7 (axis 1)."""
    powers = np.zeros((4, 4))
    order = [(i, j) if axis == 0 else (j, i) for i, j in _TERMS]
    for place, value in zip(order, values, strict=True):
        powers[place] = value
    powers = _substitute(powers, -middle / half, 1.0 / half)
    return tuple(float(powers[place]) for place in order)


def _decompose(powers: Float64, origin: Float64, unit: Float64) -> tuple[Float64, Float64, Float64]:
    """Return offset (2,), matrix (2, 2) and displacement terms (2, 7) of plane.h for c = origin + unit x."""
    terms = _substitute(powers, origin, unit)
    matrix = np.stack([terms[:, 1, 0], terms[:, 0, 1]], -1)
    higher = np.stack([terms[:, i, j] for i, j in _DISPLACEMENT_TERMS], -1)
    displacement = np.linalg.solve(matrix, higher) if np.linalg.cond(matrix) < _MAX_CONDITION else higher
    return terms[:, 0, 0], matrix, np.asarray(displacement, dtype=np.float64)
