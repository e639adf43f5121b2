"""Depth from focus with parallel pinholes: the intensities behind K pinholes give the distance of sharpest focus.

Partly transparent mirrors distribute the light of one illuminated point over K pinholes at equally spaced image
distances (F. de Jong, Figure 2.6). The intensity behind a pinhole falls off with the defocus like a Gaussian. The peak
of the Gaussian is the image distance LI, and the thin lens equation ``1/f = 1/LI + 1/LO`` (eq. 2.1) gives the object
distance LO.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]

# Curvature of the parabola through the logarithms of equal intensities, relative to the largest logarithm: sixteen
# roundings, of either sign (derived). Readings below it are AMBIGUOUS.
_CURVATURE_ROUNDING = 16.0 * float(np.finfo(np.float64).eps)


class FocusReading(NamedTuple):
    """Distances from the pinholes: arrays of the shape of the batch; NaN where the status is not OK.

    Attributes
    ----------
    image_distance
        Distance LI of the sharpest image behind the lens [m].
    object_distance
        Distance LO of the point in front of the lens [m].
    width
        Standard deviation of the Gaussian through the intensities [m].
    sigma_image, sigma_object
        Predicted standard deviations of LI and LO [m]; ``None`` if the intensities have none.
    status
        uint8 `Status` flags: NOT_FINITE; LOW_SIGNAL (fewer than three pinholes are above the minimum); AMBIGUOUS (no
        maximum: equal intensities, or a valley); OUT_OF_RANGE (the peak lies outside the pinholes, or no object in
        front of the lens has its image there).
    """

    image_distance: Float64
    object_distance: Float64
    width: Float64
    sigma_image: Float64 | None
    sigma_object: Float64 | None
    status: npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class DepthFromFocus:
    """Depth from focus: parallel pinholes behind one lens; called with intensities of shape (..., K).

    For three pinholes the solution is ``z = d/2 (ln I- - ln I+) / (ln I- - 2 ln I0 + ln I+)``, with z measured from the
    middle pinhole and the spacing d. For more pinholes a parabola is fitted to ln I with weights I^2 (equal noise on
    every I); without weights dim pinholes would dominate.

    Parameters
    ----------
    first
        Image distance of the first pinhole [m].
    spacing
        Distance between the pinholes [m].
    focal_length
        Focal length f of the lens [m].
    minimum
        Intensity above which a pinhole is used, in the unit of the intensities, default 0.
    sigma_intensity
        Standard deviation of an intensity, the same for every pinhole; requests the sigmas.

    Raises
    ------
    ValueError
        The pinholes do not lie beyond the focal length, or a number is out of range.
    """

    first: float
    spacing: float
    focal_length: float
    minimum: float = 0.0
    sigma_intensity: float | None = None

    def __post_init__(self) -> None:
        for name in ("first", "spacing", "focal_length"):
            if not finite(getattr(self, name), f"DepthFromFocus.{name}") > 0.0:
                raise ValueError(f"DepthFromFocus.{name} is {getattr(self, name)}, expected a positive length [m]")
        if not self.first > self.focal_length:
            raise ValueError(
                f"DepthFromFocus.first is {self.first} m, expected beyond the focal length, {self.focal_length} m"
            )
        if not finite(self.minimum, "DepthFromFocus.minimum") >= 0.0:
            raise ValueError(f"DepthFromFocus.minimum is {self.minimum}, expected 0 or more")
        if self.sigma_intensity is not None and not finite(self.sigma_intensity, "sigma_intensity") > 0.0:
            raise ValueError(f"DepthFromFocus.sigma_intensity is {self.sigma_intensity}, expected a positive number")

    def __call__(self, intensities: npt.ArrayLike, sigma: npt.ArrayLike | None = None) -> FocusReading:
        """Compute the distance of the sharpest focus.

        Parameters
        ----------
        intensities
            Intensities behind the pinholes in order, shape (..., K), K >= 3.
        sigma
            Standard deviations of the intensities, of the same shape; they err independently. Default:
            ``sigma_intensity``.

        Raises
        ------
        ValueError
            There are fewer than three pinholes, or ``sigma`` has another shape.
        """
        light = np.asarray(intensities, dtype=np.float64)
        if not light.ndim or light.shape[-1] < 3:
            raise ValueError(f"intensities have shape {light.shape}, expected (..., K) with at least 3 pinholes")
        deviations = self.sigma_intensity if sigma is None else np.asarray(sigma, dtype=np.float64)
        if deviations is not None and np.shape(deviations) not in ((), light.shape):
            raise ValueError(
                f"sigma has shape {np.shape(deviations)}, expected the shape of the intensities, {light.shape}"
            )
        count = light.shape[-1]
        known = np.all(np.isfinite(light), axis=-1)
        lit = np.isfinite(light) & (light > self.minimum)
        enough = known & (np.count_nonzero(lit, axis=-1) >= 3)
        safe = np.where(lit, light, 1.0)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            # Relative to the brightest: a common level would only add roundings, which small weights magnify.
            log = np.log(safe / np.max(np.where(lit, light, 0.0), axis=-1, keepdims=True))
            peak, curvature, spread = self._peak(log, self._weights(safe, lit), lit, safe, deviations)
            # In units of the spacing, from the middle of the pinholes.
            image = self.first + self.spacing * (peak + 0.5 * (count - 1))
            width = self.spacing * np.sqrt(-0.5 / curvature)
        flat = _CURVATURE_ROUNDING * np.max(np.abs(np.log(safe)), axis=-1)
        status = np.zeros(light.shape[:-1], dtype=np.uint8)
        status[~(np.abs(peak) <= 0.5 * (count - 1))] = Status.OUT_OF_RANGE
        status[~(curvature < -flat)] = Status.AMBIGUOUS
        status[~enough] = Status.LOW_SIGNAL
        status[~known] = Status.NOT_FINITE
        good = status == Status.OK
        image = np.where(good, image, np.nan)
        sigma = None if spread is None else np.where(good, self.spacing * spread, np.nan)
        slope = self.focal_length / (image - self.focal_length)
        return FocusReading(
            image_distance=image,
            object_distance=conjugate_distance(image, self.focal_length),
            width=np.where(good, width, np.nan),
            sigma_image=sigma,
            sigma_object=None if sigma is None else sigma * slope**2,
            status=status,
        )

    def _weights(self, light: Float64, lit: npt.NDArray[np.bool_]) -> Float64:
        """Return weights I^2 relative to the brightest pinhole; with three pinholes the weights have no effect."""
        if light.shape[-1] == 3:
            return np.where(lit, 1.0, 0.0)
        brightest = np.max(np.where(lit, light, 0.0), axis=-1, keepdims=True)
        return np.where(lit, (light / np.where(brightest > 0.0, brightest, 1.0)) ** 2, 0.0)

    @staticmethod
    def _peak(
        log: Float64,
        weights: Float64,
        lit: npt.NDArray[np.bool_],
        light: Float64,
        deviations: float | Float64 | None,
    ) -> tuple[Float64, Float64, Float64 | None]:
        """Return peak and curvature of the weighted parabola [spacings], and the standard deviation of the peak.

        Polynomials orthogonal under the weights keep the fit well conditioned where few pinholes carry the weight.
        """
        count = log.shape[-1]
        place = np.arange(count) - 0.5 * (count - 1)
        total = np.sum(weights, axis=-1, keepdims=True)
        middle = np.sum(weights * place, axis=-1, keepdims=True) / total
        offset = place - middle
        second = np.sum(weights * offset**2, axis=-1, keepdims=True)
        skew = np.sum(weights * offset**3, axis=-1, keepdims=True) / second
        bow = offset * (offset - skew) - second / total
        to_slope = weights * offset / second
        to_curvature = weights * bow / np.sum(weights * bow**2, axis=-1, keepdims=True)
        slope = np.sum(to_slope * log, axis=-1, keepdims=True)
        curvature = np.sum(to_curvature * log, axis=-1, keepdims=True)
        step = -0.5 * slope / curvature
        peak = (middle + 0.5 * skew + step)[..., 0]
        if deviations is None:
            return peak, curvature[..., 0], None
        gain = (-0.5 * to_slope - step * to_curvature) / curvature
        noise = np.where(lit, deviations / light, 0.0)
        return peak, curvature[..., 0], np.sqrt(np.sum((gain * noise) ** 2, axis=-1))


def conjugate_distance(distance: npt.ArrayLike, focal_length: float) -> Float64:
    """Return the conjugate distance on the other side of a thin lens [m]: ``1/f = 1/LI + 1/LO``, in either direction.

    NaN for distances up to the focal length.
    """
    reach = np.asarray(distance, dtype=np.float64)
    beyond = reach > finite(focal_length, "focal_length")
    return np.where(beyond, focal_length * (reach / np.where(beyond, reach - focal_length, math.inf)), np.nan)
