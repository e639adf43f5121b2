"""``gpuvision scan``: compute a range image, pictures and a report from a recording."""

from __future__ import annotations

import os
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import (
    DeviceLabel,
    Overwrite,
    ReportFile,
    claim_outputs,
    device_of,
    echo,
    echo_warnings,
    named_path,
    prints_report,
    progress_bar,
    reject_unused,
    write_report,
)
from gpuvision.cli.plan_output import claim_plan, planned_tolerance, planning, report_plan

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.workflows.scan_plan import ScanPlan
    from gpuvision.workflows.scan_result import Scan


class Precision(StrEnum):
    """Values of ``--precision``."""

    single = "single"
    double = "double"


class QueuePolicy(StrEnum):
    """Values of ``--policy``."""

    block = "block"
    drop_oldest = "drop_oldest"
    stop = "raise"


class SurfaceFile(StrEnum):
    """Values of ``--format``."""

    x3p = "x3p"
    sur = "sur"
    sdf = "sdf"
    sdf_ascii = "sdf-ascii"


class PlyPoints(StrEnum):
    """Values of ``--ply``."""

    organised = "organised"
    valid = "valid"


Recording = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        parser=named_path,
        help="Camera recording: video, TIFF stack, folder of images, or NPY array (frames, rows, columns). "
        "PSD recording: NPY array (frames, strips, 2).",
    ),
]
SensorFile = Annotated[
    str, typer.Option(metavar="SENSOR", help="Sensor file (TOML), or a preset: camera_line, corner_scene, psd_line.")
]
Results = Annotated[
    Path,
    typer.Option(metavar="DIR", parser=named_path, help="Folder for the range image, the pictures and report.json."),
]
Rate = Annotated[
    float | None, typer.Option(help="Replay the recording at this rate [frames/s]. Default: as fast as possible.")
]
RoomPolicy = Annotated[
    QueuePolicy | None,
    typer.Option(
        help="If the frame queue is full: block the recording (default), drop the oldest frame (default with "
        "--rate), or raise an error."
    ),
]
SurfaceFiles = Annotated[
    list[SurfaceFile] | None,
    typer.Option(
        "--format",
        help="Also write the height map for surface metrology programs: X3P (ISO 25178-72), SUR (Digital Surf), SDF "
        "(ISO 25178-71, binary or text); repeat the option for several.",
    ),
]
PlyFile = Annotated[
    PlyPoints,
    typer.Option(
        "--ply",
        help="Points of range_image.ply: organised (all samples in scan order, NaN in holes) or valid (for viewers "
        "that do not support NaN).",
    ),
]
EncoderFile = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        parser=named_path,
        help="Encoder file of this recording: a count for each profile. It replaces the encoder file or the step of "
        "the sensor file, which gives the size of a count.",
    ),
]
Preview = Annotated[
    bool,
    typer.Option(
        "--preview",
        help="Only write preview.png: frames of the recording with the line that the readout finds, threshold and "
        "flags. No scan.",
    ),
]

Tolerance = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Largest error of the heights, such as 20um: replace method and window of the sensor's line readout by "
        "the fastest that is predicted to meet it on a sample of the recording. The sensor file must give the noise.",
    ),
]
OnlyPlan = Annotated[
    bool,
    typer.Option(
        "--plan",
        help="With --tolerance: only print the readouts that were tried with their predicted errors and times, and "
        "write plan.png. With --rate also batch and ring of the stream. No scan.",
    ),
]


