from __future__ import annotations

import dataclasses
import math

import hypothesis
import hypothesis.strategies as st
import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis.extra import numpy as hnp

from gpuvision import Device, Status
from gpuvision.profiling.offline.builds import GpuModel
from gpuvision.ranging.height_map import Grid, HeightMap
from gpuvision.ranging.regrid import Regrid, RegridCounts
from gpuvision.reference import regrid as reference

DTYPES = (np.float32, np.float64)
GRID = Grid(left=-1.0, top=2.0, cell_x=0.125, cell_y=0.25, columns=17, rows=13)
OP = Regrid(grid=GRID, max_gap=0.5, max_step=0.25)


def flat(shape: tuple[int, int], dtype: type = np.float64) -> list[np.ndarray]:
    """Return a scan of samples along x and profiles along y, slightly larger than GRID, with height x + y / 2."""
    x, y = np.meshgrid(np.linspace(-1.05, 1.05, shape[1]), np.linspace(-1.1, 2.1, shape[0]))
    return [each.astype(dtype) for each in (x, y, x + y / 2, 10 * x)] + [np.zeros(shape, np.uint8)]


def close(made: HeightMap, truth: HeightMap, tolerance: float) -> None:
    np.testing.assert_array_equal(made.status, truth.status)
    for values, right in zip(made[:2], truth[:2], strict=True):
        np.testing.assert_allclose(values, right, rtol=0, atol=tolerance, equal_nan=True)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("transposed", [False, True])
def test_a_plane_is_resampled_exactly(device, dtype, transposed):
    frames = flat((40, 61), dtype)
    op = OP
    if transposed:
        frames = [np.ascontiguousarray(each.T) for each in frames]
        op = dataclasses.replace(op, along="y")
    made = op(*frames, device=device)
    x, y = np.meshgrid(GRID.x, GRID.y)
    assert np.all(made.status == 0)
    # On a plane, linear interpolation has only rounding errors: a few operations with numbers up to 10.
    np.testing.assert_allclose(made.z, x + y / 2, rtol=0, atol=8 * 2 * np.finfo(dtype).eps)
    np.testing.assert_allclose(made.intensity, 10 * x, rtol=0, atol=8 * 10 * np.finfo(dtype).eps)


def test_groups_of_a_gpu():
    """Short lines share a group, lines along the profiles are read eight at a time; the last group may have fewer."""
    gpu = GpuModel()
    along_samples, along_profiles = OP.passes
    for operation, shape, groups, lines in (
        (along_samples, (1_000_003, 8), 62_501, 16),
        (along_samples, (67, 61), 17, 4),
        (along_samples, (67, 1000), 67, 1),
        (along_profiles, (67, 1001), 126, 8),
    ):
        launch = operation.launch(gpu, shape, np.dtype(np.float32))
        counts = next(each for each in launch.arguments if isinstance(each, np.ndarray))
        assert (launch.global_size, launch.local_size) == ((256 * groups,), (256,))
        assert (launch.problem_per_group, RegridCounts(*counts).lines_per_group) == (True, lines)


def rough(rng: np.random.Generator, shape: tuple[int, int], dtype: type, fold: float) -> list[np.ndarray]:
    """Return a scan with noise, steps, folds, samples far ahead of the others, holes of every kind, and flags."""
    x, y, _, intensity, status = flat(shape)
    x, y = x + fold * np.sin(7 * x + y), y + 0.1 * x + fold * np.cos(5 * y) * np.sin(3 * x)
    x, y = x + rng.normal(0, 3e-3, shape), y + rng.normal(0, 3e-3, shape)
    z = np.sin(3 * x) * np.cos(2 * y) + 0.3 * (rng.random(shape) < 0.05)
    ahead = rng.random(shape) < 0.005
    x[ahead] += rng.uniform(-1, 1, int(ahead.sum()))
    for flag in (1, 2, 16, 18, 64, 128):
        status[rng.random(shape) < 0.02] = flag
    for values, hole in ((x, np.inf), (y, np.nan), (z, np.nan)):
        values[rng.random(shape) < 0.03] = hole
    frames = [each.astype(dtype) for each in (x, y, z, intensity)]
    return [*frames, status, rng.uniform(1e-3, 2e-3, shape).astype(dtype)]


