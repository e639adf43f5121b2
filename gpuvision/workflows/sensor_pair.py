"""Two simulated sensors over one sheet of light, and what they are together."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gpuvision.formats.json import json_tree
from gpuvision.host.files import whole_folder
from gpuvision.plots.simulation import draw_causes, draw_errors
from gpuvision.simulation.errors.error_attribution import ErrorAttribution
from gpuvision.simulation.errors.recommendations import DualSensor, attribute_pair_errors, rank
from gpuvision.workflows.simulating import Simulation

_GAP = 2.5  # samples: over wider gaps nothing is read between two of them


@dataclass(frozen=True, kw_only=True)
class SensorPair:
    """What two sensors over one sheet make of a part.

    Attributes
    ----------
    first, second
        Each alone.
    artifacts
        "first", "second" and "both", at common places and judged by what either sees.
    rule
        How they became one.
    limit
        Error from which on a sample counts as wrong [m].
    """

    first: Simulation
    second: Simulation
    artifacts: dict[str, ErrorAttribution]
    rule: DualSensor
    limit: float

    @classmethod
    def of(cls, first: Simulation, second: Simulation, rule: DualSensor) -> SensorPair:
        """Join two simulations of the same profiles.

        Raises
        ------
        ValueError
            The profiles differ, or the first sensor sees no surface.
        """
        if not np.array_equal(first.task.transports, second.task.transports):
            raise ValueError("the two sensors' profiles are not the same; give prepare the first one's transports")
        apart = np.abs(np.diff(first.artifacts.truth.g, axis=-1))
        gap = _GAP * float(np.nanmedian(apart)) if np.isfinite(apart).any() else np.inf
        artifacts = attribute_pair_errors(first.artifacts, second.artifacts, rule, gap=gap)
        return cls(first=first, second=second, artifacts=artifacts, rule=rule, limit=max(first.limit, second.limit))

    def summary(self) -> str:
        """Return how much of the surfaces each reads well, the best first."""
        best = rank(self.artifacts, self.limit)
        told = [f"{each.name} {100 * (1 - each.unread):.1f} % ({100 * each.false:.1f} % false)" for each in best]
        return f"surfaces read within {1e6 * self.limit:.0f} µm: {', '.join(told)}"

    def write(self, folder: str | Path) -> None:
        """Write the second sensor's results into ``second``, and pictures and a report of both into ``both``."""
        self.second.write(Path(folder) / "second")
        both = self.artifacts["both"]
        with whole_folder(Path(folder) / "both") as inside:
            draw_errors(inside / "errors.png", both, "Both sensors")
            draw_causes(inside / "causes.png", both, self.limit, "Both sensors")
            report = {
                "rule": self.rule.rule,
                "limit": self.limit,
                "ranked": [each._asdict() for each in rank(self.artifacts, self.limit)],
                "errors": {name: each.summary(self.limit) for name, each in self.artifacts.items()},
            }
            (inside / "report.json").write_text(json.dumps(json_tree(report), indent=1, allow_nan=False) + "\n")
