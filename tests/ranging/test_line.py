"""Line readout against the float64 oracle: both axes, both kernel variants, every dtype, odd shapes and extremes."""

from __future__ import annotations

import copy
import itertools
from dataclasses import replace

import numpy as np
import pyopencl as cl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.ranging.line import LineReadout
from gpuvision.ranging.line_parameters import Method
from gpuvision.ranging.sheet import SampleAxes
from gpuvision.ranging.triangulation import Triangulation
from gpuvision.reference.line import (
    AMBIGUOUS,
    LOW_SIGNAL,
    NOT_FINITE,
    OUT_OF_RANGE,
    SATURATED,
    pixel_gaussian,
    read_lines,
)
from gpuvision.reference.triangulation import triangulate
from gpuvision.status import Status
from guard_pages import assert_within_pages
from tiers import variants_of

TOP = {"uint8": 180.0, "uint16": 40_000.0, "float32": 100.0}
LEVEL = {"uint8": 20, "uint16": 4000, "float32": 8.5}
VARIANTS = ("vector", "work_item")
# Most builds know the window: each value is a kernel more to compile. Tests take this one unless they are about it.
WINDOW = 6
EVERY = list(itertools.product(TOP, ("columns", "rows"), VARIANTS))


def line_frames(rng, dtype, shape, along="columns", sigma=1.7, swing=0.45):
    """A Gaussian line that wanders by +-`swing` of the length over noise, some profiles dark."""
    *batch, rows, columns = shape
    length, samples = (rows, columns) if along == "columns" else (columns, rows)
    k, i = np.arange(length)[:, None], np.arange(samples)
    place = length * (0.5 + swing * np.sin(0.05 * i)) + rng.uniform(-0.5, 0.5, (*batch, samples))[..., None, :]
    light = np.where(rng.random((*batch, samples)) < 0.06, 0.0, rng.uniform(0.3, 1.0, (*batch, samples)))
    frames = light[..., None, :] * np.exp(-((k - place) ** 2) / (2 * sigma**2))
    frames = TOP[dtype] * (frames + rng.uniform(0.0, 0.07, frames.shape))
    if along == "rows":
        frames = np.swapaxes(frames, -1, -2)
    return np.ascontiguousarray(frames.astype(dtype))


def between_bright_frames(frames):
    """Return a batch with a frame of the largest values before and after the frames: reads beyond them see light."""
    bright = np.full_like(frames[:1], np.inf if frames.dtype.kind == "f" else np.iinfo(frames.dtype).max)
    return np.concatenate([bright, frames, bright])


def without_bright_frames(reading):
    """Return the outputs of the frames between the bright ones."""
    return type(reading)(*(None if each is None else each[1:-1] for each in reading))


def assert_same(reading, expected, precision=np.float32, slack=1.0):
    """Assert that status, peak and width are equal, and the position within a few ulp."""
    np.testing.assert_array_equal(reading.status, expected["status"])
    np.testing.assert_array_equal(reading.peak, expected["peak"])
    np.testing.assert_array_equal(reading.width, expected["width"])
    eps = np.finfo(precision).eps
    # Three roundings of the position, and the roundings of about ten sums over the window.
    np.testing.assert_allclose(reading.position, expected["position"], rtol=3 * eps, atol=slack * 40 * eps)
    np.testing.assert_allclose(reading.total, expected["total"], rtol=20 * eps)


@pytest.mark.parametrize("method", ["centroid", "windowed"])
@pytest.mark.parametrize(("dtype", "along", "variant"), EVERY)
def test_centre_of_gravity(device, rng, method, dtype, along, variant):
    second = {"ambiguity": 0.5} if method == "windowed" and dtype == "uint8" else {}
    parameters = {"method": method, "along": along, "threshold": LEVEL[dtype], "window": WINDOW, **second}
    readout = LineReadout(variant=variant, **parameters)
    # The last one has a column more than one strip takes, or a row of many blocks and a rest.
    for shape in ((2, 137, 201), (1, 64, 64), (1, 50, 1025)):
        frames = line_frames(rng, dtype, shape, along, swing=0.5)
        reading = without_bright_frames(readout(between_bright_frames(frames), device=device))
        expected = read_lines(frames, **parameters)
        assert np.any(expected["status"] & OUT_OF_RANGE)
        # Along a thousand samples the light far from the line, up to the threshold, weighs by its distance.
        assert_same(reading, expected, slack=4.0)


