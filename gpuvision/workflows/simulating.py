"""A part and the description of a sensor become the range image that the sensor will make, its errors and their causes.

The light of every profile is simulated once and kept (`gpuvision.workflows.light_cache`); what the electronics make of
it, behind which mask, is computed from there.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.formats.range_image import write_npz, write_ply, write_png16, write_tiff
from gpuvision.host import Device
from gpuvision.host.files import whole_folder
from gpuvision.plots.range_image import draw_height_map
from gpuvision.plots.simulation import draw_causes, draw_errors
from gpuvision.ranging.range_image import RangePoints, StraightTransport
from gpuvision.ranging.regrid import Grid, HeightMap
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import light_of, sensor_view_of, simulator_of
from gpuvision.simulation.errors.error_attribution import ErrorAttribution, attribute_errors
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.masks import Mask, MaskOptimisation, optimise_mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.readings import PATHS, GroundTruth, Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from gpuvision.workflows.light_cache import LightBlock, LightStore, Progress, SimulationTask, compute_missing_blocks
from gpuvision.workflows.scanning import assembled, resampled

DEFAULT_PATHS = ("direct", "specular", "diffuse-specular", "diffuse-diffuse")
_LIMIT_SIGMAS = 5.0
_MAX_MASK_BINS = 1 << 26  # bins of all profiles that a mask is made from

Array = npt.NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """What a sensor will make of a part.

    Attributes
    ----------
    task
        What was simulated.
    attribution
        Readings, truth, errors and causes, (profiles, samples).
    points
        The range image that the sensor makes.
    heights, grid
        Its height map over regular cells, and where they lie.
    limit
        Error from which on a sample counts as wrong [m].
    mask
        What was found for it, where one was asked for.
    statistics
        What was modelled, summed over the profiles.
    device
        Where readings were made.
    seconds
        Time of the steps, by name.
    computed
        Blocks of profiles that were not there yet.
    """

    task: SimulationTask
    attribution: ErrorAttribution
    points: RangePoints
    heights: HeightMap
    grid: Grid
    limit: float
    mask: MaskOptimisation | None
    statistics: dict[str, float]
    device: Device
    seconds: dict[str, float]
    computed: int

    def summary(self) -> str:
        """Return what came out, in a line or two."""
        told = self.attribution.summary(self.limit)
        worst = max(told["causes"], key=lambda name: told["causes"][name]["dominant"])
        um = 1e6
        text = (
            f"{len(self.task.transports)} profiles, {told['valid']} of {told['surface']} samples read, errors "
            f"{um * (told['median'] or 0.0):.1f} µm median, {um * (told['p95'] or 0.0):.0f} µm p95, "
            f"{told['beyond_limit']} beyond {um * self.limit:.1f} µm (mostly {worst}), {told['spurious']} spurious "
            "(a reading, but no lit surface in view)"
        )
        if self.mask is None:
            return text
        before, after = (float(np.nanmax(np.abs(each))) for each in (self.mask.error_before, self.mask.error_after))
        return (
            f"{text}\nmask: worst error of the light's centre {um * before:.0f} µm without, {um * after:.0f} µm with it"
        )

    def report(self) -> dict[str, Any]:
        """Return what `write` puts into ``report.json``; lengths in metres, times in seconds."""
        task = self.task
        return {
            "gpuvision": version("gpuvision"),
            "sensor": task.sensor.name,
            "kind": task.sensor.kind,
            "profiles": len(task.transports),
            "triangles": len(task.part.corners),
            "defects": {each.name: len(getattr(task.part.defects, each.name)) for each in fields(task.part.defects)},
            "paths": list(task.paths),
            "tolerance": task.tolerance,
            "errors": self.attribution.summary(self.limit),
            "mask": None if self.mask is None else _mask_report(self.mask),
            "modelled": self.statistics,
            "device": {"label": self.device.label, "name": self.device.name, "driver": self.device.driver},
            "light": task.fingerprint,
            "computed_blocks": self.computed,
            "seconds": self.seconds,
        }

    def write(self, folder: str | Path) -> None:
        """Write the range image, pictures and the report into a folder, all or nothing.

        ``range_image.tiff``, ``.png`` (16 bit) and ``picture.png`` show the height map as it will be measured,
        ``range_image.ply`` the organised points, ``errors.png`` and ``causes.png`` how far off they are and why;
        ``simulation.npz`` holds the arrays.

        Raises
        ------
        OSError
            The folder cannot be written.
        """
        told = self.attribution
        title = self.task.sensor.name or "Simulation"
        with whole_folder(folder) as inside:
            write_tiff(inside / "range_image.tiff", self.heights.z, self.grid)
            write_png16(inside / "range_image.png", self.heights.z, self.grid)
            write_ply(inside / "range_image.ply", *self.points[:3], _strength(told.reading), self.points.status)
            write_npz(inside / "simulation.npz", *self._arrays())
            draw_height_map(inside / "picture.png", self.heights, self.grid, title=f"{title}: as measured")
            draw_errors(inside / "errors.png", told, title)
            draw_causes(inside / "causes.png", told, self.limit, title)
            if self.mask is not None:
                self.mask.mask.save(inside / "mask.txt")
            (inside / "report.json").write_text(json.dumps(self.report(), indent=1, allow_nan=False) + "\n")

    def _arrays(self) -> tuple[dict[str, Array], dict[str, str]]:
        told = self.attribution
        held: dict[str, tuple[Any, str]] = {
            **{name: (getattr(self.points, name), "m") for name in ("x", "y", "z")},
            "status": (self.points.status, "flags"),
            "true_g": (told.truth.g, "m"),
            "true_h": (told.truth.h, "m"),
            "error": (told.error, "m"),
            "category": (told.category, "flags"),
            **{f"cause_{name}": (part, "m") for name, part in told.causes.items()},
            "sigma": (told.reading.sigma, "m"),
            "transport": (self.task.transports, "m"),
        }
        return {name: array for name, (array, _) in held.items()}, {name: unit for name, (_, unit) in held.items()}


def prepare_simulation(
    part: Scene,
    materials: Sequence[Material],
    sensor: Sensor,
    *,
    paths: Sequence[str] = DEFAULT_PATHS,
    tolerance: float = 0.0,
    profiles: int | None = None,
    transports: npt.ArrayLike | None = None,
) -> SimulationTask:
    """Return the task of scanning a part from end to end.

    Parameters
    ----------
    part, materials
        The scene, in the sensor's coordinates, and a material for every number in `Scene.material`.
    sensor
        With a light and a straight transport of even steps.
    paths
        Out of `gpuvision.simulation.sensors.readings.PATHS`.
    tolerance
        Range error that may come from what is left out [m]; 0: nothing is left out.
    profiles
        How many, about the middle; None: all that meet the part.
    transports
        Where the sheet is to stand instead [m]: for a second sensor beside a first one.

    Raises
    ------
    ValueError
        The sensor cannot be simulated, or no profile meets the part.
    """
    light_of(sensor)
    transport = sensor.transport
    assert isinstance(transport, StraightTransport)  # light_of looked
    if not (np.isfinite(tolerance) and tolerance >= 0.0):
        raise ValueError(f"the tolerance is {tolerance}, expected metres, 0 or more")
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
) -> Simulation:
    """Simulate a scan; what a folder already holds of its light is not computed again.

    Parameters
    ----------
    task
        From `prepare_simulation`.
    folder
        Where the light of the profiles is kept, in ``light``.
    mask
        Before the sensor; "best": a window for every sample, made for this part.
    seed
        Of the noise; None: there is none.
    limit
        Error from which on a sample counts as wrong [m]; None: five times the median of the predicted standard
        deviation, or the task's tolerance if that is more.
    device
        None: `Device.best`.
    scheduler
        Address of a Dask scheduler whose workers compute the light.
    progress
        Called with the profiles done, and of how many.

    Raises
    ------
    ValueError
        The mask is not one for this sensor, or nothing can be read.
    OSError
        The folder cannot be written.
    """
    device = Device.best() if device is None else device
    store = LightStore(Path(folder), task)
    start = time.perf_counter()
    computed = compute_missing_blocks(store, device=device, scheduler=scheduler, progress=progress)
    lit = time.perf_counter()
    view = sensor_view_of(task.sensor)
    found = optimise_mask(view, *_all_light(store, view.samples * view.bins)) if mask == "best" else None
    before = found.mask if found is not None else mask if isinstance(mask, Mask) else None
    attribution, statistics = _attribute_errors(store, simulator_of(task.sensor, view, before), seed, device)
    points = _points(task, attribution.reading, device)
    if task.sensor.output.ambiguous == "drop":
        attribution = attribution.without_flagged(Status.AMBIGUOUS)
    heights, grid = resampled(task.sensor, points, _strength(attribution.reading), device)
    return Simulation(
        task=task,
        attribution=attribution,
        points=points,
        heights=heights,
        grid=grid,
        limit=max(_default_limit(attribution.reading), task.tolerance) if limit is None else limit,
        mask=found,
        statistics=statistics,
        device=device,
        seconds={"light": lit - start, "readings": time.perf_counter() - lit},
        computed=computed,
    )


def simulate_recording(
    task: SimulationTask,
    folder: str | Path,
    *,
    mask: Mask | None = None,
    seed: int | None = 1,
    device: Device | None = None,
) -> Array:
    """Return the sensor's recording, in the form that `gpuvision.workflows.scanning.scan` takes.

    Light that `folder` already holds is not computed again.

    Parameters
    ----------
    task, folder, mask, seed, device
        As for `simulate`.

    Returns
    -------
    numpy.ndarray
        (profiles, rows, columns) grey levels of a camera, (profiles, strips, 2) currents or codes of a PSD.
    """
    store = LightStore(Path(folder), task)
    compute_missing_blocks(store, device=device)
    simulator = simulator_of(task.sensor, sensor_view_of(task.sensor), mask)
    record = simulator.currents if isinstance(simulator, PsdSimulator) else simulator.frames
    parts, first = [], 0
    for block in store:
        parts.append(record(block.exposures, seed=seed, first_profile=first))
        first += len(parts[-1])
    return np.concatenate(parts)


def load_part(
    path: str | Path, metres: float, materials: Sequence[Material] | None, albedo: float
) -> tuple[Scene, tuple[Material, ...]]:
    """Read a part, and give it its materials, or one of an albedo.

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
    """Return where the sheet stands while it moves over a part."""
    if transport.step is None:
        raise ValueError("a simulation needs [transport] step: metres per profile")
    corners = part.corners.reshape(-1, 3)
    corners = corners[np.isfinite(corners).all(axis=1)]
    if not len(corners):
        raise ValueError("the part has no triangle")
    axes = np.array([transport.g_axis, transport.h_axis, transport.direction])
    places = (corners - transport.origin) @ np.linalg.inv(axes)[:, 2]
    steps = (np.array([places.min(), places.max()]) - transport.start) / transport.step
    first, last = int(np.ceil(steps.min() + 1e-9)), int(np.floor(steps.max() - 1e-9))
    if profiles is not None and profiles < last + 1 - first:
        first = (first + last + 1 - profiles) // 2
        last = first + profiles - 1
    if last < first:
        raise ValueError("no profile meets the part: it is shorter than a step of the transport")
    return transport.start + transport.step * np.arange(first, last + 1, dtype=np.float64)


