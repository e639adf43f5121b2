"""PSD readout against the float64 oracle, on every device and in both kernel variants."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

import gpuvision as gv
from canary import Guarded, shifted
from gpuvision.host import host_view
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.psd import PsdNoise, PsdReadout
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference import psd as reference
from gpuvision.status import Status

VARIANTS = ("vector", "work_item")
LENGTH = 6e-3
# Roundings of the position in units of L/2: of difference, sum, quotient, product and the packed constant; and of the
# parameters where they are used.
POSITION_ULPS = {np.dtype(np.float32): 4, np.dtype(np.float64): 4}


def tolerance(real, readout=None) -> float:
    return POSITION_ULPS[np.dtype(real)] * np.finfo(real).eps * LENGTH / 2


def currents(rng, shape, dtype=np.float32, scale=1e-6):
    values = rng.uniform(0.01, 1.0, shape)
    return (values * 60_000).astype(dtype) if np.dtype(dtype).kind == "u" else (values * scale).astype(dtype)


def assert_like_reference(readout, reading, left, right):
    expected = reference.read_out(readout, left, right)
    real = reading.position.dtype
    np.testing.assert_array_equal(reading.status, expected.status)
    np.testing.assert_array_equal(np.isnan(reading.position), expected.status != 0)
    np.testing.assert_allclose(reading.position, expected.position, rtol=0, atol=tolerance(real))
    finite = np.isfinite(expected.total)
    np.testing.assert_allclose(reading.total[finite], expected.total[finite], rtol=4 * np.finfo(real).eps)
    if reading.sigma is not None:
        np.testing.assert_allclose(reading.sigma, expected.sigma, rtol=2e-5 if real == np.float32 else 1e-12)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("dtype", ["float32", "float64", "uint16"])
@pytest.mark.parametrize("layout", ["pairs", "planar"])
@pytest.mark.parametrize("batch", [(1,), (15,), (16,), (17,), (3, 5), (4095,), (4097,), (8193,), (7, 1023)])
def test_like_float64(device, rng, variant, dtype, layout, batch):
    readout = PsdReadout(
        strip_length=LENGTH, variant=variant, layout=layout, ampere=1e-11 if dtype == "uint16" else 1.0
    )
    values = currents(rng, (2, *batch), dtype)
    given_ = np.ascontiguousarray(np.moveaxis(values, 0, -1)) if layout == "pairs" else values
    reading = readout(given_, device=device)
    assert reading.position.shape == batch
    assert_like_reference(readout, reading, *values)


@pytest.mark.parametrize("shift", [0, 1])
def test_stores_past_small_caches(device, rng, shift):
    """A device with caches of 1 KiB writes past them: all outputs, at aligned addresses and at other addresses."""
    samples = 4003
    small = copy.copy(device)
    small.cache_bytes = 1024
    readout = PsdReadout(strip_length=LENGTH, layout="planar")  # shares the usual build with `test_like_float64`
    defines = readout.launch(small, (2, samples), np.dtype(np.float32)).defines
    assert ("PAST_CACHES" in defines) == ("VECTOR_VARIANT" in defines and device.is_cpu)
    values = currents(rng, (2, samples))
    complete = readout(values, device=device)
    for mine, theirs in zip(readout(values, device=small, out=shifted(complete, shift)), complete, strict=True):
        if mine is not None:
            np.testing.assert_array_equal(mine, theirs)


@pytest.mark.slow
@pytest.mark.parametrize("shift", [0, 1])
def test_more_than_the_caches_hold(device, rng, shift):
    """Outputs bypass the caches, at addresses that are aligned to a vector and at other addresses."""
    samples = 2 + device.cache_bytes // 13 * 16 // 15
    readout = PsdReadout(strip_length=LENGTH, layout="planar", saturation=float(np.float32(0.9e-6)))
    values = currents(rng, (2, samples))
    complete = readout(np.ascontiguousarray(values[:, :1]), device=device)
    out = type(complete)(
        *(None if each is None else np.zeros(samples + 16, each.dtype)[shift:][:samples] for each in complete)
    )
    assert_like_reference(readout, readout(values, device=device, out=out), *values)


@pytest.mark.parametrize("variant", VARIANTS)
def test_everything_at_once(device, rng, variant):
    strips = 37
    linearity = tuple(map(tuple, rng.normal(0, 20e-6, (strips, 9))))
    readout = PsdReadout(
        strip_length=LENGTH,
        ampere=2e-11,
        dark=(3e-9, 5e-9),
        right_gain=1.07,
        interelectrode_resistance=50e3,
        load_resistance=1e3,
        minimum_total=1e-7,
        saturation=1.1e-6,
        linearity=linearity,
        noise=PsdNoise(independent=1e-11, opposed=2e-12, spot=50e-6, bandwidth=100e3),
        variant=variant,
    )
    codes = rng.integers(0, 65_536, (200, strips, 2)).astype(np.uint16)
    # Exclude codes that float32 and float64 round to different sides of a limit.
    reading = readout(codes, device=device)
    expected = reference.read_out(readout, codes[..., 0], codes[..., 1])
    agree = reading.status == expected.status
    assert agree.mean() > 0.999
    good = agree & (expected.status == 0)
    assert good.mean() > 0.3
    np.testing.assert_allclose(reading.position[good], expected.position[good], rtol=0, atol=2 * tolerance(np.float32))
    np.testing.assert_allclose(reading.sigma[good], expected.sigma[good], rtol=2e-5)


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_reason_is_told(device, variant):
    nan, inf = np.nan, np.inf
    cases = [
        ((1.0, 3.0), Status.OK),
        ((0.0, 0.0), Status.LOW_SIGNAL),
        ((0.04, 0.05), Status.LOW_SIGNAL),
        ((-0.5, 0.2), Status.LOW_SIGNAL),
        ((-0.1, 2.0), Status.OUT_OF_RANGE),
        ((2.0, -0.1), Status.OUT_OF_RANGE),
        ((0.0, 2.0), Status.OK),
        ((2.0, 0.0), Status.OK),
        ((8.0, 1.0), Status.SATURATED),
        ((1.0, 9.0), Status.SATURATED),
        ((nan, 1.0), Status.NOT_FINITE),
        ((1.0, nan), Status.NOT_FINITE),
        ((inf, 1.0), Status.NOT_FINITE),
        ((1.0, -inf), Status.NOT_FINITE),
        ((inf, inf), Status.NOT_FINITE),
        ((-inf, inf), Status.NOT_FINITE),
    ]
    readout = PsdReadout(strip_length=2.0, minimum_total=0.1, saturation=8.0, variant=variant)
    for repeat in (1, 64):  # within one vector, and in blocks that are read twice
        pairs = np.repeat(np.array([pair for pair, _ in cases], np.float32), repeat, axis=0)
        reading = readout(pairs, device=device)
        expected = np.repeat([int(status) for _, status in cases], repeat)
        np.testing.assert_array_equal(reading.status, expected)
        np.testing.assert_array_equal(np.isnan(reading.position), expected != 0)
    assert readout(np.array([[0.0, 2.0]], np.float32), device=device).position[0] == 1.0
    assert readout(np.array([[2.0, 0.0]], np.float32), device=device).position[0] == -1.0


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("pair", "status"),
    [
        ((1000, 4094), Status.OK),
        ((1000, 4095), Status.SATURATED),
        ((4095, 1000), Status.SATURATED),
        ((50, 51), Status.OK),
        ((51, 49), Status.LOW_SIGNAL),
    ],
)
def test_one_code_at_a_limit_among_good_codes(device, variant, pair, status):
    """The limits are inclusive for saturation and exclusive for the smallest sum, also in a block of valid samples."""
    codes = np.full((4999, 2), (700, 1300), np.uint16)
    codes[3001] = pair
    readout = PsdReadout(strip_length=2.0, saturation=4095.0, minimum_total=100.0, variant=variant)
    reading = readout(codes, device=device)
    expected = np.zeros(4999, np.uint8)
    expected[3001] = status
    np.testing.assert_array_equal(reading.status, expected)
    np.testing.assert_array_equal(np.isnan(reading.position), expected != 0)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("real", [np.float32, np.float64])
def test_a_sum_that_overflows_is_flagged(device, variant, real):
    largest = np.finfo(real).max
    pairs = np.array([[0.7 * largest, 0.9 * largest]] * 20, real)
    reading = PsdReadout(strip_length=LENGTH, variant=variant)(pairs, device=device)
    assert (reading.status == Status.SATURATED).all()
    assert np.isnan(reading.position).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_denormal_currents_keep_their_ratio_or_are_dark(device, variant):
    tiny = np.full((32, 2), 1e-40, np.float32) * np.array([1.0, 3.0], np.float32)
    reading = PsdReadout(strip_length=2.0, variant=variant)(tiny, device=device)
    good = reading.status == 0
    # A runtime may flush denormal numbers: the status is then LOW_SIGNAL, never an arbitrary position.
    np.testing.assert_allclose(reading.position[good], 0.5, rtol=1e-4)
    assert (reading.status[~good] == Status.LOW_SIGNAL).all()


def test_a_thousandfold_change_of_light_does_not_move_the_position(device):
    level = np.geomspace(1e-9, 1e-6, 31)
    pairs = (level[:, None] * np.array([0.3, 0.7])).astype(np.float32)
    position = PsdReadout(strip_length=LENGTH)(pairs, device=device).position
    assert np.ptp(position) <= 2 * tolerance(np.float32)


@pytest.mark.double
def test_two_lights_meet_at_their_centre_of_gravity(device):
    places, powers = np.array([-1e-3, 2e-3]), np.array([1e-6, 0.5e-6])
    right = (powers * (0.5 + places / LENGTH)).sum()
    left = powers.sum() - right
    reading = PsdReadout(strip_length=LENGTH)(np.array([[left, right]]), device=device)
    assert reading.position[0] == pytest.approx((powers * places).sum() / powers.sum(), abs=1e-15)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_quantised_codes_err_within_their_predicted_sigma(device, rng, bits):
    steps = 2**bits
    place = rng.uniform(-0.45, 0.45, 20_000)
    total = steps * rng.uniform(0.6, 0.9, place.size)  # a constant total would correlate the two rounding errors
    codes = np.round(np.stack([total * (0.5 - place), total * (0.5 + place)], axis=-1)).astype(np.uint16)
    readout = PsdReadout(strip_length=1.0, saturation=float(steps), noise=PsdNoise())
    reading = readout(codes, device=device)
    assert (reading.status == 0).all()
    scaled = (reading.position - place) / reading.sigma
    # 20 000 draws determine a standard deviation to 0.5 %; three times this margin.
    assert np.std(scaled) == pytest.approx(1.0, abs=0.015)


@pytest.mark.double
@pytest.mark.parametrize("model", ["independent", "opposed", "common"])
@pytest.mark.parametrize("xi", [-0.9, 0.0, 0.5])
def test_noise_models_predict_what_draws_scatter(device, rng, model, xi):
    total, draws = 1e-6, 40_000
    mean = total * np.array([0.5 - xi / 2, 0.5 + xi / 2])
    if model == "independent":
        noise, pairs = PsdNoise(independent=1e-9), mean + rng.normal(0, 1e-9, (draws, 2))
    elif model == "opposed":
        leaves = rng.normal(0, 1e-9, draws)
        noise, pairs = PsdNoise(opposed=1e-9), mean + np.stack([-leaves, leaves], axis=-1)
    else:
        noise = PsdNoise(spot=100e-6, bandwidth=1e9)
        electrons = total / (2 * reference.ELECTRON * 1e9)
        place = xi / 2 + rng.normal(0, 100e-6 / LENGTH / np.sqrt(electrons), draws)
        pairs = total * np.stack([0.5 - place, 0.5 + place], axis=-1)
    # The spots of the draws lie beside each other within a range that a margin would cut.
    reading = PsdReadout(strip_length=LENGTH, noise=noise, margin=0.0)(pairs, device=device)
    good = reading.status == 0
    # 40 000 draws determine a standard deviation to 0.35 %; three times this margin.
    assert np.std(reading.position[good]) == pytest.approx(np.mean(reading.sigma[good]), rel=0.0125)


def electrons_as_currents(rng, draws, signal, background, place, spot, bandwidth):
    """Return currents (draws, 2) of a strip on which every electron is a Poisson event at its position.

    The electrons of a Gaussian spot and of a uniform background arrive in cells of the strip during 1 / (2 bandwidth);
    an electron at y divides in the ratio of its distances from the electrodes.
    """
    window, cells = 0.5 / bandwidth, 250
    edges = np.linspace(-0.5 * LENGTH, 0.5 * LENGTH, cells + 1)
    rate = signal * np.diff(ndtr((edges - place) / spot)) + background / cells
    counts = rng.poisson(rate * window / reference.ELECTRON, (draws, cells))
    y = 0.5 * (edges[1:] + edges[:-1]) / LENGTH
    return counts @ np.stack([0.5 - y, 0.5 + y], axis=-1) * reference.ELECTRON / window


@pytest.mark.parametrize(
    "ambient", [0.0, *(pytest.param(each, marks=pytest.mark.slow) for each in (2e-6, 20e-6)), 200e-6]
)
def test_sigma_with_background_light(device, rng, ambient):
    """The predicted sigma is the scatter of drawn electrons, also under ambient light of 100 times the signal."""
    draws, spot, bandwidth, amplifier, responsivity = 10_000, 50e-6, 1e6, 0.2e-9, 0.4
    signal, background, dark_current = 2e-6 * responsivity, ambient * responsivity, 50e-9
    removed = 0.5 * (background + dark_current)
    noise = PsdNoise(
        independent=amplifier, spot=spot, bandwidth=bandwidth, background=background, dark_current=dark_current
    )
    for place in (-2.5e-3, -0.8e-3, 0.0, 1.7e-3, 2.7e-3):
        pairs = electrons_as_currents(rng, draws, signal, background + dark_current, place, spot, bandwidth)
        for gain in (1.0, 0.25, 3.0):
            recorded = pairs * (1.0, gain) + rng.normal(0.0, amplifier, pairs.shape)
            readout = PsdReadout(
                strip_length=LENGTH, right_gain=gain, dark=(removed, gain * removed), noise=noise, margin=0.0
            )
            # Single precision rounds the difference of currents of 40 uA to a tenth of the noise.
            reading = readout(recorded if device.has_double else recorded.astype(np.float32), device=device)
            assert (reading.status == 0).all()
            # 10 000 draws determine a standard deviation to 0.7 %; four times this margin.
            assert np.std(reading.position) == pytest.approx(np.mean(reading.sigma), rel=0.03), (place, gain)
            mean = np.mean(reading.position)
            assert mean == pytest.approx(place, abs=4 * np.mean(reading.sigma) / np.sqrt(draws)), (place, gain)


@pytest.mark.parametrize("load", [0.0, 2e3])
def test_sigma_by_background_in_closed_form(device, load):
    """An electron anywhere on the strip moves the position by its distance: variance L^2 / 12 + u^2, with and without
    a load, which shrinks the recorded position to R / (R + 2 R_L)."""
    resistance, bandwidth, background, total = 1e4, 1e6, 1e-6, 5e-6
    noise = PsdNoise(bandwidth=bandwidth, background=background)
    loaded = {"interelectrode_resistance": resistance, "load_resistance": load} if load else {}
    readout = PsdReadout(strip_length=LENGTH, noise=noise, margin=0.0, **loaded)
    place = np.linspace(-2.5e-3, 2.5e-3, 21)
    balance = place / (0.5 * LENGTH) * resistance / (resistance + 2.0 * load)
    currents = 0.5 * total * np.stack([1.0 - balance, 1.0 + balance], axis=-1)
    reading = readout(currents.astype(np.float32), device=device)
    np.testing.assert_allclose(reading.position, place, rtol=0, atol=1e-8)
    variance = 2.0 * reference.ELECTRON * bandwidth * background / total**2 * (LENGTH**2 / 12.0 + place**2)
    np.testing.assert_allclose(reading.sigma, np.sqrt(variance), rtol=1e-5)


def test_shot_noise_needs_a_bandwidth():
    for name in ("background", "dark_current"):
        with pytest.raises(ValueError, match=rf"{name} needs bandwidth \[Hz\]"):
            PsdNoise(**{name: 1e-6})
        with pytest.raises(ValueError, match=rf"{name} is -1"):
            PsdNoise(**{name: -1.0}, bandwidth=1e6)


def clipped_spot(centre, spot, length=LENGTH, nodes=40):
    """Return the signal and the mean of the part of a Gaussian spot on a strip, by Gauss-Legendre quadrature."""
    half = 0.5 * length
    edges = np.linspace(max(-half, centre - 40 * spot), min(half, centre + 40 * spot), 41)
    x, weight = np.polynomial.legendre.leggauss(nodes)
    width = np.diff(edges)[:, None] / 2
    y = (edges[:-1, None] + width * (x + 1)).ravel()
    # Relative to the largest density on the strip: no underflow for spots beyond the end.
    exponent = -0.5 * ((y - centre) / spot) ** 2
    density = np.exp(exponent - exponent.max()) * (width * weight).ravel()
    total = density.sum() * np.exp(exponent.max()) / (np.sqrt(2 * np.pi) * spot)
    return total, (density @ (y - centre)) / density.sum()


def test_bias_of_a_clipped_spot():
    """The closed form is the mean of the light on the strip, inside, at, and beyond either end, for any width."""
    spot = 50e-6
    inside = np.array([3.0, 2.0, 1.0, 0.0, -1.0, -2.0, -10.0, -30.0])
    table = [-0.0044, -0.0553, -0.2876, -0.7979, -1.5251, -2.3732]  # domain reference, to one unit of the last digit
    centre = 0.5 * LENGTH - inside * spot
    bias = gv.clipping_bias(centre, spot=spot, strip_length=LENGTH)
    np.testing.assert_allclose(bias[:6] / spot, table, atol=1e-4)
    np.testing.assert_allclose(gv.clipping_bias(-centre, spot=spot, strip_length=LENGTH), -bias, rtol=1e-15)
    for spot in (10e-6, 0.5e-3, 2e-3, 10e-3, 1.0):
        centre = np.concatenate([[0.0, 1e-9], 0.5 * LENGTH - inside * min(spot, LENGTH), 0.5 * LENGTH + spot * inside])
        bias = gv.clipping_bias(centre, spot=spot, strip_length=LENGTH)
        expected = [clipped_spot(each, spot)[1] for each in centre]
        np.testing.assert_allclose(bias, expected, rtol=1e-8, atol=1e-11 * LENGTH)
    assert gv.clipping_bias(0.0, spot=spot, strip_length=LENGTH).shape == ()


def test_what_the_bias_of_a_clipped_spot_refuses():
    for name in ("spot", "strip_length"):
        with pytest.raises(ValueError, match=f"{name} is 0"):
            gv.clipping_bias(0.0, **{"spot": 1e-4, "strip_length": LENGTH, name: 0.0})


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("dtype", ["float32", "float64", "uint16"])
def test_a_spot_cut_by_the_end_of_the_strip_is_flagged(device, rng, variant, dtype):
    """A spot that the end cuts is OUT_OF_RANGE if its bias exceeds the largest bias that the readout states."""
    spot, total = 50e-6, 0.8e-6
    unit = 2e-11 if dtype == "uint16" else 1.0
    inside = np.array([6.0, 4.0, 3.2, 2.8, 2.0, 1.0, 0.0, -1.0, -2.0])
    for end in (-1.0, 1.0):
        signal, bias = np.transpose([clipped_spot(0.5 * LENGTH - c * spot, spot) for c in inside])
        place = end * (0.5 * LENGTH - inside * spot + bias)
        pairs = total * signal[:, None] * np.stack([0.5 - place / LENGTH, 0.5 + place / LENGTH], axis=-1)
        # Many samples of each: in blocks of good samples, in blocks of bad ones, and beside each other.
        pairs = np.concatenate([np.repeat(pairs, 700, axis=0), np.tile(pairs, (50, 1))])
        recorded = np.rint(pairs / unit).astype(dtype) if dtype == "uint16" else pairs.astype(dtype)
        readout = PsdReadout(
            strip_length=LENGTH, ampere=unit, noise=PsdNoise(spot=spot, bandwidth=20e3), variant=variant
        )
        reading = readout(recorded, device=device)
        cut = np.concatenate([np.repeat(inside, 700), np.tile(inside, 50)]) < 3.0
        np.testing.assert_array_equal(reading.status, np.where(cut, Status.OUT_OF_RANGE, 0))
        np.testing.assert_array_equal(np.isnan(reading.position), cut)
        np.testing.assert_array_equal(np.isnan(reading.sigma), cut)
        assert np.isfinite(reading.total).all()
        assert np.abs(bias[inside >= 3.0]).max() <= readout.largest_clipping_bias < 0.0045 * spot
        # Without a margin the biased positions are read; their errors are the closed form.
        read = replace(readout, margin=0.0)(recorded, device=device)
        assert (read.status == 0).all()
        error = read.position[-len(inside) :] - end * (0.5 * LENGTH - inside * spot)
        rounding = {
            "float32": tolerance(np.float32),
            "float64": 1e-15,
            "uint16": LENGTH * unit / (total * signal.min()),
        }
        np.testing.assert_allclose(error, end * bias, rtol=0, atol=rounding[dtype])


@pytest.mark.double
def test_the_margin_is_a_parameter(device):
    """The limit is inclusive, and does not depend on load resistors; the default is three widths of the spot."""
    inner = 0.8
    for resistance, load in ((None, 0.0), (50e3, 1e3)):
        shrink = 1.0 if resistance is None else 1.0 + 2.0 * load / resistance
        xi = np.array([-0.81, -0.799, 0.0, 0.799, 0.81, 0.95]) / shrink
        readout = PsdReadout(
            strip_length=2.0, margin=1.0 - inner, interelectrode_resistance=resistance, load_resistance=load
        )
        status = readout(np.stack([1.0 - xi, 1.0 + xi], axis=-1), device=device).status
        assert (status == Status.OUT_OF_RANGE).tolist() == [True, False, False, False, True, True]
    codes = np.array([[1000, 9000], [1000, 8999], [9001, 1000]], np.uint16)
    readout = PsdReadout(strip_length=2.0, margin=0.2)
    assert readout(codes, device=device).status.tolist() == [0, 0, Status.OUT_OF_RANGE]
    assert PsdReadout(strip_length=1.0).applied_margin == 0.0
    assert PsdReadout(strip_length=1.0).largest_clipping_bias == 0.0
    spread = PsdReadout(strip_length=1.0, noise=PsdNoise(spot=0.1))
    assert spread.applied_margin == pytest.approx(0.3)
    assert replace(spread, noise=PsdNoise(spot=0.05)).applied_margin == pytest.approx(0.15)
    assert replace(spread, margin=0.0).applied_margin == 0.0
    # Without a margin a spot far beyond the end is read near the end.
    assert replace(spread, margin=0.0).largest_clipping_bias > 3.0
    with pytest.raises(ValueError, match=r"margin is 0.5 m;"):
        PsdReadout(strip_length=1.0, margin=0.5)
    with pytest.raises(ValueError, match=r"3 times noise\.spot"):
        PsdReadout(strip_length=1.0, noise=PsdNoise(spot=0.2))


@pytest.mark.double
def test_ambient_light_pulls_to_the_electrical_centre_and_the_dark_level_undoes_it(device):
    ambient = 100e-6
    pair = np.array([[0.2e-6 + ambient, 0.8e-6 + ambient]])
    pulled = PsdReadout(strip_length=LENGTH)(pair, device=device).position[0]
    undone = PsdReadout(strip_length=LENGTH, dark=(ambient, ambient))(pair, device=device).position[0]
    assert pulled == pytest.approx(0.3 * LENGTH * 1e-6 / (1e-6 + 2 * ambient), rel=1e-9)
    assert undone == pytest.approx(0.3 * LENGTH, rel=1e-9)


@pytest.mark.double
def test_load_resistors_shrink_and_the_readout_undoes_it(device):
    shrunk = 0.6 / (1 + 2 * 1e3 / 50e3)
    pair = np.array([[0.5 - shrunk / 2, 0.5 + shrunk / 2]])
    readout = PsdReadout(strip_length=LENGTH, interelectrode_resistance=50e3, load_resistance=1e3)
    assert readout(pair, device=device).position[0] == pytest.approx(0.6 * LENGTH / 2, rel=1e-12)
    beyond = np.array([[0.001, 0.999]])
    assert readout(beyond, device=device).status[0] == Status.OUT_OF_RANGE


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_sheet_in_the_same_pass(device, rng, variant):
    sheet = Triangulation(
        homography=((0.8, 0.01, 1e-3), (0.02, 1.0, 2e-3), (5.0, 0.3, 1.0)),
        region=((-3e-3, 3e-3), (-4e-3, 4e-3)),
    )
    axes = SampleAxes(sample_pitch=1e-4, sample_origin=-32e-4)
    pairs = currents(rng, (50, 65, 2))
    pairs[3, 7] = np.nan
    readout = PsdReadout(strip_length=LENGTH, triangulation=sheet, axes=axes, variant=variant)
    reading = readout(pairs, device=device)
    expected = reference.read_out(readout, pairs[..., 0], pairs[..., 1])
    v = -32e-4 + 1e-4 * np.arange(65)
    matrix = np.array(sheet.homography)
    sensor = np.stack(np.broadcast_arrays(expected.position, v, 1.0))
    place = np.einsum("ij,j...->i...", matrix, sensor)
    good = expected.status == 0
    np.testing.assert_array_equal(reading.status, expected.status)
    # The slopes of G and H over u are below 1.2 in this sheet.
    for value, row in ((reading.g, 0), (reading.h, 1)):
        np.testing.assert_allclose(value[good], (place[row] / place[2])[good], rtol=0, atol=3 * tolerance(np.float32))
        assert np.isnan(value[~good]).all()


def test_a_systematic_error_needs_a_covariance():
    sheet = Triangulation(homography=np.eye(3), region=((-3e-3, 3e-3), (-4e-3, 4e-3)))
    for readout in (lambda **more: PsdReadout(strip_length=LENGTH, **more), LineReadout):
        with pytest.raises(ValueError, match=r"outputs has 'systematic_h', but its triangulation has no covariance"):
            readout(triangulation=sheet, outputs=("position", "systematic_h"))


def test_sigma_travels_to_the_sheet(device, rng):
    sheet = Triangulation(
        homography=((0.8, 0.01, 1e-3), (0.02, 1.0, 2e-3), (5.0, 0.3, 1.0)),
        region=((-3e-3, 3e-3), (-4e-3, 4e-3)),
        covariance=np.diag([1e-14, 2e-14, 3e-14, 4e-14, 5e-14, 6e-14, 1e-8, 2e-8]),
    )
    pairs = currents(rng, (50, 65, 2))
    pairs[3, 7] = np.nan
    names = ("position", "sigma", "sigma_g", "sigma_h", "systematic_g", "systematic_h", "status")
    settings = {"strip_length": LENGTH, "noise": PsdNoise(independent=1e-9), "axes": SampleAxes(sample_pitch=1e-4)}
    reading = PsdReadout(triangulation=sheet, outputs=names, **settings)(pairs, device=device)
    good = reading.status == 0
    u, v = reading.position.astype(np.float64), np.broadcast_to(1e-4 * np.arange(65), good.shape)

    def points(u):
        lifted = np.einsum("ij,j...->i...", np.array(sheet.homography), np.stack([u, v, np.ones(u.shape)]))
        return lifted[:2] / lifted[2]

    slopes = np.abs(points(u + 1e-7) - points(u - 1e-7)) / 2e-7
    of_parameters = sheet.covariance_at(np.stack([u, v], axis=-1))
    for axis, name in enumerate("gh"):
        noise, systematic = getattr(reading, f"sigma_{name}"), getattr(reading, f"systematic_{name}")
        # Where the point hardly moves, its slope is a difference of terms in float32.
        rounding = 1e-5 * np.max(slopes[axis][good]) * np.max(reading.sigma[good])
        np.testing.assert_allclose(noise[good], (slopes[axis] * reading.sigma)[good], rtol=1e-4, atol=rounding)
        np.testing.assert_allclose(systematic[good], np.sqrt(of_parameters[good][:, axis, axis]), rtol=1e-4)
        assert np.isnan([noise[3, 7], systematic[3, 7]]).all()


@pytest.mark.double
@pytest.mark.parametrize("variant", VARIANTS)
@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    batch=st.lists(st.integers(1, 90), min_size=0, max_size=3).map(tuple),
    dtype=st.sampled_from(["float32", "float64", "uint16"]),
    layout=st.sampled_from(["pairs", "planar"]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_shape(device, variant, batch, dtype, layout, seed):
    values = currents(np.random.default_rng(seed), (2, *batch), dtype)
    given_ = np.ascontiguousarray(np.moveaxis(values, 0, -1)) if layout == "pairs" else values
    readout = PsdReadout(strip_length=LENGTH, layout=layout, variant=variant)
    guarded = Guarded(readout(given_, device=device))
    reading = readout(given_, device=device, out=guarded.out)
    assert reading is guarded.out
    guarded.assert_intact()
    assert_like_reference(readout, reading, *values)


def test_outputs_are_chosen(device, rng):
    reading = PsdReadout(strip_length=LENGTH, outputs=("status",))(currents(rng, (40, 2)), device=device)
    assert reading.position is None
    assert reading.total is None
    assert (reading.status == 0).all()


@pytest.mark.parametrize("name", ["g", "h", "position"])
def test_one_output_of_the_sheet(device, rng, name):
    """Outputs that are not requested are not written, also with a triangulation."""
    sheet = Triangulation(homography=((1, 0, 0), (0, 1, 0), (5.0, 0, 1)), region=((-3e-3, 3e-3), (-4e-3, 4e-3)))
    pairs = currents(rng, (40, 2))
    complete = PsdReadout(strip_length=LENGTH, triangulation=sheet)(pairs, device=device)
    alone = PsdReadout(strip_length=LENGTH, triangulation=sheet, outputs=(name,))(pairs, device=device)
    np.testing.assert_array_equal(getattr(alone, name), getattr(complete, name))
    assert sum(each is not None for each in alone) == 1


def test_an_empty_batch_is_no_error(device):
    reading = PsdReadout(strip_length=LENGTH)(np.zeros((0, 4, 2), np.float32), device=device)
    assert reading.position.shape == (0, 4)


def test_bound_and_device_arrays_say_the_same(device, rng):
    readout = PsdReadout(strip_length=LENGTH)
    pairs = currents(rng, (1000, 2))
    expected = readout(pairs, device=device)
    bound = readout.bind(device, pairs.shape, pairs.dtype)
    frame = device.empty(pairs.shape, pairs.dtype)
    frame.set(pairs)
    bound(frame).wait()
    np.testing.assert_array_equal(bound.outputs.position.get(), expected.position)
    np.testing.assert_array_equal(readout(frame).position.get(), expected.position)
    if device.shares_memory:
        host_view(bound.inputs[0])[...] = pairs[::-1]
        bound().wait()
        np.testing.assert_array_equal(host_view(bound.outputs.position), expected.position[::-1])


@pytest.mark.parametrize(
    ("values", "error", "message"),
    [
        (np.zeros((4, 2), np.int32), TypeError, "float32, float64 or uint16"),
        (np.zeros((4, 3), np.float32), ValueError, r"\(\.\.\., 2\)"),
        (np.zeros((8, 4), np.float32)[:, ::2], ValueError, "C-contiguous"),
        ([[1.0, 2.0]], TypeError, "NumPy arrays or pyopencl arrays"),
    ],
)
def test_wrong_input_is_told(device, values, error, message):
    with pytest.raises(error, match=message):
        PsdReadout(strip_length=LENGTH)(values, device=device)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"strip_length": 0.0}, "strip_length"),
        ({"strip_length": float("nan")}, "strip_length"),
        ({"right_gain": -1.0}, "right_gain"),
        ({"load_resistance": 5.0}, "interelectrode_resistance"),
        ({"layout": "rows"}, "layout"),
        ({"outputs": ("place",)}, "'place'"),
        ({"outputs": ("g",)}, "'g'"),
        ({"linearity": ((0.0,),)}, "knots"),
        ({"saturation": -1.0}, "saturation"),
        ({"saturation": float("nan")}, "saturation"),
        ({"interelectrode_resistance": -5.0, "load_resistance": 1.0}, "interelectrode_resistance"),
        ({"dark": (float("nan"), 0.0)}, "dark"),
        ({"dark": (1e-9,)}, "dark|unpack"),
        ({"linearity": ((0.0, 1.0), (0.0, 1.0, 2.0))}, "knots"),
    ],
)
def test_wrong_parameters_are_told(changes, message):
    with pytest.raises(ValueError, match=message):
        PsdReadout(**({"strip_length": LENGTH} | changes))


@pytest.mark.parametrize("changes", [{"dark": 3.0}, {"noise": 3}, {"linearity": 5}])
def test_parameters_of_another_kind_are_told(changes):
    with pytest.raises(TypeError, match=next(iter(changes))):
        PsdReadout(strip_length=LENGTH, **changes)


def test_a_list_of_dark_currents_is_as_good(device):
    pairs = np.full((20, 2), 1.0, np.float32)
    assert PsdReadout(strip_length=LENGTH, dark=[0.5, 0.5])(pairs, device=device).total[0] == 1.0


def test_a_scale_that_overflows_the_total_is_flagged(device):
    reading = PsdReadout(strip_length=LENGTH, ampere=1e38)(np.full((20, 2), 4.0, np.float32), device=device)
    assert (reading.status == Status.SATURATED).all()


@pytest.mark.double
def test_precision_is_never_lowered_in_silence(device):
    with pytest.raises(TypeError, match="single"):
        PsdReadout(strip_length=LENGTH, precision="single")(np.ones((4, 2)), device=device)
    double = PsdReadout(strip_length=LENGTH, precision="double")(np.ones((4, 2), np.float32), device=device)
    assert double.position.dtype == np.float64


def test_wrong_out_is_told(device, rng):
    readout, pairs = PsdReadout(strip_length=LENGTH), currents(rng, (32, 2))
    out = readout(pairs, device=device)
    with pytest.raises(TypeError, match=r"out\.position"):
        readout(pairs, device=device, out=out._replace(position=out.position.astype(float)))
    with pytest.raises(ValueError, match=r"out\.status"):
        readout(pairs, device=device, out=out._replace(status=out.status[:5]))


def test_strips_must_match_the_linearity_table(device):
    readout = replace(PsdReadout(strip_length=LENGTH), linearity=((0.0, 0.0),) * 3)
    with pytest.raises(ValueError, match="3 rows, the input has 4 strips"):
        readout(np.ones((2, 4, 2), np.float32), device=device)


def test_the_public_name(device, rng):
    assert gv.PsdReadout is PsdReadout