@pytest.mark.parametrize(
    ("method", "dtype", "along", "variant"),
    [
        ("gauss3", "uint8", "columns", "vector"),
        ("gauss3", "float32", "rows", "work_item"),
        ("fir", "uint16", "rows", "vector"),
        ("fir", "uint8", "columns", "work_item"),
        ("ml", "uint8", "columns", "vector"),
        ("ml", "uint16", "rows", "work_item"),
    ],
)
def test_fits(device, rng, method, dtype, along, variant):
    noise = {"read_noise": TOP[dtype] * 0.02, "gain": 0.3} if method == "ml" else {}
    # More samples for the fit with the noise of uint16, so that it converges in nearly all profiles.
    window = 7 if dtype == "uint16" else WINDOW
    second = {"ambiguity": 0.5} if method == "fir" else {}
    parameters = {"method": method, "along": along, "threshold": LEVEL[dtype], "window": window, **noise, **second}
    frames = line_frames(rng, dtype, (1, 40, 83) if along == "columns" else (1, 83, 40), along)
    if dtype == "uint8":
        frames = np.pad(frames, ((0, 0), (5, 5), (0, 0)))
    readout = LineReadout(variant=variant, **parameters)
    reading = without_bright_frames(readout(between_bright_frames(frames), device=device))
    expected = read_lines(frames, **parameters)
    if method == "ml":
        # With these draws; other draws have larger errors in up to 1 % of the lines, see the next test.
        np.testing.assert_array_equal(reading.status & ~np.uint8(AMBIGUOUS), expected["status"])
        settled = (reading.status & AMBIGUOUS) == 0
        assert settled.mean() > 0.95
        np.testing.assert_allclose(reading.position[settled], expected["position"][settled], atol=1e-4)
    else:
        # The rounding errors of a logarithm or quotient are larger where the peak is flat.
        assert_same(reading, expected, slack=20.0)


@pytest.mark.slow
def test_few_fits_end_early(device, rng):
    """The iteration of some weak lines ends before the error that is usual; the docstring states both."""
    parameters = {"method": "ml", "threshold": LEVEL["uint8"], "window": WINDOW, "read_noise": 5.1, "gain": 0.3}
    readout = LineReadout(**parameters)
    errors = []
    for _ in range(6):
        frames = np.pad(line_frames(rng, "uint8", (1, 40, 83)), ((0, 0), (5, 5), (0, 0)))
        reading = readout(frames, device=device)
        settled = (reading.status & AMBIGUOUS) == 0
        error = np.abs(reading.position - read_lines(frames, **parameters)["position"])[settled]
        errors.append(error[np.isfinite(error)])
    error = np.concatenate(errors)
    assert len(error) > 400
    # 21 of 4182 errors were above 1.5e-4 px; the largest was 6.4e-4 px.
    assert np.mean(error > 1.5e-4) < 0.02
    assert np.max(error) < 1e-3