@pytest.mark.parametrize(
    ("shape", "along", "across", "fold"),
    [((37, 611), "x", "y", 0.3), ((259, 33), "-x", "-y", 0.05), ((5, 263), "y", "-x", 0.0), ((271, 9), "-y", "x", 0.3)],
)
@pytest.mark.parametrize("folded", ["drop", "top"])
@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.vectors
def test_work_groups_give_the_same_bits_as_lines_side_by_side(device, rng, shape, along, across, fold, folded, dtype):
    grid = Grid(left=-1.0, top=2.0, cell_x=2 / 301, cell_y=3 / 97, columns=302, rows=98)
    gap = 0.1 if min(shape) > 30 else 0.9
    op = Regrid(grid=grid, max_gap=gap, max_step=0.2, along=along, across=across, folded=folded, sigma=folded == "top")
    op = dataclasses.replace(op, fold_tolerance=0.01 if shape[0] < 100 else 0.0)
    frames = rough(rng, shape, dtype, fold)[: 5 + op.sigma]
    if along[-1] == "y":
        frames = [each.T for each in frames]
    frames = [
        np.ascontiguousarray(each[:: 1 if len(across) == 1 else -1, :: 1 if len(along) == 1 else -1]) for each in frames
    ]
    made, truth = op(*frames, device=device.without_vectors()), op(*frames, device=device)
    assert 0.05 < np.isfinite(truth.z).mean() < 1.0
    assert fold == 0.0 or np.any(truth.status & Status.NOT_INVERTIBLE)
    for field, value in zip(HeightMap._fields, truth, strict=True):
        np.testing.assert_array_equal(getattr(made, field), value, err_msg=field)


@pytest.mark.double
@pytest.mark.parametrize("directions", [("x", "y"), ("-x", "y"), ("x", "-y"), ("-y", "-x"), ("y", "x")])
def test_the_direction_of_the_scan_does_not_matter(device, directions):
    frames = flat((40, 61))
    truth = OP(*frames, device=device)
    along, across = directions
    if along[-1] == "y":
        frames = [each.T for each in frames]
    frames = [
        np.ascontiguousarray(each[:: 1 if len(across) == 1 else -1, :: 1 if len(along) == 1 else -1]) for each in frames
    ]
    made = dataclasses.replace(OP, along=along, across=across)(*frames, device=device)
    close(made, truth, 1e-14)


@pytest.mark.double
def test_a_scan_against_its_direction_is_folded_all_over(device):
    x, y, z, intensity, status = flat((40, 61))
    made = dataclasses.replace(OP, along="-x")(x, y, z, intensity, status, device=device)
    assert np.all(made.status == Status.NOT_INVERTIBLE)
    assert np.all(np.isnan(made.z))


@pytest.mark.double
def test_a_gap_stays_a_hole(device):
    frames = flat((40, 61))
    x, y, status = frames[0], frames[1], frames[4]
    status[8:32, 20:40] = Status.LOW_SIGNAL
    made = OP(*frames, device=device)
    inside = (GRID.x > x[0, 19]) & (GRID.x < x[0, 40])
    assert inside.sum() > 3
    in_gap = (GRID.y > y[7, 0]) & (GRID.y < y[32, 0])
    gap = in_gap[:, None] & inside
    assert np.all(made.status[gap] == Status.NO_DATA)
    assert np.all(np.isnan(made.z[gap]))
    assert np.all(made.status[~gap] == 0)
    bridged = dataclasses.replace(OP, max_gap=0.8, max_step=0.8)(*frames, device=device)
    np.testing.assert_allclose(bridged.z, GRID.x + GRID.y[:, None] / 2, atol=1e-14)


