"""From images to a lens file and back to straight images: the commands `calibrate` and `undistort`, end to end."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from gpuvision.camera.calibration import Calibration
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.cli.main import application
from gpuvision.formats.camera_file import read_calibrated_camera, read_lens, write_lens
from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.host.outputs import MANIFEST
from gpuvision.schema import DescriptionError
from gpuvision.sensor.sensor import Sensor
from gpuvision.workflows import calibrating
from gpuvision.workflows.calibrating import calibrate, write_calibration
from gpuvision.workflows.undistorting import undistort_files
from target_images import View, dots, photo, view

CAMERA = Camera(
    matrix=((900.0, 0.0, 330.0), (0.0, 900.0, 235.0), (0.0, 0.0, 1.0)),
    distortion=(-0.2, 0.1, 1e-4, 0.0, 0.01, *(0.0,) * 7, 0.05, -0.02),
)
LENS = Lens(k1=2e-7, k2=-3e-14, centre=(310.25, 250.5))


@pytest.fixture(scope="module")
def seen() -> View:
    return view((640, 480), 12, 16, 34.0, turn=3.0, tilt=12.0, barrel=6.0)


@pytest.fixture(scope="module")
def image(seen: View, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write an image of a grid of dots through a lens."""
    return photographed(seen, tmp_path_factory.mktemp("images") / "grid.png")


@pytest.fixture(scope="module")
def done(image: Path) -> Calibration:
    return calibrate([image])


def photographed(seen: View, path: Path) -> Path:
    """Write an image of 12 x 16 dots through the lens of a view."""
    cover = dots(seen, np.ones((12, 16), bool))
    cv2.imwrite(str(path), photo(cover, np.random.default_rng(3)))
    return path


def run(*arguments: object) -> None:
    application()([str(each) for each in arguments], standalone_mode=False)


def test_lens_is_found_within_its_uncertainty(done: Calibration, seen: View) -> None:
    found = done.parameters
    for name, truth in (("k1", seen.lens.k1), ("C_c", seen.lens.centre[0]), ("R_c", seen.lens.centre[1])):
        value, sigma = found[name]
        assert abs(value - truth) < 5.0 * sigma, name
    assert done.fit.model == "k1"
    before, after = done.straightness_px
    assert after < 0.02 < 0.15 < before


@pytest.mark.rendered
def test_report_says_what_the_fit_says(done: Calibration, tmp_path: Path) -> None:
    write_calibration(done, tmp_path / "lens.toml")
    report = json.loads((tmp_path / "lens.json").read_text())
    assert report["parameters"]["k1"]["value"] == done.parameters["k1"][0]
    assert report["rms_px"] == done.fit.rms_px
    assert [each["model"] for each in report["alternatives"]] == [each.model for each in done.alternatives]
    picture = cv2.imread(str(tmp_path / "lens.png"))
    assert picture is not None
    assert min(picture.shape[:2]) > 500
    assert sorted(each.name for each in tmp_path.iterdir()) == [MANIFEST, "lens.json", "lens.png", "lens.toml"]


def test_commands_make_bent_dots_straight(image: Path, tmp_path: Path) -> None:
    run("calibrate", image, "--out", tmp_path / "lens.toml")
    run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", tmp_path / "straight")
    again = calibrate([tmp_path / "straight" / "grid.png"], model="none")
    # Interpolation of pixels moves a dot's centre by less than 0.01 px.
    assert again.straightness_px[0] < 0.03


def test_three_views_calibrate_the_camera(tmp_path: Path) -> None:
    files = []
    for number, (tilt, towards) in enumerate(((30.0, 0.2), (-28.0, 1.4), (25.0, 2.6), (32.0, 4.0))):
        flat = view((640, 480), 12, 16, 26.0, tilt=tilt, towards=towards, focal=1.4)
        files.append(photographed(flat, tmp_path / f"{number}.png"))
    done = calibrate(files, model="none", pitch=0.01)
    assert isinstance(done.model, Camera)
    value, sigma = done.parameters["f"]
    assert abs(value - 1.4 * 640) < max(5.0 * sigma, 1.0)
    assert done.report()["poses"][0]["translation"][2] > 0.0
    write_calibration(done, tmp_path / "out" / "camera.toml")
    known = read_calibrated_camera(tmp_path / "out" / "camera.toml")
    assert known[:3] == (done.model, done.image_size, done.fit.names)
    np.testing.assert_array_equal(known.covariance, done.fit.covariance)


