"""Scans: range images, files and report from recordings; one-line errors, and no partial output."""

from __future__ import annotations

import functools
import json
import re
import subprocess
import sys
import threading
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from gpuvision.formats.range_image import read_npz, read_ply, read_png16, read_tiff
from gpuvision.host import Device, RecordingError, StreamError
from gpuvision.host.outputs import MANIFEST
from gpuvision.host.pipeline import Pipeline
from gpuvision.host.sources import ArraySource, PacedSource, Source
from gpuvision.sensor.sensor import Sensor
from gpuvision.status import Status
from gpuvision.workflows import scanning
from gpuvision.workflows.scan_result import Scan
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused, currents, line_frames
from streams import producer_ended

FILES = {
    MANIFEST,
    "range_image.tiff",
    "range_image.png",
    "range_image.ply",
    "range_image.npz",
    "picture.png",
    "scan.png",
    "report.json",
}


@pytest.mark.parametrize("moves", [True, False])
@pytest.mark.parametrize(("level", "is_named"), [(0, False), (15, False), (16, True), (40, True)])
def test_ambient_light_that_reaches_the_threshold_is_named(level: int, is_named: bool, moves: bool) -> None:
    """The threshold is 16 grey levels; the line covers more than 3 % of the frame, also if it stands still."""
    rows = np.linspace(20.0, 44.0, 480)[None, :] + (0.8 if moves else 0.0) * np.arange(20)[:, None]
    done = scan(line_frames(rows) + np.uint8(level), Sensor.load("camera_line"), device=Device.best())
    assert done.report()["ambient_level"] == level
    sentence = f"the frames have {level} grey levels beside the line, expected less than the threshold of 16; ambient"
    assert any(each.startswith(sentence) for each in done.advice()) == is_named
    assert len(done.advice()) == is_named


# ---- output -------------------------------------------------------------------------------------------------


def test_a_plane_before_psd_strips(device: Device) -> None:
    done = scan(currents(20), Sensor.load("psd_line"), device=device)
    assert done.valid_fraction == 1.0
    # A code is 50 pA of 1 uA: the position error is at most 6 mm / 2e4 / 4, and dH/du is about 9 in this setup.
    np.testing.assert_allclose(done.points.z, 2e-3, rtol=0, atol=6e-3 / 2e4 / 4 * 10)
    np.testing.assert_allclose(done.points.y, np.broadcast_to(0.25e-3 * np.arange(20)[:, None], (20, 96)), atol=1e-9)
    assert np.all(np.diff(done.points.x, axis=1) > 0)
    np.testing.assert_allclose(done.intensity, 1e-6, rtol=1e-4)
    assert done.heights.z.shape == done.grid.shape
    np.testing.assert_allclose(done.heights.z[np.isfinite(done.heights.z)], 2e-3, atol=1e-6)


def test_a_tilted_line_before_a_camera(device: Device) -> None:
    rows = np.linspace(20.0, 44.0, 480)[None, :] + 0.1 * np.arange(12)[:, None]
    sensor = Sensor.load("camera_line")
    done = scan(line_frames(rows), sensor, device=device)
    sheet: Any = sensor.readout.triangulation
    straight = sheet.lens.swapped().undistort(
        np.stack([48.0 - rows, np.broadcast_to(np.arange(480) - 239.5, rows.shape)], -1)
    )
    lifted = straight @ np.array(sheet.homography)[:, :2].T + np.array(sheet.homography)[:, 2]
    expected = lifted[..., 1] / lifted[..., 2]
    assert done.valid_fraction == 1.0
    # Grey levels are rounded and the threshold cuts the tails: 0.03 pixel, at 0.24 mm per pixel.
    np.testing.assert_allclose(done.points.z, expected, rtol=0, atol=0.03 * 0.24e-3)
    assert np.all(done.intensity >= 180)


