"""Output of a calibration: digits of parameters against their uncertainty, skipped images, warnings."""

from __future__ import annotations

import math
import types
from typing import Any

import pytest

from gpuvision.cli.calibrate import _digits, _show


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


def test_everything_that_was_found_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    alternative = types.SimpleNamespace(model="k1,k2", rms_px=0.05123, p_value=0.0321, centre_distance_px=1.5)
    done: Any = types.SimpleNamespace(
        summary=lambda: "12 images",
        skipped_images=[("a.png", "no dots"), ("b.png", "too dark")],
        parameters={"f": (1234.5678, 0.5), "k1": (-1e-7, 1e-9)},
        alternatives=[alternative],
        fit=types.SimpleNamespace(warnings=("add views", "tilt them")),
    )
    _show(done, to_stderr=False)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert lines[:3] == ["12 images", "skipped a.png: no dots", "skipped b.png: too dark"]
    assert {"f 1234.57 0.5", "k1 -1e-07 1e-09", "k1,k2 0.05123 0.032 1.5"} <= set(lines)
    assert lines[-2:] == ["warning: add views", "warning: tilt them"]
    _show(done, to_stderr=True)
    assert capsys.readouterr().out == ""
