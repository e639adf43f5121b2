"""Simulated PSD strips against closed forms of their readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from gpuvision.host import Device
from gpuvision.ranging.psd import PsdNoise
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.simulation.sensors.masks import Mask
from gpuvision.simulation.sensors.psd_simulator import PsdSimulator
from gpuvision.simulation.sensors.readings import height_secant, sheet_point, stack_profiles
from gpuvision.simulation.sensors.sensor_view import Exposure
from gpuvision.status import Status
from lights import LENGTH, PITCH, gaussian, psd, psd_view

ELECTRON = 1.602176634e-19  # elementary charge [C], exact by definition of the SI


def moments(simulator: PsdSimulator, light: dict[str, Exposure]) -> tuple[np.ndarray, np.ndarray]:
    """Return total and position from the currents, without a device."""
    currents = simulator.currents(light)
    total = currents.sum(axis=-1)
    return total, 0.5 * LENGTH * (currents[..., 1] - currents[..., 0]) / total


@pytest.mark.parametrize(
    ("inside", "signal", "bias"),
    [
        (3.0, 0.9987, -0.0044),
        (2.0, 0.9772, -0.0553),
        (1.0, 0.8413, -0.2876),
        (0.0, 0.5, -0.7979),
        (-1.0, 0.1587, -1.5251),
        (-2.0, 0.0228, -2.3732),
    ],
)
def test_light_beyond_the_end(inside: float, signal: float, bias: float) -> None:
    """Only light inside the strip counts: signal Phi(c), bias -sigma phi(c) / Phi(c)."""
    view, sigma = psd_view(), 1e-4
    spot = 0.5 * LENGTH - inside * sigma
    total, u = moments(psd(view, responsivity=0.5), {"direct": gaussian(view, [spot], 2e-6, sigma)})
    # The table is accurate to one unit of its last digit.
    assert total[0] / 1e-6 == pytest.approx(signal, abs=1e-4)
    assert (u[0] - spot) / sigma == pytest.approx(bias, abs=1e-4)
    exact = -np.exp(-0.5 * inside**2) / np.sqrt(2.0 * np.pi) / ndtr(inside)
    assert (u[0] - spot) / sigma == pytest.approx(exact, rel=1e-10)
    assert total[0] / 1e-6 == pytest.approx(ndtr(inside), rel=1e-12)


def test_several_lights() -> None:
    """The reading is the centre of gravity of all lights, sum P x / sum P, for any shape and binning."""
    places, powers = np.array([-2e-3, 1e-4, 2.5e-3]), np.array([1e-6, 5e-6, 2e-7])
    for bins in (1, 7, 60):
        view = psd_view(bins)
        light = {
            path: view.deposit_spots(x, view.v_centres, power)
            for path, x, power in zip(("direct", "diffuse-diffuse", "multi-bounce"), places, powers, strict=True)
        }
        _, u = moments(psd(view), light)
        np.testing.assert_allclose(u, places @ powers / powers.sum(), rtol=1e-13)


def test_secondary_light() -> None:
    """A secondary spot of ratio q at distance D moves the reading by q D / (1 + q)."""
    view, q, distance = psd_view(), 0.07, 1.3e-3
    light = {"direct": gaussian(view, [-1e-3], 1e-6, 5e-5)}
    light["diffuse-specular"] = gaussian(view, [-1e-3 + distance], q * 1e-6, 5e-5)
    np.testing.assert_allclose(moments(psd(view), light)[1] + 1e-3, q * distance / (1.0 + q), rtol=1e-11)


def test_ambient_light() -> None:
    """It shifts the reading to the middle by S / (S + background), but not with demodulation."""
    view = psd_view()
    light = {"direct": gaussian(view, [1e-3], 1e-6, 5e-5)}
    _, u = moments(psd(view, ambient=100e-6), light)
    np.testing.assert_allclose(u, 1e-3 / 101.0, rtol=1e-11)
    _, u = moments(psd(view, ambient=100e-6, modulated=True), light)
    np.testing.assert_allclose(u, 1e-3, rtol=1e-12)
    # Behind a mask over the lower half ambient light lies about the middle of the upper one.
    mask = Mask(windows=[[0.0, 3e-3]] * view.samples)
    total, u = moments(psd(view, ambient=2e-6, mask=mask, responsivity=1.0), light)
    np.testing.assert_allclose(total, 2e-6, rtol=1e-12)
    np.testing.assert_allclose(u, 0.5 * (1e-3 + 1.5e-3), rtol=1e-12)


def test_reading_undoes_the_electronics(device: Device) -> None:
    """Dark levels, gain, load and linearity are put into the currents, and taken out by the readout."""
    view = psd_view()
    linearity = tuple(tuple(1e-5 * np.sin(np.arange(9) + strip)) for strip in range(view.samples))
    electronics = {
        "dark": (3e-9, 5e-9),
        "right_gain": 1.2,
        "interelectrode_resistance": 50e3,
        "load_resistance": 1e3,
        "linearity": linearity,
        "precision": "single" if not device.has_double else "double",
    }
    places = np.array([-2.9e-3, -1e-3, 1e-6, 1.234e-3, 2.9e-3])
    light = stack_profiles([{"direct": view.deposit_spots(places, view.v_centres, 1e-6)}] * 3)
    simulator = psd(view, readout=electronics)
    reading = simulator.read(light, device=device)
    rounding = 1e-12 if device.has_double else 1e-6
    np.testing.assert_allclose(reading.position, np.broadcast_to(places, (3, 5)), atol=LENGTH * rounding)
    np.testing.assert_allclose(reading.strength, 0.4e-6, rtol=2.0 * rounding)
    g, h = sheet_point(view.triangulation, places, view.v_centres)
    np.testing.assert_allclose(reading.h[1], h, atol=0.1 * rounding)
    np.testing.assert_allclose(reading.g[2], g, atol=0.1 * rounding)
    assert not reading.status.any()


def test_no_light_is_no_reading(device: Device) -> None:
    view = psd_view()
    reading = psd(view).read({"direct": view.deposit_spots([0.0], [view.v_centres[1]], [1e-6])}, device=device)
    assert np.isfinite(reading.h).tolist() == [False, True, False, False, False]
    assert (reading.status == Status.LOW_SIGNAL).tolist() == [True, False, True, True, True]


def test_codes(device: Device) -> None:
    """Codes are within half a step of the currents; currents beyond the largest code are flagged."""
    view = psd_view()
    light = {"direct": view.deposit_spots([1e-3] * 3, view.v_centres[:3], [1e-6, 1e-7, 1e-2])}
    coded = psd(view, readout={"ampere": 1e-11, "dark": (1e-9, 1e-9)}, quantised=True)
    codes = coded.currents(light, seed=0)
    assert codes.dtype == np.uint16
    exact = psd(view, readout={"dark": (1e-9, 1e-9)}).currents(light)
    np.testing.assert_allclose(coded.currents(light)[:2], exact[:2] / 1e-11, rtol=1e-14)
    np.testing.assert_allclose(1e-11 * codes[:2].astype(float), exact[:2], atol=0.5e-11 * (1.0 + 1e-9))
    reading = coded.read(light, seed=0, device=device)
    assert reading.status[2] == Status.SATURATED
    assert coded.read(light, device=device).status[2] == Status.SATURATED
    # Half a step of either current.
    assert abs(reading.position[0] - 1e-3) < 0.5e-11 / 0.4e-6 * LENGTH
    saturating = psd(view, readout={"saturation": 1e-6}).read(light, device=device)
    assert saturating.status.tolist()[:3] == [0, 0, Status.SATURATED]


def test_noise_is_what_the_readout_predicts(device: Device) -> None:
    """Over many profiles the readings scatter by the sigma that the readout predicts, for each cause separately."""
    view, spot, current = psd_view(), 2e-4, 0.4e-6
    places = np.linspace(-2e-3, 2e-3, view.samples)
    one = {"direct": gaussian(view, places, current / 0.4, spot)}
    light = stack_profiles([one] * 600)
    for kinds in ({"independent": 2e-9}, {"opposed": 2e-9}, {"spot": spot, "bandwidth": 1e9}):
        simulator = psd(view, readout={"noise": PsdNoise(**kinds)})
        reading = simulator.read(light, seed=7, device=device)
        sigma = simulator.read(one, device=device).sigma
        # 3000 samples: 1.3 % is one standard error; the position noise by photons is resolved only to the bins of the
        # spot.
        assert np.sqrt(np.mean((reading.h.std(axis=0) / sigma) ** 2)) == pytest.approx(1.0, abs=0.06)
        slope = height_secant(view.triangulation, places, places, view.v_centres)
        electrons = current / (2.0 * ELECTRON * kinds.get("bandwidth", 1.0))
        if "spot" in kinds:
            np.testing.assert_allclose(sigma, slope * spot / np.sqrt(electrons), rtol=1e-4)


@pytest.mark.parametrize(
    ("independent", "opposed", "shot"),
    [(2e-9, 0.0, False), (0.0, 2e-9, False), (0.0, 0.0, True), (3e-9, 4e-9, True)],
)
def test_covariance_of_the_two_currents(independent: float, opposed: float, shot: bool) -> None:
    """The causes of noise are independent of each other: their covariances, in closed form, add up."""
    view, current, profiles, bandwidth = psd_view(bins=30), 0.4e-6, 4500, 2e9 if shot else 0.0
    power = np.zeros((view.samples, 30))
    power[:, 9:21] = current / 0.4 / 12
    light = stack_profiles([{"direct": Exposure(power, np.zeros_like(power))}] * profiles)
    noise = PsdNoise(independent=independent, opposed=opposed, bandwidth=bandwidth)
    pairs = psd(view, readout={"noise": noise}).currents(light, seed=11).reshape(-1, 2)
    # Light is uniform over 12 of 30 bins about the middle. The number of electrons and their centroid fluctuate:
    # left, right = total (1/2 -+ u / LENGTH).
    of_total = 2.0 * ELECTRON * bandwidth * current
    of_centroid = (LENGTH * 12 / 30) ** 2 / 12 * 2.0 * ELECTRON * bandwidth / current * (current / LENGTH) ** 2
    common, opposite = np.ones((2, 2)), np.array([[1.0, -1.0], [-1.0, 1.0]])
    expected = of_total / 4 * common + (of_centroid + opposed**2) * opposite + independent**2 * np.eye(2)
    # 22 500 draws determine a variance to 0.94 % and a correlation to 0.67 %; four times this margin.
    for axes in (np.eye(2), np.array([[1.0, 1.0], [-1.0, 1.0]])):  # the currents; their sum and difference
        scatter, exact = np.cov(axes @ pairs.T), axes @ expected @ axes.T
        scale = np.sqrt(np.outer(np.diag(exact), np.diag(exact)))
        assert (np.abs(scatter - exact) <= 0.038 * scale + 1e-28).all()
    np.testing.assert_allclose(pairs.mean(axis=0), 0.5 * current, atol=4 * np.sqrt(expected[0, 0] / len(pairs)))


@pytest.mark.parametrize("modulated", [True, False])
@pytest.mark.parametrize(
    "ambient", [0.0, *(pytest.param(each, marks=pytest.mark.slow) for each in (2e-6, 20e-6)), 200e-6]
)
@pytest.mark.parametrize("windows", [None, (-3e-3, 0.5e-3)])
def test_sigma_with_ambient_light(
    ambient: float, modulated: bool, windows: tuple[float, float] | None, device: Device
) -> None:
    """Readings scatter by their sigma under ambient light: demodulated or not, with a mask or without, any gain."""
    view, spot = psd_view(120), 60e-6
    places = np.linspace(-2.2e-3, 0.2e-3, view.samples)
    one = {"direct": gaussian(view, places, 2e-6, spot)}
    mask = None if windows is None else Mask(windows=[windows] * view.samples)
    noise = PsdNoise(independent=0.2e-9, spot=spot, bandwidth=1e6, dark_current=50e-9)
    simulator = psd(
        view,
        ambient=ambient,
        modulated=modulated,
        mask=mask,
        readout={"noise": noise, "right_gain": 0.5, "dark": (25e-9, 25e-9)},
    )
    reading = simulator.read(stack_profiles([one] * 3000), seed=5, device=device)
    sigma = simulator.read(one, device=device).sigma
    # 3000 readings determine a standard deviation to 1.3 %; three times this margin.
    np.testing.assert_allclose(reading.h.std(axis=0), sigma, rtol=0.039)
    # The background of a readout is the ambient light of a strip without a mask.
    if modulated and mask is None:
        stated = PsdNoise(
            independent=0.2e-9,
            spot=spot,
            bandwidth=1e6,
            dark_current=50e-9,
            background=simulator.responsivity * ambient,
        )
        readout = {"noise": stated, "right_gain": 0.5, "dark": (25e-9, 25e-9)}
        np.testing.assert_allclose(psd(view, readout=readout).read(one, device=device).sigma, sigma, rtol=1e-3)
        scatter = psd(view, readout=readout).read(stack_profiles([one] * 3000), seed=6, device=device).h.std(axis=0)
        np.testing.assert_allclose(scatter, sigma, rtol=0.039)


def test_noise_belongs_to_the_profile() -> None:
    """A profile's noise follows from its number, not from blocks; other profiles and strips are independent."""
    view = psd_view()
    light = {"direct": gaussian(view, [0.0], 1e-6, 5e-5)}
    simulator = psd(view, readout={"noise": PsdNoise(independent=1e-9, bandwidth=1e6)})
    whole = simulator.currents(stack_profiles([light] * 6), seed=3)
    np.testing.assert_array_equal(simulator.currents(stack_profiles([light] * 2), seed=3, first_profile=4), whole[4:])
    np.testing.assert_array_equal(simulator.currents(light, seed=3, first_profile=2), whole[2])
    assert len(np.unique(whole)) == whole.size
    assert not np.array_equal(simulator.currents(light, seed=4), whole[0])


