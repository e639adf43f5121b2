"""Map from the sensor to the sheet of light: homography, distortion, their checks and their inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.distortion import Distortion, ExchangedAxes
from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.ranging import homography
from gpuvision.ranging.homography import Model
from gpuvision.validation import numbers

Along = Literal["columns", "rows"]
Matrix = tuple[tuple[float, float, float], ...]
Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TriangulationModel:
    """Map from sensor coordinates (u, v) to sheet coordinates (G, H), with its covariance.

    The parameters are the same as in `gpuvision.Triangulation`, which computes with the map on a device.
    """

    homography: Matrix
    region: tuple[tuple[float, float], tuple[float, float]]
    model: Model = "H8"
    along: Along = "columns"
    lens: Lens | None = None
    camera: Camera | None = None
    polynomial: PlanePolynomial | None = None
    covariance: tuple[tuple[float, ...], ...] | None = None
    sigma: tuple[float, float] | None = None
    horizon: float = 1e-3

    def __post_init__(self) -> None:
        object.__setattr__(self, "homography", numbers(self.homography, (3, 3), "Triangulation.homography"))
        object.__setattr__(self, "region", numbers(self.region, (2, 2), "Triangulation.region"))
        if self.covariance is not None:
            object.__setattr__(self, "covariance", numbers(self.covariance, (8, 8), "Triangulation.covariance"))
        if self.sigma is not None:
            object.__setattr__(self, "sigma", numbers(self.sigma, (2,), "Triangulation.sigma"))
        self._check()

    def _check(self) -> None:
        (u_min, u_max), (v_min, v_max) = self.region
        if not (u_min < u_max and v_min <= v_max):
            raise ValueError(f"Triangulation.region is {self.region}, expected ((u_min, u_max), (v_min, v_max))")
        if self.model not in homography.MODELS:
            raise ValueError(f"Triangulation.model is {self.model!r}, expected one of {', '.join(homography.MODELS)}")
        if self.along not in ("columns", "rows"):
            raise ValueError(f"Triangulation.along is {self.along!r}, expected 'columns' or 'rows'")
        if self.lens is not None and self.camera is not None:
            raise ValueError("Triangulation has a lens and a camera; the camera includes a lens, give one of them")
        if self.polynomial is not None:
            if self.lens is not None or self.camera is not None:
                raise ValueError("Triangulation has a polynomial and a lens or camera; the polynomial includes them")
            if self.homography != linear_part(self.polynomial):
                raise ValueError("Triangulation.homography is no linear part of the polynomial; use from_polynomial")
            if self.covariance is not None:
                raise ValueError(
                    "Triangulation.covariance belongs to a homography; a PlanePolynomial has its covariance itself"
                )
        if not 0.0 < self.horizon < 1.0:
            raise ValueError(f"Triangulation.horizon is {self.horizon}, expected a number between 0 and 1")
        if self.sigma is not None and min(self.sigma) < 0.0:
            raise ValueError(f"Triangulation.sigma is {self.sigma}, expected (sigma_u, sigma_v), neither negative")
        self.conditioned()

    def conditioned(self) -> Float64:
        """(g0, gx, gy, h0, hx, hy, dx, dy) of the displacement form over ``region``.

        ``G = g0 + (gx x + gy y) / (1 + dx x + dy y)``, and the same form for H. x and y are the undistorted u and v,
        shifted and scaled to about -1 to 1: ``x = (u - u_middle) / half``, where ``half`` is half of the larger extent
        of the region.
        """
        return self._displacement(*self._centre_and_half_extent())

    @property
    def _image_region(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Region of the sensor as ranges of columns and rows."""
        u, v = self.region
        return (v, u) if self.along == "columns" else (u, v)

    def _centre_and_half_extent(self) -> tuple[Float64, Float64]:
        return homography.centre_and_half_extent(self.region)

    def _displacement(self, origin: Float64, unit: Float64) -> Float64:
        """Return the eight parameters for u = origin + unit x."""
        matrix = np.array(self.homography) @ homography.shift_and_scale(origin, unit)
        return homography.to_displacement(matrix, rank=2 if self.model == "C3" else 3)

    def to_sensor(self, points: npt.ArrayLike) -> Float64:
        """Compute the measured sensor coordinates (u, v) of sheet points (G, H), both of shape (..., 2): the inverse.

        NaN for points behind the horizon of the sensor and for points that the lens does not image.
        """
        points = np.asarray(points, dtype=np.float64)
        origin, unit = self._centre_and_half_extent()
        g0, gx, gy, h0, hx, hy, dx, dy = self.conditioned()
        matrix = np.array([[gx + g0 * dx, gy + g0 * dy, g0], [hx + h0 * dx, hy + h0 * dy, h0], [dx, dy, 1.0]])
        if self.model == "C3":
            # A single beam has no v: return the middle of the region.
            matrix[0], points = (0.0, 1.0, 0.0), points * (0.0, 1.0)
        inverse = np.linalg.inv(matrix)
        lifted = points @ inverse[:, :2].T + inverse[:, 2]
        middle = inverse @ matrix[:, 2]
        lifted[lifted[..., 2] * middle[2] <= 0.0] = np.nan
        straight: Float64 = origin + unit * lifted[..., :2] / lifted[..., 2:]
        return straight if self.distortion is None else self.distortion.distort(straight)

    @property
    def sensor_lens(self) -> Lens | None:
        """Lens for points in (u, v) order; None without a lens."""
        return self.lens.swapped() if self.lens is not None and self.along == "columns" else self.lens

    @property
    def distortion(self) -> Distortion | None:
        """Lens, camera or higher terms of the polynomial for points in (u, v) order; None without them."""
        if self.polynomial is not None:
            return ExchangedAxes(self.polynomial)
        return in_sensor_order(self.camera if self.lens is None else self.lens, self.along)

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, as in a TOML file; parameters that are None are omitted."""
        table: dict[str, Any] = {"homography": [list(row) for row in self.homography]}
        table["region"] = [list(bounds) for bounds in self.region]
        table |= {"model": self.model, "along": self.along, "horizon": self.horizon}
        if self.covariance is not None:
            table["covariance"] = [list(row) for row in self.covariance]
        if self.sigma is not None:
            table["sigma"] = list(self.sigma)
        if self.lens is not None:
            table["lens"] = self.lens.to_dict()
        if self.camera is not None:
            table["camera"] = self.camera.to_dict()
        if self.polynomial is not None:
            table["polynomial"] = self.polynomial.to_dict()
        return table


def linear_part(polynomial: PlanePolynomial) -> Matrix:
    """Return the homography of the polynomial without its higher terms, for points in (u, v) order."""
    rows: Matrix = numbers([*polynomial.affine[:, [1, 0, 2]], (0.0, 0.0, 1.0)], (3, 3), "Triangulation.homography")
    return rows


def in_sensor_order(model: Lens | Camera | None, along: Along) -> Distortion | None:
    """Return a distortion model for points in (u, v) order."""
    if along == "rows" or model is None:
        return model
    return model.swapped() if isinstance(model, Lens) else ExchangedAxes(model)
