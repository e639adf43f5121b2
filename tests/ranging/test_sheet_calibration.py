"""Sheet of light from laser lines on targets: bend test, outliers, noise, and refusals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gpuvision.camera.camera import Camera
from gpuvision.camera.views.camera_fit import Pose
from gpuvision.camera.views.pose_response import PoseResponse, change_camera
from gpuvision.ranging import sheet_calibration
from gpuvision.ranging.sheet_calibration import _system, fit_sheet
from gpuvision.ranging.sheet_readings import DEFAULT_LIMITS, LaserLine, SheetFrame
from gpuvision.ranging.sheet_result import SheetFit
from laser_sensor import LaserSensor, on_stage, poses, readings, sensor

TRUTH = sensor(20.0)
BENT = sensor(20.0, (0.05, 0.0, -0.03))


def camera_of(truth: LaserSensor) -> Camera:
    rows = tuple(tuple(row) for row in truth.matrix.tolist())
    return Camera(matrix=rows, distortion=tuple(truth.distortion.tolist()))


def lines_of(truth: LaserSensor, rng: np.random.Generator, count: int = 8, sigma: float = 0.1) -> list[LaserLine]:
    """Return noisy lines on targets of known pose; the poses count as known to 1 um and 10 urad."""
    known = np.diag([1e-10] * 3 + [1e-12] * 3)
    lines = []
    for rotation, translation in poses(truth, rng, count):
        points = readings(truth, rotation, translation)
        points[:, 1] += rng.normal(0.0, sigma, len(points))
        lines.append(LaserLine(points, PoseResponse(Pose(rotation, translation), known, np.zeros((6, 0)))))
    return lines


def errors_of(found: SheetFit, truth: LaserSensor) -> np.ndarray:
    """Return offset, slopes and, for a bent fit, bends of the true sheet in the frame of the found one."""
    flat = np.stack(np.meshgrid(np.linspace(-0.05, 0.05, 9), np.linspace(-0.03, 0.03, 9)), axis=-1).reshape(-1, 2)
    return parameters_of(found, truth.surface(flat))


def parameters_of(found: SheetFit, points: np.ndarray) -> np.ndarray:
    """Return the parameters of a surface through points, in the frame of a sheet and less its bend."""
    offset = points - found.origin
    g, h, d = (offset @ np.stack([found.g_axis, found.h_axis, found.normal]).T).T
    gg, gh, hh = found.bend or (0.0, 0.0, 0.0)
    d = d - (gg * g * g + gh * g * h + hh * h * h)
    basis = np.stack([np.ones_like(g), g, h, g * g, g * h, h * h], axis=1)[:, : len(found.names)]
    return np.linalg.lstsq(basis, d, rcond=None)[0]


@pytest.mark.parametrize("truth", [TRUTH, BENT], ids=["plane", "bent"])
def test_sheet_is_found_within_its_sigma(truth: LaserSensor, rng: np.random.Generator) -> None:
    found = fit_sheet(camera_of(truth), lines_of(truth, rng))
    assert (found.bend is None) == (truth is TRUTH)
    error = errors_of(found, truth)
    assert error @ np.linalg.solve(found.covariance(np.zeros((0, 0))), error) < 23.0  # 0.1 % of six normal numbers
    assert found.sigma_px == pytest.approx(0.1, rel=0.1)
    assert found.rms_px == pytest.approx(0.1, rel=0.1)
    assert found.g_axis @ truth.g > 0.99
    assert found.h_axis @ truth.h > 0.99
    assert found.view_ratio < 3.0


def test_bend_is_found_and_tested(rng: np.random.Generator) -> None:
    bent = fit_sheet(camera_of(BENT), lines_of(BENT, rng)).bend_test
    flat = fit_sheet(camera_of(TRUTH), lines_of(TRUTH, rng)).bend_test
    assert bent is not None
    assert flat is not None
    assert bent.significant
    assert not flat.significant
    assert flat.p_value > 1e-3 > bent.p_value
    # A rotation of the axes in the sheet keeps gg + hh.
    assert bent.bend[0] + bent.bend[2] == pytest.approx(0.02, abs=4.0 * np.hypot(bent.sigma[0], bent.sigma[2]))


def test_reflections_are_rejected(rng: np.random.Generator) -> None:
    """A tenth of the readings 1 to 40 px off, ten standard deviations and more, and one view with a third of them."""
    lines = lines_of(TRUTH, rng)
    clean = fit_sheet(camera_of(TRUTH), lines)
    wrong = 0
    for number, (points, _, _) in enumerate(lines):
        chosen = rng.random(len(points)) < (0.33 if number == 0 else 0.1)
        points[chosen, 1] -= rng.uniform(1.0, 40.0, np.count_nonzero(chosen)) ** rng.choice(
            [0.2, 1.0], np.count_nonzero(chosen)
        )
        wrong += np.count_nonzero(chosen)
    found = fit_sheet(camera_of(TRUTH), lines)
    assert found.bend is None
    assert wrong <= found.outliers < wrong + 60
    np.testing.assert_allclose(found.normal, clean.normal, atol=5e-5)
    assert abs((found.origin - clean.origin) @ clean.normal) < 5e-6


def test_wrong_poses_widen_the_uncertainty(rng: np.random.Generator) -> None:
    """Targets displaced by much more than their covariance: the views disagree, and the sigmas follow."""
    lines = lines_of(TRUTH, rng)
    moved = [
        LaserLine(points, target._replace(pose=Pose(target.pose[0], target.pose[1] + rng.normal(0.0, 1e-4, 3))))
        for points, target, _ in lines
    ]
    known, doubtful = fit_sheet(camera_of(TRUTH), lines), fit_sheet(camera_of(TRUTH), moved)
    assert doubtful.view_ratio > 10.0 * known.view_ratio
    assert doubtful.bend is None
    error = errors_of(doubtful, TRUTH)
    assert error @ np.linalg.solve(doubtful.covariance(np.zeros((0, 0))), error) < 23.0


def test_derivative_by_the_camera_predicts_another_fit(rng: np.random.Generator) -> None:
    """Another k1, and poses that follow it: the sheet moves by its derivative, in the frame of the first fit."""
    change, camera = 2e-3, camera_of(BENT)
    first, second = [], []
    for points, target, _ in lines_of(BENT, rng, sigma=0.01):
        response = rng.normal(size=(6, 1)) * np.array([[0.05], [0.05], [0.05], [0.01], [0.01], [0.01]])
        rotation, translation = target.pose
        turn = Rotation.from_rotvec(change * response[:3, 0]).as_matrix()
        first.append(LaserLine(points, target._replace(by_camera=response)))
        moved = Pose(turn @ rotation, translation + change * response[3:, 0])
        second.append(LaserLine(points, target._replace(pose=moved)))
    fit = fit_sheet(camera, first, names=("k1",), camera_covariance=[[1e-12]])
    other = fit_sheet(change_camera(camera, "k1", change), second)
    flat = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 5), np.linspace(-0.02, 0.02, 5)), axis=-1).reshape(-1, 2)
    assert other.bend is not None
    h, g, d = flat[:, 1], flat[:, 0], flat**2 @ np.array(other.bend)[[0, 2]] + other.bend[1] * flat.prod(axis=1)
    places = other.origin + np.outer(g, other.g_axis) + np.outer(h, other.h_axis) + np.outer(d, other.normal)
    moved_by = parameters_of(fit, places)
    np.testing.assert_allclose(moved_by, change * fit.by_camera[:, 0], rtol=0.05, atol=2e-6)
    assert np.abs(moved_by[:3]).min() > 2e-6


def test_stepped_block_on_one_plane_gives_the_sheet(rng: np.random.Generator) -> None:
    """Steps of known heights over one plane, which share the error of its pose."""
    rotation, translation = on_stage(TRUTH, 0.0)
    towards = -rotation[:, 2] * np.sign(rotation[:, 2] @ translation)
    points, heights = [], []
    for number, height in enumerate((0.0, 0.02, 0.01)):
        rows = TRUTH.line(rotation[:, 2], translation + height * towards)
        columns = np.arange(120.0, 200.0) + 80.0 * number
        points.append(np.stack([columns, rows[columns.astype(int)] + rng.normal(0.0, 0.1, 80)], axis=1))
        heights.append(np.full(80, height))
    known = np.diag([1e-10] * 3 + [1e-12] * 3)
    target = PoseResponse(Pose(rotation, translation), known, np.zeros((6, 0)))
    line = LaserLine(np.concatenate(points), target, np.concatenate(heights))
    found = fit_sheet(camera_of(TRUTH), [line])
    assert found.bend is None
    error = errors_of(found, TRUTH)
    assert error @ np.linalg.solve(found.covariance(np.zeros((0, 0))), error) < 16.3
    assert abs(found.normal @ TRUTH.normal) > np.cos(np.radians(1.0))
    with pytest.raises(ValueError, match="read on 1 targets"):
        fit_sheet(camera_of(TRUTH), [LaserLine(points[0], target, 0.01)])


def test_one_target_or_parallel_lines_in_one_place_are_refused(rng: np.random.Generator) -> None:
    lines = lines_of(TRUTH, rng, 2)
    with pytest.raises(ValueError, match="read on 1 targets, expected two"):
        fit_sheet(camera_of(TRUTH), lines[:1])
    with pytest.raises(ValueError, match="lie on one line in space"):
        fit_sheet(camera_of(TRUTH), [lines[0], lines[0]])


def test_lines_of_other_targets_are_refused(rng: np.random.Generator) -> None:
    lines = lines_of(TRUTH, rng)
    mixed = [LaserLine(line.points, other.target) for line, other in zip(lines, lines[3:] + lines[:3], strict=True)]
    with pytest.raises(ValueError, match="lie on no common sheet"):
        fit_sheet(camera_of(TRUTH), mixed)


def block_line(rng: np.random.Generator, target: PoseResponse) -> LaserLine:
    """Return a noisy line on three steps over the true stage, with the pose of a target for the stage."""
    rotation, translation = on_stage(TRUTH, 0.0)
    towards = -rotation[:, 2] * np.sign(rotation[:, 2] @ translation)
    points, heights = [], []
    for number, height in enumerate((0.0, 0.02, 0.01)):
        rows = TRUTH.line(rotation[:, 2], translation + height * towards)
        columns = np.arange(120.0, 200.0) + 80.0 * number
        points.append(np.stack([columns, rows[columns.astype(int)] + rng.normal(0.0, 0.05, 80)], axis=1))
        heights.append(np.full(80, height))
    return LaserLine(np.concatenate(points), target, np.concatenate(heights))


def test_lines_on_one_pose_share_its_error(rng: np.random.Generator) -> None:
    """Four lines on a block whose pose is in error: they do not reduce its part of the sheet's error."""
    covariance = np.diag([1e-6] * 3 + [1e-8] * 3)
    rotation, translation = on_stage(TRUTH, 0.0)
    chi_squares, ratios = [], []
    for _ in range(12):
        turn, shift = np.split(np.sqrt(np.diag(covariance)) * rng.normal(size=6), 2)
        pose = Pose(Rotation.from_rotvec(turn).as_matrix() @ rotation, translation + shift)
        target = PoseResponse(pose, covariance, np.zeros((6, 0)))
        found = fit_sheet(camera_of(TRUTH), [block_line(rng, target) for _ in range(4)])
        error = errors_of(found, TRUTH)[:3]
        chi_squares.append(error @ np.linalg.solve(found.covariance(np.zeros((0, 0)))[:3, :3], error))
        ratios.append(found.view_ratio)
    # Chi-square with 3 degrees of freedom: variance 6 per draw.
    assert 1.0 < np.mean(chi_squares) < 3.0 + 4.0 * np.sqrt(6.0 / 12)
    assert np.mean(ratios) < 1.5


