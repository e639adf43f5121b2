"""OpenCV's camera on the host: against its equations in extended precision and OpenCV, up to the fold."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gpuvision.camera.camera import Camera
from gpuvision.reference import camera as reference

MATRIX = ((1700.0, 0.0, 642.5), (0.0, 1650.0, 509.25), (0.0, 0.0, 1.0))
ANOTHER = ((1500.0, 0.0, 600.0), (0.0, 1480.0, 500.0), (0.0, 0.0, 1.0))
FULL = (-0.12, 0.08, 1e-3, -2e-3, 0.01, 0.02, 0.03, 0.001, 1e-3, 2e-3, -1e-3, 3e-3)


def camera(*coefficients: float, tilt: tuple[float, float] = (0.0, 0.0), matrix: object = MATRIX) -> Camera:
    """Return a camera with the given leading coefficients, tilted by degrees."""
    distortion = (*coefficients, *(0.0,) * (12 - len(coefficients)), *np.radians(tilt))
    return Camera(matrix=matrix, distortion=distortion)


CAMERAS = {
    "pinhole": camera(),
    "k1": camera(-0.25),
    "k1 k2": camera(-0.12, 0.08),
    "pincushion": camera(0.3, 0.1),
    "tangential": camera(-0.28, 0.11, 5e-4, -3e-4, -0.02),
    "rational": camera(*FULL[:8]),
    "prism": camera(*FULL),
    "prism alone": camera(*(0.0,) * 8, 0.01, -0.02, 0.02, 0.01),
    "tilt": camera(tilt=(20.0, 0.0)),
    "tilt 45": camera(-0.12, 0.08, tilt=(45.0, 0.0)),
    "tilt both": camera(*FULL, tilt=(-30.0, 25.0)),
    "all": camera(*FULL, tilt=(20.0, -10.0)),
}


@pytest.fixture(params=CAMERAS.values(), ids=CAMERAS)
def any_camera(request: pytest.FixtureRequest) -> Camera:
    """Return each test camera."""
    return request.param


def image_points() -> np.ndarray:
    columns, rows = np.meshgrid(np.linspace(0.0, 1279.0, 41), np.linspace(0.0, 1023.0, 33))
    return np.stack([columns, rows], -1).reshape(-1, 2)


def by_opencv(points: np.ndarray, given_: Camera) -> np.ndarray:
    """Return OpenCV's projectPoints of ideal pixels."""
    matrix, coefficients = given_.to_opencv()
    rays = np.concatenate([points, np.ones((len(points), 1))], 1) @ np.linalg.inv(matrix).T
    return cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, coefficients)[0][:, 0]


# A tilt by 45 degrees magnifies up to 3 times, so coordinates reach 4000 px: a few roundings of 4000.
FEW_ROUNDINGS = 4e-12


def test_forward_against_the_equations(any_camera: Camera) -> None:
    points = image_points()
    expected = reference.distort_pixels(points, any_camera.matrix, any_camera.distortion).astype(np.float64)
    np.testing.assert_allclose(any_camera.distort(points), expected, rtol=0, atol=FEW_ROUNDINGS)


def test_forward_against_opencv(any_camera: Camera) -> None:
    points = image_points()
    np.testing.assert_allclose(any_camera.distort(points), by_opencv(points, any_camera), rtol=0, atol=FEW_ROUNDINGS)


def test_backward_of_what_the_equations_say(any_camera: Camera) -> None:
    """Measured points from the oracle's forward model: an error in both directions would not cancel."""
    points = image_points()
    measured = reference.distort_pixels(points, any_camera.matrix, any_camera.distortion).astype(np.float64)
    np.testing.assert_allclose(any_camera.undistort(measured), points, rtol=0, atol=1e-9)


def test_round_trips(any_camera: Camera) -> None:
    points = image_points()
    np.testing.assert_allclose(any_camera.undistort(any_camera.distort(points)), points, rtol=0, atol=1e-9)
    ideal = any_camera.undistort(points)
    good = np.isfinite(ideal[:, 0])
    assert good.mean() > 0.9
    np.testing.assert_allclose(any_camera.distort(ideal[good]), points[good], rtol=0, atol=1e-9)


@pytest.mark.parametrize("degrees", [-45.0, -10.0, 5.0, 20.0, 45.0])
def test_a_tilt_in_closed_form(degrees: float) -> None:
    """About x alone: x cos t / (cos t - y sin t), y / (cos t - y sin t). The opposite tilt is not a solution."""
    points = image_points()
    x, y = ((points - [642.5, 509.25]) / [1700.0, 1650.0]).T
    sine, cosine = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    for sign in (1.0, -1.0):
        w = cosine - sign * sine * y
        expected = np.stack([1700.0 * cosine * x / w + 642.5, 1650.0 * y / w + 509.25], -1)
        differ = np.abs(camera(tilt=(degrees, 0.0)).distort(points) - expected).max()
        assert differ < FEW_ROUNDINGS if sign > 0.0 else differ > 10.0


