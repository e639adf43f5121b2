"""The command ``gpuvision delay``: analysis of parts and of a recording, refused options, files that are kept."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.servoing.delay import DelayBudget, gain_limit
from gpuvision.servoing.delay_measurement import excitation
from gpuvision.servoing.delay_response import delay_against_frame_time
from gpuvision.servoing.margins import observer_tolerance, predictor_tolerance
from gpuvision.workflows import analysing_delay

PERIOD = 1e-3


def run(*words: object) -> str:
    done = CliRunner().invoke(application(), ["delay", *map(str, words)])
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.stdout


def write_recording(path: Path, delay: float) -> None:
    time = PERIOD * np.arange(300)
    command = np.concatenate([[0.0], np.cumsum(excitation(299, 0.02)) * PERIOD])
    measured = np.interp(time - delay, time, command) + 1e-6 * np.random.default_rng(0).standard_normal(300)
    rows = [f"{t:.9g},{c:.9g},{m:.9g}" for t, c, m in zip(time, command, measured, strict=True)]
    path.write_text("\n".join(["time,command,measured", *rows]) + "\n")


@pytest.fixture
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a few bytes instead of the picture, whose drawing takes most of the time."""
    monkeypatch.setattr(analysing_delay, "draw_delay", lambda path, _: Path(path).write_bytes(b"a picture"))


@pytest.mark.rendered
def test_parts_and_a_recording(tmp_path: Path) -> None:
    """The recording measures 0.4 ms more than the parts sum up to."""
    write_recording(tmp_path / "loop.csv", 2.4e-3)
    parts = ("--rate", 1000, "--exposure", "200us", "--readout", "0.9ms", "--transfer", "0.5ms", "--stage", "all=0.5ms")
    said = run(*parts, "--recording", tmp_path / "loop.csv", "--out", tmp_path / "out")
    assert "frames of 1 ms" in said
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert sum(report["parts_s"].values()) == pytest.approx(2.5e-3)
    assert report["measured"]["beyond_the_budget_s"] == pytest.approx(0.4e-3, abs=2e-5)
    assert report["delay_frames"] == pytest.approx(2.4, abs=0.02)
    assert report["limit_per_frame"] == pytest.approx(gain_limit(report["delay_frames"]))
    assert report["rules"]["non_oscillating"]["gain_margin"] == pytest.approx(
        report["limit_per_frame"] / report["non_oscillating_per_frame"], rel=1e-6
    )
    for observer, predictor in zip(report["observer"], report["predictor"], strict=True):
        assert observer["gain_per_frame"] == predictor["gain_per_frame"]
        expected = observer_tolerance(observer["gain_per_frame"], report["delay_frames"])
        assert observer["unstable_from_longer_by_s"] == pytest.approx(1e-3 * expected.longer, rel=0.01)
        assert observer["unstable_from_plant_gain"] > predictor["unstable_from_plant_gain"]
    # At a gain of 0.2 per frame every shorter delay is stable; at 0.8 the predictor does not bear a delay of 0.
    assert [report[each][0]["unstable_from_shorter_by_s"] for each in ("observer", "predictor")] == [None, None]
    shorter = predictor_tolerance(0.8, report["delay_frames"]).shorter
    assert report["predictor"][-1]["unstable_from_shorter_by_s"] == pytest.approx(1e-3 * shorter, rel=0.01)
    assert shorter < report["delay_frames"]
    for name in ("delay.png", "measured_delay.png"):
        assert (tmp_path / "out" / name).stat().st_size > 10_000


