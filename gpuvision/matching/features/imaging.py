"""Image quality of a board's edges and search range of the board, for which features are selected."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.matching.artwork.shapes import Float64
from gpuvision.validation import finite, integer, numbers


@dataclass(frozen=True, kw_only=True)
class Imaging:
    """Image quality of a board's edges, and search range of the board.

    Parameters
    ----------
    pixel : float
        Size of a pixel on the board [m], above 0.
    blur_px : float
        Standard deviation of the edges' blur [px], above 0, default 1; the extent of the pixels (1 / sqrt(12) px)
        included.
    motion_px : (float, float)
        Motion during the exposure along x and y [px], default 0. It blurs edges across it beyond the blur for which the
        smoothing is chosen.
    contrast_bare, contrast_masked : float
        Height of the step at an edge over the noise of a pixel, above 0, for bare copper (default 40) and for copper
        under the mask (default 15).
    width_px : int
        Number of lines that a ruler averages, default 5. Range: 1 or more.
    etch_bias_sigma : float
        Standard deviation of the etch bias, common to the whole board [m], default 10 um.
    registration : float
        Largest offset, along x and along y, of mask, silk and holes relative to the copper [m], default 50 um.
    smoothing_ratio : float
        Smoothing of the rulers over the blur, above 0, default sqrt(5): the best for isolated edges. A smaller ratio
        needs less room between edges and is less precise (1.44 times the sigma at 1).
    shift : float
        Search range: largest offset of the board along x and along y [m], above 0, default 100 um.
    angle : float
        Search range: largest angle of the board [rad], 0 or more, default 5 mrad.

    Raises
    ------
    ValueError
        A parameter is not finite, or not positive (``motion_px``, ``etch_bias_sigma``, ``registration`` and ``angle``
        may be 0).
    """

    pixel: float
    blur_px: float = 1.0
    motion_px: tuple[float, float] = (0.0, 0.0)
    contrast_bare: float = 40.0
    contrast_masked: float = 15.0
    width_px: int = 5
    etch_bias_sigma: float = 10e-6
    registration: float = 50e-6
    smoothing_ratio: float = math.sqrt(5.0)
    shift: float = 100e-6
    angle: float = 5e-3

    def __post_init__(self) -> None:
        integer(self.width_px, "Imaging.width_px", minimum=1)
        for name in ("pixel", "blur_px", "contrast_bare", "contrast_masked", "smoothing_ratio", "shift"):
            if finite(getattr(self, name), f"Imaging.{name}") <= 0.0:
                raise ValueError(f"Imaging.{name} is {getattr(self, name)}, it must be positive")
        for name in ("etch_bias_sigma", "registration", "angle"):
            if finite(getattr(self, name), f"Imaging.{name}") < 0.0:
                raise ValueError(f"Imaging.{name} is {getattr(self, name)}, it must be 0 or positive")
        numbers(self.motion_px, (2,), "Imaging.motion_px")

    @property
    def smoothing_px(self) -> float:
        """Smoothing of an edge without motion [px]; by default sqrt(5) times the blur, see `best_smoothing`."""
        return self.smoothing_ratio * self.blur_px

    @property
    def room_px(self) -> float:
        """Distance to other edges that an edge needs [px]: 2.74 standard deviations of blur and smoothing together.

        For the best smoothing this is 3 times the smoothing, beyond which an edge moves another one by less than its
        own error.
        """
        return 3.0 * math.sqrt(5.0 / 6.0) * math.hypot(self.blur_px, self.smoothing_px)

    @property
    def max_blur_px(self) -> float:
        """Standard deviation of the blur of edges across the motion [px]."""
        return math.hypot(self.blur_px, math.hypot(*self.motion_px) / math.sqrt(12.0))

    def sigma(self, bare: npt.ArrayLike, normal: npt.ArrayLike = (1.0, 0.0)) -> Float64:
        """Return the standard deviation [m] of isolated edges with normals (..., 2), at ``smoothing_px``.

        Parameters
        ----------
        bare : array_like
            Whether the copper is bare; otherwise it is under the mask.
        normal : array_like
            (..., 2) unit normals. Default ``(1.0, 0.0)``.

        Notes
        -----
        The Cramer-Rao bound for a Gaussian edge in white noise is 1.883 sqrt(blur) / (contrast sqrt(width)) pixels.
        With smoothing a and blur s, the variance of the gradient's maximum is (3/8) (a^2 + s^2)^3 / (a^5 s) times the
        bound: 1.2 standard deviations without motion. Motion over a length m adds m / sqrt(12) to the blur of edges
        across it.
        """
        contrast = np.where(bare, self.contrast_bare, self.contrast_masked)
        smear = np.asarray(normal, dtype=np.float64) @ np.asarray(self.motion_px) / math.sqrt(12.0)
        blur = np.hypot(self.blur_px, smear)
        bound = np.sqrt(2 * math.sqrt(math.pi) * blur / self.width_px) / contrast
        worse = np.sqrt(3 / 8 * (self.smoothing_px**2 + blur**2) ** 3 / (self.smoothing_px**5 * blur))
        return np.asarray(worse * bound * self.pixel)
