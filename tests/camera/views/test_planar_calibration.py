"""Calibration of tilted and other cameras from views of a flat target."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest

from gpuvision.camera.patterns.pattern import PatternGrid
from gpuvision.camera.views.diagnosis import DEFAULT_LIMITS
from gpuvision.camera.views.parameters import FIT_PARAMETERS
from gpuvision.camera.views.planar_calibration import _prepare, _starting_states, fit_camera
from gpuvision.camera.views.target_views import make_view
from tilted_camera import (
    KINDS,
    TILTED,
    calibrate_with_opencv,
    scene,
    through_float32,
)

TILTS = (0, 10, 20, 30, 40, 45)


def found(fit):
    """Return the parameters in the order of Scene.truth."""
    matrix, distortion = fit.camera.to_opencv()
    return np.array([matrix[0, 0], matrix[0, 2], matrix[1, 2], *distortion[[0, 1, 12, 13]]])


def random_scene(kind, tilt, seed):
    """Draw a scene: distortion of 0.3 to 20 px at the corner, noise of 0.02 to 0.2 px."""
    rng = np.random.default_rng([seed, tilt, len(kind), ord(kind[0])])
    corner = None if kind == "grid" and seed % 2 else 10.0 ** rng.uniform(math.log10(0.3), math.log10(20.0))
    sigma = 10.0 ** rng.uniform(math.log10(0.02), math.log10(0.2))
    made = scene(rng, kind, tilt, corner_px=corner, views=10 + seed % 3)
    return made, made.views(rng, sigma), sigma


def check(made, fit, sigma):
    """Check that the fit is the global minimum, and that the truth is within the uncertainty."""
    free = 2 * sum(map(len, made.targets)) - 6 * len(made.targets) - 7
    # The residual of the global minimum has a chi-squared distribution: within 5 standard deviations.
    assert fit.sigma_px == pytest.approx(sigma, rel=5.0 / math.sqrt(2.0 * free))
    at_truth = [cv2.Rodrigues(rotation)[0] for rotation in made.rotations]
    assert len(fit.poses) == len(at_truth)
    # The virtual camera is well determined even if the centre is not: chi-squared of 3 degrees of freedom, 1e-9.
    error = found(fit) - made.truth
    spread = fit.covariance
    f, v = fit.sensor.virtual_focal_length, np.array(fit.sensor.virtual_centre)
    axis = np.array([-math.sin(made.truth[6]) * math.cos(made.truth[5]), math.sin(made.truth[5])])
    true_f = made.truth[0] * math.cos(made.truth[5]) * math.cos(made.truth[6])
    assert abs(f - true_f) < 0.05 * true_f
    assert np.linalg.norm(v - (made.truth[1:3] - made.truth[0] * axis)) < 0.05 * true_f
    # A poorly known centre is not normally distributed; its ellipsoid is then not checked.
    if spread[1, 1] + spread[2, 2] < 25.0:
        assert error @ np.linalg.solve(spread, error) < 60.0


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("kind", KINDS)
def test_a_cold_start_never_fails(kind, tilt, draws):
    for seed in range(draws(4, 10) if kind == "grid" else draws(2, 5)):
        made, views, sigma = random_scene(kind, tilt, seed)
        check(made, fit_camera(views, made.size, model="tilt"), sigma)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("kind", KINDS)
def test_many_cold_starts_never_fail(kind, tilt, draws):
    """120 starts find a failure rate of 2.5 % with a probability of 95 %, 2400 (nightly) one of 0.125 %."""
    for seed in range(draws(10, 10, 200)):
        made, views, sigma = random_scene(kind, tilt, 1000 + seed)
        check(made, fit_camera(views, made.size, model="tilt"), sigma)


@pytest.mark.slow
@pytest.mark.parametrize(("tilt", "draws"), [(0, 3), (20, 3), (30, 25)])
def test_never_worse_than_opencv(tilt, draws):
    """On the same points, in single precision as OpenCV requires; equal residuals are accepted."""
    stuck = 0
    for seed in range(draws):
        made, views, sigma = random_scene("grid", tilt, seed)
        views = through_float32(views)
        fit = fit_camera(views, made.size, model="tilt")
        rms = calibrate_with_opencv(views, made.size)[0]
        assert fit.rms_px <= rms * (1.0 + 1e-7)
        stuck += rms > 2.0 * math.sqrt(2.0) * sigma
    assert stuck < draws


@pytest.mark.parametrize("tilt", [0, 20, 45])
def test_exact_points_give_the_exact_camera(tilt, rng):
    made = scene(rng, "grid", tilt)
    fit = fit_camera(made.views(rng, 0.0), made.size, model="tilt")
    np.testing.assert_allclose(found(fit), made.truth, rtol=1e-7, atol=1e-8)
    for pose, rotation, translation in zip(fit.poses, made.rotations, made.translations, strict=True):
        np.testing.assert_allclose(pose.rotation, rotation, atol=1e-8)
        np.testing.assert_allclose(pose.translation, translation, rtol=1e-7, atol=1e-8)
    assert fit.rms_px < 1e-6


def test_residuals_and_rms_are_those_of_the_camera(rng):
    made = scene(rng, "grid", 20)
    views = made.views(rng, 0.1)
    views[2][1][5:9] = np.nan
    fit = fit_camera(views, made.size, model="tilt")
    every = []
    for (target, image), pose, residual in zip(views, fit.poses, fit.residuals, strict=True):
        expected = image - fit.camera.project(target, pose.rotation, pose.translation)
        np.testing.assert_allclose(residual, expected, atol=1e-8)
        every.append(expected[np.isfinite(expected[:, 0])])
    assert np.isnan(fit.residuals[2][5:9]).all()
    assert fit.rms_px == pytest.approx(math.sqrt(np.mean(np.sum(np.concatenate(every) ** 2, axis=1))))


def test_predicted_covariance_is_the_bound(rng):
    """The Cramer-Rao bound is computed from OpenCV's derivatives."""
    for tilt in (0, 20, 45):
        made = scene(rng, "grid", tilt)
        fit = fit_camera(made.views(rng, 0.0), made.size, model="tilt", sigma=0.1)
        bound = made.bound(0.1)
        np.testing.assert_allclose(np.sqrt(np.diag(fit.covariance)), np.sqrt(np.diag(bound)), rtol=1e-4)
        unit = np.sqrt(np.diag(bound))
        np.testing.assert_allclose(fit.covariance / np.outer(unit, unit), bound / np.outer(unit, unit), atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "tilt", "corner"), [("grid", 20, None), ("grid", 45, None), ("dots", 10, 10.0)])
