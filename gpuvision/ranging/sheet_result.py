"""Sheet of light in the camera's frame: parameters, covariance, residuals, and the test of its bend."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Float64 = npt.NDArray[np.float64]

SHEET_PARAMETERS = ("offset", "slope_g", "slope_h", "gg", "gh", "hh")
"""Names of the parameters of a sheet [m, -, -, 1/m, 1/m, 1/m]; a plane has the first three."""


class BendTest(NamedTuple):
    """Test of the bend of a sheet against a plane.

    Attributes
    ----------
    bend : (float, float, float)
        (gg, gh, hh) of the fit with a bend [1/m].
    sigma : (float, float, float)
        Standard deviations, with the error of the camera [1/m].
    f_value, p_value : float
        F statistic of "no bend", and the probability of at least this value for a plane.
    significant : bool
        Whether the sheet keeps the bend.
    """

    bend: tuple[float, float, float]
    sigma: tuple[float, float, float]
    f_value: float
    p_value: float
    significant: bool


@dataclass(frozen=True, kw_only=True)
class SheetFit:
    """Sheet of light in the camera's frame.

    Attributes
    ----------
    origin, g_axis, h_axis : numpy.ndarray
        (3,): point G = H = 0 [m], and unit vectors along G and H. G follows the samples of the image, H leads towards
        the camera.
    bend : (float, float, float) or None
        (gg, gh, hh) [1/m]; None for a plane.
    names : tuple of str
        Fitted parameters, the first ones of `SHEET_PARAMETERS`.
    noise_covariance : numpy.ndarray
        (p, p): covariance of the parameters for a known camera.
    by_camera : numpy.ndarray
        (p, m): derivative of the parameters by the camera's parameters.
    sigma_px : float
        Noise of a reading across the line [px].
    view_ratio : float
        Reduced chi-square of the lines of the views about the sheet; `noise_covariance` includes it if it is above 1.
    bend_test : BendTest or None
        Test of the bend; None with too few views.
    residuals : tuple of numpy.ndarray
        Per view (n,): distance of each reading from the sheet's line [px]; NaN for outliers.
    coordinates : tuple of numpy.ndarray
        Per view (n, 2): G and H of each reading [m].
    converged : bool
        Whether the last step of the fit was at most a tenth of the standard deviations. Default True.
    """

    origin: Float64
    g_axis: Float64
    h_axis: Float64
    bend: tuple[float, float, float] | None
    names: tuple[str, ...]
    noise_covariance: Float64
    by_camera: Float64
    sigma_px: float
    view_ratio: float
    bend_test: BendTest | None
    residuals: tuple[Float64, ...]
    coordinates: tuple[Float64, ...]
    converged: bool = True

    @property
    def normal(self) -> Float64:
        """Direction of d: ``g_axis x h_axis``."""
        return np.cross(self.g_axis, self.h_axis)

    @property
    def rms_px(self) -> float:
        """Root mean square residual of the readings that are no outliers [px]."""
        return float(np.sqrt(np.nanmean(np.concatenate(self.residuals) ** 2)))

    @property
    def outliers(self) -> int:
        """Number of readings that the fit rejected."""
        return int(np.count_nonzero(np.isnan(np.concatenate(self.residuals))))

    def covariance(self, camera: npt.ArrayLike) -> Float64:
        """Return the covariance (p, p) of the parameters for a camera with a covariance (m, m)."""
        total: Float64 = self.noise_covariance + self.by_camera @ np.asarray(camera) @ self.by_camera.T
        return total
