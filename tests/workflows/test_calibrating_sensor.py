"""From images of a target and a laser line to a sensor file: the command ``calibrate --sensor``, end to end.

The written file is judged by float64 oracles of OpenCV and NumPy against the rendered sensor.
"""

from __future__ import annotations

import json
import math
import shutil
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from gpuvision.camera.camera import Camera
from gpuvision.cli.main import application
from gpuvision.formats.camera_file import covariance_table, write_lens
from gpuvision.host import Device
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows import calibrating_sensor
from gpuvision.workflows.calibrating_sensor import (
    BlockViews,
    TransportViews,
    _cell,
    _check_transport_targets,
    _Light,
    _lit_targets,
    _motion,
    _sheet_of_points,
    _warnings,
    calibrate_sensor,
)
from gpuvision.workflows.laser_images import pair_images, split_steps
from gpuvision.workflows.scanning import scan
from laser_sensor import PITCH, PROFILES_BETWEEN, LaserSensor, sensor, up, write_images

Float64 = npt.NDArray[np.float64]
BEND = (0.06, -0.02, 0.03)
TRUTH = sensor(25.0, BEND)
VIEWS, MOVED = 7, 3
CAMERA = "[camera]\nmatrix = [[750.0, 0.0, 240.0], [0.0, 750.0, 180.0], [0.0, 0.0, 1.0]]\n"


@pytest.fixture(scope="module")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Render the images of a calibration."""
    folder = tmp_path_factory.mktemp("shots")
    write_images(folder, TRUTH, np.random.default_rng(4), VIEWS, MOVED)
    return folder


@pytest.fixture(scope="module")
def written(images: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Run the command; return the sensor file."""
    out = tmp_path_factory.mktemp("calibrated") / "sensor.toml"
    run(*command(images), "--out", out)
    return out


def command(images: Path) -> list[object]:
    between = ["--transport-views", images / "moved", "--profiles-between", PROFILES_BETWEEN, "--on-stage"]
    return ["calibrate", *sorted(images.glob("*.png")), "--sensor", *between, "--pitch", PITCH]


def run(*arguments: object) -> None:
    application()([str(each) for each in arguments], standalone_mode=False)


def read(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    return tomllib.loads(path.read_text()), json.loads(path.with_suffix(".json").read_text())


def scene_points(table: dict[str, Any], pixels: Float64, profile: float) -> Float64:
    """Return points (n, 3) of the scene by the keys of a sensor file: OpenCV's rays, and bisection along each ray."""
    camera, sheet, transport = table["camera"], table["triangulation"], table["transport"]
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tauX", "tauY")
    distortion = np.array([camera.get(name, 0.0) for name in names])
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-13)
    flat = np.ascontiguousarray(pixels.reshape(-1, 1, 2))
    eye = np.eye(3)
    ideal = cv2.undistortPoints(flat, np.array(camera["matrix"]), distortion, None, eye, eye, criteria)
    ray = np.concatenate([ideal.reshape(-1, 2), np.ones((len(flat), 1))], axis=1)
    axes = np.array([sheet["g_axis"], sheet["h_axis"], np.cross(sheet["g_axis"], sheet["h_axis"])])
    gg, gh, hh = sheet.get("bend", (0.0, 0.0, 0.0))

    def side(depth: Float64) -> tuple[Float64, Float64]:
        g, h, d = ((ray * depth[:, None] - sheet["sheet_origin"]) @ axes.T).T
        return np.stack([g, h, d], axis=1), d - (gg * g * g + gh * g * h + hh * h * h)

    near, far = np.full(len(ray), 0.15), np.full(len(ray), 0.4)
    sign = np.sign(side(near)[1])
    for _ in range(60):
        middle = 0.5 * (near + far)
        before = np.sign(side(middle)[1]) == sign
        near, far = np.where(before, middle, near), np.where(before, far, middle)
    g, h, d = side(near)[0].T
    g_axis, h_axis = np.array(transport["g_axis"]), np.array(transport["h_axis"])
    moved = profile * transport["step"] * np.array(transport["direction"]) + transport["origin"]
    return np.outer(g, g_axis) + np.outer(h, h_axis) + np.outer(d, np.cross(g_axis, h_axis)) + moved


def readings(truth: LaserSensor, height: float, profile: float) -> Float64:
    """Return the light on a plane parallel to the stage, for a part that has moved by `profile` steps."""
    rows = truth.line(up(truth), truth.origin + height * up(truth) + profile * truth.step)
    columns = np.arange(60.0, 420.0, 4.0)
    return np.stack([columns, rows[columns.astype(int)]], axis=1)