def test_errors_reach_the_bound_and_deviations_cover_them(kind, tilt, corner, rng, draws):
    """150 draws determine a coverage of 95 % to 1.8 %, and an rms error to 5.8 %; 600 (nightly) to 0.9 % and 2.9 %."""
    count = draws(150, 150, 600)
    wider = math.sqrt(600 / count)
    made = scene(rng, kind, tilt, corner_px=corner, views=10 if kind == "grid" else 5)
    errors, covered, poses = [], [], []
    for _ in range(count):
        fit = fit_camera(made.views(rng, 0.1), made.size, model="tilt")
        errors.append(found(fit) - made.truth)
        covered.append(np.abs(errors[-1]) <= 1.96 * np.sqrt(np.diag(fit.covariance)))
        poses.append(_pose_in_deviations(fit, made))
    coverage = np.mean(covered, axis=0)
    np.testing.assert_array_less(np.abs(coverage - 0.95), 0.03 * wider)
    np.testing.assert_array_less(np.abs(np.mean(np.abs(poses) <= 1.96, axis=0) - 0.95), 0.03 * wider)
    against_bound = np.sqrt(np.mean(np.square(errors), axis=0) / np.diag(made.bound(0.1)))
    np.testing.assert_array_less(np.abs(against_bound - 1.0), 0.1 * wider)


def _pose_in_deviations(fit, made):
    """Return the error of the first pose divided by its predicted standard deviation."""
    turn = cv2.Rodrigues(made.rotations[0] @ fit.poses[0].rotation.T)[0].ravel()
    error = np.array([*turn, *(made.translations[0] - fit.poses[0].translation)])
    return error / np.sqrt(np.diag(fit.pose_covariance[0]))