def test_readings_without_a_ray_are_left_out(rng: np.random.Generator) -> None:
    """Readings past the fold of the lens, where the camera has no ray: outliers, and the same sheet."""
    truth = replace(TRUTH, distortion=np.array([-0.15, *TRUTH.distortion[1:] * np.r_[0.0, np.ones(12)]]))
    lines = lines_of(truth, rng)
    clean = fit_sheet(camera_of(truth), lines)
    past = np.full((5, 2), 1e5)
    assert np.isnan(camera_of(truth).rays(past)).all()
    found = fit_sheet(camera_of(truth), [lines[0]._replace(points=np.concatenate([lines[0].points, past])), *lines[1:]])
    assert found.outliers == clean.outliers + 5
    assert np.isnan(found.residuals[0][-5:]).all()
    np.testing.assert_allclose(found.origin, clean.origin, rtol=1e-9)
    np.testing.assert_allclose(found.noise_covariance, clean.noise_covariance, rtol=1e-6, atol=1e-30)


def test_lines_with_few_readings_are_left_out(rng: np.random.Generator) -> None:
    lines = lines_of(TRUTH, rng)
    clean = fit_sheet(camera_of(TRUTH), lines[1:])
    found = fit_sheet(camera_of(TRUTH), [lines[0]._replace(points=lines[0].points[:15]), *lines[1:]])
    assert [len(each) for each in found.residuals] == [15, *(len(each) for each in clean.residuals)]
    assert np.isnan(found.residuals[0]).all()
    np.testing.assert_allclose(found.origin, clean.origin, rtol=1e-9)
    np.testing.assert_allclose(found.noise_covariance, clean.noise_covariance, rtol=1e-6, atol=1e-30)


