"""Undistorted images on devices: against the float64 oracle and OpenCV, every window, the borders, the extremes."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from canary import Guarded, shifted
from designs import covering
from gpuvision.camera.camera import Camera
from gpuvision.camera.image_map import RUN, PackedMap, Packer, PixelMap, Taps
from gpuvision.camera.lens import Lens
from gpuvision.camera.undistort_image import UndistortImage
from gpuvision.host import Device
from gpuvision.reference import undistort_image as reference
from gpuvision.status import Status
from guard_pages import assert_within_pages
from tiers import variants_of

ON_DEVICES = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
VARIANTS = ["vector", "work_item"]
BORDERS = ["mask", "constant", "replicate", "reflect"]
DTYPES = [np.uint8, np.uint16, np.float32]
LARGEST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0, np.dtype(np.float32): 1.0}
# Position error: 1e-5 px of a cubic, plus four single-precision roundings of an offset below 32.
PLACE_ERROR = 1e-5 + 4 * 32 * 6e-8
# Distance from the image border within which the status is not compared.
EDGE = 1e-3


def pixels(rng: np.random.Generator, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    largest = LARGEST[np.dtype(dtype)]
    values = rng.uniform(0.0, largest, shape)
    return (values if dtype == np.float32 else np.rint(values)).astype(dtype)


def map_of(
    shape: tuple[int, int], source: tuple[int, int], *, turn: float = 0.0, scale: float = 1.0, mirrored: bool = False
) -> np.ndarray:
    """Return a slightly bent map that rotates about the centres of both images."""
    rows, columns = shape
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    scaled = scale * (1.0 - 1e-5 * (x**2 + y**2))
    x, y = x * scaled, y * scaled
    if mirrored:
        x = -x
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    return np.stack([c * x - s * y + (source[1] - 1) / 2 + 0.3, s * x + c * y + (source[0] - 1) / 2 - 0.2], -1)


def near_edge(positions: np.ndarray, source: tuple[int, ...]) -> np.ndarray:
    sides = np.array([[-0.5, source[1] - 0.5], [-0.5, source[0] - 0.5]])
    return (np.abs(positions[..., None] - sides) < EDGE).any((-1, -2))


def assert_right(
    result: Any,
    image: np.ndarray,
    positions: np.ndarray,
    *,
    missing: int = Status.NO_DATA,
    channels: int = 1,
    **options: Any,
) -> None:
    """Compare with the oracle: values within the errors of positions and rounding, integers rounded to nearest."""
    source = image.shape[-3:-1] if channels == 3 else image.shape[-2:]
    made = positions.shape[:2]
    clear = ~near_edge(positions, source)
    frames = image.astype(np.float64).reshape(-1, *source, channels)
    outcome = result.image.reshape(len(frames), *made, channels)
    largest = LARGEST[image.dtype]
    # Position error in x and y times the largest slope (twice the range for a cubic), plus ten roundings.
    slack = largest * (2 * 2 * PLACE_ERROR + 10 * 6e-8)
    for frame, values in zip(frames, outcome, strict=True):
        expected, status = reference.undistort(frame, positions, missing=missing, **options)
        np.testing.assert_array_equal(result.status[clear], status[clear])
        if image.dtype == np.float32:
            np.testing.assert_allclose(values[clear], expected[clear], rtol=0, atol=slack)
        else:
            clipped = np.clip(np.nan_to_num(expected), 0.0, largest)
            assert np.abs(values[clear] - clipped[clear]).max(initial=0.0) <= 0.5 + slack


@pytest.mark.parametrize(
    "kernel",
    list(itertools.product(("bilinear", "bicubic"), (1, 3), VARIANTS)),
    ids=lambda each: "-".join(map(str, each)),
)
# The code for borders is the same for every type.
@pytest.mark.parametrize(
    "source",
    [(dtype, border) for dtype in DTYPES for border in (BORDERS if dtype == np.float32 else ["mask", "constant"])],
    ids=lambda each: f"{each[0].__name__}-{each[1]}",
)
def test_a_batch_against_the_oracle(
    device: Device, source: tuple[Any, Any], kernel: tuple[Any, int, Any], rng: np.random.Generator
) -> None:
    dtype, border = source
    interpolation, channels, variant = kernel
    lens = Lens(k1=4e-6, k2=1e-11, centre=(60.0, 41.0))
    op = UndistortImage(
        model=lens,
        interpolation=interpolation,
        channels=channels,
        border=border,
        border_value=0.75,
        variant=variant,
    )
    image = pixels(rng, (2, 83, 117, 3)[: 3 + channels // 3], dtype)
    positions = op.source_positions((83, 117))
    options = {
        "interpolation": interpolation,
        "border": border,
        "border_value": 0.75,
        "missing": Status.NOT_INVERTIBLE,
    }
    assert_right(op(image, device=device), image, positions, channels=channels, **options)


# name: (map options, expected kind of the runs in the middle)
WINDOWS = {
    "narrow": ({"scale": 0.97}, 2),
    "wide": ({"scale": 1.4}, 3),
    "banded": ({"turn": 11.0, "scale": 0.97}, 4),
    "wide banded": ({"turn": -11.0, "scale": 1.3}, 5),
    "mirrored": ({"scale": 0.9, "mirrored": True}, 2),
    "upright": ({"turn": 90.0, "scale": 0.9}, 6),
    "far apart": ({"scale": 3.0}, 6),
}


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("name", WINDOWS)
@pytest.mark.vectors
def test_every_window(device: Device, name: str, channels: int, interpolation: Any, rng: np.random.Generator) -> None:
    options, kind = WINDOWS[name]
    source = (300, 310)
    image = pixels(rng, (*source, 3)[: 2 + channels // 3], np.float32)
    positions = map_of((80, 80), source, **options)
    taps = Taps(1, 2) if interpolation == "bicubic" else Taps(0, 1)
    heads = Packer(source, taps, channels, Status.NO_DATA, Status.NO_DATA, (0.5, 0.5)).pack(positions).heads
    found = set(np.unique(heads[..., 2] & 255))
    # Three channels need three times the width.
    assert found & {kind, kind | (channels == 3 and kind < 6)}
    op = UndistortImage(model=positions, interpolation=interpolation, channels=channels, variant="vector")
    assert_right(op(image, device=device), image, positions, channels=channels, interpolation=interpolation)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.vectors
def test_every_width_of_a_window(device: Device, channels: int, interpolation: Any, rng: np.random.Generator) -> None:
    """Each row has another scale: the pixels of a run span 10 to 37 columns, one more every few rows."""
    scale, source = np.linspace(0.6, 2.4, 60), (70, 120)
    image = pixels(rng, (*source, 3)[: 2 + channels // 3], np.float32)
    positions = np.empty((60, 48, 2))
    positions[..., 0] = 2.01 + scale[:, None] * np.arange(48)
    positions[..., 1] = 3.3 + np.arange(60.0)[:, None]
    op = UndistortImage(model=positions, interpolation=interpolation, channels=channels, variant="vector")
    assert_right(op(image, device=device), image, positions, channels=channels, interpolation=interpolation)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_every_gap_of_a_quad(device: Device, dtype: Any, channels: int, rng: np.random.Generator) -> None:
    """Work-items of four samples: source columns 0 to 4 apart, also to the left, and source rows that change within."""
    scale = np.concatenate([np.linspace(0.0, 4.0, 41), np.linspace(-1.0, -0.1, 4)])
    source = (61, 203)
    image = pixels(rng, (2, *source, 3)[: 3 + channels // 3], dtype)
    column = np.arange(45)
    positions = np.empty((len(scale), len(column), 2))
    positions[..., 0] = np.where(scale[:, None] < 0.0, 190.4, 0.3) + scale[:, None] * column
    positions[..., 1] = np.linspace(0.2, 58.9, len(scale))[:, None] + np.linspace(-0.2, 0.3, 9)[np.arange(45) % 9]
    op = UndistortImage(model=positions, channels=channels, variant="work_item")
    assert_right(op(image, device=device), image, positions, channels=channels)


_PRODUCT = [
    {"dtype": dtype, "variant": variant, "channels": channels, "border": border, "interpolation": interpolation}
    for dtype in DTYPES
    for variant in VARIANTS
    for channels in (1, 3)
    for border in BORDERS
    for interpolation in ("bilinear", "bicubic")
]
# Each combination of options compiles a separate program. Test all pairs of options, not all combinations.
PROGRAMS = [_PRODUCT[k] for k in covering(_PRODUCT, 2)]


@ON_DEVICES
@given(
    source=st.tuples(st.integers(1, 50), st.integers(1, 70)),
    shape=st.tuples(st.integers(1, 9), st.integers(1, 70)),
    turn=st.floats(-180.0, 180.0),
    scale=st.floats(0.0, 4.0),
    shift=st.tuples(st.floats(-60.0, 60.0), st.floats(-60.0, 60.0)),
    options=st.sampled_from(PROGRAMS),
)
def test_any_shape_and_map(
    device: Device, source: Any, shape: Any, turn: float, scale: float, shift: Any, options: dict[str, Any]
) -> None:
    assume(options["variant"] in variants_of(device))
    rng = np.random.default_rng(1)
    dtype, variant, channels, *_ = options.values()
    options = {name: options[name] for name in ("border", "interpolation")}
    image = pixels(rng, (*source, 3)[: 2 + channels // 3], dtype)
    positions = map_of(shape, source, turn=turn, scale=scale) + shift
    op = UndistortImage(model=positions, channels=channels, variant=variant, **options)
    guarded = Guarded(op(image, device=device))
    result = op(image, device=device, out=guarded.out)
    guarded.assert_intact()
    assert_right(result, image, positions, channels=channels, **options)


@given(
    source=st.tuples(st.integers(1, 60), st.integers(1, 90)),
    turn=st.floats(-180.0, 180.0),
    scale=st.floats(0.01, 2.0),
    shift=st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)),
    bicubic=st.booleans(),
    channels=st.sampled_from([1, 3]),
)
@settings(max_examples=200, deadline=None)
def test_no_window_reads_outside_the_image(
    source: Any, turn: float, scale: float, shift: Any, bicubic: bool, channels: int
) -> None:
    taps = Taps(1, 2) if bicubic else Taps(0, 1)
    packed = Packer(source, taps, channels, Status.NO_DATA, None, (0.5, 0.5)).pack(
        map_of((40, 48), source, turn=turn, scale=scale) + shift
    )
    kind = packed.heads[..., 2] & 255
    scattered = packed.heads[kind == 6]
    positions = packed.points[scattered[:, 3]] + scattered[:, None, :2]
    assert (positions >= taps.before).all()
    assert (np.floor(positions) + taps.after < source[::-1]).all()
    windows = (kind >= 2) & (kind < 6)
    column, row, bits, _ = np.moveaxis(packed.heads[windows], -1, 0)
    starts = [bits >> shift & 63 for shift in ((13, 19, 25) if channels == 3 else (31,))]
    loaded = np.where(kind[windows] & 1, 32, 16)
    lowest = ((row - taps.before) * source[1] + column - taps.before) * channels
    last_row = row + (bits >> 8 & 31) - 1 + taps.after
    highest = (last_row * source[1] + column + np.max(starts, axis=0) + taps.after) * channels + loaded
    assert (lowest >= 0).all()
    assert (highest <= source[0] * source[1] * channels).all()


def test_no_kernel_reads_outside_the_image() -> None:
    assert_within_pages("undistort_image")


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_whole_shifts_are_exact(
    device: Device, dtype: Any, interpolation: Any, variant: Any, rng: np.random.Generator
) -> None:
    image = pixels(rng, (37, 129), dtype)
    grid = np.stack(np.meshgrid(np.arange(129.0), np.arange(37.0)), -1)
    for shift in ((0, 0), (3, -2), (-17, 5)):
        op = UndistortImage(
            model=grid + shift, interpolation=interpolation, border="constant", border_value=1.0, variant=variant
        )
        expected = np.ones_like(image)
        inner = [slice(max(-s, 0), size - max(s, 0)) for s, size in zip(shift[::-1], image.shape, strict=True)]
        outer = [slice(max(s, 0), size + min(s, 0)) for s, size in zip(shift[::-1], image.shape, strict=True)]
        expected[tuple(inner)] = image[tuple(outer)]
        np.testing.assert_allclose(
            op(image, device=device).image, expected, rtol=0, atol=PLACE_ERROR * (dtype == np.float32)
        )


@pytest.mark.parametrize(
    "kernel",
    list(itertools.product(("bilinear", "bicubic"), DTYPES)),
    ids=lambda each: f"{each[0]}-{each[1].__name__}",
)
@pytest.mark.parametrize("border", ["constant", "replicate", "reflect"])
def test_against_opencv(device: Device, border: str, kernel: tuple[Any, Any], rng: np.random.Generator) -> None:
    interpolation, dtype = kernel
    image = pixels(rng, (90, 123), dtype)
    positions = map_of((70, 144), image.shape, turn=3.0, scale=1.1).astype(np.float32)
    flags = {"constant": cv2.BORDER_CONSTANT, "replicate": cv2.BORDER_REPLICATE, "reflect": cv2.BORDER_REFLECT_101}
    filters = {"bilinear": cv2.INTER_LINEAR, "bicubic": cv2.INTER_CUBIC}
    theirs = cv2.remap(
        image, positions[..., 0], positions[..., 1], filters[interpolation], borderMode=flags[border], borderValue=1.0
    )
    op = UndistortImage(model=positions, interpolation=interpolation, border=border, border_value=1.0)
    ours = op(image, device=device).image
    # OpenCV may round a half to the other side; its coordinates are floats up to 144.
    atol = 1.0 if dtype != np.float32 else 2 * 2 * (PLACE_ERROR + 1e-5)
    np.testing.assert_allclose(ours.astype(np.float64), theirs, rtol=0, atol=atol)


@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
@pytest.mark.parametrize("shape", [(1, 7), (7, 1), (1, 1), (2, 3)])
def test_small_images_are_reflected(
    device: Device, shape: tuple[int, int], interpolation: Any, rng: np.random.Generator
) -> None:
    """Also an image of one row or one column; whole places have the pixels themselves."""
    image = rng.uniform(0.0, 1.0, shape).astype(np.float32)
    rows, columns = np.meshgrid(np.arange(-3, 11), np.arange(-5, 9), indexing="ij")
    positions = np.stack([columns, rows], axis=-1).astype(np.float32)

    def reflected(places: np.ndarray, size: int) -> np.ndarray:
        return np.pad(np.arange(size), (16, 16), mode="reflect")[places + 16]

    expected = image[reflected(rows, shape[0]), reflected(columns, shape[1])]
    for variant in variants_of(device):
        op = UndistortImage(model=positions, interpolation=interpolation, border="reflect", variant=variant)
        np.testing.assert_allclose(op(image, device=device).image, expected, rtol=0, atol=1e-6)


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("border", BORDERS)
def test_places_that_are_none_or_far_away(device: Device, border: Any, variant: Any, rng: np.random.Generator) -> None:
    image = pixels(rng, (20, 40), np.float32)
    positions = map_of((6, 64), image.shape)
    positions[0, ::3] = math.nan
    positions[1, :, 1] = math.inf
    positions[2, 5:] = 1e12
    positions[3] = (-3e9, 4.0)
    positions[4, :, 0] = np.geomspace(1.0, 1e300, 64)
    op = UndistortImage(model=positions, border=border, border_value=0.5, variant=variant)
    result = op(image, device=device)
    if border != "reflect":
        assert_right(result, image, positions, border=border, border_value=0.5)
    lost = ~np.isfinite(positions).all(-1)
    assert (result.status[lost | (np.abs(positions) > 1e3).any(-1)] == Status.NO_DATA).all()
    expected = 0.5 if border == "constant" else math.nan
    np.testing.assert_array_equal(result.image[lost], expected)
    assert np.isfinite(result.image[~lost]).all() or border == "mask"


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("coordinates", ["map", "computed"])
def test_past_the_fold(device: Device, coordinates: Any, variant: Any, rng: np.random.Generator) -> None:
    lens = Lens(k1=-2e-4, centre=(50.0, 30.0))
    op = UndistortImage(model=lens, coordinates=coordinates, variant=variant)
    image = pixels(rng, (61, 101), np.uint8)
    result = op(image, device=device)
    folded = np.isnan(op.source_positions(image.shape)).any(-1)
    # In single precision the position of the fold has a rounding error.
    reach = np.hypot(*np.moveaxis(np.argwhere(np.ones_like(folded)) - (30.0, 50.0), -1, 0)).reshape(folded.shape)
    clear = np.abs(reach - lens.undistort([50.0 + 0.999999 * lens.fold_radius, 30.0])[0] + 50.0) > 0.01
    assert folded.any()
    np.testing.assert_array_equal((result.status == Status.NOT_INVERTIBLE)[clear], folded[clear])
    assert (result.image[folded & clear] == 0).all()


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("interpolation", ["bilinear", "bicubic"])
def test_a_missing_pixel_spoils_only_what_looks_at_it(
    device: Device, interpolation: Any, variant: Any, rng: np.random.Generator
) -> None:
    image = pixels(rng, (60, 100), np.float32)
    image[rng.integers(0, 60, 9), rng.integers(0, 100, 9)] = math.nan
    for turn in (0.3, 8.0):
        positions = map_of((50, 96), image.shape, turn=turn, scale=0.9)
        result = UndistortImage(model=positions, interpolation=interpolation, variant=variant)(image, device=device)
        expected, _ = reference.undistort(image[..., None].astype(np.float64), positions, interpolation=interpolation)
        np.testing.assert_array_equal(np.isnan(result.image), np.isnan(expected[..., 0]))


CAMERA = Camera(
    matrix=((150.0, 0.0, 61.0), (0.0, 155.0, 40.0), (0.0, 0.0, 1.0)),
    distortion=(-0.2, 0.05, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.02, -0.03),
)
OTHER = ((130.0, 0.0, 70.0), (0.0, 128.0, 52.0), (0.0, 0.0, 1.0))


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("precision", ["single", "double"])
@pytest.mark.parametrize(
    ("model", "matrix"), [(Lens(k1=2e-6, centre=(60.0, 40.0)), None), (CAMERA, None), (CAMERA, OTHER)]
)
def test_computed_places(
    device: Device, model: Any, matrix: Any, precision: Any, channels: int, variant: Any, rng: np.random.Generator
) -> None:
    image = pixels(rng, (83, 117, 3)[: 2 + channels // 3], np.float32)
    options: dict[str, Any] = {"model": model, "matrix": matrix, "channels": channels, "variant": variant}
    op = UndistortImage(**options, coordinates="computed", precision=precision, size=(140, 100), border="replicate")
    result = op(image, device=device)
    positions = op.source_positions((83, 117))
    expected, status = reference.undistort(
        image.reshape(83, 117, channels).astype(np.float64), positions, border="replicate"
    )
    clear = ~near_edge(positions, (83, 117))
    np.testing.assert_array_equal(result.status[clear], status[clear])
    # Single precision keeps a coordinate near 128 to 8e-6 px, and the model's terms to a few of these.
    error = 4e-5 if precision == "single" else 2e-6
    np.testing.assert_allclose(result.image.reshape(expected.shape), expected, rtol=0, atol=2 * error)


def test_region_size_and_matrix(device: Device, rng: np.random.Generator) -> None:
    image = pixels(rng, (83, 117), np.float32)
    full_image = UndistortImage(model=CAMERA, size=(150, 90), matrix=OTHER)(image, device=device)
    assert full_image.image.shape == (90, 150)
    for coordinates in ("map", "computed"):
        part = UndistortImage(
            model=CAMERA, size=(150, 90), matrix=OTHER, region=(31, 20, 50, 33), coordinates=coordinates
        )(image, device=device)
        np.testing.assert_array_equal(part.status, full_image.status[20:53, 31:81])
        np.testing.assert_allclose(part.image, full_image.image[20:53, 31:81], atol=4 * 4e-5)
    beyond = UndistortImage(model=CAMERA, region=(-60, -60, 20, 20))(image, device=device)
    assert (beyond.status == Status.NO_DATA).all()
    positions = PixelMap(map_of((40, 60), image.shape))
    part = UndistortImage(model=positions, region=(7, 3, 30, 20))(image, device=device)
    np.testing.assert_allclose(
        part.image, UndistortImage(model=positions)(image, device=device).image[3:23, 7:37], atol=1e-4
    )


def test_device_arrays_bound_and_no_frames(device: Device, rng: np.random.Generator) -> None:
    op = UndistortImage(model=Lens(k1=1e-6, centre=(30.0, 20.0)))
    image = pixels(rng, (3, 41, 61), np.uint8)
    expected = op(image, device=device)
    on_device = op(cl.array.to_device(device.queue, image))
    np.testing.assert_array_equal(on_device.image.get(), expected.image)
    bound = op.bind(device, image.shape, image.dtype)
    bound.inputs[0].set(image)
    np.testing.assert_array_equal(bound.run().image.get(), expected.image)
    assert expected.status.shape == (41, 61)
    assert op(image[:0], device=device).image.shape == (0, 41, 61)


@pytest.mark.parametrize("columns", [96, 91])
def test_stores_past_small_caches(device: Device, columns: int, rng: np.random.Generator) -> None:
    """A device with caches of 1 KiB writes past them: rows at aligned addresses and at other addresses."""
    image = pixels(rng, (40, columns), np.float32)
    small = copy.copy(device)
    small.cache_bytes = 1024
    op = UndistortImage(model=Lens(k1=3e-6, centre=(50.0, 20.0)))
    defines = op.launch(small, image.shape, image.dtype).defines
    assert ("PAST_CACHES" in defines) == ("VECTOR_VARIANT" in defines and device.is_cpu)
    usual = op(image, device=device)
    past = op(image, device=small, out=shifted(usual, columns % 2))
    np.testing.assert_array_equal(past.status, usual.status)
    np.testing.assert_array_equal(past.image, usual.image)


@pytest.mark.slow
@pytest.mark.parametrize("columns", [1008, 1003])
def test_batches_beyond_the_caches_are_the_same(device: Device, columns: int, rng: np.random.Generator) -> None:
    image = pixels(rng, (5, 1000, columns), np.float32)
    assert 2 * image.nbytes > device.cache_bytes
    op = UndistortImage(model=Lens(k1=3e-8, centre=(500.0, 500.0)))
    np.testing.assert_array_equal(op(image, device=device).image[4], op(image[4], device=device).image)


def test_wide_maps_are_kept_exactly_where_cubics_do_not_do(device: Device, rng: np.random.Generator) -> None:
    image = pixels(rng, (50, 60), np.float32)
    positions = map_of((30, 50), image.shape) + rng.uniform(-0.5, 0.5, (30, 50, 2))
    packed = Packer(image.shape, Taps(0, 1), 1, Status.NO_DATA, Status.NO_DATA, (0.5, 0.5)).pack(positions)
    assert len(packed.points) == 30 * math.ceil(50 / RUN)
    assert_right(UndistortImage(model=positions)(image, device=device), image, positions)


def test_a_map_is_small() -> None:
    op = UndistortImage(model=Lens(k1=1e-8, centre=(500.0, 500.0)))
    packed = PackedMap(*op._packed(1024, 1024))
    assert sum(each.nbytes for each in packed) < 4 * 1024 * 1024


@pytest.mark.parametrize("channels", [1, 3])
def test_frames_of_2_to_the_30_samples_are_refused(device: Device, channels: int) -> None:
    """Of the input or of the result; the smallest size that is refused, and one row less."""
    undistort = UndistortImage(model=Lens(k1=0.0), channels=channels, coordinates="computed")
    rows, columns = 2**15, 2**15 // channels + (channels > 1)
    tail = (3,) if channels == 3 else ()
    with pytest.raises(ValueError, match=rf"fewer than 2\*\*30 samples, got {rows} x {columns} pixels"):
        undistort.launch(device, (rows, columns, *tail), np.dtype(np.uint8))
    undistort.launch(device, (rows - 1, columns, *tail), np.dtype(np.uint8))
    large = replace(undistort, region=(0, 0, columns, rows))
    with pytest.raises(ValueError, match=r"fewer than 2\*\*30 samples, got 5 x 7 pixels"):
        large.launch(device, (5, 7, *tail), np.dtype(np.uint8))


def test_wrong_arguments(device: Device) -> None:
    lens = Lens(k1=1e-6)
    for options, words in (
        ({"interpolation": "nearest"}, "bilinear"),
        ({"channels": 4}, "channels"),
        ({"border": "wrap"}, "replicate"),
        ({"region": (0, 0, 0, 5)}, "region"),
        ({"size": (0, 5)}, "size"),
        ({"border_value": math.nan}, "border_value"),
        ({"model": CAMERA, "matrix": np.zeros((3, 3))}, "focal"),
        ({"precision": "double"}, "precision"),
        ({"model": np.zeros((4, 4))}, "map"),
        ({"model": np.zeros((4, 4, 2)), "size": (4, 4)}, "size"),
    ):
        with pytest.raises(ValueError, match=words):
            UndistortImage(**({"model": lens} | options))
    for options, words in (
        ({"model": 3}, "distort"),
        ({"matrix": OTHER}, "Camera"),
        ({"size": (4.5, 4)}, "integer"),
        ({"model": np.zeros((4, 4, 2)), "coordinates": "computed"}, "map"),
    ):
        with pytest.raises(TypeError, match=words):
            UndistortImage(**({"model": lens} | options))
    op = UndistortImage(model=lens)
    with pytest.raises(TypeError, match="uint8"):
        op(np.zeros((4, 4)), device=device)
    for shape in ((4,), (0, 4)):
        with pytest.raises(ValueError, match="rows, columns"):
            op(np.zeros(shape, np.uint8), device=device)
    with pytest.raises(ValueError, match="3"):
        UndistortImage(model=lens, channels=3)(np.zeros((4, 4), np.uint8), device=device)
    with pytest.raises(ValueError, match="uint8"):
        UndistortImage(model=lens, border="constant", border_value=300.0)(np.zeros((4, 4), np.uint8), device=device)
    with pytest.raises(ValueError, match="leaves the map"):
        UndistortImage(model=np.zeros((4, 4, 2)), region=(2, 2, 3, 3))(np.zeros((4, 4), np.uint8), device=device)
