"""CMOS image sensor by the linear model of EMVA 1288: photons, electrons, noise, grey levels and frame times."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.photons import photons_per_joule
from gpuvision.camera.sensor_readout import FrameTiming, SensorReadout
from gpuvision.validation import finite, integer

Float64 = npt.NDArray[np.float64]
Pixel = Literal["integrating", "direct_read"]

_POSITIVE = ("pitch", "wavelength", "gain", "full_well")
_NOT_NEGATIVE = ("dark_noise", "dark_level", "dsnu", "prnu", "dark_current", "response_time")


@dataclass(frozen=True, kw_only=True)
class CmosSensor:
    """CMOS image sensor.

    Parameters
    ----------
    rows, columns : int
        Size of the pixel array. Range: 1 or more.
    pitch : float
        Distance between pixels [m], above 0.
    quantum_efficiency : float
        Electrons per photon on the pixel's area, above 0 to 1; as in EMVA 1288 it includes the part of the area that
        collects no light.
    gain : float
        Overall system gain K [grey levels per electron], above 0.
    dark_noise : float
        Standard deviation of a pixel's value without light [e-], without quantisation.
    full_well : float
        Electrons that a pixel holds, above 0.
    bits : int
        Bits of the converter, 1 to 16.
    wavelength : float
        Wavelength of the light, and of the quantum efficiency [m], default 550 nm.
    dark_level : float
        Grey level without light and without dark current, default 0.
    dsnu : float
        Dark signal non-uniformity: standard deviation over the pixels of the dark value [e-], default 0.
    prnu : float
        Photo response non-uniformity: relative standard deviation over the pixels of the gain, default 0.
    dark_current : float
        Mean dark signal [e-/s], default 0.
    nonlinearity : float
        Relative loss of signal at the full well, 0 to below 0.5: n electrons read n (1 - nonlinearity n / full_well).
        Default 0.
    collecting : float
        Part of the area pitch x pitch from which light reaches a pixel, above 0 to 1, default 1; `skipping` lowers it.
    pixel : {"integrating", "direct_read"}
        "integrating": the pixel collects charge during the exposure. "direct_read": the photocurrent is read when the
        pixel is addressed; the "exposure" is the response time, and pixels are read one row after the other.
    response_time : float
        Time over which a direct-read pixel averages its photocurrent [s], above 0 for "direct_read", otherwise 0.
        Default 0.0.
    readout : SensorReadout
        Taps, pixel clock and shutter. Default: one tap of 40 MHz with a global shutter.
    name : str
        Name of the sensor.
    estimated : tuple of str
        Names of the parameters that are not from a datasheet.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range.

    Notes
    -----
    Model of EMVA 1288 for n = electrons photoelectrons and d = dark_current x exposure dark electrons: the mean grey
    level is dark_level + K (n + d), its temporal variance K^2 (dark_noise^2 + n + d) + 1/12, and its variance over the
    pixels K^2 (dsnu^2 + prnu^2 n^2).

    References
    ----------
    .. [1] EMVA Standard 1288, Standard for characterization of image sensors and cameras, release 4.0 (linear).
    .. [2] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, chapter 7.

    Examples
    --------
    >>> import gpuvision as gv
    >>> sensor = gv.CmosSensor(rows=1024, columns=1024, pitch=10e-6, quantum_efficiency=0.5, gain=0.1, dark_noise=10.0,
    ...     full_well=20e3, bits=10)
    >>> electrons = sensor.electrons(0.1, 1e-3)  # 0.1 W/m^2 on the sensor during 1 ms
    >>> f"{electrons:.0f} e-, SNR {sensor.snr(electrons):.0f}"
    '13844 e-, SNR 117'
    """

    rows: int
    columns: int
    pitch: float
    quantum_efficiency: float
    gain: float
    dark_noise: float
    full_well: float
    bits: int
    wavelength: float = 550e-9
    dark_level: float = 0.0
    dsnu: float = 0.0
    prnu: float = 0.0
    dark_current: float = 0.0
    nonlinearity: float = 0.0
    collecting: float = 1.0
    pixel: Pixel = "integrating"
    response_time: float = 0.0
    readout: SensorReadout = field(default_factory=lambda: SensorReadout(pixel_clock=40e6))
    name: str = ""
    estimated: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("rows", "columns"):
            integer(getattr(self, name), f"CmosSensor.{name}", minimum=1)
        integer(self.bits, "CmosSensor.bits", minimum=1, maximum=16)
        for name in _POSITIVE:
            finite(getattr(self, name), f"CmosSensor.{name}", above=0.0)
        for name in _NOT_NEGATIVE:
            finite(getattr(self, name), f"CmosSensor.{name}", minimum=0.0)
        for name in ("quantum_efficiency", "collecting"):
            finite(getattr(self, name), f"CmosSensor.{name}", above=0.0, maximum=1.0)
        if not 0.0 <= finite(self.nonlinearity, "CmosSensor.nonlinearity") < 0.5:
            raise ValueError(f"CmosSensor.nonlinearity is {self.nonlinearity}, expected 0 to below 0.5")
        if self.dark_level >= self.max_level:
            raise ValueError(f"CmosSensor.dark_level is {self.dark_level}, expected less than {self.max_level}")
        if self.pixel not in ("integrating", "direct_read"):
            raise ValueError(f"CmosSensor.pixel is {self.pixel!r}, expected 'integrating' or 'direct_read'")
        if (self.pixel == "direct_read") != (self.response_time > 0.0):
            raise ValueError(
                "CmosSensor.response_time is the time of a direct-read pixel; of an integrating one it is 0"
            )
        names = {each.name for each in dataclasses.fields(self)}
        unknown = [each for each in self.estimated if each not in names]
        if unknown:
            raise ValueError(f"CmosSensor.estimated names {unknown[0]!r}, which is no parameter")

    @property
    def max_level(self) -> int:
        """Largest grey level, 2^bits - 1."""
        return int((1 << self.bits) - 1)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.rows, self.columns

    @property
    def saturation(self) -> float:
        """Photoelectrons at which a pixel saturates: its full well, or the largest grey level."""
        wanted = (self.max_level - self.dark_level) / self.gain
        if wanted >= self.full_well * (1.0 - self.nonlinearity):
            return float(self.full_well)
        # Smaller root of n - (nonlinearity / full_well) n^2 = wanted, without cancellation.
        bend = self.nonlinearity / self.full_well
        return 2.0 * wanted / (1.0 + math.sqrt(1.0 - 4.0 * bend * wanted))

    @property
    def read_noise(self) -> float:
        """Dark noise and quantisation together [e-]: sqrt(dark_noise^2 + 1 / (12 K^2))."""
        return float(np.hypot(self.dark_noise, 1.0 / (np.sqrt(12.0) * self.gain)))

    def exposure_time(self, exposure: float) -> float:
        """Return the time during which a pixel collects light [s]: the exposure, or a direct-read pixel's response."""
        given = finite(exposure, "exposure [s]", minimum=0.0)
        return self.response_time if self.pixel == "direct_read" else given

    def photons(self, irradiance: npt.ArrayLike, exposure: float) -> Float64:
        """Return the mean number of photons on a pixel.

        Parameters
        ----------
        irradiance : array_like
            (...) irradiance on the sensor [W/m^2]; see `gpuvision.camera.photons` for lux and the light of a lens.
        exposure : float
            Exposure time [s].
        """
        area = self.pitch**2 * self.collecting
        energy = np.asarray(irradiance, np.float64) * (area * self.exposure_time(exposure))
        return np.asarray(energy * photons_per_joule(self.wavelength))

    def electrons(self, irradiance: npt.ArrayLike, exposure: float) -> Float64:
        """Return the mean number of photoelectrons (...) of a pixel, without saturation; parameters as `photons`."""
        return np.asarray(self.quantum_efficiency * self.photons(irradiance, exposure))

    def level(self, electrons: npt.ArrayLike, exposure: float = 0.0) -> Float64:
        """Return the mean grey level (...) of photoelectrons (...), with dark current, non-linearity and saturation."""
        collected = np.asarray(electrons, np.float64) + self.dark_current * self.exposure_time(exposure)
        held = np.minimum(collected, self.full_well)
        read = held * (1.0 - self.nonlinearity * held / self.full_well)
        return np.asarray(np.minimum(self.dark_level + self.gain * read, self.max_level))

    def noise(self, electrons: npt.ArrayLike, exposure: float = 0.0, *, spatial: bool = True) -> Float64:
        """Return the standard deviation of a pixel [e-], relative to its photoelectrons.

        Parameters
        ----------
        electrons : array_like
            (...) mean photoelectrons.
        exposure : float
            Exposure time [s], for the dark current; default 0.
        spatial : bool
            Whether the differences between pixels count: True (default) for one image of an unknown place of the
            sensor, False for the changes from frame to frame.
        """
        signal = np.asarray(electrons, np.float64)
        slope = self._slope(signal)
        fixed = self.read_noise**2 + (self.dsnu**2 if spatial else 0.0)
        variance = signal + self.dark_current * self.exposure_time(exposure) + fixed / slope**2
        return np.asarray(np.sqrt(variance + (self.prnu * signal) ** 2 if spatial else variance))

    def snr(self, electrons: npt.ArrayLike, exposure: float = 0.0, *, spatial: bool = True) -> Float64:
        """Return the signal-to-noise ratio (...) of photoelectrons (...); parameters as `noise`."""
        return np.asarray(np.asarray(electrons, np.float64) / self.noise(electrons, exposure, spatial=spatial))

    def _slope(self, electrons: Float64) -> Float64:
        """Return the derivative of the read electrons by the collected ones."""
        return 1.0 - 2.0 * self.nonlinearity * np.minimum(electrons, self.full_well) / self.full_well

    def timing(
        self, shape: tuple[int, int] | None = None, exposure: float | None = None, *, flash: bool = False
    ) -> FrameTiming:
        """Return the times of a frame.

        Parameters
        ----------
        shape : pair of ints, optional
            Rows and columns of the region of interest; None: the whole sensor.
        exposure : float, optional
            Exposure time, or length of the flash [s]; None only for direct-read pixels.
        flash : bool
            Whether a flash is the only light, see `SensorReadout.timing`. Default False.

        Raises
        ------
        ValueError
            The region is larger than the sensor, or an integrating pixel has no exposure time.
        """
        shape = self.shape if shape is None else shape
        if shape[0] > self.rows or shape[1] > self.columns:
            raise ValueError(f"a region of {shape[0]} x {shape[1]} pixels, the sensor has {self.rows} x {self.columns}")
        if self.pixel == "direct_read":
            return dataclasses.replace(self.readout, shutter="rolling").timing(shape, self.response_time)
        if exposure is None:
            raise ValueError("CmosSensor.timing: give the exposure time of an integrating pixel")
        return self.readout.timing(shape, exposure, flash=flash)

    def frame_time(
        self, shape: tuple[int, int] | None = None, exposure: float | None = None, *, flash: bool = False
    ) -> float:
        """Return the least time from frame to frame [s]; parameters as `timing`."""
        return self.timing(shape, exposure, flash=flash).period

    def motion_blur(self, speed: float, exposure: float, pixel: float) -> float:
        """Return the length of the motion blur [px] at a speed [m/s] of an object with pixels of a size [m]."""
        return speed * self.exposure_time(exposure) / finite(pixel, "pixel [m]", above=0.0)

    def binned(self, factor: int) -> CmosSensor:
        """Return the sensor with coarse pixels: the charge of factor x factor pixels is added before it is read.

        Signal, dark current and full well grow by factor^2 and shot noise by the factor; a coarse pixel is read once.
        The differences between the pixels are independent.
        """
        n = integer(factor, "factor", minimum=1)
        return dataclasses.replace(
            self,
            rows=max(self.rows // n, 1),
            columns=max(self.columns // n, 1),
            pitch=self.pitch * n,
            full_well=self.full_well * n * n,
            dark_current=self.dark_current * n * n,
            dsnu=self.dsnu * n,
            prnu=self.prnu / n,
        )

    def skipping(self, factor: int) -> CmosSensor:
        """Return the sensor with coarse pixels of which only one of factor x factor pixels is read."""
        n = integer(factor, "factor", minimum=1)
        return dataclasses.replace(
            self,
            rows=max(self.rows // n, 1),
            columns=max(self.columns // n, 1),
            pitch=self.pitch * n,
            collecting=self.collecting / n**2,
        )
