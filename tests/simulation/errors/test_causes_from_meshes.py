"""Causes of errors, simulated from meshes: reflectivity steps, blades that occlude a beam, surface steps."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.ranging.psd import clipping_bias
from gpuvision.simulation.errors.error_attribution import ErrorAttribution, ReadingCategory, attribute_errors
from gpuvision.simulation.light_paths import LightPaths
from gpuvision.simulation.scene.material import Material
from gpuvision.simulation.scene.reflectance import Lambert
from gpuvision.simulation.scene.scene import Scene
from gpuvision.simulation.sensors.readings import GroundTruth, sheet_point
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.simulation.transport.direct import DirectLight
from gpuvision.simulation.transport.illumination import LightSheet
from gpuvision.status import Status
from lights import LENGTH, psd, psd_view

SIGMA = 5e-5
# The lens is 80 mm beside the sheet and 150 mm above the plane.
TAN = 0.08 / 0.15
WIDE = 0.05


def flat(y0: float, y1: float, z: float = 0.0) -> list[list[tuple[float, float, float]]]:
    """Return two triangles that face upwards."""
    a, b, c, d = (-WIDE, y0, z), (WIDE, y0, z), (WIDE, y1, z), (-WIDE, y1, z)
    return [[a, b, c], [a, c, d]]


def found(scene: Scene, albedos: list[float], slabs, device: Device) -> ErrorAttribution:
    """Attribute the errors of PSD strips with a thick sheet at y = 0."""
    view = psd_view(240)
    light = DirectLight(
        view=view,
        scene=scene,
        materials=[Material(diffuse=Lambert(albedo=each)) for each in albedos],
        sheet=LightSheet(transport=view.transport, sigma=SIGMA),
        sub_sheets=slabs,
        device=device,
    )
    exposures: dict[str, Exposure] = light.exposures(0.0, causes=True)
    level = GroundTruth(*np.zeros((2, view.samples)), np.zeros(view.samples, np.uint8))
    return attribute_errors(psd(view), exposures, level, device=device)


def test_reflectivity_step(device: Device) -> None:
    """The error is sigma (k - 1) phi(x) / (Phi(x) + k (1 - Phi(x))) over tan(theta), by reflectivity only."""
    x, k = 0.6, 5.0
    edge = x * SIGMA
    scene = Scene(corners=np.array(flat(-0.01, edge) + flat(edge, 0.01)), material=np.array([0, 0, 1, 1], np.int32))
    attribution = found(scene, [0.15, 0.15 * k], [-1.0, x, 1.5], device)
    phi = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    shift = SIGMA * (k - 1.0) * phi / (ndtr(x) + k * (1.0 - ndtr(x)))
    # Perspective over the beam's width: 50 um of 170 mm.
    np.testing.assert_allclose(np.abs(attribution.error), shift / TAN, rtol=2e-3)
    np.testing.assert_allclose(attribution.causes["reflectivity"], attribution.error, rtol=5e-3)
    np.testing.assert_allclose(attribution.causes["occlusion"], 0.0, atol=1e-9)
    # Strips average over a straight line: only perspective remains.
    np.testing.assert_allclose(attribution.causes["shape"], 0.0, atol=3e-3 * shift)


@pytest.mark.parametrize("end_bins", [0, 60])
@pytest.mark.parametrize("inside", [2.0, 1.0, 0.1, -1.0, -2.0])
def test_surfaces_at_the_end_of_the_strips(inside: float, end_bins: int, device: Device) -> None:
    """The end of the strips cuts the image of a plane: clipped, and beyond the end still a reading of the plane."""
    view = psd_view(240)
    u = 0.5 * LENGTH - inside * SIGMA
    height = float(sheet_point(view.triangulation, u, 0.0)[1])
    light = LightPaths(
        view=view,
        sheet=LightSheet(transport=view.transport),
        scene=Scene(corners=np.array(flat(-0.01, 0.01, height))),
        materials=[Material(diffuse=Lambert(albedo=0.5))],
        paths=("direct",),
        blur=SIGMA,
        end_bins=end_bins,
        device=device,
    ).profile(0.0)
    found = attribute_errors(psd(view), light.exposures, light.truth, device=device)
    np.testing.assert_array_equal(light.truth.status, Status.OK if inside >= 0.0 else Status.OUT_OF_RANGE)
    bias = float(clipping_bias(u, spot=SIGMA, strip_length=LENGTH))
    expected = sheet_point(view.triangulation, u + bias, 0.0)[1] - height
    if end_bins:
        np.testing.assert_allclose(light.truth.h, height, atol=1e-9)
        np.testing.assert_allclose(found.error, expected, rtol=1e-3)
        np.testing.assert_allclose(found.causes["clipped"], found.error, rtol=2e-3)
        assert (found.category == ReadingCategory.VALID).all()
    else:
        assert "clipped" not in found.causes
        assert (found.category == (ReadingCategory.VALID if inside >= 0.0 else ReadingCategory.NO_SURFACE)).all()


def test_blade_before_the_lens(device: Device) -> None:
    """A blade hides the beam up to x sigma from the lens: error sigma phi(x) / (1 - Phi(x)) / tan, by occlusion."""
    x = 0.4
    # An upright blade between the line and the lens, low enough for the ray from x sigma just to pass under it.
    lens, foot = np.array([0.0, 0.08, 0.15]), np.array([0.0, x * SIGMA, 0.0])
    _, y, z = foot + 0.1 * (lens - foot)
    a, b, c, d = (-WIDE, y, z), (WIDE, y, z), (WIDE, y, z + 0.03), (-WIDE, y, z + 0.03)
    scene = Scene(corners=np.array([*flat(-0.01, 0.02), [a, b, c], [a, c, d]]))
    attribution = found(scene, [0.5], [-1.0, x, 1.5], device)
    phi = np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi)
    np.testing.assert_allclose(np.abs(attribution.error), SIGMA * phi / ndtr(-x) / TAN, rtol=2e-3)
    np.testing.assert_allclose(attribution.causes["occlusion"], attribution.error, rtol=5e-3)
    np.testing.assert_allclose(attribution.causes["reflectivity"], 0.0, atol=1e-9)


def test_step_of_the_surface(device: Device) -> None:
    """Half of the beam on each level: read in the middle (shape); from the other side the step also occludes."""
    rise = 2e-4
    seen = found(Scene(corners=np.array(flat(-0.01, 0.0, rise) + flat(0.0, 0.01))), [0.5], [-1.0, 0.0, 1.0], device)
    np.testing.assert_allclose(seen.error, 0.5 * rise, rtol=5e-3)
    np.testing.assert_allclose(seen.causes["shape"], seen.error, rtol=1e-6 if device.has_double else 1e-5)
    other = found(Scene(corners=np.array(flat(-0.01, 0.0) + flat(0.0, 0.01, rise))), [0.5], 32, device)
    np.testing.assert_allclose(other.causes["shape"], 0.5 * rise, rtol=0.02)
    assert np.all(other.causes["occlusion"] > 0.1 * rise)


def test_part_in_the_shadow(device: Device) -> None:
    """Under a roof no surface is lit: no reading, category NO_SURFACE."""
    scene = Scene(corners=np.array(flat(-0.01, 0.01) + flat(-0.02, 0.02, 0.2)))
    attribution = found(scene, [0.5], 9, device)
    assert (attribution.category == ReadingCategory.MISSING).all()
    assert np.isnan(attribution.error).all()


@pytest.mark.parametrize("albedo", [1e-3, 1.0])
def test_even_surfaces_have_no_error(albedo: float, device: Device) -> None:
    attribution = found(Scene(corners=np.array(flat(-0.01, 0.01))), [albedo], 9, device)
    assert np.abs(attribution.error).max() < 1e-6
