"""Plans of simulations against truth: random parts and sensors: ``python -m gpuvision.profiling.simulation_plans``.

Each job is a part of boxes and a cylinder under a PSD or a camera, with a tolerance and a rate. Half of the parts are
small, with 24 profiles in the middle. The others are large, with 100 to 400 profiles of the whole part, of which the
plan tries some. Truth is an independent, finer computation of 24 profiles (of 8 with multi-bounce light): a random one
of each of 24 sections of the part, drawn without regard to the profiles of the plan. It has eight times the rays of the
finest setting of the plan, which is twice the rays of the plan's reference, spread over the samples. It has twice the
slabs of the finest setting, half its bins, patches, steps in mirrors and parts of lobes, and three times its rays of
multi-bounce light. A plan holds if the root mean square difference of the simulated heights is at most the tolerance,
and if the time of a profile keeps up with the rate. No rate is asked if no combination of options truly meets the
tolerance. The cost of a plan is its time over the time of the fastest combination that truly meets the tolerance on
these profiles (exhaustive search).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import trimesh

from gpuvision.accuracy.plan import PlanError
from gpuvision.host import Device
from gpuvision.profiling.plan_outcomes import Outcome, room_of, run_jobs
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import require_light
from gpuvision.simulation.light_paths import SolverKey
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert, Phong
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS, Reading
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.direct import DirectLimits
from gpuvision.simulation.transport.radiosity import Radiosity
from gpuvision.status import Status
from gpuvision.workflows.light_cache import SimulationTask
from gpuvision.workflows.planning_simulation import plan_task
from gpuvision.workflows.simulating import prepare_simulation
from gpuvision.workflows.simulation_options import LightOptions, light_of_options
from gpuvision.workflows.simulation_plan import SimulationPlanLimits
from gpuvision.workflows.simulation_sample import ProfileSample, SimulationSettings, divided_light

Float64 = npt.NDArray[np.float64]

_WIDTH = 6  # strips or columns of the sensor file that are joined to one: a sixth of the work
_BINS = 48  # of a strip of a PSD
_PROFILES = 24  # of a small part, and of a large one that are compared with truth
_LARGE = 0.5  # share of the large parts
_MIN_LARGE, _MAX_LARGE = 100, 400  # profiles of a large part
_THIRD = 3  # of three profiles with multi-bounce light, one is compared with truth, because that light takes minutes
_TURNS = 5  # of the times of the chosen and of the best light: the machine may be busy
INDIRECT = ("diffuse-diffuse", "multi-bounce")
_BOUNCES = 0.5  # share of the PSD's jobs with multi-bounce light, which takes most of the time


class TrueRays(NamedTuple):
    """Numbers of rays per bin of the true light, along u and along v, as multiples of those in the sensor file.

    Attributes
    ----------
    diffuse, bounces : pair of ints
        Rays of light of two diffuse reflections, in bins of half the size, and of multi-bounce light.
    """

    diffuse: tuple[int, int]
    bounces: tuple[int, int]

    def times(self, factor: int) -> TrueRays:
        """Return the rays with a factor along v."""
        return TrueRays(*((u, factor * v) for u, v in self))


# In bins of half the size two rays along u are four. Multi-bounce light has the bins of the options, but other places.
_TRUE_RAYS = (TrueRays((2, 16), (4, 3)), TrueRays((2, 12), (3, 4)))
_MORE_RAYS = 4  # factor of the rays along v where these two differ


class Job(NamedTuple):
    """Part and sensor, and what is asked of the simulation.

    Attributes
    ----------
    task : SimulationTask
        The part under the sensor, with all light paths.
    places : numpy.ndarray
        (n,): transports at which the simulation is compared with truth [m].
    tolerance : float
        Largest error of the range [m].
    rate : float
        Rate, as a fraction of that of the fastest light that truly meets the tolerance.
    """

    task: SimulationTask
    places: Float64
    tolerance: float
    rate: float


def random_job(rng: np.random.Generator) -> Job:
    """Draw a part, materials, a sensor, a tolerance and a rate."""
    scene, materials = random_part(rng)
    is_psd = bool(rng.integers(2))
    sensor = random_sensor(rng, "psd_line" if is_psd else "camera_line")
    diagonal = float(np.linalg.norm(np.ptp(scene.corners.reshape(-1, 3), axis=0)))
    size = diagonal / rng.uniform(4.0, 6.0)
    paths = PATHS if is_psd and rng.random() < _BOUNCES else PATHS[:-1]
    is_large = rng.random() < _LARGE
    profiles = None if is_large else _PROFILES
    task = prepare_simulation(scene, materials, sensor, paths=paths, patch_size=size, profiles=profiles)
    if is_large:  # over the whole part, at another step than the sensor's
        count = int(rng.integers(_MIN_LARGE, _MAX_LARGE + 1))
        task = dataclasses.replace(task, transports=np.linspace(task.transports[0], task.transports[-1], count))
    low, high = (3e-6, 300e-6) if is_psd else (0.3e-6, 30e-6)
    places = random_places(rng, task.transports, _PROFILES // (_THIRD if "multi-bounce" in paths else 1))
    tolerance = math.exp(rng.uniform(math.log(low), math.log(high)))
    return Job(task, places, tolerance, rng.uniform(0.3, 0.8))


def random_places(rng: np.random.Generator, transports: Float64, count: int) -> Float64:
    """Return a random transport of each of ``count`` equal sections."""
    section = len(transports) / count
    starts = np.ceil(np.arange(count + 1) * section - 0.5).astype(int)
    return np.asarray(transports[rng.integers(starts[:-1], starts[1:])])


def random_part(rng: np.random.Generator) -> tuple[Scene, tuple[Material, ...]]:
    """Return a plate with blocks, whose sides the sheet lights, and sometimes a rod; some are glossy or mirrors."""
    plate = trimesh.creation.box((40e-3, 20e-3, 2e-3))
    plate.apply_translation((0.0, 0.0, -1e-3))
    meshes = [plate]
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform((4e-3, 8e-3, 2e-3), (12e-3, 19e-3, 6e-3))
        block = trimesh.creation.box(size)
        block.apply_transform(_turn(rng.uniform(0.2, 1.2), (0.0, 1.0, 0.0)))
        block.apply_translation((rng.uniform(-14e-3, 14e-3), rng.uniform(-3e-3, 3e-3), rng.uniform(0.0, 2e-3)))
        meshes.append(block)
    if rng.random() < 0.4:
        radius = rng.uniform(2e-3, 4e-3)
        rod = trimesh.creation.cylinder(radius, 18e-3, sections=24)
        rod.apply_transform(_turn(0.5 * math.pi, (1.0, 0.0, 0.0)))
        rod.apply_translation((rng.uniform(-15e-3, 15e-3), 0.0, radius))
        meshes.append(rod)
    scene = Scene.of(trimesh.Scene(meshes))
    assert scene.material is not None  # set by Scene itself
    return scene, tuple(_material(rng) for _ in range(int(scene.material.max()) + 1))


def _turn(angle: float, axis: tuple[float, float, float]) -> Float64:
    transformations: Any = trimesh.transformations
    return np.asarray(transformations.rotation_matrix(angle, axis), np.float64)


def _material(rng: np.random.Generator) -> Material:
    kind, albedo = rng.random(), rng.uniform(0.1, 0.8)
    if kind < 0.6:
        return Material(diffuse=Lambert(albedo=albedo))
    if kind < 0.85:
        gloss = Phong(albedo=rng.uniform(0.02, 0.15), exponent=math.exp(rng.uniform(math.log(5.0), math.log(80.0))))
        return Material(diffuse=Lambert(albedo=albedo), gloss=gloss)
    return Material(diffuse=Lambert(albedo=albedo), mirror=rng.uniform(0.02, 0.15))


def random_sensor(rng: np.random.Generator, name: str) -> Sensor:
    """Return a sensor of the package with joined samples and fewer bins, and a sheet and a blur of another size."""
    sensor = Sensor.load(name)
    light, readout = require_light(sensor), sensor.readout
    assert sensor.frame is not None  # the package's sensors have one, and one of these readouts
    assert isinstance(readout, PsdReadout | LineReadout)
    axes: Any = readout.axes
    wide = dataclasses.replace(
        axes,
        sample_origin=axes.sample_origin + 0.5 * (_WIDTH - 1) * axes.sample_pitch,
        sample_pitch=_WIDTH * axes.sample_pitch,
    )
    first, second = sensor.frame
    frame = (first, second // _WIDTH) if isinstance(readout, LineReadout) else (first // _WIDTH, second)
    light = dataclasses.replace(
        light,
        thickness=0.0 if rng.random() < 0.2 else rng.uniform(0.5, 3.0) * light.thickness,
        blur=rng.uniform(0.7, 2.0) * light.blur,
        sub_sheets=int(rng.integers(5, 12)),
        bins=_BINS,
    )
    return dataclasses.replace(sensor, light=light, frame=frame, readout=dataclasses.replace(readout, axes=wide))


def judge(rng: np.random.Generator, device: Device, limits: SimulationPlanLimits = SimulationPlanLimits()) -> Outcome:
    """Plan a random job and measure the plan against truth."""
    job = random_job(rng)
    truth = Truth(job, device)
    options = LightOptions(truth.sample, job.tolerance, lambda done, of: None)
    combinations = list(options.combinations())
    max_moved = 2.0 * limits.max_moved  # as many as differ from the reference may differ again
    errors = [truth.error(light_of_options(each), max_moved) for each in combinations]
    times = {options.settings_of(each): options.seconds_of(each) for each in combinations}
    meeting = [each for each, error in zip(times, errors, strict=True) if error <= job.tolerance]
    best = min(meeting, key=lambda each: times[each], default=None)
    # A fraction of the largest rate of the fastest accurate light.
    rate = None if best is None else job.rate / times[best]
    room = job.tolerance / min(errors) if rate is None else room_of(errors, list(times.values()), job.tolerance, rate)
    try:
        plan = plan_task(job.task, tolerance=job.tolerance, rate=rate, device=device, limits=limits)
    except PlanError as refusal:
        return Outcome(None, job.tolerance, possible=bool(meeting), room=room, note=note_of(truth, str(refusal)))
    chosen = plan.chosen.settings
    light = truth.sample.light(chosen)
    error = truth.error(light.exposures, max_moved)
    cost = math.nan if best is None else time_ratio(truth.sample, options, chosen, best)
    keeps_up = None if rate is None else (light.seconds + options.preparation_of(chosen)) * rate <= 1.0
    return Outcome(plan, job.tolerance, error, bool(meeting), cost, keeps_up, room, note_of(truth))


def note_of(truth: Truth, reason: str = "") -> str:
    """Return the number of profiles of the part, of samples without truth, and the reason of a refusal."""
    notes = [f"{len(truth.sample.task.transports)} profiles"]
    if truth.left_out:
        notes.append(f"{truth.left_out} of {truth.heights.size} samples without truth left out")
    return "; ".join([*notes, reason] if reason else notes)


def time_ratio(
    sample: ProfileSample, options: LightOptions, chosen: SimulationSettings, best: SimulationSettings
) -> float:
    """Return the time of a profile with chosen settings over that with the best ones, measured in turns."""
    if chosen == best:
        return 1.0
    runs = [[sample.light(each, runs=1).seconds for each in (chosen, best)] for _ in range(_TURNS)]
    one, other = np.min(runs, axis=0) + [options.preparation_of(each) for each in (chosen, best)]
    return float(one / other)


class Truth:
    """Readings of a job's profiles by a finer computation.

    Indirect light is computed with two numbers of rays. Profiles in which the heights differ by more than the
    tolerance are computed again with more rays. Samples that still differ are left out: their truth is not known.

    Parameters
    ----------
    job : Job
        The job.
    device : Device
        Device of the kernels.

    Attributes
    ----------
    heights : numpy.ndarray
        (profiles, samples): heights [m]; NaN where nothing is read.
    is_clear : numpy.ndarray
        (profiles, samples): whether the sample is compared.
    left_out : int
        Number of samples that two numbers of rays read differently.
    """

    def __init__(self, job: Job, device: Device) -> None:
        task = job.task  # with all profiles: they share the preparation of multi-bounce light
        self.sample = dataclasses.replace(ProfileSample.of(task, len(job.places), device), places=job.places)
        self._settings, self._solvers = SimulationSettings.of(task), dict[SolverKey, Radiosity]()
        slabs = 2 * (2 * self._settings.sub_sheets + 1)
        direct = tuple(each for each in task.paths if each not in INDIRECT)
        self._direct = self._halved(job.places, direct, sub_sheets=slabs)
        found, other = self._readings(np.arange(len(job.places)), 1)
        self.heights, status = found.h.copy(), found.status.copy()
        differs = differ(found.h, other.h, job.tolerance)
        unsure = np.flatnonzero(differs.any(axis=1))
        if len(unsure):
            found, other = self._readings(unsure, _MORE_RAYS)
            self.heights[unsure], status[unsure] = found.h, found.status
            differs[unsure] = differ(found.h, other.h, job.tolerance)
        self.left_out = int(np.count_nonzero(differs))
        self.is_clear = ((status & Status.AMBIGUOUS) == 0) & ~differs

    def _readings(self, chosen: npt.NDArray[np.int64], more: int) -> list[Reading]:
        """Read chosen profiles with two numbers of rays, of which there are ``more`` times as many along v."""
        direct = {name: Exposure(each.power[chosen], each.moment[chosen]) for name, each in self._direct.items()}
        places, reader = self.sample.places[chosen], self.sample.reader
        return [reader.read(direct | self._indirect(places, each.times(more))) for each in _TRUE_RAYS]

    def _indirect(self, places: Float64, rays: TrueRays) -> dict[str, Exposure]:
        """Return the diffuse light and the multi-bounce light of some profiles."""
        light, (u, v) = dict[str, Exposure](), self._settings.nodes
        for name, (along_u, along_v) in zip(INDIRECT, rays, strict=True):
            if name not in self.sample.task.paths:
                continue
            paths, nodes = ("direct", name), (along_u * u, along_v * v)
            if name == "diffuse-diffuse":
                found = self._halved(places, paths, sub_sheets=1, nodes=nodes)
            else:
                size = 0.5 * self._settings.patch_size
                finer = dataclasses.replace(self._settings, paths=paths, sub_sheets=1, nodes=nodes, patch_size=size)
                found = self.sample.light(finer, places, runs=1, solvers=self._solvers).exposures
            light[name] = found[name]
        return light

    def _halved(self, places: Float64, paths: tuple[str, ...], **changes: Any) -> dict[str, Exposure]:
        """Return light of bins of half the size, spread rays, and smaller parts of lobes and steps in mirrors."""
        settings = dataclasses.replace(self._settings, paths=paths, **changes)
        limits = {"direct_limits": DirectLimits(lobe_turn=0.5 * DirectLimits.lobe_turn), "mirror_steps": 4.0}
        task = settings.applied(self.sample.task)
        light = divided_light(task, places, self.sample.device, 2, spreads_rays=True, **limits)
        return {name: each for name, each in light.items() if name in paths}

    def error(self, light: Mapping[str, Exposure], max_moved: float) -> float:
        """Return the root mean square error of heights read from light [m]; infinite if too many are of other lines."""
        heights = self.sample.reader.read(light).h
        is_read, is_true = (self.is_clear & np.isfinite(each) for each in (heights, self.heights))
        away = np.abs(heights - self.heights)
        same = is_read & is_true & ~(away > self._largest)
        if np.mean(~same[is_read | is_true]) > max_moved or not same.any():
            return math.inf
        return math.sqrt(float(np.mean(away[same] ** 2)))

    @property
    def _largest(self) -> float:
        """Height beyond which a camera reads another line [m]."""
        readout = self.sample.task.sensor.readout
        if not isinstance(readout, LineReadout):
            return math.inf
        view = self.sample.reader.simulator.view
        u, v = 0.5 * (view.u_edges[0] + view.u_edges[-1]), view.v_centres[view.samples // 2]
        move = abs(readout.axes.position_pitch) * readout.window
        ends = [view.sheet_coordinates(view.points_in_sheet(u + each, v))[1] for each in (-0.5 * move, 0.5 * move)]
        return abs(float(ends[1] - ends[0]))


def differ(found: Float64, other: Float64, largest: float) -> npt.NDArray[np.bool_]:
    """Return which heights differ by more than a limit [m], or are read only once."""
    return np.asarray((np.isfinite(found) != np.isfinite(other)) | (np.abs(found - other) > largest))


if __name__ == "__main__":
    raise SystemExit(run_jobs(judge, (__doc__ or "").partition("\n\n")[2]))
