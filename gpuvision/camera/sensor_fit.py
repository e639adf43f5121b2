"""Fit of an EMVA 1288 sensor model to flat and dark frames, by photon transfer, with uncertainties."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.photon_transfer import Float64, FrameStatistics, frame_statistics
from gpuvision.validation import finite

_QUANTISATION = 1.0 / 12.0  # variance of rounding to whole grey levels
_PART_OF_RANGE = 0.7  # of the grey levels to saturation, for the fits: EMVA 1288, release 4.0, section 6.6
_SIGNIFICANT = 4.0  # least fall of the variance beyond saturation [standard deviations]


class Estimate(NamedTuple):
    """Fitted value and its standard deviation; NaN where the frames do not determine it."""

    value: float
    sigma: float

    def __str__(self) -> str:
        """Return ``value +- sigma``."""
        return f"{self.value:.5g} +- {self.sigma:.2g}"


_UNKNOWN = Estimate(math.nan, math.nan)


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorFit:
    """Fitted parameters of a sensor.

    Attributes
    ----------
    gain : Estimate
        K [grey levels per electron].
    dark_noise : Estimate
        Standard deviation from frame to frame without light, without quantisation and dark current [e-].
    quantum_efficiency : Estimate
        Electrons per photon; NaN without photons. The uncertainty of the photons is not included.
    dark_current : Estimate
        Mean dark signal [e-/s]; NaN with fewer than two exposure times.
    dsnu, prnu : Estimate
        Differences between the pixels without light [e-], and of their gain (relative).
    dark_level : float
        Mean grey level without light at exposure 0; at the only exposure without exposure times.
    saturation : float
        Electrons at which the temporal variance is largest; infinite if it does not fall in the frames.
    mean, variance : (steps,)
        Mean grey level and temporal variance of the flat frames, minus mean and variance of their dark frames.
    used : (steps,) bool
        Steps of the fits: up to 0.7 of the saturation.
    reduced_chi_square : float
        Squared deviations of the variances from K times the mean, over the expected squared deviations, per degree of
        freedom. Where it exceeds 1, sigmas are larger by its square root.
    """

    gain: Estimate
    dark_noise: Estimate
    quantum_efficiency: Estimate
    dark_current: Estimate
    dsnu: Estimate
    prnu: Estimate
    dark_level: float
    saturation: float
    mean: Float64
    variance: Float64
    used: npt.NDArray[np.bool_]
    reduced_chi_square: float

    @property
    def predicted_variance(self) -> Float64:
        """Variance (steps,) that the fit predicts from the mean: K times the mean."""
        return np.asarray(self.gain.value * self.mean)

    def sensor(self, **others: Any) -> CmosSensor:
        """Return a sensor with the fitted values; give the other parameters of `CmosSensor` (rows, pitch, bits ...).

        Values that the frames do not determine have the default of `CmosSensor`, unless they are given.
        """
        names = ("gain", "dark_noise", "quantum_efficiency", "dark_current", "dsnu", "prnu")
        fitted = {name: getattr(self, name).value for name in names}
        known = {name: value for name, value in fitted.items() if math.isfinite(value)}
        known |= {"full_well": self.saturation} if math.isfinite(self.saturation) else {}
        return CmosSensor(**{**known, "dark_level": max(self.dark_level, 0.0), **others})


def fit_sensor(
    flat: Sequence[npt.NDArray[Any]],
    dark: Sequence[npt.NDArray[Any]] | npt.NDArray[Any],
    *,
    photons: npt.ArrayLike | None = None,
    exposures: npt.ArrayLike | None = None,
    quantised: bool = True,
) -> SensorFit:
    """Fit gain, noise, quantum efficiency and differences between the pixels to flat and dark frames.

    Parameters
    ----------
    flat : sequence of numpy.ndarray
        A stack (frames, rows, columns) of 2 frames or more for each irradiation, of evenly lit pixels, ascending.
    dark : sequence of numpy.ndarray
        A stack without light for each stack of ``flat``, with the same exposure time; or one stack for all.
    photons : array_like, optional
        (steps,) mean photons per pixel of the flat frames, for the quantum efficiency.
    exposures : array_like, optional
        (steps,) exposure times [s], for the dark current. Default: all are equal.
    quantised : bool
        Whether the grey levels are whole numbers: quantisation (1/12) is then not part of the dark noise. Default True.

    Returns
    -------
    SensorFit

    Raises
    ------
    TypeError, ValueError
        A stack has a wrong shape, numbers of stacks differ, or fewer than two steps lie below saturation.

    Notes
    -----
    Temporal variance less dark variance = K (mean less dark mean): generalised least squares with the variances of
    normal noise, from all steps up to 0.7 of the saturation. Mean less dark mean = K QE photons likewise. Standard
    deviations of the statistics are propagated to all values; the residuals enlarge them where they are larger than
    expected (a non-linear sensor, light that changes). dsnu and prnu include the finite number of pixels. Uneven light
    counts as prnu.

    Cost: two passes over the frames, in double precision one stack at a time.

    References
    ----------
    .. [1] EMVA Standard 1288, Standard for characterization of image sensors and cameras, release 4.0 (linear).
    .. [2] J. R. Janesick, Photon Transfer, SPIE Press 2007.
    """
    lit = frame_statistics(flat, "flat")
    steps = len(lit.mean)
    shared = isinstance(dark, np.ndarray)
    unlit = frame_statistics([dark] if isinstance(dark, np.ndarray) else dark, "dark")
    if not shared and len(unlit.mean) != steps:
        raise ValueError(f"{steps} stacks of flat frames and {len(unlit.mean)} of dark ones; give one for each, or one")
    times = _per_step(exposures, steps, "exposures [s]")
    given = _per_step(photons, steps, "photons")
    if shared and times is not None:
        raise ValueError("exposures need a stack of dark frames for each of them")
    return _Fit(lit, unlit, given, times, _QUANTISATION if quantised else 0.0).result()


def _per_step(values: npt.ArrayLike | None, steps: int, what: str) -> Float64 | None:
    if values is None:
        return None
    numbers = np.array([finite(each, what, minimum=0.0) for each in np.ravel(np.asarray(values))])
    if len(numbers) != steps:
        raise ValueError(f"{what}: {len(numbers)} numbers, expected {steps}, one for each stack of flat frames")
    return numbers


class _Values(NamedTuple):
    """Values that depend on the statistics, in the order of the rows of the Jacobian."""

    gain: float
    dark_noise: float
    quantum_efficiency: float
    dark_current: float
    dark_level: float


class _Fit:
    """Estimation from statistics, and propagation of their variances."""

    def __init__(
        self,
        lit: FrameStatistics,
        unlit: FrameStatistics,
        photons: Float64 | None,
        exposures: Float64 | None,
        quantisation: float,
    ) -> None:
        self._lit, self._unlit, self._photons, self._quantisation = lit, unlit, photons, quantisation
        steps, stacks = len(lit.mean), len(unlit.mean)
        self._dark_of = np.arange(steps) if stacks > 1 else np.zeros(steps, int)
        self._times = exposures if exposures is not None and len(np.unique(exposures)) > 1 else None
        # Statistics in one vector: flat means, flat variances, dark means, dark variances.
        self._parts = np.cumsum([steps, steps, stacks])
        self._statistics = np.concatenate([lit.mean, lit.temporal, unlit.mean, unlit.temporal])
        self.mean = lit.mean - unlit.mean[self._dark_of]
        self.variance = lit.temporal - unlit.temporal[self._dark_of]
        self._last, self.saturated = self._saturation()
        limit = self.mean[self._last] * (_PART_OF_RANGE if self.saturated else 1.0)
        self.used = (self.mean <= limit) & (np.arange(steps) <= self._last)
        if np.count_nonzero(self.used) < 2:
            raise ValueError("fewer than two steps of the flat frames lie below 0.7 of the saturation; give more steps")
        self._weights_of_variance = self._weights(lit.temporal_variance, unlit.temporal_variance)
        self._weights_of_mean = self._weights(lit.mean_variance, unlit.mean_variance)

    def _saturation(self) -> tuple[int, bool]:
        """Return the step of the largest temporal variance, and whether the variance falls beyond it."""
        last = int(np.argmax(self._lit.temporal))
        error = np.sqrt(self._lit.temporal_variance)
        fall = self._lit.temporal[last] - self._lit.temporal[last + 1 :]
        falls = bool(np.any(fall > _SIGNIFICANT * np.hypot(error[last], error[last + 1 :])))
        return (last, True) if falls else (len(self.mean) - 1, False)

    def _weights(self, lit: Float64, unlit: Float64) -> Float64:
        """Return the inverse covariance of differences of flat and dark statistics with these variances, used steps."""
        which = self._dark_of[self.used]
        covariance = np.diag(lit[self.used]) + np.where(which[:, None] == which, unlit[which], 0.0)
        # Frames without noise: a variance of 0 has no inverse; such steps then count alike.
        floor = max(float(covariance.diagonal().max()), 1e-30) * 1e-12
        return np.asarray(np.linalg.inv(covariance + floor * np.eye(len(covariance))))

    def _values(self, statistics: Float64) -> _Values:
        flat_mean, flat_variance, dark_mean, dark_variance = np.split(statistics, self._parts)
        mean = (flat_mean - dark_mean[self._dark_of])[self.used]
        gain = _slope(mean, (flat_variance - dark_variance[self._dark_of])[self.used], self._weights_of_variance)
        level, rate = self._dark_line(dark_mean)
        # Dark current adds its shot noise K (mean - level) to the dark noise.
        noise = dark_variance - self._quantisation
        if self._times is not None:
            noise = noise - gain * (dark_mean - level)
        weights = 1.0 / np.maximum(self._unlit.temporal_variance, 1e-30)
        squared = float(np.sum(weights * noise) / np.sum(weights))
        efficiency = math.nan
        if self._photons is not None:
            efficiency = _slope(self._photons[self.used], mean, self._weights_of_mean) / gain
        return _Values(gain, math.sqrt(max(squared, 0.0)) / abs(gain), efficiency, rate / gain, level)

    def _dark_line(self, dark_mean: Float64) -> tuple[float, float]:
        """Return the dark level at exposure 0 and its increase per second, both of grey levels."""
        if self._times is None:
            return float(np.mean(dark_mean)), math.nan
        weights = 1.0 / np.sqrt(np.maximum(self._unlit.mean_variance, 1e-30))
        design = np.stack([np.ones_like(self._times), self._times], axis=1)
        level, rate = np.linalg.lstsq(design * weights[:, None], dark_mean * weights, rcond=None)[0]
        return float(level), float(rate)

    def _scales(self, gain: float) -> tuple[float, float, float, float]:
        """Return factors >= 1 on the variances of flat variances, flat means and dark means, and the first one raw."""
        mean, variance = self.mean[self.used], self.variance[self.used]
        of_variance = _reduced_chi_square(variance - gain * mean, self._weights_of_variance, 1)
        of_mean = of_dark = 1.0
        if self._photons is not None:
            photons = self._photons[self.used]
            slope = _slope(photons, mean, self._weights_of_mean)
            of_mean = _reduced_chi_square(mean - slope * photons, self._weights_of_mean, 1)
        if self._times is not None:
            level, rate = self._dark_line(self._unlit.mean)
            left = self._unlit.mean - level - rate * self._times
            weights = np.diag(1.0 / np.maximum(self._unlit.mean_variance, 1e-30))
            of_dark = _reduced_chi_square(left, weights, 2)
        return max(of_variance, 1.0), max(of_mean, 1.0), max(of_dark, 1.0), of_variance

    def result(self) -> SensorFit:
        """Return the fit with standard deviations."""
        values = self._values(self._statistics)
        of_variance, of_mean, of_dark, chi_square = self._scales(values.gain)
        lit, unlit = self._lit, self._unlit
        variances = np.concatenate(
            [
                lit.mean_variance * of_mean,
                lit.temporal_variance * of_variance,
                unlit.mean_variance * of_dark,
                unlit.temporal_variance,
            ]
        )
        sigmas = np.sqrt(self._jacobian(np.sqrt(variances)) ** 2 @ np.ones(len(variances)))
        fitted = {
            name: Estimate(value, float(sigma)) if math.isfinite(value) else _UNKNOWN
            for name, value, sigma in zip(_Values._fields, values, sigmas, strict=True)
        }
        dsnu, prnu = self._differences(values.gain)
        return SensorFit(
            gain=fitted["gain"],
            dark_noise=fitted["dark_noise"],
            quantum_efficiency=fitted["quantum_efficiency"],
            dark_current=fitted["dark_current"],
            dsnu=dsnu,
            prnu=prnu,
            dark_level=values.dark_level,
            saturation=float(self.mean[self._last] / values.gain) if self.saturated else math.inf,
            mean=self.mean,
            variance=self.variance,
            used=self.used,
            reduced_chi_square=chi_square,
        )

    def _jacobian(self, steps: Float64) -> Float64:
        """Return the changes of the values by one standard deviation of each statistic (values, statistics)."""
        columns = []
        for index, step in enumerate(steps):
            moved = np.zeros(len(steps))
            moved[index] = step
            above, below = (np.array(self._values(self._statistics + sign * moved)) for sign in (1.0, -1.0))
            columns.append((above - below) / 2.0)
        return np.stack(columns, axis=1)

    def _differences(self, gain: float) -> tuple[Estimate, Estimate]:
        """Return dsnu [e-] and prnu: square roots of spatial variances, averaged over the stacks."""
        unlit, pixels = self._unlit, float(self._unlit.pixels[0])
        weights = 1.0 / np.maximum(unlit.spatial_variance, 1e-30)
        squared = float(np.sum(weights * unlit.spatial) / np.sum(weights))
        dsnu = _root(squared, 1.0 / float(np.sum(weights)), pixels)
        mean, excess = self.mean[self.used], self._lit.spatial[self.used] - squared
        noise = np.maximum(self._lit.spatial_variance[self.used], 1e-30)
        weight = mean**4 / noise
        ratio = float(np.sum(weight * excess / mean**2) / np.sum(weight))
        # Dark and bright differences are independent, but not of a finite number of pixels.
        chance = 4.0 * max(squared, 0.0) * max(ratio, 0.0) / pixels * float(np.sum(weight / mean) / np.sum(weight)) ** 2
        prnu = _root(ratio, 1.0 / float(np.sum(weight)) + chance, pixels)
        return Estimate(dsnu.value / gain, dsnu.sigma / gain), prnu


def _slope(x: Float64, y: Float64, weights: Float64) -> float:
    """Return the slope of a line through 0, by generalised least squares."""
    return float(x @ weights @ y / (x @ weights @ x))


def _reduced_chi_square(left: Float64, weights: Float64, parameters: int) -> float:
    freedom = len(left) - parameters
    return float(left @ weights @ left) / freedom if freedom else 1.0


def _root(squared: float, variance: float, pixels: float) -> Estimate:
    """Return the root of a spatial variance, with the errors of the variance and of a finite number of pixels.

    Where the variance is not above its error, the value has the error of the root at the error.
    """
    value = math.sqrt(max(squared, 0.0))
    error = math.sqrt(variance)
    own = error / (2.0 * max(value, math.sqrt(error / 2.0)))
    return Estimate(value, math.hypot(own, value / math.sqrt(2.0 * (pixels - 1.0))))
