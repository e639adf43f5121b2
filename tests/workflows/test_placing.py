"""Placements on a rendered board with the true image processing, by the function and by the command."""

from __future__ import annotations

import dataclasses
import json
import re
import tomllib
from collections.abc import Callable
from importlib import resources
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest
import tomli_w

from boards import LAYERS, board_folder, narrow_pads
from gpuvision.cli.main import application
from gpuvision.formats.machine_file import read_machine
from gpuvision.host import Device
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.features.feature_set import edge_clearance
from gpuvision.matching.pose.motion import rotation
from gpuvision.servoing.frames import Transform, compose_poses, invert_pose, move_covariance
from gpuvision.servoing.loop import SimulatedClock
from gpuvision.servoing.margins import margins
from gpuvision.servoing.placement.budget import predict_budget
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import Machine, ThermalDrift
from gpuvision.servoing.placement.placing import place_part
from gpuvision.servoing.placement.plan import placement_imaging, plan_placement
from gpuvision.servoing.placement.vision import BoardPoseSensor, Frame, SimulatedCamera
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.workflows import placement_cell, placing
from gpuvision.workflows.placement_cell import measure_repeatability
from gpuvision.workflows.placing import PlacementResult, simulate_placements

PRESET = tomllib.loads(
    resources.files("gpuvision").joinpath("presets", "machines", "look_while_place.toml").read_text(encoding="utf-8")
)
# The camera looks at a pad of 1.2 mm and a trace beside it, 1.1 mm from the nozzle.
TARGET = (14.8e-3 + 1.0e-3, 5.9e-3 + 0.5e-3, 0.0)


@pytest.fixture(scope="module")
def machine_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("machine") / "machine.toml"
    path.write_text(tomli_w.dumps(PRESET | {"camera": PRESET["camera"] | {"window": [128, 128], "pixel": 20e-6}}))
    return path


@pytest.fixture(scope="module")
def machine(machine_file: Path) -> Machine:
    return read_machine(machine_file)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return board_folder(tmp_path_factory.mktemp("board"))


@pytest.fixture(scope="module")
def artwork(folder: Path, machine: Machine) -> Artwork:
    return read_artwork(folder, layers=LAYERS, clearance=edge_clearance(placement_imaging(machine)))


def numbered_result(monkeypatch: pytest.MonkeyPatch, landing: object = "registration") -> PlacementResult:
    """Return a result of three runs, the second one aborted, whose numbers all differ."""
    monkeypatch.setattr(
        placing, "settled_frames", lambda motion, band, *, released: len(motion) + 1 if released else None
    )
    # One frame for each micrometre of the first error, less calibration and drift.
    monkeypatch.setattr(
        placing, "predicted_settling", lambda machine, error, band: round(1e6 * float(error[0])) if band[2] > 0 else -1
    )
    monkeypatch.setattr(
        placing, "model_tolerance", lambda machine, plan: SimpleNamespace(plant_gain=1.7, longer_delay=8e-3)
    )
    sources = {"calibration": 1e-6 * np.arange(9.0).reshape(3, 3), "drift": np.full((3, 3), 2e-6)}
    rest = np.array([[5e-6, -4e-6, 3e-6], [np.nan] * 3, [-7e-6, 6e-6, 1e-6]])
    motion = tuple(
        sources["calibration"][n] + sources["drift"][n] + np.arange(3.0 * count)[::-1].reshape(count, 3) * 1e-6
        for n, count in enumerate((4, 9, 6))
    )
    machine: Any = SimpleNamespace(
        tolerance=SimpleNamespace(position=20e-6, angle=5e-3),
        landing=20e-3,
        rate=500.0,
        period=2e-3,
        loop_gain=0.3,
        delay=SimpleNamespace(parts={"exposure": 1e-3, "transfer": 3e-3}, total=4e-3, frames=2.5),
        gains=SimpleNamespace(integral=np.inf, derivative=0.01),
        control=SimpleNamespace(observer="latest", controller="pd"),
        settling=SimpleNamespace(rule="vibration", frequency=(145.0, 150.0), damping=0.03),
        error_after=lambda frames: np.full((frames, 3), 0.25),
    )
    vision, etch = np.diag([4.0, 9.0, 16.0]) * 1e-12, np.diag([1.0, 2.0, 3.0]) * 1e-12
    budget: Any = SimpleNamespace(
        total=np.diag([26.0, 51.0, 84.0]) * 1e-12,
        sources={"vision": vision, "etch bias": etch},
        sigmas={"vision": np.array([3e-6, 6e-6, 9e-6]), "sampling": np.array([4e-6, 8e-6, 12e-6])},
    )
    plan: Any = SimpleNamespace(
        landing=landing,
        target=np.array([0.01, 0.02, 0.3]),
        vision=np.diag([2.0, 3.0, 4.0]) * 1e-12,
        features=SimpleNamespace(
            length=np.zeros(7),
            fiducials=SimpleNamespace(radius=np.zeros(2)),
            imaging=SimpleNamespace(shift=33e-6),
        ),
    )
    runs = ((True, 12, 9, ""), (False, 40, 30, "no pose"), (True, 15, 10, ""))
    placements: Any = tuple(
        SimpleNamespace(
            released=released, frames=frames, predicted_frames=least, reason=reason, start_error=np.arange(3.0) + least
        )
        for released, frames, least, reason in runs
    )
    parts = {**sources, "vision and servo": rest - sources["calibration"] - sources["drift"]}
    reach = np.array([0.4, np.nan, 0.6])
    return PlacementResult(plan, machine, budget, placements, rest, motion, parts, reach)


