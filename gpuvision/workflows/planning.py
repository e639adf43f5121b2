"""One entry for all plans: the fastest settings of a job that meet a tolerance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, overload

import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.board.measurement_result import Copper
from gpuvision.sensor.sensor import Sensor
from gpuvision.servoing.placement.machine import Machine
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.workflows.location_plan import LocationPlan
from gpuvision.workflows.placement_plan import PlacementSettingsPlan
from gpuvision.workflows.planning_location import plan_location
from gpuvision.workflows.planning_placement import plan_placement_settings
from gpuvision.workflows.planning_scan import plan_scan
from gpuvision.workflows.planning_simulation import plan_simulation
from gpuvision.workflows.scan_plan import ScanPlan
from gpuvision.workflows.simulation_plan import SimulationPlan


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanJob:
    """Scan of a recording, for `plan`.

    Attributes
    ----------
    recording : str, Path or numpy.ndarray
        Recording, or frames: (frames, rows, columns) of a camera, (frames, strips, 2) of a PSD.
    sensor : Sensor
        Sensor of the recording, with its noise.
    """

    recording: str | Path | npt.NDArray[Any]
    sensor: Sensor


@dataclass(frozen=True, kw_only=True, eq=False)
class LocationJob:
    """Localization of a board, for `plan`; see `gpuvision.workflows.locating_board.locate_board` for the attributes.

    Attributes
    ----------
    image, artwork, scale
        Image of the board, its artwork, and the size of a pixel on the board [m].
    initial_pose, search_range, model
        Expected pose and search range, and lens or camera model. Default: as in `locate_board`.
    blur_px : float
        Standard deviation of the edges' blur [px]. Default 1.0.
    etch_bias_sigma : float
        Standard deviation of the etch bias [m]. Default 1e-05.
    threshold, noise, copper
        Least height of an edge, noise of a pixel [grey levels], and grey level of copper. Default: from the image.
    """

    image: npt.NDArray[Any]
    artwork: Artwork
    scale: float
    initial_pose: tuple[float, float, float] | None = None
    search_range: tuple[float, float] | None = None
    model: Lens | Camera | None = None
    blur_px: float = 1.0
    etch_bias_sigma: float = 10e-6
    threshold: float | None = None
    noise: float | None = None
    copper: Copper = "auto"


@dataclass(frozen=True, kw_only=True, eq=False)
class PlacementJob:
    """Placements on a board, for `plan`.

    Attributes
    ----------
    artwork, target, machine
        Side of the board, pose of the part on it [m], [m], [rad], and machine: see
        `gpuvision.workflows.planning_placement.plan_placement_settings`.
    part_radius : float, optional
        Distance from the nozzle at which the errors count [m]. Default: by the tolerances of the machine.
    max_rate : float, optional
        Largest frame rate of the camera link and the drives [Hz]. Default: the frame rate of the machine.
    budget : int
        Largest number of rulers. Default 60.
    times_vision : bool
        Measure the time of the vision, for several numbers of rulers. Default False: as in the machine file.
    """

    artwork: Artwork
    target: npt.ArrayLike
    machine: Machine
    part_radius: float | None = None
    max_rate: float | None = None
    budget: int = 60
    times_vision: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class SimulationJob:
    """Simulation of a scan, for `plan`.

    Attributes
    ----------
    part : Scene
        Part in the sensor's coordinates.
    materials : sequence of Material
        A material for every number in `Scene.material`.
    sensor : Sensor
        Sensor with a light and a straight transport.
    paths : sequence of str
        Light paths that may be needed, out of "direct", "specular", "diffuse-specular", "diffuse-diffuse" and
        "multi-bounce". Default: all.
    patch_size, profiles, transports
        Smallest patches of multi-bounce light [m], number of profiles, and positions of the sheet [m]. Default: as in
        `gpuvision.workflows.simulating.prepare_simulation`.
    """

    part: Scene
    materials: Sequence[Material]
    sensor: Sensor
    paths: Sequence[str] = PATHS
    patch_size: float | None = None
    profiles: int | None = None
    transports: npt.ArrayLike | None = None


@overload
def plan(
    job: ScanJob,
    *,
    tolerance: float,
    rate: float | None = ...,
    latency: float | None = ...,
    device: Device | None = ...,
) -> ScanPlan: ...


@overload
def plan(
    job: LocationJob,
    *,
    tolerance: float,
    rate: float | None = ...,
    latency: float | None = ...,
    device: Device | None = ...,
) -> LocationPlan: ...


@overload
def plan(
    job: PlacementJob,
    *,
    tolerance: float,
    rate: float | None = ...,
    latency: float | None = ...,
    device: Device | None = ...,
) -> PlacementSettingsPlan: ...


@overload
def plan(
    job: SimulationJob,
    *,
    tolerance: float,
    rate: float | None = ...,
    latency: float | None = ...,
    device: Device | None = ...,
) -> SimulationPlan: ...


def plan(
    job: ScanJob | LocationJob | PlacementJob | SimulationJob,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    device: Device | None = None,
) -> ScanPlan | LocationPlan | PlacementSettingsPlan | SimulationPlan:
    """Choose the fastest settings of a job whose predicted error meets a tolerance.

    Parameters
    ----------
    job : ScanJob, LocationJob, PlacementJob or SimulationJob
        Scan of a recording, localization of a board, placements on a board, or simulation of a scan.
    tolerance : float
        Largest error of the heights, of the pose at the features of the board, of the placed part, or of the simulated
        range [m].
    rate : float, optional
        Frames, placements, or simulated profiles per second that the settings must keep up with [1/s].
    latency : float, optional
        Longest acceptable time from a frame to its result, of a placement, or of a simulated profile [s]; needs a rate.
    device : Device, optional
        Default `Device.best`.

    Returns
    -------
    ScanPlan, LocationPlan, PlacementSettingsPlan or SimulationPlan
        Chosen settings, all that were tried, and what another tolerance gives.

    Raises
    ------
    PlanError
        No settings meet the tolerance, or none of them keeps up with the rate.
    TypeError
        The job is of another type.
    ValueError
        As `gpuvision.workflows.planning_scan.plan_scan`, `gpuvision.workflows.planning_location.plan_location`,
        `gpuvision.workflows.planning_placement.plan_placement_settings` and
        `gpuvision.workflows.planning_simulation.plan_simulation`, which also take other options.
    """
    planners: dict[type, Callable[..., Any]] = {
        ScanJob: plan_scan,
        LocationJob: plan_location,
        PlacementJob: plan_placement_settings,
        SimulationJob: plan_simulation,
    }
    planner = planners.get(type(job))
    if planner is None:
        expected = "a ScanJob, a LocationJob, a PlacementJob or a SimulationJob"
        raise TypeError(f"job is a {type(job).__name__}, expected {expected}")
    options: dict[str, Any] = {each.name: getattr(job, each.name) for each in fields(job)}
    options |= {"tolerance": tolerance, "rate": rate, "latency": latency, "device": device}
    found: ScanPlan | LocationPlan | PlacementSettingsPlan | SimulationPlan = planner(**options)
    return found
