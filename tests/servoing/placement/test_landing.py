"""Start poses of the coarse registration: the target and four corners of the landing zone."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from gpuvision.servoing.frames import compose_poses
from gpuvision.servoing.placement import landing
from gpuvision.status import Status

STATUSES = [Status.OK, Status.AMBIGUOUS, Status.NOT_CONVERGED, Status.LOW_SIGNAL, Status.OK]


class Search:
    """Coarse registration of an image, which is its number."""

    def __call__(self, image: int, device: Any) -> Any:
        return SimpleNamespace(status=STATUSES[image])


def test_flags_of_the_refused_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The nozzle starts at each of the corners, each angle with each side; the board covers all views."""
    calibrated, pose = np.array([3e-3, -2e-3, 0.2]), np.array([0.1, 0.2, 0.5])
    rendered: list[np.ndarray] = []
    regions: list[Any] = []
    changed: list[tuple[Any, dict[str, Any]]] = []

    def render(poses: np.ndarray, seeds: np.ndarray, device: Any) -> Any:
        rendered.append(poses)
        assert seeds.tolist() == [0] * 5
        return SimpleNamespace(image=np.arange(5))

    monkeypatch.setattr(landing.ReflectanceMap, "of", lambda artwork, **how: regions.append(how))
    monkeypatch.setattr(landing, "board_renderer", lambda board, camera, noise: render)

    def recorded(camera: Any, **changes: Any) -> Any:
        changed.append((camera, changes))
        return camera

    monkeypatch.setattr(landing, "replace", recorded)
    machine: Any = SimpleNamespace(
        camera=SimpleNamespace(window=(300, 400), pixel=1e-5, blur_px=0.7),
        tolerance=SimpleNamespace(landing_zone=1e-3, landing_angle=0.1),
        pipette_in_camera=SimpleNamespace(pose=calibrated),
    )
    search: Any = Search()
    artwork: Any = None
    assert landing.refused_starts(artwork, pose, machine, search) == [Status.AMBIGUOUS, Status.LOW_SIGNAL]
    # The ideal images have no distortion.
    assert changed == [(machine.camera, {"lens": None})]
    (poses,) = rendered
    nozzle = compose_poses(poses[:, 0], calibrated) - compose_poses(pose, calibrated)
    signs = nozzle / [0.9e-3, 0.9e-3, 0.09]
    np.testing.assert_allclose(signs, np.round(signs), atol=1e-9)
    expected = {(0, 0, 0), (1, 1, 1), (-1, 1, -1), (1, -1, -1), (-1, -1, 1)}
    assert {tuple(int(each) for each in row) for row in np.round(signs)} == expected
    # Half of the diagonal of the window: 250 px.
    low, high = regions[0]["region"]
    np.testing.assert_allclose(low, poses[:, 0, :2].min(axis=0) - 2.5e-3)
    np.testing.assert_allclose(high, poses[:, 0, :2].max(axis=0) + 2.5e-3)
    assert (regions[0]["pixel"], regions[0]["blur_px"]) == (1e-5, 0.7)
