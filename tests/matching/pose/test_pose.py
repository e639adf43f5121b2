"""Poses on devices: minimum of the loss, validity of the covariance, refusals."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.optimize import least_squares

from canary import Guarded
from gpuvision.host import Device
from gpuvision.matching.features.line_fit import FitLines
from gpuvision.matching.pose.pose import BoardPose, SolvePose, fitted_line_rows, line_rows, point_rows
from gpuvision.matching.robust import sample_subsets
from gpuvision.reference import robust
from gpuvision.status import Status

VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
SIGMA = 2e-6
MIDDLE = np.array([0.05, 0.08])
PLACE = (0.06, 0.07)


def scene(
    rng: np.random.Generator,
    boards: int,
    count: int,
    *,
    bad: float = 0.0,
    turn: float = 0.03,
    deformation: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Return true parameters (boards, 6), and rows of edges in all directions; the first rows are gross errors."""
    angle = rng.uniform(0.0, np.pi, (boards, count))
    normal = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    along = np.stack([normal[..., 1], -normal[..., 0]], axis=-1)
    point = MIDDLE + rng.uniform(-0.015, 0.015, (boards, count, 2))
    truth = np.column_stack(
        [rng.uniform(-1e-3, 1e-3, (boards, 2)), rng.uniform(-turn, turn, boards), np.tile(deformation, (boards, 1))]
    )
    error = rng.normal(0.0, SIGMA, (boards, count))
    far = int(bad * count)
    error[:, :far] += rng.uniform(2e-5, 4e-4, (boards, far)) * rng.choice([-1.0, 1.0], (boards, far))
    # Measured anywhere along the edge.
    moved = point + error[..., None] * normal + rng.uniform(-3e-4, 3e-4, (boards, count, 1)) * along
    rows = np.empty((boards, count, 7))
    for number, parameters in enumerate(truth):
        matrix, shift = robust.transform_of(parameters)
        seen = moved[number] @ matrix.T + shift
        rows[number] = line_rows(normal[number], point[number], seen, SIGMA)
    return truth, rows


def placed(truth: np.ndarray) -> np.ndarray:
    """Return the placement point and theta."""
    rows = []
    for parameters in truth:
        matrix, shift = robust.transform_of(parameters)
        rows.append([*(matrix @ PLACE + shift), parameters[2]])
    return np.array(rows)


def errors(result: BoardPose, truth: np.ndarray) -> np.ndarray:
    return np.column_stack([result.placement, result.pose[:, 2]]) - placed(truth)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize(
    ("loss", "transform"), [("tukey", "rigid"), ("huber", "similarity"), ("least_squares", "affine")]
)
def test_lies_at_the_minimum_of_its_loss(
    device: Device, loss: Any, transform: Any, variant: Any, rng: np.random.Generator
) -> None:
    deformation = {"rigid": (0.0, 0.0, 0.0), "similarity": (1e-3, 1e-3, 0.0), "affine": (1e-3, -2e-3, 5e-4)}[transform]
    bad = 0.3 if loss == "tukey" else 0.0
    truth, rows = scene(rng, 3, 33, bad=bad, deformation=deformation)
    operation = SolvePose(loss=loss, transform=transform, variant=variant, max_iterations=40, max_trials=64)
    result = operation(rows, device=device)
    assert not result.status.any()
    freedoms = {"rigid": 3, "similarity": 4, "affine": 6}[transform]
    for number, each in enumerate(rows):
        start = truth[number, :freedoms]
        found = robust.solve_pose(each, freedoms, 1.0, loss, operation.tuning_constant, start)
        ours = np.concatenate([result.pose[number], result.deformation[number]])[:freedoms]
        # A hundredth of the standard deviations (of the shifts, 0.1 m from the origin).
        np.testing.assert_allclose(ours[:2], found[:2], atol=5e-8)
        np.testing.assert_allclose(ours[2:], found[2:], atol=5e-7)
        np.testing.assert_allclose(result.residuals[number], robust.residuals(ours, each), atol=1e-11)
        assert (result.weights[number, : int(bad * 33)] == 0.0).all()


