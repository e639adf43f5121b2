"""RulerEdges on devices: against the float64 reference on every kind of image, and flags."""

from __future__ import annotations

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
from scipy.special import erf

from canary import Guarded
from gpuvision.camera.camera import Camera
from gpuvision.camera.lens import Lens
from gpuvision.host import Device
from gpuvision.host.kept import clear_cache
from gpuvision.matching.features.ruler import RulerEdges, best_smoothing
from gpuvision.reference import ruler as reference
from gpuvision.status import Status
from tiers import variants_of

SHAPE, MIDDLE = (120, 150), (75.0, 60.0)
VARIANTS = pytest.mark.parametrize("variant", ["vector", "work_item"])
STRONGEST = RulerEdges(threshold=20.0)
ON_DEVICES = settings(max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def image_of(values: np.ndarray, dtype: Any) -> np.ndarray:
    return values.astype(dtype) if np.dtype(dtype).kind == "f" else np.rint(values).astype(dtype)


def one_ruler(x: float = 75.0, y: float = 60.0, angle: float = 0.0) -> np.ndarray:
    return np.array([[x, y, math.cos(angle), math.sin(angle)]], np.float32)


def step(rng: np.random.Generator, angle: float = 0.4, noise: float = 2.0, **more: Any) -> tuple[np.ndarray, ...]:
    """A noisy edge in the middle, and 40 rulers across it."""
    distance = float(np.dot(MIDDLE, (math.cos(angle), math.sin(angle))))
    image = reference.step_image(SHAPE, angle, distance, 1.2, **more) + rng.normal(0.0, noise, SHAPE)
    return image, reference.random_rulers(angle, distance, 40, rng, MIDDLE)


def expected(operation: RulerEdges, image: np.ndarray, rulers: np.ndarray) -> list[list[dict[str, float]]]:
    """Return all the edges of each ruler."""
    found = []
    for ruler in rulers:
        grey, _ = reference.profile(image, ruler, operation.length, operation.width, operation.step_px)
        options = (operation.smoothing_px, operation.threshold, operation.step_px)
        found.append(reference.find_edges(grey, *options, ruler, operation.width))
    return found


def assert_like(ours: Any, theirs: list[dict[str, float]], scale: float = 100.0) -> None:
    """Sample positions, relative to a pixel of the ruler, have a few roundings of 64 px; so have the grey levels.

    The error of an edge is the error of its samples divided by its slope, magnified by the difference of the
    logarithms.
    """
    for name, tolerance in (("position", 1e-4), ("amplitude", 2e-4 * scale), ("width", 5e-4)):
        values = [each[name] for each in theirs]
        np.testing.assert_allclose(getattr(ours, name), values, rtol=0, atol=tolerance, err_msg=name)


@VARIANTS
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_against_the_reference(device: Device, variant: Any, dtype: Any, rng: np.random.Generator) -> None:
    values, rulers = step(rng)
    image = image_of(values, dtype)
    ours = replace(STRONGEST, variant=variant)(image, rulers, device=device)
    assert (ours.status == 0).all()
    assert ours.spacing is None
    strongest = [max(each, key=lambda edge: abs(edge["gradient"])) for each in expected(STRONGEST, image, rulers)]
    assert_like(ours, strongest)


@VARIANTS
@pytest.mark.parametrize("edge_selection", ["strongest", "all"])
def test_pairs_among_many_edges(device: Device, variant: Any, edge_selection: Any, rng: np.random.Generator) -> None:
    """A long ruler across noise: each pair of neighbouring edges of the reference, over several words of bits."""
    image = 100.0 + 60.0 * cv2.GaussianBlur(rng.normal(0.0, 1.0, (100, 300)), (0, 0), 1.2)
    image = image.astype(np.float32)
    ruler, length = one_ruler(150.0, 50.0, 0.2), 200
    operation = RulerEdges(
        threshold=4.0,
        length=length,
        width=3,
        smoothing_px=1.0,
        edge_selection=edge_selection,
        max_edges=40,
        pairs=True,
        polarity="rising",
        variant=variant,
    )
    (edges,) = expected(operation, image, ruler)
    pairs = [(one, other) for one, other in itertools.pairwise(edges) if one["gradient"] > 0.0 > other["gradient"]]
    assert 10 < len(pairs) <= 40
    ours = operation(image, ruler, device=device)
    middle = np.array([0.5 * (one["position"] + other["position"]) for one, other in pairs])
    if edge_selection == "all":
        np.testing.assert_allclose(ours.position[0, : len(pairs)], middle, rtol=0, atol=2e-3)
        assert np.isnan(ours.position[0, len(pairs) :]).all()
        assert (ours.status[0, len(pairs) :] == Status.LOW_SIGNAL).all()
    else:
        weaker = [min(abs(one["gradient"]), abs(other["gradient"])) for one, other in pairs]
        assert abs(ours.position[0] - middle[int(np.argmax(weaker))]) < 2e-3


@VARIANTS
def test_odd_sizes_and_steps(device: Device, variant: Any, rng: np.random.Generator) -> None:
    values, rulers = step(rng, angle=2.5)
    image = values.astype(np.float32)
    operation = RulerEdges(threshold=20.0, length=51, width=4, step_px=0.75, smoothing_px=1.5, variant=variant)
    ours = operation(image, rulers, device=device)
    assert (ours.status == 0).all()
    strongest = [max(each, key=lambda edge: abs(edge["gradient"])) for each in expected(operation, image, rulers)]
    assert_like(ours, strongest)


@pytest.mark.parametrize(
    ("length", "width", "step_px", "angle"),
    [(129, 12, 1.5, 0.7), pytest.param(61, 5, 4.0, 0.1, marks=pytest.mark.slow), (200, 41, 1.0, 3.0)],
)
def test_long_and_wide_ones(
    device: Device, length: int, width: int, step_px: float, angle: float, rng: np.random.Generator
) -> None:
    """Fixed-point positions have fewer digits there, which are still sufficient."""
    distance = float(np.dot((170.0, 160.0), (math.cos(angle), math.sin(angle))))
    image = (reference.step_image((320, 340), angle, distance, 3.0) + rng.normal(0.0, 2.0, (320, 340))).astype(
        np.float32
    )
    rulers = reference.random_rulers(angle, distance, 5, rng, (170.0, 160.0))
    smoothing = 2.0 * step_px
    operation = RulerEdges(threshold=20.0, length=length, width=width, step_px=step_px, smoothing_px=smoothing)
    ours = operation(image, rulers, device=device)
    assert (ours.status == 0).all()
    strongest = [max(each, key=lambda edge: abs(edge["gradient"])) for each in expected(operation, image, rulers)]
    assert_like(ours, strongest)


@pytest.mark.parametrize("angle", [0.0, math.pi / 2, math.pi, -math.pi / 2, math.pi / 4])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_all_of_an_image(device: Device, dtype: Any, angle: float) -> None:
    """Samples and lines from the first to the last pixel: rounding never causes a read outside the image."""
    turned, diagonal = abs(math.sin(angle)) > 0.9, abs(math.sin(2.0 * angle)) > 0.9
    shape = (64, 16) if turned else (16, 64)
    length, width = 41 if diagonal else 64, 16
    if diagonal:
        shape = (40, 40)
    middle = (0.5 * (shape[1] - 1), 0.5 * (shape[0] - 1))
    distance = float(np.dot(middle, (math.cos(angle), math.sin(angle)))) + 0.25
    inner = image_of(reference.step_image(shape, angle, distance, 1.2), dtype)
    operation = RulerEdges(threshold=20.0, length=length, width=width)
    ruler = np.round(one_ruler(*middle, angle), 7)  # along the pixels, without the rounding error of pi
    ours = operation(inner, ruler, device=device)
    assert ours.status[0] == 0
    theirs = max(expected(operation, inner, ruler)[0], key=lambda edge: abs(edge["gradient"]))
    assert_like(ours, [theirs])


def test_lengths_and_polarities_share_a_program(device: Device) -> None:
    """Lengths of one capacity and one fixed-point format, and the polarities, are arguments of one program."""

    def options(**changed: Any) -> Any:
        return replace(STRONGEST, count=1, **changed).launch(device, SHAPE, np.dtype(np.uint8)).defines

    assert options(length=120) == options(length=15) == options(polarity="rising") == options(polarity="falling")
    assert options(length=129) != options(length=120)
    assert options(length=129) == options(length=240)


def test_shortest_and_a_single_line(device: Device) -> None:
    image = reference.step_image((20, 20), 0.0, 10.25, 0.8).astype(np.float32)
    operation = RulerEdges(threshold=20.0, length=9, width=1, smoothing_px=1.0)
    ours = operation(image, one_ruler(10.0, 7.0), device=device)
    (theirs,) = expected(operation, image, one_ruler(10.0, 7.0))
    assert_like(ours, theirs)


@ON_DEVICES
@given(angle=st.floats(0.0, 2.0 * math.pi), x=st.floats(60.0, 90.0), y=st.floats(45.0, 75.0))
def test_any_direction(device: Device, angle: float, x: float, y: float) -> None:
    """For an image that is linear along an edge, the reference holds in any direction, on and off the grid."""
    image = reference.step_image(SHAPE, 0.0, 75.2, 2.0).astype(np.float32)
    image += reference.step_image(SHAPE, math.pi / 2, 60.4, 2.0).astype(np.float32)
    ruler = one_ruler(x, y, angle)
    ours = STRONGEST(image, ruler, device=device)
    (theirs,) = expected(STRONGEST, image, ruler)
    ranked = sorted(theirs, key=lambda edge: -abs(edge["gradient"]))
    # Exclude edges close to the threshold, and pairs of edges so equal that rounding decides which is the strongest.
    assume(ranked)
    assume(abs(abs(ranked[0]["amplitude"]) - STRONGEST.threshold) >= 5.0)
    assume(len(ranked) == 1 or abs(ranked[1]["gradient"]) <= 0.9999 * abs(ranked[0]["gradient"]))
    np.testing.assert_allclose(ours.position, [ranked[0]["position"]], rtol=0, atol=2e-3)


@VARIANTS
@pytest.mark.parametrize("edge_selection", ["strongest", "first", "last", "all"])
def test_choices(device: Device, variant: Any, edge_selection: Any, rng: np.random.Generator) -> None:
    image = reference.stripe_image(SHAPE, 0.3, 90.0, 16.0, 1.0) + rng.normal(0.0, 1.0, SHAPE)
    image += 0.4 * reference.step_image(SHAPE, 0.3, 112.0, 1.0)
    rulers = reference.random_rulers(0.3, 94.0, 10, rng, MIDDLE)
    operation = RulerEdges(threshold=15.0, length=80, edge_selection=edge_selection, max_edges=5, variant=variant)
    ours = operation(image.astype(np.float32), rulers, device=device)
    for k, found in enumerate(expected(operation, image, rulers)):
        assert 2 <= len(found) <= 4
        mine = type(ours)(*(None if each is None else each[k] for each in ours))
        if edge_selection == "all":
            assert_like(type(ours)(*(None if each is None else each[: len(found)] for each in mine)), found)
            assert (mine.status[: len(found)] == 0).all()
            assert (mine.status[len(found) :] == Status.LOW_SIGNAL).all()
            assert np.isnan(mine.position[len(found) :]).all()
        else:
            wanted = {
                "first": found[0],
                "last": found[-1],
                "strongest": max(found, key=lambda edge: abs(edge["gradient"])),
            }[edge_selection]
            assert_like(mine, [wanted])


@VARIANTS
def test_more_edges_than_places(device: Device, variant: Any) -> None:
    image = reference.stripe_image(SHAPE, 0.0, 75.0, 20.0, 1.0).astype(np.float32)
    operation = RulerEdges(threshold=15.0, edge_selection="all", max_edges=1, variant=variant)
    ours = operation(image, one_ruler(), device=device)
    assert ours.status.shape == (1, 1)
    assert ours.status[0, 0] == Status.AMBIGUOUS
    assert abs(ours.position[0, 0] + 10.0) < 0.05


@VARIANTS
@pytest.mark.parametrize(("polarity", "sign", "place"), [("rising", 1.0, -8.0), ("falling", -1.0, 8.0)])
def test_polarity(device: Device, variant: Any, polarity: Any, sign: float, place: float) -> None:
    image = reference.stripe_image(SHAPE, 0.0, 75.0, 16.0, 1.0).astype(np.float32)
    ours = RulerEdges(threshold=15.0, polarity=polarity, variant=variant)(image, one_ruler(), device=device)
    assert np.sign(ours.amplitude) == sign
    assert abs(ours.position[0] - place) < 0.01
    # A reversed ruler changes the signs of the edges, but not their places in the image.
    back = RulerEdges(threshold=15.0, polarity=polarity, variant=variant)(
        image, one_ruler(angle=math.pi), device=device
    )
    assert abs(back.position[0] - place) < 0.01


@VARIANTS
@pytest.mark.parametrize("spacing", [9.3, 14.0])
def test_pairs_have_the_middle_whatever_the_width(device: Device, variant: Any, spacing: float) -> None:
    image = reference.stripe_image(SHAPE, 0.6, 95.5, spacing, 1.0).astype(np.float32)
    rulers = reference.random_rulers(0.6, 95.5, 12, np.random.default_rng(3), MIDDLE)
    true = 95.5 - np.einsum("ij,ij->i", rulers[:, :2].astype(float), rulers[:, 2:].astype(float))
    operation = RulerEdges(threshold=15.0, pairs=True, polarity="rising", variant=variant)
    ours = operation(image, rulers, device=device)
    assert (ours.status == 0).all()
    np.testing.assert_allclose(ours.position, true, rtol=0, atol=0.01)
    np.testing.assert_allclose(ours.spacing, spacing, rtol=0, atol=0.02)
    single = replace(operation, pairs=False)(image, rulers, device=device)
    np.testing.assert_allclose(ours.sigma, single.sigma / math.sqrt(2.0), rtol=0.05)
    # Each output of a pair equals the output of its two edges, measured as single edges.
    second = replace(operation, pairs=False, polarity="falling")(image, rulers, device=device)
    np.testing.assert_allclose(ours.position, 0.5 * (single.position + second.position), rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.spacing, second.position - single.position, rtol=0, atol=1e-5)
    np.testing.assert_allclose(ours.amplitude, 0.5 * (single.amplitude - second.amplitude), rtol=1e-5)
    np.testing.assert_allclose(ours.width, 0.5 * (single.width + second.width), rtol=1e-5)
    np.testing.assert_allclose(ours.sigma, 0.5 * np.hypot(single.sigma, second.sigma), rtol=1e-5)
    # The same stripe is not found as a dark stripe.
    dark = replace(operation, polarity="falling")(image, rulers, device=device)
    assert (dark.status == Status.LOW_SIGNAL).all()


def test_pairs_of_a_spacing(device: Device) -> None:
    """If an image shows two stripes, the stripe with the requested width is found."""
    image = reference.stripe_image(SHAPE, 0.0, 60.0, 8.0, 0.8) + reference.stripe_image(SHAPE, 0.0, 90.0, 14.0, 0.8)
    for limits, place in (((6.0, 10.0), -15.0), ((12.0, 16.0), 15.0)):
        operation = RulerEdges(threshold=15.0, pairs=True, polarity="rising", spacing_px=limits)
        ours = operation(image.astype(np.float32), one_ruler(), device=device)
        assert abs(ours.position[0] - place) < 0.02


@VARIANTS
@pytest.mark.parametrize("radius", [12.0, 25.0])
def test_curved_edges(device: Device, variant: Any, radius: float) -> None:
    """Radial rulers on a disc: the straight model has a bias of (blur^2 + lines) / (2 radius), the curved one none.

    The second order remains, a fraction (variance / radius^2) of that.
    """
    image = reference.disc_image(SHAPE, MIDDLE, radius, 1.2).astype(np.float32)
    angle = np.linspace(0.0, 2.0 * math.pi, 60, endpoint=False)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rulers = np.concatenate([MIDDLE + radius * direction, direction], axis=1).astype(np.float32)
    operation = RulerEdges(threshold=20.0, length=21, width=3, smoothing_px=1.5, variant=variant)
    straight = operation(image, rulers, device=device).position.mean()
    # The centre lies behind rulers that point outwards.
    curved = replace(operation, radius_px=-radius)(image, rulers, device=device).position.mean()
    bias = (1.2**2 + 2.0 / 3.0 + 1.0 / 6.0) / (2.0 * radius)
    assert abs(straight + bias) < 0.2 * bias
    assert abs(curved) < 0.2 * bias
    inward = np.concatenate([rulers[:, :2], -rulers[:, 2:]], axis=1)
    turned = replace(operation, radius_px=radius)(image, inward, device=device).position.mean()
    assert abs(turned) < 0.2 * bias


LENSES = {
    "lens": Lens(k1=-3e-6, k2=1e-11, centre=(70.0, 64.0)),
    "camera": Camera(
        matrix=((200.0, 0.0, 74.0), (0.0, 205.0, 59.0), (0.0, 0.0, 1.0)),
        distortion=(-0.2, 0.05, 1e-3, -5e-4, *(0.0,) * 10),
    ),
}


@VARIANTS
@pytest.mark.parametrize("model", LENSES.values(), ids=LENSES)
def test_through_a_lens(device: Device, variant: Any, model: Any, rng: np.random.Generator) -> None:
    """A straight edge of the scene is bent in the image; the ruler finds it in undistorted coordinates."""
    row, column = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float64)
    ideal = model.undistort(np.stack([column, row], axis=-1))
    angle, distance = 0.5, float(np.dot((30.0, 90.0), (math.cos(0.5), math.sin(0.5))))
    place = ideal @ [math.cos(angle), math.sin(angle)] - distance
    image = (100.0 + 50.0 * np.tanh(place / 1.5)).astype(np.float32)
    rulers = reference.random_rulers(angle, distance, 20, rng, (30.0, 90.0))
    operation = replace(STRONGEST, length=33, model=model, variant=variant)
    ours = operation(image, rulers, device=device)
    inside = ours.status == 0
    assert inside.sum() >= 10
    assert (ours.status[~inside] == Status.OUT_OF_RANGE).all()
    true = distance - np.einsum("ij,ij->i", rulers[:, :2].astype(float), rulers[:, 2:].astype(float))
    np.testing.assert_allclose(ours.position[inside], true[inside], rtol=0, atol=0.02)
    ignored = replace(operation, model=None)(image, rulers, device=device)
    assert np.nanmax(np.abs(ignored.position - true)) > 0.2
    for k in np.flatnonzero(inside)[:5]:
        grey, _ = reference.profile(image, rulers[k], 33, operation.width, 1.0, model.distort)
        theirs = max(reference.find_edges(grey, operation.smoothing_px, 20.0), key=lambda edge: abs(edge["gradient"]))
        assert abs(ours.position[k] - theirs["position"]) < 5e-4