@pytest.mark.parametrize(
    ("along", "step", "cell"), [("columns", 1e-5, 41e-6), ("rows", -2e-5, 21e-6), ("rows", -5.55e-5, 56e-6)]
)
def test_cell_is_the_larger_of_step_and_samples(along: Any, step: float, cell: float) -> None:
    """A pixel is 40.2 um wide and 20.1 um high; the median of the readings is taken over all lines."""
    asked: list[Float64] = []

    def points(pixels: Float64) -> Float64:
        asked.append(pixels)
        return np.array([40.2e-6 * pixels[0], 20.1e-6 * pixels[1], 7.0])

    lines: Any = [SimpleNamespace(points=np.array(each)) for each in ([[0.0, 9.0], [4.0, 1.0]], [[5.0, 2.0]])]
    geometry: Any = SimpleNamespace(points=points, step=step)
    assert _cell(geometry, lines, along) == pytest.approx(cell, rel=1e-12)
    assert [4.0, 2.0] in [each.tolist() for each in asked]


def test_only_targets_with_a_laser_image_are_lit() -> None:
    detected: Any = [SimpleNamespace(image=name) for name in "abc"]
    lasers: Any = {"a": "a_laser", "b": None, "c": "c_laser"}
    found = _lit_targets(detected, lasers, at_least=2)
    assert [(each.image, laser) for each, laser in found] == [("a", "a_laser"), ("c", "c_laser")]
    with pytest.raises(ValueError, match="2 target images with a laser image show the target, expected two at least"):
        _lit_targets(detected, lasers, at_least=3)
    assert _lit_targets(detected, {}, at_least=0) == []


def test_readings_of_targets_blocks_and_points_are_in_order() -> None:
    lines: Any = {"one": "line one", "two": "line two"}
    blocks: Any = (("block one", np.zeros(3)), ("block two", np.zeros(3)))
    points: Any = "points"
    light = _Light("rows", lines, blocks, points)
    assert light.others == ("block one", "block two", "points")
    assert light.readings == ("line one", "line two", "block one", "block two", "points")
    assert _Light("rows", lines, blocks).others == ("block one", "block two")


def test_transport_views_show_the_whole_target() -> None:
    names = [Path(name) for name in ("m1.png", "m2.png", "m3.png")]

    def target(name: Path, rows: int, columns: int, missing: int = 0) -> Any:
        grid = np.ones((rows, columns, 2))
        grid.reshape(-1, 2)[:missing] = np.nan
        return SimpleNamespace(image=name, grid=grid)

    good = [target(name, 4, 6) for name in names]
    _check_transport_targets(good, [], names)
    _check_transport_targets([*good, target(Path("pose.png"), 3, 5)], [(Path("other.png"), "dark")], names)
    with pytest.raises(ValueError, match=r"^m2\.png: the transport needs the target in every view .*; no dots"):
        _check_transport_targets([good[0], good[2]], [(names[1], "no dots")], names)
    with pytest.raises(ValueError, match=r"^m3\.png: 18 points in a grid of 6 x 3, m1\.png shows 6 x 4; the transport"):
        _check_transport_targets([*good[:2], target(names[2], 3, 6)], [], names)
    with pytest.raises(ValueError, match=r"^m2\.png: 22 points in a grid of 6 x 4, m1\.png shows 6 x 4"):
        _check_transport_targets([good[0], target(names[1], 4, 6, missing=2), good[2]], [], names)


@pytest.mark.parametrize(("ratio", "factor"), [(9.0, None), (9.01, "3.0"), (25.0, "5.0")])
def test_views_that_scatter_are_named(ratio: float, factor: str | None) -> None:
    lines: Any = [SimpleNamespace(image=Path("a.png"), note="dim"), SimpleNamespace(image=Path("b.png"), note="")]
    few, many = np.zeros(20), np.zeros(20)
    few[:10], many[:11] = np.nan, np.nan
    for sheet_ratio, transport_ratio, words in (
        (ratio, 1.0, "the laser lines scatter {} times as much from view to view as readings and poses predict"),
        (1.0, ratio, "the transport views scatter {} times as much about a straight uniform motion"),
    ):
        sheet = SimpleNamespace(residuals=(few, many), view_ratio=sheet_ratio, converged=True)
        geometry: Any = SimpleNamespace(sheet=sheet, transport=SimpleNamespace(view_ratio=transport_ratio))
        found = _warnings(geometry, lines)
        assert found[:2] == [
            "a.png: dim",
            "b.png: the sheet rejects 11 of 20 readings; check that the target did not move between its two images",
        ]
        assert [each.startswith(words.format(factor)) for each in found[2:]] == ([] if factor is None else [True])
    geometry.sheet.converged = False
    assert any(
        each.startswith("the fit of the sheet stopped before it converged") for each in _warnings(geometry, lines)
    )
    geometry.transport = None
    assert _warnings(geometry, lines)[-1].startswith("no transport views: the part is assumed to move along -(g x h)")


