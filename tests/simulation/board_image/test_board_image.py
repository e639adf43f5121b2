"""Images of a board: against the reference, the place of edges, the statistics of the noise, and extreme input."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from bare_boards import board_of
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.camera.lens import Lens
from gpuvision.camera.orthographic import BoardView
from gpuvision.host import Device
from gpuvision.reference import board_image as reference
from gpuvision.simulation.board_image.board_image import RenderBoard, exposure_poses
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

PIXEL = 10e-6
SHAPE = (40, 37)  # rows of pixels that do not divide into vectors of 16
SENSOR = CmosSensor(
    rows=64,
    columns=64,
    pitch=5e-6,
    quantum_efficiency=0.6,
    gain=0.03,
    dark_noise=12.0,
    full_well=9000.0,
    bits=8,
    dark_level=4.0,
    dsnu=20.0,
    prnu=0.02,
    dark_current=3000.0,
    nonlinearity=0.08,
)
# The differences between the pixels, the bend and other types of grey levels have builds of their own.
PLAIN = CmosSensor(
    rows=256,
    columns=256,
    pitch=5e-6,
    quantum_efficiency=0.5,
    gain=0.5,
    dark_noise=8.0,
    full_well=40e3,
    bits=12,
    dark_level=100.0,
)
SEED = 77
ONE = np.array([7], np.uint32)


@pytest.fixture(scope="module")
def pads() -> ReflectanceMap:
    """Return two pads that are slanted and straight, 1 mm x 1 mm."""
    slanted = 1e-3 * np.array([[0.3, 0.4], [0.5, 0.3], [0.65, 0.5], [0.4, 0.62]])
    straight = 1e-3 * np.array([[0.55, 0.55], [0.8, 0.55], [0.8, 0.8], [0.55, 0.8]])
    return ReflectanceMap.of(board_of(slanted, straight, size=1e-3), pixel=PIXEL)


def motion(count: int) -> np.ndarray:
    return exposure_poses((0.5e-3, 0.5e-3, 0.3), (0.52e-3, 0.49e-3, 0.31), count)


def expected_reflectance(
    board_map: ReflectanceMap, poses: np.ndarray, pixels: np.ndarray, **options: Any
) -> np.ndarray:
    return reference.reflectance(
        board_map.values, board_map.origin, board_map.cell, board_map.pixel, pixels, poses, **options
    )


@pytest.mark.double
@pytest.mark.parametrize("variant", ["vector", "work_item"])
def test_images_are_those_of_the_reference(pads: ReflectanceMap, device: Device, variant: Any) -> None:
    """Everything at once: motion, mirrored view, lens, illumination, glare, and all terms of the sensor."""
    rng = np.random.default_rng(SEED)
    differences = rng.standard_normal((2, *SHAPE))  # of the pixels, from the same seed as the operation
    light, glare = rng.uniform(0.6, 1.2, SHAPE), rng.uniform(0.0, 0.2, SHAPE)
    lens = Lens(k1=2e-5, centre=(20.0, 15.0))
    white = 8000.0
    op = RenderBoard(
        board=pads,
        shape=SHAPE,
        mirrored=True,
        sensor=SENSOR,
        electrons=white,
        exposure=1e-2,
        seed=SEED,
        illumination=light,
        glare=glare,
        model=lens,
        variant=variant,
    )
    poses = np.stack([motion(3), np.add(motion(3), (2e-5, 0.0, 0.0))])
    numbers = np.array([5, 2**32 - 1], np.uint32)
    images = op(poses, numbers, device=device).image
    assert images.dtype == np.uint8
    x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
    ideal = lens.undistort(np.stack([x, y], axis=-1)) - ((SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2)
    for image, sub_poses, number in zip(images, poses, numbers.tolist(), strict=True):
        seen = expected_reflectance(pads, sub_poses, ideal, mirrored=True)
        electrons = white * (seen + glare) * light * (1.0 + SENSOR.prnu * differences[0]) + 30.0
        levels = reference.grey_levels(
            electrons,
            reference.normal_numbers(SHAPE, number, SEED),
            {
                "dark_noise": 12.0,
                "full_well": 9000.0,
                "gain": 0.03,
                "dark_level": 4.0,
                "max_level": 255.0,
                "nonlinearity": 0.08,
            },
            SENSOR.dsnu * differences[1],
        )
        # Single precision: a place in the map to 1e-4 nodes, and electrons to 0.01: 0.01 levels decide the rounding.
        np.testing.assert_allclose(image, levels, atol=0.51)


@pytest.mark.parametrize(("variant", "dtype"), [("vector", np.float64), ("work_item", np.float32)])
def test_without_a_sensor_images_are_reflectances(
    pads: ReflectanceMap, device: Device, variant: Any, dtype: Any
) -> None:
    op = RenderBoard(board=pads, shape=SHAPE, variant=variant)
    poses = motion(3)[:, None].astype(dtype)
    poses[2] = (0.02e-3, 0.9e-3, math.pi / 2)  # leaves the map on two sides
    images = op(poses, np.zeros(3, np.uint32), device=device).image
    for image, pose in zip(images, poses, strict=True):
        exact = expected_reflectance(pads, pose, reference.centred_pixels(SHAPE))
        np.testing.assert_allclose(image, exact, atol=1e-4)
    # A pose that is not finite, or far away, shows the border of the map: here its corners have own reflectances.
    values = np.arange(16, dtype=np.uint16).reshape(4, 4) * np.uint16(4000)
    corners = replace(op, board=replace(pads, values=values))
    wrong = np.array([[[1e9, -1e9, 0.0]], [[-np.inf, 1e30, 1.0]], [[np.nan, 0.0, 0.0]]], dtype)
    images = corners(wrong, np.zeros(3, np.uint32), device=device).image
    np.testing.assert_allclose(images[0], values[0, 3] / 65535.0, rtol=1e-6)
    np.testing.assert_allclose(images[1], values[3, 0] / 65535.0, rtol=1e-6)
    assert np.isfinite(images[2]).all()


@pytest.mark.double
def test_edges_lie_where_the_artwork_and_the_pose_put_them(device: Device) -> None:
    """A half-plane under many poses: the image equals the closed form, and its half level lies on the edge."""
    blur, centre = 0.6, np.array([0.05, 0.05])
    offset = np.array([3.3e-6, -2.1e-6])
    angle = 0.2
    normal = np.array([math.cos(angle), math.sin(angle)])  # out of the copper
    along = np.array([-normal[1], normal[0]])
    point = centre + offset
    half_plane = [point + a * along - b * normal for a, b in ((-0.01, 0.0), (0.01, 0.0), (0.01, 0.01), (-0.01, 0.01))]
    board_map = ReflectanceMap.of(
        board_of(half_plane), pixel=PIXEL, region=(centre - 0.5e-3, centre + 0.5e-3), blur_px=blur
    )
    op = RenderBoard(board=board_map, shape=SHAPE)
    rng = np.random.default_rng(1)
    turns = np.concatenate([rng.uniform(-0.2, 0.2, 6), [0.0, math.pi - angle, 2.0, -1.3]])
    poses = np.array([[[*(centre + rng.uniform(-2e-5, 2e-5, 2)), turn]] for turn in turns])
    images = op(poses, np.zeros(len(poses), np.uint32), device=device).image
    errors = []
    for image, (pose,) in zip(images, poses, strict=True):
        view = BoardView(scale=PIXEL, shape=SHAPE, pose=tuple(pose))
        x, y = np.meshgrid(np.arange(SHAPE[1]), np.arange(SHAPE[0]))
        distance = -(view.to_plane(np.stack([x, y], axis=-1)) - point) @ normal / PIXEL
        share = reference.edge_response(distance, angle, blur)
        np.testing.assert_allclose(image, 0.35 + 0.43 * share, atol=0.43 / (30 * 16 * blur) + 1e-3)
        errors.append(shift_of(image, distance, angle, blur))
    assert np.max(np.abs(errors)) < 0.002  # of the map: 0.0008 px


def shift_of(image: np.ndarray, distance: np.ndarray, angle: float, blur: float) -> float:
    """Return the distance [px] by which the edge of an image is nearer to the bright side than the closed form."""
    near = np.abs(distance) < 3.0

    def excess(shift: float) -> float:
        return float(np.sum(0.35 + 0.43 * reference.edge_response(distance[near] - shift, angle, blur) - image[near]))

    return float(brentq(excess, -0.5, 0.5))


def test_philox_has_the_published_numbers() -> None:
    """Known answers of the authors' library Random123."""
    for first, second, key, expected in (
        (0, 0, 0, (0xFF1DAE59, 0x6CD10DF2)),
        (0xFFFFFFFF, 0xFFFFFFFF, 0xFFFFFFFF, (0x2C3F628B, 0xAB4FD7AD)),
        (0x243F6A88, 0x85A308D3, 0x13198A2E, (0xDD7CE038, 0xF62A4C12)),
    ):
        assert reference.philox(first, second, key) == expected


