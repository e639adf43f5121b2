"""BoardPoseEstimator on devices: both variants give the same pose as their parts one by one."""

from __future__ import annotations

import contextlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from canary import Guarded
from gpuvision.host import Device, Trace
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.matching.pose.board_pose import BoardPoseEstimator, FitBoardLines, MeasureBoardEdges, place_rulers
from gpuvision.matching.pose.pose import SolvePose, line_rows
from gpuvision.reference import robust
from gpuvision.status import Status

VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
PIXEL, NOISE = 10e-6, 2.0
SHAPE, PATCH, LINES, EACH = (360, 480), 120, 12, 6
PLACE = (3e-3, -1e-3)
# An oblique camera with y upwards in the image.
MATRIX = np.array([[1.0 / PIXEL, 0.0, 240.0], [0.0, -1.0 / PIXEL, 180.0], [6.0, 3.0, 1.0]])
POSE = np.array([3e-5, -2e-5, 0.006])
ANGLES = np.arange(LINES) * np.pi / LINES + 0.1  # of the normals [rad]


def on_board(points: np.ndarray) -> np.ndarray:
    """Return points on the board's plane for pixels."""
    lifted = np.concatenate([points, np.ones((*points.shape[:-1], 1))], axis=-1) @ np.linalg.inv(MATRIX).T
    return np.asarray(lifted[..., :2] / lifted[..., 2:])


def artwork(angle: np.ndarray = ANGLES) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return normals and points of the lines, one in the middle of each patch, and the offsets of their rulers."""
    middle = [((i % 4 + 0.5) * PATCH, (i // 4 + 0.5) * PATCH) for i in range(LINES)]
    along = np.tile(np.linspace(-20.0, 20.0, EACH) * PIXEL, (LINES, 1))
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1), on_board(np.array(middle)), along


def picture(
    rng: np.random.Generator,
    pose: np.ndarray = POSE,
    shifted: tuple[int, ...] = (),
    shifts_px: np.ndarray | None = None,
    angle: np.ndarray = ANGLES,
) -> np.ndarray:
    """Return an image of the artwork's edges at a pose, each in its patch; some are displaced by 10 px, or as given."""
    normal, point, _ = artwork(angle)
    shift_px = 10.0 * np.isin(np.arange(LINES), shifted) if shifts_px is None else shifts_px
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    matrix, shift = robust.transform_of(pose)
    back = (on_board(np.stack([column, row], axis=-1)) - shift) @ np.linalg.inv(matrix).T
    which = row // PATCH * 4 + column // PATCH
    away = np.sum((back - point[which]) * normal[which], axis=-1) / PIXEL - shift_px[which]
    image = 100.0 + 50.0 * np.tanh(away / 1.3) + rng.normal(0.0, NOISE, SHAPE)
    return np.rint(image).astype(np.uint8)


def operation(variant: Any = "auto", **more: Any) -> BoardPoseEstimator:
    ruler = RulerEdges(threshold=20.0, length=48, width=5, smoothing_px=2.0, noise=NOISE, variant=variant)
    return BoardPoseEstimator(ruler=ruler, lines=LINES, rulers_per_line=EACH, solver=SolvePose(placement=PLACE, **more))


def board_rulers(sigma: float = 0.0, angle: np.ndarray = ANGLES) -> tuple[np.ndarray, np.ndarray]:
    normal, point, along = artwork(angle)
    return place_rulers(normal, point, along, MATRIX, sigma)


def error(result: Any, pose: np.ndarray = POSE) -> np.ndarray:
    matrix, shift = robust.transform_of(pose)
    return np.array([*(result.placement - (matrix @ PLACE + shift)), result.pose[2] - pose[2]])


