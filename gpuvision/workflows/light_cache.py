"""Store of simulated light in blocks of profiles, computed here or by Dask; each block is a file.

A block depends only on its task and its profiles: computed again, or on another machine, it is the same.
"""

from __future__ import annotations

import functools
import io
import math
import threading
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.host.errors import ReadError, RecordingError
from gpuvision.host.files import atomic_write, check_writable_folder
from gpuvision.host.reading import check_archive, reading
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import make_light_sheet, make_sensor_view, minimum_sample_power, require_light
from gpuvision.simulation.light_paths import LightPaths
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import GroundTruth
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows.light_key import key_of, source_digest

PROFILES_PER_BLOCK = 16
"""Profiles in a file: some seconds of work, so that little is lost when a run stops."""
# Length beyond either end of a PSD strip in which the light is computed that the end cuts off, as a fraction of the
# strip. Chosen: far more than the width of a light spot; the computing time grows with it.
_END_FRACTION = 0.25
# Time in which a Dask scheduler must accept the connection: Dask tries again until then. Chosen.
_CONNECTION_TIMEOUT = "10s"

Float64 = npt.NDArray[np.float64]
Progress = Callable[[int, int | None], object]


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulationTask:
    """Everything that the simulated light depends on; can be sent to another machine. Compared by identity.

    Attributes
    ----------
    part, materials
        Scene, and a material for every number in `Scene.material`.
    sensor
        Sensor with a light and a straight transport.
    transports
        (profiles,): positions of the sheet [m].
    paths
        Light paths, out of `gpuvision.simulation.sensors.readings.PATHS`.
    tolerance
        Range error that omitted light may cause [m]; 0: all light is computed. Default 0.0.
    patch_size
        Largest edge of the patches for multi-bounce light [m]; None: a sixteenth of the scene's diagonal.
    bounce_nodes
        Rays per bin along u and along v for multi-bounce light; None: `Light.nodes`, as for other indirect light.
    """

    part: Scene
    materials: tuple[Material, ...]
    sensor: Sensor
    transports: Float64
    paths: tuple[str, ...]
    tolerance: float = 0.0
    patch_size: float | None = None
    bounce_nodes: tuple[int, int] | None = None

    @functools.cached_property
    def fingerprint(self) -> str:
        """Name of the light: equal for equal tasks and sources of gpuvision, independent of the electronics."""
        # The light that may be omitted depends on the least readable power, which depends on the electronics.
        least = minimum_sample_power(self.sensor) if self.tolerance > 0.0 else None
        return key_of(self, least)

    def blocks(self) -> list[range]:
        """Return the profiles of each block."""
        count = len(self.transports)
        return [range(k, min(k + PROFILES_PER_BLOCK, count)) for k in range(0, count, PROFILES_PER_BLOCK)]


class LightBlock(NamedTuple):
    """Light of some profiles.

    Attributes
    ----------
    exposures
        `Exposure` (profiles, samples, bins) by name of the light path.
    truth
        True positions, (profiles, samples).
    statistics
        `ProfileLight.statistics` by name, (profiles,) each.
    """

    exposures: dict[str, Exposure]
    truth: GroundTruth
    statistics: dict[str, npt.NDArray[Any]]

    def to_bytes(self) -> bytes:
        """Return the block as an NPZ file.

        Powers and moments are stored in single, which changes a reading by less than 1e-6 of its error.
        """
        arrays: dict[str, Any] = {f"truth/{name}": value for name, value in self.truth._asdict().items()}
        for path, exposure in self.exposures.items():
            arrays |= {f"{name}/{path}": value.astype(np.float32) for name, value in exposure._asdict().items()}
        arrays |= {f"statistics/{name}": value for name, value in self.statistics.items()}
        file = io.BytesIO()
        np.savez_compressed(file, **arrays)
        return file.getvalue()

    @classmethod
    def from_file(cls, path: Path) -> LightBlock:
        """Read a file that `to_bytes` made.

        Raises
        ------
        RecordingError
            The file has other content.
        """
        parts: dict[str, dict[str, Any]] = {"truth": {}, "statistics": {}, "power": {}, "moment": {}}
        with reading(path, "file of simulated light", RecordingError):
            check_archive(path)
            try:
                with np.load(path, allow_pickle=False) as file:
                    for name in file.files:
                        kind, key = name.split("/", 1)
                        parts[kind][key] = file[name]
                exposures = {
                    name: Exposure(power.astype(np.float64), parts["moment"][name].astype(np.float64))
                    for name, power in parts["power"].items()
                }
                return cls(exposures, GroundTruth(**parts["truth"]), parts["statistics"])
            except (AttributeError, KeyError, TypeError, ValueError) as error:
                raise RecordingError(
                    f"{path}: holds no simulated light; delete it, and it is computed again"
                ) from error


