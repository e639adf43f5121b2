"""Digits of calibrated parameters, against the printed uncertainty."""

from __future__ import annotations

import math

import pytest

from gpuvision.cli.calibrate import _digits


@pytest.mark.parametrize(
    ("value", "error", "digits"),
    [
        (1234.0, 0.5, 6),  # 1234.00: one digit below 0.1
        (-1234.0, 0.5, 6),
        (1.0, 0.3, 3),
        (0.001, 5.0, 2),  # unknown: two digits
        (1.0, 1e-12, 10),  # ten digits at most
        (1.0, 0.0, 6),  # no uncertainty
        (1.0, math.inf, 6),
        (1.0, math.nan, 6),
        (0.0, 0.1, 6),
    ],
)
def test_digits_reach_below_the_uncertainty(value: float, error: float, digits: int) -> None:
    assert _digits(value, error) == digits
