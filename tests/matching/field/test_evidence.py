"""Evidence for a pose: number of false alarms, and expected lines."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.special import rel_entr

from gpuvision.formats.field_file import read_field
from gpuvision.matching.field.distance_map import Arc, Field
from gpuvision.matching.field.evidence import (
    _detected,
    distances_to_lines,
    evidence,
    expected_crossings,
    log_nfa,
    robot_to_field,
    total_line_length,
)
from gpuvision.plots.field import field_lines

CROSS = Field(length=10.0, width=6.0, lines=((-4.0, 0.0, 4.0, 0.0), (0.0, -2.0, 0.0, 2.0)))
ROUND = Field(length=10.0, width=6.0, arcs=(Arc(0.0, 0.0, 2.0), Arc(3.0, 0.0, 1.0, 0.0, 0.5 * math.pi)))


@pytest.mark.parametrize("name", ["robocup_msl", "robocup_junior"])
def test_distances_are_those_to_dense_samples(name: str, rng: np.random.Generator) -> None:
    field = read_field(name)
    places = rng.uniform(-0.6, 0.6, (300, 2)) * (field.length, field.width)
    samples = []
    for line in field_lines(field):
        for start, end in itertools.pairwise(line):
            samples.append(start + np.linspace(0.0, 1.0, 200)[:, None] * (end - start))
    every = np.concatenate(samples)
    nearest = np.array([np.hypot(*(every - place).T).min() for place in places])
    # Samples up to 0.11 m apart, chords of arcs of 0.08 rad: errors of half a step along the line, and r (1 -
    # cos(0.04)) across it.
    np.testing.assert_allclose(distances_to_lines(field, places), nearest, atol=0.06)
    assert distances_to_lines(field, every[::50]).max() < 0.002
    grid = distances_to_lines(field, np.zeros((2, 3, 4, 2)))
    assert grid.shape == (2, 3, 4)
    assert np.ptp(grid) == 0.0
    assert distances_to_lines(field, (0.0, 0.0)).shape == ()


def test_crossings_are_where_scan_lines_meet_lines() -> None:
    paths = [(-3.0, -1.0, -3.0, 1.0), (-3.5, -1.0, -1.5, 1.0), (-1.0, 1.0, 1.0, 1.0), (2.0, 0.5, 2.0, 2.0)]
    found = expected_crossings(CROSS, (0.0, 0.0, 0.0), paths, line_width=0.1)
    np.testing.assert_allclose(found.places, [(-3.0, 0.0), (-2.5, 0.0), (0.0, 1.0)], atol=1e-12)
    np.testing.assert_allclose(found.sines, [1.0, math.sqrt(0.5), 1.0])
    # A robot at another pose has the same paths in its frame.
    pose = (0.7, -0.4, 1.1)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    seen = (np.reshape(paths, (-1, 2, 2)) - pose[:2]) @ np.array([[c, -s], [s, c]])
    turned = expected_crossings(CROSS, pose, seen.reshape(-1, 4), line_width=0.1)
    np.testing.assert_allclose(robot_to_field(turned.places, pose), found.places, atol=1e-12)


def test_crossings_that_need_not_be_found_are_left_out() -> None:
    grazing, at_the_end = (-3.0, -0.2, 3.0, 0.2), (3.95, -1.0, 3.95, 1.0)
    beside_another, ends_on_it = (-0.25, -1.5, 0.25, 1.5), (-3.0, -1.0, -3.0, 0.05)
    for path in (grazing, at_the_end, beside_another, ends_on_it):
        assert not len(expected_crossings(CROSS, (0.0, 0.0, 0.0), [path], line_width=0.1).places)


def test_circles_are_crossed_twice() -> None:
    paths = [(-3.0, 0.5, 2.9, 0.5), (3.0, -2.0, 3.0, 2.0), (3.7, -2.0, 3.7, 2.0)]
    found = expected_crossings(ROUND, (0.0, 0.0, 0.0), paths, line_width=0.05)
    far = math.sqrt(4.0 - 0.25)
    np.testing.assert_allclose(found.places, [(-far, 0.5), (far, 0.5), (3.7, math.sqrt(1 - 0.49))], atol=1e-12)
    assert not len(expected_crossings(ROUND, (0.0, 0.0, 0.0), [(-3.0, 1.9, 1.0, 1.9)], line_width=0.05).places)


def test_seen_is_what_has_a_point() -> None:
    paths = [(x, -1.0, x, 1.0) for x in (-3.5, -3.0, -2.5, -2.0)]
    crossings = expected_crossings(CROSS, (0.0, 0.0, 0.0), paths, line_width=0.1)
    points = np.array([(-3.5, 0.04), (-2.0, -0.06), (5.0, 5.0)])
    assert _detected(crossings, points, 0.05).tolist() == [True, False, False, False]
    assert _detected(crossings, crossings.places, 0.05).tolist() == [True] * 4
    no_crossings = expected_crossings(CROSS, (0.0, 0.0, 0.0), [(5.0, 1.0, 5.0, 2.0)], line_width=0.1)
    assert _detected(no_crossings, crossings.places, 0.05).tolist() == []


def test_chance_bounds_what_random_points_reach(rng: np.random.Generator) -> None:
    """The best of all poses is tested: a number of false alarms of 1/1000 occurs at most once in a thousand draws."""
    field = read_field("robocup_msl")
    # Straight ones; goal and penalty areas; the circle; corners of 79.568 degrees.
    straight, areas = 2 * 21.875 + 3 * 13.875, 2 * (2 * 0.625 + 3.775 + 2 * 2.125 + 6.775)
    arcs = 2 * math.pi * 1.9375 + 4 * 0.6875 * math.radians(79.568)
    assert total_line_length(field) == pytest.approx(straight + areas + arcs, abs=1e-4)
    reached = []
    for _ in range(1000):
        places = rng.uniform(-0.5, 0.5, (60, 2)) * (field.length, field.width)
        reached.append(log_nfa(distances_to_lines(field, places), field, scale=0.25, max_range=6.0, margin=None))
    # Expected below ln(1/100): 10 at most, and 4 sigmas of that.
    assert np.sum(np.array(reached) < math.log(0.01)) < 10 + 4 * math.sqrt(10)
    assert log_nfa([], field, scale=0.25, max_range=6.0, margin=None) == math.inf
    on_lines = log_nfa(np.zeros(60), field, scale=0.25, max_range=6.0, margin=1.0)
    # All 60 points lie within 15 mm; the number of poses reduces the evidence.
    assert on_lines == pytest.approx(60 * math.log(2 * 0.015 * total_line_length(field) / 308), rel=0.15)


def test_missing_is_what_is_not_seen_beside_what_is_explained() -> None:
    turns = np.linspace(0.0, 2.0 * math.pi, 64, endpoint=False)
    directions = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    pose = (1.0, 1.0, 0.5)
    paths = np.hstack([0.0 * directions, 3.0 * directions])
    places = expected_crossings(CROSS, pose, paths, line_width=0.1).places
    settings = {"half_line_width": 0.05, "scale": 0.2, "max_range": 3.0, "margin": 0.5}
    complete = evidence(places, paths, CROSS, pose, **settings)
    assert (complete.expected, complete.on_lines, complete.seen) == (len(places), 1.0, 1.0)
    assert complete.missing == 0.0
    half = evidence(places[::2], paths, CROSS, pose, **settings)
    assert half.missing == pytest.approx(0.5, abs=0.1)
    elsewhere = np.concatenate([places[::2], places[::2] + 0.3])
    assert evidence(elsewhere, paths, CROSS, pose, **settings).missing > 0.8
    unknown = evidence(places[::2], None, CROSS, pose, **settings)
    assert (unknown.expected, unknown.missing) == (0, 0.0)


def test_line_that_is_seen_least() -> None:
    """Six paths across one line and six across the other one: half of one line is seen, and nothing of the other."""
    upright = [(x, -1.0, x, 1.0) for x in (-3.5, -3.0, -2.5, 2.5, 3.0, 3.5)]
    level = [(-1.0, y, 1.0, y) for y in (-1.6, -1.2, -0.8, 0.8, 1.2, 1.6)]
    crossings = expected_crossings(CROSS, (0.0, 0.0, 0.0), [*upright, *level], line_width=0.05)
    assert crossings.lines.tolist() == [0] * 6 + [1] * 6
    settings = {"half_line_width": 0.025, "scale": 0.2, "max_range": 3.0, "margin": 0.5}
    thinned = np.concatenate([crossings.places[:6:2], crossings.places[6:]])
    density = len(thinned) / 24.0
    by_chance = 1.0 - math.exp(-density * 0.05)
    found = evidence(thinned, [*upright, *level], CROSS, (0.0, 0.0, 0.0), **settings)
    assert found.least_seen == pytest.approx((0.5 - by_chance) / (1.0 - by_chance))
    gone = evidence(crossings.places[6:], [*upright, *level], CROSS, (0.0, 0.0, 0.0), **settings)
    assert gone.least_seen < 0.0 < gone.seen
    few = evidence(thinned, [*upright[:5], *level[:5]], CROSS, (0.0, 0.0, 0.0), **settings)
    assert math.isnan(few.least_seen)
    rounds = expected_crossings(ROUND, (0.0, 0.0, 0.0), [(-3.0, 0.5, 2.9, 0.5), (3.7, -2.0, 3.7, 2.0)], line_width=0.05)
    assert rounds.lines.tolist() == [0, 0, 1]


@pytest.mark.parametrize("margin", [None, 1.0])
@pytest.mark.parametrize("near", [0, 1, 4, 17, 50])
def test_false_alarms_in_closed_form(near: int, margin: float | None) -> None:
    """Only more points near lines than chance are evidence: with fewer, the number of tests is all that is left."""
    distances = np.array([-0.003] * near + [3.0] * (50 - near))
    expected = []
    for t in (0.012, 0.024, 0.05, 0.1, 0.2):
        # 12 m of lines on 10 m x 6 m; poses on 0.4 m x 0.4 m and 0.4 rad, or on 12 m x 8 m and all round at 3 m.
        chance, share = 2 * t * 12 / 60, near / 50
        tests = (
            5 * max((0.16 if margin is None else 96) / t**2, 1) * max((0.4 if margin is None else 6 * math.pi) / t, 1)
        )
        information = rel_entr(share, chance) + rel_entr(1 - share, 1 - chance) if share > chance else 0.0
        expected.append(math.log(tests) - 50 * information)
    found = log_nfa(distances, CROSS, scale=0.2, max_range=3.0, margin=margin)
    assert found == pytest.approx(min(expected), rel=1e-12)


def test_seen_is_corrected_for_points_that_meet_crossings_by_chance() -> None:
    upright = [(x, -1.0, x, 1.0) for x in (-3.5, -3.0, -2.5, -2.0, -1.5)]
    paths = [*upright, (2.0, -1.0, 4.0, 1.0)]
    on_lines = [(-3.5, 0.03), (-3.0, -0.03), (-2.0, 0.0), (3.0, 0.0)]
    points = np.array([*on_lines, (-3.5, 0.7), (-1.5, 0.5), (-1.5, -0.4)])
    found = evidence(points, paths, CROSS, (0.0, 0.0, 0.0), half_line_width=0.05, scale=0.2, max_range=3.0, margin=0.5)
    assert (found.expected, found.on_lines) == (6, pytest.approx(4 / 7))
    # 7 points on 10 m and 2.83 m of scan lines; a crossing is 0.1 m long, 0.141 m on the oblique one.
    density, window = 7 / (10 + 2 * math.sqrt(2)), 0.1 * (5 + math.sqrt(2)) / 6
    by_chance = 1 - math.exp(-density * window)
    assert found.seen == pytest.approx((4 / 6 - by_chance) / (1 - by_chance), rel=1e-12)


def crossings_of(field: Field, pose: tuple[float, float, float], path: np.ndarray, width: float) -> list[np.ndarray]:
    """Return the expected crossings of one scan line in the robot's frame, by definition, with complex numbers."""
    turn, origin = complex(math.cos(pose[2]), math.sin(pose[2])), complex(pose[0], pose[1])
    start, end = (origin + turn * complex(*each) for each in (path[:2], path[2:]))
    length, way = abs(end - start), (end - start) / abs(end - start)
    found: list[tuple[float, float, bool]] = []  # distance, sine, away from the ends of the line
    for x0, y0, x1, y1 in field.lines:
        # In the frame of the scan line.
        a, b = ((complex(*each) - start) / way for each in ((x0, y0), (x1, y1)))
        size, sine = abs(b - a), abs((b - a).imag) / abs(b - a)
        if sine <= 0.02:
            continue
        share = a.imag / (a.imag - b.imag)
        if -width < share * size < size + width:
            clear = width < share * size < size - width
            found.append(((a + share * (b - a)).real, sine, clear))
    for arc in field.arcs:
        centre = (complex(arc.x, arc.y) - start) / way
        if abs(centre.imag) >= arc.radius:
            continue
        half = math.sqrt(arc.radius**2 - centre.imag**2)
        for away in (centre.real - half, centre.real + half):
            place = start + away * way
            along = (np.angle(place - complex(arc.x, arc.y)) - arc.start) % (2.0 * math.pi) * arc.radius
            whole = arc.radius * (arc.end - arc.start)
            if along <= whole:
                is_circle = arc.end - arc.start > 2.0 * math.pi - 1e-9
                found.append((away, half / arc.radius, is_circle or width < along < whole - width))
    kept = []
    for number, (away, sine, clear) in enumerate(found):
        alone = all(abs(away - other[0]) > 3.0 * width for k, other in enumerate(found) if k != number)
        if alone and clear and sine >= 0.5 and width < away < length - width:
            kept.append(path[:2] + away / length * (path[2:] - path[:2]))
    return kept


