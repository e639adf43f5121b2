"""The tilted sensor of a Scheimpflug camera: its geometry, and the condition that it is tilted for.

A sensor tilted by alpha about the point where the optical axis meets it sees, without distortion, what an untilted
pinhole camera sees that is turned by alpha about the pinhole (F. de Jong, fig. 3.3): its focal length is
f = f' cos(alpha) (eq. 3.1), and its principal point lies f' sin(alpha) aside in the sensor.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gpuvision.camera.camera import Camera
from gpuvision.camera.tilted_projection import Floats, tilt_matrix
from gpuvision.validation import finite, numbers

_RIGHT_ANGLE = 0.5 * math.pi


@dataclass(frozen=True, kw_only=True)
class TiltedSensor:
    """A sensor with square pixels, tilted against the plane of its lens.

    Parameters
    ----------
    focal_length
        f': from the pinhole to the sensor along the optical axis, pixels.
    centre
        (C_c, R_c): where the optical axis meets the sensor, pixels.
    alpha
        Angle between the optical axis and the sensor's normal, radians, at least 0 and less than a right angle.
    direction
        In which direction of the image the optical axis leans away from the sensor's normal: radians from the
        columns' axis (x) towards the rows' (y).

    Raises
    ------
    ValueError, TypeError
        A number is out of these bounds, or is none.
    """

    focal_length: float
    centre: tuple[float, float]
    alpha: float
    direction: float = 0.0

    def __post_init__(self) -> None:
        for name in ("focal_length", "alpha", "direction"):
            object.__setattr__(self, name, finite(getattr(self, name), f"TiltedSensor.{name}"))
        object.__setattr__(self, "centre", numbers(self.centre, (2,), "TiltedSensor.centre (column, row)"))
        if self.focal_length <= 0.0:
            raise ValueError(f"TiltedSensor.focal_length is {self.focal_length:g} px, expected a number above 0")
        if not 0.0 <= self.alpha < _RIGHT_ANGLE:
            raise ValueError(f"TiltedSensor.alpha is {self.alpha:g} rad, expected 0 to less than a right angle")

    @property
    def axis(self) -> Floats:
        """Unit vector of the optical axis in the sensor's frame (columns, rows, normal)."""
        flat = math.sin(self.alpha)
        return np.array([flat * math.cos(self.direction), flat * math.sin(self.direction), math.cos(self.alpha)])

    @property
    def tau(self) -> tuple[float, float]:
        """OpenCV's (tauX, tauY), radians."""
        x, y, z = self.axis.tolist()
        return math.asin(y), math.atan2(-x, z)

    @classmethod
    def from_tau(cls, focal_length: float, centre: tuple[float, float], tau_x: float, tau_y: float) -> TiltedSensor:
        """Build it from OpenCV's angles: cos(alpha) = cos(tauX) cos(tauY)."""
        x, y, z = tilt_matrix(tau_x, tau_y)[:, 2].tolist()
        return cls(
            focal_length=focal_length, centre=centre, alpha=math.atan2(math.hypot(x, y), z), direction=math.atan2(y, x)
        )

    @classmethod
    def of(cls, camera: Camera) -> TiltedSensor:
        """Return the sensor of a camera with fx = fy.

        Raises
        ------
        ValueError
            Its pixels are not square.
        """
        matrix, distortion = camera.to_opencv()
        if not math.isclose(matrix[0, 0], matrix[1, 1], rel_tol=1e-9):
            raise ValueError(f"the camera has fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}, expected square pixels")
        return cls.from_tau(float(matrix[0, 0]), (matrix[0, 2], matrix[1, 2]), *distortion[12:])

    @property
    def virtual_focal_length(self) -> float:
        """From the pinhole square to the sensor, pixels: f = f' cos(alpha) (eq. 3.1)."""
        return self.focal_length * math.cos(self.alpha)

    @property
    def virtual_centre(self) -> tuple[float, float]:
        """Where the sensor's normal through the pinhole meets it: f' sin(alpha) from the centre, pixels."""
        x, y, _ = self.axis.tolist()
        return self.centre[0] - self.focal_length * x, self.centre[1] - self.focal_length * y

    @property
    def virtual_camera(self) -> Camera:
        """The untilted camera that sees the same, once distortion is undone (fig. 3.3, S')."""
        (column, row), f = self.virtual_centre, self.virtual_focal_length
        return Camera(matrix=((f, 0.0, column), (0.0, f, row), (0.0, 0.0, 1.0)))

    @property
    def turn(self) -> Floats:
        """Rotation (3, 3) from the lens' frame, in which a tilted `Camera` has its poses, to the virtual camera's."""
        return tilt_matrix(*self.tau)

    @classmethod
    def from_virtual(
        cls, focal_length: float, virtual_centre: tuple[float, float], centre: tuple[float, float]
    ) -> TiltedSensor:
        """Build it from the virtual camera (f, v) and the centre that distortion shows: the inverse of fig. 3.3.

        Parameters
        ----------
        focal_length
            f of the virtual camera, pixels.
        virtual_centre
            Its principal point.
        centre
            Where the optical axis meets the sensor.
        """
        x, y = centre[0] - virtual_centre[0], centre[1] - virtual_centre[1]
        return cls(
            focal_length=math.hypot(x, y, focal_length),
            centre=centre,
            alpha=math.atan2(math.hypot(x, y), focal_length),
            direction=math.atan2(y, x),
        )


