"""FindBlobs on devices: fiducials of every shape against float64 references, and flags for missing ones."""

from __future__ import annotations

import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pyopencl.array
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from canary import Guarded
from gpuvision.host import Device
from gpuvision.matching.features.blob import FindBlobs
from gpuvision.matching.features.ruler import RulerEdges
from gpuvision.operation import KERNEL_FOLDER
from gpuvision.reference import blob as reference
from gpuvision.status import Status

SHAPE, TRUE = (80, 96), np.array([48.7, 39.4])
VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
PLAIN = FindBlobs(threshold=20.0, noise=2.0, spokes=32)
POLARITY: dict[str, Any] = {"circle": "bright", "ring": "dark", "square": "dark", "cross": "bright"}
RATIO = {"circle": 0.5, "ring": 0.5, "square": 0.5, "cross": 0.3}
ON_DEVICES = settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def image_of(values: np.ndarray, dtype: Any) -> np.ndarray:
    return values.astype(dtype) if np.dtype(dtype).kind == "f" else np.rint(values).astype(dtype)


def place(x: float = 47.9, y: float = 40.0, size: float = 10.0, *angle: float) -> np.ndarray:
    return np.array([[x, y, size, *angle]], np.float32)


def a_disc(radius: float = 10.0, blur: float = 1.0) -> np.ndarray:
    return 50.0 + 100.0 * reference.disc(SHAPE, *TRUE, radius, blur)


def centre(blobs: Any, k: int = 0) -> np.ndarray:
    return np.array([blobs.x[k], blobs.y[k]], np.float64)


@pytest.mark.parametrize(
    ("dtype", "variant"),
    [(np.uint8, "vector"), pytest.param(np.uint16, "vector", marks=pytest.mark.slow), (np.float32, "work_item")],
)
def test_a_disc(device: Device, dtype: Any, variant: Any) -> None:
    saturation = None if dtype == np.float32 else 255.0
    blobs = replace(PLAIN, variant=variant, saturation=saturation)(image_of(a_disc(), dtype), place(), device=device)
    assert blobs.status[0] == 0
    np.testing.assert_allclose(centre(blobs), TRUE, rtol=0, atol=2e-3)  # rounded grey levels: 0.3 of 100
    np.testing.assert_allclose(blobs.shift[0], TRUE - [47.9, 40.0], rtol=0, atol=2e-3)
    np.testing.assert_allclose([blobs.gravity_x[0], blobs.gravity_y[0]], TRUE, rtol=0, atol=5e-3)
    assert abs(blobs.size[0] - 10.0) < 5e-3
    assert abs(blobs.contrast[0] - 100.0) < 0.3
    assert abs(blobs.blur[0] - 1.0) < 0.01
    assert abs(blobs.distance[0] - math.hypot(0.8, 0.6)) < 3e-3
    assert blobs.inliers[0] == 32
    assert blobs.symmetry[0] > 0.95
    assert blobs.residual[0] < 0.05
    assert blobs.angle is None


@VARIANTS
def test_centre_of_gravity_of_a_noisy_image(device: Device, variant: Any, rng: np.random.Generator) -> None:
    """The grey levels up to 2.5 blurs and 1 px beyond the contour, less their mean in the next 2 px."""
    image = image_of(a_disc() + rng.normal(0.0, 5.0, SHAPE), np.float32)
    blobs = replace(PLAIN, variant=variant)(image, place(), device=device)
    (x, y), reach = centre(blobs), blobs.size[0] + 2.5 * blobs.blur[0] + 1.0
    rows, columns = np.indices(SHAPE)
    distance = np.hypot(columns - x, rows - y)
    inside, ring = distance <= reach, (distance > reach) & (distance <= reach + 2.0)
    assert np.min(np.abs(distance[..., None] - [reach, reach + 2.0])) > 1e-4
    light = (image.astype(np.float64) - image[ring].mean(dtype=np.float64)) * inside
    expected = [np.sum(light * each) / np.sum(light) for each in (columns, rows)]
    np.testing.assert_allclose([blobs.gravity_x[0], blobs.gravity_y[0]], expected, rtol=0, atol=2e-4)


