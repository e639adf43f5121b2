"""Light of a few profiles of a simulation at chosen settings, and the difference between two readings of them."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.sensor.simulated import make_sensor_view, make_simulator, require_light
from gpuvision.simulation.sensors.readings import PATHS, Reading, Simulator, height_secant, stack_profiles
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from gpuvision.workflows.light_cache import SimulationTask, make_light_paths

Float64 = npt.NDArray[np.float64]

# Standard errors of the mean over the profiles by which the mean square error is raised. Chosen: the mean over all
# profiles of a part exceeds it in few cases.
_STANDARD_ERRORS = 2.0
# Runs of a light whose shortest time counts, and the time [s] after which it is not repeated. Chosen: pauses of a busy
# machine hit one run or a few.
RUNS, _LEAST_TIME = 5, 0.4


@dataclass(frozen=True, kw_only=True)
class SimulationSettings:
    """Light paths and discretisations of a simulation.

    Attributes
    ----------
    paths : tuple of str
        Light paths, out of `gpuvision.simulation.sensors.readings.PATHS`.
    sub_sheets : int
        Number of slabs of the sheet of light, 1 or more.
    nodes : pair of ints
        Rays per bin along u and along v for indirect light, 1 or more each.
    patch_size : float
        Largest edge of the patches for multi-bounce light [m].
    tolerance : float
        Range error that omitted or clustered pairs may cause [m]; 0: all pairs are computed. Default 0.0.
    """

    paths: tuple[str, ...]
    sub_sheets: int
    nodes: tuple[int, int]
    patch_size: float
    tolerance: float = 0.0

    @classmethod
    def of(cls, task: SimulationTask) -> SimulationSettings:
        """Return the settings of a task."""
        light = require_light(task.sensor)
        size = task.patch_size
        if size is None:  # as `LightPaths`
            size = float(np.linalg.norm(np.ptp(task.part.corners.reshape(-1, 3), axis=0))) / 16.0
        return cls(
            paths=task.paths,
            sub_sheets=light.sub_sheets,
            nodes=light.nodes,
            patch_size=size,
            tolerance=task.tolerance,
        )

    def applied(self, task: SimulationTask) -> SimulationTask:
        """Return a task with these settings."""
        light = replace(require_light(task.sensor), sub_sheets=self.sub_sheets, nodes=self.nodes)
        return replace(
            task,
            sensor=replace(task.sensor, light=light),
            paths=self.paths,
            tolerance=self.tolerance,
            patch_size=self.patch_size,
        )

    @property
    def name(self) -> str:
        """Light paths, with the settings that matter to them."""
        parts = [each for each in self.paths if each in ("direct", "specular")]
        parts[0] += f" {self.sub_sheets}"
        if "diffuse-specular" in self.paths:
            parts.append("mirrors")
        if "diffuse-diffuse" in self.paths:
            clustered = f" {1e6 * self.tolerance:.3g} um" if self.tolerance else ""
            parts.append(f"diffuse {self.nodes[0]}x{self.nodes[1]}{clustered}")
        if "multi-bounce" in self.paths:
            parts.append(f"bounces {1e3 * self.patch_size:.3g} mm")
        return ", ".join(parts)


class SampledLight(NamedTuple):
    """Light of the sampled profiles.

    Attributes
    ----------
    exposures : dict of str to Exposure
        (profiles, samples, bins) by name of the light path.
    statistics : dict of str to float
        Largest value over the profiles of each number in `ProfileLight.statistics`.
    seconds : float
        Time of a profile [s].
    setup : float
        Time of the first profile beyond the time of others [s]: patches and their form factors, kernels.
    """

    exposures: dict[str, Exposure]
    statistics: dict[str, float]
    seconds: float
    setup: float


def sample_light(
    task: SimulationTask, places: Float64, device: Device, *, runs: int = RUNS, **changes: Any
) -> SampledLight:
    """Compute the light of a task at some transports.

    Parameters
    ----------
    task : SimulationTask
        Task with the settings to use.
    places : numpy.ndarray
        (profiles,): transports [m].
    device : Device
        Device of the kernels.
    runs : int
        Largest number of runs, 1 or more; the shortest time counts. Default 5.
    **changes
        Other parameters of `LightPaths`.
    """
    start = time.perf_counter()
    paths = replace(make_light_paths(task, device), **changes)
    paths.profile(float(places[0]))
    first = time.perf_counter() - start  # with the preparation
    taken: list[float] = []
    while not taken or (len(taken) < runs and sum(taken) < _LEAST_TIME):
        start = time.perf_counter()
        profiles = paths.profiles(places)
        taken.append(time.perf_counter() - start)
    seconds = min(taken) / len(places)
    exposures = stack_profiles([each.exposures for each in profiles])
    names = {name for each in profiles for name in each.statistics}
    statistics = {name: max(each.statistics.get(name, 0.0) for each in profiles) for name in names}
    kept = {name: each for name, each in exposures.items() if name in PATHS}
    return SampledLight(kept, statistics, seconds, max(first - seconds, 0.0))


def divided_light(
    task: SimulationTask, places: Float64, device: Device, factor: int, **changes: Any
) -> dict[str, Exposure]:
    """Compute the light of a task with bins divided into ``factor`` parts, and sum the parts of each bin.

    Light is blurred in the narrow bins: the error of the blur, which takes the light of a bin as a spot, falls too.
    """
    view = make_sensor_view(task.sensor)
    steps = np.arange(factor) / factor
    edges = np.append((view.u_edges[:-1, None] + np.diff(view.u_edges)[:, None] * steps).ravel(), view.u_edges[-1])
    paths = make_light_paths(task, device)
    fine = replace(
        paths, view=replace(view, u_edges=edges, axis=view.axis), end_bins=factor * paths.end_bins, **changes
    )
    light = stack_profiles([each.exposures for each in fine.profiles(places)])
    offset = fine.view.u_centres.reshape(-1, factor) - view.u_centres[:, None]

    def joined(each: Exposure) -> Exposure:
        power, moment = (part.reshape(*part.shape[:-1], view.bins, factor) for part in each)
        return Exposure(power.sum(axis=-1), np.sum(moment + power * offset, axis=-1))

    return {name: joined(each) for name, each in light.items() if name in PATHS}


class Difference(NamedTuple):
    """Difference between two readings of the same profiles.

    Attributes
    ----------
    error : float
        Range error [m]: root mean square, raised by twice the standard error of its mean over the profiles.
    worst : float
        Largest range error [m].
    signal : float
        Root mean square of the difference of the signals, as a fraction of the root mean square signal.
    changed : float
        Fraction of the samples that only one of the readings reads, or that the readings read on different lines.
    """

    error: float
    worst: float
    signal: float
    changed: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleReader:
    """Reader of sampled light without noise; compared by identity.

    Attributes
    ----------
    simulator : Simulator
        Sensor without a mask.
    fraction : float
        Sampled profiles as a fraction of all profiles, above 0 to 1: errors of all profiles have no standard error.
    device : Device
        Device of the readout.
    """

    simulator: Simulator
    fraction: float
    device: Device

    @classmethod
    def of(cls, task: SimulationTask, profiles: int, device: Device) -> SampleReader:
        """Return the reader for some profiles of a task."""
        return cls(
            simulator=make_simulator(task.sensor, make_sensor_view(task.sensor)),
            fraction=profiles / len(task.transports),
            device=device,
        )

    def read(self, exposures: Mapping[str, Exposure]) -> Reading:
        """Read light."""
        return self.simulator.read(exposures, device=self.device)

    def read_in_double(self, exposures: Mapping[str, Exposure]) -> Reading:
        """Read light with a readout in double precision."""
        simulator: Any = self.simulator
        double: Simulator = replace(simulator, readout=replace(simulator.readout, precision="double"))
        return double.read(exposures, device=self.device)

    def compare(self, found: Reading, reference: Reading) -> Difference:
        """Return the difference of a reading from a reference.

        The range error is the distance of the positions on the sensor times the derivative dH/du of the height at the
        position of the reference. Samples that the reference flags as ambiguous are not compared: two lines compete.
        """
        view, readout = self.simulator.view, getattr(self.simulator, "readout", None)
        moved = np.abs(found.position - reference.position)
        is_clear = (reference.status & Status.AMBIGUOUS) == 0
        read, expected = is_clear & np.isfinite(found.position), is_clear & np.isfinite(reference.position)
        # The centroid of a window moves by less than the window unless another line is read.
        jump = abs(readout.axes.position_pitch) * readout.window if isinstance(readout, LineReadout) else math.inf
        same = read & expected & ~(moved > jump)
        u = np.where(expected, reference.position, 0.0)
        slope = np.abs(height_secant(view.triangulation, u, u, view.v_centres))
        error = np.where(same, slope * moved, 0.0)
        counted = int((read | expected).sum())
        strength = np.where(same, reference.strength, 0.0)
        change = np.where(same, found.strength - reference.strength, 0.0)
        total = float(np.sum(strength**2))
        return Difference(
            error=self._root_mean_square(error, same),
            worst=float(error.max(initial=0.0)),
            signal=math.sqrt(float(np.sum(change**2)) / total) if total > 0.0 else 0.0,
            changed=(counted - int(same.sum())) / max(counted, 1),
        )

    def _root_mean_square(self, error: Float64, same: npt.NDArray[np.bool_]) -> float:
        """Return the root mean square (profiles, samples) over the counted samples, raised by its standard error."""
        counts = np.sum(same, axis=-1)
        if not counts.any():
            return math.nan
        squares = np.sum(error**2, axis=-1)
        mean = float(squares.sum() / counts.sum())
        if len(counts) < 2:
            return math.sqrt(mean)
        shares = squares - mean * counts  # residuals of the ratio estimate of the mean
        variance = float(np.sum(shares**2)) / (len(counts) - 1) / len(counts) / float(counts.mean()) ** 2
        return math.sqrt(mean + _STANDARD_ERRORS * math.sqrt(variance * (1.0 - self.fraction)))


@dataclass(frozen=True, kw_only=True, eq=False)
class ProfileSample:
    """Some profiles of a task, and their light by path at the settings of the task or others; compared by identity.

    Attributes
    ----------
    task : SimulationTask
        The task.
    places : numpy.ndarray
        (profiles,): transports of the sample [m].
    others : numpy.ndarray
        (others,): transports of other profiles, to check results [m].
    reader : SampleReader
        Reader of the light.
    device : Device
        Device of the kernels.
    """

    task: SimulationTask
    places: Float64
    others: Float64
    reader: SampleReader
    device: Device

    @classmethod
    def of(cls, task: SimulationTask, profiles: int, device: Device, *, others: int = 0) -> ProfileSample:
        """Return evenly spaced profiles of a task; all if it has fewer.

        Parameters
        ----------
        task : SimulationTask
            The task.
        profiles : int
            Number of profiles of the sample, 1 or more.
        device : Device
            Device of the kernels.
        others : int
            Number of evenly spaced profiles among the others, at most. Default 0.
        """
        chosen = _spaced(np.arange(len(task.transports)), profiles)
        rest = _spaced(np.setdiff1d(np.arange(len(task.transports)), chosen), others)
        return cls(
            task=task,
            places=task.transports[chosen],
            others=task.transports[rest],
            reader=SampleReader.of(task, len(chosen), device),
            device=device,
        )

    def light(self, settings: SimulationSettings, places: Float64 | None = None, **changes: Any) -> SampledLight:
        """Compute the light of settings, on other places than those of the sample if given.

        ``changes`` are other parameters of `LightPaths`, or ``runs`` of `sample_light`.
        """
        return sample_light(
            settings.applied(self.task), self.places if places is None else places, self.device, **changes
        )


def _spaced(numbers: npt.NDArray[np.int64], count: int) -> npt.NDArray[np.int64]:
    """Return evenly spaced elements, each in the middle of its part; all if there are fewer."""
    count = min(count, len(numbers))
    places: npt.NDArray[np.int64] = ((np.arange(count) + 0.5) * len(numbers) / max(count, 1)).astype(np.int64)
    return np.take(numbers, places)
