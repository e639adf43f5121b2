"""Triangulation by plane polynomials, against the polynomials term by term in extended precision."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.polynomial import PlanePolynomial
from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference import plane_polynomial as reference
from gpuvision.status import Status

# About 0.1 m by 0.08 m on 1280 columns (c, v) and 1024 rows (r, u), with perspective and distortion of some percent.
POLYNOMIAL = PlanePolynomial(
    p=(-0.05, 8e-5, 2e-6, 3e-10, 5e-9, -1e-10, 2e-13, 4e-13),
    q=(-0.04, -7.5e-5, 1e-6, 4e-9, 2e-10, 3e-10, -3e-13, 2e-13),
    region=((0.0, 1279.0), (0.0, 1023.0)),
)


def oracle(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    points = np.stack([v, u], -1).reshape(-1, 2)
    return reference.to_plane(points, POLYNOMIAL.p, POLYNOMIAL.q).astype(np.float64).reshape(*u.shape, 2)


def drawn(rng: np.random.Generator, count: int, dtype: Any) -> tuple[np.ndarray, np.ndarray]:
    return rng.uniform(0, 1023, count).astype(dtype), rng.uniform(0, 1279, count).astype(dtype)


@pytest.mark.parametrize(
    ("dtype", "variant"), [(np.float32, "vector"), (np.float64, "vector"), (np.float32, "work_item")]
)
def test_against_the_oracle(device: Device, dtype: Any, variant: Any, rng: np.random.Generator) -> None:
    operation = Triangulation.from_polynomial(POLYNOMIAL, variant=variant, sigma=(0.2, 0.3))
    u, v = drawn(rng, 2003, dtype)
    result = operation(u, v, device=device)
    truth = oracle(u.astype(np.float64), v.astype(np.float64))
    # Eight roundings of the homography and of the displacement, of the largest value; the oracle's terms in double.
    atol = 8.0 * np.finfo(dtype).eps * np.max(np.abs(truth))
    np.testing.assert_array_equal(result.status, 0)
    np.testing.assert_allclose(np.stack([result.g, result.h], -1), truth, rtol=0, atol=atol)
    step = 1e-3
    points = np.stack([u, v], -1).astype(np.float64)
    slopes = [
        (oracle(*(points + step * axis).T) - oracle(*(points - step * axis).T)) / (2.0 * step) for axis in np.eye(2)
    ]
    variances = (0.2 * slopes[0]) ** 2 + (0.3 * slopes[1]) ** 2
    rtol = 1e-5 if dtype == np.float32 else 1e-7
    np.testing.assert_allclose(np.stack([result.sigma_g, result.sigma_h], -1), np.sqrt(variances), rtol=rtol)
    covariance = operation.covariance_at(points)
    np.testing.assert_allclose(np.diagonal(covariance, axis1=1, axis2=2), variances, rtol=1e-7)


def test_outside_of_the_region_and_not_finite(device: Device) -> None:
    operation = Triangulation.from_polynomial(POLYNOMIAL)
    u = np.array([0.0, 1023.0, -1.0, 1024.0, 500.0, 500.0, math.nan, math.inf], np.float32)
    v = np.array([0.0, 1279.0, 5.0, 5.0, -1.0, 1280.0, 5.0, 5.0], np.float32)
    result = operation(u, v, device=device)
    expected = [0, 0, *4 * [Status.OUT_OF_RANGE], *2 * [Status.NOT_FINITE]]
    np.testing.assert_array_equal(result.status, expected)
    np.testing.assert_array_equal(np.isnan(result.g) & np.isnan(result.h), result.status != 0)


def test_fused_in_the_readout_with_axes(device: Device, rng: np.random.Generator) -> None:
    frames = rng.integers(0, 20, (1, 48, 64)).astype(np.uint8)
    frames[:, 20:24] = 200
    axes = SampleAxes(position_origin=400.0, position_pitch=-1.0, sample_origin=300.0, sample_pitch=2.0)
    operation = Triangulation.from_polynomial(POLYNOMIAL)
    readout = LineReadout(threshold=50.0, window=4, triangulation=operation, axes=axes)
    reading = readout(frames, device=device)
    truth = oracle(400.0 - np.asarray(reading.position, np.float64), 300.0 + 2.0 * np.arange(64.0)[None])
    np.testing.assert_allclose(np.stack([reading.g, reading.h], -1), truth, rtol=0, atol=1e-6 * 0.05)


def test_points_of_the_sheet_and_back(rng: np.random.Generator) -> None:
    operation = Triangulation.from_polynomial(POLYNOMIAL)
    u, v = drawn(rng, 200, np.float64)
    np.testing.assert_allclose(operation.to_sensor(oracle(u, v)), np.stack([u, v], -1), rtol=0, atol=1e-8)
    assert Triangulation.from_dict(operation.to_dict()) == operation
    assert operation.region == ((0.0, 1023.0), (0.0, 1279.0))


def test_errors() -> None:
    operation = Triangulation.from_polynomial(POLYNOMIAL)
    with pytest.raises(ValueError, match="has a polynomial and a lens or camera"):
        replace(operation, lens=Lens(k1=1e-9))
    with pytest.raises(ValueError, match="no linear part of the polynomial; use from_polynomial"):
        replace(operation, homography=np.diag([1.0, 2.0, 1.0]))
    with pytest.raises(ValueError, match="covariance belongs to a homography"):
        replace(operation, covariance=np.eye(8))
