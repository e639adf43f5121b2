"""Tilted sensor of a Scheimpflug camera: geometry, virtual camera, and the Scheimpflug condition.

A sensor tilted by alpha about the intersection of the optical axis records, without distortion, the same image as an
untilted pinhole camera rotated by alpha about the pinhole (the virtual camera S' of F. de Jong, fig. 3.3). The virtual
camera has the focal length f = f' cos(alpha) (eq. 3.1); its principal point lies at a distance f' sin(alpha) from the
optical axis in the sensor plane.
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
    """Sensor with square pixels, tilted against the plane of the lens (Scheimpflug).

    Parameters
    ----------
    focal_length : float
        f': distance from the pinhole to the sensor along the optical axis [px], above 0.
    centre : (float, float)
        (C_c, R_c): column and row of the optical axis on the sensor [px].
    alpha : float
        Angle between the optical axis and the sensor's normal [rad], 0 to below pi/2.
    direction : float
        Image direction in which the optical axis leans away from the sensor's normal [rad], from the columns' axis (x)
        towards the rows' axis (y). Default 0.

    Raises
    ------
    ValueError, TypeError
        A number is out of its range, or an argument is no number.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, section 3.3.1. C.
    Steger, A comprehensive and versatile camera model for cameras with tilt lenses, Int. J. Computer Vision 123 (2017)
    121.
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
        """Unit vector (3,) of the optical axis in the sensor's frame (columns, rows, normal)."""
        flat = math.sin(self.alpha)
        return np.array([flat * math.cos(self.direction), flat * math.sin(self.direction), math.cos(self.alpha)])

    @property
    def tau(self) -> tuple[float, float]:
        """OpenCV's tilt angles (tauX, tauY) [rad]."""
        x, y, z = self.axis.tolist()
        return math.asin(y), math.atan2(-x, z)

    @classmethod
    def from_tau(cls, focal_length: float, centre: tuple[float, float], tau_x: float, tau_y: float) -> TiltedSensor:
        """Build the sensor from OpenCV's tilt angles [rad]: cos(alpha) = cos(tauX) cos(tauY)."""
        x, y, z = tilt_matrix(tau_x, tau_y)[:, 2].tolist()
        return cls(
            focal_length=focal_length, centre=centre, alpha=math.atan2(math.hypot(x, y), z), direction=math.atan2(y, x)
        )

    @classmethod
    def from_camera(cls, camera: Camera) -> TiltedSensor:
        """Build the sensor of a camera with fx = fy.

        Raises
        ------
        ValueError
            The pixels are not square.
        """
        matrix, distortion = camera.to_opencv()
        if not math.isclose(matrix[0, 0], matrix[1, 1], rel_tol=1e-9):
            raise ValueError(f"the camera has fx = {matrix[0, 0]:g}, fy = {matrix[1, 1]:g}, expected square pixels")
        return cls.from_tau(float(matrix[0, 0]), (matrix[0, 2], matrix[1, 2]), *distortion[12:])

    @property
    def virtual_focal_length(self) -> float:
        """Distance from the pinhole to the sensor plane [px]: f = f' cos(alpha) (eq. 3.1)."""
        return self.focal_length * math.cos(self.alpha)

    @property
    def virtual_centre(self) -> tuple[float, float]:
        """Foot of the perpendicular from the pinhole to the sensor [px]; f' sin(alpha) from the centre."""
        x, y, _ = self.axis.tolist()
        return self.centre[0] - self.focal_length * x, self.centre[1] - self.focal_length * y

    @property
    def virtual_camera(self) -> Camera:
        """Untilted camera that records the same undistorted image (fig. 3.3, S')."""
        (column, row), f = self.virtual_centre, self.virtual_focal_length
        return Camera(matrix=((f, 0.0, column), (0.0, f, row), (0.0, 0.0, 1.0)))

    @property
    def rotation(self) -> Floats:
        """Rotation (3, 3) from the lens' frame (the frame of a tilted `Camera`'s poses) to the virtual camera's."""
        return tilt_matrix(*self.tau)

    @classmethod
    def from_virtual(
        cls, focal_length: float, virtual_centre: tuple[float, float], centre: tuple[float, float]
    ) -> TiltedSensor:
        """Build the sensor from its virtual camera and the distortion centre: the inverse of fig. 3.3.

        Parameters
        ----------
        focal_length : float
            f of the virtual camera [px].
        virtual_centre : (float, float)
            Principal point of the virtual camera [px].
        centre : (float, float)
            Column and row of the optical axis on the sensor [px].
        """
        x, y = centre[0] - virtual_centre[0], centre[1] - virtual_centre[1]
        return cls(
            focal_length=math.hypot(x, y, focal_length),
            centre=centre,
            alpha=math.atan2(math.hypot(x, y), focal_length),
            direction=math.atan2(y, x),
        )