def test_past_the_fold_of_the_lens(device: Device) -> None:
    lens = Lens(k1=-3e-4, centre=(75.0, 60.0))
    ours = replace(STRONGEST, model=lens)(np.zeros(SHAPE, np.uint8), one_ruler(), device=device)
    assert ours.status[0] & Status.NOT_INVERTIBLE
    assert np.isnan(ours.position[0])


@VARIANTS
def test_what_cannot_be_read_is_flagged(device: Device, variant: Any) -> None:
    image = reference.step_image(SHAPE, 0.0, 75.0, 1.0).astype(np.float32)
    image[100, 70] = np.nan
    image[20, 80] = np.inf
    rulers = np.concatenate(
        [
            one_ruler(),
            one_ruler(31.4),
            one_ruler(y=1.9),
            one_ruler(118.0),
            one_ruler(y=118.0),
            one_ruler(1e30, -1e30),
            one_ruler(math.nan),
            np.array([[75, 60, math.inf, 0]], np.float32),
            one_ruler(y=100.0),
            one_ruler(y=20.0),
            np.array([[75, 60, 0, 0]], np.float32),
            one_ruler(angle=math.pi / 2),
            one_ruler(-500.0),
        ]
    )
    out, bad, dark = Status.OUT_OF_RANGE, Status.NOT_FINITE, Status.LOW_SIGNAL
    ours = replace(STRONGEST, variant=variant)(image, rulers, device=device)
    assert [Status(each) for each in ours.status] == [
        *(Status(0), out, out, out, out, out),
        *(bad, bad, bad, bad, dark, dark, out),
    ]
    for values in (ours.position, ours.amplitude, ours.width, ours.sigma):
        assert np.array_equal(np.isnan(values), ours.status != 0)


