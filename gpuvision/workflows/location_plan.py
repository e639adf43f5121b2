"""Plan of the localization of a board: feature sets that were tried, with errors and times, and the chosen one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

from gpuvision.accuracy.plan import AccuracyLimits, AccuracyPlan
from gpuvision.accuracy.trial import millionths
from gpuvision.formats.features_file import write_features
from gpuvision.matching.board.located_board import LocatedBoard
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.ruler import best_smoothing
from gpuvision.validation import finite, integer
from gpuvision.workflows.plan_files import write_plan

_LEGEND = """errors of the pose in um; scatter: with repeated noise; other: residuals that the noise does not explain
- has no pose in too many images (refused), depends on a single feature, or differs from the whole board"""
FEATURES_FILE = "features.toml"
"""Name of the file of the chosen features, which `LocationPlan.write` writes."""


@dataclass(frozen=True, kw_only=True)
class LocationPlanLimits(AccuracyLimits):
    """Limits of `gpuvision.workflows.planning_location.plan_location`; extends `AccuracyLimits`.

    The ``margin`` covers the scatter of 128 poses in two directions, which has a standard deviation of 4.4 %.

    Attributes
    ----------
    rate_margin : float
        Least ratio of the time that rate and latency allow to the upper quartile of the measured time of a frame, at
        least 1. Default 1.15: other work between two frames makes a frame take up to 1.14 times that time (measured).
    max_leverage : float
        Largest leverage of a feature (`gpuvision.BoardPose.leverage`), above 0 to 1. Default 0.7: without the feature,
        the rest still has the share 0.3 of the information that a pose must have
        (`gpuvision.BoardPose.inlier_fraction`).
    max_refused : float
        Largest fraction of the images with additional noise that may have no pose, 0 to 1. Default 0.02.
    draws : int
        Number of images with additional noise that each feature set measures, 8 or more. Default 128.
    """

    rate_margin: float = 1.15
    max_leverage: float = 0.7
    max_refused: float = 0.02
    draws: int = 128

    def __post_init__(self) -> None:
        super().__post_init__()
        finite(self.max_leverage, "LocationPlanLimits.max_leverage", above=0.0, maximum=1.0)
        finite(self.max_refused, "LocationPlanLimits.max_refused", minimum=0.0, maximum=1.0)
        integer(self.draws, "LocationPlanLimits.draws", minimum=8)


class FeaturesTrial(NamedTuple):
    """Feature set that was tried on the image.

    Attributes
    ----------
    features : FeatureSet
        The features.
    seconds, slow_seconds : float
        Median and upper quartile of the time from a frame to its pose [s].
    error : float
        Error of the pose [m]: root mean square distance by which the pose moves the features of the board. It is
        ``scatter`` and ``unexplained`` with an error that all rulers share. NaN without a pose.
    scatter : float
        Scatter of poses in images with additional noise about the poses in the image [m].
    unexplained : float
        Error by residuals that the noise does not explain [m].
    leverage : float
        Largest leverage of a feature in these images: 1 if no other feature checks it.
    refused : float
        Fraction of the images with additional noise that have no pose.
    """

    features: FeatureSet
    seconds: float
    slow_seconds: float
    error: float
    scatter: float
    unexplained: float
    leverage: float
    refused: float

    @property
    def name(self) -> str:
        """Number and width of the rulers, number of fiducials, and the smoothing if it is not the best."""
        imaging, fiducials = self.features.imaging, len(self.features.fiducials.radius)
        parts = [f"{len(self.features.length)} rulers of {imaging.width_px} px"]
        if fiducials:
            parts.append(f"{fiducials} fiducial{'s' if fiducials > 1 else ''}")
        if imaging.smoothing_px < best_smoothing(imaging.blur_px):
            parts.append(f"smoothing {imaging.smoothing_px:.2g} px")
        return ", ".join(parts)

    @property
    def error_parts(self) -> dict[str, float]:
        """Parts of the error by name [m]."""
        return {"scatter": self.scatter, "unexplained": self.unexplained}

    @property
    def legend(self) -> str:
        """Explanation of the columns."""
        return _LEGEND

    def cells(self) -> dict[str, str]:
        """Return the texts of a row of a table by the headings of their columns; the name is the first."""
        headings = ("us/frame", "error", "scatter", "other")
        numbers = map(millionths, (self.seconds, self.error, self.scatter, self.unexplained))
        texts = dict(zip(headings, numbers, strict=True))
        return {"features": self.name, **texts, "leverage": f"{self.leverage:.2f}", "refused": f"{self.refused:.1%}"}

    def to_dict(self) -> dict[str, Any]:
        """Return the columns by name, for JSON."""
        numbers = {name: getattr(self, name) for name in self._fields if name != "features"}
        imaging = self.features.imaging
        return {
            "features": self.name,
            "rulers": len(self.features.length),
            "fiducials": len(self.features.fiducials.radius),
            "width_px": imaging.width_px,
            "smoothing_px": imaging.smoothing_px,
            **numbers,
        }


@dataclass(frozen=True, kw_only=True)
class LocationPlan(AccuracyPlan[FeaturesTrial]):
    """Plan of the localization of a board. ``str(plan)`` states it in one line.

    ``locate_board(image, artwork, features=plan.chosen.features, ...)`` and ``plan.chosen.features.bind(...)`` carry it
    out.

    Attributes
    ----------
    chosen : FeaturesTrial
        Fastest feature set that meets the tolerance.
    trials : tuple of FeaturesTrial
        All feature sets that were tried, fastest first.
    tolerance : float
        Asked error of the pose [m].
    located : LocatedBoard
        Pose of the image, by which the features were selected.
    limits : LocationPlanLimits
        Limits of the plan.
    """

    kind: ClassVar[str] = "feature set"

    located: LocatedBoard
    limits: LocationPlanLimits

    @property
    def usable(self) -> list[FeaturesTrial]:
        """Feature sets that may be chosen."""
        return usable_feature_sets(self.trials, self.limits)

    def write(self, folder: str | Path, *, title: str = "Plan", overwrite: bool = False) -> None:
        """Write ``plan.png`` and ``features.toml`` into a folder, which is created if it is missing.

        The picture shows the predicted errors over the times, the file holds the chosen features for
        ``gpuvision locate --features``.

        Parameters
        ----------
        folder : str or Path
            Output folder.
        title : str
            Title of the picture. Default ``"Plan"``.
        overwrite : bool
            Whether files may be replaced that no earlier plan wrote. Default False.

        Raises
        ------
        FileExistsError
            A file exists, and is not an unchanged output of an earlier plan.
        OSError
            The folder cannot be written.
        """
        chosen = self.chosen.features
        more = {FEATURES_FILE: lambda path: write_features(chosen, path)}
        write_plan(self, folder, error_of="the pose", title=title, overwrite=overwrite, more=more)

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as dictionaries, lists and numbers for JSON."""
        x, y, theta = self.located.pose
        return super().to_dict() | {"pose": {"x": x, "y": y, "theta": theta}}


def usable_feature_sets(trials: Sequence[FeaturesTrial], limits: LocationPlanLimits) -> list[FeaturesTrial]:
    """Return the feature sets with a pose in nearly all images that does not depend on a single feature."""
    return [
        each
        for each in trials
        if each.error > 0.0 and each.refused <= limits.max_refused and each.leverage <= limits.max_leverage
    ]
