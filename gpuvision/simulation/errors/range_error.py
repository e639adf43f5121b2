"""Bounds of the range error that missing or additional light causes on a strip, and selection of light paths."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.readings import height_secant
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Reals = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class StripErrorModel:
    """Range error of strips as a function of additional light, linear in the position of the light's centroid.

    A strip reads the mean of u over its light, as a PSD does, or as a camera's centroid in a fixed window.

    Parameters
    ----------
    power
        (strips,), power of the direct light [W], 0 or more.
    moment
        (strips,), first moment of the direct light: the sum of power times u [W sensor unit].
    slope
        (strips,), derivative of the range with respect to u [m / sensor unit].
    limits
        (u_low, u_high), ends of a strip or of the window [sensor unit]; each a number or (strips,).
    min_power
        Smallest power at which a strip is read [W]. A strip with less light is dark and has no range. Default 0.0.
    max_shift
        Largest distance between the direct light's position and the reading [sensor unit], a number or (strips,).
        Infinite: only the limits bound the reading.

    Raises
    ------
    ValueError
        Shapes do not agree, a power is negative, or u_low is not below u_high.
    """

    power: Reals
    moment: Reals
    slope: Reals
    limits: tuple[npt.ArrayLike, npt.ArrayLike]
    min_power: float = 0.0
    max_shift: npt.ArrayLike = math.inf

    def __post_init__(self) -> None:
        power = np.asarray(self.power, np.float64)
        for name in ("power", "moment", "slope"):
            values = np.asarray(getattr(self, name), np.float64)
            if values.shape != power.shape or values.ndim != 1:
                raise ValueError(f"StripErrorModel.{name} has shape {values.shape}, expected (strips,) as of the power")
            object.__setattr__(self, name, values)
        low, high = (np.broadcast_to(np.asarray(each, np.float64), power.shape) for each in self.limits)
        if np.any(power < 0.0) or np.any(low >= high):
            raise ValueError("StripErrorModel: expected power >= 0 and limits (u_low, u_high) with u_low < u_high")
        object.__setattr__(self, "limits", (low, high))

    @classmethod
    def from_exposure(
        cls, view: SensorView, exposure: Exposure, *, min_power: float = 0.0, max_shift: npt.ArrayLike = math.inf
    ) -> StripErrorModel:
        """Return the model of a sensor's strips under the direct light of one profile.

        The slope of a strip is the largest derivative dH/du of the height at the edges of its bins. Without a lens the
        derivative has its extremes at the ends of an interval, so that no u between the edges has a larger one. Edges
        beyond the horizon of the sheet are ignored.

        Parameters
        ----------
        view, exposure
            The sensor, and the direct light on it, (samples, bins).
        min_power, max_shift
            As for `StripErrorModel`.
        """
        power = exposure.total()
        u, v = np.broadcast_arrays(view.u_edges, view.v_centres[:, None])
        is_seen = np.isfinite(view.points_in_sheet(u, v)).all(axis=-1)
        slope = np.abs(height_secant(view.triangulation, u, u, v))
        return cls(
            power=power,
            moment=exposure.first_moment(view.u_edges),
            slope=np.where(is_seen & np.isfinite(slope), slope, 0.0).max(axis=1),
            limits=(view.u_edges[0], view.u_edges[-1]),
            min_power=min_power,
            max_shift=max_shift,
        )

    def weights(self, seen: npt.NDArray[Any], u: npt.NDArray[Any]) -> Reals:
        """Return the weights for `error_per_irradiance` and `LightClustering`.

        Parameters
        ----------
        seen
            (strips, n), power on the sensor per irradiance of each receiver [W per W/m^2].
        u
            (strips, n) or broadcastable, position of the receiver's image [sensor unit].

        Returns
        -------
        numpy.ndarray
            (strips, n, 2), power and first moment about u = 0 per irradiance; zero outside the limits.
        """
        low, high = (np.asarray(each)[:, None] for each in self.limits)
        power = np.where((u >= low) & (u <= high), seen, 0.0)
        return np.stack([power, power * u], axis=-1)

    @property
    def position(self) -> Reals:
        """Reading of the direct light alone, (strips,) [sensor unit]; without direct light the middle of the limits."""
        low, high = (np.asarray(each) for each in self.limits)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.clip(np.where(self.power > 0.0, self.moment / self.power, 0.5 * (low + high)), low, high)

    def max_error(self) -> Reals:
        """Return the range between both limits, (strips,) [m]: no light causes a larger error."""
        low, high = (np.asarray(each) for each in self.limits)
        return np.asarray(np.abs(self.slope) * (high - low))

    def error_bound(self, power: npt.ArrayLike) -> Reals:
        """Return a bound of the range error by additional light anywhere within the limits, (strips,) [m].

        The bound is D q / (1 + q), with D the range between the limits and q the ratio of the additional power to the
        direct power.

        Parameters
        ----------
        power
            Additional power, a number or (strips,) [W].
        """
        more, least = np.asarray(power, np.float64), np.maximum(self.power, self.min_power)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(more > 0.0, self.max_error() / (1.0 + least / more), 0.0))

    def error_per_irradiance(self, weights: npt.NDArray[Any]) -> Reals:
        """Return the range error per irradiance that is missing or additional at each receiver.

        For light of power p at u in addition to light of power P at x, the reading without p has the error p (u - x) /
        P, where x is within `max_shift` of the direct light's position and within the limits.

        Parameters
        ----------
        weights
            (strips, n, 2), power and first moment per irradiance, from `weights`.

        Returns
        -------
        numpy.ndarray
            (strips, n) [m per W/m^2]; infinite for strips without direct light where `min_power` is 0.
        """
        power, moment = (np.asarray(weights[..., k], np.float64) for k in range(2))
        low, high = (np.asarray(each)[:, None] for each in self.limits)
        position = self.position[:, None]
        max_shift = np.broadcast_to(np.asarray(self.max_shift, np.float64), self.power.shape)[:, None]
        first, last = np.maximum(low, position - max_shift), np.minimum(high, position + max_shift)
        arm = np.maximum(np.abs(moment - first * power), np.abs(moment - last * power))
        least = np.maximum(self.power, self.min_power)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(arm > 0.0, np.abs(self.slope)[:, None] * arm / least, 0.0)


class PathSelection(NamedTuple):
    """Light paths that are simulated, and light paths that are omitted.

    Attributes
    ----------
    modelled, omitted
        Paths by name, with a bound of the range error if the path is omitted [m] (None: no bound).
    remaining_tolerance
        Tolerance less the bounds of the omitted paths [m].
    """

    modelled: dict[str, float | None]
    omitted: dict[str, float]
    remaining_tolerance: float


def select_paths(error_bounds: Mapping[str, npt.ArrayLike], tolerance: float) -> PathSelection:
    """Select the light paths to simulate: omit the paths with the smallest bounds, up to half the tolerance in sum.

    A path with the bound 0 is always omitted. The error of several omitted paths is at most the sum of their bounds.

    Parameters
    ----------
    error_bounds
        For each path, a bound of the range error if it is omitted [m]: a number, or one for each strip; infinite: no
        bound.
    tolerance
        Allowed range error [m].
    """
    bounds = {name: float(np.max(np.asarray(values, np.float64), initial=0.0)) for name, values in error_bounds.items()}
    omitted: dict[str, float] = {}
    spent = 0.0
    for name, bound in sorted(bounds.items(), key=lambda item: item[1]):
        if bound == 0.0 or spent + bound <= 0.5 * tolerance:
            omitted[name] = bound
            spent += bound
    modelled = {name: bound if math.isfinite(bound) else None for name, bound in bounds.items() if name not in omitted}
    return PathSelection(modelled, omitted, max(tolerance - spent, 0.0))


def interreflection_power_bound(received: float, albedo: float, solid_angle: float) -> float:
    """Return a bound of the power that reaches the sensor after two or more diffuse reflections [W], of all strips.

    Parameters
    ----------
    received
        Power that surfaces receive from the lit surfaces directly; at most the power that the lit surfaces emit [W], 0
        or more.
    albedo
        Largest albedo of the scene, 0 to 1.
    solid_angle
        Largest solid angle of the lens from a surface [sr], 0 or more.

    Returns
    -------
    float
        Infinite for an albedo of 1: the sum over the reflections does not converge.

    Raises
    ------
    ValueError
        A number is out of its range.

    Notes
    -----
    Surfaces send out at most ``albedo`` times the received power, which other surfaces receive again. After the first
    reflection they receive at most received albedo / (1 - albedo) in sum. A diffuse surface sends albedo / pi times the
    solid angle of that into the lens.
    """
    if not (0.0 <= albedo <= 1.0 and received >= 0.0 and solid_angle >= 0.0):
        raise ValueError(f"expected 0 <= albedo <= 1, got {albedo}; power and solid angle >= 0")
    if received == 0.0 or albedo == 0.0:
        return 0.0
    if albedo == 1.0:
        return math.inf
    return received * albedo / (1.0 - albedo) * albedo / math.pi * solid_angle