def flat(level: float) -> ReflectanceMap:
    """Return a board of one reflectance."""
    values = np.full((8, 8), round(65535 * level), np.uint16)
    return ReflectanceMap(values=values, origin=(0.0, 0.0), cell=PIXEL / 4, pixel=PIXEL, blur_px=0.5)


@pytest.mark.double
@pytest.mark.parametrize("level", [0.0, 0.01, 0.5])
def test_noise_has_the_variance_of_the_sensor(device: Device, level: float) -> None:
    op = RenderBoard(board=flat(level), shape=(64, 64), sensor=PLAIN, electrons=4000.0, seed=3)
    poses, numbers = np.zeros((16, 1, 3)), np.arange(16, dtype=np.uint32)
    image = op(poses, numbers, device=device).image.astype(np.float64)
    electrons = 4000.0 * level
    sigma = PLAIN.gain * float(PLAIN.noise(electrons, spatial=False))
    # Four standard deviations of a mean and of a variance of 65 536 normal numbers; half an electron of the map.
    assert image.mean() == pytest.approx(float(PLAIN.level(electrons)), abs=4 * sigma / 256 + 0.02)
    assert image.var() == pytest.approx(sigma**2, rel=4 * math.sqrt(2) / 256)
    # No correlation along rows, along columns, or from frame to frame.
    rest = (image - image.mean()) / sigma
    for a, b in ((rest[:, :, 1:], rest[:, :, :-1]), (rest[:, 1:], rest[:, :-1]), (rest[1:], rest[:-1])):
        assert abs(np.mean(a * b)) < 4.5 / 256


