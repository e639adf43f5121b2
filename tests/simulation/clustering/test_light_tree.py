"""Numbers of the nodes of a light tree, by hand."""

from __future__ import annotations

import numpy as np

from gpuvision.simulation.clustering.light_tree import _mean_direction


def test_normals_that_cancel_have_the_direction_of_the_first() -> None:
    """Sums of one and of two normals keep their direction, also at the length 1."""
    summed = np.array([[0.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 2.0]])
    first = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    facing, length = _mean_direction(summed, first)
    np.testing.assert_allclose(facing, [[1.0, 0.0, 0.0], [0.0, 0.6, 0.8], [0.0, 0.0, 1.0]], rtol=1e-15)
    np.testing.assert_allclose(length, [0.0, 1.0, 2.0], rtol=1e-15)
