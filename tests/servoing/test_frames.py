from __future__ import annotations

import math

import numpy as np
import pytest
from pytransform3d.transform_manager import TransformManager

from gpuvision.servoing.frames import (
    Transform,
    compose_poses,
    invert_pose,
    move_covariance,
    placement_error,
    pose_difference,
)

POSES = {
    "pipette": (0.021, -0.003, 0.4),
    "expected": (-0.004, 0.0125, -2.1),
    "artwork": (0.0003, -0.0002, 0.003),
}
COVARIANCE = np.diag([4e-6, 3e-6, 2e-4]) @ np.array([[1, 0.3, -0.5], [0.3, 1, 0.2], [-0.5, 0.2, 1]])
COVARIANCE = COVARIANCE @ np.diag([4e-6, 3e-6, 2e-4])


def _chain(covariance: object = None) -> Transform:
    return placement_error(
        Transform.rigid("pipette", "camera", POSES["pipette"], covariance),
        Transform.rigid("expected", "camera", POSES["expected"], covariance),
        Transform.rigid("artwork", "expected", POSES["artwork"], covariance),
    )


def _in_space(pose: tuple[float, float, float]) -> np.ndarray:
    x, y, theta = pose
    lifted = np.eye(4)
    lifted[:2, :2] = [[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]]
    lifted[:2, 3] = x, y
    return lifted


def test_chain_agrees_with_pytransform3d() -> None:
    manager = TransformManager()
    manager.add_transform("pipette", "camera", _in_space(POSES["pipette"]))
    manager.add_transform("expected", "camera", _in_space(POSES["expected"]))
    manager.add_transform("artwork", "expected", _in_space(POSES["artwork"]))
    expected = manager.get_transform("artwork", "pipette")
    chain = _chain()
    assert (chain.source, chain.target, chain.kind) == ("artwork", "pipette", "rigid")
    np.testing.assert_allclose(chain.linear, expected[:2, :2], atol=1e-14)
    np.testing.assert_allclose(chain.translation, expected[:2, 3], atol=1e-16)
    point = np.array([0.01, 0.02])
    np.testing.assert_allclose(chain.apply(point), (expected @ [*point, 0, 1])[:2], atol=1e-16)


def _draws(count: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).multivariate_normal(np.zeros(3), COVARIANCE, count)


def test_covariance_of_the_chain_agrees_with_monte_carlo() -> None:
    chain = _chain(COVARIANCE)
    count = 40_000
    drawn = [np.array(pose) + _draws(count, seed) for seed, pose in enumerate(POSES.values())]

    def matrices(pose: np.ndarray) -> np.ndarray:
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        rows = [[c, -s, pose[:, 0]], [s, c, pose[:, 1]], [0 * c, 0 * c, 0 * c + 1]]
        return np.moveaxis(np.array(rows), -1, 0)

    pipette, expected, artwork = map(matrices, drawn)
    product = np.linalg.inv(pipette) @ expected @ artwork
    poses = np.stack([product[:, 0, 2], product[:, 1, 2], np.arctan2(product[:, 1, 0], product[:, 0, 0])], axis=1)
    measured = np.cov(poses.T)
    sigma = np.sqrt(np.diag(chain.pose_covariance))
    # Standard error of a variance of 40,000 draws: 0.7 %; of a correlation about as much.
    np.testing.assert_allclose(
        measured / sigma / sigma[:, None], chain.pose_covariance / sigma / sigma[:, None], atol=0.03
    )
    np.testing.assert_allclose(poses.mean(axis=0), chain.pose, atol=4e-3 * sigma.max())


