"""Common part of simulated sensors: light by path, ground truth, and heights of positions on the sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]

PATHS = ("direct", "specular", "diffuse-specular", "diffuse-diffuse", "multi-bounce")
"""Light paths from the sheet of light to the lens. The sensor receives the sum of all paths."""
AMBIENT = "ambient"
"""Light of other sources than the sheet."""
UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED = "direct, uniform", "direct, unoccluded", "direct, uniform, unoccluded"
"""Hypothetical variants of the direct light: with uniform reflectivity of all surfaces, without occlusion between
surfaces and lens, and both. They serve to attribute errors; the sensor never receives them."""
BEYOND_ENDS = "direct, beyond the ends"
"""Direct light that misses a sample beyond its ends in u, as power and first moment in its first and last bin. It
serves to attribute errors; the sensor never receives it."""
# For positions closer than this fraction of the region, the lens' derivative replaces the secant: a difference quotient
# loses digits there. Chosen: the rounding error of the quotient stays below about 2e-10, and the derivative at one end
# differs from the secant by about 1e-6 times the relative curvature of the distortion.
_MIN_SECANT = 1e-6
_RECEIVED, _KNOWN = (*PATHS, AMBIENT), (*PATHS, AMBIENT, UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED, BEYOND_ENDS)


@dataclass(frozen=True, kw_only=True)
class AlignmentLimits:
    """Allowed differences between the descriptions of a view and of its readout, which differ by rounding.

    Attributes
    ----------
    edge_tolerance : float
        Difference between the edges of the view and of the readout along u. Camera: fraction of a pixel. PSD: fraction
        of half a strip. Chosen. Default 1e-6.
    pitch_tolerance : float
        Difference between the samples of the view and of the readout along v, as a fraction of the pitch. Chosen.
        Default 1e-6.
    """

    edge_tolerance: float = 1e-6
    pitch_tolerance: float = 1e-6


class GroundTruth(NamedTuple):
    """True position of the lit surface in each sample, arrays (..., samples).

    Attributes
    ----------
    g, h
        float64, point in the sheet of light [m]; NaN where no lit surface is visible.
    status
        uint8 `Status` flags: LOW_SIGNAL (no lit surface is visible), AMBIGUOUS (several are), OUT_OF_RANGE (the lit
        surface is imaged beyond the ends of the sensor in u; its point is given if light of it may reach the sensor).
    """

    g: npt.NDArray[Any]
    h: npt.NDArray[Any]
    status: npt.NDArray[Any]


class Reading(NamedTuple):
    """Reading of a simulated sensor, arrays (..., samples).

    Attributes
    ----------
    position
        float64, position along u [sensor unit]; NaN where the status allows no value.
    g, h
        float64, point in the sheet of light [m].
    sigma
        float64, standard deviation of h from the sensor's noise [m].
    strength
        float64, light of the reading in the unit of the readout (A for PSDs, grey levels for cameras).
    width
        float64, number of pixels of the line over the threshold; NaN for PSDs.
    status
        uint8 `Status` flags.
    """

    position: Float64
    g: Float64
    h: Float64
    sigma: Float64
    strength: Float64
    width: Float64
    status: npt.NDArray[np.uint8]


class Simulator(Protocol):
    """A simulated sensor: `PsdSimulator` or `CameraSimulator`."""

    @property
    def view(self) -> SensorView:
        """View of the sensor."""
        ...

    def detected_light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light by path that contributes to readings: behind the mask, with the ambient light."""
        ...

    def signal(self, light: Exposure) -> npt.NDArray[Any]:
        """Return the signal of light behind the mask. The signal of a sum of exposures is the sum of their signals."""
        ...

    def heights(self, signal: npt.NDArray[Any], device: Device | None = None) -> Float64:
        """Read a signal without noise: heights [m], (..., samples)."""
        ...

    def read(
        self,
        exposures: Mapping[str, Exposure],
        *,
        seed: int | None = None,
        first_profile: int = 0,
        device: Device | None = None,
    ) -> Reading:
        """Simulate and read a block of profiles."""
        ...


def stack_profiles(profiles: Sequence[Mapping[str, Exposure]]) -> dict[str, Exposure]:
    """Stack the light of profiles, (samples, bins) by path, to a block (profiles, samples, bins) by path.

    A path that a profile lacks is dark in that profile.

    Raises
    ------
    ValueError
        There is no profile, or a profile has no path.
    """
    names = list(dict.fromkeys(name for each in profiles for name in each))
    if not names or not all(profiles):
        raise ValueError("expected one or more profiles, each with the light of one path or more")
    dark = dark_exposure(profiles[0])
    light = {name: [each.get(name, dark) for each in profiles] for name in names}
    return {
        name: Exposure(np.stack([each.power for each in row]), np.stack([each.moment for each in row]))
        for name, row in light.items()
    }