@VARIANTS
@pytest.mark.parametrize("shape", ["circle", "ring", "square", "cross"])
def test_every_shape_without_noise(device: Device, variant: Any, shape: Any) -> None:
    """Exact except for the edge profile (2.4e-4 of the contrast) and the first-order curvature of a disc."""
    straight, polarity = shape in ("square", "cross"), POLARITY[shape]
    numbers = np.array([*TRUE, 14.0, 0.35, 1.1] if straight else [*TRUE, 14.0, 1.1])
    level = reference.render(shape, SHAPE, numbers, RATIO[shape])
    image = (50.0 + 100.0 * level if polarity == "bright" else 150.0 - 100.0 * level).astype(np.float32)
    operation = replace(PLAIN, shape=shape, ratio=RATIO[shape], polarity=polarity, variant=variant)
    blobs = operation(image, place(48.0, 40.0, 14.5, *((0.3,) if straight else ())), device=device)
    assert blobs.status[0] == 0
    np.testing.assert_allclose(centre(blobs), TRUE, rtol=0, atol=1e-3)
    assert abs(blobs.size[0] - 14.0) < 3e-3
    assert abs(abs(blobs.contrast[0]) - 100.0) < 0.1
    assert (blobs.contrast[0] > 0) == (polarity == "bright")
    if straight:
        assert abs(blobs.angle[0] - 0.35) < 2e-4
    assert blobs.covariance.shape == (1, 4, 4) if straight else (1, 3, 3)


@VARIANTS
@pytest.mark.parametrize("shape", ["circle", pytest.param("ring", marks=pytest.mark.slow), "square", "cross"])
def test_matched_as_least_squares_have_it(device: Device, variant: Any, shape: Any, rng: np.random.Generator) -> None:
    """SciPy's least squares, same pixels, exact profiles: the difference is at most half the deviation by noise.

    Tukey's weights, which the reference lacks, and the stopping criterion contribute to the difference.
    """
    straight = shape in ("square", "cross")
    numbers = np.array([*TRUE, 13.0, 0.2, 1.0] if straight else [*TRUE, 13.0, 1.0])
    sign = 1.0 if POLARITY[shape] == "bright" else -1.0
    image = 150.0 + sign * 100.0 * reference.render(shape, SHAPE, numbers, RATIO[shape]) + rng.normal(0.0, 3.0, SHAPE)
    extent = {"square": math.sqrt(2.0), "cross": math.hypot(1.0, 0.3)}.get(shape, 1.0)
    exact = reference.fit(image, shape, numbers, RATIO[shape], 13.0 * extent + 7.0)
    operation = replace(PLAIN, shape=shape, ratio=RATIO[shape], polarity=POLARITY[shape], noise=3.0, variant=variant)
    blobs = operation(image.astype(np.float32), place(48.0, 40.0, 13.0, *((0.2,) if straight else ())), device=device)
    assert blobs.status[0] == 0
    fields = ("x", "y", "size", "angle") if straight else ("x", "y", "size")
    sigma = np.sqrt(np.diagonal(blobs.covariance[0]))
    ours = [getattr(blobs, name)[0] for name in fields]
    assert np.all(np.abs(ours - exact[: len(fields)]) < 0.5 * sigma)


@VARIANTS
@pytest.mark.parametrize("radius", [7.0, 15.0])
def test_edges_alone_as_their_circle_has_it(device: Device, variant: Any, radius: float) -> None:
    """Without the match: edges along the same rulers, SciPy's circle through them, corrected for curvature.

    FindBlobs gives less weight to edges with interpolation errors, which explains the difference.
    """
    image = a_disc(radius).astype(np.float32)
    operation = replace(PLAIN, match=False, passes=1, variant=variant)
    nominal = place(48.4, 39.7, radius)
    blobs = operation(image, nominal, device=device)
    angle = np.arange(32) * math.pi / 16.0
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)
    start = nominal[0, :2] + radius * direction
    rulers = np.concatenate([start, direction], axis=-1).astype(np.float32)
    edges = RulerEdges(threshold=20.0, length=25, width=1, smoothing_px=1.5, polarity="falling")
    points = start + edges(image, rulers, device=device).position[:, None] * direction
    found = reference.circle_through(points.astype(np.float64), np.array([*TRUE, radius]))
    bent = math.sqrt(found[2] ** 2 + float(blobs.blur[0]) ** 2)
    np.testing.assert_allclose([*centre(blobs), blobs.size[0]], [*found[:2], bent], rtol=0, atol=2e-3)
    np.testing.assert_allclose(centre(blobs), TRUE, rtol=0, atol=0.01)
    assert abs(blobs.size[0] - radius) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("spokes", "match"), [(8, True), (20, True), (44, False)])
