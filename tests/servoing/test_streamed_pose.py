"""Rulers, fiducials and whole feature sets in a stream of frames, with the times of every pose."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from boards import BOARD_MIDDLE
from gpuvision.host import ArraySource, Device, Pipeline, Step, plan_stream
from gpuvision.matching.artwork.artwork import Artwork
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.feature_set import FeatureSet, choose_features
from gpuvision.matching.features.imaging import Imaging
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.ranging.line import LineReadout
from gpuvision.servoing.controllers import PidController, PidGains
from gpuvision.servoing.loop import ServoLoop, WallClock
from gpuvision.servoing.observer import MotionModel, PoseMeasurement, PoseObserver, PosePrediction, Verdict
from gpuvision.servoing.plant import SimulatedPlant
from gpuvision.servoing.streamed_pose import streamed_pose
from gpuvision.status import Status
from round_boards import NOISE, PIXEL, SHAPE, TRACES, moved_picture, round_artwork, round_board, round_picture

NEAR = np.array([*BOARD_MIDDLE, 0.0])
CORNER = np.zeros(2, np.float32)
FRAMES = 5
IMAGING = Imaging(pixel=PIXEL, blur_px=1.04, contrast_bare=110 / NOISE, contrast_masked=50 / NOISE, angle=5.3e-3)


@pytest.fixture(scope="module")
def artwork(tmp_path_factory: pytest.TempPathFactory) -> Artwork:
    return round_artwork(round_board(tmp_path_factory.mktemp("board"), traces=TRACES))


@pytest.fixture(scope="module")
def features(artwork: Artwork) -> FeatureSet:
    return choose_features(artwork, ((2e-3, 2e-3), (18e-3, 14e-3)), IMAGING, budget=200)


@pytest.fixture(scope="module")
def frames(artwork: Artwork) -> tuple[np.ndarray, np.ndarray]:
    """Return images of a moving board, the last one without a board, and the true poses of the others."""
    rng, picture = np.random.default_rng(4), round_picture(artwork)
    seen = [moved_picture(picture, rng) for _ in range(FRAMES - 1)]
    images = [*(image for image, _ in seen), np.full(SHAPE, 80, np.uint8)]
    return np.stack(images), np.stack([pose for _, pose in seen])


def near(device: Device) -> np.ndarray:
    """Return the expected pose as the operation takes it: in single precision on a device without doubles."""
    return NEAR.astype(np.float64 if device.has_double else np.float32)


def rulers() -> np.ndarray:
    x, y = np.meshgrid(np.linspace(60, 340, 6), np.linspace(60, 240, 4))
    return np.column_stack([x.ravel(), y.ravel(), np.ones(24), np.zeros(24)]).astype(np.float32)


@pytest.mark.parametrize("zero_copy", [True, False])
def test_poses_of_a_stream_are_those_of_single_calls(
    zero_copy: bool, features: FeatureSet, frames: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    images, true = frames
    bound = features.bind(device, SHAPE, np.uint8, copper="bright", threshold=12.0, noise=NOISE)
    source = ArraySource(images)
    source.exposure_delay = 1.5e-3
    step = Step(bound.operation, fixed=(near(device), CORNER))
    measured = []
    with Pipeline(source, step, device=device, zero_copy=zero_copy and device.shares_memory) as stream:
        for number, batch in enumerate(stream):
            assert batch.number == number
            assert len(batch) == 1
            assert batch.result.pose.shape == (1, 3)
            pose = streamed_pose(batch)
            alone = bound(images[number], NEAR)
            np.testing.assert_array_equal(pose.pose, alone.pose)
            np.testing.assert_array_equal(pose.covariance, alone.covariance)
            np.testing.assert_array_equal(batch.result.residuals[0], alone.residuals)
            assert pose.status == alone.status
            assert pose.exposed == pytest.approx(1e-9 * batch.arrived[0] - 1.5e-3, abs=1e-9)
            assert pose.arrived > 1e-9 * batch.arrived[0]
            assert batch.latency[0] == batch.delivered - batch.arrived[0] + 1_500_000
            assert batch.copy().latency[0] == batch.latency[0]
            measured.append(pose)
    assert [pose.status for pose in measured] == [0] * (FRAMES - 1) + [Status.NO_DATA]
    error = np.stack([pose.pose for pose in measured[:-1]]) - true
    assert (np.abs(error) < 6 * np.sqrt([np.diag(pose.covariance) for pose in measured[:-1]])).all()


def test_loop_with_a_wall_clock_takes_the_poses_of_a_stream(
    features: FeatureSet, frames: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    bound = features.bind(device, SHAPE, np.uint8, copper="bright", threshold=12.0, noise=NOISE)
    images, clock, observer = frames[0][:-1], WallClock(), PoseObserver(MotionModel(lag=(0.0,) * 3), gate=1e300)
    observer.reset(clock.now(), NEAR, np.eye(3))
    found: list[PoseMeasurement] = []
    with Pipeline(images, Step(bound.operation, fixed=(near(device), CORNER)), device=device) as stream:
        batches = iter(stream)

        def sensor(time: float, _predicted: PosePrediction) -> list[PoseMeasurement]:
            """Return the poses of the earlier calls that were not returned yet, and take the next one."""
            arrived = found[-1:]
            found.extend(streamed_pose(batch, clock.start) for batch in (next(batches, None),) if batch is not None)
            return arrived

        controller = PidController(PidGains(proportional=1.0))
        loop = ServoLoop(SimulatedPlant(), sensor, observer, controller, clock, period=0.02, limits=None)
        record = loop.run(NEAR, 1.0, settling=lambda *_: len(found) == len(images))
    verdicts = [verdict for _, verdict in record.measurements]
    assert verdicts == [Verdict.ACCEPTED] * (len(images) - 1)
    assert all(0.0 < each.exposed < each.arrived < record.time[-1] for each, _ in record.measurements)


@pytest.mark.parametrize("kind", ["rulers", "blobs"])
def test_operations_of_one_frame_take_fixed_inputs(
    kind: str, features: FeatureSet, frames: tuple[np.ndarray, np.ndarray], device: Device
) -> None:
    images, _ = frames
    operation: Any = RulerEdges(threshold=12.0, length=48, smoothing_px=2.3, count=24)
    fixed = rulers()
    if kind == "blobs":
        pixels = (features.fiducials.point - NEAR[:2]) * (1, -1) / PIXEL + (np.array(SHAPE[::-1]) - 1) / 2
        fixed = np.column_stack([pixels, features.fiducials.radius / PIXEL]).astype(np.float32)
        operation = FindBlobs(threshold=12.0, polarity="bright", count=len(fixed))
    with Pipeline(images, Step(operation, fixed=(fixed,)), device=device) as stream:
        assert stream.batch == 1
        for number, batch in enumerate(stream):
            alone = operation(images[number], fixed, device=device)
            for name, values in alone._asdict().items():
                streamed = getattr(batch.result, name)
                assert (streamed is None) == (values is None)
                if values is not None:
                    np.testing.assert_array_equal(streamed[0], values, err_msg=name)
    assert number == FRAMES - 1


def test_wrong_batches_and_fixed_inputs_are_refused() -> None:
    frames = np.zeros((4, 60, 80), np.uint8)
    operation = RulerEdges(threshold=12.0, count=24)
    with pytest.raises(ValueError, match="RulerEdges takes one frame at a time; use batch=1, not 2"):
        Pipeline(frames, Step(operation, fixed=(rulers(),)), batch=2)
    with pytest.raises(ValueError, match="RulerEdges takes 2 arrays, a stream's source gives one"):
        Pipeline(frames, operation)
    with pytest.raises(ValueError, match=r"RulerEdges expects .*\(24, 4\)"):
        Pipeline(frames, Step(operation, fixed=(rulers()[:5],)))
    with pytest.raises(ValueError, match="LineReadout takes 1 arrays"):
        Pipeline(frames, Step(LineReadout(), fixed=(rulers(),)))


def test_a_plan_tries_single_frames_only() -> None:
    source = ArraySource(np.zeros((1, 60, 80), np.uint8), 50)
    plan = plan_stream(source, Step(RulerEdges(threshold=12.0, count=24), fixed=(rulers(),)), rate=10.0)
    assert {trial.batch for trial in plan.trials} == {1}