@settings(deadline=None, max_examples=60)
@given(
    radial=st.tuples(*(st.floats(-0.4, 0.4),) * 6),
    decentred=st.tuples(*(st.floats(-0.01, 0.01),) * 6),
    tilt=st.tuples(st.floats(-45.0, 45.0), st.floats(-45.0, 45.0)),
    part=st.floats(0.0, 0.95),
    turn=st.floats(0.0, 2.0 * math.pi),
)
def test_any_camera_inverts_before_its_fold(radial, decentred, tilt, part, turn) -> None:
    """Points before the fold and in front of the sensor are inverted to 1e-9 px where the inverse does not magnify."""
    (k1, k2, k3, k4, k5, k6), (p1, p2, *s) = radial, decentred
    given_ = camera(k1, k2, p1, p2, k3, k4, k5, k6, *s, tilt=tilt)
    radius = part * min(given_.invertible_radius, 0.6)
    point = np.array([642.5 + 1700.0 * radius * math.cos(turn), 509.25 + 1650.0 * radius * math.sin(turn)])
    measured = given_.distort(point)
    if np.isnan(measured).any():  # behind the tilted sensor
        x, y = reference.distort(*((point - [642.5, 509.25]) / [1700.0, 1650.0]), given_.distortion)
        a, b = np.radians(tilt)
        assert math.sin(b) * x - math.cos(b) * math.sin(a) * y + math.cos(b) * math.cos(a) <= 1e-12
    else:
        magnified = np.linalg.norm(given_.jacobian(measured), 2)
        size = 1e-12 * np.abs(measured).max()
        np.testing.assert_allclose(given_.undistort(measured), point, rtol=0, atol=max(1e-9, size * magnified))


def test_where_opencv_fails() -> None:
    """OpenCV's default of five steps has errors of tens of pixels here, without a warning."""
    matrix = ((800.0, 0.0, 640.0), (0.0, 800.0, 512.0), (0.0, 0.0, 1.0))
    given_ = camera(-0.4, tilt=(20.0, 0.0), matrix=matrix)
    radius = np.linspace(0.0, 0.912, 50)[:, None, None] * 800.0
    angles = np.linspace(0.0, 6.2, 40)
    points = ((640.0, 512.0) + radius * np.stack([np.cos(angles), np.sin(angles)], -1)).reshape(-1, 2)
    measured = given_.distort(points)
    theirs = cv2.undistortPoints(measured[:, None], *given_.to_opencv(), P=np.array(matrix))[:, 0]
    assert np.abs(theirs - points).max() > 50.0
    # A thousandth before the fold the inverse magnifies 500 times.
    np.testing.assert_allclose(given_.undistort(measured), points, rtol=0, atol=1e-9)


# ---- the fold ------------------------------------------------------------------------------------------------


def test_fold_in_closed_form() -> None:
    unit = camera(-0.4, matrix=np.eye(3))
    fold = 1.0 / math.sqrt(1.2)
    assert unit.invertible_radius == pytest.approx(fold, rel=1e-14)
    inside, outside = np.array([[fold * (1.0 - 1e-9), 0.0]]), np.array([[fold * (1.0 + 1e-9), 0.0]])
    assert np.isfinite(unit.distort(inside)).all()
    assert np.isnan(unit.distort(outside)).all()
    # The image of the fold is at 2/3; the inverse has a square-root singularity there, so half of the digits remain.
    np.testing.assert_allclose(unit.undistort([[fold / 1.5 * (1.0 - 1e-12), 0.0]]), [[fold, 0.0]], rtol=2e-6)
    assert np.isnan(unit.undistort([[fold / 1.5 * (1.0 + 1e-9), 0.0], [5.0, 0.0], [-1.0, 30.0]])).all()


FOLDING = {
    "k1": (-0.3,),
    "k1 k2 k3": (-0.3, 0.05, 0.0, 0.0, -0.01),
    "barrel then back": (-0.5, 0.1),
    "tangential": (-0.3, 0.02, 0.02, -0.03),
    "prism": (-0.25, 0.0, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.03, -0.02, 0.02, 0.01),
    "rational": (0.1, 0.0, 0.0, 0.0, 0.0, 0.5, 0.1, 0.05),
    "rational decentred": (0.1, 0.0, 0.01, 0.02, 0.0, 0.5, 0.1, 0.05),
}


