"""Survey of the profiles of a simulation: which of them a plan should try."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.simulation.light_paths import LightPaths
from gpuvision.simulation.sensors.readings import stack_profiles
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.workflows.light_cache import PROFILES_PER_BLOCK, SimulationTask, make_light_paths
from gpuvision.workflows.simulation_errors import DIRECT, scene_paths
from gpuvision.workflows.simulation_sample import SampleReader, SimulationSettings, evenly_spaced

Float64 = npt.NDArray[np.float64]


def profile_shares(task: SimulationTask, count: int, device: Device) -> Float64:
    """Return the share of each profile in a sample, in which profiles with large errors are frequent.

    A light path left out, slabs and rays change few profiles by much: where the sheet passes a wall or grazes an edge,
    and where a ray runs beside a lit line. The coarsest light of some profiles shows which ones. A quarter or more of
    the shares is equal for all profiles, because finer light may change others.

    Parameters
    ----------
    task : SimulationTask
        The task.
    count : int
        Largest number of profiles that are surveyed, evenly spaced; between them changes are interpolated.
    device : Device
        Device of the kernels.

    Returns
    -------
    numpy.ndarray
        (profiles,): shares, with the sum 1.
    """
    every = np.arange(len(task.transports))
    chosen = evenly_spaced(len(every), count)
    changes = np.concatenate(list(_changes(task, task.transports[chosen], device)))
    shares = [np.ones(len(every)), *(np.interp(every, chosen, each) for each in changes.T)]
    return np.asarray(np.mean([each / each.sum() for each in shares if each.any()], axis=0))


def _changes(task: SimulationTask, places: Float64, device: Device) -> Iterator[Float64]:
    """Yield the mean square changes (profiles, 3) of the readings by indirect light, by slabs, and by rays."""
    reader, settings = SampleReader.of(task, device), SimulationSettings.of(task)
    there = scene_paths(task)
    paths = [each for each in task.paths if each in there]
    direct = tuple(each for each in DIRECT if each in paths)
    indirect = tuple(each for each in ("diffuse-specular", "diffuse-diffuse") if each in paths)
    u, v = settings.nodes
    one_slab = replace(settings, paths=direct, sub_sheets=1, tolerance=0.0)
    slabs = replace(one_slab, sub_sheets=settings.sub_sheets)
    rays = replace(one_slab, paths=("direct", *indirect))
    lights = [
        (make_light_paths(each.applied(task), device), names)
        for each, names in (
            (slabs, direct),
            (one_slab, direct),
            (rays, indirect),
            (replace(rays, nodes=(u, 2 * v)), indirect),
        )
    ]
    for first in range(0, len(places), PROFILES_PER_BLOCK):
        block = places[first : first + PROFILES_PER_BLOCK]
        by_slabs, by_one, by_rays, by_more = (_light(paths, names, block) for paths, names in lights)
        whole = reader.read(by_slabs | by_rays)
        others = (by_slabs, by_one | by_rays, by_slabs | by_more)
        yield np.stack([reader.mean_squares(reader.read(each), whole) for each in others], axis=1)


def _light(paths: LightPaths, names: Sequence[str], places: Float64) -> dict[str, Exposure]:
    """Return the light of some paths by name (profiles, samples, bins); nothing is computed for no paths."""
    if not names:
        return {}
    light = stack_profiles([each.exposures for each in paths.profiles(places)])
    return {name: light[name] for name in names if name in light}
