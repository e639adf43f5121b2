"""Choice of the next measurement against the determinants of written-out information matrices."""

from __future__ import annotations

import math

import numpy as np
import pytest

from gpuvision.servoing.machine_calibration.motion_frame import MotionPrior, next_move
from gpuvision.servoing.machine_calibration.next_measurement import NextMeasurement
from gpuvision.servoing.machine_calibration.nozzle_axis import NozzlePrior, next_nozzle_angle

POSITION = np.array([[4e-12, 1e-12], [1e-12, 3e-12]])


def of_move(command: tuple[float, float, float]) -> np.ndarray:
    """Return the derivatives (2, 8) of the seen position by axes, place of the board and offset of the camera."""
    x, y, angle = command
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[x, 0.0, y, 0.0, 1.0, 0.0, c, -s], [0.0, x, 0.0, y, 0.0, 1.0, s, c]])


def of_angle(angle: float, harmonics: tuple[int, ...]) -> np.ndarray:
    """Return the derivatives (2, 4 + 2 k) of the marker by the axis, the marker at the angle 0 and the harmonics."""
    turns = [np.exp(1j * order * angle) for order in (0, 1, *harmonics)]
    return np.hstack([[[each.real, -each.imag], [each.imag, each.real]] for each in turns])


def check(found: NextMeasurement, tried: list[np.ndarray], candidates: list[np.ndarray], prior: list[float]) -> None:
    """Compare with the information of the prior and of the measurements, in units of the prior."""
    unit, weight = np.array(prior), np.linalg.inv(POSITION)

    def information(rows: list[np.ndarray]) -> np.ndarray:
        return np.eye(len(unit)) + sum(each.T @ weight @ each * np.outer(unit, unit) for each in rows)

    before = np.linalg.slogdet(information(tried))[1]
    factors = [math.exp(0.5 * (np.linalg.slogdet(information([*tried, each]))[1] - before)) for each in candidates]
    np.testing.assert_allclose(found.volume_factor, factors, rtol=1e-6)
    assert factors[found.chosen] == pytest.approx(max(factors), rel=1e-9)
    after = np.linalg.inv(information([*tried, candidates[found.chosen]]))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), after, atol=1e-6 * np.abs(after).max())


@pytest.mark.parametrize(
    ("prior", "sigmas"),
    [(MotionPrior(), [0.01] * 4 + [0.01] * 4), (MotionPrior(axes=0.03, position=2e-3), [0.03] * 4 + [2e-3] * 4)],
)
@pytest.mark.parametrize("count", [0, 4])
def test_a_move_shrinks_the_volume_by_the_ratio_of_the_determinants(
    prior: MotionPrior, sigmas: list[float], count: int
) -> None:
    tried = [(0.0, 1e-3, 0.1), (20e-3, -2e-3, 0.7), (13e-3, 30e-3, -0.5), (5e-3, 8e-3, 1.9)][:count]
    candidates = [(1e-3, 2e-3, 0.2), (-35e-3, 25e-3, 2.5), (30e-3, 4e-3, -1.0)]
    covariance = np.zeros((3, 3))
    covariance[:2, :2], covariance[2, 2] = POSITION, 7e-10
    found = next_move(np.array(tried).reshape(-1, 3), candidates, covariance, prior=prior)
    check(found, [of_move(each) for each in tried], [of_move(each) for each in candidates], sigmas)


@pytest.mark.parametrize("harmonics", [(-1, 2), (3,), ()])
@pytest.mark.parametrize("count", [0, 5])
def test_an_angle_shrinks_the_volume_by_the_ratio_of_the_determinants(harmonics: tuple[int, ...], count: int) -> None:
    tried, candidates = [0.0, 0.4, 1.1, 1.7, -0.6][:count], [0.2, 2.9, -1.6, 1.2]
    for prior, position, run_out in (
        (NozzlePrior(), 1e-3, 20e-6),
        (NozzlePrior(position=3e-4, run_out=5e-6), 3e-4, 5e-6),
    ):
        found = next_nozzle_angle(tried, candidates, POSITION, harmonics=harmonics, prior=prior)
        check(
            found,
            [of_angle(each, harmonics) for each in tried],
            [of_angle(each, harmonics) for each in candidates],
            [position] * 4 + [run_out] * 2 * len(harmonics),
        )