def carried(rows: np.ndarray, bad: int, transform: str) -> tuple[float, float]:
    """Return the least share of the total information in the good rows, and their largest leverage."""
    nx, ny, px, py = rows[:, :4].T
    px, py = 100.0 * (px - px.mean()), 100.0 * (py - py.mean())
    moves = [nx * px, nx * py, ny * px, ny * py] if transform == "affine" else [ny * px - nx * py]
    every = np.column_stack([nx, ny, *moves])
    good = every[bad:]
    share = eigh(good.T @ good, every.T @ every, eigvals_only=True)[0]
    return share, np.einsum("ij,ji->i", good, np.linalg.pinv(good)).max()


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize(
    ("transform", "scale", "count", "bad", "turn"),
    [("rigid", 1.0, 32, 0.4, 0.08), ("rigid", None, 48, 0.3, 0.03), ("affine", 1.0, 64, 0.2, 0.03)],
)
def test_covariance_is_what_is_measured(
    device: Device,
    variant: Any,
    transform: Any,
    scale: Any,
    count: int,
    bad: float,
    turn: float,
    rng: np.random.Generator,
) -> None:
    deformation = (1e-3, -2e-3, 5e-4) if transform == "affine" else (0.0, 0.0, 0.0)
    truth, rows = scene(rng, 500, count, bad=bad, turn=turn, deformation=deformation)
    operation = SolvePose(transform=transform, scale=scale, placement=PLACE, variant=variant, max_trials=256)
    result = operation(rows, device=device)
    good = result.status == Status.OK
    # Poses that the good rows do not support are refused, up to the effect of the weights.
    agreement, leverage = np.transpose([carried(each, int(bad * count), transform) for each in rows])
    allowed = np.where(agreement > 0.75, 1.0, 0.5) * operation.max_leverage
    spare = np.minimum(agreement - operation.min_inlier_fraction, allowed - leverage)
    assert good[spare > 0.02].all()
    assert not good[spare < -0.02].any()
    assert np.mean(np.abs(spare) > 0.02) > 0.9
    found = errors(result, truth)[good]
    covariance = result.covariance[good, :3, :3]
    # 500 draws determine a standard deviation to 3 %.
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(covariance[:, [0, 1, 2], [0, 1, 2]], axis=0))
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    # No gross errors: 7 sigma have a chance of 1e-9 in three freedoms.
    squares = np.einsum("bi,bij,bj->b", found, np.linalg.inv(covariance), found)
    assert squares.max() < 49.0
    np.testing.assert_allclose(np.mean(result.residual_scale[good]), 1.0, atol=0.1)


def test_a_given_scale_is_a_factor_on_the_sigmas(device: Device, rng: np.random.Generator) -> None:
    """A power of two, so that all numbers are equal bit by bit."""
    _, rows = scene(rng, 3, 16)
    rows = rows.astype(np.float32)
    wide = rows.copy()
    wide[..., 6] *= 2.0
    one, other = (
        SolvePose(scale=scale, placement=PLACE, max_leverage=1.0)(each, device=device)
        for scale, each in ((1.0, wide), (2.0, rows))
    )
    assert not one.status.any()
    for name in ("pose", "covariance", "leverage", "condition", "weights", "status"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)
    np.testing.assert_array_equal(other.residual_scale, 2.0 * one.residual_scale)


def information(rows: np.ndarray) -> np.ndarray:
    """Return the information of the rigid motion about PLACE of each set of rows, at no motion."""
    nx, ny, px, py, _, _, sigma = np.moveaxis(rows.astype(np.float64), -1, 0)
    terms = np.stack([nx, ny, ny * (px - PLACE[0]) - nx * (py - PLACE[1])], axis=-1) / sigma[..., None]
    return terms.swapaxes(-1, -2) @ terms


