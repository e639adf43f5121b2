"""Free parameters of a tilted camera in a fit, and the coordinates in which the fit works.

In f', centre c and tilt, data with little distortion form a curved valley. The fit works in the virtual camera (f, v)
and the centre c instead: the optical axis has the direction g = (c - v, f) in the sensor's frame, so that alpha is the
angle between g and the sensor's normal, f' = |g| and f = f' cos(alpha) (F. de Jong, *Range Imaging and Visual Servoing
for industrial applications*, TU Delft 2008, eq. 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gpuvision.camera.tilted_projection import INTERNAL, Floats

FIT_PARAMETERS = (
    "f",
    "aspect",
    "v_column",
    "v_row",
    "c_column",
    "c_row",
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
)
"""Coordinates of the fit."""
OPENCV = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "tauX", "tauY")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True, kw_only=True)
class FreeParameters:
    """Free parameters of one camera model.

    Parameters
    ----------
    coefficients : tuple of str
        Free distortion coefficients, from `COEFFICIENTS`; the others keep their values.
    tilt : bool
        The sensor is tilted: c and v are independent. Otherwise c equals v.
    aspect : bool
        fy / fx is free. Default False.
    focal_length : float, optional
        Known f' [px]. Default: free.
    centre : bool
        The centre is free; otherwise it keeps its value. Default True.
    direction : float, optional
        Known direction of the tilt [rad], from the columns' axis towards the rows': v then moves along it only.
    """

    coefficients: tuple[str, ...]
    tilt: bool
    aspect: bool = False
    focal_length: float | None = None
    centre: bool = True
    direction: float | None = None

    @property
    def basis(self) -> Floats:
        """Linear map (14, free) from free parameters to `FIT_PARAMETERS`. Without a tilt v follows the centre."""
        names = [] if self.focal_length is not None else ["f"]
        names += ["aspect"] if self.aspect else []
        names += ["v_column"] if self.tilt else []
        names += ["v_row"] if self.tilt and self.direction is None else []
        names += ["c_column", "c_row"] if self.centre else []
        names += self.coefficients
        basis = np.eye(len(FIT_PARAMETERS))[:, [FIT_PARAMETERS.index(name) for name in names]]
        if self.tilt and self.direction is not None:
            basis[2:4, names.index("v_column")] = np.cos(self.direction), np.sin(self.direction)
        return basis

    @property
    def count(self) -> int:
        """Number of free parameters."""
        return len(self.basis.T)

    @property
    def names(self) -> tuple[str, ...]:
        """OpenCV's names of the free parameters; ``f`` for fx = fy."""
        names = [] if self.focal_length is not None else ["fx", "fy"] if self.aspect else ["f"]
        names += ["fy"] if self.aspect and self.focal_length is not None else []
        names += ["cx", "cy"] if self.centre else []
        names += [*self.coefficients, *(("tauX", "tauY") if self.tilt else ())]
        return tuple(names)

    def with_dependent(self, values: Floats) -> Floats:
        """Return the parameters with the dependent ones recomputed: v without a tilt, f if f' is known.

        f is NaN if no tilt leads the axis from v to c with this f'.
        """
        result = values.copy()
        if not self.tilt:
            result[2:4] = result[4:6]
        if self.focal_length is not None:
            reach = self.focal_length**2 - (result[4] - result[2]) ** 2 - ((result[5] - result[3]) / result[1]) ** 2
            result[0] = np.sqrt(reach) if reach > 0.0 else np.nan
        return result

    def derivative(self, values: Floats) -> Floats:
        """Return d(`FIT_PARAMETERS`) / d(free parameters), (14, free)."""
        derivative = self.basis
        if not self.tilt:
            derivative[2:4] = derivative[4:6]
        elif self.focal_length is not None:
            f, aspect, v_column, v_row, c_column, c_row = values[:6]
            across, down = c_column - v_column, (c_row - v_row) / aspect
            moves_down = (derivative[5] - derivative[3] - down * derivative[1]) / aspect
            derivative[0] = -(across * (derivative[4] - derivative[2]) + down * moves_down) / f
        return derivative


def internal_parameters(values: Floats) -> tuple[Floats, Floats]:
    """Return the parameters of `tilted_projection.project`, and their derivative (14, 14) by `FIT_PARAMETERS`."""
    f, aspect, v_column, v_row, c_column, c_row = values[:6].tolist()
    g = np.array([c_column - v_column, (c_row - v_row) / aspect, f])
    by_parameters = np.zeros((3, len(FIT_PARAMETERS)))
    by_parameters[0, 4], by_parameters[0, 2] = 1.0, -1.0
    by_parameters[1, 5], by_parameters[1, 3], by_parameters[1, 1] = 1.0 / aspect, -1.0 / aspect, -g[1] / aspect
    by_parameters[2, 0] = 1.0
    # g is parallel to (-sin tauY cos tauX, sin tauX, cos tauY cos tauX).
    flat2, whole2 = g[0] ** 2 + g[2] ** 2, g @ g
    flat = np.sqrt(flat2)
    tau_x, tau_y = np.arctan2(g[1], flat), np.arctan2(-g[0], g[2])
    by_g_x = np.array([-g[0] * g[1] / flat, flat, -g[2] * g[1] / flat]) / whole2
    by_g_y = np.array([-g[2], 0.0, g[0]]) / flat2
    internal = values.copy()
    internal[4], internal[5] = tau_x, tau_y
    derivative = np.eye(len(INTERNAL))
    derivative[4], derivative[5] = by_g_x @ by_parameters, by_g_y @ by_parameters
    return internal, derivative


def opencv_parameters(values: Floats) -> tuple[Floats, Floats]:
    """Return the parameters named in `OPENCV`, and their derivative (14, 14) by `FIT_PARAMETERS`."""
    internal, to_internal = internal_parameters(values)
    f, aspect, v_column, v_row, c_column, c_row = values[:6].tolist()
    g = np.array([c_column - v_column, (c_row - v_row) / aspect, f])
    fx = float(np.linalg.norm(g))
    result = np.array([fx, aspect * fx, c_column, c_row, *values[6:], internal[4], internal[5]])
    derivative = np.zeros((len(OPENCV), len(FIT_PARAMETERS)))
    by_g = g / fx
    derivative[0, [4, 2, 0]] = by_g[0], -by_g[0], by_g[2]
    derivative[0, [5, 3, 1]] = by_g[1] / aspect, -by_g[1] / aspect, -by_g[1] * g[1] / aspect
    derivative[1] = aspect * derivative[0]
    derivative[1, 1] += fx
    derivative[2, 4] = derivative[3, 5] = 1.0
    derivative[4:12, 6:] = np.eye(8)
    derivative[12:] = to_internal[4:6]
    return result, derivative