@pytest.mark.parametrize("variant", VARIANTS)
def test_fits_of_lines_of_any_width(device, rng, variant):
    """Lines narrower than 1.6 px, and wider than 12 px, are fitted by integrals; the others by values at pixels."""
    k, parameters = np.arange(120)[:, None], {"method": "ml", "window": 30, "read_noise": 2.0, "gain": 0.1}
    for sigmas in ((0.7, 1.5, 1.7, 2.0), (3.0, 7.0, 11.5, 12.5)):
        place, sigma = 60 + rng.uniform(-0.5, 0.5, 16), np.tile(sigmas, 4)
        light = pixel_gaussian(k, place, sigma, 180.0 / np.maximum(1.0, sigma / 4.0), 12.0)
        frame = np.rint(light + rng.normal(0.0, 0.5, light.shape)).astype(np.uint8)
        reading = LineReadout(variant=variant, **parameters)(frame, device=device)
        expected = read_lines(frame, **parameters)
        np.testing.assert_array_equal(reading.status & ~np.uint8(SATURATED), 0)
        np.testing.assert_allclose(reading.position, expected["position"], atol=1e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_bound_of_the_fit_for_the_narrowest_lines_with_strong_noise(device, rng, variant):
    """Worst case of the model at pixel middles: sigma 1.6 px, and noise that scatters the position by 0.09 px."""
    place, parameters = 20 + rng.uniform(-0.5, 0.5, 300), {"method": "ml", "window": 8, "read_noise": 4.0}
    light = pixel_gaussian(np.arange(41)[:, None], place, 1.6, 60.0, 20.0)
    frame = np.rint(light + rng.normal(0.0, 4.0, light.shape)).astype(np.uint8)
    reading = LineReadout(variant=variant, threshold=35, **parameters)(frame, device=device)
    expected = read_lines(frame, threshold=35, **parameters)
    np.testing.assert_array_equal(reading.status, 0)
    np.testing.assert_allclose(reading.position, expected["position"], atol=1.5e-4)


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_fit_does_not_depend_on_its_neighbours(device, rng, variant):
    k, place, sigma = np.arange(60)[:, None], rng.uniform(18, 42, 96), rng.uniform(0.6, 4.0, 96)
    light = pixel_gaussian(k, place, sigma, 150.0, 12.0)
    frame = np.clip(light + rng.normal(0.0, 5.0, light.shape), 0, 255).astype(np.uint8)
    order, readout = rng.permutation(96), LineReadout(method="ml", window=8, gain=0.1, variant=variant)
    position, status = readout(frame, device=device).position, readout(frame, device=device).status
    moved = readout(np.ascontiguousarray(frame[:, order]), device=device)
    np.testing.assert_array_equal(moved.position, position[order])
    np.testing.assert_array_equal(moved.status, status[order])


@pytest.mark.parametrize("peak_selection", ["first", "last", "nearest", "strongest"])
@pytest.mark.parametrize(
    "kernel",
    [("uint8", "columns", "vector"), ("uint16", "rows", "vector"), ("float32", "columns", "work_item")],
    ids="-".join,
)
def test_peak_selection(device, rng, peak_selection, kernel):
    dtype, along, variant = kernel
    parameters = {"along": along, "threshold": LEVEL[dtype], "window": WINDOW, "peak_selection": peak_selection}
    parameters |= {"minimum_width": 2, "maximum_width": 9, "minimum_peak": LEVEL[dtype] * 2}
    shape = (2, 90, 50) if along == "columns" else (2, 50, 90)
    frames = np.maximum(line_frames(rng, dtype, shape, along), line_frames(rng, dtype, shape, along, sigma=0.8))
    frames[..., 20, 30] = TOP[dtype] * 1.2  # hot
    profiles = frames if along == "columns" else np.swapaxes(frames, 1, 2)
    profiles[:, :3, 40:43] = profiles[:, -4:, 42:45] = TOP[dtype] * 1.1  # runs that begin or end with the profile
    # Runs as wide as the limits and one sample wider or narrower, and peaks at the lowest level and below it.
    profiles[:, :, 10:18] = 0
    for number, width in enumerate((1, 2, 9, 10)):
        profiles[:, 30 : 30 + width, 10 + number] = TOP[dtype] * 0.7
    for number, level in enumerate((-1, 0, 1)):
        profiles[:, 30:33, 14 + number] = LEVEL[dtype] * 2 + level
    second = ()
    if peak_selection == "nearest":
        previous = rng.uniform(-5, 95, (2, 50)).astype(np.float32)
        previous[0, ::7] = np.nan
        second = (np.pad(previous, ((1, 1), (0, 0))),)
        parameters["previous"] = previous
    expected = read_lines(frames, **parameters)
    parameters.pop("previous", None)
    readout = LineReadout(variant=variant, **parameters)
    reading = readout(between_bright_frames(frames), *second, device=device)
    assert_same(without_bright_frames(reading), expected)


def test_levels_at_their_limits(device):
    """The threshold is exclusive; the smallest peak and the level of saturation are inclusive."""
    levels = np.array([19, 20, 21, 59, 60, 61, 199, 200, 201])
    frame = np.zeros((40, 64), np.uint8)
    for column in range(64):
        frame[15:18, column] = levels[column % 9] // 2, levels[column % 9], levels[column % 9] // 3
    limits = {"threshold": 20, "saturation": 200}
    for method, variant in itertools.product(("centroid", "windowed"), variants_of(device)):
        for lowest, first_read in ((20, 21), (60, 60)):
            parameters = {"method": method, "minimum_peak": lowest, "window": WINDOW, **limits}
            reading = LineReadout(variant=variant, **parameters)(frame, device=device)
            assert_same(reading, read_lines(frame, **parameters))
            status = np.where(levels < first_read, LOW_SIGNAL, np.where(levels < 200, 0, SATURATED))
            np.testing.assert_array_equal(reading.status, np.resize(status, 64))


def test_a_second_peak_at_its_limits(device):
    """A peak of half the light, just beyond the window, is a second one; less light or a place in the window is not."""
    places = {"beyond": 4 + 1, "within": 4}
    for along, (name, place), level in itertools.product(("columns", "rows"), places.items(), (84, 85, 86)):
        for side in (-1, 1):
            frame = np.zeros((94, 64), np.uint8)
            frame[40], frame[40 + side * place] = 105, level
            frame = frame if along == "columns" else np.ascontiguousarray(frame.T)
            reading = LineReadout(threshold=5, window=4, ambiguity=0.8, along=along)(frame, device=device)
            ambiguous = name == "beyond" and level >= 85
            np.testing.assert_array_equal(reading.status, AMBIGUOUS if ambiguous else 0)


def test_widths_at_the_limits_are_read(device):
    """Lines of 1 to 6 lit samples, of which 3 to 5 are wide enough and not too wide for the centroid."""
    frame = np.zeros((24, 18), np.uint8)
    for column in range(18):
        frame[9 : 10 + column % 6, column] = 100
    reading = LineReadout(method="centroid", threshold=20, minimum_width=3, maximum_width=5)(frame, device=device)
    lit = 1 + np.arange(18) % 6
    np.testing.assert_array_equal(reading.width, lit)
    np.testing.assert_array_equal(reading.status == 0, (lit >= 3) & (lit <= 5))
    np.testing.assert_array_equal(np.isfinite(reading.position), reading.status == 0)


@pytest.mark.double
@pytest.mark.parametrize("variant", VARIANTS)
def test_double(device, rng, variant):
    frames = line_frames(rng, "float32", (130, 33))
    for method in ("centroid", "windowed"):
        parameters = {"method": method, "threshold": 8.5, "window": WINDOW}
        reading = LineReadout(variant=variant, precision="double", **parameters)(frames, device=device)
        assert reading.position.dtype == np.float64
        assert_same(reading, read_lines(frames, **parameters), np.float64, slack=10.0)


@given(rows=st.integers(1, 90), columns=st.integers(1, 150), frames=st.integers(1, 3), seed=st.integers(0, 99))
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
def test_any_shape(device, rows, columns, frames, seed):
    rng = np.random.default_rng(seed)
    image = line_frames(rng, "uint8", (frames, rows, columns))
    for method, variant in itertools.product(("centroid", "windowed"), variants_of(device)):
        parameters = {"method": method, "threshold": 20, "window": WINDOW}
        assert_same(
            LineReadout(variant=variant, **parameters)(image, device=device), read_lines(image, **parameters), slack=4.0
        )


@pytest.mark.parametrize(
    ("method", "variant"), [("centroid", "vector"), ("windowed", "vector"), ("windowed", "work_item")]
)
@pytest.mark.parametrize("along", ["columns", "rows"])
def test_writes_nothing_else(device, rng, method, variant, along):
    shape = (2, 71, 83)
    frames = line_frames(rng, "uint8", shape, along)
    readout = LineReadout(method=method, variant=variant, along=along, threshold=20, window=WINDOW)
    guarded = Guarded(readout(frames, device=device))
    assert readout(frames, device=device, out=guarded.out) is guarded.out
    guarded.assert_intact()
    assert_same(guarded.out, read_lines(frames, method=method, along=along, threshold=20, window=WINDOW), slack=4.0)


@pytest.mark.slow
def test_reads_within_its_frames():
    assert_within_pages("line")


def test_outputs(device, rng):
    frames = line_frames(rng, "uint8", (64, 70))
    full = LineReadout(threshold=20, window=WINDOW)(frames, device=device)
    some = LineReadout(threshold=20, window=WINDOW, outputs=("position", "status"))(frames, device=device)
    assert {name for name, array in some._asdict().items() if array is not None} == {"position", "status"}
    np.testing.assert_array_equal(some.position, full.position)


def column(*values, dtype=np.uint8):
    """Return a frame of 64 equal columns."""
    return np.repeat(np.array(values, dtype)[:, None], 64, axis=1)


DARKNESS = (0,) * 6
EXTREMES = {
    "all zero": (column(*[0] * 20), LOW_SIGNAL),
    "flat top": (column(*DARKNESS, 90, 255, 255, 255, 255, 255, 60, *DARKNESS), SATURATED),
    "top wider than half the window": (column(*DARKNESS, *[255] * 8, *DARKNESS), SATURATED),
    "top as wide as the window": (column(*DARKNESS, *[255] * 9, *DARKNESS), SATURATED),
    "top wider than the window": (column(*DARKNESS, *[255] * 10, *DARKNESS), SATURATED | AMBIGUOUS),
    "wide top at the border": (column(*[255] * 12, *DARKNESS), SATURATED | OUT_OF_RANGE | AMBIGUOUS),
    "wide top at the end": (column(*DARKNESS, *[255] * 12), SATURATED | OUT_OF_RANGE | AMBIGUOUS),
    "ties apart": (column(*DARKNESS, 100, 250, 100, 250, 250, 100, *DARKNESS), 0),
    "edge": (column(200, 90, 10, *DARKNESS, *DARKNESS), OUT_OF_RANGE),
    "last row": (column(*DARKNESS, *DARKNESS, 10, 90, 200), OUT_OF_RANGE),
    "two equal peaks": (column(*DARKNESS, 50, 100, 50, *DARKNESS, 50, 100, 50, *DARKNESS), AMBIGUOUS),
    "tie of neighbours": (column(*DARKNESS, 30, 90, 90, 30, *DARKNESS), 0),
    "one pixel": (column(*DARKNESS, 200, *DARKNESS), 0),
    "narrow": (column(*DARKNESS, 1, 250, 3, *DARKNESS), 0),
    "plateau at the threshold": (column(*DARKNESS, 5, 5, 5, 5, *DARKNESS), LOW_SIGNAL),
    "all saturated": (column(*[255] * 20), SATURATED | OUT_OF_RANGE | AMBIGUOUS),
}


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("along", ["columns", "rows"])
def test_extremes(device, variant, along):
    readout = LineReadout(threshold=5, window=4, ambiguity=0.8, along=along, variant=variant)
    for name, (frame, status) in EXTREMES.items():
        frame = frame if along == "columns" else np.ascontiguousarray(np.pad(frame.T, ((0, 0), (0, 64))))
        if along == "rows" and name in ("last row", "all saturated", "wide top at the end"):
            continue  # the padding removes the effect of the border
        reading = readout(frame, device=device)
        assert_same(reading, read_lines(frame, threshold=5, window=4, ambiguity=0.8, along=along))
        assert set(reading.status.ravel()) == {status}, name
        assert np.all(np.isnan(reading.position) == bool(status & (LOW_SIGNAL | OUT_OF_RANGE))), name


def test_flat_top_is_read_in_its_middle(device):
    frame = column(*[0] * 9, *[255] * 6, *[0] * 9)
    for method in ("windowed", "gauss3", "fir"):
        reading = LineReadout(method=method, threshold=5, window=WINDOW)(frame, device=device)
        np.testing.assert_allclose(reading.position[reading.status & LOW_SIGNAL == 0], 11.5)


METHODS_WITH_PEAKS = ("windowed", "gauss3", "fir", "ml")


@pytest.mark.parametrize(
    "kernel",
    [
        (along, peak_selection, variant)
        for along, peak_selection in (("columns", "strongest"), ("rows", "strongest"), ("columns", "last"))
        for variant in VARIANTS
    ],
    ids="-".join,
)
@pytest.mark.parametrize("method", METHODS_WITH_PEAKS)
def test_top_wider_than_the_window(device, kernel, method):
    along, peak_selection, variant = kernel
    for width in (20, 21):
        frame = column(*[0] * 20, *[255] * width, *[0] * 40)
        frame = frame if along == "columns" else np.ascontiguousarray(frame.T)
        readout = LineReadout(
            method=method, threshold=5, window=WINDOW, along=along, peak_selection=peak_selection, variant=variant
        )
        reading = readout(frame, device=device)
        np.testing.assert_array_equal(reading.position, 20 + (width - 1) / 2)
        np.testing.assert_array_equal(reading.status, SATURATED | AMBIGUOUS)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("peak_selection", ["first", "strongest"])
@pytest.mark.parametrize("method", ["gauss3", "fir", "windowed"])
def test_only_neighbours_make_a_flat_top(device, variant, peak_selection, method):
    frame = column(*[0] * 19, 100, 255, 100, *[0] * 4, 100, 255, 255, *[0] * 20)
    parameters = {
        "method": method,
        "threshold": 5,
        "window": {"gauss3": 8, "fir": WINDOW, "windowed": 3}[method],
        "peak_selection": peak_selection,
    }
    reading = LineReadout(variant=variant, **parameters)(frame, device=device)
    np.testing.assert_array_equal(reading.status, SATURATED)
    np.testing.assert_allclose(reading.position, 20.0, atol=1e-5)


@pytest.mark.parametrize(
    ("dtype", "gain"), [("uint8", 0.0), ("uint8", 0.3), pytest.param("float32", 0.3, marks=pytest.mark.slow)]
)
def test_fit_of_noise_stays_at_its_peak(device, rng, dtype, gain):
    """If the fit does not converge inside the window, the centre of gravity is returned."""
    frame = rng.integers(0, 255, (70, 400)).astype(dtype)
    gravity = LineReadout(threshold=20, window=WINDOW)(frame, device=device)
    readings = []
    for variant in variants_of(device):
        fit = LineReadout(method="ml", threshold=20, window=WINDOW, gain=gain, variant=variant)(frame, device=device)
        given = ~np.isnan(gravity.position)
        np.testing.assert_array_equal(np.isnan(fit.position), ~given)
        peak = frame.argmax(axis=0)
        assert np.all(np.abs(fit.position - peak)[given] <= WINDOW)
        fallen = given & (fit.status & AMBIGUOUS != 0)
        assert 0.2 < fallen.sum() / given.sum() < 0.9
        np.testing.assert_allclose(fit.position[fallen], gravity.position[fallen], atol=1e-5)
        readings.append(fit)
    # Rounding decides about a fit at the limit of convergence.
    same = readings[0].status == readings[-1].status
    assert same.mean() > 0.98
    np.testing.assert_allclose(readings[0].position[same], readings[-1].position[same], atol=0.01)


def test_fit_leaves_saturated_samples_out(device):
    k = np.arange(41)[:, None]
    place = 20 + np.linspace(-0.5, 0.5, 64)
    frame = np.minimum(np.rint(600 * np.exp(-((k - place) ** 2) / (2 * 2.5**2)) + 10), 255).astype(np.uint8)
    reading = LineReadout(method="ml", threshold=10, window=8, read_noise=1.0)(frame, device=device)
    assert np.all(reading.status == SATURATED)
    # Quantisation of the flanks; the centre of gravity of the flat top is no better.
    np.testing.assert_allclose(reading.position, place, atol=0.02)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("along", ["columns", "rows"])
@pytest.mark.parametrize(
    "estimator", [("centroid", "strongest"), ("windowed", "strongest"), ("windowed", "last")], ids="-".join
)
def test_not_finite(device, rng, variant, along, estimator):
    method, peak_selection = estimator
    frames = line_frames(rng, "float32", (60, 70), along) - 50.0  # negative after a dark frame
    frames[7, 20], frames[11, 21], frames[13, 22] = np.nan, np.inf, -np.inf
    parameters = {
        "method": method,
        "peak_selection": peak_selection,
        "threshold": 0.0,
        "window": WINDOW,
        "along": along,
        "saturation": 1e9,
    }
    reading, expected = (
        LineReadout(variant=variant, **parameters)(frames, device=device),
        read_lines(frames, **parameters),
    )
    lost = expected["status"] & NOT_FINITE != 0
    assert lost.sum() == 3
    np.testing.assert_array_equal(reading.status, expected["status"])
    assert all(np.isnan(getattr(reading, name)[lost]).all() for name in ("position", "peak", "width", "total"))
    np.testing.assert_allclose(reading.position[~lost], expected["position"][~lost], rtol=4e-7, atol=2e-5)


@pytest.mark.parametrize(("along", "variant"), list(itertools.product(("columns", "rows"), VARIANTS)))
@pytest.mark.parametrize("method", ["centroid", "windowed", "fir"])
def test_nothing_finite(device, along, variant, method):
    """Profiles of NaN only have no peak, along rows also no second one."""
    second = {"ambiguity": 0.5} if along == "rows" and method != "centroid" else {}
    readout = LineReadout(along=along, variant=variant, method=method, threshold=1, window=WINDOW, **second)
    for value in (np.nan, -np.inf, np.inf):
        reading = readout(np.full((64, 64), value, np.float32), device=device)
        np.testing.assert_array_equal(reading.status, NOT_FINITE)
        assert np.isnan(reading.position).all()


@pytest.mark.parametrize(("along", "variant"), list(itertools.product(("columns", "rows"), VARIANTS)))
@pytest.mark.parametrize("peak_selection", ["strongest", "last"])
def test_sums_beyond_the_largest_number(device, along, variant, peak_selection):
    """Finite samples whose sum overflows in single precision."""
    frame = column(*[0.0] * 20, 2e38, 3e38, 2e38, *[0.0] * 41, dtype=np.float32)
    for threshold, method in itertools.product((0.0, 1.0), ("windowed", "centroid", "gauss3")):
        if method == "centroid" and peak_selection == "last":
            continue
        readout = LineReadout(
            method=method,
            along=along,
            threshold=threshold,
            window=WINDOW,
            peak_selection=peak_selection,
            variant=variant,
        )
        reading = readout(frame if along == "columns" else np.ascontiguousarray(frame.T), device=device)
        np.testing.assert_array_equal(reading.status, NOT_FINITE)
        assert all(np.isnan(getattr(reading, name)).all() for name in ("position", "peak", "width", "total"))


@pytest.mark.double
def test_double_sums_along_rows_fit_into_local_memory(device, rng):
    """OpenCL guarantees 32 KiB of local memory."""
    frames = line_frames(rng, "float32", (2, 33, 130), "rows")
    parameters = {"method": "centroid", "along": "rows", "threshold": 8.5}
    readout = LineReadout(variant="work_item", precision="double", **parameters)
    bound = readout.bind(device, frames.shape, frames.dtype)
    assert_same(bound.on_host((frames,)), read_lines(frames, **parameters), np.float64, slack=10.0)
    kernel = bound.enqueue_arguments[1]
    needed = kernel.get_work_group_info(cl.kernel_work_group_info.LOCAL_MEM_SIZE, device.handle)
    assert device.kind == "rusticl" or 0 < needed <= 32 << 10


@pytest.mark.parametrize(("along", "variant"), list(itertools.product(("columns", "rows"), VARIANTS)))
def test_least_total_on_a_device_without_denormal_numbers(device, along, variant):
    """The centroid needs length * 2**23 of the smallest normal number; a device that has denormals pretends not to."""
    without = copy.copy(device)
    without.has_denormals = False
    # Two samples of half the total: both levels are exact.
    least = 64 * 2.0**23 * float(np.finfo(np.float32).tiny)
    readout = LineReadout(method="centroid", along=along, variant=variant)
    for total, status in ((least, 0), (least * (1.0 - 2.0**-22), LOW_SIGNAL), (least * (1.0 + 2.0**-22), 0)):
        frame = column(*[0.0] * 20, total / 2, total / 2, *[0.0] * 42, dtype=np.float32)
        reading = readout(frame if along == "columns" else np.ascontiguousarray(frame.T), device=without)
        np.testing.assert_array_equal(reading.total, np.float32(total))
        np.testing.assert_array_equal(reading.status, status)


@pytest.mark.parametrize(("along", "variant"), list(itertools.product(("columns", "rows"), VARIANTS)))
@pytest.mark.parametrize("method", ["centroid", "windowed"])
def test_faintest_light(device, along, variant, method):
    """Sums with an infinite reciprocal: read, or dark on a device that flushes denormal numbers."""
    frame = column(*[0.0] * 20, 1e-40, 2e-40, 1e-40, *[0.0] * 41, dtype=np.float32)
    readout = LineReadout(method=method, along=along, window=WINDOW, variant=variant)
    reading = readout(frame if along == "columns" else np.ascontiguousarray(frame.T), device=device)
    read = reading.status == 0
    assert np.all(reading.status[~read] & (LOW_SIGNAL | NOT_FINITE) != 0)
    np.testing.assert_allclose(reading.position[read], 21.0, atol=1e-5)
    assert np.isnan(reading.position[~read]).all()


@pytest.mark.parametrize("variant", VARIANTS)
def test_large_moments_are_exact(device, rng, variant):
    """16 bit, 4100 rows on a bright background: the moment needs 40 bits."""
    frame = rng.integers(2900, 3100, (4100, 64)).astype(np.uint16)
    frame[3270:3275] = 65_535
    for column in range(64):
        frame[:column, column] = 0
    reading = LineReadout(method="centroid", variant=variant)(frame, device=device)
    expected = read_lines(frame, method="centroid")
    np.testing.assert_allclose(reading.position, expected["position"], rtol=1.2e-7)
    np.testing.assert_array_equal(reading.width, expected["width"])


def test_wide_window_of_16_bits(device, rng):
    frame = np.zeros((400, 64), np.uint16)
    frame[50:350] = rng.integers(60_000, 65_535, (300, 64))
    parameters = {"threshold": 0, "window": 180}
    frame[200] = 65_535
    assert_same(LineReadout(**parameters)(frame, device=device), read_lines(frame, **parameters), slack=200.0)


@pytest.mark.parametrize("variant", VARIANTS)
def test_tall_frames(device, rng, variant):
    """More than 256 blocks of rows, and peaks far apart within a group."""
    frame = np.zeros((9000, 70), np.uint8)
    frame[rng.integers(20, 8980, 70), np.arange(70)] = 200
    parameters = {"threshold": 5, "window": 4}
    assert_same(LineReadout(variant=variant, **parameters)(frame, device=device), read_lines(frame, **parameters))


@pytest.mark.parametrize("dtype", TOP)
@pytest.mark.parametrize("method", ["centroid", "windowed"])
def test_light_of_a_single_sample_counts(device: Device, method: Method, dtype: str) -> None:
    """Blocks of rows without light are skipped: a sample just above the threshold, in each row of several blocks.

    The frame has a whole strip of columns and a part of one.
    """
    columns, level = np.arange(1090), LEVEL[dtype]
    rows = 1 + columns % 65
    frame = np.full((67, len(columns)), level, dtype)
    frame[rows, columns] += 1
    frame[40] = np.where(rows == 40, level + 1, 0)  # the block also has dark samples
    outputs = ("position", "peak", "width", "total", "status")
    readout = LineReadout(method=method, threshold=level, window=1, outputs=outputs)
    reading = readout(frame, device=device)
    np.testing.assert_array_equal(reading.position, rows)
    np.testing.assert_array_equal(reading.status, 0)
    for name in ("total", "width"):
        np.testing.assert_array_equal(getattr(reading, name), 1.0, err_msg=name)
    np.testing.assert_array_equal(reading.peak, np.dtype(dtype).type(level + 1))


@pytest.mark.vectors
def test_another_window_is_no_other_build(device: Device, rng: np.random.Generator) -> None:
    """In the vector variant down the columns the window is an argument; up to 15 samples the sums have 16 bits."""
    frame = line_frames(rng, "uint8", (90, 64), sigma=4.0)
    builds = {}
    for window in (3, 15, 16, 40):
        readout = LineReadout(threshold=20, window=window, variant="vector")
        builds[window] = readout.launch(device, frame.shape, frame.dtype).defines
        assert_same(readout(frame, device=device), read_lines(frame, threshold=20, window=window))
    assert builds[3] == builds[15] != builds[16] == builds[40]


@pytest.mark.vectors
def test_a_small_frame_has_one_work_item(device: Device) -> None:
    """So Intel's runtime runs the launch in the calling thread."""
    launches = {
        shape: LineReadout(variant="vector").launch(device, shape, np.dtype(np.uint8))
        for shape in ((512, 1024), (1024, 1024), (2, 64, 64))
    }
    assert launches[512, 1024].global_size == (1, 1)
    assert launches[1024, 1024].global_size[0] > 1
    assert launches[2, 64, 64].global_size[1] == 2
    fit = LineReadout(method="ml", variant="vector").launch(device, (512, 1024), np.dtype(np.uint8))
    assert fit.global_size[0] > 1


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"method": "best"}, "method"),
        ({"along": "x"}, "along"),
        ({"window": 0}, "window"),
        ({"outputs": ("g",)}, "outputs"),
        ({"minimum_width": 5, "maximum_width": 2}, "widths"),
        ({"method": "centroid", "peak_selection": "first"}, "centroid"),
        ({"method": "ml", "read_noise": 0.0}, "read_noise"),
        ({"ambiguity": 2.0}, "ambiguity"),
        ({"threshold": float("nan")}, "threshold"),
        ({"window": 181}, "window"),
        ({"fir_length": 5}, "fir_length"),
        ({"minimum_width": 0}, "widths"),
    ],
)
def test_bad_parameters(parameters, words):
    with pytest.raises(ValueError, match=words):
        LineReadout(**parameters)