def test_sensor_gives_the_readout(tmp_path: Path, quick_picture: None) -> None:
    parts = ("--rate", 1000, "--exposure", "200us", "--sensor", "pb1024", "--jitter", "0.2ms", "--json", "-")
    delays = []
    for roi in ("128x128", "256x256"):
        report = json.loads(run(*parts, "--roi", roi, "--out", tmp_path / roi))
        delays.append(report["delay_s"])
        assert report["limit_with_jitter_per_frame"] != report["limit_per_frame"]
        assert not (tmp_path / roi / "measured_delay.png").exists()
    assert 1e-4 < delays[0] < delays[1] < 1e-3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "give --rate and the parts of the delay, or --recording"),
        (("--exposure", "1ms"), "--exposure has no effect without --rate"),
        (
            ("--rate", "1000", "--exposure", "400"),
            "200 s = 2e.05 frames of 1 ms, expected at most 100 frames; check the",
        ),
        (
            ("--rate", "100", "--transfer", "1ms", "--jitter", "1"),
            "the jitter is 1 s = 100 frames of 10 ms, expected at most 25 frames; check its unit",
        ),
        (("--rate", "1000", "--stage", "edges"), "--stage is 'edges'"),
        (("--rate", "1000", "--exposure", "1mm"), "--exposure is '1mm', expected 1 number: s"),
        (("--rate", "1000", "--roi", "8x8"), "--roi has no effect without --sensor"),
        (("--rate", "1000", "--sensor", "pb1024", "--readout", "1ms"), "--readout has no effect with --sensor"),
        (("--rate", "1000", "--sensor", "pb1024", "--exposure", "1us", "--roi", "8by8"), "--roi is '8by8'"),
        (("--rate", "1000", "--sensor", "pb1024", "--exposure", "1us", "--roi", "²x3"), "--roi is '²x3'"),
        (("--rate", "1000", "--sensor", "pb1024"), "--sensor pb1024 needs --exposure, such as 200us"),
        (
            ("--rate", "1000", "--sensor", "foo", "--exposure", "1us"),
            "there is no image sensor file foo; give a file or one of lupa300, pb1024",
        ),
        (("--rate", "1000", "--exposure", "-200us"), "--exposure is '-200us', expected a time of 0 or more"),
        (("--rate", "1000", "--stage", "edges=1ms", "--stage", "edges=2ms"), "--stage edges is given twice"),
        (("--rate", "1000", "--sensor", "pb1024", "--exposure", "5ms", "--roi", "128x128"), "shorten --exposure"),
        (("--rate", "90000", "--sensor", "pb1024", "--exposure", "1us"), "--rate is 90000; lower --roi"),
    ],
)
def test_options_are_checked(tmp_path: Path, words: tuple[str, ...], message: str) -> None:
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        run(*words, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_foreign_files_are_kept(tmp_path: Path, quick_picture: None) -> None:
    (tmp_path / "report.json").write_text("mine")
    with pytest.raises(FileExistsError, match="--overwrite"):
        run("--rate", 1000, "--out", tmp_path)
    assert (tmp_path / "report.json").read_text() == "mine"
    run("--rate", 1000, "--out", tmp_path, "--overwrite")
    assert (tmp_path / "report.json").read_text() != "mine"
    run("--rate", 500, "--out", tmp_path)


@pytest.mark.parametrize(
    ("outputs", "kept"), [(("--out", "out", "--json", "cam.toml"), "cam.toml"), (("--out", "in"), "in/report.json")]
)
def test_sensor_file_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, outputs: tuple[str, ...], kept: str
) -> None:
    monkeypatch.chdir(tmp_path)
    text = (resources.files("gpuvision") / "presets" / "cameras" / "pb1024.toml").read_text(encoding="utf-8")
    Path(kept).parent.mkdir(exist_ok=True)
    Path(kept).write_text(text)
    with pytest.raises(FileExistsError, match=f"it is the input {kept}"):
        run("--rate", 100, "--exposure", "200us", "--sensor", kept, *outputs, "--overwrite")
    assert Path(kept).read_text() == text


@pytest.mark.parametrize("rate", ["1e300", "inf"])
def test_impossible_rate_is_refused(tmp_path: Path, rate: str) -> None:
    done = CliRunner().invoke(application(), ["delay", "--rate", rate, "--transfer", "1ms", "--out", str(tmp_path)])
    assert done.exit_code == 2
    assert "--rate" in done.output


def test_delay_of_a_hundred_frames_is_drawn() -> None:
    done = analysing_delay.analyse_delay(DelayBudget(period=PERIOD, transfer=100 * PERIOD))
    curve = delay_against_frame_time(done.budget, done.sweep())
    assert np.isfinite(curve.bandwidth).all()
    assert curve.frames.max() == pytest.approx(1000.0, rel=1e-5)


@pytest.mark.parametrize(
    ("position_scale", "rate", "expected"),
    [
        (1.0, 1000, ""),
        (1e3, 1000, "times the commanded motion; check the units of the columns command and measured"),
        (1.0, 500, "warning: the samples of the recording are 1 ms apart, the frames 2 ms; check the column time"),
    ],
)
def test_wrong_units_are_reported(
    tmp_path: Path, quick_picture: None, position_scale: float, rate: float, expected: str
) -> None:
    write_recording(tmp_path / "loop.csv", 2.4e-3)
    header, *lines = (tmp_path / "loop.csv").read_text().splitlines()
    rows = np.array([[float(each) for each in line.split(",")] for line in lines])
    rows *= [1.0, 1.0, position_scale]
    np.savetxt(tmp_path / "loop.csv", rows, delimiter=",", header=header, comments="")
    words = ["--rate", rate, "--transfer", "1ms", "--recording", tmp_path / "loop.csv", "--out", tmp_path / "out"]
    done = CliRunner().invoke(application(), ["delay", *map(str, words)])
    assert done.exit_code == 0
    assert expected in done.stderr
    assert ("warning" in done.stderr) == bool(expected)


def test_missing_parts_are_reported(tmp_path: Path, quick_picture: None) -> None:
    done = CliRunner().invoke(application(), ["delay", "--rate", "1000", "--out", str(tmp_path)])
    assert done.exit_code == 0
    assert "warning: the delay is 0: no part of it is given" in done.stderr


def test_faults_of_a_recording_name_the_file(tmp_path: Path) -> None:
    rows = [f"{n},{n},\n" for n in range(30)]
    (tmp_path / "loop.csv").write_text("time,command,measured\n" + "".join(rows))
    with pytest.raises(ValueError, match=r"loop\.csv: "):
        run("--recording", tmp_path / "loop.csv", "--out", tmp_path / "out")