def dark_exposure(exposures: Mapping[str, Exposure]) -> Exposure:
    """Return an exposure without light, of the shape of the given ones.

    Raises
    ------
    ValueError
        There is no exposure.
    """
    if not exposures:
        raise ValueError(f"expected light of one path or more; paths are {', '.join(PATHS)}")
    like = next(iter(exposures.values()))
    return Exposure(np.zeros_like(like.power), np.zeros_like(like.power))


def total_exposure(exposures: Mapping[str, Exposure]) -> Exposure:
    """Return the sum of the light of all paths and the ambient light. Hypothetical variants are not added.

    Raises
    ------
    ValueError
        A path is unknown, or shapes differ.
    """
    for name in exposures:
        if name not in _KNOWN:
            raise ValueError(f"unknown path {name!r}, expected some of {', '.join(_KNOWN)}")
    if len({each.power.shape for each in exposures.values()}) > 1:
        raise ValueError("the paths' light has different shapes, expected one (..., samples, bins)")
    lit = [exposures[name] for name in _RECEIVED if name in exposures] or [dark_exposure(exposures)]
    return Exposure(_sum([each.power for each in lit]), _sum([each.moment for each in lit]))


def _sum(parts: Sequence[Float64]) -> Float64:
    total = parts[0] if len(parts) == 1 else parts[0] + parts[1]
    for each in parts[2:]:
        total += each
    return total


def add_ambient(view: SensorView, exposures: Mapping[str, Exposure], power: float) -> dict[str, Exposure]:
    """Return the light with added ambient light, uniform along u.

    Parameters
    ----------
    view
        View of the sensor.
    exposures
        Light by path, (..., samples, bins).
    power
        Ambient power of each sample [W].

    Raises
    ------
    ValueError
        There is no light path, or a shape does not fit the view.
    """
    if exposures.keys().isdisjoint(PATHS):
        raise ValueError(
            f"expected light of one path or more out of {', '.join(PATHS)}, got {list(exposures) or 'none'}"
        )
    light = dict(exposures)
    for name, each in light.items():
        if each.power.shape[-2:] != (view.samples, view.bins):
            raise ValueError(f"{name}: light has shape {each.power.shape}, expected (..., {view.samples}, {view.bins})")
    if power:
        like = light[AMBIENT] if AMBIENT in light else dark_exposure(light)
        share = np.diff(view.u_edges) / (view.u_edges[-1] - view.u_edges[0])
        light[AMBIENT] = Exposure(like.power + power * share, like.moment)
    return light


def profile_generators(seed: int, first_profile: int, profiles: tuple[int, ...]) -> list[np.random.Generator]:
    """Return a random generator for each profile; its state depends only on the seed and the profile's number."""
    return [np.random.default_rng([seed, first_profile + each]) for each in range(math.prod(profiles))]


def check_not_negative(simulator: Any, *names: str) -> None:
    """Check that parameters of a simulator are finite numbers, 0 or more.

    Raises
    ------
    TypeError, ValueError
        A parameter is not.
    """
    for name in names:
        if finite(getattr(simulator, name), f"{type(simulator).__name__}.{name}") < 0.0:
            raise ValueError(f"{type(simulator).__name__}.{name} is {getattr(simulator, name)}, expected 0 or more")


def check_sample_axes(view: SensorView, origin: float, pitch: float, limits: AlignmentLimits) -> None:
    """Check that the axes of a readout have the samples of the view.

    Raises
    ------
    ValueError
        The positions differ.
    """
    expected = np.sort(origin + pitch * np.arange(view.samples))
    if np.any(np.abs(view.v_centres - expected) > limits.pitch_tolerance * abs(pitch)):
        raise ValueError(
            f"the view's samples are at v = {view.v_centres[0]:g} ... {view.v_centres[-1]:g}, the readout's axes "
            f"place them at {expected[0]:g} ... {expected[-1]:g}; expected the same"
        )


def make_reading(view: SensorView, readout: Any, u: Float64, sigma_u: Float64, *, backward: bool) -> Reading:
    """Convert the result of a readout to a `Reading`.

    Parameters
    ----------
    view
        View of the sensor.
    readout
        `PsdReading` or `LineReading`.
    u, sigma_u
        Position and its standard deviation [sensor unit].
    backward
        True: the samples of the readout are in the opposite order to the samples of the view.
    """
    step = -1 if backward else 1
    width = getattr(readout, "width", np.full(u.shape, np.nan))
    numbers = (u, readout.g, readout.h, sigma_u, readout.total, width)
    u, g, h, sigma_u, strength, width = (np.asarray(each, np.float64)[..., ::step] for each in numbers)
    slope = height_secant(view.triangulation, u, u, view.v_centres)
    return Reading(u, g, h, np.abs(slope) * sigma_u, strength, width, np.asarray(readout.status)[..., ::step])