@pytest.mark.parametrize("name", ["window", "minimum_width", "maximum_width", "fir_length"])
@pytest.mark.parametrize("value", [8.0, 2.5, True, float("nan"), "a", np.array([8, 8])])
def test_parameters_that_count(name, value):
    with pytest.raises(TypeError, match=rf"^LineReadout\.{name} must be a whole number, got .*$"):
        LineReadout(**{name: value})


def test_counts_of_numpy(device, rng):
    counts = {"window": WINDOW, "minimum_width": 2, "maximum_width": 30, "fir_length": 8}
    frame = line_frames(rng, "uint8", (64, 70))
    plain, same = (
        LineReadout(threshold=20, method="fir", **{name: kind(count) for name, count in counts.items()})
        for kind in (int, np.uint8)
    )
    assert plain == same
    np.testing.assert_array_equal(same(frame, device=device).position, plain(frame, device=device).position)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("method", ["centroid", "windowed"])
def test_widths_beyond_the_profile(device, rng, method, variant):
    frame = line_frames(rng, "uint8", (64, 70))
    parameters = {"method": method, "threshold": 20, "window": WINDOW, "variant": variant}
    free = LineReadout(**parameters)(frame, device=device)
    wide = LineReadout(maximum_width=2**31, **parameters)(frame, device=device)
    np.testing.assert_array_equal(wide.position, free.position)
    too_wide = LineReadout(minimum_width=2**31, **parameters)(frame, device=device)
    assert np.all(too_wide.status & LOW_SIGNAL)


