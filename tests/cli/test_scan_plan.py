"""``gpuvision scan --tolerance`` and ``--plan``: table, picture, report, and a scan with the chosen readout."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host.outputs import MANIFEST
from gpuvision.reference.line import pixel_gaussian
from gpuvision.workflows import planning_scan


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Path:
    """Return the current folder, with a recording and a sensor file that gives the noise."""
    monkeypatch.chdir(tmp_path)
    # The sensor's own readout only: each readout is a build of the kernel.
    monkeypatch.setattr(planning_scan, "_readouts", lambda sensor, *_: [sensor.readout])
    light = pixel_gaussian(np.arange(64)[:, None], np.full((1, 480), 30.4), 2.0, 150.0, 4.0)  # type: ignore[arg-type]
    frames = rng.poisson(np.broadcast_to(light, (6, 64, 480)) / 0.1) * 0.1
    np.save("in.npy", np.clip(np.rint(frames), 0, 255).astype(np.uint8))
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text(encoding="utf-8")
    text = text.replace("threshold = 16", "threshold = 16\nread_noise = 0.5\ngain = 0.1")
    # Build options of test_planning_scan.py: without a second peak, a window of 6.
    for before, after in (("window = 4 ", "window = 6 "), ("ambiguity = 0.4 ", "# ")):
        assert text.count(before) == 1
        text = text.replace(before, after)
    Path("s.toml").write_text(text)
    return tmp_path


def run(*words: str) -> str:
    ran = CliRunner().invoke(application(), ["scan", "in.npy", "--sensor", "s.toml", "--out", "out", *words])
    if ran.exception is not None:
        raise ran.exception
    return ran.stdout


def test_a_plan_is_printed_drawn_and_reported(folder: Path) -> None:
    text = run("--plan", "--tolerance", "1mm", "--json", "plan.json")
    lines = text.splitlines()
    assert lines[0].split() == ["readout", "us/frame", "error", "random", "phase", "calibr.", "other", "lost"]
    assert sum(line.startswith("* ") for line in lines) == 1
    assert "predicted error" in lines[-2]
    assert lines[-1] == "look at out/plan.png"
    report = json.loads((folder / "plan.json").read_text())
    assert report["tolerance"] == 1e-3
    assert report["chosen"] in report["trials"]
    assert {path.name for path in (folder / "out").iterdir()} == {"plan.png", MANIFEST}


def test_a_tolerance_scans_with_the_chosen_readout(folder: Path) -> None:
    text = run("--tolerance", "1mm")
    report = json.loads((folder / "out" / "report.json").read_text())
    chosen = report["readout"]
    assert text.startswith(f"plan: {chosen['method']} {chosen['window']}: predicted error")
    assert chosen == {"method": "windowed", "window": 6, "fir_length": 4, "precision": None}


def test_a_plan_without_a_tolerance_and_options_without_effect_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="--plan needs --tolerance"):
        run("--plan")
    with pytest.raises(ValueError, match=r"--tolerance is '20 kg', expected 1 number: m \(or cm, mm, um\)"):
        run("--plan", "--tolerance", "20 kg")
    with pytest.raises(ValueError, match="--precision has no effect with --tolerance, which chooses it"):
        run("--tolerance", "20um", "--precision", "double")
    for option, value in (("--policy", "block"), ("--format", "x3p"), ("--ply", "valid"), ("--precision", "single")):
        with pytest.raises(ValueError, match=f"{option} has no effect with --plan"):
            run("--plan", "--tolerance", "20um", option, value)
    with pytest.raises(ValueError, match="--tolerance has no effect with --preview"):
        run("--preview", "--tolerance", "20um")
    assert {path.name for path in folder.iterdir()} == {"in.npy", "s.toml"}


def test_a_refused_plan_leaves_no_file(folder: Path) -> None:
    with pytest.raises(Exception, match=r"no readout meets an error of 0\.001 um"):
        run("--plan", "--tolerance", "0.001um")
    assert not (folder / "out" / "plan.png").exists()
