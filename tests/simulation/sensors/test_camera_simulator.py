"""Simulated camera columns: photons, electronics, and readings in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from gpuvision.host import Device
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.readings import height_secant, sheet_point, stack_profiles
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from lights import camera, camera_view, gaussian, pixel_axes

ELECTRON = 1.602176634e-19  # elementary charge [C], exact by definition of the SI
PIXEL = 10e-6


def watts(electrons: float) -> float:
    """Return the power that generates a number of electrons in a millisecond at 0.4 A/W."""
    return electrons * ELECTRON / (0.4 * 1e-3)


def line(view, pixels=30.3, electrons: float = 1e5, sigma: float = 1.2) -> dict[str, Exposure]:
    u = view.u_centres[0] + PIXEL * np.broadcast_to(np.asarray(pixels, float), view.samples)
    return {"direct": gaussian(view, u, watts(electrons), sigma * PIXEL)}


def test_electrons_and_grey_levels() -> None:
    view = camera_view()
    simulator = camera(view, gain=0.02, offset=7.0)
    light = line(view, electrons=1e4)
    np.testing.assert_allclose(simulator.electrons(light).sum(axis=-1), 1e4, rtol=1e-12)
    frame = simulator.frames(light)
    assert frame.dtype == np.float32
    assert frame.shape == (view.bins, view.samples)
    np.testing.assert_allclose(frame.sum(axis=0) - 7.0 * view.bins, 200.0, rtol=1e-5)


@pytest.mark.parametrize("along", ["columns", "rows"])
def test_reading_of_a_clean_line(along: str, device: Device) -> None:
    """The centre of gravity of all light is where the light is; the sheet's point follows."""
    view = camera_view()
    pixels = 30.0 + np.arange(view.samples) * 0.37
    triangulation = view.triangulation if along == "columns" else None
    readout = {"method": "centroid", "along": along}
    if triangulation is None:
        rows = view.triangulation.to_dict() | {"along": "rows"}
        readout["triangulation"] = type(view.triangulation).from_dict(rows)
    reading = camera(view, readout=readout, gain=1e-3).read(stack_profiles([line(view, pixels)] * 2), device=device)
    u = view.u_centres[0] + PIXEL * pixels
    # Frames are single precision: 64 pixels of 6e-8 each.
    np.testing.assert_allclose(reading.position, np.stack([u, u]), atol=2e-5 * PIXEL)
    g, h = sheet_point(view.triangulation, u, view.v_centres)
    np.testing.assert_allclose(reading.h[0], h, atol=1e-7)
    np.testing.assert_allclose(reading.g[1], g, atol=1e-7)
    assert not reading.status.any()


def test_photon_and_read_noise(device: Device) -> None:
    """Readings scatter as sigma says; with photons alone that is sigma / sqrt(N)."""
    view = camera_view(columns=16)
    one = line(view, electrons=2e4)
    for read_noise in (0.0, 20.0):
        # The threshold is below the offset minus its noise: no sample is cut.
        readout = {"method": "windowed", "window": 6, "threshold": 200.0 if read_noise else 300.0}
        simulator = camera(view, readout=readout, gain=0.5, bits=16, offset=300.0, read_noise=read_noise)
        reading = simulator.read(stack_profiles([one] * 120), seed=5, device=device)
        sigma = simulator.read(one, device=device).sigma
        # 1920 samples: 1.6 % is one standard error.
        assert np.sqrt(np.mean((reading.h.std(axis=0, ddof=1) / sigma) ** 2)) == pytest.approx(1.0, abs=0.07)
        if read_noise == 0.0:
            u = view.u_centres[0] + 30.3 * PIXEL
            slope = height_secant(view.triangulation, u, u, view.v_centres)
            # The extent of a pixel is a blur.
            blur = np.sqrt(1.2**2 + 1.0 / 12.0) * PIXEL
            np.testing.assert_allclose(sigma, slope * blur / np.sqrt(2e4), rtol=2e-3)


@pytest.mark.parametrize("method", ["windowed", "centroid"])
def test_sigma_is_that_of_a_centroid_with_all_noise(method: str, device: Device) -> None:
    """Photons, read noise and quantisation, of each pixel over the threshold in the window, up to the full well."""
    view = camera_view()
    gain, offset, threshold, read_noise, well, window = 0.2, 3.0, 7.0, 30.0, 9000.0, 6
    light = line(view, np.array([1.6, 2.4, 20.3, 30.0, 31.7, 45.2, 61.2, 62.9]), electrons=3e4)
    simulator = camera(
        view,
        readout={"method": method, "threshold": threshold, "window": window},
        gain=gain,
        offset=offset,
        read_noise=read_noise,
        full_well=well,
        bits=12,
    )
    reading = simulator.read(light, device=device)
    known = np.flatnonzero(np.isfinite(reading.position))
    assert len(known) >= 4
    np.testing.assert_array_equal(np.isfinite(reading.sigma), np.isfinite(reading.position))
    electrons = simulator.electrons(light)
    slope = height_secant(view.triangulation, reading.position, reading.position, view.v_centres)
    for sample in known:
        pixel = (reading.position[sample] - view.u_centres[0]) / PIXEL
        reach = range(64) if method == "centroid" else range(round(pixel) - window, round(pixel) + window + 1)
        weighted = total = 0.0
        for k in (each for each in reach if 0 <= each < 64):
            held = min(electrons[sample, k], well)
            signal = held + (offset - threshold) / gain
            if signal > 0.0:
                weighted += (held + read_noise**2 + 1.0 / 12.0 / gain**2) * (k - pixel) ** 2
                total += signal
        expected = abs(slope[sample]) * PIXEL * np.sqrt(weighted) / total
        assert reading.sigma[sample] == pytest.approx(expected, rel=1e-5)