def test_a_reading_is_of_profile_0_by_default(device: Device) -> None:
    view = psd_view()
    light = {"direct": gaussian(view, [0.0], 1e-6, 5e-5)}
    simulator = psd(view, readout={"noise": PsdNoise(independent=1e-9)})
    first, other = (simulator.read(light, seed=3, first_profile=k, device=device).position for k in (0, 1))
    np.testing.assert_array_equal(simulator.read(light, seed=3, device=device).position, first)
    np.testing.assert_array_equal(simulator.currents(light, seed=3), simulator.currents(light, seed=3, first_profile=0))
    assert np.all(first != other)


def test_heights_of_signals_are_in_the_order_of_the_view(device: Device) -> None:
    """Also where the strips of the readout run the other way."""
    view = psd_view()
    places = np.linspace(-2e-3, 1e-3, 5)
    light = gaussian(view, places, 1e-6, 5e-5)
    backwards = SampleAxes(sample_origin=float(view.v_centres[-1]), sample_pitch=-PITCH)
    expected = sheet_point(view.triangulation, places, view.v_centres)[1]
    for simulator in (psd(view), psd(view, readout={"axes": backwards})):
        heights = simulator.heights(simulator.signal(light), device)
        np.testing.assert_allclose(heights, expected, rtol=1e-6, atol=1e-9 if device.has_double else 1e-7)


