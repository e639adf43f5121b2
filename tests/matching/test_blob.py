"""FindBlobs on devices: marks of every shape where they are, as the float64 reference says, and flagged where not."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.matching.blob import FindBlobs
from reference import blob as reference

SHAPE = (80, 96)
WALKS = pytest.mark.parametrize("walk", ["strip", "item"])
PLAIN = FindBlobs(threshold=20.0)


def image_of(values: np.ndarray, dtype: Any) -> np.ndarray:
    return values.astype(dtype) if np.dtype(dtype).kind == "f" else np.rint(values).astype(dtype)


@WALKS
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_a_disc(device: Device, walk: Any, dtype: Any) -> None:
    image = image_of(50.0 + 100.0 * reference.disc(SHAPE, 40.3, 39.6, 10.0, 1.0), dtype)
    blobs = FindBlobs(threshold=20.0, walk=walk)(image, np.array([[38, 42, 9]], np.float32), device=device)
    assert blobs.status[0] == 0
    np.testing.assert_allclose([blobs.x[0], blobs.y[0], blobs.size[0]], [40.3, 39.6, 10.0], atol=0.01)
    np.testing.assert_allclose([blobs.gravity_x[0], blobs.gravity_y[0]], [40.3, 39.6], atol=0.01)
    assert blobs.inliers[0] == 32
    assert blobs.symmetry[0] > 0.95
    assert abs(blobs.contrast[0] - 100.0) < 1.0
