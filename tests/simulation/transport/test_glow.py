"""Secondary light in the corners of a recording agrees with the simulator, on the wall and on the ceiling."""

from __future__ import annotations

import numpy as np
import pytest

import glow
from conftest import DATA

pytestmark = pytest.mark.realdata

# Frames without other objects in the corner, up to these distances to the left and right of the line [m].
FRAMES = {20: (-0.13, 0.14), 90: (-0.15, 0.35), 110: (-0.3, 0.15)}


@pytest.fixture(scope="module")
def frames():
    path = DATA / "laser" / "corner_scene_sweep.mp4"
    if not path.exists():
        pytest.skip("the recordings in ../shared/data are not here")
    return glow.red_frames(path, tuple(FRAMES))


@pytest.fixture(scope="module")
def room():
    return glow.room()


@pytest.fixture(scope="module")
def predicted(room):
    return {number: room.predict(number) for number in FRAMES}


@pytest.fixture(scope="module", params=FRAMES)
def seen(request, frames, predicted):
    return request.param, frames[request.param], predicted[request.param]


def fits(seen, name, *, bounces):
    number, red, surfaces = seen
    surface = surfaces[name]
    some = glow.kept(surface, red, FRAMES[number])
    light = surface.once + surface.more if bounces else surface.once
    assert some.sum() > 10_000
    return glow.fit(light[some], glow.linear(red[surface.rows])[some])


def test_the_light_stands_where_the_geometry_says(seen, room):
    number, red, _ = seen
    foot = room.foot(number) - [0.0, 0.15, 0.0] - room.eye
    column, row = (
        middle + room.geometry.focal_length_px * (each / -foot[2])
        for middle, each in zip(room.geometry.principal_point_px, (foot[0], -foot[1]), strict=True)
    )
    bright = np.flatnonzero(red[round(row)] >= glow.LIMIT)
    assert abs(bright.mean() - column) < 2.0


def test_the_wall_glows_as_predicted(seen):
    once, all_of_it = (fits(seen, "wall", bounces=each) for each in (False, True))
    assert once.correlation > 0.965
    assert once.deviation < 0.11
    # Further bounces between wall and ceiling remove half of the deviation.
    assert all_of_it.correlation > 0.99
    assert all_of_it.deviation < 0.06


def test_the_ceiling_glows_roughly_as_predicted(seen):
    # The ceiling is viewed at a grazing angle, 4 mm and more per pixel, and gets light from everything below.
    once = fits(seen, "ceiling", bounces=False)
    assert once.correlation > 0.89
    assert once.deviation < 0.15


def test_all_frames_have_the_same_factor(frames, predicted):
    factors = [fits((n, frames[n], predicted[n]), "wall", bounces=True).factor for n in FRAMES]
    assert np.ptp(factors) < 0.1 * np.mean(factors)


def test_the_wall_is_brightest_as_far_from_the_corner_as_beside_the_line(seen):
    # Any tone curve preserves a maximum. An infinite line gives y = x.
    number, red, surfaces = seen
    wall = surfaces["wall"]
    left, right = FRAMES[number]
    measured, said = [], []
    for beside in (0.04, 0.06, 0.08, 0.1, -0.04, -0.06, -0.08):
        assert left < beside < right
        measured.append(glow.brightest_away(wall, red[wall.rows], beside))
        said.append(glow.brightest_away(wall, wall.once + wall.more, beside))
    assert np.corrcoef(measured, said)[0, 1] > 0.8
    assert abs(np.median(np.array(measured) / said) - 1.0) < 0.15
    assert np.abs(np.array(measured) - said).max() < 0.04


def test_light_falls_off_beside_the_line_as_predicted(seen):
    number, red, surfaces = seen
    wall = surfaces["wall"]
    shown = (wall.beside > FRAMES[number][0]) & (wall.beside < FRAMES[number][1])
    found = fits(seen, "wall", bounces=True)
    said = found.factor * (wall.once + wall.more) + found.constant
    measured = glow.linear(red[wall.rows])
    for away in (0.03, 0.05, 0.1):
        powers = [glow.fall_off(wall, np.where(shown, light, 0.0), away) for light in (measured, said)]
        assert powers[0] == pytest.approx(powers[1], abs=0.2)
    near, far = (glow.fall_off(wall, np.where(shown, measured, 0.0), away) for away in (0.03, 0.1))
    assert near < far - 0.3
