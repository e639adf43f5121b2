"""Round marks in an image of a board: found near where they should be, each for itself, with a covariance."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.matching.features.blob import Blobs, FindBlobs
from gpuvision.matching.features.fiducials import SPOKES, Marks, mark_smoothing
from gpuvision.matching.pose.pose import line_rows
from gpuvision.status import Status

Float64 = npt.NDArray[np.float64]

# [px] by which a match may be off, and a fit to edges beside which a trace ends, whatever the noise.
_MATCH_PX, _EDGES_PX = 0.003, 0.02
_ODD_PX = 1.0  # by which a mark may be larger or smaller than drawn, besides how it was etched


class FoundMarks(NamedTuple):
    """What was found of each mark, (n, ...).

    Attributes
    ----------
    point, radius
        (n, 2) and (n,) as drawn [m].
    seen
        (n, 2) where it is on the board as the camera is thought to be [m]; NaN where it was not found.
    image_px
        (n, 2) column and row in the image as it was taken; NaN where it was not found.
    size
        (n,) the radius that was found [m].
    covariance
        (n, 2, 2) of the place [m^2].
    weight
        (n,) in the pose, 0 (rejected, or not found) to 1: the less of its two rows'.
    residual
        (n, 2) what the pose leaves of x, y [m].
    status
        (n,) uint8 `Status` flags, as in `gpuvision.matching.features.blob.Blobs`.
    laid
        (n,) bool: which should lie in the image.
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
    laid: npt.NDArray[np.bool_]

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which were found."""
        return np.asarray(np.isfinite(self.seen[:, 0]))

    @property
    def used(self) -> npt.NDArray[np.bool_]:
        """Which the pose agrees with."""
        return self.weight > 0.05

    @property
    def axes(self) -> tuple[Float64, Float64]:
        """(n, 2) standard deviations [m] and (n, 2, 2) unit directions, in rows, along which they are independent."""
        known = np.where(self.found[:, None, None], self.covariance, np.eye(2))
        variance, columns = np.linalg.eigh(known)
        return np.sqrt(np.where(self.found[:, None], variance, np.nan)), np.swapaxes(columns, 1, 2)

    def rows(self, placement: Float64) -> Float64:
        """(2 n, 8) rows for `SolvePose` about a placement point; the last number, of etching, is 0."""
        sigma, axes = self.axes
        point, seen = (np.broadcast_to(each[:, None], axes.shape) - placement for each in (self.point, self.seen))
        return line_rows(axes, point, seen, sigma, 0.0)

    def known_to(self, sigma: float) -> FoundMarks:
        """Return them with a least standard deviation [m] along any direction."""
        sigmas, axes = self.axes
        variance = np.maximum(sigmas, sigma) ** 2
        return self._replace(covariance=np.einsum("na,nai,naj->nij", variance, axes, axes))

    def judged(self, weights: Float64, residuals: Float64) -> FoundMarks:
        """Return them with what a pose made of their rows, (2 n,) each."""
        _, axes = self.axes
        along = np.where(np.isfinite(residuals), residuals, np.nan).reshape(-1, 2)
        return self._replace(
            weight=np.nan_to_num(weights).reshape(-1, 2).min(axis=1, initial=np.inf),
            residual=np.einsum("na,naj->nj", along, axes),
        )


def find_marks(
    grey: npt.NDArray[Any],
    marks: Marks,
    view: BoardView,
    *,
    is_bright: bool,
    search_px: float,
    threshold: float,
    noise: float,
    blur_px: float,
    etch: float,
    device: Device,
) -> FoundMarks:
    """Find marks where a view has them, in the image as it was taken; none is followed further than the search.

    Parameters
    ----------
    grey
        As `FindBlobs` takes it.
    marks, view
        What is looked for, and where the camera is thought to be.
    is_bright
        Whether copper is brighter than what lies beside it.
    search_px
        How far a mark may be from there.
    threshold, noise
        Least contour, and of a pixel [grey levels].
    blur_px
        Standard deviation of the contour's blur.
    etch
        Standard deviation of how far copper was etched [m]: marks of another size are others.
    device
        Where to run.
    """
    count = len(marks.radius)
    inside = view.contains(marks.point, marks.radius / view.scale + 2 * blur_px)
    found = FoundMarks(
        point=marks.point,
        radius=marks.radius,
        seen=np.full((count, 2), np.nan),
        image_px=np.full((count, 2), np.nan),
        size=np.full(count, np.nan),
        covariance=np.full((count, 2, 2), np.nan),
        weight=np.zeros(count),
        residual=np.full((count, 2), np.nan),
        status=np.where(inside, 0, Status.OUT_OF_RANGE).astype(np.uint8),
        laid=inside,
    )
    for is_drilled in np.unique(marks.hole[inside] > 0):
        which = np.flatnonzero(inside & ((marks.hole > 0) == is_drilled))
        smoothing = min(mark_smoothing(blur_px), float(marks.radius[which].min()) / view.scale / 2.5)
        blobs = FindBlobs(
            threshold=threshold,
            polarity="bright" if is_bright else "dark",
            search_px=search_px,
            spokes=SPOKES,
            smoothing_px=smoothing,
            match=not bool(is_drilled),
            noise=noise,
        )(grey, _places(marks.point[which], marks.radius[which], view), device=device)
        _keep(found, which, blobs, view, etch, _EDGES_PX if is_drilled else _MATCH_PX)
    return found


def _places(point: Float64, radius: Float64, view: BoardView) -> npt.NDArray[np.float32]:
    places = np.concatenate([view.to_measured_pixels(point), radius[:, None] / view.scale], axis=1)
    return np.ascontiguousarray(places.astype(np.float32))


def _keep(
    found: FoundMarks,
    which: npt.NDArray[np.int64],
    blobs: Blobs,
    view: BoardView,
    etch: float,
    systematic_px: float,
) -> None:
    nominal = _places(found.point[which], found.radius[which], view)[:, :2]
    pixels = nominal + blobs.shift.astype(np.float64)
    size = blobs.size.astype(np.float64) * view.scale
    status = np.array(blobs.status)
    odd = np.abs(size - found.radius[which]) > _ODD_PX * view.scale + 4 * etch
    status[odd] |= np.uint8(Status.AMBIGUOUS)
    pixels[odd] = np.nan
    straight = pixels if view.model is None else np.asarray(view.model.undistort(pixels))
    back = np.linalg.inv(view.matrix[:2, :2])
    covariance = blobs.covariance[:, :2, :2].astype(np.float64) + systematic_px**2 * np.eye(2)
    found.image_px[which], found.seen[which] = pixels, view.to_plane(straight)
    found.size[which], found.status[which] = size, status
    found.covariance[which] = back @ covariance @ back.T