def scan(
    recording: Recording,
    sensor: SensorFile,
    out: Results,
    device: DeviceLabel = None,
    precision: Annotated[
        Precision | None, typer.Option(help="Floating-point precision. Default: the precision of the recording.")
    ] = None,
    rate: Rate = None,
    policy: RoomPolicy = None,
    formats: SurfaceFiles = None,
    ply: PlyFile = PlyPoints.organised,
    encoder: EncoderFile = None,
    preview: Preview = False,
    tolerance: Tolerance = None,
    only_plan: OnlyPlan = False,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute the range image of a recording; write it with pictures and a report to DIR.

    Files are written only after the whole recording was processed.
    """
    # Silence OpenCV: the command reports a bad image in one line.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from gpuvision.sensor.sensor import Sensor
    from gpuvision.workflows.scan_result import SCAN_FILES, SIGMA_FILES, surface_files
    from gpuvision.workflows.scanning import scan as run

    described = Sensor.load(sensor, encoder=encoder)
    inputs: list[str | Path] = [recording, sensor, *described.files]
    unused_ply = None if ply is PlyPoints.organised else ply
    given = {"precision": precision, "rate": rate, "policy": policy, "format": formats, "ply": unused_ply}
    if preview:
        reject_unused("with --preview", **given, json=as_json, tolerance=tolerance, plan=only_plan)
        _write_preview(recording, described, out, inputs, device, overwrite)
        return
    largest = planned_tolerance(tolerance, "the heights, such as 20um", only_plan=only_plan)
    chosen_formats = [each.value for each in formats or ()]
    if only_plan:
        reject_unused("with --plan", **given | {"rate": None})  # the plan keeps up with the rate
        outputs = claim_plan(out, as_json, inputs, overwrite=overwrite)
    else:
        names = (*SCAN_FILES, *SIGMA_FILES, *surface_files(chosen_formats).values())
        outputs = claim_outputs("scan", inputs, (out, names), as_json, overwrite=overwrite)
    chosen = device_of(device)
    plan = None
    if largest is not None:
        reject_unused("with --tolerance, which chooses it", precision=precision)
        plan = _plan(recording, described, largest, rate, chosen)
        if only_plan:
            plan.write(out, overwrite=overwrite)
            report_plan(plan, out, as_json, outputs)
            return
        described = plan.sensor
    with progress_bar(f"scanning {recording.name}") as progress:
        done = run(
            recording,
            described,
            device=chosen,
            precision=None if precision is None else precision.value,
            rate=rate,
            policy=None if policy is None else policy.value,
            stream_plan=None if plan is None else plan.stream,
            progress=progress,
        )
    # The size of the height map is known only now: write the other files before the error.
    problems = done.surface_problems(out, chosen_formats)
    possible = [each for each in chosen_formats if each not in problems]
    done.write(out, formats=possible, ply_points=ply.value, overwrite=overwrite)
    write_report(as_json, done.report(), outputs)
    if plan is not None:
        echo(f"plan: {plan}", err=prints_report(as_json))
    _show(done, out, to_stderr=prints_report(as_json))
    if problems:
        raise ValueError(f"{'; '.join(problems.values())}; all other files are written")


def _plan(recording: Path, sensor: Sensor, tolerance: float, rate: float | None, device: Device | None) -> ScanPlan:
    """Choose the readout that meets a tolerance [m] on a sample of the recording, with a progress bar."""
    from gpuvision.workflows.planning_scan import plan_scan

    with planning(recording.name) as progress:
        return plan_scan(recording, sensor, tolerance=tolerance, rate=rate, device=device, progress=progress)


def _show(done: Scan, out: Path, *, to_stderr: bool) -> None:
    """Print the advice to standard error, then summary and error budget."""
    from gpuvision.workflows.scan_errors import budget_line

    echo_warnings(done.advice(), err=True)
    lines = (done.summary(), budget_line(done.error_budget()))
    look = f"look at {out / 'picture.png'} and {out / 'report.json'}"
    echo("\n".join([*filter(None, lines), look]), err=to_stderr)


def _write_preview(
    recording: Path, sensor: Sensor, out: Path, inputs: Sequence[str | Path], device: str | None, overwrite: bool
) -> None:
    """Write the preview of a scan and print its line."""
    from gpuvision.workflows.preview import PREVIEW_FILE, preview_scan

    claim_outputs("preview", inputs, (out, (PREVIEW_FILE,)), overwrite=overwrite)
    found = preview_scan(recording, sensor, device=device_of(device))
    found.write(out, overwrite=overwrite)
    echo(f"{found.summary()}\nlook at {out / PREVIEW_FILE}")
