"""Simulated cameras: frames with noise under simulated light, and the profiles read from them.

The input is the same light as for `gpuvision.simulation.sensors.psd_simulator`; a bin along u is a pixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import ELECTRON
from gpuvision.simulation.sensors.masks import Mask, apply_mask
from gpuvision.simulation.sensors.readings import (
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
# Largest mean for which Poisson numbers are drawn [electrons]; no well holds this number, and NumPy's limit is 9e18.
_MAX_ELECTRONS = 1e15


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraSimulator:
    """A camera that views a sheet of light: a sample of the view is a column (or row) of the frame, a bin is a pixel.

    Parameters
    ----------
    view : SensorView
        View of the camera; its bins along u are the pixels of a profile.
    readout : LineReadout
        Readout of the line. Without a triangulation it takes the triangulation of the view.
    exposure_time : float
        Exposure time [s], 0 or more. Default 1e-3.
    responsivity : float
        Responsivity of the pixels [A/W], 0 or more. The number of electrons is the charge over the elementary charge.
        Default 0.4.
    gain : float
        Conversion gain [grey levels per electron], > 0. Default 0.01.
    offset : float
        Grey level without light, 0 or more. Default 0.0.
    read_noise : float
        Standard deviation of a pixel without light [electrons], 0 or more. Default 0.0.
    full_well : float
        Capacity of a pixel [electrons], > 0. Infinite: only the number of bits limits the grey level.
    bits : {8, 10, 12, 14, 16}
        Bits of a grey level: 8, 10, 12, 14 or 16. Frames of more than 8 bits are uint16. Default 8.
    ambient : float
        Power of the ambient light on every profile, uniform along u [W], 0 or more. Default 0.0.
    mask : Mask, optional
        Mask before the pixels, for example a region of interest that follows the line.
    limits : AlignmentLimits
        Allowed differences between view and readout.

    Raises
    ------
    TypeError, ValueError
        A number is out of its range, or the bins of the view are not the pixels of the readout.
    """

    view: SensorView
    readout: LineReadout
    exposure_time: float = 1e-3
    responsivity: float = 0.4
    gain: float = 0.01
    offset: float = 0.0
    read_noise: float = 0.0
    full_well: float = np.inf
    bits: Literal[8, 10, 12, 14, 16] = 8
    ambient: float = 0.0
    mask: Mask | None = None
    limits: AlignmentLimits = _ALIGNMENT_LIMITS

    def __post_init__(self) -> None:
        check_not_negative(self, "exposure_time", "responsivity", "gain", "offset", "read_noise", "ambient")
        if not self.full_well > 0.0 or self.gain == 0.0:
            raise ValueError("CameraSimulator.full_well and gain: expected numbers > 0")
        if self.bits not in (8, 10, 12, 14, 16):
            raise ValueError(f"CameraSimulator.bits is {self.bits}, expected 8, 10, 12, 14 or 16")
        readout = self.readout
        readout = replace(
            readout,
            triangulation=readout.triangulation or self.view.triangulation,
            saturation=self._max_level if readout.saturation is None else readout.saturation,
            outputs=None,
        )
        object.__setattr__(self, "readout", readout)
        axes = readout.axes
        pixels = axes.position_origin + axes.position_pitch * (np.arange(self.view.bins + 1) - 0.5)
        if np.any(np.abs(self.view.u_edges - np.sort(pixels)) > self.limits.edge_tolerance * abs(axes.position_pitch)):
            raise ValueError(
                f"CameraSimulator: the view's bins are at {self.view.u_edges[0]:g} ... {self.view.u_edges[-1]:g}, the "
                f"readout's pixels at {pixels[0]:g} ... {pixels[-1]:g}; expected a bin for every pixel"
            )
        check_sample_axes(self.view, axes.sample_origin, axes.sample_pitch, self.limits)

    @property
    def _max_level(self) -> float:
        """Largest grey level: the smaller limit of the full well and the number of bits."""
        return min(float(2**self.bits - 1), self.offset + self.gain * self.full_well)

    def detected_light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light behind the mask by path, with the ambient light."""
        return apply_mask(self.mask, self.view, add_ambient(self.view, exposures, self.ambient))

    def electrons(self, exposures: Mapping[str, Exposure]) -> Float64:
        """Return the expected electrons of each pixel, not limited by the full well, (..., samples, bins)."""
        power = total_exposure(self.detected_light(exposures)).power
        return np.asarray(power * (self.responsivity * self.exposure_time / ELECTRON))

    def frames(
        self, exposures: Mapping[str, Exposure], *, seed: int | None = None, first_profile: int = 0
    ) -> npt.NDArray[Any]:
        """Return frames in the layout of the readout, (..., rows, columns).

        Parameters
        ----------
        exposures : mapping of str to Exposure
            Light by path behind the lens, before the mask, (..., samples, bins).
        seed : int, optional
            Seed of the noise, 0 or more: frames of uint8 or uint16 with photon, read and quantisation noise. None:
            expected grey levels, float32.
        first_profile : int
            Number of the first profile of the block. The noise of a profile depends on the seed and its number only.
            Default 0.
        """
        if seed is None:
            return self._expected(self.signal(total_exposure(self.detected_light(exposures))))
        return self._noisy(self.electrons(exposures), seed, first_profile)

    def signal(self, light: Exposure) -> npt.NDArray[np.float32]:
        """Return the grey levels that light behind the mask adds, float32 in the layout of the readout."""
        levels = self.gain * self.responsivity * self.exposure_time / ELECTRON
        return self._as_frames((levels * light.power).astype(np.float32))

    def heights(self, signal: npt.NDArray[np.float32], device: Device | None = None) -> Float64:
        """Read a signal without noise: heights [m], (..., samples), in the order of the view."""
        reading = replace(self.readout, outputs=("h",))(self._expected(signal), device=device)
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return np.asarray(reading.h, np.float64)[..., ::step]

    def read(
        self,
        exposures: Mapping[str, Exposure],
        *,
        seed: int | None = None,
        first_profile: int = 0,
        device: Device | None = None,
    ) -> Reading:
        """Simulate frames of a block of profiles and read them on a device.

        Parameters
        ----------
        exposures, seed, first_profile : mapping of str to Exposure, int or None, int
            As for `frames`.
        device : Device, optional
            Device of the readout; None: `Device.best`.

        Returns
        -------
        Reading
            (..., samples), in the order of the view.

        Notes
        -----
        Sigma is the standard deviation of a centroid over the readout's window about the reading (with the method
        "centroid": over the whole profile) under photon, read and quantisation noise. It holds for thresholds that are
        below the noise of dark pixels, or far above. The standard deviations of other methods differ from it.
        """
        light = total_exposure(self.detected_light(exposures))
        electrons = light.power * (self.responsivity * self.exposure_time / ELECTRON)
        frames = self._expected(self.signal(light)) if seed is None else self._noisy(electrons, seed, first_profile)
        reading = self.readout(frames, device=device)
        axes = self.readout.axes
        position = np.asarray(reading.position, np.float64)
        u = axes.position_origin + axes.position_pitch * position
        sigma = abs(axes.position_pitch) * self._sigma(self._in_order(electrons), position)
        return make_reading(self.view, reading, u, sigma, backward=axes.sample_pitch < 0.0)

    def _expected(self, signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        return np.asarray(np.minimum(signal + np.float32(self.offset), np.float32(self._max_level)))

    def _noisy(self, electrons: Float64, seed: int, first_profile: int) -> npt.NDArray[Any]:
        flat = electrons.reshape(-1, *electrons.shape[-2:])
        codes = np.empty(flat.shape, np.uint8 if self.bits == 8 else np.uint16)
        for each, generator in enumerate(profile_generators(seed, first_profile, electrons.shape[:-2])):
            # Clipped: NumPy cannot draw Poisson numbers of arbitrarily large mean.
            held = np.minimum(generator.poisson(np.clip(flat[each], 0.0, _MAX_ELECTRONS)), self.full_well)
            grey = self.offset + self.gain * (held + self.read_noise * generator.standard_normal(held.shape))
            codes[each] = np.clip(np.rint(grey), 0.0, 2.0**self.bits - 1.0)
        return self._as_frames(codes.reshape(electrons.shape))

    def _in_order(self, profiles: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (..., samples, bins) with samples and bins in the order of the readout."""
        axes = self.readout.axes
        return profiles[..., :: -1 if axes.sample_pitch < 0.0 else 1, :: -1 if axes.position_pitch < 0.0 else 1]

    def _as_frames(self, profiles: npt.NDArray[Any]) -> npt.NDArray[Any]:
        profiles = self._in_order(profiles)
        turned = profiles if self.readout.along == "rows" else profiles.swapaxes(-1, -2)
        return np.ascontiguousarray(turned)

    def _sigma(self, electrons: Float64, position: Float64) -> Float64:
        """Return the standard deviation of a centroid about positions [pixel]."""
        known = np.isfinite(position)
        middle = np.where(known, position, 0.0)
        if self.readout.method == "centroid":
            at = np.broadcast_to(np.arange(self.view.bins), electrons.shape)
            inside = np.ones(electrons.shape, bool)
        else:
            reach = np.arange(-self.readout.window, self.readout.window + 1)
            at = np.rint(middle)[..., None].astype(np.intp) + reach
            inside = (at >= 0) & (at < self.view.bins)
            electrons = np.take_along_axis(electrons, np.clip(at, 0, self.view.bins - 1), axis=-1)
        held = np.minimum(electrons, self.full_well)
        signal = np.where(inside, np.maximum(held + (self.offset - self.readout.threshold) / self.gain, 0.0), 0.0)
        # Pixels below the threshold have weight 0.
        variance = np.where(signal > 0.0, held + self.read_noise**2 + 1.0 / 12.0 / self.gain**2, 0.0)
        weighted = np.sum(variance * (at - middle[..., None]) ** 2, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(known, np.sqrt(weighted) / np.sum(signal, axis=-1), np.nan)
