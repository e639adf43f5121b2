"""Two simulated sensors over one sheet of light, and the fusion of their readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpuvision.formats.json import json_tree, report_text
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.plots.simulation import PictureScale, draw_causes, draw_errors
from gpuvision.simulation.errors.error_attribution import ErrorAttribution
from gpuvision.simulation.errors.recommendations import rank_candidates
from gpuvision.simulation.errors.sensor_fusion import SensorFusion
from gpuvision.simulation.errors.sensor_pair import attribute_pair_errors
from gpuvision.workflows.simulation_result import Simulation, simulation_files


def pair_files(*, has_mask: bool) -> tuple[str, ...]:
    """Return the names of the files that `SensorPair.write` writes, relative to the folder of the first sensor."""
    both = ("errors.png", "causes.png", "report.json")
    return (*(f"second/{each}" for each in simulation_files(has_mask=has_mask)), *(f"both/{each}" for each in both))


@dataclass(frozen=True, kw_only=True)
class FusionLimits:
    """Limits of the fusion of two sensors.

    Attributes
    ----------
    max_gap : float
        Largest gap between points that is interpolated [median distances of neighbouring samples]. Chosen: one missing
        sample is interpolated, two are not. Default 2.5.
    """

    max_gap: float = 2.5


@dataclass(frozen=True, kw_only=True)
class SensorPair:
    """Simulations of two sensors over one sheet of light, and their fused readings.

    Attributes
    ----------
    first, second
        Simulations of the single sensors.
    errors
        Errors of "first", "second" and "both" at common positions; the truth is every surface that at least one sensor
        sees.
    fusion
        Fusion rule.
    limit
        Error from which on a sample counts as an outlier [m]; the larger one of both simulations.
    """

    first: Simulation
    second: Simulation
    errors: dict[str, ErrorAttribution]
    fusion: SensorFusion
    limit: float

    @classmethod
    def fuse(
        cls, first: Simulation, second: Simulation, fusion: SensorFusion, *, limits: FusionLimits = FusionLimits()
    ) -> SensorPair:
        """Fuse two simulations of the same profiles.

        Parameters
        ----------
        first, second : Simulation
            Simulations with the same transports.
        fusion : SensorFusion
            Fusion rule.
        limits : FusionLimits
            Limits of the interpolation.

        Returns
        -------
        SensorPair

        Raises
        ------
        ValueError
            The transports differ, or the first sensor sees no surface.
        """
        if not np.array_equal(first.task.transports, second.task.transports):
            raise ValueError(
                "the two sensors' profiles are not the same; give prepare_simulation the first one's transports"
            )
        steps = np.abs(np.diff(first.attribution.truth.g, axis=-1))
        max_gap = limits.max_gap * float(np.nanmedian(steps)) if np.isfinite(steps).any() else np.inf
        errors = attribute_pair_errors(first.attribution, second.attribution, fusion, max_gap=max_gap)
        return cls(first=first, second=second, errors=errors, fusion=fusion, limit=max(first.limit, second.limit))

    def summary(self) -> str:
        """Return one line: fractions within the limit and of spurious readings of each sensor and both, best first."""
        parts = [
            f"{each.name} {100 * (1 - each.failed_fraction):.1f} % ({100 * each.spurious_fraction:.1f} % spurious)"
            for each in rank_candidates(self.errors, self.limit)
        ]
        return f"surface samples read within {1e6 * self.limit:.0f} µm: {', '.join(parts)}"

    @property
    def picture_scale(self) -> PictureScale:
        """Scale of the pictures of both sensors and of their fused readings, for comparison."""
        return PictureScale.of([self.first.attribution, self.second.attribution, self.errors["both"]], self.limit)

    def write(self, folder: str | Path, *, inputs: Sequence[str | Path] = (), overwrite: bool = False) -> None:
        """Write the second sensor's results into ``second``, and pictures and a report of both into ``both``.

        Parameters
        ----------
        folder
            Folder of the first sensor's results.
        inputs
            Files that were read, as for `Simulation.write`.
        overwrite
            Whether files may be replaced that no earlier simulation wrote. Default False.

        Raises
        ------
        FileExistsError
            A file exists, and is not an unchanged output of an earlier simulation; see `gpuvision.host.outputs`.
        OSError
            The folders cannot be written.
        """
        self.second.write(Path(folder) / "second", inputs=inputs, overwrite=overwrite, scale=self.picture_scale)
        both = self.errors["both"]
        outputs = Outputs("simulate", inputs=inputs, overwrite=overwrite)
        with outputs.folder(Path(folder) / "both") as inside:
            backward = self.first.moves_backward
            draw_errors(inside / "errors.png", both, "Both sensors", self.picture_scale, backward=backward)
            draw_causes(inside / "causes.png", both, "Both sensors", self.picture_scale, backward=backward)
            report = {
                "rule": self.fusion.rule,
                "limit": self.limit,
                "ranking": [each._asdict() for each in rank_candidates(self.errors, self.limit)],
                "errors": {name: each.summary(self.limit) for name, each in self.errors.items()},
            }
            write_text_atomic(inside / "report.json", report_text(json_tree(report)))
