"""``gpuvision tune``: find faster settings of the operations on this machine, and keep them in the user's cache."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import (
    DeviceLabels,
    Overwrite,
    ReportFile,
    claim_outputs,
    devices_of,
    echo,
    prints_report,
    write_report,
)

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.host.tuning import TuningResult

# Size classes of 4^5 = 1024 to 4^11 = 4 million elements (chosen).
_CLASSES = range(5, 11)


def tune(
    operations: Annotated[
        list[str] | None,
        typer.Argument(metavar="OPERATION", help="Operations to tune, such as psd or points. Default: all."),
    ] = None,
    device: DeviceLabels = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Measure and print, but keep nothing.")] = False,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Find faster settings of the operations on this machine: work-group sizes, strips, kernel variants.

    Each operation is timed on inputs of about 2400 to 2.4 million elements. Settings win only if their results are the
    results of the defaults, and if they are faster by more than the measured spread. The winners are kept in the cache
    folder of gpuvision. Every operation of the same configuration (class, kernel, build options, types of input and
    results) that is bound later uses them, until the driver or the version of gpuvision changes. Other configurations,
    for example a PSD with a triangulation, keep the defaults. GPUVISION_TUNING=off ignores the settings.
    """
    from gpuvision.profiling import tuning_inputs

    for name in operations or ():
        if name not in tuning_inputs.NAMES:
            raise ValueError(f"no operation {name!r} to tune; expected some of {', '.join(tuning_inputs.NAMES)}")
    outputs = claim_outputs("tune", (), as_json, overwrite=overwrite)
    devices = devices_of(device)
    results: list[TuningResult] = []
    try:
        _tune_all(devices, operations or tuning_inputs.NAMES, results, keeps=not dry_run)
    finally:  # also what was measured before an error
        write_report(as_json, [_described(each) for each in results], outputs)
        _show(results, to_stderr=prints_report(as_json))


def _tune_all(
    devices: Sequence[Device], operations: Sequence[str], results: list[TuningResult], *, keeps: bool
) -> None:
    """Tune operations on devices, append the results, and keep the winners."""
    from gpuvision.host.tuned_settings import DEFAULTS, keep_entries
    from gpuvision.host.tuning import tune as tuned
    from gpuvision.profiling import tuning_inputs

    for each in devices:
        for name in operations:
            echo(f"{name} on {each.label}", err=True)
            found: list[TuningResult] = []
            for operation, make in tuning_inputs.cases(name):
                is_possible = each.has_double or make(2)[0].dtype != "float64"
                found += [tuned(operation, make, each, size) for size in _CLASSES if is_possible]
            results += found
            if keeps:
                # After each operation, so that an interrupted command keeps the winners found so far.
                entries = [result.entry for result in found]
                winners = [entry for entry in entries if entry.settings != DEFAULTS]
                echo(f"kept in {keep_entries(winners, [entry.key for entry in entries])}", err=True)


def _described(result: TuningResult) -> dict[str, object]:
    return {
        "operation": result.operation,
        "dtype": result.dtype,
        "device": result.device,
        "elements": result.elements,
        "default_seconds": result.default_seconds,
        "best_seconds": result.best_seconds,
        "gain": result.gain,
        "spread": result.spread,
        "settings": asdict(result.best),
        "rejected": {str(settings): reason for settings, reason in result.rejected.items()},
    }


def _show(results: list[TuningResult], *, to_stderr: bool) -> None:
    """Print the table; below it the settings that failed."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD)
    for heading in ("operation", "type", "elements", "device"):
        table.add_column(heading, no_wrap=True)
    for heading in ("default [us]", "best [us]", "gain"):
        table.add_column(heading, justify="right", no_wrap=True)
    table.add_column("settings")
    for each in results:
        times = [f"{1e6 * seconds:.3g}" for seconds in (each.default_seconds, each.best_seconds)]
        names = (each.operation, each.dtype, str(each.elements), each.device)
        table.add_row(*names, *times, f"{each.gain:.2f}", str(each.best))
    Console(width=120, stderr=to_stderr).print(table)
    for each in results:
        for settings, reason in each.rejected.items():
            case = f"{each.operation} {each.dtype} {each.elements} on {each.device}"
            echo(f"rejected: {case}, {settings}: {reason}", err=True)