@pytest.mark.parametrize("kind", ["similarity", "affine"])
def test_points_and_inverse_agree_with_monte_carlo(kind: str) -> None:
    random = np.random.default_rng(5)
    if kind == "similarity":
        covariance = np.diag([1e-6, 2e-6, 1e-4, 1e-9]) ** 2
        transform = Transform.similarity("image", "camera", (0.01, -0.02, 0.7), 1e-5, covariance)
        parameters = random.multivariate_normal([0.01, -0.02, 0.7, 1e-5], covariance, 20_000)
        x, y, theta, scale = parameters.T
        c, s = scale * np.cos(theta), scale * np.sin(theta)
        matrices = np.moveaxis(np.array([[c, -s, x], [s, c, y]]), -1, 0)
    else:
        matrix = np.array([[1.1e-5, 2e-6, 3e-3], [-1e-6, 0.9e-5, 4e-3]])
        root = np.tril(random.normal(size=(6, 6))) * np.array([1e-9, 1e-9, 1e-6, 1e-9, 1e-9, 1e-6])[:, None]
        covariance = root @ root.T
        transform = Transform.affine("image", "camera", matrix, covariance)
        matrices = matrix + (random.normal(size=(20_000, 6)) @ root.T).reshape(-1, 2, 3)
    point, noise = np.array([120.0, -80.0]), np.diag([0.05, 0.02]) ** 2
    seen = random.multivariate_normal(point, noise, len(matrices))
    mapped = np.einsum("nij,nj->ni", matrices[:, :, :2], seen) + matrices[:, :, 2]
    predicted = transform.propagate(point, noise)
    sigma = np.sqrt(np.diag(predicted.covariance))
    np.testing.assert_allclose(
        np.cov(mapped.T) / sigma / sigma[:, None], predicted.covariance / sigma / sigma[:, None], atol=0.05
    )
    np.testing.assert_allclose(predicted.points, transform.apply(point), rtol=1e-15)
    # Back: the image of a fixed point under the inverse.
    target = transform.apply(point)
    back = np.linalg.solve(matrices[:, :, :2], (target - matrices[:, :, 2])[..., None])[..., 0]
    inverse = transform.inverse()
    expected = inverse.propagate(target).covariance
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(np.cov(back.T) / sigma / sigma[:, None], expected / sigma / sigma[:, None], atol=0.05)
    np.testing.assert_allclose(inverse.apply(target), point, rtol=1e-12)


def test_plain_poses_agree_with_transforms() -> None:
    outer, inner = np.array(POSES["pipette"]), np.array(POSES["expected"])
    transform = Transform.rigid("camera", "motion", outer, COVARIANCE)
    product = transform @ Transform.rigid("expected", "camera", inner)
    np.testing.assert_allclose(compose_poses(outer, inner), product.pose, atol=1e-15)
    np.testing.assert_allclose(invert_pose(outer), transform.inverse().pose, atol=1e-15)
    np.testing.assert_allclose(compose_poses(np.stack([outer, inner]), inner)[0], product.pose, atol=1e-15)
    moved, expected = move_covariance(COVARIANCE, outer, inner), product.pose_covariance
    np.testing.assert_allclose(moved, expected, atol=1e-9 * np.abs(expected).max())


def test_pose_and_scale_come_back_with_their_covariance() -> None:
    given = np.diag([1e-6, 2e-6, 1e-4, 1e-8]) ** 2
    given[0, 2] = given[2, 0] = 0.5e-10
    transform = Transform.similarity("image", "camera", (1.0, 2.0, 3.0), 2e-5, given)
    np.testing.assert_allclose(transform.pose, (1.0, 2.0, 3.0), rtol=1e-14)
    assert transform.scale == pytest.approx(2e-5, rel=1e-14)
    np.testing.assert_allclose(transform.pose_covariance, given[:3, :3], rtol=1e-9, atol=1e-24)
    assert transform.scale_sigma == pytest.approx(1e-8, rel=1e-9)
    twice = transform.inverse().inverse()
    np.testing.assert_allclose(twice.pose_covariance, given[:3, :3], rtol=1e-6, atol=1e-18)


def test_kind_of_a_product_is_the_more_general_one() -> None:
    rigid = Transform.rigid("camera", "motion", (0, 0, 1))
    scaled = Transform.similarity("image", "camera", (0, 0, 1), 2.0)
    skewed = Transform.affine("motion", "commands", [[1, 0.1, 0], [0, 1, 0]])
    assert (rigid @ scaled).kind == "similarity"
    assert (skewed @ (rigid @ scaled)).kind == "affine"


