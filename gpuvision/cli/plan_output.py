"""Options and output of plans: ``--tolerance``, ``--plan``, the table of the tried settings, picture and report."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gpuvision.cli.arguments import claim_outputs, echo, prints_report, progress_bar, quantities, write_report

if TYPE_CHECKING:
    from gpuvision.accuracy.plan import AccuracyPlan
    from gpuvision.host.outputs import Outputs


def planned_tolerance(text: str | None, error_of: str, *, only_plan: bool) -> float | None:
    """Return the length of ``--tolerance`` [m]; None without the option.

    Parameters
    ----------
    text : str or None
        Value of the option.
    error_of : str
        Result whose error it limits, with an example, for the message: "the pose, such as 2um".
    only_plan : bool
        Whether ``--plan`` is given, which needs a tolerance.

    Raises
    ------
    ValueError
        ``--plan`` has no tolerance, or the tolerance is no length above 0.
    """
    if text is None:
        if only_plan:
            raise ValueError(f"--plan needs --tolerance, the largest error of {error_of}")
        return None
    (found,) = quantities(text, "--tolerance", "m")
    if found <= 0.0:
        raise ValueError(f"--tolerance is {text!r}, expected a length above 0")
    return found


def claim_plan(
    out: Path | None,
    as_json: Path | None,
    inputs: Sequence[str | Path | None],
    *,
    overwrite: bool,
    more: Sequence[str] = (),
) -> Outputs:
    """Check that the files of a plan may be written, before it is made.

    Parameters
    ----------
    out : Path or None
        Folder of the picture; None: no picture.
    as_json : Path or None
        File of the report.
    inputs : sequence of str, Path or None
        Files that are read; None is skipped.
    overwrite : bool
        Whether a file may be replaced that no earlier plan wrote.
    more : sequence of str
        Names of other files in the folder. Default: none.
    """
    from gpuvision.workflows.plan_files import PLAN_FILE

    return claim_outputs("plan", inputs, (out, (PLAN_FILE, *more)), as_json, overwrite=overwrite)


@contextmanager
def planning(description: str) -> Iterator[Callable[[int, int | None], object]]:
    """Show a progress bar of a plan, as `progress_bar`; print the settings that were tried if the plan is refused."""
    from gpuvision.accuracy.plan import PlanError

    try:
        with progress_bar(f"planning {description}") as progress:
            yield progress
    except PlanError as refusal:
        echo(refusal.table(), err=True)
        raise


def report_plan(plan: AccuracyPlan[Any], out: Path | None, as_json: Path | None, outputs: Outputs) -> None:
    """Print a plan, whose picture is in the folder `out`, and write its report."""
    from gpuvision.workflows.plan_files import PLAN_FILE

    write_report(as_json, plan.to_dict(), outputs)
    shown = () if out is None else (f"look at {out / PLAN_FILE}",)
    echo("\n".join([plan.table(), str(plan), *shown]), err=prints_report(as_json))