@pytest.mark.double
def test_gaps_and_steps_are_joined_up_to_their_limits(device):
    """Two samples a quarter apart in x and an eighth in height; all numbers are exact."""
    x, y = np.broadcast_to([-0.5, -0.25], (3, 2)).copy(), np.broadcast_to([[-0.25], [0.0], [0.25]], (3, 2)).copy()
    z = np.broadcast_to([0.0, 0.125], (3, 2)).copy()
    frames = (x, y, z, np.ones((3, 2)), np.zeros((3, 2), np.uint8))
    between = (GRID.x == -0.375).argmax()
    for gap, step, is_joined in ((0.25, 0.125, True), (0.2499, 0.125, False), (0.25, 0.1249, False)):
        made = dataclasses.replace(OP, max_gap=gap, max_step=step)(*frames, device=device)
        row = (GRID.y == 0.0).argmax()
        assert (made.status[row, between] == 0) == is_joined
        assert not is_joined or made.z[row, between] == 0.0625


@pytest.mark.double
def test_a_step_is_not_joined(device):
    x, y, z, intensity, status = flat((40, 61))
    z = np.where(x > 0.03, 0.3, 0.0)
    made = OP(x, y, z, intensity, status, device=device)
    edge = (GRID.x > x[x <= 0.03].max()) & (GRID.x < x[x > 0.03].min())
    profile = np.where(edge, np.nan, np.where(GRID.x > 0.03, 0.3, 0.0))
    np.testing.assert_array_equal(made.z, np.broadcast_to(profile, GRID.shape))
    joined = dataclasses.replace(OP, max_step=0.31)(x, y, z, intensity, status, device=device)
    assert np.all(np.isfinite(joined.z))


@pytest.mark.double
def test_flags_that_inform_ride_along(device):
    x, y, z, intensity, status = flat((40, 61))
    status[:, 30] = Status.SATURATED
    status[10, :] |= np.uint8(Status.AMBIGUOUS)
    made = OP(x, y, z, intensity, status, device=device)
    assert np.all(np.isfinite(made.z))
    near_column = np.abs(GRID.x - x[0, 30]) < x[0, 1] - x[0, 0]
    np.testing.assert_array_equal((made.status & Status.SATURATED) != 0, np.broadcast_to(near_column, GRID.shape))
    near_row = np.abs(GRID.y - y[10, 0]) < y[1, 0] - y[0, 0]
    np.testing.assert_array_equal((made.status & Status.AMBIGUOUS) != 0, np.broadcast_to(near_row[:, None], GRID.shape))


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_scan_that_turns_back_is_folded_where_it_does(device, dtype):
    # x rises to 0.5, falls to -0.5 and rises again: the values between are passed three times.
    turns = np.concatenate([np.arange(-72, 32), np.arange(32, -32, -1), np.arange(-32, 72)]) / 64
    shape = (20, len(turns))
    x = np.broadcast_to(turns, shape).astype(dtype)
    y = np.broadcast_to(np.linspace(-2, 3, 20)[:, None], shape).astype(dtype)
    z = np.full(shape, 0.5, dtype)
    frames = [np.ascontiguousarray(each) for each in (x, y, z, z)] + [np.zeros(shape, np.uint8)]
    made = OP(*frames, device=device)
    folded = (GRID.x >= -0.5) & (GRID.x <= 0.5)
    np.testing.assert_array_equal(made.status, np.broadcast_to(np.where(folded, Status.NOT_INVERTIBLE, 0), GRID.shape))
    assert np.all(np.isnan(made.z[:, folded]))
    kept = dataclasses.replace(OP, folded="top")(*frames, device=device)
    np.testing.assert_array_equal(kept.status, made.status)
    assert np.all(kept.z == 0.5)


@pytest.mark.double
def test_of_two_surfaces_the_higher_one_is_kept(device):
    x = np.array([[0.0, 0.5, 1.0, 0.25, 0.75, 1.0]]).repeat(2, 0)
    z = np.array([[1.0, 1.0, 1.0, 0.0, 0.0, 0.0]]).repeat(2, 0)
    y = np.array([[2.0], [1.75]]).repeat(6, 1)
    status = np.zeros(x.shape, np.uint8)
    op = dataclasses.replace(OP, folded="top", across="-y")
    made = op(x, y, z, z, status, device=device)
    row = made.z[0, (GRID.x >= 0) & (GRID.x <= 1)]
    np.testing.assert_array_equal(row, np.ones(9))
    flags = made.status[0, (GRID.x >= 0) & (GRID.x <= 1)]
    np.testing.assert_array_equal(flags, [0, 0] + [Status.NOT_INVERTIBLE] * 7)


