"""Depth from focus of image stacks, against exact Gaussians and blurred textures."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.ndimage

from gpuvision.ranging.focus_stack import FocusPeak, FocusSearch, FocusStack, LensFocus, StageFocus
from gpuvision.ranging.sheet_motion import StraightTransport
from gpuvision.status import Status

ANYWHERE = ((-math.inf, math.inf),) * 3
STAGE = StageFocus(start=1e-3, step=20e-6, pixel_size=5e-6)


def found(stack: FocusStack, frames: Any) -> FocusPeak:
    search = FocusSearch(stack, frames.dtype)
    for frame in frames:
        search.add(frame)
    return search.peak()


def gaussians(peaks: Any, frames: int, width: float = 1.6, level: float = 100.0) -> Any:
    """Return a stack whose intensity is a Gaussian of the frame number with given peaks, (rows, columns)."""
    number = np.arange(frames)[:, None, None]
    return (level * np.exp(-0.5 * ((number - np.asarray(peaks)) / width) ** 2)).astype(np.float32)


def confocal(**more: Any) -> FocusStack:
    return FocusStack(geometry=STAGE, measure="intensity", **more)


@pytest.mark.parametrize("neighbours", [1, 2, 4])
def test_gaussians_are_met_exactly(neighbours: int) -> None:
    peaks = np.linspace(0.01, 10.99, 60).reshape(4, 15)
    peak = found(confocal(neighbours=neighbours), gaussians(peaks, 12))
    assert not peak.status.any()
    # float32 intensities: ln I has an error of 6e-8, relative to a curvature of 1/1.6^2.
    np.testing.assert_allclose(peak.frame, peaks, rtol=0, atol=3e-5)


def test_every_flag_has_its_reason() -> None:
    frames = gaussians(np.full((1, 8), 5.3), 12)
    frames[:, 0, 1] = 0.0
    frames[3, 0, 2] = np.nan
    frames[:, 0, 3] = gaussians(np.array([[-1.0]]), 12)[:, 0, 0]
    frames[:, 0, 4] = gaussians(np.array([[12.5]]), 12)[:, 0, 0]
    frames[:, 0, 5] = 7.0  # equal intensities
    frames[:, 0, 6] = np.minimum(frames[:, 0, 6], 90.0)  # at the limit
    frames[:, 0, 7] += 0.9 * gaussians(np.array([[0.0]]), 12, 0.8)[:, 0, 0]  # a second maximum
    peak = found(confocal(threshold=1.0, saturation=90.0, ambiguity=0.8), frames * 0.8)
    expected = [
        Status.OK, Status.LOW_SIGNAL, Status.NOT_FINITE, Status.OUT_OF_RANGE, Status.OUT_OF_RANGE, Status.AMBIGUOUS,
        Status.OK, Status.AMBIGUOUS,
    ]  # fmt: skip
    assert peak.status[0].tolist() == [int(each) for each in expected]
    np.testing.assert_array_equal(np.isfinite(peak.frame[0]), [True, *[False] * 5, True, True])
    bright = found(confocal(saturation=90.0), frames)
    assert bright.status[0, 6] == Status.SATURATED
    assert found(confocal(threshold=1.0), frames * 0.8).status[0, 7] == Status.OK


def test_noise_on_a_flank_is_no_second_maximum() -> None:
    rng = np.random.default_rng(4)
    frames = gaussians(np.full((40, 40), 20.3), 40, width=6.0)
    frames += rng.normal(0.0, 3.0, frames.shape).astype(np.float32)
    assert not found(confocal(ambiguity=0.5), np.maximum(frames, 0.1)).status.any()
    both = np.maximum(frames + gaussians(np.full((40, 40), 0.0), 40, width=2.0, level=70.0), 0.1)
    assert np.all(found(confocal(ambiguity=0.5), both).status == Status.AMBIGUOUS)


def test_a_second_maximum_may_come_first_or_last() -> None:
    peaks = np.array([[4.2, 15.1]])
    frames = gaussians(peaks, 20) + 0.8 * gaussians(peaks[:, ::-1], 20)
    peak = found(confocal(ambiguity=0.7), frames)
    assert np.all(peak.status == Status.AMBIGUOUS)
    np.testing.assert_allclose(peak.frame, peaks, rtol=0, atol=1e-3)
    assert not found(confocal(ambiguity=0.9), frames).status.any()


def blurred(depth: Any, frames: int, seed: int = 1) -> Any:
    """Return a stack (frames, rows, columns) uint8 of a texture, blurred by 0.6 px and 0.5 px per frame of defocus."""
    rng = np.random.default_rng(seed)
    texture = rng.uniform(0.0, 255.0, np.shape(depth))
    levels = np.sqrt(0.6**2 + (0.5 * np.abs(np.arange(frames)[:, None, None] - np.asarray(depth))) ** 2)
    sigmas = np.linspace(0.6, levels.max(), 60)
    layers = np.stack([scipy.ndimage.gaussian_filter(texture, sigma, mode="nearest") for sigma in sigmas])
    place = np.clip(np.searchsorted(sigmas, levels) - 1, 0, 58)
    share = (levels - sigmas[place]) / (sigmas[1] - sigmas[0])
    row, column = np.indices(np.shape(depth))
    stack = (1 - share) * layers[place, row, column] + share * layers[place + 1, row, column]
    return np.rint(stack).astype(np.uint8)


def test_a_tilted_texture_becomes_a_plane() -> None:
    depth = np.broadcast_to(np.linspace(3.0, 9.0, 90)[:, None], (90, 80))
    peak = found(FocusStack(geometry=STAGE, window=4, threshold=2.0), blurred(depth, 13))
    error = peak.frame - depth
    assert not peak.status.any()
    # Measured: 0.034 and 0.001 of the distance between frames.
    assert np.nanstd(error) < 0.05
    assert abs(np.nanmedian(error)) < 0.005


def test_the_laplacian_is_that_of_the_definition() -> None:
    image = np.random.default_rng(2).uniform(0, 200, (9, 11))
    padded = np.pad(image, 1, mode="edge")
    bends = np.abs(2 * image - padded[1:-1, :-2] - padded[1:-1, 2:]) + np.abs(
        2 * image - padded[:-2, 1:-1] - padded[2:, 1:-1]
    )
    one = FocusStack(geometry=STAGE, window=0).sharpness(image)
    np.testing.assert_allclose(one, bends, rtol=0, atol=1e-3)
    summed = FocusStack(geometry=STAGE, window=1).sharpness(image)
    assert summed[4, 5] == pytest.approx(bends[3:6, 4:7].mean(), rel=1e-5)


def test_a_lens_sees_objects_where_its_equation_says() -> None:
    lens = LensFocus(focal_length=0.05, first=0.055, spacing=5e-4, pixel_pitch=5e-6, stand_off=0.5)
    frame = np.array([[2.25, 4.0, 7.5]])
    image = 0.055 + 5e-4 * frame
    distance = 1.0 / (1.0 / 0.05 - 1.0 / image)
    peak = FocusPeak(frame, np.ones((1, 3), np.float32), np.zeros((1, 3), np.uint8))
    stack = FocusStack(geometry=lens, principal_point_px=(0.0, -10.0))
    points = stack.points(peak, StraightTransport(direction=(0.0, -1.0, 0.0)), ANYWHERE, np.float64)
    np.testing.assert_allclose(points.z, 0.5 - distance, rtol=0, atol=1e-14)
    np.testing.assert_allclose(points.x, np.arange(3) * 5e-6 * distance / image, rtol=0, atol=1e-16)
    np.testing.assert_allclose(points.y, -10.0 * 5e-6 * distance / image, rtol=0, atol=1e-16)
    high = stack.points(peak, StraightTransport(), (*ANYWHERE[:2], (-math.inf, float(0.5 - distance[0, 1]))))
    assert high.status.tolist() == [[0, 0, Status.OUT_OF_RANGE]]
    assert np.isnan(high.x).tolist() == [[False, False, True]]


@pytest.mark.parametrize("principal_point_px", [None, (0.5, 3.0)])
def test_pixels_lie_around_the_optical_axis(principal_point_px: tuple[float, float] | None) -> None:
    """Columns along g, rows along the direction, from the middle of the frame by default; flags of the peak stay."""
    frame = np.arange(12.0).reshape(3, 4)
    status = np.zeros((3, 4), np.uint8)
    status[1, 2] = Status.SATURATED
    move = StraightTransport(
        g_axis=(1.0, 0.25, 0.0), h_axis=(0.5, 0.0, 2.0), direction=(0.0, -0.6, 0.8), origin=(0.1, -0.2, 0.3)
    )
    stack = confocal(principal_point_px=principal_point_px)
    points = stack.points(FocusPeak(frame, np.ones((3, 4), np.float32), status), move, ANYWHERE, np.float64)
    column, row = principal_point_px or (1.5, 1.0)
    for r, c in np.ndindex(3, 4):
        height = 1e-3 + 20e-6 * frame[r, c]
        place = np.array(move.origin) + height * np.array(move.h_axis)
        place += 5e-6 * ((c - column) * np.array(move.g_axis) + (r - row) * np.array(move.direction))
        np.testing.assert_allclose([points.x[r, c], points.y[r, c], points.z[r, c]], place, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(points.status, status)


def test_points_on_the_limits_are_inside() -> None:
    frame = np.array([[0.0, 1.0, 2.0, 3.0]])
    peak = FocusPeak(frame, np.ones((1, 4), np.float32), np.array([[0, 0, 0, Status.SATURATED]], np.uint8))
    stage = StageFocus(start=-1.0, step=1.0, pixel_size=0.5)
    stack = FocusStack(geometry=stage, principal_point_px=(0.0, 0.0))
    everywhere = (-math.inf, math.inf)
    out = int(Status.OUT_OF_RANGE)
    for limits, expected in (
        ((everywhere, everywhere, (0.0, 1.0)), [out, 0, 0, out | int(Status.SATURATED)]),
        (((0.5, 1.0), everywhere, everywhere), [out, 0, 0, out | int(Status.SATURATED)]),
        ((everywhere, (0.0, 0.0), everywhere), [0, 0, 0, int(Status.SATURATED)]),
        ((everywhere, (1e-300, 1.0), everywhere), [out, out, out, out | int(Status.SATURATED)]),
    ):
        points = stack.points(peak, StraightTransport(), limits)
        assert points.status.tolist() == [expected]
        for each in (points.x, points.y, points.z):
            np.testing.assert_array_equal(np.isnan(each[0]), [(flag & out) != 0 for flag in expected])
            assert each.dtype == np.float32


def test_a_short_stack_is_refused() -> None:
    with pytest.raises(ValueError, match="the focus stack has 2 frames, expected at least 3"):
        found(confocal(), gaussians(np.ones((2, 2)), 2))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: StageFocus(start=0.0, step=0.0, pixel_size=1.0), r"StageFocus\.step is 0"),
        (lambda: StageFocus(start=0.0, step=1.0, pixel_size=0.0), r"StageFocus\.pixel_size is 0\.0"),
        (lambda: LensFocus(focal_length=0.05, first=0.04, spacing=1, pixel_pitch=1, stand_off=1), r"first is 0\.04"),
        (lambda: confocal(neighbours=0), r"neighbours"),
        (lambda: confocal(window=-1), r"window"),
        (lambda: confocal(threshold=-1.0), r"threshold is -1"),
        (lambda: confocal(threshold=-1e-9), r"threshold is -1e-09, expected 0 or more"),
        (lambda: confocal(ambiguity=0.0), r"ambiguity is 0\.0, expected a number above 0 and at most 1"),
        (lambda: confocal(ambiguity=1.0 + 1e-9), r"ambiguity is 1\.000000001"),
        (lambda: confocal(read_noise=0.0), r"read_noise is 0\.0, expected a number above 0"),
        (lambda: confocal(read_noise=1.0, gain=-1e-9), r"gain"),
        (lambda: confocal().noise(np.ones((3, 3))), r"read_noise is None"),
        (lambda: LensFocus(focal_length=0.05, first=0.05, spacing=1, pixel_pitch=1, stand_off=1), r"first is 0\.05 m"),
        (lambda: LensFocus(focal_length=0.05, first=1, spacing=0, pixel_pitch=1, stand_off=1), r"spacing is 0"),
        (lambda: LensFocus(focal_length=0.05, first=1, spacing=1, pixel_pitch=1, stand_off=-1), r"stand_off is -1"),
        (lambda: confocal(ambiguity=1.5), r"ambiguity is 1\.5"),
        (lambda: FocusStack(geometry=STAGE, measure="contrast"), r"measure is 'contrast', expected one of laplacian"),
    ],
)  # fmt: skip
def test_refusals(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_numbers_on_their_limits_are_taken() -> None:
    stack = confocal(threshold=0.0, ambiguity=1.0, window=0, neighbours=1, read_noise=1e-9, gain=0.0)
    # Equal maxima, one after the other: the second one is as strong as the first.
    frames = np.tile(gaussians(np.full((1, 1), 3.0), 7), (2, 1, 1))
    assert found(stack, frames).status.tolist() == [[Status.AMBIGUOUS]]
    assert StageFocus(start=0.0, step=-1e-9, pixel_size=1e-9).step == -1e-9
    # A measure equal to the threshold is too low, and a level equal to the limit is saturated.
    assert found(confocal(threshold=100.0), frames).status.tolist() == [[Status.LOW_SIGNAL]]
    assert found(confocal(threshold=99.9, saturation=100.0), frames).status.tolist() == [[Status.SATURATED]]
    assert found(confocal(saturation=100.1), frames).status.tolist() == [[Status.OK]]