@pytest.mark.parametrize(
    ("tilt", "corner", "model"),
    [(0, 0.0, "none"), (0, 10.0, "k1,k2"), (20, 10.0, "tilt"), (5, 3.0, "tilt")],
)
def test_the_smallest_sufficient_model_is_chosen(tilt, corner, model, rng):
    made = scene(rng, "dots", tilt, corner_px=corner, direction=1.0)
    fit = fit_camera(made.views(rng, 0.05), made.size)
    assert fit.model == model
    assert {each.model for each in fit.alternatives} | {model} == {"none", "k1", "k1,k2", "tilt,k1", "tilt"}
    for other in fit.alternatives:
        assert other.rms_px >= fit.rms_px or other.parameters > len(fit.names) or other.p_value >= 0.001
        assert other.centre_distance_px == pytest.approx(
            math.dist(other.centre, (fit.camera.matrix[0][2], fit.camera.matrix[1][2]))
        )


def test_each_named_model_frees_what_it_names(rng):
    made = scene(rng, "grid", 0)
    views = made.views(rng, 0.1)
    for model, names in (
        ("none", "f cx cy"),
        ("k1", "f cx cy k1"),
        ("k1,k2,p1,p2,k3", "f cx cy k1 k2 p1 p2 k3"),
        ("tilt,k1", "f cx cy k1 tauX tauY"),
        ("tilt", "f cx cy k1 k2 tauX tauY"),
    ):
        fit = fit_camera(views, made.size, model=model)
        assert fit.names == tuple(names.split())
        assert fit.model == model
        assert fit.alternatives == ()
        coefficients = dict(zip(("k1", "k2", "p1", "p2", "k3"), fit.camera.distortion[:5], strict=True))
        assert {name for name, value in coefficients.items() if value} == set(fit.names) & set(coefficients)
    fit = fit_camera(views, made.size, model="k1,k2", free_aspect=True)
    assert fit.names == ("fx", "fy", "cx", "cy", "k1", "k2")
    assert abs(fit.camera.matrix[0][0] - fit.camera.matrix[1][1]) < 5.0 * fit.uncertainties["fx"]


@pytest.mark.parametrize("loss", ["huber", "tukey"])
def test_outliers_do_little_harm(loss, rng):
    made = scene(rng, "grid", 15)
    views = made.views(rng, 0.1)
    clean = fit_camera(views, made.size, model="tilt")
    for _, image in views:
        wrong = rng.random(len(image)) < 0.2
        image[wrong] += rng.normal(0.0, 30.0, (wrong.sum(), 2))
    fit = fit_camera(views, made.size, loss=loss)
    assert fit.model == "tilt"
    error = found(fit) - made.truth
    assert error @ np.linalg.solve(fit.covariance, error) < 30.0
    assert np.sqrt(fit.covariance[0, 0]) < 2.0 * np.sqrt(clean.covariance[0, 0])
    plain = fit_camera(views, made.size, model="tilt")
    assert any("loss='tukey'" in each for each in plain.warnings)


def test_noise_above_the_given_one_is_said(rng):
    made = scene(rng, "grid", 15)
    views = made.views(rng, 0.1)
    for sigma, ratio in ((0.05, "2.0 times the given noise"), (0.1, None)):
        said = [each for each in fit_camera(views, made.size, model="tilt", sigma=sigma).warnings if "noise" in each]
        assert [ratio in each for each in said] == ([True] if ratio else [])


def test_a_view_that_is_all_wrong_is_named(rng):
    made = scene(rng, "grid", 10)
    views = made.views(rng, 0.1)
    views[3] = (views[3][0], views[3][1] + rng.normal(0.0, 30.0, views[3][1].shape))
    with pytest.raises(ValueError, match=r"views \[3\] do not fit the others"):
        fit_camera(views, made.size, model="tilt", loss="tukey")
    fit = fit_camera(views, made.size, model="tilt", loss="huber")
    assert fit.camera.matrix[0][0] == pytest.approx(1700.0, abs=5.0 * fit.uncertainties["f"])


