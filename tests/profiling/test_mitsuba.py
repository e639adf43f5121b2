"""Mitsuba as a peer: skipped if it is missing; works with an LLVM that does not know the processor."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")
pytest.importorskip("embreex.rtcore_scene", reason="the extra 'profile' is not installed")

from gpuvision.host import Device
from gpuvision.profiling import mitsuba, mitsuba_scenes


def test_without_mitsuba_there_are_no_cases_and_a_line_says_so(monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *more: None if name == "mitsuba" else find(name, *more)
    )
    assert list(mitsuba.cases(Device.best())) == []
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize(
    ("trial", "variant"),
    [("print('well')", "llvm_ad_rgb"), ("import os; os.abort()", "scalar_rgb"), ("raise ImportError", "scalar_rgb")],
)
def test_a_variant_that_dies_is_not_taken(monkeypatch, trial, variant):
    monkeypatch.setattr(mitsuba_scenes, "_TRY", trial)
    assert mitsuba_scenes.best_variant() == variant


def test_pixels_see_the_wall_where_the_picture_says():
    lit = mitsuba_scenes.groove(np.radians(90.0), (4, 6))
    receivers = lit.receivers(nodes=1)
    places, normals = receivers.rows[:, :, 0, :3], receivers.rows[:, :, 0, 3:]
    np.testing.assert_allclose(places[0, :, 0], 0.02 * (np.arange(6) - 2.5), atol=1e-12)
    # The edge is above, the wall's height of 80 mm is in the picture.
    height = np.linalg.norm(places[:, 0, 1:], axis=-1)
    np.testing.assert_allclose(height, 0.02 * (np.arange(4) + 0.5), atol=1e-9)
    np.testing.assert_allclose(normals[0, 0], [0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)
    assert receivers.whole.sum() < receivers.whole.size  # the strip ends in the edge, between two columns
    assert receivers.whole.any()


def test_lines_of_a_strip_share_its_light_and_its_width():
    lit = mitsuba_scenes.groove(np.radians(60.0))
    lines = lit.lines(3)
    assert lines.exitance.sum() == pytest.approx(lit.segments.exitance.sum())
    offset = lines.ends[:, 0] - lit.segments.ends[0, 0]
    np.testing.assert_allclose(np.sort(offset[:, 0]), np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.6) * 0.5e-4, atol=1e-15)
