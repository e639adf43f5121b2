"""No command overwrites its inputs or files that it did not write."""

from __future__ import annotations

import os
from collections.abc import Callable
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.main import get_command

from gpuvision.camera.calibration import Calibration
from gpuvision.camera.lens import Lens
from gpuvision.cli.main import application
from gpuvision.formats.camera_file import read_lens, write_lens
from gpuvision.host.outputs import MANIFEST
from gpuvision.workflows import calibrating
from gpuvision.workflows.calibrating import calibrate, write_calibration
from target_images import dots, photo, view

LENS = Lens(k1=2e-7, k2=-3e-14, centre=(310.25, 250.5))
FOREIGN = "a user's"


def run(*arguments: object) -> None:
    application()([str(each) for each in arguments], standalone_mode=False)


def contents(folder: Path) -> dict[Path, bytes]:
    return {each: each.read_bytes() for each in folder.rglob("*") if each.is_file() and each.name != MANIFEST}


@pytest.fixture(scope="module")
def picture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grid of dots through a lens."""
    seen = view((640, 480), 12, 16, 34.0, turn=3.0, tilt=12.0, barrel=6.0)
    path = tmp_path_factory.mktemp("grid") / "x.png"
    cv2.imwrite(str(path), photo(dots(seen, np.ones((12, 16), bool)), np.random.default_rng(3)))
    return path


@pytest.fixture
def image(picture: Path, tmp_path: Path) -> Path:
    (tmp_path / "x.png").write_bytes(picture.read_bytes())
    return tmp_path / "x.png"


@pytest.fixture(scope="module")
def done(picture: Path) -> Calibration:
    return calibrate([picture])


@pytest.fixture
def quick_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write a few bytes instead of the picture, whose drawing takes most of the time of a calibration's files."""
    monkeypatch.setattr(calibrating, "draw_calibration", lambda path, _: Path(path).write_bytes(b"a picture"))


def test_every_command_that_writes_has_the_option() -> None:
    commands: Any = get_command(application())
    for name, command in commands.commands.items():
        options = {option for each in command.params for option in each.opts}
        assert {"--out", "--json", "--plots", "--trace"} & options, f"{name} writes nothing: then it needs no option"
        assert "--overwrite" in options, name


@pytest.mark.parametrize("more", [(), ("--overwrite",)])
def test_the_plot_of_a_calibration_does_not_replace_its_image(image: Path, more: tuple[str, ...]) -> None:
    before = contents(image.parent)
    with pytest.raises(FileExistsError, match=rf"cannot write {image}: it is the input {image}"):
        run("calibrate", image, "--out", image.with_suffix(".toml"), *more)
    assert contents(image.parent) == before


@pytest.mark.usefixtures("quick_picture")
def test_a_calibration_made_in_python_does_not_replace_its_image(done: Calibration, picture: Path) -> None:
    before = contents(picture.parent)
    with pytest.raises(FileExistsError, match="it is the input"):
        write_calibration(done, picture.with_suffix(".toml"), overwrite=True)
    assert contents(picture.parent) == before


@pytest.mark.usefixtures("quick_picture")
def test_a_calibration_replaces_its_own_files_and_no_edited_one(done: Calibration, tmp_path: Path) -> None:
    file = tmp_path / "lens.toml"
    write_calibration(done, file)
    write_calibration(done, file)
    edited = file.read_text() + "[mount]\nheight = 0.4\ntilt_degrees = 30\n"
    file.write_text(edited)
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=rf"cannot write {file}: the file exists, and is not an unchanged output"):
        write_calibration(done, file)
    assert contents(tmp_path) == before
    write_calibration(done, file, overwrite=True)
    assert "[mount]" not in file.read_text()


