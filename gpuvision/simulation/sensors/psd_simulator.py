"""PSD strips under simulated light: their currents with noise, and what is read.

Takes the same light as `gpuvision.simulation.sensors.camera_simulator`: `Exposure` by path, (samples, bins) of a
profile or (profiles, samples, bins) of a block. Noise is drawn anew for every profile from the seed and the profile's
number, so that a block simulated twice, or in other blocks, is the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.psd import ELECTRON, PsdNoise, PsdReading, PsdReadout
from gpuvision.simulation.sensors.masks import Mask, light_behind
from gpuvision.simulation.sensors.readings import (
    AMBIENT,
    Reading,
    check_not_negative,
    check_samples,
    lit_by,
    profile_generators,
    reading_of,
    with_ambient,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Float64 = npt.NDArray[np.float64]
_HIGHEST_CODE = 65535
_SAME = 1e-6  # of half a strip


@dataclass(frozen=True, kw_only=True, eq=False)
class PsdSimulator:
    """A row of PSD strips behind a lens.

    Parameters
    ----------
    view
        Its samples are the strips; its first and last edge along u are the strips' electrodes. Light beyond them does
        not count.
    readout
        How the currents are read, with the electronics' dark level, gain, load, linearity and noise, all of which are
        put into the currents. Without a triangulation it takes the view's. Its layout is "pairs".
    responsivity
        Of the strips [A/W].
    ambient
        Other light on every strip, even along it [W].
    modulated
        The light is modulated and demodulated: ambient light adds its shot noise only.
    mask
        In front of the strips.
    codes
        A converter makes uint16 codes of the currents, of `readout.ampere` each.

    Raises
    ------
    ValueError
        A number is out of its range, or the view is not one of the readout's strips.
    """

    view: SensorView
    readout: PsdReadout
    responsivity: float = 0.4
    ambient: float = 0.0
    modulated: bool = False
    mask: Mask | None = None
    codes: bool = False

    def __post_init__(self) -> None:
        check_not_negative(self, "responsivity", "ambient")
        if self.readout.layout != "pairs":
            raise ValueError("PsdSimulator.readout has layout 'planar', expected 'pairs'")
        sheet = self.readout.triangulation or self.view.triangulation
        noise = self.readout.noise or PsdNoise()
        limits = [self.readout.saturation, _HIGHEST_CODE * self.readout.ampere if self.codes else None]
        saturation = min((each for each in limits if each is not None), default=None)
        readout = replace(self.readout, triangulation=sheet, noise=noise, saturation=saturation, outputs=None)
        object.__setattr__(self, "readout", readout)
        axes, edges = self.readout.axes, self.view.u_edges
        half = 0.5 * abs(axes.position_pitch) * self.readout.strip_length
        ends = np.array([axes.position_origin - half, axes.position_origin + half])
        if np.any(np.abs(edges[[0, -1]] - ends) > _SAME * half):
            raise ValueError(
                f"PsdSimulator: the view's light ends at u = {edges[0]:g} and {edges[-1]:g}, the readout's strips at "
                f"{ends[0]:g} and {ends[1]:g}; expected the same"
            )
        check_samples(self.view, axes.sample_origin, axes.sample_pitch)

    def light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light behind the mask by path, ambient light among it unless it is demodulated away."""
        light = self._arriving(exposures)
        return {name: each for name, each in light.items() if not (self.modulated and name == AMBIENT)}

    def currents(
        self, exposures: Mapping[str, Exposure], *, seed: int | None = None, first: int = 0
    ) -> npt.NDArray[Any]:
        """Return the strips' currents (left, right), (..., strips, 2), in units of `readout.ampere`.

        In the readout's order of the strips, which runs against the view's where its axes' pitch is negative.

        Parameters
        ----------
        exposures
            Light by path, as it comes from the lens.
        seed
            Of the noise, of which the rounding to codes is a part. None: the currents that are expected, float64.
        first
            Number of the block's first profile.
        """
        signal = self.signal(lit_by(self.light(exposures)))
        if seed is None:
            return self._expected(signal)
        total, place = self._centre(signal)
        generators = profile_generators(seed, first, total.shape[:-1])
        draws = np.reshape(
            [each.standard_normal((5, self.view.samples)) for each in generators], (*total.shape[:-1], 5, -1)
        )
        kinds = self.readout.noise or PsdNoise()
        arriving = self._in_order(lit_by(self._arriving(exposures)))
        pair = self._divided(*self._with_shot_noise(arriving, total, place, draws))
        pair += kinds.independent * draws[..., 2:4, :].swapaxes(-1, -2)
        pair += kinds.opposed * draws[..., 4, :, None] * (1.0, -1.0)
        recorded = self._recorded(pair)
        if not self.codes:
            return recorded
        return np.clip(np.rint(recorded), 0, _HIGHEST_CODE).astype(np.uint16)

    def read(
        self,
        exposures: Mapping[str, Exposure],
        *,
        seed: int | None = None,
        first: int = 0,
        device: Device | None = None,
    ) -> Reading:
        """Read a block of profiles: `currents`, then the readout on a device.

        Without a seed the reading is the one of the currents without noise; its sigma says what noise would do. A
        strip without any light is LOW_SIGNAL. Samples are in the view's order.
        """
        said = self._said(self.currents(exposures, seed=seed, first=first), device)
        axes = self.readout.axes
        u = axes.position_origin + axes.position_pitch * np.asarray(said.position, np.float64)
        sigma = abs(axes.position_pitch) * np.asarray(said.sigma, np.float64)
        return reading_of(self.view, said, u, sigma, backward=axes.sample_pitch < 0.0)

    def signal(self, light: Exposure) -> Float64:
        """Return what light behind the mask adds to the strips' currents: their sum, and it times u, (..., strips, 2).

        In the readout's order of the strips.
        """
        light = self._in_order(light)
        return self.responsivity * np.stack([light.total(), light.first_moment(self.view.u_edges)], axis=-1)

    def heights(self, signal: Float64, device: Device | None = None) -> Float64:
        """Read a signal without noise: heights [m], (..., samples), in the view's order."""
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return np.asarray(self._said(self._expected(signal), device).h, np.float64)[..., ::step]

    def _said(self, currents: npt.NDArray[Any], device: Device | None) -> PsdReading:
        device = Device.best() if device is None else device
        if currents.dtype == np.float64 and not device.has_double:
            currents = currents.astype(np.float32)
        return self.readout(currents, device=device)

    def _expected(self, signal: Float64) -> Float64:
        return self._recorded(self._divided(*self._centre(signal)))

    def _centre(self, signal: Float64) -> tuple[Float64, Float64]:
        total = signal[..., 0]
        return total, np.divide(signal[..., 1], total, out=np.zeros_like(total), where=total > 0.0)

    def _arriving(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        return light_behind(self.mask, self.view, with_ambient(self.view, exposures, self.ambient))

    def _in_order(self, light: Exposure) -> Exposure:
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return Exposure(light.power[..., ::step, :], light.moment[..., ::step, :])

    # ---- from light to currents ----------------------------------------------------------------------------

    def _with_shot_noise(
        self, light: Exposure, total: Float64, place: Float64, noise: Float64
    ) -> tuple[Float64, Float64]:
        """Every electron divides at its own place: their number, and the mean of their places, have noise.

        Ambient electrons add theirs, even where the mean of ambient light is demodulated away.
        """
        bandwidth = (self.readout.noise or PsdNoise()).bandwidth
        about = _second_moment(light, self.view.u_edges, place)
        variance = 2.0 * ELECTRON * bandwidth * self.responsivity * light.total()
        spread = np.sqrt(2.0 * ELECTRON * bandwidth * self.responsivity * about)
        noisy = total + np.sqrt(variance) * noise[..., 0, :]
        with np.errstate(invalid="ignore", divide="ignore"):
            shift = np.where(total > 0.0, spread * noise[..., 1, :] / total, 0.0)
        return noisy, place + shift

    def _divided(self, total: Float64, u: Float64) -> Float64:
        """Return what arrives at the electrodes, (..., 2) [A], without dark level and gain."""
        readout = self.readout
        position = (u - readout.axes.position_origin) / readout.axes.position_pitch
        half = 0.5 * readout.strip_length
        if readout.linearity is not None:
            knots = np.linspace(-half, half, len(readout.linearity[0]))
            for strip, corrections in enumerate(readout.linearity):
                # What is read at a knot is the knot; the light is where the correction takes it.
                position[..., strip] = np.interp(position[..., strip], knots + np.array(corrections), knots)
        balance = position / half
        if readout.interelectrode_resistance:
            balance /= 1.0 + 2.0 * readout.load_resistance / readout.interelectrode_resistance
        return 0.5 * total[..., None] * np.stack([1.0 - balance, 1.0 + balance], axis=-1)

    def _recorded(self, pair: Float64) -> Float64:
        readout = self.readout
        raw: Float64 = pair * (1.0, readout.right_gain) + readout.dark
        if readout.saturation is not None:
            raw = np.minimum(raw, readout.saturation)
        return raw / readout.ampere


def _second_moment(light: Exposure, edges: Float64, place: Float64) -> Float64:
    """Return the sum of power times squared distance from a place; light is even about its centre in every bin."""
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.where(light.power > 0.0, light.moment / light.power, 0.0)
    reach = half - np.minimum(np.abs(centre), half)
    square = (middle + centre - place[..., None]) ** 2 + reach**2 / 3.0
    return np.asarray(np.sum(light.power * square, axis=-1))
