"""What the command `select` makes of its options."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from gpuvision.cli import select
from gpuvision.cli.main import application
from gpuvision.formats import features_file
from gpuvision.host import Device
from gpuvision.matching.artwork import artwork
from gpuvision.matching.features import feature_set
from gpuvision.plots import board


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("60", (60.0, "rulers")),
        (" 60 rulers ", (60.0, "rulers")),
        ("20000px", (20000.0, "px")),
        ("150us", (150.0, "us")),
        ("1.5µs", (1.5, "us")),
        ("0.1 px", (0.1, "px")),
    ],
)
def test_budgets(text: str, expected: tuple[float, str]) -> None:
    assert select._budget(text) == expected


@pytest.mark.parametrize("text", ["0", "0px", "-1", "1ms", "px", "", "1 2"])
def test_budgets_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match=f"--budget is '{text}', expected a number above 0 with a unit"):
        select._budget(text)


def test_regions_have_two_corners() -> None:
    assert select._box("1mm,2mm,3mm,4mm") == (pytest.approx((1e-3, 2e-3)), pytest.approx((3e-3, 4e-3)))
    for text in ("3mm,2mm,1mm,4mm", "1mm,4mm,3mm,2mm", "1mm,2mm,1mm,4mm", "1mm,2mm,3mm,2mm"):
        with pytest.raises(ValueError, match=f"--region is '{text}', expected X0 < X1 and Y0 < Y1"):
            select._box(text)


def test_imaging_of_the_options() -> None:
    found = select._imaging("25um", "0.1mm,0.3deg", "40,15", "10um", blur_px=1.25, width_px=7)
    assert (found.pixel, found.contrast_bare, found.contrast_masked) == pytest.approx((25e-6, 40.0, 15.0))
    assert (found.etch_bias_sigma, found.shift, found.angle) == pytest.approx((1e-5, 1e-4, math.radians(0.3)))
    assert (found.blur_px, found.width_px) == (1.25, 7)
    for text in ("40", "40,15,3", "a,b"):
        with pytest.raises(ValueError, match=f"--contrast is '{text}', expected two numbers, such as 40,15"):
            select._contrasts(text)


@pytest.mark.parametrize("full", [False, True])
def test_features_are_chosen_written_and_drawn(full: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A device is for budgets in microseconds alone; the next command has the layers of this one."""
    asked: list[Any] = []
    made = SimpleNamespace(
        summary=lambda: "30 rulers", length=np.zeros(30), fiducials=SimpleNamespace(radius=np.zeros(0))
    )
    side = SimpleNamespace(warnings=("an odd layer",))
    monkeypatch.setattr(Device, "named", staticmethod(lambda label: f"device {label}"))
    monkeypatch.setattr(artwork, "read_artwork", lambda *given, **how: asked.append((given, how)) or side)
    monkeypatch.setattr(feature_set, "edge_clearance", lambda imaging: imaging.pixel)
    monkeypatch.setattr(feature_set, "choose_features", lambda *given, **how: asked.append((given, how)) or made)
    monkeypatch.setattr(features_file, "write_features", lambda features, path: path.write_text("features"))
    monkeypatch.setattr(
        board, "draw_features", lambda path, *given: asked.append((given, {})) or path.write_text("png")
    )
    folder, out = tmp_path / "my board", tmp_path / "out"
    folder.mkdir()
    words = ["select", str(folder), "--region", "1mm,2mm,3mm,4mm", "--scale", "25um", "--out", str(out)]
    more = ["--budget", "150us", "--device", "gpu", "--placement", "2mm,3mm", "--side", "bottom", "--missing", "0.25"]
    layers = ["--layers", "*.gtl=top copper"]
    ran = CliRunner().invoke(application(), [*words, *(more + layers if full else [])], catch_exceptions=False)
    assert ran.exit_code == 0
    (given, how), ((chosen_on, box, imaging), settings), (drawn, _) = asked
    assert given == (folder,)
    assert (how["side"], how["clearance"]) == ("bottom" if full else "top", pytest.approx(25e-6))
    assert list((how["layers"] or {}).values()) == (["top copper"] if full else [])
    assert chosen_on is side
    assert box == ((pytest.approx(1e-3), pytest.approx(2e-3)), (pytest.approx(3e-3), pytest.approx(4e-3)))
    assert (imaging.pixel, imaging.contrast_bare) == pytest.approx((25e-6, 40.0))
    assert settings == {
        "placement": pytest.approx((2e-3, 3e-3)) if full else None,
        "budget": 150.0 if full else 60.0,
        "unit": "us" if full else "rulers",
        "missing": 0.25 if full else 0.0,
        "device": "device gpu" if full else None,
    }
    assert drawn == (side, made, box)
    assert {each.name for each in out.iterdir() if not each.name.startswith(".")} == {"features.toml", "features.png"}
    assert ran.stderr.splitlines() == ["warning: an odd layer"]
    next_command = f"gpuvision locate IMAGE --board '{folder}' --features {out}/features.toml"
    next_command += " --layers '*.gtl=top copper'" if full else ""
    assert ran.stdout.splitlines() == ["30 rulers", f"look at {out}/features.png; next: {next_command}"]
    with pytest.raises(ValueError, match="--device has no effect without a --budget in us"):
        CliRunner().invoke(application(), [*words, "--device", "gpu", "--budget", "9px"], catch_exceptions=False)
