"""Merge of two height maps: against the float64 oracle, at the extremes, and over different grids."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from canary import Guarded
from gpuvision.host import Device, to_numpy
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.merge_heights import (
    DISAGREEMENTS,
    DISAGREES,
    FIRST,
    SECOND,
    UNCONFIRMED,
    MergeHeights,
    common_differences,
    merge_height_maps,
)
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


@pytest.mark.double
@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("shift", [(3, -2), (-3, 2), (1, 4)])
def test_every_cell_keeps_its_place(device: Device, shift: tuple[int, int], order: int) -> None:
    """Heights that are the number of the cell in one lattice, for maps in both orders; cells that are not square."""
    columns, rows = shift
    first = Grid(left=0.25, top=-0.5, cell_x=1e-3, cell_y=2e-3, columns=6, rows=4)
    second = Grid(left=0.25 + columns * 1e-3, top=-0.5 - rows * 2e-3, cell_x=1e-3, cell_y=2e-3, columns=5, rows=7)
    lattice = np.arange(400.0).reshape(20, 20)
    one = lattice[8:12, 8:14].copy()
    two = lattice[8 + rows : 15 + rows, 8 + columns : 13 + columns] + 1e-6
    maps = [(height_map(one), first), (height_map(two), second)][::order]
    merged, grid = merge_height_maps(maps[0], maps[1], tolerance=2e-6, device=device)
    top, left = min(rows, 0), min(columns, 0)
    bottom, right = max(4, rows + 7), max(6, columns + 5)
    assert grid.shape == (bottom - top, right - left)
    np.testing.assert_allclose([grid.left, grid.top], [0.25 + left * 1e-3, -0.5 - top * 2e-3], rtol=1e-12)
    assert (grid.cell_x, grid.cell_y) == (1e-3, 2e-3)
    places = lattice[8 + top : 8 + bottom, 8 + left : 8 + right]
    has_one, has_two = np.isin(places, one), np.isin(places + 1e-6, two)
    np.testing.assert_array_equal(merged.source & FIRST != 0, (has_one, has_two)[::order][0])
    np.testing.assert_array_equal(merged.source & SECOND != 0, (has_one, has_two)[::order][1])
    expected = np.where(has_one | has_two, places + 1e-6 * has_two / np.maximum(1, 1.0 * has_one + has_two), np.nan)
    np.testing.assert_allclose(merged.z, expected, rtol=0, atol=1e-12)
    differences = common_differences(maps[0], maps[1], merged, grid)
    assert differences.shape == (np.count_nonzero(has_one & has_two),)
    np.testing.assert_allclose(differences, order * 1e-6, rtol=1e-6)


@pytest.mark.double
def test_differences_include_the_cells_that_disagree(device: Device) -> None:
    grid = Grid(left=0.0, top=0.0, cell_x=1e-3, cell_y=1e-3, columns=4, rows=1)
    one, two = np.array([[1.0, 1.0, 1.0, np.nan]]), np.array([[1.25, 3.0, np.nan, 1.0]])
    maps = (height_map(one), grid), (height_map(two), grid)
    for disagreement, source in (("drop", DISAGREES), ("first", DISAGREES | FIRST), ("mean", DISAGREES | BOTH)):
        merged, made = merge_height_maps(*maps, tolerance=0.5, disagreement=disagreement, device=device)
        np.testing.assert_array_equal(merged.source, [[BOTH, source, FIRST, SECOND]])
        np.testing.assert_array_equal(common_differences(*maps, merged, made), [0.25, 2.0])


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
    z = np.zeros((3, 3))
    changes: tuple[tuple[dict[str, float], str], ...] = (
        ({"cell_x": 2e-3}, "0.001 and 0.002 m wide"),
        ({"cell_y": 3e-3}, "0.001 and 0.003 m wide"),
        ({"left": 0.4e-3}, r"shifted by 0\.4 and 0 cells"),
        ({"left": 2e-3, "top": -1.25e-3}, r"shifted by 2 and 1\.25 cells"),
    )
    for change, message in changes:
        with pytest.raises(ValueError, match=message):
            merge_height_maps((height_map(z), grid), (height_map(z), dataclasses.replace(grid, **change)))


def test_a_lattice_is_common_up_to_rounding(device: Device) -> None:
    """Cells differ by up to 1e-6 over the map, and grids are off the lattice by up to 1e-6 of their shift."""
    z = np.zeros((5, 4), np.float32)
    grid = Grid(left=0.0, top=0.0, cell_x=1.0, cell_y=1.0, columns=4, rows=5)

    def is_common(**change: float) -> bool:
        try:
            merge_height_maps(
                (height_map(z), grid), (height_map(z), dataclasses.replace(grid, **change)), device=device
            )
        except ValueError:
            return False
        return True

    assert is_common(cell_x=1.0 + 0.9e-6 / 5)
    assert not is_common(cell_y=1.0 + 1.1e-6 / 5)
    assert is_common(left=0.9e-6)
    assert not is_common(left=1.1e-6)
    assert is_common(left=50.0, top=-3.0 - 0.9e-6 * 50)
    assert not is_common(left=50.0, top=-3.0 - 1.1e-6 * 50)
