"""Parameters of the kernels that triangulate: build options and table of ``kernels/common/sheet.h``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.lens import Lens
from gpuvision.camera.profile_correction import ProfileCorrection, profile_correction
from gpuvision.host import Define, flags
from gpuvision.ranging import homography
from gpuvision.ranging.sheet import SampleAxes, SheetTable
from gpuvision.ranging.triangulation_model import Float64
from gpuvision.ranging.triangulation_sigma import TriangulationSigma

# Largest error of a tabulated correction, relative to a rounding of the corrected coordinate. Chosen.
_SHARE_OF_ROUNDING = 0.25


@dataclass(frozen=True, kw_only=True)
class TriangulationTable(TriangulationSigma):
    """Map from the sensor to the sheet of light, as parameters of the kernels that triangulate."""

    def profile_correction(
        self, real: npt.DTypeLike, axes: SampleAxes, length: int, samples: int
    ) -> ProfileCorrection | None:
        """Return the camera's correction as a table for a readout of ``samples`` profiles of ``length`` positions.

        None without a distorting camera, in double precision, and where polynomials do not reach a quarter of a
        rounding: the kernel then computes the correction.
        """
        if self.camera is None or not self.camera.distorts or np.dtype(real) != np.float32:
            return None
        assert self.distortion is not None
        _, _, first, pitch, unit = self._kernel_axes(np.dtype(real), axes)
        tolerance = _SHARE_OF_ROUNDING * float(np.finfo(np.float32).eps)
        return profile_correction(
            self.distortion, first=first, pitch=pitch, length=length, samples=samples, unit=unit, tolerance=tolerance
        )

    def defines(self, real: npt.DTypeLike, profiles: ProfileCorrection | None = None) -> dict[str, Define]:
        """Return the build options of ``kernels/common/sheet.h`` for a kernel with the real type ``real``.

        ``profiles`` is the result of `profile_correction`.
        """
        options: dict[str, Define] = {} if self.covariance is None else {"SHEET_COVARIANCE": None}
        if self.lens is not None:
            options |= self.lens.defines
        if self.camera is not None and self.camera.distorts:
            _, half = self._centre_and_half_extent()
            options |= (
                self.camera.correction_defines(real, float(half[0]), self._image_region)
                if profiles is None
                else {**self.camera.defines(), "CAMERA_PROFILES": profiles.terms.shape[1]}
            )
            options |= flags(SHEET_ROWS=self.along == "rows")
        return options if self.polynomial is None else {**options, **self.polynomial.defines}

    def packed(
        self, real: npt.DTypeLike, axes: SampleAxes | None = None, profiles: ProfileCorrection | None = None
    ) -> npt.NDArray[Any]:
        """Return the parameter table of the device functions of ``kernels/common/sheet.h`` (`SheetTable`).

        Parameters
        ----------
        real : dtype
            float32 or float64, the real type of the kernel. Origins and scales are rounded to it *before* the other
            numbers are computed from them, so that their rounding costs no accuracy.
        axes : SampleAxes, optional
            Map from the positions and sample indices of the kernel to sensor coordinates; it is folded into the table.
        profiles : ProfileCorrection, optional
            Result of `profile_correction`.
        """
        real, axes = np.dtype(real), SampleAxes() if axes is None else axes
        _, half = self._centre_and_half_extent()
        origin, scale, first, pitch, unit = self._kernel_axes(real, axes)
        start = first + pitch * origin
        terms = self._displacement(start, unit)
        lens, camera = np.zeros(Lens.TABLE_SIZE), np.zeros(0)
        if self.sensor_lens is not None:
            # The two scales differ by a rounding only, which moves a distorted point by less than a rounding.
            lens = self.sensor_lens.packed(start.tolist(), 1.0 / half[0])
        if self.camera is not None and self.camera.distorts:
            to_image = [1, 0] if self.along == "columns" else [0, 1]
            camera = self.camera.packed_correction(
                real,
                first[to_image],
                pitch[to_image],
                unit[to_image],
                self._image_region,
                None if profiles is None else (profiles.middle, profiles.scale),
            )
        plane: dict[str, Float64] = {}
        if self.polynomial is not None:
            plane_middle, plane_half, displacement = self.polynomial.displacement
            plane = {
                "plane_origin": (plane_middle - first[::-1]) / pitch[::-1],
                "plane_scale": pitch[::-1] / plane_half,
                "plane_unit": plane_half / unit[::-1],
                "plane_terms": displacement.ravel(),
            }
        g0, gx, gy, h0, hx, hy, dx, dy = terms
        factor_g, factor_h = self._factors()
        table = SheetTable(
            position_origin=origin[0],
            position_scale=scale[0],
            sample_origin=origin[1],
            sample_scale=scale[1],
            horizon=self.horizon,
            w_terms=(dx, dy),
            g_terms=(g0, gx, gy),
            h_terms=(h0, hx, hy),
            lens=lens,
            factor_g=factor_g,
            factor_h=factor_h,
            camera=camera,
            **plane,
        )
        with np.errstate(over="ignore"):
            return np.hstack(table).astype(real)

    def _kernel_axes(self, real: np.dtype[Any], axes: SampleAxes) -> tuple[Float64, Float64, Float64, Float64, Float64]:
        """Return origin and scale of the kernel's positions and samples, first, pitch, and the units of x and y."""
        middle, half = self._centre_and_half_extent()
        pitch = np.array([axes.position_pitch, axes.sample_pitch])
        first = np.array([axes.position_origin, axes.sample_origin])
        origin = ((middle - first) / pitch).astype(real).astype(np.float64)
        scale = (pitch / half).astype(real).astype(np.float64)
        return origin, scale, first, pitch, pitch / scale

    def _factors(self) -> tuple[Float64, Float64]:
        """Return triangular factors of the covariance of the parameters of G, and of the parameters of H."""
        if self.covariance is None:
            return np.zeros(15), np.zeros(15)
        covariance = np.array(self.covariance)
        # Displacement parameters on which G and H depend.
        of_g, of_h = (0, 1, 2, 6, 7), (3, 4, 5, 6, 7)
        factor_g, factor_h = (homography.packed_covariance_factor(covariance, which) for which in (of_g, of_h))
        return factor_g, factor_h
