"""Inputs of the simulator from the shipped sensor files: light sheet, view, noise, least power and simulators."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gpuvision.ranging.sheet import SampleAxes
from gpuvision.schema import Section
from gpuvision.sensor.light_source import Light, read_light
from gpuvision.sensor.polygon import read_polygon
from gpuvision.sensor.sensor import Sensor
from gpuvision.sensor.simulated import (
    line_noise,
    make_light_sheet,
    make_sensor_view,
    make_simulator,
    minimum_sample_power,
    require_light,
)
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator

CHARGE = 1.602176634e-19  # C


def camera(*, light: dict[str, Any] | None = None, **readout: Any) -> Sensor:
    shipped = Sensor.load("camera_line")
    given: Any = shipped.readout
    assert shipped.light is not None
    return replace(shipped, readout=replace(given, **readout), light=replace(shipped.light, **(light or {})))


def psd(*, light: dict[str, Any] | None = None, **readout: Any) -> Sensor:
    shipped = Sensor.load("psd_line")
    given: Any = shipped.readout
    assert shipped.light is not None
    return replace(shipped, readout=replace(given, **readout), light=replace(shipped.light, **(light or {})))


@pytest.mark.parametrize(("peak", "grey", "automatic"), [(40.0, 40.0, 40.0), (None, 16.0, 4.0)])
def test_least_power_of_a_camera(peak: float | None, grey: float, automatic: float) -> None:
    """One grey level is 30 000 / 255 electrons, which take 5 us of light at 0.5 A/W; an estimated threshold is 4."""
    made = camera(light={"full_well": 30_000.0, "exposure": 5e-6, "responsivity": 0.5}, minimum_peak=peak)
    level = 30_000.0 / 255.0 * CHARGE / (0.5 * 5e-6)
    assert minimum_sample_power(made) == pytest.approx(grey * level, rel=1e-9)
    assert minimum_sample_power(replace(made, auto_threshold=True)) == pytest.approx(automatic * level, rel=1e-9)


def test_least_power_of_a_psd() -> None:
    assert minimum_sample_power(psd(light={"responsivity": 0.25}, minimum_total=6e-8)) == pytest.approx(24e-8)


def test_noise_of_a_camera_in_grey_levels() -> None:
    """A full well of 51 000 electrons is 255 grey levels: 0.005 for each electron."""
    noise = line_noise(camera(light={"full_well": 51_000.0, "read_noise": 30.0}))
    assert noise == pytest.approx({"read_noise": 0.15, "gain": 0.005})


@pytest.mark.parametrize(("ampere", "quantised"), [(50e-12, True), (1.0, False)])
def test_simulator_of_a_psd(ampere: float, quantised: bool) -> None:
    """Currents in codes are whole numbers, currents in amperes are not."""
    made = psd(light={"ambient": 3e-9, "modulated": True, "responsivity": 0.3}, ampere=ampere)
    view = make_sensor_view(made)
    found = make_simulator(made, view)
    assert isinstance(found, PsdSimulator)
    assert (found.view, found.readout, found.mask) == (view, made.readout, None)
    assert (found.responsivity, found.ambient, found.modulated, found.quantised) == (0.3, 3e-9, True, quantised)


@pytest.mark.parametrize("known", [False, True])
def test_simulator_of_a_camera(known: bool) -> None:
    """Without a noise model in the file the readout gets the noise of the light source."""
    light = {"ambient": 2.0, "exposure": 7e-6, "responsivity": 0.3, "full_well": 51_000.0, "read_noise": 30.0}
    made = replace(camera(light=light, read_noise=4.0, gain=0.5), noise_known=known)
    view = make_sensor_view(made)
    found = make_simulator(made, view)
    assert isinstance(found, CameraSimulator)
    readout = made.readout if known else replace(made.readout, read_noise=0.15, gain=0.005)
    assert (found.view, found.mask) == (view, None)
    assert replace(found.readout, saturation=None) == readout
    assert (found.exposure_time, found.responsivity, found.ambient) == (7e-6, 0.3, 2.0)
    assert (found.read_noise, found.full_well) == (30.0, 51_000.0)
    assert found.gain == pytest.approx(0.005)


def test_view_of_a_camera() -> None:
    """Edges lie half a pixel before and after each pixel, ascending; the longer side follows the line."""
    made = camera(axes=SampleAxes(position_origin=48.0, position_pitch=-1.0, sample_origin=-239.5, sample_pitch=2.0))
    view = make_sensor_view(made)
    np.testing.assert_allclose(view.u_edges, 48.5 - np.arange(64.0, -1.0, -1.0))
    np.testing.assert_allclose(view.v_edges, -240.5 + 2.0 * np.arange(481.0))
    assert view.lens == (0.0, 0.08, 0.15)
    assert view.aperture == 2e-3
    given: Any = made.readout
    assert view.triangulation == given.triangulation
    assert view.transport == made.transport
    turned = make_sensor_view(camera(along="rows", triangulation=replace(given.triangulation, along="rows")))
    assert (len(turned.u_edges), len(turned.v_edges)) == (481, 65)


def test_view_of_a_psd() -> None:
    """96 strips of 6 mm in 7 bins."""
    axes = SampleAxes(position_origin=1e-4, position_pitch=1.0, sample_origin=5.9375e-3, sample_pitch=-0.125e-3)
    view = make_sensor_view(psd(light={"bins": 7}, axes=axes))
    np.testing.assert_allclose(view.u_edges, 1e-4 + np.linspace(-3e-3, 3e-3, 8))
    np.testing.assert_allclose(view.v_edges, np.linspace(-6e-3, 6e-3, 97), atol=1e-15)
    assert view.aperture == 10e-3


def test_sheet_of_light() -> None:
    light = {"power": 3.0, "thickness": 50e-6, "source": (0.01, 0.2), "width": (-0.02, 0.03)}
    made = camera(light=light)
    sheet = make_light_sheet(made)
    assert sheet.transport == made.transport
    assert (sheet.power, sheet.sigma, sheet.profile) == (3.0, 50e-6, None)
    assert (sheet.source, sheet.g_limits) == ((0.01, 0.2), (-0.02, 0.03))


def test_a_simulation_needs_a_light_source_and_a_pinhole() -> None:
    made = camera()
    assert require_light(made) is made.light
    assert made.light is not None
    for changes, message in (
        ({"light": None}, "has no table"),
        ({"light": replace(made.light, lens=None)}, "does not say where the pinhole is"),
        ({"polygon": object()}, "point sensor behind a polygon mirror"),
        ({"transport": object()}, "needs a straight transport"),
    ):
        values: dict[str, Any] = changes
        with pytest.raises(ValueError, match=message) as refused:
            require_light(changed(made, values))
        assert str(refused.value).startswith(f"{made.name}: ")
        with pytest.raises(ValueError, match=r"^the sensor: "):
            require_light(changed(made, {**values, "name": ""}))


def changed(sensor: Sensor, values: dict[str, Any]) -> Any:
    """Return a copy with other attributes, without the checks of a sensor."""
    copied = object.__new__(Sensor)
    for name in sensor.__dataclass_fields__:
        object.__setattr__(copied, name, values.get(name, getattr(sensor, name)))
    return copied


def test_light_sources_read_and_made_have_the_same_defaults() -> None:
    found = read_light(Section({"aperture": 2e-3, "power": 0.5}, "sensor.toml"))
    made = Light(lens=None, aperture=2e-3, power=0.5)
    assert found == made
    assert (made.exposure, made.full_well, made.read_noise, made.responsivity) == (1e-3, 20_000.0, 0.0, 0.4)
    assert (made.thickness, made.sub_sheets, made.blur, made.bins, made.nodes) == (0.0, 1, 0.0, 64, (1, 1))
    assert (made.source, made.width, made.profile, made.patch_size) == (None, None, None, None)
    assert (made.ambient, made.modulated) == (0.0, False)


def test_a_mirror_that_reflects_no_sample_names_its_rotations() -> None:
    """Eight facets reflect the beam from -22.5 to 22.5 degrees at most; three samples are farther away."""
    values = {"apothem": 0.03, "facets": 8, "height": 0.2, "first_rotation": 1.0, "rotation_step": 0.25}
    with pytest.raises(ValueError, match=r"turns from 1 to 1\.5 rad, expected a part of .* where a facet reflects"):
        read_polygon(Section(values, "sensor.toml"), 3, None)
