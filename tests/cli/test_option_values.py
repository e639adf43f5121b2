"""Values of options that commands parse: lists of pixels, lengths and counts, and options that need each other."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gpuvision.cli import calibrate, calibrate_sensor, locate, locate_robot, undistort
from gpuvision.cli.arguments import devices_of, layers_of, prints_report, quantities, reject_unused, write_report
from gpuvision.formats import camera_file, features_file
from gpuvision.host import Device
from gpuvision.workflows import locating_robot


def test_pixels_of_a_window_and_a_region() -> None:
    assert undistort._window("12,-3") == (12, -3)
    assert undistort._region("1,2,30,40") == (1, 2, 30, 40)
    for text in ("1", "1,2,3", "1,x", "1.5,2"):
        with pytest.raises(ValueError, match=f"--window is '{text}', expected column,row in whole pixels"):
            undistort._window(text)
    for text in ("1,2,3", "1,2,3,4,5", "1,2,3,4.0"):
        with pytest.raises(ValueError, match=f"--region is '{text}', expected column,row,columns,rows in whole pixels"):
            undistort._region(text)


def test_inner_corners() -> None:
    assert calibrate._corners("9x6") == (9, 6)
    assert calibrate._corners("10 X 7") == (10, 7)
    for text in ("9", "9x6x2", "9x", "ax6", "9x-6"):
        with pytest.raises(ValueError, match=f"--inner-corners is '{text}', expected the numbers of inner corners"):
            calibrate._corners(text)


def test_views_of_the_transport_and_of_a_block() -> None:
    options: Any = SimpleNamespace(
        transport_views=Path("moved"),
        profiles_between=40.0,
        on_stage=True,
        block=Path("b"),
        block_heights="1mm,0,2.5mm",
    )
    views = calibrate_sensor._transport_views(options)
    assert views is not None
    assert (views.folder, views.profiles_between, views.on_stage) == (Path("moved"), 40.0, True)
    block = calibrate_sensor._block_views(options)
    assert block is not None
    assert (block.folder, block.heights) == (Path("b"), pytest.approx((1e-3, 0.0, 2.5e-3)))
    for name, made in (
        ("transport_views", calibrate_sensor._transport_views),
        ("profiles_between", calibrate_sensor._transport_views),
        ("block", calibrate_sensor._block_views),
        ("block_heights", calibrate_sensor._block_views),
    ):
        assert made(SimpleNamespace(**{**vars(options), name: None})) is None  # type: ignore[arg-type]
    options.block_heights = "1mm,x"
    with pytest.raises(ValueError, match="--block-heights is '1mm,x', expected 2 numbers"):
        calibrate_sensor._block_views(options)


@pytest.mark.parametrize("significant", [False, True])
def test_a_calibrated_sensor_is_printed_camera_first(significant: bool, capsys: pytest.CaptureFixture[str]) -> None:
    camera = SimpleNamespace(summary=lambda: "a camera", skipped_images=[("a.png", "no dots")], warnings=("tilt it",))
    test = SimpleNamespace(
        significant=significant, bend=(0.5, -0.25, 2.0), sigma=(0.1, 0.02, 0.3), p_value=0.0123 if significant else 0.5
    )
    done: Any = SimpleNamespace(
        calibration=camera,
        summary=lambda: "a sensor",
        geometry=SimpleNamespace(sheet=SimpleNamespace(bend_test=test)),
        warnings=("tilt it", "move it"),
    )
    calibrate_sensor._show(done, pytest.fail, to_stderr=significant)
    printed = capsys.readouterr()
    verdict = "p = 0.012 (F test): kept" if significant else "p = 0.5 (F test): not significant, left out"
    assert (printed.err if significant else printed.out).splitlines() == [
        "a camera",
        "skipped a.png: no dots",
        "warning: tilt it",
        "a sensor",
        f"bend of the sheet [1/m]: gg 0.5 +- 0.1, gh -0.25 +- 0.02, hh 2 +- 0.3; {verdict}",
        "warning: move it",
    ]
    assert not (printed.out if significant else printed.err)


def test_search_range_and_pixel_of_a_board() -> None:
    assert locate._search_range(None) is None
    assert locate._search_range("2mm,0.5") == pytest.approx((2e-3, 0.5))
    features: Any = SimpleNamespace(imaging=SimpleNamespace(pixel=3e-5))
    assert locate._pixel("25um", features) == pytest.approx(25e-6)
    assert locate._pixel(None, features) == 3e-5
    with pytest.raises(ValueError, match="--scale is missing: the size of a pixel on the board, such as 25um"):
        locate._pixel(None, None)


def test_place_of_the_camera_on_the_machine() -> None:
    assert locate._camera_at(None, None, None) is None
    assert locate._camera_at("120mm,-80mm,0.5", Path("a.ngc"), None) == pytest.approx((0.12, -0.08, 0.5))
    with pytest.raises(ValueError, match="--camera-at has no effect without --gcode; leave it out"):
        locate._camera_at("0,0,0", None, None)
    with pytest.raises(ValueError, match="--gcode needs --camera-at: where on the machine"):
        locate._camera_at(None, Path("a.ngc"), None)


def test_features_of_a_file_and_options_that_contradict_it(monkeypatch: pytest.MonkeyPatch) -> None:
    features = SimpleNamespace(side="bottom")
    monkeypatch.setattr(features_file, "read_features", lambda file: features)
    file, top, bottom = Path("f.toml"), SimpleNamespace(value="top"), SimpleNamespace(value="bottom")
    given: Any
    for given in ((file, None, None), (file, None, bottom)):
        assert locate._features(*given) is features
    given = (file, None, top)
    with pytest.raises(ValueError, match=r"--side is top, but the features in f\.toml are on the bottom; leave it out"):
        locate._features(*given)
    given = (file, 50, None)
    with pytest.raises(ValueError, match="--budget has no effect with --features"):
        locate._features(*given)


@pytest.mark.parametrize("lens", [None, "a lens"])
@pytest.mark.parametrize("line_width", [None, "20mm"])
def test_settings_of_a_view_of_the_floor(
    lens: str | None, line_width: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A top view needs its scale; a camera with a table [mount] gives it."""
    monkeypatch.setattr(locating_robot, "default_line_width", lambda field: 0.125)
    monkeypatch.setattr(camera_file, "read_mounted", lambda file, shape: "a mount" if file.stem == "mounted" else None)
    monkeypatch.setattr(camera_file, "read_lens", lambda file: lens)
    width = 0.125 if line_width is None else 0.02
    field: Any = None
    camera = None if lens is None else Path("lens.toml")
    found = locate_robot._scan_settings((3, 4), field, camera, 0.01, line_width, "30cm")
    assert found == {"scale": 0.01, "line_width": width, "blind": pytest.approx(0.3), "model": lens}
    found = locate_robot._scan_settings((3, 4), field, Path("mounted.toml"), None, line_width, None)
    assert found == {"scale": None, "line_width": width, "blind": 0.0, "model": "a mount"}
    with pytest.raises(ValueError, match="--scale is missing: the size of a pixel on the floor, such as 1cm"):
        locate_robot._scan_settings((3, 4), field, camera, None, line_width, None)
    for given in ((0.01, None), (None, "30cm")):
        with pytest.raises(ValueError, match=r"has no effect with mounted\.toml, whose table \[mount\] gives height"):
            locate_robot._scan_settings((3, 4), field, Path("mounted.toml"), given[0], line_width, given[1])