def _all_light(store: LightStore, bins: int) -> tuple[dict[str, Exposure], GroundTruth]:
    """Return the light of all profiles by path, or of every second, third, ... where that is much."""
    every = -(-len(store.task.transports) * bins // _MAX_MASK_BINS)
    light: dict[str, list[Exposure]] = {}
    truths = []
    for block, profiles in zip(store, store.task.blocks(), strict=True):
        chosen = [k - profiles.start for k in profiles if k % every == 0]
        for name in set(PATHS) & set(block.exposures):
            light.setdefault(name, []).append(Exposure(*(each[chosen] for each in block.exposures[name])))
        truths.append(GroundTruth(*(each[chosen] for each in block.truth)))
    whole = {
        name: Exposure(*(np.concatenate(each) for each in zip(*parts, strict=True))) for name, parts in light.items()
    }
    return whole, GroundTruth(*(np.concatenate(each) for each in zip(*truths, strict=True)))


def _attribute_errors(
    store: LightStore, simulator: PsdSimulator | CameraSimulator, seed: int | None, device: Device
) -> tuple[ErrorAttribution, dict[str, float]]:
    """Return the artifacts of all profiles, and what was modelled of them.

    Raises
    ------
    ValueError
        There is no profile in which the sensor sees a lit surface.
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
    if not np.isfinite(attribution.truth.h).any():
        raise ValueError(
            f"the sensor sees nothing lit in any of {first} profiles: {_describe_position(store.task.part)}; "
            "is that where sheet and sensor are, and the unit right?"
        )
    return attribution, statistics


def _points(task: SimulationTask, reading: Reading, device: Device) -> RangePoints:
    """Return the organised range image of what a sensor reads."""
    place = [np.ascontiguousarray(each, np.float32) for each in (reading.g, reading.h)]
    return assembled(task.sensor, place, task.transports, reading.status, device)


def _default_limit(reading: Reading) -> float:
    """Return the error that noise alone hardly ever makes [m]."""
    sigma = reading.sigma[np.isfinite(reading.sigma)]
    return _LIMIT_SIGMAS * float(np.median(sigma)) if sigma.size else 0.0


def _add_statistics(statistics: Mapping[str, float], block: LightBlock) -> dict[str, float]:
    """Return sums, and of bounds the largest."""
    added = {}
    for name, each in block.statistics.items():
        before = statistics.get(name, 0.0)
        largest = name.startswith("bound")
        added[name] = max(before, float(np.max(each))) if largest else before + float(np.sum(each))
    return added


def _concatenate(parts: Sequence[ErrorAttribution]) -> ErrorAttribution:
    """Return the artifacts of all blocks as one."""

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
    """Say where a part lies."""
    corners = part.corners.reshape(-1, 3)
    low, high = (1e3 * bound(corners[np.isfinite(corners).all(axis=1)], axis=0) for bound in (np.min, np.max))
    return "the part lies at " + ", ".join(
        f"{name} {a:.4g} to {b:.4g} mm" for name, a, b in zip("xyz", low, high, strict=True)
    )


def _strength(reading: Reading) -> Array:
    return np.nan_to_num(reading.strength).astype(np.float32)


def _mask_report(plan: MaskOptimisation) -> dict[str, Any]:
    def worst(values: Array) -> float | None:
        known = np.abs(values[np.isfinite(values)])
        return float(known.max()) if known.size else None

    kept = plan.passed_fraction[np.isfinite(plan.passed_fraction)]
    return {
        "worst_without": worst(plan.error_before),
        "worst_with": worst(plan.error_after),
        "light_kept": float(kept.min()) if kept.size else None,
    }
