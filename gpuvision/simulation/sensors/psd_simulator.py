"""Simulated PSDs: currents of the strips with noise under simulated light, and the profiles read from them.

The input is the same light as for `gpuvision.simulation.sensors.camera_simulator`: `Exposure` by path, (samples, bins)
of a profile or (profiles, samples, bins) of a block. The noise of a profile depends on the seed and the number of the
profile only: a block that is simulated again, or divided into other blocks, has the same noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.psd import ELECTRON, PsdNoise, PsdReading, PsdReadout
from gpuvision.simulation.sensors.masks import Mask, apply_mask
from gpuvision.simulation.sensors.readings import (
    AMBIENT,
    BEYOND_ENDS,
    AlignmentLimits,
    Reading,
    add_ambient,
    check_not_negative,
    check_sample_axes,
    make_reading,
    profile_generators,
    total_exposure,
)
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Float64 = npt.NDArray[np.float64]
_ALIGNMENT_LIMITS = AlignmentLimits()
# Largest code of the converter, uint16.
_MAX_CODE = 65535


@dataclass(frozen=True, kw_only=True, eq=False)
class PsdSimulator:
    """A row of PSD strips behind a lens.

    Parameters
    ----------
    view : SensorView
        View of the sensor. Its samples are the strips; its first and last edge along u are the electrodes of the
        strips. Light outside the edges is lost.
    readout : PsdReadout
        Readout of the currents, layout "pairs". Dark level, gain, load, linearity and noise of the readout are
        simulated. Without a triangulation it takes the triangulation of the view.
    responsivity : float
        Responsivity of the strips [A/W], 0 or more. Default 0.4.
    ambient : float
        Power of the ambient light on every strip, uniform along u [W], 0 or more. Above 0 it replaces the background
        photocurrent of the readout's noise model; that one is simulated as shot noise that no mask stops. Default 0.0.
    modulated : bool
        True: the light is modulated and demodulated, so that ambient light adds its shot noise only. Default False.
    mask : Mask, optional
        Mask before the strips.
    quantised : bool
        True: an analogue-to-digital converter makes uint16 codes of the currents, with a step of `readout.ampere`.
        Default False.
    limits : AlignmentLimits
        Allowed differences between view and readout.

    Raises
    ------
    TypeError, ValueError
        A number is out of its range, or the view does not fit the strips of the readout.
    """

    view: SensorView
    readout: PsdReadout
    responsivity: float = 0.4
    ambient: float = 0.0
    modulated: bool = False
    mask: Mask | None = None
    quantised: bool = False
    limits: AlignmentLimits = _ALIGNMENT_LIMITS

    def __post_init__(self) -> None:
        check_not_negative(self, "responsivity", "ambient")
        if self.readout.layout != "pairs":
            raise ValueError("PsdSimulator.readout has layout 'planar', expected 'pairs'")
        sheet = self.readout.triangulation or self.view.triangulation
        noise = self.readout.noise or PsdNoise()
        if self.ambient > 0.0:
            noise = replace(noise, background=0.0)
        limits = [self.readout.saturation, _MAX_CODE * self.readout.ampere if self.quantised else None]
        saturation = min((each for each in limits if each is not None), default=None)
        readout = replace(self.readout, triangulation=sheet, noise=noise, saturation=saturation, outputs=None)
        object.__setattr__(self, "readout", readout)
        axes, edges = self.readout.axes, self.view.u_edges
        half = 0.5 * abs(axes.position_pitch) * self.readout.strip_length
        ends = np.array([axes.position_origin - half, axes.position_origin + half])
        if np.any(np.abs(edges[[0, -1]] - ends) > self.limits.edge_tolerance * half):
            raise ValueError(
                f"PsdSimulator: the view ends at u = {edges[0]:g} and {edges[-1]:g}, the readout's strips at "
                f"{ends[0]:g} and {ends[1]:g}; expected the same"
            )
        check_sample_axes(self.view, axes.sample_origin, axes.sample_pitch, self.limits)

    def detected_light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light behind the mask by path, with the ambient light unless demodulation removes it."""
        light = self._incident(exposures)
        return {name: each for name, each in light.items() if not (self.modulated and name == AMBIENT)}

    def currents(
        self, exposures: Mapping[str, Exposure], *, seed: int | None = None, first_profile: int = 0
    ) -> npt.NDArray[Any]:
        """Return the currents (left, right) of the strips, (..., strips, 2), in units of `readout.ampere`.

        The strips are in the order of the readout: opposite to the order of the view if the pitch of the axes is
        negative.

        Parameters
        ----------
        exposures : mapping of str to Exposure
            Light by path behind the lens, before the mask, (..., samples, bins).
        seed : int, optional
            Seed of the noise, 0 or more; the quantisation to codes is part of the noise. None: expected currents,
            float64.
        first_profile : int
            Number of the first profile of the block. Default 0.
        """
        signal = self.signal(total_exposure(self.detected_light(exposures)))
        if seed is None:
            return self._expected(signal)
        total, centroid = self._total_and_centroid(signal)
        generators = profile_generators(seed, first_profile, total.shape[:-1])
        draws = np.reshape(
            [each.standard_normal((5, self.view.samples)) for each in generators], (*total.shape[:-1], 5, -1)
        )
        model = self.readout.noise or PsdNoise()
        incident = self._in_order(total_exposure(self._incident(exposures)))
        pair = self._divide(*self._with_shot_noise(incident, total, centroid, draws))
        # Noise of the channels as recorded, behind the gain.
        pair += model.independent * draws[..., 2:4, :].swapaxes(-1, -2) / (1.0, self.readout.right_gain)
        pair += model.opposed * draws[..., 4, :, None] * (1.0, -1.0)
        recorded = self._record(pair)
        if not self.quantised:
            return recorded
        return np.clip(np.rint(recorded), 0, _MAX_CODE).astype(np.uint16)

    def read(
        self,
        exposures: Mapping[str, Exposure],
        *,
        seed: int | None = None,
        first_profile: int = 0,
        device: Device | None = None,
    ) -> Reading:
        """Simulate the currents of a block of profiles and read them on a device.

        Parameters
        ----------
        exposures, seed, first_profile : mapping of str to Exposure, int or None, int
            As for `currents`. Without a seed, the noiseless currents are read; sigma is the same.
        device : Device, optional
            Device of the readout; None: `Device.best`.

        Returns
        -------
        Reading
            (..., samples), in the order of the view. A strip without light has the status LOW_SIGNAL. ``sigma`` is the
            readout's, with the shot noise of the ambient light that passes the mask.
        """
        reading = self._read(self.currents(exposures, seed=seed, first_profile=first_profile), device)
        axes = self.readout.axes
        u = axes.position_origin + axes.position_pitch * np.asarray(reading.position, np.float64)
        sigma = abs(axes.position_pitch) * np.asarray(reading.sigma, np.float64)
        sigma = np.sqrt(np.maximum(sigma**2 + self._ambient_variance(exposures), 0.0))
        return make_reading(self.view, reading, u, sigma, backward=axes.sample_pitch < 0.0)

    def signal(self, light: Exposure) -> Float64:
        """Return the total current and the current times u that light behind the mask adds, (..., strips, 2).

        The strips are in the order of the readout. Units: A, and A times sensor unit.
        """
        light = self._in_order(light)
        return self.responsivity * np.stack([light.total(), light.first_moment(self.view.u_edges)], axis=-1)

    def heights(self, signal: Float64, device: Device | None = None) -> Float64:
        """Read a signal without noise: heights [m], (..., samples), in the order of the view."""
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return np.asarray(self._read(self._expected(signal), device).h, np.float64)[..., ::step]

    def _read(self, currents: npt.NDArray[Any], device: Device | None) -> PsdReading:
        device = Device.best() if device is None else device
        if currents.dtype == np.float64 and not device.has_double:
            currents = currents.astype(np.float32)
        return self.readout(currents, device=device)

    def _expected(self, signal: Float64) -> Float64:
        return self._record(self._divide(*self._total_and_centroid(signal)))

    def _total_and_centroid(self, signal: Float64) -> tuple[Float64, Float64]:
        total = signal[..., 0]
        return total, np.divide(signal[..., 1], total, out=np.zeros_like(total), where=total > 0.0)

    def _incident(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        light = add_ambient(self.view, exposures, self.ambient)
        beyond = light.pop(BEYOND_ENDS, None)
        passing = apply_mask(self.mask, self.view, light)
        if beyond is not None:
            # A mask stops light beyond an end as it stops uniform light in the bin at the end.
            spread = Exposure(beyond.power, np.zeros_like(beyond.power))
            power = apply_mask(self.mask, self.view, {BEYOND_ENDS: spread})[BEYOND_ENDS].power
            share = np.divide(power, beyond.power, out=np.zeros_like(power), where=beyond.power > 0.0)
            passing[BEYOND_ENDS] = Exposure(power, share * beyond.moment)
        return passing

    def _in_order(self, light: Exposure) -> Exposure:
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return Exposure(light.power[..., ::step, :], light.moment[..., ::step, :])

    # ---- from light to currents ----------------------------------------------------------------------------

    def _with_shot_noise(
        self, light: Exposure, total: Float64, centroid: Float64, noise: Float64
    ) -> tuple[Float64, Float64]:
        """Return total and centroid of the photocurrent with shot noise.

        The number of electrons and the mean of their positions both fluctuate. Ambient light adds to both variances
        even where demodulation removes its mean.
        """
        model = self.readout.noise or PsdNoise()
        bandwidth, edges = model.bandwidth, self.view.u_edges
        # Electrons without light behind the mask, uniform over the strip.
        uniform = model.background + model.dark_current
        from_middle = centroid - 0.5 * (edges[0] + edges[-1])
        about = self.responsivity * _second_moment(light, edges, centroid)
        about += uniform * ((edges[-1] - edges[0]) ** 2 / 12.0 + from_middle**2)
        variance = 2.0 * ELECTRON * bandwidth * (self.responsivity * light.total() + uniform)
        spread = np.sqrt(2.0 * ELECTRON * bandwidth * about)
        noisy = total + np.sqrt(variance) * noise[..., 0, :]
        with np.errstate(invalid="ignore", divide="ignore"):
            shift = np.where(total > 0.0, spread * noise[..., 1, :] / total, 0.0)
        return noisy, centroid + shift

    def _ambient_variance(self, exposures: Mapping[str, Exposure]) -> Float64:
        """Return the variance of u by ambient light, beyond the variance that the readout predicts, (..., strips).

        Every electron moves the reading by its distance from it, over the number of detected electrons. Ambient light
        that is not demodulated pulls the reading away from the spot, whose electrons then move it by more than the
        width of the spot; and it adds to the total, to which the readout attributes the width of the spot.
        """
        ambient = self._incident(exposures).get(AMBIENT)
        if ambient is None:
            return np.zeros(())
        model, axes = self.readout.noise or PsdNoise(), self.readout.axes
        light = self.detected_light(exposures)
        signal = self.signal(total_exposure({name: each for name, each in light.items() if name != AMBIENT}))
        total, reading = self._total_and_centroid(self.signal(total_exposure(light)))
        spot_total, spot = self._total_and_centroid(signal)
        about = self.responsivity * _second_moment(self._in_order(ambient), self.view.u_edges, reading)
        about += spot_total * (spot - reading) ** 2 - (total - spot_total) * (axes.position_pitch * model.spot) ** 2
        shot = 2.0 * ELECTRON * model.bandwidth
        return np.divide(shot * about, total**2, out=np.zeros_like(total), where=total > 0.0)

    def _divide(self, total: Float64, u: Float64) -> Float64:
        """Return the currents at the electrodes, (..., 2) [A], without dark level and gain."""
        readout = self.readout
        position = (u - readout.axes.position_origin) / readout.axes.position_pitch
        half = 0.5 * readout.strip_length
        if readout.linearity is not None:
            knots = np.linspace(-half, half, len(readout.linearity[0]))
            for strip, corrections in enumerate(readout.linearity):
                # The readout maps a knot to knot + correction; light at knot + correction is thus read at the knot.
                position[..., strip] = np.interp(position[..., strip], knots + np.array(corrections), knots)
        balance = position / half
        if readout.interelectrode_resistance:
            balance /= 1.0 + 2.0 * readout.load_resistance / readout.interelectrode_resistance
        return 0.5 * total[..., None] * np.stack([1.0 - balance, 1.0 + balance], axis=-1)

    def _record(self, pair: Float64) -> Float64:
        """Return currents with gain, dark level and saturation, in units of `readout.ampere`."""
        readout = self.readout
        raw: Float64 = pair * (1.0, readout.right_gain) + readout.dark
        if readout.saturation is not None:
            raw = np.minimum(raw, readout.saturation)
        return raw / readout.ampere


def _second_moment(light: Exposure, edges: Float64, position: Float64) -> Float64:
    """Return the sum of power times squared distance from a position, (..., samples).

    The light of a bin is assumed uniform over the widest interval of the bin that is centred on its centroid.
    """
    middle, half = 0.5 * (edges[1:] + edges[:-1]), 0.5 * np.diff(edges)
    with np.errstate(invalid="ignore", divide="ignore"):
        centre = np.where(light.power > 0.0, light.moment / light.power, 0.0)
    reach = half - np.minimum(np.abs(centre), half)
    square = (middle + centre - position[..., None]) ** 2 + reach**2 / 3.0
    return np.asarray(np.sum(light.power * square, axis=-1))
