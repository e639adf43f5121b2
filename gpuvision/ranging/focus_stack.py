"""Depth from focus with a stack of images: the frame in which each pixel is sharpest gives its distance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import numpy.typing as npt
import scipy.ndimage

from gpuvision.ranging.focus import DepthFromFocus, conjugate_distance
from gpuvision.ranging.focus_noise import BEND, laplacian_variance
from gpuvision.ranging.range_image import Limits, RangePoints
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.status import Status
from gpuvision.validation import finite, integer

Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]
Measure = Literal["laplacian", "intensity"]
MEASURES: tuple[Measure, ...] = get_args(Measure)

# Two maxima are distinct if the measure between them falls below this fraction of the smaller one. Chosen: 0.5 (half
# height), so that noise on the flank of a peak is not a second maximum.
_VALLEY = 0.5
# Largest standard deviation of the sharpest frame by the noise of a Laplacian that is stated [frames]. Measured: the
# scatter is 0.91 to 1.05 of the prediction below it, and 1.1 to 1.6 above it, where the fit is no longer linear.
_MOST_SIGMA = 0.1
_BLOCK_PIXELS = 1 << 18  # fitted at a time; bounds the memory of the fit to some 50 MB


@dataclass(frozen=True, kw_only=True)
class LensFocus:
    """Focus by the image distance: frame k is taken at the image distance ``first + k spacing`` behind a thin lens.

    The object distance is ``LO = f LI / (LI - f)`` (eq. 2.1), the height ``stand_off - LO``. A pixel at the distance p
    from the principal point lies ``p pixel_pitch LO / LI`` from the optical axis.

    Parameters
    ----------
    focal_length : float
        Focal length f [m].
    first, spacing : float
        Image distance of frame 0, beyond f, and its change per frame [m].
    pixel_pitch : float
        Distance between pixels on the sensor [m].
    stand_off : float
        Distance from the lens to height 0 [m].

    Raises
    ------
    ValueError
        A number is out of its range.
    """

    focal_length: float
    first: float
    spacing: float
    pixel_pitch: float
    stand_off: float

    def __post_init__(self) -> None:
        for name in ("focal_length", "first", "spacing", "pixel_pitch", "stand_off"):
            if not finite(getattr(self, name), f"LensFocus.{name}") > 0.0:
                raise ValueError(f"LensFocus.{name} is {getattr(self, name)}, expected a positive length [m]")
        if not self.first > self.focal_length:
            raise ValueError(
                f"LensFocus.first is {self.first} m, expected beyond the focal length, {self.focal_length} m"
            )

    def locate(self, frame: Float64) -> tuple[Float64, Float64]:
        """Return the height [m] and the size of a pixel on the object [m] for frame numbers of sharpest focus."""
        image = self.first + self.spacing * frame
        distance = conjugate_distance(image, self.focal_length)
        return self.stand_off - distance, self.pixel_pitch * distance / image


@dataclass(frozen=True, kw_only=True)
class StageFocus:
    """Focus by a stage: frame k is focused on the height ``start + k step``.

    Parameters
    ----------
    start, step : float
        Height of the plane in focus in frame 0, and its change per frame, not 0 [m].
    pixel_size : float
        Distance between pixels on the plane in focus [m].

    Raises
    ------
    ValueError
        A number is out of its range.
    """

    start: float
    step: float
    pixel_size: float

    def __post_init__(self) -> None:
        finite(self.start, "StageFocus.start")
        if finite(self.step, "StageFocus.step") == 0.0:
            raise ValueError("StageFocus.step is 0, expected metres per frame")
        if not finite(self.pixel_size, "StageFocus.pixel_size") > 0.0:
            raise ValueError(f"StageFocus.pixel_size is {self.pixel_size}, expected a positive length [m]")

    def locate(self, frame: Float64) -> tuple[Float64, Float64]:
        """Return the height [m] and the size of a pixel on the object [m] for frame numbers of sharpest focus."""
        return self.start + self.step * frame, np.full_like(frame, self.pixel_size)


class FocusPeak(NamedTuple):
    """Sharpest focus of each pixel, arrays (rows, columns).

    Attributes
    ----------
    frame
        Frame number of the sharpest focus, with a fraction; NaN where the status has a flag other than SATURATED and
        AMBIGUOUS.
    strength
        Largest focus measure [grey levels].
    status
        uint8 `Status` flags: LOW_SIGNAL (the measure is never above the threshold), SATURATED (the sharpest frame is
        at the upper limit), OUT_OF_RANGE (sharpest before the first or after the last frame), AMBIGUOUS (another
        maximum of nearly the same strength, or no maximum at all), NOT_FINITE.
    sigma
        Standard deviation of ``frame`` by the noise of the stack; None if the stack gives no noise. With the measure
        "laplacian" it is NaN where it would exceed 0.1 frames, since it is too small there by up to 1.6 (a factor that
        depends on the texture), and in the ``window + 1`` outermost rows and columns. `gpuvision.merge_height_maps`
        leaves out heights without a finite standard deviation.
    """

    frame: Float64
    strength: Float32
    status: npt.NDArray[np.uint8]
    sigma: Float64 | None = None


@dataclass(frozen=True, kw_only=True)
class FocusStack:
    """Depth from focus of an image stack.

    Parameters
    ----------
    geometry : LensFocus or StageFocus
        Focus distance of each frame.
    measure : {"laplacian", "intensity"}
        Focus measure: ``"laplacian"``, the default, is the mean of the modified Laplacian ``|2 I - I_left - I_right| +
        |2 I - I_up - I_down|`` over the window and suits a textured surface; ``"intensity"`` is the grey level itself,
        for points of light behind pinholes (confocal), as in section 2.3.4 of the thesis.
    window : int
        Half size of the window of the Laplacian [px], default 2: 5 x 5 pixels. 0 is one pixel. Range: 0 or more.
    neighbours : int
        Frames before and after the sharpest one to which the Gaussian is fitted, default 1: three frames. Range: 1 or
        more.
    threshold : float
        Smallest focus measure of a valid pixel [grey levels; mean over the window], default 0.
    ambiguity : float, optional
        Second maximum, relative to the largest one, from which on a pixel is AMBIGUOUS, above 0, at most 1. Between two
        maxima the measure falls below half of the smaller one. Default: not checked.
    saturation : float, optional
        Level at which a pixel is saturated [grey levels]; default: the largest code of integer frames.
    principal_point_px : (column, row), optional
        Image of the optical axis [px]; default: the middle of the frame.
    read_noise : float, optional
        Standard deviation of a pixel without quantisation [grey levels], above 0; requests the standard deviations of
        the heights. Default: not known.
    gain : float
        Grey levels per electron, for shot noise: the variance of a pixel is ``read_noise**2 + gain * level``, plus 1/12
        for integer frames. 0, the default: no shot noise. Only with ``read_noise``. Range: 0 or more.

    Raises
    ------
    ValueError
        A parameter is out of its range.

    Notes
    -----
    The measure of a pixel is a Gaussian of the frame number in a first approximation; the parabola through its
    logarithms (`DepthFromFocus`) finds the peak. The arithmetic runs in NumPy and SciPy on the host, frame by frame:
    the memory does not grow with the number of frames.

    Standard deviation: the noise of the measures in the fitted frames, which err independently, propagated to the peak
    to first order. An intensity has the noise of a pixel. The noise of a Laplacian depends on the texture
    (`gpuvision.ranging.focus_noise.laplacian_variance`): computing it takes some 0.3 s per megapixel and frame, nearly
    twenty times the time of the measure. The measures of pixels less than ``2 window + 3`` apart share
    noise. The standard deviation does not contain the error by the texture itself: the measure is no exact Gaussian of
    the frame number.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3.4.

    S. K. Nayar, Y. Nakagawa, *Shape from focus*, IEEE PAMI 16 (1994) 824-831: the modified Laplacian and the Gaussian
    interpolation.
    """

    geometry: LensFocus | StageFocus
    measure: Measure = "laplacian"
    window: int = 2
    neighbours: int = 1
    threshold: float = 0.0
    ambiguity: float | None = None
    saturation: float | None = None
    principal_point_px: tuple[float, float] | None = None
    read_noise: float | None = None
    gain: float = 0.0

    def __post_init__(self) -> None:
        if self.measure not in MEASURES:
            raise ValueError(f"FocusStack.measure is {self.measure!r}, expected one of {', '.join(MEASURES)}")
        integer(self.window, "FocusStack.window", minimum=0)
        integer(self.neighbours, "FocusStack.neighbours", minimum=1)
        if not finite(self.threshold, "FocusStack.threshold") >= 0.0:
            raise ValueError(f"FocusStack.threshold is {self.threshold}, expected 0 or more [grey levels]")
        if self.ambiguity is not None and not 0.0 < self.ambiguity <= 1.0:
            raise ValueError(f"FocusStack.ambiguity is {self.ambiguity}, expected a number above 0 and at most 1")
        if self.read_noise is not None and not finite(self.read_noise, "FocusStack.read_noise") > 0.0:
            raise ValueError(f"FocusStack.read_noise is {self.read_noise}, expected a number above 0 [grey levels]")
        if finite(self.gain, "FocusStack.gain", minimum=0.0) > 0.0 and self.read_noise is None:
            raise ValueError("FocusStack.gain is given without read_noise, which the noise of a pixel needs too")

    def sharpness(self, frame: npt.NDArray[Any]) -> Float32:
        """Compute the focus measure of each pixel of a frame, (rows, columns) [grey levels]."""
        image = frame.astype(np.float32)
        if self.measure == "intensity":
            return image
        bends = [np.abs(scipy.ndimage.correlate1d(image, BEND, axis, mode="nearest")) for axis in (0, 1)]
        total: Float32 = scipy.ndimage.uniform_filter(bends[0] + bends[1], 2 * self.window + 1, mode="nearest")
        return total

    def noise(self, frame: npt.NDArray[Any]) -> Float32:
        """Compute the standard deviation of the focus measure of each pixel of a frame, (rows, columns) [grey levels].

        NaN in the ``window + 1`` outermost rows and columns for the measure "laplacian".

        Raises
        ------
        ValueError
            ``read_noise`` is not known.
        """
        if self.read_noise is None:
            raise ValueError("FocusStack.read_noise is None, expected the standard deviation of a pixel [grey levels]")
        quantisation = 1.0 / math.sqrt(12.0) if np.issubdtype(frame.dtype, np.integer) else 0.0
        pixel: float | Float64 = math.hypot(self.read_noise, quantisation)
        if self.gain > 0.0:
            # The level with its noise: unbiased, and the measure averages over the window.
            pixel = np.sqrt(pixel**2 + self.gain * np.maximum(frame.astype(np.float64), 0.0))
        if self.measure == "intensity":
            return np.broadcast_to(pixel, frame.shape).astype(np.float32)
        return np.sqrt(laplacian_variance(frame, pixel, self.window)).astype(np.float32)

    def points(
        self, peak: FocusPeak, transport: StraightTransport, limits: Limits, dtype: npt.DTypeLike = np.float32
    ) -> RangePoints:
        """Compute the points of the pixels.

        Parameters
        ----------
        peak : FocusPeak
        transport : StraightTransport
            Directions in the scene: of the columns (``g_axis``), of the height (``h_axis``) and of the rows
            (``direction``), and the origin, which is on the optical axis at height 0.
        limits : ((low, high), (low, high), (low, high))
            Limits of x, y and z [m]; points outside are OUT_OF_RANGE.
        dtype : dtype
            Type of the coordinates, default float32.

        Returns
        -------
        RangePoints
            Arrays (rows, columns).
        """
        rows, columns = peak.frame.shape
        column, row = self.principal_point_px or (0.5 * (columns - 1), 0.5 * (rows - 1))
        height, size = self.geometry.locate(peak.frame)
        across, down = size * (np.arange(columns) - column), size * (np.arange(rows) - row)[:, None]
        axes = (transport.origin, transport.g_axis, transport.h_axis, transport.direction)
        place = np.stack([o + g * across + h * height + d * down for o, g, h, d in zip(*axes, strict=True)])
        bounds = np.array(limits)[:, :, None, None]
        outside = np.any((place < bounds[:, 0]) | (place > bounds[:, 1]), axis=0)
        place[:, outside] = np.nan
        x, y, z = place.astype(dtype)
        return RangePoints(x, y, z, peak.status | np.where(outside, np.uint8(Status.OUT_OF_RANGE), np.uint8(0)))


class FocusSearch:
    """Search for the sharpest frame of each pixel: call `add` for each frame, then `peak`.

    Holds the measures of the frames around the maximum of each pixel and of the last frames.

    Parameters
    ----------
    stack : FocusStack
    dtype : dtype
        Type of the frames.
    """

    def __init__(self, stack: FocusStack, dtype: np.dtype[Any]) -> None:
        self._stack = stack
        self._limit = stack.saturation
        if self._limit is None:
            self._limit = float(np.iinfo(dtype).max) if np.issubdtype(dtype, np.integer) else math.inf
        # Measures of the last frames, and under the same index their standard deviations.
        self._recent: list[tuple[Float32, ...]] = []
        self._count = 0

    @property
    def frames(self) -> int:
        """Number of frames so far."""
        return self._count

    def add(self, frame: npt.NDArray[Any]) -> None:
        """Add the next frame, (rows, columns)."""
        stack, size = self._stack, 2 * self._stack.neighbours + 1
        measure = stack.sharpness(frame)
        saturated = frame >= self._limit
        if not self._count:
            shape = frame.shape
            self._best, self._number = np.full(shape, -np.inf, np.float32), np.zeros(shape, np.int32)
            self._second = np.full(shape, -np.inf, np.float32)
            self._start = np.zeros(shape, np.int32)
            self._window = np.zeros((size, 1 if stack.read_noise is None else 2, *shape), np.float32)
            self._saturated, self._lost = np.zeros(shape, np.bool_), np.zeros(shape, np.bool_)
            self._valley = np.full(shape, np.inf, np.float32)  # smallest measure since the largest one
        self._lost |= ~np.isfinite(measure)
        values = (measure,) if stack.read_noise is None else (measure, stack.noise(frame))
        self._recent = [*self._recent[-(size - 1) :], values]
        other = ~(measure > self._best) & (self._valley < _VALLEY * measure)
        self._second[other] = np.maximum(self._second, measure)[other]
        better = measure > self._best
        apart = better & (self._valley < _VALLEY * self._best)
        self._second[apart] = np.maximum(self._second, self._best)[apart]
        self._valley = np.where(better, np.inf, np.minimum(self._valley, measure)).astype(np.float32)
        self._best[better], self._number[better] = measure[better], self._count
        self._saturated[better] = saturated[better]
        self._count += 1
        self._keep_windows(size)

    def _keep_windows(self, size: int) -> None:
        """Store the last frames for the pixels whose maximum is in their middle, or in the first half of the stack."""
        if self._count < size:
            return
        first = self._count - size
        middle = first + self._stack.neighbours
        chosen = self._number == middle if first else self._number <= middle
        self._keep(chosen, first)

    def _keep(self, chosen: npt.NDArray[np.bool_], first: int) -> None:
        """Store the last frames, the first of them number ``first``, for the chosen pixels."""
        for held, values in zip(self._window, self._recent, strict=True):
            for to, value in zip(held, values, strict=True):
                to[chosen] = value[chosen]
        self._start[chosen] = first

    def peak(self) -> FocusPeak:
        """Return the sharpest focus of each pixel.

        Raises
        ------
        ValueError
            The stack has fewer frames than the Gaussian is fitted to.
        """
        stack, size = self._stack, 2 * self._stack.neighbours + 1
        if self._count < size:
            raise ValueError(f"the focus stack has {self._count} frames, expected at least {size}")
        late = self._number > self._count - 1 - stack.neighbours
        self._keep(late, self._count - size)
        place, status, sigma = self._fit()
        status[self._best <= stack.threshold] = Status.LOW_SIGNAL
        status[self._lost] = Status.NOT_FINITE
        frame = np.where(status == 0, self._start + place - 1.0, np.nan)
        good = status == 0
        status[good & self._saturated] |= np.uint8(Status.SATURATED)
        if stack.ambiguity is not None:
            status[good & (self._second >= stack.ambiguity * self._best)] |= np.uint8(Status.AMBIGUOUS)
        if sigma is not None:
            sigma[np.isnan(frame)] = np.nan
            if stack.measure == "laplacian":
                sigma[~(sigma <= _MOST_SIGMA)] = np.nan
        return FocusPeak(frame, self._best, status, sigma)

    def _fit(self) -> tuple[Float64, npt.NDArray[np.uint8], Float64 | None]:
        """Fit the Gaussians; return their peaks counted from 1, status, and standard deviations."""
        # The coordinate is the frame number, from 1; any focal length below 1 gives the same result.
        fit = DepthFromFocus(first=1.0, spacing=1.0, focal_length=0.5)
        shape = self._best.shape
        place, status = np.empty(shape), np.empty(shape, np.uint8)
        sigma = np.empty(shape) if self._window.shape[1] == 2 else None
        rows = max(_BLOCK_PIXELS * len(place) // max(place.size, 1), 1)
        for first in range(0, len(place), rows):
            block = slice(first, first + rows)
            measures, *noise = np.moveaxis(self._window[:, :, block], 0, -1)
            reading = fit(measures, *noise)
            place[block], status[block] = reading.image_distance, reading.status
            if sigma is not None and reading.sigma_image is not None:
                sigma[block] = reading.sigma_image
        return place, status, sigma
