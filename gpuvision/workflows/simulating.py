"""Simulation of a scan: the range image that a sensor makes of a part, its errors and their causes.

The light of every profile is simulated once and stored (`gpuvision.workflows.light_cache`). The readings of the
sensor's electronics, with or without a mask, are computed from the stored light.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.range_image import RangePoints
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import make_sensor_view, make_simulator, require_light
from gpuvision.simulation.errors.error_attribution import ErrorAttribution, attribute_errors
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.masks import Mask, optimise_mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.readings import PATHS, GroundTruth, Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.sheet_cut import SheetIndex
from gpuvision.status import Status
from gpuvision.workflows.light_cache import LightBlock, LightStore, Progress, SimulationTask, compute_missing_blocks
from gpuvision.workflows.scan_result import ScanLimits
from gpuvision.workflows.scanning import assemble_points, resample_heights
from gpuvision.workflows.simulated_recording import sensor_of_recording
from gpuvision.workflows.simulation_result import Simulation, light_strength

DEFAULT_PATHS = ("direct", "specular", "diffuse-specular", "diffuse-diffuse")

Array = npt.NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class SimulationLimits:
    """Limits of the evaluation of a simulated scan.

    Attributes
    ----------
    limit_sigmas : float
        Default error limit [predicted standard deviations]. Derived: Gaussian noise alone exceeds 5 standard deviations
        in less than one of a million samples.
    max_mask_bins : int
        Largest number of bins, over all profiles, on which a mask is optimised; with more bins every n-th profile is
        used. Chosen: bounds the memory, 512 MB per array.
    max_cells : int
        Largest number of cells of a height map, as `ScanLimits.max_cells`.
    """

    limit_sigmas: float = 5.0
    max_mask_bins: int = 1 << 26
    max_cells: int = ScanLimits.max_cells


def prepare_simulation(
    part: Scene,
    materials: Sequence[Material],
    sensor: Sensor,
    *,
    paths: Sequence[str] = DEFAULT_PATHS,
    tolerance: float = 0.0,
    patch_size: float | None = None,
    profiles: int | None = None,
    transports: npt.ArrayLike | None = None,
) -> SimulationTask:
    """Return the task of scanning a part from end to end.

    Parameters
    ----------
    part, materials
        Scene in the sensor's coordinates, and a material for every number in `Scene.material`.
    sensor
        Sensor with a light and a straight transport of even steps.
    paths
        Light paths, out of `gpuvision.simulation.sensors.readings.PATHS`; "direct" is required.
    tolerance
        Range error that omitted light may cause [m], 0 or more; 0: nothing is left out. See `LightPaths` for the errors
        that it covers. Default 0.0.
    patch_size
        Largest edge of the patches for multi-bounce light [m]; None: `Light.patch_size` of the sensor, or else a
        sixteenth of the scene's diagonal.
    profiles
        Number of profiles, about the middle of the part; None: all profiles that meet the part.
    transports
        Positions of the sheet [m] that replace the sensor's: for a second sensor on the same sheet.

    Raises
    ------
    ValueError
        The sensor cannot be simulated, a parameter lies outside its range, no profile meets the part, or the sheet is
        bent too much for the part, see `SheetIndex.of`.
    """
    require_light(sensor)
    transport = sensor.transport
    assert isinstance(transport, StraightTransport)  # require_light checked it
    if not (np.isfinite(tolerance) and tolerance >= 0.0):
        raise ValueError(f"the tolerance is {tolerance}, expected metres, 0 or more")
    if patch_size is None:
        patch_size = require_light(sensor).patch_size
    elif not (np.isfinite(patch_size) and patch_size > 0.0):
        raise ValueError(f"the patch size is {patch_size}, expected metres, more than 0")
    for path in paths:
        if path not in PATHS:
            raise ValueError(f"unknown path '{path}', expected some of {', '.join(PATHS)}")
    if "direct" not in paths:
        raise ValueError("the paths lack 'direct': without it there is nothing to read")
    return SimulationTask(
        part=part,
        materials=tuple(materials),
        sensor=sensor,
        transports=_transports_over(part, transport, profiles)
        if transports is None
        else np.asarray(transports, np.float64),
        paths=tuple(dict.fromkeys(paths)),
        tolerance=float(tolerance),
        patch_size=patch_size,
    )


def simulate(
    task: SimulationTask,
    folder: str | Path,
    *,
    mask: Mask | str | None = None,
    seed: int | None = 1,
    limit: float | None = None,
    device: Device | None = None,
    scheduler: str | None = None,
    progress: Progress = lambda done, of: None,
    limits: SimulationLimits = SimulationLimits(),
) -> Simulation:
    """Simulate a scan. Light that the folder already holds is not computed again.

    Parameters
    ----------
    task
        From `prepare_simulation`.
    folder
        Folder of the results; the light of the profiles is stored in its subfolder ``light``.
    mask
        Mask before the sensor; "best": a window for every sample, optimised for this part; None: no mask.
    seed
        Seed of the noise; None: no noise. Default 1.
    limit
        Smallest error that counts as wrong [m]. None: `SimulationLimits.limit_sigmas` times the median of the predicted
        standard deviation, or the task's tolerance if that is larger.
    device
        None: `Device.best`.
    scheduler
        Address of a Dask scheduler whose workers compute the light; None: compute here.
    progress
        Called with the number of profiles done and the number of all profiles.
    limits
        Limits of the evaluation.

    Raises
    ------
    ValueError
        The mask does not fit the sensor, or nothing can be read.
    OSError
        The folder cannot be written.
    """
    device = Device.best() if device is None else device
    store = LightStore(Path(folder), task)
    start = time.perf_counter()
    computed = compute_missing_blocks(store, device=device, scheduler=scheduler, progress=progress)
    lit = time.perf_counter()
    view = make_sensor_view(task.sensor)
    found = None
    if mask == "best":
        found = optimise_mask(view, *_all_light(store, view.samples * view.bins, limits.max_mask_bins))
    before = found.mask if found is not None else mask if isinstance(mask, Mask) else None
    sensor = sensor_of_recording(store, before, seed)
    attribution, statistics = _attribute_errors(store, make_simulator(sensor, view, before), seed, device)
    points = _points(task, attribution.reading, device)
    if task.sensor.output.ambiguous == "drop":
        attribution = attribution.without_flagged(Status.AMBIGUOUS)
    heights, grid = resample_heights(
        task.sensor, points, light_strength(attribution.reading), device, max_cells=limits.max_cells
    )
    return Simulation(
        task=task,
        threshold=None if isinstance(sensor.readout, PsdReadout) else sensor.readout.threshold,
        attribution=attribution,
        points=points,
        heights=heights,
        grid=grid,
        limit=_default_limit(attribution.reading, task, limits) if limit is None else limit,
        mask=found,
        statistics=statistics,
        device=device,
        seconds={"light": lit - start, "readings": time.perf_counter() - lit},
        computed_blocks=computed,
    )


def load_part(
    path: str | Path, metres: float, materials: Sequence[Material] | None, albedo: float
) -> tuple[Scene, tuple[Material, ...]]:
    """Load a part and its materials.

    Parameters
    ----------
    path
        Mesh file.
    metres
        Metres per unit of length of the file.
    materials
        A material for each mesh of the file; None: all meshes are Lambertian with ``albedo``.
    albedo
        Albedo without materials, 0 to 1.

    Raises
    ------
    OSError, ValueError
        As `Scene.load`; or there are fewer materials than the file has meshes.
    """
    scene = Scene.load(path, metres=metres)
    assert scene.material is not None  # set by Scene itself
    count = int(scene.material.max(initial=-1)) + 1
    if materials is None:
        return scene, (Material(diffuse=Lambert(albedo=albedo)),) * count
    if len(materials) < count:
        raise ValueError(f"{path} has {count} meshes, {len(materials)} materials are given; expected one for each")
    return scene, tuple(materials)


def _transports_over(part: Scene, transport: StraightTransport, profiles: int | None) -> Array:
    """Return the transports [m] at which the sheet meets a part."""
    if transport.step is None:
        raise ValueError("a simulation needs [transport] step: metres per profile")
    places = _corner_transports(part, transport)
    if not len(places):
        raise ValueError("the part has no triangle")
    steps = (np.array([places.min(), places.max()]) - transport.start) / transport.step
    first, last = int(np.ceil(steps.min() + 1e-9)), int(np.floor(steps.max() - 1e-9))
    if profiles is not None and profiles < last + 1 - first:
        first = (first + last + 1 - profiles) // 2
        last = first + profiles - 1
    if last < first:
        raise ValueError(
            "no profile meets the part: it is shorter than a step of the transport; give a smaller [transport] step, "
            "or the right unit of the mesh"
        )
    return transport.start + transport.step * np.arange(first, last + 1, dtype=np.float64)


def _corner_transports(part: Scene, transport: StraightTransport) -> Array:
    """Return the transports [m] at which the sheet meets corners of the part; of its division by a bent sheet."""
    if transport.bend is not None:
        return SheetIndex.of(part, transport).corners[..., 2].ravel()
    corners = part.corners.reshape(-1, 3)
    axes = np.array([transport.g_axis, transport.h_axis, transport.direction])
    return np.asarray((corners - transport.origin) @ np.linalg.inv(axes)[:, 2])


def _all_light(store: LightStore, bins: int, max_bins: int) -> tuple[dict[str, Exposure], GroundTruth]:
    """Return the light of all profiles by path; of every n-th profile where all would exceed ``max_bins``."""
    every = -(-len(store.task.transports) * bins // max_bins)
    light: dict[str, list[Exposure]] = {}
    truths = []
    for block, profiles in zip(store, store.task.blocks(), strict=True):
        chosen = [k - profiles.start for k in profiles if k % every == 0]
        for name in set(PATHS) & set(block.exposures):
            light.setdefault(name, []).append(Exposure(*(each[chosen] for each in block.exposures[name])))
        truths.append(GroundTruth(*(each[chosen] for each in block.truth)))
    exposures = {
        name: Exposure(*(np.concatenate(each) for each in zip(*parts, strict=True))) for name, parts in light.items()
    }
    return exposures, GroundTruth(*(np.concatenate(each) for each in zip(*truths, strict=True)))


def _attribute_errors(
    store: LightStore, simulator: PsdSimulator | CameraSimulator, seed: int | None, device: Device
) -> tuple[ErrorAttribution, dict[str, float]]:
    """Return readings, errors and causes of all profiles, and the statistics of their light.

    Raises
    ------
    ValueError
        The sensor sees a lit surface in no profile.
    """
    parts: list[ErrorAttribution] = []
    statistics: dict[str, float] = {}
    first = 0
    for block in store:
        parts.append(
            attribute_errors(simulator, block.exposures, block.truth, seed=seed, first_profile=first, device=device)
        )
        statistics = _add_statistics(statistics, block)
        first += len(block.truth.h)
    attribution = _concatenate(parts)
    if not (np.isfinite(attribution.truth.h) & ((attribution.truth.status & Status.OUT_OF_RANGE) == 0)).any():
        raise ValueError(
            f"the sensor sees nothing lit in any of {first} profiles: {_describe_position(store.task.part)}; "
            "is that where sheet and sensor are, and the unit right?"
        )
    return attribution, statistics


def _points(task: SimulationTask, reading: Reading, device: Device) -> RangePoints:
    """Return the organised range image of a reading."""
    place = [np.ascontiguousarray(each, np.float32) for each in (reading.g, reading.h)]
    return assemble_points(task.sensor, place, task.transports, reading.status, device)


def _default_limit(reading: Reading, task: SimulationTask, limits: SimulationLimits) -> float:
    """Return the error that noise alone hardly ever exceeds [m], but at least the tolerance of the task."""
    sigma = reading.sigma[np.isfinite(reading.sigma)]
    return max(limits.limit_sigmas * float(np.median(sigma)) if sigma.size else 0.0, task.tolerance)


def _add_statistics(statistics: Mapping[str, float], block: LightBlock) -> dict[str, float]:
    """Return sums of the statistics and a block's; the larger value of bounds and estimated errors."""
    added = {}
    for name, each in block.statistics.items():
        before = statistics.get(name, 0.0)
        largest = name.startswith(("bound", "estimated"))
        added[name] = max(before, float(np.max(each))) if largest else before + float(np.sum(each))
    return added


def _concatenate(parts: Sequence[ErrorAttribution]) -> ErrorAttribution:
    """Return the attributions of all blocks as one."""

    def joined(values: Sequence[Any]) -> Any:
        if isinstance(values[0], dict):
            return {name: joined([each[name] for each in values]) for name in values[0]}
        if isinstance(values[0], tuple):
            return type(values[0])(*(joined(each) for each in zip(*values, strict=True)))
        return np.concatenate(values)

    return ErrorAttribution(
        **{each.name: joined([getattr(part, each.name) for part in parts]) for each in fields(ErrorAttribution)}
    )


def _describe_position(part: Scene) -> str:
    """Return a text with the extent of a part."""
    corners = part.corners.reshape(-1, 3)
    low, high = (1e3 * bound(corners, axis=0) for bound in (np.min, np.max))
    return "the part lies at " + ", ".join(
        f"{name} {a:.4g} to {b:.4g} mm" for name, a, b in zip("xyz", low, high, strict=True)
    )
