"""Light of the laser in pairs of images, and readings of the line along both axes of an image."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.host.errors import RecordingError
from gpuvision.workflows import calibrating_sensor, laser_images
from gpuvision.workflows.laser_images import (
    ImagePairs,
    LightImage,
    LineImage,
    image_light,
    line_direction,
    read_block,
    read_line,
    target_light,
)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_light_is_the_difference_of_two_images(tmp_path: Path, dtype: Any, rng: np.random.Generator) -> None:
    """Numbers below 0 stay; a pixel at the largest value of the laser image is saturated."""
    top = np.iinfo(dtype).max
    dark, lit = rng.integers(0, top, (2, 3, 5)).astype(dtype)
    lit[1, 2], lit[1, 3], dark[0, 0] = top, top - 1, top
    for name, image in (("dark", dark), ("lit", lit)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image)
    found = image_light(tmp_path / "dark.png", tmp_path / "lit.png", "grey")
    np.testing.assert_array_equal(found.light, lit.astype(float) - dark.astype(float))
    assert found.light.dtype == np.float32
    assert np.argwhere(found.saturated).tolist() == [[1, 2]]
    assert found.inside.all()
    assert found.inside.shape == (3, 5)
    cv2.imwrite(str(tmp_path / "other.png"), dark[:2, :4])
    with pytest.raises(
        RecordingError, match=r"lit\.png: 5 x 3 pixels, the image without laser .*other\.png has 4 x 2$"
    ):
        image_light(tmp_path / "other.png", tmp_path / "lit.png", "grey")


def test_light_on_a_target_is_read_within_its_points(tmp_path: Path) -> None:
    for name, level in (("dark", 10), ("lit", 50)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((20, 30), level, np.uint8))
    grid = np.stack(np.meshgrid([4.2, 11.0, 21.8], [3.0, 9.6]), axis=-1)
    grid[0, 1] = np.nan
    target: Any = type("Target", (), {"grid": grid, "image": tmp_path / "dark.png"})
    found = target_light(target, tmp_path / "lit.png", "grey")
    expected = np.zeros((20, 30), bool)
    expected[3:11, 4:23] = True
    np.testing.assert_array_equal(found.inside, expected)
    assert (found.light == 40.0).all()


def line_light(along: str, rows: np.ndarray) -> LightImage:
    """Return noisy light of a line, sigma 1.5 px, at a position for each sample; the border of 5 px is no target."""
    rng = np.random.default_rng(8)
    across = np.arange(120.0)[:, None]
    light = 150.0 * np.exp(-0.5 * ((across - rows) / 1.5) ** 2) + rng.normal(0.0, 1.0, (120, len(rows)))
    light = (light if along == "columns" else light.T).astype(np.float32)
    inside = np.zeros(light.shape, bool)
    inside[5:-5, 5:-5] = True
    return LightImage(light, inside, np.zeros(light.shape, bool))


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_a_line_is_read_along_either_axis(along: Any, device: Device) -> None:
    samples = np.arange(200)
    rows = 40.0 + 0.05 * samples
    images = line_light(along, rows)
    assert line_direction([images]) == along
    found = read_line(images, Path("lit.png"), along=along, device=device)
    assert (found.image, found.note) == (Path("lit.png"), "")
    assert 0.0 < found.threshold < 75.0
    sample, position = found.points.T if along == "columns" else found.points.T[::-1]
    # Within 8 pixels of the border of the area nothing is read.
    np.testing.assert_array_equal(sample, samples[13:-13])
    np.testing.assert_allclose(position, rows[13:-13], atol=0.15)
    # Saturated readings are left out, and named where they are the larger part.
    for last, note in ((90, ""), (130, "117 readings are saturated; take the laser images with less light")):
        clipped = np.zeros((120, 200), bool)
        clipped[:, :last] = True
        saturated = images._replace(saturated=clipped if along == "columns" else clipped.T)
        part = read_line(saturated, Path("lit.png"), along=along, device=device)
        assert part.note == note
        np.testing.assert_array_equal(part.points, found.points[last - 13 :])
    dark = images._replace(light=images.light * np.float32(0.0))
    assert read_line(dark, Path("dark.png"), along=along, device=device).note == "no laser line was found"


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_a_block_is_read_along_either_axis(along: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    sample = np.arange(200.0)
    position = 50.0 + 0.2 * sample + 12.0 * (sample >= 80.0) + rng.normal(0.0, 0.1, 200)
    points = np.stack([sample, position] if along == "columns" else [position, sample], axis=1)
    line = LineImage(image=Path("lit.png"), points=points, threshold=7.0, note="a note")
    monkeypatch.setattr(laser_images, "read_line", lambda *_, along, device: line)
    images: Any = None
    found, step = read_block(images, Path("lit.png"), 2, along=along, device=None)
    assert (found.image, found.threshold, found.note) == (line.image, 7.0, "a note")
    kept = found.points[:, 0 if along == "columns" else 1]
    np.testing.assert_array_equal(kept, np.delete(sample, np.arange(74, 86)))
    np.testing.assert_array_equal(step, kept >= 80.0)
    with pytest.raises(ValueError, match=r"^lit\.png: the laser line has 1 steps up or down, expected 2$"):
        read_block(images, Path("lit.png"), 3, along=along, device=None)


@pytest.mark.parametrize(
    ("target", "laser", "expected"),
    [
        ("t/pose7.png", "l/pose7.png", True),
        ("t/pose7.png", "l/pose7_laser.png", True),
        ("t/pose7.png", "t/pose7_laser.png", True),
        ("t/cam2_7.png", "l/laser3_07.png", True),  # the last numbers, whose zeros in front do not count
        ("t/cam2_7.png", "l/laser7_2.png", False),
        ("t/cam7_2.png", "l/laser7_3.png", False),
        ("t/cam2_7.png", "t/laser3_7_laser.png", False),  # in one folder the names must be the same
        ("t/seven.png", "l/laser7.png", False),
        ("t/pose7.png", "l/seven.png", False),
    ],
)
def test_pairs_by_name_or_by_last_number(target: str, laser: str, expected: bool) -> None:
    assert laser_images._is_pair(Path(target), Path(laser)) is expected


def test_the_line_runs_along_its_longer_axis() -> None:
    """Light below a quarter of the largest, and light off the target, do not count; equal spreads are columns."""

    def light(*places: tuple[int, int, float]) -> LightImage:
        image = np.zeros((40, 60), np.float32)
        for row, column, level in places:
            image[row, column] = level
        inside = np.ones(image.shape, bool)
        inside[:, 50:] = False
        return LightImage(image, inside, np.zeros(image.shape, bool))

    wide, tall = [(20, 10, 80.0), (20, 24, 80.0)], [(10, 20, 80.0), (24, 20, 80.0)]
    assert line_direction([light(*wide)]) == "columns"
    assert line_direction([light(*tall)]) == "rows"
    assert line_direction([light(*wide), light(*tall)]) == "columns"
    assert line_direction([light(*wide), light((8, 20, 80.0), (24, 20, 80.0))]) == "rows"
    assert line_direction([light(*tall, (17, 0, 19.0), (17, 49, 19.0))]) == "rows"
    assert line_direction([light(*tall, (17, 0, 21.0), (17, 49, 21.0))]) == "columns"
    assert line_direction([light(*tall, (17, 50, 80.0), (17, 59, 80.0))]) == "rows"
    assert line_direction([light(), light(*tall)]) == "rows"


def test_three_images_of_each_kind_give_the_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the target and of the block; places of the block without a laser image do not count."""
    monkeypatch.setattr(calibrating_sensor, "target_light", lambda *given: given)
    monkeypatch.setattr(calibrating_sensor, "image_light", lambda *given: given)
    lit: Any = [(f"target {n}", f"laser {n}") for n in range(5)]
    names: Any = tuple(f"block {n}" for n in range(6))
    lights: Any = (None, *(f"light {n}" for n in range(1, 6)))
    block = ImagePairs(names, lights)
    channel: Any = "red"
    targets = [(f"target {n}", f"laser {n}", "red") for n in range(3)]
    blocks = [(f"block {n}", f"light {n}", "red") for n in range(1, 4)]
    assert [*calibrating_sensor._first_lights(lit, None, channel)] == targets
    assert [*calibrating_sensor._first_lights(lit, block, channel)] == targets + blocks
    assert [*calibrating_sensor._first_lights([], block, channel)] == blocks
