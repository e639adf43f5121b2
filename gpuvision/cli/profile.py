"""``gpuvision profile``: measure operations side by side with their peers on this machine."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import typer

from gpuvision.cli.arguments import (
    DeviceLabels,
    Overwrite,
    ReportFile,
    devices_of,
    echo,
    named_path,
    prints_report,
    reject_unused,
)
from gpuvision.host.errors import GpuVisionError

if TYPE_CHECKING:
    from gpuvision.host.outputs import Outputs
    from gpuvision.profiling.run import Row, Run

_SECONDS, _QUICK_SECONDS = 2.0, 0.3  # longest time to measure a case [s]
_MINUTES, _QUICK_MINUTES = 20.0, 3.0
_MEMORY_MIB = 256.0
# Options that have an effect with an option that measures something else, or nothing; --overwrite always has.
_TAKEN = {
    "offline": ("json", "one_build"),
    "from": ("plots", "html"),
    "contract": ("device", "json"),
    "growth": ("device", "json", "plots", "memory_mib"),
}
_NO_PLOTS = (
    "no plots: no series over size or tolerance, no declared operations; try light_clustering, reflections or psd"
)


Operations = Annotated[
    list[str] | None,
    typer.Argument(metavar="OPERATION", help="Operations to measure, such as psd or line. Default: all."),
]
Seconds = Annotated[
    float | None,
    typer.Option(help="Longest time to measure each case [s]. Default: 2, with --quick 0.3.", min=0.01),
]
Minutes = Annotated[
    float | None,
    typer.Option(
        help="Approximate time of the whole run [min]; cases are measured for a shorter time if the run would take "
        "longer. Default: 20, with --quick 3.",
        min=0.01,
    ),
]
Quick = Annotated[bool, typer.Option("--quick", help="Measure only one case of each operation, on the default device.")]
PlotFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        parser=named_path,
        help="Folder for plots: a roofline, time and error over the amount of work and over the tolerance.",
    ),
]
PageFolder = Annotated[
    Path | None,
    typer.Option(
        metavar="DIR",
        parser=named_path,
        help="Folder for profile.html: a page with machine, peers, figures and all rows, which needs no network.",
    ),
]
StoredRun = Annotated[
    Path | None,
    typer.Option(
        "--from",
        metavar="FILE",
        parser=named_path,
        help="Make the page or the plots from a file of --json instead of measuring.",
    ),
]
Targets = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TARGET",
        help="Compile the kernels for this GPU (sm_70, sm_90, gfx90a, gfx1100), which need not be present, instead "
        "of measuring; repeat the option for several. OPERATION then names kernel files, such as line or pose.",
    ),
]
OneBuild = Annotated[
    bool, typer.Option("--one-build", help="With --offline: compile only the first build of each kernel file.")
]
Growth = Annotated[
    bool,
    typer.Option(
        "--growth",
        help="Measure the time against the size instead of against peers, from one item to --memory-mib.",
    ),
]
MemoryMib = Annotated[
    float | None,
    typer.Option(help="With --growth: largest memory of inputs and outputs [MiB]. Default: 256.", min=0.001),
]
Contract = Annotated[
    bool,
    typer.Option(
        "--contract",
        help="Compare the results of all devices with float64 and with each other, by the stated limits, instead "
        "of measuring times.",
    ),
]


def profile(
    operations: Operations = None,
    device: DeviceLabels = None,
    seconds: Seconds = None,
    minutes: Minutes = None,
    quick: Quick = False,
    as_json: ReportFile = None,
    plots: PlotFolder = None,
    html: PageFolder = None,
    stored: StoredRun = None,
    offline: Targets = None,
    one_build: OneBuild = False,
    growth: Growth = False,
    memory_mib: MemoryMib = None,
    contract: Contract = False,
    overwrite: Overwrite = False,
) -> None:
    """Measure operations against their peers: NumPy, Numba, OpenCV.

    Candidates run interleaved. Below the time of a call stands the time of its kernels on the device, in parentheses,
    from the events of the OpenCL runtime. The ratio is the time of the peer over the time of gpuvision, with its 95 %
    confidence interval. The FLOP rate of the device is measured before and after each operation; a run during which it
    changed is marked invalid, and the exit code is 1. If the measurement of an operation fails, the
    others are still measured; the report names the operation and the reason, and the exit code is 1.

    With --html DIR the run is also written as a page; with --from FILE the page shows a stored run.

    With --growth each operation is measured without peers, with 1, 4, 16, ... items. The report states the time of one
    item, the shortest time, and the rates of the largest size. It also states two numbers of items: where a call takes
    twice the shortest time, and where inputs and outputs exceed the largest cache.

    With --contract no times are measured. Each public operation runs on a corpus of seeded inputs on each device. The
    table shows the largest difference from float64 and between devices, as a fraction of the limit that the operation
    states. Integer results are equal. Samples whose decision lies within rounding of a threshold are counted as
    undecided and not compared. The exit code is 1 if a limit is broken.

    With --offline nothing is measured: the kernels are compiled for GPUs by Clang and NVIDIA's ptxas. The table shows
    the registers, stack, spilled registers and local memory of each kernel. The exit code is 1 if a kernel does not
    compile, calls a function without a body, spills more registers than the limit, or takes more than 5 KiB of stack
    or 32 KiB of local memory.
    """
    given = {"device": device or None, "seconds": seconds, "minutes": minutes, "quick": quick, "json": as_json}
    given |= {"plots": plots, "html": html, "one_build": one_build, "memory_mib": memory_mib}
    modes = {"offline": offline or None, "from": stored, "contract": contract, "growth": growth}
    _reject_unused(modes, given)
    names, labels, pictures = operations or (), device or (), _Pictures(plots, html, overwrite)
    if offline:
        from gpuvision.cli.profile_offline import profile_offline

        profile_offline(offline, names, as_json, one_build=one_build, overwrite=overwrite)
    elif stored is not None:
        if names:
            raise ValueError("OPERATION has no effect with --from; leave it out")
        pictures.write_stored(stored)
    elif importlib.util.find_spec("numba") is None:
        raise GpuVisionError("the peer numba is missing; install it: pip install 'gpuvision[profile]'")
    elif contract:
        from gpuvision.cli.profile_contract import profile_contract

        profile_contract(names, labels, as_json, overwrite=overwrite)
    elif growth:
        from gpuvision.cli.profile_growth import profile_growth

        profile_growth(names, labels, memory_mib or _MEMORY_MIB, as_json, plots, overwrite=overwrite)
    else:
        seconds = seconds or (_QUICK_SECONDS if quick else _SECONDS)
        minutes = minutes or (_QUICK_MINUTES if quick else _MINUTES)
        _measure(names, labels, pictures, as_json, seconds=seconds, minutes=minutes, quick=quick)


def _reject_unused(modes: Mapping[str, object], given: Mapping[str, object]) -> None:
    """Refuse the options that the mode of the command does not take.

    Parameters
    ----------
    modes : mapping of str to object
        Values of the options that choose a mode, by name; the first one that is given counts.
    given : mapping of str to object
        Values of the other options.

    Raises
    ------
    ValueError
        An option has no effect.
    """
    mode = next((name for name, value in modes.items() if value not in (None, False)), None)
    if mode != "offline":
        reject_unused("without --offline", one_build=given["one_build"])
    if mode is None:
        reject_unused("without --growth", memory_mib=given["memory_mib"])
        return
    unused = {name: value for name, value in {**given, **modes}.items() if name not in (mode, *_TAKEN[mode])}
    reject_unused(f"with --{mode}", **unused)


def _measure(
    operations: Sequence[str],
    labels: Sequence[str],
    pictures: _Pictures,
    as_json: Path | None,
    *,
    seconds: float,
    minutes: float,
    quick: bool,
) -> None:
    """Measure operations against their peers, show and write the run."""
    from gpuvision.host import Device
    from gpuvision.host.outputs import Outputs
    from gpuvision.profiling import harness

    outputs = Outputs("profile", overwrite=pictures.overwrite)
    outputs.claim(as_json)
    pictures.claim(outputs)
    for name in operations:
        if name not in harness.OPERATIONS:
            raise ValueError(f"no operation {name!r} to profile; expected some of {', '.join(harness.OPERATIONS)}")
    devices = [Device.best()] if quick and not labels else devices_of(labels)
    run = harness.profile(
        operations or list(harness.OPERATIONS),
        devices,
        seconds=seconds,
        total=60.0 * minutes,
        quick=quick,
        progress=lambda line: echo(line, err=True),
    )
    if prints_report(as_json):
        typer.echo(run.to_json(), nl=False)
    elif as_json is not None:
        run.write(as_json, overwrite=pictures.overwrite)
    _show(list(run.rows), to_stderr=prints_report(as_json))
    for line in _speeds(run):
        echo(line, err=True)
    pictures.write(run)
    if not run.valid:
        echo("not valid: the machine changed its speed during the measurement; run the command again", err=True)
    for failure in run.failures:
        echo(f"not measured: {failure.operation} on {failure.device}: {failure.reason}", err=True)
    if run.failures or not run.valid:
        raise typer.Exit(1)


class _Pictures(NamedTuple):
    """Folders of ``--plots`` and ``--html``."""

    plots: Path | None
    html: Path | None
    overwrite: bool

    def claim(self, outputs: Outputs) -> None:
        """Check the files before the measurement."""
        if self.plots is not None:
            from gpuvision.profiling.plots import PLOTS

            outputs.claim_folder(self.plots, PLOTS)
        if self.html is not None:
            if importlib.util.find_spec("jinja2") is None:
                raise GpuVisionError("the page needs jinja2; install it: pip install 'gpuvision[profile]'")
            from gpuvision.profiling.page import PAGE_FILE

            outputs.claim_folder(self.html, (PAGE_FILE,))

    def write(self, run: Run) -> None:
        """Draw the plots and write the page."""
        if self.plots is not None:
            from gpuvision.profiling.plots import draw_plots

            drawn = draw_plots(self.plots, run.rows, run.machine, overwrite=self.overwrite)
            echo(f"look at {', '.join(str(self.plots / name) for name in drawn)}" if drawn else _NO_PLOTS, err=True)
        if self.html is not None:
            from gpuvision.profiling.page import write_page

            echo(f"look at {write_page(self.html, run, overwrite=self.overwrite)}", err=True)

    def write_stored(self, path: Path) -> None:
        """Draw the plots and write the page of a stored run."""
        from gpuvision.host.outputs import Outputs
        from gpuvision.profiling.stored_run import read_run

        if self.plots is None and self.html is None:
            raise ValueError("--from has no effect without --html or --plots; give a folder")
        self.claim(Outputs("profile", inputs=[path], overwrite=self.overwrite))
        self.write(read_run(path))


def _show(rows: list[Row], to_stderr: bool) -> None:
    """Print a table for each operation, narrow enough for a terminal of 80 columns."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    console = Console(stderr=to_stderr)
    for operation in dict.fromkeys(each.operation for each in rows):
        table = Table(title=operation, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for heading in ("case", "device", "time", "peer", "peer time", "ratio", "error", "ceiling"):
            words = heading in ("case", "device", "peer")
            table.add_column(heading, justify="left" if words else "right", no_wrap=heading != "case", overflow="fold")
        for each in rows:
            if each.operation == operation:
                table.add_row(*_cells(each))
        console.print(table)
        for line in dict.fromkeys(
            _metadata_line(each) for each in rows if each.operation == operation and each.metadata
        ):
            console.print(line, highlight=False, markup=False)


def _speeds(run: Run) -> list[str]:
    """Return the trace of the speed probe: a line for each device, and one for each section that was not steady."""
    lines = []
    for device in dict.fromkeys(probe.device for probe in run.probes):
        rates = [1e-9 * rate for probe in run.probes if probe.device == device for rate in (probe.before, probe.after)]
        trace = " ".join(f"{rate:.0f}" for rate in rates)
        lines.append(f"speed of {device} before and after each operation [GFLOP/s]: {trace}")
    for probe in run.probes:
        if not probe.steady:
            change = f"{1e-9 * probe.before:.0f} -> {1e-9 * probe.after:.0f} GFLOP/s"
            lines.append(f"not steady: {probe.operation} on {probe.device}, {change}")
    return lines


def _metadata_line(row: Row) -> str:
    return f" {row.case} on {row.device}: " + ", ".join(f"{name} {value}" for name, value in row.metadata.items())


def _cells(row: Row) -> tuple[str, ...]:
    fraction = "" if row.fraction is None else f"{100 * row.fraction:.0f} %"
    peer = f"{row.peer}\n({row.form})" if row.form else row.peer
    kernels = "" if row.device_seconds is None else f"\n({_time(row.device_seconds)})"
    times = (_time(row.seconds) + kernels, peer, _time(row.peer_seconds))
    return row.case, row.device, *times, _ratio(row), f"{row.error:.1e}", fraction


def _ratio(row: Row) -> str:
    """Return the ratio, and the larger half of its interval unless this has less than 95 % confidence."""
    if row.interval is None:
        return f"{row.ratio:.2f}"
    half = max(row.interval[1] - row.ratio, row.ratio - row.interval[0])
    return f"{row.ratio:.2f} ±{100 * half / row.ratio:.0f}%"


def _time(seconds: float) -> str:
    unit, name = next(
        each for each in ((1.0, "s"), (1e-3, "ms"), (1e-6, "µs")) if seconds >= each[0] or each[0] == 1e-6
    )
    return f"{seconds / unit:.3g} {name}"
