"""``gpuvision delay``: analyse the delay of a servo loop."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gpuvision.cli.arguments import (
    Overwrite,
    ReportFile,
    claim_outputs,
    echo,
    echo_warnings,
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
Rate = Annotated[float | None, typer.Option(metavar="HZ", min=1e-3, max=1e7, help="Frames per second.")]
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
    typer.Option(metavar="TIME", help="Standard deviation of the delay. Default: the jitter of the recording, or 0."),
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
    names = DELAY_FILES if recording is None else (*DELAY_FILES, MEASURED_PICTURE)
    outputs = claim_outputs("delay", inputs, (out, names), as_json, overwrite=overwrite)
    deviation = None if jitter is None else _time(jitter, "--jitter")
    if recording is None:
        done = analyse_delay(budget, jitter=deviation)
    else:
        samples = read_loop_recording(recording)
        try:
            done = analyse_delay(budget, recording=samples, jitter=deviation)
        except ValueError as error:
            raise ValueError(f"{recording}: {error}") from error
    echo_warnings(done.warnings, err=True)
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

    exposed = _time(exposure, "--exposure")
    if sensor is None:
        reject_unused("without --sensor", roi=roi)
        read = _time(readout, "--readout")
    else:
        reject_unused("with --sensor", readout=readout)
        if exposure is None:
            raise ValueError(f"--sensor {sensor} needs --exposure, such as 200us")
        read = _readout(sensor, roi, exposed, rate)
    times = {}
    for each in stages:
        name, equals, time = each.partition("=")
        if not (name and equals):
            raise ValueError(f"--stage is {each!r}, expected a name and a time: edges=0.4ms")
        if name in times:
            raise ValueError(f"--stage {name} is given twice; give the sum, or two names")
        times[name] = _time(time, f"--stage {name}")
    moved = _time(transfer, "--transfer")
    return DelayBudget(period=1.0 / rate, exposure=exposed, readout=read, transfer=moved, stages=times)


def _time(text: str | None, option: str) -> float:
    """Return the time of an option [s]; 0 without the option."""
    time = 0.0 if text is None else quantities(text, option, "s")[0]
    if time < 0.0:
        raise ValueError(f"{option} is {text!r}, expected a time of 0 or more")
    return time


def _readout(sensor: str, roi: str | None, exposure: float, rate: float) -> float:
    """Return the readout time of a region of a camera preset, which must reach the frame rate."""
    from gpuvision.formats.cmos_sensor_file import read_cmos_sensor

    shape = None
    if roi is not None:
        found = re.fullmatch(r"0*([1-9][0-9]{0,6})x0*([1-9][0-9]{0,6})", roi)
        if found is None:
            raise ValueError(f"--roi is {roi!r}, expected columns and rows: 128x128")
        shape = int(found[2]), int(found[1])
    described = read_cmos_sensor(sensor)
    timing = described.timing(shape, exposure or None)
    if timing.rate < rate:
        reached = f"the sensor reaches {timing.rate:.4g} frames per second, --rate is {rate:g}"
        raise ValueError(f"{reached}; lower --roi or shorten --exposure")
    return max(timing.delay - timing.exposure / 2.0, 0.0)
