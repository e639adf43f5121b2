"""Warnings of a lens fit to straight lines: conditions on both sides of their limits, numbers of the messages."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np

from gpuvision.camera.lines.lens_fit import LensFitLimits, fit_warnings

LACK = SimpleNamespace(p_value=0.5, rms_px=0.0, noise_px=0.1)
FIT = SimpleNamespace(
    lens="lens",
    lines="vanishing",
    model="k1,k2",
    names=("k1", "k2", "C_c", "R_c"),
    covariance=np.diag([1e-16, 1e-16, 0.25, 1.0]),
    rms_px=0.1,
    lack_of_fit=LACK,
    alternatives=(),
)
# Half of the points lie within 0.05 pixels: a standard deviation of 0.0741.
PACKED = SimpleNamespace(family=np.array([0, 0, 1, 1]), families=2, unit=100.0)
FOUND: dict[str, Any] = {"at_bound": None, "converged": True, "parameters": SimpleNamespace(k=np.zeros(2))}


def _fit(**changes: Any) -> Any:
    return SimpleNamespace(**(vars(FIT) | changes))


def _warnings(
    fit: Any = FIT,
    packed: Any = PACKED,
    straight: float = 1e-3,
    bends: float = 1e3,
    distance: float = 5e-4,
    **found: Any,
) -> list[str]:
    evaluation = SimpleNamespace(distance=np.array([-2e-4, 3e-4, -distance, 1e-3, -5e-3]))
    minimum = SimpleNamespace(evaluation=evaluation, **(FOUND | found))
    return list(fit_warnings(fit, packed, minimum, straight, bends, LensFitLimits()))


def _only(words: str, *arguments: Any, **changes: Any) -> None:
    (warning,) = _warnings(*arguments, **changes)
    assert words in warning


def test_nothing_to_warn_of() -> None:
    assert _warnings() == []
    assert _warnings(_fit(lack_of_fit=None)) == []


def test_families_of_one_line() -> None:
    packed = SimpleNamespace(family=np.array([0, 1, 1, 2]), families=4, unit=100.0)
    _only("families [0, 2, 3] have fewer than two lines", FIT, packed)
    assert _warnings(_fit(lines="free"), packed) == []


def test_a_fit_that_has_not_converged() -> None:
    _only("stopped before it converged", converged=False)


def test_outliers() -> None:
    """The rms is limited to twice 1.4826 times the median of the residuals."""
    assert _warnings(_fit(rms_px=0.148)) == []
    _only("within 0.05 pixels, but the rms is 0.149: there are outliers", _fit(rms_px=0.149))
    # Residuals at the level of rounding say nothing.
    exact = SimpleNamespace(evaluation=SimpleNamespace(distance=np.zeros(5)), **FOUND)
    for rms, count in ((0.9e-7, 0), (1.1e-7, 1)):
        assert len(list(fit_warnings(_fit(rms_px=rms), PACKED, exact, 0.0, 1e3, LensFitLimits()))) == count


def test_smooth_residuals() -> None:
    for p_value, rms, is_reported in ((0.049, 0.06, True), (0.05, 0.06, False), (0.049, 0.05, False)):
        lack = SimpleNamespace(p_value=p_value, rms_px=rms, noise_px=0.1)
        found = _warnings(_fit(lack_of_fit=lack))
        assert len(found) == is_reported
        words = "a smooth pattern of 0.06 pixels rms over the image, beside 0.1 pixels of noise"
        assert not found or (words in found[0] and "not of model k1,k2" in found[0])


def test_parameters_that_the_data_do_not_determine() -> None:
    _only("the best lens would fold inside the data", at_bound="fold")
    _only("the centre moved to its bound", at_bound="centre")
    assert _warnings(straight=0.05) == []
    _only("the lines are as straight without a lens (p = 0.051)", straight=0.051)
    assert _warnings(bends=100.0) == []
    _only("faint for several coefficients", bends=99.0)
    assert _warnings(bends=99.0, parameters=SimpleNamespace(k=np.zeros(1))) == []
    # One sentence of the two.
    _only("as straight without a lens", straight=0.051, bends=99.0)
    # Without a lens none of them applies.
    bad: dict[str, Any] = {"straight": 1.0, "bends": 0.0, "at_bound": "fold"}
    assert _warnings(_fit(lens=None, names=(), covariance=np.zeros((0, 0))), **bad) == []


def test_centre() -> None:
    """A tenth of the half-diagonal, 10 pixels, along the axis that the data determine least."""
    for sigma, count in ((10.0, 0), (10.1, 1)):
        covariance = np.zeros((4, 4))
        direction = np.array([0.6, 0.8])
        covariance[2:, 2:] = sigma**2 * np.outer(direction, direction)
        found = _warnings(_fit(covariance=covariance))
        assert len(found) == count
        assert not found or ("only to 10.1 pixels along" in found[0] and "0.60, " in found[0] and "0.80)" in found[0])
    for unknown, words in ((0, "(1.00, 0.00)"), (1, "(0.00, 1.00)")):
        covariance = np.diag([1e-16, 1e-16, 1.0, 1.0])
        covariance[2 + unknown, 2 + unknown] = math.inf
        _only(f"only to inf pixels along {words}", _fit(covariance=covariance))


def test_alternatives() -> None:
    """Reported with an rms of at most 1.01 times, and a centre more than 3 standard deviations of 1 px away."""
    other = SimpleNamespace(model="k1", lines="free", rms_px=0.101, centre_distance_px=3.01)
    _only(
        "k1 with lines free fits as well (0.101 to 0.1 pixels), but has its centre 3.01 pixels away",
        _fit(alternatives=(other,)),
    )
    for change in ({"rms_px": 0.1011}, {"centre_distance_px": 3.0}):
        assert _warnings(_fit(alternatives=(SimpleNamespace(**(vars(other) | change)),))) == []
