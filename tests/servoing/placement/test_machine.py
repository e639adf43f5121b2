"""Description of a machine: limits of its numbers on both sides, delays and gains by hand, and the view from below."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from gpuvision.camera.lens import Lens
from gpuvision.formats.machine_file import read_machine
from gpuvision.servoing.axis import Axis
from gpuvision.servoing.delay import gain_limit, lag_gains, non_oscillating_gain
from gpuvision.servoing.delay_response import settling_frames, step_response
from gpuvision.servoing.frames import Transform
from gpuvision.servoing.placement.control import Control, Settling
from gpuvision.servoing.placement.machine import Machine, PlacementCamera, ThermalDrift, Tolerance

PRESET = read_machine("look_while_place")
LAGS = (0.5e-3, 2e-3, 1.25e-3)
AXES = tuple(Axis(lag=lag) for lag in LAGS)
MOTION = (60e-9, 60e-9, 3e-5)


def machine(observer: Any = "latest", controller: Any = "p", **more: Any) -> Machine:
    motion = MOTION if observer == "kalman" else None
    names = {each.name for each in dataclasses.fields(Control)}
    control = Control(
        observer=observer,
        controller=controller,
        motion_sigma=motion,
        **{name: more.pop(name) for name in names & set(more)},
    )
    return dataclasses.replace(PRESET, control=control, **({"axes": AXES} | more))


def with_readout(**more: Any) -> PlacementCamera:
    sensor = PRESET.camera.sensor
    return dataclasses.replace(
        PRESET.camera, sensor=dataclasses.replace(sensor, readout=dataclasses.replace(sensor.readout, **more))
    )


def test_delay_of_a_frame_by_hand() -> None:
    """Readout of 512 x 512 px by 8 taps of 66 MHz; each buffer delays by a period of the machine."""
    readout = 512 * 512 / 8 / 66e6
    for buffers in (0, 2):
        found = dataclasses.replace(PRESET, camera=with_readout(buffers=buffers), rate=800.0, transfer=30e-6)
        delay = found.delay
        assert delay.period == found.period == pytest.approx(1.25e-3)
        assert (delay.exposure, delay.transfer, dict(delay.stages)) == (2e-4, 30e-6, {"vision": 5e-4, "control": 1e-4})
        assert delay.readout == pytest.approx(readout + buffers * 1.25e-3)
        total = 1e-4 + readout + buffers * 1.25e-3 + 30e-6 + 6e-4
        assert delay.latency == pytest.approx(total)
        assert found.response_frames == pytest.approx(total / 1.25e-3)


def test_frames_fit_into_their_period() -> None:
    timing = PRESET.camera.sensor.timing(PRESET.camera.window, exposure=PRESET.camera.exposure)
    dataclasses.replace(PRESET, rate=(1.0 + 0.9e-9) / timing.period)
    with pytest.raises(
        ValueError, match=rf"a frame of 512 x 512 px takes {1e3 * timing.period:.3f} ms, more than 1/rate = "
    ):
        dataclasses.replace(PRESET, rate=(1.0 + 1.2e-9) / timing.period)
    with pytest.raises(
        ValueError, match=r"takes 0\.496 ms, more than 1/rate = 0\.400 ms; read a smaller window, expose"
    ):
        dataclasses.replace(PRESET, rate=2500.0)


def test_delay_and_lags_that_the_controller_sees() -> None:
    """Longest lag of 2 ms at 1000 frames/s: 2 frames."""
    latency = PRESET.delay.frames
    assert machine().lag == 2e-3
    for observer, delay, lags in (
        ("latest", latency + 2.0, (0.0, 0.0, 0.0)),
        ("kalman", 2.0, (0.0, 0.0, 0.0)),
        ("smith", 0.0, (0.5, 2.0, 1.25)),
    ):
        found = machine(observer)
        assert found.response_frames == pytest.approx(latency + 2.0)
        assert found.control_delay == pytest.approx(delay)
        assert found.control_lags == pytest.approx(lags)


def test_gains_of_controllers() -> None:
    """Without a gain: the largest that does not oscillate, or half the inverse delay with half a frame for the hold."""
    latency = PRESET.delay.frames
    smooth = {
        "latest": non_oscillating_gain(latency + 2.0),
        "kalman": non_oscillating_gain(2.0),
        "smith": min(lag_gains(lag).critical for lag in (0.5, 2.0, 1.25)),
    }
    frames = {"latest": latency + 2.5, "kalman": 2.5, "smith": 2.5}
    for observer, gain in smooth.items():
        plain = machine(observer)
        assert plain.loop_gain == pytest.approx(gain)
        assert plain.gains.proportional == pytest.approx(gain * 1000.0)
        assert (plain.gains.integral, plain.gains.derivative) == (math.inf, 0.0)
        both = machine(observer, "pi")
        assert both.loop_gain == pytest.approx(0.5 / frames[observer])
        assert both.gains.proportional == pytest.approx(500.0 / frames[observer])
        assert (both.gains.integral, both.gains.derivative) == (pytest.approx(8e-3 * frames[observer]), 0.0)
        given = machine(observer, "pi", gain=0.1, integral=0.03)
        assert dataclasses.astuple(given.gains)[:2] == pytest.approx((100.0, 0.03))
    full = machine("smith", "pid", axes=(Axis(lag=0.1e-3), Axis(lag=0.2e-3), Axis()))
    assert full.gains.derivative == 0.2e-3
    assert full.gains.integral == pytest.approx(8e-3 * 0.7)
    assert machine("smith", "pid", gain=0.1, integral=0.04, derivative=0.3e-3).gains.derivative == 0.3e-3
    constants = given.time_constants(1.5)
    assert constants == {"integral": pytest.approx(30.0), "derivative": 0.0, "lag": 1.5}
    assert machine("smith", axes=(Axis(), AXES[1], Axis()))._smooth_gains == pytest.approx(
        (non_oscillating_gain(0.0), lag_gains(2.0).critical, non_oscillating_gain(0.0))
    )


@pytest.mark.parametrize(
    ("observer", "axes", "most", "cause"),
    [
        ("latest", AXES, gain_limit(PRESET.delay.frames + 2.0), f"a delay of {PRESET.delay.frames + 2.0:.2f} frames"),
        ("kalman", AXES, gain_limit(2.0), "a delay of 2.00 frames"),
        ("kalman", (Axis(), Axis(lag=0.2e-3), Axis()), gain_limit(0.5), "a delay of 0.20 frames"),
        ("kalman", (Axis(), Axis(), Axis()), gain_limit(0.0), "a delay of 0.00 frames"),
        ("smith", AXES, min(lag_gains(each).limit for each in (0.5, 2.0, 1.25)), "a lag of 2.00 frames"),
        ("smith", (Axis(), Axis(lag=0.3e-3), Axis()), 2.0, "a lag of 0.00 frames"),
    ],
)
def test_limit_of_the_gain(observer: str, axes: Any, most: float, cause: str) -> None:
    if cause.startswith("a lag of 2"):
        limits = {each: lag_gains(each).limit for each in (0.5, 2.0, 1.25)}
        cause = f"a lag of {min(limits, key=limits.__getitem__):.2f} frames"
    machine(observer, axes=axes, gain=0.9999 * most)
    for gain in (1.0001 * most, 0.0, -0.1):
        with pytest.raises(
            ValueError, match=rf"gain is {gain}, expected above 0 and below {most:.4g}, .* for {cause}$"
        ):
            machine(observer, axes=axes, gain=gain)
    machine(observer, axes=axes, gain=1e-4)
    with pytest.raises(ValueError, match=r"gain is 9.9e-05, expected 0.0001 or more: the loop would hardly move"):
        machine(observer, axes=axes, gain=0.99e-4)


def test_controllers_that_are_not_stable() -> None:
    with pytest.raises(
        ValueError, match=r"the controller pi with gain 0.9, integral 0.03 s and derivative 0 s is not .* a delay"
    ):
        machine("latest", "pi", gain=0.9, integral=0.03)
    with pytest.raises(
        ValueError, match=r"the controller pid with gain 3.5, integral 0.03 s .* with a lag of 2.00 frames"
    ):
        machine("smith", "pid", axes=(Axis(lag=2e-3),) * 3, gain=3.5, integral=0.03, derivative=0.0)
    with pytest.raises(ValueError, match=r"gain is 0\.0"):
        machine("latest", "pi", gain=0.0)


@pytest.mark.parametrize(("observer", "gain"), [("latest", 0.15), ("smith", 0.3), ("smith", None), ("latest", None)])
def test_response_of_each_axis(observer: str, gain: float | None) -> None:
    found = machine(observer, gain=gain)
    lags = (0.5, 2.0, 1.25) if observer == "smith" else (0.0, 0.0, 0.0)
    errors = [step_response(found.control_delay, found.loop_gain, 300, lag=lag) for lag in lags]
    np.testing.assert_allclose(found.error_after(300), np.transpose(errors), atol=1e-12)
    fractions = (0.5, 0.05, 0.2)
    each = [
        settling_frames(found.control_delay, found.loop_gain, fraction, lag=lag)
        for lag, fraction in zip(lags, fractions, strict=True)
    ]
    assert found.frames_to(fractions) == max(each)
    assert found.frames_to(1.0) == 0
    assert found.frames_to((1.0, 1.0, 0.3)) == settling_frames(found.control_delay, found.loop_gain, 0.3, lag=lags[2])
    overshoot = np.maximum(-np.min(errors, axis=1), 0.0)
    np.testing.assert_allclose(found.overshoot, overshoot, atol=1e-6)
    assert found.overshoot.any() == (gain is not None)


def test_view_from_below_and_back() -> None:
    """A point that the nozzle covers on the board is the same in both frames, and errors are mirrored."""
    covariance = np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.2], [0.3, -0.2, 1.0]]) * 1e-14
    above = dataclasses.replace(
        PRESET,
        pipette_in_camera=Transform.rigid("pipette", "camera", (1e-3, 5e-4, 0.2), covariance),
        drift=ThermalDrift(expansion=(1e-6, -3e-6), temperature_sigma=2.0),
    )
    assert above.for_side("top") is above
    below = above.for_side("bottom")
    assert (above.camera.mirrored, below.camera.mirrored) == (False, True)
    assert below.for_side("bottom") is below
    np.testing.assert_allclose(below.pipette_in_camera.pose, (-1e-3, 5e-4, -0.2), rtol=1e-14)
    expected = covariance * np.array([[1.0, -1.0, 1.0], [-1.0, 1.0, -1.0], [1.0, -1.0, 1.0]])
    np.testing.assert_allclose(below.pipette_in_camera.pose_covariance, expected, rtol=1e-9)
    assert (below.pipette_in_camera.source, below.pipette_in_camera.target) == ("pipette", "camera")
    assert below.drift == ThermalDrift(expansion=(-1e-6, -3e-6), temperature_sigma=2.0)
    again = below.for_side("top")
    np.testing.assert_allclose(again.pipette_in_camera.pose, (1e-3, 5e-4, 0.2), rtol=1e-14)
    assert (again.camera, again.drift, again.tolerance) == (above.camera, above.drift, above.tolerance)


def test_reach_of_a_window_with_a_lens() -> None:
    """Distortion about a point off the middle of the sensor: the farthest corner, undistorted."""
    camera = PRESET.camera
    lens = Lens(k1=2e-7, centre=(500.0, 530.0))
    seen = dataclasses.replace(camera, window=(200, 300), lens=lens)
    assert seen.window_lens == Lens(k1=2e-7, centre=(500.0 - 362.0, 530.0 - 412.0))
    corners = np.array([(x, y) for x in (-0.5, 299.5) for y in (-0.5, 199.5)])
    away = lens.undistort(corners + np.array([362.0, 412.0])) - (362.0 + 149.5, 412.0 + 99.5)
    assert seen.reach_px == pytest.approx(np.hypot(*away.T).max(), rel=1e-6)
    assert seen.reach_px > math.hypot(200, 300) / 2.0 + 0.1
    cushion = dataclasses.replace(seen, lens=Lens(k1=-2e-7, centre=(511.5, 511.5)))
    assert cushion.reach_px == pytest.approx(math.hypot(200, 300) / 2.0)
    with pytest.raises(ValueError, match="lens: the model folds within the window"):
        dataclasses.replace(seen, window=(1024, 1024), lens=Lens(k1=-2e-6, centre=(511.5, 511.5)))


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"rate": 0.0}, "rate is 0"),
        ({"landing": -1e-9}, "landing is -1e-09"),
        ({"swing": (1e-6, 0.0, 0.0)}, "swing needs an axis with a resonance"),
        ({"swing": (0.0, -1e-9, 0.0)}, "swing is -1e-09"),
        (
            {"settling": Settling(rule="fixed", wait=1.0)},
            "settling.wait is 1.0 s, expected less than tolerance.max_time, 1",
        ),
        ({"pipette_in_camera": Transform.rigid("camera", "pipette", (0, 0, 0))}, "pipette_in_camera is .*, expected a"),
        ({"pipette_in_camera": Transform.affine("pipette", "camera", np.eye(2, 3))}, "'affine'.*, expected a rigid"),
    ],
)
def test_wrong_numbers_of_a_machine_are_refused(more: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(PRESET, **more)


def test_numbers_at_their_limits_are_taken() -> None:
    dataclasses.replace(PRESET, landing=0.0, settling=Settling(rule="fixed", wait=0.999))
    dataclasses.replace(PRESET, axes=(Axis(resonance=60.0), Axis(), Axis()), swing=(1e-6, 0.0, 0.0))
    limits = {"position": 1e-6, "angle": 1e-3, "landing_zone": 1e-4, "landing_angle": 1e-2}
    tolerance = Tolerance(**limits)
    assert (tolerance.max_time, tolerance.max_refused) == (1.0, 20)
    assert Tolerance(**limits, max_refused=1).max_refused == 1
    for name in (*limits, "max_time"):
        with pytest.raises(ValueError, match=f"{name} is 0"):
            dataclasses.replace(tolerance, **{name: 0.0})
    with pytest.raises(ValueError, match="max_refused is 0"):
        dataclasses.replace(tolerance, max_refused=0)
    assert not ThermalDrift().covariance.any()
    drift = ThermalDrift(expansion=(2.0, -3.0), temperature_sigma=0.5)
    np.testing.assert_array_equal(drift.covariance, [[1.0, -1.5, 0.0], [-1.5, 2.25, 0.0], [0.0, 0.0, 0.0]])
    with pytest.raises(ValueError, match="temperature_sigma is -0"):
        ThermalDrift(temperature_sigma=-0.1)
    for name in ("pixel", "exposure", "electrons"):
        with pytest.raises(ValueError, match=f"{name} is 0"):
            dataclasses.replace(PRESET.camera, **{name: 0.0})
    assert dataclasses.replace(PRESET.camera, blur_px=0.0).edge_blur_px == pytest.approx(math.sqrt(1.0 / 12.0))
    with pytest.raises(ValueError, match="blur_px is -0"):
        dataclasses.replace(PRESET.camera, blur_px=-0.1)