@pytest.mark.double
def test_double_precision_and_single_agree(device: Device) -> None:
    frames = currents(6)
    single, double = (scan(frames, Sensor.load("psd_line"), device=device, precision=p) for p in ("single", "double"))
    assert (single.points.z.dtype, double.points.z.dtype) == (np.float32, np.float64)
    assert (single.report()["precision"], double.report()["precision"]) == ("single", "double")
    np.testing.assert_allclose(single.points.z, double.points.z, rtol=0, atol=1e-8)


def test_currents_that_are_no_numbers_are_flagged(device: Device) -> None:
    sensor = Sensor.load("psd_line")
    frames = currents(8).astype(np.float32)
    frames[3, 10, 0] = np.nan
    frames[4, 20] = np.inf
    frames[5, 30:40] = 0.0
    done = scan(frames, sensor, device=device)
    status = done.points.status
    assert status[3, 10] & Status.NOT_FINITE
    assert status[4, 20] & (Status.NOT_FINITE | Status.SATURATED)
    assert np.all(status[5, 30:40] & Status.LOW_SIGNAL)
    bad = status != 0
    assert np.count_nonzero(bad) == 12
    np.testing.assert_array_equal(bad, ~np.isfinite(done.points.z))
    counts = done.counts()
    assert counts["OK"] == 8 * 96 - 12
    assert counts["LOW_SIGNAL"] >= 10
    assert done.report()["valid_fraction"] == pytest.approx(1 - 12 / (8 * 96))


def two_lines() -> Any:
    """Return frames with a line at row 40, and in columns 100 to 149 a second line of nearly the same strength."""
    frames = line_frames(np.full((6, 480), 40.0))
    frames[:, :, 100:150] += line_frames(np.full((6, 50), 12.0), peak=190.0)
    return frames


@pytest.mark.parametrize("kept", [False, True])
def test_more_than_one_line_is_flagged_and_dropped_unless_asked_for(kept: bool) -> None:
    sensor = Sensor.load("camera_line")
    if kept:
        sensor = replace(sensor, output=replace(sensor.output, ambiguous="keep"))
    done = scan(two_lines(), sensor)
    np.testing.assert_array_equal(
        (done.points.status & Status.AMBIGUOUS) != 0, np.isin(np.arange(480), range(100, 150))[None].repeat(6, 0)
    )
    np.testing.assert_array_equal(np.isfinite(done.points.z[:, 100:150]), np.full((6, 50), kept))


def test_an_ambiguous_point_has_no_coordinate() -> None:
    points = scan(two_lines(), Sensor.load("camera_line")).points
    ambiguous = np.zeros((6, 480), bool)
    ambiguous[:, 100:150] = True
    for coordinate in (points.x, points.y, points.z):
        np.testing.assert_array_equal(np.isnan(coordinate), ambiguous)


@pytest.mark.parametrize("step", [0.25e-3, -0.25e-3])
def test_a_transport_that_runs_forwards_or_backwards(device: Device, step: float) -> None:
    """A ramp of 0.1 mm a profile: the same heights at y of either sign."""
    sensor = Sensor.load("psd_line")
    frames = np.concatenate([currents(1, height=1e-4 * number) for number in range(13)])
    done = scan(frames, replace(sensor, transport=replace(sensor.transport, step=step)), device=device)
    np.testing.assert_allclose(done.points.y[:, 0], step * np.arange(13), atol=1e-9)
    held = np.isfinite(done.heights.z)
    assert held.mean() > 0.8
    assert not done.heights.status[held].any()
    height = np.broadcast_to(0.4 * np.sign(step) * done.grid.y[:, None], held.shape)
    # Half a code of both currents, of 2e4 codes; dH/du is about 9.
    np.testing.assert_allclose(done.heights.z[held], height[held], rtol=0, atol=6e-3 / 2e4 / 2 * 10)


