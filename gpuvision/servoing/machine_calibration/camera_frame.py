"""Camera frame of a placement machine: from pixels to metres on the plane of the board, with covariance.

The plane and the sensor are related by a homography after the lens distortion is removed; a plate with known points
fixes it.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 8.3.1 and
   8.4.1 (camera coordinate system).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.distortion import Distortion
from gpuvision.ranging.homography import (
    centre_and_half_extent,
    displacement_design,
    project,
    shift_and_scale,
    to_displacement,
)
from gpuvision.ranging.homography_fit import fit_models
from gpuvision.servoing.frames import CAMERA, IMAGE, MappedPoints, Transform
from gpuvision.servoing.machine_calibration.next_measurement import NextMeasurement, most_informative

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraFrame:
    """Calibrated map from pixels to the plane of the board in the camera frame.

    Attributes
    ----------
    homography : numpy.ndarray
        (3, 3): from undistorted pixels (column, row) to metres.
    covariance : numpy.ndarray
        (8, 8): covariance of the displacement parameters over the image
        (`gpuvision.ranging.homography.to_displacement`).
    shape : (int, int)
        Rows and columns of the image.
    sigma_px : float
        Standard deviation of a calibration point [px].
    rms : float
        Root mean square residual of a coordinate in standard deviations.
    distortion : Distortion or None
        Lens distortion that was removed.
    """

    homography: Float64
    covariance: Float64
    shape: tuple[int, int]
    sigma_px: float
    rms: float
    distortion: Distortion | None = None

    @property
    def transform(self) -> Transform:
        """Affine transform from "image" [px] to "camera" [m]: the homography linearised at the image centre."""
        centre, unit = centre_and_half_extent(_bounds(self.shape))
        values = to_displacement(self.homography @ shift_and_scale(centre, unit))
        # Displacement parameters are elements of the matrix of normalised pixels: g0, gx, gy, h0, hx, hy.
        to_normalised = np.linalg.inv(shift_and_scale(centre, unit))
        rows = np.kron(np.eye(2), to_normalised.T[:, [2, 0, 1]])
        covariance = rows @ self.covariance[:6, :6] @ rows.T
        return Transform.affine(IMAGE, CAMERA, (rows @ values[:6]).reshape(2, 3), covariance)

    @property
    def pixel_size(self) -> float:
        """Size of a pixel at the image centre [m], the mean over directions."""
        return float(np.sqrt(abs(np.linalg.det(self.transform.linear))))

    def to_plane(self, pixels: npt.ArrayLike, covariance: npt.ArrayLike | None = None) -> MappedPoints:
        """Map measured pixels to the plane.

        Parameters
        ----------
        pixels : array_like
            (..., 2): column and row in the measured (distorted) image [px].
        covariance : array_like, optional
            (..., 2, 2): covariance of the pixels [px^2]. Default: 0.

        Returns
        -------
        MappedPoints
            Positions [m] with the covariance of the pixels and of the calibration, which is common to all points.
        """
        measured = np.asarray(pixels, np.float64)
        ideal, design, by_pixel = self._linearise(measured)
        spread = design @ self.covariance @ design.swapaxes(-1, -2)
        if covariance is not None:
            spread = spread + by_pixel @ np.asarray(covariance, np.float64) @ by_pixel.swapaxes(-1, -2)
        return MappedPoints(project(self.homography, ideal), np.asarray(spread))

    def next_point(self, candidates: npt.ArrayLike) -> NextMeasurement:
        """Propose the pixel at which one more known point would improve the frame most.

        Parameters
        ----------
        candidates : array_like
            (n, 2): pixels (column, row) at which the machine can show a point.
        """
        _, design, by_pixel = self._linearise(np.asarray(candidates, np.float64))
        # A pixel error e moves the point by J e: the rows in standard deviations are J^-1 D / sigma.
        rows: Float64 = np.asarray(np.linalg.solve(by_pixel, design) / self.sigma_px, np.float64)
        return most_informative(rows, np.asarray(np.linalg.inv(self.covariance), np.float64))

    def _linearise(self, measured: Float64) -> tuple[Float64, Float64, Float64]:
        """Return undistorted pixels (..., 2), and derivatives by the parameters (..., 2, 8), the pixels (..., 2, 2)."""
        ideal = measured if self.distortion is None else self.distortion.undistort(measured)
        centre, unit = centre_and_half_extent(_bounds(self.shape))
        values = to_displacement(self.homography @ shift_and_scale(centre, unit))
        normalised = (ideal - centre) / unit
        denominator = 1.0 + normalised @ values[6:]
        offset = project(self.homography, ideal) - values[[0, 3]]
        design = displacement_design(normalised / denominator[..., None], offset)
        gradient = np.stack([values[1:3], values[4:6]])
        by_pixel = (gradient - offset[..., :, None] * values[6:]) / denominator[..., None, None] / unit
        if self.distortion is not None:
            by_pixel = by_pixel @ self.distortion.jacobian(measured)
        return ideal, design, np.asarray(by_pixel)


def fit_camera_frame(
    pixels: npt.ArrayLike,
    points: npt.ArrayLike,
    sigma_px: float,
    shape: tuple[int, int],
    *,
    distortion: Distortion | None = None,
) -> CameraFrame:
    """Fit the camera frame to known points of a plate in the plane of the board.

    Parameters
    ----------
    pixels : array_like
        (n, 2): measured column and row of each point [px].
    points : array_like
        (n, 2): known positions [m]: they define the camera frame.
    sigma_px : float
        Standard deviation of a measured coordinate [px].
    shape : (int, int)
        Rows and columns of the image.
    distortion : Distortion, optional
        Calibrated lens (`Lens` or `Camera`), exact. Default: no distortion.

    Returns
    -------
    CameraFrame

    Raises
    ------
    DegenerateError
        The points do not determine the homography: too few, or on one line.
    ValueError
        A shape differs, or a number is not finite.
    """
    fit = fit_models(pixels, points, sigma=sigma_px, models=("H8",), region=_bounds(shape), distortion=distortion)[0]
    assert fit.covariance is not None  # sigma is given
    return CameraFrame(
        homography=fit.homography,
        covariance=fit.covariance,
        shape=shape,
        sigma_px=sigma_px,
        rms=fit.rms,
        distortion=distortion,
    )


def _bounds(shape: tuple[int, int]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the extent of the pixel centres, columns and rows."""
    return (0.0, shape[1] - 1.0), (0.0, shape[0] - 1.0)