def test_saturation_and_rounding(device: Device) -> None:
    """A full well or the largest code limits the signal; both are flagged."""
    view = camera_view()
    light = line(view, electrons=1e6)
    for limits, level in (({"gain": 0.01}, 255), ({"gain": 0.001, "full_well": 1e5}, 100)):
        simulator = camera(view, **limits)
        for frame in (simulator.frames(light), simulator.frames(light, seed=1)):
            assert frame.max() == level
        assert (simulator.read(light, device=device).status & Status.SATURATED).all()
        assert (simulator.read(light, seed=1, device=device).status & Status.SATURATED).all()
    assert camera(view, bits=12).frames(light, seed=0).dtype == np.uint16
    assert camera(view, bits=12, gain=1.0).frames(light, seed=0).max() == 4095


def test_noise_belongs_to_the_profile() -> None:
    view = camera_view()
    simulator = camera(view, gain=0.5, bits=12)
    all_frames = simulator.frames(stack_profiles([line(view)] * 4), seed=9)
    np.testing.assert_array_equal(
        simulator.frames(stack_profiles([line(view)] * 2), seed=9, first_profile=2), all_frames[2:]
    )
    assert not np.array_equal(all_frames[0], all_frames[1])
    # Profile 0 by default, also for a reading.
    np.testing.assert_array_equal(simulator.frames(line(view), seed=9), all_frames[0])


def test_a_reading_is_of_profile_0_by_default(device: Device) -> None:
    view = camera_view()
    simulator = camera(view, gain=0.5, bits=12)
    readings = [
        simulator.read(line(view), seed=9, device=device, **more).position for more in ({}, {"first_profile": 0})
    ]
    np.testing.assert_array_equal(*readings)
    other = simulator.read(line(view), seed=9, first_profile=1, device=device).position
    assert np.any(other != readings[0])


def test_mask_is_a_region_of_interest(device: Device) -> None:
    """A mask hides a second, stronger line."""
    view = camera_view()
    light = line(view, 20.0) | {"diffuse-specular": line(view, 50.0, electrons=2e5)["direct"]}
    mask = Mask(windows=[view.u_edges[[10, 30]]] * view.samples)
    first = view.u_centres[0]
    for given, pixel in ((None, 50.0), (mask, 20.0)):
        reading = camera(view, mask=given, gain=1e-3).read(light, device=device)
        np.testing.assert_allclose(reading.position, first + pixel * PIXEL, atol=1e-4 * PIXEL)


def test_axes_that_run_backwards(device: Device) -> None:
    """A frame with axes opposite to the sensor coordinates gives the same result in the order of the view."""
    view = camera_view()
    light = line(view, 30.0 + np.arange(view.samples) * 0.37)
    axes = pixel_axes(view)
    turned = SampleAxes(
        position_origin=float(view.u_centres[-1]),
        position_pitch=-axes.position_pitch,
        sample_origin=float(view.v_centres[-1]),
        sample_pitch=-axes.sample_pitch,
    )
    method = {"method": "windowed"}
    ahead, back = (
        camera(view, readout=method | {"axes": each}, gain=1e-3).read(light, device=device) for each in (axes, turned)
    )
    for one, other in zip(ahead, back, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-9)


def test_heights_of_signals_are_in_the_order_of_the_view(device: Device) -> None:
    """Also where the columns or the rows of the frame run the other way; the offset is added once."""
    view, axes = camera_view(), pixel_axes(camera_view())
    pixels = 30.0 + np.arange(view.samples) * 0.37
    light = line(view, pixels)["direct"]
    expected = sheet_point(view.triangulation, view.u_centres[0] + PIXEL * pixels, view.v_centres)[1]
    for u, v in ((1.0, 1.0), (1.0, -1.0), (-1.0, 1.0)):
        turned = SampleAxes(
            position_origin=axes.position_origin if u > 0.0 else float(view.u_centres[-1]),
            position_pitch=u * axes.position_pitch,
            sample_origin=axes.sample_origin if v > 0.0 else float(view.v_centres[-1]),
            sample_pitch=v * axes.sample_pitch,
        )
        simulator = camera(view, readout={"axes": turned, "threshold": 5.0}, gain=1e-3, offset=5.0)
        np.testing.assert_allclose(simulator.heights(simulator.signal(light), device), expected, atol=2e-6)


def test_dark_profiles(device: Device) -> None:
    reading = camera().read({"direct": camera_view().dark()}, device=device)
    assert (reading.status == Status.LOW_SIGNAL).all()
    assert np.isnan(reading.h).all()
    assert np.isnan(reading.sigma).all()


def test_what_is_refused() -> None:
    edges = camera_view().u_edges
    with pytest.raises(ValueError, match=rf"bins are at {edges[0]:g} \.\.\. {edges[-1]:g},.* a bin for every pixel"):
        camera(camera_view(), readout={"axes": camera(camera_view(rows=60)).readout.axes})
    with pytest.raises(ValueError, match="bits is 9"):
        camera(bits=9)
    with pytest.raises(ValueError, match="read_noise is -1"):
        camera(read_noise=-1.0)
