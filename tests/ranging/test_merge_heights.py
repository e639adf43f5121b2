"""Merge of two height maps: against the float64 oracle, at the extremes, and over different grids."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from canary import Guarded
from gpuvision.host import Device, to_numpy
from gpuvision.ranging.merge_heights import (
    DISAGREEMENTS,
    DISAGREES,
    FIRST,
    SECOND,
    UNCONFIRMED,
    MergeHeights,
    merge_height_maps,
)
from gpuvision.ranging.regrid import Grid, HeightMap
from gpuvision.reference.merge_heights import merge_heights as reference
from gpuvision.status import Status

BOTH = FIRST | SECOND
Arrays = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


def maps(rng: np.random.Generator, shape: tuple[int, ...], dtype: Any) -> tuple[Arrays, Arrays]:
    """Return two maps of one surface with noise, holes, flags of every kind, outliers, and wrong sigmas."""
    surface = rng.uniform(-0.01, 0.01, shape)
    made = []
    for _ in range(2):
        sigma = 10.0 ** rng.uniform(-7.0, -4.0, shape)
        z = surface + sigma * rng.normal(size=shape)
        z = np.where(rng.random(shape) < 0.2, z + rng.choice([-1.0, 1.0], shape) * 1e-3, z)
        status = np.where(rng.random(shape) < 0.3, 1 << rng.integers(0, 8, shape), 0).astype(np.uint8)
        z = np.where(rng.random(shape) < 0.1, rng.choice([math.nan, math.inf], shape), z)
        sigma = np.where(rng.random(shape) < 0.1, rng.choice([math.nan, math.inf, 0.0, -1.0], shape), sigma)
        made.append((z.astype(dtype), rng.uniform(0.0, 255.0, shape).astype(dtype), status, sigma.astype(dtype)))
    return made[0], made[1]


def run(operation: MergeHeights, one: Arrays, two: Arrays, device: Device, **more: Any) -> Any:
    sigmas = (one[3], two[3]) if operation.sigma else ()
    return operation(*one[:3], *two[:3], *sigmas, device=device, **more)


def assert_close(found: Any, operation: MergeHeights, one: Arrays, two: Arrays) -> None:
    if not operation.sigma:
        one, two = (*one[:3], None), (*two[:3], None)
    expected = reference(
        one,
        two,
        max_sigmas=operation.max_sigmas,
        tolerance=operation.tolerance,
        disagreement=operation.disagreement,
        require_both=operation.require_both,
    )
    np.testing.assert_array_equal(found.status, expected.status)
    np.testing.assert_array_equal(found.source, expected.source)
    eps = float(np.finfo(found.z.dtype).eps)
    # Two roundings of the weight and the product, times differences of at most 2e-3 m, and one of the height.
    np.testing.assert_allclose(found.z, expected.z, rtol=4.0 * eps, atol=4.0 * eps * 2e-3)
    np.testing.assert_allclose(found.intensity, expected.intensity, rtol=8.0 * eps, atol=8.0 * eps * 255.0)
    if operation.sigma:
        np.testing.assert_allclose(found.sigma, expected.sigma, rtol=8.0 * eps)
    else:
        assert found.sigma is None


@pytest.mark.parametrize("disagreement", DISAGREEMENTS)
@pytest.mark.parametrize("sigma", [True, False])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_against_the_oracle(
    device: Device, disagreement: Any, sigma: bool, dtype: Any, variant: Any, rng: np.random.Generator
) -> None:
    operation = MergeHeights(
        disagreement=disagreement, sigma=sigma, tolerance=0.0 if sigma else 2e-5, variant=variant, max_sigmas=3.0
    )
    one, two = maps(rng, (23, 37), dtype)
    found = run(operation, one, two, device)
    assert found.z.dtype == dtype
    assert set(np.unique(found.source)) >= {0, FIRST, SECOND, BOTH, FIRST | DISAGREES}
    assert_close(found, operation, one, two)


def test_heights_of_one_map_are_dropped(device: Device, rng: np.random.Generator) -> None:
    operation = MergeHeights(sigma=True, require_both=True, disagreement="lower")
    one, two = maps(rng, (23, 37), np.float32)
    found = run(operation, one, two, device)
    assert set(np.unique(found.source)) == {0, BOTH, UNCONFIRMED, FIRST | DISAGREES, SECOND | DISAGREES}
    assert np.all(np.isnan(found.z[found.source == UNCONFIRMED]))
    assert np.all(found.status[found.source == UNCONFIRMED] != 0)  # the flags of the map without a height
    assert_close(found, operation, one, two)


@pytest.mark.parametrize("shape", [(0,), (1,), (15,), (16,), (17,), (3, 5, 7), (255,), (257,), (1025,), (70_001,)])
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_sizes_and_canaries(device: Device, shape: tuple[int, ...], variant: Any, rng: np.random.Generator) -> None:
    operation = MergeHeights(sigma=True, variant=variant)
    one, two = maps(rng, shape, np.float32)
    like = run(operation, one, two, device)
    guarded = Guarded(like)
    found = run(operation, one, two, device, out=guarded.out)
    guarded.assert_intact()
    for each, expected in zip(found, like, strict=True):
        np.testing.assert_array_equal(each, expected)
    if math.prod(shape) < 2000:
        assert_close(like, operation, one, two)


@pytest.mark.double
def test_two_readings_agree_within_their_sigmas(device: Device) -> None:
    """Heights 0 and d with sigmas 3 and 4 um: the limit is 15 um; the mean is 9/25 of d."""
    d = np.array([14.9e-6, 15.1e-6], np.float64)
    zero, light, flags = np.zeros(2), np.ones(2), np.zeros(2, np.uint8)
    found = MergeHeights(sigma=True)(
        zero, light, flags, d, light, flags, np.full(2, 3e-6), np.full(2, 4e-6), device=device
    )
    np.testing.assert_allclose(found.z, [d[0] * 9.0 / 25.0, math.nan], rtol=1e-12)
    np.testing.assert_allclose(found.sigma, [2.4e-6, math.nan], rtol=1e-12)
    np.testing.assert_array_equal(found.status, [0, Status.AMBIGUOUS])


@pytest.mark.double
def test_merged_noise_is_that_of_sigma(device: Device, rng: np.random.Generator) -> None:
    """The scatter of the mean of two maps is the predicted one, and of independent maps 0.3 % disagree."""
    one, two = (rng.uniform(1e-6, 1e-5, 200_000).astype(np.float64) for _ in range(2))
    light, flags = np.ones_like(one), np.zeros(len(one), np.uint8)
    heights = [rng.normal(0.0, each) for each in (one, two)]
    found = MergeHeights(sigma=True)(heights[0], light, flags, heights[1], light, flags, one, two, device=device)
    agree = found.source == BOTH
    assert np.mean(~agree) == pytest.approx(0.0027, abs=0.0005)
    assert np.std(found.z[agree] / found.sigma[agree]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("sigma", [1e-30, 1e-19, 1.0, 1e18])
def test_extreme_sigmas(device: Device, sigma: float) -> None:
    """Squares of these standard deviations underflow or overflow in single precision."""
    z, light, flags = np.zeros(16, np.float32), np.ones(16, np.float32), np.zeros(16, np.uint8)
    spread = np.full(16, sigma, np.float32)
    found = MergeHeights(sigma=True)(z, light, flags, z, light, flags, spread, 1e3 * spread, device=device)
    np.testing.assert_array_equal(found.source, BOTH)
    np.testing.assert_allclose(found.sigma, spread, rtol=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"max_sigmas": -1.0}, "max_sigmas is -1.0, expected 0 or more"),
        ({"tolerance": -1e-6}, "tolerance is -1e-06, expected 0 or more"),
        ({"disagreement": "best"}, "disagreement is 'best', expected one of drop, first"),
    ],
)
def test_wrong_parameters(options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        MergeHeights(**options)


def height_map(z: np.ndarray, sigma: float | None = None) -> HeightMap:
    status = np.where(np.isfinite(z), 0, Status.NO_DATA).astype(np.uint8)
    return HeightMap(z, np.ones_like(z), status, None if sigma is None else np.full_like(z, sigma))


@pytest.mark.double
def test_maps_over_different_grids(device: Device) -> None:
    """An occlusion of each map is filled by the other; cells outside both have no data."""
    first = Grid(left=0.0, top=0.01, cell_x=1e-3, cell_y=1e-3, columns=6, rows=4)
    second = Grid(left=0.003, top=0.012, cell_x=1e-3, cell_y=1e-3, columns=5, rows=3)
    one, two = np.full(first.shape, 1.0), np.full(second.shape, 1.0)
    one[2, 4] = math.nan
    two[2, 1] = math.nan  # row 0, column 4 of the first map
    merged, grid = merge_height_maps((height_map(one, 1e-6), first), (height_map(two, 1e-6), second), device=device)
    assert grid == Grid(left=0.0, top=0.012, cell_x=1e-3, cell_y=1e-3, columns=8, rows=6)
    expected = np.zeros(grid.shape, np.uint8)
    expected[2:, :6] |= FIRST
    expected[:3, 3:] |= SECOND
    expected[4, 4] = 0
    expected[2, 4] = FIRST
    np.testing.assert_array_equal(merged.source, expected)
    np.testing.assert_array_equal(to_numpy(merged.status) == Status.NO_DATA, expected == 0)
    np.testing.assert_allclose(merged.sigma[expected == BOTH], 1e-6 / math.sqrt(2.0))
    without, _ = merge_height_maps((height_map(one), first), (height_map(two, 1e-6), second), device=device)
    assert without.sigma is None


def test_maps_of_two_frames_are_refused_before_they_are_allocated() -> None:
    grid = Grid(left=0.0, top=0.0, cell_x=1e-5, cell_y=1e-5, columns=3, rows=3)
    far = Grid(left=1.0, top=1.0, cell_x=1e-5, cell_y=1e-5, columns=3, rows=3)
    z = np.zeros((3, 3))
    message = r"span 100003 x 100003 cells of 1e-05 m, expected at most 67108864 cells; are both scans in one frame\?$"
    with pytest.raises(ValueError, match=message):
        merge_height_maps((height_map(z), grid), (height_map(z), far))
    with pytest.raises(ValueError, match="span 3 x 3 cells"):
        merge_height_maps((height_map(z), grid), (height_map(z), grid), max_cells=8)


def test_grids_off_the_lattice_are_refused() -> None:
    grid = Grid(left=0.0, top=0.0, cell_x=1e-3, cell_y=1e-3, columns=3, rows=3)
    wider = Grid(left=0.0, top=0.0, cell_x=2e-3, cell_y=1e-3, columns=3, rows=3)
    shifted = Grid(left=0.4e-3, top=0.0, cell_x=1e-3, cell_y=1e-3, columns=3, rows=3)
    z = np.zeros((3, 3))
    for other, message in ((wider, "0.001 and 0.002 m wide"), (shifted, "shifted by 0.4 and 0 cells")):
        with pytest.raises(ValueError, match=message):
            merge_height_maps((height_map(z), grid), (height_map(z), other))
