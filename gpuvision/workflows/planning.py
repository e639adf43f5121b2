"""One entry for all plans: the fastest settings of a job that meet a tolerance."""

from __future__ import annotations

from collections.abc import Callable
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
from gpuvision.workflows.location_plan import LocationPlan
from gpuvision.workflows.placement_plan import PlacementSettingsPlan
from gpuvision.workflows.planning_location import plan_location
from gpuvision.workflows.planning_placement import plan_placement_settings
from gpuvision.workflows.planning_scan import plan_scan
from gpuvision.workflows.scan_plan import ScanPlan


@dataclass(frozen=True, kw_only=True, eq=False)
class ScanJob:
    """Scan of a recording, for `plan`.

    Attributes
    ----------
    recording : str, Path or numpy.ndarray
        Camera recording, or frames (frames, rows, columns).
    sensor : Sensor
        Sensor of the recording, with the noise of its camera.
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


def plan(
    job: ScanJob | LocationJob | PlacementJob,
    *,
    tolerance: float,
    rate: float | None = None,
    latency: float | None = None,
    device: Device | None = None,
) -> ScanPlan | LocationPlan | PlacementSettingsPlan:
    """Choose the fastest settings of a job whose predicted error meets a tolerance.

    Parameters
    ----------
    job : ScanJob, LocationJob or PlacementJob
        Scan of a recording, localization of a board, or placements on a board.
    tolerance : float
        Largest error of the heights, of the pose at the features of the board, or of the placed part [m].
    rate : float, optional
        Frames, or placements, per second that the settings must keep up with [1/s].
    latency : float, optional
        Longest acceptable time from a frame to its result, or of a placement [s]; needs a rate.
    device : Device, optional
        Default `Device.best`.

    Returns
    -------
    ScanPlan, LocationPlan or PlacementSettingsPlan
        Chosen settings, all that were tried, and what another tolerance gives.

    Raises
    ------
    PlanError
        No settings meet the tolerance, or none of them keeps up with the rate.
    TypeError
        The job is of another type.
    ValueError
        As `gpuvision.workflows.planning_scan.plan_scan`, `gpuvision.workflows.planning_location.plan_location` and
        `gpuvision.workflows.planning_placement.plan_placement_settings`, which also take other options.
    """
    planners: dict[type, Callable[..., Any]] = {
        ScanJob: plan_scan,
        LocationJob: plan_location,
        PlacementJob: plan_placement_settings,
    }
    planner = planners.get(type(job))
    if planner is None:
        raise TypeError(f"job is a {type(job).__name__}, expected a ScanJob, a LocationJob or a PlacementJob")
    options: dict[str, Any] = {each.name: getattr(job, each.name) for each in fields(job)}
    options |= {"tolerance": tolerance, "rate": rate, "latency": latency, "device": device}
    found: ScanPlan | LocationPlan | PlacementSettingsPlan = planner(**options)
    return found