def sheet_point(triangulation: Triangulation, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return (G, H) [m] of positions on the sensor; NaN beyond the horizon and where the lens is not invertible."""
    lifted = _lifted(triangulation, u, v)[0] @ np.array(triangulation.homography).T
    with np.errstate(divide="ignore", invalid="ignore"):
        in_front = lifted[..., 2] * _front(triangulation) > 0.0
        sheet = np.where(in_front[..., None], lifted[..., :2] / lifted[..., 2:], np.nan)
    return sheet[..., 0], sheet[..., 1]


def height_secant(triangulation: Triangulation, u: npt.ArrayLike, other_u: npt.ArrayLike, v: npt.ArrayLike) -> Float64:
    """Return the slope of the secant of the height between two positions u: Delta H / Delta u [m / sensor unit].

    Parameters
    ----------
    triangulation
        From the sensor to the sheet.
    u, other_u, v
        Positions (u, v) and (other_u, v) on the sensor [sensor unit]; broadcastable.

    Notes
    -----
    Exact without a lens, also for coinciding positions, where it is the derivative: the difference of the two heights
    is a product with Delta u as a factor, which cancels. With a lens, positions closer than 1e-6 of the region use the
    derivative of the lens.
    """
    u, other_u, v = np.broadcast_arrays(*(np.asarray(each, np.float64) for each in (u, other_u, v)))
    matrix = np.array(triangulation.homography)
    one, sensor = _lifted(triangulation, u, v)
    other, _ = _lifted(triangulation, other_u, v)
    distance = other_u - u
    move = np.zeros((*u.shape, 2))
    lens = triangulation.distortion
    if lens is None:
        move[..., 0] = 1.0
    else:
        (low, high), _ = triangulation.region
        is_close = np.abs(distance) < _MIN_SECANT * (high - low)
        safe = np.where(is_close, 1.0, distance)[..., None]
        move = np.where(is_close[..., None], lens.jacobian(sensor)[..., 0], (other - one)[..., :2] / safe)
    turned = np.stack([move[..., 1], -move[..., 0], move[..., 0] * one[..., 1] - move[..., 1] * one[..., 0]], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = (one @ matrix[2]) * (other @ matrix[2])
        return np.asarray(turned @ np.cross(matrix[1], matrix[2]) / scale)


def height_slope(view: SensorView, truth: GroundTruth) -> tuple[Float64, Float64]:
    """Return the image positions u of true points, and dH/du there, (..., samples) each."""
    sensor = view.triangulation.to_sensor(np.stack([truth.g, truth.h], axis=-1))
    u, v = sensor[..., 0], sensor[..., 1]
    return u, height_secant(view.triangulation, u, u, v)


def _lifted(triangulation: Triangulation, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return undistorted positions in homogeneous coordinates, (..., 3), and the distorted ones, (..., 2)."""
    sensor = np.stack(np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64)), axis=-1)
    lens = triangulation.distortion
    straight = sensor if lens is None else lens.undistort(sensor)
    return np.concatenate([straight, np.ones((*straight.shape[:-1], 1))], axis=-1), sensor


def _front(triangulation: Triangulation) -> float:
    """Return the sign of the homography's third coordinate in front of the sensor."""
    middle = np.mean(np.array(triangulation.region), axis=1)
    return float(np.sign(np.array(triangulation.homography)[2] @ [*middle, 1.0]))


def strongest_points(
    samples: int,
    sample: Integers,
    places: Float64,
    on: npt.NDArray[np.bool_],
    in_view: npt.NDArray[np.bool_],
    light: Float64,
    same: float,
) -> GroundTruth:
    """Return for each sample the position (G, H) with the most light on the sensor, with status flags.

    A sample without a position on the sensor gets the position in the view with the most light.
    """
    order = np.lexsort((-light, ~in_view, ~on, sample))
    sample, places, on, in_view = sample[order], places[order], on[order], in_view[order]
    best = np.flatnonzero(np.diff(sample, prepend=-1))
    group = np.repeat(best, np.diff(best, append=len(sample)))
    other = on & (np.abs(places - places[group]).max(axis=1, initial=0.0) > same * np.abs(places).max(initial=0.0))
    g, h = np.full(samples, np.nan), np.full(samples, np.nan)
    status = np.full(samples, Status.LOW_SIGNAL, np.uint8)
    status[sample[best]] = np.where(on[best], Status.OK, Status.OUT_OF_RANGE)
    status[sample[other]] |= np.uint8(Status.AMBIGUOUS)
    given = best[in_view[best]]
    g[sample[given]], h[sample[given]] = places[given].T
    return GroundTruth(g, h, status)
