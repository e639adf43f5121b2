"""Measurement-plane polynomials (F. de Jong, eq. 3.6 and 3.7), term by term in extended precision."""

from __future__ import annotations

import numpy as np


def to_plane(points, p, q):
    """Return (G, H) of sensor points (n, 2)."""
    c, r = np.asarray(points, np.longdouble).T
    p, q = np.asarray(p, np.longdouble), np.asarray(q, np.longdouble)
    g = p[0] + p[1] * c + p[2] * r + p[3] * c**2 + p[4] * r * c + p[5] * r**2 + p[6] * r**2 * c + p[7] * c**3
    h = q[0] + q[1] * r + q[2] * c + q[3] * r**2 + q[4] * c * r + q[5] * c**2 + q[6] * c**2 * r + q[7] * r**3
    return np.stack([g, h], -1)
