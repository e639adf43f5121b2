"""``gpuvision delay``: analyse the delay of a servo loop."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import (
    Overwrite,
    ReportFile,
    echo,
    named_path,
    prints_report,
    quantities,
    reject_unused,
    write_report,
)

if TYPE_CHECKING:
    from gpuvision.servoing.delay import DelayBudget

Results = Annotated[
    Path,
    typer.Option(
        metavar="DIR",
        parser=named_path,
        help="Folder for report.json and delay.png; with --recording also measured_delay.png.",
    ),
]
Rate = Annotated[float | None, typer.Option(metavar="HZ", min=1e-3, help="Frames per second.")]
Exposure = Annotated[str | None, typer.Option(metavar="TIME", help="Time of exposure, such as 200us. Default: 0.")]
Readout = Annotated[
    str | None, typer.Option(metavar="TIME", help="Time from the end of the exposure to the last pixel. Default: 0.")
]
SensorName = Annotated[
    str | None,
    typer.Option(
        "--sensor", metavar="NAME|FILE", help="Camera preset, such as pb1024, that gives the readout time of --roi."
    ),
]
Region = Annotated[
    str | None, typer.Option(metavar="COLUMNSxROWS", help="Region of interest of --sensor. Default: the whole sensor.")
]
Transfer = Annotated[
    str | None, typer.Option(metavar="TIME", help="Time of the transfer to the computer's memory. Default: 0.")
]
Stages = Annotated[
    list[str] | None,
    typer.Option(
        "--stage", metavar="NAME=TIME", help="Time of a stage, such as edges=0.4ms; repeat the option for each stage."
    ),
]
Jitter = Annotated[
    str | None,
    typer.Option(metavar="TIME", help="Standard deviation of the delay. Default: that of the recording, or 0."),
]
Recording = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE.csv",
        parser=named_path,
        help="Recording of an excited axis: CSV file with the header time,command,measured in seconds, and metres or "
        "radians. Its delay is measured.",
    ),
]


def delay(
    out: Results,
    rate: Rate = None,
    exposure: Exposure = None,
    readout: Readout = None,
    sensor: SensorName = None,
    roi: Region = None,
    transfer: Transfer = None,
    stage: Stages = None,
    jitter: Jitter = None,
    recording: Recording = None,
    as_json: ReportFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Analyse the delay of a servo loop: stability limits, gains, margins, from its parts or from a recording.

    Give --rate and the parts of the delay, or --recording, or both: then the report states the difference.
    """
    from gpuvision.formats.cmos_sensor_file import CMOS_SENSORS
    from gpuvision.formats.loop_recording import read_loop_recording
    from gpuvision.host.outputs import Outputs
    from gpuvision.workflows.analysing_delay import DELAY_FILES, MEASURED_PICTURE, analyse_delay

    budget = None
    if rate is None:
        parts = {"exposure": exposure, "readout": readout, "sensor": sensor, "roi": roi, "transfer": transfer}
        reject_unused("without --rate", **parts, stage=stage or None)
        if recording is None:
            raise ValueError("give --rate and the parts of the delay, or --recording")
    else:
        budget = _budget(rate, exposure, readout, sensor, roi, transfer, stage or ())
    sensor_file = None if sensor in CMOS_SENSORS else sensor
    inputs = tuple(Path(each) for each in (recording, sensor_file) if each is not None)
    outputs = Outputs("delay", inputs=inputs, overwrite=overwrite)
    outputs.claim_folder(out, DELAY_FILES if recording is None else (*DELAY_FILES, MEASURED_PICTURE))
    outputs.claim(as_json)
    done = analyse_delay(
        budget,
        recording=None if recording is None else read_loop_recording(recording),
        jitter=None if jitter is None else quantities(jitter, "--jitter", "s")[0],
    )
    done.write(out, inputs=inputs, overwrite=overwrite)
    write_report(as_json, done.report(), outputs)
    echo(f"{done.summary()}\nlook at {out / 'delay.png'} and {out / 'report.json'}", err=prints_report(as_json))


def _budget(
    rate: float,
    exposure: str | None,
    readout: str | None,
    sensor: str | None,
    roi: str | None,
    transfer: str | None,
    stages: list[str] | tuple[str, ...],
) -> DelayBudget:
    """Return the budget that the options state."""
    from gpuvision.servoing.delay import DelayBudget

    exposed = 0.0 if exposure is None else quantities(exposure, "--exposure", "s")[0]
    if sensor is None:
        reject_unused("without --sensor", roi=roi)
        read = 0.0 if readout is None else quantities(readout, "--readout", "s")[0]
    else:
        reject_unused("with --sensor", readout=readout)
        read = _readout(sensor, roi, exposed, rate)
    times = {}
    for each in stages:
        name, equals, time = each.partition("=")
        if not (name and equals):
            raise ValueError(f"--stage is {each!r}, expected a name and a time: edges=0.4ms")
        times[name] = quantities(time, f"--stage {name}", "s")[0]
    moved = 0.0 if transfer is None else quantities(transfer, "--transfer", "s")[0]
    return DelayBudget(period=1.0 / rate, exposure=exposed, readout=read, transfer=moved, stages=times)


def _readout(sensor: str, roi: str | None, exposure: float, rate: float) -> float:
    """Return the readout time of a region of a camera preset, which must reach the frame rate."""
    from gpuvision.formats.cmos_sensor_file import read_cmos_sensor

    shape = None
    if roi is not None:
        columns, cross, rows = roi.partition("x")
        if not (cross and columns.isdigit() and rows.isdigit() and int(columns) and int(rows)):
            raise ValueError(f"--roi is {roi!r}, expected columns and rows: 128x128")
        shape = int(rows), int(columns)
    timing = read_cmos_sensor(sensor).timing(shape, exposure or None)
    if timing.rate < rate:
        raise ValueError(f"the sensor reaches {timing.rate:.4g} frames per second, --rate is {rate:g}; lower --roi")
    return max(timing.delay - timing.exposure / 2.0, 0.0)
