from __future__ import annotations

import math

import numpy as np
import pytest
from pytransform3d.transform_manager import TransformManager

from gpuvision.servoing.frames import Transform, compose_poses, invert_pose, move_covariance, placement_error

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
