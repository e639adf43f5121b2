"""Reference of the measurement-plane polynomials, term by term in extended precision.

References
----------
F. de Jong, *Range Imaging and Visual Servoing for industrial applications*, TU Delft 2008, equations 3.6 and 3.7.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray


def to_plane(points: ArrayLike, p: ArrayLike, q: ArrayLike) -> NDArray[np.longdouble]:
    """Return (G, H) (n, 2) [m] of sensor points (n, 2), with the 8 coefficients of each polynomial."""
    c, r = np.asarray(points, np.longdouble).T
    p, q = np.asarray(p, np.longdouble), np.asarray(q, np.longdouble)
    g = p[0] + p[1] * c + p[2] * r + p[3] * c**2 + p[4] * r * c + p[5] * r**2 + p[6] * r**2 * c + p[7] * c**3
    h = q[0] + q[1] * r + q[2] * c + q[3] * r**2 + q[4] * c * r + q[5] * c**2 + q[6] * c**2 * r + q[7] * r**3
    return np.stack([g, h], -1)