@pytest.mark.double
def test_noise_within_the_tolerance_is_no_fold(device, rng):
    x, y, z, intensity, status = flat((40, 61))
    x = x + rng.uniform(-0.03, 0.03, x.shape)
    assert np.any(np.diff(x, axis=1) < 0)
    assert np.any(OP(x, y, z, intensity, status, device=device).status & Status.NOT_INVERTIBLE)
    made = dataclasses.replace(OP, fold_tolerance=0.1)(x, y, z, intensity, status, device=device)
    assert not np.any(made.status & Status.NOT_INVERTIBLE)


@pytest.mark.double
def test_samples_on_one_place_are_folded_there(device):
    x, y, z, intensity, status = flat((40, 61))
    x[:] = np.linspace(-1.0, 1.4, 61)
    x[:, 26] = x[:, 25]  # = 0.0, the centre of a cell
    made = OP(x, y, z, intensity, status, device=device)
    np.testing.assert_array_equal(np.flatnonzero(made.status[3] == Status.NOT_INVERTIBLE), [8])


@pytest.mark.double
def test_a_fold_is_known_on_the_row_beside_it(device):
    """Cells exactly at a row use its intervals to both neighbours: a fold in either one flags the cell."""
    x, y, z, intensity, status = flat((7, 11))
    x[:] = np.linspace(-1.0, 1.0, 11).round(2)
    y[:] = np.arange(7)[:, None] / 4 - 0.5
    x[4, 9] = x[4, 10]  # = 1.0, the centre of a cell; rows 3 and 5 have no fold
    op = dataclasses.replace(OP, grid=GRID, max_gap=0.25, max_step=1.0, folded="drop")
    frames = x, y, z, intensity, status
    made = op(*frames, device=device)
    close(made, reference.regrid(op, *frames), 1e-12)
    np.testing.assert_array_equal(np.flatnonzero(made.status[:, 16] == Status.NOT_INVERTIBLE), [5, 6, 7])


@hypothesis.settings(max_examples=60, deadline=None)
@hypothesis.given(data=st.data(), shape=hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=12))
def test_as_the_oracle(data, shape):
    # Coordinates on a dyadic grid are exact, and no height difference is close to max_step: rounding decides nothing.
    def numbers(low, high, part):
        return data.draw(hnp.arrays(np.float32, shape, elements=st.integers(low, high).map(lambda n: n / part)))

    ramp = np.broadcast_to(np.linspace(-1, 1, shape[1]).round(4), shape)
    x = (np.round(ramp * 64) / 64 + numbers(-8, 24, 64)).astype(np.float32)
    shifts = data.draw(hnp.arrays(np.float32, (shape[0], 1), elements=st.integers(-12, 12).map(lambda n: n / 32)))
    y = np.ascontiguousarray(np.broadcast_to(np.arange(shape[0], dtype=np.float32)[:, None] / 4 - 0.5 + shifts, shape))
    z, intensity = numbers(0, 12, 16), numbers(0, 100, 1)
    holes = st.sampled_from([np.nan, np.inf, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0])
    z = z + data.draw(hnp.arrays(np.float32, shape, elements=holes))
    given = data.draw(hnp.arrays(np.uint8, shape, elements=st.sampled_from([0] * 8 + [1, 2, 4, 16, 64])))
    op = Regrid(
        grid=GRID,
        max_gap=data.draw(st.sampled_from([0.0, 0.25, 0.5, 1.0])),
        max_step=data.draw(st.sampled_from([0.00013, 0.25013, 1.00013])),
        along=data.draw(st.sampled_from(["x", "-x"])),
        across=data.draw(st.sampled_from(["y", "-y"])),
        fold_tolerance=data.draw(st.sampled_from([0.0, 0.0625, 0.25])),
        folded=data.draw(st.sampled_from(["drop", "top"])),
        precision="double",
    )
    truth = reference.regrid(op, x, y, z, intensity, given)
    for device in Device.all():
        close(op(x, y, z, intensity, given, device=device), truth, 1e-12)