def plane_of_focus(sensor: TiltedSensor, lens_focal_length: float, pixel_pitch: float) -> tuple[Floats, float]:
    """Return the plane of sharp focus of a thin lens before a tilted sensor: the Scheimpflug condition.

    Object plane, lens plane and sensor plane intersect in one line.

    Parameters
    ----------
    sensor : TiltedSensor
        Sensor; its f' is the image distance.
    lens_focal_length : float
        Focal length of the thin lens [m]; below f' for a real object.
    pixel_pitch : float
        Pixel pitch [m/px].

    Returns
    -------
    tuple
        Unit normal n (3,) in the lens' frame (columns, rows, optical axis) and distance d [m]: points X with n . X = d
        are in focus.

    Raises
    ------
    ValueError
        The lens focuses no plane before it onto the sensor.

    References
    ----------
    F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, fig. 3.1.
    """
    image = sensor.focal_length * pixel_pitch
    if not 0.0 < lens_focal_length < image:
        raise ValueError(f"lens_focal_length is {lens_focal_length:g} m, expected above 0 and below f' ({image:g} m)")
    # The sensor plane, reflected through the pinhole, is m . q = f with its normal m. A point P = q Z / z is in focus
    # if 1/Z + 1/z = 1/F (thin lens), hence Z/F - m . P / f = 1.
    f = sensor.virtual_focal_length * pixel_pitch
    plane = np.array([0.0, 0.0, 1.0 / lens_focal_length]) - sensor.rotation[2] / f
    length = float(np.linalg.norm(plane))
    return plane / length, 1.0 / length


def tilt_for_plane(normal: npt.ArrayLike, distance: float, lens_focal_length: float) -> tuple[float, float, float]:
    """Return the sensor tilt that focuses a plane: the Scheimpflug condition solved for the sensor.

    Parameters
    ----------
    normal : array_like
        Normal n (3,) of the plane n . X = d, in the lens' frame (columns, rows, optical axis).
    distance : float
        d [m], for a unit normal.
    lens_focal_length : float
        Focal length of the thin lens [m], above 0.

    Returns
    -------
    tuple of float
        f' [m], tauX and tauY [rad], the arguments of `TiltedSensor.from_tau` (which takes f' in pixels).

    Raises
    ------
    ValueError
        The plane passes through the lens, or meets the optical axis nearer than the focal length.
    """
    n = np.asarray(normal, dtype=np.float64)
    if lens_focal_length <= 0.0:
        raise ValueError(f"lens_focal_length is {lens_focal_length:g} m, expected a number above 0")
    if n.shape != (3,) or not np.isfinite(n).all() or not n.any():
        raise ValueError(f"normal is {n.tolist()}, expected three finite numbers, not all 0")
    if distance == 0.0 or n[2] / distance * lens_focal_length >= 1.0 or n[2] / distance <= 0.0:
        raise ValueError("the plane meets the optical axis nearer than the focal length: no sensor sees it sharply")
    # As in `plane_of_focus`, solved for the sensor's normal over f.
    normal_over_f = np.array([0.0, 0.0, 1.0 / lens_focal_length]) - n / distance
    x, y, z = (normal_over_f / np.linalg.norm(normal_over_f)).tolist()
    # The normal is the last row of `TiltedSensor.rotation`: (sin tauY, -cos tauY sin tauX, cos tauY cos tauX).
    return float(1.0 / normal_over_f[2]), math.atan2(-y, z), math.asin(x)
