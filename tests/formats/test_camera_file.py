"""Camera files: the size of the calibrated images, and images that show a part of the sensor."""

from __future__ import annotations

from pathlib import Path

import pytest

from gpuvision.formats.camera_file import check_calibrated_size, read_calibrated_size
from gpuvision.schema import DescriptionError


def test_size_of_the_calibrated_images(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    for text, size in (("", None), ("[image]\n", None), ("[image]\nsize = [640, 480.0]\n", (640, 480))):
        path.write_text(text, encoding="utf-8")
        assert read_calibrated_size(path) == size
    path.write_text("[image]\nsize = [1, 1]\n", encoding="utf-8")
    assert read_calibrated_size(path) == (1, 1)
    for size in ("[0, 480]", "[640, 0]", "[640.5, 480]", "[640, 480.5]", "[-640, 480]"):
        path.write_text(f"[image]\nsize = {size}\n", encoding="utf-8")
        with pytest.raises(DescriptionError, match="expected two whole numbers of pixels above 0"):
            read_calibrated_size(path)


def test_images_of_the_whole_sensor() -> None:
    check_calibrated_size("a.png", (640, 480), None)
    check_calibrated_size("a.png", (640, 480), (640, 480))
    for size in ((480, 640), (640, 479), (641, 480)):
        message = rf"a\.png: {size[0]} x {size[1]} pixels, the model was calibrated at 640 x 480; use another"
        with pytest.raises(ValueError, match=message):
            check_calibrated_size("a.png", size, (640, 480), hint="use another")
    with pytest.raises(ValueError, match="give the window and the binning"):
        check_calibrated_size("a.png", (1, 1), (640, 480))


def test_images_of_a_part() -> None:
    """The window, times the binning, lies within the calibrated image."""
    for window, binning in (((0, 0), 2), ((40, 80), 2), ((340, 0), 1), ((0, 280), 1)):
        check_calibrated_size("a.png", (300, 200), (640, 480), (window, binning))
    for window, binning in (((41, 80), 2), ((40, 81), 2), ((-1, 0), 1), ((0, -1), 1), ((341, 0), 1), ((0, 281), 1)):
        with pytest.raises(ValueError, match=rf"with binning {binning} ends at \(.*\), outside"):
            check_calibrated_size("a.png", (300, 200), (640, 480), (window, binning))
    check_calibrated_size("a.png", (640, 480), (640, 480), ((0, 0), 1))
    with pytest.raises(ValueError, match=r"ends at \(641, 480\)"):
        check_calibrated_size("a.png", (640, 480), (640, 480), ((1, 0), 1))
