"""Cameras above a floor: geometry, files, scan lines, and localisation of robots."""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from floors import carpet_of, detected_fraction, seen_ahead
from gpuvision.camera.camera import Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.lens import Lens
from gpuvision.cli import main as cli
from gpuvision.formats.camera_file import read_mounted
from gpuvision.formats.field_file import read_field
from gpuvision.host import Device
from gpuvision.matching.field.evidence import distances_to_lines, expected_crossings, robot_to_field
from gpuvision.schema import DescriptionError
from gpuvision.workflows.locating_robot import locate_robot, scan_floor

SHAPE, WIDE = (480, 640), 0.125
BARREL = Camera(
    matrix=((450.0, 0.0, 325.0), (0.0, 452.0, 236.0), (0.0, 0.0, 1.0)), distortion=(-0.25, 0.08, *[0.0] * 12)
)
PINHOLE = MountedCamera(height=0.8, tilt=math.radians(25.0), focal_px=500.0, centre_px=(319.5, 239.5))
BENT = MountedCamera(height=0.8, tilt=0.5, roll=0.05, heading=0.3, position=(0.1, -0.05), model=BARREL)
POSE = (6.0, 3.0, 0.3)


@cache
def carpet() -> np.ndarray:
    return carpet_of(read_field("robocup_msl"), WIDE)


def test_straight_down_is_a_top_view() -> None:
    camera = MountedCamera(height=2.0, tilt=0.5 * math.pi, focal_px=400.0, centre_px=(300.0, 200.0))
    # A pixel is 5 mm; image rows decrease ahead, image columns increase to the right.
    places = camera.to_floor([(300.0, 200.0), (300.0, 100.0), (200.0, 200.0)])
    np.testing.assert_allclose(places, [(0.0, 0.0), (0.5, 0.0), (0.0, 0.5)], atol=1e-12)
    turned = MountedCamera(height=2.0, tilt=0.5 * math.pi, roll=0.5 * math.pi, focal_px=400.0, centre_px=(300.0, 200.0))
    # Rotated clockwise: the left of the image is ahead.
    np.testing.assert_allclose(turned.to_floor([(200.0, 200.0)]), [(0.5, 0.0)], atol=1e-12)


def test_ahead_is_where_height_and_tilt_say() -> None:
    far = 0.8 / math.tan(math.radians(25.0))
    np.testing.assert_allclose(PINHOLE.to_floor([(319.5, 239.5)]), [(far, 0.0)], atol=1e-12)
    left = MountedCamera(
        height=0.8,
        tilt=math.radians(25.0),
        heading=0.5 * math.pi,
        position=(0.2, 0.1),
        focal_px=500.0,
        centre_px=(319.5, 239.5),
    )
    np.testing.assert_allclose(left.to_floor([(319.5, 239.5)]), [(0.2, 0.1 + far)], atol=1e-12)


@pytest.mark.parametrize("camera", [PINHOLE, BENT])
def test_pixels_and_places_are_each_other_s(camera: MountedCamera, rng: np.random.Generator) -> None:
    pixels = rng.uniform([0, 0], [639, 479], (400, 2))
    places = camera.to_floor(pixels)
    seen = np.isfinite(places).all(axis=-1)
    assert 200 < seen.sum() < 400 or seen.all()
    np.testing.assert_allclose(camera.to_pixels(places[seen]), pixels[seen], atol=1e-6)
    assert np.isnan(camera.to_pixels([(-5.0, 0.0)])).all()


def test_nothing_is_seen_above_the_horizon() -> None:
    horizon = 239.5 - 500.0 * math.tan(math.radians(25.0))
    assert np.isnan(PINHOLE.to_floor([(100.0, horizon - 0.01), (600.0, -50.0)])).all()
    assert PINHOLE.to_floor([(319.5, horizon + 1.0)])[0, 0] > 100.0


@pytest.mark.parametrize("camera", [pytest.param(PINHOLE, marks=pytest.mark.slow), BENT])
def test_stripes_are_found_on_their_lines(camera: MountedCamera, rng: np.random.Generator, device: Device) -> None:
    field = read_field("robocup_msl")
    image = seen_ahead(carpet(), camera, POSE, shape=SHAPE, rng=rng)
    scan = scan_floor(image, line_width=WIDE, model=camera, device=device)
    assert len(scan.points) > 60
    away = distances_to_lines(field, robot_to_field(scan.points, POSE))
    # The error is a few millimetres, and some centimetres at 10 m; it is larger where lines end or meet.
    assert np.median(away) < 0.005
    assert np.mean(away < 0.06) > 0.95
    crossings = expected_crossings(field, POSE, scan.paths, line_width=WIDE)
    assert len(crossings.places) > 40
    assert detected_fraction(crossings, scan.points, 0.06) > 0.9
    # Far points have larger standard deviations.
    far = np.hypot(*scan.points.T)
    assert np.median(scan.sigmas[far > 5.0]) > 3.0 * np.median(scan.sigmas[far < 3.0])


