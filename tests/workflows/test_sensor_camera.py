"""Camera of a sensor from a file: its summary, its report and its warnings."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.workflows import sensor_camera
from gpuvision.workflows.sensor_camera import KnownCamera, known_camera

RESIDUALS = (np.array([[3.0, 4.0], [0.0, 0.0]]), np.array([[0.0, 1.0], [-1.0, 0.0], [2.0, -2.0]]))


def _known(**changes: Any) -> KnownCamera:
    values: dict[str, Any] = {
        "file": Path("folder/camera.toml"),
        "names": ("f", "cx"),
        "covariance": np.array([[4.0, 1.0], [1.0, 9.0]]),
        "pattern": "dots",
        "image_size": (640, 480),
        "detected_targets": tuple(
            SimpleNamespace(points=count, image=Path(f"folder/{name}.png")) for name, count in (("a", 2), ("b", 3))
        ),
        "skipped_images": ((Path("folder/c.png"), "too dark"),),
        "residuals": RESIDUALS,
    }
    return KnownCamera(**(values | changes))


def test_summary_and_report() -> None:
    """Squared lengths 25, 0, 1, 1 and 8: a mean of 7."""
    known = _known()
    assert known.rms_px == pytest.approx(np.sqrt(7.0))
    assert known.summary() == "camera of camera.toml; dots in 2 of 3 images, 5 points: residual 2.65 px rms"
    report = json.loads(json.dumps(known.report()))
    first, second = report.pop("images")
    assert (first["name"], second["name"]) == ("a.png", "b.png")
    assert [first["rms_px"], second["rms_px"]] == pytest.approx([np.sqrt(12.5), np.sqrt(10.0 / 3.0)])
    assert report == {
        "file": "camera.toml",
        "pattern": "dots",
        "image_size": [640, 480],
        "rms_px": pytest.approx(np.sqrt(7.0)),
        "covariance": {"names": ["f", "cx"], "matrix": [[4.0, 1.0], [1.0, 9.0]]},
        "skipped_images": {"c.png": "too dark"},
        "warnings": [],
    }


def test_a_camera_without_covariance_is_exact() -> None:
    (warning,) = _known(names=(), covariance=np.zeros((0, 0))).warnings
    assert warning.startswith("camera.toml has no table [covariance]: the camera counts as exact")


def test_images_of_another_size_name_the_first_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sensor_camera, "read_calibrated_camera", lambda _: SimpleNamespace(size=(640, 480)))
    images = tuple(SimpleNamespace(image=Path(f"folder/{name}.png")) for name in "abc")
    views: Any = SimpleNamespace(detected=images, size=(320, 240))
    with pytest.raises(
        ValueError, match=r"a\.png.*320 x 240.*640 x 480.*take images of the whole sensor, or calibrate"
    ):
        known_camera(views, Path("camera.toml"))
