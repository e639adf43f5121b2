"""A robot through a recording of top views: its track, and the files of the command."""

from __future__ import annotations

import csv
import json
import math
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from floors import floor_image
from gpuvision.cli import main as cli
from gpuvision.formats.field_file import read_field
from gpuvision.host import ArraySource, Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.sources import Source
from gpuvision.matching.field.odometry import PoseEstimate, predict
from gpuvision.matching.field.robot_filter import RobotState
from gpuvision.status import Status
from gpuvision.workflows import tracking_robot
from gpuvision.workflows.tracking_robot import MotionUncertainty, RobotTrack, _motion, read_odometry, track_robot

SCALE, SHAPE, WIDE = 0.04, (300, 330), 0.125
MOTION = np.array([0.15, 0.02, 0.04])
START = np.array([-3.0, 1.0, 0.4])


@pytest.fixture(scope="module")
def drive() -> tuple[np.ndarray, np.ndarray]:
    """Return grey views of a robot that drives a curve, the third one of a bare carpet, and its true poses."""
    rng, field, zero = np.random.default_rng(3), read_field("robocup_msl"), np.zeros((3, 3))
    poses, views = [START], []
    for number in range(5):
        if number:
            poses.append(predict(PoseEstimate(poses[-1], zero), MOTION, zero).pose)
        colour = floor_image(field, tuple(poses[-1]), scale=SCALE, shape=SHAPE, line_width=WIDE, rng=rng)
        views.append(colour.min(axis=2) if number != 2 else np.full(SHAPE, 50, np.uint8))
    return np.stack(views), np.stack(poses)


def test_a_track_from_a_known_pose_is_certain(drive: tuple[np.ndarray, np.ndarray]) -> None:
    views, true = drive
    odometry = np.tile(MOTION, (len(views) - 1, 1))
    track = track_robot(
        ArraySource(views),
        read_field("robocup_msl"),
        rate=10.0,
        odometry=odometry,
        initial_pose=tuple(np.add(START, (0.2, -0.1, 0.1))),
        scale=SCALE,
        line_width=WIDE,
    )
    assert list(track.refused) == [2]
    assert [state.status for state in track.states] == [Status.OK] * len(views)
    for state, pose in zip(track.states, true, strict=True):
        error = state.pose - pose
        assert np.abs(error[:2]).max() < 0.06
        assert abs(error[2]) < 0.02
        assert error @ np.linalg.solve(state.covariance, error) < 30
    # Without a view the odometry alone goes on, with a larger covariance.
    assert track.states[2].covariance[0, 0] > track.states[1].covariance[0, 0]
    assert [state.time for state in track.states] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