def test_numbers_of_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands, frames and sums by hand; 20 ms of registration are 10 frames of 2 ms."""
    result = numbered_result(monkeypatch)
    np.testing.assert_allclose(result.settling_band, [0.2 * 20e-6 + 15e-6, 0.2 * 20e-6 + 30e-6, 0.2 * 5e-3 + 45e-6])
    assert result.settled == [5, None, 7]
    assert result.predicted_settling == [10 + 11, 10 + 26, 10 + 17]
    np.testing.assert_allclose(result.simulated_sigmas, [5e-6, 7e-6, 9e-6])
    assert result.response.tolist() == [[1.0] * 3] * 10 + [[0.25] * 3]  # one frame at least
    alone = numbered_result(monkeypatch, None)
    assert alone.predicted_settling == [11, 26, 17]
    assert alone.response.tolist() == [[0.25] * 3] * 9
    assert result.summary().splitlines() == [
        "2 of 3 parts placed, in 13.5 frames (the release waits for 10.5)",
        "coarse registration of the first frame: 20.0 ms",
        "observer latest, controller pd, release by vibration",
        "true error settled in 6.0 frames, predicted 24.0; not settled before the release: 1",
        "error, root mean square: x 6.08 µm, y 5.10 µm, theta 0.002 mrad",
        "error, predicted: x 5.00 µm, y 7.00 µm, theta 0.009 mrad",
        "aborted: no pose",
    ]
    assert "coarse" not in alone.summary()
    nowhere = result._replace(
        placements=(result.placements[1],) * 3, error=np.full((3, 3), np.nan), reach=np.full(3, np.nan)
    )
    assert nowhere.summary().splitlines() == [
        "0 of 3 parts placed",
        "coarse registration of the first frame: 20.0 ms",
        "aborted: no pose",
    ]
    monkeypatch.setattr(placing, "settled_frames", lambda *_, released: None)
    assert "the true error did not settle before the release" in result.summary().splitlines()


def test_report_of_a_result(monkeypatch: pytest.MonkeyPatch) -> None:
    result = numbered_result(monkeypatch)

    def pose(x: float, y: float, theta: float) -> Any:
        return pytest.approx({"x_m": x, "y_m": y, "theta_rad": theta})

    report = result.report()
    runs = report.pop("placements")
    assert report.pop("settling_band") == pose(19e-6, 34e-6, 1.045e-3)
    assert report.pop("measured_rms") == {
        "total": pose(np.sqrt(37.0) * 1e-6, np.sqrt(26.0) * 1e-6, np.sqrt(5.0) * 1e-6),
        "calibration": pose(np.sqrt(18.0) * 1e-6, 5e-6, np.sqrt(34.0) * 1e-6),
        "drift": pose(2e-6, 2e-6, 2e-6),
        "vision and servo": pose(*np.sqrt([(9 + 225) / 2, (49 + 9) / 2, (1 + 81) / 2]) * 1e-6),
    }
    assert report == {
        "gpuvision": version("gpuvision"),
        "target": {"x_m": 0.01, "y_m": 0.02, "theta_rad": 0.3},
        "rate_Hz": 500.0,
        "features": 9,
        "search_range_m": 33e-6,
        "landing_s": 20e-3,
        "period_s": 2e-3,
        "parts_s": {"exposure": 1e-3, "transfer": 3e-3},
        "total_delay_s": 4e-3,
        "delay_frames": 2.5,
        "observer": "latest",
        "controller": "pd",
        "gain_per_frame": 0.3,
        "integral_s": None,
        "derivative_s": 0.01,
        "vision_gain": pose(2.0, 3.0, 4.0),
        "tolerated_plant_gain": 1.7,
        "tolerated_delay_s": 8e-3,
        "settling": "vibration",
        "vibration_Hz": (145.0, 150.0),
        "vibration_damping": 0.03,
        "predicted_sigma": {"vision": pose(3e-6, 6e-6, 9e-6), "sampling": pose(4e-6, 8e-6, 12e-6)},
        "predicted_sigma_simulated": pose(5e-6, 7e-6, 9e-6),
    }
    assert runs == [
        {
            "released": True,
            "reason": "",
            "start_error": pose(9.0, 10.0, 11.0),
            "frames": 12,
            "predicted_frames": 10,
            "settled_frames": 5,
            "predicted_settled_frames": 21,
            "error": pose(5e-6, -4e-6, 3e-6),
            "reach_of_tolerance": 0.4,
        },
        {
            "released": False,
            "reason": "no pose",
            "start_error": pose(30.0, 31.0, 32.0),
            "frames": 40,
            "predicted_frames": 31,
            "settled_frames": None,
            "predicted_settled_frames": 36,
            "error": None,
            "reach_of_tolerance": None,
        },
        {
            "released": True,
            "reason": "",
            "start_error": pose(10.0, 11.0, 12.0),
            "frames": 15,
            "predicted_frames": 11,
            "settled_frames": 7,
            "predicted_settled_frames": 27,
            "error": pose(-7e-6, 6e-6, 1e-6),
            "reach_of_tolerance": 0.6,
        },
    ]
    gains: Any = result.machine.gains
    gains.integral = 0.7
    plain = result._replace(plan=numbered_result(monkeypatch, None).plan).report()
    assert (plain["integral_s"], plain["landing_s"], plain["tolerated_plant_gain"]) == (0.7, None, 1.7)
    monkeypatch.setattr(placing, "model_tolerance", lambda *_: None)
    plain = result._replace(error=np.full((3, 3), np.nan)).report()
    assert (plain["tolerated_plant_gain"], plain["tolerated_delay_s"]) == (None, None)
    assert set(plain["measured_rms"].values()) == {None}


def test_parts_of_the_predicted_covariance_add_up(artwork: Artwork, machine: Machine) -> None:
    plan = plan_placement(artwork, TARGET, machine)
    expected = move_covariance(plan.features.covariance, plan.camera_pose, machine.pipette_in_camera.pose)
    unit = np.sqrt(np.diag(expected))
    total = (plan.vision + plan.etch_bias) / np.outer(unit, unit)
    # The selection also counts the chance of a wrong edge, which lowers weights by some percent.
    np.testing.assert_allclose(total, expected / np.outer(unit, unit), atol=0.1)
    np.testing.assert_allclose(plan.camera_pose, (TARGET[0] - 1e-3, TARGET[1] - 0.5e-3, 0.0), atol=1e-12)
    # Half of the step of copper under the mask counts as an edge; the noise is that of the brighter side.
    board, sensor, white = BoardReflectance(), machine.camera.sensor, machine.camera.white_electrons
    sides = np.array([board.copper_masked, board.laminate_masked]) * white
    assert plan.threshold == pytest.approx(0.5 * np.ptp(sides) * sensor.gain)
    total, temporal = (float(sensor.noise(sides.max(), machine.camera.exposure, spatial=k)) for k in (True, False))
    assert plan.noise == pytest.approx(total * sensor.gain)
    assert plan.fixed_pattern == pytest.approx((total**2 - temporal**2) / total**2)


def test_parts_land_where_and_when_the_prediction_says(artwork: Artwork, machine: Machine, device: Device) -> None:
    done: list[int] = []
    result = simulate_placements(
        artwork, TARGET, machine, count=6, device=device, progress=lambda number, _: done.append(number)
    )
    assert done == [1, 2, 3, 4, 5, 6]
    for placement in result.placements:
        assert placement.released
        assert placement.predicted_frames + 1 <= placement.frames <= placement.predicted_frames + 3
    # The true error, not the measured one: five predicted sigmas in x, y and theta.
    assert np.all(np.abs(result.error) <= 5.0 * result.simulated_sigmas)
    # What calibration and drift do not explain is vision and servo, much less than the start errors of up to 90 um.
    assert np.all(np.abs(result.sources["vision and servo"][:, :2]) < 2e-6)
    assert max(np.abs(motion[0, :2]).max() for motion in result.motion) > 50e-6
    # The true error settles when theory says; the release rule has no part in this count.
    counted = [each for each in result.settled if each is not None]
    assert len(counted) == 6
    assert np.all(np.abs(np.subtract(counted, result.predicted_settling)) <= 2)
    assert abs(np.mean(counted) - np.mean(result.predicted_settling)) <= 0.7
    assert np.all(result.reach < 0.5)
    report = result.report()
    assert [each["settled_frames"] for each in report["placements"]] == counted
    # The report also counts the frame of the release.
    least = [placement.predicted_frames + 1 for placement in result.placements]
    assert [each["predicted_frames"] for each in report["placements"]] == least
    assert (report["observer"], report["controller"], report["settling"]) == ("latest", "p", "response")
    assert report["tolerated_plant_gain"] == pytest.approx(
        margins(machine.gains, machine.delay.latency, machine.period).gain
    )
    assert f"true error settled in {np.mean(counted):.1f} frames" in result.summary()
    assert report["delay_frames"] == machine.delay.frames
    assert sum(report["parts_s"].values()) == pytest.approx(report["total_delay_s"])
    assert list(report["measured_rms"]["total"].values()) == pytest.approx(np.sqrt(np.mean(result.error**2, axis=0)))
    assert len(report["placements"]) == 6
    assert "6 of 6 parts placed" in result.summary()
    # An aborted run is not settled, even if its last errors are small.
    first = result.placements[0]._replace(released=False, reason="stalled")
    error = np.vstack([np.full(3, np.nan), result.error[1:]])
    aborted = result._replace(placements=(first, *result.placements[1:]), error=error)
    assert aborted.settled == [None, *counted[1:]]
    assert [each["settled_frames"] for each in aborted.report()["placements"]] == [None, *counted[1:]]
    assert "not settled before the release: 1" in aborted.summary()


def test_the_simulated_machine_keeps_all_commands_of_a_placement(
    artwork: Artwork, machine: Machine, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A short default history of the plant changes nothing."""
    monkeypatch.setattr(
        placement_cell, "SimulatedPlant", lambda *given, **more: SimulatedPlant(*given, **{"history": 6} | more)
    )
    result = simulate_placements(artwork, TARGET, machine, count=1, device=device)
    assert result.placements[0].frames > 7
    assert result.motion[0].shape == (result.placements[0].frames, 3)