def test_points_of_a_fixture_give_the_direction_of_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels, places = np.array([[10.0, 5.0], [30.0, 7.0], [50.0, 6.0]]), np.ones((3, 3))
    calls: list[Any] = []
    monkeypatch.setattr(calibrating_sensor, "read_known_points", lambda file: (pixels, places))
    monkeypatch.setattr(
        calibrating_sensor, "sheet_from_points", lambda *given, **how: calls.append((given, how)) or "fit"
    )
    found: Any = SimpleNamespace(camera="camera", names=("f",))
    for given, along in ((None, "columns"), ("rows", "rows")):
        asked: Any = given
        light, sheet = _sheet_of_points(Path("points.csv"), found, asked)
        assert (light.along, light.lines, light.blocks, sheet) == (along, {}, (), "fit")
        assert light.points is not None
        assert (light.points.image, light.points.note) == (Path("points.csv"), "")
        assert math.isnan(light.points.threshold)
        np.testing.assert_array_equal(light.points.points, pixels)
        (camera, by_places, by_pixels), how = calls[-1]
        assert (camera, by_places is places, by_pixels is pixels) == ("camera", True, True)
        assert how == {"along": along, "names": ("f",)}
    pixels[:] = pixels[:, ::-1].copy()
    assert _sheet_of_points(Path("points.csv"), found, None)[0].along == "rows"


