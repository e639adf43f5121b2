"""Light of lit strips against the independent path tracer Mitsuba, within the noise of Mitsuba."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats

from gpuvision.host import Device

pytest.importorskip("mitsuba", reason="the extra 'profile' is not installed")
pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from gpuvision.profiling.mitsuba_scenes import LitScene, Picture, board, by_closed_form, by_mitsuba, groove

pytestmark = pytest.mark.slow

SEEDS = 16


class Agreement(NamedTuple):
    """Comparison of images with several seeds and an expected image; the noise is the variation over the seeds."""

    chi_square: float  # per pixel; 1 if there is only noise
    chi_sigma: float
    bias: float  # standard error of the mean ratio
    bias_sigma: float
    pixels: int


def compare(pictures: Picture, expected: Picture, kept: np.ndarray) -> Agreement:
    made, expected = pictures[:, kept], expected[kept]
    student = (made.mean(axis=0) - expected) / (made.std(axis=0, ddof=1) / np.sqrt(len(made)))
    normal = stats.norm.ppf(stats.t.cdf(student, len(made) - 1))
    ratio = (made / expected).mean(axis=1) - 1.0
    return Agreement(
        float(np.mean(normal**2)),
        float(np.sqrt(2.0 / kept.sum())),
        float(ratio.mean()),
        float(ratio.std(ddof=1) / np.sqrt(len(made))),
        int(kept.sum()),
    )


def render(lit: LitScene, samples: int) -> Picture:
    picture = by_mitsuba(lit, "scalar_rgb")
    return np.array([picture(samples, seed) for seed in range(SEEDS)])


@pytest.fixture(scope="module", params=[90.0, pytest.param(60.0, marks=pytest.mark.nightly)], ids=["corner", "groove"])
def glowing(request):
    """Return the angle in degrees, Mitsuba's images, and gpuvision's image."""
    lit = groove(np.radians(request.param))
    return request.param, render(lit, 256), *expect(lit)


def expect(lit: LitScene, *, occluding: bool = False) -> tuple[Picture, np.ndarray]:
    receivers = lit.receivers()
    return by_closed_form(lit, receivers, Device.best(), occluding=occluding), receivers.whole


def test_a_wall_gets_the_light_that_the_closed_form_says(glowing):
    _, pictures, expected, kept = glowing
    found = compare(pictures, expected, kept)
    assert found.pixels > 4000
    assert abs(found.chi_square - 1.0) < 4.0 * found.chi_sigma
    assert abs(found.bias) < 3.0 * found.bias_sigma
    assert found.bias_sigma < 2e-4


def test_the_comparison_sees_a_thousandth_and_a_degree(glowing):
    angle, pictures, expected, kept = glowing
    brighter = compare(pictures, 1.001 * expected, kept)
    assert abs(brighter.bias) > 3.0 * brighter.bias_sigma
    # A wall with an angle larger by one degree, with the same total light.
    other, _ = expect(groove(np.radians(angle + 1.0)))
    leaning = compare(pictures, other * (expected[kept].sum() / other[kept].sum()), kept)
    assert abs(leaning.chi_square - 1.0) > 4.0 * leaning.chi_sigma


@pytest.fixture(scope="module")
def busy():
    """Return Mitsuba's images of a board with parts that occlude parts of the line."""
    lit = board()
    return lit, render(lit, 512)


# The tests of occluded irradiance compare it with rays.
@pytest.mark.nightly
def test_a_board_gets_the_light_of_what_it_sees(busy):
    lit, pictures = busy
    expected, whole = expect(lit, occluding=True)
    dark = whole & (expected == 0.0)
    assert dark.sum() > 3000
    assert np.all(pictures[:, dark] == 0.0)
    found = compare(pictures, expected, whole & (expected > 1e-3 * expected[whole].max()))
    assert found.pixels > 200
    assert abs(found.chi_square - 1.0) < 4.0 * found.chi_sigma
    assert abs(found.bias) < 3.0 * found.bias_sigma
    assert found.bias_sigma < 4e-3


@pytest.mark.nightly
def test_a_board_through_which_light_goes_is_another_one(busy):
    lit, pictures = busy
    expected, whole = expect(lit, occluding=False)
    found = compare(pictures, expected, whole & (expected > 0.0) & (np.ptp(pictures, axis=0) > 0.0))
    assert found.chi_square > 2.0
    assert abs(found.bias) > 10.0 * found.bias_sigma
