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
        ((1e7,), [1e7]),
        ((0.5, 9e11), [0.5, 9e11]),
        ((0.5, 1.1e12), [0.5]),  # beyond the square of the farthest radius
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


def determinants(terms: dict[str, float], points: np.ndarray) -> np.ndarray:
    """Return the determinant of the Jacobian of OpenCV's distortion at points (..., 2), by complex steps."""
    k = [terms.get(f"k{n}", 0.0) for n in range(1, 7)]
    p1, p2 = terms.get("p1", 0.0), terms.get("p2", 0.0)
    s = [terms.get(f"s{n}", 0.0) for n in range(1, 5)]

    def distorted(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        q = x * x + y * y
        scale = (1 + k[0] * q + k[1] * q**2 + k[2] * q**3) / (1 + k[3] * q + k[4] * q**2 + k[5] * q**3)
        return (
            x * scale + 2 * p1 * x * y + p2 * (q + 2 * x * x) + s[0] * q + s[1] * q**2,
            y * scale + p1 * (q + 2 * y * y) + 2 * p2 * x * y + s[2] * q + s[3] * q**2,
        )

    x, y = np.moveaxis(points, -1, 0)
    step = 1e-30
    by_x, by_y = distorted(x + 1j * step, y + 0j), distorted(x + 0j, y + 1j * step)
    return np.asarray((by_x[0].imag * by_y[1].imag - by_x[1].imag * by_y[0].imag) / step**2)


@pytest.mark.parametrize(
    ("terms", "kind"),
    [
        ({"k1": 0.5, "p2": 0.01}, "no fold"),
        ({"k1": -0.2, "p1": 0.004, "p2": -0.007}, "one fold"),
        ({"k1": -0.2, "p1": 0.004, "s1": 0.01, "s4": -0.003}, "one fold"),
        ({"k1": -0.3, "k2": 0.045, "p2": 0.02}, "two folds"),
        ({"k1": 0.1, "k4": -0.1, "p1": 0.003}, "pole"),
        ({"p1": 0.03, "p2": 0.05}, "one side"),
    ],
)
@pytest.mark.parametrize("unit", [1.0, 30.0])
def test_regions_of_decentred_terms(terms: dict[str, float], kind: str, unit: float) -> None:
    """The determinant along 90 rays: positive within `safe`, with one change of sign at most within `limit`."""
    powers = dict(zip(["k1", "k2", "k4", "p1", "p2", "s1", "s4"], (2, 4, 2, 1, 1, 1, 3), strict=True))
    scaled = {name: value / unit ** powers[name] for name, value in terms.items()}
    sizes = (("k", 6), ("p", 2), ("s", 4))
    groups = [[scaled.get(f"{name}{n}", 0.0) for n in range(1, count + 1)] for name, count in sizes]
    region = invertible_region(*groups)
    angles = np.linspace(0.0, 2.0 * math.pi, 90, endpoint=False)
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=-1)

    def along(radius: float) -> np.ndarray:
        radii = np.linspace(0.0, min(radius, 40.0 * unit), 400, endpoint=False)
        return determinants(scaled, radii[:, None, None] * rays)

    assert (along(math.sqrt(region.safe)) > 0.0).all()
    changes = np.count_nonzero(np.diff(along(math.sqrt(region.limit)) > 0.0, axis=0), axis=0)
    assert changes.max() <= 1
    radius = np.hypot(*region.edge.T)
    folds = np.isfinite(radius)
    at = region.edge[folds]
    if kind != "pole":
        np.testing.assert_allclose(determinants(scaled, at), 0.0, atol=1e-8)
        inside = determinants(scaled, region.edge[folds] * 0.999)
        assert (inside > 0.0).all()
    if kind == "no fold":
        assert region.safe == region.limit == math.inf
        assert not folds.any()
    elif kind == "one fold":
        assert folds.all()
        assert math.sqrt(region.limit) > radius.max()
        assert region.safe == pytest.approx((0.98 * radius.min()) ** 2, rel=1e-9)
    elif kind == "two folds":
        # The square of the limit lies between the last first fold and the nearest second one, or below the latter.
        again = _second_fold(scaled, rays, unit)
        assert folds.any()
        assert region.limit < again**2
        assert region.limit == pytest.approx(
            radius[folds].max() * again if radius[folds].max() < again else (0.98 * again) ** 2, rel=0.02
        )
    elif kind == "pole":
        pole = unit / math.sqrt(0.1)
        assert region.limit == pytest.approx(pole**2)
        assert (radius <= pole * (1.0 + 1e-9)).all()
    else:
        assert 0 < np.count_nonzero(folds) < len(folds)


def _second_fold(terms: dict[str, float], rays: np.ndarray, unit: float) -> float:
    """Return the smallest radius of a second change of sign along a ray."""
    radii = np.linspace(0.0, 8.0 * unit, 1600)
    positive = determinants(terms, radii[:, None, None] * rays) > 0.0
    changes = np.cumsum(np.diff(positive, axis=0), axis=0)
    return float(radii[1 + np.flatnonzero((changes >= 2).any(axis=1))[0]])
