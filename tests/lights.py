"""Light on simulated sensors with power and moments in closed form."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.simulation.sensors.camera_simulator import CameraSimulator
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.sensor_view import Exposure, SensorView

LENGTH, PITCH, STRIPS = 6e-3, 1e-4, 5


def psd_view(bins: int = 60, strips: int = STRIPS) -> SensorView:
    """Return the view of PSD strips of 6 mm on a vertical sheet of light."""
    half, v = 0.5 * LENGTH, PITCH * (np.arange(strips + 1) - 0.5 * strips)
    triangulation = Triangulation.from_stand_off(
        baseline=0.08, stand_off=0.15, focal_distance=0.04, region=((-half, half), (v[0], v[-1]))
    )
    edges = np.linspace(-half, half, bins + 1)
    return SensorView(
        triangulation=triangulation, transport=StraightTransport(), lens=(0.0, 0.08, 0.15), u_edges=edges, v_edges=v
    )


def strip_axes(view: SensorView) -> SampleAxes:
    return SampleAxes(sample_origin=float(view.v_centres[0]), sample_pitch=PITCH)


def psd(view: SensorView | None = None, *, readout: dict | None = None, **more) -> PsdSimulator:
    view = psd_view() if view is None else view
    return PsdSimulator(
        view=view, readout=PsdReadout(strip_length=LENGTH, **{"axes": strip_axes(view), **(readout or {})}), **more
    )


def camera_view(rows: int = 64, columns: int = 8) -> SensorView:
    """Return the view of a camera with 10 um pixels on the same sheet."""
    axes = [10e-6 * (np.arange(count + 1) - 0.5 * count) for count in (rows, columns)]
    triangulation = Triangulation.from_stand_off(
        baseline=0.08,
        stand_off=0.15,
        focal_distance=0.04,
        region=((axes[0][0], axes[0][-1]), (axes[1][0], axes[1][-1])),
    )
    return SensorView(
        triangulation=triangulation,
        transport=StraightTransport(),
        lens=(0.0, 0.08, 0.15),
        u_edges=axes[0],
        v_edges=axes[1],
    )


def pixel_axes(view: SensorView) -> SampleAxes:
    return SampleAxes(
        position_origin=float(view.u_centres[0]),
        position_pitch=10e-6,
        sample_origin=float(view.v_centres[0]),
        sample_pitch=10e-6,
    )


def camera(view: SensorView | None = None, *, readout: dict | None = None, **more) -> CameraSimulator:
    view = camera_view() if view is None else view
    return CameraSimulator(view=view, readout=LineReadout(**{"axes": pixel_axes(view), **(readout or {})}), **more)


def gaussian(view: SensorView, u, power, sigma: float) -> Exposure:
    """Return spots of a Gaussian profile, integrated exactly over bins; u and power broadcast to (..., samples)."""
    u, power = np.broadcast_arrays(np.asarray(u, float), np.asarray(power, float))
    u, power = (np.array(np.broadcast_to(each, (*u.shape[:-1], view.samples)))[..., None] for each in (u, power))
    x = (view.u_edges - u) / sigma
    share = np.diff(ndtr(x), axis=-1)
    # Above the centre, differences of the complement avoid the cancellation of numbers near 1.
    share = np.where(x[..., :-1] > 0.0, -np.diff(ndtr(-x), axis=-1), share)
    first = -sigma * np.diff(np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), axis=-1)
    return Exposure(power * share, power * (first + (u - view.u_centres) * share))
