"""Radial lens model from measured to undistorted sensor coordinates; PSD and camera readouts apply it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import numpy.typing as npt

from gpuvision.validation import check_keys, finite, numbers

_MAX_NEWTON_STEPS = 64
_NEWTON_TOLERANCE = 2e-16  # largest relative residual of a solution; derived: one rounding of float64
# Derived: with these bounds the powers of the fold radius and the kernel table stay within single precision. No lens
# reaches them, in pixels or in metres.
_MAX_COEFFICIENT = {"k1": 1e10, "k2": 1e20, "k3": 1e30, "k4": 1e37}
_MAX_CENTRE = 1e9

# Imaginary part of a computed root, relative to its size, up to which the root counts as real. Derived: roots of a
# quartic are computed to about 1e-14; a double root, which is no fold, splits by the square root of that.
_REAL_ROOT = 1e-9
# Inverse of the farthest fold that is searched, in squared scale radii. A scale radius is where the largest term of the
# slope reaches 1; a thousand of them are far outside of every image.
_FARTHEST_FOLD = 1e-6
# Doublings of the bracket of a measured radius.
_MAX_DOUBLINGS = 64
_Number = TypeVar("_Number", float, npt.NDArray[np.float64])


def _horner(coefficients: Sequence[float], square: _Number) -> _Number:
    """Return c0 + c1 square + c2 square^2 + ..."""
    *lower, total = coefficients
    result: Any = total
    for coefficient in reversed(lower):
        result = coefficient + result * square
    return cast("_Number", result)


def _fold_radius(coefficients: Sequence[float]) -> float:
    """Return the least radius at which r (1 + k1 r^2 + ...) stops rising; infinite if it rises everywhere."""
    factors = [(2 * order + 1) * k for order, k in enumerate(coefficients, 1)]
    rates = [abs(factor) ** (1.0 / order) for order, factor in enumerate(factors, 1)]
    rate = max(rates)
    # As a polynomial in z = rate r^2, the slope has coefficients of at most 1. Solve for 1/z: that polynomial has the
    # leading coefficient 1 and stays well conditioned when a term vanishes. The largest root is the nearest fold.
    scaled = [
        math.copysign((each / rate) ** order, k) for order, (each, k) in enumerate(zip(rates, factors, strict=True), 1)
    ]
    inverse = np.roots([1.0, *scaled]).astype(np.complex128)
    is_fold = (np.abs(inverse.imag) <= _REAL_ROOT * np.abs(inverse)) & (inverse.real > _FARTHEST_FOLD)
    if not is_fold.any():
        return math.inf
    z = 1.0 / float(inverse.real[is_fold].max())
    change = _horner([order * c for order, c in enumerate(scaled, 1)], z)
    if change != 0.0:
        z -= (1.0 + z * _horner(scaled, z)) / change
    return math.sqrt(z / rate)


@dataclass(frozen=True, kw_only=True)
class Lens:
    """Radial distortion about a centre, as a polynomial from measured to undistorted coordinates.

    ``C = C_c + (C' - C_c)(1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8)``, the same for R, with ``r^2 = (R' - R_c)^2 + (C' -
    C_c)^2``. The model is isotropic: it holds in any square sensor coordinates, such as pixels, or metres on a PSD. The
    thesis has k1 and k2; wide-angle lenses need k3 and k4.

    Parameters
    ----------
    k1, k2, k3, k4 : float
        Distortion coefficients [unit^-2], [unit^-4], [unit^-6] and [unit^-8] of the sensor coordinates (pixels or
        metres). Default of k2, k3 and k4: 0.
    centre : (float, float)
        (C_c, R_c): column and row of the distortion centre, in sensor coordinates. Default (0, 0).

    Raises
    ------
    ValueError
        A number is not finite, or its magnitude exceeds the bound named in the message.
    TypeError
        An argument is no number.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, eq. 3.11-3.13.
    """

    TABLE_SIZE: ClassVar[int] = 7
    """Entries of the table of ``kernels/common/lens.h`` that undistortion needs."""

    k1: float
    k2: float = 0.0
    centre: tuple[float, float] = (0.0, 0.0)
    k3: float = 0.0
    k4: float = 0.0

    def __post_init__(self) -> None:
        for name in _MAX_COEFFICIENT:
            object.__setattr__(self, name, finite(getattr(self, name), f"Lens.{name}"))
            if abs(getattr(self, name)) > _MAX_COEFFICIENT[name]:
                raise ValueError(
                    f"Lens.{name} is {getattr(self, name):g}, expected a size of at most {_MAX_COEFFICIENT[name]:g}"
                )
        object.__setattr__(self, "centre", numbers(self.centre, (2,), "Lens.centre (column, row)"))
        if max(map(abs, self.centre)) > _MAX_CENTRE:
            raise ValueError(f"Lens.centre is {self.centre}, expected coordinates of at most {_MAX_CENTRE:g}")

    @property
    def defines(self) -> dict[str, None]:
        """Defines of ``kernels/common/lens.h``: ``LENS``, and the option of the last coefficient that is not 0."""
        order = len(self.coefficients)
        return {"LENS": None, f"LENS_K{order}": None} if order > 1 else {"LENS": None}

    @property
    def coefficients(self) -> tuple[float, ...]:
        """k1 and the further coefficients up to the last one that is not 0."""
        every = (self.k1, self.k2, self.k3, self.k4)
        return every[: max([1, *(order for order, k in enumerate(every, 1) if k != 0.0)])]

    def packed(self, origin: Sequence[float], scale: float, *, inverse: bool = False) -> npt.NDArray[np.float64]:
        """Return the parameter table of ``kernels/common/lens.h`` for kernel coordinates (point - origin) * scale.

        Parameters
        ----------
        origin : sequence of 2 floats
            Origin of the kernel coordinates, in the order of ``centre``.
        scale : float
            Scale of the kernel coordinates. Coordinates of about 1 at the sensor's border minimise rounding errors.
        inverse : bool
            Add the entry that ``lens_distort`` needs. Default False.

        Returns
        -------
        numpy.ndarray
            Both coordinates of the centre, k1 to k4 and the squared fold radius, in kernel units; with ``inverse`` also
            the squared undistorted radius of the fold.
        """
        centre = [(c - o) * scale for c, o in zip(self.centre, origin, strict=True)]
        fold = self.fold_radius
        terms = [k / scale**power for power, k in zip((2, 4, 6, 8), (self.k1, self.k2, self.k3, self.k4), strict=True)]
        table = [*centre, *terms, (fold * scale) ** 2]
        return np.array([*table, (self.undistorted_radius(fold) * scale) ** 2] if inverse else table)

    def swapped(self) -> Lens:
        """Return the same lens for points in (row, column) order."""
        return replace(self, centre=self.centre[::-1])

    def in_window(self, first: Sequence[float], binning: int = 1) -> Lens:
        """Return the lens in the pixels of a window of the image.

        Parameters
        ----------
        first : sequence of 2 floats
            Column and row of the window's first pixel in this lens' pixels.
        binning : int
            Pixels of this lens per pixel of the window, along each axis. Default 1.
        """
        powers = (binning ** (2 * order) for order in range(1, 5))
        k1, k2, k3, k4 = (k * p for k, p in zip((self.k1, self.k2, self.k3, self.k4), powers, strict=True))
        column, row = ((c - f - 0.5 * (binning - 1)) / binning for c, f in zip(self.centre, first, strict=True))
        return Lens(k1=k1, k2=k2, k3=k3, k4=k4, centre=(column, row))

    @property
    def fold_radius(self) -> float:
        """Measured radius up to which the polynomial increases; no scene point lies beyond it (inf: no limit)."""
        if len(self.coefficients) > 2:
            return _fold_radius(self.coefficients)
        # d/dr of r (1 + k1 r^2 + k2 r^4) is 1 + 3 k1 s + 5 k2 s^2 in s = r^2; no 0/0 where k2 is 0.
        discriminant = 9.0 * self.k1**2 - 20.0 * self.k2
        if discriminant < 0.0:
            return math.inf
        slope = -3.0 * self.k1 + math.copysign(math.sqrt(discriminant), -self.k1)
        roots = [2.0 / slope if slope != 0.0 else math.inf]
        if self.k2 != 0.0:
            roots.append(slope / (10.0 * self.k2))
        positive = [s for s in roots if s > 0.0]
        return math.sqrt(min(positive)) if positive else math.inf

    def undistort(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the undistorted (column, row) of measured points (..., 2); NaN beyond the fold."""
        offset = np.asarray(points, dtype=np.float64) - self.centre
        square = (offset[..., 0] ** 2 + offset[..., 1] ** 2)[..., None]  # faster than a sum along the short last axis
        inside = square < self.fold_radius**2
        # Add the small displacement to the point instead of scaling the offset: the rounding error is smaller.
        with np.errstate(invalid="ignore", over="ignore"):
            moved = np.asarray(points) + offset * self._stretch(square)
        undistorted: npt.NDArray[np.float64] = np.where(inside, moved, np.nan)
        return undistorted

    def jacobian(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return d(undistorted) / d(measured), (..., 2, 2), at measured points (..., 2)."""
        offset = np.asarray(points, dtype=np.float64) - self.centre
        square = np.sum(offset**2, axis=-1)[..., None, None]
        scale, slope = 1.0 + self._stretch(square), 2.0 * self._stretch_slope(square)
        return np.asarray(scale * np.eye(2) + slope * offset[..., :, None] * offset[..., None, :])

    def distort(self, points: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Return the measured (column, row) of undistorted points (..., 2): the inverse of `undistort`.

        Computed by safeguarded Newton steps. NaN where no measured point inside the fold has this undistorted position.
        """
        offset = np.asarray(points, dtype=np.float64) - self.centre
        target = np.hypot(offset[..., 0], offset[..., 1])
        radius = self._measured_radius(target)
        with np.errstate(invalid="ignore"):
            shrink = np.where(target > 0.0, radius / np.where(target > 0.0, target, 1.0), 1.0)
        return self.centre + offset * np.where(np.isfinite(target), shrink, np.nan)[..., None]

    def undistorted_radius(self, radius: float) -> float:
        """Return the undistorted radius of a measured radius; infinite for an infinite one (no fold)."""
        if math.isinf(radius):
            return math.inf
        return radius * (1.0 + self._stretch(radius**2))

    def _stretch(self, square: _Number) -> _Number:
        """Return k1 r^2 + k2 r^4 + ... at r^2 = square."""
        return square * _horner(self.coefficients, square)

    def _stretch_slope(self, square: _Number) -> _Number:
        """Return the derivative of k1 r^2 + k2 r^4 + ... by r^2."""
        return _horner([order * k for order, k in enumerate(self.coefficients, 1)], square)

    def _measured_radius(self, target: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Solve r (1 + k1 r^2 + k2 r^4 + ...) = target on the monotonic interval [0, fold)."""
        fold = self.fold_radius
        if math.isfinite(fold):
            high = np.full_like(target, fold)
            reachable = target < self.undistorted_radius(fold)
        else:
            # Without a fold the polynomial rises everywhere: double the bracket until it reaches the target.
            high = target.copy()
            for _ in range(_MAX_DOUBLINGS):
                with np.errstate(over="ignore", invalid="ignore"):
                    short = high * (1.0 + self._stretch(high**2)) < target
                if not np.any(short):
                    break
                high = np.where(short, 2.0 * high, high)
            reachable = np.isfinite(target)
        low = np.zeros_like(target)
        radius = np.where(reachable, np.minimum(target, high), np.nan)
        for _ in range(_MAX_NEWTON_STEPS):
            square = radius**2
            stretch = self._stretch(square)
            excess = radius * (1.0 + stretch) - target
            if not np.any(np.abs(excess) > _NEWTON_TOLERANCE * target):
                break
            high = np.where(excess > 0.0, radius, high)
            low = np.where(excess < 0.0, radius, low)
            with np.errstate(divide="ignore", invalid="ignore"):
                step = radius - excess / (1.0 + stretch + 2.0 * square * self._stretch_slope(square))
            radius = np.where((step >= low) & (step <= high), step, np.where(reachable, 0.5 * (low + high), np.nan))
        return radius

    def to_dict(self) -> dict[str, Any]:
        """Return the lens as a table of numbers and lists for TOML."""
        further = {name: value for name, value in (("k3", self.k3), ("k4", self.k4)) if value != 0.0}
        return {"k1": self.k1, "k2": self.k2, **further, "centre": list(self.centre)}

    @classmethod
    def from_dict(cls, table: Mapping[str, Any]) -> Lens:
        """Build a lens from ``{"k1": ..., "k2": ..., "k3": ..., "k4": ..., "centre": [column, row]}``.

        Raises
        ------
        ValueError
            A key is unknown or missing, or a value is no finite number.
        """
        return cls(**check_keys(table, ("k1", "k2", "k3", "k4", "centre"), ("k1",), "lens"))