def test_the_measured_pose_of_a_head_at_rest_scatters_as_predicted(
    artwork: Artwork, machine: Machine, device: Device
) -> None:
    plan = plan_placement(artwork, TARGET, machine)
    resting = measure_repeatability(artwork, machine, plan, frames=60, device=device)
    assert resting.error.shape == (60, 3)
    ratio = np.std(resting.error, axis=0, ddof=1) / resting.frame_sigma
    # 60 frames: a standard error of 9 %. The selection counts the chance of a wrong edge, and predicts somewhat more.
    assert np.all((ratio > 0.5) & (ratio < 1.25)), ratio
    assert np.all(np.abs(np.mean(resting.error, axis=0)) < 4.0 * resting.pixel_sigma)
    # Frames are independent: their differences have twice the variance.
    steps = np.std(np.diff(resting.error, axis=0), axis=0, ddof=1) / np.std(resting.error, axis=0, ddof=1)
    np.testing.assert_allclose(steps, np.sqrt(2.0), rtol=0.25)


def test_the_covariance_of_a_measured_pose_is_the_planned_one(
    artwork: Artwork, machine: Machine, device: Device
) -> None:
    result = simulate_placements(artwork, TARGET, machine, count=1, device=device)
    reported = result.placements[0].measurements[-1].covariance
    ratio = np.sqrt(np.diag(reported) / np.diag(result.plan.reported))
    # Noise and residuals of one frame scale the reported covariance.
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


