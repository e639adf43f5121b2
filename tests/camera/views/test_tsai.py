"""Tsai's two stages on one view of a flat target."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.camera.views.tsai import fit_tsai, radial_alignment
from tilted_camera import scene

CENTRE = (640.0, 500.0)


def _view(rotation, translation, f=1700.0, kappa=0.0, noise=0.0, seed=1):
    """Return a view of a grid by an untilted camera, distorted by eq. 3.9."""
    row, column = np.indices((9, 12)).reshape(2, -1) * 0.01
    target = np.stack([column, row, 0.0 * row], axis=1)
    placed = target @ rotation.T + translation
    image = Lens(k1=kappa, centre=CENTRE).distort(np.array(CENTRE) + f * placed[:, :2] / placed[:, 2:])
    return target, image + np.random.default_rng(seed).normal(0.0, noise, image.shape)


def _rotation(x, y, z):
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return about_x @ about_y @ np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1.0]])


POSES = {
    "oblique": (_rotation(0.4, -0.2, 0.3), [-0.05, -0.03, 0.3]),
    "its origin on the row of the centre": (_rotation(0.4, 0.1, 0.0), [-0.05, 0.0, 0.3]),
    "its origin on the axis": (_rotation(-0.3, 0.3, 1.0), [0.0, 0.0, 0.3]),
    "upside down": (_rotation(0.3, 0.2, 3.0), [0.05, 0.04, 0.3]),
    "from behind": (_rotation(3.0, 0.3, 0.0), [-0.05, 0.05, 0.3]),
}


@pytest.mark.parametrize("kappa", [0.0, 1.2e-8, -3e-8])
@pytest.mark.parametrize("name", POSES)
def test_exact_points_give_the_exact_camera(name, kappa):
    rotation, translation = POSES[name]
    target, image = _view(rotation, np.array(translation), kappa=kappa)
    fit = fit_tsai(target, image, CENTRE)
    assert fit.focal_length == pytest.approx(1700.0, rel=1e-8)
    # In pixels at the corner: r = 800.
    assert fit.lens.k1 * 800.0**3 == pytest.approx(kappa * 800.0**3, abs=1e-6)
    np.testing.assert_allclose(fit.pose.rotation, rotation, atol=1e-8)
    np.testing.assert_allclose(fit.pose.translation, translation, atol=1e-8)
    assert fit.rms_px < 1e-6


def test_alignment_needs_neither_focal_length_nor_distortion():
    rotation, translation = POSES["oblique"]
    for f, kappa in ((500.0, 0.0), (1700.0, 3e-8), (4000.0, -3e-9)):
        target, image = _view(rotation, np.array(translation), f=f, kappa=kappa)
        alignment = radial_alignment(target, image, CENTRE)
        np.testing.assert_allclose(alignment.shift, translation[:2], atol=1e-9)
        assert min(np.abs(each - rotation).max() for each in alignment.rotations) < 1e-8
        for each in alignment.rotations:
            np.testing.assert_allclose(each @ each.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(each) == pytest.approx(1.0)


@pytest.mark.parametrize("count", [5, 6])
def test_five_points_determine_the_alignment(count):
    """Five equations of six unknowns: the solution is the vector that no equation sees."""
    rotation, translation = POSES["oblique"]
    target, image = _view(rotation, np.array(translation))
    few = np.array([0, 11, 50, 96, 107, 31])[:count]
    alignment = radial_alignment(target[few], image[few], CENTRE)
    np.testing.assert_allclose(alignment.shift, translation[:2], atol=1e-9)
    assert min(np.abs(each - rotation).max() for each in alignment.rotations) < 1e-8


@pytest.mark.parametrize(("count", "distorted"), [(5, True), (9, False), (108, True)])
def test_the_deviation_is_that_of_the_second_stage(count, distorted):
    """Of f, the distance and k1: their derivatives by differences; spare coordinates count, and 0.01 px at least."""
    rotation, translation = POSES["oblique"]
    for noise in (0.0, 0.5):
        target, image = _view(rotation, np.array(translation), kappa=1e-8, noise=noise)
        chosen = np.array([0, 11, 50, 96, 107, 31, 62, 20, 85, *range(12, 20)])[:count] if count < 108 else slice(None)
        target, image = target[chosen], image[chosen]
        fit = fit_tsai(target, image, CENTRE, distorted=distorted)
        offset = image - CENTRE
        square = np.sum(offset**2, axis=1, keepdims=True)
        placed = target @ fit.pose.rotation.T + fit.pose.translation

        def errors(f, distance, kappa, offset=offset, square=square, placed=placed):
            ideal = f * placed[:, :2] / (placed[:, 2:] + distance)
            return (offset * (1.0 + kappa * square) - ideal).ravel()

        known = (fit.focal_length, 0.0, fit.lens.k1 if distorted else 0.0)
        steps = np.diag([1e-2, 1e-6, 1e-13])[: 3 if distorted else 2]
        slopes = [(errors(*(known + h)) - errors(*(known - h))) / (2.0 * h.max()) for h in steps]
        scale = np.linalg.norm(slopes, axis=1)
        inverse = np.linalg.inv((slopes / scale[:, None]) @ (slopes / scale[:, None]).T)[0, 0] / scale[0] ** 2
        rest = errors(*known)
        variance = max(rest @ rest / (len(rest) - len(steps)), 1e-4)
        assert fit.focal_length_sigma == pytest.approx(np.sqrt(variance * inverse), rel=1e-4)
        assert fit.rms_px == pytest.approx(np.sqrt(2.0 * np.mean(rest**2)), abs=1e-9)


def test_noise_moves_the_focal_length_by_its_deviation():
    rotation, translation = POSES["oblique"]
    errors, deviations = [], []
    for seed in range(60):
        target, image = _view(rotation, np.array(translation), kappa=1e-8, noise=0.1, seed=seed)
        fit = fit_tsai(target, image, CENTRE)
        errors.append(fit.focal_length - 1700.0)
        deviations.append(fit.focal_length_sigma)
    # The rotation is the result of the first stage and is not refined: the predicted deviation excludes this error.
    assert np.sqrt(np.mean(np.square(errors))) < 3.0 * np.mean(deviations)
    assert abs(np.mean(errors)) < 0.01 * 1700.0


def test_a_known_focal_length_gives_the_distance_of_a_parallel_target():
    target, image = _view(np.eye(3), np.array([-0.05, -0.03, 0.3]))
    with pytest.raises(ValueError, match="parallel"):
        fit_tsai(target, image, CENTRE)
    fit = fit_tsai(target, image, CENTRE, focal_length=1700.0)
    assert fit.focal_length_sigma == 0.0
    np.testing.assert_allclose(fit.pose.translation, [-0.05, -0.03, 0.3], atol=1e-8)


def test_a_tilted_sensor_is_beyond_it(rng):
    """Documented limit: at 20 degrees the pose error is degrees, with fit_camera hundredths of a degree."""
    made = scene(rng, "grid", 20.0, views=1, weakest=15.0)
    fit = fit_tsai(made.targets[0], made.exact[0], tuple(made.matrix[:2, 2]), focal_length=1700.0)
    turn = fit.pose.rotation @ made.rotations[0].T
    assert np.degrees(np.arccos(0.5 * (np.trace(turn) - 1.0))) > 1.0


def test_missing_points_are_left_out():
    rotation, translation = POSES["oblique"]
    target, image = _view(rotation, np.array(translation))
    image[::3] = np.nan
    assert fit_tsai(target, image, CENTRE, distorted=False).focal_length == pytest.approx(1700.0, rel=1e-8)
    assert fit_tsai(target, image, CENTRE, distorted=False).lens is None


@pytest.mark.parametrize(
    ("keep", "message"), [(slice(0, 4), "at least 5"), (slice(0, 12), "one line"), (slice(0, 0), "at least 5")]
)
def test_what_the_points_lack(keep, message):
    rotation, translation = POSES["oblique"]
    target, image = _view(rotation, np.array(translation))
    with pytest.raises(ValueError, match=message):
        fit_tsai(target[keep], image[keep], CENTRE)
    with pytest.raises(ValueError, match="equal numbers"):
        fit_tsai(target, image[:-1], CENTRE)
