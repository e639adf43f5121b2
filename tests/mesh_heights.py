"""Heights of a mesh by trimesh's vertical rays: an oracle that shares no code with the simulator or the scan."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import trimesh

Float64 = npt.NDArray[np.float64]


def mesh_heights(mesh: trimesh.Trimesh, x: Float64, y: Float64) -> Float64:
    """Return the largest z of a mesh at places (n,), NaN beside the mesh."""
    above = np.stack([x, y, np.full_like(x, 1.0)], axis=1)
    down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
    places, ray, _ = mesh.ray.intersects_location(above, down, multiple_hits=False)
    found = np.full(len(x), np.nan)
    found[ray] = places[:, 2]
    return found