@pytest.mark.parametrize("dtype", DTYPES)
def test_a_large_scan_as_the_oracle(device, rng, dtype):
    shape = (50, 130)
    x, y, _, intensity, status = flat(shape)
    x, y = x + rng.normal(0, 0.002, shape), y + 0.1 * x
    z = np.sin(3 * x) * np.cos(2 * y)
    status[rng.random(shape) < 0.1] = Status.LOW_SIGNAL
    frames = [each.astype(dtype) for each in (x, y, z, intensity)] + [status]
    made, truth = OP(*frames, device=device), reference.regrid(OP, *frames)
    # In single precision a sample may be on the other side of a cell's centre: the value is the same.
    assert np.mean(made.status != truth.status) <= (0.0 if dtype is np.float64 else 0.01)
    both = np.isfinite(made.z) & np.isfinite(truth.z)
    assert both.mean() > 0.9
    np.testing.assert_allclose(made.z[both], truth.z[both], rtol=0, atol=40 * np.finfo(dtype).eps)


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (5, 1)])
def test_too_few_points_are_holes(device, shape):
    frames = [np.zeros(shape, np.float32) for _ in range(4)] + [np.zeros(shape, np.uint8)]
    made = OP(*frames, device=device)
    assert made.z.shape == GRID.shape
    assert np.all((made.status & Status.NO_DATA) != 0)
    assert np.all(np.isnan(made.z))


def test_bound_out_and_device_arrays_give_the_same(device):
    frames = flat((40, 61), np.float32)
    truth = OP(*frames, device=device)
    names = HeightMap._fields[:3]
    out = HeightMap(*(np.empty_like(getattr(truth, name)) for name in names))
    assert OP(*frames, device=device, out=out) is out
    arrays = [cl.array.to_device(device.queue, each) for each in frames]
    on_device = OP(*arrays)
    for along in ("x", "y"):
        op = dataclasses.replace(OP, along=along)
        bound = op.bind(device, frames[0].shape, np.float32)
        bound(*arrays).wait()
        right = op(*frames, device=device)
        for array, frame in zip(bound.inputs, frames, strict=True):
            cl.enqueue_copy(device.queue, array.base_data, frame) if not device.shares_memory else array.set(frame)
        for name in names:
            np.testing.assert_array_equal(getattr(bound.outputs, name).get(), getattr(right, name))
    for name in names:
        np.testing.assert_array_equal(getattr(out, name), getattr(truth, name))
        np.testing.assert_array_equal(getattr(on_device, name).get(), getattr(truth, name))


def test_a_grid_covers_the_points():
    grid = Grid.covering([0.013, np.nan, -0.021], [0.5, 7.0, 0.42], 0.01)
    assert (grid.columns, grid.rows) == (6, 9)
    np.testing.assert_allclose([grid.x[0], grid.x[-1], grid.y[0], grid.y[-1]], [-0.03, 0.02, 0.5, 0.42], atol=1e-15)
    for cell in (0, -1e-3):
        with pytest.raises(ValueError, match=rf"cell of a grid is {cell}, expected metres above 0"):
            Grid.covering([0.0, 1.0], [0.0, 1.0], cell)
    with pytest.raises(ValueError, match="no finite point"):
        Grid.covering([np.nan], [1.0], 0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"max_gap": -1.0}, "max_gap is -1.0, expected metres, 0 or more"),
        ({"max_step": math.nan}, "max_step must be finite"),
        ({"along": "z"}, "along is 'z', expected one of x, -x, y, -y"),
        ({"across": "-x"}, "expected the axis other than along='x'"),
        ({"folded": "keep"}, "expected 'drop' or 'top'"),
    ],
)
def test_a_wrong_regrid_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(OP, **change)