@pytest.mark.parametrize(
    ("units", "values"),
    [
        ("m", {"": 1.0, "m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6}),
        ("rad", {"": 1.0, "rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0}),
        ("s", {"": 1.0, "s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6}),
    ],
)
def test_units_of_quantities(units: str, values: dict[str, float]) -> None:
    for name, value in values.items():
        for text in (f"-2.5{name}", f" -25e-1 {name} ", f"-.25e+1{name}", f"-2.5E0{name}"):
            assert quantities(text, "--at", units) == pytest.approx((-2.5 * value,), rel=1e-12)
    for name in {"m", "mm", "rad", "deg", "s", "ms", "km", "x"} - set(values):
        with pytest.raises(ValueError, match=rf"--at is '1{name}', expected 1 number: {units} \(or "):
            quantities(f"1{name}", "--at", units)


def test_numbers_of_quantities() -> None:
    assert quantities("1mm,2,3deg", "--at", "m,m,rad") == pytest.approx((1e-3, 2.0, math.pi / 60.0))
    for text, message in (
        ("1mm,2", "--at is '1mm,2', expected 3 numbers: m (or cm, mm, um), m (or cm, mm, um), rad (or mrad, deg)"),
        ("1mm,2,3,4", "--at is '1mm,2,3,4', expected 3 numbers: "),
        ("1mm,2,1e400", "--at is '1mm,2,1e400', expected finite numbers"),
        ("1mm,,3", "--at is '1mm,,3', expected 3 numbers"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            quantities(text, "--at", "m,m,rad")


def test_layers_by_name_or_pattern() -> None:
    assert layers_of(None) is layers_of([]) is None
    table = layers_of(["*.gtl=top copper", "a.gko= mechanical outline "])
    assert table is not None
    assert list(table.values()) == ["top copper", "mechanical outline"]
    top, outline = table
    assert [bool(re.match(top, name)) for name in ("x.gtl", "x.gtlx", "gtl")] == [True, False, False]
    assert [bool(re.match(outline, name)) for name in ("a.gko", "b.gko")] == [True, False]
    for text in ("a", "=top copper", "a=", "a= "):
        with pytest.raises(ValueError, match=f"--layers is '{text}', expected a file name or pattern and a layer"):
            layers_of([text])


def test_options_without_effect_are_named() -> None:
    reject_unused("here", some_value=None, flag=False)
    for given in ({"some_value": 0}, {"some_value": ""}, {"some_value": True}):
        with pytest.raises(ValueError, match="--some-value has no effect here; leave it out"):
            reject_unused("here", other=None, **given)


def test_devices_by_their_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Device, "named", staticmethod(lambda label: f"device {label}"))
    monkeypatch.setattr(Device, "best", staticmethod(lambda: "best"))
    for all_of_them, expected in ((("one", "two"), ["one", "two"]), ((), ["best"])):
        monkeypatch.setattr(Device, "all", staticmethod(lambda found=all_of_them: found))
        assert devices_of(None) == devices_of([]) == expected
        assert devices_of(["b", "a"]) == ["device b", "device a"]


@pytest.mark.parametrize("to", [None, "-", "report.json"])
def test_a_report_goes_where_it_is_asked_for(to: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    written: list[Any] = []
    outputs: Any = SimpleNamespace(write_text=lambda *given: written.append(given))
    path = None if to is None else Path(to)
    write_report(path, {"a": math.inf, "b": 1.5}, outputs)
    assert prints_report(path) == (to == "-")
    assert [file for file, _ in written] == ([path] if to == "report.json" else [])
    for text in [capsys.readouterr().out] if to == "-" else [text for _, text in written]:
        assert json.loads(text) == {"a": None, "b": 1.5}
    assert capsys.readouterr().out == ""
