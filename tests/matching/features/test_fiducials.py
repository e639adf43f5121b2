"""Selection of round pads as fiducials, and their gain relative to rulers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates
from gpuvision.matching.features.fiducials import MIN_RADIUS_PX, Fiducials, append_fiducials, select_fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.selection import predict_selection, select_rulers
from round_boards import FIDUCIALS, LANDS, TRACES, round_artwork, round_board

IMAGING = Imaging(pixel=25e-6, shift=100e-6, angle=5e-3)
BOARD = ((0.0, 0.0), (20e-3, 16e-3))
MIDDLE = (10e-3, 8e-3)


def found(artwork: Artwork, imaging: Imaging = IMAGING, **more: Any) -> Fiducials:
    return select_fiducials(artwork, BOARD, MIDDLE, imaging, **more)


def names(fiducials: Fiducials) -> set[tuple[float, float]]:
    return {(round(1e3 * x, 3), round(1e3 * y, 3)) for x, y in fiducials.point}


def test_round_lands_are_marks(tmp_path: Path) -> None:
    fiducials = found(round_artwork(round_board(tmp_path)))
    assert names(fiducials) == {*LANDS, *FIDUCIALS}
    # Centres to a hundredth of a micrometre: 10 nm is a tenth of the best standard deviation.
    np.testing.assert_allclose(
        sorted(fiducials.point.tolist()), sorted(np.multiply([*LANDS, *FIDUCIALS], 1e-3).tolist()), atol=1e-8
    )
    np.testing.assert_allclose(fiducials.radius, 0.5e-3, rtol=2e-3)
    in_the_open = np.array([each in FIDUCIALS for each in map(tuple, np.round(1e3 * fiducials.point, 3).tolist())])
    assert np.all(fiducials.sigma[in_the_open] < fiducials.sigma[~in_the_open].min())


@pytest.mark.parametrize(
    ("more", "is_mark"),
    [
        ({}, True),
        # The mask opening is 0.1 mm wider, or covers the rim of the pad, or is 0.5 mm wider.
        ({"openings": ((7, 5, 1.2),)}, False),
        ({"openings": ((7, 5, 0.9),)}, False),
        ({"openings": ((7, 5, 2.0),)}, True),
        # A trace ends in the pad, two wider traces do, a line passes by.
        ({"traces": ((7, 5, 9, 6),), "width": 0.25}, True),
        ({"traces": ((7, 5, 9, 6), (7, 5, 5, 5)), "width": 0.5}, False),
        ({"traces": ((5, 5.8, 9, 5.8),), "width": 0.4}, False),
        # Holes that leave a ring of 0.3 mm, of 0.1 mm, and nothing of the pad.
        ({"holes": ((7, 5, 0.4),)}, True),
        ({"holes": ((7, 5, 0.8),)}, False),
        ({"holes": ((7, 5, 1.7),)}, False),
        # Another pad with which it may be confused.
        ({"pads": (*LANDS, (7.0, 5.25))}, False),
        ({"pads": (*LANDS, (7.0, 6.6))}, True),
    ],
)
def test_what_hides_a_contour_costs_the_mark(tmp_path: Path, more: dict[str, Any], is_mark: bool) -> None:
    fiducials = found(round_artwork(round_board(tmp_path, **more)))
    assert ((7.0, 5.0) in names(fiducials)) == is_mark
    if "holes" in more and is_mark:
        assert fiducials.hole.max() == pytest.approx(0.4e-3)


def test_small_ones_and_those_at_the_border_are_none(tmp_path: Path) -> None:
    artwork = round_artwork(round_board(tmp_path))
    assert len(found(artwork, Imaging(pixel=0.5e-3 / (MIN_RADIUS_PX - 0.1), shift=100e-6)).radius) == 0
    inside = select_fiducials(artwork, ((3.4e-3, 3.4e-3), (16e-3, 13e-3)), MIDDLE, IMAGING)
    assert (4.0, 4.0) not in names(inside)
    assert (7.0, 5.0) in names(inside)


def test_fiducials_come_first_and_then_what_is_far_apart(tmp_path: Path) -> None:
    artwork = round_artwork(round_board(tmp_path))
    assert names(found(artwork, max_count=2)) == set(FIDUCIALS)
    four = names(found(artwork, max_count=4)) - set(FIDUCIALS)
    assert four == {(16.6, 10.0), (4.0, 4.0)}


def candidates_of(artwork: Artwork) -> FeatureCandidates:
    return find_ruler_candidates(artwork, BOARD, MIDDLE, IMAGING)


def test_a_mark_is_worth_two_rulers_across_its_middle(tmp_path: Path) -> None:
    artwork = round_artwork(round_board(tmp_path, traces=TRACES))
    rulers, fiducials = candidates_of(artwork), found(artwork)
    both = append_fiducials(rulers, fiducials, IMAGING)
    one = both
    count = len(fiducials.radius)
    as_rulers = FeatureCandidates._make(
        [
            *(
                np.concatenate([values, values[-count:]]) if name not in ("normal", "radius") else values
                for name, values in one._asdict().items()
                if name != "placement"
            ),
            rulers.placement,
        ]
    )._replace(
        normal=np.concatenate([one.normal, np.tile([0.0, 1.0], (count, 1))]), radius=np.zeros(len(one.radius) + count)
    )
    some = np.arange(0, len(rulers.radius), 7)
    mine = predict_selection(both, IMAGING, [*some, *range(len(rulers.radius), len(both.radius))])
    theirs = predict_selection(as_rulers, IMAGING, [*some, *range(len(rulers.radius), len(as_rulers.radius))])
    np.testing.assert_allclose(mine.covariance, theirs.covariance, rtol=1e-9)
    # The region contains the whole fiducial in x and y.
    alone = predict_selection(both, IMAGING, np.arange(len(rulers.radius), len(both.radius)))
    assert np.all(alone.region[0] < (fiducials.point - fiducials.radius[:, None] - 100e-6).min(axis=0))


@pytest.mark.parametrize("criterion", ["determinant", "placement"])
def test_the_greediest_choice_is_taken(tmp_path: Path, criterion: Any) -> None:
    """Each selected feature has the largest gain for its cost among all possible next features."""
    artwork = round_artwork(round_board(tmp_path, traces=TRACES))
    rulers = candidates_of(artwork)
    subset = FeatureCandidates._make([*(each[::9] for each in rulers[:-1]), rulers.placement])
    both = append_fiducials(subset, found(artwork), IMAGING)
    both = both._replace(ambiguity=np.zeros(len(both.radius)))
    costs = np.where(both.radius > 0, 6.0, 1.0)
    # A negligible prior, so that the gains follow from the predicted covariances.
    wide = Imaging(pixel=25e-6, shift=1.0, angle=3.0, etch_bias_sigma=0.0)
    chosen = select_rulers(both, wide, 30, costs=costs, criterion=criterion, per_source=99).chosen
    assert np.sum(both.radius[chosen] > 0) > 0

    def value(which: list[int]) -> float:
        covariance = predict_selection(both, wide, which).covariance
        return float(
            -np.log(np.linalg.det(covariance)) if criterion == "determinant" else -np.trace(covariance[:2, :2])
        )

    for step in range(6, len(chosen)):
        before = chosen[:step].tolist()
        gains = {n: (value([*before, n]) - value(before)) / costs[n] for n in range(len(costs)) if n not in before}
        affordable = 30 - costs[before].sum()
        best = max(gain for n, gain in gains.items() if costs[n] <= affordable)
        assert gains[int(chosen[step])] == pytest.approx(best, rel=1e-3)