@pytest.mark.parametrize("observer", ["smith", pytest.param("kalman", marks=pytest.mark.slow)])
def test_a_predictor_places_in_two_frames_with_the_same_error(
    artwork: Artwork, machine: Machine, device: Device, observer: Literal["smith", "kalman"]
) -> None:
    """With the gain 1 the first measured pose moves the head to the target; calibration and drift limit the error."""
    motion = (30e-9, 30e-9, 3e-6) if observer == "kalman" else None
    predicting = dataclasses.replace(machine, control=Control(observer=observer, motion_sigma=motion))
    result = simulate_placements(artwork, TARGET, predicting, count=6, device=device)
    assert [each.frames for each in result.placements] == [2] * 6
    assert result.settled == result.predicted_settling == [1] * 6
    assert np.all(np.abs(result.error) <= 5.0 * result.simulated_sigmas)
    plain = predict_budget(machine, plan_placement(artwork, TARGET, machine))
    assert np.all(result.simulated_sigmas <= 1.15 * plain.sigmas["total"])


@pytest.mark.slow
def test_waiting_by_vibration_saves_30_percent_of_a_fixed_wait(
    artwork: Artwork, machine: Machine, device: Device
) -> None:
    """Parts with tolerances of 5 and 20 um; the simulation finds the vibration of the steered head by itself."""
    x = dataclasses.replace(machine.axes[0], resonance=2.0 * np.pi * 150.0, damping=0.03)
    swinging = dataclasses.replace(
        machine, axes=(x, *machine.axes[1:]), swing=(50e-6, 0.0, 0.0), control=Control(gain=0.07)
    )

    def placed(tolerance: float, rule: Settling) -> PlacementResult:
        limits = dataclasses.replace(machine.tolerance, position=tolerance)
        return simulate_placements(
            artwork,
            TARGET,
            dataclasses.replace(swinging, settling=rule, tolerance=limits),
            count=6,
            device=device,
        )

    waits = []
    for tolerance in (5e-6, 20e-6):
        result = placed(tolerance, Settling(rule="vibration"))
        assert result.machine.settling.frequency is not None
        assert result.machine.settling.frequency[0] == pytest.approx(145.0, rel=0.02)
        assert np.all(result.reach <= 1.0)
        waits += [each.record.time[-1] for each in result.placements]
    fixed = placed(5e-6, Settling(rule="fixed", wait=float(np.mean(waits)) / 0.7))
    assert np.count_nonzero(fixed.reach > 1.0) >= 1


