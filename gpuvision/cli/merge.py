"""``gpuvision merge``: merge the height maps of two scans of one part."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

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
    quantities,
    write_report,
)


class Disagreement(StrEnum):
    """Values of ``--disagreement``."""

    drop = "drop"
    first = "first"
    second = "second"
    lower_height = "lower"
    higher_height = "higher"
    mean = "mean"


FirstScan = Annotated[
    Path,
    typer.Argument(
        metavar="FIRST",
        parser=named_path,
        help="First scan: folder of `gpuvision scan`, its range_image.npz, or a TIFF or 16-bit PNG file of heights.",
    ),
]
SecondScan = Annotated[
    Path, typer.Argument(metavar="SECOND", parser=named_path, help="Second scan, in the same frame and cell size.")
]
Results = Annotated[
    Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for the merged map, a picture and report.json.")
]
Tolerance = Annotated[
    str | None,
    typer.Option(
        metavar="LENGTH",
        help="Allowed difference of heights that agree, such as 20um, besides --max-sigmas. Needed if a scan has no "
        "standard deviations. Default: 0.",
    ),
]
MaxSigmas = Annotated[
    float, typer.Option(min=0.0, help="Heights agree within this many standard deviations of their difference.")
]
OnDisagreement = Annotated[
    Disagreement,
    typer.Option(
        help="Height where the scans disagree: none (drop), the height of one scan, the lower, the higher, the mean. "
        "The cell is flagged AMBIGUOUS."
    ),
]
RequireBoth = Annotated[
    bool,
    typer.Option(
        "--require-both",
        help="Drop heights that one scan alone has: nothing confirms them. Occlusions are then not filled.",
    ),
]


def merge(
    first: FirstScan,
    second: SecondScan,
    out: Results,
    tolerance: Tolerance = None,
    max_sigmas: MaxSigmas = 3.0,
    disagreement: OnDisagreement = Disagreement.drop,
    require_both: RequireBoth = False,
    as_json: ReportFile = None,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Merge two scans of one part: fill what one sensor does not see, average the rest, flag disagreement."""
    from gpuvision.workflows.merging import MERGE_FILES, SIGMA_FILE, height_map_file, merge_scans

    allowed = 0.0 if tolerance is None else quantities(tolerance, "--tolerance", "m")[0]
    inputs = (height_map_file(first), height_map_file(second))
    outputs = claim_outputs("merge", inputs, (out, (*MERGE_FILES, SIGMA_FILE)), as_json, overwrite=overwrite)
    done = merge_scans(
        first,
        second,
        max_sigmas=max_sigmas,
        tolerance=allowed,
        disagreement=disagreement.value,
        require_both=require_both,
        device=device_of(device),
    )
    done.write(out, inputs=inputs, overwrite=overwrite)
    write_report(as_json, done.report(), outputs)
    echo_warnings(done.advice(), err=True)
    echo(
        f"{done.summary()}\nlook at {out / 'picture.png'}, {out / 'sources.png'} and {out / 'report.json'}",
        err=prints_report(as_json),
    )