def test_wrong_composition_is_an_error_not_a_number() -> None:
    one = Transform.rigid("pipette", "camera", (0, 0, 0))
    with pytest.raises(ValueError, match="expected the same frame in the middle"):
        one @ one
    with pytest.raises(TypeError):
        one @ np.eye(3)
    artwork = Transform.rigid("artwork", "expected", (0, 0, 0))
    with pytest.raises(ValueError, match="expected artwork, expected, camera, pipette"):
        placement_error(
            Transform.rigid("motion", "camera", (0, 0, 0)), Transform.rigid("expected", "camera", (0, 0, 0)), artwork
        )


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Transform.rigid("", "camera", (0, 0, 0)), "expected two names"),
        (lambda: Transform.rigid("a", "b", (0, 0)), r"pose has shape \(2,\)"),
        (lambda: Transform.rigid("a", "b", (0, math.nan, 0)), "not finite"),
        (lambda: Transform.rigid("a", "b", (0, 0, 0), -np.eye(3)), "positive semidefinite"),
        (lambda: Transform.rigid("a", "b", (0, 0, 0), np.triu(np.full((3, 3), 0.5)) + np.eye(3)), "not symmetric"),
        (lambda: Transform.similarity("a", "b", (0, 0, 0), 0.0), "scale is 0.0"),
        (lambda: Transform.affine("a", "b", [[1, 1, 0], [1, 1, 0]]), "singular"),
        (lambda: Transform(source="a", target="b", matrix=np.eye(2, 3) * 2, kind="rigid"), "scale 2"),
        (
            lambda: Transform(source="a", target="b", matrix=np.array([[1, 1, 0], [0, 1, 0]]), kind="similarity"),
            "no simi",
        ),
        (lambda: Transform(source="a", target="b", matrix=np.eye(2, 3), kind="round"), "kind is 'round'"),
    ],
)
def test_wrong_transforms_are_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("name", ["pose", "scale", "pose_covariance", "scale_sigma"])
def test_a_reflection_has_no_pose(name: str) -> None:
    reflected = Transform.affine("image", "camera", [[1e-5, 0, 0], [0, -1.1e-5, 0]], 1e-18 * np.eye(6))
    with pytest.raises(ValueError, match="'camera' <- 'image' reflects"):
        getattr(reflected, name)
    np.testing.assert_allclose(reflected.apply([2.0, 3.0]), [2e-5, -3.3e-5])
    turned = Transform.affine("image", "camera", [[0, 1e-5, 0], [1e-5, 0, 0]])
    with pytest.raises(ValueError, match="reflects"):
        getattr(turned, name)


def _matrix(linear: object, kind: str = "affine") -> Transform:
    return Transform(source="a", target="b", matrix=np.column_stack([np.array(linear), [3.0, -4.0]]), kind=kind)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("taken", "refused", "kind"),
    [
        # An inverse: the determinant is above 1e-18 of the square of the largest element.
        ([[3.0, 0.0], [0.0, 3.1e-18]], [[3.0, 0.0], [0.0, 2.9e-18]], "affine"),
        ([[0.0, 4e-18], [-2e-5, 0.0]], [[0.0, 0.0], [-2e-5, 0.0]], "affine"),
        # Elements that are equal, and opposite, to 1e-9 of the largest one.
        ([[2e-5, 0.0], [0.0, 2e-5 + 1.9e-14]], [[2e-5, 0.0], [0.0, 2e-5 + 2.1e-14]], "similarity"),
        ([[2e-5, 0.0], [0.0, 2e-5 - 1.9e-14]], [[2e-5, 0.0], [0.0, 2e-5 - 2.1e-14]], "similarity"),
        ([[0.0, 5.0], [-5.0 + 4.9e-9, 0.0]], [[0.0, 5.0], [-5.0 + 5.2e-9, 0.0]], "similarity"),
        ([[0.8, -0.6], [0.6, 0.8]], [[0.8, 0.6], [0.6, -0.8]], "rigid"),
        ([[0.8 + 7e-10, -0.6], [0.6, 0.8 + 7e-10]], [[0.8 + 2e-9, -0.6], [0.6, 0.8 + 2e-9]], "rigid"),
        ([[1.0 - 9e-10, 0.0], [0.0, 1.0 - 9e-10]], [[1.0 - 1.1e-9, 0.0], [0.0, 1.0 - 1.1e-9]], "rigid"),
    ],
)
def test_linear_parts_are_taken_up_to_rounding(taken: object, refused: object, kind: str) -> None:
    np.testing.assert_array_equal(_matrix(taken, kind).linear, taken)
    with pytest.raises(ValueError, match=r"singular|is no|has the scale"):
        _matrix(refused, kind)


