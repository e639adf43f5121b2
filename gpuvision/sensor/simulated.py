"""Inputs of the simulator from a sensor file: sensor view, sheet of light, and simulator of the readings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from gpuvision.ranging.background import LEAST_INTEGER_THRESHOLD
from gpuvision.ranging.focus_stack import FocusStack
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import ELECTRON, PsdReadout
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.sensor.light_source import Light
from gpuvision.sensor.sensor import Sensor
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.sensor_view import SensorView
from gpuvision.simulation.transport.illumination import LightSheet

_MAX_GREY_LEVEL = 255.0  # of an 8-bit camera: the full well


def require_light(sensor: Sensor) -> Light:
    """Return the light source of a sensor, complete for a simulation.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    Light
        With the position of the pinhole (``lens``).

    Raises
    ------
    ValueError
        The sensor file has no table ``[light]`` or no pinhole position, the transport is not straight, or a
        polygon mirror turns the beam.
    """
    name = sensor.name or "the sensor"
    if isinstance(sensor.readout, FocusStack):
        raise ValueError(f"{name}: a simulation needs a sheet of light, this one measures depth from focus")
    if not isinstance(sensor.transport, StraightTransport):
        raise ValueError(f"{name}: a simulation needs a straight transport, this one has a sheet that turns")
    if sensor.polygon is not None:
        raise ValueError(
            f"{name}: a simulation needs a sheet of light, this one is a point sensor behind a polygon mirror"
        )
    if sensor.light is None:
        raise ValueError(
            f"{name}: its file has no table [light], which a simulation needs; see gpuvision.sensor.light_source"
        )
    if sensor.light.lens is None:
        raise ValueError(f"{name}: its file does not say where the pinhole is: light.lens, three numbers [m]")
    return sensor.light


def make_light_sheet(sensor: Sensor) -> LightSheet:
    """Make the sheet of light of a sensor.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    LightSheet
        Power [W], thickness sigma [m] and limits [m] are read from the table ``[light]``.

    Raises
    ------
    ValueError
        As `require_light`; or `LightSheet` refuses a value of the table.
    """
    light = require_light(sensor)
    return LightSheet(
        transport=_transport(sensor),
        power=light.power,
        sigma=light.thickness,
        source=light.source,
        g_limits=light.width,
        profile=light.profile,
    )


def make_sensor_view(sensor: Sensor) -> SensorView:
    """Make the view of a sensor: the edges of its bins along u and of its samples along v.

    A sample is a strip of a PSD, as wide as the pitch of the strips, or a line of pixels of a camera.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    SensorView
        Edges in sensor units, ascending: ``light.bins`` bins over the length of a PSD strip, one bin per pixel of a
        camera.

    Raises
    ------
    ValueError
        As `require_light`.
    """
    light, readout = require_light(sensor), _readout(sensor)
    assert sensor.frame is not None  # the region of a triangulation is derived from the frame
    assert light.lens is not None  # require_light checked it
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


def minimum_sample_power(sensor: Sensor) -> float:
    """Return the power of a sample [W] below which the readout gives no position.

    PSD: ``minimum_total / responsivity``. Camera: the power whose photo-electrons in one exposure give the larger of
    ``minimum_peak`` and ``threshold``, ``grey full_well / 255 q / (responsivity exposure)``, with the charge q of an
    electron. An estimated threshold (``threshold = "auto"``) counts as its smallest value for integer frames.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    float
        Power [W].

    Raises
    ------
    ValueError
        As `require_light`.
    """
    light, readout = require_light(sensor), _readout(sensor)
    if isinstance(readout, PsdReadout):
        return readout.minimum_total / light.responsivity
    threshold = LEAST_INTEGER_THRESHOLD if sensor.auto_threshold else readout.threshold
    grey = max(readout.minimum_peak or 0.0, threshold)
    return grey * light.full_well / _MAX_GREY_LEVEL * ELECTRON / (light.responsivity * light.exposure)


def line_noise(sensor: Sensor) -> dict[str, float]:
    """Return the noise of a simulated camera in the units of the table ``[line]``.

    Parameters
    ----------
    sensor : Sensor

    Returns
    -------
    dict
        ``read_noise`` [grey levels] and ``gain`` [grey levels per electron]. The readout adds the quantisation.

    Raises
    ------
    ValueError
        As `require_light`.
    """
    light = require_light(sensor)
    gain = _MAX_GREY_LEVEL / light.full_well
    return {"read_noise": gain * light.read_noise, "gain": gain}


def make_simulator(sensor: Sensor, view: SensorView, mask: Mask | None = None) -> PsdSimulator | CameraSimulator:
    """Make the simulator that computes readings of a sensor from the light on it.

    Parameters
    ----------
    sensor : Sensor
    view : SensorView
        View of the sensor, see `make_sensor_view`.
    mask : Mask, optional
        Mask in front of the sensor.

    Returns
    -------
    PsdSimulator or CameraSimulator
        A camera without a noise model in ``[line]`` reads its frames with the noise model of `line_noise`. It reads
        with the threshold of ``sensor.readout``: a threshold that is to be estimated is estimated before, see
        `gpuvision.workflows.simulated_recording.sensor_of_recording`.

    Raises
    ------
    ValueError
        As `require_light`; or the mask does not fit the view.
    """
    light, readout = require_light(sensor), _readout(sensor)
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
    if not sensor.noise_known:
        noise = line_noise(sensor)
        readout = replace(readout, read_noise=noise["read_noise"], gain=noise["gain"])
    return CameraSimulator(
        view=view,
        readout=readout,
        exposure_time=light.exposure,
        responsivity=light.responsivity,
        gain=_MAX_GREY_LEVEL / light.full_well,
        read_noise=light.read_noise,
        full_well=light.full_well,
        ambient=light.ambient,
        mask=mask,
    )


def _readout(sensor: Sensor) -> LineReadout | PsdReadout:
    assert not isinstance(sensor.readout, FocusStack)  # require_light checked it
    return sensor.readout


def _transport(sensor: Sensor) -> StraightTransport:
    assert isinstance(sensor.transport, StraightTransport)  # require_light checked it
    return sensor.transport


def _triangulation(readout: PsdReadout | LineReadout) -> Triangulation:
    assert readout.triangulation is not None  # a sensor file with a straight transport has a triangulation
    return readout.triangulation


def _ascending(edges: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    return edges if edges[0] < edges[-1] else edges[::-1].copy()
