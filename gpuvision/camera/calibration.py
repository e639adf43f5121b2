"""Result of a camera calibration from images of a flat pattern."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.lens import Lens
from gpuvision.camera.lines.lens_fit import LensFit
from gpuvision.camera.patterns.pattern import LineFamilies
from gpuvision.camera.views.camera_fit import CameraFit

Pattern = Literal["dots", "chessboard", "lines"]
Float64: TypeAlias = npt.NDArray[np.float64]


class Other(NamedTuple):
    """A model that was fitted too.

    Attributes
    ----------
    model
        Its name.
    rms_px
        Root mean square residual.
    p_value
        Probability of so much a worse fit than the largest model's, were this one true (F test).
    aic
        Akaike's criterion; only differences tell.
    centre
        (column, row) of its centre; None without a lens.
    apart_px
        How far that lies from the chosen model's; NaN without a lens.
    """

    model: str
    rms_px: float
    p_value: float
    aic: float
    centre: tuple[float, float] | None
    apart_px: float


class Seen(NamedTuple):
    """The pattern in one image.

    Attributes
    ----------
    image
        Its file.
    grid
        (rows, columns, 2) [px], NaN where missing; None for a pattern of lines.
    families
        Its straight lines.
    """

    image: Path
    grid: Float64 | None
    families: LineFamilies

    @property
    def points(self) -> int:
        """Number of points."""
        if self.grid is None:
            return sum(len(line) for family in self.families for line in family)
        return int(np.count_nonzero(np.isfinite(self.grid[..., 0])))


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """A camera model and what it was found from.

    Attributes
    ----------
    fit
        The fit, with parameters, covariance, alternatives and warnings.
    pattern
        What was looked for.
    image_size
        (columns, rows) of the images.
    seen
        The pattern in each image where it was found.
    passed_over
        Images without it, and why.
    straightness_px
        Root mean square distance of the points from straight lines: as measured, and corrected by the model.
    """

    fit: LensFit | CameraFit
    pattern: Pattern
    image_size: tuple[int, int]
    seen: tuple[Seen, ...]
    passed_over: tuple[tuple[Path, str], ...]
    straightness_px: tuple[float, float]

    @property
    def model(self) -> Lens | Camera | None:
        """What corrects images and points; None where lines are straight without."""
        return self.fit.lens if isinstance(self.fit, LensFit) else self.fit.camera

    @property
    def parameters(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of every parameter of the camera, by its name."""
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
    def alternatives(self) -> tuple[Other, ...]:
        """Other models, fitted to the same points."""
        if isinstance(self.fit, CameraFit):
            return tuple(
                Other(each.model, each.rms_px, each.p_value, each.aic, each.centre, each.apart_px)
                for each in self.fit.alternatives
            )
        return tuple(
            Other(
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
        """Per image the measured points (n, 2), and how far each lies off: (n, 2), or (n,) from its line [px]."""
        if isinstance(self.fit, CameraFit):
            grids = [each.grid for each in self.seen if each.grid is not None]
            return tuple((grid.reshape(-1, 2), off) for grid, off in zip(grids, self.fit.residuals, strict=True))
        left, parts = list(self.fit.residuals_px), []
        for each in self.seen:
            mine = [left.pop(0) for _ in each.families]
            points = [line for family in each.families for line in family]
            parts.append((np.concatenate(points), np.concatenate([off for family in mine for off in family])))
        return tuple(parts)

    def summary(self) -> str:
        """Return a line: what was found, how well."""
        points = sum(each.points for each in self.seen)
        before, after = self.straightness_px
        return (
            f"{self.pattern} in {len(self.seen)} of {len(self.seen) + len(self.passed_over)} images, {points} points; "
            f"model {self.fit.model}: residual {self.fit.rms_px:.3g} px rms; lines bent by {before:.3g} px, "
            f"corrected {after:.3g} px"
        )

    def report(self) -> dict[str, Any]:
        """Everything in plain numbers and strings, as JSON holds them."""
        fit = self.fit
        table: dict[str, Any] = {
            "pattern": self.pattern,
            "image_size": list(self.image_size),
            "model": fit.model,
            "rms_px": fit.rms_px,
            "straightness_px": dict(zip(("measured", "corrected"), self.straightness_px, strict=True)),
            "parameters": {k: {"value": v, "sigma": s} for k, (v, s) in self.parameters.items()},
            "covariance": {"names": list(fit.names), "matrix": fit.covariance.tolist()},
            "alternatives": [each._asdict() for each in self.alternatives],
            "warnings": list(fit.warnings),
            "images": [
                {"name": each.image.name, "rms_px": _rms(off)}
                for each, (_, off) in zip(self.seen, self.residuals, strict=True)
            ],
            "passed_over": {path.name: why for path, why in self.passed_over},
        }
        if isinstance(fit, LensFit):
            return table | {"sigma_px": fit.sigma_px, "lines": fit.lines}
        tilt = {"alpha_rad": fit.sensor.alpha, "alpha_sigma_rad": fit.alpha_sigma}
        poses = [{"rotation": p.rotation.tolist(), "translation": p.translation.tolist()} for p in fit.poses]
        return table | {"sigma_px": fit.sigma, "tilt": tilt, "poses": poses}


def _rms(off: Float64) -> float:
    """Root mean square size of residuals (n, 2) or (n,)."""
    return float(np.sqrt(np.nanmean(np.sum(off.reshape(len(off), -1) ** 2, axis=1))))
