"""Peers of calipers, blobs and field searches: every form of a peer agrees with double precision or with us."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling import ruler, shift_peers


@pytest.fixture(scope="module")
def exact_rulers():
    image, rulers = ruler.scene(45)
    exact = ruler._numpy(image, rulers.astype(np.float64), ruler._gradient_matrix(np.float64))
    return image, rulers, exact


@pytest.mark.parametrize(
    ("peer", "names"),
    [
        ("numba-plain", {""}),
        # Numba compiles these forms for a minute or more; the plain form runs the same check of the results.
        pytest.param("numba", {"pairs", "lanes"}, marks=pytest.mark.slow),
    ],
)
def test_numba_measures_the_rulers(exact_rulers, peer, names):
    """45 rulers fill neither the blocks nor the lanes of the forms."""
    image, rulers, exact = exact_rulers
    seen = set()
    for of, name, call, edges, status in ruler.numba_calls(image, rulers):
        if of != peer:
            continue
        edges[...], status[...] = np.nan, 255
        call()
        ruler.check_peer(name, edges, status, exact)
        seen.add(name)
    assert names <= seen


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


@pytest.mark.slow  # Numba compiles each form for seconds
@pytest.mark.parametrize("is_long", [False, True])
@pytest.mark.parametrize("rays", [4, 8, 16])
def test_numba_adds_the_shifted_rows(rays, is_long):
    """61 or 131 rays fill neither the passes nor the sums of 16 bits; some are not used."""
    rng = np.random.default_rng(8)
    count, rows, columns, stride = 131 if is_long else 61, 3, 70, 90
    level = rng.integers(0, 1024, (9, stride)).astype(np.uint16)
    shifts = rng.integers(0, 5 * stride + 20, (2, count))
    shifts[0, ::7], shifts[1, -3:] = -1, -1
    flat, wide = shift_peers.padded(level, columns)
    scores, least = np.full((2, rows, columns), np.nan, np.float32), np.full((2, rows, 2), np.nan, np.float32)
    where = np.full((2, rows, 2), -1)
    shift_peers.search_form(rays, wide, is_long=is_long)(flat, stride, shifts, scores, least, where)
    for turn in range(2):
        used = shifts[turn][shifts[turn] >= 0]
        for row in range(rows):
            exact = sum(level.ravel()[at + row * stride :][:columns].astype(int) for at in used) / (1023.0 * len(used))
            assert scores[turn, row] == pytest.approx(exact, rel=1e-6)
            places = [int(np.argmin(exact[:64])), 6 + int(np.argmin(exact[6:70]))]
            assert where[turn, row].tolist() == places
            assert least[turn, row] == pytest.approx(exact[places], rel=1e-6)
