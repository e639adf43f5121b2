"""``gpuvision profile --offline``: compile the kernels for GPUs that need not be present."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gpuvision.cli.arguments import claim_outputs, echo, prints_report, progress_bar

if TYPE_CHECKING:
    from gpuvision.profiling.offline.builds import KernelBuild
    from gpuvision.profiling.offline.check import OfflineReport, OfflineRow


def profile_offline(
    names: Sequence[str], kernels: Sequence[str], as_json: Path | None, *, one_build: bool, overwrite: bool
) -> None:
    """Compile the kernels for targets, print the table, and exit with 1 if a kernel fails the check."""
    from gpuvision.profiling.offline.check import check_builds, one_build_each
    from gpuvision.profiling.offline.registry import all_builds
    from gpuvision.profiling.offline.targets import TARGETS

    outputs = claim_outputs("profile", (), as_json, overwrite=overwrite)
    for name in names:
        if name not in TARGETS:
            raise ValueError(f"no target {name!r} to compile for; expected some of {', '.join(TARGETS)}")
    builds = _chosen(all_builds(), kernels)
    with progress_bar("compiling") as progress:
        report = check_builds(
            one_build_each(builds) if one_build else builds,
            [TARGETS[name] for name in dict.fromkeys(names)],
            progress=progress,
        )
    if prints_report(as_json):
        typer.echo(report.to_json(), nl=False)
    elif as_json is not None:
        outputs.write_text(as_json, report.to_json())
    _show(report, to_stderr=prints_report(as_json))
    for row in report.faults:
        echo(f"{row.target}: {row.source} ({row.case}) {row.kernel}: {row.fault}", err=True)
    if report.faults:
        raise typer.Exit(1)


def _chosen(builds: Sequence[KernelBuild], kernels: Sequence[str]) -> list[KernelBuild]:
    """Return the builds of kernels by the name of their file; all builds if no kernel is named."""
    known = dict.fromkeys(Path(build.source).stem for build in builds)
    for name in kernels:
        if name not in known:
            raise ValueError(f"no kernel {name!r} to compile; expected some of {', '.join(known)}")
    return [build for build in builds if not kernels or Path(build.source).stem in kernels]


def _show(report: OfflineReport, *, to_stderr: bool) -> None:
    """Print a table for each target: the range of each number over the builds of a kernel."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console(stderr=to_stderr)
    for target in report.compilers:
        table = Table(title=target, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column("kernel")
        for heading in ("builds", "registers", "stack [B]", "spills [B]", "local [B]"):
            table.add_column(heading, justify="right", no_wrap=True)
        compiled = [row for row in report.rows if row.target == target and row.usage is not None]
        for kernel in dict.fromkeys(row.kernel for row in compiled):
            table.add_row(kernel, *_cells([row for row in compiled if row.kernel == kernel]))
        console.print(table)


def _cells(rows: Sequence[OfflineRow]) -> tuple[str, ...]:
    usages = [row.usage for row in rows if row.usage is not None]
    columns = [[getattr(each, name) for each in usages] for name in ("registers", "stack", "spills", "local")]
    return str(len(rows)), *(
        f"{min(each)} to {max(each)}" if min(each) < max(each) else f"{min(each)}" for each in columns
    )