def test_bad_frames(device):
    with pytest.raises(TypeError, match="int64"):
        LineReadout()(np.zeros((4, 4), np.int64), device=device)
    with pytest.raises(ValueError, match=r"\(\.\.\., rows, columns\)"):
        LineReadout()(np.zeros(4, np.uint8), device=device)
    with pytest.raises(ValueError, match="whole number"):
        LineReadout(threshold=2.5)(np.zeros((4, 4), np.uint8), device=device)
    with pytest.raises(ValueError, match="saturation"):
        LineReadout(saturation=300)(np.zeros((4, 4), np.uint8), device=device)


SHEET = Triangulation(
    homography=((1.1e-5, 2.0e-4, -0.1), (-2.2e-4, 1.0e-6, 0.06), (2.0e-4, 1.0e-5, 1.0)),
    region=((0.0, 700.0), (0.0, 900.0)),
)
LENS = Lens(k1=4e-8, k2=1e-14, centre=(450.0, 350.0))


@pytest.mark.parametrize(("along", "variant"), list(itertools.product(("columns", "rows"), VARIANTS)))
@pytest.mark.parametrize("method", ["centroid", "windowed"])
def test_triangulates_in_the_same_pass(device, rng, along, variant, method):
    sheet = replace(SHEET, along=along, lens=LENS)
    frames = line_frames(rng, "uint8", (2, 99, 130), along)
    axes = SampleAxes(position_origin=300.0, sample_origin=400.0, sample_pitch=2.0)
    parameters = {"method": method, "along": along, "threshold": 20, "window": WINDOW}
    reading = LineReadout(variant=variant, triangulation=sheet, axes=axes, **parameters)(frames, device=device)
    expected = read_lines(frames, **parameters)
    samples = np.broadcast_to(400.0 + 2.0 * np.arange(reading.position.shape[1]), reading.position.shape)
    g, h, status = triangulate(
        expected["position"] + 300.0,
        samples,
        sheet.homography,
        sheet.region,
        lens=(LENS.k1, LENS.k2, LENS.centre),
        along=along,
    )
    good = expected["status"] == 0
    assert good.any()
    assert not status[good].any()
    np.testing.assert_array_equal(reading.status, expected["status"])
    # 0.2 mm per pixel; single precision resolves 4e-5 px at 400 px.
    np.testing.assert_allclose(reading.g[good], g[good], atol=2e-8)
    np.testing.assert_allclose(reading.h[good], h[good], atol=2e-8)
    lost = np.isnan(expected["position"])
    assert np.isnan(reading.g[lost]).all()
    assert np.isnan(reading.h[lost]).all()


