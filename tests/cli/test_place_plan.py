"""``gpuvision place --tolerance`` and ``--plan``: table, picture, machine file, report, and placements by the plan."""

from __future__ import annotations

import json
import tomllib
from importlib import resources
from pathlib import Path

import pytest
import tomli_w
from typer.testing import CliRunner

from boards import LAYERS, board_folder
from gpuvision.cli.main import application
from gpuvision.formats.machine_file import read_machine
from gpuvision.host.outputs import MANIFEST
from gpuvision.workflows import placement_settings, planning_placement

LAYER_WORDS = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the current folder, with a board and a machine of 128 x 128 px."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(placement_settings, "_WINDOWS", (1.0,))
    monkeypatch.setattr(placement_settings, "_RELEASES", (1.0,))
    monkeypatch.setattr(planning_placement, "_TRIED", 3)
    (tmp_path / "gerbers").mkdir()
    board_folder(tmp_path / "gerbers")
    preset = resources.files("gpuvision").joinpath("presets", "machines", "look_while_place.toml")
    table = tomllib.loads(preset.read_text(encoding="utf-8"))
    table["camera"] |= {"window": [128, 128], "pixel": 20e-6}
    (tmp_path / "machine.toml").write_text(tomli_w.dumps(table))
    return tmp_path


def run(*words: str, machine: str = "machine.toml") -> str:
    given = ["place", "gerbers", "--machine", machine, *LAYER_WORDS, "--at", "15.8mm,6.4mm,0deg", "--out", "out"]
    ran = CliRunner().invoke(application(), [*given, *words])
    if ran.exception is not None:
        raise ran.exception
    return ran.stdout


def test_a_plan_is_printed_drawn_and_reported(folder: Path) -> None:
    text = run(
        "--plan", "--tolerance", "1mm", "--rate", "20", "--part-radius", "0m", "--json", "plan.json", "--out", "my plan"
    )
    lines = text.splitlines()
    heads = ["settings", "us/part", "error", "machine", "vision", "loop", "images", "aborted"]
    assert lines[0].split() == heads
    assert sum(line.startswith("* ") for line in lines) == 1
    assert "128x128 at 1000/s, " in lines[-3]
    assert lines[-2:] == [
        "look at my plan/plan.png",
        "next: give --machine 'my plan/machine.toml' --budget 60 instead of --machine and --tolerance",
    ]
    report = json.loads((folder / "plan.json").read_text())
    assert report["tolerance"] == 1e-3
    assert report["chosen"] in report["trials"]
    # Without a radius the angle does not count: the error is that of the calibration and the loop in x and y.
    assert report["chosen"]["error"] < 1.5e-6
    assert {path.name for path in (folder / "my plan").iterdir()} == {"plan.png", "machine.toml", MANIFEST}
    read, chosen = read_machine(folder / "my plan" / "machine.toml"), report["chosen"]
    assert (read.control.observer, read.loop_gain) == (chosen["observer"], chosen["gain"])
    assert read.tolerance.position == chosen["release_position"]
    assert read.rate == chosen["rate"]


def test_a_tolerance_places_with_the_chosen_settings(folder: Path) -> None:
    text = run("--tolerance", "1mm", "--count", "2", "--json", "place.json")
    assert text.startswith("plan: 128x128 at 1000/s")
    report = json.loads((folder / "place.json").read_text())
    assert f", {report['observer']} {report['gain_per_frame']:.2g}" in text.splitlines()[0]
    assert len(report["placements"]) == 2


def test_options_without_effect_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="--plan needs --tolerance, the largest error of the placement, such as 5um"):
        run("--plan")
    with pytest.raises(ValueError, match="--rate has no effect without --tolerance"):
        run("--rate", "100")
    with pytest.raises(ValueError, match="--time-vision has no effect without --tolerance"):
        run("--time-vision")
    with pytest.raises(ValueError, match="--part-radius has no effect without --tolerance"):
        run("--part-radius", "1mm")
    with pytest.raises(ValueError, match="--count has no effect with --plan"):
        run("--plan", "--tolerance", "5um", "--count", "2")
    with pytest.raises(ValueError, match="--seed has no effect with --plan"):
        run("--plan", "--tolerance", "5um", "--seed", "0")
    assert {path.name for path in folder.iterdir()} == {"gerbers", "machine.toml"}


def test_a_refused_plan_shows_what_was_tried_and_leaves_no_file(folder: Path) -> None:
    with pytest.raises(Exception, match=r"no setting meets an error of 0\.001 um; the most accurate, 128x128"):
        run("--plan", "--tolerance", "0.001um")
    assert not (folder / "out").exists()
