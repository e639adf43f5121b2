"""``gpuvision profile --contract``: results of all devices against float64 and against each other."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from gpuvision.cli.arguments import claim_outputs, devices_of, echo, prints_report, write_report

if TYPE_CHECKING:
    from gpuvision.profiling.contract.agreement import Comparison


def profile_contract(names: Sequence[str], labels: Sequence[str], as_json: Path | None, *, overwrite: bool) -> None:
    """Check the limits of the operations that benchmarks measure, and print a line for each output.

    The exit code is 1 if a limit is broken, or if an operation failed.
    """
    from gpuvision.profiling import harness
    from gpuvision.profiling.contract.agreement import check
    from gpuvision.profiling.machine import describe_machine

    outputs = claim_outputs("profile", (), as_json, overwrite=overwrite)
    known = sorted(set(harness.MEASURED.values()))
    for name in names:
        if name not in known:
            raise ValueError(f"no operation {name!r} with a contract; expected some of {', '.join(known)}")
    chosen = [each for each, benchmark in harness.MEASURED.items() if benchmark in (names or known)]
    devices = devices_of(labels)
    found = check(chosen, devices, progress=lambda line: echo(line, err=True))
    report = {"machine": describe_machine(devices), **found.to_dict()}
    write_report(as_json, report, outputs)
    if not prints_report(as_json):
        _show(found.comparisons)
    if found.without:
        echo(f"no contract yet: {', '.join(found.without)}", err=True)
    for each in found.broken:
        place = f"{each.operation}.{each.output} on {each.first} and {each.second}, {each.case}"
        echo(f"broken: {place}: {each.broken} of {each.elements} beyond the limit, {each.fraction:.3g} of it", err=True)
    for failure in found.failures:
        echo(f"failed: {failure.operation} on {failure.device}: {failure.reason}", err=True)
    if found.broken or found.failures:
        raise typer.Exit(1)


def _show(comparisons: Sequence[Comparison]) -> None:
    """Print for each output the largest difference over its limit, from float64 and between devices."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    from gpuvision.profiling.contract.agreement import REFERENCE

    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0), title="largest difference / limit", title_justify="left")
    for heading in ("operation", "output", "elements", "undecided", "from float64", "between devices", "broken"):
        table.add_column(heading, justify="left" if heading in ("operation", "output") else "right", overflow="fold")
    for key in dict.fromkeys((each.operation, each.output) for each in comparisons):
        chosen = [each for each in comparisons if (each.operation, each.output) == key]
        exact = [each for each in chosen if each.second == REFERENCE]
        pairs = [each for each in chosen if each.second != REFERENCE]
        table.add_row(
            *key,
            str(sum(each.elements for each in exact)),
            str(sum(each.undecided for each in exact)),
            *(f"{max(each.fraction for each in some):.2f}" if some else "" for some in (exact, pairs)),
            str(sum(each.broken for each in chosen)),
        )
    Console().print(table)