def test_triangulation_flags_its_own(device):
    """Beyond the horizon, H and G are NaN, but the position is valid."""
    sheet = Triangulation(
        homography=((1e-4, 0.0, 0.0), (0.0, 1e-4, 0.0), (-1.0 / 30.0, 0.0, 1.0)), region=((0.0, 40.0), (0.0, 64.0))
    )
    frame = np.zeros((60, 64), np.uint8)
    frame[10, :32] = frame[45, 32:] = 200
    reading = LineReadout(threshold=20, window=WINDOW, triangulation=sheet)(frame, device=device)
    np.testing.assert_array_equal(reading.status, np.repeat([0, Status.HORIZON], 32))
    np.testing.assert_array_equal(reading.position, np.repeat([10.0, 45.0], 32))
    np.testing.assert_array_equal(np.isnan(reading.h), np.repeat([False, True], 32))


@pytest.mark.parametrize("name", [pytest.param("g", marks=pytest.mark.slow), "h", "position"])
def test_one_output_of_the_sheet(device, rng, name):
    """Outputs that are not requested are not written, also with a triangulation."""
    frames = line_frames(rng, "uint8", (2, 99, 130), "columns")
    readout = LineReadout(threshold=20, window=WINDOW, triangulation=SHEET)
    complete, alone = (each(frames, device=device) for each in (readout, replace(readout, outputs=(name,))))
    np.testing.assert_array_equal(getattr(alone, name), getattr(complete, name))
    assert sum(each is not None for each in alone) == 1