def test_alpha_has_a_deviation_even_where_it_is_0(rng):
    made = scene(rng, "grid", 0)
    views = made.views(rng, 0.1)
    fit = fit_camera(views, made.size, model="tilt")
    assert 0.0 < fit.alpha_sigma < 0.001
    assert fit.alpha_sigma >= 0.99 * min(fit.uncertainties["tauX"], fit.uncertainties["tauY"])
    assert any("within its own uncertainty" in each for each in fit.warnings)
    assert fit_camera(views, made.size, model="k1,k2").alpha_sigma == 0.0


def test_tukey_on_clean_points_costs_five_percent(rng):
    """The tuning constant is chosen for 95 % efficiency."""
    made = scene(rng, "grid", 20)
    views = made.views(rng, 0.1)
    plain, robust = (fit_camera(views, made.size, model="tilt", loss=loss) for loss in ("squared", "tukey"))
    ratio = np.diag(robust.covariance) / np.diag(plain.covariance)
    np.testing.assert_allclose(ratio, 1.0 / 0.95, rtol=0.05)


@pytest.mark.parametrize("tilt", TILTS)
@pytest.mark.parametrize("kind", KINDS)
def test_one_view_with_a_known_focal_length(kind, tilt, draws):
    for seed in range(draws(3, 10)):
        rng = np.random.default_rng(seed)
        made = scene(rng, kind, tilt, corner_px=10.0, views=1, weakest=5.0)
        fit = fit_camera(made.views(rng, 0.05), made.size, model="tilt", focal_length=made.truth[0])
        assert fit.camera.matrix[0][0] == pytest.approx(made.truth[0], rel=1e-12)
        free = 2 * len(made.targets[0]) - 12
        assert fit.sigma_px == pytest.approx(0.05, rel=5.0 / math.sqrt(2.0 * free))
        error = (found(fit) - made.truth)[1:]
        # Chi-squared of 6 degrees of freedom at 1e-6, with a margin for the less certain centre of a single view.
        assert error @ np.linalg.solve(fit.covariance, error) < 45.0


def test_one_view_of_an_untilted_sensor_with_a_known_focal_length(rng):
    """No closed form gives a start: it comes from the search for the scale, which then has the known one only."""
    made = scene(rng, "grid", 0, corner_px=10.0, views=1, weakest=5.0)
    fit = fit_camera(made.views(rng, 0.05), made.size, model="k1,k2", focal_length=made.truth[0])
    error = (found(fit) - made.truth)[1:5]
    assert fit.sigma_px == pytest.approx(0.05, rel=5.0 / math.sqrt(2.0 * (2 * len(made.targets[0]) - 10)))
    assert error @ np.linalg.solve(fit.covariance[:4, :4], error) < 40.0  # chi-squared of 4 at 1e-7


@pytest.mark.parametrize("fixed", [{}, {"centre": (639.5, 511.5)}])
def test_the_start_is_exact_where_the_homographies_are(fixed, rng):
    """Exact points, no tilt, and a lens about the middle of the image: the closed form leaves nothing to adjust."""
    made = scene(rng, "grid", 0, corner_px=8.0, views=4)
    middle = 0.5 * (np.array(made.size) - 1.0)
    made.matrix[:2, 2] = middle
    views = []
    for target, rotation, translation in zip(made.targets, made.rotations, made.translations, strict=True):
        vector = cv2.Rodrigues(rotation)[0]
        views.append((target, cv2.projectPoints(target, vector, translation, made.matrix, made.distortion)[0][:, 0]))
    task = _prepare(views, made.size, None, fixed.get("centre"), "squared", None, False, DEFAULT_LIMITS)
    for model, free in (("k1,k2", ("k1", "k2")), ("tilt", ("k1", "k2")), ("k1", ("k1",)), ("none", ())):
        start = next(_starting_states(task, task.free_parameters(model)))
        values = dict(zip(FIT_PARAMETERS, start.values, strict=True))
        coefficients = dict(zip(("k1", "k2"), made.distortion, strict=False))
        expected = {"f": made.matrix[0, 0], "aspect": 1.0, "v_column": middle[0], "v_row": middle[1]}
        expected |= {"c_column": middle[0], "c_row": middle[1]} | {name: coefficients[name] for name in free}
        for name, value in values.items():
            assert value == pytest.approx(expected.get(name, 0.0), rel=1e-4, abs=1e-9), (model, name)
        np.testing.assert_allclose(start.rotations, made.rotations, atol=1e-6)
        np.testing.assert_allclose(start.translations, made.translations, rtol=1e-5, atol=1e-7)


