"""Scans of focus stacks: from a folder of images to a height map, with the same files as other scans."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.ndimage
import tomli_w

from gpuvision.host import Device, to_numpy
from gpuvision.schema import DescriptionError, Section
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import require_light
from gpuvision.status import Status
from gpuvision.workflows.scan_result import SCAN_FILES
from gpuvision.workflows.scanning import scan
from scanning import Ran, check_refused

STAGE = {"stage_start": 0.0, "stage_step": 50e-6, "pixel_size": 10e-6, "measure": "intensity"}


def table(**focus: Any) -> dict[str, Any]:
    return {"kind": "focus", "focus": STAGE | focus, "output": {"cell": 20e-6}}


def sensor(**focus: Any) -> Sensor:
    return Sensor.from_section(Section(table(**focus), "sensor.toml"))


def slope_frames(dark: int = 0) -> tuple[Any, Any]:
    """Return a confocal stack (9, 30, 40) uint16 of a slope along x, and its heights (30, 40) [m]."""
    height = np.broadcast_to(100e-6 + 5e-6 * np.arange(40), (30, 40))
    number = np.arange(9)[:, None, None]
    frames = 40_000 * np.exp(-0.5 * ((number - height / 50e-6) / 1.3) ** 2)
    frames[:, :dark] = 0
    return np.rint(frames).astype(np.uint16), height


def test_a_slope(device: Device) -> None:
    frames, height = slope_frames(dark=5)
    done = scan(frames, sensor(threshold=100.0), device=device)
    z = to_numpy(done.points.z)
    assert np.all(to_numpy(done.points.status)[:5] == Status.LOW_SIGNAL)
    # Codes of 1 in 40 000, in the flanks 1 in 10 000: 1e-4 of a frame.
    np.testing.assert_allclose(z[5:], height[5:], rtol=0, atol=2e-4 * 50e-6)
    np.testing.assert_allclose(to_numpy(done.points.x)[6], 10e-6 * (np.arange(40) - 19.5), rtol=0, atol=1e-9)
    np.testing.assert_allclose(to_numpy(done.points.y)[5:, 0], 10e-6 * (14.5 - np.arange(5, 30)), rtol=0, atol=1e-9)
    known = np.isfinite(done.heights.z)
    assert known.mean() > 0.7
    plane = 100e-6 + 5e-6 * (done.grid.x / 10e-6 + 19.5)
    np.testing.assert_allclose(done.heights.z[known], np.broadcast_to(plane, known.shape)[known], rtol=0, atol=1e-8)
    np.testing.assert_array_equal(done.frame_numbers[6], np.rint(height[6] / 50e-6))
    assert np.all(done.frame_numbers[:5] == -1)
    report = done.report()
    assert (report["kind"], report["frames"], report["samples_per_frame"]) == ("focus", 9, 1200)
    assert report["valid_fraction"] == pytest.approx(25 / 30)


@pytest.mark.double
@pytest.mark.parametrize("geometry", ["stage", "lens"])
def test_noise_scatters_the_heights_by_their_sigma(
    device: Device, geometry: str, rng: np.random.Generator, tmp_path: Path
) -> None:
    """Noise of 1200 pixels determines the ratio of scatter and sigma to 2 %."""
    exact, _ = slope_frames()
    lens = {"focal_length": 0.05, "first": 0.055, "spacing": 5e-4, "pixel_pitch": 5e-6, "stand_off": 0.6}
    focus = STAGE if geometry == "stage" else lens | {"measure": "intensity"}
    described = {"kind": "focus", "focus": focus | {"read_noise": 150.0}, "output": {"cell": 20e-6}}
    if geometry == "lens":
        described["output"] = {"cell": 2e-3}
    noisy = np.clip(np.rint(exact + rng.normal(0.0, 150.0, exact.shape)), 0, 65_535).astype(np.uint16)
    made = Sensor.from_section(Section(described, "sensor.toml"))
    done, true = scan(noisy, made, device=device, precision="double"), scan(exact, made, precision="double")
    assert done.errors is not None
    for axis in "xz":
        error = to_numpy(getattr(done.points, axis)) - to_numpy(getattr(true.points, axis))
        sigma = getattr(done.errors.random, axis)
        used = np.isfinite(error) & (sigma > 1e-12)
        if axis == "z" or geometry == "lens":
            assert used.mean() > 0.7
            assert np.sqrt(np.mean((error[used] / sigma[used]) ** 2)) == pytest.approx(1.0, abs=0.1)
    assert done.report()["error_budget"]["random"]["total"]["z"] == pytest.approx(np.nanmedian(done.errors.random.z))
    done.write(tmp_path / "out")
    assert (tmp_path / "out" / "range_image_sigma.tiff").exists()


def test_shot_noise_of_the_sensor_file() -> None:
    """The fit of symmetric frames depends on the two beside the peak, at 900 grey levels: variance 1 + 0.01 * 900."""
    frames = (
        np.full((5, 4, 4), 800.0, np.float32)
        + 100.0 * (2 - np.abs(np.arange(5.0, dtype=np.float32) - 2))[:, None, None]
    )
    made = [sensor(measure="intensity", read_noise=1.0, gain=gain) for gain in (0.0, 0.01)]
    sigmas = [np.nanmedian(done.errors.random.z) for done in (scan(frames, each) for each in made) if done.errors]
    assert sigmas[1] / sigmas[0] == pytest.approx(math.sqrt(10.0), rel=1e-5)


def test_a_laplacian_has_a_sigma_within_the_border(rng: np.random.Generator) -> None:
    """A texture that is sharpest at frame 2.3: every height within the border has the sigma of the frame."""
    texture = rng.uniform(0.0, 200.0, (30, 40))
    frames = np.stack([scipy.ndimage.gaussian_filter(texture, 0.5 + 0.4 * abs(k - 2.3)) for k in range(5)])
    done = scan(frames.astype(np.float32), sensor(measure="laplacian", read_noise=1.0))
    assert done.errors is not None
    known = np.isfinite(done.errors.random.z)
    assert known[3:-3, 3:-3].mean() > 0.95
    assert not known[:3].any()
    assert np.all(done.errors.random.z[known] <= 0.1 * 50e-6)
    assert done.points.z[known] == pytest.approx(2.3 * 50e-6, abs=10e-6)


def test_the_command_writes_what_other_scans_write(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    np.save(tmp_path / "stack.npy", slope_frames()[0])
    (tmp_path / "sensor.toml").write_text(tomli_w.dumps(table()))
    arguments = ("scan", tmp_path / "stack.npy", "--sensor", tmp_path / "sensor.toml", "--out", tmp_path / "out")
    ran = Ran(capsys, monkeypatch, *arguments)
    assert (ran.code, ran.err) == (0, "")
    assert "9 frames at" in ran.out
    assert set(SCAN_FILES) <= {each.name for each in (tmp_path / "out").iterdir()}
    assert json.loads((tmp_path / "out" / "report.json").read_text())["kind"] == "focus"
    check_refused(Ran(capsys, monkeypatch, *arguments, "--rate", "100"), "a focus stack is one measurement")


def test_what_to_try(device: Device) -> None:
    frames, _ = slope_frames(dark=20)
    assert "no texture" in " ".join(scan(frames, sensor(threshold=100.0), device=device).advice())
    assert "sharpest outside the stack" in " ".join(scan(frames[5:, 20:], sensor(), device=device).advice())
    with pytest.raises(ValueError, match=r"no valid sample in .*many pixels have no texture"):
        scan(np.zeros((5, 8, 8), np.uint8), sensor(), device=device)


@pytest.mark.double
def test_double_precision(device: Device) -> None:
    single, double = (scan(slope_frames()[0], sensor(), device=device, precision=each) for each in ("single", "double"))
    assert (single.points.z.dtype, double.points.z.dtype) == (np.float32, np.float64)
    np.testing.assert_allclose(single.points.z, double.points.z, rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"focus": {"stage_step": 0.0}}, r"focus: StageFocus\.step is 0"),
        ({"focus": {"stage_stp": 0.0}}, r"unknown key 'focus\.stage_stp'; did you mean 'focus\.stage_step'"),
        ({"focus": {"focal_length": 0.05}}, r"'focus\.first' is missing, expected a number \[m\] above 0"),
        ({"focus": {"measure": "contrast"}}, r"focus\.measure is 'contrast', expected one of"),
        ({"transport": {"kind": "straight"}}, r"unknown key 'transport'"),
        ({"line": {}}, r"unknown key 'line'"),
    ],
)
def test_files(changes: dict[str, Any], message: str) -> None:
    described = table(**changes.get("focus", {})) | {key: each for key, each in changes.items() if key != "focus"}
    with pytest.raises(DescriptionError, match=message):
        Sensor.from_section(Section(described, "sensor.toml"))


def test_a_lens_by_its_equation() -> None:
    lens = {"focal_length": 0.05, "first": 0.055, "spacing": 5e-4, "pixel_pitch": 5e-6, "stand_off": 0.5}
    described = {"kind": "focus", "focus": lens, "frame": {"columns": 4, "rows": 3}, "output": {"cell": 1e-4}}
    made = Sensor.from_section(Section(described, "sensor.toml"))
    assert made.kind == "focus"
    made.check_frame((3, 4), "here")
    with pytest.raises(ValueError, match=r"expects \(rows, columns\) = \(3, 4\)"):
        made.check_frame((4, 3), "here")
    with pytest.raises(ValueError, match="this one measures depth from focus"):
        require_light(made)
