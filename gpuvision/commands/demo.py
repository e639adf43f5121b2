"""``gpuvision demo``: a part with a known shape is recorded, scanned, and compared with what it is."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from gpuvision.commands.arguments import named_path


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for recordings, range images and pictures.")
    ] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Of the noise.")] = 1,
    device: Annotated[str | None, typer.Option(help="Label of an OpenCL device, see `gpuvision devices`.")] = None,
) -> None:
    """Record a part with a camera and with PSD strips, scan both recordings, and compare with the truth.

    The sensors are simulated: direct light, noise, quantisation. The scans are what `gpuvision scan` does.
    """
    import numpy as np

    from gpuvision.demo import SENSORS, part, record
    from gpuvision.demo_errors import compare, draw_errors
    from gpuvision.host import Device
    from gpuvision.scan import check_folder, whole_folder
    from gpuvision.scan import scan as run
    from gpuvision.sensor import Sensor

    check_folder(out)
    chosen = Device.best() if device is None else Device.named(device)
    typer.echo(f"device {chosen.label}: {chosen.name}")
    mesh = part()
    results: dict[str, Any] = {}
    with whole_folder(out) as inside:
        mesh.export(inside / "part.ply")
        for name in SENSORS:
            recording = record(name, mesh, seed)
            done = run(recording, Sensor.load(name), device=chosen)
            errors = compare(done, mesh)
            done.write(inside / name)
            np.save(inside / name / "recording.npy", recording)
            draw_errors(inside / name / "errors.png", errors, done.sensor.name)
            results[name] = {"errors": errors.to_dict(), **done.report()}
            typer.echo(f"{name}: {done.summary()}\n{'':>{len(name)}}  {errors.summary()}")
        (inside / "report.json").write_text(json.dumps(results, indent=1) + "\n")
    camera = out / "camera_line"
    typer.echo(
        f"scan one yourself: gpuvision scan {camera / 'recording.npy'} --sensor camera_line --out {out / 'again'}"
    )
    worst = max(each["errors"]["rms"] for each in results.values())
    typer.echo(
        f"Two scans of a part with a known shape, off by {1e6 * worst:.0f} µm rms or less away from its edges: "
        f"look at {camera / 'picture.png'}, and at errors.png beside it."
    )