def test_the_search_covers_three_tilts_in_eight_directions(rng):
    """About the centre, in units of half the diagonal of the image; the distance of v from it is f' sin(alpha)."""
    made = scene(rng, "grid", 0, corner_px=5.0, views=1)
    middle, radius = 0.5 * (np.array(made.size) - 1.0), 0.5 * math.hypot(*made.size)
    given = {None: [0.6, 1.2, 2.5, 5.0, 10.0], 2000.0: [2000.0 / radius]}
    for focal_length, scales in given.items():
        task = _prepare(made.views(rng, 0.0), made.size, focal_length, None, "squared", None, False, DEFAULT_LIMITS)
        for model, count in (("k1", 1), ("tilt", 17)):
            starts = [*_starting_states(task, task.free_parameters(model))]
            searched = np.array([each.values for each in starts[-count * len(scales) :]])
            assert len(starts) - len(searched) <= (model == "tilt" and focal_length is not None)
            offsets = (searched[:, 2:4] - middle) / radius
            f = searched[:, 0] / radius
            length = np.hypot(f, np.hypot(*offsets.T))
            np.testing.assert_allclose(np.sort(length), np.sort(np.repeat(scales, count)), rtol=1e-12)
            alphas = np.arctan2(np.hypot(*offsets.T), f)
            assert {round(float(each), 9) for each in alphas} == ({0.0, 0.35, 0.7} if count > 1 else {0.0})
            tilted = alphas > 0.1
            steps = np.arctan2(offsets[tilted, 1], offsets[tilted, 0]) / (math.pi / 4.0)
            np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)
            seen = {
                (*np.round((a, s), 6), int(n) % 8)
                for a, s, n in zip(alphas[tilted], length[tilted], np.rint(steps), strict=True)
            }
            assert len(seen) == (count - 1) * len(scales)


def test_a_known_centre_fixes_the_tilt_without_distortion(rng):
    made = scene(rng, "grid", 20, corner_px=0.0)
    views = made.views(rng, 0.1)
    fit = fit_camera(views, made.size, model="tilt", centre=tuple(made.truth[1:3]))
    assert math.degrees(fit.sensor.alpha) == pytest.approx(20.0, abs=5.0 * math.degrees(fit.alpha_sigma))
    assert math.degrees(fit.alpha_sigma) < 0.01
    np.testing.assert_array_equal(found(fit)[1:3], made.truth[1:3])


def test_it_says_when_tilt_and_centre_cannot_be_told_apart(rng):
    """Corner distortion 10 px: determined. 0.3 px: 20 px of centre at equal residual. 0: the virtual camera only."""
    warnings = {}
    for corner in (10.0, 0.3, 0.0):
        made = scene(rng, "dots", 10, corner_px=corner, direction=1.0)
        views = made.views(rng, 0.05)
        fit = fit_camera(views, made.size, model="tilt")
        warnings[corner] = (
            any("tell tilt from centre" in each for each in fit.warnings),
            fit.uncertainties["cx"],
            fit.rms_px,
        )
    assert not warnings[10.0][0]
    assert warnings[10.0][1] < 1.0
    assert warnings[0.3][0]
    assert 3.0 < warnings[0.3][1] < 60.0
    assert warnings[0.0][0]
    np.testing.assert_allclose([each[2] for each in warnings.values()], 0.05 * math.sqrt(2.0), rtol=0.05)
    # The alternatives contain the untilted camera that fits equally well.
    chosen = fit_camera(views, made.size)
    assert chosen.model == "none"
    assert any("a sensor tilted by" in each for each in chosen.warnings)
    assert any("fits as well" in each for each in chosen.warnings)


