"""Photon budget of a camera: illuminance and irradiance, light through a lens, and photons per pixel."""

from __future__ import annotations

import math

from gpuvision.validation import finite

PLANCK = 6.62607015e-34
"""Planck's constant [J s] (exact in the SI)."""
LIGHT_SPEED = 299792458.0
"""Speed of light in vacuum [m/s] (exact in the SI)."""
LUMENS_PER_WATT = 683.0
"""Luminous efficacy of light of 555 nm [lm/W] (defines the candela)."""


def luminous_efficiency(wavelength: float) -> float:
    """Return the photopic luminous efficiency V of light of one wavelength, 0 to 1.

    Parameters
    ----------
    wavelength
        Wavelength [m], above 0.

    Notes
    -----
    Two Gaussians with different widths below and above their maxima. They agree with the CIE table of 1931 to 0.01.

    References
    ----------
    .. [1] C. Wyman, P.-P. Sloan and P. Shirley, Simple analytic approximations to the CIE XYZ color matching functions,
       Journal of Computer Graphics Techniques 2 (2013) 1.
    """
    nm = finite(wavelength, "wavelength [m]", above=0.0) * 1e9
    lobes = ((0.821, 568.8, 46.9, 40.5), (0.286, 530.9, 16.3, 31.1))
    return sum(
        height * math.exp(-0.5 * ((nm - centre) / (below if nm < centre else above)) ** 2)
        for height, centre, below, above in lobes
    )


def irradiance_from_lux(illuminance: float, wavelength: float) -> float:
    """Return the irradiance [W/m^2] of monochromatic light from its illuminance [lx].

    Parameters
    ----------
    illuminance
        Illuminance [lx], 0 or more.
    wavelength
        Wavelength [m]. For white light give the wavelength at which the quantum efficiency is stated: the result then
        is the irradiance of light of that wavelength that is as bright to the eye.

    Raises
    ------
    ValueError
        The light is not visible: V is below 1e-3, and lux say nothing about its power.
    """
    efficiency = luminous_efficiency(wavelength)
    if efficiency < 1e-3:  # chosen: V of the CIE table falls to 1e-3 at 408 nm and 720 nm
        raise ValueError(f"light of {wavelength * 1e9:.0f} nm is not visible; give its irradiance [W/m^2], not lux")
    return finite(illuminance, "illuminance [lx]", minimum=0.0) / (LUMENS_PER_WATT * efficiency)


def image_irradiance(
    irradiance: float, f_number: float, *, magnification: float = 0.0, transmission: float = 1.0
) -> float:
    """Return the irradiance of the image of a white diffuse object [W/m^2] (camera equation).

    Parameters
    ----------
    irradiance
        Irradiance of the object [W/m^2], 0 or more.
    f_number
        Focal length over the diameter of the aperture, above 0.
    magnification
        Size of the image over the size of the object, default 0 (a far object). Range: 0 or more.
    transmission
        Part of the light that the lens transmits, above 0 to 1, default 1.

    Notes
    -----
    E_image = E_object T / (4 N^2 (1 + m)^2) for a Lambertian object of reflectance 1 near the optical axis. For
    another reflectance multiply by it.
    """
    aperture = finite(f_number, "f_number", above=0.0) * (1.0 + finite(magnification, "magnification", minimum=0.0))
    passed = finite(transmission, "transmission", above=0.0, maximum=1.0)
    return finite(irradiance, "irradiance [W/m^2]", minimum=0.0) * passed / (4.0 * aperture**2)


def photons_per_joule(wavelength: float) -> float:
    """Return the number of photons of a wavelength [m] in one joule: wavelength / (h c)."""
    return finite(wavelength, "wavelength [m]", above=0.0) / (PLANCK * LIGHT_SPEED)
