"""Types and parsers of command-line arguments that several commands share."""

from __future__ import annotations

import contextlib
import fnmatch
import math
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.host.outputs import Outputs

DeviceLabel = Annotated[
    str | None,
    typer.Option(metavar="LABEL", help="Label of an OpenCL device, see `gpuvision devices`. Default: the best device."),
]

DeviceLabels = Annotated[
    list[str] | None,
    typer.Option(
        metavar="LABEL",
        help="Label of an OpenCL device, see `gpuvision devices`; repeat the option for several. Default: all.",
    ),
]

LayerNames = Annotated[
    list[str] | None,
    typer.Option(
        "--layers",
        metavar="NAME=LAYER",
        help="Layer of a file whose name does not show it, such as `*.gtl=top copper` or `*.gko=mechanical outline`; "
        "repeat the option for every file to read.",
    ),
]


def device_of(label: str | None) -> Device | None:
    """Return the device with a label; None, the best device of a job, without a label.

    Raises
    ------
    GpuVisionError
        No device has the label.
    """
    from gpuvision.host import Device

    return None if label is None else Device.named(label)


def devices_of(labels: Sequence[str] | None) -> list[Device]:
    """Return the devices with these labels; without labels all devices that work.

    Raises
    ------
    GpuVisionError
        No device has a label, or no device works.
    """
    from gpuvision.host import Device

    return [Device.named(label) for label in labels] if labels else list(Device.all() or [Device.best()])


def named_path(text: str | Path) -> Path:
    """Return a path. Reject an empty name: an unset shell variable must not mean the current folder.

    Raises
    ------
    typer.BadParameter
        The name is empty.
    """
    if not str(text):
        raise typer.BadParameter("the name is empty; give one, or . for this folder")
    return Path(text)


def check_exists(path: Path) -> None:
    """Check that an input file exists, before slow imports and reading of other files.

    Raises
    ------
    FileNotFoundError
        The file does not exist.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such file")


ReportFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        parser=named_path,
        help="Also write the report (JSON) to this file; - prints it to standard output, without other text.",
    ),
]


Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Replace existing files that no earlier run of this command wrote, or that were changed since. Input "
        "files are never replaced.",
    ),
]


def echo(text: str, *, err: bool = False) -> None:
    """Print text to standard output or standard error, without the control characters of files and drivers."""
    from gpuvision.host.text import printable

    typer.echo(printable(text), err=err)


def echo_warnings(warnings: Iterable[str], *, err: bool) -> None:
    """Print a line for each warning to standard output or standard error."""
    for each in warnings:
        echo(f"warning: {each}", err=err)


def command_line(*words: object) -> str:
    """Return words of a proposed command, quoted for the shell where they need it."""
    return shlex.join(map(str, words))


def prints_report(path: Path | None) -> bool:
    """Return whether ``--json`` asks for the report on standard output; other text then goes to standard error."""
    return str(path) == "-"


def claim_outputs(
    job: str,
    inputs: Iterable[str | Path | None],
    *targets: Path | tuple[Path | None, Iterable[str]] | None,
    overwrite: bool,
) -> Outputs:
    """Check that the outputs of a job may be written, before the work.

    Parameters
    ----------
    job : str
        Name of the job, such as "scan".
    inputs : iterable of str, Path or None
        Files that the job reads; None is skipped.
    *targets : Path, or tuple of Path and iterable of str
        Output file, or folder with the names of its files, in the order of the checks; without a path, none.
    overwrite : bool
        Whether files may be replaced that no earlier run of the job wrote.

    Raises
    ------
    OSError
        A file cannot be written, is an input, or exists and is no output of the job.
    ValueError
        Two outputs are the same file.
    """
    from gpuvision.host.outputs import Outputs

    outputs = Outputs(job, inputs=[each for each in inputs if each is not None], overwrite=overwrite)
    for target in targets:
        if not isinstance(target, tuple):
            outputs.claim(target)
        elif target[0] is not None:
            outputs.claim_folder(target[0], target[1])
    return outputs


def write_report(path: Path | None, report: object, outputs: Outputs) -> None:
    """Write a report as JSON to the file of ``--json``, whole or not at all; ``-`` is standard output.

    Infinities and NaN become null: JSON has no such numbers.
    """
    from gpuvision.formats.json import json_tree, report_text

    if path is None:
        return
    text = report_text(json_tree(report))
    if prints_report(path):
        typer.echo(text, nl=False)
    else:
        outputs.write_text(path, text)


@contextlib.contextmanager
def progress_bar(description: str) -> Iterator[Callable[[int, int | None], object]]:
    """Show a progress bar on stderr if it is a terminal; yield a function (done, total) that updates it."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from gpuvision.host.text import printable

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(escape(printable(description)), total=None)
        yield lambda done, of: bar.update(task, completed=done, total=of)