class LightStore:
    """Blocks of a task in a folder; each file is written completely or not at all.

    Parameters
    ----------
    folder
        Folder of the simulation; the blocks of a task lie in ``light/<fingerprint>``.
    task
        Task whose blocks are stored.
    """

    def __init__(self, folder: Path, task: SimulationTask) -> None:
        self.task = task
        self.folder = folder / "light" / task.fingerprint

    def path(self, number: int) -> Path:
        """Return the file of a block."""
        return self.folder / f"block_{number:05d}.npz"

    def missing(self) -> list[int]:
        """Return the numbers of the blocks that are missing or cannot be read."""
        return [number for number in range(len(self.task.blocks())) if not _is_intact(self.path(number))]

    def write(self, number: int, content: bytes) -> None:
        """Write the file of a block."""
        self.folder.mkdir(parents=True, exist_ok=True)
        with atomic_write(self.path(number), overwrite=True) as file:
            file.write(content)

    def __iter__(self) -> Iterator[LightBlock]:
        """Read the blocks one after the other."""
        for number in range(len(self.task.blocks())):
            yield LightBlock.from_file(self.path(number))


def compute_missing_blocks(
    store: LightStore,
    *,
    device: Device | None = None,
    scheduler: str | None = None,
    progress: Progress = lambda done, of: None,
) -> int:
    """Compute the blocks that are not in the store, and return their number.

    Parameters
    ----------
    store
        Store of the task's blocks.
    device
        Device for a computation here; None: `Device.best`.
    scheduler
        Address of a Dask scheduler whose workers compute, each on the `Device.best` of its machine; None: compute here.
        The blocks of a worker that dies are computed again by others.
    progress
        Called with the number of profiles done and the number of all profiles.

    Raises
    ------
    ImportError
        Dask is not installed.
    OSError
        There is no scheduler at that address, or a block cannot be written.
    ValueError
        A worker has other sources of gpuvision than this machine.
    """
    task, missing = store.task, store.missing()
    if missing:
        check_writable_folder(store.folder)  # before minutes of work
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
    """Return the `LightPaths` of a task."""
    light = require_light(task.sensor)
    is_psd = isinstance(task.sensor.readout, PsdReadout)
    return LightPaths(
        view=make_sensor_view(task.sensor),
        sheet=make_light_sheet(task.sensor),
        scene=task.part,
        materials=task.materials,
        paths=task.paths,
        sub_sheets=light.sub_sheets,
        blur=light.blur,
        nodes=light.nodes,
        bounce_nodes=task.bounce_nodes,
        spreads_rays=is_psd,  # a strip adds up its bins; a pixel is read alone
        end_bins=math.ceil(_END_FRACTION * light.bins) if is_psd else 0,
        patch_size=task.patch_size,
        tolerance=task.tolerance,
        min_power=minimum_sample_power(task.sensor),
        device=device,
    )


def compute_block(task: SimulationTask, number: int, device: Device | None = None) -> bytes:
    """Compute a block; return the bytes of its file."""
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
    with dask.Client(address, timeout=_CONNECTION_TIMEOUT, set_as_default=False) as client, client.as_current():
        everywhere = client.scatter(task, broadcast=True)
        # A block that is requested twice is computed twice; the second file replaces an equal one.
        futures = {
            client.submit(
                _compute_on_worker, everywhere, number, source_digest(), key=f"{task.fingerprint}-{number}"
            ): number
            for number in numbers
        }
        for future, content in dask.as_completed(futures, with_results=True):
            yield futures[future], content


def _compute_on_worker(task: SimulationTask, number: int, sources: str) -> bytes:
    """Compute a block on a worker with the client's sources; other sources compute other light under the same key."""
    if source_digest() != sources:
        raise ValueError("a Dask worker has other sources of gpuvision than this machine; install the same version")
    return compute_block(task, number)


# Kernels are built once per task. A bound kernel may be used by one thread at a time.
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
        with reading(path, "file of simulated light"):
            check_archive(path)
            with zipfile.ZipFile(path) as file:
                return file.testzip() is None
    except (OSError, ReadError):
        return False
