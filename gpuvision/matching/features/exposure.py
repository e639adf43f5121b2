"""Image quality of a board's edges from the sensor, and the exposure for a wanted precision of the edges."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.features.imaging import Imaging
from gpuvision.validation import finite

_DECADES, _STEPS = 9.0, 180  # searched exposures below saturation: 20 per decade


def sensor_imaging(
    sensor: CmosSensor,
    *,
    pixel: float,
    white_electrons: float,
    exposure: float = 0.0,
    reflectance: BoardReflectance | None = None,
    spatial: bool = True,
    **options: Any,
) -> Imaging:
    """Return the image quality of a board's edges, with the contrast and the noise of a sensor.

    Parameters
    ----------
    sensor : CmosSensor
        Sensor.
    pixel : float
        Size of a pixel on the board [m].
    white_electrons : float
        Photoelectrons of white board during the exposure, see `CmosSensor.electrons`. Range: above 0.
    exposure : float
        Exposure time for the dark current [s], default 0.
    reflectance : BoardReflectance, optional
        Reflectances of the board. Default: `BoardReflectance`.
    spatial : bool
        Whether the differences between pixels count as noise, as in `CmosSensor.noise`. Default True.
    **options
        Other parameters of `Imaging`: blur_px, motion_px, width_px and so on.

    Returns
    -------
    Imaging
        Image quality with contrasts in units of the noise.

    Raises
    ------
    ValueError
        Bare copper saturates, an edge has no contrast, or a parameter is out of its range.

    Notes
    -----
    The contrast of an edge is the step in electrons over the root mean square noise of its two sides.
    """
    board = reflectance or BoardReflectance()
    white = finite(white_electrons, "white_electrons", above=0.0)
    brightest = white * max(board.copper, board.laminate)
    if brightest > sensor.saturation:
        raise ValueError(
            f"bare board has {brightest:.4g} electrons, the sensor saturates at {sensor.saturation:.4g}; expose shorter"
        )

    def contrast(copper: float, laminate: float) -> float:
        if copper == laminate:
            raise ValueError(f"copper and laminate have the same reflectance {copper:g}: edges have no contrast")
        sides = np.array([copper, laminate]) * white
        noise = sensor.noise(sides, exposure, spatial=spatial)
        return float(abs(sides[0] - sides[1]) / np.sqrt(np.mean(noise**2)))

    return Imaging(
        pixel=pixel,
        contrast_bare=contrast(board.copper, board.laminate),
        contrast_masked=contrast(board.copper_masked, board.laminate_masked),
        **options,
    )


def smallest_exposure(
    sensor: CmosSensor,
    sigma_px: float,
    *,
    irradiance: float,
    pixel: float,
    speed: float = 0.0,
    bare: bool = False,
    reflectance: BoardReflectance | None = None,
    **options: Any,
) -> float:
    """Return the shortest exposure [s] at which edges have a wanted standard deviation.

    Parameters
    ----------
    sensor : CmosSensor
        Sensor with integrating pixels.
    sigma_px : float
        Wanted standard deviation of the position of one ruler's edge [px], above 0.
    irradiance : float
        Irradiance of the sensor by white board [W/m^2], above 0; see `gpuvision.camera.photons.image_irradiance`.
    pixel : float
        Size of a pixel on the board [m].
    speed : float
        Speed of the board across its edges [m/s], default 0: motion blur. Range: 0 or more.
    bare : bool
        True: edges of bare copper. Default False: edges under the mask.
    reflectance : BoardReflectance, optional
        Reflectances of the board. Default: `BoardReflectance`.
    **options
        Other parameters of `Imaging`: blur_px, width_px.

    Returns
    -------
    float
        Exposure time [s].

    Raises
    ------
    ValueError
        No exposure below saturation reaches the standard deviation; the message states the best one. Or the pixels are
        direct-read, or a parameter is out of its range.

    Notes
    -----
    `Imaging.sigma` at every exposure: at best smoothing 1.2 times the bound 1.883 sqrt(blur) / (contrast sqrt(width)).
    With motion a long exposure is worse again, because rulers are smoothed for edges at rest.
    """
    wanted = finite(sigma_px, "sigma_px", above=0.0)
    finite(irradiance, "irradiance [W/m^2]", above=0.0)
    finite(speed, "speed [m/s]", minimum=0.0)
    if sensor.pixel == "direct_read":
        raise ValueError("direct-read pixels have no exposure; the response time determines their noise")
    board = reflectance or BoardReflectance()
    per_second = float(sensor.electrons(irradiance, 1.0))

    def sigma(log_time: float) -> float:
        time = math.exp(log_time)
        imaging = sensor_imaging(
            sensor,
            pixel=pixel,
            white_electrons=per_second * time,
            exposure=time,
            reflectance=board,
            motion_px=(sensor.motion_blur(speed, time, pixel), 0.0),
            **options,
        )
        return float(imaging.sigma(bare)) / pixel

    # Rounding may put the longest exposure just beyond saturation.
    last = math.log(sensor.saturation / (max(board.copper, board.laminate) * per_second)) - 1e-12
    return math.exp(_shortest_log_time(sigma, last, wanted))


def _shortest_log_time(sigma: Callable[[float], float], last: float, wanted: float) -> float:
    """Return the logarithm of the shortest time, up to ``last``, at which a standard deviation [px] is reached."""
    times = np.linspace(last - _DECADES * math.log(10.0), last, _STEPS + 1)
    sigmas = np.array([sigma(each) for each in times])
    best = int(np.argmin(sigmas))
    inner = minimize_scalar(sigma, bounds=(times[max(best - 1, 0)], times[min(best + 1, _STEPS)]), method="bounded")
    least, longest = min((sigmas[best], times[best]), (inner.fun, inner.x))
    if least > wanted:
        raise ValueError(
            f"no exposure reaches {wanted:g} px: the best, {math.exp(longest):.3g} s, reaches {least:.3g} px; "
            "give more light, wider rulers or less speed"
        )
    before = times[(times < longest) & (sigmas > wanted)]
    if not len(before):
        return float(times[0])
    return float(brentq(lambda at: sigma(at) - wanted, before[-1], longest))
