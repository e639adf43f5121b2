"""A described sensor as the simulator takes it: what it sees, its sheet of light, and what reads the light."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import ELECTRON, PsdReadout
from gpuvision.ranging.range_image import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.sensor.light_source import Light
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet

_CODES = 255.0


def light_of(sensor: Sensor) -> Light:
    """Return the sensor's light.

    Raises
    ------
    ValueError
        The sensor's file has none, or the sheet turns: a simulation needs a straight transport.
    """
    name = sensor.name or "the sensor"
    if not isinstance(sensor.transport, StraightTransport):
        raise ValueError(f"{name}: a simulation needs a straight transport, this one has a sheet that turns")
    if sensor.light is None:
        raise ValueError(
            f"{name}: its file has no table [light], which a simulation needs; see gpuvision.sensor.light_source"
        )
    if sensor.light.lens is None:
        raise ValueError(f"{name}: its file does not say where the pinhole is: light.lens, three numbers [m]")
    return sensor.light


def sheet_of(sensor: Sensor) -> LightSheet:
    """Return the sensor's sheet of light.

    Raises
    ------
    ValueError
        As `light_of`; or the light cannot be such.
    """
    light = light_of(sensor)
    return LightSheet(
        transport=_transport(sensor),
        power=light.power,
        sigma=light.thickness,
        source=light.source,
        g_limits=light.width,
        profile=light.profile,
    )


def sensor_view_of(sensor: Sensor) -> SensorView:
    """Return what the sensor sees: a PSD's strips, as wide as they lie apart, or a camera's columns of pixels.

    Raises
    ------
    ValueError
        As `light_of`.
    """
    light, readout = light_of(sensor), sensor.readout
    assert sensor.frame is not None  # a triangulation has a region, which came from it
    assert light.lens is not None  # the file says, or its baseline
    axes = readout.axes
    if isinstance(readout, PsdReadout):
        samples = sensor.frame[0]
        half = 0.5 * readout.strip_length
        positions: npt.NDArray[np.float64] = np.linspace(-half, half, light.bins + 1)
    else:
        length, samples = sensor.frame if readout.along == "columns" else sensor.frame[::-1]
        positions = np.arange(length + 1, dtype=np.float64) - 0.5
    return SensorView(
        triangulation=_triangulation(readout),
        transport=_transport(sensor),
        lens=light.lens,
        u_edges=_ascending(axes.position_origin + axes.position_pitch * positions),
        v_edges=_ascending(axes.sample_origin + axes.sample_pitch * (np.arange(samples + 1) - 0.5)),
        aperture=light.aperture,
    )


def floor_of(sensor: Sensor) -> float:
    """Return the power of a sample below which it is not read, W.

    Of a PSD, what makes the least total current; of a camera, what makes the least peak, or the threshold.
    """
    light, readout = light_of(sensor), sensor.readout
    if isinstance(readout, PsdReadout):
        return readout.minimum_total / light.responsivity
    grey = max(readout.minimum_peak or 0.0, readout.threshold)
    return grey * light.full_well / _CODES * ELECTRON / (light.responsivity * light.exposure)


def simulator_of(sensor: Sensor, view: SensorView, mask: Mask | None = None) -> PsdSimulator | CameraSimulator:
    """Return what makes readings of the light.

    Raises
    ------
    ValueError
        As `light_of`; or the mask is not one for this sensor.
    """
    light, readout = light_of(sensor), sensor.readout
    if isinstance(readout, PsdReadout):
        return PsdSimulator(
            view=view,
            readout=readout,
            responsivity=light.responsivity,
            ambient=light.ambient,
            modulated=light.modulated,
            mask=mask,
            quantised=readout.ampere != 1.0,
        )
    return CameraSimulator(
        view=view,
        readout=readout,
        exposure_time=light.exposure,
        responsivity=light.responsivity,
        gain=_CODES / light.full_well,
        read_noise=light.read_noise,
        full_well=light.full_well,
        ambient=light.ambient,
        mask=mask,
    )


def _transport(sensor: Sensor) -> StraightTransport:
    assert isinstance(sensor.transport, StraightTransport)  # light_of looked
    return sensor.transport


def _triangulation(readout: PsdReadout | LineReadout) -> Triangulation:
    assert readout.triangulation is not None  # a straight transport's file has one
    return readout.triangulation


def _ascending(edges: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return edges if edges[0] < edges[-1] else edges[::-1].copy()
