"""Correction of a distortion along the profiles of a readout: one polynomial of the position for each profile."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numpy.polynomial import chebyshev

from gpuvision.camera.distortion import Distortion

Float64 = npt.NDArray[np.float64]

# Chebyshev nodes along both axes of the frame. The series of strong lenses (20 % distortion, tilt 20 degrees) end at
# 1e-10 of the half extent (measured), far below single precision.
_NODES = 24
# Highest orders of the series along both axes; the orders that the nodes do not resolve are smaller than these.
_LAST_ORDERS = 2
# Positions lie in the profile; the margin holds roundings [samples].
_MARGIN = 1.0
# Terms of a polynomial, at most. With more the table costs as much as the iteration of the kernels (chosen).
_MAX_TERMS = 20
_LANES = 16  # profiles of a block of the kernels' table


class ProfileCorrection(NamedTuple):
    """Polynomials of the correction, see ``sheet_place_in_profile`` in ``kernels/common/sheet.h``.

    Attributes
    ----------
    terms
        float64 (2, terms, samples): coefficients of ``t^k`` of the corrections along position and sample, in the unit
        of the corrections, with ``t = (position - middle) scale``.
    middle, scale
        Position of t = 0, and change of t for one position.
    """

    terms: Float64
    middle: float
    scale: float

    def blocks(self, real: npt.DTypeLike) -> npt.NDArray[Any]:
        """Return the kernels' table of type ``real``: blocks of 16 profiles, (blocks, terms, 2, 16).

        The powers of t fall. If the profiles are no multiple of 16, blocks that end with the last profile follow.
        """
        from_last_power = self.terms[:, ::-1]
        moved = from_last_power.shape[-1] % _LANES
        rows = [np.pad(from_last_power, ((0, 0), (0, 0), (0, -from_last_power.shape[-1] % _LANES)))]
        if moved:
            rows.append(from_last_power[..., moved:])
        blocks = np.concatenate(rows, axis=-1).reshape(2, self.terms.shape[1], -1, _LANES)
        return np.ascontiguousarray(np.transpose(blocks, (2, 1, 0, 3)), real)


def profile_correction(
    distortion: Distortion,
    *,
    first: npt.ArrayLike,
    pitch: npt.ArrayLike,
    length: int,
    samples: int,
    unit: npt.ArrayLike,
    tolerance: float,
) -> ProfileCorrection | None:
    """Fit the correction of a distortion along the profiles of a frame.

    Parameters
    ----------
    distortion : Distortion
        Distortion of points (u, v).
    first, pitch : (2,) array_like
        Sensor coordinates of a position and a sample: ``(u, v) = first + pitch * (position, sample)``.
    length, samples : int
        Positions of a profile, and number of profiles.
    unit : (2,) array_like
        Units of the corrections along u and v [unit of u and v].
    tolerance : float
        Largest error of a correction, in its unit.

    Returns
    -------
    ProfileCorrection or None
        None if no polynomial of 20 terms meets the tolerance in all profiles. This includes a frame with a pixel that
        has no undistorted place: the inverse has a singularity at the fold of a lens, and at the horizon of a tilted
        sensor.

    Notes
    -----
    The corrections at 24 x 24 Chebyshev nodes give the series ``sum c_jk T_j(sample) T_k(position)``. Since ``|T| <=
    1``, the sum of the magnitudes of the omitted c_jk bounds the error of a truncated series over the whole frame. A
    profile's polynomial follows from the series at its sample.
    """
    grid = np.cos((np.arange(_NODES) + 0.5) * (math.pi / _NODES))
    middle, half = 0.5 * (length - 1), 0.5 * (length - 1) + _MARGIN
    centre, reach = 0.5 * (samples - 1), 0.5 * max(samples - 1, 1)
    coordinates = np.stack(np.meshgrid(middle + half * grid, centre + reach * grid), -1)
    points = np.asarray(first) + np.asarray(pitch) * coordinates
    corrections = (distortion.undistort(points) - points) / np.asarray(unit)
    if not np.isfinite(corrections).all():
        return None
    orders = np.arange(_NODES)
    to_series = np.cos(np.outer(orders, np.arccos(grid))) * (np.where(orders, 2.0, 1.0) / _NODES)[:, None]
    series = np.einsum("js,kp,spd->djk", to_series, to_series, corrections)
    sizes = np.max(np.abs(series), axis=0)
    rest = np.cumsum(np.sum(sizes, axis=0)[::-1])[::-1]  # of the orders k and above along the profile
    unresolved = sizes[-_LAST_ORDERS:].sum() + sizes[:, -_LAST_ORDERS:].sum()
    enough = np.flatnonzero(rest[:_MAX_TERMS] + unresolved <= tolerance)
    if not len(enough):
        return None
    terms = max(int(enough[0]), 1)
    at_samples = chebyshev.chebvander((np.arange(samples) - centre) / reach, _NODES - 1)
    chebyshev_terms = np.einsum("sj,djk->dks", at_samples, series[..., :terms])
    powers = np.stack([np.pad(chebyshev.cheb2poly(row), (0, terms))[:terms] for row in np.eye(terms)], -1)
    table = np.einsum("mk,dks->dms", powers, chebyshev_terms)
    return ProfileCorrection(table, middle, 1.0 / half)
