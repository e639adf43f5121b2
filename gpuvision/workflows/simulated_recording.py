"""Recording that a simulated sensor makes of a part, and the sensor file with which a scan reads it."""

from __future__ import annotations

import dataclasses
import itertools
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import tomli_w

from gpuvision.host import Device
from gpuvision.host.files import write_text_atomic
from gpuvision.host.outputs import Outputs
from gpuvision.host.sources import IteratedSource
from gpuvision.ranging.background import sample_frames
from gpuvision.ranging.line import LineReadout
from gpuvision.schema import Section, read_preset
from gpuvision.sensor.sensor import BACKGROUNDS, Sensor
from gpuvision.sensor.simulated import line_noise, make_sensor_view, make_simulator
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.workflows.light_cache import LightStore, SimulationTask, compute_missing_blocks
from gpuvision.workflows.opened_recording import sensor_with_threshold

Array = npt.NDArray[Any]

RECORDING_FILES = ("recording.npy", "recording.toml")
"""Names of the files that `write_recording` writes."""
# Largest difference of a transport from even steps, in steps (chosen): far above rounding, below the noise of a scan.
_EVEN = 1e-6
_PAIRS = ("dark_after", "dark_before")
_ENCODER_KEYS = ("encoder", "encoder_key", "encoder_bits")

_HEADER = (
    "# Written by gpuvision simulate --recording: the sensor file of the simulation, with the transport of the first\n"
    "# simulated profile and the noise of the simulated sensor.\n\n"
)


def simulate_recording(
    task: SimulationTask,
    folder: str | Path,
    *,
    mask: Mask | None = None,
    seed: int | None = 1,
    device: Device | None = None,
) -> Array:
    """Return the sensor's simulated recording, in the form that `gpuvision.workflows.scanning.scan` takes.

    Light that ``folder`` already holds is not computed again.

    Parameters
    ----------
    task, folder, mask, seed, device
        As for `gpuvision.workflows.simulating.simulate`.

    Returns
    -------
    numpy.ndarray
        Camera: grey levels (profiles, rows, columns). PSD: currents or codes (profiles, strips, 2). Profile 0 is at
        ``task.transports[0]``.
    """
    return np.concatenate(list(_recorded_blocks(task, folder, mask, seed, device)))


def write_recording(
    task: SimulationTask,
    folder: str | Path,
    sensor_file: str | Path,
    *,
    light: str | Path | None = None,
    mask: Mask | None = None,
    seed: int | None = 1,
    device: Device | None = None,
    inputs: Sequence[str | Path] = (),
    overwrite: bool = False,
) -> None:
    """Write the simulated recording ``recording.npy``, and ``recording.toml``, with which a scan reads it.

    ``gpuvision scan FOLDER/recording.npy --sensor FOLDER/recording.toml --out DIR`` then has the same readings as the
    simulation. The memory holds one block of profiles.

    Parameters
    ----------
    task, mask, seed, device
        As for `gpuvision.workflows.simulating.simulate`.
    folder : str or Path
        Output folder; created if it is missing.
    sensor_file : str or Path
        Sensor file of the task, or the name of a preset.
    light : str or Path, optional
        Folder of the simulation, whose subfolder ``light`` holds the light. Default: ``folder``.
    inputs : sequence of path
        Files that are never replaced, with the files of the sensor.
    overwrite : bool
        Whether files may be replaced that no earlier simulation wrote. Default False.

    Raises
    ------
    FileExistsError
        A file exists, and is not an unchanged output of an earlier simulation; see `gpuvision.host.outputs`.
    OSError
        The folder cannot be written.
    ValueError
        No sensor file can describe the recording, see `recording_sensor`.
    """
    text = recording_sensor(task, sensor_file, noise=seed is not None)
    first = 0
    frames: Array | None = None
    with Outputs("simulate", inputs=[*inputs, *task.sensor.files], overwrite=overwrite).folder(folder) as inside:
        for block in _recorded_blocks(task, folder if light is None else light, mask, seed, device):
            if frames is None:
                shape = (len(task.transports), *block.shape[1:])
                frames = np.lib.format.open_memmap(
                    inside / RECORDING_FILES[0], mode="w+", dtype=block.dtype, shape=shape
                )
            frames[first : first + len(block)] = block
            first += len(block)
        del frames  # closes the file
        write_text_atomic(inside / RECORDING_FILES[1], text)