def test_a_delay_is_in_seconds_in_the_report_and_in_milliseconds_in_the_summary() -> None:
    sensor, now = Sensor.load("psd_line"), [1_000_000_000]
    source = PacedSource(ArraySource(currents(3)), 1000.0, clock=lambda: now[0], sleep=lambda seconds: None)
    frame, arrived = np.zeros((1, 96, 2), np.uint16), np.zeros(1, np.int64)
    assert source.wait()
    now[0] += 9_000_000
    assert source.read_into(frame, arrived) == 1
    done = scan(currents(3), sensor)
    punctual = replace(done, metadata=scanning._metadata("tape", sensor, 1000.0, source))
    assert punctual.report()["late"] == pytest.approx(9e-3)
    assert "late" not in punctual.summary()
    now[0] += 28_000_000  # the second frame was due 1 ms after the first
    assert source.read_into(frame, arrived) == 1
    overdue = replace(done, metadata=scanning._metadata("tape", sensor, 1000.0, source))
    assert overdue.report()["late"] == pytest.approx(36e-3)
    assert "frames were read up to 36 ms late" in overdue.summary()


class SensorClock:
    """Clock that only sleeps of the sensor advance; after the first quarter of a second they wait for `release`."""

    def __init__(self) -> None:
        self._now = 0
        self._released = threading.Event()

    def __call__(self) -> int:
        return self._now

    def sleep(self, seconds: float) -> None:
        """Wake a millisecond late: a reader that wakes early reads the clock until the time has come."""
        now = self._now + round(seconds * 1e9) + 1_000_000
        assert now < 250_000_000 or self._released.wait(60)
        self._now = now

    def release(self) -> None:
        self._released.set()


@pytest.fixture
def sensor_clock(monkeypatch: pytest.MonkeyPatch) -> SensorClock:
    """The clock of all parts of a scan."""
    clock = SensorClock()

    class Paced(PacedSource):
        def __init__(self, source: Source, rate: float) -> None:
            super().__init__(source, rate, clock=clock, sleep=clock.sleep)

    monkeypatch.setattr(scanning, "PacedSource", Paced)
    monkeypatch.setattr(scanning, "Pipeline", functools.partial(Pipeline, clock=clock))
    return clock


def test_dropped_frames_do_not_shift_the_transport(sensor_clock: SensorClock) -> None:
    sensor = Sensor.load("psd_line")

    def stall(done: int, of: int | None) -> None:
        """Hold up the first batch until the last frame has come; the ring holds fewer frames than come meanwhile."""
        sensor_clock.release()
        producer_ended()

    done = scan(ArraySource(currents(2), count=300), sensor, rate=200.0, progress=stall)
    report = done.report()
    assert report["dropped"] > 0
    assert report["frames"] + report["dropped"] == 300
    assert report["stream"]["longest_stall"]["place"] == "consumer"
    assert report["stream"]["longest_stall"]["consumer"] > 0.9
    assert "; longest stall " in done.summary()
    assert done.summary().endswith("most of it in the consumer")
    assert report["stream"]["policy"] == "drop_oldest"
    assert len(done.frame_numbers) == report["frames"]
    assert np.all(np.diff(done.frame_numbers) > 0)
    assert done.frame_numbers[-1] == 299
    np.testing.assert_allclose(done.points.y[:, 0], 0.25e-3 * done.frame_numbers, atol=1e-8)


def test_a_scan_ends_at_a_stall_where_no_frame_may_be_lost(sensor_clock: SensorClock) -> None:
    def stall(done: int, of: int | None) -> None:
        sensor_clock.release()
        producer_ended()

    endless = ArraySource(currents(2), count=10**9)
    with pytest.raises(StreamError, match="no slot was free"):
        scan(endless, Sensor.load("psd_line"), rate=400.0, policy="raise", progress=stall)


