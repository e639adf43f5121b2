"""Correction of a camera along the profiles of a readout, against the camera's inverse."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.camera.distortion import ExchangedAxes
from gpuvision.camera.profile_correction import ProfileCorrection, profile_correction

CAMERA = Camera(
    matrix=((1000.0, 0.0, 512.0), (0.0, 980.0, 250.0), (0.0, 0.0, 1.0)),
    distortion=(-0.2, 0.12, 7e-4, -4e-4, 0.05, 0.06, -0.02, 0.01, 3e-4, -5e-4, -2e-4, 4e-4, 0.35, -0.12),
)
FIRST, PITCH, UNIT = np.array([3.0, 900.0]), np.array([1.0, -0.5]), np.array([400.0, -500.0])


def table(tolerance: float, camera: Camera = CAMERA) -> ProfileCorrection | None:
    return profile_correction(
        ExchangedAxes(camera), first=FIRST, pitch=PITCH, length=500, samples=100, unit=UNIT, tolerance=tolerance
    )


@pytest.mark.parametrize("tolerance", [1e-4, 3e-8, 1e-11])
def test_the_correction_is_within_the_tolerance(tolerance: float, rng: np.random.Generator) -> None:
    found = table(tolerance)
    assert found is not None
    position, sample = rng.uniform(0.0, 499.0, 400), rng.integers(0, 100, 400)
    points = FIRST + PITCH * np.stack([position, sample], -1)
    exact = (CAMERA.undistort(points[:, ::-1])[:, ::-1] - points) / UNIT
    t = (position - found.middle) * found.scale
    powers = t ** np.arange(found.terms.shape[1])[:, None]
    error = np.abs(np.sum(found.terms[:, :, sample] * powers, axis=1).T - exact)
    assert error.max() <= tolerance
    # The tolerance decides how many terms there are.
    assert error.max() > 1e-4 * tolerance


def test_no_table_for_a_strict_tolerance_and_beyond_the_fold() -> None:
    assert table(1e-17) is None
    # The image of k1 = -1 ends 0.385 focal lengths from the centre.
    folding = Camera(matrix=CAMERA.matrix, distortion=(-1.0, *(0.0,) * 13))
    assert table(1e-3, folding) is None


@pytest.mark.parametrize("samples", [16, 21])
def test_blocks_of_the_kernel(samples: int) -> None:
    """Blocks of 16 profiles from the first one on, then blocks that end with the last profile."""
    terms = np.arange(2.0 * 3 * samples).reshape(2, 3, samples)
    blocks = ProfileCorrection(terms, 0.0, 1.0).blocks(np.float32)
    assert blocks.dtype == np.float32
    assert blocks.shape == ((1 if samples == 16 else 3), 3, 2, 16)
    for power in range(3):
        for axis in (0, 1):
            np.testing.assert_array_equal(blocks[0, 2 - power, axis], terms[axis, power, :16])
            if samples == 21:
                np.testing.assert_array_equal(blocks[1, 2 - power, axis, :5], terms[axis, power, 16:])
                np.testing.assert_array_equal(blocks[2, 2 - power, axis], terms[axis, power, 5:])
