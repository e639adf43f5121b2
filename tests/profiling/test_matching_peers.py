"""Peers of calipers, blobs and field searches: every form of a peer agrees with double precision or with us."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import ruler


@pytest.fixture(scope="module")
def exact_rulers():
    image, rulers = ruler.scene(45)
    exact = ruler._numpy(image, rulers.astype(np.float64), ruler._gradient_matrix(np.float64))
    return image, rulers, exact


def test_numba_measures_the_rulers(exact_rulers):
    """45 rulers fill neither the blocks nor the lanes of the forms."""
    image, rulers, exact = exact_rulers
    seen = set()
    for peer, name, call, edges, status in ruler.numba_calls(image, rulers):
        edges[...], status[...] = np.nan, 255
        call()
        ruler.check_peer(name, edges, status, exact)
        seen.add((peer, name))
    assert {("numba", "pairs"), ("numba", "lanes"), ("numba-plain", "")} <= seen


def test_a_wrong_edge_of_a_peer_is_noticed(exact_rulers):
    _, rulers, exact = exact_rulers
    status = np.zeros(len(rulers), np.uint8)
    for row, change in enumerate((1e-3, 0.1, 1e-3, 1e-3)):
        edges = np.stack(exact[:4]).astype(np.float32)
        edges[3] /= ruler.WIDTH
        ruler.check_peer("same", edges, status, exact)
        edges[row, 7] += change
        with pytest.raises(AssertionError, match="changed"):
            ruler.check_peer("changed", edges, status, exact)
