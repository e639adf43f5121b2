"""What simulated sensors share: light by path, the truth, and how a place on the sensor becomes a height."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]

PATHS = ("direct", "specular", "diffuse-specular", "diffuse-diffuse", "multi-bounce")
"""Ways of the light from the sheet to the lens; together they are what the sensor gets."""
AMBIENT = "ambient"
"""Light that is not the sheet's; it arrives beside the paths."""
UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED = "direct, uniform", "direct, unoccluded", "direct, uniform, unoccluded"
"""The direct light if all surfaces reflected evenly, if nothing hid them from the lens, and both; never part of what
the sensor gets."""
_SAME = 1e-6  # of a sample's pitch
_LIT, _KNOWN = (*PATHS, AMBIENT), (*PATHS, AMBIENT, UNIFORM, UNOCCLUDED, UNIFORM_UNOCCLUDED)


class GroundTruth(NamedTuple):
    """Where the sheet's light truly is, each array (..., samples).

    Attributes
    ----------
    g, h
        In the sheet of light [m]; NaN where no lit surface is seen.
    status
        uint8 `Status` flags: LOW_SIGNAL (there is none), AMBIGUOUS (there are several).
    """

    g: Any
    h: Any
    status: Any


class Reading(NamedTuple):
    """What a simulated sensor says, each array (..., samples).

    Attributes
    ----------
    position
        Along u [sensor unit]; NaN where the status does not allow a value.
    g, h
        The point in the sheet of light [m].
    sigma
        Standard deviation of h that the sensor's noise makes [m].
    strength
        Light that was read, in the sensor's own unit (ampere; grey levels).
    width
        Samples of the light's run over the threshold; NaN on a PSD, which does not know.
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
    """A sensor that reads exposures: `PsdSimulator`, `CameraSimulator`."""

    @property
    def view(self) -> SensorView:
        """What it sees."""
        ...

    def detected_light(self, exposures: Mapping[str, Exposure]) -> dict[str, Exposure]:
        """Return the light by path that moves a reading: behind the mask, ambient light among it."""
        ...

    def signal(self, light: Exposure) -> npt.NDArray[Any]:
        """Return what light behind the mask adds to what is read; signals add."""
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
        """Read a block of profiles."""
        ...


def stack_profiles(profiles: Sequence[Mapping[str, Exposure]]) -> dict[str, Exposure]:
    """Join the light of profiles, each (samples, bins) by path, to blocks (profiles, samples, bins).

    A path that a profile lacks is dark there.

    Raises
    ------
    ValueError
        There is no profile, or a profile has no light at all.
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
    """Return no light, of the shape of the others'.

    Raises
    ------
    ValueError
        There are no others.
    """
    if not exposures:
        raise ValueError(f"expected light of one path or more; paths are {', '.join(PATHS)}")
    like = next(iter(exposures.values()))
    return Exposure(np.zeros_like(like.power), np.zeros_like(like.power))


def total_exposure(exposures: Mapping[str, Exposure]) -> Exposure:
    """Return the light of all paths and what is ambient together.

    Raises
    ------
    ValueError
        A name is unknown, or shapes differ.
    """
    for name in exposures:
        if name not in _KNOWN:
            raise ValueError(f"unknown path {name!r}, expected some of {', '.join(_KNOWN)}")
    if len({each.power.shape for each in exposures.values()}) > 1:
        raise ValueError("the paths' light has different shapes, expected one (..., samples, bins)")
    lit = [exposures[name] for name in _LIT if name in exposures] or [dark_exposure(exposures)]
    return Exposure(_sum([each.power for each in lit]), _sum([each.moment for each in lit]))


def _sum(parts: Sequence[Float64]) -> Float64:
    total = parts[0] if len(parts) == 1 else parts[0] + parts[1]
    for each in parts[2:]:
        total += each
    return total


def add_ambient(view: SensorView, exposures: Mapping[str, Exposure], power: float) -> dict[str, Exposure]:
    """Return the light and, beside its paths, ambient light that is even along every sample: a power a sample [W].

    Raises
    ------
    ValueError
        There is no path's light, or it is not of the view's samples and bins.
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
    """Return random numbers for profiles `first`, `first` + 1, ...: each profile's depend on its number alone."""
    return [np.random.default_rng([seed, first_profile + each]) for each in range(math.prod(profiles))]


def check_not_negative(simulator: Any, *names: str) -> None:
    """Check parameters.

    Raises
    ------
    TypeError, ValueError
        One is not a finite number of 0 or more.
    """
    for name in names:
        if finite(getattr(simulator, name), f"{type(simulator).__name__}.{name}") < 0.0:
            raise ValueError(f"{type(simulator).__name__}.{name} is {getattr(simulator, name)}, expected 0 or more")