def reject_unused(reason: str, **given: object) -> None:
    """Raise an error for an option that was given and would have no effect.

    Parameters
    ----------
    reason : str
        Why the options have no effect, such as "without --second".
    **given : object
        Values by parameter name; None and False mean that the option was not given.

    Raises
    ------
    ValueError
        One of the options was given.
    """
    for name, value in given.items():
        if value is not None and value is not False:
            raise ValueError(f"--{name.replace('_', '-')} has no effect {reason}; leave it out")


_UNITS = {
    "m": {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6},
    "rad": {"": 1.0, "rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180},
    "s": {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6},
}
_NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([a-zµ]*)\s*")


def quantities(text: str, option: str, units: str) -> tuple[float, ...]:
    """Parse comma-separated quantities and return them in metres, radians and seconds.

    Parameters
    ----------
    text : str
        Numbers with optional units, such as "1.5e-3,2mm,90deg". Units: m, cm, mm, um; rad, mrad, deg; s, ms, us.
    option : str
        Name of the option, for the error message.
    units : str
        Expected SI units, such as "m,m,rad".

    Returns
    -------
    tuple of float
        One value per unit [m], [rad] or [s].

    Raises
    ------
    ValueError
        The count or a unit differs from the expected ones, or a number is too large for a float.
    """
    kinds, parts = units.split(","), text.split(",")
    found = [_NUMBER.fullmatch(part) for part in parts]
    if len(parts) == len(kinds):
        known = [each and each[2] in _UNITS[kind] for each, kind in zip(found, kinds, strict=True)]
        if all(known):
            values = tuple(
                float(each[1]) * _UNITS[kind][each[2]] for each, kind in zip(found, kinds, strict=True) if each
            )
            if not all(map(math.isfinite, values)):
                raise ValueError(f"{option} is {text!r}, expected finite numbers")
            return values
    ends = {"m": "m (or cm, mm, um)", "rad": "rad (or mrad, deg)", "s": "s (or ms, us)"}
    expected = ", ".join(ends[kind] for kind in kinds)
    raise ValueError(f"{option} is {text!r}, expected {len(kinds)} number{'s' * (len(kinds) > 1)}: {expected}")


def length_of(text: str | None, option: str) -> float | None:
    """Parse a length [m], see `quantities`; None without the option."""
    return None if text is None else quantities(text, option, "m")[0]


def pose_of(text: str | None, option: str) -> tuple[float, float, float] | None:
    """Parse a pose, x, y [m] and theta [rad], see `quantities`; None without the option."""
    if text is None:
        return None
    x, y, theta = quantities(text, option, "m,m,rad")
    return x, y, theta


def layers_of(given: Sequence[str] | None) -> dict[str, str] | None:
    """Parse the values of ``--layers`` into the mapping that `read_artwork` takes; None without values.

    Raises
    ------
    ValueError
        A value is not of the form NAME=LAYER.
    """
    table = {}
    for each in given or ():
        name, equals, layer = each.partition("=")
        if not (name and equals and layer.strip()):
            raise ValueError(f"--layers is {each!r}, expected a file name or pattern and a layer: '*.gtl=top copper'")
        table[fnmatch.translate(name)] = layer.strip()
    return table or None
