"""Benchmark of the triangulation: its NumPy and Numba peers read the parameter table as the kernel does."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.profiling import triangulation
from gpuvision.ranging.triangulation import Triangulation


@pytest.mark.slow
@pytest.mark.parametrize("lens", [None, triangulation.LENS])
def test_the_peers_agree_with_the_kernel(device: Device, lens: object) -> None:
    operation = Triangulation(homography=triangulation.HOMOGRAPHY, region=triangulation.REGION, lens=lens)
    # `_case` compares the flags of kernel and NumPy in double precision, and the results of both with Numba's.
    case = triangulation._case(device, operation, "float32", 1001, "small")
    assert case.error < 1e-5
    assert set(case.peers) == {"numba", "numba-plain", "numpy"}
    g, *_ = case.peers["numpy"]()
    assert np.isfinite(g).mean() > 0.5