@VARIANTS
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_up_to_the_border(device: Device, variant: Any, dtype: Any) -> None:
    """The outermost pixels belong to the image, and pixels beyond them are never read."""
    image = image_of(reference.step_image((5, 64), 0.0, 33.25, 1.0), dtype)
    operation = replace(STRONGEST, variant=variant)
    ruler = one_ruler(31.5, 2.0)
    ours = operation(image, ruler, device=device)
    assert ours.status[0] == 0
    assert abs(ours.position[0] - 1.75) < 0.01
    across = operation(np.ascontiguousarray(image.T), one_ruler(2.0, 31.5, math.pi / 2), device=device)
    np.testing.assert_allclose(across.position, ours.position, atol=1e-4)


@VARIANTS
@pytest.mark.parametrize(
    ("width", "length", "step_px", "rows", "norm"),
    [
        *((5, 40, 1.0, 120, 1.0), (2, 33, 0.8, 50, 1.0), (2, 24, 1.0, 4, 1.0), (2, 24, 1.0, 3, 1.0)),
        *((4, 30, 1.6, 120, 1.0), (3, 20, 1.0, 120, 1.7)),
    ],
)
def test_eight_bits_are_read_like_floats(
    device: Device, variant: Any, width: int, length: int, step_px: float, rows: int, norm: float,
    rng: np.random.Generator,
) -> None:  # fmt: skip
    """Words of pixels hold all samples: of noise, to the borders, at distances and directions of any length."""
    image = rng.integers(0, 256, (rows, 150)).astype(np.uint8)
    operation = RulerEdges(
        threshold=1.0, width=width, length=length, step_px=step_px, smoothing_px=1.2, saturation=250.0, variant=variant
    )
    angle = rng.uniform(0.0, 2.0 * math.pi, 100) if rows > 4 else np.tile([0.0, math.pi], 50)
    angle[:20] = np.repeat([0.0, math.pi / 2, math.pi, -math.pi / 2], 5)
    direction = norm * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    along, across = 0.5 * (length - 1) * step_px, 0.5 * (width - 1)
    reach = along * np.abs(direction) + across * np.abs(direction[:, ::-1])
    last = np.array([149.0, rows - 1.0])
    centres = reach + rng.uniform(0.0, 1.0, (100, 2)) * np.maximum(last - 2.0 * reach, 0.0)
    centres[::3], centres[1::3] = reach[::3], (last - reach)[1::3]
    rulers = np.concatenate([centres, direction], axis=1).astype(np.float32)
    ours, floats = (operation(each, rulers, device=device) for each in (image, image.astype(np.float32)))
    assert np.mean(np.isfinite(floats.position)) > 0.5
    np.testing.assert_array_equal(ours.status, floats.status)
    for name, tolerance in (("position", 1e-4), ("amplitude", 1e-2), ("width", 5e-4)):
        np.testing.assert_allclose(getattr(ours, name), getattr(floats, name), rtol=0, atol=tolerance, err_msg=name)


