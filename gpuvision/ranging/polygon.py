"""Scanning geometries that sample a surface irregularly: the polygon mirror, and the beam at 45 degrees.

Polygon mirror (thesis, Figures 2.7 and 2.8): a horizontal beam hits a facet of a turning polygon at the
height of the middle of the facet and is reflected down to the surface. With R the polygon's apothem, D the drop from
the hit point to the surface and phi the rotation, 0 where the facet lies at 45 degrees and is hit in its middle::

    x_h = R (1 + sin(psi)/sqrt(2)) / cos(psi),  psi = phi - pi/4
    x = x_h(phi) - x_h(0) + D tan(2 phi)

An object of height h shortens the drop: the spot moves sideways to ``x_h(phi) - x_h(0) + (D - h) tan(2 phi)``. The
difference ``x_h(phi) - x_h(0)`` is due to the motion of the hit point; it makes the scan asymmetric in second order.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3 (Figures 2.5,
2.7 and 2.8).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.status import Status
from gpuvision.validation import finite, integer

Float64 = npt.NDArray[np.float64]

# Cap on the bracketed Newton iterations. Bisection alone narrows the bracket, which is at most pi/2 wide, below the
# spacing of float64 in about 55.
_MAX_ITERATIONS = 80
_POSITION_ROUNDING = 4.0 * np.finfo(np.float64).eps  # of a position, relative to |x| + R: four roundings
_IMAGINARY_ROUNDING = 1e-9  # a root of the cubic, which is of order 1, counts as real below this imaginary part
_HALF_ROOT = math.sqrt(0.5)  # cosine of 45 degrees, at which the middle of a facet reflects the beam downwards


@dataclass(frozen=True, kw_only=True)
class PolygonMirror:
    """Rotating polygon mirror that scans a laser beam over a surface.

    Parameters
    ----------
    apothem
        Distance R from the axis to the middle of a facet [m], positive.
    facets
        Number of mirrors, at least 3; the beam stays on one facet for a rotation of 2 pi / facets.
    height
        Height H of the polygon above the surface [m], positive.
    height_from
        "centre": H is measured from the polygon's axis, and D = H - R/sqrt(2); "hit": from the point where the
        beam hits the facet, and D = H.

    Raises
    ------
    ValueError
        If a length is not positive, there are fewer than 3 facets, or the surface lies above the hit point.
    """

    apothem: float
    facets: int
    height: float
    height_from: Literal["centre", "hit"] = "centre"

    def __post_init__(self) -> None:
        for name in ("apothem", "height"):
            if not finite(getattr(self, name), f"PolygonMirror.{name}") > 0.0:
                raise ValueError(f"PolygonMirror.{name} is {getattr(self, name)}, expected a positive length [m]")
        integer(self.facets, "PolygonMirror.facets", minimum=3)
        if self.height_from not in ("centre", "hit"):
            raise ValueError(f"PolygonMirror.height_from is {self.height_from!r}, expected 'centre' or 'hit'")
        if not self.drop > 0.0:
            raise ValueError(
                f"PolygonMirror.height is {self.height} m from the centre, expected more than apothem/sqrt(2) = "
                f"{self.apothem * _HALF_ROOT} m"
            )

    @property
    def drop(self) -> float:
        """Distance D from the point where the beam hits the facet down to the surface [m]."""
        return self.height - self.apothem * _HALF_ROOT if self.height_from == "centre" else self.height

    def position(self, rotation: npt.ArrayLike, object_height: npt.ArrayLike = 0.0) -> Float64:
        """Return the position x of the spot [m] for rotations phi [rad]; NaN outside `limits`.

        Parameters
        ----------
        rotation : array_like
            Rotations phi [rad], any shape.
        object_height : array_like
            Height h of the object above the surface at the spot [m], below `drop`; default 0: the surface.

        Returns
        -------
        numpy.ndarray
            Positions x [m], float64, of the broadcast shape.
        """
        phi = np.asarray(rotation, dtype=np.float64)
        low, high = self.limits
        aside = np.asarray(object_height, dtype=np.float64) * np.tan(2.0 * phi)
        return np.where((phi >= low) & (phi <= high), self._position(phi) - aside, np.nan)

    def slope(self, rotation: npt.ArrayLike) -> Float64:
        """Return the derivative dx/dphi [m/rad] at rotations phi [rad]; it is 2 D in the middle of the scan."""
        phi = np.asarray(rotation, dtype=np.float64)
        facet = 0.25 * math.pi - phi
        hit_point = self.apothem * (_HALF_ROOT - np.sin(facet)) / np.cos(facet) ** 2
        return np.asarray(hit_point + 2.0 * self.drop / np.cos(2.0 * phi) ** 2)

    def rotation(self, position: npt.ArrayLike) -> Float64:
        """Return the rotation phi [rad] that directs the beam to x [m]: the inverse of `position`; NaN out of reach.

        Parameters
        ----------
        position : array_like
            Positions x on the surface [m], any shape.

        Returns
        -------
        numpy.ndarray
            Rotations phi [rad], float64, of the same shape.

        Notes
        -----
        Newton iterations, replaced by bisection where a step leaves the bracket. `position` of the result equals x up
        to rounding.
        """
        x = np.asarray(position, dtype=np.float64)
        bounds = self.limits
        first, last = self._position(np.array(bounds))
        # At a fold dx/dphi is 0: rounding can place the position of a rotation within the limits outside the positions
        # of the limits.
        below, above = (_POSITION_ROUNDING * (abs(end) + self.apothem) for end in (first, last))
        reachable = (x >= first - below) & (x <= last + above)
        x = np.clip(x, first, last)
        low, high = np.full_like(x, bounds[0]), np.full_like(x, bounds[1])
        # Start value: the exact solution without the motion of the hit point.
        phi = np.where(reachable, np.clip(0.5 * np.arctan(x / self.drop), *bounds), np.nan)
        for _ in range(_MAX_ITERATIONS):
            excess = self._position(phi) - x
            high = np.where(excess > 0.0, phi, high)
            low = np.where(excess < 0.0, phi, low)
            with np.errstate(divide="ignore"):  # the slope is 0 at a fold; the infinite step is rejected below
                step = phi - np.divide(excess, self.slope(phi), out=np.zeros_like(x), where=excess != 0.0)
            inside = (step >= low) & (step <= high)
            better = np.where(inside | ~reachable, step, 0.5 * (low + high))
            if np.array_equal(better, phi, equal_nan=True):
                break
            phi = better
        return phi

    def times(self, positions: npt.ArrayLike, angular_speed: float) -> Float64:
        """Return the times [s] at which a rotating mirror directs the beam to ``positions`` [m].

        Sampling at these times, counted from the middle of the facet, gives equidistant samples for equidistant
        positions. The next facet repeats them after ``2 pi / (facets angular_speed)``.

        Parameters
        ----------
        positions : array_like
            Positions x on the surface [m], any shape.
        angular_speed : float
            Rotation speed of the mirror [rad/s], positive.

        Returns
        -------
        numpy.ndarray
            Times [s] from the middle of the facet; NaN out of reach.

        Raises
        ------
        ValueError
            ``angular_speed`` is not positive.
        """
        if not finite(angular_speed, "angular_speed") > 0.0:
            raise ValueError(f"angular_speed is {angular_speed}, expected a positive one [rad/s]")
        return self.rotation(positions) / angular_speed

    def facet_position(self, rotation: npt.ArrayLike) -> Float64:
        """Return the distance along the facet from its middle to the point that the beam hits [m]."""
        facet = 0.25 * math.pi - np.asarray(rotation, dtype=np.float64)
        return np.asarray(self.apothem * (_HALF_ROOT - np.sin(facet)) / np.cos(facet))

    @property
    def limits(self) -> tuple[float, float]:
        """Smallest and largest phi [rad] of a scan.

        Three conditions hold within the limits. The beam hits the facet: ``|facet_position| <= R tan(pi / facets)``.
        The beam is reflected downwards: ``|phi| < pi/4``. And x increases with phi; for a small drop this bounds
        phi on the negative side.
        """
        half = math.pi / self.facets
        middle = 0.25 * math.pi - math.asin(_HALF_ROOT * math.cos(half))
        edge = np.nextafter(0.25 * math.pi, 0.0)
        return max(middle - half, self._fold(), -edge), min(middle + half, edge)

    def hit_shift(self, rotation: npt.ArrayLike) -> Float64:
        """Return the motion of the hit point towards the light source, ``x_h(phi) - x_h(0)`` [m], 0 or more."""
        phi = np.asarray(rotation, dtype=np.float64)
        # As one quotient: the difference itself cancels near phi = 0.
        return np.asarray(2.0 * self.apothem * np.sin(0.5 * phi) ** 2 / np.cos(0.25 * math.pi - phi))

    def _position(self, phi: Float64) -> Float64:
        return np.asarray(self.hit_shift(phi) + self.drop * np.tan(2.0 * phi))

    def _fold(self) -> float:
        """Negative phi at which dx/dphi vanishes; -pi/4 where it never does."""
        # With s = sin(pi/4 - phi), dx/dphi has the sign of D/(2 s^2) + R/sqrt(2) - R s, which falls with s.
        roots = np.roots([-self.apothem, self.apothem * _HALF_ROOT, 0.0, 0.5 * self.drop])
        real = roots[np.abs(roots.imag) < _IMAGINARY_ROUNDING].real
        folded = real[(real > _HALF_ROOT) & (real < 1.0)]
        return 0.25 * math.pi - math.asin(folded.min()) if len(folded) else -0.25 * math.pi


class ShearedProfile(NamedTuple):
    """Positions of the samples of an inclined beam, shape (..., n).

    Attributes
    ----------
    x
        X of every sample [m], also where the status is NOT_INVERTIBLE; NaN where H is not finite.
    status
        uint8 `Status` flags: NOT_FINITE (H is not finite), NOT_INVERTIBLE (X does not advance from the previous finite
        sample: the surface is steeper than the beam, or two samples coincide).
    """

    x: Float64
    status: npt.NDArray[np.uint8]


def shear_profile(start: npt.ArrayLike, height: npt.ArrayLike, angle: float = 0.25 * math.pi) -> ShearedProfile:
    """Compute the positions of samples of an inclined beam: ``X = X0 + H tan(angle)`` (F. de Jong, Figure 2.5).

    Parameters
    ----------
    start : array_like
        X0, position where each beam meets H = 0 [m]; (..., n), strictly monotone along the last axis.
    height : array_like
        H of the samples [m], of the same shape.
    angle : float
        Angle between the beam and the H axis [rad], -pi/2 to pi/2 (exclusive).

    Returns
    -------
    ShearedProfile
        The sample after a hole is compared with the last finite sample before the hole.

    Raises
    ------
    ValueError
        Shapes differ, ``start`` is not strictly monotone, or the angle is out of its range.
    """
    x0, h = np.asarray(start, dtype=np.float64), np.asarray(height, dtype=np.float64)
    if x0.shape != h.shape or not x0.ndim:
        raise ValueError(f"start has shape {x0.shape} and height {h.shape}, expected the same, (..., n)")
    if not abs(finite(angle, "angle")) < 0.5 * math.pi:
        raise ValueError(f"angle is {angle} rad, expected less than a right angle")
    steps = np.diff(x0, axis=-1)
    if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
        raise ValueError("start is not strictly monotone along the last axis; expected the order of the scan")
    forward = 1.0 if np.all(steps > 0.0) else -1.0
    x = x0 + h * math.tan(angle)
    known = np.isfinite(x)
    # Number of the last known sample up to each sample: forward fill of the holes.
    number = np.maximum.accumulate(np.where(known, np.arange(x.shape[-1]), -1), axis=-1)
    before = np.take_along_axis(x, np.maximum(number[..., :-1], 0), axis=-1)
    folded = known[..., 1:] & (number[..., :-1] >= 0) & (forward * (x[..., 1:] - before) <= 0.0)
    status = np.where(known, 0, Status.NOT_FINITE).astype(np.uint8)
    status[..., 1:][folded] = Status.NOT_INVERTIBLE
    return ShearedProfile(np.where(known, x, np.nan), status)