@pytest.mark.rendered
def test_the_command_writes_the_track(
    drive: tuple[np.ndarray, np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    views, true = drive
    np.save(tmp_path / "views.npy", views[:2])
    (tmp_path / "odometry.csv").write_text("forward,left,turn\n0.15,0.02,0.04\n")
    start = f"--initial-pose={START[0]},{START[1]},{START[2]}"
    where = [
        "--field",
        "robocup_msl",
        "--scale",
        "4cm",
        "--rate",
        "10",
        "--odometry",
        str(tmp_path / "odometry.csv"),
        start,
    ]
    monkeypatch.setattr(
        "sys.argv", ["gpuvision", "locate-robot", str(tmp_path / "views.npy"), *where, "--out", str(tmp_path / "out")]
    )
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    assert capsys.readouterr().out.startswith("2 frames, 0 of them refused; last state OK")
    with (tmp_path / "out" / "track.csv").open() as file:
        rows = list(csv.DictReader(file))
    report = json.loads((tmp_path / "out" / "track.json").read_text())
    for row, entry, pose in zip(rows, report["frames"], true, strict=False):
        for name, value in zip(("x", "y", "theta"), pose, strict=True):
            assert abs(float(row[name]) - value) < 6 * float(row[f"sigma_{name}"]) + 1e-3
            assert entry[name] == float(row[name])
        assert math.sqrt(entry["covariance"][0][0]) == pytest.approx(float(row["sigma_x"]))
    assert (tmp_path / "out" / "track.png").stat().st_size > 1000


def test_a_small_error_of_the_scale_is_in_the_report_and_on_standard_error(
    drive: tuple[np.ndarray, np.ndarray],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Views of 4 cm per pixel, read with 4.06 cm."""
    views, _ = drive
    np.save(tmp_path / "views.npy", views[:2])
    where = ["--field", "robocup_msl", "--scale", "4.06cm", "--rate", "10", "--json", str(tmp_path / "track.json")]
    monkeypatch.setattr("sys.argv", ["gpuvision", "locate-robot", str(tmp_path / "views.npy"), *where])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert not end.value.code
    assert "warning: 2 of 2 frames have warnings; frame 0: the points are 1." in capsys.readouterr().err
    for frame in json.loads((tmp_path / "track.json").read_text())["frames"]:
        (warning,) = frame["warnings"]
        assert "farther from the robot than the lines of the field" in warning


def test_wrong_odometry_is_refused(drive: tuple[np.ndarray, np.ndarray], tmp_path: Path) -> None:
    views, _ = drive
    source, field = ArraySource(views[:1]), read_field("robocup_msl")
    with pytest.raises(ValueError, match="has 2 motions, expected 0 between 1 frames"):
        track_robot(source, field, rate=10.0, odometry=np.zeros((2, 3)), scale=SCALE, line_width=WIDE)
    for rate in (0.0, 2e7, math.inf):
        with pytest.raises(ValueError, match="rate"):
            track_robot(source, field, rate=rate, scale=SCALE, line_width=WIDE)
    (tmp_path / "a.csv").write_text("x,y\n1,2\n")
    with pytest.raises(RecordingError, match="expected forward,left,turn"):
        read_odometry(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("forward,left,turn\n1,2,nan\n")
    with pytest.raises(RecordingError, match="three finite numbers"):
        read_odometry(tmp_path / "b.csv")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("forward,left,turn\n1,2,3\n1,2\n", "line 3: expected three finite numbers"),
        ("forward,left,turn\n1,2,a\n", "not a readable list of motions"),
        ("forward,left,turn\n1,2,3\n1,2,a\n", "line 3: not a readable list of motions: '1,2,a'"),
        ("forward,left,turn\n1e300,0,0\n", r"line 2: 1e\+300, expected a motion of at most 1000 m or rad"),
        ("forward,left,turn\n1,2,3\n\n4,5,6\n7,8,9\n", "3 motions or more, .* set GPUVISION_MAX_MOTIONS"),
    ],
)
def test_damaged_odometry_is_refused(text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GPUVISION_MAX_MOTIONS", "2")
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(RecordingError, match=message):
        read_odometry(tmp_path / "a.csv")


def test_odometry_is_read(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("\ufeffforward, left, turn\n0.1,0,-2e-2\n\n0.2,0.3,0.4\n", encoding="utf-8")
    assert read_odometry(tmp_path / "a.csv").tolist() == [[0.1, 0.0, -0.02], [0.2, 0.3, 0.4]]
    (tmp_path / "b.csv").write_text("forward,left,turn\n")
    assert read_odometry(tmp_path / "b.csv").shape == (0, 3)


def test_the_command_fails_without_a_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "carpet.npy", np.full((2, *SHAPE), 50, np.uint8))
    words = ["locate-robot", "carpet.npy", "--field", "robocup_msl", "--scale", "4cm", "--rate", "10", "--out", "out"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["gpuvision", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("gpuvision: no pose in 2 frames: ")
    assert "nan" not in said.err
    assert said.err.endswith("; look at out/track.png and out/track.csv\n")
    assert (tmp_path / "out" / "track.csv").exists()


@pytest.mark.parametrize("rate", ["1e-4", "2e7", "1e300", "inf"])
def test_impossible_rates_are_refused(
    rate: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(tmp_path / "carpet.npy", np.full((2, *SHAPE), 50, np.uint8))
    words = ["locate-robot", "carpet.npy", "--field", "robocup_msl", "--scale", "4cm", "--rate", rate, "--out", "out"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", ["gpuvision", *words])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    assert "--rate" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_short_odometry_is_refused_before_the_first_frame(tmp_path: Path) -> None:
    source = ArraySource(np.zeros((4, *SHAPE), np.uint8))
    with pytest.raises(ValueError, match="has 2 motions, expected 3 between 4 frames"):
        track_robot(source, read_field("robocup_msl"), rate=10.0, odometry=np.zeros((2, 3)), scale=-1.0)


def test_motion_between_two_frames() -> None:
    """Without odometry the robot may have moved at its speed; else by the odometry with an error relative to it."""
    uncertainty = MotionUncertainty(speed=1.2, turn_rate=1.6, share=0.1, least=2e-3, least_turn=3e-3)
    move, covariance = _motion(None, 4, 10.0, uncertainty)
    np.testing.assert_array_equal(move, np.zeros(3))
    np.testing.assert_allclose(covariance, np.diag([0.12**2, 0.12**2, 0.16**2]))
    motions = np.array([[9.0, 9.0, 9.0], [0.3, -0.4, -0.5]])
    move, covariance = _motion(motions, 1, 10.0, uncertainty)
    np.testing.assert_array_equal(move, motions[1])
    np.testing.assert_allclose(covariance, np.diag([0.052**2, 0.052**2, 0.053**2]))


def test_report_and_summary_of_a_track(device: Device) -> None:
    covariance = np.diag([4e-4, 9e-4, 1e-4])
    hypothesis = SimpleNamespace(estimate=SimpleNamespace(pose=np.array([1.0, 2.0, 0.5])), probability=0.75)
    lost = RobotState(0.5, np.full(3, np.nan), np.full((3, 3), np.nan), 0.0, Status.NO_DATA, ())
    found = RobotState(1.5, np.array([1.0, 2.0, 0.5]), covariance, 0.75, Status.OK, (hypothesis,))
    field = read_field("robocup_msl")
    track = RobotTrack(
        states=(lost, found), refused={0: "too dark"}, warned={1: ("a scale", "more")}, field=field, device=device
    )
    unknown = dict.fromkeys(("x", "y", "theta", "sigma_x", "sigma_y", "sigma_theta"))
    known = {"x": 1.0, "y": 2.0, "theta": 0.5, "sigma_x": 0.02, "sigma_y": pytest.approx(0.03), "sigma_theta": 0.01}
    rows = [
        {"frame": 0, "time": 0.5, **unknown, "probability": 0.0, "status": "NO_DATA"},
        {"frame": 1, "time": 1.5, **known, "probability": 0.75, "status": "OK"},
    ]
    assert track.rows() == rows
    assert track.report() == {
        "gpuvision": version("gpuvision"),
        "field": field.name,
        "symmetric": True,
        "frames": [
            {**rows[0], "covariance": None, "hypotheses": [], "refused": "too dark", "warnings": []},
            {
                **rows[1],
                "covariance": covariance.tolist(),
                "hypotheses": [{"pose": [1.0, 2.0, 0.5], "probability": 0.75}],
                "refused": None,
                "warnings": ["a scale", "more"],
            },
        ],
        "device": {"label": device.label, "name": device.name, "driver": device.driver},
    }
    assert track.summary() == (
        "2 frames, 1 of them refused; last state OK, probability 0.750\nx 1.000 m, y 2.000 m, heading 28.65 degrees; "
        "sigmas 20 mm, 30 mm, 0.57 degrees"
    )
    assert track.problem() is None
    assert track.warnings() == ("1 of 2 frames have warnings; frame 1: a scale",)
    none = RobotTrack(
        states=(lost, lost), refused={0: "too dark", 1: "too dark"}, warned={}, field=field, device=device
    )
    assert none.summary() == "2 frames, 2 of them refused; last state NO_DATA\nno pose at the last frame"
    assert none.problem() == "no pose in 2 frames: too dark"
    assert none.warnings() == ()
    assert (
        RobotTrack(states=(lost,), refused={}, warned={}, field=field, device=device).problem() == "no pose in 1 frames"
    )


class Followed:
    """Filter that notes what it is told; its state has the time of the last view."""

    made: list[Any]

    def __init__(self, field: Any, initial: Any, *, limits: Any) -> None:
        self.calls: list[Any] = []
        self.made.append((field, initial, limits, self.calls))

    def move(self, time: float, motion: Any, covariance: Any) -> None:
        self.calls.append(("move", time, motion.tolist(), np.sqrt(np.diag(covariance)).tolist()))

    def see(self, time: float, candidates: Any) -> None:
        self.calls.append(("see", time, candidates))

    def state(self) -> int:
        return len(self.calls)


@pytest.mark.parametrize("with_odometry", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_each_frame_moves_the_robot_and_shows_its_place(
    known: bool, with_odometry: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Followed, "made", [], raising=False)
    monkeypatch.setattr(tracking_robot, "RobotFilter", Followed)
    monkeypatch.setattr(tracking_robot, "scan_floor", lambda frame, **how: (int(frame[0, 0]), how))
    monkeypatch.setattr(
        tracking_robot,
        "locate_robot",
        lambda scan, field, device: SimpleNamespace(
            reason="dark" if scan[0] == 1 else "",
            candidates=(scan, device),
            warnings=("small",) if scan[0] == 2 else (),
        ),
    )
    views = np.arange(3, dtype=np.uint8)[:, None, None] * np.ones((3, 2, 2), np.uint8)
    motions = np.array([[0.3, 0.4, -0.5], [0.6, 0.0, 0.0]]) if with_odometry else None
    field, device, limits = "a field", "a device", "the limits"
    track: Any = track_robot(
        ArraySource(views), field, rate=4.0, odometry=motions, device=device, limits=limits, scale=SCALE,  # type: ignore[arg-type]
        initial_pose=(1.0, 2.0, 3.0) if known else None,
    )  # fmt: skip
    ((given, initial, used, calls),) = Followed.made
    assert (given, used) == (field, limits)
    if known:
        np.testing.assert_array_equal(initial.pose, [1.0, 2.0, 3.0])
        np.testing.assert_allclose(initial.covariance, np.diag([0.25, 0.25, 0.1225]))
    else:
        assert initial is None
    seen = [("see", 0.25 * k, ((k, {"device": device, "scale": SCALE}), device)) for k in range(3)]
    if motions is None:
        moves = [[[0.0] * 3, [0.25, 0.25, 0.375]]] * 2
    else:
        moves = [[motions[0].tolist(), [0.052, 0.052, 0.052]], [motions[1].tolist(), [0.062, 0.062, 0.002]]]
    assert [calls[k] for k in (0, 2, 4)] == seen
    for call, time, (motion, sigmas) in zip((calls[1], calls[3]), (0.25, 0.5), moves, strict=True):
        assert call == ("move", time, motion, pytest.approx(sigmas))
    assert track.states == (1, 3, 5)
    assert (track.refused, track.warned, track.field, track.device) == ({1: "dark"}, {2: ("small",)}, field, device)


class Views(Source):
    """Views of a bare carpet; the source does not know its length."""

    def __init__(self, count: int) -> None:
        self.shape, self.dtype = SHAPE, np.dtype(np.uint8)
        self.left, self.closed = count, False

    def wait(self) -> bool:
        return self.left > 0

    def read_into(self, out: np.ndarray, arrived: np.ndarray) -> int:
        out[:] = 50
        self.left -= 1
        return 1

    def close(self) -> None:
        self.closed = True


@pytest.mark.parametrize(
    ("frames", "motions", "error", "message"),
    [
        (3, 1, ValueError, "the odometry has 1 motions, fewer than between the frames"),
        (2, 2, ValueError, "the odometry has 2 motions, expected 1 between 2 frames"),
        (0, None, RecordingError, "the recording has no frame"),
    ],
)
def test_a_source_of_unknown_length_is_compared_with_the_odometry(
    frames: int, motions: int | None, error: type[Exception], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tracking_robot, "scan_floor", lambda frame, **_: None)
    located = SimpleNamespace(reason="no line", candidates=(), warnings=())
    monkeypatch.setattr(tracking_robot, "locate_robot", lambda *_, **__: located)
    source = Views(frames)
    odometry = None if motions is None else np.tile(MOTION, (motions, 1))
    with pytest.raises(error, match=message):
        track_robot(source, read_field("robocup_msl"), rate=10.0, odometry=odometry)
    assert source.closed
