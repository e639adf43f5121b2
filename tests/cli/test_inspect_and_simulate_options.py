"""What the commands `inspect` and `simulate` make of their options: values, defaults, sides and files."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gpuvision.cli import inspect, scan, simulate
from gpuvision.formats import height_files, leads_file, materials_file
from gpuvision.inspection import apertures
from gpuvision.matching.artwork import artwork
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.readings import PATHS
from gpuvision.workflows import (
    inspecting_leads,
    inspecting_paste,
    part_unit,
    scan_errors,
    simulated_recording,
    simulating,
)

# ---- inspect ---------------------------------------------------------------------------------------------------------


def paste_options(**changes: Any) -> inspect._PasteOptions:
    return inspect._PasteOptions(**{**dict.fromkeys(inspect._PasteOptions._fields), "pin_names": False, **changes})


def test_settings_of_paste_and_their_defaults() -> None:
    default = paste_options().settings("120um")
    assert (default.stencil, default.threshold, default.margin) == pytest.approx((120e-6, 60e-6, 50e-6))
    assert (default.ring, default.reference_order, default.pad_height) == pytest.approx((0.2e-3, 1, 0.0))
    given = {"threshold": "20um", "margin": "70um", "ring": "1mm", "reference_order": 0, "pad_height": "35um"}
    found = paste_options(**given).settings("0.1mm")
    assert (found.stencil, found.threshold, found.margin) == pytest.approx((1e-4, 20e-6, 70e-6))
    assert (found.ring, found.reference_order, found.pad_height) == pytest.approx((1e-3, 0, 35e-6))
    limits = paste_options().limits
    assert (limits.minimum, limits.maximum) == (0.5, 1.5)
    limits = paste_options(minimum_volume=0.0, maximum_volume=0.25).limits
    assert (limits.minimum, limits.maximum) == (0.0, 0.25)


def test_search_range_of_paste() -> None:
    assert paste_options().reach == pytest.approx((2e-3, math.radians(3.0)))
    assert paste_options(search_range="0,0").reach == (0.0, 0.0)
    for text, what in (("-1um,0", "shift"), ("1mm,-0.1", "rotation")):
        with pytest.raises(ValueError, match=f"the {what} of --search-range is -"):
            _ = paste_options(search_range=text).reach


def test_numbers_of_an_inspection() -> None:
    assert inspect._sigma(None) is inspect._correlation_area(None) is None
    assert inspect._sigma("2um") == pytest.approx(2e-6)
    assert inspect._correlation_area(1.0) == 1.0
    assert inspect._scale_sigmas("0.002,0.001") == {"height": 0.002, "lateral": 0.001}
    with pytest.raises(ValueError, match=r"--sigma is 0\.0, expected a number > 0"):
        inspect._sigma("0")
    with pytest.raises(ValueError, match=r"--correlation-area is 0\.99, expected"):
        inspect._correlation_area(0.99)
    for text in ("0.1", "0.1,0.2,0.3", "a,b"):
        with pytest.raises(ValueError, match=f"--scale-sigma is '{text}', expected two numbers"):
            inspect._scale_sigmas(text)


def test_scale_of_an_image_of_heights() -> None:
    assert inspect._image_scale(None, None, None, None) is None
    found: Any = inspect._image_scale("20um", "1um", None, None)
    assert (found.cell_x, found.cell_y, found.step) == pytest.approx((2e-5, 2e-5, 1e-6))
    assert (found.offset, found.hole) == (0.0, 0.0)
    found = inspect._image_scale("20um,30um", "2um", "-5mm", 65535.0)
    assert (found.cell_x, found.cell_y, found.step) == pytest.approx((2e-5, 3e-5, 2e-6))
    assert (found.offset, found.hole) == (pytest.approx(-5e-3), 65535.0)
    for given, missing in ((("20um", None), "--height-step"), ((None, "1um"), "--cell")):
        with pytest.raises(ValueError, match=f"{missing} is missing; an image of heights needs both"):
            inspect._image_scale(*given, None, None)
    for options, name in ((("1mm", None), "height-offset"), ((None, 0.0), "hole")):
        with pytest.raises(ValueError, match=f"--{name} has no effect without --cell and --height-step"):
            inspect._image_scale(None, None, *options)


def common_options(**changes: Any) -> inspect._Common:
    values = dict.fromkeys(inspect._Common._fields) | {"heights": Path("h.tiff"), "side": "top"}
    return inspect._Common(**(values | changes))


@pytest.mark.parametrize(
    ("side", "file", "seen"),
    [("top", None, "bottom"), ("bottom", None, "top"), ("top", "l.csv", "top"), ("bottom", "l.csv", "bottom")],
)
@pytest.mark.parametrize("full", [False, True])
def test_leads_of_a_part_are_the_mirror_image_of_its_pads(
    side: Any, file: str | None, seen: str, full: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inspect, "_regions", lambda *given: given)
    monkeypatch.setattr(height_files, "read_heights", lambda *given: given)
    monkeypatch.setattr(inspecting_leads, "inspect_leads", lambda *given, **how: (given, how))
    more = {"board": Path("b"), "sigma": 3e-6, "correlation_area": 4.0} if full else {}
    common = common_options(side=side, pose=(1.0, 2.0, 0.5), **more)
    leads, place = "U1", None if file is None else Path(file)
    options: dict[str, Any] = (
        {"centre": "1mm,2mm", "maximum_gap": "50um"} if full else dict.fromkeys(("centre", "maximum_gap"))
    )
    found: Any = inspect._inspect_leads(common, leads, place, side_given=True, **options)
    (heights, regions), how = found
    assert heights == (Path("h.tiff"), None)
    assert regions == (leads, place, common.board, None, side)
    placement = how.pop("placement")
    assert (placement.x, placement.y, placement.theta, placement.side) == (1.0, 2.0, 0.5, seen)
    files = {"height_map": "h.tiff", "leads": "U1"}
    if full:
        assert how.pop("centre") == pytest.approx((1e-3, 2e-3))
        assert how.pop("maximum") == pytest.approx(5e-5)
        assert how == {"sigma": 3e-6, "correlation_area": 4.0, "files": files | {"board": "b"}}
    else:
        assert how == {"sigma": None, "correlation_area": 1.0, "centre": None, "maximum": None, "files": files}


def test_leads_without_a_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspect, "_regions", lambda *given: given)
    monkeypatch.setattr(height_files, "read_heights", lambda *given: given)
    monkeypatch.setattr(inspecting_leads, "inspect_leads", lambda *given, **how: how)
    none: Any = {"centre": None, "maximum_gap": None}
    found: Any = inspect._inspect_leads(common_options(), "l.csv", Path("l.csv"), side_given=False, **none)
    assert found["placement"] is None
    with pytest.raises(ValueError, match="--side has no effect without --pose"):
        inspect._inspect_leads(common_options(), "l.csv", Path("l.csv"), side_given=True, **none)
    with pytest.raises(ValueError, match="--leads is 'U1', a part: give --pose too, or a CSV file of leads"):
        inspect._inspect_leads(common_options(), "U1", None, side_given=False, **none)


def test_regions_of_leads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leads_file, "read_leads", lambda file: ("read", file))
    monkeypatch.setattr(artwork, "read_artwork", lambda board, **how: SimpleNamespace(pads=(board, how)))
    monkeypatch.setattr(inspecting_leads, "pads_of_part", lambda *given: given)
    found: Any = inspect._regions("l.csv", Path("l.csv"), None, None, "top")
    assert found == ("read", Path("l.csv"))
    found = inspect._regions("U1", None, Path("b"), ["a.gtl=top copper"], "bottom")
    (board, how), part = found
    assert (board, how["side"], list(how["layers"].values()), part) == (Path("b"), "bottom", ["top copper"], "U1")
    for given, name in (((Path("b"), None), "board"), ((None, ["a=b"]), "layers")):
        with pytest.raises(ValueError, match=f"--{name} has no effect with a CSV file of leads"):
            inspect._regions("l.csv", Path("l.csv"), *given, "top")
    with pytest.raises(ValueError, match="--leads is 'U1', a part: give --board too"):
        inspect._regions("U1", None, None, None, "top")


@pytest.mark.parametrize("full", [False, True])
def test_an_inspection_of_paste(full: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(height_files, "read_heights", lambda *given: given)
    monkeypatch.setattr(artwork, "read_artwork", lambda board, **how: SimpleNamespace(pads=("pads", how["side"])))
    monkeypatch.setattr(apertures, "read_apertures", lambda board, **how: (board, how["side"], how["pads"]))
    result = SimpleNamespace()
    asked: list[Any] = []
    monkeypatch.setattr(inspecting_paste, "inspect_paste", lambda *given, **how: asked.append((given, how)) or result)
    options: dict[str, Any] = {"stencil": "0.1mm"}
    if full:
        options |= {
            "pin_names": True,
            "initial_pose": "1mm,2mm,0.5",
            "search_range": "1mm,0.1",
            "scale_sigma": "0.2,0.1",
        }
    more = {"sigma": 2e-6, "correlation_area": 3.0} if full else {}
    common = common_options(board=Path("b"), side="bottom", **more)
    assert inspect._inspect_paste(common, paste_options(**options)) is result
    (((heights, regions, settings), how),) = asked
    assert heights == (Path("h.tiff"), None)
    assert regions == (Path("b"), "bottom", ("pads", "bottom") if full else ())
    assert settings.stencil == pytest.approx(1e-4)
    assert how.pop("search_range") == pytest.approx((1e-3, 0.1) if full else (2e-3, math.radians(3.0)))
    initial, scales = how.pop("initial_pose"), how.pop("scale_sigma")
    assert initial == (pytest.approx((1e-3, 2e-3, 0.5)) if full else None)
    assert (scales.height, scales.lateral) == (0.2, 0.1) if full else scales is None
    assert (how.pop("limits").minimum, how.pop("files")) == (0.5, {"height_map": "h.tiff", "board": "b"})
    assert how == {
        "side": "bottom",
        "pose": None,
        "sigma": more.get("sigma"),
        "correlation_area": more.get("correlation_area"),
    }


@pytest.mark.parametrize("kind", ["paste", "leads"])
def test_warnings_are_printed(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    result = SimpleNamespace(
        warnings=lambda: ["rough", "tilted"], write=lambda *given, **how: None, summary=lambda: "done", report=dict
    )
    monkeypatch.setattr(inspect, f"_inspect_{kind}", lambda *given, **how: result)
    (tmp_path / "h.tiff").touch()
    inspect.inspect(tmp_path / "h.tiff", tmp_path / "out", leads="U1" if kind == "leads" else None)
    assert capsys.readouterr().err.splitlines() == ["warning: rough", "warning: tilted"]


def test_what_an_inspection_of_paste_needs() -> None:
    for changes, stencil, missing in (({}, "0.1mm", "--board"), ({"board": Path("b")}, None, "--stencil")):
        with pytest.raises(ValueError, match=f"{missing} is missing; expected a board with its stencil, or --leads"):
            inspect._inspect_paste(common_options(**changes), paste_options(stencil=stencil))
    common = common_options(board=Path("b"), pose=(0.0, 0.0, 0.0))
    for name in ("initial_pose", "search_range"):
        with pytest.raises(ValueError, match=f"--{name.replace('_', '-')} has no effect with --pose, a known place"):
            inspect._inspect_paste(common, paste_options(stencil="0.1mm", **{name: "0,0,0"}))


# ---- simulate and scan -----------------------------------------------------------------------------------------------


def test_light_paths_by_name() -> None:
    assert simulate._names(" all ") == PATHS
    assert simulate._names("direct, specular,,multi-bounce ") == ("direct", "specular", "multi-bounce")
    assert simulate._names(None) == simulating.DEFAULT_PATHS
    assert simulate._names(None, is_planned=True) == PATHS
    assert simulate._names("direct", is_planned=True) == ("direct",)


def test_mask_by_name_or_file(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Mask, "load", lambda file: ("mask of", file))
    assert [simulate._mask(each) for each in ("none", "best", "m.toml")] == [None, "best", ("mask of", "m.toml")]


@pytest.mark.parametrize("has_recording", [False, True])
def test_files_of_one_sensor_and_of_two(has_recording: bool) -> None:
    one = set(simulate._files(1, has_mask=False, has_recording=has_recording))
    two = set(simulate._files(2, has_mask=False, has_recording=has_recording))
    recordings = set(simulated_recording.RECORDING_FILES)
    assert one < two
    assert (recordings <= one) == has_recording
    assert ({f"second/{name}" for name in recordings} <= two) == has_recording
    assert not any(name.startswith(("second/", "both/")) for name in one)
    assert {"both/errors.png", "second/errors.png", "errors.png"} <= two


@pytest.mark.parametrize("has_second", [False, True])
def test_a_second_sensor_has_the_profiles_of_the_first(has_second: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(
        simulating,
        "prepare_simulation",
        lambda *given, **how: asked.append((given, how)) or SimpleNamespace(transports=f"of {given[2]}"),
    )
    given: Any = ("scene", ("matt",), ["one", "other"] if has_second else ["one"], 7)
    tasks = simulate._prepare(*given, paths=("direct",))
    assert tasks[0].transports == "of one"
    assert asked[0] == (("scene", ("matt",), "one"), {"profiles": 7, "paths": ("direct",)})
    assert len(asked) == 1 + has_second
    assert len(tasks) == 1 + has_second
    if has_second:
        assert asked[1] == (("scene", ("matt",), "other"), {"transports": "of one", "paths": ("direct",)})


@pytest.mark.parametrize(("defects", "doubt"), [("no defects", ""), ("holes\nslivers", "is it in mm?")])
@pytest.mark.parametrize(("materials", "albedo", "used"), [(None, None, 0.5), (None, 0.0, 0.0), (Path("m"), None, 0.5)])
def test_doubts_about_a_part_are_said(
    defects: str,
    doubt: str,
    materials: Path | None,
    albedo: float | None,
    used: float,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    scene: Any = SimpleNamespace(defects=defects)
    asked: list[Any] = []
    monkeypatch.setattr(materials_file, "read_materials", lambda file: ["a material"])
    monkeypatch.setattr(simulating, "load_part", lambda *given: asked.append(given) or (scene, ("matt",)))
    monkeypatch.setattr(part_unit, "doubt_unit", lambda *given: asked.append(given) or doubt)
    sensor: Any = "a sensor"
    assert simulate._load_part(Path("part.stl"), simulate.Unit.millimetre, materials, albedo, sensor) == (
        scene,
        ("matt",),
    )
    given = None if materials is None else ["a material"]
    assert asked[0] == (Path("part.stl"), 1e-3, given, used)
    assert asked[1][:3] == (scene, "a sensor", simulate.Unit.millimetre.value)
    assert asked[1][3][simulate.Unit.millimetre.value] == 1e-3
    lines = ["part.stl: holes; slivers", "part.stl: is it in mm?"] if doubt else []
    assert capsys.readouterr().err.splitlines() == lines


def test_recordings_of_each_sensor(monkeypatch: pytest.MonkeyPatch) -> None:
    """A mask that was made for the part is that of the recording, too."""
    asked: list[Any] = []
    monkeypatch.setattr(simulated_recording, "write_recording", lambda *given, **how: asked.append((given, how)))
    found: Any = [
        SimpleNamespace(task="one", mask=None),
        SimpleNamespace(task="other", mask=SimpleNamespace(mask="made")),
    ]
    made = {"seed": 5, "device": "d", "mask": "given", "limit": 1.0}
    out = Path("my part")
    lines = simulate._write_recordings(found, ["a.toml", "b.toml"], out, made, ["p.stl"], True)
    how: dict[str, Any] = {"light": out, "inputs": ["p.stl"], "overwrite": True, "seed": 5, "device": "d"}
    assert asked == [
        (("one", out, "a.toml"), how | {"mask": "given"}),
        (("other", out / "second", "b.toml"), how | {"mask": "made"}),
    ]
    recording, sensor = simulated_recording.RECORDING_FILES
    assert lines == [
        f"next: gpuvision scan 'my part/{recording}' --sensor 'my part/{sensor}' --out 'my part/scan'",
        f"next: gpuvision scan 'my part/second/{recording}' --sensor 'my part/second/{sensor}' "
        "--out 'my part/second/scan'",
    ]


@pytest.mark.parametrize("budget", ["", "sigma 3 um"])
@pytest.mark.parametrize("to_stderr", [False, True])
def test_a_scan_is_told_in_lines(
    budget: str, to_stderr: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done: Any = SimpleNamespace(
        advice=lambda: ("more light",), summary=lambda: "30 frames", error_budget=lambda: {"of": "scan"}
    )
    monkeypatch.setattr(scan_errors, "budget_line", lambda given: budget if given == {"of": "scan"} else "wrong")
    scan._show(done, Path("out"), to_stderr=to_stderr)
    printed = capsys.readouterr()
    lines = ["30 frames", *([budget] if budget else []), "look at out/picture.png and out/report.json"]
    assert printed.out.splitlines() == ([] if to_stderr else lines)
    assert printed.err.splitlines() == ["warning: more light", *(lines if to_stderr else [])]