def test_expected_crossings_are_those_of_the_definition(rng: np.random.Generator) -> None:
    """Random scan lines over lines at all angles and arcs, one of which is a circle that does not begin at 0."""
    lines = [tuple(each) for each in rng.uniform(-4.0, 4.0, (5, 4))]
    arcs = (Arc(0.5, -1.0, 1.5, 0.7, 0.7 + 2.0 * math.pi), Arc(-2.0, 1.0, 1.2, -2.5, 1.0), Arc(2.0, 2.0, 0.8, 1.0, 5.0))
    field, pose, width = Field(length=8.0, width=8.0, lines=tuple(lines), arcs=arcs), (0.4, -0.3, 2.1), 0.12
    paths = rng.uniform(-5.0, 5.0, (300, 4))
    expected = [place for path in paths for place in crossings_of(field, pose, path, width)]
    found = expected_crossings(field, pose, paths, line_width=width)
    assert len(expected) > 150
    np.testing.assert_allclose(sorted(found.places.tolist()), sorted(np.array(expected).tolist()), atol=1e-9)
    # The crossings of a line or an arc lie on it, and have the sine of the angle to it.
    alone = [Field(length=8.0, width=8.0, lines=(each,)) for each in lines]
    alone += [Field(length=8.0, width=8.0, arcs=(each,)) for each in arcs]
    for number, each in enumerate(alone):
        places = robot_to_field(found.places[found.lines == number], pose)
        np.testing.assert_allclose(distances_to_lines(each, places), 0.0, atol=1e-9)
    assert len(np.unique(found.lines)) > 5


