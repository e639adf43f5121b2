"""Radiometry of a lens and a photodiode: solid angle, image irradiance, cos^4 law, responsivity."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
# Planck's constant [J s], speed of light [m/s], elementary charge [C]: exact by definition of the SI.
_PLANCK, _LIGHT, _CHARGE = 6.62607015e-34, 299792458.0, 1.602176634e-19


def lens_solid_angle(radius: npt.ArrayLike, distance: npt.ArrayLike) -> Array:
    """Return the solid angle of a round aperture from a point on its axis: 2 pi (1 - cos) [sr].

    Parameters
    ----------
    radius, distance
        Radius of the aperture and distance of the point from its centre [m], 0 or more.
    """
    radius, distance = np.asarray(radius, np.float64), np.asarray(distance, np.float64)
    slant = np.hypot(radius, distance)
    # 1 - cos = (r / s) (r / (s + d)) with s = hypot(r, d): no cancellation for a small aperture.
    with np.errstate(invalid="ignore"):
        return np.asarray(2.0 * np.pi * (radius / slant) * (radius / (slant + distance)))


def image_irradiance(
    radiance: npt.ArrayLike, f_number: float, magnification: float = 0.0, angle: npt.ArrayLike = 0.0
) -> Array:
    """Return the image irradiance behind a thin lens: L (pi / 4) cos^4(angle) / (N^2 (1 + m)^2) [W/m^2].

    Parameters
    ----------
    radiance
        L [W/(m^2 sr)].
    f_number
        N, > 0.
    magnification
        m, 0 or more. Default 0.0.
    angle
        Angle between the chief ray and the optical axis [rad]. Default 0.0.

    Raises
    ------
    ValueError
        The f-number is not positive, or the magnification is negative.
    """
    if not f_number > 0.0 or not magnification >= 0.0:
        raise ValueError(f"expected f_number > 0 and magnification >= 0, got {f_number} and {magnification}")
    factor = np.pi / 4.0 / (f_number * (1.0 + magnification)) ** 2
    return np.asarray(radiance, np.float64) * factor * cos4(angle)


def cos4(angle: npt.ArrayLike) -> Array:
    """Return the natural vignetting cos^4 of the chief ray's angle [rad]; 0 for 90 degrees and more."""
    return np.asarray(np.maximum(np.cos(np.asarray(angle, np.float64)), 0.0) ** 4)


def responsivity(wavelength: npt.ArrayLike, quantum_efficiency: npt.ArrayLike) -> Array:
    """Return the responsivity of a photodiode, eta lambda e / (h c) [A/W].

    Parameters
    ----------
    wavelength
        lambda [m].
    quantum_efficiency
        eta, 0 to 1.
    """
    return (
        np.asarray(quantum_efficiency, np.float64) * np.asarray(wavelength, np.float64) * (_CHARGE / _PLANCK / _LIGHT)
    )
