"""Exposure for a wanted precision of edges: closed forms, motion, and edges that are measured in rendered images."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from bare_boards import board_of
from gpuvision.camera.cmos_sensor import CmosSensor
from gpuvision.host import Device
from gpuvision.matching.artwork.board_reflectance import BoardReflectance
from gpuvision.matching.features.exposure import sensor_imaging, smallest_exposure
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.simulation.board_image.board_image import RenderBoard
from gpuvision.simulation.board_image.reflectance_map import ReflectanceMap

PIXEL = 20e-6
SENSOR = CmosSensor(
    rows=480,
    columns=640,
    pitch=8e-6,
    quantum_efficiency=0.5,
    gain=0.05,
    dark_noise=25.0,
    full_well=20e3,
    bits=10,
    dark_current=1e4,
)
BOARD = BoardReflectance(laminate=0.3, copper=0.7, laminate_masked=0.2, copper_masked=0.4)
WORSE = math.sqrt(3 / 8 * 6**3 / 5**2.5)  # of rulers at best smoothing over the Cramer-Rao bound


def test_contrast_is_the_step_over_the_noise() -> None:
    imaging = sensor_imaging(SENSOR, pixel=PIXEL, white_electrons=10e3, reflectance=BOARD, exposure=1e-3, width_px=7)
    rest = 25.0**2 + 20.0**2 / 12 + 10.0
    assert imaging.contrast_bare == pytest.approx(4000.0 / math.sqrt(5000.0 + rest))
    assert imaging.contrast_masked == pytest.approx(2000.0 / math.sqrt(3000.0 + rest))
    assert (imaging.width_px, imaging.pixel) == (7, PIXEL)


@pytest.mark.parametrize("wanted", [0.02, 0.1])
def test_the_smallest_exposure_solves_the_quadratic_equation(wanted: float) -> None:
    """(k S)^2 (m t + c) = (a t)^2 with the step rate a, the mean rate m and the fixed variance c."""
    found = smallest_exposure(SENSOR, wanted, irradiance=2.0, pixel=PIXEL, reflectance=BOARD, blur_px=0.8, width_px=9)
    white = float(SENSOR.electrons(2.0, 1.0))
    step, mean, fixed = 0.2 * white, 0.3 * white + 1e4, 25.0**2 + 20.0**2 / 12
    factor = (WORSE * math.sqrt(2.0 * math.sqrt(math.pi)) * math.sqrt(0.8) / (3.0 * wanted)) ** 2
    a, b, c = step**2, factor * mean, factor * fixed
    assert found == pytest.approx((b + math.sqrt(b * b + 4 * a * c)) / (2 * a), rel=1e-6)


def test_motion_makes_long_exposures_worse() -> None:
    options = {"irradiance": 2.0, "pixel": PIXEL, "reflectance": BOARD}
    still = smallest_exposure(SENSOR, 0.06, **options)
    moving = smallest_exposure(SENSOR, 0.06, speed=0.05, **options)
    assert still < moving < 1.5 * still
    with pytest.raises(ValueError, match=r"no exposure reaches 0\.06 px: the best, .* give more light"):
        smallest_exposure(SENSOR, 0.06, speed=5.0, **options)
    with pytest.raises(ValueError, match="no exposure reaches"):
        smallest_exposure(SENSOR, 1e-4, **options)
    bare = smallest_exposure(SENSOR, 0.06, bare=True, **options)
    assert bare < still


def test_wrong_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="saturates at 2e"):
        sensor_imaging(SENSOR, pixel=PIXEL, white_electrons=30e3)
    with pytest.raises(ValueError, match="no contrast"):
        sensor_imaging(SENSOR, pixel=PIXEL, white_electrons=1e3, reflectance=replace(BOARD, copper=0.3))
    direct = replace(SENSOR, pixel="direct_read", response_time=1e-5)
    with pytest.raises(ValueError, match="no exposure; the response time determines their noise"):
        smallest_exposure(direct, 0.1, irradiance=1.0, pixel=PIXEL)


@pytest.mark.slow
def test_edges_of_rendered_images_have_the_predicted_precision(device: Device, rng: np.random.Generator) -> None:
    """Rulers across one straight edge at places anywhere between the pixels, with the noise of the sensor."""
    half = 1e-3 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 3.0], [-1.0, 3.0]])
    board = ReflectanceMap.of(
        board_of(half),
        pixel=PIXEL,
        region=((0.0, 0.0), (2e-3, 2e-3)),
        blur_px=0.9,
        reflectance=BOARD,
    )
    white = 2500.0
    op = RenderBoard(board=board, shape=(60, 64), sensor=SENSOR, electrons=white)
    blur = math.hypot(0.9, math.sqrt(1 / 12))
    imaging = sensor_imaging(SENSOR, pixel=PIXEL, white_electrons=white, reflectance=BOARD, blur_px=blur)
    ruler = RulerEdges(threshold=10.0, smoothing_px=imaging.smoothing_px, width=imaging.width_px, length=32)
    rulers = np.array([[31.5, row, 1.0, 0.0] for row in range(4, 56, 6)], np.float32)
    errors = []
    for number in range(150):
        x = 1e-3 + rng.uniform(-PIXEL, PIXEL)
        image = op(np.array([[[x, 1e-3, 0.0]]]), np.array([number], np.uint32), device=device).image[0]
        errors.append(ruler(image, rulers, device=device).position - (1e-3 - x) / PIXEL)
    measured = float(np.std(errors))
    assert measured == pytest.approx(float(imaging.sigma(True)) / PIXEL, rel=0.1)
    assert abs(np.mean(errors)) < 4 * measured / math.sqrt(np.size(errors)) + 0.002


@pytest.mark.parametrize("name", ["sigma_px", "irradiance", "speed"])
def test_ranges_of_an_exposure(name: str) -> None:
    """The standard deviation and the irradiance are above 0; without a speed there is no motion blur."""
    given: dict[str, Any] = {"sigma_px": 0.06, "irradiance": 2.0, "speed": 0.0}
    for value in (-5e-324, math.nan) if name == "speed" else (0.0, -5e-324, math.nan):
        options = given | {name: value}
        with pytest.raises(ValueError, match=name):
            smallest_exposure(SENSOR, options.pop("sigma_px"), pixel=PIXEL, **options)
