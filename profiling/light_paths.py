"""Complete profile of a simulated scan, compared with the time of NumPy and Embree for its indirect light alone.

We compute lit segments, shadows, the visible parts, causes of errors, the surface in the view of every bin, indirect
light with exact visibility, and true positions. The peer traces rays from 256 samples of the line to the same surface
elements (`occluded_irradiance`). Errors are medians of the indirect light, relative to double precision.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator

import numpy as np

from gpuvision.host import Device, to_numpy
from gpuvision.profiling.harness import Case
from gpuvision.profiling.occluded_irradiance import Board, embree_of, error_of, irradiance_by_samples
from gpuvision.simulation.transport.line_irradiance import LitSegments
from gpuvision.simulation.transport.occluded_irradiance import OccludedIrradiance, segment_rows
from gpuvision.workflows.demo import make_scan_task
from gpuvision.workflows.light_cache import make_light_paths

_SAMPLES = 256
_AT = 0.006  # transport position [m]: the sheet crosses the rim of the cylinder, the box and the ball


def cases(device: Device) -> Iterator[Case]:
    """Yield a profile of PSD strips and one of a camera."""
    for name in ("psd_line", "camera_line"):
        yield _case(device, name)


def _case(device: Device, name: str) -> Case:
    task = make_scan_task(name)
    model = make_light_paths(task, device)
    seen = model.view_rays.visible_surface(_AT)
    lit = model.sheet.illuminate(task.part, _AT)
    segments = LitSegments(lit.ends, lit.normals, task.materials[0].albedo * lit.power)
    board = Board(task.part, segments, seen.receivers.astype(np.float32))
    ours, truth = model.irradiance(seen, segments), np.full(seen.weights.shape, np.nan)
    if device.has_double:
        rows = segment_rows(segments)
        exact = OccludedIrradiance(scene=task.part, segments=len(rows), precision="double")
        truth = to_numpy(exact(seen.receivers, np.zeros((*seen.weights.shape, 2)), rows, device=device).irradiance)
    peer = functools.partial(irradiance_by_samples, board, _SAMPLES, embree_of(task.part))
    seen_at_all = seen.weights > 0.0
    metadata = {
        "receivers": int(seen_at_all.sum()),
        "segments": len(segments.exitance),
        "peer_error": error_of(peer().reshape(truth.shape)[seen_at_all], truth[seen_at_all]),
    }
    run = functools.partial(model.profile, _AT)
    error = error_of(ours[seen_at_all], truth[seen_at_all])
    return Case("simulate", f"profile/{name}", run, {"numpy+embreex": peer}, error, metadata=metadata)
