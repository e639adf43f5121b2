"""Round fiducials in an image of a board: each one found near its expected place, with a covariance.

References
----------
.. [1] F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, sections 6.3.2 and
   6.3.3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device, to_numpy
from gpuvision.matching.features.blob import Blobs, FindBlobs
from gpuvision.matching.features.fiducials import SPOKES, FiducialLimits, Fiducials, fiducial_smoothing
from gpuvision.matching.pose.pose import line_rows
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

# Least weight in the pose of a ruler or fiducial that counts as agreeing with it (chosen).
MIN_WEIGHT = 0.05


class FoundFiducials(NamedTuple):
    """Fiducials as they were found, (n, ...).

    Attributes
    ----------
    point, radius : (n, 2) and (n,)
        As drawn in the artwork [m].
    seen : (n, 2)
        Position on the board for the expected pose of the camera [m]; NaN where the fiducial was not found.
    image_px : (n, 2)
        Column and row in the measured (distorted) image; NaN where the fiducial was not found.
    size : (n,)
        Measured radius [m].
    covariance : (n, 2, 2)
        Covariance of ``seen`` [m^2].
    weight : (n,)
        Weight in the pose, 0 (outlier, or not found) to 1: the smaller weight of its two rows.
    residual : (n, 2)
        Residuals of the pose in x and y [m].
    status : (n,), uint8
        `Status` flags, as in `gpuvision.matching.features.blob.Blobs`.
    in_image : (n,), bool
        Which fiducials are expected in the image.
    """

    point: Float64
    radius: Float64
    seen: Float64
    image_px: Float64
    size: Float64
    covariance: Float64
    weight: Float64
    residual: Float64
    status: npt.NDArray[np.uint8]
    in_image: npt.NDArray[np.bool_]

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """(n,) which fiducials were found."""
        return np.asarray(np.isfinite(self.seen[:, 0]))

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """(n,) which fiducials agree with the pose."""
        return self.weight > MIN_WEIGHT

    @property
    def axes(self) -> tuple[Float64, Float64]:
        """Principal axes of the covariances: (n, 2) standard deviations [m] and (n, 2, 2) unit directions in rows."""
        known = np.where(self.found[:, None, None], self.covariance, np.eye(2))
        variance, columns = np.linalg.eigh(known)
        return np.sqrt(np.where(self.found[:, None], variance, np.nan)), np.swapaxes(columns, 1, 2)

    def rows(self, placement: Float64) -> Float64:
        """Return (2 n, 8) rows for `SolvePose` relative to a placement point (2,) [m]; their etch factor is 0."""
        sigma, axes = self.axes
        point, seen = (np.broadcast_to(each[:, None], axes.shape) - placement for each in (self.point, self.seen))
        return line_rows(axes, point, seen, sigma, 0.0)

    def with_min_sigma(self, sigma: float) -> FoundFiducials:
        """Return the fiducials with standard deviations of at least ``sigma`` [m] along any direction."""
        sigmas, axes = self.axes
        variance = np.maximum(sigmas, sigma) ** 2
        return self._replace(covariance=np.einsum("na,nai,naj->nij", variance, axes, axes))

    def with_pose(self, weights: Float64, residuals: Float64) -> FoundFiducials:
        """Return the fiducials with the weights and residuals that a pose gives their rows, (2 n,) each."""
        _, axes = self.axes
        along = np.where(np.isfinite(residuals), residuals, np.nan).reshape(-1, 2)
        return self._replace(
            weight=np.nan_to_num(weights).reshape(-1, 2).min(axis=1, initial=np.inf),
            residual=np.einsum("na,naj->nj", along, axes),
        )


def find_fiducials(
    grey: npt.NDArray[Any],
    fiducials: Fiducials,
    view: BoardView,
    *,
    is_bright: bool,
    search_px: float,
    threshold: float,
    noise: float,
    blur_px: float,
    etch_bias_sigma: float,
    device: Device,
    limits: FiducialLimits = FiducialLimits(),
) -> FoundFiducials:
    """Find fiducials near the places where a view expects them, in the image as measured.

    Parameters
    ----------
    grey
        Image (rows, columns), uint8, uint16 or float32, as `FindBlobs` takes it.
    fiducials
        Fiducials of the artwork.
    view
        Expected pose of the camera over the board.
    is_bright
        Whether copper is brighter than its surroundings.
    search_px
        Largest distance of a fiducial from its expected place [px].
    threshold, noise
        Least height of the contour's edges, and standard deviation of a pixel [grey levels].
    blur_px
        Standard deviation of the contour's blur [px].
    etch_bias_sigma
        Standard deviation of the etch bias [m]: a blob of another size than etching explains is not the fiducial.
    device
        Where to run.
    limits
        Thresholds.
    """
    count = len(fiducials.radius)
    inside = view.contains(fiducials.point, fiducials.radius / view.scale + 2 * blur_px)
    found = FoundFiducials(
        point=fiducials.point,
        radius=fiducials.radius,
        seen=np.full((count, 2), np.nan),
        image_px=np.full((count, 2), np.nan),
        size=np.full(count, np.nan),
        covariance=np.full((count, 2, 2), np.nan),
        weight=np.zeros(count),
        residual=np.full((count, 2), np.nan),
        status=np.where(inside, 0, Status.OUT_OF_RANGE).astype(np.uint8),
        in_image=inside,
    )
    for is_drilled in np.unique(fiducials.hole[inside] > 0):
        which = np.flatnonzero(inside & ((fiducials.hole > 0) == is_drilled))
        smoothing = min(fiducial_smoothing(blur_px), float(fiducials.radius[which].min()) / view.scale / 2.5)
        blobs = FindBlobs(
            threshold=threshold,
            polarity="bright" if is_bright else "dark",
            search_px=search_px,
            spokes=SPOKES,
            smoothing_px=smoothing,
            match=not bool(is_drilled),
            noise=noise,
        )(grey, _places(fiducials.point[which], fiducials.radius[which], view), device=device)
        _keep(found, which, blobs, view, etch_bias_sigma, bool(is_drilled), limits)
    return found


def _places(point: Float64, radius: Float64, view: BoardView) -> npt.NDArray[np.float32]:
    """Return x, y and radius of the fiducials in the measured image [px], as `FindBlobs` takes them."""
    places = np.concatenate([view.to_measured_pixels(point), radius[:, None] / view.scale], axis=1)
    return np.ascontiguousarray(places.astype(np.float32))


def _keep(
    found: FoundFiducials,
    which: npt.NDArray[np.int64],
    blobs: Blobs,
    view: BoardView,
    etch_bias_sigma: float,
    is_drilled: bool,
    limits: FiducialLimits,
) -> None:
    """Store the blobs found for some of the fiducials; blobs of a wrong size are refused as AMBIGUOUS."""
    nominal = _places(found.point[which], found.radius[which], view)[:, :2]
    pixels = nominal + to_numpy(blobs.shift).astype(np.float64)
    size = to_numpy(blobs.size).astype(np.float64) * view.scale
    status = to_numpy(blobs.status).copy()
    tolerance = limits.size_tolerance_px * view.scale + limits.size_sigmas * etch_bias_sigma
    has_wrong_size = np.abs(size - found.radius[which]) > tolerance
    status[has_wrong_size] |= np.uint8(Status.AMBIGUOUS)
    pixels[has_wrong_size] = np.nan
    undistorted = pixels if view.model is None else np.asarray(view.model.undistort(pixels))
    back = np.linalg.inv(view.matrix[:2, :2])
    systematic_px = limits.edges_sigma_px if is_drilled else limits.matched_sigma_px
    covariance = to_numpy(blobs.covariance)[:, :2, :2].astype(np.float64) + systematic_px**2 * np.eye(2)
    found.image_px[which], found.seen[which] = pixels, view.to_plane(undistorted)
    found.size[which], found.status[which] = size, status
    found.covariance[which] = back @ covariance @ back.T