@pytest.mark.double
def test_seed_and_number_select_the_noise(pads: ReflectanceMap, device: Device) -> None:
    op = RenderBoard(board=pads, shape=SHAPE, sensor=PLAIN, seed=1)
    pose = motion(1)[None]
    first = op(pose, ONE, device=device).image
    np.testing.assert_array_equal(first, op(pose, ONE, device=device).image)
    assert (first != op(pose, ONE + np.uint32(1), device=device).image).mean() > 0.5
    assert (first != replace(op, seed=2)(pose, ONE, device=device).image).mean() > 0.5
    both = op(np.concatenate([pose, pose]), np.array([7, 7], np.uint32), device=device).image
    np.testing.assert_array_equal(both, np.concatenate([first, first]))
    quiet = replace(op, noise=False)(pose, ONE, device=device).image
    np.testing.assert_array_equal(quiet, replace(op, noise=False)(pose, ONE + np.uint32(9), device=device).image)
    bright = replace(op, electrons=1e9)(pose, ONE, device=device).image
    assert (bright == 4095).all()


@pytest.mark.parametrize(
    ("change", "error", "match"),
    [
        ({"board": None}, TypeError, "expected a ReflectanceMap"),
        ({"shape": (0, 5)}, ValueError, "shape"),
        ({"seed": -1}, ValueError, "seed"),
        ({"electrons": 10.0}, ValueError, "give the sensor"),
        ({"sensor": SENSOR, "electrons": 0.0}, ValueError, "electrons"),
        ({"illumination": np.ones((2, 2))}, ValueError, "illumination"),
        ({"glare": np.full(SHAPE, np.nan)}, ValueError, "glare"),
        ({"model": 3}, TypeError, "expected a Lens"),
        ({"exposure": -1.0}, ValueError, "exposure"),
    ],
)
def test_wrong_parameters_are_refused(change: dict[str, Any], error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        RenderBoard(**{"board": flat(0.5), "shape": SHAPE, **change})


@pytest.mark.double
def test_wrong_poses_are_refused(device: Device) -> None:
    op = RenderBoard(board=flat(0.5), shape=SHAPE)
    for shape in ((1, 3), (1, 65, 3), (0, 1, 3), (1, 1, 2)):
        with pytest.raises(ValueError, match=r"poses \(frames, sub-poses, 3\)"):
            op(np.zeros(shape), ONE, device=device)
    with pytest.raises(TypeError, match="float64 or float32"):
        op(np.zeros((1, 1, 3), np.int32), ONE, device=device)
    folded = replace(op, model=Lens(k1=-1e-3, centre=(0.0, 0.0)))
    with pytest.raises(ValueError, match="the lens model folds"):
        folded(np.zeros((1, 1, 3)), ONE, device=device)


def test_sub_poses_lie_in_the_middles_of_equal_times() -> None:
    found = exposure_poses((0.0, 1.0, 2.0), (4.0, 1.0, 0.0), 4)
    np.testing.assert_allclose(found, [[0.5, 1, 1.75], [1.5, 1, 1.25], [2.5, 1, 0.75], [3.5, 1, 0.25]])