@pytest.mark.parametrize(
    ("taken", "refused"),
    [
        # Correlations (3 x 3) that differ by 1e-9, and eigenvalues down to -3e-9.
        ([[1, 0.5, 0], [0.5 + 0.9e-9, 1, 0], [0, 0, 1]], [[1, 0.5, 0], [0.5 + 1.2e-9, 1, 0], [0, 0, 1]]),
        ([[1, 1 + 2.8e-9, 0], [1 + 2.8e-9, 1, 0], [0, 0, 1]], [[1, 1 + 3.2e-9, 0], [1 + 3.2e-9, 1, 0], [0, 0, 1]]),
        ([[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[1, 0, 0], [0, 0, 1e3], [0, 1e3, 1]]),
    ],
)
def test_covariances_are_taken_up_to_rounding(taken: object, refused: object) -> None:
    """The limits hold for the correlations: the standard deviations are 2 um, 3 um and 4e-4."""
    sigma = np.array([2e-6, 3e-6, 4e-4])
    scaled = np.array(taken, np.float64) * sigma * sigma[:, None]
    found = Transform.rigid("a", "b", (1.0, 2.0, 0.3), scaled)
    symmetric = 0.5 * (scaled + scaled.T)
    np.testing.assert_allclose(found.pose_covariance, symmetric, rtol=1e-9, atol=1e-24)
    with pytest.raises(ValueError, match="not symmetric and positive semidefinite"):
        Transform.rigid("a", "b", (1.0, 2.0, 0.3), np.array(refused, np.float64) * sigma * sigma[:, None])


def test_pose_and_scale_of_an_affine_transform_are_those_of_the_nearest_similarity(rng: np.random.Generator) -> None:
    """The nearest by least squares of the elements, and its derivatives by differences."""
    matrix = np.array([[1.3, -0.4, 5.0], [0.9, 1.1, -6.0]])
    root = rng.normal(size=(6, 6))
    transform = Transform.affine("image", "camera", matrix, root @ root.T)
    basis = np.array([[1.0, 0.0], [0.0, -1.0], [0.0, 1.0], [1.0, 0.0]])

    def nearest(elements: np.ndarray) -> np.ndarray:
        (along, across), *_ = np.linalg.lstsq(basis, elements.reshape(2, 3)[:, :2].ravel(), rcond=None)
        return np.array([elements[2], elements[5], math.atan2(across, along), math.hypot(along, across)])

    x, y, theta, scale = nearest(matrix.ravel())
    np.testing.assert_allclose(transform.pose, (x, y, theta), rtol=1e-14)
    assert transform.scale == pytest.approx(scale, rel=1e-14)
    steps = 1e-5 * np.eye(6)
    rows = np.array([nearest(matrix.ravel() + each) - nearest(matrix.ravel() - each) for each in steps]).T / 2e-5
    expected = rows @ root @ root.T @ rows.T
    np.testing.assert_allclose(transform.pose_covariance, expected[:3, :3], rtol=1e-7)
    assert transform.scale_sigma == pytest.approx(math.sqrt(expected[3, 3]), rel=1e-7)
    exact = Transform.affine("image", "camera", matrix)
    assert exact.scale_sigma == 0.0
    assert not exact.pose_covariance.any()


def test_covariances_of_products_and_inverses_are_those_of_differences(rng: np.random.Generator) -> None:
    """Elements of A B and A^-1, differentiated by each element; points with and without a covariance of their own."""
    first, second = rng.normal(size=(2, 2, 3)) + np.array([[2.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    roots = rng.normal(size=(2, 6, 6))
    a, b = (
        Transform.affine(source, target, matrix, root @ root.T)
        for source, target, matrix, root in zip("xy", "yz", (first, second), roots, strict=True)
    )

    def square(elements: np.ndarray) -> np.ndarray:
        return np.vstack([elements.reshape(2, 3), [0.0, 0.0, 1.0]])

    def rows(function: object, at: np.ndarray) -> np.ndarray:
        sides = [[function(at.ravel() + sign * 1e-5 * each) for sign in (1, -1)] for each in np.eye(6)]  # type: ignore[operator]
        return np.array([(one - other).ravel() for one, other in sides]).T / 2e-5

    by_second = rows(lambda each: (square(each) @ square(first))[:2], second) @ roots[1]
    by_first = rows(lambda each: (square(second) @ square(each))[:2], first) @ roots[0]
    product = b @ a
    assert (product.source, product.target, product.kind) == ("x", "z", "affine")
    np.testing.assert_allclose(product.matrix, (square(second) @ square(first))[:2], rtol=1e-12)
    np.testing.assert_allclose(
        product.covariance, by_first @ by_first.T + by_second @ by_second.T, rtol=1e-6, atol=1e-6
    )
    inverse = a.inverse()
    assert (inverse.source, inverse.target) == ("y", "x")
    moved = rows(lambda each: np.linalg.inv(square(each))[:2], first) @ roots[0]
    np.testing.assert_allclose(inverse.covariance, moved @ moved.T, rtol=1e-6, atol=1e-6)
    points = rng.normal(size=(4, 3, 2))
    own = np.array([[0.5, 0.1], [0.1, 0.3]])
    mapped = a.propagate(points, np.broadcast_to(own, (4, 3, 2, 2)))
    np.testing.assert_allclose(mapped.points, points @ first[:, :2].T + first[:, 2], rtol=1e-12)
    by_elements = rows(lambda each: (square(each) @ np.array([*points[2, 1], 1.0]))[:2], first) @ roots[0]
    alone = by_elements @ by_elements.T
    np.testing.assert_allclose(mapped.covariance[2, 1], alone + first[:, :2] @ own @ first[:, :2].T, rtol=1e-6)
    np.testing.assert_allclose(a.propagate(points).covariance[2, 1], alone, rtol=1e-6)


def test_angles_of_differences_are_within_half_a_turn() -> None:
    for angle, expected in (
        (3.0, 3.0),
        (3.2, 3.2 - 2 * math.pi),
        (-3.2, 2 * math.pi - 3.2),
        (16.0, 16.0 - 6 * math.pi),
    ):
        one, other = np.array([1.0, 5.0, 0.25 + angle]), np.array([4.0, -2.0, 0.25])
        np.testing.assert_allclose(pose_difference(one, other), [-3.0, 7.0, expected], atol=1e-14)
        assert one[2] == 0.25 + angle


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ("motion camera expected camera artwork expected", "'artwork' over 'expected' and 'camera' to 'motion'"),
        ("pipette image expected image artwork expected", "'artwork' over 'expected' and 'image' to 'pipette'"),
        ("pipette camera image camera artwork image", "'artwork' over 'image' and 'camera' to 'pipette'"),
        ("pipette camera expected camera motion expected", "'motion' over 'expected' and 'camera' to 'pipette'"),
    ],
)
def test_each_frame_of_the_chain_is_checked(frames: str, message: str) -> None:
    names = frames.split()
    chain = [Transform.rigid(*pair, (0, 0, 0)) for pair in zip(names[::2], names[1::2], strict=True)]
    with pytest.raises(ValueError, match=f"^the chain leads from {message}, expected artwork, expected, camera"):
        placement_error(*chain)


def test_wrong_names_and_scales_are_refused() -> None:
    with pytest.raises(ValueError, match="frames are 'a' and '', expected two names"):
        Transform.rigid("a", "", (0, 0, 0))
    for scale in (-1e-9, math.inf, math.nan):
        with pytest.raises(ValueError, match=f"scale is {scale}, expected a number above 0"):
            Transform.similarity("a", "b", (0, 0, 0), scale)
    assert Transform.similarity("a", "b", (0, 0, 0), 1e-9).scale == 1e-9