@pytest.mark.parametrize("model", [LENS, CAMERA, Lens(k1=-1e-7), Lens(k1=-1e-7, k2=2e-14, k3=-1e-21, k4=3e-28)])
def test_lens_file_keeps_every_digit(model: Lens | Camera, tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.toml", model, {"image": {"size": [640, 480]}})
    assert read_lens(tmp_path / "lens.toml") == model


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[image]\nsize = [1, 2]\n", r"expected one table, \[lens\] or \[camera\]"),
        ("[lens]\nk1 = 1e-7\n[camera]\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\n", "expected one table"),
        ("[lens]\nk2 = 1e-7\n", "lens.k1' is missing"),
        ("[lens]\nk1 = 1e-7\nk5 = 0.0\n", "unknown key 'lens.k5'"),
        ("[camera]\nmatrix = [[1, 0], [0, 1]]\n", "camera.matrix"),
        ("[camera]\nmatrix = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\nk9 = 1.0\n", "unknown key 'camera.k9'"),
        ("[lens\n", "not valid TOML"),
    ],
)
def test_wrong_lens_file(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "lens.toml").write_text(text)
    with pytest.raises(DescriptionError, match=said):
        read_lens(tmp_path / "lens.toml")


def test_a_truncated_jpeg_is_refused(seen: View, tmp_path: Path) -> None:
    """Decoders fill the missing rows with grey, and the dots at the seam are wrong."""
    whole = photographed(seen, tmp_path / "whole.jpg")
    assert calibrate([whole]).fit.model == "k1"
    for share in (0.5, 0.9, 0.999):
        cut = tmp_path / "cut.jpg"
        cut.write_bytes(whole.read_bytes()[: int(share * whole.stat().st_size)])
        with pytest.raises(RecordingError, match="truncated: there is no end-of-image marker"):
            calibrate([cut])


