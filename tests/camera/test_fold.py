"""Sign changes of polynomials, and invertible regions of radial terms whose fold is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.polynomial import polynomial

from gpuvision.camera.fold import _sign_changes, invertible_region

NONE6, NONE2, NONE4 = (0.0,) * 6, (0.0,) * 2, (0.0,) * 4


@pytest.mark.parametrize(
    ("roots", "expected"),
    [
        ((), []),
        ((-1.0, -3.0), []),
        ((2.0, 0.5, -1.0), [0.5, 2.0]),
        ((0.5, 1.5, 2.5, 3.0), [0.5, 1.5, 2.5, 3.0]),
        ((1.0 + 1.0j, 1.0 - 1.0j, 2.0), [2.0]),
        ((1.0, 1.0), []),
        ((0.3, 0.3, 0.7), [0.7]),
        ((0.3, 0.7, 0.7), [0.3]),
        ((0.3, 0.7, 0.7, 2.0), [0.3, 2.0]),
    ],
)
def test_sign_changes_are_at_positive_roots_of_odd_order(roots: tuple[complex, ...], expected: list[float]) -> None:
    terms = polynomial.polyfromroots(roots).real
    assert _sign_changes(terms / terms[0]) == pytest.approx(expected, rel=1e-6)


def test_a_triple_root_is_one_sign_change() -> None:
    """Rounding splits a triple root by its third root, 6e-6, times its condition."""
    assert _sign_changes((1.0, -3.0, 3.0, -1.0)) == pytest.approx([1.0], rel=1e-4)
    terms = polynomial.polyfromroots((0.3, 0.7, 0.7, 0.7, 2.0))
    assert _sign_changes(terms / terms[0]) == pytest.approx([0.3, 0.7, 2.0], rel=1e-3)


@pytest.mark.parametrize("unit", [1.0, 1e-2, 1e2])
def test_regions_of_radial_terms(unit: float) -> None:
    """1 + 3 k1 r^2 vanishes at r^2 = -1 / (3 k1); a denominator 1 + k4 r^2 at r^2 = -1 / k4, before the fold."""
    for change, square in (
        ({0: -0.2}, 1.0 / 0.6),
        ({0: 0.2}, math.inf),
        ({3: -0.5}, 2.0),
        ({3: 0.5}, 2.0),  # r / (1 + r^2 / 2) is largest at r^2 = 2
    ):
        k = np.array(NONE6)
        for place, value in change.items():
            k[place] = value / unit**2
        region = invertible_region(tuple(k), NONE2, NONE4)
        assert region.safe == region.limit == pytest.approx(square * unit**2, rel=1e-9)
        np.testing.assert_allclose(np.hypot(*region.edge.T), math.sqrt(square) * unit, rtol=1e-9)


def test_tangential_terms_fold_on_one_side() -> None:
    """With p2 alone, x' = x (1 + 3 p2 x) on the x axis folds at x = -1 / (6 p2)."""
    p2 = 0.05
    region = invertible_region(NONE6, (0.0, p2), NONE4)
    radius = np.hypot(*region.edge.T)
    nearest = region.edge[np.argmin(radius)]
    assert nearest[0] < 0.0
    # The determinant is (1 + 6 p2 x) (1 + 2 p2 x) - 4 p2^2 y^2.
    at = region.edge[np.isfinite(radius)]
    np.testing.assert_allclose(
        (1 + 6 * p2 * at[:, 0]) * (1 + 2 * p2 * at[:, 0]) - (2 * p2 * at[:, 1]) ** 2, 0, atol=1e-9
    )
    assert region.safe == pytest.approx((0.98 * radius.min()) ** 2, rel=1e-9)
    assert region.safe < (1 / (6 * p2)) ** 2
