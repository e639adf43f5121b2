"""Reference of visible intervals: complement of the union of all occluded intervals."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]


def visible_parts(corners: Float64, fan: Float64, least: float = 1e-9) -> Float64:
    """Return the visible parts (k, 2) of the segment of one fan (11,), as fractions of its length.

    The intersection of each triangle with the plane of the fan is a segment. It is clipped to the fan; its ends, seen
    from the apex, bound an occluded interval.

    Parameters
    ----------
    corners
        (n, 3, 3), triangles [m].
    fan
        Apex, the two ends of the segment [m], and the two fractions from which on triangles occlude.
    least
        Shorter parts are ignored, as a fraction of the segment.
    """
    apex, one, two = fan[:3], fan[3:6] - fan[:3], fan[6:9] - fan[:3]
    per = 1.0 / np.maximum(fan[9:], 1e-12)
    basis = np.linalg.pinv(np.stack([one, two], axis=1))
    normal = np.cross(one, two) / np.linalg.norm(np.cross(one, two))
    occluded = []
    for triangle in corners - apex:
        above = triangle @ normal
        cuts = []
        for n in range(3):
            m = (n + 1) % 3
            if (above[n] < 0.0) != (above[m] < 0.0):
                share = above[n] / (above[n] - above[m])
                cuts.append(basis @ (triangle[n] + share * (triangle[m] - triangle[n])))
        if len(cuts) != 2:
            continue
        start, end = cuts
        low, high = 0.0, 1.0
        for weights, offset in (((1, 0), 0), ((0, 1), 0), ((-1, -1), 1 - least), (per, -1 - least)):
            a, b = np.dot(weights, start) + offset, np.dot(weights, end) + offset
            if a < 0 and b < 0:
                low, high = 1.0, 0.0
            elif a < 0:
                low = max(low, a / (a - b))
            elif b < 0:
                high = min(high, a / (a - b))
        if high > low:
            ends = [start + share * (end - start) for share in (low, high)]
            occluded.append(sorted(each[1] / each.sum() for each in ends))
    parts, at = [], 0.0
    for begin, finish in sorted(occluded):
        if begin > at + least:
            parts.append((at, begin))
        at = max(at, finish)
    if at < 1.0 - least:
        parts.append((at, 1.0))
    return np.array(parts).reshape(-1, 2)