def test_triangulation_of_another_axis():
    with pytest.raises(ValueError, match="along"):
        LineReadout(along="rows", triangulation=SHEET)


def test_colour_frames_are_refused(device: Device) -> None:
    """A colour image has the shape of a batch of narrow frames."""
    with pytest.raises(
        ValueError, match=r"LineReadout takes frames .* of one channel, got shape \(16, 40, 3\): its last"
    ):
        LineReadout()(np.zeros((16, 40, 3), np.uint8), device=device)
    assert LineReadout(window=WINDOW)(np.zeros((15, 40, 3), np.uint8), device=device).position.shape == (15, 3)


@pytest.mark.vectors
def test_narrow_frames_on_cpu_runtimes_have_a_work_item_per_profile(device: Device, rng: np.random.Generator) -> None:
    """Frames narrower than a vector: the shape of work that is fast on CPU runtimes, with the same results."""
    frames = rng.integers(0, 40, (90, 13)).astype(np.uint8)
    frames[43:46] += np.array([[90], [200], [120]], np.uint8)
    cpu = LineReadout(threshold=30, window=WINDOW, variant="vector")
    gpu = replace(cpu, variant="work_item")
    launches = [each.launch(device, frames.shape, frames.dtype) for each in (cpu, gpu)]
    assert [each.local_size for each in launches] == [(64, 1), (256, 1)]
    for name, ours in cpu(frames, device=device)._asdict().items():
        np.testing.assert_array_equal(ours, getattr(gpu(frames, device=device), name), err_msg=name)
