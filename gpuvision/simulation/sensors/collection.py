"""What a sensor makes of radiance: the lens' light, its fall towards the edge, and the current."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
_PLANCK, _LIGHT, _CHARGE = 6.62607015e-34, 299792458.0, 1.602176634e-19


def lens_solid_angle(radius: npt.ArrayLike, distance: npt.ArrayLike) -> Array:
    """Return the solid angle, sr, of a round aperture (m) seen from its axis at a distance (m): 2 pi (1 - cos)."""
    radius, distance = np.asarray(radius, np.float64), np.asarray(distance, np.float64)
    slant = np.hypot(radius, distance)
    # 1 - cos cancels for a small aperture.
    with np.errstate(invalid="ignore"):
        return np.asarray(2.0 * np.pi * (radius / slant) * (radius / (slant + distance)))


def image_irradiance(
    radiance: npt.ArrayLike, f_number: float, magnification: float = 0.0, angle: npt.ArrayLike = 0.0
) -> Array:
    """Return L (pi / 4) / (N^2 (1 + m)^2) cos^4, W/m^2, behind a thin lens of f-number N and magnification m.

    ``radiance`` in W/(m^2 sr), ``angle`` of the chief ray in radians.

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
    """Return the natural fall of light, cos^4 of the chief ray's angle (radians); zero from 90 degrees on."""
    return np.asarray(np.maximum(np.cos(np.asarray(angle, np.float64)), 0.0) ** 4)


def responsivity(wavelength: npt.ArrayLike, quantum_efficiency: npt.ArrayLike) -> Array:
    """Return a photodiode's responsivity eta lambda e / (h c), A/W; the wavelength in metres."""
    return (
        np.asarray(quantum_efficiency, np.float64) * np.asarray(wavelength, np.float64) * (_CHARGE / _PLANCK / _LIGHT)
    )
