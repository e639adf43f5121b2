"""Blocks of simulated profiles: computed here or by Dask, each kept as a file, so that nothing is computed twice.

A block depends on its task and its profiles alone: it may be computed again, or on another machine, and is the same.
"""

from __future__ import annotations

import functools
import hashlib
import io
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.files import replacing
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import floor_of, light_of, sensor_view_of, sheet_of
from gpuvision.simulation.light_paths import LightPaths
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure

PROFILES_PER_BLOCK = 16
_OPTICAL = (
    "lens",
    "aperture",
    "power",
    "thickness",
    "source",
    "width",
    "profile",
    "sub_sheets",
    "blur",
    "bins",
    "nodes",
)

Float64 = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulationTask:
    """What light is to be simulated: all that a block depends on. It can go to another machine.

    Attributes
    ----------
    part, materials
        The scene, and a material for every number in `Scene.material`.
    sensor
        With a light and a straight transport.
    transports
        (profiles,) where the sheet stands [m].
    paths
        Which ways of the light are modelled, out of `gpuvision.simulation.sensors.readings.PATHS`.
    tolerance
        Range error that may come from what is left out [m]; 0: nothing is left out.
    """

    part: Scene
    materials: tuple[Material, ...]
    sensor: Sensor
    transports: Float64
    paths: tuple[str, ...]
    tolerance: float = 0.0

    @functools.cached_property
    def fingerprint(self) -> str:
        """A name for the light: the same for the same task, whatever the electronics make of it."""
        sensor, readout = self.sensor, self.sensor.readout
        assert self.part.material is not None  # set by Scene itself
        length = readout.strip_length if isinstance(readout, PsdReadout) else readout.along
        optics = [readout.triangulation, readout.axes, length, sensor.transport, sensor.frame]
        light = [getattr(sensor.light, name) for name in _OPTICAL]
        # What is read depends on the electronics, and so does what may be left out.
        least = floor_of(sensor) if self.tolerance > 0.0 else None
        words = repr([version("gpuvision"), self.materials, optics, light, self.paths, self.tolerance, least])
        digest = hashlib.sha256(words.encode())
        for array in (self.part.corners, self.part.material, self.transports):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:16]

    def blocks(self) -> list[range]:
        """Return which profiles each block has."""
        count = len(self.transports)
        return [range(k, min(k + PROFILES_PER_BLOCK, count)) for k in range(0, count, PROFILES_PER_BLOCK)]


class LightBlock(NamedTuple):
    """Light of some profiles.

    Attributes
    ----------
    exposures
        By path, (profiles, samples, bins).
    truth
        (profiles, samples).
    statistics
        What was modelled and what was left out: numbers by name, (profiles,) each.
    """

    exposures: dict[str, Exposure]
    truth: GroundTruth
    statistics: dict[str, npt.NDArray[Any]]

    def to_bytes(self) -> bytes:
        """Return an NPZ file: powers and moments in single, which moves a reading by less than 1e-6 of its error."""
        arrays: dict[str, Any] = {f"truth/{name}": value for name, value in self.truth._asdict().items()}
        for path, exposure in self.exposures.items():
            arrays |= {f"{name}/{path}": value.astype(np.float32) for name, value in exposure._asdict().items()}
        arrays |= {f"statistics/{name}": value for name, value in self.statistics.items()}
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()

    @classmethod
    def from_file(cls, path: Path) -> LightBlock:
        """Read what `to_bytes` gave.

        Raises
        ------
        RecordingError
            The file holds something else.
        """
        parts: dict[str, dict[str, Any]] = {"truth": {}, "statistics": {}, "power": {}, "moment": {}}
        try:
            with np.load(path) as file:
                for name in file.files:
                    kind, key = name.split("/", 1)
                    parts[kind][key] = file[name]
            exposures = {
                name: Exposure(power.astype(np.float64), parts["moment"][name].astype(np.float64))
                for name, power in parts["power"].items()
            }
            return cls(exposures, GroundTruth(**parts["truth"]), parts["statistics"])
        except (KeyError, TypeError, ValueError) as error:
            raise RecordingError(f"{path}: holds no simulated light; delete it, and it is computed again") from error