@pytest.mark.parametrize("camera", [pytest.param(PINHOLE, marks=pytest.mark.slow), BENT])
def test_a_robot_is_located_through_its_camera(camera: MountedCamera, rng: np.random.Generator, device: Device) -> None:
    field = read_field("robocup_msl")
    image = seen_ahead(carpet(), camera, POSE, shape=SHAPE, rng=rng)
    located = locate_robot(scan_floor(image, line_width=WIDE, model=camera, device=device), field, device=device)
    assert located.reason == ""
    best = min((each.pose for each in located.candidates[:2]), key=lambda pose: np.hypot(*(pose[:2] - POSE[:2])))
    np.testing.assert_allclose(best, POSE, atol=0.05)
    # A tilt error of 4 degrees distorts the view: far lines are metres off.
    wrong = MountedCamera(
        height=0.8,
        tilt=camera.tilt - 0.07,
        roll=camera.roll,
        heading=camera.heading,
        position=camera.position,
        focal_px=camera.focal_px,
        centre_px=camera.centre_px,
        model=camera.model,
    )
    other = locate_robot(scan_floor(image, line_width=WIDE, model=wrong, device=device), field, device=device)
    assert other.reason or other.candidates[0].scale > 2.0 * located.candidates[0].scale


def test_what_it_cannot_be_is_refused() -> None:
    for change, words in (
        ({"height": 0.0}, "height"),
        ({"tilt": 2.0}, "right angle"),
        ({"focal_px": None}, "focal_px"),
        ({"focal_px": -1.0}, "focal_px"),
        ({"centre_px": None}, "centre_px is missing"),
        ({"model": BARREL}, "leave them out"),
    ):
        given = {"height": 0.8, "tilt": 0.4, "focal_px": 500.0, "centre_px": (319.5, 239.5)} | change
        with pytest.raises(ValueError, match=words):
            MountedCamera(**given)
    lens = Lens(k1=1e-8, centre=(300.0, 200.0))
    assert MountedCamera(height=1.0, tilt=0.4, focal_px=500.0, model=lens).matrix[0, 2] == 300.0
    up = MountedCamera(height=0.8, tilt=-1.0, focal_px=500.0, centre_px=(319.5, 239.5))
    with pytest.raises(ValueError, match="nowhere on the floor"):
        scan_floor(np.zeros(SHAPE, np.uint8), line_width=WIDE, model=up)
    with pytest.raises(ValueError, match="scale is given for a mounted camera"):
        scan_floor(np.zeros(SHAPE, np.uint8), line_width=WIDE, scale=0.01, model=PINHOLE)
    with pytest.raises(ValueError, match="scale is missing"):
        scan_floor(np.zeros(SHAPE, np.uint8), line_width=WIDE)


def test_files_say_how_it_is_mounted(tmp_path: Path) -> None:
    file = tmp_path / "camera.toml"
    mount = "[mount]\nheight = 0.8\ntilt_degrees = 25\n"
    file.write_text(mount + "focal_px = 500\n")
    assert read_mounted(file, SHAPE) == MountedCamera(
        height=0.8, tilt=math.radians(25.0), focal_px=500.0, centre_px=(319.5, 239.5)
    )
    matrix = "[camera]\nmatrix = [[450.0, 0, 325], [0, 452, 236], [0, 0, 1]]\nk1 = -0.25\nk2 = 0.08\n"
    file.write_text(matrix + mount + "roll_degrees = 3\nheading_degrees = -90\nposition = [0.1, 0.2]\n")
    read = read_mounted(file, SHAPE)
    assert read is not None
    assert (read.model, read.position, read.heading) == (BARREL, (0.1, 0.2), -0.5 * math.pi)
    file.write_text("[lens]\nk1 = 1e-8\ncentre = [300, 200]\n" + mount + "focal_px = 500\n")
    lens = read_mounted(file, SHAPE)
    assert lens is not None
    assert lens.centre_px == (300.0, 200.0)
    file.write_text(matrix)
    assert read_mounted(file, SHAPE) is None
    for text, words in (
        (mount, "mount.focal_px"),
        (matrix + mount + "focal_px = 500\n", "mount.focal_px"),
        ("[mount]\nheight = 0\ntilt_degrees = 3\n", "mount.height"),
        (mount.replace("25", "95"), "mount.tilt_degrees"),
    ):
        file.write_text(text)
        with pytest.raises(DescriptionError, match=words):
            read_mounted(file, SHAPE)


@pytest.mark.slow
def test_the_command_takes_a_mounted_camera(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], rng: np.random.Generator
) -> None:
    cv2.imwrite(str(tmp_path / "ahead.png"), seen_ahead(carpet(), PINHOLE, POSE, shape=SHAPE, rng=rng))
    (tmp_path / "camera.toml").write_text("[mount]\nheight = 0.8\ntilt_degrees = 25\nfocal_px = 500\n")
    call = ["gpuvision", "locate-robot", str(tmp_path / "ahead.png"), "--field", "robocup_msl"]
    call += ["--camera", str(tmp_path / "camera.toml")]
    monkeypatch.setattr("sys.argv", [*call, "--out", str(tmp_path / "out")])
    with pytest.raises(SystemExit) as done:
        cli.main()
    assert not done.value.code
    report = json.loads((tmp_path / "out" / "pose.json").read_text())
    assert abs(abs(report["candidates"][0]["pose"]["x"]) - 6.0) < 0.05
    assert (tmp_path / "out" / "located.png").exists()
    monkeypatch.setattr("sys.argv", [*call, "--scale", "1cm"])
    capfd.readouterr()
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 1
    told_wrong = capfd.readouterr().err
    assert "--scale has no effect" in told_wrong
    assert told_wrong.count("\n") == 1