@pytest.mark.slow
def test_targets_square_to_an_untilted_sensor_fix_no_focal_length(rng):
    made = scene(rng, "grid", 0, steepest=0.0)
    for sigma in (0.0, 0.1):
        with pytest.raises(ValueError, match="do not determine the focal length"):
            fit_camera(made.views(rng, sigma), made.size)
    fit = fit_camera(made.views(rng, 0.1), made.size, focal_length=1700.0, model="k1,k2")
    np.testing.assert_allclose(found(fit)[:3], made.truth[:3], atol=5.0)
    weak = scene(rng, "grid", 0, steepest=1.0)
    assert any("focal length" in each for each in fit_camera(weak.views(rng, 0.1), weak.size, model="tilt").warnings)


def test_a_sensor_of_8000_pixels(rng):
    made = scene(rng, "grid", 30)
    views = [(target, 6.25 * image) for target, image in made.views(rng, 0.016)]
    fit = fit_camera(views, (8000, 6400), model="tilt")
    assert fit.sigma_px == pytest.approx(0.1, rel=0.05)
    assert fit.camera.matrix[0][0] == pytest.approx(6.25 * 1700.0, abs=5.0 * fit.uncertainties["f"])


def test_missing_points_and_half_of_the_grid(rng):
    made = scene(rng, "grid", 20)
    views = made.views(rng, 0.1)
    holes = [(target, np.where(rng.random((len(image), 1)) < 0.4, np.nan, image)) for target, image in views]
    halves = [(target[len(target) // 2 :], image[len(image) // 2 :]) for target, image in views]
    for lacking in (holes, halves):
        fit = fit_camera(lacking, made.size, model="tilt")
        error = found(fit) - made.truth
        assert error @ np.linalg.solve(fit.covariance, error) < 30.0


def test_mirrored_images(rng):
    made = scene(rng, "grid", 20)
    views = made.views(rng, 0.1)
    plain = fit_camera(views, made.size, model="tilt")
    flipped = [(target, image * [-1.0, 1.0] + [made.size[0] - 1.0, 0.0]) for target, image in views]
    fit = fit_camera(flipped, made.size, model="tilt")
    # The fit finds the mirrored camera and warns, because the targets have left-handed coordinates.
    expected = found(plain) * [1.0, -1.0, 1.0, 1.0, 1.0, 1.0, -1.0] + [0.0, made.size[0] - 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(found(fit), expected, rtol=1e-5, atol=1e-7)
    assert any("mirrored" in each for each in fit.warnings)
    assert not any("mirrored" in each for each in plain.warnings)
    for unit in (1e-3, 1.0, 1e3):
        mixed = [(unit * target, image) for target, image in (*views[:3], flipped[3], *views[4:])]
        with pytest.raises(ValueError, match=r"views \[3\] show the target from its other side"):
            fit_camera(mixed, made.size)


def _lacking(views):
    target, image = views[0]
    row = target[:, 1] == target[0, 1]
    corners = [0, 1, -2, -1]
    one_beside = np.append(np.flatnonzero(row), len(target) - 1)
    return {
        "no views given": [],
        "at least 4": [(target[:3], image[:3]), *views[1:]],
        "0 measured points": [(target, np.full_like(image, np.nan)), *views[1:]],
        "one line": [*views[1:], (target[row], image[row])],
        "view 1: all points lie on one line": [views[1], (target[one_beside], image[one_beside])],
        "give focal_length": views[:1],
        "too few": [(target[corners], image[corners]), (views[1][0][corners], views[1][1][corners])],
        "plane Z = 0": [(target + np.array([0.0, 0.0, 0.1]), image), *views[1:]],
        "expected \\(n, 2": [(target, image[:-1]), *views[1:]],
    }


def test_too_few_points_for_the_smallest_model(rng):
    """Of one view of four points a camera has 3 parameters and the pose 6: more than the 8 coordinates."""
    target, image = scene(rng, "grid", 10, views=1).views(rng, 0.1)[0]
    corners = [0, 1, -2, -1]
    message = "4 points in 1 views are too few for the 9 unknowns of model 'none'"
    with pytest.raises(ValueError, match=f"^{message}$"):
        fit_camera([(target[corners], image[corners])], (1280, 1024))


@pytest.mark.parametrize("message", _lacking([(np.zeros((8, 3)), np.zeros((8, 2)))] * 3))
def test_what_the_views_lack(message, rng):
    made = scene(rng, "grid", 10, views=3)
    with pytest.raises(ValueError, match=message) as raised:
        fit_camera(_lacking(made.views(rng, 0.1))[message], made.size, model="tilt")
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "tilt,p1"}, "cannot be separated"),
        ({"model": "k9"}, "unknown term"),
        ({"loss": "cauchy"}, "expected one of squared, huber, tukey"),
        ({"sigma": 0.0}, "above 0"),
        ({"focal_length": -1.0}, "focal_length is -1, expected a number above 0"),
        ({"focal_length": 0.0}, "focal_length is 0, expected a number above 0"),
        ({"centre": (1.0, 2.0, 3.0)}, "shape"),
    ],
)
def test_options_out_of_bounds(options, message, rng):
    made = scene(rng, "grid", 10, views=2)
    with pytest.raises(ValueError, match=message):
        fit_camera(made.views(rng, 0.1), made.size, **options)


