"""Result of a camera calibration from images of a flat target pattern."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy.spatial import ConvexHull, QhullError

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.correction_uncertainty import CorrectionMap, correction_map, largest_sigma
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.patterns.pattern import LineFamilies
from gpuvision.camera.views.camera_fit import CameraFit

TargetPattern = Literal["dots", "chessboard", "lines"]
Float64: TypeAlias = npt.NDArray[np.float64]


class AlternativeModel(NamedTuple):
    """Camera or lens model fitted to the same points as the chosen one.

    Attributes
    ----------
    model : str
        Name of the model.
    rms_px : float
        Root mean square residual [px].
    p_value : float
        p-value of the F test of this model against the largest one: the probability of at least this increase of the
        residual if this model is true.
    aic : float
        Akaike information criterion; only differences between models are meaningful.
    centre : (float, float) or None
        Column and row of the distortion centre [px]; None for a model without a lens.
    centre_distance_px : float
        Distance of `centre` from the chosen model's centre [px]; NaN for a model without a lens.
    """

    model: str
    rms_px: float
    p_value: float
    aic: float
    centre: tuple[float, float] | None
    centre_distance_px: float


class DetectedTarget(NamedTuple):
    """Target pattern detected in one image.

    Attributes
    ----------
    image : Path
        File of the image.
    grid : numpy.ndarray or None
        (rows, columns, 2) float64: measured (column, row) of the grid points [px], NaN where missing; None for a line
        pattern.
    families : tuple
        Families of measured lines that are straight and parallel on the target.
    """

    image: Path
    grid: Float64 | None
    families: LineFamilies

    @property
    def points(self) -> int:
        """Number of measured points."""
        if self.grid is None:
            return sum(len(line) for family in self.families for line in family)
        return int(np.count_nonzero(np.isfinite(self.grid[..., 0])))


def image_coverage(detected: Sequence[DetectedTarget], size: tuple[int, int]) -> float:
    """Return the part of the image inside the convex hull of all detected points, 0 to 1.

    Parameters
    ----------
    detected : sequence of DetectedTarget
        Detected target patterns.
    size : (int, int)
        Columns and rows of the image.
    """
    points = np.concatenate([np.asarray(line) for each in detected for family in each.families for line in family])
    try:
        hull = ConvexHull(points[np.isfinite(points).all(axis=1)])
    except QhullError:
        return 0.0
    return min(float(hull.volume) / (size[0] * size[1]), 1.0)


# Sigma of the correction [px] above which the model counts as extrapolated. Chosen: a tenth of a pixel, about the
# error of a single measured point of a usual target.
_MAX_CORRECTION_SIGMA_PX = 0.1


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """Calibrated camera model with its detected target patterns.

    Attributes
    ----------
    fit : LensFit or CameraFit
        Fit with parameters, covariance, alternative models and warnings.
    pattern : {"dots", "chessboard", "lines"}
        Target pattern.
    image_size : (int, int)
        Columns and rows of the images.
    detected_targets : tuple of DetectedTarget
        Detected target pattern of each image used.
    skipped_images : tuple of (Path, str)
        Images without a detected target pattern, each with the reason.
    straightness_px : (float, float)
        Root mean square distance of the points from straight lines [px]: of the measured points, and of the points
        corrected by the model.
    """

    fit: LensFit | CameraFit
    pattern: TargetPattern
    image_size: tuple[int, int]
    detected_targets: tuple[DetectedTarget, ...]
    skipped_images: tuple[tuple[Path, str], ...]
    straightness_px: tuple[float, float]

    @property
    def model(self) -> Lens | Camera | None:
        """Model that corrects images and points; None if the lines are straight without a lens."""
        return self.fit.lens if isinstance(self.fit, LensFit) else self.fit.camera

    @property
    def warnings(self) -> tuple[str, ...]:
        """Parameters that the data do not determine, and other doubts."""
        return self.fit.warnings

    @property
    def coverage(self) -> float:
        """Part of the image inside the convex hull of all points, 0 to 1; outside the model is extrapolated."""
        return image_coverage(self.detected_targets, self.image_size)

    @functools.cached_property
    def correction_map(self) -> CorrectionMap:
        """Uncertainty of the correction over the image; extrapolated above 0.1 px or outside the measured points."""
        measured = [line for each in self.detected_targets for family in each.families for line in family]
        return correction_map(self.fit, self.image_size, measured, max_sigma_px=_MAX_CORRECTION_SIGMA_PX)

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of every camera parameter, by name."""
        if isinstance(self.fit, LensFit):
            errors, values = self.fit.uncertainties, dict(zip(self.fit.names, self.fit.values, strict=True))
            return {name: (float(values[name]), error) for name, error in errors.items() if not name.startswith("v")}
        camera = self.fit.camera
        (fx, _, cx), (_, fy, cy), _ = camera.matrix
        known = {
            "f": fx,
            "fx": fx,
            "fy": fy,
            "cx": cx,
            "cy": cy,
            **dict(zip(COEFFICIENT_NAMES, camera.distortion, strict=True)),
        }
        return {name: (known[name], error) for name, error in self.fit.uncertainties.items()}

    @property
    def alternatives(self) -> tuple[AlternativeModel, ...]:
        """Alternative models, fitted to the same points."""
        if isinstance(self.fit, CameraFit):
            return tuple(
                AlternativeModel(each.model, each.rms_px, each.p_value, each.aic, each.centre, each.centre_distance_px)
                for each in self.fit.alternatives
            )
        return tuple(
            AlternativeModel(
                f"{each.model} (lines {each.lines})",
                each.rms_px,
                each.p_value,
                each.aic,
                each.centre,
                each.centre_distance_px,
            )
            for each in self.fit.alternatives
        )

    @property
    def residuals(self) -> tuple[tuple[Float64, Float64], ...]:
        """Per image the measured points (n, 2) and residuals: vectors (n, 2), or distances (n,) from the line [px]."""
        if isinstance(self.fit, CameraFit):
            grids = [each.grid for each in self.detected_targets if each.grid is not None]
            return tuple((grid.reshape(-1, 2), error) for grid, error in zip(grids, self.fit.residuals, strict=True))
        remaining, images = list(self.fit.residuals_px), []
        for each in self.detected_targets:
            distances = [remaining.pop(0) for _ in each.families]
            points = [line for family in each.families for line in family]
            images.append((np.concatenate(points), np.concatenate([line for family in distances for line in family])))
        return tuple(images)

    def summary(self) -> str:
        """Return one line: images and points used, model, residual and straightness."""
        points = sum(each.points for each in self.detected_targets)
        used = len(self.detected_targets)
        before, after = self.straightness_px
        return (
            f"{self.pattern} in {used} of {used + len(self.skipped_images)} images, {points} points "
            f"over {100.0 * self.coverage:.0f} % of the image; "
            f"model {self.fit.model}: residual {self.fit.rms_px:.3g} px rms; deviation from straight lines "
            f"{before:.3g} px, corrected {after:.3g} px; "
            f"the correction is known to {largest_sigma(self.correction_map, inside=True):.2g} px, and extrapolated in "
            f"{100.0 * self.correction_map.extrapolated.mean():.0f} % of the image"
        )

    def report(self) -> dict[str, Any]:
        """Return the calibration as a tree of numbers and strings for JSON."""
        fit = self.fit
        table: dict[str, Any] = {
            "pattern": self.pattern,
            "image_size": list(self.image_size),
            "coverage": self.coverage,
            "model": fit.model,
            "rms_px": fit.rms_px,
            "straightness_px": dict(zip(("measured", "corrected"), self.straightness_px, strict=True)),
            "parameters": {k: {"value": v, "sigma": s} for k, (v, s) in self.parameters.items()},
            "covariance": {"names": list(fit.names), "matrix": fit.covariance.tolist()},
            "alternatives": [each._asdict() for each in self.alternatives],
            "warnings": list(fit.warnings),
            "error_model": fit.error_model,
            "lack_of_fit": fit.lack_of_fit and asdict(fit.lack_of_fit),
            "correction": {
                "max_sigma_px": largest_sigma(self.correction_map, inside=False),
                "max_sigma_inside_px": largest_sigma(self.correction_map, inside=True),
                "extrapolated": float(self.correction_map.extrapolated.mean()),
                "max_allowed_sigma_px": _MAX_CORRECTION_SIGMA_PX,
            },
            "images": [
                {"name": each.image.name, "rms_px": _rms(errors)}
                for each, (_, errors) in zip(self.detected_targets, self.residuals, strict=True)
            ],
            "skipped_images": {path.name: reason for path, reason in self.skipped_images},
        }
        if isinstance(fit, LensFit):
            return table | {"sigma_px": fit.sigma_px, "lines": fit.lines}
        tilt = {"alpha_rad": fit.sensor.alpha, "alpha_sigma_rad": fit.alpha_sigma}
        poses = [{"rotation": p.rotation.tolist(), "translation": p.translation.tolist()} for p in fit.poses]
        return table | {"sigma_px": fit.sigma_px, "tilt": tilt, "poses": poses, "view_p_value": fit.view_p_value}


def _rms(errors: Float64) -> float:
    """Return the root mean square length of residuals (n, 2) or (n,)."""
    return float(np.sqrt(np.nanmean(np.sum(errors.reshape(len(errors), -1) ** 2, axis=1))))