@VARIANTS
@pytest.mark.parametrize(("width", "length"), [(5, 40), (2, 151)])
def test_neighbours_of_other_lengths_change_no_result(
    device: Device, variant: Any, width: int, length: int, rng: np.random.Generator
) -> None:
    """Rulers of 8-bit images give the same bits where a neighbour's step is too long for patches of 4 x 4 pixels."""
    image = rng.integers(0, 256, (160, 190)).astype(np.uint8)
    operation = RulerEdges(threshold=1.0, width=width, length=length, smoothing_px=1.2, variant=variant)
    angle = rng.uniform(-0.2, 0.2, 37)
    rulers = np.stack(
        [rng.uniform(85.0, 105.0, 37), rng.uniform(60.0, 100.0, 37), np.cos(angle), np.sin(angle)], axis=1
    )
    mixed = rulers.copy()
    mixed[[3, 20, 36], 2:] *= 2.5
    alone, beside = (operation(image, each.astype(np.float32), device=device) for each in (rulers, mixed))
    same = np.delete(np.arange(37), [3, 20, 36])
    assert np.mean(np.isfinite(alone.position[same])) > 0.5
    for name in ("position", "amplitude", "width", "sigma", "status"):
        np.testing.assert_array_equal(getattr(beside, name)[same], getattr(alone, name)[same], err_msg=name)