def test_an_image_size_in_the_wrong_order(rng):
    made = scene(rng, "grid", 10, views=3)
    with pytest.raises(ValueError, match="outside an image of 512 columns and 1280 rows"):
        fit_camera(made.views(rng, 0.1), (512, 1280))


def test_a_view_of_a_grid():
    points = np.arange(24.0).reshape(3, 4, 2)
    points[1, 2] = np.nan
    for grid in (points, PatternGrid(points=points, sigma=0.1)):
        target, image = make_view(grid, 0.5)
        np.testing.assert_array_equal(target[6], [1.0, 0.5, 0.0])
        np.testing.assert_array_equal(image[7], points[1, 3])
    with pytest.raises(ValueError, match="rows, columns"):
        make_view(points[0], 0.5)


def _chessboards(data):
    # Whole numbers: OpenCV's single precision holds them exactly.
    target = np.zeros((54, 3))
    target[:, :2] = np.mgrid[0:9, 0:6].T.reshape(-1, 2)
    views = []
    for path in sorted((data / "calibration" / "chessboard").glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        corners = cv2.findChessboardCorners(image, (9, 6))[1]
        corners = cv2.cornerSubPix(image, corners, (11, 11), (-1, -1), (cv2.TERM_CRITERIA_EPS, 30, 1e-3))
        views.append((target, corners.reshape(-1, 2).astype(np.float64)))
    return views, image.shape[::-1]


@pytest.mark.slow
@pytest.mark.realdata
def test_chessboards_as_well_as_opencv(data):
    views, size = _chessboards(data)
    assert len(views) == 13
    square = cv2.CALIB_FIX_ASPECT_RATIO
    plain = cv2.CALIB_ZERO_TANGENT_DIST
    models = {
        "none": plain | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
        "k1": plain | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3,
        "k1,k2": plain | cv2.CALIB_FIX_K3,
        "k1,k2,k3": plain,
        "k1,k2,p1,p2": cv2.CALIB_FIX_K3,
        "k1,k2,p1,p2,k3": 0,
        "tilt": TILTED & ~square,
    }
    for model, flags in models.items():
        for free_aspect in (False, True):
            fit = fit_camera(views, size, model=model, free_aspect=free_aspect)
            rms, matrix, _ = calibrate_with_opencv(views, size, flags | (0 if free_aspect else square))
            assert fit.rms_px <= rms * (1.0 + 1e-9)
            assert fit.camera.matrix[0][0] == pytest.approx(matrix[0, 0], rel=1e-4)
    # The best tilt is 0.4 degrees; errors that differ from view to view explain as much.
    assert fit.error_model == "correlated"
    assert any("is within its own uncertainty" in each for each in fit.warnings)
