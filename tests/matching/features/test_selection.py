"""Selection of rulers: predicted deviations agree with least squares, and other selections are not better."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gpuvision.matching.artwork.artwork import Artwork, Holes, read_artwork
from gpuvision.matching.artwork.shapes import Shape
from gpuvision.matching.features.candidates import FeatureCandidates, find_ruler_candidates
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.selection import Selection, predict_selection, select_rulers, two_row_update

IMAGING = Imaging(pixel=20e-6)
REGION = ((-1e-3, -1e-3), (21e-3, 21e-3))
MIDDLE = (10e-3, 10e-3)
Trace = tuple[float, float, float, float]
CROSS: tuple[Trace, ...] = ((2, 10, 9, 10), (11, 10, 18, 10), (10, 2, 10, 9), (10, 11, 10, 18), (2, 2, 6, 6))


def board(folder: Path, *traces: Trace, flashes: tuple[tuple[float, float], ...] = ()) -> Artwork:
    """Traces 0.3 mm wide, and square pads of 1 mm."""
    lines = ["%FSLAX46Y46*%", "%MOMM*%", "%LPD*%", "%ADD10C,0.3*%", "%ADD11R,1.0X1.0*%", "G01*", "D10*"]
    for x, y, to_x, to_y in traces:
        lines += [f"X{round(x * 1e6)}Y{round(y * 1e6)}D02*", f"X{round(to_x * 1e6)}Y{round(to_y * 1e6)}D01*"]
    lines.append("D11*")
    lines += [f"X{round(x * 1e6)}Y{round(y * 1e6)}D03*" for x, y in flashes]
    (folder / "copper.gbr").write_text("\n".join([*lines, "M02*", ""]))
    return read_artwork(folder, layers={r"copper\.gbr": "top copper"})


def rulers_of(artwork: Artwork, imaging: Imaging = IMAGING) -> FeatureCandidates:
    return find_ruler_candidates(artwork, REGION, MIDDLE, imaging)


def seen_offsets(rulers: FeatureCandidates, shift: np.ndarray, angle: float) -> np.ndarray:
    """Return the edge offset on each ruler for a board that is rotated about the placement point and shifted."""
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])
    point = rulers.placement + (rulers.point - rulers.placement) @ turn.T + shift
    normal = rulers.normal @ turn.T
    return np.sum(normal * (point - rulers.point), axis=1) / np.sum(normal * rulers.normal, axis=1)


def covariance_of(rulers: FeatureCandidates, chosen: np.ndarray, imaging: Imaging) -> np.ndarray:
    """Return the covariance of generalised least squares; the etch bias is noise common to all edges."""
    step = 1e-7
    columns = [
        (seen_offsets(rulers, step * np.array(shift), step * angle) - seen_offsets(rulers, np.zeros(2), 0)) / step
        for shift, angle in (((1, 0), 0), ((0, 1), 0), ((0, 0), 1))
    ]
    rows = np.stack(columns, axis=1)[chosen]
    shared = imaging.etch_bias_sigma * (~rulers.pair[chosen])
    noise = np.diag(rulers.sigma[chosen] ** 2) + np.outer(shared, shared)
    return np.linalg.inv(rows.T @ np.linalg.inv(noise) @ rows)


@pytest.mark.parametrize("criterion", ["determinant", "placement"])
def test_promises_what_least_squares_deliver(tmp_path: Path, criterion: str) -> None:
    rulers = rulers_of(board(tmp_path, *CROSS, flashes=((5, 15), (15, 5))))
    for which in (rulers.pair, ~rulers.pair):
        some = only(rulers, which)
        found = select_rulers(some, IMAGING, 12, criterion=criterion)
        expected = covariance_of(some, found.chosen, IMAGING)
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert found.covariance / scale == pytest.approx(expected / scale, abs=1e-4)
        assert found.sigmas == pytest.approx(np.sqrt(np.diag(expected)), rel=1e-4)
        assert len(found.chosen) == len(set(found.chosen.tolist())) == 12


def only(rulers: FeatureCandidates, which: np.ndarray) -> FeatureCandidates:
    return FeatureCandidates(*(each[which] for each in rulers[:-1]), rulers.placement)


@pytest.mark.slow
def test_measured_poses_scatter_as_promised(tmp_path: Path, rng: np.random.Generator) -> None:
    rulers = rulers_of(board(tmp_path, *CROSS, flashes=((5, 15), (15, 5))))
    found = select_rulers(rulers, IMAGING, 20)
    rows = np.concatenate([rulers.normal, lever(rulers)[:, None]], axis=1)[found.chosen]
    shared = IMAGING.etch_bias_sigma * (~rulers.pair[found.chosen])
    noise = np.linalg.inv(np.diag(rulers.sigma[found.chosen] ** 2) + np.outer(shared, shared))
    solve = np.linalg.inv(rows.T @ noise @ rows) @ rows.T @ noise
    errors = []
    for _ in range(1000):
        shift, angle = rng.uniform(-50e-6, 50e-6, 2), rng.uniform(-1e-4, 1e-4)
        measured = seen_offsets(rulers, shift, angle)[found.chosen]
        measured += rng.normal(0, rulers.sigma[found.chosen]) + shared * rng.normal()
        errors.append(solve @ measured - (*shift, angle))
    # 1000 draws: a standard deviation is known to 1 / sqrt(2000) = 2.2 %; four of these.
    assert np.std(errors, axis=0) == pytest.approx(found.sigmas, rel=0.09)


def lever(rulers: FeatureCandidates) -> np.ndarray:
    away = rulers.point - rulers.placement
    return np.asarray(away[:, 0] * rulers.normal[:, 1] - away[:, 1] * rulers.normal[:, 0])


def test_comes_near_to_the_best_of_all_sets(tmp_path: Path, rng: np.random.Generator) -> None:
    imaging = replace(IMAGING, etch_bias_sigma=0.0)
    all_rulers = rulers_of(board(tmp_path, *CROSS), imaging)
    which = rng.choice(len(all_rulers.sigma), 14, replace=False)
    rulers = only(all_rulers, which)
    rows = np.concatenate([rulers.normal, lever(rulers)[:, None]], axis=1)
    prior = np.diag([3 / imaging.shift**2, 3 / imaging.shift**2, 3 / imaging.angle**2])
    weight = (1 - rulers.ambiguity) / rulers.sigma**2

    def gain(chosen: tuple[int, ...]) -> float:
        some = rows[list(chosen)]
        information = prior + (some * weight[list(chosen), None]).T @ some
        return float(np.linalg.slogdet(information)[1] - np.linalg.slogdet(prior)[1])

    found = select_rulers(rulers, imaging, 4, per_source=14)
    best = max(gain(each) for each in itertools.combinations(range(14), 4))
    assert best >= gain(tuple(found.chosen)) >= (1 - 1 / math.e) * best


def test_beats_what_is_picked_at_random(tmp_path: Path, rng: np.random.Generator) -> None:
    rulers = rulers_of(board(tmp_path, *CROSS, flashes=((5, 15), (15, 5))))
    found = select_rulers(rulers, IMAGING, 12)
    placed = select_rulers(rulers, IMAGING, 12, criterion="placement")
    sets = [rng.choice(len(rulers.sigma), 12, replace=False) for _ in range(200)]
    others = [covariance_of(rulers, each, IMAGING) for each in sets]
    assert np.linalg.det(found.covariance) < min(np.linalg.det(each) for each in others)
    assert np.trace(placed.covariance[:2, :2]) < min(np.trace(each[:2, :2]) for each in others)
    assert np.trace(placed.covariance[:2, :2]) <= np.trace(found.covariance[:2, :2])


@pytest.mark.parametrize(
    ("traces", "budget", "message"),
    [
        (((2, 10, 18, 10), (2, 5, 18, 5), (2, 15, 18, 15)), 20, "do not determine"),
        (((2, 2, 9, 9), (11, 11, 18, 18)), 20, "do not determine"),
        (CROSS, 2, "2 rulers do not determine"),
        (((1, 1, 1.2, 1.2),), 20, "0 rulers do not determine"),
    ],
)
def test_refuses_what_fixes_no_pose(tmp_path: Path, traces: tuple[Trace, ...], budget: float, message: str) -> None:
    rulers = rulers_of(board(tmp_path, *traces))
    with pytest.raises(ValueError, match=message):
        select_rulers(rulers, IMAGING, budget, per_source=100)


def test_etching_spoils_edges_that_face_one_way_and_no_others(tmp_path: Path) -> None:
    artwork = board(tmp_path, flashes=((2, 5), (18, 5), (5, 2), (5, 18)))
    sure, unsure = replace(IMAGING, etch_bias_sigma=1e-9), replace(IMAGING, etch_bias_sigma=30e-6)
    rulers = rulers_of(artwork)
    one_way = only(rulers, (rulers.normal @ (1, 1) > 0.9) & ~rulers.pair)
    assert select_rulers(one_way, sure, 16).sigmas[:2].max() < 1e-6
    assert select_rulers(one_way, unsure, 16).sigmas[:2].min() > 20e-6
    assert select_rulers(rulers, unsure, 16).sigmas[:2].max() < 1e-6
    traces = rulers_of(board(tmp_path, *CROSS), unsure)
    pairs = only(traces, traces.pair)
    assert select_rulers(pairs, unsure, 16).covariance == pytest.approx(
        select_rulers(pairs, sure, 16).covariance, rel=1e-6
    )


def test_repeated_edges_on_a_ruler_are_ambiguous(tmp_path: Path, rng: np.random.Generator) -> None:
    comb = tuple((2.0, y, 8.0, y) for y in (10.0, 10.7, 11.4))
    separate = tuple((12.0, y, 18.0, y) for y in (10.0, 13.0))
    imaging = replace(IMAGING, shift=400e-6, angle=0.0)
    rulers = rulers_of(board(tmp_path, *comb, *separate, (10, 2, 10, 8)), imaging)
    # Edges are found on a ruler, except within the extent of the smoothing filter at both ends.
    found = np.max(rulers.length[~rulers.pair]) / 2 - 3 * math.sqrt(5.0) * imaging.pixel
    up = (rulers.normal[:, 1] > 0.9) & (rulers.point[:, 0] < 9e-3)
    shifts = rng.uniform(-400e-6, 400e-6, 20000)
    for y, others in ((10.15e-3, (0.7e-3,)), (10.85e-3, (-0.7e-3, 0.7e-3))):
        on_trace = up & ~rulers.pair & np.isclose(rulers.point[:, 1], y, rtol=0, atol=1e-6)
        seen = np.sum([np.mean(np.abs(shifts + other) < found) for other in others])
        assert on_trace.any()
        assert 0.05 < seen < 0.95
        assert rulers.ambiguity[on_trace] == pytest.approx(seen, abs=0.015)
    assert not rulers.ambiguity[rulers.point[:, 0] > 9e-3].any()
    chosen = select_rulers(rulers, imaging, 8).chosen
    assert not rulers.ambiguity[chosen].any()


def test_ink_and_holes_are_ambiguous_too_and_may_lie_off(tmp_path: Path) -> None:
    """A trace 0.3 mm wide along y = 10 mm, silk above it, and a hole below it."""
    artwork = board(tmp_path, (2, 10, 18, 10), (1, 2, 1, 18))
    ink = Shape(np.array([[12.0, 10.6], [16.0, 10.6], [16.0, 10.65], [12.0, 10.65]]) * 1e-3)
    hole = np.array([[6.0, 10.8]]) * 1e-3
    holes = Holes(hole, hole + np.array([2e-3, 0.0]), np.array([0.4e-3]), np.array([0], dtype=np.int8))
    artwork = replace(artwork, silk=(ink,), holes=holes)
    far, near = (rulers_of(artwork, replace(IMAGING, registration=each)) for each in (0.0, 0.3e-3))

    def upper(rulers: FeatureCandidates, low: float, high: float) -> np.ndarray:
        x, y = rulers.point.T * 1e3
        return rulers.ambiguity[(x > low) & (x < high) & np.isclose(y, 10.15) & ~rulers.pair]

    # Search range of a ruler: 0.1 mm of shift, a rotation by 5 mrad at up to 8 mm, and 0.06 mm. The board moves by the
    # shift and the rotation only. The ink ends 0.5 mm from the edge, the hole begins 0.45 mm from it.
    assert upper(far, 12.2, 15.8).max() == 0.0 == upper(far, 6.2, 7.8).max()
    assert upper(near, 12.2, 15.8).min() > 0.1
    assert upper(near, 6.2, 7.8).min() > 0.1
    assert upper(near, 9.0, 11.0).max() == 0.0


def test_edges_that_pull_at_each_other_are_left_out(tmp_path: Path) -> None:
    artwork = board(tmp_path, (2, 10, 18, 10), (2, 10.5, 18, 10.5))
    # 0.3 mm wide and 0.2 mm apart; 3 sqrt(5) blurs are 0.134 mm at 20 um, 0.268 mm at 40 um and 0.335 mm at 50 um.
    fine, coarse, coarsest = (rulers_of(artwork, replace(IMAGING, pixel=each)) for each in (20e-6, 40e-6, 50e-6))
    assert sorted(set(np.round(fine.point[:, 1] * 1e3, 6))) == pytest.approx([9.85, 10, 10.15, 10.35, 10.5, 10.65])
    assert sorted(set(np.round(coarse.point[:, 1] * 1e3, 6))) == pytest.approx([9.85, 10.65])
    assert len(coarsest.sigma) == 0


def test_rulers_stay_on_their_edges_and_in_the_region_to_read(tmp_path: Path, rng: np.random.Generator) -> None:
    artwork = board(tmp_path, *CROSS, flashes=((5, 15), (15, 5)))
    rulers = rulers_of(artwork)
    found = select_rulers(rulers, IMAGING, 20)
    low, high = found.region
    half_width = IMAGING.width_px * IMAGING.pixel / 2
    edges = artwork.edges
    for index in found.chosen:
        point, normal = rulers.point[index], rulers.normal[index]
        ends = point + np.array([[-0.5], [0.5]]) * rulers.length[index] * normal
        assert ((ends >= low - 1e-12) & (ends <= high + 1e-12)).all()
        # The edge crosses the ruler between its ends for every shift and rotation.
        offsets = [
            seen_offsets(rulers, rng.choice([-1, 1], 2) * IMAGING.shift, sign * IMAGING.angle)[index]
            for sign in (-1, 1)
        ]
        assert np.abs(offsets).max() < rulers.length[index] / 2
        if not rulers.pair[index]:
            axis = np.array([-normal[1], normal[0]])
            on = (edges.normal @ normal > 0.999) & (np.abs(np.sum((edges.start - point) * normal, axis=1)) < 1e-9)
            spans = np.sort(np.stack([(edges.start[on] - point) @ axis, (edges.end[on] - point) @ axis]), axis=0)
            room = half_width + IMAGING.shift - 1e-9
            assert np.any((spans[0] <= -room) & (spans[1] >= room))


def test_keeps_to_its_budget_and_to_few_rulers_on_each_side(tmp_path: Path) -> None:
    rulers = rulers_of(board(tmp_path, *CROSS, flashes=((5, 15), (15, 5))))
    costs = rulers.pixels(IMAGING)
    found = select_rulers(rulers, IMAGING, 3000, costs=costs)
    assert found.cost == costs[found.chosen].sum() <= 3000
    left = np.setdiff1d(np.arange(len(costs)), found.chosen)
    full = [source for source in set(rulers.source) if np.sum(rulers.source[found.chosen] == source) == 4]
    assert (costs[left][~np.isin(rulers.source[left], full)] > 3000 - found.cost).all()
    counts = [np.sum(rulers.source[found.chosen] == each) for each in set(rulers.source)]
    assert max(counts) <= 4
    # The board is symmetric about its diagonal: x and y may be exchanged.
    assert np.sort(select_rulers(rulers, IMAGING, 12, missing=0.19).sigmas) == pytest.approx(
        np.sort(select_rulers(rulers, IMAGING, 12).sigmas) / 0.9, rel=0.01
    )


def test_the_sigma_is_1_2_times_the_bound() -> None:
    bound = 1.883 * math.sqrt(2.0) / (40 * math.sqrt(16)) * 10e-6
    imaging = Imaging(pixel=10e-6, blur_px=2.0, width_px=16)
    assert imaging.sigma(True) == pytest.approx(1.2 * bound, rel=5e-3)
    assert imaging.sigma([True, False]) == pytest.approx(1.2 * bound * np.array([1, 40 / 15]), rel=5e-3)


@pytest.mark.parametrize(
    "changed", [{"pixel": 0.0}, {"blur_px": -1.0}, {"shift": math.nan}, {"etch_bias_sigma": -1.0}, {"angle": math.inf}]
)
def test_refuses_a_camera_that_is_none(changed: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        replace(IMAGING, **changed)


def test_refuses_what_makes_no_sense(tmp_path: Path) -> None:
    artwork = board(tmp_path, *CROSS)
    rulers = rulers_of(artwork)
    with pytest.raises(ValueError, match="region must be"):
        find_ruler_candidates(artwork, ((0, 0), (0, 1)), MIDDLE, IMAGING)
    with pytest.raises(ValueError, match="placement must be"):
        find_ruler_candidates(artwork, REGION, (0, math.nan), IMAGING)
    with pytest.raises(ValueError, match="costs must be"):
        select_rulers(rulers, IMAGING, 5, costs=[1.0])
    with pytest.raises(ValueError, match="missing must be"):
        select_rulers(rulers, IMAGING, 5, missing=1.0)
    with pytest.raises(ValueError, match="criterion must be"):
        select_rulers(rulers, IMAGING, 5, criterion="trace")


@pytest.mark.realdata
@pytest.mark.parametrize(
    "name",
    [
        "upverter",
        pytest.param("fritzing", marks=pytest.mark.slow),  # gerbonara takes seconds for each of these
        pytest.param("kicad-x2-tests/x2ap", marks=pytest.mark.slow),
    ],
)
def test_finds_rulers_on_the_boards_of_three_tools(data: Path, name: str, rng: np.random.Generator) -> None:
    artwork = read_artwork(data / "gerber" / name)
    middle = artwork.bounds.mean(axis=0)
    rulers = find_ruler_candidates(artwork, (middle - 8e-3, middle + 8e-3), middle, IMAGING)
    found: Selection = select_rulers(rulers, IMAGING, 30)
    others = [
        np.sqrt(np.diag(covariance_of(rulers, rng.choice(len(rulers.sigma), 30, replace=False), IMAGING)))
        for _ in range(50)
    ]
    assert (found.sigmas < np.median(others, axis=0)).all()
    assert found.sigmas[:2].max() < 2e-6
    assert found.condition < 100


def test_error_of_an_edge_in_closed_form() -> None:
    """The bound of a Gaussian edge in white noise is 1.883 sqrt(blur) / (contrast sqrt(width)) [px].

    Smoothing by sqrt(5) blurs is the best one: it costs a factor of 1.2 (6^3 / 5^2.5 times 3/8 is 1.449, its root 1.2).
    """
    imaging = Imaging(pixel=20e-6, blur_px=1.5, width_px=4, contrast_bare=50.0, contrast_masked=25.0)
    bound = 1.88279 * np.sqrt(1.5) / (50.0 * 2.0)
    best = np.sqrt(3.0 / 8.0 * 6.0**3 / 5.0**2.5)
    assert imaging.sigma(True) == pytest.approx(best * bound * 20e-6, rel=1e-5)
    assert imaging.sigma(False) == pytest.approx(2.0 * best * bound * 20e-6, rel=1e-5)
    assert imaging.smoothing_px == pytest.approx(np.sqrt(5.0) * 1.5)
    assert imaging.room_px == pytest.approx(3.0 * imaging.smoothing_px)
    assert imaging.max_blur_px == pytest.approx(1.5)
    # Motion by sqrt(12) times 2 px along x adds a standard deviation of 2 px to the blur of edges across x only.
    moving = replace(imaging, motion_px=(2.0 * np.sqrt(12.0), 0.0))
    assert moving.max_blur_px == pytest.approx(2.5)
    blur, smoothing = 2.5, np.sqrt(5.0) * 1.5
    worse = np.sqrt(3.0 / 8.0 * (smoothing**2 + blur**2) ** 3 / (smoothing**5 * blur))
    assert moving.sigma(True, (1.0, 0.0)) == pytest.approx(worse * bound * np.sqrt(2.5 / 1.5) * 20e-6, rel=1e-5)
    assert moving.sigma(True, (0.0, 1.0)) == pytest.approx(float(imaging.sigma(True)), rel=1e-12)


def candidates_by_hand(ambiguity: float = 0.0) -> FeatureCandidates:
    """Return two rulers at right angles, one across a trace, one oblique, and a fiducial, at places on no axis."""
    return FeatureCandidates(
        point=np.array([[1e-3, 2e-3], [-2e-3, 1e-3], [0.5e-3, -3e-3], [2e-3, -1e-3], [-1e-3, -1e-3]]),
        normal=np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.6, -0.8], [1.0, 0.0]]),
        sigma=np.array([1.0, 2.0, 1.5, 0.8, 0.5]) * 1e-6,
        pair=np.array([False, False, True, False, True]),
        length=np.array([1.0, 1.2, 1.4, 1.6, 0.9]) * 1e-3,
        ambiguity=np.array([0.0, ambiguity, 0.0, 0.0, 0.0]),
        source=np.array([0, 1, 2, 3, -1000000]),
        spacing=np.array([0.0, 0.0, 1e-4, 0.0, 0.0]),
        radius=np.array([0.0, 0.0, 0.0, 0.0, 2e-4]),
        placement=np.array([0.25e-3, -0.5e-3]),
    )


@pytest.mark.parametrize("missing", [0.0, 0.3])
@pytest.mark.parametrize("ambiguity", [0.0, 0.25])
def test_prediction_is_that_of_the_information_of_each_coordinate(missing: float, ambiguity: float) -> None:
    """A missing or ambiguous feature has less information; the etch bias is one unknown with a prior."""
    rulers, imaging = candidates_by_hand(ambiguity), replace(IMAGING, etch_bias_sigma=3e-6, width_px=6)
    found = predict_selection(rulers, imaging, [0, 1, 2, 3, 4], costs=[1.0, 2.0, 3.0, 4.0, 5.5], missing=missing)
    information = np.diag([0.0, 0.0, 0.0, 1.0 / 3e-6**2])
    for k in range(5):
        x, y = rulers.point[k] - rulers.placement
        weight = (1.0 - missing) * (1.0 - rulers.ambiguity[k]) / rulers.sigma[k] ** 2
        ways = [rulers.normal[k]] if rulers.radius[k] == 0.0 else [np.array([1.0, 0.0]), np.array([0.0, 1.0])]
        for nx, ny in ways:
            row = np.array([nx, ny, x * ny - y * nx, 0.0 if rulers.pair[k] else 1.0])
            information += weight * np.outer(row, row)
    expected = np.linalg.inv(information)[:3, :3]
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found.covariance / scale, expected / scale, atol=1e-9)
    assert found.cost == 15.5
    # Turns at the mean distance of the points count as shifts.
    distance = np.hypot(*(rulers.point - rulers.placement).T).mean()
    unit = np.array([1.0, 1.0, 1.0 / distance])
    values = np.linalg.eigvalsh(np.linalg.inv(expected) * unit * unit[:, None])
    assert found.condition == pytest.approx(math.sqrt(values[2] / values[0]))
    # Rulers of 6 px of 20 um, 0.12 mm wide; the fiducial's window of 0.9 mm.
    half = 0.5e-3 * np.array([[1.0, 0.12], [0.12, 1.2], [1.4, 0.12], [0.96 + 0.096, 1.28 + 0.072], [0.9, 0.9]])
    np.testing.assert_allclose(found.region, [(rulers.point - half).min(axis=0), (rulers.point + half).max(axis=0)])


@pytest.mark.parametrize(("chosen", "count"), [([0, 1], 2), ([4], 1), ([], 0)])
def test_too_few_coordinates_are_refused(chosen: list[int], count: int) -> None:
    with pytest.raises(ValueError, match=f"^{count} rulers do not determine x, y and theta: give a larger budget"):
        predict_selection(candidates_by_hand(), IMAGING, chosen)
    predict_selection(candidates_by_hand(), replace(IMAGING, etch_bias_sigma=0.0), [0, 4])


def test_a_budget_may_be_used_up_exactly() -> None:
    rulers = candidates_by_hand()
    found = select_rulers(rulers, IMAGING, 5.0)
    assert (sorted(found.chosen.tolist()), found.cost) == ([0, 1, 2, 3, 4], 5.0)
    assert len(select_rulers(rulers, IMAGING, 4.999).chosen) == 4
    costs = np.array([1.0, 1.0, 1.0, 3.0, 2.0])
    assert select_rulers(rulers, IMAGING, 8.0, costs=costs).cost == 8.0
    assert select_rulers(rulers, IMAGING, 7.999, costs=costs).cost < 8.0


def test_rulers_of_one_source_are_limited() -> None:
    rulers = candidates_by_hand()._replace(source=np.array([7, 7, 7, 7, 3]))
    for most in (1, 2, 3):
        # The fiducial has two coordinates, so that one ruler suffices with it.
        found = select_rulers(rulers, IMAGING, 10.0, per_source=most)
        assert len(found.chosen) == most + 1
        assert 4 in found.chosen
    assert len(select_rulers(rulers, IMAGING, 10.0).chosen) == 5
    with pytest.raises(ValueError, match="per_source must be 1 or more, not 0"):
        select_rulers(rulers, IMAGING, 10.0, per_source=0)
    for wrong in ([1.0, 1.0, 0.0, 1.0, 1.0], [1.0] * 4):
        with pytest.raises(ValueError, match="costs must be 5 positive numbers, one for each candidate"):
            select_rulers(rulers, IMAGING, 10.0, costs=wrong)
    for wrong_share in (-0.01, 1.0):
        with pytest.raises(ValueError, match=r"missing must be in \[0, 1\)"):
            select_rulers(rulers, IMAGING, 10.0, missing=wrong_share)


def test_two_coordinates_shrink_a_covariance_by_their_determinant(rng: np.random.Generator) -> None:
    rows, second = rng.normal(size=(2, 6, 4))
    second[3:] = 0.0
    weight = rng.uniform(0.5, 2.0, 6)
    factor = rng.normal(size=(4, 4))
    covariance = factor @ factor.T
    found = two_row_update(rows, second, weight, covariance)
    for k in range(6):
        both = np.stack([rows[k], second[k]])
        expected = np.eye(2) + weight[k] * both @ covariance @ both.T
        np.testing.assert_allclose(
            [[found.one[k], found.mixed[k]], [found.mixed[k], found.two[k]]], expected, atol=1e-12
        )
        assert found.determinant[k] == pytest.approx(np.linalg.det(expected))
        np.testing.assert_allclose(found.first[k], rows[k] @ covariance)
        np.testing.assert_allclose(found.second[k], second[k] @ covariance)
