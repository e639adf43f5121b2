"""What light that is missing, or too much, does to the range of a strip; and which light paths can be left out."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

Reals = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True, eq=False)
class StripReading:
    """The light that strips get anyway, and how their range follows their reading.

    A strip reads the mean of u over its light, as a PSD does, or a camera's centroid in a fixed window.

    Parameters
    ----------
    power
        (strips,), W: of the light that is certainly there.
    moment
        (strips,), W times sensor unit: the sum of power times u.
    slope
        (strips,), metres of range per sensor unit.
    limits
        (u_low, u_high): where a strip, or the window, begins and ends; each a number or (strips,).
    floor
        W: the least power at which a strip's reading counts. Strips below it are dark: their range is no number.
    shift
        Sensor units, a number or (strips,): how far from its direct light a strip's reading can come to be, if less
        than the limits allow is known.

    Raises
    ------
    ValueError
        Shapes do not agree; a power is negative; the limits are none.
    """

    power: Reals
    moment: Reals
    slope: Reals
    limits: tuple[npt.ArrayLike, npt.ArrayLike]
    floor: float = 0.0
    shift: npt.ArrayLike = math.inf

    def __post_init__(self) -> None:
        power = np.asarray(self.power, np.float64)
        for name in ("power", "moment", "slope"):
            values = np.asarray(getattr(self, name), np.float64)
            if values.shape != power.shape or values.ndim != 1:
                raise ValueError(f"StripReading.{name} has shape {values.shape}, expected (strips,) as of the power")
            object.__setattr__(self, name, values)
        low, high = (np.broadcast_to(np.asarray(each, np.float64), power.shape) for each in self.limits)
        if np.any(power < 0.0) or np.any(low >= high):
            raise ValueError("StripReading: expected power >= 0 and limits (u_low, u_high) with u_low < u_high")
        object.__setattr__(self, "limits", (low, high))

    @classmethod
    def of(
        cls, view: SensorView, exposure: Exposure, *, floor: float = 0.0, shift: npt.ArrayLike = math.inf
    ) -> StripReading:
        """Return what the direct light of a profile makes of a sensor's strips.

        The slope is the largest of the height H over u anywhere on a strip, from bin to bin; what looks over the
        horizon does not count.

        Parameters
        ----------
        view, exposure
            The sensor, and direct light on it, (samples, bins).
        floor, shift
            As of `StripReading`.
        """
        power = exposure.total()
        u, v = np.broadcast_arrays(view.u_edges, view.v_middles[:, None])
        height = view.sheet_coordinates(view.points_in_sheet(u, v))[..., 1]
        slope = np.abs(np.diff(height, axis=1) / np.diff(view.u_edges))
        return cls(
            power=power,
            moment=exposure.first_moment(view.u_edges),
            slope=np.where(np.isfinite(slope), slope, 0.0).max(axis=1),
            limits=(view.u_edges[0], view.u_edges[-1]),
            floor=floor,
            shift=shift,
        )

    def weights(self, seen: npt.NDArray[Any], u: npt.NDArray[Any]) -> Reals:
        """Return the weights of `costs` and `LightClustering`: W by 1 W/m^2 of receivers (strips, n) seen at u."""
        low, high = (np.asarray(each)[:, None] for each in self.limits)
        power = np.where((u >= low) & (u <= high), seen, 0.0)
        return np.stack([power, power * u], axis=-1)

    @property
    def position(self) -> Reals:
        """Where the direct light alone reads, (strips,), within the limits; their middle where there is none."""
        low, high = (np.asarray(each) for each in self.limits)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.clip(np.where(self.power > 0.0, self.moment / self.power, 0.5 * (low + high)), low, high)

    def widest(self) -> Reals:
        """Return the largest range error that any light can make, (strips,), metres: from limit to limit."""
        low, high = (np.asarray(each) for each in self.limits)
        return np.asarray(np.abs(self.slope) * (high - low))

    def worst(self, power: npt.ArrayLike) -> Reals:
        """Return the largest range error by up to so much more light, W, wherever it falls within the limits: metres.

        D q / (1 + q) with q the ratio to the direct light, D from limit to limit.
        """
        more, least = np.asarray(power, np.float64), np.maximum(self.power, self.floor)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.where(more > 0.0, self.widest() / (1.0 + least / more), 0.0))

    def costs(self, weights: npt.NDArray[Any]) -> Reals:
        """Return the range error by a unit of irradiance that is missing, or too much, at each receiver.

        With light p at u besides P at x, the reading x' without it is off by p (u - x) / P, and x lies within `shift`
        of the direct light's position, and within the limits.

        Parameters
        ----------
        weights
            (strips, n, 2): W, and W times sensor unit about u = 0, by 1 W/m^2.

        Returns
        -------
        numpy.ndarray
            (strips, n), metres per W/m^2; infinite in strips without direct light and floor.
        """
        power, moment = (np.asarray(weights[..., k], np.float64) for k in range(2))
        low, high = (np.asarray(each)[:, None] for each in self.limits)
        position = self.position[:, None]
        shift = np.broadcast_to(np.asarray(self.shift, np.float64), self.power.shape)[:, None]
        first, last = np.maximum(low, position - shift), np.minimum(high, position + shift)
        arm = np.maximum(np.abs(moment - first * power), np.abs(moment - last * power))
        least = np.maximum(self.power, self.floor)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(arm > 0.0, np.abs(self.slope)[:, None] * arm / least, 0.0)


class Choice(NamedTuple):
    """Which light paths are modelled.

    Attributes
    ----------
    modelled, left_out
        The paths by name, with the largest range error that leaving each out may make, metres (None: no bound).
    remaining
        Metres: what those left out leave of the tolerance.
    """

    modelled: dict[str, float | None]
    left_out: dict[str, float]
    remaining: float


def choose_paths(worst: Mapping[str, npt.ArrayLike], tolerance: float) -> Choice:
    """Leave out the light paths with the least bounds, as long as their sum stays within half the tolerance.

    Paths whose bound is zero are left out in any case. Errors of paths add, at most.

    Parameters
    ----------
    worst
        For each path, the largest range error by leaving it out, metres: a number, or one for each strip; infinite
        where there is no bound.
    tolerance
        Metres of range.
    """
    bounds = {name: float(np.max(np.asarray(values, np.float64), initial=0.0)) for name, values in worst.items()}
    left_out: dict[str, float] = {}
    spent = 0.0
    for name, bound in sorted(bounds.items(), key=lambda item: item[1]):
        if bound == 0.0 or spent + bound <= 0.5 * tolerance:
            left_out[name] = bound
            spent += bound
    modelled = {name: bound if math.isfinite(bound) else None for name, bound in bounds.items() if name not in left_out}
    return Choice(modelled, left_out, max(tolerance - spent, 0.0))


def bounce_power(received: float, albedo: float, solid_angle: float) -> float:
    """Return the most light of further bounces that a sensor can get, W, all strips together.

    Parameters
    ----------
    received
        W that other surfaces get from the lit ones at first; at most what those send out.
    albedo
        The largest in the scene; below 1 the bounces' sum converges.
    solid_angle
        sr: the largest under which any surface sees the lens.

    Raises
    ------
    ValueError
        A number is negative, or the albedo more than 1.

    Notes
    -----
    Received light is sent out again at most ``albedo`` times as strong, and received again; so after the first bounce
    surfaces receive at most received albedo / (1 - albedo), and of what a diffuse surface sends out albedo / pi times
    the solid angle gets into the lens.
    """
    if not (0.0 <= albedo <= 1.0 and received >= 0.0 and solid_angle >= 0.0):
        raise ValueError(f"expected 0 <= albedo <= 1, got {albedo}; power and solid angle >= 0")
    if received == 0.0 or albedo == 0.0:
        return 0.0
    if albedo == 1.0:
        return math.inf
    return received * albedo / (1.0 - albedo) * albedo / math.pi * solid_angle
