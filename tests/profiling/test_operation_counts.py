"""Stated numbers of operations, compared with counts of the same methods in Python (`counted`).

The other forms place samples, solve small systems and take powers in other ways: most counts differ by less than 30 %.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("numba", reason="the extra 'profile' is not installed")

from counted import operations_of
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device
from gpuvision.matching.robust import sample_subsets
from gpuvision.profiling import adaptive_shadow_rays as adaptive
from gpuvision.profiling import (
    blob,
    blob_peers,
    board_image,
    board_pose,
    deposits,
    feature_pose,
    field_pose,
    line,
    line_fit,
    line_irradiance,
    numba_cache,
    occluded_irradiance,
    pose,
    ray_visits,
    reflectance,
    ruler,
    ruler_peers,
    undistort_image,
    undistort_points,
)
from gpuvision.reference import rays as reference_rays
from gpuvision.reference.camera import distort_pixels
from gpuvision.simulation.scene.bvh import GPU_WIDTH, WIDTH, Bvh
from gpuvision.simulation.scene.reflectance import Ggx, Ward

F = np.float32


def agree(stated, found, within=0.3):
    assert abs(stated / found - 1.0) <= within, f"stated {stated:.0f}, counted {found}"


def numbers_of_numba(noise=1.0):
    return np.array([ruler._LEAST * ruler_peers.WIDTH, ruler._VARIANCE, noise], F)


def test_the_counter_counts_elements_of_real_results():
    def function(a, n):
        total = np.zeros(3)
        total += a * a  # 6
        total[0] -= np.sqrt(a[0]) / 2.0  # 3
        return total, n * n, -a, 2.0 * np.pi

    function.__module__ = "gpuvision.example"
    assert operations_of(function, np.ones(3), 4) == 9


def test_line_fit():
    points, sigma = line_fit.scene(20)
    u, v = (points[0, :, k] - points[0, 0, k] for k in (0, 1))
    pairs = sample_subsets(20, 2, line_fit.TRIALS)
    agree(line_fit.fit_flops(20, len(pairs)), operations_of(line_fit.fit_line, u, v, 1 / sigma[0], pairs))


@pytest.mark.parametrize("count", [20, 60])
def test_pose(count):
    rows, starts = pose.edge_rows(count).T.copy(), sample_subsets(count, 3, line_fit.TRIALS)
    rows[6] = 1 / rows[6]
    out = np.empty(3, F), np.empty((3, 3), F)
    found = operations_of(pose.fit_pose, rows, starts, np.array(pose.PLACEMENT, F), *out)
    agree(pose.fit_flops(count, len(starts)), found)


@pytest.mark.parametrize("unknowns", [3, 8])
def test_normal_equations(unknowns):
    matrix, right = np.eye(unknowns, dtype=F), np.ones(unknowns, F)
    if unknowns == blob_peers.UNKNOWNS:
        agree(pose.factor_flops(unknowns), operations_of(blob_peers.factor, matrix), 0.1)
        agree(pose.solve_flops(unknowns), operations_of(blob_peers.solve, matrix, right, right.copy()), 0.01)
    lower = sum(unknowns - k for k in range(unknowns))
    assert pose.add_flops(unknowns) == unknowns + 2 * (lower + unknowns)  # products with the weight; sums


def test_ruler():
    """The peers do not correct the bias of the interpolation: the correction in float64 is counted apart."""
    image, rulers = ruler.scene(1)
    call = next(call for _, name, call, _, _ in ruler.numba_calls(image, rulers) if name == "pairs-serial")
    found = operations_of(call.func, *call.args) + operations_of(
        ruler._corrected, rulers.astype(float), np.zeros(1), np.ones(1)
    )
    agree(ruler.ruler_flops(ruler.LENGTH, ruler.WIDTH, ruler.REACH), found)


def test_board_pose():
    image, rulers, lines = board_pose.scene()
    flat, plain = rulers.reshape(-1, rulers.shape[-1]), np.ascontiguousarray(rulers[..., :4].reshape(-1, 4))
    pairs = sample_subsets(board_pose.EACH, 2, line_fit.TRIALS)
    starts = sample_subsets(2 * board_pose.LINES, 3, line_fit.TRIALS)
    out = np.empty((4, len(flat)), F), np.zeros(len(flat), np.uint8), np.empty(3, F), np.empty((3, 3), F)
    edges = [np.zeros(len(flat)), np.full(len(flat), 50.0), np.ones(len(flat)), np.full(len(flat), 0.1)]

    def measured(*arguments):
        arguments[-2][...] = edges

    of_pose = operations_of(
        board_pose._fused_form(measured, parallel=False), *ruler_peers.Frame.of(image), plain, flat, lines,
        ruler._TAPS.astype(F), numbers_of_numba(), pairs, starts, *out,
    )  # fmt: skip
    of_rulers = len(flat) * ruler.ruler_flops(ruler.LENGTH, ruler.WIDTH, ruler.REACH)
    agree(board_pose.pose_flops(len(pairs), len(starts)) - of_rulers, of_pose)


def test_feature_pose():
    _, features = feature_pose.scene(128)
    point = (features.point - features.placement).astype(F)
    normal, placed = features.normal.astype(F), np.empty((feature_pose.RULERS, 4), F)
    found = operations_of(feature_pose._place, point, normal, feature_pose.PREDICTED, F(63.5), placed)
    starts = len(sample_subsets(feature_pose.RULERS, 3, line_fit.TRIALS))
    rest = feature_pose.pose_flops(starts) - pose.fit_flops(feature_pose.RULERS, starts)
    of_rulers = feature_pose.RULERS * ruler.ruler_flops(ruler.LENGTH, ruler.WIDTH, ruler.REACH)
    agree(rest - of_rulers - 12 * feature_pose.RULERS, found, 0.3)


@pytest.mark.parametrize(
    ("model", "peer", "stated"),
    [
        (Ggx(alpha=0.2, f0=0.9), reflectance._ggx, reflectance._GGX),
        (Ward(albedo=0.8, alpha_x=0.15, alpha_y=0.4), reflectance._ward, reflectance._WARD),
    ],
)
def test_reflectance(model, peer, stated):
    directions = np.array([[0.3, -0.2, 0.8, 0.1, 0.4, 0.7]], F)
    out = np.empty(1, F), np.empty(1, np.uint8)
    found = operations_of(reflectance._numba(peer), directions, np.array(model.parameters, F), *out)
    agree(reflectance._UNIT + stated, found, 0.1)


def test_image_of_a_board():
    """The peer has the logarithm and the cosine of the library, which count 1 each."""
    values, numbers, image = np.zeros((40, 40), np.uint16), np.ones(3, F), np.empty((4, 4), np.uint8)
    one, three = (
        operations_of(board_image._numba, values, np.array(count * [[20.0, 20.0, 1.0, 0.0]], F), 0, numbers, image) / 16
        for count in (1, 3)
    )
    assert (three - one) / 2 == board_image._SAMPLE + 1  # the peer computes the column of a pixel for each sub-pose
    agree(board_image._PIXEL - 16 - 14 + 4, one - board_image._SAMPLE)


@pytest.mark.parametrize("shift", [0.0, 55e-6])
def test_deposits(shift):
    """Few cells are near the threshold at first, many when the paste is as high as the threshold."""
    rng, side = np.random.default_rng(1), 16
    z = rng.normal(1e-3 + shift, 2e-6, (side, side)).astype(F)
    sigma, owner = np.full(z.shape, 3e-6, F), np.ones(z.shape, np.int32)
    owner[:, 8:] = -1
    z[::5, ::3] = np.nan
    surface = np.zeros((1, 49), F)
    surface[0, [0, 7, 9, 12]] = 1e-3, 1 / side, 1 / side, side * 1e-5
    settings = tuple(map(F, (1e-10, deposits._THRESHOLD, 1.5, 0.5, 3.0)))
    boxes = np.array([[0, side, 0, side]], np.int32)
    found = operations_of(deposits._numba, z, sigma, owner, boxes, surface, settings, np.empty((1, 11), F))
    agree(deposits.measure_flops(z, sigma, owner, 1e-3, 1), found, 0.35)


def test_blob():
    image, places, _ = blob.scene(1)
    taps = np.arange(1, blob_peers.REACH + 1) * np.exp(-0.5 * (np.arange(1, blob_peers.REACH + 1) / 1.5) ** 2)
    taps /= 2.0 * np.sum(taps * np.arange(1, blob_peers.REACH + 1))
    numbers = np.array([blob.THRESHOLD / 5.0, 2.25, 1.0, *taps], F)
    angle = np.arange(blob_peers.SPOKES) * 2.0 * math.pi / blob_peers.SPOKES
    directions = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(F)
    out = np.empty((1, 13), F), np.empty((1, 3, 3), F), np.empty(1, np.uint8)
    found = operations_of(
        blob_peers.find_form(blob_peers.start, True), image, places, numbers, directions, F(2.0), *out
    )
    agree(blob.blob_flops(), found)


def test_undistorted_points():
    """Two steps of the peer are one of ours with longer polynomials."""
    camera = undistort_points.STANDARD
    points = undistort_points._points(camera, 10, inverse=False).astype(F)
    (f, _, cx), (_, _, cy), _ = camera.matrix
    table, series = np.array([cx, cy, f, *camera.distortion[:5], 1.0 / f], F), np.ones(14, F)
    pairs = points.reshape(-1).view(np.complex64)
    out = np.empty_like(pairs), np.empty(len(pairs), np.uint8)
    found = operations_of(undistort_points._one_thread, pairs, table, F(1.0), series, (0, 0), *out)
    agree(10 * undistort_points.undistort_flops(camera, F), found)


def test_distorted_points():
    camera = undistort_points.FULL
    found = operations_of(distort_pixels, np.full((10, 2), 300.0), camera.matrix, camera.distortion)
    agree(10 * undistort_points.undistort_flops(camera, F, inverse=True), found)


def test_terms_that_a_lens_lacks_count_nothing():
    counts = [
        undistort_points.undistort_flops(each, F) for each in (undistort_points.TILTED, undistort_points.STANDARD)
    ]
    assert counts[1] < undistort_points.undistort_flops(undistort_points.FULL, F)
    assert counts[0] < counts[1]  # a tilt has fewer operations than the terms of a decentred lens


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_undistorted_image(interpolation):
    """The reference sums all taps with a weight each; the kernel interpolates one axis after the other."""
    image, at = np.zeros((8, 8)), np.full((2, 2), 3.4)
    found = operations_of(undistort_image._interpolated, image, at, at, interpolation) / at.size
    operation = UndistortImage(model=undistort_points.TILTED, interpolation=interpolation)
    stated = undistort_image.pixel_flops(operation) - undistort_image._MAPPED
    assert {"bilinear": 0.5, "bicubic": 0.35}[interpolation] * found <= stated < found


def test_line():
    frames = np.random.default_rng(1).uniform(0.0, 255.0, (1, line.ROWS, 2))

    def centroid(frames):
        light = np.maximum(frames, line.THRESHOLD) - line.THRESHOLD
        return np.einsum("frc,r->fc", light, np.arange(frames.shape[1])) / light.sum(axis=1)

    centroid.__module__ = "gpuvision.example"
    agree(2 * line.profile_flops("centroid"), operations_of(centroid, frames), 0.01)
    agree(2 * line.profile_flops("gauss3"), operations_of(line._numpy_gauss3, frames), 0.3)
    agree(2 * line.profile_flops("windowed"), operations_of(line._numpy_windowed, frames), 0.1)
    assert line.profile_flops("ml") is None


def expected_tests(tree, ray, *, any_hit, node=0):
    """Return the numbers of boxes and of triangles below a node of a tree that a ray without a hit is tested against.

    A search for the closest hit tests the boxes of a node again when it returns to it from another node.
    """
    origin, direction = ray[:3] - tree.middle, ray[3:]
    low, high = tree.boxes[node, :3], tree.boxes[node, 3:]
    cuts = np.sort([(each - origin[:, None]) / direction[:, None] for each in (low, high)], axis=0)
    is_met = np.maximum(cuts[0].max(axis=0), 0.0) <= np.minimum(cuts[1].min(axis=0), 1.0 if any_hit else np.inf)
    boxes = np.isfinite(low[0]).sum()
    met = tree.children[node, is_met & np.isfinite(low[0])][:: -1 if direction[tree.axes[node]] < 0.0 else 1]
    counts = [(boxes, 0)]
    for child in met:
        if child < 0:
            counts.append((0, np.sum(tree.members[~child] >= 0)))
            continue
        counts.append(expected_tests(tree, ray, any_hit=any_hit, node=child))
        if not any_hit and child != met[-1]:
            counts.append((boxes, 0))
    return np.sum(counts, axis=0)


@pytest.mark.parametrize("width", [WIDTH, GPU_WIDTH])
@pytest.mark.parametrize("any_hit", [True, False])
def test_boxes_and_triangles_of_rays(width, any_hit):
    """Hits equal the hits of the reference, and rays without one test all that the boxes on their way hold."""
    numba_cache.keep_compiled(ray_visits)
    rng = np.random.default_rng(4)
    corners = rng.uniform(-1.0, 1.0, (300, 1, 3)) + rng.uniform(-0.1, 0.1, (300, 3, 3))
    rays = np.hstack([rng.uniform(-2.0, 2.0, (200, 3)), rng.uniform(-1.0, 1.0, (200, 3))])
    tree = Bvh.build(corners, width=width)
    end = 1.0 if any_hit else np.inf
    found = ray_visits.visits(tree, rays, end=end, any_hit=any_hit)
    t = reference_rays.crossings(corners, rays[:, :3], rays[:, 3:])[0]
    with np.errstate(invalid="ignore"):
        np.testing.assert_array_equal(found.is_hit, ((t > 0.0) & (t < end)).any(axis=1))
    root = np.isfinite(tree.boxes[0, 0]).sum()
    assert found.boxes.min() == root
    missed, within = ~found.is_hit, np.array([expected_tests(tree, each, any_hit=any_hit) for each in rays])
    assert np.sum(missed & (found.triangles > 0)) > 20
    np.testing.assert_array_equal(np.transpose([found.boxes, found.triangles])[missed], within[missed])
    assert np.all(found.triangles <= within[:, 1])
    assert 0 < found.triangles.mean() < 0.3 * len(corners)
    nothing = ray_visits.visits(tree, rays + np.array([9.0, 0, 0, 0, 0, 0]), end=1.0, any_hit=any_hit)
    assert nothing.mean_flops() == ray_visits._RAY_FLOPS + ray_visits._BOX_FLOPS * root


def test_search_of_a_field():
    search = SimpleNamespace(scores=np.empty((2, 3, 64)))
    level, out = np.ones((3, 64), F), (search.scores[:1], np.empty((1, 3, 1)), np.empty((1, 3, 1), int))
    offsets = np.zeros((1, field_pose._RAYS), np.int64)
    total = operations_of(field_pose._numba_poses, level, offsets, offsets, *out)
    assert field_pose._Search.flops.fget(search) == 2 * (total - 2)  # the scale is computed once


def test_refinement_on_a_field():
    """A point at a pose: its place and turn, distance of one line, weight, and normal equations."""
    count = 10

    def equations(shapes, points, pose, scale):
        c, s, which = np.cos(pose[2]), np.sin(pose[2]), np.zeros(len(points), int)
        dx, dy = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]
        x, y = pose[0] + dx, pose[1] + dy
        away, nx, ny = field_pose._offsets(shapes, which, x, y)
        rows = np.stack([nx, ny, ny * dx - nx * dy], axis=-1)
        share = scale**2 / (scale**2 + away**2)
        cost, weighted = np.sum(1.0 - share), rows * (share**2)[:, None]
        return cost, np.einsum("ni,nj->ij", weighted, rows), np.einsum("ni,n->i", weighted, away)

    equations.__module__ = "gpuvision.example"
    shapes = np.array([[0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]])
    found = operations_of(equations, shapes, np.ones((count, 2)), np.zeros(3), 0.1)
    step = field_pose.refinement_flops(count, 1) - field_pose.refinement_flops(count, 0) - field_pose._STEP
    agree(step, found, 0.5)  # the arrays treat all points as ends of lines, and the matrix as not symmetric


def test_steps_of_a_refinement(monkeypatch):
    """The count ends at the first number of steps with the last pose."""
    poses = {steps: np.array([[1.0 / min(steps, 5), 0.0, 0.0]]) for steps in range(1, 9)}

    class Refinement:
        def __init__(self, map, max_iterations=8):
            self.max_iterations = max_iterations

        def __call__(self, points, starts, device):
            return SimpleNamespace(poses=poses[self.max_iterations])

    monkeypatch.setattr(field_pose, "FieldPoseRefinement", Refinement)
    assert field_pose.steps_of(Device.best(), None, None, np.zeros(3)) == 5


def test_occluded_irradiance():
    """The closed form of all pairs that face each other, without the view that the search for occluders takes."""
    board = occluded_irradiance.Board.of(strips=3)
    receivers = board.receivers.reshape(-1, 6)[::3]
    table = adaptive.segment_table(board.segments)
    found = operations_of(line_irradiance._numba_plain, receivers, table, np.empty(len(receivers), F))
    some = SimpleNamespace(receivers=receivers, segments=board.segments)
    total = occluded_irradiance.pair_flops(some)
    pairs = len(receivers) * len(table)
    facing = (total - occluded_irradiance._PAIR * pairs) / occluded_irradiance._FACING
    agree(total - 90 * facing, found, 0.5)