def test_rulers_lie_where_they_say() -> None:
    rulers, lines = board_rulers()
    normal, point, along = artwork()
    for s in (-20.0, 0.0, 20.0):
        seen = on_board(rulers[..., :2].astype(float) + s * rulers[..., 2:4])
        per = 1.0 / (1.0 + s * rulers[..., 8])
        u, v = (rulers[..., 4] + s * rulers[..., 6]) * per, (rulers[..., 5] + s * rulers[..., 7]) * per
        direction = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)
        expected = point[:, None] + u[..., None] * direction[:, None] + v[..., None] * normal[:, None]
        # The centres are rounded to a float: 3e-5 px.
        np.testing.assert_allclose(expected, seen, atol=1e-9)
        assert (np.sign(v) == np.sign(s)).all() or s == 0.0
    np.testing.assert_allclose(lines[:, 2:4], point, atol=1e-9)
    np.testing.assert_allclose(rulers[..., 4], along, atol=1e-9)


@VARIANTS
def test_rulers_that_find_nothing(device: Device, variant: Any, rng: np.random.Generator) -> None:
    image, (rulers, lines) = picture(rng), board_rulers()
    image[:120, 0:120] = 90
    rulers[1, 2:] = np.nan
    rulers[2, 1:] = np.nan
    rulers[3, 0, :2] = [-50.0, 20.0]
    result = operation(variant)(image, rulers, lines, device=device)
    assert result.status == Status.OK
    np.testing.assert_array_equal(result.edge_status[0], Status.LOW_SIGNAL)
    np.testing.assert_array_equal(result.edge_status[1, 2:], Status.NOT_FINITE)
    assert result.edge_status[3, 0] == Status.OUT_OF_RANGE
    assert np.isnan(result.edges[0]).all()
    assert np.isnan(result.residuals[0]).all()
    # One edge is one row.
    np.testing.assert_array_equal(np.isfinite(result.residuals[1:4]), [[True, True], [True, False], [True, True]])
    assert not result.edge_weights[0].any()
    assert (np.abs(error(result)) < 5.0 * np.sqrt(np.diag(result.covariance))).all()


@pytest.mark.double
@VARIANTS
def test_as_its_parts(device: Device, variant: Any, rng: np.random.Generator) -> None:
    image, (rulers, lines) = picture(rng), board_rulers()
    fix = operation(variant)
    result = fix(image, rulers, lines, device=device)
    assert result.status == Status.OK
    plain = np.ascontiguousarray(rulers[..., :4].reshape(-1, 4))
    edges = fix.ruler(image, plain, device=device)
    np.testing.assert_allclose(result.edges.ravel(), edges.position, atol=1e-4)
    np.testing.assert_array_equal(result.edge_status.ravel(), edges.status)
    # Without outliers the pose from lines agrees with the pose from all edges, up to small differences of the weights.
    seen = on_board(plain[:, :2] + edges.position[:, None] * plain[:, 2:].astype(float))
    normal, point, _ = artwork()
    sigma = edges.sigma.astype(float) * PIXEL
    rows = line_rows(np.repeat(normal, EACH, axis=0), np.repeat(point, EACH, axis=0), seen, sigma)
    whole = SolvePose(placement=PLACE, max_trials=256)(rows, device=device)
    deviation = np.sqrt(np.diag(whole.covariance))
    assert (np.abs(result.placement - whole.placement) < 0.3 * deviation[:2]).all()
    assert abs(result.pose[2] - whole.pose[2]) < 0.3 * deviation[2]
    np.testing.assert_allclose(np.sqrt(np.diag(result.covariance)), deviation, rtol=0.1)


@VARIANTS
@pytest.mark.parametrize("loss", ["tukey", "huber"])
def test_fits_that_have_not_converged(device: Device, variant: Any, loss: Any, rng: np.random.Generator) -> None:
    """One iteration flags most poses and some lines, and keeps their values; twelve flag none."""
    flags = {1: [], 12: []}
    for steps, found in flags.items():
        for _ in range(6):
            fix = operation(variant, max_iterations=steps, loss=loss)
            result = fix(picture(rng, shifted=(2,)), *board_rulers(), device=device)
            assert np.isfinite(result.pose).all()
            found.append((int(result.status), *result.line_status.tolist()))
    assert set(np.ravel(flags[1])) == {0, int(Status.NOT_CONVERGED)}
    assert np.count_nonzero(np.array(flags[1])[:, 0]) >= 2
    assert np.count_nonzero(np.array(flags[1])[:, 1:]) >= 3
    assert not np.any(flags[12])


