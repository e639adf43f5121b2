"""Camera files: models, covariances, the size of the calibrated images, and images of a part of the sensor."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.camera import COEFFICIENT_NAMES, Camera
from gpuvision.camera.ground_plane import MountedCamera
from gpuvision.camera.lens import Lens
from gpuvision.formats.camera_file import (
    check_calibrated_size,
    covariance_table,
    read_calibrated_camera,
    read_calibrated_size,
    read_lens,
    read_mounted,
    write_lens,
)
from gpuvision.schema import DescriptionError

CAMERA = Camera(
    matrix=((900.0, 0.0, 321.0), (0.0, 905.0, 242.0), (0.0, 0.0, 1.0)),
    distortion=(*(1e-4 * number for number in range(1, 13)), 0.1, -0.2),
)
LENS = Lens(k1=1e-7, k2=-2e-14, k3=3e-21, k4=-4e-28, centre=(300.0, 200.0))


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


def test_every_coefficient_is_read(tmp_path: Path) -> None:
    for name, model in (("camera", CAMERA), ("lens", LENS)):
        write_lens(tmp_path / f"{name}.toml", model, {"image": {"size": [640, 480]}, "fit": {"rms_px": 0.1}})
        assert read_lens(tmp_path / f"{name}.toml") == model
    path = tmp_path / "one.toml"
    for place, coefficient in enumerate(COEFFICIENT_NAMES):
        path.write_text(
            f"[camera]\nmatrix = [[900, 0, 321], [0, 905, 242], [0, 0, 1]]\n{coefficient} = 0.25\n", encoding="utf-8"
        )
        expected = [0.25 * (place == number) for number in range(14)]
        assert read_lens(path) == Camera(matrix=CAMERA.matrix, distortion=tuple(expected))
    path.write_text("[lens]\nk1 = 1e-7\n", encoding="utf-8")
    assert read_lens(path) == Lens(k1=1e-7)


def test_a_file_has_one_model(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    for text in ("", "[image]\n", "[lens]\nk1 = 0.0\n[camera]\nmatrix = []\n"):
        path.write_text(text, encoding="utf-8")
        with pytest.raises(DescriptionError, match=r"expected one table, \[lens\] or \[camera\]"):
            read_lens(path)


def test_lens_and_pose_of_a_mounted_camera(tmp_path: Path) -> None:
    """The principal point is that of the file, of the lens, or the middle of the image, in this order."""
    path = tmp_path / "camera.toml"
    mount = "[mount]\nheight = 0.75\ntilt_degrees = 30\nroll_degrees = 6\nheading_degrees = -18\nfocal_px = 500\n"
    tilt, roll, heading = map(math.radians, (30.0, 6.0, -18.0))
    pose = {"height": 0.75, "tilt": tilt, "roll": roll, "heading": heading, "focal_px": 500.0}
    for lens, model in (("", None), ("[lens]\nk1 = 1e-7\ncentre = [300, 200]\n", Lens(k1=1e-7, centre=(300.0, 200.0)))):
        path.write_text(lens + mount, encoding="utf-8")
        middle = (319.5, 179.5) if model is None else (300.0, 200.0)
        found = read_mounted(path, (360, 640))
        assert found == MountedCamera(**pose, centre_px=middle, model=model)
        path.write_text(lens + mount + "centre_px = [310, 170]\n", encoding="utf-8")
        assert read_mounted(path, (360, 640)) == MountedCamera(**pose, centre_px=(310.0, 170.0), model=model)
    for tilt, height in ((-90, 1e-9), (90, 1e9)):
        path.write_text(f"[mount]\nheight = {height}\ntilt_degrees = {tilt}\nfocal_px = 1e-9\n", encoding="utf-8")
        if height > 1e6:
            with pytest.raises(DescriptionError, match=r"mount\.height is .* at most 1e\+06"):
                read_mounted(path, (360, 640))
        else:
            assert read_mounted(path, (360, 640)) is not None


def with_covariance(folder: Path, names: str, matrix: Any) -> Path:
    path = folder / "camera.toml"
    table = covariance_table(names.split(","), matrix)
    write_lens(path, CAMERA, {"covariance": table, "image": {"size": [640, 480]}}, overwrite=True)
    return path


def correlated(*correlations: float) -> np.ndarray:
    """Return the covariance of f, cx and k1 with these correlations of f cx, f k1 and cx k1."""
    matrix = np.eye(3)
    for (row, column), value in zip(((0, 1), (0, 2), (1, 2)), correlations, strict=True):
        matrix[row, column] = matrix[column, row] = value
    sigmas = np.array([2.0, 0.5, 1e-3])
    return matrix * np.outer(sigmas, sigmas)


def test_covariance_of_a_camera(tmp_path: Path) -> None:
    """Also of correlations of 1 and -1, whose smallest eigenvalue is 0; rounding does not matter."""
    rounded = correlated(0.9, 0.3, 0.2)
    rounded[0, 1] *= 1.0 + 5e-10
    for matrix in (correlated(0.6, -0.3, 0.2), correlated(1.0, -1.0, -1.0), rounded):
        found = read_calibrated_camera(with_covariance(tmp_path, "f,cx,k1", matrix))
        assert (found.camera, found.size, found.names) == (CAMERA, (640, 480), ("f", "cx", "k1"))
        np.testing.assert_array_equal(found.covariance, matrix)
    write_lens(tmp_path / "without.toml", CAMERA, {})
    found = read_calibrated_camera(tmp_path / "without.toml")
    assert (found.camera, found.size, found.names, found.covariance.shape) == (CAMERA, None, (), (0, 0))
    write_lens(tmp_path / "lens.toml", LENS, {})
    with pytest.raises(DescriptionError, match=r"\[lens\] is the distortion alone, expected a \[camera\]"):
        read_calibrated_camera(tmp_path / "lens.toml")


@pytest.mark.parametrize(
    ("names", "matrix", "message"),
    [
        ("f,cx,f", np.eye(3), "names is 'f,cx,f', expected different ones of f, fx, fy, cx, cy, k1"),
        ("f,cx,k7", np.eye(3), "names is 'f,cx,k7', expected different ones"),
        ("f,cx", np.eye(2)[:1], "matrix has 1 rows for 2 names"),
        ("f,cx", np.eye(2)[[0, 1, 1]], "matrix has 3 rows for 2 names"),
        ("f,cx,k1", np.diag([1.0, 0.0, 1.0]), "is no covariance"),
        ("f,cx,k1", np.diag([1.0, -1.0, 1.0]), "is no covariance"),
        ("f,cx,k1", np.eye(3) + 1e-8 * np.eye(3, k=1), "is no covariance"),
        ("f,cx", np.array([[1.0, 1.0 + 1e-8], [1.0 + 1e-8, 1.0]]), "is no covariance"),
        ("f,cx", np.array([[1.0, -1.0 - 1e-8], [-1.0 - 1e-8, 1.0]]), "is no covariance"),
        ("f,cx,k1", correlated(-0.51, -0.51, -0.51), "is no covariance"),
        ("f,cx,k1", correlated(-0.5 - 1e-8, -0.5, -0.5), "is no covariance"),
    ],
)
def test_other_tables_of_a_covariance_are_refused(tmp_path: Path, names: str, matrix: Any, message: str) -> None:
    with pytest.raises(DescriptionError, match=message):
        read_calibrated_camera(with_covariance(tmp_path, names, matrix))
