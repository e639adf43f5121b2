"""Range images of a point sensor behind a polygon mirror: the height of the object moves the spot sideways."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.host import Device, to_numpy
from gpuvision.ranging.polygon import PolygonMirror
from gpuvision.ranging.range_image import Limits, RangeImage, RangePoints
from gpuvision.ranging.sheet import SheetPoints
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.status import Status
from gpuvision.validation import finite

Float64 = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class PolygonScan:
    """Point sensor that looks through a polygon mirror: a sweep of one facet is a profile.

    The sensor and its beam see the scene through the same facet. A plane mirror does not change lengths: unfolded, the
    spot always moves along the same straight beam, and the reading depends on the length of the path alone. Let the
    sensor be calibrated with the mirror at rest at rotation 0, where a reading h is the height of the spot. The path
    from there to the spot is ``D - h``. At rotation phi the hit point lies ``s = x_h(phi) - x_h(0)`` nearer to the
    source, so that the path after the mirror is ``d = D - h + s``, in the direction ``(sin(2 phi), -cos(2 phi))``::

        x = s + d sin(2 phi),  z = D - d cos(2 phi)

    Parameters
    ----------
    mirror : PolygonMirror
    first_rotation : float
        Rotation phi of sample 0 [rad].
    rotation_step : float
        Rotation from a sample to the next one [rad], not 0.
    is_moving : bool
        Whether the object moves during a sweep, default True: a sample at rotation phi then lies
        ``phi / (2 pi / facets)`` profiles after the position of its profile, which is measured at rotation 0. False for
        a stage that stops for each sweep.

    Raises
    ------
    ValueError
        A number is not finite, or the step is 0.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 2.3.5.
    """

    mirror: PolygonMirror
    first_rotation: float
    rotation_step: float
    is_moving: bool = True

    def __post_init__(self) -> None:
        finite(self.first_rotation, "PolygonScan.first_rotation")
        if finite(self.rotation_step, "PolygonScan.rotation_step") == 0.0:
            raise ValueError(
                "PolygonScan.rotation_step is 0, expected the rotation from a sample to the next one [rad]"
            )

    def rotations(self, samples: int) -> Float64:
        """Return the rotation of each sample of a profile, (samples,) [rad]."""
        return self.first_rotation + self.rotation_step * np.arange(samples, dtype=np.float64)

    def locate(self, reading: npt.NDArray[Any], status: npt.NDArray[np.uint8]) -> SheetPoints:
        """Compute position and height of the spots in the plane of the sweep.

        Parameters
        ----------
        reading : numpy.ndarray
            Readings h [m], (profiles, samples): heights that the sensor measures at rotation 0.
        status : numpy.ndarray
            `Status` flags of the readings, (profiles, samples) uint8.

        Returns
        -------
        SheetPoints
            Position x as ``g`` and height z as ``h`` [m], of the dtype of the readings; OUT_OF_RANGE where the facet
            does not reflect the beam (`PolygonMirror.limits`), and where the reading lies at or behind the mirror.
        """
        phi = self.rotations(reading.shape[-1])
        low, high = self.mirror.limits
        inside = (phi >= low) & (phi <= high)
        phi = np.where(inside, phi, np.nan)
        shift = self.mirror.hit_shift(phi)
        path = self.mirror.drop + shift - reading.astype(np.float64)
        inside = inside & ~(path <= 0.0)
        path = np.where(inside, path, np.nan)
        position, height = shift + path * np.sin(2.0 * phi), self.mirror.drop - path * np.cos(2.0 * phi)
        flags = status | np.where(inside, np.uint8(0), np.uint8(Status.OUT_OF_RANGE))
        return SheetPoints(position.astype(reading.dtype), height.astype(reading.dtype), flags)

    def sample_transports(self, transports: Float64, samples: int) -> Float64:
        """Return the transport of each sample [m], (profiles, samples).

        Parameters
        ----------
        transports : numpy.ndarray
            Transport of each profile at rotation 0 [m], (profiles,), of consecutive profiles.
        samples : int

        Returns
        -------
        numpy.ndarray
            Interpolated linearly between the profiles, and extrapolated at both ends. A single profile does not move.
        """
        profiles = len(transports)
        if not self.is_moving or profiles < 2:
            return np.repeat(transports[:, None], samples, axis=1)
        pitch = 2.0 * math.pi / self.mirror.facets
        delays = math.copysign(1.0, self.rotation_step) * self.rotations(samples) / pitch  # [profiles]
        times = np.arange(profiles)[:, None] + delays
        first = np.clip(np.floor(times), 0, profiles - 2).astype(np.int64)
        return np.asarray(transports[first] + (times - first) * np.diff(transports)[first])

    def assemble(
        self,
        reading: npt.NDArray[Any],
        transports: Float64,
        status: npt.NDArray[np.uint8],
        *,
        transport: StraightTransport,
        limits: Limits,
        device: Device,
    ) -> RangePoints:
        """Compute the range image of sweeps.

        Parameters
        ----------
        reading : numpy.ndarray
            Readings h [m], (profiles, samples).
        transports : numpy.ndarray
            Transport of each sample [m], (profiles, samples), see `sample_transports`.
        status : numpy.ndarray
            `Status` flags of the readings, (profiles, samples) uint8.
        transport : StraightTransport
            Directions of position, height and motion in the scene.
        limits : ((low, high), (low, high), (low, high))
            Limits of x, y and z [m]; points outside are OUT_OF_RANGE.
        device : Device

        Returns
        -------
        RangePoints
            NumPy arrays (profiles, samples).
        """
        spots = self.locate(reading, status)
        at_rest = np.zeros(len(reading), reading.dtype)
        points = RangeImage(geometry=transport)(spots.g, spots.h, at_rest, spots.status, device=device)
        moved = zip((points.x, points.y, points.z), transport.direction, strict=True)
        place = [to_numpy(each) + (component * transports).astype(reading.dtype) for each, component in moved]
        flags = to_numpy(points.status)
        bounds = np.array(limits)[:, :, None, None]
        outside = np.any((place < bounds[:, 0]) | (place > bounds[:, 1]), axis=0)
        flags[outside] |= np.uint8(Status.OUT_OF_RANGE)
        for each in place:
            each[outside] = np.nan
        x, y, z = place
        return RangePoints(x, y, z, flags)
