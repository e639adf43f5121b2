"""``gpuvision locate --tolerance`` and ``--plan``: choose the features of a board for a tolerance."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpuvision.cli.arguments import echo, prints_report, progress_bar, quantities
from gpuvision.cli.plan_output import claim_plan, report_plan, show_refused

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs
    from gpuvision.matching.artwork.artwork import Artwork
    from gpuvision.workflows.location_plan import LocationPlan


def claim_location_plan(
    tolerance: str | None, inputs: Iterable[Path | None], out: Path | None, as_json: Path | None, *, overwrite: bool
) -> Outputs:
    """Check ``--plan``: it needs a tolerance, and its files may be written.

    Raises
    ------
    ValueError
        There is no tolerance.
    OSError
        A file cannot be written, is an input, or exists and is no output of a plan.
    """
    from gpuvision.workflows.location_plan import FEATURES_FILE

    if tolerance is None:
        raise ValueError("--plan needs --tolerance, the largest error of the pose, such as 2um")
    files = [each for each in inputs if each is not None]
    return claim_plan(out, as_json, files, overwrite=overwrite, more=(FEATURES_FILE,))


def make_location_plan(
    image: Path, picture: Any, artwork: Artwork, tolerance: str, rate: float | None, options: Mapping[str, Any]
) -> LocationPlan:
    """Plan a localization for the text of ``--tolerance``, with a progress bar."""
    from gpuvision.workflows.planning_location import plan_location

    (largest,) = quantities(tolerance, "--tolerance", "m")
    with progress_bar(f"planning {image.name}") as progress, show_refused():
        return plan_location(picture, artwork, tolerance=largest, rate=rate, progress=progress, **options)


def write_location_plan(
    plan: LocationPlan, image: Path, out: Path | None, as_json: Path | None, outputs: Outputs, *, overwrite: bool
) -> None:
    """Print a plan, and write its picture, its features and its report."""
    from gpuvision.workflows.location_plan import FEATURES_FILE

    if out is not None:
        plan.write(out, title=image.name, overwrite=overwrite)
    report_plan(plan, out, as_json, outputs)
    if out is not None:
        echo(f"next: give --features {out / FEATURES_FILE} instead of --tolerance", err=prints_report(as_json))
