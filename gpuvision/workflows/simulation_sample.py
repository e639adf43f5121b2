"""Light of a few profiles of a simulation at chosen settings, and the difference between two readings of them."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.sensor.simulated import make_sensor_view, make_simulator, require_light
from gpuvision.simulation.light_paths import SolverKey
from gpuvision.simulation.sensors.readings import PATHS, Reading, Simulator, height_secant, stack_profiles
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.radiosity import Radiosity
from gpuvision.status import Status
from gpuvision.workflows.light_cache import PROFILES_PER_BLOCK, SimulationTask, make_light_paths

Float64 = npt.NDArray[np.float64]

# The mean square error over the profiles of a sample is raised and lowered by this many standard errors. Chosen: the
# mean over all profiles of a part is rarely outside these limits.
_STANDARD_ERRORS = 2.0
# Runs of a light whose shortest time counts, and the time [s] after which it is not repeated. Chosen: pauses of a busy
# machine hit one run or a few. On a very busy one they hit each of five runs of 10 ms; 20 take most of the planning.
RUNS, _LEAST_TIME = 8, 0.2


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
    bounce_nodes : pair of ints, optional
        Rays per bin along u and along v for multi-bounce light. Default: ``nodes``.
    """

    paths: tuple[str, ...]
    sub_sheets: int
    nodes: tuple[int, int]
    patch_size: float
    tolerance: float = 0.0
    bounce_nodes: tuple[int, int] | None = None

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
            bounce_nodes=task.bounce_nodes,
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
            bounce_nodes=self.bounce_nodes,
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
            u, v = self.nodes if self.bounce_nodes is None else self.bounce_nodes
            parts.append(f"bounces {u}x{v} {1e3 * self.patch_size:.3g} mm")
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
        Largest number of runs, 1 or more; the shortest time counts. Default 8.
    **changes
        Other parameters of `LightPaths`.
    """
    start = time.perf_counter()
    paths = replace(make_light_paths(task, device), **changes)
    paths.profile(float(places[0]))
    first = time.perf_counter() - start  # with the preparation
    start = time.perf_counter()
    profiles = paths.profiles(places)
    spent = time.perf_counter() - start
    taken, block = [spent / len(places)], np.resize(places, PROFILES_PER_BLOCK)
    while len(taken) < runs and spent < _LEAST_TIME:  # as many profiles as a simulation computes together
        start = time.perf_counter()
        paths.profiles(block)
        spent += time.perf_counter() - start
        taken.append((time.perf_counter() - start) / len(block))
    seconds = min(taken)
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
        Upper limit of the range error [m]: root of the mean square plus twice the standard error of this mean over
        the profiles.
    least : float
        Lower limit of the range error [m]: root of the mean square minus twice its standard error, 0 at least.
    worst : float
        Largest range error [m].
    signal : float
        Root mean square of the difference of the signals, as a fraction of the root mean square signal.
    changed : float
        Fraction of the samples that only one of the readings reads, or that the readings read on different lines.
    least_changed : float
        Lower limit of this fraction: minus twice its standard error over the profiles, 0 at least.
    """

    error: float
    least: float
    worst: float
    signal: float
    changed: float
    least_changed: float


