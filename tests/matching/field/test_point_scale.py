"""Scale of a robot's points: recovered from points of known scale, with its standard deviation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from conftest import Draws
from gpuvision.matching.field import point_scale as module
from gpuvision.matching.field.distance_map import Arc, Field
from gpuvision.matching.field.point_scale import point_scale

RECTANGLE = ((-3.0, -2.0, 3.0, -2.0), (-3.0, 2.0, 3.0, 2.0), (-3.0, -2.0, -3.0, 2.0), (3.0, -2.0, 3.0, 2.0))
POSE = (0.5, -0.3, 0.4)


def in_robot_frame(places: np.ndarray) -> np.ndarray:
    x, y, heading = POSE
    away, c, s = places - (x, y), math.cos(heading), math.sin(heading)
    return np.stack([c * away[:, 0] + s * away[:, 1], c * away[:, 1] - s * away[:, 0]], axis=-1)


def on_rectangle(count: int, rng: np.random.Generator) -> np.ndarray:
    ends = np.array(RECTANGLE).reshape(-1, 2, 2)
    line = np.arange(count) % 4
    return ends[line, 0] + rng.uniform(0.1, 0.9, (count, 1)) * (ends[line, 1] - ends[line, 0])


def on_circle(count: int, rng: np.random.Generator) -> np.ndarray:
    turn = rng.uniform(0.2, 2.9, count)
    return np.stack([1.0 + 0.8 * np.cos(turn), 0.8 * np.sin(turn)], axis=-1)


@pytest.mark.parametrize("error", [-0.04, 0.0, 0.03])
@pytest.mark.parametrize("kind", ["lines", "arc", "both"])
def test_exact_points_give_their_scale(error: float, kind: str, rng: np.random.Generator) -> None:
    """From a start that is 3 cm and 1 degree wrong."""
    arcs = (Arc(1.0, 0.0, 0.8, 0.0, math.pi),)
    line, places = RECTANGLE[:2], [on_circle(40, rng)]
    if kind == "lines":
        field, places = Field(length=8.0, width=6.0, lines=RECTANGLE), [on_rectangle(60, rng)]
    elif kind == "arc":  # a circle and a line: a circle alone does not determine the heading
        field = Field(length=8.0, width=6.0, lines=line[:1], arcs=arcs)
        places.append(np.stack([rng.uniform(-2.5, 2.5, 20), np.full(20, -2.0)], axis=-1))
    else:
        field = Field(length=8.0, width=6.0, lines=RECTANGLE, arcs=arcs)
        places.append(on_rectangle(60, rng))
    points = (1.0 + error) * in_robot_frame(np.concatenate(places))
    found = point_scale(points, field, (POSE[0] + 0.03, POSE[1] - 0.02, POSE[2] + 0.02), scale=0.25)
    assert found is not None
    assert found.error == pytest.approx(error, abs=1e-5)
    assert found.sigma < 1e-4
    np.testing.assert_allclose(found.pose, POSE, atol=1e-4)


def test_points_that_the_scale_brings_to_lines_are_counted(rng: np.random.Generator) -> None:
    """Of 60 points with errors of 1 cm, and 12 in clutter; at the pose most points are off by more than 2.5 cm."""
    field = Field(length=8.0, width=6.0, lines=RECTANGLE)
    points = 1.03 * (in_robot_frame(on_rectangle(60, rng)) + rng.normal(0.0, 0.01, (60, 2)))
    points = np.concatenate([points, rng.uniform(-1.0, 1.0, (12, 2))])
    found = point_scale(points, field, POSE, scale=0.25)
    assert found is not None
    before, after = (distances(points / each, POSE) for each in (1.0, 1.03))
    sigma = 1.4826 * np.median(after[after < 0.25])
    on_lines = [np.count_nonzero(each < 2.5 * sigma) for each in (before, after)]
    assert on_lines[1] > 55 > 40 > on_lines[0]
    assert found.gained == pytest.approx(on_lines[1] - on_lines[0], abs=2)


def distances(points: np.ndarray, pose: tuple[float, float, float]) -> np.ndarray:
    """Return the distances of points in the robot's frame from the sides of the rectangle."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    at = points @ np.array([[c, s], [-s, c]]) + pose[:2]
    x, y = np.abs(np.abs(at[:, 0]) - 3.0), np.abs(np.abs(at[:, 1]) - 2.0)
    return np.minimum(np.where(np.abs(at[:, 1]) <= 2.0, x, np.inf), np.where(np.abs(at[:, 0]) <= 3.0, y, np.inf))


def test_the_standard_deviation_is_right(rng: np.random.Generator, draws: Draws) -> None:
    field = Field(length=8.0, width=6.0, lines=RECTANGLE)
    fits = []
    for _ in range(draws(200, 400)):
        points = in_robot_frame(on_rectangle(60, rng)) + rng.normal(0.0, 0.02, (60, 2))
        found = point_scale(1.02 * points, field, POSE, scale=0.25)
        assert found is not None
        fits.append(found[:2])
    errors, sigmas = np.array(fits).T
    # 200 draws: the standard deviation is known to 5 %.
    assert np.std(errors) == pytest.approx(np.sqrt(np.mean(sigmas**2)), rel=0.2)
    assert np.mean(errors) == pytest.approx(0.02, abs=4.0 * np.std(errors) / math.sqrt(len(errors)))


@pytest.mark.parametrize("lines", [RECTANGLE[:1], (RECTANGLE[0], RECTANGLE[2])])
def test_points_that_determine_no_scale(
    lines: tuple[tuple[float, float, float, float], ...], rng: np.random.Generator
) -> None:
    """A single line, and two lines that meet: scaling about their meeting point changes nothing."""
    ends = np.array(lines).reshape(-1, 2, 2)
    which = np.arange(60) % len(ends)
    places = ends[which, 0] + rng.uniform(0.1, 0.9, (60, 1)) * (ends[which, 1] - ends[which, 0])
    field = Field(length=8.0, width=6.0, lines=lines)
    assert point_scale(in_robot_frame(places), field, POSE, scale=0.25) is None


def test_a_fit_that_has_not_converged_gives_no_scale(monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> None:
    """From 3 cm beside the pose one step reaches no convergence, thirty do."""
    field = Field(length=8.0, width=6.0, lines=RECTANGLE)
    given = (1.03 * in_robot_frame(on_rectangle(60, rng)), field, (POSE[0] + 0.03, *POSE[1:]))
    assert module.point_scale(*given, scale=0.25) is not None
    monkeypatch.setattr(module, "_MAX_ITERATIONS", 1)
    assert module.point_scale(*given, scale=0.25) is None


def test_few_points_and_no_points_beside_lines_determine_no_scale(rng: np.random.Generator) -> None:
    field = Field(length=8.0, width=6.0, lines=RECTANGLE)
    assert point_scale(in_robot_frame(on_rectangle(4, rng)), field, POSE, scale=0.25) is None
    assert point_scale(np.full((5, 2), 30.0), field, (0.0, 0.0, 0.0), scale=0.25) is None
