"""Output of the commands that locate something: pose, report and picture, or the reason of a refusal."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import typer

from gpuvision.cli.arguments import echo, named_path, prints_report, quantities, write_report
from gpuvision.formats.json import report_text

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs

_FILES = ("pose.json", "located.png")

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


def check_image(path: Path) -> None:
    """Check that the input file exists, before slow imports and reading of other files.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")


def initial_pose_of(text: str | None) -> tuple[float, float, float] | None:
    """Parse ``--initial-pose``: x, y [m] and theta [rad]; None without the option."""
    if text is None:
        return None
    x, y, theta = quantities(text, "--initial-pose", "m,m,rad")
    return x, y, theta


def claim_outputs(
    job: str, inputs: Iterable[str | Path | None], out: Path | None, as_json: Path | None, overwrite: bool
) -> Outputs:
    """Check that the files of ``--out`` and ``--json`` may be written, before the work.

    Raises
    ------
    OSError
        A file cannot be written, is an input, or exists and is no output of the command.
    """
    from gpuvision.host.outputs import Outputs

    outputs = Outputs(job, inputs=[each for each in inputs if each is not None], overwrite=overwrite)
    outputs.claim(as_json)
    if out is not None:
        outputs.claim_folder(out, _FILES)
    return outputs


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
