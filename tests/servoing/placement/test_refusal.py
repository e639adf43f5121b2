"""Reasons why a target is refused: where the camera looks, the nearest target that works, and the smallest window."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.placement.machine import Machine
from gpuvision.servoing.placement.refusal import explain_refusal

# Slow enough for the whole sensor of 1024 x 1024 pixels.
MACHINE = read_machine("look_while_place", rate=20.0)
SIDE = 512 * MACHINE.camera.pixel
TARGET, CAMERA = np.array([10e-3, 20e-3, 0.5]), np.array([11e-3, 22e-3, 0.25])


def _artwork(*points: tuple[float, float]) -> Any:
    """Return pads, then starts and ends of edges, at points relative to the camera, in windows."""
    places = CAMERA[:2] + SIDE * np.array(points).reshape(-1, 2)
    third = len(places) // 3
    return SimpleNamespace(
        bounds=np.array([[1e-3, 2e-3], [30e-3, 40e-3]]),
        pads=tuple(SimpleNamespace(centre=each) for each in places[:third]),
        edges=SimpleNamespace(start=places[third : 2 * third], end=places[2 * third :]),
    )


def _always(pose: np.ndarray, machine: Machine) -> bool:
    return True


def _said(artwork: Any, works: Any, lands: Any = _always, reason: str = "too few edges; use more") -> list[str]:
    guidance = SimpleNamespace(works=works, lands=lands)
    return explain_refusal(reason, artwork, TARGET, CAMERA, MACHINE, guidance).split("; ")


def _never(pose: np.ndarray, machine: Machine) -> bool:
    return False


def test_target_window_and_board() -> None:
    said = _said(_artwork(), _never)
    side = f"{1e3 * SIDE:.2f}"
    assert said == [
        "target (10.000, 20.000) mm: too few edges",
        f"the camera window of {side} x {side} mm is centred at (11.000, 22.000) mm",
        "the board spans x 1.00 to 30.00 mm and y 2.00 to 40.00 mm",
    ]


def test_the_nearest_target_that_works() -> None:
    """Points are tried from the nearest one on, and none within a quarter of a window of one that does not work."""
    tried: list[np.ndarray] = []
    points = ((2.0, 0.0), (0.0, -1.0), (0.0, -1.2), (0.0, -1.26), (-0.5, 0.0), (0.0, 3.0))

    def works(pose: np.ndarray, machine: Machine) -> bool:
        assert machine is MACHINE or machine.camera.window != (512, 512)
        tried.append((pose[:2] - CAMERA[:2]) / SIDE)
        assert pose[2] == CAMERA[2]
        return bool(pose[0] > CAMERA[0] + SIDE)

    said = _said(_artwork(*points), works)
    np.testing.assert_allclose(tried[:4], [(-0.5, 0.0), (0.0, -1.0), (0.0, -1.26), (2.0, 0.0)], atol=1e-9)
    x, y = 1e3 * (TARGET[:2] + SIDE * np.array([2.0, 0.0]))
    assert said[3] == f"the nearest target found that has enough edges in view is ({x:.3f}, {y:.3f}) mm"


def test_forty_targets_are_tried() -> None:
    far = [(float(k), 0.0) for k in range(1, 43)]
    for last, is_found in ((40, True), (41, False)):
        limit = CAMERA[0] + (last - 0.5) * SIDE
        said = _said(_artwork(*far), lambda pose, machine, limit=limit: bool(pose[0] > limit))
        assert any("nearest target" in each for each in said) == is_found


def test_the_smallest_window_that_works() -> None:
    for least, window in ((513, 768), (768, 768), (769, 1024), (1024, 1024)):
        said = _said(_artwork(), lambda pose, machine, least=least: machine.camera.window[0] >= least)
        assert said[3] == f"a window of {window} x {window} px instead of 512 x 512 px has enough"
    # The sensor is not larger.
    assert len(_said(_artwork(), lambda pose, machine: machine.camera.window[0] > 1024)) == 3
    poses = []
    _said(_artwork(), lambda pose, machine: poses.append(pose))
    np.testing.assert_array_equal(poses, [CAMERA] * 2)


def test_the_coarse_registration_must_land_too() -> None:
    """Three targets at which features suffice are tried."""
    near = [(float(k), 0.0) for k in range(1, 7)]
    for last, is_found in ((3, True), (4, False)):
        limit = CAMERA[0] + (last - 0.5) * SIDE
        said = _said(_artwork(*near), _always, lambda pose, machine, limit=limit: bool(pose[0] > limit))
        assert any("nearest target" in each for each in said) == is_found
    said = _said(_artwork(), _always, lambda pose, machine: machine.camera.window[0] >= 1024)
    assert said[3] == "a window of 1024 x 1024 px instead of 512 x 512 px has enough"
