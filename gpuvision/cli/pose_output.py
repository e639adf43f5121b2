"""Output of the commands that locate something: pose, report and picture, or the reason of a refusal."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from gpuvision.cli.arguments import echo, named_path, prints_report, write_report
from gpuvision.formats.json import report_text

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs

POSE_FILES = ("pose.json", "located.png")
"""Names of the files in the folder of a pose."""

PoseFolder = Annotated[
    Path | None,
    typer.Option(
        "--out",
        metavar="DIR",
        parser=named_path,
        help="Folder for pose.json and the picture located.png. Default: no files.",
    ),
]


class Located(Protocol):
    """Result of a localisation: a pose, or the reason why it was refused."""

    @property
    def reason(self) -> str:
        """Reason of the refusal; empty for a pose."""

    def summary(self) -> str:
        """Return the pose in a few lines."""

    def report(self) -> dict[str, Any]:
        """Return the content of ``pose.json``."""


def report_pose(
    located: Located, draw: Callable[[Path], None], out: Path | None, as_json: Path | None, outputs: Outputs
) -> None:
    """Print a pose and write its report and picture. A refused pose is an error; its picture shows the reason.

    Raises
    ------
    ValueError
        The pose was refused.
    """
    from gpuvision.host.files import write_text_atomic

    report = located.report()
    write_report(as_json, report, outputs)
    shown = ""
    if out is not None:
        with outputs.folder(out) as inside:
            write_text_atomic(inside / "pose.json", report_text(report))
            draw(inside / "located.png")
        shown = f"look at {out / 'located.png'} and {out / 'pose.json'}"
    if located.reason:
        raise ValueError(f"no pose: {located.reason}{'; ' + shown if shown else ''}")
    echo("\n".join(filter(None, (located.summary(), shown))), err=prints_report(as_json))