@VARIANTS
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_exact_rows_are_not_refused(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    _, rows = scene(rng, 4, 16)
    rows[..., 4:6] = 0.0
    result = SolvePose(scale=None, min_scale=1.0, placement=PLACE, variant=variant)(rows.astype(dtype), device=device)
    assert not result.status.any()
    np.testing.assert_array_equal(result.residual_scale, 0.0)
    np.testing.assert_array_equal(result.covariance, 0.0)
    np.testing.assert_allclose(result.leverage, [carried(each, 0, "rigid")[1] for each in rows], rtol=1e-3)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize("is_exact", [False, True])
def test_as_many_rows_as_unknowns_have_the_covariance_of_their_sigmas(
    device: Device, variant: Any, is_exact: bool, rng: np.random.Generator
) -> None:
    _, rows = scene(rng, 6, 3, turn=0.0)
    rows[..., 4:6] = 0.0 if is_exact else 1e-9 * rng.standard_normal((6, 3, 2))
    operation = SolvePose(scale=None, min_scale=1.0, placement=PLACE, variant=variant, max_leverage=1.0)
    result = operation(rows, device=device)
    good = result.status == Status.OK
    assert good.any()
    assert np.isnan(result.residual_scale).all()
    expected = np.linalg.inv(information(rows))
    unit = np.sqrt(np.einsum("bi,bj->bij", *2 * [np.diagonal(expected, axis1=1, axis2=2)]))
    np.testing.assert_allclose((result.covariance / unit)[good], (expected / unit)[good], atol=1e-3)
    # Nothing checks such a pose.
    checked = replace(operation, max_leverage=0.95)(rows, device=device)
    assert (checked.status == Status.AMBIGUOUS).all()
    np.testing.assert_allclose(checked.leverage[good], 1.0, atol=1e-6)


@pytest.mark.double
def test_single_follows_double(device: Device, rng: np.random.Generator) -> None:
    _, rows = scene(rng, 20, 32, bad=0.3)
    rows = rows.astype(np.float32)
    operation = SolvePose(placement=PLACE, max_trials=256)
    single, double = operation(rows, device=device), operation(rows.astype(np.float64), device=device)
    # A twentieth of the standard deviations.
    np.testing.assert_allclose(single.placement, double.placement, atol=4e-8)
    np.testing.assert_allclose(single.pose[:, 2], double.pose[:, 2], atol=2e-6)
    np.testing.assert_allclose(single.covariance[:, 0, 0], double.covariance[:, 0, 0], rtol=0.02)


@pytest.mark.double
@VARIANTS
def test_points_of_a_board_turned_far(device: Device, variant: Any, rng: np.random.Generator) -> None:
    point = MIDDLE + rng.uniform(-0.01, 0.01, (6, 2))
    matrix, shift = robust.transform_of(np.array([0.02, -0.03, 1.2]))
    rows = point_rows(point, point @ matrix.T + shift, SIGMA)
    assert rows.shape == (12, 7)
    result = SolvePose(variant=variant, max_iterations=20)(rows, device=device)
    np.testing.assert_allclose(result.pose, [0.02, -0.03, 1.2], atol=1e-10)
    # The opposite sign, with a start nearby.
    matrix, shift = robust.transform_of(np.array([0.02, -0.03, -3.0]))
    rows = point_rows(point, point @ matrix.T + shift, SIGMA)
    result = SolvePose(variant=variant, with_initial_pose=True)(rows, np.array([0.0, 0.0, 3.0]), device=device)
    np.testing.assert_allclose(result.pose, [0.02, -0.03, -3.0], atol=1e-10)


@pytest.mark.double
@VARIANTS
def test_covariance_of_points_in_closed_form(device: Device, variant: Any) -> None:
    """Points on a circle about the placement point: x and y have sigma^2/n, theta sigma^2/(n r^2)."""
    angle = np.arange(8) * np.pi / 4
    point = np.array(PLACE) + 0.01 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    rows = point_rows(point, point + np.array([1e-4, 0.0]), SIGMA)
    operation = SolvePose(loss="least_squares", placement=PLACE, variant=variant)
    result = operation(rows, device=device)
    expected = np.diag([SIGMA**2 / 8, SIGMA**2 / 8, SIGMA**2 / 8 / 1e-4])
    np.testing.assert_allclose(result.covariance, expected, rtol=1e-9, atol=1e-22)
    np.testing.assert_allclose(result.condition, 1.0, rtol=1e-9)
    # A lever arm adds a contribution of theta perpendicular to it.
    away = SolvePose(loss="least_squares", placement=(PLACE[0] + 0.05, PLACE[1]), variant=variant)(rows, device=device)
    np.testing.assert_allclose(away.covariance[1, 1], SIGMA**2 / 8 * (1 + 25), rtol=1e-9)
    np.testing.assert_allclose(away.covariance[0, 0], SIGMA**2 / 8, rtol=1e-9)
    assert away.rank == 3


@VARIANTS
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_refuses_what_the_features_cannot_carry(
    device: Device, variant: Any, dtype: Any, rng: np.random.Generator
) -> None:
    _, rows = scene(rng, 6, 32)
    from_middle = rows[1, :, 2:4] - MIDDLE
    rows[0, :, :2] = [np.cos(0.7), np.sin(0.7)]  # parallel edges
    rows[1, :, :2] = from_middle / np.linalg.norm(from_middle, axis=-1)[:, None]  # all edges lie about one point
    rows[:2, :, 4:6] = rng.normal(0.0, SIGMA, (2, 32, 1)) * rows[:2, :, :2]
    rows[2, 2:, 4] = np.nan  # two rulers
    rows[3, :, 6] = 0.0  # no rows
    rows[4, :, 4:6] = rng.uniform(-1e-3, 1e-3, (32, 2))  # clutter
    result = SolvePose(variant=variant)(rows.astype(dtype), device=device)
    expected = [Status.AMBIGUOUS, Status.AMBIGUOUS, Status.NO_DATA, Status.NO_DATA, Status.AMBIGUOUS, Status.OK]
    np.testing.assert_array_equal(result.status, expected)
    np.testing.assert_array_equal(result.rank[[0, 1, 5]], [2, 2, 3])
    assert np.isnan(result.pose[:5]).all()
    assert np.isnan(result.placement[:5]).all()
    assert np.isnan(result.covariance[:5]).all()
    assert np.isfinite(result.pose[5]).all()


@pytest.mark.double
def test_a_start_that_is_no_number(device: Device, rng: np.random.Generator) -> None:
    _, rows = scene(rng, 2, 32)
    initial_pose = np.zeros((2, 3))
    initial_pose[1, 2] = np.nan
    result = SolvePose(with_initial_pose=True)(rows, initial_pose, device=device)
    np.testing.assert_array_equal(result.status, [Status.OK, Status.NOT_FINITE])
    assert np.isnan(result.pose[1]).all()


@pytest.mark.double
def test_missing_rows_are_as_if_they_were_not_there(device: Device, rng: np.random.Generator) -> None:
    _, rows = scene(rng, 2, 40)
    without = SolvePose(loss="least_squares")(np.ascontiguousarray(rows[:, :30]), device=device)
    rows[:, 30:, 5] = np.inf
    result = SolvePose(loss="least_squares")(rows, device=device)
    np.testing.assert_allclose(result.pose, without.pose, atol=1e-12)
    np.testing.assert_allclose(result.covariance, without.covariance, rtol=1e-9)
    assert np.isnan(result.residuals[:, 30:]).all()
    assert not result.weights[:, 30:].any()


@pytest.mark.double
def test_fitted_lines_carry_their_angle(device: Device, rng: np.random.Generator) -> None:
    """Poses from fitted lines agree with poses from the edges of the lines."""
    lines, each = 12, 10
    angle = np.arange(lines) * np.pi / lines
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    along = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    point = MIDDLE + rng.uniform(-0.01, 0.01, (lines, 2))
    on = point[:, None] + rng.uniform(-0.004, 0.004, (lines, each, 1)) * along[:, None]
    matrix, shift = robust.transform_of(np.array([2e-4, -1e-4, 0.01]))
    seen = (on + rng.normal(0.0, SIGMA, (lines, each, 1)) * normal[:, None]) @ matrix.T + shift
    fits = FitLines(loss="least_squares", scale=SIGMA)(seen, device=device)
    direction = fits.normal * np.sign(np.sum(fits.normal * (normal @ matrix.T), axis=-1))[:, None]
    turned = np.arcsin(normal[:, 0] * direction[:, 1] - normal[:, 1] * direction[:, 0])
    rows = fitted_line_rows(normal, point, fits.centre, fits.covariance, turned)
    operation = SolvePose(loss="least_squares", placement=PLACE)
    by_lines = operation(rows, device=device)
    by_edges = operation(line_rows(normal[:, None], on, seen, SIGMA), device=device)
    np.testing.assert_allclose(by_lines.placement, by_edges.placement, atol=2e-8)
    np.testing.assert_allclose(by_lines.covariance, by_edges.covariance, rtol=0.02, atol=1e-14)


ETCH = 20e-6


def etched(rng: np.random.Generator, boards: int, count: int, bad: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scene whose edges are displaced by the etch bias of the board; a quarter of them are not single edges."""
    truth, rows = scene(rng, boards, count, bad=bad)
    etch = rng.normal(0.0, ETCH, boards)
    etch_factor = np.where(np.arange(count) % 4, 1.0, 0.0) * np.ones((boards, 1))
    for number, parameters in enumerate(truth):
        matrix, _ = robust.transform_of(parameters)
        out = rows[number, :, :2] @ matrix.T
        rows[number, :, 4:6] += etch[number] * etch_factor[number][:, None] * out
    return truth, etch, np.concatenate([rows, etch_factor[..., None]], axis=-1)


@pytest.mark.double
@VARIANTS
def test_an_etching_is_one_more_unknown(device: Device, variant: Any, rng: np.random.Generator) -> None:
    truth, etch, rows = etched(rng, 500, 40, 0.3)
    # Normals over the upper half circle: without this range the etch bias would be a shift.
    plain = SolvePose(placement=PLACE, max_trials=256, variant=variant)(
        np.ascontiguousarray(rows[..., :7]), device=device
    )
    result = SolvePose(placement=PLACE, max_trials=256, etch_bias_sigma=ETCH, variant=variant)(rows, device=device)
    good = result.status == Status.OK
    assert np.mean(good) > 0.97
    found, covariance = errors(result, truth)[good], result.covariance[good]
    ratio = np.std(found, axis=0) / np.sqrt(np.mean(covariance[:, [0, 1, 2], [0, 1, 2]], axis=0))
    # 500 draws determine a standard deviation to 3 %.
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)
    assert np.std(result.etch_bias[good] - etch[good]) < 0.25 * ETCH
    squares = np.einsum("bi,bij,bj->b", found, np.linalg.inv(covariance), found)
    assert squares.max() < 49.0
    seen = plain.status == Status.OK
    wrong = np.abs(errors(plain, truth)[seen, 1]) > 5.0 * np.sqrt(plain.covariance[seen, 1, 1])
    assert np.mean(np.append(wrong, np.ones(np.sum(~seen), bool))) > 0.5


@pytest.mark.double
def test_an_etching_takes_as_much_as_least_squares_say(device: Device, rng: np.random.Generator) -> None:
    _, _, rows = etched(rng, 1, 24, 0.0)
    found = SolvePose(placement=(0.0, 0.0), loss="least_squares", etch_bias_sigma=ETCH)(rows, device=device)
    normal, point = rows[0, :, :2], rows[0, :, 2:4]
    lever = point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0]
    equations = np.column_stack([normal, lever, rows[0, :, 7]])
    matrix = equations.T @ equations / SIGMA**2 + np.diag([0.0, 0.0, 0.0, 1.0 / ETCH**2])
    # To the pose's own size: lengths turn by 0.03, and shifts are a thousandth.
    np.testing.assert_allclose(found.covariance[0], np.linalg.inv(matrix)[:3, :3], rtol=0.1)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize("sigma", [3e-7, 20e-6])
def test_an_etch_bias_is_at_the_minimum_of_loss_and_prior(
    device: Device, variant: Any, sigma: float, rng: np.random.Generator
) -> None:
    """The smaller standard deviation of the etch bias is as certain as the 27 rows, and halves the estimate."""
    truth, _, rows = etched(rng, 3, 27, 0.0)
    operation = SolvePose(loss="least_squares", etch_bias_sigma=sigma, variant=variant, max_iterations=30)
    found = operation(rows, device=device)
    scale = np.array([1e-3, 1e-3, 1e-2, 1e-5])
    for board in range(3):

        def equations(unknowns: np.ndarray, given: np.ndarray = rows[board]) -> np.ndarray:
            pose, etch_bias = unknowns[:3] * scale[:3], unknowns[3] * scale[3]
            across = robust.residuals(pose, given[:, :7]) - given[:, 7] * etch_bias
            return np.append(across / given[:, 6], etch_bias / sigma)

        start = np.append(truth[board, :3], 0.0) / scale
        expected = scale * least_squares(equations, start, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        assert found.etch_bias[board] == pytest.approx(expected[3], abs=1e-9)
        np.testing.assert_allclose(found.pose[board], expected[:3], atol=1e-8)


@pytest.mark.double
@VARIANTS
def test_the_condition_is_compared_with_its_limit(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """Edges fix y 50 times worse than x: accepted up to this ratio of standard deviations."""
    _, rows = scene(rng, 1, 37)
    rows[0, ::2, :2], rows[0, 1::2, :2] = (1.0, 0.0), (0.0, 1.0)
    rows[..., 4:6] = 0.0
    rows[0, 1::2, 6] *= 50.0
    for limit, status, rank in ((60.0, Status.OK, 3), (42.0, Status.AMBIGUOUS, 2)):
        found = SolvePose(max_condition=limit, variant=variant)(rows, device=device)
        assert found.condition[0] == pytest.approx(50.0, rel=0.1)
        assert (found.status[0], found.rank[0]) == (status, rank)
        assert np.isnan(found.pose).all() == (status != Status.OK)


# Angles of 1016 parallel edges whose sums rounding changes most, of 4 million random ones in an emulation of the sums.
BIASED = (2.4331034946954203, 0.7523015129366443)


def parallel_edges(rng: np.random.Generator, dtype: Any, least: float) -> tuple[np.ndarray, np.ndarray]:
    """Return shifts (200, 2) along parallel edges, and rows whose condition is ``least`` to 30 ``least``.

    Only 8 of 1024 edges measure the shift, with large sigmas.
    """
    boards, count, few, size = 200, 1024, 8, 0.02
    angle = rng.choice(BIASED, (boards, 1)) + rng.normal(0.0, 1e-5, (boards, 1))
    shift = 1e-4 * np.concatenate([-np.sin(angle), np.cos(angle)], axis=-1)
    angles = np.repeat(angle, count, axis=1)
    angles[:, :few] += np.pi / 2.0
    normal = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    sigma = np.repeat(10.0 ** rng.uniform(-6.0, -5.0, (boards, 1)), count, axis=1)
    sigma[:, :few] *= least * 30.0 ** rng.uniform(0.0, 1.0, (boards, 1)) * np.sqrt(few / (count - few))
    point = rng.uniform(-0.5 * size, 0.5 * size, (boards, count, 2))
    moved = np.sum(normal * shift[:, None], axis=-1, keepdims=True) * normal
    return shift, np.concatenate([normal, point, moved, sigma[..., None]], axis=-1).astype(dtype)


@pytest.mark.double
@VARIANTS
@pytest.mark.parametrize(("dtype", "largest"), [(np.float32, 512.0), (np.float64, 1.18e7)])
def test_poses_up_to_the_largest_condition(
    device: Device, dtype: Any, largest: float, variant: Any, rng: np.random.Generator
) -> None:
    """Poses are refused, or right: 12 steps that leave a quarter of the distance each leave 6e-8 of the shift."""
    shift, rows = parallel_edges(rng, dtype, largest / 10.0)
    operation = SolvePose(loss="least_squares", max_condition=largest, variant=variant)
    found = operation(rows, device=device)
    is_good = found.status == Status.OK
    assert np.all(found.status[~is_good] == Status.AMBIGUOUS)
    assert np.any(is_good & (found.condition > 0.9 * largest))
    assert np.linalg.norm(found.pose[is_good, :2] - shift[is_good], axis=1).max() < 1e-4 * 1e-6
    with pytest.raises(ValueError, match=f"max_condition is .*, expected up to .* in {np.dtype(dtype).name}"):
        replace(operation, max_condition=1.01 * largest)(rows, device=device)


@VARIANTS
def test_poses_beyond_the_largest_condition_are_wrong(
    device: Device, variant: Any, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the limit there are poses that are off by a tenth of the shift and more, without a flag."""
    monkeypatch.setattr("gpuvision.matching.pose.pose._LEAST_EIGENVALUE", 1e-9)
    shift, rows = parallel_edges(rng, np.float32, 500.0)
    found = SolvePose(loss="least_squares", max_condition=1e5, variant=variant)(rows, device=device)
    error = np.linalg.norm(found.pose[:, :2] - shift, axis=1)
    assert np.any(error[found.status == Status.OK] > 1e-5)


@VARIANTS
def test_a_pose_whose_steps_ended_at_a_singular_matrix_is_refused(
    device: Device, variant: Any, rng: np.random.Generator
) -> None:
    """Three edges of 200 measure x + y, and disagree by 1e7 sigmas: Huber's weights are below 1e-6 for two of them.

    The best pose lies on the third one. No start candidate has it.
    """
    rows = np.zeros((200, 7))
    rows[:, :2], rows[:3, :2] = np.sqrt(0.5), (np.sqrt(0.5), -np.sqrt(0.5))
    rows[:, 2:4], rows[:, 6] = rng.uniform(-0.02, 0.02, (200, 2)), 1e-9
    rows[:3, 4:6] = np.array([[1e-2], [-1e-2], [-5e-3]]) * rows[:3, :2]
    chosen = sample_subsets(200, 3, 16)
    assert chosen.min() > 2
    found = SolvePose(loss="huber", max_trials=16, variant=variant)(rows.astype(np.float32), device=device)
    assert (found.status, found.rank) == (Status.AMBIGUOUS, 3)
    assert found.condition < 20.0
    assert np.isnan(found.pose).all()


@pytest.mark.double
@VARIANTS
def test_refuses_what_nothing_checks(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """Few edges among many determine x: one edge, two edges of which one is wrong, three edges."""
    _, rows = scene(rng, 5, 32)
    rows[:, :, :2] = [0.0, 1.0]
    upright = {0: 1, 1: 2, 2: 4, 3: 4, 4: 4}
    for board, count in upright.items():
        rows[board, :count, :2] = [1.0, 0.0]
    rows[..., 4:6] = rng.normal(0.0, SIGMA, (5, 32, 1)) * rows[..., :2]
    rows[1, 0, 4] += 1e-4
    rows[2, :2, 4] += [1e-4, 2e-4]  # two that agree, of four
    rows[3, 0, 4] += 1e-4  # three that agree, of four
    result = SolvePose(variant=variant)(rows, device=device)
    np.testing.assert_array_equal(result.status, [Status.AMBIGUOUS] * 3 + [Status.OK] * 2)
    # Approximate shares: the rotation uses a part of the information of these edges.
    np.testing.assert_allclose(result.inlier_fraction, [1.0, 0.5, 0.5, 0.75, 1.0], atol=0.1)
    np.testing.assert_allclose(result.leverage[[0, 1]], 1.0, atol=0.01)
    assert (result.leverage[2:] < 0.7).all()
    lenient = SolvePose(max_leverage=1.0, variant=variant)(rows, device=device)
    assert not lenient.status.any()


@pytest.mark.double
def test_refuses_a_pose_out_of_where_was_looked(device: Device, rng: np.random.Generator) -> None:
    truth, rows = scene(rng, 2, 32)
    moved = np.hypot(*(placed(truth)[:, :2] - PLACE).T)
    for shift, turn in ((1.1, 1.1), (0.9, 1.1), (1.1, 0.9)):
        for board in range(2):
            limits = (shift * moved[board], turn * abs(truth[board, 2]))
            result = SolvePose(placement=PLACE, search_range=limits)(rows[board], device=device)
            assert result.status == (Status.OK if shift > 1 < turn else Status.OUT_OF_RANGE)
            assert np.isnan(result.pose).all() == (result.status != Status.OK)


@pytest.mark.double
@VARIANTS
def test_writes_within_its_outputs(device: Device, variant: Any, rng: np.random.Generator) -> None:
    _, rows = scene(rng, 3, 33)
    operation = SolvePose(variant=variant)
    result = operation(rows, device=device)
    guarded = Guarded(result)
    operation(rows, device=device, out=guarded.out)
    guarded.assert_intact()
    for ours, again in zip(result, guarded.out, strict=True):
        np.testing.assert_array_equal(ours, again)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"transform": "shear"}, "transform is 'shear'"),
        ({"loss": "l1"}, "loss is 'l1'"),
        ({"loss": "ransac", "scale": None}, "give the scale"),
        ({"scale": -1.0}, "scale is -1.0"),
        ({"placement": (1.0, 2.0, 3.0)}, "placement"),
        ({"max_trials": 10}, "multiple of 16"),
        ({"min_inlier_fraction": 1.5}, "min_inlier_fraction"),
        ({"max_leverage": 0.0}, "max_leverage"),
        ({"search_range": (1e-3, -0.1)}, "search_range"),
        ({"etch_bias_sigma": 0.0}, "etch_bias_sigma"),
        ({"max_condition": 0.0}, "max_condition"),
        ({"max_iterations": 0}, "max_iterations"),
    ],
)
def test_refuses_parameters(parameters: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SolvePose(**parameters)


def test_refuses_inputs(device: Device) -> None:
    with pytest.raises(TypeError, match="float32 or float64"):
        SolvePose()(np.zeros((8, 7), np.int32), device=device)
    with pytest.raises(ValueError, match="rows"):
        SolvePose()(np.zeros((2, 7)), device=device)