@VARIANTS
def test_saturated_and_ambiguous_edges_come_with_a_value(device: Device, variant: Any) -> None:
    image = np.clip(np.rint(reference.step_image(SHAPE, 0.0, 75.0, 1.0, 50.0, 300.0)), 0, 255).astype(np.uint8)
    operation = replace(STRONGEST, saturation=255.0, ambiguity=0.8, variant=variant)
    ours = operation(image, one_ruler(), device=device)
    assert ours.status[0] == Status.SATURATED
    assert abs(ours.position[0]) < 0.5
    stripe = np.rint(reference.stripe_image(SHAPE, 0.0, 75.0, 16.0, 1.0)).astype(np.uint8)
    twice = operation(stripe, one_ruler(), device=device)
    assert twice.status[0] == Status.AMBIGUOUS
    assert abs(abs(twice.position[0]) - 8.0) < 0.02


@VARIANTS
@pytest.mark.parametrize(("dtype", "level"), [(np.uint8, 0), (np.uint8, 255), (np.uint16, 65535), (np.float32, -1e30)])
def test_no_contrast(device: Device, variant: Any, dtype: Any, level: float) -> None:
    rulers = np.concatenate([one_ruler(), one_ruler(70.3, 61.7, 0.7)])
    ours = replace(STRONGEST, variant=variant)(np.full(SHAPE, level, dtype), rulers, device=device)
    assert (ours.status == Status.LOW_SIGNAL).all()
    assert np.isnan(ours.position).all()
    assert np.isnan(ours.sigma).all()


@VARIANTS
def test_all_levels_of_16_bits(device: Device, variant: Any) -> None:
    image = np.rint(reference.step_image(SHAPE, 0.2, 86.0, 1.2, 0.0, 65535.0)).astype(np.uint16)
    rulers = reference.random_rulers(0.2, 86.0, 5, np.random.default_rng(1), MIDDLE)
    operation = replace(STRONGEST, width=16, variant=variant)
    ours = operation(image, rulers, device=device)
    assert (ours.status == 0).all()
    strongest = [max(each, key=lambda edge: abs(edge["gradient"])) for each in expected(operation, image, rulers)]
    assert_like(ours, strongest, 65535.0)


@pytest.mark.parametrize("scale", [1e-30, 1e-3, 1e6, 1e30])
def test_any_scale_of_grey_levels(device: Device, scale: float) -> None:
    image = (reference.step_image(SHAPE, 0.2, 86.0, 1.2) * scale).astype(np.float32)
    rulers = reference.random_rulers(0.2, 86.0, 5, np.random.default_rng(1), MIDDLE)
    ours = replace(STRONGEST, threshold=20.0 * scale)(image, rulers, device=device)
    true = 86.0 - np.einsum("ij,ij->i", rulers[:, :2].astype(float), rulers[:, 2:].astype(float))
    np.testing.assert_allclose(ours.position, true, rtol=0, atol=0.01)
    np.testing.assert_allclose(ours.amplitude, 100.0 * scale, rtol=0.03)