@pytest.mark.parametrize(
    ("away", "is_expected"),
    [(0.3, False), (0.301, True), (-0.3, False), (-0.301, True)],
)
def test_crossings_within_three_widths_of_another_are_left_out(away: float, is_expected: bool) -> None:
    field = Field(length=10.0, width=6.0, lines=((-4.0, 0.0, 4.0, 0.0), (-4.0, away, 4.0, away)))
    found = expected_crossings(field, (0.0, 0.0, 0.0), [(1.0, -2.0, 1.0, 2.0)], line_width=0.1)
    assert len(found.places) == 2 * is_expected


def test_crossings_at_30_degrees_or_more_are_expected() -> None:
    for degrees, is_expected in ((29.9, False), (30.1, True), (149.9, True), (150.1, False)):
        angle = math.radians(degrees)
        end = np.array([math.cos(angle), math.sin(angle)])
        found = expected_crossings(CROSS, (2.0, 0.0, 0.0), [(*-end, *end)], line_width=0.1)
        assert len(found.places) == is_expected
        if is_expected:
            assert found.sines == pytest.approx([math.sin(angle)])


def test_share_of_crossings_without_points_by_chance_is_at_most_one() -> None:
    """So many points that each crossing meets one by chance: what is seen is not divided by nothing."""
    paths = [(x, -1.0, x, 1.0) for x in (-3.5, -3.0, -2.5)]
    points = np.column_stack([np.full(3000, -3.0), np.linspace(-1.0, 1.0, 3000)])
    found = evidence(points, paths, CROSS, (0.0, 0.0, 0.0), half_line_width=0.05, scale=0.2, max_range=3.0, margin=0.5)
    assert found.expected == 3
    # One of three is seen; by chance all would be.
    by_chance = 1.0 - math.exp(-3000 / 6.0 * 0.1)
    assert found.seen == pytest.approx((1.0 / 3.0 - by_chance) / 1e-3)
    assert found.missing == pytest.approx((1.0 - found.seen) / found.on_lines)
    none = evidence(
        points, np.zeros((0, 4)), CROSS, (0.0, 0.0, 0.0), half_line_width=0.05, scale=0.2, max_range=3.0, margin=None
    )
    assert (none.expected, none.missing) == (0, 0.0)