@dataclass(frozen=True, kw_only=True, eq=False)
class SampleReader:
    """Reader of sampled light without noise; compared by identity.

    Attributes
    ----------
    simulator : Simulator
        Sensor without a mask.
    profiles : int
        Number of profiles of the part: the mean error of all of them has no standard error.
    device : Device
        Device of the readout.
    """

    simulator: Simulator
    profiles: int
    device: Device

    @classmethod
    def of(cls, task: SimulationTask, device: Device) -> SampleReader:
        """Return the reader for profiles of a task."""
        return cls(
            simulator=make_simulator(task.sensor, make_sensor_view(task.sensor)),
            profiles=len(task.transports),
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

    def compare(self, found: Reading, reference: Reading, chances: Float64 | None = None) -> Difference:
        """Return the difference of a reading from a reference.

        The range error is the distance of the positions on the sensor times the derivative dH/du of the height at the
        position of the reference. Samples that the reference flags as ambiguous are not compared: two lines compete.

        Parameters
        ----------
        found, reference : Reading
            Readings of the same profiles.
        chances : numpy.ndarray, optional
            (profiles,): chance of each profile to be in the sample, above 0, to 1: a profile stands for one over its
            chance of the part's profiles. None: all profiles of the part have the same chance.
        """
        error, same, counted = self._range_errors(found, reference)
        strength = np.where(same, reference.strength, 0.0)
        change = np.where(same, found.strength - reference.strength, 0.0)
        if chances is None:
            chances = np.full(len(error), min(len(error) / self.profiles, 1.0))
        squares, total = (float(np.sum(np.sum(each**2, axis=-1) / chances)) for each in (change, strength))
        least, most = self._root_mean_square(error, same, chances)
        changed, deviation = self._mean(counted & ~same, counted, chances)
        return Difference(
            error=most,
            least=least,
            worst=float(error.max(initial=0.0)),
            signal=math.sqrt(squares / total) if total > 0.0 else 0.0,
            changed=changed,
            least_changed=max(changed - deviation, 0.0),
        )

    def mean_squares(self, found: Reading, reference: Reading) -> Float64:
        """Return the mean square range error of each profile (profiles,) [m^2]; 0 where nothing is compared."""
        error, same, _ = self._range_errors(found, reference)
        return np.asarray(np.sum(error**2, axis=-1) / np.maximum(np.sum(same, axis=-1), 1))

    def _range_errors(
        self, found: Reading, reference: Reading
    ) -> tuple[Float64, npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
        """Return range errors [m], which samples both readings read on the same line, and which ones count."""
        view, readout = self.simulator.view, getattr(self.simulator, "readout", None)
        moved = np.abs(found.position - reference.position)
        is_clear = (reference.status & Status.AMBIGUOUS) == 0
        read, expected = is_clear & np.isfinite(found.position), is_clear & np.isfinite(reference.position)
        # The centroid of a window moves by less than the window unless another line is read.
        jump = abs(readout.axes.position_pitch) * readout.window if isinstance(readout, LineReadout) else math.inf
        same = read & expected & ~(moved > jump)
        u = np.where(expected, reference.position, 0.0)
        slope = np.abs(height_secant(view.triangulation, u, u, view.v_centres))
        return np.where(same, slope * moved, 0.0), same, read | expected

    def _root_mean_square(self, error: Float64, same: npt.NDArray[np.bool_], chances: Float64) -> tuple[float, float]:
        """Return limits of the root mean square (profiles, samples) over the counted samples, by its standard error."""
        if not same.any():
            return math.nan, math.nan
        mean, deviation = self._mean(error**2, same, chances)
        return math.sqrt(max(mean - deviation, 0.0)), math.sqrt(mean + deviation)

    @staticmethod
    def _mean(values: npt.NDArray[Any], counted: npt.NDArray[np.bool_], chances: Float64) -> tuple[float, float]:
        """Return the mean of values (profiles, samples) over the counted samples, and twice its standard error.

        All other values are 0. There is no standard error of a single profile, and of profiles that are certainly in
        the sample. Otherwise it is that of a sample with unequal chances (Hajek, 1964).
        """
        sums, counts = np.sum(values, axis=-1) / chances, np.sum(counted, axis=-1) / chances
        if not counts.any():
            return 0.0, 0.0
        mean, number = float(sums.sum() / counts.sum()), len(counts)
        if number < 2:
            return mean, 0.0
        shares = sums - mean * counts  # residuals of the ratio estimate of the mean
        variance = float(np.sum((1.0 - chances) * shares**2)) * number / (number - 1)
        return mean, _STANDARD_ERRORS * math.sqrt(variance) / float(counts.sum())


def join_readings(readings: Sequence[Reading]) -> Reading:
    """Return the readings (profiles, samples) of several groups of profiles as one."""
    return Reading(*(np.concatenate(each) for each in zip(*readings, strict=True)))


@dataclass(frozen=True, kw_only=True, eq=False)
class ProfileSample:
    """Some profiles of a task, and their light by path at the settings of the task or others; compared by identity.

    Attributes
    ----------
    task : SimulationTask
        The task.
    places : numpy.ndarray
        (profiles,): transports of the sample [m].
    others : tuple of numpy.ndarray
        (others,) each: transports of groups of other profiles, to judge settings more closely [m].
    numbers : tuple of numpy.ndarray
        Numbers of the profiles of the sample and of each group, among the transports of the task.
    shares : numpy.ndarray
        (transports,): shares of all profiles in the groups, as `of` takes them.
    reader : SampleReader
        Reader of the light.
    device : Device
        Device of the kernels.
    solvers : dict
        Radiosity solutions that `light` has made, as in `LightPaths`: they take most of the time.
    """

    task: SimulationTask
    places: Float64
    others: tuple[Float64, ...]
    numbers: tuple[npt.NDArray[np.int64], ...]
    shares: Float64
    reader: SampleReader
    device: Device
    solvers: dict[SolverKey, Radiosity] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        task: SimulationTask,
        profiles: int,
        device: Device,
        *,
        others: Sequence[int] = (),
        shares: Float64 | None = None,
    ) -> ProfileSample:
        """Return evenly spaced profiles of a task; all if it has fewer.

        Parameters
        ----------
        task : SimulationTask
            The task.
        profiles : int
            Number of profiles of the sample, 1 or more.
        device : Device
            Device of the kernels.
        others : sequence of int
            Largest number of profiles of each group of other profiles, out of the rest. Groups without profiles are
            left out. Default: no groups.
        shares : numpy.ndarray, optional
            (transports,): shares of the profiles in the groups, with the sum 1: systematic samples with these chances.
            None: evenly spaced ones.
        """
        every = np.arange(len(task.transports))
        shares = np.full(len(every), 1.0 / len(every)) if shares is None else shares
        chosen = [evenly_spaced(len(every), profiles)]
        for count in others:
            rest = np.setdiff1d(every, np.concatenate(chosen))
            chosen.append(rest[_systematic(shares[rest], count)])
        kept = [each for number, each in enumerate(chosen) if len(each) or not number]
        places = [task.transports[each] for each in kept]
        return cls(
            task=task,
            places=places[0],
            others=tuple(places[1:]),
            numbers=tuple(kept),
            shares=shares,
            reader=SampleReader.of(task, device),
            device=device,
        )

    def chances(self, groups: int) -> Float64:
        """Return the chances of the profiles of the sample and of the first groups to be in any of these.

        Parameters
        ----------
        groups : int
            Number of groups of other profiles, 0 or more.
        """
        even = min(len(self.places) / len(self.shares), 1.0)
        drawn = sum(map(len, self.numbers[1 : groups + 1]))
        if not drawn:
            return np.full(len(self.places), even)
        chances = even + (1.0 - even) * _chances(self.shares, drawn / (1.0 - even))  # drawn from the rest
        return np.asarray(chances[np.concatenate(self.numbers[: groups + 1])])

    def light(self, settings: SimulationSettings, places: Float64 | None = None, **changes: Any) -> SampledLight:
        """Compute the light of settings, on other places than those of the sample if given.

        ``changes`` are other parameters of `LightPaths`, or ``runs`` of `sample_light`. The time of the preparation is
        that of the patches that no earlier light had: of the given size, and of twice this size.
        """
        where = self.places if places is None else places
        return sample_light(settings.applied(self.task), where, self.device, **{"solvers": self.solvers, **changes})


def evenly_spaced(size: int, count: int) -> npt.NDArray[np.int64]:
    """Return ``count`` of the numbers below ``size``, each in the middle of its part; all if there are fewer."""
    count = min(count, size)
    numbers: npt.NDArray[np.int64] = ((np.arange(count) + 0.5) * size / max(count, 1)).astype(np.int64)
    return numbers


def _systematic(shares: Float64, count: int) -> npt.NDArray[np.int64]:
    """Return about ``count`` of the numbers of shares: a systematic sample with chances in proportion to them."""
    if not (count := min(count, len(shares))):
        return np.zeros(0, np.int64)
    picks = np.searchsorted(np.cumsum(_chances(shares, count)), np.arange(count) + 0.5, side="right")
    return np.unique(np.minimum(picks, len(shares) - 1))


def _chances(shares: Float64, count: float) -> Float64:
    """Return chances in proportion to shares, 1 at most, with the sum ``count``."""
    certain = np.zeros(len(shares), bool)
    while True:  # chances above 1 become certain, which raises the others
        free = shares[~certain].sum()
        left = max(count - np.count_nonzero(certain), 0.0) / free if free > 0.0 else 0.0
        chances = np.where(certain, 1.0, left * shares)
        if not np.any(chances > 1.0):
            return chances
        certain |= chances > 1.0