@pytest.mark.rendered
def test_files_hold_what_was_scanned(tmp_path: Path) -> None:
    done = scan(two_lines(), Sensor.load("camera_line"))
    out = tmp_path / "a" / "b"
    done.write(out)
    assert {each.name for each in out.iterdir()} == FILES
    assert [each.name for each in (tmp_path / "a").iterdir()] == ["b"]
    np.testing.assert_array_equal(read_tiff(out / "range_image.tiff").z, done.heights.z)
    read = read_png16(out / "range_image.png")
    assert read.grid == done.grid
    np.testing.assert_array_equal(np.isfinite(read.z), np.isfinite(done.heights.z))
    points = read_ply(out / "range_image.ply")
    for name in ("x", "y", "z", "status"):
        np.testing.assert_array_equal(points[name], getattr(done.points, name))
    np.testing.assert_array_equal(points["intensity"], done.intensity)
    arrays, units = read_npz(out / "range_image.npz")
    np.testing.assert_array_equal(arrays["map_z"], done.heights.z)
    np.testing.assert_array_equal(arrays["map_x"], done.grid.x)
    assert (units["z"], units["intensity"]) == ("m", "grey level")
    report = json.loads((out / "report.json").read_text())
    assert report["frames"] == 6
    assert report["device"]["label"] == done.device.label
    assert report["status"]["AMBIGUOUS"] == 300
    assert report["valid_fraction"] == pytest.approx(430 / 480)
    assert report["throughput"] > 0
    assert report["latency"]["p50"] <= report["latency"]["p99"] <= report["latency"]["maximum"]
    assert {"source", "launch", "wait", "compute", "sink"} <= set(report["stages"])
    assert {"stream", "assemble", "resample", "write"} == set(report["seconds"])
    for name in ("picture.png", "scan.png"):
        picture = cv2.imread(str(out / name))
        assert picture is not None
        assert min(picture.shape[:2]) > 100