@pytest.mark.double
def test_wrong_input_is_refused(device):
    x, y, z, intensity, status = flat((4, 5))
    with pytest.raises(TypeError, match="float32 or float64 points, got int64"):
        OP(x.astype(np.int64), y, z, intensity, status, device=device)
    with pytest.raises(ValueError, match="one sample at least, got shape \\(20,\\)"):
        OP(*(each.ravel() for each in (x, y, z, intensity, status)), device=device)
    with pytest.raises(ValueError, match="one sample at least, got shape \\(0, 5\\)"):
        OP(*(each[:0] for each in (x, y, z, intensity, status)), device=device)
    with pytest.raises(ValueError, match="columns is 0, expected a number above 0"):
        dataclasses.replace(GRID, columns=0)
    bound = OP.bind(device, (4, 5), np.float64)
    with pytest.raises(TypeError, match="expected x, y, z, intensity and status, got 1 arrays"):
        bound(x)


@pytest.mark.double
@pytest.mark.parametrize("along", ["x", "-y"])
def test_wrong_arrays_are_named_as_given(device, along):
    """The names of the two passes and the order of their inputs do not appear."""
    op, names = dataclasses.replace(OP, along=along), ("x", "y", "z", "intensity", "status")
    given = [np.ascontiguousarray(each) for each in flat((4, 5))]
    for number, name in enumerate(names):
        wrong = [each if k != number else each.tolist() for k, each in enumerate(given)]
        kinds = ", ".join(type(each).__name__ for each in wrong)
        message = f"^Regrid: expected NumPy arrays or pyopencl arrays, all of one kind, got {kinds}$"
        with pytest.raises(TypeError, match=message):
            op(*wrong, device=device)
        if name != along[-1]:  # the first input of the first pass gives the shape
            wrong = [each if k != number else each[:3] for k, each in enumerate(given)]
            with pytest.raises(ValueError, match=rf"^Regrid: {name}: expected shape \(4, 5\), got \(3, 5\)$"):
                op(*wrong, device=device)


@pytest.mark.double
@pytest.mark.parametrize("along", ["x", "-y"])
def test_sigma_is_the_effect_of_every_sample(device, rng, along):
    """The oracle perturbs one height after the other: the sum of (weight sigma)^2, by the float64 reference."""
    grid = Grid(left=-1.0, top=0.9, cell_x=0.31, cell_y=0.29, columns=7, rows=6)
    op = Regrid(grid=grid, max_gap=0.5, max_step=5.0, along=along, sigma=True)
    frames = flat((9, 8), np.float64)
    frames[:2] = [each + rng.uniform(-0.05, 0.05, each.shape) for each in frames[:2]]
    frames[4][4, 3] = Status.LOW_SIGNAL
    if along != "x":
        frames = [np.ascontiguousarray(np.transpose(each)[:, ::-1]) for each in frames]
    sigma = rng.uniform(1e-3, 4e-3, frames[0].shape)
    truth, variance = reference.regrid(op, *frames), np.zeros(grid.shape)
    for at in np.ndindex(sigma.shape):
        moved = [each.copy() for each in frames]
        moved[2][at] += 1e-3
        weight = (reference.regrid(op, *moved).z - truth.z) / 1e-3
        variance += (weight * sigma[at]) ** 2
    made = op(*frames, sigma, device=device)
    np.testing.assert_array_equal(made.status, truth.status)
    assert np.isfinite(made.sigma).mean() > 0.6
    np.testing.assert_allclose(made.sigma, np.sqrt(variance), rtol=1e-9)
    bound = op.bind(device, sigma.shape, np.float64)
    for array, frame in zip(bound.inputs, [*frames, sigma], strict=True):
        array.set(frame)
    bound().wait()
    np.testing.assert_array_equal(bound.outputs.sigma.get(), made.sigma)
    without = dataclasses.replace(op, sigma=False)
    np.testing.assert_array_equal(without(*frames, device=device).z, made.z)
    with pytest.raises(TypeError, match=r"Regrid\.sigma"):
        op(*frames, device=device)
    with pytest.raises(TypeError, match=r"Regrid\.sigma"):
        without(*frames, sigma, device=device)