def test_narrow_pads_are_landed_by_registration_and_tracked_by_short_rulers(tmp_path: Path, device: Device) -> None:
    """Edges of 0.34 mm have no room for rulers that cover a landing zone of 0.1 mm, but for the motion of a frame."""
    narrow_pads(tmp_path)
    machine = read_machine("look_while_place")
    layers = {name: LAYERS[name] for name in ("copper.gbr", "outline.gbr")}
    board = read_artwork(tmp_path, layers=layers, clearance=edge_clearance(placement_imaging(machine)))
    target = (9.85e-3 + 1.0e-3, 8.0e-3 + 0.5e-3, 0.0)
    result = simulate_placements(board, target, machine, count=3, device=device)
    assert result.plan.landing is not None
    # 0.1 mm and the lever of the camera times the gain of 0.2 to 0.26, and a pixel.
    assert 30e-6 < result.plan.features.imaging.shift < 38e-6
    assert max(np.abs(motion[0, :2]).max() for motion in result.motion) > 40e-6
    for placement in result.placements:
        assert placement.released
        assert 21 <= placement.predicted_frames + 1 <= placement.frames <= placement.predicted_frames + 3
        # The head rests while the first frame is registered: 20 ms.
        assert min(each.arrived for each in placement.measurements) == pytest.approx(20e-3)
    assert np.all(np.abs(result.sources["vision and servo"][:, :2]) < 2e-6)
    assert result.report()["landing_s"] == 20e-3