def sharp_plane(sensor: TiltedSensor, lens_focal_length: float, pixel_pitch: float) -> tuple[Floats, float]:
    """Plane of sharp focus of a thin lens before a tilted sensor: the Scheimpflug condition.

    Object plane, plane of the lens and plane of the sensor meet in one line (fig. 3.1).

    Parameters
    ----------
    sensor
        The sensor; its f' is the distance of the image.
    lens_focal_length
        Focal length of the lens as such, metres; less than f' for a real object.
    pixel_pitch
        Metres per pixel.

    Returns
    -------
    tuple
        Unit normal n in the lens' frame (columns, rows, optical axis) and distance d [m]: n . X = d is sharp.

    Raises
    ------
    ValueError
        The lens cannot image anything before it on that sensor.
    """
    image = sensor.focal_length * pixel_pitch
    if not 0.0 < lens_focal_length < image:
        raise ValueError(f"lens_focal_length is {lens_focal_length:g} m, expected above 0 and below f' ({image:g} m)")
    # The sensor, mirrored through the pinhole, is the plane m . q = f with its normal m. A point P = q Z / z is sharp
    # where 1/Z + 1/z = 1/F, so that Z/F - m . P / f = 1.
    f = sensor.virtual_focal_length * pixel_pitch
    plane = np.array([0.0, 0.0, 1.0 / lens_focal_length]) - sensor.turn[2] / f
    length = float(np.linalg.norm(plane))
    return plane / length, 1.0 / length


def tilt_for_plane(normal: npt.ArrayLike, distance: float, lens_focal_length: float) -> tuple[float, float, float]:
    """Tilt of the sensor that sees a plane sharply: the Scheimpflug condition solved for the sensor.

    Parameters
    ----------
    normal, distance
        The plane n . X = d in the lens' frame (columns, rows, optical axis), metres.
    lens_focal_length
        Focal length of the lens as such, metres.

    Returns
    -------
    tuple
        f' [m], tauX and tauY [rad] (`TiltedSensor.from_tau` takes them, f' in pixels).

    Raises
    ------
    ValueError
        The plane passes through the lens, or lies nearer than its focal length on the axis.
    """
    n = np.asarray(normal, dtype=np.float64)
    if lens_focal_length <= 0.0:
        raise ValueError(f"lens_focal_length is {lens_focal_length:g} m, expected a number above 0")
    if n.shape != (3,) or not np.isfinite(n).all() or not n.any():
        raise ValueError(f"normal is {n.tolist()}, expected three finite numbers, not all 0")
    if distance == 0.0 or n[2] / distance * lens_focal_length >= 1.0 or n[2] / distance <= 0.0:
        raise ValueError("the plane meets the optical axis nearer than the focal length: no sensor sees it sharply")
    # As in `sharp_plane`, solved for the sensor's normal over f.
    normal_over_f = np.array([0.0, 0.0, 1.0 / lens_focal_length]) - n / distance
    x, y, z = (normal_over_f / np.linalg.norm(normal_over_f)).tolist()
    # The normal is the last row of `turn`: (sin tauY, -cos tauY sin tauX, cos tauY cos tauX).
    return float(1.0 / normal_over_f[2]), math.atan2(-y, z), math.asin(x)