def recording_sensor(task: SimulationTask, sensor_file: str | Path, *, noise: bool = True) -> str:
    """Return the sensor file (TOML) of a simulated recording.

    Parameters
    ----------
    task : SimulationTask
        Simulation of the sensor.
    sensor_file : str or Path
        Sensor file of the task, or the name of a preset.
    noise : bool
        Whether the recording has noise. Default True.

    Returns
    -------
    str
        The table of ``sensor_file`` with these changes: ``[transport] start`` and ``step`` describe the simulated
        profiles; the keys of an encoder file are removed; without a noise model in ``[line]``, the noise of the
        simulated camera is added, so that the scan predicts its errors; ``[recording] background`` is removed, because
        the frames show no background; names of files are absolute. Comments are lost.

    Raises
    ------
    ValueError
        The transports of the profiles are not evenly spaced, or the sensor file expects pairs of frames with and
        without light.

    Notes
    -----
    The method ``"ml"`` weighs samples by the noise model. The simulation reads its frames with the noise model of the
    camera, so the file has it for this method without noise too.
    """
    opened = read_preset(sensor_file, "sensors", "sensor")
    table = opened.to_dict()
    background = table.get("recording", {}).pop("background", None)
    if background in _PAIRS:
        raise ValueError(
            f'{sensor_file}: [recording] background = "{background}" needs frames without light, which a simulated '
            f"recording does not have; expected one of {', '.join(each for each in BACKGROUNDS if each not in _PAIRS)}"
        )
    for name in ("lens", "camera"):
        if "file" in table.get(name, {}):
            table[name]["file"] = str(opened.section(name).file("file").resolve())
    table["transport"] = _even_transport(task, table["transport"])
    readout = task.sensor.readout
    if isinstance(readout, LineReadout) and not task.sensor.noise_known and (noise or readout.method == "ml"):
        table["line"] |= line_noise(task.sensor)
    text = _HEADER + tomli_w.dumps(table)
    Sensor.from_section(Section(tomllib.loads(text), str(sensor_file)))  # refuses a file that a scan would refuse
    return text


def sensor_of_recording(store: LightStore, mask: Mask | None, seed: int | None) -> Sensor:
    """Return the sensor of a simulation with the threshold that a scan of the simulated recording estimates.

    Parameters
    ----------
    store : LightStore
        Light of all profiles.
    mask, seed
        As for `gpuvision.workflows.simulating.simulate`.

    Returns
    -------
    Sensor
        The sensor of the task unless it has ``threshold = "auto"``. The estimate is that of
        `gpuvision.workflows.opened_recording.open_for_scan`, from the simulated frames without a background.
    """
    sensor = store.task.sensor
    if not sensor.auto_threshold:
        return sensor
    frames = itertools.chain.from_iterable(_stored_blocks(store, mask, seed))
    bare = dataclasses.replace(sensor, recording=dataclasses.replace(sensor.recording, background="none"))
    readout = sensor_with_threshold(bare, sample_frames(IteratedSource(frames)).frames).readout
    return dataclasses.replace(sensor, readout=readout)


def _even_transport(task: SimulationTask, table: dict[str, Any]) -> dict[str, Any]:
    """Return the table ``[transport]`` with the start and step of the task, without an encoder file.

    A single profile has the step of the table, or the size of a count of its encoder.
    """
    kept = {key: value for key, value in table.items() if key not in _ENCODER_KEYS}
    return {**kept, **_start_and_step(task, kept["step"] if "step" in kept else kept["metres_per_count"])}


def _start_and_step(task: SimulationTask, single_step: float) -> dict[str, float]:
    """Return start and step [m] of the transports; ``single_step`` for a single profile."""
    places = task.transports
    if len(places) < 2:
        return {"start": float(places[0]), "step": float(single_step)}
    step = float(places[-1] - places[0]) / (len(places) - 1)
    if np.max(np.abs(places - places[0] - step * np.arange(len(places)))) > _EVEN * abs(step):
        raise ValueError("the transports of the profiles are not evenly spaced; no sensor file describes the recording")
    return {"start": float(places[0]), "step": step}


def _recorded_blocks(
    task: SimulationTask, folder: str | Path, mask: Mask | None, seed: int | None, device: Device | None
) -> Iterator[Array]:
    """Yield the recording block by block; missing light is computed first."""
    store = LightStore(Path(folder), task)
    compute_missing_blocks(store, device=device)
    yield from _stored_blocks(store, mask, seed)


def _stored_blocks(store: LightStore, mask: Mask | None, seed: int | None) -> Iterator[Array]:
    """Yield the recording of stored light block by block."""
    sensor = store.task.sensor
    simulator = make_simulator(sensor, make_sensor_view(sensor), mask)
    record = simulator.currents if isinstance(simulator, PsdSimulator) else simulator.frames
    first = 0
    for block in store:
        frames = record(block.exposures, seed=seed, first_profile=first)
        yield frames
        first += len(frames)
