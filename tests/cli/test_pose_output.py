"""Output of a localisation: report, picture, summary, and the reason of a refusal."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gpuvision.cli.arguments import check_exists, claim_outputs, pose_of
from gpuvision.cli.pose_output import POSE_FILES, report_pose

REPORT = {"pose": {"x": 0.25, "theta": -1.5}, "reason": ""}


def located(reason: str = "") -> Any:
    return SimpleNamespace(reason=reason, report=lambda: {**REPORT, "reason": reason}, summary=lambda: "x 250 mm")


def draw(path: Path) -> None:
    path.write_bytes(b"picture")


def test_files_and_summary_of_a_pose(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, as_json = tmp_path / "out", tmp_path / "pose.json"
    report_pose(
        located(), draw, out, as_json, claim_outputs("locate", [None], as_json, (out, POSE_FILES), overwrite=False)
    )
    assert (out / "pose.json").read_text() == json.dumps(REPORT, indent=1) + "\n"
    assert (out / "located.png").read_bytes() == b"picture"
    assert json.loads(as_json.read_text()) == REPORT
    shown = f"x 250 mm\nlook at {out / 'located.png'} and {out / 'pose.json'}\n"
    assert tuple(capsys.readouterr()) == (shown, "")
    # Files of an earlier run are replaced; other files are not.
    claim_outputs("locate", [], as_json, (out, POSE_FILES), overwrite=False)
    (tmp_path / "other.json").write_text("{}")
    with pytest.raises(FileExistsError, match=r"other\.json"):
        claim_outputs("locate", [], tmp_path / "other.json", (out, POSE_FILES), overwrite=False)
    claim_outputs("locate", [], tmp_path / "other.json", (out, POSE_FILES), overwrite=True)


def test_a_report_on_standard_output_moves_the_summary(capsys: pytest.CaptureFixture[str]) -> None:
    report_pose(located(), draw, None, Path("-"), claim_outputs("locate", [], Path("-"), overwrite=False))
    out, err = capsys.readouterr()
    assert json.loads(out) == REPORT
    assert err == "x 250 mm\n"


def test_a_refused_pose_is_an_error_with_its_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ValueError, match=r"^no pose: too dark$"):
        report_pose(
            located("too dark"),
            draw,
            None,
            None,
            claim_outputs("locate", [], None, (None, POSE_FILES), overwrite=False),
        )
    out = tmp_path / "out"
    with pytest.raises(ValueError, match=r"^no pose: too dark; look at .*located\.png and .*pose\.json$"):
        report_pose(
            located("too dark"), draw, out, None, claim_outputs("locate", [], None, (out, POSE_FILES), overwrite=False)
        )
    assert json.loads((out / "pose.json").read_text())["reason"] == "too dark"
    assert (out / "located.png").exists()
    assert not capsys.readouterr().out


def test_inputs_are_not_overwritten(tmp_path: Path) -> None:
    image = tmp_path / "image.json"
    image.write_text("[]")
    with pytest.raises(OSError, match=r"image\.json"):
        claim_outputs("locate", [str(image), None], image, (None, POSE_FILES), overwrite=True)


def test_the_first_target_with_a_fault_is_named(tmp_path: Path) -> None:
    """Targets are checked in their order: files, and the files of folders."""
    out, report = tmp_path / "out", tmp_path / "report.json"
    out.mkdir()
    for path in (report, out / "b.png"):
        path.write_text("mine")
    with pytest.raises(FileExistsError, match=r"cannot write .*report\.json"):
        claim_outputs("locate", [], report, (out, ("a.png", "b.png")), overwrite=False)
    with pytest.raises(FileExistsError, match=r"cannot write .*b\.png"):
        claim_outputs("locate", [], (out, ("a.png", "b.png")), report, overwrite=False)
    with pytest.raises(ValueError, match=r"two outputs have the same name .*a\.png"):
        claim_outputs("locate", [], (out, ("a.png",)), out / "a.png", overwrite=False)


def test_initial_pose_and_image(tmp_path: Path) -> None:
    assert pose_of(None, "--initial-pose") is None
    assert pose_of("1 m, 20 cm, 90 deg", "--initial-pose") == pytest.approx((1.0, 0.2, 1.5707963))
    assert pose_of("1mm,-2mm,90deg", "--pose") == pytest.approx((1e-3, -2e-3, 1.5707963))
    check_exists(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"missing\.png: no such file"):
        check_exists(tmp_path / "missing.png")