def test_a_pattern_that_repeats_within_the_landing_zone_is_refused_by_the_plan(
    tmp_path: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Pads at a pitch of 0.5 mm: from a corner of a zone of 0.3 mm the registration also fits the next pads."""
    # The search for another target takes a second; the test of a refused target has it.
    monkeypatch.setattr("gpuvision.servoing.placement.plan.explain_refusal", lambda reason, *_: reason)
    preset = read_machine("look_while_place")
    narrow_pads(tmp_path, rows=6, pitch=0.5)
    layers = {name: LAYERS[name] for name in ("copper.gbr", "outline.gbr")}
    target = (9.85e-3 + 1.0e-3, 8.75e-3 + 0.5e-3, 0.0)
    machine = dataclasses.replace(
        preset,
        camera=dataclasses.replace(preset.camera, window=(128, 128)),
        tolerance=dataclasses.replace(preset.tolerance, landing_zone=0.3e-3),
        control=Control(gain=0.1),
    )
    board = read_artwork(tmp_path, layers=layers, clearance=edge_clearance(placement_imaging(machine)))
    with pytest.raises(ValueError, match=r"registration refuses [1-5] of 5 starts .*AMBIGUOUS.*repeats"):
        plan_placement(board, target, machine, device=device)


def test_a_refused_target_names_where_the_camera_looks_and_a_target_that_works(
    artwork: Artwork, machine: Machine
) -> None:
    with pytest.raises(ValueError, match=r"2\.56 x 2\.56 mm is centred at") as refused:
        plan_placement(artwork, (1e-3, 1e-3, 0.0), machine)
    near = re.search(r"in view is \(([-.\d]+), ([-.\d]+)\) mm", str(refused.value))
    assert near is not None
    x, y = (1e-3 * float(each) for each in near.groups())
    plan = plan_placement(artwork, (x, y, 0.0), machine)
    assert len(plan.features.length) >= 3


def test_the_command_writes_report_and_pictures(
    folder: Path, machine_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    layers = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]
    words = ["place", folder, "--machine", machine_file, "--count", 2, *layers]
    near = [*words, "--at", "15.8mm,6.4mm,0deg", "--out", tmp_path / "out"]
    application()([str(each) for each in near], standalone_mode=False)
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert [each["released"] for each in report["placements"]] == [True, True]
    assert report["target"] == pytest.approx(dict(zip(("x_m", "y_m", "theta_rad"), TARGET, strict=True)))
    assert report["gpuvision"] == version("gpuvision")
    assert {each.name for each in (tmp_path / "out").glob("*.png")} == {
        "placements.png",
        "features.png",
        "repeatability.png",
    }
    assert report["repeatability"]["frames"] == 100
    printed = capsys.readouterr().out
    assert "2 of 2 parts placed" in printed
    far = [*words, "--at", "1mm,1mm,0deg", "--out", tmp_path / "none"]
    with pytest.raises(ValueError, match="expected 3 or more together"):
        application()([str(each) for each in far], standalone_mode=False)
    assert not (tmp_path / "none").exists()


class MirrorCamera:
    """Camera below the board: frames of a camera above the same drawing, with the columns reversed.

    A board that is turned over about its y axis has the coordinates (-x, y), in which the machine works as on a top
    side.
    """

    def __init__(
        self, board: ReflectanceMap, machine: Machine, nozzle: Callable[[np.ndarray], np.ndarray], device: Device
    ) -> None:
        turned_over = np.array([-1.0, 1.0, -1.0])
        camera_in_nozzle = invert_pose(machine.pipette_in_camera.pose)

        def above(time: np.ndarray) -> np.ndarray:
            return compose_poses(nozzle(time) * turned_over, camera_in_nozzle) * turned_over

        self._camera = SimulatedCamera(board, machine, above, np.zeros(3), device=device)
        self.dtype = self._camera.dtype

    def __call__(self, time: float) -> list[Frame]:
        return [frame._replace(image=np.ascontiguousarray(frame.image[:, ::-1])) for frame in self._camera(time)]


def bottom(layers: dict[str, str]) -> dict[str, str]:
    return {name: layer.replace("top", "bottom") for name, layer in layers.items()}


@pytest.mark.parametrize("is_narrow", [False, True], ids=["rulers", "registration"])
def test_a_part_lands_on_the_bottom_side(
    folder: Path, machine: Machine, tmp_path: Path, device: Device, *, is_narrow: bool
) -> None:
    """Calibration and start error have all three components; the frames come from a rendering of the top side."""
    if is_narrow:
        machine = read_machine("look_while_place")
        folder, target = narrow_pads(tmp_path), np.array([10.85e-3, 8.5e-3, 0.2])
    else:
        target = np.array([*TARGET[:2], 0.2])
    covariance = np.diag([1e-6, 2e-6, 1e-4]) @ [[1.0, 0.5, 0.2], [0.5, 1.0, 0.3], [0.2, 0.3, 1.0]]
    nozzle = Transform.rigid("pipette", "camera", (-1.0e-3, 0.5e-3, 0.1), covariance @ np.diag([1e-6, 2e-6, 1e-4]))
    machine = dataclasses.replace(machine, pipette_in_camera=nozzle)
    layers = {name: layer for name, layer in LAYERS.items() if (folder / name).exists()}
    clearance = edge_clearance(placement_imaging(machine))
    above = read_artwork(folder, layers=layers, clearance=clearance)
    artwork = read_artwork(folder, side="bottom", layers=bottom(layers), clearance=clearance)
    below = machine.for_side("bottom")
    plan = plan_placement(artwork, target, below)
    assert (plan.landing is not None) == is_narrow
    centre, half = plan.camera_pose[:2], 2.5e-3
    board = ReflectanceMap.of(
        above, pixel=machine.camera.pixel, region=(centre - half, centre + half), blur_px=machine.camera.blur_px
    )
    plant = SimulatedPlant(machine.axes, start=target + np.array([60e-6, -40e-6, 2e-3]))
    camera = MirrorCamera(board, machine, plant.pose, device)
    sensor = BoardPoseSensor(camera, below, plan, camera.dtype, device=device)
    landing = machine.landing if is_narrow else 0.0
    placement = place_part(below, target, plant, sensor, SimulatedClock(), landing=landing)
    assert placement.released
    error = plant.pose(placement.record.time[-1]) - target
    np.testing.assert_allclose(error[:2], 0.0, atol=2e-6)
    assert abs(error[2]) < 1e-3
    # The budget in the files' frame: the errors of the nozzle on the turned-over board, with x and theta reversed.
    turn, mirror = np.eye(3), np.diag([-1.0, 1.0, -1.0])
    turn[:2, :2] = rotation(-float(plan.camera_pose[2]))
    expected = mirror @ turn @ machine.pipette_in_camera.pose_covariance @ turn.T @ mirror
    found = predict_budget(below, plan).sources["calibration"]
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_a_machine_is_turned_to_a_side_and_back(artwork: Artwork, machine: Machine) -> None:
    machine = dataclasses.replace(machine, drift=ThermalDrift(expansion=(1e-6, 2e-6), temperature_sigma=1.0))
    below = machine.for_side("bottom")
    assert below.for_side("bottom") is below
    assert below.drift.expansion == (-1e-6, 2e-6)
    again = below.for_side("top")
    np.testing.assert_allclose(again.pipette_in_camera.matrix, machine.pipette_in_camera.matrix, atol=1e-15)
    assert (again.drift, again.camera) == (machine.drift, machine.camera)
    with pytest.raises(ValueError, match=r"the artwork shows the top side; use machine.for_side\('top'\)"):
        plan_placement(artwork, TARGET, below)


def test_the_command_places_on_the_bottom_side(folder: Path, machine_file: Path, tmp_path: Path) -> None:
    layers = [word for name, layer in bottom(LAYERS).items() for word in ("--layers", f"{name}={layer}")]
    words = ["place", folder, "--machine", machine_file, "--count", 1, "--side", "bottom", *layers]
    # The camera is 1 mm beside the nozzle, in x on the other side than above the top side.
    words += ["--at", "13.8mm,6.4mm,0deg", "--out", tmp_path / "out"]
    application()([str(each) for each in words], standalone_mode=False)
    (placement,) = json.loads((tmp_path / "out" / "report.json").read_text())["placements"]
    assert placement["released"]
    assert abs(placement["error"]["x_m"]) < 5e-6


@pytest.mark.slow
@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "window", "target"),
    [
        ("eagle", 256, (43.547e-3, 4.252e-3)),
        ("upverter", 512, (-48.98e-3, 35.925e-3)),
        ("kicad-x2-tests/x2ap", 512, (75.934e-3, -47.0486e-3)),
    ],
)
def test_three_sigma_on_real_boards_are_below_half_a_pixel(
    data: Path, name: str, window: int, target: tuple[float, float]
) -> None:
    """Pixels of 10 um at 1 kHz: 5 um, and the number of frames of theory."""
    preset = read_machine("look_while_place")
    machine = dataclasses.replace(preset, camera=dataclasses.replace(preset.camera, window=(window, window)))
    board = read_artwork(data / "gerber" / name, clearance=edge_clearance(placement_imaging(machine)))
    result = simulate_placements(board, (*target, 0.0), machine, count=10)
    assert all(each.released for each in result.placements)
    assert np.all(3.0 * np.sqrt(np.mean(result.error[:, :2] ** 2, axis=0)) <= 5e-6)
    waited = [each.frames - each.predicted_frames - 1 for each in result.placements]
    assert np.mean(waited) <= 1.0
    # The frames in which the true error settles, against theory.
    counted = np.array([each for each in result.settled if each is not None])
    assert len(counted) == 10
    assert abs(np.mean(counted - result.predicted_settling)) <= 0.6


class Cell:
    """Cell that notes what it places; the second part is not released."""

    made: list[Any]

    def __init__(self, *given: Any) -> None:
        self.made.append(given)
        self.machine, self.calls = given[1], []
        self.made.append(self.calls)

    def identify(self, zone: Any) -> None:
        self.calls.append(("identify", zone.copy()))
        self.machine = SimpleNamespace(**{**vars(self.machine), "identified": True})

    def place(self, start: Any, swing: Any, true: Any, offset: Any, seed: int) -> Any:
        number = sum(call[0] == "place" for call in self.calls)
        self.calls.append(("place", start.copy(), swing.copy(), true.copy(), offset.copy(), seed))
        run = SimpleNamespace(released=number != 1, steered_frames=10 + number)
        return run, np.array([start, offset + 1e-6 * (number + 1)]), 0.25 * number


@pytest.mark.parametrize("rule", ["vibration", "known", "response"])
def test_placements_begin_at_random_errors_within_the_landing_zone(rule: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Start errors fill 0.9 of the zone less the swing; calibration, drift and sensor are drawn anew for each part."""
    for name, function in (
        ("check_resonances", lambda machine: None),
        ("plan_placement", lambda *given, **how: planned.append((given, how)) or plan),
        ("predict_budget", lambda *given: given),
        ("PlacementCell", Cell),
    ):
        monkeypatch.setattr(placing, name, function)
    monkeypatch.setattr(Cell, "made", [], raising=False)
    planned: list[Any] = []
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    plan = SimpleNamespace(camera_to_board=turn)
    calibrated = np.array([1e-3, 2e-3, 0.1])
    machine: Any = SimpleNamespace(
        swing=(1e-5, 0.0, 0.0),
        tolerance=SimpleNamespace(landing_zone=1e-4, landing_angle=0.02),
        pipette_in_camera=SimpleNamespace(pose=calibrated, pose_covariance=np.diag([1e-12, 4e-12, 9e-8])),
        drift=SimpleNamespace(covariance=np.diag([1e-14, 0.0, 0.0])),
        settling=SimpleNamespace(
            rule="response" if rule == "response" else "vibration",
            frequency=(1.0, 1.0, 1.0) if rule == "known" else None,
        ),
    )
    machine.for_side = lambda side: machine if side == "bottom" else None
    artwork: Any = SimpleNamespace(side="bottom")
    device: Any = "a device"
    steps: list[Any] = []
    count = 40
    result: Any = simulate_placements(
        artwork, (1.0, 2.0, 3.0), machine, count=count, budget=30, seed=4, device=device,
        progress=lambda *given: steps.append(given),
    )  # fmt: skip
    assert planned == [((artwork, (1.0, 2.0, 3.0), machine), {"budget": 30, "device": device})]
    given, calls = Cell.made
    assert given == (artwork, machine, plan, device, 4)
    assert steps == [(number, count) for number in range(1, count + 1)]
    zone = np.array([8e-5, 9e-5, 0.018])
    if rule == "vibration":
        name, told = calls.pop(0)
        assert name == "identify"
        np.testing.assert_allclose(told, zone)
        assert result.machine.identified
    starts, swings, true, offsets = (np.array([call[k] for call in calls]) for k in range(1, 5))
    assert len({call[5] for call in calls}) == count
    assert np.all(np.abs(starts) <= zone)
    assert np.all(np.abs(starts).max(axis=0) > 0.8 * zone)
    assert np.all(starts.min(axis=0) < -0.5 * zone)
    assert np.all(swings[:, 1:] == 0.0)
    assert 0.8e-5 < np.abs(swings[:, 0]).max() <= 1e-5
    assert swings[:, 0].min() < 0.0 < swings[:, 0].max()
    # The camera sees the parts in its own frame, the board in the frame of the files.
    np.testing.assert_allclose(offsets, (true - calibrated) @ turn.T, atol=1e-18)
    np.testing.assert_allclose(np.std(true - calibrated, axis=0), [1e-6, 2e-6, 3e-4], rtol=0.35)
    assert abs(np.corrcoef(true[:, 0], true[:, 1])[0, 1]) < 0.5
    np.testing.assert_allclose(result.sources["calibration"] + result.sources["drift"], offsets, atol=1e-18)
    assert np.all(result.sources["drift"][:, [0, 2]] == 0.0)
    assert 3e-8 < np.std(result.sources["drift"][:, 1]) < 3e-7
    released = np.arange(count) != 1
    assert np.isfinite(result.error).all(axis=1).tolist() == released.tolist()
    rest = result.sources["vision and servo"]
    expected = 1e-6 * np.arange(1.0, count + 1)[released, None] * np.ones(3)
    np.testing.assert_allclose(rest[released], expected, atol=1e-15)
    assert np.isnan(rest[1]).all()
    np.testing.assert_array_equal(result.reach, 0.25 * np.arange(count))
    predicted_for, _, frames = result.budget
    assert predicted_for is result.machine
    assert frames == [10 + number for number in range(count) if number != 1]
    again: Any = simulate_placements(artwork, (1.0, 2.0, 3.0), machine, count=2, seed=5, device=device)
    assert not np.array_equal(Cell.made[3][-1][1], starts[1])
    assert len(again.placements) == 2
    for swing in ((0.9e-4, 0.0, 0.0), (0.0, 0.0, 0.019)):
        machine.swing = swing
        with pytest.raises(ValueError, match=r"swing is .*, expected less than 0\.9 of the landing zone"):
            simulate_placements(artwork, (1.0, 2.0, 3.0), machine, count=1, device=device)
    with pytest.raises(ValueError, match="count is 0"):
        simulate_placements(artwork, (1.0, 2.0, 3.0), machine, count=0, device=device)