@VARIANTS
def test_forty_lines_of_one_ruler(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """More lines than work-items of a group, and lines without an angle of their own."""
    normal, point, along = artwork()
    direction = np.stack([normal[:, 1], -normal[:, 0]], axis=-1)
    at = (point[:, None] + along[..., None] * direction[:, None]).reshape(-1, 2)
    which = np.linspace(0, LINES * EACH - 1, 40).astype(int)
    rulers, lines = place_rulers(np.repeat(normal, EACH, axis=0)[which], at[which], np.zeros((40, 1)), MATRIX)
    fix = replace(operation(variant), lines=40, rulers_per_line=1)
    result = fix(picture(rng), rulers, lines, device=device)
    assert result.status == Status.OK
    np.testing.assert_array_equal(result.edge_status, Status.OK)
    assert result.rank == 3
    assert (np.abs(error(result)) < 5.0 * np.sqrt(np.diag(result.covariance))).all()


@pytest.mark.slow
@VARIANTS
def test_a_large_board(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """300 lines of 4 rulers: no kernel of the work-item variant takes more than 32 KiB of local memory."""
    normal, point, _ = artwork()
    which = np.arange(300) % LINES
    offsets = (np.arange(300) // LINES * 1.5 - 18.0)[:, None] + np.array([-3.0, -1.0, 1.0, 3.0])
    rulers, lines = place_rulers(normal[which], point[which], offsets * PIXEL, MATRIX)
    fix = replace(operation(variant), lines=300, rulers_per_line=4)
    result = fix(picture(rng), rulers, lines, device=device)
    assert result.status == Status.OK
    # The rulers overlap, so that their errors are not independent: a thirtieth of a pixel, and that over 3 mm.
    assert (np.abs(error(result)) < (3e-7, 3e-7, 1e-4)).all()
    if variant == "work_item":
        bound: Any = fix.bind(device, SHAPE, np.uint8)
        for stage in bound.stages.values():
            _, kernel, _, _ = stage.enqueue_arguments
            info = cl.kernel_work_group_info.LOCAL_MEM_SIZE
            assert kernel.get_work_group_info(info, device.queue.device) <= 32768


@pytest.mark.parametrize("variant", ["work_item"])
def test_odd_numbers_of_rulers_stay_within_the_outputs(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """9 lines of 5 rulers: groups of four rulers, the last one with a single ruler; capacities as of other tests."""
    normal, point, along = artwork()
    placed = place_rulers(normal[:9], point[:9], along[:9, :5], MATRIX)
    fix = replace(operation(variant), lines=9, rulers_per_line=5)
    image = picture(rng)
    result = fix(image, *placed, device=device)
    assert result.status == Status.OK
    guarded = Guarded(result)
    fix(image, *placed, device=device, out=guarded.out)
    guarded.assert_intact()
    np.testing.assert_array_equal(guarded.out.pose, result.pose)


@pytest.mark.slow
@VARIANTS
def test_covariance_is_what_is_measured(device: Device, variant: Any, rng: np.random.Generator) -> None:
    fix, (rulers, lines) = operation(variant), board_rulers()
    found, covariance = [], []
    for number in range(60):
        pose = np.array([*rng.uniform(-5e-5, 5e-5, 2), rng.uniform(-0.01, 0.01)])
        result = fix(picture(rng, pose, (number % LINES,)), rulers, lines, device=device)
        assert result.status == Status.OK
        # The displaced line has weight 0.
        assert not result.weights[number % LINES].any()
        found.append(error(result, pose))
        covariance.append(result.covariance)
    deviation = np.sqrt(np.mean(covariance, axis=0)[[0, 1, 2], [0, 1, 2]])
    # Sixty draws determine a standard deviation to 9 %.
    ratio = np.std(found, axis=0) / deviation
    assert (ratio < 1.3).all()
    assert (ratio > 0.7).all()
    squares = np.einsum("bi,bij,bj->b", np.array(found), np.linalg.inv(covariance), np.array(found))
    assert squares.max() < 49.0


def largest_leverages(
    fix: BoardPoseEstimator, image: np.ndarray, placed: tuple[np.ndarray, np.ndarray], weights: Any, device: Device
) -> tuple[float, float]:
    """Return the largest leverage of a row and of a line, from the hat matrix of the rows with a weight."""
    measure = MeasureBoardEdges(
        ruler=replace(fix.ruler, variant="work_item"), lines=fix.lines, rulers_per_line=fix.rulers_per_line
    )
    edges = measure(image, placed[0], device=device)
    rows = FitBoardLines(solver=fix.solver)(edges.places, edges.sigmas, placed[1], device=device).rows.astype(float)
    nx, ny, x, y, _, _, sigma = rows.T
    x, y = 1e3 * (x - x.mean()), 1e3 * (y - y.mean())
    jacobian = np.where(weights.reshape(-1, 1) > 0.0, np.column_stack([nx, ny, ny * x - nx * y]) / sigma[:, None], 0.0)
    hat = jacobian @ np.linalg.pinv(jacobian)
    of_lines = [np.linalg.eigvalsh(hat[i : i + 2, i : i + 2])[-1] for i in range(0, len(hat), 2)]
    return float(np.diag(hat).max()), float(max(of_lines))


@VARIANTS
def test_two_rows_of_a_line_do_not_check_each_other(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """Another board: only half of the lines agree, by chance, three in each direction."""
    angle = np.where(np.arange(LINES) % 2, 0.02, 0.5 * np.pi - 0.03)
    shifts_px = np.array([1.5, 1.5, 1.5, 1.5, 5.0, -3.0, -3.0, 5.0, -5.0, 3.0, 1.5, 1.5])
    image, placed = picture(rng, shifts_px=shifts_px, angle=angle), board_rulers(angle=angle)
    fix = operation(variant, max_trials=256)
    refused = fix(image, *placed, device=device)
    assert refused.status == Status.AMBIGUOUS
    assert np.isnan(refused.pose).all()
    # Without the limit of leverage the pose is accepted. Two rows check each row, but one of them is of the same line.
    lenient = operation(variant, max_trials=256, max_leverage=1.0)
    found = lenient(image, *placed, device=device)
    assert found.status == Status.OK
    np.testing.assert_array_equal((found.weights > 0.0).all(axis=1), shifts_px == 1.5)
    of_row, of_line = largest_leverages(lenient, image, placed, found.weights, device)
    assert of_row < 0.95 / 2 < of_line
    np.testing.assert_allclose([refused.leverage, found.leverage], of_line, rtol=0.01)


@VARIANTS
def test_a_majority_of_the_lines_gives_the_pose(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """Four displaced lines of twelve: rows are checked one by one, although a line has a high leverage."""
    shifts_px = np.zeros(LINES)
    shifts_px[::3] = [-3.0, 2.0, 4.0, -5.0]
    image, placed = picture(rng, shifts_px=shifts_px), board_rulers()
    fix = operation(variant, max_trials=256)
    result = fix(image, *placed, device=device)
    assert result.status == Status.OK
    np.testing.assert_array_equal((result.weights > 0.0).all(axis=1), shifts_px == 0.0)
    of_row, of_line = largest_leverages(fix, image, placed, result.weights, device)
    assert of_row < 0.95 / 2 < of_line
    np.testing.assert_allclose(result.leverage, of_row, rtol=0.01)
    assert (np.abs(error(result)) < 5.0 * np.sqrt(np.diag(result.covariance))).all()


@VARIANTS
def test_refuses(device: Device, variant: Any, rng: np.random.Generator) -> None:
    rulers, lines = board_rulers()
    fix = operation(variant)
    dark = fix(np.full(SHAPE, 90, np.uint8), rulers, lines, device=device)
    assert dark.status == Status.NO_DATA
    assert np.isnan(dark.pose).all()
    assert np.isnan(dark.covariance).all()
    # All lines in one direction.
    one = place_rulers(np.tile([[0.0, 1.0]], (LINES, 1)), artwork()[1], artwork()[2], MATRIX)
    level = rng.normal(90.0, 1.0, SHAPE) + 60.0 * (np.arange(SHAPE[0])[:, None] % PATCH > PATCH // 2)
    parallel = fix(level.astype(np.uint8), *one, device=device)
    assert parallel.status == Status.AMBIGUOUS
    assert parallel.rank < 3
    assert np.isnan(parallel.placement).all()


def test_place_of_lines_on_the_board(device: Device, rng: np.random.Generator) -> None:
    """The position error of a line on the board limits its weight."""
    image, (rulers, lines) = picture(rng), board_rulers(1e-6)
    result = operation()(image, rulers, lines, device=device)
    # Two rows of a line, 24 in all: about sigma^2 / 12 in each direction, taken for independent.
    assert np.sqrt(result.covariance[0, 0]) > 1e-6 / np.sqrt(12)


@VARIANTS
def test_a_trace_records_the_launches(device: Device, variant: Any, rng: np.random.Generator, tmp_path: Path) -> None:
    with Trace(tmp_path / "trace.json"):
        operation(variant)(picture(rng), *board_rulers(), device=device)
    events = json.loads((tmp_path / "trace.json").read_text())["traceEvents"]
    found = {(each["name"], each["args"].get("of")) for each in events}
    assert ("run", "BoardPoseEstimator") in found


def test_work_items_have_no_single_launch() -> None:
    with pytest.raises(ValueError, match="three launches"):
        operation("work_item").launch(Device.best(), SHAPE, np.dtype(np.uint8))


def test_writes_within_its_outputs(device: Device, rng: np.random.Generator) -> None:
    image, (rulers, lines) = picture(rng), board_rulers()
    result = operation()(image, rulers, lines, device=device)
    guarded = Guarded(result)
    operation()(image, rulers, lines, device=device, out=guarded.out)
    guarded.assert_intact()


@pytest.mark.parametrize(
    ("lines", "each", "refused"),
    [(3, 1, False), (512, 4, False), (8, 256, False), (1, 1, True), (513, 1, True), (2, 0, True), (2, 257, True)],
)
def test_counts_of_lines_and_rulers_have_inclusive_limits(lines: int, each: int, refused: bool) -> None:
    """2 to 512 lines, 1 to 256 rulers on each."""
    with pytest.raises(ValueError, match="expected") if refused else contextlib.nullcontext():
        BoardPoseEstimator(ruler=RulerEdges(threshold=20.0), lines=lines, rulers_per_line=each)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"lines": 1}, "lines is 1"),
        ({"rulers_per_line": 0}, "rulers_per_line is 0"),
        ({"lines": 500, "rulers_per_line": 100}, "up to 2048"),
        ({"ruler": RulerEdges(threshold=20.0, edge_selection="all")}, "edge_selection='all'"),
        ({"solver": SolvePose(with_initial_pose=True)}, "no pose to start from"),
        ({"lines": 2, "solver": SolvePose(transform="affine")}, "too few"),
    ],
)
def test_refuses_parameters(more: dict[str, Any], message: str) -> None:
    given = {"ruler": RulerEdges(threshold=20.0), "lines": 10, "rulers_per_line": 10} | more
    with pytest.raises(ValueError, match=message):
        BoardPoseEstimator(**given)


@pytest.mark.parametrize("more", [{"ruler": None}, {"solver": None}, {"ruler": SolvePose()}])
def test_refuses_other_operations(more: dict[str, Any]) -> None:
    given = {"ruler": RulerEdges(threshold=20.0), "lines": 10, "rulers_per_line": 10} | more
    with pytest.raises(TypeError, match="takes a RulerEdges as ruler and a SolvePose as solver"):
        BoardPoseEstimator(**given)
