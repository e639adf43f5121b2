"""View of a sensor on a scene: rays through its pixels or strips, images of points, and exposures.

The sheet of light and the sensor move together along the transport; methods take the transport L of a profile. The
image of a point is found in two steps. The ray from the lens through the point meets the sheet of light at (G, H). The
triangulation gives the position of the image of (G, H) on the sensor. This holds for every pinhole sensor, tilted or
not, because the sheet and the sensor are planes. Of a bent sheet the mean plane is meant, as in the triangulation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from gpuvision.ranging.sheet_motion import StraightTransport, Vector
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.validation import finite, numbers

Float64 = npt.NDArray[np.float64]


class Exposure(NamedTuple):
    """Light on a sensor, in bins along u for each sample along v. Exposures can be added.

    Attributes
    ----------
    power
        float64 (samples, bins) [W].
    moment
        float64 (samples, bins), power times the distance of its centroid from the bin's centre [W sensor unit]. With it
        the first moment of a strip does not depend on the size of the bins.
    """

    power: Float64
    moment: Float64

    def __add__(self, other: object) -> Exposure:
        if not isinstance(other, Exposure):
            return NotImplemented
        return Exposure(self.power + other.power, self.moment + other.moment)

    def total(self) -> Float64:
        """Return the power of each sample, (samples,) [W]."""
        return np.asarray(self.power.sum(axis=-1))

    def first_moment(self, u_edges: Float64) -> Float64:
        """Return the first moment of each sample, the sum of power times u, (samples,) [W sensor unit]."""
        return np.asarray(self.moment.sum(axis=-1) + self.power @ (0.5 * (u_edges[1:] + u_edges[:-1])))


@dataclass(frozen=True, kw_only=True)
class ViewLimits:
    """Limits of `SensorView`.

    Attributes
    ----------
    spot_radius : float
        Radius of a blurred spot [standard deviations]; light beyond it is omitted. Derived: less than 3e-12 of a
        Gaussian is farther away. Default 7.0.
    min_off_sheet : float
        Least distance of the lens from the sheet of light, as a fraction of its distance from the sheet's origin.
        Chosen. Default 1e-9.
    """

    spot_radius: float = 7.0
    min_off_sheet: float = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class SensorView:
    """View of a pinhole sensor on a sheet of light and a scene; compared by identity.

    Parameters
    ----------
    triangulation : Triangulation
        Triangulation from the sensor to the sheet, with the distortion of a lens or a camera.
    transport : StraightTransport
        Motion of sheet and sensor over the scene.
    lens : sequence of 3 floats
        Position of the pinhole in the scene at transport 0, (3,) [m].
    u_edges : numpy.ndarray
        Edges of the bins along u, (bins + 1,), ascending [sensor unit]. For a PSD, the first and the last edge are the
        ends of the strips; for a camera, each bin is a pixel.
    v_edges : numpy.ndarray
        Edges of the strips or columns along v, (samples + 1,), ascending [sensor unit].
    aperture : float
        Diameter of the lens' aperture [m], > 0. Default 1e-3.
    axis : sequence of 3 floats, optional
        Direction of the lens' optical axis in the scene, (3,). None: towards the point of the sheet that the centre of
        the sensor sees.
    limits : ViewLimits
        Limits of the blur and of the lens' position.

    Raises
    ------
    TypeError, ValueError
        A parameter has the wrong type or is out of its range, or the lens lies in the sheet.
    """

    triangulation: Triangulation
    transport: StraightTransport
    lens: Vector
    u_edges: Float64
    v_edges: Float64
    aperture: float = 1e-3
    axis: Vector | None = None
    limits: ViewLimits = ViewLimits()

    def __post_init__(self) -> None:
        object.__setattr__(self, "lens", numbers(self.lens, (3,), "SensorView.lens"))
        object.__setattr__(self, "u_edges", _edges(self.u_edges, "SensorView.u_edges"))
        object.__setattr__(self, "v_edges", _edges(self.v_edges, "SensorView.v_edges"))
        if finite(self.aperture, "SensorView.aperture") <= 0.0:
            raise ValueError(f"SensorView.aperture is {self.aperture:g} m, expected a diameter > 0")
        if abs(self._off_sheet) <= self.limits.min_off_sheet * float(np.linalg.norm(self._to_sheet)):
            raise ValueError("SensorView.lens lies in the sheet of light: nothing can be triangulated")
        if self.axis is not None:
            towards: npt.ArrayLike = numbers(self.axis, (3,), "SensorView.axis")
        else:
            middle = 0.5 * (self.u_edges[0] + self.u_edges[-1]), 0.5 * (self.v_edges[0] + self.v_edges[-1])
            towards = self.points_in_sheet(*middle) - self.lens
        length = float(np.linalg.norm(towards))
        if not 0.0 < length < math.inf:
            raise ValueError("SensorView.axis has no direction")
        object.__setattr__(self, "axis", numbers(np.asarray(towards) / length, (3,), "SensorView.axis"))

    @property
    def samples(self) -> int:
        """Number of strips or columns."""
        return len(self.v_edges) - 1

    @property
    def bins(self) -> int:
        """Number of bins of a sample."""
        return len(self.u_edges) - 1

    @property
    def u_centres(self) -> Float64:
        """Centres of the bins, (bins,) [sensor unit]."""
        return 0.5 * (self.u_edges[1:] + self.u_edges[:-1])

    @property
    def v_centres(self) -> Float64:
        """Centres of the samples, (samples,) [sensor unit]."""
        return 0.5 * (self.v_edges[1:] + self.v_edges[:-1])

    def lens_at(self, L: float) -> Float64:
        """Return the position of the lens, (3,) [m], at a transport L [m]."""
        return np.asarray(np.array(self.lens) + L * np.array(self.transport.direction))

    # ---- projection and rays -------------------------------------------------------------------------------

    def sheet_coordinates(self, points: npt.ArrayLike, L: float = 0.0) -> Float64:
        """Return the apparent positions of points in the sheet: (..., 3) to (G, H), (..., 2) [m].

        NaN for points that are not in front of the lens, or whose ray does not meet the sheet in front of the lens.
        """
        rays = np.asarray(points, np.float64) - self.lens_at(L)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = self._off_sheet / (rays @ self._normal)
            point = np.where(
                ((depth > 0.0) & (rays @ np.array(self.axis) > 0.0))[..., None], depth[..., None] * rays, np.nan
            )
        return self._in_sheet(point)

    def project(self, points: npt.ArrayLike, L: float = 0.0) -> Float64:
        """Return the images (u, v) of points: (..., 3) [m] to (..., 2) [sensor unit]; NaN as in `sheet_coordinates`."""
        return self.triangulation.to_sensor(self.sheet_coordinates(points, L))

    def points_in_sheet(self, u: npt.ArrayLike, v: npt.ArrayLike, L: float = 0.0) -> Float64:
        """Return the points of the sheet imaged at (u, v), (..., 3) in the scene [m]; NaN beyond the horizon."""
        sensor = np.stack(np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64)), axis=-1)
        lens = self.triangulation.distortion
        straight = sensor if lens is None else lens.undistort(sensor)
        lifted = straight @ self._matrix[:, :2].T + self._matrix[:, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            sheet = np.where((lifted[..., 2] * self._front > 0.0)[..., None], lifted[..., :2] / lifted[..., 2:], np.nan)
        move = self.transport
        place = np.array(move.origin) + L * np.array(move.direction)
        return np.asarray(place + sheet @ np.array([move.g_axis, move.h_axis]))

    def rays(self, u: npt.ArrayLike, v: npt.ArrayLike, L: float = 0.0) -> Float64:
        """Return the rays through (u, v), (..., 6): position of the lens [m] and unit vector into the scene.

        NaN for positions beyond the horizon of the sheet.
        """
        lens = self.lens_at(L)
        towards = self.points_in_sheet(u, v, L) - lens
        towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
        return np.concatenate([np.broadcast_to(lens, towards.shape), towards], axis=-1)

    def etendue(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Float64:
        """Return the etendue per area of the sensor, power over radiance [m^2 sr / sensor unit^2].

        It is the area of the aperture, times the cosine of the angle to the optical axis, times the solid angle that an
        element of the sensor sees. Behind an untilted lens this is the cos^4 law. Zero for positions beyond the horizon
        and for directions away from the optical axis.
        """
        sensor = np.stack(np.broadcast_arrays(np.asarray(u, np.float64), np.asarray(v, np.float64)), axis=-1)
        lens = self.triangulation.distortion
        straight = sensor if lens is None else lens.undistort(sensor)
        lifted = straight @ self._matrix[2, :2] + self._matrix[2, 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            stretch = np.abs(np.linalg.det(self._matrix) / lifted**3)
            if lens is not None:
                stretch = stretch * np.abs(np.linalg.det(lens.jacobian(sensor)))
            towards = self.points_in_sheet(u, v) - self.lens
            distance = np.linalg.norm(towards, axis=-1)
            cosine = towards @ np.array(self.axis) / distance
            area = np.abs(self._off_sheet) * self._metric * stretch
            value = self._opening * np.maximum(cosine, 0.0) * area / distance**3
        return np.where(np.isfinite(value), value, 0.0)

    def aperture_solid_angle(self, points: npt.ArrayLike, L: float = 0.0) -> Float64:
        """Return the solid angle of the aperture seen from points, (..., 3) to (...) [sr]; 0 behind the lens.

        It is the power on the sensor [W] over the radiant intensity [W/sr] of the points.
        """
        towards = np.asarray(points, np.float64) - self.lens_at(L)
        square = np.sum(towards * towards, axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            value = self._opening * np.maximum(towards @ np.array(self.axis), 0.0) / square**1.5
        return np.where(np.isfinite(value), value, 0.0)

    # ---- exposures -----------------------------------------------------------------------------------------

    def sample_of(self, v: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the samples that contain positions v; -1: none."""
        return _interval_of(self.v_edges, v)

    def bin_of(self, u: npt.ArrayLike) -> npt.NDArray[np.int64]:
        """Return the bins that contain positions u; -1: none."""
        return _interval_of(self.u_edges, u)

    def dark(self) -> Exposure:
        """Return an exposure without light."""
        return Exposure(np.zeros((self.samples, self.bins)), np.zeros((self.samples, self.bins)))

    def deposit_spots(self, u: npt.ArrayLike, v: npt.ArrayLike, power: npt.ArrayLike) -> Exposure:
        """Return the exposure by point-like spots of light; light outside the sensor is lost.

        Parameters
        ----------
        u, v : array_like
            Positions of the spots [sensor unit].
        power : array_like
            Power of the spots [W]; all three are broadcast.
        """
        u, v, power = (np.ravel(each) for each in np.broadcast_arrays(u, v, power))
        sample, place = self.sample_of(v), self.bin_of(u)
        on = (sample >= 0) & (place >= 0)
        at, size = sample[on] * self.bins + place[on], self.samples * self.bins
        weights = np.asarray(power, np.float64)[on]
        total = np.bincount(at, weights, minlength=size)
        moment = np.bincount(at, weights * (u[on] - self.u_centres[place[on]]), minlength=size)
        shape = (self.samples, self.bins)
        return Exposure(np.asarray(total.reshape(shape), np.float64), np.asarray(moment.reshape(shape), np.float64))

    def blur(self, exposure: Exposure, sigma: float) -> Exposure:
        """Return an exposure blurred along u by a Gaussian point spread function.

        Parameters
        ----------
        exposure : Exposure
            (samples, bins). The light of a bin is treated as a spot at its centroid.
        sigma : float
            Standard deviation of the image of a point [sensor unit], 0 or more.

        Notes
        -----
        Light beyond the ends of the sensor, or more than 7 sigma from its spot (3e-12 of it), is lost.
        """
        if sigma == 0.0:
            return exposure
        sample, place = np.nonzero(exposure.power)
        light = exposure.power[sample, place]
        at = self.u_centres[place] + exposure.moment[sample, place] / light
        radius = self.limits.spot_radius * sigma
        first = np.maximum(np.searchsorted(self.u_edges, at - radius) - 1, 0)
        last = np.minimum(np.searchsorted(self.u_edges, at + radius), self.bins)
        widest = int(np.max(last - first, initial=0))
        bins = np.minimum(first[:, None] + np.arange(widest + 1), self.bins)
        edges = (self.u_edges[bins] - at[:, None]) / sigma
        below, bell = ndtr(edges), np.exp(-0.5 * edges**2) / math.sqrt(math.tau)
        power = light[:, None] * np.diff(below, axis=1)
        bins = np.minimum(bins[:, :-1], self.bins - 1)
        first_moment = -sigma * light[:, None] * np.diff(bell, axis=1)
        moment = first_moment + (at[:, None] - self.u_centres[bins]) * power
        index = (sample[:, None] * self.bins + bins).ravel()
        shape, size = (self.samples, self.bins), self.samples * self.bins
        sums = (np.bincount(index, each.ravel(), minlength=size).reshape(shape) for each in (power, moment))
        return Exposure(*(np.asarray(each, np.float64) for each in sums))

    # ---- derived quantities --------------------------------------------------------------------------------

    @property
    def _matrix(self) -> Float64:
        return np.array(self.triangulation.homography)

    @property
    def _front(self) -> float:
        """Sign of the homography's third coordinate for points in front of the sensor."""
        middle = np.mean(np.array(self.triangulation.region), axis=1)
        return float(np.sign(self._matrix[2] @ [*middle, 1.0]))

    @property
    def _normal(self) -> Float64:
        across = np.cross(self.transport.g_axis, self.transport.h_axis)
        return np.asarray(across / np.linalg.norm(across))

    @property
    def _metric(self) -> float:
        """Area in the scene per unit area of (G, H)."""
        return float(np.linalg.norm(np.cross(self.transport.g_axis, self.transport.h_axis)))

    @property
    def _to_sheet(self) -> Float64:
        return np.asarray(np.array(self.transport.origin) - np.array(self.lens))

    @property
    def _off_sheet(self) -> float:
        return float(self._to_sheet @ self._normal)

    @property
    def _opening(self) -> float:
        return 0.25 * math.pi * self.aperture**2

    def _in_sheet(self, from_lens: Float64) -> Float64:
        """Return (G, H) of points of the sheet, given relative to the lens."""
        axes = np.array([self.transport.g_axis, self.transport.h_axis])
        return np.asarray((from_lens - self._to_sheet) @ np.linalg.pinv(axes))


def _edges(values: npt.ArrayLike, what: str) -> Float64:
    edges = np.array(values, np.float64)
    if edges.ndim != 1 or len(edges) < 2 or not np.isfinite(edges).all() or np.any(np.diff(edges) <= 0.0):
        raise ValueError(f"{what}: expected two or more numbers in ascending order")
    edges.flags.writeable = False
    return edges


def _interval_of(edges: Float64, values: npt.ArrayLike) -> npt.NDArray[np.int64]:
    """Return the intervals between edges that contain values, -1: none; the last edge belongs to the last interval."""
    values = np.asarray(values, np.float64)
    at = np.searchsorted(edges, values, side="right") - 1
    at = np.where(values == edges[-1], len(edges) - 2, at)
    return np.where((at >= 0) & (at < len(edges) - 1) & np.isfinite(values), at, -1).astype(np.int64)