def test_the_fit_ends_when_the_noise_does_not_change(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """The iterations of the robust fit converge within a limit; more iterations would not change the sheet."""
    calls = 0

    def counted(*arguments: object) -> object:
        nonlocal calls
        calls += 1
        return _system(*arguments)

    monkeypatch.setattr(sheet_calibration, "_system", counted)
    lines = lines_of(TRUTH, rng)
    fits, counts = [], []
    for max_iterations in (DEFAULT_LIMITS.max_iterations, 3 * DEFAULT_LIMITS.max_iterations):
        calls = 0
        fits.append(fit_sheet(camera_of(TRUTH), lines, limits=replace(DEFAULT_LIMITS, max_iterations=max_iterations)))
        counts.append(calls)
    assert counts[0] == counts[1]
    np.testing.assert_array_equal(fits[0].origin, fits[1].origin)
    assert fits[0].converged
    assert not fit_sheet(camera_of(TRUTH), lines, limits=replace(DEFAULT_LIMITS, max_iterations=1)).converged


def test_derivatives_of_the_distances(rng):
    """A change of a ray, of a target's pose and of the bend moves the distance from a bent sheet as stated.

    The point of a reading is the intersection of its ray with the plane of its target.
    """
    frame = SheetFrame(np.array([0.01, -0.02, 0.4]), Rotation.from_rotvec([0.3, -0.4, 0.2]).as_matrix())
    bend = np.array([2.0, -3.0, 1.5])
    view = np.array([0, 1, 1, 0, 1])
    ray = rng.normal([0.0, 0.0, 1.0], 0.2, (5, 3))
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    normals, places = rng.normal([0.2, -0.1, -1.0], 0.2, (2, 3)), rng.normal([0.0, 0.0, 0.4], 0.05, (2, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    slope, by_camera = rng.normal(size=(5, 3)), rng.normal(size=(5, 3, 2))

    def distances(ray: np.ndarray, normals: np.ndarray, places: np.ndarray, bend: np.ndarray = bend) -> np.ndarray:
        normal = normals[view]
        share = np.sum(normal * places[view], axis=1) / np.sum(normal * ray, axis=1)
        g, h, d = frame.axes @ (share[:, None] * ray - frame.origin).T
        return d - (bend[0] * g * g + bend[1] * g * h + bend[2] * h * h)

    def slopes(change) -> np.ndarray:
        return (change(1e-6) - change(-1e-6)) / 2e-6

    share = np.sum(normals[view] * places[view], axis=1) / np.sum(normals[view] * ray, axis=1)
    lines = tuple(SimpleNamespace(target=SimpleNamespace(pose=SimpleNamespace(translation=each))) for each in places)
    readings = SimpleNamespace(
        lines=lines,
        view=view,
        ray=ray,
        slope=slope,
        by_camera=by_camera,
        point=share[:, None] * ray,
        normal=normals[view],
    )
    found = _system(frame, bend, readings, 6)
    np.testing.assert_allclose(found.distance, distances(ray, normals, places), rtol=1e-12)
    np.testing.assert_allclose(
        found.by_pixel, slopes(lambda e: distances(ray + e * slope, normals, places)), rtol=1e-6, atol=1e-9
    )
    for number in range(2):
        expected = slopes(lambda e, n=number: distances(ray + e * by_camera[..., n], normals, places))
        np.testing.assert_allclose(found.by_camera[:, number], expected, rtol=1e-6, atol=1e-9)
    for axis, unit in enumerate(np.eye(3)):
        turned = slopes(lambda e, w=unit: distances(ray, normals + e * np.cross(w, normals), places))
        np.testing.assert_allclose(found.by_pose[:, axis], turned, rtol=1e-6, atol=1e-9)
        moved = slopes(lambda e, t=unit: distances(ray, normals, places + e * t))
        np.testing.assert_allclose(found.by_pose[:, 3 + axis], moved, rtol=1e-6, atol=1e-9)
        bent = slopes(lambda e, b=unit: distances(ray, normals, places, bend + e * b))
        np.testing.assert_allclose(found.design[:, 3 + axis], -bent, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(found.design[:, 0], 1.0)
    np.testing.assert_array_equal(found.design[:, 1:3], found.flat)
    np.testing.assert_allclose(found.flat, (readings.point - frame.origin) @ frame.axes[:2].T, rtol=1e-12)
    assert _system(frame, bend, readings, 3).design.shape == (5, 3)
