"""Vision of placements: rulers at the predicted pose, the lens of the camera, the error of the sampling."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal

import numpy as np
import pytest

from boards import LAYERS, board_folder, narrow_pads
from gpuvision.camera.lens import Lens
from gpuvision.formats.machine_file import read_machine
from gpuvision.host import Device, to_numpy
from gpuvision.matching.artwork.artwork import Artwork, read_artwork
from gpuvision.matching.features.feature_set import edge_clearance
from gpuvision.servoing.frames import compose_poses
from gpuvision.servoing.observer import SAME_TIME
from gpuvision.servoing.placement import vision
from gpuvision.servoing.placement.board_renderer import board_renderer
from gpuvision.servoing.placement.budget import predict_budget
from gpuvision.servoing.placement.control import Control
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.plan import placement_imaging, plan_placement
from gpuvision.servoing.placement.vision import BoardPoseSensor
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap
from gpuvision.workflows.placement_cell import PlacementCell
from gpuvision.workflows.placing import simulate_placements

PRESET = read_machine("look_while_place")
# The camera looks at a pad of 1.2 mm and a trace beside it, 1.1 mm from the nozzle.
TARGET = (14.8e-3 + 1.0e-3, 5.9e-3 + 0.5e-3, 0.0)
# The camera looks at the rows of `narrow_pads`.
NARROW = np.array([9.85e-3 + 1.0e-3, 8.0e-3 + 0.5e-3, 0.0])


@pytest.fixture(scope="module")
def machine() -> Machine:
    return dataclasses.replace(PRESET, camera=dataclasses.replace(PRESET.camera, window=(128, 128), pixel=20e-6))


@pytest.fixture(scope="module")
def artwork(tmp_path_factory: pytest.TempPathFactory, machine: Machine) -> Artwork:
    folder = board_folder(tmp_path_factory.mktemp("board"))
    return read_artwork(folder, layers=LAYERS, clearance=edge_clearance(placement_imaging(machine)))


@pytest.mark.parametrize(
    "is_narrow", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["rulers", "registration"]
)
def test_a_part_lands_as_exactly_behind_a_lens(
    artwork: Artwork, machine: Machine, tmp_path: Path, device: Device, *, is_narrow: bool
) -> None:
    """Up to 3 px of distortion about a point beside the middle. A measurement without the lens is wrong."""
    board, target = artwork, np.array(TARGET)
    if is_narrow:
        machine = read_machine("look_while_place")
        layers = {name: LAYERS[name] for name in ("copper.gbr", "outline.gbr")}
        clearance = edge_clearance(placement_imaging(machine))
        board, target = read_artwork(narrow_pads(tmp_path), layers=layers, clearance=clearance), NARROW
    rows, columns = machine.camera.window
    lens = Lens(k1=3.0 / (0.5 * np.hypot(rows, columns)) ** 3, k2=1e-13, centre=(520.0, 500.0))
    behind = dataclasses.replace(machine, camera=dataclasses.replace(machine.camera, lens=lens))
    result = simulate_placements(board, target, behind, count=2, device=device)
    assert (result.plan.landing is not None) == is_narrow
    assert all(each.released for each in result.placements)
    assert np.all(np.abs(result.sources["vision and servo"][:, :2]) < 2e-6)
    assert np.all(np.abs(result.error) <= 5.0 * result.simulated_sigmas)
    # The same frames, measured as if there were no lens.
    cell = PlacementCell(board, behind, result.plan, device, 0)
    seen = cell.rest(3)
    cell._sensor = BoardPoseSensor(cell._camera, machine, result.plan, cell._camera.dtype, device=device)
    assert np.all(np.abs(seen[:, :2]) < 1e-6)
    if not is_narrow:
        assert np.linalg.norm(cell.rest(3)[:, :2], axis=1).min() > 3e-6


def test_a_lens_that_folds_within_the_window_is_refused(machine: Machine) -> None:
    with pytest.raises(ValueError, match="lens: the model folds within the window"):
        dataclasses.replace(machine.camera, lens=Lens(k1=-1e-4, centre=(511.5, 511.5)))


@pytest.mark.parametrize("observer", ["smith", pytest.param("kalman", marks=pytest.mark.slow)])
def test_rulers_that_are_placed_at_the_predicted_pose_reach_less_than_the_motion(
    tmp_path: Path, device: Device, observer: Literal["smith", "kalman"]
) -> None:
    """Gain 0.5: the head moves by up to 50 um between two frames, the rulers cover a tenth of it and a pixel."""
    narrow_pads(tmp_path)
    motion = (1e-6, 1e-6, 1e-4) if observer == "kalman" else None
    control = Control(observer=observer, gain=0.5, motion_sigma=motion)
    machine = dataclasses.replace(read_machine("look_while_place"), control=control)
    layers = {name: LAYERS[name] for name in ("copper.gbr", "outline.gbr")}
    board = read_artwork(tmp_path, layers=layers, clearance=edge_clearance(placement_imaging(machine)))
    result = simulate_placements(board, (10.85e-3, 8.5e-3, 0.0), machine, count=2, device=device)
    assert 15e-6 < result.plan.features.imaging.shift < 15.5e-6
    assert max(np.abs(motion[0, :2]).max() for motion in result.motion) > 60e-6
    assert all(each.status == 0 for placement in result.placements for each in placement.measurements)
    assert [each.frames for each in result.placements] == [each.predicted_frames + 1 for each in result.placements]
    assert np.all(np.abs(result.sources["vision and servo"][:, :2]) < 2e-6)


def test_sampling_covariance_is_the_scatter_of_weighted_least_squares(artwork: Artwork, machine: Machine) -> None:
    """Errors of 0.02 px of each ruler, poses by NumPy: the equations of the rulers are written here again."""
    plan = plan_placement(artwork, TARGET, machine)
    features, pixel = plan.features, machine.camera.pixel
    assert len(features.fiducials.sigma) == 0
    away = features.point - np.array(TARGET[:2])
    rows = np.column_stack(
        [
            features.normal,
            features.normal[:, 1] * away[:, 0] - features.normal[:, 0] * away[:, 1],
            features.spacing == 0.0,
        ]
    )
    error = 0.02 * pixel * np.random.default_rng(1).standard_normal((len(rows), 4000))
    weight = 1.0 / (features.sigma**2 + (0.02 * pixel) ** 2)
    bias = np.array([[0.0, 0.0, 0.0, 1.0 / features.imaging.etch_bias_sigma]])  # the prior of the etch bias
    equations = np.concatenate([np.sqrt(weight)[:, None] * rows, bias])
    values = np.concatenate([np.sqrt(weight)[:, None] * error, np.zeros((1, error.shape[1]))])
    found = np.cov(np.linalg.lstsq(equations, values, rcond=None)[0][:3])
    unit = np.sqrt(np.diag(plan.sampling))
    # Standard error of a covariance of 4000 draws: 2.2 %.
    np.testing.assert_allclose(found / np.outer(unit, unit), plan.sampling / np.outer(unit, unit), atol=0.1)
    sources = predict_budget(machine, plan).sources
    np.testing.assert_array_equal(sources["sampling"], plan.sampling)
    assert np.all(np.diag(plan.sampling) < np.diag(plan.reported))


@pytest.mark.slow
def test_sampling_error_of_frames_without_noise_is_within_the_budget(
    artwork: Artwork, machine: Machine, device: Device
) -> None:
    """0.02 px of each ruler is an upper estimate: a third of it is seen here."""
    plan = plan_placement(artwork, TARGET, machine)
    camera = dataclasses.replace(machine.camera, sensor=dataclasses.replace(machine.camera.sensor, prnu=0.0, dsnu=0.0))
    centre, half = plan.camera_pose[:2], 2e-3
    region = (centre - half, centre + half)
    board = ReflectanceMap.of(artwork, pixel=camera.pixel, region=region, blur_px=camera.blur_px, nodes_per_pixel=2)
    poses = plan.camera_pose + np.random.default_rng(0).uniform(-1.0, 1.0, (60, 3)) * (60e-6, 60e-6, 3e-3)
    rendered = board_renderer(board, camera, noise=False)(poses[:, None], np.zeros(60, np.uint32), device=device)
    images = to_numpy(rendered.image)
    bound = plan.features.bind(
        device, camera.window, images.dtype, copper="bright", threshold=plan.threshold, noise=plan.noise
    )
    nozzle = machine.pipette_in_camera.pose
    found = [np.array(bound(image, pose).pose, np.float64) for image, pose in zip(images, poses, strict=True)]
    error = compose_poses(np.array(found), nozzle) - compose_poses(poses, nozzle)
    ratio = np.sqrt(np.mean(error**2, axis=0) / np.diag(plan.sampling))
    assert np.all((ratio > 0.1) & (ratio < 1.0)), ratio


def test_another_sensor_has_other_pixels(artwork: Artwork, machine: Machine, device: Device) -> None:
    """The mean of many frames shows the differences between the pixels: alike for one seed, independent for two."""
    place = np.array(TARGET[:2])
    board = ReflectanceMap.of(
        artwork, pixel=machine.camera.pixel, region=(place - 3e-3, place + 3e-3), blur_px=machine.camera.blur_px
    )
    rest, true = np.array(TARGET), machine.pipette_in_camera.pose

    def nozzle(time: np.ndarray) -> np.ndarray:
        return np.broadcast_to(rest, (*np.shape(time), 3))

    camera = vision.SimulatedCamera(board, machine, nozzle, true, device=device, seed=1)

    def mean_frame(seed: int | None) -> np.ndarray:
        camera.follow(nozzle, true, seed=seed)
        frames = camera(23.5 * machine.period)
        assert len(frames) == 24
        return np.mean([each.image for each in frames], axis=0, dtype=np.float64)

    first, again, other = mean_frame(None), mean_frame(None), mean_frame(2)
    # Noise from frame to frame averages out; the differences between the pixels do not.
    assert np.std(first - again) < 0.5 * np.std(first - other)
    assert np.mean(first) == pytest.approx(np.mean(other), rel=0.01)
    assert np.std(mean_frame(2) - other) < 0.5 * np.std(first - other)


def test_frames_that_arrive_during_the_registration_are_not_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first frame is registered, which takes 0.25 s; the next one is the first that arrives after that."""
    monkeypatch.setattr(vision, "move_view", lambda view, pose: SimpleNamespace(pose=pose))
    sensor: Any = object.__new__(BoardPoseSensor)
    searched: list[int] = []

    def landing(image: int, device: Any) -> Any:
        searched.append(image)
        return SimpleNamespace(status=int(image == 0), pose=(1.0, 2.0, 3.0))

    sensor._plan, sensor._view, sensor._device = SimpleNamespace(camera_pose=np.zeros(3), landing=landing), None, None
    sensor._undistort, sensor._landing_time, sensor._measure = None, 0.25, lambda frame, predicted: frame.image
    ready = (0.5 + 0.25) + 0.25
    times = [0.5, 0.6, 0.75, 0.8, np.nextafter(ready - SAME_TIME, 0.0), ready - SAME_TIME, 1.5]
    frames = [SimpleNamespace(image=k, exposed=each - 0.1, arrived=each) for k, each in enumerate(times)]
    sensor.camera = lambda time: frames
    sensor.reset()
    refused, *measured = sensor(2.0)
    assert (refused.exposed, refused.arrived, refused.status) == (0.4, 0.5, 1)
    assert searched == [0, 2]
    assert measured == [5, 6]
    assert sensor._last.tolist() == [1.0, 2.0, 3.0]
