"""Peers with adaptive shadow rays: without an occluder, with a screen that cuts segments, and on the board."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from numpy.typing import NDArray

from gpuvision.profiling import adaptive_shadow_rays as adaptive
from gpuvision.reference import line_irradiance as reference
from gpuvision.simulation.transport.line_irradiance import LitSegments

# Numba compiles for some seconds.
FORMS = pytest.mark.parametrize(
    "form", [pytest.param(adaptive.NUMPY, id="numpy"), pytest.param(adaptive.NUMBA, id="numba", marks=pytest.mark.slow)]
)


def _scene() -> tuple[NDArray[np.float32], LitSegments]:
    """Return receivers with normals in all directions, and segments on a floor."""
    rng = np.random.default_rng(3)
    normals = rng.normal(size=(40, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    receivers = np.hstack([rng.uniform((-0.1, -0.1, -0.02), (0.1, 0.1, 0.1), (40, 3)), normals]).astype(np.float32)
    ends = np.zeros((7, 2, 3))
    ends[:, :, :2] = rng.uniform(-0.05, 0.05, (7, 2, 2))
    return receivers, LitSegments(ends, np.tile([0.0, 0.0, 1.0], (7, 1)), rng.uniform(0.5, 2.0, 7))


@FORMS
def test_without_occluders_it_is_the_closed_form(form: adaptive.Form) -> None:
    receivers, segments = _scene()
    found = adaptive.irradiance_by_adaptive_rays(
        form, receivers, adaptive.segment_table(segments), _sees_everything, adaptive.Setting(3, 2), 0.0
    )
    expected, scale = reference.irradiance(receivers, segments.ends, segments.normals, segments.exitance)
    assert np.count_nonzero(expected) > 20
    np.testing.assert_array_less(np.abs(found - expected), 2e-5 * scale + 1e-12)


@FORMS
def test_a_screen_leaves_the_parts_before_it(form: adaptive.Form) -> None:
    """A screen hides all places with x > 0.01 m: bisection finds the edge to 1/2^20 of the distance of two rays."""
    receivers, segments = _scene()
    found = adaptive.irradiance_by_adaptive_rays(
        form, receivers, adaptive.segment_table(segments), _before_the_screen, adaptive.Setting(16, 20), 0.0
    )
    start, end = segments.ends[:, 0], segments.ends[:, 1]
    cut = np.clip((0.01 - start[:, 0]) / (end - start)[:, 0], 0.0, 1.0)[:, None]
    middle = start + cut * (end - start)
    first = np.where(start[:, :1] <= 0.01, start, middle)
    last = np.where(end[:, :1] <= 0.01, end, middle)
    lit = np.linalg.norm(last - first, axis=1) > 0.0
    assert np.count_nonzero((cut > 0.0) & (cut < 1.0)) > 2
    parts = np.stack([first, last], axis=1)[lit]
    expected, scale = reference.irradiance(receivers, parts, segments.normals[lit], segments.exitance[lit])
    np.testing.assert_array_less(np.abs(found - expected), 1e-4 * scale + 1e-9)


def _sees_everything(start: NDArray[np.float32], step: NDArray[np.float32]) -> NDArray[np.bool_]:
    return np.ones(len(step), bool)


def _before_the_screen(start: NDArray[np.float32], step: NDArray[np.float32]) -> NDArray[np.bool_]:
    seen: NDArray[np.bool_] = (start + step)[:, 0] <= np.float32(0.01)
    return seen


def test_the_cheapest_setting_below_the_limit() -> None:
    """With 3 bisections no number of rays is enough; 4, 5 and 6 bisections need 32, 16 and 12 rays."""

    def error(setting: adaptive.Setting) -> float:
        return 0.5**setting.bisections + 1.0 / setting.rays

    def cost(setting: adaptive.Setting) -> float:
        return setting.rays + 10.0 * setting.bisections

    assert adaptive.cheapest_setting(error, cost, 0.1) == (16, 5)
    with pytest.raises(ValueError, match="no setting of the adaptive peer has an error of 1e-03 or less"):
        adaptive.cheapest_setting(error, cost, 1e-3)


@FORMS
def test_more_rays_come_nearer_to_the_truth_on_the_board(form: adaptive.Form) -> None:
    """Against 16 times as many rays; the parts that no ray hits are the error."""
    pytest.importorskip("embreex")
    from gpuvision.profiling import occluded_irradiance as board_cases

    board = board_cases.Board.of(strips=20)
    free = functools.partial(board_cases.trace_free, board_cases.embree_of(board.scene))
    light = functools.partial(
        adaptive.irradiance_by_adaptive_rays,
        form,
        board.receivers.reshape(-1, 6),
        adaptive.segment_table(board.segments),
        free,
        clearance=board_cases.CLEARANCE,
    )
    truth = light(adaptive.Setting(256, 10)).astype(float)
    few, many = (board_cases.error_of(light(adaptive.Setting(rays, 4)), truth, 0.95) for rays in (4, 64))
    assert many < 0.01 < few