@pytest.mark.usefixtures("quick_picture")
@pytest.mark.parametrize("broken", ["draw_calibration", "write_lens"])
def test_a_calibration_writes_all_of_its_files_or_none(
    done: Calibration, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    write_calibration(done, tmp_path / "lens.toml")
    before = contents(tmp_path)

    def fail(*_: Any) -> None:
        raise OSError("the disk broke")

    monkeypatch.setattr(calibrating, broken, fail)
    with pytest.raises(OSError, match="the disk broke"):
        write_calibration(done, tmp_path / "lens.toml")
    with pytest.raises(OSError, match="the disk broke"):
        write_calibration(done, tmp_path / "other.toml")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("link", [None, os.symlink, os.link])
@pytest.mark.parametrize("more", [(), ("--overwrite",)])
def test_undistortion_does_not_replace_its_inputs(
    image: Path, tmp_path: Path, link: Callable[[Path, Path], object] | None, more: tuple[str, ...]
) -> None:
    write_lens(tmp_path / "lens.toml", LENS, {})
    out = tmp_path
    if link is not None:
        out = tmp_path / "out"
        out.mkdir()
        link(image, out / "x.png")
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=rf"cannot write {out / 'x.png'}: it is the input {image}"):
        run("undistort", image, "--lens", tmp_path / "lens.toml", "--out", out, *more)
    assert contents(tmp_path) == before


def test_undistortion_does_not_replace_the_camera_file(image: Path, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    write_lens(tmp_path / "out" / "x.png", LENS, {})
    with pytest.raises(FileExistsError, match="it is the input"):
        run("undistort", image, "--lens", tmp_path / "out" / "x.png", "--out", tmp_path / "out", "--overwrite")
    assert read_lens(tmp_path / "out" / "x.png") == LENS


def test_undistortion_replaces_its_own_images_alone(image: Path, tmp_path: Path) -> None:
    write_lens(tmp_path / "lens.toml", LENS, {})
    arguments = ("undistort", image, "--lens", tmp_path / "lens.toml", "--out", tmp_path / "out")
    run(*arguments)
    run(*arguments)
    (tmp_path / "out" / "x.png").write_text(FOREIGN)
    with pytest.raises(FileExistsError, match="not an unchanged output of an earlier undistort"):
        run(*arguments)
    assert (tmp_path / "out" / "x.png").read_text() == FOREIGN
    run(*arguments, "--overwrite")
    assert cv2.imread(str(tmp_path / "out" / "x.png")) is not None


SCAN = ("scan", "in.npy", "--sensor", "psd_line", "--out", "out")
SIMULATE = ("simulate", "in.npy", "--sensor", "psd_line", "--out", "out")
CALIBRATE = ("calibrate", "in.npy", "--out", "lens.toml")
SELECT = ("select", "in.npy", "--region", "0,0,1cm,1cm", "--scale", "25um", "--out", "out")
LOCATE = ("locate", "in.npy", "--board", "b", "--scale", "25um", "--out", "out")
ROBOT = ("locate-robot", "in.npy", "--field", "robocup_msl", "--out", "out")


@pytest.mark.parametrize(
    ("arguments", "file"),
    [
        *((SCAN, f"out/{name}") for name in ("report.json", "picture.png", "range_image.npz")),
        ((*SCAN, "--trace", "t.json"), "t.json"),
        ((*SCAN, "--json", "r.json"), "r.json"),
        *((SIMULATE, f"out/{name}") for name in ("report.json", "causes.png", "simulation.npz")),
        ((*SIMULATE, "--mask", "best"), "out/mask.txt"),
        ((*SIMULATE, "--second", "camera_line"), "out/second/report.json"),
        ((*SIMULATE, "--second", "camera_line"), "out/both/errors.png"),
        *((CALIBRATE, f"lens.{kind}") for kind in ("toml", "json", "png")),
        ((*CALIBRATE, "--json", "r.json"), "r.json"),
        *((SELECT, f"out/features.{kind}") for kind in ("toml", "png")),
        *((LOCATE, f"out/{name}") for name in ("pose.json", "located.png")),
        *((ROBOT, f"out/{name}") for name in ("pose.json", "located.png")),
        ((*ROBOT, "--json", "r.json"), "r.json"),
        (("devices", "--json", "r.json"), "r.json"),
        (("profile", "psd", "--json", "r.json"), "r.json"),
        (("profile", "psd", "--plots", "out"), "out/growth.png"),
        (("curves", "psd", "--json", "r.json"), "r.json"),
        (("curves", "psd", "--plots", "out"), "out/curve-psd.png"),
        (("tune", "psd", "--json", "r.json"), "r.json"),
        (("demo", "--out", "out"), "out/part.ply"),
        (("demo", "--out", "out"), "out/psd_line_masked/mask.txt"),
    ],
)
def test_files_that_no_earlier_run_wrote_are_refused_before_the_work(
    arguments: tuple[str, ...], file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", np.zeros((9, 2), np.float32))
    Path(file).parent.mkdir(parents=True, exist_ok=True)
    Path(file).write_text(FOREIGN)
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=rf"cannot write {file}: the file exists, and is not an unchanged output"):
        run(*arguments)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "arguments",
    [
        (*SCAN, "--trace", "in.npy"),
        (*SCAN, "--json", "in.npy"),
        (*SIMULATE, "--json", "in.npy"),
        (*CALIBRATE, "--json", "in.npy"),
        (*LOCATE, "--json", "in.npy"),
        (*ROBOT, "--json", "in.npy"),
    ],
)
def test_a_report_does_not_replace_an_input(
    arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", np.zeros((9, 2), np.float32))
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=r"cannot write in.npy: it is the input in.npy"):
        run(*arguments, "--overwrite")
    assert contents(tmp_path) == before


