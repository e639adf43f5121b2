"""Starting point of the kernels' lens inversion: fitted polynomials, and the number of Newton steps from there."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from gpuvision.camera.newton import Displacement, invert_displacement

Float64 = npt.NDArray[np.float64]

# CAMERA_GUESS_TERMS of camera.h, and the terms of each vector polynomial.
_TERMS, _VECTOR_TERMS = 8, 3
# Terms of the derivatives of z g and z w: CAMERA_SLOPE_TERMS, and one less than w has. Measured: the steps converge as
# fast as with all terms.
_SLOPE_TERMS, _ACROSS_TERMS = 6, 2
# Polar grid of the points of the fit.
_RADII, _DIRECTIONS = 32, 16
# Polar grid of the points on which the error of the steps is tested: between the directions of the fit, up to its edge.
_TEST_RADII, _TEST_DIRECTIONS = 48, 37
# Radius of the fit: the first factor on the sensor's farthest corner, at most the second on the fold's distorted
# radius. The inverse has a square-root singularity at the fold, which polynomials do not fit.
_CORNER_FACTOR, _FOLD_FACTOR = 1.1, 0.95
# As in camera.h: CAMERA_MOST_STEPS, and CAMERA_LEFT and CAMERA_NOISE of both precisions.
_MAX_STEPS = 8
_LEFT = {np.dtype(np.float32): (1e-15, 1e-13), np.dtype(np.float64): (1e-31, 1e-28)}
# Share of the points of the fit that have to converge within CAMERA_STEPS; the kernel iterates the others further.
_CONVERGED_SHARE = 0.97


class InverseStart:
    """Starting polynomials of ``camera_approach`` in kernels/common/camera.h.

    Parameters
    ----------
    lens : callable
        Displacement from ideal to distorted points.
    radial : callable or None
        The same without decentred terms; None if the lens has no decentred terms.
    fold : float
        Squared radius of the radial part's fold, normalised ideal coordinates.
    farthest : float
        Squared radius of the sensor's farthest point, normalised distorted coordinates.
    """

    def __init__(self, lens: Displacement, radial: Displacement | None, fold: float, farthest: float) -> None:
        self._lens = lens
        self._reach = _CORNER_FACTOR**2 * farthest or 1.0
        if math.isfinite(fold):
            edge = np.array([[math.sqrt(fold), 0.0]])
            with np.errstate(all="ignore"):
                distorted = np.sum((edge + (radial or lens)(edge)[0]) ** 2)
            self._reach = (
                min(self._reach, float(distorted) * _FOLD_FACTOR**2) if np.isfinite(distorted) else self._reach
            )
        # Chebyshev's nodes in the squared radius.
        z = 0.5 - 0.5 * np.cos((np.arange(_RADII) + 0.5) * (math.pi / _RADII))
        angles = np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS)
        radii, directions = np.sqrt(self._reach * z), np.stack([np.cos(angles), np.sin(angles)], -1)
        self._points = (radii[:, None, None] * directions).reshape(-1, 2)
        self._exact = invert_displacement(lens, self._points) - self._points
        self._coefficients = self._fit(radial is not None)

    def packed(self, real: npt.DTypeLike) -> Float64:
        """Return the entries of camera.h's table from CAMERA_PER_REACH on, for float32 or float64."""
        left, _ = _LEFT[np.dtype(real)]
        slope, by_v, by_w = self._slopes
        head = np.array([1.0 / self._reach, left / self._shrinkage**4])
        parts = [head, self._coefficients[:_TERMS], slope, self._vectors, by_v, by_w]
        return np.concatenate([part.ravel() for part in parts])

    def newton_steps(self, real: npt.DTypeLike) -> int:
        """Return CAMERA_STEPS: the number of Newton steps after which most of the converging points have converged."""
        left, noise = _LEFT[np.dtype(real)]
        sizes = self._steps[0]
        before = np.concatenate([np.full_like(sizes[:1], left / self._shrinkage**4), sizes[:-1]]) + noise
        with np.errstate(over="ignore", invalid="ignore"):
            converged = np.sum(sizes**2 <= left * before, axis=1)
        return 1 + int(np.argmax(converged >= _CONVERGED_SHARE * converged.max()))

    def _fit(self, is_decentred: bool) -> Float64:
        """Fit the coefficients of g, v and w to the exact inverse displacement, weighted by 1 / radius."""
        m = self._points
        z = np.sum(m**2, axis=-1, keepdims=True) / self._reach
        columns = [m * z**k for k in range(1, _TERMS + 1)]
        if is_decentred:
            columns += [m * m[:, [axis]] * z**k for k in range(_VECTOR_TERMS) for axis in (0, 1)]
            columns += [self._reach * z ** (k + 1) * np.eye(2)[axis] for k in range(_VECTOR_TERMS) for axis in (0, 1)]
        known = np.isfinite(self._exact[:, 0])
        weight = 1.0 / np.sqrt(z[known])
        design = np.stack([(column[known] * weight).ravel() for column in columns], -1)
        scale = np.linalg.norm(design, axis=0)
        found = np.linalg.lstsq(design / scale, (self._exact[known] * weight).ravel(), rcond=1e-13)[0] / scale
        return np.pad(found, (0, _TERMS + 4 * _VECTOR_TERMS - len(found)))

    @property
    def _vectors(self) -> Float64:
        """Coefficients of v and of w, (2, terms, 2)."""
        return self._coefficients[_TERMS:].reshape(2, _VECTOR_TERMS, 2)

    @property
    def _slopes(self) -> tuple[Float64, Float64, Float64]:
        """Coefficients of 2 (z g)' / reach, of 2 v' / reach and of 2 (z w)'."""
        v, w = self._vectors
        order = 2.0 * np.arange(1.0, _TERMS + 1)[:, None]
        slope = _shortened(self._coefficients[:_TERMS, None] * order / self._reach, _SLOPE_TERMS)[:, 0]
        by_v = v[1:] * order[: len(v) - 1] / self._reach
        return slope, by_v, _shortened(w * order[: len(w)], _ACROSS_TERMS)

    @cached_property
    def _steps(self) -> tuple[Float64, Float64]:
        """Squared lengths of the kernel's steps and of the errors after them over the points' own, (steps, points)."""
        square = np.sum(self._points**2, axis=-1)
        iterates = self._iterates(self._points)
        with np.errstate(all="ignore"):
            sizes = np.sum(np.diff(iterates, axis=0) ** 2, axis=-1) / square
            errors = np.sum((iterates[1:] - self._exact) ** 2, axis=-1) / square
        return sizes, errors

    def _iterates(self, m: Float64) -> Float64:
        """Return the displacements of points (n, 2) before the kernel's steps and after each, (1 + steps, n, 2)."""
        square = np.sum(m**2, axis=-1, keepdims=True)
        z = square / self._reach
        slopes, by_v, by_w = self._slopes
        at_v, at_w = (_values(z, each) for each in self._vectors)
        g = z * polynomial.polyval(z, self._coefficients[:_TERMS]) + _dot(m, at_v)
        slope = polynomial.polyval(z, slopes) + _dot(m, _values(z, by_v))
        across = _values(z, by_w)
        iterates = [m * g + square * at_w]
        with np.errstate(all="ignore"):
            for _ in range(_MAX_STEPS):
                left = self._lens(m + iterates[-1])[0] + iterates[-1]
                along = _dot(m, left)
                step = left + g * left + m * (slope * along + _dot(at_v, left)) + across * along
                iterates.append(iterates[-1] - step)
        return np.array(iterates)

    @cached_property
    def _test_points(self) -> tuple[Float64, Float64, Float64]:
        """Points (n, 2) between the points of the fit, their exact displacements, and their radii (n,)."""
        radii = np.sqrt(self._reach) * (np.arange(_TEST_RADII) + 1.0) / _TEST_RADII
        angles = (np.arange(_TEST_DIRECTIONS) + 0.5) * (2.0 * math.pi / _TEST_DIRECTIONS)
        points = (radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], -1)).reshape(-1, 2)
        return points, invert_displacement(self._lens, points) - points, np.repeat(radii, _TEST_DIRECTIONS)

    @cached_property
    def _test_errors(self) -> Float64:
        """Errors on the test points before the kernel's steps and after each, (1 + steps, points, 2)."""
        points, exact, _ = self._test_points
        errors = np.abs(self._iterates(points) - exact)
        return np.where(np.isfinite(errors), errors, math.inf)

    def sure_steps(self, tolerance: float) -> int | None:
        """Return the number of steps, possibly 0, after which every point within the reach is exact to ``tolerance``.

        Parameters
        ----------
        tolerance : float
            Largest error of a displacement, normalised coordinates.

        Returns
        -------
        int or None
            None if no number of steps suffices: a part of the reach lies close to the fold.
        """
        return _first(np.max(self._test_errors, axis=(1, 2)) <= tolerance)

    def settled_steps(self, real: npt.DTypeLike) -> int | None:
        """Return the number of steps after which every point within the reach passes the kernel's test of convergence.

        The test accepts errors up to sqrt(CAMERA_LEFT) times the radius of the point. The errors on the polar grid,
        in float64, are held to half of this.

        Returns
        -------
        int or None
            None if no number of steps suffices.
        """
        relative = np.hypot(*np.moveaxis(self._test_errors, -1, 0)) / self._test_points[2]
        return _first(np.max(relative, axis=1) <= 0.5 * math.sqrt(_LEFT[np.dtype(real)][0]))

    @cached_property
    def _shrinkage(self) -> float:
        """Ratio of the error after the first step to that step, met by most points."""
        sizes, errors = self._steps
        with np.errstate(all="ignore"):
            ratios = np.sqrt(errors[0] / np.maximum(sizes[0], np.finfo(np.float64).tiny))
        return float(np.clip(np.nanquantile(ratios, _CONVERGED_SHARE), 1e-4, 1.0))


def _first(enough: npt.NDArray[np.bool_]) -> int | None:
    """Return the index of the first true element, or None if all elements are false."""
    return int(np.argmax(enough)) if np.any(enough) else None


def _shortened(terms: Float64, count: int) -> Float64:
    """Return coefficients (count, n) of the polynomials that are closest to polynomials (terms, n) between 0 and 1."""
    z = 0.5 - 0.5 * np.cos((np.arange(_RADII) + 0.5) * (math.pi / _RADII))
    # Weighted by z: the derivatives are multiplied by a squared radius.
    weights = z[:, None] ** np.arange(1, max(count, len(terms)) + 1)
    return np.asarray(np.linalg.lstsq(weights[:, :count], weights[:, : len(terms)] @ terms, rcond=None)[0])


def _values(z: Float64, terms: Any) -> Float64:
    """Evaluate vector polynomials with coefficients (terms, 2) at z (points, 1)."""
    return np.asarray(sum(z**k * term for k, term in enumerate(terms)))


def _dot(a: Float64, b: Float64) -> Float64:
    return np.asarray(np.sum(a * b, axis=-1, keepdims=True))