@pytest.mark.parametrize(
    "coefficients",
    [
        pytest.param(each, marks=pytest.mark.slow if name in ("k1 k2 k3", "tangential", "rational") else [])
        for name, each in FOLDING.items()
    ],
    ids=FOLDING,
)
def test_fold_along_rays(coefficients: tuple[float, ...]) -> None:
    unit = camera(*coefficients, matrix=np.eye(3))
    finite = 0
    for angle in np.linspace(0.1, 6.3, 17):
        fold = reference.fold_radius(angle, unit.distortion, 6.0)
        direction = np.array([math.cos(angle), math.sin(angle)])
        if math.isinf(fold):
            assert np.isfinite(unit.distort(5.9 * direction)).all()
            continue
        finite += 1
        before, beyond = (fold - 1e-3) * direction, (fold + 1e-3) * direction
        assert unit.invertible_radius < fold
        assert np.isfinite(unit.distort(before)).all()
        assert np.isnan(unit.distort(beyond)).all()
        np.testing.assert_allclose(unit.undistort(unit.distort(before)), before, rtol=0, atol=1e-11)
        assert np.isnan(unit.distort(np.linspace(1.001, 5.0, 300)[:, None] * beyond)).all()
    assert finite > 5


def test_a_pole_is_a_fold() -> None:
    unit = camera(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, matrix=np.eye(3))
    assert unit.invertible_radius == pytest.approx(1.0)
    points = np.array([[0.999, 0.0], [1.001, 0.0], [0.0, 3.0]])
    np.testing.assert_array_equal(np.isnan(unit.distort(points)[:, 0]), [False, True, True])
    np.testing.assert_allclose(unit.undistort(unit.distort(points[:1])), points[:1], rtol=1e-12)


def test_no_fold() -> None:
    assert camera().invertible_radius == math.inf
    assert camera(0.1, 0.02).invertible_radius == math.inf
    far = np.array([[4e3, -4e3]])
    np.testing.assert_allclose(camera(0.1, 0.02).undistort(camera(0.1, 0.02).distort(far)), far, rtol=1e-12)


def test_behind_a_tilted_sensor_there_is_nothing() -> None:
    given_ = camera(tilt=(45.0, 0.0))
    seen = given_.distort([[642.5, 509.25 + 1650.0 * 0.99], [642.5, 509.25 + 1650.0 * 1.01]])
    np.testing.assert_array_equal(np.isnan(seen[:, 0]), [False, True])


def test_covers() -> None:
    assert camera(-0.12, 0.08).covers((1280, 1024))
    wide = ((800.0, 0.0, 640.0), (0.0, 800.0, 512.0), (0.0, 0.0, 1.0))
    assert not camera(-0.4, matrix=wide).covers((1280, 1024))


