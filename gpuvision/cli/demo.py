"""``gpuvision demo``: simulate the recording of a known part, scan it, and compare with the truth."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gpuvision.cli.arguments import DeviceLabel, Overwrite, claim_outputs, command_line, echo, named_path, progress_bar

if TYPE_CHECKING:
    from gpuvision.host import Device
    from gpuvision.workflows.light_cache import SimulationTask


def demo(
    out: Annotated[
        Path, typer.Option(metavar="DIR", parser=named_path, help="Folder for recordings, range images and pictures.")
    ] = Path("out/demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 1,
    device: DeviceLabel = None,
    overwrite: Overwrite = False,
) -> None:
    """Simulate recordings of a part with a camera and with PSD strips, scan them, and compare with the truth.

    Light between the walls of the part's concave corners shifts the PSD readings; a mask computed for the part reduces
    the shift.
    """
    from trimesh.exchange.ply import export_ply

    from gpuvision.formats.json import json_tree, report_text
    from gpuvision.host import Device
    from gpuvision.host.files import atomic_write, write_text_atomic
    from gpuvision.workflows.demo import SENSORS, make_part, make_scan_task
    from gpuvision.workflows.scan_result import SCAN_FILES, SIGMA_FILES
    from gpuvision.workflows.simulating import simulate
    from gpuvision.workflows.simulation_result import simulation_files

    each_sensor = {*SCAN_FILES, *SIGMA_FILES, *simulation_files(has_mask=False), "recording.npy"}
    names = ["part.ply", "report.json", *(f"{name}/{file}" for name in SENSORS for file in sorted(each_sensor))]
    masked_folder = f"{SENSORS[-1]}_masked"
    names += [f"{masked_folder}/{file}" for file in simulation_files(has_mask=True)]
    outputs = claim_outputs("demo", (), (out, names), overwrite=overwrite)
    chosen = Device.best() if device is None else Device.named(device)
    echo(f"device {chosen.label}: {chosen.name}")
    results: dict[str, Any] = {}
    with outputs.folder(out) as inside, tempfile.TemporaryDirectory() as light_folder:
        with atomic_write(inside / "part.ply") as file:
            file.write(export_ply(make_part()))
        for name in SENSORS:
            task = make_scan_task(name)
            results[name] = _simulate_and_scan(name, task, inside / name, light_folder, seed, chosen)
        masked = simulate(task, light_folder, seed=seed, mask="best", device=chosen)
        masked.write(inside / masked_folder)
        results[masked_folder] = {"predicted": masked.report()}
        write_text_atomic(inside / "report.json", report_text(json_tree(results)))
    echo(f"{name} with a mask computed for the part: {masked.summary()}")
    camera = out / "camera_line"
    words = ("scan", camera / "recording.npy", "--sensor", "camera_line", "--out", out / "again")
    echo(f"next: scan a recording yourself: {command_line('gpuvision', *words)}")
    echo(
        f"Range image of the part: {camera / 'picture.png'}. Errors of the PSD strips from light in the corners: "
        f"{out / name / 'errors.png'} and causes.png in the same folder; with a mask: "
        f"{out / masked_folder / 'errors.png'}."
    )


def _simulate_and_scan(
    name: str, task: SimulationTask, folder: Path, light_folder: str, seed: int, device: Device
) -> dict[str, Any]:
    """Simulate the sensor over the part, scan the simulated recording, write both, and return the report."""
    import numpy as np

    from gpuvision.host.files import atomic_write
    from gpuvision.workflows.scanning import scan
    from gpuvision.workflows.simulated_recording import simulate_recording
    from gpuvision.workflows.simulating import simulate

    with progress_bar(f"{name}: simulating") as progress:
        known = simulate(task, light_folder, seed=seed, device=device, progress=progress)
    recording = simulate_recording(task, light_folder, seed=seed, device=device)
    done = scan(recording, task.sensor, device=device)
    known.write(folder)
    done.write(folder, overwrite=True)  # the scan's range image takes the name of the simulated one
    with atomic_write(folder / "recording.npy") as file:
        np.save(file, recording)
    echo(f"{name}: {done.summary()}\n  {known.summary()}")
    return {"predicted": known.report(), **done.report()}