def test_any_number_of_rulers(device: Device, spokes: int, match: bool) -> None:
    """Numbers of fiducials that fill the kernel's vectors, and other numbers."""
    blobs = replace(PLAIN, spokes=spokes, match=match)(a_disc().astype(np.float32), place(), device=device)
    assert blobs.status[0] == 0
    assert blobs.inliers[0] == spokes
    assert np.hypot(*(centre(blobs) - TRUE)) < (2e-3 if match else 0.02)


@pytest.mark.slow
@VARIANTS
def test_unwritten_memory_does_not_reach_the_symmetry(
    device: Device, variant: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """24 rulers are padded to 32: with NaN in the arrays before they are written, the results have the same bits."""
    image = a_disc().astype(np.float32)
    operation = replace(PLAIN, spokes=24, match=False, count=1, variant=variant)
    plain = operation.bind(device, image.shape, image.dtype).on_host([image, place()])
    shutil.copytree(KERNEL_FOLDER, tmp_path / "kernels")
    source = tmp_path / "kernels" / "blob" / "blob.cl"
    declared = "GROUP_SPACE blob_quality quality;"
    filled = (
        f"{declared}\nfor (int i = GROUP_ITEM; i < PADDED_SPOKES + SPOKES / 2 + LANES; i += GROUP_ITEMS) "
        "quality.height[i] = quality.weights[i] = REAL_NAN;\ngroup_barrier();"
    )
    before, after = source.read_text().split(declared)
    source.write_text(before + filled + after)
    monkeypatch.setattr(FindBlobs, "kernel_folder", tmp_path / "kernels")
    blobs = operation.bind(device, image.shape, image.dtype).on_host([image, place()])
    assert 0.95 < plain.symmetry[0] <= 1.0
    for name, expected in plain._asdict().items():
        if expected is not None:
            np.testing.assert_array_equal(getattr(blobs, name), expected, err_msg=name)


def occluded(image: np.ndarray, kind: str, rng: np.random.Generator) -> np.ndarray:
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    image = image.copy()
    if kind == "cut":
        image[column > TRUE[0] + 4.5] = 50.0
    elif kind == "wedge":
        image[np.abs(np.arctan2(row - TRUE[1], column - TRUE[0])) < 0.3 * math.pi] = 50.0
    elif kind == "silk":
        image += (190.0 - image) * reference.bar(SHAPE, 52.0, 33.0, -0.6, 40.0, 2.0, 0.8)
    elif kind == "neighbour":
        image = np.maximum(image, 50.0 + 130.0 * reference.disc(SHAPE, 66.0, 40.0, 6.0, 1.0))
    else:
        for _ in range(25):
            x, y, grey = rng.uniform(20.0, 76.0), rng.uniform(10.0, 70.0), rng.uniform(20.0, 200.0)
            image += (grey - image) * reference.disc(SHAPE, x, y, rng.uniform(1.0, 3.0), 0.7)
    return image


@pytest.mark.parametrize("kind", ["cut", "wedge", "silk", "neighbour", "clutter"])
def test_what_hides_a_part_of_the_mark(device: Device, kind: str, rng: np.random.Generator) -> None:
    """30 % of the contour gone, silk over it, a brighter disc within the search radius, 25 specks: within 0.05 px.

    All disturbances except the specks bias the centre of gravity, and `symmetry` shows it.
    """
    plain = PLAIN(a_disc().astype(np.float32), place(), device=device)
    image = occluded(a_disc(), kind, rng) + rng.normal(0.0, 2.0, SHAPE)
    blobs = PLAIN(image.astype(np.float32), place(), device=device)
    assert blobs.status[0] == 0
    assert np.hypot(*(centre(blobs) - TRUE)) < 0.05
    assert abs(blobs.size[0] - 10.0) < 0.05
    assert blobs.symmetry[0] < 0.97 * plain.symmetry[0]
    assert blobs.covariance[0, 0, 0] > plain.covariance[0, 0, 0]
    if kind != "clutter":
        assert blobs.inliers[0] < 32
        assert np.hypot(blobs.gravity_x[0] - TRUE[0], blobs.gravity_y[0] - TRUE[1]) > 0.3


@ON_DEVICES
@given(
    angle=st.floats(0.0, 2.0 * math.pi),
    share=st.floats(0.0, 0.3),
    grey=st.floats(30.0, 140.0),
    off=st.floats(0.0, 3.0),
    towards=st.floats(0.0, 2.0 * math.pi),
)
def test_a_wedge_anywhere(device: Device, angle: float, share: float, grey: float, off: float, towards: float) -> None:
    """Up to 30 % of the disc of any other grey level, from any nominal place within 3 px: within 0.1 px, or refused."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]]
    image = a_disc()
    away = np.angle(np.exp(1j * (np.arctan2(row - TRUE[1], column - TRUE[0]) - angle)))
    image[np.abs(away) < share * math.pi] = grey
    image += np.random.default_rng(3).normal(0.0, 2.0, SHAPE)
    nominal = place(TRUE[0] + off * math.cos(towards), TRUE[1] + off * math.sin(towards))
    blobs = PLAIN(image.astype(np.float32), nominal, device=device)
    assert blobs.status[0] == 0
    assert np.hypot(*(centre(blobs) - TRUE)) < 0.1


def test_not_chasing_what_lies_beyond(device: Device, rng: np.random.Generator) -> None:
    """A fiducial 5 px away is found; a fiducial 9 px away is not found, even after many passes."""
    image = (a_disc() + rng.normal(0.0, 2.0, SHAPE)).astype(np.float32)
    for match in (True, False):
        operation = replace(PLAIN, passes=6, match=match)
        close = operation(image, place(TRUE[0] - 5.0, TRUE[1]), device=device)
        assert close.status[0] == 0
        assert np.hypot(*(centre(close) - TRUE)) < 0.05
        assert abs(close.distance[0] - 5.0) < 0.05
        far = operation(image, place(TRUE[0] - 9.0, TRUE[1]), device=device)
        assert far.status[0] != 0
        assert np.isnan(far.x[0])


@pytest.mark.parametrize(("polarity", "sign"), [("bright", 1.0), pytest.param("dark", -1.0, marks=pytest.mark.slow)])
def test_contrast_reversed(device: Device, polarity: Any, sign: float) -> None:
    """Reversed contrast is refused, or found if both polarities are allowed, for each fiducial separately."""
    bright, dark = a_disc().astype(np.float32), (200.0 - a_disc()).astype(np.float32)
    image, reversed_image = (bright, dark) if sign > 0.0 else (dark, bright)
    one, either = replace(PLAIN, polarity=polarity), replace(PLAIN, polarity="either")
    assert one(image, place(), device=device).status[0] == 0
    assert one(reversed_image, place(), device=device).status[0] == Status.LOW_SIGNAL
    for each, contrast in ((image, sign * 100.0), (reversed_image, -sign * 100.0)):
        blobs = either(each, place(), device=device)
        assert blobs.status[0] == 0
        assert np.hypot(*(centre(blobs) - TRUE)) < 2e-3
        assert abs(blobs.contrast[0] - contrast) < 0.2


@VARIANTS
def test_what_is_not_trusted(device: Device, variant: Any) -> None:
    image = np.full((80, 200), 50.0, np.float32)
    image[:, :96] = a_disc()
    image[:, 104:] = a_disc()
    row, column = np.mgrid[:80, :96]
    image[:, 104:][(column > 35) & (column < 60) & (row > 20) & (row < 41)] = np.nan
    places = np.concatenate(
        [
            place(),
            place(150.0, 70.0),
            place(90.0, 60.0, 8.0),
            place(0.0, 40.0),
            place(-1e30, 1e30),
            place(math.nan),
            place(48.0, math.inf),
            place(48.0, 40.0, 0.0),
            place(48.0, 40.0, -3.0),
            place(48.0, 40.0, math.nan),
            place(104.0 + TRUE[0], TRUE[1]),
        ]
    )
    dark, out, bad = Status.LOW_SIGNAL, Status.OUT_OF_RANGE, Status.NOT_FINITE
    blobs = replace(PLAIN, variant=variant)(image, places, device=device)
    expected = [Status.OK, out | dark, dark, out, out, bad, bad, bad, bad, bad, bad]
    found = [Status(each) for each in blobs.status]
    assert found[0] == Status.OK
    assert found[1] in (out, dark)
    assert found[2:] == expected[2:]
    assert blobs.inliers[0] == 32
    for name, values in blobs._asdict().items():
        if values is not None and name not in ("status", "inliers"):
            assert np.isnan(values[1:]).all(), name
    assert (blobs.inliers[1:] == 0).all()


def test_specks_all_over_are_no_marks(device: Device, rng: np.random.Generator) -> None:
    """Too few edges or pixels agree: at most one of 117 places is accepted as a fiducial."""
    image = np.full(SHAPE, 100.0)
    for _ in range(220):
        x, y, grey = rng.uniform(0.0, 96.0), rng.uniform(0.0, 80.0), rng.uniform(0.0, 250.0)
        image += (grey - image) * reference.disc(SHAPE, x, y, rng.uniform(1.0, 3.0), 0.7)
    places = np.array([(x, y, 10.0) for x in range(24, 73, 4) for y in range(24, 57, 4)], np.float32)
    blobs = PLAIN(image.astype(np.float32), places, device=device)
    assert (blobs.status == Status.AMBIGUOUS).sum() > 20
    assert (blobs.status == 0).sum() <= 1
    assert np.array_equal(np.isnan(blobs.x), blobs.status != 0)


def test_a_mark_that_leaves_the_image(device: Device) -> None:
    """If some rulers leave the image, the fiducial is found without a centre of gravity; if most do, it is refused."""
    for x, status in ((10.5, 0), (-3.0, Status.OUT_OF_RANGE)):
        image = (50.0 + 100.0 * reference.disc(SHAPE, x, 40.2, 10.0, 1.0)).astype(np.float32)
        blobs = PLAIN(image, place(x + 0.4, 40.0), device=device)
        assert blobs.status[0] == status
        if not status:
            assert np.hypot(*(centre(blobs) - [x, 40.2])) < 5e-3
            assert np.isnan(blobs.gravity_x[0])


def test_saturated_marks_come_with_a_value(device: Device) -> None:
    image = np.clip(np.rint(2.0 * a_disc()), 0.0, 255.0).astype(np.uint8)
    blobs = replace(PLAIN, saturation=255.0)(image, place(), device=device)
    assert blobs.status[0] == Status.SATURATED
    assert np.hypot(*(centre(blobs) - TRUE)) < 0.02


def test_a_slope_of_the_lighting(device: Device) -> None:
    """A slope of 0.1 grey levels per pixel does not move the match, and moves the centre of gravity by 0.1 px."""
    image = (a_disc() + 0.1 * np.arange(SHAPE[1])).astype(np.float32)
    blobs = PLAIN(image, place(), device=device)
    assert np.hypot(*(centre(blobs) - TRUE)) < 1e-3
    assert abs(blobs.gravity_x[0] - TRUE[0]) > 0.05


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e6, 1e30])
def test_any_scale_of_grey_levels(device: Device, scale: float) -> None:
    image = (a_disc() * scale).astype(np.float32)
    blobs = replace(PLAIN, threshold=20.0 * scale, noise=2.0 * scale)(image, place(), device=device)
    assert blobs.status[0] == 0
    np.testing.assert_allclose(centre(blobs), TRUE, rtol=0, atol=1e-3)
    np.testing.assert_allclose(blobs.contrast, 100.0 * scale, rtol=2e-3)


def test_smallest_images(device: Device) -> None:
    """Images one vector wide, and images with fewer rows than the height of a fiducial."""
    image = (50.0 + 100.0 * reference.disc((17, 16), 7.6, 8.3, 2.4, 0.6)).astype(np.float32)
    operation = FindBlobs(threshold=20.0, search_px=1.0, smoothing_px=0.8)
    blobs = operation(image, place(7.5, 8.2, 2.4), device=device)
    assert blobs.status[0] == 0
    assert np.hypot(*(centre(blobs) - [7.6, 8.3])) < 0.01
    flat = operation(np.ascontiguousarray(image[5:12]), place(7.5, 3.2, 2.4), device=device)
    assert flat.status[0] == Status.OUT_OF_RANGE


@VARIANTS
def test_canaries_and_bound_calls(device: Device, variant: Any, rng: np.random.Generator) -> None:
    image = (a_disc() + rng.normal(0.0, 2.0, SHAPE)).astype(np.float32)
    places = np.repeat(place(), 19, axis=0)
    places[:, :2] += rng.uniform(-2.0, 2.0, (19, 2)).astype(np.float32)
    for operation in (
        replace(PLAIN, variant=variant),
        replace(PLAIN, shape="square", polarity="dark", variant=variant),
    ):
        given_places = places if operation.shape == "circle" else np.pad(places, ((0, 0), (0, 1)))
        operation = replace(operation, count=19)
        plain = operation(image, given_places, device=device)
        guarded = Guarded(plain)
        operation(image, given_places, device=device, out=guarded.out)
        guarded.assert_intact()
        bound = operation.bind(device, image.shape, image.dtype)
        result = bound.run(*(cl.array.to_device(device.queue, each) for each in (image, given_places)))
        for mine, theirs, out in zip(result, plain, guarded.out, strict=True):
            if theirs is not None:
                np.testing.assert_array_equal(mine.get(), theirs)
                np.testing.assert_array_equal(out, theirs)


def test_no_marks(device: Device) -> None:
    blobs = PLAIN(np.zeros((40, 40), np.float32), np.zeros((0, 3), np.float32), device=device)
    assert blobs.x.shape == (0,)
    assert blobs.covariance.shape == (0, 3, 3)


def test_wrong_input(device: Device) -> None:
    with pytest.raises(TypeError, match="uint8, uint16 or float32"):
        PLAIN(np.zeros(SHAPE), place(), device=device)
    with pytest.raises(ValueError, match="16 columns or more"):
        PLAIN(np.zeros((80, 15), np.uint8), place(), device=device)
    with pytest.raises(ValueError, match="to the number of blobs"):
        PLAIN.bind(device, SHAPE, np.uint8)
    with pytest.raises(ValueError, match="shape"):
        replace(PLAIN, shape="square", polarity="dark")(np.zeros(SHAPE, np.float32), place(), device=device)
    with pytest.raises(TypeError, match="float32"):
        PLAIN(np.zeros(SHAPE, np.float32), place().astype(np.float64), device=device)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"shape": "star"}, ValueError, "expected one of circle, ring, square, cross"),
        ({"polarity": "light"}, ValueError, "expected one of bright, dark, either"),
        ({"ratio": 1.0}, ValueError, "ratio"),
        ({"min_inlier_fraction": 0.0}, ValueError, "min_inlier_fraction"),
        ({"search_px": math.nan}, ValueError, "search_px"),
        ({"spokes": 18}, ValueError, "a multiple of 4"),
        ({"spokes": 20, "shape": "ring"}, ValueError, "a multiple of 8"),
        ({"spokes": 16.0}, TypeError, "spokes must be a whole number"),
        ({"passes": 0}, ValueError, "passes is 0"),
        ({"threshold": 0.0}, ValueError, "threshold"),
        ({"noise": -1.0}, ValueError, "noise"),
        ({"width": 0}, ValueError, "width"),
        ({"smoothing_px": 0.0}, ValueError, "smoothing_px"),
        ({"count": -1}, ValueError, "count"),
    ],
)
def test_wrong_parameters(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        FindBlobs(**{"threshold": 20.0, **options})


def test_integer_frames_have_the_noise_of_rounding() -> None:
    """Rounding to whole grey levels adds a variance of 1/12: frames of floats with the sum have the same numbers."""
    shape = (64, 64)
    rounded = replace(PLAIN, count=3, noise=0.5).launch(Device.best(), shape, np.dtype(np.uint8))
    exact = replace(PLAIN, count=3, noise=math.sqrt(0.25 + 1.0 / 12.0)).launch(
        Device.best(), shape, np.dtype(np.float32)
    )
    for one, other in zip(rounded.arguments, exact.arguments, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


@pytest.mark.parametrize("width", [1, 2, 5])
@pytest.mark.parametrize(("shape", "ratio"), [("circle", 0.5), ("ring", 0.25), ("square", 0.5), ("cross", 0.3)])
def test_numbers_of_the_kernel_follow_from_the_shape(shape: Any, ratio: float, width: int) -> None:
    """Spread of the lines of a ruler, size at which rulers share pixels, extent, noise, contour for each ruler."""
    blobs = FindBlobs(threshold=20.0, shape=shape, ratio=ratio, width=width, spokes=24, noise=0.75, count=2)
    launch = blobs.launch(Device.best(), (64, 64), np.dtype(np.float32))
    spread, overlap, extent, noise, each = (float(value) for value in launch.arguments[-6:-1])
    contour = {
        "circle": 2.0 * math.pi,
        "ring": 2.5 * math.pi,
        "square": 4.0 * 0.7 * 2.0,
        # Half of the end of each arm, and half of its flanks, which reach from the ratio to 1.
        "cross": 4.0 * (0.5 * 2.0 * 0.3 + 2.0 * 0.5 * 0.7),
    }[shape]
    assert spread == pytest.approx(np.var(np.arange(width)), abs=1e-7)
    # Bilinear interpolation gives neighbouring lines a correlation: w lines have the noise of w^2 / (w - 1/3).
    assert overlap == pytest.approx(24 * width**2 / (width - 1 / 3) / contour, rel=1e-6)
    assert extent == pytest.approx({"square": math.sqrt(2.0), "cross": math.hypot(1.0, 0.3)}.get(shape, 1.0), rel=1e-6)
    assert (noise, each) == pytest.approx((0.75, contour / 24), rel=1e-6)
    assert int(launch.arguments[-1]) == blobs.passes
    # Of 24 edges half must agree, and one more than the unknowns: x, y and size, and the angle of a square or a cross.
    least = replace(blobs, min_inlier_fraction=0.01).launch(Device.best(), (64, 64), np.dtype(np.float32))
    assert int(launch.arguments[-7]) == 12
    assert int(least.arguments[-7]) == (5 if shape in ("square", "cross") else 4)


@pytest.mark.parametrize("spokes", [16, 24, 40])
def test_rulers_lie_evenly_on_the_contour(spokes: int) -> None:
    """Places, normals, heights and weights; one half first, then the opposite rulers; the table ends with weights 0."""

    def rulers(shape: Any, ratio: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
        blobs = FindBlobs(threshold=20.0, shape=shape, ratio=ratio, spokes=spokes, count=2)
        table = np.array(blobs.launch(Device.best(), (64, 64), np.dtype(np.float32)).arguments[1], np.float64)
        assert table.shape == (6, 16 * math.ceil(spokes / 16))
        assert not table[5, spokes:].any()
        assert np.all(table[5, :spokes] == 1.0)
        base, normal, height = table[:2, :spokes].T, table[2:4, :spokes].T, table[4, :spokes]
        np.testing.assert_allclose(height, np.abs(np.sum(base * normal, axis=1)), atol=1e-6)
        np.testing.assert_array_equal(base[spokes // 2 :], -base[: spokes // 2])
        np.testing.assert_array_equal(normal[spokes // 2 :], -normal[: spokes // 2])
        return base, normal

    def angles(places: np.ndarray) -> np.ndarray:
        return np.asarray(np.sort(np.degrees(np.arctan2(places[:, 1], places[:, 0])) % 359.99999))

    base, normal = rulers("circle")
    np.testing.assert_allclose(angles(base), np.arange(spokes) * 360.0 / spokes, atol=2e-5)
    np.testing.assert_array_equal(base, normal)
    base, normal = rulers("ring", 0.25)
    is_outer = np.hypot(*base.T) > 0.6
    np.testing.assert_allclose(np.hypot(*base.T), np.where(is_outer, 1.0, 0.25), rtol=1e-6)
    np.testing.assert_allclose(normal, np.where(is_outer[:, None], base, -4.0 * base), atol=1e-6)
    step = 720.0 / spokes
    np.testing.assert_allclose(angles(base[is_outer]), np.arange(spokes // 2) * step, atol=2e-5)
    np.testing.assert_allclose(angles(base[~is_outer]), (np.arange(spokes // 2) + 0.5) * step, atol=2e-5)
    base, normal = rulers("square")
    side = normal[:, 0] > 0.5
    along = (2.0 * np.arange(spokes // 4) + 1.0) / (spokes // 4) - 1.0
    np.testing.assert_allclose(base[side], [(1.0, 0.7 * each) for each in along], rtol=1e-6)
    is_top = normal[:, 1] > 0.5
    np.testing.assert_allclose(base[is_top], [(-0.7 * each, 1.0) for each in along], rtol=1e-6)
    base, normal = rulers("cross", 0.3)
    # Of the arm along x: 3/8 of the rulers on each flank, in the middle half of it; the others on half of the end.
    flank = {16: 2, 24: 2, 40: 4}[spokes]
    end = spokes // 4 - 2 * flank
    first, normals = base[: spokes // 4], normal[: spokes // 4]
    np.testing.assert_array_equal(normals, [(1.0, 0.0)] * end + [(0.0, 1.0)] * flank + [(0.0, -1.0)] * flank)
    out = 0.65 + 0.175 * ((2.0 * np.arange(flank) + 1.0) / flank - 1.0)
    across = 0.15 * ((2.0 * np.arange(end) + 1.0) / max(end, 1) - 1.0)
    expected = [(1.0, each) for each in across] + [(each, side * 0.3) for side in (1.0, -1.0) for each in out]
    np.testing.assert_allclose(first, expected, rtol=1e-6, atol=1e-7)
    turned = np.array([[0.0, -1.0], [1.0, 0.0]])
    np.testing.assert_allclose(base[spokes // 4 : spokes // 2], first @ turned.T, atol=1e-7)
    np.testing.assert_allclose(normal[spokes // 4 : spokes // 2], normals @ turned.T, atol=1e-7)


def notched_square(half: float, depths: list[int]) -> np.ndarray:
    """Return a square with notches of some depths [px] in the middle of its right, left, lower and upper side."""
    dy, dx = np.mgrid[:64, :64] - 32.0
    inside = np.clip(half + 0.5 - np.abs(dx), 0.0, 1.0) * np.clip(half + 0.5 - np.abs(dy), 0.0, 1.0)
    for depth, along, across in zip(depths, (dx, -dx, dy, -dy), (dy, dy, dx, dx), strict=False):
        inside[(along > half - depth) & (np.abs(across) < 6.0)] = 0.0
    return 40.0 + 160.0 * inside


@pytest.mark.vectors
@pytest.mark.parametrize("match", [True, False])
def test_variants_choose_the_same_of_equal_starts(device: Device, match: bool) -> None:
    """Several shapes fit the edges of a square with notches equally well."""
    plain = FindBlobs(threshold=10.0, shape="square", match=match)
    for seed in range(40):
        rng = np.random.default_rng(seed)
        half = float(rng.choice([8.0, 9.5, 10.0, 12.0]))
        image = np.rint(notched_square(half, list(rng.integers(2, 6, seed % 5)))).astype(np.uint8)
        near = place(32.0, 32.0, half, 0.0)
        vector, item = (replace(plain, variant=each)(image, near, device=device) for each in ("vector", "work_item"))
        assert vector.status == item.status
        np.testing.assert_allclose(centre(vector), centre(item), rtol=0, atol=1e-3)
