"""``gpuvision locate --tolerance`` and ``--plan``: table, picture, features, report, and a pose by the chosen ones."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from board_images import BoardPicture, View
from boards import BOARD_MIDDLE, LAYERS, board_folder
from gpuvision.cli.main import application
from gpuvision.host.outputs import MANIFEST
from gpuvision.matching.artwork.artwork import read_artwork
from gpuvision.workflows import planning_location

LAYER_WORDS = [word for name, layer in LAYERS.items() for word in ("--layers", f"{name}={layer}")]
PIXEL = 40e-6


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rng: np.random.Generator) -> Path:
    """Return the current folder, with a board and its image."""
    monkeypatch.chdir(tmp_path)
    # Few feature sets: each width and smoothing is a build of the kernel.
    monkeypatch.setattr(planning_location, "_BUDGETS", (40, 100))
    monkeypatch.setattr(planning_location, "_RULERS", ((5, math.sqrt(5.0)),))
    (tmp_path / "gerbers").mkdir()
    artwork = read_artwork(board_folder(tmp_path / "gerbers"), layers=LAYERS)
    corner = np.array(BOARD_MIDDLE) + (np.array((400, 300)) - 1) / 2 * PIXEL * (-1, 1)
    view = View(corner=tuple(corner), pixel=PIXEL, shape=(300, 400), noise=2.0)
    image = BoardPicture(artwork, view).seen((20e-6, -30e-6, 1e-3), rng)
    cv2.imwrite("board.png", np.clip(np.rint(image), 0, 255).astype(np.uint8))
    return tmp_path


def run(*words: str) -> str:
    given = ["locate", "board.png", "--board", "gerbers", *LAYER_WORDS, "--scale", "40um"]
    ran = CliRunner().invoke(application(), [*given, "--initial-pose", "10mm,8mm,0deg", *words])
    if ran.exception is not None:
        raise ran.exception
    return ran.stdout


def test_a_plan_is_printed_drawn_and_reported(folder: Path) -> None:
    text = run("--plan", "--tolerance", "1mm", "--rate", "1", "--out", "my plan", "--json", "plan.json")
    lines = text.splitlines()
    assert lines[0].split() == ["features", "us/frame", "error", "scatter", "other", "leverage", "refused"]
    assert sum(line.startswith("* ") for line in lines) == 1
    assert "rulers of 5 px: predicted error" in lines[-3]
    assert lines[-2:] == [
        "look at my plan/plan.png",
        "next: give --features 'my plan/features.toml' instead of --tolerance",
    ]
    report = json.loads((folder / "plan.json").read_text())
    assert report["tolerance"] == 1e-3
    assert report["chosen"] in report["trials"]
    assert {path.name for path in (folder / "my plan").iterdir()} == {"plan.png", "features.toml", MANIFEST}
    # The features locate the board without another selection.
    assert "sigmas" in run("--features", "my plan/features.toml")


def test_a_tolerance_locates_with_the_chosen_features(folder: Path) -> None:
    text = run("--tolerance", "1mm", "--json", "pose.json")
    assert text.startswith("plan: ")
    assert "x 9.9" in text
    report = json.loads((folder / "pose.json").read_text())
    assert report["status"] == "located"
    assert text.startswith(f"plan: {len(report['rulers'])} rulers of 5 px")


def test_options_without_effect_are_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match="--plan needs --tolerance, the largest error of the pose, such as 2um"):
        run("--plan")
    with pytest.raises(ValueError, match="--rate has no effect without --tolerance"):
        run("--rate", "100")
    with pytest.raises(ValueError, match=r"--tolerance is '2 kg', expected 1 number: m \(or cm, mm, um\)"):
        run("--tolerance", "2 kg")
    for option, value in (("--features", "f.toml"), ("--budget", "9")):
        with pytest.raises(ValueError, match=f"{option} has no effect with --tolerance, which chooses the features"):
            run("--tolerance", "2um", option, value)
    with pytest.raises(ValueError, match="--gcode has no effect with --plan"):
        run("--plan", "--tolerance", "2um", "--gcode", "f.ngc", "--camera-at", "0,0,0")
    assert {path.name for path in folder.iterdir()} == {"gerbers", "board.png"}


def test_a_refused_plan_shows_what_was_tried_and_leaves_no_file(folder: Path) -> None:
    with pytest.raises(Exception, match=r"no feature set meets an error of 0\.001 um"):
        run("--plan", "--tolerance", "0.001um", "--out", "out")
    assert not (folder / "out").exists()