def test_beyond_the_largest_number(device: Device) -> None:
    image = (reference.step_image(SHAPE, 0.0, 75.0, 1.2) * 2e36).astype(np.float32)
    ours = replace(STRONGEST, threshold=1e30)(image, one_ruler(), device=device)
    assert ours.status[0] == Status.NOT_FINITE
    assert np.isnan(ours.position[0])


@VARIANTS
def test_canaries_and_bound_calls(device: Device, variant: Any, rng: np.random.Generator) -> None:
    values, rulers = step(rng)
    image = image_of(values, np.uint8)
    operation = replace(STRONGEST, variant=variant, count=len(rulers))
    plain = operation(image, rulers, device=device)
    guarded = Guarded(plain)
    operation(image, rulers, device=device, out=guarded.out)
    guarded.assert_intact()
    bound = operation.bind(device, image.shape, image.dtype)
    frames = [cl.array.to_device(device.queue, each) for each in (image, rulers)]
    result = bound.run(*frames)
    for mine, theirs, out in zip(result, plain, guarded.out, strict=True):
        if theirs is not None:
            np.testing.assert_array_equal(mine.get(), theirs)
            np.testing.assert_array_equal(out, theirs)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
@pytest.mark.parametrize(("length", "saturation"), [(64, None), (51, 255.0)])
def test_few_rulers_in_parts_give_the_same_bits(
    device: Device, dtype: Any, length: int, saturation: float | None, rng: np.random.Generator
) -> None:
    """Up to 8 rulers are sampled in parts side by side; the parts of a ruler are joined, and so are their flags."""
    values, rulers = step(rng)
    image = image_of(np.clip(values, 0.0, 254.0), dtype)
    rulers[1, 0] = np.nan
    x, y, cosine, sine = rulers[2]
    at = 0.5 * length - 6.0  # near the end of a ruler: in its last part
    image[
        round(y + at * sine) - 1 : round(y + at * sine) + 2, round(x + at * cosine) - 1 : round(x + at * cosine) + 2
    ] = 255
    operation = replace(STRONGEST, length=length, saturation=saturation, ambiguity=None if saturation is None else 0.8)
    every = operation(image, rulers, device=device)
    assert bool(every.status[2] & Status.SATURATED) == (saturation is not None)
    assert np.mean(np.isfinite(every.position)) > 0.5
    for count in (1, 2, 3, 4, 5, 8, 9, 20):
        for mine, theirs in zip(
            operation(image, np.ascontiguousarray(rulers[:count]), device=device), every, strict=True
        ):
            if mine is not None:
                np.testing.assert_array_equal(mine, theirs[:count], err_msg=str(count))


@pytest.mark.parametrize("count", [1, 3, 5])
def test_a_group_may_have_fewer_rulers(device: Device, count: int, rng: np.random.Generator) -> None:
    """Work-groups of four rulers: the last group computes the remaining rulers, and writes nothing beyond them."""
    values, rulers = step(rng)
    image = image_of(values, np.uint8)
    operation = replace(STRONGEST, variant="work_item")  # shares programs with `test_against_the_reference`
    every = operation(image, rulers, device=device)
    guarded = Guarded(operation(image, rulers[:count], device=device))
    some = operation(image, np.ascontiguousarray(rulers[:count]), device=device, out=guarded.out)
    guarded.assert_intact()
    for mine, theirs in zip(some, every, strict=True):
        if mine is not None:
            np.testing.assert_array_equal(mine, theirs[:count])


