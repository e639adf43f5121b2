"""Plan of a placement: search ranges and predicted covariances by hand, and the choice of the guidance."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.formats.machine_file import read_machine
from gpuvision.matching.features.feature_set import FeatureSet
from gpuvision.matching.features.fiducials import Fiducials
from gpuvision.matching.features.imaging import Imaging
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.placement import plan
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine, PlacementCamera
from gpuvision.servoing.placement.plan import landing_range, placement_imaging, tracking_imaging
from gpuvision.status import Status

PRESET = read_machine("look_while_place")
PIXEL = PRESET.camera.pixel
PLACEMENT = np.array([3e-3, -2e-3])
ROWS = ("point", "normal", "spacing", "length", "sigma")  # of the rulers of a feature set


def features(etch_bias_sigma: float = 8e-6) -> FeatureSet:
    """Return single edges, edges across traces, and fiducials with and without a hole, at places on no axis."""
    rng = np.random.default_rng(5)
    angle = rng.uniform(-np.pi, np.pi, 7)
    marks = Fiducials(
        PLACEMENT + rng.uniform(-2e-3, 2e-3, (3, 2)),
        np.full(3, 3e-4),
        np.array([0.0, 2e-4, 0.0]),
        np.array([0.3e-6, 0.2e-6, 0.5e-6]),
    )
    return FeatureSet(
        side="top",
        placement=PLACEMENT,
        point=PLACEMENT + rng.uniform(-2e-3, 2e-3, (7, 2)),
        normal=np.stack([np.cos(angle), np.sin(angle)], axis=1),
        spacing=np.array([0.0, 1e-4, 0.0, 0.0, 2e-4, 0.0, 1e-4]),
        length=np.full(7, 1e-3),
        sigma=np.array([0.2, 0.3, 0.4, 0.25, 0.35, 0.15, 0.5]) * 1e-6,
        imaging=Imaging(pixel=PIXEL, etch_bias_sigma=etch_bias_sigma),
        covariance=np.eye(3),
        condition=2.0,
        region=np.zeros((2, 2)),
        fiducials=marks,
    )


def equations(found: FeatureSet) -> list[tuple[list[float], float, float, bool]]:
    """Return for each measured coordinate its derivatives, sigma, error of the sampling, and whether it is a ruler."""
    rows: list[tuple[list[float], float, float, bool]] = []
    for point, normal, spacing, sigma in zip(found.point, found.normal, found.spacing, found.sigma, strict=True):
        x, y = point - found.placement
        lever = float(normal[1] * x - normal[0] * y)
        rows.append(([*normal, lever, float(spacing == 0.0)], sigma, 0.02 * PIXEL, True))
    marks = found.fiducials
    for point, hole, sigma in zip(marks.point, marks.hole, marks.sigma, strict=True):
        x, y = point - found.placement
        rest = (0.02 if hole else 0.003) * PIXEL
        rows += [([1.0, 0.0, -y, 0.0], sigma, rest, False), ([0.0, 1.0, x, 0.0], sigma, rest, False)]
    return rows


def test_covariance_of_noise_and_of_etch_bias_add_up_to_the_posterior() -> None:
    """The estimate by the noise of each row, and by the etch bias, which shifts the edges of single rulers."""
    found = features()
    rows = equations(found)
    design, sigma = np.array([each[0] for each in rows]), np.array([each[1] for each in rows])
    prior = np.diag([0.0, 0.0, 0.0, 1.0 / 8e-6**2])
    estimator = np.linalg.solve(design.T @ (design / sigma[:, None] ** 2) + prior, design.T / sigma**2)
    noise, etch_bias = plan._split_covariance(found)
    np.testing.assert_allclose(noise, ((estimator * sigma**2) @ estimator.T)[:3, :3], rtol=1e-9)
    # A bias b moves the measured edges by b times their factor: what the estimate of x, y, theta moves by.
    moved = 8e-6 * (estimator @ design[:, 3])
    np.testing.assert_allclose(etch_bias, np.outer(moved, moved)[:3, :3], rtol=1e-6, atol=1e-30)


def test_rounding_of_the_inverse_makes_no_variance_of_the_etch_bias_negative(monkeypatch: pytest.MonkeyPatch) -> None:
    """Seen on a board whose edges face each other: rounding alone determined both elements, with opposite signs."""
    inverse = np.linalg.inv

    def rounded(matrix: Any) -> Any:
        found = inverse(matrix)
        found[1, 3], found[3, 1] = 3e-22, -2e-22
        return found

    monkeypatch.setattr(np.linalg, "inv", rounded)
    _, etch_bias = plan._split_covariance(features())
    assert etch_bias[1, 1] == pytest.approx((3e-22 / 8e-6) ** 2, rel=1e-12, abs=0.0)


def test_covariance_of_the_sampling_is_that_of_weighted_least_squares() -> None:
    found = features()
    rows = equations(found)
    design, sigma, rest = (np.array([each[k] for each in rows]) for k in (0, 1, 2))
    prior = np.diag([0.0, 0.0, 0.0, 1.0 / 8e-6**2])
    weight = 1.0 / (sigma**2 + rest**2)
    posterior = np.linalg.inv(design.T @ (design * weight[:, None]) + prior)
    estimator = posterior @ (design.T * weight)
    sampling, reported = plan._sampling_and_reported(found)
    np.testing.assert_allclose(sampling, ((estimator * rest**2) @ estimator.T)[:3, :3], rtol=1e-9)
    np.testing.assert_allclose(reported, posterior[:3, :3], rtol=1e-9)


def test_largest_leverage_is_that_of_the_hat_matrix() -> None:
    found = features(etch_bias_sigma=0.0)
    design = np.array([[*each[0][:3]] for each in equations(found)])
    sigma = np.array([each[1] for each in equations(found)])
    weighted = design / sigma[:, None]
    hat = weighted @ np.linalg.pinv(weighted)
    # Without an etch bias its prior keeps it at 0: three unknowns are left.
    assert plan._largest_leverage(found) == pytest.approx(float(np.diag(hat).max()), rel=1e-4)


def machine(*, gain: float = 0.4, observer: str = "latest", axes: Any = PRESET.axes, **camera: Any) -> Machine:
    motion = (1e-6, 1e-6, 1e-4) if observer == "kalman" else None
    name: Any = observer
    return dataclasses.replace(
        PRESET,
        control=Control(observer=name, gain=gain, motion_sigma=motion),
        axes=axes,
        camera=dataclasses.replace(PRESET.camera, **camera),
        pipette_in_camera=Transform.rigid("pipette", "camera", (3e-3, -4e-3, 0.1)),
    )


def test_search_range_of_the_landing_and_of_the_frames_after_it() -> None:
    """The nozzle is 5 mm from the camera, and turns by up to 5 mrad: 100 um and 25 um; a pixel is added."""
    found = machine(gain=0.1)
    assert landing_range(found) == pytest.approx(125e-6)
    wide, near = placement_imaging(found), tracking_imaging(found)
    assert (wide.shift, wide.angle, wide.pixel) == (100e-6, 5e-3, PIXEL)
    assert wide.blur_px == pytest.approx(math.hypot(PRESET.camera.blur_px, math.sqrt(1.0 / 12.0)))
    assert near.shift == pytest.approx(0.1 * 125e-6 + PIXEL)
    assert near.angle == pytest.approx(0.1 * 5e-3 + 1.0 / 256.0)
    # Not wider than the landing zone.
    assert (tracking_imaging(machine(gain=0.9)).shift, tracking_imaging(machine(gain=0.9)).angle) == (100e-6, 5e-3)
    # A turn moves the border of the window, its shorter side, by a pixel.
    near = tracking_imaging(machine(gain=0.05, window=(512, 480)))
    assert near.angle == pytest.approx(0.05 * 5e-3 + 1.0 / 240.0)


@pytest.mark.parametrize(
    ("observer", "axis", "part"),
    [
        ("smith", Axis(), 0.1),
        ("kalman", Axis(), 0.1),
        ("smith", Axis(lag=1e-3), 0.1),
        ("latest", Axis(), 1.0),
        ("smith", Axis(lag=1e-3, viscous=1.0), 1.0),
        ("smith", Axis(lag=1e-3, coulomb=1.0), 1.0),
        ("smith", Axis(resonance=300.0), 1.0),
    ],
)
def test_an_observer_that_predicts_the_motion_leaves_a_tenth_of_it(observer: str, axis: Axis, part: float) -> None:
    """Of one axis, too: friction and a resonance are not in its model."""
    for number in range(3):
        axes = [Axis()] * 3
        axes[number] = axis
        near = tracking_imaging(machine(gain=0.2, observer=observer, axes=tuple(axes)))
        assert near.shift == pytest.approx(part * 0.2 * 125e-6 + PIXEL)


@pytest.mark.parametrize(("scale", "is_precise"), [(0.999, True), (1.001, False)])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_three_standard_deviations_must_be_within_the_tolerance(
    monkeypatch: pytest.MonkeyPatch, axis: int, scale: float, is_precise: bool
) -> None:
    zone = PRESET.tolerance
    limit = np.array([zone.position, zone.position, zone.angle]) / 3.0
    sigma = 0.3 * limit
    sigma[axis] = scale * limit[axis]
    noise = np.diag(sigma**2)
    monkeypatch.setattr(plan, "_split_covariance", lambda _: (noise, None))
    monkeypatch.setattr(plan, "move_covariance", lambda covariance, *_: covariance)
    assert plan._is_precise(features(), np.zeros(3), PRESET) == is_precise


class Guidance(plan._Guidance):
    """Selection of features whose steps have given outcomes."""

    def _select(self, view: Any, imaging: Any) -> Any:
        if imaging.shift >= 100e-6:
            return _outcome(WIDE)
        return "narrow"

    def _near(self, camera_pose: Any) -> Any:
        return _outcome(NEAR), "landing"

    def _check_views(self, poses: Any, features: Any) -> None:
        np.testing.assert_array_equal(poses, np.zeros((1, 3)))  # at the target only
        if features == "blind":
            raise ValueError(features)

    def _check(self, camera_pose: Any, landing: Any) -> None:
        assert landing == "landing"
        _outcome(LANDS)


WIDE: list[Any] = []
NEAR: list[Any] = []
LANDS: list[Any] = []


def _outcome(of: list[Any]) -> Any:
    if isinstance(of[0], Exception):
        raise of[0]
    return of[0]


@pytest.mark.parametrize(
    ("wide", "near", "lands", "expected"),
    [
        ("precise", "near", True, ("precise", None)),
        ("coarse", "near", True, ("near", "landing")),
        ("coarse", ValueError("near"), True, ("coarse", None)),
        ("coarse", "near", ValueError("lands"), ("coarse", None)),
        (ValueError("wide"), "near", True, ("near", "landing")),
        ("blind", "near", True, ("near", "landing")),
        ("blind", ValueError("near"), True, "near"),
        (ValueError("wide"), ValueError("near"), True, "near"),
        (ValueError("wide"), "near", ValueError("lands"), "lands"),
    ],
)
def test_rulers_of_the_landing_zone_are_used_where_they_are_precise(
    monkeypatch: pytest.MonkeyPatch, wide: Any, near: Any, lands: Any, expected: Any
) -> None:
    monkeypatch.setattr(plan, "_is_precise", lambda found, *_: found == "precise")
    WIDE[:], NEAR[:], LANDS[:] = [wide], [near], [lands]
    nothing: Any = None
    guidance = Guidance(
        artwork=nothing, machine=machine(gain=0.1), reflectance=nothing, budget=60, threshold=1.0, device=None
    )
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected):
            guidance.at(np.zeros(3))
    else:
        assert guidance.at(np.zeros(3)) == expected
    is_near, is_landing = (not isinstance(each, Exception) for each in (near, lands))
    assert guidance.works(np.zeros(3), machine()) == is_near
    assert guidance.lands(np.zeros(3), machine()) == (is_near and is_landing)


@pytest.mark.parametrize(
    ("condition", "leverage", "message"),
    [
        (300.0, 0.95, ""),
        (300.1, 0.95, "the edges hardly separate a direction of the pose"),
        (300.0, 0.951, "a direction of the pose depends on one edge only"),
    ],
)
def test_features_that_hardly_determine_the_pose_are_refused(
    monkeypatch: pytest.MonkeyPatch, condition: float, leverage: float, message: str
) -> None:
    found = dataclasses.replace(features(), condition=condition)
    monkeypatch.setattr(plan, "select_features_in_view", lambda *_, with_hint: found)
    monkeypatch.setattr(plan, "_largest_leverage", lambda _: leverage)
    nothing: Any = None
    guidance = plan._Guidance(
        artwork=nothing, machine=PRESET, reflectance=nothing, budget=60, threshold=1.0, device=None
    )
    if message:
        with pytest.raises(ValueError, match=message):
            guidance._select(nothing, nothing)
    else:
        assert guidance._select(nothing, nothing) is found


def test_refused_starts_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    flags = [Status.LOW_SIGNAL, Status.AMBIGUOUS, Status.LOW_SIGNAL]
    monkeypatch.setattr(plan, "refused_starts", lambda *_, **__: flags)
    nothing: Any = None
    guidance = plan._Guidance(
        artwork=nothing, machine=PRESET, reflectance=nothing, budget=60, threshold=1.0, device=None
    )
    with pytest.raises(ValueError, match=r"refuses 3 of 5 starts .* \(AMBIGUOUS and LOW_SIGNAL\), such"):
        guidance._check(np.zeros(3), nothing)
    flags.clear()
    guidance._check(np.zeros(3), nothing)


@pytest.mark.parametrize("normal", [(0.6, 0.8), (1.0, 0.0), (0.0, 1.0)])
def test_rows_that_do_not_determine_the_pose_have_the_largest_leverage(normal: tuple[float, float]) -> None:
    """Two rulers, parallel rulers, and a third direction by a single one."""
    found = features()
    nothing = found.fiducials.subset(np.zeros(3, bool))
    rows = {name: getattr(found, name)[:2] for name in ROWS}
    assert plan._largest_leverage(dataclasses.replace(found, **rows, fiducials=nothing)) == 1.0
    parallel = np.tile(normal, (7, 1))
    assert plan._largest_leverage(dataclasses.replace(found, normal=parallel, fiducials=nothing)) == 1.0
    parallel[3] = [normal[1], -normal[0]]
    single = dataclasses.replace(found, normal=parallel, fiducials=nothing)
    assert plan._largest_leverage(single) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("column", "message"), [(30, ""), (31, "in view of 18 of 27 starts in the landing zone")])
def test_features_must_be_in_view_from_each_start(column: int, message: str) -> None:
    """Two rulers of 32 samples fix x: they end 10.5 or 9.5 px from the border of the window; the zone is 10 px."""
    camera = dataclasses.replace(PRESET.camera, window=(113, 113))
    still = dataclasses.replace(PRESET.tolerance, landing_angle=1e-6)
    nothing: Any = None
    guidance = plan._Guidance(
        artwork=nothing,
        machine=dataclasses.replace(PRESET, camera=camera, tolerance=still),
        reflectance=nothing,
        budget=60,
        threshold=1.0,
        device=None,
    )
    places = [(column, 3), (-column, -3), (-20, 20), (20, 20), (-20, -20), (20, -20)]
    found = dataclasses.replace(
        features(),
        placement=np.zeros(2),
        point=PIXEL * np.array(places, float),
        normal=np.array(2 * [(1.0, 0.0)] + 4 * [(0.0, 1.0)]),
        spacing=np.full(6, 3.0 * PIXEL),
        length=np.full(6, 15.0 * PIXEL),
        sigma=np.full(6, 1e-6),
        fiducials=features().fiducials.subset(np.zeros(3, bool)),
    )
    if message:
        with pytest.raises(ValueError, match=message):
            guidance._check_views(guidance._starts(np.zeros(3)), found)
    else:
        guidance._check_views(guidance._starts(np.zeros(3)), found)


def test_the_registration_needs_its_least_number_of_rulers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan._Guidance, "_select", lambda *_: "features")
    monkeypatch.setattr(plan._Guidance, "_check_views", lambda *_: None)
    asked: list[Any] = []
    for count, is_refused in ((11, True), (12, False)):
        landing = SimpleNamespace(
            rulers=SimpleNamespace(point=np.zeros((count, 2))), limits=SimpleNamespace(min_rulers=12)
        )
        monkeypatch.setattr(
            plan, "prepare_board_registration", lambda *a, landing=landing, **how: (asked.append(how), landing)[1]
        )
        nothing: Any = None
        guidance = plan._Guidance(
            artwork=nothing, machine=machine(), reflectance=nothing, budget=60, threshold=7.0, device=None
        )
        if is_refused:
            with pytest.raises(ValueError, match="11 places on edges have room for the coarse registration"):
                guidance._near(np.zeros(3))
        else:
            assert guidance._near(np.zeros(3)) == ("features", landing)
    how = asked[0]
    assert how["shift"] == pytest.approx(125e-6)
    assert (how["angle"], how["threshold"], how["tolerance_px"]) == (5e-3, 7.0, 1.0)
    assert how["blur_px"] == pytest.approx(math.hypot(PRESET.camera.blur_px, math.sqrt(1.0 / 12.0)))


def test_errors_of_the_nozzle_turn_with_the_camera() -> None:
    found: Any = object.__new__(plan.PlacementPlan)
    object.__setattr__(found, "camera_pose", np.array([1.0, 2.0, 0.3]))
    c, s = math.cos(0.3), math.sin(0.3)
    np.testing.assert_allclose(found.camera_to_board, [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], atol=1e-15)


def test_window_and_light_of_a_camera() -> None:
    sensor: CmosSensor = PRESET.camera.sensor
    camera = PlacementCamera(sensor=sensor, pixel=1e-5, window=(16, 40), exposure=1e-4)
    assert camera.white_electrons == pytest.approx(0.8 * sensor.saturation)
    assert dataclasses.replace(camera, electrons=123.0).white_electrons == 123.0
    assert (camera.blur_px, camera.mirrored, camera.window_lens) == (0.5, False, None)
    assert camera.edge_blur_px == pytest.approx(math.sqrt(0.25 + 1.0 / 12.0))
    assert camera.reach_px == pytest.approx(math.hypot(16, 40) / 2.0)
    view = camera.view(np.array([1e-3, 2e-3, 0.3]))
    assert (view.scale, view.shape, view.pose, view.mirrored) == (1e-5, (16, 40), (1e-3, 2e-3, 0.3), False)
    for window, message in (((15, 40), "window rows is 15"), ((16, 15), "window columns is 15")):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(camera, window=window)
    rows, columns = sensor.shape
    dataclasses.replace(camera, window=(rows, columns))
    with pytest.raises(ValueError, match=f"window columns is {columns + 1}"):
        dataclasses.replace(camera, window=(rows, columns + 1))


def test_a_refusal_without_advice_searches_for_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> Any:
        raise ValueError("too few edges; more")

    monkeypatch.setattr(plan._Guidance, "at", refuse)
    monkeypatch.setattr(plan, "explain_refusal", lambda reason, *_: f"explained: {reason}")
    artwork: Any = SimpleNamespace(side="top")
    with pytest.raises(ValueError, match=r"^too few edges; more$"):
        plan.plan_placement(artwork, (0.0, 0.0, 0.0), PRESET, advises=False)
    with pytest.raises(ValueError, match=r"^explained: too few edges; more$"):
        plan.plan_placement(artwork, (0.0, 0.0, 0.0), PRESET)
