"""Parts of the coarse registration: acceptance, other candidates, border of the cost map, rows of a start."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.matching.pose.coarse_registration import (
    _REFINEMENT_ROWS,
    CoarseRegistration,
    _fill_border,
    _select_found,
)
from gpuvision.matching.pose.motion import rotation
from gpuvision.matching.pose.registration_result import RegistrationLimits, ScoredMotion


def test_a_share_is_accepted_from_its_limit_on() -> None:
    """0.25 and two standard deviations of a share of one half of 16 rulers: 0.25 + 2 * 0.5 / 4 = 0.5."""
    search: Any = SimpleNamespace(min_score=0.25, limits=SimpleNamespace(significance=2.0))
    for score, rulers, accepted in ((0.5, 16, True), (0.4999, 16, False), (0.375, 64, True), (0.5, 15, False)):
        tried: Any = SimpleNamespace(score=score, rulers=rulers)
        assert CoarseRegistration._is_accepted(search, tried) == accepted


def test_other_candidates_move_half_of_the_rulers_by_more_than_the_tolerance() -> None:
    """A tolerance of 1.5 px: 4 px, at 0.02 units for each pixel 0.08 units, in the median of the rulers."""
    point = np.array([[5.0, 1.0], [9.0, 1.0], [5.0, 8.0], [-3.0, -2.0], [7.0, 3.0]])
    search: Any = SimpleNamespace(
        rulers=SimpleNamespace(point=point), placement=np.array([5.0, 1.0]), tolerance_px=1.5, _pixels_per_unit=50.0
    )

    def scored(angle: float, x: float, y: float, agreeing: int) -> ScoredMotion:
        inside = np.ones(10, np.bool_)
        return ScoredMotion(
            np.column_stack([rotation(angle), [5.0 + x, 1.0 + y]]), 0.0, inside, np.arange(10) < agreeing
        )

    best = scored(0.3, 0.0, 0.0, 9)
    # Rulers are 0, 4, 7, 8.54 and 2.83 from the placement point: the median turns about 4 units.
    turn = 2.0 * math.asin(0.08 / 2.0 / 4.0)
    near = [scored(0.3, 0.0479, 0.0639, 8), scored(0.3 + 0.999 * turn, 0.0, 0.0, 7), best]
    far = [scored(0.3 + 1.001 * turn, 0.0, 0.0, 3), scored(0.3, -0.0481, 0.0641, 6), scored(0.3, 0.0, -0.09, 5)]
    found = CoarseRegistration._distinct_from(search, best, [far[0], *near, *far[1:]])
    assert found == [far[1], far[2], far[0]]


@pytest.mark.parametrize(
    ("mine", "other", "is_better"),
    [
        # Twice the score is enough, whatever the rulers.
        ((10, 8), (10, 4), True),
        # Of 100 rulers 60 and 31 agree, 10 of both: 50 against 21, 3 sqrt(71) = 25.3 more than 21, but not twice 26.
        ((100, 60), (100, 31), True),
        ((100, 60), (100, 36), False),
        ((16, 12), (16, 9), False),
    ],
)
def test_a_motion_is_better_by_rulers_of_its_own(mine: Any, other: Any, *, is_better: bool) -> None:
    def scored(rulers: int, agreeing: np.ndarray) -> ScoredMotion:
        return ScoredMotion(np.eye(2, 3), 0.0, np.ones(rulers, np.bool_), agreeing)

    rulers = np.arange(mine[0])
    one = scored(mine[0], rulers < mine[1])
    # Ten rulers, or all that there must be, agree with both motions.
    both = max(10, mine[1] + other[1] - mine[0])
    second = scored(other[0], (rulers >= mine[1] - both) & (rulers < mine[1] - both + other[1]))
    assert (one.rulers, one.score) == (mine[0], mine[1] / mine[0])
    assert one.is_better_than(second, RegistrationLimits()) == is_better


def test_cost_beyond_the_image_is_a_share_of_the_mean_of_each_direction(rng: np.random.Generator) -> None:
    level = np.full((3, 9, 11), 7777, np.uint16)
    inside = rng.integers(0, 1000, (3, 5, 7)) + np.array([0, 3000, 6000])[:, None, None]
    level[:, 2:-2, 2:-2] = inside
    _fill_border(level, 2, 0.75)
    np.testing.assert_array_equal(level[:, 2:-2, 2:-2], inside)
    for each, costs in zip(level, inside, strict=True):
        border = each.copy().astype(float)
        border[2:-2, 2:-2] = np.nan
        np.testing.assert_array_equal(border[np.isfinite(border)], np.rint(0.75 * costs.mean()))


@pytest.mark.parametrize("count", [1, 3, _REFINEMENT_ROWS, 2 * _REFINEMENT_ROWS + 5])
def test_each_start_has_the_same_number_of_rulers_with_an_edge(count: int) -> None:
    offset = np.full((3, 2 * count + 1), np.nan)
    offset[0, 1::2] = offset[2, -1] = 0.5
    found = _select_found(offset)
    assert found.shape == (3, _REFINEMENT_ROWS)
    numbers = (found[0] - 1) // 2
    np.testing.assert_array_equal(numbers, [k * count // _REFINEMENT_ROWS for k in range(_REFINEMENT_ROWS)])
    assert np.all(np.isfinite(offset[0, found[0]]))
    assert set(numbers) == set(range(count)) or count > _REFINEMENT_ROWS
    assert np.isnan(offset[1, found[1]]).all()
    assert set(found[2]) == {2 * count}


@pytest.mark.parametrize("mirrored", [False, True])
def test_scale_and_sign_of_the_etch_bias_in_the_image(*, mirrored: bool) -> None:
    """Root of the determinant of the derivative at the placement point; the sign of a mirrored view."""
    matrix = np.array([[900.0, -200.0, 40.0], [150.0, 1100.0, 30.0], [0.3, -0.2, 1.4]])
    if mirrored:
        matrix[:, 0] *= -1.0
    x, y = place = (0.7, -0.4)
    search: Any = SimpleNamespace(
        to_image=matrix, placement=place, shift=0.5, _to_pixels=lambda p: CoarseRegistration._to_pixels(search, p)
    )
    # The determinant of the derivative of a homography is det(H) / w^3.
    w = matrix[2] @ [x, y, 1.0]
    scale = math.sqrt(abs(np.linalg.det(matrix)) / w**3)
    search._pixels_per_unit = CoarseRegistration._pixels_per_unit.func(search)  # type: ignore[attr-defined]
    assert search._pixels_per_unit == pytest.approx(scale, rel=1e-6)
    sign = -1.0 if mirrored else 1.0
    assert CoarseRegistration._etch_px.fget(search) == pytest.approx(sign * scale, rel=1e-6)  # type: ignore[attr-defined]
    search.to_image = -matrix  # the same homography
    assert CoarseRegistration._etch_px.fget(search) == pytest.approx(sign * scale, rel=1e-6)  # type: ignore[attr-defined]
    pixels = CoarseRegistration._to_pixels(search, np.array([[x, y]]))
    np.testing.assert_allclose(CoarseRegistration._from_pixels(search, pixels), [[x, y]])
