"""``gpuvision demo``: simulate the recording of a known part, scan it, and compare with the truth."""

from __future__ import annotations

import json
import tempfile
from pathlib import Path
from typing import Annotated, Any

import typer

from gpuvision.cli.arguments import DeviceLabel, named_path


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for recordings, range images and pictures.")
    ] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 1,
    device: DeviceLabel = None,
) -> None:
    """Simulate recordings of a part with a camera and with PSD strips, scan them, and compare with the truth.

    Light between the walls of the part's concave corners shifts the PSD readings; a mask computed for the part reduces
    the shift.
    """
    import numpy as np

    from gpuvision.cli.scan import progress_bar
    from gpuvision.host import Device
    from gpuvision.host.files import atomic_folder, check_writable_folder
    from gpuvision.workflows.demo import SENSORS, make_part, make_scan_task
    from gpuvision.workflows.scanning import scan
    from gpuvision.workflows.simulating import simulate, simulate_recording

    check_writable_folder(out)
    chosen = Device.best() if device is None else Device.named(device)
    typer.echo(f"device {chosen.label}: {chosen.name}")
    results: dict[str, Any] = {}
    with atomic_folder(out) as inside, tempfile.TemporaryDirectory() as light_folder:
        make_part().export(inside / "part.ply")
        for name in SENSORS:
            task = make_scan_task(name)
            with progress_bar(f"{name}: simulating") as progress:
                known = simulate(task, light_folder, seed=seed, device=chosen, progress=progress)
            recording = simulate_recording(task, light_folder, seed=seed, device=chosen)
            done = scan(recording, task.sensor, device=chosen)
            known.write(inside / name)
            done.write(inside / name)
            np.save(inside / name / "recording.npy", recording)
            results[name] = {"predicted": known.report(), **done.report()}
            typer.echo(f"{name}: {done.summary()}\n  {known.summary()}")
        masked = simulate(task, light_folder, seed=seed, mask="best", device=chosen)
        masked.write(inside / f"{name}_masked")
        results[f"{name}_masked"] = {"predicted": masked.report()}
        (inside / "report.json").write_text(json.dumps(results, indent=1) + "\n")
    typer.echo(f"{name} with a mask computed for the part: {masked.summary()}")
    camera = out / "camera_line"
    typer.echo(
        "next: scan a recording yourself: "
        f"gpuvision scan {camera / 'recording.npy'} --sensor camera_line --out {out / 'again'}"
    )
    typer.echo(
        f"Range image of the part: {camera / 'picture.png'}. Errors of the PSD strips from light in the corners: "
        f"{out / name / 'errors.png'} and causes.png beside it; with a mask: "
        f"{out / f'{name}_masked' / 'errors.png'}."
    )
