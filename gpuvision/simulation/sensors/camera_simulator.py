"""Camera columns under simulated light: frames with their noise, and what is read.

Takes the same light as `gpuvision.simulation.sensors.psd_simulator`; a bin along u is a pixel.
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
from gpuvision.simulation.sensors.masks import Mask, light_behind
from gpuvision.simulation.sensors.readings import (
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
_SAME = 1e-6  # pixel
_MOST_ELECTRONS = 1e15


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraSimulator:
    """A camera beside a sheet of light: every sample of its view is a profile of the frame, every bin a pixel.

    Parameters
    ----------
    view
        Its bins along u are the pixels of a profile.
    readout
        How the line is read. Without a triangulation it takes the view's.
    exposure_time
        [s].
    responsivity
        Of the pixels [A/W]: electrons are charge over the electron's.
    gain
        Grey levels per electron.
    offset
        Grey levels without light.
    read_noise
        Standard deviation of a pixel without light [electrons].
    full_well
        Electrons that a pixel holds; infinite: only the highest code limits it.
    bits
        Of a grey level; frames of more than 8 are uint16.
    ambient
        Other light on every profile, even along it [W].
    mask
        In front of the pixels: a region of interest that follows the line, or glass.

    Raises
    ------
    ValueError
        A number is out of its range, or the view is not one of the readout's pixels.
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

    def __post_init__(self) -> None:
        check_not_negative(self, "exposure_time", "responsivity", "gain", "offset", "read_noise", "ambient")
        if not self.full_well > 0.0 or self.gain == 0.0:
            raise ValueError("CameraSimulator.full_well and gain: expected numbers > 0")
        if self.bits not in (8, 10, 12, 14, 16):
            raise ValueError(f"CameraSimulator.bits is {self.bits}, expected 8, 10, 12, 14 or 16")
        given = self.readout
        readout = replace(
            given,
            triangulation=given.triangulation or self.view.triangulation,
            saturation=self._highest if given.saturation is None else given.saturation,
            outputs=None,
        )
        object.__setattr__(self, "readout", readout)
        axes = readout.axes
        pixels = axes.position_origin + axes.position_pitch * (np.arange(self.view.bins + 1) - 0.5)
        if np.any(np.abs(self.view.u_edges - np.sort(pixels)) > _SAME * abs(axes.position_pitch)):
            raise ValueError(
                f"CameraSimulator: the view's bins are {self.view.u_edges[0]:g} ... {self.view.u_edges[-1]:g}, the "
                f"readout's pixels {pixels[0]:g} ... {pixels[-1]:g}; expected a bin for every pixel"
            )
        check_samples(self.view, axes.sample_origin, axes.sample_pitch)

    @property
    def _highest(self) -> float:
        return min(float(2**self.bits - 1), self.offset + self.gain * self.full_well)

    def light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light behind the mask by path, ambient light among it."""
        return light_behind(self.mask, self.view, with_ambient(self.view, exposures, self.ambient))

    def electrons(self, exposures: Mapping[str, Exposure]) -> Float64:
        """Return how many electrons are expected in every pixel, (..., samples, bins), however many it holds."""
        power = lit_by(self.light(exposures)).power
        return np.asarray(power * (self.responsivity * self.exposure_time / ELECTRON))

    def frames(self, exposures: Mapping[str, Exposure], *, seed: int | None = None, first: int = 0) -> npt.NDArray[Any]:
        """Return frames as the readout takes them, (..., rows, columns).

        Parameters
        ----------
        exposures
            Light by path, as it comes from the lens.
        seed
            Of the noise of photons and electronics: codes of uint8 or uint16. None: what is expected, float32.
        first
            Number of the block's first profile.
        """
        if seed is None:
            return self._expected(self.signal(lit_by(self.light(exposures))))
        return self._noisy(self.electrons(exposures), seed, first)

    def signal(self, light: Exposure) -> npt.NDArray[np.float32]:
        """Return what light behind the mask adds to the grey levels, float32 as the readout takes frames."""
        levels = self.gain * self.responsivity * self.exposure_time / ELECTRON
        return self._as_frames((levels * light.power).astype(np.float32))

    def heights(self, signal: npt.NDArray[np.float32], device: Device | None = None) -> Float64:
        """Read a signal without noise: heights [m], (..., samples), in the view's order."""
        said = replace(self.readout, outputs=("h",))(self._expected(signal), device=device)
        step = -1 if self.readout.axes.sample_pitch < 0.0 else 1
        return np.asarray(said.h, np.float64)[..., ::step]

    def read(
        self,
        exposures: Mapping[str, Exposure],
        *,
        seed: int | None = None,
        first: int = 0,
        device: Device | None = None,
    ) -> Reading:
        """Read a block of profiles: `frames`, then the readout on a device.

        Sigma is that of a centre of gravity over the readout's window about the reading (over all light, for method
        "centroid"), of photon, read and rounding noise, where the threshold lies below the noise of dark pixels or far
        above it; other methods' differ from it. Without a seed the frames are those without noise. Samples are in the
        view's order.
        """
        light = lit_by(self.light(exposures))
        electrons = light.power * (self.responsivity * self.exposure_time / ELECTRON)
        frames = self._expected(self.signal(light)) if seed is None else self._noisy(electrons, seed, first)
        said = self.readout(frames, device=device)
        axes = self.readout.axes
        position = np.asarray(said.position, np.float64)
        u = axes.position_origin + axes.position_pitch * position
        sigma = abs(axes.position_pitch) * self._sigma(self._in_order(electrons), position)
        return reading_of(self.view, said, u, sigma, backward=axes.sample_pitch < 0.0)

    def _expected(self, signal: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        return np.asarray(np.minimum(signal + np.float32(self.offset), np.float32(self._highest)))

    def _noisy(self, electrons: Float64, seed: int, first: int) -> npt.NDArray[Any]:
        flat = electrons.reshape(-1, *electrons.shape[-2:])
        codes = np.empty(flat.shape, np.uint8 if self.bits == 8 else np.uint16)
        for each, generator in enumerate(profile_generators(seed, first, electrons.shape[:-2])):
            # More than any well holds is no Poisson number that can be drawn.
            held = np.minimum(generator.poisson(np.clip(flat[each], 0.0, _MOST_ELECTRONS)), self.full_well)
            grey = self.offset + self.gain * (held + self.read_noise * generator.standard_normal(held.shape))
            codes[each] = np.clip(np.rint(grey), 0.0, 2.0**self.bits - 1.0)
        return self._as_frames(codes.reshape(electrons.shape))

    def _in_order(self, profiles: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return (..., samples, bins) with samples and bins as the readout counts them."""
        axes = self.readout.axes
        return profiles[..., :: -1 if axes.sample_pitch < 0.0 else 1, :: -1 if axes.position_pitch < 0.0 else 1]

    def _as_frames(self, profiles: npt.NDArray[Any]) -> npt.NDArray[Any]:
        profiles = self._in_order(profiles)
        turned = profiles if self.readout.along == "rows" else profiles.swapaxes(-1, -2)
        return np.ascontiguousarray(turned)

    def _sigma(self, electrons: Float64, position: Float64) -> Float64:
        """Return the standard deviation of a centre of gravity about positions [pixel]."""
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
        # Samples that the threshold takes away have no say.
        variance = np.where(signal > 0.0, held + self.read_noise**2 + 1.0 / 12.0 / self.gain**2, 0.0)
        weighed = np.sum(variance * (at - middle[..., None]) ** 2, axis=-1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(known, np.sqrt(weighed) / np.sum(signal, axis=-1), np.nan)
