"""Undistortion of files: the part of the plane that an image shows, and what each kind of file becomes."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

from gpuvision.host.errors import RecordingError
from gpuvision.workflows import undistorting
from gpuvision.workflows.undistorting import frame_region, undistort_files


def affine(xx: float, xy: float, x: float, yx: float, yy: float, y: float) -> Any:
    """Return a model whose correction is an affine map."""
    matrix, shift = np.array([[xx, xy], [yx, yy]]), np.array([x, y])
    return SimpleNamespace(undistort=lambda pixels: pixels @ matrix.T + shift)


@pytest.mark.parametrize(
    ("frame", "region"),
    # The corners of 20 x 11 pixels are at (-2.3, 1.7), (18.6, -0.2), (20.6, 8.8) and (-0.3, 10.7).
    [("same", (0, 0, 20, 11)), ("all", (-3, -1, 25, 13)), ("valid", (0, 2, 19, 7))],
)
def test_part_of_the_plane(frame: Any, region: tuple[int, ...]) -> None:
    assert frame_region(affine(1.1, 0.2, -2.3, -0.1, 0.9, 1.7), (20, 11), frame) == region


@pytest.mark.parametrize(
    ("model", "size", "frame", "region"),
    [
        (affine(7.0, 0.0, 0.0, 0.0, 7.0, 0.0), (2, 2), "all", (0, 0, 8, 8)),  # 16 times the pixels
        (affine(4.0, 0.0, 0.0, 0.0, 9.0, 0.0), (3, 2), "all", (0, 0, 9, 10)),
        (affine(0.4, 0.0, 0.9, 0.0, 1.0, 0.0), (3, 3), "valid", (1, 0, 1, 3)),  # one column
    ],
)
def test_largest_and_smallest_part(model: Any, size: tuple[int, int], frame: Any, region: tuple[int, ...]) -> None:
    assert frame_region(model, size, frame) == region


@pytest.mark.parametrize(
    ("model", "size", "frame", "message"),
    [
        (affine(7.5, 0.0, 0.0, 0.0, 7.0, 0.0), (2, 2), "all", "frame 'all': it would have 9 x 8 pixels"),
        (affine(0.4, 0.0, 0.1, 0.0, 1.0, 0.0), (3, 3), "valid", "frame 'valid': it would have 0 x 3 pixels"),
        (affine(1.0, 0.0, 0.0, 0.0, 0.4, 0.1), (3, 3), "valid", "frame 'valid': it would have 3 x 0 pixels"),
        (affine(np.nan, 0.0, 0.0, 0.0, 1.0, 0.0), (3, 3), "valid", "frame 'valid': the image's border lies past"),
    ],
)
def test_parts_that_no_image_shows_are_refused(model: Any, size: tuple[int, int], frame: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        frame_region(model, size, frame)


@pytest.fixture
def inputs(tmp_path: Path) -> list[Path]:
    """A grey image with an odd size, a colour image of floats, and points."""
    cv2.imwrite(str(tmp_path / "grey.png"), np.arange(15, dtype=np.uint8).reshape(3, 5))
    colour = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    tifffile.imwrite(tmp_path / "colour.tiff", colour, photometric="rgb")
    np.save(tmp_path / "points.npy", np.arange(6.0).reshape(3, 2))
    return [tmp_path / name for name in ("grey.png", "colour.tiff", "points.npy")]


@pytest.mark.parametrize("window", [None, (7, 9)])
@pytest.mark.parametrize("binning", [1, 2])
def test_each_kind_of_file(
    inputs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, window: tuple[int, int] | None, binning: int
) -> None:
    """Grey images become PNG, floats TIFF, points stay points; a part of the sensor has its own model."""
    part = affine(2.0, 0.0, 1.0, 0.0, 3.0, 0.0)
    whole = SimpleNamespace(in_window=lambda *given: parts.append(given) or part)
    parts: list[Any] = []
    checked: list[Any] = []
    seen: list[Any] = []
    monkeypatch.setattr(undistorting, "check_calibrated_size", lambda *given: checked.append(given))
    monkeypatch.setattr(undistorting, "_undistorted_points", lambda file, model, device: np.load(file) + 1.0)

    def undistorted(image: Any, model: Any, device: Any, options: Any) -> Any:
        seen.append((image.shape, model, device, dict(options)))
        return image + np.asarray(1, image.dtype)

    monkeypatch.setattr(undistorting, "_undistorted_image", undistorted)
    steps: list[Any] = []
    is_part = window is not None or binning > 1
    written = undistort_files(
        inputs,
        whole if is_part else part,  # type: ignore[arg-type]
        tmp_path / "out",
        device="a device",  # type: ignore[arg-type]
        frame="all",
        calibrated_size=(640, 480),
        window=window,
        binning=binning,
        progress=lambda *given: steps.append(given),
    )
    assert written == tuple(tmp_path / "out" / name for name in ("grey.png", "colour.tif", "points.npy"))
    assert steps == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert parts == ([(window or (0, 0), binning)] if is_part else [])
    shown = (window or (0, 0), binning) if is_part else None
    assert checked == [
        (inputs[0], (5, 3), (640, 480), shown),
        (inputs[1], (4, 2), (640, 480), shown),
    ]
    # 5 x 3 pixels reach from (1, 0) to (9, 6), 4 x 2 pixels from (1, 0) to (7, 3).
    assert [each[3]["region"] for each in seen] == [(1, 0, 9, 7), (1, 0, 7, 4)]
    assert [each[:3] for each in seen] == [((3, 5), part, "a device"), ((2, 4, 3), part, "a device")]
    np.testing.assert_array_equal(cv2.imread(str(written[0]), cv2.IMREAD_UNCHANGED).ravel(), np.arange(15) + 1)
    np.testing.assert_array_equal(tifffile.imread(written[1]), tifffile.imread(inputs[1]) + 1.0)
    np.testing.assert_array_equal(np.load(written[2]), np.arange(6.0).reshape(3, 2) + 1.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"binning": 0}, "binning is 0, expected a whole number of 1 or more"),
        ({"frame": "all", "region": (0, 0, 1, 1)}, "frame 'all' and region both choose the part of the image"),
    ],
)
def test_settings_that_do_not_fit_are_refused(
    inputs: list[Path], tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        undistort_files(inputs, affine(1, 0, 0, 0, 1, 0), tmp_path / "out", device="", **options)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_inputs_of_one_name_and_missing_inputs_are_refused(inputs: list[Path], tmp_path: Path) -> None:
    model: Any = affine(1, 0, 0, 0, 1, 0)
    twice = [*inputs, tmp_path / "other" / "grey.tif"]
    with pytest.raises(RecordingError, match="several inputs have the name grey; undistort them into separate"):
        undistort_files(twice, model, tmp_path / "out", device="")  # type: ignore[arg-type]
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such file"):
        undistort_files([tmp_path / "none.png"], model, tmp_path / "out", device="")  # type: ignore[arg-type]


def test_an_image_that_no_png_holds_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imencode", lambda *_: (False, None))
    with pytest.raises(ValueError, match=r"cannot encode an image of shape \(2, 3\) as PNG, the format of a\.png"):
        undistorting._write(tmp_path / "a.png", np.zeros((2, 3)))