def test_transport_is_fitted_about_the_middle_of_the_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four profiles lie between two views; the first view shows 2 x 3 points at a pitch of 5 mm."""
    monkeypatch.setattr(calibrating_sensor, "fit_transport", lambda *given: given)
    names = [Path(name) for name in ("m1.png", "m2.png", "m3.png")]
    views: Any = SimpleNamespace(
        detected=[SimpleNamespace(image=name, grid=np.ones((2, 3, 2)) * n) for n, name in enumerate(names)], pitch=5e-3
    )
    found: Any = SimpleNamespace(targets={name: f"pose of {name}" for name in names})
    transport = TransportViews(folder=Path("moved"), profiles_between=4.0)
    fit: Any = _motion(transport, views, found, names)
    targets, profiles, middle = fit
    assert targets == [f"pose of {name}" for name in names]
    np.testing.assert_array_equal(profiles, [0.0, 4.0, 8.0])
    np.testing.assert_allclose(middle, [5e-3, 2.5e-3, 0.0][: len(middle)])


def test_parameters_are_within_their_sigma(written: Path) -> None:
    table, report = read(written)
    sigma = dict(zip(report["covariance"]["names"], np.sqrt(np.diag(report["covariance"]["matrix"])), strict=True))
    camera = {"f": table["camera"]["matrix"][0][0], "cx": table["camera"]["matrix"][0][2], **table["camera"]}
    truth = {"f": TRUTH.matrix[0, 0], "cx": TRUTH.matrix[0, 2], "k1": TRUTH.distortion[0], "tauX": TRUTH.distortion[12]}
    for name, value in truth.items():
        assert abs(camera[name] - value) < 4.0 * sigma[name], name
    # A rotation of the axes in the sheet keeps gg + hh.
    bend = table["triangulation"]["bend"]
    assert abs(bend[0] + bend[2] - BEND[0] - BEND[2]) < 4.0 * np.hypot(sigma["gg"], sigma["hh"])
    step = float(np.linalg.norm(TRUTH.step))
    assert abs(table["transport"]["step"] - step) < 4.0 * report["transport"]["step_sigma_m"] < 1e-7
    assert report["sheet"]["bend_test"]["significant"]


def test_step_block_is_measured_to_a_fiftieth_of_a_pixel(written: Path) -> None:
    """Steps of 6 mm on the stage: heights over the stage, and their differences."""
    table, _ = read(written)
    rng = np.random.default_rng(8)
    middle = readings(TRUTH, 0.0, 0.0)[40:41]
    pixel = np.linalg.norm(scene_points(table, middle + np.array([0.0, 1.0]), 0.0) - scene_points(table, middle, 0.0))
    heights = []
    for height in (-0.012, -0.006, 0.0, 0.006, 0.012, 0.018):
        points = np.concatenate([readings(TRUTH, height, each) for each in np.arange(-4.0, 5.0)])
        noisy = points + rng.normal(0.0, 0.05, points.shape) * [0.0, 1.0]
        heights.append(float(np.mean(scene_points(table, noisy, 0.0)[:, 2])))
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * pixel
    assert np.abs(np.array(heights) - np.arange(-0.012, 0.019, 0.006)).max() < 0.1 * pixel


def test_parts_keep_their_shape(written: Path) -> None:
    """Points of a part pass through the sheet one after the other: the scene shows the part, and no mirror image."""
    table, _ = read(written)
    axes = np.stack([TRUTH.g, TRUTH.h, TRUTH.normal])
    part = np.array([[0.0, 0.0, 0.0], [0.02, 0.001, 0.003], [-0.01, 0.004, -0.03], [0.005, 0.015, 0.02]]) @ axes
    found = []
    for place in TRUTH.origin + part:
        profile = 0.0
        for _ in range(30):  # the profile at which the point has moved into the bent sheet
            g, h, d = axes @ (place + profile * TRUTH.step - TRUTH.origin)
            distance = d - (BEND[0] * g * g + BEND[1] * g * h + BEND[2] * h * h)
            profile -= distance / (TRUTH.normal @ TRUTH.step)
        pixel = TRUTH.project((place + profile * TRUTH.step)[None])
        found.append(scene_points(table, pixel, profile)[0])
    for first in range(3):
        for second in range(first + 1, 4):
            apart = np.linalg.norm(part[second] - part[first])
            assert np.linalg.norm(found[second] - found[first]) == pytest.approx(apart, abs=2e-5)
    volumes = [np.linalg.det(np.array(each)[1:] - np.array(each)[0]) for each in (found, part)]
    assert volumes[0] == pytest.approx(volumes[1], rel=2e-3)
    assert abs(volumes[1]) > 1e-6


def test_report_and_picture_belong_to_the_file(written: Path) -> None:
    table, report = read(written)
    assert table["transport"]["step"] == report["step_m"]
    assert table["output"]["cell"] == report["cell_m"]
    assert table["triangulation"]["sheet_origin"] == report["sheet"]["origin"]
    assert len(report["laser_images"]) == VIEWS
    assert sum(each["readings"] for each in report["laser_images"]) == report["sheet"]["readings"] > 1000
    assert len(report["camera"]["images"]) == VIEWS + MOVED
    assert len(report["covariance"]["names"]) == len(report["covariance"]["matrix"]) == 7 + 6 + 3
    assert report["warnings"] == []
    assert table["line"]["along"] == "columns"
    picture = cv2.imread(str(written.with_suffix(".png")))
    assert picture is not None
    # Cyan of the grid, red of the laser line.
    blue, _, red = np.moveaxis(picture[: len(picture) // 2, : picture.shape[1] // 2].astype(int), -1, 0)
    assert np.count_nonzero((blue > 150) & (red < 100)) > 500
    assert np.count_nonzero((red > 180) & (blue < 90)) > 200


def test_inputs_are_not_replaced(images: Path) -> None:
    with pytest.raises(FileExistsError, match=r"pose0\.png"):
        run(*command(images), "--out", images / "pose0.toml", "--overwrite")
    with pytest.raises(FileExistsError, match=r"1\.png"):
        run(*command(images), "--out", images / "moved" / "1.toml", "--overwrite")


@pytest.mark.parametrize("option", ["laser", "transport-views", "block"])
def test_an_output_among_the_images_is_refused(tmp_path: Path, option: str) -> None:
    """The next run would take the picture ``sensor.png`` for an image of the folder."""
    folder = tmp_path / "shots"
    folder.mkdir()
    given: dict[str, object] = {"--transport-views": tmp_path, "--profiles-between": 40}
    if option == "block":
        given["--block-heights"] = "0,1mm"
    given[f"--{option}"] = folder
    options = [each for pair in given.items() for each in pair]
    with pytest.raises(ValueError, match=f"--out is .*, in the folder of --{option}"):
        run("calibrate", "a.png", "--sensor", "--pitch", PITCH, *options, "--out", folder / "sensor.toml")


@pytest.mark.parametrize(
    ("between", "heights", "said"),
    [
        (40.0, (0.0,), "the block has 1 height"),
        (0.0, (0.0, 1e-3), "profiles_between is 0"),
        (math.nan, (0.0, 1e-3), "profiles_between must be finite"),
    ],
)
def test_settings_are_checked_before_the_images_are_read(
    tmp_path: Path, between: float, heights: tuple[float, ...], said: str
) -> None:
    moved = TransportViews(folder=tmp_path / "none", profiles_between=between)
    block = BlockViews(folder=tmp_path / "none", heights=heights)
    with pytest.raises(ValueError, match=said):
        calibrate_sensor([tmp_path / "none.png"], pitch=PITCH, transport=moved, block=block)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"pattern": "lines", "step": 1e-3}, "pattern 'lines' gives no poses of the target; use 'dots' or"),
        ({}, "give either transport views, which measure the step, or the step"),
        ({"transport": True, "step": 1e-3}, "give either transport views, which measure the step, or the step"),
        ({"step": 0.0}, "step is 0.0, expected metres per profile, not 0"),
        ({"step": math.inf}, "step is inf, expected metres per profile, not 0"),
        ({"step": 1e-3, "block": (0.0, 1e-3)}, "a block needs transport views"),
        ({"step": 1e-3, "camera": "c.toml", "model": "k1"}, "a camera file replaces the calibration of the camera"),
        ({"step": 1e-3, "camera": "c.toml", "focal_length": 900.0}, "a camera file replaces the calibration"),
        ({"step": 1e-3, "camera": "c.toml", "loss": "tukey"}, "a camera file replaces the calibration"),
        ({"transport": True, "points": "p.csv", "block": (0.0, 1e-3)}, "known points replace laser images and the"),
        ({"step": 1e-3, "points": "p.csv", "laser": True}, "known points replace laser images and the block"),
    ],
)
def test_settings_that_miss_each_other_are_refused(settings: dict[str, Any], said: str, tmp_path: Path) -> None:
    for folder in ("targets", "laser"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "a1.png").write_bytes(b"")
    given = dict(settings)
    if given.pop("transport", False):
        given["transport"] = TransportViews(folder=tmp_path, profiles_between=1.0)
    if "block" in given:
        given["block"] = BlockViews(folder=tmp_path, heights=given["block"])
    if given.pop("laser", False):
        given["laser"] = tmp_path / "laser"
    with pytest.raises(ValueError, match=said):
        calibrate_sensor([tmp_path / "targets" / "a1.png"], pitch=PITCH, **given)


def test_readings_on_a_block_have_the_heights_of_their_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """A target without a laser image shows no line."""
    images: Any = SimpleNamespace(targets=[Path("a"), Path("b"), Path("c")], lasers=[Path("A"), None, Path("C")])
    monkeypatch.setattr(calibrating_sensor, "image_light", lambda *given: given)

    def read_block(light: Any, laser: Path, steps: int, *, along: str, device: Any) -> Any:
        assert light == (Path(laser.name.lower()), laser, "red")
        assert (steps, along, device) == (3, "rows", "a device")
        return f"line of {laser}", np.array([2, 0, 1])

    monkeypatch.setattr(calibrating_sensor, "read_block", read_block)
    block = BlockViews(folder=Path("x"), heights=(1e-3, 0.0, 5e-3))
    device: Any = "a device"
    found = calibrating_sensor._other_lines(images, block, "rows", "red", device)
    assert [line for line, _ in found] == ["line of A", "line of C"]
    for _, heights in found:
        np.testing.assert_array_equal(heights, [5e-3, 1e-3, 0.0])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--sensor",), "--sensor needs --pitch"),
        (("--sensor", "--pitch", 0.01), "--sensor needs either --transport-views"),
        (("--sensor", "--pitch", 0.01, "--transport-views", "x"), "need each other"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--on-stage"), "--on-stage has no effect"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--block", "x"), "--block and --block-heights need each other"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--block", "x", "--block-heights", "0,1mm"), "--block needs"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--channel", "pink"), "--channel is 'pink'"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--camera", "x", "--model", "k1"), "--model has no effect with"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--camera", "x", "--focal-length", 9), "--focal-length has no"),
        (("--camera", "x"), "--camera has no effect without --sensor"),
        (("--sensor", "--pitch", 0.01, "--step", 1e-3, "--method", "lines"), "--sensor needs poses|--pitch has no"),
        (("--step", 1e-3), "--step has no effect without --sensor"),
        (("--laser", "x"), "--laser has no effect without --sensor"),
    ],
)
def test_options_that_miss_each_other_are_refused(options: tuple[object, ...], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        run("calibrate", tmp_path / "a.png", *options, "--out", tmp_path / "sensor.toml")


def test_pairs_are_found_by_name_and_number(tmp_path: Path) -> None:
    targets = [tmp_path / f"target_{number}.png" for number in (2, 10)]
    lasers = tmp_path / "laser"
    lasers.mkdir()
    for name in ("laser010.png", "target_2.png"):
        (lasers / name).touch()
    assert pair_images(targets, lasers).lasers == (lasers / "target_2.png", lasers / "laser010.png")
    beside = [*targets, tmp_path / "target_2_laser.png"]
    assert pair_images(beside, None).lasers == (tmp_path / "target_2_laser.png", None)
    with pytest.raises(ValueError, match="no laser images"):
        pair_images(targets, None)
    with pytest.raises(ValueError, match=r"other_laser\.png is the laser image of 0 target images"):
        pair_images([*targets, tmp_path / "other_laser.png"], None)
    (lasers / "010_laser.png").touch()
    with pytest.raises(ValueError, match="has two laser images"):
        pair_images(targets, lasers)
    for each in targets:
        each.touch()
    with pytest.raises(ValueError, match=r"target_2\.png is a target image and a laser image"):
        pair_images(targets, tmp_path)


def test_steps_of_a_block_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    sample = np.delete(np.arange(300.0), [40, 41, 180])
    position = 50.0 + 0.2 * sample + 12.0 * (sample >= 100.0) - 20.0 * (sample >= 210.0) + rng.normal(0.0, 0.1, 297)
    position[97:100] = 75.0  # reflections at an edge
    inside, step = split_steps(np.stack([sample, position], axis=1), 3)
    kept = sample[inside]
    np.testing.assert_array_equal(step, (kept >= 100.0).astype(int) + (kept >= 210.0))
    assert np.min(np.abs(kept - 100.0)) >= 3.0
    assert len(kept) > 265
    with pytest.raises(ValueError, match="has 2 steps up or down, expected 3"):
        split_steps(np.stack([sample, position], axis=1), 4)
    with pytest.raises(ValueError, match="30 readings of the laser line, too few for 3 steps"):
        split_steps(np.stack([sample, position], axis=1)[:30], 3)


def test_cut_off_transport_view_is_refused(images: Path, tmp_path: Path) -> None:
    """A target that leaves the image would get other point numbers, and the stage a wrong step."""
    moved = tmp_path / "moved"
    shutil.copytree(images / "moved", moved)
    view = cv2.imread(str(moved / "1.png"), cv2.IMREAD_GRAYSCALE)
    assert view is not None
    view[:, :150] = 160
    cv2.imwrite(str(moved / "1.png"), view)
    pair = [images / "pose0.png", images / "pose0_laser.png"]
    with pytest.raises(ValueError, match=r"1\.png: .* needs the whole target in every view"):
        calibrate_sensor(pair, pitch=PITCH, transport=TransportViews(folder=moved, profiles_between=1.0))


def written_camera(file: Path, f: float, names: tuple[str, ...] = ("f", "cx")) -> Path:
    """Write the camera of the truth with another focal length, and a covariance of f and cx."""
    matrix = TRUTH.matrix.copy()
    matrix[[0, 1], [0, 1]] = f
    camera = Camera(matrix=tuple(map(tuple, matrix.tolist())), distortion=tuple(TRUTH.distortion.tolist()))
    tables: dict[str, Any] = {"image": {"size": [480, 360]}}
    if names:
        tables["covariance"] = covariance_table(names, [[0.25, 0.03], [0.03, 0.16]])
    write_lens(file, camera, tables)
    return file


def test_camera_file_replaces_the_calibration_of_the_camera(images: Path, tmp_path: Path) -> None:
    """Two lit poses suffice; the joint covariance has the derivatives that a file with another f shows."""
    shots = [images / f"pose{number}{end}.png" for number in (0, 2, 4) for end in ("", "_laser")]
    moved = TransportViews(folder=images / "moved", profiles_between=PROFILES_BETWEEN)
    low, high = (
        calibrate_sensor(shots, pitch=PITCH, transport=moved, camera=written_camera(tmp_path / f"{f}.toml", f)).geometry
        for f in (749.9, 750.1)
    )
    assert low.camera.matrix[0][0] == 749.9
    assert low.names[:3] == ("f", "cx", "offset")
    np.testing.assert_allclose(low.covariance[:2, :2], [[0.25, 0.03], [0.03, 0.16]])
    by_f = (low.covariance[:, :2] @ np.linalg.inv(low.covariance[:2, :2]))[:, 0]
    axes = np.stack([low.sheet.g_axis, low.sheet.h_axis, low.sheet.normal])
    shift = axes[2] @ (high.sheet.origin - low.sheet.origin)
    assert shift == pytest.approx(0.2 * by_f[low.names.index("offset")], rel=0.02)
    assert low.transport is not None
    assert high.transport is not None
    change = axes @ (high.transport.step - low.transport.step)
    rows = [low.names.index(name) for name in ("step_g", "step_h", "step_d")]
    np.testing.assert_allclose(change, 0.2 * by_f[rows], rtol=0.02, atol=1e-10)


@pytest.mark.slow
def test_camera_file_without_covariance_counts_as_exact(images: Path, tmp_path: Path) -> None:
    shots = [images / f"pose{number}{end}.png" for number in (0, 2, 4) for end in ("", "_laser")]
    camera = written_camera(tmp_path / "camera.toml", 750.0, ())
    moved = ["--transport-views", images / "moved", "--profiles-between", PROFILES_BETWEEN, "--on-stage"]
    out = tmp_path / "out" / "sensor.toml"
    run("calibrate", *shots, "--sensor", "--camera", camera, "--pitch", PITCH, *moved, "--out", out)
    table, report = read(out)
    assert report["camera"]["file"] == "camera.toml"
    assert report["covariance"]["names"][0] == "offset"
    assert report["warnings"] == report["camera"]["warnings"]
    assert "camera.toml has no table [covariance]" in report["warnings"][0]
    heights = [
        float(np.mean(scene_points(table, readings(TRUTH, height, 0.0), 0.0)[:, 2])) for height in (0.0, 0.006, 0.012)
    ]
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * 0.73e-3
    with pytest.raises(FileExistsError, match=r"camera\.toml"):
        run("calibrate", *shots, "--sensor", "--camera", camera, "--pitch", PITCH, *moved, "--out", camera)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[lens]\nk1 = 1e-7\n", r"\[lens\] is the distortion alone"),
        ("[image]\nsize = [640, 480]\n" + CAMERA, "480 x 360 pixels, the model was calibrated at 640 x 480"),
        (CAMERA + '[covariance]\nnames = "f,f"\nmatrix = [[1.0, 0.0], [0.0, 1.0]]\n', "names is 'f,f'"),
        (CAMERA + '[covariance]\nnames = "f,z"\nmatrix = [[1.0, 0.0], [0.0, 1.0]]\n', "names is 'f,z'"),
        (CAMERA + '[covariance]\nnames = "f,cx"\nmatrix = [[1.0, 0.0]]\n', "matrix has 1 rows for 2 names"),
        (CAMERA + '[covariance]\nnames = "f,cx"\nmatrix = [[1.0, 2.0], [2.0, 1.0]]\n', "matrix is no covariance"),
        (CAMERA + '[covariance]\nnames = "f,cx"\nmatrix = [[1.0, 0.5], [0.0, 1.0]]\n', "matrix is no covariance"),
        (CAMERA + '[covariance]\nnames = "f,cx"\nmatrix = [[0.0, 1e20], [1e20, 0.0]]\n', "matrix is no covariance"),
        (CAMERA + '[covariance]\nnames = "f,cx"\nmatrix = [[1e-310, 1e20], [1e20, 1.0]]\n', "matrix is no covariance"),
    ],
)
def test_camera_file_that_does_not_fit_is_refused(images: Path, tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "camera.toml").write_text(text)
    pair = [images / "pose0.png", images / "pose0_laser.png"]
    with pytest.raises(ValueError, match=said):
        calibrate_sensor(pair, pitch=PITCH, camera=tmp_path / "camera.toml", step=1e-3)


@pytest.mark.slow
def test_chessboard_calibrates_the_sensor(tmp_path: Path) -> None:
    """The laser line crosses black and white squares; steps of 6 mm are measured as from a target of dots."""
    write_images(tmp_path, TRUTH, np.random.default_rng(4), VIEWS, MOVED, "chessboard")
    out = tmp_path / "out" / "sensor.toml"
    run(*command(tmp_path), "--pattern", "chessboard", "--inner-corners", "9x6", "--out", out)
    table, report = read(out)
    assert len(report["camera"]["images"]) == VIEWS + MOVED
    assert report["sheet"]["readings"] > 1000
    heights = [
        float(np.mean(scene_points(table, readings(TRUTH, height, 0.0), 0.0)[:, 2]))
        for height in (-0.006, 0.0, 0.006, 0.012)
    ]
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * 0.73e-3
    step = float(np.linalg.norm(TRUTH.step))
    assert abs(table["transport"]["step"] - step) < 4.0 * report["transport"]["step_sigma_m"] < 4e-7


@pytest.mark.slow
def test_given_step_takes_the_transport_along_the_normal(images: Path) -> None:
    shots = sorted(images.glob("*.png"))
    done = calibrate_sensor(shots, pitch=PITCH, step=1e-3)
    np.testing.assert_allclose(done.geometry.direction, done.geometry.sheet.normal)
    assert done.geometry.step == 1e-3
    assert done.cell == 1e-3
    assert any("no transport views" in each for each in done.warnings)
    assert done.report()["transport"] is None


@pytest.mark.slow
def test_scan_measures_a_step_block(written: Path, device: Device) -> None:
    """Frames of a block with steps of 6 mm, 120 columns wide, on the moving stage; the scan reads the written file."""
    rng = np.random.default_rng(3)
    row = np.arange(360.0)[:, None]
    frames = np.full((24, 360, 480), 8.0) + rng.normal(0.0, 1.5, (24, 360, 480))
    for profile in range(24):
        for number, height in enumerate((-0.006, 0.0, 0.006)):
            rows = TRUTH.line(up(TRUTH), TRUTH.origin + height * up(TRUTH) + profile * TRUTH.step)
            step = slice(60 + 120 * number, 180 + 120 * number)
            frames[profile, :, step] += 150.0 * np.exp(-0.5 * ((row - rows[step]) / 1.4) ** 2)
    sensor_read = Sensor.load(written)
    done = scan(np.clip(np.rint(frames), 0.0, 255.0).astype(np.uint8), sensor_read, device=device)
    heights = [float(np.nanmean(done.points.z[:, start : start + 90])) for start in (75, 195, 315)]
    pixel = 0.73e-3
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * pixel
    assert np.abs(np.subtract(heights, (-0.006, 0.0, 0.006))).max() < 0.02 * pixel


@pytest.mark.slow
def test_stepped_block_gives_the_sheet_without_laser_images(images: Path, tmp_path: Path) -> None:
    """A flat sheet and a block with steps of 8 mm on the stage; the target is never lit by the laser."""
    truth, rng = sensor(25.0), np.random.default_rng(9)
    (tmp_path / "block").mkdir()
    write_images(tmp_path, truth, rng, VIEWS, MOVED)
    row = np.arange(360.0)[:, None]
    dark = np.full((360, 480), 60.0)
    lit = dark.copy()
    for number, height in enumerate((0.0, 0.008, 0.016)):
        rows = truth.line(up(truth), truth.origin + height * up(truth))
        step = slice(60 + 120 * number, 180 + 120 * number)
        lit[:, step] += 120.0 * np.exp(-0.5 * ((row - rows[step]) / 1.4) ** 2)
    for name, image in (("a.png", dark), ("a_laser.png", lit)):
        noisy = np.clip(np.rint(image + rng.normal(0.0, 1.5, image.shape)), 0.0, 255.0)
        cv2.imwrite(str(tmp_path / "block" / name), noisy.astype(np.uint8))
    targets = [each for each in sorted(tmp_path.glob("*.png")) if not each.stem.endswith("_laser")]
    block = ["--block", tmp_path / "block", "--block-heights", "0,8mm,16mm"]
    moved = ["--transport-views", tmp_path / "moved", "--profiles-between", PROFILES_BETWEEN, "--on-stage"]
    run("calibrate", *targets, "--sensor", "--pitch", PITCH, *moved, *block, "--out", tmp_path / "out" / "sensor.toml")
    table, report = read(tmp_path / "out" / "sensor.toml")
    assert [each["name"] for each in report["laser_images"]] == ["a_laser.png"]
    heights = [
        float(np.mean(scene_points(table, readings(truth, height, 0.0), 0.0)[:, 2])) for height in (0.0, 0.006, 0.012)
    ]
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * 0.73e-3


@pytest.mark.slow
def test_known_points_give_the_sheet(images: Path, tmp_path: Path) -> None:
    """Corners of a fixture in the light, in its own frame; no image shows the laser."""
    truth = sensor(25.0)
    write_images(tmp_path, truth, np.random.default_rng(9), VIEWS, MOVED)
    flat = np.stack(np.meshgrid(np.linspace(-0.04, 0.04, 4), np.linspace(-0.02, 0.02, 3)), axis=-1).reshape(-1, 2)
    noise = np.random.default_rng(3).normal(0.0, 0.02, flat.shape)
    rows = np.column_stack([truth.project(truth.surface(flat)) + noise, flat, np.zeros(len(flat))])
    np.savetxt(tmp_path / "points.csv", rows, delimiter=",", header="column,row,x,y,z", comments="")
    targets = [each for each in sorted(tmp_path.glob("*.png")) if not each.stem.endswith("_laser")]
    moved = ["--transport-views", tmp_path / "moved", "--profiles-between", PROFILES_BETWEEN, "--on-stage"]
    options = ["--sensor", "--pitch", PITCH, *moved, "--points", tmp_path / "points.csv"]
    run("calibrate", *targets, *options, "--out", tmp_path / "out" / "sensor.toml")
    table, _ = read(tmp_path / "out" / "sensor.toml")
    heights = [
        float(np.mean(scene_points(table, readings(truth, height, 0.0), 0.0)[:, 2])) for height in (0.0, 0.006, 0.012)
    ]
    assert np.abs(np.diff(heights) - 0.006).max() < 0.02 * 0.73e-3
    with pytest.raises(ValueError, match="known points replace laser images"):
        run("calibrate", *tmp_path.glob("*.png"), *options, "--out", tmp_path / "other" / "sensor.toml")


def test_unused_short_line_is_named() -> None:
    """A line of few readings is not used; the few known points of a fixture are."""
    transport = SimpleNamespace(view_ratio=1.0)
    lines = [SimpleNamespace(image=Path("pose1_laser.png"), note="")]
    for residual, count in ((np.full(10, np.nan), 1), (np.zeros(10), 0)):
        sheet = SimpleNamespace(residuals=(residual,), view_ratio=1.0, converged=True)
        found = _warnings(SimpleNamespace(sheet=sheet, transport=transport), lines)
        assert found == ["pose1_laser.png: the line has 10 readings, the sheet uses lines of 16 or more"][:count]