def test_height_map_and_scan_have_one_colour_scale(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The height map fills gaps and has other percentiles than the scan: the same colour is the same height."""
    frames = np.concatenate([currents(1, height=1e-4 * number**2) for number in range(7)])
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **how: figures.append(figure))
    done = scan(frames, Sensor.load("psd_line"))
    done.write(tmp_path)
    spans = [figure.axes[1].get_ylim() for figure in figures]
    known = np.sort(done.points.z.ravel())
    # In mm: 0.5 % and 99.5 % of 672 samples lie within the first and the last profile.
    assert spans == [pytest.approx((1e3 * known[3], 1e3 * known[-4]), abs=1e-3)] * 2
    assert spans[0] == spans[1]


# ---- the command and bad input --------------------------------------------------------------------------------------


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    return lambda *args: Ran(capsys, monkeypatch, *args)


def test_the_command_scans(tmp_path: Path, run: Any) -> None:
    np.save(tmp_path / "plane.npy", currents(12))
    out, trace, device = tmp_path / "out", tmp_path / "trace.json", Device.best()
    precision = "double" if device.has_double else "single"
    ran = run(
        "scan", tmp_path / "plane.npy", "--sensor", "psd_line", "--out", out, "--device", device.label,
        "--precision", precision, "--rate", "1000", "--policy", "block", "--trace", trace,
    )  # fmt: skip
    assert (ran.code, ran.err) == (0, "")
    assert {each.name for each in out.iterdir()} == FILES | {"range_image_sigma.tiff"}  # the sensor gives its noise
    assert "12 frames at" in ran.out
    assert re.search(r"sigma of z [0-9.e+-]+ um random \(readout .* um, transport 0 um\); systematic unknown", ran.out)
    assert str(out / "picture.png") in ran.out
    report = json.loads((out / "report.json").read_text())
    assert (report["precision"], report["rate"], report["stream"]["policy"]) == (precision, 1000.0, "block")
    assert report["recording"] == str(tmp_path / "plane.npy")
    assert json.loads(trace.read_text())["traceEvents"]


def video(path: Path, frames: Any, codec: str = "MJPG") -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 25.0, frames.shape[:0:-1])
    assert writer.isOpened()
    for frame in frames:
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def truncated_video(folder: Path) -> Path:
    complete = video(folder / "whole.avi", two_lines().repeat(8, 0))
    cut = folder / "cut.avi"
    cut.write_bytes(complete.read_bytes()[: complete.stat().st_size // 2])
    return cut


def changing_images(folder: Path) -> Path:
    images = folder / "images"
    images.mkdir()
    for number, rows in enumerate((64, 64, 63)):
        cv2.imwrite(str(images / f"{number}.png"), two_lines()[0, :rows])
    return images


def empty_folder(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def dark_frames(folder: Path) -> Path:
    np.save(folder / "dark.npy", np.zeros((4, 64, 480), np.uint8))
    return folder / "dark.npy"


def other_frames(folder: Path) -> Path:
    np.save(folder / "other.npy", np.zeros((4, 64, 481), np.uint8))
    return folder / "other.npy"


def wrong_type(folder: Path) -> Path:
    np.save(folder / "type.npy", np.zeros((4, 64, 480), np.int32))
    return folder / "type.npy"


def cut_array(folder: Path) -> Path:
    np.save(folder / "whole.npy", two_lines())
    cut = folder / "cut.npy"
    cut.write_bytes((folder / "whole.npy").read_bytes()[:5000])
    return cut


BAD_RECORDINGS = [
    (truncated_video, r"truncated video: frame \d+ of 48"),
    (changing_images, r"2\.png: 63x480 .*first frame was 64x480"),
    (empty_folder, r"no images in this folder"),
    (lambda folder: folder / "nothing.npy", r"nothing\.npy: no such recording"),
    (dark_frames, r"no valid sample in 4 frames \(LOW_SIGNAL\)"),
    (
        other_frames,
        r"other\.npy: frames have shape \(64, 481\), the sensor file expects \(rows, columns\) = \(64, 480\)",
    ),
    (wrong_type, r"LineReadout takes uint8, uint16 or float32 frames, got int32"),
    (cut_array, r"cut\.npy: not a readable \.npy file"),
]


@pytest.mark.parametrize(("make", "message"), BAD_RECORDINGS, ids=[m[:24] for _, m in BAD_RECORDINGS])
def test_a_bad_recording_is_a_line_and_leaves_nothing(make: Any, message: str, tmp_path: Path, run: Any) -> None:
    recording = make(tmp_path)
    before = sorted(tmp_path.rglob("*"))
    out = tmp_path / "new" / "out"
    ran = run("scan", recording, "--sensor", "camera_line", "--out", out, "--trace", out / "trace.json")
    check_refused(ran, message)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_the_decoder_of_videos_keeps_quiet(tmp_path: Path) -> None:
    """Standard error contains exactly one line, including output of the video libraries."""
    complete = video(tmp_path / "whole.mp4", two_lines().repeat(8, 0), "mp4v")
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(complete.read_bytes()[: complete.stat().st_size // 2])
    command = [sys.executable, "-c", "from gpuvision.cli.main import main; main()", "scan", str(cut)]
    command += ["--sensor", "camera_line", "--out", str(tmp_path / "out")]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert re.fullmatch(r"gpuvision: .*cut\.mp4: no frame of this video can be decoded.*\n", ran.stderr)
    assert not (tmp_path / "out").exists()


def test_bad_arguments_are_a_line_and_leave_nothing(tmp_path: Path, run: Any) -> None:
    np.save(tmp_path / "plane.npy", currents(4))
    text = "kind = 'psd'\n[psd]\nstrips = 96\nstrip_lenght = 1\n[transport]\nkind = 'straight'\nstep = 1e-3\n"
    (tmp_path / "bad.toml").write_text(text)
    (tmp_path / "file").write_text("")
    before = sorted(tmp_path.rglob("*"))
    plane, out = tmp_path / "plane.npy", tmp_path / "out"
    for args, message in (
        (("--sensor", tmp_path / "bad.toml", "--out", out), r"bad\.toml: .*strip_lenght"),
        (("--sensor", tmp_path / "none.toml", "--out", out), r"no sensor file"),
        (("--sensor", "psd_line", "--out", tmp_path / "file"), r"file is a file, expected a folder"),
        (("--sensor", "psd_line", "--out", tmp_path / "file" / "below"), r"file is a file, expected a folder"),
        (("--sensor", "psd_line", "--out", out, "--device", "abacus"), r"no device matches 'abacus'"),
        (("--sensor", "psd_line", "--out", out, "--rate", "-1"), r"rate is -1"),
    ):
        check_refused(run("scan", plane, *args), message)
        assert sorted(tmp_path.rglob("*")) == before
    for args in (("--policy", "sometimes"), ("--precision", "half")):
        assert run("scan", plane, "--sensor", "psd_line", "--out", out, *args).code == 2
    assert sorted(tmp_path.rglob("*")) == before


def test_the_smallest_recordings_are_scanned() -> None:
    sensor = Sensor.load("psd_line")
    one = scan(currents(1), sensor)
    assert one.valid_fraction == 1.0
    assert one.grid.rows == 1
    line = scan(line_frames(np.full((1, 480), 30.0)), Sensor.load("camera_line"))
    assert line.points.z.shape == (1, 480)
    assert line.valid_fraction == 1.0


def test_one_array_of_several_is_named_by_its_key(tmp_path: Path, run: Any) -> None:
    np.savez(tmp_path / "both.npz", dark=currents(3), light=currents(5))
    text = resources.files("gpuvision").joinpath("presets", "sensors", "psd_line.toml").read_text(encoding="utf-8")
    keyed = tmp_path / "keyed.toml"
    keyed.write_text(text.replace("[recording]", "[recording]\nkey = 'light'"))
    assert scan(tmp_path / "both.npz", Sensor.load(keyed)).points.z.shape == (5, 96)
    ran = run("scan", tmp_path / "both.npz", "--sensor", "psd_line", "--out", tmp_path / "out")
    check_refused(ran, r"holds several arrays; name one of dark, light as key, in a sensor file under \[recording\]")


def test_a_map_too_large_to_hold_is_refused() -> None:
    sensor = Sensor.load("psd_line")
    with pytest.raises(ValueError, match=r"cells of 1e-08 m; give \[output\] a larger cell"):
        scan(currents(4), replace(sensor, output=replace(sensor.output, cell=1e-8)))
    with pytest.raises(RecordingError, match="no such recording"):
        scan("nowhere.npy", sensor)


# ---- the real recording ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def corner(data: Path) -> Scan:
    return scan(data / "laser" / "corner_scene_sweep.mp4", Sensor.load("corner_scene"))


# The surface of each region was read from scan.png; the positions of the surfaces follow from a fit of the whole scene
# without sphere and cylinder. A pixel is z^2/(b f) of depth: 57 mm at the wall, 27 mm at the large box. That fit has a
# residual of 0.063 pixel rms; 0.1 pixel is granted for a plane.
PLANES = {
    "wall": ((slice(64, 118), slice(200, 480)), "z", 0.0, 5.7e-3),
    "large box": ((slice(32, 80), slice(1140, 1560)), "z", 1.104, 2.7e-3),
    "floor": ((slice(30, 110), slice(1700, 1900)), "y", 0.0, 0.7e-3),
    "ceiling": ((slice(62, 118), slice(10, 140)), "y", 2.0, 2.5e-3),
}


@pytest.mark.realdata
@pytest.mark.parametrize("name", PLANES)
def test_planes_of_the_corner_scene(corner: Scan, name: str) -> None:
    place, axis, level, tolerance = PLANES[name]
    off = getattr(corner.points, axis)[place] - level
    assert np.mean(np.isfinite(off)) > 0.99
    off = off[np.isfinite(off)]
    assert abs(float(np.median(off))) < tolerance
    assert float(np.sqrt(np.mean(off**2))) < tolerance


def sphere_of(x: Any, y: Any, z: Any) -> tuple[Any, float]:
    """Return centre and radius by linear least squares."""
    A = np.column_stack([2 * x, 2 * y, 2 * z, np.ones_like(x)])
    (a, b, c, d), *_ = np.linalg.lstsq(A, x**2 + y**2 + z**2, rcond=None)
    return np.array([a, b, c]), float(np.sqrt(d + a * a + b * b + c * c))


@pytest.mark.realdata
def test_sphere_and_cylinder_of_the_corner_scene(corner: Scan) -> None:
    """The outlines in the image give radii of 0.224 and 0.137 m; the scanned depths agree within 4 %."""
    x, y, z = (each[70:98, 560:800].astype(np.float64) for each in corner.points[:3])
    on = np.isfinite(z) & (np.hypot(x - 0.232, y - 1.071) < 0.19) & (z > 0.55)
    assert np.count_nonzero(on) > 3000
    centre, radius = sphere_of(x[on], y[on], z[on])
    np.testing.assert_allclose(centre, [0.232, 1.071, 0.593], atol=0.01)
    assert radius == pytest.approx(0.224, rel=0.04)
    x, y, z = (each[39:57, 200:900].astype(np.float64) for each in corner.points[:3])
    on = np.isfinite(z) & (z > 0.4)
    assert np.mean(on) > 0.99
    A = np.column_stack([2 * x[on], 2 * z[on], np.ones(np.count_nonzero(on))])
    (a, c, d), *_ = np.linalg.lstsq(A, x[on] ** 2 + z[on] ** 2, rcond=None)
    assert float(np.sqrt(d + a * a + c * c)) == pytest.approx(0.137, rel=0.04)
    assert a == pytest.approx(-0.202, abs=0.005)


def runs_of(row: Any, threshold: int) -> list[tuple[int, int]]:
    """Return the first and last sample of each run over the threshold."""
    lit = np.flatnonzero(row > threshold)
    breaks = np.flatnonzero(np.diff(lit) > 1)
    return list(zip(lit[np.r_[0, breaks + 1]], lit[np.r_[breaks, len(lit) - 1]], strict=True)) if len(lit) else []


@pytest.mark.slow
@pytest.mark.realdata
def test_rows_without_a_clear_line_are_flagged_not_invented(corner: Scan, data: Path) -> None:
    assert corner.valid_fraction > 0.88
    capture = cv2.VideoCapture(str(data / "laser" / "corner_scene_sweep.mp4"))
    frames = {n: capture.read()[1][:, :, 1] for n in range(128)}
    capture.release()
    seen = dict.fromkeys(("none", "part", "two"), 0)
    for number in (2, 6, 28, 36, 45, 59, 65, 83, 100, 107, 119):
        status, z = corner.points.status[number], corner.points.z[number]
        for row in range(0, 1920, 3):
            samples = frames[number][row].astype(int)
            runs = [(a, b) for a, b in runs_of(samples, 120) if samples[a : b + 1].max() >= 152]
            lines = [(a, b) for a, b in runs if 5 <= b - a + 1 <= 12]
            if not lines:
                seen["part" if runs else "none"] += 1
                assert status[row] & Status.LOW_SIGNAL
                assert np.isnan(z[row])
            elif runs[-1][0] - runs[0][1] > 12:
                seen["two"] += 1
                assert status[row] != 0
                assert np.isnan(z[row])
    assert min(seen.values()) > 20, seen


@pytest.mark.realdata
def test_nothing_hangs_in_the_air_before_the_back_wall(corner: Scan) -> None:
    """Between objects: points of the wall, holes, or flags; a half covered line is off by at most one pixel."""
    x, y, z = (np.where(np.isfinite(corner.points.z), each, 9.0) for each in corner.points[:3])
    between = (x > 0.5) & (x < 0.95) & (y > 0.8) & (y < 1.9)
    assert np.count_nonzero(between) > 10_000
    assert np.all(np.abs(z[between]) < 0.057)