def test_the_whole_border_is_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pixel of the border is tested, and no pixel beyond it; a single one without an ideal point suffices."""
    border = {(x, y) for x in range(5) for y in range(4) if x in (0, 4) or y in (0, 3)}
    asked: list[tuple[int, int]] = []
    for lost in (None, *sorted(border)):
        asked.clear()

        def undistort(_: Camera, points: np.ndarray, lost: object = lost) -> np.ndarray:
            asked.extend((int(x), int(y)) for x, y in points)
            return np.array([[np.nan] * 2 if each == lost else each for each in asked], np.float64)

        monkeypatch.setattr(Camera, "undistort", undistort)
        assert camera(-0.12).covers((5, 4)) == (lost is None)
        assert set(asked) == border


# ---- other properties ---------------------------------------------------------------------------------------


def test_another_matrix_for_the_ideal_pixels(any_camera: Camera) -> None:
    points = image_points()
    expected = reference.distort_pixels(points, MATRIX, any_camera.distortion, ANOTHER).astype(np.float64)
    measured = any_camera.distort(points, matrix=ANOTHER)
    np.testing.assert_allclose(measured, expected, rtol=0, atol=FEW_ROUNDINGS)
    np.testing.assert_allclose(any_camera.undistort(measured, matrix=ANOTHER), points, rtol=0, atol=1e-9)


def test_jacobian_against_differences(any_camera: Camera) -> None:
    points, step = any_camera.distort(image_points()[::7]), 1e-3
    for axis, offset in enumerate(step * np.eye(2)):
        difference = (any_camera.undistort(points + offset) - any_camera.undistort(points - offset)) / (2.0 * step)
        # Rounding of 1e-12 pixels divided by the step, plus third derivatives times the squared step.
        np.testing.assert_allclose(any_camera.jacobian(points)[:, :, axis], difference, rtol=0, atol=1e-8)


def test_project_and_rays(any_camera: Camera, rng: np.random.Generator) -> None:
    rotation, translation = cv2.Rodrigues(np.array([0.1, -0.2, 0.3]))[0], np.array([0.01, -0.02, 0.9])
    scene = rng.uniform(-0.15, 0.15, (5, 8, 3))
    seen = any_camera.project(scene, rotation, translation)
    assert seen.shape == (5, 8, 2)
    vector = cv2.Rodrigues(rotation)[0]
    expected = cv2.projectPoints(scene.reshape(-1, 1, 3), vector, translation, *any_camera.to_opencv())[0]
    np.testing.assert_allclose(seen.reshape(-1, 2), expected[:, 0], rtol=0, atol=FEW_ROUNDINGS)
    towards = scene @ rotation.T + translation
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    np.testing.assert_allclose(any_camera.rays(seen), towards, rtol=0, atol=1e-12)
    assert np.isnan(any_camera.project([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])).all()


@pytest.mark.parametrize("points", [[[math.nan, 1.0]], [[math.inf, 0.0]], [[1e300, -1e300]]])
def test_not_finite_stays_so(any_camera: Camera, points: list[list[float]]) -> None:
    for result in (any_camera.distort(points), any_camera.undistort(points)):
        assert result.shape == (1, 2)
        # A pinhole camera maps even 1e300 correctly.
        assert np.isnan(result).any() or np.isfinite(points).all()


def test_shapes() -> None:
    given_ = CAMERAS["all"]
    for shape in ((0, 2), (2,), (3, 4, 2)):
        points = np.full(shape, 300.0)
        assert given_.distort(points).shape == given_.undistort(points).shape == shape
        assert given_.rays(points).shape == (*shape[:-1], 3)


@pytest.mark.parametrize("count", [0, 4, 5, 8, 12, 14])
def test_opencv_coefficients_both_ways(count: int) -> None:
    coefficients = np.array([*FULL, 0.1, -0.2])[:count]
    given_ = Camera.from_opencv(np.array(MATRIX), coefficients[None])
    matrix, back = given_.to_opencv()
    np.testing.assert_array_equal(matrix, MATRIX)
    np.testing.assert_array_equal(back, np.pad(coefficients, (0, 14 - count)))
    np.testing.assert_allclose(given_.distort(image_points()), by_opencv(image_points(), given_), atol=FEW_ROUNDINGS)


def test_table_round_trip(any_camera: Camera) -> None:
    assert Camera.from_dict(any_camera.to_dict()) == any_camera
    assert set(camera(-0.1, tilt=(3.0, 0.0)).to_dict()) == {"matrix", "k1", "tauX"}


def test_code_is_compiled_only_where_needed() -> None:
    no_terms = {"CAMERA": None, "CAMERA_RADIAL": 0, "CAMERA_RATIONAL": 0}
    assert camera().defines() == no_terms
    assert camera(-0.1, 0.02).defines() == no_terms | {"CAMERA_RADIAL": 2}
    assert camera(0.0, 0.0, 0.0, 1e-3).defines(MATRIX) == no_terms | {"CAMERA_DECENTRED": None}
    full = {"CAMERA_DECENTRED", "CAMERA_PRISM", "CAMERA_TILTED", "CAMERA_MATRICES"}
    assert set(CAMERAS["all"].defines(ANOTHER)) == set(no_terms) | full
    assert CAMERAS["all"].defines()["CAMERA_RATIONAL"] == 3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: camera(matrix=np.eye(2)), r"Camera.matrix has shape \(2, 2\)"),
        (lambda: camera(matrix=((0.0, 0, 1), (0, 1, 1), (0, 0, 1))), "focal lengths 0 and 1, expected numbers above 0"),
        (lambda: camera(matrix=((1, 0.1, 1), (0, 1, 1), (0, 0, 1))), r"expected \(\(fx, 0, cx\)"),
        (lambda: camera(math.nan), "Camera.distortion has a number that is not finite"),
        (lambda: camera(tilt=(90.0, 0.0)), "less than a right angle"),
        (lambda: Camera(matrix=MATRIX, distortion=(0.1,)), r"shape \(1,\), expected \(14,\)"),
        (lambda: Camera.from_opencv(MATRIX, np.zeros(6)), "got 6 numbers, expected 4, 5, 8, 12 or 14"),
        (lambda: Camera.from_dict({"k1": 1.0}), "'matrix' is missing"),
        (lambda: Camera.from_dict({"matrix": MATRIX, "k7": 1.0}), "unknown key 'k7'"),
        (lambda: camera().undistort([[0.0, 0.0]], matrix=np.zeros((3, 3))), "focal lengths 0 and 0"),
    ],
)
def test_what_is_wrong_is_told(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
