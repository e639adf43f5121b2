"""Renderer of the images that the camera of a placement machine sees."""

from __future__ import annotations

from gpuvision.servoing.placement.machine import PlacementCamera
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap


def board_renderer(board: ReflectanceMap, camera: PlacementCamera, *, noise: bool = True, seed: int = 0) -> RenderBoard:
    """Return the operation that renders a board as a camera sees it.

    Parameters
    ----------
    board : ReflectanceMap
        Board in view.
    camera : PlacementCamera
        Window, sensor, lens, light and side of the board.
    noise : bool
        Add the noise of the sensor. Default True.
    seed : int
        Seed of the noise. Default 0.
    """
    return RenderBoard(
        board=board,
        shape=camera.window,
        mirrored=camera.mirrored,
        model=camera.window_lens,
        sensor=camera.sensor,
        electrons=camera.white_electrons,
        exposure=camera.exposure,
        noise=noise,
        seed=seed,
    )
