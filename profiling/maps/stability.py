"""Measured stability maps: relative error against float64 over a grid of inputs."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device

OPERATIONS = (
    *("psd", "triangulation", "line", "undistort_points", "ruler", "line_fit", "pose"),
    *("range_image", "merge_heights", "deposits", "reflectance", "line_irradiance", "rays", "blob", "board_image"),
    *("any_hit", "occluded_irradiance", "undistort_image", "board_pose", "feature_pose", "field_search"),
    "field_refinement",
)
"""Operations with a map: names of the modules of this package."""
LIMITS = (1e-6, 1e-3)
"""Relative errors that bound the regions of a map."""
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Axis:
    """Axis of a map.

    Attributes
    ----------
    name : str
        Input along the axis, with its unit in brackets.
    low, high : float
        Ends of the axis.
    logarithmic : bool
        Whether places are spaced by equal ratios.
    """

    name: str
    low: float
    high: float
    logarithmic: bool = True

    def at(self, shares: npt.ArrayLike) -> Floats:
        """Return the inputs at fractions 0 to 1 of the axis."""
        share = np.asarray(shares, np.float64)
        if self.logarithmic:
            return np.asarray(self.low * (self.high / self.low) ** share)
        return np.asarray(self.low + (self.high - self.low) * share)


@dataclass(frozen=True)
class Problem:
    """Inputs of an operation in a plane of two axes.

    Attributes
    ----------
    axes : tuple of Axis
        Axes of the map, x and y.
    relative_to : str
        Quantity that divides the error.
    errors : callable
        Function of a device, places (n, 2) and a random generator: the relative errors (n,) of one random input at each
        place; NaN where the operation gives no value.
    bound : callable
        Function of places (n, 2): the relative errors (n,) that the error model allows.
    """

    axes: tuple[Axis, Axis]
    relative_to: str
    errors: Callable[[Device, Floats, np.random.Generator], Floats]
    bound: Callable[[Floats], Floats]

    def places(self, shares: npt.ArrayLike) -> Floats:
        """Return the places (n, 2) at fractions (n, 2) of the axes."""
        return np.stack([axis.at(share) for axis, share in zip(self.axes, np.transpose(shares), strict=True)], axis=-1)


@dataclass(frozen=True)
class StabilityMap:
    """Measured map.

    Attributes
    ----------
    operation, device : str
        Name of the operation, and label of the device.
    axes : tuple of Axis
        Axes of the map, x and y.
    relative_to : str
        Quantity that divides the error.
    x, y : numpy.ndarray
        Places of the columns and of the rows of the grid.
    errors : numpy.ndarray
        Largest relative error of the random inputs at each place (rows, columns); NaN where one has no value.
    bounds : numpy.ndarray
        Relative error that the error model allows.
    """

    operation: str
    device: str
    axes: tuple[Axis, Axis]
    relative_to: str
    x: Floats
    y: Floats
    errors: Floats
    bounds: Floats

    def share(self, limit: float) -> float:
        """Return the fraction of the places with an error below a limit."""
        return float(np.mean(self.errors < limit))

    def allowed(self, limit: float) -> float:
        """Return the fraction of the places where the error model allows an error below a limit."""
        return float(np.mean(self.bounds < limit))

    def to_dict(self) -> dict[str, Any]:
        """Return the map for JSON."""
        arrays = {name: getattr(self, name).tolist() for name in ("x", "y", "errors", "bounds")}
        regions = [{"limit": each, "share": self.share(each), "allowed": self.allowed(each)} for each in LIMITS]
        return {
            "operation": self.operation,
            "device": self.device,
            "axes": [asdict(axis) for axis in self.axes],
            "relative_to": self.relative_to,
            "regions": regions,
            **arrays,
        }


def problem_of(operation: str) -> Problem:
    """Return the problem of an operation.

    Raises
    ------
    ValueError
        The operation has no map.
    """
    if operation not in OPERATIONS:
        raise ValueError(f"no map of {operation!r}; expected some of {', '.join(OPERATIONS)}")
    found: Problem = importlib.import_module(f"gpuvision.profiling.maps.{operation}").problem()
    return found


def measure_maps(
    operations: Sequence[str],
    devices: Sequence[Device],
    *,
    size: int = 32,
    draws: int = 8,
    progress: Callable[[str], None] = lambda line: None,
) -> list[StabilityMap]:
    """Measure the maps of operations on devices.

    Parameters
    ----------
    operations : sequence of str
        Names in `OPERATIONS`.
    devices : sequence of Device
        Devices to measure on.
    size : int
        Number of places along each axis.
    draws : int
        Number of random inputs at each place.
    progress : callable
        Function that is called with lines of text about the progress.

    Raises
    ------
    ValueError
        An operation has no map.
    """
    problems = {operation: problem_of(operation) for operation in operations}
    maps = []
    for operation, problem in problems.items():
        for device in devices:
            progress(f"map of {operation} on {device.label}")
            maps.append(_measure(operation, problem, device, size, draws))
    return maps


def _measure(operation: str, problem: Problem, device: Device, size: int, draws: int) -> StabilityMap:
    shares = (np.arange(size) + 0.5) / size
    x, y = np.meshgrid(shares, shares)
    places = problem.places(np.stack([x.ravel(), y.ravel()], axis=-1))
    rng = np.random.default_rng(1)
    every = [problem.errors(device, places, rng) for _ in range(draws)]
    return StabilityMap(
        operation=operation,
        device=device.label,
        axes=problem.axes,
        relative_to=problem.relative_to,
        x=problem.axes[0].at(shares),
        y=problem.axes[1].at(shares),
        errors=np.max(every, axis=0).reshape(size, size),
        bounds=problem.bound(places).reshape(size, size),
    )