def sensor_with_files(folder: Path, lens_file: str) -> None:
    """Write the sensor file s.toml, which names a lens file, an encoder file and a background image."""
    text = resources.files("gpuvision").joinpath("presets", "sensors", "camera_line.toml").read_text(encoding="utf-8")
    head, tail = text.split("[lens]")
    tail = tail[tail.index("[triangulation]") :].replace(
        "step = 0.25e-3 ", 'encoder = "e.csv"\nmetres_per_count = 1e-6'
    )
    head = head.replace("[recording]", '[recording]\nbackground = "dark.png"').replace("pitch = -1.0", "pitch = 1.0")
    (folder / "s.toml").write_text(f'{head}[lens]\nfile = "{lens_file}"\n{tail}')
    (folder / "e.csv").write_text("1\n2\n")
    (folder / "dark.png").write_text("dark")
    (folder / lens_file).parent.mkdir(exist_ok=True)
    write_lens(folder / lens_file, LENS, {})


FROM_FILE = ("--sensor", "s.toml", "--out", "o1")


@pytest.mark.parametrize(
    ("arguments", "lens_file", "named"),
    [
        (("scan", "in.npy", *FROM_FILE, "--json", "cam.toml"), "cam.toml", "cam.toml"),
        (("scan", "in.npy", *FROM_FILE, "--trace", "cam.toml"), "cam.toml", "cam.toml"),
        (("scan", "in.npy", *FROM_FILE, "--json", "e.csv"), "cam.toml", "e.csv"),
        (("scan", "in.npy", *FROM_FILE, "--json", "dark.png"), "cam.toml", "dark.png"),
        (("scan", "in.npy", *FROM_FILE, "--preview"), "o1/preview.png", "o1/preview.png"),
        (("simulate", "in.npy", *FROM_FILE, "--json", "cam.toml"), "cam.toml", "cam.toml"),
        ((*SIMULATE, "--second", "s.toml", "--json", "cam.toml"), "cam.toml", "cam.toml"),
    ],
)
def test_files_that_a_sensor_file_names_are_inputs(
    arguments: tuple[str, ...], lens_file: str, named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("in.npy", np.zeros((2, 64, 480), np.uint8))
    sensor_with_files(tmp_path, lens_file)
    before = contents(tmp_path)
    with pytest.raises(FileExistsError, match=rf"cannot write {named}: it is the input {named}"):
        run(*arguments, "--overwrite")
    assert contents(tmp_path) == before


def test_a_report_does_not_take_the_name_of_another_output(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=r"two outputs have the same name"):
        run(*SCAN, "--json", "out/../out/report.json")


@pytest.mark.parametrize(("given", "value"), [("--pitch", "0.01"), ("--method=auto", "--pitch=0.01")])
def test_a_pitch_without_poses_is_refused(image: Path, tmp_path: Path, given: str, value: str) -> None:
    before = contents(tmp_path)
    with pytest.raises(ValueError, match="pitch has no effect with method 'lines', which finds no poses"):
        run("calibrate", image, "--out", tmp_path / "lens.toml", given, value)
    assert contents(tmp_path) == before
