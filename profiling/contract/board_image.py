"""Contract of rendered boards: reflectances and grey levels with noise, motion, a mirrored view, poses off the map."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.profiling.contract.agreement import Case, equal, roundings
from gpuvision.reference import board_image as reference
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

_SENSOR = "with a sensor"
_NODES, _SHAPE = (48, 64), (40, 37)
_CELL, _PIXEL = 2.5e-6, 10e-6  # [m]
_REFLECTANCE = roundings(
    8, "image", of="nodes along the map x reflectance of white",
    reason="places in x and y, each of four half epsilons of the map's size, times a slope of white for each node",
)  # fmt: skip
LIMITS = {
    "RenderBoard": (
        _REFLECTANCE,
        equal(
            "image", when=_SENSOR,
            reason="grey levels are rounded to nearest, except within the limit of the reflectance of a half; the "
            "random numbers are integers before their logarithm and cosine",
        ),
    )
}  # fmt: skip
_LEVELS = {
    "dark_noise": 12.0, "full_well": 9000.0, "gain": 0.03, "dark_level": 4.0, "max_level": 255.0, "nonlinearity": 0.0,
}  # fmt: skip
_WHITE, _SEED = 8000.0, 77  # electrons of white, and seed of the noise


def cases() -> Iterator[Case]:
    """Yield reflectances and grey levels of a random map."""
    values = np.random.default_rng(35).integers(0, 65536, _NODES).astype(np.uint16)
    board = ReflectanceMap(values=values, origin=(-8e-5, -6e-5), cell=_CELL, pixel=_PIXEL, blur_px=0.5)
    still = np.array([[[1e-5, 2e-5, 0.3]], [[-2e-5, 1e-5, -2.0]], [[1e-3, -1e-3, 0.0]]], np.float32)
    moving = still[:2] + np.array([(0.0, 0.0, 0.0), (4e-6, 1e-6, 0.01), (8e-6, 2e-6, 0.02)], np.float32)
    for name, poses, mirrored in (("still", still, False), ("moving", moving, True)):
        yield _case(f"reflectance, {name}", board, poses, mirrored=mirrored)
        yield _case(f"grey levels, {name}", board, poses, mirrored=mirrored, sensor=_sensor())


def _sensor() -> CmosSensor:
    return CmosSensor(
        rows=64,
        columns=64,
        pitch=5e-6,
        quantum_efficiency=0.6,
        bits=8,
        dark_noise=_LEVELS["dark_noise"],
        full_well=_LEVELS["full_well"],
        gain=_LEVELS["gain"],
        dark_level=_LEVELS["dark_level"],
    )


def _case(name: str, board: ReflectanceMap, poses: npt.NDArray[Any], *, mirrored: bool, sensor: Any = None) -> Case:
    seen = np.stack([
        reference.reflectance(
            board.values, board.origin, board.cell, board.pixel, reference.centred_pixels(_SHAPE), each,
            mirrored=mirrored,
        )
        for each in poses.astype(np.float64)
    ])  # fmt: skip
    numbers = np.array([5, 2**32 - 1, 12][: len(poses)], np.uint32)
    quantity = float(max(_NODES))
    if sensor is None:
        operation = RenderBoard(board=board, shape=_SHAPE, mirrored=mirrored)
        return Case("RenderBoard", name, operation, (poses, numbers), {"image": seen}, {"image": quantity})
    noise = [reference.normal_numbers(_SHAPE, number, _SEED) for number in numbers.tolist()]
    levels = np.stack([reference.grey_levels(_WHITE * each, n, _LEVELS) for each, n in zip(seen, noise, strict=True)])
    # The level changes by white times the gain with the reflectance; noise and sums add roundings of all electrons.
    limit = _REFLECTANCE.single * (quantity + 1.0) * _WHITE * _LEVELS["gain"]
    undecided = np.abs(levels - np.floor(levels) - 0.5) <= limit
    operation = RenderBoard(board=board, shape=_SHAPE, mirrored=mirrored, sensor=sensor, electrons=_WHITE, seed=_SEED)
    return Case(
        "RenderBoard", name, operation, (poses, numbers), {"image": np.rint(levels)}, {}, undecided, when=_SENSOR
    )