@pytest.mark.parametrize(
    "group", [16, pytest.param(32, marks=pytest.mark.slow), pytest.param(256, marks=pytest.mark.slow)]
)
def test_results_do_not_depend_on_the_size_of_the_group(
    device: Device, group: int, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise gives many candidates; the strongest one and its rival are the same for each split of the gradients."""
    image = (100.0 + 40.0 * cv2.GaussianBlur(rng.normal(0.0, 1.0, SHAPE), (0, 0), 1.2)).astype(np.float32)
    rulers = reference.random_rulers(0.4, 86.0, 9, rng, MIDDLE)
    operation = RulerEdges(threshold=5.0, smoothing_px=1.0, ambiguity=0.9, variant="work_item")
    usual = operation(image, rulers, device=device)
    assert (usual.status == 0).any()
    assert (usual.status == Status.AMBIGUOUS).any()
    for k, found in enumerate(expected(operation, image, rulers)):
        ranked = sorted(found, key=lambda edge: -abs(edge["gradient"]))
        assert abs(usual.position[k] - ranked[0]["position"]) < 1e-3
        is_rivalled = abs(ranked[1]["gradient"]) >= 0.9 * abs(ranked[0]["gradient"])
        assert usual.status[k] == (Status.AMBIGUOUS if is_rivalled else 0)
    monkeypatch.setattr("gpuvision.matching.features.ruler._GROUP", group)
    clear_cache()  # a kept instance has the usual group
    try:
        found = operation(image, rulers, device=device)
    finally:
        clear_cache()  # the instance of this group
    for mine, theirs in zip(found, usual, strict=True):
        if mine is not None:
            np.testing.assert_array_equal(mine, theirs)


def test_no_rulers(device: Device) -> None:
    ours = STRONGEST(np.zeros((40, 40), np.uint8), np.zeros((0, 4), np.float32), device=device)
    assert ours.position.shape == (0,)


def test_wrong_input(device: Device) -> None:
    rulers = one_ruler()
    with pytest.raises(TypeError, match="uint8, uint16 or float32"):
        STRONGEST(np.zeros(SHAPE), rulers, device=device)
    with pytest.raises(ValueError, match=r"images \(rows, columns\)"):
        STRONGEST(np.zeros((3, 4, 5), np.uint8), rulers, device=device)
    counted = replace(STRONGEST, count=1)
    assert counted.launch(device, (2, 2**15 - 1), np.dtype(np.uint8)).inputs[0][0] == (2, 2**15 - 1)
    for shape in ((1, 40), (40, 1), (2, 2**15)):
        with pytest.raises(ValueError, match=r"images \(rows, columns\) of 2 to 32767"):
            counted.launch(device, shape, np.dtype(np.uint8))
    with pytest.raises(ValueError, match="to the number of rulers"):
        STRONGEST.bind(device, SHAPE, np.uint8)
    with pytest.raises(TypeError, match="float32"):
        STRONGEST(np.zeros(SHAPE, np.uint8), rulers.astype(np.float64), device=device)
    with pytest.raises(ValueError, match="shape"):
        replace(STRONGEST, count=2)(np.zeros(SHAPE, np.uint8), rulers, device=device)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"threshold": 0.0}, ValueError, "threshold is 0.0, expected a number above 0"),
        ({"threshold": math.nan}, ValueError, "threshold"),
        ({"smoothing_px": -1.0}, ValueError, "smoothing_px"),
        ({"length": 14}, ValueError, "expected 15 samples or more"),
        ({"length": 10.5}, TypeError, "length must be a whole number"),
        ({"length": 513}, ValueError, "expected 5 to 512"),
        ({"width": 0}, ValueError, "width is 0"),
        ({"polarity": "up"}, ValueError, "expected one of any, rising, falling"),
        ({"edge_selection": "best"}, ValueError, "expected one of strongest"),
        ({"ambiguity": 1.5}, ValueError, "0 < share <= 1"),
        ({"ambiguity": 0.5, "edge_selection": "all"}, ValueError, "edge_selection='strongest' only"),
        ({"spacing_px": (3.0, 5.0)}, ValueError, "pairs=True only"),
        ({"pairs": True, "spacing_px": (5.0, 3.0)}, ValueError, "0 <= least <= greatest"),
        ({"pairs": True, "spacing_px": (-0.5, 3.0)}, ValueError, "0 <= least <= greatest"),
        ({"radius_px": 0.0}, ValueError, "radius_px is 0"),
        ({"noise": -1.0}, ValueError, "noise"),
        ({"model": 3}, TypeError, "expected a Lens or a Camera"),
        ({"count": -1}, ValueError, "count"),
    ],
)
def test_wrong_parameters(options: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        RulerEdges(**{"threshold": 20.0, **options})


@VARIANTS
@pytest.mark.parametrize("polarity", [1, -1])
@pytest.mark.parametrize(("smoothing", "blur", "per_px"), [(2.0, 1.0, 2e-3), (1.8, 0.8, -2e-3), (3.0, 1.2, 1e-3)])
def test_light_gradient_moves_edges_to_the_brighter_side(
    device: Device, variant: Any, polarity: int, smoothing: float, blur: float, per_px: float
) -> None:
    """The shift is g (a^2 + 2 b^2) to 10 %, for both polarities; an oracle in closed form."""
    operation = RulerEdges(threshold=10.0, length=41, width=5, smoothing_px=smoothing, variant=variant)
    shifts = []
    for place in np.linspace(63.5, 64.5, 11):
        away = np.arange(128.0) - place
        image = 100.0 + polarity * 60.0 * erf(away / (math.sqrt(2.0) * blur))
        lit, even = (
            operation(np.tile(each, (24, 1)).astype(np.float32), one_ruler(64.0, 12.0), device=device).position[0]
            for each in (image * (1.0 + per_px * away), image)
        )
        shifts.append(lit - even)
    assert np.mean(shifts) == pytest.approx(per_px * (smoothing**2 + 2.0 * blur**2), rel=0.1)


def test_the_recommended_smoothing() -> None:
    """The recommended smoothing minimises the variance of the gradient peak, (a^2 + s^2)^3 / (a^5 s), over a."""
    a = np.linspace(0.5, 5.0, 4501)
    assert abs(a[np.argmin((a**2 + 1.0) ** 3 / a**5)] - best_smoothing(1.0)) < 1e-3


@VARIANTS
def test_each_ruler_looks_for_its_edge(variant: Any, rng: np.random.Generator, device: Device) -> None:
    """Single edges and pairs of either polarity in one launch are the edges of four operations, bit by bit."""
    image = np.full(SHAPE, 60.0)
    for left in range(8, 130, 30):
        image[:, left : left + 11 + left % 3] = 160.0
    image = (cv2.GaussianBlur(image, (0, 0), 1.1) + rng.normal(0.0, 2.0, SHAPE)).astype(np.float32)
    count = 48
    angle = rng.uniform(-0.6, 0.6, count) + np.pi * (rng.random(count) < 0.5)
    places = [rng.uniform(35, 115, count), rng.uniform(35, 85, count), np.cos(angle), np.sin(angle)]
    sign, is_pair = np.where(rng.random(count) < 0.5, 1.0, -1.0), rng.random(count) < 0.5
    limits = np.where(is_pair[:, None], (6.0, 24.0), 0.0)
    rulers = np.column_stack([*places, sign, limits]).astype(np.float32)
    base = replace(STRONGEST, noise=2.0, variant=variant)  # shares programs with `test_polarity`
    found = replace(base, per_ruler=True)(image, rulers, device=device)
    for polarity, pairs in itertools.product((1.0, -1.0), (False, True)):
        which = (sign == polarity) & (is_pair == pairs)
        kind: dict[str, Any] = {"polarity": "rising" if polarity > 0 else "falling", "pairs": pairs}
        alone = replace(base, spacing_px=(6.0, 24.0) if pairs else None, **kind)
        expected = alone(image, np.ascontiguousarray(rulers[which, :4]), device=device)
        assert (expected.status == 0).sum() > 5
        for name, values in expected._asdict().items():
            if values is not None:
                np.testing.assert_array_equal(getattr(found, name)[which], values, err_msg=name)
    assert np.isnan(found.spacing[~is_pair]).all()
    with pytest.raises(ValueError, match="per_ruler takes polarity and spacing from the rulers"):
        replace(base, per_ruler=True, pairs=True)


def test_integer_frames_have_the_noise_of_rounding() -> None:
    """Rounding to whole grey levels adds a variance of 1/12: frames of floats with the sum have the same numbers."""
    rounded = replace(STRONGEST, count=3, noise=0.5).launch(Device.best(), SHAPE, np.dtype(np.uint8))
    exact = replace(STRONGEST, count=3, noise=math.sqrt(0.25 + 1.0 / 12.0)).launch(
        Device.best(), SHAPE, np.dtype(np.float32)
    )
    for one, other in zip(rounded.arguments, exact.arguments, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_allclose(one, other, rtol=1e-6)


def test_kinds_of_rulers_in_every_direction(device: Device) -> None:
    """Polarity and spacing are of the ruler, not of its direction; a ruler without a polarity has no edges."""
    rows, columns = np.indices(SHAPE)
    image = (60.0 + 100.0 * (np.hypot(columns - MIDDLE[0], rows - MIDDLE[1]) < 10.25)).astype(np.float32)
    image = cv2.GaussianBlur(image, (0, 0), 1.1)
    rulers, expected_edges = [], []
    for angle in np.pi / 8.0 + np.pi / 4.0 * np.arange(8):
        way = np.array([math.cos(angle), math.sin(angle)])
        for polarity, nearest, farthest, off, has_edge in (
            (-1.0, 0.0, 0.0, 30.0, True),
            (1.0, 0.0, 0.0, 30.0, False),
            (1.0, 0.0, 0.0, -30.0, True),
            (0.0, 0.0, 0.0, 30.0, False),
            (np.nan, 0.0, 0.0, 30.0, False),
            (1.0, 18.0, 23.0, 0.0, True),
            (-1.0, 18.0, 23.0, 0.0, False),
            (1.0, 1.0, 18.0, 0.0, False),
            (1.0, 23.0, 30.0, 0.0, False),
        ):
            rulers.append([*(np.array(MIDDLE) + off * way), *way, polarity, nearest, farthest])
            expected_edges.append(has_edge)
    given, there = np.array(rulers, np.float32), np.array(expected_edges)
    single = there & (given[:, 6] == 0.0)
    for variant in variants_of(device):
        found = replace(STRONGEST, per_ruler=True, variant=variant)(image, given, device=device)
        np.testing.assert_array_equal(found.status == 0, there)
        np.testing.assert_allclose(found.position[single], np.tile([-20.0, 20.0], 8), rtol=0, atol=0.3)
        np.testing.assert_allclose(found.spacing[there & ~single], 20.5, rtol=0, atol=0.5)
        assert np.isnan(found.position[~there]).all()


def test_rulers_to_the_last_pixel(device: Device) -> None:
    """Rulers along and up to the borders of the image have their edges; nothing beyond the last column is read."""
    length, half, last_x, last_y = 41, 20.0, SHAPE[1] - 1.0, SHAPE[0] - 1.0
    rows, columns = np.indices(SHAPE)
    bright = np.where((np.abs(rows - 60.0) < 50.0) & (np.abs(columns - 75.0) < 65.0), 160.0, 60.0)
    image = cv2.GaussianBlur(bright, (0, 0), 1.1).astype(np.float32)
    beside = np.where(rows < 100, 160.0, 60.0)
    beside = cv2.GaussianBlur(beside, (0, 0), 1.1).astype(np.float32)
    beside[:, 0] = np.nan
    ends = [[last_x - half, 60, 1, 0], [half, 60, 1, 0], [75, last_y - half, 0, 1], [75, half, 0, 1]]
    ends += [[last_x - half, 60, -1, 0], [half, 60, -1, 0], [75, last_y - half, 0, -1], [75, half, 0, -1]]
    outward = np.tile([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], (2, 1))
    along = np.array([[last_x, 99, 0, 1], [last_x, 99, 0, -1]], np.float32)
    for variant in variants_of(device):
        plain = replace(STRONGEST, length=length, width=1, variant=variant)
        through_lens = replace(plain, model=Lens(k1=-1e-20, centre=(75.0, 60.0)))
        # Places in the distorted image have rounding errors.
        for operation, margin in ((plain, 0.0), (through_lens, 1e-3)):
            for off, status in ((-margin, 0), (0.5, Status.OUT_OF_RANGE)):
                places = ends + np.column_stack([off * outward, np.zeros((8, 2))])
                result = operation(image, places.astype(np.float32), device=device)
                np.testing.assert_array_equal(result.status, status)
        np.testing.assert_array_equal(plain(beside, along, device=device).status, 0)