def test_ambient_light_has_shot_noise_also_where_its_mean_is_gone() -> None:
    view = psd_view()
    light = stack_profiles([{"direct": gaussian(view, [0.0], 1e-6, 5e-5)}] * 400)
    quiet, loud = (
        psd(view, ambient=power, modulated=True, readout={"noise": PsdNoise(bandwidth=1e6)}).currents(light, seed=1)
        for power in (0.0, 99e-6)
    )
    growth = loud.sum(axis=-1).std() / quiet.sum(axis=-1).std()
    assert growth == pytest.approx(10.0, rel=0.1)


def test_axes_that_run_backwards(device: Device) -> None:
    """A readout with axes opposite to the sensor coordinates gives the same result in the order of the view."""
    view = psd_view()
    axes = SampleAxes(sample_origin=float(view.v_centres[-1]), sample_pitch=-PITCH, position_pitch=-1.0)
    table = tuple(tuple(1e-6 * np.arange(3) * strip) for strip in range(view.samples))
    light = {"direct": gaussian(view, np.linspace(-2e-3, 2e-3, 5), [1e-6, 2e-6, 3e-6, 4e-6, 5e-6], 5e-5)}
    ahead = psd(view, readout={"linearity": table[::-1]}).read(light, device=device)
    back = psd(view, readout={"axes": axes, "linearity": table}).read(light, device=device)
    # Without doubles: two roundings of heights up to 18 mm, of 2e-9 m each.
    rounding = (1e-9, 1e-12) if device.has_double else (1e-6, 4e-9)
    for one, other in zip(ahead, back, strict=True):
        np.testing.assert_allclose(one, other, rtol=rounding[0], atol=rounding[1])


def test_what_is_refused() -> None:
    view = psd_view()
    light = {"direct": view.dark()}
    with pytest.raises(ValueError, match="strips at"):
        PsdSimulator(view=view, readout=replace(psd(view).readout, strip_length=5e-3))
    with pytest.raises(ValueError, match="samples are at v"):
        PsdSimulator(view=psd_view(strips=4), readout=psd(view).readout)
    with pytest.raises(ValueError, match="layout"):
        psd(view, readout={"layout": "planar"})
    with pytest.raises(ValueError, match=r"responsivity is -1"):
        psd(view, responsivity=-1.0)
    with pytest.raises(ValueError, match="unknown path 'glow'"):
        psd(view).currents(light | {"glow": view.dark()})
    with pytest.raises(ValueError, match="light of one path or more"):
        psd(view).currents({})
    with pytest.raises(ValueError, match=r"expected \(\.\.\., 5, 60\)"):
        psd(view).currents({"direct": psd_view(50).dark()})