class LightStore:
    """The blocks of a task in a folder, each written whole or not at all.

    Parameters
    ----------
    folder
        Where simulations are kept; the task's blocks lie in a folder of its own within.
    task
        What they are blocks of.
    """

    def __init__(self, folder: Path, task: SimulationTask) -> None:
        self.task = task
        self.folder = folder / "light" / task.fingerprint

    def path(self, number: int) -> Path:
        """Return where a block is kept."""
        return self.folder / f"block_{number:05d}.npz"

    def missing(self) -> list[int]:
        """Return the numbers of the blocks that are not there, or cannot be read."""
        return [number for number in range(len(self.task.blocks())) if not _is_intact(self.path(number))]

    def write(self, number: int, content: bytes) -> None:
        """Write a block."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with replacing(self.path(number)) as file:
            file.write(content)

    def __iter__(self) -> Iterator[LightBlock]:
        """Read one block after the other."""
        for number in range(len(self.task.blocks())):
            yield LightBlock.from_file(self.path(number))


def compute_missing_blocks(
    store: LightStore,
    *,
    device: Device | None = None,
    scheduler: str | None = None,
    progress: Progress = lambda done, of: None,
) -> int:
    """Compute the blocks that are not there yet; return how many those were.

    Parameters
    ----------
    store
        Where they are kept.
    device
        Where to compute here; None: `Device.best`.
    scheduler
        Address of a Dask scheduler, whose workers compute instead, each on its own `Device.best`. A worker that dies
        costs the blocks it was at: others compute them again.
    progress
        Called with the profiles done, and of how many.

    Raises
    ------
    ImportError
        Dask is not installed.
    OSError
        There is no scheduler at that address, or a block cannot be written.
    """
    task, missing = store.task, store.missing()
    blocks = task.blocks()
    done = len(task.transports) - sum(len(blocks[number]) for number in missing)
    progress(done, len(task.transports))
    computed = _compute_here(task, missing, device) if scheduler is None else _compute_on_dask(task, missing, scheduler)
    for number, content in computed:
        store.write(number, content)
        done += len(blocks[number])
        progress(done, len(task.transports))
    return len(missing)


def make_light_paths(task: SimulationTask, device: Device) -> LightPaths:
    """Return what computes the light of a task's profiles."""
    light = light_of(task.sensor)
    return LightPaths(
        view=sensor_view_of(task.sensor),
        sheet=sheet_of(task.sensor),
        scene=task.part,
        materials=task.materials,
        paths=task.paths,
        sub_sheets=light.sub_sheets,
        blur=light.blur,
        nodes=light.nodes,
        tolerance=task.tolerance,
        floor=floor_of(task.sensor),
        device=device,
    )


def compute_block(task: SimulationTask, number: int, device: Device | None = None) -> bytes:
    """Compute a block; the bytes of its file."""
    with _CACHE_LOCK:
        paths = _cached_light_paths(task, device)
        profiles = paths.profiles(task.transports[list(task.blocks()[number])])
    names = profiles[0].exposures
    exposures = {
        name: Exposure(*(np.stack(each) for each in zip(*(p.exposures[name] for p in profiles), strict=True)))
        for name in names
    }
    truth = GroundTruth(*(np.stack(each) for each in zip(*(p.truth for p in profiles), strict=True)))
    statistics = {name: np.array([p.statistics[name] for p in profiles]) for name in profiles[0].statistics}
    return LightBlock(exposures, truth, statistics).to_bytes()


def _compute_here(task: SimulationTask, numbers: list[int], device: Device | None) -> Iterator[tuple[int, bytes]]:
    for number in numbers:
        yield number, compute_block(task, number, device)


def _compute_on_dask(task: SimulationTask, numbers: list[int], address: str) -> Iterator[tuple[int, bytes]]:
    try:
        import distributed
    except ImportError:
        raise ImportError("a scheduler needs Dask: pip install 'gpuvision[cluster]'") from None
    dask: Any = distributed
    with dask.Client(address, timeout="10s", set_as_default=False) as client, client.as_current():
        everywhere = client.scatter(task, broadcast=True)
        # Not pure: the same block asked for twice is computed twice, and written over itself.
        futures = {
            client.submit(compute_block, everywhere, number, key=f"{task.fingerprint}-{number}"): number
            for number in numbers
        }
        for future, content in dask.as_completed(futures, with_results=True):
            yield futures[future], content


# Kernels are built once for a task, and a bound kernel is one thread's at a time.
_CACHE_LOCK = threading.Lock()
_CACHE: dict[tuple[str, str], LightPaths] = {}


def _cached_light_paths(task: SimulationTask, device: Device | None) -> LightPaths:
    chosen = Device.best() if device is None else device
    key = (task.fingerprint, chosen.label)
    if key not in _CACHE:
        _CACHE.clear()
        _CACHE[key] = make_light_paths(task, chosen)
    return _CACHE[key]


def _is_intact(path: Path) -> bool:
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except (OSError, zipfile.BadZipFile):
        return False
