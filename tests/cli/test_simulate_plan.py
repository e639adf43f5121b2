"""``gpuvision simulate --tolerance`` and ``--plan``: table, picture, report, and a simulation with the chosen light."""

from __future__ import annotations

import json
from importlib import resources
from pathlib import Path

import pytest
import trimesh
from typer.testing import CliRunner

from gpuvision.cli.main import application
from gpuvision.host.outputs import MANIFEST
from gpuvision.workflows import planning_simulation


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a mesh and a sensor file of few bins."""
    monkeypatch.chdir(tmp_path)
    trimesh.creation.box((20e-3, 10e-3, 4e-3)).export("part.stl")
    text = resources.files("gpuvision").joinpath("presets", "sensors", "psd_line.toml").read_text(encoding="utf-8")
    assert text.count("\nbins = 96") == 1
    Path("s.toml").write_text(text.replace("\nbins = 96", "\nbins = 24"))
    return tmp_path


def run(*words: str, out: str = "out") -> str:
    ran = CliRunner().invoke(
        application(), ["simulate", "part.stl", "--sensor", "s.toml", "--out", out, "--paths", "direct", *words]
    )
    if ran.exception is not None:
        raise ran.exception
    return ran.stdout


def test_a_plan_is_printed_drawn_and_reported(folder: Path) -> None:
    text = run("--plan", "--tolerance", "1mm", "--json", "plan.json")
    lines = text.splitlines()
    columns = ["light", "us/prof.", "error", "change", "pairs", "finest", "worst", "signal", "moved", "profiles"]
    assert lines[0].split() == columns
    assert sum(line.startswith("* direct ") for line in lines) == 1
    assert "predicted error" in lines[-2]
    assert lines[-1] == "look at out/plan.png"
    report = json.loads((folder / "plan.json").read_text())
    assert report["tolerance"] == 1e-3
    assert report["chosen"] in report["trials"]
    assert {path.name for path in (folder / "out").iterdir()} == {"plan.png", MANIFEST}


def test_a_tolerance_simulates_with_the_chosen_light(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(planning_simulation, "_WORTH", 24)
    text = run("--tolerance", "1mm", "--profiles", "25", "--rate", "0.001")
    assert text.startswith("plan: direct ")
    assert "predicted error" in text.splitlines()[0]
    report = json.loads((folder / "out" / "report.json").read_text())
    assert (report["profiles"], report["paths"]) == (25, ["direct"])


def test_a_small_part_is_computed_in_full(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also of a second sensor, without a plan."""
    monkeypatch.setattr(planning_simulation, "plan_task", lambda *_, **__: pytest.fail("planned"))
    text = run("--tolerance", "1mm", "--profiles", "3", "--second", "s.toml")
    line = (
        "plan: 3 profiles are computed in full, because planning would take longer; their error is unknown: "
        "--plan predicts it"
    )
    assert text.splitlines()[:2] == [line, line]


def test_a_plan_without_a_tolerance_and_options_without_effect_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="--plan needs --tolerance, the largest error of the simulated range, such as"):
        run("--plan")
    with pytest.raises(ValueError, match=r"--tolerance is '20 kg', expected 1 number: m \(or cm, mm, um\)"):
        run("--tolerance", "20 kg")
    with pytest.raises(ValueError, match="--tolerance is '0um', expected a length above 0"):
        run("--tolerance", "0um")
    for option in (
        ("--mask", "best"), ("--second", "psd_line"), ("--limit", "1"), ("--seed", "1"), ("--no-noise",),
        ("--recording",), ("--scheduler", "a"),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=f"{option[0]} has no effect with --plan"):
            run("--plan", "--tolerance", "20um", *option)
    assert {path.name for path in folder.iterdir()} == {"part.stl", "s.toml"}


def test_a_refused_plan_leaves_no_file(folder: Path) -> None:
    with pytest.raises(Exception, match=r"no setting meets an error of 0\.001 um"):
        run("--plan", "--tolerance", "0.001um")
    assert not (folder / "out" / "plan.png").exists()
