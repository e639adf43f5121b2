"""Standard deviations of triangulated points: by the noise of the readout, and by the covariance of the calibration."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.ranging import homography
from gpuvision.ranging.triangulation_model import Float64, TriangulationModel


@dataclass(frozen=True, kw_only=True)
class TriangulationSigma(TriangulationModel):
    """Map from the sensor to the sheet of light, with the covariance of its points."""

    def covariance_at(self, points: npt.ArrayLike) -> Float64:
        """Compute the covariance (..., 2, 2) of (G, H) at measured points (u, v) (..., 2); NaN beyond the horizon.

        ``J diag(sigma_u^2, sigma_v^2) J'`` with the Jacobian J of distortion and homography, plus the contribution of
        the covariance of the parameters.

        Raises
        ------
        ValueError
            Neither ``sigma`` nor ``covariance`` is known.
        """
        if self.sigma is None and self.covariance is None:
            raise ValueError("Triangulation knows neither sigma nor covariance; give it one of them")
        points = np.asarray(points, dtype=np.float64)
        p, values, w = self._at(points)
        unit = self._centre_and_half_extent()[1]
        _, gx, gy, _, hx, hy, dx, dy = self.conditioned()
        slopes = np.array([[gx, gy], [hx, hy]]) - values[..., None] * np.array([dx, dy])
        distortion_slopes = np.eye(2) if self.distortion is None else self.distortion.jacobian(points)
        slopes = (slopes / w[..., None, None]) @ distortion_slopes / unit
        scaled = slopes * np.array(self.sigma or (0.0, 0.0))
        total: Float64 = scaled @ np.swapaxes(scaled, -1, -2)
        if self.covariance is not None:
            design = homography.displacement_design(p, values)
            total += design @ np.array(self.covariance) @ np.swapaxes(design, -1, -2)
        return total

    def parameter_derivatives(self, points: npt.ArrayLike) -> Float64:
        """Return the derivatives (..., 2, 8) of (G, H) at measured points (u, v) (..., 2) by the parameters.

        `conditioned` returns the parameters, and ``covariance`` is their covariance. NaN beyond the horizon.
        """
        return homography.displacement_design(*self._at(np.asarray(points, dtype=np.float64))[:2])

    def _at(self, points: Float64) -> tuple[Float64, Float64, Float64]:
        """Return ``(x, y) / w``, the displacements (G - g0, H - h0) and the denominator w at measured points (u, v)."""
        origin, unit = self._centre_and_half_extent()
        x = ((points if self.distortion is None else self.distortion.undistort(points)) - origin) / unit
        _, gx, gy, _, hx, hy, dx, dy = self.conditioned()
        w = 1.0 + x @ np.array([dx, dy])
        w = np.where(w > self.horizon, w, np.nan)
        p = x / w[..., None]
        return p, p @ np.array([[gx, hx], [gy, hy]]), w

    def check_systematic(self, outputs: Iterable[str], operation: str) -> None:
        """Check that an operation that computes systematic errors has the covariance for them.

        Raises
        ------
        ValueError
            ``outputs`` has a systematic error, and the triangulation has no covariance.
        """
        for name in outputs:
            if name.startswith("systematic") and self.covariance is None:
                raise ValueError(
                    f"{operation}.outputs has {name!r}, but its triangulation has no covariance; "
                    "give Triangulation.covariance"
                )