def check_sample_axes(view: SensorView, origin: float, pitch: float) -> None:
    """Check that a readout's axes place the samples where the view has them.

    Raises
    ------
    ValueError
        They do not.
    """
    expected = np.sort(origin + pitch * np.arange(view.samples))
    if np.any(np.abs(view.v_centres - expected) > _SAME * abs(pitch)):
        raise ValueError(
            f"the view's samples lie about v = {view.v_centres[0]:g} ... {view.v_centres[-1]:g}, the readout's axes "
            f"place them at {expected[0]:g} ... {expected[-1]:g}; expected the same"
        )


def make_reading(view: SensorView, said: Any, u: Float64, sigma_u: Float64, *, backward: bool) -> Reading:
    """Return what a readout says as a simulator's reading.

    Parameters
    ----------
    view
        Of the sensor.
    said
        `PsdReading` or `LineReading`.
    u, sigma_u
        Its position and the standard deviation of that [sensor unit].
    backward
        The readout's samples run against the view's.
    """
    step = -1 if backward else 1
    width = getattr(said, "width", np.full(u.shape, np.nan))
    numbers = (u, said.g, said.h, sigma_u, said.total, width)
    u, g, h, sigma_u, strength, width = (np.asarray(each, np.float64)[..., ::step] for each in numbers)
    slope = height_secant(view.triangulation, u, u, view.v_centres)
    return Reading(u, g, h, np.abs(slope) * sigma_u, strength, width, np.asarray(said.status)[..., ::step])


def sheet_point(triangulation: Triangulation, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return (G, H) [m] of places on the sensor; NaN beyond the horizon and the lens' fold."""
    lifted = _lifted(triangulation, u, v)[0] @ np.array(triangulation.homography).T
    with np.errstate(divide="ignore", invalid="ignore"):
        seen = lifted[..., 2] * _front(triangulation) > 0.0
        sheet = np.where(seen[..., None], lifted[..., :2] / lifted[..., 2:], np.nan)
    return sheet[..., 0], sheet[..., 1]


def height_secant(triangulation: Triangulation, u: npt.ArrayLike, other_u: npt.ArrayLike, v: npt.ArrayLike) -> Float64:
    """Return the difference of the heights at two places over that of the places [m per sensor unit].

    Exact without a lens, also where the places fall together; with one, places nearer than 1e-6 of the region use
    the lens' derivative.
    """
    u, other_u, v = np.broadcast_arrays(*(np.asarray(each, np.float64) for each in (u, other_u, v)))
    matrix = np.array(triangulation.homography)
    one, sensor = _lifted(triangulation, u, v)
    other, _ = _lifted(triangulation, other_u, v)
    apart = other_u - u
    move = np.zeros((*u.shape, 2))
    lens = triangulation.sensor_lens
    if lens is None:
        move[..., 0] = 1.0
    else:
        (low, high), _ = triangulation.region
        near = np.abs(apart) < 1e-6 * (high - low)
        safe = np.where(near, 1.0, apart)[..., None]
        move = np.where(near[..., None], lens.jacobian(sensor)[..., 0], (other - one)[..., :2] / safe)
    turned = np.stack([move[..., 1], -move[..., 0], move[..., 0] * one[..., 1] - move[..., 1] * one[..., 0]], axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = (one @ matrix[2]) * (other @ matrix[2])
        return np.asarray(turned @ np.cross(matrix[1], matrix[2]) / scale)


def height_slope(view: SensorView, truth: GroundTruth) -> tuple[Float64, Float64]:
    """Return where true points are imaged, u, and how their height grows with it, dH/du: each (..., samples)."""
    sensor = view.triangulation.to_sensor(np.stack([truth.g, truth.h], axis=-1))
    u, v = sensor[..., 0], sensor[..., 1]
    return u, height_secant(view.triangulation, u, u, v)


def _lifted(triangulation: Triangulation, u: npt.ArrayLike, v: npt.ArrayLike) -> tuple[Float64, Float64]:
    """Return undistorted places as (..., 3), and the measured ones (..., 2)."""
    sensor = np.stack(np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64)), axis=-1)
    lens = triangulation.sensor_lens
    straight = sensor if lens is None else lens.undistort(sensor)
    return np.concatenate([straight, np.ones((*straight.shape[:-1], 1))], axis=-1), sensor


def _front(triangulation: Triangulation) -> float:
    """Return the sign of the homography's third coordinate in front of the sensor."""
    middle = np.mean(np.array(triangulation.region), axis=1)
    return float(np.sign(np.array(triangulation.homography)[2] @ [*middle, 1.0]))