def test_an_image_given_twice_counts_once(image: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.png"
    copy.write_bytes(image.read_bytes())
    twice = calibrate([image, copy, image])
    assert len(twice.detected_targets) == 1
    assert [path for path, _ in twice.skipped_images] == [copy, image]
    assert all("the same pixels as" in reason for _, reason in twice.skipped_images)
    assert twice.parameters == calibrate([image]).parameters


def test_few_points_do_not_tell_that_a_lens_is_not_needed(tmp_path: Path) -> None:
    """A pattern of 4 x 4 dots in a corner; they are straight, and say nothing about the lens."""
    small = view((640, 480), 4, 4, 12.0, barrel=0.0)
    path = tmp_path / "small.png"
    cv2.imwrite(str(path), photo(dots(small, np.ones((4, 4), bool)), np.random.default_rng(3)))
    with pytest.raises(ValueError, match=r"dots found in 1 images: 16 points over \d+ % of the image, too few"):
        calibrate([path])


def test_coverage_is_part_of_the_report(done: Calibration) -> None:
    ends = [done.detected_targets[0].grid[i, j] for i, j in ((0, 0), (0, -1), (-1, -1), (-1, 0))]
    area = cv2.contourArea(np.array(ends, np.float32)) / (640 * 480)
    assert done.coverage == pytest.approx(area, rel=0.03)
    assert done.report()["coverage"] == done.coverage
    assert f"over {100.0 * done.coverage:.0f} % of the image" in done.summary()


def test_a_lens_of_another_size_is_refused(image: Path, tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.toml", LENS, {"image": {"size": [4000, 3000]}})
    out = tmp_path / "straight"
    with pytest.raises(ValueError, match="640 x 480 pixels, the model was calibrated at 4000 x 3000; give the window"):
        run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", out)
    assert not out.exists() or not list(out.glob("*.png"))
    with pytest.raises(ValueError, match="outside"):
        run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", out, "--window", "3500,0")
    run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", out, "--window", "100,20", "--binning", "2")
    assert (out / "grid.png").exists()


@pytest.mark.parametrize("model", [LENS, CAMERA])
def test_window_and_binning_are_those_of_the_sensor(model: Lens | Camera) -> None:
    """A binned pixel lies in the middle of the pixels that it sums."""
    part = model.in_window((100, 20), 2)
    points = np.array([[0.0, 0.0], [100.0, 50.0], [250.0, 180.0]])
    sensor = 2.0 * points + np.array([100.0, 20.0]) + 0.5
    expected = (model.undistort(sensor) - [100.0, 20.0] - 0.5) / 2.0
    np.testing.assert_allclose(part.undistort(points), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("k1", [2e-7, -2e-7])
def test_frames_show_all_or_only_valid_pixels(k1: float, tmp_path: Path, device: Device) -> None:
    lens = Lens(k1=k1, centre=(310.25, 250.5))
    white = tmp_path / "white.png"
    cv2.imwrite(str(white), np.full((480, 640), 255, np.uint8))
    made = {}
    for frame in ("same", "all", "valid"):
        (path,) = undistort_files([white], lens, tmp_path / frame, device=device, frame=frame)
        made[frame] = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert made["same"].shape == (480, 640)
    assert np.all(made["valid"] == 255)
    # Area of the corrected image, by the determinant of the Jacobian at the centres of squares of 4 x 4 pixels.
    places = np.stack(np.meshgrid(np.arange(1.5, 640.0, 4.0), np.arange(1.5, 480.0, 4.0)), -1)
    area = 16.0 * np.sum(np.linalg.det(lens.jacobian(places)))
    assert np.count_nonzero(made["all"]) == pytest.approx(area, rel=0.005)
    assert made["valid"].size < area < made["all"].size


def test_a_sensor_file_takes_the_lens_table(tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.toml", LENS, {})
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text()
    text = re.sub(r"\[lens\].*?\n\n", "", text, flags=re.DOTALL)
    (tmp_path / "sensor.toml").write_text(text + (tmp_path / "lens.toml").read_text())
    found = Sensor.load(str(tmp_path / "sensor.toml"))
    assert found.readout.triangulation is not None
    assert found.readout.triangulation.lens == LENS


# ---- undistort ------------------------------------------------------------------------------------------------


def test_points_go_through_the_same_lens(device: Device, tmp_path: Path, rng: np.random.Generator) -> None:
    points = rng.uniform(0.0, 480.0, (7, 5, 2))
    points[2, 3] = np.nan
    np.save(tmp_path / "points.npy", points)
    written = undistort_files([tmp_path / "points.npy"], LENS, tmp_path / "out", device=device)
    assert written == (tmp_path / "out" / "points.npy",)
    rounding = 1e-9 if device.has_double else 1e-3
    np.testing.assert_allclose(np.load(written[0]), LENS.undistort(points), rtol=0.0, atol=rounding)
    (binned,) = undistort_files([tmp_path / "points.npy"], LENS, tmp_path / "binned", binning=2, device=device)
    expected = (LENS.undistort(2.0 * points + 0.5) - 0.5) / 2.0
    np.testing.assert_allclose(np.load(binned), expected, rtol=0.0, atol=rounding)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "float32"])
@pytest.mark.parametrize("channels", [1, 3])
def test_images_keep_their_type(device: Device, kind: str, channels: int, tmp_path: Path) -> None:
    row, column = np.mgrid[0:61, 0:83].astype(np.float32)
    image = (0.5 * row + column + 20.0).astype(kind)
    if channels == 3:
        image = np.stack([image, image + 20, image + 40], axis=-1)
    name = "one.tif" if kind == "float32" else "one.png"
    kind_of = {1: "minisblack", 3: "rgb"}
    if kind == "float32":
        tifffile.imwrite(tmp_path / name, image[..., ::-1] if channels == 3 else image, photometric=kind_of[channels])
    else:
        cv2.imwrite(str(tmp_path / name), image)
    (written,) = undistort_files([tmp_path / name], Lens(k1=0.0), tmp_path / "out", device=device)
    again = tifffile.imread(written) if kind == "float32" else cv2.imread(str(written), cv2.IMREAD_UNCHANGED)
    if channels == 3 and kind == "float32":
        again = again[..., ::-1]
    assert again.dtype == kind
    np.testing.assert_array_equal(again, image)


# ---- choice of the method ------------------------------------------------------------------------------


@pytest.fixture
def dispatched(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Return a function that calibrates from detected grids, and returns the calibration; the fits are recorded."""

    def fitted(kind: str) -> Any:
        def fit(*given: Any, **options: Any) -> Any:
            return SimpleNamespace(kind=kind, given=given, options=options, camera="camera", lens="lens")

        return fit

    monkeypatch.setattr(calibrating, "fit_camera", fitted("camera"))
    monkeypatch.setattr(calibrating, "fit_lens", fitted("lens"))
    monkeypatch.setattr(calibrating, "make_view", lambda grid, pitch: (grid, pitch))
    monkeypatch.setattr(calibrating, "straightness_px", lambda families, model=None: (families, model))

    def run(grids: tuple[str | None, ...], **options: Any) -> Any:
        detected = [
            SimpleNamespace(grid=grid, families=(f"rows {number}", f"columns {number}"))
            for number, grid in enumerate(grids)
        ]
        monkeypatch.setattr(calibrating, "detect_targets", lambda *given: (detected, [("e.png", "dark")], (640, 480)))
        return calibrate(["a.png"], **options)

    return run


@pytest.mark.parametrize(
    ("grids", "options", "kind"),
    [
        (("g", "h", "i"), {}, "camera"),
        (("g", "h"), {}, "lens"),
        (("g", "h", None), {}, "lens"),
        (("g",), {"focal_length": 900.0}, "camera"),
        (("g", "h", "i"), {"method": "lines"}, "lens"),
        (("g",), {"method": "views", "pitch": 2e-3}, "camera"),
        ((None, None), {"pattern": "lines"}, "lens"),
    ],
)
def test_views_are_used_where_they_give_a_camera(
    dispatched: Callable[..., Any], grids: tuple[str | None, ...], options: dict[str, Any], kind: str
) -> None:
    done = dispatched(grids, model="k1", loss="huber", **options)
    families = tuple(name for n in range(len(grids)) for name in (f"rows {n}", f"columns {n}"))
    assert done.fit.kind == kind
    if kind == "camera":
        assert done.fit.given == ([(grid, options.get("pitch", 1.0)) for grid in grids], (640, 480))
        assert done.fit.options == {"model": "k1", "focal_length": options.get("focal_length"), "loss": "huber"}
    else:
        assert (done.fit.given, done.fit.options) == ((families,), {"model": "k1", "loss": "huber"})
    assert done.straightness_px == ((families, None), (families, kind))
    assert (done.pattern, done.image_size) == (options.get("pattern", "dots"), (640, 480))
    assert done.skipped_images == (("e.png", "dark"),)
    assert [each.grid for each in done.detected_targets] == list(grids)


def test_options_that_a_method_does_not_take(dispatched: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match=r"pitch has no effect with method 'lines'.*fewer than 3 images of a grid"):
        dispatched(("g", "h"), pitch=1e-3)
    with pytest.raises(ValueError, match="focal_length has no effect with method 'lines'"):
        dispatched(("g", "h", "i"), method="lines", focal_length=900.0)
    with pytest.raises(ValueError, match="method 'views' needs a grid of points, a line pattern has none"):
        dispatched((None,), method="views", pattern="lines")


@pytest.mark.parametrize(("count", "more"), [(1, ""), (2, r" \(and 1 more images\)"), (4, r" \(and 3 more images\)")])
def test_images_without_a_target_are_counted(count: int, more: str, tmp_path: Path) -> None:
    files = [tmp_path / f"{number}.png" for number in range(count)]
    for number, file in enumerate(files):
        cv2.imwrite(str(file), np.full((48, 64), 80 + number, np.uint8))
    steps: list[tuple[int, int | None]] = []
    with pytest.raises(ValueError, match=rf"^{re.escape(str(files[0]))}{more}: no dots found"):
        calibrate(files, progress=lambda done, of: steps.append((done, of)))
    assert steps == [(number, count) for number in range(count + 1)]


# ---- errors ------------------------------------------------------------------------------------------


def test_image_without_a_pattern(image: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "empty.png"), np.full((480, 640), 80, np.uint8))
    with pytest.raises(ValueError, match=r"empty\.png: no dots found; expected"):
        calibrate([tmp_path / "empty.png"])
    done = calibrate([tmp_path / "empty.png", image])
    assert [path.name for path, _ in done.skipped_images] == ["empty.png"]
    assert "1 of 2 images" in done.summary()


def test_a_folder_is_no_image(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="a folder, expected an image; name the images in it"):
        calibrate([tmp_path])


def test_images_of_two_sizes(image: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "small.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(RecordingError, match=r"small\.png: 10 x 10 pixels, .*grid\.png has 640 x 480"):
        calibrate([image, tmp_path / "small.png"])


def test_missing_and_unreadable_files(tmp_path: Path, device: Device) -> None:
    with pytest.raises(FileNotFoundError, match="no such file"):
        calibrate([tmp_path / "none.png"])
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(RecordingError, match=r"text\.png: not a readable image"):
        calibrate([tmp_path / "text.png"])
    with pytest.raises(ValueError, match="no images given"):
        calibrate([])
    for name, message in (("text.png", "not a readable image"), ("none.png", "no such file")):
        with pytest.raises((RecordingError, FileNotFoundError), match=message):
            undistort_files([tmp_path / name], LENS, tmp_path / "out", device=device)
    (tmp_path / "nothing.npy").touch()
    with pytest.raises(RecordingError, match=r"nothing\.npy: not a readable NPY array"):
        undistort_files([tmp_path / "nothing.npy"], LENS, tmp_path / "out", device=device)
    np.save(tmp_path / "three.npy", np.zeros((4, 3)))
    with pytest.raises(RecordingError, match=r"three\.npy: float64 of shape \(4, 3\), expected"):
        undistort_files([tmp_path / "three.npy"], LENS, tmp_path / "out", device=device)
    assert not (tmp_path / "out").exists(), "nothing is written when something is wrong"


def test_inputs_of_one_name(tmp_path: Path, device: Device) -> None:
    with pytest.raises(RecordingError, match="several inputs have the name a"):
        undistort_files([tmp_path / "a.png", tmp_path / "b" / "a.tif"], LENS, tmp_path / "out", device=device)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--pattern", "chessboard", "--inner-corners", "nine"), "--inner-corners is 'nine', expected"),
        (("--out", "lens.json"), "the report and the plot get the suffixes .json and .png"),
        (("--model", "k7"), "k7"),
        (("--method", "views"), "focal"),
    ],
)
def test_wrong_arguments(image: Path, arguments: tuple[str, ...], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        run("calibrate", image, "--out", tmp_path / "lens.toml", *arguments)
    assert list(tmp_path.iterdir()) == []


def test_wrong_region(image: Path, tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.toml", LENS, {})
    with pytest.raises(ValueError, match="--region is '1,2', expected column,row,columns,rows"):
        run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", tmp_path / "o", "--region", "1,2")


# ---- real images ----------------------------------------------------------------------------------------------


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "pattern", "best"),
    [
        pytest.param("dot_pattern_01", "dots", 0.079, marks=pytest.mark.slow),
        ("dot_pattern_02", "dots", 0.691),
        pytest.param("line_pattern_01", "lines", 0.117, marks=pytest.mark.slow),
    ],
)
def test_real_patterns_are_straighter_than_known(name: str, pattern: str, best: float, data: Path) -> None:
    done = calibrate([data / "calibration" / f"{name}.jpg"], pattern=pattern)
    assert done.straightness_px[1] <= best


@pytest.mark.slow
@pytest.mark.realdata
def test_real_chessboards(data: Path) -> None:
    files = sorted((data / "calibration" / "chessboard").glob("left*.jpg"))
    done = calibrate(files, pattern="chessboard", model="k1,k2", pitch=0.025)
    assert len(done.detected_targets) == len(files) == 13
    # OpenCV's corners and calibration with the same model: 0.4183 px.
    assert done.fit.rms_px < 0.4183


# ---- too few data ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", ["none", "points", "coverage"])
def test_few_points_or_a_small_part_of_the_image_do_not_tell(change: str, monkeypatch: pytest.MonkeyPatch) -> None:
    least = calibrating._MIN_POINTS
    targets: list[Any] = [SimpleNamespace(points=least - 7), SimpleNamespace(points=7 - (change == "points"))]
    coverage = calibrating._MIN_COVERAGE - (1e-3 if change == "coverage" else 0.0)
    monkeypatch.setattr(calibrating, "image_coverage", lambda *_: coverage)
    if change == "none":
        calibrating._check_enough_to_judge(targets, (64, 48), "dots")
        return
    count = least - (change == "points")
    message = f"dots found in 2 images: {count} points over {100 * coverage:.0f} % of the image, too few to tell"
    with pytest.raises(ValueError, match=re.escape(message)):
        calibrating._check_enough_to_judge(targets, (64, 48), "dots")


def test_a_target_of_lines_has_no_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    found = SimpleNamespace(points="points")
    monkeypatch.setattr(calibrating, "find_lines", lambda image: ("lines of", image))
    monkeypatch.setattr(calibrating, "find_dots", lambda image: found)
    monkeypatch.setattr(calibrating, "find_chessboard", lambda image, corners: found if corners == (9, 6) else None)
    monkeypatch.setattr(calibrating, "grid_lines", lambda points: ("lines through", points))
    image: Any = "an image"
    expected = {
        "lines": (None, ("lines of", "an image")),
        "dots": ("points", ("lines through", "points")),
        "chessboard": ("points", ("lines through", "points")),
    }
    for pattern, (grid, families) in expected.items():
        target: Any = calibrating._detect(Path("a.png"), image, pattern, (9, 6))  # type: ignore[arg-type]
        assert (target.image, target.grid, target.families) == (Path("a.png"), grid, families)


def test_a_calibration_without_a_model_is_not_written(tmp_path: Path) -> None:
    straight: Any = SimpleNamespace(model=None)
    with pytest.raises(ValueError, match="the lines are straight without a lens; no correction is needed, nothing was"):
        write_calibration(straight, tmp_path / "lens.toml")
    assert list(tmp_path.iterdir()) == []
